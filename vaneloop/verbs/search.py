"""Compare, locate, diagnose, extend, experiment: where a model fails, what it lacks, and what to measure next.

A model is the vane machine (`Machine`), held against one log, or a user's own (`System`), held against several records.
"""

from __future__ import annotations

import difflib
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict, cast

import numpy as np

from hil.logs.notes import counted, told
from plant import write_model
from plant.curve import PLACES
from plant.effects import EFFECTS
from plant.model import SIDE_NAMES, Side, of_a_side, side_of
from vaneloop.base.errors import InputError
from vaneloop.base.signals import heading
from vaneloop.identification import Record, StageError, System
from vaneloop.identification.least_squares.problem import LeastSquaresProblem
from vaneloop.identification.onset import Onset
from vaneloop.identification.regimes import Located
from vaneloop.identification.selection.relative_error_acceptance import RelativeErrorAcceptance
from vaneloop.identification.user_models.by_log import ByLog, as_given, bind
from vaneloop.identification.user_models.experiment import Limits
from vaneloop.identification.user_models.experiment import recommend as best_run
from vaneloop.identification.vane_chain.candidates import SCALE, curve_effect, with_laws, without_laws
from vaneloop.identification.vane_chain.experiment import recommend
from vaneloop.identification.workflow import (
    Diagnosis,
    News,
    as_compared,
    diagnosis_json,
    extend_stage,
    locate_stages,
    no_better,
)
from vaneloop.identification.workflow import diagnose as search
from vaneloop.pages.diagnosis import (
    compare_page,
    diagnosis_page,
    experiment_page,
    extended_page,
    located_sentence,
    verdict_sentence,
)
from vaneloop.pages.story import CANNOT, EXPLAINED, MISSING, extended_sentence, reached, since
from vaneloop.verbs.answer import COLOUR, Answer, Row, axes, labelled
from vaneloop.verbs.curves import Curves
from vaneloop.verbs.estimates import Fitted
from vaneloop.verbs.long import Held, changed, held_results, searched
from vaneloop.verbs.long import located as located_of
from vaneloop.verbs.machine import Machine, with_law_files
from vaneloop.verbs.parts import Tested, bind_parts, read_record, records_of, split, tested
from vaneloop.verbs.replay import brief, log_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from plant import Model
    from vaneloop.identification.least_squares.problem import Fit
    from vaneloop.identification.results import StageDiagnosis
    from vaneloop.identification.subsystem import Array, Bound
    from vaneloop.identification.user_models.by_log import Logs
    from vaneloop.identification.vane_chain.chain import Chain
    from vaneloop.pages.page import Page
    from vaneloop.verbs.parts import LogsLike, Parts
    from vaneloop.verbs.replay import LogLike

__all__ = [
    "Diagnosed", "Experiment", "Extended", "Recommended", "Stages", "chain_for", "compare", "diagnose", "experiment",
    "extend", "locate", "logs_for", "read_record",
]  # fmt: skip

Progress = Callable[[float], None]


