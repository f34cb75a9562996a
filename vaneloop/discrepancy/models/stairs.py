"""Which steps a sensor may round to, as its values and the nominal model's errors tell: a fit sees no slope there.

Rounding to steps S adds to a value y the sawtooth -S/pi (sin 2 pi y/S - sin(4 pi y/S)/2 + ...). So errors that come
from it go with sin(2 pi f y) at f = 1/S, and values that are rounded, with little noise on top, with cos(2 pi f y).
Both show in the magnitude of the sum with exp(2 pi i f y), at frequencies a quarter of 1/range apart; steps count from
zero, so that the phase then tells f closer, by the range from there.
"""

from __future__ import annotations

import numpy as np

from vaneloop.discrepancy.stage import Array

__all__ = ["steps_seen"]

LEAST = 1.0  # times the noise: a smaller step makes an error of less than 0.3 of it
MOST_FREQUENCIES = 6000
SAMPLES = 3000  # looked at
KEPT = 3  # of each kind of peak
FINER, MOST_FINER = 16.0, 500  # frequencies tried around a peak, to one turn of the phase; at most


def steps_seen(measured: Array, model: Array, noise: float) -> list[float]:
    """Steps to begin from, ascending; empty where there is nothing to look at.

    measured, model  values of the output, and what the nominal model makes of it, float64[samples]
    noise            RMS of the noise in the values
    """
    good = np.isfinite(measured) & np.isfinite(model)
    y, m = measured[good], model[good]
    if len(y) < 2:
        return []
    span = float(np.ptp(m))
    least = max(LEAST * noise, 4.0 * span / MOST_FREQUENCIES)
    if not span > 2.0 * least:
        return []
    f = np.arange(2.0 / span, 1.0 / least, 0.25 / span)
    stride = max(1, len(y) // SAMPLES)
    y, m = y[::stride], m[::stride]
    error = y - m - np.mean(y - m)
    with_error = _sums(f, m - m[0], error)
    of_values = _sums(f, y - y[0], np.full(len(y), 1.0 / len(y)))
    out: set[float] = set()
    finer = 1.0 / (FINER * max(float(np.max(np.abs(m))), span))
    for height in (with_error, of_values):
        inner = height[1:-1]
        peaks = 1 + np.flatnonzero((inner >= height[:-2]) & (inner > height[2:]))
        for k in peaks[np.argsort(-height[peaks], kind="stable")][:KEPT]:
            many = min(int(0.25 / span / finer) + 1, MOST_FINER // 2)
            sizes = 1.0 / (f[k] + finer * np.arange(-many, many + 1))
            left = [float(np.sum((y - np.round(m / s) * s) ** 2)) for s in sizes]
            best = f[k] + finer * (int(np.argmin(left)) - many)
            out |= {float(1.0 / (best + near * finer)) for near in (-1.0, 0.0, 1.0)}
    return sorted(out)


def _sums(f: Array, x: Array, weights: Array) -> Array:
    """Magnitude of the sum of weights times exp(2 pi i f x), at evenly spaced frequencies ``f``."""
    many = min(len(f), 256)
    turned = np.exp(2j * np.pi * (f[:many, None] - f[0]) * x)  # from the first frequency of a block to each of it
    parts = [np.abs(turned @ (weights * np.exp(2j * np.pi * f[i] * x))) for i in range(0, len(f), many)]
    return np.concatenate(parts)[: len(f)]
