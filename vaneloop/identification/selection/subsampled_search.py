"""A search that sends ahead: an excerpt of the log tells where fits begin and which are worth making on all of it.

Most of a search goes into fits that come to nothing: many effects, many starts, pairs. On an excerpt they cost a share
of it. What leads there is fitted to the whole log from where it stands, where few steps are left, and all that is
decided is decided by these fits.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from vaneloop.identification.least_squares.problem import Fit, LeastSquaresProblem, Task
from vaneloop.identification.selection.likelihood_acceptance import LikelihoodAcceptance, rival_nats
from vaneloop.identification.selection.search import Criterion, Search
from vaneloop.identification.settings import (
    AHEAD_SAMPLES,
    DIRECTIONS,
    FITTED_ALONE,
    FITTED_BESIDE,
    LEAST_PROMISE,
    LITTLE_TOLD,
    NATS,
    SHORT_PIECE,
    STARTS_TOGETHER,
)
from vaneloop.identification.subsystem import Array, Effect, Stage

__all__ = ["SubsampledSearch", "excerpt_of", "searched", "spread"]

Promise = tuple[float, Array]  # sum of squares, parameters


def searched(
    criterion: Criterion, judged: Callable[[LeastSquaresProblem], Criterion], tick: Callable[[], None] | None
) -> Search:
    """The search of a stage: with one ahead, where the stage is long enough."""
    stage = criterion.judge.stage
    if stage.excerpt is None or len(stage.t) < 2 * AHEAD_SAMPLES or not isinstance(criterion, LikelihoodAcceptance):
        return Search(criterion, tick)
    return SubsampledSearch(criterion, judged, tick)


class _Ahead(Search):
    """The search on an excerpt, from the starts that are best on the whole log: quick fits, of which those are finished
    that lead.
    """

    def __init__(self, criterion: Criterion, tick: Callable[[], None], starts: dict[str, list[Array]]):
        """Fit the model as it is; ``starts`` of each effect."""
        self._given = starts
        super().__init__(criterion, tick)

    def _screen(self) -> dict[str, list[Array]]:
        return self._given

    def _joined(self, effects: tuple[str, ...], finished: bool) -> Task[Fit]:
        if len(effects) > 1:
            return (yield from super()._joined(effects, finished))
        return (yield from (self._single(effects[0]) if finished else self._quick(effects[0])))

    def _quick(self, name: str) -> Task[Fit]:
        key = frozenset((name,))
        if key not in self.fits:
            self.fits[key] = yield from self._begun(name)
            self.tick()
        return self.fits[key]

    def _single(self, name: str) -> Task[Fit]:
        key = frozenset((name,))
        fit = yield from self._quick(name)
        if key not in self.finished:
            fit = yield from self.judge.fitting((name,), fit, self._steps((name,)))
            self.fits[key] = yield from self._refine(name, fit)
            self.finished.add(key)
        return self.fits[key]


class SubsampledSearch(Search):
    """The search on one stage, with a search on an excerpt of it ahead.

    judged  makes the criterion of the excerpt
    """

    criterion: LikelihoodAcceptance

    def __init__(
        self,
        criterion: LikelihoodAcceptance,
        judged: Callable[[LeastSquaresProblem], Criterion],
        tick: Callable[[], None] | None,
    ):
        """Fit the model as it is, and see what each effect could do for it."""
        self._promised: dict[frozenset[str], dict[str, Promise]] = {}
        super().__init__(criterion, tick)
        self._judged = judged
        self.judge.roughly = True

    def _screen(self) -> dict[str, list[Array]]:
        if self.quiet:
            return super()._screen()
        self.reach = {}
        return {name: [theta] for name, (_, theta) in self._promises(self.base).items()}

    def _promises(self, fit: Fit) -> dict[str, Promise]:
        """Of each effect that could be added to a fit: what it would leave, and where.

        The way from the fit to each start is simulated. How far to go on it, and how far what is fitted follows, is
        taken from the slopes: exact for what acts linearly, and for what has no slope at its neutral value (a dead
        band, play) as good as a start is near.
        """
        key = frozenset(fit.effects)
        if key in self._promised:
            return self._promised[key]
        judge, stage, index = self.judge, self.stage, self.stage.index()
        slopes, free, first = self._slopes(key), fit.free, not fit.effects
        neutral, (low, high) = stage.neutral(), judge.bounds()
        here = float(np.sum(slopes.error**2))
        out: dict[str, Promise] = {e.name: (here, fit.theta) for e in stage.effects if e.name not in key}
        asked = [(e, np.array(s)) for e in stage.effects if e.name not in key for s in _tried(e)]
        for i in range(0, len(asked), STARTS_TOGETHER):
            part = asked[i : i + STARTS_TOGETHER]
            thetas = np.repeat(fit.theta[None], len(part), axis=0)
            for theta, (e, s) in zip(thetas, part, strict=True):
                theta[index[e.name]] = s
            errors = judge.errors(thetas)
            if first:
                for (e, _), left in zip(part, slopes.left(errors), strict=True):
                    self.reach[e.name] = max(self.reach.get(e.name, 0.0), abs(left - here))
            moved = [[judge._moves[c][0] for c in range(index[e.name].start, index[e.name].stop)] for e, _ in part]
            groups = [_ways(e, of, len(slopes.error)) for (e, _), of in zip(part, moved, strict=True)]
            ways = slopes.towards(errors, groups)
            for theta, (left, step, times), (e, s), of, own in zip(thetas, ways, part, moved, groups, strict=True):
                if left < out[e.name][0]:
                    far = [times[next((k for k, way in enumerate(own) if o in way), 0)] for o in of]
                    size = np.array([not p.shape for p in e.parameters])
                    none = neutral[index[e.name]]
                    theta[free] += step * judge.scale[free]
                    theta[index[e.name]] = np.where(size, none + far * (s - none), s)
                    out[e.name] = left, np.clip(theta, low, high)
        self._promised[key] = out
        if first:
            self.level = {name: left for name, (left, _) in out.items()}
        return out

    @cached_property
    def ahead(self) -> _Ahead:
        """The search on the excerpt."""
        judge = self.judge
        assert self.stage.excerpt is not None
        at = excerpt_of(judge, self.base, SHORT_PIECE, AHEAD_SAMPLES)
        part = LeastSquaresProblem(self.stage.excerpt(at), judge.floor, judge.valid[:, at])
        part.roughly = True
        return _Ahead(self._judged(part), self.tick, self.starts)

    def singles(self, names: Sequence[str]) -> dict[str, Fit]:
        """Fits with one effect each: of those that lead to the whole log, of the others as they stand."""
        base = float(self.base.cost.sum())
        promising = sorted(names, key=lambda n: self.level[n])
        promising = [n for n in promising if base - self.level[n] > LEAST_PROMISE * 2.0 * NATS][:FITTED_ALONE]
        out = dict.fromkeys(names, self.base)
        ahead = self.ahead.best_of([(n,) for n in promising]) if promising else []
        rough = [self._rough(f) for f in ahead]
        for f in (*rough, *self._fitted(rough, self.criterion.leaders)):
            out[f.effects[0]] = f
        return out

    def best_of(self, sets: Sequence[tuple[str, ...]]) -> list[Fit]:
        """Rank these sets of effects on the excerpt; fit those that lead to the whole log, and return them, best first.
        None is worth it that does no better than one of fewer effects.
        """
        if len(sets) > FITTED_BESIDE + 2:
            sets = sorted(sets, key=lambda s: self._known_promise(s)[0])[:FITTED_BESIDE]
        new = [s for s in sets if frozenset(s) not in self.fits]
        rough = [self._rough(f) for f in (self.ahead.best_of(new) if new else ())]
        fewer = min(self.judge.total_of(f) for key, f in self.fits.items() if len(key) < len(sets[0]))
        rough = [f for f in rough if fewer - self.judge.total_of(f) > LEAST_PROMISE * 2.0 * NATS]
        known = [self.fits[k] for k in map(frozenset, sets) if k in self.fits]
        return sorted(self._fitted([*known, *rough], self.criterion.finished), key=self.criterion.order)

    def _known_promise(self, effects: tuple[str, ...]) -> Promise:
        """Of the last effect beside the others as they are fitted."""
        fit = self.fits.get(frozenset(effects[:-1]))
        return (np.inf, self.base.theta) if fit is None else self._promises(fit)[effects[-1]]

    def rivals(self, fit: Fit, sets: Sequence[tuple[str, ...]], correlation: float) -> list[Fit]:
        """Those of these sets that may turn out to do as well as ``fit``, of whose errors so many count as one."""
        there, total = self.ahead.judge, self.judge.total_of
        new = [s for s in sets if frozenset(s) not in self.fits]
        quick = there.together([self.ahead._joined(s, False) for s in new])
        (mine,) = there.together([self.ahead._joined(fit.effects, True)])
        most = self._near(there, there.total_of(mine), correlation)
        quick = there.together([self.ahead._joined(f.effects, True) for f in quick if there.total_of(f) <= most])
        most = self._near(self.judge, max(total(fit), total(self._rough(mine)) if quick else 0.0), correlation)
        known = [self.fits[k] for k in map(frozenset, sets) if k in self.fits]
        rough = [f for f in map(self._rough, quick) if total(f) <= most]
        return sorted([*known, *self.judge.together([self._from(f) for f in rough])], key=self.criterion.order)

    def _part(self, fit: Fit) -> tuple[float, Array]:
        """The best fit that is known with some of these effects: what it leaves, and its parameters."""
        parts = [f for key, f in self.fits.items() if key < frozenset(fit.effects)]
        best = min(parts, key=self.judge.total_of)
        return self.judge.total_of(best), best.theta

    def _fitted(self, rough: Sequence[Fit], most: int) -> list[Fit]:
        """Fits begun where these stand: of the best, and of others, ``most`` in all, that may turn out to be as
        good.
        """
        total = self.judge.total_of
        rough = sorted(rough, key=total)
        near = [f for f in rough if total(f) <= self._near(self.judge, total(rough[0]), self.criterion.correlation)]
        return self.judge.together([self._from(f) for f in near[:most]])

    def _near(self, judge: LeastSquaresProblem, best: float, correlation: float) -> float:
        """The sum of squares up to which a fit may turn out to do as well as the one that leaves ``best``: four times
        what rivals may have between them.
        """
        return best + 2.0 * correlation * 4.0 * rival_nats(judge, best, correlation)

    def _from(self, rough: Fit) -> Task[Fit]:
        """The fit to the whole log, begun where it stands, or where a part of it does if that is better."""
        effects, key = rough.effects, frozenset(rough.effects)
        if key not in self.fits:
            part, there = self._part(rough)
            start = rough.theta if self.judge.total_of(rough) < part else there
            fit = yield from self.judge.fitting(effects, start, self._steps(effects))
            if len(effects) == 1:
                fit = yield from self._refine(effects[0], fit)
            self.fits[key] = fit
            self.tick()
        self.fits[key] = yield from self._no_worse(self.fits[key])
        return self.fits[key]

    def _single(self, name: str) -> Task[Fit]:
        return (yield from self._joined((name,), True))

    def _joined(self, effects: tuple[str, ...], finished: bool) -> Task[Fit]:
        if frozenset(effects) in self.fits:
            return (yield from self._from(self.fits[frozenset(effects)]))
        return (yield from self._from(self._rough(self.ahead.joined(effects))))

    def _rough(self, ahead: Fit) -> Fit:
        """What the excerpt says, or what the screening promised if that is better, with what it leaves of the whole log
        in each block when the model's own parameters have followed. Of what the effects pull at nothing is known; held
        out is what they were not fitted to.
        """
        free, slopes, (low, high) = self.base.free, self._slopes(frozenset()), self.judge.bounds()
        scale, none = self.judge.scale[free], np.zeros((self.judge.n_blocks, len(ahead.free)))
        thetas = [ahead.theta]
        for last in ahead.effects:
            key = frozenset(ahead.effects) - {last}
            if key in self._promised:
                thetas.append(self._promised[key][last][1])
        tried = []
        for theta, errors in zip(thetas, self.judge.errors(np.array(thetas)), strict=True):
            step, errors = slopes.follow(errors, *((b[free] - theta[free]) / scale for b in (low, high)))
            theta = theta.copy()
            theta[free] = np.clip(theta[free] + step * scale, low[free], high[free])
            cost = self.judge.block_costs(errors[None])[0]
            rough = {"cost": cost, "held_out": cost, "gradients": none, "normals": none[..., None] * none[:, None]}
            tried.append(replace(ahead, theta=theta, **rough))
        return min(tried, key=self.judge.total_of)


def _ways(effect: Effect, moves: Sequence[int | None], outputs: int) -> list[list[int]]:
    """Outputs that go together towards an effect, whose parameters move these (None: all): those of one output each go
    on their own.
    """
    own = sorted({o for o in moves if o is not None})
    split = all(o is not None or p.shape for o, p in zip(moves, effect.parameters, strict=True)) and len(own) > 1
    return [[o] for o in own] if split else [list(range(outputs))]


def _tried(effect: Effect) -> list[tuple[float, ...]]:
    """Starts of an effect; of one with a direction, its middle one in directions all round: from a wrong one the way is
    long.
    """
    starts = list(effect.starts)
    for i, p in enumerate(effect.parameters):
        if p.period:
            middle = starts[len(starts) // 2]
            around = [p.low + p.period * k / DIRECTIONS for k in range(DIRECTIONS)]
            starts = [(*middle[:i], turn, *middle[i + 1 :]) for turn in around]
    return starts


def excerpt_of(judge: LeastSquaresProblem, fit: Fit | None, piece: int, searched: int) -> Array:
    """Samples to search on, about ``searched``: pieces of whole windows, about ``piece`` long, half of them evenly
    spaced, the others where ``fit`` fails most; without a fit the first half only. Pieces of which little counts tell
    little, such as those of a linkage that stands.
    """
    stage = judge.stage
    n = len(stage.t)
    dt = float(np.median(np.diff(stage.t)))
    window = max(1, round((stage.window or dt) / dt))
    length = max(1, round(piece / window)) * window
    pieces, many = n // length, max(2, searched // length)
    told = _telling(stage, length, pieces, many)
    worst: list[int] = []
    if fit is not None:
        squares = np.sum(judge.errors(fit.theta[None])[0] ** 2, axis=0)
        cost = squares[: pieces * length].reshape(pieces, length).sum(axis=1)
        worst = np.argsort(-cost[told]).tolist()
    chosen = told[spread(len(told), many, worst)]
    return np.asarray((chosen[:, None] * length + np.arange(length)).reshape(-1))


def _telling(stage: Stage, length: int, pieces: int, many: int) -> Array:
    """Those pieces of so many samples that count for at least half as much as the best; at least ``many``."""
    if stage.counted is None:
        return np.arange(pieces)
    rows = np.arange(length)
    counts = np.array([np.count_nonzero(stage.counted(k * length + rows)) for k in range(pieces)])
    least = min(LITTLE_TOLD * counts.max(), np.sort(counts)[-min(many, pieces)])
    return np.flatnonzero(counts >= least)


def spread(pieces: int, many: int, wanted: Iterable[int]) -> list[int]:
    """Some of the pieces of a log, ascending: half of them evenly spaced, the others as they are ``wanted``, the first
    before the next.
    """
    many = min(many, pieces)
    chosen = set(np.linspace(0, pieces - 1, many - many // 2).round().astype(int).tolist())
    for k in wanted:
        if len(chosen) >= many:
            break
        chosen.add(int(k))
    return sorted(chosen)
