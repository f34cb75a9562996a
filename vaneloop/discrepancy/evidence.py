"""What is a user's own model missing? The fits of `vaneloop.discrepancy.diagnose`, judged against what the best model
leaves, not a noise floor.

On real data no model reaches the sensor's noise: small effects that nobody models dominate what is left. A threshold in
noise floors or in nats then "finds" everything, since the errors of a wrong model are large, correlated and alike from
sample to sample. So a law must earn its place by what it does to the *held-out error itself*, block by block (blocks as
in `vaneloop.discrepancy.fit`):

- `LEAST_FALL`: the held-out sum of squares falls by at least this share;
- `LEAST_HELP`: of all relative change, block by block, at least this share is improvement. Relative, so that a block of
  small motion, which is wrong by a constant that suits the large motions, counts as much as they do;
- at least two blocks agree.

The order in which sets of laws are preferred is `score`: the mean of the log error over all samples and of the log
errors of the blocks, and 1 % for every parameter.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from vaneloop.discrepancy.diagnose import (
    Candidate,
    Found,
    StageDiagnosis,
    found_of,
    parameters_of,
    recalibrated,
    rms_per_output,
)
from vaneloop.discrepancy.fit import Fit, Judge
from vaneloop.discrepancy.locate import agrees
from vaneloop.discrepancy.stage import Array, Stage

__all__ = ["LEAST_FALL", "Explorer", "diagnose_system", "extend_system", "noise_of_channel", "structure", "worth"]

LEAST_FALL = 0.20  # share of the held-out sum of squares (10 % of the RMS) that a law must explain
LEAST_HELP = 0.75  # share of the change over the blocks that is improvement
AGREE = 0.05  # fall of a block's log mean square that counts as agreement
PER_PARAMETER = 0.01  # log error that a parameter costs when sets are compared
RIVAL = 0.05  # log error within which two laws do equally well
MOST = 6  # laws in one model
FITTED = 12  # leaders of the screening that are fitted
FINISHED = 5  # leaders of these whose fits are finished
PAIRED = 4  # leaders tried in pairs where none alone helps
STRUCTURE = (
    0.25  # share of the remaining error that the logged channels predict, from which it is called unknown physics
)


@dataclass
class Evidence:
    """What one fit gains on another, on held-out blocks.

    fall   share of the sum of squares by which it falls
    help   share of the change, block by block, that is improvement
    agree  blocks that improve
    """

    fall: float
    help: float
    agree: int

    @property
    def good(self) -> bool:
        """Whether it is enough."""
        return self.fall >= LEAST_FALL and self.help >= LEAST_HELP and self.agree >= 2


def _levels(judge: Judge, fit: Fit) -> tuple[Array, Array]:
    """Held-out sum of squares of every block, not below the noise, and the number of samples."""
    use = judge.samples > 0
    m = judge.samples[use].astype(float)
    return np.maximum(fit.held_out[use], m), m


def worth(judge: Judge, before: Fit, after: Fit) -> Evidence:
    """Evidence for ``after`` against ``before``."""
    (a, _), (b, _) = _levels(judge, before), _levels(judge, after)
    r = np.log(a / b)
    change = float(np.abs(r).sum())
    fall = 1.0 - float(b.sum() / a.sum())
    helps = float(np.maximum(r, 0.0).sum()) / change if change > 0 else 0.0
    return Evidence(fall, helps, int(np.sum(r > AGREE)))


def score(judge: Judge, fit: Fit, blocks: Array | None = None) -> float:
    """Log of the held-out error, half over all samples, half over the blocks; less is better. ``blocks``: a resampling
    of them.
    """
    s, m = _levels(judge, fit)
    if blocks is not None:
        s, m = s[blocks], m[blocks]
    return (
        0.25 * float(np.log(s.sum() / m.sum())) + 0.25 * float(np.mean(np.log(s / m))) + PER_PARAMETER * len(fit.free)
    )


class _Judge(Judge):
    """A judge that can leave out parameters of the model itself; they then stay where they are."""

    def __init__(self, stage: Stage, floor: Array):
        super().__init__(stage, floor)
        self.without: set[int] = set()

    def columns(self, effects: tuple[str, ...]) -> Array:
        return np.array([c for c in super().columns(effects) if c not in self.without], dtype=int)


class Explorer:
    """Fits of one stage with sets of laws, each made once."""

    def __init__(self, judge: _Judge, tick: Callable[[], None] | None = None, guess: Array | None = None):
        """Fit the model as it is; ``guess``: the user's own values of all parameters."""
        self.judge, self.stage, self.guess = judge, judge.stage, guess
        self.tick = tick or (lambda: None)
        self.fits: dict[frozenset[str], Fit] = {}
        self.out: set[tuple[tuple[str, ...], str]] = set()  # what the screening left out
        self.base = self._finish(judge.fit((), self.stage.neutral()))
        self.fits[frozenset()] = self.base

    def _finish(self, fit: Fit, rounds: int = 4) -> Fit:
        """Go on until the error falls no more."""
        for _ in range(rounds):
            more = self.judge.fit(fit.effects, fit.theta, 8)
            gained = fit.cost.sum() - more.cost.sum()
            if more.cost.sum() <= fit.cost.sum():
                fit = more
            if gained < 1e-3 * fit.cost.sum():
                break
        return fit

    def add(self, fit: Fit, names: list[str], finished: int = FINISHED, fitted: int = FITTED) -> list[Fit]:
        """Fits with one law more than ``fit``, best first; only the leading ones are finished."""
        names = [n for n in names if n not in fit.effects]
        known = [self.fits[key] for n in names if (key := frozenset((*fit.effects, n))) in self.fits]
        new = [n for n in names if frozenset((*fit.effects, n)) not in self.fits and (fit.effects, n) not in self.out]
        quick = []
        screened = self._screen(fit, new)
        for name in list(screened)[fitted:]:
            self.out.add((fit.effects, name))
        for name in list(screened)[:fitted]:
            effects = (*fit.effects, name)
            quick.append(
                min((self.judge.fit(effects, s, 3) for s in screened[name]), key=lambda f: float(f.cost.sum()))
            )
            self.tick()
        if not fit.effects and self.guess is not None:
            quick = self._from_guess(new, quick)
        quick.sort(key=lambda f: score(self.judge, f))
        for i, f in enumerate(quick):
            f = self._finish(f) if i < finished else f
            self.fits[frozenset(f.effects)] = f
            known.append(f)
            self.tick()
        return sorted(known, key=lambda f: score(self.judge, f))

    def _from_guess(self, names: list[str], quick: list[Fit]) -> list[Fit]:
        """Fits that start where the user's own values stand: fitted without a gross law, a model may go where no law
        helps it any more.
        """
        assert self.guess is not None
        index, best = self.stage.index(), {f.effects[-1]: f for f in quick}
        tries: list[tuple[float, int, str, Array]] = []
        for name in names:
            for s in self.stage.effect(name).starts:
                theta = self.guess.copy()
                theta[index[name]] = s
                tries.append((float(np.sum(self.judge.errors(theta[None]) ** 2)), len(tries), name, theta))
        least: dict[str, tuple[float, int, str, Array]] = {}
        for t in sorted(tries, key=lambda t: t[:2]):
            least.setdefault(t[2], t)
        for t in list(least.values())[:FINISHED]:
            f = self._finish(self.judge.fit((t[2],), t[3], 6), 2)
            if t[2] not in best or f.cost.sum() < best[t[2]].cost.sum():
                best[t[2]] = f
            self.out.discard(((), t[2]))
            self.tick()
        return list(best.values())

    def _screen(self, fit: Fit, names: list[str]) -> dict[str, list[Array]]:
        """Up to two starts for each law on top of ``fit``, the best after one linear refit of what is free already;
        best law first.
        """
        stage, judge = self.stage, self.judge
        index = stage.index()
        free = fit.free
        e0, jac = judge.linearise(fit.theta, free)
        flat = jac.reshape(len(free), e0.size)
        a = flat @ flat.T
        a += np.diag(1e-9 * np.maximum(np.diag(a), 1e-3))
        out, level = {}, {}
        for name in names:
            costs: list[tuple[float, int, Array]] = []
            for s in stage.effect(name).starts:
                theta = fit.theta.copy()
                theta[index[name]] = s
                r = judge.errors(theta[None])[0].reshape(-1)
                fall = 0.0
                if len(free):
                    pull = flat @ r
                    step = np.linalg.solve(a, pull)
                    fall = float(2.0 * step @ pull - step @ a @ step)
                costs.append((float(r @ r) - fall, len(costs), theta))
            costs.sort(key=lambda c: c[:2])
            here = float(np.sum(e0 * e0))
            near = costs[0][0] + 0.2 * max(here - costs[0][0], 0.05 * here)
            out[name] = [c[2] for c in costs[:2] if c[0] <= near]
            level[name] = costs[0][0]
        return {name: out[name] for name in sorted(out, key=lambda n: level[n])}

    def of(self, effects: tuple[str, ...]) -> Fit:
        """Fit with exactly these laws."""
        key = frozenset(effects)
        if key not in self.fits:
            tries: list[Fit] = []
            for last in effects:
                rest = tuple(e for e in effects if e != last)
                if frozenset(rest) in self.fits or not tries:
                    self.out.discard((self.of(rest).effects, last))
                    tries += [f for f in self.add(self.of(rest), [last], 1) if frozenset(f.effects) == key]
            self.fits[key] = min(tries, key=lambda f: float(f.cost.sum()))
        return self.fits[key]

    def less(self, fit: Fit, drop: str) -> Fit:
        """Fit without one law: the known one, or where the other parameters of ``fit`` lead, if that is better.

        A law that changes nothing may have shown the way out of a local minimum; it must not take the credit.
        """
        known = self.of(tuple(e for e in fit.effects if e != drop))
        at = self.stage.index()[drop]
        first, neutral = fit.theta[at], self.stage.neutral()[at]
        theta = fit.theta
        for share in (0.25, 0.5, 0.75, 1.0):  # by and by, so that the others can follow
            theta = theta.copy()
            theta[at] = first + share * (neutral - first)
            theta = self.judge.fit(known.effects, theta, 5).theta
        other = self._finish(self.judge.fit(known.effects, theta, 8), 2)
        if other.cost.sum() < 0.99 * known.cost.sum():
            self.fits[frozenset(known.effects)] = known = other
        return known


