"""A user's own model against logs whose answer a closed form knows: what is taken in, what noise and motion they hold,
which parameters and starts suit them, and what a curve does at each place.
"""

from __future__ import annotations

import math
import re
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import scipy
from numba.core.compiler import run_frontend
from scipy.stats import qmc

from hil.logs.notes import Note
from plant.model import Learned
from vaneloop.base.errors import InputError
from vaneloop.base.hysteresis import STOPS
from vaneloop.identification import Parameter, Record, StageError, System, unknown
from vaneloop.identification.candidates.library import Size
from vaneloop.identification.least_squares.problem import LeastSquaresProblem
from vaneloop.identification.results import StageDiagnosis
from vaneloop.identification.selection.diagnosis import diagnose_stage
from vaneloop.identification.settings import COARSE_STOPS, LEVEL_SPREAD
from vaneloop.identification.subsystem import Array
from vaneloop.identification.user_models import bound_system, by_log, experiment, terms
from vaneloop.identification.user_models import motion as motion_of
from vaneloop.identification.user_models.bound_system import BoundSystem, steps_seen
from vaneloop.identification.user_models.by_log import ByLog, Logs, _loaded, as_given, bind, parameter_warnings
from vaneloop.identification.user_models.codegen import try_law
from vaneloop.identification.user_models.data import Data, noise_of_channel, noise_of_neighbours, spikes, without_order
from vaneloop.identification.user_models.exogenous_regressors import (
    column_of,
    every,
    forgotten,
    share_given_back,
    sides_of,
    swings,
)
from vaneloop.identification.user_models.experiment import (
    SHAPES,
    Limits,
    _Bench,
    _Parameters,
    _Rivals,
    driven,
    recommend,
)
from vaneloop.identification.user_models.injection_points import _size, nominal_course
from vaneloop.identification.user_models.motion import differentiated_to, highest_frequency, low_pass, motion, smoothed
from vaneloop.identification.user_models.system import Law
from vaneloop.identification.user_models.user_code import UserCode, _ends, cannot, load_system

# docs/settings.md
LEAST_SAMPLES, LEAST_POINTS, INPUT_NAN = 50, 12, 0.2
FORCE_SHARE, FLAT_TO, MOVES = 0.9995, 3.0, 0.3
WIDE, GIVEN, START_WITHIN = 4.0, 12.0, 3.0
NO_HELP = 0.85

T = 0.1 * np.arange(60)  # s


def white(seed: int, n: int) -> Array:
    return np.random.default_rng(seed).standard_normal(n)


def gain(u: Any, p: Any) -> Any:
    return p.a * u.u


def mapping(**more: Any) -> System:
    given: dict[str, Any] = {
        "model": gain, "outputs": {"y": "V"}, "inputs": {"u": "A"}, "parameters": [unknown("a", 1.0, "V/A")],
    }  # fmt: skip
    return System("map", "static", **given | more)


def mover(**more: Any) -> System:
    """A mass and a damper whose force is measured with its displacement ``x`` (mm)."""
    given: dict[str, Any] = {
        "outputs": {"f": "N"}, "position": "x", "units": {"position": "mm"},
        "parameters": [unknown("m", 1.0, "kg"), unknown("c", 1.0, "N s/m")],
    }  # fmt: skip
    return System("mover", "force", lambda u, p: p.m * u.acceleration + p.c * u.velocity, **given | more)


def turning(**more: Any) -> System:
    """A shaft: its angle follows its speed, which an input drives and a damper brakes."""
    given: dict[str, Any] = {
        "outputs": {"angle": "rad"}, "inputs": {"u": "A"}, "states": {"angle": "rad", "speed": "rad/s"},
        "rates": {"speed": "angle"}, "parameters": [unknown("c", 0.5, "1/s")],
    }  # fmt: skip
    return System("shaft", "simulate", lambda x, u, p: (x.speed, u.u - p.c * x.speed), **given | more)


def record(t: Array = T, name: str = "log", begin: float = 0.0, ordered: bool = True, **columns: Any) -> Record:
    return Record(name, t, {k: np.asarray(v, dtype=float) for k, v in columns.items()}, begin, (), ordered)


def put(values: Array, at: Any, value: float = np.nan) -> Array:
    out = np.array(values, dtype=float)
    out[at] = value
    return out


# ---- what a log must be ----------------------------------------------------------------------------------------------

U, Y = np.sin(T), 2.0 * np.sin(T)


@pytest.mark.parametrize(
    ("system", "log", "said"),
    [
        (mapping(), record(u=U, yy=Y), "log: no channel 'y', which system 'map' needs; close: yy; the log has u, yy"),
        (mapping(), record(T[:11], u=U[:11], y=Y[:11]), "log: 11 samples; at least 12 are needed"),
        (mover(), record(T[:49], x=U[:49], f=Y[:49]), "log: 49 samples; at least 50 are needed"),
        (mapping(), record(T[None], u=U, y=Y), "log: 60 samples; at least 12 are needed"),
        (mapping(), record(put(T, 7, T[6]), u=U, y=Y), "log: time must rise from sample to sample"),
        (mapping(), record(put(T, 59, np.inf), u=U, y=Y), "log: time must rise from sample to sample"),
        (mapping(), record(put(T, 59, 2e60), u=U, y=Y), "log: time reaches 2e+60 s; allowed: 1e+60"),
        (mapping(), record(u=put(U, 3, 2e60), y=Y), "log: channel 'u' reaches 2e+60; allowed: 1e+60"),
        (mapping(), record(u=U, y=Y[1:]), "log: channel 'y' has shape (59,); (60,) is needed, as the time has"),
        (
            mapping(), record(u=put(U, slice(20, 33)), y=Y),
            "log: channel 'u': 13 of 60 samples are NaN; an input may lack 20 % at most",
        ),
        (
            turning(window=1.0, outputs={"angle": "rad"}, rates={}), record(u=U, angle=Y),
            "system 'shaft': window= needs state 'speed' measured at every start; the log has u, angle (name a channel "
            "like it, or declare it in rates= as the rate of a measured one)",
        ),
    ],
)  # fmt: skip
def test_a_log_that_a_system_cannot_take_gets_one_line(system: System, log: Record, said: str) -> None:
    with pytest.raises(StageError) as e:
        Data(system, [log]).restarts(0, 60)
    assert str(e.value) == said


def test_a_log_is_taken_up_to_the_limits_that_the_lines_name() -> None:
    n = LEAST_POINTS
    d = Data(mapping(), [record(T[:n] + 5.0, u=put(U[:n], 0, 1e60), y=Y[:n], begin=2.0)])
    assert d.records[0].t[0] == 0.0 and d.times[0] == pytest.approx(T[:n] + 2.0) and d.u[0][0, 0] == 1e60
    assert Data(mover(), [record(T[:LEAST_SAMPLES], x=U[:LEAST_SAMPLES], f=Y[:LEAST_SAMPLES])]).ordered
    gap = slice(20, 20 + round(INPUT_NAN * len(T)))
    d = Data(mapping(), [record(u=put(3.0 * T, gap), y=put(Y, gap))])
    assert d.u[0][0] == pytest.approx(3.0 * T) and np.isnan(d.y[0][0, gap]).all()
    (note,) = d.notes
    assert note == "log: u: 12 NaN filled from their neighbours"
    assert isinstance(note, Note) and (note.kind, note.of, note.number) == ("filled", "u", 12)
    assert note.rows == tuple(range(21, 33))
    with pytest.raises(StageError, match="system 'map': no log"):
        Data(mapping(), [])


def test_a_log_counts_from_where_all_that_drives_the_model_is_known_to_where_the_first_of_it_ends() -> None:
    system = mapping(inputs={"u": "A", "w": "A"}, outputs={"y": "V"})
    log = record(T + 1.0, u=put(U, slice(0, 4)), w=put(put(U, slice(0, 2)), slice(54, 60)), y=Y, begin=7.0)
    d = Data(system, [log])
    assert len(d.t) == LEAST_SAMPLES and d.times[0][[0, -1]] == pytest.approx([7.4, 7.0 + T[53]])
    assert d.records[0].t == pytest.approx(T[:50]) and d.measured[0] == pytest.approx(Y[4:54])
    assert d.notes == ["log: 10 samples at its ends, where what drives the model is not known, do not count"]
    shorter = Data(system, [record(u=put(U, slice(0, 5)), w=put(U, slice(54, 60)), y=Y)])  # too few would be left
    assert len(shorter.t) == 60 and shorter.u[0][0, 0] == U[5] and shorter.u[0][1, -1] == U[53]


def test_logs_follow_each_other_on_one_time_axis_under_names_of_their_own() -> None:
    a, b = record(u=U, y=Y), record(2.0 * T, u=U, y=Y, begin=3.0)
    d = Data(mapping(), [a, b, a])
    assert list(d.logs) == ["log", "log'", "log''"] and d.logs["log'"] == slice(60, 120)
    assert d.t == pytest.approx(np.concatenate([T, 6.0 + 2.0 * T, 18.0 + T]))
    assert list(Data(mapping(), [a], like=d).logs) == ["log'''"]
    conditions, units = d.regimes()
    assert list(conditions) == ["time", "u", "y", "log"]
    assert units == {"time": "s", "u": "A", "y": "V", "log": ""}
    assert conditions["log"].tolist() == [1.0] * 60 + [2.0] * 60 + [3.0] * 60
    assert np.array_equal(conditions["u"], np.tile(U, 3))  # rows of a static model may be in any order
    noisy = U + 0.01 * white(1, 60)
    moving = Data(turning(), [record(u=noisy, angle=Y)]).regimes()[0]
    assert not np.array_equal(moving["u"], noisy) and moving["u"] == pytest.approx(U, abs=0.1)
    assert list(Data(mapping(), [record(u=U, y=put(Y, 3), ordered=False)]).regimes()[0]) == ["u", "y"]


# ---- where states start ----------------------------------------------------------------------------------------------


def test_a_state_starts_at_what_the_user_gives_else_at_the_first_of_three_readings() -> None:
    read = record(u=U, angle=put(Y + 1.0, [0, 1]))
    d = Data(turning(start={"speed": 4}), [read])
    assert d.first_state(0, "speed", 9.0) == 4.0 and d.first_state(0, "speed", 9.0, at=1) == 9.0
    assert d.first_state(0, "angle", 9.0) == Y[2] + 1.0
    blind = Data(turning(), [record(u=U, angle=put(Y, [0, 1, 2]))])
    assert blind.first_state(0, "angle", 9.0) == 9.0
    first, size = blind.begin(0, "angle")
    assert first == 0.0 and size == pytest.approx(np.std(Y[3:]))


@pytest.mark.parametrize("speed", [-2.0, 0.0, 2.0])
def test_a_velocity_that_starts_at_rest_but_was_none_is_said(speed: float) -> None:
    t = 0.01 * np.arange(400)
    d = Data(turning(), [record(t, u=np.sin(t), angle=speed * t + 0.5 * np.sin(3.0 * t))])
    v = speed + 1.5 * np.cos(3.0 * t)
    first, size = d.begin(0, "speed")
    assert first == pytest.approx(v[0], abs=0.1) and size == pytest.approx(np.sqrt(np.mean(v**2)), rel=0.02)
    said = d.begins_in_motion(0, "speed")
    assert bool(said) == (abs(first) > MOVES * size)
    if said:
        assert said == [
            f"log: speed is about {first:.3g} rad/s at the start, where the model starts at rest; "
            "start={'speed': 'fitted'} fits it"
        ]
    still = Data(turning(), [record(t, u=np.sin(t), angle=1.0 - np.cos(3.0 * t))])
    assert still.begins_in_motion(0, "speed") == []
    assert Data(turning(outputs={"speed": "rad/s"}), [record(t, u=t, speed=t)]).begin(0, "angle") == (0.0, 0.0)


def test_windows_begin_anew_at_their_length_from_what_is_measured_there() -> None:
    t = 0.01 * np.arange(400)
    angle = np.sin(2.0 * t)
    d = Data(turning(window=0.5), [record(t, u=t, angle=put(angle, 150))])
    first, values = d.restarts(0, 300)
    assert np.flatnonzero(first).tolist() == [0, 50, 100, 200, 250]  # not at 150, where nothing was measured
    assert values.shape == (2, 300) and values[0, 50] == angle[50]
    assert values[1, 50:250] == pytest.approx(2.0 * np.cos(2.0 * t[50:250]), abs=0.05)
    assert d.restarts(0, 300)[1] == pytest.approx(values, nan_ok=True)
    free = Data(turning(), [record(t, u=t, angle=angle)]).restarts(0, 300)
    assert not free[0].any() and len(free[0]) == 300 and free[1].tolist() == [[0.0], [0.0]]


def test_the_force_that_is_held_at_the_start_is_the_median_of_five_readings() -> None:
    f = put(Y, slice(0, 5), 3.0)
    d = Data(mover(velocity="v"), [record(x=U, v=U, f=put(put(f, 1), 2, 50.0))])
    assert d.held(0) == 3.0
    assert Data(mover(velocity="v"), [record(x=U, v=U, f=put(Y, slice(0, 5)))]).held(0) == 0.0


# ---- noise -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [40, 300, 3000])
def test_the_noise_of_a_channel_is_that_of_the_white_noise_on_a_motion(n: int) -> None:
    t = np.arange(n) / 100.0
    levels = [noise_of_channel(5.0 * np.sin(0.7 * t) + 0.2 * white(seed, n)) for seed in range(8)]
    assert np.mean(levels) == pytest.approx(0.2, rel=0.3 if n == 40 else 0.1)
    assert noise_of_channel(0.2 * white(0, 39)) == 0.0
    # half the log may shake much more: the quieter half tells
    shaken = np.where(np.arange(n) < 0.45 * n, 20.0, 1.0) * 0.2 * white(1, n)
    assert noise_of_channel(shaken) < 0.5


def test_rows_in_no_order_have_the_noise_of_planes_through_their_neighbours() -> None:
    rng = np.random.default_rng(1)
    u = rng.uniform(-1.0, 1.0, (2, 1500)) * [[3.0], [500.0]]
    y = np.sin(0.5 * u[0]) + 1e-3 * u[1] + 0.05 * white(2, 1500)
    assert not any(without_order(np.sort(size * row[None])) for row in u for size in (1e-3, 1.0, 1e3))
    assert without_order(u) and not without_order(np.sort(u)) and not without_order(np.vstack([u, np.sort(u[:1])]))
    assert without_order(np.vstack([u, np.ones((1, 1500))])) and not without_order(np.ones((2, 1500)))
    assert noise_of_neighbours(u, y) == pytest.approx(0.05, rel=0.12)
    assert noise_of_neighbours(np.vstack([u, np.ones((1, 1500))]), y) == noise_of_neighbours(u, y)
    assert noise_of_neighbours(u[:, :16], y[:16]) > 0.0 and noise_of_neighbours(u[:, :15], y[:15]) == 0.0
    system = mapping(inputs={"u": "A", "w": "A"})
    data = Data(system, [record(np.arange(1500.0), u=u[0], w=u[1], y=put(y, 5))])
    assert data.noise() == pytest.approx([0.05], rel=0.12)
    assert Data(mapping(), [record(u=U, y=np.zeros(60))]).noise().tolist() == [1e-300]
    straight = Data(mapping(), [record(u=U, y=T)]).noise()
    assert straight == pytest.approx([1e-6 * np.std(T)], rel=0.01)


# ---- measured motion -------------------------------------------------------------------------------------------------

FINE = 0.001 * np.arange(8000)


