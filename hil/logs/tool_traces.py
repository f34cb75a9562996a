"""Text traces of CAN tools: Vector ASCII (`.asc`), PEAK (`.trc`), BUSMASTER, Microchip's CAN BUS Analyzer, CRTD,
CANHacker, CARBUS Analyzer, and frames in CSV (SavvyCAN and GVRET, CANedge, python-can).

python-can's readers end at the first line that they cannot read; a log cut off in mid-line, or with a foreign event, is
common.
"""

from __future__ import annotations

import base64
import binascii
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hil.logs.frames import EXTENDED, Frames
from hil.logs.source import LogError, read_bytes
from hil.logs.text_lines import Lines, Part, join_parts, match_lines, part_of

__all__ = [
    "read_asc", "read_busmaster", "read_canhacker", "read_carbus", "read_crtd", "read_csv_frames", "read_microchip",
    "read_trc",
]  # fmt: skip

_MINUTE, _DAY = 60 * 10**9, 86_400 * 10**9  # ns after which a clock of seconds, or of a day, begins anew
_LATE = 10**9  # ns that a frame may come late, as loggers of several channels swap some
_BYTES = rb"(?P<d>(?:[ \t]+[0-9A-Fa-f]{2}(?![^ \t])){0,64})"
_ID = rb"(?P<id>[0-9A-Fa-f]{1,8})"
_YES = (b"1", b"true", b"29", b"x")  # what says that an identifier has 29 bits, in small letters


@dataclass(frozen=True)
class _Trace:
    """How the lines of a trace look.

    name     of the format, and an ``example`` of its lines, for messages
    layout   of a line; groups as of `hil.logs.text_lines`, and: x says whether the identifier has 29 bits, len is the
             number of data bytes, rtr a word of a remote frame, minus the sign of the time
    unit     ns of one count of the group s
    wraps    ns after which the time begins anew, 0 where it does not
    remark   lines that are no frames and no damage
    """

    name: str
    example: str
    layout: re.Pattern[bytes]
    unit: int = 10**9
    wraps: int = 0
    remark: re.Pattern[bytes] | None = None


_BUSMASTER = _Trace(
    "BUSMASTER", "11:49:12:9420 Rx 1 0x023 s 2 40 00",
    re.compile(
        rb"(?P<h>\d{1,2}):(?P<m>\d{1,2}):(?P<s>\d{1,2}):(?P<f>\d{1,6})[ \t]+[RT]x[ \t]+(?P<bus>\d{1,2})[ \t]+0x" + _ID
        + rb"[ \t]+(?P<x>[sx])(?P<rtr>r?)[ \t]+(?P<len>\d{1,2})" + _BYTES + rb"(?P<tail>.*)\Z"
    ),
    wraps=_DAY,
)  # fmt: skip
_MICROCHIP = _Trace(
    "CAN BUS Analyzer", "1247;RX;0xC2;2;0x5C;0x87",
    re.compile(
        rb"(?P<s>\d{1,15})(?:\.(?P<f>\d{1,6}))?;[RT]X;" + _ID
        + rb";(?P<len>\d{1,2});?(?P<d>[0-9A-Fa-f]{0,2}(?:;[0-9A-Fa-f]{2}){0,64});?(?P<tail>)[ \t]*\Z"
    ),
    unit=10**6,
)  # fmt: skip
_CRTD = _Trace(
    "CRTD", "1320745424.002 1R11 2C3 00 35 2F",
    re.compile(rb"(?P<s>\d{1,15})(?:\.(?P<f>\d{1,9}))?[ \t]+(?P<bus>\d?)[RT](?P<x>11|29)[ \t]+" + _ID + _BYTES
               + rb"[ \t]*(?P<tail>)\Z"),
    remark=re.compile(rb"^\d+(?:\.\d+)?[ \t]+\d?[A-QS-Z]\w*", re.M),
)  # fmt: skip
_CANHACKER = _Trace(
    "CANHacker", "00.250 18EA0003 8 BE FE 00 00 FF FF FF FF",
    re.compile(rb"(?P<s>\d{1,10})[.,](?P<f>\d{1,6})[ \t]+" + _ID + rb"[ \t]+(?P<len>\d)" + _BYTES + rb"(?P<tail>.*)\Z"),
    wraps=_MINUTE,
)  # fmt: skip
_CARBUS = _Trace(
    "CARBUS Analyzer", "14,687 1 0004 4E0 2 24 00",
    re.compile(
        rb"(?P<s>\d{1,10})[.,](?P<f>\d{1,6})[ \t]+(?P<bus>\d{1,2})[ \t]+[0-9A-Fa-f]{1,8}[ \t]+" + _ID
        + rb"[ \t]+(?P<len>\d{1,2})" + _BYTES + rb"(?P<tail>.*)\Z"
    ),
    wraps=_MINUTE,
)  # fmt: skip
_GVRET = _Trace(
    "SavvyCAN", "166064000,00000122,false,Rx,0,2,74,6A",
    re.compile(
        rb"(?P<minus>-?)(?P<s>\d{1,18})(?P<f>),(?:0x)?" + _ID + rb",(?P<x>\w{1,5}),(?:[RTrt]x,)?(?P<bus>\d{1,3}),"
        rb"(?P<len>\d{1,2})(?P<d>(?:,[0-9A-Fa-f]{2}){0,64})(?P<tail>(?:,.*)?)\Z"
    ),
    unit=10**3,
)  # fmt: skip
_CANEDGE = _Trace(
    "CANedge", "1578922367.777150;1;14FF0121;1;2;2;0;0;0;0;0;0102",
    re.compile(
        rb"(?P<s>\d{1,10})\.(?P<f>\d{1,9});(?P<bus>\d{1,3});" + _ID + rb";(?P<x>[01]);\d{1,2};(?P<len>\d{1,2});"
        rb"\d;\d;\d;\d;(?P<rtr>1?)0?;(?P<d>(?:[0-9A-Fa-f]{2}){0,64})(?P<tail>)\Z"
    ),
)  # fmt: skip


