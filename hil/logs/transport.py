"""Messages longer than a frame, put together from the frames that carry them: the transport protocol of J1939
(J1939-21: BAM, and RTS with CTS) and ISO-TP (ISO 15765-2, normal addressing).

A message has the time of its last frame: before, nobody had it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from hil.logs.dbc import Message
from hil.logs.frames import EXTENDED, Frames
from hil.logs.notes import Note
from hil.logs.signals import pgn

__all__ = ["put_together"]

_CM, _DT = 0xEC00, 0xEB00  # parameter groups: connection management, data transfer
_RTS, _BAM = 16, 32
_PRIORITY = 6 << 26  # of a message put together: its own was not sent
_LONGEST = 1785, 4095  # bytes of a message of J1939, and of ISO-TP that is taken for one


@dataclass
class _Found:
    """Messages put together: s, identifier, bus, bytes; how many frames they took, and how many stayed incomplete."""

    t: list[float] = field(default_factory=list)
    ident: list[int] = field(default_factory=list)
    bus: list[int] = field(default_factory=list)
    data: list[bytes] = field(default_factory=list)
    frames: int = 0
    broken: int = 0

    def add(self, t: float, ident: int, bus: int, data: bytes) -> None:
        self.t.append(t)
        self.ident.append(ident)
        self.bus.append(bus)
        self.data.append(data)

    def extend(self, other: _Found) -> None:
        for name in ("t", "ident", "bus", "data"):
            getattr(self, name).extend(getattr(other, name))

    def note(self, protocol: str) -> Note:
        lost = f"; {self.broken:,} incomplete: left out" if self.broken else ""
        said = f"{protocol}: {len(self.t):,} messages put together from {self.frames:,} frames{lost}"
        return Note(said, "joined", "frames", self.frames)


def put_together(frames: Frames, messages: list[Message]) -> tuple[Frames | None, list[str]]:
    """The messages of a database that no frame of the log holds whole, and notes; None where there are none.

    ``length`` of the result is int64, and its ``data`` as wide as the longest message.
    """
    long = [m for m in messages if m.layout.length > 8]
    found, notes = _Found(), list[str]()
    if any(m.ident & EXTENDED for m in long):
        group = np.where(frames.ident >> 31 == 1, pgn(frames.ident & np.uint32(0x1FFFFFFF)), 0)
        rows = np.flatnonzero((group == _CM) | (group == _DT))
        if rows.size and (one := _j1939(frames, rows)).t:
            found.extend(one)
            notes.append(one.note("J1939 TP"))
    for m in long:
        rows = np.flatnonzero(frames.ident == np.uint32(m.ident))
        if rows.size and (m.layout.length > 64 or int(frames.length[rows].max()) <= 8):
            one = _iso_tp(frames, rows)
            if one.frames > len(one.t):  # a message of several frames is what tells the protocol
                found.extend(one)
                notes.append(one.note(f"{m.layout.name}: ISO-TP"))
    if not found.t:
        return None, notes
    order = np.argsort(found.t, kind="stable")
    length = np.array([len(d) for d in found.data], np.int64)
    wide = int(length.max())
    data = np.frombuffer(b"".join(d.ljust(wide, b"\0") for d in found.data), np.uint8).reshape(-1, wide)
    ident, bus = np.array(found.ident, np.uint32), np.array(found.bus, np.int32)
    return Frames(np.array(found.t)[order], ident[order], bus[order], length[order], data[order]), notes


def _columns(frames: Frames, rows: np.ndarray) -> zip[tuple[float, int, int, bytes]]:
    """Time, identifier, bus and bytes of some frames."""
    data = [row[:n].tobytes() for row, n in zip(frames.data[rows], frames.length[rows].tolist(), strict=True)]
    return zip(frames.t[rows].tolist(), frames.ident[rows].tolist(), frames.bus[rows].tolist(), data, strict=True)


def _j1939(frames: Frames, rows: np.ndarray) -> _Found:
    """Messages of J1939: one at a time from a source to a destination. A packet may be sent again."""
    found = _Found()
    open_: dict[tuple[int, int], tuple[int, int, int, dict[int, bytes]]] = {}  # group, bytes, packets, these by number
    for t, ident, bus, data in _columns(frames, rows):
        between = bus, ident & 0xFFFF  # destination and source
        if len(data) < 8:
            continue
        if (ident >> 16) & 0xFF == _CM >> 8:
            if data[0] not in (_RTS, _BAM):
                continue
            size, packets = int.from_bytes(data[1:3], "little"), data[3]
            found.broken += between in open_
            open_.pop(between, None)
            if 8 < size <= _LONGEST[0] and packets == -(-size // 7):
                open_[between] = int.from_bytes(data[5:8], "little") & 0x3FFFF, size, packets, {}
        elif between in open_:
            of, size, packets, got = open_[between]
            got[data[0]] = data[1:8]
            if len(got) == packets and set(got) == set(range(1, packets + 1)):
                destination = ident & 0xFF00 if (of >> 8) & 0xFF < 240 else 0
                whole = b"".join(got[k] for k in range(1, packets + 1))[:size]
                found.add(t, EXTENDED | _PRIORITY | of << 8 | destination | ident & 0xFF, bus, whole)
                found.frames += packets + 1
                del open_[between]
    found.broken += len(open_)
    return found


def _iso_tp(frames: Frames, rows: np.ndarray) -> _Found:
    """Messages of one identifier in ISO-TP: single frames, first and consecutive ones. Flow control is passed over."""
    found = _Found()
    open_: dict[int, tuple[int, bytearray, int, int]] = {}  # by bus: bytes, those that came, next number, frames
    for t, ident, bus, data in _columns(frames, rows):
        kind = data[0] >> 4 if data else 3
        if kind in (0, 1) and bus in open_:
            found.broken += 1
            del open_[bus]
        if kind == 0:
            size, at = (data[0] & 15, 1) if data[0] & 15 or len(data) <= 8 else (data[1], 2)
            if 0 < size <= len(data) - at:
                found.add(t, ident, bus, data[at : at + size])
                found.frames += 1
        elif kind == 1 and len(data) >= 8:
            size, at = int.from_bytes(data[:2], "big") & 0xFFF, 2
            if not size:
                size, at = int.from_bytes(data[2:6], "big"), 6
            if len(data) - at < size <= _LONGEST[1]:
                open_[bus] = size, bytearray(data[at:]), 1, 1
        elif kind == 2 and bus in open_:
            size, got, number, count = open_.pop(bus)
            if data[0] & 15 != number:
                found.broken += 1
                continue
            got += data[1:]
            if len(got) >= size:
                found.add(t, ident, bus, bytes(got[:size]))
                found.frames += count + 1
            else:
                open_[bus] = size, got, (number + 1) % 16, count + 1
    found.broken += len(open_)
    return found
