"""The electromechanical actuator: its balances and responses in closed form, what it may never do, and that the loop,
the search and the design work with it.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import StateSpace, lsim

from controller.records import RUN
from hil import inject
from hil.engine_test import load_profile
from hil.logs import Channel, Log
from hil.loop.lockstep import Stimulus, lockstep
from plant import Model, build_plant, chain, places
from plant import parameters as rows
from plant.effects import EFFECTS, STATE
from plant.machine import Plant
from tests import rig
from tests.firmware_on_rig import firmware
from vaneloop.base.errors import InputError
from vaneloop.base.tables import path
from vaneloop.cli.main import main
from vaneloop.design.servo import default_gains, margins
from vaneloop.design.servo_motor import plant_of_tables
from vaneloop.identification.vane_chain.chain import build_chain
from vaneloop.verbs.search import diagnosed

TABLE = "plant_electromechanical.toml"
MACHINE = build_plant(TABLE)
P = MACHINE.p[:, 0]
R = P[rows.SCREW_LEAD] / (2.0 * math.pi * P[rows.GEAR_RATIO])  # m/rad
INERTIA = P[rows.MOTOR_INERTIA] + P[rows.GEAR_INERTIA] + P[rows.SCREW_MASS] * R * R
RATE = P[rows.SPEED_GAIN] / P[rows.SPEED_TIME]  # A/rad
LOSS = 1.0 / P[rows.SCREW_EFFICIENCY] - 1.0
STROKE = 0.048


def with_rows(**values: float) -> Plant:
    """The nominal machine with these rows of its parameters, SI."""
    from dataclasses import replace

    p = MACHINE.p.copy()
    for name, value in values.items():
        p[getattr(rows, name)] = value
    rows.derive(p, chain.TICK / chain.SUBSTEPS, chain.TICK)
    return replace(MACHINE, p=p)


def with_effects(**effects: dict[str, float]) -> Plant:
    return Model(effects=effects).plant(MACHINE)


def drive(machine: Plant, current, ticks: int, *, n_r: float = 0.0, t: float = 40.0, stroke: float = 0.024):
    """States of every tick under a current (A): float64[ticks, rows]."""
    s, out = machine.start(stroke, n_r, t), np.empty((ticks, chain.N_STATE))
    for k in range(ticks):
        chain.drive_step(s, machine.p, 0, current if np.isscalar(current) else current[k], n_r, 0.0, t)
        out[k] = s[:, 0]
    return out


# ---- balances --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("force", [-6000.0, 0.0, 6000.0])
@pytest.mark.parametrize("current", [-4e-3, 4e-3])
def test_steady_speed_is_the_rated_one_and_the_motor_carries_load_and_friction(force: float, current: float) -> None:
    out = drive(with_effects(aero_load={"force": force}), current, 500, n_r=100.0)
    speed = P[rows.RATED_SPEED] * current / P[rows.RATED_CURRENT]
    assert (out[-1, places.X] - out[-101, places.X]) / 0.1 == pytest.approx(speed, rel=1e-3)
    w, sign = speed / R, math.copysign(1.0, current)
    torque = force * R + P[rows.SCREW_VISCOUS] * w + sign * R * (P[rows.SCREW_FRICTION] + abs(force) * LOSS)
    assert out[-1, places.I_MOTOR] == pytest.approx(torque / P[rows.TORQUE_CONSTANT], rel=2e-3)


def test_lifting_takes_load_over_efficiency_and_lowering_gives_two_less_one_over_efficiency() -> None:
    machine = with_rows(SCREW_FRICTION=0.0, SCREW_VISCOUS=0.0)
    force, eta = 8000.0, P[rows.SCREW_EFFICIENCY]
    loaded = Model(effects={"aero_load": {"force": force}}).plant(machine)
    up, down = (drive(loaded, i, 500, n_r=100.0)[-1, places.I_MOTOR] for i in (3e-3, -3e-3))
    assert up * P[rows.TORQUE_CONSTANT] == pytest.approx(force * R / eta, rel=2e-3)
    assert down * P[rows.TORQUE_CONSTANT] == pytest.approx(force * R * (2.0 - 1.0 / eta), rel=2e-3)


def unpowered(force: float, **values: float) -> np.ndarray:
    machine = with_rows(SPEED_GAIN=0.0, **values)
    loaded = Model(effects={"aero_load": {"force": force}}).plant(machine)
    s, out = loaded.start(0.024, 100.0), np.empty(100)
    s[[places.I_MOTOR, places.SPEED_INTEGRAL]] = 0.0
    for k in range(100):
        chain.drive_step(s, loaded.p, 0, 0.0, 100.0, 0.0, 40.0)
        out[k] = s[places.MOTOR_SPEED, 0]
    return out


def test_a_load_drives_the_unpowered_motor_from_the_back_driving_force_on() -> None:
    threshold = P[rows.SCREW_FRICTION] / (1.0 - LOSS)  # f / (2 - 1/eta)
    assert not unpowered(-0.99 * threshold).any()  # exact rest
    assert not unpowered(0.99 * threshold).any()
    w = unpowered(1.5 * threshold, SCREW_VISCOUS=0.0)
    torque = R * (1.5 * threshold * (1.0 - LOSS) - P[rows.SCREW_FRICTION])
    assert w[-1] == pytest.approx(-torque / INERTIA * 0.1, rel=1e-6)


def test_a_screw_of_half_efficiency_locks_itself_under_any_load() -> None:
    assert not unpowered(20000.0, SCREW_EFFICIENCY=0.4999, SCREW_FRICTION=0.0).any()
    assert unpowered(20000.0, SCREW_EFFICIENCY=0.51, SCREW_FRICTION=0.0)[-1] < -1.0


@pytest.mark.parametrize("current, stop", [(0.04, STROKE), (-0.04, 0.0)])
def test_a_motor_stalled_at_its_stop_takes_its_peak_current_and_leaves_when_told_to(
    current: float, stop: float
) -> None:
    out = drive(MACHINE, np.repeat([current, -0.25 * current], [600, 300]), 900)
    assert np.array_equal(out[500:600, places.X], np.full(100, stop)) and not out[500:600, places.MOTOR_SPEED].any()
    assert out[599, places.I_MOTOR] == pytest.approx(math.copysign(P[rows.PEAK_CURRENT], current), rel=1e-9)
    away = abs(out[899, places.X] - stop)
    assert away == pytest.approx(0.25 * P[rows.RATED_SPEED] * 0.3, rel=0.1)


def test_bus_voltage_limits_the_speed_to_what_back_emf_leaves() -> None:
    machine = with_rows(VOLTAGE=60.0)
    w = drive(machine, 0.04, 400, stroke=0.001)[-1, places.MOTOR_SPEED]
    i = (P[rows.SCREW_VISCOUS] * w + P[rows.SCREW_FRICTION] * R) / P[rows.TORQUE_CONSTANT]
    assert w == pytest.approx((60.0 - P[rows.RESISTANCE] * i) / P[rows.TORQUE_CONSTANT], rel=1e-3)


# ---- responses -------------------------------------------------------------------------------------------------------


def test_without_friction_the_speed_follows_the_linear_response_of_its_loop() -> None:
    """Against scipy's solution of current loop, integral and motor as three linear equations, written anew here."""
    machine = with_rows(SCREW_FRICTION=0.0)
    kp, band = P[rows.SPEED_GAIN], 2.0 * math.pi * P[rows.CURRENT_BANDWIDTH]
    kt, b = P[rows.TORQUE_CONSTANT], P[rows.SCREW_VISCOUS]
    a = [[-band, band, -band * kp], [0.0, 0.0, -RATE], [kt / INERTIA, 0.0, -b / INERTIA]]  # i, I, w
    system = StateSpace(a, [[band * kp], [RATE], [0.0]], [[0.0, 0.0, 1.0]], [[0.0]])
    t = np.arange(0.0, 0.3, 1e-4)
    target = P[rows.RATED_SPEED] / R * 2e-3 / P[rows.RATED_CURRENT]
    _, linear, _ = lsim(system, np.full(len(t), target), t)
    w = drive(machine, 2e-3, 300)[:, places.MOTOR_SPEED]
    assert np.max(np.abs(w[:-1] - linear[10::10][: len(w) - 1])) < 0.02 * target
    assert w[-1] == pytest.approx(linear[-1], rel=1e-3)