@dataclass(frozen=True, repr=False, eq=False)
class Stages(Answer):
    """Every stage on its own logged inputs, nothing added: how large its error is, where it fails, since when.

    bound   the model held against the log
    by_log  of a `System`, what that means log by log
    verb    what was asked: compare, locate
    held    of a very long log: what all of it says of a fit to an excerpt
    """

    bound: Bound
    located: list[Located]
    log: str = ""
    by_log: ByLog | None = None
    verb: str = "compare"
    held: Held | None = None

    @cached_property
    def tested(self) -> list[Tested]:
        """Errors on the part of the log that nothing was fitted to, of a `Machine`."""
        return tested(self.bound, [(x.stage, x.fit, x.fit) for x in self.located])

    @property
    def fails(self) -> bool:
        """Whether any stage's error is more than noise."""
        return any(x.fails for x in self.located) or bool(self.held and self.held.failing)

    @property
    def verdict(self) -> str:
        """Agrees or fails."""
        return "fails" if self.fails else "agrees"

    def sentence(self) -> str:
        """The answer in one sentence."""
        return located_sentence(self.located, self.bound.not_observed, self.held.failing if self.held else ())

    def to_dict(self) -> dict[str, object]:
        """The answer as the JSON of ``vaneloop locate``."""
        out: dict[str, object] = {"schema": 1, "log": self.log, "stages": [x.json() for x in self.located]}
        out |= {"not_observed": self.bound.not_observed, "notes": self.bound.notes} | _tested_json(self.tested)
        out |= {"whole": self.held.json()} if self.held else {}
        if self.by_log is not None:
            signals = [{**f.json(), "reference": "measured"} for x in self.located for f in x.signals]
            out |= {"signals": signals, **self.by_log.json(), "verdict": self.verdict}
        return out | {"done": counted(cast("list[str]", out["notes"]))}

    def rows(self) -> list[Row]:
        """A row for each signal: its error, RMS, and in noise floors."""
        return [
            {
                "subsystem": x.stage, "signal": f.signal, "unit": f.unit, "rms": f.rms, "rms_as_given": f.rms_as_given,
                "noise_floor": f.noise_floor, "ratio": f.ratio, "samples": f.samples, "fails": x.fails,
            }
            for x in self.located for f in x.signals
        ]  # fmt: skip

    def _fits(self) -> list[Fitted]:
        return [_fitted(self.bound, x.stage, x.floor, x.fit, x.fit) for x in self.located]

    def page(self, command: str = "") -> Page:
        """The answer as a page."""
        title = "Where the model fails" if self.verb == "locate" else "Model and log"
        return compare_page(self.located, self.bound, command, self.log, self.by_log, self.tested, title)


@dataclass(frozen=True, repr=False, eq=False)
class Diagnosed(Answer):
    """What each stage lacks: effects with probability, parameters and rivals, or "unknown" with its shape.

    bound   the model held against the log
    by_log  of a `System`, what that means log by log
    held    of a very long log: what all of it says of what was found on an excerpt
    """

    bound: Bound
    diagnosis: Diagnosis
    log: str = ""
    by_log: ByLog | None = None
    held: Held | None = field(default=None, kw_only=True)

    @cached_property
    def tested(self) -> list[Tested]:
        """Errors on the part of the log that nothing was fitted to, of a `Machine`."""
        return tested(self.bound, [(s.stage, s.base, s.final) for s in self.diagnosis.stages])

    @property
    def verdict(self) -> str:
        """Missing, none or unknown."""
        return self.diagnosis.verdict

    @property
    def effects(self) -> list[str]:
        """Names of the effects named as missing, the most probable first."""
        return [str(e["effect"]) for e in diagnosis_json(self.diagnosis, self.log)["effects"]]

    def sentence(self) -> str:
        """The answer in one sentence."""
        return verdict_sentence(self.diagnosis, self.by_log)

    def to_dict(self) -> dict[str, object]:
        """The answer as the JSON of ``vaneloop diagnose``."""
        by_log = self.by_log.json() if self.by_log else {}
        whole = {"whole": self.held.json()} if self.held else {}
        out = diagnosis_json(self.diagnosis, self.log) | by_log | _tested_json(self.tested) | whole
        return out | {"done": counted(out["notes"])}

    def rows(self) -> list[Row]:
        """A row for each signal: its held-out error without and with what was found, RMS."""
        return [
            {
                "subsystem": s.stage, "verdict": self._word(s), "signal": signal, "unit": s.units[k],
                "error_before": float(s.error_before[k]), "error_after": float(s.error_after[k]),
                "noise_floor": float(s.floor[k]), "effects": ", ".join(f.effect for f in s.effects),
            }
            for s in self.diagnosis.stages for k, signal in enumerate(s.outputs)
        ]  # fmt: skip

    def _word(self, s: StageDiagnosis) -> str:
        """What a stage says, as the JSON has it."""
        return s.verdict

    def _fits(self) -> list[Fitted]:
        return [_fitted(self.bound, s.stage, s.floor, s.final, s.base) for s in self.diagnosis.stages]

    def page(self, command: str = "") -> Page:
        """The answer as a page."""
        return diagnosis_page(self.diagnosis, self.bound, command, self.log, by_log=self.by_log, tested=self.tested)


