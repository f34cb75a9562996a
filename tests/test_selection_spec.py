"""The search on stages that are linear in their parameters, where linear algebra knows every answer: the fits that it
makes, what it names, exchanges, takes out and leaves unnamed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as settings_of
from hypothesis import strategies as st
from scipy.optimize import brentq, lsq_linear

from tests.conftest import examples
from vaneloop.identification import Effect, Parameter, Stage, StageError
from vaneloop.identification.least_squares.noise import correlation_of
from vaneloop.identification.least_squares.problem import Fit, LeastSquaresProblem
from vaneloop.identification.results import StageDiagnosis, rms_of, trust
from vaneloop.identification.selection import likelihood_acceptance as likelihood
from vaneloop.identification.selection import subsampled_search
from vaneloop.identification.selection.diagnosis import _search, diagnose_stage, extend_stage
from vaneloop.identification.selection.likelihood_acceptance import LikelihoodAcceptance
from vaneloop.identification.selection.relative_error_acceptance import RelativeErrorAcceptance, score, structure
from vaneloop.identification.selection.screening import Linearisation, along, onward, out_of, within
from vaneloop.identification.selection.search import Search
from vaneloop.identification.selection.subsampled_search import SubsampledSearch, _ways, excerpt_of, searched
from vaneloop.identification.subsystem import Array

# docs/settings.md
FLOOR_KNOWN, NATS, RIVAL_NATS, RIVAL_SHARE = 0.01, 12.0, 3.0, 0.25
PER_PARAMETER, RIVAL = 0.01, 0.05  # log error
SAME_SIZE, SCREEN_LINE = (0.8, 1.25), (0.02, 5.0)  # times
TRUST_MOST_LEFT, TRUST_MOST_FALL = 100.0, 30.0
TRUST_COEFFICIENTS = {"noise_floor": (-0.46, -0.75, 1.44, 0.23), "error_share": (0.57, -0.93, 1.23, 0.23)}

N = 240
T = 0.1 * np.arange(N)  # s
FLOOR = 0.1


def waves(seed: int, many: int) -> Array:
    """Independent random signals, one a row."""
    return np.random.default_rng(seed).standard_normal((many, N))


def effect(name: str, parameters: int = 1, starts: tuple[float, ...] = (-1.0, 1.0), **more: Any) -> Effect:
    """An effect that adds each of its sizes times a signal."""
    sizes = tuple(Parameter(f"{name}{k}", 0.0, "1", -50.0, 50.0) for k in range(parameters))
    return Effect(name, sizes, tuple((s,) * parameters for s in starts), **more)


def linear(effects: Mapping[Effect, Array], measured: Array, lead: Array, **more: Any) -> Stage:
    """A stage whose output is ``lead`` times a gain, known to be within 0.5 of 1, and what its effects add."""
    rows = np.vstack([lead[None], *(np.atleast_2d(x) for x in effects.values())])
    return Stage(
        name="sum", outputs=("y",), units=("1",), parameters=(Parameter("gain", 1.0, "1", 0.0, 2.0, 0.5),),
        effects=tuple(effects), run=lambda thetas: (thetas @ rows)[:, None, :], t=T, measured=measured,
        floor=np.array([FLOOR]), **more,
    )  # fmt: skip


CRITERIA = pytest.mark.parametrize("criterion", [RelativeErrorAcceptance, LikelihoodAcceptance])


def names(d: StageDiagnosis) -> list[str]:
    return sorted(f.effect for f in d.effects)


def relative(stage: Stage, **more: Any) -> StageDiagnosis:
    assert stage.floor is not None
    return diagnose_stage(stage, stage.floor, judged=lambda judge: RelativeErrorAcceptance(judge, **more))


# ---- every fit -------------------------------------------------------------------------------------------------------


@CRITERIA
@pytest.mark.parametrize("seed", [1, 2])
def test_every_fit_of_a_search_is_the_one_that_linear_algebra_makes(criterion: Any, seed: int) -> None:
    x = waves(seed, 6)
    measured = 1.2 * x[0] + 2.0 * x[2] - 1.5 * x[4] + FLOOR * waves(90 + seed, 1)[0]
    stage = linear({effect(c): x[k + 1] for k, c in enumerate("abcd")}, measured, x[0])
    judge = LeastSquaresProblem(stage, np.array([FLOOR]))
    ticks: list[int] = []
    search, fit, _, steps = _search(Search(criterion(judge), lambda: ticks.append(1)))
    assert sorted(fit.effects) == ["b", "d"] and len(search.fits) > 6
    if not search.criterion.roams:  # each fit is told, and of several effects each that is finished
        assert len(ticks) == len(search.fits) + len(search.finished)
        leader = min((search.fits[frozenset(c)] for c in "abcd"), key=lambda f: float(f.held_out.sum()))
        assert search.criterion.correlation == correlation_of(judge, leader)  # type: ignore[attr-defined]
    assert not search.criterion.accepts(fit, fit)  # nothing is gained by what is there
    assert steps[0] == ("nominal", rms_of(judge, search.base)) and steps[-1][1] == rms_of(judge, fit)
    index = stage.index()
    for key, f in search.fits.items():
        columns = [0, *sorted(index[e].start for e in key)]
        a = np.vstack([x[[0, *(c for c in columns if c)]].T / FLOOR, np.eye(1, len(columns)) * np.sqrt(12.0)])
        b = np.append(measured / FLOOR, np.sqrt(12.0))
        least = lsq_linear(a, b)
        free = len(f.effects) < 2 or set(f.effects) == {"b", "d"}  # the others are ranked only
        assert f.theta[columns] == pytest.approx(least.x, rel=1e-4 if free else 0.1, abs=1e-4 if free else 0.05), key
        assert judge.total_of(f) == pytest.approx(2.0 * least.cost, rel=1e-6 if free else 1e-2), key
        others = np.setdiff1d(np.arange(5), columns)
        assert np.array_equal(f.theta[others], np.zeros(len(others)))


@CRITERIA
@pytest.mark.parametrize("quick", [False, True])
def test_a_screening_promises_what_linear_algebra_leaves(criterion: Any, quick: bool) -> None:
    x = waves(41, 5)
    measured = 1.1 * x[0] + 0.9 * x[1] + 0.2 * x[2] + FLOOR * x[4]
    starts = (0.1, 0.8, 4.0)
    stage = linear({effect(c, starts=starts): x[k + 1] for k, c in enumerate("abc")}, measured, x[0], quick=quick)
    search = Search(criterion(LeastSquaresProblem(stage, np.array([FLOOR]))))
    for k, name in enumerate("abc", 1):
        left = {s: np.linalg.lstsq(x[:1].T, measured - s * x[k], rcond=None)[1][0] / FLOOR**2 for s in starts}
        best = np.linalg.lstsq(x[[0, k]].T, measured, rcond=None)
        better = search.criterion.roams and best[0][1] > 0.0  # the size that is best follows from that of a start
        levels = [*left.values(), *([best[1][0] / FLOOR**2] if better else [])]
        assert search.level[name] == pytest.approx(min(levels), rel=1e-3)
        base = search.base.cost.sum()
        assert search.reach[name] == pytest.approx(max(abs(v - base) for v in levels), rel=1e-3)
        begins = search.starts[name][0][k]
        nearest = min(left, key=lambda s: left[s])
        assert begins == (pytest.approx(best[0][1], rel=SAME_SIZE[1] - 1.0) if better else nearest)


def test_of_a_great_library_those_are_fitted_that_promise_most() -> None:
    x = waves(42, 18)
    truth = {"e2": 3.0, "e7": -2.0}
    measured = x[0] + sum(size * x[int(name[1:]) + 1] for name, size in truth.items()) + FLOOR * 5.0 * x[17]
    stage = linear({effect(f"e{k}"): x[k + 1] for k in range(16)}, measured, x[0])
    judge = LeastSquaresProblem(stage, np.array([FLOOR]))
    search, fit, candidates, _ = _search(Search(RelativeErrorAcceptance(judge)))
    assert set(fit.effects) == set(truth) and len(candidates) == RelativeErrorAcceptance.fitted == 8
    assert candidates[0].effect == "e2" and {c.effect for c in candidates} >= set(truth)
    beside = {
        k: np.linalg.lstsq(x[[0, 3, k + 1]].T, measured, rcond=None)[1][0] for k in range(16) if k != 2
    }  # what is left with e2 and another
    best = sorted(beside, key=lambda k: beside[k])
    assert {frozenset(("e2", f"e{k}")) for k in best[:8]} <= search.fits.keys()
    assert {frozenset(("e2", f"e{k}")) for k in best[8:]} <= search.passed


@pytest.mark.parametrize(("parameters", "named"), [(1, ["a", "wide"]), (4, ["a"])])
def test_of_effects_that_do_equally_well_the_freer_one_is_no_rival(parameters: int, named: list[str]) -> None:
    x = waves(43, 8)
    measured = x[0] + 3.0 * x[1] + FLOOR * x[2]
    wide = effect("wide", parameters)
    d = diagnose_stage(
        linear({wide: x[[1, 3, 4, 5][:parameters]], effect("a"): x[1]}, measured, x[0]), np.array([FLOOR])
    )
    (f,) = d.effects
    assert sorted([f.effect, *f.rivals]) == named
    assert f.effect == "a" or parameters == 1


@given(nats=st.floats(0.1, 100.0), correlation=st.floats(1.0, 9.0))
@settings_of(max_examples=examples(15), deadline=None)
def test_what_could_change_the_squares_by_twice_the_nats_would_have_been_seen(nats: float, correlation: float) -> None:
    judge: Any = SimpleNamespace()
    criterion = LikelihoodAcceptance(judge)
    criterion.correlation = correlation
    assert criterion.shows(2.0 * nats * correlation) == (nats >= NATS)
    assert RelativeErrorAcceptance(judge).shows(nats) and not RelativeErrorAcceptance(judge).shows(0.0)


@given(seed=st.integers(0, 1000), parameters=st.integers(0, 3), blocks=st.booleans())
@settings_of(max_examples=examples(10), deadline=None)
def test_the_score_is_the_mean_of_the_logs_of_the_whole_and_of_the_blocks(
    seed: int, parameters: int, blocks: bool
) -> None:
    rng = np.random.default_rng(seed)
    samples = rng.integers(0, 50, 8)
    judge: Any = SimpleNamespace(n=int(samples.sum()), samples=samples, stage=SimpleNamespace(grain=1.0))
    held, draw = samples * rng.uniform(0.2, 40.0, 8), rng.integers(0, np.sum(samples > 0), 8)
    fit: Any = SimpleNamespace(held_out=held, free=np.arange(parameters))
    rms = np.sqrt(np.maximum(held[samples > 0] / samples[samples > 0], 1.0))
    weight = samples[samples > 0]
    if blocks:
        rms, weight = rms[draw], weight[draw]
    whole = np.log(np.sqrt(np.average(rms**2, weights=weight)))
    expected = 0.5 * (whole + np.mean(np.log(rms))) + PER_PARAMETER * parameters
    assert score(judge, fit, draw if blocks else None) == pytest.approx(expected)
    judge.stage.grain = 0.01  # near a noise that is known the whole alone counts, in its grain
    expected = 0.5 * np.log(held.sum() / judge.n) / 0.01 + PER_PARAMETER * parameters
    assert score(judge, fit) == pytest.approx(expected)


# ---- against an error that is no noise -------------------------------------------------------------------------------


def test_a_sum_that_stood_in_for_two_effects_is_exchanged_for_them() -> None:
    x = waves(3, 4)
    measured = x[0] + 3.0 * x[1] + 2.5 * x[2] + FLOOR * 12.0 * x[3]
    both = 3.0 * x[1] + 2.5 * x[2] + 0.8 * waves(4, 1)[0]  # nearer than either, and not it
    d = relative(linear({effect("both"): both, effect("a"): x[1], effect("b"): x[2]}, measured, x[0]))
    assert names(d) == ["a", "b"] and d.effects[0].parameters["a0"]["value"] == pytest.approx(3.0, abs=0.2)
    assert d.steps[1][0] == "both"
    for f, rest in zip(d.effects, ([0, 2], [0, 1]), strict=True):
        left = [np.linalg.lstsq(x[c].T, measured, rcond=None)[1][0] / FLOOR**2 for c in (rest, [0, 1, 2])]
        assert f.nats == pytest.approx(left[0] - left[1], rel=0.05)


@pytest.mark.parametrize("truth", ["one", "two", "all"])
def test_a_law_of_many_parameters_gives_way_to_one_or_two_that_do_its_work(truth: str) -> None:
    x = waves(5, 8)
    sizes = {"one": (4.0, 0.0, 0.0), "two": (4.0, 3.0, 0.0), "all": (4.0, 3.0, 3.5)}[truth]
    measured = x[0] + np.array(sizes) @ x[1:4] + FLOOR * 12.0 * x[4]
    library = {effect("flexible", 3): x[1:4], effect("a"): x[1], effect("b"): x[2], effect("other"): x[5]}
    d = relative(linear(library, measured, x[0]))
    assert names(d) == {"one": ["a"], "two": ["a", "b"], "all": ["flexible"]}[truth]
    if truth == "one":  # nor is a law of two numbers worth it
        assert names(relative(linear({effect("pair", 2): x[1:3], effect("a"): x[1]}, measured, x[0]))) == ["a"]


def test_a_shape_is_no_freedom_that_keeps_a_law_from_being_a_rival() -> None:
    x = waves(50, 4)
    shape = Parameter("fade", 0.0, "1", 0.0, 9.0, shape=True, scale=1.0)
    bent = Effect("bent", (Parameter("size", 0.0, "1", -50.0, 50.0), shape), ((-1.0, 0.1), (1.0, 0.1)))

    def run(thetas: Array) -> Array:
        gain, plain, size, fade = thetas.T[:, :, None]
        return (gain * x[0] + (plain + size * np.exp(-fade * np.abs(x[2]))) * x[1])[:, None, :]

    stage = Stage(
        "s", ("y",), ("1",), (Parameter("gain", 1.0, "1", 0.0, 2.0, 0.5),), (effect("plain"), bent), run, T,
        run(np.array([[1.0, 3.0, 0.0, 0.0]]))[0] + 8.0 * FLOOR * x[3:], floor=np.array([FLOOR]),
    )  # fmt: skip
    (f,) = relative(stage).effects
    assert (f.effect, f.rivals) == ("plain", ["bent"]) and f.probability <= 0.5


def harmed(seed: int, change: Mapping[str, Mapping[str, float]], tests: frozenset[str]) -> tuple[StageDiagnosis, Any]:
    """The answer on a log that lacks a and b, where other logs' log errors change as told by each effect."""
    x = waves(seed, 5)
    measured = x[0] + 3.0 * x[1] + 1.2 * x[2] + FLOOR * 6.0 * x[3]
    stage = linear({effect("a"): x[1], effect("b"): x[2], effect("c"): x[4]}, measured, x[0])
    index = stage.index()

    def figures(theta: Array) -> dict[str, float]:
        here = [e for e in index if theta[index[e]].any()]
        return {log: sum(of.get(e, 0.0) for e in here) for log, of in change.items()}

    return relative(stage, figures=figures, tests=tests), figures


