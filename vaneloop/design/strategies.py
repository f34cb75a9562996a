"""Control strategies side by side: the same engine run under each of them, what the vanes get and what it costs.

Scenarios spoil the machine in the ways that a schedule's curves cannot know; the last one does it in all of them at
once. Errors are those of the true vane angles against the schedule at the true speed, every 10 ms: no sensor's noise is
in them. After that the potentiometers fail in the middle of the run, in several ways, and the strategy that uses them
has to go on without a step.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from controller import STRATEGIES, Calibration
from hil.loop.lockstep import Stimulus, lockstep, snapshot_names
from plant import Model, Plant, build_plant
from plant.effect import T_REF
from vaneloop.base.compiled import compiled

__all__ = ["FAILURES", "Failure", "Outcome", "Scenario", "failing", "run", "scenarios"]

Array = NDArray[np.float64]

FIGURES = ("mean_abs", "max_abs", "mean_abs_99_100")
MOVE = 2e-5  # m: a shorter motion of the piston is not counted; four times the LVDT's noise
HEATING = 120.0  # s: lag of the casing's temperature behind the engine's power
HEAT = 50.0  # K by which the casing is warmer at full speed than at idle
IDLE, FULL = 45.0, 100.0  # %
SWING = 20.0  # s for which a dither keeps its frequency
FREQUENCIES = (0.1, 0.2, 0.5, 1.0)  # Hz
AFTER = 10.0  # s after a failure in which a step is looked for
STEP_TIME = 1.0  # s: a change within this is a step
QUICK = 3.0  # %/s: a demand that moves faster moves the vanes
GAIN, TRAVEL, STEP = 3.0, 1.15, 0.2  # goals: error of dual over best, travel of best over dual, deg
EVERY = 10  # ticks between samples that are kept


@dataclass(frozen=True)
class Scenario:
    """What is wrong with the machine.

    play    deg, total play at the VIGV; the other stages' grow in proportion, as pins do that wear alike; None: as
            built
    growth  deg, by which the casing's heat turns the vanes of every stage at full speed
    noise   factor on the noise of all sensors
    dither  %, amplitude of what the ECU adds to the demand between 99 and 100 %
    """

    name: str
    play: float | None = None
    growth: float = 0.0
    noise: float = 1.0
    dither: float = 0.0


def scenarios(play: float = 2.4, growth: float = 0.5, noise: float = 3.0, dither: float = 0.15) -> tuple[Scenario, ...]:
    """Return the rows of the comparison; the last one has everything."""
    return (
        Scenario("nominal"),
        Scenario("worn", play=play),
        Scenario("thermal growth", growth=growth),
        Scenario("dither", dither=dither),
        Scenario(f"noise x{noise:g}", noise=noise),
        Scenario("all together", play, growth, noise, dither),
    )


@dataclass(frozen=True)
class Outcome:
    """One run. Curves on the raster ``t`` (s, 10 ms).

    errors   float64[n, stages], deg, vane angle minus schedule of each stage
    vanes    float64[n, stages], deg
    stroke_demand  mm
    aim      deg, VIGV angle that the stroke demand stands for, the compensation taken off
    side     -1 .. 1, where in the gap the stroke demand is
    offset, width  deg, compensation in use: offset and play beyond the one as built
    figures  stage -> mean_abs, max_abs, mean_abs_99_100 in deg
    travel, demand_travel  mm, of the piston without motions shorter than 0.02 mm, and of the stroke demand
    reversals  turning points of the piston, same threshold
    current  mA rms
    """

    scenario: str
    strategy: str
    t: Array
    n_r: Array
    errors: Array
    vanes: Array
    stroke_demand: Array
    aim: Array
    side: Array
    offset: Array
    width: Array
    figures: dict[str, dict[str, float | None]]
    travel: float
    demand_travel: float
    reversals: int
    current: float
    faults: int

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON values, without the curves."""
        names = ("scenario", "strategy", "travel", "demand_travel", "reversals", "current", "faults")
        units = {"travel": "travel_mm", "demand_travel": "demand_travel_mm", "current": "current_rms_ma"}
        return {units.get(k, k): getattr(self, k) for k in names} | self.figures


Outcomes = dict[tuple[str, str], Outcome]  # (scenario, strategy)


