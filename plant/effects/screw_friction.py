"""Screw, gear and bearings rub more than nominal: worn balls, dry grease, too much preload.

Equation::

    f <- f + force

Symbols: f Coulomb friction seen at the rod (N), force (N).
Limits: the same both ways and at every stroke; sticking holds no more than sliding.
In a log: at each reversal the stroke stops until the speed loop's integral has turned the current round, some 0.1 s.
What it loses (2 r force / (K_t k_p / T_i) r, 60 um for 500 N) does not depend on the speed. Steady motion does not
change. Play (gear_backlash) loses its width in a time that does depend on the speed.
Source: Coulomb friction; Armstrong-Helouvry, Dupont and Canudas de Wit, Automatica 30 (1994), section 2.
"""

from __future__ import annotations

from plant.effect import MOTOR, Effect, Parameter
from vaneloop.base.compiled import compiled

__all__ = ["EFFECT", "step"]

EFFECT = Effect(
    "screw_friction",
    "screw",
    ("actuator",),
    (Parameter("force", "N", 0.0, 0.0, 10000.0, "Coulomb friction at the rod beyond nominal"),),
    (),
    "screw and gear rub more",
    "reversals of the stroke",
    MOTOR,
)


@compiled
def step(friction: float, force: float) -> float:
    """Return the Coulomb friction (N at the rod)."""
    return friction + force
