"""Which curve is meant, and what is said of it: held-out errors against refits, what confirms memory, formulas that
speak for curves, surfaces and products. Models here are linear in their curves, so that least squares knows the answer;
what only orders and picks gets stand-ins.
"""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as settings_of
from hypothesis import strategies as st

from tests.conftest import examples
from tests.small_logs import white
from vaneloop.base.forms import FORMS
from vaneloop.identification import Parameter, Stage
from vaneloop.identification.candidates.closed_forms import Formula
from vaneloop.identification.least_squares.problem import Fit, LeastSquaresProblem
from vaneloop.identification.results import rms_of
from vaneloop.identification.selection.likelihood_acceptance import rival_nats
from vaneloop.identification.selection.relative_error_acceptance import RelativeErrorAcceptance, score
from vaneloop.identification.selection.rules import Decisions
from vaneloop.identification.subsystem import Array
from vaneloop.identification.unmodelled import curve_choice, learning, screening, surface_search
from vaneloop.identification.unmodelled.closed_form_fits import (
    Product,
    _factors,
    _is_shaped,
    _likely,
    _samples,
    _text,
    effect_of,
    library_name,
    likely,
    likely_products,
)
from vaneloop.identification.unmodelled.curve_candidates import Candidate, basis_for, surface_of, usual
from vaneloop.identification.unmodelled.fitted_candidate import (
    FittedCandidate,
    Outcome,
    at_samples,
    left_by_its_mean,
    one_constant,
    stands,
    step_without,
    surely_more,
    told_by_others,
    with_held_out,
    without_its_lag,
)
from vaneloop.identification.unmodelled.learned_law import _trades, _with_formulas, band_of, range_of, surface_law_of
from vaneloop.identification.unmodelled.learning import CurveSearch
from vaneloop.identification.unmodelled.problem import CurveProblem, above_the_noise, grain_of, in_grains
from vaneloop.identification.unmodelled.regressors import Quantity
from vaneloop.identification.user_models.terms import COLUMN, INPUT

# docs/settings.md
HARM, LEAST_FALL, LEAST_USE, MOST_LEFT, UNKNOWN, OTHER_AMPLITUDE, SURELY = 0.1, 0.2, 0.02, 0.25, 1.25, 1.5, 3.0
RIVAL, BETTER, NATS, FORM, FORM_POOR, FORMS_NEAR, FORM_SAME, PER_PARAMETER = (
    0.05,
    0.02,
    12.0,
    0.02,
    1.5,
    0.05,
    0.02,
    0.01,
)
FORMULA_MAY_EARN, NOT_INSTEAD, LEAST_PARAMETER_LEFT, LEAST_OF_NOISE, MAY_CATCH_UP = 0.25, 0.5, 0.1, 0.1, 0.25
MOST_CURVES, SURFACE_QUANTITIES, PRODUCT_FORMS, BENDS_TRIED, SCREENED_BEND = 2, 5, 4, (0.1, 1.0, 5.0), 1.0

N = 480
T = 0.1 * np.arange(N)
U = 1.5 * np.sin(0.9 * T) + 0.7 * np.sin(2.3 * T + 1.0)
FLOOR = 0.1


def candidate(name: str = "u", at: str = "y", how: str = "output adds", x: Array = U, **more: Any) -> Candidate:
    """A curve of a quantity at a place; ``of`` its number."""
    q = Quantity(name, more.pop("of_unit", "V"), more.pop("of", INPUT), x, **more.pop("quantity", {}))
    basis = basis_for(Quantity("u", "V", INPUT, x))
    assert basis is not None
    kind = "gain" if how.endswith("times") else "curve"
    return Candidate(f"{at}.{kind}_of_{name}", how, 0, at, more.pop("unit", "V"), 0.5, True, q, basis, **more)


def fitted(c: Candidate, y: Array, wiggle: float = 1.0, tolerance: float = 0.5, **more: Any) -> FittedCandidate:
    """A curve beside a gain, fitted to y: least squares with priors."""
    effect = c.effect(wiggle)
    rows = np.vstack([np.cos(1.3 * T), (c.basis.design(c.quantity.visited) @ c.turn).T])
    stage = Stage(
        "s", ("y",), ("V",), (Parameter("gain", 1.0, "1", 0.0, 2.0, tolerance),), (effect,),
        lambda thetas: (thetas @ rows)[:, None, :], T, y, floor=np.array([FLOOR]),
    )  # fmt: skip
    judge = LeastSquaresProblem(stage, np.array([FLOOR]))
    fit = with_held_out(judge, judge.fit((c.name,), stage.neutral()))
    return FittedCandidate(c, wiggle, judge, fit, ((c.placed(), effect),), **more)


def measured(seed: int, law: Any = lambda x: 0.3 * np.sin(2.0 * x), gain: float = 1.1, x: Array = U) -> Array:
    return np.asarray(gain * np.cos(1.3 * T) + law(x) + FLOOR * white(seed, N))


def tried(name: str = "u", error: float = 1.0, **more: Any) -> Any:
    """A stand-in for a fitted curve: where only its name, place and error count."""
    given: dict[str, Any] = {"at": "y", "how": "output adds", "memory": False, "formulas": None, "loose": None}
    given |= more
    c = candidate(name, given["at"], given["how"], quantity=given.pop("quantity", {}))
    if given["memory"]:
        c = candidate(f"{name}_lagged_by_5_s", given["at"], given["how"])
    judge = SimpleNamespace(n=100, samples=np.full(4, 25), stage=SimpleNamespace(grain=1.0))
    fit = SimpleNamespace(
        held_out=np.full(4, 25.0 * error**2), cost=np.full(4, 25.0 * error**2), free=np.arange(3), effects=(c.name,),
        theta=np.zeros(3),
    )  # fmt: skip
    more = {k: given[k] for k in ("formulas", "loose")}
    return FittedCandidate(c, 1.0, judge, fit, (), **more)  # type: ignore[arg-type]


# ---- held-out errors -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [1, 2])
def test_a_curve_is_judged_on_blocks_that_it_was_not_fitted_to(seed: int) -> None:
    c = candidate()
    t = fitted(c, measured(seed))
    judge, fit = t.judge, t.fit
    scale = judge.scale
    rows = np.vstack([np.cos(1.3 * T), (c.basis.design(U) @ c.turn).T]).T / FLOOR
    prior = np.diag(np.sqrt(judge.prior))
    expected = judge.stage.expected()
    block = np.repeat(np.arange(judge.n_blocks), np.diff(np.append(judge.block_start, N)))
    y = judge.stage.measured[0] / FLOOR
    whole = np.linalg.lstsq(np.vstack([rows, prior]), np.concatenate([y, prior @ expected]), rcond=None)[0]
    assert fit.theta == pytest.approx(whole, abs=1e-4)
    for b in range(judge.n_blocks):
        use = block != b
        rest = y - rows[:, 0] * fit.theta[0]  # the model's own parameters are calibrated on the whole log
        a = np.vstack([rows[use][:, 1:], prior[1:, 1:]])
        others = np.linalg.lstsq(a, np.concatenate([rest[use], np.zeros(len(whole) - 1)]), rcond=None)[0]
        held = np.sum((rest[~use] - rows[~use][:, 1:] @ others) ** 2)
        assert fit.held_out[b] == pytest.approx(max(held, 0.5 * fit.cost[b]), rel=1e-3)
    stiff = fitted(c, measured(seed), tolerance=0.01)  # a prior pulls at its parameter whatever is left out
    some = np.arange(judge.n_blocks) < 4
    rest = stiff.fit.theta + step_without(stiff, some) * stiff.judge.scale[stiff.fit.free]
    assert abs(rest[0] - 1.0) < 0.0100001
    held_blocks = np.arange(judge.n_blocks) < 4
    step = step_without(t, held_blocks) * scale[fit.free]
    use = ~np.isin(block, np.flatnonzero(held_blocks))
    a = np.vstack([rows[use], prior])
    without = np.linalg.lstsq(a, np.concatenate([y[use], prior @ expected]), rcond=None)[0]
    assert (fit.theta + step)[1:] == pytest.approx(without[1:], abs=2e-3)
    # only samples that count
    known = np.random.default_rng(seed).random(N) < 0.7
    counted = with_held_out(judge, fit, t.counted(known))
    for b in range(judge.n_blocks):
        rest = y - rows[:, 0] * fit.theta[0]
        use = block != b
        a = np.vstack([rows[use][:, 1:], prior[1:, 1:]])
        others = np.linalg.lstsq(a, np.concatenate([rest[use], np.zeros(len(whole) - 1)]), rcond=None)[0]
        at = (block == b) & known
        held = np.sum((rest[at] - rows[at][:, 1:] @ others) ** 2)
        cost = np.sum((rest[at] - rows[at][:, 1:] @ fit.theta[1:]) ** 2)
        assert counted.held_out[b] == pytest.approx(max(held, 0.5 * cost), rel=2e-3)


