"""The measurements behind ``python -m benchmarks``: each gives rows of what, ours, peer, ratio, target.

This machine may be busy and its clock may change: opponents run in turn, and the fastest run of each counts (the median
where whole processes are started). Loops are timed in processor time, processes on the wall clock.
"""

from __future__ import annotations

import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Protocol

import numpy as np

from benchmarks.ours import COLUMNS, OurLanes, OurLoop, Setup, profile
from hil.loop.lockstep import Stimulus, lockstep

__all__ = ["MEASUREMENTS", "Row", "machine"]

ROOT = Path(__file__).resolve().parent.parent
LONG = 300.0  # s simulated where only compiled loops run
LANES_LONG = 60.0  # s, of each loop side by side: 64 of them are over an hour
ROUNDS = 15
REPLAYED = 3000.0  # s
# largest difference to a peer that integrates the same equations with another method: one count of the LVDT is 0.00076
# mm
TOLERANCE = {
    "n_engine": 0.005,
    "x_dem": 2e-6,
    "x_lvdt": 2e-6,
    **dict.fromkeys(("vigv", "vgv1", "vgv2"), np.deg2rad(2e-3)),
}  # %, m, rad


@dataclass(frozen=True)
class Row:
    """One line of the table. ``ratio`` is what the ``target`` is about; ``held`` None = no target, for information."""

    what: str
    ours: str
    peer: str = ""
    ratio: float | None = None
    target: str = ""
    held: bool | None = None
    note: str = ""


def machine() -> dict[str, str]:
    """Return what the figures depend on."""
    cpu = "unknown"
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        cpu = next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        pass
    found = {
        "cpu": f"{cpu}, {os.cpu_count()} cores",
        "system": platform.platform(),
        "python": platform.python_version(),
    }
    for package in ("numpy", "numba", "control", "pathsim"):
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            found[package] = "not installed"
    try:
        found["gcc"] = subprocess.run(
            ["gcc", "-dumpfullversion"], capture_output=True, text=True, check=True
        ).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        found["gcc"] = "not installed"
    found["load"] = f"{os.getloadavg()[0]:.1f}"
    return found


class Loop(Protocol):
    """A loop that is ready at t = 0."""

    def advance(self, out: np.ndarray) -> None:
        """Run the whole stimulus."""


def cpu_time(loop: Loop, out: np.ndarray) -> float:
    """Processor time of one run, s, without what comes before t = 0."""
    started = time.process_time()
    loop.advance(out)
    return time.process_time() - started


def _speed(simulated: float, seconds: float) -> str:
    rate = simulated / seconds
    return f"{rate:,.0f} s/s" if rate >= 100 else f"{rate:.2g} s/s"


