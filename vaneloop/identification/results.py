"""What one stage says: effects named, with parameters and rivals, what was recalibrated, what the log cannot show."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from vaneloop.identification.least_squares.problem import Fit, LeastSquaresProblem
from vaneloop.identification.onset import Onset
from vaneloop.identification.selection.rules import Decision
from vaneloop.identification.settings import NINETY, TRUST_COEFFICIENTS, TRUST_MOST_FALL, TRUST_MOST_LEFT
from vaneloop.identification.subsystem import Array, Parameter, Stage

__all__ = [
    "Candidate", "Estimate", "Evidence", "Found", "StageDiagnosis", "answer_of", "at_bound", "estimates",
    "found_of", "interval_of", "parameters_of", "recalibrated", "rms_of", "rms_per_output", "terms", "trust",
    "weigh",
]  # fmt: skip

Evidence = Mapping[str, float]  # left, fall, share: see `terms`


@dataclass
class Candidate:
    """An effect as a candidate: its gain on held-out data when it is added alone to the nominal model.

    nats, spreads  as the criterion counts a gain: nats and noise-floor spreads, or per cent of the error and the share
                   of the change that is improvement
    reason         why it cannot be seen in this log, if it cannot
    left           held-out error with it alone, in noise floors
    """

    effect: str
    nats: float
    spreads: float
    reason: str = ""
    left: float = float("nan")


@dataclass(eq=False)
class Found:
    """An effect named as missing.

    probability  that it is what is missing (`trust`); that of each rival: `probabilities`
    fits         the stage's fit with it, and with each that was tried in its place
    shares       of each of these: how much speaks for it among them
    fall         error without it over the error with it
    evidence     what the probability follows from
    inseparable  what this log cannot tell from what the effect turns on ("time", "oil temperature")
    other_cause  the cause with which its law is significantly better, so that it is no answer; "": none is
    """

    effect: str
    probability: float
    parameters: dict[str, dict[str, object]]
    rivals: list[str]
    nats: float
    fits: dict[str, Fit] = field(default_factory=dict, repr=False)
    shares: dict[str, float] = field(default_factory=dict, repr=False)
    fall: float = 1.0
    evidence: dict[str, float] = field(default_factory=dict)
    probabilities: dict[str, float] = field(default_factory=dict)
    inseparable: list[str] = field(default_factory=list)
    other_cause: str = ""


@dataclass(eq=False)
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
    gain: str = "log-likelihood gain on held-out data"  # what `Candidate.nats` counts
    criterion: str = ""  # what an effect had to do to be named: a name of `TRUST_COEFFICIENTS`
    notes: list[str] = field(default_factory=list)  # what decided between rivals, what was left out, in words
    decisions: list[Decision] = field(default_factory=list, repr=False)  # every acceptance rule's verdict
    onset: Onset | None = None  # when the effects begin; None: they act all along


def rms_of(judge: LeastSquaresProblem, fit: Fit) -> float:
    """RMS of the held-out error, in noise floors."""
    return float(np.sqrt(max(fit.held_out.sum(), 0.0) / max(judge.n, 1)))


# ---- How far a name can be trusted: the probability that the law which is missing is the one named or among its rivals
#
# The search's own shares say which of the laws *that it tried* explains the log best. They cannot say how often none of
# them is it. That is learnt from blind answers (`benchmarks/hidden_effect.py`, `hidden_law.py`), by a logistic
# regression (Platt 1999) on what an answer shows of itself: the more is left, the less the law does and the nearer
# others come, the more its name is doubted. `python -m benchmarks.trust` fits and judges it.


def terms(evidence: Evidence) -> tuple[float, float, float, float]:
    """The regression's terms of one answer.

    left   error that the stage's best model leaves on its worst output, noise floors
    fall   error of the model without the law over the error with it
    share  of all that was tried in its place, what the law and its rivals have, 0 to 1
    """
    left, fall = (
        float(np.clip(evidence[k], 1.0, most)) for k, most in (("left", TRUST_MOST_LEFT), ("fall", TRUST_MOST_FALL))
    )
    return 1.0, float(np.log(left)), float(np.log(fall)), float(np.clip(evidence["share"], 0.0, 1.0)) - 1.0


def trust(criterion: str, evidence: Evidence) -> float:
    """Probability that what is missing is the law named, or one of its rivals."""
    score = sum(b * x for b, x in zip(TRUST_COEFFICIENTS[criterion], terms(evidence), strict=True))
    return float(1.0 / (1.0 + np.exp(-score)))


def weigh(d: StageDiagnosis) -> None:
    """Give each effect of the answer, and each of its rivals, the probability that it is what is missing."""
    left = float(np.max(d.error_after / d.floor))
    for f in d.effects:
        shares = {m: f.shares.get(m, 1.0) for m in (f.effect, *f.rivals)}
        said = sum(shares.values())
        f.evidence = {"left": left, "fall": f.fall, "share": said}
        together = trust(d.criterion, f.evidence)
        f.probabilities = {m: together * v / max(said, 1e-300) for m, v in shares.items()}
        f.probability = f.probabilities[f.effect]


def rms_per_output(judge: LeastSquaresProblem, fit: Fit) -> Array:
    """RMS error of each output in its unit, scaled from fitted to held-out blocks."""
    e = judge.errors(fit.theta[None])[0] * judge.floor[:, None]
    inflation = np.sqrt(max(fit.held_out.sum(), 1e-300) / max(fit.cost.sum(), 1e-300))
    return np.sqrt(judge.mean_squares(e)) * inflation


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


def interval_of(p: Parameter, fit: Fit, k: int) -> tuple[float, float]:
    """The 90 % interval of a fit's free parameter number ``k``, as far as its physical bounds let it reach."""
    low, high = float(fit.low[k]), float(fit.high[k])
    return (low, high) if p.period else (max(low, p.low), min(high, p.high))


