"""``python -m benchmarks.two_actuators``: the blind benchmark of the machine with two actuators. A fault of one side,
or of the linkage that both drive, is hidden; the diagnosis sees the log only, and every answer is counted.

The loop of the product itself simulates: the reference simulator (`tests.rig`) has one actuator. What is counted is so
whether side and part are told, not whether the equations are nature's.
"""

from __future__ import annotations

import argparse
import json
import secrets
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import start
from benchmarks.blind import add_result_options, check_run, detected, print_shares, read_rows, run, share
from hil.logs import Channel, Log
from hil.loop.lockstep import Stimulus, lockstep, warm_up
from plant import Model, build_plant
from plant.model import SIDE_NAMES, Side
from vaneloop.base import terminal
from vaneloop.base.errors import InputError
from vaneloop.identification.vane_chain.chain import Chain
from vaneloop.verbs.machine import Machine
from vaneloop.verbs.search import diagnosed

__all__ = ["DESCRIPTION", "HIDDEN", "add_options", "command", "draw_case", "judge_case", "outcome", "summary"]

DESCRIPTION = """Hide a fault in a machine with two actuators, simulate a log, diagnose it, count the answers.

Each machine has sides that differ by up to 1 % in flow gain, bandwidth and damping, and a known load of the air.

examples:
  python -m benchmarks.two_actuators --logs 40 --out out/two_actuators.parquet
  python -m benchmarks.two_actuators --logs 80 --seed 12345 --out out/two_actuators.parquet  (continues)

exit codes: 0 done, 2 bad input. The figures are for reading; no threshold decides."""

TABLE = "plant_two_actuators.toml"
LOAD = {"aero_load": {"force": 4000.0}}  # N, known to the search: without a load no leakage shows
UNEQUAL = 0.01  # by which the sides differ at most
STIFFNESS = "actuators.ring_stiffness"
CLEAN = "clean"
# what is hidden: its parameter, its unit, smallest and largest size, drawn evenly in the logarithm; a sign by chance
# where it has one, about the neutral value
HIDDEN: dict[str, tuple[str, str, float, float, bool, float]] = {
    "lvdt_bias": ("bias", "mm", 0.1, 1.5, True, 0.0),
    "lvdt_gain": ("factor", "-", 0.005, 0.04, True, 1.0),
    "lvdt_thermal_drift": ("coefficient", "mm/K", 0.004, 0.04, True, 0.0),
    "piston_friction": ("force", "N", 200.0, 2500.0, False, 0.0),
    "internal_leakage": ("coefficient", "mm/s/MPa", 0.5, 10.0, False, 0.0),
    "oil_compressibility": ("compliance", "mm/kN", 0.01, 0.3, False, 0.0),
    "rigging_offset": ("length", "mm", 0.1, 1.5, True, 0.0),
    "ring_stiffness": ("ratio", "-", 0.1, 0.6, False, 0.0),  # as it stays
    "linkage_backlash": ("vigv", "deg", 0.1, 0.8, False, 0.0),
    "link_length_error": ("vigv", "mm", 0.5, 3.0, True, 0.0),
    STIFFNESS: ("", "of nominal", 0.25, 0.6, True, 1.0),
}
OF_BOTH = ("linkage_backlash", "link_length_error", STIFFNESS)  # these have no side
KINDS = (CLEAN, *HIDDEN)
ANSWERS = ("named", "among rivals", "its side, another part", "wrong", "unknown", "nothing")


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--logs", type=int, default=40, metavar="N", help="number of logs (default 40)")
    parser.add_argument("--seed", type=int, metavar="S", help="seed of the draw (default: fresh, and printed)")
    parser.add_argument("--duration", type=float, default=120.0, metavar="S", help="length of each log (default 120 s)")
    add_result_options(parser, "logs", "log", "out/two_actuators.parquet")


