"""The nominal plant against closed forms, invariants and an independent integrator."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from plant import build_plant, chain, places
from plant.actuator import speed_factor
from plant.engine import engine_step
from plant.parameters import BANDWIDTH, FLOW_GAIN, PLAY, VALVE_A11, VALVE_A22, derive
from plant.play import play_step
from plant.sensors import lag_factor, quantise
from plant.valve import valve_matrix, valve_step
from tests.conftest import examples


@pytest.fixture
def machine():
    return build_plant()


def drive(machine, current, ticks, p_s=21e6, stroke=0.024):
    s = machine.start(stroke=stroke, n_r=60.0)
    out = np.empty((ticks, chain.N_STATE))
    for k in range(ticks):
        chain.drive_step(s, machine.p, 0, current if np.isscalar(current) else current[k], 60.0, p_s, 40.0)
        out[k] = s[:, 0]
    return out


def test_full_spool_moves_the_piston_at_the_rated_speed(machine) -> None:
    out = drive(machine, 0.040, 100, stroke=0.002)
    assert out[-1, places.SPEED] == pytest.approx(0.150, rel=1e-9)


def test_speed_falls_with_the_root_of_the_supply_pressure(machine) -> None:
    full, quarter = (drive(machine, 0.040, 60, p_s=p, stroke=0.002)[-1, places.SPEED] for p in (21e6, 5.25e6))
    assert quarter / full == pytest.approx(0.5, rel=1e-9)
    assert speed_factor(1e6, 2e6, 21e6) == 0.0  # a load above the supply stalls, it does not push back


def test_half_current_reaches_the_stop_and_stays(machine) -> None:
    out = drive(machine, 0.020, 600, stroke=0.024)
    assert out[-1, places.X] == 0.048
    assert np.all(np.diff(out[:, places.X]) >= 0.0)


def test_valve_step_is_the_exact_solution_of_its_equation() -> None:
    w, z, dt = 2 * np.pi * 60.0, 0.8, 1e-4
    sol = solve_ivp(
        lambda t, y: [y[1], w * w * (0.5 - y[0]) - 2 * z * w * y[1]],
        (0, 0.03),
        [0.0, 0.0],
        rtol=1e-11,
        atol=1e-13,
        dense_output=True,
    )
    a = valve_matrix(60.0, z, dt)
    u, du = 0.0, 0.0
    for k in range(300):
        u, du = valve_step(u, du, 0.5, *a)
        assert u == pytest.approx(sol.sol((k + 1) * dt)[0], abs=1e-9)


@given(st.floats(-3, 3), st.floats(-1e4, 1e4), st.floats(-1, 1), st.floats(10, 200), st.floats(0.1, 0.95))
def test_spool_never_leaves_its_stops(target, du, u, bandwidth, damping) -> None:
    a = valve_matrix(bandwidth, damping, 1e-4)
    for _ in range(50):
        u, du = valve_step(u, du, target, *a)
        assert -1.0 <= u <= 1.0


def test_valve_at_60_hz_lags_as_its_transfer_function_says(machine) -> None:
    f, n = 20.0, 1000
    t = np.arange(n) * 1e-3
    out = drive(machine, 0.010 * np.sin(2 * np.pi * f * t), n)
    s = 2j * np.pi * f
    w = 2 * np.pi * 60.0
    hold = np.exp(-s * 0.5e-3) * np.sinc(f * 1e-3)  # the current is held over each tick; out[k] is at t + 1 ms
    expected = w * w / (s * s + 1.6 * w * s + w * w) * hold * np.exp(s * 1e-3)
    basis = np.exp(1j * 2 * np.pi * f * t[500:])
    gain = 2j * np.mean(out[500:, places.SPOOL] * basis.conj()) / 0.25
    assert abs(gain - expected) < 2e-3


def test_engine_follows_the_lag_and_keeps_its_limits() -> None:
    n, rates = 45.0, []
    for _ in range(20_000):
        after = engine_step(n, 100.0, 1.2, 8.0, 10.0, 1e-3)
        rates.append((after - n) / 1e-3)
        n = after
    assert max(rates) == pytest.approx(8.0)
    # last 9.6 % run out as exp(-t/1.2): from 9.6 % off, 3.6 s later 9.6 exp(-3) are left
    limited = (100.0 - 9.6 - 45.0) / 8.0
    assert n == pytest.approx(100.0, abs=1e-3)
    m = 45.0
    for _ in range(int(round((limited + 3.6) * 1000))):
        m = engine_step(m, 100.0, 1.2, 8.0, 10.0, 1e-3)
    assert 100.0 - m == pytest.approx(9.6 * np.exp(-3.0), rel=2e-3)


def test_reversal_loses_the_whole_gap(machine) -> None:
    width = machine.p[PLAY, 0]
    y = play_step(0.0, 0.3, width)
    assert y == pytest.approx(0.3 - width / 2)
    assert play_step(y, 0.3 - width * 0.999, width) == y
    assert play_step(y, 0.3 - width * 1.5, width) == pytest.approx(y - width * 0.5)


@settings(max_examples=examples(50))
@given(st.lists(st.floats(-1, 1), min_size=2, max_size=50), st.floats(0, 0.5))
def test_play_is_rate_independent_and_stays_in_its_gap(path, width) -> None:
    y = z = path[0]
    for a, b in zip(path, path[1:], strict=False):
        for u in np.linspace(a, b, 7)[1:]:
            y = play_step(y, u, width)
            assert abs(y - u) <= width / 2 + 1e-15
        z = play_step(z, b, width)
        assert y == pytest.approx(z, abs=1e-15)


@pytest.mark.parametrize(("stage", "width"), [("vigv", 1.6), ("vgv1", 1.1), ("vgv2", 0.8)])
def test_hysteresis_at_the_vane_is_the_published_width(machine, stage, width) -> None:
    k = ("vigv", "vgv1", "vgv2").index(stage)
    strokes = np.concatenate([np.linspace(0.001, 0.047, 2000), np.linspace(0.047, 0.001, 2000)])
    s = machine.start(stroke=0.001, n_r=60.0)
    angle = np.empty(len(strokes))
    for i, x in enumerate(strokes):
        s[places.X, 0] = x
        for _ in range(20 if i == 0 else 1):
            chain.vane_step(s, machine.p, 0, 60.0, 40.0)
        ring = s[places.RING + k, 0]
        from plant.linkage import vane_angle

        angle[i] = np.rad2deg(vane_angle(ring, *machine.lever(k)))
    up, down = angle[:2000], angle[2000:][::-1]
    middle = slice(200, 1800)
    assert np.mean(down[middle] - up[middle]) == pytest.approx(width, rel=0.03)


def test_lvdt_converter_steps_are_its_range_over_two_to_the_bits(machine) -> None:
    q = 0.050 / 65536
    s = machine.start(stroke=0.0123456789, n_r=0.0)
    sample = chain.sample_lvdt(s, machine.p, 0, 0.0)
    assert abs(sample - 0.0123456789) <= q / 2
    assert sample / q == pytest.approx(round(sample / q), abs=1e-6)
    assert quantise(0.3, 0.0) == 0.3
    assert lag_factor(0.0, 1e-3) == 1.0


@pytest.mark.slow
def test_halving_the_plant_step_changes_the_stroke_by_less_than_a_tenth_of_a_count() -> None:
    from scipy.signal import chirp

    t = np.arange(2000) * 1e-3
    current = 0.02 * chirp(t, 0.5, 2.0, 20.0)
    machine = build_plant()
    coarse = drive(machine, current, 2000)[:, places.X]
    w, z = 2 * np.pi * 60.0, 0.8

    def rhs(time, y):
        i = current[min(int(time * 1000 + 1e-9), 1999)] / 0.040
        u = min(max(y[0], -1.0), 1.0)
        return [y[1], w * w * (i - y[0]) - 2 * z * w * y[1], 0.150 * u]

    y, fine = [0.0, 0.0, 0.024], []
    for k in range(2000):
        y = solve_ivp(rhs, (k * 1e-3, (k + 1) * 1e-3 - 1e-12), y, rtol=1e-9, atol=1e-12).y[:, -1]
        fine.append(y[2])
    assert np.max(np.abs(coarse - fine)) < 0.1 * 0.050 / 65536


def test_parameters_side_by_side_do_not_touch_each_other(machine) -> None:
    p = np.repeat(machine.p, 3, axis=1)
    p[FLOW_GAIN, 1] *= 1.1
    p[BANDWIDTH, 2] *= 0.8
    derive(p, chain.TICK / chain.SUBSTEPS, chain.TICK)
    assert p[VALVE_A11, 2] != p[VALVE_A11, 0] and p[VALVE_A22, 1] == p[VALVE_A22, 0]
    s = np.repeat(machine.start(0.02, 60.0), 3, axis=1)
    for j in range(3):
        for _ in range(50):
            chain.drive_step(s, p, j, 0.01, 60.0, 21e6, 40.0)
    alone = drive(machine, 0.01, 50, stroke=0.02)[-1]
    assert np.array_equal(s[:, 0], alone)
    moved = s[places.X] - 0.02
    assert moved[1] / moved[0] == pytest.approx(1.1, rel=1e-9)
    assert moved[2] != moved[0]
