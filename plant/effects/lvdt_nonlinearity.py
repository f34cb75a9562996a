"""Windings that are not uniform: the stroke sensor's error swings once over the stroke.

Equation::

    reading = x - amplitude sin(2 pi x / stroke)

Symbols: x stroke (m), amplitude (m), stroke full stroke (m). The error is nil at both ends and in the middle,
negative first.
Limits: the first harmonic only.
In a log: vanes off one way at a quarter of the stroke and the other way at three quarters, all three stages at once;
independent of direction and speed.
Source: 0.25 % of range is a usual data-sheet linearity of an LVDT.
"""

from __future__ import annotations

import math

from plant.compiled import compiled
from plant.effect import Effect, Parameter

__all__ = ["EFFECT", "step"]

EFFECT = Effect(
    "lvdt_nonlinearity",
    "lvdt",
    ("actuator", "linkage"),
    (Parameter("amplitude", "mm", 0.0, -3.0, 3.0, "one sine wave of error over the stroke, reading high in its upper half"),),
    (),
    "the stroke reading swings over the stroke",
    "strokes over most of the range",
)


@compiled
def step(x, stroke, amplitude):
    """Return the reading (m) of the stroke ``x`` (m)."""
    return x if amplitude == 0.0 else x - amplitude * math.sin(2.0 * math.pi * x / stroke)
