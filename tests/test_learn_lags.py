"""Laws of the vane chain with a memory: a curve of a signal behind a first-order lag, in the loop, in the stages of the
search, in the file, and learned.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hil.logs import Channel, Log
from hil.loop.lockstep import Run, Stimulus, lockstep
from plant import Model, build_plant, load_model, write_model
from plant.curve import CRANK_ADDS, CURRENT_ADDS, S_LATE, begin, bend, follow, quantity_of
from plant.effects import N_STATE
from tests import rig
from tests.test_learn_vanes import WIDE, chain, columns, curved, law
from vaneloop.base.errors import InputError
from vaneloop.identification.user_models.exogenous_regressors import lagged
from vaneloop.identification.vane_chain.candidates import LAGGED, VaneChainCandidates, curve_effect, with_laws
from vaneloop.identification.vane_chain.chain import Chain, build_chain
from vaneloop.identification.vane_chain.subsystem_data import Made

TICK = 1e-3
SECONDS = 30.0
CREEP = ("linkage.crank adds", "speed_of_x_lvdt_lagged_by_2_s", "line", -0.2)  # 0.1 of a stroke comes 2 s late


def run_of(model: Model, seconds: float = SECONDS) -> Run:
    demand = rig.manoeuvre(3, seconds).n_dem
    return lockstep(Stimulus.of(demand), plant=build_plant(model=model), seed=1, hashed=False)


def chain_of(run: Run, model: Model) -> Chain:
    known = {k: np.isfinite(v) for k, v in run.columns.items()}
    channels = {k: Channel(run.t[known[k]], v[known[k]]) for k, v in run.columns.items() if k != "t" and known[k].any()}
    return build_chain(Log("loop", channels), build_plant(model=model))


def left(chain: Chain, stage: str) -> float:
    s = chain.stage(stage)
    return float(np.sqrt(np.nanmean((s.run(s.neutral()[None])[0] - s.measured) ** 2)))


@pytest.mark.slow
@given(st.floats(0.005, 50.0), st.floats(-20.0, 20.0), st.integers(1, 400))
def test_a_step_comes_through_a_lag_as_its_exponential(tau: float, step: float, ticks: int) -> None:
    name = f"i_cmd_lagged_by_{round(tau * 1e6)}_us"
    tau = round(tau * 1e6) * 1e-6
    p = build_plant(model=curved(law("valve.current adds", name, "line", 0.5))).p
    s = np.zeros((N_STATE, 1))
    begin(s, p, 0, 40.0)
    for k in range(1, ticks + 1):
        follow(s, p, 0, step * 1e-3, 0.0, 70.0, 70.0, 2.1e7, 40.0, k * TICK)
    want = step * -np.expm1(-ticks * TICK / tau)
    assert s[S_LATE, 0] == pytest.approx(1e-3 * want, rel=1e-9, abs=1e-15)
    assert bend(s, p, 0, CURRENT_ADDS) == pytest.approx(0.5e-3 * want, rel=1e-6, abs=1e-9)


def test_every_curve_has_its_own_lag() -> None:
    """Four of one signal, at two places, one of them behind none."""
    of = ("n_r_lagged_by_1_s", "n_r", "n_r_lagged_by_10_ms", "n_r_lagged_by_1_s")
    laws = [law("valve.current adds", q, "line", 1.0) for q in of[:3]] + [law("linkage.crank adds", of[3], "line", 1.0)]
    p = build_plant(model=curved(*laws)).p
    s = np.zeros((N_STATE, 1))
    begin(s, p, 0, 40.0)
    follow(s, p, 0, 0.0, 0.0, 0.0, 50.0, 2.1e7, 40.0, 0.5)
    slow, quick = (50.0 * -np.expm1(-0.5 / tau) for tau in (1.0, 0.01))
    assert bend(s, p, 0, CRANK_ADDS) == pytest.approx(1e-3 * slow)
    assert bend(s, p, 0, CURRENT_ADDS) == pytest.approx(1e-3 * (slow + 50.0 + quick))


def test_a_lag_of_nothing_changes_no_bit() -> None:
    of = ("i_cmd", "x_lvdt", "n_r", "t_oil")
    places = ("valve.current adds", "linkage.crank adds", "engine.lag times", "servo.current times")
    nothing = [law(at, f"{q}_lagged_by_300_ms", "constant", 0.0) for at, q in zip(places, of, strict=True)]
    assert np.array_equal(columns(Model()), columns(curved(*nothing)), equal_nan=True)


def test_a_lag_of_the_speed_in_a_reading_is_a_lag_of_the_reading() -> None:
    """x behind a lag T is x - T (x's speed behind T)."""
    tau = 0.01
    ours = curved(law("sensors.lvdt adds", "speed_of_x_lvdt_lagged_by_10_ms", "line", -tau))
    plain, ours, theirs = (columns(m) for m in (Model(), ours, Model(effects={"lvdt_lag": {"time_constant": tau}})))
    moved, off = (np.sqrt(np.nanmean((x - theirs) ** 2, axis=0)) for x in (plain, ours))
    assert moved.max() > 0.0 and np.all(off <= 1e-9 + 0.1 * moved)


def test_loop_and_stage_say_the_same_of_a_crank_that_creeps() -> None:
    model = curved(law(CREEP[0], CREEP[1], CREEP[2], *CREEP[3:]))
    run = run_of(model)
    without, with_it = (left(chain_of(run, m), "linkage") for m in (Model(), model))
    clean = left(chain_of(run_of(Model()), Model()), "linkage")
    assert without > 5.0 * clean and with_it < 1.1 * clean


def confirmed(model: Model, file: Path):
    """A law's file is taken, and a log of the loop with the law confirms its scale: the linkage's stage with the law
    and without, the law, and parameters with three scales.
    """
    write_model(file, model)
    assert load_model(file) == model
    ((name, curve),) = model.curves.items()
    effect = curve_effect(name, curve)
    plain = chain_of(run_of(model), Model()).stage("linkage")
    stage = with_laws(plain, (), [effect], "loop")
    theta = np.repeat(stage.neutral()[None], 3, axis=0)
    theta[:, stage.index()[name]] = np.array([[0.9], [1.0], [1.1]])
    off = np.nanmean((stage.run(theta) - stage.measured) ** 2, axis=(1, 2))
    assert off[1] < 0.9 * min(off[0], off[2])
    return stage, plain, effect, theta


def test_its_file_is_taken_and_another_log_confirms_its_scale(tmp_path) -> None:
    confirmed(curved(law(*CREEP)), tmp_path / "law.toml")


def test_loop_and_stage_say_the_same_of_an_engine_that_remembers() -> None:
    model = curved(law("engine.demand adds", "n_dem_lagged_by_2_s", "line", 0.1, **WIDE))
    run = run_of(model)
    without, with_it = (left(chain_of(run, m), "engine") for m in (Model(), model))
    assert without > 20.0 * with_it and with_it < 0.03


@pytest.mark.slow
def test_compiled_or_not_a_lag_has_the_same_bits() -> None:
    code = (
        "import hashlib; from tests.test_learn_lags import *; "
        "x = np.column_stack(list(run_of(curved(law(*CREEP)), 0.5).columns.values())); "
        "print(hashlib.sha256(x.tobytes()).hexdigest())"
    )
    said = []
    for off in ("0", "1"):
        env = {**os.environ, "NUMBA_DISABLE_JIT": off}
        done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=True)
        said.append(done.stdout.strip())
    assert said[0] == said[1] and len(said[0]) == 64