@pytest.mark.parametrize(
    ("change", "named", "said"),
    [
        ({"fit": {"a": -1.0, "b": -0.5}, "test": {"a": -1.0, "b": -0.5}}, ["a", "b"], []),
        ({"fit": {"a": -1.0, "b": -0.5}, "test": {"a": -1.0, "b": 0.09}}, ["a", "b"], []),
        (
            {"fit": {"a": -1.0, "b": -0.5}, "test": {"a": -1.0, "b": 0.11}},
            ["a"],
            ["b fits, but is not named: makes test worse: 1.12 times the error"],
        ),
        ({"fit": {"a": -1.0, "b": -0.021}, "test": {"a": -1.0}}, ["a", "b"], []),
        (
            {"fit": {"a": -1.0, "b": -0.019}, "test": {"a": -1.0}},
            ["a"],
            ["b fits, but is not named: no log is better by 2% for it"],
        ),
        (
            {"fit": {"a": -1.0, "b": -0.5}, "test": {"a": -1.0, "b": 0.3}},
            ["a"],
            ["b fits, but is not named: makes test worse: 1.35 times the error"],
        ),
        ({"fit": {"a": -1.0}, "test": {"a": -1.0}}, ["a"], ["b fits, but is not named: no log is better by 2% for it"]),
        (
            {"fit": {"a": -1.0, "b": -0.5}, "test": {"a": 0.07, "b": 0.06}},  # neither by itself, both together
            [],
            ["a + b fits, but is not named: makes test worse: 1.14 times the error"],
        ),
    ],
)
def test_what_harms_a_validation_log_or_helps_none_is_left_out_and_said(
    change: dict[str, dict[str, float]], named: list[str], said: list[str]
) -> None:
    d, _ = harmed(6, change, frozenset(["test"]))
    assert names(d) == named and [n for n in d.notes if "not named" in n] == said
    assert d.verdict == ("missing" if named else "unknown")


