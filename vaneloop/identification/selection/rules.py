"""Acceptance rules: named conditions on a candidate, each with its limit and the reason for it.

A `Rule` measures one number of a case and compares it with a limit. A candidate is accepted when every rule of its
table holds. `Decisions` keeps each verdict, so that an answer can say why a candidate was accepted and another was not.
A number that is not finite never meets a limit.

| table | judges | case |
|---|---|---|
| `KNOWN_NOISE` | effects and curves of a model that may come down to the noise of its log | `Comparison` |
| `UNKNOWN_NOISE` | effects and curves of a model that will not | `Comparison` |
| `AWAY` | effects of the library, on top of these | `Comparison` |
| `BEGINS` | effects that begin within the log, against those that act all along | `Beginning` |
| `NEAR_NOISE` | curves where the error is hardly more than noise | `AllRows` |
| `DISSIPATES`, `CONFIRMED` | curves of hysteretic and dynamic terms | a number, `Confirmation` |
| `OTHER_LOGS` | what was accepted, on each log | `LogChanges` |
| `SUITS_ALL` | curves, on the other subsystems in which they act | `LogChanges` |
| `NAMED` | each effect before it is named | `Naming` |
| `EXPLAINS_HALF`, `LEAVES_LITTLE` | the whole set, where the noise is known | `Remainder` |
| `LEAVES_A_QUARTER` | the whole set, where it is not | `Remainder` |
| `PROBABLE` | each name of a subsystem that fails with all of them | a number |
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Generic, TypeVar

import numpy as np

from vaneloop.identification.least_squares.noise import floor_deviation
from vaneloop.identification.least_squares.problem import Fit, LeastSquaresProblem
from vaneloop.identification.settings import (
    AGREE,
    AGREEING_BLOCKS,
    BLOCK_SPREADS,
    EXPLAINED,
    FLAT,
    FLOOR_KNOWN,
    HARM,
    LEAST_FALL,
    LEAST_HELP,
    LEAST_OF_NOISE,
    LEAST_SHARE,
    LEAST_USE,
    LEFT_FLOORS,
    LIKELY,
    MOST_LEFT,
    NATS,
    NEGATIVE_STOPS,
    SPREADS,
    TOLERATED,
    UNKNOWN,
)
from vaneloop.identification.subsystem import Array

__all__ = [
    "AWAY", "BEGINS", "CONFIRMED", "DISSIPATES", "EXCESS", "EXPLAINS_HALF", "GAIN", "HARMS_NONE", "KNOWN_NOISE",
    "LEAVES_A_QUARTER", "LEAVES_LITTLE", "NAMED", "NEAR_NOISE", "OTHER_LOGS", "PROBABLE", "RULES", "SUITS_ALL",
    "UNKNOWN_NOISE",
    "AllRows", "Beginning", "Comparison", "Confirmation", "Decision", "Decisions", "LogChanges", "Naming", "Remainder",
    "Rule", "Verdict", "decisions_json", "gain",
]  # fmt: skip

Case = TypeVar("Case")


@dataclass(frozen=True)
class Verdict:
    """What a rule says of one candidate: the number measured, the limit, and whether the rule holds."""

    rule: str
    value: float
    limit: float
    holds: bool


@dataclass(frozen=True)
class Rule(Generic[Case]):
    """One condition for acceptance.

    name     as printed
    unit     of the number and the limit
    reason   why the rule exists, a sentence
    measure  function from a case to the number
    limit    function from a case to the limit
    at_most  whether the number may not exceed the limit; otherwise it must reach it
    applies  function from a case to whether the rule is asked at all
    """

    name: str
    unit: str
    reason: str
    measure: Callable[[Case], float]
    limit: Callable[[Case], float]
    at_most: bool = False
    applies: Callable[[Case], bool] = lambda _: True

    def verdict(self, case: Case) -> Verdict:
        """The rule's verdict on a case."""
        value, limit = float(self.measure(case)), float(self.limit(case))
        return Verdict(self.name, value, limit, value <= limit if self.at_most else value >= limit)


@dataclass(frozen=True)
class Decision:
    """What the rules say of a set of effects or curves against another set.

    added, beside  names of the set, and of the set that it is compared with
    """

    added: tuple[str, ...]
    beside: tuple[str, ...]
    verdicts: tuple[Verdict, ...]

    @property
    def accepted(self) -> bool:
        """Whether every rule holds."""
        return all(v.holds for v in self.verdicts)


