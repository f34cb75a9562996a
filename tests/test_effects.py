"""Every effect: neutral is an exact identity, it shows where it says and nowhere else, and its physics is right."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from functools import lru_cache, partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq

from benchmarks.effects_page import page
from controller import load_calibration, new_state
from hil.loop.lockstep import Stimulus, lockstep
from hil.loop.tick import flashed
from plant import Model, build_plant, chain, load_model, places, write_model
from plant import effects as library
from plant.effect import DEG, KINDS, MOTOR, PAIR, STAGES
from plant.effects import (
    EFFECTS,
    ROW,
    can_delay,
    frame_hold,
    linkage_compliance,
    linkage_friction,
    lvdt_nonlinearity,
    oil_compressibility,
    piston_friction,
    piston_stiction,
    ring_eccentricity,
    supply_pressure_droop,
    valve_hysteresis,
)
from plant.geometry import vane_angles
from plant.layout import GEOMETRY, N_NOMINAL
from plant.linkage import G_LB, G_LC, N_CRANK, N_PER_STAGE
from plant.linkage_lanes import arctangent, tangent
from plant.parameters import DRIVE_EFFECTS, DRIVE_LOADED, VANE_EFFECTS, derive
from plant.stages import actuator_run, engine_run, linkage_run, step_currents
from plant.stages.blocks import W
from plant.stages.linkage import SOME
from tests import columns as fw
from tests.conftest import ROOT, examples
from tests.effect_table import EXAMPLES
from vaneloop.base.errors import InputError

NAMES = tuple(EFFECTS)
MACHINE = build_plant()
OWN = {name: tuple(MACHINE.parameters_of(name).values()) for name in NAMES}  # of the shipped machine

SIZES = {name: example.plain for name, example in EXAMPLES.items()}
ALONE = [n for n in NAMES if EFFECTS[n].kinds != PAIR]  # those of a pair: tests/test_two_actuators.py
ELECTRIC = [n for n in NAMES if EFFECTS[n].kinds == MOTOR]


def base_of(*names: str):
    """The nominal machine that can have these effects."""
    electric = any(EFFECTS[n].kinds == MOTOR for n in names)
    return build_plant("plant_electromechanical.toml" if electric else "plant.toml")


def library_of(kind: str):
    """Effects that a machine with an actuator of this kind can have."""
    return [e for e in EFFECTS.values() if kind in e.kinds]


number = st.floats(-50.0, 50.0, allow_subnormal=False)
positive = st.floats(1e-3, 50.0)


def si(name: str, key: str, value: float) -> float:
    return value * EFFECTS[name][key].si


def machine_with(base=None, **sizes):
    """The nominal machine (or ``base``) with effects, {name: {parameter: value in its unit}}."""
    return Model(effects=sizes).plant(base or base_of(*sizes))


def drive(machine, current, ticks, *, n_r=100.0, p_s=21e6, t_oil=40.0, stroke=0.024):
    s = machine.start(stroke=stroke, n_r=n_r, t_oil=t_oil)
    out = np.empty((ticks, chain.N_STATE))
    for k in range(ticks):
        chain.drive_step(s, machine.p, 0, current if np.isscalar(current) else current[k], n_r, p_s, t_oil)
        out[k] = s[:, 0]
    return out


def speed(machine, current, **conditions):
    """Steady speed (m/s) of the piston under a constant current (A)."""
    out = drive(machine, current, 200, **conditions)[:, places.X]
    return (out[-1] - out[-101]) / 0.1


# ---- the registry ----------------------------------------------------------------------------------------------------


def test_library_holds_what_the_tests_know() -> None:
    assert set(NAMES) == set(EXAMPLES)


def test_rows_follow_the_nominal_ones_without_gaps() -> None:
    rows = [ROW[e.name] + i for e in EFFECTS.values() for i in range(len(e.parameters))]
    assert rows == list(range(N_NOMINAL, library.DERIVED))
    assert len(library.STATE) == library.N_STATE == len(set(library.STATE))


@pytest.mark.parametrize("name", NAMES)
def test_docstring_has_its_sections(name: str) -> None:
    doc = sys.modules[f"plant.effects.{name}"].__doc__
    for section in ("Equation", "Symbols:", "Limits:", "In a log:", "Source:"):
        assert section in doc, f"plant/effects/{name}.py: the docstring lacks {section!r}"


def test_page_on_effects_is_current() -> None:
    assert (ROOT / "docs" / "effects.md").read_text(encoding="utf-8") == page(), (
        "run: python -m benchmarks.effects_page > docs/effects.md"
    )


# ---- neutral is an identity ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
@settings(max_examples=examples(40))
@given(a=number, b=number, c=positive)
def test_neutral_effect_is_an_exact_identity(name: str, a: float, b: float, c: float) -> None:
    neutral = [p.neutral * p.si for p in EFFECTS[name].parameters]
    if name == "valve_flow_saturation":
        a *= 1e3  # any speed at all
    result, expected = EXAMPLES[name].neutral(sys.modules[f"plant.effects.{name}"], neutral, a, b, c)
    assert result == expected


@settings(max_examples=examples(30))
@given(
    st.lists(st.floats(-0.045, 0.045), min_size=5, max_size=40),
    st.floats(0.0, 0.048),
    st.floats(5e6, 25e6),
    st.floats(-40.0, 120.0),
)
def test_neutral_chain_with_every_effect_in_it_is_the_nominal_chain_bit_by_bit(currents, stroke, p_s, t_oil) -> None:
    machine = build_plant()
    assert not machine.p[[DRIVE_EFFECTS, DRIVE_LOADED, VANE_EFFECTS], 0].any()
    long_way = machine.p.copy()
    long_way[[DRIVE_EFFECTS, VANE_EFFECTS]] = 1.0
    loaded = long_way.copy()
    loaded[DRIVE_LOADED] = 1.0
    runs = []
    for p in (machine.p, long_way, loaded):
        s, samples = machine.start(stroke, 60.0), []
        for k, i in enumerate(currents):
            chain.rotor_step(s, p, 0, 80.0)
            chain.drive_step(s, p, 0, i, 70.0, p_s, t_oil)
            chain.vane_step(s, p, 0, 70.0, t_oil, k * 1e-3)
            samples.append(chain.sample_lvdt(s, p, 0, 0.0, t_oil))
        runs.append(np.concatenate([s[: places.RING + 6, 0], samples]))
    assert np.array_equal(runs[0], runs[1])
    # with the load's equations in it, one product is rounded differently
    assert np.allclose(runs[0], runs[2], rtol=1e-12, atol=1e-15)


# ---- where an effect shows: stages driven by the same log ------------------------------------------------------------

T = np.arange(0.0, 40.0, 0.01)
SAMPLES = len(T)


@lru_cache(maxsize=1)
def log() -> dict[str, np.ndarray]:
    """Inputs that excite every effect: both stops, slams, slow motion, reversals, dwells, warming oil."""
    n_dem = np.interp(
        T, [0, 3, 10, 12, 18, 20, 22, 22.6, 25, 32, 36, 40], [60, 60, 95, 95, 70, 70, 74, 73.4, 98, 98, 62, 62]
    )
    n_r = lockstep(Stimulus.of(n_dem)).columns["n_engine"]
    x = 24.0 + 20.0 * np.sin(0.5 * T) + 4.5 * np.sin(2.3 * T)
    i = 4.0 * np.sin(2.0 * np.pi * T / 7.0) + 2.0 * np.sin(9.0 * T) + np.where((T > 20) & (T < 20.6), 40.0, 0.0)
    i += np.where((T > 30) & (T < 30.6), -40.0, 0.0)
    return {
        "n_dem": n_dem,
        "n_r": n_r,
        "x_lvdt": 1e-3 * np.clip(x, 0.5, 47.5),
        "i_cmd": 1e-3 * i,
        "p_s": np.full(len(T), 21e6),
        "t_oil": 30.0 + T,
        "x_dem": 1e-3 * np.interp(T, [0, 5, 20, 40], [10, 10, 40, 15]),
    }


def lanes_of(sets, base):
    """Parameters with one lane per set of effects, on top of ``base``."""
    p = np.concatenate([machine_with(base, **effects).p for effects in sets], axis=1)
    return p, np.repeat(base.start(0.024, 60.0), len(sets), axis=1)


def actuator_lanes(sets, base, n=SAMPLES):
    p, s = lanes_of(sets, base)
    derive(p, 2e-3, 1e-2)
    out, c = np.empty((n, len(sets)), order="F"), {k: v[:n] for k, v in log().items()}
    actuator_run(step_currents(c["i_cmd"], 1e-2, 5), c["n_r"], c["p_s"], c["t_oil"], 1e-2, p, s, out, c["x_lvdt"], 500)
    return out, s


def linkage_lanes(sets, base, n=SAMPLES):
    p, s = lanes_of(sets, base)
    out, c = np.empty((n, 3, len(sets)), order="F"), {k: v[:n] for k, v in log().items()}
    linkage_run(c["x_lvdt"], c["n_r"], c["t_oil"], T[:n], 1e-2, p, s, out)
    return out, s


def engine_lanes(sets, base):
    p, s = lanes_of(sets, base)
    out = np.empty((len(T), len(sets)))
    engine_run(log()["n_dem"], 1e-2, p, s, out)
    return out


def demand_of(machine):
    """x_dem (m) of the firmware's 10 ms part with the logged frames, as the bus brings them."""
    cal, z, c = flashed(load_calibration(), machine), new_state(), log()
    z[fw.TREND_N] = z[fw.TREND_TURN] = c["n_dem"][0]
    out = np.empty(len(T))
    for k, t in enumerate(T):
        content = frame_hold.step(can_delay.step(t, machine.p[ROW["can_delay"], 0]), machine.p[ROW["frame_hold"], 0])
        j = max(int(np.floor(content / 0.01 + 1e-6)), 0)
        z[fw.N_DEM], z[fw.N_R] = c["n_dem"][j], c["n_r"][j]
        fw.trend_step(z, cal.k, z[fw.N_DEM])
        fw.schedule_step(z, cal.k, cal.table)
        if k == 0:
            z[fw.X_DEM] = z[fw.X_TARGET]
        fw.move_demand(z, cal.k, z[fw.X_TARGET], cal.scalars.stroke_rate)
        out[k] = z[fw.X_DEM]
    return out


