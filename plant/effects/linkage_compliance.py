"""Links and crank bend: the air's load on the vanes turns the rings back.

Equation::

    th <- th - compliance (n_r / 100 %)^2

Symbols: th ring angle before the backlash (rad), compliance ring angle lost at the load of 100 % (rad), n_r rotor speed
(%). The same for all rings.
Limits: load as dynamic pressure only, whatever the vane angle; elastic, without delay.
In a log: vane angles fall short as n_r squared, all vane rows (by Ld'/L of the lever), both directions alike;
nothing at low speed.
Source: Hooke's law; dynamic pressure.
"""

from __future__ import annotations

from plant.effect import Effect, Parameter
from vaneloop.base.compiled import compiled

__all__ = ["EFFECT", "step"]

EFFECT = Effect(
    "linkage_compliance",
    "linkage",
    ("linkage",),
    (Parameter("compliance", "deg", 0.0, -2.0, 2.0, "ring angle lost at the load of 100 %, grows with n_r squared"),),
    (),
    "the linkage bends under the air's load",
    "low and high rotor speed",
)


@compiled
def step(theta: float, n_r: float, compliance: float) -> float:
    """Return the ring angle (rad) at the rotor speed ``n_r`` (%)."""
    r = 0.01 * n_r
    return theta - compliance * (r * r)
