"""The firmware against inputs that a machine, a bus or a bad day can give it: direction, tables, sensor, loop, modes,
faults, purity.

Times in the names of faults and modes are held to the calibration tick by tick: sample ``n`` of a fault time of ``n``
ticks is the one that sets it.
"""

# ruff: noqa: D103 - a test's name is its claim
from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit

from tests import columns as fw
from tests.columns import (
    DEGRADED,
    FAIL_SAFE,
    INIT,
    MODES,
    N_INPUTS,
    N_STATE,
    RUN,
    STANDBY,
    load_calibration,
    look_up,
    new_state,
    servo_step,
    tick,
    trend_step,
)
from tests.conftest import examples
from vaneloop.base.vanes import VANES

CAL = load_calibration()
SINGLE = load_calibration(strategy="single")
INVERSE = load_calibration(strategy="inverse")
ADAPTIVE = load_calibration(strategy="adaptive")
ROOT = Path(__file__).resolve().parent.parent

# columns of a test's inputs: the controller's own, then how the LVDT column is meant and how strong the actuator is
MEASURED, STRENGTH, N_COLUMNS = N_INPUTS, N_INPUTS + 1, N_INPUTS + 2
NOMINAL_GAIN = 0.150 / 0.040  # m/s per A


def k(name: str) -> float:
    return float(CAL.k[fw.SCALARS.index(name)])


def ticks(name: str) -> int:
    """A calibrated time in ticks."""
    return round(k(name) / fw.TICK)


def changed(**values: float):
    """The calibration with some scalars changed, in SI."""
    scalars = CAL.k.copy()
    for name, value in values.items():
        scalars[fw.SCALARS.index(name)] = value
    return CAL._replace(k=scalars)


@njit(error_model="numpy")
def drive(inputs, z, cal, piston, out):
    """Run the controller on a piston that integrates its current: piston = [stroke m, spool current A, null bias A]."""
    row = np.empty(N_INPUTS)
    for i in range(inputs.shape[0]):
        for q in range(N_INPUTS):
            row[q] = inputs[i, q]
        if inputs[i, MEASURED] == 1.0:
            row[fw.IN_X_LVDT] += piston[0]
        tick(row, z, cal)
        out[i] = z
        piston[1] += 0.3 * (z[fw.I_CMD] - piston[1])  # 60 Hz valve
        speed = inputs[i, STRENGTH] * NOMINAL_GAIN * (piston[1] + piston[2])
        piston[0] = min(max(piston[0] + speed * fw.TICK, 0.0), 0.048)


class Rig:
    """A controller and its piston, played through frames; keeps every tick's state."""

    def __init__(self, cal=CAL, stroke=0.020, bias=0.0):
        self.cal, self.z = cal, new_state()
        self.piston = np.array([stroke, 0.0, bias])
        self.log = np.empty((0, N_STATE))

    @property
    def now(self) -> int:
        """Index of the next tick."""
        return len(self.log)

    def play(self, inputs) -> np.ndarray:
        out = np.empty((len(inputs), N_STATE))
        drive(np.ascontiguousarray(inputs), self.z, self.cal, self.piston, out)
        self.log = np.vstack([self.log, out])
        return out

    def healthy(self, n, n_dem=80.0, n_r=None, **more):
        return self.play(frames(n, n_dem, n_r, phase=self.now, **more))

    def running(self, n_dem=80.0, n_r=None):
        self.healthy(1500, n_dem, n_r)
        assert self.z[fw.MODE] == RUN and self.z[fw.FAULT_BITS] == 0.0
        return self

    def first(self, condition) -> int:
        """Index of the first tick whose state fulfils the condition."""
        hits = np.flatnonzero(condition(self.log))
        assert hits.size, "never"
        return int(hits[0])

    def first_fault(self, bit: int, since=0) -> int:
        return since + self.tail(since).first(lambda s: fault(s, bit))

    def first_mode(self, mode: int, since=0) -> int:
        return since + self.tail(since).first(lambda s: s[:, fw.MODE] == mode)

    def tail(self, since: int) -> Rig:
        other = object.__new__(Rig)
        other.log = self.log[since:]
        return other


def frames(n, n_dem=80.0, n_r=None, phase=0, mode_request=1.0):
    """Good inputs for ``n`` ticks: a frame every 10 ms, the LVDT on the piston."""
    rows = np.zeros((n, N_COLUMNS))
    rows[:, fw.IN_N_DEM] = n_dem
    rows[:, fw.IN_N_R] = n_dem if n_r is None else n_r
    rows[:, fw.IN_FRESH] = (np.arange(phase, phase + n) % fw.SLOW) == 0
    rows[:, fw.IN_MODE_REQUEST] = mode_request
    rows[:, MEASURED] = 1.0
    rows[:, STRENGTH] = 1.0
    return rows


def lvdt_is(rows, value):
    """The same inputs with the LVDT giving ``value`` (m) instead of the stroke."""
    rows = rows.copy()
    rows[:, fw.IN_X_LVDT] = value
    rows[:, MEASURED] = 0.0
    return rows


def fault(states, bit):
    return (states[:, fw.FAULT_BITS].astype(int) >> bit & 1).astype(bool)


# ---- direction of the demand -----------------------------------------------------------------------------------------


@njit(error_model="numpy")
def trend_run(z, scalars, demand, direction):
    for i in range(demand.shape[0]):
        trend_step(z, scalars, demand[i])
        direction[i] = z[fw.DIRECTION]


def directions(demand, start=1.0):
    z = new_state()
    z[fw.TREND_N] = z[fw.TREND_TURN] = z[fw.TREND_LAST] = demand[0]
    z[fw.DIRECTION] = start
    out = np.empty(len(demand))
    trend_run(z, CAL.k, np.ascontiguousarray(demand, dtype=np.float64), out)
    return out


def turns(direction, start=1.0):
    """Indices at which the direction turned."""
    return np.flatnonzero(np.diff(direction, prepend=start))


def noise(n, seed=0, rms=0.02):
    return np.random.default_rng(seed).normal(0.0, rms, n)


RATES = [0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0]


@pytest.mark.parametrize("rate", RATES)
def test_a_ramp_turns_the_direction_once_and_in_time(rate):
    """Within 0.5 % / rate + trend_hold of the reversal, and not before half of that way back."""
    half = int(6.0 / rate * 100)
    up = 60.0 + rate * 0.01 * np.arange(half)
    demand = np.concatenate([np.full(500, 60.0), up, up[-1] - rate * 0.01 * np.arange(1, half)])
    at = turns(directions(demand))
    assert len(at) == 1
    seconds = (at[0] - (500 + half - 1)) * 0.01
    soonest, latest = 0.5 * k("trend_change") / rate + k("trend_hold"), k("trend_change") / rate + k("trend_hold")
    assert soonest - 0.011 <= seconds <= latest + 0.011
    assert seconds <= 0.36 if rate >= 2.0 else True  # fast manoeuvres: a third of a second


