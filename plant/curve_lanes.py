"""Curves of many lanes side by side, where these differ in their tables alone: the search tries one curve with many
tables. Where a signal stands on them is worked out once for all.

What the curves give is what `plant.curve.bend` gives, of the signals that `plant.curve.take` would take from a log.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from plant.curve import KNOWN, S_CURRENT, S_N_R
from plant.effects import CURVES, SIGNAL_AT
from plant.layout import C_HIGH, C_LAG, C_LOW, C_OF, C_PERIOD, C_SITE, C_STOPS, C_TABLE, CURVE_ROWS
from vaneloop.base.compiled import compiled_free, inlined
from vaneloop.base.curve import POINTS, between_points

__all__ = [
    "CURRENT", "OWN_SPEED", "alike", "first_curved", "gives", "gives_at", "gives_each", "of_signal", "on_curve",
    "signal_of", "site_of", "tables_of",
]  # fmt: skip

CURRENT, OWN_SPEED = S_CURRENT - SIGNAL_AT, S_N_R - SIGNAL_AT  # signals that change within a row of a log


def alike(p: np.ndarray) -> np.ndarray:
    """Return bool[lane]: whether its curves are those of the first lane that has any, but for their tables."""
    first = int(np.argmax(p[CURVES] != 0.0))
    heads = [CURVES + 1 + c * CURVE_ROWS + k for c in range(int(p[CURVES, first])) for k in range(C_TABLE)]
    rows = [CURVES, *heads]
    return np.asarray((p[rows] == p[rows, first : first + 1]).all(axis=0) & (p[CURVES] != 0.0))


@inlined
def first_curved(p: np.ndarray, lanes: np.ndarray) -> int:
    """The first of these lanes that has curves; -1: none."""
    for q in lanes:
        if p[CURVES, q] != 0.0:
            return q
    return -1


@inlined
def site_of(p: np.ndarray, q: int, c: int) -> int:
    """Where curve ``c`` of lane ``q`` acts."""
    return int(p[CURVES + 1 + c * CURVE_ROWS + C_SITE, q])


@inlined
def of_signal(p: np.ndarray, q: int, c: int, signal: int) -> bool:
    """Whether curve ``c`` of lane ``q`` is one of this signal, as it is."""
    r = CURVES + 1 + c * CURVE_ROWS
    return p[r + C_OF, q] == signal and p[r + C_LAG, q] == 0.0 and p[r + C_STOPS, q] == 0.0


@compiled_free
def tables_of(p: np.ndarray, q: int, lanes: np.ndarray, width: int) -> np.ndarray:
    """Return the tables of the curves that lane ``q`` has, float64[curves, POINTS, width], those of a lane side by side
    with the next one's; 0 for a lane that has none, and where there are fewer lanes.
    """
    out = np.zeros((int(p[CURVES, q]), POINTS, width))
    for j, lane in enumerate(lanes):
        if p[CURVES, lane] != 0.0:
            for c in range(len(out)):
                r = CURVES + 1 + c * CURVE_ROWS + C_TABLE
                for k in range(POINTS):
                    out[c, k, j] = p[r + k, lane]
    return out


@inlined
def signal_of(p: np.ndarray, q: int, c: int, rows: int) -> int:
    """In which of the ``rows`` of what is known lane ``q`` has the signal of its curve ``c``; of a hysteresis, what it
    gives (`plant.curve.take`).
    """
    r, n = CURVES + 1 + c * CURVE_ROWS, int(p[CURVES, q])
    if p[r + C_LAG, q] > 0.0 or p[r + C_STOPS, q] != 0.0:
        return KNOWN + c + (q * n if rows > KNOWN + n else 0)
    return int(p[r + C_OF, q])


@inlined
def on_curve(p: np.ndarray, r: int, q: int, x: float) -> tuple[int, float]:
    """Which point of the curve at row ``r`` a signal ``x`` is behind, and the share of the way to the next."""
    period = p[r + C_PERIOD, q]
    if period > 0.0:
        x -= math.floor(x / period) * period
    return between_points(x, p[r + C_LOW, q], p[r + C_HIGH, q], POINTS)


@inlined
def gives_at(into: Any, p: np.ndarray, q: int, c: int, x: float, tables: np.ndarray) -> None:
    """Add to ``into`` [lane] what curve ``c`` of lane ``q`` gives where its signal is ``x`` in all lanes."""
    at, share = on_curve(p, CURVES + 1 + c * CURVE_ROWS, q, x)
    for j in range(len(into)):
        a = tables[c, at, j]
        into[j] += a + share * (tables[c, at + 1, j] - a)


@inlined
def gives(
    into: Any, p: np.ndarray, q: int, c: int, known: np.ndarray, before: int, k: int, tables: np.ndarray,
    lanes: np.ndarray,
) -> None:  # fmt: skip
    """`gives_at` the mean of samples ``before`` and ``k`` of what is ``known``; of a hysteresis, what it gives each of
    these ``lanes``.
    """
    r = CURVES + 1 + c * CURVE_ROWS
    if p[r + C_STOPS, q] != 0.0:
        for j in range(len(lanes)):
            if p[CURVES, lanes[j]] != 0.0:
                into[j] += known[signal_of(p, lanes[j], c, len(known)), k]
        return
    row = signal_of(p, q, c, len(known))
    gives_at(into, p, q, c, 0.5 * (known[row, before] + known[row, k]), tables)


@inlined
def gives_each(into: Any, p: np.ndarray, q: int, c: int, x: Any, tables: np.ndarray) -> None:
    """`gives_at` of a signal that each lane has of its own, ``x`` [lane]."""
    r = CURVES + 1 + c * CURVE_ROWS
    for j in range(len(into)):
        at, share = on_curve(p, r, q, x[j])
        a = tables[c, at, j]
        into[j] += a + share * (tables[c, at + 1, j] - a)
