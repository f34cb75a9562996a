"""The clocks and zeros of a log: by how much the samples of some channels stand late in the file, or read high.

Who records the bus, the controller and the vanes with three devices has three clocks, three filters and three zeros.
What that does to a log is no physics, and it is worked out before the search looks for any. Only what the machine
cannot do counts as the recorder's, and each subsystem has its own offsets, against the channels that it explains: what
comes in frames, each of one of the controller's ticks, is never worked out between two of them.

| subsystem | what stands late | why no machine does that |
|---|---|---|
| servo | stroke demand or stroke against the current | the firmware's law leaves no time |
| demand | rotor speed against the stroke demand | an answer before its cause |
| engine | rotor speed and all else against its demand | lags bend a response, they do not move it |
| linkage | all vane angles alike against the stroke; also more and more | each sensor has a lag of its own |

A reading that is high in the file alone is the recorder's, too: the firmware's law and tables say what the controller
has read.

| subsystem | what reads high | what says so |
|---|---|---|
| servo | stroke | the integral of the law drifts away from that of the logged current |
| demand | rotor speed | the stroke demand lies elsewhere on the tables |
| engine | rotor speed, where no demand is judged | it settles at another speed than the demanded one |
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np

from hil.logs import Log
from plant import chain
from vaneloop.base.signals import UNITS
from vaneloop.base.vanes import VANES
from vaneloop.identification.least_squares.problem import LeastSquaresProblem, recalibrate
from vaneloop.identification.selection.likelihood_acceptance import LikelihoodAcceptance
from vaneloop.identification.settings import COLOUR, EXPLAINED, LATE, LOW_PASS_ROWS, MOVES_ALIKE, NATS, RASTER, WINDOW
from vaneloop.identification.subsystem import Array, Stage
from vaneloop.identification.vane_chain.current import LOGGED_CURRENT, law_of, taken
from vaneloop.identification.vane_chain.low_pass import AS_LOGGED, LOW_PASSES, LowPass
from vaneloop.identification.vane_chain.resample import OF_SUBSYSTEM, Grid, first_row, last_digit
from vaneloop.identification.vane_chain.subsystem_data import ALSO, VANES_LATE, Made

__all__ = [
    "Late", "LateIn", "aligned", "demand_of", "driving", "explains", "fits", "late_in_controller", "late_vanes",
    "on_rows", "passed_by", "vanes_late", "zeros_in_controller",
]  # fmt: skip

Sampled = tuple[Array, ...]  # a row's current by each of the ways in which a logger may take it from its ten ticks
LateIn = Mapping[str, tuple["Late", ...]]  # subsystem -> what stands late in it, against what it explains
DEMAND, DRIVING = ("x_dem",), ("n_r", "n_dem")
LEAST_LATE = chain.TICK  # s; the controller does nothing between two ticks


class Late(NamedTuple):
    """Channels whose samples stand ``seconds`` late in the file at the middle of the log, and ``drift`` (s/s) more with
    each second; times count from the start of the log's stages.

    passed  low-pass of the analogue channels: of a demand, which has not passed it, it makes the delay, or part of it;
            of analogue channels that stand where they belong, all have passed it
    zero    border unit, by which the file reads higher than the controller has
    """

    channels: tuple[str, ...]
    seconds: float
    drift: float = 0.0
    middle: float = 0.0
    passed: LowPass = AS_LOGGED
    zero: float = 0.0

    def text(self) -> str:
        """What is said of it."""
        if self.zero:
            by = f"{abs(self.zero):.3g} {UNITS[self.channels[0]]} {'higher' if self.zero > 0.0 else 'lower'}"
            return f"{self.channels[0]}: reads {by} in the file than in the controller; subtracted"
        if self.passed.kind and not self.seconds:
            return f"{', '.join(self.channels)}: have passed {self.passed.text()}; the model's have, too"
        way = "late" if self.seconds >= 0.0 else "early"
        more = f", and {1e6 * self.drift:.3g} us more each second" if self.drift else ""
        more += f", because the analogue channels have passed {self.passed.text()}" if self.passed.kind else ""
        return f"{', '.join(self.channels)}: stand {abs(1e3 * self.seconds):.3g} ms {way} in the file{more}; moved"

    @property
    def besides(self) -> float:
        """Seconds that no low-pass makes."""
        return self.seconds + self.passed.delay

    def times(self, t: Array) -> Array:
        """The true times of samples that the file has at ``t`` (s)."""
        return np.asarray(t - self.seconds - self.drift * (t - self.middle))


def aligned(log: Log, late: Sequence[Late], grid: Grid) -> Log:
    """The log without zero offsets, its strokes where they belong, and the vane angles `on_rows` of its raster."""
    late = [one for one in late if one.seconds or one.drift or one.zero]
    channels = dict(log.channels)
    for one in late:
        for name in (c for c in one.channels if c in log.channels):
            c = channels[name]
            if one.zero:
                channels[name] = replace(c, values=c.values - one.zero)
            elif name in VANES:
                channels[name] = replace(c, t=c.t - on_rows(log, one, grid))
            elif name not in DRIVING:
                channels[name] = replace(c, t=grid.start + one.times(c.t - grid.start))
    return replace(log, channels=channels) if late else log


def on_rows(log: Log, late: Late, grid: Grid) -> float:
    """Seconds by which the samples of channels that stand late lie behind rows of the raster, at most half a row: noise
    between two rows is less than it is at them, and the floor with it.
    """
    c = next(log.channels[name] for name in late.channels if name in log.channels)
    step = min(grid.dt, float(np.median(np.diff(c.t))))
    turns = np.exp(2j * np.pi * (c.t - first_row(log.channels, grid)) / step)
    return float(np.angle(np.mean(turns))) * step / (2.0 * np.pi)


def driving(t: Array, columns: dict[str, Array], late: Sequence[Late]) -> dict[str, Array]:
    """The columns of a raster with the speeds where they belong: between their rows by straight lines, for a stage is
    driven by them.
    """
    moved = {name: one for one in late if one.besides for name in one.channels if name in columns and name in DRIVING}
    return columns | {name: _shifted(t, columns[name], one.besides) for name, one in moved.items()}


def vanes_late(t: Array, late: Sequence[Late], log: Log, grid: Grid) -> dict[str, Array]:
    """By how much the vane angles stand late at the rows ``t`` (s) where `aligned` has left them: a column `VANES_LATE`
    (s), or none. The model of them is made for where they were.
    """
    moved = next((one for one in late if not {*VANES}.isdisjoint(one.channels) and (one.seconds or one.drift)), None)
    return {VANES_LATE: t - moved.times(t) - on_rows(log, moved, grid)} if moved else {}


def demand_of(late: Sequence[Late]) -> tuple[LowPass, tuple[Late, ...]]:
    """The low-pass that stroke and current have passed and the servo's demand has not; and all other offsets."""
    behind = next((one.passed for one in late if one.channels == DEMAND), AS_LOGGED)
    return behind, tuple(one for one in late if one.channels != DEMAND)


