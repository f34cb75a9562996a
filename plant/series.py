"""Arctangent, arcsine and tangent from sums, products, a division or two: a compiler can put several of them into one
vector instruction.

Rational approximations of the Cephes library (Moshier 1989; atan.c, tan.c) and of fdlibm (Sun 1993; e_asin.c), within
2 units in the last place of the C library's; without branches. They serve lanes side by side; the chain itself calls
the C library.
"""

from __future__ import annotations

import math

from vaneloop.base.compiled import fused

__all__ = ["arcsine", "arctangent", "tangent"]

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
