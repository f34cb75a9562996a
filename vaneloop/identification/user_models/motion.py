"""Measured motion, smoothed so that it can be differentiated, up to the frequency at which the measured forces end."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
import scipy

from vaneloop.identification.settings import ABOVE_WHITE, FLAT_TO, FORCE_SHARE, SPECTRUM_PARTS
from vaneloop.identification.subsystem import Array
from vaneloop.identification.user_models.system import Record, System

__all__ = ["MOTION", "differentiated_to", "highest_frequency", "low_pass", "motion", "smoothed", "uses"]

MOTION = ("position", "velocity", "acceleration")


def highest_frequency(outputs: Iterable[str], records: Sequence[Record]) -> float:
    """Up to which frequency forces are compared (Hz): what the measured ones have above it is white noise, or next to
    nothing.
    """
    best = 0.0
    for r in records:
        for o in outputs:
            f, power, noise = _spectrum(r, o)
            above = np.cumsum(power[::-1])[::-1] - power  # of each frequency
            left = np.arange(len(f))[::-1]
            total = float(power.sum()) - noise * len(f)
            if not total > 0.0:
                continue
            force = above - noise * left - ABOVE_WHITE * noise * np.sqrt(left)
            best = max(best, float(f[int(np.argmax(force <= (1.0 - FORCE_SHARE) * total))]))
    rate = 1.0 / float(np.median(np.diff(records[0].t)))
    return float(np.clip(best, 5.0 / records[0].t[-1], 0.2 * rate))


def differentiated_to(s: System, records: Sequence[Record], cutoff: float) -> float:
    """Up to which frequency the motion is differentiated where forces are compared up to ``cutoff`` (Hz): higher, so
    that a force that is no straight function of the motion is that of the whole motion; but no further than where its
    white noise, differentiated, is next to nothing beside the motion.
    """
    channel, order = (str(s.velocity), 0) if s.velocity else (str(s.position), 1)
    order += uses(s.model, "acceleration")
    best = FLAT_TO * cutoff
    for r in records:
        f, power, noise = _spectrum(r, channel)
        gain = f ** (2 * order)
        whole = float(np.sum(gain * np.maximum(power - noise, 0.0) * (f <= cutoff)))
        too_much = np.cumsum(gain * noise) > (1.0 - FORCE_SHARE) * whole
        best = min(best, float(f[int(np.argmax(too_much))]) if too_much.any() else best)
    return max(best, cutoff)


def _spectrum(r: Record, channel: str) -> tuple[Array, Array, float]:
    """Frequencies (Hz) and power of a channel, and that of its white noise."""
    y = r.columns[channel]
    y = np.where(np.isfinite(y), y, np.nanmean(y))
    f, power = scipy.signal.welch(y - y.mean(), 1.0 / float(np.median(np.diff(r.t))), nperseg=min(4096, len(y)))
    return f, power, float(np.quantile([part.mean() for part in np.array_split(power, SPECTRUM_PARTS)], 0.25))


def motion(s: System, r: Record, cutoff: float | None) -> tuple[Array, Array, Array]:
    """Displacement, velocity and acceleration of a log, differentiated up to ``cutoff`` (Hz; None: as measured); a
    displacement that is not measured is integrated from 0.
    """
    if s.position is None:  # the position at the start is added where it is known (`Runner`)
        v = r.columns[str(s.velocity)]
        x = scipy.integrate.cumulative_trapezoid(v, r.t, initial=0.0)
        if not cutoff:
            return x, v, np.zeros(len(v))
        x, v = low_pass(r.t, x, cutoff), low_pass(r.t, v, cutoff)
        return x, v, _derivative(r.t, v)
    x = r.columns[s.position]
    if not cutoff:
        return x, np.gradient(x, r.t) if s.velocity is None else r.columns[s.velocity], np.zeros(len(x))
    x = low_pass(r.t, x, cutoff)
    v = _derivative(r.t, x) if s.velocity is None else low_pass(r.t, r.columns[s.velocity], cutoff)
    return x, v, _derivative(r.t, v)


def _derivative(t: Array, x: Array) -> Array:
    """That of a cubic spline through all samples."""
    return np.asarray(scipy.interpolate.CubicSpline(t, x)(t, 1))


def low_pass(t: Array, x: Array, cutoff: float) -> Array:
    """Zero-phase low-pass that looks no farther than one period of ``cutoff`` (Hz) to either side: farther from its
    ends a log is filtered exactly, and so is what is linear in it. Beyond its ends it goes on mirrored.
    """
    good = np.isfinite(x)
    if not good.all():
        x = np.interp(t, t[good], x[good]) if good.any() else np.zeros(len(x))
    kernel = _kernel(min(cutoff * float(np.median(np.diff(t))), 0.475))
    more, mean = len(kernel) // 2, float(np.mean(x))
    return np.asarray(scipy.signal.oaconvolve(np.pad(x - mean, more, mode="symmetric"), kernel, mode="valid") + mean)


@lru_cache(maxsize=64)
def _kernel(cutoff: float) -> Array:
    """Weights of `low_pass` for a cut-off in periods a sample: a window of cos^4 that ends after one period, times the
    parabola that leaves every cubic as it is. It passes 0.999 at a fifth of the cut-off, 0.956 at half of it.
    """
    n = int(np.ceil(1.0 / cutoff))
    k = np.arange(-n, n + 1) / (n + 1)
    window = np.cos(0.5 * np.pi * k) ** 4
    m0, m2, m4 = (float(np.sum(window * k**i)) for i in (0, 2, 4))
    kernel = window * (m4 - m2 * k**2) / (m0 * m4 - m2**2)
    kernel.setflags(write=False)
    return np.asarray(kernel)


def _butterworth(t: Array, x: Array, cutoff: float) -> Array:
    """Zero-phase fourth-order Butterworth filter."""
    rate = 1.0 / float(np.median(np.diff(t)))
    good = np.isfinite(x)
    if not good.all():
        x = np.interp(t, t[good], x[good]) if good.any() else np.zeros(len(x))
    return np.asarray(
        scipy.signal.sosfiltfilt(scipy.signal.butter(4, min(cutoff / (0.5 * rate), 0.95), output="sos"), x)
    )


def smoothed(t: Array, x: Array) -> Array:
    """A measured displacement, smooth enough to be differentiated once, with all that moves it."""
    rate = 1.0 / float(np.median(np.diff(t)))
    y = np.where(np.isfinite(x), x, np.nanmean(x))
    f, power = scipy.signal.welch(y - y.mean(), rate, nperseg=min(4096, len(y)))
    total = np.cumsum(power)
    highest = float(f[int(np.searchsorted(total, FORCE_SHARE * total[-1]))])
    return _butterworth(t, x, min(max(0.05 * rate, 1.5 * highest), 0.4 * rate))


def uses(f: Callable[..., Any], name: str) -> bool:
    """Whether a function mentions an attribute."""
    code = getattr(getattr(f, "py_func", f), "__code__", None)
    return code is None or name in code.co_names or not {"position", "velocity"} & set(code.co_names)
