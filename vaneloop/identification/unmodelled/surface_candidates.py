"""Surfaces that nobody named: functions of two quantities, where no curve of one is enough.

A surface is the tensor product of few splines of each quantity. Each function is one of the first quantity's times one
of the second's, as `identification.candidates.spline_basis` turns them: what it may bend along either is known
beforehand, and those that are constant along one of them are curves of the other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vaneloop.base.curve import SIDE
from vaneloop.base.hull import hull_of, nearest_within, within
from vaneloop.identification.candidates.spline_basis import Basis, basis_of
from vaneloop.identification.settings import LEVEL_SPREAD, SURFACE_SPLINES
from vaneloop.identification.subsystem import Array, Effect, Parameter
from vaneloop.identification.unmodelled.curve_candidates import Candidate
from vaneloop.identification.unmodelled.regressors import Quantity
from vaneloop.identification.user_models.exogenous_regressors import DISTANCE, SINCE, TIME, WAY
from vaneloop.identification.user_models.law_file import CURVE_LAW
from vaneloop.identification.user_models.simulation import Placed
from vaneloop.identification.user_models.terms import Jump, Surface, Table

__all__ = ["SurfaceCandidate", "may_be_of", "surface_of"]


@dataclass(frozen=True, kw_only=True, eq=False)
class SurfaceCandidate(Candidate):
    """A surface that may be missing: a curve's candidate with another quantity.

    other, across  the second quantity and its functions
    been     corners of where both have been (`vaneloop.base.hull`); ``nearest``: within it, of each point of the grid
    additive whether it is only the sum of a curve of each
    """

    other: Quantity
    across: Basis
    been: Array
    nearest: Array
    additive: bool = False

    @property
    def axes(self) -> tuple[tuple[Quantity, Basis], ...]:
        """Its quantities, each with its functions."""
        return ((self.quantity, self.basis), (self.other, self.across))

    def reaches(self, *values: Array) -> Array:
        """At which values of both it was learned."""
        low, high = np.array([self.basis.low, self.across.low]), np.array([self.basis.high, self.across.high])
        return within(self.been, low, high, *values)

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """Functions of each quantity that it has the products of."""
        n, m = self.basis.turn.shape[1], self.across.turn.shape[1]
        every = [(i, j) for i in range(n) for j in range(m) if not self.additive or 0 in (i, j)]
        return [ij for ij in every if ij != (0, 0) or self.mean]

    @property
    def turn(self) -> Array:
        """B-spline coefficients of each of its functions, of the first quantity's splines in turn."""
        return np.array([np.kron(self.basis.turn[:, i], self.across.turn[:, j]) for i, j in self.pairs]).T

    def coefficients(self, amplitudes: Array) -> Array:
        """Those of B-splines, of each of the first quantity's in turn all of the second's."""
        return np.asarray(self.turn @ amplitudes)

    @property
    def grids(self) -> tuple[Array, Array]:
        """Where its table has its points."""
        return np.linspace(self.basis.low, self.basis.high, SIDE), np.linspace(self.across.low, self.across.high, SIDE)

    def placed(self) -> Placed:
        """What runs."""
        (one, other), pairs = self.grids, self.pairs
        a, b = self.basis.design(one) @ self.basis.turn, self.across.design(other) @ self.across.turn
        design = np.array([np.outer(a[:, i], b[:, j]).ravel()[self.nearest] for i, j in pairs]).T
        return self.placed_as(lambda values: (design @ values).reshape(SIDE, SIDE), len(pairs))

    def placed_as(
        self, table: Table, parameters: int, reach: tuple[float, float] | None = None, jump: Jump | None = None,
        across: tuple[float, float] | None = None,
    ) -> Placed:  # fmt: skip
        """The same with another function from so many parameters to its table, over other ranges."""
        q, ends = (
            self.other,
            (reach or (self.basis.low, self.basis.high), across or (self.across.low, self.across.high)),
        )
        surface = Surface(
            self.how, self.place, self.quantity.of, self.quantity.name, *ends[0], table,
            of_second=q.of, second=q.name, low_second=ends[1][0], high_second=ends[1][1],
        )  # fmt: skip
        return Placed(self.name, CURVE_LAW, "curve", -1, 0.0, neutral=np.zeros(parameters), curve=surface)

    def effect(self, wiggle: float) -> Effect:
        """What the search is told: each product is known to bend as its two functions do."""
        wide, out = float(np.sqrt(3.0) * self.size), []
        for i, j in self.pairs:
            bend = float(self.basis.bend[i] + self.across.bend[j])
            tolerance = wide * (wiggle / np.sqrt(bend) if bend > 0.0 else LEVEL_SPREAD)
            out.append(Parameter(f"w_{i}_{j}", 0.0, self.unit, scale=self.size, tolerance=tolerance))
        return Effect(self.name, tuple(out), (tuple(0.1 * self.size for _ in out),))


def may_be_of(q: Quantity) -> bool:
    """Whether a surface may be of a quantity: of what is measured or simulated. What follows from time or from turning
    points imitates much by itself; a difference is a function of two by itself.
    """
    follows = q.remembers or q.period or q.name == TIME or q.name.startswith((WAY, DISTANCE, SINCE))
    return q.less is None and not follows


def surface_of(one: Candidate, two: Candidate, splines: int = SURFACE_SPLINES) -> SurfaceCandidate | None:
    """The surface of the quantities of two curves at one place; None where the logs do not spread over both."""
    x, z = one.quantity.visited, two.quantity.visited
    a, b = basis_of(x, splines), basis_of(z, splines)
    if a is None or b is None or len(x) != len(z) or min(len(a.bend), len(b.bend)) < 3:
        return None
    low, high = np.array([a.low, b.low]), np.array([a.high, b.high])
    good = np.isfinite(x) & np.isfinite(z)
    been = hull_of(x[good], z[good], low, high)
    if been is None:
        return None
    kind = "gain" if one.how.endswith("times") else "curve"
    name = f"{one.at}.{kind}_of_{one.quantity.name}_and_{two.quantity.name}"
    return SurfaceCandidate(
        name, one.how, one.place, one.at, one.unit, one.size, one.mean, one.quantity, a, one.near or two.near,
        other=two.quantity, across=b, been=been, nearest=nearest_within(been, low, high),
    )  # fmt: skip