@pytest.mark.parametrize("prefers", ["a", "like_a", "neither"])
def test_logs_that_were_not_fitted_decide_between_effects_that_do_equally_well(prefers: str) -> None:
    x = waves(7, 5)
    measured = x[0] + 3.0 * x[1] + FLOOR * 10.0 * x[3]
    like = x[1] + 0.02 * x[4]  # as good here
    stage = linear({effect("a"): x[1], effect("like_a"): like, effect("c"): x[2]}, measured, x[0])
    index = stage.index()

    def figures(theta: Array) -> dict[str, float]:
        here = [e for e in index if theta[index[e]].any()]
        return {"fit": -float(len(here)), "test": -1.0 * len(here) - (2.0 * RIVAL if prefers in here else 0.0)}

    d = relative(stage, figures=figures, tests=frozenset(["test"]))
    first = relative(stage, tests=frozenset(["test"]))  # of which nothing is known
    (by_fit,) = first.effects
    (f,) = d.effects
    other = {"a": "like_a", "like_a": "a"}
    assert by_fit.rivals == [other[by_fit.effect]] and f.rivals == [other[f.effect]] and f.probability <= 0.5
    assert f.effect == (by_fit.effect if prefers == "neither" else prefers)
    said = f"{by_fit.effect} and {prefers} do equally well on the fitted log; the test logs prefer {prefers}"
    assert d.notes == ([] if f.effect == by_fit.effect else [said])


@pytest.mark.parametrize(("left", "verdict"), [(1.1, "none"), (1.23, "none"), (1.27, "unknown"), (1.4, "unknown")])
def test_what_no_effect_explains_is_unknown_from_a_quarter_above_the_noise(left: float, verdict: str) -> None:
    x = waves(8, 3)
    noise = waves(9, 1)[0]
    measured = x[0] + FLOOR * left * noise / np.std(noise)
    d = relative(linear({effect("a"): x[1], effect("b"): x[2]}, measured, x[0]))
    assert d.verdict == verdict and not d.effects and d.criterion == "error_share"


@pytest.mark.parametrize(("left", "named"), [(0.22, True), (0.28, False), (0.5, False)])
def test_a_name_that_leaves_a_quarter_is_none_and_is_said_to_come_nearest(left: float, named: bool) -> None:
    x = waves(10, 4)
    x = np.linalg.qr(x.T)[0].T * np.sqrt(N)
    measured = x[0] + 3.0 * x[1] + 3.0 * np.sqrt(left / (1.0 - left)) * x[3]  # the last part is nobody's
    d = relative(linear({effect("a"): x[1], effect("b"): x[2]}, measured, x[0]))
    if named:
        assert (d.verdict, names(d)) == ("missing", ["a"])
        return
    assert d.verdict == "unknown" and not d.effects and d.nearest[0] == "a"
    (said,) = d.refused
    assert said.startswith("a comes nearest and leaves ")
    assert float(said.split()[-4].rstrip("%")) == pytest.approx(100.0 * np.sqrt(left), abs=2.0)


@pytest.mark.parametrize(("share", "named"), [(0.0215, False), (0.023, True)])
def test_an_effect_must_do_more_than_the_form_of_the_equations_may_be_wrong(share: float, named: bool) -> None:
    x = np.linalg.qr(waves(46, 4).T)[0].T * np.sqrt(N)
    # two per cent of what the model as it is leaves, in squares beyond the noise
    measured = x[0] + 100.0 * FLOOR * (x[1] + share * x[2])
    wide = {Effect(c, (Parameter("size", 0.0, "1", -99.0, 99.0),), ((-9.0,), (0.2,), (9.0,))): x[k] for c, k in
            (("a", 1), ("b", 2))}  # fmt: skip
    assert names(relative(linear(wide, measured, x[0]))) == (["a", "b"] if named else ["a"])


@pytest.mark.parametrize(("apart", "rivals"), [(0.045, ["like_a"]), (0.055, [])])
def test_rivals_are_within_a_twentieth_of_the_log_error(apart: float, rivals: list[str]) -> None:
    x = np.linalg.qr(waves(47, 5).T)[0].T * np.sqrt(N)
    measured = x[0] + 3.0 * x[1] + 10.0 * FLOOR * x[3]

    def stage(off: float) -> Stage:
        return linear({effect("a"): x[1], effect("like_a"): x[1] + off * x[2]}, measured, x[0])

    def too_far(off: float) -> float:
        judge = LeastSquaresProblem(stage(off), np.array([FLOOR]))
        scores = [score(judge, judge.fit((name,), judge.stage.neutral())) for name in ("a", "like_a")]
        return scores[1] - scores[0] - apart

    off = brentq(too_far, 0.0, 0.5, xtol=1e-4)
    (f,) = relative(stage(off)).effects
    assert (f.effect, f.rivals) == ("a", rivals)


@pytest.mark.parametrize(("share", "verdict"), [(0.22, "none"), (0.28, "unknown")])
def test_a_small_error_that_inputs_predict_by_a_quarter_is_unknown(share: float, verdict: str) -> None:
    rng = np.random.default_rng(48)
    t, u = 0.1 * np.arange(6000), rng.standard_normal(6000)
    error = np.sqrt(share) * u + np.sqrt(1.0 - share) * rng.standard_normal(len(t))
    stage = Stage(
        "s", ("y",), ("1",), (Parameter("offset", 0.0, "1"),), (), lambda thetas: np.zeros((len(thetas), 1, len(t))), t,
        1.2 * error / np.std(error), regimes={"u": u}, floor=np.array([1.0]),
    )  # fmt: skip
    judge = LeastSquaresProblem(stage, np.array([1.0]))
    fit = judge.fit((), stage.neutral())
    assert structure(judge, fit) == pytest.approx(share, abs=0.02)
    assert RelativeErrorAcceptance(judge).conclude(fit, fit, [], [], []).verdict == verdict


@pytest.mark.parametrize("kind", ["noise", "now", "before", "magnitude"])
def test_the_structure_of_an_error_is_what_inputs_now_and_before_predict_of_it(kind: str) -> None:
    rng = np.random.default_rng(11)
    t = 0.1 * np.arange(4000)
    u = rng.standard_normal(len(t))
    noise = rng.standard_normal(len(t))
    of = {"noise": 0.0 * u, "now": u, "before": np.append(np.zeros(3), u[:-3]), "magnitude": np.abs(u)}[kind]
    stage = Stage(
        "s", ("y",), ("1",), (Parameter("offset", 0.0, "1", -0.1, 0.1, 0.1),), (),
        lambda thetas: np.repeat(thetas[:, :1, None], len(t), axis=2), t, of + noise,
        regimes={"time": t, "u": u, "y": of}, floor=np.array([1.0]),
    )  # fmt: skip
    judge = LeastSquaresProblem(stage, np.array([1.0]))
    fit = judge.fit((), stage.neutral())
    e = judge.errors(fit.theta[None])[0, 0]
    expected = {"noise": 0.0, "now": 0.5, "before": 0.5}.get(kind, 1.0 - 1.0 / np.mean(e * e))
    assert structure(judge, fit) == pytest.approx(expected, abs=0.03)
    stage.regimes = {"time": t, "log": t, "y": of}  # what is no input predicts nothing
    assert structure(judge, fit) == 0.0
    short = replace(
        stage, t=t[:30], measured=20.0 * u[None, :30], regimes={"u": u[:30]}, run=lambda _: np.zeros((1, 1, 30))
    )
    assert structure(LeastSquaresProblem(short, np.array([1.0])), fit) == 0.0  # so few tell nothing