def read_busmaster(path: Path) -> Frames:
    """Frames of a BUSMASTER log; times of the day, from the start, or from line to line."""
    raw = read_bytes(path)
    head = raw[:100_000].upper()
    if b"***DEC***" in head:
        raise LogError(f"{path}: has its numbers in DEC; allowed: HEX")
    parts, notes = _parts(raw, _BUSMASTER)
    if b"***RELATIVE MODE***" in head:
        times = re.finditer(rb"^(\d+):(\d+):(\d+):(\d+)[ \t]", raw, re.M)
        events = [(m.start(), (int(m[1]) * 60 + int(m[2])) * 60 + float(m[3] + b"." + m[4])) for m in times]
        place, since = np.array([e[0] for e in events]), np.cumsum([e[1] for e in events])
        parts = [(p[0], np.rint(since[np.searchsorted(place, p[0])] * 1e9).astype(np.int64), *p[2:]) for p in parts]
        return join_parts(path, parts, _BUSMASTER.name, _BUSMASTER.example, notes)
    return _joined(path, parts, _BUSMASTER, notes)


def read_microchip(path: Path) -> Frames:
    """Frames of a log of Microchip's CAN BUS Analyzer; times in ms."""
    raw = re.sub(rb"0[xX]", b"", read_bytes(path))
    return _joined(path, *_of(_parts(raw, _MICROCHIP), _MICROCHIP))


def read_crtd(path: Path) -> Frames:
    """Frames of a CRTD log, as of the Open Vehicle Monitoring System; times in s."""
    return _joined(path, *_of(_parts(read_bytes(path), _CRTD), _CRTD))


def read_canhacker(path: Path) -> Frames:
    """Frames of a CANHacker trace; times in s of the minute."""
    return _joined(path, *_of(_parts(read_bytes(path), _CANHACKER), _CANHACKER))


def read_carbus(path: Path) -> Frames:
    """Frames of a CARBUS Analyzer trace, versions 2 and 3; times in s of the minute, lines that end with CR."""
    raw = read_bytes(path).replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    return _joined(path, *_of(_parts(raw, _CARBUS), _CARBUS))


def read_csv_frames(path: Path) -> Frames:
    """Frames in CSV, a row a frame, as SavvyCAN and GVRET, CANedge's converters or python-can write them."""
    raw = read_bytes(path).removeprefix(b"\xef\xbb\xbf")
    if raw.startswith(b"timestamp,"):
        return _python_can(path, raw)
    of = _CANEDGE if raw.startswith(b"TimestampEpoch") else _GVRET
    found = _parts(raw, of)
    if of is _GVRET and found[1]:  # small loggers write 5 for 05
        found = _parts(re.sub(rb",([0-9A-Fa-f])(?=[,\r\n]|\Z)", rb",0\1", raw), of)
    return _joined(path, *_of(found, of))