@dataclass(frozen=True, repr=False, eq=False)
class Extended(Diagnosed):
    """The model with effects added and fitted.

    model    recalibrated parameters and all effects
    refused  why the model is no better with them; "": it is
    path     where the model file was written; "": nowhere
    """

    model: Model | None = None
    refused: str = ""
    path: str = ""

    @property
    def reached(self) -> bool:
        """Whether each stage extended stands at its noise floor."""
        return all(map(reached, self.diagnosis.stages))

    @property
    def verdict(self) -> str:
        """Explained: the error of each stage extended is noise by now; else missing."""
        return EXPLAINED if self.reached and not self.refused else MISSING

    def _word(self, s: StageDiagnosis) -> str:
        return EXPLAINED if s.effects and reached(s) and not self.refused else s.verdict

    def sentence(self) -> str:
        """The answer in one sentence."""
        return extended_sentence(self.diagnosis, self.refused)

    def page(self, command: str = "") -> Page:
        """The answer as a page."""
        return extended_page(self.diagnosis, self.bound, command, self.log, self.refused, self.by_log, self.tested)

    def to_dict(self) -> dict[str, object]:
        """The answer as the JSON of ``vaneloop extend``."""
        waterfall = {r.stage: [{"step": n, "noise_floors": v} for n, v in r.steps] for r in self.diagnosis.stages}
        said, words = super().to_dict(), {s.stage: self._word(s) for s in self.diagnosis.stages}
        rows = cast("list[dict[str, object]]", said["stages"])
        stages = [{**row, "verdict": words.get(str(row["stage"]), row["verdict"])} for row in rows]
        own = {"model": self.path, "waterfall": waterfall}
        return {**said, "verdict": self.verdict, "stages": stages, **own}

    def write(self, path: str | Path) -> Path:
        """Write the model file that every command takes with ``--model``; return its path."""
        assert self.model is not None
        write_model(str(path), self.model)
        return Path(path)


class Recommended(TypedDict):
    """A run that tells rivals apart, or parameters.

    score      of a `Machine` the smallest log-likelihood ratio over all pairs of rivals and all ``repeats``, nats; of a
               `System` the log of the error with the wrong law over that with the right one, or of its parameters'
               standard errors in the log over those in the run
    t, inputs  the run: s, and what drives the machine, name -> unit, values
    table      every run that was tried, the best first; ``heads``: key -> heading of its columns
    """

    text: str
    profile: str
    score: float
    separates: bool
    repeats: int
    t: Array
    inputs: dict[str, tuple[str, Array]]
    table: list[dict[str, object]]
    heads: dict[str, str]


@dataclass(frozen=True, repr=False, eq=False)
class Experiment(Answer):
    """Which run would best tell the rivals of a diagnosis apart; ``recommended`` None: there are none. Of a `System`
    without rivals, which run would best tell its parameters.
    """

    diagnosed: Diagnosed
    recommended: Recommended | None
    log: str = ""

    def sentence(self) -> str:
        """The answer in one sentence."""
        return self.recommended["text"] if self.recommended else "Nothing to separate: the log leaves no rivals."

    def to_dict(self) -> dict[str, object]:
        """The answer as the JSON of ``vaneloop experiment``."""
        e, notes = self.recommended, self.diagnosed.diagnosis.notes
        if e is None:
            return {"schema": 1, "log": self.log, "recommended": None, "profiles": []} | told(notes)
        score = "nats" if "nats" in e["heads"] else "score"
        best = {
            score: e["score"], "profile": e["profile"], "repeats": e["repeats"], "separates": e["separates"],
            "text": e["text"],
        }  # fmt: skip
        return {"schema": 1, "log": self.log, "recommended": best, "profiles": e["table"]} | told(notes)

    def rows(self) -> list[Row]:
        """A row for each profile that was tried."""
        table = self.recommended["table"] if self.recommended else []
        return [{k: v for k, v in row.items() if k != "by_pair"} for row in table]

    def _fits(self) -> list[Fitted]:
        return self.diagnosed._fits()

    def _worked_out(self) -> Curves:
        return self.diagnosed._curves

    def plot(self, ax: Axes | None = None, *, signal: str = "", residuals: bool = False) -> Axes:
        """Draw what drives the run; where none is recommended, or a signal is asked for, as of a diagnosis."""
        if self.recommended is None or signal or residuals:
            return super().plot(ax, signal=signal, residuals=residuals)
        ax = axes(ax)
        for name, (unit, values) in self.recommended["inputs"].items():
            ax.plot(self.recommended["t"], values, color=COLOUR["target"], label=heading(name, unit))
        return labelled(ax, ", ".join(heading(n, unit) for n, (unit, _) in self.recommended["inputs"].items()))

    def page(self, command: str = "") -> Page:
        """The answer as a page."""
        d, run = self.diagnosed, cast("dict[str, Any] | None", self.recommended)
        return experiment_page(d.diagnosis, d.bound, command, self.log, self.sentence(), run, d.by_log)