def diagnose_system(
    stage: Stage,
    floor: Array,
    tick: Callable[[], None] | None = None,
    decide: Callable[[Array], float] | None = None,
    guess: Array | None = None,
) -> tuple[StageDiagnosis, list[str]]:
    """Search all laws at all places of a user's model for what is missing; what was decided by other logs, in words.

    floor   RMS of the noise of every output, as far as its samples tell it
    decide  function from parameters to the mean log error on logs that were not fitted: it chooses among rivals that
            the fitted ones cannot tell apart, and nothing else
    guess   the user's own values of all parameters
    """
    judge = _Judge(stage, floor)
    explorer = Explorer(judge, tick, guess)
    names = [e.name for e in stage.effects]
    n = max(judge.n, 1)

    def rms(fit: Fit) -> float:
        return float(np.sqrt(fit.held_out.sum() / n))

    base = current = explorer.base
    steps = [("model", rms(base))]
    first: list[Fit] = []
    while len(current.effects) < MOST:
        singles = explorer.add(current, names)
        first = first or singles
        options = [f for f in singles if worth(judge, current, f).good]
        if not options and not current.effects:
            leaders = [f.effects[-1] for f in singles if f.effects[-1] not in current.effects][:PAIRED]
            for a, b in itertools.combinations(leaders, 2):
                f = explorer.of((*current.effects, a, b))
                if worth(judge, current, f).good and all(
                    worth(judge, explorer.of((*current.effects, one)), f).good for one in (a, b)
                ):
                    options.append(f)
        if not options:
            break
        best = min(options, key=lambda f: score(judge, f))
        best = _prune(explorer, best)
        if score(judge, best) >= score(judge, current):
            break
        current = best
        steps.append((" + ".join(current.effects), rms(current)))
    current = _spare(judge, _simpler(explorer, _swap(explorer, current, names), names))
    explorer.fits[frozenset(current.effects)] = current
    effects = _name(explorer, current, names)
    decided = []
    if decide is not None:
        for name in list(current.effects):
            rivals = next((f.rivals for f in effects if f.effect == name), [])
            rest = tuple(e for e in current.effects if e != name)
            here = decide(current.theta)
            for other in rivals:
                f = _spare(judge, explorer.of((*rest, other)))
                if decide(f.theta) < here - RIVAL:
                    decided.append(
                        f"{name} and {other} do equally well on the fitted log; the test logs prefer {other}"
                    )
                    explorer.fits[frozenset(f.effects)] = f
                    current, here = f, decide(f.theta)
        if decided:
            effects = _name(explorer, current, names)
            steps[-1] = (" + ".join(current.effects), rms(current))
    candidates = []
    for f in first:
        gained = 100.0 * (1.0 - rms(f) / max(rms(base), 1e-300))
        candidates.append(Candidate(f.effects[-1], gained, worth(judge, base, f).help))
    candidates.sort(key=lambda c: -c.nats)
    before, after = (rms_per_output(judge, f) for f in (base, current))
    share = structure(judge, current)
    verdict = "missing" if effects else "unknown" if share > STRUCTURE and not agrees(rms(current), 1.0) else "none"
    d = StageDiagnosis(
        stage=stage.name, outputs=stage.outputs, units=stage.units, verdict=verdict, floor=judge.floor, base=base,
        final=current,
        error_before=before, error_after=after, effects=effects, recalibrated=recalibrated(stage, current),
        candidates=candidates,
        correlation=1.0, steps=steps, excess=rms(current),
    )  # fmt: skip
    return d, decided


