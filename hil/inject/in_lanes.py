"""A scenario on many machines side by side, without the bus: verdicts and margins, taken while the loops run.

What the controller hears is worked out once (`hil.inject.heard`); the loops are those of `hil.loop.heard_lanes`. A
verdict is that of `hil.inject.injection.run`, a margin the same to rounding. No trace is kept.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from controller import FAULTS, MODES, load_calibration
from hil.inject.actions import Machine
from hil.inject.heard import Heard, hear
from hil.inject.margin import Margin, margin_of, without_distance
from hil.inject.on_lockstep import TICK, changed_rows
from hil.inject.scenario import Expect, Scenario
from hil.inject.tamper import tick_of
from hil.inject.verdict import CHANGES, EDGE, ROUNDING, TRANSITIONS, Facts, Trace, always, facts_of, holds
from hil.loop.firmware_lanes import runs_in_lanes
from hil.loop.heard_lanes import HeardLanes, noise_of, power_on
from plant import build_plant, chain
from plant.chain_lanes import W, way
from plant.parameters import derive
from vaneloop.base.compiled import in_place_free

if TYPE_CHECKING:
    from controller import Calibration
    from plant import Plant

__all__ = ["can", "margins_in_lanes", "warm_up_lanes"]

AT_ONCE = 200  # ticks whose samples are in memory
DEGREES = 180.0 / np.pi
BORDER = {"x_dem": 1e3, "x_lvdt": 1e3, "i_cmd": 1e3, "n_dem": 1.0, "n_r": 1.0}  # signals of a sample, factor from SI

# columns of a claim: what it is about, the sample's column, factor into the border's unit, mode or fault's bit, limits,
# kind of time, and from when to when (s)
C_ABOUT, C_COLUMN, C_FACTOR, C_NUMBER, C_LOW, C_HIGH, C_WHEN, C_BEGIN, C_END, N_CLAIM = range(10)
A_MODE, A_FAULT, A_ANY, A_SIGNAL = range(4)
W_AT, W_BY, W_DURING, W_NEVER = range(4)
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
        claim, f = claims[c], facts[c]
        about, column, factor, number = int(claim[C_ABOUT]), int(claim[C_COLUMN]), claim[C_FACTOR], int(claim[C_NUMBER])
        low, high, when, begin, end = claim[C_LOW], claim[C_HIGH], int(claim[C_WHEN]), claim[C_BEGIN], claim[C_END]
        for i in range(ticks):
            t = (k0 + i) * TICK
            inside = begin - EDGE <= t <= end + EDGE
            before = not inside and t < begin and when == W_DURING and about != A_SIGNAL
            if not (inside or before or when == W_AT):
                continue
            for j in range(n):
                v = out[i, column, j] * factor
                if about == A_SIGNAL:
                    true = low <= v <= high
                elif about == A_MODE:
                    true = int(v) == number
                elif about == A_FAULT:
                    true = (int(v) >> number) & 1 == 1
                else:
                    true = v != 0.0
                if when == W_AT:
                    if true and f[F_BEFORE, j] == 0.0:
                        f[F_NEAREST, j] = min(f[F_NEAREST, j], abs(t - begin))
                    f[F_BEFORE, j] = 1.0 if true else 0.0
                    continue
                broken = true == (when == W_NEVER)
                if not inside:
                    if broken:
                        f[F_LAST, j] = t
                    continue
                f[F_SEEN, j] += 1.0
                if true:
                    f[F_FIRST, j] = min(f[F_FIRST, j], t)
                if broken:
                    f[F_BROKEN, j] += 1.0
                if about == A_SIGNAL:
                    distance = min(v - low, high - v)
                    if not distance <= f[F_BEST, j]:  # NaN, too, and it stays
                        f[F_BEST, j] = distance if f[F_BEST, j] == f[F_BEST, j] else np.nan
                    if not distance >= f[F_WORST, j]:
                        f[F_WORST, j] = distance if f[F_WORST, j] == f[F_WORST, j] else np.nan
    for i in range(ticks):
        for j in range(n):
            new = int(out[i, modes, j])
            if k0 + i > 0 and not allowed[mode[j], new]:
                wrong[j] += 1
            mode[j] = new


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
    vanes, ticks = plants[0].vanes, len(heard.rows)
    loops = [power_on(plant, cal, float(scenario.demand[0][1])) for plant in plants]
    k_of = loops[0].calibration.scalars
    limits = always((float(k_of.stroke_min) * 1e3, float(k_of.stroke_max) * 1e3), float(k_of.current_limit) * 1e3)
    demanded = [
        Expect(signal=name, low=least - ROUNDING, high=most + ROUNDING, never=False, during=[0.0, scenario.duration])
        for name, least, most, _, _ in limits
    ]
    common = {
        i: facts_of(claim, Trace(np.arange(ticks) * TICK, np.empty(0), np.empty(0), {}, heard.counts, heard.late))
        for i, claim in enumerate(scenario.expect)
        if claim.count is not None or claim.late is not None
    }
    own = [i for i in range(len(scenario.expect)) if i not in common]
    claims = np.array([_claim(c, vanes) for c in (*(scenario.expect[i] for i in own), *demanded)])
    lanes = HeardLanes(loops, plants, [cal] * len(plants), heard.rows, noise_of(scenario.seed, ticks, len(vanes)))
    facts = np.zeros((len(claims), N_FACT, len(plants)))
    facts[:, [F_NEAREST, F_FIRST, F_WORST]], facts[:, [F_BEST, F_LAST]] = np.inf, -np.inf
    mode, wrong = np.zeros((2, len(plants)), np.int64)
    due = [tick for tick, _ in changes[0].at] + [ticks]
    done = 0
    room = lanes.room(AT_ONCE)
    while lanes.k < ticks:
        while due[done] == lanes.k:
            lanes.change([of.at[done][1] for of in changes])
            done += 1
        k, n = lanes.k, min(AT_ONCE, due[done] - lanes.k)
        lanes.advance(n, room[:n])
        watch(k, room[:n])
        _collect(k, room[:n], len(plants), claims, facts, mode, wrong, ALLOWED)
    found = []
    for j in range(len(plants)):
        margins = []
        mine = {i: _facts(scenario.expect[i], facts[q, :, j]) for q, i in enumerate(own)}
        for i, claim in enumerate(scenario.expect):
            of = mine[i] if i in mine else common[i]
            if of is not None:
                margins.append(margin_of(claim, of, holds(claim, of)))
        for (*_, words), row in zip(limits, facts[len(own) :, :, j], strict=True):
            margins.append(without_distance(words, bool(row[F_BROKEN] == 0.0)))
        margins.append(without_distance(CHANGES, bool(wrong[j] == 0)))
        found.append(margins)
    return found


def _facts(claim: Expect, row: np.ndarray) -> Facts:
    """Facts of a claim as collected."""
    signal = claim.signal is not None and claim.at is None and row[F_SEEN] > 0.0
    return Facts(
        float(row[F_NEAREST]), float(row[F_FIRST]), float(row[F_BEST]) if signal else np.nan,
        float(row[F_WORST]) if signal else np.nan, int(row[F_SEEN]), int(row[F_BROKEN]), float(row[F_LAST]),
    )  # fmt: skip
