"""What each line of the schedule's, the links' and the strategies' design promises: limits of the options, tables by
their definition, a measured loop's parts, and comparisons of runs that are known beforehand.
"""

from __future__ import annotations

import itertools
import math
import tomllib
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from controller import STRATEGIES, load_calibration
from hil.logs import Channel, Log, LogError
from plant import build_plant, load_geometry, load_schedules
from plant.effect import T_REF
from plant.geometry import vane_angles
from plant.linkage import G_HYSTERESIS, G_L, G_LDP, N_CRANK, N_PER_STAGE, stage_ring_angle, vane_angle
from plant.spatial import Clearances, spatial_angles
from vaneloop.base.errors import InputError
from vaneloop.design import (
    clearance,
    links,
    loop_fit,
    measured_loop,
    schedule_files,
    scheduling,
    spatial,
    stroke_tables,
)
from vaneloop.design import strategies as st
from vaneloop.design.links import ScheduleOptions, geometry_with
from vaneloop.design.multibody import multibody_angles

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
    ends = np.rad2deg(vane_angles(np.array([0.0, 48e-3]), GEOMETRY)[:, 0])  # of the stops
    high = SCHEDULES.model_copy(
        update={"vigv": SCHEDULES.vigv.model_copy(update={"values": [v + 30.0 for v in SCHEDULES.vigv.values]})}
    )
    for made in (stroke_tables.stroke_tables, stroke_tables.stroke_of_model):
        with pytest.raises(InputError) as e:
            made(GEOMETRY, high, np.array([90.0, 100.0]))
        at = np.rad2deg(high.targets(np.array([100.0]))[0, 0])
        assert str(e.value) == (
            f"vigv: no stroke meets the schedule at 100 % speed: target angle (={at:.4g} deg) must be in "
            f"[{ends[0]:.4g}, {ends[1]:.4g}], what 0 to 48 mm of stroke give"
        )
    assert stroke_tables.schedules_at_design(np.array([98.0, 99.0, 100.5, 101.0])) == 2


def test_the_tables_have_each_per_cent_from_where_the_schedule_rises_and_its_breakpoints() -> None:
    def of(speed: list[float], angle: list[float]) -> list[float]:
        axes = {"speed": speed, "vigv": angle, "vgv1": None, "vgv2": None}
        update = {n: SCHEDULES.vigv.model_copy(update={"values": v}) if v else None for n, v in axes.items()}
        return stroke_tables.table_speeds(SCHEDULES.model_copy(update=update)).tolist()

    assert of([50.0, 96.5, 98.25, 100.4], [1.0, 1.0, 2.0, 3.0]) == [96.5, 97.0, 98.0, 98.25, 99.0, 100.0, 100.4]
    assert of([97.0, 99.0], [1.0, 3.0]) == [97.0, 98.0, 99.0]


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


def test_strokes_in_three_places_tell_a_wrong_sign_and_in_two_do_not() -> None:
    grid = np.linspace(0.0, 48.0, 97)
    three = np.repeat([5.0, 6.5, 40.0], 50)  # the first two in the first two of 24 parts
    with pytest.raises(LogError, match=r"allowed: 0.4 to 2.5 times that"):
        measured_loop._right_way(three, -1.2 * three, grid, 1.2 * grid, "vigv", "log")
    two = np.repeat([5.0, 40.0], 50)
    measured_loop._right_way(two, -1.2 * two, grid, 1.2 * grid, "vigv", "log")
    with pytest.raises(LogError, match=r"log: vigv stays at 3 deg while x_lvdt moves from 5 to 40 mm"):
        measured_loop._right_way(two, np.full(100, 3.0), grid, 1.2 * grid, "vigv", "log")


def test_a_curve_is_made_to_rise() -> None:
    y = measured_loop._rising(np.array([1.0, 3.0, 2.0, 2.5, 4.0]))
    assert (np.diff(y) > 0.0).all() and y == pytest.approx([1.0, 3.0, 3.0, 3.0, 4.0], abs=1e-8)


# ---- the fit of a loop -----------------------------------------------------------------------------------------------


def ring_log(loops: int, seed: int = 3, noise: float = 0.04, lag: float = 0.03, drift: float = 0.0) -> tuple[Any, ...]:
    """Time, stroke, ring angle beside the model, slope and rate of a stroke that goes ``loops`` times there and back
    between 4 and 16 mm at 2 mm/s; a play of 1.2 mm drives a ring of 1.5 deg/mm with a curved centre.
    """
    t = np.arange(0.0, 12.0 * loops, 0.05)
    x = 10.0 - 6.0 * np.cos(np.pi * t / 6.0)
    ring, lost = x[0], []
    for v in x:
        ring = min(max(ring, v - 0.6), v + 0.6)
        lost.append(ring - v)
    v, s = np.gradient(x, t), np.full(t.size, 1.5)
    e = noise * np.random.default_rng(seed).standard_t(3, t.size)
    return t, x, 1.5 * np.array(lost) + 0.002 * (x - 9.0) ** 2 - lag * s * v + drift * np.sin(0.1 * t) + e, s, v


def least_squares_of_a_loop(
    t: Any, x: Any, r: Any, s: Any, v: Any, d: Any, loops: Any, lag: tuple[float, float]
) -> Any:
    """The fit by its definition: Huber's losses of r = c(x) - d g(x)/2 + drift(t) - lag s v and penalties on curvature
    (0.03), on the gap's slope (0.03), on the lag's prior, on the drift's steps (0.3 deg) and its mean.
    """
    knots = np.linspace(x.min(), x.max(), round((x.max() - x.min()) / 2.0) + 1)
    m, q = knots.size, len(loops)
    hats = np.array([np.interp(x, knots, row) for row in np.eye(m)]).T
    bend, step = np.diff(np.eye(m), 2, axis=0), np.diff(np.eye(m), axis=0)
    spline = CubicSpline(loops, np.eye(q), bc_type="natural")(t) if q else np.zeros((t.size, 0))
    a = np.hstack([hats, -0.5 * d[:, None] * hats, -(s * v)[:, None], spline])

    def wide(rows: Any, at: int, scale: float) -> Any:
        out = np.zeros((len(rows), 2 * m + 1 + q))
        out[:, at : at + rows.shape[1]] = rows / scale
        return out

    penalties = [wide(bend, 0, 0.03), wide(bend, m, 0.03), wide(step, m, 0.03), wide(np.eye(1), 2 * m, lag[1])]
    if q:
        drifts = np.diff(np.eye(q), axis=0), spline.mean(axis=0)[None]
        penalties += [wide(drifts[0], 2 * m + 1, 0.3), wide(drifts[1], 2 * m + 1, 1e-4)]
    p = np.vstack(penalties)
    aim = np.where(p[:, 2 * m] != 0.0, lag[0] / lag[1], 0.0)
    theta, sigma = np.zeros(a.shape[1]), 0.05
    w = np.ones(t.size)
    for _ in range(40):
        normal = a.T @ (a * w[:, None]) / sigma**2 + p.T @ p
        theta = np.linalg.solve(normal, a.T @ (w * r) / sigma**2 + p.T @ aim)
        e = np.abs(r - a @ theta)
        sigma = 1.4826 * np.median(e)
        w = np.where(e > 1.5 * sigma, 1.5 * sigma / e, 1.0)
    unit = np.r_[np.zeros(m), np.full(m, 1.0 / m), np.zeros(1 + q)]
    drift = np.ptp(spline @ theta[2 * m + 1 :]) if q else None
    return theta[:m], theta[m : 2 * m], theta[2 * m], sigma, math.sqrt(unit @ np.linalg.solve(normal, unit)), drift


