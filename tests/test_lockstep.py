"""The closed loop in simulated time: deterministic to the bit, and doing its job."""

from __future__ import annotations

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from hil.engine_test import engine_test, load_profile
from hil.loop.lockstep import Stimulus, lockstep
from tests.conftest import ROOT

SHORT = """
import numpy as np
from hil.loop.lockstep import Stimulus, lockstep
n = np.interp(np.arange(0.0, {seconds}, 0.01), [0, 0.5, 1.0, 1.5, 2.0], [60, 62, 70, 66, 60])
print(lockstep(Stimulus.of(n), seed=5).state_hash)
"""


def hash_in_another_process(seconds: float, **env: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", SHORT.format(seconds=seconds)],
        cwd=ROOT,
        env={**os.environ, **env},
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout.strip()


def hash_here(seconds: float) -> str:
    n = np.interp(np.arange(0.0, seconds, 0.01), [0, 0.5, 1.0, 1.5, 2.0], [60, 62, 70, 66, 60])
    return lockstep(Stimulus.of(n), seed=5).state_hash


def test_same_run_gives_the_same_hash_in_another_process() -> None:
    assert hash_in_another_process(2.0) == hash_here(2.0)


@pytest.mark.slow
def test_same_run_gives_the_same_hash_under_load() -> None:
    alone = hash_here(2.0)
    with ThreadPoolExecutor(4) as pool:
        others = [pool.submit(hash_in_another_process, 2.0) for _ in range(4)]
        assert {f.result() for f in others} == {alone}


def test_same_run_gives_the_same_hash_without_compiling() -> None:
    assert hash_in_another_process(0.5, NUMBA_DISABLE_JIT="1") == hash_here(0.5)


def test_another_seed_gives_another_hash() -> None:
    n = np.full(50, 70.0)
    assert lockstep(Stimulus.of(n), seed=1).state_hash != lockstep(Stimulus.of(n), seed=2).state_hash


def test_hash_covers_every_tick_not_only_the_logged_ones() -> None:
    n = np.full(100, 70.0)
    n[50] = 70.5  # one frame of 10 ms
    a, b = (lockstep(Stimulus.of(v), every=1000) for v in (np.full(100, 70.0), n))
    assert a.state_hash != b.state_hash


def test_logging_faster_changes_no_state() -> None:
    n = np.interp(np.arange(0.0, 3.0, 0.01), [0, 3], [60, 75])
    slow, fast = lockstep(Stimulus.of(n), every=10), lockstep(Stimulus.of(n), every=1)
    assert slow.state_hash == fast.state_hash
    assert np.array_equal(slow.columns["x_lvdt"], fast.columns["x_lvdt"][::10])
    assert np.allclose(
        slow.columns["i_cmd"][1:],
        fast.columns["i_cmd"][1:].reshape(-1)[: 10 * (len(slow.t) - 1)].reshape(-1, 10).mean(axis=1),
    )


def test_stroke_follows_its_demand_and_vanes_their_schedule() -> None:
    n = np.interp(np.arange(0.0, 60.0, 0.01), [0, 5, 15, 30, 40, 60], [60, 60, 95, 95, 70, 70])
    run = lockstep(Stimulus.of(n))
    c = run.columns
    assert np.max(np.abs(c["x_lvdt"] - c["x_dem"])) < 1.0
    settled = (run.t > 25) & (run.t < 30)
    from plant import build_plant

    target = np.rad2deg(build_plant().schedules.targets(c["n_r"]))[:, 0]
    assert np.max(np.abs(c["vigv"] - target)[settled]) < 0.05


def test_stimulus_without_frames_drives_the_controller_to_its_fail_safe_stroke() -> None:
    stimulus = Stimulus.of(np.full(800, 80.0))
    stimulus.rows[200:, 4] = 0.0  # no fresh frame after 2 s
    run = lockstep(stimulus)
    c = run.columns
    assert c["state"][199] == 2 and c["state"][-1] == 4
    assert c["x_lvdt"][-1] == pytest.approx(2.0, abs=0.1)


@pytest.fixture(scope="module")
def of_dual_curves():
    return engine_test(load_profile(), "dual")


@pytest.fixture(scope="module")
def of_a_single_curve():
    return engine_test(load_profile(), "single")


@pytest.mark.slow
def test_engine_test_is_as_long_as_the_papers(of_dual_curves, of_a_single_curve) -> None:
    n, single, dual = load_profile(), of_a_single_curve, of_dual_curves
    assert len(n) * 1e-2 > 3000.0
    assert dual.signals[0].samples > 30_000 and single.signals[0].samples == dual.signals[0].samples


@pytest.mark.slow
def test_dual_curves_stay_below_the_papers_errors(of_dual_curves) -> None:
    vigv = of_dual_curves.signals[0]
    assert vigv.max_abs <= 2.17 and vigv.mean_abs <= 0.55 and vigv.mean_abs_99_100 <= 0.47


@pytest.mark.slow
def test_single_curve_shows_half_the_hysteresis_that_it_does_not_remove(of_a_single_curve) -> None:
    assert of_a_single_curve.signals[0].mean_abs == pytest.approx(0.8, abs=0.1)
