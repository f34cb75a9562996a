"""A search with another one ahead on an excerpt names what the search on the whole log alone names."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from tests.test_identification import (
    FLOOR,
    GAUGE_FLOOR,
    TRUTH,
    U,
    V,
    W,
    gauges,
    holds,
    integrator,
    linear,
    names,
    search,
)
from vaneloop.identification.least_squares.problem import LeastSquaresProblem
from vaneloop.identification.results import StageDiagnosis
from vaneloop.identification.selection.likelihood_acceptance import LikelihoodAcceptance
from vaneloop.identification.selection.screening import _best_within
from vaneloop.identification.selection.search import Search
from vaneloop.identification.selection.subsampled_search import SubsampledSearch, searched
from vaneloop.identification.subsystem import Stage

AHEAD = 3_000  # samples of the excerpt


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vaneloop.identification.selection.subsampled_search.AHEAD_SAMPLES", AHEAD)
    monkeypatch.setattr("vaneloop.identification.selection.subsampled_search.SHORT_PIECE", 300)


def with_excerpts(stage: Stage, sets: dict[int, int] | None = None) -> Stage:
    """The stage, of which excerpts can be taken; ``sets`` notes how many parameter sets were simulated on how many
    samples.
    """
    noted = {} if sets is None else sets

    def on(at: np.ndarray | slice, samples: int) -> Stage:
        def run(thetas: np.ndarray) -> np.ndarray:
            noted[samples] = noted.get(samples, 0) + len(thetas)
            return stage.run(thetas)[..., at]

        return replace(stage, run=run, t=stage.t[at], measured=stage.measured[:, at], excerpt=None)

    return replace(on(slice(None), len(stage.t)), excerpt=lambda at: on(at, len(at)))


def both(stage: Stage) -> tuple[StageDiagnosis, StageDiagnosis, dict[int, int]]:
    """What the search on the whole log alone says, what the one with another ahead says, and what that simulated."""
    sets: dict[int, int] = {}
    return search(stage), search(with_excerpts(stage, sets)), sets


@pytest.mark.parametrize("name", TRUTH)
def test_each_effect_is_named_with_the_same_size(name: str) -> None:
    plain, ahead, sets = both(integrator(3, **{name: TRUTH[name][0]}))
    (was,), (now,) = plain.effects, ahead.effects
    assert (was.effect, was.rivals) == (now.effect, now.rivals) == (name, [])
    parameter = next(iter(was.parameters))
    assert holds(now, parameter, TRUTH[name][0])
    assert now.parameters[parameter]["value"] == pytest.approx(was.parameters[parameter]["value"], rel=2e-3)
    np.testing.assert_allclose(ahead.error_after, plain.error_after, rtol=1e-4)
    assert min(sets) <= AHEAD


@pytest.mark.parametrize("pair", [("null_bias", "dead_band"), ("gain_asymmetry", "saturation")])
def test_two_effects_are_named(pair: tuple[str, str]) -> None:
    plain, ahead, _ = both(integrator(5, **{name: TRUTH[name][0] for name in pair}))
    assert names(plain) == names(ahead) == set(pair)
    np.testing.assert_allclose(ahead.error_after, plain.error_after, rtol=1e-4)


def test_a_small_effect_is_named() -> None:
    terms = [linear("slope", (1, 1, 1), V), linear("tilt", (1, 0, -1), W)]
    plain, ahead, _ = both(gauges(terms, [0.0, 0.0027]))
    assert names(plain) == names(ahead) == {"tilt"}


def test_an_effect_that_acts_where_the_excerpt_is_not_is_named() -> None:
    rare = np.where((np.arange(len(W)) % 1_000) < 60, W, 0.0)
    terms = [linear("slope", (1, 1, 1), V), linear("rare", (1, 1, 0), rare)]
    plain, ahead, _ = both(gauges(terms, [0.3, 0.2]))
    assert names(plain) == names(ahead) == {"slope", "rare"}


def test_rivals_are_the_same() -> None:
    terms = [linear("one", (1, 1, 1), V), linear("same", (1, 1, 1), V + 1e-4 * U), linear("other", (1, 0, -1), W)]
    plain, ahead, _ = both(gauges(terms, [0.3, 0.0, 0.2]))
    for d in (plain, ahead):
        assert {frozenset((f.effect, *f.rivals)) for f in d.effects} == {
            frozenset(("one", "same")),
            frozenset(("other",)),
        }


@pytest.mark.parametrize("seed", range(3))
def test_clean_data_lack_nothing(seed: int) -> None:
    terms = [linear("slope", (1, 1, 1), V), linear("tilt", (1, 0, -1), W)]
    assert search(with_excerpts(gauges(terms, [0.0, 0.0], seed))).verdict == "none"
    assert search(with_excerpts(integrator(seed))).verdict == "none"


def test_what_acts_linearly_leaves_what_was_promised() -> None:
    terms = [linear("slope", (1, 1, 1), V), linear("tilt", (1, 0, -1), W)]
    stage = with_excerpts(gauges(terms, [0.31, 0.17], bias=0.05))
    judge = LeastSquaresProblem(stage, GAUGE_FLOOR)
    found = searched(LikelihoodAcceptance(judge), LikelihoodAcceptance, None)
    assert isinstance(found, SubsampledSearch)
    for name, level in found.level.items():
        alone = judge.fit((name,), found.starts[name][0], 8)
        assert level == pytest.approx(float(alone.cost.sum()), rel=1e-6)
        np.testing.assert_allclose(found.starts[name][0], alone.theta, atol=1e-6)


def test_a_short_log_is_searched_whole() -> None:
    stage = with_excerpts(integrator(1, null_bias=0.4))
    short = stage.excerpt(np.arange(2 * AHEAD - 100)) if stage.excerpt else stage
    assert type(searched(LikelihoodAcceptance(LeastSquaresProblem(short, FLOOR)), LikelihoodAcceptance, None)) is Search


@pytest.mark.parametrize("seed", range(20))
def test_the_best_step_within_bounds_is_that_of_scipy(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 12))
    j, y = rng.normal(size=(30, n)) @ rng.normal(size=(n, n)), 5.0 * rng.normal(size=30)
    low, high = -rng.uniform(0.0, 1.0, n) * (rng.random(n) > 0.3), rng.uniform(0.1, 1.0, n)
    step = _best_within(j.T @ j, j.T @ y, low, high)
    assert np.all((step >= low) & (step <= high))
    best = lsq_linear(j, y, (low, high), method="bvls", tol=1e-12)
    assert float(np.sum((j @ step - y) ** 2)) == pytest.approx(2.0 * best.cost, rel=1e-9)
