"""A law that nobody listed: where it acts, of which quantity it is a function, and its curve.

Every place of the model is tried with every quantity that the logs or the model know. The slopes of a curve's functions
at the model as it is say what each could do, one linear solve a candidate; the most promising are fitted inside the
simulation, with the model's own parameters. What earns a curve its place is what earns it for a law with a name
(`vaneloop.discrepancy.error_share`): the error of blocks that it was not fitted to, and no harm to a test log. Beside
laws with names it must do clearly better than the best of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from vaneloop.discrepancy.curves import basis_of
from vaneloop.discrepancy.error_share import (
    BETTER,
    HARM,
    LEAST_USE,
    MOST_LEFT,
    RIVAL,
    UNKNOWN,
    ErrorShare,
    score,
    worth,
)
from vaneloop.discrepancy.fit import Fit, Judge
from vaneloop.discrepancy.locate import agrees
from vaneloop.discrepancy.models.curved import Candidate
from vaneloop.discrepancy.models.quantities import DISTANCE, SINCE, TIME, WAY
from vaneloop.discrepancy.models.runner import Placed
from vaneloop.discrepancy.promise import Slopes
from vaneloop.discrepancy.stage import Array, Effect, Stage
from vaneloop.discrepancy.stage_answer import StageDiagnosis, rms_of

__all__ = ["Ground", "Learner", "Outcome", "Placings", "Tried"]

MOST_CURVES = 2
WIGGLES = (0.1, 1.0, 5.0)  # standard deviations of a curve's first bend, in its usual size, that are tried
SCREENED = 1.0  # of them, where candidates are screened
QUICK, FINISHED = 24, 5  # candidates that are fitted for a few steps, and of these to the end
DAMPED = (0.003, 0.03, 0.3)  # of the diagonal of the slopes' equations: their steps are simulated
FINER, SPLINES = 2, 28  # finalists that are fitted with so many splines where the best still fails
Placings = tuple[tuple[Placed, Effect], ...]


class Ground(Protocol):
    """What curves are learned on: one stage of a model, held against logs.

    whole  the stage with all laws of the library as effects; ``floor``: noise of its outputs
    tests  names of the logs that nothing is fitted to
    """

    whole: Stage
    floor: Array
    tests: frozenset[str]

    def stage(self, laws: Sequence[str], curves: Placings, quick: bool = False) -> Stage:
        """The same stage with only these laws of the library, and these curves, as effects; ``quick``: on as many
        samples as tell which candidates to fit.
        """

    def candidates(self, theta: Array) -> list[Candidate]:
        """Every curve that may be missing, at parameters ``theta`` of a stage without any."""

    def figures(self, curves: Placings, theta: Array) -> dict[str, Array]:
        """RMS error of each output, log by log, test logs too."""


@dataclass
class Tried:
    """A curve fitted beside the model, and curves before it.

    curves  each as it runs and as the search has it, the new one last
    told    the fit of the curve with the mean and slope that it was found with, where the logs do not tell them
    """

    candidate: Candidate
    wiggle: float
    judge: Judge
    fit: Fit
    curves: Placings
    told: Fit | None = None


@dataclass
class Outcome:
    """What learning says.

    verdict  learned; named: laws of the library do as well; none: nothing is missing; unknown: no honest law is there
    tried    the model with its curves, curve by curve; ``rivals``: candidates that do as well in the last one's place
    nearest  the candidates that come nearest, where nothing was learned
    why      in words, where nothing was learned
    """

    verdict: str
    tried: list[Tried] = field(default_factory=list)
    rivals: list[list[str]] = field(default_factory=list)
    nearest: list[str] = field(default_factory=list)
    why: str = ""
    notes: list[str] = field(default_factory=list)


def _strange(candidate: Candidate) -> int:
    """Which of several candidates that do as well is meant: the lower, the plainer.

    What is at a place itself is plainer than what another signal says of it. Reversals follow from every quantity that
    turns, and time from every one that drifts.
    """
    name = candidate.quantity.name
    if name == candidate.at.removesuffix("_sensor").rpartition(".")[2] or candidate.near:
        return 0
    if name.startswith((WAY, DISTANCE, SINCE)):
        return 3
    return 2 if name == TIME else 1


def held_out(cost: Array, gradients: Array, normals: Array, mine: Array, prior: Array, deviation: Array) -> Array:
    """Cost of each block with a curve's parameters (``mine``, of all free ones) fitted to the other blocks, within its
    prior. All in the parameters' scales.
    """
    g, a = gradients[:, mine], normals[:, mine][:, :, mine]
    p = prior[mine]
    pull = g.sum(axis=0) - p * deviation[mine]
    total = a.sum(axis=0) + np.diag(p + 1e-9 * np.maximum(np.diag(a.sum(axis=0)), 1e-12))
    step = np.linalg.solve(total - a, (pull - g)[:, :, None])[:, :, 0]
    out = cost - 2.0 * np.sum(step * g, axis=1) + np.einsum("bi,bij,bj->b", step, a, step)
    return np.asarray(np.maximum(out, 0.5 * cost))


def with_held_out(judge: Judge, fit: Fit) -> Fit:
    """The fit with the held-out errors of its curves within their priors."""
    scale = judge.scale[fit.free]
    mine = fit.free >= len(judge.stage.parameters)
    if not mine.any():
        return fit
    deviation = (fit.theta - judge.stage.neutral())[fit.free] / scale
    held = held_out(fit.cost, fit.gradients, fit.normals, mine, fit.prior * scale**2, deviation)
    return replace(fit, held_out=held)


class Learner:
    """The search for curves on one stage.

    ground    the stage on its logs
    d         what `diagnose` says of it
    progress  called with the share that is done
    """

    def __init__(self, ground: Ground, d: StageDiagnosis, progress: Callable[[float], None] | None = None):
        self.ground, self.d, self.progress = ground, d, progress or (lambda _: None)
        self.judge = self._judge((), ())
        self.base = self.judge.fit((), d.base.theta[: len(self.judge.stage.parameters)], 4)
        self.form = ErrorShare(self.judge)
        self.form.begin(self.base)
        self.candidates = ground.candidates(self.base.theta)

    def _judge(self, laws: Sequence[str], curves: Placings, quick: bool = False) -> Judge:
        return Judge(self.ground.stage(laws, curves, quick), self.ground.floor)

    def learned(self) -> Outcome:
        """Curves one after the other, each earning its place; at most two."""
        out = Outcome("none")
        if not self.form.fails(self.base):
            out.why = "the model comes down to the noise of its samples: nothing is missing"
            return out
        named = self._named()
        if named is not None and self.d.effects and agrees(rms_of(*named), 1.0):
            out.verdict = "named"
            out.why = f"{' + '.join(self.d.final.effects)} of the library leaves nothing but noise"
            return out
        current = Tried(self.candidates[0], 0.0, self.judge, self.base, ()) if self.candidates else None
        fit = self.base
        while current is not None and len(out.tried) < MOST_CURVES and self.form.fails(fit):
            finalists = self._finalists(current)
            out.nearest = out.nearest or [t.candidate.name for t in finalists[:3]]
            good = [t for t in finalists if self._earns(fit, t)]
            if not good:
                break
            near = [t for t in good if score(self.judge, t.fit) < score(self.judge, good[0].fit) + RIVAL]
            best = min(near, key=lambda t: (_strange(t.candidate), t.candidate.how.endswith("times")))
            why = self._harmful(current, best)
            if why:
                out.notes.append(f"{best.candidate.name} fits, but is not learned: {why}")
                break
            limit = score(self.judge, best.fit) + RIVAL
            out.rivals.append([t.candidate.name for t in good if t is not best and score(self.judge, t.fit) < limit])
            best = self._settled(current, best)
            out.tried.append(best)
            current, fit = best, best.fit
        return self._concluded(out, named)

    def _named(self) -> tuple[Judge, Fit] | None:
        """The best laws of the library, fitted with their held-out errors, where there are any."""
        effects = self.d.final.effects or tuple(self.d.nearest[:1])
        if not effects:
            return None
        judge = self._judge(effects, ())
        theta = judge.stage.neutral()
        whole, part = self.ground.whole.index(), judge.stage.index()
        theta[: len(self.base.theta)] = self.d.final.theta[: len(self.base.theta)]
        for e in effects:
            if self.d.final.effects:
                theta[part[e]] = self.d.final.theta[whole[e]]
            else:
                theta[part[e]] = self.ground.whole.effect(e).starts[0]
        return judge, judge.fit(effects, theta, 8)

    def _concluded(self, out: Outcome, named: tuple[Judge, Fit] | None) -> Outcome:
        if not out.tried:
            out.verdict = "named" if self.d.effects else "unknown"
            out.why = "no curve of one quantity, at any place, explains enough of the error on data left out"
            return out
        last = out.tried[-1]
        left, was = rms_of(last.judge, last.fit), rms_of(self.judge, self.base)
        share = max(left**2 - 1.0, 0.0) / max(was**2 - 1.0, 1e-300)
        if left > UNKNOWN and share > MOST_LEFT:
            out.verdict, out.why = "unknown", f"the best curve leaves {np.sqrt(share):.0%} of the error"
        elif named is not None and self.d.effects and not worth(self.judge, named[1], last.fit, self.form.form).good:
            out.verdict = "named"
            out.why = f"{' + '.join(self.d.final.effects)} of the library does as well, or nearly"
        else:
            out.verdict = "learned"
        return out

    def _earns(self, before: Fit, tried: Tried) -> bool:
        return worth(self.judge, before, tried.fit, self.form.form).good

    def _settled(self, current: Tried, best: Tried) -> Tried:
        """The curve without mean, without slope, or without both, where the logs do not tell them from the model's own
        parameters.

        Along such a valley a fit ends anywhere; here it ends where the parameters say all that they can.
        """
        whole = best.candidate
        found = dict(zip(whole.kept, best.fit.theta[best.judge.stage.index()[whole.name]], strict=True))
        nominal = [current.fit.theta, best.fit.theta[: len(current.fit.theta)]]
        for untold in ((0, 1), (1,), (0,)):
            c = replace(whole, untold=untold)
            if len(c.kept) == len(whole.kept) or not c.kept:
                continue
            bends = [found[k] for k in c.kept]
            fits = [self._fitted(current, c, best.wiggle, np.concatenate([n, bends]), 16) for n in nominal]
            simpler = min(fits, key=lambda t: score(self.judge, t.fit))
            if score(self.judge, simpler.fit) <= score(self.judge, best.fit) + BETTER:
                return replace(simpler, told=best.fit)
        return best

    # ---- candidates --------------------------------------------------------------------------------------------------

    def _finalists(self, current: Tried) -> list[Tried]:
        """The candidates that promise most, fitted; best first."""
        quick = []
        for k, (_, candidate, theta) in enumerate(self._screened(current)[:QUICK]):
            quick.append(self._fitted(current, candidate, SCREENED, theta, 3, True))
            self.progress((k + 1.0) / (QUICK + FINISHED + 1.0))
        quick.sort(key=lambda t: score(t.judge, t.fit))
        done = []
        for k, t in enumerate(quick[:FINISHED]):
            options = [self._fitted(current, t.candidate, w, t.fit.theta, 12) for w in WIGGLES]
            done.append(min(options, key=lambda o: score(self.judge, o.fit)))
            self.progress((QUICK + k + 1.0) / (QUICK + FINISHED + 1.0))
        done.sort(key=lambda t: score(self.judge, t.fit))
        if done and self.form.fails(done[0].fit):  # a curve may turn more often than its splines
            finer = [f for t in done[:FINER] if (f := self._finer(current, t)) is not None]
            done = sorted([*done, *finer], key=lambda t: score(self.judge, t.fit))
            best = {t.candidate.name: t for t in reversed(done)}
            done = [t for t in done if best[t.candidate.name] is t]
        return done

    def _finer(self, current: Tried, coarse: Tried) -> Tried | None:
        """The same curve with `SPLINES` splines."""
        c = coarse.candidate
        basis = basis_of(c.quantity.visited, SPLINES)
        if basis is None or len(basis.bend) <= len(c.basis.bend):
            return None
        fine = replace(c, basis=basis)
        curve = c.basis.design(fine.grid) @ (c.turn @ coarse.fit.theta[coarse.judge.stage.index()[c.name]])
        amplitudes = np.linalg.lstsq(basis.design(fine.grid) @ fine.turn, curve, rcond=None)[0]
        theta = np.concatenate([coarse.fit.theta[: coarse.judge.stage.index()[c.name].start], amplitudes])
        return self._fitted(current, fine, WIGGLES[-1], theta, 12)

    def _fitted(
        self, current: Tried, candidate: Candidate, wiggle: float, theta: Array, iterations: int, quick: bool = False
    ) -> Tried:
        curves: Placings = (*current.curves, (candidate.placed(), candidate.effect(wiggle)))
        judge = self._judge((), curves, quick)
        names = tuple(e.name for _, e in curves)
        fit = with_held_out(judge, judge.fit(names, theta, iterations))
        return Tried(candidate, wiggle, judge, fit, curves)

    def _screened(self, current: Tried) -> list[tuple[float, Candidate, Array]]:
        """Each candidate with what it would leave, and parameters to begin from; best first."""
        quick = self._judge((), current.curves, True)
        slopes = Slopes(quick, current.fit.theta, current.fit.free, current.fit.prior)
        have = {q.effect for q, _ in current.curves}
        out = [self._promise(current, c, slopes) for c in self.candidates if c.name not in have]
        return sorted(out, key=lambda o: o[0])

    def _promise(self, current: Tried, candidate: Candidate, slopes: Slopes) -> tuple[float, Candidate, Array]:
        """What a candidate leaves, in the simulation, after one step by the slopes, as damped as suits it best.

        Far from the truth slopes say nothing of data left out: that is asked when the candidate has been fitted.
        """
        fit = current.fit
        effect = candidate.effect(SCREENED)
        judge = self._judge((), (*current.curves, (candidate.placed(), effect)), True)
        theta = np.concatenate([fit.theta, np.zeros(len(effect.parameters))])
        own = np.arange(len(fit.theta), len(theta))
        moved, derivative = judge._differences(theta, own, judge.scale[own], judge.bounds()[1], slopes.error)
        rows = np.concatenate([slopes.jac, derivative(judge.errors(moved))[1]])
        _, gradients, normals = judge._blocks(slopes.error, rows)
        free = np.concatenate([fit.free, own])
        scale = judge.scale[free]
        tolerance = np.array([p.tolerance for p in effect.parameters])
        prior = np.concatenate([fit.prior, 3.0 / tolerance**2]) * scale**2
        deviation = (theta - judge.stage.neutral())[free] / scale
        a, g = normals.sum(axis=0) + np.diag(prior + 1e-9), gradients.sum(axis=0) - prior * deviation
        trials = np.repeat(theta[None], len(DAMPED), axis=0)
        low, high = judge.bounds()
        for row, damping in zip(trials, DAMPED, strict=True):
            step = np.linalg.solve(a + damping * np.diag(np.diag(a)), g)
            row[free] = np.clip(row[free] + step * scale, low[free], high[free])
        left = judge.totals(judge.errors(trials), trials)
        k = int(np.argmin(left))
        return float(left[k]), candidate, trials[k]

    # ---- other logs --------------------------------------------------------------------------------------------------

    def _harmful(self, before: Tried, tried: Tried) -> str:
        """Why the logs speak against a curve; "": they do not."""
        floor = self.ground.floor

        def levels(of: Tried) -> dict[str, float]:
            by = self.ground.figures(of.curves, of.fit.theta)
            good = {log: v for log, v in by.items() if np.isfinite(v).all()}
            return {log: float(np.log(np.maximum(v / floor, 1.0)).mean()) for log, v in good.items()}

        was, now = levels(before), levels(tried)
        tests = self.ground.tests
        change = {log: now[log] - was[log] for log in was if log in now}
        worst = max((log for log in change if log in tests), key=lambda log: change[log], default=None)
        if worst is not None and change[worst] > HARM:
            return f"makes {worst} worse: {np.exp(change[worst]):.2f} times the error"
        if change and min(change.values()) > -LEAST_USE:
            return f"no log is better by {LEAST_USE:.0%} for it"
        return ""
