"""Formulas, products and surfaces in the place of what was learned, in a user's own map of two inputs, whose law is
known; what candidates, quantities and lines there are.
"""

from __future__ import annotations

from collections import namedtuple
from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.small_logs import white
from tests.test_curve_choice_spec import chooser, ordering, tried
from vaneloop import Record, System, unknown
from vaneloop.base.forms import FORMS
from vaneloop.identification.candidates.closed_forms import Formula
from vaneloop.identification.results import rms_of
from vaneloop.identification.subsystem import Array
from vaneloop.identification.unmodelled import (
    curve_candidates,
    curve_choice,
    learning,
    regressors,
    screening,
    surface_search,
)
from vaneloop.identification.unmodelled.closed_form_fits import (
    Product,
    fitted_formulas,
    fitted_products,
    goes_on,
    likely,
    likely_products,
    reach_of,
)
from vaneloop.identification.unmodelled.curve_candidates import (
    Candidate,
    SurfaceCandidate,
    UserModelCandidates,
    surface_of,
    with_curves,
)
from vaneloop.identification.unmodelled.curve_choice import as_the_law
from vaneloop.identification.unmodelled.fitted_candidate import FittedCandidate
from vaneloop.identification.unmodelled.learned_law import law_of, surface_law_of
from vaneloop.identification.unmodelled.learning import CurveSearch
from vaneloop.identification.unmodelled.regressors import Quantity, _acting, _differences, quantities
from vaneloop.identification.unmodelled.screening import screened, smoothed
from vaneloop.identification.unmodelled.spectral_lines import Course, Lines, _driven, _repeats
from vaneloop.identification.user_models.by_log import bind
from vaneloop.identification.user_models.terms import COLUMN, INPUT, OUTPUT

# docs/settings.md
RIVAL, LEAST_LAG_GAIN, PER_PARAMETER, FINER_SLOPES, MOST_PERIODS, HARM = 0.05, 0.002, 0.01, 0.025, 2, 0.1
DERIVATIVE_PLACES, MOST_DIFFERENCES = 5, 2

N = 200
T = 0.1 * np.arange(N)
U = 1.5 * np.sin(0.9 * T) + 0.7 * np.sin(2.3 * T + 1.0)
W = 2.0 + np.cos(0.37 * T) + 0.5 * np.sin(1.9 * T)


def gain(u: Any, p: Any) -> Any:
    return p.a * u.u


def ground_of(
    law: Any,
    places: list[str],
    test: Any = None,
    noise: float = 0.01,
    first: tuple[Array, Array] = (U, W),
    t: Array = T,
) -> UserModelCandidates:
    """y = 2 u and a law of u and w, on a ``first`` log and perhaps a ``test`` log that goes further."""
    s = System("map", "static", gain, inputs={"u": "V", "w": "A"}, outputs={"y": "V"},
               parameters=[unknown("a", 2.0, "-")], **({"places": places} if places else {}))  # fmt: skip
    records = []
    for k, (x, z) in enumerate((first, *([test] if test is not None else []))):
        y = 2.0 * x + law(x, z) + noise * white(k, len(x))
        records.append(Record("log" if k == 0 else "test", t, {"u": x, "w": z, "y": y}))
    return UserModelCandidates(bind(s, records[:1], records[1:]))


def learner_on(ground: UserModelCandidates) -> tuple[CurveSearch, FittedCandidate]:
    d: Any = SimpleNamespace(
        base=SimpleNamespace(theta=np.array([2.0])), verdict="unknown", effects=[], nearest=[],
        final=SimpleNamespace(effects=(), theta=np.array([2.0])),
    )  # fmt: skip
    learner = CurveSearch(ground, d)
    return learner, FittedCandidate(learner.candidates[0], 0.0, learner.judge, learner.base, ())


def named(learner: CurveSearch, name: str) -> Candidate:
    return next(c for c in learner.candidates if c.name == name)


def curve(learner: CurveSearch, nothing: FittedCandidate, name: str) -> FittedCandidate:
    c = named(learner, name)
    begin = np.append(nothing.fit.theta, np.zeros(len(c.parts)))
    return smoothed(learner, nothing, c, begin, (0.1, 1.0, 5.0))


@cache
def cubed() -> tuple[CurveSearch, FittedCandidate, FittedCandidate]:
    """A cubic law of w on the reading, with a test log that goes half as far again."""
    learner, nothing = learner_on(ground_of(lambda u, w: 0.05 * w**3, ["y"], (U, 1.5 * W)))
    return learner, nothing, curve(learner, nothing, place(learner, "w"))


def place(learner: CurveSearch, of: str, how: str = "output adds") -> str:
    return next(c.name for c in learner.candidates if c.how == how and c.quantity.name == of)


# ---- a formula in a curve's place ------------------------------------------------------------------------------------


