"""Electro-hydraulic servo valve: the spool follows the current like a damped mass on a spring, between its stops.

Equation, with u the spool position as a fraction of its rated travel::

    u'' + 2 zeta w u' + w^2 u = w^2 i / i_rated,   -1 <= u <= 1

Symbols: w = 2 pi bandwidth (rad/s), zeta damping (-), i current (A). The current is constant over a step, so the step
below is exact (the matrix exponential in closed form), whatever its length, as long as the spool stays off its stops;
at a stop the spool rests.

Source: Merritt, Hydraulic Control Systems (1967), ch. 7: second-order fit to a two-stage valve's frequency response.
"""

from __future__ import annotations

import math

from vaneloop.base.compiled import compiled

__all__ = ["valve_matrix", "valve_step"]


@compiled
def valve_matrix(bandwidth: float, damping: float, dt: float) -> tuple[float, float, float, float]:
    """Return (a11, a12, a21, a22) of the exact step of (u - i/i_rated, u') over ``dt`` (s).

    bandwidth: Hz, damping: in (0, 1).
    """
    w = 2.0 * math.pi * bandwidth
    wd = w * math.sqrt(1.0 - damping * damping)
    e = math.exp(-damping * w * dt)
    c, s = math.cos(wd * dt), math.sin(wd * dt)
    r = damping * w / wd
    return e * (c + r * s), e * s / wd, -e * s * w * w / wd, e * (c - r * s)


@compiled
def valve_step(
    u: float, du: float, target: float, a11: float, a12: float, a21: float, a22: float
) -> tuple[float, float]:
    """Return the spool (u, u') one step later, for the demand ``target`` = i / i_rated."""
    d = u - target
    u1 = target + a11 * d + a12 * du
    du1 = a21 * d + a22 * du
    if u1 > 1.0:
        return 1.0, 0.0
    if u1 < -1.0:
        return -1.0, 0.0
    return u1, du1
