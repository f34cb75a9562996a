"""What a search for curves works on: candidates of a subsystem, how one is fitted, scored and compared."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager

import numpy as np

from vaneloop.base.side_by_side import Answer, Item, side_by_side
from vaneloop.identification.least_squares.levenberg_marquardt import NOT_KNOWN, Known
from vaneloop.identification.least_squares.noise import correlation_of
from vaneloop.identification.least_squares.problem import Fit, LeastSquaresProblem
from vaneloop.identification.results import StageDiagnosis
from vaneloop.identification.selection.likelihood_acceptance import LikelihoodAcceptance, rival_nats
from vaneloop.identification.selection.relative_error_acceptance import RelativeErrorAcceptance, score
from vaneloop.identification.selection.rules import (
    EXCESS,
    GAIN,
    NEAR_NOISE,
    OTHER_LOGS,
    SUITS_ALL,
    UNKNOWN_NOISE,
    AllRows,
    Comparison,
    Decisions,
    LogChanges,
)
from vaneloop.identification.settings import NATS, RIVAL
from vaneloop.identification.subsystem import Array
from vaneloop.identification.unmodelled.curve_candidates import Candidate
from vaneloop.identification.unmodelled.fitted_candidate import (
    CandidateSource,
    FittedCandidate,
    Placings,
    at_samples,
    told_by_others,
    with_held_out,
)
from vaneloop.identification.user_models.bound_system import rms_of_rows

__all__ = ["CurveProblem", "above_the_noise", "grain_of", "in_grains", "promises"]


class CurveProblem:
    """Curves on one subsystem: how each is fitted, what it leaves on data left out, and what it does to other logs.

    ground    the stage on its logs
    d         what `diagnose` says of it
    progress  called with the share that is done
    shape     what is known of every curve (`identification.unmodelled.curve_candidates.SHAPES`)
    speaks    whether a formula that does as well as its curve will be the law
    """

    def __init__(
        self, ground: CandidateSource, d: StageDiagnosis, progress: Callable[[float], None] | None = None,
        shape: Sequence[str] = (), speaks: bool = True,
    ):  # fmt: skip
        self.ground, self.d, self.progress, self.shape = ground, d, progress or (lambda _: None), tuple(shape)
        self.speaks = speaks
        self.decisions = Decisions()
        self.ranked: list[list[FittedCandidate]] = []  # of each search for a curve, what was fitted, best first
        self.judge = self.judge_of((), ())
        self.base = self.judge.fit((), d.base.theta[: len(self.judge.stage.parameters)], 4)
        self.form = RelativeErrorAcceptance(self.judge)
        self.form.begin(self.base)
        self.faint = ground.noise_known and not self.form.fails(self.base)
        if self.faint:
            in_grains(ground, grain_of(self.judge, self.base), [self.judge])
        self.candidates = [s for c in ground.candidates(self.base.theta) if (s := c.shaped(shape)) is not None]

    def judge_of(
        self, laws: Sequence[str], curves: Placings, quick: bool = False, keep: Array | None = None
    ) -> LeastSquaresProblem:  # fmt: skip
        return LeastSquaresProblem(self.ground.stage(laws, curves, quick), self.ground.floor, keep)

    def fails(self, tried: FittedCandidate) -> bool:
        """Whether there is any error beyond noise where it is judged."""
        return RelativeErrorAcceptance(tried.judge).fails(tried.fit)

    def each(self, f: Callable[[Item], Answer], items: Iterable[Item]) -> Iterator[Answer]:
        """`side_by_side` where the ground's models allow it."""
        return side_by_side(f, items, self.ground.shares)

    @contextmanager
    def told_in_nats(self, tried: FittedCandidate) -> Iterator[None]:
        """Compare errors in nats meanwhile, if a curve leaves nothing but a noise that is known: 1 % of the error there
        can be a hundred nats.
        """
        grain = self.judge.stage.grain
        if self.ground.noise_known and grain == 1.0 and not self.fails(tried):
            in_grains(self.ground, grain_of(tried.judge, tried.fit), [self.judge])
        try:
            yield
        finally:
            in_grains(self.ground, grain, [self.judge])

    def _known(self, among: Sequence[FittedCandidate]) -> Array:
        """Samples where all these curves are told by more than one block."""
        start, n = self.judge.block_start, len(self.judge.stage.t)
        known = np.ones(n, dtype=bool)
        for q in {q.name: q for t in among for q, _ in t.candidate.axes}.values():
            if (values := at_samples(q.visited, n)) is not None:
                known &= told_by_others(values, start)
        for settled in (t.settled for t in among):
            known &= True if settled is None else settled
        return known if known.any() else ~known

    def judged(self, tried: FittedCandidate, among: Sequence[FittedCandidate]) -> tuple[LeastSquaresProblem, Fit]:
        """A fit with its held-out errors, where all curves of ``among`` know something."""
        known = self._known(among)
        if known.all():
            return self.judge, tried.fit
        judge = LeastSquaresProblem(self.judge.stage, self.ground.floor, keep=known)
        return judge, with_held_out(tried.judge, tried.fit, tried.counted(known))

    def score(self, tried: FittedCandidate, among: Sequence[FittedCandidate] = ()) -> float:
        """What orders curves: `score`, where all of ``among`` (default: itself) know something."""
        return score(*self.judged(tried, among or [tried]))

    def accepts(self, before: FittedCandidate, tried: FittedCandidate) -> bool:
        """Whether the rules accept a curve, on the samples where it and what it is compared with are determined."""
        among = [tried, before] if before.curves else [tried]
        (judge, was), (_, now) = (self.judged(t, among) for t in (before, tried))
        correlation = correlation_of(tried.judge, tried.fit) if self.faint else 1.0
        case = Comparison(judge, was, now, correlation, self.form.form)
        rules = (EXCESS, GAIN) if self.faint else UNKNOWN_NOISE
        return self.decisions.decide(rules, case, tried.names, before.names)

    def left(self, before: FittedCandidate, tried: FittedCandidate, among: Sequence[FittedCandidate]) -> float:
        """What orders candidates ``among`` which one is chosen: the score and what each makes of the test logs."""
        return self.score(tried, among) + self.tested(before, tried, among)

    def tested(self, before: FittedCandidate, tried: FittedCandidate, among: Sequence[FittedCandidate]) -> float:
        """Log of what a curve makes of the test logs' error, where all of ``among`` know something."""
        inside = [self.ground.within(t.candidate) for t in among]
        part = {log: np.logical_and.reduce([i[log] for i in inside if log in i]) for i in inside for log in i}
        change = self.change(before, tried, part)
        tests = [c for log, c in change.items() if log in self.ground.tests]
        return float(np.mean(tests)) if tests else 0.0

    def ordered(self, tried: Sequence[FittedCandidate]) -> list[FittedCandidate]:
        """The best first."""
        return sorted(tried, key=lambda t: self.score(t, tried))

    def fitted(
        self, current: FittedCandidate, candidate: Candidate, wiggle: float, begin: Array | Fit, iterations: int,
        quick: bool = False, slopes: Known = NOT_KNOWN,
    ) -> FittedCandidate:  # fmt: skip
        """A candidate fitted beside the model and its curves; ``begin``: parameters, or its fit as smooth as another
        ``wiggle`` makes it, on the same samples; ``slopes`` near there, as far as they are known.
        """
        curves: Placings = (*current.curves, (candidate.placed(), candidate.effect(wiggle)))
        settled = [s for s in (current.settled, candidate.settled) if s is not None and not quick]
        judge = self.judge_of((), curves, quick, np.logical_and.reduce(settled) if settled else None)
        judge.sparing = True
        names = tuple(e.name for _, e in curves)
        fit = with_held_out(judge, judge.fit(names, begin, iterations, slopes=slopes))
        return FittedCandidate(candidate, wiggle, judge, fit, curves)

    def objection(self, before: FittedCandidate, tried: FittedCandidate) -> str:
        """Why the logs, or other subsystems in which it acts, speak against a curve; "": they do not."""
        logs = LogChanges(self.change(before, tried), self.ground.tests)
        sure = True
        if self.faint:
            rows = AllRows(before.errors or {}, tried.errors or {}, self.ground.tests)
            sure = self.decisions.decide(NEAR_NOISE, rows, tried.names, before.names)
        harmless = self.decisions.decide(OTHER_LOGS, logs, tried.names, before.names)
        if not sure or not harmless:
            return logs.objection() if sure else rows.objection()
        change = self.ground.elsewhere(tried.curves, tried.fit.theta)
        elsewhere = LogChanges(change, frozenset(change))
        return "" if self.decisions.decide([SUITS_ALL], elsewhere, tried.names, before.names) else elsewhere.objection()

    def change(
        self, before: FittedCandidate, tried: FittedCandidate, part: Mapping[str, Array] | None = None
    ) -> dict[str, float]:
        """Log of the error with a curve over that without, log by log; ``part``: of these logs, of these samples."""
        was, now = self._levels(before, part or {}), self._levels(tried, part or {})
        return {log: now[log] - was[log] for log in was if log in now}

    def _levels(self, of: FittedCandidate, part: Mapping[str, Array]) -> dict[str, float]:
        if of.errors is None:
            of.errors = self.ground.errors(of.curves, of.fit.theta)
        out = {}
        for log, e in of.errors.items():
            some = e[:, part[log]] if log in part else e
            if self.faint:
                out[log] = 0.5 * float(np.log(np.nanmean(some**2))) / self.judge.stage.grain
                continue
            rms = rms_of_rows(some)
            if np.isfinite(rms).all():
                out[log] = float(np.log(np.maximum(rms, 1.0)).mean())
        return out


