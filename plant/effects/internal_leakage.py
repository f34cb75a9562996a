"""Oil slips past the piston's seals from the loaded side to the other.

Equation::

    v <- v - coefficient p_L,   p_L = (F + z + drag v) / A

Symbols: v speed (m/s), p_L load pressure (Pa), F load (N), z friction (N), drag see oil_compressibility (N/(m/s)), A
area (m2), coefficient (m/s/Pa).
Limits: laminar gap. Without a load but the drag it looks like a flow gain that is lower by coefficient drag / A (5
mm/s/MPa: 0.6 %).
In a log: under load the piston creeps in its direction, with i_cmd needed to hold it: like a null bias that grows
with the load.
Source: Merritt (1967), section 6-1, leakage coefficient.
"""

from __future__ import annotations

from plant.effect import HYDRAULIC, Effect, Parameter
from vaneloop.base.compiled import compiled

__all__ = ["EFFECT", "step"]

EFFECT = Effect(
    "internal_leakage",
    "actuator",
    ("actuator",),
    (Parameter("coefficient", "mm/s/MPa", 0.0, 0.0, 50.0, "stroke speed lost per load pressure"),),
    (),
    "oil slips past the loaded piston",
    "a load on the piston: friction or air forces, held for seconds",
    HYDRAULIC,
)


@compiled
def step(v: float, p_load: float, resistance: float, coefficient: float) -> float:
    """Return the speed (m/s) left of ``v`` (m/s) at the load pressure ``p_load`` + ``resistance`` v (Pa, against
    extension).
    """
    if coefficient == 0.0:
        return v
    return (v - coefficient * p_load) / (1.0 + coefficient * resistance)
