"""Stand-ins for the diagnosis: cheap, and each log says by its text what it does to the process that reads it.

A process that imports this module knows them as kinds of work, and so do the processes that it starts.
"""

from __future__ import annotations

import os
import random
import signal
import time
from pathlib import Path
from typing import Any

from vaneloop.base.errors import InputError
from vaneloop.fleet import reader, rent
from vaneloop.fleet.kinds import KINDS, Kind, Options


def read(path: str, options: dict[str, Any], run: str) -> dict[str, Any]:
    """Count the letters of a log, or do what it says."""
    text = Path(path).read_text(encoding="utf-8")
    if "kill the reader" in text:
        os.kill(os.getpid(), signal.SIGSEGV)
    if "hang" in text:
        while True:
            time.sleep(3600.0)
    if "refuse" in text:
        raise InputError(f"{Path(path).name}: n_dem (=-3 %) must be in [0, 120] %")
    if "defect" in text:
        raise KeyError("level")
    if "alter" in text:
        Path(path).write_text("it has grown", encoding="utf-8")
    if "pause" in text:
        time.sleep(0.05)
    return {"verdict": "none", "answer": {"letters": len(text), "first": text[:12]}}


def diagnosed(path: str, options: dict[str, Any], run: str) -> dict[str, Any]:
    """An answer with a row in every table, drawn by the log's text, after a tenth of a second."""
    draw = random.Random(Path(path).read_text(encoding="utf-8"))
    time.sleep(0.1)
    value = draw.gauss(1.0, 0.1)
    row = {"stage": "linkage", "unit": "deg", "value": value, "low": value - 0.1, "high": value + 0.1}
    blind = {"effect": "coil_heating", "stage": "actuator", "needs": "an oil temperature that changes by 20 K"}
    answer = {
        "nominal": [{**row, "parameter": "linkage.vigv_play", "table": 1.6, "tolerance": 0.3}],
        "sizes": [{**row, "effect": "pot_bias", "parameter": "vigv", "probability": draw.random(), "neutral": 0.0}],
        "not_observable": [blind], "stages": [], "duration_s": 60.0,
    }  # fmt: skip
    return {"verdict": "missing", "answer": answer}


def read_cold(path: str, options: dict[str, Any], run: str) -> dict[str, Any]:
    """As `read`, once compiled; its ``options`` say what compiling comes to."""
    return read(path, options, run)


def _warm_up(options: dict[str, Any], run: str) -> None:
    if options["compiling"] == "hangs":
        time.sleep(3600.0)
    begun = Path(run) / "begun"
    with open(begun, "a", encoding="utf-8") as f:
        f.write("x")
    if len(begun.read_text(encoding="utf-8")) <= options["compiling"]:
        os.kill(os.getpid(), signal.SIGKILL)


read_cold.warm_up = _warm_up  # type: ignore[attr-defined]


class Cold(Options):
    """What compiling comes to."""

    compiling: str | int


KINDS["read"] = Kind((__name__, "read"), Options)
KINDS["diagnosed"] = Kind((__name__, "diagnosed"), Options)
KINDS["read_cold"] = Kind((__name__, "read_cold"), Cold)
reader.SERVE = f"import {__name__}; {reader.SERVE}"
rent.HIRED = f"import {__name__}; {rent.HIRED}"
