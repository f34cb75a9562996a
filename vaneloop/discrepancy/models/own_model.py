"""The four verbs on a user's own model (`System`) and logs: what ``vaneloop ... --system`` does, as a Python API.

from vaneloop.discrepancy import load_system
from vaneloop.discrepancy.models import own_model
answer = own_model.diagnose(load_system("my_model.py"), [record], test=[other])
answer.json()["effects"]
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from vaneloop.discrepancy.diagnose import diagnose_stage, extend_stage
from vaneloop.discrepancy.error_share import ErrorShare
from vaneloop.discrepancy.fit import Judge
from vaneloop.discrepancy.laws import HYSTERETIC
from vaneloop.discrepancy.locate import Located, Shape, agrees, shape
from vaneloop.discrepancy.locate import locate as where
from vaneloop.discrepancy.models.bound import Bound
from vaneloop.discrepancy.models.runner import STARTS_LOADED
from vaneloop.discrepancy.models.system import Record, System
from vaneloop.discrepancy.stage import Array, StageError
from vaneloop.discrepancy.stage_answer import StageDiagnosis, answer_of, rms_of

__all__ = ["Answer", "Model", "compare", "diagnose", "extend", "load_model", "locate", "write_model"]

NO_HELP = 0.85  # error with a law over error without it, from which it hardly helps


@dataclass
class Model:
    """What `extend` found: parameters and laws that a system has from now on."""

    system: str = ""
    parameters: dict[str, float] = field(default_factory=dict)
    effects: dict[str, dict[str, float]] = field(default_factory=dict)
    history: list[str] = field(default_factory=list)


@dataclass
class Answer:
    """What one verb found.

    located   the model as given, with nothing added: how large its error is, and under which conditions
    logs      every log, fitted or test, with the error of each output after each step: step -> log -> RMS per output
    ablation  law -> log -> error with it over error without it (each refitted on the fitted logs), over all outputs
    """

    verb: str
    bound: Bound
    test: Bound | None
    diagnosis: StageDiagnosis
    located: Located
    shapes: list[Shape] = field(default_factory=list)
    logs: dict[str, dict[str, Array]] = field(default_factory=dict)
    ablation: dict[str, dict[str, float]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    elapsed_s: float = 0.0
    model: Model = field(default_factory=Model)

    def sentence(self) -> str:
        """The answer in one sentence."""
        d = self.diagnosis
        k = int(np.argmax(d.error_before / d.floor))
        size = float(np.sqrt(np.nanmean(self.bound.measured[k] ** 2)))
        share = 100 * d.error_after[k] / size
        left = (
            f"{d.outputs[k]} is left with an error of {d.error_after[k]:.4g} {d.units[k]} ({share:.2g} % of its RMS), "
        )
        left += f"{d.excess:.3g} times the noise of its samples"
        if d.verdict == "missing":
            names = [f.effect + (f" (or {', '.join(f.rivals)})" if f.rivals else "") for f in d.effects]
            return f"System {d.stage} lacks {' and '.join(names)}; {left}." + self._shape()
        if d.verdict == "unknown":
            return f"System {d.stage} lacks something that the library does not have; {left}." + self._shape()
        return f"Nothing is missing that the library could add to system {d.stage}; {left}."

    def _shape(self) -> str:
        return f" What is left: {self.shapes[0].text}." if self.shapes else ""

    def json(self) -> dict[str, Any]:
        """The answer as the commands' JSON (docs/diagnosis.md), with `parameters`, `logs` and `ablation` beside."""
        d = self.diagnosis
        stages = [
            {
                "stage": d.stage, "verdict": d.verdict, "signal": d.outputs[k], "unit": d.units[k],
                "error_before": float(d.error_before[k]), "error_after": float(d.error_after[k]),
                "noise_floor": float(d.floor[k]),
            }
            for k in range(len(d.outputs))
        ]  # fmt: skip
        effects = [
            {
                "effect": f.effect,
                "stage": d.stage,
                "probability": f.probability,
                "parameters": f.parameters,
                "rivals": f.rivals,
            }
            for f in d.effects
        ]
        fitted = list(self.bound.logs)
        out: dict[str, Any] = {
            "schema": 1,
            "log": fitted[0],
            "verdict": d.verdict,
            "stages": stages,
            "effects": effects,
            "recalibrated": self._recalibrated(),
            "unknown": [],
            "not_observable": [],
            "parameters": self.parameters(),
            "waterfall": {d.stage: [{"step": n, "noise_floors": v} for n, v in d.steps]},
            "logs": [
                {
                    "log": log, "fitted": log in fitted, "signal": d.outputs[k], "unit": d.units[k], "step": step,
                    "rms": float(rms[k]),
                    "relative": float(rms[k] / self._size(log, k)),
                }
                for step, by in self.logs.items() for log, rms in by.items() for k in range(len(d.outputs))
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
            "elapsed_s": self.elapsed_s,
        }  # fmt: skip
        if self.shapes:
            out["unknown"] = [
                {"stage": d.stage, "shape": "; ".join(s.text for s in self.shapes), "nearest_effects": []}
            ]
        return out

    def together(self) -> dict[str, dict[str, Array]]:
        """RMS error of each output over all samples of the fitted logs, and of the test logs: step -> "fitted" | "test"
        -> RMS.
        """
        out: dict[str, dict[str, Array]] = {}
        for step, by in self.logs.items():
            out[step] = {}
            for what, bound in (("fitted", self.bound), ("test", self.test)):
                if bound is not None:
                    n = np.array([np.isfinite(bound.measured[:, at]).sum(axis=1) for at in bound.logs.values()])
                    squares = np.array([np.where(np.isfinite(by[log]), by[log], 0.0) ** 2 for log in bound.logs])
                    out[step][what] = np.sqrt((n * squares).sum(axis=0) / np.maximum(n.sum(axis=0), 1))
        return out

    def _size(self, log: str, k: int) -> float:
        b = self.bound if log in self.bound.logs else self.test
        assert b is not None
        return float(np.sqrt(np.nanmean(b.measured[k, b.logs[log]] ** 2))) or 1.0

    def _recalibrated(self) -> list[dict[str, object]]:
        free = {p.name for p in self.bound.system.parameters if np.isinf(p.tolerance)}
        return [
            r
            for r in self.diagnosis.recalibrated
            if r["parameter"] not in free and not str(r["parameter"]).startswith("start_")
        ]

    def parameters(self) -> list[dict[str, object]]:
        """The model's own parameters as fitted, with 90 % intervals."""
        fit = self.diagnosis.final
        out: list[dict[str, object]] = []
        for i, p in enumerate(self.bound.stage.parameters):
            where = np.flatnonzero(fit.free == i)
            value = float(fit.theta[i])
            low, high = (float(fit.low[where[0]]), float(fit.high[where[0]])) if len(where) else (value, value)
            out.append({"parameter": p.name, "value": value, "low": low, "high": high, "unit": p.unit})
        return out


def _bind(
    system: System, logs: Sequence[Record], test: Sequence[Record], model: Model | None
) -> tuple[Bound, Bound | None]:
    m = model or Model()
    bound = system.bind(list(logs), values=m.parameters, present=m.effects)
    return bound, system.bind(list(test), like=bound) if test else None


def _steps(bound: Bound, test: Bound | None, named: Mapping[str, Array]) -> dict[str, dict[str, Array]]:
    out = {}
    for step, theta in named.items():
        by = bound.figures(theta)
        if test is not None:
            by |= test.figures(test.theta_from(bound, theta))
        out[step] = by
    return out


def _as_is(bound: Bound) -> StageDiagnosis:
    """The model with its parameters as they are, nothing added."""
    judge = Judge(bound.thinned, bound.data.noise())
    theta = bound.stage.neutral()
    fit = judge.fit((), theta, 0)
    return answer_of(judge, "none", fit, fit, [], [("model", rms_of(judge, fit))])


def compare(system: System, logs: Sequence[Record], test: Sequence[Record] = (), model: Model | None = None) -> Answer:
    """Error of the model on each log, fitted in nothing but its unknown parameters."""
    started = time.perf_counter()
    bound, other = _bind(system, logs, test, model)
    d = _as_is(bound)
    return Answer(
        "compare",
        bound,
        other,
        d,
        where(Judge(bound.thinned, d.floor), d.base),
        logs=_steps(bound, other, {"model": d.base.theta}),
        notes=bound.notes,
        elapsed_s=time.perf_counter() - started,
        model=model or Model(),
    )


def locate(system: System, logs: Sequence[Record], test: Sequence[Record] = (), model: Model | None = None) -> Answer:
    """Where the model fails: under which logged conditions its error is largest, since when."""
    answer = compare(system, logs, test, model)
    answer.verb = "locate"
    return answer


def diagnose(
    system: System,
    logs: Sequence[Record],
    test: Sequence[Record] = (),
    model: Model | None = None,
    progress: Callable[[float], None] | None = None,
) -> Answer:
    """Which laws, at which places, is the model missing? ``test``: logs that nothing is fitted to."""
    started = time.perf_counter()
    bound, other = _bind(system, logs, test, model)
    done = 0

    def tick() -> None:
        nonlocal done
        done += 1
        if progress:
            progress(1.0 - 1.0 / (1.0 + done / 60.0))  # nobody knows how many laws there will be

    names = frozenset(other.logs) if other is not None else frozenset[str]()

    def figures(theta: Array) -> dict[str, float]:
        """Log of the error on each log, over its outputs."""
        by = bound.figures(theta)
        if other is not None:
            by |= other.figures(other.theta_from(bound, theta))
        floor = bound.data.noise()
        return {log: float(np.log(np.maximum(v / floor, 1.0)).mean()) for log, v in by.items() if np.isfinite(v).all()}

    d = diagnose_stage(
        bound.thinned, bound.data.noise(), tick=tick, judged=lambda judge: ErrorShare(judge, figures, names)
    )
    answer = _finish("diagnose", bound, other, d, started, model or Model())
    answer.notes += d.notes
    return answer


def extend(
    system: System,
    logs: Sequence[Record],
    effects: Sequence[str],
    test: Sequence[Record] = (),
    model: Model | None = None,
) -> Answer:
    """Fit exactly these laws; ``answer.model`` is the model with them."""
    started = time.perf_counter()
    bound, other = _bind(system, logs, test, model)
    have = [e.name for e in bound.stage.effects]
    for e in effects:
        if e not in have:
            import difflib

            close = difflib.get_close_matches(e, have, 3, 0.4)
            hint = (
                "it is part of the model already"
                if e in bound.present
                else f"close: {', '.join(close)}"
                if close
                else f"it can have {', '.join(have)}"
            )
            raise StageError(f"--effect {e!r}: not a law that system {system.name!r} can be given; {hint}")
    d = extend_stage(bound.thinned, tuple(dict.fromkeys(effects)), judged=ErrorShare)
    return _finish("extend", bound, other, d, started, model or Model())


def _finish(verb: str, bound: Bound, other: Bound | None, d: StageDiagnosis, started: float, before: Model) -> Answer:
    """What `diagnose` and `extend` answer; ``before``: the model that they started from."""
    judge = Judge(bound.thinned, d.floor)
    named = {"model": d.base.theta}
    # the waterfall log by log: laws in the order in which they came in, each step fitted
    theta = d.base.theta
    for k in range(1, len(d.final.effects)):
        part = judge.fit(d.final.effects[:k], _seeded(bound, theta, d.final.theta, d.final.effects[:k]), 12)
        named[" + ".join(part.effects)] = theta = part.theta
    if d.final.effects:
        named[" + ".join(d.final.effects)] = d.final.theta
    answer = Answer(
        verb, bound, other, d, where(judge, d.base), logs=_steps(bound, other, named), notes=list(bound.notes)
    )
    last = list(answer.logs.values())[-1]
    if len(d.final.effects) > 1:
        for name in d.final.effects:
            rest = tuple(e for e in d.final.effects if e != name)
            without = judge.fit(rest, _seeded(bound, d.base.theta, d.final.theta, rest), 12)
            by = _steps(bound, other, {"x": without.theta})["x"]
            answer.ablation[name] = {log: float(np.exp(np.nanmean(np.log(last[log] / by[log])))) for log in by}
    elif d.final.effects:
        first = answer.logs["model"]
        answer.ablation[d.final.effects[0]] = {
            log: float(np.exp(np.nanmean(np.log(last[log] / first[log])))) for log in first
        }
    for name, ratios in answer.ablation.items():
        for log, r in ratios.items():
            if r > NO_HELP:
                how = "hardly helps" if r < 0.98 else "does not help"
                answer.notes.append(f"{name} {how} on {log}: error with it over error without it is {r:.2f}")
    for p, v0 in zip(bound.stage.parameters, d.base.theta, strict=False):
        i = bound.stage.parameters.index(p)
        if d.final.theta[i] == 0.0 and v0 != 0.0 and p.low == 0.0 and p.tolerance > 0:
            answer.notes.append(
                f"{p.name}: not needed any more, set to 0 (it was {v0:.4g} {p.unit} while {', '.join(d.final.effects)} "
                "was missing)"
            )
    answer.notes += _loaded(bound, judge, d)
    if d.verdict != "none" and not agrees(d.excess, 1.0):
        answer.shapes = shape(judge, d.final)
    answer.elapsed_s = time.perf_counter() - started
    effects = {k: dict(v) for k, v in before.effects.items()}
    answer.model = Model(bound.system.name, dict(before.parameters), effects, list(before.history))
    for p, v in zip(bound.stage.parameters, d.final.theta, strict=False):
        law, _, parameter = p.name.rpartition(".")
        if law:
            answer.model.effects[law][parameter] = float(v)
        else:
            answer.model.parameters[p.name] = float(v)
    for f in d.effects:
        answer.model.effects[f.effect] = {k: float(str(v["value"])) for k, v in f.parameters.items()}
    return answer


def _loaded(bound: Bound, judge: Judge, d: StageDiagnosis) -> list[str]:
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


def _seeded(bound: Bound, base: Array, final: Array, effects: tuple[str, ...]) -> Array:
    """Start of a fit with some laws of the final model: theirs from there, all others absent."""
    out = bound.stage.neutral()
    n = len(bound.stage.parameters)
    out[:n] = final[:n] if effects else base[:n]
    for e in effects:
        at = bound.stage.index()[e]
        out[at] = final[at]
    return out


def write_model(path: str | Path, model: Model) -> None:
    """Write a model file (TOML) that ``--model`` takes back."""

    def text(v: str) -> str:
        return '"' + v.replace("\\", "\\\\").replace('"', '\\"') + '"'

    lines = [
        "# Written by vaneloop extend: parameters and laws of a user's own model.",
        f"system = {text(model.system)}",
    ]
    lines += ["history = [" + ", ".join(text(h) for h in model.history) + "]", "", "[parameters]"]
    lines += [f"{k} = {v!r}" for k, v in model.parameters.items()]
    for name, values in model.effects.items():
        lines += ["", f"[effects.{text(name)}]", *(f"{k} = {v!r}" for k, v in values.items())]
    try:
        Path(path).write_text("\n".join(lines) + "\n", encoding="utf-8")
    except OSError as e:
        raise StageError(f"{path}: cannot be written ({e.strerror})") from None


def load_model(path: str | Path, system: System) -> Model:
    """Read a model file of this system. Raises StageError, one line."""
    import tomllib

    try:
        data = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as e:
        raise StageError(f"{path}: cannot be read ({e.strerror})") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as e:
        raise StageError(f"{path}: is not a model file ({e})") from None
    if data.get("system") != system.name:
        raise StageError(
            f"{path}: is a model of {data.get('system', 'the vane chain')!r}; system {system.name!r} is asked for"
        )
    parameters, effects = data.get("parameters", {}), data.get("effects", {})
    flat = {**parameters, **{f"{e}.{k}": v for e, by in effects.items() if isinstance(by, dict) for k, v in by.items()}}
    for k, v in flat.items():
        if not isinstance(v, int | float) or isinstance(v, bool) or not np.isfinite(v):
            raise StageError(f"{path}: {k} (={v!r}) must be a finite number")
    return Model(
        system.name,
        dict(parameters),
        {k: dict(v) for k, v in effects.items()},
        [str(h) for h in data.get("history", [])],
    )