@pytest.mark.parametrize("rate", RATES)
@pytest.mark.parametrize("start", [1.0, -1.0])
def test_a_ramp_out_of_a_dwell_turns_once_with_noise(rate, start):
    n = int(8.0 / rate * 100)
    demand = np.concatenate(
        [
            np.full(2000, 70.0),
            70.0 - start * rate * 0.01 * np.arange(n),
            np.full(3000, 70.0 - start * rate * 0.01 * (n - 1)),
        ]
    )
    at = turns(directions(demand + noise(len(demand), int(rate * 10)), start), start)
    assert len(at) == 1 and at[0] >= 2000
    assert (at[0] - 2000) * 0.01 <= k("trend_change") / rate + k("trend_hold") + 0.011


@pytest.mark.parametrize("start", [1.0, -1.0])
@pytest.mark.parametrize("seed", range(4))
def test_measurement_noise_never_turns_the_direction_in_an_hour(seed, start):
    assert turns(directions(99.5 + noise(360_000, seed), start), start).size == 0


@pytest.mark.parametrize("start", [1.0, -1.0])
@pytest.mark.parametrize("hertz", [0.2, 0.5, 1.0, 2.0, 5.0])
def test_dither_about_a_set_point_never_turns_the_direction_in_an_hour(hertz, start):
    t = 0.01 * np.arange(360_000)
    demand = 99.5 + 0.05 * np.sin(2 * np.pi * hertz * t) + noise(len(t), 7)
    assert turns(directions(demand, start), start).size == 0


@pytest.mark.parametrize("start", [1.0, -1.0])
def test_one_wrong_demand_never_turns_the_direction(start):
    demand = np.full(2000, 80.0)
    for i, wrong in enumerate((0.0, 120.0, 79.0, 81.0)):
        spiked = demand.copy()
        spiked[500 + i : 500 + i + 1] = wrong
        d = directions(spiked, start)
        assert turns(d, start).size == 0


@pytest.mark.parametrize("rate", [2.0, 8.0, 20.0, 1e4])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_the_end_of_a_slam_is_not_a_turn(rate, side):
    """The filter overshoots there by up to 1 % and its rate goes the other way; the direction is the demand's."""
    leg = np.minimum(rate * 0.01 * np.arange(12_000), 55.0)
    demand = (45.0 + leg if side > 0 else 100.0 - leg) + noise(12_000, 3)
    assert turns(directions(demand, side), side).size == 0
    assert turns(directions(demand, -side), -side).size == 1


@pytest.mark.parametrize("amplitude", [2.0, 10.0, 25.0])
@pytest.mark.parametrize("period", [5.0, 20.0, 100.0])
def test_a_large_sine_turns_exactly_twice_a_period(amplitude, period):
    t = 0.01 * np.arange(int(20 * period * 100))
    demand = 70.0 + amplitude * np.sin(2 * np.pi * t / period) + noise(len(t), 5)
    assert len(turns(directions(demand))) == 40


def test_insane_demand_never_reaches_the_filter():
    rig = Rig().running()
    before = rig.z[[fw.N_DEM, fw.N_R_RAW, fw.TREND_TURN, fw.DIRECTION]].copy()
    for wrong in (np.nan, np.inf, -np.inf, 1e308, -1e308, -0.001, 120.001):
        for column in (fw.IN_N_DEM, fw.IN_N_R, fw.IN_MODE_REQUEST):
            rows = frames(10, phase=rig.now)
            rows[:, column] = wrong
            rig.play(rows)
    assert np.all(rig.z[[fw.N_DEM, fw.N_R_RAW, fw.TREND_TURN, fw.DIRECTION]] == before)
    assert abs(rig.z[fw.TREND_N] - 80.0) < 1e-9 and abs(rig.z[fw.TREND_RATE]) < 1e-9
    assert fault(rig.log[-1:], fw.F_DEMAND_RANGE).all()


# ---- tables to stroke demand -----------------------------------------------------------------------------------------


@settings(max_examples=examples(200))
@given(st.floats(-1e3, 1e3) | st.sampled_from([-np.inf, np.inf, *CAL.table[0]]), st.sampled_from([1, 2, 3]))
def test_look_up_is_linear_interpolation_held_beyond_its_ends(v, row):
    expected = np.interp(v, CAL.table[0], CAL.table[row])
    assert look_up(0, row, CAL.table, v) == pytest.approx(expected, abs=1e-15)


def test_look_up_is_exact_at_its_breakpoints_and_its_ends():
    for row in (1, 2, 3):
        assert np.array_equal([look_up(0, row, CAL.table, v) for v in CAL.table[0]], CAL.table[row])
        assert look_up(0, row, CAL.table, -1e308) == CAL.table[row, 0]
        assert look_up(0, row, CAL.table, np.nan) == CAL.table[row, 0]
        assert look_up(0, row, CAL.table, 1e308) == CAL.table[row, -1]
    two = np.array([[0.0, 1.0], [0.0, 2.0]])
    assert look_up(0, 1, two, 0.25) == 0.5


@settings(max_examples=examples(100))
@given(
    st.lists(st.floats(0, 120), min_size=2, max_size=30, unique=True), st.floats(-10, 130), st.integers(0, 2**32 - 1)
)
def test_look_up_agrees_with_numpy_on_any_table(axis, v, seed):
    axis = np.unique(np.round(axis, 3))
    if axis.size < 2:
        return
    table = np.vstack([axis, np.random.default_rng(seed).uniform(0, 0.05, axis.size)])
    assert look_up(0, 1, table, v) == pytest.approx(np.interp(v, *table), abs=1e-12)


def test_a_change_of_direction_moves_the_demand_bumplessly_from_curve_to_curve():
    """With the speed held, the stroke demand goes from one curve to the other in blend_time, evenly, at every speed."""
    for n in (45.0, 60.0, 75.0, 85.0, 95.0, 99.5):
        rig = Rig().running(n)
        triangle = np.interp(np.arange(6000), [0, 1000, 2000, 4000, 6000], [n, n, n + 2, n - 2, n - 2])
        states = rig.play(frames(6000, triangle, n, phase=rig.now))
        extension, retraction = (np.interp(n, CAL.table[0], CAL.table[r]) for r in (1, 2))
        steps = np.abs(np.diff(states[:, fw.X_DEM]))
        assert steps.max() <= (extension - retraction) * fw.SLOW_TICK / k("blend_time") + 1e-15
        assert states[0, fw.X_DEM] == pytest.approx(extension, abs=1e-12)
        assert states[-1, fw.X_DEM] == pytest.approx(retraction, abs=1e-12)
        assert np.count_nonzero(steps) * fw.SLOW_TICK == pytest.approx(k("blend_time"), abs=fw.SLOW_TICK)
        assert turns(states[:, fw.DIRECTION]).size == 1


def test_a_reversal_in_the_middle_of_a_change_of_table_turns_it_back_without_a_jump():
    z = new_state()
    z[fw.N_R] = 85.0
    z[fw.BLEND] = 0.0
    seen = []
    for i in range(60):
        z[fw.DIRECTION] = 1.0 if i < 12 else -1.0
        fw.schedule_step(z, CAL.k, CAL.table)
        seen.append(z[fw.BLEND])
    assert np.abs(np.diff(seen)).max() <= fw.SLOW_TICK / k("blend_time") + 1e-15
    assert max(seen) == pytest.approx(12 * fw.SLOW_TICK / k("blend_time")) and seen[-1] == 0.0