def draw_case(seed: int, index: int, duration: float = 120.0) -> dict[str, Any]:
    """Draw what is hidden in log ``index`` of the series ``seed``: kinds follow one another, sides take turns.

    Returns its name as an answer has it, kind, size, the `plant.Model` of the machine, and the speed demand (%).
    """
    rng = np.random.default_rng([seed, index])
    kind, turn = KINDS[index % len(KINDS)], index // len(KINDS) % 2
    nominal = {n.name: n.value for n in build_plant(TABLE).nominal}
    own = [
        {name: nominal[name] * float(1.0 + rng.uniform(-UNEQUAL, UNEQUAL)) for name in (
            "actuator.flow_gain", "valve.bandwidth", "valve.damping")}
        for _ in SIDE_NAMES
    ]  # fmt: skip
    sides, both, parameters, size, truth = [{}, {}], dict(LOAD), dict[str, float](), 0.0, ""
    if kind != CLEAN:
        key, _, low, high, signed, neutral = HIDDEN[kind]
        size = float(np.exp(rng.uniform(np.log(low), np.log(high)))) * (rng.choice([-1.0, 1.0]) if signed else 1.0)
        truth = kind if kind in OF_BOTH else f"{SIDE_NAMES[turn]}.{kind}"
        if kind == STIFFNESS:
            parameters[kind] = nominal[kind] * (1.0 + size)
        elif kind in OF_BOTH:
            both[kind] = {key: neutral + size}
        else:
            sides[turn] = {kind: {key: neutral + size}}
    a, b = (Side(parameters=p, effects=e) for p, e in zip(own, sides, strict=True))
    model = Model(parameters=parameters, effects=both, side_a=a, side_b=b)
    return {
        "index": index, "kind": kind, "truth": truth, "size": size, "model": model,
        "demand": _demand(rng, duration), "noise": int(rng.integers(1, 2**31)),
    }  # fmt: skip


def _demand(rng: np.random.Generator, duration: float) -> np.ndarray:
    """Ramps between speeds drawn from 50 to 99 %, each with a dwell, float64[samples of 10 ms], %."""
    points = [(0.0, 60.0), (2.0, 60.0)]
    while points[-1][0] < duration:
        at, last = points[-1]
        to = float(rng.uniform(50.0, 99.0))
        there = at + max(abs(to - last) / float(rng.uniform(3.0, 30.0)), 0.3)
        points += [(there, to), (there + float(rng.uniform(0.5, 3.0)), to)]
    return np.interp(np.arange(0.0, duration, 0.01), *np.array(points).T)


def _clean(case: dict[str, Any]) -> Model:
    """The machine of a case with nothing hidden: its sides still differ within their tolerances."""
    a, b = (Side(parameters=case["model"].sides[side].parameters) for side in SIDE_NAMES)
    return Model(effects=dict(LOAD), side_a=a, side_b=b)


def _logged(case: dict[str, Any], model: Model) -> Chain:
    """A log of a case's run by the machine ``model``, in the stages that the search takes."""
    demand = case["demand"]
    warm = 40.0 + 30.0 * (1.0 - np.exp(-np.arange(len(demand)) * 1e-2 / 60.0))  # oil warms up in any run
    plant = model.plant(build_plant(TABLE))
    done = lockstep(Stimulus.of(demand, t_oil=warm), plant=plant, seed=case["noise"], hashed=False)
    columns = {k: Channel(done.t, v) for k, v in done.columns.items() if k not in ("t", "n_engine")}
    return Machine(table=TABLE, model=Model(effects=LOAD)).bind(Log(f"log {case['index']}", columns))


def judge_case(seed: int, index: int, duration: float) -> dict[str, Any]:
    """Simulate and diagnose log ``index``; return its row."""
    case = draw_case(seed, index, duration)
    chain = _logged(case, case["model"])
    began = time.perf_counter()
    answer = diagnosed(chain, f"log {index}", 1).to_dict()
    elapsed = time.perf_counter() - began
    rivals = {e["effect"]: e["rivals"] for e in answer["effects"]}  # type: ignore[attr-defined, index]
    moved = [q["parameter"] for q in answer["recalibrated"] if q["at_limit"]]  # type: ignore[attr-defined, index]
    row = {
        "seed": seed, "index": index, "kind": case["kind"], "truth": case["truth"], "size": case["size"],
        "verdict": answer["verdict"], "named": list(rivals), "rivals": json.dumps(rivals), "at_limit": moved,
        "elapsed_s": elapsed, "detectable": case["kind"] != CLEAN and detected(chain, _logged(case, _clean(case))),
    }  # fmt: skip
    return row | {"outcome": outcome(row)}


