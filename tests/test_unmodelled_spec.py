"""Terms that nobody listed, against closed forms: quantities and periods that are looked for, curves as candidates,
the step that ranks them, what confirms them, and the Python file that says one.
"""

from __future__ import annotations

import inspect
import math
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.small_logs import white
from vaneloop import InputError, Record, System, unknown
from vaneloop.base.curve import FINE
from vaneloop.base.forms import FORMS
from vaneloop.identification import Effect, Parameter, Stage
from vaneloop.identification.candidates.closed_forms import Formula
from vaneloop.identification.least_squares.problem import LeastSquaresProblem
from vaneloop.identification.selection.diagnosis import diagnose_stage
from vaneloop.identification.settings import LEAST_FALL, LEAST_OF_NOISE, LEVEL_SPREAD, NATS
from vaneloop.identification.subsystem import Array
from vaneloop.identification.unmodelled import (
    closed_form_fits,
    curve_choice,
    fitted_candidate,
    learned_law,
    problem,
    spectral_lines,
)
from vaneloop.identification.unmodelled.closed_form_fits import Product, goes_on
from vaneloop.identification.unmodelled.curve_candidates import (
    Candidate,
    UserModelCandidates,
    _further,
    basis_for,
    candidates,
    may_be_of,
    shape_fits,
    surface_of,
)
from vaneloop.identification.unmodelled.curve_choice import stands_before
from vaneloop.identification.unmodelled.fitted_candidate import (
    adds_what,
    channel_of,
    left_by_its_mean,
    one_constant,
    plain,
    step_without,
    strange,
)
from vaneloop.identification.unmodelled.learned_law import LearnedLaw, LearnedSurface, law_of
from vaneloop.identification.unmodelled.learning import CurveSearch
from vaneloop.identification.unmodelled.problem import CurveProblem, promises
from vaneloop.identification.unmodelled.python_law import python_law
from vaneloop.identification.unmodelled.regressors import Quantity, _alike, difference, quantities
from vaneloop.identification.unmodelled.screening import best_step, starts_of
from vaneloop.identification.unmodelled.spectral_lines import (
    Course,
    Lines,
    _between,
    _coherence,
    _coherent,
    _Even,
    _even,
    _fitted,
    _peaks,
    _repeats,
    _spectrum,
    about,
    periods_along,
)
from vaneloop.identification.user_models.bound_system import BoundSystem
from vaneloop.identification.user_models.by_log import bind
from vaneloop.identification.user_models.terms import COLUMN, INPUT, OUTPUT

T = 0.1 * np.arange(240)
U = 1.5 * np.sin(0.9 * T) + 0.7 * np.sin(2.3 * T + 1.0)


def gain(u: Any, p: Any) -> Any:
    return p.a * u.u


def system(**more: Any) -> System:
    given: dict[str, Any] = {
        "model": gain, "inputs": {"u": "V"}, "outputs": {"y": "V"}, "parameters": [unknown("a", 2.0, "-")],
    }  # fmt: skip
    return System("map", "static", **given | more)


def log(y: Array, name: str = "log", **more: Array) -> Record:
    return Record(name, T, {"u": U, "y": y, **more})


# ---- periods ---------------------------------------------------------------------------------------------------------


def test_a_fitted_wave_takes_off_what_least_squares_says() -> None:
    t = 0.05 * np.arange(400) + 3.0
    w = 1.0 + 0.5 * np.sin(0.37 * t)
    f = 0.8
    e = w * (0.4 + 0.7 * np.cos(2.0 * np.pi * f * t) - 0.3 * np.sin(4.0 * np.pi * f * t)) + 0.1 * white(1, 400)
    part = _Even(t, np.array([e, w]))
    window = np.sqrt(np.hanning(400))
    for harmonics in (1, 2):
        waves = [g(2.0 * np.pi * h * f * t) for h in range(1, harmonics + 1) for g in (np.cos, np.sin)]
        left = []
        for columns in ([np.ones(400)], [np.ones(400), *waves]):
            a = (np.array(columns) * w * window).T
            left.append(float(np.linalg.lstsq(a, e * window, rcond=None)[1][0]))
        got = _fitted([part], harmonics, np.array([4]), f / 4.0)
        assert got == pytest.approx([left[0] - left[1]], rel=1e-4)
    assert _fitted([part, part], 1, np.array([4]), 0.2) == pytest.approx(2.0 * _fitted([part], 1, np.array([4]), 0.2))
    assert _fitted([_Even(t, np.zeros((2, 400)))], 1, np.array([4]), 0.2).tolist() == [0.0]


def test_power_at_a_frequency_is_that_of_its_wave() -> None:
    t = 2.0 + 0.02 * np.arange(1000)
    f = 1.3
    wave = 0.6 * np.sin(2.0 * np.pi * f * t)
    part = _Even(t, wave[None])
    at = np.array([f, f + 1.0])
    inside = np.hanning(1000)
    wanted = [abs(np.sum(inside * wave * np.exp(-2j * np.pi * g * t))) ** 2 / 1000.0 for g in at]
    assert _spectrum(part, at) == pytest.approx(wanted, rel=0.03, abs=1e-3)
    whole = (0.3 * 1000.0) ** 2
    assert _coherent([part], f) == pytest.approx(whole, rel=0.02)
    other = _Even(t + 0.5 / f, wave[None])
    assert _coherence([part, part], f) == pytest.approx(1.0) and _coherence([part, other], f) < 1e-3
    power = np.ones(1200)
    power[600] = 500.0
    assert about(power) == pytest.approx(np.ones(1200)) and about(np.zeros(1200)).min() > 0.0


def test_uneven_times_are_made_even_and_straight_lines_taken_off() -> None:
    t = np.linspace(0.0, 10.0, 101) ** 1.2
    even = _even(t, (3.0 * t + 1.0)[None], straight=False)
    assert np.diff(even.t) == pytest.approx(np.full(100, even.t[1])) and even.t[[0, -1]] == pytest.approx(t[[0, -1]])
    assert even.rows[0] == pytest.approx(3.0 * even.t + 1.0)
    assert _even(t, (3.0 * t + 1.0)[None]).rows[0] == pytest.approx(np.zeros(101), abs=1e-9)
    assert _between(1.0, 2.0, 1.0) == 0.0 and _between(2.0, 2.0, 1.0) == -0.5 and _between(1.0, 0.0, 1.0) == 0.0
    assert _between(0.0, 3.0, 2.0) == pytest.approx(0.25)


@pytest.mark.parametrize("alike", [0.97, 0.8])
def test_a_signal_repeats_itself_after_the_time_at_which_it_is_the_same_again(alike: float) -> None:
    rng = np.random.default_rng(1)
    piece = rng.standard_normal((3, 100))
    x = np.concatenate([np.sqrt(alike) * piece[0] + np.sqrt(1.0 - alike) * k for k in (*piece[1:], piece[1], piece[2])])
    assert _repeats(x - x.mean(), 0.02) == ([pytest.approx(2.0)] if alike > 0.9 else [])
    assert _repeats(rng.standard_normal(300), 0.02) == [] and _repeats(np.ones(50), 1.0) == []


@pytest.mark.parametrize(("cycles", "size", "found"), [(9.3, 1.0, True), (4.0, 1.0, False), (9.3, 0.05, False)])
def test_a_period_of_the_error_is_found_from_six_cycles_on_and_clear_of_the_noise(
    cycles: float, size: float, found: bool
) -> None:
    t = 0.02 * np.arange(1500)
    f = cycles / t[-1]
    error = size * np.sin(2.0 * np.pi * f * t + 0.3) + 0.3 * white(2, 1500)
    course = Course(t, error[None], np.zeros((0, 1500)))
    got = Lines([course]).found()
    assert len(got) == found
    if found:
        assert got[0][0] == pytest.approx(1.0 / f, rel=0.01)
        driven = course._replace(drivers=np.sin(2.0 * np.pi * f * t)[None])
        assert Lines([driven]).found() == []
        third = course._replace(drivers=np.sin(2.0 * np.pi * f * t / 3.0)[None])
        assert Lines([third]).found() == []  # a multiple of what drives the model is its own
    short = Course(t[:20], error[None, :20], np.zeros((0, 20)))
    assert Lines([short]).found() == [] and Lines([short]).fast() == []


