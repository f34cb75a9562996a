"""A CAN log seen through a database: its signals read from frames, and channels written as the frames that a bus would
carry.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from hil.logs.dbc import Message, load_dbc
from hil.logs.frames import Frames
from hil.logs.notes import Note
from hil.logs.signals import cut_signal, encode, pgn, select
from hil.logs.source import Channel, LogError, Options, Series, names_held
from hil.logs.transport import put_together
from vaneloop.base import tables

__all__ = ["Bus", "encode_channels", "open_bus_log"]

_MOST_FRAMES = 20_000_000  # of one message; 55 h at 10 ms
_HOLD = 3  # frame periods a value is repeated on the bus before its channel counts as silent


class Bus:
    """A CAN log seen through a database: `MESSAGE.SIGNAL`, or `SIGNAL` where one message has it."""

    kind = "signal"
    sorted = True

    def __init__(self, frames: Frames, messages: list[Message], notes: list[str], dbc: Path):
        self.frames, self.dbc = frames, dbc
        self.notes = notes + frames.notes
        self.names: dict[str, tuple[str, ...]] = {}
        self.comments: dict[str, str] = {}
        self._of: dict[str, tuple[Message, list[Any]]] = {}
        self._silent: dict[str, str] = {}
        self._rows: dict[int, tuple[Frames, np.ndarray]] = {}
        self._long, said = put_together(frames, messages)
        self.notes += said
        seen = np.unique(frames.ident if self._long is None else np.concatenate((frames.ident, self._long.ident)))
        groups = set(pgn(seen[seen >> 31 == 1]).tolist())
        sent = set(seen.tolist())
        for m in messages:
            here = m.ident in sent or (m.ident >> 31 and int(pgn(m.ident & 0x1FFFFFFF)) in groups)
            for key, branches in _by_name(m).items():
                full, name = f"{m.layout.name}.{branches[0].name}", str(branches[0].name)
                if here:
                    self.names[key] = tuple(dict.fromkeys((key, full, name)))
                    self._of[key] = m, branches
                    self.comments[key] = str(branches[0].comment or "")
                else:
                    why = (
                        f"{dbc.name} has it in {m.layout.name} (0x{m.ident & 0x1FFFFFFF:X}), but the log has no "
                        f"such frame"
                    )
                    self._silent[name] = self._silent[full] = why
        if frames.t.size and not self.names:
            self.notes.append(self._unknown())

    def has(self) -> str:
        if self.names:
            return names_held(self.kind, self.names)
        return f"; {self._unknown()}"

    def _unknown(self) -> str:
        """What is to be said of a database that knows none of the log's frames."""
        ident, count = np.unique(self.frames.ident & 0x1FFFFFFF, return_counts=True)
        most = ", ".join(f"0x{i:X}" for i in ident[np.argsort(-count)][:8]) + (", ..." if ident.size > 8 else "")
        return f"{self.dbc.name} has no message for the log's {ident.size} identifiers ({most}): --dbc F"

    def absent(self, name: str) -> str:
        return self._silent.get(name, "")

    def series(self, key: str) -> Series:
        m, branches, frames, of = self.carried(key)
        parts = [cut_signal(frames, of, m, signal) for signal in branches]
        rows, values, missing = parts[0][0], parts[0][1], sum(p[2] for p in parts)
        if len(parts) > 1:  # each frame carries one branch
            rows, at = np.unique(np.concatenate([p[0] for p in parts]), return_index=True)
            values = np.concatenate([p[1] for p in parts])[at]
        if missing and not rows.size:
            self._silent[key] = self._silent[str(branches[0].name)] = f"all {missing} frames say not available"
        elif missing:
            self.notes.append(Note(f"{key}: {missing} frames say not available: left out", "left out", key, missing))
        return Series(frames.t[rows], values, str(branches[0].unit or ""), framed=True)

    def carried(self, key: str) -> tuple[Message, list[Any], Frames, np.ndarray]:
        """The message and the signals of it that ``key`` names, and the rows of the frames that carry it."""
        m, branches = self._of[key]
        if m.ident not in self._rows:
            self._rows[m.ident] = self._select(m)
        return m, branches, *self._rows[m.ident]

    def _select(self, m: Message) -> tuple[Frames, np.ndarray]:
        """Frames and the rows of them that carry a message: those put together by a transport protocol, if any do."""
        for frames in filter(None, (self._long if m.layout.length > 8 else None, self.frames)):
            rows, notes = select(frames, m)
            if rows.size or frames is self.frames:
                self.notes += notes
                break
        return frames, rows


