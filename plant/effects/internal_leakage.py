"""Oil slips past the piston's seals from the loaded side to the other.

Equation::

    v <- v - coefficient p_L,   p_L = (F + z) / A

Symbols: v speed (m/s), p_L load pressure (Pa), F load (N), z friction (N), A area (m2), coefficient (m/s/Pa).
Limits: laminar gap; without a load force nothing leaks and nothing shows.
In a log: under load the piston creeps in its direction, with i_cmd needed to hold it: like a null bias that grows
with the load.
Source: Merritt (1967), section 6-1, leakage coefficient.
"""

from __future__ import annotations

from plant.compiled import compiled
from plant.effect import Effect, Parameter

__all__ = ["EFFECT", "step"]

EFFECT = Effect(
    "internal_leakage",
    "actuator",
    ("actuator",),
    (Parameter("coefficient", "mm/s/MPa", 0.0, 0.0, 50.0, "stroke speed lost per load pressure"),),
    (),
    "oil slips past the loaded piston",
    "a load on the piston: friction or air forces, held for seconds",
)


@compiled
def step(v, p_load, coefficient):
    """Return the speed (m/s) left of ``v`` (m/s) at the load pressure ``p_load`` (Pa, against extension)."""
    return v - coefficient * p_load
