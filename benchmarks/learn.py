"""What it takes to learn a law that nobody listed, and what curves side by side save of it.

python -m benchmarks learn    # some minutes
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

import numpy as np

from benchmarks.measure import ROOT, Row

__all__ = ["MEASUREMENTS"]

LIMIT = 60.0  # s of wall clock on two cores: 300 s at 100 Hz, or 4,000 samples
SECONDS, SEED, OFTEN = 300, 23, 5
HIDDEN = {  # effects that the library does not have, of each stage
    "schedule_bent": {"amplitude": 1.3e-3},
    "acceleration_by_speed": {"slope": 8.7e-3},
    "null_over_temperature": {"coefficient": 4e-5},
    "play_temperature": {"coefficient": 3e-5},
    "return_spring": {"stiffness": 4e4},
}
TANK = """
from vaneloop import System, unknown


def derivative(x, u, p):
    return p.inflow * u.pump - p.outflow * x.level


system = System(
    name="tank", kind="simulate", model=derivative, inputs={"pump": "V", "oil": "degC"}, states={"level": "cm"},
    outputs={"level": "cm"},
    parameters=[unknown("inflow", 0.1, "cm/(V s)", low=0.0), unknown("outflow", 0.01, "1/s", low=0.0)],
)
"""


def _rig(folder: Path, name: str) -> Path:
    from tests.firmware_on_rig import firmware
    from tests.rig import CATALOGUE, Hidden, manoeuvre, simulate, write

    path = folder / f"{name}.parquet"
    sizes = {CATALOGUE[name].main: next(iter(HIDDEN[name].values()))}
    write(simulate(manoeuvre(SEED, SECONDS), firmware(), [Hidden(name, sizes)], seed=SEED, rate=100), path)
    return path


def _tank(folder: Path, samples: int) -> Path:
    """A tank whose outflow grows several times as its oil warms."""
    rng = np.random.default_rng(3)
    t = np.arange(float(samples))
    pump = np.repeat(rng.uniform(0.0, 8.0, -(-samples // 50)), 50)[:samples]
    oil = 40.0 + 25.0 * np.sin(2.0 * np.pi * t / 1100.0 + rng.uniform(0.0, 6.0))
    outflow = 0.02 + 0.05 / (1.0 + np.exp(-(oil - 35.0) / 6.0))
    level, rows = 20.0, []
    for k in range(samples):
        rows.append((t[k], pump[k], oil[k], level + 0.05 * rng.standard_normal()))
        for _ in range(10):
            level += 0.1 * (0.2 * pump[k] - outflow[k] * level)
    path = folder / f"tank_{samples}.csv"
    np.savetxt(path, rows, delimiter=",", header="t,pump,oil,level", comments="", fmt="%.5f")
    return path


def _command(what: str, arguments: list[str], target: bool, folder: Path) -> Row:
    """One `vaneloop learn`, from start to end; what it compiles has been compiled."""
    answer = folder / "answer.json"
    command = [sys.executable, "-m", "vaneloop", "learn", *arguments, "--quiet", "--json", str(answer)]
    began = time.perf_counter()
    p = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    _, status, used = os.wait4(p.pid, 0)
    wall, cpu = time.perf_counter() - began, used.ru_utime + used.ru_stime
    p.returncode = os.waitstatus_to_exitcode(status)
    if p.returncode not in (0, 1):
        raise RuntimeError(f"{what}: exit code {p.returncode}")
    said = json.loads(answer.read_text(encoding="utf-8"))
    named = " + ".join(law["effect"] for law in said["laws"]) or said["verdict"]
    return Row(
        f"learn: {what}", f"{wall:.0f} s", f"{LIMIT:.0f} s", wall / LIMIT, "at most 1" if target else "",
        wall <= LIMIT if target else None, f"{named}; {cpu:.0f} s of a processor; load {os.getloadavg()[0]:.1f}",
    )  # fmt: skip


def commands() -> Iterator[Row]:
    """The whole command, on logs of the rig and of a model of one's own."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "tank.py").write_text(TANK, encoding="utf-8")
        first = _tank(folder, 400)  # compiles the system with curves
        _command("", [str(first), "--system", str(folder / "tank.py")], False, folder)
        for samples, target in ((4_000, True), (30_000, False)):
            log = _tank(folder, samples)
            yield _command(
                f"a tank, {samples:,} samples", [str(log), "--system", str(folder / "tank.py")], target, folder
            )
        for hidden in HIDDEN:
            yield _command(f"vane chain, 300 s, {hidden}", [str(_rig(folder, hidden))], True, folder)


def side_by_side() -> Iterator[Row]:
    """Sixteen parameter sets of a stage with a curve: side by side, and each through the plant's chain."""
    from hil.logs import read_log
    from plant import build_plant
    from plant.stages import actuator, bends, engine, linkage
    from vaneloop.identification.vane_chain.candidates import VaneChainCandidates
    from vaneloop.identification.vane_chain.chain import build_chain

    with tempfile.TemporaryDirectory() as folder:
        log = read_log(_rig(Path(folder), "null_over_temperature"), require=())
    chain = build_chain(log, build_plant())
    none = lambda p: np.zeros(p.shape[1], dtype=bool)  # noqa: E731
    for name in ("linkage", "actuator", "engine"):
        ground = VaneChainCandidates(chain.stage(name))
        c = ground.candidates(ground.stage((), ()).neutral())[0]
        stage = ground.stage((), ((c.placed(), c.effect(1.0)),))
        sets = np.repeat(stage.neutral()[None], 16, axis=0)
        sets[:, -3:] = 0.01

        def spent(stage: object = stage, sets: np.ndarray = sets) -> float:
            stage.run(sets)  # type: ignore[attr-defined]
            best = np.inf
            for _ in range(OFTEN):
                sets[:, -1] += 1e-9
                began = time.process_time()
                stage.run(sets)  # type: ignore[attr-defined]
                best = min(best, time.process_time() - began)
            return best

        ours = spent()
        with (
            mock.patch.object(linkage, "alike", none),
            mock.patch.object(actuator, "alike", none),
            mock.patch.object(engine, "alike", none),
            mock.patch.object(bends, "alike", none),
        ):
            peer = spent()
        each = 1e9 / len(sets) / len(stage.t)
        yield Row(
            f"{name} with a curve, 16 sets: side by side, through the chain", f"{ours * each:.0f} ns",
            f"{peer * each:.0f} ns", peer / ours, "", None, "of a processor, for a set and sample",
        )  # fmt: skip


MEASUREMENTS = {"curves side by side": side_by_side, "learning a law": commands}