class Decisions:
    """The decisions of one search: the latest verdict of each rule on each pair of sets, in the order of the search.

    earlier  decisions that the search goes on from
    """

    def __init__(self, earlier: Sequence[Decision] = ()) -> None:
        self._verdicts = {(d.added, d.beside): {v.rule: v for v in d.verdicts} for d in earlier}

    def decide(self, rules: Sequence[Rule[Case]], case: Case, added: Sequence[str], beside: Sequence[str]) -> bool:
        """Apply the rules to a case, keep their verdicts, and return whether all hold."""
        verdicts = [rule.verdict(case) for rule in rules if rule.applies(case)]
        of = self._verdicts.setdefault((tuple(added), tuple(beside)), {})
        for v in verdicts:
            of[v.rule] = v
        return all(v.holds for v in verdicts)

    def __iter__(self) -> Iterator[Decision]:
        for (added, beside), of in self._verdicts.items():
            if of:
                yield Decision(added, beside, tuple(of.values()))


# ---- one fit against another -----------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Comparison:
    """A fit held against another, by the held-out errors of the log's blocks.

    correlation  samples of the error that count as one observation
    form         error (noise floors) by which the equations of what is in the model already may be wrong
    """

    judge: LeastSquaresProblem
    before: Fit
    after: Fit
    correlation: float = 1.0
    form: float = 0.0

    @property
    def share_of_excess(self) -> float:
        """Share of the held-out sum of squares beyond noise that goes; infinite where nothing is beyond noise."""
        was = float(self.before.held_out.sum())
        excess = was - self.judge.n
        return (was - float(self.after.held_out.sum())) / excess if excess > 0.0 or np.isnan(excess) else np.inf

    @property
    def further(self) -> int:
        """Parameters beyond the first that ``after`` has more."""
        return max(len(self.after.free) - len(self.before.free), 1) - 1

    @cached_property
    def gain(self) -> tuple[float, float]:
        """Gain of log-likelihood, and fall of the RMS error in standard deviations; see `gain`."""
        return gain(self.before, self.after, self.correlation)

    @cached_property
    def block_changes(self) -> Array:
        """Log of the mean square before over that after, of each block. A block that is nearly perfect cannot change
        (`FLAT`).
        """
        flat = max(1.0, FLAT * float(np.sqrt(max(self.before.held_out.sum(), 0.0) / max(self.judge.n, 1))))
        return np.asarray(np.log(self._levels(self.before, flat) / self._levels(self.after, flat)), dtype=float)

    @cached_property
    def squares(self) -> tuple[float, float]:
        """Held-out sums of squares before and after, of no block less than its noise."""
        return float(self._levels(self.before).sum()), float(self._levels(self.after).sum())

    @property
    def share_of_fall(self) -> float:
        """Share of the sum of squares that goes, held out, and no more of it than goes where all blocks are fitted.

        What the model before knew too little of to predict blocks left out is no merit of the new term.
        """
        was, now = self.squares
        fitted, left = (float(self._of_noise(f.cost).sum()) for f in (self.before, self.after))
        return min(was - now, fitted - left) / was

    @property
    def least_share(self) -> float:
        """Share of the sum of squares that must go: of what is beyond noise, of the noise, of the error of form."""
        was, noise = self.squares[0], float(self.judge.n)
        return max(LEAST_FALL * (was - noise), LEAST_OF_NOISE * noise, self.form * self.form * noise) / was

    @property
    def share_improved(self) -> float:
        """Share of the summed changes, block by block, that is improvement."""
        change = float(np.abs(self.block_changes).sum())
        return float(np.maximum(self.block_changes, 0.0).sum()) / change if change > 0 else 0.0

    @property
    def away_from_neutral(self) -> float:
        """Of the further effect that is nearest to neutral: distance of its clearest size from there, over that of the
        near end of its 90 % interval from the size; above 1 the interval excludes neutral. Infinite without any.
        """
        further = [e for e in self.after.effects if e not in self.before.effects]
        return min((self._clearest(e) for e in further), default=np.inf)

    def _clearest(self, effect: str) -> float:
        stage, fit, found = self.judge.stage, self.after, []
        at = stage.index()[effect].start
        for i, p in enumerate(stage.effect(effect).parameters):
            if p.shape:
                continue
            k = int(np.flatnonzero(fit.free == at + i)[0])
            value, neutral = float(fit.theta[at + i]), p.value
            half = value - float(fit.low[k]) if neutral < value else float(fit.high[k]) - value
            if value == neutral:  # of two limits one that nothing reaches stays there
                found.append(0.0)
            else:
                found.append(abs(value - neutral) / half if half > 0.0 else np.inf)
        return max(found, default=np.inf)

    def _levels(self, fit: Fit, least: float = 1.0) -> Array:
        """Held-out sum of squares of every block, not below ``least`` (noise floors, RMS)."""
        return self._of_noise(fit.held_out, least)

    def _of_noise(self, squares: Array, least: float = 1.0) -> Array:
        """Sums of squares of the blocks that have samples, not below ``least`` (noise floors, RMS)."""
        use = self.judge.samples > 0
        return np.maximum(squares[use], self.judge.samples[use].astype(float) * least * least)


