"""Safety campaign: random and mutated frames against controller and plant, by the million, in simulated time.

An episode starts with a controller that has just been switched on, or that runs on good frames; then comes the attack,
then good frames for `RECOVERY` ticks. Frames come one in 10 ms, one a tick, several a tick, or in bursts with silence
between. Kinds of frames, mixed anew for each episode::

    noise      any identifier, kind, length and bytes            wrong kind    a good frame as extended, remote, CAN FD
               or error frame
    payload    ECU_DEMAND with random bytes                      replay        a frame of before, once more
    insane     right CRC and counter, values from anywhere       foreign       the controller's own frames, from
               somebody else
    mutated    a good frame with 1 to 8 bits turned              good          demands anywhere in 0..120 %, RUN or
               standby
    length     a good frame cut or with another length           counter       a right CRC and any counter

What must hold, in every tick: current and stroke demand within their limits, state finite, mode transitions only those
of docs/controller.md, frames sent that carry a right CRC; and RUN without faults before the good frames end. What does
not hold is shrunk to the fewest frames that still show it, and written as a candump log that `vaneloop fuzz --replay`
runs again.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from controller.records import DEGRADED, FAIL_SAFE, INIT, RUN, STANDBY, as_outputs
from hil.bus.frames import (
    ECU_DEMAND,
    ERROR,
    EXTENDED,
    FD,
    IDENT_MASK,
    NAMES,
    REMOTE,
    crc,
    from_message,
    to_message,
    word0,
)
from hil.logs.signals import e2e_crc
from hil.loop.node import MOST_SENT, Node, NodeArrays, node_tick
from hil.native.program import restore, save
from vaneloop.base.compiled import in_place
from vaneloop.base.errors import InputError
from vaneloop.base.files import whole

if TYPE_CHECKING:
    from controller import Calibration
    from plant import Plant

__all__ = ["Campaign", "Failure", "fuzz", "read_attack", "run_attack", "watched_ticks", "write_attack", "write_frames"]

WARM = 600  # ticks of good frames before an attack on a running controller
# ticks of good frames after it; docs/controller.md promises RUN within 2 s, silence and a full bucket cost up to 0.2 s
RECOVERY = 2_500
NOISE_ROWS = 1_000
TRANSITIONS = np.zeros((5, 5), np.bool_)
for _a, _b in (
    (INIT, STANDBY), (INIT, FAIL_SAFE), (STANDBY, RUN), (STANDBY, FAIL_SAFE), (RUN, FAIL_SAFE), (DEGRADED, FAIL_SAFE),
    (RUN, DEGRADED),
    (RUN, STANDBY), (DEGRADED, RUN), (FAIL_SAFE, RUN), (FAIL_SAFE, STANDBY),
):  # fmt: skip
    TRANSITIONS[_a, _b] = True
TRANSITIONS.setflags(write=False)

HELD, CURRENT, STROKE, NOT_FINITE, TRANSITION, SENT_CRC, NO_RECOVERY = range(7)
CLAIMS = (
    "held",
    "the current left its limits",
    "the stroke demand left its limits",
    "the state is not finite",
    "a mode transition that is not in the table",
    "a frame was sent with a wrong CRC",
    "RUN did not come back on good frames",
)
KINDS = ("noise", "payload", "insane", "mutated", "length", "wrong kind", "replay", "foreign", "good", "counter")


@in_place
def watched_ticks(
    k0: int,
    k_end: int,
    attack_end: int,
    at: np.ndarray,
    received: np.ndarray,
    noise: np.ndarray,
    a: NodeArrays,
    sent: np.ndarray,
    limits: np.ndarray,
    seen: np.ndarray,
    ticks_in: np.ndarray,
) -> tuple[int, int, int]:
    """Run ticks ``k0``..``k_end`` on the frames and watch; return what failed, the tick, and how long RUN took after
    ``attack_end``.

    limits    float64[3]: current (A), stroke (m) from, to
    seen      int64[5, 5] counts mode transitions; ticks_in int64[5] ticks in each mode
    """
    first, since = 0, attack_end
    out = as_outputs(a.loop.outputs)
    for k in range(k0, k_end):
        last = first
        while last < len(at) and at[last] <= k:
            last += 1
        before = int(out.mode)
        m = node_tick(k, received[first:last], last - first, noise, k % NOISE_ROWS, a, sent)
        first = last
        mode = int(out.mode)
        ticks_in[mode] += 1
        if not abs(out.i_cmd) <= limits[0]:
            return CURRENT, k, 0
        if not limits[1] <= out.x_dem <= limits[2]:
            return STROKE, k, 0
        total = 0.0
        for q in range(a.loop.z.shape[0]):
            total += a.loop.z[q]
        for q in range(a.loop.s.shape[0]):
            total += a.loop.s[q, 0]
        if not abs(total) < 1e12:
            return NOT_FINITE, k, 0
        if mode != before:
            seen[before, mode] += 1
            if not TRANSITIONS[before, mode]:
                return TRANSITION, k, 0
        for q in range(m):
            if crc(sent[q, 0] & IDENT_MASK, sent[q, 1]) != sent[q, 1] & 0xFF:
                return SENT_CRC, k, 0
        if mode != RUN or out.faults != 0.0:
            since = k + 1
    if since >= k_end:
        return NO_RECOVERY, k_end - 1, 0
    return HELD, k_end, max(since - attack_end, 0)


@dataclass(frozen=True)
class Attack:
    """Frames of one episode: ``at`` int64[n] ticks, ``rows`` int64[n, 2]; it ends, and good frames follow, at tick
    ``end``.

    counter  of the first good frame after it
    warm     the controller runs on good frames for `WARM` ticks before
    """

    at: np.ndarray
    rows: np.ndarray
    end: int
    counter: int
    warm: bool


@dataclass(frozen=True)
class Failure:
    """What did not hold, when (tick of the episode), in which episode, and the fewest frames that show it."""

    claim: str
    tick: int
    episode: int
    attack: Attack


@dataclass
class Campaign:
    """Outcome of a campaign.

    frames, ticks, episodes  of the attacks; ticks with recovery and warm-up
    transitions   int64[5, 5] from mode to mode
    ticks_in      int64[5] ticks in each mode
    kinds         frames of each kind (`KINDS`)
    verdicts      what the receiver made of the frames
    longest_recovery_s  longest time from the first good frame on to RUN for good
    """

    seed: int
    frames: int = 0
    ticks: int = 0
    episodes: int = 0
    transitions: np.ndarray = field(default_factory=lambda: np.zeros((5, 5), np.int64))
    ticks_in: np.ndarray = field(default_factory=lambda: np.zeros(5, np.int64))
    kinds: np.ndarray = field(default_factory=lambda: np.zeros(len(KINDS), np.int64))
    verdicts: dict[str, int] = field(default_factory=dict)
    longest_recovery_s: float = 0.0
    elapsed_s: float = 0.0
    failure: Failure | None = None


# ---- attacks ---------------------------------------------------------------------------------------------------------


def good_frames(counter: int, n: int, n_dem: Any = 60.0, request: Any = 1) -> np.ndarray:
    """Return ``n`` frames of ECU_DEMAND, the first with ``counter``; ``n_dem`` (%) is the measured speed as well."""
    raw = np.broadcast_to(np.rint(np.asarray(n_dem) / 0.002).astype(np.int64), n)
    return _demand_frames((counter + np.arange(n)) % 15, raw, raw, np.broadcast_to(request, n))


def _demand_frames(counter: np.ndarray, n_dem: np.ndarray, n_r: np.ndarray, request: np.ndarray) -> np.ndarray:
    """Frames of ECU_DEMAND with a right CRC from raw values."""
    data = np.zeros((len(counter), 8), np.uint8)
    data[:, 1] = counter | (request & 3) << 4
    for at, raw in ((2, n_dem), (4, n_r)):
        data[:, at], data[:, at + 1] = raw & 0xFF, raw >> 8
    return _rows(ECU_DEMAND, data)


def _rows(ident: int, data: np.ndarray) -> np.ndarray:
    """Frames of bytes (uint8[n, 8]) with their CRC set."""
    data[:, 0] = e2e_crc(data, 0x5600 + ident)
    rows = np.empty((len(data), 2), np.int64)
    rows[:, 0] = word0(ident)
    rows[:, 1] = np.ascontiguousarray(data).view("<i8")[:, 0]
    return rows


_KEPT = np.array([*((1 << 8 * n) - 1 for n in range(8)), -1])  # of a frame's data, by its length


def _cut(rows: np.ndarray, length: np.ndarray) -> np.ndarray:
    """Give frames another length; bytes behind it are 0."""
    rows[:, 0] = rows[:, 0] & ~np.int64(0xFF << 32) | length << 32
    rows[:, 1] &= _KEPT[np.minimum(length, 8)]
    return rows


_INSANE = np.array([0, 1, 30000, 50000, 60000, 60001, 62500, 62501, 65534, 65535], np.int64)


def make_attack(rng: np.random.Generator, most: int = 10_000) -> tuple[Attack, np.ndarray]:
    """Return one attack of at most ``most`` frames and the kind of each (index into `KINDS`)."""
    n = min(int(10.0 ** rng.uniform(1.0, 4.0)), most)
    weights = rng.dirichlet(np.full(len(KINDS), 0.5))
    if rng.random() < 0.15:  # an ECU that is nearly well
        weights = 0.02 * weights + 0.98 * np.eye(len(KINDS))[8]
    kind = rng.choice(len(KINDS), n, p=weights)
    in_order = np.isin(kind, (2, 8))
    counter = (int(rng.integers(15)) + np.cumsum(in_order)) % 15
    value = rng.integers(0, 60001, (n, 2))
    if rng.random() < 0.5:  # slow demands, and measured speeds that follow
        value = np.clip(30000 + np.cumsum(rng.integers(-300, 301, n)), 0, 60000)[:, None] + rng.integers(-5, 6, (n, 2))
        value = np.clip(value, 0, 60000)
    request = (rng.random(n) < rng.choice([0.95, 0.5, 0.02], p=[0.8, 0.1, 0.1])).astype(np.int64)
    insane = kind == 2
    value[insane] = np.where(
        rng.random((n, 2)) < 0.5, _INSANE[rng.integers(0, len(_INSANE), (n, 2))], rng.integers(0, 65536, (n, 2))
    )[insane]
    request[insane] = rng.integers(0, 4, n)[insane]
    counter = np.where(kind == 9, rng.integers(0, 16, n), counter)
    rows = _demand_frames(counter, value[:, 0], value[:, 1], request)

    anything = rng.integers(-(2**63), 2**63 - 1, n, endpoint=True)
    random = (kind == 0) | (kind == 1)
    rows[random, 1] = anything[random]
    ident = np.where(rng.random(n) < 0.5, rng.integers(0, 0x800, n), rng.integers(0, 1 << 29, n) | EXTENDED)
    near = rng.random(n) < 0.5
    ident[near] = rng.choice(list(NAMES), n)[near]
    rows[kind == 0, 0] = (ident | 8 << 32)[kind == 0]
    for _ in range(8):  # each turn but the first changes one more bit in half of the frames that are left
        turned = np.flatnonzero(kind == 3)
        turned = turned[rng.random(len(turned)) < 0.5] if _ else turned
        rows[turned, 1] ^= np.int64(1) << rng.integers(0, 64, len(turned))
    foreign = kind == 7
    for ident_ in list(NAMES)[1:]:
        some = foreign & (rng.random(n) < 0.4)
        data = rng.integers(0, 256, (int(some.sum()), 8)).astype(np.uint8)
        data[:, 1] = data[:, 1] & 0xF0 | counter[some]
        rows[some] = _rows(ident_, data)
    other = (kind == 4) | ((kind == 0) & (rng.random(n) < 0.3))
    rows[other] = _cut(rows[other], rng.integers(0, 9, n)[other])
    wrong = np.flatnonzero((kind == 5) | ((kind == 0) & (rng.random(n) < 0.3)))
    flag = np.array([EXTENDED, REMOTE, FD, ERROR, EXTENDED | REMOTE], np.int64)[rng.integers(0, 5, len(wrong))]
    rows[wrong, 0] = np.where(flag & ERROR, ERROR | 8 << 32 | 0x88, rows[wrong, 0] | flag)
    long = wrong[(flag == FD) & (rng.random(len(wrong)) < 0.5)]
    rows[long, 0] = rows[long, 0] & ~np.int64(0xFF << 32) | rng.choice([12, 16, 20, 24, 32, 48, 64], len(long)) << 32
    rows[rows[:, 0] & REMOTE != 0, 1] = 0
    again = np.flatnonzero((kind == 6) & (np.arange(n) > 0))
    back = np.minimum(rng.geometric(rng.choice([0.9, 0.1, 0.01]), len(again)), again)
    rows[again] = rows[again - back]

    warm = rng.random() < 0.8
    pattern = rng.integers(6)
    if pattern == 0:
        gaps = np.full(n, 10)
    elif pattern == 1:
        gaps = np.ones(n, np.int64)
    elif pattern == 2:
        gaps = (rng.random(n) < 1.0 / rng.integers(2, 20)).astype(np.int64)
    elif pattern == 3:  # bursts
        gaps = np.where(np.arange(n) % rng.integers(2, 200) == 0, rng.integers(1, 1500, n), 0)
    elif pattern == 4:  # an ECU that goes away and comes back
        gaps = np.where(rng.random(n) < 0.005, rng.integers(20, 1500, n), 10)
    else:
        gaps = rng.integers(0, 25, n)
    start = WARM if warm else 0
    at = start + np.cumsum(gaps) - gaps[0]
    end = int(at[-1]) + 1 + int(rng.choice([0, 0, 5, 30, 100, 700]))
    return Attack(at, rows, end, int(rng.integers(15)), warm), kind


# ---- running ---------------------------------------------------------------------------------------------------------


class Bench:
    """A node that episodes start from, watched."""

    def __init__(
        self,
        limits: np.ndarray | None = None,
        recovery: int = RECOVERY,
        plant: Plant | None = None,
        calibration: Calibration | None = None,
    ):
        self._made = plant, calibration
        self.node = self._node()
        self.recovery = recovery
        k = self.node.loop.built.scalars
        self.limits = np.array([k.current_limit, k.stroke_min, k.stroke_max]) if limits is None else limits
        self.noise = np.random.Generator(np.random.PCG64(0)).standard_normal((NOISE_ROWS, len(self.node.loop.sigma)))
        self.transitions, self.ticks_in = np.zeros((5, 5), np.int64), np.zeros(5, np.int64)
        self._sent = np.zeros((MOST_SENT, 2), np.int64)
        self._cold, self._cold_program = self._saved(), save(self.node.loop.foreign)
        self._watch(0, WARM, WARM, np.arange(0, WARM, 10), good_frames(0, WARM // 10))
        self._warm, self._warm_program = self._saved(), save(self.node.loop.foreign)

    def _node(self) -> Node:
        plant, calibration = self._made
        if calibration is not None:
            calibration.of_one_channel("the fuzzer")
        return Node(plant, calibration, n_r=60.0, seed=0)

    def _to_start(self, warm: bool) -> None:
        """Put everything back to switch-on, or to a controller that has run on good frames for `WARM` ticks."""
        program = self._warm_program if warm else self._cold_program
        foreign = self.node.loop.foreign
        if foreign and program is None:  # it cannot be put back: a new copy of it
            self.node = self._node()
            if warm:
                self._watch(0, WARM, WARM, np.arange(0, WARM, 10), good_frames(0, WARM // 10))
            return
        for there, then in zip(self._arrays(), self._warm if warm else self._cold, strict=True):
            there[:] = then
        if foreign:
            restore(foreign, program)

    def _arrays(self) -> list[np.ndarray]:
        a = self.node.arrays
        loop = a.loop
        return [loop.inputs, loop.outputs, loop.z, loop.s, loop.mean, loop.sent, a.supply, a.receiver, a.counter]

    def _saved(self) -> list[np.ndarray]:
        return [x.copy() for x in self._arrays()]

    def _watch(self, k0: int, k_end: int, attack_end: int, at: np.ndarray, rows: np.ndarray) -> tuple[int, int, int]:
        a = self.node.arrays
        return watched_ticks(
            k0, k_end, attack_end, at, rows, self.noise, a, self._sent, self.limits, self.transitions, self.ticks_in
        )

    def run(self, attack: Attack) -> tuple[int, int, int]:
        """Run one episode; return what failed (`CLAIMS`), the tick, and the ticks that recovery took."""
        self._to_start(attack.warm)
        end = attack.end + self.recovery
        at = np.concatenate([attack.at, np.arange(attack.end, end, 10)])
        rows = np.concatenate([attack.rows, good_frames(attack.counter, len(at) - len(attack.at))])
        return self._watch(WARM if attack.warm else 0, end, attack.end, at, rows)

    def shrink(self, attack: Attack, failed: int, most: int = 3000) -> Attack:
        """Return the fewest frames found that still fail in the same way: halves, quarters, ... are left out as long as
        that goes.
        """
        keep = np.arange(len(attack.at))
        runs = 0

        def fails(some: np.ndarray, end: int) -> bool:
            nonlocal runs
            runs += 1
            return self.run(Attack(attack.at[some], attack.rows[some], end, attack.counter, attack.warm))[0] == failed

        end = attack.end
        size = len(keep)
        while size >= 1 and runs < most and len(keep):
            at = 0
            while at < len(keep) and runs < most:
                fewer = np.delete(keep, np.arange(at, min(at + size, len(keep))))
                if fails(fewer, end):
                    keep = fewer
                else:
                    at += size
            size = min(size // 2, max(len(keep), 1)) if size > 1 else 0
        sooner = int(attack.at[keep[-1]]) + 1 if len(keep) else (WARM if attack.warm else 0)
        if sooner < end and fails(keep, sooner):
            end = sooner
        return Attack(attack.at[keep], attack.rows[keep], end, attack.counter, attack.warm)


def fuzz(
    frames: int,
    seed: int = 0,
    *,
    limits: np.ndarray | None = None,
    recovery: int = RECOVERY,
    progress: Callable[[float], None] | None = None,
    plant: Plant | None = None,
    calibration: Calibration | None = None,
) -> Campaign:
    """Run a campaign of ``frames`` frames; it ends at the first failure.

    limits    float64[3] current (A), stroke demand (m) from, to; default the calibration's
    recovery  ticks of good frames within which RUN must be back
    plant, calibration  the machine; default: the shipped tables
    """
    bench = Bench(limits, recovery, plant, calibration)
    out = Campaign(seed)
    started = time.perf_counter()
    while out.frames < frames and out.failure is None:
        attack, kinds = make_attack(np.random.default_rng([seed, out.episodes]), frames - out.frames)
        failed, tick, took = bench.run(attack)
        out.frames += len(attack.at)
        out.ticks += attack.end + recovery - (WARM if attack.warm else 0)
        out.kinds += np.bincount(kinds, minlength=len(KINDS))
        for name, count in bench.node.counts.items():
            out.verdicts[name] = out.verdicts.get(name, 0) + count
        out.longest_recovery_s = max(out.longest_recovery_s, took * 1e-3)
        if failed != HELD:
            smallest = bench.shrink(attack, failed)
            out.failure = Failure(CLAIMS[failed], bench.run(smallest)[1], out.episodes, smallest)
        out.episodes += 1
        if progress is not None:
            progress(out.frames / frames)
    out.transitions, out.ticks_in = bench.transitions, bench.ticks_in
    out.elapsed_s = time.perf_counter() - started
    return out


def run_attack(
    attack: Attack,
    limits: np.ndarray | None = None,
    recovery: int = RECOVERY,
    plant: Plant | None = None,
    calibration: Calibration | None = None,
) -> tuple[str, int, float]:
    """Run one attack by itself; return what held or did not, the tick, and the seconds that recovery took."""
    failed, tick, took = Bench(limits, recovery, plant, calibration).run(attack)
    return CLAIMS[failed], tick, took * 1e-3


# ---- logs ------------------------------------------------------------------------------------------------------------


def write_attack(path: str | Path, attack: Attack) -> None:
    """Write an episode as a candump log: warm-up, attack and the good frames behind it, one ms a tick."""
    warm = good_frames(0, WARM // 10) if attack.warm else np.empty((0, 2), np.int64)
    after = good_frames(attack.counter, RECOVERY // 10)
    parts = [
        (np.arange(len(warm)) * 10, warm),
        (attack.at, attack.rows),
        (attack.end + 10 * np.arange(len(after)), after),
    ]
    write_frames(path, [pair for at, rows in parts for pair in zip(at.tolist(), rows.tolist(), strict=True)])


def write_frames(path: str | Path, frames: Iterable[tuple[int, Sequence[int]]]) -> None:
    """Write frames (tick, its two words) as a candump log, one ms a tick. Raises InputError."""
    import can

    with whole(path) as part, can.CanutilsLogWriter(part) as log:
        count: dict[int, int] = {}
        for tick, (head, data) in frames:
            order = count[tick] = count.get(tick, -1) + 1
            log.on_message_received(to_message(head, data, tick * 1e-3 + min(order, 998) * 1e-6, "vcan0"))


def read_attack(path: str | Path) -> Attack:
    """Read a log that `write_attack` wrote, or any candump log, as an attack on a controller that has just been
    switched on.
    """
    import can

    try:
        messages = list(can.CanutilsLogReader(path))
    except (OSError, ValueError) as e:
        raise InputError(f"{path}: cannot be read as a candump log ({e})") from None
    if not messages:
        raise InputError(f"{path}: no frame in it")
    start = min(m.timestamp for m in messages)
    start = start if start >= 1e6 else 0.0  # seconds since 1970, or since the start of an episode
    at = np.array([int((m.timestamp - start) * 1e3 + 1e-4) for m in messages], np.int64)
    order = np.argsort(at, kind="stable")
    rows = np.array([from_message(m) for m in messages], np.int64)
    return Attack(at[order], rows[order], int(at.max()) + 10, 0, False)


# ---- command line ----------------------------------------------------------------------------------------------------
