"""Which effects is a stage missing? Screening, pairs of the leaders, pruning, rivals, and what is left.

A candidate must earn its place on data that it was not fitted to. Two measures, both from the held-out errors of the
log's blocks:

- *nats*: half the fall of the whitened sum of squares, divided by how correlated the errors are (an error that repeats
  itself n times is one observation, not n);
- *spreads*: the fall of the RMS error in units of the noise floor's own spread, over the whole log, or within the
  blocks where it acts.

A gain counts when it passes both thresholds. They are set on the maximum over the library under "nothing missing"
(docs/diagnosis.md).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from vaneloop.discrepancy.fit import Fit, Judge, Task, bounded_step, recalibrate
from vaneloop.discrepancy.stage import FLOOR_KNOWN, Array, Effect, Stage, noise_of, reach_of

__all__ = [
    "NATS",
    "RIVAL_SPREADS",
    "Candidate",
    "Found",
    "Search",
    "StageDiagnosis",
    "as_close",
    "at_bound",
    "correlation_of",
    "diagnose_stage",
    "found_of",
    "gain",
    "parameters_of",
    "recalibrated",
    "rms_per_output",
    "significant",
]

NATS = 12.0  # gain that the best of a library of useless effects reaches in fewer than 1 of 100 clean logs, with margin
SPREADS = 3.0  # the definition of detectable
BLOCK_SPREADS = 8.0  # for an effect that shows in few blocks only
RIVAL_NATS = 3.0  # odds of 20 to 1, by which one of two effects that both earn their place beats the other
RIVAL_SPREADS = (
    0.3  # and the fall of the error: more than an effect that is not there gains by the errors of form of a clean log
)
CREDIBLE = 0.9  # an effect and its rivals have at least this probability together
RIVAL_SHARE = 0.25  # and share of what it leaves above the floor itself: the library's equations are not nature's
LEADERS = 5  # effects tried in pairs
FINISHED = 3  # leading sets whose fits are finished
MOST = 4  # effects in one stage
TOLERATED = 1.05  # error over noise floor at which nothing is missing any more
# Share of the excess over the floor that a further effect must explain (less is one effect patching another's
# equation), and that a model of the right kind may leave (its equation is not nature's): what is left then would not
# have earned a further effect either.
LEAST_SHARE = 0.15
EXPLAINED = 0.5  # share of the excess over the floor that all effects named in a stage must explain together
LONG = 60_000  # samples; a stage with more is searched on an excerpt
SEARCHED = 40_000  # samples of an excerpt, about
PIECE = 4_000  # samples in a row: longer than the memory of any stage here
SCREENED = 32  # starts simulated at one time
DIRECTIONS = 12  # from which a fit of an effect with a direction may start
LEFT_FLOORS = (
    3.0  # noise floors that a model with one effect may leave, whatever share of the excess it explains; two effects: 2
)


@dataclass
class Candidate:
    """An effect as a candidate: its gain on held-out data when it is added alone (or in the pair named) to the nominal
    model.
    """

    effect: str
    nats: float
    spreads: float
    reason: str = ""  # why it cannot be seen in this log, if it cannot


@dataclass
class Found:
    """An effect named as missing.

    fits         the stage's fit with it, and with each that was tried in its place
    shares       the probability of each of these
    inseparable  what this log cannot tell from what the effect turns on ("time", "oil temperature")
    refused      why it comes nearest and yet is no answer; "": it is one
    """

    effect: str
    probability: float
    parameters: dict[str, dict[str, object]]
    rivals: list[str]
    nats: float
    fits: dict[str, Fit] = field(default_factory=dict, repr=False)
    shares: dict[str, float] = field(default_factory=dict, repr=False)
    inseparable: list[str] = field(default_factory=list)
    refused: str = ""


@dataclass
class StageDiagnosis:
    """What one stage says."""

    stage: str
    outputs: tuple[str, ...]
    units: tuple[str, ...]
    verdict: str  # missing, none, unknown
    floor: Array
    base: Fit
    final: Fit
    error_before: Array
    error_after: Array
    effects: list[Found]
    recalibrated: list[dict[str, object]]
    candidates: list[Candidate]
    correlation: float
    steps: list[tuple[str, float]] = field(default_factory=list)  # waterfall: what was added, whitened RMS after it
    excess: float = 1.0  # whitened RMS after the best model
    nearest: list[str] = field(default_factory=list)  # where the verdict is unknown: the effects that come nearest
    refused: list[str] = field(default_factory=list)  # and why they are no answer, in words


class Search:
    """The search on one stage: fits made once, compared by their held-out blocks."""

    def __init__(self, judge: Judge, tick: Callable[[], None] | None = None):
        """Fit the nominal model and note how correlated its errors are."""
        self.judge = judge
        self.stage = judge.stage
        self.tick = tick or (lambda: None)
        self.fits: dict[frozenset[str], Fit] = {}
        self.finished: set[frozenset[str]] = set()
        self.base = self.of(())
        # a stage that stands at its noise floor needs no effect; what the log could have shown is known from the
        # largest sizes
        self.quiet = not _above_floor(judge, self.base, 1.0)
        self.starts = self._screen()

    def of(self, effects: tuple[str, ...], start: Array | None = None, iterations: int = 12) -> Fit:
        """Return the fit with ``effects``, from memory if it was made before."""
        key = frozenset(effects)
        if key not in self.fits:
            begin = self.stage.neutral() if start is None else start
            self.fits[key] = self.judge.fit(tuple(effects), begin, iterations)
            self.tick()
        return self.fits[key]

    def _screen(self) -> dict[str, list[Array]]:
        """Best starting points of every effect: all starts of all effects simulated at once beside the fitted nominal
        model.
        """
        stage, judge = self.stage, self.judge
        index = stage.index()
        thetas, owner = [], []
        for e in stage.effects:
            for s in e.starts[-2:] if self.quiet else e.starts:
                theta = self.base.theta.copy()
                theta[index[e.name]] = s
                thetas.append(theta)
                owner.append(e.name)
        free = self.base.free
        e0, jac = judge.linearise(self.base.theta, free)
        flat = jac.reshape(len(free), e0.size)
        a = flat @ flat.T + np.diag(self.base.prior * judge.scale[free] ** 2 + 1e-9)
        room = [(b[free] - self.base.theta[free]) / judge.scale[free] for b in judge.bounds()]
        if not self.quiet:
            for e in stage.effects:
                turned = self._turned(e, e0, jac)
                thetas += turned
                owner += [e.name] * len(turned)
        costs: list[float] = []
        for i in range(0, len(thetas), SCREENED):
            errors = judge.errors(np.array(thetas[i : i + SCREENED])).reshape(-1, e0.size)
            pull = errors @ flat.T
            step = np.clip(np.linalg.solve(a, pull.T).T, *room)  # nominal parameters stay within their tolerances
            costs += (np.sum(errors * errors, axis=1) - np.sum((2.0 * pull - step @ a) * step, axis=1)).tolist()
        out: dict[str, list[Array]] = {}
        self.reach: dict[str, float] = {}
        for name in dict.fromkeys(owner):
            mine = sorted((c, i) for i, (o, c) in enumerate(zip(owner, costs, strict=True)) if o == name)
            base_cost = float(np.sum(e0 * e0))
            # a second start is worth its time where it is nearly as good as the first
            near = mine[0][0] + 0.2 * max(base_cost - mine[0][0], 0.02 * base_cost)
            out[name] = [thetas[i] for c, i in mine[:2] if c <= near]
            self.reach[name] = max(abs(c - base_cost) for c, _ in mine)  # what the largest sizes change at all
        return out

    def _turned(self, effect: Effect, e0: Array, jac: Array) -> list[Array]:
        """Starts of an effect with a direction (a parameter that repeats itself), all round: each with the sizes that
        are best there.

        Size and direction are polar coordinates: from a wrong direction a fit comes to the right one by a long way
        round. In a fixed direction the sizes act linearly near neutral, so that their best values follow from one
        simulation.

        e0, jac  error of the fitted nominal model, and its derivatives by the nominal parameters, of `Judge.linearise`
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
            moved, derivative = judge._differences(theta, sizes, judge.scale[sizes], high, e0)
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
        """Fits with one effect each, side by side."""
        return dict(zip(names, self.judge.together([self._single(n) for n in names]), strict=True))

    def _single(self, name: str) -> Task[Fit]:
        key = frozenset((name,))
        if key not in self.fits:
            fits = []
            for start in self.starts[name][:2]:
                fits.append((yield from self.judge.fitting((name,), start, 3)))
            best = min(fits, key=self.judge.total_of)
            if 0.5 * float(self.base.cost.sum() - best.cost.sum()) > 0.5 * NATS:  # worth finishing
                turns = any(p.period for p in self.stage.effect(name).parameters)
                best = yield from self.judge.fitting(
                    (name,), best, 30 if turns else 8
                )  # along a curve from direction to direction
                best = yield from self._refine(name, best)
            self.fits[key] = yield from self._no_worse(best)
            self.tick()
        return self.fits[key]

    def _no_worse(self, fit: Fit) -> Task[Fit]:
        """The fit, or a better one from the best fit of a part of its effects: with more effects a fit never ends
        higher.

        A part's parameters are parameters of the whole, with the other effects at neutral, and a fit never ends higher
        than it starts.
        """
        mine = frozenset(fit.effects)
        parts = [f for key, f in self.fits.items() if key < mine]
        part = min(parts, key=self.judge.total_of, default=None)
        if part is None or self.judge.total_of(fit) <= self.judge.total_of(part):
            return fit
        again = yield from self.judge.fitting(fit.effects, part.theta, 8)
        return min(again, fit, key=self.judge.total_of)

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
        if np.min(np.abs(starts - at)) > 1e-9 * max(1.0, abs(at)):
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

    def joined(self, effects: tuple[str, ...]) -> Fit:
        """Fit with several effects, started from the fits with one fewer."""
        return self.judge.together([self._joined(effects, True)])[0]

    def _joined(self, effects: tuple[str, ...], finished: bool) -> Task[Fit]:
        """``finished`` False: a few iterations, enough to rank it."""
        if len(effects) == 1:
            return (yield from self._single(effects[0]))
        key = frozenset(effects)
        if key not in self.fits:
            index = self.stage.index()
            single = {}
            for name in effects:
                single[name] = (yield from self._single(name)).theta
            begins = []
            for leave in effects:
                rest = frozenset(effects) - {leave}
                if rest in self.fits:
                    for source in (self.starts[leave][0], single[leave]):
                        theta = self.fits[rest].theta.copy()
                        theta[index[leave]] = source[index[leave]]
                        begins.append(theta)
            if not begins:
                theta = single[effects[0]].copy()
                for other in effects[1:]:
                    theta[index[other]] = single[other][index[other]]
                begins.append(theta)
            costs = self.judge.totals((yield np.array(begins)), np.array(begins))
            self.fits[key] = yield from self.judge.fitting(tuple(effects), begins[int(np.argmin(costs))], 3)
            self.tick()
        if finished and key not in self.finished:
            self.fits[key] = yield from self.judge.fitting(tuple(effects), self.fits[key], 8)
            self.finished.add(key)
            self.tick()
        self.fits[key] = yield from self._no_worse(self.fits[key])
        return self.fits[key]

    def beside(self, rest: Sequence[str]) -> list[Fit]:
        """Fits made with one effect more than ``rest``."""
        return [f for key, f in self.fits.items() if len(key) == len(rest) + 1 and key.issuperset(rest)]

    def best_of(self, sets: Sequence[tuple[str, ...]]) -> list[Fit]:
        """Rank these sets of effects by quick fits, finish the leading ones, and return all, best first."""
        quick = self.judge.together([self._joined(s, False) for s in sets])
        quick.sort(key=lambda f: float(f.held_out.sum()))
        out = self.judge.together([self._joined(f.effects, True) for f in quick[:FINISHED]]) + quick[FINISHED:]
        return sorted(out, key=lambda f: float(f.held_out.sum()))


