"""The stepwise scheduling method: mechanism -> VIGV strokes -> links of VGV1 and VGV2 -> measured loop -> two curves ->
tables.

Source: Kim & Ki, Appl. Sci. 2020, 10, 6643, sections 4 and 5, figures 7 to 13. Pure functions: inputs in, a dataclass
out; the command line is `vaneloop.cli.schedule`, the page `vaneloop.pages.schedule`. Lengths in mm and angles in deg,
as at every border; rotor speed in per cent.

    schedule(geometry, schedules, log=...) -> ScheduleResult       everything below in one call
    measure_loop(stroke, angle, geometry, stage) -> MeasuredLoop    one stage's loop split into its two curves
    adjust_links(geometry, schedules, ...) -> list[LinkChange]      Lb and Lc that best meet the schedules
    stroke_tables(geometry, schedules) -> float64[4, n]             the controller's tables from the model's play
    vane_angle_table(geometry) -> float64[4, n]                     what the strategies inverse and adaptive know of the
                                                                    linkage
    write_tables(result, folder)                                    stroke_tables.toml, vane_angles.toml, geometry.toml,
                                                                    schedules.toml
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares

from hil.logs import Channel, Log, LogError
from plant import Geometry, Schedules
from plant.geometry import WORKING_SPEED, Stage, stroke_for_vigv, vane_angles
from plant.linkage import (
    G_L,
    G_LB,
    G_LC,
    G_LDP,
    N_CRANK,
    N_PER_STAGE,
    STAGES,
    STROKE_HIGH,
    STROKE_LOW,
    check_assembly,
    stage_ring_angle,
    stage_vane_angle,
    vane_angle,
)
from vaneloop.base.compiled import compiled
from vaneloop.base.errors import InputError

__all__ = [
    "CRITERIA",
    "LinkChange",
    "MeasuredLoop",
    "ScheduleOptions",
    "ScheduleResult",
    "adjust_links",
    "measure_loop",
    "result_json",
    "schedule",
    "stroke_tables",
    "table_speeds",
    "vane_angle_table",
    "write_stroke_tables",
    "write_tables",
    "write_vane_angles",
]

Array = NDArray[np.float64]
Criterion = Literal["rms", "max", "design"]
CRITERIA = ("rms", "max", "design")
DEG = 180.0 / math.pi
DESIGN_SPEED = 100.0  # %
STROKE_LIMITS = (0.0, 48.0)  # mm, the actuator's stops

LEAST_MOTION = 3.0  # mm of stroke below which nothing can be said about a loop
LEAST_OVERLAP = 1.0  # mm of stroke that both branches must have in common
KNOT = 2.0  # mm between the knots of a measured curve: finer than the linkage bends, coarser than scatter
MAX_SAMPLES = 6_000  # samples that enter a fit; longer logs are averaged in groups
MAX_CANDIDATES = 200_000  # pairs of lengths tried


# ---------------------------------------------------------------- what comes in and goes out


@dataclass(frozen=True)
class ScheduleOptions:
    """What may be changed, by how much, and what counts as good.

    step       mm, lengths change by multiples of it (manufacturing)
    lb_range   mm, largest change of a bell crank's lower arm
    lc_range   mm, largest change of a vertical link
    adjust     the lengths that may change, out of lb and lc
    criterion  rms or max of the error over the working speeds (40 to 102 %), or design: error at 100 % plus rms
    limit      deg, largest error of VGV1 and VGV2 at a working speed; a schedule that no length brings below it is
               refused
    """

    step: float = 0.5
    lb_range: float = 5.0
    lc_range: float = 5.0
    adjust: tuple[str, ...] = ("lb", "lc")
    criterion: Criterion = "rms"
    limit: float = 1.0

    def check(self) -> None:
        """Raise InputError for an option out of range."""
        for name, value, low, high in (
            ("step", self.step, 1e-3, 50.0),
            ("lb-range", self.lb_range, 0.0, 100.0),
            ("lc-range", self.lc_range, 0.0, 100.0),
        ):
            if not low <= value <= high:
                raise InputError(f"--{name} (={value:g} mm) must be in [{low:g}, {high:g}]")
        if not 0.0 < self.limit <= 180.0:
            raise InputError(f"--limit (={self.limit:g} deg) must be in (0, 180]")
        if self.criterion not in CRITERIA:
            raise InputError(f"--criterion (={self.criterion!r}) must be one of {', '.join(CRITERIA)}")
        for name in self.adjust:
            if name not in ("lb", "lc"):
                raise InputError(f"--adjust: {name!r} is not a length that can be adjusted; allowed: lb, lc, none")
        pairs = (2 * int(self.lb_range / self.step) + 1) * (2 * int(self.lc_range / self.step) + 1)
        if pairs > MAX_CANDIDATES:
            raise InputError(
                f"--step (={self.step:g} mm) is too fine for the ranges: {pairs:,} pairs of lengths; limit "
                f"{MAX_CANDIDATES:,}"
            )


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

    def stroke_for(self, angle: Array, branch: str = "mean") -> Array:
        """Inverse of a curve: strokes, mm, for angles in deg; beyond the grid NaN."""
        return np.interp(angle, getattr(self, branch), self.stroke, left=np.nan, right=np.nan)


@dataclass(frozen=True)
class LinkChange:
    """Lengths of one stage and how well they meet its schedule. mm, deg; errors are target minus angle, over ``speed``
    of the result.

    lb_built, lc_built       as in the geometry table (lb as first built: lb_initial)
    lb, lc                   after the adjustment
    error_initial            with lb_initial; error_built: as the machine is (measured where there is a log); error:
                             adjusted
    error_extension, error_retraction  adjusted, with the play and both stroke tables: what remains in either direction
    """

    stage: str
    lb_initial: float
    lb_built: float
    lc_built: float
    lb: float
    lc: float
    error_initial: Array
    error_built: Array
    error: Array
    error_extension: Array
    error_retraction: Array
    at_design: dict[str, float] = field(default_factory=dict)
    rms: dict[str, float] = field(default_factory=dict)
    largest: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class ScheduleResult:
    """What the method gives.

    speed    %, raster of tables and errors; target float64[n, 3] deg
    table    float64[4, n]: speed, strokes (mm) for extension, retraction and the mean: what the controller loads
    links    one entry a stage
    loops    measured loops by stage; empty without a log
    geometry the machine as measured and adjusted (equivalent lengths); written as geometry.toml
    """

    speed: Array
    target: Array
    table: Array
    links: list[LinkChange]
    loops: dict[str, MeasuredLoop]
    geometry: Geometry
    built: Geometry
    schedules: Schedules
    options: ScheduleOptions
    log: str
    origin: str
    notes: list[str]


# ---------------------------------------------------------------- tables from the model


def table_speeds(schedules: Schedules) -> Array:
    """Speeds (%) of the stroke tables: every per cent from where the VIGV's schedule begins to rise to its end, and its
    breakpoints.
    """
    n, angles = schedules.arrays()
    rises = np.flatnonzero(np.diff(angles[:, 0]) > 0.0)
    start, end = float(n[rises[0]]), float(n[-1])
    whole = np.arange(math.floor(start), math.ceil(end) + 1.0)
    inside = n[(n >= start) & (n <= end)]
    return np.unique(np.concatenate([whole[(whole >= start) & (whole <= end)], inside]))


def stroke_tables(geometry: Geometry, schedules: Schedules, speed: Array | None = None) -> Array:
    """Return float64[4, n]: speed (%), strokes (mm) for extension, retraction and the single mean curve.

    While the stroke extends, the VIGV lags behind by half the hysteresis: the stroke that gives the target then is the
    stroke of (target + half), and of (target - half) while it retracts. Raises InputError, naming the speed, where no
    stroke gives the angle.
    """
    n = table_speeds(schedules) if speed is None else speed
    target = schedules.targets(n)[:, 0]
    half = 0.5 * np.deg2rad(geometry.vigv.hysteresis.value)
    _reachable(geometry, n, target)
    low, high = (stage_vane_angle(x, geometry.arrays(), 0) for x in (STROKE_LOW, STROKE_HIGH))
    rows = [stroke_for_vigv(np.clip(target + side * half, low, high), geometry) * 1e3 for side in (1, -1, 0)]
    return np.vstack([n, *rows])


def _reachable(geometry: Geometry, speed: Array, target: Array) -> None:
    """Refuse a VIGV target (rad) that no stroke between the stops gives."""
    low, high = np.rad2deg(vane_angles(np.array(STROKE_LIMITS) * 1e-3, geometry)[:, 0])
    _refuse_outside(speed, np.rad2deg(target), low, high)


def _refuse_outside(speed: Array, target: Array, low: float, high: float) -> None:
    outside = np.flatnonzero(~((target >= low) & (target <= high)))
    if outside.size:
        i = outside[int(np.argmax(np.maximum(low - target[outside], target[outside] - high)))]
        raise InputError(
            f"vigv: no stroke meets the schedule at {speed[i]:g} % speed: target angle (={target[i]:.4g} deg) must be "
            f"in [{low:.4g}, {high:.4g}], what {STROKE_LIMITS[0]:g} to {STROKE_LIMITS[1]:g} mm of stroke give"
        )


def write_stroke_tables(table: Array, path: str | Path, origin: str) -> None:
    """Write ``stroke_tables.toml`` as the controller loads it; ``table`` as from `stroke_tables`."""
    lines = [
        "# Stroke against rotor speed for the VIGV schedule: one curve per direction of the demand, and their mean.",
        "",
    ]
    for name, unit, row in zip(
        ("speed", "extension", "retraction", "single"), ("%", "mm", "mm", "mm"), table, strict=True
    ):
        lines += _axis(name, unit, origin, row)
    _write(path, "\n".join(lines))


def vane_angle_table(geometry: Geometry, stroke: Array | None = None) -> Array:
    """Return float64[4, n]: stroke (mm; default 0 to 48 in steps of 1) and the angles (deg) of VIGV, VGV1, VGV2 in the
    middle of the play.

    Between the strokes a straight line is off by at most 0.002 deg.
    """
    x = np.arange(0.0, 49.0) if stroke is None else stroke
    return np.vstack([x, np.rad2deg(vane_angles(x * 1e-3, geometry)).T])


def write_vane_angles(table: Array, geometry: Geometry, path: str | Path, origin: str) -> None:
    """Write ``vane_angles.toml`` as the controller loads it: ``table`` as from `vane_angle_table`, the plays of
    ``geometry``.
    """
    lines = [
        "# Vane angles against stroke in the middle of the play, and the play: what the strategies inverse and "
        "adaptive know.",
        "",
    ]
    for stage in STAGES:
        q = getattr(geometry, stage).hysteresis
        lines.append(f'play_{stage} = {{ value = {q.value!r}, unit = "deg", origin = {_quoted(q.origin)} }}')
    lines.append("")
    for name, unit, row in zip(("stroke", *STAGES), ("mm", "deg", "deg", "deg"), table, strict=True):
        lines += _axis(name, unit, origin, row)
    _write(path, "\n".join(lines))


def _axis(name: str, unit: str, origin: str, row: Array) -> list[str]:
    """Lines of a list of numbers, ten a line."""
    lines = [f"[{name}]", f'unit = "{unit}"', f"origin = {_quoted(origin)}", "values = ["]
    lines += [
        "  " + ", ".join(f"{v:.4f}".rstrip("0").rstrip(".") for v in row[i : i + 10]) + ","
        for i in range(0, len(row), 10)
    ]
    return [*lines, "]", ""]


# ---------------------------------------------------------------- the measured loop


@compiled
def _branches(x: Array, width: float, tolerance: float) -> NDArray[np.int8]:
    """Branch of each sample of the stroke x: 1 where a play of ``width`` is surely driven in extension, -1 in
    retraction, 0 else.

    Two plays of that width start at either end of their gap; where both say the same the unknown start is forgotten. A
    play of a wider gap is in contact only where every narrower one is (nested contact sets), so a width above the
    machine's own gives no wrong sample.
    """
    half = 0.5 * width
    a, b = x[0] - half, x[0] + half
    out = np.zeros(x.size, np.int8)
    for i in range(x.size):
        a = min(max(a, x[i] - half), x[i] + half)
        b = min(max(b, x[i] - half), x[i] + half)
        if b - a < tolerance:
            if x[i] - b >= half - tolerance:
                out[i] = 1
            elif a - x[i] >= half - tolerance:
                out[i] = -1
    return out


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
    k = STAGES.index(stage)
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
    fit = _fit_with_width(t, x, r, s, v, travel, tolerance, lag, stage, source)

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
            "fewer than two loops there and back: a drift of the angle could not be told from the loop's width"
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
    from scipy.ndimage import median_filter

    least = 0.3 + float(np.quantile(np.abs(np.diff(x)), 0.8))
    far = np.abs(x - median_filter(x, 7, mode="nearest")) > least
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


@dataclass(frozen=True)
class _Fit:
    """Result of the robust fit of one stage: knots of centre and gap (deg, ring scaled to the vane)."""

    knots: Array
    centre: Array
    gap: Array
    gap_sigma: float
    noise: float
    drift: float | None
    lag: float
    branch: NDArray[np.int8]
    covered: dict[int, tuple[float, float]]

    @property
    def low(self) -> float:
        return min(self.covered[1][0], self.covered[-1][0])

    @property
    def high(self) -> float:
        return max(self.covered[1][1], self.covered[-1][1])

    def on(self, x: Array) -> tuple[Array, Array]:
        return np.interp(x, self.knots, self.centre), np.maximum(np.interp(x, self.knots, self.gap), 0.0)


def _fit_with_width(
    t: Array,
    x: Array,
    r: Array,
    s: Array,
    v: Array,
    travel: float,
    tolerance: float,
    lag: tuple[float, float],
    stage: str,
    source: str,
) -> _Fit:
    """Find the play width that tells the samples apart: wide first, then 1.25 times the gap that the fit shows."""
    width = 0.0
    for share in (0.4, 0.25, 0.15, 0.08, 0.04):
        width = max(share * travel, 3.0 * tolerance)
        missing = _missing(_branches(x, width, tolerance), x)
        if missing is None:
            break
    else:
        raise _one_branch(x, missing or "", width, stage, source)
    least = float(np.quantile(s, 0.02))
    fit, used = None, 0.0
    for _ in range(8):
        branch = _branches(x, width, tolerance)
        missing = _missing(branch, x)
        if missing is not None:
            if fit is not None and width > used:
                raise _one_branch(x, missing, width, stage, source)
            break
        fit, used = _fit(t, x, r, s, v, branch, lag), width
        wanted = max(1.25 * float(np.max(fit.gap)) / least + 2.0 * tolerance, 4.0 * tolerance)
        if abs(wanted - width) < 0.03 * width:
            break
        width = wanted
    assert fit is not None
    return fit


def _missing(branch: NDArray[np.int8], x: Array) -> str | None:
    """Name of the branch that is missing or too short, None where both are there and overlap."""
    for side, name in ((1, "extension"), (-1, "retraction")):
        on = branch == side
        if on.sum() < 10 or np.ptp(x[on]) < 0.5 * LEAST_OVERLAP:
            return name
    up, down = x[branch == 1], x[branch == -1]
    return None if min(up.max(), down.max()) - max(up.min(), down.min()) >= LEAST_OVERLAP else "overlap"


def _one_branch(x: Array, missing: str, width: float, stage: str, source: str) -> LogError:
    rise = float(np.max(x - np.minimum.accumulate(x)))
    fall = float(np.max(np.maximum.accumulate(x) - x))
    if missing == "overlap":
        return LogError(
            f"{source}: {stage}: the two branches of the loop do not overlap by {LEAST_OVERLAP:g} mm of stroke "
            f"(x_lvdt rises by {rise:.3g} mm and falls by {fall:.3g} mm at a stretch); a loop goes there and back"
        )
    other, had, got = ("retraction", rise, fall) if missing == "retraction" else ("extension", fall, rise)
    return LogError(
        f"{source}: {stage}: the loop has one branch only, {missing} is missing: x_lvdt from {x.min():.4g} to "
        f"{x.max():.4g} mm moves {'back' if other == 'retraction' else 'forward'} by {got:.3g} mm at most ({had:.3g} "
        f"mm the other way); more than {max(width, LEAST_OVERLAP) + LEAST_OVERLAP:.3g} mm is needed to cross the gap "
        "and measure"
    )


def _hats(at: Array, knots: Array) -> Array:
    """Piecewise-linear basis: row of weights of each knot, held beyond the ends."""
    i = np.clip(np.searchsorted(knots, at, side="right") - 1, 0, knots.size - 2)
    f = np.clip((at - knots[i]) / (knots[i + 1] - knots[i]), 0.0, 1.0)
    out = np.zeros((at.size, knots.size))
    rows = np.arange(at.size)
    out[rows, i] = 1.0 - f
    out[rows, i + 1] += f
    return out


def _fit(t: Array, x: Array, r: Array, s: Array, v: Array, branch: NDArray[np.int8], lag: tuple[float, float]) -> _Fit:
    """One robust (Huber) regularised least-squares fit of centre, gap, drift and lag to the samples on the branches."""
    on = np.flatnonzero(branch != 0)
    loops = _loop_times(t[on], x[on], branch[on])
    d = branch[on].astype(float)
    ton, xon, ron, son, von = t[on], x[on], r[on], s[on], v[on]
    if on.size > MAX_SAMPLES:  # groups of neighbours on one branch
        size = -(-on.size // MAX_SAMPLES)
        n = on.size // size * size
        group = [a[:n].reshape(-1, size) for a in (ton, xon, ron, son, von, d)]
        same = (np.abs(group[5].mean(axis=1)) == 1.0) & (
            np.ptp(group[0], axis=1) < 5.0 * size * float(np.median(np.diff(ton)))
        )
        ton, xon, son, von, d = (a[same].mean(axis=1) for a in (*group[:2], *group[3:]))
        ron = np.median(group[2][same], axis=1)
    covered = {side: (float(xon[d == side].min()), float(xon[d == side].max())) for side in (1, -1)}
    knots = np.linspace(xon.min(), xon.max(), max(3, int(round(np.ptp(xon) / KNOT)) + 1))
    m = knots.size
    hats = _hats(xon, knots)
    parts = [hats, -0.5 * d[:, None] * hats, -(son * von)[:, None]]
    prior: list[tuple[Array, float, float]] = []  # row, value, sigma

    def row(*entries: tuple[int, float]) -> Array:
        a = np.zeros(2 * m + 1 + n_drift)
        for i, value in entries:
            a[i] = value
        return a

    n_drift = 0
    if loops.size > 2:  # one knot a loop: more could follow the passes, and would take the curve's slope for drift
        n_drift = loops.size
        parts.append(CubicSpline(loops, np.eye(n_drift), bc_type="natural")(np.clip(ton, loops[0], loops[-1])))
    for i in range(1, m - 1):
        prior.append((row((i - 1, 1.0), (i, -2.0), (i + 1, 1.0)), 0.0, 0.03))
        prior.append((row((m + i - 1, 1.0), (m + i, -2.0), (m + i + 1, 1.0)), 0.0, 0.03))
    for i in range(m - 1):
        prior.append((row((m + i, -1.0), (m + i + 1, 1.0)), 0.0, 0.03))
    prior.append((row((2 * m, 1.0)), lag[0], lag[1]))
    for i in range(n_drift - 1):
        prior.append((row((2 * m + 1 + i, -1.0), (2 * m + 2 + i, 1.0)), 0.0, 0.3))
    if n_drift:  # the curves stand for the log's mean
        prior.append((np.concatenate([np.zeros(2 * m + 1), parts[-1].mean(axis=0)]), 0.0, 1e-4))
    design = np.hstack(parts)
    p_rows = np.array([p[0] / p[2] for p in prior])
    p_values = np.array([p[1] / p[2] for p in prior])
    weight, sigma = np.ones(ron.size), 0.05
    theta = np.zeros(design.shape[1])
    normal = np.eye(design.shape[1])
    for _ in range(12):
        w = weight / (sigma * sigma)
        normal = design.T @ (design * w[:, None]) + p_rows.T @ p_rows
        new = np.linalg.solve(normal, design.T @ (w * ron) + p_rows.T @ p_values)
        e = ron - design @ new
        sigma = max(1.4826 * float(np.median(np.abs(e))), 1e-4)
        weight = np.minimum(1.0, 1.5 * sigma / np.maximum(np.abs(e), 1e-12))
        moved = float(np.max(np.abs(new - theta)))
        theta = new
        if moved < 1e-6:
            break
    mean_gap = np.zeros(design.shape[1])
    mean_gap[m : 2 * m] = 1.0 / m
    gap_sigma = float(np.sqrt(mean_gap @ np.linalg.solve(normal, mean_gap)))
    drift = float(np.ptp(parts[-1] @ theta[2 * m + 1 :])) if n_drift else None
    return _Fit(knots, theta[:m], theta[m : 2 * m], gap_sigma, sigma, drift, float(theta[2 * m]), branch, covered)


def _loop_times(t: Array, x: Array, branch: NDArray[np.int8]) -> Array:
    """Times at which the loops begin, and the end: passes along a branch over a third of the log's stroke, two a loop;
    16 at most.
    """
    need = np.ptp(x) / 3.0
    edges = np.concatenate([[0], np.flatnonzero(np.diff(branch)) + 1, [branch.size]])
    starts = [t[a] for a, b in zip(edges[:-1], edges[1:], strict=True) if np.ptp(x[a:b]) >= need]
    if len(starts) < 4:
        return np.empty(0)
    times = np.unique([t[0], *starts[2 : len(starts) // 2 * 2 : 2], t[-1]])
    return times[:: -(-times.size // 16)] if times.size > 17 else times


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
    change = least_squares(residual, np.zeros(2), bounds=(low, [200.0, 200.0]), diff_step=1e-4, x_scale=[1.0, 1.0]).x
    return stage.lb.value + float(change[0]), stage.lc.value + float(change[1])


def _rising(y: Array) -> Array:
    """The curve made strictly rising, so that it has an inverse."""
    return np.maximum.accumulate(y) + 1e-9 * np.arange(y.size)


# ---------------------------------------------------------------- links


def geometry_with(
    geometry: Geometry, changes: dict[str, dict[str, float]], origins: dict[str, str] | None = None, check: bool = True
) -> Geometry:
    """A geometry with other lengths (mm) or hysteresis (deg) of some stages: {"vgv1": {"lb": 49.0}}. Refuses what does
    not assemble.
    """
    stages: dict[str, Stage] = {}
    for name in STAGES:
        stage: Stage = getattr(geometry, name)
        update = {}
        for key, value in changes.get(name, {}).items():
            q = getattr(stage, key)
            update[key] = q.model_copy(
                update={"value": float(value), "origin": (origins or {}).get(f"{name}.{key}", q.origin)}
            )
        stages[name] = stage.model_copy(update=update)
    changed = geometry.model_copy(update=stages)
    if check:
        check_assembly(changed.arrays())
    return changed


def adjust_links(
    geometry: Geometry,
    schedules: Schedules,
    stage: str,
    stroke: Array,
    speed: Array,
    options: ScheduleOptions,
    correction: Callable[[Array], Array] | None = None,
) -> tuple[float, float, Array]:
    """Changes (mm) of Lb and Lc of one stage that best meet its schedule at the strokes (mm) scheduled for the VIGV.

    correction  deg over stroke (mm): measured mean curve minus the geometry's
    Returns the two changes and the remaining error (deg) at each speed. Raises InputError where no lengths meet the
    schedule.
    """
    k = STAGES.index(stage)
    built: Stage = getattr(geometry, stage)
    target = np.rad2deg(schedules.targets(speed)[:, k])
    extra = correction(stroke) if correction is not None else np.zeros(stroke.size)
    works = (speed >= WORKING_SPEED[0]) & (speed <= WORKING_SPEED[1])
    if not works.any():
        works = np.ones(speed.size, bool)
    grids = []
    for name, reach in (("lb", options.lb_range), ("lc", options.lc_range)):
        n = int(reach / options.step + 1e-9) if name in options.adjust else 0
        grids.append(np.arange(-n, n + 1) * options.step)
    g = geometry.arrays()
    o = N_CRANK + k * N_PER_STAGE
    worth = np.full((grids[0].size, grids[1].size), np.inf)
    design = schedules_at_design(speed)
    for i, d_lb in enumerate(grids[0]):
        for j, d_lc in enumerate(grids[1]):
            if built.lb.value + d_lb > 0.0 and built.lc.value + d_lc > 0.0:
                g[o + G_LB], g[o + G_LC] = (built.lb.value + d_lb) * 1e-3, (built.lc.value + d_lc) * 1e-3
                error = target - extra - np.rad2deg(vane_angles(stroke * 1e-3, g)[:, k])
                rms = float(np.sqrt(np.mean(error[works] ** 2)))
                largest = float(np.max(np.abs(error[works])))
                worth[i, j] = {"rms": rms, "max": largest, "design": abs(float(error[design])) + rms}[options.criterion]
    order = np.argsort(worth + 1e-9 * (np.abs(grids[0])[:, None] + np.abs(grids[1])[None, :]), axis=None)
    fault: InputError | None = None
    for flat in order[:2000]:
        i, j = divmod(int(flat), worth.shape[1])
        if not np.isfinite(worth[i, j]):
            break
        change = float(grids[0][i]), float(grids[1][j])
        try:
            changed = geometry_with(
                geometry, {stage: {"lb": built.lb.value + change[0], "lc": built.lc.value + change[1]}}
            )
        except InputError as e:
            fault = fault or e
            continue
        error = target - extra - np.rad2deg(vane_angles(stroke * 1e-3, changed)[:, k])
        worst = int(np.argmax(np.where(works, np.abs(error), -1.0)))
        if abs(error[worst]) > options.limit:
            reach_lb = f"lb (={built.lb.value:g} mm) within {abs(grids[0]).max():g} mm"
            reach_lc = f"lc (={built.lc.value:g} mm) within {abs(grids[1]).max():g} mm"
            raise InputError(
                f"{stage}: no length meets the schedule at {speed[worst]:g} % speed (stroke {stroke[worst]:.4g} mm): "
                f"with {reach_lb} and {reach_lc} an error of {error[worst]:.3g} deg remains; allowed: "
                f"{options.limit:g} deg (--limit, --lb-range, --lc-range)"
            )
        return change[0], change[1], error
    raise fault or InputError(f"{stage}: no pair of lb and lc within the ranges can be assembled")


def schedules_at_design(speed: Array) -> int:
    """Index of the speed nearest to 100 %."""
    return int(np.argmin(np.abs(speed - DESIGN_SPEED)))


# ---------------------------------------------------------------- the whole method


def schedule(
    geometry: Geometry,
    schedules: Schedules,
    log: Log | None = None,
    options: ScheduleOptions | None = None,
    progress: Callable[[float], None] | None = None,
) -> ScheduleResult:
    """The paper's stepwise method in one call.

    geometry   mechanism as built (`lb`; `lb_initial` is only compared with)
    schedules  target angles over rotor speed
    log        stroke and angle of at least the VIGV, measured on the machine as built; None: the geometry's own play

    Raises InputError in one line: a mechanism that cannot be assembled, a schedule that cannot be met, a log without a
    loop.
    """
    o = options or ScheduleOptions()
    o.check()
    notes: list[str] = list(log.notes) if log is not None else []
    loops: dict[str, MeasuredLoop] = {}
    if log is not None:
        if "x_lvdt" not in log.channels or "vigv" not in log.channels:
            missing = [n for n in ("x_lvdt", "vigv") if n not in log.channels]
            raise LogError(f"{log.path}: no {' and no '.join(missing)}; a loop needs stroke and angle")
        for done, name in enumerate(STAGES):
            if name in log.channels:
                try:
                    loops[name] = measure_loop(log.channels["x_lvdt"], log.channels[name], geometry, name, log.path)
                except LogError as e:
                    if name == "vigv":
                        raise
                    notes.append(f"{name} is not measured, the geometry's own curves stand for it: {e}")
            if progress is not None:
                progress(0.8 * (done + 1) / len(STAGES))
    said: dict[str, list[str]] = {}
    for name, measured in loops.items():
        for note in measured.notes:
            said.setdefault(note, []).append(name)
    notes += [f"{', '.join(names)}: {note}" for note, names in said.items()]
    speed = table_speeds(schedules)
    works = (speed >= WORKING_SPEED[0]) & (speed <= WORKING_SPEED[1])
    if not works.any():
        low, high = WORKING_SPEED
        raise InputError(
            f"schedules: vigv rises from {speed[0]:g} to {speed[-1]:g} % speed; it must reach into {low:g} to "
            f"{high:g} %"
        )
    if not speed[0] <= DESIGN_SPEED <= speed[-1]:
        nearest = speed[schedules_at_design(speed)]
        notes.append(
            f"the schedule's table runs from {speed[0]:g} to {speed[-1]:g} %: figures at 100 % speed are those at "
            f"{nearest:g} %"
        )
    target = np.rad2deg(schedules.targets(speed))
    design = schedules_at_design(speed)
    table = _tables(geometry, schedules, speed, loops.get("vigv"), notes)
    mean_stroke = table[3]

    file = Path(log.path).name if log is not None else ""
    links, changes, origins = [], {}, {}
    for k, name in enumerate(STAGES):
        built: Stage = getattr(geometry, name)
        loop = loops.get(name)
        correction = _correction(loop, geometry, k)
        initial = target[:, k] - np.rad2deg(
            vane_angles(stroke_of_model(geometry, schedules, speed), geometry.arrays(True))[:, k]
        )
        as_built = target[:, k] - np.rad2deg(vane_angles(mean_stroke * 1e-3, geometry)[:, k]) - correction(mean_stroke)
        d_lb, d_lc, error = 0.0, 0.0, as_built
        if name != "vigv" and o.adjust:
            d_lb, d_lc, error = adjust_links(geometry, schedules, name, mean_stroke, speed, o, correction)
        width = loop.width if loop is not None else built.hysteresis.value
        lb, lc = (loop.lb, loop.lc) if loop is not None else (built.lb.value, built.lc.value)
        changes[name] = {"lb": lb + d_lb, "lc": lc + d_lc, "hysteresis": width}
        if loop is not None:
            for key, q, value, change in (("lb", built.lb, lb, d_lb), ("lc", built.lc, lc, d_lc)):
                origins[f"{name}.{key}"] = (
                    f"measured: {file}, {value:.3f} mm equivalent where the geometry has {q.value:g} mm; adjusted by "
                    f"{change:+g} mm"
                )
            origins[f"{name}.hysteresis"] = (
                f"measured: {file}, width of the loop, standard error {loop.width_sigma:.3f} deg"
            )
        else:
            if d_lb:
                origins[f"{name}.lb"] = (
                    f"derived: vaneloop schedule, {built.lb.value:g} mm as built, adjusted by {d_lb:+g} mm"
                )
            if d_lc:
                origins[f"{name}.lc"] = (
                    f"derived: vaneloop schedule, {built.lc.value:g} mm as built, adjusted by {d_lc:+g} mm"
                )
        links.append((name, built, d_lb, d_lc, initial, as_built, error))
    if loops:
        changes = {n: {k: round(v, 4) for k, v in c.items()} for n, c in changes.items()}
    machine = geometry_with(geometry, changes, origins)
    try:
        check_assembly(machine.arrays(initial=True))
    except InputError:  # the arms as first built do not go with the new links
        machine = geometry_with(machine, {n: {"lb_initial": getattr(machine, n).lb.value} for n in STAGES})
    both = [
        _branch_errors(machine, geometry, k, table, target, loops.get(n), links[k][2:4]) for k, n in enumerate(STAGES)
    ]
    out = []
    for (name, built, d_lb, d_lc, initial, as_built, error), (up, down) in zip(links, both, strict=True):
        columns = {"initial": initial, "built": as_built, "adjusted": error, "extension": up, "retraction": down}
        out.append(
            LinkChange(
                name, built.lb_initial.value, built.lb.value, built.lc.value, built.lb.value + d_lb,
                built.lc.value + d_lc,
                initial, as_built, error, up, down,
                at_design={c: float(e[design]) for c, e in columns.items()},
                rms={c: float(np.sqrt(np.mean(e[works] ** 2))) for c, e in columns.items()},
                largest={c: float(np.max(np.abs(e[works]))) for c, e in columns.items()},
            )
        )  # fmt: skip
    if progress is not None:
        progress(1.0)
    words = f"hysteresis of {geometry.vigv.hysteresis.value:g} deg"
    if loops:
        words = f"loop of {loops['vigv'].width:.2f} deg measured in {file}"
    origin = f"derived: vaneloop schedule, inverse of the two branches at the VIGV schedule, {words}"
    source = log.path if log is not None else ""
    return ScheduleResult(speed, target, table, out, loops, machine, geometry, schedules, o, source, origin, notes)


def stroke_of_model(geometry: Geometry, schedules: Schedules, speed: Array) -> Array:
    """Strokes, m, that give the VIGV's schedule in the model without play."""
    target = schedules.targets(speed)[:, 0]
    _reachable(geometry, speed, target)
    return np.asarray(stroke_for_vigv(target, geometry))


