"""A curve that was fitted in a model, what it is held against, and which of two that do as well is plainer."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from vaneloop.identification.candidates.closed_forms import Formula
from vaneloop.identification.least_squares.levenberg_marquardt import NOT_KNOWN, Known, bounded_step
from vaneloop.identification.least_squares.problem import Fit, LeastSquaresProblem
from vaneloop.identification.selection.rules import Decision
from vaneloop.identification.settings import LEAST_FALL, LEAST_OF_NOISE, LEAST_SETTLED, NATS, SURELY
from vaneloop.identification.subsystem import Array, Effect, Stage
from vaneloop.identification.unmodelled.curve_candidates import Candidate
from vaneloop.identification.unmodelled.spectral_lines import Course
from vaneloop.identification.user_models.exogenous_regressors import DISTANCE, SINCE, TIME, WAY, forgotten, named_lag
from vaneloop.identification.user_models.simulation import Placed

__all__ = [
    "MEASURED", "Blocks", "CandidateSource", "FittedCandidate", "Outcome", "Placings", "adds_what", "at_samples",
    "channel_of", "held_out", "left_by_its_mean", "one_constant", "plain", "stands", "step_without", "strange",
    "surely_more", "told_by_others", "with_held_out", "without_its_lag",
]  # fmt: skip

Placings = tuple[tuple[Placed, Effect], ...]
MEASURED = 2  # up to here what is `strange` is of measured or simulated channels alone, as they are


class CandidateSource(Protocol):
    """What curves are learned on: one stage of a model, held against logs.

    whole  the stage with all laws of the library as effects; ``floor``: noise of its outputs
    tests  names of the logs that nothing is fitted to
    points of the table of a formula; ``jumps``: whether curves may jump; ``surfaces``: whether functions of two
           quantities can run; ``noise_known``: whether the model may come down to a noise that is known;
           ``measured``: outputs of which curves may be a function, as they were measured;
           ``shares``: whether it runs in compiled loops, which threads can share out among candidates
    """

    whole: Stage
    floor: Array
    tests: frozenset[str]
    measured: frozenset[str]
    points: int
    jumps: bool
    surfaces: bool
    noise_known: bool
    shares: bool

    def in_grains(self, of: float) -> None:
        """Compare errors in so large steps from now on (`Stage.grain`)."""

    def stage(self, laws: Sequence[str], curves: Placings, quick: bool = False) -> Stage:
        """The same stage with only these laws of the library, and these curves, as effects; ``quick``: on as many
        samples as tell which candidates to fit.
        """

    def candidates(self, theta: Array) -> list[Candidate]:
        """Every curve that may be missing, at parameters ``theta`` of a stage without any."""

    def errors(self, curves: Placings, theta: Array, laws: Sequence[str] = ()) -> dict[str, Array]:
        """Error of every sample of each output in noise floors, log by log, test logs too; NaN where none is known."""

    def elsewhere(self, curves: Placings, theta: Array) -> dict[str, float]:
        """Of each other subsystem in which curves act, with the parameters at the end of ``theta``, the log of its
        error with them over that without.
        """

    def within(self, candidate: Candidate) -> dict[str, Array]:
        """Of test logs, the samples where a candidate's quantity is where its curve was learned: bool[samples]."""

    def reach(self, candidate: Candidate) -> tuple[float, float]:
        """The range of its quantity beyond which no formula goes on."""

    def courses(self, curves: Placings, theta: Array) -> list[Course]:
        """The error of every sample of the logs that are fitted."""


