"""The formula is the law where it does as well as the curve: what the answer and the law file then hold.

A curve stays level beyond the values that the logs have visited. A formula goes on, and a log that goes further needs
that. So a formula speaks for its curve where its error is not larger by what two laws that do equally well differ by
(`identification.selection.relative_error_acceptance.RIVAL`): held out, and on every test log over all of its samples.
Of several the simplest that is as near to the best of them. That it has fewer numbers than the curve does not count for
it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vaneloop.base.forms import NAMED
from vaneloop.identification.candidates.closed_forms import Formula, text_of
from vaneloop.identification.least_squares.problem import LeastSquaresProblem
from vaneloop.identification.results import rms_of
from vaneloop.identification.settings import HARM, LEAST_PARAMETER_LEFT, PER_PARAMETER, RIVAL
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
from vaneloop.identification.unmodelled.fitted_candidate import CandidateSource, FittedCandidate, with_held_out
from vaneloop.identification.unmodelled.learned_law import LearnedLaw
from vaneloop.identification.unmodelled.problem import CurveProblem
from vaneloop.identification.user_models.terms import runs

__all__ = ["as_the_law", "more_left", "spoken", "takes_mean_back", "tell_each_by_its_formula"]


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
