"""A user's own model, log by log: how much each law brings on each log, fitted or only tested, and what it all says.

The search is that of every model (`identification.workflow`); here is what several logs have beyond one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from plant import Model
from vaneloop.base.tables import read
from vaneloop.identification.candidates import laws
from vaneloop.identification.candidates.laws import HYSTERETIC
from vaneloop.identification.least_squares.problem import Fit, LeastSquaresProblem
from vaneloop.identification.regimes import agrees
from vaneloop.identification.results import StageDiagnosis, answer_of, at_bound, interval_of, rms_of
from vaneloop.identification.selection.diagnosis import Judged
from vaneloop.identification.selection.relative_error_acceptance import RelativeErrorAcceptance
from vaneloop.identification.settings import BOUND_PULL, DRIVES, LEAST_FALL, NO_HELP, STARTS_LOADED
from vaneloop.identification.subsystem import Array, StageError
from vaneloop.identification.user_models.bound_system import BoundSystem, rms_of_rows
from vaneloop.identification.user_models.system import Record, System

__all__ = ["ByLog", "Logs", "as_given", "bind", "load_model_of", "parameter_warnings"]


@dataclass
class Logs:
    """A system held against the logs that it is fitted to, and against those that only test it."""

    fitted: BoundSystem
    test: BoundSystem | None

    def errors(self, theta: Array) -> dict[str, Array]:
        """Error of every sample of each output, log by log; NaN where nothing was measured."""
        out = self.fitted.errors(theta)
        if self.test is not None:
            out |= self.test.errors(self.test.theta_from(self.fitted, theta))
        return out

    def figures(self, theta: Array) -> dict[str, Array]:
        """RMS error of every output, log by log."""
        return {log: rms_of_rows(e) for log, e in self.errors(theta).items()}

    def judged(self) -> Judged:
        """What earns a law its place: its share of the error, and what the test logs say."""
        floor = self.fitted.floor

        def levels(theta: Array) -> dict[str, float]:
            by = {log: v for log, v in self.figures(theta).items() if np.isfinite(v).all()}
            return {log: float(np.log(np.maximum(v / floor, 1.0)).mean()) for log, v in by.items()}

        return partial(RelativeErrorAcceptance, figures=levels, tests=frozenset(self.test.logs if self.test else ()))


def bind(system: System, logs: Sequence[Record], test: Sequence[Record] = (), model: Model | None = None) -> Logs:
    """Put logs into a system, with what a model file says of it."""
    m = model or Model()
    bound = BoundSystem(system, list(logs), values=m.parameters, present=m.effects, curves=m.curves)
    return Logs(bound, BoundSystem(system, list(test), like=bound) if test else None)


def as_given(logs: Logs, fit: Fit) -> StageDiagnosis:
    """The model with nothing added, as it was fitted to say where it fails."""
    judge = LeastSquaresProblem(logs.fitted.thinned, logs.fitted.floor)
    return answer_of(judge, "none", fit, fit, [], [("model", rms_of(judge, fit))])


@dataclass(eq=False)
class ByLog:
    """What an answer (``d``) means for each log.

    steps     RMS error of every output after each step of the waterfall: step -> log -> RMS per output
    ablation  law -> log -> error with it over error without it (each refitted on the fitted logs), over all outputs
    notes     what the user should know
    model     the model from now on: its parameters as fitted, its laws
    """

    logs: Logs
    d: StageDiagnosis
    steps: dict[str, dict[str, Array]] = field(default_factory=dict)
    ablation: dict[str, dict[str, float]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    model: Model = field(default_factory=Model)

    @classmethod
    def of(cls, logs: Logs, d: StageDiagnosis, before: Model | None = None) -> ByLog:
        """Work it out; ``before``: the model that the answer started from."""
        bound, final = logs.fitted, d.final
        judge = LeastSquaresProblem(bound.thinned, d.floor)
        named = {"model": d.base.theta}
        # the waterfall log by log: laws in the order in which they came in, each step fitted
        theta = d.base.theta
        for k in range(1, len(final.effects)):
            part = judge.fit(final.effects[:k], _seeded(bound, theta, final.theta, final.effects[:k]), 12)
            named[" + ".join(part.effects)] = theta = part.theta
        if final.effects:
            named[" + ".join(final.effects)] = final.theta
        notes = list(dict.fromkeys([*bound.notes, *(logs.test.notes if logs.test else ())]))
        out = cls(logs, d, {step: logs.figures(theta) for step, theta in named.items()}, notes=notes)
        out._ablate(judge)
        out._remark(judge)
        m = before or Model()
        out.model = Model(
            parameters=dict(m.parameters),
            effects={k: dict(v) for k, v in m.effects.items()},
            meta={"system": bound.system.name, **m.meta},
            curves={k: v for k, v in m.curves.items() if k in m.effects},
        )
        for p, v in zip(bound.stage.parameters, final.theta, strict=False):
            law, _, parameter = p.name.rpartition(".")
            (out.model.effects[law] if law else out.model.parameters)[parameter if law else p.name] = float(v)
        for f in d.effects:
            if f.effect in bound.curves:
                out.model.curves[f.effect] = bound.curves[f.effect]
            out.model.effects[f.effect] = {k: float(str(v["value"])) for k, v in f.parameters.items()}
        return out

    def _ablate(self, judge: LeastSquaresProblem) -> None:
        bound, final = self.logs.fitted, self.d.final
        last = list(self.steps.values())[-1]
        for name in final.effects:
            rest = tuple(e for e in final.effects if e != name)
            by = self.steps["model"]
            if rest:
                without = judge.fit(rest, _seeded(bound, self.d.base.theta, final.theta, rest), 12)
                by = self.logs.figures(without.theta)
            self.ablation[name] = {log: float(np.exp(np.nanmean(np.log(last[log] / by[log])))) for log in by}

    def _remark(self, judge: LeastSquaresProblem) -> None:
        bound, d = self.logs.fitted, self.d
        for name, ratios in self.ablation.items():
            for log, r in ratios.items():
                if r > NO_HELP:
                    how = "hardly helps" if r < 0.98 else "does not help"
                    self.notes.append(f"{name} {how} on {log}: error with it over error without it is {r:.2f}")
        laws = ", ".join(d.final.effects)
        for i, p in enumerate(bound.stage.parameters):
            v0 = d.base.theta[i]
            if d.final.theta[i] == 0.0 and v0 != 0.0 and p.low == 0.0 and p.tolerance > 0:
                was = f"it was {v0:.4g} {p.unit} while {laws} was missing"
                self.notes.append(f"{p.name}: not needed any more, set to 0 ({was})")
        self.notes += [*_loaded(bound, judge, d), *_between(bound, judge, d), *d.notes]
        self.notes += [n for n in parameter_warnings(bound, judge, d) if n not in self.notes]

    def together(self) -> dict[str, dict[str, Array]]:
        """RMS error of each output over all samples of the fitted logs, and of the test logs: step -> "fitted" | "test"
        -> RMS.
        """
        out: dict[str, dict[str, Array]] = {}
        for step, by in self.steps.items():
            out[step] = {}
            for what, bound in (("fitted", self.logs.fitted), ("test", self.logs.test)):
                if bound is not None:
                    n = np.array([np.isfinite(bound.measured[:, at]).sum(axis=1) for at in bound.logs.values()])
                    squares = np.array([np.where(np.isfinite(by[log]), by[log], 0.0) ** 2 for log in bound.logs])
                    out[step][what] = np.sqrt((n * squares).sum(axis=0) / np.maximum(n.sum(axis=0), 1))
        return out

    def rows(self) -> list[tuple[str, str, int, list[float], float]]:
        """A line for each log and output, and for all logs of a kind: log, "fitted" or "test", output, error after each
        step, RMS of the output.
        """
        d, out = self.d, []
        together = self.together()
        kinds = [("fitted", self.logs.fitted), *([("test", self.logs.test)] if self.logs.test else [])]
        for what, bound in kinds:
            for log, at in bound.logs.items():
                for k in range(len(d.outputs)):
                    errors = [float(by[log][k]) for by in self.steps.values()]
                    out.append((log, what, k, errors, _size(bound.measured[k, at])))
        for what, bound in kinds:
            for k in range(len(d.outputs)) if len(bound.logs) > 1 else ():
                errors = [float(by[what][k]) for by in together.values()]
                out.append((f"all {len(bound.logs)} together", what, k, errors, _size(bound.measured[k])))
        return out

    def tested(self, floor: Array | None = None) -> dict[str, float]:
        """What the last step leaves of each test log, in noise floors (default: its own), not below one."""
        last, floor = list(self.steps.values())[-1], self.logs.fitted.floor if floor is None else floor
        levels = {log: np.maximum(v / floor, 1.0) for log, v in last.items() if log not in self.logs.fitted.logs}
        return {log: float(np.exp(np.nanmean(np.log(v)))) for log, v in levels.items() if np.isfinite(v).any()}

    def sentence(self) -> str:
        """What is left, in words."""
        d = self.d
        k = int(np.argmax(d.error_before / d.floor))
        share = 100.0 * d.error_after[k] / _size(self.logs.fitted.measured[k])
        return (
            f"{d.outputs[k]} is left with an error of {d.error_after[k]:.4g} {d.units[k]} ({share:.2g} % of its RMS), "
            f"{d.excess:.3g} times the noise of its samples"
        )

    def parameters(self) -> list[dict[str, object]]:
        """The model's own parameters as fitted, with 90 % intervals."""
        fit = self.d.final
        out: list[dict[str, object]] = []
        for i, p in enumerate(self.logs.fitted.stage.parameters):
            where = np.flatnonzero(fit.free == i)
            value = float(fit.theta[i])
            low, high = interval_of(p, fit, int(where[0])) if len(where) else (value, value)
            out.append({"parameter": p.name, "value": value, "low": low, "high": high, "unit": p.unit})
        return out

    def json(self) -> dict[str, Any]:
        """What the commands' JSON has beyond that of one log (docs/diagnosis.md)."""
        d, fitted = self.d, self.logs.fitted
        free = {p.name for p in fitted.system.parameters if np.isinf(p.tolerance)}
        moved = [r for r in d.recalibrated if r["parameter"] not in free]
        sizes = {(log, k): size for log, _, k, _, size in self.rows()}
        return {
            "recalibrated": [r for r in moved if not str(r["parameter"]).startswith("start_")],
            "parameters": self.parameters(),
            "waterfall": {d.stage: [{"step": n, "noise_floors": v} for n, v in d.steps]},
            "logs": [
                {
                    "log": log, "fitted": log in fitted.logs, "signal": d.outputs[k], "unit": d.units[k], "step": step,
                    "rms": float(rms[k]), "relative": float(rms[k] / sizes[log, k]),
                }
                for step, by in self.steps.items() for log, rms in by.items() for k in range(len(d.outputs))
            ],
            "together": [
                {"logs": what, "signal": d.outputs[k], "unit": d.units[k], "step": step, "rms": float(rms[k])}
                for step, by in self.together().items() for what, rms in by.items() for k in range(len(d.outputs))
            ],
            "ablation": [
                {"effect": e, "log": log, "error_ratio": v, "helps": v < NO_HELP}
                for e, by in self.ablation.items() for log, v in by.items()
            ],
            "notes": self.notes,
        }  # fmt: skip


