"""A curve of one quantity as a table, and a surface of two: what runs in compiled loops of a function that somebody
fitted or learned.
"""

from __future__ import annotations

import numpy as np
import scipy

from vaneloop.base.compiled import compiled_free, inlined

__all__ = [
    "DEGREE", "FINE", "FINE_SIDE", "POINTS", "SIDE", "between_points", "on_even", "on_even_grid", "on_grid", "on_table",
    "splines",
]  # fmt: skip

DEGREE = 3  # of its splines
POINTS = 257  # of a table, evenly spaced from its lowest to its highest argument
FINE = 1025  # of that of a formula, which goes on beyond where logs have been
SIDE = 65  # of a surface's, each way
FINE_SIDE = 257  # the same of a product of formulas, which may have corners and goes on further


@inlined
def on_table(x: float, low: float, high: float, table: np.ndarray) -> float:
    """The curve at ``x``: straight between the points of ``table``, which stand evenly from ``low`` to ``high``; beyond
    its ends it stays as at them.
    """
    k, share = between_points(x, low, high, len(table))
    return table[k] + share * (table[k + 1] - table[k])


@inlined
def on_even(x: float, low: float, per: float, table: np.ndarray) -> float:
    """`on_table` where so many points stand ``per`` one of ``x``."""
    z, last = (x - low) * per, len(table) - 1
    if not z > 0.0:
        return table[0]
    if z >= last:
        return table[last]
    k = int(z)
    return table[k] + (z - k) * (table[k + 1] - table[k])


@compiled_free
def on_even_grid(x: np.ndarray, grid: np.ndarray, table: np.ndarray) -> np.ndarray:
    """``np.interp(x, grid, table)`` to the last bit, of a ``grid`` that is even but for rounding: where a value stands
    in it is computed, not searched.
    """
    out, last = np.empty(len(x)), len(grid) - 1
    per = last / (grid[last] - grid[0])
    for i in range(len(x)):
        v = x[i]
        if not v > grid[0]:
            out[i] = table[0] if v <= grid[0] else v  # NaN stays NaN
        elif v >= grid[last]:
            out[i] = table[last]
        else:
            k = min(int((v - grid[0]) * per), last - 1)
            while grid[k] > v:
                k -= 1
            while grid[k + 1] <= v:
                k += 1
            slope = (table[k + 1] - table[k]) / (grid[k + 1] - grid[k])
            out[i] = slope * (v - grid[k]) + table[k]
    return out


@inlined
def on_grid(x: float, z: float, low: np.ndarray, high: np.ndarray, table: np.ndarray) -> float:
    """The surface at ``x`` and ``z``: straight each way between the points of ``table`` [x, z], which stand evenly from
    ``low`` to ``high`` of either; beyond its edges it stays as at them.
    """
    k, a = between_points(x, low[0], high[0], table.shape[0])
    m, b = between_points(z, low[1], high[1], table.shape[1])
    near = table[k, m] + b * (table[k, m + 1] - table[k, m])
    far = table[k + 1, m] + b * (table[k + 1, m + 1] - table[k + 1, m])
    return near + a * (far - near)


@inlined
def between_points(x: float, low: float, high: float, points: int) -> tuple[int, float]:
    """Which point of a table of so many ``x`` is behind, and the share of the way to the next; NaN is at the first."""
    last = points - 1
    z = (x - low) / (high - low) * last
    if not z > 0.0:
        return 0, 0.0
    if z >= last:
        return last - 1, 1.0
    k = int(z)
    return k, z - k


def splines(knots: np.ndarray, x: np.ndarray) -> np.ndarray:
    """The B-splines of these ``knots`` at ``x``, float64[len(x), splines]; beyond the ends as there."""
    inside = np.clip(np.asarray(x, dtype=float), knots[DEGREE], knots[-DEGREE - 1])
    return np.asarray(scipy.interpolate.BSpline(knots, np.eye(len(knots) - DEGREE - 1), DEGREE)(inside))
