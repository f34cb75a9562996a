"""A process beside the server that does the long work: reads logs, searches, refits. ``python -m vaneloop.web.worker
FD`` speaks over a socket.

It calls what the command line calls.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np

from controller import FAULTS
from hil.logs import Channel, Log, columns, offered, read_log
from hil.logs.formats import is_framed
from hil.logs.survey import survey
from hil.logs.table import NoTime
from hil.loop.lockstep import Stimulus, lockstep, warm_up
from hil.replay import replay
from plant import load_geometry, load_schedules
from plant.geometry import vane_angles
from plant.spatial import plane_joints
from vaneloop.base import terminal
from vaneloop.base.errors import InputError
from vaneloop.base.extras import needs
from vaneloop.base.signals import UNITS
from vaneloop.cli import options
from vaneloop.cli.chains import tell_search
from vaneloop.cli.main import main
from vaneloop.cli.schedule import log_of
from vaneloop.design.links import ScheduleOptions
from vaneloop.design.schedule_files import write_tables
from vaneloop.design.scheduling import schedule
from vaneloop.design.stroke_tables import STROKE_LIMITS, stroke_tables, table_speeds
from vaneloop.fleet.folder import Folder
from vaneloop.fleet.report import view_of
from vaneloop.fleet.state import state_of
from vaneloop.fleet.tables import answers, roll_up
from vaneloop.identification import System
from vaneloop.identification.least_squares.problem import LeastSquaresProblem
from vaneloop.identification.workflow import locate_stages
from vaneloop.pages.by_log import errors_by_log
from vaneloop.pages.diagnosis import APART, diagnosis_page, errors_apart, located_tone
from vaneloop.pages.fleet import fleet_page, log_page
from vaneloop.pages.schedule import NAMES, schedule_page
from vaneloop.pages.story import fall, word
from vaneloop.verbs.learn import with_path
from vaneloop.verbs.machine import Machine
from vaneloop.verbs.parts import read_record, signals_of
from vaneloop.verbs.search import Diagnosed, Stages
from vaneloop.verbs.search import experiment as recommend
from vaneloop.web.held import Held, held, system_of
from vaneloop.web.process import Progress, answer, parsed

__all__ = ["TASKS"]

# ---- what is kept between questions ----------------------------------------------------------------------------------

_HELD: dict[tuple[str, ...], Held] = {}  # the latest log only


def held_of(words: list[str], progress: Progress) -> Held:
    """Return the log that ``words`` name (with its options), held against its model; read once."""
    key = tuple(words)
    if key not in _HELD:
        _HELD.clear()
        _HELD[key] = held(parsed("diagnose", words), lambda text: progress(None, text))
    return _HELD[key]


# ---- tasks -----------------------------------------------------------------------------------------------------------


SECONDS = 20  # of the run that is compared to load what a comparison needs


def ready(progress: Progress) -> None:
    """Load what a log will need, before there is one: modules, and compiled code by a comparison of a short run."""
    warm_up(lambda text: progress(None, text))
    run = lockstep(Stimulus.of(np.repeat([60.0, 90.0, 70.0, 95.0], 25 * SECONDS)), seed=1)
    log = Log("ready", {k: Channel(run.t, v) for k, v in run.columns.items() if k in UNITS})
    tell_search(lambda text: progress(None, text))
    locate_stages(Machine().bind(log).stages)


def offers(progress: Progress, words: list[str]) -> list[str]:
    """Names that the log offers, to be mapped; none where the model has a reader of its own."""
    args = parsed("diagnose", words)
    return [] if (system := system_of(args)) and system.read else offered(args.log, dbc=args.dbc)


def look(progress: Progress, words: list[str]) -> dict[str, Any]:
    """What the form of names and units shows: the survey of the log, or why there is none.

    ``ours``: the signals that the model looks for, name -> unit.
    """
    args = parsed("diagnose", words)
    system = system_of(args)
    ours = UNITS if system is None else signals_of(system)
    none: dict[str, Any] = {
        "signals": {},
        "open": {},
        "unused": [],
        "suggested_rpm": None,
        "damaged": False,
        "ours": ours,
    }
    if system is not None and system.read is not None:
        return none
    try:
        seen = survey(args.log, **options.log_options(args), signals=ours)
    except NoTime as e:
        return {**none, "open": {"t": str(e).partition(": ")[2]}}
    rows = {r.signal: (r.name, r.unit, r.how, r.confidence, r.why, r.curve.tolist()) for r in seen.rows}
    return {
        "signals": rows, "open": seen.open, "unused": seen.unused(), "suggested_rpm": seen.suggested_rpm,
        "damaged": seen.damaged, "ours": ours,
    }  # fmt: skip


def preview(progress: Progress, words: list[str]) -> dict[str, Any]:
    """Read the log: its channels in our names and units; and the controller's faults, where it has them."""
    if is_framed(Path(words[0])):
        columns.warm_up(lambda text: progress(None, text))
    args = parsed("diagnose", words)
    if (system := system_of(args)) is not None:
        return _preview_of(args, system)
    named = {f"fault_{f}": f for f in FAULTS}  # as vgv.dbc calls them
    signals = {**UNITS, **dict.fromkeys(named, "-")}
    try:
        log = read_log(args.log, **options.log_options(args), require=(), signals=signals)
    except InputError:  # said as every command says it
        log = options.read_log_of(args, require=())
    own = {n: c for n, c in log.channels.items() if n in UNITS}
    faults = {fault: (c.t, c.values) for n, fault in named.items() if (c := log.channels.get(n)) is not None}
    return {"notes": log.notes, "channels": {n: (UNITS[n], c.t, c.values) for n, c in own.items()}, "faults": faults}