@compiled
def _motions(x: np.ndarray, least: float, total: np.ndarray, start: np.ndarray) -> None:
    """Add travel and turning points of ``x`` to total = [travel, turns]; start = [turn, extreme, direction] goes on
    from call to call.
    """
    for i in range(x.shape[0]):
        v = x[i]
        if start[2] == 0.0:
            if abs(v - start[0]) > least:
                start[2] = 1.0 if v > start[0] else -1.0
                start[1] = v
        elif start[2] * (v - start[1]) >= 0.0:
            start[1] = v
        elif start[2] * (start[1] - v) > least:
            total[0] += abs(start[1] - start[0])
            total[1] += 1.0
            start[0] = start[1]
            start[1] = v
            start[2] = -start[2]


class _Recorder:
    """Keeps of every tick's states what the figures need."""

    LEARNED = ("offset_in_use", "width_in_use", "crossing")

    def __init__(self, plant: Plant) -> None:
        names = snapshot_names(plant)
        last = len(names) - 1 - names[::-1].index("n_r")  # the plant's; the firmware has its own
        rings = [names.index(f"ring_{v}") for v in plant.vanes]
        self.kept = [last, *rings, *map(names.index, ("x_dem", *self.LEARNED))]
        self.x, self.current = names.index("x"), names.index("i_cmd")
        self.rows: list[Array] = []
        self.total, self.start, self.square, self.ticks = np.zeros(2), np.full(3, np.nan), 0.0, 0

    def __call__(self, states: Array) -> None:
        self.rows.append(states[::EVERY, self.kept])
        x, i = np.ascontiguousarray(states[:, self.x]), states[:, self.current]
        if np.isnan(self.start[0]):
            self.start[:] = x[0], x[0], 0.0
        _motions(x, MOVE, self.total, self.start)
        self.square += float(i @ i)
        self.ticks += len(i)


def machine(scenario: Scenario, plant: Plant) -> Plant:
    """Return the machine of a scenario: ``plant`` with what is wrong with it."""
    effects: dict[str, dict[str, float]] = {}
    built = {s: plant.geometry.stage(s).hysteresis.value for s in plant.vanes}
    if scenario.play is not None:
        effects["linkage_backlash"] = {s: v * (scenario.play / built["vigv"] - 1.0) for s, v in built.items()}
    if scenario.growth:
        effects["thermal_growth"] = dict.fromkeys(plant.vanes, scenario.growth / HEAT)
    plant = Model(effects=effects).plant(plant)
    return replace(plant, sigma=plant.sigma * scenario.noise)


def casing(n_dem: Array) -> Array:
    """Temperature (degC) that the casing has under a demand (%, every 10 ms): first-order lag behind the engine's
    power.
    """
    share = 1e-2 / HEATING
    return T_REF + HEAT * scipy.signal.lfilter(
        [share], [1.0, share - 1.0], np.clip((n_dem - IDLE) / (FULL - IDLE), 0.0, 1.0)
    )