def _correction(loop: MeasuredLoop | None, geometry: Geometry, k: int) -> Callable[[Array], Array]:
    """Deg over stroke (mm): measured mean curve minus the geometry's."""
    if loop is None:
        return lambda x: np.zeros(np.shape(x))
    grid, difference = loop.stroke, loop.mean - np.rad2deg(vane_angles(loop.stroke * 1e-3, geometry)[:, k])
    return lambda x: np.interp(x, grid, difference)


def _tables(
    geometry: Geometry, schedules: Schedules, speed: Array, loop: MeasuredLoop | None, notes: list[str]
) -> Array:
    """The controller's stroke tables, between the actuator's stops; ``notes`` gains where a stop cuts a branch off."""
    if loop is None:
        table = stroke_tables(geometry, schedules, speed)
    else:
        target = np.rad2deg(schedules.targets(speed)[:, 0])
        low, high = np.interp(STROKE_LIMITS, loop.stroke, loop.mean)
        _refuse_outside(speed, target, float(low), float(high))
        rows = [np.interp(target, getattr(loop, b), loop.stroke) for b in ("extension", "retraction", "mean")]
        table = np.vstack([speed, *rows])
    cut = np.clip(table[1:], *STROKE_LIMITS)
    for row, name in enumerate(("extension", "retraction")):
        beyond = np.abs(table[1 + row] - cut[row])
        if beyond.max() > 0.0:
            i = int(np.argmax(beyond))
            notes.append(
                f"{name}: the stop at {cut[row, i]:g} mm cuts the table off at {int((beyond > 0).sum())} speeds, most "
                f"at {speed[i]:g} % ({beyond[i]:.2f} mm): the gap is not crossed in full there"
            )
    # the controller wants rising rows, extension above the mean above retraction
    up, down, mean = cut
    mean = np.maximum.accumulate(mean)
    up = np.maximum(np.maximum.accumulate(up), mean)
    down = np.minimum(np.maximum.accumulate(down), mean)
    return np.vstack([speed, up, down, mean])


