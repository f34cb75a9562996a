"""Seals that hold longer than they drag: at rest and at creeping speed the friction is greater.

Equation::

    level = force + excess S(v),   S(v) = (1 + (v/speed)^2 / 8)^-8

Symbols: level greatest friction force (N), force Coulomb's (N), excess above it at rest (N), v speed of the oil
(m/s), speed Stribeck speed (m/s). S is within 0.035 of the usual exp(-(v/speed)^2) and needs no transcendental
function.
Limits: the piston is massless and v is the oil's speed: no stick-slip oscillation comes out, only the lost motion and
the force.
In a log: lost motion at reversals as with piston_friction, 2 C (force + excess), but hardly slower at speed; after
slow reversals a small catching up when it lets go.
Source: Stribeck curve, Armstrong-Helouvry, Dupont, Canudas de Wit, Automatica 30 (1994), section 2.
"""

from __future__ import annotations

from plant.compiled import compiled
from plant.effect import Effect, Parameter

__all__ = ["EFFECT", "step"]

EFFECT = Effect(
    "piston_stiction",
    "actuator",
    ("actuator",),
    (
        Parameter("excess", "N", 0.0, 0.0, 20000.0, "breakaway force above Coulomb friction"),
        Parameter("speed", "mm/s", 5.0, 0.1, 100.0, "Stribeck speed"),
    ),
    (),
    "seals hold the resting piston more than the moving one",
    "slow reversals beside fast motion",
)


@compiled
def step(force, v, excess, speed):
    """Return the greatest friction force (N) at the speed ``v`` (m/s)."""
    if excess == 0.0:
        return force
    r = v / speed
    a = 1.0 / (1.0 + 0.125 * r * r)
    a *= a
    a *= a
    return force + excess * (a * a)
