"""Very many closed loops: figures without logs, on a GPU or not. Numba's simulator stands in for the GPU."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from controller import load_calibration
from hil.loop import cuda, engines
from hil.loop.engines import Engines, Unfinished, lockstep_engines
from hil.loop.lockstep import Stimulus, lockstep
from plant import Model, Plant, build_plant
from vaneloop.base import extras
from vaneloop.base.errors import InputError

HERE = Path(__file__).resolve().parent.parent
# one by one on the processor, by the loop that the program compiles ahead
ALONE = load_calibration(strategy="inverse")
RISE = Stimulus.of(np.linspace(60.0, 61.0, 3))


def plants() -> list[Plant]:
    """A machine as built, and one with effects in its drive and its linkage."""
    base = build_plant()
    effects = {"valve_null_bias": {"bias": 1.0}, "aero_load": {"force": 500.0}, "linkage_friction": {"vigv": 0.2}}
    return [base, Model(effects=effects).plant(base)]


def figures(run: Engines) -> dict[str, list[float]]:
    """The numbers of an answer, for JSON."""
    names = ("servo_error", "angle_error", "stroke", "angles", "in_mode")
    return {name: getattr(run, name).tolist() for name in names}


def test_an_unknown_device_is_one_line():
    with pytest.raises(InputError, match="device .='gpu'. must be one of auto, cpu, cuda"):
        lockstep_engines(RISE, [build_plant()], device="gpu")


def test_without_numba_cuda_a_line_names_the_extra_and_auto_goes_on(monkeypatch):
    monkeypatch.setattr(extras, "is_there", lambda module: False)
    cuda.kernel.cache_clear()
    with pytest.raises(InputError, match=r"needs numba-cuda, which is not installed: pip install 'vaneloop\[gpu\]'"):
        lockstep_engines(RISE, [build_plant()], calibrations=ALONE, device="cuda")
    run = lockstep_engines(RISE, [build_plant()], calibrations=ALONE, device="auto")
    assert run.ran.all() and run.devices == ["cpu"] and "numba-cuda" in run.notes[0]


def test_figures_are_those_of_the_log():
    run = lockstep_engines(RISE, [build_plant()], calibrations=ALONE, seed=3, device="cpu")
    log = lockstep(RISE, calibration=ALONE, plant=build_plant(), seed=3).columns
    assert run.servo_error[0] == np.abs(log["x_dem"] - log["x_lvdt"]).max()
    assert run.stroke[0] == log["x_lvdt"][-1] and run.angles[0, 0] == log["vigv"][-1]
    assert run.in_mode[0].sum() == pytest.approx(0.03)


class Failing:
    """A GPU that runs one chunk and then fails."""

    name = "a GPU"

    def room(self, *_: object) -> int:
        return 1


@pytest.mark.parametrize("device", ["cuda", "auto"])
def test_a_gpu_that_fails_half_way_loses_nothing_that_was_finished(monkeypatch, device):
    done = []

    def on_gpu(kernel, work, some):
        if done:
            raise RuntimeError("out of order")
        done.append(some)
        work.out.stroke[some] = 7.0
        work.ran_on(kernel.name, some)

    monkeypatch.setattr(engines, "_on_gpu", on_gpu)
    monkeypatch.setattr(cuda, "kernel", Failing)
    monkeypatch.setattr(engines, "_on_processor", lambda work, some: work.ran_on("cpu", some))
    three = [build_plant()] * 3
    if device == "cuda":
        with pytest.raises(Unfinished, match="out of order; 1 of 3 engines are finished") as e:
            lockstep_engines(RISE, three, device=device)
        assert e.value.engines.ran.tolist() == [True, False, False] and e.value.engines.stroke[0] == 7.0
    else:
        run = lockstep_engines(RISE, three, device=device)
        assert run.on.tolist() == [0, 1, 1] and run.stroke[0] == 7.0 and "out of order" in run.notes[0]


def simulated() -> None:
    """In a child: the kernel, interpreted by numba's simulator."""
    cals = [load_calibration(), load_calibration(strategy="single")]
    for given in (cals[0], cals):  # scalars as arguments of the kernel, and as records
        print(json.dumps(figures(lockstep_engines(RISE, plants(), calibrations=given, seed=1, device="cuda"))))


@pytest.mark.slow
def test_the_kernel_gives_what_the_loop_gives():
    if not extras.is_there("numba_cuda"):
        pytest.skip("the extra gpu is not installed: the kernel has no simulator to run in")
    code = "from tests.test_gpu import simulated; simulated()"
    env = {**os.environ, "NUMBA_ENABLE_CUDASIM": "1"}
    done = subprocess.run([sys.executable, "-c", code], cwd=HERE, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    for line, strategies in zip(done.stdout.splitlines(), (("dual", "dual"), ("dual", "single")), strict=True):
        told = json.loads(line)
        for i, (plant, strategy) in enumerate(zip(plants(), strategies, strict=True)):
            log = lockstep(RISE, calibration=load_calibration(strategy=strategy), plant=plant, seed=1).columns
            assert told["stroke"][i] == log["x_lvdt"][-1]
            assert told["servo_error"][i] == pytest.approx(np.abs(log["x_dem"] - log["x_lvdt"]).max(), rel=1e-9)
            targets = np.rad2deg(plant.schedules.targets(log["n_r"]))
            for q, vane in enumerate(plant.vanes):
                assert told["angles"][i][q] == pytest.approx(log[vane][-1], rel=1e-9)
                assert told["angle_error"][i][q] == pytest.approx(np.abs(log[vane] - targets[:, q]).max(), rel=1e-9)
            assert told["in_mode"][i] == pytest.approx(0.01 * np.bincount(log["state"].astype(int), minlength=5))
