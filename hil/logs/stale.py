"""Rows that a logger wrote again because nothing new had come: every channel repeats the row before, to the last bit.

A channel with noise in its last digit turns back in every second row. By chance it repeats itself now and then, more
often where the machine rests: the rows around tell how often. The noise of two channels is independent, so that the
chance that all repeat is the product of theirs. Without noise a machine at rest looks the same, and nothing is stale.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

__all__ = ["stale_rows"]

CHANCE = 1e-6  # that any row of the log is taken for stale where all were sampled
AROUND = 250  # rows on either side that tell how often a channel repeats itself
NOISY = 0.3  # share of changes that go back on the one before; white noise: two thirds
MOST = 0.5  # share of rows; where more repeat, the channels are slower than the rows


def stale_rows(columns: Sequence[np.ndarray]) -> np.ndarray:
    """Which rows of the ``columns`` of one table, each float64[rows], are stale: bool[rows]."""
    rows = len(columns[0]) if columns else 0
    out = np.zeros(rows, dtype=bool)
    if rows < 10:
        return out
    same = np.ones(rows - 1, dtype=bool)
    for v in columns:  # two channels with noise leave nothing to look at
        same &= v[1:] == v[:-1]
        if not same.any():
            return out
    edges = np.flatnonzero(np.diff(np.concatenate([[0], same.astype(np.int8), [0]])))
    first, behind = edges[::2] + 1, edges[1::2] + 1
    out[1:] = same
    low, high = np.maximum(first - AROUND, 0), np.minimum(behind + AROUND, rows)

    def around(those: np.ndarray) -> np.ndarray:
        total = np.concatenate([[0], np.cumsum(those)])
        return np.asarray(total[high] - total[low])

    fresh, chance = around(~out) + 1.0, np.zeros(len(first))  # chance: its logarithm
    noisy = [v for v in columns if _turns(v[~out]) >= NOISY]
    for v in noisy:
        chance += np.log((around(np.append(False, v[1:] == v[:-1]) & ~out) + 1.0) / fresh)
    by_chance = chance * (behind - first) + np.log(rows) > np.log(CHANCE)
    for begin, end in zip(first[by_chance], behind[by_chance], strict=True):
        out[begin:end] = False
    return out if noisy and out.mean() <= MOST else np.zeros(rows, dtype=bool)


def _turns(v: np.ndarray) -> float:
    """Share of a channel's changes that go back on the one before."""
    up = np.sign(np.diff(v))
    up = up[up != 0.0]
    return float(np.mean(up[1:] != up[:-1])) if len(up) > 10 else 0.0
