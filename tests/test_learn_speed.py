"""What makes learning quick must not change what it says: threads, and the way from one smoothness to the next."""

from __future__ import annotations

import threading
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from vaneloop.base import side_by_side as sharing
from vaneloop.base.side_by_side import shared_out, side_by_side
from vaneloop.discrepancy import Record, System, unknown
from vaneloop.discrepancy.models import nominal, runner
from vaneloop.discrepancy.models.smoothness import smoothed

pytestmark = pytest.mark.filterwarnings("ignore")


def tank(x: Any, u: Any, p: Any) -> Any:  # dx/dt
    return p.inflow * u.pump - p.outflow * x.level


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
    stage = system.bind([record]).stage
    sets = np.repeat(stage.neutral()[None], 8, axis=0)
    sets[:, 0] *= np.linspace(0.5, 1.5, 8)
    for k, effect in enumerate(stage.effects[:6]):
        sets[k, stage.index()[effect.name]] = effect.starts[-1]
    monkeypatch.setattr(runner, "threads", lambda: 1)
    alone = stage.run(sets)
    monkeypatch.setattr(runner, "threads", lambda: 2)
    monkeypatch.setattr(runner, "SHORT", 0)
    assert np.array_equal(stage.run(sets), alone)
    assert not np.array_equal(alone[0], alone[1])


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

    learner: Any = SimpleNamespace(_fitted=fitted, _score=lambda tried: scores[tried.wiggle])
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
    bound = system.bind([record])
    walked.clear()
    states = nominal.nominal_course(bound.runner, np.array([1.0])).states
    np.testing.assert_allclose(states[0][0], 1.0 - np.exp(-t), atol=1e-5)
    np.testing.assert_allclose(states[1][0], 1.0 - (1.0 + t) * np.exp(-t), atol=1e-5)
    assert len(walked) == 1
