"""The reusable laws: neutral parameters are an exact identity, and each law does what its name says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from vaneloop.identification.candidates import laws
from vaneloop.identification.candidates.laws import PARAMETERS
from vaneloop.identification.candidates.library import FORCE_LAWS, LAWS, SIGNAL_LAWS, STATE_LAWS, Law, Size

T = np.arange(0.0, 10.0, 0.01)
U = 2.0 * np.sin(1.3 * T) + 0.4 * np.sin(9.0 * T)
SIZE = Size(float(U.min()), float(U.max()), 2.0, 6.0, 0.01, 10.0, unit="V", force=3.0, speed=2.0, travel=2.0)


def row(law: Law, values: tuple[float, ...]) -> np.ndarray:
    out = np.zeros(PARAMETERS + 1)
    out[: len(values)] = values
    if law.constant:
        out[len(values)] = law.constant(SIZE)
    return out


def signal(name: str, *values: float, u: np.ndarray = U) -> np.ndarray:
    return laws.apply(SIGNAL_LAWS[name].code, T, u, row(SIGNAL_LAWS[name], values))


def force(
    name: str, values: tuple[float, ...], x: np.ndarray, v: np.ndarray, gap: float = 0.0, asymmetry: float = 0.0
) -> np.ndarray:
    memory = np.zeros(laws.MEMORY)
    law = FORCE_LAWS[name]
    p = row(law, values)
    return np.array(
        [laws.force_of(law.code, v[k], x[k], k == 0, p, gap, asymmetry, 0.0, memory) for k in range(len(x))]
    )


ALL = [(family, law) for family, by in LAWS.items() for law in by.values()]


@pytest.mark.parametrize(("family", "law"), ALL, ids=[f"{f}-{x.name}" for f, x in ALL])
def test_declared_parameters_hang_together(family: str, law: Law) -> None:
    parameters, starts = law.make(SIZE)
    assert 0 < len(parameters) <= PARAMETERS and starts
    assert law.text
    for p in parameters:
        assert p.low <= p.value <= p.high and p.unit
    for s in starts:
        assert len(s) == len(parameters)
        assert s != tuple(p.value for p in parameters)
        assert all(p.low <= v <= p.high for p, v in zip(parameters, s, strict=True)), (law.name, s)


def test_a_state_that_runs_away_leaves_the_laws_numbers_finite() -> None:
    """A model whose first fit ends in the void: 1e200 is no size of anything."""
    from vaneloop import Record, System, unknown
    from vaneloop.identification.user_models.codegen import Dispatch
    from vaneloop.identification.user_models.data import Data
    from vaneloop.identification.user_models.injection_points import Course, places

    system = System(
        name="s", kind="simulate", model=lambda x, u, p: (p.a * x.level + u.pump, x.level - x.other),
        inputs={"pump": "V"}, states={"level": "cm", "other": "cm"}, outputs={"level": "cm"},
        parameters=[unknown("a", 1.0, "1/s")],
    )  # fmt: skip
    t = np.arange(0.0, 5.0, 0.01)
    record = Record("log", t, {"pump": np.ones_like(t), "level": np.cos(t)})
    data = Data(system, [record])
    course = Course([[np.exp(np.minimum(140.0 * t, 690.0))], [np.full_like(t, 1e300)]], [])
    _, effects = places(data, course, Dispatch())
    assert {e.name.split(".")[0] for e in effects} >= {"level", "other"}
    for e in effects:
        numbers = [v for p in e.parameters for v in (p.low, p.value, p.high)] + [v for s in e.starts for v in s]
        assert np.isfinite(numbers).all(), e.name


@pytest.mark.parametrize("factor", [1e-6, 1e6])
@pytest.mark.parametrize(("family", "law"), ALL, ids=[f"{f}-{x.name}" for f, x in ALL])
def test_bounds_follow_the_data_whatever_the_unit(family: str, law: Law, factor: float) -> None:
    scaled = Size(
        SIZE.low * factor, SIZE.high * factor, 2.0 * factor, 6.0 * factor, 0.01, 10.0, force=3.0, speed=2.0, travel=2.0
    )
    for p, q in zip(law.make(SIZE)[0], law.make(scaled)[0], strict=True):
        assert q.low <= q.value <= q.high
        if p.unit in ("V", "(V)/s") and p.high:
            assert q.high / p.high == pytest.approx(factor)


@pytest.mark.parametrize("name", SIGNAL_LAWS)
def test_neutral_signal_law_is_an_exact_identity(name: str) -> None:
    neutral = tuple(p.value for p in SIGNAL_LAWS[name].make(SIZE)[0])
    np.testing.assert_array_equal(signal(name, *neutral), U)


@pytest.mark.parametrize("name", FORCE_LAWS)
def test_neutral_force_law_adds_nothing(name: str) -> None:
    neutral = tuple(p.value for p in FORCE_LAWS[name].make(SIZE)[0])
    assert not force(name, neutral, U, np.gradient(U, T)).any()


@pytest.mark.parametrize("name", STATE_LAWS)
def test_neutral_state_law_takes_nothing_off(name: str) -> None:
    law = STATE_LAWS[name]
    neutral = row(law, tuple(p.value for p in law.make(SIZE)[0]))
    assert all(laws.state_rate(law.code, x, neutral) == 0.0 for x in (-1.0, 0.0, 0.7))


def test_static_signal_laws() -> None:
    u = np.array([-2.0, -0.3, 0.0, 0.3, 2.0])
    t = np.arange(5.0)

    def law(name: str, *values: float) -> list[float]:
        return list(laws.apply(SIGNAL_LAWS[name].code, t, u, row(SIGNAL_LAWS[name], values)))

    assert law("bias", 0.5) == [-1.5, 0.2, 0.5, 0.8, 2.5]
    assert law("gain", 2.0) == [-4.0, -0.6, 0.0, 0.6, 4.0]
    assert law("asymmetric_gain", 0.5) == [-1.0, -0.15, 0.0, pytest.approx(0.45), 3.0]
    assert law("absolute_value", 1.0) == [2.0, 0.3, 0.0, 0.3, 2.0]
    assert law("dead_zone", 0.5) == [-1.5, 0.0, 0.0, 0.0, 1.5]
    assert law("saturation", -1.0, 1.5) == [-1.0, -0.3, 0.0, 0.3, 1.5]
    assert law("cubic", 0.1) == pytest.approx([-2.8, -0.3027, 0.0, 0.3027, 2.8])
    assert law("quantisation", 0.5) == [-2.0, -0.5, 0.0, 0.5, 2.0]
    assert law("smooth_saturation", 1.0) == pytest.approx(np.tanh(u))
    big = SIZE.greatest
    assert law("square_root", 1.0) == pytest.approx(np.sign(u) * np.sqrt(np.abs(u) * big))


def test_play_holds_its_width_and_is_rate_independent() -> None:
    y = signal("play", 0.6)
    assert np.max(np.abs(U - y)) == pytest.approx(0.3)
    slow = laws.apply(SIGNAL_LAWS["play"].code, 7.0 * T, U, row(SIGNAL_LAWS["play"], (0.6,)))
    np.testing.assert_array_equal(y, slow)


def test_rate_limit_never_moves_faster_and_catches_up() -> None:
    step = np.where(T > 1.0, 1.0, 0.0)
    y = signal("rate_limit", 0.5, u=step)
    assert np.max(np.abs(np.diff(y))) <= 0.5 * 0.01 + 1e-12
    assert y[np.searchsorted(T, 2.0)] == pytest.approx(0.5, abs=0.01)
    assert y[-1] == 1.0


def test_lag_is_the_exact_first_order_answer() -> None:
    ramp = 2.0 * T
    y = signal("lag", 0.7, u=ramp)
    np.testing.assert_allclose(y, 2.0 * (T - 0.7 * (1.0 - np.exp(-T / 0.7))), atol=1e-9)


def test_second_order_lag_rings_at_its_frequency() -> None:
    step = np.where(T >= 0.5, 1.0, 0.0)
    y = signal("second_order_lag", 0.1, 0.2, u=step)
    peak = 1.0 + np.exp(-np.pi * 0.2 / np.sqrt(1 - 0.04))
    assert y.max() == pytest.approx(peak, abs=0.01)
    assert T[int(np.argmax(y))] - 0.5 == pytest.approx(np.pi * 0.1 / np.sqrt(1 - 0.04), abs=0.015)


def test_dead_time_shifts_and_changes_nothing_else() -> None:
    y = signal("dead_time", 0.255)
    np.testing.assert_allclose(y[26:], np.interp(T[26:] - 0.255, T, U), atol=1e-12)
    assert np.all(y[:25] == U[0])


def test_laws_look_at_no_later_sample() -> None:
    late = U.copy()
    late[600:] += 5.0
    for name, law in SIGNAL_LAWS.items():
        values = law.make(SIZE)[1][0]
        np.testing.assert_array_equal(signal(name, *values)[:600], signal(name, *values, u=late)[:600])


def test_friction_opposes_motion_and_differs_with_direction() -> None:
    v = np.array([-2.0, -0.1, 0.0, 0.1, 2.0])
    x = np.zeros(5)
    assert list(force("coulomb", (3.0,), x, v)) == [-3.0, -3.0, 0.0, 3.0, 3.0]
    assert list(force("coulomb", (3.0,), x, v, asymmetry=-0.2)) == pytest.approx([-3.6, -3.6, 0.0, 2.4, 2.4])
    smooth = force("smooth_coulomb", (3.0, 0.1), x, v)
    assert smooth == pytest.approx(3.0 * np.tanh(v / 0.1))
    s = force("stribeck", (3.0, 1.0, 0.1), x, v)
    assert s[4] == pytest.approx(3.0) and s[3] == pytest.approx(3.0 + np.exp(-1.0))
    assert list(force("viscous", (3.0,), x, v)) == pytest.approx(3.0 * v)
    assert list(force("quadratic_drag", (3.0,), x, v)) == pytest.approx(3.0 * v * np.abs(v))
    assert list(force("force_offset", (-1.0,), x, v)) == [-1.0] * 5


@pytest.mark.parametrize(("name", "values"), [("elastic_plastic", (50.0, 3.0)), ("bouc_wen", (50.0, 3.0, 2.0))])
def test_hysteretic_friction(name: str, values: tuple[float, ...]) -> None:
    x = np.concatenate([np.linspace(0, 2, 400), np.linspace(2, -2, 800), np.linspace(-2, 2, 800)])
    v = np.gradient(x)
    f = force(name, values, x, v)
    assert f.max() == pytest.approx(3.0, rel=0.01) and f.min() == pytest.approx(-3.0, rel=0.01)
    assert (f[1] - f[0]) / (x[1] - x[0]) == pytest.approx(50.0, rel=0.05)  # starts unloaded, at its stiffness
    assert np.sum(0.5 * (f[1200:] + f[1199:-1]) * np.diff(x[1199:])) > 0.0  # takes energy
    # lost motion: after a reversal the force stays zero over the gap
    g = force(name, values, x, v, gap=0.5)
    zero = np.abs(g[400:1200]) < 1e-6
    assert np.ptp(x[400:1200][zero]) == pytest.approx(0.5, abs=0.02)
    # rate-independent: the path counts, not the speed
    np.testing.assert_array_equal(f, force(name, values, x, 3.0 * v))
    h = force(name, values, x, v, asymmetry=0.25)
    assert h.max() == pytest.approx(3.75, rel=0.01) and h.min() == pytest.approx(-2.25, rel=0.01)


def test_springs_and_their_gap() -> None:
    x = np.array([-2.0, -0.2, 0.0, 0.2, 2.0])
    assert list(force("spring", (4.0,), x, x)) == pytest.approx(4.0 * x)
    assert list(force("spring", (4.0,), x, x, gap=1.0)) == pytest.approx([-6.0, 0.0, 0.0, 0.0, 6.0])
    assert list(force("cubic_spring", (4.0,), x, x)) == pytest.approx(4.0 * x**3)


def test_an_end_stop_pushes_back_beyond_its_ends_only() -> None:
    x = np.array([-2.0, -0.5, 0.0, 1.0, 1.5])
    assert list(force("end_stop", (10.0, -0.5, 1.0), x, x)) == pytest.approx([-15.0, 0.0, 0.0, 0.0, 5.0])


def test_a_square_keeps_the_greatest_value_and_loses_the_sign() -> None:
    g = SIZE.greatest
    assert list(signal("square", 1.0, u=np.array([-g, 0.0, 0.5 * g]))) == pytest.approx([g, 0.0, 0.25 * g])


@pytest.mark.parametrize(("unit", "zero"), [("degC", 273.15), ("K", 0.0), ("degF", 459.67)])
def test_a_body_radiates_as_stefan_and_boltzmann_say(unit: str, zero: float) -> None:
    z = replace(SIZE, low=300.0, high=400.0, unit=unit)
    alone, to = STATE_LAWS["radiation"], STATE_LAWS["radiation_to"]
    assert alone.constant is not None and to.constant is not None
    lost = laws.state_rate(alone.code, 350.0, np.array([2e-12, 310.0, alone.constant(z)]))
    assert lost == pytest.approx(2e-12 * ((350.0 + zero) ** 4 - (310.0 + zero) ** 4))
    assert laws.state_rate(to.code, 350.0, np.array([2e-12, to.constant(z)]), 310.0) == pytest.approx(lost)
    assert laws.state_rate(to.code, 310.0, np.array([2e-12, to.constant(z)]), 310.0) == 0.0
    for law in (alone, to):
        (size, *_), starts = law.make(z)
        assert size.low == 0.0 < starts[0][0] < starts[-1][0] < size.high and law.suits(unit) and not law.suits("V")


def test_a_rise_in_kelvin_is_one_over_a_room() -> None:
    constant = STATE_LAWS["radiation"].constant
    assert constant is not None
    assert constant(replace(SIZE, low=0.0, high=80.0, unit="K")) == 293.15
    assert constant(replace(SIZE, low=280.0, high=360.0, unit="K")) == 0.0


def test_state_laws() -> None:
    rate = {
        n: [laws.state_rate(law.code, x, np.array([2.0, 0.0, 0.0, 0.0])) for x in (-4.0, 4.0)]
        for n, law in STATE_LAWS.items()
    }
    assert rate["offset"] == [2.0, 2.0]
    assert rate["leak"] == [-8.0, 8.0]
    assert rate["square_root"] == [-4.0, 4.0]
    assert rate["quadratic_drag"] == [-32.0, 32.0]
    assert rate["cubic"] == [-128.0, 128.0]


# ---- what sticks -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["stiction", "stick_slip"])
@pytest.mark.parametrize("begin", [-1.0, 0.0, 0.7])
def test_stiction_without_a_jump_is_play(name: str, begin: float) -> None:
    np.testing.assert_allclose(signal(name, 0.8, 0.0, begin), signal("play", 0.8, begin), atol=1e-12)


@pytest.mark.parametrize("jump", [0.2, 0.6, 1.0])
def test_a_valve_that_sticks_breaks_away_after_its_width_and_jumps(jump: float) -> None:
    width = 1.0
    u = np.concatenate([np.linspace(0.0, 5.0, 501), np.linspace(5.0, 0.0, 501)[1:]])
    for name in ("stiction", "stick_slip"):
        y = laws.apply(SIGNAL_LAWS[name].code, np.arange(len(u)) * 0.01, u, np.array([width, jump, 0.0, 0.0]))
        assert np.all(np.abs(u - y) <= 0.5 * width * (1.0 + jump) + 1e-9)  # static friction holds no more
    y = laws.apply(laws.STICTION, np.arange(len(u)) * 0.01, u, np.array([width, jump, 0.0, 0.0]))
    back = y[500:]
    first = int(np.flatnonzero(np.diff(back))[0])  # after turning it rests over the width
    assert u[500] - u[500 + first] == pytest.approx(width, abs=0.011)
    assert back[first] - back[first + 1] == pytest.approx(jump * width, abs=0.021)  # and jumps
    slides = np.diff(back[first + 1 :])
    np.testing.assert_allclose(slides, np.diff(u[500 + first + 1 :]), atol=1e-9)  # and then slides with its command


@pytest.mark.parametrize("times", [2, 6, 25])
def test_a_command_that_a_log_repeats_has_not_stopped(times: int) -> None:
    rng = np.random.default_rng(1)
    u = np.cumsum(rng.standard_normal(400))
    u[100:110] = u[100]  # here it stops, whatever the log's raster
    u[110:130] = u[100] + 0.1 * np.arange(1, 21)  # and creeps on
    often = np.repeat(u, times)

    def moved(values: np.ndarray, step: float, held: float) -> np.ndarray:
        law = SIGNAL_LAWS["stiction"]
        assert law.constant is not None
        p = np.array([1.5, 0.5, 0.2, law.constant(replace(SIZE, step=step, held=held))])
        return np.asarray(laws.apply(law.code, step * np.arange(len(values)), values, p))

    once = moved(u, 1.0, 1.0)
    np.testing.assert_array_equal(moved(often, 1.0 / times, 1.0)[times - 1 :: times], once)
    assert np.ptp(once[100:117]) == 0.0 and once[129] > once[100]  # stopped, it moves again beyond the jump only


@pytest.mark.parametrize("start", [(0.8, 0.0), (0.8, 0.7), (3.0, -0.4)])
def test_where_stiction_begins_from_play_it_slides_as_far_behind_and_stands_at_the_same_place(
    start: tuple[float, float],
) -> None:
    stiction = SIGNAL_LAWS["stiction"]
    assert stiction.onward is not None and stiction.holds is not None and stiction.holds[0] == "play"
    ways = stiction.onward(start)
    u = np.linspace(0.0, 50.0, 5001)
    play = laws.apply(laws.PLAY, np.arange(len(u)) * 0.01, u, np.array([*start, 0.0, 0.0]))
    for values in ways[::2]:
        y = laws.apply(laws.STICTION, np.arange(len(u)) * 0.01, u, np.array([*values, 0.0]))
        assert y[0] == pytest.approx(play[0]) and y[-1] == pytest.approx(play[-1])
    assert {values[1] for values in ways} == {0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8}


def test_a_stem_that_sticks_again_at_once_moves_in_stairs() -> None:
    u = np.linspace(0.0, 5.0, 501)
    y = laws.apply(laws.STICK_SLIP, np.arange(501) * 0.01, u, np.array([1.0, 0.5, 0.0, 0.0]))
    steps = np.diff(y)
    np.testing.assert_allclose(steps[steps != 0.0][1:], 0.5, atol=0.011)  # each the jump
    assert np.count_nonzero(steps) == pytest.approx(5.0 / 0.5, abs=2)


@pytest.mark.parametrize(
    ("name", "values"),
    [("bias", (0.4,)), ("gain", (1.3,)), ("asymmetric_gain", (0.2,)), ("cubic", (0.05,)), ("square_root", (0.5,))],
)
def test_the_argument_of_a_law_is_what_it_reads(name: str, values: tuple[float, ...]) -> None:
    law = SIGNAL_LAWS[name]
    p = row(law, values)
    for x in (0.3, 1.1, 1.9):
        y = laws.apply(law.code, np.zeros(1), np.array([x]), p)[0]
        assert laws.argument(law.code, y, p) == pytest.approx(x, rel=1e-6)
