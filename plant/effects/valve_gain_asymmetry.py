"""Ports of unequal width: the same current moves the piston faster one way than the other.

Equation::

    g_extending = g sqrt(ratio),   g_retracting = g / sqrt(ratio)

Symbols: g flow gain (m/s), ratio extending over retracting (-). The geometric mean stays, so that a wrong mean gain
is a recalibration of g.
Limits: pistons of unequal area look the same as long as the load is small.
In a log: the current needed for the same speed differs between extension and retraction by the ratio, in proportion
to speed (a null bias shifts both by a constant).
Source: asymmetric valve gain, Merritt, Hydraulic Control Systems (1967), section 5.
"""

from __future__ import annotations

import math

from plant.effect import HYDRAULIC, Effect, Parameter
from vaneloop.base.compiled import compiled

__all__ = ["EFFECT", "step"]

EFFECT = Effect(
    "valve_gain_asymmetry",
    "valve",
    ("actuator",),
    (Parameter("ratio", "-", 1.0, 0.2, 5.0, "flow gain extending over flow gain retracting"),),
    (),
    "extending is faster than retracting, or slower",
    "fast motion both ways",
    HYDRAULIC,
)


@compiled
def step(gain: float, ratio: float) -> tuple[float, float]:
    """Return the flow gains (m/s at full spool) for extension and for retraction."""
    root = math.sqrt(ratio)
    return gain * root, gain / root
