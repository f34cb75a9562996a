"""Compare, diagnose and extend over all stages of a model, and the JSON of it."""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, wait
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from vaneloop.base.side_by_side import forks, in_processes
from vaneloop.identification.least_squares.noise import correlation_of
from vaneloop.identification.least_squares.problem import Fit, LeastSquaresProblem, recalibrate
from vaneloop.identification.onset import begun, onset_of
from vaneloop.identification.regimes import Located, Shape, StageFigures, agrees, locate, shape
from vaneloop.identification.results import StageDiagnosis, parameters_of, recalibrated, rms_of, rms_per_output, weigh
from vaneloop.identification.selection.diagnosis import Judged, diagnose_stage, extend_stage, floor_of
from vaneloop.identification.selection.likelihood_acceptance import LikelihoodAcceptance, as_close, significant
from vaneloop.identification.selection.rules import PROBABLE, Decisions, decisions_json
from vaneloop.identification.settings import LOOK_EVERY, NATS, SHORT_SEARCH, SIZES_AGREE, USUAL_FITS
from vaneloop.identification.subsystem import Stage, StageError

__all__ = [
    "Diagnosis", "News", "StageError", "StageFigures", "as_compared", "compare_stages", "diagnose", "diagnosis_json",
    "extend_stage", "floor_of", "locate_stages", "no_better", "verdict_of",
]  # fmt: skip


@dataclass(eq=False)
class Diagnosis:
    """What all stages say together."""

    verdict: str
    stages: list[StageDiagnosis]
    shapes: dict[str, list[Shape]]
    not_observed: dict[str, str]
    elapsed_s: float
    notes: list[str] = field(default_factory=list)


def locate_stages(stages: Sequence[Stage], progress: Callable[[float, str], None] | None = None) -> list[Located]:
    """Every stage with nothing added, driven by its own logged inputs: how large its error is, and under which
    conditions.
    """
    out = []
    for i, stage in enumerate(stages):
        if progress:
            progress(i / len(stages), stage.name)
        out.append(locate(LeastSquaresProblem(stage, floor_of(stage))))
    return out


def compare_stages(stages: Sequence[Stage]) -> list[StageFigures]:
    """Error of every output of every stage, driven by its own logged inputs, with nothing added."""
    return [figures for located in locate_stages(stages) for figures in located.signals]


@dataclass(frozen=True, eq=False)
class News:
    """How far a search is.

    fraction  done, as far as that can be known: a search ends when nothing more earns its place
    text      what is being tried
    found     what a stage says, as soon as it is searched; the other stages may still correct it (`diagnose`)
    """

    fraction: float
    text: str
    found: StageDiagnosis | None = None


class _Work:
    """The stages of one search.

    judged  what an effect must do to be named
    fits    fits made by each stage, numbers that all processes of the search see
    """

    def __init__(self, stages: Sequence[Stage], judged: Judged = LikelihoodAcceptance):
        self.stages, self.judged = list(stages), judged
        self.fits: list[Any] = [multiprocessing.RawValue("l", 0) for _ in self.stages]


def _one(work: _Work, i: int, tell: Callable[[], None] | None = None) -> tuple[StageDiagnosis, list[Shape]]:
    stage = work.stages[i]

    def tick() -> None:
        work.fits[i].value += 1  # one process writes each
        if tell:
            tell()

    d = as_compared(stage, diagnose_stage(stage, floor_of(stage), tick=tick, judged=work.judged))
    if d.criterion == "noise_floor":
        d = _as_located(stage, d)
        if d.verdict == "missing":
            d = _probable(stage, d)
    return d, shape(LeastSquaresProblem(stage, d.floor), d.final) if _leaves(d) else []


def _as_located(stage: Stage, d: StageDiagnosis) -> StageDiagnosis:
    """The answer as `locate` has it: "none" where the stage fits everywhere with nothing added, though little is enough
    for a search; without an effect "unknown" where it fails over the whole log or under a condition.
    """
    if d.verdict == "missing":
        judge = LeastSquaresProblem(stage, floor_of(stage))
        if locate(judge, d.base).fails:
            return d
        names = ", ".join(d.final.effects)
        d.notes.append(f"{stage.name} fits everywhere with nothing added; {names} would help, and is not named")
        return replace(
            d, verdict="none", floor=judge.floor, final=d.base, error_after=d.error_before, effects=[], onset=None,
            steps=d.steps[:1], excess=rms_of(judge, d.base), recalibrated=recalibrated(stage, d.base),
        )  # fmt: skip
    if d.final.effects:
        return d
    located = locate(LeastSquaresProblem(stage, d.floor), d.final)
    if d.verdict == "none" and located.hot:
        return replace(d, verdict="unknown", refused=[f"fails at {located.hot[0].worst()}"])
    if d.verdict == "unknown" and not d.refused and not located.fails:
        return replace(d, verdict="none", nearest=[])
    return d


