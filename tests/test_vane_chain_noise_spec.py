"""What a log hides from the vane chain, and how much of an error is noise: each against the noise that was put in."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import scipy

from controller import load_calibration
from controller.records import as_scalars
from hil.figures import noise_floor
from plant import build_plant
from tests.small_logs import white
from vaneloop.identification.least_squares.problem import LeastSquaresProblem
from vaneloop.identification.subsystem import Array, Parameter, Stage, without_jumps
from vaneloop.identification.vane_chain import current, demand
from vaneloop.identification.vane_chain import stationary_noise as module
from vaneloop.identification.vane_chain.current import (
    LOGGED_CURRENT,
    Smooth,
    _bridged,
    _calibrated,
    _demanded,
    _known,
    between_rows,
    law_of,
    other_current,
    servo_law,
    taken,
    without_noise,
)
from vaneloop.identification.vane_chain.demand import _other_noise, demand_stage
from vaneloop.identification.vane_chain.low_pass import AS_LOGGED, LowPass
from vaneloop.identification.vane_chain.resample import last_digit, rms
from vaneloop.identification.vane_chain.servo import servo_stage
from vaneloop.identification.vane_chain.stationary_noise import (
    Expected,
    _alike,
    _draws,
    _expect,
    _over_blocks,
    _power,
    _quietest,
    _said,
    _windows,
    expect_stationary_noise,
    like,
)
from vaneloop.identification.vane_chain.subsystem_data import Driven, Made

CALIBRATION, MACHINE = load_calibration(), build_plant()
GAINS = CALIBRATION.scalars
DT, ROWS, TICK = 0.01, 2000, 1e-3
T = DT * np.arange(ROWS)
NONE = np.zeros(ROWS)


def size(values: Array) -> float:
    """RMS in windows of a second, each with a constant of its own."""
    v = values.reshape(-1, 100)
    return float(np.std(v - v.mean(axis=1, keepdims=True)))


def known_to(noise: float, stroke: Array, rows: int = 25, distortion: Array = NONE, uneven: Array = NONE) -> Smooth:
    return Smooth(stroke, noise, rows, distortion, uneven, NONE)


def columns_of(stroke: Array, x_dem: Array = NONE, **more: Array) -> dict[str, Array]:
    return {"x_dem": x_dem, "x_lvdt": stroke, "missing": NONE, "fresh": np.ones(ROWS), **more}


# ---- the current between rows ----------------------------------------------------------------------------------------


def loop(error: Array, rate: Array | float = 0.0) -> Array:
    """The servo's law, written out: proportional, integral and feed-forward part at every tick."""
    e = error.ravel()
    out = GAINS.kp * e + GAINS.ki * TICK * np.cumsum(e) + GAINS.kff * np.broadcast_to(rate, error.shape).ravel()
    return np.asarray(out.reshape(error.shape))


def test_the_law_runs_on_the_row_s_own_stroke_and_on_the_smooth_one_before_it() -> None:
    smooth, x_dem = 20.0 + 3.0 * np.sin(T), 20.0 + 3.0 * np.sin(T + 0.1)
    logged = smooth + 0.01 * white(1, ROWS)
    missing = NONE.copy()
    missing[500:505] = 1.0
    c = columns_of(logged, x_dem) | {"missing": missing}
    law, *_ = servo_law(T, c, CALIBRATION, known_to(0.01, smooth), {}, draws=1)
    # a row that lacks its sample has the smooth stroke; one in a gap counts nowhere
    x = np.where(missing > 0.0, smooth, logged)
    assert law == pytest.approx(law_of(x_dem, smooth, CALIBRATION, x))
    assert not np.allclose(law, law_of(x_dem, smooth, CALIBRATION, logged))
    behind = LowPass("mean", 0.02)
    filtered, *_ = servo_law(T, c, CALIBRATION, known_to(0.01, smooth), {}, draws=1, behind=behind)
    assert filtered == pytest.approx(law_of(x_dem, smooth, CALIBRATION, x, behind))


def test_the_way_between_two_rows_is_known_as_well_as_a_line_and_a_cubic_agree() -> None:
    """Of a parabola the cubic is the truth; the line is off by a u (1 - u) / 2 at the part u of a row."""
    bend = 4e-4  # mm per row squared
    stroke = 0.5 * bend * (np.arange(ROWS) - 1000.0) ** 2
    _, of_mean, of_some = servo_law(T, columns_of(stroke), CALIBRATION, known_to(0.0, stroke), {}, draws=2, samples=2)
    u = np.arange(1, 11) / 10.0
    off = np.repeat(-0.5 * bend * u[None] * (1.0 - u[None]), ROWS, axis=0)
    off[0] = 0.0
    wanted = loop(off)
    for draw in range(2):
        assert size(of_mean[:, draw] - wanted.mean(axis=1)) < 0.02 * size(wanted.mean(axis=1))
        assert size(of_some[:, draw] - wanted[:, [4, 9]].mean(axis=1)) < 0.02 * size(wanted[:, [4, 9]].mean(axis=1))
    assert np.mean(of_mean - of_some, axis=0) == pytest.approx(np.mean(wanted.mean(axis=1) - wanted[:, [4, 9]].mean(
        axis=1)), rel=0.05)  # fmt: skip


