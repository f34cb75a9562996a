"""What each line of the schedule's, the links' and the strategies' design promises: limits of the options, tables by
their definition, a measured loop's parts, and comparisons of runs that are known beforehand.
"""

from __future__ import annotations

import math
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from controller import load_calibration
from hil.logs import Channel, LogError
from plant import build_plant, load_geometry, load_schedules
from plant.effect import T_REF
from plant.geometry import vane_angles
from vaneloop.base.errors import InputError
from vaneloop.design import clearance, loop_fit, measured_loop, schedule_files, spatial, stroke_tables
from vaneloop.design import strategies as st
from vaneloop.design.links import ScheduleOptions, geometry_with

GEOMETRY, SCHEDULES = load_geometry(), load_schedules()

# ---- options and tables ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "option", "low", "high"),
    [("step", "--step", 1e-3, 50.0), ("lb_range", "--lb-range", 0.0, 100.0), ("lc_range", "--lc-range", 0.0, 100.0)],
)
def test_each_option_is_allowed_up_to_both_of_its_ends(name: str, option: str, low: float, high: float) -> None:
    base = ScheduleOptions(step=1.0, lb_range=0.0, lc_range=0.0)
    for value in (low, high):
        replace(base, **{name: value}).check()
    for value in (low - 1e-6, high + 1e-6, math.nan):
        with pytest.raises(InputError, match=rf"^{option} \(=.* mm\) must be in \[{low:g}, {high:g}\]$"):
            replace(base, **{name: value}).check()


def test_limit_criterion_and_lengths_are_checked() -> None:
    ScheduleOptions(limit=180.0).check()
    for limit in (0.0, 180.001, math.nan):
        with pytest.raises(InputError, match=r"--limit \(=.* deg\) must be in \(0, 180\]"):
            ScheduleOptions(limit=limit).check()
    with pytest.raises(
        InputError, match=r"--criterion \(='desing'\) must be one of rms, max, design \(did you mean design\?\)"
    ):
        ScheduleOptions(criterion="desing").check()  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"--adjust: 'ld' is not a length that can be adjusted; allowed: lb, lc, none"):
        ScheduleOptions(adjust=("lb", "ld")).check()
    # 447 of each are 199,809 pairs, 449 of one and 447 of the other 200,703
    ScheduleOptions(step=0.1, lb_range=22.35, lc_range=22.35).check()
    with pytest.raises(InputError, match=r"too fine for the ranges: 200,703 pairs of lengths; limit 200,000"):
        ScheduleOptions(step=0.1, lb_range=22.45, lc_range=22.35).check()
    o = ScheduleOptions()
    assert (o.step, o.lb_range, o.lc_range, o.adjust, o.criterion, o.limit) == (0.5, 5.0, 5.0, ("lb", "lc"), "rms", 1.0)


def test_a_changed_geometry_changes_what_is_named_alone() -> None:
    g = geometry_with(GEOMETRY, {"vgv1": {"lb": 49.5}}, {"vgv1.lb": "measured"})
    assert g.stage("vgv1").lb.value == 49.5 and g.stage("vgv1").lb.origin == "measured"
    assert g.stage("vgv1").lc == GEOMETRY.stage("vgv1").lc and g.stage("vigv") == GEOMETRY.stage("vigv")
    with pytest.raises(InputError):
        geometry_with(GEOMETRY, {"vgv1": {"lc": 100.0}})
    assert geometry_with(GEOMETRY, {"vgv1": {"lc": 100.0}}, check=False).stage("vgv1").lc.value == 100.0


def test_the_strokes_of_either_direction_are_half_the_play_apart() -> None:
    n = np.array([60.0, 80.0, 100.0])
    table = stroke_tables.stroke_tables(GEOMETRY, SCHEDULES, n)
    target = np.rad2deg(SCHEDULES.targets(n)[:, 0])
    half = 0.5 * GEOMETRY.vigv.hysteresis.value
    angles = [np.rad2deg(vane_angles(row * 1e-3, GEOMETRY)[:, 0]) for row in table[1:]]
    np.testing.assert_array_equal(table[0], n)
    for got, expected in zip(angles, (target + half, target - half, target), strict=True):
        np.testing.assert_allclose(got, expected, atol=1e-6)
    np.testing.assert_allclose(stroke_tables.stroke_of_model(GEOMETRY, SCHEDULES, n) * 1e3, table[3], atol=1e-9)
    by_stroke = stroke_tables.vane_angle_table(GEOMETRY)
    assert by_stroke.shape == (1 + len(GEOMETRY.vanes), 49) and by_stroke[0].tolist() == list(range(49))
    np.testing.assert_allclose(by_stroke[1:, 24], np.rad2deg(vane_angles(np.array([24e-3]), GEOMETRY)[0]))
    two = stroke_tables.vane_angle_table(GEOMETRY, np.array([10.0, 20.0]))
    np.testing.assert_allclose(two, by_stroke[:, [10, 20]])