def _probable(stage: Stage, d: StageDiagnosis) -> StageDiagnosis:
    """The answer; where the stage fails with its names, without those that are improbable."""
    weigh(d)
    if agrees(float(np.max(d.error_after / d.floor)), 1.0):
        return d
    decisions, doubted = Decisions(d.decisions), dict[str, str]()
    for f in d.effects:
        together = sum(f.probabilities.values())
        if not decisions.decide([PROBABLE], together, (f.effect,), [g.effect for g in d.effects if g is not f]):
            doubted[f.effect] = f"{f.effect} has a probability of {together:.2g}, and the subsystem fails with it"
    d.decisions = list(decisions)
    if not doubted:
        return d
    left = [f for f in d.effects if f.effect not in doubted]
    judge = LeastSquaresProblem(begun(stage, onset_of(stage, d.final.theta)), d.floor)
    fit = _with(judge, {f.effect: d.final for f in left}) if left else d.base
    d = replace(
        d, verdict="missing" if left else "unknown", final=fit, error_after=rms_per_output(judge, fit),
        effects=[replace(f, parameters=parameters_of(stage, fit, f.effect)) for f in left], excess=rms_of(judge, fit),
        recalibrated=recalibrated(stage, fit),
    )  # fmt: skip
    if left:
        return replace(
            d, steps=[*d.steps[:-1], (" + ".join(fit.effects), d.excess)], notes=[*d.notes, *doubted.values()]
        )
    return replace(d, nearest=list(doubted)[:3], refused=list(doubted.values()), steps=d.steps[:1], onset=None)


def as_compared(stage: Stage, d: StageDiagnosis) -> StageDiagnosis:
    """The diagnosis with the error before as `compare_stages` has it, where a search has begun anew with a lower noise
    floor.
    """
    floor = floor_of(stage)
    if not np.array_equal(d.floor, floor):
        judge = LeastSquaresProblem(stage, floor)
        d.base = recalibrate(judge)
        d.error_before = rms_per_output(judge, d.base)
        if not d.final.effects:
            d.final, d.error_after = d.base, d.error_before
    return d


def _leaves(d: StageDiagnosis) -> bool:
    """Whether what is left asks for words: something is missing, or still missing."""
    return d.verdict == "unknown" or (d.verdict != "none" and not agrees(d.excess, 1.0))


def diagnose(
    stages: Sequence[Stage],
    not_observed: dict[str, str] | None = None,
    progress: Callable[[float], None] | None = None,
    workers: int = 2,
    judged: Judged = LikelihoodAcceptance,
    news: Callable[[News], None] | None = None,
) -> Diagnosis:
    """Search every stage for missing effects; stages run side by side in ``workers`` processes where the system can
    fork.

    judged    what an effect must do to be named
    progress  takes the fraction done
    news      takes that too, with what is being tried and what each stage says as soon as it is searched
    """
    started = time.perf_counter()
    work = _Work(stages, judged)
    side_by_side = forks(workers, len(work.stages))
    order = _order(work.stages, side_by_side)
    done: dict[int, tuple[StageDiagnosis, list[Shape]]] = {}

    def tell(found: StageDiagnosis | None = None) -> None:
        told = News(*_how_far(work, set(done)), found)
        if progress:
            progress(told.fraction)
        if news:
            news(told)

    if side_by_side:
        with in_processes(_one, work, workers) as submit:
            open_jobs = {submit(i): i for i in order}
            while open_jobs:
                ended, _ = wait(open_jobs, LOOK_EVERY if news or progress else None, FIRST_COMPLETED)
                for job in ended:
                    i = open_jobs.pop(job)
                    done[i] = job.result()
                    tell(done[i][0])
                if not ended:
                    tell()
    else:
        for i in order:
            done[i] = _one(work, i, tell)
            tell(done[i][0])
    results = [done[i][0] for i in range(len(work.stages))]
    by_name = {s.name: s for s in stages}
    _agree(by_name, results)
    for d in results:
        weigh(d)
    _join(by_name, results)
    shapes = {done[i][0].stage: done[i][1] for i in range(len(work.stages)) if done[i][1]}
    return Diagnosis(verdict_of(results), results, shapes, dict(not_observed or {}), time.perf_counter() - started)


