"""What is said of a law that was learned: its curve and band, where the logs have been, what it trades with, and its
formulas.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from plant.model import Second
from vaneloop.base.curve import POINTS, SIDE
from vaneloop.base.durations import within_no_period
from vaneloop.identification.candidates.closed_forms import Formula, values_of
from vaneloop.identification.least_squares.levenberg_marquardt import bounded_step
from vaneloop.identification.least_squares.problem import Fit, LeastSquaresProblem
from vaneloop.identification.results import rms_of
from vaneloop.identification.settings import BAND, BAND_DRAWS, SHOWN_PLACES, SHOWN_SAMPLES, VISITED_BINS
from vaneloop.identification.subsystem import Array
from vaneloop.identification.unmodelled.closed_form_fits import Ends, Product, fitted_formulas, likely, likely_products
from vaneloop.identification.unmodelled.curve_candidates import Candidate, SurfaceCandidate
from vaneloop.identification.unmodelled.fitted_candidate import CandidateSource, FittedCandidate
from vaneloop.identification.user_models.exogenous_regressors import STOPS, TIME, named_lag

__all__ = ["Formula", "LearnedLaw", "LearnedSurface", "band_of", "law_of", "range_of", "surface_law_of"]


@dataclass(frozen=True, eq=False)
class LearnedLaw:
    """A law that was learned.

    name, how, at, of   of the effect; what it does (`identification.user_models.terms`), at which place, of what
    x, y, low, high     the curve, at places of its quantity, with its 90 % band
    edges, visited      of a histogram: where the logs have been, as shares
    untold   of its mean (0) and slope (1): what the logs do not tell from the model's parameters; it has none
    trades   parameters that left their intervals when it was given none
    rivals   curves at other places or of other quantities that do as well
    spoken   the formula that is the law, as it does as well as the curve; None: the curve is. ``reach``: from where to
             where it goes on
    period   along its channel, after which it repeats itself; 0: it does not
    """

    name: str
    how: str
    at: str
    of: str
    unit: str
    of_unit: str
    x: Array
    y: Array
    low: Array
    high: Array
    edges: Array
    visited: Array
    error_before: float
    error_after: float
    knots: Array = field(repr=False)
    formulas: list[Formula] = field(default_factory=list)
    untold: tuple[int, ...] = ()
    trades: list[str] = field(default_factory=list)
    rivals: list[str] = field(default_factory=list)
    spoken: Formula | None = None
    reach: tuple[float, float] = (0.0, 0.0)
    period: float = 0.0

    def of_the_kind_of(self, other: LearnedLaw) -> bool:
        """Whether it does the same, at the same place and of the same quantity, whatever its curve and its period."""
        mine, its = (within_no_period(law.of) for law in (self, other))
        return (self.how, self.at, mine) == (other.how, other.at, its)

    @property
    def constant(self) -> bool:
        """Whether it is the same whatever its quantity is."""
        return self.spoken is not None and self.spoken.form == "constant"

    @property
    def channel(self) -> str:
        """Its quantity; of what repeats itself, the channel along which it does."""
        return within_no_period(self.of) if self.period else self.of

    @property
    def of_what(self) -> str:
        """Of which quantity it is a function."""
        return self.of

    def more(self) -> dict[str, Any]:
        """What the JSON of a surface has beyond that of a curve."""
        return {}

    def axis(self) -> Second | None:
        """The other quantity, as a law file has it."""
        return None

    def range_note(self) -> str:
        """Where its quantity has been, what it does beyond, and what the law file has of it, in words."""
        has = "the formula, which does as well as the curve" if self.spoken else "the curve"
        if self.period or self.constant:
            return f"{self.name}: the law file has {has}"
        been = f"{self.name}: {self.of} has been in {range_of(self.x, self.of_unit)}; the law file has {has}"
        if not self.spoken:
            return f"{been}; beyond, it stays as at its end"
        reach = range_of(np.array(self.reach), self.of_unit)
        return f"{been}; it goes on to {reach}, and stays as there beyond"

    def sentence(self) -> str:
        """What it is, in words."""
        stops, lag = self.of.startswith(STOPS), named_lag(self.of)
        what = f"a hysteresis of {self.of.removeprefix(STOPS)}" if stops else f"a function of {self.of_what}"
        if lag:
            what = f"a function of {lag[0]} (lagged by {lag[1]:.4g} s)"
        if self.period:
            of = "the time" if self.channel == TIME else self.channel
            what = f"a function of {of} within each {self.period:.6g} {self.of_unit.strip('-')}".rstrip()
        if self.constant:
            what = "a constant"
        does = {
            "parameter times": f"{self.at} is multiplied by 1 + {what}",
            "input adds": f"{what} is added to {self.at}",
            "input times": f"{self.at} is multiplied by 1 + {what}",
            "state adds": f"{what} is taken off the derivative of {self.at}",
            "force adds": f"{what} is added to the force",
            "output adds": f"{what} is added to the reading {self.at}",
            "output times": f"the reading {self.at} is multiplied by 1 + {what}",
            "adds": f"{what} is added to {self.at}",
            "times": f"{self.at} is multiplied by 1 + {what}",
        }[self.how]
        best = self.spoken or (self.formulas[0] if self.formulas else None)
        near = "" if self.spoken else "near "
        said = f"{near}{best.text}{f' ({best.law} of the library)' if best.law else ''}" if best else ""
        said = f", {'with the virgin curve ' if stops else ''}{said}" if said else ""
        return f"{does}{said}"


def range_of(x: Array, unit: str) -> str:
    """Where a quantity has been, with its unit."""
    return f"[{x[0]:.4g}, {x[-1]:.4g}] {unit.strip('-')}".strip()


def law_of(ground: CandidateSource, before: tuple[LeastSquaresProblem, Fit], tried: FittedCandidate) -> LearnedLaw:
    """Everything that is said of the last curve of ``tried``."""
    c, judge, fit = tried.candidate, tried.judge, tried.fit
    table, amplitudes = tried.table()
    grid, y = c.grid, table(amplitudes)
    if tried.formulas is None:
        tried.formulas = fitted_formulas(ground, tried)
    formulas = likely(tried, tried.formulas, rms_of(*before))
    been = np.isin(np.arange(POINTS), np.searchsorted(grid, c.quantity.visited).clip(0, POINTS - 1))
    low, high = _with_formulas(c, y, *band_of(tried, been), been, formulas)
    visited = c.quantity.visited[np.isfinite(c.quantity.visited)]
    counts, edges = np.histogram(visited, bins=VISITED_BINS, range=(c.basis.low, c.basis.high))
    return LearnedLaw(
        c.name, c.how, c.at, c.quantity.name, c.unit, c.quantity.unit, grid, y, low, high, edges,
        counts / max(counts.sum(), 1), rms_of(*before), rms_of(judge, fit), c.basis.knots,
        formulas, c.untold, _trades(tried), list(tried.rivals), period=c.quantity.period,
    )  # fmt: skip


def band_of(tried: FittedCandidate, been: Array) -> tuple[Array, Array]:
    """90 % band of a curve: blocks of the log and values known beforehand drawn anew, each draw solved by the slopes of
    the fit. What the log cannot tell apart is as wide as it was known before.

    Each draw counts to both sides: it tells how far the fit may be off. To which side is its own, as a block that alone
    tells an end pulls its own way (Hall 1988). A fit ends a little before its solution. What it is still pulled by is
    no block's, so the pulls are those at the solution.

    It holds nine draws in ten as a whole, at all points of the table where logs have ``been`` (Ruppert, Wand and
    Carroll 2003, 6.5): one that holds nine in ten point by point leaves most of them somewhere.
    """
    judge, fit, c = tried.judge, tried.fit, tried.candidate
    table, amplitudes = tried.table()
    scale = judge.scale[fit.free]
    prior = fit.prior * scale**2
    n = judge.n_blocks
    rng = np.random.default_rng(0)
    weights = rng.multinomial(n, np.full(n, 1.0 / n), BAND_DRAWS)
    known = rng.standard_normal((BAND_DRAWS, len(prior))) * np.sqrt(prior)
    at = judge.stage.index()[c.name]
    bounds = tuple(b[fit.free] for b in judge.bounds())
    mine = np.flatnonzero((fit.free >= at.start) & (fit.free < at.stop))
    deviation = (fit.theta - judge.stage.neutral())[fit.free] / scale
    rest = bounded_step(
        fit.normals.sum(axis=0) + np.diag(prior + 1e-9),
        fit.gradients.sum(axis=0) - prior * deviation,
        *((b - fit.theta[fit.free]) / scale for b in bounds),
    )
    pulls = fit.gradients - fit.normals @ rest
    curves = []
    for w, drawn in zip(weights, known, strict=True):
        a = np.tensordot(w, fit.normals, 1) + np.diag(prior + 1e-9)
        step = np.linalg.solve(a, (w - 1.0) @ pulls + drawn)
        for off in (step, -step):
            curves.append(table(np.clip(fit.theta[fit.free] + off * scale, *bounds)[mine]))
    edge = 50.0 * (1.0 - BAND)
    low, high = np.percentile(curves, [edge, 100.0 - edge], axis=0)
    y = table(amplitudes)
    least = 1e-9 * float(np.max(np.abs(y))) + 1e-300
    below, above = np.maximum(y - low, least), np.maximum(high - y, least)
    furthest = [np.max(np.maximum((y - c) / below, (c - y) / above)[been]) for c in curves]
    whole = float(np.quantile(furthest, BAND))
    return y - whole * below, y + whole * above


def _with_formulas(
    c: Candidate, y: Array, low: Array, high: Array, been: Array, formulas: list[Formula]
) -> tuple[Array, Array]:  # fmt: skip
    """The band about a curve, and about each formula that does as well: a smooth curve is no corner."""
    x, below, above = c.grid, y - low, high - y
    for formula in formulas:
        f = values_of(formula, x)
        gone = sorted(c.lent)
        if gone:  # the curve has them as the parameters leave them, and the formula has its own
            lines = np.stack([(np.ones(POINTS), x, f)[k] for k in (*gone, *([2] if 1 in gone else []))])
            f = f + np.linalg.lstsq(lines[:, been].T, (y - f)[been], rcond=1e-9)[0] @ lines
        low, high = np.minimum(low, f - below), np.maximum(high, f + above)
    return low, high


def _trades(tried: FittedCandidate) -> list[str]:
    """Parameters of the model that stand elsewhere than where the curve had a mean and a slope."""
    told, now = tried.told, tried.fit
    if told is None:
        return []
    names, out = [p.name for p in tried.judge.stage.parameters], []
    for k, column in enumerate(told.free):
        if column < len(names) and not told.low[k] <= now.theta[column] <= told.high[k]:
            out.append(names[column])
    return out


# ---- A surface that was learned: its values and band, and where the logs have been


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
