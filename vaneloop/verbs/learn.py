"""Learn a law that nobody listed: where it acts, of what it is a function, its curve, its formula, a file of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hil.logs.notes import Note, told
from plant import write_model
from plant.model import Learned as Table
from vaneloop.base.errors import InputError
from vaneloop.base.files import write
from vaneloop.base.signals import heading
from vaneloop.identification import StageError, System
from vaneloop.identification.least_squares.problem import LeastSquaresProblem
from vaneloop.identification.results import answer_of, found_of, recalibrated, rms_of
from vaneloop.identification.selection.rules import decisions_json
from vaneloop.identification.settings import HARM, LEAST_FALL, UNKNOWN
from vaneloop.identification.unmodelled.closed_form_fits import reach_of
from vaneloop.identification.unmodelled.curve_candidates import SHAPES, SurfaceCandidate, UserModelCandidates, on_logs
from vaneloop.identification.unmodelled.curve_choice import as_the_law, spoken
from vaneloop.identification.unmodelled.fitted_candidate import Outcome
from vaneloop.identification.unmodelled.learned_law import LearnedSurface, law_of, surface_law_of
from vaneloop.identification.unmodelled.learning import CurveSearch
from vaneloop.identification.unmodelled.problem import above_the_noise
from vaneloop.identification.unmodelled.python_law import python_law
from vaneloop.identification.user_models.by_log import ByLog, as_given, bind
from vaneloop.identification.vane_chain.candidates import VaneChainCandidates
from vaneloop.pages.decisions import Explained
from vaneloop.pages.learned import learned_page
from vaneloop.pages.story import floors
from vaneloop.pages.style import capital
from vaneloop.verbs.answer import COLOUR, Answer, Row, axes, labelled
from vaneloop.verbs.curves import Curves
from vaneloop.verbs.estimates import Fitted
from vaneloop.verbs.machine import Machine
from vaneloop.verbs.search import Diagnosed, chain_for, diagnose, not_given, with_fits
from vaneloop.verbs.search import diagnosed as of_chain

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from plant import Model
    from vaneloop.identification.least_squares.problem import Fit
    from vaneloop.identification.results import StageDiagnosis
    from vaneloop.identification.selection.rules import Decision
    from vaneloop.identification.unmodelled.fitted_candidate import FittedCandidate
    from vaneloop.identification.unmodelled.learned_law import LearnedLaw
    from vaneloop.identification.vane_chain.chain import Chain
    from vaneloop.pages.page import Page
    from vaneloop.verbs.parts import LogsLike, Parts

__all__ = ["Learned", "learn"]


@dataclass(frozen=True, repr=False, eq=False)
class Learned(Answer):
    """Laws learned, or why none was.

    diagnosed  what the library of named laws says of the same logs
    laws       in the order in which they were added; empty: none was learned
    by_log     errors before and after, log by log, where one was
    model      the model with them, to be written; None: none was learned
    steps      channel -> step (border unit) in which its reading comes, where its converter's low bits are lost
    fits       of each stage that a law was learned in: the model with its laws
    decisions  subsystem -> what the acceptance rules said of each candidate
    """

    diagnosed: Diagnosed
    outcome: Outcome
    laws: list[LearnedLaw]
    by_log: ByLog | None = None
    model: Model | None = None
    log: str = ""
    path: str = ""
    steps: Mapping[str, float] = field(default_factory=dict)
    fits: tuple[Fitted, ...] = ()
    decisions: Mapping[str, Sequence[Decision]] = field(default_factory=dict)

    @property
    def verdict(self) -> str:
        """Learned, named, none or unknown."""
        return self.outcome.verdict

    def sentence(self) -> str:
        """The answer in one sentence."""
        if not self.laws:
            said = {
                "none": "Nothing is missing",
                "named": "Laws of the library explain it",
                "unknown": "No law of one or two quantities was accepted",
            }[self.verdict]
            if self.verdict == "unknown" and self.steps:
                said = "A reading lacks bits"
            return f"{said}: {self.outcome.why}."
        text = "; ".join(law.sentence() for law in self.laws)
        before, after = self.laws[0].error_before, self.laws[-1].error_after
        return f"{capital(text)}. Held-out error in noise floors: {floors(before)} to {floors(after)}."

    def to_dict(self) -> dict[str, object]:
        """The answer as the JSON of ``vaneloop learn``."""
        out: dict[str, object] = {
            "schema": 1, "log": self.log, "verdict": self.verdict, "sentence": self.sentence(),
            "laws": [law_json(law) for law in self.laws], "nearest": self.outcome.nearest, "model": self.path,
            "named": self.diagnosed.effects, **told([*self._read, *self.notes]),
        }  # fmt: skip
        out["decisions"] = [one for name, of in self.decisions.items() for one in decisions_json(of, stage=name)]
        out |= {"steps": dict(self.steps)} if self.steps else {}
        return out | ({"logs": self.by_log.json()["logs"]} if self.by_log else {})

    def rows(self) -> list[Row]:
        """A row for each law: where it acts, of what it is a function, and what it does to the error."""
        return [
            {
                "effect": law.name, "how": law.how, "at": law.at, "of": law.of, "unit": law.unit,
                "error_before": law.error_before, "error_after": law.error_after,
                "formula": law.spoken.text if law.spoken else "",
            }
            for law in self.laws
        ]  # fmt: skip

    def _fits(self) -> Sequence[Fitted]:
        learned = {f.judge.stage.name for f in self.fits}
        return [*self.fits, *(f for f in self.diagnosed._fits() if f.judge.stage.name not in learned)]

    def _worked_out(self) -> Curves:
        return super()._worked_out() if self.by_log is not None or self.fits else self.diagnosed._curves

    def plot(self, ax: Axes | None = None, *, signal: str = "", residuals: bool = False) -> Axes:
        """Draw the first law over its quantity, with its 90 % band; with a signal, or where none was learned, as of
        any answer.
        """
        law = next((law for law in self.laws if not isinstance(law, LearnedSurface)), None)
        if law is None or signal or residuals:
            return super().plot(ax, signal=signal, residuals=residuals)
        ax = axes(ax)
        ax.fill_between(law.x, law.low, law.high, color=COLOUR["model"], alpha=0.25, label="90 % band")
        ax.plot(law.x, law.y, color=COLOUR["model"], label=law.name)
        return labelled(ax, heading(f"{law.how} at {law.at}", law.unit), heading(law.of, law.of_unit))

    @property
    def explained(self) -> dict[str, Explained]:
        """Subsystem -> decisions, and the names of what was chosen."""
        chosen = [law.name for law in self.laws]
        return {name: (of, chosen) for name, of in self.decisions.items()}

    @property
    def _read(self) -> list[str]:
        """What reading did to the log."""
        return [n for n in self.diagnosed.diagnosis.notes if isinstance(n, Note)]

    @property
    def notes(self) -> list[str]:
        """What the user should know of the laws."""
        out = list(self.outcome.notes)
        for law in self.laws:
            if law.untold:
                what = " and ".join(("mean", "slope")[k] for k in law.untold)
                trades = f"; it trades with {', '.join(law.trades)}" if law.trades else ""
                out.append(f"{law.name}: its {what} cannot be estimated from these logs{trades}")
            if law.rivals:
                out.append(f"{law.name}: as good: {', '.join(law.rivals)}")
            out.append(law.range_note())
        return out

    def page(self, command: str = "") -> Page:
        """The answer as a page."""
        said, of = self.sentence(), self.explained
        return learned_page(
            self.laws, self.outcome, said, [*self._read, *self.notes], self.by_log, command, self.log, of
        )

    def write(self, path: str | Path) -> Path:
        """Write the model with its laws, a file that ``extend --effect`` and ``--model`` take; return its path."""
        assert self.model is not None
        write_model(str(path), self.model)
        return Path(path)

    def write_python(self, path: str | Path, system: System | None = None) -> Path:
        """Write the first law as a Python file; return its path.

        system  the user's own model, to whose ``laws`` it can be added, or which calls it, of a difference; None: of
                the vane chain, the function alone, as always where it is one of two quantities
        """
        return write(path, python_law(self.laws[0], system))


def law_json(law: LearnedLaw) -> dict[str, Any]:
    """A law as JSON; its curve at 33 places, a surface at 9 each way."""
    k = range(0, len(law.x), 8)
    return {
        "effect": law.name, "how": law.how, "at": law.at, "of": law.of, "unit": law.unit, "of_unit": law.of_unit,
        "x": [float(law.x[i]) for i in k], "y": [float(law.y[i]) for i in k],
        "low": [float(law.low[i]) for i in k], "high": [float(law.high[i]) for i in k],
        "visited": [float(v) for v in law.visited], "error_before": law.error_before, "error_after": law.error_after,
        "formulas": [
            {"form": f.form, "text": f.text, "numbers": f.numbers, "error": f.error, "law": f.law} for f in law.formulas
        ],
        "untold": law.untold, "trades": law.trades, "rivals": law.rivals, **law.more(),
    }  # fmt: skip


def learn(
    log: LogsLike,
    model: Machine | System | None = None,
    *,
    fit: Parts = (),
    test: Parts | LogsLike = (),
    added: Model | None = None,
    without: Sequence[str] = (),
    shape: Sequence[str] = (),
    formulas: bool = True,
    workers: int = 2,
    progress: Callable[[float], None] | None = None,
) -> Learned:
    """Which law does a model lack that nobody listed?

    The library of named laws is searched first; a learned law must do clearly better than the best of them.

    Parameters
    ----------
    log, model, fit, test, added, without, workers, progress
        As of `diagnose`.
    shape : sequence of str, optional
        What is known of every curve: "zero" where its quantity is 0, "odd", "rising", "falling".
    formulas : bool, optional
        Whether a formula that does as well as its curve is the law.

    Returns
    -------
    Learned
        Its ``verdict`` is learned, named, none or unknown; ``laws`` are the curves, `rows` a table of them; ``write``
        writes the model with them.

    Raises
    ------
    InputError
        One line, for logs that the model cannot be held against.

    Examples
    --------
    An amplifier whose reading ripples, which no law of the library says:

    >>> import numpy as np, pandas as pd, vaneloop
    >>> system = vaneloop.System(
    ...     "amplifier", "static", lambda u, p: p.gain * u.u, inputs={"u": "V"}, outputs={"y": "V"},
    ...     parameters=[vaneloop.unknown("gain", 1.0, "-")], places=["output"],
    ... )
    >>> t = np.arange(0.0, 20.0, 0.02)
    >>> u = np.sin(0.4 * t) + 0.7 * np.sin(1.7 * t + 1.0)
    >>> y = 2.0 * u + 0.4 * np.cos(5.0 * u) + 0.01 * np.random.default_rng(1).standard_normal(len(t))
    >>> answer = vaneloop.learn(pd.DataFrame({"u": u, "y": y}, index=t), system)
    >>> answer.verdict, [(row["at"], row["of"], row["unit"]) for row in answer.rows()]
    ('learned', [('y', 'y', 'V')])
    """
    if isinstance(shape, str):
        raise InputError(f"shape (={shape!r}) must be a list of {', '.join(SHAPES)}")
    tell, shape = progress or (lambda _: None), checked_shape(shape)
    if not isinstance(model, System):
        machine = model or Machine()
        machine.plant.of_one_actuator("learning")
        chain, name = chain_for(log, machine, fit, test)
        return learned(not_given(chain, without), name, machine.added, workers, tell, None, shape, formulas)
    found = diagnose(log, model, fit=fit, test=test, added=added, without=without, progress=lambda f: tell(0.5 * f))
    return learned_system(found, added, lambda f: tell(0.5 + 0.5 * f), shape, formulas)


def learned_system(
    found: Diagnosed,
    added: Model | None = None,
    progress: Callable[[float], None] | None = None,
    shape: Sequence[str] = (),
    formulas: bool = True,
) -> Learned:
    """`learn` of logs of a system that have been diagnosed."""
    tell = progress or (lambda _: None)
    try:
        alone = _learned(found, added, lambda f: tell(0.5 * f), shape, formulas)
        beside = _beside_named(found, alone, lambda f: tell(0.5 + 0.5 * f), shape, formulas)
        tell(1.0)
        return beside or alone
    except StageError as e:
        raise InputError(str(e)) from None


def learned(
    chain: Chain,
    log: str,
    before: Model,
    workers: int = 2,
    progress: Callable[[float], None] | None = None,
    found: Diagnosed | None = None,
    shape: Sequence[str] = (),
    formulas: bool = True,
) -> Learned:
    """`learn` of a log that has been put into the stages of the vane chain.

    before    what the machine has by now
    found     the diagnosis of this log, where that has been made
    formulas  whether a formula that does as well as its curve is the law
    """
    tell = progress or (lambda _: None)
    shape = checked_shape(shape)
    begun = 0.0 if found else 0.4
    found = found or of_chain(chain, log, workers, lambda f: tell(0.4 * f))
    stages = found.diagnosis.stages
    open_ones = [s for s in stages if _open(chain, s)]
    laws: list[LearnedLaw] = []
    model, said, out, fits = before, [], None, list[Fitted]()
    decisions: dict[str, list[Decision]] = {}
    for i, d in enumerate(open_ones):
        stage = chain.stage(d.stage)
        if stage.coarse:  # what it would learn is how the steps look from there
            explains = any(o in stage.coarse for o in stage.outputs)
            driven = f"not asked, as it is driven by {', '.join(stage.coarse)}"
            said.append(f"{d.stage}: {'; '.join(stage.coarse.values()) if explains else driven}")
            continue
        test = next((s for s in chain.test.stages if s.name == d.stage), None) if chain.test else None
        ground = VaneChainCandidates(stage, d.floor, test, [s for s in chain.stages if s is not stage])
        said_by = lambda f, i=i: tell(begun + (1.0 - begun) * (i + f) / len(open_ones))  # noqa: E731
        learner = CurveSearch(ground, d, said_by, shape, formulas)
        one = learner.learned()
        decisions[d.stage] = one.decisions
        out = out or (one if d.verdict == "unknown" else None)
        said += [f"{d.stage}: {note}" for note in one.notes]
        if one.verdict != "learned" and d.verdict == "none":  # little is above the noise, and no law says it
            continue
        if out is not None and one.verdict != "learned":
            said.append(f"{d.stage}: {one.why}")
            out.nearest += [n for n in one.nearest if n not in out.nearest]
            continue
        last, before_it, own = one.tried[-1], (learner.judge, learner.base), []
        for tried in one.tried:
            own.append(law_of(ground, before_it, tried))
            before_it = tried.judge, tried.fit
        if formulas:
            last, own = spoken(learner, one.tried, own)
        new = [k for k, law in enumerate(own) if not any(law.of_the_kind_of(known) for known in laws)]
        said += [
            f"{d.stage}: {law.name}: another subsystem has the same law" for k, law in enumerate(own) if k not in new
        ]
        laws += [own[k] for k in new]
        if new:
            kept = replace(one, tried=[one.tried[k] for k in new])
            model = _with_stage(_as_model(model, kept, [own[k] for k in new], last), last.judge, last.fit)
            fits.append(Fitted(last.judge, last.fit, None, chain.start))
    unknown = any(s.verdict == "unknown" for s in open_ones)
    verdict = "learned" if laws else "unknown" if unknown else "named" if found.effects else "none"
    why = {
        "named": f"{', '.join(found.effects)} of the library",
        "none": "the model comes down to the noise of the log's sensors: nothing is missing",
    }.get(verdict, "; ".join(said))
    if laws:
        model = with_fits(model, [s for s in stages if s.verdict == "missing"])
    outcome = Outcome(verdict, nearest=out.nearest if out else [], why=why, notes=said if laws else [])
    tell(1.0)
    return Learned(
        found, outcome, laws, None, model if laws else None, log, steps=chain.steps, fits=tuple(fits),
        decisions=decisions,
    )  # fmt: skip


def _open(chain: Chain, d: StageDiagnosis) -> bool:
    """Whether a stage may lack a law that nobody listed: its error is more than noise, and no law has a name for it."""
    stage = chain.stage(d.stage)
    if stage.made is None or d.verdict == "missing":
        return False
    return d.verdict == "unknown" or above_the_noise(LeastSquaresProblem(stage, d.floor), d.base)


def _with_stage(model: Model, judge: LeastSquaresProblem, fit: Fit) -> Model:
    """The model with a stage's own parameters as they were fitted."""
    moved = {str(r["parameter"]): float(str(r["value"])) for r in recalibrated(judge.stage, fit)}
    return model.model_copy(update={"parameters": {**model.parameters, **moved}})