def test_a_period_along_a_channel_is_found_where_the_channel_is_no_time() -> None:
    t = 0.01 * np.arange(3000)
    way = 5.0 * t + 4.0 * np.sin(0.7 * t) + 2.0 * np.sin(0.23 * t)
    error = np.sin(2.0 * np.pi * way / 3.7)[None] + 0.3 * white(3, 1, 3000)
    none = np.zeros((0, 3000))
    assert periods_along([way], [t], [error], [none])[0] == pytest.approx(3.7, rel=0.001)
    assert periods_along([5.0 * t], [t], [error], [none]) == []
    signal = np.cos(1.9 * t)[None]
    assert periods_along([way], [t], [signal * error], [signal])[0] == pytest.approx(3.7, rel=0.005)
    assert periods_along([way[:15]], [t[:15]], [error[:, :15]], [none[:, :15]]) == []
    power = np.ones(2000)
    power[399:402] = 900.0, 1000.0, 900.0
    (peak,) = _peaks(power, 10.0, 200.0)
    assert list(peak) == pytest.approx([1000.0, 400.0 / 40.0])
    assert _peaks(power, 10.0, 90.0) == []  # beyond what its samples tell


# ---- quantities ------------------------------------------------------------------------------------------------------


def test_every_quantity_that_is_known_has_its_values_and_unit() -> None:
    bound = BoundSystem(system(), [log(2.0 * U, oil=40.0 + T), log(2.0 * U, "two", oil=50.0 - T)])
    found = {q.name: q for q in quantities(bound, np.array([2.0]))}
    units = {
        "u": "V", "y": "V", "time": "s", "oil": "", "direction_of_u": "-", "distance_since_reversal_of_u": "V",
        "time_since_reversal_of_u": "s", "direction_of_y": "-", "distance_since_reversal_of_y": "V",
        "time_since_reversal_of_y": "s",
    }  # fmt: skip
    lags = [n for n in found if "_lagged_by_" in n]
    assert {n: found[n].unit for n in units} == units and set(found) == {*units, *lags, "stops_of_u"}
    assert (found["u"].of, found["y"].of, found["oil"].of) == (INPUT, OUTPUT, COLUMN)
    assert found["oil"].visited == pytest.approx(np.concatenate([40.0 + T, 50.0 - T]))
    assert found["stops_of_u"].visited == pytest.approx(0.5 * found["distance_since_reversal_of_u"].visited)
    assert found["stops_of_u"].stops and found["stops_of_u"].remembers and not found["u"].remembers
    # three between three samples and an eighth of the log, evenly in their logarithm
    low, high = 3.0 * 0.1, 0.125 * T[-1]
    wanted = [low * (high / low) ** z for z in (1.0 / 6.0, 0.5, 5.0 / 6.0)]
    taus = sorted(float(n.split("_by_")[1].replace("_ms", "e-3").replace("_s", "").replace("_us", "e-6")) for n in lags)
    assert taus == pytest.approx(wanted, rel=0.01)
    lag = found[min(lags, key=len)]
    assert lag.slower is not None and lag.slower(100.0) is None and lag.slower(0.001) is None
    further = lag.slower(1.1)
    assert further is not None and further.name != lag.name and len(lag.course) == 2


def test_a_difference_of_two_of_a_kind_is_a_quantity_of_its_own() -> None:
    other = np.cos(1.7 * T)
    two = system(inputs={"u": "V", "w": "V", "i": "A"}, model=lambda u, p: p.a * (u.u - u.w))
    logged = log(2.0 * (U - other), w=other, i=U + 3.0 * other)
    found = {q.name: q for q in quantities(BoundSystem(two, [logged]), np.array([2.0])) if q.less is not None}
    # y is twice u - w, and what is a multiple of what is there says nothing new
    assert list(found) == []
    bound = BoundSystem(two, [log(U * other, w=other, i=U + 3.0 * other)])
    found = {q.name: q for q in quantities(bound, np.array([2.0])) if q.less is not None}
    assert list(found) == ["u_minus_w"]
    q = found["u_minus_w"]
    assert q.visited == pytest.approx(U - other) and q.less == (INPUT + 1, "w") and q.of == INPUT and q.unit == "V"
    assert q.sides == ("u", "w") and Quantity("u", "V", INPUT, U).sides == ("u",)
    assert _alike(U, 3.0 - 2.0 * U) and not _alike(U, U + 0.2 * other) and _alike(np.ones(240), U)
    noisy = difference(bound, U + 0.05 * white(1, 240), U - 0.2 * np.sin(0.3 * T))
    assert np.std(noisy - 0.2 * np.sin(0.3 * T)) < 0.035  # its noise is taken out where it is much of it
    assert difference(bound, U, other) == pytest.approx(U - other)


# ---- candidates ------------------------------------------------------------------------------------------------------


def test_candidates_are_places_times_quantities() -> None:
    bound = BoundSystem(system(), [log(2.0 * U, oil=40.0 + np.sin(T))])
    out = {c.name: c for c in candidates(bound, np.array([2.0]))}
    for place, how, index, unit in (
        ("a.gain_of_", "parameter times", 0, "-"), ("u.curve_of_", "input adds", 0, "V"),
        ("u.gain_of_", "input times", 0, "-"), ("y.curve_of_", "output adds", 0, "V"),
        ("y.gain_of_", "output times", 0, "-"),
    ):  # fmt: skip
        mine = {n.removeprefix(place): c for n, c in out.items() if n.startswith(place)}
        assert {"oil", "time", "direction_of_u"} <= set(mine)
        assert ("u" in mine) == (place != "u.gain_of_") and ("y" in mine) == (place == "y.curve_of_")
        assert ("stops_of_u" in mine) == (place == "y.curve_of_")
        assert {(c.how, c.place, c.unit) for c in mine.values()} == {(how, index, unit)}
        assert all(c.mean == (place != "a.gain_of_" and not c.quantity.stops) for c in mine.values())
    half_u, half_y = 0.5 * np.ptp(U), np.ptp(U)
    assert out["u.curve_of_oil"].size == pytest.approx(0.3 * half_u)
    assert out["y.curve_of_oil"].size == pytest.approx(0.3 * half_y)
    assert out["a.gain_of_oil"].size == 0.5 and out["y.gain_of_oil"].size == out["u.gain_of_oil"].size == 0.3


def curve_of(q: Quantity, **more: Any) -> Candidate:
    basis = basis_for(q)
    assert basis is not None
    return Candidate(f"y.curve_of_{q.name}", "output adds", 0, "y", "V", 0.5, True, q, basis, **more)


