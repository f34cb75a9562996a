"""A smooth curve of one quantity: cubic B-spline, evaluated in compiled loops."""

from __future__ import annotations

import numpy as np

from vaneloop.base.compiled import inlined

__all__ = ["DEGREE", "spline"]

DEGREE = 3


@inlined
def spline(x: float, knots: np.ndarray, coefficients: np.ndarray, count: int) -> float:
    """Value at ``x`` of the cubic B-spline with ``count`` coefficients; beyond its ends it stays as at them.

    knots  float64[count + 4] or longer, ascending, each end four times (clamped)

    De Boor's recursion (de Boor 1978, A Practical Guide to Splines, ch. X).
    """
    t, c = knots, coefficients
    x = min(max(x, t[3]), t[count])
    j = 3
    while j < count - 1 and x >= t[j + 1]:
        j += 1
    d0, d1, d2, d3 = c[j - 3], c[j - 2], c[j - 1], c[j]
    a = (x - t[j - 2]) / (t[j + 1] - t[j - 2])
    d1_ = (1.0 - a) * d0 + a * d1
    a = (x - t[j - 1]) / (t[j + 2] - t[j - 1])
    d2_ = (1.0 - a) * d1 + a * d2
    a = (x - t[j]) / (t[j + 3] - t[j])
    d3_ = (1.0 - a) * d2 + a * d3
    a = (x - t[j - 1]) / (t[j + 1] - t[j - 1])
    d2 = (1.0 - a) * d1_ + a * d2_
    a = (x - t[j]) / (t[j + 2] - t[j])
    d3 = (1.0 - a) * d2_ + a * d3_
    a = (x - t[j]) / (t[j + 1] - t[j])
    return (1.0 - a) * d2 + a * d3
