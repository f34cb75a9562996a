"""A scenario on many machines side by side, without the bus: verdicts and margins, taken while the loops run.

What the controller hears is worked out once (`hil.inject.heard`); the loops are those of `hil.loop.heard_lanes`, on a
GPU those of `hil.loop.cuda`. A verdict is that of `hil.inject.injection.run`, a margin the same to rounding. No trace
is kept.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from controller import FAULTS, MODES, load_calibration
from hil.inject.actions import Machine
from hil.inject.heard import Heard, hear
from hil.inject.margin import Margin, margin_of, without_distance
from hil.inject.on_lockstep import TICK, changed_rows
from hil.inject.scenario import Expect, Scenario
from hil.inject.tamper import tick_of
from hil.inject.verdict import CHANGES, EDGE, ROUNDING, TRANSITIONS, Facts, Trace, always, facts_of, holds
from hil.loop import cuda as gpu
from hil.loop.engines import MOST, SHARE, change_on_gpu, machines_on_gpu, on_gpu
from hil.loop.firmware_lanes import runs_in_lanes
from hil.loop.heard_lanes import (
    COLUMNS,
    OIL,
    HeardLanes,
    Rows,
    depth,
    hear_row,
    noise_of,
    power_on,
    sample,
    stretch_of,
    stretches,
)
from hil.loop.lockstep import CHUNK
from plant import build_plant, chain
from plant.chain_lanes import W, way
from plant.parameters import derive
from plant.places import POT
from vaneloop.base.compiled import in_place_free, inlined

if TYPE_CHECKING:
    from controller import Calibration
    from plant import Plant

__all__ = ["WATCHED", "can", "margins_in_lanes", "margins_on_gpu", "warm_up_lanes"]

AT_ONCE = 200  # ticks whose samples are in memory
DEGREES = 180.0 / np.pi
BORDER = {"x_dem": 1e3, "x_lvdt": 1e3, "i_cmd": 1e3, "n_dem": 1.0, "n_r": 1.0}  # signals of a sample, factor from SI

# columns of a claim: what it is about, the sample's column, factor into the border's unit, mode or fault's bit, limits,
# kind of time, and from when to when (s)
C_ABOUT, C_COLUMN, C_FACTOR, C_NUMBER, C_LOW, C_HIGH, C_WHEN, C_BEGIN, C_END, N_CLAIM = range(10)
A_MODE, A_FAULT, A_ANY, A_SIGNAL = range(4)
W_AT, W_BY, W_DURING, W_NEVER = range(4)
P_OUTSIDE, P_INSIDE, P_BEFORE = range(3)  # parts of the time of a claim
F_BEFORE, F_NEAREST, F_FIRST, F_BEST, F_WORST, F_SEEN, F_BROKEN, F_LAST, N_FACT = range(9)
ALLOWED = np.array([[a == b or (a, b) in TRANSITIONS for b in MODES] for a in MODES])


class Changes(NamedTuple):
    """What a scenario does to the parameters of a machine: tick, and values of rows (SI); ``ways``: the machine's ways
    through a block (`plant.chain_lanes.way`), from power-on and from each change on.
    """

    at: tuple[tuple[int, dict[int, float]], ...]
    ways: tuple[tuple[int, bool] | None, ...]


def changes_of(scenario: Scenario, plant: Plant) -> Changes:
    """Changes of a machine. Raises InputError for a vane row that it lacks."""
    spans = []
    for q, action in enumerate(a for a in scenario.inject if isinstance(a, Machine)):
        if new := changed_rows(action, plant):
            spans += [(tick_of(action.start), q, new), (tick_of(action.end), q, {})]
    p, old, at, ways = plant.p.copy(), dict[int, dict[int, float]](), [], [way(plant.p)]
    for tick, q, new in sorted(spans, key=lambda span: span[:2]):
        if tick < np.inf:
            rows = new or old[q]
            old[q] = {r: float(p[r, 0]) for r in rows}
            for r, v in rows.items():
                p[r, 0] = v
            derive(p, chain.TICK / chain.SUBSTEPS, chain.TICK)
            at.append((int(tick), rows))
            ways.append(way(p))
    return Changes(tuple(at), tuple(ways))


def can(scenario: Scenario, plant: Plant, calibration: Calibration) -> bool:
    """Whether a machine with this controller runs a scenario side by side with others."""
    return runs_in_lanes(calibration) and None not in changes_of(scenario, plant).ways


def warm_up_lanes() -> None:
    """Compile what `margins_in_lanes` needs."""
    bias = Machine(effect="lvdt_bias", parameters={"bias": 0.1}, start=0.01)
    scenario, plant = Scenario(title="warm-up", duration=0.02, inject=[bias]), build_plant()
    heard = hear(scenario, plant)
    assert isinstance(heard, Heard)
    margins_in_lanes(scenario, [plant], load_calibration(), heard)


class Claim(NamedTuple):
    """A row of a claim, as compiled code has it."""

    about: int
    column: int
    factor: float
    number: int
    low: float
    high: float
    when: int
    begin: float
    end: float


@inlined
def _taken(row: np.ndarray) -> Claim:
    """The claim of a row."""
    return Claim(
        int(row[C_ABOUT]), int(row[C_COLUMN]), row[C_FACTOR], int(row[C_NUMBER]), row[C_LOW], row[C_HIGH],
        int(row[C_WHEN]), row[C_BEGIN], row[C_END],
    )  # fmt: skip


@inlined
def _part(claim: Claim, t: float) -> int:
    """In which part of a claim's time a sample at ``t`` (s) is."""
    if claim.begin - EDGE <= t <= claim.end + EDGE or claim.when == W_AT:
        return P_INSIDE
    if t < claim.begin and claim.when == W_DURING and claim.about != A_SIGNAL:
        return P_BEFORE
    return P_OUTSIDE


