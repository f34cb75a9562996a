"""Acceptance for a model that will not come down to its sensors' noise: by what an effect does to the held-out error.

On real data small effects that nobody models dominate what is left. A threshold in noise floors or in log-likelihood
then "finds" everything, since the errors of a wrong model are large, correlated and alike from sample to sample. The
rules are therefore shares, block by block (`identification.selection.rules`: `UNKNOWN_NOISE`, `OTHER_LOGS`). Shares of
each block's own error give a block of small motion, which is wrong by a constant that suits the large motions, the same
weight as these.

Sets of effects are ordered by `score`: the mean of the log error over all samples and of the log errors of the blocks,
and 1 % for every parameter.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np

from vaneloop.identification.least_squares.problem import Fit, LeastSquaresProblem
from vaneloop.identification.regimes import agrees
from vaneloop.identification.results import Candidate, Found, StageDiagnosis, answer_of, at_bound, parameters_of, rms_of
from vaneloop.identification.selection.rules import (
    AWAY,
    HARMS_NONE,
    LEAVES_A_QUARTER,
    OTHER_LOGS,
    UNKNOWN_NOISE,
    Comparison,
    Decisions,
    LogChanges,
    Remainder,
)
from vaneloop.identification.settings import BETTER, FORM, PER_PARAMETER, RIVAL, STRUCTURE, UNKNOWN
from vaneloop.identification.subsystem import Array

if TYPE_CHECKING:
    from vaneloop.identification.selection.search import Search

__all__ = ["RelativeErrorAcceptance", "score", "structure"]


Figures = Callable[[Array], Mapping[str, float]]  # parameters -> log -> log of its RMS error


def _levels(judge: LeastSquaresProblem, fit: Fit) -> tuple[Array, Array]:
    """Held-out sum of squares of every block, not below its noise, and the number of samples."""
    use = judge.samples > 0
    m = judge.samples[use].astype(float)
    return np.maximum(fit.held_out[use], m), m


def score(judge: LeastSquaresProblem, fit: Fit, blocks: Array | None = None) -> float:
    """Log of the held-out error, half over all samples, half over the blocks; less is better. ``blocks``: a resampling
    of them. Near a noise that is known: of the error itself, in its stage's ``grain``.
    """
    if judge.stage.grain < 1.0:
        log_error = 0.5 * float(np.log(fit.held_out.sum() / max(judge.n, 1)))
        return log_error / judge.stage.grain + PER_PARAMETER * len(fit.free)
    s, m = _levels(judge, fit)
    if blocks is not None:
        s, m = s[blocks], m[blocks]
    return (
        0.25 * float(np.log(s.sum() / m.sum())) + 0.25 * float(np.mean(np.log(s / m))) + PER_PARAMETER * len(fit.free)
    )


class RelativeErrorAcceptance:
    """The criterion (`identification.selection.search.Criterion`).

    figures  function from parameters to the log of the RMS error on each log, fitted or not
    tests    names of those that are not fitted: they veto what harms them, and choose among rivals
    """

    most, leaders, fitted, finished, least, roams = 6, 4, 8, 3, 0.0, True

    def __init__(self, judge: LeastSquaresProblem, figures: Figures | None = None, tests: frozenset[str] = frozenset()):
        self.judge, self.figures, self.tests = judge, figures, tests
        self.form = 0.0
        self.notes: list[str] = []
        self.left_out: dict[str, str] = {}  # effect that helped -> why it is not named
        self.decisions = Decisions()

    def begin(self, base: Fit) -> None:
        """Note what the laws are to explain: their form is known to a share of it."""
        self.form = FORM * rms_of(self.judge, base)

    def learn(self, fit: Fit) -> None:
        """Nothing: the errors are not compared with noise."""

    def order(self, fit: Fit) -> float:
        """The score; of equal ones the first in the library, which begins with the plainest, is taken."""
        return round(score(self.judge, fit), 4)

    def fails(self, fit: Fit) -> bool:
        """Whether there is any error beyond the samples' noise."""
        return not agrees(rms_of(self.judge, fit), 1.0)

    def shows(self, reach: float) -> bool:
        """Every effect that changes an output at all can be seen."""
        return reach > 0.0

    def accepts(self, before: Fit, after: Fit) -> bool:
        """Whether the evidence is good."""
        if after is before:
            return False
        case = Comparison(self.judge, before, after, form=self.form)
        return self.decisions.decide((*UNKNOWN_NOISE, AWAY), case, after.effects, before.effects)

    def gain(self, before: Fit, after: Fit) -> tuple[float, float]:
        """Per cent of the held-out error; share of the change that is improvement."""
        judge = self.judge
        per_cent = 100.0 * (1.0 - rms_of(judge, after) / max(rms_of(judge, before), 1e-300))
        return per_cent, Comparison(judge, before, after).share_improved

    # ---- the best model ----------------------------------------------------------------------------------------------

    def settle(self, search: Search, fit: Fit) -> Fit:
        """The model with effects exchanged for better and for simpler ones, and without what is not needed."""
        names = [e.name for e in self.judge.stage.effects if e.name not in self.left_out]
        return self._harmless(search, self._simpler(search, self._swapped(search, fit, names), names))

    def _swapped(self, search: Search, fit: Fit, names: list[str]) -> Fit:
        """Exchange one effect for another where that is better: what was right first need not be right last. One with
        more parameters must be worth them, and one that others make needless brings nothing.
        """
        for _ in range(2):
            best = fit
            for drop in fit.effects:
                rest = tuple(e for e in fit.effects if e != drop)
                options = search.best_of([(*rest, n) for n in names if n not in fit.effects])
                better = [
                    f for f in options if self.order(f) < self.order(best) - BETTER and not self._leaves_more(best, f)
                ]
                best = next((f for f in better if len(f.free) <= len(best.free) or self.accepts(best, f)), best)
            needed = search.pruned(best)
            if self.order(needed) >= self.order(fit) or self._leaves_more(fit, needed):
                return fit
            fit = needed
        return fit

    def _leaves_more(self, before: Fit, after: Fit) -> bool:
        """Whether a set leaves clearly more of the whole log, however well it does in blocks where little moves."""
        return rms_of(self.judge, after) > np.exp(RIVAL) * rms_of(self.judge, before)

    def _simpler(self, search: Search, fit: Fit, names: list[str]) -> Fit:
        """Exchange an effect of many parameters for one or two with fewer in all, where it is not worth the difference:
        a flexible law stands in for whatever bends.
        """
        size = {e.name: len(e.parameters) for e in self.judge.stage.effects}
        for drop in [e for e in fit.effects if size[e] > 1]:
            rest = search.joined(tuple(e for e in fit.effects if e != drop))
            free = [n for n in names if n not in rest.effects and size[n] < size[drop]]
            one = [f for f in search.best_of([(*rest.effects, n) for n in free]) if self.accepts(rest, f)]
            single = [n for n in free if size[n] == 1] if size[drop] > 2 else []
            two = [
                g
                for f in [f for f in one if f.effects[-1] in single][:2]
                for g in search.best_of([(*f.effects, n) for n in single if n not in f.effects])
                if self.accepts(f, g)
            ]
            held = search.simpler(fit, drop)
            options = [f for f in (*one, *two, *held) if len(f.free) < len(fit.free) and not self.accepts(f, fit)]
            if options:
                fit = min(options, key=self.order)
        return fit

    def _harmless(self, search: Search, fit: Fit) -> Fit:
        """Take out what makes a test log clearly worse, and what no log is better for."""
        while self.figures is not None and fit.effects:
            with_it = self.figures(fit.theta)
            for name in fit.effects:
                without = search.without(fit, name)
                change = {log: with_it[log] - v for log, v in self.figures(without.theta).items() if log in with_it}
                case = LogChanges(change, self.tests)
                if self.decisions.decide(OTHER_LOGS, case, fit.effects, without.effects):
                    continue
                self.left_out[name] = case.objection()
                self.notes.append(f"{name} fits, but is not named: {self.left_out[name]}")
                fit = without
                break
            else:
                break
        return self._harmless_together(search, fit)

    def _harmless_together(self, search: Search, fit: Fit) -> Fit:
        """The model without any effect where all of them together make a validation log worse: taken out one at a time,
        each may look needed to make up for another.
        """
        if self.figures is None or not fit.effects:
            return fit
        base, with_them = self.figures(search.base.theta), self.figures(fit.theta)
        change = {log: with_them[log] - v for log, v in base.items() if log in with_them}
        case = LogChanges(change, self.tests)
        if self.decisions.decide([HARMS_NONE], case, fit.effects, ()):
            return fit
        named = " + ".join(fit.effects)
        self.left_out |= dict.fromkeys(fit.effects, case.objection())
        self.notes.append(f"{named} fits, but is not named: {case.objection()}")
        return search.base

    def spared(self, fit: Fit) -> Fit:
        """Set to zero what the model itself does not need any more: coefficients not below 0 that only stood in for
        what was missing.
        """
        judge = self.judge
        for k, p in enumerate(judge.stage.parameters if fit.effects else ()):
            if p.low == 0.0 and p.tolerance > 0 and p.value - p.tolerance <= 0.0 and fit.theta[k] != 0.0:
                judge.spared.add(k)
                theta = fit.theta.copy()
                theta[k] = 0.0
                less = judge.fit(fit.effects, theta, 12)
                if self.accepts(less, fit):
                    judge.spared.discard(k)
                else:
                    fit = less
        return fit

    def _sizes(self) -> dict[str, int]:
        """How many numbers of each effect say how much of it there is."""
        return {e.name: sum(not p.shape for p in e.parameters) for e in self.judge.stage.effects}

    # ---- names -------------------------------------------------------------------------------------------------------

    def name(self, search: Search, fit: Fit, candidates: list[Candidate]) -> tuple[list[Found], Fit]:
        """Each effect with those that would do as well in its place, and how often it wins over resampled blocks; test
        logs decide between rivals that the fitted ones cannot tell apart.
        """
        names = [e.name for e in self.judge.stage.effects if e.name not in self.left_out]
        found = self._named(search, fit, names)
        decided = False
        for f in found if self.tests and self.figures is not None else ():
            rest = tuple(e for e in fit.effects if e != f.effect)
            for other in f.rivals:
                trial = self.spared(search.joined((*rest, other)))
                if self._tested(trial) < self._tested(fit) - RIVAL:
                    self.notes.append(
                        f"{f.effect} and {other} do equally well on the fitted log; the test logs prefer {other}"
                    )
                    search.fits[frozenset(trial.effects)] = trial
                    fit, decided = trial, True
        return (self._named(search, fit, names) if decided else found), fit

    def _tested(self, fit: Fit) -> float:
        """Mean log error on the test logs."""
        assert self.figures is not None
        return float(np.mean([v for log, v in self.figures(fit.theta).items() if log in self.tests] or [0.0]))

    def _named(self, search: Search, fit: Fit, names: list[str]) -> list[Found]:
        judge, stage = self.judge, self.judge.stage
        count = int(np.sum(judge.samples > 0))
        draws = np.random.default_rng(0).integers(0, count, (400, count))
        size = self._sizes()
        out = []
        for name in fit.effects:
            rest_names = tuple(e for e in fit.effects if e != name)
            rest = search.joined(rest_names)
            alternatives = {name: fit}
            tried = search.best_of([(*rest_names, n) for n in names if n not in fit.effects])
            holding = [n for n in names if any(held == name for held, _ in stage.effect(n).holds)]
            for f in (*tried, *(search.joined((*rest_names, n)) for n in holding if n not in fit.effects)):
                alternatives[next(e for e in f.effects if e not in rest_names)] = f
            mine = score(judge, fit)
            # what has more parameters and does no better holds the named effect within it
            alternatives = {m: f for m, f in alternatives.items() if m == name or size[m] <= size[name]}
            # a law that holds the named one within it is that one at some of its sizes: no log could tell them apart
            same = [m for m in holding if m in alternatives and judge.total_of(alternatives[m]) <= judge.total_of(fit)]
            rivals = [
                m for m, f in alternatives.items()
                if m != name and (m in same or (score(judge, f) < mine + RIVAL and self.accepts(rest, f)))
            ]  # fmt: skip
            others = [f for m, f in alternatives.items() if m == name or m not in rivals]
            wins = np.mean(np.argmin([[score(judge, f, d) for d in draws] for f in others], axis=0) == 0)
            share = float(wins) / (1.0 + len(rivals))
            gained = float(rest.held_out.sum() - fit.held_out.sum())
            shares = {name: share} | dict.fromkeys(rivals, share)
            fall = rms_of(judge, rest) / max(rms_of(judge, fit), 1e-300)
            out.append(Found(name, share, parameters_of(stage, fit, name), rivals, gained, alternatives, shares, fall))
        return out

    def conclude(
        self, base: Fit, fit: Fit, effects: list[Found], candidates: list[Candidate], steps: list[tuple[str, float]]
    ) -> StageDiagnosis:
        """Missing what was found; else unknown where the error left is more than noise, or follows from what was
        logged; or none.
        """
        judge, stage = self.judge, self.judge.stage
        left = rms_of(judge, fit)
        unknown = left > UNKNOWN or (not agrees(left, 1.0) and structure(judge, fit) > STRUCTURE)
        for f in effects:
            if at_bound(stage, fit, f.effect):
                self.notes.append(f"{f.effect} stands at the end of its physical range: the log would have it go on")
        remainder = Remainder(rms_of(judge, base), left, left, len(effects))
        poor = bool(effects) and not self.decisions.decide([LEAVES_A_QUARTER], remainder, fit.effects, ())
        verdict = "missing" if effects and not poor else "unknown" if unknown or poor else "none"
        if poor:  # no name rather than a poor one
            out = answer_of(judge, verdict, base, base, [], steps, candidates)
            out.nearest = list(dict.fromkeys(m for f in effects for m in (f.effect, *f.rivals)))[:3]
            named = " + ".join(f.effect for f in effects)
            out.refused = [f"{named} comes nearest and leaves {np.sqrt(remainder.share_left):.0%} of the error"]
        else:
            out = answer_of(judge, verdict, base, fit, effects, steps, candidates)
        out.criterion, out.decisions = "error_share", list(self.decisions)
        out.notes, out.gain = self.notes, "fall of the held-out error [%]"
        return out


