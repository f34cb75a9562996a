"""A stroke table flashed with an offset: the controller asks for another stroke at every speed.

Equation::

    x_table <- x_table + offset

Symbols: x_table every stroke of the extension, retraction and mean curve (m), offset (m).
Limits: the same offset at all speeds and in both directions; the controller's stroke limits still hold.
In a log: x_dem stands off the tables by the same millimetres at every speed and direction; everything behind follows
x_dem correctly.
Source: definition.
"""

from __future__ import annotations

from plant.effect import Effect, Parameter
from vaneloop.base.compiled import compiled

__all__ = ["EFFECT", "step"]

EFFECT = Effect(
    "schedule_error",
    "demand",
    ("demand",),
    (Parameter("offset", "mm", 0.0, -5.0, 5.0, "shift of every stroke in the tables"),),
    (),
    "the stroke tables are shifted",
    "any run",
)


@compiled
def step(x_table: float, offset: float) -> float:
    """Return the stroke (m) that the flashed table holds where the right one holds ``x_table`` (m)."""
    return x_table + offset
