"""Fit a stage's parameters to its log, and judge a fit on data that it has not seen.

Errors are divided by the noise floor and, where a stage integrates, freed of one constant per window. The fit is
Levenberg-Marquardt with bounds; all difference steps and all damping trials of an iteration are one call of the stage's
``run`` (many parameter sets side by side). Nominal parameters carry a prior of the width of their tolerance.

The log is cut into blocks. Leaving one block out changes the least-squares solution by a step that follows from the
blocks' normal equations, so the held-out error of every block costs no further simulation (exact for a linear model,
first order otherwise).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, TypeVar

import numpy as np

from vaneloop.identification.least_squares.levenberg_marquardt import (
    NOT_KNOWN,
    Begin,
    End,
    Known,
    LatestSlopes,
    carries,
    levenberg_marquardt,
)
from vaneloop.identification.least_squares.residuals import ResidualCache, normalise_residuals, whiten_unlogged
from vaneloop.identification.settings import (
    DIFFERENCE,
    EVIDENCE,
    LEAST_STEP_FALL,
    MAX_SETS,
    MAX_VALUES,
    MIN_BLOCKS,
    MOST_BLOCKS,
    NINETY,
    USUAL_BLOCKS,
)
from vaneloop.identification.subsystem import Array, Stage, StageError

__all__ = ["Fit", "LeastSquaresProblem", "Task", "covariance", "recalibrate", "to_the_end"]

Answer = TypeVar("Answer")
Task = Generator[
    Array, Array, Answer
]  # yields parameter sets [sets, parameters], gets whitened errors [sets, outputs, samples]

Moves = tuple[int | None, int | None]  # the only output and the only log that a parameter moves; None: all


@dataclass(eq=False)
class Fit:
    """Parameters fitted with some effects present.

    effects   names of the effects set free
    theta     float64[all parameters]
    free      columns of theta that were fitted
    cost      whitened sum of squares of every block, float64[blocks], with the parameters fitted to all blocks
    held_out  the same with the parameters fitted to the other blocks
    low, high 90 % interval of each free parameter; of one that repeats itself it may reach beyond the turn that the
    value is in
    stalled   no step along the slope, however short, brought what the slope promises: it stands at a kink
    near      where its slopes may still be found
    """

    effects: tuple[str, ...]
    theta: Array
    free: Array
    cost: Array
    held_out: Array
    gradients: Array
    normals: Array
    prior: Array
    low: Array
    high: Array
    stalled: bool = False
    near: LatestSlopes | None = None


class Led(NamedTuple):
    """Where the first steps of a fit lead: what it has minimised there, parameters, and slopes near them."""

    total: float
    theta: Array
    slopes: Known


class LeastSquaresProblem:
    """Everything that fits of one stage share: whitening, windows, blocks, base fit."""

    def __init__(self, stage: Stage, floor: Array, keep: Array | None = None):
        """Prepare ``stage`` with noise ``floor`` (one per output); ``keep``: samples that count (default: all measured
        ones).
        """
        self.stage, self.floor, self._latest, self.keep = stage, np.asarray(floor, dtype=float), ResidualCache(), keep
        self._near = LatestSlopes()
        self.spared: set[int] = set()  # columns of nominal parameters that stay where they are
        self.roughly = False  # a fit that leaves more than noise ends when it gains less than `EVIDENCE` can tell
        self.sparing = (
            False  # one ends when a step takes off less than `LEAST_STEP_FALL` of what it leaves beyond noise
        )
        self.valid = np.isfinite(stage.measured)
        if keep is not None:
            self.valid &= keep
        self.measured = np.where(self.valid, stage.measured, 0.0)
        t = stage.t
        span = t[-1] - t[0]
        if stage.window:
            w = np.minimum(((t - t[0]) / stage.window + 1e-9).astype(int), max(int(span / stage.window + 1e-9) - 1, 0))
        else:
            w = None
        self.memory = stage.memory or span / USUAL_BLOCKS  # s, the stage's own time scale
        blocks = int(np.clip(span / self.memory, MIN_BLOCKS, MOST_BLOCKS))
        if w is not None:
            per = max(1, round((w[-1] + 1) / blocks))
            block_of = w // per
            self.window_start: Array | None = np.flatnonzero(np.diff(w, prepend=-1))
        else:
            block_of = np.minimum(((t - t[0]) / span * blocks).astype(int), blocks - 1)
            self.window_start = None
        self.block_start = np.flatnonzero(np.diff(block_of, prepend=-1))
        self.n_blocks = len(self.block_start)
        self.samples = np.add.reduceat(self.valid.sum(axis=0), self.block_start)
        self.n = int(self.samples.sum())
        self.scale = self._scales()
        names = stage.outputs  # what each parameter moves: the only output, the only log
        self._moves = [(names.index(p.output) if p.output in names else None, p.log) for p in stage.all_parameters()]
        self._shared: dict[bytes, tuple[Array, int]] = {}  # of columns: see `_sharing`
        width = np.array([p.tolerance for p in stage.all_parameters()])
        # a tolerance is the half-width of a uniform interval; its standard deviation is a 1/sqrt(3) of it
        self.prior = np.where(width > 0.0, 3.0 / np.where(width > 0.0, width, 1.0) ** 2, 0.0)
        self._bounds = self._limits()
        self._turning = [c for c, p in enumerate(stage.all_parameters()) if p.period > 0.0]
        self._counted = self.valid.astype(float)
        self._unlogged: list[Array] = []  # responses to inputs that nobody logged, each whitened by those before it
        for response in () if stage.unlogged is None or not stage.window else stage.unlogged:
            if np.any(response):
                self._unlogged.append(self._whiten(self.measured - response[None])[0])

    def _scales(self) -> Array:
        """Size of a usual change of each parameter, for difference steps and damping."""
        s = self.stage
        out = [p.tolerance or abs(p.value) or 1.0 for p in s.parameters]
        for e in s.effects:
            starts = np.array(e.starts, dtype=float)
            for i, p in enumerate(e.parameters):
                away = np.abs(starts[:, i] - p.value)
                away = away[away > 0]
                out.append(float(np.median(away)) if len(away) else abs(p.value) or 1.0)
        return np.array([p.scale or v for p, v in zip(s.all_parameters(), out, strict=True)])

    @cached_property
    def block_of(self) -> Array:
        """Number of the block that each sample is in, int64[samples]."""
        return np.repeat(np.arange(self.n_blocks), np.diff(self.block_start, append=len(self.stage.t)))

    @property
    def nominal(self) -> list[int]:
        """Columns of the nominal parameters that are not exactly known."""
        return [i for i, p in enumerate(self.stage.parameters) if p.tolerance > 0.0]

    def nominal_slopes(self, theta: Array) -> tuple[Array, Array]:
        """Errors at ``theta``, float64[outputs, samples], and their slopes by each of the `nominal` parameters,
        float64[parameters, outputs, samples]: over a twentieth of its tolerance.
        """
        free = self.nominal
        sizes = np.array([0.05 * self.stage.parameters[i].tolerance for i in free])
        tries = np.repeat(theta[None], len(free) + 1, axis=0)
        tries[np.arange(1, len(free) + 1), free] += sizes
        e = self.errors(tries)
        return e[0], (e[1:] - e[0]) / sizes[:, None, None]

    def errors(self, thetas: Array) -> Array:
        """Whitened errors float64[sets, outputs, samples], measured minus model; 0 where nothing was measured."""
        return self._latest.errors(np.atleast_2d(thetas), self._simulated)

    def _simulated(self, thetas: Array) -> Array:
        out = np.empty((len(thetas), *self.measured.shape))
        for i in range(0, len(thetas), MAX_SETS):
            self._whiten(self.stage.run(thetas[i : i + MAX_SETS]), out[i : i + MAX_SETS])
        return out

    def lost(self) -> Array:
        """Squared error that the log's raster makes expect in each sample, whitened: float64[outputs, samples], 1 on
        average.
        """
        if self.stage.lost is None:
            return np.ones_like(self.measured)
        squares = np.mean(self._whiten(self.measured - self.stage.lost) ** 2, axis=0)
        mean = squares.sum(axis=1) / np.maximum(self.valid.sum(axis=1), 1)
        return 1.0 + squares - mean[:, None]

    def expected(self) -> Array:
        """Squared error that the log's raster makes expect in each block, whitened: float64[blocks], 1 on average."""
        if self.stage.lost is None:
            return np.ones(self.n_blocks)
        lost = np.where(self.valid, self.lost(), 0.0).sum(axis=0)
        return np.asarray(np.maximum(np.add.reduceat(lost, self.block_start) / np.maximum(self.samples, 1), 0.1))

    def _whiten(self, model: Array, out: Array | None = None) -> Array:
        """Whitened errors of the outputs ``model``, [sets, outputs, samples]."""
        out = np.empty(np.shape(model)) if out is None else out
        starts = self.window_start if self.window_start is not None else np.empty(0, dtype=np.int64)
        normalise_residuals(np.ascontiguousarray(model, float), self.measured, self._counted, self.floor, starts, out)
        for response in self._unlogged:
            whiten_unlogged(out, response, starts)
        return out

    def block_costs(self, e: Array) -> Array:
        """Sum of squares per block: float64[sets, blocks]."""
        return np.add.reduceat(np.einsum("soi,soi->si", e, e), self.block_start, axis=1)

    def mean_squares(self, errors: Array) -> Array:
        """Mean square of ``errors``, float64[..., outputs, samples], over the samples of each output that count."""
        return np.asarray(np.sum(errors * errors, axis=-1) / np.maximum(self.valid.sum(axis=1), 1))

    def columns(self, effects: tuple[str, ...]) -> Array:
        """Columns that a fit with these effects sets free."""
        s = self.stage
        free = [i for i, p in enumerate(s.parameters) if p.tolerance > 0 and i not in self.spared]
        index = s.index()
        for name in effects:
            sl = index[name]
            free += list(range(sl.start, sl.stop))
        return np.array(free, dtype=int)

    def _limits(self) -> tuple[Array, Array]:
        s = self.stage
        limits = [p.limits() for p in s.parameters] + [(p.low, p.high) for e in s.effects for p in e.parameters]
        low, high = np.array(limits, dtype=float).reshape(-1, 2).T
        endless = np.array([p.period > 0.0 for p in s.all_parameters()], dtype=bool)
        return np.where(endless, -np.inf, low), np.where(endless, np.inf, high)

    def bounds(self) -> tuple[Array, Array]:
        """Lowest and highest value of every column; nominal parameters stay within their tolerance, what repeats itself
        has no bound.
        """
        return self._bounds

    def wrapped(self, theta: Array) -> Array:
        """The same parameters, those that repeat themselves within one turn."""
        for c in self._turning:
            theta[c] = self.stage.all_parameters()[c].wrapped(theta[c])
        return theta

    def totals(self, errors: Array, thetas: Array) -> Array:
        """What a fit minimises, of parameter sets with these whitened errors: sum of squares and prior,
        float64[sets].
        """
        return np.asarray(self.block_costs(errors).sum(axis=1) + (thetas - self.stage.expected()) ** 2 @ self.prior)

    def total_of(self, fit: Fit) -> float:
        """What the fit has minimised."""
        return float(fit.cost.sum() + np.sum(fit.prior * (fit.theta - self.stage.expected())[fit.free] ** 2))

    def fit(self, effects: tuple[str, ...], start: Array | Fit, iterations: int = 12, slopes: Known = NOT_KNOWN) -> Fit:
        """Fit the nominal parameters and those of ``effects`` from ``start``.

        start   parameters, or a fit to go on from: where its effects are the same, its derivatives are used again
        slopes  near the start, as far as they are known
        """
        return self.together([self.fitting(effects, start, iterations, slopes)])[0]

    def together(self, tasks: Sequence[Task[Answer]]) -> list[Answer]:
        """Run tasks side by side; return what each returns, in their order.

        A task yields parameter sets and gets their whitened errors. What all tasks ask for at one time is simulated in
        few calls of the stage's ``run``, many sets side by side.
        """
        answers: list[Any] = [None] * len(tasks)
        asked: list[tuple[int, Array]] = []

        def step(i: int, errors: Array | None) -> None:
            try:
                asked.append((i, tasks[i].send(errors)))  # type: ignore[arg-type]
            except StopIteration as end:
                answers[i] = end.value

        for i in range(len(tasks)):
            step(i, None)
        size = self.stage.measured.size
        while asked:
            batch: list[tuple[int, Array]] = []
            sets = 0
            while asked and (not batch or (sets + len(asked[0][1])) * size <= MAX_VALUES):
                batch.append(asked.pop(0))
                sets += len(batch[-1][1])
            errors = self.errors(np.concatenate([thetas for _, thetas in batch]))
            at = 0
            for i, thetas in batch:
                step(i, errors[at : at + len(thetas)])
                at += len(thetas)
        return answers

    def fitting(
        self, effects: tuple[str, ...], start: Array | Fit, iterations: int = 12, slopes: Known = NOT_KNOWN
    ) -> Task[Fit]:
        """`fit` as a task for `together`."""
        end = yield from self._descent(effects, start, iterations, slopes)
        free, linear = end.free, end.linear
        if linear is None:
            thetas, derivative = self.differences(end.theta, free, self.scale[free], self.bounds()[1], end.errors)
            error, rows = derivative((yield thetas))
            linear = self.blocks(error, rows)
            if carries(self, free):
                self._near.put(end.theta, free, error, rows)
        return self._finish(effects, end, *linear)

    def leading(self, effects: tuple[str, ...], start: Array, iterations: int, slopes: Known = NOT_KNOWN) -> Task[Led]:
        """Where the first steps of a `fitting` lead.

        What a fit is judged by, its derivatives at its end, costs as much as a step. Here it is left out.
        """
        end = yield from self._descent(effects, start, iterations, slopes)
        return Led(end.total, end.theta, end.near)

    def _descent(
        self, effects: tuple[str, ...], start: Array | Fit, iterations: int, slopes: Known = NOT_KNOWN
    ) -> Task[End]:
        """The steps of a `fitting`."""
        free = self.columns(effects)
        if not isinstance(start, Fit):
            return (yield from levenberg_marquardt(self, free, Begin(start, near=slopes), iterations))
        begin = Begin(start.theta, near=slopes)
        if start.effects == effects and np.array_equal(start.free, free):
            at_start = start.near.get(start.theta, free) if start.near is not None else None
            begin = begin._replace(linear=(start.cost, start.gradients, start.normals), slopes=at_start)
        return (yield from levenberg_marquardt(self, free, begin, iterations))

    def blocks(self, e: Array, jac: Array) -> tuple[Array, Array, Array]:
        """Sum of squares, gradient and normal matrix of every block, from the error and its derivatives
        (`linearise`).
        """
        k = len(jac)
        costs, gradients = np.zeros(self.n_blocks), np.zeros((self.n_blocks, k))
        normals = np.zeros((self.n_blocks, k, k))
        for b, (i, j) in enumerate(itertools.pairwise([*self.block_start, e.shape[1]])):
            for o in range(len(e)):
                error, slopes = e[o, i:j], jac[:, o, i:j]
                costs[b] += error @ error
                gradients[b] += slopes @ error
                normals[b] += slopes @ slopes.T
        return costs, gradients, normals

    def linearise(self, theta: Array, free: Array) -> tuple[Array, Array]:
        """Whitened error at ``theta`` (outputs, samples); minus its derivative by each scaled parameter (free, outputs,
        samples).
        """
        if (found := self._near.get(theta, free)) is not None:
            return found
        thetas, derivative = self.differences(theta, free, self.scale[free], self.bounds()[1])
        return derivative(self.errors(thetas))

    def lead(self, effects: tuple[str, ...], start: Array, iterations: int, slopes: Known = NOT_KNOWN) -> Led:
        """Where the first steps of a `fit` lead."""
        return self.together([self.leading(effects, start, iterations, slopes)])[0]

    def differences(
        self, theta: Array, free: Array, scale: Array, high: Array, known: Array | None = None
    ) -> tuple[Array, Callable[[Array], tuple[Array, Array]]]:
        """Parameter sets for `linearise`, and the function from their errors to its result; ``known``: errors at theta,
        if they are.
        """
        moves = [self._moves[c] for c in free]
        row, groups = self._sharing(free)
        thetas = np.repeat(theta[None], groups + 1, axis=0)
        steps = np.empty(len(free))
        for i, c in enumerate(free):
            d = DIFFERENCE * scale[i]
            if theta[c] + d > high[c]:
                d = -d
            thetas[row[i] + 1, c] += d
            steps[i] = d / scale[i]

        def derivative(e: Array) -> tuple[Array, Array]:
            here, moved = (e[0].copy(), e[1:]) if known is None else (known, e)
            jac = np.zeros((len(free), *here.shape))
            for i in range(len(free)):
                output, log = moves[i]
                only = slice(None) if output is None else slice(output, output + 1)
                jac[i, only] = (here[only] - moved[row[i], only]) / steps[i]
                if log is not None and "log" in self.stage.regimes:
                    jac[i] *= self.stage.regimes["log"] == log
            return here, jac

        return thetas if known is None else thetas[1:], derivative

    def begun(self, theta: Array, free: Array, slopes: Known) -> tuple[Array, Callable[[Array], tuple[Array, Array]]]:
        """Parameter sets whose errors tell, beside slopes that are known near ``theta``, those that are not; and the
        function from them to the error there and all slopes.
        """
        new = free[~np.isin(free, slopes.columns)]
        thetas, derivative = self.differences(theta, new, self.scale[new], self.bounds()[1])

        def whole(e: Array) -> tuple[Array, Array]:
            here, own = derivative(e)
            rows = np.zeros((len(free), *here.shape))
            rows[np.isin(free, new)] = own
            for i, c in enumerate(free):
                if c in slopes.columns:
                    rows[i] = slopes.rows[int(np.flatnonzero(slopes.columns == c)[0])].reshape(here.shape)
            return here, rows

        return thetas, whole

    def _sharing(self, free: Array) -> tuple[Array, int]:
        """The simulation of each of these, which it shares with what moves other outputs or logs; and how many."""
        key = free.tobytes()
        if key not in self._shared:
            moves, row, many = [self._moves[c] for c in free], np.zeros(len(free), dtype=int), 0
            for i, mine in enumerate(moves):
                alike = {int(row[j]) for j in range(i) if not _apart(mine, moves[j])}
                row[i] = next(g for g in range(many + 1) if g not in alike)
                many = max(many, int(row[i]) + 1)
            self._shared[key] = row, many
        return self._shared[key]

    def _finish(self, effects: tuple[str, ...], end: End, cost: Array, gradients: Array, normals: Array) -> Fit:
        theta, free, prior, scale, expected = (
            end.theta,
            end.free,
            end.prior,
            self.scale[end.free],
            self.stage.expected(),
        )
        (low, high), k = self.bounds(), len(free)
        # parameters at a bound do not move
        scaled_prior = prior * scale**2
        pinned = (theta[free] <= low[free]) | (theta[free] >= high[free])
        held = cost.copy()
        half = np.zeros(k)
        move = ~pinned
        if move.any():
            nm, gm, pm = normals[:, move][:, :, move], gradients[:, move], scaled_prior[move]
            # at the solution the blocks' pulls and the prior's cancel; what is left of the pull is rounding and bounds
            pull = gm.sum(axis=0) - pm * ((theta[free] - expected[free]) / scale)[move]
            total = nm.sum(axis=0) + np.diag(pm)
            a = total - nm + 1e-9 * np.diag(np.maximum(np.diag(total), 1e-12))
            without = np.linalg.solve(a, (pull - gm)[:, :, None])[:, :, 0]
            held = self._held_out(theta, free, move, cost, gradients, normals)
            centre = without.mean(axis=0)
            spread = np.zeros(k)
            spread[move] = (self.n_blocks - 1) / self.n_blocks * np.sum((without - centre) ** 2, axis=0)
            variance = np.diag(self._covariance(cost, normals, scaled_prior, move))
            half[move] = (NINETY * np.sqrt(np.maximum(variance, spread)) * scale)[move]
            turn = np.array([p.period or np.inf for p in self.stage.all_parameters()])[free]
            half = np.minimum(half, 0.5 * turn)
        return Fit(
            effects,
            theta,
            free,
            cost,
            np.maximum(held, cost * 0.5),
            gradients,
            normals,
            prior,
            theta[free] - half,
            theta[free] + half,
            end.stalled,
            self._near,
        )

    def _covariance(self, cost: Array, normals: Array, scaled_prior: Array, move: Array) -> Array:
        """Covariance of scaled parameters, as far as the log and what is known beforehand tell them: 0 where neither
        does. ``move``: which of them are at no bound.
        """
        # a nominal parameter at the edge of its tolerance is still as uncertain as its tolerance
        loose = move | (scaled_prior > 0.0)
        excess = max(1.0, cost.sum() / max(self.n, 1))
        worth = min(1.0 / excess, EVIDENCE * len(self.stage.outputs) / max(self.n, 1))
        out = np.zeros((len(move), len(move)))
        if loose.any():
            info = normals.sum(axis=0)[np.ix_(loose, loose)] * worth + np.diag(scaled_prior[loose])
            out[np.ix_(loose, loose)] = covariance(info)
        return out

    def correlation(self, fit: Fit) -> Array:
        """How the errors of a fit's free parameters go together: float64[free, free], from -1 to 1; NaN for one that
        stands at a bound, or of which nothing is known.
        """
        low, high = self.bounds()
        move = (fit.theta[fit.free] > low[fit.free]) & (fit.theta[fit.free] < high[fit.free])
        known = self._covariance(fit.cost, fit.normals, fit.prior * self.scale[fit.free] ** 2, move)
        with np.errstate(invalid="ignore", divide="ignore"):
            sizes = np.sqrt(np.where(move, np.diag(known), np.nan))
            return np.asarray(np.clip(known / np.outer(sizes, sizes), -1.0, 1.0))

    def _held_out(self, theta: Array, free: Array, move: Array, cost: Array, gradients: Array, normals: Array) -> Array:
        """Cost of each block with the effects' parameters fitted to the other blocks.

        Nominal parameters are calibrated on the whole log: a lag that only one manoeuvre shows is no reason to distrust
        the model.
        """
        mine = move & (free >= len(self.stage.parameters))
        if not mine.any():
            return cost.copy()
        g, a = gradients[:, mine], normals[:, mine][:, :, mine]
        total, pull = a.sum(axis=0), g.sum(axis=0)
        ridge = 1e-6 * np.diag(np.maximum(np.diag(total), 1e-12))
        columns, size, (low, high) = free[mine], self.scale[free[mine]], self.bounds()
        step = np.linalg.solve(total - a + ridge, (pull - g)[:, :, None])[:, :, 0]
        step = np.clip(step, (low[columns] - theta[columns]) / size, (high[columns] - theta[columns]) / size)
        return np.asarray(cost - 2.0 * np.sum(step * g, axis=1) + np.einsum("bi,bij,bj->b", step, a, step))