@pytest.mark.slow
def test_a_finer_step_changes_next_to_nothing() -> None:
    current = 1e-3 * (2.0 * np.sin(0.02 * np.arange(3000)) + np.sin(0.13 * np.arange(3000)))
    coarse = drive(MACHINE, current, 3000)[:, places.X]
    p, s, fine = MACHINE.p.copy(), MACHINE.start(0.024, 0.0), np.empty(3000)
    rows.derive(p, chain.TICK / 100, chain.TICK)
    for k in range(3000):
        chain.drive_step(s, p, 0, current[k], 0.0, 0.0, 40.0, chain.TICK, 100)
        fine[k] = s[places.X, 0]
    assert np.max(np.abs(coarse - fine)) < 2e-6  # the LVDT's noise is 5e-6


def test_rest_stays_rest_to_the_last_bit_with_and_without_a_load() -> None:
    for force in (0.0, 7000.0, -7000.0):
        out = drive(with_effects(aero_load={"force": force}), 0.0, 2000, n_r=100.0)
        for place in (places.X, places.MOTOR_SPEED, places.I_MOTOR, places.SPEED_INTEGRAL, places.X_LVDT):
            assert np.array_equal(out[:, place], np.full(2000, out[0, place]))
        assert out[0, places.X] == 0.024 and out[0, places.MOTOR_SPEED] == 0.0


