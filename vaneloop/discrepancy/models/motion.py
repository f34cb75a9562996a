"""Measured motion, smoothed so that it can be differentiated, up to the frequency at which the measured forces end."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from vaneloop.discrepancy.models.system import Record, System
from vaneloop.discrepancy.stage import Array

__all__ = ["MOTION", "highest_frequency", "low_pass", "motion", "smoothed", "uses"]

MOTION = ("position", "velocity", "acceleration")
FORCE_SHARE = 0.9995  # of the power of the measured force lies below the frequency to which motion is differentiated

NOISE = 2.0  # times the quietest tenth of a spectrum: more than that is not its white noise


def highest_frequency(outputs: Iterable[str], records: Sequence[Record]) -> float:
    """Up to which frequency the motion is differentiated: where the measured forces have their power."""
    from scipy.signal import welch

    best = 0.0
    for r in records:
        rate = 1.0 / float(np.median(np.diff(r.t)))
        for o in outputs:
            y = r.columns[o]
            y = np.where(np.isfinite(y), y, np.nanmean(y))
            f, power = welch(y - y.mean(), rate, nperseg=min(4096, len(y)))
            # white noise is everywhere; what rises into it is no force
            total = np.cumsum(np.maximum(power - NOISE * np.quantile(power, 0.1), 0.0))
            if not total[-1] > 0.0:
                continue
            best = max(best, float(f[int(np.searchsorted(total, FORCE_SHARE * total[-1]))]))
    rate = 1.0 / float(np.median(np.diff(records[0].t)))
    return float(np.clip(best, 5.0 / records[0].t[-1], 0.2 * rate))


def motion(s: System, r: Record, cutoff: float | None) -> tuple[Array, Array, Array]:
    """Displacement, velocity and acceleration of a log, differentiated up to ``cutoff`` (Hz; None: as measured); a
    displacement that is not measured is integrated from 0.
    """
    from scipy.integrate import cumulative_trapezoid

    if s.position is None:  # the position at the start is added where it is known (`Runner`)
        v = r.columns[str(s.velocity)]
        x = cumulative_trapezoid(v, r.t, initial=0.0)
        if cutoff:
            x, v = low_pass(r.t, x, cutoff), low_pass(r.t, v, cutoff)
        return x, v, np.gradient(v, r.t) if cutoff else np.zeros(len(v))
    x = r.columns[s.position]
    if cutoff:
        x = low_pass(r.t, x, cutoff)
    v = np.gradient(x, r.t) if s.velocity is None else r.columns[s.velocity]
    if s.velocity is not None and cutoff:
        v = low_pass(r.t, v, cutoff)
    a = np.gradient(v, r.t) if cutoff else np.zeros(len(x))
    return x, v, a


def low_pass(t: Array, x: Array, cutoff: float) -> Array:
    """Zero-phase fourth-order Butterworth filter."""
    from scipy.signal import butter, sosfiltfilt

    rate = 1.0 / float(np.median(np.diff(t)))
    good = np.isfinite(x)
    if not good.all():
        x = np.interp(t, t[good], x[good]) if good.any() else np.zeros(len(x))
    return np.asarray(sosfiltfilt(butter(4, min(cutoff / (0.5 * rate), 0.95), output="sos"), x))


def smoothed(t: Array, x: Array) -> Array:
    """A measured displacement, smooth enough to be differentiated once, with all that moves it."""
    from scipy.signal import welch

    rate = 1.0 / float(np.median(np.diff(t)))
    y = np.where(np.isfinite(x), x, np.nanmean(x))
    f, power = welch(y - y.mean(), rate, nperseg=min(4096, len(y)))
    total = np.cumsum(power)
    highest = float(f[int(np.searchsorted(total, FORCE_SHARE * total[-1]))])
    return low_pass(t, x, min(max(0.05 * rate, 1.5 * highest), 0.4 * rate))


def uses(f: Callable[..., Any], name: str) -> bool:
    """Whether a function mentions an attribute."""
    code = getattr(getattr(f, "py_func", f), "__code__", None)
    return code is None or name in code.co_names or not {"position", "velocity"} & set(code.co_names)
