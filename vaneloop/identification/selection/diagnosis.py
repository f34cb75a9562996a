"""Which effects is a stage missing? Screening, pairs of the leaders, pruning, rivals, and what is left.

The loop is `identification.selection.stepwise`, the fits are those of `identification.selection.search`. The criterion
accepts an effect or not: `LikelihoodAcceptance` for a model that may come down to the noise of its log,
`RelativeErrorAcceptance` for one that will not.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from vaneloop.identification.least_squares.noise import correlation_of
from vaneloop.identification.least_squares.problem import Fit, LeastSquaresProblem, recalibrate
from vaneloop.identification.onset import begun, change_point, onset_of, quiet_until
from vaneloop.identification.regimes import agrees
from vaneloop.identification.results import Candidate, StageDiagnosis, answer_of, found_of, rms_of
from vaneloop.identification.selection.likelihood_acceptance import LikelihoodAcceptance
from vaneloop.identification.selection.rules import BEGINS, LEAVES_A_QUARTER, Beginning, Decisions, Remainder
from vaneloop.identification.selection.search import Criterion, Search
from vaneloop.identification.selection.stepwise import eliminate, stepwise
from vaneloop.identification.selection.subsampled_search import excerpt_of, searched
from vaneloop.identification.settings import (
    EXCERPT_PIECE,
    EXCERPT_SAMPLES,
    LONG_SAMPLES,
    ONSET_ROUNDS,
    PAIR_LEADERS,
    TOLERATED,
)
from vaneloop.identification.subsystem import Array, Stage, StageError, noise_of, reach_of

__all__ = ["Judged", "diagnose_stage", "extend_stage", "floor_of"]


Judged = Callable[[LeastSquaresProblem], Criterion]  # makes the criterion of a stage
Said = tuple[Search, Fit, list[Candidate], list[tuple[str, float]]]


def floor_of(stage: Stage) -> Array:
    """The stage's noise floor, which whoever made the stage must have given."""
    if stage.floor is None or not np.all(np.isfinite(stage.floor)):
        raise StageError(f"subsystem {stage.name!r}: no noise floor")
    return stage.floor


def diagnose_stage(
    stage: Stage,
    floor: Array,
    keep: Array | None = None,
    tick: Callable[[], None] | None = None,
    judged: Judged = LikelihoodAcceptance,
) -> StageDiagnosis:
    """Search the stage's library for what is missing; see `_search`.

    floor   RMS of each output's error when nothing is missing
    keep    samples that count
    tick    called after every fit, for a progress bar
    judged  what an effect must do to be named

    A stage with very many samples is searched on an excerpt: half of it evenly spaced, half where the model fails most.
    What is found there is fitted to the whole log and has to earn its place again; where the whole log shows more, a
    second excerpt is taken from what is left.
    """
    if stage.excerpt is None or len(stage.t) < LONG_SAMPLES:
        ask = partial(_to_the_floor, floor=floor, keep=keep, tick=tick, judged=judged)
        said = _whenever(stage, keep, judged, ask)
        return _unless_coarse(stage, said)
    judge = LeastSquaresProblem(stage, floor, keep)
    at = excerpt_of(judge, None, EXCERPT_PIECE, EXCERPT_SAMPLES)
    even = LeastSquaresProblem(stage.excerpt(at), floor, None if keep is None else keep[..., at])
    base = judge.fit((), recalibrate(even).theta)  # from near it, where few steps are left
    left = base
    for _ in range(2):
        at = excerpt_of(judge, left, EXCERPT_PIECE, EXCERPT_SAMPLES)
        part = stage.excerpt(at)
        own = None if keep is None else keep[..., at]
        said = _whenever(part, own, judged, partial(_to_the_floor, floor=floor, keep=own, tick=tick, judged=judged))
        found = _confirm(stage, keep, floor, base, said, judged)
        if found.verdict != "unknown" or said.verdict == "unknown":
            break
        left = found.final
    return _unless_coarse(stage, found)


