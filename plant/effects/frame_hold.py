"""Stale content: frames go on arriving every 10 ms, but what is in them is renewed more seldom.

Equation::

    content(t) = sent(period floor(t / period))

Symbols: t time (s), period of renewal (s); 0 renews with every frame. A thousandth of a millisecond counts as
reached.
Limits: the renewal is strictly periodic from t = 0; a sender that renews on change looks different.
In a log: x_dem moves in equal stairs while n_dem is smooth; on average it trails by half the period. Invisible in
dwells.
Source: zero-order hold, Franklin, Powell, Workman, Digital Control of Dynamic Systems (1998), section 5.
"""

from __future__ import annotations

import math

from plant.effect import Effect, Parameter
from vaneloop.base.compiled import compiled

__all__ = ["EFFECT", "step"]

EFFECT = Effect(
    "frame_hold",
    "demand",
    ("demand",),
    (Parameter("period", "s", 0.0, 0.0, 1.0, "time between two renewals of a frame's content"),),
    (),
    "the content of the ECU's frames changes only now and then",
    "a demand that moves for longer than the period",
)


@compiled
def step(t: float, period: float) -> float:
    """Return the time (s) of the content that a frame at ``t`` (s) carries."""
    if period <= 0.0:
        return t
    return math.floor((t + 1e-6) / period) * period