def test_a_low_pass_keeps_cubics_and_looks_one_period_far() -> None:
    cubic = 3.0 - FINE + 2.0 * FINE**2 - 0.3 * FINE**3
    inner = slice(500, -500)
    assert low_pass(FINE, cubic, 5.0)[inner] == pytest.approx(cubic[inner], abs=1e-9)
    for share, passed in ((0.2, 0.999), (0.5, 0.956)):
        wave = np.sin(2.0 * np.pi * 10.0 * share * FINE)
        got = low_pass(FINE, wave, 10.0)[inner]
        assert got @ wave[inner] / (wave[inner] @ wave[inner]) == pytest.approx(passed, abs=2e-3)
    impulse = put(np.zeros(8000), 4000, 1.0)
    answer = low_pass(FINE, impulse, 10.0)
    assert np.flatnonzero(np.abs(answer) > 1e-12)[[0, -1]].tolist() == [3900, 4100]
    assert answer[3900:4001] == pytest.approx(answer[4000:4101][::-1], abs=1e-15) and answer.sum() == pytest.approx(1.0)
    assert low_pass(FINE, put(3.0 * FINE, slice(3000, 3100)), 5.0)[inner] == pytest.approx(3.0 * FINE[inner])
    assert low_pass(FINE, np.full(8000, np.nan), 5.0) == pytest.approx(np.zeros(8000))
    assert low_pass(FINE, np.full(8000, 4.0), 5.0) == pytest.approx(np.full(8000, 4.0))  # to its very ends


@pytest.mark.parametrize(("share", "frequency"), [(1.5, 8.0), (0.3, 2.0)])
def test_forces_are_compared_as_far_as_all_but_a_two_thousandth_of_their_power(share: float, frequency: float) -> None:
    low = np.sin(2.0 * np.pi * 2.0 * FINE)
    force = low + np.sqrt(share * (1.0 - FORCE_SHARE)) * np.sin(2.0 * np.pi * 8.0 * FINE)
    for noise in (0.0, 0.05):
        r = record(FINE, f=force + noise * white(3, 8000))
        if noise == 0.0 or share > 1.0:
            assert highest_frequency(["f"], [r]) == pytest.approx(frequency, abs=0.75)
    assert highest_frequency(["f"], [record(FINE, f=low), r]) == highest_frequency(["f"], [r])
    assert highest_frequency(["f"], [record(FINE, f=np.ones(8000))]) == pytest.approx(5.0 / FINE[-1])
    fast = record(FINE, f=np.sin(2.0 * np.pi * 400.0 * FINE))
    assert highest_frequency(["f"], [fast]) == pytest.approx(200.0)


def model_of_speed(u: Any, p: Any) -> Any:
    return p.c * u.velocity


@pytest.mark.parametrize("model", [None, model_of_speed])
def test_motion_is_differentiated_until_its_noise_is_next_to_nothing_beside_it(model: Any) -> None:
    order = 2 if model is None else 1
    system = mover()
    if model is not None:
        system = System("mover", "force", model, {"f": "N"}, position="x", parameters=[unknown("c", 1.0, "-")])
    dt, f0 = FINE[1], 3.0

    def limit(sigma: float) -> float:
        x = np.sin(2.0 * np.pi * f0 * FINE)
        return differentiated_to(system, [record(FINE, x=x + sigma * white(5, 8000), f=x)], 4.0)

    assert limit(0.0) == FLAT_TO * 4.0
    assert limit(10.0) == 4.0
    # the noise of 2 sigma^2 dt a Hz, times f^(2 order), has up to f the share of the motion that does not count
    n = 2 * order + 1
    wanted = 8.0
    sigma = np.sqrt((1.0 - FORCE_SHARE) * 0.5 * f0 ** (2 * order) * n / wanted**n / (2.0 * dt))
    assert limit(sigma) == pytest.approx(wanted, rel=0.12)


@pytest.mark.parametrize(("position", "velocity"), [("x", None), ("x", "v"), (None, "v")])
@pytest.mark.parametrize("cutoff", [None, 20.0])
def test_motion_is_that_of_which_some_was_measured(
    position: str | None, velocity: str | None, cutoff: float | None
) -> None:
    w = 2.0 * np.pi * 1.5
    x, v, a = np.cos(w * FINE), -w * np.sin(w * FINE), -(w**2) * np.cos(w * FINE)
    system = mover(position=position, velocity=velocity)
    got = motion(system, record(FINE, x=x, v=v, f=x), cutoff)
    inner = slice(200, -200)
    assert got[0][inner] == pytest.approx(x[inner] - (0.0 if position else 1.0), abs=2e-3)
    assert got[1][inner] == pytest.approx(v[inner], abs=2e-3 * w)
    if cutoff is None:
        assert not got[2].any() and len(got[2]) == 8000
    else:
        assert got[2][inner] == pytest.approx(a[inner], abs=5e-3 * w**2)


def test_a_displacement_is_smoothed_above_all_that_moves_it() -> None:
    x = np.sin(2.0 * np.pi * 3.0 * FINE) + 0.1 * np.sin(2.0 * np.pi * 20.0 * FINE)
    got = smoothed(FINE, put(x + 0.001 * white(6, 8000), 3000))
    inner = slice(300, -300)
    assert got[inner] == pytest.approx(x[inner], abs=4e-3)
    hiss = np.sin(2.0 * np.pi * 300.0 * FINE)
    assert smoothed(FINE, x + 0.002 * hiss)[inner] == pytest.approx(x[inner], abs=5e-4)  # a twentieth of the rate


# ---- a curve at each place -------------------------------------------------------------------------------------------

Q = np.linspace(0.2, 1.4, 60)  # the input, and the other column is its square root


def two(u: Any, p: Any) -> Any:
    return p.a * u.u + p.b, p.a * u.u - p.b


def curved_system(**more: Any) -> System:
    given: dict[str, Any] = {
        "outputs": {"y": "V", "z": "V"}, "inputs": {"u": "A"},
        "parameters": [unknown("a", 2.0, "V/A"), unknown("b", 0.5, "V")],
    }  # fmt: skip
    return System("two", "static", two, **given | more)


def learned(how: str, at: str, of: str, form: str = "line", **more: Any) -> Learned:
    given: dict[str, Any] = {"low": -10.0, "high": 10.0, "values": [0.3], "unit": "1", "form": form}
    return Learned(how=how, at=at, of=of, **given | more)


def held_against(system: System, curve: Learned, log: Record) -> tuple[BoundSystem, Array]:
    """A system with a curve, and its parameters with the curve as it was learned."""
    bound = BoundSystem(system, [log], curves={"c": curve})
    theta = bound.stage.neutral()
    theta[: len(system.parameters)] = [p.value for p in system.parameters]
    theta[bound.stage.index()["c"]] = curve.values
    return bound, theta


LOG = record(u=Q, y=2.0 * Q + 0.5, z=2.0 * Q - 0.5, w=np.sqrt(Q))
A, B = 2.0, 0.5
WORTH = {
    "u": Q, "w": np.sqrt(Q), "time": T, "u_minus_w": Q - np.sqrt(Q), "z": A * Q - B, "time_every_1700_ms": T % 1.7,
    "w_every_0p3": np.sqrt(Q) % 0.3, "direction_of_u": put(np.ones(60), [0, 1], 0.0), "w_lagged_by_1_ms": np.sqrt(Q),
}  # fmt: skip
PLACES = (
    ("parameter times", "b"), ("input adds", "u"), ("input times", "u"), ("output adds", "z"), ("output times", "y"),
)  # fmt: skip


def test_a_curve_changes_what_it_is_at_by_its_value() -> None:
    curves = {
        f"c{k}{m}": learned(how, at, of)
        for k, (how, at) in enumerate(PLACES)
        for m, of in enumerate(WORTH)
        if of != "z" or how.startswith("output")  # an output is not known before the model runs
    }
    bound = BoundSystem(curved_system(), [LOG], curves=curves)
    neutral = bound.stage.neutral()
    for name, curve in curves.items():
        theta, c, how = neutral.copy(), 0.3 * WORTH[curve.of], curve.how
        theta[bound.stage.index()[name]] = 0.3
        u = Q + c if how == "input adds" else Q * (1.0 + c) if how == "input times" else Q
        b = B * (1.0 + c) if how == "parameter times" else B
        y = (A * u + b) * (1.0 + c if how == "output times" else 1.0)
        z = A * u - b + (c if how == "output adds" else 0.0)
        assert bound.run(theta[None])[0] == pytest.approx(np.array([y, z]), abs=2e-4), (how, curve.of)
    assert bound.run(neutral[None])[0] == pytest.approx(np.array([A * Q + B, A * Q - B]), rel=1e-4)


def test_a_curve_that_jumps_and_one_of_splines_are_what_their_numbers_say() -> None:
    jumps = learned("output adds", "y", "u_minus_w", form="sign")
    bound, theta = held_against(curved_system(), jumps, LOG)
    assert bound.run(theta[None])[0, 0] == pytest.approx(A * Q + B + 0.3 * np.sign(Q - np.sqrt(Q)))
    knots = [0.0] * 4 + [2.0] * 4
    spline = scipy.interpolate.BSpline(np.array(knots), np.array([0.1, -0.4, 0.3, 0.2]), 3)
    cubic = learned("output adds", "y", "u", "", low=0.0, high=2.0, knots=knots, values=[0.1, -0.4, 0.3, 0.2], size=0.5)
    bound, theta = held_against(curved_system(), cubic, LOG)
    assert bound.run(theta[None])[0, 0] == pytest.approx(A * Q + B + spline(Q), abs=1e-4)
    (effect,) = (e for e in bound.stage.effects if e.name == "c")
    assert effect.starts == ((0.1, -0.4, 0.3, 0.2),) and [p.name for p in effect.parameters] == ["c1", "c2", "c3", "c4"]
    for p in effect.parameters:  # known to be of the curve's size
        assert (p.value, p.low, p.high, p.scale) == (0.0, -500.0, 500.0, 0.5)
        assert p.tolerance == pytest.approx(np.sqrt(3.0) * LEVEL_SPREAD * 0.5)
    line_of = held_against(curved_system(), learned("output adds", "y", "u", values=[-0.25]), LOG)[0].stage.effect("c")
    assert [(p.high, p.scale, p.tolerance) for p in line_of.parameters] == [(250.0, 0.25, 0.0)]
    both = learned(
        "output adds", "y", "u", "", low=-1.0, high=1.0, knots=[-1.0] * 4 + [1.0] * 4, values=[0.0] * 4 + [0.7],
        jump=True,
    )  # fmt: skip
    log = record(u=Q - 0.8, y=A * (Q - 0.8) + B, z=A * (Q - 0.8) - B)
    bound, theta = held_against(curved_system(), both, log)
    assert bound.run(theta[None])[0, 0] == pytest.approx(A * (Q - 0.8) + B + 0.7 * np.sign(Q - 0.8))


def test_a_surface_is_the_product_of_what_it_is_made_of() -> None:
    second = {"of": "w", "low": -2.0, "high": 2.0, "form": "line"}
    bound, theta = held_against(
        curved_system(), learned("output adds", "y", "u", low=-4.0, high=4.0, second=second), LOG
    )
    assert bound.run(theta[None])[0, 0] == pytest.approx(A * Q + B + 0.3 * Q * np.sqrt(Q), abs=1e-3)


@pytest.mark.parametrize(
    ("curve", "said"),
    [
        (
            learned("somehow", "y", "u"),
            "how (='somehow') is not one of system 'two'; allowed: parameter times, input adds, input times, state "
            "adds, output adds, output times, force adds",
        ),
        (learned("output adds", "u", "u"), "at (='u') is not one of system 'two'; allowed: y, z"),
        (
            learned("force adds", "y", "u"),
            "at (='y') is not one of system 'two'; allowed: nothing, with how = 'force adds'",
        ),
        (
            learned("output adds", "y", "v"),
            "of (='v') is not one of system 'two'; allowed: y, z, u, time, w",
        ),
    ],
)  # fmt: skip
def test_a_curve_that_the_system_cannot_have_gets_one_line(curve: Learned, said: str) -> None:
    with pytest.raises(StageError) as e:
        BoundSystem(curved_system(), [LOG], curves={"c": curve})
    assert str(e.value) == f"curves.c: {said}"


# ---- a system and its logs -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("given", [1.0, 0.0, -3.0])
def test_unknown_parameters_begin_at_least_squares_and_may_move_by_some_of_their_sizes(given: float) -> None:
    y = put(2.5 * Q + 0.75 + 0.01 * white(3, 60), 7)
    parameters = [unknown("a", given, "V/A"), unknown("b", 0.0, "V", -1.0, 1.0)]
    bound = BoundSystem(mapping(model=lambda u, p: p.a * u.u + p.b, parameters=parameters), [record(u=Q, y=y)])
    there = np.isfinite(y)
    best = np.linalg.lstsq(np.stack([Q[there], np.ones(59)], axis=1), y[there], rcond=None)[0]
    a, b = bound.stage.parameters
    assert (a.value, b.value) == pytest.approx(tuple(best), rel=1e-5)
    size = max(abs(a.value), abs(given))
    assert a.tolerance == pytest.approx(max(WIDE * size, GIVEN * abs(given)))
    assert a.scale == pytest.approx(WIDE * max(abs(a.value), 0.1 * size))
    spread = np.nanstd(y)  # of what was given as 0: the size that moves the output by as much as it varies
    assert b.tolerance == pytest.approx(WIDE * max(abs(b.value), spread), rel=0.05)
    assert (b.low, b.high) == (-1.0, 1.0)
    assert bound.floor == pytest.approx(bound.data.noise())  # inputs are taken as they are
    assert bound.errors(bound.stage.neutral())["log"][0] == pytest.approx(a.value * Q + b.value - y, nan_ok=True)


def test_a_known_parameter_stays_and_one_at_its_bound_stays_within() -> None:
    parameters = [Parameter("a", 2.0, "V/A"), unknown("b", 1.0, "V", 0.5, 3.0)]
    system = mapping(model=lambda u, p: p.a * u.u + p.b, parameters=parameters)
    bound = BoundSystem(system, [record(u=Q, y=2.0 * Q)])
    assert bound.stage.parameters[0] == parameters[0] and bound.stage.parameters[1].value == pytest.approx(0.5)
    again = BoundSystem(system, [record(u=Q, y=2.0 * Q)], values={"b": 9.0})
    assert again.stage.parameters[1].value == 3.0
    with pytest.raises(StageError) as e:
        BoundSystem(system, [record(u=Q, y=Q)], values={"g": 1.0})
    assert str(e.value) == "model file: parameter 'g' is not one of system 'map'; allowed: a, b"
    with pytest.raises(StageError, match=r"^model file: effect 'u\.wrong' is not one that system 'map' can have; it"):
        BoundSystem(system, [record(u=Q, y=Q)], present={"u.wrong": {}})
    with pytest.raises(StageError) as e:
        BoundSystem(system, [record(u=Q, y=Q)], present={"u.cubic": {"b": 1.0}})
    assert str(e.value) == "model file: effect 'u.cubic' needs a number for coefficient"
    with pytest.raises(StageError, match=r"^without 'u\.wrong': not a law that system 'map' can have; it has u\."):
        BoundSystem(mapping(without=["u.wrong"]), [record(u=Q, y=Q)])


def test_the_other_valley_of_an_error_is_begun_from_too() -> None:
    system = mapping(model=lambda u, p: p.a**2 * u.u, parameters=[unknown("a", 0.0, "-")])
    bound = BoundSystem(system, [record(u=Q, y=4.0 * Q + 0.01 * white(1, 60))])
    assert bound.stage.begins is not None and bound.others
    values = sorted(float(begin[0]) for begin in bound.stage.begins)
    assert values[0] == pytest.approx(-2.0, rel=0.01) or values[-1] == pytest.approx(2.0, rel=0.01)
    assert abs(bound.stage.parameters[0].value) == pytest.approx(2.0, rel=0.01)
    assert float(bound.others[0][0]) == pytest.approx(-bound.stage.parameters[0].value, rel=0.01)


def test_laws_of_a_model_file_are_part_of_the_model_and_not_looked_for() -> None:
    log = record(u=Q, y=2.0 * (Q + 0.3 * Q**3))
    bound = BoundSystem(mapping(), [log], values={"a": 2.0}, present={"u.cubic": {"coefficient": 0.3}})
    (a, law) = bound.stage.parameters
    assert a.value == pytest.approx(2.0) and (law.name, law.value) == ("u.cubic.coefficient", 0.3)
    assert "u.cubic" not in [e.name for e in bound.stage.effects] and "u.bias" in [e.name for e in bound.stage.effects]
    assert bound.errors(bound.stage.neutral())["log"] == pytest.approx(np.zeros((1, 60)), abs=1e-4)
    assert law.tolerance == pytest.approx(WIDE * law.scale / 0.1) and law.low < 0.3 < law.high
    left = BoundSystem(mapping(without=["u.bias"]), [log])
    assert "u.bias" not in [e.name for e in left.stage.effects]
    assert all(h[0] != "u.bias" for e in left.stage.effects for h in e.holds)


