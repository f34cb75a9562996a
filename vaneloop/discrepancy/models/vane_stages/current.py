"""The current of every tick: what the firmware's law makes of logged demand and stroke, and which of the ticks a log
shows.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import uniform_filter1d

from controller import Calibration
from hil.figures import resolution
from plant import chain
from vaneloop.base.compiled import compiled
from vaneloop.base.spline_rates import SplineRates
from vaneloop.discrepancy.models.vane_stages.raster import RASTER, WINDOW
from vaneloop.discrepancy.models.vane_stages.stroke import SMOOTH, Smooth
from vaneloop.discrepancy.stage import Array

__all__ = ["BEFORE", "DRAWS", "SAMPLED", "between_rows", "other_current", "servo_law"]

SAMPLED = "the current of the tick at each row"
DRAWS = 8  # of what the log hides: the integral wanders, so that one draw says little of a stretch of the log
BEFORE = "the mean of the ten ticks before the row"


def servo_law(
    t: Array, c: dict[str, Array], cal: Calibration, smooth: Smooth, draws: int = DRAWS
) -> tuple[Array, Array, Array]:
    """What the firmware's servo loop makes of logged demand and stroke, but for a constant of its integral.

    At the row it has the logged stroke with its noise; the nine ticks before it had other noise, so theirs is taken off
    the stroke.

    Returns the current (mA) of the ten ticks since the row before, the last at the row, float64[rows, 10]; and draws of
    how much their mean, and the last of them, are off because not all of stroke and demand is logged, each
    float64[rows, draws].
    """
    x_dem, x = c["x_dem"], c["x_lvdt"]
    gains = (cal.scalars.kp, cal.scalars.ki, cal.scalars.kff)  # A/m = mA/mm
    when = np.maximum(t[:, None] - RASTER + chain.TICK * np.arange(1, 11)[None], t[0])
    stroke = np.empty(when.shape)
    spline = SplineRates(np.arange(float(len(t))))
    _between(smooth.stroke, spline(smooth.stroke), stroke)
    between = stroke - np.interp(when.ravel(), t, smooth.stroke).reshape(when.shape)
    stroke[:, -1] = x
    law = np.empty(when.shape)
    _loop(x_dem, stroke, *gains, law)
    # not known: the LVDT's noise in nine ticks, what smoothing leaves at the rows, the way between them, which is known
    # as well as a straight line and a cubic agree, and what the logged demand's last digit hides
    draw, step = np.random.default_rng(0), resolution(x_dem)
    of_mean, of_last = np.empty((len(t), draws)), np.empty((len(t), draws))
    off, ticks = stroke, np.empty(when.shape)
    for k in range(draws):
        left = smooth.left(draw) + smooth.distortion
        _between(left, spline(left), off)
        off += between
        draw.standard_normal(out=ticks)
        ticks *= smooth.noise
        np.subtract(ticks, off, out=off)
        off[:, -1] = 0.0
        _loop(-step * draw.uniform(-0.5, 0.5, len(t)), off, *gains, ticks)
        of_mean[:, k], of_last[:, k] = ticks.mean(axis=1), ticks[:, -1]
    return law, of_mean, of_last


@compiled
def _loop(demand: Array, stroke: Array, kp: float, ki: float, kff: float, out: Array) -> None:
    """The servo loop's current at the ten ticks up to each row: its integral runs through all of them.

    demand  at each row: ticks since the row before are nine of the ramp before it, then the first of the new one
            (docs/controller.md, timing)
    stroke  at each tick, float64[rows, 10]
    """
    total = 0.0
    two = before = demand[0]
    for m in range(len(demand)):
        for i in range(10):
            ramp, rate = two + (before - two) * ((i + 2) / 10.0), (before - two) / RASTER
            if i == 9:
                ramp, rate = before + (demand[m] - before) / 10.0, (demand[m] - before) / RASTER
            e = ramp - stroke[m, i]
            total += e
            out[m, i] = kp * e + ki * total * chain.TICK + kff * rate
        two, before = before, demand[m]


@compiled
def _between(x: Array, slope: Array, out: Array) -> None:
    """A cubic spline through the rows, of these ``slope`` per row, at the ten ticks up to each row: float64[rows, 10].
    Before the first row it is the first.
    """
    out[0] = x[0]
    for m in range(1, len(x)):
        step = x[m] - x[m - 1]
        for i in range(10):
            u = (i + 1) / 10.0
            v = 1.0 - u
            out[m, i] = x[m - 1] + u * (u * (3.0 - 2.0 * u) * step + v * (v * slope[m - 1] - u * slope[m]))


def between_rows(
    c: dict[str, Array], law: Array, size: float, run: Array, cal: Calibration, unknown: Array | None, seed: int
) -> Array:
    """Current (mA) of every tick, float64[rows, 10], whose mean over a row is the logged one.

    Between two rows it is what the firmware's law makes of the stroke between them, and of the LVDT's noise in the nine
    ticks that nobody logged: any noise of that size, for it works like dither on a valve with hysteresis or overlap.
    Where the law does not hold (not in mode RUN, at the current's limit) the current is the row's mean.

    law      of `servo_law`
    size     mA, RMS of the LVDT's noise in the current
    unknown  mA, such an error as the law left in each row's mean, where that was worked out from its last tick; with
             the noise of about one tick it is added for any ``seed`` but 0
    """
    rng = np.random.default_rng(seed)
    noise = rng.standard_normal(law.shape)
    noise[:, -1] = 0.0
    slow = uniform_filter1d(c["i_cmd"] - law.mean(axis=1), SMOOTH[-1])  # the integral's constant
    ticks = law + slow[:, None] + size * noise
    # the row's own tick is known; the others' noise was such that the mean comes out
    ticks[:, :-1] += (c["i_cmd"] - ticks.mean(axis=1))[:, None] * (law.shape[1] / (law.shape[1] - 1.0))
    alone = ~run | (np.abs(c["i_cmd"]) > 0.9e3 * cal.scalars.current_limit)
    ticks[alone] = c["i_cmd"][alone, None]
    if unknown is not None and seed:
        ticks += (unknown + size * rng.standard_normal(len(law)))[:, None]
    return np.asarray(ticks)


def other_current(t: Array, c: dict[str, Array], law: Array, run: Array, cal: Calibration) -> str:
    """Where the log's current is not the mean of the ticks since the row before, the one at the row included, put that
    in its place.

    The firmware's ``law`` on the logged stroke says which it is instead (`SAMPLED`, `BEFORE`; "": neither), and what
    the other ticks added.
    """
    width = int(round(WINDOW / RASTER))
    use = run & (np.abs(c["i_cmd"]) < 0.9e3 * cal.scalars.current_limit)

    def misfit(model: Array) -> float:
        e = np.where(use, c["i_cmd"] - model, np.nan)[: len(t) // width * width].reshape(-1, width)
        e = e[np.isfinite(e).all(axis=1)]
        return float(np.median(np.std(e, axis=1))) if len(e) else 0.0

    mean = law.mean(axis=1)
    others = {SAMPLED: law[:, -1], BEFORE: mean + 0.1 * (np.roll(law[:, -1], 1) - law[:, -1])}
    what = min(others, key=lambda k: misfit(others[k]))
    if misfit(others[what]) >= 0.9 * misfit(mean):
        return ""
    c["i_cmd"] = c["i_cmd"] + (mean - others[what])
    return what