def gain(before: Fit, after: Fit, correlation: float) -> tuple[float, float]:
    """Return what ``after`` gains over ``before`` on held-out blocks.

    The first number is the gain of log-likelihood: half the fall of the normalised sum of squares, divided by how many
    samples count as one observation. The second is the fall of the RMS error in standard deviations of it: over the
    whole log, or in the two blocks where it falls most.
    """
    d = before.held_out - after.held_out
    likelihood = 0.5 * float(d.sum()) / correlation
    # the root of a sum of squares of noise has the same variance, correlation / 2, whatever the number of samples
    sums = [np.append(f.held_out, f.held_out.sum()) for f in (before, after)]
    *local, overall = (np.sqrt(np.maximum(sums[0], 0.0)) - np.sqrt(np.maximum(sums[1], 0.0))) / np.sqrt(correlation / 2)
    return likelihood, max(float(overall), SPREADS / BLOCK_SPREADS * float(np.sort(local)[-2:].mean()))


EXCESS = Rule[Comparison](
    "share of the excess", "share",
    "What removes a small share of the error beyond noise corrects the form of another equation.",
    lambda c: c.share_of_excess, lambda _: LEAST_SHARE,
)  # fmt: skip
GAIN = Rule[Comparison](
    "log-likelihood gain", "1",
    "The best useless candidate of the library gains less in 99 of 100 clean logs; each further parameter costs 1.",
    lambda c: c.gain[0], lambda c: NATS + c.further,
)  # fmt: skip
DEVIATIONS = Rule[Comparison](
    "fall of the error", "standard deviations",
    "A fall is detectable from three standard deviations of the error on, and from eight in the two best blocks.",
    lambda c: c.gain[1], lambda _: SPREADS,
)  # fmt: skip
KNOWN_NOISE = (EXCESS, GAIN, DEVIATIONS)
AWAY = Rule[Comparison](
    "away from neutral", "interval half-widths",
    "An effect whose own interval holds the size at which it does nothing is not there.",
    lambda c: c.away_from_neutral, lambda _: 1.0,
)  # fmt: skip


@dataclass(frozen=True)
class Beginning:
    """Effects that begin within a log held against the best that act all along.

    nats   gain of log-likelihood
    times  blocks of the log, in each of which they might have begun
    """

    nats: float
    times: int


BEGINS = Rule[Beginning](
    "gain by an onset", "1",
    "Effects may begin in any block of the log: the best of n times gains the logarithm of n by chance.",
    lambda c: c.nats, lambda c: NATS + float(np.log(c.times)),
)  # fmt: skip

UNKNOWN_NOISE = (
    Rule[Comparison](
        "share of the error", "share",
        "Nominal equations are no better than this, so a smaller fall may patch their form.",
        lambda c: c.share_of_fall, lambda c: c.least_share,
    ),
    Rule[Comparison](
        "share improved", "share",
        "No single block decides: of all changes, block by block, three quarters are improvement.",
        lambda c: c.share_improved, lambda _: LEAST_HELP,
    ),
    Rule[Comparison](
        "blocks that improve", "blocks",
        "One block alone may hold a disturbance.",
        lambda c: float(np.sum(c.block_changes > AGREE)), lambda _: AGREEING_BLOCKS,
    ),
)  # fmt: skip


