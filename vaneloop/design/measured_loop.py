"""One stage's measured stroke-angle loop, split into its extension and its retraction curve.

    measure_loop(stroke, angle, geometry, stage) -> MeasuredLoop

Lengths in mm and angles in deg, as at every border.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import scipy
from numpy.typing import NDArray

from hil.logs import Channel, LogError
from plant import Geometry
from plant.geometry import vane_angles
from plant.linkage import (
    G_L,
    G_LB,
    G_LC,
    G_LDP,
    N_CRANK,
    N_PER_STAGE,
    STROKE_HIGH,
    STROKE_LOW,
    stage_ring_angle,
    vane_angle,
)
from vaneloop.design.links import geometry_with
from vaneloop.design.loop_fit import fit_with_width
from vaneloop.design.stroke_tables import STROKE_LIMITS

__all__ = ["MeasuredLoop", "measure_loop"]

Array = NDArray[np.float64]
DEG = 180.0 / math.pi
LEAST_MOTION = 3.0  # mm of stroke below which nothing can be said about a loop


@dataclass(frozen=True)
class MeasuredLoop:
    """One stage's measured stroke-angle loop, and what was made of it. mm, deg.

    width             total width of the loop at the vane at mid-stroke (as `hysteresis` in geometry.toml)
    width_sigma       its standard error
    offset            measured mean curve minus the geometry's, mean over the stroke covered
    lb, lc            lengths with which the model has the measured mean curve (equivalent, not necessarily what a gauge
                      would read)
    misfit            rms of what the model with lb, lc leaves of the measured mean curve
    noise             rms scatter of the angle about its branch
    drift             span of the slow drift of the angle that was taken off; None where the log has fewer than two
                      loops
    lag               s by which the angle lags the stroke
    extension_covered, retraction_covered   strokes (low, high) that each branch was measured over
    stroke            grid for the curves; extension, retraction, mean: angles on it
    samples           x, y and branch (1 extension, -1 retraction, 0 inside the gap) of the samples used, for a plot
    """

    stage: str
    width: float
    width_sigma: float
    offset: float
    lb: float
    lc: float
    misfit: float
    noise: float
    drift: float | None
    lag: float
    extension_covered: tuple[float, float]
    retraction_covered: tuple[float, float]
    stroke: Array
    extension: Array
    retraction: Array
    mean: Array
    samples: tuple[Array, Array, Array]
    notes: list[str] = field(default_factory=list)


def measure_loop(
    stroke: Channel,
    angle: Channel,
    geometry: Geometry,
    stage: str = "vigv",
    source: str = "log",
    lag: tuple[float, float] = (4e-3, 4e-3),
) -> MeasuredLoop:
    """Split one stage's measured stroke-angle loop into its extension and its retraction curve.

    stroke, angle   channels of the log: mm and deg, each with its own raster
    geometry        the mechanism as built; what the measurement does not cover follows it
    lag             s, expected lag of the angle behind the stroke (potentiometer minus LVDT) and its standard deviation

    1. Samples are told apart by a play operator on the stroke, wider than the machine's gap: only what surely lies on a
       branch counts. Dither inside the gap, partial reversals and the way across the gap are left out. The width is
       found by iteration.
    2. In the angle of the ring, where play has one width, one robust least-squares fit takes all samples at once:
       y = model(x) + c(x) -+ h(x)/2 + drift(t) - lag dy/dt; c, h piecewise linear and smooth, drift only where loops
       repeat.
    3. The equivalent Lb and Lc are those with which the model has the measured mean curve; what they leave stays in the
       curves.

    Raises LogError: no motion, one branch only, a stage that moves the wrong way, too few samples.
    """
    k = geometry.vanes.index(stage)
    t, x, y = _aligned(stroke, angle, stage, source)
    travel = float(np.ptp(np.quantile(x, [0.001, 0.999])))
    if travel < LEAST_MOTION:
        raise LogError(
            f"{source}: x_lvdt moves only {travel:.3g} mm ({x.min():.4g} to {x.max():.4g} mm): no motion to see a loop "
            f"in; at least {LEAST_MOTION:g} mm is needed"
        )
    g = geometry.arrays()
    o = N_CRANK + k * N_PER_STAGE
    ldp, lever = float(g[o + G_LDP]), float(g[o + G_L])
    scale = DEG * ldp / lever  # ring angle -> deg at the vane about mid-range
    ring = np.arctan(lever * np.sin(np.deg2rad(y)) / ldp) * scale  # equation (16) read backwards
    grid = np.arange(STROKE_LOW * 1e3, STROKE_HIGH * 1e3 + 1e-9, 0.05)
    model_ring = np.array([stage_ring_angle(v * 1e-3, g, k) for v in grid]) * scale
    slope = np.gradient(model_ring, grid)
    outside = (x < grid[0]) | (x > grid[-1])
    if outside.mean() > 0.02:
        worst = x[outside][int(np.argmax(np.abs(x[outside] - 24.0)))]
        raise LogError(
            f"{source}: x_lvdt (={worst:.4g} mm) must be in [{grid[0]:g}, {grid[-1]:g}] mm; is its unit right?"
        )
    _right_way(x, y, grid, np.rad2deg(vane_angles(grid * 1e-3, g)[:, k]), stage, source)

    tolerance = min(max(5.0 * _raster_noise(x), 0.02), 0.2)
    r = ring - np.interp(x, grid, model_ring)
    s = np.interp(x, grid, slope)
    v = _rate(t, x)
    fit = fit_with_width(t, x, r, s, v, travel, tolerance, lag, stage, source)

    # curves on the grid, at the ring, relative to the model as built
    centre, gap = fit.on(grid)
    covered = (max(fit.low, grid[0]), min(fit.high, grid[-1]))
    inside = (grid >= covered[0]) & (grid <= covered[1])
    lb, lc = _equivalent(geometry, k, grid[inside][::10], (model_ring + centre)[inside][::10], scale)
    fitted = geometry_with(geometry, {stage: {"lb": lb, "lc": lc}}, check=False).arrays()
    fitted_ring = np.array([stage_ring_angle(x * 1e-3, fitted, k) for x in grid]) * scale
    rest = (model_ring + centre - fitted_ring)[inside]
    rest_on = np.interp(grid, grid[inside], rest)  # held beyond what was measured
    middle = fitted_ring + rest_on
    rings = (middle - 0.5 * gap, middle + 0.5 * gap, middle)
    curves = [_rising(np.array([vane_angle(q / scale, ldp, lever) for q in c]) * DEG) for c in rings]
    width = float(np.mean(gap[inside]))
    notes = []
    if fit.drift is None:
        notes.append(
            "fewer than two loops there and back: a drift of the angle cannot be distinguished from the loop's width"
        )
    reach = min(fit.covered[1][1], fit.covered[-1][1]), max(fit.covered[1][0], fit.covered[-1][0])
    if covered[0] > STROKE_LIMITS[0] + 3.0 or covered[1] < STROKE_LIMITS[1] - 4.0:
        notes.append(
            f"measured from {covered[0]:.1f} to {covered[1]:.1f} mm (both branches {reach[1]:.1f} to {reach[0]:.1f}); "
            "beyond, the curves follow the geometry"
        )
    keep = np.linspace(0, x.size - 1, min(x.size, 20_000)).astype(int)
    base = np.rad2deg(vane_angles(grid * 1e-3, g)[:, k])
    return MeasuredLoop(
        stage=stage,
        width=width,
        width_sigma=fit.gap_sigma,
        offset=float(np.mean((curves[2] - base)[inside])),
        lb=lb,
        lc=lc,
        misfit=float(np.sqrt(np.mean(rest**2))),
        noise=fit.noise,
        drift=fit.drift,
        lag=fit.lag,
        extension_covered=fit.covered[1],
        retraction_covered=fit.covered[-1],
        stroke=grid,
        extension=curves[0],
        retraction=curves[1],
        mean=curves[2],
        samples=(x[keep], y[keep], fit.branch[keep].astype(float)),
        notes=notes,
    )


def _aligned(stroke: Channel, angle: Channel, stage: str, source: str) -> tuple[Array, Array, Array]:
    """Time, stroke and angle on the angle's raster, single spikes and gaps of the stroke left out."""
    if len(stroke.t) < 20 or len(angle.t) < 20:
        name, n = ("x_lvdt", len(stroke.t)) if len(stroke.t) < 20 else (stage, len(angle.t))
        raise LogError(f"{source}: {name} has {n} samples; a loop needs at least 20")
    if not (np.isfinite(stroke.values).all() and np.isfinite(angle.values).all()):
        raise LogError(f"{source}: {stage}: samples must be finite")
    x_all = _without_spikes(stroke.values)
    gap = max(0.5, 5.0 * float(np.median(np.diff(stroke.t))))
    i = np.clip(np.searchsorted(stroke.t, angle.t, side="right"), 1, len(stroke.t) - 1)
    good = (angle.t >= stroke.t[0]) & (angle.t <= stroke.t[-1]) & (stroke.t[i] - stroke.t[i - 1] <= gap)
    if good.sum() < 20:
        raise LogError(
            f"{source}: {stage} and x_lvdt have {int(good.sum())} samples at the same time; a loop needs at least 20"
        )
    t = angle.t[good]
    return t, np.interp(t, stroke.t, x_all), angle.values[good]


