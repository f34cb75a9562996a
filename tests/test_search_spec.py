"""Parts of the search, each by itself, against linear algebra and scipy: steps within bounds, what slopes promise, fits
that are gone on from, effects that begin, and what a search on an excerpt passes over.
"""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as settings_of
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

from tests.conftest import examples
from vaneloop.identification import Effect, Parameter, Stage, StageError
from vaneloop.identification.least_squares.noise import correlation_of
from vaneloop.identification.least_squares.problem import Fit, LeastSquaresProblem
from vaneloop.identification.onset import onset_of, that_begins
from vaneloop.identification.results import StageDiagnosis, answer_of, found_of, rms_of
from vaneloop.identification.selection import diagnosis
from vaneloop.identification.selection.diagnosis import EffectSelection, extend_stage, floor_of
from vaneloop.identification.selection.likelihood_acceptance import LikelihoodAcceptance, _above_floor, as_close
from vaneloop.identification.selection.relative_error_acceptance import RelativeErrorAcceptance, structure
from vaneloop.identification.selection.rules import BEGINS, Comparison
from vaneloop.identification.selection.screening import Linearisation, _best_within, _solved, followed
from vaneloop.identification.selection.search import Search
from vaneloop.identification.selection.subsampled_search import SubsampledSearch, _tried, spread
from vaneloop.identification.subsystem import Array

# docs/settings.md
SPREADS, BLOCK_SPREADS, FLOOR_KNOWN, NATS, DIRECTIONS, TOLERATED = 3.0, 8.0, 0.01, 12.0, 12, 1.05
FITTED_BESIDE, FITTED_ALONE, SHORT_PIECE, AHEAD_SAMPLES, SCREEN_LINE = 8, 12, 500, 8000, (0.02, 5.0)

N = 240
T = 0.1 * np.arange(N)  # s
FLOOR = np.array([0.1, 0.2])
PRIOR = np.sqrt(12.0)  # of a gain that is known to 0.5: its standard deviation is that over the root of three


def effect(name: str, starts: tuple[float, ...] = (-1.0, 1.0), parameters: int = 1, **more: Any) -> Effect:
    sizes = tuple(Parameter(f"{name}{k}", 0.0, "1", -50.0, 50.0) for k in range(parameters))
    return Effect(name, sizes, tuple((s,) * parameters for s in starts), **more)


def linear(x: Array, measured: Array, names: str = "abc", **more: Any) -> Stage:
    """A stage linear in a gain and its effects: signals float64[1 + effects, outputs, samples]."""
    outputs = ("y", "z")[: x.shape[1]]
    effects = more.pop("effects", tuple(effect(n) for n in names))
    return Stage(
        name=more.pop("name", "sum"), outputs=outputs, units=("1",) * len(outputs), effects=effects,
        parameters=(Parameter("gain", 1.0, "1", 0.0, 2.0, 0.5),), measured=measured,
        run=lambda thetas: np.einsum("sp,pon->son", thetas, x), t=0.1 * np.arange(x.shape[2]),
        floor=FLOOR[: len(outputs)], **more,
    )  # fmt: skip


def signals(seed: int, effects: int = 3, outputs: int = 1, n: int = N) -> Array:
    return np.random.default_rng(seed).standard_normal((effects + 1, outputs, n))


def with_noise(seed: int, x: Array, *sizes: float) -> Array:
    noise = FLOOR[: x.shape[1], None] * np.random.default_rng(1000 + seed).standard_normal(x.shape[1:])
    return np.asarray(np.einsum("p,pon->on", np.array(sizes), x[: len(sizes)]) + noise)


def problem(stage: Stage) -> LeastSquaresProblem:
    return LeastSquaresProblem(stage, floor_of(stage))


def least(x: Array, measured: Array, columns: list[int]) -> Any:
    """What scipy makes of these columns, the gain first, which is known to 0.5."""
    floor = FLOOR[: x.shape[1], None]
    a = (x[columns] / floor).reshape(len(columns), -1).T
    a = np.vstack([a, np.eye(1, len(columns)) * PRIOR])
    return lsq_linear(a, np.append((measured / floor).ravel(), PRIOR))


# ---- slopes ----------------------------------------------------------------------------------------------------------


@given(seed=st.integers(0, 999), k=st.integers(1, 6), narrow=st.floats(0.05, 3.0))
@settings_of(max_examples=examples(30), deadline=None)
def test_a_step_within_bounds_is_the_one_that_scipy_finds(seed: int, k: int, narrow: float) -> None:
    rng = np.random.default_rng(seed)
    rows, wanted = rng.standard_normal((k + 3, k)), 2.0 * rng.standard_normal(k + 3)
    low, high = -narrow * rng.random(k), narrow * rng.random(k)
    low[rng.random(k) < 0.2] = 0.0  # already at a bound
    held = rng.random(k) < 0.2
    low[held] = high[held] = 0.0
    step = _best_within(rows.T @ rows, rows.T @ wanted, low, high)
    assert np.all(step >= low - 1e-12) and np.all(step <= high + 1e-12) and not step[held].any()
    free = ~held
    if free.any():
        low, high = low[free], np.maximum(high[free], low[free] + 1e-12)
        best = lsq_linear(rows[:, free], wanted, (low, high), tol=1e-12)
        left = 0.5 * np.sum((rows @ step - wanted) ** 2)
        assert left == pytest.approx(best.cost, rel=1e-6, abs=1e-9)


def test_of_many_solutions_the_least_is_taken() -> None:
    a = np.array([[2.0, 2.0], [2.0, 2.0]])  # an offset and a gain that are one
    assert _solved(a, np.array([4.0, 4.0])) == pytest.approx([1.0, 1.0])
    assert _solved(np.diag([2.0, 4.0]), np.array([4.0, 4.0])) == pytest.approx([2.0, 1.0])


@given(seed=st.integers(0, 99))
@settings_of(max_examples=examples(10), deadline=None)
def test_what_is_left_when_the_model_follows_is_that_of_its_least_squares(seed: int) -> None:
    x = signals(seed, 3, 2)
    stage = linear(x, with_noise(seed, x, 1.1, 0.4))
    judge = problem(stage)
    base = judge.fit((), stage.neutral())
    slopes = Linearisation(judge, base.theta, base.free, base.prior)
    thetas = np.repeat(base.theta[None], 3, axis=0)
    thetas[np.arange(3), [1, 2, 3]] = [0.5, -0.8, 2.0]
    errors = judge.errors(thetas)
    gain = slopes.jac[0].ravel() / judge.scale[0]
    prior = np.append(gain, PRIOR)
    step, lefts = slopes._follow(errors)
    for e, theta, left, s in zip(errors, thetas, lefts, step[:, 0], strict=True):
        # what follows is measured from where it stands; the prior holds it there
        moved = lsq_linear(prior[:, None], np.append(e.ravel(), 0.0), (-theta[0], 2.0 - theta[0])).x[0]
        assert s * judge.scale[0] == pytest.approx(moved, abs=1e-6)
        assert left == pytest.approx(np.sum((e.ravel() - gain * moved) ** 2) + (PRIOR * moved) ** 2, rel=1e-6)
        own, after = slopes.follow(e, np.array([-0.01]), np.array([0.01]))
        held = np.clip(moved / judge.scale[0], -0.01, 0.01)
        assert own[0] == pytest.approx(held) and after == pytest.approx(e - held * slopes.jac[0])
    share, promised = slopes.line(errors)
    for k in range(3):
        way = ((errors[k] - slopes.error) / 1.0).ravel()
        a = np.vstack([np.column_stack([gain, -way]), [PRIOR, 0.0]])
        free = np.linalg.lstsq(a, np.append(slopes.error.ravel(), 0.0), rcond=None)
        times = np.clip(free[0][1], *SCREEN_LINE)
        assert share[k] == pytest.approx(times, rel=1e-5)
        rest = np.linalg.lstsq(a[:, :1], np.append(slopes.error.ravel() + times * way, 0.0), rcond=None)[1][0]
        assert promised[k] == pytest.approx(rest, rel=1e-6)
    nowhere, left_there = slopes.line(slopes.error[None])  # a set that changes nothing promises nothing
    assert nowhere.tolist() == [SCREEN_LINE[0]] and left_there[0] == pytest.approx(np.sum(slopes.error**2), rel=1e-4)