def _fitted(bound: Bound, name: str, floor: Array, fit: Fit, base: Fit) -> Fitted:
    stage = next(s for s in bound.stages if s.name == name)
    return Fitted(LeastSquaresProblem(stage, floor), fit, base, getattr(bound, "start", 0.0))


# ---- the verbs -------------------------------------------------------------------------------------------------------


def _tested_json(rows: Sequence[Tested]) -> dict[str, Any]:
    return {"tested": [asdict(row) for row in rows]} if rows else {}


def chain_for(log: LogLike, machine: Machine, fit: Parts = (), test: Parts | LogsLike = ()) -> tuple[Chain, str]:
    """A log in the stages of a machine, and the log's name."""
    to_fit, to_test, others = split(fit, test)
    if others:
        raise InputError(f"test={brief(others[0])}: the vane chain takes parts of its log, such as (200, None)")
    read = log_of(log, machine, require=())
    return bind_parts(machine, read, to_fit, to_test), read.path


def _records(logs: LogsLike, system: System) -> list[Record]:
    several = logs if isinstance(logs, Sequence) and not isinstance(logs, str) else [logs]
    return [x if isinstance(x, Record) else read_record(x, system)[0] for x in several]


def logs_for(
    log: LogsLike, system: System, fit: Parts, test: Parts | LogsLike, added: Model | None
) -> tuple[Logs, str]:
    """The records held against a system, and the first one's name."""
    to_fit, to_test, others = split(fit, test)
    try:
        first, *more = _records(log, system)
        fitted = [*records_of(first, to_fit), *more]
        tests = [*(records_of(first, to_test) if to_test else ()), *_records(others, system)]
        return bind(system, fitted, tests, added), first.name
    except StageError as e:
        raise InputError(str(e)) from None


def compare(
    log: LogsLike,
    model: Machine | System | None = None,
    *,
    fit: Parts = (),
    test: Parts | LogsLike = (),
    added: Model | None = None,
    progress: Progress | None = None,
) -> Stages:
    """By how much does the model miss? Each stage driven by its own logged inputs, so that none hides behind another.

    Parameters
    ----------
    log : Log, pandas.DataFrame, str or Path
        A log of the vane machine. Of a `System` one or several, also as `Record`.
    model : Machine or System, optional
        What the log is held against; default: the machine of the shipped tables.
    fit : (float, float) or a list of such, optional
        Parts of the (first) log that are fitted, (from, to) in s of its own time, None an open end; default: all.
    test : (float, float), a list of such, or logs, optional
        Parts of it that only test what was fitted; of a `System` also logs of their own.
    added : plant.Model, optional
        Parameters and laws that a `System` has by now; a `Machine` has its own.
    progress : callable, optional
        Takes the fraction done.

    Returns
    -------
    Stages
        Its `rows` are the signals with their errors; ``residuals``, ``fitted`` and ``params`` are those of each stage
        with its nominal parameters refitted within their tolerances.

    Raises
    ------
    InputError
        One line, for a log that the model cannot be held against.

    Examples
    --------
    >>> import vaneloop
    >>> frame = vaneloop.read_log("examples/hidden_effect.parquet").to_pandas().loc[:30.0, ["x_lvdt", "vigv"]]
    >>> answer = vaneloop.compare(frame)
    >>> answer.verdict
    'agrees'
    >>> [(row["subsystem"], row["signal"], row["unit"]) for row in answer.rows()]
    [('linkage', 'vigv', 'deg')]
    >>> answer.residuals
    Channels('hidden_effect.parquet', 2,550 rows, 4.51 to 30 s: vigv [deg])
    """
    if isinstance(model, System):
        return compared_system(*logs_for(log, model, fit, test, added), added)
    chain, name = chain_for(log, model or Machine(), fit, test)
    return compared(chain, name, progress=progress)


