"""Vertical links of one side that are set too long or too short, all by the same length.

Equation::

    Lc_side <- Lc_side + length

Symbols: Lc_side vertical link of any ring between the crank of this side and the ring (m), length (m). The linkage's
equations (plant/linkage.py) say to where this side alone would turn each ring; plant/unison.py what both sides do then.
Limits: geometry only; all links of the side are off alike, as by one gauge. One link alone is not told.
In a log: at equal strokes both sides ask unequal angles of the rings. They load both pistons against each other at
every stroke: the strokes part, or the pistons hold each other by their load. The vanes are off by half of what one link
makes (plant/effects/link_length_error.py), about -0.8 deg for 1 mm.
Source: two springs between unequal places; Kim & Ki 2020, section 5: 1 mm of link is 1.6 deg.
"""

from __future__ import annotations

from plant.effect import PAIR, Effect, Parameter
from vaneloop.base.compiled import compiled

__all__ = ["EFFECT", "step"]

EFFECT = Effect(
    "rigging_offset",
    "link",
    ("actuator", "linkage"),
    (Parameter("length", "mm", 0.0, -5.0, 5.0, "vertical links of this side longer than in the table"),),
    (),
    "the links of one side are set too long or too short",
    "any run with both strokes",
    PAIR,
)


@compiled
def step(lc: float, length: float) -> float:
    """Return the length (m) of a vertical link of this side."""
    return lc + length