@dataclass(eq=False)
class FittedCandidate:
    """A curve fitted beside the model, and curves before it.

    curves  each as it runs and as the search has it, the new one last
    told    the fit of the curve with the mean and slope that it was found with, where the logs do not tell them
    errors  in noise floors, log by log, once they have been simulated
    rivals  names of candidates that do as well in the new one's place
    rows    whitened error of each sample and its derivatives, once they have been simulated
    formulas those that were fitted in its place, once they have been; ``loose``: those whose mean and slope may be what
             parameters of the model could have
    form     name of the closed form that stands in the new curve's place; "": the curve itself
    """

    candidate: Candidate
    wiggle: float
    judge: LeastSquaresProblem
    fit: Fit
    curves: Placings
    told: Fit | None = None
    errors: dict[str, Array] | None = None
    rivals: Sequence[str] = ()
    rows: tuple[Array, Array] | None = None
    formulas: list[tuple[Formula, FittedCandidate]] | None = None
    loose: list[FittedCandidate] | None = None
    form: str = ""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the effects and curves of the model, for the record of decisions."""
        names = self.fit.effects
        return (*names[:-1], f"{names[-1]} as {self.form}") if self.form else names

    @property
    def settled(self) -> Array | None:
        """Samples at which none of its curves remembers what was before the log; None: all."""
        return self.judge.keep

    def slopes(self, beside: bool = True) -> Known:
        """Slopes where its fit ended, as far as they are kept; ``beside``: of what is fitted beside the new curve."""
        fit = self.fit
        before = self.judge.stage.index()[self.candidate.name].start if beside else np.inf
        return fit.near.of(fit.theta, fit.free, before) if fit.near is not None else NOT_KNOWN

    def forgotten(self) -> Array | None:
        """Of a hysteresis, the samples at which it has forgotten what was before the log; None: all, or hardly any."""
        c, n = self.candidate, len(self.judge.stage.t)
        if not c.quantity.stops:
            return None
        table, amplitudes = self.table()
        known = np.concatenate([forgotten(q, c.basis.high, table(amplitudes)) for q in c.quantity.course])
        known = known[:: max(1, round(len(known) / n))][:n]
        return None if known.all() or known.mean() < LEAST_SETTLED else known

    def refitted(self, judge: LeastSquaresProblem, fit: Fit, curves: Placings) -> FittedCandidate:
        """The same candidate as another fit has it: nothing that was worked out of this one holds of that."""
        return replace(
            self, judge=judge, fit=fit, curves=curves, told=None, errors=None, rows=None, formulas=None, loose=None,
            form="",
        )  # fmt: skip

    def counted(self, known: Array) -> Blocks:
        """What its blocks hold at samples that count."""
        if self.rows is None:
            self.rows = self.judge.linearise(self.fit.theta, self.fit.free)
        return self.judge.blocks(*(row * known for row in self.rows))

    def table(self) -> tuple[Callable[[Array], Array], Array]:
        """From the new curve's amplitudes to its table, and these amplitudes."""
        curve = self.curves[-1][0].curve
        assert curve is not None
        return curve.whole, self.fit.theta[self.judge.stage.index()[self.candidate.name]]

    def at(self, q: Array, amplitudes: Array) -> Array:
        """The new curve with these amplitudes at values of its quantity; of stops, its virgin curve."""
        curve = self.curves[-1][0].curve
        assert curve is not None
        if self.candidate.quantity.stops:
            return np.interp(q, self.candidate.grid, curve.whole(amplitudes))
        return curve.at(q, curve.row(amplitudes))


@dataclass(eq=False)
class Outcome:
    """What learning says.

    verdict  learned; named: laws of the library do as well; none: nothing is missing; unknown: no honest law is there
    tried    the model with its curves, curve by curve
    nearest  the candidates that come nearest, where nothing was learned
    why      in words, where nothing was learned
    decisions  what the acceptance rules said of each candidate
    """

    verdict: str
    tried: list[FittedCandidate] = field(default_factory=list)
    nearest: list[str] = field(default_factory=list)
    why: str = ""
    notes: list[str] = field(default_factory=list)
    decisions: list[Decision] = field(default_factory=list, repr=False)


def strange(candidate: Candidate) -> int:
    """Which of several candidates that do as well is meant: the lower, the plainer.

    What is at a place itself is plainer than what another signal says of it, and a signal is plainer than its
    difference to another. Reversals follow from every quantity that turns, and time from every one that drifts. What
    remembers imitates most.
    """
    name = candidate.quantity.name
    if name == candidate.at.removesuffix("_sensor").rpartition(".")[2] or candidate.near:
        return 0
    if candidate.quantity.remembers:
        return 5
    if name.startswith((WAY, DISTANCE, SINCE)) or candidate.quantity.period:
        return 4
    if name == TIME:
        return 3
    return 1 if candidate.quantity.less is None else MEASURED