def _unless_coarse(stage: Stage, said: StageDiagnosis) -> StageDiagnosis:
    """The answer; "unknown" where it would rest on a channel that lacks bits, or explains one."""
    if stage.coarse and (said.effects or any(o in stage.coarse for o in stage.outputs)):
        nearest = [f.effect for f in said.effects] or said.nearest
        said = replace(said, verdict="unknown", nearest=nearest, effects=[], refused=list(stage.coarse.values()))
    return said


def _confirm(
    stage: Stage, keep: Array | None, floor: Array, base: Fit, said: StageDiagnosis, judged: Judged
) -> StageDiagnosis:
    """Fit what an excerpt said to the whole log; an effect that the whole log does not need is dropped."""
    begins = onset_of(stage, said.final.theta)
    if begins is not None:
        begins = change_point(LeastSquaresProblem(stage, said.floor, keep), said.final, said.correlation).value
    stage = begun(stage, begins)
    judge = LeastSquaresProblem(stage, said.floor, keep)
    criterion = judged(judge)
    nominal = base if np.array_equal(floor, said.floor) else judge.fit((), base.theta, 4)
    chosen, current = said.final.effects, nominal
    if chosen:
        current = judge.fit(chosen, said.final.theta, 8)
        if judge.total_of(current) > judge.total_of(nominal):  # what suits the excerpt may suit nothing else
            current = judge.fit(chosen, nominal.theta, 8)
    criterion.learn(current)
    less: dict[str, Fit] = {}  # of the latest model, without each of its effects

    def without(fit: Fit) -> list[Fit]:
        rest = [tuple(c for c in fit.effects if c != name) for name in fit.effects]
        begins = (np.where(_allowed(stage, r), fit.theta, stage.neutral()) for r in rest)
        fits = (
            [nominal]
            if rest == [()]
            else judge.together([judge.fitting(r, b, 6) for r, b in zip(rest, begins, strict=True)])
        )
        less.update(zip(fit.effects, fits, strict=True))
        return fits

    current = eliminate(current, without, criterion.accepts, lambda idle: idle[0])
    chosen = current.effects
    whole = {f.effect: f for f in found_of(judge, current, chosen, less)}
    effects = [
        replace(f, parameters=whole[f.effect].parameters, fall=whole[f.effect].fall)
        for f in said.effects
        if f.effect in chosen
    ]
    steps = [("nominal", rms_of(judge, nominal))]
    if chosen:
        steps.append((" + ".join(chosen), rms_of(judge, current)))
    out = criterion.conclude(nominal, current, effects, said.candidates, steps)
    if current.effects and begins is not None:
        out.onset = replace(change_point(judge, current, correlation_of(judge, current)), value=begins)
    return out


def _allowed(stage: Stage, effects: tuple[str, ...]) -> Array:
    """Columns that a model with only these effects may have away from neutral: bool[parameters]."""
    out = np.ones(len(stage.all_parameters()), dtype=bool)
    for name, columns in stage.index().items():
        out[columns] = name in effects
    return out


def _down_to(stage: Stage, floor: Array, ask: Callable[[Array, bool], tuple[Fit, Said]]) -> Said:
    """Ask with the floor, measured again on the errors of the best model where it was too high, and once more with
    what a model with these effects can reach at all.

    A gross effect makes the nominal model's error move so fast that it passes for noise.

    ask  function from a floor, and whether it is the last word, to the best fit and the answer
    """
    for attempt in range(3):
        fit, said = ask(floor, False)
        if stage.noise is None or attempt == 2:
            break
        lower = noise_of(stage, fit.theta)
        if not np.any(lower < 0.9 * floor):
            break
        floor = np.minimum(lower, floor)
    reach = reach_of(stage, floor, fit.theta)  # nobody can come closer than that
    return ask(reach, True)[1] if np.any(reach > floor) else said


