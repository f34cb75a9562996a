"""Tables from the model: the strokes that give the VIGV's schedule in either direction, and the vane angles over
stroke.

    stroke_tables(geometry, schedules) -> float64[4, n]             the controller's tables from the model's play
    vane_angle_table(geometry) -> float64[1 + stages, n]            what the strategies inverse and adaptive know of the
                                                                    linkage
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from plant import Geometry, Schedules
from plant.geometry import stroke_for_vigv, vane_angles
from plant.linkage import STROKE_HIGH, STROKE_LOW, stage_vane_angle
from vaneloop.base.errors import InputError

__all__ = [
    "DESIGN_SPEED", "STROKE_LIMITS", "refuse_outside", "schedules_at_design", "stroke_of_model", "stroke_tables",
    "table_speeds", "vane_angle_table",
]  # fmt: skip

Array = NDArray[np.float64]
DESIGN_SPEED = 100.0  # %
STROKE_LIMITS = (0.0, 48.0)  # mm, the actuator's stops


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


def schedules_at_design(speed: Array) -> int:
    """Index of the speed nearest to 100 %."""
    return int(np.argmin(np.abs(speed - DESIGN_SPEED)))


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


def stroke_of_model(geometry: Geometry, schedules: Schedules, speed: Array) -> Array:
    """Strokes, m, that give the VIGV's schedule in the model without play."""
    target = schedules.targets(speed)[:, 0]
    _reachable(geometry, speed, target)
    return np.asarray(stroke_for_vigv(target, geometry))


def _reachable(geometry: Geometry, speed: Array, target: Array) -> None:
    """Refuse a VIGV target (rad) that no stroke between the stops gives."""
    low, high = np.rad2deg(vane_angles(np.array(STROKE_LIMITS) * 1e-3, geometry)[:, 0])
    refuse_outside(speed, np.rad2deg(target), low, high)


def refuse_outside(speed: Array, target: Array, low: float, high: float) -> None:
    """Refuse a VIGV target (deg) outside ``low`` to ``high``, naming the speed where it is furthest off."""
    outside = np.flatnonzero(~((target >= low) & (target <= high)))
    if outside.size:
        i = outside[int(np.argmax(np.maximum(low - target[outside], target[outside] - high)))]
        raise InputError(
            f"vigv: no stroke meets the schedule at {speed[i]:g} % speed: target angle (={target[i]:.4g} deg) must be "
            f"in [{low:.4g}, {high:.4g}], what {STROKE_LIMITS[0]:g} to {STROKE_LIMITS[1]:g} mm of stroke give"
        )


def vane_angle_table(geometry: Geometry, stroke: Array | None = None) -> Array:
    """Return float64[1 + stages, n]: stroke (mm; default 0 to 48 in steps of 1) and each stage's angle (deg) in the
    middle of the play.

    Between the strokes a straight line is off by at most 0.002 deg.
    """
    x = np.arange(0.0, 49.0) if stroke is None else stroke
    return np.vstack([x, np.rad2deg(vane_angles(x * 1e-3, geometry)).T])