def passed_by(late: Sequence[Late]) -> LowPass:
    """The low-pass that what a subsystem explains has passed, and the model of it has not."""
    return next(
        (one.passed._replace(late=0.0) for one in late if one.passed.kind and one.channels != DEMAND), AS_LOGGED
    )


def late_in_controller(stages: Sequence[Stage]) -> LateIn:
    """Channels of the controller and of the ECU that stand late in each subsystem, as the stages of a log say where
    they fail.
    """
    of = _judged(stages)
    out: dict[str, tuple[Late, ...]] = {}
    if "servo" in of and (servo := _servo(of["servo"])):
        stroke = tuple(one for one in servo if one.channels == ("x_lvdt",))
        out = {"servo": tuple(servo), "actuator": tuple(servo)} | ({"linkage": stroke} if stroke else {})
    # an answer before its cause is the recorder's only where it has the answer late in the servo as well
    demand_late = max([0.0, *(one.seconds for one in out.get("servo", ()) if one.channels == DEMAND)])
    if "demand" in of:
        out["demand"] = _one(of["demand"], ("n_r",), lambda d: d > -demand_late - LEAST_LATE * (demand_late > 0.0))
    passed, _ = demand_of(out.get("servo", ()))
    passed = passed._replace(late=0.0)
    if "servo" not in of and "linkage" in of:
        passed = _both_passed(of["linkage"])
    if "engine" in of:
        out["engine"] = _one(of["engine"], ("n_dem",), lambda d: True, passed)
    if passed.kind and "linkage" in of:
        out["linkage"] = out.get("linkage", ()) + _both_behind(of["linkage"], passed)
    return {name: late for name, late in out.items() if late}