def _branch_errors(
    machine: Geometry,
    built: Geometry,
    k: int,
    table: Array,
    target: Array,
    loop: MeasuredLoop | None,
    change: Sequence[Any],
) -> tuple[Array, Array]:
    """Errors (deg) of stage k with the dual tables, in extension and in retraction: target minus the angle on its own
    branch.
    """
    out = []
    for row, side, name in ((1, -1.0, "extension"), (2, 1.0, "retraction")):
        stroke = table[row]
        if loop is not None and not any(change):
            angle = np.interp(stroke, loop.stroke, getattr(loop, name))
        else:
            g = machine.arrays()
            o = N_CRANK + k * N_PER_STAGE
            ldp, lever = float(g[o + G_LDP]), float(g[o + G_L])
            half = 0.5 * math.radians(getattr(machine, STAGES[k]).hysteresis.value) * lever / ldp
            angle = (
                np.array([vane_angle(stage_ring_angle(x * 1e-3, g, k) + side * half, ldp, lever) for x in stroke]) * DEG
            )
        out.append(target[:, k] - angle)
    return out[0], out[1]


# ---------------------------------------------------------------- files and JSON


def write_tables(result: ScheduleResult, folder: str | Path) -> list[Path]:
    """Write stroke_tables, vane_angles, geometry, schedules (.toml) into ``folder``, made where missing; each number
    with its origin.
    """
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as e:
        raise InputError(f"{folder}: cannot be made ({e.strerror})") from None
    out = [folder / f"{name}.toml" for name in ("stroke_tables", "geometry", "schedules", "vane_angles")]
    write_stroke_tables(result.table, out[0], result.origin)
    write_geometry(result.geometry, out[1], "Linkage of the three stages, as measured and adjusted: vaneloop schedule.")
    write_schedules(result.schedules, out[2])
    write_vane_angles(vane_angle_table(result.geometry), result.geometry, out[3], result.origin)
    return out


