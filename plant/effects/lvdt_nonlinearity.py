"""Windings that are not uniform: the stroke sensor's error bends over the stroke.

Equation, with r the stroke from the middle over half the stroke (-1 to 1)::

    reading = x - amplitude sin(2 pi x / stroke) + cubic (5 r^3 - 3 r) / 2

Symbols: x stroke (m), amplitude (m), cubic (m), stroke full stroke (m). The sine is nil at both ends and in the middle.
The cubic is what coils that weaken towards their ends give, with its straight part, which is a gain, taken out.
Limits: two odd shapes about mid-stroke; an even one moves the null and is left out. Beyond the stroke the cubic stays
what it is at its end.
In a log: vanes off one way in one half of the stroke and the other way in the other half, all vane rows at once;
independent of direction and speed.
Source: 0.25 % of range is a usual data-sheet linearity of an LVDT; Herceg, Handbook of Measurement and Control (1976).
"""

from __future__ import annotations

import math

from plant.effect import Effect, Parameter
from vaneloop.base.compiled import compiled

__all__ = ["EFFECT", "slope", "step"]

EFFECT = Effect(
    "lvdt_nonlinearity",
    "lvdt",
    ("actuator", "linkage"),
    (
        Parameter(
            "amplitude", "mm", 0.0, -3.0, 3.0, "one sine wave of error over the stroke, reading high in its upper half"
        ),
        Parameter(
            "cubic", "mm", 0.0, -1.0, 1.0, "cubic error at full stroke, reading high there, without its straight part"
        ),
    ),
    (),
    "the stroke reading bends over the stroke",
    "strokes over most of the range",
)


@compiled
def step(x: float, stroke: float, amplitude: float, cubic: float) -> float:
    """Return the reading (m) of the stroke ``x`` (m)."""
    y = x if amplitude == 0.0 else x - amplitude * math.sin(2.0 * math.pi * x / stroke)
    if cubic != 0.0:
        r = min(max(2.0 * x / stroke - 1.0, -1.0), 1.0)
        y += cubic * 0.5 * (5.0 * r * r - 3.0) * r
    return y


@compiled
def slope(x: float, stroke: float, amplitude: float, cubic: float) -> float:
    """Return the derivative of the reading by the stroke, at ``x`` (m)."""
    r = 2.0 * x / stroke - 1.0
    sine = amplitude * (2.0 * math.pi / stroke) * math.cos(2.0 * math.pi * x / stroke)
    bend = cubic * (15.0 * r * r - 3.0) / stroke if abs(r) < 1.0 else 0.0
    return 1.0 - sine + bend
