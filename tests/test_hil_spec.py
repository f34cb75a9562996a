"""Figures, replay and the engine test by their specification: closed forms, boundaries, units."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from controller import load_calibration
from hil import engine_test as engine_test_module
from hil import figures
from hil import replay as replay_module
from hil.engine_test import EngineTestTable, engine_test, load_profile
from hil.figures import error_figures, noise_floor, resolution, resolution_before
from hil.logs import Channel, Log, LogError
from hil.loop.lockstep import Run, Stimulus
from hil.replay import replay, replay_json
from plant import build_plant
from plant.parameters import PLAY
from vaneloop.base.errors import InputError
from vaneloop.base.vanes import VANES
from vaneloop.identification.settings import AGREES

SHIPPED, flashed = build_plant(), cache(load_calibration)

# ---- noise floor -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("k", [1, 2, 3, 7])
def test_one_sample_of_noise_alone_has_the_sum_of_squares_of_a_third_difference(k: int) -> None:
    n = 64
    windows = np.zeros((3, n))
    windows[:, 31] = 1.0, 2.0, 40.0  # 1 + 9 + 9 + 1 = 20 times its square, over n - 3 k differences
    assert figures._level(windows, k) == pytest.approx(2.0 / math.sqrt(n - 3 * k), rel=1e-12)


@pytest.mark.parametrize("k", [1, 4])
def test_third_differences_see_no_parabola_and_all_of_a_cubic(k: int) -> None:
    i = np.arange(64.0)
    assert figures._level(np.array([3.0 - 2.0 * i + 0.5 * i**2]), k) == pytest.approx(0.0, abs=1e-9)
    assert figures._level(np.array([i**3]), k) == pytest.approx(6.0 * k**3 / math.sqrt(20.0))


def test_noise_that_does_not_grow_with_the_lag_is_the_mean_of_both_lags() -> None:
    y = 0.3 * (-1.0) ** np.arange(1000.0)  # a third difference of 8 times its height, at twice the lag of none
    assert noise_floor(np.arange(1000) * 0.01, y) == pytest.approx(0.5 * 8.0 * 0.3 / math.sqrt(20.0), rel=1e-9)


def levels(of: dict[int, float], monkeypatch: pytest.MonkeyPatch, width: int = 64, q: float = 0.0) -> float:
    """The answer where third differences at each lag have these levels."""
    monkeypatch.setattr(figures, "_level", lambda _, k: of[k])
    monkeypatch.setattr(figures, "_dwell_windows", lambda *_: np.zeros((5, width)))
    monkeypatch.setattr(figures, "resolution", lambda _: q)
    return noise_floor(np.zeros(3), np.zeros(3))


def test_the_lag_doubles_until_the_noise_stops_growing(monkeypatch: pytest.MonkeyPatch) -> None:
    assert levels({1: 1.0, 2: 1.5, 4: 1.6}, monkeypatch) == pytest.approx(1.55)  # a plateau: less than 1.08-fold
    assert levels({1: 1.0, 2: 1.5, 4: 1.65, 8: 1.65}, monkeypatch) == pytest.approx(1.65)  # none at 1.1-fold
    assert levels({1: 1.0, 2: 2.0, 4: 4.3, 8: 9.0}, monkeypatch) == 2.0  # motion takes over: more than 2.1-fold
    assert levels({1: 1.0, 2: 2.0, 4: 6.1}, monkeypatch) == 2.0  # more than threefold, whatever follows
    # up to threefold and then a plateau: noise behind a filter of the second order
    assert levels({1: 1.0, 2: 3.0, 4: 3.1}, monkeypatch) == pytest.approx(3.05)
    assert levels({1: 1.0, 2: 2.8, 4: 4.0, 8: 4.4}, monkeypatch) == 1.0  # none within the window
    assert levels({1: 1.0, 2: 2.1, 4: 2.1}, monkeypatch) == 2.1
    assert levels({1: 1.0, 2: 1.08, 4: 1.6, 8: 1.6}, monkeypatch) == 1.6  # 1.08-fold is none yet
    assert levels({1: 1.0, 2: 1.08, 4: 1.08}, monkeypatch) == 1.08 and figures.AGREES == AGREES == 1.1


def test_the_lag_stays_below_a_twelfth_of_a_window(monkeypatch: pytest.MonkeyPatch) -> None:
    growing = {1: 1.0, 2: 1.5, 4: 2.25, 8: 3.0}
    assert levels(growing, monkeypatch, 47) == 2.25 and levels(growing, monkeypatch, 48) == 3.0
    assert levels({1: 0.0}, monkeypatch, 48, q=math.sqrt(12.0)) == 1.0  # never below the quantisation
    assert levels({1: 0.5, 2: 0.5}, monkeypatch, 48, q=0.1 * math.sqrt(12.0)) == 0.5


def test_values_without_a_time_each_are_refused() -> None:
    with pytest.raises(InputError, match="3 values for 4 times"):
        noise_floor(np.arange(4.0), np.arange(3.0))
    assert noise_floor(np.arange(3.0), [0.0, 0.5, 1.0]) == pytest.approx(0.5 / math.sqrt(12.0))  # too few for a window


# ---- windows ---------------------------------------------------------------------------------------------------------


def windows_of(y: np.ndarray, dt: float = 0.01) -> np.ndarray:
    """Dwell windows on a raster."""
    return figures._dwell_windows(np.arange(y.size) * dt, y)


@pytest.mark.parametrize("dt, n, width", [
    (0.01, 1000, 100), (0.1, 1000, 64), (0.0156, 1000, 64), (1e-3, 10_000, 1000), (1e-4, 10_000, 2048), (0.01, 50, 50),
    (0.0, 500, 64),
])  # fmt: skip
def test_a_window_is_a_second_within_64_and_2048_samples(dt: float, n: int, width: int) -> None:
    y = np.arange(float(n)) ** 2
    found = figures._dwell_windows(np.arange(n) * dt, y)
    assert found.shape[1] == width or (dt == 0.0 and found.size == 0)


def test_windows_overlap_by_half_and_the_half_that_moves_least_is_kept() -> None:
    y = np.arange(1000.0) ** 2  # moves more and more
    found = windows_of(y)
    assert found.tolist() == [y[50 * k : 50 * k + 100].tolist() for k in range(10)]  # of 19
    many = windows_of(np.arange(100_000.0) ** 2)
    assert len(many) == 300  # of at most 600
    assert many[1, 0] == float(int(99_900 / 599)) ** 2


@pytest.mark.parametrize("n, rows", [(7, 0), (8, 1), (100, 1), (199, 1), (200, 3), (300, 3)])
def test_fewer_than_four_windows_are_all_kept(n: int, rows: int) -> None:
    assert len(windows_of(np.arange(float(n)) ** 2)) == rows


def three_seconds() -> np.ndarray:
    """Five windows, from 0, 50, 100, 150 and 200 on, each of which moves more than the one before."""
    return 1e-3 * np.arange(300.0) ** 2


def kept(found: np.ndarray) -> list[int]:
    """Where the windows of `three_seconds` begin, by their last samples."""
    return [round(math.sqrt(1e3 * row[-2])) - 98 for row in found]


@pytest.mark.parametrize("at, expected", [(28, [50, 100, 150]), (40, [0, 50, 100])])
def test_motion_is_that_from_the_first_third_to_the_last(at: int, expected: list[int]) -> None:
    y = three_seconds()
    assert kept(windows_of(y)) == [0, 50, 100]
    y[at] += 3000.0
    assert kept(windows_of(y)) == expected


@pytest.mark.parametrize("before", [1, 30, 99, 100, 151, 299])
@pytest.mark.parametrize("gap, allowed", [(0.45, True), (0.6, False)])
def test_a_window_with_a_gap_does_not_count(before: int, gap: float, allowed: bool) -> None:
    t, y = np.arange(300) * 0.01, three_seconds()
    t[before:] += gap
    left = [s for s in range(0, 201, 50) if allowed or not s < before <= s + 99]
    expected = left if len(left) < 4 else left[: -(-len(left) // 2)]  # the half that moves least
    assert kept(figures._dwell_windows(t, y)) == expected


def test_windows_with_a_nan_and_constant_ones_do_not_count() -> None:
    y = three_seconds()
    y[10] = np.nan
    assert kept(windows_of(y)) == [50, 100]  # half of four
    y = three_seconds()
    y[:100] = 5.0
    assert kept(windows_of(y)) == [50, 100]
    y = 1e-3 * three_seconds()  # less than 1 in all
    assert len(windows_of(y)) == 3


# ---- resolution ------------------------------------------------------------------------------------------------------


def with_gaps(*gaps: float) -> np.ndarray:
    """Levels so far apart."""
    return np.cumsum([1.0, *gaps])


@pytest.mark.parametrize("values, q", [
    ([], 0.0), ([3.0] * 9, 0.0), ([1.0, 1.25], 0.25), ([1.0, 1.0 + 1e-9], 0.0), ([0.0, 0.25, 0.5], 0.25),
    ([0.0, 0.25, 0.6], 0.0), ([0.0, 1.0, 1.0 + 0.9e-6], 1.0), ([0.0, 1.0, 1.0 + 1.1e-6], 0.0),
    (with_gaps(*[1.0, 1.04] * 10), 1.02), (with_gaps(*[0.5] * 40, 0.8), 0.5),
    (with_gaps(*[1.0] * 40, *[3.056] * 3), 0.0),
    (with_gaps(*[1.0] * 19, 2.5), 0.0), (with_gaps(*[1.0] * 20, 2.5), 1.0), (with_gaps(*[1.0] * 40, *[3.04] * 3), 1.0),
    ([np.nan, 0.0, np.inf, 0.5, 1.0], 0.5),
])  # fmt: skip
def test_the_step_of_which_19_in_20_gaps_and_more_are_multiples(values: Any, q: float) -> None:
    assert resolution(values) == pytest.approx(q, rel=1e-9)


@pytest.mark.parametrize("n, found", [(100, 2.5), (99, 0.0)])
def test_a_step_behind_another_needs_a_hundred_gaps(n: int, found: float) -> None:
    y = np.round(2.5 * np.arange(n + 1.0))
    assert resolution_before(y) == pytest.approx(found, rel=1e-3)
    assert resolution_before([*y, *(y + 1e-8)]) == pytest.approx(found, rel=1e-3)  # copies are no levels of their own
    assert resolution_before(1e-3 * y - 0.01) == pytest.approx(1e-3 * found, rel=1e-3)


@pytest.mark.parametrize("m", [20, 21])
def test_a_step_has_at_most_twenty_small_ones(m: int) -> None:
    """A step of between m and m + 1 smaller ones; the least gap is m of them."""
    y = np.round((m + 0.5) * np.arange(400.0))
    assert resolution_before(y) == pytest.approx(m + 0.5 if m <= 20 else 0.0, rel=1e-3)


def test_a_few_wrong_levels_leave_the_step_behind_another() -> None:
    y = np.round(3.4 * np.arange(2000.0))
    y[:10] -= np.arange(10.0, 0.0, -1.0) * 0.3  # off the grid: a twentieth of the gaps may be
    assert resolution_before(y) == pytest.approx(3.4, rel=1e-2)
    y[:300] -= np.arange(300.0, 0.0, -1.0) * 0.3
    assert resolution_before(y) == 0.0


def test_levels_off_by_more_than_half_a_small_step_have_no_step_behind_it() -> None:
    """Gaps of 10, 11, 9 small steps: a third of the levels is two thirds of one off the mean."""
    assert resolution_before(np.cumsum([0.0, *[10.0, 11.0, 9.0] * 60])) == 0.0
    assert resolution_before(np.cumsum([0.0, *[10.0, 11.0] * 60])) == pytest.approx(10.5, rel=1e-3)


# ---- figures ---------------------------------------------------------------------------------------------------------


def test_the_noise_floor_is_the_less_of_the_reference_s_and_the_error_s() -> None:
    t, ones = np.arange(1000) * 0.01, (-1.0) ** np.arange(1000.0)
    floor = 4.0 / math.sqrt(20.0)
    for of_reference, of_model, expected in ((0.3, 0.1, 0.2), (0.2, 0.9, 0.2), (0.3, 0.2, 0.1), (0.1, -0.4, 0.1)):
        found = error_figures("vigv", "linkage", "deg", "measured", t, of_model * ones, of_reference * ones)
        assert found.noise_floor == pytest.approx(expected * floor, rel=1e-9)


# ---- the engine test -------------------------------------------------------------------------------------------------


def profile_of(speed: list[float], rate: list[float], dwell: list[float], start: float = 50.0) -> dict[str, Any]:
    """A table of steps."""
    axes = (("start", start, "%"), ("speed", speed, "%"), ("rate", rate, "%/s"), ("dwell", dwell, "s"))
    return {k: {"value" if k == "start" else "values": v, "unit": u, "origin": "chosen: a test"} for k, v, u in axes}


def write_profile(path: Path, table: dict[str, Any]) -> Path:
    """The table as a file."""
    rows = (f"[{k}]\n" + "".join(f"{n} = {v!r}\n".replace("'", '"') for n, v in s.items()) for k, s in table.items())
    path.write_text("\n".join(rows))
    return path


def test_a_profile_goes_to_each_speed_at_its_rate_and_stays(tmp_path: Path) -> None:
    at = write_profile(tmp_path / "steps.toml", profile_of([60.0, 40.0], [5.0, 10.0], [3.0, 1.0]))
    for dwells, times in ((1.0, [0.0, 2.0, 5.0, 7.0, 8.0]), (0.5, [0.0, 2.0, 3.5, 5.5, 6.0])):
        n = load_profile(at, dwells)
        assert len(n) == round(100 * times[-1])
        assert n == pytest.approx(np.interp(np.arange(len(n)) * 0.01, times, [50.0, 60.0, 60.0, 40.0, 40.0]))
    assert load_profile(at).tolist() == load_profile(at, 1.0).tolist()


@pytest.mark.parametrize("speed, rate, dwell, says", [
    ([50.0, 50.0], [1.0, 1.0], [1e5, 0.0], ""), ([51.0, 51.0], [1.0, 1.0], [50_000.0, 49_999.0], ""),
    ([49.0, 49.0], [0.5, 1.0], [99_998.0, 0.0], ""),
    ([51.0, 51.0], [0.5, 1.0], [99_999.0, 0.0], "a test of 100001 s; allowed: up to 100000 s"),
    ([51.0, 51.0], [1.0, 1.0], [50_000.0, 50_000.0], "a test of 100001 s"),
    ([51.0, 52.0, 53.0], [1.0, 1.0], [1.0, 1.0, 1.0], "rate.values has 2 numbers; speed has 3"),
    ([51.0, 52.0], [1.0, 1.0], [1.0, 2.0, 2.0], "dwell.values has 3 numbers; speed has 2"),
])  # fmt: skip
def test_a_profile_lasts_28_hours_at_most(speed: Any, rate: Any, dwell: Any, says: str) -> None:
    table = profile_of(speed, rate, dwell)
    if not says:
        EngineTestTable.model_validate(table)
        return
    with pytest.raises(ValueError, match=says):
        EngineTestTable.model_validate(table)


class Loop:
    """Stands for the loop: keeps what it was asked, and gives every signal as a ramp."""

    def __init__(self, t: np.ndarray, **columns: np.ndarray):
        ramp = np.linspace(1.0, 2.0, len(t))
        self.columns = {"t": t, "n_r": 60.0 + ramp, "n_engine": 61.0 + ramp, "x_dem": 10.0 * ramp, "i_cmd": ramp}
        self.columns |= {"x_lvdt": 9.0 * ramp, "n_dem": 60.0 + ramp, "p_s": 21.0 + 0.0 * t, "t_oil": 40.0 + 0.0 * t}
        self.columns |= {v: (3.0 + k) * ramp for k, v in enumerate(VANES[:3])} | columns
        self.asked: dict[str, Any] = {}
        self.stimulus = Stimulus(np.zeros((0, 0)))

    def __call__(self, stimulus: Stimulus, **asked: Any) -> Run:
        self.stimulus, self.asked = stimulus, asked
        return Run(dict(self.columns), 12.5, 0.25, "ab" * 32, 0)


@pytest.mark.parametrize("hysteresis", [None, 0.6])
def test_the_engine_test_holds_the_vanes_against_the_schedule(
    hysteresis: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    loop = Loop(np.arange(20) * 0.1)
    monkeypatch.setattr(engine_test_module, "lockstep", loop)
    found = engine_test(np.full(200, 61.0), "single", hysteresis=hysteresis)
    assert loop.stimulus.rows[:, 0].tolist() == [61.0] * 200
    assert (loop.asked["seed"], loop.asked["every"], loop.asked["progress"]) == (1, 100, None)
    assert loop.asked["calibration"].k.tolist() == load_calibration(strategy="single").k.tolist()
    p = SHIPPED.p.copy()
    if hysteresis is not None:  # at the vane; the ring's is as much less as the lever is longer
        stage = SHIPPED.geometry.vigv
        p[PLAY, 0] = math.radians(0.6) * stage.l.value / stage.ld_prime.value
    assert np.array_equal(loop.asked["plant"].p, p)
    speed = loop.columns["n_r"]
    targets = np.degrees(SHIPPED.schedules.targets(speed))
    for k, (signal, vane) in enumerate(zip(found.signals, VANES[:3], strict=True)):
        assert (signal.signal, signal.stage, signal.unit, signal.reference) == (vane, "linkage", "deg", "schedule")
        assert signal.noise_floor == SHIPPED.table.sensors.pot_noise.value and signal.samples == 20
        assert signal.mean_abs == pytest.approx(np.abs(loop.columns[vane] - targets[:, k]).mean())
    assert (found.log, found.simulated_s, found.wall_s, found.measured) == ("engine test, single", 12.5, 0.25, {})


def test_the_engine_test_takes_the_machine_and_the_controller_that_it_is_given(monkeypatch: pytest.MonkeyPatch) -> None:
    loop = Loop(np.arange(20) * 0.1)
    monkeypatch.setattr(engine_test_module, "lockstep", loop)
    machine, calibration = replace(SHIPPED, p=1.01 * SHIPPED.p), load_calibration(strategy="dual")
    engine_test(np.full(200, 61.0), "single", 7, plant=machine, calibration=calibration)
    assert loop.asked["plant"] is machine and loop.asked["calibration"] is calibration and loop.asked["seed"] == 7


# ---- replay ----------------------------------------------------------------------------------------------------------


def log_of(end: float = 2.0, raster: float = 0.01, **channels: Channel) -> Log:
    """A log with a demand up to ``end`` (s)."""
    t = np.arange(round(end / raster) + 1) * raster
    return Log("a.csv", {"n_dem": Channel(t, 60.0 + t)} | channels)


@pytest.fixture
def loop(monkeypatch: pytest.MonkeyPatch) -> Loop:
    """The loop of a replay of two seconds."""
    stand_in = Loop(np.arange(201) * 0.01)
    monkeypatch.setattr(replay_module, "lockstep", stand_in)
    monkeypatch.setattr(replay_module, "build_plant", lambda: SHIPPED)
    monkeypatch.setattr(replay_module, "load_calibration", flashed)
    return stand_in


@pytest.mark.parametrize("end, good", [(0.1, True), (0.11, True), (0.09, False)])
def test_a_demand_of_a_tenth_of_a_second_drives_the_loop(end: float, good: bool, loop: Loop) -> None:
    if good:
        replay(log_of(end))
        assert len(loop.stimulus.rows) == round(100 * end) + 1
    else:
        with pytest.raises(LogError, match=r"n_dem: lasts 0.09 s; at least 0.1 s is needed"):
            replay(log_of(end))


def test_one_demand_alone_lasts_for_no_time(loop: Loop) -> None:
    with warnings.catch_warnings(), pytest.raises(LogError, match=r"n_dem: lasts 0 s; at least 0.1 s is needed"):
        warnings.simplefilter("error")
        replay(Log("a.csv", {"n_dem": Channel(np.array([0.3]), np.array([60.0]))}))


@pytest.mark.parametrize("late, had", [(0.004, 62.0), (0.0055, 61.0), (-0.004, 61.0), (-0.0055, 62.0)])
def test_a_frame_is_in_the_answer_that_is_within_half_a_period(late: float, had: float, loop: Loop) -> None:
    """The answer of the tick at 1 s is off its time; one frame comes just before the earlier, one before the later."""
    stamps = np.arange(201) * 0.01
    stamps[100] += late
    frames = np.array([0.0, 1.0 + min(late, 0.0) - 0.0002, 1.0 + max(late, 0.0) - 0.0001, 2.0])
    n_dem = Channel(frames, np.array([60.0, 61.0, 62.0, 63.0]), framed=True)
    replay(Log("a.csv", {"n_dem": n_dem, "x_lvdt": Channel(stamps, np.full(201, 20.0))}))
    assert loop.stimulus.rows[100, 0] == had


def test_the_firmware_gets_what_the_log_s_ecu_sent(loop: Loop) -> None:
    t = np.array([0.0, 0.5, 1.5])
    replay(log_of(2.0, n_r=Channel(t, np.array([61.0, 62.0, 63.0])), p_s=Channel(t, np.array([20.0, 21.0, 22.0]))))
    n_dem, n_r, p_s, t_oil = loop.stimulus.rows[:, :4].T
    k = np.arange(201)
    assert n_dem == pytest.approx(60.0 + 0.01 * k)
    assert n_r == pytest.approx(np.where(k < 50, 61.0, np.where(k < 150, 62.0, 63.0)))
    assert p_s == pytest.approx(1e6 * np.where(k < 50, 20.0, np.where(k < 150, 21.0, 22.0)))
    assert (t_oil == SHIPPED.usual["t_oil"]).all()
    replay(log_of(2.0, t_oil=Channel(t, np.array([30.0, 35.0, 35.0]))))
    n_dem, n_r, p_s, t_oil = loop.stimulus.rows[:, :4].T
    assert np.isnan(n_r).all() and (p_s == 1e6 * SHIPPED.usual["p_s"]).all()
    assert t_oil == pytest.approx(np.where(k < 50, 30.0, 35.0))


def test_the_loop_starts_where_the_log_s_machine_was(loop: Loop) -> None:
    t = np.array([0.0, 0.01, 2.0])
    replay(log_of(vigv=Channel(t, np.array([30.0, 29.0, 28.0])), x_dem=Channel(t, np.array([12.0, 13.0, 14.0]))))
    assert loop.asked["angles"][0] == pytest.approx(math.radians(30.0)) and np.isnan(loop.asked["angles"][1:]).all()
    assert loop.asked["stroke_demand"] == pytest.approx(0.012) and loop.asked["progress"] is None
    assert loop.asked["plant"].p.tolist() == SHIPPED.p.tolist()
    assert loop.asked["calibration"].k.tolist() == load_calibration().k.tolist()
    replay(log_of(), strategy="single")
    assert loop.asked["stroke_demand"] is None and len(loop.asked["angles"]) == 3
    assert loop.asked["calibration"].k.tolist() == load_calibration(strategy="single").k.tolist()
    machine, calibration = replace(SHIPPED, p=1.01 * SHIPPED.p), load_calibration(strategy="dual")
    replay(log_of(), plant=machine, calibration=calibration)
    assert loop.asked["plant"] is machine and loop.asked["calibration"] is calibration


@pytest.mark.parametrize("rasters, every", [
    ([], 10), ([0.01], 10), ([0.005], 10), ([0.0049], 1), ([0.001], 1), ([0.01, 0.001], 1), ([9.0], 10),
])  # fmt: skip
def test_every_tick_is_kept_where_the_log_has_more_than_every_fifth(rasters: Any, every: int, loop: Loop) -> None:
    """9 s stands for a channel of one sample: it has no raster."""
    channels = {}
    for name, raster in zip(("x_lvdt", "vigv"), rasters, strict=False):
        t = np.arange(round(0.2 / raster) + 1) * raster
        channels[name] = Channel(t, np.full(len(t), 20.0))
    replay(log_of(**channels))
    assert loop.asked["every"] == every


def steady(t: np.ndarray, value: float) -> Channel:
    """A channel that stays."""
    return Channel(t, np.full(len(t), value))


def test_signals_are_held_against_the_log_at_its_times_and_against_the_schedule(loop: Loop) -> None:
    t = np.array([0.005, 0.5, 1.0, 2.0, 2.5])  # the last is later than the demand
    log = log_of(vigv=steady(t, 5.0), n_r=steady(t, 62.0), x_lvdt=steady(t[-1:], 9.0), vgv5=steady(t, 5.0))
    found = replay(log, floors={"vigv": 0.125})
    by = {(s.signal, s.reference): s for s in found.signals}
    assert set(by) == {("n_r", "measured"), ("vigv", "measured"), *((v, "schedule") for v in VANES[:3])}
    vigv, n_r = by["vigv", "measured"], by["n_r", "measured"]
    assert (vigv.samples, vigv.noise_floor, vigv.stage, vigv.unit) == (4, 0.125, "linkage", "deg")
    assert vigv.max_abs == pytest.approx(5.0 - 3.0 * (1.0 + 0.0025)) and n_r.unit == "%"
    assert n_r.mean_abs == pytest.approx(np.abs(62.0 + 0.5 * t[:4] - 62.0).mean())  # the engine's own speed
    targets = np.degrees(SHIPPED.schedules.targets(loop.columns["n_r"]))
    for k, vane in enumerate(VANES[:3]):
        figure = by[vane, "schedule"]
        assert figure.mean_abs == pytest.approx(np.abs(loop.columns[vane] - targets[:, k]).mean())
        assert figure.noise_floor == pytest.approx(0.125 if k == 0 else SHIPPED.table.sensors.pot_noise.value)
        assert figure.samples == 201 and np.array_equal(found.target[vane], targets[:, k])
    assert found.notes == [
        "x_lvdt: no sample while n_dem is known; not compared",
        "vgv5: this machine has no such vane row (geometry); not compared",
    ]
    assert found.t == pytest.approx(loop.columns["t"]) and (found.model["n_r"] == loop.columns["n_engine"]).all()
    assert "i_motor" not in found.model and found.log == "a.csv" and found.measured.keys() == log.channels.keys()


def test_a_motor_s_current_is_among_the_curves(monkeypatch: pytest.MonkeyPatch) -> None:
    t = np.arange(201) * 0.01
    monkeypatch.setattr(replay_module, "lockstep", Loop(t, i_motor=2.0 * t))
    assert replay(log_of()).model["i_motor"] == pytest.approx(2.0 * t)


@pytest.mark.parametrize("raster, hole, gap", [(0.01, 0.49, ""), (0.01, 0.6, "0.5"), (0.2, 0.8, ""), (0.2, 1.2, "1")])
def test_a_hole_in_the_demand_is_longer_than_half_a_second_and_five_samples(
    raster: float, hole: float, gap: str, loop: Loop
) -> None:
    t = np.arange(round(2.0 / raster) + 1) * raster
    t = t[(t <= 0.4 + 1e-9) | (t > 0.4 + hole - 1e-9)]
    every = np.arange(201) * 0.01
    log = Log("a.csv", {"n_dem": steady(t, 60.0), "x_lvdt": steady(every, 9.0)}, ["read"])
    found = replay(log)
    begin = 0.4 + float(gap or 9.0)
    says = f"n_dem: 1 gaps longer than {gap} s; the last value is held and errors there do not count"
    assert found.notes == (["read", says] if gap else ["read"])
    counted = ~((every > begin + 1e-5) & (every < 0.4 + hole - 1e-5))
    assert {s.signal: s.samples for s in found.signals if s.signal in ("x_lvdt", "vigv")} == dict.fromkeys(
        ("x_lvdt", "vigv"), int(counted.sum())
    )


def test_a_current_is_its_mean_since_the_log_s_last_sample_and_the_rest_lies_in_between() -> None:
    t, values = 3.0 + np.arange(8) * 0.5, np.array([2.0, 1.0, 0.0, 4.0, 2.0, 2.0, 6.0, 0.0])
    when = np.array([4.0, 4.5, 5.5])  # of the steps that end there; a step before the first one is as long as the next
    assert replay_module._model_at("i_cmd", t, values, when) == pytest.approx([0.0, 4.0, 2.0])
    across = replay_module._model_at("i_cmd", t, values, np.array([4.25, 5.25]))  # half of some steps
    assert across == pytest.approx([0.5 * (0.5 * 1.0 + 0.0 + 0.5 * 4.0), 0.5 * (0.5 * 4.0 + 2.0 + 0.5 * 2.0)])
    assert replay_module._model_at("i_cmd", t, values, np.array([3.0, 3.5])) == pytest.approx([2.0, 1.0])
    assert replay_module._model_at("x_lvdt", t, values, np.array([3.25, 4.75])) == pytest.approx([1.5, 3.0])
    assert replay_module._model_at("i_cmd", t, values, np.array([3.25])) == pytest.approx([1.5])  # no time before it


def test_what_the_controller_sent_is_that_of_the_nearest_tick() -> None:
    t = 0.003 + np.arange(5) * 0.01
    when = np.array([-1.0, 0.0075, 0.0085, 0.0231, 0.5])
    assert replay_module._in_tick(when, t) == pytest.approx(t[[0, 0, 1, 2, 4]])


def test_a_hole_begins_behind_the_gap() -> None:
    c = steady(np.array([0.0, 1.0]), 5.0)
    found = replay_module._in_hole(np.array([0.0, 0.5, 0.75, 1.0, 1.5, 1.6]), c, 0.5)
    assert found.tolist() == [False, False, True, False, False, True]


def test_a_command_is_at_the_first_tick_that_had_it() -> None:
    c = Channel(np.array([0.0, 0.011, 0.012, 0.03]), np.array([5.0, 6.0, 7.0, 8.0]), framed=True)
    ticks = np.arange(6) * 0.01
    found = replay_module._when_had(c, ticks, ticks)
    assert found.t == pytest.approx([0.0, 0.02, 0.03]) and found.values.tolist() == [5.0, 7.0, 8.0] and found.framed


def test_json_has_the_figures_of_every_signal(loop: Loop) -> None:
    found = replay(log_of())
    said = replay_json(found)
    assert said["schema"] == 1 and said["notes"] == [] and len(said["signals"]) == 3
    assert (said["log"], said["simulated_s"], said["wall_s"], said["state_hash"]) == ("a.csv", 12.5, 0.25, "ab" * 32)