def write_geometry(geometry: Geometry, path: str | Path, words: str = "Linkage of the three stages.") -> None:
    """Write a geometry as `plant.load_geometry` reads it, each number with its origin."""
    lines = [f"# {words}", ""]
    for name in ("crank", *STAGES):
        lines.append(f"[{name}]")
        for key, q in getattr(geometry, name):
            tolerance = f", tolerance = {q.tolerance!r}" if q.tolerance else ""
            lines.append(
                f'{key} = {{ value = {q.value!r}, unit = "{q.unit}"{tolerance}, origin = {_quoted(q.origin)} }}'
            )
        lines.append("")
    _write(path, "\n".join(lines))


def write_schedules(schedules: Schedules, path: str | Path) -> None:
    """Write schedules as `plant.load_schedules` reads them."""
    lines = ["# Target vane angles over rotor speed.", ""]
    for name, axis in schedules:
        lines += [
            f"[{name}]",
            f'unit = "{axis.unit}"',
            f"origin = {_quoted(axis.origin)}",
            f"values = {axis.values!r}",
            "",
        ]
    _write(path, "\n".join(lines))


LOOP_FIGURES = (
    "width",
    "width_sigma",
    "offset",
    "lb",
    "lc",
    "misfit",
    "noise",
    "drift",
    "lag",
    "extension_covered",
    "retraction_covered",
)


