"""Effects that begin within a log, at a time that nobody knows.

The time is a parameter of a stage, ``onset``, which no fit sets free: before it the stage runs with every effect at its
neutral size, from it on with the effects. Errors do not depend on it smoothly, so that it is found as a change point:
up to where the model without effects stands at the noise (`quiet_until`), then as the time at which the sum of squares
of a model with effects is least (`change_point`). Its interval: B. E. Hansen, Econometrica 68 (2000) 575-603, sample
splitting and threshold estimation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import wraps
from typing import TypeVar

import numpy as np

from vaneloop.identification.least_squares.problem import Fit, LeastSquaresProblem
from vaneloop.identification.settings import MAX_SETS, NINETY_ONSET, ONSET_BLOCKS
from vaneloop.identification.subsystem import Array, Parameter, Stage

__all__ = ["Onset", "begun", "change_point", "onset_of", "quiet_until", "that_begins"]

NAME = "onset"

Driven = TypeVar("Driven")
Run = Callable[[Array], Array]


@dataclass(frozen=True)
class Onset:
    """Time from which effects act, with its 90 % interval: s of the stage's own time."""

    value: float
    low: float
    high: float


def that_begins(make: Callable[[Driven], Stage]) -> Callable[[Driven], Stage]:
    """A maker of stages whose effects may begin at a time: one more parameter, the last of the stage's own."""

    @wraps(make)
    def made(driven: Driven) -> Stage:
        stage = make(driven)
        column, neutral, t = len(stage.parameters), stage.neutral(), stage.t

        def of(theta: Array) -> Array:
            return np.delete(theta, column, axis=-1)

        def begins(run: Run) -> Run:
            def with_onset(thetas: Array) -> Array:
                own = of(thetas)
                out = run(own)
                late = np.flatnonzero(thetas[:, column] > t[0])
                if len(late):
                    own[:, column:] = neutral[column:]
                    without, which = np.unique(own[late], axis=0, return_inverse=True)
                    before = run(without)
                    for i, j in zip(late, which.ravel(), strict=True):
                        _begin(stage, out[i], before[j], float(thetas[i, column]))
                return out

            return with_onset

        stage.parameters = (*stage.parameters, Parameter(NAME, 0.0, "s"))
        stage.run = begins(stage.run)
        if stage.finer is not None:
            stage.finer = begins(stage.finer)
        if stage.hidden is not None:
            hidden = stage.hidden
            stage.hidden = lambda theta: hidden(of(theta))
        stage.twins = {name: (cause, begins(run)) for name, (cause, run) in stage.twins.items()}
        return stage

    return made


def _begin(stage: Stage, out: Array, before: Array, onset: float) -> None:
    """Let ``out`` be ``before`` until the onset; each float64[outputs, samples].

    The window of a stage that integrates ends at the onset, and another begins: where a reading jumps and where it goes
    on is free. Both parts get the same mean error, which is then taken off as the window's constant.
    """
    k = int(np.searchsorted(stage.t, onset))
    if stage.window and k < len(stage.t):
        number = np.floor((stage.t[k] - stage.t[0]) / stage.window + 1e-9)
        first, end = np.searchsorted(stage.t, stage.t[0] + (number + np.arange(2)) * stage.window - 1e-9)
        for m, x, y in zip(stage.measured, out, before, strict=True):
            behind, ahead = (e[np.isfinite(e)] for e in (m[first:k] - y[first:k], m[k:end] - x[k:end]))
            if len(behind) and len(ahead):
                x[k:end] += ahead.mean() - behind.mean()
    out[:, :k] = before[:, :k]


def _column(stage: Stage) -> int | None:
    """Which of the stage's parameters its onset is; None: its effects cannot begin."""
    return next((i for i, p in enumerate(stage.parameters) if p.name == NAME), None)


def begun(stage: Stage, onset: float | None) -> Stage:
    """The same stage, whose effects act from ``onset`` (s) on; None: all along. A fit leaves what it does not set free
    at the stage's values.
    """
    if onset is None:
        return stage
    parameters = tuple(replace(p, value=onset) if p.name == NAME else p for p in stage.parameters)
    return replace(stage, parameters=parameters)


def onset_of(stage: Stage, theta: Array) -> float | None:
    """From when on the effects of these parameters act (s); None: all along."""
    column = _column(stage)
    if column is None or theta[column] <= stage.t[0]:
        return None
    return float(theta[column])


def quiet_until(judge: LeastSquaresProblem, fails: Callable[[LeastSquaresProblem, Fit], bool]) -> float | None:
    """Beginning (s) of the block of the log in which the model without effects begins to fail, its nominal parameters
    fitted to what comes before; None: it fails from the start, or in the last blocks alone, or the stage's effects
    cannot begin.

    fails  whether a fit leaves more than noise of the samples that a problem counts
    """
    stage = judge.stage
    if _column(stage) is None:
        return None
    edges = np.append(stage.t[judge.block_start], np.inf)

    def fails_before(k: int) -> bool:
        part = LeastSquaresProblem(stage, judge.floor, judge.valid & (stage.t < edges[k]))
        return part.n > 0 and fails(part, part.fit((), stage.neutral(), 6))

    quiet, failing = ONSET_BLOCKS, len(edges) - 1
    if failing - quiet < ONSET_BLOCKS or fails_before(quiet):
        return None
    while failing - quiet > 1:
        k = (quiet + failing) // 2
        quiet, failing = (quiet, k) if fails_before(k) else (k, failing)
    return float(edges[quiet]) if failing + ONSET_BLOCKS <= len(edges) else None


def change_point(judge: LeastSquaresProblem, fit: Fit, correlation: float) -> Onset:
    """The onset with which the parameters of ``fit`` leave the least sum of squares, half-way between two samples, and
    its 90 % interval: all onsets that leave no more than `NINETY_ONSET` beyond it.

    Before the onset the squares are those without effects, behind it those with them. In a window that an onset lies in
    they are others: the onset is sought at the beginnings of windows, and then sample by sample in the windows next to
    the best.

    correlation  samples of the error that count as one observation
    """
    stage, column = judge.stage, _column(judge.stage)
    t, n = stage.t, len(stage.t)

    def squares(onsets: Array) -> Array:
        """float64[onsets, samples]"""
        thetas = np.repeat(fit.theta[None], len(onsets), axis=0)
        thetas[:, column] = onsets
        return np.asarray(np.sum(judge.errors(thetas) ** 2, axis=1))

    without, with_them = squares(np.array([t[-1] + 1.0, t[0]]))
    left = np.cumsum(without)[:-1] + np.cumsum(with_them[::-1])[-2::-1]  # of an onset before sample 1, 2, ...
    times = 0.5 * (t[1:] + t[:-1])
    known = np.arange(n - 1)
    if judge.window_start is not None:
        begins = judge.window_start[judge.window_start > 0] - 1
        k = int(np.argmin(left[begins]))
        near = np.arange(begins[max(k - 1, 0)], begins[min(k + 1, len(begins) - 1)] + 1)
        left[near] = np.concatenate(
            [squares(x).sum(axis=1) for x in np.array_split(times[near], 1 + len(near) // MAX_SETS)]
        )
        known = np.union1d(begins, near)
    best = known[np.argmin(left[known])]
    inside = known[left[known] <= left[best] + NINETY_ONSET * correlation]
    # an onset before sample k lies behind sample k - 1; the interval ends at the next onset that is ruled out
    low = known[known < inside[0]].max(initial=-1) + 1
    high = known[known > inside[-1]].min(initial=n - 1)
    return Onset(float(times[best]), float(t[low]), float(t[high]))
