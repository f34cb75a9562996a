"""Seals hold the piston: a constant force against its motion, which the oil must overcome before it moves.

Equation, with s the way that the oil has pushed (m), z the friction force (N), level the greatest one, C the
compliance of the oil (m/N)::

    z <- clip(z + ds / C, -level, level),   dx = ds - C dz,   p_L = (F + z) / A

Symbols: x stroke (m), F load (N), level = force (with piston_stiction: more at low speed), C see oil_compressibility,
A area (m2), p_L load pressure (Pa). In words: at a reversal the oil is first compressed by 2 C force while the piston
stands; then the force is Coulomb's.
Limits: no viscous part (it is in the flow gain), no presliding of the seals themselves; the piston has no mass.
In a log: the stroke loses 2 C force at each reversal (2 kN: 25 um), and runs slower by force / (2 A p_s) both ways (2
kN: 4 %). In closed loop the tracking hardly changes; i_cmd rises.
Source: Coulomb friction on an elastic support (Prandtl), Armstrong-Helouvry, Dupont, Canudas de Wit, Automatica 30
(1994), section 2.
"""

from __future__ import annotations

from plant.compiled import compiled
from plant.effect import Effect, Parameter

__all__ = ["EFFECT", "step"]

EFFECT = Effect(
    "piston_friction",
    "actuator",
    ("actuator",),
    (Parameter("force", "N", 0.0, 0.0, 20000.0, "Coulomb friction"),),
    ("force",),
    "seals hold the piston back",
    "reversals, and fast motion",
)


@compiled
def step(z, travel, level, stiffness):
    """Return the friction force (N) after the oil has pushed by ``travel`` (m) from where it was ``z`` (N); ``stiffness`` 1/C (N/m)."""
    if level == 0.0:
        return 0.0
    return min(max(z + travel * stiffness, -level), level)
