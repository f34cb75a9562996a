"""What is said of a surface that was learned: its values and band, and where the logs have been."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from plant.model import Second
from vaneloop.base.curve import SIDE
from vaneloop.identification.least_squares.problem import Fit, LeastSquaresProblem
from vaneloop.identification.results import rms_of
from vaneloop.identification.settings import SHOWN_PLACES, SHOWN_SAMPLES, VISITED_BINS
from vaneloop.identification.subsystem import Array
from vaneloop.identification.unmodelled.fitted_candidate import FittedCandidate
from vaneloop.identification.unmodelled.learned_law import LearnedLaw, band_of, range_of
from vaneloop.identification.unmodelled.surface_candidates import SurfaceCandidate
from vaneloop.identification.unmodelled.surface_closed_forms import Ends, Product, likely_products

__all__ = ["LearnedSurface", "surface_law_of"]


@dataclass(frozen=True, kw_only=True, eq=False)
class LearnedSurface(LearnedLaw):
    """A law of two quantities that was learned; its curve is that of the first where the second is in its middle.

    second, second_unit, middle   the other quantity and its median
    across            values of it, as ``x`` of the first
    values, lowest, highest   float64[x, across] with 90 % band
    within            whether the logs have been there: bool[x, across]
    samples           float64[2, n]: places where they have been
    been, knots_across   corners of where they have been; knots of the second quantity's splines
    goes_on  from where to where the product that is the law goes on, of the second quantity
    """

    second: str
    second_unit: str
    middle: float
    across: Array
    values: Array
    lowest: Array
    highest: Array
    within: Array
    samples: Array = field(repr=False)
    been: Array = field(repr=False)
    knots_across: Array = field(repr=False)
    goes_on: tuple[float, float] = (0.0, 0.0)

    @property
    def of_what(self) -> str:
        """Of which quantities it is a function."""
        return f"{self.of} and {self.second}"

    def range_note(self) -> str:
        """Where its quantities have been, what it does beyond, and what the law file has of it, in words."""
        own, other = range_of(self.x, self.of_unit), range_of(self.across, self.second_unit)
        been = f"{self.name}: {self.of} has been in {own}, {self.second} in {other}"
        if self.spoken is None:
            return (
                f"{been}; the law file has the surface; beyond where both have been, it stays as at the nearest place "
                f"within"
            )
        own, other = range_of(np.array(self.reach), self.of_unit), range_of(np.array(self.goes_on), self.second_unit)
        return (
            f"{been}; the law file has the formula, which does as well as the surface; it goes on to {own} and "
            f"{other}, and stays as there beyond"
        )

    def more(self) -> dict[str, Any]:
        """The surface at `SHOWN_PLACES` places each way."""
        some = np.linspace(0, SIDE - 1, SHOWN_PLACES).astype(int)
        grids = {"values": self.values, "lowest": self.lowest, "highest": self.highest, "within": self.within}
        return {
            "second": self.second, "second_unit": self.second_unit, "middle": self.middle,
            "across": self.across[some].tolist(), **{k: v[np.ix_(some, some)].tolist() for k, v in grids.items()},
        }  # fmt: skip

    def axis(self) -> Second:
        """The second quantity, as a law file has it."""
        if isinstance(self.spoken, Product):
            low, high = self.goes_on
            return Second(of=self.second, low=low, high=high, form=self.spoken.second_form)
        return Second(
            of=self.second, low=float(self.across[0]), high=float(self.across[-1]), knots=self.knots_across.tolist(),
            been=self.been.tolist(),
        )  # fmt: skip

    def spoken_by(self, product: Product, ends: Ends, error: float) -> LearnedSurface:
        """The same with a product as the law."""
        others = [f for f in self.formulas if (f.form, getattr(f, "second_form", "")) != _forms(product)]
        return replace(
            self, formulas=[product, *others], spoken=product, reach=ends[0], goes_on=ends[1], error_after=error
        )


def _forms(product: Product) -> tuple[str, str]:
    return product.form, product.second_form


def surface_law_of(before: tuple[LeastSquaresProblem, Fit], tried: FittedCandidate) -> LearnedSurface:
    """Everything that is said of the surface that ``tried`` has last."""
    c, judge, fit = tried.candidate, tried.judge, tried.fit
    assert isinstance(c, SurfaceCandidate)
    table, amplitudes = tried.table()
    within = (c.nearest == np.arange(SIDE * SIDE)).reshape(SIDE, SIDE)
    values, (low, high), (x, across) = table(amplitudes), band_of(tried, within), c.grids
    good = np.isfinite(c.quantity.visited) & np.isfinite(c.other.visited)
    both = np.stack([c.quantity.visited[good], c.other.visited[good]])
    some = both[:, np.linspace(0, both.shape[1] - 1, min(both.shape[1], SHOWN_SAMPLES)).astype(int)]
    counts, edges = np.histogram(both[0], bins=VISITED_BINS, range=(c.basis.low, c.basis.high))
    middle = float(np.median(both[1]))
    k = int(np.argmin(np.abs(across - middle)))
    return LearnedSurface(
        c.name, c.how, c.at, c.quantity.name, c.unit, c.quantity.unit, x, values[:, k], low[:, k], high[:, k], edges,
        counts / max(counts.sum(), 1), rms_of(*before), rms_of(judge, fit), c.basis.knots,
        likely_products(tried, rms_of(*before)), rivals=list(tried.rivals),
        second=c.other.name, second_unit=c.other.unit, middle=float(across[k]), across=across, values=values,
        lowest=low, highest=high, within=within, samples=some,
        been=c.been, knots_across=c.across.knots,
    )  # fmt: skip