def test_a_slow_command_sticks_without_chatter_until_the_integral_breaks_it_loose() -> None:
    current = 2e-5  # 0.075 mm/s
    w = drive(MACHINE, current, 3000)[:, places.MOTOR_SPEED]
    moves = np.flatnonzero(w != 0.0)
    target = P[rows.RATED_SPEED] / R * current / P[rows.RATED_CURRENT]
    loose = (P[rows.SCREW_FRICTION] * R / P[rows.TORQUE_CONSTANT] - P[rows.SPEED_GAIN] * target) / (RATE * target)
    assert moves[0] * 1e-3 == pytest.approx(loose, abs=0.005)
    assert np.all(w >= 0.0)


def test_a_load_pushes_the_resting_rod_by_the_screws_bend_and_by_what_the_integral_needs() -> None:
    machine = with_rows(SCREW_FRICTION=0.0, SCREW_EFFICIENCY=1.0)
    loaded = Model(effects={"aero_load": {"force": 8000.0}}).plant(machine)
    s = loaded.start(0.024, 0.0)
    for _ in range(1000):
        chain.drive_step(s, loaded.p, 0, 0.0, 100.0, 0.0, 40.0)
    held = 8000.0 * R / P[rows.TORQUE_CONSTANT]  # A
    pushed = 8000.0 / P[rows.SCREW_STIFFNESS] + R * held / RATE
    assert 0.024 - s[places.X, 0] == pytest.approx(pushed, rel=1e-3)


# ---- what it may never do --------------------------------------------------------------------------------------------


@settings(max_examples=25, deadline=None)
@given(
    st.lists(st.floats(-0.04, 0.04), min_size=4, max_size=30),
    st.floats(-15000.0, 15000.0),
    st.floats(0.2, 1.0),
    st.floats(0.0, 4000.0),
)
def test_friction_screw_and_stops_never_add_energy(currents, force: float, efficiency: float, friction: float) -> None:
    """Step by step the motor's energy grows by no more than motor and load put into it."""
    machine = with_rows(SCREW_EFFICIENCY=efficiency, SCREW_FRICTION=friction)
    machine = Model(effects={"aero_load": {"force": force}}).plant(machine)
    s, h = machine.start(0.024, 100.0), chain.TICK / chain.SUBSTEPS
    for i in currents:
        for _ in range(20):
            before = s[places.MOTOR_SPEED, 0]
            chain.drive_step(s, machine.p, 0, i, 100.0, 0.0, 40.0, h, 1)
            w = s[places.MOTOR_SPEED, 0]
            given_in = h * w * (P[rows.TORQUE_CONSTANT] * s[places.I_MOTOR, 0] - force * R)
            assert 0.5 * INERTIA * (w * w - before * before) <= given_in + 1e-12