@given(seed=st.integers(0, 99), split=st.booleans())
@settings_of(max_examples=examples(10), deadline=None)
def test_one_goes_towards_each_set_of_errors_as_far_as_is_best(seed: int, split: bool) -> None:
    x = signals(seed, 2, 2)
    stage = linear(x, with_noise(seed, x, 1.1, 0.4), "ab")
    judge = problem(stage)
    base = judge.fit((), stage.neutral())
    slopes = Linearisation(judge, base.theta, base.free, base.prior)
    theta = base.theta.copy()
    theta[1] = 0.1
    groups = [[[0], [1]] if split else [[0, 1]]]
    ((left, step, times),) = slopes.towards(judge.errors(theta[None]), groups)
    ways = slopes.error - judge.errors(theta[None])[0]
    own = [np.where(np.isin([0, 1], outputs)[:, None], ways, 0.0).ravel() for outputs in groups[0]]
    a = np.column_stack([slopes.jac[0].ravel() / judge.scale[0], *own])
    a = np.vstack([a, np.eye(1, a.shape[1]) * PRIOR])
    room = ([-base.theta[0], *[0.0] * len(own)], [2.0 - base.theta[0], *[SCREEN_LINE[1]] * len(own)])
    best = lsq_linear(a, np.append(slopes.error.ravel(), 0.0), room)
    assert left == pytest.approx(2.0 * best.cost, rel=1e-6)
    assert times == pytest.approx(best.x[1:], abs=1e-5) and step * judge.scale[:1] == pytest.approx(
        best.x[:1], abs=1e-5
    )


@pytest.mark.parametrize("many", [1, 16, 17, 40])
def test_sets_are_moved_to_where_the_model_has_followed(many: int) -> None:
    x = signals(4)
    stage = linear(x, with_noise(4, x, 1.3, 0.4))
    judge = problem(stage)
    base = judge.fit((), stage.neutral())
    thetas = [base.theta + np.array([0.0, 0.02 * k, 0.0, 0.0]) for k in range(many)]
    given_there, given_arrays = [theta.copy() for theta in thetas], list(thetas)
    errors, lefts = followed(judge, thetas, base.free, base.prior)
    assert errors == pytest.approx(judge.errors(np.array(given_there)), abs=1e-9)
    assert all(np.array_equal(was, now) for was, now in zip(given_there, given_arrays, strict=True))
    for theta, before, left in zip(thetas, given_there, lefts, strict=True):
        assert theta[1:].tolist() == before[1:].tolist()
        rest = (stage.measured - before[1] * x[1]).ravel() / FLOOR[0]
        a = np.append(x[0].ravel() / FLOOR[0], PRIOR)[:, None]
        moved = np.linalg.lstsq(a, np.append(rest - before[0] * a[:-1, 0], 0.0), rcond=None)
        assert theta[0] == pytest.approx(before[0] + moved[0][0], abs=1e-6) and left == pytest.approx(moved[1][0])


# ---- fits ------------------------------------------------------------------------------------------------------------


def search_of(stage: Stage, criterion: Any = LikelihoodAcceptance, **more: Any) -> Search:
    return Search(criterion(problem(stage), **more))


def test_a_fit_is_never_worse_than_its_part_and_is_fitted_anew_from_there() -> None:
    x = signals(5)
    measured = with_noise(5, x, 1.1, 2.0, -1.5)
    search = search_of(linear(x, measured))
    judge = search.judge
    alone = search.single("a")
    lost = replace(search.base, effects=("a", "b"))  # as bad as the model without either
    (again,) = judge.together([search._no_worse(lost)])
    best = least(x, measured, [0, 1, 2])
    assert again.effects == ("a", "b") and judge.total_of(again) == pytest.approx(2.0 * best.cost, rel=1e-6)
    assert again.theta[:3] == pytest.approx(best.x, abs=1e-4)
    (same,) = judge.together([search._no_worse(again)])
    assert same is again and judge.total_of(alone) > judge.total_of(again)
    search.fits[frozenset("a")] = lost_alone = replace(search.base, effects=("a",))
    (other,) = judge.together([search._no_worse(lost_alone)])
    assert judge.total_of(other) <= judge.total_of(search.base)


def test_where_one_effect_leads_to_another_is_tried_once() -> None:
    """A law of two numbers whose own starts lie in another valley, and the plain law that it holds."""
    x = signals(6, 1)
    plain = Effect("plain", (Parameter("size", 0.0, "1", -9.0, 9.0),), ((-1.0,), (1.0,)))
    sizes = (Parameter("size", 0.0, "1", -9.0, 9.0), Parameter("bend", 0.0, "1", 0.0, 20.0))
    whole = Effect(
        "whole",
        sizes,
        ((1.0, 9.0),),
        holds=(("plain", (None, 0.0)),),
        onward=lambda v: [(v[0] / b, b) for b in (0.3, 0.1)],
    )
    asked: list[int] = []

    def run(thetas: Array) -> Array:
        asked.append(len(thetas))
        gain, size, own, bend = thetas.T[:, :, None]
        return (gain * x[0] + size * x[1] + own * np.sin(np.minimum(bend, 6.0) * x[1] + 1e-3 * x[1]))[:, None, :]

    stage = replace(linear(x, np.zeros((1, N)), effects=(plain, whole)), run=run)
    stage.measured = run(np.array([[1.1, 0.0, 3.0, 0.35]]))[0] + FLOOR[0] * signals(7, 0)[0]
    search = search_of(stage)
    assert search._held(("whole",)) == []
    search.single("plain")
    assert [(name, held) for name, held, _ in search._held(("whole",))] == [("whole", "plain")]
    assert search._held(("whole", "plain")) == []  # both are there
    bad = replace(search.base, effects=("whole",), free=np.array([0, 2, 3]))
    (led,) = search.judge.together([search._led_on(bad)])
    assert led.theta[2:] == pytest.approx([3.0, 0.35], abs=0.1)
    asked.clear()
    (again,) = search.judge.together([search._led_on(led)])
    assert again is led and asked == []  # from there it was tried
    plainly = search.fits[frozenset(("plain",))]
    search.fits[frozenset(("plain",))] = replace(plainly, theta=1.01 * plainly.theta)
    search.judge.together([search._led_on(led)])
    assert asked  # another fit may lead elsewhere


