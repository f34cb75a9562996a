"""What follows the right quantity all along a log, and an excerpt that tells nothing: which curve is learned."""

from __future__ import annotations

from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hil.logs import Channel, Log
from tests import rig
from tests.firmware_on_rig import firmware
from vaneloop.identification.least_squares.noise import correlation_of
from vaneloop.identification.settings import RIVAL_NATS, SCREENED_BEND
from vaneloop.identification.unmodelled import curve_choice as by_formula
from vaneloop.identification.unmodelled.closed_form_fits import fitted_formulas
from vaneloop.identification.unmodelled.curve_choice import said_first
from vaneloop.identification.unmodelled.fitted_candidate import FittedCandidate
from vaneloop.identification.unmodelled.learning import CurveSearch
from vaneloop.identification.vane_chain.candidates import VaneChainCandidates, remade
from vaneloop.identification.vane_chain.chain import build_chain

SPEED, STROKE = "actuator.load.curve_of_n_r", "actuator.load.curve_of_x_lvdt"


@lru_cache
def learner_of(effect: str, sizes: tuple[tuple[str, float], ...], duration: float, *names: str) -> CurveSearch:
    """A search among a few curves on the stage of an effect of the rig, whose library has nothing."""
    hidden = rig.Hidden(effect, dict(sizes))
    test = rig.manoeuvre(11, duration)
    run = rig.simulate(test, firmware(), [hidden], seed=11, rate=100, randomised=False)
    chain = build_chain(Log("rig", {k: Channel(run.log["t"], v) for k, v in run.log.items() if k != "t"}))
    ground = VaneChainCandidates(remade(chain.stage(rig.EFFECTS[effect].stage), (), ()))
    fit = SimpleNamespace(theta=ground.whole.neutral(), effects=())
    d: Any = SimpleNamespace(base=fit, final=fit, verdict="unknown", effects=[], nearest=[])
    learner = CurveSearch(ground, d)
    learner.candidates = [c for c in learner.candidates if c.name in names]
    return learner


@lru_cache
def with_load(force: float) -> tuple[CurveSearch, FittedCandidate, list[FittedCandidate]]:
    """An air load of ``force`` (N) at full speed: the model as it is, and with curves of the speed and the stroke."""
    learner = learner_of("aero_load", (("force", force),), 60.0, SPEED, STROKE)
    before = FittedCandidate(learner.candidates[0], 0.0, learner.judge, learner.base, ())
    begin = [np.append(learner.base.theta, np.zeros(len(c.parts))) for c in learner.candidates]
    both = zip(learner.candidates, begin, strict=True)
    return learner, before, [learner.fitted(before, c, SCREENED_BEND, theta, 12) for c, theta in both]


@pytest.mark.slow
def test_what_a_formula_says_is_learned_and_not_the_channel_that_follows_it() -> None:
    """The stroke goes with the speed by its schedule. As a curve of it the load does as well, and as no formula."""
    learner, before, tried = with_load(-1500.0)
    left = {t.candidate.name: learner.left(before, t, tried) for t in tried}
    near = learner._near(before, list(tried), left)
    assert [t.candidate.name for t in near] == [STROKE, SPEED]  # the stroke is at its place itself
    (first, second) = said_first(learner, near, left)
    assert (first.candidate.name, second.candidate.name) == (SPEED, STROKE)
    assert fitted_formulas(learner.ground, first)[0][0].form in ("square", "power")


def test_a_slope_that_a_known_noise_tells_is_kept() -> None:
    """Without it the curve leaves 1 % more, which is a hundred nats."""
    learner, before, tried = with_load(-1500.0)
    speed = next(t for t in tried if t.candidate.name == SPEED)
    settled = learner._settled(before, speed)
    fall = float(settled.fit.held_out.sum() - speed.fit.held_out.sum())
    assert 0.5 * fall < 3.0 * RIVAL_NATS * correlation_of(speed.judge, speed.fit)
    assert learner.judge.stage.grain == learner.ground.whole.grain == settled.judge.stage.grain == 1.0


def test_what_formulas_of_two_channels_say_as_well_is_of_the_plainer(monkeypatch: pytest.MonkeyPatch) -> None:
    learner, _, tried = with_load(-1500.0)
    stroke, speed = (next(t for t in tried if t.candidate.name == name) for name in (STROKE, SPEED))
    best = min(tried, key=lambda t: float(learner.judged(t, tried)[1].held_out.sum()))
    monkeypatch.setattr(by_formula, "with_and_without_mean", lambda *_: [best])  # whatever curve it stands for
    for near in ([stroke, speed], [speed, stroke]):
        assert said_first(learner, near, {STROKE: 0.0, SPEED: 0.0}) == near


@pytest.mark.slow
@pytest.mark.parametrize("names", [("linkage.ring.curve_of_n_r", "linkage.ring.curve_of_x_lvdt")])
def test_candidates_are_ranked_on_all_samples(names: tuple[str, ...]) -> None:
    """In half a minute the links' lengths make up for anything."""
    learner = learner_of("linkage_compliance", (("compliance", 6e-4),), 90.0, *names)
    assert len(learner.ground.stage((), (), True).t) < len(learner.judge.stage.t)
    learner.finalists(FittedCandidate(learner.candidates[0], 0.0, learner.judge, learner.base, ()))
    assert {len(t.judge.stage.t) for t in learner.ranked[0]} == {len(learner.judge.stage.t)}
    assert learner.ranked[0][0].candidate.name == names[0]