def test_noise_of_nine_ticks_and_the_last_digit_are_what_the_current_is_not_known_to() -> None:
    stroke, sigma, digit = 20.0 + 3.0 * np.sin(T), 0.01, 0.05
    _, of_mean, of_some = servo_law(T, columns_of(stroke), CALIBRATION, known_to(sigma, stroke, 41), {}, draws=4)
    draws = []
    for seed in range(4):
        noise = sigma * white(seed + 10, ROWS, 10)
        noise[:, -1] = 0.0  # at the row it is logged
        draws.append(loop(noise).mean(axis=1))
    # the smoothed stroke is off besides, over 41 rows by a fifth of the noise
    assert [size(d) for d in of_mean.T] == pytest.approx([size(d) for d in draws], rel=0.5)
    assert [size(d) for d in of_some.T] == pytest.approx([size(d) for d in draws], rel=1.0)
    assert len({size(d) for d in of_mean.T}) == 4
    # a digit of the demand: what the law makes of its rounding, the stroke being known
    x_dem = np.round((20.0 + 3.0 * np.sin(3.0 * T)) / digit) * digit
    c = columns_of(stroke, x_dem)
    straight = known_to(0.0, 20.0 + NONE)
    _, of_mean, _ = servo_law(T, c | {"x_lvdt": 20.0 + NONE}, CALIBRATION, straight, {"x_dem": digit}, draws=4)
    drawn = last_digit(x_dem, digit)
    alike = [law_of(drawn(np.random.default_rng(s)), NONE, CALIBRATION).mean(axis=1) for s in range(8)]
    assert np.mean([size(d) for d in of_mean.T]) == pytest.approx(np.mean([size(d) for d in alike]), rel=0.15)
    # a digit of the stroke: the logged one at the row itself, with the other sign of its error
    rounded = np.round((20.0 + 3.0 * np.sin(3.0 * T)) / digit) * digit
    _, of_mean, of_last = servo_law(T, columns_of(rounded), CALIBRATION, known_to(0.0, 20.0 + NONE), {"x_lvdt": digit},
                                    draws=4, samples=1)  # fmt: skip
    quick = np.std(np.diff(of_last, axis=0)) / np.sqrt(2.0)
    assert quick == pytest.approx(GAINS.kp * digit / np.sqrt(12.0), rel=0.25)
    assert np.std(np.diff(of_mean, axis=0)) < 0.6 * np.std(np.diff(of_last, axis=0))


def test_what_smoothing_bends_and_what_is_uneven_are_errors_of_the_stroke() -> None:
    stroke, bent = 20.0 + NONE, 0.02 * np.sin(12.0 * T)
    _, plain, _ = servo_law(T, columns_of(stroke), CALIBRATION, known_to(0.0, stroke), {}, draws=1)
    assert not plain.any()
    _, of_bent, _ = servo_law(T, columns_of(stroke), CALIBRATION, known_to(0.0, stroke, 25, bent), {}, draws=2)
    wanted = loop(np.concatenate([-(law_ticks(bent)[:, :9]), np.zeros((ROWS, 1))], axis=1)).mean(axis=1)
    assert min(size(of_bent[:, 0] + sign * wanted) for sign in (1.0, -1.0)) < 0.05 * size(wanted)  # either is as likely
    assert np.array_equal(of_bent[:, 0], of_bent[:, 1])
    smooth = known_to(0.3, stroke, 25, NONE, np.full(ROWS, 0.4))
    digit = 0.2 * np.sign(np.sin(2.0 * T))
    assert smooth.white(digit) == pytest.approx(np.sqrt(0.09 - np.mean(digit**2)))
    assert smooth.white(2.0 * digit) == 0.0  # rounding makes all of it
    left = np.array([smooth.left(np.random.default_rng(s), NONE) for s in range(8)])
    through = np.array([smooth.smoothed(0.3 * white(s + 50, ROWS)) for s in range(8)])
    assert np.std(left) == pytest.approx(np.hypot(0.4, np.std(through)), rel=0.05)
    only = known_to(0.0, stroke, 25)
    assert only.left(np.random.default_rng(0), digit) == pytest.approx(only.smoothed(digit))


def law_ticks(x: Array) -> Array:
    """A smooth signal at the ten ticks up to each row."""
    return np.interp(np.arange(-9, 1)[None] / 10.0 + np.arange(len(x))[:, None], np.arange(len(x)), x)


def test_a_demand_runs_straight_a_row_late_and_its_first_tick_is_at_once() -> None:
    x_dem = np.cumsum(white(3, 50))
    ramp, rate = _demanded(x_dem, AS_LOGGED)
    before, two = x_dem[:-1], np.concatenate([x_dem[:1], x_dem[:-2]])
    for k in range(9):  # ticks 2 to 10 of the ramp that ends a row before
        assert ramp[1:, k] == pytest.approx(two + (before - two) * (k + 2) / 10.0)
        assert rate[1:, k] == pytest.approx((before - two) / DT)
    assert ramp[1:, 9] == pytest.approx(before + 0.1 * (x_dem[1:] - before))
    assert rate[1:, 9] == pytest.approx((x_dem[1:] - before) / DT) and not rate[0].any()
    assert ramp[0] == pytest.approx(x_dem[0])
    low = LowPass("first order", 0.01)
    assert _demanded(x_dem, low)[0] == pytest.approx(low.of(ramp)) and _demanded(x_dem, low)[1] == pytest.approx(
        low.of(rate)
    )


def test_ways_of_a_logger_to_take_a_current() -> None:
    ticks = white(1, 30, 10)
    ways = taken(ticks, 2)
    assert list(ways) == ["", "the current at single ticks", "the mean of the ten ticks before the row"]
    assert ways[""] == pytest.approx(ticks.mean(axis=1)) and list(taken(ticks, 10)) == [list(ways)[0], list(ways)[2]]
    before = np.concatenate([ticks.ravel()[9:-1]])[: 29 * 10].reshape(29, 10).mean(axis=1)
    assert list(ways.values())[2][1:] == pytest.approx(before)


def test_rows_without_their_sample_are_bridged_and_those_of_a_gap_are_not() -> None:
    missing, fresh = np.array([0.0, 1, 1, 0, 1, 0]), np.array([1.0, 1, 1, 1, 0, 1])
    known = _known({"missing": missing, "fresh": fresh})
    assert known.tolist() == [True, False, False, True, True, True]
    v = np.array([3.0, 70, 80, 9, 5, 1])
    assert _bridged(v, known).tolist() == [3.0, 5.0, 7.0, 9.0, 5.0, 1.0]
    none = np.zeros(6, dtype=bool)
    assert _bridged(v, none) is v and _bridged(v, ~none) is v


