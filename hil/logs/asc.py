"""Vector ASCII logs, `.asc`.

python-can's reader ends at the first line that it cannot read; a log cut off in mid-line, or with a foreign event, is
common.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from hil.logs.frames import Frames
from hil.logs.source import LogError, read_bytes
from hil.logs.text_lines import Part, join_parts, match_lines, part_of

__all__ = ["read_asc"]

_ASC = re.compile(
    rb"(?P<s> *\d{1,10})\.(?P<f>\d{1,9})[ \t]+(?P<fd>CANFD[ \t]+)?(?P<bus>\d{1,4})[ \t]+(?(fd)\w+[ "
    rb"\t]+)(?P<id>[0-9A-Fa-f]{1,8})"
    rb"(?P<x>x?)[ \t]+(?(fd)(?:\S*[^\s01]\S*[ \t]+)?[01][ \t]+[01][ \t]+[0-9A-Fa-f]{1,2}|\w+[ \t]+d)[ "
    rb"\t]+(?P<len>[0-9A-Fa-f]{1,2})"
    rb"(?P<d>(?:[ \t]+[0-9A-Fa-f]{2}(?![^ \t])){0,64})(?P<tail>(?:[ \t].*)?)\Z"
)
_ASC_TIME = re.compile(rb"^[ \t]*(\d+\.\d+)[ \t]", re.M)
_ASC_BASE = re.compile(rb"^[ \t]*base[ \t]+(hex|dec)(?:[ \t]+timestamps[ \t]+(absolute|relative))?", re.M | re.I)


def read_asc(path: Path) -> Frames:
    """Frames of a Vector ASCII log, classic and CAN FD; times absolute or relative to the event before."""
    raw = read_bytes(path)
    head = _ASC_BASE.search(raw[:100_000])
    if head and head[1].lower() == b"dec":
        raise LogError(f"{path}: has its numbers in base dec; allowed: base hex")
    parts: list[Part] = []
    for lines in match_lines(raw, _ASC, b" \t0123456789"):
        if not isinstance(lines, int):
            m = lines.match
            most = min(int(m["len"]), 64) if m["fd"] and m["len"].isdigit() else min(int(m["len"], 16), 8)
            parts.append(part_of(lines, 10**9, bool(m["x"]), int(m["bus"]), most))
    if head and (head[2] or b"").lower() == b"relative":
        events = [(m.start(), float(m[1])) for m in _ASC_TIME.finditer(raw)]
        place, since = np.array([e[0] for e in events]), np.cumsum([e[1] for e in events])
        parts = [(p[0], np.rint(since[np.searchsorted(place, p[0])] * 1e9).astype(np.int64), *p[2:]) for p in parts]
    return join_parts(path, parts, "ASC", "0.010000 1  A0  Rx  d 8 00 01 02 03 04 05 06 07", [])