def test_a_candidate_s_shape_jump_and_period() -> None:
    c = curve_of(Quantity("u", "V", INPUT, U))
    n = len(c.basis.bend)
    assert c.kept == list(range(n)) and c.lent == set() and c.parts == c.kept
    less = curve_of(Quantity("u", "V", INPUT, U), untold=(1,))
    assert less.kept == [0, *range(2, n)] and less.lent == {1}
    jumps = c.jumping()
    assert jumps is not None and jumps.parts == [*c.kept, -1] and jumps.jumping() is None
    assert curve_of(Quantity("u", "V", INPUT, np.abs(U) + 0.1)).jumping() is None
    assert curve_of(Quantity("time", "s", COLUMN, T - 5.0)).jumping() is None
    a = np.arange(1.0, n + 1.0)
    assert c.coefficients(a) == pytest.approx(c.turn @ a)
    assert jumps.coefficients(np.append(a, 0.7))[-1] == 0.7
    for shape in (("zero",), ("odd",), ("rising",), ("falling", "zero")):
        s = c.shaped(shape)
        assert s is not None and s.shape == shape
        p = s.effect(1.0).parameters
        amplitudes = np.clip(np.random.default_rng(1).standard_normal(len(p)), [q.low for q in p], [q.high for q in p])
        curve = s.placed().curve
        assert curve is not None
        y = curve.table(amplitudes)
        x = np.linspace(curve.low, curve.high, len(y))
        if "zero" in shape:
            assert np.interp(0.0, x, y) == pytest.approx(0.0, abs=2e-3 * np.ptp(y))
        if "odd" in shape:
            assert np.interp(-x, x, y) == pytest.approx(-y, abs=0.02 * np.ptp(y))
        if rises := ("rising" in shape) - ("falling" in shape):
            assert np.all(rises * np.diff(y) >= -1e-9)
    assert shape_fits(("zero",), np.array([0.0, 1.0])) and not shape_fits(("odd",), np.array([0.0, 1.0]))
    assert not shape_fits(("zero",), np.array([0.1, 1.0])) and not shape_fits(("zero",), np.zeros(0))
    again = curve_of(Quantity("time", "s", COLUMN, T)).every(1.7)
    assert again.quantity.name == "time_every_1700_ms" and again.quantity.period == pytest.approx(1.7)
    assert again.quantity.visited == pytest.approx(T % 1.7) and again.quantity.span == pytest.approx(T[-1])
    longer = again.slower(1.1)
    assert longer is not None and longer.quantity.period == pytest.approx(1.87) and longer.name.endswith("1870_ms")
    finer = c.finer(n + 4)
    assert finer is not None and len(finer.basis.bend) > n and c.finer(n - 2) is None
    same = finer.as_of(c, a)
    q = np.linspace(c.basis.low, c.basis.high, 50)
    first, second = c.placed().curve, finer.placed().curve
    assert first is not None and second is not None
    assert second.at(q, second.row(same)) == pytest.approx(first.at(q, first.row(a)), abs=0.03 * np.ptp(first.row(a)))


def test_a_reading_at_its_limit_is_taken_from_the_model() -> None:
    said = np.linspace(-2.0, 2.0, 41)
    read = np.clip(said, -1.0, 1.0)
    assert _further(read, said) == pytest.approx(said)
    assert _further(read, 9.0 * said)[[0, 20, -1]] == pytest.approx([-1.0, 0.0, 1.0])  # far off: the reading
    assert _further(said, read) == pytest.approx(said)
    assert _further(np.full(41, np.nan), said) == pytest.approx(np.full(41, np.nan), nan_ok=True)


# ---- the step that ranks ---------------------------------------------------------------------------------------------


def test_the_best_step_is_that_of_damped_least_squares() -> None:
    x = white(5, 3, 240)
    y = 0.8 * x[0] + 0.5 * x[1] + 0.1 * x[2]
    effect = Effect("law", (Parameter("size", 0.0, "1", -50.0, 50.0, 3.0, scale=1.0),), ((1.0,),))
    stage = Stage(
        "sum", ("y",), ("1",), (Parameter("gain", 1.0, "1", 0.0, 2.0, 0.5),), (effect,),
        lambda thetas: (thetas @ x[:2])[:, None], T, y[None], floor=np.array([0.1]),
    )  # fmt: skip
    judge = LeastSquaresProblem(stage, np.array([0.1]))
    fit = judge.fit((), stage.neutral())
    ((begin, slopes),) = starts_of(judge, fit)
    assert begin == pytest.approx(fit.theta)
    step = best_step(fit, effect, judge, begin[:1], slopes)
    rows = np.vstack([x[:2].T / 0.1, np.diag([np.sqrt(3.0) / 0.5, np.sqrt(3.0) / 3.0])])
    wanted = np.linalg.lstsq(rows, np.concatenate([y / 0.1, [np.sqrt(3.0) / 0.5, 0.0]]), rcond=None)[0]
    assert step.theta == pytest.approx(wanted, abs=0.01)
    begin_at = np.array([begin[0], 0.0])
    left = np.concatenate([(y - begin_at @ x[:2]) / 0.1, -rows[-2:] @ (begin_at - [1.0, 0.0])])
    normal = rows.T @ rows
    least_damped = begin_at + np.linalg.solve(normal + 0.003 * np.diag(np.diag(normal)), rows.T @ left)
    assert step.theta == pytest.approx(least_damped, abs=1e-7)
    narrow = Effect("law", (Parameter("size", 0.0, "1", -50.0, 0.2, 3.0, scale=1.0),), ((1.0,),))
    alike = x[:2] + np.array([[0.0], [1.0]]) * x[:1]  # the law can stand in for the gain
    other = Stage(
        "sum", ("y",), ("1",), stage.parameters, (narrow,), lambda thetas: (thetas @ alike)[:, None], T, y[None],
        floor=np.array([0.1]),
    )  # fmt: skip
    of_other = LeastSquaresProblem(other, np.array([0.1]))
    nominal = of_other.fit((), other.neutral())
    ((_, steep),) = starts_of(of_other, nominal)
    ends, goes_on_with_others = (
        best_step(nominal, narrow, of_other, nominal.theta[:1], steep, cut_off) for cut_off in (True, False)
    )
    assert ends.theta[1] == goes_on_with_others.theta[1] == 0.2
    start = np.array([nominal.theta[0], 0.0])
    known = np.vstack([alike.T / 0.1, rows[-2:]])
    normal = known.T @ known
    pull = known.T @ np.concatenate([(y - start @ alike) / 0.1, -rows[-2:] @ (start - [1.0, 0.0])])
    gains = [start[0] + (pull[0] - normal[0, 1] * 0.2) / (normal[0, 0] * (1.0 + d)) for d in (0.003, 0.03, 0.3)]
    assert min(abs(goes_on_with_others.theta[0] - g) for g in gains) < 1e-6 < abs(ends.theta[0] - gains[0])
    bound = Stage(
        "sum", ("y",), ("1",), (Parameter("gain", 1.0, "1", 0.95, 2.0, 0.5),), (effect,),
        stage.run, T, y[None], floor=np.array([0.1]),
    )  # fmt: skip
    held = LeastSquaresProblem(bound, np.array([0.1]))
    assert [s[0][0] for s in starts_of(held, held.fit((), bound.neutral()))] == [pytest.approx(0.95), 1.0]
    assert promises(100.0, 75.9) and not promises(100.0, 76.0)


@pytest.mark.parametrize(
    ("named", "learned", "tests", "stands"),
    [
        (5.0, 1.2, {}, True), (5.0, 4.9, {}, False), (np.sqrt(5.0), np.sqrt(2.0) - 1e-6, {}, True),
        (np.sqrt(5.0), 1.6, {}, False), (5.0, 4.9, {"t": -0.5}, True), (5.0, 1.0, {"t": 0.5}, False),
        (5.0, 4.9, {"t": 0.0}, False),
    ],
)  # fmt: skip
def test_what_was_learned_stands_before_laws_with_names_where_it_is_confirmed_or_leaves_a_quarter(
    named: float, learned: float, tests: dict[str, float], stands: bool
) -> None:
    assert stands_before(named, learned, tests) == stands


# ---- a search --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def learned() -> LearnedLaw:
    """An input with a ripple that no law of the library has, on one log and a test log."""
    v = 1.3 * np.cos(0.8 * T)
    y, other = (2.0 * (x + 0.2 * np.sin(3.0 * x)) + 0.01 * white(k, 240) for k, x in enumerate((U, v)))
    logs = bind(system(places=["u"]), [log(y)], [Record("test", T, {"u": v, "y": other})])
    d = diagnose_stage(logs.fitted.thinned, logs.fitted.floor, judged=logs.judged())
    ground = UserModelCandidates(logs)
    learner = CurveSearch(ground, d)
    out = learner.learned()
    assert out.verdict == "learned" and out.why == ""
    return law_of(ground, (learner.judge, learner.base), out.tried[-1])


def test_a_ripple_of_an_input_is_learned_as_its_curve_and_formula(learned: LearnedLaw) -> None:
    law = learned
    assert (law.name, law.how, law.at, law.of, law.unit, law.of_unit) == (
        "u.curve_of_u", "input adds", "u", "u", "V", "V",
    )  # fmt: skip
    assert law.error_after < 1.3 and law.error_before > 20.0
    inner = (law.x > np.quantile(U, 0.02)) & (law.x < np.quantile(U, 0.98))
    off = law.y - 0.2 * np.sin(3.0 * law.x)
    straight = np.polyval(np.polyfit(law.x[inner], off[inner], 1), law.x)  # which the gain may have
    assert np.abs(off - straight)[inner].max() < 0.01
    assert np.all(law.low < law.y) and np.all(law.y < law.high) and np.median(law.high - law.low) < 0.12
    assert law.visited.sum() == pytest.approx(1.0) and len(law.edges) == 25
    assert (law.x[0], law.x[-1]) == pytest.approx((U.min(), U.max()), abs=0.02)
    space: dict[str, Any] = {}
    exec(python_law(law), space)
    space["test_curve"]()