def test_a_formula_is_fitted_in_its_curve_s_place_and_becomes_the_law() -> None:
    learner, nothing, t = cubed()
    ground = learner.ground
    assert rms_of(t.judge, t.fit) < 1.1 < 5.0 < rms_of(nothing.judge, nothing.fit)
    formulas = t.formulas = fitted_formulas(ground, t)
    by_form = {f.form: (f, fit) for f, fit in formulas}
    cube, fit = by_form["cube"]
    assert cube.numbers["a"] == pytest.approx(0.05, rel=0.02) and cube.error < 1.1 and fit.form == "cube"
    assert cube.text == f"{cube.numbers['a']:.4g} w^3" and cube.level == pytest.approx(0.0, abs=1e-12)
    assert rms_of(fit.judge, fit.fit) == cube.error and fit.curves[-1][0].curve is not None
    scores = [np.log(f.error) + 0.01 * len(f.numbers) for f, _ in formulas]
    assert scores[0] < min(scores) + 0.02
    law = law_of(ground, (nothing.judge, nothing.fit), t)
    assert law.formulas and law.formulas == likely(t, t.formulas or [], rms_of(nothing.judge, nothing.fit))
    now, (said,) = curve_choice.spoken(learner, [t], [law])
    assert said.spoken is not None and said.spoken.form == "cube" and now is not t
    assert said.spoken.numbers["a"] == pytest.approx(0.05, rel=0.02)
    low, high = law.x[0], law.x[-1]
    assert said.reach[1] > high + 0.5 * (high - low) and said.reach[1] <= 2.0 * high - low + 1e-9
    assert said.error_after == rms_of(now.judge, now.fit) < 1.1
    assert len(now.fit.theta) == 2 and now.fit.theta[1] == pytest.approx(0.05, rel=0.02)
    before, after = ground.errors(t.curves, t.fit.theta), ground.errors(now.curves, now.fit.theta)
    assert np.sqrt(np.mean(after["test"] ** 2)) < 0.3 * np.sqrt(np.mean(before["test"] ** 2))  # a formula goes on


def test_a_curve_says_where_it_was_learned_and_how_far_its_formula_may_go() -> None:
    learner, _, t = cubed()
    ground: Any = learner.ground
    c = t.candidate
    assert ground.reach(c) == (2.0 * c.basis.low - c.basis.high, 2.0 * c.basis.high - c.basis.low)
    period = replace(c.quantity, name="time_every_2_s", span=9.0)
    assert ground.reach(replace(c, quantity=period)) == (c.basis.low, c.basis.high)
    inside = ground.within(c)["test"]
    assert np.array_equal(inside, c.basis.reaches(1.5 * W)) and 0.2 < inside.mean() < 0.9
    (course,) = ground.courses((), learner.base.theta)
    y = 2.0 * U + 0.05 * W**3 + 0.01 * white(0, N)
    said = learner.base.theta[0] * U
    assert course.error[0] == pytest.approx((said - y) / ground.floor[0]) and course.said[0] == pytest.approx(said)
    assert course.read["y"] == pytest.approx(y) and course.drivers == pytest.approx(np.array([U, W]))
    lost = with_curves(ground.logs.fitted, (), ())
    first = ground.logs.fitted.measured[0, 5]
    lost.measured[0, 5] = np.nan
    (gap,) = ground.courses((), learner.base.theta)
    assert gap.error[0, 5] == 0.0 and gap.error[0, 6] != 0.0 and gap.read["y"][5] == pytest.approx(said[5])
    lost.measured[0, 5] = first
    assert set(ground.errors((), learner.base.theta)) == {"log", "test"} and ground.elsewhere((), np.zeros(1)) == {}
    assert not ground.shares and ground.tests == {"test"}
    tested = {name: ground._tested(q) for name, q in (
        ("w", c.quantity), ("u", Quantity("u", "V", INPUT, U)), ("time", Quantity("time", "s", COLUMN, T)),
        ("u_minus_w", Quantity("u_minus_w", "V", INPUT, U - W, less=(INPUT + 1, "w"))),
        ("w_every_0p7", Quantity("w_every_0p7", "A", INPUT + 1, W % 0.7, span=2.0)),
    )}  # fmt: skip
    assert tested["w"] == pytest.approx(1.5 * W) and tested["u"] == pytest.approx(U)
    assert tested["time"] == pytest.approx(T) and tested["u_minus_w"] == pytest.approx(U - 1.5 * W)
    assert tested["w_every_0p7"] == pytest.approx(1.5 * W % 0.7)


def test_slopes_of_the_model_s_own_parameters_are_taken_over_finer_steps() -> None:
    ground: Any = cubed()[0].ground
    bound = with_curves(ground.logs.fitted, (), ())
    for mine, was in zip(bound.stage.parameters, ground.logs.fitted.stage.parameters, strict=False):
        assert mine.scale == pytest.approx(FINER_SLOPES * was.scale)
    assert bound.stage.carries and bound.stage.effects == () and bound.stages == [bound.thinned]


def test_a_level_goes_back_into_the_parameter() -> None:
    """A gain that is a constant of w, and the parameter that has it."""
    learner, nothing = learner_on(ground_of(lambda u, w: 0.3 * u * (w - 2.0), []))
    t = curve(learner, nothing, place(learner, "w", "parameter times"))
    assert not t.candidate.mean and rms_of(t.judge, t.fit) < 1.2
    formula, alone = next((f, a) for f, a in fitted_formulas(learner.ground, t) if f.form == "line")
    assert formula.level != 0.0  # it comes less its mean
    got = curve_choice._in_place(learner.ground, t, 0, t.candidate, formula, alone)
    assert got is not None
    now, said = got
    # 2 u + 0.3 u (w - 2) = a u (1 + b w) with a = 1.4, b = 0.3 / 1.4
    assert now.fit.theta[0] == pytest.approx(1.4, rel=0.02) and said.numbers["a"] == pytest.approx(0.3 / 1.4, rel=0.05)
    assert said.level == 0.0 and said.error == rms_of(now.judge, now.fit) < 1.2
    gone = replace(formula, level=-0.95)
    assert curve_choice._in_place(learner.ground, t, 0, t.candidate, gone, alone) is None


# ---- a surface and its product ---------------------------------------------------------------------------------------