def test_a_coefficient_that_only_stood_in_for_what_was_missing_goes_to_zero() -> None:
    x = waves(12, 3)

    def answered(drag: float) -> Fit:
        rows = np.vstack([x[0], x[1]])
        stage = Stage(
            "s", ("y",), ("1",), (Parameter("drag", 0.3, "1", 0.0, 2.0, 0.5),), (effect("a"),),
            lambda thetas: (thetas @ rows)[:, None, :], T, drag * x[0] + 3.0 * x[1] + 0.5 * x[2],
            floor=np.array([FLOOR]),
        )  # fmt: skip
        judge = LeastSquaresProblem(stage, np.array([FLOOR]))
        search, fit, _, _ = _search(Search(RelativeErrorAcceptance(judge)))
        assert fit is search.fits[frozenset("a")] and fit.effects == ("a",)
        assert judge.spared == ({0} if drag == 0.0 else set())
        return fit

    assert answered(0.0).theta[0] == 0.0
    assert answered(0.7).theta[0] == pytest.approx(0.7, abs=0.1)


# ---- promises --------------------------------------------------------------------------------------------------------


def problem(seed: int, narrow: bool = False) -> tuple[LeastSquaresProblem, Fit]:
    x = waves(seed, 6)
    rows = x[:4]
    tolerance = 0.02 if narrow else 50.0
    stage = Stage(
        "s", ("y",), ("1",), tuple(Parameter(c, 0.5, "1", -60.0, 60.0, tolerance, scale=2.0) for c in "pq"),
        (effect("a"), effect("b")), lambda thetas: (thetas @ rows)[:, None, :], T,
        np.array([1.0, 2.0, 3.0, 0.0]) @ rows + x[4], floor=np.array([FLOOR]),
    )  # fmt: skip
    judge = LeastSquaresProblem(stage, np.array([FLOOR]))
    return judge, judge.fit((), stage.neutral())


@given(seed=st.integers(0, 200), narrow=st.booleans(), sizes=st.tuples(st.floats(-4.0, 4.0), st.floats(-4.0, 4.0)))
@settings_of(max_examples=examples(10), deadline=None)
def test_what_is_promised_of_a_linear_stage_is_what_scipy_finds(
    seed: int, narrow: bool, sizes: tuple[float, float]
) -> None:
    judge, fit = problem(seed, narrow)
    slopes = Linearisation(judge, fit.theta, fit.free, fit.prior)
    theta = fit.theta.copy()
    theta[2:] = sizes
    errors = judge.errors(theta[None])[0]
    scale = judge.scale[:2]
    a = np.vstack([slopes.jac.reshape(2, -1).T, np.diag(np.sqrt(fit.prior) * scale)])
    low, high = ((b[:2] - fit.theta[:2]) / scale for b in judge.bounds())
    followed = lsq_linear(a, np.append(errors.ravel(), [0.0, 0.0]), (low - 1e-12, high + 1e-12), tol=1e-14)
    step, rest = slopes.follow(errors, low, high)
    assert step == pytest.approx(followed.x, abs=1e-5)
    assert rest.ravel() == pytest.approx(errors.ravel() - a[:-2] @ step, abs=1e-9)
    straight = np.linalg.lstsq(a, np.append(errors.ravel(), [0.0, 0.0]), rcond=None)[0]
    clipped = np.clip(straight, low, high)  # a screening does not come again to what the others draw from a bound
    (left,) = slopes.left(errors[None])
    assert left == pytest.approx(np.sum((np.append(errors.ravel(), [0.0, 0.0]) - a @ clipped) ** 2), rel=1e-6)
    # how far to go: the model's own parameters follow without bounds
    e0, d = slopes.error.ravel(), (errors - slopes.error).ravel()
    both = np.column_stack([a, -np.append(d, [0.0, 0.0])])
    best = np.linalg.lstsq(both, np.append(e0, [0.0, 0.0]), rcond=None)[0]
    share, promise = slopes.line(errors[None])
    if np.abs(d).max() > 1e-3:
        assert share[0] == pytest.approx(np.clip(best[2], *SCREEN_LINE), rel=1e-4)
        there = np.append(e0 + share[0] * d, [0.0, 0.0])
        least = np.linalg.lstsq(a, there, rcond=None)[0]
        assert promise[0] == pytest.approx(np.sum((there - a @ least) ** 2), rel=1e-6, abs=1e-6)
    share, promise = slopes.line(slopes.error[None])  # a way of no length goes nowhere
    assert share[0] == SCREEN_LINE[0]
    least = np.linalg.lstsq(a, np.append(e0, [0.0, 0.0]), rcond=None)[0]
    assert promise[0] == pytest.approx(np.sum((np.append(e0, [0.0, 0.0]) - a @ least) ** 2), rel=1e-6, abs=1e-6)


@given(size=st.floats(-9.0, 9.0), other=st.floats(-9.0, 9.0), share=st.floats(0.0, 12.0))
@settings_of(max_examples=examples(20), deadline=None)
def test_an_effect_and_what_it_holds_within_it_are_each_other_s_parameters(
    size: float, other: float, share: float
) -> None:
    nan = float("nan")
    lead = lambda of: [(3.0 * of[0], 100.0, -of[0])]  # noqa: E731
    wide = effect("wide", 3, holds=(("narrow", (None, 1.0, nan)),), onward=lead)
    x = waves(1, 6)
    stage = linear({wide: x[1:4], effect("narrow"): x[4], effect("more"): x[5]}, x[0], x[0])
    theta = np.array([1.1, 0.0, 0.0, 0.0, size, other])
    held = within(stage, theta, "wide", "narrow")
    assert held.tolist() == [1.1, size, 1.0, 0.0, 0.0, other]
    assert out_of(stage, held, "wide", "narrow").tolist() == theta.tolist()
    (begun,) = onward(stage, theta, "wide", "narrow")
    assert begun.tolist() == [1.1, *np.clip([3.0 * size, 100.0, -size], -50.0, 50.0), 0.0, other]
    assert onward(stage, theta, "more", "narrow") == []
    sizes = (Parameter("size", 2.0, "1", -9.0, 9.0), Parameter("shape", 0.0, "1", -9.0, 9.0, shape=True))
    moved = along(Effect("e", sizes, ()), np.array([3.0, 4.0]), share, np.full(2, -9.0), np.full(2, 9.0))
    assert (moved is None) == (SAME_SIZE[0] < share < SAME_SIZE[1])  # that is the start again
    assert moved is None or moved.tolist() == pytest.approx([min(2.0 + share, 9.0), 4.0])


# ---- against a known noise -------------------------------------------------------------------------------------------


@given(seed=st.integers(0, 500), correlation=st.floats(1.0, 5.0))
@settings_of(max_examples=examples(15), deadline=None)
def test_freedom_is_half_the_log_of_what_the_data_narrowed(seed: int, correlation: float) -> None:
    """Of one size alone: one observation's information before, all of them after."""
    rng = np.random.default_rng(seed)
    size, slope = rng.uniform(0.1, 3.0), rng.uniform(5.0, 50.0)
    parameter = Parameter("size", 0.0, "1", -50.0, 50.0)
    stage: Any = SimpleNamespace(all_parameters=lambda: (parameter,))
    judge: Any = SimpleNamespace(stage=stage, scale=np.array([2.0]), n=N)
    data = np.full((4, 1, 1), 0.25 * N * slope**2)
    fit: Any = SimpleNamespace(
        free=np.array([0]), prior=np.zeros(1), low=np.array([size - 0.1]), high=np.array([size + 0.1]), normals=data,
        theta=np.array([size]),
    )  # fmt: skip
    one = min(slope**2, (2.0 / size) ** 2)
    expected = 0.5 * np.log((N * slope**2 / correlation + one) / one)
    assert likelihood._freedom(judge, fit, correlation) == pytest.approx(expected)
    fit.low[:] = -0.1  # nothing was made possible by a size that may be neutral
    assert likelihood._freedom(judge, fit, correlation) == 0.0
    fit.prior = np.array([3.0])  # but by one that is known beforehand
    expected = 0.5 * np.log((N * slope**2 / correlation + 12.0) / 12.0)
    assert likelihood._freedom(judge, fit, correlation) == pytest.approx(expected)
    fit.prior = np.zeros(1)  # and by a shape, which may be anywhere within its bounds: as evenly as a ruler's marks
    for low, high in ((-1.0, 3.0), (2.0, 6.0)):
        stage.all_parameters = lambda low=low, high=high: (Parameter("share", low, "-", low, high, shape=True),)
        variance = (high - low) ** 2 / 12.0 / judge.scale[0] ** 2
        expected = 0.5 * np.log(N * slope**2 / correlation * variance + 1.0)
        assert likelihood._freedom(judge, fit, correlation) == pytest.approx(expected)