def test_a_model_without_a_curve_holds_out_what_it_leaves() -> None:
    t = fitted(candidate(), measured(3))
    bare = t.judge.fit((), t.judge.stage.neutral())
    assert with_held_out(t.judge, bare) is bare
    some = np.full(t.judge.n_blocks, 3.0)
    assert with_held_out(t.judge, bare, (some, bare.gradients, bare.normals)).held_out is some
    low, _ = t.judge.bounds()
    pinned = replace(t.fit, theta=np.append(t.fit.theta[:1], low[1:]), gradients=-np.abs(t.fit.gradients))
    if np.isfinite(low[1:]).all():
        assert with_held_out(t.judge, pinned) is pinned


@given(seed=st.integers(0, 99), blocks=st.integers(1, 6))
@settings_of(max_examples=examples(20), deadline=None)
def test_samples_are_told_that_lie_between_those_of_other_blocks(seed: int, blocks: int) -> None:
    q = np.round(white(seed, 60), 1)
    start = np.sort(np.random.default_rng(seed).choice(np.arange(1, 60), blocks - 1, replace=False))
    start = np.append(0, start)
    block = np.searchsorted(start, np.arange(60), side="right")
    told = told_by_others(q, start)
    for i in range(60):
        others = q[block != block[i]]
        assert told[i] == (len(others) == 0 or others.min() <= q[i] <= others.max())


@given(by=st.lists(st.floats(-2.0, 5.0), min_size=3, max_size=12))
@settings_of(max_examples=examples(25), deadline=None)
def test_more_is_sure_beyond_three_deviations_of_the_blocks(by: list[float]) -> None:
    d = np.array(by)
    t = d.mean() / (d.std(ddof=1) / np.sqrt(len(d))) if d.std(ddof=1) > 0.0 else 0.0
    if abs(t - SURELY) > 1e-9:
        assert surely_more(d) == (t > SURELY)
    assert not surely_more(np.ones(4))  # blocks that are all alike tell no scatter


def test_values_at_the_samples_that_are_judged() -> None:
    x = np.arange(12.0)
    every = at_samples(x, 12)
    third = at_samples(x, 4)
    assert (
        every is not None
        and third is not None
        and third.tolist() == [0.0, 3.0, 6.0, 9.0]
        and every.tolist() == x.tolist()
    )
    assert (
        at_samples(x, 5) is not None and at_samples(x, 13) is None and at_samples(np.append(x[:-1], np.nan), 12) is None
    )


@pytest.mark.parametrize("shape", [(), ("zero",)])
def test_what_its_mean_alone_leaves(shape: tuple[str, ...]) -> None:
    c = candidate().shaped(shape)
    assert c is not None
    t = fitted(c, measured(5, lambda x: 0.4 + 0.0 * x))
    if shape:
        assert left_by_its_mean(t) == np.inf  # a curve that is nothing at 0 has none
        return
    rows = np.column_stack([np.cos(1.3 * T), np.ones(N)]) / FLOOR
    first = c.basis.design(U) @ c.turn[:, 0]
    assert first == pytest.approx(np.full(N, first[0]), rel=1e-6)
    prior = np.array([[np.sqrt(12.0), 0.0]])
    y = t.judge.stage.measured[0] / FLOOR
    left = np.linalg.lstsq(np.vstack([rows, prior]), np.append(y, np.sqrt(12.0)), rcond=None)[1][0]
    assert left_by_its_mean(t) == pytest.approx(left, rel=0.02)


def test_of_curves_that_are_a_constant_at_one_place_the_plainest_stays() -> None:
    y = measured(6, lambda x: 0.4 + 0.0 * x)
    late, own = fitted(candidate("time"), y), fitted(candidate("u"), y)
    elsewhere = fitted(candidate("time", "z"), y)
    bends = fitted(candidate("direction_of_u"), measured(7))
    kept = one_constant([late, bends, own, elsewhere])
    assert len(kept) == 3 and all(t is o for t, o in zip(kept, (own, bends, elsewhere), strict=True))
    assert one_constant([bends]) == [bends]
    late.judge.stage.grain = own.judge.stage.grain = 0.1  # near a known noise by nats
    assert one_constant([own, late]) == [own]


def test_the_same_curve_with_and_without_memory() -> None:
    lag, plain = tried("u", memory=True), tried("u")
    assert without_its_lag(plain, lag) and not without_its_lag(lag, plain) and not without_its_lag(tried("w"), lag)
    assert not without_its_lag(tried("u", at="z"), lag) and not without_its_lag(tried("u", how="output times"), lag)
    t = fitted(candidate(), measured(1))
    t.curves = ((SimpleNamespace(effect="y.curve_of_u"), None),)  # type: ignore[assignment]
    assert stands(t, candidate()) and not stands(t, candidate("w"))


# ---- what confirms ---------------------------------------------------------------------------------------------------


def remembering(courses: list[Array], left: Array, was: Array) -> tuple[Any, Any]:
    """What was fitted to some logs, block by block, and the model before: sums of squares whose slopes are nothing."""
    blocks = len(left)
    n = sum(len(c) for c in courses)
    start = np.linspace(0, n, blocks + 1).astype(int)[:-1]
    judge: Any = SimpleNamespace(
        measured=np.zeros((1, n)), block_start=start, scale=np.ones(1),
        bounds=lambda: (np.full(1, -9.0), np.full(1, 9.0)), stage=SimpleNamespace(neutral=lambda: np.zeros(1)),
    )  # fmt: skip
    fit: Any = SimpleNamespace(
        cost=left, gradients=np.zeros((blocks, 1)), normals=np.ones((blocks, 1, 1)), prior=np.zeros(1),
        free=np.array([0]), theta=np.zeros(1), effects=("lag",),
    )  # fmt: skip
    quantity = Quantity("u_lagged_by_5_s", "V", COLUMN, np.concatenate(courses), tuple(courses))
    after = FittedCandidate(replace(candidate(), quantity=quantity), 1.0, judge, fit, ())
    judge.keep = None
    return after, SimpleNamespace(fit=SimpleNamespace(cost=was), names=(), judge=judge, curves=())


def wave(size: float, cycles: int = 6) -> Array:
    return size * np.sin(2.0 * np.pi * np.linspace(0.0, cycles, 60 * cycles + 1)[:-1])


@pytest.mark.parametrize("side", [0.98, 1.02])
@pytest.mark.parametrize("case", ["another log", "another amplitude"])
def test_memory_is_confirmed_by_another_log_or_another_amplitude(case: str, side: float) -> None:
    logs = [wave(1.0), wave(1.0)] if case == "another log" else [np.concatenate([wave(1.0), wave(2.0)])]
    limit = (1.0 - LEAST_USE) ** 2 if case == "another log" else 1.0 - LEAST_FALL
    was = np.full(12, 100.0)
    left = 100.0 * np.where(np.arange(12) < 6, side * limit, 0.1)  # the first half is the narrow one
    after, before = remembering(logs, left, was)
    learner: Any = SimpleNamespace(
        decisions=Decisions(), change=lambda *_: {}, ground=SimpleNamespace(tests=frozenset())
    )
    assert curve_choice.another_confirms(learner, before, after) == (side < 1.0)
    far, log = curve_choice.moves(after)
    assert far == pytest.approx(np.full(12, 2.0) if case == "another log" else [*[2.0] * 5, 3.0, *[4.0] * 6], rel=0.02)
    assert log.tolist() == ([0] * 6 + [1] * 6 if case == "another log" else [0] * 12)
    found = curve_choice._confirmation(learner, before, after)
    assert found.limit == pytest.approx(limit) and found.left == pytest.approx(side * limit, rel=1e-6)
    learner.change = lambda *_: {"t": -0.5, "f": 0.0, "v": 0.3}  # validation logs say it themselves
    learner.ground.tests = frozenset("tv")
    assert curve_choice._confirmation(learner, before, after).left == pytest.approx(np.exp(-1.0))
    assert curve_choice._confirmation(learner, before, after).limit == pytest.approx(np.exp(-2.0 * LEAST_USE))
    before.fit.cost[:] = 0.0
    learner.change = lambda *_: {}
    assert curve_choice._confirmation(learner, before, after).left == np.inf  # where nothing was wrong


def test_one_amplitude_confirms_no_memory_and_what_remembers_nothing_needs_no_other() -> None:
    learner: Any = SimpleNamespace(
        decisions=Decisions(), change=lambda *_: {}, ground=SimpleNamespace(tests=frozenset())
    )
    for narrow, confirmed in ((1.45, False), (1.55, True)):
        after, before = remembering([np.concatenate([wave(1.0), wave(narrow)])], np.full(12, 1.0), np.full(12, 100.0))
        assert (
            np.isfinite(curve_choice._confirmation(learner, before, after).left)
            == confirmed
            == (narrow > OTHER_AMPLITUDE)
        )
    after, before = remembering([wave(1.0)], np.full(6, 1.0), np.full(6, 100.0))
    assert not curve_choice.another_confirms(learner, before, after)
    assert curve_choice._confirmation(learner, before, after).limit == pytest.approx(1.0 - LEAST_FALL)
    assert curve_choice.another_confirms(learner, before, tried("u"))