def test_the_single_curve_knows_no_direction():
    rig = Rig(SINGLE).running(80.0)
    states = rig.play(
        frames(4000, np.interp(np.arange(4000), [0, 2000, 4000], [80.0, 84.0, 76.0]), 80.0, phase=rig.now)
    )
    assert turns(states[:, fw.DIRECTION]).size == 1
    assert np.ptp(states[:, fw.X_DEM]) == 0.0


@pytest.mark.parametrize("table_input", [0.0, 1.0])
def test_stroke_demand_stays_within_limits_and_slew_under_any_speed(table_input):
    rng = np.random.default_rng(2)
    cal = changed(table_input=table_input)
    cal = cal._replace(
        table=cal.table * np.array([[1.0], [1.3], [1.0], [1.2]]) - np.array([[0.0], [0.003], [0.003], [0.003]])
    )
    rig = Rig(cal).running(70.0)
    steps = np.repeat(rng.uniform(0.0, 120.0, (60, 2)), 1000, axis=0)
    states = rig.play(frames(len(steps), steps[:, 0], steps[:, 1], phase=rig.now))
    assert (states[:, fw.MODE] == RUN).all()
    for column in (fw.X_DEM, fw.X_SERVO):
        assert states[:, column].min() >= k("stroke_min") - 1e-15 and states[:, column].max() <= k("stroke_max") + 1e-15
    assert states[:, fw.X_DEM].min() == k("stroke_min") and states[:, fw.X_DEM].max() == k("stroke_max")
    assert np.abs(np.diff(states[:, fw.X_DEM])).max() <= k("stroke_rate") * fw.SLOW_TICK + 1e-15
    assert np.abs(np.diff(states[:, fw.X_SERVO])).max() <= k("stroke_rate") * fw.TICK + 1e-15


# ---- LVDT ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf, 1e308, -0.0011, 0.0491, 0.001, 0.047, "above", "below"])
@pytest.mark.parametrize("moving", [False, True])
def test_a_single_bad_sample_is_ignored(wrong, moving):
    """The current differs from the undisturbed one only by what the piston moved during one tick."""
    clean, spiked = Rig().running(75.0), Rig().running(75.0)
    n_dem = np.minimum(75.0 + (0.02 if moving else 0.0) * np.arange(300), 85.0)
    rows = frames(300, n_dem, phase=clean.now)
    reference = clean.play(rows)
    x = reference[150, fw.X_MEAS]
    value = {"above": x + 0.6e-3, "below": x - 0.6e-3}.get(wrong, wrong)
    rows[150, [fw.IN_X_LVDT, MEASURED]] = value, 0.0
    states = spiked.play(rows)
    assert (states[:, fw.MODE] == RUN).all() and (states[:, fw.FAULT_BITS] == 0.0).all()
    assert states[150, fw.LVDT_GOOD] == 0.0 and (states[151:, fw.LVDT_GOOD] == 1.0).all()
    difference = np.abs(states[:, fw.I_CMD] - reference[:, fw.I_CMD]).max()
    assert difference <= (1.7e-3 if moving else 1e-6)  # A: kp times 0.1 mm


@pytest.mark.parametrize("mode", [INIT, STANDBY, RUN, DEGRADED])
def test_a_pause_is_fail_safe_at_once_and_run_comes_back_a_second_after_good_frames(mode):
    rig = Rig()
    if mode == INIT:
        rig.healthy(20)
    elif mode == STANDBY:
        rig.healthy(200, mode_request=0.0)
    else:
        rig.running()
    if mode == DEGRADED:
        rows = frames(10, phase=rig.now)
        rows[:, fw.IN_N_DEM] = 400.0
        rig.play(rows)
    assert rig.z[fw.MODE] == mode
    began = rig.now
    rows = frames(1, phase=1)
    rows[:, fw.IN_PAUSE] = 5.0
    rig.play(rows)
    assert rig.z[fw.MODE] == FAIL_SAFE and fault(rig.log[-1:], fw.F_PAUSED)[0]
    assert fault(rig.log[-1:], fw.F_STALE)[0] == (mode != INIT or rig.z[fw.DEMAND_AGE] >= 0.05)
    rig.healthy(1500)
    after = rig.tail(began)
    gone = after.first(lambda s: ~fault(s, fw.F_PAUSED))
    assert gone == ticks("recover_time")
    back = after.first(lambda s: s[:, fw.MODE] == RUN)
    assert 2 * ticks("recover_time") - 1 <= back <= 2 * ticks("recover_time") + 11
    assert (after.log[:back, fw.MODE] == FAIL_SAFE).all() and after.log[-1, fw.FAULT_BITS] == 0.0


@pytest.mark.parametrize("pause", [0.0, -1.0, np.nan, -np.inf])
def test_no_pause_changes_nothing(pause):
    rigs = Rig().running(), Rig().running()
    rows = frames(500, phase=rigs[0].now)
    rigs[0].play(rows)
    rows[:, fw.IN_PAUSE] = pause
    rigs[1].play(rows)
    assert np.array_equal(rigs[0].log, rigs[1].log)


def test_the_piston_may_be_anywhere_after_a_long_pause():
    rig = Rig().running()
    rig.piston[0] += 0.01
    rows = frames(1, phase=1)
    rows[:, fw.IN_PAUSE] = 0.2
    rig.play(rows)
    assert rig.z[fw.LVDT_GOOD] == 1.0 and rig.z[fw.X_MEAS] == pytest.approx(rig.piston[0], abs=1e-3)


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf, 0.06, -0.01, 1e308])
def test_a_lost_lvdt_is_a_fault_at_lvdt_debounce_and_heals_at_lvdt_heal(wrong):
    rig = Rig().running()
    bad = rig.now
    rig.play(lvdt_is(frames(3000, phase=bad), wrong))
    lost = rig.first_fault(fw.F_LVDT_RANGE)
    assert lost == bad + ticks("lvdt_debounce") - 1
    assert rig.first_mode(FAIL_SAFE) == lost
    after = rig.log[lost + 1 :]
    assert (after[:, fw.I_CMD] == k("fail_safe_current")).all() and (after[:, fw.INTEGRAL] == 0.0).all()
    assert (rig.log[bad:lost, fw.X_MEAS] == rig.log[bad - 1, fw.X_MEAS]).all()
    assert rig.piston[0] == 0.0  # the fail-safe current has retracted it

    good = rig.now
    rig.healthy(4000)
    healed = good + rig.tail(good).first(lambda s: s[:, fw.FAULT_BITS] == 0.0)
    assert (
        healed <= good + ticks("lvdt_heal") + 5
    )  # the first good sample is where the piston is by now, not where it was
    running = rig.first_mode(RUN, since=good)
    assert running == healed + ticks("recover_time") - 1
    assert np.abs(rig.log[-1, fw.X_DEM] - rig.log[-1, fw.X_MEAS]) < 1e-6


