"""Smooth curves as effects: a basis whose first two functions are a constant and a straight line, and whose others bend
more and more.

A curve that nobody named is a sum of cubic B-splines with knots where the log has been. Their coefficients mean nothing
one by one, and a fit needs to be told that a curve is smooth. So the basis is turned (Demmler and Reinsch 1975): its
functions are orthonormal over the values that the log visited, and ordered by how much they bend. An amplitude's prior
is then one number for each function, which is what `identification.least_squares.problem` knows; the number of knots
hardly matters, and the mean and the slope can be held at zero, to see what the curve says beyond a gain and an offset.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from vaneloop.base.curve import DEGREE, splines
from vaneloop.identification.settings import (
    CURVE_SPLINES,
    EDGE_SHARE,
    HARMONICS,
    LEAST_KNOT_DISTANCE,
    LEAST_SPLINES,
    LEVEL_SPREAD,
    STRAY_RANGE,
    WAVE_SPLINES,
)
from vaneloop.identification.subsystem import Array, Effect, Parameter

__all__ = ["Basis", "basis_of", "waves_of"]


@dataclass(frozen=True, eq=False)
class Basis:
    """Functions of one quantity.

    knots   float64[splines + 4]
    turn    float64[splines, functions]: B-spline coefficients of each function; function 0 is a constant, 1 a straight
            line, both and all others with mean square 1 over the visited values
    bend    float64[functions]: mean square of the second derivative over the range, as a share of that of function 2
    period  of one whose functions are sines and cosines, with no straight line; 0: it is none
    rises   functions but the constant are steps up (1) or down (-1) from one spline to the next, of amplitudes that are
            not below 0; 0: none of this
    """

    knots: Array
    turn: Array
    bend: Array
    rises: int = 0
    period: float = 0.0

    @property
    def low(self) -> float:
        """Where it begins; below, curves stay as here."""
        return float(self.knots[0])

    @property
    def high(self) -> float:
        """Where it ends; above, curves stay as here."""
        return float(self.knots[-1])

    def reaches(self, x: Array) -> Array:
        """Which values are not beyond its ends."""
        return (x >= self.low) & (x <= self.high)

    def zeroed(self) -> Basis:
        """The same functions less what they are at 0."""
        return replace(self, turn=self.turn - self.design(np.zeros(1)) @ self.turn)

    def rising(self, sign: int) -> Basis:
        """The same splines, of curves that only rise (1) or fall (-1)."""
        n = len(self.turn)
        steps = sign * np.tril(np.ones((n, n)))[:, 1:]
        return replace(self, turn=np.column_stack([np.ones(n), steps]), bend=np.ones(n), rises=sign)

    @property
    def straight(self) -> int:
        """How many of its functions do not bend: the constant, and the straight line where there is one."""
        return 1 if self.rises or self.period else 2

    def design(self, x: Array) -> Array:
        """`splines` of its knots at ``x``."""
        return splines(self.knots, x)

    def effect(
        self, name: str, unit: str, size: float, wiggle: float, kept: Sequence[int], jump: bool = False
    ) -> Effect:
        """The curve as an effect: amplitudes in ``unit``, ``size`` large in usual, bends known to be within ``wiggle``.

        wiggle  standard deviation of the amplitude of function 2, in ``size``; others by how much they bend
        kept    of its functions, rising: where a parameter that is fitted does what the mean does, the curve has none
        jump    whether half the height of a jump is one more amplitude
        """
        # a tolerance is the half-width of a uniform interval: sqrt(3) standard deviations
        wide = float(np.sqrt(3.0) * LEVEL_SPREAD * size)
        out = []
        for k in kept:
            step, plain = self.rises and k > 0, k < self.straight
            bend = f"step_{k}" if step else f"wave_{k}" if self.period else f"bend_{k - 1}"
            own = ("mean", "slope")[k] if plain else bend
            tolerance = wide if plain else float(np.sqrt(3.0) * wiggle * size / np.sqrt(self.bend[k]))
            out.append(Parameter(own, 0.0, unit, 0.0 if step else -np.inf, scale=size, tolerance=tolerance))
        if jump:
            out.append(Parameter("jump", 0.0, unit, scale=size, tolerance=wide))
        starts = tuple(tuple(sign * size if i == k else 0.0 for i in range(len(out)))
                       for k in range(len(out)) if k < 3 for sign in (-0.3, 0.3)
                       if sign * size > out[k].low)  # fmt: skip
        return Effect(name, tuple(out), starts)


def basis_of(visited: Array, count: int = CURVE_SPLINES) -> Basis | None:
    """The basis for a quantity that has been at these values; None where there are too few different ones.

    Knots stand at their quantiles: a curve is as fine as the log tells.
    """
    x = np.sort(np.asarray(visited, dtype=float)[np.isfinite(visited)])
    if len(x) < 4 * LEAST_SPLINES:
        return None
    if len(few := np.unique(x)) in (2, 3):
        return _straight(x, float(few[0]), float(few[-1]))
    low, high = (float(np.quantile(x, q)) for q in (EDGE_SHARE, 1.0 - EDGE_SHARE))
    if not high - low > 1e-12 * max(-low, high, 1e-300):
        return None
    apart = STRAY_RANGE * (high - low)
    low, high = max(low - apart, float(x[0])), min(high + apart, float(x[-1]))
    z = (x[(x >= low) & (x <= high)] - low) / (high - low)
    inner = np.quantile(np.unique(z), np.linspace(0.0, 1.0, count - DEGREE + 1)[1:-1])
    inner = np.unique(np.round(inner / LEAST_KNOT_DISTANCE)) * LEAST_KNOT_DISTANCE
    inner = inner[(inner > LEAST_KNOT_DISTANCE) & (inner < 1.0 - LEAST_KNOT_DISTANCE)]
    if len(np.unique(z)) < LEAST_SPLINES or len(inner) + DEGREE + 1 < LEAST_SPLINES:
        return None
    knots = np.concatenate([np.zeros(4), inner, np.ones(4)])
    n = len(knots) - DEGREE - 1
    some = z[np.linspace(0, len(z) - 1, min(len(z), 10_000)).astype(int)]
    values = scipy.interpolate.BSpline.design_matrix(some, knots, DEGREE).toarray()
    gram = values.T @ values / len(some) + 1e-9 * np.eye(n)
    # cubic pieces: the second derivative is straight in each, so that Simpson's rule takes its square exactly
    edges = np.unique(knots)
    at = np.concatenate([edges[:-1], 0.5 * (edges[1:] + edges[:-1]), edges[1:]])
    weight = np.concatenate([np.full(len(edges) - 1, w) for w in (1.0, 4.0, 1.0)]) * np.tile(np.diff(edges), 3) / 6.0
    second = scipy.interpolate.BSpline(knots, np.eye(n), DEGREE).derivative(2)(np.minimum(at, np.nextafter(1.0, 0.0))).T
    bending = (second * weight) @ second.T
    bends, turn = scipy.linalg.eigh(bending, gram)
    # the first two do not bend: a constant, and the straight line that is orthogonal to it
    one = np.ones(n) / np.sqrt(gram.sum())
    line = _greville(knots)
    line = line - one * (one @ gram @ line)
    line /= np.sqrt(line @ gram @ line)
    turn = np.column_stack([one, line, turn[:, 2:]])
    return Basis(low + (high - low) * knots, turn, np.concatenate([[0.0, 0.0], bends[2:] / bends[2]]))


def waves_of(period: float, harmonics: int = HARMONICS) -> Basis:
    """The basis for a quantity that repeats itself: a constant, a sine and a cosine of its ``period``, and up to
    ``harmonics`` times as fast ones.
    """
    around = WAVE_SPLINES * harmonics
    knots = np.concatenate([np.zeros(DEGREE), np.linspace(0.0, 1.0, around - DEGREE + 1), np.ones(DEGREE)])
    z = np.linspace(0.0, 1.0, 8 * around)
    order = np.arange(1, harmonics + 1)
    turns = 2.0 * np.pi * z[:, None] * order
    waves = np.sqrt(2.0) * np.stack([np.sin(turns), np.cos(turns)], axis=2).reshape(len(z), -1)
    turn = np.linalg.lstsq(splines(knots, z), np.column_stack([np.ones(len(z)), waves]), rcond=None)[0]
    return Basis(period * knots, turn, np.concatenate([[0.0], np.repeat(order, 2) ** 4.0]), period=period)


def _straight(x: Array, low: float, high: float) -> Basis:
    """The basis for a quantity of two or three values, such as a direction: it cannot bend."""
    knots = np.concatenate([np.full(4, low), np.full(4, high)])
    line = _greville(knots) - x.mean()
    return Basis(knots, np.column_stack([np.ones(4), line / np.sqrt(np.mean((x - x.mean()) ** 2))]), np.zeros(2))


def _greville(knots: Array) -> Array:
    """Coefficients of the straight line y = x: the means of each spline's inner knots (Greville abscissae)."""
    return np.array([knots[i + 1 : i + 4].mean() for i in range(len(knots) - DEGREE - 1)])
