"""Rows that a logger wrote again because nothing new had come: every channel repeats the row before, to the last bit.

A channel with noise in its last digit turns back in every second row, repeats itself by chance now and then, and seldom
often on end. The noisy channel that does so least tells how many repeated rows on end are beyond chance. Without noise
a machine at rest looks the same, and nothing is stale.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

__all__ = ["stale_rows"]

CHANCE = 1e-6  # that any row of the log is taken for stale where all were sampled
FEWEST = 2  # repeated rows on end; a single one may be a clock that ticked twice
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
    first, length = edges[::2] + 1, edges[1::2] - edges[::2]
    long = length >= FEWEST
    if not long.any():
        return out
    first, length = first[long], length[long]
    for begin, many in zip(first, length, strict=True):
        out[begin : begin + many] = True
    others = [(v[1:] == v[:-1])[~out[1:]] for v in columns if _turns(v[~out]) >= NOISY]
    if not others:
        return np.zeros(rows, dtype=bool)
    chance = float((min(o.sum() for o in others) + 1) / (len(others[0]) + 1))
    for begin, many in zip(first, length, strict=True):
        if chance**many * rows > CHANCE:
            out[begin : begin + many] = False
    return out if out.mean() <= MOST else np.zeros(rows, dtype=bool)


def _turns(v: np.ndarray) -> float:
    """Share of a channel's changes that go back on the one before."""
    up = np.sign(np.diff(v))
    up = up[up != 0.0]
    return float(np.mean(up[1:] != up[:-1])) if len(up) > 10 else 0.0
