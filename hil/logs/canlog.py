"""Frames of a CAN log as columns of numbers, and the signals in them.

A log of any format becomes one `Frames` (time, identifier, bus, length, bytes as arrays); a signal is then cut out
of all frames of its message at once. That is what makes an hour of CAN readable in a second: python-can and cantools
walk frame by frame at 0.2 to 0.3 million frames/s and serve here as the reference in the tests, as the readers of
the formats where speed matters less (`.asc`, `.trc`), and as the source of the layout (DBC).

Bit order, as in DBC: a little-endian signal starts at its least significant bit, a big-endian one at its most
significant bit; bit k of the frame is bit k % 8 (0 = least significant) of byte k // 8.
"""

from __future__ import annotations

import functools
import re
import struct
import zlib
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from hil.logs import plausible
from vaneloop.base.errors import InputError

__all__ = [
    "DISORDER_S", "EXTENDED", "Frames", "LogError", "Message", "crc_table", "cut_signal", "e2e_crc", "encode",
    "load_dbc", "read_asc",
    "read_blf", "read_candump", "read_trc", "select", "write_asc", "write_blf", "write_candump", "write_trc",
]  # fmt: skip

EXTENDED = 1 << 31  # flag in `Frames.ident`, as socketcan sets it
DISORDER_S = 0.050  # loggers that merge several channels swap frames by a few ms; more is a clock that jumped
MAX_DBC = 32 << 20  # bytes; the largest of whole vehicles have some ten MB
MAX_FILE = 4 << 30  # bytes; a CAN log beyond this is split by every logger


class LogError(InputError):
    """A log cannot be used. One line: file, channel, reason."""

    def __init__(self, text: str):
        # names and cells of a damaged file end up in messages: keep them on one printable line
        line = "".join(c if c.isprintable() else " " for c in text)
        super().__init__(" ".join(line.split())[:1000])


@dataclass(frozen=True)
class Frames:
    """All data frames of a log, in order of time.

    t       float64[n]      s from the first frame
    ident   uint32[n]       identifier, bit 31 set for the 29-bit kind
    bus     int32[n]        number of the bus (interface) in the log
    length  uint8[n]        bytes of data
    data    uint8[n, w]     data, zeros behind `length`; w = 8, or 64 where the log has CAN FD
    """

    t: np.ndarray
    ident: np.ndarray
    bus: np.ndarray
    length: np.ndarray
    data: np.ndarray
    notes: list[str] = field(default_factory=list)

    @property
    def words(self) -> np.ndarray:
        """uint64[n]: eight bytes of data as one number, the first lowest."""
        return np.ascontiguousarray(self.data).view("<u8")[:, 0]


def in_order(name: str, t: np.ndarray, notes: list[str]) -> tuple[np.ndarray, np.ndarray | slice]:
    """Times in s from the first (``t`` in s, or int64 ns) and the order that sorts them; refuse a clock that jumped
    back.
    """
    if t.dtype == np.int64:
        t = (t - t[:1]) / 1e9
    if not np.isfinite(t).all():
        raise LogError(f"{name}: time of frame {int(np.argmin(np.isfinite(t))) + 1} is not a number")
    if not t.size or (np.diff(t) >= 0).all():
        return t, slice(None)
    back = np.maximum.accumulate(t) - t
    worst = int(np.argmax(back))
    if back[worst] > DISORDER_S and (wrong := plausible.out_of_order(t, DISORDER_S)) is not None:
        first = int(np.argmax(wrong))
        what = f"{int(np.count_nonzero(wrong)):,} of {t.size:,} frames"
        notes.append(
            f"time: {what} have a wrong time stamp (first frame {first + 1}: {t[first]:.9g} s from the first): left out"
        )
        rows = np.flatnonzero(~wrong)
        return t, rows[in_order(name, t[rows], notes)[1]]
    if back[worst] > DISORDER_S:
        limit = f"allowed: up to {DISORDER_S * 1e3:g} ms (sorted)"
        raise LogError(f"{name}: time runs backwards by {back[worst]:.6g} s at frame {worst + 1}; {limit}")
    falls = int(np.count_nonzero(np.diff(t) < 0))
    if falls > 0.3 * t.size and t.size > 10:
        raise LogError(
            f"{name}: time runs backwards at {falls} of {t.size} frames; it must count from one start (not from frame "
            f"to frame)"
        )
    notes.append(
        f"{int(np.count_nonzero(back > 0))} frames out of order by up to {back[worst] * 1e3:.3g} ms: sorted by time"
    )
    return t, np.argsort(t, kind="stable")


def _frames(
    name: str, t: np.ndarray, ident: np.ndarray, bus: np.ndarray, length: np.ndarray, data: np.ndarray, notes: list[str]
) -> Frames:
    """Frames in order of time from the first."""
    t, order = in_order(name, t, notes)
    t = t[order]
    return Frames(t - t[:1], ident[order], bus[order], length[order], data[order], notes)


