"""Slopes of a fit, carried along its steps instead of simulated anew at each.

A step d of the free parameters changes the errors from e to e'. The slopes J, by which they should have changed by
-J d, are off by w = e' - e + J d; so J is changed as little as makes it say what this step did (Broyden 1965):

    J' = J - v w,   v = M d / (d M d)

M, the diagonal of the normal matrix, measures a parameter by what it does to the errors, so that units do not matter.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vaneloop.identification.settings import KEPT_SLOPES
from vaneloop.identification.subsystem import Array

__all__ = ["NOT_KNOWN", "BroydenJacobian", "Known", "LatestSlopes", "bounded_step"]


class Known(NamedTuple):
    """Minus derivatives of the errors by parameters in their scales: of these columns of theta, a row each."""

    columns: Array
    rows: Array

    def fits(self, size: int) -> bool:
        """Whether any are known, and of so many errors."""
        return len(self.columns) > 0 and self.rows.size == len(self.columns) * size


NOT_KNOWN = Known(np.zeros(0, dtype=int), np.zeros((0, 0)))


class BroydenJacobian:
    """Errors and minus their slopes at one place of a descent; their gradient and normal matrix.

    error   whitened, float64[outputs, samples]
    slopes  minus the derivative by each free parameter in its scale, float64[free, outputs, samples]
    """

    def __init__(self, error: Array, slopes: Array):
        """Begin with slopes that were simulated at ``error``."""
        self.error, self.slopes = error.ravel(), slopes.reshape(len(slopes), error.size)
        self.normal = self.slopes @ self.slopes.T

    @property
    def gradient(self) -> Array:
        """What a step gains first, by each parameter: half the fall of the sum of squares."""
        return np.asarray(self.slopes @ self.error)

    def moved(self, step: Array, error: Array) -> None:
        """Note that a ``step`` of the free parameters, in their scales, has led to this ``error``."""
        way = np.diag(self.normal) * step
        size = float(way @ step)
        if size > 0.0:
            way /= size
            off = error.ravel() - self.error + step @ self.slopes
            across = self.slopes @ off
            both = np.outer(way, across)
            self.normal += float(off @ off) * np.outer(way, way) - both - both.T
            self.slopes -= np.outer(way, off)
        self.error = error.ravel().copy()


class LatestSlopes:
    """Errors and slopes where fits have ended last, which may be gone on with."""

    def __init__(self) -> None:
        self._kept: dict[tuple[bytes, bytes], tuple[Array, Array]] = {}

    def put(self, theta: Array, free: Array, error: Array, slopes: Array) -> None:
        """Keep these; the oldest go."""
        self._kept[theta.tobytes(), free.tobytes()] = error, slopes
        while sum(rows.size for _, rows in self._kept.values()) > KEPT_SLOPES:
            del self._kept[next(iter(self._kept))]

    def get(self, theta: Array, free: Array) -> tuple[Array, Array] | None:
        """Copies of error and slopes; None where they are not kept."""
        found = self._kept.get((theta.tobytes(), free.tobytes()))
        return (found[0], found[1].copy()) if found else None

    def of(self, theta: Array, free: Array, before: float = np.inf) -> Known:
        """The slopes by those free parameters that stand before a column, where they are kept."""
        found = self._kept.get((theta.tobytes(), free.tobytes()))
        return Known(free[free < before], found[1][free < before]) if found else NOT_KNOWN


def bounded_step(a: Array, g: Array, low: Array, high: Array) -> Array:
    """The step that minimises step a step / 2 - g step within bounds, near enough: what runs into one stops, the rest
    is solved again.

    A step that is only cut off at the bounds is no descent where parameters can stand in for each other.
    """
    step = np.zeros(len(g))
    moves = np.ones(len(g), dtype=bool)
    for _ in range(len(g)):
        if moves.all():
            step = np.linalg.solve(a, g)
        else:
            step[moves] = np.linalg.solve(a[np.ix_(moves, moves)], g[moves] - a[np.ix_(moves, ~moves)] @ step[~moves])
        beyond = moves & ((step < low) | (step > high))
        if not beyond.any():
            break
        step[beyond] = np.clip(step[beyond], low[beyond], high[beyond])
        moves &= ~beyond
        if not moves.any():
            break
    return step