def test_a_threshold_has_the_interval_within_which_the_error_is_as_good() -> None:
    x = waves(13, 2)
    steps = np.sign(x[1] - np.linspace(-2.0, 2.0, N))
    at = 0.31

    def run(thetas: Array) -> Array:  # counts the samples above a threshold
        return (thetas[:, :1] * x[0] + np.where(steps * np.abs(x[1]) > thetas[:, 1:2], 1.0, 0.0))[:, None, :]

    threshold = Effect("threshold", (Parameter("at", 0.0, "1", -5.0, 5.0),), ((0.2,), (0.31,), (0.5,)))
    stage = Stage(
        "s", ("y",), ("1",), (Parameter("gain", 1.0, "1", 0.0, 2.0, 0.5),), (threshold,), run, T,
        run(np.array([[1.0, at]]))[0] + 0.1 * waves(14, 1), floor=np.array([FLOOR]),
    )  # fmt: skip
    judge = LeastSquaresProblem(stage, np.array([FLOOR]))
    fit = judge.fit(("threshold",), np.array([1.0, at]), 0)
    k = list(fit.free).index(1)
    likelihood._widen_steps(judge, fit, "threshold", 1.0)
    levels = steps * np.abs(x[1])
    below, above = levels[levels <= at].max(), levels[levels > at].min()
    assert fit.low[k] < at < fit.high[k]
    assert fit.low[k] <= below and fit.high[k] >= above  # one sample more on either side is seen at once
    assert at - fit.low[k] < 2.0 * (at - below) + 1e-3 and fit.high[k] - at < 2.0 * (above - at) + 1e-3
    found = fit.low[k], fit.high[k]
    likelihood._widen_steps(judge, fit, "threshold", 1.0)  # one that is an interval stays
    assert (fit.low[k], fit.high[k]) == found
    far = judge.fit(("threshold",), np.array([1.0, 4.2]), 0)  # beyond all samples
    likelihood._widen_steps(judge, far, "threshold", 1.0)
    assert (far.low[k], far.high[k]) == pytest.approx((0.7 * 4.2, 5.0))


def test_rivals_of_equal_effects_are_each_other_and_share_the_probability() -> None:
    x = waves(15, 5)
    measured = x[0] + 3.0 * x[1] + 2.0 * x[2] + FLOOR * x[3]
    library = {effect("a"): x[1], effect("twin"): 2.0 * x[1], effect("b"): x[2], effect("c"): x[4]}
    stage = linear(library, measured, x[0])
    d = diagnose_stage(stage, np.array([FLOOR]))
    by_name = {f.effect: f for f in d.effects}
    assert d.verdict == "missing" and len(by_name) == 2 and "b" in by_name
    (first,) = by_name.keys() - {"b"}
    other = {"a": "twin", "twin": "a"}[first]
    assert by_name[first].rivals == [other] and by_name["b"].rivals == []
    assert by_name[first].probability == pytest.approx(0.5, abs=0.02) and by_name["b"].probability > 0.99
    # what the name gains: half of what the error falls, as without it all others stand
    judge = LeastSquaresProblem(stage, np.array([FLOOR]))
    without = judge.fit((first,), stage.neutral())
    assert by_name["b"].nats == pytest.approx(0.5 * (without.cost.sum() - d.final.cost.sum()), rel=0.1)
    assert by_name["b"].fall == pytest.approx(np.sqrt(without.cost.sum() / d.final.cost.sum()), rel=0.05)
    value = by_name["b"].parameters["b0"]
    assert value["low"] < 2.0 < value["high"]


def test_a_rival_that_leads_beside_the_others_alone_is_found() -> None:
    x = waves(44, 17)
    near = {effect(f"c{k}"): x[1] + 0.4 * x[k + 4] for k in range(11)}  # all of these do more by themselves
    measured = x[0] + 3.0 * x[1] + 0.3 * x[2] + FLOOR * x[3]
    library = {effect("a"): x[1], **near, effect("b"): x[2], effect("twin"): 2.0 * x[2]}
    d = diagnose_stage(linear(library, measured, x[0]), np.array([FLOOR]))
    assert {frozenset([f.effect, *f.rivals]) for f in d.effects} == {frozenset("a"), frozenset(["b", "twin"])}


@pytest.mark.parametrize("beyond", [0.0, 2.0])
def test_shares_are_those_of_the_likelihoods_over_resampled_blocks_softened_by_what_is_left(beyond: float) -> None:
    x = waves(45, 5)
    measured = x[0] + 3.0 * x[1] + FLOOR * (x[3] + beyond * x[4])
    stage = linear({effect("a"): x[1], effect("near"): x[1] + 0.03 * x[2], effect("c"): x[2]}, measured, x[0])
    judge = LeastSquaresProblem(stage, np.array([FLOOR]))
    search, fit, candidates, _ = _search(Search(LikelihoodAcceptance(judge)))
    found, _ = search.criterion.name(search, fit, candidates)
    correlation = correlation_of(judge, fit)
    (f,) = found
    assert {"a", "near"} <= f.fits.keys()
    held = np.array([of.held_out for of in f.fits.values()])
    least = 0.5 * (held.sum(axis=1).min() - judge.n * (1.0 + FLOOR_KNOWN) ** 2) / correlation
    soft = max(1.0, RIVAL_SHARE * least / RIVAL_NATS)
    assert (soft > 5.0) == (beyond > 0.0)
    draws = np.random.default_rng(1).integers(0, judge.n_blocks, (4000, judge.n_blocks))
    price = np.array([likelihood._freedom(judge, of, correlation) for of in f.fits.values()])
    table = -0.5 * held[:, draws].sum(axis=2) / (correlation * soft) - price[:, None]
    weight = np.exp(table - table.max(axis=0))
    shares = (weight / weight.sum(axis=0)).mean(axis=1)
    assert list(f.shares.values()) == pytest.approx(shares, abs=0.04)


def test_a_model_with_two_valleys_begins_wherever_its_stage_says_that_it_may() -> None:
    x = waves(16, 2)

    def run(thetas: Array) -> Array:  # at 2 and near -1 the first part is the same
        p, size = thetas[:, :1], thetas[:, 1:2]
        return ((p**3 - 3.0 * p) * x[0] + (0.3 * p + size) * x[1])[:, None, :]

    def stage(begins: Array | None) -> Stage:
        return Stage(
            "s", ("y",), ("1",), (Parameter("p", -1.2, "1", -5.0, 5.0, 4.0),), (effect("a"),), run, T,
            run(np.array([[2.0, 0.0]]))[0] + FLOOR * waves(17, 1), floor=np.array([FLOOR]), begins=begins,
        )  # fmt: skip

    for criterion in (RelativeErrorAcceptance, LikelihoodAcceptance):
        searches = [
            Search(criterion(LeastSquaresProblem(stage(b), np.array([FLOOR]))))
            for b in (None, np.array([[2.5, 0.0]]), np.array([[-1.1, 0.0], [2.5, 0.0]]))
        ]
        assert -1.5 < searches[0].base.theta[0] < -0.5
        assert [s.base.theta[0] for s in searches[1:]] == pytest.approx([2.0, 2.0], abs=0.05)
        assert [len(s.nominal) for s in searches] == [1, 2, 3]


