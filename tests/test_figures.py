"""Error figures and the noise floor, on signals whose error and noise are known."""

# ruff: noqa: D103 - a test's name is its claim
from __future__ import annotations

import dataclasses
import math
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter

from hil.figures import SignalError, error_figures, noise_floor, resolution, resolution_before
from tests.conftest import examples
from vaneloop.base.errors import InputError


def raster(duration=300.0, rate=100.0):
    return np.arange(int(duration * rate)) / rate


def rises_and_falls(t, low=40.0, high=100.0, rate=8.0, dwell=15.0):
    """Rotor speed of an engine run: dwells joined by rounded ramps."""
    leg = (high - low) / rate
    corners = np.cumsum([0.0, *([dwell, leg] * 200)])
    levels = [low]
    for i in range(200):
        levels += [levels[-1], high if i % 2 == 0 else low]
    y = np.interp(t, corners, levels)
    dt = t[1] - t[0]
    k = max(1, int(1.2 / dt))
    return np.convolve(np.pad(y, (k, 0), mode="edge"), np.ones(k) / k, mode="valid")[: t.size]


def lagged_noise(n, sigma, dt, lag, seed=1):
    """White noise through a first-order lag, scaled to RMS ``sigma``."""
    phi = math.exp(-dt / lag)
    e = np.random.default_rng(seed).normal(0, 1, n + 1000)
    return (lfilter([math.sqrt(1 - phi**2)], [1, -phi], e) * sigma)[1000:]


def figures(model, ref, **more):
    t = np.arange(len(model)) * 0.1
    return error_figures("vigv", "linkage", "deg", "measured", t, model, ref, **more)


def test_figures_of_a_known_error():
    f = figures([1.0, 2.0, 3.0, 4.0], [1.0, 1.0, 5.0, 4.0], noise_floor=0.03)
    assert f == SignalError("vigv", "linkage", "deg", "measured", math.sqrt(5 / 4), 0.75, 2.0, None, 0.03, 4)


def test_fields_are_the_ones_of_the_architecture_page():
    names = "signal stage unit reference rms mean_abs max_abs mean_abs_99_100 noise_floor samples"
    assert " ".join(f.name for f in dataclasses.fields(SignalError)) == names
    with pytest.raises(dataclasses.FrozenInstanceError):
        figures([1.0], [2.0], noise_floor=0.0).rms = 3.0


def test_what_was_not_measured_does_not_count():
    f = figures([1.0, np.nan, 3.0, 9.0], [2.0, np.nan, np.inf, 8.0], noise_floor=0.0)
    assert (f.samples, f.max_abs, f.rms) == (2, 1.0, 1.0)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_model_that_is_no_number_where_it_was_measured_is_refused(value):
    with pytest.raises(InputError, match=r"'vigv': the model \(=(nan|-?inf)\) at t = [0-9.]+ s and in 1 of 3 samples"):
        figures([1.0, value, 3.0], [2.0, 1.0, 8.0], noise_floor=0.0)


def test_design_point_is_the_open_interval_99_to_100():
    n_r = [99.0, 99.5, 100.0, np.nan, 99.9]
    f = figures([1.0, 2.0, 4.0, 8.0, 3.0], [0.0] * 5, n_r=n_r, noise_floor=0.0)
    assert f.mean_abs_99_100 == 2.5
    assert figures([1.0], [0.0], n_r=[98.0], noise_floor=0.0).mean_abs_99_100 is None


def test_no_common_sample_is_refused_in_one_line():
    with pytest.raises(InputError, match="'vigv'.*no sample"):
        figures([2.0, 1.0], [np.inf, np.nan])
    with pytest.raises(InputError, match="reference has 3 samples, must have 2"):
        figures([1.0, 2.0], [1.0, 2.0, 3.0])


@settings(max_examples=examples(50), deadline=None)
@given(st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=200))
def test_mean_never_exceeds_rms_and_rms_never_exceeds_max(error):
    f = figures(error, np.zeros(len(error)), noise_floor=0.0)
    slack = 1e-12 + 1e-12 * f.max_abs
    assert f.mean_abs <= f.rms + slack and f.rms <= f.max_abs + slack


def test_noise_floor_is_estimated_from_the_reference():
    t = raster()
    ref = np.random.default_rng(0).normal(0, 0.03, t.size)
    f = error_figures("vigv", "linkage", "deg", "measured", t, np.zeros(t.size), ref)
    assert f.noise_floor == pytest.approx(0.03, rel=0.03)
    assert f.rms / f.noise_floor == pytest.approx(1.0, rel=0.03)


@pytest.mark.parametrize("rate", [10.0, 100.0, 1000.0])
@pytest.mark.parametrize("sigma", [0.002, 0.03, 0.5])
def test_white_noise_at_rest(rate, sigma):
    t = raster(120.0, rate)
    y = 12.0 + np.random.default_rng(3).normal(0, sigma, t.size)
    assert noise_floor(t, y) == pytest.approx(sigma, rel=0.06)