def servo_of(machine):
    """i_cmd (A) of the firmware's servo on a logged demand and a stroke 0.1 mm behind it."""
    cal, z, c = flashed(load_calibration(), machine), new_state(), log()
    out = np.empty(len(T))
    for k, x in enumerate(c["x_dem"]):
        z[fw.X_MEAS] = x - 1e-4
        fw.servo_step(z, cal.k, x, 0.001)
        out[k] = z[fw.I_CMD]
    return out


@pytest.fixture(scope="module")
def stage_outputs():
    """{effect: {stage: output}} of every effect alone, and of the machine of either kind without it (whether it is
    electric). A load is on the piston in all
    of them.
    """
    out = {}
    for electric in (False, True):
        base = machine_with(base_of(*ELECTRIC[: int(electric)]), aero_load={"force": 2000.0})
        sets = [{}, *({name: SIZES[name]} for name in ALONE if (name in ELECTRIC) == electric)]
        wide = {
            "actuator": actuator_lanes(sets, base)[0],
            "linkage": linkage_lanes(sets, base)[0],
            "engine": engine_lanes(sets, base),
        }
        for j, effects in enumerate(sets):
            machine = machine_with(base, **effects)
            alone = {"demand": demand_of(machine), "servo": servo_of(machine)}
            out[next(iter(effects), electric)] = alone | {k: v[..., j] for k, v in wide.items()}
    return out


@pytest.mark.parametrize("name", ALONE)
def test_effect_shows_in_every_stage_it_declares_and_in_no_other(name: str, stage_outputs) -> None:
    with_it, without = stage_outputs[name], stage_outputs[name in ELECTRIC]
    # blocks of lanes and single ones differ by rounding
    changed = {stage for stage in STAGES if np.max(np.abs(with_it[stage] - without[stage])) > 1e-12}
    assert changed == set(EFFECTS[name].stages)
    assert all(np.isfinite(v).all() for v in with_it.values())


