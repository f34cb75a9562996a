"""Periods in time with which a model's error repeats itself, and what drives the model does not.

A ripple, a hum or a shaken base is a curve of the time within its period. Its period is where the error's spectrum has
a line. Where it multiplies, the line is in the error times what a constant would do there: a gain that swings at 50 Hz
shows at 50 Hz beside the motion that it acts on. Lines of what drives the model, and multiples of them, are the model's
own: they say nothing of time.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from vaneloop.discrepancy.stage import Array

__all__ = ["Course", "Lines"]

MOST = 2  # periods of one place that are tried
CLEAR = 40.0  # times the median power about it: a line; the highest of 100,000 of white noise is 17 times it
ABOUT = 50  # lines each way that "about" means
CYCLES, SAMPLES = 6.0, 2.5  # least of the first in a log, of the second in a period
ORDERS = 6  # multiples of a driven line that are the model's own
SHARE, MAIN = 0.01, 0.2  # of the variance of what drives the model in a line of it; in one that is most of it
AGAIN = 0.9  # correlation of what drives the model with itself a while later that means it is repeated
ALIKE = 0.9  # of the power that logs have in a line: what they have together, where it is the same in each
FINE = 4  # lines of a spectrum for each that its length resolves


class Course(NamedTuple):
    """One log.

    t        s, float64[samples]; ``error``: of each output, in noise floors, 0 where there is none
    drivers  what drives the model, float64[channels, samples]
    """

    t: Array
    error: Array
    drivers: Array


class _Even(NamedTuple):
    """Signals at even steps of time, from ``t``'s first; each in its own course."""

    t: Array
    rows: Array


def _even(t: Array, rows: Array) -> _Even:
    """Signals at even steps, without their straight line."""
    from scipy.signal import detrend

    n = len(t)
    even = np.linspace(t[0], t[-1], n)
    if np.max(np.abs(even - t)) > 0.1 * (t[-1] - t[0]) / n:
        rows = np.array([np.interp(even, t, row) for row in rows]).reshape(len(rows), n)
    return _Even(even, detrend(rows) if len(rows) else rows)


def _spectrum(part: _Even, f: Array) -> Array:
    """Power of all signals of a course at frequencies ``f`` (Hz), by its length."""
    n, span = len(part.t), float(part.t[-1] - part.t[0])
    size = int(2 ** np.ceil(np.log2(FINE * n)))
    lines = np.sum(np.abs(np.fft.rfft(part.rows * np.hanning(n), size)) ** 2, axis=0) / n
    return np.interp(f, np.arange(len(lines)) * (n - 1) / span / size, lines)


def _about(power: Array) -> Array:
    """The median about each line."""
    from scipy.ndimage import median_filter

    about = median_filter(power, 2 * FINE * ABOUT + 1, mode="reflect")
    return np.asarray(np.maximum(about, 1e-12 * max(float(power.max()), 1e-300)))


def _coherent(parts: Sequence[_Even], f: float) -> float:
    """Power of each signal at one frequency, its phase counted from t = 0 in every course."""
    total = sum(rows @ np.exp(-2j * np.pi * f * t) for t, rows in parts)
    return float(np.sum(np.abs(total) ** 2))