def verdict_of(results: Sequence[StageDiagnosis]) -> str:
    """What all stages say together."""
    verdicts = {d.verdict for d in results}
    return "missing" if "missing" in verdicts else "unknown" if "unknown" in verdicts else "none"


def _order(stages: Sequence[Stage], side_by_side: bool) -> list[int]:
    """Stages in the order in which they are searched: those that take next to nothing, so that something is found at
    once, then the longest. Side by side with others the longest of all begins: the end waits for it.
    """
    size = [len(s.effects) * len(s.outputs) for s in stages]
    by_size = sorted(range(len(stages)), key=lambda i: size[i])
    short = [i for i in by_size if SHORT_SEARCH * size[i] < size[by_size[-1]]]
    out = [*short, *(i for i in reversed(by_size) if i not in short)]
    return sorted(out, key=lambda i: i != by_size[-1]) if side_by_side else out


def _how_far(work: _Work, done: set[int]) -> tuple[float, str]:
    """Fraction of the search that is done, and what is being tried: nobody knows how many fits there will be."""
    size = [max(1, len(s.effects)) * len(s.outputs) for s in work.stages]
    fits = [n.value for n in work.fits]
    share = [1.0 if i in done else fits[i] / (fits[i] + USUAL_FITS) for i in range(len(work.stages))]
    at_work = [
        f"{stage.name} ({len(stage.effects)} effects, {fits[i]} fits)"
        for i, stage in enumerate(work.stages)
        if i not in done and fits[i]
    ]
    text = f"{len(done)} of {len(work.stages)} subsystems searched" + (
        f"; trying {', '.join(at_work)}" if at_work else ""
    )
    return sum(a * b for a, b in zip(share, size, strict=True)) / sum(size), text


def _agree(stages: dict[str, Stage], results: list[StageDiagnosis]) -> None:
    """Let the stages settle each other's answers: an effect that acts in two stages must do so in both by the same
    amount.

    Among an effect and its rivals those go that another stage contradicts; those stay alone that another stage names
    too. Where all of them are contradicted, with any size near theirs, the next best of those that were tried takes the
    place if it explains as much; else the stage's answer is "unknown".
    """
    for d in results:
        judge = LeastSquaresProblem(begun(stages[d.stage], onset_of(stages[d.stage], d.final.theta)), d.floor)
        for k, f in enumerate(d.effects):
            elsewhere = {
                m: [o for o in results if o is not d and o.verdict != "unknown" and m in stages[o.stage].index()]
                for m in f.fits
            }
            options = [f.effect, *f.rivals]
            left = [m for m in options if all(_fits(stages, d, f.fits[m], o, m, _doubt(o, m)) for o in elsewhere[m])]
            if not left:
                left = [m for m in options if all(_fits(stages, d, f.fits[m], o, m, SIZES_AGREE) for o in elsewhere[m])]
            beside = {
                g.effect: d.final for g in d.effects if g is not f
            }  # they may have changed since the rivals were fitted
            refitted: dict[str, Fit] = {}
            for m in () if left else sorted((m for m in f.shares if m not in options), key=lambda m: -f.shares[m]):
                if all(_fits(stages, d, f.fits[m], o, m) for o in elsewhere[m]):
                    refitted[m] = _with(
                        judge, {**beside, m: f.fits[m]}
                    )  # where an excerpt was searched, to the whole log now
                    if as_close(judge, d, refitted[m]):
                        left = [m]
                        break
            if not left:
                d.verdict, d.nearest, d.effects = "unknown", options[:3], []
                d.refused = [f"{m} is contradicted by {elsewhere[m][0].stage}" for m in options if elsewhere[m]]
                break
            seconded = [m for m in left if any(m in (g.effect, *g.rivals) for o in elsewhere[m] for g in o.effects)]
            left = seconded or left
            if left == options:
                continue
            name, fit = left[0], d.final
            if name != f.effect:
                fit = refitted.get(name) or _with(judge, {**beside, name: f.fits[name]})
                d.final, d.error_after, d.excess = fit, rms_per_output(judge, fit), rms_of(judge, fit)
                d.steps = [*d.steps[:-1], (" + ".join(fit.effects), d.excess)]
                d.recalibrated = recalibrated(stages[d.stage], fit)
                for other in d.effects:
                    if other is not f:
                        other.parameters = parameters_of(stages[d.stage], fit, other.effect)
            shares = {m: v for m, v in f.shares.items() if m in left or m not in options}  # the others are refuted
            whole = max(sum(shares.values()), 1e-300)
            d.effects[k] = replace(
                f, effect=name, rivals=left[1:], shares={m: v / whole for m, v in shares.items()},
                parameters=parameters_of(stages[d.stage], fit, name),
            )  # fmt: skip


