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
DIGITS_OF = 150  # values of one size, whose last digit is looked for
LOOKED_AT = 1500  # rows of a part of a long channel
GLANCE = 120  # rows of it that tell most channels apart
MOST_CORNERS = 0.6  # share of rows: where lines join samples, half of them at most are corners

_LEAST = 1e-9  # of the largest value: the last digit of a channel that has none
_TENS = 10.0 ** np.arange(DECIMALS)[:, None]
_NEAR = 1e-6 * np.maximum(1.0, 1e-3 * _TENS)  # of a multiple, by which a number may be off


class Joined(NamedTuple):
    """Every ``every``-th row is a true sample, the first in row ``first``; ``sure`` where nearly each of them shows."""

    every: int
    first: int
    sure: bool


def joined(t: np.ndarray, values: np.ndarray, fewest: int = 0) -> Joined | None:
    """The true samples of a channel whose others are straight lines between them; None where all may be true.

    A command whose corners stand at round times looks the same, so a channel that seldom bends is not ``sure``.

    t       s, increasing; only a channel with a step of its own is looked at
    fewest  corners of a channel that is looked at
    """
    if t.size < 3 * FEWEST:
        return None
    bends = _bends(values)
    corners = np.count_nonzero(bends)
    if SLOWEST ** -float(corners) > CHANCE or not fewest <= corners <= MOST_CORNERS * values.size:
        return None
    step = float(np.median(np.diff(t)))
    row = np.rint((t - t[0]) / step).astype(np.int64)
    if np.mean(np.abs(t - t[0] - row * step) > UNIFORM * step) > STRAY:
        return None
    even = (row[2:] - row[:-2] == 2) & (row[1:-1] - row[:-2] == 1)
    at = row[1:-1][even & bends]
    if np.count_nonzero(np.diff(at) == 1) > 2.0 * STRAY * at.size:  # two corners side by side: one of them strays
        return None
    for every in range(SLOWEST, 1, -1):
        if every ** -float(at.size) > CHANCE:
            continue
        share = np.bincount(at % every, minlength=every) / at.size
        first = int(np.argmax(share))
        if share[first] >= 1.0 - STRAY:
            sure = at.size >= FEWEST and at.size * every >= TELLING * row[-1]
            return Joined(every, first, sure)
    return None


def seems_joined(t: np.ndarray, values: np.ndarray) -> bool:
    """Whether the channel is surely joined at its start, in its middle or at its end: a long one is looked at there.

    Most channels were sampled in each row, which a few of their rows show.
    """
    middle = max(t.size - GLANCE, 0) // 2
    if np.count_nonzero(_bends(values[middle : middle + GLANCE])) > MOST_CORNERS * GLANCE:
        return False
    last = max(t.size - LOOKED_AT, 0)
    parts = (slice(k, k + LOOKED_AT) for k in sorted({0, last // 2, last}))
    return any((j := joined(t[part], values[part], FEWEST)) is not None and j.sure for part in parts)


def _bends(values: np.ndarray) -> np.ndarray:
    """Whether the line bends at each value but the first and the last, by more than the last digits of three: bool."""
    bend = np.abs(values[2:] - 2.0 * values[1:-1] + values[:-2])
    some = bend > 2.0 * _LEAST * np.abs(values).max(initial=0.0)
    if SLOWEST ** -float(np.count_nonzero(some)) > CHANCE:  # too few to tell anything
        return some
    digit = _last_digit(values)
    if digit.size > 1:
        digit = np.maximum(np.maximum(digit[2:], digit[1:-1]), digit[:-2])
    return np.asarray(bend > 2.01 * digit)


def _last_digit(values: np.ndarray) -> np.ndarray:
    """For each value the decimal step of which it and those of its size are multiples, as text has them; 1e-9 of the
    largest where there is none. One step where all are of one size.
    """
    far = np.abs(values)
    least = _LEAST * far.max(initial=0.0)
    low, high = _size(far.min(initial=np.inf)), _size(far.max(initial=0.0))
    if low == high:
        return np.array([_step_of(values, least)])
    size = _size(far)
    out = np.empty(values.size)
    for s in np.flatnonzero(np.bincount((size - low).astype(np.int64))):
        of = size == low + s
        out[of] = _step_of(values[of], least)
    return out


def _size(far: np.ndarray) -> np.ndarray:
    """Tens of a number before its first digit; -12 of what is smaller."""
    return np.floor(np.log10(np.maximum(far, 1e-12)))


def _step_of(values: np.ndarray, least: float) -> float:
    """The decimal step of which values of one size are multiples, at least ``least``."""
    some = values[:: max(1, values.size // DIGITS_OF)]
    steps = some * _TENS
    fits = np.count_nonzero(np.abs(steps - np.rint(steps)) < _NEAR, axis=1) > 0.98 * some.size
    return max(least, 1.0 / _TENS[int(np.argmax(fits)), 0]) if fits.any() else least