def _spare(judge: _Judge, fit: Fit) -> Fit:
    """Set to zero what the model itself does not need any more: coefficients not below 0 that only stood in for what
    was missing.
    """
    if not fit.effects:
        return fit
    for k, p in enumerate(judge.stage.parameters):
        if p.low == 0.0 and p.tolerance > 0 and p.value - p.tolerance <= 0.0 and fit.theta[k] != 0.0:
            judge.without.add(k)
            theta = fit.theta.copy()
            theta[k] = 0.0
            less = judge.fit(fit.effects, theta, 12)
            if worth(judge, less, fit).good:
                judge.without.discard(k)
            else:
                fit = less
    return fit


def _prune(explorer: Explorer, fit: Fit) -> Fit:
    """Drop laws that are not needed any more."""
    while len(fit.effects) > 1:
        without = [explorer.less(fit, drop) for drop in fit.effects]
        spare = [f for f in without if not worth(explorer.judge, f, fit).good]
        if not spare:
            break
        fit = min(spare, key=lambda f: score(explorer.judge, f))
    return fit


def _swap(explorer: Explorer, fit: Fit, names: list[str]) -> Fit:
    """Exchange one law for another where that is better: what was right first need not be right last."""
    for _ in range(2):
        best = fit
        for drop in fit.effects:
            rest = explorer.of(tuple(e for e in fit.effects if e != drop))
            options = [f for f in explorer.add(rest, names, 3, 6) if len(f.effects) == len(fit.effects)]
            better = [f for f in options if score(explorer.judge, f) < score(explorer.judge, best) - 0.02]
            if better:
                best = better[0]
        if best is fit:
            return fit
        fit = _prune(explorer, best)
    return fit


