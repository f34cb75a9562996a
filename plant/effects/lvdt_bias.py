"""The stroke sensor is mounted off its zero.

Equation::

    reading = x + bias

Symbols: x stroke (m), bias (m).
Limits: constant.
In a log: the servo hides it, x_lvdt follows x_dem; the vanes stand off by bias times their slope (about 1 deg/mm),
all vane rows at once and in the ratio of their slopes. At an end stop x_lvdt reads the bias.
Source: definition.
"""

from __future__ import annotations

from plant.effect import Effect, Parameter
from vaneloop.base.compiled import compiled

__all__ = ["EFFECT", "step"]

EFFECT = Effect(
    "lvdt_bias",
    "lvdt",
    ("actuator", "linkage"),
    (Parameter("bias", "mm", 0.0, -5.0, 5.0, "reading above stroke"),),
    (),
    "the stroke reading is shifted",
    "vane angles logged, or strokes at an end stop",
)


@compiled
def step(x: float, bias: float) -> float:
    """Return the reading (m) of the stroke ``x`` (m)."""
    return x + bias