def compared_system(logs: Logs, log: str, added: Model | None = None) -> Stages:
    """`compare` of logs that have been put into a system."""
    located = locate_stages(logs.fitted.stages)
    return Stages(logs.fitted, located, log, ByLog.of(logs, as_given(logs, located[0].fit), added))


def compared(chain: Chain, log: str, verb: str = "compare", progress: Progress | None = None) -> Stages:
    """`compare` of a log that has been put into stages."""
    located, held = located_of(chain, (lambda f, _: progress(f)) if progress else None)
    return Stages(chain, located, log, None, verb, held)


def locate(
    log: LogsLike,
    model: Machine | System | None = None,
    *,
    fit: Parts = (),
    test: Parts | LogsLike = (),
    added: Model | None = None,
    progress: Progress | None = None,
) -> Stages:
    """Which stage fails, under which conditions, since when? `compare`, asked for its details.

    Parameters
    ----------
    log, model, fit, test, added, progress
        As of `compare`.

    Returns
    -------
    Stages
        Its ``located`` has the conditions of each stage.

    Examples
    --------
    >>> import vaneloop
    >>> frame = vaneloop.read_log("examples/hidden_effect.parquet").to_pandas().loc[:30.0, ["x_lvdt", "vigv"]]
    >>> print(vaneloop.locate(frame).located[0].verdict())
    fits everywhere
    """
    return replace(compare(log, model, fit=fit, test=test, added=added, progress=progress), verb="locate")


def diagnose(
    log: LogsLike,
    model: Machine | System | None = None,
    *,
    fit: Parts = (),
    test: Parts | LogsLike = (),
    added: Model | None = None,
    without: Sequence[str] = (),
    workers: int = 2,
    progress: Progress | None = None,
) -> Diagnosed:
    """Which physical effects does the model lack?

    Parameters
    ----------
    log, model, fit, test, added, progress
        As of `compare`.
    without : sequence of str, optional
        Effects that are not looked for.
    workers : int, optional
        Stages searched at a time, each in a process of its own; a thread other than the main one searches them one
        after the other.

    Returns
    -------
    Diagnosed
        Its ``verdict`` is missing, none or unknown; ``effects`` are the names of what is missing, the most probable
        first; ``params`` has the sizes of these effects.

    Raises
    ------
    InputError
        One line, for a log that the model cannot be held against.

    Examples
    --------
    An amplifier that rectifies, and its model that does not:

    >>> import numpy as np, pandas as pd, vaneloop
    >>> system = vaneloop.System(
    ...     "amplifier", "static", lambda u, p: p.gain * u.u, inputs={"u": "V"}, outputs={"y": "V"},
    ...     parameters=[vaneloop.unknown("gain", 1.0, "-")], places=["output"],
    ... )
    >>> t = np.arange(0.0, 20.0, 0.02)
    >>> frame = pd.DataFrame({"u": np.sin(0.4 * t) + 0.7 * np.sin(1.7 * t + 1.0)}, index=pd.Index(t, name="t"))
    >>> noise = 0.01 * np.random.default_rng(1).standard_normal(len(t))
    >>> frame["y"] = np.abs(2.0 * frame["u"]) + noise
    >>> answer = vaneloop.diagnose(frame, system)
    >>> answer.verdict, answer.effects
    ('missing', ['y.absolute_value'])
    >>> round(answer.params["gain"].value, 2), answer.params["gain"].unit
    (2.0, '-')
    """
    if isinstance(model, System):
        model = replace(model, without=(*model.without, *without))
        return diagnosed_system(*logs_for(log, model, fit, test, added), added, progress)
    chain, name = chain_for(log, model or Machine(), fit, test)
    return diagnosed(not_given(chain, without), name, workers, progress)


def diagnosed_system(
    logs: Logs,
    log: str,
    added: Model | None = None,
    progress: Progress | None = None,
    news: Callable[[News], None] | None = None,
) -> Diagnosed:
    """`diagnose` of logs that have been put into a system; ``news`` takes what is being tried meanwhile."""
    d = search(logs.fitted.stages, None, progress, 1, logs.judged(), news)
    by_log = ByLog.of(logs, d.stages[0], added)
    d.notes = by_log.notes
    return Diagnosed(logs.fitted, d, log, by_log)


