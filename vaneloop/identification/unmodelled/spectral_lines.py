"""Periods in time with which a model's error repeats itself, and what drives the model does not.

A ripple, a hum or a shaken base is a curve of the time within its period. Its period is where the error's spectrum has
a line. Where it multiplies, a gain that swings at 50 Hz shows at 50 Hz beside the motion that it acts on. There a wave
is fitted as that gain, alone and with its multiples: a gain that dips for a moment has many, and none stands out. What
swings faster than the model answers is no wave times what a constant does. It is nearly a wave times what the gain acts
on, and that is much like a signal that drives the model, or one that it gives. Lines of what drives the model, and
multiples of them, are the model's own: they say nothing of time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import scipy

from vaneloop.identification.settings import (
    ABOUT_LINES,
    CLEAR_COMB,
    CLEAR_LINE,
    CYCLE_BINS,
    DRIVEN_MAIN,
    DRIVEN_SHARE,
    FINE_HARMONICS,
    HARMONICS,
    LEAST_CYCLES,
    LINE_DERIVATIVES,
    LINE_PIECES,
    LINE_RESOLVED,
    LINES_EACH,
    LOGS_ALIKE,
    MODEL_ORDERS,
    MOST_PERIODS,
    MOSTLY,
    REPEATED,
    SAMPLES_PER_PERIOD,
    STEADY_LINE,
    UNEVEN_PERIODS,
)
from vaneloop.identification.subsystem import Array

__all__ = ["Course", "Lines", "about", "detrended", "periods_along"]

ALONE = (1, CLEAR_LINE)  # a wave without multiples
WAVES = ((FINE_HARMONICS, np.inf), (HARMONICS, CLEAR_COMB), ALONE)


class Course(NamedTuple):
    """One log.

    t        s, float64[samples]; ``error``: of each output, in noise floors, 0 where there is none
    drivers  what drives the model, float64[channels, samples]
    said     what the model itself gives, float64[signals, samples]; of none nothing is asked that is faster than it
    read     what its sensors read, by the names of its outputs
    """

    t: Array
    error: Array
    drivers: Array
    said: Array = np.zeros((0, 0))
    read: Mapping[str, Array] = {}


class _Even(NamedTuple):
    """Signals at even steps of time, from ``t``'s first; each in its own course."""

    t: Array
    rows: Array


class _Line(NamedTuple):
    """A line at ``f`` (Hz) in ``parts``, of so many harmonics; ``share``: of the sum of squares that it takes off."""

    f: float
    parts: list[_Even]
    harmonics: int
    share: float


def _even(t: Array, rows: Array, straight: bool = True) -> _Even:
    """Signals at even steps; ``straight``: without their straight line."""
    n = len(t)
    even = np.linspace(t[0], t[-1], n)
    if np.max(np.abs(even - t)) > 0.1 * (t[-1] - t[0]) / n:
        rows = np.array([np.interp(even, t, row) for row in rows]).reshape(len(rows), n)
    return _Even(even, detrended(rows) if straight and len(rows) else rows)


def detrended(rows: Array) -> Array:
    """Signals without their straight line."""
    return np.asarray(scipy.signal.detrend(rows))


def _taken(part: _Even) -> Array:
    """Of errors, and behind them what a constant would do to each, their products."""
    n = len(part.rows) // 2
    return part.rows[:n] * part.rows[n:]


