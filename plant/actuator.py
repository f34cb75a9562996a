"""Hydraulic actuator: the spool opens the way for the oil, the load takes part of the supply pressure.

Equation::

    dx/dt = g u sqrt(max(0, (p_s - sign(u) p_L) / p_ref)),   p_L = F / A,   0 <= x <= stroke

Symbols: g flow gain (m/s at full spool and p_ref = 21 MPa), u spool (-), p_s supply pressure (Pa), F force against
extension (N), A piston area (m2), x stroke (m). Hard stops at both ends. Oil and piston are without inertia and
compliance here.

Source: orifice equation of a critically lapped four-way valve, Merritt (1967), ch. 5.
"""

from __future__ import annotations

import math

from vaneloop.base.compiled import compiled

__all__ = ["speed_factor", "stroke_step"]


@compiled
def speed_factor(p_s: float, p_load: float, p_ref: float) -> float:
    """Return sqrt((p_s - p_load)/p_ref), 0 where the load exceeds the supply. Pressures in Pa, ``p_load`` against the
    motion.
    """
    return math.sqrt(max(0.0, (p_s - p_load) / p_ref))


@compiled
def stroke_step(x: float, v_before: float, v_after: float, stroke: float, dt: float) -> float:
    """Return the stroke (m) after ``dt`` (s) with the speed going straight from ``v_before`` to ``v_after`` (m/s),
    between the stops.
    """
    return min(max(x + 0.5 * (v_before + v_after) * dt, 0.0), stroke)
