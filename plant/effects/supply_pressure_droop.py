"""The supply line chokes: the faster the piston draws oil, the less pressure is left at the valve.

Equation, with v0 the speed at full supply pressure and p the pressure drop available to the orifices::

    p_valve = p_s - droop |v|   and   v ~ sqrt(p)   give   v = v0 (sqrt(1 + q^2) - q),   q = droop |v0| / (2 p)

Symbols: p pressure (Pa), v speed (m/s), droop (Pa/(m/s)).
Limits: a resistive line without inertia or accumulator; p_s is logged ahead of the line.
In a log: the stroke falls short at high speed, more than in proportion, and is untouched at low speed; the same both
ways.
Source: orifice and resistance in series, Merritt (1967), ch. 3; the closed form solves its quadratic.
"""

from __future__ import annotations

import math

from plant.effect import HYDRAULIC, Effect, Parameter
from vaneloop.base.compiled import compiled

__all__ = ["EFFECT", "step"]

EFFECT = Effect(
    "supply_pressure_droop",
    "supply",
    ("actuator",),
    (Parameter("droop", "MPa/(m/s)", 0.0, 0.0, 1000.0, "supply pressure lost with piston speed"),),
    (),
    "the supply pressure falls at the valve when oil flows",
    "fast and slow motion",
    HYDRAULIC,
)


@compiled
def step(v0: float, p: float, droop: float) -> float:
    """Return the speed (m/s) under droop, for the speed ``v0`` without it and the pressure drop ``p`` (Pa)."""
    if droop == 0.0:
        return v0
    q = abs(v0) * droop / max(2.0 * p, 1.0)
    return v0 * (math.sqrt(1.0 + q * q) - q)