# ---- how an effect is fitted -----------------------------------------------------------------------------------------


def turning(seed: int, size: float, angle: float, starts: tuple[tuple[float, float], ...]) -> Stage:
    """A stage that lacks a force of a size in a direction in the plane."""
    x = waves(seed, 4)
    parameters = (
        Parameter("size", 0.0, "1", 0.0, 50.0), Parameter("angle", 0.0, "rad", 0.0, 2.0 * np.pi, shape=True, scale=1.0,
                                                          period=2.0 * np.pi),
    )  # fmt: skip

    def run(thetas: Array) -> Array:
        gain, size, angle = thetas.T[:, :, None]
        return (gain * x[0] + size * (np.cos(angle) * x[1] + np.sin(angle) * x[2]))[:, None, :]

    return Stage(
        "plane", ("y",), ("1",), (Parameter("gain", 1.0, "1", 0.0, 2.0, 0.5),), (Effect("force", parameters, starts),),
        run, T, run(np.array([[1.1, size, angle]]))[0] + FLOOR * x[3:], floor=np.array([FLOOR]),
    )  # fmt: skip


@CRITERIA
@given(size=st.floats(0.5, 9.0), angle=st.floats(0.0, 6.28))
@settings_of(max_examples=examples(5), deadline=None)
def test_a_direction_is_found_wherever_it_points(criterion: Any, size: float, angle: float) -> None:
    stage = turning(21, size, angle, ((1.0, 0.0),))
    search = Search(criterion(LeastSquaresProblem(stage, np.array([FLOOR]))))
    found = search.single("force").theta
    assert found[1] == pytest.approx(size, rel=0.2, abs=0.05)
    assert np.cos(found[2] - angle) > 0.99


def test_from_each_direction_a_fit_begins_with_the_size_that_is_best_there() -> None:
    stage = turning(22, 4.0, 1.0, ((1.0, 0.0),))
    judge = LeastSquaresProblem(stage, np.array([FLOOR]))
    search = Search(LikelihoodAcceptance(judge))
    base = search.base
    e0, jac = judge.linearise(base.theta, base.free)
    thetas = search._turned(stage.effects[0], e0, jac)
    assert [t[2] for t in thetas] == pytest.approx([2.0 * np.pi * k / len(thetas) for k in range(len(thetas))])
    x, prior = waves(22, 4), np.sqrt(base.prior[0])
    measured = stage.measured[0] / FLOOR
    for theta in thetas:
        way = np.cos(theta[2]) * x[1] + np.sin(theta[2]) * x[2]
        a = np.vstack([np.column_stack([x[0], way]) / FLOOR, [prior, 0.0]])
        straight = np.linalg.lstsq(a, np.append(measured, prior), rcond=None)[0]
        if straight[1] < 0.0:  # a force has no negative size
            assert theta[1] == 0.0
        elif abs(straight[0] - 1.0) < 0.5:  # else the gain stands at its limit
            assert theta[:2] == pytest.approx(straight, abs=0.02)
    plain = linear({effect("a"): x[1]}, x[0], x[0])
    still = Search(LikelihoodAcceptance(LeastSquaresProblem(plain, np.array([FLOOR]))))
    assert still._turned(plain.effects[0], e0, jac) == []


@CRITERIA
@pytest.mark.parametrize("truth", [0.83, 1.7, 4.6])
def test_a_size_that_acts_in_steps_is_found_between_its_starts(criterion: Any, truth: float) -> None:
    x = waves(23, 3)

    def run(thetas: Array) -> Array:  # in whole steps of a tenth, so that it has no slope
        return (thetas[:, :1] * x[0] + np.floor(10.0 * thetas[:, 1:2] + 0.5) / 10.0 * x[1])[:, None, :]

    steps = Effect("steps", (Parameter("size", 0.0, "1", 0.0, 9.0),), ((0.5,), (1.0,), (2.0,), (5.0,)))
    stage = Stage(
        "s", ("y",), ("1",), (Parameter("gain", 1.0, "1", 0.0, 2.0, 0.5),), (steps,), run, T,
        run(np.array([[1.0, truth]]))[0] + FLOOR * x[2:], floor=np.array([FLOOR]),
    )  # fmt: skip
    search = Search(criterion(LeastSquaresProblem(stage, np.array([FLOOR]))))
    found = search.single("steps")
    assert found.theta[1] == pytest.approx(truth, abs=0.11)
    assert search.judge.total_of(found) < 1.0 * search.judge.total_of(search.base)


@CRITERIA
def test_a_law_is_never_worse_than_one_that_it_holds_and_that_one_is_reached_from_it(criterion: Any) -> None:
    x = waves(24, 4)
    shape = Parameter("fade", 0.0, "1", 0.0, 99.0, shape=True, scale=1.0)
    wide = Effect(
        "wide", (Parameter("size", 0.0, "1", -50.0, 50.0), shape), ((1.0, 90.0),), holds=(("narrow", (None, 0.0)),)
    )  # where it begins, it does nothing

    def run(thetas: Array) -> Array:
        gain, wide, fade, narrow = thetas.T[:, :, None]
        return (gain * x[0] + (narrow + wide * np.exp(-fade * np.abs(x[2]))) * x[1])[:, None, :]

    stage = Stage(
        "s", ("y",), ("1",), (Parameter("gain", 1.0, "1", 0.0, 2.0, 0.5),), (wide, effect("narrow")), run, T,
        run(np.array([[1.0, 3.0, 0.1, 0.0]]))[0] + FLOOR * x[3:], floor=np.array([FLOOR]),
    )  # fmt: skip
    judge = LeastSquaresProblem(stage, np.array([FLOOR]))
    search = Search(criterion(judge))
    narrow = search.single("narrow")
    wider = search.single("wide")
    assert judge.total_of(wider) < 1.3 * judge.n < judge.total_of(narrow)
    assert wider.theta[[1, 2, 3]] == pytest.approx([3.0, 0.1, 0.0], abs=0.05)
    search.fits.pop(frozenset(["narrow"]))
    (simpler,) = search.simpler(wider, "wide")
    assert simpler.effects == ("narrow",) and simpler.theta == pytest.approx(narrow.theta, abs=1e-3)
    assert search.fits[frozenset(["narrow"])] is simpler
    assert search.simpler(narrow, "narrow") == []


@CRITERIA
def test_a_law_without_a_slope_is_reached_from_where_the_one_that_it_holds_leads(criterion: Any) -> None:
    x = waves(29, 4)
    width = Parameter("width", 0.0, "1", 0.0, 9.0, shape=True, scale=1.0)
    wide = Effect(
        "wide", (Parameter("size", 0.0, "1", -50.0, 50.0), width), ((-9.0, 8.0),), holds=(("narrow", (None, 0.0)),),
        onward=lambda of: [(of[0], 5.0), (of[0], 1.0)],
    )  # fmt: skip

    def run(thetas: Array) -> Array:  # by whole widths, so that no step between two tells anything
        gain, size, width, narrow = thetas.T[:, :, None]
        return (gain * x[0] + (narrow + size * (np.abs(x[1]) > 0.5 * np.round(width))) * x[1])[:, None, :]

    stage = Stage(
        "s", ("y",), ("1",), (Parameter("gain", 1.0, "1", 0.0, 2.0, 0.5),), (wide, effect("narrow")), run, T,
        run(np.array([[1.0, 3.0, 1.0, 0.0]]))[0] + FLOOR * x[3:], floor=np.array([FLOOR]),
    )  # fmt: skip
    search = Search(criterion(LeastSquaresProblem(stage, np.array([FLOOR]))))
    narrow, wider = search.single("narrow"), search.single("wide")
    assert search.judge.total_of(wider) < 1.3 * search.judge.n < search.judge.total_of(narrow)
    assert wider.theta[1:] == pytest.approx([3.0, 1.0, 0.0], abs=0.05)


