"""Seals that hold longer than they drag: at rest and at creeping speed the friction is greater.

Equation::

    level = force + excess S(v),   S(v) = (1 + r / 8)^-8 (1 + 50 r) / (1 + 100 r),   r = (v/speed)^2

Symbols: level greatest friction force (N), force Coulomb's (N), excess above it at rest (N), v speed of the oil
(m/s), speed Stribeck speed (m/s). The first factor of S is within 0.035 of the usual exp(-r) and needs no
transcendental function. The second falls from 1 to 1/2 about a tenth of the Stribeck speed: there the piston sticks
and slips on its oil column, and the mean of that sawtooth is half the excess.
Limits: the sawtooth itself, some hundred hertz and up to C excess high, is not in it (C see oil_compressibility). It
stays as scatter. Of a sawtooth as high as twice what the second factor takes off, A = excess (1 + r / 8)^-8 100 r / (1
+ 100 r), the RMS is A / sqrt(12) (`scatter`).
In a log: lost motion at reversals as with piston_friction, 2 C (force + excess), but hardly slower at speed; after
slow reversals a small catching up when it lets go; scatter of some micrometres in slow motion.
Source: Stribeck curve and stick-slip, Armstrong-Helouvry, Dupont, Canudas de Wit, Automatica 30 (1994), sections 2
and 3.
"""

from __future__ import annotations

import numpy as np

from plant.effect import HYDRAULIC, Effect, Parameter
from vaneloop.base.compiled import compiled

__all__ = ["EFFECT", "scatter", "step"]

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
    HYDRAULIC,
)


@compiled
def step(force: float, v: float, excess: float, speed: float) -> float:
    """Return the greatest friction force (N) at the speed ``v`` (m/s)."""
    if excess == 0.0:
        return force
    r2 = (v / speed) * (v / speed)
    a = 1.0 / (1.0 + 0.125 * r2)
    a *= a
    a *= a
    return force + excess * (a * a) * (1.0 + 50.0 * r2) / (1.0 + 100.0 * r2)


def scatter(v: np.ndarray, excess: float, speed: float) -> np.ndarray:
    """RMS (N) of the friction's sawtooth about its mean at the speeds ``v`` (m/s)."""
    r = (v / speed) ** 2
    return np.asarray(excess * (1.0 + 0.125 * r) ** -8 * 100.0 * r / (1.0 + 100.0 * r) / np.sqrt(12.0))
