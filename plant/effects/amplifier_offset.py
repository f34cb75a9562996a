"""The amplifier reads a command where there is none: its input stage or the tachometer's zero has drifted.

Equation::

    i_read = i_cmd + offset

Symbols: i command current (A), offset (A), > 0 extends.
Limits: constant; the drift of the zero with temperature is not in it.
In a log: the current that holds the stroke still is -offset; without a current the rod creeps at w_rated offset /
i_rated (1 mA: 3.75 mm/s). In closed loop the integrator hides it: only the mean of i_cmd shows it.
Source: definition; the offset that the maker of an analogue amplifier lets one trim.
"""

from __future__ import annotations

from plant.effect import MOTOR, Effect, Parameter
from vaneloop.base.compiled import compiled

__all__ = ["EFFECT", "step"]

EFFECT = Effect(
    "amplifier_offset",
    "amplifier",
    ("actuator",),
    (Parameter("offset", "mA", 0.0, -20.0, 20.0, "current that the amplifier adds to its command"),),
    (),
    "the motor turns at zero current",
    "any run of some seconds",
    MOTOR,
)


@compiled
def step(i: float, offset: float) -> float:
    """Return the current (A) that the amplifier reads as its command."""
    return i + offset
