"""The current of every tick: what the firmware's law makes of logged demand and stroke, and which of the ticks a log
shows.
"""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import uniform_filter1d

from controller import Calibration
from plant import chain
from vaneloop.discrepancy.models.vane_stages.raster import RASTER, WINDOW
from vaneloop.discrepancy.models.vane_stages.stroke import SMOOTH, Smooth
from vaneloop.discrepancy.stage import Array

__all__ = ["BEFORE", "SAMPLED", "between_rows", "other_current", "servo_law"]

SAMPLED = "the current of the tick at each row"
BEFORE = "the mean of the ten ticks before the row"


def servo_law(t: Array, c: dict[str, Array], cal: Calibration, smooth: Smooth) -> tuple[Array, Array]:
    """What the firmware's servo loop makes of logged demand and stroke, but for a constant of its integral.

    At the row it has the logged stroke with its noise; the nine ticks before it had other noise, so theirs is taken off
    the stroke.

    Returns the current (mA) of the ten ticks since the row before, the last at the row, float64[rows, 10]; and a draw
    of how much they are off because the stroke between two rows is not logged, of the same shape.
    """
    x_dem, x = c["x_dem"], c["x_lvdt"]
    kp, ki, kff = (cal.scalars.kp, cal.scalars.ki, cal.scalars.kff)  # A/m = mA/mm
    # ticks since the last row: nine of the ramp before, the first of the new one (docs/controller.md, timing)
    before, two = np.roll(x_dem, 1), np.roll(x_dem, 2)
    before[0], two[:2] = x_dem[0], x_dem[0]
    ramp = two[:, None] + (before - two)[:, None] * (np.arange(2, 12) / 10.0)[None]
    ramp[:, -1] = before + (x_dem - before) / 10.0
    rate = np.repeat((before - two)[:, None], 10, axis=1) / RASTER
    rate[:, -1] = (x_dem - before) / RASTER
    when = np.maximum(t[:, None] - RASTER + chain.TICK * np.arange(1, 11)[None], t[0])
    stroke = CubicSpline(t, smooth.stroke)(when)
    straight = np.interp(when.ravel(), t, smooth.stroke).reshape(when.shape)
    stroke[:, -1] = straight[:, -1] = x
    error = ramp - stroke

    def loop(e: Array) -> Array:
        return np.asarray(kp * e + ki * np.cumsum(e).reshape(e.shape) * chain.TICK)

    # not known: the LVDT's noise in nine ticks, what smoothing leaves at the rows, and the way between them, which is
    # known as well as a straight line and a cubic agree
    noise = smooth.noise * np.random.default_rng(0).standard_normal((len(t), 10))
    off = CubicSpline(t, smooth.left + smooth.distortion)(when) - noise + (stroke - straight)
    off[:, -1] = 0.0
    return loop(error) + kff * rate, loop(off)


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