@pytest.mark.parametrize("kind", KINDS)
def test_any_parameters_within_their_bounds_keep_every_stage_finite(kind: str) -> None:
    base = machine_with(base_of(*(ELECTRIC if kind == MOTOR[0] else ())), aero_load={"force": 2000.0})
    own_of = {e.name: OWN[e.name] for e in library_of(kind)}
    sets = [{name: {p.name: v}} for name, own in own_of.items() for p in own for v in (p.low, p.high)]
    everything_low = {name: {p.name: p.low for p in own} for name, own in own_of.items()}
    everything_high = {name: {p.name: p.high for p in own} for name, own in own_of.items()}
    sets += [everything_low, everything_high]
    x, s = actuator_lanes(sets, base)
    vanes, _ = linkage_lanes(sets, base)
    assert (
        np.isfinite(x).all()
        and np.isfinite(s).all()
        and np.isfinite(vanes).all()
        and np.isfinite(engine_lanes(sets, base)).all()
    )
    assert np.all((s[places.X] >= 0.0) & (s[places.X] <= 0.048))


@pytest.mark.parametrize("name", ALONE)
def test_effect_changes_the_closed_loop_and_keeps_it_finite(name: str) -> None:
    load = {} if name == "aero_load" else {"aero_load": {"force": 2000.0}}
    stimulus = Stimulus.of(log()["n_dem"], t_oil=log()["t_oil"])
    machines = (machine_with(base_of(name), **load, **effects) for effects in ({name: SIZES[name]}, {}))
    run, without = (lockstep(stimulus, plant=machine, hashed=False).columns for machine in machines)
    assert all(np.isfinite(v).all() for v in run.values())
    if name == "end_stop_shift":  # this run stays 4 mm off the stops
        return
    assert any(not np.array_equal(run[c], without[c]) for c in run)


def everything_on(kind="hydraulic"):
    """The machine with every effect of its kind at a fiftieth of its range."""

    def small(p):
        return p.neutral + 0.02 * ((p.high - p.neutral) or (p.low - p.neutral))

    return machine_with(**{e.name: {p.name: small(p) for p in OWN[e.name]} for e in library_of(kind)})


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("lanes", [2, W, W + 2, SOME + 3, 40])
def test_lanes_side_by_side_give_the_bits_of_each_alone(lanes: int, kind: str) -> None:
    base, electric = everything_on(kind), kind == MOTOR[0]
    singles = [
        {},
        {"amplifier_offset": {"offset": -0.5}} if electric else {"valve_null_bias": {"bias": -0.5}},
        {"screw_friction": {"force": 900.0}} if electric else {"piston_friction": {"force": 900.0}},
        {"linkage_backlash": {"vigv": 0.4}},
    ]
    sets = [singles[j % 4] for j in range(lanes)]
    x, s = actuator_lanes(sets, base, 600)
    vanes, _ = linkage_lanes(sets, base, 600)
    for j in range(min(lanes, 4)):
        alone, state = actuator_lanes([sets[j]], base, 600)
        assert np.array_equal(alone[:, 0], x[:, j]) and np.array_equal(state[:, 0], s[:, j])
        assert np.allclose(linkage_lanes([sets[j]], base, 600)[0][:, :, 0], vanes[:, :, j], rtol=0.0, atol=1e-14)


# what a block of the actuator's lanes leaves out, by the effects that its lanes have
BLOCKS = {
    "nothing": (
        {},
        {"valve_dead_band": {"half_width": 0.5}},
        {"lvdt_nonlinearity": {"amplitude": 0.1}},
        {"oil_viscosity": {"coefficient": 3e-3}},
    ),
    "hysteresis": ({"valve_hysteresis": {"width": 1.0, "spread": 0.6}}, {"lvdt_gain": {"factor": 1.02}}),
    "load": (
        {"aero_load": {"force": 3000.0}},
        {"piston_friction": {"force": 900.0}},
        {"oil_compressibility": {"compliance": 0.1}},
    ),
    "losses": ({"supply_pressure_droop": {"droop": 20.0}}, {"internal_leakage": {"coefficient": 2.0}}),
    "stiction": ({"piston_stiction": {"excess": 1500.0, "speed": 5.0}}, {"piston_friction": {"force": 900.0}}),
}


@pytest.mark.parametrize("kind", BLOCKS)
def test_a_block_that_leaves_out_what_its_lanes_lack_gives_the_bits_of_the_whole(kind: str) -> None:
    loads = kind in ("load", "losses", "stiction")
    base = machine_with(aero_load={"force": 2000.0}) if loads else build_plant()
    sets = [BLOCKS[kind][j % len(BLOCKS[kind])] for j in range(W)]
    x, s = actuator_lanes(sets, base, 600)
    for j, effects in enumerate(sets):
        alone, state = actuator_lanes([effects], base, 600)
        assert np.array_equal(alone[:, 0], x[:, j])
        # where no effect acts, the short way of a lane alone leaves the effects' own state as it was
        assert np.array_equal(state[: places.X_LVDT + 1, 0], s[: places.X_LVDT + 1, j])
    everything = {name: sizes for k in BLOCKS.values() for effects in k for name, sizes in effects.items()}
    whole, _ = actuator_lanes([*sets[:-1], everything if loads else BLOCKS["hysteresis"][0]], base, 600)
    assert np.array_equal(whole[:, :-1], x[:, :-1])


def test_series_are_the_c_librarys_to_the_last_places() -> None:
    t = np.concatenate([np.linspace(-3.0, 3.0, 2001), np.geomspace(1e-9, 1e9, 500)])
    assert np.allclose([arctangent(v, 1.0) for v in t], np.arctan(t), rtol=5e-16, atol=0.0)
    assert arctangent(1.0, 0.0) == pytest.approx(np.pi / 2) and arctangent(-2.0, 0.0) == pytest.approx(-np.pi / 2)
    a = np.linspace(-0.785, 0.785, 2001)
    assert np.allclose([tangent(v) for v in a], np.tan(a), rtol=5e-16, atol=1e-300)