def structure(judge: LeastSquaresProblem, fit: Fit) -> float:
    """Share of the remaining error that present and past inputs and outputs predict on blocks that the prediction was
    not fitted to.

    A linear regression on the logged channels, their magnitudes, signs and squares, now and at some past times. What a
    correct model leaves is not predicted by what it was driven with.
    """
    stage = judge.stage
    e = judge.errors(fit.theta[None])[0]
    features = []
    for name, v in stage.regimes.items():
        if name in ("time", "log") or name in stage.outputs:
            continue
        v = np.where(np.isfinite(v), v, 0.0)
        z = (v - v.mean()) / (v.std() or 1.0)
        for lag in (0, 1, 3, 10, 30, 100):
            if lag > len(z) // 20:
                continue
            w = np.concatenate([np.full(lag, z[0]), z[: len(z) - lag]])
            features += [w, np.abs(w), w * w, np.sign(w) * np.sqrt(np.abs(w))]
    if not features:
        return 0.0
    x = np.array([*features, np.ones(len(stage.t))]).T
    total = left = 0.0
    for k in range(len(e)):
        use = judge.valid[k]
        for fold in range(4):
            train, test = use & (judge.block_of % 4 != fold), use & (judge.block_of % 4 == fold)
            if not test.any() or train.sum() < 3 * x.shape[1]:
                continue
            a = x[train].T @ x[train]
            a += 1e-3 * np.diag(np.diag(a)) + 1e-9 * np.eye(len(a))
            c = np.linalg.solve(a, x[train].T @ e[k, train])
            total += float(np.sum(e[k, test] ** 2))
            left += float(np.sum((e[k, test] - x[test] @ c) ** 2))
    return max(0.0, 1.0 - left / total) if total > 0 else 0.0
