"""Which candidates are fitted at all: none is left out because its place is crooked, its piece of the log stands, or a
reading brought its own noise.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.test_learn_vanes import rig_chain
from vaneloop import Record, System, unknown
from vaneloop.identification.least_squares.problem import LeastSquaresProblem
from vaneloop.identification.selection.subsampled_search import excerpt_of
from vaneloop.identification.settings import CURVES_QUICK, LAG_TIMES, LITTLE_TOLD
from vaneloop.identification.unmodelled.curve_candidates import Candidate, UserModelCandidates
from vaneloop.identification.unmodelled.curve_choice import leaves
from vaneloop.identification.unmodelled.fitted_candidate import CandidateSource, FittedCandidate
from vaneloop.identification.unmodelled.learning import CurveSearch
from vaneloop.identification.unmodelled.screening import screened
from vaneloop.identification.user_models.by_log import bind
from vaneloop.identification.vane_chain.candidates import VaneChainCandidates

pytestmark = pytest.mark.filterwarnings("ignore")


def tank(x: Any, u: Any, p: Any) -> Any:  # dx/dt
    return p.inflow * u.pump - p.outflow * x.level


TANK = System(
    name="tank", kind="simulate", model=tank, inputs={"pump": "V", "oil": "degC"}, states={"level": "cm"},
    outputs={"level": "cm"},
    parameters=[unknown("inflow", 0.1, "cm/(V s)", low=0.0), unknown("outflow", 0.05, "1/s", low=0.0)],
)  # fmt: skip


def learner_on(ground: CandidateSource) -> CurveSearch:
    """A search where no law of the library was found."""
    fit = SimpleNamespace(theta=ground.whole.neutral(), effects=())
    d: Any = SimpleNamespace(base=fit, final=fit, verdict="unknown", effects=[], nearest=[])
    return CurveSearch(ground, d)


def learner_of(outflow: tuple[float, float], seed: int) -> CurveSearch:
    """A search on a log of a tank whose outflow goes from one value to another as its oil warms."""
    rng = np.random.default_rng(seed)
    t = 0.1 * np.arange(3000)
    pump = np.repeat(rng.uniform(0.0, 8.0, 60), 50)
    oil = 40.0 + 25.0 * np.sin(2.0 * np.pi * t / 220.0 + rng.uniform(0.0, 6.0))
    cold, warm = outflow
    out = cold + (warm - cold) / (1.0 + np.exp(-(oil - 35.0) / 6.0))
    y, level = np.empty(len(t)), 5.0
    for k in range(len(t)):
        y[k] = level
        for _ in range(10):
            level += 0.01 * (0.2 * pump[k] - out[k] * level)
    record = Record("log", t, {"pump": pump, "oil": oil, "level": y + 0.05 * rng.standard_normal(len(t))})
    return learner_on(UserModelCandidates(bind(TANK, [record], [])))


@pytest.mark.slow
@pytest.mark.parametrize(("outflow", "seed"), [((0.1, 0.35), 3), ((0.06, 0.4), 5)])
def test_what_goes_with_one_over_a_parameter_is_among_what_is_fitted(outflow: tuple[float, float], seed: int) -> None:
    """Four times the outflow is a quarter of the level: no step by slopes shows it, and sums of the oil seemed more."""
    learner = learner_of(outflow, seed)
    current = FittedCandidate(learner.candidates[0], 0.0, learner.judge, learner.base, ())
    bare, promising = screened(learner, current, CURVES_QUICK, LAG_TIMES[0])
    names, left = [c.name for _, c, _ in promising], [cost for cost, *_ in promising]
    assert left == sorted(left) and left[0] < 0.05 * bare
    assert len(set(names)) == len(names) >= CURVES_QUICK
    assert {(c.how, c.at) for _, c, _ in promising} == {(c.how, c.at) for c in learner.candidates}
    assert "outflow.gain_of_oil" in names
    best = learner.finalists(current)[0]
    assert best.candidate.name == "outflow.gain_of_oil" and leaves(best) < 1.1


def standing_chain(moves: slice) -> Any:
    """A log of 240 s whose demand moves in one part alone."""
    t = np.arange(24_000) * 0.01
    n_dem = np.full(24_000, 75.0)
    n_dem[moves] += 20.0 * np.sin(t[moves] / 1.7)
    return rig_chain([], n_dem, 240.0)


@pytest.mark.slow
def test_pieces_that_stand_are_not_searched() -> None:
    """Where the stroke stands nobody knows where in their play the rings are: such a piece counts for nothing."""
    stage = standing_chain(slice(14_000, 20_000)).stage("linkage")
    assert stage.counted is not None and stage.floor is not None
    judge = LeastSquaresProblem(stage, stage.floor)
    at = excerpt_of(judge, judge.fit((), stage.neutral(), 1), 1_000, 4_000)
    part = stage.excerpt(at)
    assert len(at) == 4_000 and at.min() >= 13_000
    assert np.isfinite(part.measured[0]).sum() > 0.5 * len(at)
    counts = [int(stage.counted(np.arange(k, k + 1_000)).sum()) for k in range(0, 23_000, 1_000)]
    chosen = sorted({int(k) // 1_000 for k in at})
    assert all(counts[k] >= LITTLE_TOLD * max(counts) for k in chosen)


@pytest.mark.slow
def test_where_few_pieces_count_the_excerpt_is_no_shorter() -> None:
    stage = standing_chain(slice(14_000, 15_500)).stage("linkage")
    assert stage.floor is not None
    judge = LeastSquaresProblem(stage, stage.floor)
    fit = judge.fit((), stage.neutral(), 1)
    for counted in (stage.counted, lambda rows: np.zeros(len(rows), dtype=bool), None):
        stage.counted = counted
        at = excerpt_of(judge, fit, 1_000, 8_000)
        assert len(at) == 8_000 and len(set(at.tolist())) == 8_000


@pytest.mark.slow
def test_a_measured_angle_puts_no_other_quantity_behind() -> None:
    """What a stage gives, as it was measured, has the noise of its error in it: a curve takes a little of that off."""
    learner = learner_on(VaneChainCandidates(standing_chain(slice(0, 24_000)).stage("linkage")))
    wanted = ("sensors.lvdt.curve_of_vgv1", "sensors.lvdt.curve_of_x_lvdt", "sensors.vgv1.curve_of_vgv1")
    echo, plain, own = (next(c for c in learner.candidates if c.name == name) for name in wanted)
    assert [learner._echoes(c) for c in (echo, plain, own)] == [True, False, False]

    def judged(c: Candidate, off: float) -> Any:
        """A fit that leaves about as much in every block, ``off`` more."""
        some = np.random.default_rng(1).uniform(0.9, 1.1, learner.judge.n_blocks)
        held = float(learner.judge.n) / learner.judge.n_blocks * (1.0 + off * some)
        fit = SimpleNamespace(held_out=held, cost=held, theta=learner.base.theta, effects=())
        return FittedCandidate(c, 0.0, learner.judge, fit, ())  # type: ignore[arg-type]

    for first, behind in ((echo, False), (own, True)):
        good = [judged(first, -1e-3), judged(plain, 0.0)]
        left = {good[0].candidate.name: -1.0, good[1].candidate.name: -0.99}
        learner.fails = lambda tried: False  # type: ignore[method-assign]
        learner.judged = lambda tried, among: (learner.judge, tried.fit)  # type: ignore[method-assign, assignment]
        learner._tell_apart(good, left)
        assert (left[plain.name] > -0.95) == behind