@pytest.mark.parametrize("rate", [10.0, 100.0, 1000.0])
def test_white_noise_on_a_moving_signal(rate):
    t = raster(600.0, rate)
    y = rises_and_falls(t) + np.random.default_rng(4).normal(0, 0.02, t.size)
    assert noise_floor(t, y) == pytest.approx(0.02, rel=0.1)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("lag", [0.001, 0.005, 0.02])
def test_noise_behind_a_sensor_lag_is_not_underestimated(lag, seed):
    t = raster(300.0, 1000.0)
    y = rises_and_falls(t) + lagged_noise(t.size, 0.03, 1e-3, lag, seed)
    assert noise_floor(t, y) == pytest.approx(0.03, rel=0.12)


def test_quantised_noise():
    t, rng = raster(), np.random.default_rng(5)
    for q, sigma in ((0.002, 0.03), (0.02, 0.03), (0.05, 0.03)):
        y = np.round((rises_and_falls(t) + rng.normal(0, sigma, t.size)) / q) * q
        assert resolution(y) == pytest.approx(q, rel=1e-6)
        assert noise_floor(t, y) == pytest.approx(math.hypot(sigma, q / math.sqrt(12)), rel=0.25)


def test_never_below_the_quantisation():
    t = raster()
    q = 0.25
    y = np.round(rises_and_falls(t) / q) * q
    assert noise_floor(t, y) == pytest.approx(q / math.sqrt(12), rel=0.3)


def test_steps_and_spikes_do_not_count():
    t, rng = raster(), np.random.default_rng(6)
    y = rng.normal(0, 0.03, t.size) + 10.0 * (np.floor(t / 20) % 2)
    y[rng.integers(0, t.size, 40)] += 50.0
    assert noise_floor(t, y) == pytest.approx(0.03, rel=0.1)


def test_held_samples_are_not_taken_for_quiet_ones():
    t = raster(300.0, 100.0)
    slow = np.random.default_rng(7).normal(0, 0.03, t.size // 10 + 1)
    y = np.repeat(slow, 10)[: t.size]
    assert noise_floor(t, y) == pytest.approx(0.03, rel=0.2)


def test_gaps_jitter_and_nan():
    rng = np.random.default_rng(8)
    t = raster() + rng.uniform(-0.002, 0.002, 30000)
    y = rises_and_falls(raster()) + rng.normal(0, 0.03, t.size)
    y[rng.integers(0, t.size, 30)] = np.nan
    keep = (t < 50) | (t > 70)
    assert noise_floor(t[keep], y[keep]) == pytest.approx(0.03, rel=0.15)


def test_a_sensor_switched_off_for_most_of_the_log():
    t = raster()
    y = np.where(t < 200, 0.0, 5 + np.random.default_rng(9).normal(0, 0.03, t.size))
    assert noise_floor(t, y) == pytest.approx(0.03, rel=0.1)


@pytest.mark.parametrize("values", [[], [1.0], [1.0] * 100, [np.nan] * 100, [1.0, 2.0, 4.0]])
def test_channels_too_poor_for_an_estimate_give_a_finite_answer(values):
    floor = noise_floor(np.arange(len(values)) * 0.1, values)
    assert math.isfinite(floor) and floor >= 0


def test_smooth_motion_without_noise_has_almost_no_floor():
    t = raster()
    assert noise_floor(t, rises_and_falls(t)) < 0.005
    assert noise_floor(t, 10 * np.sin(2 * np.pi * 0.2 * t)) < 0.001


@pytest.mark.parametrize("q", [2.4, 3.7, 4.49, 9.3])
def test_a_step_is_found_behind_a_smaller_one(q: float) -> None:
    rng = np.random.default_rng(3)
    for spread in (800.0, 20_000.0):  # with most levels between the ends, and with few of them
        y = np.round(q * np.round(np.cumsum(rng.standard_normal(5000)) * spread / 70.0 / q))
        assert resolution_before(0.001 * y + 7.0) == pytest.approx(0.001 * q, rel=1e-3)


def test_no_step_is_found_behind_one_or_in_noise() -> None:
    y = np.random.default_rng(4).normal(size=5000)
    assert resolution_before(y) == 0.0
    assert resolution_before(np.round(y, 2)) == 0.0
    assert resolution_before(np.round(100.0 * y) / 8.0) == 0.0
    assert resolution_before(np.zeros(10)) == 0.0 == resolution_before([])


def test_a_channel_without_steps_has_no_resolution():
    assert resolution(np.random.default_rng(0).normal(size=5000)) == 0.0
    assert resolution(np.float32(np.arange(1000) * 0.25).astype(float)) == pytest.approx(0.25)


def test_three_thousand_seconds_at_one_kilohertz_take_little_time():
    t = raster(3000.0, 1000.0)
    y = np.random.default_rng(0).normal(0, 0.03, t.size)
    noise_floor(t[:1000], y[:1000])
    start = time.process_time()
    noise_floor(t, y)
    assert time.process_time() - start < 3.0
