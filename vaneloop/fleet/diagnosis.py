"""What a fleet run does with one log: the diagnosis, and from it what can be followed over time."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from vaneloop.verbs.machine import Machine
    from vaneloop.verbs.search import Diagnosed

__all__ = ["diagnose_log"]


def diagnose_log(path: str, options: dict[str, Any], run: str) -> dict[str, Any]:
    """Diagnose a log as ``vaneloop diagnose`` does; return verdict and answer, without what differs between two runs.

    options  files (of the machine, within the run's folder), and how logs are read (`hil.logs.read_log`)
    """
    from hil.logs import read_log
    from vaneloop.verbs.machine import files_of
    from vaneloop.verbs.search import diagnose

    files = {name: str(Path(run) / f) for name, f in options["files"].items()}
    reading = dict(options["reading"])
    reading |= {k: files[n] for k, n in (("dbc", "dbc"), ("mapping_file", "mapping")) if n in files}
    log = read_log(path, require=(), **reading, tables=files_of(files.get("tables")))
    said = diagnose(log, _machine(files), workers=1)
    answer = said.to_dict()
    answer.pop("elapsed_s")
    answer["nominal"], answer["sizes"] = _nominal(said), _sizes(said, answer)
    answer["range"] = {
        name: [float(np.min(c.values)), float(np.max(c.values))] for name, c in sorted(log.channels.items())
    }
    answer["duration_s"] = float(
        max(c.t[-1] for c in log.channels.values()) - min(c.t[0] for c in log.channels.values())
    )
    return {"verdict": said.verdict, "answer": answer}


def _machine(files: dict[str, str]) -> Machine:
    from vaneloop.verbs.machine import Machine

    given = {"tables": "tables", "model": "model", "table": "plant", "controller": "controller"}
    return Machine(**{argument: files[name] for argument, name in given.items() if name in files})


def _nominal(said: Diagnosed) -> list[dict[str, Any]]:
    """Every nominal parameter that the log could move, as fitted with what was found: value, 90 % interval, and what
    the tables say of it.
    """
    out, stages = [], {s.name: s for s in said.bound.stages}
    for d in said.diagnosis.stages:
        parameters = stages[d.stage].parameters
        for k, column in enumerate(d.final.free):
            if column < len(parameters):
                p = parameters[int(column)]
                out.append({
                    "stage": d.stage, "parameter": p.name, "unit": p.unit, "value": float(d.final.theta[column]),
                    "low": float(d.final.low[k]), "high": float(d.final.high[k]), "table": float(p.value),
                    "tolerance": float(p.tolerance),
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
    """Compile all that a diagnosis needs, on a short simulated run."""
    from hil.logs import Channel, Log
    from hil.loop.lockstep import Stimulus, lockstep
    from vaneloop.verbs.search import diagnose

    machine = _machine({name: str(Path(run) / f) for name, f in options["files"].items()})
    n_dem = np.repeat([60.0, 90.0, 70.0, 95.0], 1000)
    simulated = lockstep(Stimulus.of(n_dem), calibration=machine.calibration, plant=machine.plant, seed=1, every=10)
    columns = {k: Channel(simulated.t, v) for k, v in simulated.columns.items() if k != "t"}
    diagnose(Log("warm-up", columns), machine, workers=1)


diagnose_log.warm_up = _warm_up  # type: ignore[attr-defined]
