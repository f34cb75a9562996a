"""Age of the bus: every frame of the ECU reaches the controller later than it was sent.

Equation::

    content(t) = sent(t - delay)

Symbols: t time of arrival (s), delay (s), sent(t) newest frame at t. The engine itself gets its demand without the
delay.
Limits: the delay is constant; frames neither overtake each other nor get lost. The controller looks at frames every
10 ms, so that between two multiples of 10 ms nothing changes.
In a log: x_dem trails what n_dem and n_r ask for by the same time in rise and fall, at any rate; a ramp of 3 mm/s
shows 0.3 mm for 0.1 s.
Source: dead time of a sampled signal, Franklin, Powell, Workman, Digital Control of Dynamic Systems (1998), section
3.
"""

from __future__ import annotations

from plant.effect import Effect, Parameter
from vaneloop.base.compiled import compiled

__all__ = ["EFFECT", "step"]

EFFECT = Effect(
    "can_delay",
    "demand",
    ("demand",),
    (Parameter("delay", "s", 0.0, 0.0, 1.0, "age of a frame when the controller gets it"),),
    (),
    "frames of the ECU arrive late",
    "rises or falls of the demand; the faster, the finer the delay that shows",
)


@compiled
def step(t: float, delay: float) -> float:
    """Return the time (s) of the content that a frame arriving at ``t`` (s) carries."""
    return t - delay
