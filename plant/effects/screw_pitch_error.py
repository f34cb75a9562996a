"""A screw whose lead sways once a turn: a bent spindle or a nut that stands askew.

Equation::

    dx/du = 1 + (2 pi amplitude / lead) cos(2 pi x / lead + phase)

Symbols: x stroke (m), u stroke of a straight screw (m), amplitude of the error (m), lead (m), phase (rad).
Limits: one sine a turn, small against the lead / 2 pi; slow errors over the whole screw are as lvdt_nonlinearity.
In a log: the speed for a given i_cmd sways with the stroke, once each lead (5 mm), both ways alike. The vanes follow
the true stroke, so the linkage stays clean.
Source: ISO 3408-3:2006, travel deviation within one revolution (2 pi).
"""

from __future__ import annotations

import math

from plant.effect import MOTOR, Effect, Parameter
from vaneloop.base.compiled import compiled

__all__ = ["EFFECT", "step"]

EFFECT = Effect(
    "screw_pitch_error",
    "screw",
    ("actuator",),
    (
        Parameter("amplitude", "mm", 0.0, 0.0, 0.4, "sine of one screw turn in the stroke"),
        Parameter("phase", "deg", 0.0, -180.0, 180.0, "its phase at the retracted stop", period=360.0),
    ),
    (),
    "the screw's lead sways once a turn",
    "strokes over some turns of the screw",
    MOTOR,
)


@compiled
def step(x: float, travel: float, lead: float, amplitude: float, phase: float) -> float:
    """Return the way (m) of the rod at the stroke ``x`` (m) for ``travel`` (m) of a straight screw."""
    if amplitude == 0.0:
        return travel
    k = 2.0 * math.pi / lead
    return travel * (1.0 + k * amplitude * math.cos(k * (x + 0.5 * travel) + phase))