# ---- the file --------------------------------------------------------------------------------------------------------


def made(how: str, at: str, of: str, formula: Formula | None = None, **more: Any) -> LearnedLaw:
    x = np.linspace(-2.0, 2.0, 257)
    given: dict[str, Any] = {"formulas": [formula] if formula else [], **more}
    return LearnedLaw(
        f"{at}.curve_of_{of}", how, at, of, "V", "V", x, x**2, x**2 - 1.0, x**2 + 1.0, x[:25], np.ones(24), 30.0, 1.0,
        np.zeros(8), **given,
    )  # fmt: skip


def product_of(one: str, other: str) -> LearnedSurface:
    forms = [next(f for f in FORMS if f.name == n) for n in (one, other)]
    x, z = np.linspace(-2.0, 2.0, 65), np.linspace(1.0, 3.0, 65)
    names = [*forms[0].numbers, *(f"second_{n}" for n in forms[1].numbers[1:])]
    numbers = {n: 0.7 if k else 1.5 for k, n in enumerate(names)}
    formula = Product(one, f"1.5 {one}(y) {other}(w)", numbers, 1.0, 3, second_form=other)
    values = np.outer(x, z)
    more: dict[str, Any] = {
        "second": "w", "second_unit": "A", "middle": 2.0, "across": z, "values": values, "lowest": values,
        "highest": values, "within": values > 0.0, "samples": np.zeros((2, 1)), "been": np.zeros((3, 2)),
        "knots_across": np.zeros(8),
    }  # fmt: skip
    return LearnedSurface(
        "y.curve", "output adds", "y", "y", "V", "V", x, x, x, x, x[:25], np.ones(24), 30.0, 1.0, np.zeros(8),
        [formula], **more,
    )  # fmt: skip


@pytest.mark.parametrize("one", ["sign", "power", "line", "tanh"])
@pytest.mark.parametrize("other", ["sign", "root"])
def test_a_product_s_file_computes_the_product(one: str, other: str) -> None:
    law, space = product_of(one, other), dict[str, Any]()
    exec(python_law(law), space)
    space["test_surface"]()
    first, second = (next(f for f in FORMS if f.name == n) for n in (one, other))
    for y, w in ((-1.3, 1.5), (0.4, 2.9), (9.0, 9.0)):
        at = np.array([min(y, 2.0)]), np.array([min(w, 3.0)])
        wanted = first.value(at[0], np.array([1.5, 0.7, 0.7])) * second.value(at[1], np.array([1.0, 0.7, 0.7]))
        assert space["surface"](y, w) == pytest.approx(float(wanted[0]), rel=1e-9)


def test_a_surface_s_file_is_its_table() -> None:
    law, space = product_of("line", "line"), dict[str, Any]()
    exec(python_law(replace(law, formulas=[])), space)
    space["test_surface"]()
    for y, w in ((-1.3, 1.5), (0.4, 2.9), (2.0, 3.0), (-2.0, 1.0)):
        assert space["surface"](y, w) == pytest.approx(y * w, abs=1e-6)
    assert space["surface"](9.0, 0.0) == pytest.approx(2.0)


@pytest.mark.parametrize("name", [f.name for f in FORMS])
def test_a_formula_s_file_computes_the_formula(name: str) -> None:
    form = next(f for f in FORMS if f.name == name)
    numbers = np.array([1.5, 0.7, 0.4][: len(form.numbers)])
    formula = Formula(name, form.text, dict(zip(form.numbers, numbers.tolist(), strict=True)), 1.0, 3)
    space: dict[str, Any] = {}
    text = python_law(made("output adds", "y", "y", formula), system())
    exec(text, space)
    space["test_curve"]()
    space["test_law"]()
    low = 0.2 if form.positive else -1.9
    for q in np.linspace(low, 1.9, 7):
        wanted = float(np.broadcast_to(form.value(np.array([q]), numbers), (1,))[0])
        assert space["curve"](float(q)) == pytest.approx(wanted, rel=1e-9, abs=1e-9)
    assert space["curve"](9.0) == space["curve"](2.0) and space["curve"](-9.0) == space["curve"](-2.0)
    law = space["LAW"]
    assert (law.name, law.on, list(law.places)) == ("curve_of_y", "signal", ["y"])
    p = SimpleNamespace(scale=2.0)
    assert law.function(1.2, 0.0, p) == pytest.approx(1.2 + 2.0 * space["curve"](1.2))


def test_a_curve_s_file_is_its_table_and_says_where_it_holds() -> None:
    space: dict[str, Any] = {}
    text = python_law(made("output adds", "y", "y"))
    exec(text, space)
    space["test_curve"]()
    for q in (-2.0, -0.3, 0.77, 2.0):
        assert space["curve"](q) == pytest.approx(q * q, abs=0.02)
    assert "Range: learned for q in [-2, 2]; beyond, it stays as at the ends." in text
    assert "Error on held-out data: 30 noise floors without it, 1 with it." in text and "LAW" not in space
    level = Formula("line", "2 y", {"a": 2.0}, 1.0, 2, level=0.5)
    goes = made("output adds", "y", "y", level, spoken=level, reach=(-4.0, 4.0))
    further: dict[str, Any] = {}
    text = python_law(goes)
    exec(text, further)
    assert further["curve"](3.0) == 6.5 and further["curve"](99.0) == 8.5
    assert "and goes on to [-4, 4]" in text
    turns = made("output adds", "y", "y_every_0p5", Formula("line", "2 q", {"a": 2.0}, 1.0, 2), period=0.5)
    within: dict[str, Any] = {}
    exec(python_law(turns), within)
    assert within["curve"](1.3) == pytest.approx(0.6)
    assert math.isclose(within["curve"](-0.2), 0.6)


def test_a_law_file_is_written_for_what_a_law_can_be_of() -> None:
    shaft = System(
        "shaft", "simulate", lambda x, u, p: (x.w, u.u - p.c * x.w), {"phi": "rad"}, {"u": "A", "w2": "rad/s"},
        [unknown("c", 1.0, "1/s"), unknown("m", 1.0, "kg")], states={"phi": "rad", "w": "rad/s"}, rates={"w": "phi"},
        masses={"w": "m"},
    )  # fmt: skip
    for of, given in (("w", "v"), ("phi", "x")):
        space: dict[str, Any] = {}
        exec(python_law(made("state adds", "w", of), shaft), space)
        space["test_law"]()
        assert space["LAW"].on == "force"
        p = SimpleNamespace(scale=3.0)
        assert space["acts"](1.0, 0.5, 0.0, p) == pytest.approx(3.0 * (1.0 if given == "v" else 0.25), abs=0.01)
    apart: dict[str, Any] = {}
    text = python_law(made("state adds", "w", "w_minus_w2"), shaft)
    exec(text, apart)
    assert "c / p.m is taken off the derivative of w" in text
    assert apart["quantity"](SimpleNamespace(w=5.0), SimpleNamespace(w2=2.0)) == 3.0
    for bad in (made("parameter times", "c", "w"), made("input adds", "u", "w")):
        with pytest.raises(
            InputError, match=rf"^--python: {bad.name} is a function of w at {bad.at}; a Law of your own"
        ):
            python_law(bad, shaft)


# ---- which is plainer, how far it goes, a surface --------------------------------------------------------------------


def named(name: str, at: str = "y", how: str = "output adds", **more: Any) -> Candidate:
    return replace(
        curve_of(Quantity("u", "V", INPUT, U)), quantity=Quantity(name, "V", INPUT, U, **more), at=at, how=how
    )


