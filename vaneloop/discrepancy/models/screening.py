"""Which curves promise most: each candidate after one step by the slopes, before any is fitted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from vaneloop.discrepancy.models.curved import Candidate
from vaneloop.discrepancy.models.periods import Lines
from vaneloop.discrepancy.models.quantities import TIME
from vaneloop.discrepancy.models.smoothness import SCREENED
from vaneloop.discrepancy.models.steps import best_step, starts_of
from vaneloop.discrepancy.models.tried import Placings, Tried, channel_of, stands
from vaneloop.discrepancy.promise import Slopes
from vaneloop.discrepancy.stage import Array

if TYPE_CHECKING:
    from vaneloop.discrepancy.models.learning import Learner

__all__ = ["screened"]

PROBE, SMALL = "probe", 1e-2  # a constant by which a place is moved to see what a swing there would do
Promise = tuple[float, Candidate, Array]  # what a candidate would leave, and parameters to begin from
Starts = Sequence[tuple[Array, Slopes]]


def screened(learner: Learner, current: Tried, many: int, apart: float) -> tuple[float, list[Promise]]:
    """What a step of the model's own parameters leaves; and the ``many`` best candidates, best first.

    apart  by which times a lag is changed: those that are tried first are far apart
    """
    starts = starts_of(learner._judge((), current.curves, True), current.fit)
    bare = starts[0][1].left(starts[0][1].error)[0]
    every = [c for c in (*learner.candidates, *_periodic(learner, current)) if not stands(current, c)]
    out = sorted(learner.each(lambda c: _promise(learner, current, c, starts), every), key=lambda o: o[0])
    best: dict[tuple[str, str, str, bool], Promise] = {}
    for one in out:  # of several lags of a channel, one
        c = one[1]
        best.setdefault((c.how, c.at, channel_of(c), channel_of(c) == c.quantity.name), one)
    first = learner.each(lambda one: _its_lag(learner, current, one, starts, apart), list(best.values())[:many])
    return bare, sorted(first, key=lambda o: o[0])


def _its_lag(learner: Learner, current: Tried, one: Promise, starts: Starts, apart: float) -> Promise:
    """A candidate with the lag that promises most."""
    for factor in (apart, 1.0 / apart) if one[1].quantity.remembers else ():
        while (c := one[1].slower(factor)) is not None and not stands(current, c):
            other = _promise(learner, current, c, starts)
            if other[0] >= one[0]:
                break
            one = other
    return one


def _periodic(learner: Learner, current: Tried) -> list[Candidate]:
    """Every curve over time that may repeat itself, with the periods of the error; none where a shape is known."""
    over_time = [c for c in learner.candidates if c.quantity.name == TIME and not c.shape]
    if not over_time:
        return []
    fit, ground = current.fit, learner.ground
    courses = ground.courses(current.curves, fit.theta)
    lines = Lines(courses)
    out, plain, fast = [], lines.found(), lines.fast()
    for c in over_time:
        periods = plain
        if c.how.endswith("times"):
            whole = replace(c, name=PROBE, mean=True, untold=())
            values = np.zeros(len(whole.kept))
            values[0] = SMALL
            curves: Placings = (*current.curves, (whole.placed(), whole.effect(SCREENED)))
            moved = ground.courses(curves, np.concatenate([fit.theta, values]))
            periods = lines.found([m.error - w.error for m, w in zip(moved, courses, strict=True)])
            if not c.how.startswith("output"):
                periods += [p for p in fast if all(abs(p[0] / q[0] - 1.0) > 1e-3 for q in periods)]
        out += [c.every(*p) for p in periods]
    return out


def _promise(learner: Learner, current: Tried, candidate: Candidate, starts: Starts) -> Promise:
    """What a candidate leaves, in the simulation, after one step by the slopes, as damped as suits it best, from where
    that leaves least.

    Far from the truth slopes say nothing of data left out: that is asked when the candidate has been fitted.
    """
    effect = candidate.effect(SCREENED)
    judge = learner._judge((), (*current.curves, (candidate.placed(), effect)), True)
    slips = candidate.quantity.stops  # fitted to the end whatever it promises, from the fit that it follows
    steps = [best_step(current.fit, effect, judge, *s, cut_off=slips) for s in (starts[:1] if slips else starts)]
    left, theta = min(steps, key=lambda s: s[0])
    return left, candidate, theta