def test_a_pair_is_begun_from_its_effects_where_none_of_them_was_fitted() -> None:
    x = signals(8)
    measured = with_noise(8, x, 1.1, 2.0, -1.5, 0.7)
    search = search_of(linear(x, measured), RelativeErrorAcceptance)
    for names in (("a", "b"), ("c", "a", "b")):
        fit = search.joined(names)
        best = least(x, measured, [0, *(1 + "abc".index(n) for n in names)])
        assert search.judge.total_of(fit) == pytest.approx(2.0 * best.cost, rel=1e-6) and fit.effects == names
        assert frozenset(names) in search.finished and search.joined(names) is search.fits[frozenset(names)]
    (rough,) = search.judge.together([search._joined(("a", "c"), False)])
    assert rough.effects == ("a", "c") and frozenset("ac") not in search.finished  # enough to rank it
    assert search.joined(()) is search.base


def test_without_an_effect_the_model_is_fitted_also_from_where_it_led() -> None:
    """The model's gain has two valleys: from 1 it comes down to the wrong one."""
    x = signals(9, 1)[:, 0]

    def run(thetas: Array) -> Array:
        gain, size = thetas.T[:, :, None]
        return ((gain - 0.9) ** 2 * (gain - 2.4) * x[0] + size * x[1])[:, None, :]

    gain = Parameter("gain", 1.0, "1", 0.0, 4.0, 3.0)
    stage = Stage("s", ("y",), ("1",), (gain,), (effect("a"),), run, T, np.zeros((1, N)), floor=FLOOR[:1])
    stage.measured = run(np.array([[3.0, 0.0]]))[0] + FLOOR[0] * x[:1]
    for criterion in (LikelihoodAcceptance, RelativeErrorAcceptance):
        search = search_of(stage, criterion)
        assert search.base.theta[0] < 2.0
        far = search.judge.fit(("a",), np.array([2.9, 0.3]))
        assert far.theta == pytest.approx([3.0, 0.0], abs=0.1)
        less = search.without(far, "a")
        if criterion is RelativeErrorAcceptance:
            assert less.theta[0] == pytest.approx(3.0, abs=0.1) and search.base is less is search.fits[frozenset()]
        else:
            assert less is search.base


@pytest.mark.parametrize("criterion", [LikelihoodAcceptance, RelativeErrorAcceptance])
def test_a_model_loses_what_it_does_not_need(criterion: Any) -> None:
    x = signals(10)
    measured = with_noise(10, x, 1.1, 2.0, 0.0, 1.5)
    search = search_of(linear(x, measured), criterion)
    search.singles(["a", "b", "c"])
    assert search.pruned(search.joined(("a", "b", "c"))).effects == ("a", "c")
    alone = search.single("b")
    assert search.pruned(alone) is alone and search.pruned(search.base) is search.base
    assert {frozenset(f.effects) for f in search.beside(("a",))} <= {frozenset("ab"), frozenset("ac")}


def test_an_effect_is_exchanged_for_a_better_one() -> None:
    x = signals(11)
    x[2] = x[1] + 0.7 * x[2]  # nearly the truth
    measured = with_noise(11, x, 1.1, 3.0)
    search = search_of(linear(x, measured), RelativeErrorAcceptance)
    search.singles(["a", "b", "c"])
    criterion: Any = search.criterion
    assert criterion._swapped(search, search.single("b"), ["a", "b", "c"]).effects == ("a",)
    best = search.single("a")
    assert criterion._swapped(search, best, ["a", "b", "c"]) is best
    assert criterion._swapped(search, search.single("b"), ["b", "c"]).effects == ("b",)  # of those that may be named


def test_an_exchange_leaves_no_more_of_the_whole_log() -> None:
    x = signals(13, 2)
    search = search_of(
        linear(x, with_noise(13, x, 1.1, 3.0), effects=(effect("a"), effect("b"))), RelativeErrorAcceptance
    )
    fit, criterion = search.single("a"), cast(Any, search.criterion)
    for times, more in ((1.09, False), (1.12, True), (0.5, False)):  # e^(2 RIVAL) = 1.105
        assert criterion._leaves_more(fit, replace(fit, held_out=times * fit.held_out)) == more


def test_effects_that_do_the_same_are_one_leader() -> None:
    x = signals(14)
    x[2] = x[1]  # b does what a does
    search = search_of(linear(x, with_noise(14, x, 1.1, 3.0, 0.0, 2.0)), RelativeErrorAcceptance)
    singles = search.singles(["a", "b", "c"])
    leaders = EffectSelection(search, singles, ["a", "b", "c"], []).leaders
    assert leaders(["a", "b", "c"]) == ["a", "c"] and leaders(["b", "c", "a"]) == ["b", "c"]
    vanes = search_of(linear(x, search.stage.measured))
    assert EffectSelection(vanes, vanes.singles(["a", "b", "c"]), [], []).leaders(["a", "b", "c"]) == ["a", "b", "c"]


def test_the_least_of_many_effects_with_fewest_is_chosen() -> None:
    x = signals(12)
    measured = with_noise(12, x, 1.1, 2.0, -1.5)
    search = search_of(linear(x, measured))
    singles = search.singles(["a", "b", "c"])
    steps: list[tuple[str, float]] = []
    choice = EffectSelection(search, singles, ["a", "b", "c"], steps)
    pair = search.joined(("a", "b"))
    assert choice.wants_more(search.base) and not choice.wants_more(pair)
    found = choice.finalists(search.base)
    assert {f.effects for f in found} == {("a",), ("b",), ("c",)}  # two of which leave nothing but noise together
    assert choice.chosen(search.base, [*found, pair]).effects == ("a", "b")
    assert steps == [("a + b", rms_of(search.judge, pair))]
    only = [singles["b"], singles["a"]]
    best = min(only, key=search.criterion.order)
    assert choice.chosen(search.base, only) is best and len(steps) == 2
    assert choice.accepted(search.base, [*only, search.base]) == only
    beside = choice.finalists(best)
    assert all(len(f.effects) == 2 and set(best.effects) <= set(f.effects) for f in beside) and len(beside) == 2
    assert choice.pruned([search.base, pair])[-1] is pair and len(steps) == 2


# ---- the noise floor -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("side", [0.995, 1.005])
@pytest.mark.parametrize(("each", "known"), [(100, 0.01), (100_000, 0.01), (100_000, 0.05)])
def test_a_model_fails_above_its_floor_over_the_log_or_in_a_block(side: float, each: int, known: float) -> None:
    samples = np.full(8, each)
    judge: Any = SimpleNamespace(n=8 * each, samples=samples, expected=lambda: np.ones(8))

    def fails(rms: Array, correlation: float = 2.0) -> bool:
        return _above_floor(judge, SimpleNamespace(held_out=rms**2 * samples), correlation, known)  # type: ignore[arg-type]

    whole = 1.0 + max(SPREADS * np.sqrt(2.0 / (2.0 * 8 * each)), known)
    assert fails(np.full(8, 1.0 + side * (whole - 1.0))) == (side > 1.0)
    block = 1.0 + known + BLOCK_SPREADS * np.sqrt(2.0 / (2.0 * each))
    quiet = np.full(8, 0.5)
    quiet[3] = 1.0 + side * (block - 1.0)
    assert fails(quiet) == (side > 1.0)
    judge.expected = lambda: np.where(np.arange(8) == 3, 9.0, 1.0)
    assert not fails(quiet)  # where the raster makes expect as much
    judge.expected = lambda: np.ones(8)
    samples[3] = 0.19 * each  # a block of few samples decides nothing
    judge.n = int(samples.sum())
    quiet = np.where(np.arange(8) == 3, 4.0 if each == 100 else 1.2, 0.05)
    assert not fails(quiet)
    samples[3] = 0.21 * each
    assert fails(quiet)
    judge.n = 0
    samples[:] = 0
    assert not fails(quiet)