def test_in_the_limit_and_out_of_run_the_current_is_the_row_s_mean() -> None:
    law = np.cumsum(white(5, ROWS * 10)).reshape(ROWS, 10) * 0.01
    limit = 0.9e3 * GAINS.current_limit
    c = {"i_cmd": law.mean(axis=1).copy(), "missing": NONE, "fresh": np.ones(ROWS)}
    c["i_cmd"][[700, 701]] = limit, 1.0001 * limit
    for seed in (0, 1):
        ticks = between_rows(c, law, 0.2, np.ones(ROWS, dtype=bool), CALIBRATION, None, seed)
        assert np.ptp(ticks[700]) > 0.0 == np.ptp(ticks[701])
        assert ticks.mean(axis=1) == pytest.approx(c["i_cmd"])
    # what changes from row to row is the recorder's; not so what changes slowly, and a row at the limit tells nothing
    c["i_cmd"][700] = law[700].mean()
    c["i_cmd"] += 0.2 * white(6, ROWS) + 5.0 * np.sin(0.02 * np.arange(ROWS))
    errors = NONE[:, None], NONE[:, None]
    none = between_rows(c, law, 0.5, np.ones(ROWS, dtype=bool), CALIBRATION, errors, 1).mean(axis=1) - c["i_cmd"]
    assert np.std(none[:700]) == pytest.approx(0.2, rel=0.1)


def test_a_stroke_that_jumps_is_taken_as_logged_and_a_fast_swing_as_bent() -> None:
    """A piston that follows its current, but for a jump and for a swing of three times the smoothing's length."""
    sigma = 2e-3
    i, swing = 6.0 * np.sin(0.8 * T), np.where((T > 12.0) & (T < 16.0), 0.02 * np.sin(2.0 * np.pi * T / 0.12), 0.0)
    c = {"i_cmd": i, "n_r": 70.0 + NONE, "p_s": 21.0 + NONE, "t_oil": 40.0 + NONE, "missing": NONE,
         "fresh": np.ones(ROWS)}  # fmt: skip
    moves = without_noise(T, c | {"x_lvdt": 20.0 + np.cumsum(i) * 2e-3}, MACHINE).stroke
    jump = 0.4 * (T >= 8.0)
    noisy = moves + jump + swing + sigma * white(4, ROWS)
    out = without_noise(T, c | {"x_lvdt": noisy}, MACHINE)
    assert out.noise == pytest.approx(sigma, rel=0.1)
    e = out.stroke - moves - jump - swing
    quiet, jumped, swings = (T > 2.0) & (T < 7.0), np.abs(T - 8.0) < 0.02, (T > 13.0) & (T < 15.0)
    assert np.std(e[quiet]) < 0.55 * sigma and np.abs(e[jumped]).max() < 5.0 * sigma
    assert np.array_equal(out.stroke[jumped], noisy[jumped])  # rather noisy than wrong
    # what smoothing takes off the swing is said to be its distortion there, and none elsewhere
    bent = np.hypot(np.std(e[swings]), 0.0)
    assert np.std(out.distortion[swings]) == pytest.approx(bent, rel=0.5)
    assert np.std(out.distortion[quiet]) < 0.3 * sigma and np.all(out.uneven >= 0.0)
    assert np.sqrt(np.mean(out.uneven[quiet] ** 2)) < 0.5 * sigma
    gap = np.ones(ROWS)
    gap[1000:1020] = 0.0  # over a gap the model goes where the stroke went
    far = noisy + 3.0 * (np.arange(ROWS) >= 1010)
    over = without_noise(T, c | {"x_lvdt": far, "fresh": gap}, MACHINE)
    assert np.std((over.stroke - far + sigma * white(4, ROWS))[1650:1950]) < 0.55 * sigma
    assert over.noise == pytest.approx(sigma, rel=0.1)


def servo(law_error: Array, e: Array) -> Stage:
    c = {"law": np.zeros((ROWS, 10)), "law_error": law_error, "i_cmd": e, "missing": NONE}
    return servo_stage(Driven(T, c, MACHINE, CALIBRATION, ("i_cmd",), np.ones(ROWS, dtype=bool), ()))


def test_two_estimates_of_one_noise_are_one_noise_and_what_is_slower_is_the_raster_s() -> None:
    slow = 0.4 * np.sin(2.0 * np.pi * T / 0.8)[:, None]
    quick = 0.1 * white(1, ROWS, 6)
    whole = servo(quick + slow, quick[:, 0] + slow[:, 0])
    drawn = np.mean([noise_floor(T, h) for h in (quick + slow).T])
    hidden = np.sqrt(np.mean([rms(whole, h[None]) ** 2 for h in (quick + slow).T]))
    assert whole.raster_error == pytest.approx([np.sqrt(hidden**2 - drawn**2)], rel=0.06)
    assert whole.lost is not None and np.array_equal(whole.lost[:, 0], (quick + slow).T)
    # a stage that shows more noise than was drawn: only what was drawn is taken for it
    loud = servo(quick + slow, 0.5 * white(2, ROWS))
    assert loud.raster_error == pytest.approx([np.sqrt(hidden**2 - drawn**2)], rel=0.02)
    calm = servo(quick + slow, 0.05 * white(2, ROWS))  # and one that shows less: no more than it shows
    assert calm.raster_error == pytest.approx([np.sqrt(hidden**2 - 0.05**2)], rel=0.02)
    again = servo_stage(whole.made.driven._replace(again=True))  # type: ignore[attr-defined]
    assert again.raster_error is None and again.lost is not None


def test_a_servo_does_not_count_about_its_limit_and_where_samples_are_missing() -> None:
    e = 0.1 * white(1, ROWS)
    e[550] = 0.9e3 * GAINS.current_limit
    missing = NONE.copy()
    missing[1000] = 1.0
    c = {"law": np.zeros((ROWS, 10)), "law_error": 0.1 * white(1, ROWS, 2), "i_cmd": e, "missing": missing}
    stage = servo_stage(Driven(T, c, MACHINE, CALIBRATION, ("i_cmd",), np.ones(ROWS, dtype=bool), ()))
    lost = np.flatnonzero(~np.isfinite(stage.measured[0])).tolist()
    assert lost == [*range(500, 600), *range(996, 1005)]  # the window of the limit; four rows to either side