@settings(max_examples=25, deadline=None)
@given(st.lists(st.floats(-0.04, 0.04), min_size=2, max_size=30), st.integers(0, 2**32 - 1))
def test_any_command_and_any_effects_keep_current_stroke_and_speed_bounded(currents, seed: int) -> None:
    rng = np.random.default_rng(seed)
    effects = {
        e.name: {p.name: float(rng.choice([p.low, p.neutral, p.high])) for p in e.parameters}
        for e in EFFECTS.values()
        if MACHINE.kind in e.kinds and e.site in ("amplifier", "motor", "screw", "actuator", "lvdt")
    }
    out = drive(with_effects(**effects), np.repeat(currents, 40), 40 * len(currents), n_r=100.0, t=90.0)
    assert np.isfinite(out).all()
    assert np.all((out[:, places.X] >= 0.0) & (out[:, places.X] <= STROKE))
    assert np.max(np.abs(out[:, places.I_MOTOR])) <= P[rows.PEAK_CURRENT] * (1.0 + 1e-12)
    assert np.max(np.abs(out[:, places.MOTOR_SPEED])) < 20_000.0


# ---- effects ---------------------------------------------------------------------------------------------------------


def steady(machine: Plant, current: float, t: float = 40.0) -> float:
    x = drive(machine, current, 500, t=t)[:, places.X]
    return float((x[-1] - x[-101]) / 0.1)


def test_offset_dead_band_and_drift_change_the_speed_as_they_say() -> None:
    gain = P[rows.RATED_SPEED] / P[rows.RATED_CURRENT]
    assert steady(with_effects(amplifier_offset={"offset": -1.0}), 4e-3) == pytest.approx(3e-3 * gain, rel=1e-3)
    band = with_effects(amplifier_dead_band={"half_width": 1.5})
    assert steady(band, 4e-3) == pytest.approx(2.5e-3 * gain, rel=1e-3)
    assert steady(band, 1.4e-3) == 0.0
    warm = with_effects(tacho_thermal_drift={"coefficient": 2e-3})
    assert steady(warm, 4e-3, t=80.0) == pytest.approx(4e-3 * gain * 1.08, rel=1e-3)


def test_lag_before_the_speed_loop_delays_a_ramp_by_its_time_constant() -> None:
    ramp = 1e-3 + 4e-3 * np.arange(1500) * 1e-3
    speeds = [
        drive(m, ramp, 1500)[-1, places.MOTOR_SPEED]
        for m in (MACHINE, with_effects(amplifier_lag={"time_constant": 0.02}))
    ]
    slope = P[rows.RATED_SPEED] / R / P[rows.RATED_CURRENT] * 4e-3
    assert (speeds[0] - speeds[1]) / slope == pytest.approx(0.02, rel=0.01)


def lost_at_reversal(machine: Plant) -> float:
    """Stroke (m) that a reversal loses: how far the run there and back ends beyond its start."""
    there_and_back = np.repeat([0.0, 3e-3, -3e-3], [10, 1000, 1000])
    x = drive(machine, there_and_back, 2010)[:, places.X]
    return float(x[-1] - x[1009] + (x[1009] - x[509]) * 2.0)


def test_a_reversal_loses_the_whole_play() -> None:
    more = lost_at_reversal(with_effects(gear_backlash={"width": 0.08})) - lost_at_reversal(MACHINE)
    assert more == pytest.approx(0.08e-3, rel=0.01)


def test_a_reversal_loses_twice_the_friction_over_the_integral_gain() -> None:
    more = lost_at_reversal(with_effects(screw_friction={"force": 800.0})) - lost_at_reversal(MACHINE)
    assert more == pytest.approx(2.0 * 800.0 * R / P[rows.TORQUE_CONSTANT] / RATE * R, rel=0.02)


