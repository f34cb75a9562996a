"""The casing grows as it warms up and turns the vanes a little at the same stroke.

Equation::

    th <- th + coefficient L / Ld' (T - 40 degC)

Symbols: th ring angle before the backlash (rad), coefficient at the vane (rad/K), L / Ld' ratio of the lever at
mid-stroke, T oil temperature (degC).
Limits: linear and without thermal lag; the oil stands for the casing.
In a log: one vane row drifts with t_oil while the others do not (an LVDT that drifts moves all).
Source: linear expansion; 0.5 mm/m for 40 K of steel.
"""

from __future__ import annotations

from plant.effect import T_REF, Effect, per_vane_stage
from vaneloop.base.compiled import compiled

__all__ = ["EFFECT", "step"]

EFFECT = Effect(
    "thermal_growth",
    "linkage",
    ("linkage",),
    per_vane_stage("deg/K", 0.0, -0.5, 0.5, "vane angle per kelvin of oil above 40 degC"),
    (),
    "the angle of a vane row drifts with temperature",
    "oil that warms up by 10 K or more",
)


@compiled
def step(theta: float, t_oil: float, coefficient: float, ratio: float) -> float:
    """Return the ring angle (rad) at the oil temperature ``t_oil`` (degC); ``ratio`` ring per vane."""
    return theta if coefficient == 0.0 else theta + coefficient * ratio * (t_oil - T_REF)
