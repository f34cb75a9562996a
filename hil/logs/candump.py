"""Text logs of candump, `.log`."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from hil.logs.frames import EXTENDED, Frames
from hil.logs.notes import Note
from hil.logs.source import LogError, read_bytes
from hil.logs.text_lines import Part, join_parts, match_lines
from vaneloop.base.files import whole

__all__ = ["read_candump", "write_candump"]

# `candump -l`: (1735329625.329586) can0 17C#0000000010000021, ids of 3 or 8 digits, #R remote, ##f CAN FD with flags f,
# direction behind; and the console form `candump -ta` or `-tz`, a blank before it, with `-a` text behind:
#  (1735329625.329586)  can0  17C   [8]  00 00 00 00 10 00 00 21   '.......!'
_CANDUMP = re.compile(
    rb" ?\((?P<s>\d{1,10})\.(?P<f>\d{1,9})\)\s+(?P<bus>[^\s#]{1,20})\s+(?:[RT]X\s+\S\s+\S\s+)?"
    rb"(?P<id>[0-9A-Fa-f]{8}|[0-9A-Fa-f]{3})"
    rb"(?P<form>##(?P<flags>[0-9A-Fa-f])|#|\s+\[\s?\d{1,2}\]\s*)(?P<remote>R[0-9A-Fa-f]?|remote request)?"
    rb"(?P<d>(?: ?[0-9A-Fa-f]{2}){0,64})(?:_[0-9A-Fa-f])?(?:\s+[RTrt][xX]?)?[ \t]*"
    rb"(?P<tail>(?:'[^\n]{0,64}'|ERRORFRAME)?[ \t]*)\Z"
)
_NO_SECONDS = (
    (re.compile(rb"^ ?\(\d{4}-\d\d-\d\d ", re.M), "its times are dates (candump -tA)"),
    (re.compile(rb"^ *[^\s(#\[]{1,20} +(?:[RT]X\s+\S\s+\S\s+)?[0-9A-Fa-f]{3,8} +\[", re.M), "its lines have no time"),
)
# `candump -d` says what the socket's queue could not hold
_DROPCOUNT = re.compile(rb"^DROPCOUNT: dropped (?P<n>\d{1,10}) CAN frames? on '(?P<bus>[^'\n]{1,20})' socket", re.M)


def read_candump(path: Path) -> Frames:
    """Frames of a `candump` log."""
    parts: list[Part] = []
    buses: dict[bytes, int] = {}
    bad = special = 0
    raw = read_bytes(path)
    for lines in match_lines(raw, _CANDUMP, b"( "):
        if isinstance(lines, int):
            bad += lines
            continue
        m, ident = lines.match, lines.ident()
        extended = len(m["id"]) == 8
        right = ident < (1 << 29 if extended else 1 << 11)  # an error frame has bit 29
        if m["remote"] is not None:
            right[:] = False
        special += int(np.count_nonzero(~right))
        if extended:
            ident |= np.uint32(EXTENDED)
        data = lines.data(8 if m["form"] == b"#" else 64)
        parts.append(
            (
                lines.start[right],
                lines.seconds(10**9)[right],
                ident[right],
                buses.setdefault(m["bus"], len(buses)),
                data[right],
            )
        )
    notes: list[str] = []
    if bad:
        notes.append(Note(f"{bad} lines are not candump lines: left out", "left out", "rows", bad))
    dropped: dict[bytes, int] = {}
    for m in _DROPCOUNT.finditer(raw):
        dropped[m["bus"]] = dropped.get(m["bus"], 0) + int(m["n"])
    notes += [
        f"the logger dropped {n:,} frames of {bus.decode('ascii', 'replace')} (DROPCOUNT)" for bus, n in dropped.items()
    ]
    if special:
        notes.append(Note(f"{special} remote or error frames: left out", "left out", "frames", special))
    if not parts and (what := next((what for kind, what in _NO_SECONDS if kind.search(raw)), "")):
        raise LogError(f"{path}: {what}; allowed: seconds (candump -l, or -ta on the console)")
    return join_parts(path, parts, "candump", "(1735329625.329586) can0 17C#0000000010000021", notes)


def write_candump(path: Path, frames: Frames) -> None:
    """Write a `candump -l` log of classic frames on vcan0, microseconds."""
    text = frames.data.tobytes().hex().upper()
    w = 2 * frames.data.shape[1]
    micros = np.rint(frames.t * 1e6).astype(np.int64).tolist()
    lines = [
        f"({us // 1_000_000:010d}.{us % 1_000_000:06d}) vcan0 "
        f"{i & 0x1FFFFFFF:0{8 if i >> 31 else 3}X}#{text[k * w : k * w + 2 * n]}\n"
        for k, (us, i, n) in enumerate(zip(micros, frames.ident.tolist(), frames.length.tolist(), strict=True))
    ]
    with whole(path, LogError) as part:
        part.write_text("".join(lines), encoding="ascii")
