"""``python -m benchmarks.fleet_demo``: a fleet of simulated engines whose truth is known, two years of logs by the
independent rig (tests/rig).
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from benchmarks import start
from tests import rig
from tests.firmware_on_rig import firmware
from tests.rig import parameters
from vaneloop.base import terminal
from vaneloop.base.errors import InputError
from vaneloop.base.files import whole, write
from vaneloop.cli.fleet import unusable

__all__ = ["DESCRIPTION", "YEAR", "YEARS", "add_options", "command", "fate", "make", "size_at"]

DESCRIPTION = """Logs of a simulated fleet whose truth is known, to try `vaneloop fleet` with. The independent rig
simulates two years of each engine; truth.json says what befell it. One is badly rigged, one has a sensor exchanged, a
quarter of the others wears, a fifth has a drifting null. What is in the folder already stays.

examples:
  python -m benchmarks.fleet_demo --engines 4 --logs 20 --duration 60 --out out/fleet_logs

exit codes: 0 done, 2 bad input"""

BEGIN = datetime(2026, 1, 1, tzinfo=UTC)
YEARS = 2.0
YEAR = timedelta(days=365.25)
# what befalls an engine -> the effect, its size at the end of the two years (gross in the rig's ladder), how it comes
FATES = {
    "wear": ("linkage_backlash", 0.012, "growth"),  # rad at the vane
    "null drift": ("valve_null_bias", 1.5e-3, "growth"),  # A
    "badly rigged": ("link_length_error", 1e-3, "always"),  # m
    "sensor exchanged": ("pot_bias", 0.02, "step"),  # rad
}


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--out", required=True, metavar="DIR", help="folder of the logs; what is there stays")
    parser.add_argument("--engines", type=int, default=40, metavar="N", help="number of engines (default 40)")
    parser.add_argument("--logs", type=int, default=2000, metavar="N", help="logs of all together (default 2000)")
    parser.add_argument("--duration", type=float, default=60.0, metavar="S", help="length of a log (default 60 s)")
    parser.add_argument("--seed", type=int, default=1, metavar="S", help="seed of the draw (default 1)")
    parser.add_argument("--workers", type=int, default=2, metavar="N", help="logs simulated side by side (default 2)")
    terminal.add_output_options(parser)


def fate(seed: int, engine: int, engines: int) -> dict[str, Any]:
    """What befalls an engine: one is badly rigged, one has a sensor exchanged, of the others a quarter wears and a
    fifth has a drifting null; the rest is healthy. Onsets are in the first 70 % of the time.
    """
    rng = np.random.default_rng([seed, engine])
    others = max(engines - 2, 1)
    if engine == 0:
        kind = "badly rigged"
    elif engine == 1:
        kind = "sensor exchanged"
    else:
        place = (engine - 1.5) / others
        kind = "wear" if place < 0.25 else "null drift" if place < 0.45 else "healthy"
    out: dict[str, Any] = {"engine": f"engine_{engine:03d}", "fate": kind, "specimen": int(rng.integers(1, 2**31))}
    if kind != "healthy":
        effect, size, comes = FATES[kind]
        onset = 0.0 if comes == "always" else float(rng.uniform(0.1, 0.7) * YEARS)
        sign = 1.0 if effect == "linkage_backlash" else float(rng.choice([-1.0, 1.0]))
        out |= {"effect": effect, "onset_years": onset, "comes": comes, "stage": int(rng.integers(0, 3))}
        out |= {"size": sign * size * float(rng.uniform(0.8, 1.2))}
    return out


def size_at(truth: dict[str, Any], years: float) -> float:
    """Size of an engine's effect so many years after the beginning."""
    since = years - float(truth["onset_years"])
    if since < 0.0:
        return 0.0
    share = since / (YEARS - float(truth["onset_years"])) if truth["comes"] == "growth" else 1.0
    return float(truth["size"]) * share


def _one(folder: str, seed: int, engines: int, each: int, duration: float, number: int) -> None:
    """Simulate one log of one engine, and write it where its engine and date are said by the path."""
    engine, k = divmod(number, each)
    truth = fate(seed, engine, engines)
    machine = np.random.default_rng(truth["specimen"])
    geometry = rig.load_geometry(rng=machine)
    specimen = parameters.specimen(rig.machine(geometry), machine)
    rng = np.random.default_rng([seed, engine, k + 1])
    years = YEARS * (k + float(rng.uniform(0.1, 0.9))) / each
    path = Path(folder) / truth["engine"] / f"{BEGIN + years * YEAR:%Y-%m-%dT%H%M}_{k:05d}.parquet"
    if path.exists():
        return
    hidden = []
    if truth["fate"] != "healthy" and (size := size_at(truth, years)) != 0.0:
        effect = rig.CATALOGUE[truth["effect"]]
        stage = {"stage": float(truth["stage"])} if effect.stages else {}
        hidden = [rig.Hidden(truth["effect"], {effect.main: size, **effect.others, **stage})]
    draw = int(rng.integers(1, 2**31))
    run = rig.simulate(
        rig.manoeuvre(draw, duration), firmware(), hidden, seed=draw, rate=100, parameters=specimen,
        geometry=geometry,
    )  # fmt: skip
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole(path) as part:
        pq.write_table(pa.table(run.log), part)


def make(
    folder: Path, engines: int, logs: int, duration: float, seed: int, workers: int, progress: Callable[[float], None]
) -> Path:
    """Write ``logs`` logs of ``engines`` engines, and the truth beside them; what is there already stays. Return the
    file of the truth.
    """
    each = -(-logs // engines)
    folder.mkdir(parents=True, exist_ok=True)
    truth = {"seed": seed, "begin": BEGIN.isoformat(), "engines": [fate(seed, e, engines) for e in range(engines)]}
    write(folder / "truth.json", json.dumps(truth, indent=2) + "\n")
    one = partial(_one, str(folder), seed, engines, each, duration)
    with ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn")) as pool:
        jobs = [pool.submit(one, n) for n in range(engines * each)]
        for done, job in enumerate(as_completed(jobs), 1):
            job.result()
            progress(done / len(jobs))
    return folder / "truth.json"


def command(args: argparse.Namespace) -> int:
    """Run from parsed options; return the exit code."""
    if not 4 <= args.logs <= 100_000:
        raise InputError(f"--logs (={args.logs}) must be in [4, 100000]")
    if not 4 <= args.engines <= args.logs:
        raise InputError(f"--engines (={args.engines}) must be in [4, {args.logs}], no more than --logs")
    if not 1 <= args.workers <= 64:
        raise InputError(f"--workers (={args.workers}) must be in [1, 64]")
    if not 30.0 <= args.duration <= 1e5:
        raise InputError(f"--duration (={args.duration:g} s) must be in [30, 1e5]")
    with unusable(), terminal.progress_bar(args, "simulating the fleet") as progress:
        truth = make(Path(args.out), args.engines, args.logs, args.duration, args.seed, args.workers,
                     progress or (lambda fraction: None))  # fmt: skip
    terminal.say(args, f"truth: {truth}; next: vaneloop fleet run {args.out} --out RUN")
    terminal.write_json(args, {"schema": 1, "truth": str(truth)})
    return 0


if __name__ == "__main__":
    start.run("benchmarks.fleet_demo")