def test_what_is_at_a_place_is_plainer_than_what_follows_and_memory_imitates_most() -> None:
    order = [
        named("y", "y_sensor"), named("u"), named("u_minus_w", less=(INPUT + 1, "w")), named("time"),
        named("direction_of_u"), named("stops_of_u"),
    ]  # fmt: skip
    assert [strange(c) for c in order] == [0, 1, 2, 3, 4, 5]
    assert strange(named("u_every_0p5", span=3.0)) == 4 and strange(named("u_lagged_by_5_s")) == 5
    assert strange(named("time_since_reversal_of_u")) == strange(named("distance_since_reversal_of_u")) == 4
    assert strange(replace(named("u"), near=True)) == 0
    assert plain(named("u")) < plain(named("u", how="output times")) < plain(named("time"))
    assert adds_what(named("u"), named("u", how="output times")) and not adds_what(named("u"), named("u"))
    assert not adds_what(named("u"), named("w", how="output times"))
    assert channel_of(named("u_lagged_by_5_s")) == "u" and channel_of(named("u")) == "u"


def test_a_formula_goes_on_while_it_is_not_ten_times_as_steep() -> None:
    c = curve_of(Quantity("u", "V", INPUT, np.linspace(-1.0, 1.0, 400)))
    ground: Any = SimpleNamespace(reach=lambda c: (-3.0, 3.0))
    by = {f.name: f for f in FORMS}
    assert goes_on(ground, c, by["line"], np.array([2.0])) == (-3.0, 3.0)
    assert goes_on(ground, c, by["square"], np.array([2.0])) == (-3.0, 3.0)
    low, high = goes_on(ground, c, by["exponential"], np.array([1.0, 2.0]))  # exp(2 q) is ten times as steep at 2.15
    assert low == -3.0 and high == pytest.approx(1.0 + 0.5 * np.log(10.0), abs=0.03)


@pytest.mark.parametrize("additive", [False, True])
def test_a_surface_has_the_products_of_its_functions(additive: bool) -> None:
    rng = np.random.default_rng(2)
    x, z = rng.uniform(-1.0, 1.0, 600), rng.uniform(2.0, 4.0, 600)
    one, two = (curve_of(Quantity(n, "V", INPUT + k, v)) for k, (n, v) in enumerate((("u", x), ("w", z))))
    s = surface_of(one, two)
    assert s is not None and s.name == "y.curve_of_u_and_w"
    s = replace(s, additive=additive)
    n = len(s.basis.bend)
    assert len(s.pairs) == (2 * n - 1 if additive else n * n) and s.pairs[0] == (0, 0)
    assert replace(s, mean=False).pairs[0] == (0, 1)
    effect = s.effect(2.0)
    for (i, j), p in zip(s.pairs, effect.parameters, strict=True):
        bend = s.basis.bend[i] + s.across.bend[j]
        of = 2.0 / np.sqrt(bend) if bend > 0.0 else LEVEL_SPREAD
        assert (p.name, p.scale) == (f"w_{i}_{j}", 0.5) and p.tolerance == pytest.approx(np.sqrt(3.0) * 0.5 * of)
    amplitudes = rng.standard_normal(len(s.pairs))
    curve = s.placed().curve
    assert curve is not None
    a, b = (basis.design(v) @ basis.turn for basis, v in ((s.basis, x), (s.across, z)))
    wanted = sum(v * a[:, i] * b[:, j] for v, (i, j) in zip(amplitudes, s.pairs, strict=True))
    inside = s.reaches(x, z)
    got = curve.at(np.stack([x, z]), curve.table(amplitudes))
    off = np.abs(got - wanted)[inside]
    assert inside.mean() > 0.9 and np.quantile(off, 0.9) < 0.02 * np.ptp(wanted)
    assert surface_of(one, replace(two, quantity=Quantity("w", "V", INPUT + 1, 2.0 * x))) is None  # along a line only
    assert [may_be_of(q.quantity) for q in (one, named("time"), named("stops_of_u"), named("direction_of_u"))] == [
        True, False, False, False,
    ]  # fmt: skip


def test_where_a_law_holds_is_said() -> None:
    curve = made("output adds", "y", "u")
    been = "y.curve_of_u: u has been in [-2, 2] V; the law file has the curve"
    assert curve.range_note() == f"{been}; beyond, it stays as at its end"
    formula = Formula("line", "2 u", {"a": 2.0}, 1.0, 2)
    spoken = replace(curve, spoken=formula, reach=(-4.0, 4.0))
    assert spoken.range_note() == (
        "y.curve_of_u: u has been in [-2, 2] V; the law file has the formula, which does as well as the curve; it "
        "goes on to [-4, 4] V, and stays as there beyond"
    )
    always = replace(curve, spoken=Formula("constant", "3", {"a": 3.0}, 1.0, 1))
    assert always.constant and always.range_note().endswith("has the formula, which does as well as the curve")
    assert replace(curve, period=0.5).range_note() == "y.curve_of_u: the law file has the curve"
    for how, said in (
        ("output adds", "a function of u is added to the reading y"), ("state adds", "taken off the derivative of y"),
        ("input times", "y is multiplied by 1 + "), ("output times", "the reading y is multiplied by 1 + "),
    ):  # fmt: skip
        assert said.removeprefix("a function of u ") in replace(curve, how=how).sentence()
    assert "near 2 u" in replace(curve, formulas=[formula]).sentence() and "near" not in spoken.sentence()
    assert curve.of_the_kind_of(replace(curve, x=curve.y)) and not curve.of_the_kind_of(replace(curve, at="z"))


# ---- what is left without a part of a curve --------------------------------------------------------------------------


def quadratic(low: float = -np.inf, high: float = np.inf) -> Any:
    """A fit of two parameters of a model and a curve of three, whose errors are straight in all of them, in two blocks
    of samples. The first of the model's lies between ``low`` and ``high``.
    """
    rng = np.random.default_rng(3)
    jac = rng.standard_normal((2, 30, 5))
    errors = 0.1 * rng.standard_normal((2, 30))
    theta, scale = np.array([1.0, 2.0, 0.5, -0.4, 0.3]), np.array([1.0, 0.5, 2.0, 1.0, 4.0])
    index = {"law": slice(2, 5)}
    bounds = np.full(5, -np.inf), np.full(5, np.inf)
    bounds[0][0], bounds[1][0] = low, high
    stage: Any = SimpleNamespace(index=lambda: index, grain=1.0, neutral=lambda: np.array([0.9, 2.5, 0.0, 0.0, 0.0]))
    fit = SimpleNamespace(
        theta=theta, free=np.arange(5), cost=(errors**2).sum(axis=1), normals=np.einsum("bsi,bsj->bij", jac, jac),
        gradients=np.einsum("bs,bsi->bi", errors, jac), prior=np.zeros(5),
    )  # fmt: skip
    judge = SimpleNamespace(stage=stage, scale=scale, bounds=lambda: bounds, n=50.0)
    candidate = SimpleNamespace(name="law", kept=(0, 1, 2), how="output adds", at="y", quantity=None)
    return SimpleNamespace(candidate=candidate, fit=fit, judge=judge, jac=jac, errors=errors)


def least(jac: Array, errors: Array) -> float:
    """What least squares leaves."""
    x = np.linalg.lstsq(jac, errors, rcond=None)[0]
    return float(((errors - jac @ x) ** 2).sum())


def test_with_only_its_mean_a_curve_leaves_what_least_squares_says() -> None:
    t = quadratic()
    jac, errors = t.jac.reshape(60, 5), t.errors.reshape(60)
    moved = errors - jac[:, 3:] @ (-t.fit.theta[3:] / t.judge.scale[3:])  # the curve's bends are gone, its mean is not
    assert left_by_its_mean(t) == pytest.approx(least(jac[:, :3], moved), rel=1e-6)
    step = np.linalg.lstsq(jac[:, :3], moved, rcond=None)[0]
    beyond = 1.0 + 0.5 * step[0]  # where the first of the model's parameters may not go to the end
    held = quadratic(*sorted((-50.0 if step[0] > 0.0 else 50.0, beyond)))
    stopped = moved - 0.5 * step[0] * jac[:, 0]
    assert left_by_its_mean(held) == pytest.approx(least(jac[:, 1:3], stopped), rel=1e-6)
    t.candidate.kept = (1, 2)
    assert left_by_its_mean(t) == np.inf