def test_stages_alone_reproduce_the_closed_loop_that_made_the_log() -> None:
    c = lockstep(Stimulus.of(log()["n_dem"])).columns
    machine, n = build_plant(), len(T)
    x, n_r, t_oil = c["x_lvdt"] * 1e-3, c["n_r"], c["t_oil"]
    p, s, out = machine.p.copy(), machine.start(x[0], n_r[0]), np.empty((n, 1))
    derive(p, 2e-3, 1e-2)
    actuator_run(step_currents(c["i_cmd"] * 1e-3, 1e-2, 5), n_r, c["p_s"] * 1e6, t_oil, 1e-2, p, s, out, x, 100)
    error = (out[:, 0] - x).reshape(-1, 100)
    error -= error.mean(axis=1, keepdims=True)
    assert np.sqrt(np.mean(error**2)) < 0.7e-6  # one count of the LVDT is 0.76 um
    s, vanes = machine.start(x[0], n_r[0]), np.empty((n, 3, 1))
    machine.place_rings(s, tuple(np.deg2rad(c[k][0]) for k in ("vigv", "vgv1", "vgv2")))
    linkage_run(x, n_r, t_oil, T, 1e-2, machine.p, s, vanes)
    for k, stage in enumerate(("vigv", "vgv1", "vgv2")):
        assert (
            np.sqrt(np.mean((np.rad2deg(vanes[300:, k, 0]) - c[stage][300:]) ** 2)) < 0.006
        )  # a fifth of the potentiometer's noise
    s, speeds = machine.start(x[0], c["n_engine"][0]), np.empty((n, 1))
    engine_run(c["n_dem"], 1e-2, machine.p, s, speeds)
    assert np.max(np.abs(speeds[:, 0] - c["n_engine"])) < 0.01


SHORT = """
import numpy as np
from hil.loop.lockstep import Stimulus, lockstep
from tests.test_effects import everything_on
print(lockstep(Stimulus.of(np.linspace(60.0, 63.0, 30)), seed=5, plant=everything_on()).state_hash)
"""


@pytest.mark.slow
def test_every_effect_on_gives_the_same_bits_without_compiling() -> None:
    run = partial(subprocess.run, [sys.executable, "-c", SHORT], cwd=ROOT, capture_output=True, text=True, check=True)
    found = [run(env={**os.environ, **env}).stdout for env in ({"NUMBA_DISABLE_JIT": "1"}, {})]
    assert found[0] == found[1] and len(found[0].strip()) == 64


# ---- physics: demand and engine --------------------------------------------------------------------------------------


def test_can_delay_shifts_the_demand_by_itself() -> None:
    n = np.interp(T, [0, 3, 10, 12, 18, 40], [60, 60, 95, 95, 70, 70])
    late, prompt = (
        lockstep(Stimulus.of(n, n), plant=machine_with(**e)).columns for e in ({"can_delay": {"delay": 0.15}}, {})
    )
    assert np.allclose(late["x_dem"][15:], prompt["x_dem"][:-15], atol=1e-9)
    assert np.array_equal(late["n_dem"], prompt["n_dem"])  # the log holds what the ECU sent
    assert np.array_equal(late["n_engine"], prompt["n_engine"])


@given(st.floats(0.0, 100.0), st.floats(0.011, 1.0))
def test_held_frame_is_never_older_than_its_period(t, period) -> None:
    content = frame_hold.step(t, period)
    assert -2e-6 <= t - content < period
    assert content / period == pytest.approx(round(content / period), abs=1e-6)


def test_schedule_error_moves_the_demand_by_its_offset_at_any_speed() -> None:
    n = np.interp(T, [0, 40], [60, 95])
    shifted, plain = machine_with(schedule_error={"offset": -0.7}), build_plant()
    run, without = (lockstep(Stimulus.of(n), plant=machine).columns["x_dem"] for machine in (shifted, plain))
    assert np.allclose(run - without, -0.7, atol=1e-9)


def test_twice_the_trend_threshold_needs_twice_the_way_back() -> None:
    n = np.concatenate([np.linspace(60, 70, 500), 70 - 0.02 * np.arange(20), np.full(100, 69.6)])
    for factor, direction in ((1.0, -1.0), (2.0, 1.0)):
        cal = flashed(load_calibration(), machine_with(trend_threshold_error={"factor": factor}))
        z = new_state()
        z[fw.TREND_N] = z[fw.TREND_TURN] = n[0]
        for v in n:
            fw.trend_step(z, cal.k, v)
        assert z[fw.DIRECTION] == direction


def test_controller_gain_error_scales_the_current() -> None:
    weak, plain = servo_of(machine_with(controller_gain_error={"factor": 0.8})), servo_of(build_plant())
    linear = plain < 0.039  # the integral winds up to the limit later
    assert linear.sum() > 1000 and np.allclose(weak[linear], 0.8 * plain[linear], rtol=1e-12)


def test_rotor_trails_a_ramp_by_the_rate_times_the_lag() -> None:
    p, s = lanes_of([{"rotor_lag_error": {"lag": 0.5}}], build_plant())
    out = np.empty((4000, 1))
    ramp = 50.0 + 1.0 * T
    s[places.N_R] = 50.0
    engine_run(ramp, 1e-2, p, s, out)
    # the demand of a sample holds until the next: half a sample later on average
    assert ramp[-1] - out[-1, 0] == pytest.approx(1.7 * 1.0, abs=0.011)


def test_acceleration_limit_error_moves_the_slope_of_a_slam_up_only() -> None:
    machine = machine_with(acceleration_limit_error={"limit": -3.0})
    for target, slope in ((100.0, 5.0), (40.0, -10.0)):
        s = machine.start(0.02, 70.0)
        for _ in range(1000):
            chain.rotor_step(s, machine.p, 0, target)
        assert s[places.N_R, 0] - 70.0 == pytest.approx(slope, rel=1e-9)


# ---- physics: valve and supply ---------------------------------------------------------------------------------------


def test_one_milliampere_of_null_bias_creeps_by_a_fortieth_of_rated_speed() -> None:
    assert speed(machine_with(valve_null_bias={"bias": 1.0}), 0.0) == pytest.approx(0.150 / 40.0, rel=1e-9)