def check_file(path: Path) -> int:
    """Size of the file, or a LogError for one that is missing, a folder, empty, or too long."""
    try:
        folder, size = path.is_dir(), path.stat().st_size
    except (OSError, ValueError) as e:
        raise LogError(f"{path}: cannot be read ({getattr(e, 'strerror', None) or e})") from None
    if folder or not path.is_file():
        raise LogError(f"{path}: is {'a folder' if folder else 'not a file'}, not a log")
    if size > MAX_FILE:
        raise LogError(f"{path}: {size} bytes; allowed: up to {MAX_FILE}")
    if not size:
        raise LogError(f"{path}: is empty")
    return size


def read_bytes(path: Path, most: int = -1) -> bytes:
    """The file's bytes, or its first ``most``; LogError where it cannot be read."""
    check_file(path)
    try:
        with path.open("rb") as file:
            return file.read(most)
    except (OSError, MemoryError) as e:
        raise LogError(f"{path}: cannot be read ({getattr(e, 'strerror', None) or e})") from None


# --- text formats -----------------------------------------------------------------------------------------------------

# Lines of a text log that have equal length nearly always have equal columns. So the first line of a length gives the
# columns (by a regular expression), all lines that agree with it are parsed as one matrix, and the others take the next
# round. In the expressions the groups s, f, n are decimal digits (s, n with the blanks that pad them), id, d, flags are
# hex digits (with the blanks between bytes), tail is free; all else is fixed in a round.
_DECIMAL, _HEX = ("s", "f", "n"), ("id", "d", "flags")
_ROUNDS = 24  # per line length; lines left over are sorted into layouts one by one
_BLOCK = 4096  # lines turned into columns at a time: 200 kB stay in the cache
_LONGEST = 600  # bytes of a line; CAN FD with everything behind it stays below

_NIBBLE = np.full(256, 255, np.uint8)
for _i, _c in enumerate(b"0123456789ABCDEF"):
    _NIBBLE[_c] = _i
for _i, _c in enumerate(b"abcdef"):
    _NIBBLE[_c] = 10 + _i
_KIND = np.arange(256, dtype=np.uint8)  # a byte's kind: hex digits are one, every other byte its own
_KIND[_NIBBLE < 16] = ord("0")


