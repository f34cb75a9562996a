"""Curves and formulas as candidates: a basis by its definition, and which formula a curve is."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as settings_of
from hypothesis import strategies as st
from scipy.interpolate import BSpline

from tests.conftest import examples
from vaneloop.base.forms import FORMS, Form
from vaneloop.identification.candidates.closed_forms import Formula, _refined, begin, text_of, values_of
from vaneloop.identification.candidates.laws import apply
from vaneloop.identification.candidates.library import LAWS, Size
from vaneloop.identification.candidates.spline_basis import Basis, basis_of, waves_of

Array = np.ndarray


def made(name: str, seed: int, q: Array) -> tuple[Form, Array]:
    """A form and random numbers of it that show in q."""
    form = next(f for f in FORMS if f.name == name)
    rng = np.random.default_rng(seed)
    span = float(np.ptp(q))
    units = {"per": 1.0 / span, "share": span, "plain": 1.0, "kelvin": 1e4}
    inner = []
    for kind, of in form.inner:
        v = float(rng.uniform(min(of), max(of))) if kind != "per" or min(of) > 0 else float(rng.choice(of)) * 1.2
        inner.append(q.min() + v * span if kind == "at" else v * units[kind])
    return form, np.array([float(rng.choice([-1.0, 1.0])) * rng.uniform(0.5, 5.0), *inner])


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("name", [f.name for f in FORMS])
def test_a_curve_that_is_a_formula_is_known_by_it_whatever_the_model_adds(name: str, seed: int) -> None:
    form = next(f for f in FORMS if f.name == name)
    q = np.sort(np.random.default_rng(seed).uniform(*((1.0, 9.0) if form.positive else (-4.0, 5.0)), 80))
    form, numbers = made(name, seed, q)
    y = np.broadcast_to(form.value(q, numbers), q.shape).astype(float)
    got = begin(form, q, y, ())
    assert got is not None and got[1] < 2e-3
    assert form.value(q, got[0]) == pytest.approx(y, abs=0.06 * float(np.ptp(y) or 1.0))
    shape = y - np.polyval(np.polyfit(q, y, 1), q)
    if name not in ("constant", "step") and np.std(shape) > 0.05 * np.std(y):  # which is no straight line itself
        freed = begin(form, q, y + 7.0 - 0.5 * q, (0, 1))
        assert freed is not None and freed[1] < 5e-3
    w = np.where(np.arange(80) < 40, 1.0, 0.0)  # what has no weight says nothing
    half = begin(form, q, np.where(w > 0.0, y, 99.0), (), w)
    assert half is None or not np.any(y[:40]) or half[1] < 2e-2


def test_a_formula_is_asked_only_where_it_can_be_told() -> None:
    by_name = {f.name: f for f in FORMS}
    up, both = np.linspace(1.0, 9.0, 50), np.linspace(-4.0, 5.0, 50)
    for name, q, free, asked in (
        ("inverse", both, (), False), ("inverse", up, (), True), ("inverse", up - 1.0, (), False),
        ("magnitude", up, (), False), ("magnitude", both, (), True), ("magnitude", up - 1.0, (), False),
        ("magnitude", up - 9.0, (), False),
        ("Arrhenius", both - 300.0, (), False), ("Arrhenius", both, (), True),
        ("constant", up, (0,), False), ("constant", up, (1,), True), ("line", up, (1,), False),
        ("straight line", up, (0,), True), ("straight line", up, (0, 1), False), ("line", up, (0, 1), False),
    ):  # fmt: skip
        assert (begin(by_name[name], q, q**2 + 1.0, free) is not None) == asked, (name, free)
    assert begin(by_name["square"], up, np.zeros(50), ()) is None  # nothing is no curve
    _, left = begin(by_name["line"], up, np.random.default_rng(1).standard_normal(50), ()) or (None, 0.0)
    assert 0.8 < left <= 1.0


@pytest.mark.parametrize(
    ("name", "numbers", "above", "mean", "text"),
    [
        ("line", [2.0], False, 0.0, "2 speed"),
        ("line", [2.0], False, 3.0, "2 speed - 3"),
        ("line", [2.0], False, -3.0, "2 speed + 3"),
        ("straight line", [2.0, -1.5], False, 0.0, "2 (speed + 1.5)"),
        ("root", [-2.0], True, 0.0, "-2 sqrt(speed)"),
        ("root", [-2.0], False, 0.0, "-2 sign(speed) sqrt(|speed|)"),
        ("tanh", [2.0, 0.333333], False, 0.0, "2 tanh(0.3333 speed)"),
    ],
)
def test_a_formula_in_words(name: str, numbers: list[float], above: bool, mean: float, text: str) -> None:
    form = next(f for f in FORMS if f.name == name)
    assert text_of(form, np.array(numbers), "speed", above, mean) == text
    q = np.linspace(1.0, 2.0, 5)
    formula = Formula(name, text, dict(zip(form.numbers, numbers, strict=True)), 1.0, 2)
    assert formula.level == 0.0 and text_of(form, np.array(numbers), "speed", above) == re.sub(r" [-+] 3$", "", text)
    assert values_of(formula, q) == pytest.approx(form.value(q, np.array(numbers)))
    assert values_of(Formula("constant", "", {"a": 3.0}, 1.0, 1), q).tolist() == [3.0] * 5


# ---- bases -----------------------------------------------------------------------------------------------------------


def functions(b: Basis, x: Array) -> Array:
    """Every function of a basis at x: float64[samples, functions]."""
    return np.asarray(b.design(x) @ b.turn)


@given(seed=st.integers(0, 999), scale=st.floats(1e-3, 1e3), shift=st.floats(-10.0, 10.0))
@settings_of(max_examples=examples(8), deadline=None)
def test_a_basis_is_orthonormal_where_the_log_has_been_and_ordered_by_how_much_it_bends(
    seed: int, scale: float, shift: float
) -> None:
    x = scale * (shift + np.random.default_rng(seed).standard_normal(900))
    b = basis_of(x)
    assert b is not None
    assert b.reaches(np.array([b.low - scale, 0.5 * (b.low + b.high), b.high + scale])).tolist() == [False, True, False]
    inside = x[b.reaches(np.clip(x, x.min() + 1e-9 * scale, x.max() - 1e-9 * scale))]
    assert len(inside) > 0.97 * len(x) and b.low >= x.min() - 1e-9 * scale and b.high <= x.max() + 1e-9 * scale
    f = functions(b, inside)
    assert f.T @ f / len(f) == pytest.approx(np.eye(f.shape[1]), abs=1e-5)
    assert f[:, 0] == pytest.approx(1.0, abs=1e-6)
    straight = np.polyval(np.polyfit(inside, f[:, 1], 1), inside)
    assert f[:, 1] == pytest.approx(straight, abs=1e-6) and np.corrcoef(inside, f[:, 1])[0, 1] == pytest.approx(1.0)
    grid = np.linspace(b.low, b.high, 4001)[:-1]
    second = BSpline(b.knots, b.turn, 3).derivative(2)(grid)
    bend = np.mean(second**2, axis=0)
    assert b.bend[2:] == pytest.approx(bend[2:] / bend[2], rel=0.02) and b.bend[:2].tolist() == [0.0, 0.0]
    assert np.all(np.diff(b.bend) >= 0.0) and b.straight == 2
    beyond = functions(b, np.array([b.low - scale, b.low, b.high, b.high + scale]))
    assert beyond[0] == pytest.approx(beyond[1]) and beyond[3] == pytest.approx(beyond[2])  # it stays as at its ends
    zeroed = b.zeroed()
    assert functions(zeroed, np.zeros(1)) == pytest.approx(np.zeros((1, f.shape[1])), abs=1e-9)
    some = np.diff(functions(zeroed, inside[:9]), axis=0)
    assert some == pytest.approx(np.diff(f[:9], axis=0), abs=1e-9)
    for sign in (1, -1):
        rising = b.rising(sign)
        steps = np.diff(functions(rising, np.linspace(b.low, b.high, 60)), axis=0)
        assert np.all(sign * steps[:, 1:] >= -1e-12) and steps[:, 0] == pytest.approx(0.0, abs=1e-12)
        assert (
            rising.turn.shape == b.turn.shape
            and rising.straight == 1
            and rising.rises == sign
            and np.array_equal(rising.bend, np.ones(len(rising.turn)))
        )
        ends = functions(rising, np.array([b.low, b.high]))
        assert ends[1, 1:] - ends[0, 1:] == pytest.approx(float(sign))  # each step is one up or down


@given(harmonics=st.integers(1, 4), period=st.floats(0.1, 50.0))
@settings_of(max_examples=examples(6), deadline=None)
def test_what_repeats_itself_has_sines_and_cosines(harmonics: int, period: float) -> None:
    b = waves_of(period, harmonics)
    x = np.linspace(0.0, period, 200)
    f = functions(b, x)
    assert f[:, 0] == pytest.approx(1.0) and b.straight == 1 and b.period == period and b.bend[0] == 0.0
    for k in range(1, harmonics + 1):
        turns = 2.0 * np.pi * k * x / period
        assert f[:, 2 * k - 1] == pytest.approx(np.sqrt(2.0) * np.sin(turns), abs=0.03)
        assert f[:, 2 * k] == pytest.approx(np.sqrt(2.0) * np.cos(turns), abs=0.03)
        assert b.bend[2 * k - 1] == b.bend[2 * k] == k**4
    assert f.shape[1] == 2 * harmonics + 1 and len(b.turn) == 9 * harmonics  # docs/settings.md


def test_too_few_values_are_no_curve_and_two_or_three_make_a_straight_one() -> None:
    rng = np.random.default_rng(3)
    assert basis_of(rng.random(19)) is None and basis_of(rng.random(20)) is not None
    assert basis_of(np.full(900, 4.0)) is None
    assert basis_of(np.append(rng.random(19), [np.nan] * 50)) is None
    assert basis_of(np.repeat([1.0, 2.0, 3.0, 4.0], 50)) is None  # four values: neither
    for values in ([-1.0, 1.0], [-1.0, 0.0, 1.0]):
        x = rng.choice(values, 400)
        b = basis_of(x)
        assert b is not None and b.turn.shape == (4, 2) and (b.low, b.high) == (-1.0, 1.0) and not b.bend.any()
        assert len(b.bend) == 2
        f = functions(b, x)
        assert f.T @ f / len(f) == pytest.approx(np.eye(2), abs=1e-9)


def test_one_stray_value_does_not_stretch_a_basis() -> None:
    x = np.random.default_rng(4).uniform(0.0, 1.0, 3000)
    stray = basis_of(np.append(x, 1000.0))
    assert stray is not None and 1.0 <= stray.high <= 1.26 and stray.low == pytest.approx(x.min())


@pytest.mark.parametrize("kind", ["plain", "rising", "waves"])
def test_a_curve_s_amplitudes_are_known_as_well_as_curves_are_smooth(kind: str) -> None:
    b = basis_of(np.random.default_rng(5).uniform(0.0, 1.0, 900))
    assert b is not None
    b = {"plain": b, "rising": b.rising(1), "waves": waves_of(2.0)}[kind]
    kept = range(1, 6)
    e = b.effect("curve", "N", 4.0, 0.5, kept, jump=True)
    *own, jump = e.parameters
    wide = np.sqrt(3.0) * 3.0 * 4.0  # three times what is usual, as a uniform interval has it
    assert jump.name == "jump" and jump.tolerance == pytest.approx(wide)
    first = {"plain": "slope", "rising": "step_1", "waves": "wave_1"}[kind]
    assert [p.name for p in own][:2] == [first, {"plain": "bend_1", "rising": "step_2", "waves": "wave_2"}[kind]]
    for k, p in zip(kept, own, strict=True):
        bent = np.sqrt(3.0) * 0.5 * 4.0 / np.sqrt(b.bend[k]) if k >= b.straight else wide
        assert p.tolerance == pytest.approx(bent)
        assert (p.unit, p.scale, p.value, p.low) == ("N", 4.0, 0.0, 0.0 if kind == "rising" else -np.inf)
    signs = (1.2,) if kind == "rising" else (-1.2, 1.2)  # from three tenths of what is usual, both ways where it may
    expected = [tuple(s if i == k else 0.0 for i in range(6)) for k in range(3) for s in signs]
    assert sorted(e.starts) == sorted(expected)
    assert [p.name for p in b.effect("curve", "N", 4.0, 0.5, [0]).parameters] == ["mean"]


@pytest.mark.parametrize("count", [5, 10, 17])
def test_a_curve_has_as_many_splines_as_it_is_to_have_with_knots_at_quantiles(count: int) -> None:
    x = np.linspace(0.0, 1.0, 2001) ** 2
    b = basis_of(x, count)
    assert b is not None and b.turn.shape == (count, count) and len(b.bend) == count
    inner = np.unique(b.knots)[1:-1]
    wanted = b.low + (b.high - b.low) * np.linspace(0.0, 1.0, count - 2)[1:-1] ** 2
    assert len(inner) == len(wanted) == count - 4 and inner == pytest.approx(wanted, abs=0.02)
    assert b.low == 0.0 and b.high == 1.0
    assert basis_of(3.0 + 1e-13 * x) is None and basis_of(-3.0 - 1e-9 * x) is not None  # as rounding may leave them
    crowd = np.concatenate([1e-4 * np.random.default_rng(1).random(500), np.linspace(0.0, 1.0, 60)])
    ends = basis_of(crowd, count)
    assert ends is None or [np.count_nonzero(ends.knots == end) for end in (ends.low, ends.high)] == [4, 4]
    wave = waves_of(1.0, 2)
    fine = np.linspace(0.0, 1.0, 999)
    off = functions(wave, fine)[:, 3] - np.sqrt(2.0) * np.sin(4.0 * np.pi * fine)
    assert np.abs(off).max() < 0.03


def test_numbers_of_formulas_are_refined_side_by_side() -> None:
    """Each row is a decay of its own; from one nothing leads on, and it stays."""
    t = np.linspace(0.0, 4.0, 60)
    truth = np.array([[2.0, 0.7], [-1.0, 1.5], [0.5, 0.2], [1.0, 1.0]])

    def left(z: Array, rows: Array) -> Array:
        out = truth[rows, :1] * np.exp(-truth[rows, 1:] * t) - z[:, :1] * np.exp(-z[:, 1:] * t)
        out[rows == 3] = np.nan
        return out

    begins = np.array([[1.0, 1.0], [-0.5, 1.0], [1.0, 0.5], [1.0, 2.0]])
    got = _refined(left, begins)
    assert got[:3] == pytest.approx(truth[:3], rel=1e-4) and got[3].tolist() == [1.0, 2.0]
    assert begins[0].tolist() == [1.0, 1.0]
    assert _refined(left, truth[:1]) == pytest.approx(truth[:1])


# ---- laws ------------------------------------------------------------------------------------------------------------

USUAL = Size(-4.0, 5.0, 3.0, 11.0, 0.01, 60.0, "U", 5.0, "F", 0.7, "V", 0.3, "X")


def test_fits_start_from_hardly_seen_to_gross_and_both_ways_where_a_law_may_go() -> None:
    for place, laws in LAWS.items():
        for name, law in laws.items():
            ps, starts = law.make(USUAL)
            sizes = np.array(starts)
            told = f"{place} {name}"
            for k, p in enumerate(ps):
                values = np.unique(sizes[:, k])
                if p.low < 0.0 < p.high and p.value == 0.0:  # it may have either sign: as many of each, as large
                    assert values == pytest.approx(-values[::-1], rel=1e-9) or name == "stribeck", told
                if p.shape or (p.name, name) == ("sharpness", "bouc_wen"):
                    assert p.low <= p.value <= p.high
                    continue
                if name in ("saturation", "overflow", "gain", "stribeck", "second_order_lag", "rate_limit"):
                    continue
                up = values[values > 0.0]
                assert up.max() / up.min() >= (5.0 if p.high == 1.0 else 9.0), told  # from hardly seen to gross
                assert np.all(up[1:] / up[:-1] <= (10.0 if place == "state" else 5.0) + 1e-9), (
                    told
                )  # none far from the next
                assert p.high >= 1.2 * up.max() or p.high == up.max() == 1.0, told
            if name == "bouc_wen":
                assert set(sizes[:, 2]) == {ps[2].value} == {1.0}
    (gain,), factors = LAWS["signal"]["gain"].make(USUAL)
    assert (
        np.prod(factors) == pytest.approx(1.0, rel=0.01) and gain.low * gain.high == 1.0 == gain.value
    )  # as often half
    (rate,), starts = LAWS["signal"]["rate_limit"].make(USUAL)
    ratios = np.diff(np.log(np.ravel(starts)))
    assert ratios == pytest.approx(np.full(len(ratios), ratios[0])) and starts[-1][0] == pytest.approx(USUAL.fastest)
    least = (USUAL.high - USUAL.low) / USUAL.span  # what goes through the range once in the log
    assert starts[0][0] == pytest.approx(2.0 * least) and rate.scale == pytest.approx(np.exp(np.mean(np.log(starts))))
    assert rate.low < least < rate.high == rate.value >= 100.0 * USUAL.fastest
    for name in ("lag", "dead_time", "second_order_lag"):
        (p, *_), starts = LAWS["signal"][name].make(USUAL)
        ratios = np.diff(np.log(np.unique([s[0] for s in starts])))
        assert ratios == pytest.approx(np.full(len(ratios), ratios[0])), name
        assert starts[-1][0] == pytest.approx(USUAL.span / 30.0) and p.high > 3.0 * starts[-1][0] / 2.0
    level, share = LAWS["state"]["overflow"].make(USUAL)[0]
    levels = [s[0] for s in LAWS["state"]["overflow"].make(USUAL)[1]]
    assert levels == sorted(levels, reverse=True) and (levels[0], levels[-1]) == (USUAL.high, 0.5)
    assert share.value == 1.0 and share.low + share.high == 2.0 and level.value == level.high
    held, step = 0.1, 0.01  # halfway from the last sample of one hold to that of two
    stopped = LAWS["signal"]["stiction"].constant
    assert stopped is not None
    assert stopped(replace(USUAL, held=held)) == pytest.approx(0.5 * ((held - step) + (2.0 * held - step)))
    assert stopped(USUAL) == 0.5 * step  # at once, where a command changes with every sample
    down = replace(USUAL, low=-9.0)
    assert (USUAL.greatest, down.greatest, replace(USUAL, low=3.0).half) == (5.0, 9.0, 1.0)
    low, high = LAWS["signal"]["saturation"].make(USUAL)[0]
    assert (low.value, high.value) == (-13.0, 14.0)  # a range beyond either end: it changes nothing


def test_a_law_without_memory_answers_each_value_alone() -> None:
    rng = np.random.default_rng(1)
    u = np.cumsum(rng.standard_normal(400))
    u *= 4.0 / np.abs(u).max()
    t = 0.01 * np.arange(400)
    for name, law in LAWS["signal"].items():
        ps, starts = law.make(USUAL)
        row = np.zeros(4)
        row[: len(ps)] = starts[len(starts) // 2]
        row[len(ps)] = law.constant(USUAL) if law.constant else 0.0
        there = apply(law.code, t, u, row)
        back = apply(law.code, t, np.ascontiguousarray(u[::-1]), row)[::-1]
        assert np.allclose(there, back, atol=1e-12) != law.memory, name
    assert Size(0.0, 1.0, 1.0, 1.0, 1.0, 1.0).held == 0.0  # not known
    assert {name for name, law in LAWS["force"].items() if law.memory} == {
        "elastic_plastic", "bouc_wen", "backlash_gap"
    }  # fmt: skip


def worth(unit: str, scales: dict[str, float]) -> float:
    """How many of the new unit an old one is, where the old base units are so many of the new ones."""
    text = re.sub(r"(?<=[\w)]) (?=[\w(])", "*", unit).replace("^", "**")
    return 1.0 if unit == "-" else float(eval(text, {**scales}))  # noqa: S307


@given(scales=st.tuples(*[st.floats(0.01, 100.0)] * 5), low=st.floats(-9.0, 1.0), memory=st.booleans())
@settings_of(max_examples=examples(10), deadline=None)
def test_in_other_units_every_law_is_the_same_law(scales: tuple[float, ...], low: float, memory: bool) -> None:
    u, f, v, x, s = scales  # of the values, of forces, of speeds, of displacements, of time
    by_unit = {"U": u, "F": f, "V": v, "X": x, "s": s}
    here = Size(
        low, 7.0, 3.0, 11.0, 0.01, 60.0, "U", 5.0, "F", 0.7, "V", 0.3, "X", 0.05 if memory else 0.0,
    )  # fmt: skip
    there = replace(
        here, low=u * low, high=u * 7.0, rate=u / s * 3.0, fastest=u / s * 11.0, step=s * 0.01, span=s * 60.0,
        force=f * 5.0, speed=v * 0.7, travel=x * 0.3, held=s * here.held, ends=(-x, x),
    )  # fmt: skip
    for place, laws in LAWS.items():
        for name, law in laws.items():
            if "temperature" in law.of:  # of an absolute temperature, which no unit U is
                continue
            (ps, starts), (ps_there, starts_there) = law.make(here), law.make(there)
            factor = np.array([worth(p.unit, by_unit) for p in ps])
            told = f"{place} {name}"
            for of in ("value", "low", "high", "tolerance", "scale"):
                a, b = (np.array([getattr(p, of) for p in each], dtype=float) for each in (ps, ps_there))
                assert b == pytest.approx(np.where(np.isfinite(a), factor * np.nan_to_num(a), a), rel=1e-9), told
            assert np.array(starts_there) == pytest.approx(factor * np.array(starts), rel=1e-9), told
            low_end, high_end = (np.array([getattr(p, end) for p in ps]) for end in ("low", "high"))
            within = (np.array(starts) >= low_end - 1e-12) & (np.array(starts) <= high_end + 1e-12)
            assert within.all() and all(p.low <= p.value <= p.high for p in ps), told
            assert len({tuple(of) for of in starts}) == len(starts) and len(starts[0]) == len(ps), told