# ---- the demand ------------------------------------------------------------------------------------------------------


def demands(**scaled: float) -> Any:
    """The firmware's tables with other scalars."""
    k = CALIBRATION.k.copy()
    scalars = as_scalars(k)
    for name, by in scaled.items():
        setattr(scalars, name, getattr(scalars, name) * by)
    return CALIBRATION._replace(k=k)


def demand_of(calibration: Any = CALIBRATION, **more: Any) -> Stage:
    n_dem = np.interp(T, [0, 3, 4, 5, 6, 9, 12, 14, 20], [70, 70, 71, 70.5, 72, 80, 79, 76, 76.5])
    n_r = n_dem[0] + np.convolve(np.concatenate([np.zeros(60), n_dem - n_dem[0]]), np.ones(61) / 61.0)[60 : 60 + ROWS]
    c = {"n_dem": n_dem, "n_r": n_r, "x_dem": NONE, "missing": NONE, "spell": np.zeros(ROWS, dtype=int)}
    columns = more.pop("columns", {})
    driven = Driven(T, c | columns, MACHINE, calibration, ("x_dem",), np.ones(ROWS, dtype=bool), (), again=True)
    return demand_stage(driven._replace(**more))


def test_thresholds_of_the_trend_off_by_a_factor_are_those_of_a_firmware_with_other_numbers() -> None:
    stage = demand_of()
    theta = np.repeat(stage.neutral()[None], 3, axis=0)
    at = stage.index()["trend_threshold_error"]
    theta[1, at], theta[2, at] = 0.3, 4.0
    as_is, less, more = stage.run(theta)[:, 0]
    for factor, found in ((0.3, less), (4.0, more)):
        other = demand_of(demands(trend_rate_on=factor, trend_change=factor))
        assert found == pytest.approx(other.run(other.neutral()[None])[0, 0], abs=1e-9)
    assert np.abs(as_is - more).max() > 0.1 and np.abs(less - more).max() > 0.1
    assert demand_of(CALIBRATION).run(theta[:1])[0, 0] == pytest.approx(as_is)  # the tables are as they were


def test_a_log_begins_on_the_curve_that_its_demand_stands_on() -> None:
    first = demand_of().run(demand_of().neutral()[None])[0, 0]
    table = CALIBRATION.table
    n = demand_of().made.driven.columns["n_r"][0]  # type: ignore[attr-defined]
    curves = [1e3 * float(np.interp(n, table[0], table[row])) for row in (1, 2)]
    begun = []
    for curve in curves:
        stage = demand_of(columns={"x_dem": curve + NONE})
        begun.append(stage.run(stage.neutral()[None])[0, 0, 0])
    assert sorted(begun) == pytest.approx(sorted(curves), abs=0.02) and abs(curves[0] - curves[1]) > 0.05
    assert begun[0] == pytest.approx(curves[0], abs=0.02) and min(abs(first[0] - c) for c in curves) < 0.02


@pytest.mark.parametrize("row", [600, 1300])
def test_behind_a_gap_the_direction_is_the_one_that_fits(row: int) -> None:
    """Rising at 6 s and falling at 13 s; the curves of the two directions are 1.5 mm apart."""
    whole = demand_of()
    neutral = whole.neutral()[None]
    truth = whole.run(neutral)[0, 0]
    n, table = whole.made.driven.columns["n_r"][row], CALIBRATION.table  # type: ignore[attr-defined]
    seen = truth.copy()  # one reading on either curve: the others tell
    seen[row] = max((1e3 * float(np.interp(n, table[0], table[k])) for k in (1, 2)), key=lambda x: abs(x - truth[row]))
    assert abs(seen[row] - truth[row]) > 1.0
    stage = demand_of(columns={"spell": (np.arange(ROWS) >= row).astype(int), "x_dem": seen})
    counts = np.isfinite(stage.measured[0])
    assert np.abs(stage.run(neutral)[0, 0] - truth)[counts].max() < 0.2 and counts[row:].mean() > 0.8


def test_noise_of_a_channel_is_its_last_digit_s_and_what_is_white_besides() -> None:
    t = DT * np.arange(20_000)
    smooth, step, sigma = 5.0 * np.sin(0.5 * t), 0.3, 0.25
    noisy = smooth + sigma * white(7, len(t))
    rounded = np.round(noisy / step) * step
    draws = np.array([_other_noise(t, rounded, step)(np.random.default_rng(s)) for s in range(3)])
    assert np.std(draws) == pytest.approx(np.sqrt(sigma**2 + step**2 / 12.0), rel=0.03)
    assert np.std(_other_noise(t, noisy, 0.0)(np.random.default_rng(1))) == pytest.approx(sigma, rel=0.03)


# ---- noise that is the same under every condition --------------------------------------------------------------------


def plain_stage(measured: Array, window: float | None = None, made: Any = None, name: str = "s") -> Stage:
    outputs = tuple(f"y{k}" for k in range(len(measured)))
    n = measured.shape[1]
    stage = Stage(name, outputs, ("mm",) * len(outputs), (), (), lambda p: np.zeros((len(p), len(outputs), n)),
                  DT * np.arange(n), measured, window=window)  # fmt: skip
    stage.made = made
    return stage


def test_windows_have_no_gap_and_are_of_the_time_asked_for() -> None:
    values = np.arange(1050.0)
    stage = plain_stage(values[None])
    assert _windows(stage, values, 2.0).tolist() == values[:1000].reshape(5, 200).tolist()
    assert _windows(stage, values, None).shape == (2, 400)  # 4 s
    assert _windows(stage, values, 0.01).shape == (131, 8)
    values[250] = np.nan
    assert _windows(stage, values, 2.0)[:, 0].tolist() == [0.0, 400.0, 600.0, 800.0]
    assert _windows(stage, np.full(1050, np.nan), 2.0).shape == (0, 200)


