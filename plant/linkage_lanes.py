"""The linkage for lanes side by side: the equations of `plant.linkage` without branches and without the C library.

A compiler puts eight of them into one vector instruction. Tests hold them against `plant.linkage` to rounding.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from vaneloop.base.compiled import fused

__all__ = [
    "Crank", "arcsine", "arctangent", "crank", "crank_numbers", "ring_angle", "ring_numbers", "tangent",
    "vane_angle",
]  # fmt: skip

# ---- Arctangent, arcsine and tangent from sums, products, a division or two, without branches: rational approximations
# of the Cephes library (Moshier 1989; atan.c, tan.c) and of fdlibm (Sun 1993; e_asin.c), within 2 units in the last
# place of the C library's, which the chain itself calls.

QUARTER = 0.25 * math.pi


@fused
def arctangent(sine: float, cosine: float) -> float:
    """Return atan(sine / cosine), rad, for cosine > 0 (or 0 where sine is not)."""
    a = abs(sine)
    far, middle = a > 2.41421356237309504880 * cosine, a > 0.66 * cosine
    start = 2.0 * QUARTER if far else (QUARTER if middle else 0.0)
    x = (-cosine if far else (a - cosine if middle else a)) / (a if far else (a + cosine if middle else cosine))
    z = x * x
    p = ((-8.750608600031904122785e-1 * z - 1.615753718733365076637e1) * z - 7.500855792314704667340e1) * z
    p = (p - 1.228866684490136173410e2) * z - 6.485021904942025371773e1
    q = ((z + 2.485846490142306297962e1) * z + 1.650270098316988542046e2) * z + 4.328810604912902668951e2
    q = (q * z + 4.853903996359136964868e2) * z + 1.945506571482613964425e2
    y = start + (x + x * (z * p / q))
    return y if sine >= 0.0 else -y


@fused
def tangent(x: float) -> float:
    """Return tan(x), x in rad, held at +-1 beyond +-45 deg."""
    x = min(max(x, -QUARTER), QUARTER)
    z = x * x
    p = (-1.30936939181383734205e4 * z + 1.15351664838587416140e6) * z - 1.79565251976484877988e7
    q = (
        ((z + 1.36812963470692954678e4) * z - 1.32089234440210967447e6) * z + 2.50083801823357915839e7
    ) * z - 5.38695755929454629881e7
    return x + x * (z * p / q)


@fused
def arcsine(x: float) -> float:
    """Return asin(x), rad, for x within +-1."""
    a = abs(x)
    far = a > 0.5  # asin a = pi/2 - 2 asin sqrt((1 - a) / 2)
    z = 0.5 * (1.0 - a) if far else a * a
    p = (3.47933107596021167570e-5 * z + 7.91534994289814532176e-4) * z - 4.00555345006794114027e-2
    p = ((p * z + 2.01212532134862925881e-1) * z - 3.25565818622400915405e-1) * z + 1.66666666666666657415e-1
    q = (7.70381505559019352791e-2 * z - 6.88283971605453293030e-1) * z + 2.02094576023350569471
    q = (q * z - 2.40339491173441421878) * z + 1.0
    s = math.sqrt(z) if far else a
    y = s + s * (z * p / q)
    y = 2.0 * QUARTER - 2.0 * y if far else y
    return y if x >= 0.0 else -y


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
