"""What injection does to frames: a gateway between node and bus that drops, delays or changes them, and a third station
that sends.

Both work tick by tick (1 ms) on frames as `hil.bus.frames` has them, for any bus.
"""

from __future__ import annotations

import heapq
import random
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from hil.bus import frames
from hil.bus.secoc import Authenticator
from hil.inject.actions import (
    Action,
    Babble,
    Corrupt,
    Delay,
    Drop,
    Duplicate,
    Flood,
    Freeze,
    OnFrame,
    Override,
    Reorder,
    Replay,
    Send,
    identifier,
    raw_signal,
)
from hil.logs.formats import format_at
from vaneloop.base.errors import InputError

__all__ = ["Gateway", "Intruder", "tick_of"]

# ---- frames on their way from the sender to the bus ------------------------------------------------------------------

Words = tuple[int, int]  # a frame, see `hil.bus.frames`
FULL = (1 << 64) - 1


def _signed(word: int) -> int:
    """Return the low 64 bits of ``word`` as int64 has them."""
    word &= FULL
    return word - (1 << 64) if word >> 63 else word


def tick_of(t: float) -> float:
    """Return the tick (1 ms) of a time, infinite ones too."""
    return t if t == np.inf else round(t * 1000.0)


class Gateway:
    """Every action on frames between sender and bus, one after the other as the scenario lists them."""

    def __init__(self, actions: Iterable[Action], chance: random.Random):
        self.stages = [a for a in actions if isinstance(a, OnFrame)]
        self.span = [(tick_of(a.start), tick_of(a.end)) for a in self.stages]
        self.ident = [identifier(a.frame) for a in self.stages]
        self.met = [0] * len(self.stages)  # frames that came by
        self.acted = [0] * len(self.stages)
        self.chance = chance
        self.late: list[tuple[int, int, int, Words]] = []  # delayed: tick, order, next stage, frame
        self.held: list[list[Words]] = [[] for _ in self.stages]
        self.frozen: dict[int, int] = {}
        self.order = 0

    def done(self, k: int) -> bool:
        """Whether nothing is left to do from tick ``k`` on."""
        return all(end <= k for _, end in self.span) and not self.late and not any(self.held)

    def feed(self, k: int, sent: Iterable[Words]) -> list[Words]:
        """Take the frames that the nodes send at tick ``k``; return those that reach the bus at it."""
        if not self.stages:
            return list(sent)
        out: list[Words] = []
        for i, held in enumerate(self.held):
            if held and k >= self.span[i][1]:  # it is over: what is left goes on in its old order
                self.held[i] = []
                for frame in held:
                    self._go(i + 1, k, frame, out)
        while self.late and self.late[0][0] <= k:
            _, _, stage, frame = heapq.heappop(self.late)
            self._go(stage, k, frame, out)
        for frame in sent:
            self._go(0, k, frame, out)
        return out

    def _acts(self, i: int, k: int, ident: int) -> bool:
        action = self.stages[i]
        if ident != self.ident[i] or not self.span[i][0] <= k < self.span[i][1]:
            return False
        self.met[i] += 1
        if (self.met[i] - 1) % action.every or (action.count is not None and self.acted[i] >= action.count):
            return False
        if action.probability < 1.0 and self.chance.random() >= action.probability:
            return False
        self.acted[i] += 1
        return True

    def _go(self, stage: int, k: int, frame: Words, out: list[Words]) -> None:
        head, data = int(frame[0]), int(frame[1])
        ident = head & frames.IDENT_MASK
        for i in range(stage, len(self.stages)):
            if not self._acts(i, k, ident):
                continue
            match self.stages[i]:
                case Drop():
                    return
                case Delay(delay=delay, jitter=jitter):
                    ticks = round((delay + jitter * self.chance.random()) * 1000.0)
                    if ticks:
                        self.order += 1
                        heapq.heappush(self.late, (k + ticks, self.order, i + 1, (head, data)))
                        return
                case Duplicate(copies=copies):
                    for _ in range(copies):
                        self._go(i + 1, k, (head, data), out)
                case Reorder(window=window):
                    self.held[i].append((head, data))
                    if len(self.held[i]) < window:
                        return
                    group, self.held[i] = self.held[i], []
                    for old in reversed(group):
                        self._go(i + 1, k, old, out)
                    return
                case Corrupt() as action:
                    head, data = self._corrupt(action, head, data)
                case Freeze(signal=signal, e2e=e2e):
                    _, mask = raw_signal(ident, signal, 0.0)
                    bits = self.frozen.setdefault(i, data & mask)
                    data = _protected(ident, (data & ~mask) | bits, e2e if signal != "crc" else "keep")
                case Override(signals=signals, e2e=e2e):
                    for name, value in signals.items():
                        bits, mask = raw_signal(ident, name, value)
                        data = (data & ~mask) | bits
                    data = _protected(ident, data, e2e if "crc" not in signals else "keep")
        out.append((head, _signed(data)))

    def _corrupt(self, action: Corrupt, head: int, data: int) -> Words:
        if action.length is not None:
            return head & ~(0xFF << 32) | action.length << 32, data & ((1 << 8 * action.length) - 1)
        for bit in action.at if action.at is not None else self.chance.sample(range(64), action.bits):
            data ^= 1 << bit
        return head, data