@inlined
def _add(claim: Claim, part: int, t: float, value: float, f: np.ndarray, j: int) -> None:
    """Add lane ``j``'s sample at ``t`` (s), ``value`` in SI, to the facts f[N_FACT, lane] of a claim."""
    v = value * claim.factor
    if claim.about == A_SIGNAL:
        true = claim.low <= v <= claim.high
    elif claim.about == A_MODE:
        true = int(v) == claim.number
    elif claim.about == A_FAULT:
        true = (int(v) >> claim.number) & 1 == 1
    else:
        true = v != 0.0
    if claim.when == W_AT:
        if true and f[F_BEFORE, j] == 0.0:
            f[F_NEAREST, j] = min(f[F_NEAREST, j], abs(t - claim.begin))
        f[F_BEFORE, j] = 1.0 if true else 0.0
        return
    broken = true == (claim.when == W_NEVER)
    if part == P_BEFORE:
        if broken:
            f[F_LAST, j] = t
        return
    f[F_SEEN, j] += 1.0
    if true:
        f[F_FIRST, j] = min(f[F_FIRST, j], t)
    if broken:
        f[F_BROKEN, j] += 1.0
    if claim.about == A_SIGNAL:
        distance = min(v - claim.low, claim.high - v)
        if not distance <= f[F_BEST, j]:  # NaN, too, and it stays
            f[F_BEST, j] = distance if f[F_BEST, j] == f[F_BEST, j] else np.nan
        if not distance >= f[F_WORST, j]:
            f[F_WORST, j] = distance if f[F_WORST, j] == f[F_WORST, j] else np.nan


@inlined
def _follow(k: int, new: int, mode: np.ndarray, wrong: np.ndarray, allowed: np.ndarray, j: int) -> None:
    """Note lane ``j``'s mode at tick ``k``, and whether the change to it is documented."""
    if k > 0 and not allowed[mode[j], new]:
        wrong[j] += 1
    mode[j] = new