def test_lvdt_bad_in_most_samples_is_a_fault_although_never_for_long():
    for duty in (2, 5, 10):  # one good sample in so many
        rig = Rig().running()
        rows = frames(2000, phase=rig.now)
        gone = np.arange(2000) % duty != 0
        rows[gone, fw.IN_X_LVDT] = np.nan
        start = rig.now
        rig.play(rows)
        assert rig.first_fault(fw.F_LVDT_RANGE) - start <= 2.3 * ticks("lvdt_debounce")
        assert rig.z[fw.MODE] == FAIL_SAFE


@pytest.mark.parametrize("gap", [5, 19])
def test_a_gap_shorter_than_the_debounce_time_leaves_no_trace_although_the_piston_moves(gap):
    rig = Rig().running(75.0)
    rows = frames(1500, np.minimum(75.0 + 0.02 * np.arange(1500), 90.0), phase=rig.now)
    rows[400 : 400 + gap, fw.IN_X_LVDT] = np.nan
    states = rig.play(rows)
    assert (states[:, fw.FAULT_BITS] == 0.0).all() and (states[:, fw.MODE] == RUN).all()
    assert (states[400 + gap :, fw.LVDT_GOOD] == 1.0).all()


@pytest.mark.parametrize("step", [0.0021, 0.005, 0.020, -0.0021, -0.015])
def test_a_lasting_step_of_the_lvdt_beyond_the_tracking_limit_is_a_rate_fault_within_4_ms(step):
    rig = Rig().running()
    start = rig.now
    rows = frames(200, phase=start)
    rows[:, fw.IN_X_LVDT] = step
    before = rig.log[-1].copy()
    rig.play(rows)
    assert rig.first_fault(fw.F_LVDT_RATE) == start + 3 == rig.first_mode(FAIL_SAFE)
    assert np.abs(rig.log[start : start + 4, fw.I_CMD] - before[fw.I_CMD]).max() < 1e-6  # it was never believed


def test_a_small_lasting_step_is_taken_over_without_a_fault():
    rig = Rig().running()
    rows = frames(1000, phase=rig.now)
    rows[:, fw.IN_X_LVDT] = 0.8e-3
    states = rig.play(rows)
    assert (states[:, fw.MODE] == RUN).all() and (states[:, fw.FAULT_BITS] == 0.0).all()


def test_a_wildly_noisy_lvdt_is_a_rate_fault_and_stays_one():
    rig = Rig().running()
    start = rig.now
    rows = frames(10_000, phase=start)
    rows[:, fw.IN_X_LVDT] = np.random.default_rng(4).uniform(-0.005, 0.005, len(rows))
    rig.play(rows)
    first = rig.first_fault(fw.F_LVDT_RATE)
    assert first - start <= 20
    assert fault(rig.log[first:], fw.F_LVDT_RATE).all() and (rig.log[first:, fw.MODE] == FAIL_SAFE).all()


def test_noise_of_the_sensor_is_never_a_fault():
    rig = Rig().running(75.0)
    rows = frames(60_000, 85.0 + 10.0 * np.sin(np.arange(60_000) / 1500.0), phase=rig.now)
    rows[:, fw.IN_X_LVDT] = np.random.default_rng(1).normal(0.0, 5e-6, len(rows))
    states = rig.play(rows)
    assert (states[:, fw.FAULT_BITS] == 0.0).all() and (states[:, fw.MODE] == RUN).all()


@pytest.mark.parametrize("n_dem", [65.0, 95.0])
def test_a_frozen_lvdt_is_stuck_at_stuck_time_after_the_current_asks_for_motion(n_dem):
    rig = Rig().running(80.0)
    start, x = rig.now, float(rig.z[fw.X_MEAS])
    rig.play(lvdt_is(frames(20_000, n_dem, phase=start), x))
    asked = start + rig.tail(start).first(lambda s: np.abs(s[:, fw.I_CMD]) > k("stuck_current"))
    stuck = rig.first_fault(fw.F_LVDT_STUCK)
    assert stuck == asked + ticks("stuck_time")
    assert stuck - start <= ticks("stuck_time") + 100
    after = rig.log[stuck:]
    assert fault(after, fw.F_LVDT_STUCK).all() and (after[:, fw.MODE] == FAIL_SAFE).all()  # no cure without motion
    assert (after[1:, fw.I_CMD] == k("fail_safe_current")).all()
    moving = rig.now
    rig.healthy(6000, n_dem)
    assert rig.z[fw.MODE] == RUN and rig.z[fw.FAULT_BITS] == 0.0
    assert rig.first_mode(RUN, since=moving) - moving <= ticks("lvdt_heal") + ticks("recover_time") + 100


def test_a_jammed_piston_is_told_by_the_stuck_fault_and_runs_again_once_free():
    rig = Rig().running(80.0)
    rows = frames(5000, 90.0, phase=rig.now)
    rows[:, STRENGTH] = 0.0
    rig.play(rows)
    assert rig.z[fw.MODE] == FAIL_SAFE and fault(rig.log[-1:], fw.F_LVDT_STUCK).all()
    rig.healthy(5000, 90.0)
    assert rig.z[fw.MODE] == RUN and rig.z[fw.FAULT_BITS] == 0.0


def test_resting_against_an_end_stop_is_not_stuck():
    cal = changed(stroke_min=0.0, stroke_max=0.048)
    rig = Rig(cal._replace(table=cal.table * np.array([[1.0], [0.0], [0.0], [0.0]])), stroke=0.004, bias=0.002)
    rig.healthy(20_000)
    assert rig.z[fw.MODE] == RUN and (rig.log[:, fw.FAULT_BITS] == 0.0).all()


@pytest.mark.parametrize("far", [0.003, 0.045])
def test_the_servo_takes_over_without_a_bump_when_the_lvdt_returns(far):
    """The piston is anywhere by then; it goes to the fail-safe stroke no faster than fail_safe_rate, with a little for
    the loop.
    """
    cal = changed(fail_safe_current=0.0)
    rig = Rig(cal).running()
    rig.play(lvdt_is(frames(500, phase=rig.now), np.nan))
    rig.piston[0] = far
    start = rig.now
    rows = frames(1600, phase=start)
    rows[:, fw.IN_FRESH] = 0.0  # and no demand, so that FAIL_SAFE stays
    rig.play(rows)
    states = rig.log[start:]
    closed = states[~fault(states, fw.F_LVDT_RANGE) & ~fault(states, fw.F_LVDT_RATE)]
    assert len(closed) > 500 and (closed[:, fw.MODE] == FAIL_SAFE).all()
    assert np.abs(np.diff(closed[:, fw.X_MEAS])).max() <= 1.3 * k("fail_safe_rate") * fw.TICK
    assert np.abs(closed[:, fw.I_CMD]).max() <= 2.0 * k("fail_safe_rate") / NOMINAL_GAIN


