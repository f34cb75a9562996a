"""Ordinary loggers: what other people's recorders do to a log between the sensor and the file, drawn for every log.

The rig writes what its sensors and its controller give, a row each 1 ms. A logger takes rows of its own from that: at
its rate, each the value at an instant or the mean over a window, behind an anti-alias filter, some channels through
another clock, in steps of a resolution, with hum and coloured noise of its own, with rows that repeat the last one, and
without channels that nobody wired.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy

from hil.logs import Channel
from vaneloop.base.vanes import VANES

__all__ = ["GROUPS", "KINDS", "Logger", "draw", "recorded"]

FINE = 1e-3  # s, the rig's rows
RATES = (10, 20, 25, 50, 100, 200, 500, 1000)  # Hz
GROUPS = {"bus": ("n_dem", "x_dem", "state"), "controller": ("n_r", "x_lvdt", "i_cmd"), "vanes": VANES}
DIGITAL = ("n_dem", "x_dem", "state")  # come in frames: no filter, no noise
NOISE = {"n_r": 0.02, "x_lvdt": 0.01, "i_cmd": 0.02, **dict.fromkeys(VANES, 0.02)}  # usual noise, border units
RESOLUTIONS = {
    "n_dem": 0.01, "n_r": 0.01, "x_dem": 0.01, "x_lvdt": 0.01, "i_cmd": 0.01, "p_s": 0.01, "t_oil": 0.1,
    **dict.fromkeys(VANES, 0.01),
}  # fmt: skip
EACH = 0.3  # chance of everything that a recorder may do
KINDS = ("rate", "window", "offset", "drift", "filter", "resolution", "stale", "hum", "colour", "missing")


@dataclass(frozen=True)
class Logger:
    """One recorder.

    rate        rows a second
    window      s over which a row is the mean; 0: the value at an instant
    offset      s by which each group's samples are late in the file
    drift       share by which the clock of the vanes' recorder is fast
    filter      order (1, 2; 0: none) and corner (Hz) of the low-pass before each analogue channel
    resolution  number of usual last digits: 1, 2 or 5; 0: all digits
    stale       share of rows that begin a stretch of repeated rows, and the longest such stretch
    hum         Hz and amplitude in usual noises of each analogue channel
    colour      correlation time (s) of added noise, and its RMS in usual noises
    missing     channels that are not there
    """

    rate: int = 100
    window: float = 0.0
    offset: Mapping[str, float] | None = None
    drift: float = 0.0
    filter: tuple[int, float] = (0, 0.0)
    resolution: float = 0.0
    stale: tuple[float, int] = (0.0, 0)
    hum: tuple[float, float] = (0.0, 0.0)
    colour: tuple[float, float] = (0.0, 0.0)
    missing: tuple[str, ...] = ()


def draw(rng: np.random.Generator, kinds: tuple[str, ...] = KINDS) -> Logger:
    """Draw a recorder: its rate, and each other of ``kinds`` in `EACH` of the cases."""
    rate = int(rng.choice(RATES))
    rate = rate if "rate" in kinds else 100
    window = float(rng.choice([0.0, 1.0 / rate, rng.uniform(0.2, 2.0) / rate]))
    offset = {g: float(round(rng.uniform(-0.02, 0.02), 4)) if rng.random() < 0.5 else 0.0 for g in GROUPS}
    drift = float(rng.normal(0.0, 3e-5))
    order, corner = int(rng.choice([0, 1, 2])), float(rng.uniform(0.2, 0.5) * rate)
    resolution = float(rng.choice([0.0, 1.0, 2.0, 5.0]))
    stale = (float(rng.choice([0.0, 2e-4, 1e-3])), int(rng.integers(5, 40)))
    hum = (float(rng.choice([50.0, 60.0, 400.0])), float(rng.choice([0.0, 0.5, 2.0])))
    colour = (float(10.0 ** rng.uniform(-2.0, 0.5)), float(rng.choice([0.0, 0.5, 1.0])))
    missing = tuple(c for c in ("p_s", "t_oil") if rng.random() < 0.25)
    whole: dict[str, Any] = {
        "window": window, "offset": offset, "drift": drift, "filter": (order, corner), "resolution": resolution,
        "stale": stale, "hum": hum, "colour": colour, "missing": missing,
    }  # fmt: skip
    does = {k for k, drawn in zip(KINDS, rng.random(len(KINDS)) < EACH, strict=True) if drawn and k in kinds}
    return Logger(rate, **{k: v for k, v in whole.items() if k in does})


def recorded(
    log: Mapping[str, np.ndarray], logger: Logger, rng: np.random.Generator, gaps: Sequence[tuple[float, float]] = ()
) -> dict[str, Channel]:
    """What ``logger`` writes of a log with a row each 1 ms: channel -> its samples.

    gaps  (start, length), s: stretches whose rows it loses
    """
    t = np.arange(len(next(iter(log.values())))) * FINE
    step = 1.0 / logger.rate
    at = np.arange(round(0.05 / FINE), len(t) - round(0.05 / FINE), round(step / FINE))
    group = {c: g for g, names in GROUPS.items() for c in names}
    stale = _stale(len(at), *logger.stale, rng)
    kept = np.ones(len(at), dtype=bool)
    for start, length in gaps:
        kept &= (t[at] < start) | (t[at] >= start + length)
    out = {}
    for name, values in log.items():
        if name == "t" or name in logger.missing:
            continue
        v = np.asarray(values, dtype=float)
        if name in NOISE:
            v = _analogue(v, t, NOISE[name], logger, rng)
        late = round((logger.offset or {}).get(group.get(name, "controller"), 0.0) / FINE)
        speed = 1.0 + (logger.drift if group.get(name) == "vanes" else 0.0)
        i = np.clip(np.round(at * speed).astype(int) - late, 0, len(t) - 1)
        if logger.window > 0.0 and name not in DIGITAL:
            n = max(1, round(logger.window / FINE))
            total = np.concatenate([[0.0], np.cumsum(v)])
            first = np.maximum(i + 1 - n, 0)
            v = (total[i + 1] - total[first]) / (i + 1 - first)
        else:
            v = v[i]
        if logger.resolution and name in RESOLUTIONS:
            d = logger.resolution * RESOLUTIONS[name]
            v = np.round(v / d) * d
        out[name] = Channel(t[at][kept], v[stale][kept])
    return out


def _analogue(v: np.ndarray, t: np.ndarray, noise: float, logger: Logger, rng: np.random.Generator) -> np.ndarray:
    """An analogue channel with the recorder's hum and coloured noise, behind its low-pass."""
    frequency, size = logger.hum
    if size:
        v = v + size * noise * np.sin(2.0 * np.pi * (frequency * t + rng.random()))
    tau, size = logger.colour
    if size:
        a = np.exp(-FINE / tau)
        white = rng.standard_normal(len(t)) * size * noise * np.sqrt(1.0 - a * a)
        v = v + scipy.signal.lfilter([1.0], [1.0, -a], white)
    order, corner = logger.filter
    if order:
        b, a = scipy.signal.butter(order, min(corner / (0.5 / FINE), 0.99))
        v = scipy.signal.lfilter(b, a, v, zi=scipy.signal.lfilter_zi(b, a) * v[0])[0]
    return v


def _stale(rows: int, share: float, longest: int, rng: np.random.Generator) -> np.ndarray:
    """The row that each row repeats: mostly itself."""
    of = np.arange(rows)
    for first in np.flatnonzero(rng.random(rows) < share):
        of[first : first + int(rng.integers(2, longest + 1))] = first
    return of