def checked_shape(shape: Sequence[str]) -> tuple[str, ...]:
    """What is known of curves; InputError where that is no shape, or no curve has it all."""
    for name in shape:
        if name not in SHAPES:
            raise InputError(f"shape (={name!r}): allowed: {', '.join(SHAPES)}")
    one_of = [n for n in ("odd", "rising", "falling") if n in shape]
    if len(one_of) > 1:
        raise InputError(f"shape (={', '.join(shape)}): of {' and '.join(one_of)} one is allowed")
    return tuple(dict.fromkeys(shape))


def _learned(
    diagnosed: Diagnosed, added: Model | None, progress: Callable[[float], None], shape: Sequence[str], formulas: bool
) -> Learned:
    assert diagnosed.by_log is not None
    logs = diagnosed.by_log.logs
    ground = UserModelCandidates(logs)
    learner = CurveSearch(ground, diagnosed.diagnosis.stages[0], progress, shape, formulas)
    outcome = learner.learned()
    decisions = {diagnosed.diagnosis.stages[0].stage: outcome.decisions}
    if outcome.verdict != "learned":
        return Learned(diagnosed, outcome, [], log=diagnosed.log, decisions=decisions)
    laws, before = [], (learner.judge, learner.base)
    for tried in outcome.tried:
        surface = isinstance(tried.candidate, SurfaceCandidate)
        laws.append(surface_law_of(before, tried) if surface else law_of(ground, before, tried))
        before = tried.judge, tried.fit
    last = outcome.tried[-1]
    if isinstance(law := laws[-1], LearnedSurface):
        if formulas and (said := as_the_law(learner, last, law.formulas)):
            last, formula = said
            laws = [law.spoken_by(formula, reach_of(ground, last, formula), rms_of(last.judge, last.fit))]
    elif formulas:
        last, laws = spoken(learner, outcome.tried, laws)
        outcome.tried = outcome.tried[: len(laws)]
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
    model = _as_model(by_log.model, outcome, laws, last)
    progress(1.0)
    return Learned(
        diagnosed, outcome, laws, by_log, model, diagnosed.log, fits=(Fitted(judge, last.fit, base),),
        decisions=decisions,
    )  # fmt: skip