def _fitted(parts: Sequence[_Even], harmonics: int, numbers: Array, apart: float) -> Array:
    """By how much the sum of squares of errors falls with a constant and so many harmonics of each frequency, beside a
    constant alone, where what they multiply is known; the same in all logs.

    parts    of each log errors, and behind them what a constant would do to each
    numbers  of the frequencies, in ``apart`` (Hz)
    """
    falls, weights = np.zeros((2, 2 * harmonics * int(numbers[-1]) + 1), dtype=complex)
    for part in parts:
        step = float(part.t[1] - part.t[0])
        window = np.hanning(len(part.t))
        f = apart * np.arange(len(weights))
        begun = np.exp(-2j * np.pi * f * part.t[0])
        turn = np.exp(-2j * np.pi * apart * step)
        squares = np.sum(part.rows[len(part.rows) // 2 :] ** 2, axis=0)
        weights += begun * scipy.signal.czt(window * squares, len(f), turn)
        falls += begun * scipy.signal.czt(window * np.sum(_taken(part), axis=0), len(f), turn)
    order = np.arange(-harmonics, harmonics + 1)
    at = numbers[:, None] * order

    def of(spectrum: Array, at: Array) -> Array:
        return np.where(at < 0, np.conj(spectrum[np.abs(at)]), spectrum[np.abs(at)])

    g = of(falls, at)
    normal = of(weights, numbers[:, None, None] * (order[:, None] - order[None, :]))
    mean = float(weights[0].real)
    if not mean > 0.0:
        return np.zeros(len(numbers))
    normal = normal + 1e-6 * mean * np.eye(len(order))
    solved = np.linalg.solve(normal, g[..., None])[..., 0]
    return np.maximum(np.sum((np.conj(g) * solved).real, axis=1) - float(falls[0].real) ** 2 / mean, 0.0)


def _spectrum(part: _Even, f: Array) -> Array:
    """Power of all signals of a course at frequencies ``f`` (Hz), by its length."""
    n, span = len(part.t), float(part.t[-1] - part.t[0])
    size = int(2 ** np.ceil(np.log2(LINES_EACH * n)))
    lines = np.sum(np.abs(np.fft.rfft(part.rows * np.hanning(n), size)) ** 2, axis=0) / n
    return np.interp(f, np.arange(len(lines)) * (n - 1) / span / size, lines)


def about(power: Array) -> Array:
    """The median about each line."""
    middle = scipy.ndimage.median_filter(power, 2 * LINES_EACH * ABOUT_LINES + 1, mode="reflect")
    return np.asarray(np.maximum(middle, 1e-12 * max(float(power.max()), 1e-300)))


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
        low, high = LEAST_CYCLES / self.shortest, 1.0 / (SAMPLES_PER_PERIOD * step)
        apart = 1.0 / (LINES_EACH * self.longest)
        numbers = np.arange(int(np.ceil(low / apart)), int(high / apart)) if 2.0 * low < high else np.zeros(0, int)
        self.apart, self.numbers, self.f = apart, numbers, apart * numbers
        self.driven = [_driven(c, float(self.f[-1])) for c in courses if len(numbers)]

    def periods(self, times: Sequence[Array] = ()) -> list[float]:
        """Periods (s) in which the error repeats itself; arguments as of `found`."""
        return [period for period, _ in self.found(times)]

    def found(self, times: Sequence[Array] = ()) -> list[tuple[float, int]]:
        """Periods (s) in which the error repeats itself, and the harmonics that a curve needs for it.

        times  what a constant would do to the error at the place that is asked for, log by log; none: the error itself
        """
        if not len(self.f):
            return []
        if len(times):
            return self._own(self._swings([c.error for c in self.courses], times))
        parts = [_even(c.t, c.error) for c in self.courses]
        return self._own([_Line(_highest(parts, f, self.longest), parts, 1, 0.0) for f in self._lines(parts)])

    def fast(self) -> list[tuple[float, int]]:
        """The same of a gain at any place that swings faster than the model answers, by its first wave."""
        if not len(self.f):
            return []
        signals = [np.concatenate([c.drivers, c.said]) if len(c.said) else c.said for c in self.courses]
        lines: list[_Line] = []
        for j in range(len(self.courses[0].error)):
            for i in range(len(signals[0])):
                times = [detrended(rows[i : i + 1]) for rows in signals]
                lines += self._swings([c.error[j : j + 1] for c in self.courses], times, (ALONE,))
        return self._own(sorted(lines, key=lambda line: -line.share))

    def _own(self, lines: Sequence[_Line]) -> list[tuple[float, int]]:
        """Of lines, the first ones that say something of time."""
        out: list[tuple[float, int]] = []
        for g, parts, harmonics, _ in lines:
            # a line that is driven, too, may be one of time where it has the same phase in every log
            driven = any(d.has(g, harmonics == 1) for d in self.driven)
            own = not driven or (len(parts) > 1 and _coherence(parts, g) > LOGS_ALIKE)
            if own and all(abs(g - 1.0 / h) > 2.0 / self.shortest for h, _ in out):
                out.append((1.0 / g, max(harmonics, HARMONICS)))
        return out[:MOST_PERIODS]

    def _peaks(self, power: Array, least: Array) -> list[float]:
        """Frequencies (Hz) of its lines that are above the ``least``, the highest first."""
        at = scipy.signal.find_peaks(power, least, distance=2 * LINES_EACH)[0]
        return [float(self.f[k]) for k in sorted(at, key=lambda k: -power[k])]

    def _lines(self, parts: Sequence[_Even]) -> list[float]:
        """Of the error itself."""
        own = np.array([_spectrum(part, self.f) for part in parts])
        return self._peaks(own.sum(axis=0), CLEAR_LINE * np.array([about(o) for o in own]).sum(axis=0))

    def _swings(
        self, errors: Sequence[Array], times: Sequence[Array], waves: Sequence[tuple[int, float]] = WAVES
    ) -> list[_Line]:
        """Of what swings where a constant would do ``times`` to the errors, log by log: ``waves`` of each frequency,
        with so many harmonics and so clear, fitted. Beside a product's line, what a swing does elsewhere would stand as
        noise.
        """
        logs = list(zip(self.courses, errors, times, strict=True))
        both = [_even(c.t, np.concatenate([e, w]), straight=False) for c, e, w in logs]
        products = [part._replace(rows=detrended(np.array([np.sum(_taken(part), axis=0)]))) for part in both]
        whole = sum(float(np.sum(part.rows[: len(part.rows) // 2] ** 2 * np.hanning(len(part.t)))) for part in both)
        out: list[_Line] = []
        for harmonics, clear in waves:
            below = self.numbers[harmonics * self.numbers <= self.numbers[-1]]
            if len(below) > 2 * ABOUT_LINES:
                falls = _fitted(both, harmonics, below, self.apart)
                least = np.minimum(clear * about(falls), MOSTLY * whole)
                many = None if harmonics == 1 else 1  # the next ones are multiples, and parts, of the first
                for f in self._peaks(falls, least)[:many]:
                    fall = float(np.interp(f, self.f[: len(falls)], falls))
                    out.append(_Line(f, products, harmonics, fall / max(whole, 1e-300)))
        return out


def _highest(parts: Sequence[_Even], f: float, span: float) -> float:
    """The frequency (Hz) near ``f`` that has most power in all logs together."""
    near = (f - 0.5 / span, f + 0.5 / span)
    found = scipy.optimize.minimize_scalar(
        lambda g: -_coherent(parts, g), bounds=near, method="bounded", options={"xatol": 1e-3 / span}
    )
    return float(found.x)


def _coherence(parts: Sequence[_Even], f: float) -> float:
    """Power of all logs together at a frequency, as a share of what it is where their phases are the same."""
    alone = len(parts) * sum(_coherent([part], f) for part in parts)
    return _coherent(parts, f) / max(alone, 1e-300)


class _Driven(NamedTuple):
    """What drives a model repeats itself: at frequencies ``most`` (Hz), which are most of it, and their multiples; at
    ``some`` others, each known to ``apart``; and after the times ``again`` (s), each known so that no multiple of
    1 / ``again`` is off by more than ``width`` (Hz).
    """

    most: list[float]
    some: list[float]
    apart: float
    again: list[float]
    width: float

    def has(self, f: float, alone: bool) -> bool:
        """Whether a frequency is one of them; ``alone``: of a wave that has no multiples: those that are not most of
        what drives a model make no others.
        """
        lines = [*self.most, *(self.some if alone else ())]
        repeats = any(abs(f * a - round(f * a)) < self.width * a for a in self.again)
        return repeats or any(abs(f - g) < self.apart for g in lines)


def _driven(c: Course, highest: float) -> _Driven:
    """Frequencies (Hz) up to the ``highest`` of what drives the model: its lines, multiples of a line that is most of
    it, and multiples of how often it is repeated.

    A line has one phase all along the log. A drive that has more of what is slow, or swings for a while, has none.
    """
    span = float(c.t[-1] - c.t[0])
    fine = np.arange(1.0 / span, highest, 1.0 / (LINES_EACH * span))
    out = _Driven([], [], LINE_RESOLVED / span, [], 2.0 / span)
    for row in c.drivers:
        if not np.ptp(row) > 0.0:
            continue
        part = _even(c.t, row[None])
        power = _spectrum(part, fine)
        share = np.convolve(power, np.ones(2 * LINES_EACH + 1), mode="same") / power.sum()
        pieces = [_Even(part.t[k], part.rows[:, k]) for k in np.array_split(np.arange(len(part.t)), LINE_PIECES)]
        for k in scipy.signal.find_peaks(power * (share > DRIVEN_SHARE), CLEAR_LINE * about(power))[0]:
            f = _highest([part], fine[k], span)
            if _coherence(pieces, f) > STEADY_LINE:
                most = share[k] > DRIVEN_MAIN
                (out.most if most else out.some).extend(
                    order * f for order in range(1, MODEL_ORDERS + 1 if most else 2)
                )
        out.again.extend(_repeats(part.rows[0], span / (len(c.t) - 1)))
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
    return [best * step] if alike[best] > REPEATED else []


# ---- Periods along a channel with which a model's error repeats itself


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
    most = span / max(SAMPLES_PER_PERIOD * float(np.median(steps)), 1e-300)  # cycles from end to end
    most = min(most, len(steps) / SAMPLES_PER_PERIOD)
    if not np.isfinite(span) or not most > 2.0 * LEAST_CYCLES:
        return []
    cells = int(2 ** np.ceil(np.log2(CYCLE_BINS * most)))
    where = [np.minimum(((w - low) * (cells / span)).astype(int), cells - 1) for w in ways]
    found: list[tuple[float, float]] = []
    for rows in _rows(times, errors, signals):
        power = sum(_power(at, row, cells) for at, row in zip(where, rows, strict=True))
        found += _peaks(np.asarray(power), span, most)
    out: list[float] = []
    uneven = max(float(np.ptp(w - np.polyval(np.polyfit(t, w, 1), t))) for w, t in zip(ways, times, strict=True))
    for _, f in sorted(found, reverse=True):
        if uneven * f < UNEVEN_PERIODS:
            continue  # the channel does what time does
        if all(abs(f - 1.0 / p) > 2.0 / span for p in out):
            out.append(1.0 / f)
    return out[:MOST_PERIODS]


def _rows(times: Sequence[Array], errors: Sequence[Array], signals: Sequence[Array]) -> list[list[Array]]:
    """What may have a line: of each output and derivative, alone and times each signal; log by log."""
    beside = [
        np.concatenate([np.ones((1, len(t))), detrended(s) if len(s) else s])
        for t, s in zip(times, signals, strict=True)
    ]
    out = []
    for j in range(len(errors[0])):
        rows = [e[j] for e in errors]
        for _ in range(LINE_DERIVATIVES + 1):
            out += [[row * b[i] for row, b in zip(rows, beside, strict=True)] for i in range(len(beside[0]))]
            rows = [np.gradient(row, t) for row, t in zip(rows, times, strict=True)]
    return out


def _power(where: Array, row: Array, cells: int) -> Array:
    """Power of a row along a channel, at each cycle from end to end and `LINES_EACH` parts of it, as a share of its
    own.
    """
    row = row - row.mean()
    summed = np.bincount(where, weights=row, minlength=cells)
    return np.asarray(np.abs(np.fft.rfft(summed, LINES_EACH * cells)) ** 2) / max(float(row @ row), 1e-300)


def _peaks(power: Array, span: float, most: float) -> list[tuple[float, float]]:
    """How clear lines are, and their frequencies (1 over the channel's unit)."""
    first, last = int(LINES_EACH * LEAST_CYCLES), min(int(LINES_EACH * most), len(power) - 1)
    clear = power / about(power)
    at = scipy.signal.find_peaks(clear[first:last], CLEAR_LINE, distance=2 * LINES_EACH)[0] + first
    return [(float(clear[k]), float((k + _between(*power[k - 1 : k + 2])) / (LINES_EACH * span))) for k in at]


def _between(before: float, at: float, after: float) -> float:
    """Where between its neighbours a line is highest: of a parabola through the three."""
    bend = before - 2.0 * at + after
    return 0.5 * (before - after) / bend if bend < 0.0 else 0.0
