"""Laws that repeat themselves along a channel: their periods against closed forms, and from a log to a file that
another log takes.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from plant import Model
from tests.test_learn_periods import left_by
from tests.test_page import unpack
from vaneloop import Record, System, unknown
from vaneloop.base.durations import folded, period_in_name, within_no_period
from vaneloop.base.tables import read
from vaneloop.identification import StageError
from vaneloop.identification.unmodelled.python_law import python_law
from vaneloop.identification.unmodelled.regressors import quantities
from vaneloop.identification.unmodelled.spectral_lines import periods_along
from vaneloop.identification.user_models.bound_system import BoundSystem
from vaneloop.identification.user_models.exogenous_regressors import every
from vaneloop.identification.user_models.injection_points import from_file
from vaneloop.pages.learned import about, curve_figure
from vaneloop.verbs.learn import learn

SLOT = 2.0 * np.pi / 7.0

# ---- names


@given(st.floats(1e-12, 1e12), st.integers(4, 9))
def test_a_period_in_a_name_is_the_period(period: float, digits: int) -> None:
    name = f"shaft_angle_every_{period_in_name(period, digits)}"
    assert "." not in name
    channel, said = folded(name) or ("", 0.0)
    assert channel == within_no_period(name) == "shaft_angle"
    assert said == pytest.approx(period, rel=0.51 * 10.0 ** (1 - digits))


def test_other_names_are_folded_nowhere() -> None:
    for name in ("angle", "angle_every_day", "every_5", "angle_every_0", "angle_every_", "angle_every_1p"):
        assert folded(name) is None
    assert folded("time_every_20_s") == ("time", 20.0)
    assert folded(every(0.25, 10.0, "angle")) == ("angle", 0.25)


# ---- periods


def shaft(seed: int, n: int = 4000) -> tuple[np.ndarray, np.ndarray]:
    """A shaft that turns now faster and now slower, some 100 times, and sometimes back; time and angle."""
    rng = np.random.default_rng(seed)
    t = np.arange(n) * 0.005
    speed = np.repeat(rng.uniform(-10.0, 40.0, n // 100), 100)
    speed = np.convolve(speed, np.ones(50) / 50.0, mode="same")
    return t, np.cumsum(speed) * 0.005


@pytest.mark.parametrize("seed", range(6))
def test_what_pushes_seven_times_a_turn_is_found_in_how_the_speed_changes(seed: int) -> None:
    t, angle = shaft(seed)
    rng = np.random.default_rng(seed + 100)
    speed = np.cumsum(np.sin(7.0 * angle + 0.4)) * 0.005
    error = speed + 0.005 * rng.standard_normal(len(t))  # the ripple is some 0.01
    (found, *_) = periods_along([angle], [t], [error[None]], [np.zeros((0, len(t)))])
    turns = np.ptp(angle) / SLOT
    assert abs(turns * (found / SLOT - 1.0)) < 0.3  # turns of a slot over the whole way


@pytest.mark.parametrize("seed", range(6))
def test_a_pulley_out_of_centre_is_found_in_what_it_multiplies(seed: int) -> None:
    t, angle = shaft(seed)
    rng = np.random.default_rng(seed + 100)
    force = np.repeat(rng.standard_normal(200), 20)
    error = 0.2 * force * np.sin(angle + 0.4) + 0.1 * rng.standard_normal(len(t))
    (found, *_) = periods_along([angle], [t], [error[None]], [force[None]])
    assert abs(np.ptp(angle) / (2.0 * np.pi) * (found / (2.0 * np.pi) - 1.0)) < 0.3
    assert periods_along([angle], [t], [error[None]], [np.zeros((0, len(t)))]) == []  # of what it multiplies not told


@pytest.mark.parametrize("seed", range(6))
def test_noise_and_what_bends_slowly_have_no_period(seed: int) -> None:
    t, angle = shaft(seed)
    rng = np.random.default_rng(seed + 100)
    force = np.repeat(rng.standard_normal((2, 200)), 20, axis=1)
    wander = np.cumsum(rng.standard_normal(len(t)))
    bent = np.tanh((angle - angle.mean()) / np.std(angle))
    for error in (rng.standard_normal(len(t)), wander, bent + 0.1 * rng.standard_normal(len(t))):
        assert periods_along([angle], [t], [error[None]], [force]) == []
    hum = np.sin(2.0 * np.pi * 3.0 * t) + rng.standard_normal(len(t))
    assert periods_along([0.3 * t], [t], [hum[None]], [force]) == []  # it does what time does
    assert periods_along([0.0 * t], [t], [wander[None]], [force]) == []  # it stands still


# ---- from a log to a law


def derivative(x, u, p):  # type: ignore[no-untyped-def]
    return p.gain * u.voltage - p.drag * x.speed, x.speed


MOTOR = System(
    name="motor",
    kind="simulate",
    model=derivative,
    inputs={"voltage": "V"},
    states={"speed": "rad/s", "angle": "rad"},
    outputs={"angle": "rad", "speed": "rad/s"},
    rates={"speed": "angle"},
    between="hold",
    parameters=[unknown("gain", 2.0, "rad/(s^2 V)", low=0.0), unknown("drag", 1.0, "1/s", low=0.0)],
)


def turned(seed: int, name: str, out_of_centre: float = 0.0, cogs: float = 0.0, n: int = 2400) -> Record:
    """A motor whose encoder is out of centre, and that cogs seven times a turn."""
    rng = np.random.default_rng(seed)
    t = np.arange(n) * 0.005
    voltage = np.repeat(rng.uniform(4.0, 12.0, n // 100), 100)
    w, a, rows = 10.0, 0.0, []

    def rate(w: float, a: float, u: float) -> tuple[float, float]:
        return 3.0 * u - 1.2 * w - cogs * np.sin(7.0 * a), w

    for k in range(n):
        rows.append((a, w))
        for _ in range(4):  # Heun's
            h = 0.005 / 4
            dw, da = rate(w, a, voltage[k])
            ew, ea = rate(w + h * dw, a + h * da, voltage[k])
            w, a = w + 0.5 * h * (dw + ew), a + 0.5 * h * (da + ea)
    angle, speed = np.array(rows).T
    read = angle + out_of_centre * np.sin(angle + 0.7) + 0.001 * rng.standard_normal(n)
    return Record(name, t, {"voltage": voltage, "angle": read, "speed": speed + 0.02 * rng.standard_normal(n)})


@pytest.fixture(scope="module")
def eccentric():
    return learn([turned(1, "one", 0.02)], MOTOR, test=[turned(2, "two", 0.02)])


@pytest.mark.slow
def test_an_encoder_out_of_centre_is_learned_with_its_turn_and_size(eccentric) -> None:
    assert eccentric.verdict == "learned"
    (found,) = eccentric.laws
    assert within_no_period(found.name) == "angle_sensor.curve_of_angle"
    assert folded(found.of) == ("angle", pytest.approx(2.0 * np.pi, rel=2e-3))
    assert "within each 6.28" in eccentric.sentence() and "rad" in eccentric.sentence()
    assert np.ptp(found.y) == pytest.approx(0.04, rel=0.1)
    before, *_, after = (by["two"][0] for by in eccentric.by_log.steps.values())
    assert before > 0.01 and after < 0.0015


@pytest.mark.slow
def test_its_file_says_the_same_to_another_log_and_in_python(eccentric, tmp_path) -> None:
    eccentric.write(tmp_path / "law.toml")
    model = read(tmp_path / "law.toml", Model)
    (name,) = model.curves
    other = turned(3, "three", 0.02)
    own = {k: v for k, v in model.parameters.items() if not k.startswith("start_")}

    before, after = (left_by(MOTOR, m, other, own) for m in (Model(), model))
    assert before > 0.01 and after < 0.5 * before
    data = BoundSystem(MOTOR, [other]).data
    wrong = model.curves[name].model_copy(update={"of": "shaft_every_6p283"})
    with pytest.raises(StageError, match="shaft"):
        from_file(name, wrong, data)
    space: dict[str, object] = {}
    exec(python_law(eccentric.laws[0], MOTOR), space)
    space["test_curve"]()  # type: ignore[operator]
    curve, turn = space["curve"], folded(eccentric.laws[0].of)
    assert turn is not None
    assert curve(1.0) == pytest.approx(curve(1.0 + 5.0 * turn[1]), abs=1e-9)  # type: ignore[operator]


@pytest.mark.slow
def test_its_figure_goes_on_as_it_began(eccentric) -> None:
    (law,) = eccentric.laws
    parts = [line for line in curve_figure(law)["data"] if line["name"] == "the same again"]
    assert len(parts) == 2
    turn = law.x[-1] - law.x[0]
    for line in parts:
        x, y = (unpack(line[k]) for k in ("x", "y"))
        assert np.interp(x % turn, law.x, law.y) == pytest.approx(y, abs=0.01 * np.ptp(law.y))
    assert "stays as at its end" not in about(law) and "repeats itself" in about(law)


def test_a_channel_that_is_only_named_so_is_no_period() -> None:
    """A user's own channel, such as a counter that is read on every fifth cycle."""
    one = turned(1, "one", 0.02)
    told = Record(one.name, one.t, {**one.columns, "count_every_5": np.linspace(0.0, 100.0, len(one.t))})
    bound = BoundSystem(MOTOR, [told])
    (q,) = [q for q in quantities(bound, bound.stage.neutral()) if q.name == "count_every_5"]
    assert q.period == 0.0
    assert bound.data.column(0, "count_every_5")[-1] == 100.0


@pytest.fixture(scope="module")
def cogging():
    return learn([turned(1, "one", cogs=4.0)], MOTOR)


@pytest.mark.slow
def test_a_motor_that_cogs_is_told_its_slots(cogging) -> None:
    """What is simulated shifts its own phase: the law is a function of the angle that the model has with it."""
    assert cogging.verdict == "learned"
    (found,) = cogging.laws
    assert within_no_period(found.name) == "speed.curve_of_angle"
    assert folded(found.of) == ("angle", pytest.approx(SLOT, rel=1e-3))
    assert np.ptp(found.y) == pytest.approx(8.0, rel=0.1)
    assert cogging.by_log is not None


def test_a_motor_with_nothing_hidden_learns_nothing() -> None:
    assert learn([turned(1, "one")], MOTOR).laws == []