@pytest.mark.parametrize("bad", [1, 10, 19, 30])
@pytest.mark.parametrize("stroke", [0.0, 0.030, 0.048])
def test_bad_samples_at_power_on_delay_the_start_and_nothing_else(bad, stroke):
    rig = Rig(stroke=stroke)
    rows = frames(bad)
    rows[:, fw.IN_X_LVDT] = np.nan
    rig.play(rows)
    rig.healthy(5000)
    assert rig.z[fw.MODE] == RUN and rig.z[fw.FAULT_BITS] == 0.0
    if bad < ticks("lvdt_debounce"):
        assert (rig.log[:, fw.FAULT_BITS] == 0.0).all() and rig.first_mode(STANDBY) == ticks("init_time") - 1
    else:
        assert FAIL_SAFE in rig.log[:, fw.MODE]
    reference = rig.log[bad + 1 :, fw.X_SERVO]
    assert np.abs(np.diff(reference)).max() <= k("stroke_rate") * fw.TICK + 1e-15


# ---- servo -----------------------------------------------------------------------------------------------------------


def servo(x_ref, stroke, seconds, bias=0.0, strength=1.0):
    """Step response of the servo alone on the piston: stroke and current."""
    z, x, spool, out = new_state(), stroke, 0.0, []
    for _ in range(round(seconds / fw.TICK)):
        z[fw.X_MEAS] = x
        servo_step(z, CAL.k, x_ref, 0.0)
        spool += 0.3 * (z[fw.I_CMD] - spool)
        x = min(max(x + strength * NOMINAL_GAIN * (spool + bias) * fw.TICK, 0.0), 0.048)
        out.append((x, z[fw.I_CMD], z[fw.INTEGRAL]))
    return np.array(out)


@pytest.mark.parametrize("strength", [0.5, 1.0, 1.1])
@pytest.mark.parametrize("way", [(0.002, 0.045), (0.045, 0.002), (0.020, 0.028)])
def test_after_saturation_the_stroke_overshoots_by_less_than_a_third_of_a_millimetre(way, strength):
    """Anti-windup: however long the current was at its limit, over 8 mm or 43 mm, the overshoot is the same."""
    start, goal = way
    run = servo(goal, start, 3.0, strength=strength)
    assert np.abs(run[:, 1]).max() == k("current_limit")
    side = np.sign(goal - start)
    assert (side * (run[:, 0] - goal)).max() <= 0.33e-3
    assert np.abs(run[-1, 0] - goal) < 1e-9


@pytest.mark.parametrize("bias", [-0.004, -0.001, 0.001, 0.004])
def test_a_constant_bias_leaves_no_steady_error(bias):
    run = servo(0.020, 0.020, 4.0, bias=bias)
    assert abs(run[-1, 0] - 0.020) < 1e-7
    assert run[-1, 1] == pytest.approx(-bias, abs=1e-6)
    assert np.abs(run[:, 0] - 0.020).max() < 0.06 * abs(bias)  # 0.06 mm for each mA


@settings(max_examples=examples(300))
@given(
    st.floats(-0.05, 0.1), st.floats(-0.001, 0.05), st.floats(-0.1, 0.1), st.floats(-0.04, 0.04), st.integers(1, 200)
)
def test_current_and_integral_stay_within_the_limit(x_ref, x, dx, integral, n):
    z = new_state()
    z[fw.X_MEAS], z[fw.INTEGRAL] = x, integral
    for _ in range(n):
        servo_step(z, CAL.k, x_ref, dx)
        assert abs(z[fw.I_CMD]) <= k("current_limit") and abs(z[fw.INTEGRAL]) <= k("current_limit")


def test_the_integral_does_not_grow_into_a_saturated_current_and_leaves_it_at_once():
    z = new_state()
    z[fw.X_MEAS] = 0.0
    for _ in range(3000):
        servo_step(z, CAL.k, 0.040, 0.0)
    assert z[fw.INTEGRAL] == 0.0 and z[fw.SATURATED] == 1.0
    servo_step(z, CAL.k, -0.0001, 0.0)
    assert z[fw.I_CMD] < 0.0 and z[fw.SATURATED] == 0.0


# ---- demand faults and modes, times to the tick ----------------------------------------------------------------------


def silent(n, phase):
    rows = frames(n, phase=phase)
    rows[:, fw.IN_FRESH] = 0.0
    return rows


def test_start_takes_init_time_then_standby_then_run():
    rig = Rig()
    rig.healthy(100)
    assert (rig.log[: ticks("init_time") - 1, fw.MODE] == INIT).all() and (
        rig.log[: ticks("init_time"), fw.I_CMD] == 0.0
    ).all()
    assert rig.first_mode(STANDBY) == ticks("init_time") - 1
    assert rig.first_mode(RUN) == ticks("init_time")


def test_a_stale_demand_degrades_then_fails_safe_then_recovers_at_the_calibrated_ticks():
    rig = Rig().running(90.0)
    last = rig.now - fw.SLOW  # the last good frame
    assert rig.log[last, fw.DEMAND_AGE] == 0.0
    rig.play(silent(4000, rig.now))
    stale = last + ticks("demand_timeout")
    assert rig.first_fault(fw.F_STALE) == stale == rig.first_mode(DEGRADED)
    failed = stale + ticks("degraded_hold")
    assert rig.first_mode(FAIL_SAFE) == failed
    degraded = rig.log[stale:failed]
    assert np.ptp(degraded[:, fw.X_DEM]) < 1e-12  # the last demand is held
    descent = rig.log[failed:]
    assert np.abs(np.diff(descent[:, fw.X_SERVO])).max() <= k("fail_safe_rate") * fw.TICK + 1e-12
    arrival = failed + rig.tail(failed).first(lambda s: s[:, fw.X_DEM] == k("fail_safe_stroke"))
    assert (arrival - failed) * fw.TICK <= 0.048 / k("fail_safe_rate")
    assert abs(rig.piston[0] - k("fail_safe_stroke")) < 0.1e-3
    assert (descent[arrival - failed :, fw.X_DEM] == k("fail_safe_stroke")).all()

    back = rig.now
    rig.healthy(3000, 90.0)
    healed = back + ticks("recover_time") - 1
    assert (
        not fault(rig.log[healed : healed + 1], fw.F_STALE).any()
        and fault(rig.log[healed - 1 : healed], fw.F_STALE).all()
    )
    running = healed + ticks("recover_time") - 1
    assert rig.first_mode(RUN, since=back) == running
    assert np.abs(np.diff(rig.log[back:, fw.X_SERVO])).max() <= k("stroke_rate") * fw.TICK + 1e-12
    assert (rig.log[running:, fw.MODE] == RUN).all()  # the way back of 40 mm is no tracking fault


@pytest.mark.parametrize("gap", [60, 200, 540])
def test_a_dropout_shorter_than_degraded_hold_never_fails_safe(gap):
    """The fault takes recover_time to heal; that is no reason to give up while good frames arrive."""
    rig = Rig().running(95.0)
    x = rig.z[fw.X_DEM]
    start = rig.now
    rig.play(silent(gap, start))
    rig.healthy(1000, 95.0)
    modes = rig.log[start:, fw.MODE]
    assert set(modes) == {RUN, DEGRADED} and rig.z[fw.MODE] == RUN
    assert np.abs(rig.log[start:, fw.X_DEM] - x).max() < 1e-12


