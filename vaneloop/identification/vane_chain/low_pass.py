"""The low-pass of a recorder before its analogue channels: what it makes of a signal, and what the signal was."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
import scipy

from hil.figures import noise_floor
from plant import chain
from vaneloop.base.compiled import compiled
from vaneloop.base.spline_rates import SplineRates
from vaneloop.identification.settings import LOW_PASS_LASTS, NOISE_DRAWS, ROW_PARTS
from vaneloop.identification.subsystem import Array

__all__ = ["AS_LOGGED", "LOW_PASSES", "LowPass", "lagged"]


class LowPass(NamedTuple):
    """What a recorder's low-pass does to a channel, beside one that did not pass it.

    kind   of `LOW_PASSES`; "": none
    delay  s, of slow motions, that the low-pass makes
    late   s, by which the channel stands late besides; below 0, the other one is late
    held   what passes it holds its value from row to row, as what comes in frames does; else it runs straight
    """

    kind: str = ""
    delay: float = 0.0
    late: float = 0.0
    held: bool = False

    def of(self, ticks: Array, tick: float = chain.TICK) -> Array:
        """What it makes of values at ticks (s), of any shape that runs through all of them."""
        out = LOW_PASSES[self.kind](ticks.ravel(), self.delay / tick) if self.kind else ticks.ravel()
        at = np.arange(float(len(out)))
        return np.interp(at - self.late / tick, at, out).reshape(ticks.shape)

    def of_rows(self, rows: Array, dt: float) -> Array:
        """What it makes of signals whose rows are ``dt`` (s) apart, float64[..., rows].

        The sum over the rows of what it makes of the box, or the triangle, that a single one stands for.
        """
        if self == AS_LOGGED:
            return rows
        reach = int(np.ceil((LOW_PASS_LASTS * self.delay + abs(self.late)) / dt)) + 2
        at = np.arange(-reach * ROW_PARTS, reach * ROW_PARTS + 1) / ROW_PARTS
        one = ((at > 0.0) & (at <= 1.0)).astype(float) if self.held else np.maximum(1.0 - np.abs(at), 0.0)
        weights = self.of(one, dt / ROW_PARTS)[::ROW_PARTS]
        return np.asarray(scipy.ndimage.convolve1d(rows, weights / weights.sum(), axis=-1, mode="nearest"))

    def before(self, rows: Array, dt: float) -> Array:
        """The signal x that it made these ``rows`` y of, ``dt`` (s) apart, float64[rows].

        x = y + d y' + c d^2 y'', d the delay: exact for filters of first and second order, but for a spline's rates.
        """
        if not self.kind:
            return rows
        of_second = {"mean": 1.0 / 3.0, "first order": 0.0, "second order": 0.5}[self.kind]  # of 1/F
        rates = SplineRates(dt * np.arange(len(rows)))
        slope = rates(rows)
        return np.asarray(rows + self.delay * slope + of_second * self.delay**2 * rates(slope))

    def shown(self, t: Array) -> float:
        """Share of the RMS of white noise behind it that `noise_floor` shows in a log at ``t`` (s), at most 1.

        Noise that is alike from row to row looks like motion.
        """
        if not self.kind:
            return 1.0
        found = []
        for seed in range(NOISE_DRAWS):
            draw = np.random.default_rng(seed)
            ticks = np.tile(draw.standard_normal((len(t), 1 if self.held else 10)), (1, 10 if self.held else 1))
            noise = self.of(ticks, float(t[1] - t[0]) / 10.0)[:, -1]
            found.append(noise_floor(t, noise) / float(np.std(noise)))
        return min(1.0, float(np.mean(found)))

    def text(self) -> str:
        """What it is, as its data sheet would say it."""
        if not self.kind:
            return ""
        if self.kind == "mean":
            return f"a mean over {2e3 * self.delay:.3g} ms"
        corner = {"first order": 1.0, "second order": 2.0**0.5}[self.kind] / (2.0 * np.pi * self.delay)
        return f"a low-pass of {self.kind} of {corner:.3g} Hz"


AS_LOGGED = LowPass()


def _mean_of(x: Array, delay: float) -> Array:
    """Mean over the 2 ``delay`` ticks before."""
    width, at = max(2.0 * delay, 1.0), np.arange(len(x) + 1.0)
    total = np.concatenate([[0.0], np.cumsum(x)])
    before = np.interp(at[1:] - width, at, total) + x[0] * np.minimum(at[1:] - width, 0.0)
    return np.asarray((total[1:] - before) / width)


def _first_order(x: Array, delay: float) -> Array:
    share = 0.5 / (delay + 0.5)  # by the bilinear transformation
    return x[0] + lagged(0.5 * (x + np.concatenate([x[:1], x[:-1]])) - x[0], 2.0 * share)


def _second_order(x: Array, delay: float) -> Array:
    """A filter of Butterworth of the second order, whose delay is the root of 2 over its corner."""
    b, a = scipy.signal.butter(2, min(2.0**0.5 / max(delay, 1e-3) / np.pi, 0.99))
    return x[0] + np.asarray(scipy.signal.lfilter(b, a, x - x[0]))


# What a recorder may have before its analogue channels, of a delay in ticks.
LOW_PASSES: Mapping[str, Callable[[Array, float], Array]] = {
    "mean": _mean_of, "first order": _first_order, "second order": _second_order
}  # fmt: skip


@compiled
def lagged(x: Array, share: float) -> Array:
    """A lag that goes ``share`` of the way in each row, from 0."""
    out, y = np.empty(len(x)), 0.0
    for k in range(len(x)):
        y = share * x[k] - (share - 1.0) * y
        out[k] = y
    return out
