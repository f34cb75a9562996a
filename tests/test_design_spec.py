"""What each line of the servo's design promises: closed forms, limits of what is allowed, and figures of runs that are
known beforehand.
"""

from __future__ import annotations

import itertools
import json
import math
import tomllib
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import brentq

from tests.test_design import servo_with_play
from tests.trend_filters import filterpy_estimates, filterpy_gain, firmware_estimates, tracking_index_gain
from vaneloop.base.errors import InputError
from vaneloop.base.tables import path
from vaneloop.design import servo, servo_design
from vaneloop.design import trend as tf
from vaneloop.design.limit_cycles import LimitCycle, Play, harmonic_balance, limit_cycles, play_describing_function
from vaneloop.design.servo import (
    Corner,
    Gains,
    Margins,
    ServoPlant,
    continuous_loop,
    continuous_response,
    default_gains,
    frequency_grid,
    frequency_response,
    margins,
    noise_current,
    sampled_loop,
)
from vaneloop.design.servo_design import Check, DesignResult, Limits, PlayFigures, design, evaluate, summary
from vaneloop.design.servo_motor import MotorCorner, MotorServoPlant, plant_of_tables
from vaneloop.design.servo_simulation import Trajectory, ramp_demand, simulate, steady_cycle

GAINS = Gains(12.0, 90.0, 0.2)
ODD = ServoPlant(  # no two numbers alike, none of them 1
    rated_current=0.05, bandwidth=70.0, damping=0.6, flow_gain=0.12, pressure=16e6, p_ref=21e6, stroke=40e-3,
    lvdt_lag=1.5e-3, lvdt_noise=4e-6, lvdt_step=2e-6, current_limit=0.03, tick=0.5e-3, delay=2,
)  # fmt: skip
MOTOR = MotorServoPlant(
    speed_gain=0.2, speed_time=0.04, current_bandwidth=600.0, torque_constant=0.7, inertia=5e-4, viscous=2e-3
)


# ---------------------------------------------------------------- gains and plant


@pytest.mark.parametrize(
    ("name", "low", "high"), [("kp", 1e-3, 1e3), ("ki", 0.0, 1e5), ("kff", 0.0, 10.0)], ids=["kp", "ki", "kff"]
)
def test_each_gain_is_allowed_up_to_both_of_its_ends(name: str, low: float, high: float) -> None:
    for value in (low, high):
        assert getattr(replace(GAINS, **{name: value}), name) == value
    for value in (low - 1e-6, high * (1.0 + 1e-9), math.nan):
        with pytest.raises(InputError, match=rf"^{name} \(=.*\) must be in \[{low:g}, {high:g}\]$"):
            replace(GAINS, **{name: value})


def values(table: str) -> dict[str, dict[str, float]]:
    data = tomllib.loads(path(table).read_text())
    return {s: {k: v["value"] for k, v in d.items() if isinstance(v, dict)} for s, d in data.items()}


def test_default_gains_are_those_of_the_calibration() -> None:
    k = values("calibration.toml")["servo"]
    assert default_gains() == Gains(k["kp"], k["ki"], k["kff"])


def test_the_plant_of_a_table_is_its_numbers_in_si(tmp_path) -> None:
    text = path("plant.toml").read_text()
    for old, new in (
        ("bandwidth = { value = 60.0", "bandwidth = { value = 71.0"),
        ("damping = { value = 0.8", "damping = { value = 0.7"),
        ("rated_current = { value = 40.0", "rated_current = { value = 50.0"),
        ("flow_gain = { value = 0.150", "flow_gain = { value = 0.140"),
        ("pressure = { value = 21.0", "pressure = { value = 19.0"),
        ("lvdt_lag = { value = 1.0", "lvdt_lag = { value = 1.25"),
        ("lvdt_noise = { value = 0.005", "lvdt_noise = { value = 0.004"),
        ("lvdt_bits = { value = 16.0", "lvdt_bits = { value = 14.0"),
    ):
        assert old in text
        text = text.replace(old, new)
    (tmp_path / "plant.toml").write_text(text)
    p = plant_of_tables(tmp_path / "plant.toml")
    assert type(p) is ServoPlant and p.hysteretic
    assert (p.rated_current, p.bandwidth, p.damping, p.flow_gain, p.pressure) == pytest.approx(
        (0.050, 71.0, 0.7, 0.14, 19e6)
    )
    assert (p.stroke, p.lvdt_lag, p.lvdt_noise) == pytest.approx((48e-3, 1.25e-3, 4e-6))
    assert p.lvdt_step == pytest.approx(50e-3 / 2**14)
    assert p.current_limit == pytest.approx(values("calibration.toml")["servo"]["current_limit"] * 1e-3)
    assert (p.p_ref, p.tick, p.delay) == (21e6, 1e-3, 0)
    assert plant_of_tables() == ServoPlant()  # the defaults are the shipped table's


def test_the_electromechanical_plant_of_a_table_is_its_numbers_in_si() -> None:
    t = values("plant_electromechanical.toml")
    p = plant_of_tables("plant_electromechanical.toml")
    assert isinstance(p, MotorServoPlant) and not p.hysteretic
    per_radian = t["screw"]["lead"] * 1e-3 / (2 * math.pi) / t["gear"]["ratio"]  # m of rod for 1 rad of the motor
    expected = {
        "rated_current": t["drive"]["rated_current"] * 1e-3,
        "flow_gain": t["drive"]["rated_speed"],
        "speed_gain": t["drive"]["speed_gain"],
        "speed_time": t["drive"]["speed_time"] * 1e-3,
        "current_bandwidth": t["drive"]["current_bandwidth"],
        "torque_constant": t["motor"]["torque_constant"],
        "inertia": t["motor"]["inertia"] + t["gear"]["inertia"] + t["screw"]["mass"] * per_radian**2,
        "viscous": t["screw"]["viscous"],
        "stroke": t["actuator"]["stroke"] * 1e-3,
        "lvdt_lag": t["sensors"]["lvdt_lag"] * 1e-3,
        "lvdt_noise": t["sensors"]["lvdt_noise"] * 1e-3,
        "lvdt_step": t["sensors"]["lvdt_range"] * 1e-3 / 2 ** t["sensors"]["lvdt_bits"],
        "current_limit": values("calibration.toml")["servo"]["current_limit"] * 1e-3,
        "tick": 1e-3,
    }
    assert {k: getattr(p, k) for k in expected} == pytest.approx(expected, rel=1e-12)
    assert p.table == "plant_electromechanical.toml"
    default = MotorServoPlant()  # what stands for the tables' where a test or a user gives some of it alone
    for name in ("speed_gain", "speed_time", "current_bandwidth", "torque_constant", "viscous"):
        assert getattr(default, name) == pytest.approx(expected[name])
    assert default.inertia == pytest.approx(expected["inertia"], rel=0.15)
    # no oil: rated current gives the rated speed at any pressure
    assert p.speed_per_ampere == pytest.approx(expected["flow_gain"] / expected["rated_current"])


def test_speed_goes_with_the_root_of_the_pressure() -> None:
    assert ODD.speed_per_ampere == pytest.approx(0.12 / 0.05 * math.sqrt(16 / 21))


def test_the_valve_is_a_damped_mass_on_a_spring() -> None:
    w = 2 * math.pi * 70.0
    s = np.array([1j * w, 0.3j * w, 100.0 + 50.0j])
    expected = w**2 / (s**2 + 2 * 0.6 * w * s + w**2)
    np.testing.assert_allclose(ODD.response(s), expected)
    n, d = ODD.dynamics()
    np.testing.assert_allclose(np.polyval(n, s) / np.polyval(d, s), expected)


def test_the_motors_speed_loop_is_the_closed_form() -> None:
    w = 2 * math.pi * 600.0
    s = np.array([30j, 400j, 20.0 + 100.0j])
    n = 0.2 * 0.7 * w * (0.04 * s + 1)
    d = 0.04 * s * (s + w) * (5e-4 * s + 2e-3)
    np.testing.assert_allclose(MOTOR.response(s), n / (d + n), rtol=1e-9)
    assert MOTOR.response(np.array([1e-6j]))[0] == pytest.approx(1.0)