def test_the_quietest_tenth_of_windows_is_seen_beside_its_trend() -> None:
    rng = np.random.default_rng(1)
    sizes = np.arange(1.0, 41.0)
    rng.shuffle(sizes)
    windows = sizes[:, None] * white(2, 40, 500) + 50.0 + np.linspace(-30.0, 30.0, 500) * white(3, 40, 1)
    quiet = _quietest(windows)
    assert quiet.shape == (4, 500) and np.std(quiet, axis=1) == pytest.approx([1.0, 2.0, 3.0, 4.0], rel=0.15)
    assert np.abs(quiet.mean(axis=1)).max() < 1e-9
    assert np.abs(quiet @ np.linspace(-1.0, 1.0, 500)).max() < 1e-6
    assert len(_quietest(windows[:3])) == 1 and len(_quietest(windows[:0])) == 0
    by = np.where(np.arange(40)[:, None] % 10 == 7, 2.0, np.arange(500.0))  # the demand rests in four of them
    np.testing.assert_allclose(np.std(_quietest(windows, by), axis=1), sizes[7::10], rtol=0.15)
    assert _power(np.array([[3.0, -1.0]])) == 5.0 and _power(windows[:0]) == np.inf


def test_drawn_noise_has_a_line_where_the_windows_have_it_and_each_draw_its_own_phase() -> None:
    windows = np.sin(2.0 * np.pi * np.arange(400) / 20.0 + white(1, 50, 1) * 9.0) + 0.01 * white(2, 50, 400)
    one, two = (like(windows, 5000, seed) for seed in (1, 2))
    spectrum = np.abs(np.fft.rfft(one)) ** 2
    assert abs(np.argmax(spectrum) / 5000.0 - 1.0 / 20.0) < 0.01
    assert np.sqrt(np.mean([np.var(like(windows, 5000, s)) for s in range(20)])) == pytest.approx(0.5**0.5, rel=0.15)
    assert abs(np.corrcoef(one, two)[0, 1]) < 0.3 and np.array_equal(one, like(windows, 5000, 1))
    odd = like(windows, 4999, 1)
    assert len(odd) in (4998, 4999) and len(one) == 5000


def driven_stage(columns: dict[str, Array], gain: float = 3.0, name: str = "actuator") -> Stage:
    """An output that is a channel that drives it times a gain."""

    def make(driven: Driven) -> Stage:
        c = driven.columns
        value = c["x_lvdt"] + c.get("stroke", 0.0)
        value = value + (c["ticks"].mean(axis=1) if "ticks" in c else 0.0)
        value = value + (c["law"].sum(axis=1) if "law" in c else 0.0)
        n = len(value)
        stage = Stage(name, ("y",), ("mm",), (), (), lambda p: np.repeat(gain * value[None, None], len(p), 0), driven.t,
                      np.zeros((1, n)))  # fmt: skip
        stage.made = Made(make, driven)
        return stage

    return make(Driven(T, columns, MACHINE, CALIBRATION, ("y",), np.ones(ROWS, dtype=bool), ()))


def test_draws_of_a_channel_s_noise_go_into_all_columns_that_hold_it() -> None:
    seen = 0.2 * white(1, 20, 400)
    noise = [like(seen, ROWS, seed) for seed in range(4)]
    for columns, by in (
        ({"x_lvdt": T}, 3.0), ({"x_lvdt": T, "stroke": T}, 6.0), ({"x_lvdt": T, "ticks": np.zeros((ROWS, 10))}, 3.0)
    ):  # fmt: skip
        out = _draws(driven_stage(columns), "x_lvdt", seen)
        assert out is not None and out.shape == (4, 1, ROWS)
        assert out[:, 0] == pytest.approx(by * np.array(noise), abs=1e-9)
    of_current = _draws(driven_stage({"x_lvdt": T, "i_cmd": T, "ticks": np.zeros((ROWS, 10))}), "i_cmd", seen)
    assert of_current is not None and of_current[:, 0] == pytest.approx(3.0 * np.array(noise), abs=1e-9)
    assert _draws(driven_stage({"x_lvdt": T}), "x_lvdt", 0.0 * seen) is None
    assert _draws(driven_stage({"x_lvdt": T}), "x_lvdt", seen[:0]) is None
    # in the servo the law makes a current of it, in as many of the last ticks as the column has
    servo_s = _draws(driven_stage({"x_lvdt": NONE, "law": np.zeros((ROWS, 10))}, 1.0, "servo"), "x_lvdt", seen)
    assert servo_s is not None
    for drawn, one in zip(servo_s[:, 0], noise, strict=True):
        assert drawn == pytest.approx(one + law_of(NONE, one, CALIBRATION).sum(axis=1), abs=1e-9)


def test_an_expected_noise_lifts_the_floor_to_its_size_and_shares_the_draws() -> None:
    for before, hidden in ((None, 1.0), (0.5, 0.25)):
        stage = plain_stage(np.zeros((2, 400)))
        stage.floor, stage.noise = np.array([1.0, 2.0]), lambda when, error: 0.7
        stage.raster_error = None if before is None else np.full(2, before)
        lost = white(1, 2, 2, 400)
        stage.lost = None if before is None else lost
        draws = white(2, 3, 2, 400)
        _expect(stage, [Expected(1.5, 0.49, True, hidden), Expected(1.9, 0.0, True, hidden)], draws)
        more = np.sqrt(np.maximum(np.array([1.5, 1.9]) ** 2 - np.array([1.0, 2.0]) ** 2, 0.0))
        assert stage.raster_error == pytest.approx(np.hypot(before or 0.0, more))
        assert stage.floor == pytest.approx(np.hypot(0.7, stage.raster_error))
        own = np.zeros((3, 2, 400)) if before is None else np.sqrt(hidden) * lost[[0, 1, 0]]
        assert stage.lost == pytest.approx(own + np.array([0.7, 0.0])[:, None] * draws)
    none = plain_stage(np.zeros((1, 400)))
    none.floor, none.noise = np.array([1.0]), lambda when, error: 1.0
    _expect(none, [Expected(2.0, 0.0)], None)
    assert none.lost is None and none.floor == pytest.approx([np.hypot(1.0, np.sqrt(3.0))])