def _doubt(other: StageDiagnosis, effect: str) -> float:
    """By what share of its size a stage that names an effect too may be wrong about it: errors of form are its own."""
    return SIZES_AGREE if any(effect in (g.effect, *g.rivals) for g in other.effects) else 0.0


def _with(judge: LeastSquaresProblem, sources: dict[str, Fit]) -> Fit:
    """Fit exactly these effects, each started from its size in the fit given; the last one's nominal parameters too."""
    index, start = judge.stage.index(), judge.stage.neutral()
    for name, fit in sources.items():
        nominal = slice(len(judge.stage.parameters))
        start[nominal], start[index[name]] = fit.theta[nominal], fit.theta[index[name]]
    return judge.fit(tuple(sources), start, 4)


def _fits(
    stages: dict[str, Stage], d: StageDiagnosis, fit: Fit, other: StageDiagnosis, effect: str, near: float = 0.0
) -> bool:
    """Whether the effect may have the size that stage ``d`` gives it, within its interval, in the stage ``other`` too.

    near  share of its size by which the interval is widened
    """
    stage = stages[other.stage]
    mine, theirs = stages[d.stage].index()[effect], stage.index()[effect]
    at = [int(np.flatnonzero(fit.free == c)[0]) for c in range(mine.start, mine.stop)]
    gone = _in_place_of(stage, other, effect)
    rivals = (g for g in other.effects if g.effect in gone and g.effect != effect)
    own = next((g.fits[effect] for g in rivals if effect in g.fits), other.final)
    there, turns = own.theta[theirs].copy(), [p.period for p in stage.effect(effect).parameters]
    for i, turn in enumerate(turns):
        if turn:
            there[i] += turn * np.round((fit.theta[mine][i] - there[i]) / turn)
    wider = near * np.abs(fit.theta[mine] - stages[d.stage].neutral()[mine])
    size = np.clip(there, fit.low[at] - wider, fit.high[at] + wider)
    if np.array_equal(size, there) and own is other.final:
        return True
    # from when on it acts is the machine's, too
    when = onset_of(stages[d.stage], fit.theta) if not other.final.effects else onset_of(stage, other.final.theta)
    judge = LeastSquaresProblem(begun(stage, when), other.floor)
    start = other.final.theta.copy()
    for columns in (stage.index()[e] for e in gone):
        start[columns] = stage.neutral()[columns]
    start[theirs] = size
    held = judge.fit(tuple(e for e in other.final.effects if e not in gone), start, 6)
    return not significant(judge, held, other.final, correlation_of(judge, other.final))


def _in_place_of(stage: Stage, other: StageDiagnosis, effect: str) -> tuple[str, ...]:
    """The effects of a stage's answer that this one stands in place of: itself, or else its family's."""
    named, family = other.final.effects, stage.effect(effect).family
    if effect in named or not family:
        return tuple(e for e in named if e == effect)
    return tuple(e for e in named if stage.effect(e).family == family)


def _join(stages: dict[str, Stage], results: Sequence[StageDiagnosis]) -> None:
    """Give one name to what stages say of a family: where members are each other's rivals, that of a stage that tells
    them apart, of several that of the one where it gains most; where each stage names its own and their sizes agree,
    the family's, for each place has it.
    """
    families: dict[str, list[tuple[StageDiagnosis, int]]] = {}
    for d in results:
        for k, f in enumerate(d.effects):
            if family := stages[d.stage].effect(f.effect).family:
                families.setdefault(family, []).append((d, k))
    for family, members in families.items():
        own = {m for d, k in members for m in (d.effects[k].effect, *d.effects[k].rivals)
               if stages[d.stage].effect(m).family == family}  # fmt: skip
        lead = max((d.effects[k] for d, k in members), key=lambda f: (own.isdisjoint(f.rivals), f.nats)).effect
        for d, k in members:
            f = d.effects[k]
            if lead in f.rivals and lead in f.fits:
                d.effects[k] = replace(
                    f, effect=lead, rivals=[f.effect if m == lead else m for m in f.rivals],
                    parameters=parameters_of(stages[d.stage], f.fits[lead], lead),
                    probability=f.probabilities.get(lead, f.probability),
                )  # fmt: skip
        found = [d.effects[k] for d, k in members]
        if len({f.effect for f in found}) < max(2, len(found)) or not _alike([f.parameters for f in found]):
            continue
        for d, k in members:
            f = d.effects[k]
            names = {f.effect: family}
            d.effects[k] = replace(
                f, effect=family, probabilities={names.get(m, m): v for m, v in f.probabilities.items()}
            )