@in_place_free
def _collect(
    k0: int, out: np.ndarray, n: int, claims: np.ndarray, facts: np.ndarray, mode: np.ndarray, wrong: np.ndarray,
    allowed: np.ndarray,
) -> None:  # fmt: skip
    """Add samples to the facts: out[tick, column, lane] (`HeardLanes.advance`) from tick ``k0`` on.

    facts  float64[claim, N_FACT, lane]
    mode, wrong   int64[lane]: of the sample before; changes of mode that are not documented
    """
    ticks, modes = out.shape[0], out.shape[1] - 2
    for c in range(claims.shape[0]):
        claim, f = _taken(claims[c]), facts[c]
        for i in range(ticks):
            t = (k0 + i) * TICK
            part = _part(claim, t)
            if part != P_OUTSIDE:
                for j in range(n):
                    _add(claim, part, t, out[i, claim.column, j], f, j)
    for i in range(ticks):
        for j in range(n):
            _follow(k0 + i, int(out[i, modes, j]), mode, wrong, allowed, j)


class Noted(NamedTuple):
    """What a GPU notes of a scenario's machines (`hil.loop.cuda.Watched`): arguments of `_collect`; ``modes``: the
    column of the mode.
    """

    modes: int
    claims: Any
    facts: Any
    mode: Any
    wrong: Any
    allowed: Any


def _note_tick(notes: Noted, k: int, j: int, state: Any, inputs: Any) -> None:
    t = k * TICK
    for c in range(notes.claims.shape[0]):
        claim = _taken(notes.claims[c])
        part = _part(claim, t)
        if part != P_OUTSIDE and not COLUMNS <= claim.column < notes.modes:
            value = sample(state, claim.column)
            if claim.column >= notes.modes:
                value = state.mode if claim.column == notes.modes else state.faults
            _add(claim, part, t, value, notes.facts[c], j)
    _follow(k, int(state.mode), notes.mode, notes.wrong, notes.allowed, j)


def _note_vanes(notes: Noted, k: int, j: int, s: Any, sigma: Any, noise: Any, m: int, n_r: float) -> None:
    t = k * TICK
    for c in range(notes.claims.shape[0]):
        claim = _taken(notes.claims[c])
        part = _part(claim, t)
        if part != P_OUTSIDE and COLUMNS <= claim.column < notes.modes:
            _add(claim, part, t, s[POT + claim.column - COLUMNS, j], notes.facts[c], j)


WATCHED = gpu.Watched(stretch_of, hear_row, _note_tick, after=_note_vanes)


def _claim(claim: Expect, vanes: tuple[str, ...]) -> list[float]:
    """A claim about the controller as numbers."""
    row = [0.0] * N_CLAIM
    row[C_LOW] = -np.inf if claim.low is None else claim.low
    row[C_HIGH] = np.inf if claim.high is None else claim.high
    row[C_FACTOR] = 1.0
    if claim.mode is not None:
        row[C_ABOUT], row[C_COLUMN], row[C_NUMBER] = A_MODE, len(BORDER) + len(vanes), MODES.index(claim.mode)
    elif claim.fault is not None:
        row[C_ABOUT] = A_ANY if claim.fault == "any" else A_FAULT
        row[C_COLUMN] = len(BORDER) + len(vanes) + 1
        row[C_NUMBER] = 0 if claim.fault == "any" else FAULTS.index(claim.fault)
    else:
        signals = [*BORDER, *vanes]
        row[C_ABOUT], row[C_COLUMN] = A_SIGNAL, signals.index(str(claim.signal))
        row[C_FACTOR] = BORDER.get(str(claim.signal), DEGREES)
    row[C_BEGIN], row[C_END] = claim.during or (0.0, np.inf)
    row[C_WHEN] = W_NEVER if claim.never else W_DURING
    if claim.at is not None:
        row[C_WHEN], row[C_BEGIN] = W_AT, claim.at
    elif claim.by is not None:
        row[C_WHEN], row[C_BEGIN] = W_BY, claim.after
    return row