def test_where_parameters_move_without_some_blocks() -> None:
    t = quadratic()
    held = np.array([True, False])
    step = step_without(t, held)
    assert step == pytest.approx(np.linalg.lstsq(t.jac[1], t.errors[1], rcond=None)[0], abs=1e-6)
    t.fit.prior = np.array([4.0, 8.0, 0.0, 0.0, 0.0])  # of what is known beforehand, as more samples
    weight = np.sqrt(t.fit.prior) * t.judge.scale
    away = (t.fit.theta - t.judge.stage.neutral()) / t.judge.scale
    rows = np.concatenate([t.jac[1], np.diag(weight)])
    known = np.concatenate([t.errors[1], -weight * away])
    assert step_without(t, held) == pytest.approx(np.linalg.lstsq(rows, known, rcond=None)[0], abs=1e-6)
    bounded = quadratic(1.0 - 0.5 * abs(step[0]), 1.0 + 0.5 * abs(step[0]))
    assert step_without(bounded, held)[0] == pytest.approx(0.5 * step[0])


def test_of_constants_at_one_place_the_plainest_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    def tried(name: str, left: float, cost: float, at: str = "y", grain: float = 1.0) -> Any:
        judge = SimpleNamespace(stage=SimpleNamespace(grain=grain), n=100.0)
        candidate = SimpleNamespace(how="output adds", at=at, name=name, strange=len(name))
        return SimpleNamespace(candidate=candidate, judge=judge, left=left, fit=SimpleNamespace(cost=np.array([cost])))

    monkeypatch.setattr(fitted_candidate, "left_by_its_mean", lambda t: t.left)
    monkeypatch.setattr(fitted_candidate, "strange", lambda c: c.strange)
    known = LEAST_OF_NOISE * 100.0
    flat, plainer, other = tried("long name", 100.0, 100.0), tried("name", 100.0, 100.0), tried("n", 100.0, 100.0, "z")
    bent = tried("x", 100.0, 100.0 - 1.01 * known)
    assert one_constant([flat, bent, plainer, other]) == [plainer, bent, other]
    edge = tried("x", 100.0, 100.0 - 0.99 * known)
    assert one_constant([flat, edge]) == [edge]
    wide = tried("x", 1000.0, 1000.0 - 0.99 * LEAST_FALL * 900.0)
    assert one_constant([flat, wide]) == [wide]
    assert one_constant([flat, tried("x", 1000.0, 1000.0 - 1.01 * LEAST_FALL * 900.0)])[0] is flat
    fine = [tried("long", 100.0, 100.0 - f * 2.0 * NATS, grain=0.5) for f in (0.99, 1.01)]
    assert (
        one_constant(fine) == fine
        and one_constant([*fine, tried("a", 100.0, 100.0, grain=0.5)])[0].candidate.name == "a"
    )


def test_a_line_is_highest_where_a_parabola_says() -> None:
    for top in (-0.4, 0.0, 0.3):
        assert _between(*(-2.0 * (x - top) ** 2 + 5.0 for x in (-1.0, 0.0, 1.0))) == pytest.approx(top)
    assert _between(1.0, 1.0, 1.0) == 0.0 and _between(2.0, 1.0, 3.0) == 0.0


# ---- a curve among others, on other logs -----------------------------------------------------------------------------


