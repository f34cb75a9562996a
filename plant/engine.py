"""Rotor speed: follows its demand with a lag, inside the limits of the acceleration and deceleration schedules.

Equation::

    dn/dt = clip((n_dem - n) / lag, -deceleration, acceleration)

Symbols: n, n_dem in % of design speed, lag in s, limits in %/s. The step is explicit Euler; at 1 ms and a lag of 1.2 s
its error is below 0.05 % of the change.
"""

from __future__ import annotations

from vaneloop.base.compiled import compiled

__all__ = ["engine_step"]


@compiled
def engine_step(n: float, n_dem: float, lag: float, acceleration: float, deceleration: float, dt: float) -> float:
    """Return the rotor speed (%) after ``dt`` (s)."""
    return n + min(max((n_dem - n) / lag, -deceleration), acceleration) * dt