class Lines:
    """Lines in the errors of some logs, of all frequencies that they can tell."""

    def __init__(self, courses: Sequence[Course]):
        self.courses = courses
        spans = [float(c.t[-1] - c.t[0]) for c in courses]
        self.shortest, self.longest = min(spans), max(spans)
        step = max(span / (len(c.t) - 1) for span, c in zip(spans, courses, strict=True))
        low, high = CYCLES / self.shortest, 1.0 / (SAMPLES * step)
        self.f = np.arange(low, high, 1.0 / (FINE * self.longest)) if 2.0 * low < high else np.zeros(0)
        self.driven = np.array([_driven(c, self.f) for c in courses if len(self.f)])

    def periods(self, times: Sequence[Array] = ()) -> list[float]:
        """Periods (s) in which the error repeats itself.

        times  what a constant would do to the error at the place that is asked for, log by log; none: the error itself
        """
        from scipy.signal import find_peaks

        if not len(self.f):
            return []
        weighed = [c.error if not len(times) else c.error * times[k] for k, c in enumerate(self.courses)]
        parts = [_even(c.t, w) for c, w in zip(self.courses, weighed, strict=True)]
        own = np.array([_spectrum(part, self.f) for part in parts])
        usual = np.array([_about(o) for o in own])

        def lines(power: Array) -> list[float]:  # the highest first, as far as the length of the logs tells them
            at = find_peaks(power, CLEAR * usual.sum(axis=0), distance=2 * FINE)[0]
            return [_highest(parts, self.f[k], self.longest) for k in sorted(at, key=lambda k: -power[k])[: 2 * MOST]]

        # a line that is driven, too, may be one of time where it has the same phase in every log
        alike = [g for g in lines(own.sum(axis=0)) if _coherence(parts, g) > ALIKE] if len(parts) > 1 else []
        out: list[float] = []
        for g in (*alike, *lines(np.where(self.driven, usual, own).sum(axis=0))):
            if all(abs(g - h) > 2.0 / self.shortest for h in out):
                out.append(g)
        return [1.0 / g for g in out[:MOST]]


def _highest(parts: Sequence[_Even], f: float, span: float) -> float:
    """The frequency (Hz) near ``f`` that has most power in all logs together."""
    from scipy.optimize import minimize_scalar

    near = (f - 0.5 / span, f + 0.5 / span)
    found = minimize_scalar(
        lambda g: -_coherent(parts, g), bounds=near, method="bounded", options={"xatol": 1e-3 / span}
    )
    return float(found.x)


def _coherence(parts: Sequence[_Even], f: float) -> float:
    """Power of all logs together at a frequency, as a share of what it is where their phases are the same."""
    alone = len(parts) * sum(_coherent([part], f) for part in parts)
    return _coherent(parts, f) / max(alone, 1e-300)


def _driven(c: Course, f: Array) -> Array:
    """Which of the frequencies ``f`` (Hz) are of what drives the model: its lines, multiples of a line that is most of
    it, and multiples of how often it is repeated; bool[frequencies].
    """
    span = float(c.t[-1] - c.t[0])
    fine = np.arange(1.0 / span, f[-1], 1.0 / (FINE * span))
    width = 2.0 / span
    out = np.zeros(len(f), dtype=bool)
    for row in c.drivers:
        if not np.ptp(row) > 0.0:
            continue
        part = _even(c.t, row[None])
        power = _spectrum(part, fine)
        share = np.convolve(power, np.ones(2 * FINE + 1), mode="same") / power.sum()
        lines = (power > CLEAR * _about(power)) & (share > SHARE)
        for order in range(1, ORDERS + 1):
            at = order * fine[lines & (share > (MAIN if order > 1 else SHARE))]
            out |= np.searchsorted(at, f - width, "right") < np.searchsorted(at, f + width)
        for again in _repeats(part.rows[0], span / (len(c.t) - 1)):
            out |= np.abs(f * again - np.round(f * again)) < width * again
    return out


def _repeats(x: Array, step: float) -> list[float]:
    """Time (s) after which a signal repeats itself, where it does."""
    n = len(x)
    power = np.abs(np.fft.rfft(x, 2 * n)) ** 2
    both = np.fft.irfft(power)[: n // 2]
    energy = np.concatenate([[0.0], np.cumsum(x * x)])
    k = np.arange(n // 2)
    alike = both / np.maximum(np.sqrt(energy[n - k] * (energy[n] - energy[k])), 1e-300)
    dip = np.flatnonzero(alike < 0.5)
    if not len(dip):
        return []
    best = int(dip[0] + np.argmax(alike[dip[0] :]))
    return [best * step] if alike[best] > AGAIN else []