def test_a_candidate_is_fitted_where_all_curves_have_settled(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    judge = SimpleNamespace(sparing=False, fit=lambda *given, **more: asked.append((given, more)) or "the fit")
    own: Any = SimpleNamespace(judge_of=lambda *given: asked.append(given) or judge)
    monkeypatch.setattr(problem, "with_held_out", lambda judge, fit: (judge, fit))
    first, second = np.array([True, True, False]), np.array([False, True, True])
    before = ("placed before", SimpleNamespace(name="one"))
    effect = SimpleNamespace(name="two")
    effects = {0.5: effect}
    for was, now, quick, kept in ((None, None, False, None), (first, None, False, first), (None, second, False, second),
                                  (first, second, False, first & second), (first, second, True, None)):  # fmt: skip
        asked.clear()
        candidate: Any = SimpleNamespace(settled=now, placed=lambda: "placed", effect=effects.get)
        current: Any = SimpleNamespace(settled=was, curves=(before,))
        tried = problem.CurveProblem.fitted(own, current, candidate, 0.5, np.zeros(2), 7, quick)
        (laws, curves, fast, mask), ((names, begin, iterations), more) = asked
        assert laws == () and curves == (before, ("placed", effect)) and fast is quick
        assert (mask is None) == (kept is None) and (kept is None or mask.tolist() == kept.tolist())
        assert names == ("one", "two") and iterations == 7 and begin.tolist() == [0.0, 0.0] and "slopes" in more
        assert judge.sparing is True and tried.fit == (judge, "the fit") and tried.wiggle == 0.5
        assert tried.curves == curves and tried.candidate is candidate


def test_what_a_curve_makes_of_each_log() -> None:
    rng = np.random.default_rng(1)
    errors = {log: 3.0 * rng.standard_normal((2, 50)) for log in ("a", "b", "c")}
    errors["b"][0, :3] = np.nan

    def rms(rows: Array) -> Array:
        return np.sqrt(np.nanmean(rows**2, axis=1))

    asked: list[Any] = []
    ground = SimpleNamespace(
        errors=lambda curves, theta: asked.append(curves) or errors, tests={"b"}, within=lambda c: c.inside
    )
    own: Any = SimpleNamespace(faint=False, ground=ground, judge=SimpleNamespace(stage=SimpleNamespace(grain=0.25)))
    own._levels = lambda of, part: CurveProblem._levels(own, of, part)
    own.change = lambda before, tried, part=None: CurveProblem.change(own, before, tried, part)

    def tried(factor: float, inside: Any = None) -> Any:
        e = {k: factor * v for k, v in errors.items()} if factor != 1.0 else None
        return SimpleNamespace(
            errors=e, curves=factor, fit=SimpleNamespace(theta=0), candidate=SimpleNamespace(inside=inside)
        )

    before, half = tried(1.0), tried(0.5)
    half.errors["b"] = 0.01 * errors["b"]
    change = CurveProblem.change(own, before, half)
    assert change["a"] == pytest.approx(np.log(0.5)) and asked == [1.0] and before.errors is errors
    assert change["b"] == pytest.approx(-np.log(rms(errors["b"])).mean())  # below the noise nothing counts
    some = np.arange(50) < 20
    part = CurveProblem.change(own, before, half, {"b": some})
    assert part["b"] == pytest.approx(-np.log(rms(errors["b"][:, some])).mean()) and part["a"] == change["a"]
    del half.errors["c"]
    assert set(CurveProblem.change(own, before, half)) == {"a", "b"}
    inside = [{"b": np.arange(50) < 40}, {"b": np.arange(50) >= 10, "a": np.ones(50, bool)}]
    among = [tried(0.5, i) for i in inside]
    both = (np.arange(50) < 40) & (np.arange(50) >= 10)
    value = CurveProblem.tested(own, before, half, among)
    assert value == pytest.approx(-np.log(rms(errors["b"][:, both])).mean())
    ground.tests = {"none"}
    assert CurveProblem.tested(own, before, half, among) == 0.0
    own.score = lambda tried, among: 2.5
    own.tested = lambda before, tried, among: 0.25
    assert CurveProblem.left(own, before, half, among) == 2.75
    own.faint = True
    faint = CurveProblem.change(own, before, tried(0.5))
    assert faint["a"] == pytest.approx(np.log(0.5) / 0.25) and faint["b"] == pytest.approx(np.log(0.5) / 0.25)


def test_logs_and_other_subsystems_may_speak_against_a_curve() -> None:
    decided: list[Any] = []
    verdicts: dict[str, bool] = {}

    def decide(rules: Any, case: Any, names: Any, before: Any) -> bool:
        kind = {id(problem.NEAR_NOISE): "near", id(problem.OTHER_LOGS): "logs"}.get(id(rules), "elsewhere")
        decided.append((kind, names, before))
        return verdicts.get(kind, True)

    own: Any = SimpleNamespace(
        faint=False, decisions=SimpleNamespace(decide=decide), change=lambda before, tried: {"a": 0.5, "t": 0.25},
        ground=SimpleNamespace(tests=frozenset({"t"}), elsewhere=lambda curves, theta: {"linkage": 0.75}),
    )  # fmt: skip
    before = SimpleNamespace(names=("one",), errors=None)
    tried = SimpleNamespace(names=("one", "two"), errors=None, curves=(), fit=SimpleNamespace(theta=0))
    assert CurveProblem.objection(own, before, tried) == ""
    assert [d[0] for d in decided] == ["logs", "elsewhere"] and decided[0][1:] == (("one", "two"), ("one",))
    verdicts["elsewhere"] = False
    assert "linkage" in CurveProblem.objection(own, before, tried)
    verdicts["logs"] = False
    said = CurveProblem.objection(own, before, tried)
    assert said and "linkage" not in said
    decided.clear()
    own.faint, verdicts["logs"] = True, True
    before.errors = tried.errors = {"a": np.ones((1, 50)), "t": np.ones((1, 50))}
    CurveProblem.objection(own, before, tried)
    assert [d[0] for d in decided] == ["near", "logs", "elsewhere"]


def test_stops_make_nothing_where_they_have_not_moved() -> None:
    bound = BoundSystem(system(), [log(2.0 * U)])
    q = {q.name: q for q in quantities(bound, np.array([2.0]))}["stops_of_u"]
    c = curve_of(q)
    a = np.arange(1.0, len(c.kept) + 1.0)
    curve = c.placed().curve
    assert curve is not None
    whole = c.basis.design(c.grid) @ c.turn @ a
    assert curve.table(a) == pytest.approx(whole - whole[0]) and abs(whole[0]) > 0.1
    shifted = c.placed_as(lambda n: n[0] + np.arange(4.0), 1, (1.0, 5.0)).curve
    assert shifted is not None and shifted.table(np.array([7.0])).tolist() == [0.0, 1.0, 2.0, 3.0]
    assert (shifted.low, shifted.high) == (1.0, 5.0) and (curve.low, curve.high) == (c.basis.low, c.basis.high)


@dataclass
class HeldFit:
    """What is used of a fit."""

    theta: Array
    gradients: Array
    prior: Array
    free: Array = field(default_factory=lambda: np.array([0, 1]))
    cost: Array = field(default_factory=lambda: np.array([1.0, 2.0]))
    normals: Array = field(default_factory=lambda: np.array([np.eye(2), 2.0 * np.eye(2)]))
    held_out: Array | None = None


@pytest.mark.parametrize(("side", "gradient", "held"), [(1.0, 0.2, False), (1.0, 0.4, True), (-1.0, -0.2, False),
                                                        (-1.0, -0.4, True), (0.5, 0.4, False)])  # fmt: skip
def test_what_a_bound_holds_stays_there_whatever_block_is_left_out(side: float, gradient: float, held: bool) -> None:
    """A curve's parameter at a bound, drawn outwards by the data and inwards by its prior of 0.3."""
    judge: Any = SimpleNamespace(
        scale=np.array([1.0, 1.0]), stage=SimpleNamespace(parameters=("own",), neutral=lambda: np.zeros(2)),
        bounds=lambda: (np.array([-9.0, -1.0]), np.array([9.0, 1.0])),
    )  # fmt: skip
    fit: Any = HeldFit(
        np.array([0.0, side]), np.array([[0.0, 0.75 * gradient], [0.0, 0.25 * gradient]]), np.array([0.0, 0.3])
    )
    judged = (np.array([3.0, 4.0]), 2.0 * fit.gradients, 3.0 * fit.normals)
    if held:
        assert fitted_candidate.with_held_out(judge, fit) is fit
        assert fitted_candidate.with_held_out(judge, fit, judged).held_out.tolist() == [3.0, 4.0]
        return
    # by hand: one parameter, its normals 1 and 2 with a prior of 0.3; of each block the step that the other one takes
    pull = gradient - 0.3 * side
    left = [(pull - 0.75 * gradient) / 2.3, (pull - 0.25 * gradient) / 1.3]
    wanted = [
        c - 2.0 * s * g + s * s * n
        for c, s, g, n in zip((1.0, 2.0), left, (0.75 * gradient, 0.25 * gradient), (1.0, 2.0), strict=True)
    ]
    assert fitted_candidate.with_held_out(judge, fit).held_out == pytest.approx(wanted, rel=1e-6)
    counted = [
        c - 2.0 * s * g + s * s * n
        for c, s, g, n in zip((3.0, 4.0), left, (1.5 * gradient, 0.5 * gradient), (3.0, 6.0), strict=True)
    ]
    assert fitted_candidate.with_held_out(judge, fit, judged).held_out == pytest.approx(counted, rel=1e-6)
    alone: Any = replace(fit, free=np.array([0, 0]))  # of a model without a curve nothing is held out
    assert fitted_candidate.with_held_out(judge, alone) is alone


def test_lines_that_are_hardly_apart_are_one_and_few_are_kept() -> None:
    driven = SimpleNamespace(has=lambda g, alone: g == 3.0)
    own: Any = SimpleNamespace(driven=[driven], shortest=10.0)  # two lines are 0.2 Hz apart at least
    found = [(g, [], 1, 0.5) for g in (1.0, 1.19, 0.81, 3.0, 1.21, 0.5)]
    wanted = [1.0, 1.21, 0.5][: spectral_lines.MOST_PERIODS]
    assert [g for g, _ in Lines._own(own, found)] == [pytest.approx(1.0 / f) for f in wanted]  # type: ignore[arg-type]
    assert Lines._own(own, [(2.0, [], 9, 0.1)]) == [(0.5, 9)]  # type: ignore[list-item]
    assert Lines._own(own, [(2.0, [], 1, 0.1)]) == [(0.5, spectral_lines.HARMONICS)]  # type: ignore[list-item]
    spike = np.zeros(2000)
    spike[1000] = 100.0
    assert about(spike) == pytest.approx(np.full(2000, 1e-10), rel=1e-9)


@pytest.mark.parametrize("lent", [set(), {0}, {1}, {0, 1}])
def test_a_band_goes_about_a_formula_as_far_as_the_parameters_leave_it(
    lent: set[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Mean and slope that the model's own parameters have are no difference of a curve and its formula; beside a slope
    its size is none either.
    """
    x = np.linspace(-1.0, 2.0, learned_law.POINTS)
    f, been = np.sin(3.0 * x), x < 1.5
    y = 1.4 * f + 0.3 * x - 0.7 + 0.1 * x**3
    monkeypatch.setattr(learned_law, "values_of", lambda formula, at: f if at is x else None)
    c: Any = SimpleNamespace(grid=x, lent=lent)
    low, high = learned_law._with_formulas(c, y, y - 0.2, y + 0.5, been, ["formula"])  # type: ignore[list-item]
    columns = [v for k, v in enumerate((np.ones(x.size), x)) if k in lent] + [f] * (1 in lent)
    moved = f.copy()
    if columns:
        a = np.array(columns).T
        moved += a @ np.linalg.lstsq(a[been], (y - f)[been], rcond=None)[0]
    np.testing.assert_allclose(low, np.minimum(y, moved) - 0.2, atol=1e-9)
    np.testing.assert_allclose(high, np.maximum(y, moved) + 0.5, atol=1e-9)


def test_what_grounds_give_the_search_for_curves() -> None:
    own = UserModelCandidates
    assert (own.points, own.jumps, own.surfaces) == (FINE, True, True)


HOWS = {
    "parameter times": "k is multiplied by 1 + {}", "input adds": "{} is added to k",
    "input times": "k is multiplied by 1 + {}", "state adds": "{} is taken off the derivative of k",
    "force adds": "{} is added to the force", "output adds": "{} is added to the reading k",
    "output times": "the reading k is multiplied by 1 + {}", "adds": "{} is added to k",
    "times": "k is multiplied by 1 + {}",
}  # fmt: skip


def a_law(**more: Any) -> LearnedLaw:
    x = np.linspace(-1.0, 2.0, 5)
    given: dict[str, Any] = {
        "name": "k.curve_of_u", "how": "adds", "at": "k", "of": "u", "unit": "N", "of_unit": "mm", "x": x, "y": x,
        "low": x, "high": x, "edges": x, "visited": x, "error_before": 2.0, "error_after": 1.0, "knots": x,
    }  # fmt: skip
    return LearnedLaw(**given | more)


def test_a_learned_law_in_words() -> None:
    for how, said in HOWS.items():
        assert a_law(how=how).sentence() == said.format("a function of u")
    line = Formula("line", "2 u", {"a": 2.0}, 1.0, 1.0, "k.gain", 0.0)
    root = Formula("root", "3 sqrt(u)", {"a": 3.0}, 1.0, 1.0, "", 0.0)
    assert a_law(formulas=[line, root]).sentence() == "a function of u is added to k, near 2 u (k.gain of the library)"
    assert a_law(formulas=[root], spoken=root).sentence() == "a function of u is added to k, 3 sqrt(u)"
    constant = a_law(spoken=Formula("constant", "5 N", {"a": 5.0}, 1.0, 1.0, "", 0.0))
    assert constant.constant and not a_law(spoken=root).constant
    assert constant.sentence() == "a constant is added to k, 5 N"
    stops = a_law(of="stops_of_u", formulas=[root])
    assert stops.sentence() == "a hysteresis of u is added to k, with the virgin curve near 3 sqrt(u)"
    assert a_law(of="u_lagged_by_20_ms").sentence() == "a function of u (lagged by 0.02 s) is added to k"
    timed = a_law(of="time_every_1500_ms", of_unit="s", period=1.5)
    assert timed.sentence() == "a function of the time within each 1.5 s is added to k" and timed.channel == "time"
    assert a_law(period=0.25, of_unit="-").sentence() == "a function of u within each 0.25 is added to k"
    assert a_law().channel == a_law().of_what == "u" and a_law().more() == {} and a_law().axis() is None


def test_where_a_law_holds_in_words() -> None:
    root = Formula("root", "3 sqrt(u)", {"a": 3.0}, 1.0, 1.0, "", 0.0)
    assert a_law().range_note() == (
        "k.curve_of_u: u has been in [-1, 2] mm; the law file has the curve; beyond, it stays as at its end"
    )
    assert a_law(spoken=root, reach=(-3.0, 4.5)).range_note() == (
        "k.curve_of_u: u has been in [-1, 2] mm; the law file has the formula, which does as well as the curve; it "
        "goes on to [-3, 4.5] mm, and stays as there beyond"
    )
    assert a_law(of_unit="-").range_note().startswith("k.curve_of_u: u has been in [-1, 2]; the")
    assert a_law(period=2.0).range_note() == "k.curve_of_u: the law file has the curve"
    same, every = a_law(), a_law(of="time_every_1500_ms", period=1.5)
    assert same.of_the_kind_of(a_law(name="other")) and not same.of_the_kind_of(a_law(at="m"))
    assert not same.of_the_kind_of(a_law(how="times")) and not same.of_the_kind_of(a_law(of="v"))
    assert every.of_the_kind_of(a_law(of="time_every_3000_ms", period=3.0))


def test_rows_that_may_have_a_line_are_errors_their_rates_and_their_products() -> None:
    t = [0.1 * np.arange(30), 0.2 * np.arange(20)]
    errors = [white(k, 2, len(x)) for k, x in enumerate(t)]
    signals = [np.array([1.0 + 3.0 * x + np.sin(x)]) for x in t]
    rows = spectral_lines._rows(t, errors, signals)
    each = spectral_lines.LINE_DERIVATIVES + 1
    assert len(rows) == 2 * each * 2 and all(len(r) == 2 for r in rows)
    for log, x in enumerate(t):
        at = 0
        for j in range(2):
            e = errors[log][j]
            for _ in range(each):
                s = signals[log][0] - np.polyval(np.polyfit(x, signals[log][0], 1), x)
                for factor in (1.0, s):
                    np.testing.assert_allclose(rows[at][log], e * factor, atol=1e-9)
                    at += 1
                e = np.gradient(e, x)
    alone = spectral_lines._rows(t[:1], [errors[0][:1]], [np.zeros((0, 30))])
    assert len(alone) == each and alone[0][0].tolist() == errors[0][0].tolist()
    where = np.arange(400) % 40
    power = spectral_lines._power(where, 3.0 + np.cos(2.0 * np.pi * where / 8.0), 40)
    assert int(np.argmax(power)) == 5 * spectral_lines.LINES_EACH  # five cycles from end to end
    assert (
        power.max() == pytest.approx((0.5 * 400.0) ** 2 / 200.0)
        and spectral_lines._power(where, np.ones(400), 40).max() == 0
    )


def test_pairs_of_formulas_are_the_likeliest_of_both_factors(monkeypatch: pytest.MonkeyPatch) -> None:
    x, z = np.linspace(-1.0, 1.0, 200), np.linspace(0.5, 2.0, 200)
    c: Any = SimpleNamespace(axes=[(Quantity("u", "V", INPUT, x), None), (Quantity("w", "degC", INPUT, z), None)])
    asked: list[tuple[str, float]] = []
    share = {"line": 1e-9, "cube": 0.02, "root": 0.3, "Arrhenius": 0.01, "exponential": 5.0}

    def begin(form: Any, some: Array, values: Array, free: Any) -> Any:
        asked.append((form.name, float(some[0])))
        assert values.tolist() == (2.0 * some).tolist() and len(free) == 0
        return (np.array([1.0]), share[form.name]) if form.name in share else None

    monkeypatch.setattr(closed_form_fits, "begin", begin)
    pairs = closed_form_fits._likely(c, (x, z), (lambda v: 2.0 * v, lambda v: 2.0 * v))  # type: ignore[arg-type]
    names = {f.name for f in FORMS}
    assert {n for n, first in asked if first < 0.0} == names - {"constant", "Arrhenius"}  # no temperature
    assert {n for n, first in asked if first > 0.0} == names - {"constant"}
    assert sorted({first for _, first in asked}) == pytest.approx([np.quantile(x, 0.005), np.quantile(z, 0.005)])

    def worth(name: str) -> float:
        form = next(f for f in FORMS if f.name == name)
        return float(np.log(max(share[name], closed_form_fits.FORMS_ALIKE)) + 0.3 * form.complexity)

    most = closed_form_fits.PRODUCT_FORMS
    good = [[n for n in share if share[n] < closed_form_fits.FORM_SHAPED and (n != "Arrhenius" or k)] for k in (0, 1)]
    kept = [sorted(g, key=worth)[:most] for g in good]
    wanted = sorted(((worth(a) + worth(b), a, b) for a in kept[0] for b in kept[1]), key=lambda w: w[0])
    assert [(one[0].name, other[0].name) for one, other in pairs] == [(a, b) for _, a, b in wanted]


def test_formulas_of_a_curve_are_tried_with_its_mean_and_without_once(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[bool] = []
    strict, loose = [("f", "one"), ("g", "two")], [("g", "two"), ("h", "three")]

    def fitted(ground: Any, tried: Any, loose: bool = False) -> Any:
        asked.append(loose)
        return loose_found if loose else strict

    loose_found: list[Any] = loose
    monkeypatch.setattr(curve_choice, "fitted_formulas", fitted)
    tried: Any = SimpleNamespace(loose=None)
    assert curve_choice.with_and_without_mean(None, tried) == ["one", "two", "three"] and asked == [False, True]  # type: ignore[arg-type, comparison-overlap]
    assert curve_choice.with_and_without_mean(None, tried) == ["one", "two", "three"] and asked[2:] == [False]  # type: ignore[arg-type, comparison-overlap]
    loose_found, none = [], SimpleNamespace(loose=None)
    assert curve_choice.with_and_without_mean(None, none) == ["one", "two"] and none.loose == ["one", "two"]  # type: ignore[arg-type, comparison-overlap]
    out = SimpleNamespace(decisions=None)
    own: Any = SimpleNamespace(_searched=lambda: out, decisions=["a", "b"])
    assert CurveSearch.learned(own) is out and out.decisions == ["a", "b"]  # type: ignore[comparison-overlap]
    assert inspect.signature(CurveProblem).parameters["speaks"].default is True