def test_outputs_that_have_their_own_sizes_are_gone_towards_each_on_its_own() -> None:
    sizes = tuple(Parameter(c, 0.0, "1") for c in "pq")
    shape = Parameter("shape", 0.0, "1", shape=True)
    assert _ways(Effect("e", sizes, ()), [0, 2], 3) == [[0], [2]]
    assert _ways(Effect("e", (*sizes, shape), ()), [0, 2, None], 3) == [[0], [2]]
    assert _ways(Effect("e", sizes, ()), [0, None], 3) == [[0, 1, 2]]
    assert _ways(Effect("e", sizes, ()), [1, 1], 3) == [[0, 1, 2]]
    assert _ways(Effect("e", (shape, shape), ()), [None, None], 2) == [[0, 1]]


# ---- names -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("alike", [0.0, 1.0], ids=["apart", "together"])
@pytest.mark.parametrize("truth", ["time", "temperature"])
def test_a_law_with_another_cause_is_told_from_it_or_said_to_be_inseparable(truth: str, alike: float) -> None:
    x = waves(25, 4)
    other = alike * x[1] + (1.0 - alike) * x[2]
    of = {"time": x[1], "temperature": other}

    def run(cause: str) -> Any:
        return lambda thetas: (thetas[:, :1] * x[0] + thetas[:, 1:2] * of[cause])[:, None, :]

    stage = Stage(
        "s", ("y",), ("1",), (Parameter("gain", 1.0, "1", 0.0, 2.0, 0.5),), (effect("drift"),), run("time"), T,
        run(truth)(np.array([[1.0, 0.5]]))[0] + FLOOR * x[3:], floor=np.array([FLOOR]),
        twins={"drift": ("temperature", run("temperature"))},
        alike={"drift": lambda named: f"a leak of {named['drift']['drift0']['value']:.1f}"},
    )  # fmt: skip
    d = diagnose_stage(stage, np.array([FLOOR]))
    if alike:
        (f,) = d.effects
        assert f.inseparable == ["temperature", "a leak of 0.5"] and not f.other_cause
    elif truth == "time":
        (f,) = d.effects
        assert f.inseparable == ["a leak of 0.5"] and not f.other_cause and f.nats > 100.0
    else:
        assert d.verdict == "unknown" and not d.effects


@pytest.mark.parametrize("within", [True, False])
def test_an_effect_at_its_bound_gives_way_to_one_that_does_as_well_within(within: bool) -> None:
    x = waves(26, 4)
    bounded = Effect("bounded", (Parameter("size", 0.0, "1", -2.0, 2.0),), ((-1.0,), (1.0,)))
    library = {bounded: x[1], effect("b"): 2.0 * x[1] if within else x[2]}
    measured = x[0] + 2.0 * x[1] + FLOOR * x[3] + 0.01 * x[1]
    d = diagnose_stage(linear(library, measured, x[0]), np.array([FLOOR]))
    if within:
        assert d.verdict == "missing" and names(d) == ["b"] and d.effects[0].rivals == []
    else:
        assert d.verdict == "unknown" and not d.effects and d.nearest == ["bounded"]
        assert d.refused == ["bounded fits only at the end of its physical range"]
        (last,) = (of for of in d.decisions if "physical range" in {v.rule for v in of.verdicts})
        assert (last.added, last.beside, last.accepted) == (("bounded",), (), False)


def test_extending_tells_the_error_with_each_effect_in_the_order_in_which_they_do_most() -> None:
    x = waves(27, 5)
    measured = x[0] + 1.0 * x[1] + 3.0 * x[2] + FLOOR * x[3]
    stage = linear({effect("a"): x[1], effect("b"): x[2], effect("c"): x[4]}, measured, x[0])
    d = extend_stage(stage, ("a", "b"))
    assert [name for name, _ in d.steps] == ["nominal", "+ b", "+ a"] and d.verdict == "missing"
    for columns, (_, rms) in zip(([0], [0, 2], [0, 1, 2]), d.steps, strict=True):
        least = np.linalg.lstsq(x[columns].T, measured, rcond=None)[0]
        assert rms == pytest.approx(np.std(measured - least @ x[columns]) / FLOOR, rel=0.03)
    assert {f.effect: f.fall for f in d.effects} == pytest.approx({"a": 10.0, "b": 30.0}, rel=0.2)
    assert [f.parameters[f"{f.effect}0"]["value"] for f in d.effects] == pytest.approx([1.0, 3.0], abs=0.05)
    assert extend_stage(stage, ()).verdict == "none"
    with pytest.raises(StageError, match="no effect 'd'; it has a, b, c"):
        extend_stage(stage, ("d",))


def test_no_name_rests_on_a_channel_that_lacks_bits() -> None:
    x = waves(28, 3)
    stage = linear({effect("a"): x[1]}, x[0] + 3.0 * x[1] + FLOOR * x[2], x[0])
    assert names(diagnose_stage(stage, np.array([FLOOR]))) == ["a"]
    d = diagnose_stage(replace(stage, coarse={"u": "u lacks bits"}), np.array([FLOOR]))
    assert (d.verdict, d.effects, d.nearest, d.refused) == ("unknown", [], ["a"], ["u lacks bits"])
    clean = linear({effect("a"): x[1]}, x[0] + FLOOR * x[2], x[0])  # nothing rests on how it is driven
    for coarse, verdict in (("u", "none"), ("y", "unknown")):
        assert diagnose_stage(replace(clean, coarse={coarse: "lacks bits"}), np.array([FLOOR])).verdict == verdict


@pytest.mark.parametrize(("left", "verdict"), [(2.7, "missing"), (3.4, "unknown")])
def test_no_output_makes_up_for_another(left: float, verdict: str) -> None:
    x = np.random.default_rng(49).standard_normal((2, 4, N))
    floors = np.array([FLOOR, 3.0 * FLOOR])

    def run(thetas: Array) -> Array:
        return np.einsum("sp,opn->son", thetas, x[:, :2])

    measured = run(np.array([[1.0, 3.0]]))[0] + floors[:, None] * x[:, 2]
    measured[1] += floors[1] * np.sqrt(left**2 - 1.0) * x[1, 3]
    stage = Stage(
        "s", ("y", "z"), ("1", "1"), (Parameter("gain", 1.0, "1", 0.0, 2.0, 0.5),), (effect("a"),), run, T, measured,
        floor=floors,
    )  # fmt: skip
    d = diagnose_stage(stage, floors)
    assert d.excess < 3.0 and (d.verdict, d.final.effects) == (verdict, ("a",))


@given(left=st.floats(0.5, 200.0), fall=st.floats(0.5, 2e4), share=st.floats(-0.5, 1.5))
@settings_of(max_examples=examples(20), deadline=None)
def test_trust_is_a_logistic_function_of_what_is_left_of_the_fall_and_of_the_share(
    left: float, fall: float, share: float
) -> None:
    for criterion, (one, of_left, of_fall, of_share) in TRUST_COEFFICIENTS.items():
        score = one + of_left * np.log(min(max(left, 1.0), TRUST_MOST_LEFT))
        score += of_fall * np.log(min(max(fall, 1.0), TRUST_MOST_FALL)) + of_share * (min(max(share, 0.0), 1.0) - 1.0)
        p = trust(criterion, {"left": left, "fall": fall, "share": share})
        assert np.log(p / (1.0 - p)) == pytest.approx(score, abs=1e-6)


# ---- long logs -------------------------------------------------------------------------------------------------------

LONG = 2400  # samples
PARTS = {"LONG_SAMPLES": 2000, "EXCERPT_PIECE": 60, "EXCERPT_SAMPLES": 600}


def long(library: dict[str, Array], measured: Array, lead: Array) -> Stage:
    """A linear stage of many samples, of which excerpts can be taken."""
    rows = np.vstack([lead, *library.values()])

    def on(at: Any) -> Stage:
        return Stage(
            name="long", outputs=("y",), units=("1",), parameters=(Parameter("gain", 1.0, "1", 0.0, 2.0, 0.5),),
            effects=tuple(effect(name) for name in library), run=lambda thetas: (thetas @ rows[:, at])[:, None, :],
            t=0.1 * np.arange(LONG)[at], measured=measured[at], floor=np.array([FLOOR]),
        )  # fmt: skip

    return replace(on(slice(None)), excerpt=on)


