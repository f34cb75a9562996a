"""Which curves promise most: each candidate after one step by the slopes, before any is fitted."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from vaneloop.base.durations import within_no_period
from vaneloop.identification.least_squares.levenberg_marquardt import bounded_step
from vaneloop.identification.least_squares.problem import Fit, LeastSquaresProblem
from vaneloop.identification.selection.screening import Linearisation
from vaneloop.identification.settings import (
    MOST_CROOKED,
    PERIODS_OFF,
    PROBE_SIZE,
    PROMISE_KEPT,
    SCREEN_DAMPING,
    SCREEN_STEPS,
    SCREENED_BEND,
)
from vaneloop.identification.subsystem import Array, Effect
from vaneloop.identification.unmodelled.curve_candidates import Candidate
from vaneloop.identification.unmodelled.fitted_candidate import FittedCandidate, Placings, channel_of, stands, strange
from vaneloop.identification.unmodelled.problem import CurveProblem
from vaneloop.identification.unmodelled.spectral_lines import Course, Lines, periods_along
from vaneloop.identification.user_models.exogenous_regressors import TIME

__all__ = ["Step", "best_step", "screened", "smoothed", "starts_of"]

PROBE = "probe"
Promise = tuple[float, Candidate, Array]  # what a candidate would leave, and parameters to begin from
Starts = Sequence[tuple[Array, Linearisation]]


def screened(learner: CurveProblem, current: FittedCandidate, many: int, apart: float) -> tuple[float, list[Promise]]:
    """What a step of the model's own parameters leaves; and the ``many`` best candidates, and the best at each other
    place, best first.

    apart  by which times a lag is changed: those that are tried first are far apart
    """
    starts = starts_of(learner.judge_of((), current.curves, True), current.fit)
    bare = starts[0][1].left(starts[0][1].error)[0]
    every = [c for c in (*learner.candidates, *_periodic(learner, current)) if not stands(current, c)]
    steps = list(learner.each(lambda c: _promise(learner, current, c, starts), every))
    out = _straightened(learner, current, bare, steps, many)
    each = _one_lag(out)
    chosen = each[:many] if learner.ground.noise_known else [*each[:many], *_best_elsewhere(each[:many], each[many:])]
    first = learner.each(lambda one: _its_lag(learner, current, one, starts, apart), chosen)
    return bare, sorted(first, key=lambda o: o[0])


def _best_elsewhere(chosen: Sequence[Promise], others: Sequence[Promise]) -> list[Promise]:
    """The best of each place that none of the ``chosen`` is at: one step says which quantity suits a place, and less
    which of two places will do more, of which one is crooked and the other is not. And what is at each derivative
    itself, the plainest of all: how a store loses what it holds.
    """
    best: dict[tuple[str, str], Promise] = {}
    for one in (*chosen, *others):
        best.setdefault((one[1].how, one[1].at), one)
    have = {id(one) for one in chosen}
    more = [one for one in best.values() if id(one) not in have]
    return [*more, *(p for p in others if p[1].how == "state adds" and strange(p[1]) == 0 and p not in more)]


def _one_lag(promises: Iterable[Promise]) -> list[Promise]:
    """The first of several lags of a channel at one place, and the channel itself."""
    best: dict[tuple[str, str, str, bool], Promise] = {}
    for one in promises:
        c = one[1]
        best.setdefault((c.how, c.at, channel_of(c), channel_of(c) == c.quantity.name), one)
    return list(best.values())


def _straightened(
    learner: CurveProblem, current: FittedCandidate, bare: float, steps: Sequence[tuple[Promise, float]], many: int
) -> list[Promise]:
    """All candidates, best first; those fitted for some steps that one step does no justice. A tank's level goes with
    one over its outflow: where that is off by half, no step by slopes brings what its gain can.
    """
    out = sorted((p for p, _ in steps), key=lambda o: o[0])
    limit = out[min(many, len(out)) - 1][0] if out else 0.0
    poor = [(said, p) for p, said in steps if said < limit and bare - p[0] < PROMISE_KEPT * (bare - said)]
    chosen = _one_lag(p for _, p in sorted(poor, key=lambda o: o[0]))[:MOST_CROOKED]

    def fitted(p: Promise) -> Promise:
        begin = p[2] if p[0] < bare else np.append(current.fit.theta, np.zeros(len(p[2]) - len(current.fit.theta)))
        few = learner.fitted(current, p[1], SCREENED_BEND, begin, SCREEN_STEPS, True).fit
        return min(p, (float(few.cost.sum()), p[1], few.theta), key=lambda o: o[0])

    gone = {id(p) for p in chosen}
    return sorted([*learner.each(fitted, chosen), *(p for p in out if id(p) not in gone)], key=lambda o: o[0])


def _its_lag(learner: CurveProblem, current: FittedCandidate, one: Promise, starts: Starts, apart: float) -> Promise:
    """A candidate with the lag that promises most."""
    for factor in (apart, 1.0 / apart) if one[1].quantity.remembers else ():
        while (c := one[1].slower(factor)) is not None and not stands(current, c):
            other, _ = _promise(learner, current, c, starts)
            if other[0] >= one[0]:
                break
            one = other
    return one


def _periodic(learner: CurveProblem, current: FittedCandidate) -> list[Candidate]:
    """Every curve that may repeat itself, over time or along another channel, with the periods of the error; none where
    a shape is known.
    """
    over_time = [c for c in learner.candidates if c.quantity.name == TIME and not c.shape]
    if not over_time:
        return []
    courses = learner.ground.courses(current.curves, current.fit.theta)
    return [*_in_time(learner, current, over_time, courses), *_along(learner, courses)]


def _along(learner: CurveProblem, courses: Sequence[Course]) -> list[Candidate]:
    """Along a state, a motion or another signal, where the ground tells what the model says."""
    out: list[Candidate] = []
    found: dict[str, list[float]] = {}
    ends = np.cumsum([len(c.t) for c in courses])
    if not all(len(c.said) for c in courses):
        return out
    signals = [np.concatenate([c.drivers, c.said]) for c in courses]
    times, errors = [c.t for c in courses], [c.error for c in courses]
    for c in learner.candidates:
        q = c.quantity
        if strange(c) > 1 or q.less is not None or len(q.visited) != ends[-1] or not np.isfinite(q.visited).all():
            continue
        if q.name not in found:
            # a model that lacks a law has not come quite as far as its machine
            ways = [k.read.get(q.name, w) for k, w in zip(courses, np.split(q.visited, ends[:-1]), strict=True)]
            found[q.name] = periods_along(ways, times, errors, signals)
        out += [c.every(period) for period in found[q.name]]
    return out


def _in_time(
    learner: CurveProblem, current: FittedCandidate, over_time: Sequence[Candidate], courses: Sequence[Course]
) -> list[Candidate]:  # fmt: skip
    fit, ground = current.fit, learner.ground
    lines = Lines(courses)
    out, plain, fast = [], lines.found(), lines.fast()
    for c in over_time:
        periods = plain
        if c.how.endswith("times"):
            whole = replace(c, name=PROBE, mean=True, untold=())
            values = np.zeros(len(whole.kept))
            values[0] = PROBE_SIZE
            curves: Placings = (*current.curves, (whole.placed(), whole.effect(SCREENED_BEND)))
            moved = ground.courses(curves, np.concatenate([fit.theta, values]))
            periods = lines.found([m.error - w.error for m, w in zip(moved, courses, strict=True)])
            if not c.how.startswith("output"):
                periods += [p for p in fast if all(abs(p[0] / q[0] - 1.0) > 1e-3 for q in periods)]
        out += [c.every(*p) for p in periods]
    return out


def _promise(
    learner: CurveProblem, current: FittedCandidate, candidate: Candidate, starts: Starts
) -> tuple[Promise, float]:
    """What a candidate leaves, in the simulation, after one step by the slopes, as damped as suits it best, from where
    that leaves least; and what the slopes there say that it leaves.

    Far from the truth slopes say nothing of data left out: that is asked when the candidate has been fitted.
    """
    effect = candidate.effect(SCREENED_BEND)
    judge = learner.judge_of((), (*current.curves, (candidate.placed(), effect)), True)
    slips = candidate.quantity.stops  # fitted to the end whatever it promises, from the fit that it follows
    steps = [best_step(current.fit, effect, judge, *s, cut_off=slips) for s in (starts[:1] if slips else starts)]
    left, theta, promised = min(steps, key=lambda s: s.left)
    if candidate.quantity.period and within_no_period(candidate.quantity.name) != TIME:
        # along what the model simulates a wave shifts its own phase: one whole step may leave more than none
        begin = np.append(current.fit.theta, np.zeros(len(effect.parameters)))
        best = (left, candidate, theta)
        for (
            turns
        ) in PERIODS_OFF:  # nor is the model where it was, so that its period is not quite the one that was found
            c = candidate.slower(1.0 + turns * candidate.quantity.period / candidate.quantity.span) or candidate
            few = learner.fitted(current, c, SCREENED_BEND, begin, SCREEN_STEPS, True).fit
            best = min(best, (float(few.cost.sum()), c, few.theta), key=lambda o: o[0])
        return best, best[0]
    return (left, candidate, theta), promised


# ---- The first step that a candidate is ranked by: from the model's own parameters, by the slopes there, simulated


class Step(NamedTuple):
    """What the best step leaves, where it leads, and what the slopes say that the boldest step leaves."""

    left: float
    theta: Array
    promised: float


def starts_of(judge: LeastSquaresProblem, fit: Fit) -> list[tuple[Array, Linearisation]]:
    """Parameters from which a candidate's step is taken, with their slopes: those of the fit; and where what is missing
    has pulled one of the model's own to a bound, those that are nominal, too.

    Far from the truth a model without what it lacks is bent out of shape, and no step brings it back.

    judge  of the samples on which candidates are ranked
    """
    starts, own, nominal = [fit.theta], len(judge.stage.parameters), fit.theta.copy()
    nominal[:own] = judge.stage.neutral()[:own]
    free = fit.free[fit.free < own]
    room = [np.abs(b - fit.theta)[free] for b in judge.bounds()]
    if np.any(np.minimum(*room) <= 1e-6 * judge.scale[free]):
        starts.append(nominal)
    return [(theta, Linearisation(judge, theta, fit.free, fit.prior)) for theta in starts]


def best_step(
    fit: Fit, effect: Effect, judge: LeastSquaresProblem, begin: Array, slopes: Linearisation, cut_off: bool = False
) -> Step:
    """The best step from ``begin`` with ``effect``, the last of the judge's stage.

    cut_off  a step beyond bounds ends there; else what a bound stops, others take over
    """
    theta = np.concatenate([begin, np.zeros(len(effect.parameters))])
    own = np.arange(len(begin), len(theta))
    moved, derivative = judge.differences(theta, own, judge.scale[own], judge.bounds()[1], slopes.error)
    rows = np.concatenate([slopes.jac, derivative(judge.errors(moved))[1]])
    _, gradients, normals = judge.blocks(slopes.error, rows)
    free = np.concatenate([fit.free, own])
    scale = judge.scale[free]
    tolerance = np.array([p.tolerance for p in effect.parameters])
    prior = np.concatenate([fit.prior, 3.0 / tolerance**2]) * scale**2
    deviation = (theta - judge.stage.neutral())[free] / scale
    a, g = normals.sum(axis=0) + np.diag(prior + 1e-9), gradients.sum(axis=0) - prior * deviation
    trials, promised = np.repeat(theta[None], len(SCREEN_DAMPING), axis=0), np.inf
    here = float(judge.totals(slopes.error[None], theta[None])[0])
    low, high = judge.bounds()
    for row, damping in zip(trials, SCREEN_DAMPING, strict=True):
        stiff, room = a + damping * np.diag(np.diag(a)), [(b - theta)[free] / scale for b in (low, high)]
        step = np.linalg.solve(stiff, g)
        if not cut_off and np.any((step < room[0]) | (step > room[1])):
            step = bounded_step(stiff, g, *room)
        row[free] = np.clip(row[free] + step * scale, low[free], high[free])
        gone = (row[free] - theta[free]) / scale
        promised = min(promised, here - 2.0 * float(g @ gone) + float(gone @ a @ gone))
    left = judge.totals(judge.errors(trials), trials)
    k = int(np.argmin(left))
    return Step(float(left[k]), trials[k], promised)


# ---- How much a curve or a surface may bend: as much as its held-out error says


def smoothed(
    learner: CurveProblem, current: FittedCandidate, candidate: Candidate, begin: Array | Fit, wiggles: Sequence[float],
    first: float = SCREENED_BEND,
) -> FittedCandidate:  # fmt: skip
    """A candidate fitted to the end, as smooth as suits it best: from the ``first`` of ``wiggles`` smoother, else less
    so, while that helps, each from where the last one ended.
    """
    best, at = learner.fitted(current, candidate, first, begin, 12), wiggles.index(first)
    for others in (wiggles[:at][::-1], wiggles[at + 1 :]):
        for wiggle in others if best.wiggle == first else ():
            more = learner.fitted(current, candidate, wiggle, best.fit, 12)
            if learner.score(more) >= learner.score(best):
                break
            best = more
    return best