@pytest.mark.parametrize(("change", "confirmed"), [(-0.03, True), (-0.01, False), (0.09, False)])
def test_what_is_of_time_must_hold_on_a_validation_log_where_there_is_one(change: float, confirmed: bool) -> None:
    learner: Any = SimpleNamespace(
        decisions=Decisions(), change=lambda *_: {"v": change, "f": -1.0}, ground=SimpleNamespace(tests=frozenset("v"))
    )
    before: Any = SimpleNamespace(names=())
    assert curve_choice.another_confirms(learner, before, tried("time")) == confirmed
    assert curve_choice.another_confirms(learner, before, tried("u"))  # a measured value may stay where it was
    learner.ground.tests = frozenset()
    assert curve_choice.another_confirms(learner, before, tried("time"))


def test_curves_stand_instead_of_laws_with_names_by_themselves_or_by_a_formula(monkeypatch: pytest.MonkeyPatch) -> None:
    learner: Any = SimpleNamespace(speaks=True, ground=SimpleNamespace(tests=frozenset("t")), change=lambda *_: {})
    monkeypatch.setattr(curve_choice, "better_than", lambda learner, named, t: t.candidate.name != "y.curve_of_poor")
    formula = ("f", tried("f", 1.1))
    monkeypatch.setattr(curve_choice, "fitted_formulas", lambda ground, t: [formula])
    named, good, bad = tried("named", 5.0), tried("u", 1.2), tried("u", 4.9)
    assert curve_choice.instead_of(learner, named, [good])
    assert not curve_choice.instead_of(learner, named, [tried("poor", 1.2)])
    assert bad.formulas is None and curve_choice.instead_of(learner, named, [bad]) and bad.formulas == [formula]
    learner.speaks = False
    assert not curve_choice.instead_of(learner, named, [tried("u", 4.9)])
    learner.speaks = True
    slips = tried("stops_of_u", 4.9)
    assert not curve_choice.instead_of(learner, named, [slips])  # of what slips there is no formula
    assert curve_choice.instead_of(learner, named, [tried("u", 4.9, formulas=[formula]), slips])  # of the first one
    assert not curve_choice.instead_of(learner, named, [tried("u", 4.9, formulas=[]), slips])
    learner.change = lambda before, t: {"t": 0.2 if t.candidate.name == "y.curve_of_f" else -0.5, "f": 9.0}
    assert curve_choice.instead_of(learner, named, [tried("u", 4.9)])  # a test log confirms the curve itself
    learner.change = lambda *_: {"t": 0.2}
    assert not curve_choice.instead_of(learner, named, [good])  # and here speaks against all


# ---- formulas --------------------------------------------------------------------------------------------------------


def said(form: str, error: float, complexity: float = 1.0, **numbers: float) -> Formula:
    return Formula(form, form, numbers or {"a": 1.0}, error, complexity)  # type: ignore[arg-type]


def test_formulas_are_likely_that_are_near_the_best_and_not_the_same_as_simpler_ones() -> None:
    t = fitted(candidate(), measured(1))
    own = rms_of(t.judge, t.fit)
    line, square = said("line", 1.0, 1.0, a=2.0), said("square", 1.04, 0.5, a=2.0)
    pairs: Any = [(line, t), (square, t)]
    assert [f.form for f in likely(t, pairs, 9.0)] == ["square", "line"]  # simplest first
    base = min(own, 1.0)
    for factor, near in ((0.99, True), (1.01, False)):
        far = said("square", base * (1.0 + FORMS_NEAR) * factor, 0.5, a=2.0)
        assert [f.form for f in likely(t, [(said("line", base, 1.0, a=2.0), t), (far, t)], 9.0)] == (  # type: ignore[list-item]
            ["square", "line"] if near else ["line"]
        )
    for before in (3.0, 300.0):  # no law's form is known better than a share of the error before
        limit = np.hypot(FORM_POOR * max(own, 1.0), FORM * before)
        for factor, near in ((0.999, True), (1.001, False)):
            assert bool(likely(t, [(said("line", limit * factor, a=2.0), t)], before)) == near  # type: ignore[list-item]
    nearly = said("cubic", 1.0, 2.0)
    same = [f for f in FORMS if f.name == "line"][0]
    assert same.numbers
    twice = [(said("line", 1.0, 1.0, a=2.0), t), (said("line", 1.0, 3.0, a=2.0 * (1.0 + 0.5 * FORM_SAME)), t)]
    assert len(likely(t, twice, 9.0)) == 1  # type: ignore[arg-type]
    other = [(said("line", 1.0, 1.0, a=2.0), t), (said("line", 1.0, 3.0, a=2.0 * (1.0 + 1.5 * FORM_SAME)), t)]
    assert len(likely(t, other, 9.0)) == 2 and nearly.form == "cubic"  # type: ignore[arg-type]
    assert likely(t, [], 9.0) == []


def test_a_formula_has_the_shape_that_its_curve_has() -> None:
    by = {f.name: f for f in FORMS}
    for name, numbers, fits in (
        ("line", [2.0], {"zero", "odd", "rising"}), ("line", [-2.0], {"zero", "odd", "falling"}),
        ("constant", [1.0], {"rising", "falling"}), ("square", [1.0], {"zero"}),
        ("cube", [1.0], {"zero", "odd", "rising"}),
    ):  # fmt: skip
        for shape in ("zero", "odd", "rising", "falling"):
            assert _is_shaped(by[name], np.array(numbers), replace(candidate(), shape=(shape,))) == (shape in fits), (
                name,
                shape,
            )


@pytest.mark.parametrize(
    ("how", "at", "of", "unit", "form", "law"),
    [
        ("output adds", "y", "y", "V", "line", "y.gain"),
        ("output adds", "y_sensor", "y", "V", "constant", "y_sensor.bias"),
        ("output adds", "y", "u", "V", "line", ""), ("output times", "y", "y", "-", "line", ""),
        ("output adds", "y", "y", "V", "magnitude", "y.asymmetric_gain"), ("output adds", "y", "y", "V", "root", ""),
        ("state adds", "w", "w", "(V)/s", "root", "w.square_root"), ("state adds", "w", "w", "N", "line", "w.viscous"),
        ("state adds", "w", "w", "N", "sign", "w.coulomb"), ("state adds", "w", "v", "(V)/s", "line", ""),
        ("force adds", "force", "velocity", "N", "line", "force.viscous"),
        ("force adds", "force", "u", "N", "line", ""),
        ("force adds", "force", "position", "N", "cube", "force.cubic_spring"),
        ("force adds", "force", "position", "N", "sign", ""), ("input adds", "u", "u", "V", "cube", "u.cubic"),
    ],
)  # fmt: skip
def test_a_form_at_a_place_is_a_law_of_the_library(how: str, at: str, of: str, unit: str, form: str, law: str) -> None:
    found = next(f for f in FORMS if f.name == form)
    assert library_name(candidate(of, at, how, unit=unit), found) == law


def test_a_formula_s_numbers_are_as_large_as_they_begin() -> None:
    e = effect_of("law", ("a", "b", "c"), np.array([2.0, -0.5, 0.0]))
    assert e.starts == ((2.0, -0.5, 0.0),) and [p.name for p in e.parameters] == ["a", "b", "c"]
    assert [p.scale for p in e.parameters] == [2.0, 0.5, 2e-9] and e.name == "law"


def ordering(errors: dict[str, float] | None = None, **more: Any) -> Any:
    """A learner that knows each stand-in by its error alone."""
    given: dict[str, Any] = {
        "score": lambda t, among=(): float(np.log(rms_of(t.judge, t.fit))),
        "accepts": lambda before, t: rms_of(t.judge, t.fit) < 0.5 * rms_of(before.judge, before.fit),
        "fails": lambda t: rms_of(t.judge, t.fit) > 1.1, "objection": lambda before, t: "",
        "ground": SimpleNamespace(shares=False, noise_known=False, tests=frozenset(), measured=frozenset()),
        "judged": lambda t, among: (t.judge, t.fit), "each": map, "speaks": True,
        "change": lambda before, t: {},
    }  # fmt: skip
    return SimpleNamespace(**given | more)


def test_a_curve_earns_its_place_by_a_formula(monkeypatch: pytest.MonkeyPatch) -> None:
    before, best = tried("none", 10.0), tried("best", 6.0)
    good = tried("f", 1.0)
    asked: list[str] = []

    def formulas(ground: Any, some: Any) -> list[list[Any]]:
        asked.extend(t.candidate.quantity.name for t in some)
        return [[good] if t.candidate.quantity.name == "corner" else [] for t in some]

    monkeypatch.setattr(curve_choice, "all_in_their_place", formulas)
    corner, far = (
        tried("corner", 6.0 * np.exp(0.9 * FORMULA_MAY_EARN)),
        tried("far", 6.0 * np.exp(1.1 * FORMULA_MAY_EARN)),
    )
    lag, smooth = tried("u", 6.0, memory=True), tried("smooth", 6.0)
    poor = [corner, far, lag, smooth]
    assert curve_choice.earning_by_formula(ordering(), before, poor, [best, *poor]) == [corner]
    assert asked == ["corner", "smooth"]
    home = tried("y", 4.9)  # at its place, and explains three quarters
    monkeypatch.setattr(curve_choice, "all_in_their_place", lambda ground, some: [[good] for _ in some])
    assert curve_choice.earning_by_formula(ordering(), before, [home], [tried("best", 1.0)]) == [home]