def test_where_nobody_knows_the_noise_a_model_fails_a_tenth_above_it() -> None:
    judge: Any = SimpleNamespace(n=100)
    for error, fails in ((1.09, False), (1.11, True)):
        fit: Any = SimpleNamespace(held_out=np.full(4, 25.0 * error**2))
        assert RelativeErrorAcceptance(judge).fails(fit) == fails


@pytest.mark.parametrize(("excess", "limit"), [(1.0, TOLERATED), (2.0, 2.0 * (1.0 + FLOOR_KNOWN))])
def test_a_rival_of_another_stage_comes_as_close_as_the_answer(excess: float, limit: float) -> None:
    judge: Any = SimpleNamespace(n=100)
    d: Any = SimpleNamespace(excess=excess)
    for side in (0.999, 1.001):
        fit: Any = SimpleNamespace(held_out=np.full(4, 25.0 * (side * limit) ** 2))
        assert as_close(judge, d, fit) == (side < 1.0)


def test_the_floor_comes_with_the_stage() -> None:
    stage = linear(signals(1), np.zeros((1, N)))
    assert floor_of(stage) is stage.floor
    for floor in (None, np.array([np.nan])):
        stage.floor = floor
        with pytest.raises(StageError, match="subsystem 'sum': no noise floor"):
            floor_of(stage)


def test_a_model_is_asked_again_where_the_noise_was_lower() -> None:
    stage = linear(signals(1), np.zeros((1, N)))
    fit: Any = SimpleNamespace(theta=stage.neutral())
    told: list[tuple[float, bool]] = []

    def ask(floor: Array, last: bool) -> tuple[Fit, Any]:
        told.append((float(floor[0]), last))
        return fit, len(told)

    levels = iter([0.5, 0.25, 0.125, 0.1])
    stage.noise = lambda t, e: next(levels)
    assert diagnosis._down_to(stage, np.array([1.0]), ask) == 3 and told == [(1.0, False), (0.5, False), (0.25, False)]
    told.clear()
    stage.noise = lambda t, e: 0.91
    assert diagnosis._down_to(stage, np.array([1.0]), ask) == 1
    stage.noise = None
    told.clear()
    stage.hidden = lambda theta: np.array([2.0 * theta[1]])
    fit.theta = stage.neutral() + np.array([0.0, 1.0, 0.0, 0.0])
    assert diagnosis._down_to(stage, np.array([1.0]), ask) == 2
    assert told == [(1.0, False), (pytest.approx(np.hypot(1.0, 2.0)), True)]


def test_extending_tells_the_error_of_the_model_s_own_step() -> None:
    x = signals(13)
    stage = linear(x, with_noise(13, x, 1.1, 2.0))
    run = stage.run
    stage.finer = lambda thetas: run(thetas) + 0.05 * x[3]
    d = extend_stage(stage, ("a",))
    assert [s[0] for s in d.steps] == ["nominal", "+ a", "without numerical error"]
    numerical = np.sqrt(np.mean((0.05 * x[3] / FLOOR[0]) ** 2))
    assert d.steps[2][1] == pytest.approx(np.sqrt(d.steps[1][1] ** 2 - numerical**2))
    assert d.steps[1][1] == d.excess and (d.verdict, extend_stage(stage, ()).verdict) == ("missing", "none")
    with pytest.raises(StageError, match="subsystem 'sum' has no effect 'q'; it has a, b, c"):
        extend_stage(stage, ("a", "q"))


# ---- effects that begin ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("case", ["found", "nearest", "nothing", "never settles", "all along"])
def test_a_time_is_sought_where_effects_all_along_leave_more_than_noise(case: str) -> None:
    x = signals(14, 2, n=400)
    stage = that_begins(lambda x: linear(x, np.zeros((1, 400)), "ab"))(x)
    stage.memory = 4.0
    acts = 0.1 * np.arange(400) > (26.33 if case != "all along" else -1.0)
    stage.measured = x[0] + 2.0 * acts * x[1] + FLOOR[0] * signals(15, 0, n=400)[0]
    asked: list[float | None] = []

    def ask(later: Stage) -> StageDiagnosis:
        judge = problem(later)
        asked.append(onset_of(later, later.neutral()))
        base, fit = (judge.fit(e, later.neutral()) for e in ((), ("a",)))
        if case == "nothing" or (case == "nearest" and len(asked) == 2):
            d = answer_of(judge, "unknown", base, base, [], [])
            d.nearest = ["a", "b"] if case == "nearest" else []
            return d
        d = answer_of(judge, "missing", base, fit, found_of(judge, fit, ("a",), {"a": base}), [])
        return replace(d, verdict="unknown") if case == "never settles" else d

    said = diagnosis._whenever(stage, None, LikelihoodAcceptance, ask)
    if case == "all along":
        assert asked == [None] and said.onset is None and said.verdict == "missing"
    elif case == "nothing":
        assert len(asked) == 2 and said.onset is None and said.verdict == "unknown"
    elif case == "never settles":
        assert said.onset is None and said.verdict == "unknown" and asked[0] is None and 2 <= len(asked) <= 5
    else:
        assert said.onset is not None and said.onset.value == pytest.approx(26.35, abs=0.11)
        assert said.onset.low < said.onset.value < said.onset.high and said.verdict == "missing"
        assert (
            asked[0] is None and asked[1] is not None and abs(asked[1] - 26.33) < 3.4 and asked[-1] == said.onset.value
        )
        assert len(asked) == 3  # a block's beginning, and the time itself
        (verdict,) = (v for one in said.decisions for v in one.verdicts if v.rule == BEGINS.name)
        judge = problem(stage)
        thetas = np.array([problem(stage).fit(("a",), stage.neutral()).theta, said.final.theta])
        nats = 0.5 * np.subtract(*judge.totals(judge.errors(thetas), thetas))
        assert verdict.holds and verdict.value == pytest.approx(nats, rel=0.5)
        assert verdict.limit == pytest.approx(NATS + np.log(judge.n_blocks))


# ---- a search on an excerpt ------------------------------------------------------------------------------------------


def test_a_direction_is_tried_all_round_with_the_middle_size() -> None:
    turn = Parameter("way", 0.0, "rad", -1.0, 5.0, period=6.0)
    size = Parameter("size", 0.0, "1", 0.0, 9.0)
    round_it = Effect("e", (size, turn), ((0.1, 0.0), (1.0, 0.0), (5.0, 0.0)))
    tried = _tried(round_it)
    assert [s[0] for s in tried] == [1.0] * DIRECTIONS and {len(s) for s in tried} == {2}
    assert [s[1] for s in tried] == pytest.approx([-1.0 + 0.5 * k for k in range(DIRECTIONS)])
    assert _tried(effect("a")) == [(-1.0,), (1.0,)]


