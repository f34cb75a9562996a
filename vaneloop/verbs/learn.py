"""Learn a law that nobody listed: where it acts, of what it is a function, its curve, its formula, a file of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vaneloop.base.errors import InputError
from vaneloop.discrepancy import StageError, System
from vaneloop.verbs.answer import Answer
from vaneloop.verbs.search import Diagnosed, diagnose

if TYPE_CHECKING:
    from plant import Model
    from vaneloop.discrepancy.fit import Fit, Judge
    from vaneloop.discrepancy.models.by_log import ByLog
    from vaneloop.discrepancy.models.learned import LearnedLaw
    from vaneloop.discrepancy.models.learning import Outcome
    from vaneloop.pages.page import Page

__all__ = ["Learned", "learn"]


@dataclass(frozen=True)
class Learned(Answer):
    """Laws learned, or why none was.

    diagnosed  what the library of named laws says of the same logs
    laws       in the order in which they were added; empty: none was learned
    by_log     errors before and after, log by log, where one was
    model      the model with them, to be written; None: none was learned
    """

    diagnosed: Diagnosed
    outcome: Outcome
    laws: list[LearnedLaw]
    by_log: ByLog | None = None
    model: Model | None = None
    log: str = ""
    path: str = ""

    @property
    def verdict(self) -> str:
        """Learned, named, none or unknown."""
        return self.outcome.verdict

    def sentence(self) -> str:
        """The answer in one sentence."""
        if not self.laws:
            said = {
                "none": "Nothing is missing",
                "named": "Laws with names say it",
                "unknown": "No honest law of one quantity is there",
            }[self.verdict]
            return f"{said}: {self.outcome.why}."
        text = "; ".join(law.sentence() for law in self.laws)
        before, after = self.laws[0].error_before, self.laws[-1].error_after
        return f"{text[0].upper()}{text[1:]}. Held-out error in noise floors: {before:.3g} to {after:.3g}."

    def to_dict(self) -> dict[str, Any]:
        """The answer as the JSON of ``vaneloop learn``."""
        out: dict[str, Any] = {
            "schema": 1, "log": self.log, "verdict": self.verdict, "sentence": self.sentence(),
            "laws": [law_json(law) for law in self.laws], "nearest": self.outcome.nearest, "model": self.path,
            "named": self.diagnosed.effects, "notes": self.notes,
        }  # fmt: skip
        return out | ({"logs": self.by_log.json()["logs"]} if self.by_log else {})

    @property
    def notes(self) -> list[str]:
        """What the user should know."""
        out = list(self.outcome.notes)
        for law in self.laws:
            if law.trades:
                out.append(f"{law.name} trades with {', '.join(law.trades)}: without its mean and slope they move")
            if law.rivals:
                out.append(f"{law.name}: as good: {', '.join(law.rivals)}")
            reach = f"[{law.x[0]:.4g}, {law.x[-1]:.4g}] {law.of_unit}"
            out.append(f"{law.name}: {law.of} has been in {reach}; beyond, the curve stays as at its end")
        return out

    def page(self, command: str = "") -> Page:
        """The answer as a page."""
        from vaneloop.pages.learned import learned_page

        return learned_page(self.laws, self.outcome, self.sentence(), self.notes, self.by_log, command, self.log)

    def write(self, path: str | Path) -> Path:
        """Write the model with its laws, a file that ``extend --effect`` and ``--model`` take; return its path."""
        from plant import write_model

        assert self.model is not None
        write_model(str(path), self.model)
        return Path(path)


def law_json(law: LearnedLaw) -> dict[str, Any]:
    """A law as JSON; its curve at 33 places."""
    k = range(0, len(law.x), 8)
    return {
        "effect": law.name, "how": law.how, "at": law.at, "of": law.of, "unit": law.unit, "of_unit": law.of_unit,
        "x": [float(law.x[i]) for i in k], "y": [float(law.y[i]) for i in k],
        "low": [float(law.low[i]) for i in k], "high": [float(law.high[i]) for i in k],
        "visited": [float(v) for v in law.visited], "error_before": law.error_before, "error_after": law.error_after,
        "formulas": [
            {"form": f.form, "text": f.text, "numbers": f.numbers, "error": f.error, "law": f.law} for f in law.formulas
        ],
        "trades": law.trades, "rivals": law.rivals,
    }  # fmt: skip


def learn(
    log: Any,
    model: System,
    *,
    fit: Any = (),
    test: Any = (),
    added: Model | None = None,
    progress: Callable[[float], None] | None = None,
) -> Learned:
    """Which law does a model lack that nobody listed? Arguments as of `vaneloop.diagnose`, of a `System`.

    The library of named laws is searched first; a learned law must do clearly better than the best of them. Raises
    InputError for logs that the system cannot be held against.
    """
    if not isinstance(model, System):
        raise InputError("learn needs a model of your own (--system MY.py); of the vane chain it learns nothing yet")
    tell = progress or (lambda _: None)
    diagnosed = diagnose(log, model, fit=fit, test=test, added=added, progress=lambda f: tell(0.5 * f))
    try:
        return _learned(diagnosed, added, lambda f: tell(0.5 + 0.5 * f))
    except StageError as e:
        raise InputError(str(e)) from None


def _learned(diagnosed: Diagnosed, added: Model | None, progress: Callable[[float], None]) -> Learned:
    from vaneloop.discrepancy.models.by_log import ByLog
    from vaneloop.discrepancy.models.learned import law_of
    from vaneloop.discrepancy.models.learning import Learner, on_logs
    from vaneloop.discrepancy.stage_answer import answer_of, found_of, rms_of

    assert diagnosed.by_log is not None
    logs = diagnosed.by_log.logs
    learner = Learner(logs, diagnosed.diagnosis.stages[0], progress)
    outcome = learner.learned()
    if outcome.verdict != "learned":
        return Learned(diagnosed, outcome, [], log=diagnosed.log)
    laws, before = [], (learner.judge, learner.base)
    for tried, rivals in zip(outcome.tried, outcome.rivals, strict=True):
        laws.append(law_of(logs, before, tried, rivals))
        before = tried.judge, tried.fit
    last = outcome.tried[-1]
    names = tuple(e.name for _, e in last.curves)
    judge, stage = last.judge, last.judge.stage
    theta = stage.neutral()
    theta[: len(stage.parameters)] = learner.base.theta
    base = judge.fit((), theta, 1)
    steps = [("nominal", rms_of(judge, base)), (" + ".join(names), rms_of(judge, last.fit))]
    without = {n: _without(judge, last.fit, names, n) or base for n in names}
    d = answer_of(judge, "missing", base, last.fit, found_of(judge, last.fit, names, without), steps)
    d.criterion = "error_share"
    by_log = ByLog.of(on_logs(logs, last.curves), d, added)
    model = _as_model(by_log.model, outcome, laws)
    progress(1.0)
    return Learned(diagnosed, outcome, laws, by_log, model, diagnosed.log)


def _without(judge: Judge, fit: Fit, names: tuple[str, ...], leave: str) -> Fit | None:
    """The fit with all curves but one; None where there is no other."""
    others = tuple(n for n in names if n != leave)
    if not others:
        return None
    theta, at = fit.theta.copy(), judge.stage.index()[leave]
    theta[at] = judge.stage.neutral()[at]
    return judge.fit(others, theta)


def _as_model(model: Model, outcome: Outcome, laws: list[LearnedLaw]) -> Model:
    """The model with the curves as a file has them: coefficients of B-splines."""
    from plant.model import Learned as Table

    effects, curves, last = dict(model.effects), dict(model.curves), outcome.tried[-1]
    for law, tried in zip(laws, outcome.tried, strict=True):
        c = tried.candidate
        values = [float(v) for v in c.turn @ last.fit.theta[last.judge.stage.index()[c.name]]]
        curves[law.name] = Table(
            how=law.how, at=law.at, of=law.of, low=float(law.x[0]), high=float(law.x[-1]), values=values,
            knots=[float(v) for v in law.knots], unit=law.unit, size=float(c.size),
        )  # fmt: skip
        effects[law.name] = {f"c{k + 1}": v for k, v in enumerate(values)}
    return model.model_copy(update={"effects": effects, "curves": curves})


def with_path(answer: Learned, path: str, words: str) -> Learned:
    """The answer with its model written to ``path``, and the command in the model's history."""
    assert answer.model is not None
    out = replace(answer, model=answer.model.noted(words), path=path)
    out.write(path)
    return out
