"""LVDT behind its lags: what it makes of a resting stroke, and the stroke that gives a reading, with every effect.

The lags are steps of the actuator (`plant.drive`, `plant.electromechanical`). Units: m, degC.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from plant.effects import ROW, lvdt_bias, lvdt_gain, lvdt_nonlinearity, lvdt_thermal_drift, rows_at
from plant.parameters import STROKE, changed
from plant.prepared import with_effects
from vaneloop.base.compiled import in_place, inlined

__all__ = ["Lvdt", "bends", "prepare", "reading", "straight", "straightened", "true_stroke"]


class _Lvdt(NamedTuple):
    """What it is, worked out once: its ``travel`` (m); behind it the fields of its effects (`plant.prepared`)."""

    travel: float


@inlined
def _numbers(p: np.ndarray, j: int) -> _Lvdt:
    return _Lvdt(p[STROKE, j])


Lvdt, prepare = with_effects(_Lvdt, _numbers, "p, j", "lvdt")
_STRAIGHT = ("lvdt_gain", "lvdt_thermal_drift", "lvdt_bias", "lvdt_lag")  # effects that leave its line straight
_BENDS = np.array([r for r in rows_at("lvdt") if r not in [ROW[name] for name in _STRAIGHT]])


@in_place
def bends(p: np.ndarray, j: int) -> bool:
    """Whether an effect bends the reading of lane ``j``: then `straight` alone is not its reading."""
    return changed(p, j, _BENDS) != 0.0


@inlined
def bend(d: Any, x: float, t_oil: float) -> float:
    """Return the windings' reading (m) of a resting stroke ``x`` (m)."""
    return lvdt_nonlinearity.step(x, d.travel, d.lvdt_nonlinearity_amplitude, d.lvdt_nonlinearity_cubic)


@inlined
def straight(d: Any, x: float, t_oil: float) -> float:
    """Return what is behind the windings of their reading ``x`` (m): a straight line."""
    x = lvdt_gain.step(x, d.lvdt_gain)
    return lvdt_bias.step(lvdt_thermal_drift.step(x, t_oil, d.lvdt_thermal_drift), d.lvdt_bias)


@inlined
def reading(d: Any, x: float, t_oil: float) -> float:
    """Return the reading (m) of a resting stroke ``x`` (m)."""
    return straight(d, bend(d, x, t_oil), t_oil)


@inlined
def straightened(d: Any, seen: float, t_oil: float) -> float:
    """The inverse of `straight`."""
    return (seen - straight(d, 0.0, t_oil)) / d.lvdt_gain


@inlined
def true_stroke(d: Any, seen: float, t_oil: float) -> float:
    """Return the resting stroke (m) whose `reading` is ``seen`` (m), to 1e-9 m."""
    x = target = straightened(d, seen, t_oil)
    for _ in range(12):  # Newton; the error's slope is below 0.7 within the stroke
        e = bend(d, x, t_oil) - target
        if abs(e) < 1e-10:
            break
        slope = lvdt_nonlinearity.slope(x, d.travel, d.lvdt_nonlinearity_amplitude, d.lvdt_nonlinearity_cubic)
        x -= e / max(slope, 0.2)
    return x