def zeros_in_controller(stages: Sequence[Stage]) -> LateIn:
    """Strokes and rotor speeds that read higher in the file than in the controller, where the stages of a log fail; and
    beside them the current, by no more of its noise floors: alone it would be the valve's null.
    """
    of = _judged(stages)
    speed = next((name for name in ("demand", "engine") if name in of), "")
    zeros: dict[str, float] = {}
    for name, channel in (("servo", "x_lvdt"), (speed, "n_r")):
        if name in of and not fits(of[name]) and (zero := _zero(of[name], channel)):
            zeros[channel] = zero
    floors = {c: float(f) for one in of.values() for c, f in zip(one.outputs, np.asarray(one.floor), strict=True)}
    most = max((abs(zero) / floors[c] for c, zero in zeros.items() if c in floors), default=0.0)
    if most and "i_cmd" in floors and "actuator" in of and not fits(of["actuator"]):
        zero = _zero(of["actuator"], "i_cmd")
        if 0.0 < abs(zero) <= most * floors["i_cmd"]:
            zeros["i_cmd"] = zero
    late = tuple(Late((c,), 0.0, zero=zero) for c, zero in zeros.items())
    return dict.fromkeys(OF_SUBSYSTEM, late) if late else {}


def _zero(stage: Stage, channel: str) -> float:
    """By how much a channel reads high, border unit; 0: that does not explain the stage's error, or an offset of the
    stroke demand, as tables make whose strokes are off alike, does so better.
    """
    driven, one = stage.made.driven, np.ones(len(stage.t))  # type: ignore[attr-defined]

    def fitted(column: str, rise: Array) -> tuple[Array, Array, Array]:
        """`_fit` of an offset, each unit of which adds ``rise`` to a column of the stage."""
        columns = [c for c in (column, *ALSO.get(column, ())) if c in driven.columns]

        def without(zero: Array) -> dict[str, Array]:
            of = {c: driven.columns[c] for c in columns}
            return {c: x - zero[0] * (rise if rise.ndim == x.ndim else rise[:, None]) for c, x in of.items()}

        return _fit(stage, _moving(stage, without), 1, most=np.inf)

    moves = ("law", law_of(0.0 * one, one, driven.calibration)) if stage.name == "servo" else (channel, one)
    zero, before, after = fitted(*moves)
    if not explains(stage, before, after):
        return 0.0
    if stage.outputs == DEMAND and fitted(*DEMAND, one)[2].sum() <= after.sum():
        return 0.0
    return float(zero[0])


def late_vanes(stages: Sequence[Stage]) -> LateIn:
    """Whether all vane angles stand late alike, and more and more where their clock is a fast one. They stand early
    only where the actuator has no such lag: a slow LVDT looks alike, but there, too.
    """
    of = _judged(stages)
    stage = of.get("linkage")
    if stage is None or len(stage.outputs) < 2 or fits(stage):
        return {}
    t, c = stage.t, stage.made.driven.columns  # type: ignore[attr-defined]
    length, middle, by_clock = float(np.ptp(t)), 0.5 * float(t[0] + t[-1]), _by_clock(stage)

    def shifted(late: Array) -> dict[str, Array]:
        return {name: _shifted(t, c[name], by_clock(late)) for name in ("x_lvdt", "stroke", "n_r") if name in c}

    late, before, after = _fit(stage, _moving(stage, shifted), 2)
    if not explains(stage, before, after) or np.any(np.abs(late) >= LATE):
        return {}
    if late[0] < 0.0 and "actuator" in of and _lvdt_lag(of["actuator"], -float(late[0])) > -0.5 * late[0]:
        return {}
    drift = float(late[1]) if abs(late[1]) > 2.0 * LEAST_LATE else 0.0  # less at either end of the log
    return {"linkage": (Late(stage.outputs, float(late[0]), drift / length, middle),)}


