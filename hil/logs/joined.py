"""Samples that nobody took: a slower signal that an exporter put on a faster raster, joined by straight lines.

Between two true samples all second differences vanish, but for the last digit; at true samples they do not where the
signal moves or is noisy. So they stand in every k-th row only, as in no signal that was sampled in each row.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

__all__ = ["Joined", "joined", "seems_joined"]

SLOWEST = 20  # rows from one true sample to the next; corners farther apart may be a program of commands
FEWEST = 20  # corners that tell by themselves
CHANCE = 1e-8  # at which corners of a signal that was sampled in each row would stand so
STRAY = 0.01  # share of corners that may stand in other rows
TELLING = 0.25  # share of true samples with a corner, from which on the channel tells by itself
UNIFORM = 0.05  # of the step, by which times may be off
DECIMALS = 9
LOOKED_AT = 1500  # rows of a part of a long channel


class Joined(NamedTuple):
    """Every ``every``-th row is a true sample, the first in row ``first``; ``sure`` where nearly each of them shows."""

    every: int
    first: int
    sure: bool


def joined(t: np.ndarray, values: np.ndarray) -> Joined | None:
    """The true samples of a channel whose others are straight lines between them; None where all may be true.

    A command whose corners stand at round times looks the same, so a channel that seldom bends is not ``sure``.

    t  s, increasing; only a channel with a step of its own is looked at
    """
    if t.size < 3 * FEWEST:
        return None
    step = float(np.median(np.diff(t)))
    row = np.rint((t - t[0]) / step).astype(np.int64)
    if np.mean(np.abs(t - t[0] - row * step) > UNIFORM * step) > STRAY:
        return None
    even = (row[2:] - row[:-2] == 2) & (row[1:-1] - row[:-2] == 1)
    bend = np.abs(values[2:] - 2.0 * values[1:-1] + values[:-2])
    digit = _last_digit(values)
    corners = row[1:-1][even & (bend > 2.01 * np.maximum(np.maximum(digit[2:], digit[1:-1]), digit[:-2]))]
    if corners.size > 0.75 * np.count_nonzero(even):
        return None
    for every in range(SLOWEST, 1, -1):
        if every ** -float(corners.size) > CHANCE:
            continue
        share = np.bincount(corners % every, minlength=every) / corners.size
        first = int(np.argmax(share))
        if share[first] >= 1.0 - STRAY:
            sure = corners.size >= FEWEST and corners.size * every >= TELLING * row[-1]
            return Joined(every, first, sure)
    return None


def seems_joined(t: np.ndarray, values: np.ndarray) -> bool:
    """Whether the channel is surely joined at its start, in its middle or at its end: a long one is looked at there."""
    parts = (slice(k, k + LOOKED_AT) for k in sorted({0, max(t.size - LOOKED_AT, 0) // 2, max(t.size - LOOKED_AT, 0)}))
    return any((j := joined(t[part], values[part])) is not None and j.sure for part in parts)


def _last_digit(values: np.ndarray) -> np.ndarray:
    """For each value the decimal step of which it and those of its size are multiples, as text has them; 1e-9 of the
    largest where there is none.
    """
    size = np.floor(np.log10(np.maximum(np.abs(values), 1e-12))).astype(np.int64)
    out = np.full(values.size, 1e-9 * np.abs(values).max(initial=0.0))
    for s in np.unique(size):
        some = values[size == s]
        some = some[:: max(1, some.size // 500)]
        for d in range(DECIMALS):
            if np.mean(np.abs(some * 10.0**d - np.rint(some * 10.0**d)) < 1e-6 * 10.0 ** max(0, d - 3)) > 0.98:
                out[size == s] = np.maximum(out[size == s], 10.0**-d)
                break
    return out