def test_a_position_that_no_log_tells_is_fitted_to_each_log() -> None:
    """A spring about the middle: its force tells where the motion, of which the rate was measured, began."""
    system = System(
        "spring", "force", lambda u, p: p.k * u.position, {"f": "N"}, velocity="v",
        parameters=[unknown("k", 1.0, "N/m")],
    )  # fmt: skip
    t = 0.01 * np.arange(600)
    x = np.cos(2.0 * t)

    def log(name: str, begin: float) -> Record:
        return record(t, name, v=-2.0 * np.sin(2.0 * t), f=3.0 * (x - x[0] + begin))

    bound = BoundSystem(system, [log("one", 1.0), log("two", -0.4)])
    named = {p.name: p.value for p in bound.stage.parameters}
    assert named == pytest.approx({"k": 3.0, "start_position_1": 1.0, "start_position_2": -0.4}, rel=1e-3)
    test = BoundSystem(system, [log("three", 0.7)], like=bound)
    theta = test.theta_from(bound, bound.stage.neutral())
    assert theta[:2] == pytest.approx([3.0, 0.7], rel=1e-3) and len(theta) == len(test.stage.neutral())
    assert np.abs(test.errors(theta)["three"]).max() < 0.01


# ---- a simulated system, in plain Python -----------------------------------------------------------------------------

SHORT = 0.08 * np.arange(50)
NUMBERS = {"one": 1.0, "none": None}  # of a kind that no compiler takes


def decay(x: Any, u: Any, p: Any) -> Any:
    return u.u - NUMBERS["one"] * p.c * x.y


def driven_decay(seed: int, begin: float, c: float = 0.8) -> Record:
    """A first-order lag of an input that holds, exactly."""
    u, y = np.repeat(white(seed, 5), 10), np.empty(50)
    y[0] = begin
    for k in range(1, 50):
        y[k] = u[k - 1] / c + (y[k - 1] - u[k - 1] / c) * np.exp(-c * 0.08)
    return record(SHORT, f"run {seed}", u=u, y=y)


@pytest.fixture(scope="module")
def lag() -> BoundSystem:
    system = System(
        "lag", "simulate", decay, {"y": "V"}, {"u": "V"}, [unknown("c", 0.5, "1/s")], states={"y": "V"},
        start={"y": "fitted"}, places=["y"],
    )  # fmt: skip
    return BoundSystem(system, [driven_decay(1, 0.7), driven_decay(2, -1.2)])


def test_a_model_that_numba_cannot_compile_runs_as_plain_python_and_is_fitted_with_its_starts(lag: BoundSystem) -> None:
    (note,) = [n for n in lag.notes if "numba" in n]
    assert note.startswith("system 'lag': numba cannot compile the model (")
    assert note.endswith("); it runs as plain Python, some 100 times slower")
    named = {p.name: (p.value, p.unit) for p in lag.stage.parameters}
    assert list(named) == ["c", "start_y_1", "start_y_2"] and named["c"][1] == "1/s" and named["start_y_2"][1] == "V"
    assert [v for v, _ in named.values()] == pytest.approx([0.8, 0.7, -1.2], abs=2e-3)
    size = np.std(lag.data.y[1])
    assert lag.stage.parameters[2].tolerance >= WIDE * 1.2 and lag.stage.parameters[2].tolerance >= WIDE * size
    error = lag.errors(lag.stage.neutral())
    assert list(error) == ["run 1", "run 2"] and max(float(np.abs(e).max()) for e in error.values()) < 5e-3
    effects = {e.name for e in lag.stage.effects}
    assert {"y.leak", "y_sensor.bias"} <= effects and not any(n.startswith("u.") for n in effects)


def test_a_set_of_parameters_is_run_with_what_every_law_adds(lag: BoundSystem) -> None:
    theta = lag.stage.neutral()
    theta[:3] = 0.8, 0.7, -1.2
    exact = lag.measured[0]
    index = lag.stage.index()
    assert lag.run(theta[None])[0, 0] == pytest.approx(exact, abs=1e-3)
    assert lag.run(theta[None], 7)[0, 0] == pytest.approx(exact[::7], abs=1e-3)
    biased = theta.copy()
    biased[index["y_sensor.bias"]] = 0.25
    assert lag.run(np.array([theta, biased]))[:, 0] == pytest.approx(np.array([exact, exact + 0.25]), abs=1e-3)
    leaking = theta.copy()
    leaking[0] = 0.5
    leaking[index["y.leak"]] = 0.3  # as much more of the same
    assert lag.run(leaking[None])[0, 0] == pytest.approx(exact, abs=1e-3)
    gone = theta.copy()
    gone[0] = -400.0
    far = 100.0 * np.abs(exact).max()
    assert np.abs(lag.run(gone[None])).max() == pytest.approx(far)


# ---- what several logs say -------------------------------------------------------------------------------------------


def by_hand(columns: list[Array], y: Array) -> Array:
    """Errors of the least-squares fit of a straight sum of columns."""
    a = np.stack(columns, axis=1)
    return np.asarray(a @ np.linalg.lstsq(a, y, rcond=None)[0] - y)


def rms(x: Array) -> float:
    return float(np.sqrt(np.mean(x**2)))


@pytest.fixture(scope="module")
def answer() -> tuple[Logs, StageDiagnosis, ByLog]:
    """Two logs of a gain with a cubic and an offset, and one that tests it."""
    u = [np.sin(T) + 0.2, 1.2 * np.cos(0.7 * T), 1.1 * np.sin(1.3 * T)]
    logs = [record(name=f"log {k}", u=x, y=2.0 * (x + 0.2 * x**3) + 0.5 + 0.01 * white(k, 60)) for k, x in enumerate(u)]
    every = [e.name for e in BoundSystem(mapping(), logs).effects]
    system = mapping(without=[name for name in every if name not in ("u.cubic", "y.bias")])
    found = bind(system, logs[:2], [put_last(logs[2])])
    d = diagnose_stage(found.fitted.thinned, found.fitted.floor, judged=found.judged())
    return found, d, ByLog.of(found, d)


def put_last(log: Record) -> Record:
    """The same without its last reading."""
    return record(log.t, log.name, u=log.columns["u"], y=put(log.columns["y"], -1))


def test_the_waterfall_is_told_log_by_log_as_least_squares_has_it(answer: tuple[Logs, StageDiagnosis, ByLog]) -> None:
    logs, d, by = answer
    assert sorted(d.final.effects) == ["u.cubic", "y.bias"]
    assert list(by.steps) == ["model", d.final.effects[0], " + ".join(d.final.effects)]
    assert list(by.steps["model"]) == ["log 0", "log 1", "log 2"]
    u, y = np.concatenate(logs.fitted.data.u, axis=1)[0], logs.fitted.measured[0]
    bare, best = by_hand([u], y), by_hand([u, u**3, np.ones(120)], y)
    last = by.steps[" + ".join(d.final.effects)]
    for k in range(2):
        at = slice(60 * k, 60 * k + 60)
        assert by.steps["model"][f"log {k}"] == pytest.approx([rms(bare[at])], rel=0.01)
        assert last[f"log {k}"] == pytest.approx([rms(best[at])], rel=0.01)
    assert last["log 2"] == pytest.approx([0.01], rel=0.4)
    together = by.together()
    assert together["model"]["fitted"] == pytest.approx([rms(bare)], rel=0.01)
    assert together["model"]["test"] == by.steps["model"]["log 2"]
    rows = by.rows()
    assert [r[:3] for r in rows] == [
        ("log 0", "fitted", 0), ("log 1", "fitted", 0), ("log 2", "test", 0), ("all 2 together", "fitted", 0),
    ]  # fmt: skip
    assert rows[0][3] == [float(step["log 0"][0]) for step in by.steps.values()]
    assert rows[3][3] == [float(step["fitted"][0]) for step in together.values()]
    assert [r[4] for r in rows[:2]] == pytest.approx([rms(y[:60]), rms(y[60:])]) and rows[3][4] == pytest.approx(rms(y))
    floor = np.array([0.005])
    assert by.tested(floor) == {"log 2": pytest.approx(last["log 2"][0] / 0.005)}
    assert by.tested(np.array([0.5])) == {"log 2": 1.0}
    assert by.tested() == {"log 2": pytest.approx(max(last["log 2"][0] / logs.fitted.floor[0], 1.0))}


def test_what_a_law_brings_is_the_error_with_it_over_that_without(answer: tuple[Logs, StageDiagnosis, ByLog]) -> None:
    logs, d, by = answer
    u, y = np.concatenate(logs.fitted.data.u, axis=1)[0], logs.fitted.measured[0]
    without = {"u.cubic": by_hand([u, np.ones(120)], y), "y.bias": by_hand([u, u**3], y)}
    last = list(by.steps.values())[-1]
    assert by.ablation.keys() == without.keys()
    for name, error in without.items():
        for k in range(2):
            of_log = rms(error[60 * k : 60 * k + 60])
            assert by.ablation[name][f"log {k}"] == pytest.approx(last[f"log {k}"][0] / of_log, rel=0.05)
    assert by.model.meta == {"system": "map"}
    assert by.model.parameters == {"a": pytest.approx(2.0, rel=0.01)}
    assert by.model.effects["u.cubic"]["coefficient"] == pytest.approx(0.2, rel=0.05)
    assert by.model.effects["y.bias"]["offset"] == pytest.approx(0.5, rel=0.05)
    share = 100.0 * d.error_after[0] / rms(y)
    assert by.sentence() == (
        f"y is left with an error of {d.error_after[0]:.4g} V ({share:.2g} % of its RMS), {d.excess:.3g} times the "
        "noise of its samples"
    )
    (a,) = by.parameters()
    assert (a["parameter"], a["unit"]) == ("a", "V/A") and float(str(a["low"])) < 2.0 < float(str(a["high"]))
    assert parameter_warnings(logs.fitted, LeastSquaresProblem(logs.fitted.thinned, d.floor), d) == []
    data = by.json()
    assert data["recalibrated"] == [] and len(data["logs"]) == 9 and len(data["together"]) == 6
    assert data["logs"][0]["relative"] == pytest.approx(by.steps["model"]["log 0"][0] / rms(y[:60]))
    assert {(e["log"], e["fitted"]) for e in data["logs"]} == {("log 0", True), ("log 1", True), ("log 2", False)}
    assert logs.test is not None
    logs.fitted.notes.append("said of one")
    logs.test.notes += ["said of one", "said of the test"]
    assert ByLog.of(logs, d).notes[:2] == ["said of one", "said of the test"]
    assert {(e["effect"], e["log"]): e["helps"] for e in data["ablation"]} == {
        (e, log): v < NO_HELP for e, of in by.ablation.items() for log, v in of.items()
    }


@pytest.mark.parametrize(("ratio", "said"), [(0.84, ""), (0.9, "hardly helps"), (0.99, "does not help")])
def test_a_law_that_does_not_help_on_a_log_is_said(
    answer: tuple[Logs, StageDiagnosis, ByLog], ratio: float, said: str
) -> None:
    logs, d, _ = answer
    by = ByLog(logs, d, ablation={"u.cubic": {"log 2": ratio}})
    by._remark(LeastSquaresProblem(logs.fitted.thinned, d.floor))
    helps = [n for n in by.notes if "help" in n]
    wanted = f"u.cubic {said} on log 2: error with it over error without it is {ratio:.2f}"
    assert helps == ([wanted] if said else [])


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_force_that_drives_against_the_motion_is_said(sign: float) -> None:
    t = 0.01 * np.arange(400)
    v = np.cos(2.0 * t)
    system = System(
        "damper", "force", lambda u, p: p.c * u.velocity, {"f": "N"}, velocity="v", position="x",
        parameters=[unknown("c", 1.0, "N s/m", 0.0, np.inf)],
    )  # fmt: skip
    log = record(t, x=0.5 * np.sin(2.0 * t), v=v, f=sign * 3.0 * v + 0.01 * white(1, 400))
    logs = bind(system, [log])
    judge = LeastSquaresProblem(logs.fitted.thinned, logs.fitted.floor)
    d = as_given(logs, judge.fit((), logs.fitted.stage.neutral()))
    said = parameter_warnings(logs.fitted, judge, d)
    turned = "is a sign the other way round?"
    assert said == (
        [] if sign > 0.0 else [
            f"c stands at its bound, 0 N s/m: the logs would have it go beyond; {turned}",
            "log: f acts against the motion, so that the machine gives power; friction is looked for where a positive "
            f"force drives positive motion: {turned}",
        ]
    )  # fmt: skip
    d.base = SimpleNamespace(theta=d.base.theta + 0.5)  # type: ignore[assignment]  # what a law has taken over
    assert not any(line.startswith("c ") for line in parameter_warnings(logs.fitted, judge, d))


# ---- the next run ----------------------------------------------------------------------------------------------------


def straight_line() -> BoundSystem:
    system = mapping(
        model=lambda u, p: p.a * u.u + p.b, parameters=[unknown("a", 1.0, "V/A"), unknown("b", 1.0, "V")], places=["u"],
    )  # fmt: skip
    u = 0.6 + 0.3 * np.sin(T)
    return BoundSystem(system, [record(T + 3.0, u=u, y=2.0 * u + 1.0 + 0.01 * white(4, 60))])


def test_every_shape_uses_its_range_about_the_middle() -> None:
    bench = _Bench(straight_line(), Limits({"u": (-1.0, 3.0)}, seconds=30.0))
    assert bench.t == pytest.approx(0.1 * np.arange(301)) and bench.sets == {"u": "A"}
    assert bench.first == {"y": bench.bound.measured[0, 0]}
    for name, shape in SHAPES.items():
        for size in (1.0, 0.5):
            u = bench.of_shape(shape, size)["u"]
            part = 0.1 if "small" in name else 1.0
            assert np.abs(u - 1.0).max() <= 2.0 * size * part + 1e-9
            assert np.abs(u - 1.0).max() >= 1.8 * size * part and abs(np.mean(u) - 1.0) < 0.5 * size * part, name
    turns = {
        "one slow ramp up and down": 1, "five ramps up and down": 9, "small reversals about the middle": 23,
        "swept sine to 40 cycles a run": 41,
    }  # fmt: skip
    for name, many in turns.items():
        values = SHAPES[name](np.linspace(0.0, 1.0, 20001))
        assert np.count_nonzero(np.diff(np.sign(np.diff(values))) != 0) == pytest.approx(many, abs=1), name
        assert values[0] == pytest.approx(0.0 if "sine" in name else -np.abs(values).max(), abs=1e-6)
    assert len(set(np.round(SHAPES["stairs up and down with dwells"](np.linspace(0, 1, 999)), 9))) == 9
    levels = SHAPES["30 steps between the ends at random"](np.linspace(0.0, 1.0, 3001))
    assert set(levels) == {-1.0, 1.0} and set(np.flatnonzero(np.diff(levels)) % 100) <= {99, 0}


def test_a_shift_moves_one_part_of_a_channel_within_its_range() -> None:
    bench = _Bench(straight_line(), Limits({"u": (-1.0, 3.0)}, seconds=24.0))
    run = {"u": np.full(len(bench.t), 1.0)}
    rng, part, heights = np.random.default_rng(0), len(bench.t) // 24, []
    hat = scipy.signal.windows.triang(part)  # as the inputs of this system do not hold
    for _ in range(40):
        moved = bench.shifted(run, rng)["u"] - 1.0
        at = np.flatnonzero(moved)
        assert len(at) == at[-1] - at[0] + 1 == part
        heights.append(moved[at[0]] / hat[0])
        assert moved[at] == pytest.approx(np.clip(heights[-1] * hat, -2.0, 2.0))
    assert 3.0 < max(heights) <= 4.0 and -4.0 <= min(heights) < -3.0 and run["u"].tolist() == [1.0] * len(bench.t)
    slow = _Bench(straight_line(), Limits({"u": (-1.0, 3.0)}, {"u": 0.5}))
    u = slow.of_shape(SHAPES["30 steps between the ends at random"], 1.0)["u"]
    assert np.abs(np.diff(u)).max() == pytest.approx(0.05)