def _size(y: Array) -> float:
    return float(np.sqrt(np.nanmean(y**2))) if np.isfinite(y).any() and np.nanmax(np.abs(y)) > 0.0 else 1.0


def _between(bound: BoundSystem, judge: LeastSquaresProblem, d: StageDiagnosis) -> list[str]:
    """What it would change if the inputs ran straight between samples, where the model holds them: an input that varies
    smoothly comes half a sample late, as no law of the machine's would have it.
    """
    s = bound.system
    if s.kind != "simulate" or not s.holds or not s.inputs or agrees(d.excess, 1.0):
        return []
    bound.runner.system = replace(s, between="line")
    try:
        other = judge.fit(d.final.effects, d.final.theta, 12)
    finally:
        bound.runner.system = s
    before, after = (float(f.cost.sum()) / max(judge.n, 1) for f in (d.final, other))
    if before - after < LEAST_FALL * (before - 1.0):
        return []
    share = np.sqrt(after / before)
    return [f'inputs are held from sample to sample; with between="line" the error is {share:.2f} times as large']


def _loaded(bound: BoundSystem, judge: LeastSquaresProblem, d: StageDiagnosis) -> list[str]:
    """What it would change to start springs with the force that was measured at the start."""
    codes = {q.effect: q.law.code for q in bound.placed}
    springs = [e for e in (*d.final.effects, *bound.present) if codes[e] in HYSTERETIC]
    if bound.system.kind != "force" or bound.runner.loaded or not springs:
        return []
    held = [bound.data.held(k) for k in range(len(bound.logs))]
    if max(np.abs(held)) < STARTS_LOADED * bound.runner.noise_of_force:
        return []
    bound.runner.loaded = True
    other = judge.fit(d.final.effects, judge.fit(d.final.effects, d.final.theta, 12).theta, 12)
    bound.runner.loaded = False
    before, after = (float(np.sqrt(f.cost.sum() / max(judge.n, 1)) * d.floor[0]) for f in (d.final, other))
    unit = d.units[0]
    names = [p.name for e in bound.stage.effects for p in e.parameters]
    index, n = bound.stage.index(), len(bound.stage.parameters)
    moved = [
        f"{e.rpartition('.')[2]} {names[c - n]} {d.final.theta[c]:.4g} to {other.theta[c]:.4g}"
        for e in d.final.effects for c in range(index[e].start, index[e].stop)
        if abs(other.theta[c] - d.final.theta[c]) > 0.02 * abs(d.final.theta[c])
    ]  # fmt: skip
    text = f"{' and '.join(springs)} taken as unloaded at the start, where {held[0]:.3g} {unit} was measured; "
    text += f'with start_force="measured" the error goes from {before:.4g} to {after:.4g} {unit}'
    return [text + (f", {', '.join(moved)}" if moved else "")]


