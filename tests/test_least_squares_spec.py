"""Least squares on linear stages: errors, blocks, held-out errors, intervals and correlations, against numpy."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as settings_of
from hypothesis import strategies as st
from scipy.optimize import least_squares, lsq_linear

from tests.conftest import examples
from vaneloop.identification import Effect, Parameter, Stage, StageError
from vaneloop.identification.least_squares.levenberg_marquardt import BroydenJacobian, Known, LatestSlopes, bounded_step
from vaneloop.identification.least_squares.levenberg_marquardt import carries as carries_along
from vaneloop.identification.least_squares.noise import correlation_of, floor_deviation, most_floor, tolerance
from vaneloop.identification.least_squares.problem import LeastSquaresProblem, covariance, recalibrate, to_the_end
from vaneloop.identification.least_squares.residuals import ResidualCache
from vaneloop.identification.results import at_bound, estimates, parameters_of, recalibrated, rms_of, rms_per_output
from vaneloop.identification.subsystem import Array, lifted, noise_of, reach_of, size_of, without_jumps

# docs/settings.md
AGREES, SPREADS, COLOUR, NINETY, EVIDENCE, DIFFERENCE, NO_ANSWER_ERROR = 1.1, 3.0, (2.0, 5.0), 1.645, 200.0, 1e-3, 1e6
CARRIED_VALUES, KEPT_SLOPES = 400_000, 2_000_000

N = 240
T = 9.0 + 0.5 * np.arange(N)  # s
FLOOR = np.array([0.1, 0.3])


def made(
    seed: int, tolerance: float = 0.5, sizes: tuple[float, ...] = (1.2, 2.0, -1.0), high: float = 50.0, **more: Any
) -> tuple[Stage, Array]:
    """A stage with two outputs, linear in a gain and in two effects' sizes; and its signals, float64[3, 2, N]."""
    rng = np.random.default_rng(seed)
    x = rng.standard_normal((3, 2, N))
    run = lambda thetas: np.einsum("sp,pon->son", thetas, x)  # noqa: E731
    measured = run(np.array([sizes]))[0] + FLOOR[:, None] * rng.standard_normal((2, N))
    effects = tuple(Effect(c, (Parameter("size", 0.0, "1", -50.0, high),), ((0.5,), (2.0,))) for c in "ab")
    stage = Stage(
        name="two", outputs=("y", "z"), units=("mm", "deg"), effects=effects, run=run, t=T, measured=measured,
        parameters=(Parameter("gain", 1.0, "1", 0.0, 9.0, tolerance),), floor=FLOOR, **more,
    )  # fmt: skip
    return stage, x


def whitened(stage: Stage, x: Array) -> tuple[Array, Array]:
    """What is measured and the signals, in noise floors, as one column each: float64[2 N], float64[2 N, 3]."""
    return (stage.measured / FLOOR[:, None]).ravel(), (x / FLOOR[:, None]).reshape(3, -1).T


# ---- errors ----------------------------------------------------------------------------------------------------------


@given(seed=st.integers(0, 99), window=st.sampled_from([None, 10.0, 33.0]), lost=st.floats(0.0, 0.9))
@settings_of(max_examples=examples(10), deadline=None)
def test_errors_are_in_noise_floors_and_free_of_a_constant_in_each_window(
    seed: int, window: float | None, lost: float
) -> None:
    stage, x = made(seed, window=window)
    rng = np.random.default_rng(seed)
    stage.measured[rng.random((2, N)) < lost] = np.nan
    keep = rng.random(N) < 0.9
    judge = LeastSquaresProblem(stage, FLOOR, keep)
    thetas = rng.standard_normal((3, 3))
    thetas[1] = np.nan if seed % 2 else np.inf
    expected = (stage.measured - np.einsum("sp,pon->son", thetas, x)) / FLOOR[:, None]
    expected = np.where(np.isfinite(np.einsum("sp,pon->son", thetas, x)), expected, NO_ANSWER_ERROR)
    counts = np.isfinite(stage.measured) & keep
    expected = np.where(counts, expected, 0.0)
    if window:
        since = T - T[0]
        of = np.minimum((since / window + 1e-9).astype(int), max(int(since[-1] / window + 1e-9) - 1, 0))
        for w in range(of.max() + 1):
            here = (of == w) & counts
            for e in expected:
                for o in range(2):
                    e[o, here[o]] -= e[o, here[o]].mean() if here[o].any() else 0.0
    assert judge.errors(thetas) == pytest.approx(expected, abs=1e-9)
    assert judge.n == counts.sum() == judge.samples.sum()
    blocks = np.add.reduceat(np.sum(expected**2, axis=1), judge.block_start, axis=1)
    assert judge.block_costs(judge.errors(thetas)) == pytest.approx(blocks)
    assert np.array_equal(judge.samples, np.add.reduceat(counts.sum(axis=0), judge.block_start))
    if window:  # a block is whole windows
        assert all(of[i] != of[i - 1] for i in judge.block_start[1:])


@pytest.mark.parametrize("window", [10.0, 33.0])
def test_what_inputs_that_nobody_logged_do_in_a_window_is_whitened_by_their_covariance(window: float) -> None:
    stage, x = made(3, window=window)
    stage.measured[:, 5:9] = np.nan
    theta = np.array([[1.0, 0.5, 0.0]])
    bare = LeastSquaresProblem(stage, FLOOR)
    centred, starts = bare.errors(theta)[0], bare.window_start
    stage.unlogged = np.random.default_rng(3).standard_normal((3, 2, N)) * np.array([0.5, 0.0, 2.0])[:, None, None]
    with_them = LeastSquaresProblem(stage, FLOOR).errors(theta)[0]
    responses = [bare._whiten(bare.measured - s[None])[0] for s in stage.unlogged]
    assert starts is not None
    for first, end in zip(starts, [*starts[1:], N], strict=True):
        here = slice(first, end)
        s = np.array([r[:, here].ravel() for r in responses])
        covariance = np.eye(s.shape[1]) + s.T @ s
        e, w = centred[:, here].ravel(), with_them[:, here].ravel()
        assert w @ w == pytest.approx(e @ np.linalg.solve(covariance, e))
    stage.window = None  # of a stage that begins once they say nothing
    free = LeastSquaresProblem(stage, FLOOR).errors(theta)
    stage.unlogged = None
    assert np.array_equal(free, LeastSquaresProblem(stage, FLOOR).errors(theta))