@pytest.mark.parametrize("loops", [1, 4])
def test_a_loop_is_fitted_by_robust_penalised_least_squares(loops: int) -> None:
    t, x, r, s, v = ring_log(loops, drift=0.3)
    branch = loop_fit._branches(x, 2.0, 0.02)
    fit = loop_fit._fit(t, x, r, s, v, branch, (0.01, 0.02))
    on = branch != 0
    times = loop_fit._loop_times(t[on], x[on], branch[on])
    assert len(times) == (0, 5)[loops == 4] and (fit.drift is None) == (loops == 1)
    centre, gap, lag, sigma, gap_sigma, drift = least_squares_of_a_loop(
        t[on], x[on], r[on], s[on], v[on], branch[on].astype(float), times, (0.01, 0.02)
    )
    np.testing.assert_allclose(fit.centre, centre, atol=2e-5)
    np.testing.assert_allclose(fit.gap, gap, atol=2e-5)
    assert (fit.lag, fit.noise, fit.gap_sigma) == pytest.approx((lag, sigma, gap_sigma), rel=2e-4)
    assert fit.drift is None or fit.drift == pytest.approx(drift, abs=2e-5)
    for side in (1, -1):
        assert fit.covered[side] == (x[branch == side].min(), x[branch == side].max())
    assert fit.branch is branch