def test_a_simulated_run_has_the_noise_of_its_draw_and_keeps_the_limits() -> None:
    bound = straight_line()
    bench = _Bench(bound, Limits({"u": (-1.0, 3.0), "y": (-1.5, 7.0)}))
    theta = np.concatenate([[2.0, 1.0], bound.stage.neutral()[2:]])
    u = np.linspace(-1.0, 3.0, len(bench.t))
    clean = bench.simulated({"u": u}, theta, np.array([0.2]), 0)
    assert clean is not None and clean.measured[0] == pytest.approx(2.0 * u + 1.0)
    one, two, again = (bench.simulated({"u": u}, theta, np.array([0.2]), k) for k in (1, 2, 1))
    assert one is not None and two is not None and again is not None
    assert rms(one.measured - clean.measured) == pytest.approx(0.2, rel=0.25)
    assert not np.array_equal(one.measured, two.measured) and np.array_equal(one.measured, again.measured)
    assert bench.simulated({"u": u + 0.01}, theta, np.ones(1), 0) is None
    assert bench.simulated({"u": u - 0.3}, theta, np.ones(1), 0) is None


def test_a_run_tells_the_parameters_as_their_information_says() -> None:
    bound = straight_line()
    d = diagnose_stage(bound.thinned, bound.floor, judged=Logs(bound, None).judged())
    assert d.effects == []
    bench = _Bench(bound, Limits({"u": (-1.0, 1.0)}))
    parameters = _Parameters(bench, d)
    run = {"u": np.where(np.arange(len(bench.t)) % 2, 1.0, -1.0)}
    of_log, of_run = (
        np.linalg.slogdet(np.stack([np.ones(len(u)), u]) @ np.stack([np.ones(len(u)), u]).T)[1]
        for u in (bound.data.u[0][0], run["u"])
    )
    (told,) = parameters.told(run) or [np.nan]
    assert told == pytest.approx((of_run - of_log) / 4.0, abs=0.02)
    assert parameters.row(told) == pytest.approx(np.exp(-told))
    assert parameters.told({"u": np.zeros(len(bench.t))}) is None  # nothing of a slope
    checked = parameters.checked(run, [0])
    words = re.fullmatch(r"4 simulated runs with noise scatter (.*) times as far as their errors say", checked)
    assert words is not None and 0.3 < float(words[1]) < 2.0
    assert parameters.text("ramps", told, 5.9, checked, [0]) == (
        f"No rivals are left. For the parameters: ramps, 5.9 s; standard errors are {np.exp(-told):.2f} times those of "
        f"the log; {checked}."
    )


# ---- states and curves in a simulation -------------------------------------------------------------------------------


def pair(x: Any, u: Any, p: Any) -> Any:
    """Two lags that forget slowly, each measured."""
    return u.u - NUMBERS["one"] * p.c * x.y, -0.02 * x.z


def pair_of(c: float) -> BoundSystem:
    system = System(
        "pair", "simulate", pair, {"y": "V", "z": "A"}, {"u": "V"}, [Parameter("c", c, "1/s")],
        states={"y": "V", "z": "A"}, places=["u"], without=[],
    )  # fmt: skip
    log = driven_decay(1, 0.7, c)
    z = 3.0 * np.exp(-0.02 * SHORT)
    noise = 0.05 * white(5, 50), 0.02 * white(6, 50)
    return BoundSystem(system, [record(SHORT, u=log.columns["u"], y=log.columns["y"] + noise[0], z=z + noise[1])])


def test_a_state_that_a_system_forgets_slowly_starts_within_its_sensor_s_noise() -> None:
    bound = pair_of(0.01)
    assert bound.read_starts
    named = {p.name: p for p in bound.stage.parameters}
    assert list(named) == ["c", "start_y", "start_z"]
    for k, name in enumerate(("y", "z")):
        p = named[f"start_{name}"]
        assert p.value == bound.measured[k, 0] and p.log == 1 and p.unit == "VA"[k]
        assert p.tolerance == pytest.approx(START_WITHIN * bound.data.noise()[k])
    assert np.all(bound.floor >= bound.data.noise())
    test = BoundSystem(bound.system, bound.data.records, like=bound)
    assert [p.name for p in test.stage.parameters] == list(named)


def test_a_state_that_a_system_forgets_at_once_starts_at_its_reading() -> None:
    system = System(
        "lag", "simulate", decay, {"y": "V"}, {"u": "V"}, [Parameter("c", 8.0, "1/s")], states={"y": "V"}, places=["u"],
    )  # fmt: skip
    log = driven_decay(1, 0.7, 8.0)
    bound = BoundSystem(system, [record(SHORT, u=log.columns["u"], y=log.columns["y"] + 0.02 * white(5, 50))])
    assert not bound.read_starts and [p.name for p in bound.stage.parameters] == ["c"]


@pytest.fixture(scope="module")
def lag_with_curves() -> BoundSystem:
    curves = {
        "drain": learned("state adds", "y", "y", values=[0.5]),
        "beside": learned("state adds", "y", "y_minus_u", values=[0.5]),
        "slower": learned("parameter times", "c", "time", form="constant", values=[-0.25]),
        "more": learned("input times", "u", "time", form="constant", values=[0.5]),
        "both": learned(
            "state adds", "y", "y", low=-20.0, high=20.0, values=[0.1],
            second={"of": "time", "low": 0.0, "high": 40.0, "form": "line"},
        ),
    }  # fmt: skip
    system = System(
        "lag", "simulate", decay, {"y": "V"}, {"u": "V"}, [Parameter("c", 0.8, "1/s")], states={"y": "V"},
        start={"y": 0.7}, places=["u"],
    )  # fmt: skip
    return BoundSystem(system, [driven_decay(1, 0.7)], curves=curves)


def integrated(rate: Any, u: Array, begin: float) -> Array:
    """A state by a reference integrator, between samples at which its input steps."""
    y = [begin]
    for k in range(len(SHORT) - 1):
        got = scipy.integrate.solve_ivp(
            lambda t, x, k=k: rate(t, x, u[k]), SHORT[k : k + 2], [y[-1]], rtol=1e-8, atol=1e-10
        )
        y.append(float(got.y[0, -1]))
    return np.array(y)


@pytest.mark.parametrize(
    ("curve", "rate"),
    [
        ("", lambda t, x, u: u - 0.8 * x),
        ("drain", lambda t, x, u: u - 1.3 * x),
        ("beside", lambda t, x, u: 1.5 * u - 1.3 * x),
        ("slower", lambda t, x, u: u - 0.6 * x),
        ("more", lambda t, x, u: 1.5 * u - 0.8 * x),
        ("both", lambda t, x, u: u - 0.8 * x - 0.1 * x * t),
    ],
)
def test_a_curve_in_a_simulation_is_that_term_of_its_equation(
    lag_with_curves: BoundSystem, curve: str, rate: Any
) -> None:
    bound = lag_with_curves
    theta = bound.stage.neutral()
    if curve:
        theta[bound.stage.index()[curve]] = bound.stage.effect(curve).starts[0]
    wanted = integrated(rate, bound.data.u[0][0], 0.7)
    assert bound.run(theta[None])[0, 0] == pytest.approx(wanted, abs=4e-3 * np.abs(wanted).max())


def test_what_a_channel_did_before_the_log_is_forgotten_once_the_rest_of_the_curve_is_flat() -> None:
    q = np.concatenate([np.linspace(0.0, 1.0, 11), np.linspace(0.9, -3.0, 40)])
    table = np.minimum(np.linspace(0.0, 2.0, 21), 0.5)  # from 0.5 on it is flat, 0.475 at 0.95 of it
    lost = forgotten(q, 2.0, table)
    way = np.maximum.accumulate(q) - np.minimum.accumulate(q)
    assert lost.tolist() == (0.5 * way >= 0.475 - 1e-9).tolist() and lost.any() and not lost.all()
    assert swings(np.concatenate([q, np.linspace(-3.0, 0.0, 31)[1:]])).tolist() == [4.0] * 51 + [4.0] * 30
    assert not swings(np.zeros(5)).any()
    ways = np.concatenate([np.linspace(0.0, 1.0, 11), np.linspace(0.9, 0.0, 10), np.linspace(0.1, 5.0, 50)])
    assert swings(ways) == pytest.approx([1.0] * 20 + [5.0] * 51)


def test_the_other_frequency_of_a_wave_is_found_by_drawing() -> None:
    """From the user's own value the error falls away from the truth: drawn values come to the right valley."""
    t = 0.02 * np.arange(200)
    system = mapping(model=lambda u, p: np.sin(p.a * u.u), parameters=[unknown("a", 8.0, "1/s")], places=["y"])
    bound = BoundSystem(system, [record(t, u=t, y=np.sin(3.0 * t) + 0.01 * white(1, 200))])
    assert bound.stage.parameters[0].value == pytest.approx(3.0, rel=1e-3)
    assert bound.stage.begins is not None and bound.stage.begins[0, 0] == 8.0  # the user's own is begun from, too


# ---- own laws --------------------------------------------------------------------------------------------------------


def shifted(u: Any, t: Any, p: Any) -> Any:
    return u + NUMBERS["one"] * p.by


def summed(u: Any, t: Any, dt: Any, p: Any, m: Any) -> Any:
    m[0] += dt * NUMBERS["one"]
    return u + p.rate * m[0] * p.share


def test_own_laws_in_plain_python_do_what_they_say() -> None:
    by = Law("shifted", "signal", shifted, [Parameter("by", 0.0, "V", -5.0, 5.0)], [-5.0, 5.0])
    sizes = [Parameter("rate", 0.0, "V/s", -5.0, 5.0), Parameter("share", 1.0, "-", 0.0, 2.0)]
    late = Law("summed", "signal", summed, sizes, [(0.5, 1.0), (-0.5, 2.0)], memory=1)
    bound = BoundSystem(mapping(laws=[by, late], places=["y"]), [record(T + 2.0, u=Q, y=2.0 * Q)])
    assert any(n.startswith("numba cannot compile law ") and n.endswith("runs as plain Python") for n in bound.notes)
    index, theta = bound.stage.index(), bound.stage.neutral()
    theta[index["y.shifted"]], theta[index["y.summed"]] = 0.75, (0.5, 1.5)
    assert bound.run(theta[None])[0, 0] == pytest.approx(2.0 * Q + 0.75 + 0.75 * T, rel=1e-6)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"name": "if"}, "its name must be a Python name (letters, digits, _)"),
        ({"on": "torque"}, "on (='torque') must be one of signal, force, state"),
        ({"memory": 65}, "memory (=65) must be a whole number in [0, 64]"),
        ({"memory": True}, "memory (=True) must be a whole number in [0, 64]"),
        ({"memory": 64}, "function takes (u, t, p); a law on a signal with memory=64 is called with (u, t, dt, p, m)"),
        ({"on": "force"}, "function takes (u, t, p); a law on a force with no memory is called with (v, x, t, p)"),
        ({"function": 3}, "function (=3) must be a function"),
        ({"parameters": []}, "parameters (=[]) must be a list of 1 to 8 Parameter(...)"),
        ({"parameters": [Parameter("by", 1.0, "V", 1.0, 1.0)]}, "parameter by: low (=1) must be below high (=1)"),
        ({"parameters": [Parameter("by", 6.0, "V", -5.0, 5.0)]}, "parameter by (=6 V) must be in [-5, 5]"),
        ({"starts": []}, "starts is empty; give sizes from which a fit is tried, from hardly seen to gross"),
        ({"starts": [5.1]}, "starts: by (=5.1 V) must be in [-5, 5]"),
        ({"starts": [(1.0, 2.0)]}, "starts: (1.0, 2.0) has 2 values; 1 are needed (by)"),
        ({"starts": [0.0]}, "starts: 0.0 is neutral, where the law changes nothing"),
        ({"starts": ["far"]}, "starts: 'far' is not a number, nor a tuple of numbers"),
        ({"places": "input"}, "places (='input') must be a list of names"),
        ({"name": "bias"}, "the library has a law of that name (on a signal); choose another"),
    ],
)
def test_an_own_law_that_cannot_be_gets_one_line(change: dict[str, Any], said: str) -> None:
    good: dict[str, Any] = {
        "name": "shifted", "on": "signal", "function": lambda u, t, p: u + p.by, "starts": [-5.0, 5.0],
        "parameters": [Parameter("by", 0.0, "V", -5.0, 5.0)],
    }  # fmt: skip
    law = Law(**good)
    assert (
        law.sizes() == ((-5.0,), (5.0,)) and law.arguments() == ("u", "t", "p") and law.parameters[0].tolerance == 0.0
    )
    assert law.allowed("input", "u") and not law.allowed("input", "u", by_default=False)
    with pytest.raises(StageError) as e:
        Law(**good | change)
    assert str(e.value) == f"law {change.get('name', 'shifted')!r}: {said}"


def test_why_numba_cannot_is_said_in_a_line() -> None:
    assert cannot(ValueError("Failed in nopython mode\n\n  first reason  \nsecond")) == "first reason"
    assert cannot(ValueError("x" * 200)) == "x" * 100 and cannot(ValueError("")) == "ValueError"
    assert cannot(ValueError("IMPORT_NAME")) == "an import inside a function; it belongs at the top of the file"


# ---- forces ----------------------------------------------------------------------------------------------------------


def damper(**more: Any) -> tuple[BoundSystem, Array, Array]:
    """A damper whose force, motion and speed are measured; with its displacement and speed."""
    t = 0.01 * np.arange(400)
    x, v = 0.5 * np.sin(2.0 * t), np.cos(2.0 * t)
    system = System(
        "damper", "force", lambda u, p: p.c * u.velocity, {"f": "N"}, velocity="v", position="x",
        units={"position": "mm"}, parameters=[Parameter("c", 3.0, "N s/m")], **more,
    )  # fmt: skip
    return BoundSystem(system, [record(t, x=x, v=v, f=3.0 * v)]), x, v


def pulling(v: Any, x: Any, t: Any, p: Any) -> Any:
    return NUMBERS["one"] * p.pull * v * x


def test_laws_of_force_add_what_their_equations_say() -> None:
    own = Law("pulling", "force", pulling, [Parameter("pull", 0.0, "1", -9.0, 9.0)], [1.0, -1.0])
    bound, x, v = damper(laws=[own])
    assert bound.data.cutoff is None and not any("forces compared" in n for n in bound.notes)
    names = {e.name for e in bound.stage.effects}
    assert {"force.viscous", "force.coulomb", "force.elastic_plastic", "f.gain", "f.lag"} <= names
    assert not names & {"f.bias", "f.cubic"} and "f.bias" in {e.name for e in damper(places=["f"])[0].stage.effects}
    neutral, index = bound.stage.neutral(), bound.stage.index()

    def with_law(law: str, *numbers: float) -> Array:
        theta = neutral.copy()
        theta[index[law]] = numbers
        return np.asarray(bound.run(theta[None])[0, 0] - 3.0 * v)

    assert with_law("force.viscous", 0.7) == pytest.approx(0.7 * v)
    assert with_law("force.force_offset", 0.7) == pytest.approx(np.full(400, 0.7))
    assert with_law("force.spring", 0.4) == pytest.approx(0.4 * x)
    assert with_law("force.pulling", 1.5) == pytest.approx(1.5 * v * x)
    coulomb = with_law("force.coulomb", 0.6)
    assert coulomb[np.abs(v) > 0.05] == pytest.approx(0.6 * np.sign(v)[np.abs(v) > 0.05], rel=1e-3)
    both = neutral.copy()
    both[index["force.viscous"]], both[index["force.spring"]] = 0.7, 0.4
    assert bound.run(both[None])[0, 0] == pytest.approx(3.7 * v + 0.4 * x)
    regimes, units = bound.data.regimes()
    assert units["velocity"] == "mm/s" and units["position"] == "mm" and "acceleration" not in regimes
    assert set(np.unique(regimes["direction"])) == {-1.0, 1.0} | ({0.0} if (np.abs(v) < 0.01 * rms(v)).any() else set())


