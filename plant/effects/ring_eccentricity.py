"""A unison ring that does not turn about its own centre: its angle picks up a sine of itself.

Equation::

    th <- th + amplitude sin(th + phase)

Symbols: th ring angle before the backlash (rad), amplitude (rad), phase direction of the eccentricity (rad), the same
for the rings.
Limits: first harmonic; the ring turns by some 10 deg only, of which an offset, a slope and a slight curvature are
seen.
In a log: offset and slope of one vane row's angle over stroke, both directions alike. Hard to distinguish from
pot_bias and pot_gain on a short stroke.
Source: eccentric sheave, Shigley, Theory of Machines and Mechanisms.
"""

from __future__ import annotations

import math

from plant.effect import Effect, Parameter, per_vane_stage
from vaneloop.base.compiled import compiled

__all__ = ["EFFECT", "step"]

EFFECT = Effect(
    "ring_eccentricity",
    "linkage",
    ("linkage",),
    (
        *per_vane_stage("deg", 0.0, 0.0, 2.0, "sine of the ring's own angle added to it"),
        Parameter("phase", "deg", 0.0, -180.0, 180.0, "direction of the eccentricity", period=360.0),
    ),
    (),
    "a ring turns about the wrong centre",
    "strokes over most of the range",
)


@compiled
def step(theta: float, amplitude: float, phase: float) -> float:
    """Return the ring angle (rad) for the angle ``theta`` (rad) of a centred ring."""
    return theta if amplitude == 0.0 else theta + amplitude * math.sin(theta + phase)
