"""The mechanism's joints in space."""

from __future__ import annotations

import cmath
import math

from plant.geometry import DEG, MM, Geometry
from plant.linkage import G_LE, G_LX0, G_X1, G_Y1, STAGES, crank, stage_ring_angle

__all__ = ["plane_joints"]


def plane_joints(geometry: Geometry, stage: str, stroke: float) -> dict[str, complex]:
    """Places J0 to J5 of one stage's joints in the plane, x + i y in m, at a stroke (m); the actuator's mount J0 is the origin.

    The angle between the crank's arms is theta6 less the inclination of the line from J2 to J5 (docs/linkage.md).
    """
    k = STAGES.index(stage)
    g, s = geometry.arrays(), geometry.stages()[k]
    dx, dy = s.dx.value * MM, s.dy.value * MM
    between = s.theta6.value * DEG - math.atan2(dx, -dy)
    c, d = crank(stroke, g[G_LX0], g[G_X1], g[G_Y1], g[G_LE])
    e = complex(c, d)
    j2 = complex(g[G_X1], g[G_Y1])
    j5 = j2 + complex(dx, dy)
    turn = cmath.exp(-1j * between)
    j3 = j2 - s.lb.value * MM * e * turn
    j4 = j5 - s.ld.value * MM * 1j * cmath.exp(1j * stage_ring_angle(stroke, g, k)) * turn
    return {"J0": 0j, "J1": j2 - g[G_LE] * e, "J2": j2, "J3": j3, "J4": j4, "J5": j5}
