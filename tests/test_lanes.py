"""Closed loops side by side: each is the loop that runs alone, to rounding."""

from __future__ import annotations

import math
import subprocess
import sys
import threading
from pathlib import Path

import numba
import numpy as np
import pytest
from numba import njit

from benchmarks.ours import profile, troubled
from controller import MODES, Calibration, load_calibration
from hil.loop.lanes import lockstep_lanes
from hil.loop.lockstep import Run, Stimulus, lockstep
from plant import Model, Plant, build_plant, chain_lanes, linkage, linkage_lanes
from plant.effects import EFFECTS
from plant.linkage_lanes import arcsine
from plant.parameters import nominal
from plant.stages.blocks import on_all_cores
from tests.machines import machine
from vaneloop.base.vanes import VANES
from vaneloop.fleet.reader import _environment

ANGLE = 1e-10  # deg: series stand for the C library's arctangents; all other signals have the same bits


def drawn(generator: np.random.Generator, plant: Plant, effects: int) -> Plant:
    """A machine with every nominal parameter within its tolerance, and some effects at a tenth of their range."""
    parameters = {
        n.name: n.value + n.tolerance * generator.uniform(-1.0, 1.0) for n in nominal(plant.table, plant.geometry)
    }
    chosen: dict[str, dict[str, float]] = {}
    known = [e for e in EFFECTS.values() if plant.kind in e.kinds and e.name not in ("can_delay", "frame_hold")]
    for e in generator.permutation(np.array(known, dtype=object))[:effects]:
        chosen[e.name] = {
            q.name: q.neutral + 0.1 * generator.uniform(0.2, 1.0) * (q.high - q.neutral)
            for q in plant.parameters_of(e.name).values()
        }
    return Model(parameters=parameters, effects=chosen).plant(plant)


def assert_same(runs: list[Run], alone: list[Run]) -> None:
    """Fail with the first signal that differs by more than rounding."""
    assert len(runs) == len(alone)
    for run, one in zip(runs, alone, strict=True):
        assert list(run.columns) == list(one.columns)
        assert run.faults == one.faults
        assert run.simulated_s == one.simulated_s
        for name, values in one.columns.items():
            most = ANGLE if name in VANES else 0.0
            np.testing.assert_allclose(run.columns[name], values, rtol=0.0, atol=most, err_msg=name)


@pytest.mark.slow
@pytest.mark.parametrize("effects", [0, 1, 4, 8])
def test_machines_drawn_at_random_are_the_loops_that_run_alone(effects: int) -> None:
    generator, stimulus = np.random.default_rng(20 + effects), Stimulus.of(profile(12.0))
    plants = [drawn(generator, build_plant(), effects) for _ in range(11)]
    alone = [lockstep(stimulus, plant=p, seed=3, hashed=False) for p in plants]
    assert_same(lockstep_lanes(stimulus, plants, seed=3), alone)
    assert len({float(r.columns["x_lvdt"][-1]) for r in alone}) > 1


@pytest.mark.slow
def test_lanes_in_different_modes_and_with_different_faults_do_not_mix() -> None:
    generator, trouble = np.random.default_rng(7), troubled(110.0)
    calm = Stimulus.of(profile(110.0))
    stimuli = [trouble, calm, trouble, calm]
    plants = [drawn(generator, build_plant(), 0) for _ in stimuli]
    runs = lockstep_lanes(stimuli, plants, seed=1)
    assert_same(runs, [lockstep(s, plant=p, seed=1, hashed=False) for s, p in zip(stimuli, plants, strict=True)])
    assert {MODES[int(m)] for m in runs[0].columns["state"]} >= {"STANDBY", "RUN", "DEGRADED", "FAIL_SAFE"}
    assert {MODES[int(m)] for m in runs[1].columns["state"]} == {"RUN"}


def test_a_lane_with_a_fault_at_the_end_says_so_alone() -> None:
    bad = Stimulus.of(np.full(300, 80.0))
    bad.rows[250:, 4] = 0.0  # no more frames
    runs = lockstep_lanes([bad, Stimulus.of(np.full(300, 80.0))], [build_plant()] * 2)
    assert [bool(r.faults) for r in runs] == [True, False]