# ---- curves ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class AllRows:
    """The errors of every sample, log by log, without and with a curve, in noise floors.

    tests  logs that nothing was fitted to
    """

    before: Mapping[str, Array]
    after: Mapping[str, Array]
    tests: frozenset[str]

    @cached_property
    def squares(self) -> tuple[dict[str, float], dict[str, float]]:
        """Sum of squares of each log, before and after."""
        was, now = ({log: float(np.nansum(e * e)) for log, e in of.items()} for of in (self.before, self.after))
        return was, now

    @cached_property
    def many(self) -> dict[str, int]:
        """Samples of each log."""
        return {log: int(np.isfinite(e).sum()) for log, e in self.after.items()}

    @cached_property
    def least_gain(self) -> tuple[float, str]:
        """The least gain of log-likelihood on a log that nothing was fitted to, and that log; infinite without any."""
        was, now = self.squares
        gains = [(0.5 * (was[log] - now[log]), log) for log in sorted(self.tests & set(now)) if self.many[log]]
        return min(gains, default=(np.inf, ""))

    @property
    def fall(self) -> float:
        """Fall of the RMS error of all samples, in standard deviations of independent noise."""
        was, now = (np.sqrt(sum(of.values())) for of in self.squares)
        return float((was - now) * np.sqrt(2.0))

    def objection(self) -> str:
        """Why the curve is not believed, in words; "": it is."""
        if not UNFITTED_ROWS.verdict(self).holds:
            return f"{self.least_gain[1]}: log-likelihood gain of {self.least_gain[0]:.1f} only"
        if ALL_ROWS.verdict(self).holds:
            return ""
        return f"the error falls by {self.fall:.1f} standard deviations of its noise only"


UNFITTED_ROWS = Rule[AllRows](
    "rows not fitted", "1",
    "Samples that nothing was fitted to show the gain by themselves.",
    lambda r: r.least_gain[0], lambda _: NATS, applies=lambda r: bool(r.least_gain[1]),
)  # fmt: skip
ALL_ROWS = Rule[AllRows](
    "fall over all rows", "standard deviations",
    "A fall is detectable from three standard deviations of the noise on.",
    lambda r: r.fall, lambda _: SPREADS,
)  # fmt: skip
NEAR_NOISE = (UNFITTED_ROWS, ALL_ROWS)


@dataclass(frozen=True)
class Confirmation:
    """What another log, or another amplitude, says of a curve that remembers.

    left   the greatest share of its error that it leaves there; infinite where nothing can confirm it
    limit  the share that it may leave
    """

    left: float
    limit: float


CONFIRMED = Rule[Confirmation](
    "memory confirmed", "share",
    "Blocks of one manoeuvre repeat it: memory must hold in another log or at another amplitude.",
    lambda c: c.left, lambda c: c.limit, at_most=True,
)  # fmt: skip
DISSIPATES = Rule[float](
    "energy given back", "share",
    "A hysteresis takes energy from the motion and gives none.",
    lambda share: share, lambda _: NEGATIVE_STOPS, at_most=True,
)  # fmt: skip


# ---- what it does to other logs --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class LogChanges:
    """What a candidate does to each log.

    change  log -> log of the error with it over that without
    tests   names of the logs that nothing was fitted to
    """

    change: Mapping[str, float]
    tests: frozenset[str] = frozenset()

    @property
    def worst(self) -> str | None:
        """The validation log that gets worst; None where there is none."""
        return max((log for log in self.change if log in self.tests), key=lambda log: self.change[log], default=None)

    def objection(self) -> str:
        """Why the logs speak against the candidate, in words; "": they do not."""
        if self.worst is not None and not HARMS_NONE.verdict(self).holds:
            return f"makes {self.worst} worse: {np.exp(self.change[self.worst]):.2f} times the error"
        return "" if IS_OF_USE.verdict(self).holds else f"no log is better by {LEAST_USE:.0%} for it"


HARMS_NONE = Rule[LogChanges](
    "validation logs", "log error",
    "What does not hold on a log that it was not fitted to is no physics.",
    lambda c: c.change[c.worst] if c.worst is not None else -np.inf, lambda _: HARM, at_most=True,
    applies=lambda c: c.worst is not None,
)  # fmt: skip
IS_OF_USE = Rule[LogChanges](
    "best log", "log error",
    "Some log is better for it.",
    lambda c: min(c.change.values(), default=-np.inf), lambda _: -LEAST_USE, at_most=True,
    applies=lambda c: bool(c.change),
)  # fmt: skip
OTHER_LOGS = (HARMS_NONE, IS_OF_USE)
SUITS_ALL = replace(
    HARMS_NONE, name="other subsystems", reason="What acts in several subsystems must suit all of them."
)


# ---- names, and what the whole set leaves ----------------------------------------------------------------------------


