"""Where a formula speaks for a curve while curves are chosen: where splines go astray, and a formula does not.

Splines follow no corner. They are nothing beyond the values that the logs have visited, and little where one block
alone has been. A formula that does as well says more there, and it is what the user gets (`spoken`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from vaneloop.base.forms import NAMED
from vaneloop.base.side_by_side import side_by_side
from vaneloop.identification.candidates.closed_forms import Formula, text_of
from vaneloop.identification.least_squares.noise import correlation_of
from vaneloop.identification.least_squares.problem import LeastSquaresProblem
from vaneloop.identification.results import rms_of
from vaneloop.identification.selection.likelihood_acceptance import rival_nats
from vaneloop.identification.selection.rules import CONFIRMED, Confirmation
from vaneloop.identification.settings import (
    FORMULA_MAY_EARN,
    HARM,
    LEAST_FALL,
    LEAST_PARAMETER_LEFT,
    LEAST_USE,
    MOST_LEFT,
    NOT_INSTEAD,
    OTHER_AMPLITUDE,
    PER_PARAMETER,
    RIVAL,
    UNKNOWN,
)
from vaneloop.identification.subsystem import Array
from vaneloop.identification.unmodelled.closed_form_fits import (
    Product,
    effect_of,
    fitted_formulas,
    fitted_product,
    goes_on,
    reach_of,
)
from vaneloop.identification.unmodelled.curve_candidates import Candidate, SurfaceCandidate
from vaneloop.identification.unmodelled.fitted_candidate import (
    MEASURED,
    CandidateSource,
    FittedCandidate,
    step_without,
    strange,
    with_held_out,
)
from vaneloop.identification.unmodelled.learned_law import LearnedLaw
from vaneloop.identification.unmodelled.problem import CurveProblem
from vaneloop.identification.user_models.exogenous_regressors import swings
from vaneloop.identification.user_models.terms import runs

__all__ = [
    "all_in_their_place", "another_confirms", "as_the_law", "at_its_place", "better_than", "earning_by_formula",
    "harmless", "instead_of", "leaves", "more_left", "moves", "said_first", "spoken", "stands_before",
    "takes_mean_back", "tell_each_by_its_formula", "without_memory",
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


# ---- The formula is the law where it does as well as the curve: what the answer and the law file then hold
#
# A curve stays level beyond the values that the logs have visited. A formula goes on, and a log that goes further needs
# that. So a formula speaks for its curve where its error is not larger by what two laws that do equally well differ by
# (`RIVAL`): held out, and on every test log over all of its samples. Of several the simplest that is as near to the
# best of them. That it has fewer numbers than the curve does not count for it.


def spoken(
    learner: CurveProblem, curves: Sequence[FittedCandidate], laws: Sequence[LearnedLaw]
) -> tuple[FittedCandidate, list[LearnedLaw]]:
    """The model with a formula in place of each curve that one does as well as, fitted together; and the laws with
    these formulas.

    curves  as they were learned, each beside those before it; ``laws``: what is said of them. The second one goes where
            it makes a test log clearly worse beside the first one's formula
    """
    now, out = curves[-1], list(laws)
    for k, tried in enumerate(curves):
        c = tried.candidate
        if c.quantity.stops:
            continue
        fitted = tried.formulas or []
        options = []  # simplest first
        for f in laws[k].formulas:
            alone = next(t for g, t in fitted if g is f)
            if (one := _in_place(learner.ground, now, k, c, f, alone)) is not None:
                options.append((f, *one))
        left = {f.form: more_left(learner, now, t, curves) for f, t, _ in options}
        in_all = {form: held + (float(np.mean(tests)) if tests else 0.0) for form, (held, tests) in left.items()}
        best = min([0.0, *in_all.values()])
        for f, t, said in options:
            held, tests = left[f.form]
            as_well = held <= RIVAL or in_all[f.form] <= -RIVAL  # more is won on test logs than lost
            as_well = as_well and max(tests, default=0.0) <= RIVAL
            if as_well and in_all[f.form] <= best + RIVAL:
                formulas = [said if g is f else g for g in out[k].formulas]
                reach = goes_on(learner.ground, c, NAMED[f.form], np.array(list(said.numbers.values())))
                out[k], now = replace(out[k], spoken=said, reach=reach, formulas=formulas), t
                break
    if len(out) > 1 and out[0].spoken:  # what patched the first curve may harm its formula
        formula = next(f for f in laws[0].formulas if f.form == out[0].spoken.form)
        alone = next(t for g, t in curves[0].formulas or [] if g is formula)
        one = _in_place(learner.ground, curves[0], 0, curves[0].candidate, formula, alone)
        if one is not None and max(more_left(learner, one[0], now, curves)[1], default=0.0) > HARM:
            formulas = [one[1] if g.form == formula.form else g for g in out[0].formulas]
            now, out = one[0], [replace(out[0], spoken=one[1], formulas=formulas)]
    if now is not curves[-1]:
        out[-1] = replace(out[-1], error_after=rms_of(now.judge, now.fit))
    return now, out


def tell_each_by_its_formula(learner: CurveProblem, first: FittedCandidate, second: FittedCandidate) -> None:
    """Formulas of two curves that stand beside each other: alone, what the second one says is in the first one's error,
    and leads its formulas astray. Where a formula of the first leaves less than both curves do, the second one has its
    formulas beside that.
    """
    if first.candidate.quantity.stops:
        return
    first.formulas = _formulas_beside(learner, first, second)
    said = [second, *(t for _, t in first.formulas)]
    best = min(said, key=lambda t: learner.score(t, said))
    if best is not second and learner.fails(second) and learner.speaks and not second.candidate.quantity.stops:
        second.formulas = _formulas_beside(learner, second, best)


def _formulas_beside(
    learner: CurveProblem, tried: FittedCandidate, pair: FittedCandidate
) -> list[tuple[Formula, FittedCandidate]]:
    """Formulas of a curve as it is in a model with another one."""
    name = tried.candidate.name
    curves = (*(c for c in pair.curves if c[1].name != name), *(c for c in pair.curves if c[1].name == name))
    judge = LeastSquaresProblem(learner.ground.stage((), curves), learner.ground.floor, pair.settled)
    fit = with_held_out(judge, judge.fit(tuple(e.name for _, e in curves), _as_in(pair, judge), 1))
    return fitted_formulas(learner.ground, tried.refitted(judge, fit, curves))


def _as_in(tried: FittedCandidate, judge: LeastSquaresProblem, but: str = "") -> Array:
    """Parameters of ``judge``'s model, with what a fit gave to those of the same name; ``but``: a curve that is not."""
    theta, index, own = judge.stage.neutral(), judge.stage.index(), len(judge.stage.parameters)
    theta[:own] = tried.fit.theta[:own]
    for name, at in tried.judge.stage.index().items():
        if name != but:
            theta[index[name]] = tried.fit.theta[at]
    return theta