def test_a_target_outside_the_stroke_is_named_where_it_is_furthest_off() -> None:
    speed, target = np.array([50.0, 60.0, 70.0, 80.0]), np.array([-1.0, 0.0, 5.0, 5.6])
    stroke_tables.refuse_outside(speed, target, -1.0, 5.6)
    with pytest.raises(InputError, match=r"at 80 % speed: target angle \(=5\.6 deg\) must be in \[-0\.5, 5\]"):
        stroke_tables.refuse_outside(speed, target, -0.5, 5.0)
    with pytest.raises(InputError, match=r"at 50 % speed: target angle \(=-1 deg\)"):
        stroke_tables.refuse_outside(speed, target, 0.0, 5.0)
    with pytest.raises(InputError, match=r"at 70 % speed: target angle \(=nan deg\)"):
        stroke_tables.refuse_outside(speed, np.array([1.0, 1.0, math.nan, 1.0]), 0.0, 5.0)
    assert stroke_tables.schedules_at_design(np.array([98.0, 99.5, 101.0])) == 1
    assert stroke_tables.schedules_at_design(np.array([98.0, 99.0, 100.5, 101.0])) == 2


def test_tables_are_written_ten_numbers_a_line(tmp_path: Path) -> None:
    lines = schedule_files._axis("speed", "%", 'say "so"', np.arange(12) + 0.12345)
    assert lines[4].count(",") == 10 and lines[5] == "  10.1235, 11.1235," and lines[-2:] == ["]", ""]
    read = tomllib.loads("\n".join(lines))["speed"]
    assert read["origin"] == 'say "so"' and read["unit"] == "%"
    np.testing.assert_allclose(read["values"], np.arange(12) + 0.12345, atol=6e-5)
    assert schedule_files._axis("x", "mm", "", np.array([2.0, 2.5]))[4] == "  2, 2.5,"
    assert schedule_files._quoted("grün\n") == '"grün\\n"'
    with pytest.raises(InputError, match=r"cannot write .*x\.toml: No such file or directory"):
        schedule_files.write_schedules(SCHEDULES, tmp_path / "none" / "x.toml")


# ---- a measured loop -------------------------------------------------------------------------------------------------


def test_a_branch_is_where_a_wider_play_is_driven() -> None:
    x = np.array([0.0, 1.0, 2.0, 3.0, 2.5, 2.0, 1.0, 0.0, 0.5, 1.0, 2.0])
    got = loop_fit._branches(x, 1.0, 0.01).tolist()
    # the start is unknown until the stroke has moved a gap; 1 mm back crosses it
    assert got == [0, 1, 1, 1, 0, -1, -1, -1, 0, 1, 1]
    assert loop_fit._branches(x, 1.1, 0.01).tolist() == [0, 0, 1, 1, 0, 0, -1, -1, 0, 0, 1]


def test_hats_are_piecewise_linear_and_held_beyond_the_ends() -> None:
    knots, at = np.array([0.0, 1.0, 3.0]), np.array([-1.0, 0.0, 0.25, 1.0, 2.0, 3.0, 9.0])
    values = np.array([5.0, 7.0, 3.0])
    h = loop_fit._hats(at, knots)
    np.testing.assert_allclose(h @ values, np.interp(at, knots, values))
    np.testing.assert_allclose(h.sum(axis=1), 1.0)
    fit = loop_fit.LoopFit(
        knots, values, np.array([1.0, -1.0, 2.0]), 0.1, 0.1, None, 0.0, np.zeros(1, np.int8), {1: (2, 9), -1: (1, 8)}
    )
    assert (fit.low, fit.high) == (1, 9)
    centre, gap = fit.on(np.array([0.5, 1.0, 3.0]))
    assert centre.tolist() == [6.0, 7.0, 3.0] and gap.tolist() == [0.0, 0.0, 2.0]  # no gap is less than none