@dataclass
class _Lines:
    """Lines of a text log that one layout fits: their places in the file, their bytes as columns, and the match of one
    of them.
    """

    start: np.ndarray
    columns: np.ndarray
    match: re.Match[bytes]

    def number(self, group: str) -> np.ndarray:
        """int64 of a decimal group."""
        out = np.zeros(self.start.size, np.int64)
        for k in range(*self.match.span(group)):
            out = out * 10 + (self.columns[k] & np.uint8(15))  # a blank counts 0
        return out

    def seconds(self, per_unit: int) -> np.ndarray:
        """ns of the groups s and f, in units of ``per_unit`` ns."""
        f0, f1 = self.match.span("f")
        whole = np.minimum(self.number("s"), 9_000_000_000_000_000_000 // per_unit - 1)  # int64 ns end in the year 2262
        return whole * per_unit + (self.number("f") * per_unit // 10 ** (f1 - f0) if f1 > f0 else 0)

    def ident(self) -> np.ndarray:
        """uint32 of the group id."""
        out = np.zeros(self.start.size, np.uint32)
        for k in range(*self.match.span("id")):
            out = (out << np.uint32(4)) | _NIBBLE[self.columns[k]]
        return out

    def data(self, most: int) -> np.ndarray:
        """Bytes of the group d, at most ``most``: uint8[n, w]."""
        d0, d1 = self.match.span("d")
        places = [k for k in range(d0, d1) if self.match.string[k] not in b" \t"][: 2 * most]
        out = np.empty((self.start.size, len(places) // 2), np.uint8)
        for k in range(out.shape[1]):
            out[:, k] = _NIBBLE[self.columns[places[2 * k]]] << 4 | _NIBBLE[self.columns[places[2 * k + 1]]]
        return out


def _fit(columns: np.ndarray, m: re.Match[bytes]) -> np.ndarray:
    """Which lines (columns of bytes) have the layout of ``m``."""
    line = np.frombuffer(m.string, np.uint8)
    fits = np.ones(columns.shape[1], bool)
    free = np.zeros(line.size, bool)
    free[slice(*m.span("tail") if "tail" in m.re.groupindex else (0, 0))] = True
    for group in (*_DECIMAL, *_HEX):
        at, end = m.span(group) if group in m.re.groupindex else (0, 0)
        padded = group in "sn"
        for k in range(at, end):
            if group in _HEX and line[k] in b" \t":
                continue
            free[k] = True
            c = columns[k]
            if group in _HEX:
                fits &= _NIBBLE[c] < 16
            elif not padded or k == end - 1:
                fits &= c - np.uint8(48) <= 9
            else:  # blanks stand before the digits only
                fits &= (c - np.uint8(48) <= 9) | ((c == 32) & (columns[max(k - 1, at)] == 32))
    for fixed in np.flatnonzero(~free):
        fits &= columns[fixed] == line[fixed]
    return fits


def _match_lines(raw: bytes, layout: re.Pattern[bytes], lead: bytes) -> Iterator[_Lines | int]:
    """Lines that ``layout`` matches, by layout; then how many lines that begin with one of ``lead`` it does not
    match.
    """
    buf = np.frombuffer(raw, np.uint8)
    end = np.flatnonzero(buf == 10)
    start = np.concatenate(([0], end + 1))
    end = np.concatenate((end, [buf.size]))
    end = end - ((end > start) & (buf[np.maximum(end - 1, 0)] == 13))
    size = end - start
    led = np.flatnonzero(size > 0)
    led = led[np.isin(buf[start[led]], np.frombuffer(lead, np.uint8))]
    wanted = led[size[led] <= _LONGEST]
    start, size = start[wanted], size[wanted].astype(np.uint16)
    bad = led.size - wanted.size
    order = np.argsort(size, kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(size[order])) + 1) if order.size else []:
        width = int(size[rows[0]])
        at = start[rows]
        windows = np.lib.stride_tricks.sliding_window_view(buf, width)
        columns = np.empty((width, at.size), np.uint8)
        for k in range(0, at.size, _BLOCK):
            columns[:, k : k + _BLOCK] = windows[at[k : k + _BLOCK]].T
        for _ in range(_ROUNDS):
            if not at.size:
                break
            m = layout.match(columns[:, 0].tobytes())
            if m is None:  # leave out every line of its kind: 500 lines of statistics are one round
                fits = (_KIND[columns] == _KIND[columns[:, :1]]).all(axis=0)
                bad += int(np.count_nonzero(fits))
            else:
                fits = _fit(columns, m)
                yield _Lines(at, columns, m) if fits.all() else _Lines(at[fits], columns.compress(fits, axis=1), m)
            at, columns = at[~fits], columns.compress(~fits, axis=1)
        kinds: dict[Any, list[int]] = {}
        for k, line in enumerate(np.ascontiguousarray(columns.T)):
            m = layout.match(line.tobytes())
            if m is None:
                bad += 1
            else:
                key = m.regs, *(m[g] for g in m.re.groupindex if g not in (*_DECIMAL, *_HEX, "tail"))
                kinds.setdefault(key, []).append(k)
        for some in kinds.values():
            m = layout.match(columns[:, some[0]].tobytes())
            if m is not None:
                yield _Lines(at[some], np.ascontiguousarray(columns[:, some]), m)
    yield bad


_Part = tuple[np.ndarray, np.ndarray, np.ndarray, int, np.ndarray]  # place in the file, ns, identifier, bus, data


def _join(path: Path, parts: list[_Part], kind: str, example: str, notes: list[str]) -> Frames:
    """Frames of all layouts in the order of the file."""
    parts = [p for p in parts if p[0].size]
    if not parts:
        raise LogError(f"{path}: no {kind} frame in it; a line looks like: {example}")
    order = np.argsort(np.concatenate([p[0] for p in parts]), kind="stable")
    data = np.zeros((order.size, 8 if max(p[4].shape[1] for p in parts) <= 8 else 64), np.uint8)
    row = 0
    for p in parts:
        data[row : row + len(p[4]), : p[4].shape[1]] = p[4]
        row += len(p[4])
    ns, ident = (np.concatenate([p[k] for p in parts])[order] for k in (1, 2))
    bus = np.concatenate([np.full(len(p[4]), p[3], np.int32) for p in parts])[order]
    length = np.concatenate([np.full(len(p[4]), p[4].shape[1], np.uint8) for p in parts])[order]
    return _frames(str(path), ns, ident, bus, length, data[order], notes)


# --- candump ----------------------------------------------------------------------------------------------------------

# `candump -l`: (1735329625.329586) can0 17C#0000000010000021, ids of 3 or 8 digits, #R remote, ##f CAN FD with flags f,
# direction behind; and the console form `candump -ta`: (1735329625.329586)  can0  17C   [8]  00 00 00 00 10 00 00 21
_CANDUMP = re.compile(
    rb"\((?P<s>\d{1,10})\.(?P<f>\d{1,9})\)\s+(?P<bus>[^\s#]{1,20})\s+(?:[RT]X\s+\S\s+\S\s+)?(?P<id>[0-9A-Fa-f]{8}|[0-9A-Fa-f]{3})"
    rb"(?P<form>##(?P<flags>[0-9A-Fa-f])|#|\s+\[\s?\d{1,2}\]\s*)(?P<remote>R[0-9A-Fa-f]?|remote request)?"
    rb"(?P<d>(?: ?[0-9A-Fa-f]{2}){0,64})(?:_[0-9A-Fa-f])?(?:\s+[RTrt][xX]?)?[ \t]*\Z"
)
# `candump -d` says what the socket's queue could not hold
_DROPCOUNT = re.compile(rb"^DROPCOUNT: dropped (?P<n>\d{1,10}) CAN frames? on '(?P<bus>[^'\n]{1,20})' socket", re.M)


def read_candump(path: Path) -> Frames:
    """Frames of a `candump` log."""
    parts: list[_Part] = []
    buses: dict[bytes, int] = {}
    bad = special = 0
    raw = read_bytes(path)
    for lines in _match_lines(raw, _CANDUMP, b"("):
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
    notes = [f"{bad} lines are not candump lines: left out"] if bad else []
    dropped: dict[bytes, int] = {}
    for m in _DROPCOUNT.finditer(raw):
        dropped[m["bus"]] = dropped.get(m["bus"], 0) + int(m["n"])
    notes += [
        f"the logger dropped {n:,} frames of {bus.decode('ascii', 'replace')} (DROPCOUNT)" for bus, n in dropped.items()
    ]
    if special:
        notes.append(f"{special} remote or error frames: left out")
    return _join(path, parts, "candump", "(1735329625.329586) can0 17C#0000000010000021", notes)


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
    path.write_text("".join(lines), encoding="ascii")


# --- other text formats -----------------------------------------------------------------------------------------------

# python-can's readers of these end at the first line they cannot read; a log cut off in mid-line, or with a foreign
# event, is common.
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
    parts: list[_Part] = []
    for lines in _match_lines(raw, _ASC, b" \t0123456789"):
        if not isinstance(lines, int):
            m = lines.match
            most = min(int(m["len"]), 64) if m["fd"] and m["len"].isdigit() else min(int(m["len"], 16), 8)
            parts.append(_text_part(lines, 10**9, bool(m["x"]), int(m["bus"]), most))
    if head and (head[2] or b"").lower() == b"relative":
        events = [(m.start(), float(m[1])) for m in _ASC_TIME.finditer(raw)]
        place, since = np.array([e[0] for e in events]), np.cumsum([e[1] for e in events])
        parts = [(p[0], np.rint(since[np.searchsorted(place, p[0])] * 1e9).astype(np.int64), *p[2:]) for p in parts]
    return _join(path, parts, "ASC", "0.010000 1  A0  Rx  d 8 00 01 02 03 04 05 06 07", [])


_TRC_COLUMNS = {
    b"1.0": "OILD",
    b"1.1": "OdILD",
    b"1.2": "OBdILD",
    b"1.3": "OBdIRLD",
    b"2.0": "OTIdlD",
    b"2.1": "OTBIdRLD",
}
_TRC_WORD = {
    "O": rb"(?P<s> *\d{1,15})(?:\.(?P<f>\d{1,6}))?", "T": rb"(?:DT|FD|FB|FE|BI)", "B": rb"(?P<bus>\d{1,3})",
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
    for lines in _match_lines(raw, layout, b" \t0123456789"):
        if not isinstance(lines, int):
            m, n = lines.match, int(lines.match["len"])
            most = n if "l" in columns or n <= 8 else (12, 16, 20, 24, 32, 48, 64)[min(n, 15) - 9]
            bus = int(m["bus"]) if "B" in columns else 1
            parts.append(_text_part(lines, 10**6, len(m["id"]) > 4, bus, min(most, 64)))
    return _join(path, parts, "TRC", "1)  10.0  Rx  00A0  8  00 01 02 03 04 05 06 07", [])


def _text_part(lines: _Lines, per_unit: int, extended: bool, bus: int, most: int) -> _Part:
    """Frames of one layout; an identifier that is too long for its kind is no frame's."""
    ident = lines.ident()
    right = ident < (1 << 29 if extended else 1 << 11)
    if extended:
        ident |= np.uint32(EXTENDED)
    return lines.start[right], lines.seconds(per_unit)[right], ident[right], bus, lines.data(most)[right]


# --- BLF --------------------------------------------------------------------------------------------------------------

_OBJECT = struct.Struct("<4sHHII")  # signature, header size, header version, size, type
_CONTAINER, _CAN, _CAN2, _FD, _FD64 = 10, 1, 86, 100, 101
_MOST = (
    32 << 20,
    50,
)  # bytes of all containers together, and more for each byte of the file; frames that never change shrink 11-fold


def read_blf(path: Path) -> Frames:
    """Frames of a Vector binary log.

    python-can's reader does not return from an object of size 0 and believes any container; here the containers are
    checked and joined, the objects found, and each kind of object decoded as one matrix. A damaged container costs its
    own frames.
    """
    raw = read_bytes(path)
    if len(raw) < 144 or raw[:4] != b"LOGG":
        raise LogError(f"{path}: is not a BLF (it must begin with LOGG and a header of 144 bytes)")
    chunks, damaged, total = [], 0, 0
    most = _MOST[0] + _MOST[1] * len(raw)
    at = min(max(int.from_bytes(raw[4:8], "little"), 144), len(raw))
    while at + 16 <= len(raw):
        signature, _, _, size, kind = _OBJECT.unpack_from(raw, at)
        if signature != b"LOBJ" or size < 16:
            damaged += 1
            at = raw.find(b"LOBJ", at + 1)
            if at < 0:
                break
            continue
        body = raw[at + 32 : at + size]
        damaged += at + size > len(raw)
        if kind == _CONTAINER and len(body):
            method, length = struct.unpack_from("<H6xI", raw, at + 16)
            if method == 2:
                inflate = zlib.decompressobj()
                try:  # deflate cannot shrink more than 1032-fold: a longer promise is a lie
                    body = inflate.decompress(body, min(length, 1032 * len(body) + 1024, most - total + 1) or 1)
                except zlib.error:
                    body = b""
                    damaged += 1
            elif method != 0:
                damaged += 1
                body = b""
        elif kind != _CONTAINER:
            body = raw[at : at + size]
        total += len(body)
        if total > most:
            raise LogError(
                f"{path}: {len(raw):,} bytes unpack to more than {most:,}; allowed: {_MOST[1]} times as much, and "
                f"{_MOST[0]:,}"
            )
        chunks.append(body)
        at += size + size % 4
    stream = b"".join(chunks)
    del chunks
    objects, more = _blf_objects(stream)
    notes = [f"{damaged + more} damaged places in the BLF: what is there was left out"] if damaged + more else []
    parts = [part for kind in (_CAN, _CAN2, _FD, _FD64) for part in _blf_frames(stream, objects, kind)]
    if not parts:
        raise LogError(f"{path}: no CAN frame in it")
    order = np.argsort(np.concatenate([p[0] for p in parts]), kind="stable")
    _, ns, ident, bus, length = (np.concatenate([p[k] for p in parts])[order] for k in range(5))
    wide = 8 if length.max() <= 8 else 64
    data = np.zeros((order.size, wide), np.uint8)
    row = 0
    for p in parts:
        w = min(wide, p[5].shape[1])
        data[row : row + len(p[5]), :w] = p[5][:, :w]
        row += len(p[5])
    return _frames(str(path), ns, ident, bus, length, data[order], notes)


def _blf_objects(stream: bytes) -> tuple[np.ndarray, int]:
    """Place, header version, size and type of each object, and how many damaged places were met."""
    unpack, find = _OBJECT.unpack_from, stream.find
    found = array("q")
    at, damaged, end = 0, 0, len(stream)
    while at + 32 <= end:
        signature, _, version, size, kind = unpack(stream, at)
        if signature != b"LOBJ":
            next_at = find(b"LOBJ", at + 1)
            if next_at < 0:
                break
            damaged += next_at - at > 8
            at = next_at
            continue
        if size < 32 or at + size > end:
            damaged += 1
            at += 4
            continue
        found.extend((at, version, size, kind))
        at += size
    return np.frombuffer(found, np.int64).reshape(-1, 4), damaged


def _blf_frames(stream: bytes, objects: np.ndarray, kind: int) -> Iterator[tuple[np.ndarray, ...]]:
    """Place, ns, identifier, bus, length and data of the data frames of one object type, by header version."""
    need = {_CAN: 16, _CAN2: 16, _FD: 84, _FD64: 40}[kind]
    for version, header in ((1, 32), (2, 40)):
        these = objects[(objects[:, 3] == kind) & (objects[:, 1] == version) & (objects[:, 2] >= header + need)]
        if not len(these):
            continue
        width = header + need + (64 if kind == _FD64 else 0)
        # the last object may be shorter than the columns that are cut out of it
        buf = np.frombuffer(stream if int(these[-1, 0]) + width <= len(stream) else stream + bytes(width), np.uint8)
        text = np.lib.stride_tricks.sliding_window_view(buf, width)[these[:, 0]]

        def number(at: int, size: int, text: np.ndarray = text) -> np.ndarray:
            return np.ascontiguousarray(text[:, at : at + size]).view(f"<u{size}")[:, 0]

        step = np.where(number(16, 4) == 1, 10_000, 1).astype(np.uint64)
        ticks = np.minimum(number(24, 8), np.uint64(9e18) // step)
        ident = number(header + 4, 4)
        at = header + (40 if kind == _FD64 else 20 if kind == _FD else 8)
        if kind == _FD64:
            room = np.where(text[:, header + 35] > 0, text[:, header + 35], these[:, 2]) - header - 40
            bus, remote = text[:, header], number(header + 12, 4) & 0x10
            length = np.clip(np.minimum(text[:, header + 2], room), 0, 64)
        else:
            bus, remote = number(header, 2), text[:, header + 2] & 0x80
            length = np.minimum(text[:, header + 14], 64) if kind == _FD else np.minimum(text[:, header + 3], 8)
        data = text[:, at : at + (8 if kind in (_CAN, _CAN2) else 64)].copy()
        data[np.arange(data.shape[1]) >= length[:, None]] = 0
        keep = remote == 0
        ns = (ticks * step).astype(np.int64)
        fields = these[:, 0], ns, ident & np.uint32(0x9FFFFFFF), bus.astype(np.int32), length.astype(np.uint8), data
        yield tuple(f[keep] for f in fields)


# --- writers through python-can ---------------------------------------------------------------------------------------


def _write_can(path: Path, frames: Frames, writer: str) -> None:
    import can

    with getattr(can, writer)(str(path)) as out:
        for t, i, n, data in zip(
            frames.t.tolist(), frames.ident.tolist(), frames.length.tolist(), frames.data, strict=True
        ):
            message = can.Message(
                round(t, 6), i & 0x1FFFFFFF, i >> 31 == 1, channel=0, data=data[:n].tobytes(), is_fd=n > 8
            )
            out.on_message_received(message)


def write_asc(path: Path, frames: Frames) -> None:
    """Write a Vector ASCII log."""
    _write_can(path, frames, "ASCWriter")


def write_blf(path: Path, frames: Frames) -> None:
    """Write a Vector binary log."""
    _write_can(path, frames, "BLFWriter")


def write_trc(path: Path, frames: Frames) -> None:
    """Write a PEAK trace, version 2.1."""
    _write_can(path, frames, "TRCWriter")


# --- database ---------------------------------------------------------------------------------------------------------

# What a DBC can lose without losing a signal's layout, least needed first.
_DROP = (("VAL_",), ("CM_",),
    ("BA_", "BA_DEF_", "BA_DEF_DEF_", "BA_REL_", "BA_DEF_REL_", "BA_DEF_DEF_REL_", "SIG_GROUP_", "EV_",
         "BO_TX_BU_", "VAL_TABLE_"))  # fmt: skip


@dataclass(frozen=True)
class Message:
    """One message of the database, with what the product needs beyond its layout.

    e2e         DataID of AUTOSAR E2E profile 1, None where the message has none
    j1939       raw values with 0xFE or 0xFF on top mean error or not available (J1939-71)
    missing     signal -> raw value that means not available (attribute NotAvailable of vgv.dbc)
    """

    layout: Any  # cantools.database.can.Message
    ident: int
    e2e: int | None
    j1939: bool
    missing: dict[str, int]


def load_dbc(path: Path) -> tuple[list[Message], list[str]]:
    """Messages of a database file and notes on what had to be left out of it."""
    if (size := check_file(path)) > MAX_DBC:
        raise LogError(f"{path}: {size:,} bytes; a database may have {MAX_DBC:,}")
    return _load_dbc(str(path), read_bytes(path))


@functools.lru_cache(maxsize=8)
def _load_dbc(path: str, raw: bytes) -> tuple[list[Message], list[str]]:
    import cantools

    kind = Path(path).suffix.lower().lstrip(".")
    text = raw.decode("utf-8-sig" if raw.startswith(b"\xef\xbb\xbf") else "cp1252", errors="replace")
    if kind in ("arxml", "kcd", "sym"):
        tries = [(text, False, "")]
    else:
        kind = "dbc"
        if "BO_ " not in text:
            raise LogError(f"{path}: is not a DBC (it defines no message, BO_)")
        tries = [(text, True, ""), (text, False, "")]
        for k in range(1, len(_DROP) + 1):
            gone = [word for words in _DROP[:k] for word in words]
            shorter = re.sub(rf'^[ \t]*(?:{"|".join(gone)})[ \t](?:[^;"]|"(?:[^"\\]|\\.)*")*;', "", text, flags=re.M)
            tries.append((shorter, False, "without its lines " + ", ".join(gone)))
    reason = ""
    for content, strict, lost in tries:
        try:
            db: Any = cantools.database.load_string(content, database_format=kind, strict=strict)
            messages = [_message(m) for m in db.messages]
        except Exception as e:  # cantools raises whatever its grammar meets
            reason = reason or " ".join(str(e).split())[:120]
            continue
        return messages, [f"{path}: read {lost} ({reason})"] if lost else []
    raise LogError(f"{path}: is not a database that cantools reads ({reason})")


def _message(m: Any) -> Message:
    """Read the attributes of a cantools message."""
    attributes = m.dbc.attributes if m.dbc is not None else {}

    def number(of: Any, key: str) -> int | None:
        attribute = of.get(key)
        return None if attribute is None else attribute.value

    missing = {}
    for s in m.signals:
        value = number(s.dbc.attributes if s.dbc is not None else {}, "NotAvailable")
        if isinstance(value, int):
            missing[s.name] = value
    e2e = number(attributes, "DataID") if number(attributes, "E2EProfile") in (1, "P01") else None
    frame_format = attributes.get("VFrameFormat")
    j1939 = m.protocol == "j1939" or (frame_format is not None and frame_format.value in (3, "J1939PG"))
    ident = m.frame_id | (EXTENDED if m.is_extended_frame else 0)
    return Message(m, ident, e2e, j1939 and m.is_extended_frame, missing)


def pgn(ident: np.ndarray | int) -> Any:
    """J1939 parameter group number of a 29-bit identifier: without priority, source and (PDU1) destination."""
    specific = ((ident >> 16) & 0xFF) < 240
    return ((ident >> 8) & 0x3FF00) | np.where(specific, 0, (ident >> 8) & 0xFF)


# --- signals ----------------------------------------------------------------------------------------------------------


def select(frames: Frames, message: Message) -> tuple[np.ndarray, list[str]]:
    """Rows of ``frames`` that carry ``message``, with notes on what was left out.

    The exact identifier counts first, then, for 29-bit identifiers, the J1939 parameter group. Where several senders or
    buses carry it, the one with most frames is taken: two sources in one channel would be a signal that nobody
    measured.
    """
    name, notes = message.layout.name, []
    rows = np.flatnonzero(frames.ident == np.uint32(message.ident))
    if not rows.size and message.ident & EXTENDED:
        rows = np.flatnonzero((frames.ident >> 31 == 1) & (pgn(frames.ident) == pgn(message.ident & 0x1FFFFFFF)))
    if not rows.size:
        return rows, []
    source = frames.ident[rows].astype(np.int64) << 16 | (frames.bus[rows] & 0xFFFF)
    kinds, counts = np.unique(source, return_counts=True)
    if kinds.size > 1:
        best = kinds[np.argmax(counts)]
        notes.append(
            f"{name}: {kinds.size} senders or buses; took 0x{(best >> 16) & 0x1FFFFFFF:X} ({counts.max()} of "
            f"{rows.size} frames)"
        )
        rows = rows[source == best]
    short = frames.length[rows] < message.layout.length
    if short.any():
        notes.append(
            f"{name}: {int(short.sum())} of {rows.size} frames are shorter than its {message.layout.length} bytes: "
            f"left out"
        )
        rows = rows[~short]
    if message.e2e is not None and rows.size:
        if message.layout.length == 8 and frames.data.shape[1] == 8:
            from hil.logs.columns import wrong_crc

            wrong = np.empty(rows.size, bool)
            wrong_crc(frames.words, rows, _CRC, _CRC[_CRC[message.e2e & 0xFF] ^ (message.e2e >> 8)], wrong)
        else:
            data = frames.data[rows, : message.layout.length]
            wrong = e2e_crc(data, message.e2e) != data[:, 0]
        if wrong.any():
            notes.append(f"{name}: {int(wrong.sum())} of {rows.size} frames have a wrong CRC: left out")
            rows = rows[~wrong]
    return rows, notes


def crc_table() -> np.ndarray:
    """CRC-8 SAE J1850, polynomial 0x1D."""
    c: Any = np.arange(256)
    for _ in range(8):
        c = np.where(c & 0x80, (c << 1) ^ 0x1D, c << 1) & 0xFF
    return c.astype(np.uint8)


_CRC = crc_table()


def e2e_crc(data: np.ndarray, data_id: int) -> np.ndarray:
    """CRC of AUTOSAR E2E profile 1, data identifier mode BOTH, over rows of bytes whose first is the CRC's place."""
    start = _CRC[_CRC[data_id & 0xFF] ^ (data_id >> 8)]
    crc = np.full(len(data), start, np.uint8)
    for k in range(1, data.shape[1]):
        crc = _CRC[crc ^ data[:, k]]
    return crc


def _place(signal: Any) -> tuple[list[int], int]:
    """Bytes of a signal from least to most significant, and how far its lowest bit is above bit 0 of the first
    of them.
    """
    if signal.byte_order == "little_endian":
        first, last = signal.start // 8, (signal.start + signal.length - 1) // 8
        return list(range(first, last + 1)), signal.start % 8
    first = 8 * (signal.start // 8) + 7 - signal.start % 8
    after = first + signal.length
    return list(range((after - 1) // 8, first // 8 - 1, -1)), -after % 8


def cut_raw(data: np.ndarray, signal: Any) -> np.ndarray:
    """Raw values of a signal: uint64, int64, or float64 for IEEE signals."""
    places, shift = _place(signal)
    raw = np.zeros(len(data), np.uint64)
    for k, byte in enumerate(places):
        column = data[:, byte].astype(np.uint64)
        up = 8 * k - shift
        raw |= column << np.uint64(up) if up >= 0 else column >> np.uint64(-up)
    n = signal.length
    if n < 64:
        raw &= np.uint64((1 << n) - 1)
    if signal.is_float:
        whole, part = {16: (np.uint16, np.float16), 32: (np.uint32, np.float32), 64: (np.uint64, np.float64)}[n]
        with np.errstate(invalid="ignore"):
            return raw.astype(whole).view(part).astype(np.float64)
    if not signal.is_signed:
        return raw
    lift = np.uint64(64 - n)
    return (raw << lift).view(np.int64) >> np.int64(64 - n)


def cut_signal(frames: Frames, rows: np.ndarray, message: Message, signal: Any) -> tuple[np.ndarray, np.ndarray, int]:
    """Rows that carry the signal's value, the physical values, and how many said "not available".

    value = raw * scale + offset; a multiplexed signal is in the frames whose selector says so.
    """
    chain, selector, wanted = [signal], signal.multiplexer_signal, signal.multiplexer_ids
    while selector is not None and wanted and len(chain) < 8:
        chain.append(message.layout.get_signal_by_name(selector))
        selector, wanted = chain[-1].multiplexer_signal, chain[-1].multiplexer_ids
    need = 1 + max(max(_place(s)[0]) for s in chain)
    if any(s.length > 64 or (s.is_float and s.length not in (16, 32, 64)) or min(_place(s)[0]) < 0 for s in chain):
        raise LogError(
            f"{message.layout.name}.{signal.name}: {signal.length} bits cannot be read; allowed: 64, or an IEEE number"
        )
    if need > frames.data.shape[1]:
        return rows[:0], np.empty(0), 0
    if (
        frames.data.shape[1] == 8
        and len(chain) == 1
        and not signal.is_float
        and not message.j1939
        and signal.length < 64
    ):
        return _cut_integer(frames, rows, message, signal, need)
    rows = rows[frames.length[rows] >= need]
    for s, chooser in zip(chain, chain[1:], strict=False):
        raw = cut_raw(frames.data[rows], chooser)
        rows = rows[np.isin(raw.astype(np.int64), np.array(s.multiplexer_ids, np.int64))]
    raw = cut_raw(frames.data[rows], signal)
    there = np.ones(rows.size, bool)
    if signal.name in message.missing:
        there = raw.astype(np.int64) != message.missing[signal.name]
    elif message.j1939 and not signal.is_float:
        bits = raw.astype(np.uint64) & np.uint64((1 << signal.length) - 1)
        n = signal.length
        there = bits >> np.uint64(n - 8) < 0xFE if n >= 8 else bits < (1 << n) - 1 if n >= 4 else there
    with np.errstate(all="ignore"):  # an IEEE signal may hold anything; the reader leaves out what is not finite
        values = raw.astype(np.float64) * float(signal.scale) + float(signal.offset)
    return rows[there], values[there], int(np.count_nonzero(~there))


def _cut_integer(
    frames: Frames, rows: np.ndarray, message: Message, signal: Any, need: int
) -> tuple[np.ndarray, np.ndarray, int]:
    """`cut_signal` for the common case: an integer that is in every frame of eight bytes."""
    from hil.logs.columns import cut

    places, shift = _place(signal)
    big = len(places) > 1 and places[0] > places[1]
    shift += 8 * (7 - places[0] if big else places[0])
    none = message.missing.get(signal.name, 1 << 62)
    out_rows, out = np.empty(rows.size, np.int64), np.empty(rows.size)
    scale, offset = float(signal.scale), float(signal.offset)
    n, missing = cut(
        frames.words,
        rows,
        frames.length,
        need,
        big,
        shift,
        signal.length,
        bool(signal.is_signed),
        scale,
        offset,
        none,
        out_rows,
        out,
    )
    return out_rows[:n], out[:n], missing


def encode(message: Message, values: dict[str, np.ndarray], n: int) -> np.ndarray:
    """Bytes of ``n`` frames: physical values to raw ones (nearest), NaN to "not available", then counter and CRC."""
    data = np.zeros((n, message.layout.length), np.uint8)
    for signal in message.layout.signals:
        if message.e2e is not None and signal.name in ("crc", "counter"):
            continue
        column = values.get(signal.name)
        if signal.is_float or signal.length > 52:
            if column is None:
                continue
            raise LogError(
                f"{signal.name}: its {signal.length} bits in {message.layout.name} cannot be written; allowed: 52-bit "
                f"integers"
            )
        low, high = (
            (-(1 << signal.length - 1), (1 << signal.length - 1) - 1)
            if signal.is_signed
            else (0, (1 << signal.length) - 1)
        )
        none = message.missing.get(signal.name, 0)
        if column is None:
            raw = np.full(n, none, np.int64)
        else:
            exact = (column - float(signal.offset)) / float(signal.scale)
            scaled = np.rint(exact)
            with np.errstate(invalid="ignore"):
                bad = (scaled < low) | (scaled > high) | ((scaled == none) & (signal.name in message.missing))
            if bad.any():
                a, b = sorted(
                    (
                        low * float(signal.scale) + float(signal.offset),
                        high * float(signal.scale) + float(signal.offset),
                    )
                )
                raise LogError(
                    f"{signal.name} (={column[np.argmax(bad)]:g} {signal.unit or ''}): does not fit "
                    f"{message.layout.name}, which holds {a:g} to {b:g}; a table format (.csv, .parquet) holds any "
                    "value"
                )
            raw = np.where(np.isnan(scaled), none, scaled).astype(np.int64)
        bits = raw.astype(np.uint64) & np.uint64((1 << signal.length) - 1)
        places, shift = _place(signal)
        for k, byte in enumerate(places):
            up = 8 * k - shift
            data[:, byte] |= (bits >> np.uint64(up) if up >= 0 else bits << np.uint64(-up)).astype(np.uint8)
    if message.e2e is not None:
        data[:, 1] |= (np.arange(1, n + 1) % 15).astype(np.uint8)
        data[:, 0] = e2e_crc(data, message.e2e)
    return data