def test_noise_is_said_where_it_would_fail() -> None:
    stage = plain_stage(np.zeros((3, 100)), name="linkage")
    found = [Expected(1.2, 0.0), Expected(1.05, 0.0), Expected(0.0345, 0.5)]
    (said,) = _said(stage, found, np.array([1.0, 1.0, 0.02]))
    assert said == (
        "linkage: noise beyond what changes from row to row, the same under every condition: y0 1.2 mm (1.2 times), "
        "y2 0.0345 mm (1.73 times)"
    )
    assert _said(stage, [Expected(1.1, 0.0)] * 3, np.ones(3)) == []


def test_noise_of_a_channel_is_handed_on_to_the_subsystem_that_it_drives(monkeypatch: pytest.MonkeyPatch) -> None:
    """What drives a subsystem is asked first: what it leaves, once that is noise, is what its channel passes on."""
    asked = []

    def draws(stage: Stage, channel: str, windows: Array) -> None:
        asked.append((stage.name, channel, float(np.std(windows))))

    monkeypatch.setattr(module, "_draws", draws)
    monkeypatch.setattr(module, "_noise_in", lambda judge, k, e, *rest: Expected(float(np.std(e)), 0.0))
    stages = []
    for name, output, columns, floor in (
        ("linkage", "vigv", {"x_lvdt": T, "vigv": NONE}, 0.1),
        ("actuator", "x_lvdt", {"i_cmd": 5.0 * np.sin(T) + 0.03 * white(4, ROWS), "x_lvdt": T}, 0.1),
    ):
        made = Made(lambda driven: stage, SimpleNamespace(columns=columns))  # type: ignore[arg-type]  # noqa: B023
        measured = {"vigv": 0.5, "x_lvdt": 0.3}[output] * white(9, 1, ROWS)
        stage = Stage(name, (output,), ("mm",), (), (), lambda p: np.zeros((len(p), 1, ROWS)), T, measured)
        stage.made, stage.floor, stage.noise = made, np.array([floor]), lambda when, error: 0.1
        stages.append(stage)
    notes = expect_stationary_noise(stages)
    (first, through, of_current), (second, stroke, left) = asked
    assert (first, through, second, stroke) == ("actuator", "i_cmd", "linkage", "x_lvdt")
    assert of_current == pytest.approx(0.03, rel=0.25)  # where it is quietest
    assert left == pytest.approx(0.3, rel=0.05)  # what the actuator leaves
    assert [n.split(":")[0] for n in notes] == ["actuator", "linkage"]
    assert [float(s.floor[0]) for s in stages] == pytest.approx([np.hypot(0.1, np.sqrt(0.25 - 0.01)),
                                                                np.hypot(0.1, np.sqrt(0.09 - 0.01))], rel=0.05)  # type: ignore[index]  # fmt: skip


def test_an_error_that_parameters_would_take_or_that_is_at_its_floor_is_expected_as_it_was() -> None:
    def with_parameters(of: float) -> Stage:
        slope = np.sin(T)[None, None]
        p = (Parameter("a", 0.0, "mm", tolerance=0.01),)
        measured = 0.3 * white(1, 1, ROWS) + of * slope[0]
        stage = Stage("actuator", ("y",), ("mm",), p, (), lambda th: th[:, :, None] * slope, T, measured, memory=2.0)
        stage.regimes = {"time": T, "speed": np.cos(T)}
        stage.made = Made(lambda d: stage, SimpleNamespace(columns={"y": measured[0]}))  # type: ignore[arg-type]
        stage.floor, stage.noise = np.array([0.29]), lambda when, error: 0.29
        return stage

    taken_by = with_parameters(0.6)
    assert expect_stationary_noise([taken_by]) == [] and taken_by.floor == pytest.approx([0.29])
    at_floor = with_parameters(0.0)
    at_floor.floor = np.array([np.sqrt(np.mean(at_floor.measured**2)) / 1.005])
    before = at_floor.floor.copy()
    assert expect_stationary_noise([at_floor]) == [] and np.array_equal(at_floor.floor, before)
    judge = LeastSquaresProblem(at_floor, before)
    assert judge.mean_squares(judge.errors(at_floor.neutral()[None])[0]) < 1.02
    assert expect_stationary_noise([replace(at_floor, floor=None)]) == []


def test_a_current_that_is_worked_out_is_kept_as_logged_beside() -> None:
    law = 3.0 * white(3, 600, 10) + 5.0
    c = {"i_cmd": law[:, -1] + 0.05 * white(4, 600), "missing": np.zeros(600)}
    logged = c["i_cmd"]
    assert other_current(DT * np.arange(600), c, law, np.ones(600, dtype=bool), CALIBRATION, 1)
    assert c[LOGGED_CURRENT] is logged and c["i_cmd"] == pytest.approx(law.mean(axis=1) + logged - law[:, -1])
    # rows that do not count say nothing: at the limit, out of mode RUN, without a sample
    for spoiled in ("run", "missing", "limit"):
        other = {"i_cmd": law.mean(axis=1) + 0.05 * white(4, 600), "missing": np.zeros(600)}
        run, half = np.ones(600, dtype=bool), np.arange(600) % 100 < 40
        other["i_cmd"][half] = law[half, -1]
        if spoiled == "run":
            run[half] = False
        elif spoiled == "missing":
            other["missing"][half] = 1.0
        else:
            other["i_cmd"][half] = 1e3
        assert other_current(DT * np.arange(600), other, law, run, CALIBRATION, 1) == "", spoiled
        assert LOGGED_CURRENT not in other


