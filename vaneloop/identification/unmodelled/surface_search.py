"""The search for a surface: a function of two quantities, where one curve fails, and two.

It must earn its place over what is there by then, as a second curve must over the first, and over every sum of two
curves at one place: where two quantities do not act together, there is no surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations, zip_longest

import numpy as np

from vaneloop.identification.results import rms_of
from vaneloop.identification.selection.relative_error_acceptance import score
from vaneloop.identification.settings import (
    FINE_SURFACE_SPLINES,
    MAY_CATCH_UP,
    RIVAL,
    SCREENED_BEND,
    SURFACE_BENDS_TRIED,
    SURFACE_QUANTITIES,
    SURFACES_FINISHED,
    SURFACES_QUICK,
    SURFACES_TRIED,
    UNKNOWN,
)
from vaneloop.identification.subsystem import Array
from vaneloop.identification.unmodelled.closed_form_fits import fitted_products
from vaneloop.identification.unmodelled.curve_candidates import SurfaceCandidate, may_be_of, surface_of
from vaneloop.identification.unmodelled.fitted_candidate import FittedCandidate, Outcome, plain, strange
from vaneloop.identification.unmodelled.problem import CurveProblem
from vaneloop.identification.unmodelled.screening import smoothed
from vaneloop.identification.user_models.exogenous_regressors import TIME

__all__ = ["SurfaceSelection"]


class SurfaceSelection:
    """A surface in place of the curves that were learned: the candidates of `stepwise` are models with one surface.

    Time is the last quantity: a surface of two others that does as well stands in the place of a curve over time.

    out      what has been learned: gets notes
    nothing  the model without any curve
    before   the model that a surface must be accepted over: the last curve's, or that without any
    drifting the model whose last curve is over time, instead of which a surface may stand; None: there is none
    """

    def __init__(self, learner: CurveProblem, out: Outcome, nothing: FittedCandidate):
        self.learner, self.out, self.nothing = learner, out, nothing
        self.before = out.tried[-1] if out.tried else nothing
        self.drifting: FittedCandidate | None = None
        if out.tried and out.tried[-1].candidate.quantity.name == TIME:
            self.drifting, self.before = self.before, ([nothing, *out.tried])[-2]

    def wants_more(self, current: FittedCandidate) -> bool:
        """Whether the curves, or their closed forms, leave clearly more than noise."""
        learner = self.learner
        if current is not self.before or learner.shape or not (learner.ground.surfaces and learner.ranked):
            return False
        if self.drifting is not None:
            return True
        if any(not learner.fails(f) for _, f in current.formulas or ()):
            return False
        return rms_of(current.judge, current.fit) > UNKNOWN

    def finalists(self, current: FittedCandidate) -> list[FittedCandidate]:
        """The surfaces that promise most, fitted to the end."""
        return _finished(self.learner, self.nothing)

    def accepted(self, current: FittedCandidate, tried: Sequence[FittedCandidate]) -> list[FittedCandidate]:
        """Those that the rules accept over no curve, over the curves, and over every sum of two curves at one place."""
        learner, nothing = self.learner, self.nothing
        sums = list(learner.each(lambda t: _sum(learner, nothing, t), tried))
        others = [nothing, *([current] if current is not nothing else []), *sums]
        earned = [t for t in tried if all(learner.accepts(other, t) for other in others)]
        if (over_time := self.drifting) is None:
            return earned
        return [
            t for t in earned if learner.score(t, [t, over_time]) < learner.score(over_time, [t, over_time]) + RIVAL
        ]

    def chosen(self, current: FittedCandidate, accepted: Sequence[FittedCandidate]) -> FittedCandidate | None:
        """Of those that do as well as the best the preferred one, unless it harms a validation log."""
        learner, nothing, good = self.learner, self.nothing, list(accepted)
        left = {t.candidate.name: learner.left(nothing, t, good) for t in good}
        for t in good:
            t.formulas = fitted_products(learner.ground, t)
            for _, f in t.formulas:  # the product of two laws may be what splines are not, as a curve's formula
                left[t.candidate.name] = min(left[t.candidate.name], learner.left(nothing, f, good))
        least = min(left.values())
        near = [t for t in good if left[t.candidate.name] < least + RIVAL]
        best = min(near, key=lambda t: (*plain(t.candidate), left[t.candidate.name]))
        why = learner.objection(current, best)
        if why and not any(_does_as_well(learner, current, best, f) for _, f in best.formulas or ()):
            self.out.notes.append(f"{best.candidate.name} fits, but is not learned: {why}")
            return None
        return replace(best, rivals=[t.candidate.name for t in near if t is not best])

    def pruned(self, models: list[FittedCandidate]) -> list[FittedCandidate]:
        """As they are: there is one surface at most."""
        return models


def _does_as_well(
    learner: CurveProblem, before: FittedCandidate, surface: FittedCandidate, formula: FittedCandidate
) -> bool:
    """Whether a formula does as well as its surface where that has been learned, and harms no log that goes further."""
    near = learner.score(formula, [formula, surface]) < learner.score(surface, [formula, surface]) + RIVAL
    return near and not learner.objection(before, formula)


def _candidates(learner: CurveProblem) -> list[SurfaceCandidate]:
    """The surfaces at every place of pairs of quantities: those that the best curves are of first, and the place's own.
    What acts by another may be nothing by itself, so that others follow.
    """
    known = [c for c in learner.candidates if may_be_of(c.quantity)]
    ranked = [t.candidate for column in zip_longest(*learner.ranked) for t in column if t is not None]
    first = [c.quantity.name for c in ranked if may_be_of(c.quantity)]
    names = list(dict.fromkeys([*first, *(c.quantity.name for c in known)]))[:SURFACE_QUANTITIES]
    places = list(dict.fromkeys((c.how, c.at) for c in (*ranked, *known)))
    both = []
    for k, place in enumerate(places):
        here = [c for c in known if (c.how, c.at) == place and (c.quantity.name in names or strange(c) == 0)]
        order = {c.quantity.name: names.index(c.quantity.name) if c.quantity.name in names else 0 for c in here}
        both += [(k + order[a.quantity.name] + order[b.quantity.name], a, b) for a, b in combinations(here, 2)]
    both.sort(key=lambda pair: pair[0])
    return [s for _, one, two in both[:SURFACES_TRIED] if (s := surface_of(one, two)) is not None]


def _finished(learner: CurveProblem, nothing: FittedCandidate) -> list[FittedCandidate]:
    """The surfaces that promise most, fitted to the end in place of all curves; best first."""
    one_step = lambda c: learner.fitted(nothing, c, SCREENED_BEND, _begin(learner, nothing, c), 1, True)  # noqa: E731
    begun = list(learner.each(one_step, _candidates(learner)))
    begun.sort(key=lambda t: float(t.fit.cost.sum()))
    few = lambda t: learner.fitted(nothing, t.candidate, SCREENED_BEND, t.fit, 5, True)  # noqa: E731
    quick = list(learner.each(few, begun[:SURFACES_QUICK]))
    quick.sort(key=lambda t: score(t.judge, t.fit))
    to_the_end = lambda t: smoothed(learner, nothing, t.candidate, t.fit, SURFACE_BENDS_TRIED)  # noqa: E731
    done = learner.ordered(list(learner.each(to_the_end, quick[:SURFACES_FINISHED])))
    if done and learner.fails(done[0]):
        close = [t for t in done if learner.score(t, done) < learner.score(done[0], done) + MAY_CATCH_UP]
        done = learner.ordered(
            [*done, *(f for f in learner.each(lambda t: _finer(learner, nothing, t), close) if f is not None)]
        )
    first_of = {t.candidate.name: t for t in reversed(done)}
    return [t for t in done if first_of[t.candidate.name] is t]


def _begin(learner: CurveProblem, nothing: FittedCandidate, c: SurfaceCandidate) -> Array:
    """Parameters to begin from: the best curve of either quantity at the same place, where one was fitted alone. A step
    from no law at all goes astray where a state that runs away is one of the quantities.
    """
    out = np.zeros(len(nothing.fit.theta) + len(c.pairs))
    out[: len(nothing.fit.theta)] = nothing.fit.theta
    names = [q.name for q, _ in c.axes]
    for t in learner.ranked[0]:
        one = t.candidate
        if (one.how, one.at) == (c.how, c.at) and one.quantity.name in names:
            axis = names.index(one.quantity.name)
            basis = c.axes[axis][1]
            table, amplitudes = t.table()
            across = np.linalg.lstsq(basis.design(one.grid) @ basis.turn, table(amplitudes), rcond=None)[0]
            out[: len(nothing.fit.theta)] = t.fit.theta[: len(nothing.fit.theta)]
            for k, ij in enumerate(c.pairs):
                if ij[1 - axis] == 0:
                    out[len(nothing.fit.theta) + k] = across[ij[axis]]
            break
    return out


def _finer(learner: CurveProblem, nothing: FittedCandidate, coarse: FittedCandidate) -> FittedCandidate | None:
    """The same surface with `FINE_SURFACE_SPLINES` splines of each quantity."""
    c = coarse.candidate
    assert isinstance(c, SurfaceCandidate)
    fine = surface_of(c, replace(c, quantity=c.other), FINE_SURFACE_SPLINES)
    if fine is None:
        return None
    table, amplitudes = coarse.table()
    (one, other), n = fine.grids, len(coarse.fit.theta) - len(amplitudes)
    design = np.kron(fine.basis.design(one), fine.across.design(other)) @ fine.turn
    theta = np.concatenate([coarse.fit.theta[:n], np.linalg.lstsq(design, table(amplitudes).ravel(), rcond=None)[0]])
    return smoothed(learner, nothing, fine, theta, SURFACE_BENDS_TRIED, coarse.wiggle)


def _sum(learner: CurveProblem, nothing: FittedCandidate, whole: FittedCandidate) -> FittedCandidate:
    """The sum of a curve of each of a surface's quantities, at its place."""
    c = whole.candidate
    assert isinstance(c, SurfaceCandidate)
    of = dict(zip(c.pairs, whole.fit.theta[len(nothing.fit.theta) :], strict=True))
    apart = replace(c, additive=True)
    theta = np.concatenate([whole.fit.theta[: len(nothing.fit.theta)], [of[ij] for ij in apart.pairs]])
    return learner.fitted(nothing, apart, whole.wiggle, theta, 12)
