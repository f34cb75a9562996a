"""An end stop in the wrong place: the piston cannot go all the way in, or all the way out.

Equation::

    max(0, shift) <= x <= stroke + min(0, shift)

Symbols: x stroke (m), shift (m): > 0 moves the retraction stop in, < 0 the extension stop.
Limits: rigid stop, no bounce.
In a log: x_lvdt stands at a value inside the stroke while x_dem goes beyond it and i_cmd saturates; otherwise
nothing.
Source: definition.
"""

from __future__ import annotations

from plant.effect import Effect, Parameter
from vaneloop.base.compiled import compiled

__all__ = ["EFFECT", "step"]

EFFECT = Effect(
    "end_stop_shift",
    "actuator",
    ("actuator",),
    (Parameter("shift", "mm", 0.0, -20.0, 20.0, "retraction stop in (> 0), extension stop in (< 0)"),),
    (),
    "an end stop stands inside the stroke",
    "strokes near both ends",
)


@compiled
def step(stroke: float, shift: float) -> tuple[float, float]:
    """Return the lowest and the highest stroke (m)."""
    return max(0.0, shift), stroke + min(0.0, shift)
