"""Laws of the vane chain that move an output by a few per cent of its noise, and what noise alone may not look like."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.test_learn_vanes import chain
from vaneloop.identification.least_squares.problem import Fit, LeastSquaresProblem
from vaneloop.identification.selection.relative_error_acceptance import score
from vaneloop.identification.selection.rules import EXCESS, GAIN, NEAR_NOISE, AllRows, Comparison
from vaneloop.identification.settings import FORMS_ALIKE, FORMS_REFITTED, NATS, PER_PARAMETER, RIVAL, RIVAL_NATS
from vaneloop.identification.subsystem import Array
from vaneloop.identification.unmodelled.closed_form_fits import _nearest
from vaneloop.identification.unmodelled.problem import above_the_noise, grain_of
from vaneloop.identification.vane_chain.candidates import VaneChainCandidates, remade

N = 30_000


def accepted(judge: LeastSquaresProblem, before: Fit, after: Fit, correlation: float) -> bool:
    case = Comparison(judge, before, after, correlation)
    return all(rule.verdict(case).holds for rule in (EXCESS, GAIN))


def unconfirmed(before: dict[str, Array], after: dict[str, Array], tests: frozenset[str]) -> str:
    case = AllRows(before, after, tests)
    assert (case.objection() == "") == all(r.verdict(case).holds for r in NEAR_NOISE if r.applies(case))
    return case.objection()


def nominal(name: str = "linkage"):
    stage = remade(chain()[1].stage(name), (), ())
    judge = LeastSquaresProblem(stage, stage.floor)
    return judge, judge.fit((), stage.neutral())


def test_at_the_noise_rivals_are_as_many_nats_apart_as_laws_with_names() -> None:
    judge, fit = nominal()
    quiet = replace(fit, held_out=fit.held_out * judge.n / fit.held_out.sum())  # leaves nothing but noise
    judge.stage.grain = grain = grain_of(judge, quiet)
    worse = replace(quiet, held_out=quiet.held_out * (1.0 + 2.0 * RIVAL_NATS / judge.n))
    assert 0.0 < grain < 0.05
    assert score(judge, worse) - score(judge, quiet) == pytest.approx(RIVAL, rel=0.01)
    assert score(judge, quiet) == pytest.approx(PER_PARAMETER * len(quiet.free), abs=1e-6)


def test_two_per_cent_of_the_noise_earn_a_curve_its_place_and_chance_does_not() -> None:
    judge, fit = nominal()
    after = replace(fit, held_out=fit.held_out * judge.n / fit.held_out.sum())
    before = replace(after, held_out=after.held_out * 1.02**2)
    assert above_the_noise(judge, before) and not above_the_noise(judge, after)
    assert accepted(judge, before, after, 1.0)
    assert not accepted(judge, before, after, 1e3)  # errors that repeat themselves a thousand times say little
    chance = replace(after, held_out=after.held_out * (1.0 + 2.0 * (NATS - 1.0) / judge.n))
    assert not accepted(judge, chance, after, 1.0)


@pytest.mark.parametrize(("rest", "why"), [(0.98, ""), (1.0, "rest of the log: log-likelihood gain of 0.0 only")])
def test_samples_that_nothing_was_fitted_to_must_say_so_too(rest: float, why: str) -> None:
    before = {"log": np.ones((1, N)), "rest of the log": np.ones((1, N))}
    after = {"log": 0.97 * np.ones((1, N)), "rest of the log": rest * np.ones((1, N))}
    assert unconfirmed(before, after, frozenset(("rest of the log",))) == why


def test_what_is_sure_and_too_little_is_no_law() -> None:
    """Errors of form have many nats on a long log."""
    before, after = {"log": np.ones((1, N))}, {"log": 0.995 * np.ones((1, N))}
    assert "standard deviations" in unconfirmed(before, after, frozenset())


def test_no_curve_is_larger_in_usual_than_what_moves_the_outputs_by_their_error() -> None:
    ground = VaneChainCandidates(chain()[1].stage("actuator"))
    theta = ground.whole.neutral()[: len(ground.whole.parameters)]
    gain = next(c for c in ground.candidates(theta) if c.name == "actuator.flow_gain.gain_of_t_oil")
    judge = LeastSquaresProblem(ground.stage((), ((gain.placed(), gain.effect(1.0)),)), ground.floor)
    moved = np.repeat(judge.stage.neutral()[None], 2, axis=0)
    moved[1, len(theta)] = gain.size
    still, by = judge.errors(moved)
    assert gain.size < 0.1 * 0.3  # what it may be where much is missing
    assert np.sqrt(np.sum((by - still) ** 2) / judge.n) == pytest.approx(1.0, rel=0.2)


def test_a_corner_that_splines_round_is_told_where_they_are_off_everywhere_alike() -> None:
    """Samples are dense about 0, and a curve is well known there, but for its smoothness."""
    ground = VaneChainCandidates(chain()[1].stage("actuator"))
    theta = ground.whole.neutral()[: len(ground.whole.parameters)]
    c = next(c for c in ground.candidates(theta) if c.name == "valve.current.curve_of_i_cmd")
    x = 5.0 * np.linspace(-1.0, 1.0, 257) ** 3
    rounded = -0.05 * np.where(np.abs(x) < 1.0, 0.5 + 0.5 * x**2, np.abs(x)) - 0.018 * x
    variance = (1e-4 + 0.03 * np.abs(x)) ** 2
    told, alike = (
        [form.name for form, _ in _nearest(c, x, rounded, variance, {0, 1}, weight)][:FORMS_REFITTED]
        for weight in (1.0 / np.sqrt(variance + FORMS_ALIKE * np.var(rounded)), np.ones(len(x)))
    )
    assert "magnitude" in alike and "magnitude" not in told