def test_a_weak_motor_gives_less_torque_at_stall_and_more_speed_at_the_bus_limit() -> None:
    weak = with_effects(motor_torque_constant_error={"factor": 0.5})
    force = (
        0.6 * P[rows.PEAK_CURRENT] * P[rows.TORQUE_CONSTANT] / R
    )  # the healthy motor lifts it, the weak one does not
    up = [
        drive(Model(effects={"aero_load": {"force": force}, **more}).plant(MACHINE), 4e-3, 300, n_r=100.0)[-1, places.X]
        for more in ({}, {"motor_torque_constant_error": {"factor": 0.5}})
    ]
    assert up[0] > 0.0245 and up[1] < 0.0241
    low = weak.p.copy()
    low[rows.VOLTAGE] = 60.0
    s = weak.start(0.001, 0.0)
    for _ in range(200):
        chain.drive_step(s, low, 0, 0.04, 0.0, 0.0, 40.0)
    assert (
        s[places.MOTOR_SPEED, 0] > 1.7 * drive(with_rows(VOLTAGE=60.0), 0.04, 200, stroke=0.001)[-1, places.MOTOR_SPEED]
    )


def test_a_screws_pitch_error_is_a_sine_of_its_lead() -> None:
    bent = with_effects(screw_pitch_error={"amplitude": 0.04, "phase": 0.0})
    a, b = (drive(m, 4e-3, 2000, stroke=0.010)[:, places.X] for m in (MACHINE, bent))
    off, lead = b - a, P[rows.SCREW_LEAD]
    turns = 2.0 * np.pi * b / lead
    parts = np.column_stack([np.sin(turns), np.cos(turns), np.ones(len(b)), b])
    sine, cosine, *_ = np.linalg.lstsq(parts[300:], off[300:], rcond=None)[0]
    assert math.hypot(sine, cosine) == pytest.approx(0.04e-3, rel=0.03) and abs(cosine) < 0.1 * sine


# ---- the loop --------------------------------------------------------------------------------------------------------


def test_the_firmware_reaches_run_and_tracks_and_the_run_repeats_bit_for_bit() -> None:
    n_dem = load_profile()[:30000]
    runs = [lockstep(Stimulus.of(n_dem), plant=build_plant(TABLE), seed=3) for _ in range(2)]
    c = runs[0].columns
    assert runs[0].state_hash == runs[1].state_hash and runs[0].faults == 0
    assert np.all(c["state"] == RUN)
    assert np.sqrt(np.mean((c["x_dem"] - c["x_lvdt"]) ** 2)) < 0.02
    assert 0.1 < np.max(np.abs(c["i_motor"])) < P[rows.PEAK_CURRENT]


def test_every_number_of_the_machine_is_finite() -> None:
    assert np.all(np.isfinite(P))


def test_each_machine_is_fingerprinted_by_the_states_it_has() -> None:
    hydraulic = [STATE[r] for r in build_plant().rows]
    electric = [STATE[r] for r in MACHINE.rows]
    assert "spool" in hydraulic and "i_motor" not in hydraulic and "gear_backlash.ahead" not in hydraulic
    assert "spool" not in electric and "i_motor" in electric and "piston_friction.force" not in electric
    assert "i_motor" not in lockstep(Stimulus.of(np.full(20, 60.0)), hashed=False).columns


def test_loss_of_oil_is_refused_where_there_is_none() -> None:
    with pytest.raises(InputError, match="takes no oil"):
        inject.run("supply_lost", plant=MACHINE)
    assert inject.run("demand_stops", plant=MACHINE).held


# ---- bad input -------------------------------------------------------------------------------------------------------


def refused(text: str, tmp_path, capsys) -> str:
    file = tmp_path / "plant.toml"
    file.write_text(text, encoding="utf-8")
    assert main(["design", "--plant", str(file), "--quiet"]) == 2
    said = capsys.readouterr().err.strip()
    assert "\n" not in said and str(file) in said
    return said


def test_a_wrong_kind_a_section_of_the_other_kind_and_a_missing_key_get_one_line(tmp_path, capsys) -> None:
    good, oil = (path(name).read_text(encoding="utf-8") for name in (TABLE, "plant.toml"))
    steam = refused(good.replace('"electromechanical"', '"steam"'), tmp_path, capsys)
    assert "actuator.kind (='steam') must be one of hydraulic, electromechanical" in steam
    valve = oil[oil.index("[valve]") : oil.index("[actuator]")]
    assert "'valve' is unknown" in refused(good + valve, tmp_path, capsys)
    screw = good[good.index("[screw]") : good.index("[supply]")]
    assert "'screw' is unknown" in refused(oil + screw, tmp_path, capsys)
    lead = next(line for line in good.splitlines() if line.startswith("lead ="))
    assert "'screw.lead' is missing" in refused(good.replace(lead, ""), tmp_path, capsys)
    assert "must be in [0.1, 1]" in refused(good.replace("value = 0.9, ", "value = 1.9, "), tmp_path, capsys)