@given(pieces=st.integers(1, 60), many=st.integers(1, 30), wanted=st.lists(st.integers(0, 59), max_size=40))
@settings_of(max_examples=examples(25), deadline=None)
def test_half_of_the_pieces_are_spread_evenly_and_the_others_as_wanted(
    pieces: int, many: int, wanted: list[int]
) -> None:
    wanted = [k for k in wanted if k < pieces]
    got = spread(pieces, many, wanted)
    count = min(many, pieces)
    assert got == sorted(set(got)) and len(got) <= count
    even = {int(k) for k in np.round(np.linspace(0, pieces - 1, count - count // 2))}
    assert even <= set(got)
    further = list(dict.fromkeys(k for k in wanted if k not in even))[: count - len(even)]
    assert set(got) == even | set(further)


LONG = 2400


def ahead(seed: int, sizes: tuple[float, ...], monkeypatch: pytest.MonkeyPatch) -> SubsampledSearch:
    """A search of a long stage with fourteen effects, which is sent ahead on a quarter of it."""
    for name, value in {"AHEAD_SAMPLES": 600, "SHORT_PIECE": 60}.items():
        monkeypatch.setattr(f"vaneloop.identification.selection.subsampled_search.{name}", value)
    x = signals(seed, 14, n=LONG)
    measured = with_noise(seed, x, *sizes)

    def on(at: Any) -> Stage:
        part = linear(x[..., at], measured[:, at], "abcdefghijklmn")
        return replace(part, t=0.1 * np.arange(LONG)[at])

    stage = replace(on(slice(None)), excerpt=on)
    return SubsampledSearch(LikelihoodAcceptance(problem(stage)), LikelihoodAcceptance, None)


def test_of_many_sets_those_are_tried_that_promise_most(monkeypatch: pytest.MonkeyPatch) -> None:
    search = ahead(16, (1.1, 3.0, 0.0, 1.0, 0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2), monkeypatch)
    singles = search.singles(list("abcdefghijklmn"))
    assert singles["a"].effects == ("a",) and len(singles) == 14
    sets = [("a", n) for n in "bcdefghijklmn"]
    best_of, asked = search.ahead.best_of, []

    def noted(given_sets: Any) -> list[Fit]:
        asked.append(list(given_sets))
        return best_of(given_sets)

    monkeypatch.setattr(search.ahead, "best_of", noted)
    found = search.best_of(sets)
    assert asked == [[("a", n) for n in "cdefghij"]] and len(asked[0]) == FITTED_BESIDE
    assert found[0].effects == ("a", "c")
    assert [search.criterion.order(f) for f in found] == sorted(search.criterion.order(f) for f in found)
    asked.clear()
    few = sets[: FITTED_BESIDE + 2]
    search.best_of(few)
    assert [s for s in few if frozenset(s) not in {frozenset(f.effects) for f in found}] == [
        s for s in few if s in asked[0] or s[1] in "".join(f.effects[1] for f in found)
    ] or len(asked[0]) <= len(few)
    again = search.best_of([("a", "c")])
    assert again[0] is search.fits[frozenset("ac")]  # what is fitted is not sent ahead again
    x, measured = signals(16, 14, n=LONG), search.stage.measured
    best = least(x, measured, [0, 1, 3])
    assert search.judge.total_of(again[0]) == pytest.approx(2.0 * best.cost, rel=1e-6)


def test_of_many_effects_alone_those_are_tried_that_promise_most(monkeypatch: pytest.MonkeyPatch) -> None:
    search = ahead(18, (1.1, *(0.2 + 0.1 * k for k in range(14))), monkeypatch)
    asked: list[list[tuple[str, ...]]] = []
    monkeypatch.setattr(search.ahead, "best_of", lambda sets: asked.append(sets) or [search.ahead.base])
    monkeypatch.setattr(search, "_fitted", lambda rough, most: [])
    monkeypatch.setattr(search, "_rough", lambda f: replace(f, effects=("n",)))
    assert set(search.singles(list("abcdefghijklmn"))) == set("abcdefghijklmn")
    assert {*asked[0]} == {(n,) for n in "cdefghijklmn"} and len(asked[0]) == FITTED_ALONE


def test_a_search_ahead_is_made_on_pieces_of_five_hundred_samples() -> None:
    n = 24_000
    got: list[Array] = []

    class Done(Exception):
        pass

    def excerpt(at: Array) -> Stage:
        got.append(at)
        raise Done

    error = np.random.default_rng(1).standard_normal(n)
    search: Any = object.__new__(SubsampledSearch)
    search.stage = SimpleNamespace(t=0.1 * np.arange(n), window=None, counted=None, excerpt=excerpt)
    search.judge = SimpleNamespace(stage=search.stage, errors=lambda _: error[None, None])
    search.base = SimpleNamespace(theta=np.zeros(1))
    with pytest.raises(Done):
        _ = search.ahead
    (at,) = got
    assert len(at) == AHEAD_SAMPLES and np.array_equal(np.unique(at // SHORT_PIECE, return_counts=True)[1], [500] * 16)


def test_what_the_excerpt_says_is_held_against_the_whole_log(monkeypatch: pytest.MonkeyPatch) -> None:
    search = ahead(17, (1.1, 3.0, 0.0, 1.0), monkeypatch)
    there = search.ahead.single("a")
    rough = search._rough(there)
    judge = search.judge
    assert rough.effects == ("a",) and judge.block_costs(judge.errors(rough.theta[None]))[0] == pytest.approx(
        rough.cost
    )
    assert np.array_equal(rough.cost, rough.held_out) and not rough.gradients.any() and not rough.normals.any()
    x = signals(17, 14, n=LONG)
    assert judge.total_of(rough) < 1.01 * 2.0 * least(x, search.stage.measured, [0, 1]).cost
    fit = search.single("a")
    assert fit is search.single("a") is search.fits[frozenset("a")]
    assert judge.total_of(fit) == pytest.approx(2.0 * least(x, search.stage.measured, [0, 1]).cost, rel=1e-7)
    left, theta = search._part(replace(fit, effects=("a", "b")))
    assert left == judge.total_of(fit) and theta is fit.theta
    assert search._known_promise(("z", "b"))[0] == np.inf and judge.roughly and search.ahead.judge.roughly
    pair = search.rivals(search.joined(("a", "c")), [("a", "b"), ("a", "c")], 1.0)
    assert [f.effects for f in pair] == [("a", "c")]  # b leaves far too much to be one


# ---- where fits begin, and what is kept of them ----------------------------------------------------------------------


def test_a_pair_begins_at_the_best_of_what_its_effects_had_alone_and_of_their_starts() -> None:
    x = signals(20)
    measured = with_noise(20, x, 1.1, 2.0, -1.5)
    search = search_of(linear(x, measured, effects=tuple(effect(n, (-1.0, 0.5)) for n in "abc")))
    judge, index = search.judge, search.stage.index()
    singles = search.singles(["a", "b"])
    (begins,) = judge.together([search._begins(("a", "b"))])
    totals = []
    for leave, rest in (("a", "b"), ("b", "a")):
        for size in (search.starts[leave][0], singles[leave].theta):
            theta = singles[rest].theta.copy()
            theta[index[leave]] = size[index[leave]]
            totals.append(judge.totals(judge.errors(theta[None]), theta[None])[0])
    (led,) = begins
    assert led.total == pytest.approx(min(totals)) and len(set(np.round(totals, 6))) == 4
    assert judge.totals(judge.errors(led.theta[None]), led.theta[None])[0] == pytest.approx(led.total)
    roams = search_of(linear(x, measured), RelativeErrorAcceptance)
    for name in "ab":  # one start that leads nowhere: those of the effect are tried beside the other
        roams.starts[name] = [roams.base.theta.copy()]
    roams.fits[frozenset("a")] = roams.judge.fit(("a",), np.array([1.0, 1.0, 0.0, 0.0]))
    (begins,) = roams.judge.together([roams._begins(("a", "b"))])
    best = least(x, measured, [0, 1, 2])
    assert len(begins) == 2 and [b.total for b in begins] == sorted(b.total for b in begins)
    assert begins[0].total == pytest.approx(2.0 * best.cost, rel=1e-3)
    nothing = roams.judge.errors(roams.base.theta[None])[0]
    assert roams._left(frozenset(), nothing) == np.inf  # a size that changes nothing leads nowhere


def test_the_reach_of_an_effect_is_what_its_largest_sizes_change() -> None:
    x = signals(21, 2)
    measured = with_noise(21, x, 1.1, 1.0)
    search = search_of(linear(x, measured, effects=(effect("a", (1.0,)), effect("b", (3.0,)))))
    base = search.base.cost.sum()
    for k, (name, size) in enumerate((("a", 1.0), ("b", 3.0)), 1):
        rest = (measured - size * x[k]).ravel() / FLOOR[0]
        a = np.append(x[0].ravel() / FLOOR[0], PRIOR)[:, None]
        left = np.linalg.lstsq(a, np.append(rest - search.base.theta[0] * a[:-1, 0], 0.0), rcond=None)[1][0]
        assert search.reach[name] == pytest.approx(abs(left - base), rel=1e-5)
    assert search.level["a"] < base < search.level["b"]


def test_an_effect_is_tried_from_every_place_where_a_model_without_it_may_have_lost_its_way() -> None:
    x = signals(23, 2)
    measured = with_noise(23, x, 1.1, 1.0)
    stage = linear(x, measured, effects=(effect("a", (1.0, -1.0)), effect("b", (3.0,))))
    lost = np.array([[1.0, 0.0, 0.0], [0.55, 0.0, 0.0], [1.45, 0.0, 0.0]])  # as the user has it, and two more
    search = search_of(replace(stage, begins=lost), RelativeErrorAcceptance)
    for name in "ab":
        assert {float(start[0]) for start in search.starts[name]} >= {0.55, 1.45}


def test_a_start_that_a_quick_fit_has_led_on_from_stays_with_the_others() -> None:
    x = signals(22)
    search = search_of(linear(x, with_noise(22, x, 1.1, 2.0)), RelativeErrorAcceptance)
    starts = [search.base.theta + np.array([0.0, size, 0.0, 0.0]) for size in (9.0, 1.0, -4.0)]
    search.starts["a"] = starts
    (total,) = search.judge.together([search._followed("a")])
    best = least(x, search.stage.measured, [0, 1])
    assert total == pytest.approx(2.0 * best.cost, rel=1e-4) and len(search.starts["a"]) == 3
    for start in search.starts["a"]:  # the law was fitted from each: a linear one comes to the best from anywhere
        assert start[:2] == pytest.approx(best.x, abs=1e-2)


@pytest.mark.parametrize("side", [0.999, 1.001])
@pytest.mark.parametrize("correlation", [1.0, 3.0])
def test_an_effect_shows_that_could_change_the_squares_by_twice_the_nats(side: float, correlation: float) -> None:
    criterion = LikelihoodAcceptance(SimpleNamespace())  # type: ignore[arg-type]
    criterion.correlation = correlation
    assert criterion.shows(side * 2.0 * NATS * correlation) == (side > 1.0)


def test_how_much_errors_are_alike_is_learnt_from_the_best_fit() -> None:
    x = signals(23, 0)
    e = x[0, 0].copy()
    for i in range(1, N):
        e[i] += 0.8 * e[i - 1]
    stage = linear(signals(24), signals(24)[0] + FLOOR[0] * e[None])
    judge = problem(stage)
    criterion = LikelihoodAcceptance(judge)
    assert (criterion.correlation, criterion.known, criterion.left_out) == (1.0, FLOOR_KNOWN, {})
    fit = judge.fit((), stage.neutral())
    criterion.learn(fit)
    assert criterion.correlation == correlation_of(judge, fit) > 2.0
    assert criterion.gain(fit, fit) == (0.0, 0.0)
    other = replace(fit, held_out=0.5 * fit.held_out)
    assert criterion.gain(fit, other)[0] == pytest.approx(0.25 * fit.held_out.sum() / criterion.correlation)
    assert Comparison(judge, fit, other).gain[0] == pytest.approx(0.25 * fit.held_out.sum())


def test_two_effects_that_help_only_together_are_tried_with_the_leader() -> None:
    x = signals(25)
    x[1], x[2] = x[1] + 0.1 * x[2], -x[1] + 0.1 * x[2]
    measured = with_noise(25, x, 1.0, 10.0, 10.0)
    search = search_of(linear(x, measured), RelativeErrorAcceptance)
    singles = search.singles(["a", "b", "c"])
    assert not any(search.criterion.accepts(search.base, f) for f in singles.values())
    for first in "ab":
        ranked = [first, "c"]
        choice = EffectSelection(search, singles, ranked, [])
        found = choice.finalists(search.base)
        assert frozenset("ab") in {frozenset(f.effects) for f in found}
        assert choice.chosen(search.base, choice.accepted(search.base, found)).effects in (("a", "b"), ("b", "a"))


def test_a_pair_is_taken_where_the_best_single_fails_and_the_rules_accept_it() -> None:
    one: Any = SimpleNamespace(effects=("a",), held_out=np.ones(4))
    pair: Any = SimpleNamespace(effects=("a", "b"), held_out=np.ones(4))
    for fails, accepts in ((True, True), (True, False), (False, True), (False, False)):
        criterion: Any = SimpleNamespace(
            order=lambda f: len(f.effects), fails=lambda f, fails=fails: fails, accepts=lambda b, f, ok=accepts: ok
        )
        search: Any = SimpleNamespace(
            criterion=criterion, judge=SimpleNamespace(n=4), stage=SimpleNamespace(effects=(effect("a"), effect("b")))
        )
        choice = EffectSelection(search, {}, [], [])
        assert choice.chosen(one, [pair, one]) is (pair if fails and accepts else one)


def test_what_is_not_needed_in_the_end_is_told_as_a_step() -> None:
    x = signals(26)
    search = search_of(linear(x, with_noise(26, x, 1.1, 2.0, 0.0, 1.5)))
    singles = search.singles(["a", "b", "c"])
    steps: list[tuple[str, float]] = []
    choice = EffectSelection(search, singles, ["a", "c", "b"], steps)
    *_, last = choice.pruned([search.base, search.joined(("a", "b", "c"))])
    assert last.effects == ("a", "c") and steps == [("a + c", rms_of(search.judge, last))]


@pytest.mark.parametrize("side", [0.95, 1.05])
def test_an_effect_is_exchanged_for_one_that_is_better_by_two_per_cent(side: float) -> None:
    judge = SimpleNamespace(
        n=400, samples=np.full(4, 100), stage=SimpleNamespace(grain=1.0, effects=(effect("a"), effect("b")))
    )

    def fit(name: str, error: float, free: int = 2) -> Any:
        return SimpleNamespace(effects=(name,), held_out=np.full(4, 100.0 * error**2), free=np.arange(free))

    criterion: Any = RelativeErrorAcceptance(judge)  # type: ignore[arg-type]
    mine, other = fit("a", 5.0), fit("b", 5.0 * np.exp(-side * 0.02))
    search: Any = SimpleNamespace(best_of=lambda sets: [other] if sets[0][-1] == "b" else [mine], pruned=lambda f: f)
    assert criterion._swapped(search, mine, ["a", "b"]) is (other if side > 1.0 else mine)
    other.free, criterion.accepts = np.arange(3), lambda before, after: False
    other.held_out *= 0.8
    assert criterion._swapped(search, mine, ["a", "b"]) is mine  # one that is freer must be worth it
    criterion.accepts = lambda before, after: True
    assert criterion._swapped(search, mine, ["a", "b"]) is other


def test_a_pair_of_an_excerpt_follows_to_the_whole_log_and_is_no_worse_than_its_part(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    search = ahead(27, (1.4, 3.0, 0.0, 1.0), monkeypatch)
    judge = search.judge
    ticks: list[int] = []
    search.ahead.tick = lambda: ticks.append(1)
    search.ahead.judge.together([search.ahead._quick("a")])
    assert len(ticks) == 1
    search.ahead.judge.together([search.ahead._joined(("b",), False)])
    assert frozenset("b") in search.ahead.fits and frozenset("b") not in search.ahead.finished  # quick ones alone
    search.ahead.judge.together([search.ahead._joined(("b",), True)])
    assert frozenset("b") in search.ahead.finished
    rough = search._rough(search.ahead.joined(("a", "c")))
    assert judge.block_costs(judge.errors(rough.theta[None]))[0] == pytest.approx(rough.cost, rel=1e-9)
    alone = search.single("a")
    search.fits[frozenset("ab")] = replace(search.base, effects=("a", "b"))
    (pair,) = judge.together([search._from(replace(search.base, effects=("a", "b")))])
    assert judge.total_of(pair) <= judge.total_of(alone)


# ---- what an excerpt says, on the whole log --------------------------------------------------------------------------


def excerpt_said(stage: Stage, rows: slice, effects: tuple[str, ...]) -> tuple[StageDiagnosis, LeastSquaresProblem]:
    """The answer of a part of the log with these effects, whether they are there or not."""
    run = stage.run
    part = replace(
        stage,
        t=stage.t[rows],
        measured=stage.measured[:, rows],
        run=lambda thetas: run(thetas)[..., rows],
        excerpt=None,
    )
    judge = problem(part)
    base, fit = (judge.fit(e, part.neutral()) for e in ((), effects))
    found = found_of(judge, fit, effects, dict.fromkeys(effects, base))
    for f in found:
        f.rivals, f.nats = ["r"], 77.0
    return answer_of(judge, "missing", base, fit, found, []), judge


@pytest.mark.parametrize(
    ("sizes", "kept"), [((2.0, 0.0, 1.5), ("a", "c")), ((2.0, 1.0, 1.5), ("a", "b", "c")), ((0.0, 0.0, 0.0), ())]
)
def test_what_the_whole_log_does_not_need_goes(sizes: tuple[float, ...], kept: tuple[str, ...]) -> None:
    x = signals(30, n=600)
    stage = linear(x, with_noise(30, x, 1.1, *sizes))
    said, _ = excerpt_said(stage, slice(0, 150), ("a", "b", "c"))
    judge = problem(stage)
    base = judge.fit((), stage.neutral())
    found = diagnosis._confirm(stage, None, stage.floor, base, said, LikelihoodAcceptance)  # type: ignore[arg-type]
    columns = [0, *(1 + "abc".index(n) for n in kept)]
    best = least(x, stage.measured, columns)
    assert found.final.effects == kept and found.final.theta[columns] == pytest.approx(best.x, abs=1e-4)
    assert [f.effect for f in found.effects] == list(kept) and found.verdict == ("missing" if kept else "none")
    assert found.base is base and found.correlation == correlation_of(judge, found.final)
    names = [s[0] for s in found.steps]
    assert names == (["nominal", " + ".join(kept)] if kept else ["nominal"])
    assert found.steps[0][1] == rms_of(judge, base) and found.steps[-1][1] == rms_of(judge, found.final)
    for f in found.effects:
        assert f.parameters[f"{f.effect}0"]["value"] == found.final.theta[1 + "abc".index(f.effect)]
        rest = least(x, stage.measured, [c for c in columns if c != 1 + "abc".index(f.effect)])
        assert f.fall == pytest.approx(np.sqrt(rest.cost / best.cost), rel=0.05)
        assert f.rivals == ["r"] and f.nats == 77.0  # as the excerpt has them
    lower = replace(said, floor=0.99 * FLOOR[:1])
    again = diagnosis._confirm(stage, None, stage.floor, base, lower, LikelihoodAcceptance)  # type: ignore[arg-type]
    assert again.base is not base and again.floor[0] == pytest.approx(0.99 * FLOOR[0])


@pytest.mark.parametrize(
    ("answers", "asked"),
    [
        ([("missing", "missing")], 1), ([("unknown", "unknown")], 1), ([("none", "none")], 1),
        ([("missing", "unknown"), ("missing", "missing")], 2), ([("missing", "unknown"), ("missing", "unknown")], 2),
    ],
)  # fmt: skip
def test_a_second_excerpt_is_taken_where_the_whole_log_shows_more(
    answers: list[tuple[str, str]], asked: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of each excerpt what it says, and what the whole log makes of that."""
    x = signals(31, n=400)
    stage = linear(x, with_noise(31, x, 1.1))
    run = stage.run
    stage.excerpt = lambda at: replace(
        stage, t=stage.t[at], measured=stage.measured[:, at], run=lambda thetas: run(thetas)[..., at], excerpt=None
    )
    monkeypatch.setattr(diagnosis, "LONG_SAMPLES", 400)
    left: list[Any] = []
    finals = [object(), object()]

    def excerpt(judge: Any, fit: Any, piece: int, samples: int) -> Array:
        left.append(fit)
        assert (piece, samples) == (4000, 40_000)
        return np.arange(0, 400, 2)

    told = iter(answers)
    whole: list[str] = []

    def whenever(part: Stage, own: Any, judged: Any, ask: Any) -> Any:
        one, other = next(told)
        whole.append(other)
        assert len(part.t) == 200 and (own is None or own.shape == (200,))
        return SimpleNamespace(verdict=one)

    def confirm(*given: Any) -> Any:
        return SimpleNamespace(verdict=whole[-1], final=finals[len(whole) - 1], effects=[], nearest=[])

    monkeypatch.setattr(diagnosis, "excerpt_of", excerpt)
    monkeypatch.setattr(diagnosis, "_whenever", whenever)
    monkeypatch.setattr(diagnosis, "_confirm", confirm)
    for keep in (None, np.ones(400, dtype=bool)):
        left.clear(), whole.clear()
        told = iter(answers)
        d = diagnosis.diagnose_stage(stage, FLOOR[:1], keep)
        assert d.verdict == answers[asked - 1][1] and len(whole) == asked
        assert left[0] is None and len(left) == asked + 1 and isinstance(left[1], Fit)
        if asked == 2:
            assert left[2] is finals[0]  # where the first answer fails most
    stage.t = stage.t[:399]  # one sample fewer is searched whole
    told = iter([("none", "none")])
    monkeypatch.setattr(diagnosis, "_whenever", lambda *_: SimpleNamespace(verdict="whole", effects=[], nearest=[]))
    assert diagnosis.diagnose_stage(stage, FLOOR[:1]).verdict == "whole"


def test_a_better_nominal_model_that_the_search_found_is_noted(monkeypatch: pytest.MonkeyPatch) -> None:
    x = signals(32)
    stage = linear(x, with_noise(32, x, 1.1, 2.0))
    for better in (False, True):

        def found(search: Search, better: bool = better) -> Any:
            if better:
                search.base = replace(search.base, held_out=0.25 * search.base.held_out)
            return search, search.single("a"), [], [("nominal", 1.0)]

        monkeypatch.setattr(diagnosis, "_search", found)
        d = diagnosis._to_the_floor(stage, FLOOR[:1], None, None, LikelihoodAcceptance)
        was = rms_of(problem(stage), d.base)
        says = (
            f"with nothing added sum reaches {0.5 * was:.4g} noise floors, not {was:.4g}, from the best parameters of "
            f"the search"
        )
        assert d.notes == ([says] if better else []) and d.verdict == "missing"


def test_the_last_word_is_asked_where_nobody_can_come_closer(monkeypatch: pytest.MonkeyPatch) -> None:
    """What effects make of what happens between two rows lifts the floor; it is then known to five per cent."""
    x = signals(33)
    stage = linear(x, with_noise(33, x, 1.1, 2.0))
    neutral = stage.neutral()
    stage.hidden = lambda theta: np.array([0.5 if np.any(theta[1:] != neutral[1:]) else 0.0])
    known: list[float] = []
    monkeypatch.setattr(
        diagnosis, "searched",
        lambda criterion, judged, tick: known.append((criterion.known, float(criterion.judge.floor[0]))) or criterion,
    )  # fmt: skip
    monkeypatch.setattr(
        diagnosis, "_search",
        lambda criterion: (
            Search(criterion), criterion.judge.fit(("a",), stage.neutral()), [], [("nominal", 1.0)],
        ),
    )  # fmt: skip
    d = diagnosis._to_the_floor(stage, FLOOR[:1], None, None, LikelihoodAcceptance)
    lifted = float(np.hypot(0.1, 0.5))
    assert known == [(FLOOR_KNOWN, 0.1), (pytest.approx(TOLERATED - 1.0), pytest.approx(lifted))]  # type: ignore[comparison-overlap]
    assert d.floor[0] == pytest.approx(lifted)


@pytest.mark.parametrize(
    ("coarse", "effects", "nearest", "kept"),
    [({}, True, [], True), ({"y": "y lacks bits"}, False, ["n"], False), ({"u": "u lacks bits"}, True, [], False),
     ({"u": "u lacks bits"}, False, ["n"], True)],
)  # fmt: skip
def test_no_answer_rests_on_a_channel_that_lacks_bits(
    coarse: dict[str, str], effects: bool, nearest: list[str], kept: bool
) -> None:
    x = signals(34)
    stage = linear(x, with_noise(34, x, 1.1, 2.0))
    stage.coarse = coarse
    judge = problem(stage)
    fit = judge.fit(("a",), stage.neutral())
    said = answer_of(judge, "missing", fit, fit, found_of(judge, fit, ("a",), {"a": fit}) if effects else [], [])
    said.nearest = nearest
    d = diagnosis._unless_coarse(stage, said)
    assert (d is said) == kept
    if not kept:
        assert d.verdict == "unknown" and d.effects == [] and d.refused == list(coarse.values())
        assert d.nearest == (["a"] if effects else ["n"])


@pytest.mark.parametrize("criterion", [LikelihoodAcceptance, RelativeErrorAcceptance])
def test_candidates_are_ranked_by_what_they_gain_alone_and_say_what_a_log_lacks(criterion: Any) -> None:
    x = signals(35)
    x[3] = 1e-9 * x[3]
    library = (effect("a"), effect("b"), effect("c", excites="a turn of c"))
    stage = linear(x, with_noise(35, x, 1.1, 2.0, 0.3), effects=library)
    judge = problem(stage)
    search, fit, candidates, steps = diagnosis._search(Search(criterion(judge)))
    assert [c.effect for c in candidates][:2] == ["a", "b"] and sorted(fit.effects) == ["a", "b"]
    for c in candidates[:2]:
        alone = search.fits[frozenset((c.effect,))]
        assert (c.nats, c.spreads) == pytest.approx(search.criterion.gain(search.base, alone))
        assert c.left == rms_of(judge, alone) and c.reason == ""
    assert candidates[2].reason == ("a turn of c" if criterion is LikelihoodAcceptance else "")
    assert steps[0] == ("nominal", rms_of(judge, search.base)) and steps[-1][1] == rms_of(judge, fit)
    bare = linear(x[[0, 3]], with_noise(35, x, 1.1), effects=(effect("c"),))
    quiet, fit, (c,), steps = diagnosis._search(Search(criterion(problem(bare))))
    assert fit is quiet.base and len(steps) == 1
    if criterion is LikelihoodAcceptance:
        assert c.reason == "this log does not excite it" and quiet.quiet


@pytest.mark.parametrize("share", [0.0, 0.6])
def test_what_channels_predict_of_an_error_is_no_matter_of_its_size(share: float) -> None:
    x = signals(40, 1, n=800)
    channel = np.sin(0.31 * np.arange(800)) + 0.4 * np.sin(1.7 * np.arange(800))
    noise = np.random.default_rng(40).standard_normal(800)
    e = np.sqrt(share) * channel / channel.std() + np.sqrt(1.0 - share) * noise
    found = []
    for size in (1.0, 1e-3):
        stage = linear(0.0 * x, size * FLOOR[0] * e[None], "a")
        stage.regimes = {"time": stage.t, "u": channel, "y": e}
        judge = problem(stage)
        fit = judge.fit((), stage.neutral())
        found.append(structure(judge, fit))
        stage.regimes = {"time": stage.t, "y": e}  # neither time nor what is measured itself
        assert structure(judge, fit) == 0.0
    assert found[0] == pytest.approx(found[1], rel=1e-6, abs=1e-12) and found[0] == pytest.approx(share, abs=0.15)
