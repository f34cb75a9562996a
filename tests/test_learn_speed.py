"""What makes learning quick must not change what it says: threads, and the way from one smoothness to the next."""

from __future__ import annotations

import threading
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from vaneloop.base import side_by_side as sharing
from vaneloop.base.side_by_side import shared_out, side_by_side
from vaneloop.identification import Record, System, unknown
from vaneloop.identification.unmodelled.screening import smoothed
from vaneloop.identification.user_models import injection_points as nominal
from vaneloop.identification.user_models import simulation as runner
from vaneloop.identification.user_models.bound_system import BoundSystem
from vaneloop.identification.user_models.codegen import compiled_code

pytestmark = pytest.mark.filterwarnings("ignore")


def tank(x: Any, u: Any, p: Any) -> Any:  # dx/dt
    return p.inflow * u.pump - p.outflow * x.level


@pytest.mark.slow
def test_sets_in_two_threads_are_those_run_one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Bit for bit, with laws of the library and without."""
    rng = np.random.default_rng(11)
    t = np.arange(4000.0)
    pump = np.repeat(rng.uniform(0.0, 8.0, 80), 50)
    record = Record("log", t, {"pump": pump, "level": 20.0 + 0.5 * rng.standard_normal(4000)})
    system = System(
        name="tank", kind="simulate", model=tank, inputs={"pump": "V"}, states={"level": "cm"},
        outputs={"level": "cm"}, parameters=[unknown("inflow", 0.1, "cm/(V s)"), unknown("outflow", 0.05, "1/s")],
    )  # fmt: skip
    stage = BoundSystem(system, [record]).stage
    sets = np.repeat(stage.neutral()[None], 8, axis=0)
    sets[:, 0] *= np.linspace(0.5, 1.5, 8)
    for k, effect in enumerate(stage.effects[:6]):
        sets[k, stage.index()[effect.name]] = effect.starts[-1]
    monkeypatch.setattr(runner, "threads", lambda: 1)
    alone = stage.run(sets)
    monkeypatch.setattr(runner, "threads", lambda: 2)
    monkeypatch.setattr(runner, "SHORT_RUN", 0)
    assert np.array_equal(stage.run(sets), alone)
    assert not np.array_equal(alone[0], alone[1])


def as_list(x: float, y: float) -> Any:
    d = [x - y, 2.0]
    return d


def as_list_or_tuple(x: float, y: float) -> Any:
    if x > 0.0:
        return [0, y]
    return x, y


def as_array(x: float, y: float) -> Any:
    return np.array([x, x * y, 3])


def counted_before(x: float, y: float) -> Any:
    d = [x, y]
    d.append(float(len(d)))
    return d


def of_two_lengths(x: float, y: float) -> Any:
    return [x, y] if x > 0.0 else [x]


def as_its_array(x: float, y: float) -> Any:
    return np.array([x, y]) * 2.0


@pytest.mark.parametrize(
    ("f", "kind"),
    [
        (as_list, tuple), (as_list_or_tuple, tuple), (as_array, tuple),
        (counted_before, list), (of_two_lengths, list), (as_its_array, np.ndarray),
    ],
)  # fmt: skip
def test_what_only_leaves_a_function_leaves_it_in_a_tuple(f: Any, kind: type) -> None:
    """A list that numba makes in memory at each call takes longer than most models; its numbers are the same."""
    for x, y in ((1.0, 2.0), (-1.5, 0.25)):
        got = compiled_code(f, in_a_tuple=True)(x, y)
        assert isinstance(got, kind)
        assert list(got) == list(f(x, y))
        if f is not as_list_or_tuple:  # which numba cannot compile as it is
            assert not isinstance(compiled_code(f)(x, y), tuple)


def rates(x: Any, u: Any, p: Any) -> Any:
    return [p.rate * (u.v - x.first), x.first - x.second]


def seen(x: Any, u: Any, p: Any) -> Any:
    return [x.second, rates(x, u, p)[1]]


def rates_in_a_tuple(x: Any, u: Any, p: Any) -> Any:
    return p.rate * (u.v - x.first), x.first - x.second


def seen_in_a_tuple(x: Any, u: Any, p: Any) -> Any:
    return x.second, x.first - x.second


@pytest.mark.slow
def test_models_that_return_a_list_run_as_those_that_return_a_tuple() -> None:
    """Bit for bit, also where the output asks the model, which then gives it a list."""

    rng = np.random.default_rng(5)
    t = 0.02 * np.arange(500)
    columns = {"v": np.repeat(rng.uniform(-1.0, 1.0, 50), 10), "level": rng.standard_normal(500)}
    record = Record("log", t, {**columns, "rate": rng.standard_normal(500)})
    made = []
    for model, output in ((rates, seen), (rates_in_a_tuple, seen_in_a_tuple)):
        system = System(
            name="lags", kind="simulate", model=model, inputs={"v": "V"}, states={"first": "V", "second": "V"},
            outputs={"level": "V", "rate": "V/s"}, output=output, parameters=[unknown("rate", 2.0, "1/s")],
        )  # fmt: skip
        bound = BoundSystem(system, [record])
        assert not any("plain Python" in note for note in bound.data.notes)
        stage = bound.stage
        sets = np.repeat(stage.neutral()[None], 4, axis=0)
        sets[:, 0] *= np.linspace(0.5, 1.5, 4)
        made.append(stage.run(sets))
    assert np.array_equal(made[0], made[1])
    assert made[0].std() > 0.0


@pytest.mark.parametrize(
    ("scores", "asked", "best"),
    [
        ({0.1: 1.0, 1.0: 2.0, 5.0: 0.0}, [1.0, 0.1], 0.1),  # smoother helps: less smooth is not asked
        ({0.1: 3.0, 1.0: 2.0, 5.0: 1.0}, [1.0, 0.1, 5.0], 5.0),
        ({0.1: 3.0, 1.0: 2.0, 5.0: 4.0}, [1.0, 0.1, 5.0], 1.0),
        ({0.03: 0.5, 0.1: 1.0, 1.0: 2.0, 5.0: 0.0}, [1.0, 0.1, 0.03], 0.03),
    ],
)
def test_smoothness_goes_the_way_that_helps_from_fit_to_fit(
    scores: dict[float, float], asked: list[float], best: float
) -> None:
    """Each fit begins where the best one so far has ended."""
    seen: list[tuple[float, Any]] = []

    def fitted(current: Any, candidate: Any, wiggle: float, begin: Any, iterations: int) -> Any:
        seen.append((wiggle, begin))
        return SimpleNamespace(wiggle=wiggle, fit=wiggle)

    learner: Any = SimpleNamespace(fitted=fitted, score=lambda tried: scores[tried.wiggle])
    got: Any = smoothed(learner, learner, learner, np.zeros(1), tuple(scores))
    assert got.wiggle == best
    assert [wiggle for wiggle, _ in seen] == asked
    tried = dict(seen)
    assert tried[0.1] == 1.0
    assert tried.get(5.0, 1.0) == 1.0
    assert tried.get(0.03, 0.1) == 0.1


def test_work_that_is_shared_out_comes_back_in_order_and_is_not_shared_out_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Two threads at one time: each item waits for another one's thread."""
    monkeypatch.setattr(sharing, "threads", lambda: 2)
    both = threading.Barrier(2, timeout=600.0)

    def work(item: int) -> tuple[int, bool, list[bool], int]:
        both.wait()
        return item, shared_out(), list(side_by_side(lambda _: shared_out(), range(3))), threading.get_ident()

    out = list(side_by_side(work, range(6)))
    assert [item for item, *_ in out] == list(range(6))
    assert all(mine and all(inner) for _, mine, inner, _ in out)
    assert len({thread for *_, thread in out}) == 2
    assert not shared_out()
    with pytest.raises(ZeroDivisionError):
        list(side_by_side(lambda k: 1 // k, [1, 0, 1]))


def test_a_set_of_the_model_s_own_parameters_has_no_law() -> None:
    """Learning walks through the model as it is, beside laws that a model file names: none of them at zero size, where
    a gain lets nothing through.
    """
    rng = np.random.default_rng(2)
    t = np.arange(600.0)
    pump = np.repeat(rng.uniform(0.0, 8.0, 12), 50)
    record = Record("log", t, {"pump": pump, "level": 20.0 + 0.5 * rng.standard_normal(600)})
    system = System(
        name="tank", kind="simulate", model=tank, inputs={"pump": "V"}, states={"level": "cm"},
        outputs={"level": "cm"}, parameters=[unknown("inflow", 0.1, "cm/(V s)"), unknown("outflow", 0.05, "1/s")],
    )  # fmt: skip
    bound = BoundSystem(system, [record])
    whole, own = bound.stage.neutral(), len(bound.stage.parameters)
    assert {"pump.gain", "level_sensor.gain"} <= {q.effect for q in bound.placed}
    assert np.array_equal(bound.run(whole[None, :own]), bound.run(whole[None]))


@pytest.mark.slow
def test_states_that_nobody_measures_are_walked_through_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two lags in a row, at rest, under a step: 1 - exp(-t) and 1 - (1 + t) exp(-t)."""
    walked = []
    walk = nominal._hidden
    monkeypatch.setattr(nominal, "_hidden", lambda *of: walked.append(of) or walk(*of))

    def lags(x: Any, u: Any, p: Any) -> Any:
        return u.v - x.first, x.first - x.second

    t = 0.01 * np.arange(1000)
    system = System(
        name="lags", kind="simulate", model=lags, inputs={"v": "V"}, states={"first": "V", "second": "V"},
        outputs={"sum": "V"}, output=lambda x, u, p: x.first + x.second, start={"first": 0.0, "second": 0.0},
        parameters=[unknown("unused", 1.0, "-")],
    )  # fmt: skip
    record = Record("log", t, {"v": np.ones(1000), "sum": 2.0 - (2.0 + t) * np.exp(-t)})
    bound = BoundSystem(system, [record])
    walked.clear()
    states = nominal.nominal_course(bound.runner, np.array([1.0])).states
    np.testing.assert_allclose(states[0][0], 1.0 - np.exp(-t), atol=1e-5)
    np.testing.assert_allclose(states[1][0], 1.0 - (1.0 + t) * np.exp(-t), atol=1e-5)
    assert len(walked) == 1