@cache
def crossed() -> tuple[CurveSearch, FittedCandidate, FittedCandidate]:
    """A law of both inputs together, 0.4 u w, on the reading."""
    learner, nothing = learner_on(ground_of(lambda u, w: 0.4 * u * w, ["y"], (1.3 * U, 1.3 * W)))
    s = surface_of(named(learner, place(learner, "u")), named(learner, place(learner, "w")))
    assert s is not None
    learner.ranked = [[curve(learner, nothing, place(learner, "u"))]]
    begin = surface_search._begin(learner, nothing, s)
    assert begin[: len(nothing.fit.theta)] == pytest.approx(learner.ranked[0][0].fit.theta[:1])
    along = dict(zip(s.pairs, begin[1:], strict=True))
    assert any(along[ij] for ij in along if ij[1] == 0) and not any(along[ij] for ij in along if ij[1] > 0)
    learner.ranked = [[]]
    plain = surface_search._begin(learner, nothing, s)
    assert plain.tolist() == [*nothing.fit.theta, *[0.0] * len(s.pairs)]
    return learner, nothing, smoothed(learner, nothing, s, plain, (0.1, 1.0, 5.0))


def test_a_product_is_fitted_in_its_surface_s_place_and_becomes_the_law() -> None:
    learner, nothing, t = crossed()
    ground = learner.ground
    assert rms_of(t.judge, t.fit) < 1.6
    t.formulas = fitted_products(ground, t)
    assert len(t.formulas) >= 2
    best, fit = t.formulas[0]
    assert isinstance(best, Product) and best.form == "line" and best.numbers["a"] == pytest.approx(0.4, rel=0.05)
    assert (
        best.error < 1.1 and fit.form == f"line times {best.second_form}" and rms_of(fit.judge, fit.fit) == best.error
    )
    law = surface_law_of((nothing.judge, nothing.fit), t)
    assert law.formulas == likely_products(t, rms_of(nothing.judge, nothing.fit))
    own, its = reach_of(ground, t, best)
    c: Any = t.candidate
    assert own == (2.0 * c.basis.low - c.basis.high, 2.0 * c.basis.high - c.basis.low)
    assert its == pytest.approx((2.0 * c.across.low - c.across.high, 2.0 * c.across.high - c.across.low), rel=0.05)
    got = as_the_law(learner, t, law.formulas)
    assert got is not None
    now, said = got
    assert said.form == "line" and said.numbers["a"] == pytest.approx(0.4, rel=0.05) and said.level == 0.0
    before, after = ground.errors(t.curves, t.fit.theta), ground.errors(now.curves, now.fit.theta)
    assert np.sqrt(np.mean(after["test"] ** 2)) < 0.5 * np.sqrt(np.mean(before["test"] ** 2))  # a product goes on
    assert rms_of(now.judge, now.fit) == said.error < 1.1
    spoken = law.spoken_by(said, (own, its), 1.02)
    assert spoken.spoken is said and spoken.formulas[0] is said and spoken.error_after == 1.02
    assert (spoken.reach, spoken.goes_on) == (own, its)
    assert len(spoken.formulas) == len(law.formulas)  # in the place of the one that it was
    assert as_the_law(learner, t, []) is None
    stranger = replace(best)
    assert as_the_law(learner, t, [stranger]) is None  # only what was fitted


def test_a_surface_is_held_against_the_sum_of_two_curves() -> None:
    learner, nothing, t = crossed()
    apart = surface_search._sum(learner, nothing, t)
    assert isinstance(apart.candidate, SurfaceCandidate) and apart.candidate.additive
    assert rms_of(apart.judge, apart.fit) > 3.0 * rms_of(t.judge, t.fit)
    assert learner.accepts(apart, t) and learner.accepts(nothing, t)
    fine = surface_search._finer(learner, nothing, t)
    assert fine is not None and len(fine.candidate.basis.bend) > len(t.candidate.basis.bend)
    assert rms_of(fine.judge, fine.fit) < 1.7
    learner.ranked = [[t]]
    out: Any = SimpleNamespace(tried=[], notes=[])
    choice = surface_search.SurfaceSelection(learner, out, nothing)
    assert choice.wants_more(nothing) and choice.accepted(nothing, [t]) == [t]
    best = choice.chosen(nothing, [t])
    assert best is not None and best.candidate is t.candidate and best.formulas
    pairs: Any = [t.candidate]
    learner.ranked = [[curve(learner, nothing, place(learner, "u"))]]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(surface_search, "_candidates", lambda learner: pairs)
        (done,) = surface_search._finished(learner, nothing)
    assert done.candidate.name == t.candidate.name and rms_of(done.judge, done.fit) < 1.6


@pytest.mark.parametrize(("apart", "harm", "as_well"), [(0.9, "", True), (1.1, "", False), (0.9, "worse", False)])
def test_a_formula_does_as_well_as_its_surface_where_that_was_learned(apart: float, harm: str, as_well: bool) -> None:
    learner = ordering(objection=lambda before, t: harm)
    surface, formula = tried("u", 1.0), tried("f", float(np.exp(apart * RIVAL)))
    assert surface_search._does_as_well(learner, tried("none", 9.0), surface, formula) == as_well


# ---- the search's own steps ------------------------------------------------------------------------------------------


