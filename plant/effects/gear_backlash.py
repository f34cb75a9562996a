"""Lost motion between motor and rod: worn gear teeth or screw balls.

Equation::

    d <- min(max(d + du, -w/2), w/2),   the rod moves by what is left of du      (play operator)

Symbols: d motor ahead of the rod (m), du way of the motor in the step, seen at the rod (m), w width (m).
Limits: the vanes' friction holds the rod while the motor crosses the backlash; no blow at its end, and the rod's load
does not press it to one side.
In a log: at each reversal x_lvdt stands until the motor has crossed the width, at the speed that i_cmd asks for; the
loss is the same at each. In closed loop a small limit cycle from some 0.05 mm on.
Source: play operator, see plant/play.py; Nordin and Gutman, Automatica 38 (2002), controlling systems with backlash.
"""

from __future__ import annotations

from plant.effect import MOTOR, Effect, Parameter
from vaneloop.base.compiled import compiled

__all__ = ["EFFECT", "step"]

EFFECT = Effect(
    "gear_backlash",
    "screw",
    ("actuator",),
    (Parameter("width", "mm", 0.0, 0.0, 2.0, "total backlash between motor and rod, at the rod"),),
    ("ahead",),
    "backlash between motor and rod",
    "reversals of the stroke",
    MOTOR,
)


@compiled
def step(ahead: float, travel: float, width: float) -> tuple[float, float]:
    """Return how far (m) the motor is ahead of the rod and the rod's way (m), after ``travel`` (m) of the motor."""
    half = 0.5 * width
    now = min(max(ahead + travel, -half), half)
    return now, travel if width == 0.0 else travel - (now - ahead)
