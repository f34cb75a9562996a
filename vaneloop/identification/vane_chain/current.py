"""The current of every tick: what the firmware's law makes of logged demand and stroke, and which of the ticks a log
shows.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
import scipy

from controller import Calibration
from hil.figures import noise_floor
from plant import Plant, chain, places
from plant.parameters import NAMES, derive
from plant.stages import actuator_run, step_currents
from plant.stages.blocks import NOTHING
from vaneloop.base.compiled import compiled
from vaneloop.base.spline_rates import SplineRates
from vaneloop.identification.settings import (
    CURRENT_DRAWS,
    CURRENT_LAGS,
    FLOW_BENDS,
    OTHER_CURRENT,
    RASTER,
    SMOOTH_ORDER,
    SMOOTH_ROWS,
    SMOOTH_WINDOW,
    SUBSTEPS,
    TRIANGLE_ROWS,
    WINDOW,
)
from vaneloop.identification.subsystem import Array
from vaneloop.identification.vane_chain.low_pass import AS_LOGGED, LowPass, lagged
from vaneloop.identification.vane_chain.resample import last_digit

__all__ = [
    "BEFORE", "LOGGED_CURRENT", "SAMPLED", "SLOW_CURRENTS", "Smooth", "between_rows", "law_of", "other_current",
    "samples_of", "servo_law", "taken", "without_noise",
]  # fmt: skip

SAMPLED = "the current at single ticks"
BEFORE = "the mean of the ten ticks before the row"
LOGGED_CURRENT = "logged current"  # a column: mA, as logged, where the mean was worked out from it


def servo_law(
    t: Array,
    c: dict[str, Array],
    cal: Calibration,
    smooth: Smooth,
    digits: Mapping[str, float],
    draws: int = CURRENT_DRAWS,
    samples: int = 1,
    behind: LowPass = AS_LOGGED,
) -> tuple[Array, Array, Array]:
    """What the firmware's servo loop makes of logged demand and stroke, but for a constant of its integral.

    At the row it has the logged stroke with its noise; the nine ticks before it had other noise, so theirs is taken off
    the stroke.

    digits  steps of the last digits of ``x_lvdt`` and ``x_dem`` (mm)
    behind  the low-pass that stroke and current have passed and the demand has not. The law is linear: with the demand
            behind the same low-pass it holds for what was logged

    Returns the current (mA) of the ten ticks since the row before, the last at the row, float64[rows, 10]; and draws of
    how much their mean, and that of the ticks that `samples_of` gives for ``samples``, are off because not all of
    stroke and demand is logged, each float64[rows, draws].
    """
    x_dem, x = c["x_dem"], np.where(_known(c), c["x_lvdt"], smooth.stroke)
    gains = (cal.scalars.kp, cal.scalars.ki, cal.scalars.kff)  # A/m = mA/mm
    when = np.maximum(t[:, None] - RASTER + chain.TICK * np.arange(1, 11)[None], t[0])
    stroke = np.empty(when.shape)
    spline = SplineRates(np.arange(float(len(t))))
    _between(smooth.stroke, spline(smooth.stroke), stroke)
    between = stroke - np.interp(when.ravel(), t, smooth.stroke).reshape(when.shape)
    law = law_of(x_dem, smooth.stroke, cal, x, behind)
    # not known: the LVDT's noise in nine ticks, what smoothing leaves at the rows, the way between them, which is known
    # as well as a straight line and a cubic agree, and what the last digits of logged demand and stroke hide
    draw = np.random.default_rng(0)
    of_stroke, of_demand = (last_digit(v, digits.get(name, 0.0)) for v, name in ((x, "x_lvdt"), (x_dem, "x_dem")))
    of_mean, of_some = np.empty((len(t), draws)), np.empty((len(t), draws))
    off, ticks = stroke, np.empty(when.shape)
    for k in range(draws):
        digit = of_stroke(draw)
        left = smooth.left(draw, digit) + smooth.distortion
        _between(left, spline(left), off)
        off += between
        draw.standard_normal(out=ticks)
        ticks *= smooth.white(digit)
        np.subtract(ticks, off, out=off)
        off[:, -1] = -digit
        _loop(*_demanded(of_demand(draw), behind), off, *gains, ticks)
        of_mean[:, k], of_some[:, k] = ticks.mean(axis=1), samples_of(ticks, samples)
    return law, of_mean, of_some


def law_of(
    x_dem: Array, stroke: Array, cal: Calibration, logged: Array | None = None, behind: LowPass = AS_LOGGED
) -> Array:
    """The servo loop's current (mA) at the ten ticks up to each row for a demand and a stroke (mm) at the rows, but for
    a constant of its integral: linear in both. ``logged``: the stroke at the rows with its noise, which it had there;
    ``behind``: see `servo_law`.
    """
    ticks, out = np.empty((len(stroke), 10)), np.empty((len(stroke), 10))
    _between(stroke, SplineRates(np.arange(float(len(stroke))))(stroke), ticks)
    if logged is not None:
        ticks[:, -1] = logged
    _loop(*_demanded(x_dem, behind), ticks, cal.scalars.kp, cal.scalars.ki, cal.scalars.kff, out)
    return out


def _demanded(x_dem: Array, behind: LowPass) -> tuple[Array, Array]:
    """Demand and its rate at each tick, float64[rows, 10]: since the row before, nine ticks of the ramp before it, then
    the first of the new one (docs/controller.md, timing).
    """
    before = np.concatenate([x_dem[:1], x_dem[:-1]])
    two = np.concatenate([x_dem[:1], before[:-1]])
    rate = np.repeat(((before - two) / RASTER)[:, None], 10, axis=1)
    rate[:, 9] = (x_dem - before) / RASTER
    ramp = two[:, None] + (before - two)[:, None] * (np.arange(2, 12) / 10.0)
    ramp[:, 9] = before + (x_dem - before) / 10.0
    return (ramp, rate) if behind == AS_LOGGED else (behind.of(ramp), behind.of(rate))


@compiled
def _loop(demand: Array, rate: Array, stroke: Array, kp: float, ki: float, kff: float, out: Array) -> None:
    """The servo loop's current at the ten ticks up to each row, of demand, its rate and stroke at each of them: its
    integral runs through all of them.
    """
    total = 0.0
    for m in range(len(demand)):
        for i in range(10):
            e = demand[m, i] - stroke[m, i]
            total += e
            out[m, i] = kp * e + ki * total * chain.TICK + kff * rate[m, i]


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
    c: dict[str, Array],
    law: Array,
    size: float,
    run: Array,
    cal: Calibration,
    errors: tuple[Array, Array] | None,
    seed: int,
) -> Array:
    """Current (mA) of every tick, float64[rows, 10], whose mean over a row is the logged one.

    Between two rows it is what the firmware's law makes of the stroke between them, and of the LVDT's noise in the nine
    ticks that nobody logged: any noise of that size, for it works like dither on a valve with hysteresis or overlap.
    Where the law does not hold (not in mode RUN, at the current's limit) the current is the row's mean; where samples
    of the row are missing, it is the law's.

    law     of `servo_law`
    size    mA, RMS of the LVDT's noise in the current
    errors  mA, draws of the law's errors in a row's mean and in its logged samples, of `servo_law`, where the mean was
            worked out from samples. The mean is then off by the one error less the other and by the recorder's noise:
            as much as the samples are off the law from row to row beyond its errors. Any ``seed`` but 0 adds both
    """
    rng = np.random.default_rng(seed)
    noise = rng.standard_normal(law.shape)
    noise[:, -1] = 0.0
    known = _known(c)
    alone = ~run | (np.abs(c["i_cmd"]) > 0.9e3 * cal.scalars.current_limit)
    held = known & ~alone
    off = c["i_cmd"] - law.mean(axis=1)
    slow = _mean_of(off, held, SMOOTH_ROWS[-1])  # the integral's constant, another one behind each gap
    ticks = law + slow[:, None] + size * noise
    # the row's own tick is known; the others' noise was such that the mean comes out
    more = np.where(known, c["i_cmd"] - ticks.mean(axis=1), 0.0)
    ticks[:, :-1] += more[:, None] * (law.shape[1] / (law.shape[1] - 1.0))
    ticks[alone] = c["i_cmd"][alone, None]
    if errors is not None and seed:
        of_mean, of_some = errors
        both = held[1:] & held[:-1]  # from row to row: what changes slowly is the stroke's, and cancels in the mean
        power = 0.5 * (_power(np.diff(off)[both]) - _power(np.diff(of_some, axis=0)[both]))
        recorders = np.sqrt(max(power, 0.0)) * rng.standard_normal(len(law))
        ticks += (of_mean[:, 0] - of_some[:, 0] + recorders)[:, None]
    if seed:  # where samples are missing, straight lines are as likely
        ticks[~known] = c["i_cmd"][~known, None]
    return np.asarray(ticks)


def samples_of(ticks: Array, samples: int) -> Array:
    """What a logger makes of the ten ticks of a row that takes so many evenly spaced ``samples`` of them, the last at
    the row: their mean.
    """
    return np.asarray(ticks[:, np.ceil(10.0 / samples * np.arange(1, samples + 1)).astype(int) - 1].mean(axis=1))


def taken(ticks: Array, samples: int) -> dict[str, Array]:
    """What each way of a logger takes of the ticks since the row before, float64[rows, 10]: their mean, first, and
    others by their names. Samples of all ten ticks are their mean.
    """
    mean = ticks.mean(axis=1)
    some = {SAMPLED: samples_of(ticks, samples)} if samples < ticks.shape[1] else {}
    return {"": mean, **some, BEFORE: mean + 0.1 * (np.roll(ticks[:, -1], 1) - ticks[:, -1])}


def other_current(t: Array, c: dict[str, Array], law: Array, run: Array, cal: Calibration, samples: int) -> str:
    """Where the log's current is not the mean of the ticks since the row before, the one at the row included, put that
    in its place.

    The firmware's ``law`` on the logged stroke says which it is instead (`SAMPLED`, `BEFORE`; "": neither), and what
    the other ticks added.

    samples  of the current that the log has between two rows, whose mean stands there
    """
    use = run & (c["missing"] == 0.0) & (np.abs(c["i_cmd"]) < 0.9e3 * cal.scalars.current_limit)
    window = (np.arange(len(t)) // round(WINDOW / RASTER))[use]
    count = np.bincount(window)
    most = count > 0.5 * WINDOW / RASTER

    def misfit(model: Array) -> float:
        e = (c["i_cmd"] - model)[use]
        mean, square = (np.bincount(window, x)[most] / count[most] for x in (e, e * e))
        return float(np.median(np.sqrt(np.maximum(square - mean**2, 0.0)))) if most.any() else 0.0

    ways = taken(law, samples)
    what = min((k for k in ways if k), key=lambda k: misfit(ways[k]))
    if misfit(ways[what]) >= OTHER_CURRENT * misfit(ways[""]):
        return ""
    c[LOGGED_CURRENT] = c["i_cmd"]
    c["i_cmd"] = c["i_cmd"] + (ways[""] - ways[what])
    return what


def _line_between(i: Array) -> Array:
    return np.concatenate([i[:1], 0.5 * (i[:-1] + i[1:])])


def _held(i: Array) -> Array:
    return np.concatenate([i[:1], i[:-1]])


# What a current may be that was logged more slowly than the controller's frames, and the mean since the row before that
# follows from it.
SLOW_CURRENTS: Mapping[str, Callable[[Array], Array]] = {
    "the current at single ticks": _line_between, "the current from each row on": _held,
}  # fmt: skip


# ---- The logged stroke with less of the LVDT's noise in it


class Smooth(NamedTuple):
    """Stroke (mm) at the rows with less of the LVDT's noise; its RMS (mm); over how many rows it is smoothed; errors
    (mm) such as smoothing makes; RMS (mm) of what the model of the motion is off by from row to row.

    off: mm, the logged stroke less the fitted model's, whose motion is mostly gone.
    """

    stroke: Array
    noise: float
    rows: int
    distortion: Array
    uneven: Array
    off: Array

    def left(self, draw: np.random.Generator, digit: Array) -> Array:
        """Error (mm) such as noise and model leave in the stroke at the rows: one draw; ``digit``: what rounding of the
        logged one has made of it.
        """
        noise = self.white(digit) * draw.standard_normal(len(self.off))
        uneven = self.uneven * draw.standard_normal(len(self.off))
        return np.asarray(self.smoothed(noise + digit) + uneven)

    def white(self, digit: Array) -> float:
        """RMS (mm) of the LVDT's noise without what rounding has made of it."""
        return float(np.sqrt(max(self.noise**2 - float(np.mean(digit**2)), 0.0)))

    def smoothed(self, values: Array) -> Array:
        """What is left of ``values`` where the stroke was smoothed."""
        return _smoothed(values, self.rows)


def without_noise(t: Array, c: dict[str, Array], machine: Plant, known: Array = NOTHING) -> Smooth:
    """The logged stroke with less of the LVDT's noise in it: the nominal model's, plus what it is off by, smoothed.

    The model takes the motion out, so that what is smoothed changes slowly; over how many rows, is decided by
    leave-one-out errors.

    known  signals of the machine's curves (`plant.curve.take`)
    """
    dt = float(t[1] - t[0])
    p = machine.p.copy()
    p[NAMES.index("actuator.stroke")] = 2e3  # the stops out of the way: a wrong null runs away in minutes
    derive(p, dt / SUBSTEPS, dt)
    s = np.zeros((chain.N_STATE, 1))
    s[places.X] = s[places.X_LVDT] = s[places.READING] = 1e3
    out = np.empty((len(t), 1))
    n_r = np.ascontiguousarray(c.get("n_r", np.zeros(len(t))))
    current = step_currents(c["i_cmd"] * 1e-3, dt, SUBSTEPS)
    actuator_run(current, n_r, np.ascontiguousarray(c["p_s"] * 1e6), np.ascontiguousarray(c["t_oil"]), dt, p, s, out,
                 known=known)  # fmt: skip
    step = np.diff(out[:, 0], prepend=1e3) * 1e3
    logged = np.diff(c["x_lvdt"], prepend=c["x_lvdt"][0])
    whole = scipy.ndimage.uniform_filter1d(c["fresh"], 5) > 0.999  # rows with their neighbours
    calibrated = _calibrated(step, dt, logged, whole)
    model = np.cumsum(np.where(whole, calibrated, logged))  # over a gap the model goes where the stroke went
    known_rows = _known(c)
    off = _bridged(c["x_lvdt"] - model, known_rows)
    tried = []
    for rows in SMOOTH_ROWS:
        smooth, own = _smoothed(off, rows), _weights(rows)[rows // 2]
        left = float(np.mean((off - smooth) ** 2)) / (1.0 - own)  # white noise leaves 1 - own of its power
        tried.append((left / (1.0 - own), rows, np.sqrt(left), smooth))
    _, rows, size, smooth = min(tried, key=lambda x: x[0])
    noise = min(noise_floor(t, np.where(whole, off, np.nan)), size)
    half = rows // 4 * 2 + 1
    differs = smooth - _smoothed(off, half)
    fast = known_rows & (np.abs(differs) > 2.0 * noise)  # rather noisy than wrong
    wide, narrow, as_is = _weights(rows), np.zeros(rows), np.zeros(rows)
    narrow[(rows - half) // 2 : (rows + half) // 2] = _weights(half)
    as_is[rows // 2] = 1.0
    around = int(round(SMOOTH_WINDOW / dt))
    bent = np.maximum(
        _above_noise(differs, wide - narrow, noise, around), _above_noise(off - smooth, as_is - wide, noise, around)
    )
    distortion = differs * np.sqrt(bent / np.maximum(scipy.ndimage.uniform_filter1d(differs**2, around), 1e-300))
    # and what the model of the motion leaves at each row, in proportion to how fast the motion changes: least squares
    jerky = scipy.ndimage.uniform_filter1d(
        (calibrated - scipy.ndimage.uniform_filter1d(calibrated, SMOOTH_ROWS[0])) ** 2, around
    )
    jerky = np.maximum(jerky, 0.0)  # a running sum of squares may end a rounding below 0
    weights = as_is - wide
    more = (off - smooth) ** 2 - float(weights @ weights) * noise**2 - bent
    share = max(0.0, float(more[whole] @ jerky[whole]) / max(float(jerky[whole] @ jerky[whole]), 1e-300))
    uneven = np.sqrt(share * jerky)
    stroke, distortion = np.where(fast, c["x_lvdt"], model + smooth), np.where(fast, off - smooth, distortion)
    return Smooth(stroke, noise, rows, distortion, uneven, off)


def _known(c: Mapping[str, Array]) -> Array:
    """Rows that have their samples, and those in a gap, which count nowhere: bool[rows]."""
    return np.asarray((c["missing"] == 0.0) | (c["fresh"] == 0.0))


def _power(values: Array) -> float:
    """Mean square; 0 of no values."""
    return float(np.mean(values**2)) if values.size else 0.0


def _mean_of(values: Array, held: Array, rows: int) -> Array:
    """Mean of those of ``rows`` around each row that are ``held``, with straight lines where none is."""
    share = scipy.ndimage.uniform_filter1d(held.astype(float), rows)
    mean = scipy.ndimage.uniform_filter1d(np.where(held, values, 0.0), rows) / np.maximum(share, 1.0 / rows)
    return _bridged(mean, share > 0.5 / rows)


def _bridged(values: Array, known: Array) -> Array:
    """Values with straight lines over the rows that are not ``known``."""
    if known.all() or not known.any():
        return values
    at = np.arange(len(values))
    return np.interp(at, at[known], values[known])


def _calibrated(step: Array, dt: float, logged: Array, whole: Array) -> Array:
    """The model's steps (mm), with the flow of both directions as a curve, its lags and null as suit the ``logged``
    ones best in the rows that are ``whole``.

    Least squares by triangles of the rows piece by piece, which stay in the processor's cache.
    """
    bends = [0.0, *np.quantile(np.abs(step), FLOW_BENDS)]
    late = [lagged(step, 1.0 - np.exp(-dt / lag)) for lag in CURRENT_LAGS]
    around = np.concatenate([step[-1:], step, step[:1]])
    pieces, triangles = [], []
    for i in range(0, len(step), TRIANGLE_ROWS):
        at = slice(i, i + TRIANGLE_ROWS)
        steps = around[i : i + TRIANGLE_ROWS + 2]
        sides = [np.maximum(side * steps - bend, 0.0) for side in (1.0, -1.0) for bend in bends]
        shifted = [moved for side in sides for moved in (side[2:], side[1:-1], side[:-2])]
        null = np.ones(len(shifted[0]))
        pieces.append(np.array([*shifted, *(x[at] for x in late), null, logged[at]]))
        triangles.append(np.linalg.qr(pieces[-1][:, whole[at]].T, mode="r"))
    r = np.asarray(np.linalg.qr(np.concatenate(triangles), mode="r"))  # its singular values are those of all rows
    shares = np.linalg.lstsq(r[:, :-1], r[:, -1], rcond=None)[0]
    return np.concatenate([shares @ piece[:-1] for piece in pieces])


# The filters of Savitzky and Golay are `scipy.signal`'s, whose import takes half a second of processor time.


def _weights(rows: int) -> Array:
    """Weights over ``rows`` of a cubic fitted to them, for its value in their middle."""
    x = np.arange(rows // 2, -(rows // 2) - 1, -1.0)
    return np.asarray(scipy.linalg.lstsq(x ** np.arange(SMOOTH_ORDER + 1)[:, None], np.eye(SMOOTH_ORDER + 1)[0])[0])


def _smoothed(x: Array, rows: int) -> Array:
    """A cubic fitted over ``rows`` around each row; the first and the last half of them lie on one cubic."""
    out, half, at = np.asarray(scipy.ndimage.convolve1d(x, _weights(rows), mode="constant")), rows // 2, np.arange(rows)
    out[:half] = np.polyval(np.polyfit(at, x[:rows], SMOOTH_ORDER), at[:half])
    out[-half:] = np.polyval(np.polyfit(at, x[-rows:], SMOOTH_ORDER), at[-half:])
    return out


def _above_noise(values: Array, weights: Array, noise: float, around: int) -> Array:
    """Mean square of ``values`` over ``around`` rows above what white noise gives them; 0 where it may be noise.

    ``values`` are the logged ones under a filter of these ``weights`` w, which leaves noise^2 sum(w^2) of white noise.
    The mean square of that scatters by sqrt(2 / around sum(rho^2)) of it, rho the autocorrelation of the weights; what
    is above by three times as much is not noise.
    """
    alike = np.correlate(weights, weights, "full") / (weights @ weights)
    chance = noise**2 * float(weights @ weights)
    power = scipy.ndimage.uniform_filter1d(values**2, around)
    return np.where(power > chance * (1.0 + 3.0 * np.sqrt(2.0 / around * float(alike @ alike))), power - chance, 0.0)