def _simpler(explorer: Explorer, fit: Fit, names: list[str]) -> Fit:
    """Exchange a law of many parameters for two with fewer in all, where they do as well: a flexible law stands in for
    whatever bends.
    """
    judge, stage = explorer.judge, explorer.stage
    size = {e.name: len(e.parameters) for e in stage.effects}
    for drop in [e for e in fit.effects if size[e] > 2]:
        rest = explorer.of(tuple(e for e in fit.effects if e != drop))
        one = [f for f in explorer.add(rest, names, 3, 6) if size[f.effects[-1]] == 1 and worth(judge, rest, f).good][
            :2
        ]
        two = [
            g for f in one for g in explorer.add(f, names, 3, 6) if size[g.effects[-1]] == 1 and worth(judge, f, g).good
        ]
        options = [f for f in (*one, *two) if score(judge, f) < score(judge, fit) + PER_PARAMETER]
        if options:
            fit = min(options, key=lambda f: score(judge, f))
    return fit


def _name(explorer: Explorer, fit: Fit, names: list[str]) -> list[Found]:
    """Each law with those that would do as well in its place, and how often it wins over resampled blocks."""
    judge, stage = explorer.judge, explorer.stage

    def added(f: Fit) -> int:
        return sum(len(stage.effect(e).parameters) for e in f.effects)

    count = int(np.sum(judge.samples > 0))
    draws = np.random.default_rng(0).integers(0, count, (400, count))
    out = []
    for name in fit.effects:
        rest = explorer.of(tuple(e for e in fit.effects if e != name))
        alternatives = {name: fit}
        for f in explorer.add(rest, names, 3, 6):
            other = [e for e in f.effects if e not in rest.effects]
            if len(other) == 1 and other[0] != name:
                alternatives[other[0]] = f
        mine = score(judge, fit)
        # what has more parameters and does no better holds the named law within it
        rivals = [
            m
            for m, f in alternatives.items()
            if m != name and added(f) <= added(fit) and score(judge, f) < mine + RIVAL and worth(judge, rest, f).good
        ]
        table = np.array(
            [
                [score(judge, f, d) for d in draws]
                for m, f in alternatives.items()
                if m == name or (m not in rivals and added(f) <= added(fit))
            ]
        )
        wins = np.mean(np.argmin(table, axis=0) == 0)
        gained = float(rest.held_out.sum() - fit.held_out.sum())
        share = float(wins) / (1.0 + len(rivals))
        out.append(Found(name, share, parameters_of(stage, fit, name), rivals, gained))
    return out