def test_a_force_that_goes_the_wrong_way_for_its_law_is_said() -> None:
    bound, x, v = damper(without=[])
    judge = LeastSquaresProblem(bound.thinned, bound.floor)
    d = as_given(Logs(bound, None), judge.fit((), bound.stage.neutral()))
    fit = judge.fit(("force.spring",), bound.stage.neutral())
    d.final = fit
    fit.theta[bound.stage.index()["force.spring"]] = 0.25
    assert not any("negative" in s for s in parameter_warnings(bound, judge, d))
    fit.theta[bound.stage.index()["force.spring"]] = -0.25
    (said,) = [s for s in parameter_warnings(bound, judge, d) if s.startswith("force.spring is negative")]
    assert said.startswith(
        "force.spring is negative (-0.25 (N)/(mm)): it pushes away from the middle instead of back to it; "
    )


def test_forces_are_compared_up_to_a_frequency_and_not_at_the_ends() -> None:
    t = 0.005 * np.arange(1600)
    x = np.sin(3.0 * t) + 0.2 * np.sin(11.0 * t)
    a = -9.0 * np.sin(3.0 * t) - 24.2 * np.sin(11.0 * t)
    d = Data(mover(), [record(t, x=x, f=2.0 * a + 0.01 * white(1, 1600))])
    assert d.cutoff is not None and 1.5 < d.cutoff < 4.0 and d.motion_cutoff == pytest.approx(3.0 * d.cutoff)
    assert d.notes[-1] == f"forces compared up to {d.cutoff:.3g} Hz (cutoff= sets another)"
    edge = 2.0 / d.cutoff + 8 * 0.005
    lost = np.isnan(d.measured[0])
    assert lost.tolist() == ((t < edge) | (t > t[-1] - edge)).tolist()
    inside = ~lost
    assert d.u[0][2][inside] == pytest.approx(a[inside], abs=0.3)
    again = Data(mover(), [record(t, x=x, f=2.0 * a)], like=d)
    assert again.cutoff == d.cutoff and again.notes == []
    own = Data(mover(cutoff=3.0), [record(t, x=x, f=2.0 * a)])
    assert own.cutoff == 3.0 and own.notes == []
    assert d.noise() == pytest.approx([0.01 * np.sqrt(2.0 * d.cutoff * 0.005)], rel=0.4)
    speed = System("mover", "force", model_of_speed, {"f": "N"}, position="x", parameters=[unknown("c", 1.0, "-")])
    log = record(t, x=x, v=x, f=2.0 * a)
    both = System("mover", "force", model_of_speed, {"f": "N"}, velocity="v", parameters=[unknown("c", 1.0, "-")])
    cutoffs = [Data(s, [log]).cutoff for s in (speed, mover(velocity="v"), both)]
    assert [c is None for c in cutoffs] == [False, False, True]  # what is differentiated is so up to some frequency


# ---- what a user writes ----------------------------------------------------------------------------------------------

MOVING: dict[str, Any] = {
    "kind": "simulate", "model": lambda x, u, p: (x.speed, u.u), "outputs": {"angle": "rad"},
    "states": {"angle": "rad", "speed": "rad/s"}, "rates": {"speed": "angle"},
}  # fmt: skip


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"kind": "dynamic"}, "kind (='dynamic') must be one of static, force, simulate, closed_loop"),
        ({"model": 3}, "model (=3) must be a function"),
        ({"outputs": {}}, "outputs is empty; at least one measured channel must be explained"),
        ({"inputs": ["u"]}, "inputs (=['u']) must be a dict of name -> unit"),
        (
            {"outputs": {"y 1": "V"}},
            "outputs: 'y 1' must be a Python name (letters, digits, _); --map renames a log's channel",
        ),
        (
            {"inputs": {"_u": "A"}},
            "inputs: '_u' must be a Python name (letters, digits, _); --map renames a log's channel",
        ),
        ({"parameters": [3]}, "parameters: 3 is not a Parameter; write Parameter(...) or unknown(...)"),
        ({"parameters": [Parameter("a", True, "-")]}, "parameter 'a': value (=True) must be a number"),
        ({"parameters": [Parameter("if", 1.0, "-")]}, "parameter 'if' must be a Python name"),
        ({"parameters": [Parameter("a", 3.0, "-", 0.0, 2.0)]}, "parameter a (=3 -) must be in [0, 2]"),
        ({"parameters": [unknown("a", 1.0, "-")] * 2}, "two parameters share a name among a, a"),
        (
            {"kind": "force"},
            "kind 'force' needs position=, the channel of the displacement, or velocity=, that of its rate",
        ),
        ({"kind": "simulate"}, "kind 'simulate' needs states=, name -> unit"),
        (
            {"kind": "closed_loop", "states": {"y": "V"}, "control": gain},
            "kind 'closed_loop' needs control=, a function (r, y, p), and commands=, name -> unit of what it returns",
        ),
        (MOVING | {"rates": {"speed": "way"}}, "rates: 'way' is not a state; states are angle, speed"),
        (MOVING | {"masses": {"angle": "m"}}, "masses: 'angle' is no velocity: not of rates, nor in a unit of one"),
        (MOVING | {"masses": {"speed": "m"}}, "masses: 'm' is not a parameter; parameters are a"),
        (MOVING | {"start": {"way": 1.0}}, "start: 'way' is not a state; states are angle, speed"),
        (
            MOVING | {"start": {"angle": "fitted"}, "window": 1.0},
            "start: 'angle' 'fitted' does not go with window=, which starts from measured states",
        ),
        (MOVING | {"start": {"angle": "there"}}, "start: 'angle' (='there') must be a number or 'fitted'"),
        (MOVING | {"start": {"angle": np.inf}}, "start: 'angle' (=inf) must be a number or 'fitted'"),
        (MOVING | {"start": {"angle": True}}, "start: 'angle' (=True) must be a number or 'fitted'"),
        (
            MOVING | {"outputs": {"way": "m"}},
            "output 'way' is not a state; name it like one of angle, speed, or give output=, a function (x, u, p)",
        ),
        ({"between": "curve"}, "between (='curve') must be one of hold, line, smooth"),
        ({"start_force": "some"}, "start_force (='some') must be 'unloaded' or 'measured'"),
        ({"window": 0.0}, "window (=0.0) must be above 0"),
        ({"cutoff": np.inf}, "cutoff (=inf) must be above 0"),
        ({"places": ["v"]}, "places: 'v' is not known; allowed: force, input, output, state, u, y"),
        ({"laws": "bias"}, "laws (='bias') must be a list of Law(...)"),
        ({"laws": [3]}, "laws: 3 is not a Law; write Law(name, on, function, parameters, starts)"),
    ],
)
def test_a_system_that_cannot_be_gets_one_line(change: dict[str, Any], said: str) -> None:
    good: dict[str, Any] = {
        "kind": "static", "model": gain, "outputs": {"y": "V"}, "inputs": {"u": "A"},
        "parameters": [unknown("a", 1.0, "V/A")],
    }  # fmt: skip
    assert not System("map", **good).holds
    with pytest.raises(StageError) as e:
        System("map", **good | change)
    assert str(e.value) == f"system 'map': {said}"


def test_a_system_says_what_it_is_of() -> None:
    shaft = System("shaft", **MOVING, inputs={"u": "A"}, places=["speed", "output"])
    assert shaft.holds and not System("shaft", **MOVING, between="line").holds
    assert shaft.channels() == ("u", "angle") and shaft.optional() == set()
    assert shaft.reading_of("angle") == "angle_sensor" and mapping().reading_of("y") == "y"
    assert shaft.allows("state", "speed") and shaft.allows("output", "angle") and not shaft.allows("input", "u")
    assert mapping().allows("input", "u") and mover().channels() == ("x", "f")
    p = unknown("a", 2.0, "m", -1.0, 9.0)
    assert (p.name, p.value, p.unit, p.low, p.high, p.tolerance) == ("a", 2.0, "m", -1.0, 9.0, np.inf)
    law = Law("shifted", "signal", shifted, [Parameter("by", 0.0, "V", -5.0, 5.0)], [-5.0], places=["w"])
    with pytest.raises(StageError) as e:
        mapping(laws=[law])
    assert str(e.value) == (
        "system 'map': law 'shifted': places: 'w' is not known; allowed: force, input, output, state, u, y"
    )
    twice = Law("shifted", "signal", shifted, [Parameter("by", 0.0, "V", -5.0, 5.0)], [-5.0])
    with pytest.raises(StageError, match="^system 'map': laws: two are named 'shifted'$"):
        mapping(laws=[twice, twice])


FILE = """
from vaneloop.identification import System, unknown
{0}
system = System("lag", "static", lambda u, p: p.a * u.u, {{"y": "V"}}, {{"u": "A"}}, [unknown("a", 1.0, "-")])
{1}
"""


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (FILE.format("", "system.outputs = [3"), "line 5: '[' was never closed"),
        (FILE.format("1 / 0", ""), "failed at line 3 of model.py: ZeroDivisionError: division by zero"),
        (FILE.format('System("a", "b", 3, {})', ""), "system 'a': kind (='b') must be one of static, force, simulate, "
         "closed_loop"),
        ("", "0 objects of vaneloop.System; exactly one is needed, as in system = System(...)"),
        (FILE.format("", 'other = System("b", "static", abs, {"y": "V"})'), "2 objects of vaneloop.System; exactly one "
         "is needed, as in system = System(...)"),
    ],
)  # fmt: skip
def test_a_file_without_one_system_gets_one_line(tmp_path: Path, text: str, said: str) -> None:
    at = tmp_path / "model.py"
    at.write_text(text)
    before = list(sys.path)
    with pytest.raises(StageError) as e:
        load_system(at)
    assert str(e.value) == f"{at}: {said}" and sys.path == before and "discrepancy" not in sys.modules
    at.write_text(FILE.format("import beside", "again = system"))
    (tmp_path / "beside.py").write_text("")
    assert load_system(at).name == "lag"  # of two names, one system
    with pytest.raises(StageError, match="no such file; --system wants a Python file with a System in it"):
        load_system(tmp_path / "none.py")
    (tmp_path / "model.txt").write_text("")
    with pytest.raises(StageError, match=r"model.txt: is not a Python file \(\*\.py\)$"):
        load_system(tmp_path / "model.txt")


@pytest.mark.parametrize(
    ("function", "said"),
    [
        (lambda u, t, p: u / 0.0, "failed{} with by 0 at u = -1: ZeroDivisionError: float division by zero"),
        (lambda u, t, p: [u], "returned [-1.0] with by 0 at u = -1; a finite number is needed"),
        (lambda u, t, p: float("nan"), "returned nan with by 0 at u = -1; a finite number is needed"),
        (lambda u, t, p: None, "returned None with by 0 at u = -1; a finite number is needed"),
        (
            lambda u, t, p: u + 0.5,
            "must change nothing at its neutral sizes (by 0), but gives -0.5 at u = -1; -1 is needed",
        ),
        (lambda u, t, p: u + 1.0 / (p.by - 2.0) + 0.5, "failed{} with by 2 at u = -1: ZeroDivisionError: float "
         "division by zero"),
    ],
)  # fmt: skip
def test_an_own_law_is_tried_over_the_range_of_the_data(function: Any, said: str) -> None:
    law = Law("own", "signal", function, [Parameter("by", 0.0, "V", -5.0, 5.0)], [2.0])
    size = Size(-1.0, 3.0, 1.0, 2.0, 0.1, 6.0, unit="V")
    with pytest.raises(StageError) as e:
        try_law(law, "u", size)
    where = re.sub(r" at line \d+ of \w+\.py", "", str(e.value))
    assert where == f"law 'own' on u: {said.format('')}"


def test_an_own_law_of_a_force_and_one_that_remembers_are_tried_too() -> None:
    seen: list[tuple[float, ...]] = []

    def pull(v: Any, x: Any, t: Any, p: Any) -> Any:
        seen.append((v, x, t))
        return p.by * v

    size = Size(-1.0, 3.0, 1.0, 2.0, 0.1, 6.0, unit="m", force=7.0, speed=2.0, travel=0.5)
    try_law(Law("own", "force", pull, [Parameter("by", 0.0, "N", -5.0, 5.0)], [2.0]), "force", size)
    v, x, t = np.array(seen).T.reshape(3, 2, 9)
    assert (
        np.array_equal(v[0], v[1])
        and v[0][0] == v[0][-1] == 0.0
        and v[0].max() == 3.0 == -v[0].min()
        and t[0] == pytest.approx(0.1 * np.arange(9))
    )
    assert (x[0].min(), x[0].max()) == (-0.5, 0.5) and np.diff(x[0]) == pytest.approx(np.full(8, 0.125))
    steps: list[float] = []

    def summed(u: Any, t: Any, dt: Any, p: Any, m: Any) -> Any:
        steps.append(dt)
        m[0] += dt
        return u + p.by * m[0]

    try_law(Law("own", "signal", summed, [Parameter("by", 0.0, "V", -5.0, 5.0)], [2.0], memory=1), "u", size)
    assert steps == [0.0, *[0.1] * 8] * 2


# ---- spikes, steps and columns ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("length", [1, 2, 3, 4])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_spike_is_as_long_as_it_may_be(length: int, sign: float) -> None:
    y = np.sin(0.02 * np.arange(2000)) + 0.01 * white(8, 2000)
    at = [200, 900, 1500]
    for k in at:
        y[k : k + length] += sign * 5.0
    wanted = [j for k in at for j in range(k, k + length)] if length <= 3 else []
    assert np.flatnonzero(spikes(y)).tolist() == wanted
    gaps = put(y, [100, 600])
    assert np.flatnonzero(spikes(gaps)).tolist() == wanted


def test_what_answers_an_input_or_comes_often_is_no_spike() -> None:
    y = np.sin(0.02 * np.arange(2000)) + 0.01 * white(8, 2000)
    at = np.array([200, 600, 900, 1500])
    y[at] += 5.0
    u = np.zeros(2000)
    u[at] = 1.0
    drive = 0.01 * white(9, 2000)
    assert np.flatnonzero(spikes(y, [drive])).tolist() == at.tolist()
    assert not spikes(y, [drive, u + drive]).any()  # each with a jump of the input beside it
    u[:] = 0.0
    u[200] = u[1000] = u[1100] = u[1200] = u[1300] = u[1400] = u[1450] = 1.0
    assert np.flatnonzero(spikes(y, [u + drive])).tolist() == at.tolist()  # one of its jumps in seven: chance
    assert not spikes(y[:49]).any()
    often = np.sin(0.02 * np.arange(2000)) + 0.01 * white(8, 2000)
    often[np.arange(20, 1900, 150)] += 5.0
    assert spikes(often).sum() == 0  # 13 in 2000 are more than a half in a hundred
    few = put(often, np.arange(20, 1900, 150)[9:], 0.0)
    del few
    swings_about = np.where(np.arange(2000) % 100 < 50, 1.0, -1.0) + 0.01 * white(8, 2000)
    assert not spikes(swings_about).any()
    log = record(np.arange(2000.0), u=drive, y=y)
    d = Data(mapping(), [log])
    assert np.flatnonzero(np.isnan(d.y[0][0])).tolist() == at.tolist()
    assert d.notes == [f"log: y: 4 samples left out that jump away and back, first {y[200]:.4g} at 200 s"]
    one = Data(mapping(), [record(np.arange(2000.0), u=drive, y=put(y, at[1:], 0.0))])
    assert any(n.startswith("log: y: ") for n in one.notes)