def test_dead_band_lets_its_own_current_pass_nothing() -> None:
    machine = machine_with(valve_dead_band={"half_width": 1.2})
    for i in (-1.2e-3, 0.5e-3, 1.2e-3):
        assert speed(machine, i) == pytest.approx(0.0, abs=1e-12)
    assert speed(machine, 3.2e-3) == pytest.approx(speed(build_plant(), 2e-3), rel=1e-9)
    assert speed(machine, -3.2e-3) == pytest.approx(-speed(build_plant(), 2e-3), rel=1e-9)


def test_valve_hysteresis_is_as_wide_as_it_says_and_keeps_less_of_small_turns() -> None:
    width = 2e-3

    def height_at_zero(amplitude, spread=1.0):
        """Current (A) that counts at zero command, coming down from ``amplitude`` (A), after two rounds between
        +-amplitude.
        """
        plays = (0.0, 0.0, 0.0, 0.0)
        for i in amplitude * np.concatenate(
            [np.sin(np.linspace(0.0, 4.0 * np.pi, 4001)), np.sin(np.linspace(0.0, np.pi, 1001))]
        ):
            plays = valve_hysteresis.step(*plays, i, width, spread)
        return valve_hysteresis.mean(*plays)

    assert height_at_zero(0.02) == pytest.approx(0.5 * width)
    # Rayleigh: the remanence of a small loop grows with the square of its amplitude
    assert height_at_zero(0.1e-3) == pytest.approx(0.0, abs=1e-9) and height_at_zero(0.5e-3) < 0.12 * width
    # one play: nothing below half its width, then all but that half
    assert height_at_zero(0.02, 0.0) == pytest.approx(0.5 * width) and height_at_zero(0.99e-3, 0.0) == pytest.approx(
        0.0, abs=1e-12
    )
    assert height_at_zero(1.5e-3, 0.0) == pytest.approx(0.5e-3)


def test_flow_saturation_limits_the_speed_and_leaves_slower_motion_alone() -> None:
    machine = machine_with(valve_flow_saturation={"limit": 100.0})
    assert speed(machine, 0.040, stroke=0.002) == pytest.approx(0.100, rel=1e-9)
    assert np.array_equal(drive(machine, 0.020, 50)[:, places.X], drive(build_plant(), 0.020, 50)[:, places.X])


def test_a_round_flow_saturation_adds_the_pressure_drops_of_two_orifices_in_series() -> None:
    # dp = (v / a)^2 + (v / b)^2: the speed of both is 1 / sqrt(1 / a^2 + 1 / b^2), of the spool alone a, of the passage
    # alone b
    for current in (0.005, 0.020, 0.040):
        a, b = speed(build_plant(), current, stroke=0.002), 0.100
        both = speed(machine_with(valve_flow_saturation={"limit": 100.0, "roundness": 1.0}), current, stroke=0.002)
        assert both == pytest.approx((a**-2 + b**-2) ** -0.5, rel=1e-9)
        assert (
            speed(machine_with(valve_flow_saturation={"limit": 100.0, "roundness": 0.5}), current, stroke=0.002) > both
        )


def test_valve_lag_reaches_63_per_cent_after_its_time_constant() -> None:
    machine = machine_with(valve_lag={"time_constant": 20.0e-3})
    out = drive(machine, 0.010, 20)
    assert out[-1, places.LAGGED] == pytest.approx(0.010 * (1.0 - np.exp(-1.0)), rel=1e-9)


def test_gain_asymmetry_keeps_the_geometric_mean() -> None:
    machine = machine_with(valve_gain_asymmetry={"ratio": 1.21})
    up, down = speed(machine, 0.004), -speed(machine, -0.004)
    assert up / down == pytest.approx(1.21, rel=1e-9)
    assert np.sqrt(up * down) == pytest.approx(0.015, rel=1e-9)


def test_droop_at_full_spool_solves_the_orifice_with_a_resistance_in_series() -> None:
    machine = machine_with(supply_pressure_droop={"droop": 60.0})
    v = brentq(lambda v: v - 0.150 * np.sqrt((21e6 - 60e6 * v) / 21e6), 0.0, 0.15)
    assert speed(machine, 0.040, stroke=0.002) == pytest.approx(v, rel=1e-9)
    assert supply_pressure_droop.step(0.0, -1e6, 6e7) == 0.0


def test_oil_viscosity_changes_the_speed_in_proportion_to_the_temperature() -> None:
    machine = machine_with(oil_viscosity={"coefficient": -0.003})
    assert speed(machine, 0.004, t_oil=70.0) / speed(machine, 0.004, t_oil=40.0) == pytest.approx(1.0 - 0.09, rel=1e-9)


# ---- physics: actuator -----------------------------------------------------------------------------------------------


@given(st.lists(st.floats(-1e-4, 1e-4), min_size=1, max_size=60), st.floats(10.0, 1e4), st.floats(1e7, 1e9))
def test_piston_friction_never_adds_energy(travels, level, stiffness) -> None:
    z = taken = 0.0
    for travel in travels:
        after = piston_friction.step(z, travel, level, stiffness)
        moved = travel - (after - z) / stiffness
        # friction on the moving piston; the spring of the oil in series stores z^2 / 2k and gives it back
        taken += after * moved
        z = after
        assert abs(z) <= level
        assert taken >= -1e-9 * level


def test_friction_costs_speed_both_ways_and_motion_at_reversals() -> None:
    force = 2000.0
    machine = machine_with(piston_friction={"force": force})
    slower = 0.015 * np.sqrt(1.0 - force / 1.2e-3 / 21e6)
    assert speed(machine, 0.004) == pytest.approx(slower, rel=1e-9)
    assert speed(machine, -0.004) == pytest.approx(-slower, rel=1e-9)
    pushed = 0.0
    z = force
    stiffness = 1.0 / oil_compressibility.NOMINAL
    while z > -force:  # the piston stands while the oil turns the force round
        z, pushed = piston_friction.step(z, -1e-7, force, stiffness), pushed + 1e-7
    assert pushed == pytest.approx(2.0 * force / stiffness, abs=2e-7)