def test_an_excerpt_knows_what_went_before_it() -> None:
    _, whole = chain()
    stage = whole.stage("linkage")
    rows = np.arange(2000, 3500)
    part = stage.excerpt(rows)
    assert isinstance(stage.made, Made) and isinstance(part.made, Made)
    for name in ("x_lvdt_lagged_by_5_s", "speed_of_x_lvdt_lagged_by_5_s", "speed_of_x_lvdt", "vgv1"):
        assert np.array_equal(part.made.driven.quantity(name), stage.made.driven.quantity(name)[rows])
    n_r = whole.columns["n_r"]
    assert np.array_equal(stage.made.driven.quantity("n_r_lagged_by_5_s"), lagged(whole.t, n_r, 5.0))


def test_an_excerpt_of_the_linkage_says_what_the_whole_log_says_there() -> None:
    """Also at the last row of a piece: the speed there is not that of a leap to the next one."""
    stage = chain()[1].stage("linkage")
    x = chain()[1].columns["x_lvdt"]
    ends = [(last, far) for last in range(2000, 2900) for far in range(3000, 4500, 50)]
    last, far = max(ends, key=lambda e: (x[e[1]] - x[e[0]]) * np.clip(x[e[0]] - x[e[0] - 30], -1.0, 1.0))  # its own way
    rows = np.r_[500 : last + 1, far : far + 1400]
    part = stage.excerpt(rows)
    off = part.run(part.neutral()[None])[0] - stage.run(stage.neutral()[None])[0][:, rows]
    counts, cut = np.isfinite(part.measured), last - 499
    assert abs(x[far] - x[last]) > 5.0 and counts[:, :cut].any()
    assert np.abs(off)[counts].max() < 0.1 * float(np.min(stage.floor))


@pytest.mark.slow
def test_lags_are_of_what_drives_a_stage() -> None:
    _, whole = chain()
    for stage in whole.stages:
        late = [
            c
            for c in VaneChainCandidates(stage).candidates(stage.neutral()[: len(stage.parameters)])
            if c.quantity.remembers and not c.quantity.stops
        ]
        assert late
        for c in late:
            q = quantity_of(c.quantity.name)
            assert c.quantity.name.split("_lagged_by_")[0] in LAGGED[stage.name] and q is not None and q.lag > 0.0
            longer = c.slower(1.8)
            assert longer is None or quantity_of(longer.quantity.name).lag == pytest.approx(1.8 * q.lag, rel=0.01)


def test_what_no_machine_has_behind_a_lag_is_refused() -> None:
    for name in (
        "time_lagged_by_1_s",
        "oil_lagged_by_1_s",
        "n_r_lagged_by_0_s",
        "n_r_lagged_by_1",
        "vgv7_lagged_by_1_s",
    ):
        with pytest.raises(InputError, match="SIGNAL_lagged_by_TIME"):
            build_plant(model=curved(law("sensors.lvdt adds", name, "line", 0.4)))
    log, _ = chain()
    less = Log("rig", {k: c for k, c in log.channels.items() if k != "n_dem"})
    with pytest.raises(InputError, match="n_dem"):
        build_chain(less, build_plant(model=curved(law("engine.lag times", "n_dem_lagged_by_1_s", "constant", 0.1))))
