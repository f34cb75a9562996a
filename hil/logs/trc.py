"""PEAK traces, `.trc`.

python-can's reader ends at the first line that it cannot read; a log cut off in mid-line, or with a foreign event, is
common.
"""

from __future__ import annotations

import re
from pathlib import Path

from hil.logs.frames import Frames
from hil.logs.source import LogError, read_bytes
from hil.logs.text_lines import join_parts, match_lines, part_of

__all__ = ["read_trc"]

_TRC_COLUMNS = {
    b"1.0": "OILD",
    b"1.1": "OdILD",
    b"1.2": "OBdILD",
    b"1.3": "OBdIRLD",
    b"2.0": "OTIdlD",
    b"2.1": "OTBIdRLD",
}
_TRC_WORD = {
    "O": rb"(?P<s> *\d{1,15})(?:[.,](?P<f>\d{1,6}))?", "T": rb"(?:DT|FD|FB|FE|BI)", "B": rb"(?P<bus>\d{1,3})",
    "I": rb"(?P<id>[0-9A-Fa-f]{3,8})", "d": rb"(?:Rx|Tx)", "R": rb"\S+", "L": rb"(?P<len>\d{1,2})(?![ "
                                                                              rb"\t]+RTR)", "l": rb"(?P<len>\d{1,2})",
}  # fmt: skip


def read_trc(path: Path) -> Frames:
    """Frames of a PEAK trace, versions 1.0 to 2.1; times in ms."""
    raw = read_bytes(path)
    version = re.search(rb"^;\$FILEVERSION=(\d\.\d)", raw[:100_000], re.M)
    if version and version[1] not in _TRC_COLUMNS:
        raise LogError(
            f"{path}: TRC version {version[1].decode()} is not known; allowed: {b', '.join(_TRC_COLUMNS).decode()}"
        )
    stated = re.search(rb"^;\$COLUMNS=N,([A-Za-z,]+)", raw[:100_000], re.M)
    columns = stated[1].decode().replace(",", "") if stated else _TRC_COLUMNS[version[1] if version else b"1.0"]
    given = set(columns)
    if (
        not given <= {*_TRC_WORD, "D"}
        or len(given) < len(columns)
        or not {"O", "I", "D"} <= given
        or columns[-1] != "D"
    ):
        raise LogError(f"{path}: TRC columns {columns} are not understood; allowed: {', '.join(_TRC_WORD)}, and D last")
    if ("L" in given) == ("l" in given):
        raise LogError(f"{path}: TRC columns {columns} must have one of L and l")
    words = b"".join((rb"[ \t]" if c == "O" else rb"[ \t]+") + _TRC_WORD[c] for c in columns[:-1])
    bytes_ = rb"(?P<d>(?:[ \t]+[0-9A-Fa-f]{2}(?![^ \t])){0,64})(?P<tail>(?:[ \t].*)?)\Z"
    layout = re.compile(rb"(?P<n> *\d{1,10})\)?" + words + bytes_)
    parts = []
    for lines in match_lines(raw, layout, b" \t0123456789"):
        if not isinstance(lines, int):
            m, n = lines.match, int(lines.match["len"])
            most = n if "l" in columns or n <= 8 else (12, 16, 20, 24, 32, 48, 64)[min(n, 15) - 9]
            bus = int(m["bus"]) if "B" in columns else 1
            parts.append(part_of(lines, 10**6, len(m["id"]) > 4, bus, min(most, 64)))
    return join_parts(path, parts, "TRC", "1)  10.0  Rx  00A0  8  00 01 02 03 04 05 06 07", [])