def covariance(information: Array) -> Array:
    """Covariance of parameters from the normal matrix of their fit; infinite where that is no number, because the
    model's slopes have no squares: nothing is known of such a parameter.
    """
    known = np.isfinite(information).all(axis=1)
    out = np.diag(np.where(known, 0.0, np.inf))
    out[np.ix_(known, known)] = np.linalg.pinv(information[np.ix_(known, known)])
    return out


def _apart(one: Moves, other: Moves) -> bool:
    """Whether what two parameters move is not the same output, or not the same log."""
    return any(None not in (a, b) and a != b for a, b in zip(one, other, strict=True))


def to_the_end(judge: LeastSquaresProblem, task: Task[Fit], go_on: bool = True) -> Task[Fit]:
    """The fit, gone on with until its error falls no more."""
    fit = yield from task
    for _ in range(4 if go_on else 0):
        more = yield from judge.fitting(fit.effects, fit, 8)
        gained = judge.total_of(fit) - judge.total_of(more)
        if gained > 0.0:
            fit = more
        if gained < LEAST_STEP_FALL * fit.cost.sum():
            break
    return fit


def recalibrate(judge: LeastSquaresProblem) -> Fit:
    """The stage with nothing added, its nominal parameters refitted within their tolerances, from wherever the stage
    says that a fit may begin: what every verb starts from.

    Raises StageError where the model, as it was given, says nothing of a measured sample.
    """
    stage = judge.stage
    silent = judge.valid & ~np.isfinite(stage.run(stage.neutral()[None])[0])
    if silent.any():
        o, i = (int(k[0]) for k in np.nonzero(silent))
        raise StageError(
            f"subsystem {stage.name!r}: the model's {stage.outputs[o]} is no number at {stage.t[i]:g} s and in "
            f"{int(silent.sum()):,} samples; allowed: finite values"
        )
    begins = [judge.stage.neutral(), *(judge.stage.begins if judge.stage.begins is not None else ())]
    fits = judge.together([to_the_end(judge, judge.fitting((), b), len(begins) > 1) for b in begins])
    return min(fits, key=judge.total_of)
