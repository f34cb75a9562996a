"""A stem potentiometer with a wrong scale: reference voltage or track length.

Equation::

    reading = factor vane

Symbols: vane angle (rad), factor (-). The bias is added after it.
Limits: linear about vane angle 0.
In a log: one vane row's error grows in proportion to its angle, and its hysteresis is wider by the factor too.
Source: definition.
"""

from __future__ import annotations

from plant.effect import Effect, per_vane_stage
from vaneloop.base.compiled import compiled

__all__ = ["EFFECT", "step"]

EFFECT = Effect(
    "pot_gain",
    "pot",
    ("linkage",),
    per_vane_stage("-", 1.0, 0.8, 1.25, "reading over angle"),
    (),
    "a vane-angle reading is out of scale",
    "strokes over most of the range",
)


@compiled
def step(vane: float, factor: float) -> float:
    """Return the reading (rad) of the angle ``vane`` (rad)."""
    return vane * factor