def plain(candidate: Candidate) -> tuple[int, bool]:
    """What orders candidates that do as well, whatever they leave: the less, the plainer; what adds before what
    multiplies.
    """
    return strange(candidate), candidate.how.endswith("times")


def adds_what(one: Candidate, other: Candidate) -> bool:
    """Whether a curve adds, of the same quantity, where another multiplies."""
    return one.quantity.name == other.quantity.name and not one.how.endswith("times") and other.how.endswith("times")


def channel_of(candidate: Candidate) -> str:
    """What a candidate's quantity is of: of a lag, the channel behind it, which may say the same without one."""
    lag = named_lag(candidate.quantity.name)
    return lag[0] if lag else candidate.quantity.name


def without_its_lag(tried: FittedCandidate, late: FittedCandidate) -> bool:
    """Whether a curve is at the same place as one that remembers, of the channel behind it: it may say the same."""
    c, other = tried.candidate, late.candidate
    same = (c.how, c.at, c.quantity.name) == (other.how, other.at, channel_of(other))
    return other.quantity.remembers and same


def one_constant(tried: Sequence[FittedCandidate]) -> list[FittedCandidate]:
    """Those that are ``tried``, in their order, but of those that are no more than a constant at one place only the
    plainest, in the place of the first: a constant is the same law, whatever it is called a function of. The rest of
    the log may tell more.

    More than a constant is what explains as much of what that leaves as a second law has to.
    """
    flat: dict[tuple[str, str], list[FittedCandidate]] = {}
    for t in tried:
        left = left_by_its_mean(t)
        known = 2.0 * NATS if t.judge.stage.grain < 1.0 else LEAST_OF_NOISE * t.judge.n
        least = max(LEAST_FALL * (left - t.judge.n), known)
        if left - float(t.fit.cost.sum()) < least:
            flat.setdefault((t.candidate.how, t.candidate.at), []).append(t)
    plainest = {id(alike[0]): min(alike, key=lambda t: strange(t.candidate)) for alike in flat.values()}
    gone = {id(t) for alike in flat.values() for t in alike[1:]}
    return [plainest.get(id(t), t) for t in tried if id(t) not in gone]


def left_by_its_mean(tried: FittedCandidate) -> float:
    """Sum of squares with only the mean of the last curve, by the slopes of its fit, the model's own parameters within
    their bounds; infinite where it has no mean.
    """
    c, fit, judge = tried.candidate, tried.fit, tried.judge
    if 0 not in c.kept:
        return np.inf
    own = judge.stage.index()[c.name]
    gone = (fit.free > own.start) & (fit.free < own.stop)
    step = -fit.theta[fit.free] / judge.scale[fit.free] * gone
    a = fit.normals.sum(axis=0) + np.diag(fit.prior * judge.scale[fit.free] ** 2 + 1e-9)
    g = fit.gradients.sum(axis=0)
    low, high = ((b - fit.theta)[fit.free][~gone] / judge.scale[fit.free][~gone] for b in judge.bounds())
    step[~gone] = bounded_step(a[np.ix_(~gone, ~gone)], (g - a @ step)[~gone], low, high)
    n = fit.normals.sum(axis=0)
    return float(fit.cost.sum() - 2.0 * g @ step + step @ n @ step)


def stands(current: FittedCandidate, candidate: Candidate) -> bool:
    """Whether a candidate, with just this lag or period, is one of the curves that were learned already."""
    return any(q.effect == candidate.name for q, _ in current.curves)


def step_without(tried: FittedCandidate, held: Array) -> Array:
    """Where a fit's parameters move within their bounds, in their scales, when these blocks are left out."""
    fit, judge = tried.fit, tried.judge
    scale = judge.scale[fit.free]
    prior = fit.prior * scale**2
    deviation = (fit.theta - judge.stage.neutral())[fit.free] / scale
    a = fit.normals[~held].sum(axis=0)
    a = a + np.diag(prior + 1e-9 * np.maximum(np.diag(a), 1e-12))
    low, high = ((b - fit.theta)[fit.free] / scale for b in judge.bounds())
    return bounded_step(a, fit.gradients[~held].sum(axis=0) - prior * deviation, low, high)