@pytest.mark.parametrize(("error", "there"), [(4.9, True), (5.2, False)])
def test_what_is_at_its_place_stays_where_it_explains_most_of_the_error(error: float, there: bool) -> None:
    before, own = tried("none", 10.0), tried("y", error)  # a quarter of 99, and 1: 5.07 squared
    assert bool(curve_choice.at_its_place(before, [own, tried("u", 1.0)])) == there
    assert pytest.approx(5.0744**2, rel=1e-4) == MOST_LEFT * 99.0 + 1.0


def test_what_harms_a_test_log_goes_where_one_near_the_best_does_not() -> None:
    harms = {"y.curve_of_bad", "y.curve_of_worse"}
    learner = ordering(objection=lambda before, t: "worse" if t.candidate.name in harms else "")
    bad, fine = tried("bad", loose=[]), tried("fine")
    before = tried("none", 9.0)
    for apart, kept in ((0.9 * NOT_INSTEAD, [fine]), (1.1 * NOT_INSTEAD, [bad, fine])):
        left = {"y.curve_of_bad": 0.0, "y.curve_of_fine": apart}
        assert curve_choice.harmless(learner, before, [bad, fine], left) == kept
    by_formula = tried("worse", loose=[tried("fine")])
    left = {"y.curve_of_bad": 0.0, "y.curve_of_worse": 0.1}
    assert curve_choice.harmless(learner, before, [bad, by_formula], left) == [by_formula]


def test_memory_goes_where_a_curve_without_leaves_nothing_but_noise() -> None:
    lag, clean, poor = tried("u", 1.0, memory=True), tried("u", 1.05), tried("u", 1.3)
    before = tried("none", 9.0)
    without = curve_choice.without_memory
    assert without(ordering(), before, [lag, clean]) == [clean] and without(ordering(), before, [lag, poor]) == [
        lag,
        poor,
    ]
    assert without(ordering(objection=lambda *_: "worse"), before, [lag, clean]) == [lag, clean]


def test_the_plainest_that_a_formula_says_comes_first_at_a_known_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    first, second, late = tried("y", 1.02), tried("u", 1.0), tried("time", 1.0)
    formula = tried("f", 1.0)
    monkeypatch.setattr(
        curve_choice, "with_and_without_mean", lambda ground, t: [formula] if t is second else [tried("g", 2.0)]
    )
    monkeypatch.setattr(curve_choice, "correlation_of", lambda judge, fit: 1.0)
    left = {"y.curve_of_y": 0.02, "y.curve_of_u": 0.0, "y.curve_of_time": 0.0}
    learner = ordering()
    near = [first, second, late]
    assert curve_choice.said_first(learner, near, left) is near
    learner.ground.noise_known = True
    assert curve_choice.said_first(learner, near, left) == [second, first, late]
    assert curve_choice.said_first(learner, [late, first, second], left) == [late, first, second]
    assert curve_choice.said_first(learner, [first], left) == [first]
    learner.fails = lambda t: True
    assert curve_choice.said_first(learner, near, left) == near
    learner.fails = lambda t: False
    judge: Any = first.judge
    limit = np.sqrt((100.0 + 2.0 * rival_nats(judge, 100.0, 1.0)) / 100.0)
    for side in (0.999, 1.001):
        formula.fit.held_out = np.full(4, 25.0 * (side * limit) ** 2)
        assert (curve_choice.said_first(learner, near, left)[0] is second) == (side < 1.0)


def test_what_a_curve_or_its_formulas_leave() -> None:
    t = tried("u", 3.0, formulas=[("f", tried("f", 2.0)), ("g", tried("g", 4.0))])
    assert curve_choice.leaves(t) == pytest.approx(2.0) and curve_choice.leaves(tried("u", 3.0)) == 3.0
    before = tried("none", 4.5)
    assert curve_choice.better_than(ordering(), before, t)
    assert not curve_choice.better_than(ordering(), before, tried("u", 3.0))


def test_formulas_in_a_curve_s_place_are_made_once(monkeypatch: pytest.MonkeyPatch) -> None:
    strict, loose = tried("s"), tried("l")
    asked: list[bool] = []

    def made(ground: Any, t: Any, loose: bool = False) -> list[Any]:
        asked.append(loose)
        return [("f", both[1])] if loose and both[1] else [("f", strict)] if not loose else []

    both: list[Any] = [strict, loose]
    monkeypatch.setattr(curve_choice, "fitted_formulas", made)
    ground: Any = SimpleNamespace(shares=False)
    t = tried("u")
    assert curve_choice.in_its_place(ground, t) == [loose] == t.loose and asked == [True]
    assert curve_choice.in_its_place(ground, t) == [loose] and asked == [True]
    assert curve_choice.with_and_without_mean(ground, t) == [strict, loose]
    both[1] = None
    assert curve_choice.all_in_their_place(ground, [tried("u")]) == [[strict]]
    assert curve_choice.with_and_without_mean(ground, tried("u")) == [strict]


@pytest.mark.parametrize(("level", "enough"), [(0.0, True), (0.5, True), (-0.89, True), (-0.91, False), (-2.0, False)])
def test_a_mean_goes_back_into_the_parameter_that_had_it(level: float, enough: bool) -> None:
    numbers, own = np.array([3.0, 7.0]), np.array([1.0, 2.0])
    assert curve_choice.takes_mean_back(level, numbers, own, 1) == enough
    assert abs(LEAST_PARAMETER_LEFT - 0.1) < 1e-12
    if enough:
        assert own[1] == pytest.approx(2.0 * (1.0 + level)) and own[0] == 1.0 and numbers[1] == 7.0
        assert own[1] * (1.0 + numbers[0] * 0.3) == pytest.approx(2.0 * (1.0 + level + 3.0 * 0.3))


def test_a_formula_is_held_against_its_curve_on_held_out_data_and_each_test_log() -> None:
    learner = ordering(change=lambda before, t: {"f": 9.0, "v": -0.2, "w": 0.3})
    learner.ground.tests = frozenset("vw")
    curve, formula = tried("u", 1.0), tried("f", 1.1)
    curve.fit.free, formula.fit.free = np.arange(12), np.arange(4)  # type: ignore[misc]
    held, tests = curve_choice.more_left(learner, curve, formula, [curve])
    assert held == pytest.approx(np.log(1.1) + 8.0 * PER_PARAMETER) and tests == [-0.2, 0.3]