# ---- Where the error is hardly more than a noise that is known: there a log-likelihood tells what a share of it cannot
#
# A law may move an output by 2 % of its noise and be beyond doubt over 30,000 samples. So where a stage comes near its
# noise floor errors are compared in nats (`identification.selection.likelihood_acceptance`), as laws of the library are
# there. All limits in log error then stand for as many nats as `RIVAL` does, which is `rival_nats`. A curve must gain
# what a law of the library must, by as much more as it has more numbers: that is more than the number of candidates
# asks. And samples that nothing was fitted to must say so by themselves.


def above_the_noise(judge: LeastSquaresProblem, fit: Fit) -> bool:
    """Whether a fit's error is more than its noise, as well as that is known."""
    criterion = LikelihoodAcceptance(judge)
    criterion.learn(fit)
    return criterion.fails(fit)


def grain_of(judge: LeastSquaresProblem, fit: Fit) -> float:
    """Log error that counts as much as 1 does far from the noise, where the best model is ``fit`` of ``judge``."""
    correlation = correlation_of(judge, fit)
    nats = rival_nats(judge, float(fit.held_out.sum()), correlation)
    return min(1.0, nats * correlation / max(judge.n, 1) / RIVAL)


def in_grains(ground: CandidateSource, grain: float, judges: Iterable[LeastSquaresProblem]) -> None:
    """Compare the errors of a ground's stages, and those of these judges, in ``grain`` from now on."""
    ground.in_grains(grain)
    for judge in judges:
        judge.stage.grain = grain


def promises(bare: float, best: float) -> bool:
    """Whether a step with the best candidate gains what a law must; ``bare``, ``best``: sums of squares left by a step
    of the model's own parameters, and by that one.
    """
    return bare - best > 2.0 * NATS