def _beside_named(
    diagnosed: Diagnosed, alone: Learned, progress: Callable[[float], None], shape: Sequence[str], formulas: bool
) -> Learned | None:
    """Curves beside the laws of the library that `diagnose` names, where these leave more than noise, and curves alone
    do too; None where that is not better: a valve's flow is a curve, and its dead time is none.
    """
    assert diagnosed.by_log is not None
    by, d = diagnosed.by_log, diagnosed.diagnosis.stages[0]
    left = alone.laws[-1].error_after if alone.laws else d.excess
    if not d.effects or min(d.excess, left) <= UNKNOWN:
        return None
    test = by.logs.test.data.records if by.logs.test is not None else ()
    try:
        logs = bind(by.logs.fitted.system, by.logs.fitted.data.records, test, by.model)
    except StageError:  # with these laws the model does not run through its logs: what was learned alone stands
        return None
    judge = LeastSquaresProblem(logs.fitted.thinned, logs.fitted.floor)
    given = as_given(logs, judge.fit((), judge.stage.neutral(), 12))
    given.verdict = "unknown"  # what is left is more than noise
    again = replace(diagnosed, bound=logs.fitted, diagnosis=replace(diagnosed.diagnosis, stages=[given]),
                    by_log=ByLog(logs, given))  # fmt: skip
    said = _learned(again, by.model, progress, shape, formulas)
    if not said.laws or said.by_log is None:
        return None
    # with other laws the noise of what drives a model comes to another error: all is held against that of the first
    floor, error = by.logs.fitted.floor, said.by_log.d.error_after
    ratio = float(np.linalg.norm(error / floor) / np.linalg.norm(error / logs.fitted.floor))
    held = ratio * said.laws[-1].error_after
    if max(held**2 - 1.0, 0.0) > (1.0 - LEAST_FALL) * (left**2 - 1.0):
        return None
    before = (alone.by_log if alone.by_log is not None and alone.laws else by).tested()
    if any(np.log(v / before[log]) > HARM for log, v in said.by_log.tested(floor).items()):
        return None
    named = " + ".join(d.final.effects)
    steps = list(said.by_log.steps.items())[1:]
    said.by_log.steps = {**by.steps, **{f"{named} + {name}": step for name, step in steps}}
    said.outcome.notes.append(f"learned beside {named.replace(' + ', ' and ')} of the library: the law file has both")
    return replace(said, diagnosed=diagnosed)