def _without_spikes(x: Array) -> Array:
    """The stroke without leaps of one to three samples, which no actuator makes: they would reset the play that tells
    branches apart.

    A leap is 0.3 mm and more than a usual step off the median of the seven samples around it and off both lines,
    through the two samples before and the two after it; the corner of a ramp lies on one of them.
    """
    least = 0.3 + float(np.quantile(np.abs(np.diff(x)), 0.8))
    far = np.abs(x - scipy.ndimage.median_filter(x, 7, mode="nearest")) > least
    good = np.flatnonzero(~far)
    if good.size < 4:
        return x
    at = np.flatnonzero(far)
    i = np.clip(np.searchsorted(good, at), 2, good.size - 2)
    off = np.ones(at.size, bool)
    for a, b in ((good[i - 2], good[i - 1]), (good[i + 1], good[i])):  # the nearest sound samples before, and after
        off &= np.abs(x[at] - (x[b] + (x[b] - x[a]) / (b - a) * (at - b))) > least
    sound = np.ones(x.size, bool)
    sound[at[off]] = False
    return np.interp(np.arange(x.size), np.flatnonzero(sound), x[sound])


def _raster_noise(x: Array) -> float:
    """Rms of what changes from sample to sample: third differences, by their median (a dither of some samples a period
    hardly counts).
    """
    d = np.diff(x, 3)
    return float(np.median(np.abs(d))) / (0.6745 * math.sqrt(20.0)) if d.size else 0.0


