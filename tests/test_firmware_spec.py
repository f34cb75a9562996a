"""The firmware does what its pages say: tick by tick as a second controller written from them, and at each documented
number to both sides.

`tests/reference_controller.py` is that second controller. Numbers that stand in docs/controller.md are written out here
once more.
"""

from __future__ import annotations

import math
import random

import numpy as np
import pytest

from controller import FAULTS, MODES, new_inputs
from tests import columns as fw
from tests.columns import load_calibration, new_state, tick
from tests.reference_controller import Reference, clip, numbers

COLUMNS = ("n_dem", "n_r", "fresh", "rejected", "request", "x", "follows", "strength", "vigv", "vgv1", "vgv2", "pause")
GAIN = 0.150 / 0.040  # m/s per A
DEG = math.pi / 180.0
CALS = {s: load_calibration(strategy=s) for s in ("single", "dual", "inverse", "adaptive")}


def rows(n: int, n_dem=80.0, n_r=None, **more) -> np.ndarray:
    """``n`` ms of good inputs: a frame every 10 ms, the LVDT on the piston, no potentiometers."""
    out = np.zeros((n, len(COLUMNS)))
    out[:, 0] = n_dem
    out[:, 1] = n_dem if n_r is None else n_r
    out[:, 2] = np.arange(n) % 10 == 0
    out[:, 4] = out[:, 6] = out[:, 7] = 1.0
    out[:, 8:11] = np.nan
    for name, v in more.items():
        out[:, COLUMNS.index(name)] = v
    return out


class Machine:
    """Firmware on a piston that integrates its current; ``beside`` a reference that gets the same inputs, if there is
    one.
    """

    def __init__(self, strategy="dual", stroke=0.020, beside: bool = False, table_input="n_r", **changed):
        scalars = CALS[strategy].k.copy()
        for name, v in changed.items():
            scalars[fw.SCALARS.index(name)] = v
        scalars[fw.TABLE_INPUT] = float(table_input == "n_dem")
        self.cal, self.z, self.x, self.spool = CALS[strategy]._replace(k=scalars), new_state(), stroke, 0.0
        self.beside = Reference(self.cal, strategy, table_input, numbers(**changed)) if beside else None
        self.log = np.empty((0, fw.N_STATE))

    def play(self, inputs: np.ndarray) -> np.ndarray:
        """Run; return the state after each tick."""
        out = np.empty((len(inputs), fw.N_STATE))
        row = np.zeros(fw.N_INPUTS)
        for i, r in enumerate(inputs):
            x = r[5] + (self.x if r[6] else 0.0)
            row[[fw.IN_N_DEM, fw.IN_N_R, fw.IN_FRESH, fw.IN_REJECTED, fw.IN_MODE_REQUEST]] = r[:5]
            row[fw.IN_X_LVDT], row[fw.IN_VIGV : fw.IN_VIGV + 3], row[fw.IN_PAUSE] = x, r[8:11], r[11]
            tick(row, self.z, self.cal)
            out[i] = self.z
            if self.beside is not None:
                self.beside.tick(r[0], r[1], r[2] > 0.5, r[3], r[4], x, *r[8:])
                self.same(len(self.log) + i)
            self.spool += 0.3 * (self.z[fw.I_CMD] - self.spool)
            self.x = clip(self.x + r[7] * GAIN * self.spool * 1e-3, 0.0, 0.048)
        self.log = np.vstack([self.log, out])
        return out

    def same(self, i: int) -> None:
        """Fail with the first documented quantity that differs from the reference's."""
        z, b = self.z, self.beside
        assert MODES[int(z[fw.MODE])] == b.mode, f"mode at tick {i}"
        bits = sum(b.faults[name].on << bit for bit, name in enumerate(FAULTS))
        assert int(z[fw.FAULT_BITS]) == bits, f"faults at tick {i}"
        ours = z[
            [
                fw.X_MEAS,
                fw.X_DEM,
                fw.X_SERVO,
                fw.I_CMD,
                fw.INTEGRAL,
                fw.N_R,
                fw.DIRECTION,
                fw.BLEND,
                fw.X_TARGET,
                fw.TREND_RATE,
            ]
        ]
        theirs = [b.x, b.demand, b.reference, b.i, b.integral, b.n, b.d, b.blend, b.target, b.rate]
        names = (
            "x_meas",
            "x_dem",
            "x_servo",
            "i_cmd",
            "integral",
            "n_r",
            "direction",
            "blend",
            "x_target",
            "trend_rate",
        )
        for name, v, w in zip(names, ours, theirs, strict=True):
            assert abs(v - w) <= 1e-10, f"{name} at tick {i}: {v!r}, by the page {w!r}"

    def running(self, n_dem=80.0, n=400):
        self.play(rows(n, n_dem))
        assert self.mode == "RUN" and not self.faults
        return self

    @property
    def mode(self) -> str:
        return MODES[int(self.z[fw.MODE])]

    @property
    def faults(self) -> set[str]:
        return {name for bit, name in enumerate(FAULTS) if int(self.z[fw.FAULT_BITS]) >> bit & 1}


def first(states: np.ndarray, fault: str) -> int | None:
    """Tick, counted from 1, that sets the fault."""
    hits = np.flatnonzero(states[:, fw.FAULT_BITS].astype(int) >> FAULTS.index(fault) & 1)
    return int(hits[0]) + 1 if hits.size else None


# ---- the whole controller, tick by tick ------------------------------------------------------------------------------