def not_given(chain: Chain, effects: Sequence[str]) -> Chain:
    """The chain, of whose stages some effects are not looked for."""
    if not effects:
        return chain
    known(effects, "without")
    return changed(chain, lambda c: replace(c, stages=without_laws(c.stages, effects)))


def diagnosed(
    chain: Chain,
    log: str,
    workers: int = 2,
    progress: Progress | None = None,
    news: Callable[[News], None] | None = None,
) -> Diagnosed:
    """`diagnose` of a log that has been put into stages; ``news`` takes what is being tried and found meanwhile."""
    if chain.whole is None:
        d, held = search(chain.stages, chain.not_observed, progress, workers, news=news), None
    else:
        chain, d, held = searched(chain, workers, progress, news)
    d.notes = _noted(chain, d.stages, held)
    return Diagnosed(chain, d, log, held=held)


def _noted(chain: Chain, stages: Sequence[StageDiagnosis], held: Held | None) -> list[str]:
    """What there is to note. Onsets are told in the log's own time from now on; a chain's begins at 0."""
    for s in stages:
        if s.onset is not None:
            s.onset = Onset(*(v + chain.start for v in (s.onset.value, s.onset.low, s.onset.high)))
    return [*chain.notes, *(map(str, held.failing) if held else ()), *_at_limit(stages)]


def _at_limit(stages: Sequence[StageDiagnosis]) -> list[str]:
    """Nominal parameters that stand at the end of their tolerance, a line each."""
    return [
        f"{s.stage}: {r['parameter']} stands at the end of its tolerance, {float(cast(float, r['value'])):.4g} "
        f"{r['unit']}: the log would have it go on"
        for s in stages for r in s.recalibrated if r["at_limit"]
    ]  # fmt: skip


def extend(
    log: LogsLike,
    effects: Sequence[str],
    model: Machine | System | None = None,
    *,
    fit: Parts = (),
    test: Parts | LogsLike = (),
    added: Model | None = None,
) -> Extended:
    """Add effects to the model and fit them, together with those it has.

    Parameters
    ----------
    log : Log, pandas.DataFrame, str or Path
        As of `compare`.
    effects : sequence of str
        Their names, and law files (``X.toml``).
    model, fit, test, added
        As of `compare`.

    Returns
    -------
    Extended
        Its ``verdict`` is explained where the error is noise by now, else missing; ``write`` writes the model.

    Raises
    ------
    InputError
        For an effect that is not in the library, or whose stage the log does not show.

    Examples
    --------
    >>> import vaneloop
    >>> log = vaneloop.read_log("examples/hidden_effect.parquet")[0:60]
    >>> better = vaneloop.extend(log, ["valve_dead_band", "aero_load"])
    >>> better.verdict, better.refused
    ('explained', '')
    >>> width = better.params["valve_dead_band.half_width"]
    >>> width.unit, width.low < 0.8 < width.high, width.at_bound
    ('mA', True, False)
    """
    effects = [effects] if isinstance(effects, str) else list(effects)
    if not effects:
        raise InputError("effects is empty; allowed: at least one effect, such as those that diagnose names")
    if isinstance(model, System):
        return _extended(*logs_for(log, model, fit, test, added), effects, added)
    machine = model or Machine()
    wanted, more = with_law_files(effects, machine)
    known([e for e in wanted if e not in more.curves])
    chain, name = chain_for(log, Machine(machine.tables, None, machine.strategy, machine.table), fit, test)
    return extended(chain, wanted, more, name)


def _extended(logs: Logs, name: str, effects: Sequence[str], added: Model | None) -> Extended:
    """`extend` of a system that has been held against its logs."""
    started = time.perf_counter()
    bound = logs.fitted
    have = [e.name for e in bound.stage.effects]
    for e in effects:
        if e not in have:
            why = "it is part of the model already" if e in bound.present else _close(e, have)
            raise InputError(f"--effect {e!r}: not a law that system {bound.system.name!r} can be given; {why}")
    r = extend_stage(bound.thinned, tuple(dict.fromkeys(effects)), judged=RelativeErrorAcceptance)
    by_log = ByLog.of(logs, r, added)
    d = Diagnosis("missing", [r], {}, {}, time.perf_counter() - started, by_log.notes)
    return Extended(bound, d, name, by_log, by_log.model, no_better(r) or "")


