"""A narrow passage in series: beyond some flow, more spool brings no more oil.

Equation::

    v <- (1 - roundness) clip(v, -limit, limit) + roundness v / sqrt(1 + (v / limit)^2)

Symbols: v speed of the piston (m/s), limit (m/s), roundness (-). The neutral limit, 1,000 mm/s, is beyond any spool
position and switches the effect off. Roundness 0 is a sharp corner, as of a spool whose ports are fully open. Roundness
1 is an orifice in series with the spool's, whose pressure drops add up.
Limits: the same both ways, independent of the supply pressure.
In a log: the stroke's speed stops rising with i_cmd. A sharp corner leaves everything below the limit untouched, so
that only fast manoeuvres show it; a series orifice bends gradually, some 6 % at a third of the limit.
Source: Merritt, Hydraulic Control Systems (1967), section 5, flow saturation of two-stage valves; section 3-3, orifices
in series.
"""

from __future__ import annotations

import math

from plant.effect import HYDRAULIC, Effect, Parameter
from vaneloop.base.compiled import compiled

__all__ = ["EFFECT", "corner", "step"]

EFFECT = Effect(
    "valve_flow_saturation",
    "valve",
    ("actuator",),
    (
        Parameter("limit", "mm/s", 1000.0, 1.0, 1000.0, "speed beyond which the flow does not rise"),
        Parameter("roundness", "-", 0.0, 0.0, 1.0, "0: a sharp corner, 1: an orifice in series"),
    ),
    (),
    "the flow stops rising before the spool is fully open",
    "motion faster than the limit: slams",
    HYDRAULIC,
)

OFF = 1.0  # m/s, the neutral limit


@compiled
def corner(v: float, limit: float) -> float:
    """Return the speed (m/s) that a passage with a sharp corner lets through."""
    return v if limit >= OFF else min(max(v, -limit), limit)


@compiled
def step(v: float, limit: float, roundness: float) -> float:
    """Return the speed (m/s) that the passage lets through."""
    if limit >= OFF:
        return v
    ratio = v / limit
    return (1.0 - roundness) * min(max(v, -limit), limit) + roundness * v / math.sqrt(1.0 + ratio * ratio)