def test_every_machine_and_controller_is_run_in_the_order_asked_for(tmp_path: Path) -> None:
    one, eight = machine(tmp_path / "1", 1), machine(tmp_path / "8", 8)
    shipped, late = build_plant(), Model(effects={"can_delay": {"delay": 0.04}}).plant()
    motor = build_plant("plant_electromechanical.toml")
    asked: list[tuple[Plant, Calibration]] = [
        one, (motor, load_calibration()), (shipped, load_calibration(strategy="single")), eight,
        (late, load_calibration()), (shipped, load_calibration(strategy="adaptive")), (shipped, load_calibration()),
    ]  # fmt: skip
    stimulus = Stimulus.of(profile(11.0))
    runs = lockstep_lanes(stimulus, [p for p, _ in asked], calibrations=[c for _, c in asked], every=5)
    assert_same(runs, [lockstep(stimulus, plant=p, calibration=c, every=5, hashed=False) for p, c in asked])


@pytest.mark.slow
def test_more_lanes_than_a_block_and_more_ticks_than_a_stimulus() -> None:
    generator, stimulus = np.random.default_rng(1), Stimulus.of(np.linspace(60.0, 70.0, 100))
    plants = [drawn(generator, build_plant(), 0) for _ in range(chain_lanes.W + 3)]
    runs = lockstep_lanes(stimulus, plants, duration=1.5, every=1)
    assert_same(runs, [lockstep(stimulus, plant=p, duration=1.5, every=1, hashed=False) for p in plants])


def test_what_does_not_belong_together_is_refused() -> None:
    plants = [build_plant()] * 2
    short, long = Stimulus.of(np.full(10, 60.0)), Stimulus.of(np.full(20, 60.0))
    with pytest.raises(ValueError, match="every"):
        lockstep_lanes(short, plants, every=7)
    with pytest.raises(ValueError, match="each of the 2 plants"):
        lockstep_lanes([short] * 3, plants)
    with pytest.raises(ValueError, match="equally long"):
        lockstep_lanes([short, long], plants)
    with pytest.raises(ValueError, match="each of the 2 plants"):
        lockstep_lanes(short, plants, calibrations=[load_calibration()])
    assert lockstep_lanes(short, []) == []


def test_arcsine_is_the_c_library_s_to_three_units_in_the_last_place() -> None:
    compiled = njit(arcsine.py_func)
    for x in [0.0, 0.5, -0.5, 1.0, -1.0, *np.random.default_rng(3).uniform(-1.0, 1.0, 2000)]:
        assert abs(compiled(x) - math.asin(x)) <= 3.0 * np.spacing(abs(math.asin(x)))


@pytest.mark.parametrize("stroke", [-0.4, -2e-3, 0.0, 0.024, 0.05, 0.5])
def test_the_crank_is_the_chain_s_also_where_it_cannot_be_assembled(stroke: float) -> None:
    g = build_plant().geometry.arrays()[:4]
    found = linkage_lanes.crank(stroke, linkage_lanes.crank_numbers(*g))
    assert found == pytest.approx(linkage.crank(stroke, *g), abs=1e-12)


@pytest.mark.parametrize("allowed", [1, 2])
def test_lanes_take_no_more_threads_than_the_process_may(allowed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """A worker of a fleet may take one: two workers of two threads on two cores wait for each other."""
    monkeypatch.setattr(numba.config, "NUMBA_NUM_THREADS", allowed)
    used: set[int] = set()
    both = threading.Barrier(allowed)

    def run(part: range) -> None:
        used.add(threading.get_ident())
        both.wait(600.0)

    on_all_cores(run, [range(k, k + 1) for k in range(4)])
    assert len(used) == allowed
    assert (used == {threading.get_ident()}) == (allowed == 1)


def test_the_process_that_reads_a_fleet_s_logs_may_take_one_thread() -> None:
    words = "from vaneloop.base.compiled import threads; print(threads())"
    said = subprocess.run([sys.executable, "-c", words], env=_environment(), capture_output=True, text=True, check=True)
    assert said.stdout == "1\n"
