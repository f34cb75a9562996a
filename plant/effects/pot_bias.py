"""A stem potentiometer that was rigged off its zero.

Equation::

    reading = vane + bias

Symbols: vane angle (rad), bias (rad).
Limits: constant. Within the rigging tolerance of 0.1 deg it is a recalibration of sensors.*_bias, not an effect.
In a log: one vane row is off by the same angle at every stroke, speed, direction; the others do not.
Source: definition.
"""

from __future__ import annotations

from plant.effect import Effect, per_vane_stage
from vaneloop.base.compiled import compiled

__all__ = ["EFFECT", "step"]

EFFECT = Effect(
    "pot_bias",
    "pot",
    ("linkage",),
    per_vane_stage("deg", 0.0, -10.0, 10.0, "reading above angle, beyond nominal"),
    (),
    "a vane-angle reading is shifted",
    "any run",
)


@compiled
def step(nominal: float, bias: float) -> float:
    """Return the total bias (rad) of a potentiometer whose nominal bias is ``nominal`` (rad)."""
    return nominal + bias