def margins_in_lanes(
    scenario: Scenario,
    plants: Sequence[Plant],
    calibration: Calibration,
    heard: Heard,
    watch: Callable[[list[int], int, np.ndarray], None] | None = None,
) -> list[list[Margin]]:
    """Run a scenario on machines that `can`; return the margins of each, as `hil.inject.margin.margins` gives them.

    heard  of the scenario, for machines with these vane rows, all the same ones
    watch  called with the numbers of a block's machines, a tick, and the samples from it on (`HeardLanes.advance`)
    """
    blocks: dict[object, list[int]] = {}  # machines that go the same ways
    changes = [changes_of(scenario, plant) for plant in plants]
    for i, c in enumerate(changes):
        blocks.setdefault(c.ways, []).append(i)
    out: dict[int, list[Margin]] = {}
    for some in (of[a : a + W] for of in blocks.values() for a in range(0, len(of), W)):

        def told(k: int, samples: np.ndarray, some: list[int] = some) -> None:
            if watch is not None:
                watch(some, k, samples)

        found = _block(scenario, [plants[i] for i in some], calibration, heard, [changes[i] for i in some], told)
        out.update(zip(some, found, strict=True))
    return [out[i] for i in range(len(plants))]


def _block(
    scenario: Scenario,
    plants: Sequence[Plant],
    cal: Calibration,
    heard: Heard,
    changes: Sequence[Changes],
    watch: Callable[[int, np.ndarray], None],
) -> list[list[Margin]]:
    """Run one block of machines."""
    ticks = len(heard.rows)
    loops = [power_on(plant, cal, float(scenario.demand[0][1])) for plant in plants]
    lanes = HeardLanes(
        loops, plants, [cal] * len(plants), heard.rows, noise_of(scenario.seed, ticks, len(plants[0].vanes))
    )
    seen = _Seen(scenario, plants, cal, heard)
    room = lanes.room(AT_ONCE)
    for k0, end, rows in _spans(changes, ticks):
        if rows is not None:
            lanes.change(rows)
        for k in range(k0, end, AT_ONCE):
            n = min(AT_ONCE, end - k)
            lanes.advance(n, room[:n])
            watch(k, room[:n])
            _collect(k, room[:n], len(plants), seen.claims, seen.facts, seen.mode, seen.wrong, ALLOWED)
    return seen.margins()


def _spans(changes: Sequence[Changes], ticks: int) -> Iterator[tuple[int, int, Sequence[Mapping[int, float]] | None]]:
    """Spans of ticks between changes: first tick, tick after the last one, and what changes in each machine before it.

    Of several changes before one tick, all but the last begin a span without ticks.
    """
    at = [tick for tick, _ in changes[0].at]
    yield 0, min([*at, ticks]), None
    for q, first in enumerate(at):
        if first < ticks:
            yield first, min([*at[q + 1 :], ticks]), [of.at[q][1] for of in changes]


def margins_on_gpu(
    kernel: gpu.Kernel, scenario: Scenario, plants: Sequence[Plant], calibration: Calibration, heard: Heard
) -> Iterator[tuple[range, list[list[Margin]]]]:
    """Run a scenario on machines that `can`, on a GPU (`WATCHED`), as many at once as its memory holds; give the
    margins of each, as `margins_in_lanes` has them, with their numbers, whenever some are done.

    Raises one of `hil.loop.cuda.unusable` where the GPU fails.
    """
    if not plants:
        return
    sensors, claims = 2 + len(plants[0].vanes), len(scenario.expect) + len(BORDER)  # of these at most
    numbers = gpu.ROWS + sensors + depth(heard.rows) + claims * N_FACT + 4  # calibration, speed heard, mode, changes
    most = kernel.room(8 * numbers, SHARE, MOST)
    for a in range(0, len(plants), most):
        some = plants[a : a + most]
        yield range(a, a + len(some)), _on_gpu(kernel, scenario, some, calibration, heard)


