"""A fit's descent driven by hand, request by request: which parameter sets it asks for, by which dampings, when it goes
on, when it ends; what a fit makes of slopes, blocks and groups of tasks. Against the formulas, in numpy.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.test_least_squares_spec import FLOOR, N, T, made
from vaneloop.identification import Effect, Parameter, Stage
from vaneloop.identification.least_squares.levenberg_marquardt import (
    NOT_KNOWN,
    Begin,
    BroydenJacobian,
    Known,
    LatestSlopes,
    levenberg_marquardt,
)
from vaneloop.identification.least_squares.problem import LeastSquaresProblem, covariance, to_the_end
from vaneloop.identification.subsystem import Array

# docs/settings.md
DAMPING_TIMES, MOST_DAMPED, EVIDENCE, LEAST_STEP_FALL, DIFFERENCE = (0.01, 1.0, 300.0), 4, 200.0, 1e-3, 1e-3
PROMISE_KEPT, CARRIED_STEP, NINETY, MIN_BLOCKS, USUAL_BLOCKS, MOST_BLOCKS = 0.5, 0.34, 1.645, 12, 24, 60
GAINED_AT_LEAST = 0.2  # of the sum of squares, for each parameter


def trials_of(judge: LeastSquaresProblem, theta: Array, free: Array, error: Array, jac: Array, damping: float) -> Array:
    """The damped steps from a place, without bounds."""
    scale, prior = judge.scale[free], judge.prior[free]
    rows = jac.reshape(len(free), -1)
    a = rows @ rows.T + np.diag(prior * scale**2)
    g = rows @ error.ravel() - prior * scale * (theta - judge.stage.expected())[free]
    out = np.repeat(theta[None], len(DAMPING_TIMES), axis=0)
    for row, times in zip(out, DAMPING_TIMES, strict=True):
        row[free] += scale * np.linalg.solve(a + damping * times * np.diag(np.diag(a)), g)
    return out


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_each_step_asks_for_its_slopes_and_for_three_dampings(seed: int) -> None:
    stage, _ = made(seed, tolerance=5.0)
    cubic = replace(stage, run=lambda thetas: stage.run(thetas) + 0.02 * (thetas[:, 1] ** 3)[:, None, None])
    judge = LeastSquaresProblem(cubic, FLOOR)
    free, theta = np.arange(3), np.array([1.0, 9.0, 4.0])
    run = levenberg_marquardt(judge, free, Begin(theta), 3)
    damping, known = 1e-3, None
    asked = next(run)
    for step in range(3):
        at = np.repeat(theta[None], 4, axis=0)
        at[np.arange(1, 4), free] += DIFFERENCE * judge.scale
        np.testing.assert_allclose(asked, at if known is None else at[1:], rtol=1e-12)
        error = judge.errors(theta[None])[0]
        jac = np.array([(error - e) / DIFFERENCE for e in judge.errors(at[1:])])
        asked = run.send(judge.errors(asked))
        wanted = trials_of(judge, theta, free, error, jac, damping)
        np.testing.assert_allclose(asked, wanted, rtol=1e-6, atol=1e-8)
        errors = judge.errors(asked)
        costs = judge.totals(errors, asked)
        k = int(np.argmin(costs))
        try:
            asked = run.send(errors)
        except StopIteration as end:
            assert end.value.total == pytest.approx(costs[k]) and end.value.theta == pytest.approx(wanted[k])
            assert step > 0 and not end.value.stalled
            return
        theta, known, damping = wanted[k], errors[k], max(damping * DAMPING_TIMES[k], 1e-9)


def of_effects() -> tuple[LeastSquaresProblem, Array, Array]:
    """A problem whose answers are made up, two columns without a prior, and where it begins."""
    stage, _ = made(1)
    return LeastSquaresProblem(stage, FLOOR), np.array([1, 2]), np.array([1.0, 1.0, 1.0])


def squares(total: float, sets: int = 1) -> Array:
    """Errors with this sum of squares."""
    return np.full((sets, 2, N), np.sqrt(total / (2 * N)))


def answered(judge: LeastSquaresProblem, run: Any, here: float, slope: float = 1.0) -> Array:
    """The first trials of a descent from a place that leaves ``here``, with slopes of two signals of this size."""
    assert len(next(run)) == 3
    error = squares(here)[0]
    x = np.ones((2, 2, N))
    x[1, :, ::2] = -1.0
    moved = [error, *(error - DIFFERENCE * slope * signal for signal in x)]
    return np.asarray(run.send(np.array(moved)))


def test_a_step_that_brings_nothing_though_its_slope_promises_much_is_damped_until_it_stalls() -> None:
    judge, free, theta = of_effects()
    here = 1e15  # so much that even the shortest step promises more than counts
    run = levenberg_marquardt(judge, free, Begin(theta), 5)
    asked = answered(judge, run, here, 1e7)
    error = squares(here)[0]
    x = np.ones((2, 2, N))
    x[1, :, ::2] = -1.0
    x *= 1e7
    damping = 1e-3
    for turn in range(MOST_DAMPED):
        np.testing.assert_allclose(asked, trials_of(judge, theta, free, error, x, damping), rtol=1e-6)
        damping *= 1e5
        try:
            asked = run.send(squares(2.0 * here, 3))
        except StopIteration as end:
            assert turn == MOST_DAMPED - 1 and end.value.stalled
            assert end.value.theta.tolist() == theta.tolist() and end.value.total == pytest.approx(here)
            return
    raise AssertionError


def test_a_short_step_that_promises_little_and_brings_nothing_is_the_end() -> None:
    judge, free, theta = of_effects()
    # both signals have 2 N squares: the last step, damped by 0.3, then by 30,000, promises 2 here / 30,000 at most
    for here, turns in ((0.9 * 0.4 * 30_000.0 / 2.0, 2), (1.1 * 0.4 * 30_000.0 / 2.0, 3)):
        run = levenberg_marquardt(judge, free, Begin(theta), 5)
        answered(judge, run, here)
        for turn in range(turns):
            try:
                run.send(squares(2.0 * here, 3))
                assert turn < turns - 1
            except StopIteration as end:
                assert turn == turns - 1 and not end.value.stalled


def test_of_the_three_the_best_is_gone_on_with_and_damps_the_next() -> None:
    for best, times in enumerate(DAMPING_TIMES):
        judge, free, theta = of_effects()
        run = levenberg_marquardt(judge, free, Begin(theta), 5)
        first = answered(judge, run, 1000.0)
        costs = [900.0, 900.0, 900.0]
        costs[best] = 800.0
        asked = run.send(np.concatenate([squares(c) for c in costs]))
        assert len(asked) == 2 and np.all(
            np.abs(asked - first[best]).max(axis=1) <= 1.01 * DIFFERENCE * judge.scale[free]
        )
        x = np.ones((2, 2, N))
        x[1, :, ::2] = -1.0
        error = squares(800.0)[0]
        asked = run.send(np.array([error - DIFFERENCE * signal for signal in x]))
        np.testing.assert_allclose(asked, trials_of(judge, first[best], free, error, x, 1e-3 * times), rtol=1e-6)


@pytest.mark.parametrize(
    ("roughly", "sparing", "here", "least"),
    [
        (False, False, 1000.0, GAINED_AT_LEAST * 2), (False, True, 1000.0, LEAST_STEP_FALL * (1000.0 - 2 * N)),
        (False, True, 500.0, GAINED_AT_LEAST * 2),
        (True, False, 1000.0, GAINED_AT_LEAST * 2 * (1.0 + (1000.0 - 2 * N) / EVIDENCE)),
        (True, False, 300.0, GAINED_AT_LEAST * 2),
    ],
)  # fmt: skip
@pytest.mark.parametrize("side", [0.99, 1.01])
def test_a_descent_ends_where_it_gains_too_little(
    roughly: bool, sparing: bool, here: float, least: float, side: float
) -> None:
    judge, free, theta = of_effects()
    judge.roughly, judge.sparing = roughly, sparing
    run = levenberg_marquardt(judge, free, Begin(theta), 5)
    trials = answered(judge, run, here)
    try:
        run.send(np.concatenate([squares(here + 5.0), squares(here - side * least), squares(here + 5.0)]))
        assert side > 1.0
    except StopIteration as end:
        assert side < 1.0 and end.value.theta.tolist() == trials[1].tolist()
        assert end.value.total == pytest.approx(here - side * least) and end.value.linear is None


def test_a_descent_has_as_many_steps_as_it_is_given() -> None:
    for many in (1, 2, 3):
        judge, free, theta = of_effects()
        run = levenberg_marquardt(judge, free, Begin(theta), many)
        answered(judge, run, 4000.0)
        for step in range(many):
            try:
                asked = run.send(squares(3000.0 - 400.0 * step, 3))
            except StopIteration as end:
                assert step == many - 1 and end.value.total == pytest.approx(3000.0 - 400.0 * step)
                break
            assert len(asked) == 2 and step < many - 1
            error = squares(3000.0 - 400.0 * step)[0]
            x = np.ones((2, 2, N))
            x[1, :, ::2] = -1.0
            run.send(np.array([error - DIFFERENCE * signal for signal in x]))


def test_carried_slopes_are_gone_on_with_while_a_step_keeps_half_of_what_they_promise() -> None:
    judge, free, theta = of_effects()
    judge.stage.carries = True
    # of a straight model a whole step leaves 1000 - gain; each step says how much of what it promises comes true
    for kept, carried in ((0.51, True), (0.49, False)):
        run = levenberg_marquardt(judge, free, Begin(theta), 9)
        trials = answered(judge, run, 1000.0)
        step = (trials[0] - theta)[free] / judge.scale[free]
        x = np.ones((2, 2, N))
        x[1, :, ::2] = -1.0
        rows, error = x.reshape(2, -1), squares(1000.0)[0].ravel()
        promised = 2.0 * step @ (rows @ error) - step @ (rows @ rows.T) @ step
        asked = run.send(np.concatenate([squares(1000.0 - kept * promised), squares(1001.0, 2)]))
        assert (len(asked) == 3) == carried  # at once the next three trials; else slopes of two columns
        if carried:
            b = BroydenJacobian(squares(1000.0)[0], x)
            b.moved(step, squares(1000.0 - kept * promised)[0])
            wanted = trials_of(judge, trials[0], free, b.error, b.slopes, 1e-3 * DAMPING_TIMES[0])
            np.testing.assert_allclose(asked, wanted, rtol=1e-6)


def test_slopes_that_are_known_near_the_start_are_gone_on_with() -> None:
    stage, x = made(2, carries=True)
    judge = LeastSquaresProblem(stage, FLOOR)
    free, theta = np.arange(3), np.array([1.0, 3.0, 3.0])
    own = x / FLOOR[:, None] * judge.scale[:, None, None]
    known = Known(np.array([0, 2]), own[[0, 2]].reshape(2, -1))
    assert known.fits(2 * N) and not known.fits(N) and not NOT_KNOWN.fits(2 * N)
    run = levenberg_marquardt(judge, free, Begin(theta, near=known), 5)
    asked = next(run)
    assert len(asked) == 2 and asked[0].tolist() == theta.tolist()
    assert (asked[1] - theta).tolist() == pytest.approx([0.0, DIFFERENCE * judge.scale[1], 0.0])
    asked = run.send(judge.errors(asked))
    np.testing.assert_allclose(asked, trials_of(judge, theta, free, judge.errors(theta[None])[0], own, 1e-3), rtol=1e-5)
    plain = LeastSquaresProblem(replace(stage, carries=False), FLOOR)
    assert len(next(levenberg_marquardt(plain, free, Begin(theta, near=known), 5))) == 4
    assert (
        len(next(levenberg_marquardt(judge, free, Begin(theta, near=Known(known.columns, known.rows[:, :-1])), 5))) == 4
    )


def test_of_kept_slopes_those_before_a_column_are_given() -> None:
    kept, theta, free = LatestSlopes(), np.arange(4.0), np.array([0, 2, 3])
    rows = np.arange(12.0).reshape(3, 1, 4)
    kept.put(theta, free, np.zeros((1, 4)), rows)
    for before, many in ((0, 0), (1, 1), (2, 1), (3, 2), (np.inf, 3)):
        got = kept.of(theta, free, before)
        assert got.columns.tolist() == free[:many].tolist() and got.rows.tolist() == rows[:many].tolist()
    assert kept.of(theta + 1.0, free) is NOT_KNOWN and kept.get(theta, free[:2]) is None


# ---- what a fit makes of blocks and slopes ---------------------------------------------------------------------------


def test_slopes_of_nominal_parameters_are_over_a_twentieth_of_their_tolerances() -> None:
    asked: list[Array] = []
    t = 0.1 * np.arange(200)

    def run(thetas: Array) -> Array:
        asked.append(thetas.copy())
        return (thetas[:, :1] ** 2 * np.sin(t) + thetas[:, 1:2] * 0.0 + thetas[:, 2:] * t)[:, None]

    parameters = (
        Parameter("a", 1.0, "1", 0.0, 9.0, 0.4),
        Parameter("known", 2.0, "1"),
        Parameter("c", 0.5, "1", 0.0, 9.0, 2.0),
    )
    stage = Stage("s", ("y",), ("V",), parameters, (), run, t, np.zeros((1, 200)), floor=np.array([0.5]))
    judge = LeastSquaresProblem(stage, np.array([0.5]))
    assert judge.nominal == [0, 2] and judge.columns(()).tolist() == [0, 2]
    asked.clear()
    error, slopes = judge.nominal_slopes(np.array([1.0, 2.0, 0.5]))
    assert asked[0].tolist() == [[1.0, 2.0, 0.5], [1.02, 2.0, 0.5], [1.0, 2.0, 0.6]]
    np.testing.assert_allclose(error[0], -(np.sin(t) + 0.5 * t) / 0.5)
    np.testing.assert_allclose(slopes[:, 0], [-(1.02**2 - 1.0) / 0.02 * np.sin(t) / 0.5, -t / 0.5], atol=1e-9)


@pytest.mark.parametrize(("memory", "blocks"), [(0.0, USUAL_BLOCKS), (1.0, MOST_BLOCKS), (30.0, MIN_BLOCKS), (4.0, 29)])
def test_a_log_has_so_many_blocks_as_its_memory_makes(memory: float, blocks: int) -> None:
    stage, _ = made(1, memory=memory)
    judge = LeastSquaresProblem(stage, FLOOR)
    assert judge.n_blocks == blocks and judge.memory == (memory or (T[-1] - T[0]) / USUAL_BLOCKS)
    share = (T - T[0]) / (T[-1] - T[0])
    wanted = np.minimum((share * blocks).astype(int), blocks - 1)
    assert judge.block_of.tolist() == wanted.tolist() and judge.samples.sum() == judge.n == 2 * N


@pytest.mark.parametrize("seed", [4, 5])
def test_intervals_are_as_wide_as_the_blocks_scatter_or_as_the_information_says(seed: int) -> None:
    stage, _ = made(seed)
    judge = LeastSquaresProblem(stage, FLOOR)
    fit = judge.fit(("a", "b"), stage.neutral())
    scale, expected = judge.scale[fit.free], stage.expected()
    prior = judge.prior[fit.free] * scale**2
    total = fit.normals.sum(axis=0) + np.diag(prior)
    pull = fit.gradients.sum(axis=0) - prior * (fit.theta - expected)[fit.free] / scale
    out = np.array([np.linalg.solve(total - n, pull - g) for n, g in zip(fit.normals, fit.gradients, strict=True)])
    many = judge.n_blocks
    scatter = (many - 1) / many * ((out - out.mean(axis=0)) ** 2).sum(axis=0)
    excess = max(1.0, fit.cost.sum() / judge.n)
    worth = min(1.0 / excess, 2 * EVIDENCE / judge.n)
    known = np.diag(np.linalg.inv(fit.normals.sum(axis=0) * worth + np.diag(prior)))
    half = NINETY * np.sqrt(np.maximum(scatter, known)) * scale
    np.testing.assert_allclose(fit.high - fit.theta, half, rtol=1e-6)
    np.testing.assert_allclose(fit.theta - fit.low, half, rtol=1e-6)
    assert judge.total_of(fit) == pytest.approx(judge.totals(judge.errors(fit.theta[None]), fit.theta[None])[0])
    squares = judge.mean_squares(judge.errors(fit.theta[None])[0])
    np.testing.assert_allclose(squares, (judge.errors(fit.theta[None])[0] ** 2).mean(axis=1))


def test_a_fit_that_gains_nothing_more_is_left_as_it_was() -> None:
    stage, _ = made(6)
    judge = LeastSquaresProblem(stage, FLOOR)
    asked: list[int] = []
    whole = judge.fit(("a",), stage.neutral())
    first = replace(whole, cost=1000.0 * whole.cost / whole.cost.sum())
    now = first
    gains = iter([0.5, 0.0011, 0.0009, 0.5])

    def fitting(effects: Any, start: Any, iterations: int) -> Any:
        nonlocal now
        asked.append(iterations)
        now = replace(start, cost=start.cost - next(gains) * start.cost.sum() / len(start.cost))
        yield from ()
        return now

    judge.fitting = fitting  # type: ignore[assignment, method-assign]

    def begun() -> Any:
        yield from ()
        return first

    (fit,) = judge.together([to_the_end(judge, begun())])
    assert asked == [8, 8, 8] and fit is now  # it ends with what gains less than a thousandth
    asked.clear()
    gains = iter([-0.5])
    (fit,) = judge.together([to_the_end(judge, begun())])
    assert asked == [8] and fit is first
    asked.clear()
    gains = iter([0.5] * 9)
    judge.together([to_the_end(judge, begun())])
    assert asked == [8] * 4
    assert judge.together([to_the_end(judge, begun(), False)]) == [first] and asked == [8] * 4


def test_what_moves_with_nothing_known_has_no_covariance() -> None:
    information = np.array([[4.0, 1.0, 0.0], [1.0, 3.0, 0.0], [0.0, 0.0, np.inf]])
    out = covariance(information)
    np.testing.assert_allclose(out[:2, :2], np.linalg.inv(information[:2, :2]))
    assert out[2, 2] == np.inf and not out[2, :2].any()


def test_a_size_that_is_to_be_repeated_or_cleared_up_has_a_usual_change() -> None:
    effects = (
        Effect("law", (Parameter("a", 1.0, "1"), Parameter("b", 4.0, "1"), Parameter("c", 0.0, "1")),
               ((2.0, 4.0, 0.0), (5.0, 4.0, 0.0), (1.0, 4.0, 0.0))),
    )  # fmt: skip
    parameters = (Parameter("p", 3.0, "1", 0.0, 9.0, 0.5), Parameter("q", -2.0, "1"), Parameter("r", 0.0, "1"),
                  Parameter("s", 3.0, "1", scale=7.0))  # fmt: skip
    stage = Stage("s", ("y",), ("V",), parameters, effects, lambda th: np.zeros((len(th), 1, N)), T, np.zeros((1, N)),
                  floor=np.ones(1))  # fmt: skip
    judge = LeastSquaresProblem(stage, np.ones(1))
    assert judge.scale.tolist() == [0.5, 2.0, 1.0, 7.0, 2.5, 4.0, 1.0]
    assert judge.prior[:4].tolist() == [12.0, 0.0, 0.0, 0.0]


@pytest.mark.parametrize("carries", [False, True])
def test_a_fit_keeps_its_slopes_where_the_stage_carries_them(carries: bool) -> None:
    stage, x = made(7, carries=carries)
    judge = LeastSquaresProblem(stage, FLOOR)
    fit = judge.fit(("a", "b"), stage.neutral(), 1)
    assert fit.near is not None
    kept = fit.near.get(fit.theta, fit.free)
    assert (kept is not None) == carries
    if kept is not None:
        np.testing.assert_allclose(kept[0], judge.errors(fit.theta[None])[0])
        np.testing.assert_allclose(kept[1], x / FLOOR[:, None] * judge.scale[:, None, None], rtol=1e-6, atol=1e-8)


def test_a_rough_fit_ends_without_trials_where_its_slope_promises_too_little() -> None:
    for here, goes_on in ((4.0, True), (0.3, False)):  # two parameters, two tenths each
        judge, free, theta = of_effects()
        judge.roughly = True
        run = levenberg_marquardt(judge, free, Begin(theta), 5)
        answered(judge, run, 1000.0)
        asked = run.send(squares(here, 3))
        assert len(asked) == 2
        x = np.ones((2, 2, N))
        x[1, :, ::2] = -1.0
        error = squares(here)[0]
        try:
            assert len(run.send(np.array([error - DIFFERENCE * signal for signal in x]))) == 3 and goes_on
        except StopIteration as end:
            assert not goes_on and end.value.linear is not None and end.value.total == pytest.approx(here)


def test_without_a_column_to_move_nothing_is_tried() -> None:
    judge, _, theta = of_effects()
    run = levenberg_marquardt(judge, np.zeros(0, dtype=int), Begin(theta), 5)
    assert len(next(run)) == 1
    with pytest.raises(StopIteration) as end:
        run.send(squares(100.0))
    assert end.value.value.total == pytest.approx(100.0) and end.value.value.theta.tolist() == theta.tolist()
