"""What parameter sets promise before anything is fitted: errors held against the slopes of a fit that is known.

A fit's errors e0 move with its free parameters along J, as they do at the fit. For a set with errors e the free
parameters can follow: what is left is the part of e that J does not span. An effect whose size acts linearly changes
the errors by d for the size tried, and by a d for a times that size: the best a follows from one simulation.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vaneloop.identification.least_squares.problem import LeastSquaresProblem
from vaneloop.identification.settings import SAME_SIZE, SCREEN_LINE, SCREEN_TOGETHER
from vaneloop.identification.subsystem import Array, Effect, Stage

__all__ = ["Linearisation", "along", "followed", "out_of", "within"]


class Linearisation:
    """Errors of a fit (``error``), and their slopes by its free parameters (``jac``), whitened as
    `LeastSquaresProblem.linearise` has them.

    prior  of the free parameters, as a fit has it
    known  error and slopes, where they are
    """

    def __init__(
        self,
        judge: LeastSquaresProblem,
        theta: Array,
        free: Array,
        prior: Array,
        known: tuple[Array, Array] | None = None,
    ):
        """Simulate the fit and its difference steps, where they are not known."""
        self.error, self.jac = known if known is not None else judge.linearise(theta, free)
        self._flat = self.jac.reshape(len(free), self.error.size)
        self._normal = self._flat @ self._flat.T + np.diag(prior * judge.scale[free] ** 2 + 1e-9)
        self._room = [(b[free] - theta[free]) / judge.scale[free] for b in judge.bounds()]

    def left(self, errors: Array) -> list[float]:
        """Sum of squares that is left of each set of errors when the free parameters have followed, within their
        bounds.
        """
        return self._follow(errors)[1]

    def _follow(self, errors: Array) -> tuple[Array, list[float]]:
        """Steps of the free parameters, in their scales, and what is left."""
        errors = errors.reshape(-1, self.error.size)
        pull = errors @ self._flat.T
        step = np.clip(_solved(self._normal, pull.T).T, *self._room)
        left = np.sum(errors * errors, axis=1) - np.sum((2.0 * pull - step @ self._normal) * step, axis=1)
        return step, [float(v) for v in left]

    def follow(self, errors: Array, low: Array, high: Array) -> tuple[Array, Array]:
        """How far the free parameters can follow one set of errors within ``low`` and ``high``, in their scales, and
        the errors then.
        """
        step = _best_within(self._normal, self._flat @ errors.ravel(), low, high)
        return step, np.asarray(errors - (step @ self._flat).reshape(errors.shape))

    def towards(self, errors: Array, groups: Sequence[Sequence[Sequence[int]]]) -> list[tuple[float, Array, Array]]:
        """What would be left if one could go as far towards each set of errors as is best: how much, the steps of the
        free parameters, in their scales, and how many times as far as that set. Each of its ``groups`` of outputs,
        which nothing else moves, goes its own way.
        """
        ways = self.error - errors
        across = np.array([ways[:, o] @ self.jac[:, o].T for o in range(len(self.error))])  # output, set, parameter
        sizes, pulls = np.einsum("soi,soi->os", ways, ways), np.einsum("soi,oi->os", ways, self.error)
        here, pull, k = float(np.sum(self.error**2)), self._flat @ self.error.ravel(), len(self._flat)
        out = []
        for s, mine in enumerate(groups):
            of = [list(outputs) for outputs in mine]
            both = np.array([across[outputs, s].sum(axis=0) for outputs in of])
            own = np.diag([sizes[outputs, s].sum() + 1e-9 for outputs in of])
            a = np.block([[self._normal, both.T], [both, own]])
            g = np.concatenate([pull, [pulls[outputs, s].sum() for outputs in of]])
            ends = zip(self._room, (0.0, SCREEN_LINE[1]), strict=True)
            low, high = (np.concatenate([room, np.full(len(of), end)]) for room, end in ends)
            step = _best_within(a, g, low, high)
            out.append((here - 2.0 * g @ step + step @ a @ step, step[:k], step[k:]))
        return out

    def line(self, errors: Array) -> tuple[Array, Array]:
        """By how many times the way from the fit to each set of errors the least would be left, and how much that is:
        float64[sets] each. The free parameters follow, without bounds.
        """
        e0 = self.error.ravel()
        d = errors.reshape(-1, self.error.size) - e0
        pull, pull0 = d @ self._flat.T, self._flat @ e0
        followed = _solved(self._normal, pull.T).T
        size = np.sum(d * d, axis=1) - np.sum(pull * followed, axis=1)
        down = -(d @ e0 - followed @ pull0)
        here = float(e0 @ e0 - pull0 @ _solved(self._normal, pull0))
        good = size > 1e-9 * np.maximum(np.sum(d * d, axis=1), 1e-300)
        share = np.clip(np.where(good, down / np.where(good, size, 1.0), 0.0), *SCREEN_LINE)
        return share, here - 2.0 * share * down + share**2 * size


def _best_within(a: Array, g: Array, low: Array, high: Array) -> Array:
    """The step within bounds, which are not beyond 0, that minimises step a step / 2 - g step (active sets).

    Unlike a fit, which comes again, it may not leave at a bound what the others then draw away from it.
    """
    step, free = np.zeros(len(g)), high > low
    for _ in range(6 * len(g)):
        here = np.flatnonzero(free)
        if here.size:
            fixed = step.copy()
            fixed[here] = 0.0
            way = _solved(a[np.ix_(here, here)], (g - a @ fixed)[here]) - step[here]
            room = np.where(way > 0.0, high[here], low[here]) - step[here]
            with np.errstate(divide="ignore", invalid="ignore"):
                share = np.where(way == 0.0, np.inf, room / way)
            k = int(np.argmin(share))
            step[here] += min(share[k], 1.0) * way
            if share[k] < 1.0:
                step[here[k]] = high[here[k]] if way[k] > 0.0 else low[here[k]]
                free[here[k]] = False
                continue
        pull = g - a @ step
        inward = np.where(free | (high <= low), 0.0, np.where(step >= high, -pull, pull))
        k = int(np.argmax(inward))
        if inward[k] <= 1e-9 * max(float(np.abs(g).max()), 1e-300):
            break
        free[k] = True
    return step


def _solved(a: Array, b: Array) -> Array:
    """The x of a x = b; of many that do, the least: where a law lets nothing through, an offset and a gain are one."""
    try:
        return np.asarray(np.linalg.solve(a, b))
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.lstsq(a, b)[0])


def followed(judge: LeastSquaresProblem, thetas: list[Array], free: Array, prior: Array) -> tuple[Array, list[float]]:
    """Errors at each set of parameters, and what is left when the free ones have followed by the slopes that they have
    *there*; the sets are moved there. For a parameter in which the outputs are linear (a gain, an offset) that is exact
    however far it has to go.
    """
    scale, high = judge.scale[free], judge.bounds()[1]
    errors, costs = [], []
    for i in range(0, len(thetas), SCREEN_TOGETHER):
        batch = [judge.differences(theta, free, scale, high) for theta in thetas[i : i + SCREEN_TOGETHER]]
        all_errors = judge.errors(np.concatenate([asked for asked, _ in batch]))
        at = 0
        for k, (asked, derivative) in enumerate(batch, i):
            slopes = Linearisation(judge, thetas[k], free, prior, derivative(all_errors[at : at + len(asked)]))
            at += len(asked)
            step, left = slopes._follow(slopes.error)
            thetas[k] = thetas[k].copy()
            thetas[k][free] += step[0] * scale
            errors.append(slopes.error)
            costs += left
    return np.array(errors), costs


def within(stage: Stage, theta: Array, name: str, held: str) -> Array:
    """The parameters of a model with the effect ``held`` as those of one with ``name``, which holds it within it."""
    index, out, neutral = stage.index(), theta.copy(), stage.neutral()
    values = iter(theta[index[held]])
    out[index[name]] = [
        next(values) if fixed is None else n if np.isnan(fixed) else fixed
        for fixed, n in zip(dict(stage.effect(name).holds)[held], neutral[index[name]], strict=True)
    ]
    out[index[held]] = neutral[index[held]]
    return out


def onward(stage: Stage, theta: Array, name: str, held: str) -> list[Array]:
    """Where the effect ``name`` may begin that holds ``held`` within it, by the parameters of a model with that."""
    effect, index = stage.effect(name), stage.index()
    low, high = ([getattr(p, end) for p in effect.parameters] for end in ("low", "high"))
    out = []
    for values in effect.onward(theta[index[held]].tolist()) if effect.onward is not None else []:
        out.append(within(stage, theta, name, held))
        out[-1][index[name]] = np.clip(values, low, high)
    return out


def out_of(stage: Stage, theta: Array, name: str, held: str) -> Array:
    """The parameters of a model with the effect ``name`` as those of one with ``held``, which it holds within it."""
    index, out = stage.index(), theta.copy()
    pattern = dict(stage.effect(name).holds)[held]
    out[index[held]] = [v for v, fixed in zip(theta[index[name]], pattern, strict=True) if fixed is None]
    out[index[name]] = stage.neutral()[index[name]]
    return out


def along(effect: Effect, start: Array, share: float, low: Array, high: Array) -> Array | None:
    """An effect's parameters ``share`` times as far from neutral as ``start``, within their bounds; None where that is
    the start again.

    Shapes stay: they say how it acts, not how much.
    """
    if SAME_SIZE[0] < share < SAME_SIZE[1]:
        return None
    sizes = np.array([not p.shape for p in effect.parameters])
    neutral = np.array([p.value for p in effect.parameters])
    return np.asarray(np.clip(np.where(sizes, neutral + share * (start - neutral), start), low, high))