def test_a_branch_that_is_missing_is_named() -> None:
    x = np.linspace(0.0, 10.0, 40)
    both = np.where(np.arange(40) % 2, 1, -1).astype(np.int8)
    assert loop_fit._missing(both, x) is None
    assert loop_fit._missing(np.abs(both), x) == "retraction" and loop_fit._missing(-np.abs(both), x) == "extension"
    few = np.where(np.arange(40) < 9, 1, -1).astype(np.int8)
    assert loop_fit._missing(few, x) == "extension"  # ten samples, and half a millimetre
    apart = np.where(np.arange(40) < 20, 1, -1).astype(np.int8)
    assert loop_fit._missing(apart, x) == "overlap"
    short = np.where(np.arange(40) < 20, 1, -1).astype(np.int8)
    assert loop_fit._missing(short, np.where(short == 1, 3.0 + 0.02 * np.arange(40), x)) == "extension"


def test_loops_begin_with_every_second_pass() -> None:
    t = np.arange(60.0)
    x = np.abs((t % 20) - 10)
    branch = np.where((t % 20) < 10, -1, 1).astype(np.int8)
    assert loop_fit._loop_times(t, x, branch).tolist() == [0.0, 20.0, 40.0, 59.0]
    assert loop_fit._loop_times(t[:30], x[:30], branch[:30]).size == 0  # fewer than two loops
    t = np.arange(1000.0)
    many = loop_fit._loop_times(t, np.abs((t % 20) - 10), np.where((t % 20) < 10, -1, 1).astype(np.int8))
    assert 9 <= many.size <= 17


def test_noise_and_rate_of_a_stroke() -> None:
    rng = np.random.default_rng(1)
    t = np.arange(20_000) * 0.0125
    x = 5.0 * t + 0.02 * rng.standard_normal(t.size)
    assert measured_loop._raster_noise(x) == pytest.approx(0.02, rel=0.05)
    assert measured_loop._raster_noise(np.arange(3.0)) == 0.0
    v = measured_loop._rate(t, np.where(t < 100.0, 3.0 * t, 300.0))
    assert v[5000] == pytest.approx(3.0) and v[0] == pytest.approx(3.0) and v[-1] == 0.0
    # over 25 ms before and after: two samples of 12.5 ms
    leap = measured_loop._rate(t, np.where(t < 100.0 - 1e-9, 0.0, 1.0))
    assert np.flatnonzero(leap).tolist() == [7998, 7999, 8000, 8001] and leap.max() == pytest.approx(20.0)


def test_leaps_of_single_samples_are_left_out_and_corners_stay() -> None:
    ramp = np.minimum(np.arange(100) * 0.1, 5.0)
    for at, size in ((30, 3.0), (31, -0.6), (70, 0.5)):
        spiked = ramp.copy()
        spiked[at] += size
        np.testing.assert_allclose(measured_loop._without_spikes(spiked), ramp, atol=1e-9)
    three = ramp.copy()
    three[40:43] += 2.0
    np.testing.assert_allclose(measured_loop._without_spikes(three), ramp, atol=1e-9)
    np.testing.assert_array_equal(measured_loop._without_spikes(ramp), ramp)
    small = ramp.copy()
    small[30] += 0.25  # within what an actuator may do
    np.testing.assert_array_equal(measured_loop._without_spikes(small), small)


def test_stroke_and_angle_are_taken_at_the_same_time() -> None:
    stroke = Channel(np.arange(100) * 0.1, np.linspace(0.0, 9.9, 100))
    angle = Channel(np.arange(-10, 60) * 0.17, np.arange(70.0))
    t, x, y = measured_loop._aligned(stroke, angle, "vigv", "log")
    assert t[0] == 0.0 and t[-1] <= 9.9 and y[0] == 10.0
    np.testing.assert_allclose(x, t, atol=1e-9)
    keep = np.r_[0:30, 37:100]  # a gap of 0.8 s: what lies in it is left out
    t, x, _ = measured_loop._aligned(Channel(stroke.t[keep], stroke.values[keep]), angle, "vigv", "log")
    assert not ((t > 2.9) & (t < 3.7)).any() and t.size > 40
    with pytest.raises(LogError, match=r"log: x_lvdt has 19 samples; a loop needs at least 20"):
        measured_loop._aligned(Channel(stroke.t[:19], stroke.values[:19]), angle, "vigv", "log")
    with pytest.raises(LogError, match=r"log: vigv has 19 samples"):
        measured_loop._aligned(stroke, Channel(angle.t[:19], angle.values[:19]), "vigv", "log")
    with pytest.raises(LogError, match=r"vigv and x_lvdt have \d+ samples at the same time"):
        measured_loop._aligned(stroke, Channel(angle.t + 9.0, angle.values), "vigv", "log")


