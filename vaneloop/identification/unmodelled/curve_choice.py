"""Where a formula speaks for a curve while curves are chosen: where splines go astray, and a formula does not.

Splines follow no corner. They are nothing beyond the values that the logs have visited, and little where one block
alone has been. A formula that does as well says more there, and it is what the user gets
(`identification.unmodelled.parametric_substitution`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from vaneloop.base.side_by_side import side_by_side
from vaneloop.identification.least_squares.noise import correlation_of
from vaneloop.identification.results import rms_of
from vaneloop.identification.selection.likelihood_acceptance import rival_nats
from vaneloop.identification.selection.rules import CONFIRMED, Confirmation
from vaneloop.identification.settings import (
    FORMULA_MAY_EARN,
    HARM,
    LEAST_FALL,
    LEAST_USE,
    MOST_LEFT,
    NOT_INSTEAD,
    OTHER_AMPLITUDE,
    UNKNOWN,
)
from vaneloop.identification.subsystem import Array
from vaneloop.identification.unmodelled.closed_form_fits import fitted_formulas
from vaneloop.identification.unmodelled.fitted_candidate import (
    MEASURED,
    CandidateSource,
    FittedCandidate,
    step_without,
    strange,
)
from vaneloop.identification.unmodelled.problem import CurveProblem
from vaneloop.identification.user_models.exogenous_regressors import swings

__all__ = [
    "all_in_their_place", "another_confirms", "at_its_place", "better_than", "earning_by_formula", "harmless",
    "instead_of", "leaves", "moves", "said_first", "stands_before", "without_memory",
]  # fmt: skip


def in_its_place(ground: CandidateSource, tried: FittedCandidate) -> list[FittedCandidate]:
    """The model with each formula in a curve's place; mean and slope may be what parameters of the model could have,
    unless the curve is nothing else.
    """
    if tried.loose is None:
        said = fitted_formulas(ground, tried, loose=True) or fitted_formulas(ground, tried)
        tried.loose = [f for _, f in said]
    return tried.loose


def all_in_their_place(ground: CandidateSource, tried: Sequence[FittedCandidate]) -> list[list[FittedCandidate]]:
    """`in_its_place` of several curves, side by side."""
    return list(side_by_side(lambda t: in_its_place(ground, t), tried, ground.shares))


def at_its_place(before: FittedCandidate, good: Sequence[FittedCandidate]) -> list[FittedCandidate]:
    """Those of what is at their place itself that explain most of the error: where one is a corner, splines leave a
    tenth of it, and what follows them elsewhere leaves less.
    """
    most = MOST_LEFT * max(float(before.fit.cost.sum()) / before.judge.n - 1.0, 0.0) + 1.0
    return [t for t in good if strange(t.candidate) == 0 and float(t.fit.cost.sum()) / max(t.judge.n, 1) <= most]


def earning_by_formula(
    learner: CurveProblem, before: FittedCandidate, poor: Sequence[FittedCandidate], among: Sequence[FittedCandidate]
) -> list[FittedCandidate]:
    """Of curves that do not earn their place, but are near the best of ``among`` or explain most of the error at their
    place itself, those of which a formula does; none of what remembers. A block that alone has been somewhere says
    nothing of splines there, and much of a formula.
    """
    reach, home = (
        min((learner.score(t, among) for t in among), default=0.0) + FORMULA_MAY_EARN,
        at_its_place(before, poor),
    )
    near = [t for t in poor if t in home or learner.score(t, among) < reach]
    near = [t for t in near if not t.candidate.quantity.remembers]
    said = all_in_their_place(learner.ground, near)
    return [t for t, formulas in zip(near, said, strict=True) if any(learner.accepts(before, f) for f in formulas)]


def harmless(
    learner: CurveProblem, before: FittedCandidate, good: list[FittedCandidate], left: Mapping[str, float]
) -> list[FittedCandidate]:
    """Of curves those that harm no test log, or of which a formula does not, if one is near the best; else all.

    left  what orders them, by name
    """
    fine = [t for t in good if any(not learner.objection(before, f) for f in (t, *(t.loose or ())))]
    reach = min(left[t.candidate.name] for t in good) + NOT_INSTEAD
    return fine if any(left[t.candidate.name] < reach for t in fine) else good


def without_memory(
    learner: CurveProblem, before: FittedCandidate, good: list[FittedCandidate]
) -> list[FittedCandidate]:
    """Without what remembers, where a memoryless curve leaves nothing but noise, and harms no test log: memory imitates
    much.
    """
    plain = [t for t in good if not t.candidate.quantity.remembers]
    enough = any(not learner.fails(t) and not learner.objection(before, t) for t in plain)
    return plain if enough else good


def with_and_without_mean(ground: CandidateSource, tried: FittedCandidate) -> list[FittedCandidate]:
    """The model with each formula in a curve's place, those that have the curve's mean and slope, and those of which
    parameters of the model may have them.
    """
    strict = [f for _, f in fitted_formulas(ground, tried)]
    if tried.loose is None:
        tried.loose = [f for _, f in fitted_formulas(ground, tried, loose=True)] or strict
    return [*strict, *(f for f in tried.loose if f not in strict)]


def said_first(learner: CurveProblem, near: list[FittedCandidate], left: Mapping[str, float]) -> list[FittedCandidate]:
    """Those that do as well, plainest first, but before all others the plainest that a formula says, where the best of
    measured channels leaves nothing but a noise that is known. A channel that follows the right one has a curve that
    does as well, and seldom a formula.

    A formula says a curve where it does as well as the best of all these curves and formulas: within the nats by which
    one law of the library beats another.
    """
    among = [t for t in near if strange(t.candidate) <= MEASURED]
    if not learner.ground.noise_known or len(among) < 2 or among[0] is not near[0]:
        return near
    if learner.fails(min(among, key=lambda t: left[t.candidate.name])):
        return near
    formulas = [(t, f) for t in among for f in with_and_without_mean(learner.ground, t)]
    every = [*among, *(f for _, f in formulas)]
    squares = {id(t): float(learner.judged(t, every)[1].held_out.sum()) for t in every}
    best = min(every, key=lambda t: squares[id(t)])
    judge, correlation = learner.judged(best, every)[0], correlation_of(best.judge, best.fit)
    nats = rival_nats(judge, squares[id(best)], correlation)
    said = {id(t) for t, f in formulas if squares[id(f)] - squares[id(best)] <= 2.0 * correlation * nats}
    first = next((t for t in among if id(t) in said), near[0])
    return [first, *(t for t in near if t is not first)]


def leaves(tried: FittedCandidate) -> float:
    """Held-out error, in noise floors, of a curve or of the best formula in its place."""
    return min(rms_of(t.judge, t.fit) for t in (tried, *(f for _, f in tried.formulas or ())))


def better_than(learner: CurveProblem, before: FittedCandidate, tried: FittedCandidate) -> bool:
    """Whether a curve, or a closed form in its place, is accepted over something else."""
    return any(learner.accepts(before, t) for t in (tried, *(f for _, f in tried.formulas or ())))


# ---- What confirms a curve beyond the blocks of its own log, which may all repeat one manoeuvre


def moves(tried: FittedCandidate) -> tuple[Array, Array]:
    """How wide the channel that a curve remembers swings in each block, from turn to turn, also where it turns outside
    of the block; and the number of the log that the block is of.
    """
    courses, judge = tried.candidate.quantity.course, tried.judge
    log = np.repeat(np.arange(len(courses)), [len(c) for c in courses])
    wide = np.concatenate([swings(c) for c in courses])
    n, start = judge.measured.shape[1], judge.block_start
    some = slice(None, None, max(1, round(len(wide) / n)))
    return np.maximum.reduceat(wide[some][:n], start), log[some][:n][start]


def another_confirms(learner: CurveProblem, before: FittedCandidate, tried: FittedCandidate) -> bool:
    """Whether another log, or another amplitude, says the same of a curve that remembers.

    Manoeuvres of one size do not hold out a hysteresis: what imitates one of them imitates all. So each log is left out
    in turn; of one log, the half of its blocks in which the channel swings least. The other half knows all radii and
    values that these have; what they know says nothing of wider swings. As the one question that is asked, it must be
    answered as well as a place is earned.

    What is of no measured value, such as time, asks for no other log. But where validation logs are there, one of them
    must be better for it: with its many splines time imitates whatever happened in the fitted log.
    """
    c = tried.candidate
    if not c.quantity.remembers and (strange(c) <= MEASURED or not learner.ground.tests):
        return True
    return learner.decisions.decide([CONFIRMED], _confirmation(learner, before, tried), tried.names, before.names)


def _confirmation(learner: CurveProblem, before: FittedCandidate, tried: FittedCandidate) -> Confirmation:
    """What validation logs, else other logs, else other amplitudes leave with a curve, as a share of the sum of squares
    without it.
    """
    change, tests = learner.change(before, tried), learner.ground.tests
    if change and tests & set(change):
        best = min(change[log] for log in tests & set(change))
        return Confirmation(float(np.exp(2.0 * best)), float(np.exp(-2.0 * LEAST_USE)))
    far, log = moves(tried)
    small = far <= np.median(far)
    if log.any():
        parts, most = [log == k for k in range(log.max() + 1)], (1.0 - LEAST_USE) ** 2
    elif not small.all() and np.median(far[~small]) > OTHER_AMPLITUDE * np.median(far[small]) > 0.0:
        parts, most = [small], 1.0 - LEAST_FALL
    else:
        return Confirmation(np.inf, 1.0 - LEAST_FALL)
    fit, now = tried.fit, before.fit.cost if tried.settled is None else before.counted(tried.settled)[0]
    left = []
    for held in parts:
        step = step_without(tried, held)
        change_of = np.einsum("bij,i,j->b", fit.normals[held], step, step) - 2.0 * fit.gradients[held] @ step
        was = float(now[held].sum())
        left.append(float((fit.cost[held] + change_of).sum()) / was if was > 0.0 else np.inf)
    return Confirmation(max(left), most)


def instead_of(learner: CurveProblem, named: FittedCandidate, curves: Sequence[FittedCandidate]) -> bool:
    """Whether curves, of which the last stands beside the others, are taken instead of the laws with names: they must
    earn that as a second law must before the first, and be the law, or be confirmed (`stands_before`). So may a formula
    in place of either: a test log that goes further tells what splines say at their ends, and what they do not follow
    of a first law is not the second's to follow. The user gets the formula.
    """
    tried = curves[-1]
    if _stands(learner, named, tried):
        return True
    if not learner.speaks or len(tried.candidate.axes) > 1:
        return False
    if not tried.candidate.quantity.stops and tried.formulas is None:
        tried.formulas = fitted_formulas(learner.ground, tried)
        if _stands(learner, named, tried):
            return True
    return len(curves) > 1 and any(_stands(learner, named, t) for _, t in curves[0].formulas or ())


def _stands(learner: CurveProblem, named: FittedCandidate, tried: FittedCandidate) -> bool:
    if not better_than(learner, named, tried):
        return False
    was = rms_of(named.judge, named.fit)
    for t in (tried, *(f for _, f in tried.formulas or ())):
        tests = {log: c for log, c in learner.change(named, t).items() if log in learner.ground.tests}
        if stands_before(was, rms_of(t.judge, t.fit), tests):
            return True
    return False


def stands_before(named: float, learned: float, tests: Mapping[str, float]) -> bool:
    """Whether what was learned stands before laws with names that leave more, held out.

    No test log may speak against it. It must be confirmed by the test logs, leave nothing but noise, or leave a quarter
    of the sum of squares at most: of two models that both fail, blocks of the log that both were fitted to say only
    which suits this log's motion.

    named, learned  held-out error in noise floors; ``tests``: change of the log error, by test log
    """
    if max(tests.values(), default=0.0) > HARM:
        return False
    if tests and float(np.mean(list(tests.values()))) < -LEAST_USE:
        return True
    return learned <= UNKNOWN or max(learned**2 - 1.0, 0.0) <= MOST_LEFT * max(named**2 - 1.0, 0.0)
