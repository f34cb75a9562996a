"""A curve of one quantity as a table: what runs in compiled loops of a function that somebody fitted or learned."""

from __future__ import annotations

import numpy as np

from vaneloop.base.compiled import inlined

__all__ = ["DEGREE", "FINE", "POINTS", "between_points", "on_table", "splines"]

DEGREE = 3  # of its splines
POINTS = 257  # of a table, evenly spaced from its lowest to its highest argument
FINE = 1025  # of that of a formula, which goes on beyond where logs have been


@inlined
def on_table(x: float, low: float, high: float, table: np.ndarray) -> float:
    """The curve at ``x``: straight between the points of ``table``, which stand evenly from ``low`` to ``high``; beyond
    its ends it stays as at them.
    """
    k, share = between_points(x, low, high, len(table))
    return table[k] + share * (table[k + 1] - table[k])


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
    from scipy.interpolate import BSpline

    inside = np.clip(np.asarray(x, dtype=float), knots[DEGREE], knots[-DEGREE - 1])
    return np.asarray(BSpline(knots, np.eye(len(knots) - DEGREE - 1), DEGREE)(inside))
