"""Where a formula speaks for a curve while curves are chosen: where splines go astray, and a formula does not.

Splines follow no corner. They are nothing beyond the values that the logs have visited, and little where one block
alone has been. A formula that does as well says more there, and it is what the user gets
(`identification.unmodelled.parametric_substitution`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from vaneloop.base.side_by_side import side_by_side
from vaneloop.identification.least_squares.noise import correlation_of
from vaneloop.identification.results import rms_of
from vaneloop.identification.selection.likelihood_acceptance import rival_nats
from vaneloop.identification.settings import FORMULA_MAY_EARN, MOST_LEFT, NOT_INSTEAD
from vaneloop.identification.unmodelled.closed_form_fits import fitted_formulas
from vaneloop.identification.unmodelled.fitted_candidate import MEASURED, CandidateSource, FittedCandidate, strange
from vaneloop.identification.unmodelled.problem import CurveProblem

__all__ = [
    "all_in_their_place",
    "at_its_place",
    "better_than",
    "earning_by_formula",
    "harmless",
    "leaves",
    "said_first",
    "without_memory",
]


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
