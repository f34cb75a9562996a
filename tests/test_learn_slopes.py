"""Slopes that are carried along a fit, and steps between samples that a jump does not meet: less work, one answer."""

from __future__ import annotations

from collections.abc import Generator
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as some

from vaneloop.base.curve import on_even, on_table
from vaneloop.identification import Record, System, unknown
from vaneloop.identification.least_squares import levenberg_marquardt as steps
from vaneloop.identification.least_squares.levenberg_marquardt import NOT_KNOWN, BroydenJacobian, Known, LatestSlopes
from vaneloop.identification.least_squares.problem import LeastSquaresProblem
from vaneloop.identification.subsystem import Array, Effect, Parameter, Stage
from vaneloop.identification.unmodelled.curve_candidates import candidates, with_curves
from vaneloop.identification.user_models import simulation as runner
from vaneloop.identification.user_models.bound_system import BoundSystem

pytestmark = pytest.mark.filterwarnings("ignore")


def bent_stage(asked: list[int], bend: float, unit: float = 1.0) -> Stage:
    """Outputs a x + bend (b + a b) x^2 + b sin(x) of an effect's a and b / unit; the log has 1 and 2."""
    x = np.linspace(-1.0, 2.0, 400)

    def y(a: float, b: float) -> Array:
        return np.asarray(a * x + bend * (b + a * b) * x**2 + b * np.sin(3.0 * x))

    def run(thetas: Array) -> Array:
        asked.append(len(thetas))
        return np.array([[y(a, b * unit)] for a, b in thetas])

    noise = 1e-3 * np.random.default_rng(4).standard_normal(len(x))
    parameters = (Parameter("a", 0.0, "", scale=1.0), Parameter("b", 0.0, "", scale=1.0 / unit))
    effect = Effect("law", parameters, ((0.1, 0.1 / unit),))
    return Stage("bent", ("y",), ("",), (), (effect,), run, np.arange(400.0), (y(1.0, 2.0) + noise)[None], carries=True)


@given(some.integers(0, 10_000))
def test_carried_slopes_say_what_the_last_step_did(seed: int) -> None:
    """The errors there less those before are the slopes times the step; the normal matrix is theirs."""
    rng = np.random.default_rng(seed)
    error, slopes, step = rng.standard_normal((1, 50)), rng.standard_normal((4, 1, 50)), rng.standard_normal(4)
    carried, there = BroydenJacobian(error, slopes.copy()), rng.standard_normal((1, 50))
    carried.moved(step, there)
    np.testing.assert_allclose(-step @ carried.slopes, (there - error)[0], atol=1e-9)
    np.testing.assert_allclose(carried.normal, carried.slopes @ carried.slopes.T, atol=1e-8)
    np.testing.assert_allclose(carried.gradient, carried.slopes @ there[0], atol=1e-9)


def test_a_linear_model_keeps_its_slopes() -> None:
    """What the slopes foretold changes nothing in them."""
    rng = np.random.default_rng(1)
    slopes, step = rng.standard_normal((3, 1, 40)), np.array([0.5, -2.0, 0.1])
    error = rng.standard_normal((1, 40))
    carried = BroydenJacobian(error, slopes.copy())
    carried.moved(step, error - (step @ slopes[:, 0])[None])
    np.testing.assert_allclose(carried.slopes, slopes[:, 0], atol=1e-12)


def test_a_fit_by_carried_slopes_ends_where_one_by_simulated_ones_does(monkeypatch: pytest.MonkeyPatch) -> None:
    """From slopes near the start, with fewer simulations; in any unit."""
    ends, many = [], []
    for limit, unit in ((400_000, 1.0), (0, 1.0), (400_000, 1e6)):
        monkeypatch.setattr(steps, "CARRIED_VALUES", limit)
        asked: list[int] = []
        judge = LeastSquaresProblem(bent_stage(asked, 0.2, unit), np.array([1e-3]))
        start = np.array([0.3, 0.5 / unit])
        free = judge.columns(("law",))
        near = Known(free, judge.linearise(np.array([0.2, 0.6 / unit]), free)[1]) if limit else NOT_KNOWN
        asked.clear()
        fit = judge.fit(("law",), start, 20, slopes=near)
        ends.append(fit.theta * [1.0, unit])
        many.append(sum(asked))
    np.testing.assert_allclose(ends[0], ends[1], rtol=1e-4)
    np.testing.assert_allclose(ends[2], ends[0], rtol=1e-6)
    np.testing.assert_allclose(ends[0], [1.0, 2.0], rtol=1e-3)
    assert many[0] < many[1]


