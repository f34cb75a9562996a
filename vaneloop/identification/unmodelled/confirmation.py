"""What confirms a curve beyond the blocks of its own log, which may all repeat one manoeuvre.

What imitates a law in one manoeuvre imitates it in each repetition: blocks of one sine that are left out hold nothing
out. So memory must be the same at another amplitude, or in another log. And where laws with names say most of the error
already, another law that is not the truth either does not stand before them for what it gains in that one log.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from vaneloop.identification.results import rms_of
from vaneloop.identification.selection.rules import CONFIRMED, Confirmation
from vaneloop.identification.settings import HARM, LEAST_FALL, LEAST_USE, MOST_LEFT, OTHER_AMPLITUDE, UNKNOWN
from vaneloop.identification.subsystem import Array
from vaneloop.identification.unmodelled.closed_form_fits import fitted_formulas
from vaneloop.identification.unmodelled.fitted_candidate import FittedCandidate, step_without
from vaneloop.identification.unmodelled.parametric_preference import better_than
from vaneloop.identification.unmodelled.problem import CurveProblem
from vaneloop.identification.user_models.hysteresis_regressors import swings

__all__ = ["another_confirms", "instead_of", "moves", "stands_before"]


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
    """
    if not tried.candidate.quantity.remembers:
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