def _alike(parameters: Sequence[Mapping[str, Mapping[str, Any]]]) -> bool:
    """Whether all of these sizes of an effect may be one: their intervals have a value in common. Those of one size
    lack it in one of 50 pairs: 90 % intervals of equal width part where the sizes differ by 2.3 standard deviations.
    """
    return all(
        max(float(p[name]["low"]) for p in parameters) <= min(float(p[name]["high"]) for p in parameters)
        for name in parameters[0]
    )


def no_better(r: StageDiagnosis) -> str | None:
    """Say in one line that the effects of `extend_stage` do not bring the model nearer to the log;
    None: they do.

    Errors are held-out; on the data that it was fitted to, a model with more effects is never farther off.
    """
    before = r.steps[0][1]
    if not r.final.effects or r.excess < before:
        return None
    on_bound = [
        f"{f.effect} {n}" for f in r.effects for n, p in f.parameters.items() if p["low"] == p["value"] == p["high"]
    ]
    why = f"; on a bound or neutral: {', '.join(on_bound)}" if on_bound else ""
    return (
        f"{r.stage}: {', '.join(r.final.effects)} takes the error from {before:.4g} to {r.excess:.4g} noise "
        f"floors, no better{why}"
    )


def diagnosis_json(d: Diagnosis, log: str) -> dict[str, Any]:
    """Return the diagnosis as the JSON of the command."""
    stages, effects, recalibrated, unknown, unobservable = [], [], [], [], []
    for s in d.stages:
        for k in range(len(s.floor)):
            stages.append(
                {
                    "stage": s.stage,
                    "verdict": s.verdict,
                    "signal": s.outputs[k],
                    "unit": s.units[k],
                    "error_before": float(s.error_before[k]),
                    "error_after": float(s.error_after[k]),
                    "noise_floor": float(s.floor[k]),
                }
            )
        for f in s.effects:
            effects.append(
                {
                    "effect": f.effect, "stage": s.stage, "probability": f.probability, "parameters": f.parameters,
                    "rivals": f.rivals,
                    "inseparable": f.inseparable, "probabilities": f.probabilities, "evidence": f.evidence,
                    **({"onset_s": asdict(s.onset)} if s.onset else {}),
                }
            )  # fmt: skip
        recalibrated += s.recalibrated
        if _leaves(s):
            text = "; ".join(x.text for x in d.shapes.get(s.stage, [])) or "no shape found"
            text = "; ".join([text, *s.refused])
            leaning = s.nearest or [c.effect for c in s.candidates if c.nats > NATS][:3]
            unknown.append({"stage": s.stage, "shape": text, "nearest_effects": leaning})
        unobservable += [{"effect": c.effect, "stage": s.stage, "needs": c.reason} for c in s.candidates if c.reason]
    for name, why in d.not_observed.items():
        stages.append(
            {
                "stage": name, "verdict": "not_observed", "signal": None, "unit": None, "error_before": None,
                "error_after": None,
                "noise_floor": None, "reason": why,
            }
        )  # fmt: skip
    effects.sort(key=lambda e: -float(str(e["probability"])))
    # an effect that shows in two stages is one effect: the stage where it gains most speaks for it
    best: dict[str, tuple[float, str]] = {}
    for s in d.stages:
        for f in s.effects:
            if f.effect not in best or f.nats > best[f.effect][0]:
                best[f.effect] = (f.nats, s.stage)
    effects = [e for e in effects if best[str(e["effect"])][1] == e["stage"]]
    return {
        "schema": 1,
        "log": log,
        "verdict": d.verdict,
        "stages": stages,
        "effects": effects,
        "recalibrated": recalibrated,
        "unknown": unknown,
        "not_observable": unobservable,
        "notes": d.notes,
        "decisions": [one for s in d.stages for one in decisions_json(s.decisions, stage=s.stage)],
        "elapsed_s": d.elapsed_s,
    }