def outcome(row: dict[str, Any]) -> str:
    """What an answer is worth, one of `ANSWERS`. No effect of the library is a wrong stiffness of the rings: names are
    wrong there, and what is moved to the end of its tolerance is counted apart (`summary`).
    """
    truth, named, rivals = row["truth"], row["named"], json.loads(row["rivals"])
    if named == [truth] and not rivals[truth]:
        return "named"
    if any(truth in (n, *rivals[n]) for n in named):
        return "among rivals"
    if named:
        side = truth.partition(".")[0]
        return "its side, another part" if side in SIDE_NAMES and all(n.startswith(side) for n in named) else "wrong"
    return "nothing" if row["verdict"] == "none" else "unknown"


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Shares with 90 % binomial (Wilson) intervals."""
    hidden = [r for r in rows if r["kind"] not in (CLEAN, STIFFNESS)]
    seen = [r for r in hidden if r["detectable"]]
    sided = [r for r in hidden if r["kind"] not in OF_BOTH]
    said = [r for r in rows if r["named"]]
    return {
        "hidden: named or among rivals": share([r["outcome"] in ANSWERS[:2] for r in hidden]),
        "detectable: named or among rivals": share([r["outcome"] in ANSWERS[:2] for r in seen]),
        "detectable: alone or first of its rivals": share([r["named"] == [r["truth"]] for r in seen]),
        "of one side: named or among rivals": share([r["outcome"] in ANSWERS[:2] for r in sided]),
        "of one side: named alone": share([r["outcome"] == "named" for r in sided]),
        "stiffness of the rings off: at the end of its tolerance": share(
            [STIFFNESS in r["at_limit"] for r in rows if r["kind"] == STIFFNESS]
        ),
        "stiffness of the rings right: at the end of its tolerance": share(
            [STIFFNESS in r["at_limit"] for r in rows if r["kind"] != STIFFNESS]
        ),
        "where effects are named: wrong": share([r["outcome"] in ANSWERS[2:4] for r in said]),
        "clean logs with an effect named": share([bool(r["named"]) for r in rows if r["kind"] == CLEAN]),
        "clean logs with a false alarm": share([r["verdict"] != "none" for r in rows if r["kind"] == CLEAN]),
        "median seconds": float(np.median([r["elapsed_s"] for r in rows])) if rows else None,
    }


def command(args: argparse.Namespace) -> int:
    """Run from parsed options; return the exit code."""
    check_run(args, "logs")
    if not 30.0 <= args.duration <= 3600.0:
        raise InputError(f"--duration (={args.duration:g} s) must be in [30, 3600]")
    path = Path(args.out)
    rows = read_rows(path, "two_actuators") if path.exists() else []
    seed = args.seed if args.seed is not None else (rows[0]["seed"] if rows else secrets.randbelow(2**31))
    rows = [r for r in rows if r["seed"] == seed and "detectable" in r]  # others are of an older version
    terminal.say(args, f"seed {seed}; {len(rows)} logs done before")
    path.parent.mkdir(parents=True, exist_ok=True)
    warm_up(lambda text: terminal.say(args, text))
    run(args, "logs", args.logs, rows, path, judge_case, seed, args.duration)
    s = summary(rows)
    print_shares(args, f"{len(rows)} logs, {s['median seconds']:.1f} s a diagnosis", s)
    count = Counter((r["kind"], r["outcome"]) for r in rows)
    table = [[kind, *(str(count[kind, said]) for said in ANSWERS)] for kind in KINDS]
    terminal.print_table(args, "what was hidden, what was said", ["hidden", *ANSWERS], table)
    missed = [
        f"#{r['index']} {r['truth'] or CLEAN} {r['size']:.4g}: {r['verdict']} {r['named']} {r['rivals']}"
        for r in rows if r["outcome"] != ("nothing" if r["kind"] in (CLEAN, STIFFNESS) else "named")
    ]  # fmt: skip
    for line in missed:
        terminal.say(args, line)
    terminal.write_json(args, {"schema": 1, "seed": seed, "summary": s, "said": table, "misses": missed})
    return 0


if __name__ == "__main__":
    start.run("benchmarks.two_actuators")
