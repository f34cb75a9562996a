"""What makes learning quick must not change what it says: threads, and the way from one smoothness to the next."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from vaneloop.discrepancy import Record, System, unknown
from vaneloop.discrepancy.models import runner
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