@pytest.mark.parametrize("step", [0.05, 0.3])
def test_the_step_of_a_sensor_that_rounds_is_among_those_to_begin_from(step: float) -> None:
    m = 4.0 * np.sin(0.013 * np.arange(800)) + 0.3 * np.sin(0.31 * np.arange(800))
    y = np.round(m / step) * step + 0.002 * white(1, 800)
    found = steps_seen(put(y, 7), m, 0.002)
    assert found == sorted(found) and min(abs(s - step) for s in found) < 2e-3 * step
    assert steps_seen(y[:1], m[:1], 0.1) == [] == steps_seen(y, np.ones(800), 0.1) == steps_seen(y, m, 10.0)
    bound = BoundSystem(mapping(places=["y"]), [record(np.arange(800.0), u=m, y=y)])
    starts = [s for (s,) in bound.stage.effect("y.quantisation").starts]
    assert starts == sorted(starts) and min(abs(s - step) for s in starts) < 5e-3 * step


def test_columns_of_a_log_are_channels_and_what_follows_from_them() -> None:
    t = 3.0037 + 0.01 * np.arange(500)
    x = np.sin(2.0 * t)
    log = record(t - t[0], x=x, w=put(np.arange(500.0), slice(100, 200)), none=np.full(500, np.nan))
    assert column_of(log, t, "time") is t
    assert column_of(log, t, "time_every_700_ms") == pytest.approx(t % 0.7)
    assert column_of(log, t, "x_every_0p3") == pytest.approx(x % 0.3)
    assert column_of(log, t, "w") == pytest.approx(np.arange(500.0))  # a gap is bridged
    assert not column_of(log, t, "none").any() and column_of(log, t, "stops_of_x") == pytest.approx(x)
    tau, y = 0.25, x[0]
    for k in range(1, 500):  # exact between samples that straight lines join
        z = 0.01 / tau
        y = x[k] - (x[k] - x[k - 1]) / z + (y - x[k - 1] + (x[k] - x[k - 1]) / z) * np.exp(-z)
    late = column_of(log, t, "x_lagged_by_250_ms")
    assert late[0] == x[0] and late[-1] == pytest.approx(y)
    way, distance, since = (column_of(log, t, f"{p}_of_x") for p in ("direction", "distance_since_reversal",
                                                                     "time_since_reversal"))  # fmt: skip
    moves = np.abs(np.cos(2.0 * t)) > 0.3
    assert np.all((way == np.sign(np.cos(2.0 * t)))[moves & (t > 3.5)])
    turned = (np.floor((2.0 * t - np.pi / 2) / np.pi) * np.pi + np.pi / 2) / 2.0  # s, of the last turn
    late_enough = moves & (turned > 3.0)
    assert since[late_enough] == pytest.approx((t - turned)[late_enough], abs=0.06)
    assert distance[late_enough] == pytest.approx(np.abs(x - np.sin(2.0 * turned))[late_enough], abs=0.02)
    named = {"way_of": x, "direction_of_x": x + 1.0, "time": x}
    own = record(t - t[0], **named)
    assert column_of(own, t, "direction_of_x") == pytest.approx(x + 1.0)  # a channel of that name is that channel
    assert every(0.7, 3.0) == "time_every_700_ms" and every(0.123456789, 100.0) == "time_every_123460_us"
    assert sides_of("a_minus_b_minus_c", ["a", "b_minus_c"]) == ("a", "b_minus_c")
    assert sides_of("a_minus_b", ["a", "b", "a_minus_b"]) is None and sides_of("a_minus_b", ["a"]) is None


def test_how_large_the_data_of_a_place_are() -> None:
    t = 0.01 * np.arange(5000)
    x = 3.0 + 2.0 * np.sin(4.0 * t)
    s = _size([record(t)], [put(x, slice(10, 20))], "mm", travel=0.5)
    assert (s.low, s.high) == pytest.approx((1.0, 5.0), abs=0.01)
    assert s.rate == pytest.approx(8.0 / np.sqrt(2.0), rel=0.01) and s.fastest == pytest.approx(8.0, rel=0.01)
    assert s.step == pytest.approx(0.01) and s.span == pytest.approx(49.99) and (s.unit, s.travel) == ("mm", 0.5)
    held = np.repeat(white(1, 500), 10)
    assert _size([record(t)], [held], "mm").held == pytest.approx(0.1)
    flat = _size([record(t), record(2.0 * t)], [np.full(5000, 4.0)] * 2, "mm")
    assert (flat.low, flat.high, flat.span) == pytest.approx((2.0, 6.0, 99.98)) and flat.held == 0.0
    assert flat.rate == flat.fastest == pytest.approx(4.0 / 99.98)
    none = _size([record(t)], [np.full(5000, np.nan)], "mm")
    assert (none.low, none.high) == (-0.5, 0.5)
    one = _size([record(t)], [np.where(t < 1e-3, 1.0, 0.0)], "mm")  # one sample in 5000
    assert (one.low, one.high) == (0.0, 1.0)


# ---- loops, machines and windows -------------------------------------------------------------------------------------


def plant_of_loop(x: Any, u: Any, p: Any) -> Any:
    return u.i - NUMBERS["one"] * p.c * x.y


def proportional(r: Any, y: Any, p: Any) -> Any:
    return p.k * (r.w - y.y)


def test_laws_in_a_loop_act_before_the_controller_and_behind_it() -> None:
    """A proportional controller: a bias of its sensor moves the loop as a change of its demand does."""
    system = System(
        "loop", "closed_loop", plant_of_loop, {"y": "V"}, {"w": "V"},
        [Parameter("c", 0.5, "1/s"), Parameter("k", 2.0, "1/s")], states={"y": "V"}, start={"y": 0.3},
        control=proportional, commands={"i": "V/s"},
    )  # fmt: skip
    w = np.repeat(white(3, 5), 10)

    def looped(demand: Array, bias: float = 0.0, kick: float = 0.0, begin: float = 0.3) -> Array:
        """The exact loop, whose command holds from one sample to the next."""
        y = [begin]
        for k in range(49):
            i = 2.0 * (demand[k] - y[-1] - bias) + kick
            y.append(i / 0.5 + (y[-1] - i / 0.5) * np.exp(-0.5 * 0.08))
        return np.array(y) + bias

    bound = BoundSystem(system, [record(SHORT, w=w, y=looped(w))])
    neutral, index = bound.stage.neutral(), bound.stage.index()

    def with_law(law: str, *numbers: float) -> Array:
        theta = neutral.copy()
        theta[index[law]] = numbers
        return np.asarray(bound.run(theta[None])[0, 0])

    assert with_law("i.bias", 0.0) == pytest.approx(looped(w), abs=2e-3)
    assert with_law("i.bias", 0.4) == pytest.approx(looped(w, kick=0.4), abs=2e-3)
    assert with_law("y_sensor.bias", 0.25) == pytest.approx(looped(w, 0.25), abs=2e-3)
    assert not any(name.startswith("w.") for name in index) and {"i.gain", "y.leak", "y_sensor.gain"} <= set(index)


def swinging(x: Any, u: Any, p: Any) -> Any:
    return x.speed, NUMBERS["one"] * (u.f - p.k * x.way) / p.m


def machine(**more: Any) -> System:
    """A mass on a spring that a force drives; its displacement is measured."""
    given: dict[str, Any] = {
        "outputs": {"way": "m"}, "inputs": {"f": "N"}, "states": {"way": "m", "speed": "m/s"},
        "rates": {"speed": "way"}, "masses": {"speed": "m"},
        "parameters": [Parameter("m", 2.0, "kg"), Parameter("k", 8.0, "N/m")],
    }  # fmt: skip
    return System("machine", "simulate", swinging, **given | more)


def test_a_law_of_force_on_a_machine_is_that_force_over_its_mass() -> None:
    f = np.repeat(white(4, 5), 10)
    bound = BoundSystem(machine(start={"way": 0.2, "speed": -0.1}), [record(SHORT, f=f, way=0.1 * white(5, 50))])
    neutral, index = bound.stage.neutral(), bound.stage.index()

    def reference(viscous: float = 0.0, offset: float = 0.0, spring: float = 0.0) -> Array:
        x = [np.array([0.2, -0.1])]
        for k in range(49):
            got = scipy.integrate.solve_ivp(
                lambda t, x, k=k: [x[1], (f[k] - (8.0 + spring) * x[0] - viscous * x[1] - offset) / 2.0],
                SHORT[k : k + 2], x[-1], rtol=1e-8, atol=1e-10,
            )  # fmt: skip
            x.append(got.y[:, -1])
        return np.array(x)[:, 0]

    def with_law(law: str, *numbers: float) -> Array:
        theta = neutral.copy()
        theta[index[law]] = numbers
        return np.asarray(bound.run(theta[None])[0, 0])

    assert bound.run(neutral[None])[0, 0] == pytest.approx(reference(), abs=2e-3)
    assert with_law("speed.viscous", 1.5) == pytest.approx(reference(viscous=1.5), abs=2e-3)
    assert with_law("speed.force_offset", 0.4) == pytest.approx(reference(offset=0.4), abs=2e-3)
    assert with_law("speed.spring", 3.0) == pytest.approx(reference(spring=3.0), abs=2e-3)
    assert not any(n.startswith("way.") for n in index)  # a displacement is the integral of its velocity
    units = {p.name: p.unit for e in bound.stage.effects if e.name == "speed.viscous" for p in e.parameters}
    assert list(units.values()) == ["(N)/(m/s)"]


def test_a_machine_in_windows_begins_each_where_it_was_measured() -> None:
    f = np.repeat(white(4, 5), 10)
    t = SHORT
    way = 0.3 * np.cos(3.0 * t)  # another motion than the model's: within a window it leaves it
    free = BoundSystem(machine(window=0.8), [record(t, f=f, way=way)])
    y = free.run(free.stage.neutral()[None])[0, 0]
    first = np.flatnonzero(free.data.restarts(0, 50)[0])
    assert first.tolist() == [0, 10, 20, 30, 40] and y[first] == pytest.approx(way[first])
    v = free.data.restarts(0, 50)[1][1]
    for k in first[1:-1]:
        got = scipy.integrate.solve_ivp(
            lambda s, x: [x[1], (f[min(int((s + 1e-9) / 0.08), 49)] - 8.0 * x[0]) / 2.0],
            [t[k], t[k + 9]], [way[k], v[k]], rtol=1e-7, max_step=0.02,
        )  # fmt: skip
        assert y[k + 9] == pytest.approx(got.y[0, -1], abs=3e-3)


def test_a_frequency_is_found_from_short_windows_where_a_free_run_loses_its_phase() -> None:
    t = 0.08 * np.arange(100)
    system = machine(
        parameters=[Parameter("m", 2.0, "kg"), unknown("k", 30.0, "N/m")], places=["f"], start={"speed": 0.0}
    )
    log = record(t, f=np.zeros(100), way=0.3 * np.cos(np.sqrt(8.0 / 2.0) * 1.5 * t) + 1e-4 * white(1, 100))
    bound = BoundSystem(system, [log])
    assert bound.stage.parameters[1].value == pytest.approx(8.0 * 1.5**2, rel=0.01)
    assert bound.runner.steps in (2, 4, 8, 16) and bound.data.window is None


def test_an_integration_takes_as_many_steps_as_its_rate_needs() -> None:
    c = 12.0
    system = System(
        "lag", "simulate", decay, {"y": "V"}, {"u": "V"}, [Parameter("c", c, "1/s")], states={"y": "V"},
        start={"y": 0.7}, places=["u"],
    )  # fmt: skip
    log = driven_decay(1, 0.7, c)
    bound = BoundSystem(system, [log])
    y = bound.run(bound.stage.neutral()[None])[0, 0]
    assert y == pytest.approx(log.columns["y"], abs=3e-3 * np.std(log.columns["y"]))
    assert bound.runner.steps == 2


def test_springs_that_carry_a_force_at_the_start_are_said() -> None:
    """A damper and a spring with friction, held by 3 N where the log begins."""
    t = 0.01 * np.arange(400)
    x, v = 0.5 * np.cos(2.0 * t + 0.4), -np.sin(2.0 * t + 0.4)

    def spring(first: float) -> Array:
        out = np.full(400, first)
        for k in range(1, 400):
            out[k] = np.clip(out[k - 1] + 20.0 * (x[k] - x[k - 1]), -3.0, 3.0)
        return out

    log = record(t, x=x, v=v, f=v + spring(3.0) + 1e-3 * white(2, 400))

    def bound_of(start: str) -> tuple[BoundSystem, Array]:
        system = System(
            "damper", "force", lambda u, p: p.c * u.velocity, {"f": "N"}, velocity="v", position="x",
            parameters=[Parameter("c", 1.0, "N s/m")], start_force=start,
        )  # fmt: skip
        bound = BoundSystem(system, [log])
        theta = bound.stage.neutral()
        theta[bound.stage.index()["force.elastic_plastic"]] = 20.0, 3.0
        return bound, theta

    (unloaded, theta), (measured, _) = bound_of("unloaded"), bound_of("measured")
    held = measured.data.held(0)
    assert unloaded.run(theta[None])[0, 0][:5] - v[:5] == pytest.approx(20.0 * (x - x[0])[:5], abs=1e-6)
    assert measured.run(theta[None])[0, 0] - v == pytest.approx(spring(held - v[0]), abs=1e-6)
    judge = LeastSquaresProblem(unloaded.thinned, unloaded.floor)
    d = as_given(Logs(unloaded, None), judge.fit((), unloaded.stage.neutral()))
    assert _loaded(unloaded, judge, d) == []  # no spring
    d.final = judge.fit(("force.elastic_plastic",), theta, 12)
    (said,) = _loaded(unloaded, judge, d)
    words = re.fullmatch(
        r"force.elastic_plastic taken as unloaded at the start, where (\S+) N was measured; "
        r'with start_force="measured" '
        r"the error goes from (\S+) to (\S+) N(, elastic_plastic \w+ \S+ to \S+)*",
        said,
    )
    assert words is not None and float(words[1]) == pytest.approx(held, rel=0.01)
    assert float(words[2]) > 10.0 * float(words[3]) and not unloaded.runner.loaded
    assert float(words[2]) == pytest.approx(rms(unloaded.errors(d.final.theta)["log"]), rel=0.01)
    assert _loaded(measured, judge, d) == []


# ---- the run that tells rivals apart ---------------------------------------------------------------------------------


def rivals_of(bound: BoundSystem, right: str, wrong: str) -> Any:
    """A diagnosis that has named one law, where another is as likely, each with its fit."""
    judge = LeastSquaresProblem(bound.thinned, bound.floor)
    fits = {name: judge.fit((name,), bound.stage.neutral(), 12) for name in (right, wrong)}
    named = SimpleNamespace(effect=right, rivals=[wrong, "unfitted"], fits={wrong: fits[wrong]})
    left = np.array([0.02])
    return SimpleNamespace(effects=[named], final=fits[right], error_after=left, floor=0.5 * left)


