"""The hum of the mains in a log: a line in the spectrum of every analogue channel, wherever its rate aliases it to.

What the machine does reaches some channels and not all at once: nothing that swings in the linkage, the actuator or the
servo loop does so in the rotor speed, and what the demand makes swing swings in the demand. So a line that stands out
of the noise of every analogue channel, at one frequency, and not of a command, is the recorder's. It is taken out
before the search looks for physics::

    z = third difference of a channel over its rows,  P(f) = |FFT z|^2 / median of it nearby
    hum: P(f) > ln(rows / HUM_CHANCE) / ln 2  in every channel, in no command     (of noise P ln 2 is exponential)
    taken out of each channel: a cos(2 pi f t) + b sin(2 pi f t), least squares of z, f where most goes

The clocks of two recorders differ, so that f is refined in each channel within two bins. An alias of less than a few
periods in the log cannot be told from a constant or a drift, and stays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy

from hil.logs import Channel, Log
from hil.logs.notes import Note
from vaneloop.base.signals import UNITS
from vaneloop.base.vanes import VANES
from vaneloop.identification.settings import HUM_CHANCE, HUM_LINES, HUM_NEARBY
from vaneloop.identification.subsystem import Array
from vaneloop.identification.vane_chain.resample import DEMANDS

__all__ = ["without_hum"]

ANALOGUE = ("n_r", "x_lvdt", "i_cmd", *VANES)


def without_hum(log: Log) -> Log:
    """The log without the lines that all of its analogue channels have, with a note of each; the log itself where there
    is none.
    """
    names = [c for c in ANALOGUE if c in log.channels and not log.channels[c].framed and len(log.channels[c].t) > 1000]
    commands = [log.channels[c] for c in DEMANDS if c in log.channels and len(log.channels[c].t) > 1]
    if len(names) < 3 or "n_r" not in names or not commands:
        return log
    step = float(np.median(np.diff(log.channels[names[0]].t)))
    channels, notes = dict(log.channels), []
    for _ in range(HUM_LINES):
        at = _common_line([channels[c] for c in names], commands, step)
        if at is None:
            break
        sizes = []
        for name in names:
            c = channels[name]
            line = _line(c, at, step)
            channels[name] = replace(c, values=c.values - line)
            sizes.append(f"{name} {float(np.sqrt(2.0 * np.mean(line**2))):.2g} {UNITS[name]}")
        notes.append(Note(f"{', '.join(names)}: a line at {at:.4g} Hz in all of them is a recorder's hum, or its alias "
                          f"({', '.join(sizes)}); taken out", "converted", ", ".join(names)))  # fmt: skip
    return replace(log, channels=channels, notes=[*log.notes, *notes]) if notes else log


def _third(c: Channel, step: float) -> tuple[Array, Array]:
    """Third differences of a channel, and at which of its rows they are: where four rows follow each other."""
    whole = np.abs(np.diff(c.t) - step) < 0.3 * step
    good = whole[:-2] & whole[1:-1] & whole[2:]
    return np.where(good, np.diff(c.values, 3), 0.0), good


def _common_line(channels: Sequence[Channel], commands: Sequence[Channel], step: float) -> float | None:
    """Frequency (Hz) of the line that stands out most in all of the channels and in no command; None: there is none."""
    first = min(c.t[0] for c in channels)
    rows = round((max(c.t[-1] for c in channels) - first) / step) + 1
    stands_out = np.log(rows / HUM_CHANCE) / np.log(2.0)
    least = np.full(rows // 2 + 1, np.inf)
    for c in channels:
        z, _ = _third(c, step)
        even = np.zeros(rows)
        even[np.clip(np.rint((c.t[:-3] - first) / step).astype(int), 0, rows - 1)] = z
        least = np.minimum(least, _power(even))
    least[:4] = 0.0
    if least.max() <= stands_out:
        return None
    for c in commands:
        held = c.values[np.maximum(np.searchsorted(c.t, first + step * np.arange(rows), side="right") - 1, 0)]
        least[_power(np.diff(held, 3, append=held[-3:])) > stands_out] = 0.0
    k = int(np.argmax(least))
    return k / (rows * step) if least[k] > stands_out else None


def _power(z: Array) -> Array:
    """Spectrum of rows, in medians of what is nearby; the clocks of two recorders differ: the largest of three bins."""
    power = scipy.ndimage.maximum_filter1d(np.abs(np.fft.rfft(z)) ** 2, 3)
    nearby = scipy.ndimage.median_filter(power, HUM_NEARBY, mode="nearest")
    return np.asarray(power / np.maximum(nearby, 1e-12 * float(power.max()) + 1e-300))


def _line(c: Channel, frequency: float, step: float) -> Array:
    """The line of a channel near a ``frequency`` (Hz), as of its samples: least squares of its third differences."""
    z, good = _third(c, step)
    t = c.t - c.t[0]
    bin_ = 1.0 / max(t[-1], step)

    def fitted(f: float) -> tuple[float, Array]:
        waves = np.array([np.cos(2.0 * np.pi * f * t), np.sin(2.0 * np.pi * f * t)])
        a = np.where(good, np.diff(waves, 3, axis=1), 0.0)
        size = np.linalg.lstsq(a @ a.T, a @ z, rcond=1e-9)[0]
        return float(size @ (a @ z)), size @ waves

    tried = frequency + bin_ * np.linspace(-2.0, 2.0, 17)
    for width in (0.25, 0.05, 0.01):
        best = max(tried, key=lambda f: fitted(f)[0])
        tried = best + bin_ * width * np.linspace(-1.0, 1.0, 11)
    return fitted(max(tried, key=lambda f: fitted(f)[0]))[1]
