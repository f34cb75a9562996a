"""A current that is not what the controller's tables mean: its gains, or the scaling of its output stage, are off.

Equation::

    kp <- factor kp,   ki <- factor ki,   kff <- factor kff

Symbols: kp, ki, kff gains of the servo (A/m, A/(m s), A/(m/s)), factor (-).
Limits: the current limit stays; an output stage that is off would move it too.
In a log: i_cmd is the same multiple of what x_dem and x_lvdt ask for, in both directions; the stroke tracks with
another error while moving.
Source: definition.
"""

from __future__ import annotations

from plant.effect import Effect, Parameter
from vaneloop.base.compiled import compiled

__all__ = ["EFFECT", "step"]

EFFECT = Effect(
    "controller_gain_error",
    "demand",
    ("servo",),
    (Parameter("factor", "-", 1.0, 0.1, 5.0, "current over what the tables mean"),),
    (),
    "the servo's gains are off",
    "moving strokes, so that the current is not nil",
)


@compiled
def step(gain: float, factor: float) -> float:
    """Return the gain in use for the nominal ``gain``."""
    return gain * factor