def changed(plant: ServoPlant, nominal: ServoPlant) -> dict[str, float]:
    """What differs from the nominal plant: factors, or the number itself."""
    out = {}
    for f in fields(nominal):
        a, b = getattr(plant, f.name), getattr(nominal, f.name)
        if a != b and not (a != a and b != b):  # NaN: the valve that an electric actuator has not
            out[f.name] = a if f.name in ("pressure", "delay") else a / b
    return out


@pytest.mark.parametrize(
    ("plant", "tolerances", "corner"),
    [
        (
            replace(ServoPlant(), pressure=20e6),
            {"flow_gain": (0.95, 1.05), "bandwidth": (0.85, 1.15), "damping": (0.85, 1.15), "pressure": (19e6, 22e6)},
            Corner,
        ),
        (
            replace(MOTOR, pressure=1.0, p_ref=1.0),
            {
                "flow_gain": (0.97, 1.03),
                "speed_gain": (0.85, 1.15),
                "speed_time": (0.9, 1.1),
                "torque_constant": (0.95, 1.05),
            },
            MotorCorner,
        ),
    ],
    ids=["hydraulic", "electromechanical"],
)
def test_the_corners_are_every_pair_of_tolerances(
    plant: ServoPlant, tolerances: dict[str, tuple[float, float]], corner: type
) -> None:
    expected = []
    for given in itertools.product(*tolerances.values(), (0, 1)):
        expected.append({k: v for k, v in zip((*tolerances, "delay"), given, strict=True) if v})
    got = plant.corners()
    assert len(got) == len(expected) == 32
    m = Margins(True, *[0.0] * 11)
    for (named, at), want in zip(got, expected, strict=True):
        assert changed(at, plant) == pytest.approx(want, rel=1e-12)
        c = named(m)
        assert isinstance(c, corner) and c.margins is m
        says = [1e6 * v if f.name == "pressure_mpa" else v for f in fields(c) if (v := getattr(c, f.name)) is not m]
        assert says == pytest.approx([*(want[k] for k in tolerances), want.get("delay", 0)])


def test_a_valve_is_never_damped_beyond_what_its_step_can_take() -> None:
    damping = {p.damping for _, p in replace(ServoPlant(), damping=0.9).corners()}
    assert damping == {0.9 * 0.85, 0.99}


def test_a_corner_is_named_by_its_differences() -> None:
    m = Margins(True, *[0.0] * 11)
    assert Corner(0.95, 1.15, 0.85, 19.0, 1, m).describe() == (
        "flow -5%, valve bandwidth +15%, damping -15%, 19 MPa, computation delay 1 ms"
    )
    assert MotorCorner(1.03, 0.85, 1.1, 0.95, 0, m).describe() == (
        "rated speed +3%, speed gain -15%, integral time +10%, torque constant -5%, computation delay 0 ms"
    )


# ---------------------------------------------------------------- the loop


@pytest.mark.parametrize("ki", [0.0, 90.0])
def test_the_continuous_loop_is_its_formula(ki: float) -> None:
    gains, w = replace(GAINS, ki=ki), np.array([3.0, 40.0, 300.0])
    s, valve = 1j * w, 2 * math.pi * 70.0
    expected = (12.0 + ki / s) * valve**2 / (0.05 * (s**2 + 1.2 * valve * s + valve**2))
    expected = expected * 0.12 * math.sqrt(16 / 21) / s / (1.5e-3 * s + 1) * np.exp(-s * 0.5e-3 * 2.5)
    np.testing.assert_allclose(continuous_response(gains, ODD, w), expected, rtol=1e-12)
    loop = continuous_loop(gains, ODD)
    np.testing.assert_allclose(loop(s), expected, rtol=1e-6)
    assert len(loop.poles()) == 4 + 4 + (ki > 0)  # valve, actuator, LVDT, delay of the fourth order, integral


@pytest.mark.parametrize("ki", [0.0, 90.0])
@pytest.mark.parametrize("delay", [0, 1, 3])
def test_the_sampled_loop_is_the_held_plant_and_the_firmwares_sum(ki: float, delay: int) -> None:
    """Zero-order hold by the matrix exponential; PI by its difference equation, a tick's error added before it is
    used; a tick of computation is 1/z.
    """
    plant, w = replace(ODD, delay=delay), 2 * math.pi * 70.0
    g = 0.12 * math.sqrt(16 / 21)
    a = np.array([[0, 1, 0, 0], [-w * w, -1.2 * w, 0, 0], [g, 0, 0, 0], [0, 0, 1 / 1.5e-3, -1 / 1.5e-3]])
    b = np.array([[0], [w * w / 0.05], [0], [0]])
    e = expm(np.block([[a, b], [np.zeros((1, 5))]]) * 0.5e-3)
    omega = np.array([5.0, 60.0, 700.0])
    z = np.exp(1j * omega * 0.5e-3)
    held = np.array([np.linalg.solve(v * np.eye(4) - e[:4, :4], e[:4, 4])[3] for v in z])
    expected = held / z**delay * (12.0 + ki * 0.5e-3 * z / (z - 1.0))
    np.testing.assert_allclose(
        frequency_response(sampled_loop(replace(GAINS, ki=ki), plant), omega), expected, rtol=1e-6
    )


def test_the_grid_runs_from_a_twentieth_of_a_hertz_to_half_the_sampling_rate() -> None:
    w = frequency_grid(ODD)
    assert w.size == 2500 and frequency_grid(ODD, 7).size == 7
    assert (w[0], w[-1]) == pytest.approx((2 * math.pi * 0.05, 0.999 * math.pi / 0.5e-3))
    assert np.ptp(np.diff(np.log(w))) < 1e-9


def test_margins_are_read_off_the_loops_own_curves() -> None:
    """Every figure once more, by its definition, on a dense grid of the same loop."""
    plant = replace(ODD, delay=0)
    m = margins(GAINS, plant)
    w = np.geomspace(0.3, 0.999 * math.pi / plant.tick, 8000)
    value = frequency_response(sampled_loop(GAINS, plant), w)
    s, t = 1 / (1 + value), value / (1 + value)
    cross = int(np.argmax(np.abs(value) < 1))
    back = int(np.argmax(np.unwrap(np.angle(value)) < -math.pi))
    hertz = w / (2 * math.pi)
    assert m.stable
    assert m.crossover_hz == pytest.approx(hertz[cross], rel=3e-3)
    assert m.phase_crossover_hz == pytest.approx(hertz[back], rel=3e-3)
    assert m.gain_margin_db == pytest.approx(-20 * math.log10(abs(value[back])), abs=0.02)
    assert m.phase_margin_deg == pytest.approx(180 + math.degrees(np.unwrap(np.angle(value))[cross]), abs=0.1)
    assert m.sensitivity_peak == pytest.approx(np.abs(s).max(), rel=1e-3)
    assert m.complementary_peak == pytest.approx(np.abs(t).max(), rel=1e-3)
    assert m.bandwidth_hz == pytest.approx(hertz[int(np.argmax(np.abs(t) < math.sqrt(0.5)))], rel=5e-3)
    disk = np.abs(0.5 * (s - t))
    assert m.disk_margin == pytest.approx(1 / disk.max(), rel=1e-3)
    assert m.disk_hz == pytest.approx(hertz[int(np.argmax(disk))], rel=0.02)
    alpha = m.disk_margin
    assert m.disk_gain_db == pytest.approx(20 * math.log10((2 + alpha) / (2 - alpha)), abs=0.01)
    assert m.disk_phase_deg == pytest.approx(2 * math.degrees(math.atan(alpha / 2)), abs=0.05)


def test_an_unstable_loop_has_no_disk() -> None:
    m = margins(Gains(400.0, 0.0, 0.0), replace(ODD, delay=0), frequency_grid(ODD, 400))
    assert not m.stable and m.gain_margin_db < 0.0
    assert (m.disk_margin, m.disk_gain_db, m.disk_phase_deg) == (0.0, 0.0, 0.0)