def test_a_long_log_is_fitted_in_groups_of_neighbours(monkeypatch: pytest.MonkeyPatch) -> None:
    keep = np.r_[0:61, 95:480]  # a gap of 1.7 s on a branch
    t, x, r, s, v = (a[keep] for a in ring_log(2))
    branch = loop_fit._branches(x, 2.0, 0.02)
    n = int((branch != 0).sum())
    whole = loop_fit._fit(t, x, r, s, v, branch, (0.03, 0.02))
    monkeypatch.setattr(loop_fit, "MAX_SAMPLES", n)
    assert loop_fit._fit(t, x, r, s, v, branch, (0.03, 0.02)).centre.tolist() == whole.centre.tolist()
    monkeypatch.setattr(loop_fit, "MAX_SAMPLES", n // 4)
    grouped = loop_fit._fit(t, x, r, s, v, branch, (0.03, 0.02))
    assert grouped.noise < 0.8 * whole.noise
    # groups of one branch, without a gap of time: their mean stroke, their median angle
    on = np.flatnonzero(branch)
    size = -(-on.size // (n // 4))
    groups = on[: on.size // size * size].reshape(-1, size)
    alike = [g for g in groups if abs(branch[g].sum()) == size and np.ptp(t[g]) < 5 * size * 0.05]
    assert size > 3 and 0 < len(alike) < len(groups)
    monkeypatch.setattr(loop_fit, "MAX_SAMPLES", 10**9)
    mean = [np.array([a[g].mean() for g in alike]) for a in (t, x, s, v)]
    middle, sign = np.array([np.median(r[g]) for g in alike]), np.array([branch[g[0]] for g in alike], np.int8)
    same = loop_fit._fit(mean[0], mean[1], middle, *mean[2:], sign, (0.03, 0.02))
    np.testing.assert_allclose(grouped.gap, same.gap, atol=1e-4)
    np.testing.assert_allclose(grouped.centre, same.centre, atol=1e-4)


def test_the_play_that_tells_branches_apart_is_a_quarter_wider_than_the_gap() -> None:
    t, x, r, s, v = ring_log(2, noise=0.01)
    found = loop_fit.fit_with_width(t, x, r, s, v, 12.0, 0.03, (0.03, 0.02), "vigv", "log")
    wanted = 1.25 * found.gap.max() / 1.5 + 0.06
    at = [
        w
        for w in np.linspace(0.96 * wanted, 1.04 * wanted, 81)
        if (found.branch == loop_fit._branches(x, w, 0.03)).all()
    ]
    assert at and 0.97 * wanted < np.mean(at) < 1.03 * wanted
    assert (found.low, found.high) == (x[found.branch != 0].min(), x[found.branch != 0].max())
    none = loop_fit.fit_with_width(t, x, 0.0 * r, s, v, 12.0, 0.03, (0.0, 0.02), "vigv", "log")
    assert (none.branch == loop_fit._branches(x, 0.12, 0.03)).all()  # no gap: four times the tolerance


def test_a_branch_that_only_a_narrower_play_shows_is_found_and_a_wider_gap_refused() -> None:
    """A short way back: 40 % of the travel hide it, 15 % do not. A gap that is wider than that is refused."""
    t = np.arange(0.0, 24.0, 0.05)
    x = np.where(t < 12.0, t, np.where(t < 15.0, 24.0 - t, t - 6.0))  # 12 mm up, 3 mm back, up again
    ring, lost = x[0], []
    for v in x:
        ring = min(max(ring, v - 0.25), v + 0.25)
        lost.append(ring - v)
    s, v = np.full(t.size, 1.0), np.gradient(x, t)
    assert loop_fit._missing(loop_fit._branches(x, 0.25 * 18.0, 0.02), x) == "retraction"
    fit = loop_fit.fit_with_width(t, x, np.array(lost), s, v, 18.0, 0.02, (0.0, 1e-3), "vigv", "log")
    assert np.mean(fit.gap) == pytest.approx(0.5, abs=0.03)
    with pytest.raises(LogError, match=r"^log: vigv: the loop has one branch only, retraction is missing"):
        loop_fit.fit_with_width(t, x, 7.0 * np.array(lost), s, v, 18.0, 0.02, (0.0, 1e-3), "vigv", "log")


def test_a_log_that_goes_one_way_says_how_far_it_went() -> None:
    t = np.arange(0.0, 10.0, 0.05)
    for sign, missing, way in ((1.0, "retraction", "back"), (-1.0, "extension", "forward")):
        x = 20.0 + sign * np.minimum(t, 9.0) - sign * np.maximum(t - 9.5, 0.0)
        one = np.ones(t.size)
        with pytest.raises(LogError) as e:
            loop_fit.fit_with_width(t, x, one, one, one, 9.0, 0.02, (0.0, 0.01), "vgv1", "log")
        assert str(e.value) == (
            f"log: vgv1: the loop has one branch only, {missing} is missing: x_lvdt from {x.min():.4g} to "
            f"{x.max():.4g} mm moves {way} by 0.45 mm at most (9 mm the other way); more than 2 mm is needed to cross "
            "the gap and measure"
        )
    apart = loop_fit._one_branch(np.array([0.0, 3.0, 1.0]), "overlap", 1.0, "vigv", "log")
    assert str(apart) == (
        "log: vigv: the two branches of the loop do not overlap by 1 mm of stroke (x_lvdt rises by 3 mm and falls by "
        "2 mm at a stretch); a loop goes there and back"
    )


# ---- from a log to curves --------------------------------------------------------------------------------------------

OTHER = geometry_with(GEOMETRY, {"vgv1": {"lb": 48.4, "lc": 494.5, "hysteresis": 1.5}})


def loop_of(low: float, high: float, passes: int = 4, rows: int = 0) -> tuple[Channel, Channel]:
    """Stroke (a sine of at most 4 mm/s between ``low`` and ``high`` mm) and VGV1 angle of OTHER, without noise; the
    angle lags by 10 ms.
    """
    once = (high - low) * math.pi / 8.0
    t = np.linspace(0.0, passes * once, rows or int(passes * once * 20) + 1)

    def stroke(at: Any) -> Any:
        return 0.5 * (low + high) - 0.5 * (high - low) * np.cos(np.pi * at / once)

    g, o = OTHER.arrays(), N_CRANK + N_PER_STAGE
    half = 0.5 * g[o + G_HYSTERESIS] * g[o + G_L] / g[o + G_LDP]
    ring, out = stage_ring_angle(low * 1e-3, g, 1), []
    for x in stroke(t - 0.01):
        drive = stage_ring_angle(x * 1e-3, g, 1)
        ring = min(max(ring, drive - half), drive + half)
        out.append(math.degrees(vane_angle(ring, g[o + G_LDP], g[o + G_L])))
    return Channel(t, stroke(t)), Channel(t, np.array(out))


def test_a_loop_without_noise_gives_back_the_machine_that_made_it() -> None:
    stroke, angle = loop_of(0.0, 48.0)
    m = measured_loop.measure_loop(stroke, angle, GEOMETRY, "vgv1")
    assert (m.stage, m.stroke[0], m.stroke[-1], m.stroke.size) == ("vgv1", -2.0, pytest.approx(50.0), 1041)
    assert m.width == pytest.approx(1.5, abs=0.01) and 0.0 < m.width_sigma < 2e-3 and m.noise < 2e-3
    assert (m.lb, m.lc) == pytest.approx((48.4, 494.5), abs=0.02) and m.misfit < 2e-3
    assert m.lag == pytest.approx(0.01, abs=1e-3) and m.drift == pytest.approx(0.0, abs=1e-4) and m.notes == []
    once = measured_loop.measure_loop(*loop_of(0.0, 48.0, passes=2), GEOMETRY, "vgv1")
    assert once.drift is None and once.notes == [
        "fewer than two loops there and back: a drift of the angle cannot be distinguished from the loop's width"
    ]
    middle, built = (np.rad2deg(vane_angles(m.stroke * 1e-3, g)[:, 1]) for g in (OTHER, GEOMETRY))
    np.testing.assert_allclose(m.mean, middle, atol=0.02)
    inside = (m.stroke >= m.extension_covered[0]) & (m.stroke <= m.retraction_covered[1])
    assert m.offset == pytest.approx((middle - built)[inside].mean(), abs=5e-3)
    np.testing.assert_allclose(0.5 * (m.extension + m.retraction), m.mean, atol=0.03)
    centre = np.argmin(np.abs(m.mean))  # where the vane turns as its ring does, the play is seen as it is
    assert (m.retraction - m.extension)[centre] == pytest.approx(1.5, abs=0.01)
    x, y, branch = m.samples
    np.testing.assert_array_equal(x, stroke.values)
    np.testing.assert_array_equal(y, angle.values)
    assert set(branch) == {-1.0, 0.0, 1.0} and np.diff(x)[branch[1:] == 1].min() > -0.02
    assert m.extension_covered == (x[branch == 1].min(), x[branch == 1].max())
    assert m.retraction_covered == (x[branch == -1].min(), x[branch == -1].max())


def test_a_short_loop_says_where_it_measured_and_follows_the_geometry_beyond() -> None:
    m = measured_loop.measure_loop(*loop_of(10.0, 30.0, passes=6), GEOMETRY, "vgv1", lag=(0.01, 0.001))
    assert m.drift == pytest.approx(0.0, abs=0.01)
    up, down = m.extension_covered, m.retraction_covered
    assert m.notes == [
        f"measured from {min(up[0], down[0]):.1f} to {max(up[1], down[1]):.1f} mm (both branches "
        f"{max(up[0], down[0]):.1f} to {min(up[1], down[1]):.1f}); beyond, the curves follow the geometry"
    ]
    assert m.width == pytest.approx(1.5, abs=0.02)
    fitted = geometry_with(GEOMETRY, {"vgv1": {"lb": m.lb, "lc": m.lc}}, check=False)
    rest = m.mean - np.rad2deg(vane_angles(m.stroke * 1e-3, fitted)[:, 1])
    assert np.ptp(rest[m.stroke > 31.0]) < 0.01 and np.ptp(rest[m.stroke < 9.0]) < 0.01  # held


def test_what_shows_no_loop_is_refused_in_one_line() -> None:
    def says(stroke: Channel, angle: Channel) -> str:
        with pytest.raises(LogError) as e:
            measured_loop.measure_loop(stroke, angle, GEOMETRY, "vgv1")
        return str(e.value)

    still = loop_of(20.0, 22.8, rows=57)
    assert says(*still) == (
        "log: x_lvdt moves only 2.8 mm (20 to 22.8 mm): no motion to see a loop in; at least 3 mm is needed"
    )
    stroke, angle = loop_of(0.0, 48.0, passes=2, rows=200)
    for values, worst in ((1.1 * stroke.values - 1.0, "51.8"), (stroke.values - 3.0, "-3")):
        assert says(Channel(stroke.t, values), angle) == (
            f"log: x_lvdt (={worst} mm) must be in [-2, 50] mm; is its unit right?"
        )
    dead = Channel(angle.t, np.full(angle.t.size, 3.25))
    assert says(stroke, dead) == "log: vgv1 stays at 3.25 deg while x_lvdt moves from 0 to 48 mm"
    assert "samples must be finite" in says(stroke, Channel(angle.t, np.where(angle.t > 3.0, np.nan, angle.values)))


def test_lengths_are_those_with_which_the_model_has_the_measured_curve() -> None:
    g, o = OTHER.arrays(), N_CRANK + N_PER_STAGE
    x = np.linspace(0.0, 48.0, 97)
    scale = measured_loop.DEG * g[o + G_LDP] / g[o + G_L]
    ring = np.array([stage_ring_angle(v * 1e-3, g, 1) for v in x]) * scale
    assert measured_loop._equivalent(GEOMETRY, 1, x, ring, scale) == pytest.approx((48.4, 494.5), abs=2e-3)
    # of a single stroke a change of either length would do: the smallest of both
    lb, lc = measured_loop._equivalent(GEOMETRY, 1, x[:1], ring[:1], scale)
    for changed in ((lb, lc),):
        h = geometry_with(GEOMETRY, {"vgv1": {"lb": changed[0], "lc": changed[1]}}, check=False).arrays()
        assert stage_ring_angle(0.0, h, 1) * scale == pytest.approx(ring[0], abs=1e-3)
    assert math.hypot(lb - 49.0, lc - GEOMETRY.vgv1.lc.value) < math.hypot(48.4 - 49.0, 494.5 - GEOMETRY.vgv1.lc.value)


# ---- links that meet a schedule --------------------------------------------------------------------------------------


@pytest.mark.parametrize("criterion", ["rms", "max", "design"])
def test_the_best_pair_of_lengths_is_the_best_of_all(criterion: Any) -> None:
    speed = np.array([30.0, 60.0, 80.0, 100.0, 104.0])
    stroke = stroke_tables.stroke_of_model(GEOMETRY, SCHEDULES, speed) * 1e3
    o = ScheduleOptions(step=1.0, lb_range=3.0, lc_range=2.0, criterion=criterion, limit=20.0)

    def more(x: Any) -> Any:
        return 0.05 * x - 1.0

    error: dict[tuple[float, float], Any] = {}
    for lb, lc in itertools.product(range(-3, 4), range(-2, 3)):
        g = geometry_with(GEOMETRY, {"vgv1": {"lb": 49.0 + lb, "lc": GEOMETRY.vgv1.lc.value + lc}}, check=False)
        angle = np.rad2deg(vane_angles(stroke * 1e-3, g)[:, 1]) + more(stroke)
        error[lb, lc] = np.rad2deg(SCHEDULES.targets(speed)[:, 1]) - angle
    rms = {c: math.sqrt(np.mean(e[1:4] ** 2)) for c, e in error.items()}  # at 40 to 102 % it works
    worth = {
        "rms": rms,
        "max": {c: np.abs(e[1:4]).max() for c, e in error.items()},
        "design": {c: abs(e[3]) + rms[c] for c, e in error.items()},
    }[criterion]
    best = min(worth, key=lambda c: worth[c])
    lb, lc, left = links.adjust_links(GEOMETRY, SCHEDULES, "vgv1", stroke, speed, o, more)
    assert (lb, lc) == best and type(lb) is float
    np.testing.assert_allclose(left, error[best], atol=1e-9)
    for adjust, mine in ((("lb",), [c for c in error if c[1] == 0]), (("lc",), [c for c in error if c[0] == 0])):
        found = links.adjust_links(GEOMETRY, SCHEDULES, "vgv1", stroke, speed, replace(o, adjust=adjust), more)
        assert found[:2] == min(mine, key=lambda c: worth[c])
    largest = max(abs(error[best][1:4]), default=0.0)
    links.adjust_links(GEOMETRY, SCHEDULES, "vgv1", stroke, speed, replace(o, limit=largest), more)
    at = 1 + int(np.argmax(np.abs(error[best][1:4])))
    with pytest.raises(InputError) as e:
        links.adjust_links(GEOMETRY, SCHEDULES, "vgv1", stroke, speed, replace(o, limit=0.999 * largest), more)
    assert str(e.value) == (
        f"vgv1: no length meets the schedule at {speed[at]:g} % speed (stroke {stroke[at]:.4g} mm): with lb (=49 mm) "
        f"within 3 mm and lc (={GEOMETRY.vgv1.lc.value:g} mm) within 2 mm an error of {error[best][at]:.3g} deg "
        f"remains; allowed: {0.999 * largest:g} deg (--limit, --lb-range, --lc-range)"
    )


def test_lengths_stay_above_nothing_and_speeds_at_which_nothing_works_count_all_the_same() -> None:
    speed = np.array([20.0, 30.0])
    stroke = np.array([1.0, 4.0])
    o = ScheduleOptions(step=0.5, lb_range=0.6, lc_range=0.0, limit=180.0)
    lb, lc, error = links.adjust_links(GEOMETRY, SCHEDULES, "vgv1", stroke, speed, o)
    assert lb in (-0.5, 0.0, 0.5) and lc == 0.0 and error.shape == (2,)
    g = geometry_with(GEOMETRY, {"vgv1": {"lb": 49.0 + lb}})
    expected = np.rad2deg(SCHEDULES.targets(speed)[:, 1] - vane_angles(stroke * 1e-3, g)[:, 1])
    np.testing.assert_allclose(error, expected, atol=1e-9)
    # a row of lengths of which none is left: the shortest that there are lie below zero
    short = geometry_with(GEOMETRY, {"vgv1": {"lb": 0.5, "lc": 1.0}}, check=False)
    with pytest.raises(InputError):
        links.adjust_links(short, SCHEDULES, "vgv1", stroke, speed, replace(o, lb_range=1.0))


# ---- the method ------------------------------------------------------------------------------------------------------


def loop_as_measured(stage: str, angle: Any, width: float = 1.0, **more: Any) -> measured_loop.MeasuredLoop:
    """A loop whose mean curve is ``angle`` of the stroke and whose branches lie half its width beside."""
    x = np.arange(0.0, 48.01, 0.5)
    mean = angle(x)
    given: dict[str, Any] = {"lb": 50.0, "lc": 495.0, "width_sigma": 0.01, "notes": []} | more
    return measured_loop.MeasuredLoop(
        stage, width, offset=0.1, misfit=0.02, noise=0.03, drift=None, lag=0.004, extension_covered=(1.0, 47.0),
        retraction_covered=(2.0, 46.0), stroke=x, extension=mean - 0.5 * width, retraction=mean + 0.5 * width,
        mean=mean, samples=(x, mean, 0.0 * x), **given,
    )  # fmt: skip


def model(k: int, geometry: Any = GEOMETRY) -> Any:
    return lambda x: np.rad2deg(vane_angles(np.asarray(x) * 1e-3, geometry)[:, k])


def test_tables_of_a_measured_loop_are_its_two_curves_backwards() -> None:
    speed = np.array([60.0, 80.0, 100.0])
    target, notes = np.rad2deg(SCHEDULES.targets(speed)[:, 0]), []
    loop = loop_as_measured("vigv", model(0), 0.8)
    table = scheduling._tables(GEOMETRY, SCHEDULES, speed, loop, notes)
    for row, curve in zip(table[1:], (loop.extension, loop.retraction, loop.mean), strict=True):
        np.testing.assert_allclose(np.interp(row, loop.stroke, curve), target, atol=1e-9)
    assert notes == [] and (table[1] > table[3]).all() and (table[3] > table[2]).all()
    # a stop cuts a branch off: there the gap is not crossed in full
    wide = replace(loop, stroke=loop.stroke - 1.0, extension=loop.extension + 3.0)
    table = scheduling._tables(GEOMETRY, SCHEDULES, speed, replace(wide, retraction=loop.retraction + 60.0), notes)
    assert table[2].tolist() == [0.0] * 3 and notes == [
        "retraction: the stop at 0 mm cuts the table off at 3 speeds, most at 60 % (1.00 mm): the gap is not crossed "
        "in full there"
    ]
    assert (table[1] == table[3]).all()  # never below the mean
    np.testing.assert_allclose(
        scheduling._tables(GEOMETRY, SCHEDULES, speed, None, []),
        stroke_tables.stroke_tables(GEOMETRY, SCHEDULES, speed),
    )


def test_the_method_with_a_measured_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    """VIGV and VGV1 are measured, VGV2 is not: what each has of its own loop, and what of the geometry."""
    loops = {
        "vigv": loop_as_measured("vigv", lambda x: model(0)(x) + 0.2, 1.25, lb=75.12347, notes=["n", "m"]),
        "vgv1": loop_as_measured("vgv1", lambda x: model(1)(x) - 0.1, 0.5, notes=["n"]),
    }
    seen, done = [], []

    def measure(stroke: Any, angle: Any, geometry: Any, name: str, source: str) -> Any:
        seen.append((stroke, angle, geometry is GEOMETRY, name, source))
        if name not in loops:
            raise LogError("dead")
        return loops[name]

    monkeypatch.setattr(scheduling, "measure_loop", measure)
    channels = {n: Channel(np.arange(3.0), np.arange(3.0)) for n in ("x_lvdt", "vigv", "vgv1", "vgv2")}
    log = Log("a/b.csv", channels, ["said"])
    o = ScheduleOptions(step=1.0, lb_range=1.0, lc_range=1.0)
    r = scheduling.schedule(GEOMETRY, SCHEDULES, log, o, done.append)
    assert [(s[0] == log.channels["x_lvdt"], s[1] == log.channels[s[3]], *s[2:]) for s in seen] == [
        (True, True, True, name, "a/b.csv") for name in GEOMETRY.vanes
    ]
    assert done == pytest.approx([0.8 / 3, 1.6 / 3, 0.8, 1.0]) and r.loops == loops and r.log == "a/b.csv"
    assert r.notes[:4] == [
        "said", "vgv2 is not measured, the geometry's own curves stand for it: dead", "vigv, vgv1: n", "vigv: m",
    ]  # fmt: skip
    assert r.origin == (
        "derived: vaneloop schedule, inverse of the two branches at the VIGV schedule, loop of 1.25 deg measured in "
        "b.csv"
    )
    np.testing.assert_array_equal(r.speed, stroke_tables.table_speeds(SCHEDULES))
    np.testing.assert_allclose(r.target, np.rad2deg(SCHEDULES.targets(r.speed)))
    np.testing.assert_array_equal(r.table, scheduling._tables(GEOMETRY, SCHEDULES, r.speed, loops["vigv"], []))
    works = (r.speed >= 40.0) & (r.speed <= 102.0)
    first = stroke_tables.stroke_of_model(GEOMETRY, SCHEDULES, r.speed)
    for k, (link, more) in enumerate(zip(r.links, (0.2, -0.1, 0.0), strict=True)):
        built = GEOMETRY.stage(link.stage)
        initial = r.target[:, k] - np.rad2deg(vane_angles(first, GEOMETRY.arrays(True))[:, k])
        np.testing.assert_allclose(link.error_initial, initial, atol=1e-9)
        np.testing.assert_allclose(link.error_built, r.target[:, k] - model(k)(r.table[3]) - more, atol=2e-3)
        assert (link.lb_initial, link.lb_built, link.lc_built) == (
            built.lb_initial.value, built.lb.value, built.lc.value
        )  # fmt: skip
        loop = loops.get(link.stage)
        lb, lc = (loop.lb, loop.lc) if loop else (built.lb.value, built.lc.value)
        machine = r.geometry.stage(link.stage)
        assert machine.lb.value == pytest.approx(round(lb + link.lb - link.lb_built, 4), abs=1e-12)
        assert machine.lc.value == pytest.approx(round(lc + link.lc - link.lc_built, 4), abs=1e-12)
        assert machine.hysteresis.value == (loop.width if loop else built.hysteresis.value)
        columns = (link.error_initial, link.error_built, link.error, link.error_extension, link.error_retraction)
        names = ("initial", "built", "adjusted", "extension", "retraction")
        at = int(np.argmin(np.abs(r.speed - 100.0)))
        assert link.at_design == {n: e[at] for n, e in zip(names, columns, strict=True)}
        assert link.rms == pytest.approx(
            {n: math.sqrt(np.mean(e[works] ** 2)) for n, e in zip(names, columns, strict=True)}
        )
        assert link.largest == {n: np.abs(e[works]).max() for n, e in zip(names, columns, strict=True)}
    vigv = r.links[0]
    assert (vigv.lb, vigv.lc) == (vigv.lb_built, vigv.lc_built) and vigv.error is vigv.error_built
    for error, row, curve in ((vigv.error_extension, 1, "extension"), (vigv.error_retraction, 2, "retraction")):
        angle = np.interp(r.table[row], loops["vigv"].stroke, getattr(loops["vigv"], curve))
        np.testing.assert_allclose(error, r.target[:, 0] - angle)
    change = r.links[1].lb - r.links[1].lb_built
    assert r.geometry.vgv1.lb.origin == (
        f"measured: b.csv, 50.000 mm equivalent where the geometry has 49 mm; adjusted by {change:+g} mm"
    )
    assert r.geometry.vigv.hysteresis.origin == "measured: b.csv, width of the loop, standard error 0.010 deg"
    fixed = scheduling.schedule(GEOMETRY, SCHEDULES, log, replace(o, adjust=()))
    assert [(s.lb, s.lc) for s in fixed.links] == [(s.lb_built, s.lc_built) for s in fixed.links]
    loops.pop("vigv")
    with pytest.raises(LogError, match="^dead$"):
        scheduling.schedule(GEOMETRY, SCHEDULES, log, o)
    for names, said in ((["vigv"], "no x_lvdt"), (["x_lvdt"], "no vigv"), ([], "no x_lvdt and no vigv")):
        with pytest.raises(LogError, match=rf"^log: {said}; a loop needs stroke and angle$"):
            scheduling.schedule(GEOMETRY, SCHEDULES, Log("log", {n: channels[n] for n in names}, []))


def test_either_direction_lies_on_its_own_branch_of_the_play() -> None:
    """While the stroke extends, ring and vane lag by half the play below the drive."""
    r = scheduling.schedule(GEOMETRY, SCHEDULES, options=ScheduleOptions(adjust=()))
    for k, link in enumerate(r.links):
        g, o = r.geometry.arrays(), N_CRANK + k * N_PER_STAGE
        half = 0.5 * g[o + G_HYSTERESIS] * g[o + G_L] / g[o + G_LDP]
        for error, row, side in ((link.error_extension, 1, -1.0), (link.error_retraction, 2, 1.0)):
            ring = [stage_ring_angle(x * 1e-3, g, k) + side * half for x in r.table[row]]
            angle = np.degrees([vane_angle(q, g[o + G_LDP], g[o + G_L]) for q in ring])
            np.testing.assert_allclose(error, r.target[:, k] - angle, atol=1e-9)
    assert r.geometry == GEOMETRY and r.origin.endswith(f"hysteresis of {GEOMETRY.vigv.hysteresis.value:g} deg")
    assert r.log == "" and r.loops == {}
    adjusted = scheduling.schedule(GEOMETRY, SCHEDULES, options=ScheduleOptions(step=0.25, lb_range=1.0, lc_range=1.0))
    for link in adjusted.links[1:]:
        stage = adjusted.geometry.stage(link.stage)
        for name, built, now in (("lb", link.lb_built, link.lb), ("lc", link.lc_built, link.lc)):
            assert getattr(stage, name).value == now
            if now != built:
                said = f"derived: vaneloop schedule, {built:g} mm as built, adjusted by {now - built:+g} mm"
                assert getattr(stage, name).origin == said
    assert any(s.lb != s.lb_built or s.lc != s.lc_built for s in adjusted.links)


def test_a_schedule_outside_the_working_speeds_is_refused_and_one_without_100_per_cent_noted() -> None:
    def scaled(low: float, high: float) -> Any:
        n = np.array(SCHEDULES.speed.values)
        rises = n[np.flatnonzero(np.diff(np.array(SCHEDULES.vigv.values)) > 0.0)[0]]
        values = low + (n - rises) * (high - low) / (n[-1] - rises)
        return SCHEDULES.model_copy(update={"speed": SCHEDULES.speed.model_copy(update={"values": values.tolist()})})

    with pytest.raises(
        InputError, match=r"^schedules: vigv rises from 10 to 39\.9 % speed; it must reach into 40 to 102 %$"
    ):
        scheduling.schedule(GEOMETRY, scaled(10.0, 39.9))
    r = scheduling.schedule(GEOMETRY, scaled(60.0, 98.0), options=ScheduleOptions(adjust=()))
    assert r.notes == ["the schedule's table runs from 60 to 98 %: figures at 100 % speed are those at 98 %"]
    assert scheduling.schedule(GEOMETRY, scaled(60.0, 100.0), options=ScheduleOptions(adjust=())).notes == []


def test_what_is_written_is_what_was_found(tmp_path: Path) -> None:
    r = scheduling.schedule(GEOMETRY, SCHEDULES, options=ScheduleOptions(step=1.0, lb_range=1.0, lc_range=1.0))
    files = schedule_files.write_tables(r, tmp_path / "a" / "b")
    assert sorted(f.name for f in files) == [
        "geometry.toml",
        "schedules.toml",
        "stroke_tables.toml",
        "vane_angles.toml",
    ]
    table, angles = (
        tomllib.loads((tmp_path / "a/b" / f"{n}.toml").read_text()) for n in ("stroke_tables", "vane_angles")
    )
    for name, unit, row in zip(
        ("speed", "extension", "retraction", "single"), ("%", "mm", "mm", "mm"), r.table, strict=True
    ):
        assert (table[name]["unit"], table[name]["origin"]) == (unit, r.origin)
        np.testing.assert_allclose(table[name]["values"], row, atol=5.1e-5)
    for name, unit, row in zip(
        ("stroke", *r.geometry.vanes),
        ("mm", "deg", "deg", "deg"),
        stroke_tables.vane_angle_table(r.geometry),
        strict=True,
    ):
        assert (angles[name]["unit"], angles[name]["origin"]) == (unit, r.origin)
        np.testing.assert_allclose(angles[name]["values"], row, atol=5.1e-5)
    for stage in r.geometry.vanes:
        q = r.geometry.stage(stage).hysteresis
        assert angles[f"play_{stage}"] == {"value": q.value, "unit": "deg", "origin": q.origin}
    assert load_geometry(tmp_path / "a/b/geometry.toml") == r.geometry
    assert load_schedules(tmp_path / "a/b/schedules.toml") == r.schedules
    for write, given, name in (
        (schedule_files.write_stroke_tables, (r.table,), "stroke_tables"),
        (schedule_files.write_vane_angles, (stroke_tables.vane_angle_table(r.geometry), r.geometry), "vane_angles"),
    ):
        write(*given, tmp_path / "one.toml", r.origin)  # type: ignore[operator]
        assert (tmp_path / "one.toml").read_text() == (tmp_path / "a/b" / f"{name}.toml").read_text()
    schedule_files.write_geometry(r.geometry, tmp_path / "one.toml")
    assert (tmp_path / "one.toml").read_text().startswith("# Linkage of the vane rows.\n\n[crank]\n")
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"file/x: cannot be made \(Not a directory\)$"):
        schedule_files.write_tables(r, tmp_path / "file" / "x")
    measured = replace(r, loops={"vigv": loop_as_measured("vigv", model(0))}, log="l.csv")
    told = schedule_files.result_json(measured)
    assert (told["schema"], told["log"], told["origin"]) == (1, "l.csv", r.origin)
    assert schedule_files.result_json(r)["log"] is None and schedule_files.result_json(r)["loops"] == {}
    assert {k: list(v) for k, v in told["table"].items()} == dict(
        zip(("speed", "extension", "retraction", "single"), map(list, r.table), strict=True)
    )
    for k, (stage, link) in enumerate(zip(told["stages"], r.links, strict=True)):
        assert stage["target"].tolist() == r.target[:, k].tolist() and stage["at_100"] == link.at_design
        assert (stage["rms"], stage["max_abs"], stage["error"] is link.error) == (link.rms, link.largest, True)
        assert [stage[n] for n in ("stage", "lb", "lc")] == [link.stage, link.lb, link.lc]
        assert stage["unit"] == {"length": "mm", "error": "deg"}
    assert told["loops"]["vigv"] == {
        "width": 1.0, "width_sigma": 0.01, "offset": 0.1, "lb": 50.0, "lc": 495.0, "misfit": 0.02, "noise": 0.03,
        "drift": None, "lag": 0.004, "extension_covered": (1.0, 47.0), "retraction_covered": (2.0, 46.0),
    }  # fmt: skip


# ---- clearances and space --------------------------------------------------------------------------------------------


def test_a_study_of_clearances_says_what_each_joint_makes(monkeypatch: pytest.MonkeyPatch) -> None:
    """The widths of the mechanism in space are linear in what the joints have here: 2, 3, ... deg for 1 mm."""
    worth = dict(zip(clearance.WORDS, (2.0, 3.0, 4.0, 5.0, 6.0, 7.0), strict=True))
    fits = Clearances(**clearance.FITS)

    def width(geometry: Any, stage: str, c: Clearances, vane: float = -90.0) -> float:
        return sum(w * getattr(c, j) for j, w in worth.items()) * (1.0 + 1e-3 * (vane + 90.0))

    def needed(geometry: Any, stage: str, wanted: float, c: Clearances, joint: str, vane: float) -> float:
        got = (wanted - width(geometry, stage, replace(c, **{joint: 0.0}), vane)) / worth[joint]
        if got > 0.25:
            raise InputError("more than 0.25 mm")
        return got

    loop = (np.full(49, 10.0), np.full(49, 12.0))
    monkeypatch.setattr(clearance, "clearance_width", width)
    monkeypatch.setattr(clearance, "clearance_for", needed)
    monkeypatch.setattr(clearance, "clearance_loop", lambda g, s, x, c, v: loop)
    monkeypatch.setattr(clearance, "contributions", lambda g, s, c, v: {j: w * getattr(c, j) for j, w in worth.items()})
    monkeypatch.setattr(
        clearance, "freedoms", lambda g, s, x, v: {"up": 24.0 - x + (x == 48.0) * -2.0, "along": 0.1 * x}
    )
    s = clearance.clearance_study(GEOMETRY, "vgv1", 1.3, fits)
    fixed = sum(worth[j] * v for j, v in clearance.FITS.items())
    assert s.clearances == replace(fits, ring=pytest.approx((1.3 - fixed) / 6.0)) and s.made == pytest.approx(1.3)
    assert (s.stage, s.width) == ("vgv1", 1.3) and s.per_mm == pytest.approx(worth)
    assert s.alone == pytest.approx({j: 1.3 / w if 1.3 / w <= 0.25 else None for j, w in worth.items()})
    assert s.parts["ring"] == pytest.approx(1.3 - fixed) and s.freedoms == {"up": -26.0, "along": pytest.approx(4.8)}
    assert s.stroke.tolist() == list(range(49)) and (s.extension is loop[0]) and (s.retraction is loop[1])
    ratio, mean = GEOMETRY.vgv1.l.value / GEOMETRY.vgv1.ld_prime.value, math.radians(11.0)
    np.testing.assert_allclose(s.play, 0.65 * (1.0 + (ratio * math.sin(mean)) ** 2) / math.cos(mean))
    np.testing.assert_allclose(s.around, np.arange(-180.0, 181.0, 15.0))
    np.testing.assert_allclose(s.width_around, 1.3 * (1.0 + 1e-3 * (s.around + 90.0)))
    given = clearance.clearance_study(GEOMETRY, "vgv1", 1.3, fits, vane=-80.0, ring=0.02)
    assert given.clearances == replace(fits, ring=0.02) and given.made == pytest.approx((fixed + 0.12) * 1.01)
    rows = clearance.study_rows([s, given])
    assert [row[0] for row in rows] == list(clearance.WORDS.values())
    assert rows[0] == ["actuator, both ends", "0.100", "0.200", "-", "0.100", "0.200", "-"]
    assert rows[5][:4] == ["lever arm's end", "0.030", "0.210", f"{1.3 / 7:.2f}"]
    with pytest.raises(InputError):
        clearance.clearance_study(GEOMETRY, "vgv1", 1.3, replace(fits, actuator=-0.1))


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


@pytest.mark.parametrize(("stage", "offset", "vane"), [("vigv", 0.0, 90.0), ("vgv2", 12.0, 90.0), ("vgv1", 0.0, -40.0)])
def test_the_multibody_system_is_the_mechanism_in_space(stage: str, offset: float, vane: float) -> None:
    pytest.importorskip("exudyn")
    x = np.array([0.0, 20.0, 48.0])
    got = multibody_angles(GEOMETRY, stage, x, offset, vane)
    # the ring turns about its centre, so that every vane of it has the same angle
    np.testing.assert_allclose(got, spatial_angles(GEOMETRY, stage, x, offset), atol=1e-7)


def test_a_multibody_system_that_does_not_close_is_named_with_its_stroke() -> None:
    pytest.importorskip("exudyn")
    with pytest.raises(InputError, match=r"^vigv: the multibody system does not close at stroke \d+(\.\d+)? mm$"):
        multibody_angles(GEOMETRY, "vigv", np.array([24.0, 400.0]))


def test_a_check_in_space_closes_every_stage_by_each_way(monkeypatch: pytest.MonkeyPatch) -> None:
    asked, done = [], []

    def bodies(geometry: Any, stage: str, stroke: Any, offset: float) -> Any:
        asked.append((stage, stroke.tolist(), offset))
        return stroke + 1.0

    monkeypatch.setattr(spatial, "multibody_angles", bodies)
    monkeypatch.setattr(spatial, "is_there", lambda name: name == "exudyn")
    check = spatial.spatial_check(GEOMETRY, 3.0, 2, done.append)
    assert asked == [(stage, [0.0, 48.0], 3.0) for stage in GEOMETRY.vanes] and check.notes == []
    assert done == pytest.approx([1 / 3, 2 / 3, 1.0]) and check.stroke.tolist() == [0.0, 48.0]
    for k, stage in enumerate(GEOMETRY.vanes):
        np.testing.assert_allclose(check.planar[stage], model(k)(check.stroke))
        np.testing.assert_allclose(check.newton[stage], spatial_angles(GEOMETRY, stage, check.stroke, 3.0))
        assert check.multibody[stage].tolist() == [1.0, 49.0]
    monkeypatch.setattr(spatial, "is_there", lambda name: False)
    alone = spatial.spatial_check(GEOMETRY, points=3, progress=done.append)
    assert alone.multibody == {} and alone.stroke.tolist() == [0.0, 24.0, 48.0] and len(done) == 3
    assert alone.notes == [
        "exudyn is not installed (pip install 'vaneloop[multibody]'): constraint equations by Newton's method only"
    ]
    np.testing.assert_array_equal(alone.newton["vigv"], spatial_angles(GEOMETRY, "vigv", alone.stroke))


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


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_the_first_motion_of_a_run_is_no_reversal(way: float) -> None:
    """Whichever way it goes, and in however many parts the ticks come."""
    recorder: Any = object.__new__(st._Recorder)
    recorder.kept, recorder.x, recorder.current, recorder.rows = [0], 0, 1, []
    recorder.total, recorder.start, recorder.square, recorder.ticks = np.zeros(2), np.full(3, np.nan), 0.0, 0
    x = 0.02 + way * 1e-3 * np.r_[np.linspace(0.0, 5.0, 40), np.linspace(5.0, 2.0, 40)]
    for part in np.split(np.column_stack([x, np.full(80, 2.0)]), 4):
        recorder(part)
    assert recorder.total[1] == 1.0 and recorder.total[0] == pytest.approx(5e-3)
    assert (recorder.square, recorder.ticks) == (320.0, 80) and [len(r) for r in recorder.rows] == [2] * 4


def test_errors_near_full_speed_are_those_between_99_and_100() -> None:
    f = st._figures(np.array([1.0, -3.0, 0.5, -0.7]), np.array([50.0, 99.0, 99.5, 100.0]))
    assert f == pytest.approx({"mean_abs": 1.3, "max_abs": 3.0, "mean_abs_99_100": 0.5})
    assert st._figures(np.ones(2), np.array([99.0, 100.0]))["mean_abs_99_100"] is None


def test_a_run_is_made_of_the_states_of_every_tick(monkeypatch: pytest.MonkeyPatch) -> None:
    plant, cal = build_plant(), load_calibration()
    names = st.snapshot_names(plant)
    last = len(names) - 1 - names[::-1].index("n_r")
    rng = np.random.default_rng(5)
    states = rng.uniform(-1.0, 1.0, (4000, len(names)))
    states[:, last] = np.linspace(95.0, 100.5, 4000)
    rings = [names.index(f"ring_{v}") for v in plant.vanes]
    states[:, rings] *= 0.1
    x, i, x_dem = (names.index(n) for n in ("x", "i_cmd", "x_dem"))
    states[:, x] = 0.024 + 0.01 * np.sin(np.arange(4000) * 1e-3)
    states[:, x_dem] = 0.024 + 0.02 * states[:, x_dem]
    asked: dict[str, Any] = {}

    def lockstep(stimulus: Any, watch: Any, **more: Any) -> Any:
        asked.update(more, stimulus=stimulus)
        for part in (states[:1500], states[1500:]):
            watch(part)
        return SimpleNamespace(faults=5)

    monkeypatch.setattr(st, "lockstep", lockstep)
    n_dem, pots = np.linspace(95.0, 100.5, 400), np.ones((400, 6))
    out = st.run(st.Scenario("s", noise=2.0, dither=0.1), n_dem, cal, 7, pots, plant)
    assert (asked["seed"], asked["every"], asked["hashed"], asked["pots"] is pots) == (7, 100, False, True)
    assert asked["calibration"] is cal and (asked["plant"].sigma == 2.0 * plant.sigma).all()
    expected = st.Stimulus.of(st.dithered(n_dem, 0.1), t_oil=st.casing(n_dem))
    for f in fields(expected):
        np.testing.assert_array_equal(getattr(asked["stimulus"], f.name), getattr(expected, f.name))
    every = states[::10]
    np.testing.assert_allclose(out.t, 0.01 * np.arange(400))
    np.testing.assert_array_equal(out.n_r, every[:, last])
    for k in range(3):
        ldp, lever = plant.lever(k)
        np.testing.assert_allclose(np.sin(np.deg2rad(out.vanes[:, k])), ldp * np.tan(every[:, rings[k]]) / lever)
    target = np.rad2deg(plant.schedules.targets(out.n_r))
    np.testing.assert_allclose(out.errors, out.vanes - target)
    offset, width, crossing = (every[:, names.index(n)] for n in ("offset_in_use", "width_in_use", "crossing"))
    np.testing.assert_allclose(out.offset, np.rad2deg(offset))
    np.testing.assert_allclose(out.width, np.rad2deg(width))
    np.testing.assert_array_equal(out.side, crossing)
    np.testing.assert_allclose(out.stroke_demand, 1e3 * every[:, x_dem])
    drive = np.interp(every[:, x_dem], cal.angles[0], cal.angles[1])
    np.testing.assert_allclose(out.aim, np.rad2deg(drive + offset - 0.5 * crossing * (cal.scalars.play[0] + width)))
    assert out.demand_travel == pytest.approx(1e3 * np.abs(np.diff(every[:, x_dem])).sum())
    assert out.current == pytest.approx(1e3 * math.sqrt(np.mean(states[:, i] ** 2)))
    peak, end = 10.0 * math.sin(math.pi / 2), 10.0 * math.sin(3.999)
    assert out.travel == pytest.approx(peak + (peak - end), rel=1e-5) and out.reversals == 1
    assert (out.scenario, out.faults) == ("s", 5) and out.strategy == STRATEGIES[int(cal.scalars.strategy)]
    assert out.figures == {s: st._figures(out.errors[:, k], out.n_r) for k, s in enumerate(plant.vanes)}


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
    three = (rows[0], st.Scenario("more"), rows[1])
    more = {("more", n): outcome("more", n, 0.3) for n in ("dual", "x")}
    assert st.judged(three, {**runs, **more}, [], "x")[0]["goal"].startswith("all: mean VIGV error of dual over")
    near = {
        k: replace(o, figures={"vigv": {**o.figures["vigv"], "mean_abs_99_100": m}})
        for (k, o), m in zip(runs.items(), (0.2, 0.3, 0.4, 0.5), strict=True)
    }
    goal = "nominal: VIGV mean at 99 to 100 % of x (deg), at most dual's"
    assert st.judged(rows[:1], near, [], "x")[-1] == {"goal": goal, "value": 0.3, "limit": 0.2, "held": False}
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
