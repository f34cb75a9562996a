"""The search on stages that are linear in their parameters, where linear algebra knows every answer: the fits that it
makes, what it names, exchanges, takes out and leaves unnamed.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as settings_of
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

from tests.conftest import examples
from vaneloop.identification import Effect, Parameter, Stage
from vaneloop.identification.least_squares.problem import Fit, LeastSquaresProblem
from vaneloop.identification.results import StageDiagnosis, rms_of
from vaneloop.identification.selection import likelihood_acceptance as likelihood
from vaneloop.identification.selection.diagnosis import _search, diagnose_stage
from vaneloop.identification.selection.likelihood_acceptance import LikelihoodAcceptance
from vaneloop.identification.selection.relative_error_acceptance import RelativeErrorAcceptance, score, structure
from vaneloop.identification.selection.screening import Linearisation, along, onward, out_of, within
from vaneloop.identification.selection.search import Search
from vaneloop.identification.settings import PER_PARAMETER, RIVAL
from vaneloop.identification.subsystem import Array

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
    search, fit, _, steps = _search(Search(criterion(judge)))
    assert sorted(fit.effects) == ["b", "d"] and len(search.fits) > 6
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


@pytest.mark.parametrize("truth", ["one", "two", "all"])
def test_a_law_of_many_parameters_gives_way_to_one_or_two_that_do_its_work(truth: str) -> None:
    x = waves(5, 8)
    sizes = {"one": (4.0, 0.0, 0.0), "two": (4.0, 3.0, 0.0), "all": (4.0, 3.0, 3.5)}[truth]
    measured = x[0] + np.array(sizes) @ x[1:4] + FLOOR * 12.0 * x[4]
    library = {effect("flexible", 3): x[1:4], effect("a"): x[1], effect("b"): x[2], effect("other"): x[5]}
    d = relative(linear(library, measured, x[0]))
    assert names(d) == {"one": ["a"], "two": ["a", "b"], "all": ["flexible"]}[truth]


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
    first = relative(stage)
    (by_fit,) = first.effects
    (f,) = d.effects
    other = {"a": "like_a", "like_a": "a"}
    assert by_fit.rivals == [other[by_fit.effect]] and f.rivals == [other[f.effect]] and f.probability <= 0.5
    assert f.effect == (by_fit.effect if prefers == "neither" else prefers)
    said = f"{by_fit.effect} and {prefers} do equally well on the fitted log; the test logs prefer {prefers}"
    assert d.notes == ([] if f.effect == by_fit.effect else [said])


@pytest.mark.parametrize(("left", "verdict"), [(1.1, "none"), (1.4, "unknown")])
def test_what_no_effect_explains_is_unknown_from_a_quarter_above_the_noise(left: float, verdict: str) -> None:
    x = waves(8, 3)
    noise = waves(9, 1)[0]
    measured = x[0] + FLOOR * left * noise / np.std(noise)
    d = relative(linear({effect("a"): x[1], effect("b"): x[2]}, measured, x[0]))
    assert d.verdict == verdict and not d.effects and d.criterion == "error_share"


def test_a_name_that_leaves_much_is_none_and_is_said_to_come_nearest() -> None:
    x = waves(10, 4)
    measured = x[0] + 3.0 * x[1] + 2.2 * x[3]  # the second part is nobody's
    d = relative(linear({effect("a"): x[1], effect("b"): x[2]}, measured, x[0]))
    assert d.verdict == "unknown" and not d.effects and d.nearest[0] == "a"
    share = 2.2**2 * np.var(x[3]) / (9.0 * np.var(x[1]) + 2.2**2 * np.var(x[3]))
    (said,) = d.refused
    assert said.startswith("a comes nearest and leaves ")
    assert float(said.split()[-4].rstrip("%")) == pytest.approx(100.0 * np.sqrt(share), abs=3.0)


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
    tolerance = 0.2 if narrow else 50.0
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
    both = np.column_stack([np.vstack([a[:-2]]), -d])
    ridge = np.zeros((2, 3))
    ridge[:, :2] = a[-2:]
    best = np.linalg.lstsq(np.vstack([both, ridge]), np.append(e0, [0.0, 0.0]), rcond=None)[0]
    share, promise = slopes.line(errors[None])
    if 0.0 < best[2] < 100.0 and np.abs(d).max() > 1e-3:
        assert share[0] == pytest.approx(best[2], rel=1e-4, abs=1e-6)
        assert promise[0] == pytest.approx(
            np.sum((e0 - both @ best) ** 2) + np.sum((ridge @ best) ** 2), rel=1e-6, abs=1e-6
        )


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
    if moved is not None:
        assert moved.tolist() == pytest.approx([min(2.0 + share, 9.0), 4.0])
    else:
        assert share == pytest.approx(1.0, abs=0.2)


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
