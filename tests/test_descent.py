"""What each number of a fit's steps does, on models whose steps have a closed form; of a search's order and report.

A model here is y = b(size) u: what the steps do is what Gauss and Newton do to b, and the damping says how far they go.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.test_search_limits import SIDES, fit_of, judge_of
from vaneloop.identification import workflow
from vaneloop.identification.least_squares.levenberg_marquardt import NOT_KNOWN, Known, carries
from vaneloop.identification.least_squares.problem import LeastSquaresProblem
from vaneloop.identification.selection import diagnosis as diagnose
from vaneloop.identification.subsystem import Effect, Parameter, Stage

N = 240  # samples
Array = np.ndarray[Any, Any]


class Asked(list[Array]):
    """The parameter sets of each call of a stage's ``run``, of its effect's parameters."""

    def trials(self) -> list[Array]:
        """Those of the three dampings; the others are slopes."""
        return [sets for sets in self if len(sets) == 3]

    def kinds(self) -> str:
        """s: slopes, t: trials."""
        return "".join("t" if len(sets) == 3 else "s" for sets in self)


def judge_with(
    model: Callable[[Array], Array], size: float, rest: float = 0.0, columns: int = 1, carry: bool = False
) -> tuple[LeastSquaresProblem, Asked]:
    """A stage whose first parameter leaves an error ``size`` (1 - model), root of the sum of squares; each of the other
    ``columns`` has a slope of its own and no error. ``rest``: the sum of squares beyond noise that no parameter takes
    off.
    """
    asked = Asked()
    direction = np.zeros(N)
    direction[: N // 2 : 2] = 1.0 / np.sqrt(N // 4)

    def run(thetas: Array) -> Array:
        asked.append(thetas.copy())
        out = size * model(thetas[:, 0])[:, None] * direction
        out[:, N - columns + 1 :] += thetas[:, 1:]
        return out[:, None, :]

    measured = size * direction
    measured[1 : N // 2 : 2] = np.sqrt((N + rest) / (N // 4))
    parameters = tuple(Parameter(f"p{k}", 0.0, "1", -1e3, 1e3, scale=1.0) for k in range(columns))
    effect = Effect("e", parameters, (tuple(1.0 for _ in parameters),))
    stage = Stage("s", ("y",), ("1",), (), (effect,), run, 0.1 * np.arange(N), measured[None], carries=carry)
    judge = LeastSquaresProblem(stage, np.ones(1))
    assert judge.n == N
    return judge, asked


def cubic(theta: Array) -> Array:
    """What is left is (1 - theta)^3: a full step takes off a third of 1 - theta, and all but (2/3)^6 of its square."""
    return 1.0 - (1.0 - theta) ** 3


LEFT = (2.0 / 3.0) ** 6  # of the sum of squares that the cubic model can take off, after each step


# ---- dampings --------------------------------------------------------------------------------------------------------


def test_the_first_steps_are_damped_by_a_thousandth_and_by_a_hundredth_and_three_hundred_times_that() -> None:
    """Linear: a step damped by d goes 1 / (1 + d) of the way."""
    judge, asked = judge_with(lambda theta: theta, 1e4)
    judge.lead(("e",), np.zeros(1), 1)
    (first,) = asked.trials()
    np.testing.assert_allclose(1.0 / first[:, 0] - 1.0, 1e-3 * np.array([0.01, 1.0, 300.0]), rtol=1e-6)


def test_the_damping_that_did_best_is_that_of_the_next_steps() -> None:
    judge, asked = judge_with(cubic, 1e6)
    judge.lead(("e",), np.zeros(1), 3)
    at, done = 0.0, []
    for sets in asked.trials():
        step = sets[:, 0] - at
        full = (1.0 - at) / 3.0
        done.append(full / step - 1.0)
        at = float(sets[0, 0])  # the least damped goes farthest, and is best here
    # the slope over a thousandth of a scale is a little flatter than the tangent
    np.testing.assert_allclose(done[0], 1e-3 * np.array([0.01, 1.0, 300.0]), atol=2e-3)
    np.testing.assert_allclose(done[1], 1e-5 * np.array([0.01, 1.0, 300.0]), atol=4e-3)


def test_a_step_that_brings_nothing_is_tried_four_times_ever_shorter_to_1e_15() -> None:
    """A slope that lies: at any step but that of the slope the error is greater."""
    judge, asked = judge_with(lambda theta: np.where(theta == 0.0, 0.0, np.where(theta == 1e-3, 0.01, -1.0)), 1e7)
    end = judge.fit(("e",), np.zeros(1), 5)
    full = 1.0 / 10.0  # the slope promises 0.01 of the error a thousandth
    steps = np.concatenate(asked.trials())[:, 0]
    assert len(asked.trials()) == 4 and end.stalled and end.theta[0] == 0.0
    damping = 1e-3 * np.array([1e5**tries * factor for tries in range(4) for factor in (0.01, 1.0, 300.0)])
    np.testing.assert_allclose(steps, full / (1.0 + damping), rtol=1e-3)
    assert 1e-16 < steps[-1] / full < 1e-14
    assert not judge.fit(("e",), np.full(1, -5.0), 0).stalled and not fit_of(1.0, judge_of(2, 2)).stalled


# ---- where a descent ends --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("times", "goes_on"), [(0.81, False), (0.98, False), (1.02, True), (1.24, True)])
def test_a_sparing_fit_ends_where_a_step_takes_off_less_than_a_thousandth_of_what_it_leaves(
    times: float, goes_on: bool
) -> None:
    """The second step of the cubic model takes off (1 - LEFT) LEFT of its square."""
    rest = 1e6
    square = times * 1e-3 * rest / (LEFT * (1.0 - LEFT) - 1e-3 * LEFT)
    for sparing, steps in ((True, 3 if goes_on else 2), (False, 5)):
        judge, asked = judge_with(cubic, np.sqrt(square), rest)
        judge.sparing = sparing
        judge.lead(("e",), np.zeros(1), 5)
        assert len(asked.trials()) == steps


@pytest.mark.parametrize(("times", "goes_on"), [(0.9, False), (1.1, True)])
def test_a_fit_ends_where_a_step_takes_off_less_than_a_fifth_a_parameter(times: float, goes_on: bool) -> None:
    square = times * 0.2 / (LEFT * (1.0 - LEFT))
    judge, asked = judge_with(cubic, np.sqrt(square))
    judge.lead(("e",), np.zeros(1), 5)
    assert len(asked.trials()) == (3 if goes_on else 2)


# ---- slopes that are carried along -----------------------------------------------------------------------------------


def overshooting(kept: float) -> Callable[[Array], Array]:
    """1 - b for b = 1 - theta + c theta^2: the most damped first step, of 1 / 1.3, does best, and brings that share of
    what the slope promises.
    """
    step = 1.0 / 1.3
    promised = 2.0 * step - step**2
    c = (np.sqrt(1.0 - kept * promised) - (1.0 - step)) / step**2
    return lambda theta: theta - c * theta**2


@SIDES
def test_slopes_are_carried_on_where_a_step_brought_half_of_what_they_promised(times: float, beyond: bool) -> None:
    model = overshooting(0.5 * times)
    judge, asked = judge_with(model, 1e4, carry=True)
    judge.lead(("e",), np.zeros(1), 2)
    assert asked.trials()[0][2, 0] == pytest.approx(1.0 / 1.3, rel=2e-3)
    assert asked.kinds()[:3] == ("stt" if beyond else "sts")
    judge, asked = judge_with(model, 1e4, carry=False)
    judge.lead(("e",), np.zeros(1), 2)
    assert asked.kinds() == "stst"


@pytest.mark.parametrize(("columns", "steps"), [(1, 3), (4, 5), (10, 6), (12, 6)])
def test_a_step_by_carried_slopes_counts_as_a_third_of_an_iteration_at_least(columns: int, steps: int) -> None:
    """It counts by its three trials beside those and a slope a parameter, 3 / (3 + parameters), and 0.34 at least."""
    judge, asked = judge_with(lambda theta: 1.0 - (1.0 - theta) ** 2, 1e12, columns=columns, carry=True)
    start = np.zeros(columns)
    _, slopes = judge.linearise(start, np.arange(columns))
    judge._near = type(judge._near)()
    asked.clear()
    judge.lead(("e",), start, 2, Known(np.arange(columns), slopes.reshape(columns, -1)))
    assert steps == int(np.ceil(2.0 / max(0.34, 3.0 / (3.0 + columns))))
    assert asked.kinds() == "t" * steps


@pytest.mark.parametrize(
    ("columns", "values", "carried"), [(4, 100_000, True), (5, 80_000, True), (5, 80_001, False), (1, 400_001, False)]
)
def test_no_more_than_four_hundred_thousand_values_of_slopes_are_carried(
    columns: int, values: int, carried: bool
) -> None:
    judge: Any = SimpleNamespace(stage=SimpleNamespace(carries=True), measured=np.zeros((1, values)))
    assert carries(judge, np.arange(columns)) == carried
    judge.stage.carries = False
    assert not carries(judge, np.arange(columns))


def test_nothing_that_is_known_is_no_slope() -> None:
    assert not NOT_KNOWN.fits(0) and not NOT_KNOWN.fits(1)


# ---- how far a search is, and in which order -------------------------------------------------------------------------


@pytest.mark.parametrize(("fits", "share"), [(0, 0.0), (20, 0.25), (60, 0.5), (180, 0.75)])
def test_half_of_a_stage_is_done_after_sixty_fits(fits: int, share: float) -> None:
    work = workflow._Work([SimpleNamespace(name=n, effects=("a", "b"), outputs=("y",)) for n in "pq"])  # type: ignore[misc]
    work.fits[0].value = fits
    assert workflow._how_far(work, set())[0] == pytest.approx(share / 2.0)
    done, said = workflow._how_far(work, {1})
    assert done == pytest.approx(share / 2.0 + 0.5)
    assert said == "1 of 2 subsystems searched" + (f"; trying p (2 effects, {fits} fits)" if fits else "")


def test_stages_ten_times_smaller_than_the_largest_are_searched_first() -> None:
    def order(*sizes: int, side_by_side: bool = False) -> list[int]:
        stages: Any = [SimpleNamespace(effects=range(n), outputs=("y",)) for n in sizes]
        return [sizes[i] for i in workflow._order(stages, side_by_side)]

    assert order(50, 105, 11, 10, 9) == [9, 10, 105, 50, 11]
    assert order(50, 100, 11, 10, 9) == [9, 100, 50, 11, 10]
    assert order(50, 105, 11, 10, 9, side_by_side=True) == [105, 9, 10, 50, 11]


def test_searches_in_other_processes_are_looked_at_ten_times_a_second(monkeypatch: pytest.MonkeyPatch) -> None:
    waits: list[float | None] = []

    @contextmanager
    def in_processes(*_: object) -> Iterator[Any]:
        def submit(i: int) -> Future[Any]:
            done: Future[Any] = Future()
            done.set_result((SimpleNamespace(stage=str(i), verdict="none", effects=[]), []))
            return done

        yield submit

    def wait(jobs: Any, seconds: float | None, _: str) -> Any:
        waits.append(seconds)
        return (set() if len(waits) == 1 else set(jobs)), set()

    monkeypatch.setattr(workflow, "in_processes", in_processes)
    monkeypatch.setattr(workflow, "wait", wait)
    for name in ("_agree", "weigh"):
        monkeypatch.setattr(workflow, name, lambda *_: None)
    stages: Any = [SimpleNamespace(name=n, effects=("a",), outputs=("y",)) for n in "pq"]
    told: list[float] = []
    assert workflow.diagnose(stages, progress=told.append).verdict == "none"
    assert waits == [0.1, 0.1] and told == [0.0, 0.5, 1.0]
    waits[:] = [0.0]
    workflow.diagnose(stages)
    assert waits[1:] == [None]  # who is told nothing waits for the end


def test_pairs_are_tried_with_the_two_effects_that_lead_beside_the_model_s(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where effects found leave more than noise: what leads alone may make up for two at once."""
    tried: list[str] = []

    def best_of(sets: list[tuple[str, ...]]) -> list[Any]:
        tried.append(sets[0][0])
        assert [s[1] for s in sets] == [m for m in "abcde" if m != sets[0][0]]
        return [SimpleNamespace(effects=sets[0], left=9.0)]

    criterion = SimpleNamespace(roams=True, left_out={}, accepts=lambda a, b: b.left < a.left, order=lambda f: f.left)
    effects = [SimpleNamespace(name=n) for n in "abcde"]
    search: Any = SimpleNamespace(
        criterion=criterion, base=SimpleNamespace(left=100.0), stage=SimpleNamespace(effects=effects), best_of=best_of
    )
    singles: Any = {n: SimpleNamespace(left=float(k)) for k, n in enumerate("abcd", 50)}
    singles["e"] = SimpleNamespace(left=100.0)  # earns nothing
    current: Any = SimpleNamespace(effects=("a",), left=40.0)
    search.judge = None
    monkeypatch.setattr(diagnose, "rms_of", lambda judge, fit: fit.left)
    led: list[list[str]] = []
    selection: Any = SimpleNamespace(search=search, singles=singles, ranked=list("abcde"))
    selection.leaders = lambda ranked, many: led.append(ranked) or ["e", "b", "d"][: 2 * many]
    found = diagnose._on_another_way(selection, current)
    assert tried == ["b", "c"] and found is not None and found.effects[0] == "b" and not led
    tried.clear()
    current.left = 60.0  # more than half of the RMS: no name rests on it
    criterion.left_out = {"c": "harms"}
    search.best_of = lambda sets: [tried.append(sets[0][0]), SimpleNamespace(effects=sets[0], left=9.0)][1:]
    found = diagnose._on_another_way(selection, current)
    assert tried == ["e", "b", "d"] and found is not None and led == [list("abde")]