def test_the_integral_s_constant_is_a_mean_over_as_many_rows_as_the_stroke_is_smoothed_over_at_most() -> None:
    off = 0.3 * white(6, ROWS)
    law = np.zeros((ROWS, 10))
    c = {"i_cmd": off, "missing": NONE, "fresh": np.ones(ROWS)}
    ticks = between_rows(c, law, 0.0, np.ones(ROWS, dtype=bool), CALIBRATION, None, 0)
    assert ticks[100:-100, -1] == pytest.approx(np.convolve(off, np.ones(41) / 41.0, "same")[100:-100])
    assert ticks.mean(axis=1) == pytest.approx(off)


def test_a_logger_s_single_sample_is_the_tick_at_the_row() -> None:
    stroke = 20.0 + 3.0 * np.sin(T)
    usual = servo_law(T, columns_of(stroke), CALIBRATION, known_to(0.01, stroke), {}, draws=2)
    one = servo_law(T, columns_of(stroke), CALIBRATION, known_to(0.01, stroke), {}, draws=2, samples=1)
    two = servo_law(T, columns_of(stroke), CALIBRATION, known_to(0.01, stroke), {}, draws=2, samples=2)
    assert np.array_equal(usual[2], one[2]) and not np.array_equal(one[2], two[2])
    assert np.array_equal(one[1], two[1]) and usual[1].shape == (ROWS, 2)
    assert servo_law(T, columns_of(stroke), CALIBRATION, known_to(0.01, stroke), {})[1].shape == (ROWS, 8)


def test_a_demand_that_is_the_firmware_s_own_has_no_noise_and_one_of_a_noisy_speed_has_all_of_it() -> None:
    n_dem = 75.0 + 6.0 * np.sin(0.9 * T)
    smooth = 74.0 + 6.0 * np.sin(0.9 * T - 0.2)
    noisy = smooth + 0.05 * white(8, ROWS)

    def of(n_r: Array, x_dem: Array, again: bool = False) -> Stage:
        c = {"n_dem": n_dem, "n_r": n_r, "x_dem": x_dem, "missing": NONE, "spell": np.zeros(ROWS, dtype=int)}
        return demand_stage(Driven(T, c, MACHINE, CALIBRATION, ("x_dem",), np.ones(ROWS, dtype=bool), (), again=again))

    def run(n_r: Array) -> Array:
        stage = of(n_r, NONE, True)
        return np.asarray(stage.run(stage.neutral()[None])[0, 0])

    own = of(noisy, run(noisy))
    counts = np.isfinite(own.measured[0])
    assert own.lost is not None and own.lost.shape == (8, 1, ROWS) and not own.lost[..., counts].any()
    assert own.raster_error == pytest.approx([0.0])
    hidden = of(noisy, run(smooth))  # the controller had less noise than the log
    error = (run(smooth) - run(noisy))[counts]
    assert hidden.lost is not None and hidden.raster_error is not None
    assert np.std(hidden.lost[:, 0, counts]) == pytest.approx(np.std(error), rel=0.25)
    floor = noise_floor(T, np.where(np.isfinite(hidden.measured[0]), hidden.measured[0] - run(noisy), np.nan))
    assert np.hypot(floor, hidden.raster_error[0]) == pytest.approx(np.std(error), rel=0.25)


@pytest.mark.parametrize(("gap", "known"), [(0.9e-6, True), (1.1e-6, False)])
def test_a_controller_of_the_user_s_own_is_approached_from_4_percent_below_and_above(
    monkeypatch: pytest.MonkeyPatch, gap: float, known: bool
) -> None:
    """Where both ways lead to demands (m) that are nearer than a micrometre the past is forgotten."""
    seen = []

    def run(n_dem: Array, n_r: Array, start: float, angles: Array, before: float, *rest: Any) -> None:
        seen.append(before)
        rest[-1][:] = 0.02 + 0.125 * gap * before + 1e-3 * np.sin(T)

    monkeypatch.setattr(demand, "_run", run)
    c = {"n_dem": 70.0 + NONE, "n_r": 70.0 + NONE, "x_dem": 20.0 + np.sin(T), "missing": NONE}
    own = CALIBRATION._replace(program=SimpleNamespace(start=lambda flashed: "started"))
    stage = demand.own_demand_stage(Driven(T, c, MACHINE, own, ("x_dem",), np.ones(ROWS, dtype=bool), ()))
    assert seen == [4.0, -4.0] and np.isfinite(stage.measured).all() == known


@pytest.mark.parametrize("blocks", [2, 3, 6])
def test_the_test_of_a_condition_s_bins_is_the_f_test(blocks: int) -> None:
    """Bins of equal weight: their scatter over that within them, of one degree of freedom less than blocks in each."""
    bins, level, excess = 4, 0.05, 0.4
    n, deviation = np.full((bins, blocks), 10.0), np.full(bins, 0.1)
    variance = 0.01 + (0.5 * 0.5 * excess) ** 2
    within = bins * (blocks - 1)
    # of an incomplete beta: the share x = d1 F / (d1 F + d2), and of it a mixture of Poisson's where bins differ
    d1, d2 = bins - 1.0, float(within)
    x = scipy.special.betaincinv(0.5 * d1, 0.5 * d2, 1.0 - level)
    limit = d2 * x / (1.0 - x)
    away = np.sqrt(limit * variance / bins)
    signs = np.resize([1.0, -1.0], bins)
    assert _alike(1.0 + 0.99 * away * signs, deviation, n, excess, level).holds
    assert not _alike(1.0 + 1.01 * away * signs, deviation, n, excess, level).holds
    many, half = np.arange(400.0), 0.5 * bins * excess**2 / variance
    weights = np.exp(-half + many * np.log(half) - scipy.special.gammaln(many + 1.0))
    power = 1.0 - float(weights @ scipy.special.betainc(0.5 * d1 + many, 0.5 * d2, x))
    assert _alike(np.ones(bins), deviation, n, excess, level).power == pytest.approx(power, rel=1e-6)
    some = np.vstack([n, np.zeros((1, blocks))])  # a bin without samples has no scatter
    assert _alike(np.append(np.ones(bins), np.nan), np.append(deviation, np.nan), some, excess, level).power == (
        pytest.approx(power, rel=1e-6)
    )