def _protected(ident: int, data: int, e2e: str) -> int:
    """Return ``data`` with a CRC that fits the counter in it, unless ``e2e`` keeps the old one; authentication frames
    have none.
    """
    return (
        data
        if e2e == "keep" or ident not in frames.NAMES
        else int(frames.protect(ident, _signed(data), (data >> 8) & 15))
    )


# ---- what a third station sends --------------------------------------------------------------------------------------

STALE = 1000  # ms by which a stale freshness value is old
AHEAD = 12  # frames that a flood without a rate keeps waiting: the bus takes at most 11 a millisecond


class Intruder:
    """The frames that one outsider's action sends, tick by tick (1 ms).

    recorded  what was on the bus: tick and both words
    keys      what makes MACs under the key in use, and under another; None where frames are not authenticated
    """

    def __init__(
        self,
        action: Action,
        chance: random.Random,
        recorded: list[tuple[int, int, int]],
        keys: tuple[Authenticator, Authenticator] | None = None,
    ):
        self.action, self.chance, self.recorded, self.keys = action, chance, recorded, keys
        self.first, self.end = tick_of(action.start), tick_of(action.end)
        self.sent = 0
        self.counter = action.counter if isinstance(action, Send) else 0
        self.old: dict[int, list[Words]] | None = None  # by ms from the first
        self.length = 0
        if isinstance(action, Replay) and action.log is not None:
            self.old, self.length = _old_frames(action)

    def tick(self, k: int, waiting: int) -> list[Words]:
        """Return what is sent at tick ``k``; ``waiting`` frames of earlier ticks are still in the queue."""
        if not self.first <= k < self.end:
            return []
        since = int(k - self.first)
        match self.action:
            case Send() as action:
                period = round(action.period * 1000.0) if action.period is not None else 0
                if since and (not period or since % period):
                    return []
                frame = self._frame(action)
                return [frame] if action.secoc == "none" else [frame, self._authentication(action, frame, k)]
            case Flood() as action:
                low = identifier(action.frame)
                return self._burst(
                    low, identifier(action.last) if action.last is not None else low, action.rate, since, waiting
                )
            case Babble():
                return self._burst(0, 0, None, since, waiting)
            case Replay() as action:
                if self.old is None:
                    begin = round((action.begin or 0.0) * 1000.0)
                    self.length = round(action.length * 1000.0)
                    wanted = None if action.frame is None else identifier(action.frame)
                    self.old = {}
                    for t, head, data in self.recorded:
                        if begin <= t < begin + self.length and wanted in (None, head & frames.IDENT_MASK):
                            self.old.setdefault(t - begin, []).append((head, data))
                return self.old.get(since % self.length if action.loop else since, [])
        return []

    def _frame(self, action: Send) -> Words:
        ident = identifier(action.frame, action.extended)
        if action.signals is not None:
            data, length = 0, 8
            for name, value in action.signals.items():
                data |= raw_signal(action.frame, name, value)[0]
        else:
            raw = bytes.fromhex(str(action.data))
            data, length = int.from_bytes(raw, "little"), len(raw)
        if action.protection != "none":
            data = int(frames.protect(ident, _signed(data), self.counter % 15))
            if action.protection == "wrong_crc":
                data ^= 0xFF
            if action.protection != "wrong_counter":
                self.counter = (self.counter + 1) % 15
        length = length if action.length is None else action.length
        head = (
            ident | length << 32 | (frames.EXTENDED if action.extended else 0) | (frames.REMOTE if action.remote else 0)
        )
        return head, 0 if action.remote else _signed(data & ((1 << 8 * length) - 1))

    def _authentication(self, action: Send, frame: Words, k: int) -> Words:
        """Return the authentication frame behind a frame of tick ``k``, whose freshness value is the tick's number."""
        assert self.keys is not None
        right, wrong = self.keys
        key = wrong if action.secoc == "wrong_key" else right
        freshness = max(k - STALE, 0) if action.secoc == "stale" else k
        head, data = key.frame(identifier(action.frame), frame[1], freshness)
        if action.secoc == "wrong_mac":
            data = int(frames.encode_auth(freshness, self.chance.getrandbits(32)))
        return head, data

    def _burst(self, low: int, high: int, rate: float | None, since: int, waiting: int) -> list[Words]:
        n = max(AHEAD - waiting, 0)
        if rate is not None:
            n = int((since + 1) * rate / 1000.0 + 1e-9) - self.sent
            self.sent += n
        return [(frames.word0(self.chance.randint(low, high)), _signed(self.chance.getrandbits(64))) for _ in range(n)]


def _old_frames(action: Replay) -> tuple[dict[int, list[Words]], int]:
    """Return the frames of a CAN log by ms from its first, and the log's length in ms."""
    path = Path(str(action.log))
    log = format_at(path, "frames", "holds no frames to replay").read_frames(path)
    wanted = None if action.frame is None else identifier(action.frame)
    ms = np.rint(log.t * 1000.0).astype(int).tolist()
    out: dict[int, list[Words]] = {}
    for t, ident, length, data in zip(ms, log.ident.tolist(), log.length.tolist(), log.data[:, :8], strict=True):
        if length <= 8 and wanted in (None, ident):
            word = int.from_bytes(data.tobytes().ljust(8, b"\0"), "little", signed=True)
            out.setdefault(t, []).append((ident | length << 32, word))
    if not out:
        raise InputError(
            f"{action.log}: holds no frame to replay{'' if action.frame is None else f' of {action.frame}'}"
        )
    return out, ms[-1] + 10
