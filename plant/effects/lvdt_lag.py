"""A slow filter behind the demodulator: the stroke reading trails the stroke, beside its nominal lag.

Equation::

    tau dy/dt = x - y,   exact step   y <- y + (1 - exp(-dt/tau)) (x - y)

Symbols: x stroke behind the nominal lag (m), y reading (m), tau time constant (s). ``step`` takes the share 1 -
exp(-dt/tau).
Limits: first order; a sampled filter adds dead time.
In a log: x_lvdt trails i_cmd's integral by tau, and the vanes lead x_lvdt by tau: only motion shows it. In closed
loop: overshoot from about 10 ms on.
Source: first-order lag, Ogata, Modern Control Engineering (2010), section 5.
"""

from __future__ import annotations

from plant.effect import Effect, Parameter
from vaneloop.base.compiled import compiled

__all__ = ["EFFECT", "step"]

EFFECT = Effect(
    "lvdt_lag",
    "lvdt",
    ("actuator", "linkage"),
    (Parameter("time_constant", "s", 0.0, 0.0, 0.2, "first-order lag behind the demodulator"),),
    ("reading",),
    "the stroke reading is late",
    "fast motion",
)


@compiled
def step(y: float, x: float, share: float) -> float:
    """Return the lagged stroke (m) one step later; ``share`` = 1 - exp(-dt/tau), 1 for no lag."""
    return x if share >= 1.0 else y + share * (x - y)