def _to_the_floor(
    stage: Stage, floor: Array, keep: Array | None, tick: Callable[[], None] | None, judged: Judged
) -> StageDiagnosis:
    """Search down to the floor, name what was found, and conclude."""

    def ask(floor: Array, last: bool) -> tuple[Fit, Said]:
        judge = LeastSquaresProblem(stage, floor, keep)
        begun: Judged = partial(LikelihoodAcceptance, known=TOLERATED - 1.0) if last else judged
        said = _search(searched(begun(judge), begun, tick))
        return said[1], said

    search, current, candidates, steps = _down_to(stage, floor, ask)
    effects, current = search.criterion.name(search, current, candidates)
    d = search.criterion.conclude(search.first, current, effects, candidates, steps)
    if search.base is not search.first:
        was, now = (rms_of(search.judge, f) for f in (search.first, search.base))
        d.notes.append(
            f"with nothing added {stage.name} reaches {now:.4g} noise floors, not {was:.4g}, "
            f"from the best parameters of the search"
        )
    return d


def _whenever(
    stage: Stage, keep: Array | None, judged: Judged, ask: Callable[[Stage], StageDiagnosis]
) -> StageDiagnosis:
    """What ``ask`` says of effects that act all along; where these leave more than noise, and the model without effects
    does not up to some time, what it says of effects that begin then.
    """
    said = ask(stage)
    if agrees(said.excess, 1.0) if said.final.effects else said.verdict != "unknown":
        return said
    at = quiet_until(LeastSquaresProblem(stage, said.floor, keep), lambda part, fit: judged(part).fails(fit))
    for k in range(ONSET_ROUNDS):
        if at is None:
            break
        last, later = at, begun(stage, at)
        found = ask(later)
        fit, judge = found.final, LeastSquaresProblem(stage, found.floor, keep)
        if not fit.effects:  # a block is too coarse for an answer: the time follows from what comes nearest to one
            if not found.nearest:
                break
            fit = LeastSquaresProblem(later, found.floor, keep).fit(tuple(found.nearest[:1]), later.neutral())
        correlation = correlation_of(judge, fit)
        when = change_point(judge, fit, correlation)
        settled = when.value == at or (k > 0 and when.low < at <= when.high)  # the first is only a block's beginning
        for _ in range(0 if settled else ONSET_ROUNDS):
            if when.value == at:
                break
            at = when.value
            fit = LeastSquaresProblem(begun(stage, at), found.floor, keep).fit(fit.effects, fit.theta, 4)
            when = change_point(judge, fit, correlation)
        if settled and found.verdict == "missing":
            thetas = np.array([said.final.theta, found.final.theta])
            always, begins = judge.totals(judge.errors(thetas), thetas)
            case = Beginning(0.5 * float(always - begins) / correlation, judge.n_blocks)
            decisions = Decisions(found.decisions)
            if decisions.decide([BEGINS], case, found.final.effects, said.final.effects):
                return replace(found, onset=replace(when, value=at), decisions=list(decisions))
        if at == last:
            break
    return said


def _search(search: Search) -> Said:
    """Search the stage's library for what is missing: the search, the best model, all effects alone, steps."""
    judge, stage, criterion, base = search.judge, search.stage, search.criterion, search.base
    names = [e.name for e in stage.effects]
    singles = dict.fromkeys(names, base) if search.quiet else search.singles(names)
    leader = min(singles.values(), key=criterion.order, default=base)
    criterion.learn(leader)
    candidates = []
    for name, fit in singles.items():
        why = "" if criterion.shows(search.reach[name]) else stage.effect(name).excites or "this log does not excite it"
        candidates.append(Candidate(name, *criterion.gain(base, fit), why, rms_of(judge, fit)))
    candidates.sort(key=lambda c: -c.nats)

    steps = [("nominal", rms_of(judge, base))]
    current, tried = base, -1
    while len(criterion.left_out) > tried:  # what was left out in the end may have stood in another's way
        tried = len(criterion.left_out)
        current = stepwise(EffectSelection(search, singles, [c.effect for c in candidates], steps), current)[-1]
    current = search.fits[frozenset(current.effects)] = criterion.spared(current)
    return search, current, candidates, steps