def _by_clock(stage: Stage) -> Callable[[Array], Array]:
    """Function from by how much (s) the vane angles stand late at the middle of the log, and by how much more at its
    end than at its start, to the times at which the stroke is what it was for them, less those of the rows.
    """
    place = (stage.t - 0.5 * (stage.t[0] + stage.t[-1])) / np.ptp(stage.t)
    return lambda late: np.asarray(-(late[0] + late[1] * place))


def _judged(stages: Sequence[Stage]) -> dict[str, Stage]:
    return {s.name: s for s in stages if s.floor is not None and isinstance(s.made, Made)}


def _shifted(t: Array, values: Array, late: float | Array) -> Array:
    return np.asarray(np.interp(t + late, t, values))


def _servo(stage: Stage) -> list[Late]:
    """Stroke demand and stroke against the current, by the firmware's law, which is linear in both.

    The current is `taken` from the ticks since the row before in any way that a logger may. What it has in common with
    a row's noise is projected out, and what the demand's rounding makes is taken off the squares: both would favour
    what smooths most. How large that is, is known to a half.
    """
    if fits(stage):
        return []
    driven = stage.made.driven  # type: ignore[attr-defined]
    t, c, cal = driven.t, driven.columns, driven.calibration
    use = np.isfinite(stage.measured[0])
    window = (np.arange(len(t)) // round(WINDOW / RASTER))[use]
    if not use.any():
        return []

    def centred(values: Array) -> Array:
        v = values[use]
        return np.asarray(v - (np.bincount(window, v) / np.maximum(np.bincount(window), 1))[window])

    def sampled(ticks: Array) -> Sampled:
        return tuple(centred(one) for one in taken(ticks, driven.samples).values())

    none, current, stroke = np.zeros(len(t)), centred(c.get(LOGGED_CURRENT, c["i_cmd"])), c["stroke"]
    # of a row's noise the controller saw what is the sensor's, and not what is the recorder's: a share of it
    shared = centred(c["x_lvdt"] - stroke)
    shared /= max(float(np.linalg.norm(shared)), 1e-300)

    # and what the demand's last digit hides the controller knew
    hidden = last_digit(c["x_dem"], driven.digit("x_dem"))(np.random.default_rng(0))

    def demanded(passed: LowPass, x_dem: Array) -> Sampled:
        return sampled(law_of(x_dem, none, cal, behind=passed))

    @cache
    def demand(ticks: float) -> tuple[Sampled, Array]:
        """What the law makes of a demand that is late, and the power of what it makes of its rounding."""
        late = LowPass(late=-ticks * LEAST_LATE)
        return demanded(late, c["x_dem"]), np.array([h @ h for h in demanded(late, hidden)])

    @cache
    def own_stroke(ticks: float) -> Sampled:
        return sampled(law_of(none, _shifted(t, stroke, ticks * LEAST_LATE), cal))

    def least(kind: int, late: Array, other: Array) -> tuple[float, float, float, float]:
        """The least power that demand and stroke leave which are late by these ticks; what the rounding makes, which is
        taken off it; and by how much they are.
        """
        d = [demand(float(one)) for one in late]
        left = current[None] - np.array([one[kind] for one, _ in d])
        own = np.array([own_stroke(float(one))[kind] for one in other])
        power = np.sum(left**2, axis=1)[:, None] - 2.0 * left @ own.T + np.sum(own**2, axis=1)[None]
        power -= np.where(other == 0.0, (left @ shared)[:, None] - (own @ shared)[None], 0.0) ** 2
        power -= (hides := np.array([hides[kind] for _, hides in d])[:, None])
        j, k = np.unravel_index(int(np.argmin(power)), power.shape)
        return float(power[j, k]), float(hides[j, 0]), float(late[j]), float(other[k])

    def less(before: Sequence[float], after: Sequence[float]) -> float:
        """By how much a power is less than before, at least; both with what the rounding makes."""
        return before[0] - after[0] - EXPLAINED * abs(before[1] - after[1])

    step, here = 0.1 * LATE / LEAST_LATE, np.zeros(1)
    around = step * np.arange(-8, 9) / 8.0
    kinds = range(len(own_stroke(0.0)))
    as_is = min(least(kind, here, here) for kind in kinds)
    found = [(0.0, 0.0, 0.0)]
    for kind in kinds:
        for both in (0.0, 1.0):
            *left, late, other = least(kind, step * np.arange(-10, 11), both * step * np.arange(-10, 11))
            for fine in (around, around / 8.0):
                *left, late, other = least(kind, late + fine, other + both * fine)
            found.append((less(as_is, left), late * LEAST_LATE, other * LEAST_LATE))
    chance = _chance(float(stage.floor[0]) ** 2)  # type: ignore[index]
    excess = as_is[0] + as_is[1] - float(stage.floor[0]) ** 2 * len(current)  # type: ignore[index]
    # the fewer channels have to move, the better
    near = [f for f in found if f[0] >= (1.0 - MOVES_ALIKE) * max(found)[0]]
    gain, late_demand, late_stroke = min(near, key=lambda f: (f[2] != 0.0, -f[0]))
    if min(gain, excess) < max(EXPLAINED * excess, chance):
        return []
    # all else is behind a low-pass, maybe, whose recorder's clock may be early by more than that
    own = current[None] - np.array(own_stroke(late_stroke / LEAST_LATE))

    def left_by(passed: LowPass) -> tuple[Array, Array]:
        e = own - np.array(demanded(passed, c["x_dem"]))
        return e if late_stroke else e - np.outer(e @ shared, shared), np.array(demanded(passed, hidden))

    scanned = [LowPass("second order", d, -late_demand - d) for d in float(t[1] - t[0]) * np.array(LOW_PASS_ROWS)]

    def powers(passed: LowPass) -> tuple[float, float]:
        of, by_noise = (np.sum(x**2, axis=1) for x in left_by(passed))
        return min(zip(of - by_noise, by_noise, strict=True))

    begins = [min(scanned, key=powers)]
    if late_demand < -LEAST_LATE:
        begins.append(LowPass("second order", -late_demand))
    tried = min((_low_pass(x._replace(kind=kind), left_by) for x in begins for kind in LOW_PASSES), key=lambda x: x[0])
    # what is late may be so by a low-pass or by a clock, alike; what is not needs a reason to have passed one
    by_clock = powers(LowPass(late=-late_demand))
    least_gain = chance if late_demand < -LEAST_LATE else max(chance, EXPLAINED * by_clock[0])
    passed = tried[1] if less(by_clock, powers(tried[1])) > least_gain else LowPass(late=-late_demand)
    lates = (Late(DEMAND, -passed.delay - passed.late, passed=passed), Late(("x_lvdt",), late_stroke))
    return [one for one in lates if one.seconds or one.passed.kind]


def _low_pass(begin: LowPass, errors: Callable[[LowPass], tuple[Array, Array]]) -> tuple[float, LowPass]:
    """The low-pass of the kind of ``begin``, and how late it stands besides, that leave least near that. Returns what
    is left, squared, and it.

    errors  what a low-pass leaves, and what it makes of a draw of the noise of what passed it, each float64[ways
            to sample, values]. Least squares of the first less those of the second: else the low-pass that takes most
            off the noise would be the best (Soederstroem, Automatica 43 (2007) 939, bias-compensated least squares)
    """

    def of(at: Array) -> LowPass:
        return begin._replace(delay=float(at[0]), late=float(at[1]))

    found = []
    for sample in range(len(errors(begin)[0])):
        at, best = np.array([begin.delay, begin.late]), (np.inf, AS_LOGGED)
        for _ in range(4):
            e, noise_of = (x[sample] for x in errors(of(at)))
            best = min(best, (float(e @ e - noise_of @ noise_of), of(at)))
            step = 0.2 * LEAST_LATE
            beside = [errors(of(at + d)) for d in step * np.eye(2)]
            own, noise = (np.array([(x[k][sample] - now) / step for x in beside]) for k, now in ((0, e), (1, noise_of)))
            at = at - np.linalg.lstsq(own @ own.T - noise @ noise.T, own @ e - noise @ noise_of, rcond=None)[0]
            at[0] = np.clip(at[0], 0.5 * begin.delay, 2.0 * begin.delay)
        found.append(best)
    return min(found)


def _fit(
    stage: Stage,
    moved: Callable[[Array], Stage],
    terms: int,
    frame: float = 0.0,
    start: Array | None = None,
    most: float | Array = LATE,
) -> tuple[Array, Array, Array]:
    """Offsets (s, float64[terms]) that suit a stage best with its nominal parameters, and its outputs' mean squared
    errors without and with them, in noise floors.

    start, most  offsets to begin with, and how large they may be
    """
    floor = np.asarray(stage.floor)
    judge = LeastSquaresProblem(stage, floor)
    theta, late = recalibrate(judge).theta, np.zeros(terms) if start is None else start
    free = judge.nominal
    before = judge.mean_squares(judge.errors(theta)[0])
    for _ in range(4):  # each leaves a hundredth of an offset that is short against the motion
        at = LeastSquaresProblem(moved(late), floor)
        e, slopes = at.nominal_slopes(theta)
        columns = [one.ravel() for one in slopes]
        for k in range(terms):
            other = late.copy()
            other[k] += 0.5 * LEAST_LATE
            beside = LeastSquaresProblem(moved(other), floor).errors(theta[None])[0]
            columns.append((beside - e).ravel() / (0.5 * LEAST_LATE))
        scale = np.array([*(stage.parameters[i].tolerance for i in free), *[LATE] * terms])
        a = np.array(columns).T * scale
        prior = np.diag([*[3.0**0.5] * len(free), *[0.0] * terms])
        held = np.array([*((theta[i] - stage.parameters[i].expected) / stage.parameters[i].tolerance for i in free),
                         *[0.0] * terms])  # fmt: skip
        normal, slope = a.T @ a + prior**2, a.T @ e.ravel() + prior**2 @ held
        step = np.linalg.lstsq(normal, -slope, rcond=None)[0]
        step *= scale
        theta = theta.copy()
        theta[free] += step[: len(free)]
        late = np.clip(late + step[len(free) :], -most, most)
    offsets = [late]
    if frame:  # what comes in frames stands late by whole ones
        offsets.append(np.round(late / frame) * frame)
    tried = [LeastSquaresProblem(moved(x), floor) for x in offsets]
    errors = [judge.mean_squares(judge.errors(theta)[0]) for judge in tried]
    k = min(range(len(offsets)), key=lambda k: float(errors[k].sum()))
    return offsets[k], before, errors[k]


def explains(stage: Stage, before: Array, after: Array) -> bool:
    """Whether no output gets worse, the gain is significant, and at least half of what they are above the noise goes;
    ``before`` and ``after``: mean squared errors of the outputs, in squared noise floors.
    """
    excess, left = np.maximum(before - 1.0, 0.0), np.maximum(after - 1.0, 0.0)
    better = bool(np.all(after <= before * 1.0001)) and _significant(stage, before, after)
    return better and bool(left.sum() <= (1.0 - EXPLAINED) * excess.sum())


def _significant(stage: Stage, before: Array, after: Array) -> bool:
    """Whether errors have become less by as many nats as an effect must gain."""
    samples = np.isfinite(stage.measured).sum(axis=1)
    return float((before - after) @ samples) > _chance(1.0)


def _chance(power: float) -> float:
    """By how much chance may lessen the sum of squares, where noise has this mean square."""
    return 2.0 * COLOUR[1] * NATS * power


def _moving(
    stage: Stage, of: Callable[[Array], Mapping[str, Array]], passed: LowPass | None = None
) -> Callable[[Array], Stage]:
    """A function from offsets to the stage with other columns, and what it explains behind a low-pass; None: as it
    is.
    """
    made = stage.made
    assert isinstance(made, Made)
    passed = made.driven.passed if passed is None else passed

    def moved(late: Array) -> Stage:
        columns = {**made.driven.columns, **of(late)}
        return made.make(made.driven._replace(columns=columns, passed=passed, again=True))

    return moved


def _one(
    stage: Stage, channels: tuple[str, ...], allowed: Callable[[float], bool], passed: LowPass = AS_LOGGED
) -> tuple[Late, ...]:
    """One offset of ``channels`` that drive a stage against all else in it, which may have ``passed`` a low-pass."""
    t, c = stage.t, stage.made.driven.columns  # type: ignore[attr-defined]
    if fits(stage) and not passed.kind:
        return ()

    def of(late: Array) -> dict[str, Array]:
        return {name: _shifted(t, c[name], float(late[0])) for name in channels if name in c}

    found = []
    for behind in dict.fromkeys((AS_LOGGED, passed, passed._replace(held=bool(passed.kind)))):
        late, before, after = _fit(stage, _moving(stage, of, behind), 1, RASTER)
        if explains(stage, before, after) and allowed(float(late[0])) and abs(late[0]) < LATE:
            one = Late(channels, float(late[0]) - behind.delay, passed=behind._replace(late=-float(late[0])))
            found.append((float(after.sum()), one if behind.kind else Late(channels, float(late[0]))))
    return (min(found, key=lambda x: x[0])[1],) if found else ()


def _both_behind(stage: Stage, passed: LowPass) -> tuple[Late, ...]:
    """Stroke and vanes behind a low-pass that the controller's channels have passed, unless that leaves significantly
    more, whatever the clock of the vanes.
    """
    t, c, by_clock = stage.t, stage.made.driven.columns, _by_clock(stage)  # type: ignore[attr-defined]

    def left(passed: LowPass) -> Array:
        stroke = passed.before(c.get("stroke", c["x_lvdt"]), float(t[1] - t[0]))
        moved = _moving(stage, lambda late: {"stroke": _shifted(t, stroke, by_clock(late))}, passed)
        return _fit(stage, moved, 2)[2]

    worse = _significant(stage, left(passed), left(AS_LOGGED))
    return () if worse else (Late(("x_lvdt", *stage.outputs), 0.0, passed=passed),)


def _both_passed(stage: Stage) -> LowPass:
    """The low-pass that stroke and vanes have both passed, where no servo tells: what it takes off the stroke's turns
    the play keeps, which no offset does.
    """
    if fits(stage):
        return AS_LOGGED
    t, c = stage.t, stage.made.driven.columns  # type: ignore[attr-defined]
    dt, by_clock = float(t[1] - t[0]), _by_clock(stage)
    stroke = c.get("stroke", c["x_lvdt"])

    def behind(kind: str, start: float, fixed: bool) -> tuple[float, LowPass, Array]:
        """What a low-pass leaves whose delay is ``start`` (s), or the one near it that suits best; the low-pass; and
        what it leaves of each output.
        """

        def passed(late: Array) -> LowPass:
            return LowPass(kind, start if fixed else abs(float(late[2]))) if kind else AS_LOGGED

        def moved(late: Array) -> Stage:
            before = _shifted(t, passed(late).before(stroke, dt), by_clock(late[:2]))
            return _moving(stage, lambda _: {"stroke": before}, passed(late))(late)

        begin, most = (np.array(x)[: 2 if fixed else 3] for x in ([0.0, 0.0, start], [LATE, LATE, np.inf]))
        late, _, after = _fit(stage, moved, len(begin), start=begin, most=most)
        return float(after.sum()), passed(late), after

    scanned = min((behind("second order", rows * dt, True) for rows in LOW_PASS_ROWS), key=lambda x: x[0])[1].delay
    _, passed, left = min((behind(kind, scanned, False) for kind in LOW_PASSES), key=lambda x: x[0])
    return passed if _significant(stage, behind("", 0.0, True)[2], left) else AS_LOGGED


def _lvdt_lag(stage: Stage, start: float) -> float:
    """The lag (s) of the LVDT, beyond the nominal one, that suits the actuator best, from one to ``start`` with."""
    if "lvdt_lag" not in stage.index() or fits(stage):
        return 0.0
    judge, begin = LeastSquaresProblem(stage, np.asarray(stage.floor)), stage.neutral()
    at = stage.index()["lvdt_lag"].start
    begin[at] = start
    return float(judge.fit(("lvdt_lag",), begin, 4).theta[at])


def fits(stage: Stage) -> bool:
    """Whether no search would begin."""
    judge = LeastSquaresProblem(stage, np.asarray(stage.floor))
    return not LikelihoodAcceptance(judge).fails(recalibrate(judge))