def _preview_of(args: argparse.Namespace, system: System) -> dict[str, Any]:
    """`preview` for a model of the user's own: what it would be given of the log."""
    record, notes = read_record(args.log, system, **({} if system.read else options.log_options(args)))
    units, t, channels = signals_of(system), np.asarray(record.t, dtype=float), {}
    for name, values in record.columns.items():
        there = np.isfinite(values)
        if there.any():
            channels[name] = units.get(name, ""), t[there], np.asarray(values)[there]
    return {"notes": notes, "channels": channels, "faults": {}}


def compare(progress: Progress, words: list[str]) -> dict[str, Any]:
    """Compare and locate: errors stage by stage, failure maps, curves."""
    it = held_of(words, progress)
    progress(0.1, "comparing")
    answer = it.compared(lambda share: progress(0.1 + 0.9 * share, "comparing"))
    curves = {
        x.stage: curves_of(LeastSquaresProblem(it.stage(x.stage), x.floor), {"nominal model": x.fit.theta})
        for x in answer.located
    }
    progress(1.0, "")
    return {
        "figures": [f for x in answer.located for f in x.signals], "located": {x.stage: x for x in answer.located},
        "verdict": answer.sentence(), "tone": located_tone(answer.located), "curves": curves,
        "not_observed": it.bound.not_observed, "notes": it.bound.notes,
        "windows": {x.name: x.window for x in it.bound.stages}, "apart": apart(answer),
    }  # fmt: skip


def apart(answer: Stages | Diagnosed) -> tuple[str, list[str], list[list[Any]]] | None:
    """Title, columns and rows of the errors of each log apart, or of the part that only tests; None: there is none."""
    if answer.by_log is not None:
        logs = answer.by_log.logs
        several = len(logs.fitted.logs) > 1 or logs.test is not None
        return ("RMS error, log by log", *errors_by_log(answer.by_log)) if several else None
    return (APART, *errors_apart(answer.tested)) if answer.tested else None


def whole_loop(progress: Progress, words: list[str], floors: dict[str, float]) -> tuple[list[Any], str]:
    """The whole loop's errors, and why there are none."""
    args = parsed("diagnose", words)
    try:
        machine = options.machine_of(args)
        log = options.read_log_of(args)
        return replay(log, plant=machine.plant, calibration=machine.calibration, floors=floors).signals, ""
    except InputError as e:
        return [], str(e)


def curves_of(judge: Any, models: dict[str, Any]) -> dict[str, Any]:
    """Measured outputs of a stage and each model's error (in the output's unit), for plots. NaN where nothing
    counts.
    """
    stage = judge.stage
    e = judge.errors(np.array(list(models.values()))) * judge.floor[None, :, None]
    out = {}
    for k, output in enumerate(stage.outputs):
        valid = judge.valid[k]
        out[output] = {
            "unit": stage.units[k],
            "floor": float(judge.floor[k]),
            "measured": np.where(valid, stage.measured[k], np.nan),
            "errors": {name: np.where(valid, e[i, k], np.nan) for i, name in enumerate(models)},
        }
    return {"t": stage.t, "outputs": out}