@pytest.mark.parametrize(
    ("held", "tests", "spoken"),
    [(0.04, [], True), (0.06, [], False), (0.04, [0.06], False), (0.2, [-0.3, -0.3], True), (0.2, [-0.2, -0.2], False),
     (0.01, [0.03], True), (0.04, [0.04], False)],
)  # fmt: skip
def test_a_formula_is_the_law_where_it_does_as_well(
    held: float, tests: list[float], spoken: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    f = said("line", 1.0, 1.0, a=2.0)
    now = tried("f", 1.03)
    curve = tried("u", 1.0, formulas=[(f, tried("alone"))])
    monkeypatch.setattr(curve_choice, "_in_place", lambda ground, now_, k, c, f_, alone: (now, replace(f_, text="2 u")))
    monkeypatch.setattr(curve_choice, "more_left", lambda learner, before, t, among: (held, tests))
    monkeypatch.setattr(curve_choice, "goes_on", lambda *_: (-3.0, 3.0))
    law = SimpleNamespace(formulas=[f], spoken=None)
    monkeypatch.setattr(curve_choice, "replace", lambda of, **more: SimpleNamespace(**vars(of) | more))
    at, laws = curve_choice.spoken(ordering(), [curve], [law])  # type: ignore[list-item]
    assert (at is now) == spoken and (laws[0].spoken is not None) == spoken
    if spoken:
        assert laws[0].spoken.text == "2 u" and laws[0].reach == (-3.0, 3.0) and laws[0].formulas[0].text == "2 u"  # type: ignore[union-attr]
        assert laws[0].error_after == pytest.approx(1.03)
    slips = tried("stops_of_u", formulas=[(f, tried("alone"))])
    assert curve_choice.spoken(ordering(), [slips], [law])[0] is slips  # type: ignore[list-item]


# ---- near a noise that is known --------------------------------------------------------------------------------------


def test_a_grain_is_the_nats_by_which_one_law_beats_another() -> None:
    t = fitted(candidate(), measured(8))
    judge = t.judge
    fit = replace(t.fit, held_out=t.fit.cost)
    grain = grain_of(judge, fit)
    e = judge.errors(fit.theta[None])[0, 0]
    e = e - e.mean()
    rho = np.array([e[k:] @ e[: N - k] / (e @ e) for k in range(1, 30)])
    first = int(np.argmax(rho <= 0.05))
    correlation = 1.0 + 2.0 * np.sum(rho[:first] ** 2)
    nats = max(3.0, 0.25 * 0.5 * (fit.cost.sum() - N * 1.01**2) / correlation)
    assert grain == pytest.approx(nats * correlation / N / RIVAL, rel=1e-6) and grain < 1.0
    gross = replace(fit, held_out=1e6 * fit.cost)
    assert grain_of(judge, gross) == 1.0
    told: list[float] = []
    in_grains(SimpleNamespace(in_grains=told.append), 0.3, [judge])  # type: ignore[arg-type]
    assert told == [0.3] and judge.stage.grain == 0.3
    assert not above_the_noise(judge, fit) and above_the_noise(judge, replace(fit, held_out=1.5 * fit.cost))


# ---- the problem -----------------------------------------------------------------------------------------------------


def learner_of(t: FittedCandidate, **more: Any) -> CurveProblem:
    """A search for curves on the stage of what was fitted."""
    learner = object.__new__(CurveSearch)
    learner.judge, learner.base = t.judge, t.judge.fit((), t.judge.stage.neutral())
    learner.form = RelativeErrorAcceptance(t.judge)
    learner.form.begin(learner.base)
    learner.faint, learner.speaks, learner.shape = False, True, ()
    learner.decisions, learner.ranked, learner.candidates = Decisions(), [], []
    given = {"floor": np.array([FLOOR]), "tests": frozenset(), "shares": False, "noise_known": False,
             "measured": frozenset(), "in_grains": lambda of: None, "within": lambda c: {},
             "elsewhere": lambda curves, theta: {}, "errors": lambda curves, theta, laws=(): {}}  # fmt: skip
    learner.ground = SimpleNamespace(**given | more)  # type: ignore[assignment]
    return learner


def test_curves_are_compared_where_all_of_them_are_told_by_more_than_one_block() -> None:
    x = U.copy()
    x[100:104] = 9.0  # once it has been far out
    t, other = fitted(candidate(x=x), measured(9)), fitted(candidate("w"), measured(9))
    learner = learner_of(t)
    known = learner._known([t, other])
    assert np.array_equal(known, told_by_others(x, t.judge.block_start) & told_by_others(U, t.judge.block_start))
    assert not known[100:104].any() and 0.7 < known.mean() < 1.0
    judge, fit = learner.judged(t, [t])
    assert judge.n == known_of(learner, t).sum() and fit.held_out.sum() < t.fit.held_out.sum()
    assert learner.score(t) == pytest.approx(score(judge, fit))
    other.judge.keep = np.arange(N) >= 50
    assert not learner._known([other])[:50].any()
    other.judge.keep = np.zeros(N, dtype=bool)
    assert learner._known([other]).all()  # where nothing is told all counts
    calm = replace(other, judge=t.judge)
    flat = replace(calm, candidate=replace(other.candidate, quantity=Quantity("w", "V", INPUT, np.zeros(N))))
    assert learner.judged(flat, [flat]) == (learner.judge, flat.fit)


def known_of(learner: CurveProblem, t: FittedCandidate) -> Array:
    return learner._known([t])


def test_a_curve_is_accepted_by_the_rules_and_a_useless_one_is_not() -> None:
    t = fitted(candidate(), measured(10))
    learner = learner_of(t)
    nothing = FittedCandidate(t.candidate, 0.0, t.judge, learner.base, ())
    assert learner.accepts(nothing, t)
    useless = fitted(candidate(), measured(10, lambda x: 0.0 * x))
    none = FittedCandidate(useless.candidate, 0.0, useless.judge, learner_of(useless).base, ())
    assert not learner_of(useless).accepts(none, useless)
    assert learner.fails(nothing) and not learner.fails(t)
    assert learner.ordered([nothing, t])[0] is t
    learner.faint = True
    assert learner.accepts(nothing, t)
    assert {v.rule for d in learner.decisions for v in d.verdicts} >= {"log-likelihood gain", "share of the excess"}


def test_what_a_curve_does_to_other_logs_is_the_log_of_their_error() -> None:
    t = fitted(candidate(), measured(11))
    errors = {"f": 3.0 * np.ones((1, 50)), "v": 2.0 * np.ones((1, 50)), "w": 0.5 * np.ones((1, 50))}
    now = {"f": 1.5 * np.ones((1, 50)), "v": np.where(np.arange(50) < 25, 4.0, 1.0)[None], "w": 4.0 * np.ones((1, 50))}
    learner = learner_of(t, tests=frozenset("v"), errors=lambda curves, theta, laws=(): now)
    before = replace(t, errors=errors)
    assert t.errors is None
    change = learner.change(before, t)
    assert change == pytest.approx({
        "f": np.log(0.5), "v": np.log(np.sqrt(8.5) / 2.0), "w": np.log(4.0),  # below the noise counts as the noise
    })  # fmt: skip
    assert t.errors is now
    part = {"v": np.arange(50) >= 25}
    assert learner.change(before, t, part)["v"] == pytest.approx(np.log(0.5))
    learner.ground.within = lambda c: {"v": np.arange(50) >= 25} if c is t.candidate else {"v": np.arange(50) < 50}  # type: ignore[method-assign]
    other = fitted(candidate("w"), measured(11))
    assert learner.tested(before, t, [t, other]) == pytest.approx(np.log(0.5))
    assert learner.left(before, t, [t]) == pytest.approx(learner.score(t, [t]) + np.log(0.5))
    learner.ground.tests = frozenset()
    assert learner.tested(before, t, [t]) == 0.0
    learner.ground.tests = frozenset("v")
    assert learner.objection(before, t) == "makes v worse: 1.46 times the error"
    t.errors = {"f": errors["f"], "v": errors["v"]}
    assert learner.objection(before, t) == "no log is better by 2% for it"
    t.errors = {"v": 0.5 * errors["v"]}
    assert learner.objection(before, t) == ""
    learner.ground.elsewhere = lambda curves, theta: {"linkage": 0.2}  # type: ignore[method-assign]
    assert learner.objection(before, t) == "makes linkage worse: 1.22 times the error"
    learner.faint = True
    learner.ground.elsewhere = lambda curves, theta: {}  # type: ignore[method-assign]
    assert learner.objection(before, t) == ""
    noise = replace(t, errors={"v": 1.98 * np.ones((1, 50))})
    assert learner.objection(before, noise) == "v: log-likelihood gain of 2.0 only"
    learner.judge.stage.grain = 0.1
    assert learner.change(before, t)["v"] == pytest.approx(np.log(0.5) / 0.1)


def test_errors_are_told_in_nats_meanwhile_where_only_a_known_noise_is_left() -> None:
    t = fitted(candidate(), measured(12))
    told: list[float] = []
    learner = learner_of(t, noise_known=True, in_grains=told.append)
    with learner.told_in_nats(t):
        assert learner.judge.stage.grain == told[-1] == grain_of(t.judge, t.fit) < 1.0
    assert learner.judge.stage.grain == told[-1] == 1.0
    learner.ground.noise_known = False
    with learner.told_in_nats(t):
        assert learner.judge.stage.grain == 1.0


# ---- screening and smoothing -----------------------------------------------------------------------------------------


def promise(left: float, name: str, at: str = "y", how: str = "output adds") -> Any:
    return left, candidate(name, at, how), np.zeros(3)


def test_of_each_place_and_of_each_lag_the_best_goes_on() -> None:
    a, b, c, d = promise(1.0, "u"), promise(2.0, "w"), promise(3.0, "u", "z"), promise(4.0, "u", how="output times")
    assert screening._best_elsewhere([a], [b, c, d]) == [c, d] and screening._best_elsewhere([a, c], [d]) == [d]
    lag, longer, plain = promise(1.0, "u_lagged_by_5_s"), promise(2.0, "u_lagged_by_9_s"), promise(3.0, "u")
    elsewhere = promise(4.0, "u_lagged_by_9_s", "z")
    assert screening._one_lag([lag, longer, plain, elsewhere]) == [lag, plain, elsewhere]


def test_a_candidate_goes_on_to_the_lag_that_promises_most(monkeypatch: pytest.MonkeyPatch) -> None:
    def lagged(tau: float) -> Candidate:
        slower = lambda times: lagged(tau * times).quantity if 0.5 < tau * times < 50.0 else None  # noqa: E731
        name = f"u_lagged_by_{round(1e3 * tau)}_ms"
        return candidate(name, quantity={"slower": slower, "course": (U,)})

    def off(c: Candidate) -> float:
        tau = float(c.quantity.name.split("_by_")[1].split("_")[0]) / 1e3
        return abs(np.log(tau / 7.0))

    monkeypatch.setattr(screening, "_promise", lambda learner, current, c, starts: ((off(c), c, np.zeros(1)), 0.0))
    current: Any = SimpleNamespace(curves=())
    for begin in (2.0, 20.0):
        c = lagged(begin)
        _, found, _ = screening._its_lag(SimpleNamespace(), current, (off(c), c, np.zeros(1)), [], 1.8)  # type: ignore[arg-type]
        assert off(found) <= 0.5 * np.log(1.8) + 1e-3
    plain: Any = (1.0, candidate(), np.zeros(1))
    assert screening._its_lag(SimpleNamespace(), current, plain, [], 1.8) is plain  # type: ignore[arg-type]


def test_a_crooked_candidate_is_fitted_for_some_steps() -> None:
    asked: list[str] = []

    def fit(current: Any, c: Candidate, wiggle: float, begin: Array, steps: int, quick: bool) -> Any:
        asked.append(c.quantity.name)
        cost = np.array([10.0 if c.quantity.name == "crooked" else 12.0])
        return SimpleNamespace(fit=SimpleNamespace(cost=cost, theta=begin + 1.0))

    learner: Any = SimpleNamespace(each=map, fitted=fit)
    current: Any = SimpleNamespace(fit=SimpleNamespace(theta=np.full(1, 5.0)))
    straight, crooked, worse, little = (
        promise(40.0, "straight"), promise(90.0, "crooked"), promise(120.0, "worse"), promise(70.0, "little"),
    )  # fmt: skip
    steps = [(straight, 39.0), (crooked, 20.0), (worse, 15.0), (little, 65.0)]
    out = screening._straightened(learner, current, 100.0, steps, 2)
    assert asked == ["worse", "crooked"]  # its slopes say much of which the step keeps less than half
    assert [(p[0], p[1].quantity.name) for p in out] == [
        (10.0, "crooked"), (12.0, "worse"), (40.0, "straight"), (70.0, "little"),
    ]  # fmt: skip
    assert out[0][2].tolist() == [1.0] * 3 and out[1][2].tolist() == [6.0, 1.0, 1.0]  # what makes it worse begins anew


def test_a_curve_bends_as_much_as_its_held_out_error_says() -> None:
    for best in (0.1, 1.0, 5.0):
        asked: list[tuple[float, Any]] = []

        def fit(current: Any, c: Any, wiggle: float, begin: Any, steps: int, asked: Any = asked) -> Any:
            asked.append((wiggle, begin))
            return SimpleNamespace(wiggle=wiggle, fit=wiggle)

        learner: Any = SimpleNamespace(fitted=fit, score=lambda t, best=best: abs(np.log(t.wiggle / best)))
        found = screening.smoothed(learner, None, None, "begin", BENDS_TRIED)  # type: ignore[arg-type]
        assert found.wiggle == best and asked[0] == (SCREENED_BEND, "begin")
        tried_bends = {0.1: [1.0, 0.1], 1.0: [1.0, 0.1, 5.0], 5.0: [1.0, 0.1, 5.0]}[best]
        assert [a[0] for a in asked] == tried_bends and asked[1][1] == SCREENED_BEND


# ---- which curve is chosen -------------------------------------------------------------------------------------------


def chooser(**more: Any) -> CurveSearch:
    """A search whose fits are stand-ins."""
    learner = object.__new__(CurveSearch)
    for name, value in vars(ordering(**more)).items():
        setattr(learner, name, value)
    learner.out, learner.unknown, learner.faint, learner.ranked = Outcome("none"), False, False, []
    learner.decisions, learner.judge = Decisions(), tried().judge
    learner.tested = lambda before, t, among: 0.0  # type: ignore[method-assign]
    return learner


def test_of_those_that_do_as_well_the_plainest_is_first() -> None:
    learner = chooser()
    best, own, late, poor = tried("w", 1.0), tried("y", 1.02), tried("time", 1.0), tried("u", 1.2)
    good = [late, poor, own, best]
    left = {t.candidate.name: float(np.log(rms_of(t.judge, t.fit))) for t in good}
    near = learner._near(tried("none", 9.0), good, left)
    assert near == [own, best, late] and good[0] in (best, late) and good[-1] is poor
    left["y.curve_of_y"] = 1.1 * RIVAL
    assert learner._near(tried("none", 9.0), good, left) == [best, late]
    adds, times = tried("u", 1.2), tried("u", 1.0, how="output times")
    left = {"y.curve_of_u": 0.2, "y.gain_of_u": 0.0}
    assert learner._near(tried("none", 9.0), [adds, times], left) == [adds, times]  # it adds what the other multiplies
    learner.accepts = lambda before, t: True  # type: ignore[method-assign]
    assert learner._near(tried("none", 9.0), [adds, times], left) == [times]  # which earns its place before it
    learner.accepts = lambda before, t: False  # type: ignore[method-assign]
    learner.tested = lambda before, t, among: HARM * 1.1 if t is adds else 0.0  # type: ignore[method-assign]
    assert learner._near(tried("none", 9.0), [adds, times], left) == [times]


def test_at_the_noise_what_is_surely_worse_goes_behind() -> None:
    learner = chooser()
    best, worse, late = tried("y", 1.0), tried("u", 1.04), tried("time", 1.04)
    steady = 25.0 * np.array([1.09, 1.07, 1.08, 1.08])
    worse.fit.held_out = late.fit.held_out = steady  # type: ignore[misc]
    left = {t.candidate.name: 0.01 * k for k, t in enumerate((best, worse, late))}
    learner._tell_apart([best, worse, late], left)
    assert left == pytest.approx({"y.curve_of_y": 0.0, "y.curve_of_u": 2.0 * RIVAL, "y.curve_of_time": 0.02})
    worse.fit.held_out = 25.0 * np.array([0.5, 1.6, 1.0, 1.2])  # type: ignore[misc]
    left = {t.candidate.name: 0.0 for t in (best, worse)}
    learner._tell_apart([best, worse], left)
    assert left["y.curve_of_u"] == 0.0
    learner.fails = lambda t: True  # type: ignore[method-assign]
    worse.fit.held_out = steady  # type: ignore[misc]
    learner._tell_apart([best, worse], left)
    assert left["y.curve_of_u"] == 0.0
    learner.ground.measured = frozenset("u")
    assert learner._echoes(worse.candidate) and not learner._echoes(best.candidate)


@pytest.mark.parametrize(
    ("curves", "fails", "unknown", "ended", "more"),
    [(0, True, False, False, True), (0, False, False, False, False), (0, False, True, False, True),
     (1, False, True, False, False), (1, True, False, False, True), (2, True, True, False, False),
     (0, True, True, True, False)],
)  # fmt: skip
def test_another_curve_is_looked_for_where_more_than_noise_is_left(
    curves: int, fails: bool, unknown: bool, ended: bool, more: bool
) -> None:
    learner = chooser(fails=lambda t: fails)
    learner.unknown, learner.ended = unknown, ended
    current = tried()
    current.curves = (None,) * curves
    assert learner.wants_more(current) == more and MOST_CURVES == 2


@pytest.mark.parametrize(
    ("left", "named", "instead", "verdict"),
    [(None, False, False, "unknown"), (None, True, False, "named"), (1.2, False, False, "learned"),
     (4.9, False, False, "learned"), (5.2, False, False, "unknown"), (1.2, True, True, "learned"),
     (1.2, True, False, "named")],
)  # fmt: skip
def test_what_is_learned_is_what_explains_most_and_no_law_with_a_name_says(
    left: float | None, named: bool, instead: bool, verdict: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    learner = chooser()
    learner.ground.errors = lambda curves, theta, laws=(): {}
    base = tried("none", 10.0)
    learner.judge, learner.base = base.judge, base.fit
    learner.d = SimpleNamespace(effects=["a"] if named else [], final=SimpleNamespace(effects=("a", "b")))  # type: ignore[assignment]
    monkeypatch.setattr(learning, "instead_of", lambda *_: instead)
    out = Outcome("none")
    out.tried = [] if left is None else [tried("u", left)]
    got = learner._concluded(out, (base.judge, base.fit) if named else None)
    assert got.verdict == verdict
    says = {
        "named": "a + b of the library does as well, or nearly", "learned": "",
        "unknown": "the best curve leaves 51% of the error",
    }[verdict]  # fmt: skip
    assert got.why == (
        says
        if left
        else "no function of one or two quantities, at any place, explains enough of the error on data left out"
    )


def test_a_curve_is_chosen_that_harms_nothing_and_is_confirmed(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("harmless", "said_first"):
        monkeypatch.setattr(learning, name, lambda *given: given[2] if len(given) == 4 else given[1])
    monkeypatch.setattr(learning, "without_memory", lambda learner, before, good: good)
    confirmed = {"y.curve_of_y", "y.curve_of_u", "y.curve_of_w"}
    monkeypatch.setattr(learning, "another_confirms", lambda learner, before, t: t.candidate.name in confirmed)
    harms = {"y.curve_of_y": "makes v worse: 1.4 times the error"}
    learner = chooser()
    learner.left = lambda before, t, good: float(np.log(rms_of(t.judge, t.fit)))  # type: ignore[method-assign]
    learner._with_formulas = lambda *_: None  # type: ignore[method-assign]
    learner._tell_apart = lambda *_: None  # type: ignore[method-assign]
    learner._as_learned = lambda current, t: (t, harms.get(t.candidate.name, ""))  # type: ignore[method-assign]
    own, next_one, far = tried("y", 1.0), tried("u", 1.02), tried("w", 1.3)
    chosen = learner.chosen(tried("none", 9.0), [own, next_one, far])
    assert chosen is not None and chosen.candidate.name == "y.curve_of_u" and chosen.rivals == ["y.curve_of_y"]
    assert not learner.ended and learner.out.notes == []
    harms["y.curve_of_u"] = "no log is better by 2% for it"
    assert learner.chosen(tried("none", 9.0), [own, next_one]) is None
    assert learner.out.notes == ["y.curve_of_y fits, but is not learned: makes v worse: 1.4 times the error"]
    lag = tried("u", 1.0, memory=True)
    learner.out.notes = []
    assert learner.chosen(tried("none", 9.0), [lag]) is None
    assert learner.out.notes == [
        f"{lag.candidate.name} fits, but is not learned: it remembers, and neither another log nor another amplitude "
        f"confirms it"
    ]
    clean = tried("w", 1.5, formulas=[("f", tried("f", 1.0))])
    assert learner.chosen(tried("none", 9.0), [clean]) is not None and learner.ended  # a formula leaves only noise


def test_a_curve_is_taken_as_its_lag_and_its_formulas_let_it(monkeypatch: pytest.MonkeyPatch) -> None:
    learner = chooser(objection=lambda before, t: "" if t.candidate.name == "y.curve_of_f" else "worse")
    learner._with_its_lag = lambda current, t, steps: t  # type: ignore[method-assign]
    learner._settled = lambda current, t: t  # type: ignore[method-assign]
    formulas = [("f", tried("f", 1.0 + 0.9 * RIVAL))]
    monkeypatch.setattr(learning, "fitted_formulas", lambda ground, t: formulas)
    t = tried("u", 1.0)
    assert learner._as_learned(tried("none", 9.0), t) == (t, "") and t.formulas == formulas
    formulas[0][1].fit.held_out *= 1.2
    assert learner._as_learned(tried("none", 9.0), tried("u", 1.0))[1] == "worse"
    learner.speaks = False
    assert learner._as_learned(tried("none", 9.0), tried("u", 1.0))[1] == "worse"
    fine = chooser()
    fine._with_its_lag, fine._settled = learner._with_its_lag, learner._settled  # type: ignore[method-assign]
    clean = tried("u", 1.0)
    assert (
        fine._as_learned(tried("none", 9.0), clean) == (clean, "") and clean.formulas is None
    )  # nothing asks for them


@pytest.mark.parametrize("best", [2.0, 5.0, 11.0])
def test_a_lag_is_followed_while_it_gets_better(best: float) -> None:
    learner = chooser()

    def lagged(tau: float) -> Any:
        slower = lambda times: tau * times  # noqa: E731
        t = tried("u", 1.0)
        t.candidate = replace(t.candidate, quantity=replace(t.candidate.quantity, slower=slower))
        t.tau = tau
        return t

    def slower(current: Any, t: Any, times: float) -> Any:
        return lagged(t.tau * times) if abs(np.log(t.tau * times / best)) < abs(np.log(t.tau / best)) else None

    learner._slower = slower  # type: ignore[method-assign]
    found: Any = learner._with_its_lag(tried(), lagged(5.0), (1.8, 1.1))
    assert abs(np.log(found.tau / best)) <= 0.5 * np.log(1.1) + 1e-9
    plain = tried("w")
    assert learner._with_its_lag(tried(), plain, (1.8,)) is plain


def test_a_first_curve_that_only_stood_for_the_second_goes() -> None:
    learner = chooser()
    learner.base = tried().fit
    first, second = tried("u", 3.0), tried("w", 1.0)
    index = {"y.curve_of_u": slice(1, 3), "y.curve_of_w": slice(3, 5)}
    second.judge.stage.index = lambda: index  # type: ignore[method-assign]
    second.fit.theta = np.arange(5.0)  # type: ignore[misc]
    second.told, second.rivals = "told", ["r"]  # type: ignore[assignment]
    asked: list[Any] = []

    def fit(nothing: Any, c: Any, wiggle: float, theta: Array, steps: int) -> Any:
        asked.append((nothing.curves, c, wiggle, theta.tolist()))
        return alone

    learner.fitted = fit  # type: ignore[assignment, method-assign]
    alone = tried("w", 1.0 * np.exp(0.9 * BETTER))
    (only,) = learner._without_first(first, second)
    assert asked == [((), second.candidate, 1.0, [0.0, 3.0, 4.0])]
    assert only.fit is alone.fit and only.told == "told" and only.rivals == ["r"]
    alone = tried("w", np.exp(1.1 * BETTER))
    assert learner._without_first(first, second) == [first, second]


# ---- surfaces --------------------------------------------------------------------------------------------------------

W = 3.0 + np.cos(0.37 * T) + 0.5 * np.sin(1.9 * T)


def surface(values: Any, seed: int = 1, mean: bool = True) -> FittedCandidate:
    s = surface_of(replace(candidate("u"), mean=mean), candidate("w", x=W))
    assert s is not None
    a, b = (basis.design(q.visited) @ basis.turn for q, basis in s.axes)
    rows = np.vstack([np.cos(1.3 * T), *(a[:, i] * b[:, j] for i, j in s.pairs)])
    effect = s.effect(5.0)
    stage = Stage(
        "s", ("y",), ("V",), (Parameter("gain", 1.0, "1", 0.0, 2.0, 0.5),), (effect,),
        lambda thetas: (thetas @ rows)[:, None, :], T, np.cos(1.3 * T) + values(U, W) + 0.01 * white(seed, N),
        floor=np.array([0.01]),
    )  # fmt: skip
    judge = LeastSquaresProblem(stage, np.array([0.01]))
    fit = with_held_out(judge, judge.fit((s.name,), stage.neutral()))
    return FittedCandidate(s, 5.0, judge, fit, ((s.placed(), effect),))


def test_a_product_is_taken_apart_into_its_factors() -> None:
    t = surface(lambda u, w: 0.5 * (1.0 + u) * w)
    s: Any = t.candidate
    x, z = _samples(s)
    apart = _factors(t, s, (x, z), False)
    assert apart is not None
    one, other = apart[0](x), apart[1](z)
    assert one * other == pytest.approx(0.5 * (1.0 + x) * z, abs=0.03)
    assert np.sqrt(np.mean(other**2)) == pytest.approx(1.0, rel=1e-6)  # its size is in the first one
    ranked = _likely(s, (x, z), apart)
    names = [(a[0].name, b[0].name) for a, b in ranked]
    assert ("straight line", "line") in names[:4] and len({a for a, _ in names}) <= PRODUCT_FORMS
    assert _factors(surface(lambda u, w: np.sin(2.0 * u + 3.0 * w)), s, (x, z), False) is None  # no product
    law = surface_law_of((t.judge, t.judge.fit((), t.judge.stage.neutral())), t)
    inner = law.within
    grid = 0.5 * (1.0 + law.x[:, None]) * law.across[None]
    assert np.abs(law.values - grid)[inner].max() < 0.05 and inner.mean() > 0.5
    assert np.all(law.lowest <= law.values) and np.all(law.values <= law.highest)
    assert law.middle == pytest.approx(np.median(W), abs=np.ptp(W) / 60) and law.second == "w"
    assert law.visited.sum() == pytest.approx(1.0) and law.samples.shape[0] == 2
    assert law.error_after < 2.0 < law.error_before


def test_products_are_likely_that_are_near_the_best() -> None:
    t = surface(lambda u, w: 0.5 * u * w)
    own = rms_of(t.judge, t.fit)

    def product(name: str, error: float, complexity: float) -> Any:
        return Product("line", name, {"a": 1.0}, error, complexity, second_form="line"), t  # type: ignore[arg-type]

    t.formulas = [product("b", 1.0, 2.0), product("a", 1.04, 1.0), product("a", 1.0, 3.0), product("far", 1.2, 0.5)]
    assert [(f.text, f.complexity) for f in likely_products(t, 2.0)] == [("a", 1.0), ("b", 2.0)]
    limit = float(np.hypot(FORM_POOR * max(own, 1.0), FORM * 50.0))
    for side in (0.999, 1.001):
        t.formulas = [product("a", side * limit, 1.0)]
        assert bool(likely_products(t, 50.0)) == (side < 1.0)
    t.formulas = None
    assert likely_products(t, 2.0) == []


def test_a_product_in_words() -> None:
    by = {f.name: f for f in FORMS}
    s: Any = surface(lambda u, w: 0.5 * u * w).candidate
    assert _text(s, by["line"], by["line"], np.array([2.0]), 0.0) == "2 u * w"
    assert _text(s, by["line"], by["line"], np.array([2.0]), 0.5) == "2 u * w - 0.5"
    assert _text(s, by["line"], by["line"], np.array([2.0]), -0.5) == "2 u * w + 0.5"


def test_a_surface_must_be_accepted_over_everything_that_is_there(monkeypatch: pytest.MonkeyPatch) -> None:
    nothing, curve = tried("none", 9.0), tried("u", 4.0)
    one_sum = tried("sum", 3.0)
    monkeypatch.setattr(surface_search, "_sum", lambda learner, nothing, t: one_sum)
    out: Any = SimpleNamespace(tried=[curve], notes=[])
    choice = surface_search.SurfaceSelection(ordering(), out, nothing)
    assert choice.before is curve
    good, poor = tried("w", 1.2), tried("w", 1.8)
    assert choice.accepted(curve, [good, poor]) == [good]  # half of what the sum leaves
    assert surface_search.SurfaceSelection(ordering(), SimpleNamespace(tried=[]), nothing).before is nothing  # type: ignore[arg-type]
    assert choice.pruned([nothing, good]) == [nothing, good]


@pytest.mark.parametrize(
    ("error", "shape", "surfaces", "formula", "more"),
    [(2.0, (), True, None, True), (1.2, (), True, None, False), (2.0, ("odd",), True, None, False),
     (2.0, (), False, None, False), (2.0, (), True, 1.0, False), (2.0, (), True, 1.5, True)],
)  # fmt: skip
def test_a_surface_is_looked_for_where_curves_and_formulas_leave_more_than_noise(
    error: float, shape: tuple[str, ...], surfaces: bool, formula: float | None, more: bool
) -> None:
    learner = ordering(shape=shape, ranked=[[tried()]])
    learner.ground.surfaces = surfaces
    t = tried("u", error, formulas=[("f", tried("f", formula))] if formula else None)
    out: Any = SimpleNamespace(tried=[t], notes=[])
    choice = surface_search.SurfaceSelection(learner, out, tried("none", 9.0))
    assert choice.wants_more(t) == more and not choice.wants_more(tried("other", 9.0))


def test_of_surfaces_that_do_as_well_the_plainest_is_chosen_unless_it_harms(monkeypatch: pytest.MonkeyPatch) -> None:
    learner = ordering(left=lambda before, t, among: float(np.log(rms_of(t.judge, t.fit))))
    monkeypatch.setattr(surface_search, "fitted_products", lambda ground, t: products.get(t.candidate.name, []))
    products: dict[str, Any] = {}
    nothing = tried("none", 9.0)
    out: Any = SimpleNamespace(tried=[], notes=[])
    choice = surface_search.SurfaceSelection(learner, out, nothing)
    own, other, far = tried("y", 1.03), tried("w", 1.0), tried("v", 1.2)
    best = choice.chosen(nothing, [other, own, far])
    assert best is not None and best.candidate is own.candidate and best.rivals == ["y.curve_of_w"]
    products["y.curve_of_v"] = [("f", tried("f", 0.5))]  # its product does much better
    best = choice.chosen(nothing, [other, own, far])
    assert best is not None and best.candidate is far.candidate and best.rivals == []
    learner.objection = lambda before, t: "" if t.candidate.name == "y.curve_of_f" else "makes v worse"
    assert choice.chosen(nothing, [far]) is not None  # whose product harms none
    assert choice.chosen(nothing, [own]) is None
    assert out.notes == ["y.curve_of_y fits, but is not learned: makes v worse"]


def test_pairs_of_quantities_are_those_that_the_best_curves_are_of(monkeypatch: pytest.MonkeyPatch) -> None:
    names = ["q0", "q1", "q2", "q3", "q4", "q5", "y"]
    places = {"y": "output adds", "z": "output adds"}
    known = [candidate(n, at, how) for at, how in places.items() for n in names]
    monkeypatch.setattr(surface_search, "surface_of", lambda one, two: (one.at, one.quantity.name, two.quantity.name))
    ranked = [SimpleNamespace(candidate=candidate(n, "z")) for n in ("q5", "q4", "q0")]
    learner: Any = SimpleNamespace(candidates=[*known, candidate("time")], ranked=[ranked])
    found: Any = surface_search._candidates(learner)
    assert found[0] == ("z", "q4", "q5") and {at for at, _, _ in found} == {"y", "z"}
    used = {n for at, a, b in found for n in (a, b) if at == "z"}
    assert used == {"q5", "q4", "q0", "q1", "q2"} and len(used) == SURFACE_QUANTITIES
    assert {n for at, a, b in found for n in (a, b) if at == "y"} == {*used, "y"}  # and the place's own
    order = [names.index(a) + names.index(b) for at, a, b in found]
    assert len(order) == len(found)


# ---- what is said of a law -------------------------------------------------------------------------------------------


def test_a_band_holds_the_curve_and_is_as_wide_as_blocks_make_it() -> None:
    inside = []
    truth = lambda x: 0.3 * np.sin(2.0 * x)  # noqa: E731
    for seed in range(6):
        t = fitted(candidate(), measured(20 + seed, truth), 5.0)
        been = np.isin(np.arange(257), np.searchsorted(t.candidate.grid, U).clip(0, 256))
        low, high = band_of(t, been)
        table, amplitudes = t.table()
        y = table(amplitudes)
        assert np.all(low < y) and np.all(y < high)
        x = t.candidate.grid
        inside.append(np.mean(((low <= truth(x)) & (truth(x) <= high))[been]))
        assert 0.02 < np.median((high - low)[been]) < 0.3
    assert np.mean(inside) > 0.9
    quiet = fitted(candidate(), measured(20, truth) - 0.9 * FLOOR * white(20, N), 5.0)
    narrow = np.subtract(*band_of(quiet, been)[::-1])
    assert np.median(narrow[been]) < np.median((high - low)[been])


def test_a_band_goes_about_each_formula_that_does_as_well() -> None:
    c = candidate()
    x = c.grid
    y, been = 2.0 * x, np.ones(len(x), dtype=bool)
    low, high = y - 0.1, y + 0.2
    bent = said("line", 1.0, 1.0, a=2.5)
    lower, higher = _with_formulas(c, y, low, high, been, [bent])
    assert lower == pytest.approx(np.minimum(low, 2.5 * x - 0.1)) and higher == pytest.approx(
        np.maximum(high, 2.5 * x + 0.2)
    )
    same = _with_formulas(c, y, low, high, been, [])
    assert same[0] is low and same[1] is high
    lent = _with_formulas(
        replace(c, untold=(0,)), y + 3.0, low + 3.0, high + 3.0, been, [said("line", 1.0, 1.0, a=2.0)]
    )
    assert lent[0] == pytest.approx(low + 3.0) and lent[1] == pytest.approx(high + 3.0)  # its mean is the curve's
    slope = _with_formulas(replace(c, untold=(0, 1)), y, low, high, been, [said("line", 1.0, 1.0, a=5.0)])
    assert slope[0] == pytest.approx(low, abs=1e-6) and slope[1] == pytest.approx(high, abs=1e-6)


def test_what_a_curve_trades_with_left_its_interval() -> None:
    t = fitted(candidate(), measured(1))
    assert _trades(t) == []
    inside = replace(t.fit, low=t.fit.theta[t.fit.free] - 1.0, high=t.fit.theta[t.fit.free] + 1.0)
    assert _trades(replace(t, told=inside)) == []
    assert _trades(replace(t, told=replace(inside, high=inside.low))) == ["gain"]
    assert (
        range_of(np.array([-1.23456, 0.0, 2.0]), "V") == "[-1.235, 2] V"
        and range_of(np.array([1.0, 2.0]), "-") == "[1, 2]"
    )


def test_how_many_splines_a_curve_has() -> None:
    time, u = Quantity("time", "s", COLUMN, T), Quantity("u", "V", INPUT, U)
    assert usual(time) > usual(u)
    for q in (time, u):
        basis, more = basis_for(q), basis_for(q, usual(q) + 3)
        assert basis is not None and more is not None and len(more.bend) > len(basis.bend)
    assert basis_for(Quantity("u", "V", INPUT, np.ones(N))) is None


def test_names_of_a_model_say_which_curve_a_formula_stands_for() -> None:
    t = fitted(candidate(), measured(1))
    fit: Fit = replace(t.fit, effects=("a", "y.curve_of_u"))
    assert replace(t, fit=fit).names == ("a", "y.curve_of_u")
    assert replace(t, fit=fit, form="line").names == ("a", "y.curve_of_u as line")
    again = replace(t, formulas=[], loose=[], errors={}, form="line").refitted(t.judge, fit, ())
    assert (again.formulas, again.loose, again.errors, again.form, again.curves) == (None, None, None, "", ())
    assert t.at(np.array([0.3]), t.table()[1]) == pytest.approx(
        t.candidate.basis.design(np.array([0.3])) @ t.candidate.turn @ t.table()[1], abs=1e-3
    )
    assert t.forgotten() is None and t.settled is None
    assert t.slopes().columns.tolist() == []  # a stage keeps them that carries them along
    t.judge.stage.carries = True
    t.fit = t.judge.fit((t.candidate.name,), t.judge.stage.neutral(), 1)  # it ends on its only step
    slopes = t.slopes()
    assert slopes.columns.tolist() == [0] and len(t.slopes(beside=False).columns) == len(t.fit.free)