def test_the_jackknife_of_two_blocks_is_half_of_their_difference() -> None:
    ratio, deviation = _over_blocks(np.array([[3.0, 5.0], [2.0, 2.0]]), np.ones((2, 2)))
    assert ratio.tolist() == [4.0, 2.0] and deviation.tolist() == [1.0, 0.0]
    uneven = np.array([[2.0, 6.0, 9.0, 0.0]])
    there = np.array([[1.0, 2.0, 3.0, 0.0]])  # blocks without samples do not count
    whole = 17.0 / 6.0
    left = [15.0 / 5.0, 11.0 / 4.0, 8.0 / 3.0]
    wanted = np.sqrt(2.0 / 3.0 * sum((x - whole) ** 2 for x in left))
    assert _over_blocks(uneven, there)[1] == pytest.approx([wanted])
    one = _over_blocks(np.array([[3.0, 0.0]]), np.array([[1.0, 0.0]]))
    assert one[0].tolist() == [3.0] and one[1] == pytest.approx([3.0 / np.sqrt(2.0)])  # all of it, by one block


def test_a_model_s_steps_are_calibrated_in_both_directions_piece_by_piece(monkeypatch: pytest.MonkeyPatch) -> None:
    step = np.convolve(white(1, 900), np.ones(20) / 20.0, "same")
    logged = np.where(step > 0.0, 1.3, 0.8) * step + 0.01
    whole = np.ones(900, dtype=bool)
    for rows in (4000, 400):
        monkeypatch.setattr(current, "TRIANGLE_ROWS", rows)
        assert _calibrated(step, DT, logged, whole) == pytest.approx(logged, abs=1e-8)
        early, late = np.roll(step, -1), np.roll(step, 1)  # a row each way
        shifted = 0.5 * step + 0.3 * early + 0.2 * late
        assert _calibrated(step, DT, shifted, whole) == pytest.approx(shifted, abs=1e-8)
        bad, some = logged.copy(), whole.copy()
        bad[600:650], some[600:650] = 50.0, False
        assert _calibrated(step, DT, bad, some) == pytest.approx(logged, abs=1e-8)


def test_a_model_s_flow_bends_and_its_lags_are_calibrated() -> None:
    step = np.convolve(white(1, 600), np.ones(20) / 20.0, "same")
    whole = np.ones(600, dtype=bool)
    bends = np.quantile(np.abs(step), (0.3, 0.6, 0.85, 0.97))
    for bend in bends:  # a flow that bends where so many rows move less
        curve = step + 0.4 * np.sign(step) * np.maximum(np.abs(step) - bend, 0.0)
        assert _calibrated(step, DT, curve, whole) == pytest.approx(curve, abs=1e-8)
    for lag in (0.01, 0.03, 0.1):
        share, behind = 1.0 - np.exp(-DT / lag), np.zeros(600)
        for k in range(600):
            behind[k] = (1.0 - share) * behind[k - 1] * (k > 0) + share * step[k]
        assert _calibrated(step, DT, behind, whole) == pytest.approx(behind, abs=1e-8)


def test_a_stroke_is_smoothed_over_the_more_rows_the_noisier_it_is() -> None:
    i = 6.0 * np.sin(0.8 * T) + 2.0 * np.sin(7.0 * T)
    c = {"i_cmd": i, "n_r": 70.0 + NONE, "p_s": 21.0 + NONE, "t_oil": 40.0 + NONE, "missing": NONE,
         "fresh": np.ones(ROWS)}  # fmt: skip
    x = 20.0 + np.cumsum(i) * 4e-3 + 0.004 * np.sin(2.0 * np.pi * T / 0.35)  # what no current makes
    rows = [without_noise(T, c | {"x_lvdt": x + s * white(4, ROWS)}, MACHINE).rows for s in (1e-4, 4e-3, 0.05)]
    assert rows == sorted(rows) and set(rows) <= {9, 15, 25, 41} and len({*rows}) >= 2


@pytest.mark.parametrize(("times", "one_noise"), [(1.045, True), (1.055, False)])
def test_noise_that_is_seen_to_a_twentieth_is_the_noise_that_was_drawn(times: float, one_noise: bool) -> None:
    h = 0.1 * white(1, ROWS) + 0.4 * np.sin(2.0 * np.pi * T / 0.8)
    h = h - np.repeat(h.reshape(-1, 100).mean(axis=1), 100)  # without jumps from window to window
    stage = servo(np.repeat(h[:, None], 3, axis=1), times * h)
    drawn, own = noise_floor(T, h), noise_floor(T, without_jumps(stage, times * h))
    assert 1.04 < own / drawn < 1.06
    seen = own if one_noise else drawn
    assert stage.raster_error == pytest.approx([np.sqrt(rms(stage, h[None])[0] ** 2 - seen**2)], rel=1e-4)


def test_frames_that_are_held_are_those_of_a_log_that_holds_them() -> None:
    """Frames of every 50 ms, of which one stands 20 ms behind the first row."""
    stage = demand_of()
    theta = stage.neutral()
    theta[stage.index()["frame_hold"]] = 0.05, 0.4
    n = np.maximum((np.arange(ROWS) - 2) // 5 * 5 + 2, 0)
    c = stage.made.driven.columns  # type: ignore[attr-defined]
    same = demand_of(columns={name: c[name][n] for name in ("n_dem", "n_r")})
    held, wanted = stage.run(theta[None])[0, 0], same.run(same.neutral()[None])[0, 0]
    assert held[100:] == pytest.approx(wanted[100:], abs=1e-9)
    assert np.abs(held - stage.run(stage.neutral()[None])[0, 0]).max() > 0.02
    starts = stage.effect("frame_hold").starts
    for hold in (0.02, 0.05):
        phases = [p for h, p in starts if h == pytest.approx(hold)]
        assert phases == pytest.approx(np.arange(round(hold / DT)) * DT / hold)
