"""A node whose frames are authenticated (`hil.bus.secoc`): what it sends is signed, what it takes must be proven.

The node inside is the one that runs without authentication, tick for tick. It gets a frame in the tick in which the
frame's MAC came; a frame that no MAC proves within `HOLD` ticks it gets marked (`hil.bus.frames.UNAUTHENTIC`), and
refuses it as it does one with a wrong CRC.

The freshness value of a tick is its start plus the tick's number. The start, and what the loop has skipped since, is
said by notes among a tick's frames (`hil.bus.frames.FRESHNESS`): they are recorded, so a recorded run is repeated bit
for bit.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from hil.bus import frames
from hil.bus.lockstep_bus import BusRun, Channel
from hil.bus.secoc import WINDOW, Authenticator, completed
from hil.bus.wire import BITS_PER_TICK, ERRORS, FRAMES, put, run_wire, take

__all__ = ["DEMANDED", "FROM_CONTROLLER", "HOLD", "Gate", "Secured", "run_secured", "started"]

# ticks in which the MAC of a frame must come: as long as a silence. A loop that catches up runs up to 49 ticks between
# a frame and a MAC that came right behind it.
HOLD = 50
MOST_WAITING = 16  # frames of an identifier that wait; five are the sender's, if none of its MACs comes
BEHIND = 100  # ms that the freshness value may lag behind the clock until a note corrects it
DEMANDED = (frames.ECU_DEMAND,)  # what the controller takes
FROM_CONTROLLER = tuple(i for i in frames.NAMES if i != frames.ECU_DEMAND)  # what the ECU takes


def started(at: int) -> np.ndarray:
    """Return the note of a first tick: its freshness value is ``at``."""
    return np.array([[frames.FRESHNESS, at]], np.int64)


class _Waiting:
    """A frame that waits for its MAC: since which tick, and whether one came that was not its own."""

    def __init__(self, data: int, since: int):
        self.data, self.since, self.answered = data, since, False


class Gate:
    """Which of the frames that came are proven.

    hears     identifiers of the frames that must be
    start     freshness value of tick 0; None before it is known
    verified  frames proven
    wrong_mac, stale, unmatched   authentication frames refused: MAC fits no frame that waits; freshness value not
              greater than the last, or not within the window; no frame waits for one
    missing   frames for which none came at all
    """

    COUNTS = ("verified", "wrong_mac", "stale", "unmatched", "missing")

    def __init__(self, authenticator: Authenticator, hears: Sequence[int]):
        self.authenticator = authenticator
        self.verified = self.wrong_mac = self.stale = self.unmatched = self.missing = 0
        self.start: int | None = None
        self._last = dict.fromkeys(hears, 0)
        self._waiting: dict[int, list[_Waiting]] = {ident: [] for ident in hears}
        self._data = {int(frames.word0(ident)): ident for ident in hears}
        self._auth = {int(frames.word0(ident + frames.AUTH)): ident for ident in hears}

    def now(self, k: int) -> int:
        """Freshness value of tick ``k``."""
        if self.start is None:
            raise ValueError("no note says the freshness value of the first tick")
        return self.start + k

    def correct(self, k: int, now: int) -> None:
        """Take the freshness value of tick ``k`` from a note; it never goes back."""
        if self.start is None:
            self.start = now - k
            self._last = dict.fromkeys(self._last, now - 1)
        self.start = max(self.start, now - k)

    def pass_on(self, k: int, rows: list[list[int]]) -> list[tuple[int, int]]:
        """Return what a node gets in place of the frames of tick ``k``: those that are proven in it, those that have
        waited in vain, marked, and what needs no proof.
        """
        out: list[tuple[int, int]] = []
        for head, data in rows:
            if head == frames.FRESHNESS:
                self.correct(k, data)
        for ident, waiting in self._waiting.items():
            while waiting and k - waiting[0].since >= HOLD:
                out.append(self._unproven(ident, waiting.pop(0)))
        for head, data in rows:
            if (held := self._data.get(head)) is not None:
                waiting = self._waiting[held]
                if len(waiting) == MOST_WAITING:
                    out.append(self._unproven(held, waiting.pop(0)))
                waiting.append(_Waiting(data, k))
            elif (of := self._auth.get(head)) is not None:
                if (found := self._judge(k, of, data)) is not None:
                    out.append((int(frames.word0(of)), found.data))
            elif head != frames.FRESHNESS:
                if head == frames.PAUSE:  # what waited is as old as the pause
                    for waiting in self._waiting.values():
                        waiting.clear()
                out.append((head, data))
        return out

    def _unproven(self, ident: int, frame: _Waiting) -> tuple[int, int]:
        self.missing += not frame.answered
        return int(frames.word0(ident)) | frames.UNAUTHENTIC, frame.data

    def _judge(self, k: int, ident: int, data: int) -> _Waiting | None:
        """Return the waiting frame that an authentication frame proves; it waits no longer."""
        waiting, now = self._waiting[ident], self.now(k)
        low, mac = frames.decode_auth(data)
        freshness = completed(int(low), now)
        if not waiting:
            self.unmatched += 1
            return None
        for frame in waiting:
            frame.answered = True
        if not self._last[ident] < freshness or abs(freshness - now) > WINDOW:
            self.stale += 1
            return None
        for i, frame in enumerate(waiting):
            if self.authenticator.proves(ident, frame.data, freshness, int(mac)):
                self._last[ident] = freshness
                self.verified += 1
                return waiting.pop(i)
        self.wrong_mac += 1
        return None


class Secured:
    """A node with authentication; for whoever runs it, it is a node like any other.

    hears     identifiers of the frames that must be proven
    clock     gives ms since 1970, in real time; None where notes come with the frames
    """

    def __init__(
        self, node: Any, authenticator: Authenticator, hears: Sequence[int], clock: Callable[[], int] | None = None
    ):
        self.node, self.clock, self.gate = node, clock, Gate(authenticator, hears)
        self._own = {int(frames.word0(ident)): ident for ident in frames.NAMES if ident not in hears}

    def __getattr__(self, name: str) -> Any:
        return getattr(self.node, name)

    @property
    def authentication(self) -> dict[str, int]:
        """What the gate has counted."""
        return {name: getattr(self.gate, name) for name in Gate.COUNTS}

    def heed(self, rows: np.ndarray, n: int) -> int:
        """Put notes behind the ``n`` frames of the next tick: the node's own, and the freshness value where it is not
        known yet or lags behind. Return how many rows there are.
        """
        heed = getattr(self.node, "heed", None)
        n = n if heed is None else heed(rows, n)
        if self.clock is not None and n < len(rows):
            now = self.clock()
            if self.gate.start is None or now - self.gate.now(self.node.k) > BEHIND:
                rows[n] = frames.FRESHNESS, now
                n += 1
        return n

    def tick(self, received: np.ndarray, n: int | None = None) -> np.ndarray:
        """Run the next tick on the first ``n`` rows of ``received``; return the frames to send."""
        k = self.node.k
        taken = self.gate.pass_on(k, received[:n].tolist())
        sent = self.node.tick(np.array(taken, np.int64).reshape(-1, 2), len(taken))
        if not len(sent):
            return sent
        out: list[tuple[int, int]] = []
        for head, data in sent.tolist():
            out.append((head, data))
            if (ident := self._own.get(head)) is not None:
                out.append(self.gate.authenticator.frame(ident, data, self.gate.now(k)))
        return np.array(out, np.int64)


class SecuredRun(NamedTuple):
    """What `run_secured` gives: the run as `run_lockstep` does, and frames with their ticks, as a record has them."""

    run: BusRun
    taken_at: np.ndarray
    taken: np.ndarray
    sent_at: np.ndarray
    sent: np.ndarray


def run_secured(
    profile: np.ndarray,
    vgv: Secured,
    ecu: Secured,
    *,
    start: int,
    duration: float,
    progress: Callable[[float], None] | None = None,
) -> SecuredRun:
    """Run controller, plant and ECU over the simulated wire with authentication.

    profile   float64[n, 2] n_dem, n_r (NaN = the ECU's engine model), %, one row every 10 ms
    start     freshness value of tick 0, ms since 1970
    duration  s
    progress  called with the fraction done
    """
    channel = Channel()
    wire = channel.wire
    at_vgv, at_ecu = channel.join(errors=True), channel.join(errors=True)
    rows, ticks = np.zeros((256, 2), np.int64), round(duration * 1000)
    taken: list[np.ndarray] = []
    sent: list[np.ndarray] = []
    begun = time.perf_counter()
    for k in range(ticks):
        ecu.set_demand(*profile[min(k // 10, len(profile) - 1)].tolist())
        heard = [rows[: take(wire, place, rows)].copy() for place in (at_ecu, at_vgv)]
        if k == 0:
            heard = [np.concatenate([started(start), these]) for these in heard]
        of_ecu, of_vgv = ecu.tick(heard[0]), vgv.tick(heard[1])
        for place, frames_out in ((at_ecu, of_ecu), (at_vgv, of_vgv)):
            for head, data in frames_out.tolist():
                put(wire, place, head, data)
        taken.append(heard[1])
        sent.append(of_vgv.copy())
        run_wire(wire, (k + 1) * BITS_PER_TICK, -1)
        if progress is not None and k % 1000 == 0:
            progress(k / ticks)
    at = [np.repeat(np.arange(ticks), [len(these) for these in each]) for each in (taken, sent)]
    nothing = np.zeros((0, 2), np.int64)
    run = BusRun(
        ticks * 1e-3, time.perf_counter() - begun, channel.load, int(wire.clock[FRAMES]), int(wire.clock[ERRORS]),
        np.zeros(0), nothing, "", vgv.node, ecu.node,
    )  # fmt: skip
    return SecuredRun(run, at[0], np.concatenate([nothing, *taken]), at[1], np.concatenate([nothing, *sent]))