def _without(judge: LeastSquaresProblem, fit: Fit, names: tuple[str, ...], leave: str) -> Fit | None:
    """The fit with all curves but one; None where there is no other."""
    others = tuple(n for n in names if n != leave)
    if not others:
        return None
    theta, at = fit.theta.copy(), judge.stage.index()[leave]
    theta[at] = judge.stage.neutral()[at]
    return judge.fit(others, theta)


def _as_model(model: Model, outcome: Outcome, laws: list[LearnedLaw], last: FittedCandidate) -> Model:
    """The model with the laws as a file has them: a formula's numbers, or coefficients of B-splines.

    last  the model with all of them, as it was fitted
    """
    effects, curves = dict(model.effects), dict(model.curves)
    for law, tried in zip(laws, outcome.tried, strict=True):
        c = tried.candidate
        if f := law.spoken:
            (low, high), reach = (float(law.x[0]), float(law.x[-1])), list(law.reach)
            if isinstance(law, LearnedSurface):  # what goes on is its range
                (low, high), reach = law.reach, []
            curves[law.name] = Table(
                how=law.how, at=law.at, of=law.of, low=low, high=high, form=f.form, values=list(f.numbers.values()),
                unit=law.unit, size=float(c.size), reach=reach, second=law.axis(),
            )  # fmt: skip
            effects[law.name] = dict(f.numbers)
            continue
        values = [float(v) for v in c.coefficients(last.fit.theta[last.judge.stage.index()[c.name]])]
        curves[law.name] = now = Table(
            how=law.how, at=law.at, of=law.of, low=float(law.x[0]), high=float(law.x[-1]), values=values,
            knots=[float(v) for v in law.knots], jump=c.jump, unit=law.unit, size=float(c.size), second=law.axis(),
        )  # fmt: skip
        effects[law.name] = dict(zip(now.numbers, values, strict=True))
    return model.model_copy(update={"effects": effects, "curves": curves})


def with_path(answer: Learned, path: str, words: str) -> Learned:
    """The answer with its model written to ``path``, and the command in the model's history."""
    assert answer.model is not None
    out = replace(answer, model=answer.model.noted(words), path=path)
    out.write(path)
    return out