def test_a_loop_that_never_reaches_one_has_no_margin_of_phase() -> None:
    w = np.geomspace(300.0, 0.999 * math.pi / 0.5e-3, 300)  # above the crossover
    m = margins(Gains(0.5, 0.0, 0.0), replace(ODD, delay=0), w)
    assert m.phase_margin_deg == math.inf and math.isnan(m.crossover_hz)
    assert math.isnan(m.bandwidth_hz)  # below -3 dB from the first frequency on
    low = margins(Gains(0.5, 0.0, 0.0), replace(ODD, delay=0), np.geomspace(0.1, 1.0, 50))
    assert low.gain_margin_db == math.inf and math.isnan(low.phase_crossover_hz)
    assert math.isnan(low.bandwidth_hz)  # nor does it fall to -3 dB there


def test_the_noise_of_the_current_is_the_covariance_of_the_closed_loop() -> None:
    """Plant, delay and integral, driven by one sample of noise: white noise has the energy of that response."""
    plant, tick, w = replace(ODD, delay=1), 0.5e-3, 2 * math.pi * 70.0
    g = 0.12 * math.sqrt(16 / 21)
    a = np.array([[0, 1, 0, 0], [-w * w, -1.2 * w, 0, 0], [g, 0, 0, 0], [0, 0, 1 / 1.5e-3, -1 / 1.5e-3]])
    b = np.array([[0], [w * w / 0.05], [0], [0]])
    e = expm(np.block([[a, b], [np.zeros((1, 5))]]) * tick)
    # states: plant, the current on its way, the integral before the tick; i = -(kp y + q + ki T y), y = x_lvdt + noise
    c = np.array([0, 0, 0, 1.0])
    p = GAINS.kp + GAINS.ki * tick
    f = np.zeros((6, 6))
    f[:4, :4], f[:4, 4] = e[:4, :4], e[:4, 4]
    f[4, :4], f[4, 5] = -p * c, 1.0
    f[5, :4], f[5, 5] = -GAINS.ki * tick * c, 1.0
    state, row, energy = np.array([0, 0, 0, 0, -p, -GAINS.ki * tick]), np.array([*(-p * c), 0.0, 1.0]), p * p
    for _ in range(6000):
        energy += (row @ state) ** 2
        state = f @ state
    expected = 4e-6 * math.sqrt(energy)
    assert noise_current(GAINS, plant) == pytest.approx(expected, rel=1e-3)


def test_the_whole_analysis_is_the_nominal_loop_and_each_corner(monkeypatch: pytest.MonkeyPatch) -> None:
    two = ServoPlant().corners()[5:7]
    monkeypatch.setattr(ServoPlant, "corners", lambda self: two)
    nominal, corners = servo.analyse(GAINS, ServoPlant())
    assert nominal == margins(GAINS, ServoPlant())
    assert corners == [named(margins(GAINS, at, frequency_grid(ServoPlant(), 500))) for named, at in two]


# ---------------------------------------------------------------- play


@pytest.mark.parametrize("site", ["lvdt", "valve", "vanes"])
def test_a_play_has_a_place_and_a_width(site: str) -> None:
    assert Play(site, 0.0).gap == 0.0
    for gap in (-1e-9, math.inf, math.nan):
        with pytest.raises(InputError, match=r"^gap \(=.*\) must be 0 or more$"):
            Play(site, gap)
    with pytest.raises(InputError, match=r"^site \(='pump'\) must be lvdt, valve or vanes$"):
        Play("pump", 0.1)


def test_the_describing_function_is_gelbs_closed_form() -> None:
    """N = b/A + j a/A of a gap of 2 D, x = D/A: [pi/2 + asin(1 - 2x) + (1 - 2x) sqrt(1 - (1 - 2x)^2)]/pi and
    -4 x (1 - x)/pi.
    """
    a = np.array([0.6, 1.0, 7.0, 1e4])
    y = 1 - 2 * 0.5 / a
    expected = (math.pi / 2 + np.arcsin(y) + y * np.sqrt(1 - y * y)) / math.pi - 4j * 0.5 / a * (1 - 0.5 / a) / math.pi
    np.testing.assert_allclose(play_describing_function(a, 1.0), expected, rtol=1e-9)
    one = play_describing_function(2.0, 3.0)
    assert np.ndim(one) == 0 and one == pytest.approx(play_describing_function(np.array([2.0]), 3.0)[0])


def servo_loop(w: Any) -> Any:
    return 4.0 / (1j * np.asarray(w) * (1j * np.asarray(w) + 1.0))


def test_a_limit_cycle_closes_the_loop_and_grows_with_the_gap() -> None:
    (one,) = limit_cycles(servo_loop, 1.0, 0.1, 20.0)
    balance = servo_loop(one.omega) * play_describing_function(one.amplitude, 1.0)
    assert balance == pytest.approx(-1.0, abs=1e-4)
    assert one.after == pytest.approx(one.amplitude * abs(play_describing_function(one.amplitude, 1.0)), rel=1e-9)
    (wide,) = limit_cycles(servo_loop, 2.5, 0.1, 20.0)
    assert (wide.amplitude, wide.omega, wide.after) == pytest.approx((2.5 * one.amplitude, one.omega, 2.5 * one.after))
    assert limit_cycles(servo_loop, 0.0, 0.1, 20.0) == []
    assert limit_cycles(servo_loop, 1.0, 2.0, 20.0) == []  # not between these frequencies
    assert limit_cycles(servo_loop, 1.0, 0.1, 1.0) == []


def test_only_an_oscillation_that_holds_itself_is_told() -> None:
    """A loop that is conditionally stable crosses twice: the small oscillation grows or dies, the greater one stays."""

    def conditional(w: Any) -> Any:
        s = 1j * np.asarray(w)
        return 30.0 * (s + 1.0) ** 2 / s**3 / (0.05 * s + 1.0)

    found = limit_cycles(conditional, 1.0, 0.2, 200.0)
    for cycle in found:
        d = 0.02 * cycle.amplitude
        for grown, sign in ((cycle.amplitude + d, -1.0), (cycle.amplitude - d, 1.0)):
            # roots of 1 + L(s) N: with a greater amplitude they decay
            n = play_describing_function(grown, 1.0)
            s = 1j * cycle.omega
            for _ in range(50):
                f = 1.0 + conditional(s / 1j) * n
                slope = (1.0 + conditional((s + 1e-6) / 1j) * n - f) / 1e-6
                s -= f / slope
            assert s.real * sign > 0.0
    every = [w for w in np.geomspace(0.2, 200.0, 4000) if abs(np.angle(-conditional(w))) < math.pi / 2]
    assert every and len(found) == 1


def test_with_harmonics_the_cycle_is_that_of_the_servo_in_time() -> None:
    """The textbook's motor with play, stepped in time: the balance of twelve harmonics gives its amplitude and
    frequency to a tenth of a per cent, the describing function to some per cent.
    """
    (first,) = limit_cycles(servo_loop, 0.4, 0.1, 20.0)
    better = harmonic_balance(servo_loop, 0.4, first, 200.0)
    assert better is not None
    seen = steady_cycle(*servo_with_play(0.33, 0.2, 60_000), 0.01)
    assert seen is not None
    assert (better.amplitude, better.omega) == pytest.approx((seen.amplitude, seen.omega), rel=4e-3)
    assert abs(better.omega / seen.omega - 1) < 0.5 * abs(first.omega / seen.omega - 1)
    # one harmonic is the describing function again
    alone = harmonic_balance(servo_loop, 0.4, first, 200.0, count=1)
    assert alone is not None
    assert (alone.amplitude, alone.omega, alone.after) == pytest.approx(
        (first.amplitude, first.omega, first.after), rel=3e-3
    )
    assert harmonic_balance(lambda w: 0.01 * servo_loop(w), 0.4, first, 200.0) is None  # there is no cycle to find
    low = harmonic_balance(servo_loop, 0.4, first, 1.6 * first.omega)  # none but the first is below that
    assert low is not None and low.amplitude == pytest.approx(alone.amplitude)


# ---------------------------------------------------------------- in time