class EffectSelection:
    """Effects of the library: one by one, or the leading two at once.

    singles  fits with one effect each; ``ranked``: their names, best first
    steps    gets a line for each step
    """

    def __init__(self, search: Search, singles: dict[str, Fit], ranked: list[str], steps: list[tuple[str, float]]):
        self.search, self.singles, self.ranked, self.steps = search, singles, ranked, steps
        self.names = [e.name for e in search.stage.effects]  # what may still be added

    def wants_more(self, current: Fit) -> bool:
        """Whether the model stands above the noise and may have further effects."""
        criterion = self.search.criterion
        return len(current.effects) < criterion.most and criterion.fails(current)

    def finalists(self, current: Fit) -> list[Fit]:
        """The model with each further effect; without any so far, each effect and pairs of the leaders."""
        search, criterion = self.search, self.search.criterion
        names = self.names = [m for m in self.names if m not in (*current.effects, *criterion.left_out)]
        if current.effects:
            return search.best_of([(*current.effects, m) for m in names])
        options = [f for m, f in self.singles.items() if m in names]
        leaders = self.leaders([m for m in self.ranked if m in names])
        alone = [f for f in options if criterion.accepts(current, f)]
        # of a model that roams, pairs are tried where no effect helps alone; else where the best one leaves more
        # than noise, and no other makes up for that beside it
        tried = list(options)
        if not criterion.roams and alone and _least(search, tried) > TOLERATED:
            (first,) = min(alone, key=criterion.order).effects
            tried += search.best_of([(first, m) for m in names if m != first])
        if criterion.roams and not alone and leaders:
            # a leader may need one that does nothing alone
            for first in leaders[:PAIR_LEADERS]:
                options += search.best_of([(first, m) for m in names if m != first])
        if tried and not (criterion.roams and alone) and _least(search, tried) > TOLERATED:
            options += search.best_of(list(itertools.combinations(leaders, 2)))
        return options

    def leaders(self, ranked: list[str], many: int = 1) -> list[str]:
        """The leading effects, ``many`` times the usual number; of a model that roams no two that do the same.

        A gain at either end, for example, counts as one.
        """
        search, criterion, out = self.search, self.search.criterion, list[str]()
        if not criterion.roams:
            return ranked[: many * criterion.leaders]
        errors: list[Array] = []
        for name in ranked:
            error = search.judge.errors(self.singles[name].theta[None])[0]
            apart = [float(np.sqrt(np.sum((error - other) ** 2) / max(search.judge.n, 1))) for other in errors]
            if all(rms > criterion.form for rms in apart):
                out.append(name)
                errors.append(error)
            if len(out) == many * criterion.leaders:
                break
        return out

    def accepted(self, current: Fit, tried: Sequence[Fit]) -> list[Fit]:
        """Those that the criterion accepts; of none, the way by another leading effect."""
        ok = [f for f in tried if self.search.criterion.accepts(current, f)]
        other = None if ok else _on_another_way(self, current)
        return ok if other is None else [other]

    def chosen(self, current: Fit, accepted: Sequence[Fit]) -> Fit:
        """The best with fewest effects: a pair must be accepted over the best single, and that be above the floor."""
        criterion = self.search.criterion
        ok = sorted(accepted, key=lambda f: (len(f.effects), criterion.order(f)))
        best = ok[0]
        for f in ok[1:]:
            if len(f.effects) == len(best.effects):
                if criterion.order(f) < criterion.order(best):
                    best = f
            elif criterion.fails(best) and criterion.accepts(best, f):
                best = f
        self._note(best)
        return best

    def pruned(self, models: list[Fit]) -> list[Fit]:
        """The last model without what it does not need, and with what does as well and is simpler."""
        search = self.search
        last = search.criterion.settle(search, search.pruned(models[-1]))
        if last.effects and last.effects != models[-1].effects:
            self._note(last)
        return [*models, last]

    def _note(self, fit: Fit) -> None:
        self.steps.append((" + ".join(fit.effects), rms_of(self.search.judge, fit)))