def test_a_run_tells_rivals_apart_by_the_error_with_the_wrong_one() -> None:
    u = 0.6 + 0.3 * np.sin(T)
    system = mapping(parameters=[unknown("a", 1.0, "V/A")])
    log = record(T, u=u, y=2.0 * u + 0.4 * u**3 + 0.01 * white(4, 60))
    bound = BoundSystem(system, [log])
    d = rivals_of(bound, "u.cubic", "y.bias")
    bench = _Bench(bound, Limits({"u": (-1.0, 2.0)}))
    rivals = _Rivals(bench, d)
    assert rivals.left.tolist() == [0.02] and len(rivals.pairs) == 1 and rivals.pairs[0][2] == ()
    run = bench.of_shape(SHAPES["one slow ramp up and down"], 1.0)
    c = d.final.theta[bound.stage.index()["u.cubic"]][0]
    a, b = (fit.theta[0] for fit in (d.final, d.effects[0].fits["y.bias"]))
    offset = d.effects[0].fits["y.bias"].theta[bound.stage.index()["y.bias"]][0]
    x = run["u"]
    one = by_hand([x, np.ones(len(x))], a * (x + c * x**3))
    two = by_hand([x, x**3], b * x + offset)
    (told,) = rivals.told(run) or [np.nan]
    floors = [float(Data(system, [record(bench.t, u=x, y=y)]).noise()[0]) for y in (a * (x + c * x**3), b * x + offset)]
    wanted = [0.5 * np.log(1.0 + np.mean(e**2) / max(0.02, f) ** 2) for e, f in zip((one, two), floors, strict=True)]
    assert told == pytest.approx(min(wanted), rel=0.1)
    noisy = rivals.told(run, 1)
    assert noisy is not None and noisy != [told] and noisy[0] == pytest.approx(told, abs=0.5)
    assert rivals.told({"u": np.zeros(len(x))}) == [pytest.approx(0.0, abs=0.7)]
    limited = _Rivals(_Bench(bound, Limits({"u": (-1.0, 2.0), "y": (0.0, 1.0)})), d)
    assert limited.told(run) is None and limited.checked(run, [0]).startswith("in 0 of 0 simulations")
    assert rivals.row(0.7) == pytest.approx(np.exp(0.7))
    checked = rivals.checked(run, [0])
    words = re.fullmatch(r"in (\d) of 4 simulations with noise the right law is told, whichever it is", checked)
    assert words is not None and (int(words[1]) == 4) == (told > 0.5)
    far, near = rivals.goal + 1.0, rivals.goal - 0.1
    assert rivals.text("ramps", far, 9.0, "so", [0]) == (
        f"To distinguish u.cubic from y.bias: ramps, 9 s; the wrong law then leaves {np.exp(far):.2f} times the error "
        "of the right one; so."
    )
    assert rivals.text("ramps", near, 9.0, "", [0]) == (
        f"No run within the limits separates u.cubic from y.bias. With the best, ramps, the wrong law leaves "
        f"{np.exp(near):.2f} times the error of the right one; {np.exp(rivals.goal):.2f} times is required."
    )


