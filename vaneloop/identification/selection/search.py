"""Fits of one stage with sets of effects: each made once, begun where it may come to the best.

What is a better set is the criterion's to say: `identification.selection.likelihood_acceptance` for a model that may
come down to the noise of its log, `identification.selection.relative_error_acceptance` for one that will not.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Protocol

import numpy as np

from vaneloop.identification.least_squares.levenberg_marquardt import NOT_KNOWN, bounded_step
from vaneloop.identification.least_squares.problem import Fit, LeastSquaresProblem, Led, Task, recalibrate, to_the_end
from vaneloop.identification.selection.screening import Linearisation, along, followed, onward, out_of, within
from vaneloop.identification.selection.stepwise import eliminate
from vaneloop.identification.settings import DIRECTIONS, STARTS_TOGETHER
from vaneloop.identification.subsystem import Array, Effect

if TYPE_CHECKING:
    from vaneloop.identification.results import Candidate, Found, StageDiagnosis

__all__ = ["Criterion", "Search"]


class Criterion(Protocol):
    """When an effect is accepted, and what is reported in the end.

    most     effects in one stage
    leaders  effects tried in pairs
    fitted   of all effects that could be added, so many are fitted; the others are screened
    finished so many leading sets have their fits finished
    least    fall of the sum of squares below which the fit of a single effect is not finished
    left_out effects that help and are not to be named, and why
    form     noise floors by which equations may be wrong: models that are no further apart do the same
    roams    the model's own parameters are known roughly: they are refitted at each start of an effect
    """

    judge: LeastSquaresProblem
    most: int
    leaders: int
    fitted: int
    finished: int
    least: float
    form: float
    roams: bool
    left_out: dict[str, str]

    def begin(self, base: Fit) -> None:
        """Note what the model leaves as it is."""

    def learn(self, fit: Fit) -> None:
        """Note what the errors of the best single effect say of the log."""

    def order(self, fit: Fit) -> float:
        """By what sets of effects are ranked; less is better."""

    def fails(self, fit: Fit) -> bool:
        """Whether the model needs anything more."""

    def accepts(self, before: Fit, after: Fit) -> bool:
        """Whether the rules accept the further effects of ``after``."""

    def gain(self, before: Fit, after: Fit) -> tuple[float, float]:
        """What ``after`` gains over ``before``, as `Candidate` has it."""

    def shows(self, reach: float) -> bool:
        """Whether an effect that changes the sum of squares by so much at its largest could have been seen."""

    def spared(self, fit: Fit) -> Fit:
        """The fit without what the model itself does not need any more."""

    def settle(self, search: Search, fit: Fit) -> Fit:
        """The best model found, with what does as well and is simpler."""

    def name(self, search: Search, fit: Fit, candidates: list[Candidate]) -> tuple[list[Found], Fit]:
        """For each effect of the model: its rivals, how probable it is, its parameters; and the fit with them."""

    def conclude(
        self, base: Fit, fit: Fit, effects: list[Found], candidates: list[Candidate], steps: list[tuple[str, float]]
    ) -> StageDiagnosis:
        """Give the verdict."""


class Search:
    """The search on one stage: fits made once, compared by their held-out blocks."""

    def __init__(self, criterion: Criterion, tick: Callable[[], None] | None = None):
        """Fit the model as it is, and see what each effect could do for it."""
        self.criterion, self.judge = criterion, criterion.judge
        judge, self.stage = self.judge, self.judge.stage
        self.tick = tick or (lambda: None)
        self.fits: dict[frozenset[str], Fit] = {}
        self.finished: set[frozenset[str]] = set()
        self.begun: dict[frozenset[str], list[Led]] = {}
        self.passed: set[frozenset[str]] = set()  # what the screening left out
        # of fits: effect that could be added -> what the best of its starts would leave, and that start
        self.promises: dict[frozenset[str], dict[str, tuple[float, Array]]] = {}
        self.sloped: dict[frozenset[str], tuple[Fit, Linearisation]] = {}
        self.led: dict[tuple[frozenset[str], str], Fit] = {}  # sets, and an effect held there: the fit gone on from
        begins = [self.stage.neutral()]
        if self.stage.begins is not None:
            begins += list(self.stage.begins)
        self.base = self.first = self.fits[frozenset()] = recalibrate(judge)
        self.tick()
        # other places from which a model without what it lacks sees nothing better: a law may lead on from there
        self.nominal = [self.base.theta, *begins[1:]]
        # a stage that stands at its noise floor needs no effect; what the log could have shown is known from the
        # largest sizes
        criterion.begin(self.base)
        self.quiet = not criterion.fails(self.base)
        self.starts = self._screen()

    # ---- one effect --------------------------------------------------------------------------------------------------

    def _screen(self) -> dict[str, list[Array]]:
        """Best starts of every effect: those of all effects simulated at once beside the fitted nominal model."""
        stage, judge, roams = self.stage, self.judge, self.criterion.roams
        index = stage.index()
        thetas: list[Array] = []
        owner: list[str] = []
        costs: list[float] = []
        valley: list[int] = []  # from which place each set begins
        base_cost, plain = 0.0, 0
        for k, nominal in enumerate(self.nominal if roams else self.nominal[:1]):
            slopes = Linearisation(judge, nominal, self.base.free, self.base.prior)
            first = len(thetas)
            for e in stage.effects:
                for s in e.starts[-2:] if self.quiet else e.starts:
                    theta = nominal.copy()
                    theta[index[e.name]] = s
                    thetas.append(theta)
                    owner.append(e.name)
            if k == 0:
                base_cost = float(np.sum(slopes.error * slopes.error))
                for e in stage.effects if not self.quiet else ():
                    turned = self._turned(e, slopes.error, slopes.jac)
                    thetas += turned
                    owner += [e.name] * len(turned)
                plain = len(thetas)  # so many are tried beside the base
            some = thetas[first:]
            left, better = self._tried(slopes, nominal, some, owner[first:])
            thetas[first:] = [*some, *(theta for _, theta in better.values())]
            costs += [*left, *(cost for cost, _ in better.values())]
            owner += better
            valley += [k] * (len(thetas) - first)
        out: dict[str, list[Array]] = {}
        self.reach: dict[str, float] = {}
        self.level: dict[str, float] = {}
        for name in dict.fromkeys(owner):
            mine = sorted((c, i) for i, (o, c) in enumerate(zip(owner, costs, strict=True)) if o == name)
            # a second start is worth its time where it is nearly as good as the first
            near = mine[0][0] + 0.2 * max(base_cost - mine[0][0], 0.02 * base_cost)
            kept = [i for c, i in mine[:2] if roams or c <= near]
            # of a valley that looks poor before the parameters follow, nobody knows whether the law leads on there
            kept += [
                next(i for _, i in mine if valley[i] == k) for k in set(valley) - {valley[i] for i in kept} if roams
            ]
            # beside a model that is not fitted, slopes may promise what no fit keeps: one that is tried beside the base
            if roams and not any(i < plain for i in kept):
                kept.append(next(i for _, i in mine if i < plain))
            out[name] = [thetas[i] for i in kept]
            self.reach[name] = max(abs(c - base_cost) for c, _ in mine)  # what the largest sizes change at all
            self.level[name] = mine[0][0]
        return out

    def _tried(
        self, slopes: Linearisation, theta: Array, thetas: list[Array], owner: list[str]
    ) -> tuple[list[float], dict[str, tuple[float, Array]]]:
        """What is left at each of these sets, which differ from ``theta`` by the effect ``owner``, once what is fitted
        there has followed (of a quick model it has, in ``thetas``); and of a model that roams, for each effect a set
        with a better size that the slopes promise, where there is one: name -> what is left there, and the set.
        """
        judge, index, (low, high) = self.judge, self.stage.index(), self.judge.bounds()
        costs: list[float] = []
        shares: list[float] = []  # these two only of a model that roams
        promised: list[float] = []
        for i in range(0, len(thetas), STARTS_TOGETHER):
            part = thetas[i : i + STARTS_TOGETHER]
            if self.stage.quick:
                errors, left = followed(judge, part, self.base.free, self.base.prior)
                thetas[i : i + STARTS_TOGETHER] = part
            else:
                errors = judge.errors(np.array(part))
                left = slopes.left(errors)
            costs += left
            if self.criterion.roams:
                share, promise = slopes.line(errors)
                shares += share.tolist()
                promised += promise.tolist()
        best: dict[str, int] = {}
        for i in range(len(promised)):
            if owner[i] not in best or promised[i] < promised[best[owner[i]]]:
                best[owner[i]] = i
        again: dict[str, Array] = {}
        for name, i in best.items():
            at = index[name]
            moved = along(self.stage.effect(name), thetas[i][at], shares[i], low[at], high[at])
            if moved is not None:
                again[name] = theta.copy()
                again[name][at] = moved
        left = slopes.left(judge.errors(np.array(list(again.values())))) if again else []
        return costs, {name: (c, t) for (name, t), c in zip(again.items(), left, strict=True)}

    def _turned(self, effect: Effect, e0: Array, jac: Array) -> list[Array]:
        """Starts of an effect with a direction (a parameter that repeats itself), all round: each with the sizes that
        are best there.

        Size and direction are polar coordinates: from a wrong direction the way is long. In a fixed direction the sizes
        act linearly near neutral, so that their best values follow from one simulation.

        e0, jac  error of the fitted nominal model, and its derivatives by the nominal parameters, of
                 `LeastSquaresProblem.linearise`
        """
        judge, at = self.judge, self.stage.index()[effect.name]
        turning = [i for i, p in enumerate(effect.parameters) if p.period]
        sizes = np.array([at.start + i for i, p in enumerate(effect.parameters) if not p.shape], dtype=int)
        if not turning or len(turning) + len(sizes) < len(effect.parameters):
            return []
        p, (low, high) = effect.parameters[turning[0]], judge.bounds()
        columns = np.concatenate([self.base.free, sizes])
        scale = judge.scale[columns]
        prior = np.concatenate([self.base.prior, np.zeros(len(sizes))]) * scale**2
        thetas, asked, derivatives = [], [], []
        for k in range(DIRECTIONS):
            theta = self.base.theta.copy()
            theta[at.start + turning[0]] = p.low + p.period * k / DIRECTIONS
            moved, derivative = judge.differences(theta, sizes, judge.scale[sizes], high, e0)
            thetas.append(theta)
            asked.append(moved)
            derivatives.append(derivative)
        errors = judge.errors(np.concatenate(asked))
        for k, (theta, derivative) in enumerate(zip(thetas, derivatives, strict=True)):
            own = derivative(errors[k * len(asked[k]) : (k + 1) * len(asked[k])])[1]
            flat = np.concatenate([jac, own]).reshape(len(columns), e0.size)
            a = flat @ flat.T + np.diag(prior + 1e-9)
            step = bounded_step(
                a, flat @ e0.ravel(), (low[columns] - theta[columns]) / scale, (high[columns] - theta[columns]) / scale
            )
            theta[columns] += step * scale
        return thetas

    def single(self, name: str) -> Fit:
        """Fit with one effect, from its best starts."""
        return self.singles([name])[name]

    def singles(self, names: Sequence[str]) -> dict[str, Fit]:
        """Fits with one effect each, side by side; of a model that roams, of those that promise most."""
        if self.criterion.roams:
            followed = dict(zip(names, self.judge.together([self._followed(n) for n in names]), strict=True))
            names = sorted(names, key=lambda n: followed[n])[: self.criterion.fitted]
        return dict(zip(names, self.judge.together([self._single(n) for n in names]), strict=True))

    def _followed(self, name: str) -> Task[float]:
        """What the best of quick fits of an effect leaves, one from each start once the model's own parameters have
        followed it; where these end is where a fit begins.
        """
        led = []
        for start in self.starts[name]:
            first = yield from self.judge.leading((), start, 2)
            led.append((yield from self.judge.leading((name,), first.theta, 2)))
        led.sort(key=lambda of: of.total)
        self.starts[name] = [of.theta for of in led]
        return led[0].total

    def _begun(self, name: str) -> Task[Fit]:
        """The best of quick fits of an effect, one from each start."""
        return (yield from self._best((name,), self.starts[name]))

    def _best(self, effects: tuple[str, ...], starts: Sequence[Array]) -> Task[Fit]:
        """The best of quick fits from these starts."""
        if len(starts) == 1:
            return (yield from self.judge.fitting(effects, starts[0], 3))
        led = []
        for start in starts:
            led.append((yield from self.judge.leading(effects, start, 3)))
        return (yield from self.judge.fitting(effects, min(led, key=lambda of: of.total).theta, 0))

    def _steps(self, effects: Sequence[str]) -> int:
        """How many steps finish a fit; more of one effect with a direction: a curve leads from one to the next."""
        return 30 if len(effects) == 1 and any(p.period for p in self.stage.effect(effects[0]).parameters) else 8

    def _single(self, name: str) -> Task[Fit]:
        key = frozenset((name,))
        if key not in self.fits:
            best = yield from self._begun(name)
            if float(self.base.cost.sum() - best.cost.sum()) > self.criterion.least:  # worth finishing
                task = self.judge.fitting((name,), best, self._steps((name,)))
                best = yield from to_the_end(self.judge, task, self.criterion.roams)
                best = yield from self._refine(name, best)
            self.fits[key] = best
            self.tick()
        self.fits[key] = yield from self._no_worse(self.fits[key])  # what it holds may have been fitted since
        return self.fits[key]

    def _no_worse(self, fit: Fit) -> Task[Fit]:
        """The fit, or a better one from the best fit that it contains: with more effects, or with one that holds
        another within it, a fit never ends higher.

        A part's parameters are parameters of the whole, with the other effects at neutral, and a fit never ends higher
        than it starts.
        """
        fit, mine = (yield from self._led_on(fit)), frozenset(fit.effects)
        parts = [(f, f.theta) for key, f in self.fits.items() if key < mine]
        parts += [(f, within(self.stage, f.theta, name, held)) for name, held, f in self._held(fit.effects)]
        part, theta = min(parts, key=lambda p: self.judge.total_of(p[0]), default=(None, fit.theta))
        if part is None or self.judge.total_of(fit) <= self.judge.total_of(part):
            return fit
        again = yield from self.judge.fitting(fit.effects, theta, 8)
        return min(again, fit, key=self.judge.total_of)

    def _led_on(self, fit: Fit) -> Task[Fit]:
        """The fit, or a better one from where an effect leads that one of these holds within it: what does nearly the
        same lies along a valley that no start of its own need be in.
        """
        mine = frozenset(fit.effects)
        for name, held, f in self._held(fit.effects):
            if self.led.get((mine, held)) is f or not (thetas := onward(self.stage, f.theta, name, held)):
                continue
            self.led[mine, held] = f
            costs = self.judge.totals((yield np.array(thetas)), np.array(thetas))
            if costs.min() < self.judge.total_of(f):
                again = yield from self.judge.fitting(fit.effects, thetas[int(np.argmin(costs))], 8)
                fit = min(again, fit, key=self.judge.total_of)
        return fit

    def _held(self, effects: Sequence[str]) -> list[tuple[str, str, Fit]]:
        """Fits made with an effect that one of these holds within it in its place: that one, the other, the fit."""
        out = []
        for name in effects:
            for held, _ in self.stage.effect(name).holds:
                key = (frozenset(effects) - {name}) | {held}
                if held not in effects and key in self.fits:
                    out.append((name, held, self.fits[key]))
        return out

    def simpler(self, fit: Fit, name: str) -> list[Fit]:
        """Fits with an effect that ``name`` holds within it in its place, from where ``fit`` has it too."""
        out = []
        for held, _ in self.stage.effect(name).holds:
            if held in fit.effects:
                continue
            effects = tuple(held if e == name else e for e in fit.effects)
            theta = out_of(self.stage, fit.theta, name, held)
            again = self.judge.together([to_the_end(self.judge, self.judge.fitting(effects, theta, 8))])[0]
            known = self.fits.get(frozenset(effects), again)
            out.append(min(known, again, key=self.judge.total_of))
            self.fits[frozenset(effects)] = out[-1]
        return out

    def _refine(self, name: str, fit: Fit) -> Task[Fit]:
        """Search between the starts next to the fit, where a size acts in steps (a threshold, whole frames) and has no
        slope to follow.
        """
        starts = np.unique([s[0] for s in self.stage.effect(name).starts])
        column = self.stage.index()[name].start
        at = fit.theta[column]
        parameters = self.stage.effect(name).parameters
        if sum(not p.shape for p in parameters) != 1 or any(p.period for p in parameters):
            return fit
        if np.min(np.abs(starts - at)) > 1e-9 * max(1.0, abs(at)) and not fit.stalled:
            return fit  # it moved away from its start: there is a slope
        i = int(np.argmin(np.abs(starts - at)))
        low, high = starts[max(i - 1, 0)], starts[min(i + 1, len(starts) - 1)]
        best = at
        for _ in range(2):
            sizes = np.linspace(low, high, 13)
            thetas = np.repeat(fit.theta[None], len(sizes), axis=0)
            thetas[:, column] = sizes
            costs = self.judge.block_costs((yield thetas)).sum(axis=1)
            k = int(np.argmin(costs))
            best, low, high = sizes[k], sizes[max(k - 1, 0)], sizes[min(k + 1, len(sizes) - 1)]
        theta = fit.theta.copy()
        theta[column] = best
        refined = yield from self.judge.fitting((name,), theta, 4)
        return refined if refined.cost.sum() < fit.cost.sum() else fit

    # ---- several effects ---------------------------------------------------------------------------------------------

    def joined(self, effects: tuple[str, ...]) -> Fit:
        """Fit with several effects, started from the fits with one fewer."""
        return self.judge.together([self._joined(effects, True)])[0] if effects else self.base

    def _begins(self, effects: tuple[str, ...]) -> Task[list[Led]]:
        """Where a fit with several effects may begin, each with what it would minimise there; best first."""
        index, judge = self.stage.index(), self.judge
        single: dict[str, Array] = {}
        for name in effects:
            if not self.criterion.roams:
                single[name] = (yield from self._single(name)).theta
            elif (key := frozenset((name,))) in self.fits:
                single[name] = self.fits[key].theta
        begins: list[tuple[tuple[str, ...], Array]] = []  # what stands in the fit before, and the beginning
        for leave in effects:
            rest = tuple(e for e in effects if e != leave)
            if (known := self.fits.get(frozenset(rest))) is not None:
                sources = [self.starts[leave][0], single[leave]] if leave in single else [self.starts[leave][0]]
                sizes = [source[index[leave]] for source in sources]
                if leave in (found := self.promises.get(frozenset(rest), {})):
                    sizes.append(found[leave][1])
                elif self.criterion.roams:
                    sizes += [np.array(start, dtype=float) for start in self.stage.effect(leave).starts]
                for size in sizes:
                    theta = known.theta.copy()
                    theta[index[leave]] = size
                    begins.append((rest, theta))
        if not begins:
            theta = single.get(effects[0], self.starts[effects[0]][0]).copy()
            for other in effects[1:]:
                theta[index[other]] = single.get(other, self.starts[other][0])[index[other]]
            begins.append(((), theta))
        thetas = np.array([theta for _, theta in begins])
        errors = yield thetas
        costs = judge.totals(errors, thetas)
        if not self.criterion.roams:
            k = int(np.argmin(costs))
            return [Led(float(costs[k]), begins[k][1], NOT_KNOWN)]
        left = [self._left(frozenset(rest), e) for (rest, _), e in zip(begins, errors, strict=True)]
        out = []
        for k in np.argsort(left, kind="stable")[:2]:  # the model's own parameters and the other effects' follow first
            rest, theta = begins[k]
            led = yield from judge.leading(rest, theta, 2)
            out.append((yield from judge.leading(effects, led.theta, 2)))
        return sorted(out, key=lambda of: of.total)

    def _left(self, rest: frozenset[str], errors: Array) -> float:
        """What is left of a set's errors when the parameters of the fit with one effect fewer have followed; without
        end where they are that fit's own: an effect at a size that changes nothing, a limit that nothing reaches, does
        best before the others follow, and no fit leads on from there.
        """
        slopes = self._slopes(rest)
        if np.allclose(errors, slopes.error, rtol=1e-9, atol=1e-9):
            return np.inf
        return slopes.left(errors)[0]

    def _slopes(self, key: frozenset[str]) -> Linearisation:
        """The slopes of a fit that is known."""
        fit = self.fits[key]
        if key not in self.sloped or self.sloped[key][0] is not fit:
            self.sloped[key] = fit, Linearisation(self.judge, fit.theta, fit.free, fit.prior)
        return self.sloped[key][1]

    def _joined(self, effects: tuple[str, ...], finished: bool) -> Task[Fit]:
        """``finished`` False: a few iterations, enough to rank it."""
        if len(effects) == 1:
            return (yield from self._single(effects[0]))
        key = frozenset(effects)
        if key not in self.fits:
            begins = self.begun.get(key) or (yield from self._begins(effects))
            self.fits[key] = yield from self._best(tuple(effects), [of.theta for of in begins])
            self.tick()
        if finished and key not in self.finished:
            task = self.judge.fitting(tuple(effects), self.fits[key], 8)
            self.fits[key] = yield from to_the_end(self.judge, task, self.criterion.roams)
            self.finished.add(key)
            self.tick()
        self.fits[key] = yield from self._no_worse(self.fits[key])
        return self.fits[key]

    def without(self, fit: Fit, drop: str) -> Fit:
        """Fit without one effect: the known one; of a model that roams also where the other parameters of ``fit`` lead.

        An effect that changes nothing may have shown the way out of a local minimum; it must not take the credit.
        """
        rest = tuple(e for e in fit.effects if e != drop)
        known = self.joined(rest)
        if not self.criterion.roams:
            return known
        at = self.stage.index()[drop]
        first, neutral = fit.theta[at], self.stage.neutral()[at]
        theta = fit.theta
        for share in (0.25, 0.5, 0.75, 1.0):  # by and by, so that the others can follow
            theta = theta.copy()
            theta[at] = first + share * (neutral - first)
            theta = self.judge.lead(rest, theta, 5).theta
        other = self.judge.together([to_the_end(self.judge, self.judge.fitting(rest, theta, 8))])[0]
        if self.judge.total_of(other) < 0.99 * self.judge.total_of(known):
            self.fits[frozenset(rest)] = known = other
            if not rest:
                self.base = other
        return known

    def pruned(self, fit: Fit) -> Fit:
        """The fit without the effects that it does not need any more."""
        less = lambda f: [self.without(f, drop) for drop in f.effects] if len(f.effects) > 1 else []  # noqa: E731
        return eliminate(fit, less, self.criterion.accepts, lambda idle: min(idle, key=self.criterion.order))

    def beside(self, rest: Sequence[str]) -> list[Fit]:
        """Fits made with one effect more than ``rest``."""
        return [f for key, f in self.fits.items() if len(key) == len(rest) + 1 and key.issuperset(rest)]

    def _pass_over(self, sets: Sequence[tuple[str, ...]]) -> None:
        """Screen sets of effects that are not fitted yet, and pass over those that promise least."""
        most = self.criterion.fitted
        new = [s for s in sets if frozenset(s) not in self.fits and frozenset(s) not in self.passed]
        if len(new) <= most:
            return
        promise = {s: self._promise(s) for s in new}
        leading = sorted(new, key=lambda s: promise[s])[: most + most // 2]
        for s, begins in zip(leading, self.judge.together([self._begins(s) for s in leading]), strict=True):
            self.begun[frozenset(s)] = begins
        kept = sorted(leading, key=lambda s: self.begun[frozenset(s)][0].total)[:most]
        self.passed |= {frozenset(s) for s in new if s not in kept}

    def _promise(self, effects: tuple[str, ...]) -> float:
        """What is left with the last effect, at the best of its starts, on top of the others as they are fitted, when
        the model's own parameters have followed, as their slopes there have it.
        """
        rest, last = effects[:-1], effects[-1]
        key = frozenset(rest)
        if key not in self.fits:
            return self.level[last]
        if key not in self.promises:
            fit, index = self.fits[key], self.stage.index()
            slopes = self._slopes(key)
            thetas, owner = [], []
            for e in self.stage.effects:
                for start in e.starts if e.name not in rest else ():
                    theta = fit.theta.copy()
                    theta[index[e.name]] = start
                    thetas.append(theta)
                    owner.append(e.name)
            costs, found = self._tried(slopes, fit.theta, thetas, owner)
            for name, cost, theta in zip(owner, costs, thetas, strict=True):
                if name not in found or cost < found[name][0]:
                    found[name] = cost, theta
            found = {name: (cost, theta[index[name]]) for name, (cost, theta) in found.items()}
            self.promises[key] = found
        return self.promises[key][last][0]

    def rivals(self, fit: Fit, sets: Sequence[tuple[str, ...]], correlation: float) -> list[Fit]:
        """Fits with these sets of effects, among them those that may turn out to do as well as ``fit``, of whose errors
        so many count as one; best first.
        """
        return self.best_of(sets)

    def best_of(self, sets: Sequence[tuple[str, ...]]) -> list[Fit]:
        """Rank these sets of effects by quick fits, finish the leading ones, and return all, best first."""
        if self.criterion.roams:
            self._pass_over(sets)
            sets = [s for s in sets if frozenset(s) not in self.passed]
        quick = self.judge.together([self._joined(s, False) for s in sets])
        quick.sort(key=self.criterion.order)
        leading = self.criterion.finished
        out = self.judge.together([self._joined(f.effects, True) for f in quick[:leading]]) + quick[leading:]
        return sorted(out, key=self.criterion.order)