def _python_can(path: Path, raw: bytes) -> Frames:
    """Frames of a CSV of python-can, whose bytes are in base64."""
    t: list[int] = []
    ident: list[int] = []
    data: list[bytes] = []
    bad = special = 0
    for line in raw.splitlines()[1:]:
        cells = line.split(b",")
        try:
            stamp, number, extended, remote, error, _, text = cells
            frame = float(stamp), int(number, 16), base64.b64decode(text, validate=True)
        except (ValueError, binascii.Error):
            bad += bool(line.strip())
            continue
        if b"1" in (remote, error):
            special += 1
        elif len(frame[2]) > 64 or not 0 <= frame[1] < 1 << (29 if extended == b"1" else 11) or not frame[0] < 9e9:
            bad += 1
        else:
            t.append(round(frame[0] * 1e9))
            ident.append(frame[1] | EXTENDED * (extended == b"1"))
            data.append(frame[2])
    parts = []
    for n in set(map(len, data)):
        rows = np.array([k for k, d in enumerate(data) if len(d) == n])
        block = np.frombuffer(b"".join(d for d in data if len(d) == n), np.uint8).reshape(rows.size, n)
        parts.append((rows, np.array(t, np.int64)[rows], np.array(ident, np.uint32)[rows], 0, block))
    return join_parts(path, parts, "python-can", "0.25,0x122,0,0,0,2,dGo=", _notes("python-can", bad, special))


# --- what they share --------------------------------------------------------------------------------------------------


def _of(found: tuple[list[Part], list[str]], of: _Trace) -> tuple[list[Part], _Trace, list[str]]:
    return found[0], of, found[1]


def _notes(name: str, bad: int, special: int) -> list[str]:
    notes = [f"{bad} lines are not {name} lines: left out"] if bad else []
    return notes + [f"{special} remote or error frames: left out"] * bool(special)


def _parts(raw: bytes, of: _Trace) -> tuple[list[Part], list[str]]:
    """Frames of a trace by layout of its lines, and notes on what was left out."""
    found: list[tuple[Lines, np.ndarray, np.ndarray]] = []
    bad = special = 0
    for lines in match_lines(raw, of.layout, b" -0123456789"):
        if isinstance(lines, int):
            bad += lines
            continue
        said = lines.match.groupdict()
        data = lines.data(min(int(said["len"]), 64) if "len" in said else 64)
        if said.get("rtr"):
            special += lines.start.size
        elif "len" in said and data.shape[1] < int(said["len"]):
            bad += lines.start.size
        else:
            found.append((lines, lines.ident(), data))
    padded = all(len(lines.match["id"]) == 8 for lines, _, _ in found)
    parts: list[Part] = []
    for lines, ident, data in found:
        said = lines.match.groupdict()
        extended = ident > 0x7FF
        if "x" in said:
            extended |= said["x"].lower() in _YES
        elif not padded:  # eight digits beside shorter ones are an identifier of 29 bits
            extended |= len(said["id"]) == 8
        right = ident < 1 << 29
        bad += int(np.count_nonzero(~right))
        ident = np.where(extended, ident | np.uint32(EXTENDED), ident)
        parts.append(
            (lines.start[right], _ns(lines, said, of)[right], ident[right], int(said.get("bus") or 0), data[right])
        )
    if of.remark is not None:
        bad -= sum(1 for _ in of.remark.finditer(raw))
    return parts, _notes(of.name, max(bad, 0), special)


def _ns(lines: Lines, said: dict[str, bytes], of: _Trace) -> np.ndarray:
    """The times of lines, ns."""
    ns = lines.seconds(10**3 if of is _CRTD and said["f"] is None else of.unit)  # without a point CRTD counts in us
    if "h" in said:
        ns = ns + (lines.number("h") * 60 + lines.number("m")) * _MINUTE
    return -ns if said.get("minus") else ns


def _joined(path: Path, parts: Iterable[Part], of: _Trace, notes: list[str]) -> Frames:
    """Frames of all layouts; a clock that begins anew goes on."""
    parts = [p for p in parts if p[0].size]
    if of.wraps and parts and max(int(p[1].max()) for p in parts) < of.wraps:
        place, ns = (np.concatenate([p[k] for p in parts]) for k in (0, 1))
        order = np.argsort(place, kind="stable")
        step = np.diff(ns[order])
        turns = (step < -_LATE).astype(np.int64) - (step > of.wraps - _LATE)
        ns[order] += np.concatenate(([0], np.cumsum(turns))) * of.wraps
        ends = np.cumsum([p[0].size for p in parts])[:-1]
        parts = [(p[0], t, *p[2:]) for p, t in zip(parts, np.split(ns, ends), strict=True)]
    return join_parts(path, parts, of.name, of.example, notes)


# ---- Vector ASCII

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


# ---- PEAK

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