def _seeded(bound: BoundSystem, base: Array, final: Array, effects: tuple[str, ...]) -> Array:
    """Start of a fit with some laws of the final model: theirs from there, all others absent."""
    out = bound.stage.neutral()
    n = len(bound.stage.parameters)
    out[:n] = final[:n] if effects else base[:n]
    for e in effects:
        at = bound.stage.index()[e]
        out[at] = final[at]
    return out


def load_model_of(path: str | Path, system: System) -> Model:
    """Read a model file of this system; its parameters and laws are checked when logs are put into it.

    Raises InputError or StageError in one line.
    """
    model = read(path, Model)
    if model.meta.get("system") != system.name:
        whose = model.meta.get("system", "the vane chain")
        raise StageError(f"{path}: is a model of {whose!r}; system {system.name!r} is asked for")
    if side := next(iter(model.sides), ""):
        raise StageError(f"{path}: {side} is of a vane chain with two actuators, not of system {system.name!r}")
    return model


# ---- What should make a reader doubt an answer on a model of his own: parameters at their bounds, signs the wrong way

# laws that may have either sign, and what the unusual one means
BACKWARDS = {
    laws.QUADRATIC_DRAG: "drives the motion instead of braking it",
    laws.SPRING: "pushes away from the middle instead of back to it",
    laws.CUBIC_SPRING: "pushes away from the middle instead of back to it",
    laws.LEAK: "feeds the state instead of draining it",
    laws.STATE_QUADRATIC: "feeds the state instead of draining it",
    laws.STATE_SQUARE_ROOT: "feeds the state instead of draining it",
    laws.STATE_CUBIC: "feeds the state instead of draining it",
}
ROUND = "is a sign the other way round?"


