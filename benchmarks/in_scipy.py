"""The search of one stage beside `scipy.optimize.least_squares`, one parameter set after the other, on the same
compiled stage.

The peer does the same work: the same starts are screened, and every fit that the search made is made again, from the
same start, with the same difference steps, scales, bounds and prior, and at most as many iterations. Its linear algebra
runs in one thread: in two, which wait for each other on tall matrices of five columns, it took twice to three times as
long on a machine that did other work.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from threadpoolctl import threadpool_limits

from vaneloop.identification.least_squares import problem as fitting
from vaneloop.identification.least_squares.levenberg_marquardt import NOT_KNOWN
from vaneloop.identification.least_squares.problem import Fit, LeastSquaresProblem
from vaneloop.identification.selection.diagnosis import diagnose_stage
from vaneloop.identification.selection.search import Search
from vaneloop.identification.settings import DIFFERENCE
from vaneloop.identification.subsystem import Stage

__all__ = ["in_scipy", "ours"]

Job = tuple[LeastSquaresProblem, tuple[str, ...], np.ndarray, int]


@contextmanager
def _recorded() -> Iterator[list[Any]]:
    """Every fit and every screening that is made inside, in a list."""
    jobs: list[Any] = []
    fit, screen = fitting.LeastSquaresProblem.fitting, Search._screen

    def note_fit(
        self: LeastSquaresProblem, effects: tuple[str, ...], start: Any, iterations: int = 12, slopes: Any = NOT_KNOWN
    ) -> Any:
        jobs.append((self, effects, np.array(start.theta if isinstance(start, Fit) else start), iterations))
        return fit(self, effects, start, iterations, slopes)

    def note_screen(self: Search) -> Any:
        jobs.append(self)
        return screen(self)

    fitting.LeastSquaresProblem.fitting, Search._screen = note_fit, note_screen  # type: ignore[method-assign]
    try:
        yield jobs
    finally:
        fitting.LeastSquaresProblem.fitting, Search._screen = fit, screen  # type: ignore[method-assign]


def ours(stage: Stage) -> tuple[float, float, list[Any], list[float]]:
    """Search the stage: wall seconds, processor seconds, what was done, and the cost of the nominal model and of the
    best.
    """
    assert stage.floor is not None
    started, busy = time.perf_counter(), time.process_time()
    diagnose_stage(stage, stage.floor)
    elapsed, busy = time.perf_counter() - started, time.process_time() - busy
    with _recorded() as jobs:
        said = diagnose_stage(stage, stage.floor)
    return elapsed, busy, jobs, [float(said.base.cost.sum()), float(said.final.cost.sum())]


@threadpool_limits.wrap(limits=1)
def in_scipy(stage: Stage, jobs: list[Any]) -> tuple[float, float, int, list[float]]:
    """Do the same one after the other: wall seconds, processor seconds, fits made, highest and lowest cost
    among them.
    """
    nominal = stage.neutral()
    tolerance = np.array([p.tolerance for p in stage.all_parameters()])
    costs, fits = [], 0
    started, busy = time.perf_counter(), time.process_time()
    for job in jobs:
        if isinstance(job, Search):
            for e in stage.effects:
                for s in e.starts:
                    theta = job.base.theta.copy()
                    theta[stage.index()[e.name]] = s
                    job.judge.block_costs(job.judge.errors(theta[None]))
            continue
        judge, effects, start, iterations = job
        free = judge.columns(effects)
        low, high = (b[free] for b in judge.bounds())
        pull = np.array([np.sqrt(3.0) / tolerance[c] if c < len(stage.parameters) else 0.0 for c in free])

        def residuals(
            z: np.ndarray,
            judge: LeastSquaresProblem = judge,
            start: np.ndarray = start,
            free: Any = free,
            pull: Any = pull,
        ) -> np.ndarray:
            theta = start.copy()
            theta[free] = z
            return np.concatenate([judge.errors(theta[None])[0].ravel(), pull * (z - nominal[free])])

        inside = np.clip(start[free], np.nextafter(low, np.inf), np.nextafter(high, -np.inf))
        step = DIFFERENCE * judge.scale[free] / np.maximum(np.abs(inside), 1e-12)  # relative, as scipy wants it
        found = least_squares(
            residuals,
            inside,
            bounds=(low, high),
            x_scale=judge.scale[free],
            diff_step=step,
            max_nfev=iterations + 1,
            ftol=1e-5,
        )
        costs.append(2.0 * found.cost)
        fits += 1
    return time.perf_counter() - started, time.process_time() - busy, fits, [max(costs), min(costs)]