@pytest.mark.slow
@pytest.mark.parametrize("x0", [0.004, 0.024, 0.044])
def test_motion_lost_at_a_reversal_is_that_of_two_chambers_of_oil(x0: float) -> None:
    """The chain against both chambers' pressures integrated: the piston stands until their difference has
    turned round.
    """
    force, area, bulk, dead, p_s, h = 3000.0, 1.2e-3, 1.6e9, 0.0024, 21e6, 1e-6
    p1, p2, x, pushed, lost = 0.5 * (p_s - force / area), 0.5 * (p_s + force / area), x0, [0.0], [0.0]
    opening = 0.015 / np.sqrt(0.5 * p_s)
    while pushed[-1] < 0.003:
        v1, v2 = area * (x + dead), area * (0.048 - x + dead)
        q1, q2 = area * opening * np.sqrt(p_s - p1), area * opening * np.sqrt(p2)
        v = (q1 * v2 + q2 * v1) / (area * (v1 + v2)) if area * (p1 - p2) >= force else 0.0
        pushed.append(
            pushed[-1] + h * opening * np.sqrt(0.5 * (p_s - p1 + p2))
        )  # by a valve whose chambers are in balance
        p1, p2, x = p1 + h * bulk / v1 * (q1 - area * v), p2 + h * bulk / v2 * (area * v - q2), x + h * v
        lost.append(pushed[-1] - (x - x0))
    machine = machine_with(piston_friction={"force": force})
    s = machine.start(x0, 60.0)
    s[places.FRICTION, 0] = -force
    way = 0.0
    compared = []
    while way < 0.0028:
        before = s[places.SPEED, 0]
        chain.drive_step(s, machine.p, 0, 0.004, 60.0, p_s, 40.0)
        way += 0.5e-3 * (before + s[places.SPEED, 0])
        compared.append((way - (s[places.X, 0] - x0), np.interp(way, pushed, lost)))
    ours, theirs = np.array(compared).T
    assert theirs[-1] == pytest.approx(2.0 * force * oil_compressibility.NOMINAL, rel=0.03)
    assert np.max(np.abs(ours - theirs)) < 0.06 * theirs[-1]


def test_stiction_is_a_stribeck_curve_that_slipping_halves() -> None:
    v = np.linspace(0.0, 0.05, 500)
    share = (np.array([piston_stiction.step(500.0, x, 300.0, 0.005) for x in v]) - 500.0) / 300.0
    curve = np.exp(-((v / 0.005) ** 2))
    assert share[0] == 1.0 and np.all(np.diff(share) < 0.0) and share[-1] < 1e-6
    assert np.max(np.abs(share / (0.5 + 0.5 / (1.0 + 100.0 * (v / 0.005) ** 2)) - curve)) < 0.035
    assert piston_stiction.step(500.0, -0.003, 300.0, 0.005) == piston_stiction.step(500.0, 0.003, 300.0, 0.005)


def test_leakage_lets_a_loaded_piston_creep() -> None:
    machine = machine_with(internal_leakage={"coefficient": 1.5}, aero_load={"force": 3000.0})
    lost = 1.5e-9 / 1.2e-3
    assert speed(machine, 0.0) == pytest.approx(-lost * 3000.0 / (1.0 + lost * 1500.0), rel=1e-9)


def test_nominal_oil_is_as_stiff_as_the_textbook_says() -> None:
    bulk, area, stroke = (
        1.6e9,
        1.2e-3,
        0.048,
    )  # Merritt: least stiffness 4 B A^2 / V, V both chambers with 5 % dead volume each
    assert pytest.approx(4.0 * bulk * area**2 / (area * stroke * 1.1), rel=1e-12) == 1.0 / oil_compressibility.NOMINAL


def test_compressible_oil_gives_way_to_a_growing_load() -> None:
    machine = machine_with(oil_compressibility={"compliance": 0.05}, aero_load={"force": 4000.0})
    s = machine.start(0.024, 50.0)
    for n in np.linspace(50.0, 100.0, 200):
        chain.drive_step(s, machine.p, 0, 0.0, n, 21e6, 40.0)
    grown = 4000.0 * (1.0 - 0.25)
    assert s[places.X, 0] - 0.024 == pytest.approx(-(0.05e-6 + oil_compressibility.NOMINAL) * grown, rel=1e-9)


def test_air_load_slows_extension_and_helps_retraction() -> None:
    machine = machine_with(aero_load={"force": 6000.0})
    for n_r in (50.0, 100.0):
        share = 6000.0 * (n_r / 100.0) ** 2 / 1.2e-3 / 21e6
        assert speed(machine, 0.004, n_r=n_r) == pytest.approx(0.015 * np.sqrt(1.0 - share), rel=1e-9)
        assert speed(machine, -0.004, n_r=n_r) == pytest.approx(-0.015 * np.sqrt(1.0 + share), rel=1e-9)


def test_shifted_stops_hold_the_piston() -> None:
    for shift, ends in ((3.0, (0.003, 0.048)), (-5.0, (0.0, 0.043))):
        machine = machine_with(end_stop_shift={"shift": shift})
        assert drive(machine, -0.020, 500)[-1, places.X] == ends[0]
        assert drive(machine, 0.020, 500)[-1, places.X] == pytest.approx(ends[1], abs=1e-15)


# ---- physics: LVDT ---------------------------------------------------------------------------------------------------


@given(*(st.floats(a, b) for a, b in ((0.0, 0.048), (-5, 5), (0.8, 1.25), (-3, 3), (-0.2, 0.2), (0.0, 100.0), (-1, 1))))
def test_true_stroke_undoes_every_effect_of_the_lvdt(x, bias, factor, amplitude, drift, t_oil, cubic) -> None:
    p = np.zeros((library.N_PARAMETERS, 1))
    p[chain.STROKE] = 0.048
    p[ROW["lvdt_bias"]], p[ROW["lvdt_gain"]] = bias * 1e-3, factor
    p[ROW["lvdt_nonlinearity"]], p[ROW["lvdt_thermal_drift"]] = amplitude * 1e-3, drift * 1e-3
    p[ROW["lvdt_nonlinearity"] + 1] = cubic * 1e-3
    assert chain.true_stroke(chain.measured_stroke(x, p, 0, t_oil), p, 0, t_oil) == pytest.approx(x, abs=2e-10)