@pytest.mark.parametrize("missed", [1, 2, 3, 4])
def test_up_to_four_missed_frames_are_nothing(missed):
    rig = Rig().running()
    start = rig.now
    rig.play(silent(missed * fw.SLOW, start))
    rig.healthy(1000)
    assert (rig.log[start:, fw.MODE] == RUN).all() and (rig.log[start:, fw.FAULT_BITS] == 0.0).all()


def test_the_bucket_of_refused_frames_overflows_at_its_limit_and_forgives_one_in_ten():
    limit = int(k("demand_reject_limit"))
    for burst, expected in ((limit - 1, False), (limit, True), (np.inf, True), (1e308, True)):
        rig = Rig().running()
        rows = frames(20, phase=rig.now)
        rows[5, fw.IN_REJECTED] = burst
        states = rig.play(rows)
        assert fault(states, fw.F_REJECTED).any() == expected
        assert (states[5, fw.MODE] == DEGRADED) == expected
    for insane in (np.nan, -np.inf, -1e308):
        rig = Rig().running()
        rows = frames(2000, phase=rig.now)
        rows[:, fw.IN_REJECTED] = insane
        assert (rig.play(rows)[:, fw.FAULT_BITS] == 0.0).all()
    rig = Rig().running()
    rows = frames(60_000, phase=rig.now)
    rows[::100, fw.IN_REJECTED] = 1.0
    assert (rig.play(rows)[:, fw.MODE] == RUN).all()
    rows[::50, fw.IN_REJECTED] = 1.0
    start = rig.now
    rig.play(rows)
    assert rig.first_fault(fw.F_REJECTED) - start < 1000


@pytest.mark.parametrize("refused", [6, 20, 52])
def test_a_burst_of_refused_frames_never_fails_safe_once_good_ones_return(refused):
    rig = Rig().running(95.0)
    start = rig.now
    rows = silent(refused * fw.SLOW, start)
    rows[:: fw.SLOW, fw.IN_REJECTED] = 1.0
    rig.play(rows)
    rig.healthy(2000, 95.0)
    assert set(rig.log[start:, fw.MODE]) == {RUN, DEGRADED}
    assert (
        rig.first_fault(fw.F_REJECTED) == start + 5 * fw.SLOW
    )  # 0.1 is forgiven between two frames: the sixth overflows
    assert rig.first_mode(RUN, since=rig.now - 2000) == rig.now - 2000 + ticks("recover_time") - 1


def test_one_frame_out_of_range_degrades_for_recover_time_and_no_longer():
    rig = Rig().running()
    start = rig.now
    rows = frames(1000, phase=start)
    rows[0, fw.IN_N_DEM] = 120.5
    states = rig.play(rows)
    assert states[0, fw.MODE] == DEGRADED and fault(states[:1], fw.F_DEMAND_RANGE).all()
    assert rig.first_mode(RUN, since=start) == start + ticks("recover_time")
    assert (states[ticks("recover_time") :, fw.MODE] == RUN).all() and (states[:, fw.N_DEM] == 80.0).all()


def test_only_frames_out_of_range_fail_safe_like_silence():
    rig = Rig().running()
    start = rig.now
    rig.play(frames(2000, np.nan, phase=start))
    assert rig.first_mode(DEGRADED, since=start) == start
    assert rig.first_mode(FAIL_SAFE) - start <= ticks("demand_timeout") + ticks("degraded_hold") + fw.SLOW


def test_a_mode_request_counts_only_with_a_good_frame():
    rig = Rig().running()
    rows = frames(30, phase=rig.now, mode_request=0.0)
    rows[:, fw.IN_FRESH] = 0.0
    assert (rig.play(rows)[:, fw.MODE] == RUN).all()
    rows = frames(10, phase=rig.now, mode_request=0.0)
    rows[:, fw.IN_N_R] = 500.0
    assert STANDBY not in rig.play(rows)[:, fw.MODE]
    rig.healthy(1000)
    assert rig.healthy(10, mode_request=0.0)[0, fw.MODE] == STANDBY
    assert rig.healthy(10)[0, fw.MODE] == RUN


def test_without_any_demand_the_controller_stays_in_standby_and_holds_its_stroke_against_bias():
    rig = Rig(bias=0.003)
    rig.play(silent(20_000, 0))
    assert rig.z[fw.MODE] == STANDBY
    entered = rig.first_mode(STANDBY)
    assert abs(rig.piston[0] - rig.log[entered, fw.X_MEAS]) < 1e-6
    assert np.abs(rig.log[entered:, fw.X_MEAS] - rig.log[entered, fw.X_MEAS]).max() < 0.4e-3


def test_an_actuator_too_weak_to_follow_is_a_tracking_fault_at_tracking_time():
    rig = Rig().running(75.0)
    start = rig.now
    rows = frames(20_000, 95.0, phase=start)
    rows[:, STRENGTH] = 0.04  # 6 mm/s
    rig.play(rows)
    error = np.abs(rig.log[:, fw.X_SERVO] - rig.log[:, fw.X_MEAS])
    late = start + int(np.flatnonzero(error[start:] > k("tracking_limit"))[0])
    tracked = rig.first_fault(fw.F_TRACKING)
    assert tracked == late + ticks("tracking_time") - 1 == rig.first_mode(DEGRADED)
    failed = rig.first_mode(FAIL_SAFE)
    assert failed == tracked + ticks("degraded_hold")
    left = failed + rig.tail(failed).first(lambda s: s[:, fw.MODE] != FAIL_SAFE)
    waited = error[left - ticks("recover_time") - ticks("recover_time") + 2 : left]
    assert waited.max() <= k("tracking_limit")  # FAIL_SAFE is left only after the piston has followed


def test_a_saturated_current_is_a_fault_at_saturated_time():
    rig = Rig(changed(tracking_limit=1.0)).running(75.0)
    start = rig.now
    rows = frames(4000, 95.0, phase=start)
    rows[:, STRENGTH] = 0.04
    rig.play(rows)
    first = start + rig.tail(start).first(lambda s: s[:, fw.SATURATED] == 1.0)
    assert rig.first_fault(fw.F_SATURATED) == first + ticks("saturated_time") - 1 == rig.first_mode(DEGRADED)
    assert rig.first_mode(FAIL_SAFE) == first + ticks("saturated_time") - 1 + ticks("degraded_hold")


def test_time_of_recovery_starts_anew_after_every_loss_of_the_lvdt():
    rig = Rig().running()
    rig.play(lvdt_is(frames(100, phase=rig.now), np.nan))
    rig.healthy(ticks("lvdt_heal") + 300)
    assert rig.z[fw.MODE] == FAIL_SAFE and 0.2 < rig.z[fw.RECOVER_TIMER] < k("recover_time")
    rig.play(lvdt_is(frames(100, phase=rig.now), np.nan))
    assert rig.z[fw.RECOVER_TIMER] == 0.0