def correlation_of(judge: Judge, fit: Fit) -> float:
    """Return how many samples of the fit's error count as one observation, at most 50.

    Variance inflation of a sum of the squared errors: 1 + 2 sum of the squared autocorrelations up to the first that is
    not positive.
    """
    e = judge.errors(fit.theta[None])[0]
    worst = 1.0
    for row in e:
        row = row - row.mean()
        power = float(row @ row)
        if power <= 0.0:
            continue
        total = 1.0
        spectrum = np.fft.rfft(row, 2 * len(row))
        for rho in np.fft.irfft(np.abs(spectrum) ** 2)[1 : min(400, len(row) // 4)] / power:
            if rho <= 0.05:
                break
            total += 2.0 * rho * rho  # squares of errors are correlated by rho squared
        worst = max(worst, total)
    return min(worst, 50.0)


def gain(judge: Judge, before: Fit, after: Fit, correlation: float) -> tuple[float, float]:
    """Return (nats, spreads): what ``after`` gains over ``before`` on held-out blocks."""
    d = before.held_out - after.held_out
    nats = 0.5 * float(d.sum()) / correlation
    n = max(judge.n, 1)
    spread = np.sqrt(correlation / (2.0 * n))
    rms = [np.sqrt(max(f.held_out.sum(), 0.0) / n) for f in (before, after)]
    overall = (rms[0] - rms[1]) / spread
    m = np.maximum(judge.samples, 1)
    local = (np.sqrt(np.maximum(before.held_out, 0.0) / m) - np.sqrt(np.maximum(after.held_out, 0.0) / m)) / np.sqrt(
        correlation / (2.0 * m)
    )
    return nats, max(float(overall), SPREADS / BLOCK_SPREADS * float(np.sort(local)[-2:].mean()))


def _above_floor(judge: Judge, fit: Fit, correlation: float, known: float = FLOOR_KNOWN) -> bool:
    """True when the held-out error is above the noise floor, over the whole log or in single blocks, by more than the
    floor's spread.

    known  relative error of the noise floor
    """
    n, m = max(judge.n, 1), np.maximum(judge.samples, 1)
    whole = np.sqrt(max(fit.held_out.sum(), 0.0) / n) > 1.0 + max(SPREADS * np.sqrt(correlation / (2.0 * n)), known)
    errors = np.sqrt(np.maximum(fit.held_out, 0.0) / m / judge.expected())
    blocks = errors > 1.0 + known + BLOCK_SPREADS * np.sqrt(correlation / (2.0 * m))
    return bool(whole or np.any(blocks & (m > 0.2 * m.max())))


def significant(judge: Judge, before: Fit, after: Fit, correlation: float) -> bool:
    """True when ``after`` is worth its extra effect."""
    nats, spreads = gain(judge, before, after, correlation)
    excess = before.held_out.sum() - judge.n
    if before.held_out.sum() - after.held_out.sum() < LEAST_SHARE * excess:
        return False
    extra = max(len(after.free) - len(before.free), 1)
    return nats > NATS + (extra - 1) and spreads > SPREADS


def diagnose_stage(
    stage: Stage, floor: Array, keep: Array | None = None, tick: Callable[[], None] | None = None
) -> StageDiagnosis:
    """Search the stage's library for what is missing; see `_search`.

    floor  RMS of each output's error when nothing is missing
    keep   samples that count
    tick   called after every fit, for a progress bar

    A stage with very many samples is searched on an excerpt: half of it evenly spaced, half where the model fails most.
    What is found there is fitted to the whole log and has to earn its place again; where the whole log shows more, a
    second excerpt is taken from what is left.
    """
    if stage.excerpt is None or len(stage.t) < LONG:
        return _to_the_floor(stage, floor, keep, tick)
    judge = Judge(stage, floor, keep)
    base = recalibrate(judge)
    left = base
    for _ in range(2):
        at = _excerpt(judge, left)
        part = stage.excerpt(at)
        said = _to_the_floor(part, floor, None if keep is None else keep[..., at], tick)
        found = _confirm(stage, keep, floor, base, said)
        if found.verdict != "unknown" or said.verdict == "unknown":
            break
        left = found.final
    return found


def _excerpt(judge: Judge, fit: Fit) -> Array:
    """Samples to search on: pieces of whole windows, half of them evenly spaced, the others where ``fit`` fails
    most.
    """
    stage = judge.stage
    n = len(stage.t)
    dt = float(np.median(np.diff(stage.t)))
    window = max(1, round((stage.window or dt) / dt))
    length = max(1, round(PIECE / window)) * window
    pieces = n // length
    squares = np.sum(judge.errors(fit.theta[None])[0] ** 2, axis=0)
    cost = squares[: pieces * length].reshape(pieces, length).sum(axis=1)
    many = max(2, SEARCHED // length)
    chosen = set(np.linspace(0, pieces - 1, many - many // 2).round().astype(int).tolist())
    for k in np.argsort(-cost):
        if len(chosen) >= many:
            break
        chosen.add(int(k))
    return (np.array(sorted(chosen))[:, None] * length + np.arange(length)).reshape(-1)


def _confirm(stage: Stage, keep: Array | None, floor: Array, base: Fit, said: StageDiagnosis) -> StageDiagnosis:
    """Fit what an excerpt said to the whole log; an effect that the whole log does not need is dropped."""
    judge = Judge(stage, said.floor, keep)
    nominal = base if np.array_equal(floor, said.floor) else judge.fit((), base.theta, 4)
    chosen, current = said.final.effects, nominal
    if chosen:
        current = judge.fit(chosen, said.final.theta, 8)
        if judge.total_of(current) > judge.total_of(nominal):  # what suits the excerpt may suit nothing else
            current = judge.fit(chosen, nominal.theta, 8)
    correlation = correlation_of(judge, current)
    while chosen:
        rest = [tuple(c for c in chosen if c != name) for name in chosen]
        tasks = [judge.fitting(r, np.where(_allowed(stage, r), current.theta, stage.neutral()), 6) for r in rest if r]
        without = judge.together(tasks) if rest[0] else [nominal]
        idle = [k for k, f in enumerate(without) if not significant(judge, f, current, correlation)]
        if not idle:
            break
        chosen, current = rest[idle[0]], without[idle[0]]
    effects = [
        replace(f, parameters=parameters_of(stage, current, f.effect)) for f in said.effects if f.effect in chosen
    ]
    steps = [("nominal", float(np.sqrt(nominal.held_out.sum() / max(judge.n, 1))))]
    if chosen:
        steps.append((" + ".join(chosen), float(np.sqrt(current.held_out.sum() / max(judge.n, 1)))))
    return _conclude(judge, nominal, current, effects, said.candidates, correlation, steps)


def _allowed(stage: Stage, effects: tuple[str, ...]) -> Array:
    """Columns that a model with only these effects may have away from neutral: bool[parameters]."""
    out = np.ones(len(stage.all_parameters()), dtype=bool)
    for name, columns in stage.index().items():
        out[columns] = name in effects
    return out


def _to_the_floor(stage: Stage, floor: Array, keep: Array | None, tick: Callable[[], None] | None) -> StageDiagnosis:
    """Search, measure the floor again on the errors of the best model, and repeat where it was too high.

    A gross effect makes the nominal model's error move so fast that it passes for noise.
    """
    for attempt in range(3):
        search, current, candidates, correlation, steps = _search(stage, floor, keep, tick)
        if stage.noise is None or attempt == 2:
            break
        lower = noise_of(stage, current.theta)
        if not np.any(lower < 0.9 * floor):
            break
        floor = np.minimum(lower, floor)
    reach = reach_of(stage, floor, current.theta)  # nobody can come closer than that
    if np.any(reach > floor):
        search, current, candidates, correlation, steps = _search(stage, reach, keep, tick, TOLERATED - 1.0)
    effects, current = _name(search, current, candidates)
    return _conclude(search.judge, search.base, current, effects, candidates, correlation, steps)


def _search(
    stage: Stage, floor: Array, keep: Array | None, tick: Callable[[], None] | None, known: float = FLOOR_KNOWN
) -> tuple[Search, Fit, list[Candidate], float, list[tuple[str, float]]]:
    """Search the stage's library for what is missing: the search, the best model, all effects alone, correlation of
    errors, steps.

    known  relative error of the noise floor
    """
    judge = Judge(stage, floor, keep)
    search = Search(judge, tick)
    base = search.base
    n = max(judge.n, 1)

    def rms(fit: Fit) -> float:
        return float(np.sqrt(fit.held_out.sum() / n))

    candidates = []
    names = [e.name for e in stage.effects]
    singles = dict.fromkeys(names, base) if search.quiet else search.singles(names)
    leader = min(singles.values(), key=lambda f: float(f.held_out.sum()), default=base)
    correlation = correlation_of(judge, leader)
    for name in names:
        nats, spreads = gain(judge, base, singles[name], correlation)
        reason = ""
        if search.reach[name] < 2.0 * NATS * correlation:
            reason = stage.effect(name).excites or "this log does not excite it"
        candidates.append(Candidate(name, nats, spreads, reason))
    candidates.sort(key=lambda c: -c.nats)

    chosen: tuple[str, ...] = ()
    current = base
    steps = [("nominal", rms(base))]
    while len(chosen) < MOST and _above_floor(judge, current, correlation, known):
        options: list[Fit] = []
        if not chosen:
            options += list(singles.values())
            leaders = [c.effect for c in candidates[:LEADERS]]
            if rms(leader) > TOLERATED:
                options += search.best_of(list(itertools.combinations(leaders, 2)))
        else:
            options += search.best_of([(*chosen, m) for m in names if m not in chosen])
        ok = [f for f in options if significant(judge, current, f, correlation)]
        if not ok:
            break
        # fewest effects first: a pair must be significantly better than the best single, and that above the floor
        ok.sort(key=lambda f: (len(f.effects), float(f.held_out.sum())))
        best = ok[0]
        for f in ok[1:]:
            if len(f.effects) == len(best.effects):
                if f.held_out.sum() < best.held_out.sum():
                    best = f
            elif _above_floor(judge, best, correlation, known) and significant(judge, best, f, correlation):
                best = f
        chosen, current = best.effects, best
        steps.append((" + ".join(chosen), rms(current)))
    # backward: drop what is not needed any more
    pruned = True
    while pruned and len(chosen) > 1:
        pruned = False
        for name in chosen:
            rest = tuple(c for c in chosen if c != name)
            without = search.joined(rest)
            if not significant(judge, without, current, correlation):
                chosen, current, pruned = rest, without, True
                break

    return search, current, candidates, correlation, steps


def _conclude(
    judge: Judge,
    base: Fit,
    current: Fit,
    effects: list[Found],
    candidates: list[Candidate],
    correlation: float,
    steps: list[tuple[str, float]],
) -> StageDiagnosis:
    """Give the verdict on the best model found.

    A name is only given where it explains the error: not by half, not with a size at the end of what is physically
    possible, and not where the same law with another cause (`Stage.twins`) does clearly better.
    """
    stage = judge.stage
    n = max(judge.n, 1)
    leading = [c.effect for c in candidates if c.nats > NATS]
    refused = {f.effect: f.refused or BOUND for f in effects if f.refused or at_bound(stage, current, f.effect)}
    gained, excess = (base.held_out.sum() - f for f in (current.held_out.sum(), n * (1.0 + FLOOR_KNOWN) ** 2))
    if current.effects and gained < EXPLAINED * excess:
        refused = dict.fromkeys(current.effects, f"explains {max(gained, 0.0) / excess:.0%} of what exceeds the noise")
        effects, current = [], base
    rms_before, rms_after = (float(np.sqrt(f.held_out.sum() / n)) for f in (base, current))
    excess_before, excess_after = rms_before**2 - 1.0, rms_after**2 - 1.0
    limit = max(TOLERATED, 1.0 + SPREADS * np.sqrt(correlation / (2.0 * n)))
    # each further effect is one more chance to imitate what the library does not have
    left = 1.0 + (LEFT_FLOORS - 1.0) / max(len(current.effects), 1)
    before, after = (rms_per_output(judge, f) for f in (base, current))
    worst = max(rms_after, float(np.max(after / judge.floor)))  # no output is made up for by the others
    too_much = rms_after > limit and (excess_after > LEAST_SHARE * max(excess_before, 1e-12) or worst > left)
    if too_much or (refused and current.effects):
        verdict, effects = "unknown", []
    elif current.effects:
        verdict = "missing"
    else:
        verdict = "none"
    return StageDiagnosis(
        stage=stage.name,
        outputs=stage.outputs,
        units=stage.units,
        verdict=verdict,
        floor=judge.floor,
        base=base,
        final=current,
        error_before=before,
        error_after=after,
        effects=effects,
        recalibrated=recalibrated(stage, current),
        candidates=candidates,
        correlation=correlation,
        steps=steps,
        excess=rms_after,
        nearest=list(dict.fromkeys([*refused, *current.effects, *leading]))[:3] if verdict == "unknown" else [],
        refused=[f"{name} {why}" for name, why in refused.items()] if verdict == "unknown" else [],
    )


BOUND = "fits only at the end of its physical range"


def as_close(judge: Judge, d: StageDiagnosis, fit: Fit) -> bool:
    """Whether a fit comes as close to the floor as a stage's answer must."""
    return float(np.sqrt(fit.held_out.sum() / max(judge.n, 1))) <= max(TOLERATED, (1.0 + FLOOR_KNOWN) * d.excess)


def at_bound(stage: Stage, fit: Fit, name: str) -> bool:
    """Whether a size of the effect stands at a physical bound that is not its neutral value: the data would have it go
    on.
    """
    columns = stage.index()[name]
    for value, p in zip(fit.theta[columns], stage.effect(name).parameters, strict=True):
        near = 1e-6 * (p.high - p.low) if np.isfinite(p.high - p.low) else 0.0
        if not p.shape and abs(value - p.value) > near and (value <= p.low + near or value >= p.high - near):
            return True
    return False


def rms_per_output(judge: Judge, fit: Fit) -> Array:
    """RMS error of each output in its unit, scaled from fitted to held-out blocks."""
    e = judge.errors(fit.theta[None])[0] * judge.floor[:, None]
    counts = np.maximum(judge.valid.sum(axis=1), 1)
    inflation = np.sqrt(max(fit.held_out.sum(), 1e-300) / max(fit.cost.sum(), 1e-300))
    return np.sqrt(np.sum(e * e, axis=1) / counts) * inflation


def _name(search: Search, current: Fit, candidates: list[Candidate]) -> tuple[list[Found], Fit]:
    """For each effect of the model found: which others would do as well in its place, how probable it is, its
    parameters.

    Of effects that do equally well the one that has less freedom to do so is named. Returns the fit with the effects
    named, too.
    """
    judge, chosen = search.judge, current.effects
    rng = np.random.default_rng(0)
    blocks = rng.integers(0, judge.n_blocks, (400, judge.n_blocks))
    leading = [c.effect for c in candidates if c.effect not in chosen][:10]
    correlation = correlation_of(judge, current)
    said: dict[str, tuple[list[str], float, dict[str, Fit], dict[str, float]]] = {}
    for name in chosen:
        rest = tuple(c for c in current.effects if c != name)
        _widen_steps(judge, current, name, correlation)
        alternatives = {name: current}
        # those that lead alone, and those that did best beside the rest, where that was tried
        tried = sorted(
            (f for f in search.beside(rest) if name not in f.effects), key=lambda f: float(f.held_out.sum())
        )[:5]
        near = [*leading, *(m for f in tried for m in f.effects if m not in (*rest, *leading))]
        for f in search.best_of([(*rest, other) for other in near if other not in rest]):
            alternatives[next(e for e in f.effects if e not in rest)] = f
        freedom = {m: _freedom(judge, f, correlation) for m, f in alternatives.items()}
        # differences are softened by what even the closest leaves; the price of freedom is not
        closest = min(alternatives.values(), key=lambda f: float(f.held_out.sum()))
        soft = max(RIVAL_NATS, RIVAL_SHARE * _left(judge, closest, correlation)) / RIVAL_NATS
        score = {m: -0.5 * f.held_out / (correlation * soft) for m, f in alternatives.items()}
        best, *others = sorted(alternatives, key=lambda m: freedom[m] - float(score[m].sum()))
        if at_bound(judge.stage, alternatives[best], best):  # it gives way to one that does as well within
            as_good = {
                m: not _worse(judge, alternatives[m], alternatives[best], correlation, freedom[m] - freedom[best])
                for m in others
            }
            best = next((m for m in others if as_good[m] and not at_bound(judge.stage, alternatives[m], m)), best)
        alternatives = {m: f for m, f in alternatives.items() if m == best or not at_bound(judge.stage, f, m)}
        current = alternatives[best]
        nats = gain(judge, search.joined(rest) if rest else search.base, current, correlation)[0]
        freer = {m: freedom[m] - freedom[best] for m in alternatives}
        rivals = [
            m for m, f in alternatives.items() if m != best and not _worse(judge, f, current, correlation, freer[m])
        ]
        table = np.array([score[m][blocks].sum(axis=1) - freedom[m] for m in alternatives])
        weight = np.exp(table - table.max(axis=0))
        shares = dict(zip(alternatives, (weight / weight.sum(axis=0)).mean(axis=1).tolist(), strict=True))
        said[best] = (with_rivals(best, rivals, shares), nats, alternatives, shares)
    found = []
    for m, (rivals, nats, tried_fits, shares) in said.items():
        found.append(Found(m, shares[m], parameters_of(judge.stage, current, m), rivals, nats, tried_fits, shares))
        if m in judge.stage.twins:
            cause, run = judge.stage.twins[m]
            twin = Judge(replace(judge.stage, run=run), judge.floor, judge.valid).fit(current.effects, current.theta, 8)
            if significant(judge, current, twin, correlation):
                found[-1] = replace(found[-1], refused=f"would have to turn on {cause}")
            elif not _worse(judge, twin, current, correlation, 0.0):
                found[-1] = replace(found[-1], inseparable=[cause])
    return found, current


def with_rivals(best: str, rivals: list[str], shares: dict[str, float]) -> list[str]:
    """The rivals of ``best``: those given, and others by probability until all together have `CREDIBLE` of it."""
    out = list(rivals)
    for m in sorted(shares, key=lambda m: -shares[m]):
        if sum(shares[r] for r in (best, *out)) >= CREDIBLE * sum(shares.values()):
            break
        if m != best and m not in out:
            out.append(m)
    return out


def _widen_steps(judge: Judge, fit: Fit, name: str, correlation: float) -> None:
    """Give an effect that acts in steps (a threshold), whose slope is zero, the interval of sizes that are as good: 90
    %, in the fit.
    """
    column = judge.stage.index()[name].start
    k = int(np.flatnonzero(fit.free == column)[0])
    parameter, at = judge.stage.effect(name).parameters[0], float(fit.theta[column])
    if fit.high[k] - fit.low[k] > 1e-9 * max(1.0, abs(at)) or not parameter.low < at < parameter.high:
        return
    away = np.geomspace(1e-5, 0.3, 25) * max(abs(at), 1e-3 * float(judge.scale[column]))
    limits = []
    for side in (-1.0, 1.0):
        sizes = np.clip(at + side * away, parameter.low, parameter.high)
        thetas = np.repeat(fit.theta[None], len(sizes), axis=0)
        thetas[:, column] = sizes
        worse = judge.block_costs(judge.errors(thetas)).sum(axis=1) > float(fit.cost.sum()) + 2.71 * correlation
        limits.append(float(sizes[int(np.argmax(worse))] if worse.any() else sizes[-1]))
    fit.low[k], fit.high[k] = limits


def _freedom(judge: Judge, fit: Fit, correlation: float) -> float:
    """How much more the fit's parameters could have been than the data let them be, in nats: 0.5 log det(data + prior)
    / det(prior).

    The price of flexibility in the marginal likelihood by Laplace's method. A shape may be anywhere within its bounds;
    what is known of a size beforehand counts as one observation. MacKay (1992), Bayesian interpolation; Kass and
    Wasserman (1995), unit information.
    """
    # parameters that stayed at neutral, such as those of the other two vanes, made nothing possible
    columns = [judge.stage.all_parameters()[c] for c in fit.free]
    neutral = np.array([p.value for p in columns])
    shape = np.array([p.shape for p in columns], dtype=bool)
    used = (fit.prior > 0.0) | shape | (neutral < fit.low) | (neutral > fit.high)
    scale = judge.scale[fit.free]
    width = np.array([min(p.high - p.low, 1e3 * s) for p, s in zip(columns, scale, strict=True)])
    data = fit.normals.sum(axis=0) / correlation
    # a size is known beforehand as well as one observation tells it, but not so well that the size found could not be
    found = np.abs(fit.theta[fit.free] - neutral) / scale
    one = np.minimum(
        np.maximum(np.diag(data) * correlation / max(judge.n, 1), 1e-12), 1.0 / np.maximum(found, 1e-9) ** 2
    )
    prior = np.where(fit.prior > 0.0, fit.prior * scale**2, np.where(shape, 12.0 * (scale / width) ** 2, one))[used]
    return 0.5 * float(np.linalg.slogdet(data[np.ix_(used, used)] + np.diag(prior))[1] - np.log(prior).sum())


def parameters_of(stage: Stage, fit: Fit, name: str) -> dict[str, dict[str, object]]:
    """Fitted parameters of an effect with their 90 % intervals."""
    columns = stage.index()[name]
    out: dict[str, dict[str, object]] = {}
    for i, p in zip(range(columns.start, columns.stop), stage.effect(name).parameters, strict=True):
        k = int(np.flatnonzero(fit.free == i)[0])
        low, high = float(fit.low[k]), float(fit.high[k])
        if not p.period:
            low, high = max(low, p.low), min(high, p.high)
        out[p.name] = {"value": float(fit.theta[i]), "low": low, "high": high, "unit": p.unit}
    return out


def found_of(judge: Judge, fit: Fit, effects: tuple[str, ...]) -> list[Found]:
    """Effects of a fit that was asked for: no rivals looked for, probability 1 by decree."""
    return [Found(name, 1.0, parameters_of(judge.stage, fit, name), [], 0.0) for name in effects]


def _worse(judge: Judge, other: Fit, best: Fit, correlation: float, freer: float) -> bool:
    """True when the log can tell that ``other`` is not it: it explains less than ``best``, or no more though it is
    ``freer`` (nats).
    """
    nats, spreads = gain(judge, other, best, correlation)
    less = nats > max(RIVAL_NATS, RIVAL_SHARE * _left(judge, best, correlation)) and spreads > RIVAL_SPREADS
    return less or min(nats, 0.0) + freer > RIVAL_NATS


def _left(judge: Judge, fit: Fit, correlation: float) -> float:
    """What the fit leaves above the noise floor, as well as that is known, in nats: its equations are not nature's."""
    return 0.5 * (float(fit.held_out.sum()) - judge.n * (1.0 + FLOOR_KNOWN) ** 2) / correlation


def recalibrated(stage: Stage, fit: Fit) -> list[dict[str, object]]:
    """Nominal parameters that have moved significantly within their tolerance."""
    out = []
    for k, c in enumerate(fit.free):
        if c < len(stage.parameters):
            p = stage.parameters[c]
            low, high = float(fit.low[k]), float(fit.high[k])
            if not low <= p.value <= high:
                limit = (
                    abs(fit.theta[c] - p.value) >= 0.999 * p.tolerance
                )  # the data pull on beyond what the tolerance allows
                value = float(fit.theta[c])
                out.append(
                    {
                        "parameter": p.name,
                        "value": value,
                        "low": low,
                        "high": high,
                        "unit": p.unit,
                        "at_limit": bool(limit),
                    }
                )
    return out
