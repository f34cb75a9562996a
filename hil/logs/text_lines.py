"""Lines of a text log of CAN frames, parsed as columns: what candump, ASC and TRC have in common.

Lines that have equal length nearly always have equal columns. So the first line of a length gives the columns (by a
regular expression), all lines that agree with it are parsed as one matrix, and the others take the next round. In the
expressions the groups h, m, s, f, n are decimal digits (s, n with the blanks that pad them), id, d, flags are hex
digits (with the blanks, commas or semicolons between bytes), tail is free; all else is fixed in a round.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hil.logs.frames import EXTENDED, Frames, frames_in_order
from hil.logs.source import LogError

__all__ = ["Lines", "Part", "join_parts", "match_lines", "part_of"]

_DECIMAL, _HEX = ("h", "m", "s", "f", "n"), ("id", "d", "flags")
_BETWEEN = b" \t,;"  # bytes of data
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
class Lines:
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
        places = [k for k in range(d0, d1) if self.match.string[k] not in _BETWEEN][: 2 * most]
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
            if group in _HEX and line[k] in _BETWEEN:
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


def match_lines(raw: bytes, layout: re.Pattern[bytes], lead: bytes) -> Iterator[Lines | int]:
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
                yield Lines(at, columns, m) if fits.all() else Lines(at[fits], columns.compress(fits, axis=1), m)
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
                yield Lines(at[some], np.ascontiguousarray(columns[:, some]), m)
    yield bad


Part = tuple[np.ndarray, np.ndarray, np.ndarray, int, np.ndarray]  # place in the file, ns, identifier, bus, data


def part_of(lines: Lines, per_unit: int, extended: bool, bus: int, most: int) -> Part:
    """Frames of one layout; an identifier that is too long for its kind is no frame's."""
    ident = lines.ident()
    right = ident < (1 << 29 if extended else 1 << 11)
    if extended:
        ident |= np.uint32(EXTENDED)
    return lines.start[right], lines.seconds(per_unit)[right], ident[right], bus, lines.data(most)[right]


def join_parts(path: Path, parts: list[Part], kind: str, example: str, notes: list[str]) -> Frames:
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
    return frames_in_order(str(path), ns, ident, bus, length, data[order], notes)
