"""The stroke sensor's excitation or demodulator is off: it reads too much or too little of every stroke.

Equation::

    reading = factor x

Symbols: x stroke from full retraction (m), factor (-).
Limits: linear; the gain's centre is taken at stroke 0, another centre adds a bias.
In a log: vanes off in proportion to stroke, all vane rows at once; the actuator looks faster by the factor for the
same current.
Source: definition.
"""

from __future__ import annotations

from plant.effect import Effect, Parameter
from vaneloop.base.compiled import compiled

__all__ = ["EFFECT", "step"]

EFFECT = Effect(
    "lvdt_gain",
    "lvdt",
    ("actuator", "linkage"),
    (Parameter("factor", "-", 1.0, 0.8, 1.25, "reading over stroke"),),
    (),
    "the stroke reading is out of scale",
    "strokes over most of the range",
)


@compiled
def step(x: float, factor: float) -> float:
    """Return the reading (m) of the stroke ``x`` (m)."""
    return x * factor