def test_what_the_raster_hides_is_expected_where_it_is_lost() -> None:
    stage, _ = made(1)
    judge = LeastSquaresProblem(stage, FLOOR)
    assert np.array_equal(judge.expected(), np.ones(judge.n_blocks))
    lost = np.zeros((4, 2, N))
    lost[:, 0, : N // 2] = FLOOR[0] * np.array([3.0, -3.0, 1.0, 1.0])[:, None]  # a mean square of 5 noise floors
    stage.lost = lost
    expected = LeastSquaresProblem(stage, FLOOR).expected()
    half = judge.block_start < N // 2
    assert judge.n_blocks == 24 and np.array_equal(judge.block_start, np.ceil(np.arange(24) * (N - 1) / 24))
    assert expected[half] == pytest.approx(1.0 + 0.5 * (5.0 - 2.5), rel=1e-6)
    assert expected[~half] == pytest.approx(max(1.0 - 0.5 * 2.5, 0.1))
    stage.measured[:, ::2] = np.nan  # what was not measured lost nothing
    assert LeastSquaresProblem(stage, FLOOR).expected()[half] == pytest.approx(1.0 + 0.5 * (5.0 - 2.5), rel=1e-6)
    stage.measured[:, N // 2 :] = np.nan  # of what was measured all lost as much
    assert LeastSquaresProblem(stage, FLOOR).expected()[half] == pytest.approx(1.0)


def test_a_model_that_says_nothing_of_a_sample_is_refused() -> None:
    stage, _ = made(1)
    run = stage.run
    stage.run = lambda thetas: np.where(np.arange(N) == 7, np.nan, run(thetas))
    with pytest.raises(StageError, match="the model's y is no number at 12.5 s and in 2 samples; allowed: finite"):
        recalibrate(LeastSquaresProblem(stage, FLOOR))
    stage.measured[:, 7] = np.nan  # of what nobody measured it need say nothing
    assert recalibrate(LeastSquaresProblem(stage, FLOOR)).effects == ()


@given(many=st.integers(1, 12), size=st.integers(1, 4), seed=st.integers(0, 99))
@settings_of(max_examples=examples(15), deadline=None)
def test_what_was_simulated_is_not_simulated_again(many: int, size: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    cache, asked = ResidualCache(), 0

    def simulate(thetas: Array) -> Array:
        nonlocal asked
        asked += len(thetas)
        return np.repeat(thetas.sum(axis=1)[:, None, None], size, axis=2)

    known: set[bytes] = set()
    for _ in range(5):
        thetas = rng.integers(0, 4, (many, 2)).astype(float)
        new = {t.tobytes() for t in thetas} - known
        asked = 0
        out = cache.errors(thetas, simulate)
        assert np.array_equal(out[:, 0, 0], thetas.sum(axis=1)) and out.shape == (many, 1, size)
        assert asked == (many if len({t.tobytes() for t in thetas}) == len(new) == many else len(new))
        known |= {t.tobytes() for t in thetas}
        out[:] = np.nan  # whoever asked may write into it


# ---- fits ------------------------------------------------------------------------------------------------------------


@given(seed=st.integers(0, 99), loose=st.booleans(), left_out=st.integers(0, 5))
@settings_of(max_examples=examples(8), deadline=None)
def test_a_fit_is_the_least_squares_solution_and_each_block_is_held_out_of_the_effects_fit(
    seed: int, loose: bool, left_out: int
) -> None:
    stage, x = made(seed, 0.5 if loose else 0.0)
    judge = LeastSquaresProblem(stage, FLOOR)
    fit = judge.fit(("a", "b"), stage.neutral())
    y, a = whitened(stage, x)
    prior = [np.sqrt(12.0), 0.0, 0.0] if loose else [1e9, 0.0, 0.0]  # 3 over the square of the tolerance
    whole = np.linalg.lstsq(np.vstack([a, prior]), np.append(y, prior[0]), rcond=None)[0]
    assert fit.theta == pytest.approx(whole, abs=1e-6)
    assert judge.total_of(fit) == pytest.approx(np.sum((y - a @ whole) ** 2) + (loose * 12.0 * (whole[0] - 1.0) ** 2))
    assert fit.free.tolist() == ([0, 1, 2] if loose else [1, 2])
    block = np.tile(np.repeat(np.arange(judge.n_blocks), np.diff(np.append(judge.block_start, N))), 2)
    for b in range(judge.n_blocks):  # the model's own parameters are calibrated on the whole log
        rest = y - a[:, 0] * whole[0]
        others = np.linalg.lstsq(a[block != b][:, 1:], rest[block != b], rcond=None)[0]
        held = np.sum((rest[block == b] - a[block == b][:, 1:] @ others) ** 2)
        cost = np.sum((y - a @ whole)[block == b] ** 2)
        assert fit.cost[b] == pytest.approx(cost, rel=1e-6)
        assert fit.held_out[b] == pytest.approx(held, rel=1e-4)
    without = LeastSquaresProblem(stage, FLOOR, block[:N] != left_out).fit(("a", "b"), stage.neutral())
    use = np.append(block != left_out, True)
    assert without.theta == pytest.approx(
        np.linalg.lstsq(np.vstack([a, prior])[use], np.append(y, prior[0])[use], rcond=None)[0], abs=1e-5
    )
    assert rms_of(judge, fit) == pytest.approx(np.sqrt(fit.held_out.sum() / (2 * N)))
    outputs = np.sqrt(np.mean((stage.measured - np.einsum("p,pon->on", whole, x)) ** 2, axis=1))
    inflation = np.sqrt(fit.held_out.sum() / fit.cost.sum())
    assert rms_per_output(judge, fit) == pytest.approx(outputs * inflation, rel=1e-6)


@given(seed=st.integers(0, 99), loose=st.booleans(), quieter=st.sampled_from([1.0, 0.2]), uneven=st.booleans())
@settings_of(max_examples=examples(8), deadline=None)
def test_intervals_and_correlations_follow_from_what_the_log_is_worth(
    seed: int, loose: bool, quieter: float, uneven: bool
) -> None:
    stage, x = made(seed, 0.5 if loose else 0.0)
    if uneven:  # at one time the effect is another
        stage.measured[:, 50:70] += x[1, :, 50:70]
    judge = LeastSquaresProblem(stage, quieter * FLOOR)  # where more is left than noise, all of it is taken for noise
    fit = judge.fit(("a", "b"), stage.neutral())
    a = whitened(stage, x)[1] / quieter
    worth = min(1.0 / max(1.0, fit.cost.sum() / (2 * N)), EVIDENCE * 2 / (2 * N))  # the samples are not independent
    information = worth * a.T @ a + np.diag([12.0, 0.0, 0.0])
    free = slice(None) if loose else slice(1, None)
    cov = np.linalg.inv(information[free, free])
    # as far as the log tells, or as the fits without one block differ (the jackknife)
    block = np.tile(np.repeat(np.arange(judge.n_blocks), np.diff(np.append(judge.block_start, N))), 2)
    y, rows = whitened(stage, x)[0] / quieter, np.diag([np.sqrt(12.0) if loose else 1e9, 0.0, 0.0])
    without = np.array([
        np.linalg.lstsq(np.vstack([a[block != b], rows]), np.append(y[block != b], rows[:, 0]), rcond=None)[0]
        for b in range(judge.n_blocks)
    ])[:, free]  # fmt: skip
    apart = (judge.n_blocks - 1) / judge.n_blocks * np.sum((without - without.mean(axis=0)) ** 2, axis=0)
    half = NINETY * np.sqrt(np.maximum(np.diag(cov), apart))
    lower = fit.theta[fit.free] - fit.low
    assert lower == pytest.approx(half, rel=1e-3)
    assert fit.high - fit.theta[fit.free] == pytest.approx(lower)
    expected = cov / np.sqrt(np.outer(np.diag(cov), np.diag(cov)))
    assert judge.correlation(fit) == pytest.approx(expected, abs=1e-6)
    mine = parameters_of(stage, fit, "b")["size"]
    assert mine == {"value": fit.theta[2], "low": fit.low[-1], "high": fit.high[-1], "unit": "1"}
    e = estimates(judge, fit)[-1]
    assert (e.effect, e.value, e.at_bound, e.bound) == ("b", fit.theta[2], False, (-50.0, 50.0))
    assert e.stderr == pytest.approx(lower[-1] / NINETY)


def test_a_parameter_at_its_bound_stays_there_and_has_no_interval() -> None:
    stage, x = made(3, high=1.5)  # a is 2.0 in truth
    judge = LeastSquaresProblem(stage, FLOOR)
    fit = judge.fit(("a", "b"), stage.neutral())
    y, a = whitened(stage, x)
    least = lsq_linear(
        np.vstack([a, [np.sqrt(12.0), 0.0, 0.0]]), np.append(y, np.sqrt(12.0)), ([0.5, -50, -50], [1.5, 1.5, 1.5])
    )
    assert fit.theta == pytest.approx(least.x, abs=1e-5) and fit.theta[1] == 1.5
    assert fit.low[1] == fit.high[1] == 1.5 and fit.low[2] < fit.theta[2] < fit.high[2]
    assert at_bound(stage, fit, "a") and not at_bound(stage, fit, "b")
    assert np.isnan(judge.correlation(fit)[1]).all() and np.isfinite(judge.correlation(fit)[0, 2])
    a_size = next(e for e in estimates(judge, fit) if e.effect == "a")
    assert a_size.at_bound and np.isnan(a_size.stderr)


@pytest.mark.parametrize(("truth", "said", "limit"), [(1.0, False, False), (1.3, True, False), (2.5, True, True)])
def test_a_parameter_that_moved_is_recalibrated_and_one_that_would_go_on_is_at_its_limit(
    truth: float, said: bool, limit: bool
) -> None:
    stage, _ = made(4, sizes=(truth, 0.0, 0.0))
    fit = recalibrate(LeastSquaresProblem(stage, FLOOR))
    moved = recalibrated(stage, fit)
    assert bool(moved) == said
    if said:
        assert moved[0]["parameter"] == "gain" and moved[0]["at_limit"] == limit
        assert moved[0]["value"] == pytest.approx(min(truth, 1.5), abs=0.05)


@pytest.mark.parametrize("kind", ["output", "log"])
def test_parameters_that_move_different_outputs_or_logs_share_a_simulation(kind: str) -> None:
    rng = np.random.default_rng(6)
    x = rng.standard_normal((3, 2, N))
    log = (np.arange(N) >= N // 2).astype(float)
    own = [{"output": "y"}, {"output": "z"}, {}] if kind == "output" else [{"log": 0}, {"log": 1}, {}]
    for p, of in enumerate(own):
        x[p] *= np.array([of.get("output", "y") == "y", of.get("output", "z") == "z"])[:, None]
        x[p] *= log == of["log"] if "log" in of else 1.0
    asked: list[int] = []

    def run(thetas: Array) -> Array:
        asked.append(len(thetas))
        return np.einsum("sp,pon->son", thetas, x)

    stage = Stage(
        "s", ("y", "z"), ("1", "1"),
        tuple(Parameter(c, 1.0, "1", -9.0, 9.0, 2.0, **of) for c, of in zip("pqr", own, strict=True)),  # type: ignore
        (), run, T, np.einsum("p,pon->on", np.array([1.5, 0.5, 2.0]), x), regimes={"log": log}, floor=FLOOR,
    )  # fmt: skip
    judge = LeastSquaresProblem(stage, FLOOR)
    theta = np.array([1.0, 1.0, 3.0])  # the last at its upper end: its step goes down
    error, slopes = judge.linearise(theta, np.arange(3))
    assert sum(asked) == 3  # where it stands, both of those, the third
    scale = judge.scale[:, None, None]
    assert scale.ravel() == pytest.approx([2.0, 2.0, 2.0])
    assert slopes == pytest.approx(x * scale / FLOOR[:, None], abs=1e-6)
    assert error == pytest.approx((stage.measured - np.einsum("p,pon->on", theta, x)) / FLOOR[:, None])
    thetas, _ = judge.differences(theta, np.arange(3), scale.ravel(), judge.bounds()[1])
    assert np.abs(thetas - theta).max(axis=0) == pytest.approx(DIFFERENCE * scale.ravel())
    assert (thetas <= judge.bounds()[1]).all()
    costs, gradients, normals = judge.blocks(error, slopes)
    flat = slopes.reshape(3, -1)
    assert costs.sum() == pytest.approx(np.sum(error**2))
    assert gradients.sum(axis=0) == pytest.approx(flat @ error.ravel())
    assert normals.sum(axis=0) == pytest.approx(flat @ flat.T)


def test_an_angle_has_no_bounds_and_stays_within_one_turn() -> None:
    rng = np.random.default_rng(8)
    x = rng.standard_normal((2, N))
    angle = Parameter("angle", 0.0, "rad", -np.pi, np.pi, period=2.0 * np.pi, scale=1.0, shape=True)
    run = lambda thetas: (np.cos(thetas[:, :1]) * x[0] + np.sin(thetas[:, :1]) * x[1])[:, None, :]  # noqa: E731
    measured = run(np.array([[3.0]]))[0] + 0.1 * rng.standard_normal((1, N))
    stage = Stage("s", ("y",), ("1",), (), (Effect("e", (angle,), ((0.0,),)),), run, T, measured, floor=FLOOR[:1])
    judge = LeastSquaresProblem(stage, FLOOR[:1])
    for start in (-2.9, 2.5, 9.0):
        fit = judge.fit(("e",), np.array([start]), 20)
        assert fit.theta[0] == pytest.approx(3.0, abs=0.03)
        assert fit.low[0] < 3.0 < fit.high[0] and not at_bound(stage, fit, "e")


def test_nothing_is_known_of_what_has_no_squares() -> None:
    a = np.array([[4.0, 1.0, np.inf], [1.0, 2.0, np.nan], [np.inf, np.nan, 1.0]])
    assert np.isinf(np.diag(covariance(a))).tolist() == [True, True, True]
    out = covariance(np.array([[4.0, 1.0], [1.0, 2.0]]))
    assert out == pytest.approx(np.linalg.inv(np.array([[4.0, 1.0], [1.0, 2.0]])))


# ---- carried slopes --------------------------------------------------------------------------------------------------


@given(seed=st.integers(0, 999), columns=st.integers(1, 4))
@settings_of(max_examples=examples(15), deadline=None)
def test_carried_slopes_say_what_the_last_step_did_and_change_as_little_as_that_takes(seed: int, columns: int) -> None:
    rng = np.random.default_rng(seed)
    error, slopes = rng.standard_normal((2, 9)), rng.standard_normal((columns, 2, 9))
    carried = BroydenJacobian(error, slopes)
    flat = slopes.reshape(columns, -1)
    assert carried.gradient == pytest.approx(flat @ error.ravel())
    step, after = rng.standard_normal(columns), rng.standard_normal((2, 9))
    weight = np.diag(flat @ flat.T).copy()
    carried.moved(step, after)
    assert step @ carried.slopes == pytest.approx(error.ravel() - after.ravel())  # the secant
    across = weight * step  # the least change in the metric of the errors
    off = after.ravel() - error.ravel() + step @ flat
    assert carried.slopes == pytest.approx(flat - np.outer(across, off) / (across @ step))
    assert carried.normal == pytest.approx(carried.slopes @ carried.slopes.T)
    assert carried.error == pytest.approx(after.ravel())
    before = carried.slopes.copy()
    carried.moved(np.zeros(columns), error)  # no step tells nothing
    assert np.array_equal(carried.slopes, before) and carried.error == pytest.approx(error.ravel())


def test_slopes_are_kept_by_the_place_and_the_columns_and_the_oldest_go(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vaneloop.identification.least_squares.levenberg_marquardt.KEPT_SLOPES", 20)
    kept, error = LatestSlopes(), np.ones((1, 4))
    places = [np.array([float(i), 0.0]) for i in range(4)]
    free = np.array([0, 3])
    for i, theta in enumerate(places):
        kept.put(theta, free, error * i, np.full((2, 1, 4), float(i)))
    assert [kept.get(t, free) is not None for t in places] == [False, False, True, True]
    found = kept.get(places[3], free)
    assert found is not None and found[0][0, 0] == 3.0 and kept.get(places[3], np.array([0, 2])) is None
    found[1][:] = np.nan  # a copy
    known = kept.of(places[3], free, before=3)
    assert known.columns.tolist() == [0] and known.rows.tolist() == [[[3.0] * 4]]
    assert known.fits(4) and not known.fits(5) and not kept.of(places[0], free).fits(4)
    assert not Known(free, np.zeros((2, 1, 3))).fits(4)


@given(seed=st.integers(0, 999), many=st.integers(1, 6))
@settings_of(max_examples=examples(20), deadline=None)
def test_a_bounded_step_is_within_and_the_rest_has_no_slope_left(seed: int, many: int) -> None:
    rng = np.random.default_rng(seed)
    j = rng.standard_normal((20, many))
    a, g = j.T @ j, 6.0 * rng.standard_normal(many)
    low, high = -rng.uniform(0.01, 1.0, many), rng.uniform(0.01, 1.0, many)
    step = bounded_step(a, g, low, high)
    assert np.all((step >= low) & (step <= high))
    inside = (step > low) & (step < high)
    assert (g - a @ step)[inside] == pytest.approx(np.zeros(inside.sum()), abs=1e-9)
    free = np.linalg.solve(a, g)
    if np.all((free > low) & (free < high)):
        assert step == pytest.approx(free)


# ---- noise -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rho", [0.0, 0.5, 0.8])
def test_so_many_samples_of_a_first_order_noise_count_as_one(rho: float) -> None:
    rng = np.random.default_rng(9)
    n = 60_000
    e = rng.standard_normal((2, n))
    for i in range(1, n):
        e[1, i] += rho * e[1, i - 1]
    stage: Any = SimpleNamespace(errors=lambda _: e[None] + 3.0)
    fit: Any = SimpleNamespace(theta=np.zeros(1))
    seen = rho ** np.arange(1, 400)
    expected = 1.0 + 2.0 * np.sum(seen[seen > 0.05] ** 2)
    assert correlation_of(stage, fit) == pytest.approx(expected, rel=0.03)  # of the output that tells least
    e[1] = np.sin(np.arange(n) * 2.0 * np.pi / n)
    assert correlation_of(stage, fit) == 50.0
    e[:] = 0.0
    assert correlation_of(stage, fit) == 1.0


@given(n=st.integers(1, 10**6), m=st.integers(1, 10**6), c=st.floats(1.0, 50.0))
@settings_of(max_examples=examples(20), deadline=None)
def test_how_well_a_floor_is_known(n: int, m: int, c: float) -> None:
    assert float(floor_deviation(m, n, c)) == pytest.approx(np.sqrt(c / (2.0 * m) + min(c, COLOUR[1]) / n))
    assert most_floor(n, c) == pytest.approx(1.0 + SPREADS * np.sqrt(c / n))
    expected = 1.0 + SPREADS * np.sqrt(c / (2.0 * n) + min(c, COLOUR[1]) / n)
    assert tolerance(n, c) == pytest.approx(max(AGREES, expected))


def test_what_happens_between_two_rows_raises_the_reach_where_an_effect_is_there() -> None:
    stage, _ = made(5)
    assert reach_of(stage, FLOOR, np.array([1.0, 2.0, 0.0])) is FLOOR
    stage.hidden = lambda theta: np.array([0.3 * abs(theta[1]), 1e-6])
    assert reach_of(stage, FLOOR, np.array([3.0, 0.0, 0.0])) is FLOOR  # the model's own parameter is no effect
    assert reach_of(stage, FLOOR, np.array([1.0, 2.0, 0.0])) == pytest.approx([np.hypot(0.1, 0.6), 0.3])
    stage.hidden = lambda theta: np.hypot(0.08, [0.3 * theta[1], -0.06 * theta[1]])  # the floor holds the nominal part
    assert reach_of(stage, FLOOR, np.array([1.0, 2.0, 0.0])) == pytest.approx(np.hypot(FLOOR, [0.6, 0.12]))
    stage.hidden = lambda theta: np.array([0.08, 0.08]) if theta[1] else np.array([0.09, 0.09])
    assert reach_of(stage, FLOOR, np.array([1.0, 2.0, 0.0])) is not None
    assert np.array_equal(reach_of(stage, FLOOR, np.array([1.0, 2.0, 0.0])), FLOOR)  # never below it


# ---- stages ----------------------------------------------------------------------------------------------------------


@given(
    value=st.floats(-5.0, 5.0), tolerance=st.floats(0.0, 3.0), middle=st.one_of(st.none(), st.floats(-5.0, 5.0)),
    low=st.floats(-9.0, -5.0), high=st.floats(5.0, 9.0),
)  # fmt: skip
@settings_of(max_examples=examples(25), deadline=None)
def test_a_fit_stays_within_the_tolerance_or_at_the_value_beyond_it(
    value: float, tolerance: float, middle: float | None, low: float, high: float
) -> None:
    p = Parameter("p", value, "1", low, high, tolerance, middle=middle)
    least, most = p.limits()
    expected = value if middle is None else middle
    assert p.expected == expected
    if tolerance == 0.0:
        assert least == most == value
    else:
        assert least == max(low, min(value, expected - tolerance))
        assert most == min(high, max(value, expected + tolerance))


@given(value=st.floats(-50.0, 50.0), low=st.floats(-5.0, 5.0), period=st.floats(0.5, 9.0))
@settings_of(max_examples=examples(25), deadline=None)
def test_what_repeats_itself_is_within_the_turn_that_begins_at_its_low_end(
    value: float, low: float, period: float
) -> None:
    p = Parameter("p", 0.0, "rad", low, low + period, period=period)
    at = p.wrapped(value)
    assert low - 1e-9 <= at <= low + period + 1e-9
    turns = (value - at) / period
    assert turns == pytest.approx(round(turns), abs=1e-9)
    assert Parameter("p", 0.0, "1").wrapped(value) == value


def test_a_size_is_the_first_that_says_anything() -> None:
    assert size_of(np.nan, 0.0, -3.0, 7.0) == 3.0 and size_of(np.inf, 0.0) == 1.0 and size_of(2.0) == 2.0


@given(seed=st.integers(0, 99), jump=st.floats(-9.0, 9.0), slope=st.floats(-1.0, 1.0))
@settings_of(max_examples=examples(10), deadline=None)
def test_the_jumps_of_windows_are_closed_and_what_drifts_goes_on(seed: int, jump: float, slope: float) -> None:
    stage, _ = made(seed, window=10.0)
    w = ((T - T[0]) / 10.0 + 1e-9).astype(int)
    drift = slope * (T - T[0])
    assert without_jumps(stage, drift + jump * w) == pytest.approx(drift, abs=1e-6)
    stage.window = None
    assert np.array_equal(without_jumps(stage, drift + jump * w), drift + jump * w)


def test_a_floor_is_the_noise_and_what_the_raster_hides_and_no_more_than_what_is_known_to_be_quiet() -> None:
    stage, _ = made(11)
    stage.noise = lambda t, error: 2.0 + 0.0 * float(error[0] + t[0])
    assert noise_of(stage, stage.neutral()).tolist() == [2.0, 2.0]
    stage.quiet = np.array([0.5, 1.99])  # clearly less, and as good as the same
    assert noise_of(stage, stage.neutral()).tolist() == [0.5, 2.0]
    stage.raster_error = np.array([1.2, 0.0])
    assert noise_of(stage, stage.neutral()) == pytest.approx([1.3, 2.0])
    told: list[float] = []
    stage.noise = lambda t, error: told.append(float(np.std(error))) or 1.0  # type: ignore[func-returns-value]
    theta = np.array([1.2, 2.0, -1.0])
    noise_of(stage, theta)
    assert told == pytest.approx([np.std(e) for e in stage.measured - stage.run(theta[None])[0]])


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"measured": np.zeros((3, N))}, rf"measured has shape \(3, {N}\); \(2, {N}\) is needed"),
        ({"effects": (Effect("gain", (), ()),)}, "two parameters or effects share a name among gain, gain"),
        (
            {"effects": (Effect("a", (Parameter("size", 0.0, "1"),), ((1.0, 2.0),)),)},
            "effect 'a': a start has 2 values; 1 are needed",
        ),
    ],
)
def test_a_stage_that_does_not_go_together_is_refused(change: dict[str, Any], says: str) -> None:
    stage, _ = made(12)
    with pytest.raises(StageError, match=says):
        replace(stage, **change)


def test_an_error_that_lifts_a_floor_by_less_than_that_is_known_to_is_none() -> None:
    floor = np.array([0.03, 0.008])
    assert lifted(floor, 2e-3) == pytest.approx([0.03, np.hypot(0.008, 2e-3)], rel=1e-12)
    assert lifted(floor, 2e-3)[0] == floor[0]


# ---- descents --------------------------------------------------------------------------------------------------------

DECAY = np.linspace(0.0, 4.0, N)
GROWN = Effect(
    "law", (Parameter("size", 0.0, "1", -9.0, 9.0), Parameter("rate", 0.0, "1/s", 0.0, 5.0)), ((1.0, 1.0), (2.0, 0.5))
)


def decaying(seed: int, size: float, rate: float, asked: list[int] | None = None, **more: Any) -> Stage:
    """y = gain + size exp(-rate t), which is not linear in the rate."""

    def run(thetas: Array) -> Array:
        if asked is not None:
            asked.append(len(thetas))
        gain, a, k = thetas.T[:, :, None]
        return np.asarray(gain + a * np.exp(-k * DECAY))[:, None, :]

    measured = run(np.array([[1.2, size, rate]]))[0] + FLOOR[0] * np.random.default_rng(seed).standard_normal((1, N))
    gain = Parameter("gain", 1.0, "1", 0.0, 9.0, 0.5)
    return Stage("law", ("y",), ("mm",), (gain,), (GROWN,), run, T, measured, floor=FLOOR[:1], **more)


@given(
    seed=st.integers(0, 99), size=st.floats(1.0, 8.0), rate=st.floats(0.6, 3.0), carries=st.booleans(),
    way=st.sampled_from(["at once", "by and by", "from a fit", "with slopes", "sparing"]),
)  # fmt: skip
@settings_of(max_examples=examples(20), deadline=None)
def test_a_descent_ends_where_scipy_s_does(seed: int, size: float, rate: float, carries: bool, way: str) -> None:
    stage = decaying(seed, size, rate, carries=carries)
    judge = LeastSquaresProblem(stage, FLOOR[:1])
    start = np.array([1.0, 1.0, 1.0])

    def off(theta: Array) -> Array:
        return np.append(
            (stage.measured - stage.run(theta[None])[0]).ravel() / FLOOR[0], np.sqrt(12.0) * (theta[0] - 1.0)
        )

    best = least_squares(off, start, bounds=judge.bounds(), xtol=1e-12, ftol=1e-12)
    judge.sparing = way == "sparing"
    if way == "by and by":
        fit = judge.fit(("law",), start, 1)
        for _ in range(14):
            fit = judge.fit(("law",), fit, 1)
    elif way == "from a fit":
        fit = judge.fit(("law",), judge.fit(("law",), start, 2))
    elif way == "with slopes":
        free = judge.columns(("law",))
        fit = judge.fit(("law",), start, 12, slopes=Known(free[1:], judge.linearise(start, free)[1][1:]))
    else:
        fit = judge.fit(("law",), start)
    assert 2.0 * best.cost * (1.0 - 1e-9) <= judge.total_of(fit) <= 2.0 * best.cost + 1.2  # it ends near the end
    assert fit.cost.sum() == pytest.approx(np.sum(judge.errors(fit.theta[None]) ** 2))
    lead = judge.lead(("law",), start, 3)
    assert lead.total == pytest.approx(judge.totals(judge.errors(lead.theta[None]), lead.theta[None])[0])
    assert lead.total <= judge.totals(judge.errors(start[None]), start[None])[0]
    assert judge.lead(("law",), start, 0).theta == pytest.approx(start)


def test_a_step_simulates_its_slopes_once_and_its_trials_at_once() -> None:
    asked: list[int] = []
    judge = LeastSquaresProblem(decaying(1, 4.0, 1.0, asked), FLOOR[:1])
    asked.clear()
    start = np.array([1.0, 1.0, 0.5])
    judge.lead(("law",), start, 1)
    trials = asked[1]
    assert asked == [4, trials] and trials >= 3  # at the start and a step of each parameter
    asked.clear()
    judge.fit(("law",), np.array([1.0, 1.1, 0.5]), 2)
    assert asked == [4, trials, 3, trials, 3]  # where a fit ends its slopes are known
    asked.clear()
    fit = judge.fit(("law",), np.array([1.0, 4.0, 1.0]), 0)
    assert asked == [4] and fit.theta.tolist() == [1.0, 4.0, 1.0]
    judge.spared.add(0)  # a parameter that is spared since then has no slopes in the fit
    less = judge.fit(("law",), fit, 8)
    assert less.free.tolist() == [1, 2] and less.theta[0] == 1.0 and less.cost.sum() < fit.cost.sum()


def test_carried_slopes_spare_simulations_and_lead_to_the_same_place() -> None:
    many = []
    for carries in (False, True):
        asked: list[int] = []
        judge = LeastSquaresProblem(decaying(2, 5.0, 1.5, asked, carries=carries), FLOOR[:1])
        fit = judge.fit(("law",), np.array([1.0, 1.0, 0.5]), 30)
        many.append((fit.theta, len(asked)))
    assert many[0][0] == pytest.approx(many[1][0], abs=0.01)
    short = LeastSquaresProblem(decaying(2, 5.0, 1.5, carries=True), FLOOR[:1])
    assert carries_along(short, np.arange(3)) and not carries_along(
        LeastSquaresProblem(decaying(2, 5.0, 1.5), FLOOR[:1]), np.arange(3)
    )
    edge = CARRIED_VALUES // N
    assert carries_along(short, np.arange(edge)) and not carries_along(short, np.arange(edge + 1))


def test_a_fit_is_gone_on_with_until_it_falls_no_more() -> None:
    judge = LeastSquaresProblem(decaying(3, 6.0, 2.5), FLOOR[:1])
    start = np.array([1.0, 0.2, 0.1])
    first = judge.fit(("law",), start, 1)
    (once,) = judge.together([to_the_end(judge, judge.fitting(("law",), start, 1), False)])
    (whole,) = judge.together([to_the_end(judge, judge.fitting(("law",), start, 1))])
    assert once.theta.tolist() == first.theta.tolist()
    assert judge.total_of(whole) < 0.5 * judge.total_of(first)
    assert judge.total_of(whole) == pytest.approx(judge.total_of(judge.fit(("law",), start, 60)), rel=1e-3)


# ---- blocks, scales, slopes that are kept ----------------------------------------------------------------------------


@pytest.mark.parametrize(("window", "memory", "blocks"), [(2.0, 10.0, 12), (2.0, 5.0, 20), (30.0, 5.0, 3)])
def test_a_block_is_so_many_windows_as_the_stage_s_memory_has(window: float, memory: float, blocks: int) -> None:
    stage, _ = made(1, window=window, memory=memory)
    judge = LeastSquaresProblem(stage, FLOOR)
    assert judge.n_blocks == blocks
    per = np.diff(np.append(judge.block_start, N)) * 0.5 / window
    assert np.all(np.round(per[:-1]) == np.round(per[0]))


def test_a_usual_change_is_that_of_the_tolerance_the_starts_or_the_value() -> None:
    sizes = (
        Parameter("given", 0.0, "1", scale=7.0), Parameter("started", 1.0, "1"), Parameter("near", 3.0, "1"),
        Parameter("nothing", 0.0, "1"),
    )  # fmt: skip
    stage, _ = made(1)
    stage.effects = (Effect("e", sizes, ((1.0, 1.0, 3.0, 0.0), (1.0, 3.0, 3.0, 0.0), (2.0, -4.0, 3.0, 0.0))),)
    own = (Parameter("known", 0.0, "1", tolerance=0.5), Parameter("value", -4.0, "1"), Parameter("zero", 0.0, "1"))
    stage.parameters = own
    assert LeastSquaresProblem(stage, FLOOR).scale == pytest.approx([0.5, 4.0, 1.0, 7.0, 3.5, 3.0, 1.0])


def test_how_samples_count_is_no_matter_of_their_size_or_of_lags_beyond_a_quarter_of_the_log() -> None:
    fit: Any = SimpleNamespace(theta=np.zeros(1))
    for n in (24, 60):
        ramp = np.arange(float(n))
        for scale in (1.0, 1e-7):
            judge: Any = SimpleNamespace(errors=lambda _, e=scale * ramp: e[None, None])
            row = ramp - ramp.mean()
            rho = np.array([row[k:] @ row[: n - k] / (row @ row) for k in range(1, n // 4)])
            assert correlation_of(judge, fit) == pytest.approx(1.0 + 2.0 * np.sum(rho**2))


def test_what_is_known_beforehand_holds_an_interval_at_the_edge_of_a_tolerance() -> None:
    """A gain that stands at its limit is as uncertain as its tolerance, and so is what trades with it."""
    stage, x = made(5, sizes=(4.0, 2.0, 0.0))
    x[1] = x[0] + 0.2 * x[1]  # the effect does nearly what the gain does
    stage.measured = 4.0 * x[0] + 2.0 * x[1] + FLOOR[:, None] * np.random.default_rng(5).standard_normal((2, N))
    judge = LeastSquaresProblem(stage, FLOOR)
    fit = judge.fit(("a",), stage.neutral())
    assert fit.theta[0] == 1.5 and fit.low[0] == fit.high[0] == 1.5
    a = whitened(stage, x)[1][:, :2]
    worth = min(1.0 / max(1.0, fit.cost.sum() / (2 * N)), EVIDENCE * 2 / (2 * N))
    cov = np.linalg.inv(worth * a.T @ a + np.diag([12.0, 0.0]))
    assert fit.high[1] - fit.theta[1] >= NINETY * np.sqrt(cov[1, 1]) * (1.0 - 1e-6)
    assert np.all(np.abs(judge.correlation(fit)[1, 1]) <= 1.0)


def test_so_many_slopes_are_kept() -> None:
    kept, free = LatestSlopes(), np.array([0])
    error = np.zeros((1, 1))
    places = [np.array([float(k)]) for k in range(3)]
    half = KEPT_SLOPES // 2
    for place in places[:2]:
        kept.put(place, free, error, np.broadcast_to(0.0, (1, 1, half)))
    assert all(kept.of(p, free).fits(half) for p in places[:2])
    kept.put(places[2], free, error, np.zeros((1, 1, 1)))
    assert [kept.of(p, free).fits(n) for p, n in zip(places, (half, half, 1), strict=True)] == [False, True, True]


def test_a_rough_fit_of_a_poor_model_ends_where_it_gains_less_than_can_be_told() -> None:
    many, totals = [], []
    for roughly in (False, True):
        asked: list[int] = []
        stage = decaying(4, 6.0, 1.2, asked)
        stage.measured = stage.measured + 1.2 * np.sin(9.0 * DECAY)  # far more than noise, and no parameter's
        judge = LeastSquaresProblem(stage, FLOOR[:1])
        judge.roughly = roughly
        asked.clear()
        fit = judge.fit(("law",), np.array([1.0, 1.0, 0.4]), 30)
        many.append(len(asked))
        totals.append(judge.total_of(fit))
    told = 0.2 * 3 * (1.0 + (totals[0] - N) / EVIDENCE)
    assert totals[0] > 20.0 * N and totals[0] <= totals[1] + 1e-6 <= totals[0] + 4.0 * told and many[1] < many[0]


def test_a_model_without_a_parameter_that_may_move_is_simulated_once() -> None:
    asked: list[int] = []
    stage = decaying(5, 2.0, 1.0, asked)
    stage.parameters = (Parameter("gain", 1.0, "1"),)
    judge = LeastSquaresProblem(stage, FLOOR[:1])
    asked.clear()
    fit = judge.fit((), np.array([1.0, 0.0, 0.0]))
    assert asked == [1] and len(fit.free) == 0 and np.array_equal(fit.held_out, fit.cost)
    assert fit.cost.sum() == pytest.approx(np.sum((stage.measured - 1.0) ** 2) / FLOOR[0] ** 2)
    assert judge.correlation(fit).shape == (0, 0) and judge.total_of(fit) == fit.cost.sum()


@given(seed=st.integers(0, 99), k=st.integers(1, 5))
@settings_of(max_examples=examples(15), deadline=None)
def test_a_bounded_step_stays_within_and_what_is_free_has_come_to_rest(seed: int, k: int) -> None:
    rng = np.random.default_rng(seed)
    rows = rng.standard_normal((k + 3, k))
    a, g = rows.T @ rows + 1e-9 * np.eye(k), rows.T @ rng.standard_normal(k + 3)
    low, high = -rng.random(k), rng.random(k)
    step = bounded_step(a, g, low, high)
    assert np.all(step >= low) and np.all(step <= high)
    free = (step > low) & (step < high)
    if free.any():  # beside what has stopped
        assert (g - a @ step)[free] == pytest.approx(np.zeros(int(free.sum())), abs=1e-7)
    far = np.linalg.solve(a, g)
    wide = bounded_step(a, g, far - 1.0, far + 1.0)
    assert wide == pytest.approx(far)


@pytest.mark.parametrize("window", [None, 10.0])
def test_a_raster_makes_expect_as_much_in_each_block_as_its_draws_have(window: float | None) -> None:
    stage, _ = made(6, window=window)
    assert LeastSquaresProblem(stage, FLOOR).expected().tolist() == [1.0] * LeastSquaresProblem(stage, FLOOR).n_blocks
    rng = np.random.default_rng(6)
    stage.lost = rng.standard_normal((4, 2, N)) * np.where(np.arange(N) < 30, 0.8, 0.05)
    stage.measured[1, 100:140] = np.nan
    judge = LeastSquaresProblem(stage, FLOOR)
    counted = np.isfinite(stage.measured)
    squares = np.zeros((2, N))
    for draw in stage.lost:
        e = np.where(counted, draw / FLOOR[:, None], 0.0)
        if window:
            starts = judge.window_start
            assert starts is not None
            for first, end in zip(starts, [*starts[1:], N], strict=True):
                for o in range(2):
                    here = counted[o, first:end]
                    e[o, first:end][here] -= e[o, first:end][here].mean() if here.any() else 0.0
        squares += e * e / len(stage.lost)
    beyond = 1.0 + squares - (squares.sum(axis=1) / counted.sum(axis=1))[:, None]
    assert judge.lost() == pytest.approx(beyond)
    block = np.repeat(np.arange(judge.n_blocks), np.diff(np.append(judge.block_start, N)))
    wanted = [np.sum(beyond[:, block == b][counted[:, block == b]]) / judge.samples[b] for b in range(judge.n_blocks)]
    assert judge.expected() == pytest.approx(np.maximum(wanted, 0.1)) and min(wanted) < 0.1 < max(wanted)


@pytest.mark.parametrize("period", [0.8, 6.0])
def test_a_fit_leaves_a_direction_within_its_turn(period: float) -> None:
    turn = Parameter("way", 0.0, "rad", -0.3, period - 0.3, period=period, scale=0.1 * period)
    stage = decaying(7, 1.0, 1.0)
    wave = lambda way: np.cos(2.0 * np.pi * (DECAY[None] - way[:, None]) / period)  # noqa: E731
    stage.parameters, stage.effects = (), (Effect("e", (turn,), ((0.0,),)),)
    stage.run = lambda thetas: wave(thetas[:, 0])[:, None, :]
    stage.measured = wave(np.array([0.4 * period]))[None, 0] + FLOOR[0] * np.random.default_rng(7).standard_normal(
        (1, N)
    )
    judge = LeastSquaresProblem(stage, FLOOR[:1])
    fit = judge.fit(("e",), np.array([0.2 * period + 3.0 * period]))
    assert fit.theta[0] == pytest.approx(0.4 * period, abs=0.02 * period)
    assert judge.wrapped(np.array([0.4 * period - 2.0 * period])) == pytest.approx([0.4 * period])
    assert fit.high[0] - fit.low[0] <= period and judge.bounds()[0][0] == -np.inf and judge.bounds()[1][0] == np.inf


@pytest.mark.parametrize("tolerance", [0.2, 3.0])
def test_a_parameter_that_the_log_does_not_tell_is_as_uncertain_as_its_tolerance(tolerance: float) -> None:
    stage, x = made(8, tolerance, sizes=(1.0, 0.0, 0.0))
    x[0] *= 1e-6
    stage.measured = FLOOR[:, None] * np.random.default_rng(8).standard_normal((2, N))
    judge = LeastSquaresProblem(stage, FLOOR)
    fit = judge.fit((), stage.neutral())
    assert fit.theta[0] == pytest.approx(1.0, abs=0.01 * tolerance)
    half = NINETY * tolerance / np.sqrt(3.0)  # of a uniform interval
    assert (fit.high - fit.low) / 2.0 == pytest.approx([half], rel=1e-3)


@pytest.mark.parametrize(("most", "batches"), [(1, [2, 3, 2]), (4, [2, 3, 2]), (5, [5, 2]), (6, [5, 2]), (7, [7])])
def test_tasks_are_simulated_side_by_side_up_to_so_many_values(
    most: int, batches: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    stage, _ = made(9)
    judge = LeastSquaresProblem(stage, FLOOR)
    monkeypatch.setattr("vaneloop.identification.least_squares.problem.MAX_VALUES", most * stage.measured.size)
    asked: list[int] = []
    errors = judge.errors

    def noted(thetas: Array) -> Array:
        asked.append(len(thetas))
        return errors(thetas)

    monkeypatch.setattr(judge, "errors", noted)
    sets = [np.random.default_rng(k).standard_normal((many, 3)) for k, many in enumerate((2, 3, 2))]

    def task(thetas: Array) -> Any:
        return (yield thetas)

    answers = judge.together([task(thetas) for thetas in sets])
    assert asked == batches
    for thetas, answer in zip(sets, answers, strict=True):
        assert answer == pytest.approx((stage.measured - stage.run(thetas)) / FLOOR[:, None])
    assert judge.together([]) == []