def test_a_ramp_is_drawn_in_straight_lines_between_the_demands() -> None:
    plant = replace(ServoPlant(), tick=2e-3)
    x, rate = ramp_demand([1.0, 2.0, 2.0, 0.5], plant)
    np.testing.assert_allclose(x[:5], 1.0)
    np.testing.assert_allclose(x[5:10], [1.2, 1.4, 1.6, 1.8, 2.0])
    np.testing.assert_allclose(x[15:], [1.7, 1.4, 1.1, 0.8, 0.5])
    np.testing.assert_allclose(rate[::5], [0.0, 100.0, 0.0, -150.0])
    assert x.size == rate.size == 20


def test_a_steady_cycle_is_the_sine_that_it_is() -> None:
    t = np.arange(0.0, 4.0, 1e-3)
    w = 2 * math.pi * 5.3
    sine = 0.7 + 0.02 * np.sin(w * t + 0.4)
    seen = steady_cycle(t, sine, 0.03)
    assert seen is not None
    assert (seen.amplitude, seen.omega, seen.after) == pytest.approx((0.02, w, 0.02), rel=2e-3)
    assert steady_cycle(t, sine, 0.0401) is None  # less than the smallest, peak to peak
    assert steady_cycle(t, sine, 0.0399) is not None
    # a third harmonic leaves the fundamental, and changes the peak
    square = sine + 0.02 / 3 * np.sin(3 * (w * t + 0.4))
    seen = steady_cycle(t, square, 0.01)
    assert seen is not None
    assert (seen.amplitude, seen.omega) == pytest.approx((0.02, w), rel=2e-3)
    assert seen.after == pytest.approx(0.5 * np.ptp(square[2000:]), rel=1e-6)
    # what came before the second half does not count; nor does noise near zero
    late = np.where(t < 2.0, 1.0, 0.0) + sine
    assert steady_cycle(t, late, 0.01) == pytest.approx(steady_cycle(t, sine, 0.01))
    wiggle = sine + 0.002 * np.sin(2 * math.pi * 171.0 * t)
    seen = steady_cycle(t, wiggle, 0.01)
    assert seen is not None and seen.omega == pytest.approx(w, rel=5e-3)
    # about the middle of its ends, also where it stays longer above
    long_up = np.maximum(np.sin(2 * math.pi * 5.0 * t), -0.5)
    seen = steady_cycle(t, np.where(np.sin(2 * math.pi * 5.0 * t) > -0.8, 1.0, -1.0) + 0.1 * long_up, 0.01)
    assert seen is not None and seen.omega == pytest.approx(2 * math.pi * 5.0, rel=1e-6)
    # a crossing without a swing below before it is none: here it is the first of three
    assert steady_cycle(t, np.where(t < 2.0, 0.0, np.sin(2 * math.pi * 1.3 * (t - 2.0) - 0.2)), 0.01) is None
    # two crossings are no oscillation yet, three are
    assert steady_cycle(t, np.where(t < 2.0, 0.0, np.sin(2 * math.pi * (t - 2.3))), 0.01) is None
    assert steady_cycle(t, np.where(t < 2.0, 0.0, np.sin(2 * math.pi * 1.6 * (t - 2.0) - 1.6)), 0.01) is not None