def test_lvdt_effects_add_up_as_on_a_data_sheet() -> None:
    machine = machine_with(
        lvdt_bias={"bias": 0.2}, lvdt_gain={"factor": 1.01}, lvdt_thermal_drift={"coefficient": 0.002}
    )
    assert chain.measured_stroke(0.020, machine.p, 0, 60.0) == pytest.approx(0.0202 + 0.0002 + 0.00004, abs=1e-15)


def test_lvdt_nonlinearity_is_nil_at_the_ends_and_in_the_middle() -> None:
    wave = [lvdt_nonlinearity.step(q * 0.048, 0.048, 1e-4, 0.0) - q * 0.048 for q in (0.0, 0.25, 0.5, 0.75, 1.0)]
    assert wave == pytest.approx([0.0, -1e-4, 0.0, 1e-4, 0.0], abs=1e-15)


def test_the_windings_cubic_bends_without_a_gain() -> None:
    """Odd about the middle, its size at both ends, and no straight part: a line through it by least squares is
    level.
    """
    q = np.linspace(0.0, 1.0, 20001)
    error = np.array([lvdt_nonlinearity.step(x * 0.048, 0.048, 0.0, 1e-4) - x * 0.048 for x in q])
    assert error[[0, 10000, -1]] == pytest.approx([-1e-4, 0.0, 1e-4], abs=1e-15)
    assert abs(np.polyfit(q, error, 1)[0]) < 1e-7
    step = 1e-7
    for x in (0.0005, 0.011, 0.0475, -0.001, 0.049):
        rise = lvdt_nonlinearity.step(x + step, 0.048, 2e-3, -5e-4) - lvdt_nonlinearity.step(
            x - step, 0.048, 2e-3, -5e-4
        )
        assert lvdt_nonlinearity.slope(x, 0.048, 2e-3, -5e-4) == pytest.approx(rise / (2.0 * step), rel=1e-6)


def test_lvdt_lag_trails_a_moving_piston_by_its_time_constant() -> None:
    machine = machine_with(lvdt_lag={"time_constant": 0.02})
    out = drive(machine, 0.004, 300, stroke=0.002)
    behind_first, behind_both = (
        out[-1, places.X_LVDT] - out[-1, places.READING],
        out[-1, places.X] - out[-1, places.READING],
    )
    assert behind_first == pytest.approx(0.015 * 0.02, rel=5e-3)
    assert behind_both == pytest.approx(0.015 * 0.021, rel=5e-3)


def test_slow_raster_keeps_the_delay_of_the_lvdt() -> None:
    n, i = 200, np.full(200, 0.004)
    same = np.full(n, 40.0)
    for lag, delay in ((0.0, 1e-3), (0.03, 31e-3)):
        p, s = lanes_of([{"lvdt_lag": {"time_constant": lag}}], build_plant())
        derive(p, 2e-3, 1e-2)
        out = np.empty((n, 1))
        s[places.X] = s[places.X_LVDT] = s[places.READING] = 0.002
        actuator_run(step_currents(i, 1e-2, 5), same, np.full(n, 21e6), same, 1e-2, p, s, out)
        assert s[places.X, 0] - out[-1, 0] == pytest.approx(0.015 * delay, rel=1e-3)


# ---- physics: linkage ------------------------------------------------------------------------------------------------


def loop_of(machine, k, *, t=0.0, turns=(1e-3, 47e-3)):
    """Angles (deg) behind the play of stage ``k`` while the stroke goes up and down, on the same strokes."""
    strokes = np.concatenate([np.linspace(*turns, 2000), np.linspace(*turns[::-1], 2000)])
    s = machine.start(turns[0], 60.0)
    g = machine.p[GEOMETRY:, 0]
    out = np.empty(len(strokes))
    for i, x in enumerate(np.concatenate([strokes, strokes])):  # the second round counts
        c, d = chain.crank(x, *g[:4])
        out[i % 4000] = np.rad2deg(chain.stem_angle(s, machine.p, 0, k, c, d, 60.0, 40.0, t))
    return out[:2000], out[2000:][::-1]


def width_of(machine, k, **conditions):
    up, down = loop_of(machine, k, **conditions)
    return float(np.mean((down - up)[300:1700]))


def test_backlash_widens_the_loop_at_the_vane() -> None:
    for extra, width in ((0.5, 1.6), (-0.6, 0.5), (-1.1, 0.0)):
        assert width_of(machine_with(linkage_backlash={"vgv1": extra}), 1) == pytest.approx(width, rel=0.03, abs=1e-9)


def test_wear_widens_the_loop_with_time() -> None:
    machine = machine_with(linkage_wear={"vgv2": 0.6})
    nominal = width_of(machine, 2)
    assert nominal == pytest.approx(0.8, rel=0.03)
    assert width_of(machine, 2, t=1800.0) - nominal == pytest.approx(0.3, rel=0.03)


def test_compliance_loses_angle_with_the_square_of_speed() -> None:
    c = si("linkage_compliance", "compliance", 0.2)
    assert linkage_compliance.step(0.1, 100.0, c) == pytest.approx(0.1 - 0.2 * DEG)
    lost = [0.1 - linkage_compliance.step(0.1, n, c) for n in (50.0, 100.0)]
    assert lost[1] / lost[0] == pytest.approx(4.0)


@given(st.floats(-1.0, 1.0), st.floats(1e-6, 0.1), st.integers(2, 9), st.sampled_from([-1.0, 1.0]))
def test_linkage_friction_counts_travel_not_time(y, travel, parts, sign) -> None:
    whole, pieces = linkage_friction.step(y, sign * travel, 3e-3), y
    for _ in range(parts):
        pieces = linkage_friction.step(pieces, sign * travel / parts, 3e-3)
    assert pieces == pytest.approx(whole, abs=1e-12) and -1.0 <= whole <= 1.0


def test_linkage_friction_closes_to_1_over_e_over_its_distance() -> None:
    assert 1.0 - linkage_friction.step(-1.0, 2e-3, 2e-3) == pytest.approx(2.0 * np.exp(-1.0))
    machine = machine_with(linkage_friction={"vigv": 0.7, "distance": 0.2})
    assert width_of(machine, 0) == pytest.approx(1.6 + 0.7, rel=0.03)


