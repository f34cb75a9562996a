"""Steps of the search for curves, each by itself: which formulas may be a curve, which candidates are fitted to the
end, from where to where an error may have lines, what is said of a curve beside another one.
"""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.test_curve_choice_spec import FLOOR, N, T, U, candidate, chooser, fitted, measured, ordering, tried, white
from tests.test_curves_in_place_spec import W, curve, ground_of, learner_on, named, place
from tests.test_unmodelled_spec import made, product_of
from vaneloop.base.forms import FORMS
from vaneloop.identification.candidates.closed_forms import Formula
from vaneloop.identification.least_squares.problem import LeastSquaresProblem
from vaneloop.identification.results import rms_of
from vaneloop.identification.settings import PERIOD_TURNS
from vaneloop.identification.subsystem import Array
from vaneloop.identification.unmodelled import (
    closed_form_fits,
    learned_law,
    learning,
    problem,
    regressors,
    screening,
    spectral_lines,
    surface_search,
)
from vaneloop.identification.unmodelled.closed_form_fits import _nearest, _text, _variance, _visited
from vaneloop.identification.unmodelled.curve_candidates import Candidate, _further, surface_of
from vaneloop.identification.unmodelled.fitted_candidate import FittedCandidate
from vaneloop.identification.unmodelled.learning import CurveSearch
from vaneloop.identification.unmodelled.python_law import python_law
from vaneloop.identification.unmodelled.regressors import Quantity
from vaneloop.identification.unmodelled.spectral_lines import Course, Lines, _Driven, _Even, _even, _highest
from vaneloop.identification.user_models.terms import INPUT

# docs/settings.md
RIVAL, BETTER, MAY_CATCH_UP, FORMULAS_WITHIN = 0.05, 0.02, 0.25, 0.5
FORMS_ALIKE, FORMS_REFITTED, FORM_SHAPED, FORM_FAR, MOST_PERIODS = 1e-4, 5, 0.2, 100.0, 2
CURVES_FINISHED, POINTS, LAW_TEST_VALUES = 5, 257, 9
LEAST_CYCLES, SAMPLES_PER_PERIOD, LINES_EACH, NATS = 6.0, 2.5, 4, 12.0
BY = {f.name: f for f in FORMS}
STRAIGHT = {"constant", "line", "straight line"}


# ---- which formulas may be a curve -----------------------------------------------------------------------------------


def near(
    c: Candidate, shares: dict[str, float], patch: pytest.MonkeyPatch, variance: float = 0.0,
    weight: Array | None = None, lent: set[int] | None = None, numbers: float = 1.0,
) -> tuple[list[str], dict[str, set[int]]]:  # fmt: skip
    """Names of the forms that come near sin(x), where each leaves so much; and what each of them may have beside it."""
    asked: dict[str, set[int]] = {}

    def begin(form: Any, q: Array, y: Array, free: Any, weights: Array) -> tuple[Array, float]:
        asked[form.name] = set(free)
        return np.full(len(form.numbers), numbers), shares.get(form.name, 0.5)

    patch.setattr(closed_form_fits, "begin", begin)
    x = np.quantile(c.quantity.visited, np.linspace(0.005, 0.995, 200))
    w = np.ones(200) if weight is None else weight
    out = _nearest(c, x, np.sin(x), np.full(200, variance), set() if lent is None else lent, w)
    return [form.name for form, _ in out], asked


def test_forms_that_are_asked_are_those_that_a_curve_can_be(monkeypatch: pytest.MonkeyPatch) -> None:
    every = set(BY)
    for lent in (set(), {0}, {1}, {0, 1}):
        _, asked = near(candidate(), {}, monkeypatch, lent=lent)
        assert set(asked) == every - {"Arrhenius"}
        for form, free in asked.items():  # beside a slope a form may have a mean, too: only its bends tell
            assert free == (lent | {0} if 1 in lent and form not in STRAIGHT else lent), (form, lent)
    for unit in ("degC", "°C", "C"):
        assert set(near(candidate(of_unit=unit), {}, monkeypatch)[1]) == every
    no_mean = near(replace(candidate(), mean=False), {}, monkeypatch)[1]
    assert set(no_mean) == every - {"Arrhenius", "constant", "straight line"}
    for values, few in (([-1.0, 0.0, 1.0], True), ([-1.0, 0.0, 0.5, 1.0], False)):
        c = replace(candidate(), quantity=Quantity("u", "V", INPUT, np.repeat(values, 200)))
        x = np.repeat(values, 50)
        asked = {}
        monkeypatch.setattr(closed_form_fits, "begin", lambda form, *_, asked=asked: asked.setdefault(form.name, None))
        assert _nearest(c, x, x, np.zeros(len(x)), set(), np.ones(len(x))) == []
        assert (set(asked) == {"constant", "line"}) == few


def test_forms_come_in_the_order_of_what_they_leave_and_of_their_complexity(monkeypatch: pytest.MonkeyPatch) -> None:
    shares = {"line": 0.05, "cube": 0.01, "tanh": 1e-7, "sine": 1e-9, "square": 0.199, "root": 0.201}

    def ranked(least: float) -> list[str]:
        some = [n for n in BY if shares.get(n, 1.0) < FORM_SHAPED]
        return sorted(some, key=lambda n: np.log(max(shares[n], least)) + 0.3 * BY[n].complexity)

    assert near(candidate(), shares, monkeypatch)[0] == ranked(FORMS_ALIKE)
    x = np.quantile(U, np.linspace(0.005, 0.995, 200))
    for weight in (np.ones(200), np.linspace(0.1, 3.0, 200)):  # its doubt, as a share of its own weighted squares
        middle = np.sum(weight**2 * np.sin(x)) / np.sum(weight**2)
        squares = np.sum(weight**2 * (np.sin(x) - middle) ** 2)
        for doubt in (0.03, 0.3):
            variance = doubt * squares / np.sum(weight**2)
            assert near(candidate(), shares, monkeypatch, variance, weight)[0] == ranked(doubt)
    height = np.ptp(x) / np.ptp(np.sin(x))
    for side in (0.99, 1.01):  # of a line that is far larger than the curve the parameters would have to take most
        assert ("line" in near(candidate(), shares, monkeypatch, numbers=side * FORM_FAR / height)[0]) == (side < 1.0)
    odd = replace(candidate(), shape=("odd",))
    assert set(near(odd, shares, monkeypatch)[0]) == {"line", "cube", "tanh"}


