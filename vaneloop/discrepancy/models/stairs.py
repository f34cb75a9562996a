"""Which steps a sensor may round to, as its values and the nominal model's errors tell: a fit sees no slope there.

Rounding to steps S adds to a value y the sawtooth -S/pi (sin 2 pi y/S - sin(4 pi y/S)/2 + ...). So errors that come
from it go with sin(2 pi f y) at f = 1/S, and values that are rounded, with little noise on top, with cos(2 pi f y).
A step that is wrong by a quarter of S^2 over the range of y shows nothing: frequencies stand a quarter of 1/range
apart.
"""

from __future__ import annotations

import numpy as np

from vaneloop.discrepancy.stage import Array

__all__ = ["steps_seen"]

LEAST = 1.0  # times the noise: a smaller step makes an error of less than 0.3 of it
MOST_FREQUENCIES = 6000
SAMPLES = 3000  # looked at for the frequencies; a step is then tried on all
KEPT = 3  # of each kind of peak
FINE = 41  # steps tried around a peak
NEXT = (0.998, 1.0, 1.002)  # a start, and two from which a search between starts ends beside it


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
    error = (y - m)[::stride]
    error = error - error.mean()
    goes_with_error, of_values = np.empty(len(f)), np.empty(len(f))
    for i in range(0, len(f), 256):
        turn = 2.0 * np.pi * f[i : i + 256, None]
        goes_with_error[i : i + 256] = -np.sin(turn * m[::stride]) @ error
        of_values[i : i + 256] = np.cos(turn * y[::stride]).mean(axis=1)
    out: set[float] = set()
    for height in (goes_with_error, of_values):
        inner = height[1:-1]
        peaks = 1 + np.flatnonzero((inner >= height[:-2]) & (inner > height[2:]))
        for k in peaks[np.argsort(-height[peaks], kind="stable")][:KEPT]:
            sizes = 1.0 / np.linspace(f[k] - 0.25 / span, f[k] + 0.25 / span, FINE)
            left = [float(np.sum((y - np.round(m / s) * s) ** 2)) for s in sizes]
            out.add(float(sizes[int(np.argmin(left))]))
    return sorted(s * near for s in out for near in NEXT)
