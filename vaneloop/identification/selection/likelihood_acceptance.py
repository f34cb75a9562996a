"""Acceptance for a model that may come down to the noise of its log: an effect is compared with a known noise floor.

Two measures, both from the held-out errors of the log's blocks (`identification.selection.rules.gain`):

- the gain of log-likelihood: half the fall of the normalised sum of squares, divided by how correlated the errors are
  (an error that repeats itself n times is one observation, not n);
- the fall of the RMS error in standard deviations of it, over the whole log or within the blocks where the effect acts.

Both limits follow from the maximum over the library when nothing is missing (docs/diagnosis.md).
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from vaneloop.identification.least_squares.noise import correlation_of
from vaneloop.identification.least_squares.problem import Fit, LeastSquaresProblem
from vaneloop.identification.results import (
    Candidate,
    Found,
    StageDiagnosis,
    answer_of,
    at_bound,
    parameters_of,
    rms_of,
    rms_per_output,
)
from vaneloop.identification.selection.rules import (
    AWAY,
    EXPLAINS_HALF,
    KNOWN_NOISE,
    LEAVES_LITTLE,
    NAMED,
    Comparison,
    Decisions,
    Naming,
    Remainder,
    gain,
)
from vaneloop.identification.settings import (
    BLOCK_SPREADS,
    CREDIBLE,
    FLOOR_KNOWN,
    NATS,
    RIVAL_NATS,
    RIVAL_SHARE,
    RIVAL_SPREADS,
    SPREADS,
    TOLERATED,
)

if TYPE_CHECKING:
    from vaneloop.identification.selection.search import Search

__all__ = [
    "LikelihoodAcceptance", "as_close", "rival_nats", "significant", "with_rivals",
]  # fmt: skip

BOUND = "fits only at the end of its physical range"


def _above_floor(judge: LeastSquaresProblem, fit: Fit, correlation: float, known: float = FLOOR_KNOWN) -> bool:
    """True when the held-out error is above the noise floor, over the whole log or in single blocks, by more than its
    own scatter. A search then begins: the acceptance rules do not rest on the floor's level, so that its own
    uncertainty is no matter here.

    known  relative error of the noise floor
    """
    n, m = max(judge.n, 1), np.maximum(judge.samples, 1)
    whole = np.sqrt(max(fit.held_out.sum(), 0.0) / n) > 1.0 + max(SPREADS * np.sqrt(correlation / (2.0 * n)), known)
    errors = np.sqrt(np.maximum(fit.held_out, 0.0) / m / judge.expected())
    blocks = errors > 1.0 + known + BLOCK_SPREADS * np.sqrt(correlation / (2.0 * m))
    return bool(whole or np.any(blocks & (m > 0.2 * m.max())))


def significant(judge: LeastSquaresProblem, before: Fit, after: Fit, correlation: float) -> bool:
    """Whether the rules accept the further effects of ``after``."""
    case = Comparison(judge, before, after, correlation)
    return all(rule.verdict(case).holds for rule in KNOWN_NOISE)


class LikelihoodAcceptance:
    """The criterion (`identification.selection.search.Criterion`); ``known``: relative error of the noise floor."""

    most, leaders, fitted, finished, least, form, roams = 4, 5, 1_000_000, 3, NATS, 0.0, False

    def __init__(self, judge: LeastSquaresProblem, known: float = FLOOR_KNOWN):
        self.judge, self.known = judge, known
        self.correlation = 1.0
        self.left_out: dict[str, str] = {}
        self.decisions = Decisions()

    def begin(self, base: Fit) -> None:
        """Nothing: what is left is compared with noise."""

    def learn(self, fit: Fit) -> None:
        """Note how correlated the errors are that the best single effect leaves."""
        self.correlation = correlation_of(self.judge, fit)

    def order(self, fit: Fit) -> float:
        """Held-out sum of squares."""
        return float(fit.held_out.sum())

    def fails(self, fit: Fit) -> bool:
        """Whether the error stands above the floor."""
        return _above_floor(self.judge, fit, self.correlation, self.known)

    def accepts(self, before: Fit, after: Fit) -> bool:
        """Whether the gain is significant."""
        if after is before:
            return False
        case = Comparison(self.judge, before, after, self.correlation)
        return self.decisions.decide((*KNOWN_NOISE, AWAY), case, after.effects, before.effects)

    def gain(self, before: Fit, after: Fit) -> tuple[float, float]:
        """Nats and spreads."""
        return gain(before, after, self.correlation)

    def shows(self, reach: float) -> bool:
        """Whether an effect that changes the sum of squares by so much at its largest could have been seen."""
        return reach >= 2.0 * NATS * self.correlation

    def spared(self, fit: Fit) -> Fit:
        """The fit as it is: the model's own parameters are known within their tolerances."""
        return fit

    def settle(self, search: Search, fit: Fit) -> Fit:
        """The fit as it is: of effects that do equally well, `name` takes the one with less freedom."""
        return fit

    def name(self, search: Search, fit: Fit, candidates: list[Candidate]) -> tuple[list[Found], Fit]:
        """For each effect of the model found: which others would do as well in its place, how probable it is, its
        parameters.

        Of effects that do equally well the one that has less freedom to do so is named. Returns the fit with the
        effects named, too.
        """
        judge, current, chosen = self.judge, fit, fit.effects
        rng = np.random.default_rng(0)
        blocks = rng.integers(0, judge.n_blocks, (400, judge.n_blocks))
        leading = [c.effect for c in candidates if c.effect not in chosen][:10]
        correlation = correlation_of(judge, current)
        said: dict[str, tuple[list[str], float, dict[str, Fit], dict[str, float]]] = {}
        falls: dict[str, float] = {}
        for name in chosen:
            rest = tuple(c for c in current.effects if c != name)
            _widen_steps(judge, current, name, correlation)
            alternatives = {name: current}
            # those that lead alone, and those that did best beside the rest, where that was tried
            tried = sorted(
                (f for f in search.beside(rest) if name not in f.effects), key=lambda f: float(f.held_out.sum())
            )[:5]
            near = [*leading, *(m for f in tried for m in f.effects if m not in (*rest, *leading))]
            for f in search.rivals(current, [(*rest, other) for other in near if other not in rest], correlation):
                alternatives[next(e for e in f.effects if e not in rest)] = f
            freedom = {m: _freedom(judge, f, correlation) for m, f in alternatives.items()}
            # differences are softened by what even the closest leaves; the price of freedom is not
            closest = min(alternatives.values(), key=lambda f: float(f.held_out.sum()))
            soft = rival_nats(judge, float(closest.held_out.sum()), correlation) / RIVAL_NATS
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
            before = search.joined(rest) if rest else search.base
            nats = gain(before, current, correlation)[0]
            falls[best] = rms_of(judge, before) / max(rms_of(judge, current), 1e-300)
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
            sizes = parameters_of(judge.stage, current, m)
            found.append(Found(m, shares[m], sizes, rivals, nats, tried_fits, shares, falls[m]))
            if m in judge.stage.twins:
                cause, run = judge.stage.twins[m]
                other = LeastSquaresProblem(replace(judge.stage, run=run), judge.floor, judge.valid)
                twin = other.fit(current.effects, current.theta, 8)
                if significant(judge, current, twin, correlation):
                    found[-1] = replace(found[-1], other_cause=cause)
                elif not _worse(judge, twin, current, correlation, 0.0):
                    found[-1] = replace(found[-1], inseparable=[cause])
        named = {f.effect: f.parameters for f in found}
        for k, said_of in enumerate(found):
            law = judge.stage.alike.get(said_of.effect)
            if law and (like := law(named)):
                found[k] = replace(said_of, inseparable=[*said_of.inseparable, like])
        return found, current

    def conclude(
        self, base: Fit, fit: Fit, effects: list[Found], candidates: list[Candidate], steps: list[tuple[str, float]]
    ) -> StageDiagnosis:
        """Give the verdict on the best model found.

        A name is only given where it explains the error: not by half, not with a size at the end of what is physically
        possible, and not where the same law with another cause (`Stage.twins`) does clearly better.
        """
        judge, current, decide = self.judge, fit, self.decisions.decide
        leading = [c.effect for c in candidates if c.nats > NATS]
        refused = {}
        for f in effects:
            case = Naming(
                at_bound(judge.stage, current, f.effect),
                *judge.stage.twins.get(f.effect, ("",))[:1],
                bool(f.other_cause),
            )
            if not decide(NAMED, case, current.effects, tuple(e for e in current.effects if e != f.effect)):
                refused[f.effect] = f"would have to turn on {f.other_cause}" if f.other_cause else BOUND
        left = self._left_by(base, current)
        if not decide([EXPLAINS_HALF], left, current.effects, ()):
            refused = dict.fromkeys(
                current.effects, f"explains {max(left.explained, 0.0):.0%} of what exceeds the noise"
            )
            effects, current, left = [], base, self._left_by(base, base)
        little = decide(LEAVES_LITTLE, left, current.effects, ())
        if not little or (refused and current.effects):
            verdict, effects = "unknown", []
        elif current.effects:
            verdict = "missing"
        else:
            verdict = "none"
        out = answer_of(judge, verdict, base, current, effects, steps, candidates, self.correlation)
        out.criterion, out.decisions = "noise_floor", list(self.decisions)
        if verdict == "unknown":
            out.nearest = list(dict.fromkeys([*refused, *current.effects, *leading]))[:3]
            out.refused = [f"{name} {why}" for name, why in refused.items()]
        return out

    def _left_by(self, base: Fit, fit: Fit) -> Remainder:
        judge = self.judge
        worst = float(np.max(rms_per_output(judge, fit) / judge.floor))
        n = max(judge.n, 1)
        return Remainder(rms_of(judge, base), rms_of(judge, fit), worst, len(fit.effects), n, self.correlation)