def first_principles(
    ref: np.ndarray, rate: np.ndarray, gains: Gains, plant: ServoPlant, bias: float, start: float, integral: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Stroke, what the LVDT shows and current of a linear loop: matrix exponential, PI and feed-forward by hand."""
    w, g = 2 * math.pi * plant.bandwidth, plant.flow_gain * math.sqrt(plant.pressure / plant.p_ref)
    lag = 1 / plant.lvdt_lag
    a = np.array([[0, 1, 0, 0], [-w * w, -2 * plant.damping * w, 0, 0], [g, 0, 0, 0], [0, 0, lag, -lag]])
    b = np.array([[0], [w * w / plant.rated_current], [0], [0]])
    e = expm(np.block([[a, b], [np.zeros((1, 5))]]) * plant.tick)
    s, pending = np.array([0.0, 0.0, start, start]), [0.0] * plant.delay
    out = np.empty((3, ref.size))
    for n in range(ref.size):
        error = ref[n] - s[3]
        integral += gains.ki * plant.tick * error
        i = gains.kp * error + integral + gains.kff * rate[n]
        out[:, n] = s[2], s[3], i
        pending.append(i)
        s = e[:4, :4] @ s + e[:4, 4] * (pending.pop(0) + bias)
    return out[0], out[1], out[2]


def test_the_simulation_is_the_linear_loop_while_nothing_saturates() -> None:
    plant = replace(ServoPlant(), pressure=18e6, delay=1, lvdt_lag=1.4e-3, bandwidth=50.0)
    ref, rate = ramp_demand(20e-3 + 1e-3 * np.clip(np.arange(12) - 2.0, 0.0, 4.0) / 4.0, plant)
    run = simulate(GAINS, plant, ref, rate, null_bias=2e-4, start=20.02e-3, integral=-1e-4, substeps=40)
    x, seen, i = first_principles(ref, rate, GAINS, plant, 2e-4, 20.02e-3, -1e-4)
    scale = np.ptp(x)
    np.testing.assert_allclose(run.x, x, atol=2e-3 * scale)
    np.testing.assert_allclose(run.x_lvdt, seen, atol=2e-3 * scale)
    np.testing.assert_allclose(run.i, i, atol=2e-3 * np.ptp(i))
    np.testing.assert_array_equal(run.x_dem, ref)
    np.testing.assert_allclose(run.t, np.arange(ref.size) * 1e-3)
    np.testing.assert_array_equal(run.x_vane, run.x)  # no play outside
    np.testing.assert_array_equal(run.play_in, run.x)


def test_play_stands_where_the_piston_came_from_below() -> None:
    ref = np.full(40, 24e-3)
    lvdt = simulate(Gains(1e-3, 0.0, 0.0), ServoPlant(), ref, play=Play("lvdt", 1e-3), start=24.2e-3)
    assert lvdt.x_lvdt[0] == pytest.approx(23.7e-3)  # the rod hangs half a gap behind
    assert lvdt.play_in[0] == lvdt.x[0] == 24.2e-3
    outside = simulate(Gains(1e-3, 0.0, 0.0), ServoPlant(), ref, outside=2e-3)
    assert outside.x_vane[0] == pytest.approx(23e-3) and outside.x_lvdt[0] == 24e-3
    valve = simulate(GAINS, ServoPlant(), ref, play=Play("valve", 4e-3), start=24e-3, null_bias=1.5e-3)
    assert np.ptp(valve.x) == 0.0 and valve.play_in[0] == 1.5e-3  # a current inside the hysteresis moves nothing
    weak = Gains(1e-3, 0.0, 0.0)
    wide = simulate(weak, ServoPlant(), ref, play=Play("valve", 4e-3), start=24e-3, null_bias=2.5e-3)
    free = simulate(weak, ServoPlant(), ref, start=24e-3, null_bias=0.5e-3)  # half the gap is lost
    assert wide.x[9] - 24e-3 == pytest.approx(free.x[9] - 24e-3, rel=1e-3) and wide.x[9] > 24.005e-3


def test_the_lvdts_noise_and_its_steps_are_in_what_the_firmware_reads() -> None:
    ref, plant = np.full(400, 24e-3), replace(ServoPlant(), lvdt_noise=3e-6, lvdt_step=1e-5)
    noisy = simulate(Gains(1e-3, 0.0, 0.0), plant, ref, noise_seed=3)
    np.testing.assert_allclose(noisy.x_lvdt - 24e-3, 3e-6 * np.random.default_rng(3).standard_normal(400), atol=2e-7)
    whole = simulate(Gains(1e-3, 0.0, 0.0), plant, ref + 4e-6, quantised=True, start=24.004e-3)
    assert whole.x_lvdt[0] == pytest.approx(24e-3, abs=1e-12)
    assert simulate(Gains(1e-3, 0.0, 0.0), plant, ref + 4e-6, start=24.004e-3).x_lvdt[0] == 24.004e-3


def test_the_motors_step_is_the_plants_own() -> None:
    from plant import build_plant, chain, places

    plant = plant_of_tables("plant_electromechanical.toml")
    step = plant.stepper(24e-3, 10)
    machine = build_plant("plant_electromechanical.toml")
    s = machine.start(24e-3, 80.0)
    for _ in range(20):
        xs = [step(0.02) for _ in range(10)]
        chain.drive_step(s, machine.p, 0, 0.02, 80.0, 21e6, 40.0)
        assert xs[-1] == pytest.approx(s[places.X, 0], abs=2e-6)
    assert xs[-1] - 24e-3 > 1e-3


# ---------------------------------------------------------------- figures of known runs


class Known:
    """In place of the simulation: runs that are known beforehand, and how each was asked for."""

    def __init__(self, *runs: Any) -> None:
        self.runs = list(runs)
        self.asked: list[tuple[tuple[Any, ...], dict[str, Any]]] = []

    def __call__(self, gains: Gains, plant: ServoPlant, *given: Any, **more: Any) -> Trajectory:
        self.asked.append((given, more))
        x, x_lvdt, i, vane, play_in = self.runs.pop(0)(np.asarray(given[0]))
        t = np.arange(len(given[0])) * plant.tick
        return Trajectory(t, np.asarray(given[0]), x, x_lvdt, vane, i, play_in)


def still(x: Any = None, x_lvdt: Any = None, i: Any = None, vane: Any = None, play_in: Any = None) -> Any:
    """A run of which only what is given moves, about the reference."""

    def of(ref: np.ndarray) -> tuple[np.ndarray, ...]:
        at, zero = np.full(ref.size, 24e-3), np.zeros(ref.size)
        return tuple(
            base.copy() if f is None else f(ref)
            for f, base in ((x, at), (x_lvdt, at), (i, zero), (vane, at), (play_in, at))
        )

    return of


def test_the_figures_of_a_step(monkeypatch: pytest.MonkeyPatch) -> None:
    def saturated(ref: np.ndarray) -> np.ndarray:
        i = np.zeros(ref.size)
        i[:52], i[60:63] = -0.040, 0.0399
        return i

    known = Known(
        still(x=lambda ref: np.where(np.arange(ref.size) == 700, 29.25e-3, 20e-3), i=saturated),
        still(x=lambda ref: np.where(np.arange(ref.size) == 70, 29.1e-3, 20e-3), x_lvdt=lambda ref: ref - 0.3e-3),
    )
    monkeypatch.setattr(servo_design, "simulate", known)
    curves: dict[str, Any] = {}
    plant = ServoPlant()
    f = servo_design._step_figures(GAINS, plant, curves)
    y = curves["step_linear"]
    inside = np.abs(y - 1.0) <= 0.05
    first = next(n for n in range(y.size) if inside[n:].all())
    assert f["settle_5_percent_ms"] == pytest.approx(first)
    assert f["rise_10_90_ms"] == pytest.approx(
        next(n for n in range(y.size) if y[n] >= 0.9) - next(n for n in range(y.size) if y[n] >= 0.1)
    )
    assert f["overshoot_percent"] == pytest.approx(100 * (y.max() - 1)) and f["overshoot_percent"] > 1.0
    assert (curves["step_t"].size, curves["step_t"][-1]) == (1000, pytest.approx(0.999))
    assert f["bare_10mm_overshoot_mm"] == pytest.approx(0.25)
    assert f["bare_10mm_saturated_ms"] == pytest.approx(52.0)
    assert f["drawn_10mm_overshoot_mm"] == pytest.approx(0.1)
    assert f["drawn_10mm_error_mm"] == pytest.approx(0.3)
    (bare, how), (drawn, drawn_how) = known.asked
    assert bare[0].size == 1000 and (bare[0] == 29e-3).all() and how == drawn_how == {"start": 19e-3}
    np.testing.assert_allclose(drawn[0], ramp_demand(np.minimum(19e-3 + 1e-3 * np.arange(100), 29e-3), plant)[0])
    assert drawn[1].max() == pytest.approx(0.1)


def test_an_overdamped_step_does_not_overshoot(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(servo_design, "simulate", Known(still(), still()))
    f = servo_design._step_figures(Gains(2.0, 0.0, 0.0), ServoPlant(), {})
    assert f["overshoot_percent"] == pytest.approx(0.0, abs=0.01)
    assert f["bare_10mm_overshoot_mm"] == f["drawn_10mm_overshoot_mm"] == 0.0
    # one slow pole, the root of 1 + L(s) beside -kp g / i_rated: 10 to 90 % in ln(9) of its time constant
    pole = brentq(lambda s: (1.0 + continuous_loop(Gains(2.0, 0.0, 0.0), ServoPlant())(s)).real, -12.0, -7.5)
    assert f["rise_10_90_ms"] == pytest.approx(1e3 * math.log(9) / -pole, abs=2.0)


def test_the_figures_of_a_ramp(monkeypatch: pytest.MonkeyPatch) -> None:
    def seen(ref: np.ndarray) -> np.ndarray:
        t = np.arange(ref.size) * 1e-3
        error = np.where((t >= 0.65) & (t < 0.70), -0.004e-3, 0.0)
        error[649] = error[700] = 0.09e-3
        error[200] = -0.12e-3
        return ref - error

    known = Known(still(x=lambda ref: ref + 0.02e-3, x_lvdt=seen))
    monkeypatch.setattr(servo_design, "simulate", known)
    curves: dict[str, Any] = {}
    f = servo_design._ramp_figures(GAINS, ServoPlant(), curves)
    assert f == pytest.approx(
        {"speed_mm_s": 20.0, "peak_error_mm": 0.12, "steady_error_mm": 0.004, "overshoot_mm": 0.02}, abs=1e-9
    )
    (ref, rate), _ = known.asked[0]
    assert ref.size == 1200 and (ref[0], ref[-1]) == pytest.approx((18e-3, 30e-3))
    assert sorted({round(v, 9) for v in rate}) == [0.0, 0.02] and np.sum(rate > 0.01) == 600
    assert curves["ramp"].x_dem is not None


def test_the_figures_of_a_bias(monkeypatch: pytest.MonkeyPatch) -> None:
    def moved(ref: np.ndarray) -> np.ndarray:
        x = np.full(ref.size, 24e-3)
        x[10], x[299], x[300:] = 23.94e-3, 24.00501e-3, 24.00499e-3
        return x

    known = Known(still(x=moved), still())
    monkeypatch.setattr(servo_design, "simulate", known)
    f = servo_design._bias_figures(GAINS, ServoPlant())
    assert f == pytest.approx({"current_ma": 1.0, "peak_mm": 0.06, "settled_s": 0.3}, abs=1e-9)
    assert servo_design._bias_figures(GAINS, ServoPlant())["settled_s"] == 0.0
    (ref,), how = known.asked[0]
    assert ref.size == 3000 and (ref == 24e-3).all() and how == {"null_bias": 1e-3}


def test_the_figures_at_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    plant = replace(ServoPlant(), lvdt_step=2e-6)

    def hunts(size: float) -> Any:
        def of(ref: np.ndarray) -> np.ndarray:
            a = np.zeros(ref.size)
            a[4999], a[5000], a[9999] = -9.0, size, -size
            return a

        return of

    def shakes(size: float) -> Any:
        return lambda ref: np.where(np.arange(ref.size) < 500, 7.0, size * (-1.0) ** np.arange(ref.size))

    known = Known(still(x=hunts(3e-6), i=hunts(2e-4)), still(x=shakes(4e-6), i=shakes(5e-4)))
    monkeypatch.setattr(servo_design, "simulate", known)
    assert servo_design._rest_figures(GAINS, plant) == pytest.approx(
        {"quantised_codes": 3.0, "quantised_current_ma": 0.4, "noisy_current_ma_rms": 0.5, "noisy_stroke_mm_rms": 0.004}
    )
    (quiet, how), (noisy, noisy_how) = known.asked
    assert quiet[0].size == 10_000 and noisy[0].size == 5000
    assert quiet[0][0] == noisy[0][0] == pytest.approx(24e-3 + 0.37 * 2e-6, abs=1e-12)
    assert how == {"quantised": True, "null_bias": 1e-3, "integral": -1e-3}
    assert noisy_how == {"quantised": True, "noise_seed": 1}
    monkeypatch.setattr(servo_design, "simulate", Known(still(), still()))
    assert servo_design._rest_figures(GAINS, replace(plant, lvdt_step=0.0))["quantised_codes"] == 0.0


def predicted() -> servo_design._Predicted:
    return servo_design._Predicted(
        LimitCycle(0.7, 2 * math.pi * 3.0, 0.4), LimitCycle(0.8, 2 * math.pi * 2.5, 0.5), LimitCycle(0.9, 1.0, 0.6)
    )


def sine(amplitude: float, hertz: float, middle: float = 0.0) -> Any:
    return lambda ref: middle + amplitude * np.sin(2 * math.pi * hertz * np.arange(ref.size) * 1e-3)


@pytest.mark.parametrize(("site", "unit"), [("lvdt", "mm"), ("valve", "mA")])
def test_the_figures_of_play_inside(site: str, unit: str, monkeypatch: pytest.MonkeyPatch) -> None:
    known = Known(still(play_in=sine(0.3e-3, 2.0), x_lvdt=sine(0.2e-3, 2.0, 24e-3)))
    monkeypatch.setattr(servo_design, "simulate", known)
    curves: dict[str, Any] = {}
    p = servo_design._play_figures(GAINS, ServoPlant(), Play(site, 0.4e-3), predicted(), curves)
    assert (p.site, p.unit, p.inside, p.grazing) == (site, unit, True, True)
    assert (p.gap, p.predicted_amplitude, p.harmonic_amplitude, p.without_integral) == pytest.approx(
        (0.4, 0.28, 0.32, 0.36)
    )
    assert (p.predicted_hz, p.harmonic_hz) == pytest.approx((3.0, 2.5))
    assert (p.simulated_amplitude, p.simulated_hz, p.simulated_lvdt_mm) == pytest.approx((0.3, 2.0, 0.2), rel=1e-3)
    (ref,), how = known.asked[0]
    assert ref.size == 16_000 and (ref == 24e-3).all() and how["play"] == Play(site, 0.4e-3)
    away = 0.28e-3
    assert (how["start"] - 24e-3, how["integral"]) == pytest.approx(
        (away, 0.0) if site == "lvdt" else (0.0, away), abs=1e-12
    )
    assert list(curves["play"]) == [site]


def test_play_of_no_width_or_no_prediction_is_said_so(monkeypatch: pytest.MonkeyPatch) -> None:
    none = servo_design._Predicted(None, None, None)
    known = Known(still(play_in=sine(1e-3, 2.0)), still(play_in=sine(1e-3, 2.0)), still(play_in=sine(3.9e-6, 2.0)))
    monkeypatch.setattr(servo_design, "simulate", known)
    p = servo_design._play_figures(GAINS, ServoPlant(), Play("lvdt", 0.0), predicted(), {})
    assert (p.predicted_amplitude, p.harmonic_amplitude, p.without_integral, p.simulated_amplitude) == (None,) * 4
    assert (p.predicted_hz, p.harmonic_hz, p.simulated_hz, p.grazing) == (None, None, None, False)
    p = servo_design._play_figures(GAINS, ServoPlant(), Play("lvdt", 0.4e-3), none, {})
    assert (p.predicted_amplitude, p.grazing) == (None, False) and p.simulated_amplitude == pytest.approx(1.0, rel=1e-3)
    assert known.asked[1][1]["start"] == pytest.approx(24.4e-3)  # a gap away, where nothing is predicted
    # below a fiftieth of the gap, peak to peak, it is no oscillation
    p = servo_design._play_figures(GAINS, ServoPlant(), Play("lvdt", 0.4e-3), predicted(), {})
    assert p.simulated_amplitude is None
    for amplitude, grazes in ((0.7499, True), (0.75, False)):
        monkeypatch.setattr(servo_design, "simulate", Known(still()))
        top = servo_design._Predicted(LimitCycle(amplitude, 1.0, 1.0), None, None)
        assert servo_design._play_figures(GAINS, ServoPlant(), Play("lvdt", 1e-3), top, {}).grazing is grazes


def test_the_figures_of_play_outside(monkeypatch: pytest.MonkeyPatch) -> None:
    known = Known(still(vane=sine(0.1e-3, 4.0, 24e-3)))
    monkeypatch.setattr(servo_design, "simulate", known)
    p = servo_design._play_figures(GAINS, ServoPlant(), Play("vanes", 1.5e-3), predicted(), {}, seconds=2.0)
    assert (p.inside, p.unit, p.predicted_amplitude, p.grazing) == (False, "mm", None, False)
    assert (p.gap, p.simulated_amplitude, p.simulated_hz, p.simulated_lvdt_mm) == pytest.approx(
        (1.5, 0.1, 4.0, 0.1), rel=1e-3
    )
    (ref, _), how = known.asked[0]
    assert how == {"outside": 1.5e-3} and ref.size == 2000
    early = still(vane=lambda ref: np.where(np.arange(ref.size) < ref.size // 2, 1.0, 0.0))
    monkeypatch.setattr(servo_design, "simulate", Known(early))
    p = servo_design._play_figures(GAINS, ServoPlant(), Play("vanes", 1.5e-3), predicted(), {}, seconds=2.0)
    assert p.simulated_lvdt_mm == 0.0  # of the second half
    assert (ref[100], ref[309], ref[-1]) == pytest.approx((24e-3, 28e-3, 26e-3), abs=1e-9)


def test_what_is_predicted_is_the_sampled_loops_own_cycle() -> None:
    gains, plant = Gains(10.0, 400.0, 0.0), ServoPlant()
    p = servo_design._predict(gains, plant)
    loop = sampled_loop(gains, plant)
    (cycle,) = limit_cycles(lambda w: frequency_response(loop, w), 1.0, 0.05, 0.9 * math.pi / 1e-3)
    assert p.plain == cycle and p.proportional is None
    assert p.harmonic is not None and p.harmonic.omega == pytest.approx(cycle.omega, rel=0.1)
    quiet = servo_design._predict(Gains(10.0, 0.0, 0.0), plant)
    assert (quiet.plain, quiet.harmonic) == (None, None)


FIGURES = {
    "_step_figures": {"overshoot_percent": 20.0},
    "_ramp_figures": {"peak_error_mm": 0.15, "steady_error_mm": 0.005},
    "_bias_figures": {"settled_s": 0.5},
    "_rest_figures": {"quantised_codes": 3.0},
}


def at_the_limits(
    monkeypatch: pytest.MonkeyPatch, hunting: dict[str, float], noise: float = 1e-3, **over: float
) -> None:
    """A design whose figures lie on the stated limits; ``hunting``: what each play makes, mm; ``over``: other
    figures.
    """
    for name, figures in FIGURES.items():
        found = {k: over.get(k, v) for k, v in figures.items()}
        monkeypatch.setattr(servo_design, name, lambda *_, found=found: found)
    monkeypatch.setattr(servo_design, "noise_current", lambda *_: noise)
    monkeypatch.setattr(servo_design, "_predict", lambda *_: predicted())

    def play(gains: Gains, plant: ServoPlant, p: Play, *_: Any) -> PlayFigures:
        amount = hunting[p.site]
        both = (amount, 0.0) if p.gap < 1e-3 else (0.0, amount)  # predicted, simulated
        return PlayFigures(p.site, 1e3 * p.gap, "mm", True, both[0], 1.0, None, None, both[1], 1.0, amount, None, False)

    monkeypatch.setattr(servo_design, "_play_figures", play)
    at = Margins(True, 10.0, 8.0, 50.0, 40.0, 0.86, 8.0, 46.0, 10.0, 1.4, 1.1, 20.0)
    worst = replace(at, sensitivity_peak=1.7)
    better = replace(at, gain_margin_db=9.0, phase_margin_deg=60.0, disk_margin=0.9)
    corners = [Corner(0.95, 1.0, 1.0, 21.0, 0, worst), Corner(1.05, 1.0, 1.0, 21.0, 1, better)]
    monkeypatch.setattr(servo_design, "analyse", lambda *_: (better, corners))


HUNTING = {"lvdt": 0.05, "valve": 0.05, "vanes": 1e-4}


def test_a_design_on_its_limits_keeps_them(monkeypatch: pytest.MonkeyPatch) -> None:
    at_the_limits(monkeypatch, HUNTING)
    r = design(GAINS, ServoPlant())
    assert r.ok and [c.name for c in r.checks if not c.ok] == []
    limits = Limits()
    assert [(c.value, c.limit, c.unit) for c in r.checks] == [
        (8.0, limits.gain_margin_db, "dB"), (50.0, limits.phase_margin_deg, "deg"), (0.86, limits.disk_margin, "-"),
        (1.0, 1.0, "mA"), (20.0, 20.0, "%"), (0.15, 0.15, "mm"), (0.005, 0.005, "mm"), (0.5, 0.5, "s"),
        (3.0, 3.0, "codes"), (0.05, 0.05, "mm"), (0.05, 0.05, "mm"), (1e-4, 1e-4, "mm"),
    ]  # fmt: skip
    low = Corner(0.95, 1.0, 1.0, 21.0, 0, r.nominal).describe()
    assert r.worst == {
        "gain_margin_db": 8.0, "phase_margin_deg": 50.0, "disk_margin": 0.86, "sensitivity_peak": 1.7
    }  # fmt: skip
    assert set(r.worst_at.values()) == {low} == {c.at for c in r.checks if c.at}
    assert [(p.site, p.gap) for p in r.play] == [
        ("lvdt", pytest.approx(0.02)), ("valve", pytest.approx(1.2)), ("vanes", pytest.approx(1.5))
    ]  # fmt: skip
    assert r.noise_current_ma == 1.0
    assert r.curves["omega"].size == r.curves["sampled"].size == r.curves["continuous"].size == 1200
    np.testing.assert_allclose(r.curves["sampled"][:50], r.curves["continuous"][:50], rtol=0.02)


@pytest.mark.parametrize(
    ("over", "name"),
    [
        ({"noise": 1.001e-3}, "current from LVDT noise, rms"),
        ({"overshoot_percent": 20.1}, "overshoot of a linear step"),
        ({"peak_error_mm": 0.151}, "greatest error on a 20 mm/s ramp"),
        ({"steady_error_mm": 0.0051}, "steady error on a 20 mm/s ramp"),
        ({"settled_s": 0.501}, "1 mA of null bias settled"),
        ({"quantised_codes": 3.1}, "hunting by the converter's steps"),
        ({"lvdt": 0.051}, "hunting by backlash at the LVDT"),
        ({"valve": 0.051}, "hunting by the valve's hysteresis"),
        ({"vanes": 1.1e-4}, "hunting by backlash outside the loop"),
    ],
)
def test_each_limit_is_held_alone(over: dict[str, float], name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    hunting = {k: over.get(k, v) for k, v in HUNTING.items()}
    at_the_limits(monkeypatch, hunting, **{k: v for k, v in over.items() if k not in HUNTING})
    inside = 1e-5 if "lvdt" not in over else 2e-3  # predicted, and simulated: the greater counts
    r = design(GAINS, ServoPlant(), backlash_inside=inside)
    assert [c.name for c in r.checks if not c.ok] == [name] and not r.ok


@pytest.mark.parametrize("name", ["gain_margin_db", "phase_margin_deg", "disk_margin"])
def test_each_margin_is_held_alone(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    at_the_limits(monkeypatch, HUNTING)
    limits = replace(Limits(), **{name: getattr(Limits(), name) + 1e-6})
    r = design(GAINS, ServoPlant(), limits)
    assert [c.limit for c in r.checks if not c.ok] == [getattr(limits, name)]
    assert r.limits is limits


def test_an_electric_actuator_has_no_valve_to_check(monkeypatch: pytest.MonkeyPatch) -> None:
    at_the_limits(monkeypatch, HUNTING)
    r = design(GAINS, replace(MOTOR, pressure=1.0, p_ref=1.0))
    assert [p.site for p in r.play] == ["lvdt", "vanes"] and len(r.checks) == 11 and r.ok


def test_of_an_unstable_corner_nothing_else_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    at_the_limits(monkeypatch, HUNTING)
    nominal, corners = servo_design.analyse(GAINS, ServoPlant())
    bad = replace(corners[1], margins=replace(corners[1].margins, stable=False))
    monkeypatch.setattr(servo_design, "analyse", lambda *_: (nominal, [corners[0], bad]))
    r = design(GAINS, ServoPlant())
    assert r.checks == [Check("stable at every corner", 0.0, 1.0, "-", False, bad.describe())]
    assert not r.ok and math.isnan(r.noise_current_ma) and r.step == r.rest == {} and r.play == []
    assert r.to_dict()["noise_current_ma"] is None


def test_a_result_is_json_without_what_json_cannot_hold(monkeypatch: pytest.MonkeyPatch) -> None:
    at_the_limits(monkeypatch, HUNTING)
    r = replace(
        design(GAINS, ServoPlant()),
        step={"a": math.inf, "b": np.float64(0.5)},  # type: ignore[dict-item]
        rest={"yes": np.bool_(True), "n": -math.inf},  # type: ignore[dict-item]
        noise_current_ma=math.nan,
    )
    d = r.to_dict()
    assert json.loads(json.dumps(d, allow_nan=False)) == d
    assert d["schema"] == 1 and "curves" not in d and d["noise_current_ma"] is None
    assert d["step"] == {"a": None, "b": 0.5} and d["rest"] == {"yes": True, "n": None}
    assert d["gains"] == {"kp": 12.0, "ki": 90.0, "kff": 0.2} and len(d["corners"]) == 2
    assert r.curves["omega"].size == 1200  # still there


def test_options_take_the_place_of_what_the_tables_say(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def seen(gains: Gains, plant: ServoPlant, **more: float) -> Any:
        asked.append((gains, plant, more["backlash_inside"]))
        return type("R", (), {"ok": len(asked) > 1})()

    monkeypatch.setattr(servo_design, "design", seen)
    base = default_gains()
    assert evaluate(kp=9.0, ki=0.0, backlash_inside=0.0)[1] == 1
    assert evaluate(kff=0.0, plant="plant_electromechanical.toml")[1] == 0
    assert evaluate(backlash_inside=10.0)[1] == 0
    assert asked[0][0] == Gains(9.0, 0.0, base.kff) and asked[0][1:] == (ServoPlant(), 0.0)
    assert asked[1][0] == replace(base, kff=0.0) and isinstance(asked[1][1], MotorServoPlant)
    assert asked[1][2] == 0.02e-3 and asked[2][2] == pytest.approx(10e-3)
    for mm in (-1e-6, 10.001, math.nan):
        with pytest.raises(InputError, match=r"backlash_inside \(=.* mm\) must be in \[0, 10\]"):
            evaluate(backlash_inside=mm)


def test_the_summary_says_every_check_and_every_play(monkeypatch: pytest.MonkeyPatch) -> None:
    at_the_limits(monkeypatch, {**HUNTING, "valve": 0.2})
    r: DesignResult = design(GAINS, ServoPlant())
    lines = summary(r)
    assert lines[0] == "gains: kp 12 mA/mm, ki 90 mA/(mm s), kff 0.2 mA/(mm/s)"
    assert lines[1] == (
        "nominal: crossover 10.0 Hz, gain margin 9.0 dB, phase margin 60.0 deg, disk margin 0.90, bandwidth 20.0 Hz"
    )
    assert lines[2].startswith("ok   gain margin, worst corner: 8 dB (limit 8, at flow -5%,")
    assert "MISS hunting by the valve's hysteresis: 0.2 mm (limit 0.05)" in lines
    assert len(lines) == 2 + len(r.checks) + len(r.play)
    assert lines[-3] == (
        "backlash of 0.02 mm between piston and LVDT: limit cycle predicted 0.05 mm at 1.00 Hz, with harmonics none, "
        "simulated 0 mm at 1.00 Hz"
    )


# ---------------------------------------------------------------- the trend filter


@pytest.mark.parametrize("name", ["acceleration", "noise", "step"])
def test_a_trend_model_needs_numbers_above_zero(name: str) -> None:
    for bad in (0.0, -1.0, math.inf, math.nan):
        with pytest.raises(InputError, match=rf"^{name} \(=.*\) must be above 0$"):
            tf.TrendModel(**{name: bad})
    assert tf.TrendModel(**{name: 1e-9})


def test_the_trends_model_is_its_equations() -> None:
    usual = tf.TrendModel()
    assert (usual.acceleration, usual.noise, usual.resolution, usual.step) == (0.3, 0.02, 0.002, 0.01)
    m = tf.TrendModel(acceleration=2.0, noise=0.03, resolution=0.06, step=0.1)
    assert m.sigma == pytest.approx(math.sqrt(0.03**2 + 0.06**2 / 12))
    f, h, q, r = m.matrices()
    np.testing.assert_allclose(f, [[1, 0.1], [0, 1]])
    np.testing.assert_allclose(h, [[1, 0]])
    g = np.array([[0.1**2 / 2], [0.1]])
    np.testing.assert_allclose(q, 4.0 * g @ g.T)
    np.testing.assert_allclose(r, [[m.sigma**2]])
    # alpha and beta by Kalata's tracking index, and what the filter settles to
    index = 2.0 * 0.1**2 / m.sigma
    alpha, beta = tracking_index_gain(m)
    assert index**2 == pytest.approx(beta**2 / (1 - alpha))
    assert beta == pytest.approx(2 * (2 - alpha) - 4 * math.sqrt(1 - alpha))
    assert tf.riccati_gain(m) == pytest.approx((alpha, beta), rel=1e-9)
    assert filterpy_gain(m) == pytest.approx((alpha, beta), rel=1e-9)


def test_a_filter_that_has_not_settled_is_stopped_by_its_steps() -> None:
    m = tf.TrendModel()
    assert filterpy_gain(m, steps=3) != pytest.approx(tf.riccati_gain(m), rel=1e-3)


def test_the_noise_of_the_rate_is_the_impulse_responses_energy() -> None:
    """White noise through a linear filter: the sum of the squares of its impulse response, and of neighbours."""
    alpha, beta, m = 0.2, 0.01, tf.TrendModel(noise=0.05, resolution=0.0, step=0.02)
    n = r = 0.0
    response = []
    for k in range(4000):
        e = (1.0 if k == 0 else 0.0) - (n + 0.02 * r)
        n, r = n + 0.02 * r + alpha * e, r + beta * e / 0.02
        response.append(r)
    h = np.array(response)
    sigma, rho = tf.rate_noise(alpha, beta, m)
    assert sigma == pytest.approx(0.05 * math.sqrt(h @ h), rel=1e-6)
    assert rho == pytest.approx((h[1:] @ h[:-1]) / (h @ h), rel=1e-6)
    # Rice: upward crossings of a level u sigma of either sign
    level = 1.7 * sigma
    expected = 2 * 3600 / 0.02 * math.acos(rho) / (2 * math.pi) * math.exp(-(1.7**2) / 2)
    assert tf.false_turns_per_hour(alpha, beta, level, m) == pytest.approx(expected)


def test_a_recommendation_is_the_filter_of_its_model() -> None:
    m = tf.TrendModel(acceleration=0.5, noise=0.03)
    d = tf.recommend(m, rate_on=0.07, change=0.4, hold=0.2, slowest=0.15)
    assert (d.alpha, d.beta) == pytest.approx(tf.riccati_gain(m))
    assert (d.rate_on, d.change, d.hold, d.slowest) == (0.07, 0.4, 0.2, 0.15)
    assert d.rate_noise == tf.rate_noise(d.alpha, d.beta, m)[0]
    assert d.false_turns == tf.false_turns_per_hour(d.alpha, d.beta, 0.07, m)
    assert d.clearance == pytest.approx((0.15 - 0.07) / d.rate_noise)
    # poles of z^2 + (alpha + beta - 2) z + 1 - alpha, seen as a continuous pair
    s = np.log(np.roots([1.0, d.alpha + d.beta - 2.0, 1.0 - d.alpha]).astype(complex)) / 0.01
    w = math.sqrt(abs(s[0]) * abs(s[1]))
    assert (d.bandwidth, d.damping) == pytest.approx((w, -s[0].real / w))
    default = tf.recommend()
    assert (default.rate_on, default.change, default.hold, default.slowest) == (0.06, 0.5, 0.1, 0.1)
    assert default.to_dict()["alpha"] == default.alpha and len(default.to_dict()) == 11


def test_the_estimates_start_at_rest_on_the_first_sample() -> None:
    m = tf.TrendModel()
    d = tf.recommend(m)
    leap = np.array([50.0, 51.0, 49.0, 49.5, 50.0])  # each of the first samples another
    for got, expected in zip(firmware_estimates(leap, d)[:2], filterpy_estimates(m, leap), strict=True):
        np.testing.assert_allclose(got, expected, atol=1e-10)
    assert firmware_estimates(leap, d)[0][0] == 50.0
    y = np.array([50.0, 50.0, 51.0, 51.0])
    n, rate = filterpy_estimates(m, y)
    assert (n[0], rate[0]) == (50.0, 0.0)
    assert (n[2], rate[2]) == pytest.approx((50.0 + d.alpha, d.beta / 0.01))
    got = firmware_estimates(y, d)
    np.testing.assert_allclose(got[0], n, atol=1e-12)
    np.testing.assert_allclose(got[1], rate, atol=1e-10)
    assert got[2].tolist() == [1.0] * 4


SLOW = replace(tf.recommend(), change=0.5, hold=0.1, rate_on=1e9)  # the change alone decides


def test_the_direction_turns_when_more_than_the_change_has_stood_for_the_hold() -> None:
    def turns(drop: float, design: tf.TrendDesign = SLOW) -> int | None:
        y = np.r_[np.full(20, 60.0), np.full(60, 60.0 - drop)]
        back = np.flatnonzero(tf.direction(y, design) < 0)
        return int(back[0]) - 20 if back.size else None

    assert turns(0.5) is None  # equal is not more
    assert turns(0.501) == 9  # the tenth sample in a row
    assert turns(0.501, replace(SLOW, hold=0.2)) == 19
    assert turns(0.501, replace(SLOW, hold=0.0)) == 0
    # with the rate, half of the change is enough
    fast = replace(SLOW, rate_on=0.0)
    assert turns(0.25, fast) is None and turns(0.2501, fast) is not None


def test_one_sample_alone_neither_sets_the_turn_nor_turns() -> None:
    y = np.full(100, 60.0)
    y[30] = 64.0  # one wrong demand upwards: the farthest demand stays 60
    assert (tf.direction(y, SLOW) == 1.0).all()
    y = np.r_[np.full(20, 60.0), np.full(2, 64.0), np.full(40, 60.0)]  # two in a row count
    assert (tf.direction(y, SLOW) == -1.0).sum() == 31
    falls = np.r_[[60.0], np.full(40, 59.4)]  # the first sample is the farthest demand, alone as it is
    assert (tf.direction(falls, SLOW) == -1.0).argmax() == 10
    rises = np.r_[[60.0, 63.0], np.full(40, 60.0)]
    assert (tf.direction(rises, SLOW) == 1.0).all()
    y = np.r_[np.full(20, 60.0), np.full(9, 59.0), [60.0], np.full(9, 59.0), np.full(5, 60.0)]
    assert (tf.direction(y, SLOW) == 1.0).all()  # a gap, and the hold begins anew
    # and back again, from the lowest that two in a row reached
    y = np.r_[np.full(20, 60.0), np.full(20, 59.0), np.full(20, 59.6)]
    d = tf.direction(y, SLOW)
    assert (np.flatnonzero(np.diff(d)) + 1).tolist() == [29, 49]
    np.testing.assert_array_equal(firmware_estimates(y, SLOW)[2], d)