@pytest.mark.parametrize(("times", "right"), [(0.41, True), (0.39, False), (2.49, True), (2.51, False), (-1.0, False)])
def test_an_angle_may_follow_the_stroke_by_two_fifths_to_five_halves(times: float, right: bool) -> None:
    x, grid = np.linspace(5.0, 40.0, 400), np.linspace(0.0, 48.0, 97)
    if right:
        measured_loop._right_way(x, times * 1.2 * x, grid, 1.2 * grid, "vigv", "log")
        return
    with pytest.raises(LogError, match=r"log: vigv changes by .* deg/mm of stroke between 5 and 40 mm, the geometry "):
        measured_loop._right_way(x, times * 1.2 * x, grid, 1.2 * grid, "vigv", "log")


def test_a_curve_is_made_to_rise() -> None:
    y = measured_loop._rising(np.array([1.0, 3.0, 2.0, 2.5, 4.0]))
    assert (np.diff(y) > 0.0).all() and y == pytest.approx([1.0, 3.0, 3.0, 3.0, 4.0], abs=1e-8)


# ---- clearances and space --------------------------------------------------------------------------------------------


def test_a_clearance_that_no_joint_needs_is_a_dash() -> None:
    assert clearance._or(None) == "-" and clearance._or(0.126) == "0.13"
    assert sum(v > 0 for v in clearance.FITS.values()) == 5 and set(clearance.FITS) < set(clearance.WORDS)


def test_the_check_in_space_has_its_limits() -> None:
    for offset in (-100.001, 100.001, math.nan):
        with pytest.raises(InputError, match=r"--offset \(=.* mm\) must be in \[-100, 100\]"):
            spatial.spatial_check(GEOMETRY, offset)
    for points in (1, 10_001):
        with pytest.raises(InputError, match=rf"--points \(={points}\) must be in \[2, 10000\]"):
            spatial.spatial_check(GEOMETRY, points=points)
    one = {"vigv": np.ones(2)}
    both = spatial.SpatialCheck(np.zeros(2), one, {"vigv": 3 * one["vigv"]}, {"vigv": 4 * one["vigv"]}, [])
    assert both.difference("vigv").tolist() == [3.0, 3.0]
    assert replace(both, multibody={}).difference("vigv").tolist() == [2.0, 2.0]


# ---- strategies ------------------------------------------------------------------------------------------------------


def test_the_rows_of_the_comparison() -> None:
    rows = st.scenarios()
    assert [r.name for r in rows] == ["nominal", "worn", "thermal growth", "dither", "noise x3", "all together"]
    assert [(r.play, r.growth, r.noise, r.dither) for r in rows] == [
        (None, 0.0, 1.0, 0.0), (2.4, 0.0, 1.0, 0.0), (None, 0.5, 1.0, 0.0), (None, 0.0, 1.0, 0.15),
        (None, 0.0, 3.0, 0.0), (2.4, 0.5, 3.0, 0.15),
    ]  # fmt: skip


def test_a_scenarios_machine_has_what_is_wrong_with_it() -> None:
    base = build_plant()
    same = st.machine(st.Scenario("nominal"), base)
    np.testing.assert_array_equal(same.p, base.p)
    worn = st.machine(st.Scenario("worn", play=2 * base.geometry.vigv.hysteresis.value, noise=3.0), base)
    np.testing.assert_allclose(worn.sigma, 3.0 * base.sigma)

    def added(plant: Any) -> list[float]:  # beside the flag that there are effects on the vanes
        return sorted(p for p, was in zip(plant.p[:, 0], base.p[:, 0], strict=True) if p not in (was, 1.0))

    built = [np.deg2rad(base.geometry.stage(s).hysteresis.value) for s in base.vanes]
    assert added(worn) == pytest.approx(sorted(built))  # as much again, at every stage
    warm = st.machine(st.Scenario("warm", growth=0.5), base)
    assert added(warm) == pytest.approx([np.deg2rad(0.5 / 50.0)] * len(base.vanes))