def test_a_model_file_may_name_only_effects_and_parameters_that_the_machine_has() -> None:
    with pytest.raises(InputError, match="'valve_dead_band' is of an actuator of kind hydraulic"):
        Model(effects={"valve_dead_band": {"half_width": 1.0}}).plant(MACHINE)
    with pytest.raises(InputError, match="'gear_backlash' is of an actuator of kind electromechanical"):
        Model(effects={"gear_backlash": {"width": 0.1}}).plant()
    with pytest.raises(InputError, match=r"'actuator.flow_gain' is unknown"):
        Model(parameters={"actuator.flow_gain": 0.15}).plant(MACHINE)
    with pytest.raises(InputError, match=r"drive.rated_speed \(=0.3 m/s\) must be in"):
        Model(parameters={"drive.rated_speed": 0.3}).plant(MACHINE)
    assert Model(parameters={"screw.friction": 600.0}).plant(MACHINE).p[rows.SCREW_FRICTION, 0] == 600.0


# ---- design ----------------------------------------------------------------------------------------------------------


def test_the_shipped_gains_keep_their_margins_around_the_motor_at_every_corner() -> None:
    plant = plant_of_tables(TABLE)
    s = 2j * np.pi * np.array([1e-6, 0.1])
    assert plant.response(s)[0] == pytest.approx(1.0, abs=1e-3) and plant.speed_per_ampere == pytest.approx(3.75)
    gains = default_gains()
    for corner, around in plant.corners():
        m = margins(gains, around, 2.0 * np.pi * np.geomspace(0.05, 499.0, 300))
        assert m.stable and m.gain_margin_db > 8.0 and m.phase_margin_deg > 50.0, corner(m).describe()


# ---- against the independent rig -------------------------------------------------------------------------------------


def log_of(seed: int, hidden=(), seconds: float = 60.0, **options) -> Log:
    columns = dict(rig.simulate(rig.manoeuvre(seed, seconds), firmware(), hidden, seed=seed, motor=True, **options).log)
    t = columns.pop("t")
    del columns["p_s"]  # there is no oil
    return Log("rig", {k: Channel(t, v) for k, v in columns.items()}, [])


def test_the_actuator_stage_explains_a_noise_free_run_of_the_rig() -> None:
    """Two masses, a spring, a winding and LuGre friction there; one inertia and implicit friction here."""
    chain_ = build_chain(log_of(5, noise=False, randomised=False, jitter=0.0), MACHINE)
    assert not any("p_s" in note for note in chain_.notes)
    stage = chain_.stage("actuator")
    error = stage.run(stage.neutral()[None])[0, 0] - stage.measured[0]
    width = round(stage.window / 0.01)
    error = error[: len(error) // width * width].reshape(-1, width)
    error = (error - error.mean(axis=1, keepdims=True))[np.isfinite(error).all(axis=1)]
    moved = np.ptp(stage.measured[0][np.isfinite(stage.measured[0])])
    assert moved > 5.0 and np.sqrt(np.mean(error**2)) < 0.003  # mm; the LVDT's noise is 0.005


@pytest.mark.slow
@pytest.mark.parametrize("name", ["none", "amplifier_dead_band", "gear_backlash"])
def test_the_search_names_what_the_rig_hides(name: str) -> None:
    hidden = [] if name == "none" else [rig.draw(name, 3, np.random.default_rng(9))]
    chain_ = build_chain(log_of(41, hidden, 150.0), MACHINE)
    chain_.stages = [chain_.stage("actuator")]
    found = diagnosed(chain_, "rig").diagnosis.stages[0]
    assert [f.effect for f in found.effects] == ([] if name == "none" else [name])