def _least(search: Search, fits: list[Fit]) -> float:
    """The least that one of these leaves, in noise floors."""
    return min(rms_of(search.judge, f) for f in fits)


def _on_another_way(selection: EffectSelection, current: Fit) -> Fit | None:
    """A pair with another leading effect than those of a model that grows no more, where that does better; None: none.

    What leads alone may make up for two effects at once: an upper tank that cannot rise, for its overflow and for the
    limit of the lower one. Where it leaves so much that it will not be named, what does nothing alone may lead, too.
    """
    search, singles = selection.search, selection.singles
    criterion = search.criterion
    if not criterion.roams or not current.effects or len(current.effects) > 2:
        return None
    others = [m for m, f in singles.items() if criterion.accepts(search.base, f)]
    others.sort(key=lambda m: criterion.order(singles[m]))
    was, now = (rms_of(search.judge, f) for f in (search.base, current))
    if not LEAVES_A_QUARTER.verdict(Remainder(was, now, now, len(current.effects))).holds:
        others = selection.leaders([m for m in selection.ranked if m not in criterion.left_out], 2)
    else:
        others = [m for m in others if m not in (*current.effects, *criterion.left_out)][:PAIR_LEADERS]
    names = [e.name for e in search.stage.effects if e.name not in criterion.left_out]
    pairs = [f for o in others for f in search.best_of([(o, m) for m in names if m != o])[:1]]
    pairs = [f for f in pairs if set(f.effects) != set(current.effects) and criterion.accepts(current, f)]
    return min(pairs, key=criterion.order, default=None)


def extend_stage(
    stage: Stage,
    effects: tuple[str, ...],
    tick: Callable[[], None] | None = None,
    judged: Judged = LikelihoodAcceptance,
) -> StageDiagnosis:
    """Fit a stage with exactly these effects, one added after the other; ``tick`` is called after each fit.

    The result's steps are the waterfall: nominal model, each effect, the error of the model's own numerical step.
    Errors are held-out.
    Raises StageError for an effect that the stage does not have.
    """
    for e in effects:
        if all(e != x.name for x in stage.effects):
            raise StageError(
                f"subsystem {stage.name!r} has no effect {e!r}; it has {', '.join(x.name for x in stage.effects)}"
            )

    return _whenever(stage, None, judged, partial(_extended, effects=effects, tick=tick, judged=judged))


def _extended(
    stage: Stage, effects: tuple[str, ...], tick: Callable[[], None] | None, judged: Judged
) -> StageDiagnosis:
    """`extend_stage` with effects that act all along, or from the stage's onset on."""

    def ask(floor: Array, _: bool) -> tuple[Fit, Said]:
        judge = LeastSquaresProblem(stage, floor)
        search = Search(judged(judge), tick)
        search.singles(effects)
        order: tuple[str, ...] = ()
        steps = [("nominal", rms_of(judge, search.base))]
        while len(order) < len(effects):
            order = search.best_of([(*order, e) for e in effects if e not in order])[0].effects
            steps.append((f"+ {order[-1]}", rms_of(judge, search.joined(order))))
        fit = search.criterion.spared(search.joined(order))
        return fit, (search, fit, [], steps)

    search, fit, _, steps = _down_to(stage, floor_of(stage), ask)
    judge = search.judge
    if stage.finer is not None:
        d = judge.errors(fit.theta[None]) - judge._whiten(stage.finer(fit.theta[None]))
        numerical = float(np.sqrt(np.sum(d * d) / max(judge.n, 1)))
        steps.append(("without numerical error", float(np.sqrt(max(rms_of(judge, fit) ** 2 - numerical**2, 0.0)))))
    verdict = "missing" if effects else "none"
    without = {e: search.joined(tuple(m for m in effects if m != e)) for e in effects}
    return answer_of(judge, verdict, search.base, fit, found_of(judge, fit, effects, without), steps)
