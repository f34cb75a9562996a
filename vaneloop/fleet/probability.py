"""Failure probability of a machine: from independent ones, or, where it is small, by subset simulation.

A machine fails where its margin g(x) is below 0; x is uniform in the unit cube, so u = Phi^-1(x) is standard normal.
With levels b_1 > b_2 > ... > b_m = 0, of which each leaves about the share `SHARE` of the machines of the one before,

    P(g < 0) = P(g <= b_1) P(g <= b_2 | g <= b_1) ... P(g < 0 | g <= b_(m-1))

The first factor is the share among independent machines. For each other one, Markov chains start from the machines at
or below the last level, and keep to those there: u' = r u + sqrt(1 - r^2) v with v standard normal, refused where
g(u') is above the level. r is led to an acceptance of `ACCEPTED`.

    squared coefficient of variation of a factor p from n machines: (1 - p) / (p n) (1 + gamma)

where gamma comes from the autocorrelation within the chains. Chains of one level begin with machines of the one before,
so factors are correlated, nobody knows how much. The coefficients of variation are added, as for factors wholly
correlated: an upper bound. The estimate is taken as lognormal. Failures that the chains never come near are not seen.

S. K. Au, J. L. Beck, Probabilistic Engineering Mechanics 16 (2001) 263-277: levels, gamma, bounds of the variation.
I. Papaioannou, W. Betz, K. Zwirglmaier, D. Straub, same journal 41 (2015) 89-103: the move, and how r is led.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy

__all__ = ["LEAST", "SHARE", "Level", "Subset", "interval", "subset"]

SHARE = 0.1  # of the machines of a level that are below the next one
ACCEPTED = 0.44  # of the moves; Papaioannou et al.
LEAST = 1e-9  # probability at which the levels end, failure or not


def interval(failed: int, n: int, confidence: float) -> tuple[float, float]:
    """Clopper-Pearson's interval of a failure probability from ``failed`` of ``n`` independent machines."""
    found = scipy.stats.binomtest(failed, n).proportion_ci(confidence, method="exact")
    return float(found.low), float(found.high)


@dataclass(frozen=True)
class Level:
    """A level: its margin, the share of the machines before it that reach it, and that share's coefficient of
    variation (0: none of them reach it, or all).
    """

    margin: float
    share: float
    variation: float


@dataclass(frozen=True)
class Subset:
    """What a subset simulation came to: its levels, whether the last one is failure and was reached, and how many
    machines it ran besides the independent ones.
    """

    levels: Sequence[Level]
    reached: bool
    runs: int

    @property
    def probability(self) -> float:
        """Estimate of the failure probability; 0: no machine failed."""
        return math.prod(level.share for level in self.levels) if self.reached else 0.0

    def interval(self, confidence: float) -> tuple[float, float]:
        """Interval of the failure probability. Where no machine failed it ends at the upper end of the probability of
        the last level that some reached, for a failed machine is beyond that.
        """
        seen = [level for level in self.levels if level.share > 0.0]
        variation = sum(level.variation for level in seen)
        z = float(scipy.stats.norm.ppf(0.5 + confidence / 2.0))
        factor = math.exp(z * math.sqrt(math.log1p(variation**2)))
        middle = math.prod(level.share for level in seen)
        return (middle / factor if self.reached else 0.0), min(middle * factor, 1.0)


def subset(g: Callable[[np.ndarray], np.ndarray], points: np.ndarray, margins: np.ndarray, seed: int) -> Subset:
    """Simulate level after level.

    g        margins of machines at points of the unit cube, float64[n, quantities] -> float64[n]
    points, margins   independent machines, drawn uniformly
    """
    rng = np.random.default_rng([seed, 1])  # not the stream that the first machines came from
    u, y = scipy.stats.norm.ppf(np.clip(points, 1e-16, 1.0 - 1e-16)), np.asarray(margins, float)
    chains, step, runs, levels = (len(u), 1), 0.6, 0, list[Level]()
    while True:
        failed, level = y < 0.0, _next_level(y)
        last = level is None or level < 0.0
        below = failed if level is None or level < 0.0 else y <= level
        levels.append(Level(0.0 if level is None else max(level, 0.0), float(below.mean()), _variation(below, chains)))
        if last or math.prod(of.share for of in levels) < LEAST:
            return Subset(levels, last and bool(failed.any()), runs)
        assert level is not None
        before = int(below.sum())
        u, y, step = _chains(g, u[below], y[below], level, -(-len(points) // before), step, rng)
        chains = (before, len(y) // before)
        runs += len(y) - before


def _next_level(y: np.ndarray) -> float | None:
    """The margin that the share `SHARE` of the machines does not exceed; where too many have the greatest one, the next
    below it. None: all have the same.
    """
    ordered = np.sort(y)
    level = ordered[max(int(SHARE * len(y)), 1) - 1]
    if level < ordered[-1]:
        return float(level)
    below = ordered[ordered < ordered[-1]]
    return float(below[-1]) if len(below) else None


def _chains(
    g: Callable[[np.ndarray], np.ndarray],
    u: np.ndarray,
    y: np.ndarray,
    level: float,
    steps: int,
    step: float,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray, float]:
    """Machines at or below a level, in chains of so many ``steps`` from those there, chain by chain; and the size of
    the moves, sqrt(1 - r^2), that had the right acceptance.
    """
    states, margins = [u], [y]
    for t in range(steps - 1):
        moved = math.sqrt(1.0 - step**2) * u + step * rng.standard_normal(u.shape)
        at = g(scipy.stats.norm.cdf(moved))
        good = at <= level
        u, y = np.where(good[:, None], moved, u), np.where(good, at, y)
        states.append(u)
        margins.append(y)
        step = min(1.0, step * math.exp((float(good.mean()) - ACCEPTED) / math.sqrt(t + 1.0)))
    return np.stack(states, axis=1).reshape(-1, u.shape[1]), np.stack(margins, axis=1).reshape(-1), step


def _variation(below: np.ndarray, chains: tuple[int, int]) -> float:
    """Coefficient of variation of the share of machines ``below``, which stand chain by chain."""
    p, n, length = float(below.mean()), len(below), chains[1]
    if p in (0.0, 1.0):
        return 0.0
    x, gamma = below.reshape(chains) - p, 0.0
    for lag in range(1, length):
        gamma += 2.0 * (1.0 - lag / length) * float((x[:, :-lag] * x[:, lag:]).mean()) / (p * (1.0 - p))
    return math.sqrt((1.0 - p) / (p * n) * (1.0 + max(gamma, 0.0)))