def parameter_warnings(bound: BoundSystem, judge: LeastSquaresProblem, d: StageDiagnosis) -> list[str]:
    """Parameters and laws at their bounds, and signs that physics or convention speak against, a line each."""
    out = []
    fit = d.final
    for k, p in enumerate(bound.stage.parameters):
        value = float(fit.theta[k])
        low, high = p.limits()
        near = 1e-6 * max(abs(value), p.scale, 1e-300)
        side = -1.0 if value <= low + near else 1.0 if value >= high - near else 0.0
        if side == 0.0 or p.tolerance == 0.0 or k in judge.spared or (value == 0.0 != d.base.theta[k]):
            continue
        limit, of = (low, p.low) if side < 0.0 else (high, p.high)
        if limit == of:
            more = f": the logs would have it go beyond; {ROUND}" if _pulled(fit, judge, k, side) else ""
            out.append(f"{p.name} stands at its bound, {limit:.4g} {p.unit}{more}")
        elif _pulled(fit, judge, k, side):
            out.append(
                f"{p.name} stands at the end of its tolerance, {value:.4g} {p.unit}: the logs would have it go on"
            )
    index = bound.stage.index()
    law_of = {q.effect: q.law for q in bound.placed}
    for name in fit.effects:
        if at_bound(bound.stage, fit, name):
            out.append(f"{name} stands at the end of its physical range: the log would have it go on")
        size = float(fit.theta[index[name]][0])
        if size < 0.0 and (meaning := BACKWARDS.get(law_of[name].code)):
            unit = bound.stage.effect(name).parameters[0].unit
            out.append(f"{name} is negative ({size:.4g} {unit}): it {meaning}; {ROUND}")
    return out + _against(bound)


def _pulled(fit: Fit, judge: LeastSquaresProblem, column: int, side: float) -> bool:
    """Whether the logs would have a parameter go on beyond the bound at which it stands."""
    where = np.flatnonzero(fit.free == column)
    if not len(where):
        return False
    k = int(where[0])
    g, a = float(fit.gradients[:, k].sum()), float(fit.normals[:, k, k].sum())
    return g * side > 0.0 and a > 0.0 and g * g / a > BOUND_PULL * float(fit.cost.sum())


def _against(bound: BoundSystem) -> list[str]:
    """A measured force that takes more power out of the motion than it puts in."""
    if bound.system.kind != "force":
        return []
    out = []
    for (log, at), u in zip(bound.logs.items(), bound.data.u, strict=True):
        force, v = bound.measured[0, at], u[1]
        use = np.isfinite(force)
        size = float(np.sqrt(np.mean(force[use] ** 2) * np.mean(v[use] ** 2))) if use.any() else 0.0
        if size > 0.0 and float(np.mean(force[use] * v[use])) < DRIVES * size:
            name = next(iter(bound.system.outputs))
            out.append(
                f"{log}: {name} acts against the motion, so that the machine gives power; friction is looked for where "
                f"a positive force drives positive motion: {ROUND}"
            )
    return out