def parameters_of(stage: Stage, fit: Fit, name: str) -> dict[str, dict[str, object]]:
    """Fitted parameters of an effect with their 90 % intervals."""
    columns = stage.index()[name]
    out: dict[str, dict[str, object]] = {}
    for i, p in zip(range(columns.start, columns.stop), stage.effect(name).parameters, strict=True):
        low, high = interval_of(p, fit, int(np.flatnonzero(fit.free == i)[0]))
        out[p.name] = {"value": float(fit.theta[i]), "low": low, "high": high, "unit": p.unit}
    return out


@dataclass(frozen=True)
class Estimate:
    """A parameter as it was fitted.

    effect   the effect that it belongs to; "": the model's own
    stderr   standard error; NaN at a bound, where a fit tells none
    low, high  90 % interval, within the physical bounds
    bound    what the fit could take: lowest and highest value
    at_bound whether it stands at one of them
    """

    stage: str
    effect: str
    name: str
    value: float
    stderr: float
    low: float
    high: float
    unit: str
    bound: tuple[float, float]
    at_bound: bool


def estimates(judge: LeastSquaresProblem, fit: Fit) -> list[Estimate]:
    """Every free parameter of a fit, in the order of ``fit.free``."""
    stage, (lowest, highest) = judge.stage, judge.bounds()
    effect_of = {i: name for name, columns in stage.index().items() for i in range(columns.start, columns.stop)}
    out, every = [], stage.all_parameters()
    for k, i in enumerate(fit.free):
        p, value = every[i], float(fit.theta[i])
        bound = float(lowest[i]), float(highest[i])
        at = value <= bound[0] or value >= bound[1]
        stderr = np.nan if at else 0.5 * float(fit.high[k] - fit.low[k]) / NINETY
        effect = effect_of.get(int(i), "")
        out.append(
            Estimate(stage.name, effect, p.name, value, stderr, *interval_of(p, fit, k), p.unit, bound, at)
        )  # fmt: skip
    return out


def found_of(judge: LeastSquaresProblem, fit: Fit, effects: tuple[str, ...], without: Mapping[str, Fit]) -> list[Found]:
    """Effects of a fit that was asked for: no rivals looked for, probability 1 by decree.

    without  effect -> fit of all the others
    """
    left = max(rms_of(judge, fit), 1e-300)
    return [
        Found(m, 1.0, parameters_of(judge.stage, fit, m), [], 0.0, fall=rms_of(judge, without[m]) / left)
        for m in effects
    ]


def recalibrated(stage: Stage, fit: Fit) -> list[dict[str, object]]:
    """Nominal parameters that have moved significantly within their tolerance."""
    out = []
    for k, c in enumerate(fit.free):
        if c < len(stage.parameters):
            p = stage.parameters[c]
            low, high, value = float(fit.low[k]), float(fit.high[k]), float(fit.theta[c])
            if not low <= p.value <= high:
                limit = abs(value - p.expected) >= 0.999 * p.tolerance  # the data pull on beyond what it allows
                low, high = interval_of(p, fit, k)
                moved: dict[str, object] = {"parameter": p.name, "value": value, "low": low, "high": high}
                out.append(moved | {"unit": p.unit, "at_limit": bool(limit)})
    return out


def answer_of(
    judge: LeastSquaresProblem,
    verdict: str,
    base: Fit,
    fit: Fit,
    effects: list[Found],
    steps: list[tuple[str, float]],
    candidates: list[Candidate] | None = None,
    correlation: float = 1.0,
) -> StageDiagnosis:
    """What a stage says of a fit with these effects, held against ``base``."""
    stage = judge.stage
    return StageDiagnosis(
        stage.name, stage.outputs, stage.units, verdict, judge.floor, base, fit, rms_per_output(judge, base),
        rms_per_output(judge, fit), effects, recalibrated(stage, fit), candidates or [], correlation, steps,
        rms_of(judge, fit),
    )  # fmt: skip