def diagnose(progress: Progress, words: list[str]) -> dict[str, Any]:
    """Search every stage for missing effects, as ``vaneloop diagnose`` does."""
    it = held_of(words, progress)
    progress(0.0, "searching the library of effects")

    def news(n: Any) -> None:
        if n.found is not None:
            _, before, after = fall(n.found)
            names = " and ".join(f.effect for f in n.found.effects)
            said = f"{n.found.stage} {word(n.found)}" + (f" {names}, {before} → {after} noise floors" if names else "")
            progress(None, {"found": said})
        progress(n.fraction, n.text)

    answer = it.diagnosed(news)
    return {
        "diagnosis": answer.diagnosis, "json": answer.to_dict(), "verdict": answer.sentence(), "apart": apart(answer),
    }  # fmt: skip


def refit(progress: Progress, words: list[str], stage: str, effects: tuple[str, ...]) -> dict[str, Any]:
    """Fit one stage with exactly these effects, as ``vaneloop extend`` does."""
    it = held_of(words, progress)
    s = it.stage(stage)
    expected = max(2.0, 1.5 * len(effects) * (len(effects) + 1))
    done = 0

    def tick() -> None:
        nonlocal done
        done += 1
        progress(min(0.97, done / expected), f"fitting {' + '.join(effects) or 'the nominal model'}")

    tick()
    r = it.extended(s, effects, tick)
    judge = LeastSquaresProblem(s, r.floor)
    models = {"nominal model": r.base.theta}
    if effects:
        models["with effects"] = r.final.theta
    bounds = {e: {p.name: p for p in s.effect(e).parameters} for e in effects}
    return {
        "result": r, "curves": curves_of(judge, models), "theta": r.final.theta, "floor": r.floor, "bounds": bounds,
    }  # fmt: skip


def hand(
    progress: Progress, words: list[str], stage: str, theta: Any, floor: Any, values: dict[str, dict[str, float]]
) -> dict[str, Any]:
    """Error with parameters set by hand: nothing is fitted. ``values``: effect -> parameter -> value in its declared
    unit.
    """
    s = held_of(words, progress).stage(stage)
    judge = LeastSquaresProblem(s, np.asarray(floor))
    by_hand = np.array(theta, dtype=float)
    for effect, given in values.items():
        at = s.index()[effect].start
        for i, p in enumerate(s.effect(effect).parameters):
            if p.name in given:
                by_hand[at + i] = min(max(given[p.name], p.low), p.high)
    curves = curves_of(judge, {"by hand": by_hand})
    rms = {o: float(np.sqrt(np.nanmean(c["errors"]["by hand"] ** 2))) for o, c in curves["outputs"].items()}
    return {"curves": curves, "rms": rms}


def experiment(progress: Progress, words: list[str], diagnosis: Any) -> dict[str, Any] | None:
    """Recommend the next experiment, as ``vaneloop experiment`` does."""
    found = held_of(words, progress).again(diagnosis)
    answer = recommend(words[0], found, progress=lambda f: progress(f, "trying runs"))
    return cast("dict[str, Any] | None", answer.recommended)


def report(
    progress: Progress, words: list[str], diagnosis: Any, path: str, command: str, next_experiment: Any = None
) -> str:
    """Write the page of the diagnosis, as ``vaneloop diagnose --report`` does."""
    it = held_of(words, progress)
    progress(None, "writing the page")
    by_log = it.again(diagnosis).by_log
    return str(diagnosis_page(diagnosis, it.bound, command, words[0], next_experiment, by_log).write(path))


def learn(progress: Progress, words: list[str], diagnosis: Any, law: str, page: str, command: str) -> dict[str, Any]:
    """Learn a law from a log that has been diagnosed, as ``vaneloop learn`` does; write its file and its page."""
    text = "trying every quantity at every place"
    answer = held_of(words, progress).learned(diagnosis, lambda f: progress(f, text))
    if answer.model is not None:
        answer = with_path(answer, law, command)
    answer.report(page, command)
    return {
        "laws": answer.laws, "verdict": answer.verdict, "sentence": answer.sentence(), "notes": answer.notes,
        "nearest": answer.outcome.nearest,
    }  # fmt: skip