def _right_way(x: Array, y: Array, grid: Array, model: Array, stage: str, source: str) -> None:
    """Refuse a stage whose angle does not follow the stroke roughly as the mechanism says: a wrong sign, channel or
    unit.
    """
    if np.ptp(y) == 0.0:
        raise LogError(
            f"{source}: {stage} stays at {y[0]:.4g} deg while x_lvdt moves from {x.min():.4g} to {x.max():.4g} mm"
        )
    edges = np.linspace(x.min(), x.max(), 25)
    bins = np.clip(np.digitize(x, edges) - 1, 0, 23)
    used = np.unique(bins)
    if used.size < 3:
        return
    xm = np.array([np.median(x[bins == b]) for b in used])
    ym = np.array([np.median(y[bins == b]) for b in used])
    measured = float(np.polyfit(xm, ym, 1)[0])
    expected = float(np.polyfit(xm, np.interp(xm, grid, model), 1)[0])
    if not 0.4 <= measured / expected <= 2.5:
        raise LogError(
            f"{source}: {stage} changes by {measured:.3g} deg/mm of stroke between {x.min():.4g} and {x.max():.4g} mm, "
            f"the geometry gives {expected:.3g}; allowed: 0.4 to 2.5 times that (sign, unit or name of a channel?)"
        )


def _rate(t: Array, x: Array) -> Array:
    """dx/dt, mm/s, over about 50 ms."""
    dt = float(np.median(np.diff(t)))
    n = max(1, int(round(0.025 / dt)) if dt > 0 else 1)
    a, b = np.maximum(np.arange(t.size) - n, 0), np.minimum(np.arange(t.size) + n, t.size - 1)
    return (x[b] - x[a]) / np.maximum(t[b] - t[a], 1e-9)


def _equivalent(geometry: Geometry, k: int, stroke: Array, ring: Array, scale: float) -> tuple[float, float]:
    """Lb and Lc, mm, of stage k with which the model's ring has the measured mean curve; a short stroke moves Lb little
    (weak prior).
    """
    stage = geometry.stages()[k]
    g = geometry.arrays()
    o = N_CRANK + k * N_PER_STAGE

    def residual(change: Array) -> Array:
        h = g.copy()
        h[o + G_LB] += change[0] * 1e-3
        h[o + G_LC] += change[1] * 1e-3
        model = np.array([stage_ring_angle(x * 1e-3, h, k) for x in stroke]) * scale
        return np.concatenate([(model - ring) / math.sqrt(stroke.size), 0.003 * change])

    low = [-0.8 * stage.lb.value, -0.2 * stage.lc.value]
    change = scipy.optimize.least_squares(
        residual, np.zeros(2), bounds=(low, [200.0, 200.0]), diff_step=1e-4, x_scale=[1.0, 1.0]
    ).x
    return stage.lb.value + float(change[0]), stage.lc.value + float(change[1])


def _rising(y: Array) -> Array:
    """The curve made strictly rising, so that it has an inverse."""
    return np.maximum.accumulate(y) + 1e-9 * np.arange(y.size)