def test_the_candidates_that_promise_most_are_those_of_the_law() -> None:
    learner, nothing, t = cubed()
    keep = learner.candidates
    wanted = {"w", "u", "time"}
    learner.candidates = [c for c in keep if c.quantity.name in wanted]
    try:
        bare, promising = screened(learner, nothing, 2, 1.8)
        assert bare == pytest.approx(float(learner.base.cost.sum()), rel=0.05)
        assert [p[0] for p in promising] == sorted(p[0] for p in promising)
        assert promising[0][1].quantity.name == "w" and promising[0][0] < 0.2 * bare
        ranked = len(learner.ranked)
        done = learner.finalists(nothing)
        assert done[0].candidate.quantity.name == "w" and len(learner.ranked) == ranked + 1
        assert [learner.score(x, done) for x in done] == sorted(learner.score(x, done) for x in done)
        assert learner.accepts(nothing, done[0])
    finally:
        learner.candidates = keep
    assert learner.score(t) < 0.2


def test_a_curve_without_mean_where_the_logs_do_not_tell_it() -> None:
    """A gain on the parameter has no mean; a slope of u on the reading is the parameter's own."""
    learner, nothing = learner_on(ground_of(lambda u, w: 0.2 * np.sin(3.0 * u), ["y"]))
    t = curve(learner, nothing, place(learner, "u"))
    settled = learner._settled(nothing, t)
    assert 1 in settled.candidate.untold and settled.told is t.fit and 1 in settled.candidate.lent
    assert learner.score(settled) <= learner.score(t) + 0.02 and len(settled.fit.theta) < len(t.fit.theta)
    other, none, c = cubed()
    kept = other._settled(none, c)
    assert kept.candidate.untold in ((), (0,)) and 1 not in kept.candidate.untold  # a cube of w is no gain of u