def test_the_casing_warms_with_the_engines_power() -> None:
    t = st.casing(np.r_[np.full(10, 40.0), np.full(60_000, 100.0)])
    assert t[9] == T_REF and t[-1] == pytest.approx(T_REF + 50.0, abs=0.4)
    after = T_REF + 50.0 * (1.0 - math.exp(-1.0))
    assert t[10 + 12_000] == pytest.approx(after, abs=0.02)  # 120 s
    half = st.casing(np.full(200_000, 72.5))[-1]
    assert half == pytest.approx(T_REF + 25.0, abs=1e-3)
    assert st.casing(np.full(200_000, 130.0))[-1] == pytest.approx(T_REF + 50.0, abs=1e-3)


def test_a_dither_is_added_between_99_and_100_per_cent() -> None:
    n = np.full(10_000, 99.5)
    n[:100], n[100:200], n[200:300], n[300:400] = 98.999, 99.0, 100.0, 100.001
    d = st.dithered(n, 0.2) - n
    t = np.arange(10_000) * 0.01
    assert not d[:100].any() and not d[300:400].any() and d[100:300].any()
    for k, hertz in enumerate((0.1, 0.2, 0.5, 1.0, 0.1)):
        part = slice(2000 * k + 400, 2000 * (k + 1))
        np.testing.assert_allclose(d[part], 0.2 * np.sin(2 * math.pi * hertz * t[part]), atol=1e-9)


def test_the_moments_at_which_potentiometers_fail() -> None:
    """After the middle: 5 s into a rest of 15 s at 99 % and more; 1 s into a motion faster than 3 %/s."""
    n = np.r_[np.full(3000, 60.0), np.linspace(60, 99.5, 1000), np.full(4000, 99.5), np.linspace(99.5, 60, 1300)[1:],
              np.full(3000, 60.0)]  # fmt: skip
    found = st.moments(n)
    assert found["at rest"] == len(n) // 2 + 500 and abs(found["in motion"] - 8100) <= 1
    assert st.moments(np.full(5000, 98.9)) == {}  # it stands too low, and does not move
    slow = np.r_[np.full(3000, 60.0), np.linspace(60.0, 75.0, 503), np.full(3000, 75.0)]  # 2.99 %/s
    assert st.moments(slow) == {}
    assert st.moments(np.full(3001, 99.0)) == {"at rest": 2000} and st.moments(np.full(3000, 99.0)) == {}


def test_motions_below_the_threshold_do_not_count() -> None:
    def of(x: list[float]) -> tuple[float, float]:
        total, start = np.zeros(2), np.array([x[0], x[0], 0.0])
        st._motions(np.array(x), 0.5, total, start)
        return float(total[0] + abs(start[1] - start[0])), float(total[1])

    assert of([0.0, 0.5, 0.0, 0.4]) == (0.0, 0.0)
    assert of([0.0, 2.0, 1.6, 3.0]) == (3.0, 0.0)  # 0.4 back is no motion
    assert of([0.0, 2.0, 1.0, 3.0]) == (5.0, 2.0)
    assert of([0.0, -2.0, -1.0, -1.5]) == (3.0, 1.0)


def test_errors_near_full_speed_are_those_between_99_and_100() -> None:
    f = st._figures(np.array([1.0, -3.0, 0.5, -0.7]), np.array([50.0, 99.0, 99.5, 100.0]))
    assert f == pytest.approx({"mean_abs": 1.3, "max_abs": 3.0, "mean_abs_99_100": 0.5})
    assert st._figures(np.ones(2), np.array([99.0, 100.0]))["mean_abs_99_100"] is None


def outcome(scenario: str, strategy: str, mean: float, travel: float = 10.0, **more: Any) -> st.Outcome:
    z = np.zeros(4000)
    figures = {"vigv": {"mean_abs": mean, "max_abs": 2 * mean, "mean_abs_99_100": None}}
    given = {"vanes": np.zeros((4000, 3)), "errors": np.zeros((4000, 3)), "aim": z, "side": z, "offset": z, "width": z}
    return st.Outcome(
        scenario, strategy, 0.01 * np.arange(4000), z, stroke_demand=z, figures=figures, travel=travel,
        demand_travel=1.0, reversals=2, current=3.0, faults=0, **{**given, **more},
    )  # fmt: skip