# ---- Held-out errors of curves, and the samples at which they say something

Blocks = tuple[Array, Array, Array]  # sum of squares, gradient and normal matrix of each block, as `Fit` has them


def told_by_others(q: Array, start: Array) -> Array:
    """Of a quantity's samples, those at which it is between the least and the greatest value of the other blocks;
    ``start``: first sample of each block.
    """
    if len(start) < 2:
        return np.ones(len(q), dtype=bool)
    many = np.diff(np.append(start, len(q)))
    low, high = np.minimum.reduceat(q, start), np.maximum.reduceat(q, start)
    least, greatest = np.sort(low)[:2], np.sort(high)[-2:]
    others_low = np.where(np.arange(len(low)) == np.argmin(low), least[1], least[0])
    others_high = np.where(np.arange(len(high)) == np.argmax(high), greatest[0], greatest[1])
    return np.asarray((q >= np.repeat(others_low, many)) & (q <= np.repeat(others_high, many)))


def surely_more(by: Array) -> bool:
    """Whether what the error of a fit is more ``by``, block by block, than another's is no chance of the blocks."""
    return bool(by.sum() > SURELY * np.sqrt(len(by) * np.var(by, ddof=1)) > 0.0)


def at_samples(values: Sequence[float] | Array, n: int) -> Array | None:
    """A quantity's values at the ``n`` samples that a stage is judged on; None where they are others."""
    some = np.asarray(values, dtype=float)
    some = some[:: max(1, round(len(some) / n))][:n]
    return some if len(some) == n and bool(np.isfinite(some).all()) else None


def held_out(
    cost: Array, gradients: Array, normals: Array, mine: Array, prior: Array, deviation: Array,
    judged: Blocks | None = None,
) -> Array:  # fmt: skip
    """Cost of each block with a curve's parameters (``mine``, of all free ones) fitted to the other blocks, within its
    prior. All in the parameters' scales.

    judged  of those samples of each block that count (default: of all)
    """
    cost, counted, bends = judged or (cost, gradients, normals)
    g, a = gradients[:, mine], normals[:, mine][:, :, mine]
    p = prior[mine]
    pull = g.sum(axis=0) - p * deviation[mine]
    total = a.sum(axis=0) + np.diag(p + 1e-9 * np.maximum(np.diag(a.sum(axis=0)), 1e-12))
    step = np.linalg.solve(total - a, (pull - g)[:, :, None])[:, :, 0]
    out = cost - 2.0 * np.sum(step * counted[:, mine], axis=1)
    out += np.einsum("bi,bij,bj->b", step, bends[:, mine][:, :, mine], step)
    return np.asarray(np.maximum(out, 0.5 * cost))


def with_held_out(judge: LeastSquaresProblem, fit: Fit, judged: Blocks | None = None) -> Fit:
    """The fit with the held-out errors of its curves within their priors; ``judged``: of samples that count."""
    cost = (judged or (fit.cost,))[0]
    scale = judge.scale[fit.free]
    mine = fit.free >= len(judge.stage.parameters)
    if not mine.any():
        return replace(fit, held_out=cost) if judged else fit
    deviation = (fit.theta - judge.stage.neutral())[fit.free] / scale
    # what a bound holds stays there, whatever block is left out
    low, high = (b[fit.free] for b in judge.bounds())
    pull = fit.gradients.sum(axis=0) - fit.prior * scale**2 * deviation
    at = fit.theta[fit.free]
    mine &= ~((at <= low) & (pull < 0.0) | (at >= high) & (pull > 0.0))
    if not mine.any():
        return replace(fit, held_out=cost) if judged else fit
    held = held_out(fit.cost, fit.gradients, fit.normals, mine, fit.prior * scale**2, deviation, judged)
    return replace(fit, held_out=held)