@pytest.mark.parametrize(
    ("score", "falls", "taken"),
    [(-1.1, 0.0, True), (-0.9, 0.0, False), (-0.9, 1.1, True), (0.9, 1.1, True), (1.1, 9.0, False), (0.9, 0.9, False)],
)
def test_a_lag_is_better_by_its_score_or_by_what_is_left_at_the_noise(
    score: float, falls: float, taken: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    learner = chooser()
    best, more = tried("u", 2.0), tried("u", 2.0 * float(np.exp(-falls * LEAST_LAG_GAIN)))
    best.candidate = replace(best.candidate, quantity=replace(best.candidate.quantity, slower=lambda times: None))
    monkeypatch.setattr(Candidate, "slower", lambda self, times: replace(self, name="slower"))
    monkeypatch.setattr(FittedCandidate, "slopes", lambda self, beside=True: None)
    monkeypatch.setattr(learning, "score", lambda judge, fit: score * LEAST_LAG_GAIN if fit is more.fit else 0.0)
    learner.fitted = lambda *given, **more_given: more  # type: ignore[assignment, method-assign]
    learner._begun = lambda t, c: t.fit.theta  # type: ignore[method-assign]
    assert (learner._slower(tried(), best, 1.3) is more) == taken
    there = tried()
    there.curves = ((SimpleNamespace(effect="slower"), None),)  # type: ignore[assignment]
    assert learner._slower(there, best, 1.3) is None  # it stands in the model already
    monkeypatch.setattr(Candidate, "slower", lambda self, times: None)
    assert learner._slower(tried(), best, 1.3) is None


def test_a_plainer_curve_that_adds_what_another_multiplies() -> None:
    learner = chooser()
    learner.accepts = lambda before, t: False  # type: ignore[method-assign]
    adds, times, other = tried("u", 1.2), tried("u", 1.0, how="output times"), tried("w", 1.0, how="output times")
    assert learner._plainer(tried(), adds, times) and not learner._plainer(tried(), adds, other)
    assert not learner._plainer(tried(), times, adds)
    learner.tested = lambda before, t, among: (0.99 if t is adds else 0.0) * HARM  # type: ignore[method-assign]
    assert learner._plainer(tried(), adds, times)
    learner.accepts = lambda before, t: True  # type: ignore[method-assign]
    assert not learner._plainer(tried(), adds, times)


def test_formulas_are_asked_where_the_best_curve_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[list[str]] = []
    monkeypatch.setattr(
        learning, "all_in_their_place", lambda ground, some: asked.append([t.candidate.quantity.name for t in some])
    )
    learner = chooser()
    learner.left = lambda before, t, good: float(np.log(rms_of(t.judge, t.fit)))  # type: ignore[method-assign]
    best, near, far = tried("w", 2.0), tried("u", 2.2), tried("v", 9.0)
    formula = tried("f", 1.0)
    near.loose = [formula]
    formula.fit.free = np.arange(1)  # type: ignore[misc]
    good = [best, near, far]
    left = {t.candidate.name: float(np.log(rms_of(t.judge, t.fit))) for t in good}
    learner._with_formulas(tried("none", 99.0), good, left)
    assert asked[0] == ["w", "u"] and left["y.curve_of_u"] == pytest.approx(2.0 * PER_PARAMETER)  # as many numbers
    assert left["y.curve_of_w"] == pytest.approx(np.log(2.0))
    asked.clear()
    clean, own = tried("w", 1.0), tried("y", 1.1)
    left = {t.candidate.name: float(np.log(rms_of(t.judge, t.fit))) for t in (clean, own)}
    learner._with_formulas(tried("none", 99.0), [clean, own], left)
    assert asked == [["y"]]  # those of what is plainer
    own.loose = [tried("f", 0.9)]
    asked.clear()
    learner._with_formulas(tried("none", 99.0), [clean, own], left)
    assert asked == [["y"], ["w"]] and left["y.curve_of_y"] < 0.0  # where that is then before the best, all have theirs


@pytest.mark.parametrize(
    ("verdict", "fails", "named", "says"),
    [
        ("none", False, None, "the model comes down to the noise of its samples: nothing is missing"),
        ("missing", True, 1.05, "a of the library leaves nothing but noise"), ("missing", True, 1.5, ""),
        ("unknown", False, None, ""),
    ],
)  # fmt: skip
def test_nothing_is_learned_where_nothing_or_a_law_with_a_name_is_missing(
    verdict: str, fails: bool, named: float | None, says: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    learner = chooser()
    learner.d = SimpleNamespace(  # type: ignore[assignment]
        verdict=verdict, effects=["a"] if named else [], final=SimpleNamespace(effects=("a",))
    )
    learner.form = SimpleNamespace(fails=lambda fit: fails)  # type: ignore[assignment]
    learner.base, learner.candidates = tried("none", 5.0).fit, []
    law = tried("a", named or 1.0)
    learner._named = lambda: (law.judge, law.fit) if named else None  # type: ignore[assignment, method-assign]
    learner._concluded = lambda out, named: out  # type: ignore[method-assign]
    out = learner.learned()
    assert out.why == says and out.verdict == ("named" if says.startswith("a of") else "none") and out.decisions == []


def test_laws_with_names_are_fitted_as_the_diagnosis_found_them() -> None:
    learner = chooser()
    index = {"a": slice(1, 2), "b": slice(2, 4)}
    asked: list[Any] = []
    stage = SimpleNamespace(neutral=lambda: np.zeros(4), index=lambda: {"b": slice(1, 3)})
    judge: Any = SimpleNamespace(stage=stage, fit=lambda effects, theta, steps: asked.append((effects, theta.tolist())))
    learner.judge_of = lambda laws, curves: judge  # type: ignore[assignment, method-assign]
    learner.base = SimpleNamespace(theta=np.zeros(1))  # type: ignore[assignment]
    effect = SimpleNamespace(starts=((7.0, 8.0), (9.0, 9.0)))
    learner.ground.whole = SimpleNamespace(index=lambda: index, effect=lambda name: effect)
    final = SimpleNamespace(effects=("b",), theta=np.array([2.0, 3.0, 4.0, 5.0]))
    learner.d = SimpleNamespace(final=final, nearest=["b", "a"])  # type: ignore[assignment]
    learner._named()
    learner.d = SimpleNamespace(final=SimpleNamespace(effects=(), theta=final.theta), nearest=["b", "a"])  # type: ignore[assignment]
    judge.stage.neutral = lambda: np.zeros(3)
    learner._named()
    assert asked == [(("b",), [2.0, 4.0, 5.0, 0.0]), (("b",), [2.0, 7.0, 8.0])]
    learner.d = SimpleNamespace(final=SimpleNamespace(effects=()), nearest=[])  # type: ignore[assignment]
    assert learner._named() is None


# ---- quantities and places of models that move -----------------------------------------------------------------------

X = namedtuple("X", "h1 h2")
P = namedtuple("P", "c")
IN = namedtuple("IN", "q")


def tanks(x: Any, u: Any, p: Any) -> tuple[float, float]:
    """Two tanks: one runs into the other."""
    return u.q - p.c * (x.h1 - x.h2), p.c * (x.h1 - x.h2) - 0.1 * x.h2


def moving(**more: Any) -> Any:
    """A stand-in for a model that moves, bound to one log."""
    given: dict[str, Any] = {
        "kind": "simulate", "model": tanks, "states": {"h1": "m", "h2": "m"}, "inputs": {"q": "m"},
        "outputs": {"h1": "m", "level": "m"}, "commands": {}, "unit_of_position": "m", "position": "", "velocity": "",
        "parameters": [SimpleNamespace(name="c", value=0.3, tolerance=0.0)], "rates": {}, "masses": {},
        "unit_of_force": lambda name: "N", "allows": lambda kind, name: True,
        "reading_of": lambda name: f"{name}_sensor",
    }  # fmt: skip
    s = SimpleNamespace(**given | more)
    h = np.array([1.0 + 0.2 * np.sin(T), 0.5 + 0.1 * np.cos(0.7 * T)])
    columns = {"q": U, "h1": h[0], "level": h[1], "oil": 40.0 + T}
    record = SimpleNamespace(name="log", t=T, columns=columns)
    data = SimpleNamespace(
        records=[record], in_names=list(s.inputs), u=[np.array([U])], times=[T], logs={"log": slice(0, N)},
        column=lambda k, name: columns.get(name, T if name == "time" else np.abs(np.sin(T))),
    )  # fmt: skip
    code = SimpleNamespace(X=X, U=IN, P=P)
    return SimpleNamespace(
        system=s, data=data, measured=np.array([h[0], h[1]]), t=T, runner=SimpleNamespace(code=code), h=h
    )


def test_states_and_what_drives_a_model_are_quantities_and_so_are_their_differences() -> None:
    bound = moving()
    states = [[bound.h[0]], [bound.h[1]]]
    found = {q.name: q for q in quantities(bound, np.array([0.3]), states)}
    assert (found["h1"].of, found["h2"].of, found["q"].of, found["level"].of) == (0, 1, INPUT, OUTPUT + 1)
    assert found["h2"].visited == pytest.approx(bound.h[1]) and found["level"].visited == pytest.approx(bound.h[1])
    assert found["h1_minus_h2"].less == (1, "h2") and found["h1_minus_h2"].of == 0
    assert found["h1_minus_h2"].visited == pytest.approx(bound.h[0] - bound.h[1])
    assert found["oil"].of == found["time"].of == COLUMN and "stops_of_q" in found
    closed = moving(kind="closed_loop", commands={"level": "m", "gone": "m"}, inputs={}, outputs={"h1": "m"})
    closed.data.in_names = []
    names = {q.name: q.of for q in quantities(closed, np.array([0.3]), states)}
    assert names["level"] == INPUT and "gone" not in names  # a command that no log has
    again = moving(states={}, kind="static")
    assert "h1" in {q.name for q in quantities(again, np.array([0.3]))}


def test_of_many_differences_those_come_first_that_the_model_has() -> None:
    bound = moving()
    visited = {"h1": bound.h[0], "h2": bound.h[1], "q": U}
    acting = _acting(bound, np.array([0.3]), visited)
    # h1 rises by q and falls by itself; it falls by h1 and rises by h2
    assert acting == {("h1", "h2"), ("h2", "h1"), ("h1", "q"), ("q", "h1")}
    bound.system.kind = "force"
    assert _acting(bound, np.array([0.3]), visited) == set()
    bound.system.kind = "simulate"
    bound.system.model = lambda x, u, p: 1 / 0
    assert _acting(bound, np.array([0.3]), visited) == set()  # a model may be nothing there
    names = [f"x{k}" for k in range(6)]
    many = moving(states=dict.fromkeys(names, "m"), inputs={}, outputs={}, kind="simulate")
    have = [Quantity(n, "m", k, white(k, N)) for k, n in enumerate(names)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(regressors, "_acting", lambda *_: {("x3", "x5"), ("x4", "x5")})
        out = [q.name for q in _differences(many, np.zeros(1), have)]
    assert out[:2] == ["x3_minus_x5", "x4_minus_x5"] and len(out) == MOST_DIFFERENCES * len(names)
    assert _differences(many, np.zeros(1), [replace(q, unit="-") for q in have]) == []


def test_places_of_a_model_that_moves(monkeypatch: pytest.MonkeyPatch) -> None:
    bound = moving(rates={"h2": "h1"}, masses={"h2": "m"}, parameters=[
        SimpleNamespace(name="c", value=0.3, tolerance=0.1), SimpleNamespace(name="m", value=4.0, tolerance=0.0),
    ])  # fmt: skip
    states = [[bound.h[0]], [bound.h[1]]]
    known = [Quantity("h1", "m", 0, bound.h[0]), Quantity("h2", "m", 1, bound.h[1]), Quantity("q", "m", INPUT, U),
             Quantity("level", "m", OUTPUT + 1, bound.h[1]),
             Quantity("stops_of_q", "m", COLUMN, np.abs(U), (U,))]  # fmt: skip
    monkeypatch.setattr(curve_candidates, "quantities", lambda *_: known)
    monkeypatch.setattr(curve_candidates, "nominal_course", lambda *_: SimpleNamespace(states=states))
    monkeypatch.setattr(curve_candidates, "_said", lambda *_: np.array(bound.measured))
    out = {c.name: c for c in curve_candidates.candidates(bound, np.array([0.3]))}
    rate = np.sqrt(np.mean(np.gradient(bound.h[1], T) ** 2))
    force = out["h2.curve_of_q"]
    assert (force.how, force.unit, force.place) == ("state adds", "N", 1) and force.size == pytest.approx(4.0 * rate)
    assert "h1.curve_of_q" not in out  # what only follows its rate
    assert out["h2.curve_of_h1"].near and not out["h2.curve_of_q"].near  # a force on what moves is one of its position
    assert not out["c.gain_of_q"].mean and out["m.gain_of_q"].mean
    assert out["q.curve_of_q"].size == pytest.approx(0.15 * np.ptp(U)) and "q.gain_of_q" not in out
    assert out["q.curve_of_stops_of_q"].how == "input adds" and not out["q.curve_of_stops_of_q"].mean
    assert "h2.curve_of_stops_of_q" not in out and "level_sensor.curve_of_stops_of_q" not in out
    assert out["level_sensor.curve_of_level"].unit == "m" and "level_sensor.gain_of_level" not in out
    force_model = moving(kind="force", states={}, outputs={"f": "N"}, position="x", velocity="v", inputs={"q": "m"})
    force_model.measured = np.array([3.0 * np.sin(T)])
    known[:] = [Quantity("position", "m", INPUT, U), Quantity("velocity", "m/s", INPUT + 1, np.cos(T)),
                Quantity("q", "m", INPUT + 3, U), Quantity("f", "N", OUTPUT, 3.0 * np.sin(T))]  # fmt: skip
    out = {c.name: c for c in curve_candidates.candidates(force_model, np.array([0.3]))}
    assert out["force.curve_of_velocity"].size == pytest.approx(0.5 * 3.0 / np.sqrt(2.0), rel=0.02)
    assert out["force.curve_of_velocity"].near and not out["force.curve_of_q"].near and out["q.curve_of_q"].place == 3
    assert {n for n in out if n.startswith("f_sensor.curve")} == {"f_sensor.curve_of_f"}  # what else adds is a force
    assert "force.curve_of_f" not in out


# ---- lines -----------------------------------------------------------------------------------------------------------

S = 0.02 * np.arange(3000)  # s


def tone(hertz: float, size: float = 1.0, phase: float = 0.3) -> Array:
    return np.asarray(size * np.sin(2.0 * np.pi * hertz * S + phase))


def test_the_clearest_lines_come_first_and_two_of_one_place_at_most() -> None:
    error = tone(1.3, 0.5) + tone(2.9, 1.5) + tone(4.7, 1.0) + 0.2 * white(1, 3000)
    lines = Lines([Course(S, error[None], np.zeros((0, 3000)))])
    found = lines.found()
    assert [1.0 / p for p, _ in found] == pytest.approx([2.9, 4.7], abs=0.01) and len(found) == MOST_PERIODS
    assert lines.periods() == [p for p, _ in found]
    other = Course(S + 0.37, error[None], np.zeros((0, 3000)))
    assert [1.0 / p for p, _ in Lines([Course(S, error[None], np.zeros((0, 3000))), other]).found()][
        0
    ] == pytest.approx(2.9, abs=0.01)


def test_a_line_of_what_a_swing_would_do_is_found_at_its_place() -> None:
    signal = 1.0 + 0.8 * np.sin(0.61 * S)
    error = signal * tone(1.7) + 0.2 * white(2, 3000)
    lines = Lines([Course(S, error[None], np.zeros((0, 3000)))])
    found = lines.found([signal[None]])
    assert 1.0 / found[0][0] == pytest.approx(1.7, abs=0.01)
    swing = np.sin(0.61 * S)
    said = Course(S, (tone(4.1) * swing + 0.2 * white(3, 3000))[None], np.zeros((0, 3000)), swing[None])
    fast = Lines([said]).fast()
    assert fast and 1.0 / fast[0][0] == pytest.approx(4.1, abs=0.02)
    assert Lines([said._replace(said=np.zeros((0, 3000)))]).fast() == []


def test_what_drives_a_model_has_its_lines_their_multiples_and_its_repetition() -> None:
    slow = np.cumsum(white(4, 3000)) * 0.02
    swing = np.where((S > 20.0) & (S < 28.0), tone(3.1), 0.0)
    for row, has, alone, driven in (
        (tone(0.8137), 0.8137, False, True), (tone(0.8137), 1.6274, False, True), (tone(0.8137), 1.1, False, False),
        (tone(0.8137) + 0.25 * tone(2.2718), 2.2718, True, True),
        (tone(0.8137) + 0.25 * tone(2.2718), 2.2718, False, False),
        (slow, 1.7, True, False), (swing + 0.5 * slow, 3.1, True, False), (np.zeros(3000), 0.8, True, False),
    ):  # fmt: skip
        d = _driven(Course(S, np.zeros((1, 3000)), row[None]), 5.0)._replace(again=[])
        assert d.has(has, alone) == driven, (has, alone)
    piece = white(5, 500)
    again = np.tile(piece, 6)
    (after,) = _repeats(again - again.mean(), 0.02)
    assert after / 10.0 == pytest.approx(round(after / 10.0)) and after <= 30.0  # or after so many times
    d = _driven(Course(S, np.zeros((1, 3000)), again[None]), 5.0)._replace(most=[], some=[], again=[10.0])
    assert d.has(0.5, False) and not d.has(0.55, False)


def test_a_formula_that_was_learned_with_another_one_is_told_beside_it(monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = tried("u", 2.0), tried("w", 1.5)
    made: list[Any] = []

    def beside(learner: Any, t: Any, pair: Any) -> list[Any]:
        made.append((t, pair))
        return [(Formula("line", "u", {"a": 1.0}, 1.0, 1), better)]

    better = tried("f", 1.2)
    monkeypatch.setattr(curve_choice, "_formulas_beside", beside)
    learner = ordering()
    curve_choice.tell_each_by_its_formula(learner, first, second)
    assert made == [(first, second), (second, better)] and first.formulas and second.formulas
    made.clear()
    better = tried("f", 1.6)  # leaves more than both curves
    curve_choice.tell_each_by_its_formula(learner, first, second)
    assert made == [(first, second)]
    better, learner.speaks = tried("f", 1.2), False
    made.clear()
    curve_choice.tell_each_by_its_formula(learner, first, second)
    assert made == [(first, second)]
    made.clear()
    curve_choice.tell_each_by_its_formula(learner, tried("stops_of_u"), second)
    assert made == []


# ---- what repeats itself, and the steps of the search by themselves --------------------------------------------------


@pytest.mark.parametrize("how", ["output adds", "output times"])
def test_what_repeats_itself_in_time_is_a_candidate_with_its_period(how: str) -> None:
    period, t = 1.7, 0.1 * np.arange(600)
    # what drives it has no line of its own
    x, z = (np.interp(t, np.arange(0.0, 61.0, 0.7), 1.5 * white(k, 88)) for k in (7, 8))

    def law(u: Array, w: Array) -> Array:
        wave = 0.3 * np.sin(2.0 * np.pi * t / period)
        return wave if how == "output adds" else 2.0 * u * wave

    learner, nothing = learner_on(ground_of(law, ["y"], first=(x, 3.0 + z), t=t))
    found = [
        c for c in screening._periodic(learner, nothing) if c.how == how and c.quantity.name.startswith("time_every")
    ]
    assert found and min(abs(c.quantity.period - period) for c in found) < 0.03
    learner.candidates = [replace(c, shape=("odd",)) for c in learner.candidates]
    assert screening._periodic(learner, nothing) == []  # a known shape is no wave


def test_what_repeats_itself_along_a_channel_is_one_where_the_model_tells_it() -> None:
    learner, nothing = learner_on(ground_of(lambda u, w: 0.2 * np.sin(2.0 * np.pi * u / 0.31), ["y"]))
    learner.candidates = [c for c in learner.candidates if c.quantity.name in ("u", "time") and c.how == "output adds"]
    courses = learner.ground.courses((), nothing.fit.theta)
    along = screening._along(learner, courses)
    assert all(c.quantity.name.startswith("u_every") for c in along)
    assert screening._along(learner, [c._replace(said=np.zeros((0, len(c.t)))) for c in courses]) == []


def test_how_far_a_search_for_curves_is_rises_to_its_end() -> None:
    learner, nothing, _ = cubed()
    keep, told = learner.candidates, []
    learner.candidates = [c for c in keep if c.quantity.name in ("w", "u", "time") and c.how == "output adds"]
    learner.progress = told.append
    try:
        learner.finalists(nothing)
    finally:
        learner.candidates, learner.progress = keep, lambda _: None
    assert len(told) >= 4 and told == sorted(told) and 0.0 < told[0] < 0.05 and 0.75 < told[-1] < 1.0


def test_curves_are_accepted_by_the_rules_or_by_a_formula(monkeypatch: pytest.MonkeyPatch) -> None:
    good, poor, said = tried("u", 1.0), tried("w", 9.0), tried("v", 8.0)
    asked: list[Any] = []

    def earning(learner: Any, before: Any, poor_ones: Any, among: Any) -> list[Any]:
        asked.append((list(poor_ones), list(among)))
        return [said]

    monkeypatch.setattr(learning, "earning_by_formula", earning)
    learner = chooser()
    learner.allowed = lambda before, t: t is good  # type: ignore[method-assign]
    three = [good, poor, said]
    assert learner.accepted(tried("none", 9.0), three) == [good, said]
    assert asked == [([poor, said], three)] and learner.by_formula == {"y.curve_of_v"}
    assert learner.out.nearest == [t.candidate.name for t in three]
    learner.speaks = False
    assert learner.accepted(tried("none", 9.0), three[:1]) == [good] and learner.by_formula == frozenset()
    assert learner.out.nearest == [t.candidate.name for t in three]  # of the first step


def test_a_hysteresis_must_dissipate(monkeypatch: pytest.MonkeyPatch) -> None:
    learner = chooser()
    learner.accepts = lambda before, t: True  # type: ignore[method-assign]
    slips, plain = tried("stops_of_u"), tried("u")
    monkeypatch.setattr(FittedCandidate, "table", lambda self: (lambda a: a, np.zeros(3)))
    for share, allowed in ((0.19, True), (0.21, False)):
        monkeypatch.setattr(learning, "share_given_back", lambda low, high, y, share=share: share)
        assert learner.allowed(tried("none"), slips) == allowed and learner.allowed(tried("none"), plain)


def test_two_curves_are_told_each_by_its_formulas(monkeypatch: pytest.MonkeyPatch) -> None:
    nothing, one, two = tried("none"), tried("u"), tried("w")
    told: list[Any] = []
    monkeypatch.setattr(learning, "tell_each_by_its_formula", lambda learner, *curves: told.append(curves))
    learner = chooser()
    learner._without_first = lambda first, second: [first, second]  # type: ignore[method-assign]
    assert learner.pruned([nothing, one, two]) == [nothing, one, two] and told == [(one, two)]
    learner._without_first = lambda first, second: [second]  # type: ignore[method-assign]
    assert learner.pruned([nothing, one, two]) == [nothing, two] and len(told) == 1
    assert learner.pruned([nothing, one]) == [nothing, one] and learner.pruned([nothing]) == [nothing]


def test_a_formula_in_place_of_a_gain_has_no_mean() -> None:
    learner, nothing = learner_on(ground_of(lambda u, w: 0.3 * u * (w - 2.0), []))
    t = curve(learner, nothing, place(learner, "w", "parameter times"))
    for formula, alone in fitted_formulas(learner.ground, t):
        placed = alone.curves[-1][0].curve
        assert placed is not None
        numbers = alone.fit.theta[1:]
        assert np.mean(placed.at(W, placed.row(numbers))) == pytest.approx(0.0, abs=3e-3), formula.form
        assert rms_of(alone.judge, alone.fit) == formula.error


def test_what_steepens_to_one_side_ends_there() -> None:
    c = replace(
        named(cubed()[0], place(cubed()[0], "u")), quantity=Quantity("u", "V", INPUT, np.linspace(-1.0, 1.0, 400))
    )
    basis = curve_candidates.basis_for(c.quantity)
    assert basis is not None
    c = replace(c, basis=basis)
    form = next(f for f in FORMS if f.name == "exponential")
    ground: Any = SimpleNamespace(reach=lambda c: (-3.0, 3.0))
    low, high = goes_on(ground, c, form, np.array([1.0, -2.0]))
    assert high == 3.0 and low == pytest.approx(-1.0 - 0.5 * np.log(10.0), abs=0.03)


def test_stops_have_radii_up_to_half_of_the_way_and_repeat_themselves_by_their_own_numbers() -> None:
    course = (2.0 * U,)
    stops = Quantity("stops_of_u", "V", COLUMN, np.abs(U), course)
    basis = curve_candidates.basis_for(stops)
    assert (
        basis is not None
        and basis.high == pytest.approx(0.5 * np.ptp(course[0]), rel=0.02)
        and basis.low == pytest.approx(0.0, abs=0.05)
    )
    c = named(cubed()[0], place(cubed()[0], "u"))
    again = c.every(0.7)
    for of, period in ((INPUT, again.quantity.period), (COLUMN, 0.0)):
        placed = replace(again, quantity=replace(again.quantity, of=of)).placed().curve
        assert placed is not None and placed.period == period and again.quantity.period > 0.0
