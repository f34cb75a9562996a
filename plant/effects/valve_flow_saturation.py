"""A narrow passage in series: beyond some flow, more spool brings no more oil.

Equation::

    v <- clip(v, -limit, limit)

Symbols: v speed of the piston (m/s), limit (m/s); the neutral 1,000 mm/s is beyond any spool position and switches
the effect off.
Limits: sharp corner, the same both ways, independent of the supply pressure; a real orifice in series bends
gradually.
In a log: the stroke's speed stops rising with i_cmd, everything below the limit is untouched: only fast manoeuvres
show it.
Source: Merritt, Hydraulic Control Systems (1967), section 5, flow saturation of two-stage valves.
"""

from __future__ import annotations

from plant.compiled import compiled
from plant.effect import Effect, Parameter

__all__ = ["EFFECT", "step"]

EFFECT = Effect(
    "valve_flow_saturation",
    "valve",
    ("actuator",),
    (Parameter("limit", "mm/s", 1000.0, 1.0, 1000.0, "speed beyond which the flow does not rise"),),
    (),
    "the flow stops rising before the spool is fully open",
    "motion faster than the limit: slams",
)

OFF = 1.0  # m/s, the neutral limit


@compiled
def step(v, limit):
    """Return the speed (m/s) that the passage lets through."""
    return v if limit >= OFF else min(max(v, -limit), limit)
