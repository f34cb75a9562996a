"""A filter at the amplifier's input: the speed demand follows the command late.

Equation::

    tau di_read/dt = i - i_read,   exact step   i_read <- i_read + (1 - exp(-dt/tau)) (i - i_read)

Symbols: i command current (A), i_read what the speed loop gets (A), tau time constant (s). ``step`` takes the share 1 -
exp(-dt/tau).
Limits: first order; a limit on the demand's slope is another thing.
In a log: the stroke trails the integral of i_cmd by tau; the vanes do not lead x_lvdt, as they do with lvdt_lag. In
closed loop: overshoot from about 10 ms on.
Source: first-order lag, Ogata, Modern Control Engineering (2010), section 5.
"""

from __future__ import annotations

from plant.effect import MOTOR, Effect, Parameter
from vaneloop.base.compiled import compiled

__all__ = ["EFFECT", "step"]

EFFECT = Effect(
    "amplifier_lag",
    "amplifier",
    ("actuator",),
    (Parameter("time_constant", "s", 0.0, 0.0, 0.2, "first-order lag before the speed loop"),),
    ("lagged",),
    "the motor follows its command late",
    "fast motion",
    MOTOR,
)


@compiled
def step(y: float, i: float, share: float) -> float:
    """Return the lagged command (A) one step later; ``share`` = 1 - exp(-dt/tau), 1 for no lag."""
    return i if share >= 1.0 else y + share * (i - y)