def extend_system(stage: Stage, floor: Array, wanted: tuple[str, ...]) -> StageDiagnosis:
    """Fit exactly these laws beside the model's own parameters, the one that explains most first."""
    judge = _Judge(stage, floor)
    explorer = Explorer(judge)
    n = max(judge.n, 1)

    def rms(fit: Fit) -> float:
        return float(np.sqrt(fit.held_out.sum() / n))

    current = explorer.base
    steps = [("model", rms(current))]
    while len(current.effects) < len(wanted):
        current = explorer.add(current, list(wanted))[0]
        steps.append((f"+ {current.effects[-1]}", rms(current)))
    current = _spare(judge, current)
    before, after = (rms_per_output(judge, f) for f in (explorer.base, current))
    found = found_of(judge, current, current.effects)
    return StageDiagnosis(
        stage=stage.name, outputs=stage.outputs, units=stage.units, verdict="missing" if found else "none",
        floor=judge.floor,
        base=explorer.base, final=current, error_before=before, error_after=after, effects=found,
        recalibrated=recalibrated(stage, current), candidates=[], correlation=1.0, steps=steps, excess=rms(current),
    )  # fmt: skip


def structure(judge: Judge, fit: Fit) -> float:
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
    block = np.repeat(np.arange(judge.n_blocks), np.diff(np.append(judge.block_start, len(stage.t))))
    total = left = 0.0
    for k in range(len(e)):
        use = judge.valid[k]
        for fold in range(4):
            train, test = use & (block % 4 != fold), use & (block % 4 == fold)
            if not test.any() or train.sum() < 3 * x.shape[1]:
                continue
            a = x[train].T @ x[train]
            a += 1e-3 * np.diag(np.diag(a)) + 1e-9 * np.eye(len(a))
            c = np.linalg.solve(a, x[train].T @ e[k, train])
            total += float(np.sum(e[k, test] ** 2))
            left += float(np.sum((e[k, test] - x[test] @ c) ** 2))
    return max(0.0, 1.0 - left / total) if total > 0 else 0.0


def noise_of_channel(y: Array) -> float:
    """RMS of the white noise that evenly sampled values can hold at most; 0 is possible.

    The smaller of two bounds: third differences over the quieter half of the stretches (motion is smooth), and the
    quietest tenth of the spectrum (white noise is everywhere).
    """
    from scipy.signal import welch

    y = y[np.isfinite(y)]
    if len(y) < 40:
        return 0.0
    d = np.diff(y, 3)
    width = max(10, len(d) // 60)
    parts = d[: len(d) // width * width].reshape(-1, width)
    level = np.sort(np.sqrt(np.mean(parts**2, axis=1) / 20.0))
    smooth = float(np.median(level[: max(1, len(level) // 2)]))
    _, power = welch(y, 1.0, nperseg=min(1024, len(y) // 4))
    return min(smooth, float(np.sqrt(np.quantile(power[1:], 0.1) * 0.5)))
