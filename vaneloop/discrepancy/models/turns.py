"""Periods along a channel with which a model's error repeats itself: a motor that cogs seven times a turn, the teeth of
a gear, a pulley or an encoder out of centre.

Its frequency in time goes with the speed, so that no line stands out there. Along the channel one does. What pushes
something shows in how fast a reading changes, or in how fast that does: the error is tried as it is and differentiated
once and twice. As with `vaneloop.discrepancy.models.periods` it is also tried times each signal, for what multiplies.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vaneloop.discrepancy.models.periods import CLEAR, CYCLES, FINE, MOST, SAMPLES, about, detrended
from vaneloop.discrepancy.stage import Array

__all__ = ["periods_along"]

DERIVATIVES = 2
EVEN = 0.5  # periods by which a channel must leave a straight course in time
BINS = 4  # along a channel for each of the finest cycles that are looked for


def periods_along(
    ways: Sequence[Array], times: Sequence[Array], errors: Sequence[Array], signals: Sequence[Array]
) -> list[float]:
    """The clearest periods, in the channel's unit; all arguments log by log.

    ways     the channel, float64[samples]; ``times``: s
    errors   of each output, float64[outputs, samples], 0 where there is none
    signals  that what repeats itself may multiply, float64[signals, samples]
    """
    low = min(float(w.min()) for w in ways)
    span = max(float(w.max()) for w in ways) - low
    steps = np.abs(np.concatenate([np.diff(w) for w in ways]))
    most = span / max(SAMPLES * float(np.median(steps)), 1e-300)  # cycles from end to end
    most = min(most, len(steps) / SAMPLES)
    if not np.isfinite(span) or not most > 2.0 * CYCLES:
        return []
    cells = int(2 ** np.ceil(np.log2(BINS * most)))
    where = [np.minimum(((w - low) * (cells / span)).astype(int), cells - 1) for w in ways]
    found: list[tuple[float, float]] = []
    for rows in _rows(times, errors, signals):
        power = sum(_power(at, row, cells) for at, row in zip(where, rows, strict=True))
        found += _peaks(np.asarray(power), span, most)
    out: list[float] = []
    uneven = max(float(np.ptp(w - np.polyval(np.polyfit(t, w, 1), t))) for w, t in zip(ways, times, strict=True))
    for _, f in sorted(found, reverse=True):
        if uneven * f < EVEN:
            continue  # the channel does what time does
        if all(abs(f - 1.0 / p) > 2.0 / span for p in out):
            out.append(1.0 / f)
    return out[:MOST]


def _rows(times: Sequence[Array], errors: Sequence[Array], signals: Sequence[Array]) -> list[list[Array]]:
    """What may have a line: of each output and derivative, alone and times each signal; log by log."""
    beside = [
        np.concatenate([np.ones((1, len(t))), detrended(s) if len(s) else s])
        for t, s in zip(times, signals, strict=True)
    ]
    out = []
    for j in range(len(errors[0])):
        rows = [e[j] for e in errors]
        for _ in range(DERIVATIVES + 1):
            out += [[row * b[i] for row, b in zip(rows, beside, strict=True)] for i in range(len(beside[0]))]
            rows = [np.gradient(row, t) for row, t in zip(rows, times, strict=True)]
    return out


def _power(where: Array, row: Array, cells: int) -> Array:
    """Power of a row along a channel, at each cycle from end to end and `FINE` parts of it, as a share of its own."""
    row = row - row.mean()
    summed = np.bincount(where, weights=row, minlength=cells)
    return np.asarray(np.abs(np.fft.rfft(summed, FINE * cells)) ** 2) / max(float(row @ row), 1e-300)


def _peaks(power: Array, span: float, most: float) -> list[tuple[float, float]]:
    """How clear lines are, and their frequencies (1 over the channel's unit)."""
    from scipy.signal import find_peaks

    first, last = int(FINE * CYCLES), min(int(FINE * most), len(power) - 1)
    clear = power / about(power)
    at = find_peaks(clear[first:last], CLEAR, distance=2 * FINE)[0] + first
    return [(float(clear[k]), float((k + _between(*power[k - 1 : k + 2])) / (FINE * span))) for k in at]


def _between(before: float, at: float, after: float) -> float:
    """Where between its neighbours a line is highest: of a parabola through the three."""
    bend = before - 2.0 * at + after
    return 0.5 * (before - after) / bend if bend < 0.0 else 0.0