def test_wrong_slopes_lead_no_fit_astray() -> None:
    """Slopes of the wrong sign, or of another log's length, are simulated anew."""
    for rows in (-1.0, None):
        judge = LeastSquaresProblem(bent_stage([], 0.2), np.array([1e-3]))
        free = judge.columns(("law",))
        slopes = judge.linearise(np.array([0.3, 0.5]), free)[1]
        near = Known(free, rows * slopes if rows else slopes[:, :, :300])
        judge._near = LatestSlopes()
        fit = judge.fit(("law",), np.array([0.3, 0.5]), 20, slopes=near)
        np.testing.assert_allclose(fit.theta, [1.0, 2.0], rtol=1e-3)


def test_a_fit_is_judged_by_slopes_that_were_simulated_at_its_end() -> None:
    """Its gradients and normals are those of `LeastSquaresProblem.linearise` there."""
    judge = LeastSquaresProblem(bent_stage([], 0.2), np.array([1e-3]))
    fit = judge.fit(("law",), np.array([0.3, 0.5]), 20)
    judge._near = LatestSlopes()
    cost, gradients, normals = judge.blocks(*judge.linearise(fit.theta, fit.free))
    np.testing.assert_allclose(fit.cost, cost, rtol=1e-9)
    np.testing.assert_allclose(fit.gradients, gradients, rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(fit.normals, normals, rtol=1e-9)


def test_no_descent_ends_by_carried_slopes(monkeypatch: pytest.MonkeyPatch) -> None:
    """The last sets but one that it asks for are simulated slopes: it has not ended by what was carried."""
    judge = LeastSquaresProblem(bent_stage([], 0.2), np.array([1e-3]))
    free = judge.columns(("law",))
    monkeypatch.setattr(judge, "_moves", [(None, None)] * 2)
    kinds, task = [], steps.levenberg_marquardt(judge, free, steps.Begin(np.array([0.3, 0.5])), 20)
    end = drive(judge, task, kinds)
    assert 3 in kinds and 2 in kinds
    assert end.linear is not None or kinds[-2] == 2


def drive(judge: LeastSquaresProblem, task: Generator[Array, Array, Any], kinds: list[int]) -> Any:
    """Run a task alone, noting how many sets it asks for each time."""
    try:
        asked = next(task)
        while True:
            kinds.append(len(asked))
            asked = task.send(judge.errors(asked).copy())
    except StopIteration as end:
        return end.value


@given(some.floats(allow_nan=True, allow_infinity=True))
def test_a_table_s_points_are_found_with_and_without_a_division(x: float) -> None:
    """Both kinds of look-up say the same, far beyond its ends too."""
    table = np.cos(np.linspace(0.0, 3.0, 257))
    mine, other = on_even(x, -1.0, 256.0 / 3.0, table), on_table(x, -1.0, 2.0, table)
    np.testing.assert_allclose(mine, other, atol=1e-9)


def relay(x: Any, u: Any, p: Any) -> Any:  # dx/dt
    return p.rate * (u.v - x.first), x.first - x.second


@pytest.mark.slow
def test_an_interval_that_no_jump_is_met_in_needs_no_more_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """A curve with a jump, in a state's rate: as with four steps everywhere, and exact between its jumps."""
    rng = np.random.default_rng(5)
    t = 0.02 * np.arange(1500)
    v = np.repeat(rng.uniform(-1.0, 1.0, 60), 25)
    record = Record("log", t, {"v": v, "second": 0.1 * rng.standard_normal(1500)})
    system = System(
        name="lags", kind="simulate", model=relay, inputs={"v": "V"}, states={"first": "V", "second": "V"},
        outputs={"second": "V"}, parameters=[unknown("rate", 2.0, "1/s")],
    )  # fmt: skip
    bound = BoundSystem(system, [record])
    own = bound.stage.neutral()[: len(bound.stage.parameters)]
    known = candidates(with_curves(bound, (), ()), own)
    c = next(c for c in known if c.name == "second.curve_of_first").jumping()
    assert c is not None
    said = []
    for many in (4, 64):
        monkeypatch.setattr(runner, "SWITCHED", many)
        for everywhere in (False, True):
            held = with_curves(bound, (), [(c.placed(), c.effect(1.0))])
            theta = held.stage.neutral()
            theta[: len(own)] = own
            theta[-1] = 0.3
            if everywhere:
                held.runner.steps = many
            said.append(held.stage.run(theta[None])[0, 0])
    exact = said[3]  # so many steps everywhere
    assert np.std(exact) > 0.05
    rms = [float(np.sqrt(np.mean((y - exact) ** 2))) for y in said[:3]]
    assert rms[0] < 2.0 * rms[1] + 1e-5
    assert rms[2] < 1e-4