def dithered(n_dem: Array, amplitude: float) -> Array:
    """Add a dither (%) of changing frequency to the demand where it is between 99 and 100 %."""
    t = np.arange(len(n_dem)) * 1e-2
    f = np.array(FREQUENCIES)[(t // SWING).astype(int) % len(FREQUENCIES)]
    return n_dem + np.where((n_dem >= 99.0) & (n_dem <= 100.0), amplitude * np.sin(2.0 * np.pi * f * t), 0.0)


def run(
    scenario: Scenario,
    n_dem: Array,
    calibration: Calibration,
    seed: int = 1,
    pots: Array | None = None,
    base: Plant | None = None,
) -> Outcome:
    """Run one scenario under the strategy of ``calibration``.

    n_dem  %, one value every 10 ms
    pots   as `hil.loop.lockstep.lockstep` takes them, rad
    base   the machine as built; default: the shipped tables
    """
    plant = machine(scenario, base or build_plant())
    recorder, stages = _Recorder(plant), len(plant.vanes)
    stimulus = Stimulus.of(dithered(n_dem, scenario.dither), t_oil=casing(n_dem))
    done = lockstep(
        stimulus, calibration=calibration, plant=plant, seed=seed, every=100, hashed=False, pots=pots, watch=recorder
    )
    a = np.vstack(recorder.rows)
    n_r, x_dem = a[:, 0], a[:, 1 + stages]
    vanes = np.empty((len(a), stages))
    for k in range(stages):
        ldp, lever = plant.lever(k)
        vanes[:, k] = np.rad2deg(np.arcsin(np.clip(ldp * np.tan(a[:, 1 + k]) / lever, -1.0, 1.0)))
    errors = vanes - np.rad2deg(plant.schedules.targets(n_r))
    travel, start = recorder.total, recorder.start
    angle = 180.0 / np.pi
    offset, width, crossing = a[:, 2 + stages :].T
    drive = np.interp(x_dem, calibration.angles[0], calibration.angles[1])
    aim = drive + offset - 0.5 * crossing * (calibration.scalars.play[0] + width)
    return Outcome(
        scenario.name,
        STRATEGIES[int(calibration.scalars.strategy)],
        np.arange(len(a), dtype=np.float64) * (EVERY * 1e-3),
        n_r,
        errors,
        vanes,
        x_dem * 1e3,
        aim * angle,
        crossing,
        offset * angle,
        width * angle,
        {s: _figures(errors[:, k], n_r) for k, s in enumerate(plant.vanes)},
        float(travel[0] + abs(start[1] - start[0])) * 1e3,
        float(np.abs(np.diff(x_dem)).sum()) * 1e3,
        int(travel[1]),
        float(np.sqrt(recorder.square / recorder.ticks)) * 1e3,
        done.faults,
    )


def _figures(error: Array, n_r: Array) -> dict[str, float | None]:
    e, near = np.abs(error), (n_r > 99.0) & (n_r < 100.0)
    return {
        "mean_abs": float(e.mean()),
        "max_abs": float(e.max()),
        "mean_abs_99_100": float(e[near].mean()) if near.any() else None,
    }


# ---- potentiometers that fail ----------------------------------------------------------------------------------------

# name -> (share of the reading, offset in deg at once, in deg/s from then on, noise in deg); stuck: at the angle of
# that moment
FAILURES: dict[str, tuple[float, float, float, float]] = {
    "no signal": (1.0, np.nan, 0.0, 0.0),
    "out of range": (0.0, 120.0, 0.0, 0.0),
    "stuck": (0.0, np.nan, 0.0, 0.0),
    "jump of 2 deg": (1.0, 2.0, 0.0, 0.0),
    "jump of 0.3 deg": (1.0, 0.3, 0.0, 0.0),
    "noise of 1 deg": (1.0, 0.0, 0.0, 1.0),
    "drift of 0.05 deg/s": (1.0, 0.0, 0.05, 0.0),
    "drift of 0.005 deg/s": (1.0, 0.0, 0.005, 0.0),
    "drift of -0.005 deg/s": (1.0, 0.0, -0.005, 0.0),
}


@dataclass(frozen=True)
class Failure:
    """What followed a failure of the potentiometers of ``stages``.

    during  at rest or in motion: what the demand did at the time ``at`` (s)
    step    deg, VIGV: what the failure changed within 1 s, in the first 10 s of the vane or of the angle that is aimed
            at (both against the healthy run), or at any later time of the compensation in use
    departure  deg, VIGV: largest difference to the healthy run in the first 10 s
    crossings  how often more than in the healthy run the stroke crossed the gap in the first 10 s (the vane stands
               meanwhile)
    mean_abs, mean_abs_dual  deg, VIGV's error from then on, of this run and of dual
    """

    failure: str
    during: str
    stages: tuple[str, ...]
    at: float
    step: float
    departure: float
    crossings: int
    mean_abs: float
    mean_abs_dual: float


def moments(n_dem: Array) -> dict[str, int]:
    """Samples after the middle at which to let the potentiometers fail: during -> sample; what the profile does not
    offer is left out.

    at rest    the demand has stood at 99 % or more for 5 s and will for 10 s
    in motion  the demand has moved faster than 3 %/s for 1 s, and 10 s are left
    """
    rate, half = np.abs(np.diff(n_dem, prepend=n_dem[0])) / 1e-2, len(n_dem) // 2

    def first(ok: NDArray[np.bool_], length: int, after: int) -> int | None:
        hits = np.flatnonzero(np.convolve(ok[half:], np.ones(length), "valid") > length - 0.5)
        return (
            int(hits[0]) + half + after
            if hits.size and int(hits[0]) + half + after + int(AFTER / 1e-2) < len(n_dem)
            else None
        )

    found = {"at rest": first((rate < 1e-7) & (n_dem >= 99.0), 1500, 500), "in motion": first(rate > QUICK, 100, 100)}
    return {during: at for during, at in found.items() if at is not None}


def failing(
    name: str,
    during: str,
    healthy: Outcome,
    dual: Outcome,
    scenario: Scenario,
    n_dem: Array,
    calibration: Calibration,
    seed: int = 1,
    base: Plant | None = None,
    stages: tuple[str, ...] | None = None,
) -> tuple[Failure, Outcome]:
    """Run a scenario again with the potentiometers of ``stages`` (default: all) failing ``during`` one of the
    `moments`.
    """
    at, lag = moments(n_dem)[during], int(STEP_TIME / 1e-2)
    share, offset, drift, noise = FAILURES[name]
    vanes = calibration.vanes
    stages = vanes if stages is None else stages
    pots = np.tile([1.0, 0.0], (len(n_dem), len(vanes)))
    t, rng = np.arange(len(n_dem) - at) * 1e-2, np.random.default_rng(seed)
    for k in map(vanes.index, stages):
        wrong = healthy.vanes[at, k] if name == "stuck" else offset + drift * t + noise * rng.standard_normal(len(t))
        pots[at:, 2 * k], pots[at:, 2 * k + 1] = share, np.deg2rad(wrong)
    out = run(scenario, n_dem, calibration, seed, pots, base)
    first = slice(at, at + int(AFTER / 1e-2))
    changes = [(a - b)[first] for a, b in ((out.vanes[:, 0], healthy.vanes[:, 0]), (out.aim, healthy.aim))]
    compensation = np.abs(out.offset[at + lag :] - out.offset[at:-lag]) + 0.5 * np.abs(
        out.width[at + lag :] - out.width[at:-lag]
    )
    step = max(float(compensation.max()), *(float(np.abs(c[lag:] - c[:-lag]).max()) for c in changes))
    departure = max(float(np.abs(c).max()) for c in changes)
    rest = [float(np.abs(o.errors[at:, 0]).mean()) for o in (out, dual)]
    crossings = [int(np.abs(np.diff(np.sign(o.side[first]))).sum() / 2) for o in (out, healthy)]
    return Failure(name, during, stages, at * 1e-2, step, departure, max(crossings[0] - crossings[1], 0), *rest), out


# ---- the command -----------------------------------------------------------------------------------------------------


def judged(rows: tuple[Scenario, ...], outcomes: Outcomes, failures: list[Failure], best: str) -> list[dict[str, Any]]:
    """Judge the best strategy against dual."""
    goals: list[dict[str, Any]] = []

    def judge(goal: str, value: float, limit: float, least: bool = False) -> None:
        goals.append(
            {"goal": goal, "value": value, "limit": limit, "held": bool(value >= limit if least else value <= limit)}
        )

    last = rows[-1].name
    mean = {s: outcomes[last, s].figures["vigv"]["mean_abs"] or 0.0 for s in ("dual", best)}
    judge(
        f"{last}: mean VIGV error of dual over that of {best}", mean["dual"] / max(mean[best], 1e-9), GAIN, least=True
    )
    for row in rows:
        mine, dual = outcomes[row.name, best], outcomes[row.name, "dual"]
        judge(f"{row.name}: travel of {best} over that of dual", mine.travel / max(dual.travel, 1e-9), TRAVEL)
        for k in FIGURES:
            a, b = mine.figures["vigv"][k], dual.figures["vigv"][k]
            if a is not None and b is not None:
                judge(f"{row.name}: VIGV {WORDS[k]} of {best} (deg), at most dual's", a, b)
    for f in failures:
        judge(f"potentiometers, {f.failure}, {f.during}: step (deg)", f.step, STEP)
    return goals


WORDS = {"mean_abs": "mean", "max_abs": "maximum", "mean_abs_99_100": "mean at 99 to 100 %"}