@dataclass(frozen=True)
class Naming:
    """An effect that is to be named.

    at_bound         whether a size stands at a physical bound
    cause            what else the same law could turn on; "": nothing
    other_is_better  whether the law with that cause is significantly better
    """

    at_bound: bool
    cause: str
    other_is_better: bool


NAMED = (
    Rule[Naming](
        "physical range", "sizes at a bound",
        "A size at the end of what is physically possible imitates something else.",
        lambda c: float(c.at_bound), lambda _: 0.0, at_most=True,
    ),
    Rule[Naming](
        "cause", "better causes",
        "The same law with another cause is not significantly better.",
        lambda c: float(c.other_is_better), lambda _: 0.0, at_most=True, applies=lambda c: bool(c.cause),
    ),
)  # fmt: skip


@dataclass(frozen=True)
class Remainder:
    """What a set of effects leaves.

    before, after  RMS error without and with its ``effects``, in noise floors; ``worst``: after, of the worst output
    n, correlation samples, and how many of them count as one
    """

    before: float
    after: float
    worst: float
    effects: int
    n: int = 1
    correlation: float = 1.0

    @property
    def explained(self) -> float:
        """Share of the mean square beyond the noise floor, as well as that is known, that the effects explain."""
        excess = self.before**2 - (1.0 + FLOOR_KNOWN) ** 2
        return (self.before**2 - self.after**2) / excess if excess > 0.0 or np.isnan(excess) else np.inf

    @property
    def share_left(self) -> float:
        """Share of the mean square beyond noise that is left."""
        return max(self.after**2 - 1.0, 0.0) / max(self.before**2 - 1.0, 1e-300)

    @property
    def is_noise(self) -> bool:
        """Whether what is left is noise, as well as its level is known."""
        spread = SPREADS * float(floor_deviation(self.n, self.n, self.correlation))
        return self.after <= max(TOLERATED, 1.0 + spread)


EXPLAINS_HALF = Rule[Remainder](
    "explained", "share of the excess",
    "Names that leave most of the error beyond noise are none.",
    lambda r: r.explained, lambda _: EXPLAINED, applies=lambda r: r.effects > 0,
)  # fmt: skip
LEAVES_LITTLE = (
    Rule[Remainder](
        "excess left", "noise floors²",
        "A named set may leave a small share of the error beyond noise: its equations are not nature's.",
        lambda r: r.after**2 - 1.0, lambda r: LEAST_SHARE * max(r.before**2 - 1.0, 1e-12), at_most=True,
        applies=lambda r: not r.is_noise,
    ),
    Rule[Remainder](
        "worst output", "noise floors",
        "No output makes up for another, and each further effect is one more chance to imitate.",
        lambda r: max(r.after, r.worst), lambda r: 1.0 + (LEFT_FLOORS - 1.0) / max(r.effects, 1), at_most=True,
        applies=lambda r: not r.is_noise,
    ),
)  # fmt: skip
LEAVES_A_QUARTER = Rule[Remainder](
    "error left", "share",
    "A set that leaves more than a quarter of the sum of squares beyond noise is not named.",
    lambda r: r.share_left, lambda _: MOST_LEFT, at_most=True, applies=lambda r: r.after > UNKNOWN,
)  # fmt: skip
PROBABLE = Rule[float](
    "probability", "1",
    "A subsystem that fails with its names lacks something else, too: each must be more probable than not.",
    lambda p: p, lambda _: LIKELY,
)  # fmt: skip

RULES: dict[str, Rule[Any]] = {
    rule.name: rule
    for rule in (
        *KNOWN_NOISE, *UNKNOWN_NOISE, AWAY, BEGINS, *NEAR_NOISE, DISSIPATES, CONFIRMED, *OTHER_LOGS, SUITS_ALL, *NAMED,
        EXPLAINS_HALF, *LEAVES_LITTLE, LEAVES_A_QUARTER, PROBABLE,
    )
}  # fmt: skip


def decisions_json(decisions: Iterable[Decision], stage: str) -> list[dict[str, Any]]:
    """Decisions on a subsystem as JSON. A number that is not finite is null."""
    return [
        {
            "stage": stage, "added": list(d.added), "beside": list(d.beside), "accepted": d.accepted,
            "rules": [
                {"rule": v.rule, "value": _finite(v.value), "limit": _finite(v.limit), "holds": v.holds}
                for v in d.verdicts
            ],
        }
        for d in decisions
    ]  # fmt: skip


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None