@given(st.lists(st.floats(-0.01, 0.01), min_size=2, max_size=40))
def test_linkage_friction_takes_energy_on_every_closed_path(steps) -> None:
    path = [*steps, -sum(steps)]
    y, work = 0.0, 0.0
    for _ in range(30):  # until the loop repeats
        work = 0.0
        for a in path:
            before, y = y, linkage_friction.step(y, a, 2e-3)
            # the bristle's force over an exact exponential: integral of y = s a - d (y - before), s = sign(a)
            work += abs(a) - 2e-3 * (y - before) * np.sign(a) if a else 0.0
    assert work >= -1e-12


def test_thermal_growth_turns_the_vane_by_its_coefficient() -> None:
    machine, k = machine_with(thermal_growth={"vgv2": 0.02}), 2
    g = machine.p[GEOMETRY:, 0]
    c, d = chain.crank(0.024, *g[:4])
    angles = []
    for t_oil in (40.0, 65.0):
        s = machine.start(0.024, 60.0, t_oil)
        angles.append(np.rad2deg(chain.stem_angle(s, machine.p, 0, k, c, d, 60.0, t_oil, 0.0)))
    assert angles[1] - angles[0] == pytest.approx(0.02 * 25.0, rel=0.05)


@pytest.mark.parametrize(
    ("name", "row", "size"), [("crank_length_error", G_LB, 1.5), ("link_length_error", G_LC, -0.8)]
)
def test_length_errors_are_those_of_the_linkages_equations(name, row, size) -> None:
    machine = machine_with(**{name: {"vgv1": size}})
    g = build_plant().geometry.arrays()
    g[N_CRANK + N_PER_STAGE + row] += size * 1e-3
    for x in (0.005, 0.024, 0.043):
        s = machine.start(x, 60.0)
        assert s[places.POT : places.POT + 3, 0] == pytest.approx(vane_angles(x, g)[0], abs=1e-12)


def test_one_millimetre_of_link_is_the_published_offset() -> None:
    angles = [machine_with(link_length_error={"vigv": e}).start(0.024, 60.0)[places.POT, 0] for e in (0.0, 1.0)]
    assert np.rad2deg(angles[1] - angles[0]) == pytest.approx(-1.6, abs=0.1)


def test_eccentricity_adds_a_sine_of_the_rings_own_angle() -> None:
    assert ring_eccentricity.step(0.1, 0.003, 0.4) == pytest.approx(0.1 + 0.003 * np.sin(0.5))


def test_potentiometer_reads_gain_times_angle_plus_bias() -> None:
    plain = build_plant().start(0.010, 60.0)[places.POT : places.POT + 3, 0]
    machine = machine_with(pot_bias={"vgv1": 0.4}, pot_gain={"vigv": 1.02, "vgv1": 0.98})
    expected = [1.02 * plain[0], 0.98 * plain[1] + 0.4 * DEG, plain[2]]
    assert machine.start(0.010, 60.0)[places.POT : places.POT + 3, 0] == pytest.approx(expected, abs=1e-12)


def test_potentiometer_lag_trails_moving_vanes() -> None:
    x = 1e-3 * (5.0 + 8.0 * T[:400])
    same = np.full(400, 60.0)
    out = {}
    for lag in (0.0, 0.04):
        p, s = lanes_of([{"pot_lag": {"vigv": lag}}], build_plant())
        out[lag] = np.empty((400, 3, 1))
        linkage_run(x, same, np.full(400, 40.0), T[:400], 1e-2, p, s, out[lag])
    late, prompt = out[0.04][:, 0, 0], out[0.0][:, 0, 0]
    assert np.array_equal(out[0.04][:, 1], out[0.0][:, 1])
    assert np.interp(T[300] - 0.04, T[:400], prompt) == pytest.approx(late[300], abs=2e-5)


# ---- model files -----------------------------------------------------------------------------------------------------


def test_model_file_comes_back_as_it_was_written(tmp_path) -> None:
    model = Model(
        parameters={"actuator.flow_gain": 0.147, "linkage.vigv_play": 1.7},
        effects={"valve_dead_band": {"half_width": 1.25}, "pot_lag": {"vigv": 0.01, "vgv2": 1e-3}, "aero_load": {}},
        meta={"note": 'a "quoted" word', "history": ["one", "two"]},
    )
    write_model(tmp_path / "m.toml", model)
    assert load_model(tmp_path / "m.toml") == model


def test_model_fills_the_plants_rows_in_si() -> None:
    plain = build_plant()
    model = Model(
        parameters={"linkage.vigv_play": 1.7, "actuator.flow_gain": 0.147}, effects={"lvdt_bias": {"bias": 0.3}}
    )
    machine = build_plant(model=model)
    assert machine.p[ROW["lvdt_bias"], 0] == pytest.approx(3e-4)
    assert machine.p[chain.PLAY, 0] / plain.p[chain.PLAY, 0] == pytest.approx(1.7 / 1.6)
    assert machine.p[chain.FLOW_GAIN, 0] == 0.147
    assert np.array_equal(Model().plant().p, plain.p)
    assert replace(machine, p=plain.p).table is machine.table


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[effects.valve_deadband]\nx = 1.0", "probably 'valve_dead_band' is meant"),
        ("[effects.valve_dead_band]\nhalfwidth = 1.0", "probably 'half_width' is meant; allowed: half_width"),
        ("[effects.valve_dead_band]\nhalf_width = nan", "finite"),
        ("[effects.valve_dead_band]\nhalf_width = 99", "(=99 mA) must be in [0, 20]"),
        ('[parameters]\n"actuator.flow_gian" = 0.1', "probably 'actuator.flow_gain' is meant"),
        ('[parameters]\n"actuator.flow_gain" = 0.3', "(=0.3 m/s) must be in [0.12, 0.18]"),
        ('[parameters]\n"actuator.stroke" = -3.0', "must be in [1, 1000]"),
        ("[effect]\nx = 1", "probably 'effects' is meant"),
    ],
)
def test_model_file_that_cannot_be_used_is_refused_in_one_line(tmp_path, text, words) -> None:
    (tmp_path / "m.toml").write_text(text)
    with pytest.raises(InputError) as e:
        load_model(tmp_path / "m.toml")
    assert words in str(e.value) and "m.toml" in str(e.value) and "\n" not in str(e.value)