def more_left(
    learner: CurveProblem, before: FittedCandidate, tried: FittedCandidate, among: Sequence[FittedCandidate]
) -> tuple[float, list[float]]:
    """Log of what a formula leaves over what stood there before it: held out where all of ``among`` know something,
    whatever numbers it has; and of each test log, over all its samples.
    """
    held = learner.score(tried, among) - learner.score(before, among)
    held -= PER_PARAMETER * (len(tried.fit.free) - len(before.fit.free))
    return held, [v for log, v in learner.change(before, tried).items() if log in learner.ground.tests]


def takes_mean_back(level: float, numbers: Array, own: Array, place: int) -> bool:
    """Put what a formula was given as its ``level`` back: the parameter at ``place`` of the model's ``own`` had its
    mean m, p (1 + f - m) = p (1 - m) (1 + f / (1 - m)). Whether enough of the parameter is left then.
    """
    kept = 1.0 + level
    if level and kept < LEAST_PARAMETER_LEFT:
        return False
    if level:
        numbers[0] /= kept
        own[place] *= kept
    return True


def _in_place(
    ground: CandidateSource, now: FittedCandidate, k: int, c: Candidate, formula: Formula, alone: FittedCandidate
) -> tuple[FittedCandidate, Formula] | None:
    """The model with a formula in place of its ``k``-th curve, fitted, and the formula as it then is; None where it is
    none.

    alone  the formula in the curve's place, without the curves after it
    """
    form = NAMED[formula.form]
    numbers = np.array(list(formula.numbers.values()))
    own = alone.fit.theta[: len(alone.judge.stage.parameters)].copy()
    if not takes_mean_back(formula.level, numbers, own, c.place):
        return None
    effect = effect_of(c.name, form.numbers, numbers)
    reach = goes_on(ground, c, form, numbers)
    table, jump = runs(form, *reach, ground.points)
    curves = list(now.curves)
    curves[k] = (c.placed_as(table, len(numbers), reach, jump), effect)
    judge = LeastSquaresProblem(ground.stage((), tuple(curves)), ground.floor, now.settled)
    theta, index = _as_in(now, judge, c.name), judge.stage.index()
    theta[: len(own)] = own
    theta[index[c.name]] = numbers
    names = tuple(e.name for e in judge.stage.effects)
    led = judge.lead(tuple(n for n in names if n != c.name), theta, 8)
    fit = with_held_out(judge, judge.fit(names, led.theta, 12, slopes=led.slopes))
    values: Array = form.plain(fit.theta[index[c.name]])
    if not np.all(np.isfinite(values)):
        return None
    text = text_of(form, values, c.quantity.name, bool(c.basis.low >= 0.0))
    said = replace(
        formula, text=text, numbers=dict(zip(form.numbers, (float(v) for v in values), strict=True)),
        error=rms_of(judge, fit), level=0.0,
    )  # fmt: skip
    return now.refitted(judge, fit, tuple(curves)), said


def as_the_law(
    learner: CurveProblem, tried: FittedCandidate, formulas: Sequence[Formula]
) -> tuple[FittedCandidate, Product] | None:
    """The simplest product that does as well as its surface, held out and on every test log, in its place as far as it
    goes on; None where there is none.
    """
    c, ground = tried.candidate, learner.ground
    assert isinstance(c, SurfaceCandidate)
    for f in formulas:
        alone = next((t for g, t in tried.formulas or () if g is f), None)
        if alone is None or not isinstance(f, Product):
            continue
        theta, at = alone.fit.theta.copy(), len(alone.judge.stage.parameters)
        theta[at:] = list(f.numbers.values())
        if not takes_mean_back(f.level, theta[at:], theta[:at], c.place):
            continue
        got = fitted_product(ground, tried, *f.forms, theta, reach_of(ground, tried, f), False)
        if got is None:
            continue
        said, now = got
        held, tests = more_left(learner, tried, now, [now, tried])
        if max([held, *tests]) <= RIVAL and isinstance(said, Product):
            return now, said
    return None
