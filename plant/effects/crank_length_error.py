"""A bell crank whose lower arm is longer or shorter than the table's.

Equation::

    Lb <- Lb + error

Symbols: Lb lower arm (m), error (m); the linkage's equations (plant/linkage.py) do the rest.
Limits: geometry only; where the linkage cannot be assembled it is held at the nearest stretched position.
In a log: the vane row's angle is off in proportion to the distance from the stroke at which the lower arm is square to
its link: slope, hardly offset.
Source: Kim & Ki 2020, equations (8) to (15), section 5 (arms adjusted by 1 and 3 mm).
"""

from __future__ import annotations

from plant.effect import Effect, per_vane_stage
from vaneloop.base.compiled import compiled

__all__ = ["EFFECT", "step"]

EFFECT = Effect(
    "crank_length_error",
    "linkage",
    ("linkage",),
    per_vane_stage("mm", 0.0, -10.0, 10.0, "lower arm longer than in the table"),
    (),
    "a lower crank arm is too long or too short",
    "strokes over most of the range",
)


@compiled
def step(lb: float, error: float) -> float:
    """Return the lower arm's length (m)."""
    return lb + error