# ---- insane inputs ---------------------------------------------------------------------------------------------------

ALLOWED = {
    (INIT, STANDBY),
    (INIT, FAIL_SAFE),
    (STANDBY, RUN),
    (STANDBY, FAIL_SAFE),
    (RUN, STANDBY),
    (RUN, DEGRADED),
    (RUN, FAIL_SAFE),
    (DEGRADED, RUN),
    (DEGRADED, FAIL_SAFE),
    (FAIL_SAFE, STANDBY),
    (FAIL_SAFE, RUN),
}
INSANE = np.array(
    [np.nan, np.inf, -np.inf, 1e308, -1e308, 5e-324, -0.0, 0.0, 0.5, 1.0, -1.0, 3.0, 120.0, 120.0001, 1e-3, 0.0485, 1e6]
)
OK, BAD_CURRENT, BAD_STROKE, BAD_MODE, NOT_FINITE, BAD_SLEW, NO_RECOVERY = range(7)
RECOVERY = 2000  # ticks from the return of good inputs to RUN, whatever came before


@njit(error_model="numpy")
def pick(kind, sane):
    """A sane value, an insane one, a random one, or by chance any of these."""
    if kind == 0 or (kind == 3 and np.random.random() < 0.9):
        return sane
    if kind == 1 or np.random.random() < 0.5:
        return INSANE[np.random.randint(0, INSANE.shape[0])]
    return sane + np.random.normal() * 10.0 ** np.random.uniform(-5.0, 5.0)


@njit(error_model="numpy")
def campaign(seed, n, cal, seen, trials, worst):
    """Segments of sane and insane inputs; returns (0, -1) or what was violated, and at which tick.

    Now and then, from the state reached, good inputs return on a copy: ``worst[0]`` is the longest way in ticks to RUN
    without a fault that then lasts.
    """
    np.random.seed(seed)
    scalars = cal.k
    limit, low, high = scalars[fw.CURRENT_LIMIT], scalars[fw.STROKE_MIN], scalars[fw.STROKE_MAX]
    slew = max(scalars[fw.STROKE_RATE], scalars[fw.FAIL_SAFE_RATE]) * fw.SLOW_TICK + 1e-12
    z = np.zeros(N_STATE)
    z[fw.DIRECTION] = 1.0
    z[fw.BLEND] = 1.0
    z[fw.X_REACH] = fw.FAR
    row = np.zeros(N_INPUTS)
    kinds = np.zeros(N_INPUTS, dtype=np.int64)
    x, spool, n_dem, strength, frozen, left = 0.02, 0.0, 70.0, 1.0, 0.0, 0
    request = 1.0
    for i in range(n):
        if left == 0:
            left = int(10.0 ** np.random.uniform(0.0, 3.6))
            calm = np.random.random() < 0.4
            for q in range(N_INPUTS):
                kinds[q] = 0 if calm or np.random.random() < 0.7 else np.random.randint(0, 4)
            strength = 1.0 if calm or np.random.random() < 0.7 else np.random.random()
            frozen = 0.0 if calm or np.random.random() < 0.8 else 1.0
            request = 0.0 if np.random.random() < 0.15 else 1.0
            n_dem = np.random.uniform(0.0, 120.0)
            if np.random.random() < 0.1:
                x = np.random.uniform(0.0, 0.048)
            if np.random.random() < 0.02:  # switched off and on
                z[:] = 0.0
                z[fw.DIRECTION] = 1.0
                z[fw.BLEND] = 1.0
                z[fw.X_REACH] = fw.FAR
        left -= 1
        row[fw.IN_N_DEM] = pick(kinds[0], n_dem)
        row[fw.IN_N_R] = pick(kinds[1], n_dem)
        row[fw.IN_FRESH] = pick(kinds[2], 1.0 if i % 10 == 0 else 0.0)
        row[fw.IN_REJECTED] = pick(kinds[3], 0.0)
        row[fw.IN_MODE_REQUEST] = pick(kinds[4], request)
        row[fw.IN_X_LVDT] = pick(kinds[5], x if frozen == 0.0 else z[fw.X_MEAS])
        for q in range(3):
            row[fw.IN_VIGV + q] = pick(kinds[fw.IN_VIGV + q], 20.0 * x - 0.5)  # rad, about the linkage's
        mode, x_dem = int(z[fw.MODE]), z[fw.X_DEM]
        lost = (int(z[fw.FAULT_BITS]) & fw.LVDT_MASK) != 0
        tick(row, z, cal)
        spool += 0.3 * (z[fw.I_CMD] - spool)
        x = min(max(x + strength * NOMINAL_GAIN * spool * fw.TICK, 0.0), 0.048)
        if not abs(z[fw.I_CMD]) <= limit:
            return BAD_CURRENT, i
        if not (low <= z[fw.X_DEM] <= high):
            return BAD_STROKE, i
        now = int(z[fw.MODE])
        if not 0 <= now <= 4:
            return BAD_MODE, i
        for q in range(N_STATE):
            if not np.isfinite(z[q]):
                return NOT_FINITE, i
        seen[mode, now] += 1
        lost = lost or (int(z[fw.FAULT_BITS]) & fw.LVDT_MASK) != 0
        if now == mode and mode != INIT and not lost and not abs(z[fw.X_DEM] - x_dem) <= slew:
            return BAD_SLEW, i
        if trials > 0 and np.random.random() < 3e-4:
            trials -= 1
            copy, piston, flow, speed = z.copy(), x, spool, np.random.uniform(0.0, 120.0)
            since = -1
            for j in range(RECOVERY + 3000):
                row[fw.IN_N_DEM] = speed
                row[fw.IN_N_R] = speed
                row[fw.IN_FRESH] = 1.0 if j % 10 == 0 else 0.0
                row[fw.IN_REJECTED] = 0.0
                row[fw.IN_MODE_REQUEST] = 1.0
                row[fw.IN_X_LVDT] = piston
                tick(row, copy, cal)
                flow += 0.3 * (copy[fw.I_CMD] - flow)
                piston = min(max(piston + NOMINAL_GAIN * flow * fw.TICK, 0.0), 0.048)
                if copy[fw.MODE] == RUN and copy[fw.FAULT_BITS] == 0.0:
                    if since < 0:
                        since = j
                else:
                    since = -1
            if since < 0 or since > RECOVERY:
                return NO_RECOVERY, i
            worst[0] = max(worst[0], since)
    return OK, -1