def _close(name: str, known: Sequence[str]) -> str:
    close = difflib.get_close_matches(name, known, 3, 0.4)
    return f"close: {', '.join(close)}" if close else f"it can have {', '.join(known)}"


def known(effects: Sequence[str], option: str = "effect") -> None:
    """Refuse an effect that is not in the library; ``option``: by which it was given."""
    for name in effects:
        if side_of(name)[1] not in EFFECTS:
            close = difflib.get_close_matches(name, EFFECTS, 1)
            hint = f"; probably {close[0]!r} is meant" if close else ""
            raise InputError(f"--{option} {name!r} is not in the library{hint}; docs/effects.md lists it")


def extended(chain: Chain, wanted: Sequence[str], before: Model, log: str) -> Extended:
    """`extend` of a log that has been put into the stages of the nominal machine; ``before``: the model so far."""
    started = time.perf_counter()
    laws = {name: law.now(before.effects.get(name, {})) for name, law in before.curves.items()}
    places: dict[str, list[str]] = {}  # effect -> the subsystems of this log that show it
    of_sides = [f"{side}.{name}" for side, of in before.sides.items() for name in of.effects]
    for name in (x for asked in dict.fromkeys([*before.effects, *of_sides, *wanted]) for x in _forms(asked, chain)):
        law, effect = laws.get(name), side_of(name)[1]
        if law is None and (why := chain.plant.lacks(EFFECTS[effect])):
            raise InputError(f"--effect {name}: {why} (docs/effects.md)")
        shown = PLACES[f"{law.at} {law.how}"].stages if law else _shown_by(name, chain)
        places[name] = [s for s in shown if any(s == c.name for c in chain.stages)]
        if not places[name] and (law or name in wanted):
            why = "; ".join(f"{s}: {chain.not_observed.get(s, CANNOT)}" for s in shown)
            raise InputError(f"{log}: --effect {name}: the log does not show its subsystem ({why})")

    def fitted_in(stages: Chain, by_stage: Mapping[str, Sequence[str]]) -> Chain:
        """The stages as they are fitted: those with a learned law have its curve."""
        out = []
        for x in stages.stages:
            names = by_stage.get(x.name, ())
            curves = [curve_effect(n, laws[n]) for n in names if n in laws]
            out.append(with_laws(x, [n for n in names if n not in laws], curves, log))
        return replace(stages, stages=out)

    def clearest(name: str, sure: Mapping[str, Sequence[str]]) -> str:
        """The subsystem that shows an effect most clearly beside those that are ``sure`` to be there: the greatest gain
        of log-likelihood, its noise taken as what is left.
        """
        gains = {}
        for s in places[name]:
            names = (*sure.get(s, ()), name)
            stage = fitted_in(chain, {s: names}).stage(s)
            (found,) = (f for f in extend_stage(stage, names).effects if f.effect == name)
            gains[s] = float(np.isfinite(stage.measured).sum()) * np.log(max(found.fall, 1e-300))
        return max(gains, key=lambda s: gains[s])

    by_stage: dict[str, list[str]] = {}
    for name in sorted(filter(places.get, places), key=lambda n: len(places[n]) > 1):
        where = places[name][0] if len(places[name]) == 1 else clearest(name, by_stage)
        by_stage.setdefault(where, []).append(name)
    order = list(places)
    for names in by_stage.values():
        names.sort(key=order.index)

    bound = changed(chain, lambda stages: fitted_in(stages, by_stage))
    results = [as_compared(chain.stage(s), extend_stage(bound.stage(s), tuple(names))) for s, names in by_stage.items()]
    model = with_fits(before, results)
    seconds = time.perf_counter() - started
    held = None
    if chain.whole is not None:
        results, held = held_results(bound, results)
    notes = _noted(chain, results, held)
    notes += [f"{r.stage}: effects {since(r)}; the model has them all along" for r in results if r.onset is not None]
    d = Diagnosis("missing", results, {}, chain.not_observed, seconds, notes)
    return Extended(bound, d, log, None, model, next(filter(None, map(no_better, results)), ""), held=held)


def _forms(name: str, chain: Chain) -> tuple[str, ...]:
    """The names by which the stages have an effect that was asked for: its own; of two actuators that have one each,
    that of either side.
    """
    if chain.plant.sides == 1:
        return (name,)
    have = {e.name for s in chain.stages for e in s.effects}
    of_sides = tuple(f"{side}.{name}" for side in SIDE_NAMES if f"{side}.{name}" in have)
    return (name,) if name in have else of_sides or (name,)


