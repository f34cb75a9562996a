"""What parameter sets promise before anything is fitted: errors held against the slopes of a fit that is known.

A fit's errors e0 move with its free parameters along J, as they do at the fit. For a set with errors e the free
parameters can follow: what is left is the part of e that J does not span. An effect whose size acts linearly changes
the errors by d for the size tried, and by a d for a times that size: the best a follows from one simulation.
"""

from __future__ import annotations

import numpy as np

from vaneloop.discrepancy.fit import Judge
from vaneloop.discrepancy.stage import Array, Effect

__all__ = ["LINE", "Slopes", "along"]

LINE = (0.02, 5.0)  # times the size tried, within which a better size is looked for
SAME = (0.8, 1.25)  # times a size that count as that size


class Slopes:
    """Errors of a fit (``error``), and their slopes by its free parameters (``jac``), whitened as `Judge.linearise` has
    them.

    prior  of the free parameters, as a fit has it
    """

    def __init__(self, judge: Judge, theta: Array, free: Array, prior: Array):
        """Simulate the fit and its difference steps."""
        self.error, self.jac = judge.linearise(theta, free)
        self._flat = self.jac.reshape(len(free), self.error.size)
        self._normal = self._flat @ self._flat.T + np.diag(prior * judge.scale[free] ** 2 + 1e-9)
        self._room = [(b[free] - theta[free]) / judge.scale[free] for b in judge.bounds()]

    def left(self, errors: Array) -> list[float]:
        """Sum of squares that is left of each set of errors when the free parameters have followed, within their
        bounds.
        """
        errors = errors.reshape(-1, self.error.size)
        pull = errors @ self._flat.T
        step = np.clip(np.linalg.solve(self._normal, pull.T).T, *self._room)
        left = np.sum(errors * errors, axis=1) - np.sum((2.0 * pull - step @ self._normal) * step, axis=1)
        return [float(v) for v in left]

    def line(self, errors: Array) -> tuple[Array, Array]:
        """By how many times the way from the fit to each set of errors the least would be left, and how much that is:
        float64[sets] each. The free parameters follow, without bounds.
        """
        e0 = self.error.ravel()
        d = errors.reshape(-1, self.error.size) - e0
        pull, pull0 = d @ self._flat.T, self._flat @ e0
        followed = np.linalg.solve(self._normal, pull.T).T
        size = np.sum(d * d, axis=1) - np.sum(pull * followed, axis=1)
        down = -(d @ e0 - followed @ pull0)
        here = float(e0 @ e0 - pull0 @ np.linalg.solve(self._normal, pull0))
        good = size > 1e-9 * np.maximum(np.sum(d * d, axis=1), 1e-300)
        share = np.clip(np.where(good, down / np.where(good, size, 1.0), 0.0), *LINE)
        return share, here - 2.0 * share * down + share**2 * size


def along(effect: Effect, start: Array, share: float, low: Array, high: Array) -> Array | None:
    """An effect's parameters ``share`` times as far from neutral as ``start``, within their bounds; None where that is
    the start again.

    Shapes stay: they say how it acts, not how much.
    """
    if SAME[0] < share < SAME[1]:
        return None
    sizes = np.array([not p.shape for p in effect.parameters])
    neutral = np.array([p.value for p in effect.parameters])
    return np.asarray(np.clip(np.where(sizes, neutral + share * (start - neutral), start), low, high))