def manoeuvres(seed: int, n: int = 3000) -> np.ndarray:
    """Ramps, dwells, small and large reversals; the measured speed lags behind."""
    rng = np.random.default_rng(seed)
    at = np.cumsum(rng.integers(100, 500, n // 200))
    to = 80.0 + rng.choice([0.2, 0.4, 2.0, 18.0], len(at)) * rng.normal(0.0, 1.0, len(at))
    speed = np.interp(np.arange(n), at, np.clip(to, 0.0, 120.0))
    return rows(
        n, speed, np.convolve(np.pad(speed, (99, 0), "edge"), np.ones(100) / 100.0, "valid") + rng.normal(0.0, 0.02, n)
    )


@pytest.mark.parametrize(("strategy", "table_input"), [("dual", "n_r"), ("dual", "n_dem"), ("single", "n_r")])
def test_ordinary_runs_are_those_of_the_page(strategy, table_input):
    m = Machine(strategy, beside=True, table_input=table_input)
    m.play(manoeuvres(3))
    assert m.mode == "RUN"


@pytest.mark.parametrize("seed", range(6))
def test_bad_days_are_those_of_the_page(seed):
    """Silence, refused and insane frames, standby, an LVDT that jumps, freezes, drops out, a weak and a blocked piston,
    in any order.
    """
    rng = np.random.default_rng(seed)
    m = Machine(stroke=rng.uniform(0.0, 0.048), beside=True)
    for _ in range(8):
        n = int(rng.choice([30, 60, 120, 300, 600]))
        r = manoeuvres(int(rng.integers(1000)), 1200)[:n]
        kind = rng.integers(0, 10)
        if kind == 0:
            r[:, 2] = 0.0
        elif kind == 1:
            r[rng.random(n) < rng.choice([0.02, 0.3]), 3] = rng.choice([1.0, 2.0])
        elif kind == 2:
            r[rng.random(n) < 0.1, rng.choice([0, 1, 4])] = rng.choice([-0.1, 120.1, 500.0, np.nan])
        elif kind == 3:
            r[:, 4] = 0.0
        elif kind == 4:
            r[rng.random(n) < rng.choice([0.05, 0.3, 0.95]), 5] = rng.choice([np.nan, 0.06, -0.06])
        elif kind == 5:
            r[rng.random(n) < rng.choice([0.02, 0.2]), 5] = rng.choice([0.0006, -0.004, 0.004])
        elif kind == 6:
            r[:, 5], r[:, 6] = m.z[fw.X_MEAS], 0.0
        elif kind == 7:
            r[:, 7] = rng.choice([0.0, 0.03])
        elif kind == 8:
            r[rng.integers(n, size=2), 11] = rng.choice([0.05, 0.3, 2.0])
        m.play(r)
    m.play(rows(2100))
    assert m.mode == "RUN" and not m.faults


# ---- each number of docs/controller.md, to both sides ----------------------------------------------------------------


def held(machine: Machine, n: int, x: float | np.ndarray, current: float) -> np.ndarray:
    """``n`` ticks with the LVDT at ``x`` and, before each, ``current`` as the last current commanded."""
    out = np.empty((n, fw.N_STATE))
    row = new_inputs()
    row[[fw.IN_N_DEM, fw.IN_N_R]] = 80.0
    for i in range(n):
        machine.z[fw.I_CMD] = current
        row[fw.IN_FRESH] = i % 10 == 0
        row[fw.IN_X_LVDT] = x[i] if np.ndim(x) else x
        tick(row, machine.z, machine.cal)
        out[i] = machine.z
    return out


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_a_current_at_either_limit_for_a_second_is_a_fault(way):
    """Extend and retract; the last tick but one is not, and a limit left for one tick starts the second anew."""
    m = Machine(tracking_limit=1.0, stroke=0.024).running(80.0)
    far = m.play(
        rows(1400, 80.0 + way * 18.0, strength=0.0, x=0.0)
    )  # a blocked piston: the stuck fault is masked below
    assert first(far, "lvdt_stuck")  # the other guard is quicker there
    m = Machine(tracking_limit=1.0, stuck_time=10.0).running(80.0)
    r = rows(3000, 80.0 + way * 18.0, strength=0.0)
    states = m.play(r)
    at = int(np.flatnonzero(states[:, fw.SATURATED] == 1.0)[0])
    assert (states[at : at + 1000, fw.I_CMD] == way * 0.040).all()
    assert first(states, "current_saturated") == at + 1000
    assert MODES[int(states[at + 999, fw.MODE])] == "DEGRADED" and MODES[int(states[at + 998, fw.MODE])] == "RUN"


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_the_integral_stops_at_the_limit_and_may_always_come_back(way):
    z = new_state()
    k = CALS["dual"].k
    z[fw.X_MEAS], z[fw.INTEGRAL] = 0.020, way * 0.010
    fw.servo_step(z, k, 0.020 + way * 0.005, 0.0)
    assert z[fw.I_CMD] == way * 0.040 and z[fw.INTEGRAL] == way * 0.010 and z[fw.SATURATED] == 1.0
    fw.servo_step(z, k, 0.020 - way * 1e-4, way * 1.0)  # limited by the feed-forward, with the error the other way
    assert z[fw.I_CMD] == way * 0.040 and z[fw.INTEGRAL] == pytest.approx(
        way * (0.010 - 100.0 * 1e-4 * 1e-3), abs=1e-12
    )
    assert z[fw.SATURATED] == 1.0
    fw.servo_step(z, k, 0.020, 0.0)
    assert z[fw.SATURATED] == 0.0 and z[fw.I_CMD] == pytest.approx(z[fw.INTEGRAL])
    z[fw.INTEGRAL] = way * 0.0399999
    fw.servo_step(z, k, 0.020 + way * 0.002, -way * 0.5)
    assert z[fw.INTEGRAL] == way * 0.040


@pytest.mark.parametrize("x", [0.00105, 0.04695])
@pytest.mark.parametrize("inside", [False, True])
def test_no_motion_is_expected_within_stuck_margin_of_either_limit(x, inside):
    """0.6 mm from 0.5 mm and from 47.5 mm: 1.1 and 46.9 mm."""
    m = Machine(stroke=x, tracking_limit=1.0)
    m.running(80.0)
    x += math.copysign(1e-4, 0.024 - x) if inside else 0.0
    m.z[fw.X_REACH] = 1.0
    assert (first(held(m, 400, x, 0.010), "lvdt_stuck") is not None) == inside


@pytest.mark.parametrize("side", ["low", "high"])
def test_at_the_margin_itself_no_motion_is_expected(side):
    m = Machine(stroke=0.002 if side == "low" else 0.046, tracking_limit=1.0).running(80.0)
    k = m.cal.k
    low, high = k[fw.STROKE_MIN] + k[fw.STUCK_MARGIN], k[fw.STROKE_MAX] - k[fw.STUCK_MARGIN]
    m.z[fw.X_REACH] = 1.0
    assert first(held(m, 300, low if side == "low" else high, 0.010), "lvdt_stuck") is None


@pytest.mark.parametrize(("request_run", "mode"), [(1.0, fw.RUN), (0.0, fw.STANDBY)])
def test_fail_safe_is_left_for_what_the_ecu_asks_for_and_nothing_between(request_run, mode):
    m = Machine().running(80.0)
    m.play(rows(40, x=np.nan, follows=0.0, strength=0.0))
    assert m.mode == "FAIL_SAFE"
    modes = m.play(rows(1600, request=request_run))[:, fw.MODE]
    assert set(modes) == {fw.FAIL_SAFE, mode} and m.mode == MODES[mode]


def test_a_cause_of_one_tick_heals_after_500_good_ones_and_an_lvdt_fault_after_1000():
    for column, value in ((0, 130.0), (3, 5.0)):
        m = Machine().running(80.0)
        r = rows(600)
        r[0, column] = value
        bits = m.play(r)[:, fw.FAULT_BITS]
        assert bits[0] and (bits > 0).sum() == 500 and not bits[500:].any()
    m = Machine().running(80.0)
    r = rows(1100, strength=0.0)
    r[:20, 5] = np.nan
    bits = m.play(r)[:, fw.FAULT_BITS]
    assert not bits[:19].any() and bits[19:1019].all() and not bits[1019:].any()


@pytest.mark.parametrize("way", [1.0, -1.0])
@pytest.mark.parametrize(("milliamps", "stuck"), [(7.9, False), (8.0, False), (8.1, True)])
def test_a_current_above_8_ma_must_move_the_piston_either_way(way, milliamps, stuck):
    m = Machine(tracking_limit=1.0).running(80.0)
    states = held(m, 400, m.z[fw.X_MEAS], way * milliamps * 1e-3)
    assert first(states, "lvdt_stuck") == (200 if stuck else None)


@pytest.mark.parametrize("way", [1.0, -1.0])
@pytest.mark.parametrize(("micrometres", "stuck"), [(98.0, True), (102.0, False)])
def test_less_motion_than_a_tenth_of_a_millimetre_is_none(way, micrometres, stuck):
    m = Machine(tracking_limit=1.0).running(80.0)
    x = m.z[fw.X_MEAS] + way * micrometres * 1e-6 * np.minimum(np.arange(1, 301) / 190.0, 1.0)
    states = held(m, 300, x, way * 0.010)
    assert first(states, "lvdt_stuck") == (200 if stuck else None)


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_a_tenth_of_a_millimetre_is_motion(way):
    z = new_state()
    z[fw.STUCK_TIMER] = 0.2
    row = np.zeros(fw.N_INPUTS)
    row[fw.IN_X_LVDT] = way * CALS["dual"].k[fw.STUCK_MOTION]
    tick(row, z, CALS["dual"])
    assert z[fw.STUCK_TIMER] == 0.0 and z[fw.STUCK_X] == row[fw.IN_X_LVDT]


@pytest.mark.parametrize(("before", "fault"), [(18.4, False), (18.5, True), (19.0, True)])
def test_bad_samples_and_tenths_of_them_count_to_the_nearest_whole_one(before, fault):
    z = new_state()
    z[fw.T_LVDT_RANGE] = before * 1e-3
    row = np.zeros(fw.N_INPUTS)
    row[fw.IN_X_LVDT] = math.nan
    tick(row, z, CALS["dual"])
    assert bool(int(z[fw.FAULT_BITS]) & 1 << fw.F_LVDT_RANGE) == fault


@pytest.mark.parametrize(("mm", "good"), [(-1.0, True), (-1.001, False), (49.0, True), (49.001, False)])
def test_the_lvdt_range_is_from_minus_1_to_49_mm(mm, good):
    m = Machine(stroke=0.0 if mm < 0 else 0.048)
    m.play(rows(50))
    m.z[fw.X_REACH] = 1.0
    states = m.play(rows(40, x=mm * 1e-3, follows=0.0))
    assert states[0, fw.LVDT_GOOD] == good and first(states, "lvdt_range") == (None if good else 20)


@pytest.mark.parametrize("way", [1.0, -1.0])
@pytest.mark.parametrize(("mm", "good"), [(0.499, True), (0.501, False)])
@pytest.mark.parametrize("missing", [0, 3])
def test_a_jump_is_what_500_mm_per_second_cannot_do_since_the_last_good_sample(way, mm, good, missing):
    m = Machine().running(80.0)
    x = m.z[fw.X_MEAS]
    r = rows(missing + 1, x=np.nan, follows=0.0)
    r[-1, 5] = x + way * mm * 1e-3 * (missing + 1)
    assert m.play(r)[-1, fw.LVDT_GOOD] == good


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_what_500_mm_per_second_can_just_do_is_no_jump(way):
    z = new_state()
    z[fw.X_REACH] = 0.0
    row = np.zeros(fw.N_INPUTS)
    row[fw.IN_X_LVDT] = way * 0.0005
    tick(row, z, CALS["dual"])
    assert z[fw.LVDT_GOOD] == 1.0 and z[fw.X_MEAS] == way * 0.0005


def test_a_good_sample_takes_back_a_tenth_of_a_bad_one():
    """One bad in eleven never adds up; one in ten does, slowly: 200 bad ones gain nothing, two bad to eighteen good
    gain a fifth a turn.
    """
    m = Machine().running(80.0)
    r = rows(3300)
    r[::11, 5] = np.nan
    assert first(m.play(r), "lvdt_range") is None
    r = rows(3300)
    r[::9, 5] = np.nan
    # each turn of 9 leaves 0.2 of a sample: 0.2 n + 1 is 20, to half a sample, at n = 93
    assert first(m.play(r), "lvdt_range") == 9 * 93 + 1


def test_four_jumps_are_a_fault_and_three_are_not():
    for jumps in (3, 4):
        for apart in (1, 2):  # a good sample between two takes back 0.1 of 20
            m = Machine().running(80.0)
            r = rows(60)
            r[: apart * jumps : apart, 5] = 0.003
            assert first(m.play(r), "lvdt_rate") == (1 + 3 * apart if jumps == 4 else None)


@pytest.mark.parametrize("way", [1.0, -1.0])
@pytest.mark.parametrize(("mm", "fault"), [(1.99, None), (2.01, 500)])
def test_tracking_is_a_fault_beyond_2_mm_for_half_a_second(way, mm, fault):
    m = Machine(stuck_time=10.0).running(80.0)
    x = m.z[fw.X_SERVO] + way * mm * 1e-3
    m.z[fw.X_REACH] = 1.0
    m.x = x
    assert first(m.play(rows(700, strength=0.0, x=x, follows=0.0)), "tracking") == fault


@pytest.mark.parametrize("way", [1.0, -1.0])
@pytest.mark.parametrize(("beside", "bad"), [(0.0, False), (1e-9, True)])
def test_just_2_mm_is_not_beyond_the_tracking_limit(way, beside, bad):
    z = new_state()
    z[fw.MODE], z[fw.TICKS] = fw.STANDBY, 101
    z[fw.X_DEM] = z[fw.X_FROM] = CALS["dual"].k[fw.TRACKING_LIMIT]
    row = np.zeros(fw.N_INPUTS)
    row[fw.IN_X_LVDT] = (1.0 - way) * z[fw.X_DEM] - way * beside
    tick(row, z, CALS["dual"])
    assert (z[fw.T_TRACKING] > 0.0) == bad


@pytest.mark.parametrize(("speed", "good"), [(0.0, True), (-1e-6, False), (120.0, True), (120.000001, False)])
@pytest.mark.parametrize("column", [0, 1])
def test_a_speed_counts_from_0_to_120_per_cent(speed, good, column):
    m = Machine().running(80.0)
    r = rows(10)
    r[:, column] = speed
    states = m.play(r)
    assert (first(states, "demand_range") is None) == good
    assert (states[0, (fw.N_DEM, fw.N_R_RAW)[column]] == speed) == good


@pytest.mark.parametrize(
    ("asked", "good", "run"), [(0.0, True, False), (1.0, True, True), (-1e-9, False, True), (1.0000001, False, True)]
)
def test_a_mode_request_is_0_or_1(asked, good, run):
    m = Machine().running(80.0)
    states = m.play(rows(1, request=asked))
    assert (first(states, "demand_range") is None) == good and (states[0, fw.RUN_REQUEST] == 1.0) == run


def test_the_bucket_empties_at_ten_a_second():
    m = Machine().running(80.0)
    r = rows(1000)
    r[0, 3] = 4.9
    states = m.play(r)
    assert first(states, "demand_rejected") is None
    assert states[489, fw.REJECT_BUCKET] > 1e-9 and states[490, fw.REJECT_BUCKET] < 1e-9
    assert (states[491:, fw.REJECT_BUCKET] == 0.0).all()


def test_silence_is_counted_from_the_last_good_frame_and_heals_after_500_good_ticks():
    m = Machine().running(80.0)
    r = rows(800, fresh=0.0)
    r[0, 2] = 1.0
    assert first(m.play(r[:300]), "demand_stale") == 51  # the tick with the frame, and 50 without
    back = m.play(rows(600))
    healed = np.flatnonzero(back[:, fw.FAULT_BITS] == 0.0)
    assert healed[0] + 1 == 500 == np.flatnonzero(back[:, fw.MODE] == fw.RUN)[0] + 1


def test_a_table_is_exact_at_each_of_its_points():
    rng = np.random.default_rng(5)
    for _ in range(60):
        n = int(rng.integers(2, 8))
        table = np.vstack([np.cumsum(rng.uniform(0.1, 3.0, n)), rng.normal(size=n)])
        assert [fw.look_up(0, 1, table, v) for v in table[0]] == table[1].tolist()
        for v in rng.uniform(table[0, 0] - 1.0, table[0, -1] + 1.0, 8):
            assert fw.look_up(0, 1, table, v) == pytest.approx(np.interp(v, *table), abs=1e-12)


# ---- direction: the times of the page --------------------------------------------------------------------------------


def turn_time(rate: float, side: float) -> tuple[float, int]:
    """Seconds from the reversal of a ramp to the turn of the direction, and the number of turns."""
    n = int(2.0 / rate * 100) + 200
    ramp = rate * 0.01 * np.arange(n)
    demand = 60.0 + side * np.concatenate([np.zeros(10), ramp, ramp[-1] - ramp[1:]])
    z = new_state()
    z[fw.TREND_N] = z[fw.TREND_TURN] = z[fw.TREND_LAST] = demand[0]
    z[fw.DIRECTION] = side
    turned = []
    for i, n_dem in enumerate(demand):
        fw.trend_step(z, CALS["dual"].k, n_dem)
        if z[fw.DIRECTION] != (turned and -side or side):
            turned.append(i)
    return (turned[0] - (10 + n - 1)) * 0.01 if turned else math.nan, len(turned)


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize(("rate", "seconds"), [(0.1, 2.6), (1.0, 0.48), (2.0, 0.36), (5.0, 0.21), (20.0, 0.13)])
def test_a_ramp_the_other_way_turns_the_direction_after_the_documented_time(rate, seconds, side):
    found, turns = turn_time(rate, side)
    assert turns == 1
    assert found == pytest.approx(seconds, abs=0.06 if rate < 1.0 else 0.006)


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize(("back", "steps", "turns"), [(0.24, 1, 0), (0.26, 1, 1), (0.49, 200, 0), (0.51, 2000, 1)])
def test_a_reversal_turns_beyond_a_quarter_per_cent_moving_and_half_a_per_cent_creeping(back, steps, turns, side):
    """A quarter at 2 %/s; creeping at 0.04 %/s the whole half."""
    rate = 2.0 if steps == 1 else 0.04
    n = max(int(back / rate * 100), 1)
    demand = 80.0 + side * np.concatenate(
        [np.zeros(400), -back * np.arange(1, n + 1) / n, np.full(8 if rate == 2.0 else 30, -back)]
    )
    demand = np.append(demand, np.full(3, demand[-1]))
    z = new_state()
    z[fw.TREND_N] = z[fw.TREND_TURN] = z[fw.TREND_LAST] = 80.0
    z[fw.DIRECTION] = side
    k = CALS["dual"].k.copy()
    seen = 0
    for n_dem in demand:
        before = z[fw.DIRECTION]
        fw.trend_step(z, k, n_dem)
        seen += z[fw.DIRECTION] != before
    assert seen == turns


def test_a_turn_takes_ten_steps_without_a_gap():
    for gap in (None, 5):
        z = new_state()
        z[fw.TREND_N] = z[fw.TREND_TURN] = z[fw.TREND_LAST] = 80.0
        steps = 0
        for i in range(40):
            fw.trend_step(z, CALS["dual"].k, 80.0 if i == gap else 79.0)
            steps += 1
            if z[fw.DIRECTION] < 0.0:
                break
        assert steps == (10 if gap is None else 16)


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize(
    ("back", "rate", "due"), [(0.25, 1.0, False), (0.26, 0.06, False), (0.26, 0.061, True), (0.5, 0.0, False)]
)
def test_what_is_just_at_a_limit_of_the_direction_is_not_beyond_it(back, rate, due, side):
    k = CALS["dual"].k.copy()
    k[fw.TREND_BETA] = 0.0  # the rate stays
    z = new_state()
    z[fw.DIRECTION], z[fw.TREND_RATE] = side, -side * rate
    z[fw.TREND_N] = z[fw.TREND_LAST] = 80.0
    z[fw.TREND_TURN] = 80.0 + side * back
    fw.trend_step(z, k, 80.0)
    assert (z[fw.TREND_TIMER] > 0.0) == due


# ---- a calibration of one's own --------------------------------------------------------------------------------------


@pytest.mark.parametrize(("beside", "whole"), [(0.45, 0), (-0.45, 0), (0.55, 1)])
@pytest.mark.parametrize(
    ("name", "fault", "inputs"),
    [
        ("demand_timeout", "demand_stale", {"fresh": 0.0}),
        ("lvdt_debounce", "lvdt_range", {"x": math.nan, "follows": 0.0}),
        ("tracking_time", "tracking", {"strength": 0.0, "x": 0.003}),
        ("saturated_time", "current_saturated", {"strength": 0.0, "x": 0.004}),
    ],
)
def test_a_time_between_two_ticks_is_that_of_the_nearer_one(name, fault, inputs, beside, whole):
    ticks = 20
    m = Machine(**{"stuck_time": 10.0, name: (ticks + beside) * 1e-3}).running(80.0)
    m.play(rows(1))
    m.z[fw.X_REACH] = 1.0
    assert first(m.play(rows(100, **inputs)), fault) == ticks + whole


@pytest.mark.parametrize(("asked", "given"), [(0.030, 0.030), (0.050, 0.040), (-0.050, -0.040)])
def test_the_fail_safe_current_is_within_the_limit_too(asked, given):
    m = Machine(fail_safe_current=asked).running(80.0)
    assert m.play(rows(30, x=math.nan, follows=0.0))[-1, fw.I_CMD] == given


@pytest.mark.parametrize(("start", "asked", "end"), [(0.0006, 0.0, 0.0005), (0.0474, 0.048, 0.0475)])
def test_the_stroke_demand_ends_at_its_limits_whatever_is_asked_for(start, asked, end):
    z = new_state()
    z[fw.X_DEM] = start
    fw.move_demand(z, CALS["dual"].k, asked, 0.1)
    assert z[fw.X_DEM] == end and z[fw.X_FROM] == start


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_a_current_of_just_the_limit_is_not_limited(way):
    k, z = CALS["dual"].k.copy(), new_state()
    k[fw.KFF] = 1.0
    fw.servo_step(z, k, 0.0, way * k[fw.CURRENT_LIMIT])
    assert z[fw.I_CMD] == way * 0.040 and z[fw.SATURATED] == 0.0


def test_a_gain_that_is_no_number_gives_no_current():
    m = Machine(kp=math.nan)
    assert (m.play(rows(100))[:, fw.I_CMD] == 0.0).all() and m.mode == "RUN"


def test_a_pause_without_end_leaves_a_state_of_finite_numbers():
    m = Machine().running(80.0)
    m.play(rows(1, pause=math.inf, fresh=0.0))
    assert np.isfinite(m.z).all() and m.mode == "FAIL_SAFE" and m.faults == {"demand_stale", "paused"}


# ---- play and learning: each step from any state ---------------------------------------------------------------------


def any_state(rng: random.Random) -> np.ndarray:
    """A state of a running controller, its numbers often exactly on a limit."""
    z = new_state()
    pick = rng.choice
    z[fw.MODE] = pick([fw.RUN, fw.RUN, fw.RUN, fw.STANDBY])
    z[fw.N_DEM] = rng.uniform(50.0, 102.0)
    z[fw.N_R] = z[fw.N_DEM] + pick([0.0, 0.1, -5.0, 9.0, -13.0])
    z[fw.N_R_RAW] = z[fw.N_R] + rng.gauss(0.0, pick([0.02, 0.6]))
    z[fw.SPEED] = z[fw.N_R] + rng.gauss(0.0, pick([0.02, 0.3]))
    z[fw.SPEED_RATE], z[fw.SPEED_DRIFT] = rng.gauss(0.0, 1.0), pick([0.0, 1.0, -1.0, 2.999, -2.999])
    z[fw.SPEED_NOISE] = pick([0.0, 4e-4, 1e-2])
    z[fw.TREND_RATE] = rng.gauss(0.0, 1.0)
    z[fw.DEMAND_AGE] = pick([0.0, 0.005, 0.009, 0.010, 0.049, 0.050, 0.2])
    z[fw.DIRECTION] = pick([1.0, -1.0])
    z[fw.X_DEM] = rng.uniform(0.0005, 0.0475)
    z[fw.X_FROM] = z[fw.X_DEM] + pick([0.0, 0.0, 1.9e-5, 2.1e-5, 1e-4]) * pick([1.0, -1.0])
    z[fw.X_MEAS] = z[fw.X_DEM] + pick([0.0, 9e-5, 1.1e-4]) * pick([1.0, -1.0])
    z[fw.X_SLOW] = z[fw.X_DEM] + pick([0.0, 2.9e-5, 3.1e-5, 2e-3]) * pick([1.0, -1.0])
    z[fw.SIDE] = pick([0.0, 1.0, -1.0])
    z[fw.CROSSING] = pick([-1.0, 1.0, rng.uniform(-1.0, 1.0)])
    z[fw.QUIET] = pick([0.0, 0.05, 0.09, 0.1, 0.995, 1.0])
    z[fw.OFFSET_IN_USE], z[fw.WIDTH_IN_USE] = rng.gauss(0.0, 0.2 * DEG), rng.gauss(0.0, 0.2 * DEG)
    for j in range(3):
        z[fw.ENGAGED + j] = pick([0.0, 1.0, 1.0, -1.0, -1.0])
        z[fw.TRUSTED + j] = pick([0.0, 1.0, 1.0])
        z[fw.SUSPECT + j] = pick([0.0, 0.0, 0.01, 0.4, 0.79, 0.8, 0.81, 1.0, 1.16])
        z[fw.POT_SEEN + j] = pick([0.0, 1.0, 1.0, 1.0])
        z[fw.OFFSET + j] = pick([0.0, 0.3, -0.3, 0.7499, -0.7499]) * DEG
        z[fw.WIDTH + j] = pick([0.0, 0.3, -0.3, 1.1999, -1.1999, -0.4]) * DEG
        z[fw.PROVED_OFFSET + j] = z[fw.OFFSET + j] + pick([0.0, 0.2999, -0.2999, 0.1]) * DEG
        z[fw.PROVED_WIDTH + j] = z[fw.WIDTH + j] + pick([0.0, 0.2999, -0.2999, 0.1]) * DEG
        z[fw.LEARNED_UP + j] = pick([0.0, 10.0, 14.99, 15.0, 20.0, 29.999, 30.0])
        z[fw.LEARNED_DOWN + j] = pick([0.0, 10.0, 14.99, 15.0, 20.0, 29.999, 30.0])
        angle = np.interp(z[fw.X_DEM], CALS["inverse"].angles[0], CALS["inverse"].angles[1 + j])
        z[fw.FARTHEST + j] = angle + rng.gauss(0.0, pick([0.01, 0.5, 3.0])) * DEG
        expected = z[fw.FARTHEST + j] + z[fw.OFFSET + j]
        z[fw.POT + j] = expected + rng.gauss(0.0, pick([0.05, 1.0, 3.0])) * DEG
        z[fw.LOWEST + j] = expected - pick([0.0, 2.0, 5.0, 7.0]) * DEG
        z[fw.HIGHEST + j] = expected + pick([0.0, 2.0, 5.0, 7.0]) * DEG
    if rng.random() < 0.5:  # the vane near its target, the stroke somewhere in the gap
        strokes, vigv = CALS["inverse"].angles[:2]
        goal = (
            np.interp(np.interp(z[fw.SPEED], *CALS["inverse"].table[[0, 3]]), strokes, vigv) + rng.gauss(0.0, 0.2) * DEG
        )
        width = 1.6 * DEG + z[fw.WIDTH_IN_USE]
        z[fw.FARTHEST] = goal + 0.5 * z[fw.ENGAGED] * width - z[fw.OFFSET_IN_USE]
        stroke = np.interp(z[fw.FARTHEST] - z[fw.ENGAGED] * rng.uniform(-0.1, 1.1) * width, vigv, strokes)
        z[[fw.X_FROM, fw.X_MEAS, fw.X_SLOW]] += stroke - z[fw.X_DEM]
        z[fw.X_DEM] = stroke
    return z


def any_machine(rng: random.Random) -> np.ndarray:
    """A state of a controller in any mode with any faults, its timers often one tick before their end."""
    z, pick, ms = any_state(rng), rng.choice, 1e-3
    mode = z[fw.MODE] = rng.randrange(5)
    z[fw.TICKS] = pick([0, 40, 48, 49, 50, 60] if mode == fw.INIT else [100, 200, 200, 300, 509, 999])
    z[fw.DEMAND_SEEN], z[fw.RUN_REQUEST], z[fw.LVDT_GOOD], z[fw.SATURATED] = [
        rng.random() < chance for chance in (0.8, 0.7, 0.9, 0.2)
    ]
    z[fw.REJECT_BUCKET] = pick([0.0, 0.0, 0.005, 0.4, 3.0, 4.005, 4.02, 5.0])
    z[fw.TREND_N] = z[fw.TREND_LAST] = z[fw.N_DEM] + pick([0.0, 0.1, 0.3, -0.1, -0.3])
    z[fw.TREND_LAST] += pick([0.0, 0.0, 0.02, -0.02, 0.6, -0.6])
    z[fw.TREND_RATE] = pick([0.0, 0.059, 0.061, -0.059, -0.061, 2.0, -2.0])
    z[fw.TREND_TURN] = z[fw.N_DEM] + pick([0.0, 0.24, 0.26, 0.49, 0.51, 2.0]) * pick([1.0, 1.0, -1.0]) * z[fw.DIRECTION]
    z[fw.TREND_TIMER] = pick([0.0, 0.05, 0.08, 0.09, 0.09])
    z[fw.BLEND] = pick([0.0, 1.0, 0.5, 0.01, 0.99])
    z[fw.X_TARGET] = z[fw.X_DEM] + rng.gauss(0.0, pick([1e-5, 1e-3, 1e-2]))
    z[fw.X_REACH] = pick([0.0, 0.0, 1e-3, 1.0])
    z[fw.STUCK_X] = z[fw.X_MEAS] + pick([0.0, 9e-5, 1.1e-4, 1e-3]) * pick([1.0, -1.0])
    z[fw.STUCK_TIMER] = pick([0, 100, 198, 199, 200]) * ms
    z[fw.INTEGRAL], z[fw.I_CMD] = (
        pick([0.0, 0.01, -0.01, 0.03999, -0.03999]),
        pick([0.0, 0.0079, -0.0079, 0.0081, -0.0081, 0.04]),
    )
    z[fw.RECOVER_TIMER], z[fw.DEGRADED_TIMER] = (pick([0, 100, 498, 499]) * ms for _ in range(2))
    few = rng.random() < 0.7
    for bit, f in enumerate(taken_from(z).faults.values()):
        if rng.random() < (0.05 if few else 0.4):
            z[fw.FAULT_BITS] += 1 << bit
            z[fw.T_STALE + bit] = -pick([0, 0, 1, f.heal - 2, f.heal - 1]) * ms
        else:
            z[fw.T_STALE + bit] = pick([0, 0, max(f.after - 2, 0), f.after - 1]) * ms
    return z


def any_inputs(rng: random.Random, z: np.ndarray) -> np.ndarray:
    """Inputs of one tick, often at a limit, sometimes beyond one."""
    row, pick = np.zeros(fw.N_INPUTS), rng.choice
    row[fw.IN_N_DEM], row[fw.IN_N_R] = z[fw.N_DEM] + rng.gauss(0.0, 0.3), z[fw.N_DEM] + rng.gauss(0.0, 3.0)
    if rng.random() < 0.15:
        row[pick([fw.IN_N_DEM, fw.IN_N_R])] = pick([-0.001, 0.0, 120.0, 120.001, np.nan])
    row[fw.IN_FRESH] = rng.random() < 0.6
    row[fw.IN_REJECTED] = pick([0.0, 0.0, 0.0, 0.5, 1.0, 2.0, 5.0, -1.0, math.nan])
    row[fw.IN_MODE_REQUEST] = pick([0.0, 1.0, 1.0, 1.0, 1.0, 0.5, 0.51, -0.01, 1.01, np.nan])
    row[fw.IN_X_LVDT] = z[fw.X_MEAS] + pick(
        [0.0, 1e-5, 0.9e-4, 1.1e-4, 0.499e-3, 0.501e-3, 1.499e-3, 1.501e-3, 0.01]
    ) * pick([1.0, -1.0])
    if rng.random() < 0.15:
        row[fw.IN_X_LVDT] = pick([-0.000999, -0.001001, 0.048999, 0.049001, np.nan, np.inf])
    for j in range(3):
        row[fw.IN_VIGV + j] = z[fw.POT + j] + rng.gauss(0.0, 0.01) if rng.random() < 0.7 else math.nan
    row[fw.IN_PAUSE] = pick([0.05, 0.3, 3.0, -1.0, math.nan]) if rng.random() < 0.1 else 0.0
    return row


def taken_from(z: np.ndarray, table_input: str = "n_r", strategy: str = "adaptive", **changed) -> Reference:
    """A reference in the state ``z``."""
    b = Reference(CALS[strategy], strategy, table_input, numbers(**changed))
    b.ticks, b.i, b.reach, b.plausible = int(z[fw.TICKS]), z[fw.I_CMD], z[fw.X_REACH], z[fw.LVDT_GOOD] == 1.0
    b.stuck_from, b.stuck_for, b.bucket = z[fw.STUCK_X], round(z[fw.STUCK_TIMER] * 1000), z[fw.REJECT_BUCKET]
    b.seen, b.run, b.filtered, b.turn = (
        z[fw.DEMAND_SEEN] == 1.0,
        z[fw.RUN_REQUEST] == 1.0,
        z[fw.TREND_N],
        z[fw.TREND_TURN],
    )
    b.last, b.due, b.blend, b.target = z[fw.TREND_LAST], round(z[fw.TREND_TIMER] * 100), z[fw.BLEND], z[fw.X_TARGET]
    b.reference, b.integral, b.limited = z[fw.X_SERVO], z[fw.INTEGRAL], z[fw.SATURATED] == 1.0
    b.recovering, b.degraded = (round(z[at] * 1000) for at in (fw.RECOVER_TIMER, fw.DEGRADED_TIMER))
    for bit, f in enumerate(b.faults.values()):
        f.on, t = bool(int(z[fw.FAULT_BITS]) >> bit & 1), z[fw.T_STALE + bit] * 1000
        f.bad, f.good = (0.0, round(-t)) if f.on else (t, 0)
    b.mode, b.n_dem, b.n, b.raw = MODES[int(z[fw.MODE])], z[fw.N_DEM], z[fw.N_R], z[fw.N_R_RAW]
    b.speed, b.drift, b.noise, b.rate = z[fw.SPEED], z[fw.SPEED_DRIFT], z[fw.SPEED_NOISE], z[fw.TREND_RATE]
    b.age, b.d, b.speed_rate = round(z[fw.DEMAND_AGE] * 1000), int(z[fw.DIRECTION]), z[fw.SPEED_RATE]
    b.demand, b.before, b.x, b.slow_x = z[fw.X_DEM], z[fw.X_FROM], z[fw.X_MEAS], z[fw.X_SLOW]
    b.side, b.crossing, b.still = int(z[fw.SIDE]), z[fw.CROSSING], z[fw.QUIET]
    b.used = z[[fw.OFFSET_IN_USE, fw.WIDTH_IN_USE]].copy()
    three = {n: z[at : at + 3].copy() for n, at in ROWS.items()}
    b.far, b.on_side, b.pot, b.pot_seen = three["far"], three["on_side"], three["pot"], three["seen"] == 1.0
    b.doubt, b.trusted, b.low, b.high = three["doubt"], three["trusted"] == 1.0, three["low"], three["high"]
    b.known = np.stack([three["offset"], three["width"]], 1)
    b.proved = np.stack([three["proved_offset"], three["proved_width"]], 1)
    b.learned = np.stack([three["up"], three["down"]], 1)
    return b


ROWS = {
    "far": fw.FARTHEST, "on_side": fw.ENGAGED, "pot": fw.POT, "seen": fw.POT_SEEN, "doubt": fw.SUSPECT,
    "trusted": fw.TRUSTED,
    "low": fw.LOWEST, "high": fw.HIGHEST, "offset": fw.OFFSET, "width": fw.WIDTH, "proved_offset": fw.PROVED_OFFSET,
    "proved_width": fw.PROVED_WIDTH, "up": fw.LEARNED_UP, "down": fw.LEARNED_DOWN,
}  # fmt: skip


def assert_same_state(z: np.ndarray, b: Reference, what: str) -> None:
    theirs = {
        "far": b.far, "on_side": b.on_side, "pot": b.pot, "seen": b.pot_seen, "doubt": b.doubt, "trusted": b.trusted,
        "low": b.low,
        "high": b.high, "offset": b.known[:, 0], "width": b.known[:, 1], "proved_offset": b.proved[:, 0],
        "proved_width": b.proved[:, 1],
        "up": b.learned[:, 0], "down": b.learned[:, 1],
    }  # fmt: skip
    ours = np.concatenate([z[at : at + 3] for at in ROWS.values()] + [z[SCALARS]])
    rest = [b.speed, b.speed_rate, b.drift, b.noise, b.side, b.crossing, b.still, *b.used, b.target]
    off = np.flatnonzero(np.abs(ours - np.concatenate([theirs[name] for name in ROWS] + [rest])) > 1e-11)
    assert off.size == 0, f"{what}: {([n for n in ROWS for _ in range(3)] + [fw.STATE[i] for i in SCALARS])[off[0]]}"


SCALARS = [
    fw.SPEED, fw.SPEED_RATE, fw.SPEED_DRIFT, fw.SPEED_NOISE, fw.SIDE, fw.CROSSING, fw.QUIET, fw.OFFSET_IN_USE,
    fw.WIDTH_IN_USE, fw.X_TARGET,
]  # fmt: skip


def assert_same_machine(z: np.ndarray, b: Reference, what: str) -> None:
    """Everything that is not of play and learning."""
    ms = 1e-3
    theirs = {
        fw.MODE: MODES.index(b.mode), fw.TICKS: b.ticks,
        fw.FAULT_BITS: sum(f.on << bit for bit, f in enumerate(b.faults.values())),
        fw.N_DEM: b.n_dem, fw.N_R_RAW: b.raw, fw.N_R: b.n, fw.DEMAND_AGE: b.age * ms, fw.REJECT_BUCKET: b.bucket,
        fw.DEMAND_SEEN: b.seen,
        fw.RUN_REQUEST: b.run, fw.TREND_N: b.filtered, fw.TREND_RATE: b.rate, fw.TREND_TURN: b.turn,
        fw.TREND_TIMER: b.due * 0.01,
        fw.TREND_LAST: b.last, fw.DIRECTION: b.d, fw.BLEND: b.blend, fw.X_TARGET: b.target, fw.X_DEM: b.demand,
        fw.X_FROM: b.before,
        fw.X_SERVO: b.reference, fw.X_MEAS: b.x, fw.LVDT_GOOD: b.plausible, fw.STUCK_X: b.stuck_from,
        fw.STUCK_TIMER: b.stuck_for * ms, fw.INTEGRAL: b.integral, fw.I_CMD: b.i, fw.SATURATED: b.limited,
        fw.SPEED: b.speed,
        fw.RECOVER_TIMER: b.recovering * ms, fw.DEGRADED_TIMER: b.degraded * ms,
        **{fw.T_STALE + bit: (-f.good if f.on else f.bad) * ms for bit, f in enumerate(b.faults.values())},
    }  # fmt: skip
    anywhere = 0.05  # m: the LVDT's whole range
    theirs[fw.X_REACH], z[fw.X_REACH] = min(b.reach, anywhere), min(z[fw.X_REACH], anywhere)
    for at, v in theirs.items():
        assert abs(z[at] - v) <= 1e-10, f"{what}: {fw.STATE[at]} {z[at]!r}, by the page {float(v)!r}"


@pytest.mark.parametrize("seed", range(10))
def test_a_tick_is_that_of_the_page_from_any_state(seed):
    rng = random.Random(seed)
    for i in range(10 if seed < 4 else 50 if seed < 8 else 200):
        strategy, by = (
            rng.choice(["dual", "dual", "single", "inverse", "adaptive"]),
            rng.choice(["n_r", "n_r", "n_dem"]),
        )
        z = any_machine(rng)
        row = any_inputs(rng, z)
        b = taken_from(z, by, strategy)
        k = CALS[strategy].k.copy()
        k[fw.TABLE_INPUT] = float(by == "n_dem")
        tick(row, z, CALS[strategy]._replace(k=k))
        refused, pause = (
            v if v > 0.0 else 0.0 for v in row[[fw.IN_REJECTED, fw.IN_PAUSE]]
        )  # less than none, NaN: none
        b.tick(row[0], row[1], row[2] > 0.5, refused, *row[4:9], pause)
        assert_same_machine(z, b, f"state {i}, {strategy}")
        assert_same_state(z, b, f"state {i}, {strategy}")
        assert strategy == "dual" or strategy == "single" or abs(z[fw.X_SLOW] - b.slow_x) <= 1e-12


def test_crossing_the_play_is_that_of_the_page_from_any_state():
    rng = random.Random(1)
    cal = CALS["adaptive"]
    for i in range(300):
        z = any_state(rng)
        by = "n_dem" if i % 8 == 0 else "n_r"
        scalars = cal.k.copy()
        scalars[fw.TABLE_INPUT] = float(by == "n_dem")
        b = taken_from(z, by)
        if i % 16 == 3:  # a schedule that falls
            b.table = cal.table.copy()
            b.table[fw.ROW_SINGLE] = cal.table[fw.ROW_SINGLE, ::-1]
        fw.inverse_step(z, scalars, b.table, cal.angles)
        b._inverse()
        assert_same_state(z, b, f"state {i}")


def test_learning_is_that_of_the_page_from_any_state():
    rng = random.Random(2)
    for i in range(450):
        z = any_state(rng)
        b = taken_from(z)
        fw.learn(z, CALS["adaptive"].k)
        b._learn()
        assert_same_state(z, b, f"state {i}")


def at_rest(side: float, point: int, play: float, off: float, noise: float = 0.0, **changed: float) -> np.ndarray:
    """State after one step with the demand at a ``point`` of the schedule and the vane ``off`` (rad) its target there,
    along ``side``.
    """
    cal = CALS["inverse"]
    k = cal.k.copy()
    k[fw.TABLE_INPUT], k[fw.PLAY_VIGV] = 1.0, play
    for name, v in changed.items():
        k[fw.SCALARS.index(name)] = v
    z = new_state()
    z[fw.N_DEM], stroke = cal.table[fw.ROW_SPEED, point], cal.table[fw.ROW_SINGLE, point]
    drive = np.interp(stroke, *cal.angles[:2]) + side * off
    z[fw.FARTHEST] = drive + 0.5 * side * play
    z[fw.X_DEM] = z[fw.X_SLOW] = stroke if off == 0.0 else np.interp(drive, cal.angles[1], cal.angles[0])
    z[fw.ENGAGED : fw.ENGAGED + 3] = z[fw.SIDE] = z[fw.CROSSING] = side
    z[fw.SPEED_NOISE] = noise
    fw.inverse_step(z, k, cal.table, cal.angles)
    return z


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("noise", [0.0, 0.01, 0.2])
def test_the_vane_turns_round_beyond_the_band_and_not_within_it(side, noise):
    """0.05 deg, and 8 times what is left of the noise behind the observer (alpha 0.05), through the slope of the
    schedule.
    """
    cal, point = CALS["inverse"], 7
    n = cal.table[0, point] + np.array([-0.5, 0.5])
    slope = abs(np.diff(np.interp(np.interp(n, *cal.table[[0, 3]]), *cal.angles[:2]))[0])
    band = 0.05 * DEG + 8.0 * slope * math.sqrt(noise * 0.05 / 1.95)
    for off in (0.999 * band, 1.001 * band):
        z = at_rest(side, point, 1.6 * DEG + 2.0 * band, off, noise)
        assert (z[fw.SIDE] == side) == (off < band)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_vane_at_its_target_turns_round_for_nothing_even_without_a_band(side):
    z = at_rest(side, 7, 0.0, 0.0, turn_band=0.0)
    assert z[fw.SIDE] == z[fw.CROSSING] == side


@pytest.mark.parametrize("way", [1.0, -1.0])
@pytest.mark.parametrize(("beyond", "doubt"), [(0.0, 0.38), (1e-9, 0.6)])
def test_a_reading_just_at_the_gate_is_believed_and_one_beyond_it_is_not(way, beyond, doubt):
    k, z = CALS["adaptive"].k, new_state()
    z[fw.MODE], z[fw.QUIET], z[fw.POT_SEEN], z[fw.ENGAGED], z[fw.SUSPECT] = fw.RUN, 1.0, 1.0, 1.0, 0.4
    z[fw.LEARNED_UP] = z[fw.LEARNED_DOWN] = 15.0
    z[fw.WIDTH] = -k[fw.PLAY_VIGV]  # no play: 0 rad is expected
    z[fw.POT] = way * (k[fw.POT_GATE] + beyond)
    fw.learn(z, k)
    assert z[fw.SUSPECT] == pytest.approx(doubt, abs=1e-12)


def test_readings_that_have_followed_just_6_degrees_are_trusted():
    k, z = CALS["adaptive"].k, new_state()
    z[fw.HIGHEST] = 6.0 * DEG
    assert k[fw.POT_TRUST] == 6.0 * DEG
    fw.judge_pot(z, k, 0, 3.0 * DEG, True)
    assert z[fw.TRUSTED] == 1.0


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_without_play_a_stroke_at_rest_keeps_its_side(side):
    z = new_state()
    z[fw.ENGAGED], z[fw.FARTHEST] = side, 0.2
    fw.follow_play(z, 0, 0.2, 0.0)
    assert z[fw.ENGAGED] == side


@pytest.mark.parametrize(
    ("moved", "off", "rests"),
    [(0.0, 0.0, True), (1.9e-5, 9e-5, True), (2e-5, 0.0, False), (-2e-5, 0.0, False), (0.0, 1e-4, False)],
)
@pytest.mark.parametrize("mode", [fw.RUN, fw.DEGRADED])
def test_the_stroke_rests_below_0_02_mm_in_10_ms_and_0_1_mm_off(moved, off, rests, mode):
    z = new_state()
    z[fw.MODE], z[fw.X_DEM], z[fw.X_MEAS] = mode, moved, moved - off
    fw.learn(z, CALS["adaptive"].k)
    assert (z[fw.QUIET] > 0.0) == (rests and mode == fw.RUN)


def test_readings_are_taken_and_doubted_as_the_page_says():
    rng = random.Random(3)
    low = 60.0 * DEG
    for i in range(100):
        z = any_state(rng)
        b = taken_from(z)
        y = rng.choices([0.1, -0.4, low, -low, low + 1e-9, -low - 1e-9, np.nan, np.inf], k=3)
        row = np.zeros(fw.N_INPUTS)
        row[fw.IN_VIGV : fw.IN_VIGV + 3] = y
        fw.filter_pots(z, CALS["adaptive"].k, row)
        b._pots(np.array(y))
        assert_same_state(z, b, f"state {i}")


@pytest.mark.parametrize("strategy", ["inverse", "adaptive"])
def test_runs_with_play_are_those_of_the_page(strategy):
    """With readings of a linkage that is worn and has grown, from trust half won; one potentiometer drops out on the
    way.
    """
    m = Machine(strategy, beside=True)
    r = manoeuvres(5, 1500)
    vigv = np.interp(np.interp(r[:, 0], m.cal.table[0], m.cal.table[3]), m.cal.angles[0], m.cal.angles[1])
    r[:, 8:11] = vigv[:, None] * [1.0, 0.7, 0.5] + 0.2 * DEG
    r[700:760, 9] = np.nan
    m.play(r)
    assert m.z[fw.X_SLOW] == pytest.approx(m.beside.slow_x, abs=1e-12)
    assert_same_state(m.z, m.beside, "the end")