def _shown_by(name: str, chain: Chain) -> tuple[str, ...]:
    """The subsystems that show an effect of the library, whether this log has them or not."""
    side, effect = side_of(name)
    if side and not (chain.plant.sides == 2 and of_a_side(effect, chain.plant.one_valve)):
        raise InputError(f"--effect {name}: {effect} is not of one of two actuators of this machine (docs/machines.md)")
    if chain.plant.sides == 1:
        return EFFECTS[effect].stages
    known = [s.name for s in chain.stages] + list(chain.not_observed)
    having = {s.name for s in chain.stages if name in s.index()}
    return tuple(
        s for s in known if s in having or (s in chain.not_observed and s.split("_")[0] in EFFECTS[effect].stages)
    )


def with_fits(model: Model, results: Sequence[StageDiagnosis]) -> Model:
    """The model with effects and nominal parameters as stages of the vane chain were fitted; a curve of a law file is
    as it was learned, times its scale.
    """
    parts: dict[str, Model | Side] = {"": model, **dict(zip(SIDE_NAMES, (model.side_a, model.side_b), strict=True))}
    parameters = {side: dict(part.parameters) for side, part in parts.items()}
    effects = {side: dict(part.effects) for side, part in parts.items()}
    for r in results:
        for q in r.recalibrated:
            side, name = side_of(str(q["parameter"]))
            parameters[side][name] = float(cast(float, q["value"]))
        for f in r.effects:
            side, name = side_of(f.effect)
            fitted = {k: float(cast(float, v["value"])) for k, v in f.parameters.items()}
            if learned := model.curves.get(f.effect):
                law = learned.now(model.effects.get(f.effect, {}))
                effects[side][name] = {n: v * fitted[SCALE] for n, v in zip(law.numbers, law.values, strict=True)}
            else:
                own = [p.name for p in EFFECTS[name].parameters]
                effects[side][name] = {k: v for k, v in fitted.items() if k in own}
    of = {side: {"parameters": parameters[side], "effects": effects[side]} for side in parts}
    sides = {side: parts[side].model_copy(update=of[side]) for side in SIDE_NAMES}
    return model.model_copy(update=of[""] | sides)


def experiment(
    log: LogsLike,
    model: Machine | System | Diagnosed | None = None,
    *,
    fit: Parts = (),
    test: Parts | LogsLike = (),
    added: Model | None = None,
    limits: Limits | None = None,
    progress: Progress | None = None,
) -> Experiment:
    """Which run would best tell apart the rivals that a log leaves? Of a `System` without rivals: tell its parameters.

    Parameters
    ----------
    log : Log, pandas.DataFrame, str or Path
        As of `compare`.
    model : Machine, System or Diagnosed, optional
        The model, or the diagnosis of this log where that has been made.
    fit, test, added
        As of `compare`.
    limits : Limits, optional
        What a run of a `System` must keep to; default: the ranges that its inputs have in the log.
    progress : callable, optional
        Takes the fraction done.

    Returns
    -------
    Experiment
        Its ``recommended`` is None where the log leaves no rivals; `rows` are the profiles that were tried.

    Examples
    --------
    >>> import vaneloop
    >>> frame = vaneloop.read_log("examples/hidden_effect.parquet").to_pandas().loc[:30.0, ["x_lvdt", "vigv"]]
    >>> print(vaneloop.experiment(frame))
    Nothing to separate: the log leaves no rivals.
    """
    tell = progress or (lambda _: None)
    if isinstance(model, System):
        model = diagnose(log, model, fit=fit, test=test, added=added, progress=lambda f: tell(0.3 * f))
    elif not isinstance(model, Diagnosed):
        model = diagnosed(*chain_for(cast("LogLike", log), model or Machine(), fit, test))
    if model.by_log is None:
        best = recommend(model.diagnosis, progress, model.bound)
    else:
        best = best_run(
            model.by_log.logs.fitted, model.diagnosis.stages[0], limits or Limits(), lambda f: tell(0.3 + 0.7 * f)
        )
    return Experiment(model, cast("Recommended | None", best), model.log)
