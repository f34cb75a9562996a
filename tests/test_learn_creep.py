"""The time of a lag is found, whether its law is a straight line or needs many splines."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.conftest import quick_first
from vaneloop import Record, System, unknown
from vaneloop.identification.settings import BENDS_TRIED, FINE_SPLINES, LAG_TIMES
from vaneloop.identification.unmodelled.curve_candidates import Candidate, UserModelCandidates
from vaneloop.identification.unmodelled.fitted_candidate import FittedCandidate
from vaneloop.identification.unmodelled.learning import CurveSearch
from vaneloop.identification.unmodelled.screening import smoothed
from vaneloop.identification.user_models.by_log import bind
from vaneloop.identification.user_models.exogenous_regressors import lagged, named_lag

SLIDE = System(
    "slide", "static", lambda u, p: p.gain * u.drive, inputs={"drive": "V"}, outputs={"place": "mm"},
    parameters=[unknown("gain", 1.5, "mm/V")],
)  # fmt: skip
Law = Callable[[np.ndarray], np.ndarray]


def learner_of(law: Law, tau: float, seed: int, gain: float = 2.0) -> CurveSearch:
    """A search on logs of a slide that adds a ``law`` of its drive behind a lag of ``tau`` (s)."""
    rng = np.random.default_rng(seed)
    records = []
    for k in range(2):
        t = np.arange(0.0, 120.0, 0.05)
        drive = np.interp(t, np.arange(0.0, 121.0, 5.0), rng.uniform(-5.0, 5.0, 25)) + np.sin(t / (2.0 + k))
        place = gain * drive + law(lagged(t, drive, tau)) + 0.01 * rng.standard_normal(len(t))
        records.append(Record(f"log {k}", t, {"drive": drive, "place": place}))
    ground = UserModelCandidates(bind(SLIDE, records, []))
    fit = SimpleNamespace(theta=ground.whole.neutral(), effects=())
    d: Any = SimpleNamespace(base=fit, final=fit, verdict="unknown", effects=[], nearest=[])
    return CurveSearch(ground, d)


def late(learner: CurveSearch) -> tuple[FittedCandidate, Candidate]:
    """The model as it is, and what its place has of the drive behind the longest lag that is tried first."""
    known = [c for c in learner.candidates if c.how == "output adds" and c.quantity.name.startswith("drive_lagged_by")]
    last = max(known, key=tau_of)
    return FittedCandidate(last, 0.0, learner.judge, learner.base, ()), last


def tau_of(c: Candidate) -> float:
    lag = named_lag(c.quantity.name)
    assert lag is not None
    return lag[1]


@pytest.mark.parametrize(
    ("share", "tau"), quick_first([(0.06, 10.0), (-0.1, 4.0), (0.3, 5.0), (0.02, 14.0), (0.01, 3.0)], 2)
)
def test_the_time_of_a_creep_is_found(share: float, tau: float) -> None:
    """A share of the way comes late; the gain is fitted beside it."""
    learner = learner_of(lambda q: share * q, tau, seed=int(10 * tau), gain=2.0 - share)
    current, c = late(learner)
    begun = smoothed(learner, current, c, np.append(learner.base.theta, np.zeros(len(c.parts))), BENDS_TRIED)
    best = learner._with_its_lag(current, begun, LAG_TIMES)
    assert tau_of(best.candidate) == pytest.approx(tau, rel=0.1)


@pytest.mark.parametrize(("tau", "begun"), [(3.0, 1.4), (6.0, 0.7)])
def test_a_curve_of_many_splines_finds_its_lag_too(tau: float, begun: float) -> None:
    """A wavy law needs many splines; it was begun with a lag so many times as long, and keeps them."""
    learner = learner_of(lambda q: 0.8 * q + 0.2 * np.sin(5.0 * q), tau, seed=3)
    current, c = late(learner)
    c = c.slower(begun * tau / tau_of(c))
    assert c is not None
    coarse = learner.fitted(current, c, 1.0, np.append(learner.base.theta, np.zeros(len(c.parts))), 12)
    fine = learner._finer(current, coarse)
    assert fine is not None and len(fine.candidate.basis.bend) > len(c.basis.bend)
    best = learner._with_its_lag(current, fine, LAG_TIMES[1:])
    assert tau_of(best.candidate) == pytest.approx(tau, rel=0.1)
    assert best.candidate.splines == FINE_SPLINES and len(best.candidate.parts) == len(fine.candidate.parts)


def test_a_curve_is_carried_from_end_to_end_whatever_its_splines() -> None:
    learner = learner_of(lambda q: 0.2 * np.tanh(q), 4.0, seed=5)
    _, c = late(learner)
    amplitudes = np.random.default_rng(0).standard_normal(len(c.parts)) / np.sqrt(1.0 + c.basis.bend)
    curve = c.basis.design(c.grid) @ (c.turn @ amplitudes)
    assert c.as_of(c, amplitudes) == pytest.approx(amplitudes, abs=1e-6)
    fine = c.finer(FINE_SPLINES)
    assert fine is not None and c.finer(len(c.basis.bend)) is None
    longer = fine.slower(1.3)
    assert longer is not None and longer.splines == FINE_SPLINES
    for one in (fine, longer):
        own = one.basis.design(one.grid) @ (one.turn @ one.as_of(c, amplitudes))
        assert own == pytest.approx(curve, abs=0.05 * np.ptp(curve))