def result_json(result: ScheduleResult) -> dict[str, Any]:
    """The result as the JSON of the command."""
    error_keys = ("error_initial", "error_built", "error", "error_extension", "error_retraction")
    return {
        "schema": 1,
        "log": result.log or None,
        "origin": result.origin,
        "table": dict(zip(("speed", "extension", "retraction", "single"), result.table, strict=True)),
        "stages": [
            {
                "stage": s.stage,
                "unit": {"length": "mm", "error": "deg"},
                "lb_initial": s.lb_initial,
                "lb_built": s.lb_built,
                "lc_built": s.lc_built,
                "lb": s.lb,
                "lc": s.lc,
                "target": result.target[:, k],
                **{key: getattr(s, key) for key in error_keys},
                "at_100": s.at_design,
                "rms": s.rms,
                "max_abs": s.largest,
            }
            for k, s in enumerate(result.links)
        ],
        "loops": {name: {key: getattr(m, key) for key in LOOP_FIGURES} for name, m in result.loops.items()},
        "notes": result.notes,
    }


def _quoted(text: str) -> str:
    """Text as a TOML basic string."""
    import json

    return json.dumps(text, ensure_ascii=False)


def _write(path: str | Path, text: str) -> None:
    try:
        Path(path).write_text(text, encoding="utf-8")
    except OSError as e:
        raise InputError(f"{path}: cannot be written ({e.strerror})") from None