def _by_name(message: Message) -> dict[str, list[Any]]:
    """Signals of a message by the name under which they are offered.

    A name that several branches of a multiplexed message carry is one signal, unless they carry it in several units.
    """
    found: dict[str, list[Any]] = {}
    for s in message.layout.signals:
        found.setdefault(f"{message.layout.name}.{s.name}", []).append(s)
    out: dict[str, list[Any]] = {}
    for key, same in found.items():
        for s in same:
            branch = f" ({s.multiplexer_signal}={', '.join(map(str, s.multiplexer_ids or ()))})"
            out.setdefault(key + branch * (len({x.unit for x in same}) > 1), []).append(s)
    return out


def open_bus_log(frames: Frames, options: Options) -> Bus:
    """Frames seen through the database that the user named, or the product's own."""
    dbc = options.dbc or tables.path("vgv.dbc")
    messages, said = load_dbc(dbc)
    notes = list(said)
    if n := int(np.isin(frames.ident, [m.ident for m in messages if m.proves]).sum()):
        notes.append(
            f"{n:,} authentication frames (SecOC) in the log: no MAC is checked; vaneloop run --bus lockstep --inputs "
            f"LOG --secoc KEY checks those of a record"
        )
    return Bus(frames, messages, notes, dbc)


# --- writing ----------------------------------------------------------------------------------------------------------


def encode_channels(channels: dict[str, Channel], dbc: Path | None, path: Path) -> Frames:
    """Frames of a database (default: the product's own) as the nodes would send them: each message at its period,
    with the value then valid.

    A value is repeated until its channel's next sample, but no longer than `_HOLD` frame periods or steps of the
    channel: after that the signal says "not available", and a message without any value is not sent. i_cmd is the mean
    since the last frame.
    """
    dbc = dbc or tables.path("vgv.dbc")
    messages, _ = load_dbc(dbc)
    start = min(float(c.t[0]) for c in channels.values())
    parts = []
    left = set(channels)
    for m in messages:
        names = [s.name for s in m.layout.signals if s.name in channels]
        if not names:
            continue
        left -= set(names)
        period = (m.layout.cycle_time or 10) / 1000
        first = min(float(channels[n].t[0]) for n in names)
        last = max(float(channels[n].t[-1]) for n in names)
        if (last - first) / period > _MOST_FRAMES:
            raise LogError(f"{path}: {last - first:.3g} s are too long for a CAN log with a frame every {period:g} s")
        k = np.arange(math.ceil((first - start) / period - 1e-6), math.floor((last - start) / period + 1e-6) + 1)
        t = start + k * period
        values = {n: _sample(channels[n], t, period, n == "i_cmd") for n in names}
        sent = ~np.logical_and.reduce([np.isnan(v) for v in values.values()])
        t, values = t[sent], {n: v[sent] for n, v in values.items()}
        if "mode_request" in m.missing:
            values["mode_request"] = np.ones(t.size)
        try:
            data = encode(m, values, t.size)
        except LogError as e:
            raise LogError(f"{path}: {e}") from None
        parts.append((t - start, np.full(t.size, m.ident, np.uint32), data))
    if left:
        raise LogError(f"{path}: {dbc.name} has no signal for {', '.join(sorted(left))}")
    t = np.concatenate([p[0] for p in parts])
    ident = np.concatenate([p[1] for p in parts])
    width = max(8, *(p[2].shape[1] for p in parts))
    data = np.zeros((t.size, width), np.uint8)
    length = np.concatenate([np.full(len(p[2]), p[2].shape[1], np.uint8) for p in parts])
    at = 0
    for p in parts:
        data[at : at + len(p[2]), : p[2].shape[1]] = p[2]
        at += len(p[2])
    order = np.lexsort((ident & 0x1FFFFFFF, np.rint(t * 1e6)))  # the lower identifier wins arbitration
    t = np.maximum.accumulate(t[order])  # periods differ in the last digit
    return Frames(t, ident[order], np.zeros(t.size, np.int32), length[order], data[order])


def _sample(c: Channel, t: np.ndarray, period: float, mean: bool) -> np.ndarray:
    """The channel's value valid at each ``t``: its latest sample, or the mean since the sample before; NaN where it is
    silent.
    """
    now = np.searchsorted(c.t, t + 1e-6, side="right")
    age = t - c.t[np.maximum(now - 1, 0)]
    step = float(np.median(np.diff(c.t))) if c.t.size > 1 else 0.0
    there = (now > 0) & (age <= _HOLD * max(period, step))
    values = c.values[np.maximum(now - 1, 0)].copy()
    if mean and t.size:
        before = np.searchsorted(c.t, t - period + 1e-6, side="right")
        total = np.concatenate(([0.0], np.cumsum(c.values)))
        several = now - before > 1
        values[several] = (total[now] - total[before])[several] / (now - before)[several]
    return np.where(there, values, np.nan)