def _rows(setup: Setup) -> np.ndarray:
    return np.zeros((-(-setup.ticks // setup.every), len(COLUMNS)))


# ---- compiled loops --------------------------------------------------------------------------------------------------


def against_c() -> Iterator[Row]:
    """The loop against the same loop in C."""
    from benchmarks.in_c import BITWISE, FAST, CLoop

    setup = Setup(Stimulus.of(profile(LONG)))
    out, c_out = _rows(setup), _rows(setup)
    best = dict.fromkeys(("ours", "fast", "bitwise"), float("inf"))
    for _ in range(ROUNDS):
        best["ours"] = min(best["ours"], cpu_time(OurLoop(setup), out))
        best["fast"] = min(best["fast"], cpu_time(CLoop(setup, FAST), c_out))
        best["bitwise"] = min(best["bitwise"], cpu_time(CLoop(setup, BITWISE), c_out))
    same = bool((out.view(np.int64) == c_out.view(np.int64)).all())
    ours = _speed(LONG, best["ours"])
    ratio = best["ours"] / best["fast"]
    yield Row("loop, C -O3 -march=native", ours, _speed(LONG, best["fast"]), ratio, "<= 1.3", ratio <= 1.3)
    bits = "every logged signal the same bits" if same else "THE SIGNALS DIFFER"
    yield Row(
        "same, -ffp-contract=off",
        ours,
        _speed(LONG, best["bitwise"]),
        best["ours"] / best["bitwise"],
        "same bits",
        same,
        bits,
    )
    for hashed, what, note in (
        (False, "hil.loop.lockstep, no hash", "wall clock"),
        (
            True,
            "hil.loop.lockstep, every tick hashed",
            "wall clock; the hash takes as long as the loop, beside it where a core is free",
        ),
    ):
        wall = min(lockstep(setup.stimulus, hashed=hashed).wall_s for _ in range(5))
        yield Row(what, _speed(LONG, wall), note=note)


def in_lanes() -> Iterator[Row]:
    """Many loops side by side on one core, against as many one after the other in C, and in the loop alone."""
    from benchmarks.in_c import FAST, CLoop

    setup = Setup(Stimulus.of(profile(LANES_LONG)))
    out, c_out = _rows(setup), _rows(setup)
    for count, least in ((64, 6.0), (8, None)):
        lanes_out = OurLanes(setup, count).lanes.room(setup.ticks)
        best = dict.fromkeys(("lanes", "alone", "c"), float("inf"))
        for _ in range(ROUNDS):
            best["lanes"] = min(best["lanes"], cpu_time(OurLanes(setup, count), lanes_out) / count)
            best["c"] = min(best["c"], cpu_time(CLoop(setup, FAST), c_out))
            best["alone"] = min(best["alone"], cpu_time(OurLoop(setup), out))
        ratio, to_alone = best["c"] / best["lanes"], best["alone"] / best["lanes"]
        yield Row(
            f"{count} loops in lanes, C -O3 -march=native",
            _speed(LANES_LONG, best["lanes"]),
            _speed(LANES_LONG, best["c"]),
            ratio,
            "" if least is None else f">= {least:g}",
            None if least is None else ratio >= least,
            f"one core; {to_alone:.1f} times the loop alone",
        )


def interpreted() -> Iterator[Row]:
    """The same source without compilation, and whether it gives the same bits."""
    code = (
        "from benchmarks.ours import profile; from hil.loop.lockstep import Stimulus, lockstep;"
        "r = lockstep(Stimulus.of(profile(2.5)[200:]), seed=1, duration=0.5); print(r.wall_s, r.state_hash)"
    )
    answers = []
    for disabled in ("0", "1"):
        env = {**os.environ, "NUMBA_DISABLE_JIT": disabled}
        answers.append(_wall([sys.executable, "-c", code], env)[1].split())
    same = answers[0][1] == answers[1][1]
    speed = _speed(0.5, float(answers[1][0]))
    yield Row(
        "loop without compilation", speed, target="same hash", held=same, note="NUMBA_DISABLE_JIT=1, 500 noisy ticks"
    )


# ---- other simulators ------------------------------------------------------------------------------------------------


Peer = Callable[[Setup], np.ndarray]


def _against(name: str, run: Peer, signals: tuple[str, ...], seconds: float, least: float | None, repeat: int) -> Row:
    """Time a peer on a rise and a fall, check that it simulates the same system, and compare with the product on the
    very same run.
    """
    half = int(seconds * 50)
    ramp = np.linspace(60.0, 60.0 + 3.0 * seconds, half)
    setup = Setup(Stimulus.of(np.concatenate([ramp, ramp[::-1]])))
    out = _rows(setup)
    ours = min(cpu_time(OurLoop(setup), out) for _ in range(ROUNDS))
    run(Setup(Stimulus.of(ramp[:10])))  # its first call imports and compiles
    theirs, best = np.empty(0), float("inf")
    for _ in range(repeat):
        started = time.process_time()
        theirs = run(setup)
        best = min(best, time.process_time() - started)
    n = min(len(theirs), len(out))
    errors = {s: float(np.abs(theirs[:n, i] - out[:n, COLUMNS.index(s)]).max()) for i, s in enumerate(signals)}
    outside = [s for s in signals if not errors[s] <= TOLERANCE[s]]
    ratio = best / ours
    vane = np.rad2deg(max(errors[s] for s in ("vigv", "vgv1", "vgv2")))
    note = f"within {errors['x_lvdt'] * 1e3:.2g} mm, {vane:.2g} deg of ours over {2 * half / 100:g} s"
    if outside:
        note = f"NOT THE SAME SYSTEM: {', '.join(outside)} outside the tolerance; {note}"
    held = None if least is None else bool(ratio >= least and not outside)
    return Row(
        name,
        _speed(half / 50, ours),
        _speed(half / 50, best),
        ratio,
        "" if least is None else f">= {least:,.0f}",
        held,
        note,
    )


def against_control() -> Iterator[Row]:
    """The loop in python-control."""
    from benchmarks import in_control

    yield _against("loop in python-control", in_control.run, in_control.SIGNALS, 6.0, 200.0, 5)


def against_pathsim() -> Iterator[Row]:
    """The loop in pathsim, at the product's plant step and at one ten times as long."""
    from benchmarks import in_pathsim

    for name, step, solver, least in (
        ("loop in pathsim, plant step 0.1 ms as ours", 1e-4, "EUF", 1000.0),
        ("same, its default solver", 1e-4, "SSPRK22", 1000.0),
        ("same, plant step 1 ms", 1e-3, "SSPRK22", None),
    ):
        yield _against(name, partial(in_pathsim.run, step=step, solver=solver), in_pathsim.SIGNALS, 4.0, least, 3)


# ---- commands --------------------------------------------------------------------------------------------------------


def _vaneloop() -> list[str]:
    script = Path(sys.executable).with_name("vaneloop")
    return [str(script)] if script.exists() else [sys.executable, "-m", "vaneloop.cli.main"]


def _wall(command: list[str], env: dict[str, str] | None = None) -> tuple[float, str]:
    started = time.perf_counter()
    done = subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True, check=False)
    wall = time.perf_counter() - started
    if done.returncode not in (0, 1):
        raise RuntimeError(f"{' '.join(command)}: {done.stderr.strip()[-200:]}")
    return wall, done.stdout + done.stderr


def command_start() -> Iterator[Row]:
    """``vaneloop --help`` against an interpreter that does nothing."""
    bare, help_ = [], []
    for _ in range(41):
        bare.append(_wall([sys.executable, "-c", "pass"])[0])
        help_.append(_wall([*_vaneloop(), "--help"])[0])
    a, b = statistics.median(help_[1:]), statistics.median(bare[1:])
    yield Row("vaneloop --help, python -c pass", f"{a * 1e3:.0f} ms", f"{b * 1e3:.0f} ms", a / b, "<= 5", a / b <= 5.0)


def _write_run(path: Path, seconds: float) -> None:
    from hil.logs import Channel, write_log
    from vaneloop.base.signals import UNITS

    run = lockstep(Stimulus.of(profile(seconds)), seed=1, hashed=False)
    write_log(path, {name: Channel(run.t, v) for name, v in run.columns.items() if name in UNITS})


def first_run() -> Iterator[Row]:
    """The first replay and the first diagnosis on a new machine: with what `make` compiles ahead, and without."""
    root = Path(__file__).resolve().parent.parent
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder, "short.csv")
        _write_run(log, 2.0)
        for ahead in (True, False):
            more = {} if ahead else {"VANELOOP_AHEAD": str(Path(folder, "none"))}
            for words in (["replay", str(log)], ["diagnose", str(root / "examples" / "hidden_effect.parquet")]):
                cache = Path(folder, f"cache_{ahead}_{words[0]}")
                before = os.times()
                wall, said = _wall([*_vaneloop(), *words], {**os.environ, **more, "NUMBA_CACHE_DIR": str(cache)})
                after = os.times()
                busy = after.children_user + after.children_system - before.children_user - before.children_system
                compiled, told = any(cache.rglob("*.nbc")), "compiling" in said
                note = f"{wall:.1f} s wall clock; {'compiles' if compiled else 'compiles nothing'}"
                note += "" if told == compiled else ", SAYS OTHERWISE"
                yield Row(
                    f"first {words[0]}, {'compiled ahead' if ahead else 'nothing compiled yet'}",
                    f"{busy:.1f} s of processor time",
                    target="< 6 s" if ahead else "told",
                    held=busy < 6.0 and not compiled if ahead else told,
                    note=note,
                )


def long_replay() -> Iterator[Row]:
    """A whole ``vaneloop replay`` of a long log, start to end."""
    with tempfile.TemporaryDirectory() as folder:
        for suffix, what in (("parquet", "Parquet"), ("log", "candump")):
            log, answer = Path(folder, f"long.{suffix}"), Path(folder, "answer.json")
            _write_run(log, REPLAYED)
            wall = min(_wall([*_vaneloop(), "replay", str(log), "--json", str(answer)])[0] for _ in range(2))
            result = json.loads(answer.read_text(encoding="utf-8"))
            note = (
                f"{result['simulated_s']:,.0f} s, {log.stat().st_size / 2**20:.0f} MiB; the loop itself "
                f"{result['wall_s']:.1f} s"
            )
            yield Row(f"vaneloop replay of a long {what} log", f"{wall:.1f} s", note=note)


def against_least_squares() -> Iterator[Row]:
    """The search of a stage against scipy's least squares, one fit after the other, on the example log."""
    from benchmarks.in_scipy import in_scipy, ours
    from hil.logs import read_log
    from vaneloop.identification.vane_chain.chain import build_chain
    from vaneloop.identification.workflow import diagnose

    chain = build_chain(read_log(ROOT / "examples" / "hidden_effect.parquet", require=()))
    stage = chain.stage("actuator")
    ours(stage)  # compiled
    mine, busy, jobs, (_, reached) = ours(stage)
    theirs, theirs_busy, fits, (_, least) = in_scipy(stage, jobs)
    mine = min(mine, ours(stage)[0])  # after the peer, too: the load may have changed
    note = (
        f"{fits} fits; lowest cost {reached:,.0f} and {least:,.0f}; processor time {busy:.1f} and {theirs_busy:.1f} s"
    )
    note += f"; load of the machine {os.getloadavg()[0]:.1f}"
    yield Row(
        "search of the actuator, scipy",
        f"{mine:.1f} s",
        f"{theirs:.1f} s",
        theirs / mine,
        "at least 12",
        theirs / mine >= 12.0,
        note,
    )
    took = diagnose(chain.stages).elapsed_s
    yield Row("diagnose, 200 s, two effects", f"{took:.1f} s", note="two processes")


def strategies() -> Iterator[Row]:
    """``vaneloop strategies``: the best strategy against dual, on the machine with everything wrong."""
    with tempfile.TemporaryDirectory() as folder:
        answer = Path(folder, "answer.json")
        wall, _ = _wall([*_vaneloop(), "strategies", "--json", str(answer)])
        j = json.loads(answer.read_text(encoding="utf-8"))
    last = j["rows"][-1]["scenario"]
    dual, best = (
        next(r for r in j["rows"] if r["scenario"] == last and r["strategy"] == s) for s in ("dual", j["best"])
    )
    a, b = best["vigv"]["mean_abs"], dual["vigv"]["mean_abs"]
    yield Row(
        f"VIGV error, {j['best']} and dual, {last}", f"{a:.3f} deg", f"{b:.3f} deg", b / a, "at least 3", b / a >= 3.0
    )
    a, b = best["travel_mm"], dual["travel_mm"]
    yield Row("travel of the actuator, the same", f"{a:,.0f} mm", f"{b:,.0f} mm", a / b, "<= 1.15", a / b <= 1.15)
    step = max(f["step"] for f in j["failures"])
    yield Row("largest step, potentiometers failing", f"{step:.3f} deg", target="<= 0.2 deg", held=step <= 0.2)
    held = sum(g["held"] for g in j["goals"])
    note = f"{len(j['rows']) + len(j['failures'])} runs of {j['simulated_s']:,.0f} s"
    yield Row(
        "goals of vaneloop strategies",
        f"{held} of {len(j['goals'])}",
        target="all",
        held=held == len(j["goals"]),
        note=note,
    )
    yield Row("vaneloop strategies", f"{wall:.0f} s", note="wall clock")


# ---- real time -------------------------------------------------------------------------------------------------------


def real_time() -> Iterator[Row]:
    """Lateness of the whole tick with CAN against a C loop that only sleeps."""
    from benchmarks.realtime import compare, conditions, total

    for name, priority, loaded in conditions():
        try:
            turns = compare(priority, loaded)
        except PermissionError:
            yield Row(f"tick with CAN late, {name}", "not measured", note="this user may not use SCHED_FIFO")
            continue
        c, begin, end = total(turns.c), total(turns.begin), total(turns.end)
        a, b, e = begin.figures(), c.figures(), end.figures()
        ratio = a["p99_us"] / b["p99_us"]
        note = (
            f"p50 {a['p50_us']:.1f}, p99.9 {a['p999_us']:.0f}, max {a['max_us']:.0f} us; C {b['p50_us']:.1f}, "
            f"{b['p999_us']:.0f}, "
        )
        note += f"{b['max_us']:.0f} us; load of the machine {os.getloadavg()[0]:.1f}; {turns.received:,} frames came"
        yield Row(
            f"tick with CAN late, p99, {name}",
            f"{a['p99_us']:.1f} us",
            f"{b['p99_us']:.1f} us",
            ratio,
            "<= 2",
            ratio <= 2.0,
            note,
        )
        ours, theirs, surely = turns.late_more(500.0)
        note = f"{ours} of {begin.count:,} ticks; C {theirs} of {c.count:,}"
        held = True if ours <= 2 * theirs else False if surely > 2.0 else None
        if held is None:
            note += f"; undecided: other programs come in bursts, and only a ratio of {surely:.2f} is sure to 95 %"
        share = ours / theirs if theirs else None
        yield Row(
            "  later than 500 us",
            f"{100 * ours / begin.count:.3f} %",
            f"{100 * theirs / c.count:.3f} %",
            share,
            "<= 2",
            held,
            note,
        )
        note = f"p50 {e['p50_us']:.1f} us: wait, receive, tick, send; C has done nothing by then"
        ratio = e["p99_us"] / b["p99_us"]
        yield Row(
            "  its frames sent, after the deadline, p99",
            f"{e['p99_us']:.1f} us",
            f"{b['p99_us']:.1f} us",
            ratio,
            note=note,
        )


MEASUREMENTS: dict[str, Callable[[], Iterator[Row]]] = {
    "the loop in C": against_c,
    "the loop in lanes": in_lanes,
    "the loop in python-control": against_control,
    "the loop in pathsim": against_pathsim,
    "the interpreted loop": interpreted,
    "start of the command": command_start,
    "first run": first_run,
    "replay of a long log": long_replay,
    "real time": real_time,
    "the search for effects": against_least_squares,
    "the control strategies": strategies,
}
