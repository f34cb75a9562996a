"""A slow first stage: the current reaches the spool through a lag, beside the spool's own second-order response.

Equation::

    tau di/dt = i_cmd - i,   exact step   i <- i + (1 - exp(-dt/tau)) (i_cmd - i)

Symbols: i current that drives the spool (A), tau time constant (s), dt step (s). ``step`` takes the share 1 -
exp(-dt/tau).
Limits: linear; a first stage that is slow for large strokes only is a rate limit instead.
In a log: the stroke trails what i_cmd asks for by tau, at any size of motion. In closed loop: overshoot, ringing as
tau nears 10 ms.
Source: coil inductance and first stage, Merritt, Hydraulic Control Systems (1967), ch. 7.
"""

from __future__ import annotations

from plant.effect import HYDRAULIC, Effect, Parameter
from vaneloop.base.compiled import compiled

__all__ = ["EFFECT", "step"]

EFFECT = Effect(
    "valve_lag",
    "valve",
    ("actuator",),
    (Parameter("time_constant", "s", 0.0, 0.0, 0.2, "first-order lag before the spool"),),
    ("current",),
    "the current reaches the spool late",
    "quick reversals or steps of the current",
    HYDRAULIC,
)


@compiled
def step(i: float, i_cmd: float, share: float) -> float:
    """Return the lagged current (A) one step later; ``share`` = 1 - exp(-dt/tau), 1 for no lag."""
    return i_cmd if share >= 1.0 else i + share * (i_cmd - i)