def test_the_best_run_of_the_bank_is_recommended_and_improved(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is told here is how far a run's mean is from 0, where no run may go beyond 2; shifts help a little."""
    bound = straight_line()
    asked: list[tuple[str, int]] = []

    def told(self: Any, run: dict[str, Array], draw: int = 0) -> list[float] | None:
        return None if np.abs(run["u"]).max() > 2.0 else [float(np.mean(np.abs(run["u"]))), 0.1]

    monkeypatch.setattr(_Rivals, "told", told)
    monkeypatch.setattr(_Rivals, "checked", lambda self, run, of: asked.append(("checked", len(of))) or "so")
    monkeypatch.setattr(_Rivals, "goal", 0.5)
    d = rivals_of(bound, "u.cubic", "u.saturation")
    d.effects.append(SimpleNamespace(effect="u.saturation", rivals=["u.cubic"], fits={"u.cubic": d.final}))
    done: list[float] = []
    got = recommend(bound, d, Limits({"u": (-3.0, 3.0)}, seconds=6.0), done.append)
    assert done[-1] == 1.0 and done == sorted(done) and asked == [("checked", 1)]  # what no run tells is not asked
    table = got["table"]
    scores = [row["score"] for row in table]
    assert scores == sorted(scores, reverse=True) and got["score"] == scores[0] and got["separates"]
    assert got["profile"].endswith(", parts of it shifted") and got["profile"] == table[0]["profile"]
    assert table[0]["profile"].startswith("30 steps between the ends at random, 50 % of the range")
    assert {row["profile"].split(",")[0] for row in table} >= {"the log's own again", "one slow ramp up and down"}
    assert all(row["told"] == pytest.approx(np.exp(row["score"])) for row in table) and got["heads"] == _Rivals.heads
    unit, u = got["inputs"]["u"]
    assert unit == "A" and np.mean(np.abs(u)) == pytest.approx(got["score"]) and np.abs(u).max() <= 2.0
    assert np.count_nonzero(u != np.clip(u, -1.5, 1.5)) > 0 and got["t"] == pytest.approx(0.1 * np.arange(61))
    monkeypatch.setattr(_Rivals, "goal", 5.0)
    none = recommend(bound, d, Limits({"u": (-3.0, 3.0)}, seconds=6.0))
    assert not none["separates"] and none["text"].startswith("No run within the limits separates u.cubic from ")
    with pytest.raises(InputError, match="^system 'map': no run of the bank keeps its outputs within the limits$"):
        recommend(bound, d, Limits({"u": (9.0, 10.0)}, seconds=6.0))


@pytest.mark.parametrize(
    ("limits", "said"),
    [
        (Limits({"v": (0.0, 1.0)}), "limit 'v': allowed: u, y"),
        (Limits({}, {"y": 1.0}), "rate 'y': allowed: u"),
        (Limits({}, {}, 4.8), "a run of 4.8 s has 48 samples; allowed: 50 or more"),
    ],
)
def test_limits_that_cannot_be_get_one_line(limits: Limits, said: str) -> None:
    with pytest.raises(InputError) as e:
        _Bench(straight_line(), limits)
    assert str(e.value) == said
    bench = _Bench(straight_line(), Limits(seconds=5.0))
    assert len(bench.t) == 51 and bench.ranges == {"u": pytest.approx((0.3, 0.9), abs=0.01)}
    assert bench.usual["y"] == pytest.approx(np.interp(np.linspace(0.0, T[-1], 51), T, bench.bound.measured[0]))
    assert bench.log_again["u"] == pytest.approx(np.interp(np.linspace(0.0, T[-1], 51), T, bench.bound.data.u[0][0]))
    assert driven(mover()) == {"x": "mm"} and driven(mapping()) == {"u": "A"}
    assert driven(mover(position=None, velocity="v")) == {"v": ""}


def test_an_integration_is_as_fine_as_the_fitted_rate_needs() -> None:
    system = System(
        "lag", "simulate", decay, {"y": "V"}, {"u": "V"}, [unknown("c", 0.5, "1/s")], states={"y": "V"},
        start={"y": 0.7}, places=["u"],
    )  # fmt: skip
    bound = BoundSystem(system, [driven_decay(1, 0.7, 12.0)])
    assert bound.stage.parameters[0].value == pytest.approx(12.0, rel=0.01) and bound.runner.steps == 2


def test_of_values_that_are_drawn_those_nearest_to_the_logs_are_begun_from() -> None:
    system = mapping(places=["y"], parameters=[unknown("a", 1.0, "V/A")])
    bound = BoundSystem(system, [record(u=Q, y=2.5 * Q)])
    one, wide = np.ones(1), np.array([np.inf])
    scale = np.array([np.std(2.5 * Q)])
    drawn = [float(z[0]) for z in bound._drawn(one, [0], one, one, -wide, wide, scale)]
    off = [abs(z - 2.5) for z in drawn]
    assert len(drawn) == len(set(drawn)) >= 3 and off[0] < 0.5 and off[:3] == sorted(off[:3])
    bounded = bound._drawn(one, [0], one, one, np.array([1.0]), np.array([2.0]), scale)
    assert float(bounded[0][0]) == 2.0  # the nearest within its bounds


def test_an_output_that_is_0_all_along_has_a_model() -> None:
    bound = BoundSystem(mapping(places=["y"]), [record(u=Q, y=0.0 * Q)])
    assert bound.runner.far == 1e9 and bound.stage.parameters[0].value == pytest.approx(0.0, abs=1e-9)


# ---- first values, hidden states and what a sensor read first --------------------------------------------------------


def fast_lag(c: Parameter, **more: Any) -> System:
    return System(
        "lag", "simulate", decay, {"y": "V"}, {"u": "V"}, [c], states={"y": "V"}, start={"y": 0.7}, places=["u"], **more
    )  # fmt: skip


def test_a_model_that_runs_away_with_its_first_values_is_begun_from_others_or_said() -> None:
    log = driven_decay(1, 0.7)
    with pytest.raises(StageError) as e:
        BoundSystem(fast_lag(Parameter("c", 60.0, "1/s")), [log])
    assert str(e.value) == (
        "system 'lag': the model leaves all bounds or turns NaN for y at t = 0.16 s with its first parameters; other "
        "values of c are needed, or a window="
    )
    found = BoundSystem(fast_lag(unknown("c", -8.0, "1/s", -100.0, 100.0)), [driven_decay(1, 0.7, -0.5)])
    assert found.stage.parameters[0].value == pytest.approx(-0.5, rel=0.02)


def chained(x: Any, u: Any, p: Any) -> Any:
    return x.z - NUMBERS["one"] * p.c * x.y, -0.5 * x.z


def test_a_state_that_nobody_measures_goes_as_the_nominal_model_has_it() -> None:
    system = System(
        "pair", "simulate", chained, {"y": "V"}, {"u": "V"}, [Parameter("c", 0.8, "1/s")],
        states={"y": "V", "z": "A"}, start={"z": 2.0}, places=["u"],
    )  # fmt: skip
    y = 2.0 / 0.3 * (np.exp(-0.5 * SHORT) - np.exp(-0.8 * SHORT))
    bound = BoundSystem(system, [record(SHORT, u=0.0 * SHORT, y=y)])
    course = nominal_course(bound.runner, bound.stage.neutral())
    assert course.states[0][0] == pytest.approx(y) and course.commands == [] and not course.smalls.any()
    assert course.states[1][0] == pytest.approx(2.0 * np.exp(-0.5 * SHORT), rel=1e-3)


@pytest.mark.parametrize(
    ("how", "of", "value"), [("output adds", "y", 0.3), ("output adds", "u", 0.2), ("output times", "w", 0.2)],
)  # fmt: skip
def test_a_state_starts_where_its_sensor_with_its_curve_reads_what_was_read(how: str, of: str, value: float) -> None:
    log = driven_decay(1, 0.7, 8.0)
    log = record(SHORT + 0.5, u=log.columns["u"], y=log.columns["y"], w=np.cos(SHORT), begin=0.5)
    system = System(
        "lag", "simulate", decay, {"y": "V"}, {"u": "V"}, [Parameter("c", 8.0, "1/s")], states={"y": "V"}, places=["u"]
    )  # fmt: skip
    bound = BoundSystem(system, [log], curves={"curve": learned(how, "y_sensor", of, values=[value])})
    theta = bound.stage.neutral()
    theta[bound.stage.index()["curve"]] = value
    still, by = bound.run(np.array([bound.stage.neutral(), theta]))[:, 0]
    assert [still[0], by[0]] == pytest.approx([0.7, 0.7], abs=1e-4) and np.ptp(by - still) > 0.005


def test_an_input_that_runs_in_a_smooth_curve_is_integrated_as_one() -> None:
    t = 0.2 * np.arange(50)
    u = np.sin(1.7 * t)
    wanted = scipy.integrate.solve_ivp(
        lambda s, x: np.sin(1.7 * s) - 0.8 * x, t[[0, -1]], [0.7], t_eval=t, rtol=1e-9, atol=1e-11
    ).y[0]  # fmt: skip
    off = {}
    for between in ("hold", "line", "smooth"):
        bound = BoundSystem(fast_lag(Parameter("c", 0.8, "1/s"), between=between), [record(t, u=u, y=wanted)])
        theta = np.array([bound.stage.neutral()] * 2)
        theta[1, bound.stage.index()["u.gain"]] = 2.0
        still, twice = bound.run(theta)[:, 0]
        off[between] = np.abs(still - wanted).max()
        free = 0.7 * np.exp(-0.8 * t)
        assert twice - free == pytest.approx(2.0 * (still - free), abs=2e-3)
    assert off["smooth"] < 1e-3 < off["line"] < 0.02 < off["hold"]


def test_a_model_file_may_use_former_names_and_classes_of_its_own(tmp_path: Path) -> None:
    at = tmp_path / "model.py"
    own = "from __future__ import annotations\nfrom dataclasses import dataclass\n@dataclass\nclass Own:\n    a: int\n"
    at.write_text(own + FILE.format("from discrepancy import Record as Former", ""))
    with pytest.warns(
        FutureWarning, match="^discrepancy.Record is now vaneloop.identification.Record; the former name"
    ):
        assert load_system(at).name == "lag"
    at.write_text(FILE.format("import discrepancy; discrepancy.nothing", ""))
    with pytest.raises(StageError, match="AttributeError: module 'discrepancy' has no attribute 'nothing'$"):
        load_system(at)


# ---- what a user's function returns ----------------------------------------------------------------------------------


def a_list(x: Any, y: Any) -> Any:
    out = [x, y]
    return out


def an_array(x: Any, y: Any) -> Any:
    return np.array([x, y])


def either(x: Any, y: Any) -> Any:
    if x > 0.0:
        return [x, y]
    return y, x


def of_two_lengths(x: Any, y: Any) -> Any:
    if x > 0.0:
        return [x, y]
    return [x]


def a_tuple(x: Any, y: Any) -> Any:
    return x, y


def used_again(x: Any, y: Any) -> Any:
    out = [x, y]
    out.append(x)
    return out


def of_a_kind(x: Any, y: Any) -> Any:
    return np.array([x, y], np.float32)


def added(x: Any, y: Any) -> Any:
    return x + y


def empty(x: Any, y: Any) -> Any:
    return []


@pytest.mark.parametrize(
    ("function", "lists"),
    [
        (a_list, [False]), (an_array, [True]), (either, [False]), (of_two_lengths, []), (a_tuple, []),
        (used_again, []), (of_a_kind, []), (added, []), (empty, []),
    ],
)  # fmt: skip
def test_a_list_that_only_is_returned_is_known_as_one(function: Any, lists: list[bool]) -> None:
    """Of each return of a list: whether an array is made of it."""
    ends = _ends(run_frontend(function))
    assert [array is not None for _, array in ends] == lists
    assert all(made.value.op == "build_list" and len(made.value.items) == 2 for made, _ in ends)


@pytest.mark.parametrize(
    ("model", "said"),
    [
        (lambda u, p: (u.u, u.u), "model returned 2 values; 1 are needed (y)"),
        (lambda u, p: u.u[1:], "model returned shape (59,) for y; (60,) is needed, one value a sample"),
        (lambda u, p: np.where(u.u > 0.5, np.nan, u.u), "model returned nan for y at t = 0.6 s; it must be finite"),
    ],
)
def test_a_static_model_that_gives_something_else_is_said_at_once(model: Any, said: str) -> None:
    with pytest.raises(StageError) as e:
        BoundSystem(mapping(model=model), [record(u=U, y=Y)])
    assert str(e.value) == f"system 'map': {said}"
    both = System("two", "static", lambda u, p: np.array([u.u, 2.0 * u.u]), {"y": "V", "z": "V"}, {"u": "A"})
    code = UserCode(both, ["u"])
    assert code.static(np.zeros(0), U[None], T) == pytest.approx(np.array([U, 2.0 * U]))
    assert code.static(np.zeros(0), np.zeros((1, 60)), T).shape == (2, 60)
    level = UserCode(mapping(model=lambda u, p: p.a), ["u"])
    assert level.static(np.array([3.0]), U[None], T).tolist() == [[3.0] * 60]


@pytest.mark.parametrize(
    ("model", "said"),
    [
        (lambda x, u, p: (u.u, 1.0), "model returned 2 values; 1 are needed (y)"),
        (lambda x, u, p: [np.zeros(3)], "model returned an array of shape (3,) for y; a number is needed"),
        (lambda x, u, p: None, "model returned None for y at the first sample; a number is needed"),
        (lambda x, u, p: np.inf, "model returned inf for y at the first sample; it must be finite"),
    ],
)
def test_a_rate_that_is_no_number_is_said_at_the_first_sample(model: Any, said: str) -> None:
    system = System("lag", "simulate", model, {"y": "V"}, {"u": "V"}, states={"y": "V"})
    with pytest.raises(StageError) as e:
        UserCode(system, ["u"]).try_once([0.7], np.array([1.0]), np.array([0.7]))
    assert str(e.value) == f"system 'lag': {said}"


def drained(v: Any, t: Any, p: Any) -> Any:
    return NUMBERS["one"] * p.by * v


def test_an_own_law_of_a_state_is_taken_off_its_rate() -> None:
    own = Law("drained", "state", drained, [Parameter("by", 0.0, "1/s", -5.0, 5.0)], [1.0, -1.0], places=["y"])
    system = System(
        "lag", "simulate", decay, {"y": "V"}, {"u": "V"}, [Parameter("c", 0.8, "1/s")], states={"y": "V"},
        start={"y": 0.7}, places=["state"], laws=[own],
    )  # fmt: skip
    bound = BoundSystem(system, [driven_decay(1, 0.7)])
    theta = bound.stage.neutral()
    (name,) = (e.name for e in bound.stage.effects if e.name.endswith(".drained"))
    theta[bound.stage.index()[name]] = 0.3
    wanted = integrated(lambda t, x, u: u - 1.1 * x, bound.data.u[0][0], 0.7)
    assert bound.run(theta[None])[0, 0] == pytest.approx(wanted, abs=4e-3 * np.abs(wanted).max())


# ---- what runs and curves are made of --------------------------------------------------------------------------------


def test_shapes_are_ramps_sweeps_and_levels() -> None:
    s = np.linspace(0.0, 1.0, 801)
    x = (3.0 * s) % 1.0
    assert experiment._triangle(3.0, 0.5)(s) == pytest.approx(0.5 * np.where(x < 0.5, 4.0 * x - 1.0, 3.0 - 4.0 * x))
    assert experiment._triangle(1.0)(np.array([0.0, 0.25, 0.5, 0.75])) == pytest.approx([-1.0, 0.0, 1.0, 0.0])
    phase = 2.0 * np.pi * (s + 0.5 * (9.0 - 1.0) * s**2)  # from one cycle a run to nine
    assert experiment._chirp(0.2, 9.0)(s) == pytest.approx(0.2 * np.sin(phase), abs=1e-9)
    drawn = np.random.default_rng(7).uniform(-1.0, 1.0, 4)
    levels = experiment._levels(4, 7)(s)
    assert levels.tolist() == drawn[np.minimum((4.0 * s).astype(int), 3)].tolist()
    assert experiment._levels(4, 8)(s).tolist() != levels.tolist()
    ends = experiment._levels(40, 7, ends=True)(s)
    assert set(ends) == {-1.0, 1.0} and np.count_nonzero(np.diff(ends)) > 5


def test_a_course_of_a_motion_is_as_smooth_as_forces_are_compared() -> None:
    def bench(cutoff: float | None, rate: float = np.inf) -> Any:
        return SimpleNamespace(
            ranges={"x": (-1.0, 2.0), "u": (-1.0, 2.0)}, t=0.01 * np.arange(400),
            limits=Limits(rates={"x": rate, "u": rate}),
            system=SimpleNamespace(position="x", velocity=None),
            bound=SimpleNamespace(data=SimpleNamespace(motion_cutoff=cutoff)),
        )  # fmt: skip

    step = np.where(np.arange(400) < 200, -1.0, 5.0)
    rough = np.clip(step, -1.0, 2.0)
    assert _Bench._within(bench(None), "x", step).tolist() == rough.tolist()
    assert _Bench._within(bench(5.0), "u", step).tolist() == rough.tolist()  # no motion
    for cutoff, half in ((5.0, 20), (200.0, 1)):
        smooth = _Bench._within(bench(cutoff), "x", step)
        weights = np.hanning(2 * half + 3)
        assert len(smooth) == 400 and smooth[[0, -1]].tolist() == pytest.approx([-1.0, 2.0])
        assert np.diff(smooth)[199 - half : 200 + half] == pytest.approx(
            3.0 * weights[1:-1][: 2 * half + 1] / weights.sum()
        )
        assert np.count_nonzero(np.abs(np.diff(smooth)) > 1e-12) == 2 * half + 1
    limited = _Bench._within(bench(None, 2.0), "x", step)
    assert np.diff(limited).max() == pytest.approx(0.02) and limited[350] == pytest.approx(2.0)
    assert limited[199:300] == pytest.approx(-1.0 + 0.02 * np.arange(101))


def test_a_curve_with_a_jump_is_whole_with_it() -> None:
    jump = terms.Curve("output adds", 0, terms.INPUT, "u", 0.0, 4.0, lambda v: np.full(5, v[0]), lambda v: (v[1], 2.0))
    values = np.array([3.0, 0.5])
    assert jump.whole(values).tolist() == [2.5, 2.5, 3.0, 3.5, 3.5]
    assert jump.whole(np.array([3.0, 0.0])).tolist() == [3.0] * 5
    assert jump.at(np.array([1.0, 3.0]), jump.row(values)).tolist() == [2.5, 3.5]


def test_what_a_simulation_is_told_of_its_curves() -> None:
    follows = np.array([0.0, 1.0, -2.0, 3.0])
    data: Any = SimpleNamespace(column=lambda log, name: {"v": follows, f"{STOPS}v": follows}[name])
    table = np.linspace(0.0, 2.0, 9)
    stops = terms.Curve("state adds", 1, terms.COLUMN, f"{STOPS}v", 0.0, 4.0, lambda v: table)
    plain = terms.Curve("parameter times", 2, terms.COLUMN, "v", -3.0, 5.0, lambda v: v[0] * np.ones(257),
                        lambda v: (0.25, 1.5), period=2.0)  # fmt: skip
    of_state = terms.Curve("output times", 0, 1, "x", 0.0, 2.0, lambda v: np.zeros(257))
    rows = [(stops, table), (plain, plain.row(np.array([2.0]))), (of_state, np.zeros(257))]
    how, place, of, low, per, tables, jumps, columns = terms.curves_for_kernel(rows, data, 0, 3, np.array([0.5, 0.125]))
    made = stops.at(follows[:3], table)
    assert how.tolist() == [4, 1, 6] and place.tolist() == [1, 2, 0]
    assert of.tolist() == [[terms.COLUMN, -1], [terms.COLUMN + 1, -1], [1, -1]]
    assert columns.tolist() == [made.tolist(), follows[:3].tolist()]
    b = np.abs(made).max()
    assert low.tolist() == [-b, -3.0, 0.0] and tables[0] == pytest.approx(np.linspace(-b, b, 257))
    assert per == pytest.approx([256 / (2 * b), 256 / 8.0, 256 / 2.0])
    assert tables[1].tolist() == [2.0] * 257 and jumps[1].tolist() == [0.25, 1.5, 1e-300, 2.0]
    assert jumps[2].tolist() == [0.0, 0.0, 0.125, 0.0]
    (_, _, _, _, _, none, _, no_columns) = terms.curves_for_kernel([], data, 0, 3, np.zeros(0))
    assert none.shape == (0, 257) and no_columns.shape == (0, 3)


def test_stops_give_energy_where_their_weights_have_both_signs() -> None:
    radii = 2.0 * np.linspace(0.0, 1.0, COARSE_STOPS + 1)[1:] ** 2
    x = np.linspace(0.0, 2.0, 4001)

    def share(*weights: float) -> float:
        table = sum(w * np.minimum(x, r) for w, r in zip(weights, radii, strict=False))
        return share_given_back(0.0, 2.0, np.asarray(table))

    assert share(1.0, 2.0, 0.5) == pytest.approx(0.0, abs=1e-3) and share(-1.0, -2.0) == pytest.approx(0.0, abs=1e-3)
    assert share(3.0, -1.0, 1.0) == pytest.approx(0.2, abs=0.02)
    assert share(-3.0, 1.0) == pytest.approx(0.25, abs=0.02)
    assert share_given_back(0.0, 2.0, np.zeros(9)) == np.inf


def test_what_a_simulation_is_told_of_its_surfaces() -> None:
    courses = {"v": np.arange(4.0), "w": np.arange(4.0) ** 2}
    data: Any = SimpleNamespace(column=lambda log, name: courses[name])
    small, large = np.arange(9.0).reshape(3, 3), np.arange(25.0).reshape(5, 5)

    def surface(how: str, of: int, name: str, second: int, other: str, table: Array) -> terms.Surface:
        return terms.Surface(how, 1, of, name, 0.0, 2.0, lambda _: table, of_second=second, second=other,
                             low_second=-1.0, high_second=3.0)  # fmt: skip

    first = surface("output adds", terms.COLUMN, "v", 0, "x", small)
    other = surface("state adds", terms.INPUT + 1, "u", terms.COLUMN, "w", large)
    both = [(first, small), (other, large)]
    how, place, of, low, high, tables, columns = terms.surfaces_for_kernel(both, data, 0, 3)
    assert how.tolist() == [5, 4] and place.tolist() == [1, 1]
    assert of.tolist() == [[terms.COLUMN, 0], [terms.INPUT + 1, terms.COLUMN + 1]]
    assert low.tolist() == [[0.0, -1.0]] * 2 and high.tolist() == [[2.0, 3.0]] * 2
    assert columns.tolist() == [courses["v"][:3].tolist(), courses["w"][:3].tolist()]
    assert tables[1].tolist() == large.tolist() and tables[0][::2, ::2] == pytest.approx(small)
    assert tables[0][1, 1] == pytest.approx(0.25 * small[:2, :2].sum())
    assert first.at(np.array([[0.0, 2.0, 9.0], [-1.0, 1.0, 3.0]]), small) == pytest.approx([0.0, 7.0, 8.0])
    curve = terms.Curve("output adds", 0, terms.INPUT, "u", 0.0, 1.0, lambda v: v)
    assert [[c for c, _ in part] for part in terms.apart([(curve, small[0]), *both])] == [[curve], [first, other]]
    assert other.value(lambda number, name: np.array([number])).tolist() == [[terms.INPUT + 1], [terms.COLUMN]]


# ---- where a fit of unknown parameters begins ------------------------------------------------------------------------


def test_a_fit_begins_at_the_draws_that_come_nearest_plainly_or_but_for_gain_and_offset() -> None:
    t = np.linspace(0.0, 3.0, 50)
    measured = np.array([2.0 * np.exp(-0.7 * t) + 0.3, np.full(50, np.nan)])
    measured[1, ::2] = np.sin(1.3 * t[::2])
    measured[0, 7] = np.nan
    values, free, size = np.array([5.0, 1.0, 0.0]), [1, 2], np.array([2.0, 4.0])
    first, low, high = np.array([0.5, 0.0]), np.array([-np.inf, -0.9]), np.array([4.0, np.inf])
    asked: list[int] = []

    def model(thetas: Any) -> Any:
        k, w = thetas[:, 1:2], thetas[:, 2:3]
        out = np.stack([thetas[:, :1] * np.exp(-k * t), np.sin(w * t) + 0.1 * k], axis=1)
        out[k[:, 0] > 6.0] = 1e9  # these leave all bounds
        return out

    own: Any = SimpleNamespace(
        measured=measured, runner=SimpleNamespace(far=1e6), run=lambda th: asked.append(len(th)) or model(th)
    )
    scale = np.array([0.5, 0.8])
    got = BoundSystem._drawn(own, values, free, size, first, low, high, scale)
    power = 4 + 2
    unit = qmc.Sobol(2, seed=0).random_base2(power)
    one = np.minimum(0.5 * bound_system.FACTOR ** (2.0 * unit[:, 0] - 1.0), 4.0)  # about the user's own value
    z = np.column_stack([one, np.maximum(2.0 * unit[:, 1] - 1.0, -0.9)])  # of a value of 0 between both signs
    plain, bent = [], []
    for row in z:
        theta = values.copy()
        theta[free] = row * size
        m = model(theta[None])[0]
        if np.abs(m).max() >= 1e6:
            plain.append(np.inf)
            bent.append(np.inf)
            continue
        sums = [0.0, 0.0]
        for y, said, s in zip(measured, m, scale, strict=True):
            there = np.isfinite(y)
            sums[0] += np.mean(((said - y)[there] / s) ** 2)
            line = np.polyfit(said[there], y[there], 1)
            sums[1] += np.mean(((y - np.polyval(line, said))[there] / s) ** 2)
        plain.append(sums[0])
        bent.append(sums[1])
    half = bound_system.FITS_FROM // 2
    best = dict.fromkeys([*np.argsort(plain)[:half].tolist(), *np.argsort(bent)[:half].tolist()])
    wanted = [z[i] for i in best if np.isfinite(plain[i])]
    assert len(got) == len(wanted) > half and asked == [32, 32]
    for a, b in zip(got, wanted, strict=True):
        np.testing.assert_allclose(a, b)
    own.run = lambda th: np.full((len(th), 2, 50), 1e9)
    assert BoundSystem._drawn(own, values, free, size, first, low, high, scale) == []


@pytest.mark.parametrize("times", [0.0, 0.1, 0.25, 0.5, 1.0, 2.0, -0.1, -0.25, -0.5, -1.0, -2.0])
@pytest.mark.parametrize("own_size", [3.0, None])
def test_an_unknown_start_is_set_to_a_round_size_of_the_outputs(times: float, own_size: float | None) -> None:
    measured = np.array([[4.0, -8.0, np.nan], [1.0, 2.0, 3.0]])
    size = own_size or 8.0  # else the largest value that was measured
    course = np.where(np.isfinite(measured), measured, 99.0)
    own: Any = SimpleNamespace(
        measured=measured, start_sizes=[None, own_size], system=SimpleNamespace(parameters=["k"]),
        run=lambda th: course + (th[:, 2:3, None] - 5.0 - size * times),
    )  # fmt: skip
    theta = np.array([1.0, 7.0, 5.0])
    BoundSystem._scan_starts(own, theta, [2])
    assert theta.tolist() == [1.0, 7.0, pytest.approx(5.0 + size * times)]


def test_what_laws_do_to_each_log_and_parameters_that_are_not_needed_any_more_are_noted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(by_log, "_loaded", lambda *of: ["loaded"])
    monkeypatch.setattr(by_log, "_between", lambda *of: ["held"])
    monkeypatch.setattr(by_log, "parameter_warnings", lambda *of: ["again", "warned"])
    ps = [
        Parameter("k", 1.0, "N", 0.0, 9.0, 5.0), Parameter("zero", 1.0, "N", 0.0, 9.0, 5.0),
        Parameter("fixed", 1.0, "N", 0.0, 9.0), Parameter("signed", 1.0, "N", -9.0, 9.0, 5.0),
        Parameter("never", 0.0, "N", 0.0, 9.0, 5.0),
    ]  # fmt: skip
    limit = by_log.NO_HELP
    own: Any = SimpleNamespace(
        notes=["before"], ablation={"lag": {"a": limit, "b": limit + 1e-6, "c": 0.98, "d": 1.234}},
        logs=SimpleNamespace(fitted=SimpleNamespace(stage=SimpleNamespace(parameters=ps))),
        d=SimpleNamespace(final=SimpleNamespace(effects=("lag", "play"), theta=np.array([2.0, 0.0, 0.0, 0.0, 0.0])),
                          base=SimpleNamespace(theta=np.array([1.0, 1.2345678, 1.0, 1.0, 0.0])), notes=["again"]),
    )  # fmt: skip
    by_log.ByLog._remark(own, None)  # type: ignore[arg-type]
    assert own.notes == [
        "before", f"lag hardly helps on b: error with it over error without it is {limit:.2f}",
        "lag does not help on c: error with it over error without it is 0.98",
        "lag does not help on d: error with it over error without it is 1.23",
        "zero: not needed any more, set to 0 (it was 1.235 N while lag, play was missing)", "loaded", "held", "again",
        "warned",
    ]  # fmt: skip


@pytest.mark.parametrize("cutoff", [0.475, 0.2, 0.03])
def test_the_weights_of_a_low_pass_leave_a_cubic_and_are_nobody_s_to_change(cutoff: float) -> None:
    weights = motion_of._kernel(cutoff)
    n = math.ceil(1.0 / cutoff)
    assert len(weights) == 2 * n + 1 and weights == pytest.approx(weights[::-1])
    k = np.arange(-n, n + 1)
    assert [float(np.sum(weights * k**power)) for power in range(4)] == pytest.approx([1.0, 0.0, 0.0, 0.0], abs=1e-9)
    bell = np.cos(0.5 * np.pi * k / (n + 1)) ** 4
    parabola = weights / bell  # what is left of them beside a window that ends after one period
    assert np.polyval(np.polyfit(k, parabola, 2), k) == pytest.approx(parabola)
    with pytest.raises(ValueError, match="read-only"):  # they are kept for others
        weights[0] = 1.0
    assert motion_of._kernel(cutoff) is weights