def as_close(judge: LeastSquaresProblem, d: StageDiagnosis, fit: Fit) -> bool:
    """Whether a fit comes as close to the floor as a stage's answer must."""
    return rms_of(judge, fit) <= max(TOLERATED, (1.0 + FLOOR_KNOWN) * d.excess)


def with_rivals(best: str, rivals: list[str], shares: dict[str, float]) -> list[str]:
    """The rivals of ``best``: those given, and others by probability until all together have `CREDIBLE` of it."""
    out = list(rivals)
    for m in sorted(shares, key=lambda m: -shares[m]):
        if sum(shares[r] for r in (best, *out)) >= CREDIBLE * sum(shares.values()):
            break
        if m != best and m not in out:
            out.append(m)
    return out


def _widen_steps(judge: LeastSquaresProblem, fit: Fit, name: str, correlation: float) -> None:
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


def _freedom(judge: LeastSquaresProblem, fit: Fit, correlation: float) -> float:
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


def _worse(judge: LeastSquaresProblem, other: Fit, best: Fit, correlation: float, freer: float) -> bool:
    """True when the log can tell that ``other`` is not it: it explains less than ``best``, or no more though it is
    ``freer`` (nats).
    """
    nats, spreads = gain(other, best, correlation)
    less = nats > rival_nats(judge, float(best.held_out.sum()), correlation) and spreads > RIVAL_SPREADS
    return less or min(nats, 0.0) + freer > RIVAL_NATS


def rival_nats(judge: LeastSquaresProblem, squares: float, correlation: float) -> float:
    """Nats by which one of two effects beats the other, where the better one leaves so many ``squares``: the more, the
    more it leaves above the noise floor, as well as that is known.
    """
    left = 0.5 * (squares - judge.n * (1.0 + FLOOR_KNOWN) ** 2) / correlation
    return max(RIVAL_NATS, RIVAL_SHARE * left)
