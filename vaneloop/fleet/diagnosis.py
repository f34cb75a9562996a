"""What a fleet run does with one log: the diagnosis, and from it what can be followed over time."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hil.logs import Channel, Log, read_log
from hil.loop.lockstep import Stimulus, lockstep
from vaneloop.base.errors import InputError
from vaneloop.identification import StageError, load_system
from vaneloop.identification.user_models.by_log import load_model_of
from vaneloop.verbs.machine import Machine, files_of
from vaneloop.verbs.search import diagnose, read_record

if TYPE_CHECKING:
    from vaneloop.verbs.search import Diagnosed

    Columns = dict[str, tuple[np.ndarray, np.ndarray]]

__all__ = ["diagnose_log"]


def diagnose_log(path: str, options: dict[str, Any], run: str) -> dict[str, Any]:
    """Diagnose a log as ``vaneloop diagnose`` does; return verdict and answer, without what differs between two runs.

    options  files (of the machine or the user's own system, within the run's folder), and how logs are read
             (`hil.logs.read_log`)
    """
    files = {name: str(Path(run) / f) for name, f in options["files"].items()}
    reading = dict(options["reading"])
    reading |= {k: files[n] for k, n in (("dbc", "dbc"), ("mapping_file", "mapping")) if n in files}
    said, columns = (_of_system if "system" in files else _of_machine)(path, files, reading)
    answer = said.to_dict()
    answer.pop("elapsed_s")
    answer["nominal"], answer["sizes"] = _nominal(said), _sizes(said, answer)
    answer["range"] = {name: [float(np.nanmin(v)), float(np.nanmax(v))] for name, (_, v) in sorted(columns.items())}
    answer["duration_s"] = float(max(t[-1] for t, _ in columns.values()) - min(t[0] for t, _ in columns.values()))
    return {"verdict": said.verdict, "answer": answer}


def _of_machine(path: str, files: dict[str, str], reading: dict[str, Any]) -> tuple[Diagnosed, Columns]:
    """The answer to a log of the vane machine, and times and values of its channels."""
    log = read_log(path, require=(), **reading, tables=files_of(files.get("tables")))
    said = diagnose(log, _machine(files), workers=1)
    return said, {name: (c.t, c.values) for name, c in log.channels.items()}


def _of_system(path: str, files: dict[str, str], reading: dict[str, Any]) -> tuple[Diagnosed, Columns]:
    """The same of a user's own system, with what its model file has learned by now."""
    try:
        system = load_system(files["system"])
        added = load_model_of(files["model"], system) if "model" in files else None
        record, _ = read_record(path, system, **({} if system.read else reading))
        said = diagnose(record, system, added=added)
    except StageError as e:
        raise InputError(str(e)) from None
    measured = {name: v for name, v in record.columns.items() if np.isfinite(v).any()}
    return said, {name: (record.t, v) for name, v in measured.items()}


def _machine(files: dict[str, str]) -> Machine:
    given = {"tables": "tables", "model": "model", "table": "plant", "controller": "controller"}
    named: dict[str, Any] = {argument: files[name] for argument, name in given.items() if name in files}
    return Machine(**named)


def _nominal(said: Diagnosed) -> list[dict[str, Any]]:
    """Every nominal parameter that the log could move, as fitted with what was found: value, 90 % interval, and what
    the tables say of it. Of a user's own system those that it declares, not where a log starts; an unknown one has no
    tolerance.
    """
    out, stages = [], {s.name: s for s in said.bound.stages}
    declared = {p.name: p for p in said.by_log.logs.fitted.system.parameters} if said.by_log else None
    for d in said.diagnosis.stages:
        parameters = stages[d.stage].parameters
        for k, column in enumerate(d.final.free):
            if column < len(parameters) and (declared is None or parameters[int(column)].name in declared):
                p = parameters[int(column)] if declared is None else declared[parameters[int(column)].name]
                out.append({
                    "stage": d.stage, "parameter": p.name, "unit": p.unit, "value": float(d.final.theta[column]),
                    "low": float(d.final.low[k]), "high": float(d.final.high[k]), "table": float(p.value),
                    "tolerance": float(p.tolerance) if np.isfinite(p.tolerance) else None,
                })  # fmt: skip
    return out


def _sizes(said: Diagnosed, answer: dict[str, Any]) -> list[dict[str, Any]]:
    """Every parameter of the effects named, a row each, with its neutral value; of what says how and not how much,
    nothing.
    """
    out, stages = [], {s.name: s for s in said.bound.stages}
    for e in answer["effects"]:
        for p in stages[e["stage"]].effect(e["effect"]).parameters:
            if not p.shape:
                found = e["parameters"][p.name]
                out.append({
                    "effect": e["effect"], "stage": e["stage"], "probability": float(e["probability"]),
                    "parameter": p.name, "unit": p.unit, "value": found["value"], "low": found["low"],
                    "high": found["high"], "neutral": float(p.value),
                })  # fmt: skip
    return out


def _warm_up(options: dict[str, Any], run: str) -> None:
    """Compile all that a diagnosis needs, on a short simulated run; of a user's own system with its first log."""
    if "system" in options["files"]:
        return
    machine = _machine({name: str(Path(run) / f) for name, f in options["files"].items()})
    n_dem = np.repeat([60.0, 90.0, 70.0, 95.0], 1000)
    simulated = lockstep(Stimulus.of(n_dem), calibration=machine.calibration, plant=machine.plant, seed=1, every=10)
    columns = {k: Channel(simulated.t, v) for k, v in simulated.columns.items() if k != "t"}
    diagnose(Log("warm-up", columns), machine, workers=1)


diagnose_log.warm_up = _warm_up  # type: ignore[attr-defined]
