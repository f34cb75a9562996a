"""The steps of a fit: Levenberg-Marquardt with bounds, three dampings at a time.

Slopes are simulated, a parameter set for each free parameter, or carried on from the last step, which then costs the
three trials alone. They are simulated anew where such a step brings much less than they promised, or less for its cost
than the last step by simulated ones; and a descent does not end before simulated slopes say so.

A step d of the free parameters changes the errors from e to e'. The slopes J, by which they should have changed by
-J d, are off by w = e' - e + J d; so J is changed as little as makes it say what this step did (Broyden 1965):

    J' = J - v w,   v = M d / (d M d)

M, the diagonal of the normal matrix, measures a parameter by what it does to the errors, so that units do not matter.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from typing import NamedTuple, Protocol

import numpy as np

from vaneloop.identification.settings import (
    CARRIED_STEP,
    CARRIED_VALUES,
    DAMPING_TIMES,
    EVIDENCE,
    KEPT_SLOPES,
    LEAST_STEP_FALL,
    MOST_DAMPED,
    PROMISE_KEPT,
)
from vaneloop.identification.subsystem import Array, Stage

__all__ = [
    "NOT_KNOWN", "Begin", "BroydenJacobian", "End", "Known", "LatestSlopes", "bounded_step", "carries",
    "levenberg_marquardt",
]  # fmt: skip


class Known(NamedTuple):
    """Minus derivatives of the errors by parameters in their scales: of these columns of theta, a row each."""

    columns: Array
    rows: Array

    def fits(self, size: int) -> bool:
        """Whether any are known, and of so many errors."""
        return len(self.columns) > 0 and self.rows.size == len(self.columns) * size


NOT_KNOWN = Known(np.zeros(0, dtype=int), np.zeros((0, 0)))


class BroydenJacobian:
    """Errors and minus their slopes at one place of a descent; their gradient and normal matrix.

    error   whitened, float64[outputs, samples]
    slopes  minus the derivative by each free parameter in its scale, float64[free, outputs, samples]
    """

    def __init__(self, error: Array, slopes: Array):
        """Begin with slopes that were simulated at ``error``."""
        self.error, self.slopes = error.ravel(), slopes.reshape(len(slopes), error.size)
        self.normal = self.slopes @ self.slopes.T

    @property
    def gradient(self) -> Array:
        """What a step gains first, by each parameter: half the fall of the sum of squares."""
        return np.asarray(self.slopes @ self.error)

    def moved(self, step: Array, error: Array) -> None:
        """Note that a ``step`` of the free parameters, in their scales, has led to this ``error``."""
        way = np.diag(self.normal) * step
        size = float(way @ step)
        if size > 0.0:
            way /= size
            off = error.ravel() - self.error + step @ self.slopes
            across = self.slopes @ off
            both = np.outer(way, across)
            self.normal += float(off @ off) * np.outer(way, way) - both - both.T
            self.slopes -= np.outer(way, off)
        self.error = error.ravel().copy()


class LatestSlopes:
    """Errors and slopes where fits have ended last, which may be gone on with."""

    def __init__(self) -> None:
        self._kept: dict[tuple[bytes, bytes], tuple[Array, Array]] = {}

    def put(self, theta: Array, free: Array, error: Array, slopes: Array) -> None:
        """Keep these; the oldest go."""
        self._kept[theta.tobytes(), free.tobytes()] = error, slopes
        while sum(rows.size for _, rows in self._kept.values()) > KEPT_SLOPES:
            del self._kept[next(iter(self._kept))]

    def get(self, theta: Array, free: Array) -> tuple[Array, Array] | None:
        """Copies of error and slopes; None where they are not kept."""
        found = self._kept.get((theta.tobytes(), free.tobytes()))
        return (found[0], found[1].copy()) if found else None

    def of(self, theta: Array, free: Array, before: float = np.inf) -> Known:
        """The slopes by those free parameters that stand before a column, where they are kept."""
        found = self._kept.get((theta.tobytes(), free.tobytes()))
        return Known(free[free < before], found[1][free < before]) if found else NOT_KNOWN


def bounded_step(a: Array, g: Array, low: Array, high: Array) -> Array:
    """The step that minimises step a step / 2 - g step within bounds, near enough: what runs into one stops, the rest
    is solved again.

    A step that is only cut off at the bounds is no descent where parameters can stand in for each other.
    """
    step = np.zeros(len(g))
    moves = np.ones(len(g), dtype=bool)
    for _ in range(len(g)):
        if moves.all():
            step = np.linalg.solve(a, g)
        else:
            step[moves] = np.linalg.solve(a[np.ix_(moves, moves)], g[moves] - a[np.ix_(moves, ~moves)] @ step[~moves])
        beyond = moves & ((step < low) | (step > high))
        if not beyond.any():
            break
        step[beyond] = np.clip(step[beyond], low[beyond], high[beyond])
        moves &= ~beyond
        if not moves.any():
            break
    return step


Linear = tuple[Array, Array, Array]  # costs, gradients and normals of the blocks


class Begin(NamedTuple):
    """Where a descent begins.

    linear  costs, gradients and normals of the blocks there, where they are known; then ``slopes`` may be errors and
            slopes at the very place
    near    slopes near there, as far as they are known
    """

    theta: Array
    linear: Linear | None = None
    slopes: tuple[Array, Array] | None = None
    near: Known = NOT_KNOWN


class End(NamedTuple):
    """Where a descent has come to.

    total   what it minimises there
    errors  whitened errors there; ``linear``: costs, gradients and normals of the blocks; None: they are not known
    near    slopes near there, as far as they are known
    """

    theta: Array
    total: float
    free: Array
    prior: Array
    errors: Array | None
    linear: Linear | None
    stalled: bool
    near: Known


class Problem(Protocol):
    """What a descent asks of a `identification.least_squares.problem.LeastSquaresProblem`.

    stage     the subsystem; ``measured``: its outputs; ``n``: samples that count, in ``n_blocks`` blocks
    prior     weight of each column's squared distance from its expected value; ``scale``: its usual change
    roughly, sparing  when a fit may end early
    """

    stage: Stage
    measured: Array
    n: int
    n_blocks: int
    prior: Array
    scale: Array
    roughly: bool
    sparing: bool

    def bounds(self) -> tuple[Array, Array]:
        """Lowest and highest value of every column."""

    def wrapped(self, theta: Array) -> Array:
        """The same parameters, those that repeat themselves within one turn."""

    def block_costs(self, e: Array) -> Array:
        """Sum of squares per block: float64[sets, blocks]."""

    def blocks(self, error: Array, jac: Array) -> Linear:
        """Costs, gradients and normals of the blocks."""

    def begun(self, theta: Array, free: Array, slopes: Known) -> tuple[Array, Callable[[Array], tuple[Array, Array]]]:
        """Parameter sets to simulate beside slopes that are known near ``theta``, and what turns their errors into all
        slopes.
        """

    def differences(
        self, theta: Array, free: Array, scale: Array, high: Array, known: Array | None = None
    ) -> tuple[Array, Callable[[Array], tuple[Array, Array]]]:
        """Parameter sets of difference steps, and what turns their errors into the error at ``theta`` and slopes;
        ``known``: errors at ``theta``, if they are.
        """


def carries(problem: Problem, free: Array) -> bool:
    """Whether slopes by these columns are carried along: a stage may not want that, and they may be too many."""
    return problem.stage.carries and len(free) * problem.measured.size <= CARRIED_VALUES


def levenberg_marquardt(problem: Problem, free: Array, begin: Begin, iterations: int) -> Generator[Array, Array, End]:
    """The steps of a `identification.least_squares.problem.LeastSquaresProblem.fitting` in these columns."""
    low, high = problem.bounds()
    theta, linear = problem.wrapped(np.clip(begin.theta, low, high)), begin.linear
    expected, prior, scale = problem.stage.expected(), problem.prior[free], problem.scale[free]
    every = np.ones(problem.n_blocks)  # sums over the blocks are products with it

    def total(cost: Array, thetas: Array) -> Array:
        return cost @ every + np.sum(prior * (thetas[:, free] - expected[free]) ** 2, axis=1)

    may_carry = carries(problem, free)
    carried = BroydenJacobian(*begin.slopes) if begin.slopes is not None and may_carry else None
    fresh = True  # whether the next step goes by slopes that are simulated
    damping, stalled, here, lately = 1e-3, False, np.inf, 0.0
    known: Array | None = None  # errors at theta
    if linear is None and may_carry and iterations and begin.near.fits(problem.measured.size):
        asked, all_slopes = problem.begun(theta, free, begin.near)
        known, slopes = all_slopes((yield asked))
        carried, fresh = BroydenJacobian(known, slopes), False
        here = float(total(problem.block_costs(known[None]), theta[None])[0])
    left, carried_step = (
        float(iterations),
        max(CARRIED_STEP, len(DAMPING_TIMES) / (len(DAMPING_TIMES) + max(len(free), 1))),
    )
    first = ahead = True  # whether no step was made; whether the last was made by simulated slopes
    while left > 1e-9:
        left -= 1.0 if fresh else carried_step
        if fresh and linear is None:
            asked, derivative = problem.differences(theta, free, scale, high, known)
            error, slopes = derivative((yield asked))
            linear = problem.blocks(error, slopes)
            carried = BroydenJacobian(error, slopes) if may_carry else None
        if linear is not None:
            here = float(total(linear[0][None], theta[None])[0])
            a, g = np.tensordot(every, linear[2], 1), every @ linear[1]
        else:
            assert carried is not None
            a, g = carried.normal, carried.gradient
        if len(free) == 0:
            break
        little = 0.2 * len(free)
        if problem.roughly:
            little *= 1.0 + max(here - problem.n, 0.0) / EVIDENCE
        least = max(little, LEAST_STEP_FALL * (here - problem.n)) if problem.sparing else little
        a, g = a + np.diag(prior * scale**2), g - prior * scale * (theta[free] - expected[free])
        limits = [(b[free] - theta[free]) / scale for b in (low, high)]
        if (problem.roughly and not first) or (fresh and not ahead):
            step = bounded_step(a + 1e-9 * np.diag(np.maximum(np.diag(a), 1e-9)), g, *limits)
            if _promised(step, a, g) < (little if ahead else least):  # not even the slope promises more
                if fresh:
                    break
                fresh = True
                continue
        first, ahead = False, fresh
        for _ in range(MOST_DAMPED if fresh else 1):
            trials, steps = [], []
            for factor in DAMPING_TIMES:
                damped = a + damping * factor * np.diag(np.maximum(np.diag(a), 1e-9))
                step = bounded_step(damped, g, *limits)
                trial = theta.copy()
                trial[free] = np.clip(theta[free] + step * scale, low[free], high[free])
                steps.append((trial[free] - theta[free]) / scale)
                trials.append(problem.wrapped(trial))
            thetas = np.array(trials)
            errors = yield thetas
            costs = total(problem.block_costs(errors), thetas)
            k = int(np.argmin(costs))
            # the last step is the shortest: where even it promises much and nothing came of it, the slope is not to be
            # trusted so far away
            stalled = fresh and not costs[k] < here and _promised(step, a, g) > little
            if not stalled:
                break
            damping *= 1e5
        gained = here - float(costs[k])
        if gained > 0.0:
            damping, theta, known, linear = max(damping * DAMPING_TIMES[k], 1e-9), thetas[k], errors[k].copy(), None
            here = float(costs[k])
        if not gained > 0.0 or gained < least:
            if fresh:
                break
            fresh = True  # the slopes that were carried here may be wrong
            continue
        if fresh:
            lately = gained * len(DAMPING_TIMES) / (len(DAMPING_TIMES) + len(free))
        keep = carried is not None and gained > max(PROMISE_KEPT * _promised(steps[k], a, g), lately)
        if keep and carried is not None and known is not None:
            carried.moved(steps[k], known)
        fresh = not keep
    near = Known(free, carried.slopes) if carried is not None else NOT_KNOWN
    return End(theta, here, free, prior, known, linear, stalled, near)


def _promised(step: Array, a: Array, g: Array) -> float:
    """How much less a step leaves by its normal equations."""
    return 2.0 * float(step @ g) - float(step @ a @ step)
