"""The linkage for lanes side by side: the equations of `plant.linkage` without branches and without the C library.

A compiler puts eight of them into one vector instruction. Tests hold them against `plant.linkage` to rounding.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from plant.series import arcsine, arctangent, tangent
from vaneloop.base.compiled import fused

__all__ = ["Crank", "crank", "crank_numbers", "ring_angle", "ring_numbers", "vane_angle"]


class Crank(NamedTuple):
    """What `crank` needs of the geometry, worked out once.

    lx0, x1, y1  m, of `plant.linkage`
    square       m2, D^2 + Le^2
    reach        m2, D Le: what m cannot exceed
    share        1/m3, 1 / (D^2 Le)
    """

    lx0: float
    x1: float
    y1: float
    square: float
    reach: float
    share: float


@fused
def crank_numbers(lx0: float, x1: float, y1: float, le: float) -> Crank:
    """Return the numbers of a crank with these lengths (m)."""
    d2 = x1 * x1 + y1 * y1
    return Crank(lx0, x1, y1, d2 + le * le, math.sqrt(d2) * le, 1.0 / (d2 * le))


@fused
def crank(stroke: float, g: Crank) -> tuple[float, float]:
    """`plant.linkage.crank`: direction (cos, sin) of the upper arm, of the stroke (m)."""
    lx = g.lx0 + stroke
    m = min(max(0.5 * (g.square - lx * lx), -g.reach), g.reach)  # at the limits stretched or folded
    root = math.sqrt((g.reach - m) * (g.reach + m))
    return (g.x1 * m - g.y1 * root) * g.share, (g.x1 * root + g.y1 * m) * g.share


@fused
def ring_numbers(lc: float, ld: float) -> tuple[float, float]:
    """What `ring_angle` needs of a stage's link and ring radius (m): (Ld^2 - Lc^2, 1 / (2 Ld)), m2 and 1/m."""
    return ld * ld - lc * lc, 0.5 / ld


@fused
def ring_angle(c: float, d: float, ax: float, ay: float, lb: float, span: float, half: float) -> float:
    """`plant.linkage.ring_angle`, rad, for angles within +-90 deg; ``span`` and ``half`` of `ring_numbers`.

    Where the link is stretched or folded, the length of u does not change the angle.
    """
    qx = ax + lb * c
    qy = ay + lb * d
    q2 = qx * qx + qy * qy
    u = (q2 + span) * half
    v = math.sqrt(max(q2 - u * u, 0.0))
    return arctangent(-(qx * u + qy * v), qy * u - qx * v)


@fused
def vane_angle(theta: float, lever: float) -> float:
    """`plant.linkage.vane_angle`, rad, of the ring's angle (rad) within +-45 deg; ``lever`` = Ld'/L."""
    return arcsine(min(max(lever * tangent(theta), -1.0), 1.0))