@pytest.mark.parametrize(
    "cal",
    [
        *(CAL, SINGLE._replace(k=np.where(np.arange(fw.N_SCALARS) == fw.TABLE_INPUT, 1.0, SINGLE.k))),
        *(INVERSE, ADAPTIVE, ADAPTIVE._replace(k=np.where(np.arange(fw.N_SCALARS) == fw.TABLE_INPUT, 1.0, ADAPTIVE.k))),
    ],
    ids=["dual", "single", "inverse", "adaptive", "adaptive at n_dem"],
)
def test_a_million_ticks_of_insane_inputs_break_no_invariant_and_leave_no_state_without_a_way_back(cal):
    seen, worst = np.zeros((5, 5), dtype=np.int64), np.zeros(1, dtype=np.int64)
    for seed in range(10):
        verdict = campaign(seed, 200_000, cal, seen, 40, worst)
        assert verdict == (OK, -1), f"seed {seed}"
    changes = {(a, b) for a in range(5) for b in range(5) if a != b and seen[a, b]}
    assert changes - ALLOWED == set(), [(MODES[a], MODES[b]) for a, b in changes - ALLOWED]
    assert changes == ALLOWED, f"not visited: {ALLOWED - changes}"
    assert 0 < worst[0] <= RECOVERY


@pytest.mark.parametrize("seed", range(6))
def test_any_calibration_of_the_compensation_keeps_the_invariants_under_insane_inputs(seed):
    """Observer, crossing and learning with values anywhere within their bounds, ends included."""
    from controller.calibration import Adaptive, AngleTable, Inverse, Observer
    from vaneloop.base.tables import Bound

    rng, scalars = np.random.default_rng(seed), ADAPTIVE.k.copy()
    for model in (Observer, Inverse, Adaptive, AngleTable):
        for name, field in model.model_fields.items():
            bound = next((m for m in field.metadata if isinstance(m, Bound)), None)
            if name in fw.SCALARS and bound is not None and name not in ("pot_low", "pot_high"):
                value = rng.choice(
                    [
                        bound.low,
                        bound.high,
                        rng.uniform(bound.low, bound.high),
                        bound.low + 0.01 * (bound.high - bound.low),
                    ]
                )
                scalars[fw.SCALARS.index(name)] = np.deg2rad(value) if bound.unit.startswith("deg") else value
    seen, worst = np.zeros((5, 5), dtype=np.int64), np.zeros(1, dtype=np.int64)
    assert campaign(100 + seed, 200_000, ADAPTIVE._replace(k=scalars), seen, 20, worst) == (OK, -1)


@settings(max_examples=examples(100))
@given(
    st.lists(st.tuples(*[st.floats(width=64)] * N_INPUTS), min_size=1, max_size=40),
    st.sampled_from([CAL, SINGLE, INVERSE, ADAPTIVE]),
)
def test_any_floats_at_all_keep_state_finite_and_outputs_within_limits(rows, cal):
    z = new_state()
    for row in rows:
        tick(np.array(row), z, cal)
        assert np.isfinite(z).all() and abs(z[fw.I_CMD]) <= k("current_limit")
        assert k("stroke_min") <= z[fw.X_DEM] <= k("stroke_max") and z[fw.MODE] in range(5)


# ---- purity ----------------------------------------------------------------------------------------------------------


def mixed_inputs(n=6000, seed=11):
    rng = np.random.default_rng(seed)
    rows = frames(n, 80.0 + 15.0 * np.sin(np.arange(n) / 700.0))
    rows[2000:2200, fw.IN_FRESH] = 0.0
    rows[3000:3004, fw.IN_X_LVDT] = rng.choice([np.nan, np.inf, 0.03, -1e308], 4)
    rows[4500:4600, fw.IN_X_LVDT] = np.nan
    wild = rng.random(n) < 0.003
    rows[wild, fw.IN_N_DEM] = rng.choice(INSANE, wild.sum())
    rows[rng.random(n) < 0.002, fw.IN_REJECTED] = 2.0
    rows[:, fw.IN_X_LVDT] += rng.normal(0.0, 5e-6, n)
    vigv = np.interp(rows[:, fw.IN_N_DEM], CAL.table[0], np.interp(CAL.table[3], *CAL.angles[:2]))
    rows[:, fw.IN_VIGV : fw.IN_VGV2 + 1] = vigv[:, None] * [1.0, 0.69, 0.53] + rng.normal(0.0, 5e-4, (n, 3))
    rows[rng.random(n) < 0.01, fw.IN_VIGV] = np.nan
    return rows


def test_same_inputs_and_state_give_the_same_bits_and_nothing_else_changes():
    rows, scalars, table = mixed_inputs(), CAL.k.copy(), CAL.table.copy()
    untouched = rows.copy()
    a, b = Rig(), Rig()
    first = a.play(rows)
    assert np.array_equal(rows.view(np.int64), untouched.view(np.int64))
    assert np.array_equal(CAL.k, scalars) and np.array_equal(CAL.table, table)
    assert np.array_equal(first.view(np.int64), b.play(rows).view(np.int64))
    middle = first[2999].copy()  # from any state on, too
    one, other = middle.copy(), middle.copy()
    row = rows[3000, :N_INPUTS].copy()
    tick(row, one, CAL)
    tick(row, other, CAL)
    assert np.array_equal(one.view(np.int64), other.view(np.int64))
    assert np.array_equal(row.view(np.int64), rows[3000, :N_INPUTS].view(np.int64))


SCRIPT = """
import hashlib, warnings
warnings.simplefilter("ignore")
from tests.test_controller import ADAPTIVE, CAL, Rig, mixed_inputs
for cal in (CAL, ADAPTIVE):
    print(hashlib.sha256(Rig(cal).play(mixed_inputs()).tobytes()).hexdigest())
"""


@pytest.mark.slow
def test_compiled_and_interpreted_firmware_agree_bit_for_bit():
    import hashlib

    runs = [Rig(cal).play(mixed_inputs()) for cal in (CAL, ADAPTIVE)]
    assert all(len(set(states[:, fw.MODE])) == 5 for states in runs)  # the run goes through every mode
    env = {**os.environ, "NUMBA_DISABLE_JIT": "1", "PYTHONPATH": str(ROOT)}
    run = subprocess.run(
        [sys.executable, "-c", SCRIPT], check=False, cwd=ROOT, env=env, capture_output=True, text=True, timeout=300
    )
    assert run.returncode == 0, run.stderr
    assert run.stdout.split() == [hashlib.sha256(states.tobytes()).hexdigest() for states in runs]


def test_names_and_indices_of_inputs_scalars_states_and_faults_belong_together():
    for i, name in enumerate(fw.INPUTS):
        short = {"demand_fresh": "fresh", "demand_rejected": "rejected"}.get(name, name)
        assert getattr(fw, f"IN_{short.upper()}") == i
    for i, name in enumerate(fw.SCALARS):
        assert getattr(fw, name.upper()) == i
    for i, name in enumerate(fw.STATE):
        stem, _, stage = name.rpartition("_")
        if stage in fw.INPUTS:  # one row a stage
            assert getattr(fw, stem.upper()) + VANES.index(stage) == i
        else:
            assert getattr(fw, "FAULT_BITS" if name == "faults" else name.upper()) == i
    assert [fw.STATE[fw.T_STALE + bit] for bit in range(fw.N_FAULTS)] == [  # timers in the order of the bits
        *(
            "t_stale",
            "t_rejected",
            "t_lvdt_range",
            "t_lvdt_rate",
            "t_lvdt_stuck",
            "t_tracking",
            "t_saturated",
            "t_demand_range",
        ),
        "t_paused",
    ]