def test_formulas_are_fitted_that_are_near_a_curve_where_it_is_known_and_everywhere(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    t = fitted(replace(candidate(), untold=(1,)), measured(3))
    asked: list[Any] = []
    forms: list[list[Any]] = [[(f"f{k}", k) for k in range(4)], [("f1", 9), ("g", 1), ("h", 2), ("i", 3)]]

    def nearest(c: Any, visited: Array, y: Array, variance: Array, lent: set[int], weight: Array) -> list[Any]:
        asked.append((lent, weight, variance, y))
        return [(SimpleNamespace(name=n), k) for n, k in forms[len(asked) - 1]]

    tries: list[Any] = []

    def in_simulation(ground: Any, tried: Any, form: Any, numbers: Any) -> Any:
        tries.append((form.name, numbers))
        many, error = {"f0": (1, 1.02), "f1": (3, 1.0), "g": (2, 1.01), "f2": (9, 1.0)}.get(form.name, (0, 0.0))
        return (SimpleNamespace(error=error, numbers=range(many), form=form.name), form.name) if many else None

    monkeypatch.setattr(closed_form_fits, "_nearest", nearest)
    monkeypatch.setattr(closed_form_fits, "_in_simulation", in_simulation)
    ground: Any = SimpleNamespace(shares=False)
    clean = replace(t, fit=replace(t.fit, held_out=np.full(t.judge.n_blocks, t.judge.n / t.judge.n_blocks)))
    out = closed_form_fits.fitted_formulas(ground, clean)
    assert len(asked) == 1 and asked[0][0] == {1} and tries == forms[0]
    assert [f.form for f, _ in out] == ["f1", "f0", "f2"]  # 0.015, 0.0248, 0.045
    variance, y = asked[0][2], asked[0][3]
    np.testing.assert_allclose(asked[0][1], 1.0 / np.sqrt(variance + FORMS_ALIKE * np.var(y)))
    asked.clear()
    tries.clear()
    poor = replace(clean, fit=replace(clean.fit, held_out=9.0 * clean.fit.held_out))
    closed_form_fits.fitted_formulas(ground, poor, loose=True)
    assert [a[0] for a in asked] == [{0, 1}] * 2 and asked[1][1].tolist() == [1.0] * len(y)
    assert [n for n, _ in tries] == ["f0", "f1", "g", "f2", "h"] and len(tries) == FORMS_REFITTED
    assert dict(tries)["f1"] == 1
    asked.clear()
    tries.clear()
    t.judge.stage.grain = 0.1
    out = closed_form_fits.fitted_formulas(ground, clean)
    assert [f.form for f, _ in out] == ["f1", "f2", "f0"]  # near a known noise errors count ten times


def test_a_curve_s_variance_is_that_of_least_squares_with_its_priors() -> None:
    t = fitted(candidate(), measured(4))
    c, judge = t.candidate, t.judge
    rows = np.vstack([np.cos(1.3 * T), (c.basis.design(U) @ c.turn).T]) / FLOOR
    known = np.linalg.inv(rows @ rows.T + np.diag(judge.prior))
    x = np.linspace(-1.0, 1.0, 7)
    design = np.hstack([np.zeros((7, 1)), c.basis.design(x) @ c.turn])
    wanted = np.einsum("ni,ij,nj->n", design, known, design)
    quiet = replace(t, fit=replace(t.fit, cost=0.5 * judge.n * t.fit.cost / t.fit.cost.sum()))
    np.testing.assert_allclose(_variance(quiet, x), wanted, rtol=2e-2)
    loud = replace(t, fit=replace(t.fit, cost=4.0 * judge.n * t.fit.cost / t.fit.cost.sum()))
    np.testing.assert_allclose(_variance(loud, x), 4.0 * _variance(quiet, x), rtol=1e-9)


def test_a_curve_is_known_where_the_samples_that_are_judged_have_been() -> None:
    y = measured(5)
    y[U > 0.5] = np.nan
    t = fitted(candidate(), y)
    visited = _visited(t)
    counted = U[U <= 0.5]
    np.testing.assert_allclose(visited[[0, -1]], np.quantile(counted, [0.005, 0.995]), atol=0.01)
    assert len(visited) == POINTS
    course = np.append(U, np.full(2 * N, np.nan))  # radii of stops are no values at samples
    other = replace(t, candidate=replace(t.candidate, quantity=replace(t.candidate.quantity, visited=course)))
    np.testing.assert_allclose(_visited(other)[[0, -1]], np.quantile(U, [0.005, 0.995]))


def test_a_product_with_a_quotient_in_words() -> None:
    s: Any = SimpleNamespace(
        quantity=SimpleNamespace(name="u"), other=SimpleNamespace(name="w"),
        basis=SimpleNamespace(low=-1.0), across=SimpleNamespace(low=0.5),
    )  # fmt: skip
    inverse, line = BY["inverse"], BY["line"]
    assert _text(s, line, inverse, np.array([2.0]), 0.0) == "2 u / w"
    assert _text(s, line, inverse, np.array([2.0]), 0.5) == "2 u / w - 0.5"
    assert _text(s, line, inverse, np.array([2.0]), -0.5) == "2 u / w + 0.5"
    assert _text(s, line, BY["tanh"], np.array([2.0, 3.0]), 0.25) == "2 u * tanh(3 w) - 0.25"
    root = BY["root"]
    assert _text(s, root, root, np.array([2.0]), 0.0) == "2 sign(u) sqrt(|u|) * sqrt(w)"  # w stays above 0


def test_a_formula_stands_beside_the_curve_that_was_there_before(monkeypatch: pytest.MonkeyPatch) -> None:
    law = lambda u, w: 0.05 * w**3 + 0.2 * np.sin(2.0 * u)  # noqa: E731
    learner, now = learner_on(ground_of(law, ["y"], first=(U[:200], 1.5 * W)))
    monkeypatch.setattr(closed_form_fits, "FORMS", (BY["cube"], BY["line"]))
    models = [now]
    for of in "uw":
        c = named(learner, place(learner, of))
        models.append(now := learner.fitted(now, c, 5.0, np.append(now.fit.theta, np.zeros(len(c.parts))), 12))
    _, first, second = models
    found = closed_form_fits.fitted_formulas(learner.ground, second, loose=True)  # the first one has the mean
    formula, alone = next((f, a) for f, a in found if f.form == "cube")
    assert len(alone.curves) == 2 and alone.curves[0] is second.curves[0]
    assert len(alone.fit.theta) == len(first.fit.theta) + 1
    assert formula.numbers["a"] == pytest.approx(0.05, rel=0.1) and formula.error < 1.5


# ---- what is said of a curve -----------------------------------------------------------------------------------------


def test_what_is_said_of_a_curve_is_where_it_has_been(monkeypatch: pytest.MonkeyPatch) -> None:
    t = fitted(candidate(), measured(6))
    t.formulas, t.rivals = [], ["other"]
    seen: list[Array] = []

    def band(t: Any, been: Array) -> tuple[Array, Array]:
        seen.append(been)
        return -np.ones(POINTS), np.ones(POINTS)

    monkeypatch.setattr(learned_law, "band_of", band)
    grid = t.candidate.grid
    c = replace(t.candidate, quantity=replace(t.candidate.quantity, visited=np.append(U, [grid[0], np.nan, 99.0])))
    t.candidate = c
    base = t.judge.fit((), t.judge.stage.neutral())
    law = learned_law.law_of(SimpleNamespace(), (t.judge, base), t)
    values = [*U, grid[0], 99.0]
    wanted = [any(grid[k - 1] < v <= grid[k] if k else v <= grid[0] for v in values) for k in range(257)]
    wanted[-1] |= any(v > grid[-1] for v in values)
    assert seen[0].tolist() == wanted and 0.2 < np.mean(wanted) <= 1.0
    counts = np.histogram(U[(grid[0] <= U) & (grid[-1] >= U)].tolist() + [grid[0]], 24, (grid[0], grid[-1]))[0]
    np.testing.assert_allclose(law.visited, counts / counts.sum())
    assert law.rivals == ["other"] and law.untold == () and law.period == 0.0 and law.trades == []
    assert law.error_before == rms_of(t.judge, base) and law.error_after == rms_of(t.judge, t.fit)
    assert law.low.tolist() == [-1.0] * 257 and law.high.tolist() == [1.0] * 257
    np.testing.assert_allclose(law.y, t.candidate.basis.design(grid) @ t.candidate.turn @ t.table()[1])


# ---- the search's steps ----------------------------------------------------------------------------------------------


def test_what_is_as_good_as_a_plainer_curve_is_near_too() -> None:
    learner: Any = chooser()
    times, adds, other = tried("u", 1.0, how="output times"), tried("u", 1.2), tried("u", 1.3, at="z")
    learner._plainer = lambda before, t, best: t is adds
    for side in (0.9, 1.1):
        left = {"y.gain_of_u": 0.0, "y.curve_of_u": 0.2, "z.curve_of_u": 0.2 + side * RIVAL}
        assert (other in learner._near(tried("none", 9.0), [adds, other, times], left)) == (side < 1.0)
    learner._plainer = lambda *_: False
    left = {"y.gain_of_u": 0.0, "y.curve_of_u": 0.2, "z.curve_of_u": 0.2}
    assert learner._near(tried("none", 9.0), [adds, other, times], left) == [times]


@pytest.mark.parametrize("straight", [1, 2])
def test_mean_and_slope_go_where_the_model_has_them(straight: int) -> None:
    learner: Any = chooser()
    c = candidate()
    best = fitted(c, measured(7))
    if straight == 1:
        best.candidate = c = replace(c, basis=replace(c.basis, period=2.0))
    assert c.basis.straight == straight
    current: Any = SimpleNamespace(fit=SimpleNamespace(theta=np.array([0.25])))
    own = best.fit.theta
    asked: list[Any] = []
    score: dict[tuple[int, ...], float] = {}

    def fit(before: Any, c: Any, wiggle: float, begin: Array, steps: int, quick: bool, near: Any) -> Any:
        asked.append((c.untold, begin.tolist(), wiggle, quick))
        at = 0.0 if begin[0] == 0.25 else 0.01  # the nominal beginning does better
        judge = SimpleNamespace(stage=SimpleNamespace(grain=0.5))
        found: Any = replace(best, candidate=c, wiggle=score[c.untold] + at)
        found.judge = judge
        return found

    learner.fitted = fit
    learner.score = lambda t, among=(): t.wiggle if t is not best else 0.0
    learner.told_in_nats = nullcontext
    ways = [(0, 1), (1,), (0,)] if straight == 2 else [(0,)]
    for good in [*ways, None]:
        asked.clear()
        for way in ways:
            score[way] = (0.99 if way == good else 1.01) * BETTER
        got = learner._settled(current, best)
        tries = ways[: ways.index(good) + 1] if good else ways
        assert [a[0] for a in asked] == [w for w in tries for _ in range(2)]
        for untold, begin, wiggle, quick in asked:
            bends = [v for k, v in enumerate(own[1:]) if k not in untold]
            assert begin in ([0.25, *bends], [own[0], *bends]) and wiggle == 1.0 and quick is False
        if good is None:
            assert got is best
            continue
        assert got.candidate.untold == good and got.told is best.fit and got.wiggle == pytest.approx(0.99 * BETTER)
        assert got.judge.stage.grain == best.judge.stage.grain


def finalists_of(
    monkeypatch: pytest.MonkeyPatch, errors: dict[str, float], costs: dict[str, float] | None = None, **more: Any
) -> tuple[Any, list[str]]:
    """A search in which each curve leaves what is known of it, and the names of those that were fitted to the end."""
    learner: Any = chooser(**more)
    finished: list[str] = []
    names = list(errors)
    promising = [(float(k), candidate(n), np.zeros(3)) for k, n in enumerate(names)]
    monkeypatch.setattr(learning, "screened", lambda *_: (100.0, promising))
    monkeypatch.setattr(learning, "one_constant", lambda quick: quick)
    monkeypatch.setattr(learning, "score", lambda judge, fit: float(np.log(np.sqrt(fit.held_out.sum() / judge.n))))
    long = SimpleNamespace(t=np.zeros(100), grain=1.0)

    def fit(
        current: Any, c: Candidate, wiggle: float, begin: Any, steps: int, quick: bool = False, near: Any = None
    ) -> Any:  # fmt: skip
        t = tried(c.quantity.name, errors[c.quantity.name])
        t.judge.stage = long
        if costs and c.quantity.name in costs:
            t.fit.cost = np.full(4, costs[c.quantity.name])
        learner.asked.append((c.quantity.name, steps, quick))
        return t

    def end(current: Any, t: Any) -> Any:
        finished.append(t.candidate.quantity.name)
        return t

    learner.asked = []
    learner.judge.stage, learner.progress = long, lambda share: None
    learner.fitted, learner._finished = fit, end
    learner.ordered = lambda some: sorted(some, key=learner.score)
    learner._finer = learner._jumping = lambda current, t: None
    learner.ground.jumps = True
    return learner, finished


CURRENT: Any = SimpleNamespace(
    slopes=lambda beside=True: None,
    curves=(),
    fit=SimpleNamespace(cost=np.array([1e4])),
    judge=SimpleNamespace(n=100.0),
)


def test_the_best_by_held_out_error_and_the_best_by_fit_are_fitted_to_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    errors = {f"q{k}": 1.0 + 0.01 * k for k in (3, 0, 7, 5, 1, 2, 6, 4)}
    learner, finished = finalists_of(monkeypatch, errors, {"q7": 1.0, "q6": 2.0}, fails=lambda t: False)
    out = learner.finalists(CURRENT)
    assert finished == ["q0", "q1", "q2", "q7", "q6"] and len(finished) == CURVES_FINISHED
    assert [t.candidate.quantity.name for t in out] == ["q0", "q1", "q2", "q6", "q7"]
    assert [t.candidate.quantity.name for t in learner.ranked[0]] == [f"q{k}" for k in range(8)]
    assert {(steps, quick) for _, steps, quick in learner.asked} == {(3, True)}
    late = {"time": 1.0, "u": 1.3, "w": 1.4}
    learner, finished = finalists_of(monkeypatch, late, fails=lambda t: False)
    learner.finalists(CURRENT)
    assert finished == ["time", "u", "w"]
    slips = {f"q{k}": 1.0 + 0.01 * k for k in range(6)} | {"stops_of_a": 3.0, "stops_of_b": 4.0, "stops_of_c": 2.0}
    learner, finished = finalists_of(monkeypatch, slips, fails=lambda t: False)
    learner.finalists(CURRENT)
    assert finished == ["q0", "q1", "q2", "q3", "q4", "stops_of_a", "stops_of_b"]  # those that promised most


def test_a_model_that_is_far_off_is_fitted_in_more_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    for bare, known, steps in ((2499.0, False, 3), (2501.0, False, 12), (2501.0, True, 3)):
        learner, _ = finalists_of(monkeypatch, {"u": 1.0}, fails=lambda t: False)
        learner.ground.noise_known = known
        promising = [(1.0, candidate(), np.zeros(3))]
        monkeypatch.setattr(learning, "screened", lambda *_, bare=bare, some=promising: (bare, some))
        learner.finalists(CURRENT)
        assert learner.asked == [("u", steps, True)]


def test_where_an_excerpt_does_not_tell_candidates_apart_all_samples_do(monkeypatch: pytest.MonkeyPatch) -> None:
    for whole, fails, again in ((100, False, False), (101, False, True), (101, True, False)):
        learner, _ = finalists_of(monkeypatch, {"u": 1.0, "w": 1.1}, fails=lambda t, fails=fails: fails)
        learner.judge.stage = SimpleNamespace(t=np.zeros(whole), grain=1.0)
        learner.finalists(CURRENT)
        assert (("u", 1, False) in learner.asked) == again


def test_near_a_known_noise_only_what_promises_enough_is_fitted(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[Any] = []
    monkeypatch.setattr(learning, "in_grains", lambda ground, grain, judges: told.append((grain, len(judges))))
    monkeypatch.setattr(learning, "grain_of", rms_of)
    for left, fits in ((100.0 - 2.0 * NATS - 0.1, True), (100.0 - 2.0 * NATS + 0.1, False)):
        learner, finished = finalists_of(monkeypatch, {"u": 1.5, "w": 1.2}, fails=lambda t: False)
        learner.faint = True
        promising = [(left, candidate("u"), np.zeros(3)), (left, candidate("w"), np.zeros(3))]
        monkeypatch.setattr(learning, "screened", lambda *_, some=promising: (100.0, some))
        assert bool(learner.finalists(CURRENT)) == fits and bool(finished) == fits
    assert told == [(pytest.approx(1.2), 5)]  # the grain of the best; the search's own judge and four others
    monkeypatch.setattr(learning, "screened", lambda *_: (100.0, []))
    assert learner.finalists(CURRENT) == []


def test_what_is_plainer_than_the_best_is_fitted_to_the_end_too(monkeypatch: pytest.MonkeyPatch) -> None:
    errors = {f"direction_of_{k}": 1.0 + 0.001 * n for n, k in enumerate("abcdef")}
    errors |= {"time": 1.1, "u": 1.2, "far": 1.0 * np.exp(1.1 * MAY_CATCH_UP), "y": 8.0}
    learner, finished = finalists_of(monkeypatch, errors, fails=lambda t: False)
    learner.finalists(CURRENT)
    assert finished[:CURVES_FINISHED] == [f"direction_of_{k}" for k in "abcde"]
    assert finished[CURVES_FINISHED:] == ["time", "u"]  # not what is too far behind, nor what explains too little
    errors["y"] = 4.9  # of 100 noise floors it leaves a quarter
    learner, finished = finalists_of(monkeypatch, errors, fails=lambda t: False)
    learner.finalists(CURRENT)
    assert finished[CURVES_FINISHED:] == ["time", "u", "y"]


def test_where_the_best_fails_finer_ones_and_jumps_are_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    best = 4.0
    errors = {"u": best, "w": best * np.exp(0.9 * MAY_CATCH_UP), "v": best * np.exp(1.1 * MAY_CATCH_UP)}
    errors |= {"z": best * np.exp(1.1 * FORMULAS_WITHIN)}
    learner, _ = finalists_of(monkeypatch, errors, fails=lambda t: True)
    tries: dict[str, list[str]] = {"finer": [], "jumping": []}
    fine, jump = tried("u", 1.0), tried("jump", 2.0)

    def finer(current: Any, t: Any) -> Any:
        tries["finer"].append(t.candidate.quantity.name)
        return fine if t.candidate.quantity.name == "u" else None

    def jumping(current: Any, t: Any) -> Any:
        tries["jumping"].append(t.candidate.quantity.name)
        return jump if t.candidate.quantity.name == "v" else None

    learner._finer, learner._jumping = finer, jumping
    learner.accepts = lambda before, t: t is fine
    out = learner.finalists(CURRENT)
    assert tries == {"finer": ["u", "w"], "jumping": ["u", "w", "v"]}
    assert [t.candidate.quantity.name for t in out] == ["u", "jump", "w", "v", "z"] and out[0] is fine
    learner.accepts = lambda before, t: False
    learner._finer = lambda current, t: tried("u", 9.0) if t.candidate.quantity.name == "u" else None
    again = learner.finalists(CURRENT)
    assert [t.candidate.quantity.name for t in again] == ["jump", "u", "w", "v", "z"]  # each name once, its best


def test_a_surface_stands_in_the_place_of_the_curves_and_a_search_for_one_begins_at_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    learner: Any = chooser()
    learner.d = SimpleNamespace(verdict="unknown", effects=[], final=SimpleNamespace(effects=()))
    learner.base, learner.candidates = tried("none", 5.0).fit, [candidate()]
    learner._named, learner._concluded = lambda: None, lambda out, named: out
    found: dict[str, list[Any]] = {"curves": [tried("u")], "surfaces": []}
    asked: list[Any] = []

    def steps(selection: Any, model: Any) -> list[Any]:
        asked.append((selection, model))
        return [model, *(found["curves"] if selection is learner else found["surfaces"])]

    monkeypatch.setattr(learning, "stepwise", steps)
    out = learner.learned()
    assert out.tried == found["curves"] and asked[0][0] is learner and asked[0][1].curves == ()
    assert asked[1][1] is found["curves"][0]
    found["surfaces"] = [tried("s")]
    assert learner.learned().tried == found["surfaces"]
    found["curves"], found["surfaces"] = [], []
    assert learner.learned().tried == [] and asked[-1][1] is asked[-2][1]


@pytest.mark.parametrize(("known", "size", "faint"), [(True, 0.0, True), (True, 3.0, False), (False, 0.0, False)])
def test_a_search_tells_errors_in_nats_where_the_model_comes_down_to_a_known_noise(
    known: bool, size: float, faint: bool
) -> None:
    t = fitted(candidate(), measured(8, lambda x: size * np.sin(2.0 * x)))
    told: list[float] = []
    stage = replace(t.judge.stage, effects=(), run=lambda thetas: (thetas[:, :1] * np.cos(1.3 * T))[:, None])
    bare = LeastSquaresProblem(stage, np.array([FLOOR]))
    ground: Any = SimpleNamespace(
        stage=lambda laws, curves, quick=False: stage, floor=np.array([FLOOR]), noise_known=known,
        in_grains=told.append, candidates=lambda theta: [candidate("u"), candidate("w")], tests=frozenset(),
    )  # fmt: skip
    d: Any = SimpleNamespace(base=SimpleNamespace(theta=np.append(1.0, np.full(40, 9.0))))
    learner = problem.CurveProblem(ground, d, shape=("odd",))
    assert learner.faint == faint and bool(told) == faint
    assert (learner.judge.stage.grain < 1.0) == faint and all(c.shape == ("odd",) for c in learner.candidates)
    assert len(learner.candidates) == 2 and learner.speaks and learner.progress(0.5) is None
    assert learner.base.theta[0] == pytest.approx(bare.fit((), stage.neutral()).theta[0], abs=1e-6)


# ---- surfaces --------------------------------------------------------------------------------------------------------


def test_a_surface_may_stand_instead_of_a_curve_over_time() -> None:
    nothing, first, late = tried("none", 9.0), tried("u", 3.0), tried("time", 1.0)
    learner = ordering(shape=(), ranked=[[first]])
    learner.ground.surfaces = True
    choice: Any = surface_search.SurfaceSelection(learner, SimpleNamespace(tried=[first, late]), nothing)  # type: ignore[arg-type]
    assert choice.before is first and choice.drifting is late
    assert choice.wants_more(first) and not choice.wants_more(late)
    alone = surface_search.SurfaceSelection(learner, SimpleNamespace(tried=[late]), nothing)  # type: ignore[arg-type]
    assert alone.before is nothing and alone.drifting is late
    clean: Any = tried("u", 1.1)  # also where nothing but noise is left
    quiet: Any = surface_search.SurfaceSelection(learner, SimpleNamespace(tried=[clean, late]), nothing)  # type: ignore[arg-type]
    assert quiet.wants_more(clean)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(surface_search, "_sum", lambda learner, nothing, t: tried("sum", 8.0))
        near, far = tried("v", float(np.exp(0.9 * RIVAL))), tried("w", float(np.exp(1.1 * RIVAL)))
        assert choice.accepted(first, [near, far]) == [near]
        plain = surface_search.SurfaceSelection(learner, SimpleNamespace(tried=[first]), nothing)  # type: ignore[arg-type]
        assert plain.accepted(first, [near, far]) == [near, far]
        assert plain.accepted(first, [tried("v", 1.6)]) == []  # not half of what the curve leaves


def test_a_surface_begins_from_the_best_curve_of_its_second_quantity() -> None:
    learner, nothing = learner_on(ground_of(lambda u, w: 0.4 * u * w, ["y"]))
    s = surface_of(named(learner, place(learner, "u")), named(learner, place(learner, "w")))
    assert s is not None
    t = curve(learner, nothing, place(learner, "w"))
    elsewhere = replace(t, candidate=replace(t.candidate, at="z"))
    learner.ranked = [[elsewhere, t]]
    begin = surface_search._begin(learner, nothing, s)
    assert begin[0] == t.fit.theta[0]
    along = dict(zip(s.pairs, begin[1:], strict=True))
    assert not any(v for (i, _), v in along.items() if i > 0)
    x = np.linspace(s.across.low, s.across.high, 40)
    found = s.across.design(x) @ s.across.turn @ [along[0, j] for j in range(s.across.turn.shape[1])]
    table, amplitudes = t.table()
    wanted = np.interp(x, t.candidate.grid, table(amplitudes))
    assert np.corrcoef(found, wanted)[0, 1] > 0.9
    learner.ranked = [[elsewhere]]
    assert not surface_search._begin(learner, nothing, s)[1:].any()


def test_surfaces_are_fitted_further_in_the_order_of_what_they_leave(monkeypatch: pytest.MonkeyPatch) -> None:
    names = [f"s{k:02d}" for k in range(14)]
    order = {n: float((k * 5) % 14) for k, n in enumerate(names)}  # what one step leaves
    asked: list[tuple[str, int, bool]] = []

    def fit(nothing: Any, c: Any, wiggle: float, begin: Any, steps: int, quick: bool) -> Any:
        asked.append((c.quantity.name, steps, quick))
        t = tried(c.quantity.name, 1.0 + order[c.quantity.name])
        t.wiggle = wiggle
        return t

    ended: list[str] = []

    def end(learner: Any, nothing: Any, c: Any, begin: Any, bends: Any, first: float = 1.0) -> Any:
        ended.append(c.quantity.name)
        return tried(c.quantity.name, 1.0 + order[c.quantity.name])

    monkeypatch.setattr(surface_search, "_candidates", lambda learner: [candidate(n) for n in names])
    monkeypatch.setattr(surface_search, "_begin", lambda learner, nothing, c: np.zeros(2))
    monkeypatch.setattr(surface_search, "smoothed", end)
    monkeypatch.setattr(surface_search, "score", rms_of)
    fine: list[str] = []
    monkeypatch.setattr(surface_search, "_finer", lambda learner, nothing, t: fine.append(t.candidate.quantity.name))
    learner = ordering(fails=lambda t: False, fitted=fit)
    learner.ordered = lambda some: sorted(some, key=lambda t: rms_of(t.judge, t.fit))
    best = sorted(names, key=order.__getitem__)
    out = surface_search._finished(learner, tried("none"))
    assert [a for a in asked if a[1] == 1] == [(n, 1, True) for n in names]
    assert [a for a in asked if a[1] == 5] == [(n, 5, True) for n in best[:10]]
    assert ended == best[:4] == [t.candidate.quantity.name for t in out] and fine == []
    learner.fails = lambda t: True
    order |= {best[1]: float(np.expm1(0.9 * MAY_CATCH_UP)), best[2]: float(np.expm1(1.1 * MAY_CATCH_UP))}
    surface_search._finished(learner, tried("none"))
    assert fine == best[:2]


# ---- lines -----------------------------------------------------------------------------------------------------------


def test_lines_are_looked_for_between_six_cycles_and_the_fastest_that_samples_tell() -> None:
    long, short = 0.02 * np.arange(2000), 5.0 + 0.05 * np.arange(300)
    courses = [Course(t, np.zeros((1, len(t))), np.zeros((0, len(t)))) for t in (long, short)]
    lines = Lines(courses)
    assert [lines.shortest, lines.longest] == pytest.approx([299 * 0.05, 1999 * 0.02])
    apart = 1.0 / (LINES_EACH * lines.longest)
    assert lines.apart == pytest.approx(apart) and np.diff(lines.f) == pytest.approx(np.full(len(lines.f) - 1, apart))
    low, high = LEAST_CYCLES / lines.shortest, 1.0 / (SAMPLES_PER_PERIOD * 0.05)
    assert low <= lines.f[0] < low + apart and high - 2.0 * apart <= lines.f[-1] <= high
    assert len(lines.driven) == 2
    none = Lines([Course(long[:28], np.zeros((1, 28)), np.zeros((0, 28)))])  # of six cycles not twice as fast
    assert len(none.f) == 0 and none.driven == [] and none.periods() == []


def test_what_drives_a_model_has_a_frequency_as_near_as_a_log_tells() -> None:
    d = _Driven([1.0], [2.0], 0.1, [4.0], 0.01)
    assert d.has(1.099, False) and not d.has(1.101, False) and d.has(0.901, False)
    assert d.has(2.099, True) and not d.has(2.06, False)
    # 1.5 Hz is six times in four seconds; 0.01 Hz is 0.04 of a turn
    assert d.has(1.509, False) and d.has(1.491, False) and not d.has(1.511, False) and not d.has(1.62, False)


def test_a_driven_line_is_one_of_time_where_it_has_one_phase_in_two_logs() -> None:
    t = 0.02 * np.arange(1000)
    own: Any = SimpleNamespace(driven=[SimpleNamespace(has=lambda g, alone: True)], shortest=20.0)
    wave = _Even(t, np.sin(2.0 * np.pi * 1.3 * t)[None])
    same, other = (_Even(t + late, np.sin(2.0 * np.pi * 1.3 * (t + late + off))[None]) for late, off in
                   ((7.3, 0.0), (7.3, 0.5 / 1.3)))  # fmt: skip
    line = spectral_lines._Line(1.3, [wave, same], 1, 0.5)
    assert [p for p, _ in Lines._own(own, [line])] == [pytest.approx(1.0 / 1.3)]
    assert Lines._own(own, [line._replace(parts=[wave, other])]) == []
    assert Lines._own(own, [line._replace(parts=[wave])]) == []


def test_times_that_are_nearly_even_are_left_as_they_are() -> None:
    t = np.arange(50.0)
    row = np.sin(t)[None]
    for off, moved in ((0.09, False), (0.11, True)):
        late = t.copy()
        late[20] += off * 49.0 / 50.0
        even = _even(late, row, straight=False)
        assert (even.rows[0, 20] != row[0, 20]) == moved and even.t[[0, -1]].tolist() == [0.0, 49.0]
        if moved:
            assert even.rows[0] == pytest.approx(np.interp(t, late, row[0]))


@pytest.mark.parametrize("f", [1.2, 1.2345])
def test_a_line_s_frequency_is_found_beside_its_bin(f: float) -> None:
    t = 0.02 * np.arange(1500)
    wave = _Even(t, np.cos(2.0 * np.pi * f * t + 0.4)[None])
    assert _highest([wave], f + 0.3 / 30.0, 30.0) == pytest.approx(f, abs=3e-3)


def test_a_signal_repeats_itself_where_it_is_alike_again_after_it_was_not() -> None:
    assert spectral_lines._repeats(np.sin(0.01 * np.arange(60.0)) + 2.0, 0.5) == []  # it is alike all the time
    x = np.tile(white(3, 40), 5)
    assert spectral_lines._repeats(x, 0.5)[0] / 20.0 == pytest.approx(round(spectral_lines._repeats(x, 0.5)[0] / 20.0))


def test_a_period_along_a_channel_that_only_goes_with_time_is_none() -> None:
    t = 0.01 * np.arange(3000)
    none = [np.zeros((0, 3000))]
    for swing, found in ((0.5, False), (9.0, True)):  # off from a straight line by less and by more than three periods
        way = 5.0 * t + swing * np.sin(0.7 * t)
        error = [np.sin(2.0 * np.pi * way / 3.7)[None] + 0.1 * white(3, 1, 3000)]
        assert bool(spectral_lines.periods_along([way], [t], error, none)) == found
    way = 5.0 * t + 9.0 * np.sin(0.7 * t) + 4.0 * np.sin(0.23 * t)
    three = sum(np.sin(2.0 * np.pi * way / p) * a for p, a in ((3.7, 1.0), (2.9, 2.0), (2.3, 1.5)))
    got = spectral_lines.periods_along([way], [t], [np.asarray(three)[None] + 0.1 * white(4, 1, 3000)], none)
    assert len(got) == MOST_PERIODS and set(np.round(got, 1)) <= {3.7, 2.9, 2.3}


# ---- quantities and screening ----------------------------------------------------------------------------------------


def test_a_lag_is_no_shorter_than_samples_tell_and_no_longer_than_logs() -> None:
    t = 0.1 * np.arange(601)
    s = SimpleNamespace(kind="static", unit_of_position="", position="", velocity="", inputs={"u": "V", "flat": "V"})

    def column(k: int, name: str) -> Array:
        return np.ones(601) if name.endswith("flat") else np.sin(t)

    data = SimpleNamespace(records=[SimpleNamespace(t=t)], column=column)
    bound: Any = SimpleNamespace(system=s, data=data)
    found = regressors._remembering(bound, {"u", "flat"})
    names = [q.name for q in found]
    assert names[-1] == "stops_of_u" and len(names) == 4 and not any("flat" in n for n in names)
    first = found[0]
    low, high = 0.3, 0.125 * 60.0
    tau = low * (high / low) ** (1.0 / 6.0)
    assert first.slower is not None
    for limit, inside in ((0.5 * low, 1.02), (2.0 * high, 0.98)):
        assert first.slower(inside * limit / tau) is not None
        assert first.slower(limit / inside / tau) is None
    data.records[0].t = t[:91]  # 9 s: its longest lag is not four times its shortest
    assert [q.name for q in regressors._remembering(bound, {"u"})] == ["stops_of_u"]
    assert regressors._remembering(bound, set()) == []


def test_what_a_gain_of_time_would_do_has_the_periods_of_its_place(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []

    class Found:
        def __init__(self, courses: Any):
            self.courses = courses

        def found(self, times: Any = ()) -> list[tuple[float, int]]:
            asked.append([np.asarray(w).tolist() for w in times])
            return [(3.0, 2)] if len(times) else [(1.0, 2)]

        def fast(self) -> list[tuple[float, int]]:
            return [(3.0015, 2), (5.0, 4)]

    monkeypatch.setattr(screening, "Lines", Found)
    monkeypatch.setattr(Candidate, "every", lambda self, period, harmonics=2: (self.how, period, harmonics))
    still = Course(T, np.ones((1, N)), np.zeros((0, N)))
    moved = still._replace(error=np.full((1, N), 1.5))
    courses = iter([[moved], [moved]])
    given: list[Any] = []

    def simulated(curves: Any, theta: Array) -> Any:
        given.append((curves, theta))
        return next(courses)

    ground = SimpleNamespace(courses=simulated)
    learner: Any = SimpleNamespace(ground=ground)
    current: Any = SimpleNamespace(curves=("before",), fit=SimpleNamespace(theta=np.array([2.0])))
    over = [candidate("time", how=how) for how in ("output adds", "output times", "input times")]
    out: Any = screening._in_time(learner, current, over, [still])
    assert out == [("output adds", 1.0, 2), ("output times", 3.0, 2), ("input times", 3.0, 2), ("input times", 5.0, 4)]
    assert asked[0] == [] and asked[1] == asked[2] == [[[0.5] * N]]  # what a constant does to the error
    curves, theta = given[0]
    assert curves[0] == "before" and len(curves) == 2 and theta[:2].tolist() == [2.0, 0.01] and not theta[2:].any()


def test_a_wave_along_a_channel_is_fitted_from_three_periods(monkeypatch: pytest.MonkeyPatch) -> None:
    c = candidate("u").every(0.5)
    span = float(np.ptp(U))
    assert c.quantity.span == pytest.approx(span)
    costs = iter([50.0, 30.0, 40.0])
    asked: list[float] = []

    def fit(current: Any, c: Any, wiggle: float, begin: Array, steps: int, quick: bool) -> Any:
        asked.append(c.quantity.period)
        assert begin[0] == 2.0 and not begin[1:].any() and steps == 8 and quick
        return SimpleNamespace(fit=SimpleNamespace(cost=np.array([next(costs)]), theta=np.full(2, asked[-1])))

    monkeypatch.setattr(screening, "best_step", lambda *_, cut_off: screening.Step(45.0, np.zeros(2), 1.0))
    learner: Any = SimpleNamespace(fitted=fit, judge_of=lambda *_: None)
    current: Any = SimpleNamespace(curves=(), fit=SimpleNamespace(theta=np.array([2.0])))
    (left, best, theta), said = screening._promise(learner, current, c, [(np.zeros(1), None)])  # type: ignore[list-item]
    wanted = [0.5 * (1.0 + turns * 0.5 / span) for turns in (0.0, -0.25, 0.25)]
    assert asked == pytest.approx(wanted, rel=1e-3) and left == said == 30.0
    assert best.quantity.period == pytest.approx(wanted[1], rel=1e-3) and theta[0] == asked[1]
    over_time = candidate("time", x=T).every(0.5)
    monkeypatch.setattr(
        screening, "best_step",
        lambda fit, effect, judge, begin, slopes, cut_off: screening.Step(45.0 - begin[0], begin, 1.0),
    )  # fmt: skip
    starts: Any = [(np.zeros(1), None), (np.ones(1), None)]
    found, promised = screening._promise(learner, current, over_time, starts)
    assert found[0] == 44.0 and promised == 1.0 and len(asked) == 3  # the better start, and no fit
    slips = candidate("stops_of_u")
    assert screening._promise(learner, current, slips, starts)[0][0] == 45.0  # from the fit alone


@pytest.mark.parametrize(("room", "starts"), [(0.9e-6, 2), (1.1e-6, 1)])
def test_another_start_is_taken_where_a_parameter_is_at_its_bound(
    room: float, starts: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(screening, "Linearisation", lambda judge, theta, free, prior: theta.tolist())
    stage = SimpleNamespace(parameters=("a", "b"), neutral=lambda: np.array([0.5, 0.6, 0.0]))
    judge: Any = SimpleNamespace(
        stage=stage, bounds=lambda: (np.array([0.0, 0.0, 7.0]), np.ones(3)), scale=np.array([2.0, 1.0, 1.0])
    )
    fit: Any = SimpleNamespace(theta=np.array([1.0 - 2.0 * room, 0.3, 7.0]), free=np.arange(3), prior=np.zeros(3))
    found = screening.starts_of(judge, fit)
    assert len(found) == starts and found[0][0] is fit.theta and found[0][1] == fit.theta.tolist()
    if starts == 2:
        assert found[1][0].tolist() == found[1][1] == [0.5, 0.6, 7.0]  # type: ignore[comparison-overlap]


def test_two_readings_that_differ_by_their_noise_are_compared_without_it() -> None:
    r = SimpleNamespace(name="log", t=T)
    bound: Any = SimpleNamespace(data=SimpleNamespace(records=[r], logs={"log": slice(0, N)}))
    slow = np.sin(0.4 * T)
    for noise, filtered in ((0.02, False), (0.3, True)):
        d = slow + noise * white(9, N)
        got = regressors.difference(bound, d + 1.0, np.ones(N))
        assert (np.abs(got - d).max() > 1e-6) == filtered
        assert np.std(got - slow) < (0.7 * noise if filtered else 1.1 * noise)


# ---- what a search hands on, and what its law files say --------------------------------------------------------------


def test_a_reading_is_further_than_what_the_model_says_within_as_much_again_of_its_range() -> None:
    read = np.linspace(0.0, 4.0, 41)
    for said, taken in ((-4.01, False), (-3.99, True), (7.99, True), (8.01, False), (2.0, False), (2.1, True)):
        got = _further(read, np.full(41, said))
        assert got[20] == (said if taken else 2.0)  # beside the middle
    low_only, high_only = _further(read, np.full(41, -3.0)), _further(read, np.full(41, 3.0))
    assert low_only.tolist() == [-3.0] * 41  # 5 from the middle: further than any reading
    assert high_only.tolist() == [v if abs(v - 2.0) >= 1.0 else 3.0 for v in read.tolist()]


def noting(into: list[Any], answer: Any = None, last: bool = False) -> Any:
    """A function that notes what it is called with, all or the last, and gives an answer."""

    def called(*given: Any) -> Any:
        into.append(given[-1] if last else given)
        return answer

    return called


def test_laws_with_names_are_held_against_curves_by_their_own_errors() -> None:
    learner: Any = chooser()
    asked: list[Any] = []
    learner.ground.errors = noting(asked, {"log": np.ones((1, 3))})
    law = tried("a", 2.0)
    got = learner._as_tried(candidate(), law.judge, law.fit)
    assert asked == [((), law.fit.theta, law.fit.effects)] and got.errors["log"].tolist() == [[1.0] * 3]
    assert got.fit is law.fit and got.judge is law.judge and got.curves == () and got.wiggle == 0.0


def test_a_search_screens_and_finishes_with_its_own_numbers_of_lags_and_bends(monkeypatch: pytest.MonkeyPatch) -> None:
    learner, _ = finalists_of(monkeypatch, {"u": 1.0}, fails=lambda t: False)
    asked: list[Any] = []
    monkeypatch.setattr(learning, "screened", noting(asked, (1.0, [])))
    assert learner.finalists(CURRENT) == [] and asked[0][2:] == (24, 1.8)
    t, quick = tried("u"), tried("u")
    del learner._finished  # its own
    t.judge.stage = quick.judge.stage = learner.judge.stage = SimpleNamespace(t=np.zeros(9), grain=1.0)
    asked.clear()

    def smooth(*given: Any) -> Any:
        asked.append(given[3:])
        return t

    monkeypatch.setattr(learning, "smoothed", smooth)
    learner._with_its_lag = noting(asked, t, last=True)
    assert learner._finished(CURRENT, quick) is t and asked == [(quick.fit, (0.1, 1.0, 5.0)), (1.8,)]
    quick.judge.stage = SimpleNamespace(t=np.zeros(8), grain=1.0)  # an excerpt: only its parameters go on
    asked.clear()
    learner._finished(CURRENT, quick)
    assert asked[0][0] is quick.fit.theta
    known = np.ones(9, dtype=bool)
    learner.ground.noise_known = True
    monkeypatch.setattr(FittedCandidate, "forgotten", lambda self: known)
    asked.clear()
    learner._finished(CURRENT, quick)
    assert asked[1] == (t.fit, (0.1, 1.0, 5.0), t.wiggle) and asked[2] == (1.8,)
    asked.clear()
    learner._settled = lambda current, t: t
    learner.objection = lambda before, t: ""
    learner._as_learned(CURRENT, t)
    assert asked == [(1.3, 1.1, 1.03)]


def test_a_finer_curve_and_one_that_jumps_begin_where_the_curve_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    learner: Any = chooser()
    asked: list[Any] = []

    def fit(*given: Any, **more: Any) -> str:
        asked.append((given, more))
        return "fitted"

    learner.fitted = fit
    learner._begun = lambda coarse, fine: "begun"
    monkeypatch.setattr(FittedCandidate, "slopes", lambda self, beside=True: "slopes")
    coarse = fitted(candidate(), measured(1))
    assert learner._finer(CURRENT, coarse) == "fitted"
    (current, fine, wiggle, begin, steps), more = asked[0]
    assert current is CURRENT and fine.splines == 28 and len(fine.basis.bend) > len(coarse.candidate.basis.bend)
    assert (wiggle, begin, more) == (5.0, "begun", {"slopes": "slopes"})
    assert learner._finer(CURRENT, replace(coarse, candidate=fine)) is None  # it is as fine already
    ends: list[Any] = []
    learner._finished = noting(ends, "finished", last=True)
    learner.ground.jumps = True
    assert learner._jumping(CURRENT, coarse) == "finished"
    assert ends[0].candidate.jump and ends[0].fit.theta.tolist() == [*coarse.fit.theta, 0.0]
    learner.ground.jumps = False
    assert learner._jumping(CURRENT, coarse) is None
    same = candidate()
    again = replace(coarse, candidate=same)
    assert CurveSearch._begun(learner, again, same) is coarse.fit.theta
    n = len(coarse.fit.theta)
    moved = CurveSearch._begun(learner, again, fine)
    assert moved[0] == coarse.fit.theta[0] and len(moved) == 1 + len(fine.parts) != n


def test_of_plainer_curves_those_of_the_same_channel_come_first_and_then_those_at_its_place(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    names = {f"u_lagged_by_{k}_s": 1.0 + 0.001 * k for k in range(1, 7)}
    learner, finished = finalists_of(monkeypatch, names | {"w": 1.05, "v": 1.06, "u": 3.0}, fails=lambda t: False)
    learner.finalists(CURRENT)
    assert finished[:5] == list(names)[:5] and finished[5:] == ["u", "w"]  # two at most, however poor the first


def test_periods_are_tried_by_turns_over_the_whole_way() -> None:
    learner: Any = chooser()
    c = candidate("u").every(0.5)
    t = replace(tried("u"), candidate=c)
    asked: list[float] = []
    learner._slower = noting(asked, last=True)
    learner._with_its_lag(CURRENT, t, (1.8,))
    share = c.quantity.period / c.quantity.span
    wanted = [f for turns in PERIOD_TURNS for f in (1.0 + turns * share, 1.0 / (1.0 + turns * share))]
    assert asked == pytest.approx(wanted)


def test_a_law_file_is_held_to_its_curve_at_places_over_its_range_or_one_period() -> None:
    def places(law: Any) -> list[float]:
        text = python_law(law)
        line = next(row for row in text.splitlines() if row.strip().startswith("for q, y in "))
        return [q for q, _ in eval(line.strip().removeprefix("for q, y in ").rstrip(":"))]

    line = Formula("line", "2 q", {"a": 2.0}, 1.0, 2)
    plain, along = made("output adds", "y", "y", line), made("output adds", "y", "y_every_0p5", line, period=0.5)
    over_time = made("output adds", "y", "time_every_500_ms", line, period=0.5)
    for law in (plain, over_time):
        assert places(law) == pytest.approx(np.linspace(-2.0, 2.0, LAW_TEST_VALUES).tolist())
    step = 4.0 / LAW_TEST_VALUES  # of what repeats itself the end is the beginning
    assert places(along) == pytest.approx([-2.0 + step * k for k in range(LAW_TEST_VALUES)])
    bare = replace(plain, of_unit="", unit="", error_before=12.345, error_after=0.98765)
    text = python_law(bare)
    assert "q is y (-); the curve is in -." in text and "12.3 noise floors without it, 0.988 with it." in text
    assert "q is y (V); the curve is in V." in python_law(plain)
    assert product_of("line", "line").goes_on == (0.0, 0.0) and plain.reach == (0.0, 0.0)
