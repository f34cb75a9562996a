"""What is said of a law that was learned: its curve and band, where the logs have been, what it trades with, and its
formulas.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from vaneloop.base.curve import POINTS
from vaneloop.base.durations import within_no_period
from vaneloop.identification.candidates.closed_forms import Formula, values_of
from vaneloop.identification.least_squares.broyden import bounded_step
from vaneloop.identification.least_squares.problem import Fit, LeastSquaresProblem
from vaneloop.identification.results import rms_of
from vaneloop.identification.settings import BAND, BAND_DRAWS, VISITED_BINS
from vaneloop.identification.subsystem import Array
from vaneloop.identification.unmodelled.closed_form_fits import fitted_formulas, likely
from vaneloop.identification.unmodelled.curve_candidates import Candidate
from vaneloop.identification.unmodelled.fitted_candidate import CandidateSource, FittedCandidate
from vaneloop.identification.user_models.exogenous_regressors import TIME
from vaneloop.identification.user_models.hysteresis_regressors import STOPS, named_lag

if TYPE_CHECKING:
    from plant.model import Second

__all__ = ["Formula", "LearnedLaw", "band_of", "law_of", "range_of"]


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
