"""A rotor that is slower or quicker than the table says: more inertia, another fuel control.

Equation::

    dn/dt = clip((n_dem - n) / (lag_nominal + lag), -deceleration, acceleration)

Symbols: n, n_dem speed and demand (%), lag beyond nominal (s).
Limits: one lag at all speeds; the total is kept above 10 ms.
In a log: n_r trails n_dem by more (or less) at every change that the acceleration limits do not govern; on a ramp of
r %/s by r lag more.
Source: first-order lag, Ogata, Modern Control Engineering (2010), section 5.
"""

from __future__ import annotations

from plant.effect import Effect, Parameter
from vaneloop.base.compiled import compiled

__all__ = ["EFFECT", "step"]

EFFECT = Effect(
    "rotor_lag_error",
    "engine",
    ("engine",),
    (Parameter("lag", "s", 0.0, -1.15, 10.0, "lag beyond nominal"),),
    (),
    "the rotor's lag is not the nominal one",
    "changes of the demand below the acceleration limits",
)


@compiled
def step(nominal: float, lag: float) -> float:
    """Return the rotor's lag (s)."""
    return max(nominal + lag, 1e-2)