@pytest.mark.parametrize("case", ["everywhere", "in one stretch", "clean"])
def test_what_an_excerpt_finds_is_fitted_to_the_whole_log(case: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in PARTS.items():
        monkeypatch.setattr(f"vaneloop.identification.selection.diagnosis.{name}", value)
    x = np.random.default_rng(31).standard_normal((5, LONG))
    if case == "in one stretch":
        x[2] *= (np.arange(LONG) >= 1000) & (np.arange(LONG) < 1080)
    sizes = {"everywhere": (0.5, 0.3), "in one stretch": (0.5, 1.0), "clean": (0.0, 0.0)}[case]
    measured = 1.1 * x[0] + np.array(sizes) @ x[1:3] + FLOOR * x[4]
    stage = long({"a": x[1], "b": x[2], "c": x[3]}, measured, x[0])
    ticks: list[int] = []
    d = diagnose_stage(stage, np.array([FLOOR]), tick=lambda: ticks.append(1))
    assert names(d) == ([] if case == "clean" else ["a", "b"]) and len(ticks) > (0 if case == "clean" else 3)
    assert d.verdict == ("none" if case == "clean" else "missing")
    columns = [0] if case == "clean" else [0, 1, 2]
    prior = np.eye(1, len(columns)) * np.sqrt(12.0)
    least = lsq_linear(np.vstack([x[columns].T / FLOOR, prior]), np.append(measured / FLOOR, np.sqrt(12.0)))
    assert d.final.theta[columns] == pytest.approx(least.x, abs=1e-5) and d.final.theta[3] == 0.0
    assert d.final.cost.sum() == pytest.approx(np.sum((measured - least.x @ x[columns]) ** 2) / FLOOR**2)
    assert d.base.effects == () and d.base.theta[1:] == pytest.approx([0.0, 0.0, 0.0])
    assert d.excess == pytest.approx(1.0, abs=0.05)
    for f in d.effects:
        k = 1 if f.effect == "a" else 2
        assert f.parameters[f"{f.effect}0"]["value"] == pytest.approx(least.x[k], abs=1e-5)
        without = np.linalg.lstsq(x[[0, 3 - k]].T, measured, rcond=None)
        assert f.fall == pytest.approx(np.sqrt(without[1][0] / LONG) / FLOOR, rel=0.1)


@pytest.mark.parametrize("quiet", [True, False])
def test_a_search_ahead_on_an_excerpt_ends_at_the_fits_of_the_whole(
    quiet: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in {"AHEAD_SAMPLES": 600, "SHORT_PIECE": 60}.items():
        monkeypatch.setattr(f"vaneloop.identification.selection.subsampled_search.{name}", value)
    x = np.random.default_rng(32).standard_normal((6, LONG))
    measured = 1.1 * x[0] + (0.0 if quiet else 0.5 * x[1] - 0.4 * x[3]) + FLOOR * x[5]
    stage = long({"a": x[1], "b": x[2], "c": x[3], "d": x[4]}, measured, x[0])
    ahead = searched(LikelihoodAcceptance(LeastSquaresProblem(stage, np.array([FLOOR]))), LikelihoodAcceptance, None)
    assert isinstance(ahead, SubsampledSearch)
    _, fit, candidates, steps = _search(ahead)
    assert sorted(fit.effects) == ([] if quiet else ["a", "c"]) and len(candidates) == 4
    assert [len(s[0].split(" + ")) for s in steps[1:]] == (
        [] if quiet else sorted(len(s[0].split(" + ")) for s in steps[1:])
    )
    columns = [0] if quiet else [0, 1, 3]
    prior = np.eye(1, len(columns)) * np.sqrt(12.0)
    least = lsq_linear(np.vstack([x[columns].T / FLOOR, prior]), np.append(measured / FLOOR, np.sqrt(12.0)))
    assert fit.theta[columns] == pytest.approx(least.x, abs=1e-4)
    assert ahead.judge.total_of(fit) == pytest.approx(2.0 * least.cost, rel=1e-6)
    for name, (left, theta) in ({} if quiet else ahead._promises(ahead.base)).items():
        k = "abcd".index(name) + 1  # what acts linearly leaves what was promised of it
        a = np.vstack([x[[0, k]].T / FLOOR, [np.sqrt(12.0), 0.0]])
        alone = lsq_linear(a, np.append(measured / FLOOR, np.sqrt(12.0)))
        assert theta[[0, k]] == pytest.approx(alone.x, abs=1e-3)
        moved = a[-1, 0] * (alone.x[0] - ahead.base.theta[0])  # a prior holds what is fitted where the base has it
        assert left == pytest.approx(2.0 * alone.cost, abs=10.0 + abs(moved) * 1e3)
    part = [] if quiet else [key for key in ahead.ahead.finished if len(key) == 1]
    assert quiet or len(part) >= 2
    for key in part:  # what leads on the excerpt has its fits there finished
        judge, f = ahead.ahead.judge, ahead.ahead.fits[key]
        columns = [0, *("abcd".index(e) + 1 for e in key)]
        at = np.searchsorted(0.1 * np.arange(LONG), judge.stage.t)
        prior = np.eye(1, 2) * np.sqrt(12.0)
        least = lsq_linear(
            np.vstack([x[columns][:, at].T / FLOOR, prior]), np.append(measured[at] / FLOOR, prior[0, 0])
        )
        assert f.theta[columns] == pytest.approx(least.x, abs=1e-4)
    found, _ = ahead.criterion.name(ahead, fit, candidates)
    assert all(f.rivals == [] and f.probability > 0.99 for f in found) and len(found) == len(fit.effects)


@given(
    pieces=st.integers(4, 40), piece=st.integers(5, 60), many=st.integers(1, 20), worst=st.integers(0, 39),
    seed=st.integers(0, 99),
)  # fmt: skip
@settings_of(max_examples=examples(10), deadline=None)
def test_an_excerpt_is_half_evenly_spaced_and_half_where_the_model_fails_most(
    pieces: int, piece: int, many: int, worst: int, seed: int
) -> None:
    n, worst = pieces * piece + seed % piece, worst % pieces
    error = np.random.default_rng(seed).standard_normal(n)
    error[worst * piece : (worst + 1) * piece] += 50.0
    stage: Any = SimpleNamespace(t=0.1 * np.arange(n), window=None, counted=None)
    judge: Any = SimpleNamespace(stage=stage, errors=lambda _: error[None, None])
    fit: Any = SimpleNamespace(theta=np.zeros(1))
    at = excerpt_of(judge, fit, piece, many * piece)
    chosen = np.unique(at // piece)
    assert len(at) == len(chosen) * piece and np.array_equal(at, np.sort(at)) and at[-1] < pieces * piece
    count = min(max(many, 2), pieces)
    assert len(chosen) == count and worst in chosen
    even = np.round(np.linspace(0, pieces - 1, count - count // 2)).astype(int)
    assert np.isin(even, chosen).all()
    first = excerpt_of(judge, None, piece, many * piece)  # without a fit only what is evenly spaced
    assert np.array_equal(np.unique(first // piece), np.unique(even))
    stage.counted = lambda rows: rows // piece % 2 == 0  # every other piece tells nothing
    told = np.unique(excerpt_of(judge, fit, piece, many * piece) // piece)
    if count <= (pieces + 1) // 2:
        assert not np.any(told % 2)


def test_a_search_is_sent_ahead_where_a_stage_is_twice_as_long_as_it(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("Search", "SubsampledSearch"):
        monkeypatch.setattr(subsampled_search, name, lambda *given, name=name: (name, *given))
    known: Any = object.__new__(LikelihoodAcceptance)
    for criterion, n, excerpt, ahead in (
        (known, 16_000, abs, True), (known, 15_999, abs, False), (known, 16_000, None, False),
        (SimpleNamespace(), 16_000, abs, False),
    ):  # fmt: skip
        criterion.judge = SimpleNamespace(stage=SimpleNamespace(excerpt=excerpt, t=range(n)))
        wanted = ("SubsampledSearch", criterion, max, None) if ahead else ("Search", criterion, None)
        assert subsampled_search.searched(criterion, max, None) == wanted  # type: ignore[arg-type, comparison-overlap]
