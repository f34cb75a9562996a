"""A vertical link whose turnbuckle is set too long or too short.

Equation::

    Lc <- Lc + error

Symbols: Lc vertical link (m), error (m); the linkage's equations (plant/linkage.py) do the rest.
Limits: geometry only; where the linkage cannot be assembled it is held at the nearest stretched position.
In a log: the vane row's angle is off by about -1.6 deg for 1 mm, nearly the same at every stroke: an offset, like a
potentiometer's bias but for a slight dependence on the angle.
Source: Kim & Ki 2020, section 5: 1 mm of link is 1.6 deg.
"""

from __future__ import annotations

from plant.effect import Effect, per_vane_stage
from vaneloop.base.compiled import compiled

__all__ = ["EFFECT", "step"]

EFFECT = Effect(
    "link_length_error",
    "linkage",
    ("linkage",),
    per_vane_stage("mm", 0.0, -5.0, 5.0, "vertical link longer than in the table"),
    (),
    "a vertical link is too long or too short",
    "any run",
)


@compiled
def step(lc: float, error: float) -> float:
    """Return the vertical link's length (m)."""
    return lc + error
