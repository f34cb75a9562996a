"""Effects that begin within a log, at a time that nobody knows.

The time is a parameter of a stage, ``onset``, which no fit sets free: before it the stage runs with every effect at its
neutral size, from it on with the effects. Errors do not depend on it smoothly, so that it is found as a change point:
up to where the model without effects stands at the noise (`quiet_until`), then as the time at which the sum of squares
of a model with effects is least (`change_point`). Killick, Fearnhead, Eckley (2012), optimal detection of changepoints
with a linear computational cost.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import wraps
from typing import TypeVar

import numpy as np

from vaneloop.identification.least_squares.problem import Fit, LeastSquaresProblem
from vaneloop.identification.settings import NINETY, ONSET_BLOCKS
from vaneloop.identification.subsystem import Array, Parameter, Stage

__all__ = ["Onset", "beginning_at", "begun", "change_point", "onset_of", "quiet_until", "that_begins"]

NAME = "onset"
GRID = 33  # times that are tried at once: of each pass, the two intervals next to the best are the next pass's range

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

    A stage that integrates goes on from where it stood: to the end of the window that the onset lies in, its output is
    moved by what the effects would have made of the window's beginning.
    """
    k = int(np.searchsorted(stage.t, onset))
    if stage.window and k < len(stage.t):
        number = np.floor((stage.t[k] - stage.t[0]) / stage.window + 1e-9)
        end = int(np.searchsorted(stage.t, stage.t[0] + (number + 1.0) * stage.window - 1e-9))
        out[:, k:end] += (before[:, k] - out[:, k])[:, None]
    out[:, :k] = before[:, :k]


def _column(stage: Stage) -> int | None:
    """Which of the stage's parameters its onset is; None: its effects cannot begin."""
    return next((i for i, p in enumerate(stage.parameters) if p.name == NAME), None)


def begun(stage: Stage, onset: float) -> Stage:
    """The same stage, whose effects act from ``onset`` (s) on."""
    parameters = tuple(replace(p, value=onset) if p.name == NAME else p for p in stage.parameters)
    return replace(stage, parameters=parameters)


def onset_of(stage: Stage, theta: Array) -> float | None:
    """From when on the effects of these parameters act (s); None: all along."""
    column = _column(stage)
    if column is None or theta[column] <= stage.t[0]:
        return None
    return float(theta[column])


def beginning_at(stage: Stage, theta: Array, onset: float | None) -> Array:
    """The same parameters with effects that act from ``onset`` (s) on; None, or a stage whose effects cannot begin: as
    they are.
    """
    column = _column(stage)
    if onset is None or column is None:
        return theta
    out = theta.copy()
    out[column] = onset
    return out


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
    """The onset with which the parameters of ``fit`` leave the least sum of squares, and its 90 % interval.

    correlation  samples of the error that count as one observation
    """
    column = _column(judge.stage)
    assert column is not None
    tried: dict[float, float] = {}

    def costs(times: Array) -> None:
        new = [float(t) for t in times if float(t) not in tried]
        thetas = np.repeat(fit.theta[None], len(new), axis=0)
        thetas[:, column] = new
        for i in range(0, len(new), GRID):
            squares = judge.block_costs(judge.errors(thetas[i : i + GRID])).sum(axis=1)
            tried.update(zip(new[i : i + GRID], squares.tolist(), strict=True))

    t = judge.stage.t
    low, high, finest = float(t[0]), float(t[-1]), float(np.median(np.diff(t)))
    while True:
        costs(np.linspace(low, high, GRID))
        best = min(tried, key=lambda at: tried[at])
        step = (high - low) / (GRID - 1)
        if step <= finest:
            break
        low, high = max(best - step, float(t[0])), min(best + step, float(t[-1]))
    away = finest * np.geomspace(1.0, (t[-1] - t[0]) / finest, GRID)
    costs(np.clip(np.concatenate([best - away, best + away]), t[0], t[-1]))
    near = [at for at, squares in tried.items() if squares <= tried[best] + NINETY**2 * correlation]
    beyond = np.array(sorted(at for at in tried if at not in near))
    # as far as the nearest time on each side that the log rules out
    low, high = beyond[beyond < best].max(initial=t[0]), beyond[beyond > best].min(initial=t[-1])
    return Onset(best, float(low), float(high))