def command(progress: Progress, words: list[str]) -> dict[str, Any]:
    """Run a whole command line of ours; return its exit code and what it said. InputError for bad input and for a
    defect of ours.
    """
    said, complained = io.StringIO(), io.StringIO()
    sys.argv = ["vaneloop", *words]
    progress(None, "vaneloop " + words[0])
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(complained):
        try:
            code = main(words)
        except SystemExit as e:
            code = int(e.code or 0)
    if code in (2, terminal.DEFECT):
        lines = complained.getvalue().strip().splitlines()
        raise InputError(lines[-1].removeprefix("vaneloop: ") if lines else "bad input")
    return {"code": code, "text": said.getvalue()}


def engine_part(progress: Progress, path: str) -> tuple[str, Any]:
    """Read geometry or schedules: which of them the file is, and its content."""
    try:
        return "geometry", load_geometry(path)
    except InputError as no_geometry:
        try:
            return "schedules", load_schedules(path)
        except InputError as no_schedules:
            looks = "speed" in Path(path).read_bytes()[:200_000].decode("utf-8", "replace").split("[vigv]")[0]
            raise (no_schedules if looks else no_geometry) from None


def schedule_step(progress: Progress, step: str, words: list[str], out: str, command: str) -> Any:
    """One step of the scheduling method, by the functions of ``vaneloop schedule``."""
    args = parsed("schedule", words)
    progress(None, "reading")
    geometry, schedules = load_geometry(args.geometry), load_schedules(args.schedules)
    if step == "mechanism":
        strokes = np.linspace(*STROKE_LIMITS, 97)
        angles = np.rad2deg(vane_angles(strokes * 1e-3, geometry))
        stages = []
        for k, name in enumerate(geometry.vanes):
            joints = [list(plane_joints(geometry, name, x * 1e-3).values()) for x in strokes]
            places = [[[round(p.real * 1e3, 3), round(p.imag * 1e3, 3)] for p in j] for j in joints]
            radius = float(geometry.stage(name).ld.value)
            stages.append(
                {"key": name, "name": NAMES[name], "joints": places, "radius": radius, "angles": angles[:, k].tolist()}
            )
        return {"strokes": strokes.tolist(), "stages": stages}
    if step == "stroke":
        speed = table_speeds(schedules)
        return {"speed": speed, "table": stroke_tables(geometry, schedules, speed)}
    asked = ScheduleOptions(args.step, args.lb_range, args.lc_range, ("lb", "lc"), args.criterion, args.limit)
    result = schedule(geometry, schedules, log_of(args), asked, lambda f: progress(f, "scheduling"))
    if step != "tables":
        return result
    files = [str(f) for f in write_tables(result, out)]
    return {"result": result, "files": [*files, str(schedule_page(result, Path(out) / "schedule.html", command))]}


def fleet_state(progress: Progress, run: str) -> dict[str, Any]:
    """How far a fleet's run is, as ``vaneloop fleet status`` says it, and whether it is a campaign's."""
    needs("a fleet's run", "psutil", "duckdb", "ruptures")
    folder = Folder(run)
    return {**state_of(folder).json(), "campaign": folder.of_campaign}


def fleet_report(progress: Progress, run: str, logs: str) -> Any:
    """The page that ``vaneloop fleet report`` writes; None for a campaign's run."""
    folder = Folder(run)
    return None if folder.of_campaign else fleet_page(view_of(roll_up(folder), {}, run, folder.damaged), logs=logs)


def fleet_log(progress: Progress, run: str, key: str) -> str:
    """The page of one log of a run, as HTML."""
    found = answers(Folder(run), [key])
    if key not in found:
        raise InputError(f"{run}: has no answer to {key}")
    return log_page(key, found[key]).html()


TASKS: dict[str, Callable[..., Any]] = {
    **{
        f.__name__: f
        for f in (
            ready,
            offers,
            look,
            preview,
            compare,
            whole_loop,
            diagnose,
            refit,
            hand,
            experiment,
            report,
            learn,
            command,
            engine_part,
            schedule_step,
            fleet_state,
            fleet_report,
            fleet_log,
        )
    },
    "ahead": refit,  # the same, before the user asks for it
    "over": preview,  # of a log laid over the one chosen
    "judge": command,  # of a scenario, whatever else goes on
}


if __name__ == "__main__":
    os.nice(10)  # the page answers first
    sys.exit(terminal.run(lambda: answer(int(sys.argv[1]), TASKS, ready if "--load" in sys.argv else None)))