def test_the_best_is_judged_against_dual() -> None:
    rows = (st.Scenario("nominal"), st.Scenario("all"))
    runs = {
        ("nominal", "dual"): outcome("nominal", "dual", 0.1), ("nominal", "x"): outcome("nominal", "x", 0.1, 11.5),
        ("all", "dual"): outcome("all", "dual", 0.6), ("all", "x"): outcome("all", "x", 0.2, 11.6),
    }  # fmt: skip
    bad = st.Failure("stuck", "at rest", ("vigv",), 1.0, 0.21, 0.1, 0, 0.1, 0.1)
    goals = st.judged(rows, runs, [bad, replace(bad, step=0.2)], "x")
    by_name = {g["goal"]: (g["value"], g["limit"], g["held"]) for g in goals}
    ratio = by_name["all: mean VIGV error of dual over that of x"]
    assert ratio[:2] == (pytest.approx(3.0), 3.0)
    assert by_name["nominal: travel of x over that of dual"] == (pytest.approx(1.15), 1.15, True)
    assert by_name["all: travel of x over that of dual"][2] is False
    assert by_name["nominal: VIGV mean of x (deg), at most dual's"] == (0.1, 0.1, True)
    assert by_name["all: VIGV maximum of x (deg), at most dual's"] == (0.4, 1.2, True)
    assert [(g["value"], g["held"]) for g in goals[-2:]] == [(0.21, False), (0.2, True)]
    assert goals[-1]["goal"] == "potentiometers, stuck, at rest: step (deg)" and len(goals) == 1 + 2 * 3 + 2
    better = {**runs, ("all", "x"): outcome("all", "x", 0.19)}
    assert st.judged(rows, better, [], "x")[0]["held"] is True
    d = runs["all", "x"].to_dict()
    assert (d["travel_mm"], d["demand_travel_mm"], d["current_rms_ma"], d["reversals"]) == (11.6, 1.0, 3.0, 2)
    assert d["vigv"]["max_abs"] == 0.4 and "vanes" not in d


@pytest.mark.parametrize("name", st.FAILURES)
def test_a_failure_is_what_its_name_says(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    cal, n = load_calibration(), np.full(4000, 99.5)
    ramp = np.clip((np.arange(4000) - 2500) * 1e-3, 0.0, 1.0)  # from sample `at` on, 0.1 deg in each second
    crosses, leap = np.where(np.arange(4000) % 200 < 100, 1.0, -1.0), 0.4 * (np.arange(4000) > 3500)
    vanes, errors = np.column_stack([ramp] * 3), np.full((4000, 3), 0.25)
    ill = outcome("s", "x", 0.1, vanes=vanes, errors=errors, offset=leap, side=crosses)
    well = outcome("s", "x", 0.1, side=np.ones(4000))
    dual = outcome("s", "dual", 0.1, errors=np.full((4000, 3), -0.5))
    given: list[Any] = []
    monkeypatch.setattr(st, "run", lambda *words: given.append(words) or ill)
    stuck = replace(well, vanes=well.vanes + 12.0)
    healthy = stuck if name == "stuck" else well
    f, out = st.failing(name, "at rest", healthy, dual, st.Scenario("s"), n, cal, 3, None, ("vgv1",))
    pots, at = given[0][4], 2500
    assert out is ill and f.at == 25.0 and given[0][3] == 3 and f.stages == ("vgv1",)
    assert (pots[:at] == np.tile([1.0, 0.0], len(cal.vanes))).all() and (pots[:, [0, 1, 4, 5]] == [1, 0, 1, 0]).all()
    share, wrong = pots[at:, 2], np.rad2deg(pots[at:, 3])
    t = np.arange(4000 - at) * 0.01
    expected = {
        "no signal": (1, np.nan), "out of range": (0, 120.0), "stuck": (0, 12.0), "jump of 2 deg": (1, 2.0),
        "jump of 0.3 deg": (1, 0.3), "drift of 0.05 deg/s": (1, 0.05 * t), "drift of 0.005 deg/s": (1, 0.005 * t),
        "drift of -0.005 deg/s": (1, -0.005 * t),
    }  # fmt: skip
    if name == "noise of 1 deg":
        assert (share == 1).all() and np.std(wrong) == pytest.approx(1.0, rel=0.1)
    else:
        assert (share == expected[name][0]).all()
        np.testing.assert_allclose(wrong, np.broadcast_to(expected[name][1], wrong.shape), atol=1e-9)
    assert f.step == pytest.approx(0.4)  # the compensation's leap, long after
    assert f.departure == pytest.approx(0.999 if name != "stuck" else 12.0)
    assert f.crossings == 9 and (f.mean_abs, f.mean_abs_dual) == (0.25, 0.5)
    every, _ = st.failing(name, "at rest", healthy, dual, st.Scenario("s"), n, cal)
    assert every.stages == cal.vanes
