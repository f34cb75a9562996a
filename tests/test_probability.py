"""Failure probabilities against closed forms: counted, by Sobol's sequence, by subset simulation. No machine runs."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy import stats

pytest.importorskip("psutil", reason="the extra `fleet` is not installed")

from vaneloop.fleet.plan import Plan, draw
from vaneloop.fleet.probability import LEAST, Level, Subset, _chains, _next_level, _variation, interval, subset

Array = np.ndarray
Margin = Callable[[Array], Array]


def one_limit(p: float) -> tuple[Margin, int]:
    """One uniform quantity beyond its limit; two others are idle."""
    return lambda x: (1.0 - p) - x[:, 0], 3


def corner(p: float) -> tuple[Margin, int]:
    """Three uniform quantities in one corner: p = a^3."""
    a = p ** (1.0 / 3.0)
    return lambda x: (1.0 - a) - x.min(axis=1), 3


def sum_of_two(p: float) -> tuple[Margin, int]:
    """The sum of two uniform quantities: a triangle of p = a^2 / 2."""
    a = math.sqrt(2.0 * p)
    return lambda x: 2.0 - a - x.sum(axis=1), 2


def plane(p: float) -> tuple[Margin, int]:
    """A plane at the distance b in the space of ten normal quantities: p = Phi(-b)."""
    b = -float(stats.norm.ppf(p))
    return lambda x: b - stats.norm.ppf(x).sum(axis=1) / math.sqrt(x.shape[1]), 10


def two_sides(p: float) -> tuple[Margin, int]:
    """Failure at either end of a quantity: two regions that no chain leads between."""
    return lambda x: 0.5 - 0.5 * p - np.abs(x[:, 0] - 0.5), 4


def ticks(p: float) -> tuple[Margin, int]:
    """A margin that is seen in steps, as times in ticks of 1 ms are."""
    return lambda x: np.floor(((1.0 - p) - x[:, 0]) * 200.0) / 200.0, 3


CASES = [one_limit, corner, sum_of_two, plane, two_sides, ticks]


@pytest.mark.parametrize("case", CASES)
def test_the_closed_forms_are_those_of_brute_force(case: Callable[[float], tuple[Margin, int]]) -> None:
    g, d = case(1e-4)
    n = 400_000
    failed = sum(int((g(np.random.default_rng(k).random((n // 4, d))) < 0.0).sum()) for k in range(4))
    low, high = interval(failed, n, 0.999)
    assert low < 1e-4 < high and failed > 10


@pytest.mark.parametrize("sampling", ["sobol", "random"])
@pytest.mark.parametrize("p", [1e-4, 1e-6])
@pytest.mark.parametrize("case", [corner, sum_of_two])
def test_counted_samples_cover_a_small_probability(
    case: Callable[[float], tuple[Margin, int]], p: float, sampling: str
) -> None:
    """65,536 machines fail some seven times, or not at all; of twenty intervals of 95 % two may be wrong."""
    g, d = case(p)
    said, n = [], 65_536
    for seed in range(20 if sampling == "random" else 4):
        keys: dict[str, Any] = {"title": "Made", "scenarios": ["s"], "vary": {"a": [0.0, 1.0]}}
        plan = Plan(**keys, samples=n, sampling=sampling, seed=seed)
        failed = int((g(draw(plan, d)[0]) < 0.0).sum())
        low, high = interval(failed, n, 0.95)
        said.append(low <= p <= high)
        assert high < (5e-4 if p == 1e-4 else 1.5e-4) and (failed <= 2 or p == 1e-4)
    assert sum(said) >= len(said) - 2


@pytest.mark.parametrize("p", [1e-4, 1e-6])
@pytest.mark.parametrize("case", CASES)
def test_subset_simulation_covers_a_small_probability(case: Callable[[float], tuple[Margin, int]], p: float) -> None:
    """With a few thousand machines, where counting wants hundreds of thousands."""
    g, d = case(p)
    inside, estimates = 0, []
    for seed in range(12):
        points = np.random.default_rng(seed).random((256, d))
        found = subset(g, points, g(points), seed)
        low, high = found.interval(0.95)
        inside += low <= p <= high
        assert low < high < 1e3 * p or case is ticks
        assert found.runs + 256 < 3000 and found.reached == (found.probability > 0.0)
        estimates.append(found.probability)
    assert inside >= 11
    assert case is ticks or p / 2.5 < float(np.median(estimates)) < 2.5 * p


@pytest.mark.parametrize("confidence", [0.8, 0.95, 0.99])
def test_the_interval_adds_the_variations_of_the_levels(confidence: float) -> None:
    levels = [Level(0.3, 0.1, 0.2), Level(0.1, 0.1, 0.15), Level(0.0, 0.3, 0.1)]
    found = Subset(levels, True, 7)
    spread = math.sqrt(math.log(1.0 + 0.45**2))
    z = float(stats.norm.ppf(0.5 + confidence / 2.0))
    assert found.probability == pytest.approx(0.003)
    assert found.interval(confidence) == pytest.approx((0.003 * math.exp(-z * spread), 0.003 * math.exp(z * spread)))
    assert Subset([Level(0.0, 0.9, 0.5)], True, 0).interval(0.99)[1] == 1.0


def test_where_nothing_fails_the_interval_ends_at_the_last_level_that_was_reached() -> None:
    points = np.random.default_rng(1).random((500, 2))
    g: Margin = lambda x: 1.5 - x[:, 0]  # noqa: E731
    never = subset(g, points, g(points), 1)
    assert not never.reached and never.probability == 0.0
    low, high = never.interval(0.95)
    assert low == 0.0 and LEAST / 100.0 < high < 100.0 * LEAST
    assert [of.margin for of in never.levels] == sorted((of.margin for of in never.levels), reverse=True)
    flat: Margin = lambda x: np.full(len(x), 0.4)  # noqa: E731
    still = subset(flat, points, flat(points), 1)
    assert still == Subset([Level(0.0, 0.0, 0.0)], False, 0) and still.interval(0.95) == (0.0, 1.0)


def test_where_many_fail_they_are_counted() -> None:
    points = np.random.default_rng(1).random((500, 2))
    g: Margin = lambda x: 0.7 - x[:, 0]  # noqa: E731
    found = subset(g, points, g(points), 1)
    p = float((points[:, 0] > 0.7).mean())
    assert found.runs == 0 and found.levels == [Level(0.0, p, pytest.approx(math.sqrt((1.0 - p) / (p * 500))))]
    assert found.reached and found.probability == p


def test_a_level_is_the_tenth_of_the_machines_nearest_to_failing_or_what_lies_below_a_plateau() -> None:
    assert _next_level(np.arange(100.0)) == 9.0 and _next_level(np.arange(100.0)[::-1] / 7.0) == 9.0 / 7.0
    assert _next_level(np.array([0.2, *[0.5] * 30])) == 0.2, "more than nine tenths have the greatest"
    assert _next_level(np.array([0.2, 0.3, *[0.5] * 30])) == 0.3
    assert _next_level(np.array([*[0.2] * 30, 0.5])) == 0.2 and _next_level(np.full(9, 0.5)) is None


def test_moves_keep_to_their_level_and_to_the_distribution_there() -> None:
    """Of a level that all reach, the machines stay standard normal; of another they are those beyond it."""
    rng = np.random.default_rng(3)
    u = rng.standard_normal((200, 2))
    after, margins, step = _chains(lambda x: 0.0 * x[:, 0], u, np.zeros(200), 0.1, 10, 0.6, rng)
    assert after.shape == (2000, 2) and (margins == 0.0).all() and step > 0.9, "all are accepted: moves grow"
    assert np.array_equal(after[::10], u) and stats.kstest(after[9::10].ravel(), "norm").pvalue > 0.01
    beyond = stats.norm.ppf(0.99 + 0.01 * rng.random((200, 1)))
    g: Margin = lambda x: 0.99 - x[:, 0]  # noqa: E731
    after, margins, step = _chains(g, beyond, g(stats.norm.cdf(beyond)), 0.0, 20, 0.6, rng)
    assert (margins <= 1e-12).all() and np.allclose(margins, g(stats.norm.cdf(after)))
    assert stats.kstest((stats.norm.cdf(after[19::20, 0]) - 0.99) / 0.01, "uniform").pvalue > 0.01


def test_chains_that_stand_still_are_worth_one_machine_each() -> None:
    below = np.repeat([True, False, False, False, True], 8)
    assert _variation(below, (5, 8)) == pytest.approx(math.sqrt(0.6 / (0.4 * 5)))
    mixed = np.random.default_rng(1).random(4000) < 0.4
    assert _variation(mixed, (500, 8)) == pytest.approx(math.sqrt((1 - mixed.mean()) / (mixed.mean() * 4000)), rel=0.1)
    assert _variation(np.ones(8, bool), (2, 4)) == 0.0 == _variation(np.zeros(8, bool), (2, 4))


def test_the_same_seed_gives_the_same_levels_and_another_does_not() -> None:
    g, d = corner(1e-4)
    points = np.random.default_rng(1).random((256, d))
    one, same, other = (subset(g, points, g(points), seed) for seed in (1, 1, 2))
    assert one == same and one.levels[1:] != other.levels[1:] and one.levels[0] == other.levels[0]