def _on_gpu(
    kernel: gpu.Kernel, scenario: Scenario, plants: Sequence[Plant], cal: Calibration, heard: Heard
) -> list[list[Margin]]:
    """Run as many machines as the GPU has at once."""
    put, many, ticks, stages = partial(on_gpu, kernel), len(plants), len(heard.rows), len(plants[0].vanes)
    changes, seen = [changes_of(scenario, plant) for plant in plants], _Seen(scenario, plants, cal, heard)
    sensors, speed = noise_of(scenario.seed, ticks, stages)
    n_r, cals = np.full(many, float(scenario.demand[0][1])), [cal] * many
    machines = machines_on_gpu(kernel, plants, cals, n_r, n_r, np.full(many, OIL), True)
    sent = np.zeros((depth(heard.rows), many))
    hears = Rows(*map(put, (heard.rows, stretches(heard.rows), speed, sent, n_r)))
    notes = Noted(COLUMNS + stages, *map(put, (seen.claims, seen.facts, seen.mode, seen.wrong, ALLOWED)))
    for k0, end, rows in _spans(changes, ticks):
        if rows is not None:
            machines = change_on_gpu(kernel, machines, plants, cals, rows)
        for k in range(k0, end, CHUNK):
            n = min(CHUNK, end - k)
            kernel(k, n, put(sensors[k : k + n]), machines, hears, notes)
    seen.facts, seen.wrong = notes.facts.copy_to_host(), notes.wrong.copy_to_host()
    return seen.margins()


class _Seen:
    """What is noted of machines side by side while they run, and the margins that follow.

    claims  float64[claim, N_CLAIM]: the scenario's about the controller, then the safe limits that are always demanded
    facts, mode, wrong   as of `_collect`
    """

    def __init__(self, scenario: Scenario, plants: Sequence[Plant], cal: Calibration, heard: Heard):
        ticks, k_of = len(heard.rows), cal.scalars
        self._claims, many = scenario.expect, len(plants)
        stroke, current = (float(k_of.stroke_min) * 1e3, float(k_of.stroke_max) * 1e3), float(k_of.current_limit) * 1e3
        self._limits = always(stroke, current)
        demanded = [
            Expect(
                signal=name, low=least - ROUNDING, high=most + ROUNDING, never=False, during=[0.0, scenario.duration]
            )
            for name, least, most, _, _ in self._limits
        ]
        trace = Trace(np.arange(ticks) * TICK, np.empty(0), np.empty(0), {}, heard.counts, heard.late)
        self._common = {  # claims about frames: the same for all machines
            i: facts_of(claim, trace)
            for i, claim in enumerate(scenario.expect)
            if claim.count is not None or claim.late is not None
        }
        self._own = [i for i in range(len(scenario.expect)) if i not in self._common]
        vanes = plants[0].vanes
        self.claims = np.array([_claim(c, vanes) for c in (*(scenario.expect[i] for i in self._own), *demanded)])
        self.facts = np.zeros((len(self.claims), N_FACT, many))
        self.facts[:, [F_NEAREST, F_FIRST, F_WORST]], self.facts[:, [F_BEST, F_LAST]] = np.inf, -np.inf
        self.mode, self.wrong = np.zeros((2, many), np.int64)

    def margins(self) -> list[list[Margin]]:
        """The margins of each machine."""
        return [self._of(j) for j in range(self.facts.shape[2])]

    def _of(self, j: int) -> list[Margin]:
        margins = []
        mine = {i: _facts(self._claims[i], self.facts[q, :, j]) for q, i in enumerate(self._own)}
        for i, claim in enumerate(self._claims):
            of = mine[i] if i in mine else self._common[i]
            if of is not None:
                margins.append(margin_of(claim, of, holds(claim, of)))
        for (*_, words), row in zip(self._limits, self.facts[len(self._own) :, :, j], strict=True):
            margins.append(without_distance(words, bool(row[F_BROKEN] == 0.0)))
        margins.append(without_distance(CHANGES, bool(self.wrong[j] == 0)))
        return margins


def _facts(claim: Expect, row: np.ndarray) -> Facts:
    """Facts of a claim as collected."""
    signal = claim.signal is not None and claim.at is None and row[F_SEEN] > 0.0
    return Facts(
        float(row[F_NEAREST]), float(row[F_FIRST]), float(row[F_BEST]) if signal else np.nan,
        float(row[F_WORST]) if signal else np.nan, int(row[F_SEEN]), int(row[F_BROKEN]), float(row[F_LAST]),
    )  # fmt: skip
