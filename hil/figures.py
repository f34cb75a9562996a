"""How far a simulated signal is from its reference, in figures, and how much of that is only measurement noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vaneloop.base.errors import InputError

__all__ = ["AGREES", "SignalError", "error_figures", "noise_floor", "resolution", "resolution_before"]

Array = NDArray[np.float64]

# noise floors up to which an error counts as noise: floors are known to some per cent; vaneloop.identification.regimes
# has the same number
AGREES = 1.1
DESIGN_POINT = (99.0, 100.0)  # % of design speed, open interval: the range of the third figure of the paper's Table 5

WINDOW_S = 1.0  # s; long against sensor lags (milliseconds), short against a dwell of an engine run (several seconds)
WINDOW_SAMPLES = (64, 2048)  # fewest: a stable mean square; most: bounded work on fast rasters
LEVELS, MOST_PARTS = 100, 20  # of a channel that was rounded twice: fewest levels; most small steps in a large one
MAX_WINDOWS = 600  # a mean of this many windows is known to better than 1 %
PLATEAU_GROWTH = 1.08  # growth per doubling of the lag below which the noise counts as uncorrelated
# Noise behind a lag grows at most 1.5-fold per doubling, held samples twofold, noise behind a filter of the second
# order 2.8-fold, smooth motion eightfold.
MOTION_GROWTH, FILTER_GROWTH = 2.1, 3.0


@dataclass(frozen=True)
class SignalError:
    """Disagreement of one signal with its reference; all figures but `samples` are in `unit`.

    reference          ``measured`` (the log's own channel) or ``schedule`` (target at the measured speed)
    mean_abs_99_100    mean of |error| over 99 % < n_r < 100 %, None where the log has no such sample
    noise_floor        RMS of the reference's measurement noise: an RMS error at this level is a perfect model
    samples            samples in which the reference is finite
    """

    signal: str
    stage: str
    unit: str
    reference: str
    rms: float
    mean_abs: float
    max_abs: float
    mean_abs_99_100: float | None
    noise_floor: float
    samples: int


def error_figures(
    signal: str,
    stage: str,
    unit: str,
    reference: str,
    t: ArrayLike,
    model_values: ArrayLike,
    reference_values: ArrayLike,
    n_r: ArrayLike | None = None,
    noise_floor: float | None = None,
) -> SignalError:
    """Error of ``model_values`` against ``reference_values``, both on the raster ``t`` (s).

    n_r          rotor speed in % on the same raster, for the figure between 99 and 100 %
    noise_floor  in ``unit``; None: estimated by `noise_floor`, from ``reference_values`` or from the error, which holds
                 less motion where the model moves as the machine does: each is an upper bound

    Samples with a NaN or an infinity in the reference do not count. Raises InputError when none is left, where the
    model is no number at one that counts, or when the arrays differ in length.
    """
    times, model, ref = (np.asarray(a, dtype=float) for a in (t, model_values, reference_values))
    speed = None if n_r is None else np.asarray(n_r, dtype=float)
    for name, a in (("model", model), ("reference", ref), ("n_r", speed)):
        if a is not None and a.shape != times.shape:
            raise InputError(f"signal {signal!r}: {name} has {a.size} samples, must have {times.size} as its time has")
    good = np.isfinite(ref)
    samples = int(good.sum())
    if samples == 0:
        raise InputError(f"signal {signal!r}: no sample in which the {reference} value is finite; at least 1 is needed")
    silent = good & ~np.isfinite(model)
    if silent.any():
        raise InputError(
            f"signal {signal!r}: the model (={model[silent][0]}) at t = {times[silent][0]:g} s and in "
            f"{int(silent.sum())} of {samples} samples must be finite"
        )
    error = np.abs(model[good] - ref[good])
    at_design = None
    if speed is not None:
        n = speed[good]
        inside = (n > DESIGN_POINT[0]) & (n < DESIGN_POINT[1])
        if inside.any():
            at_design = float(error[inside].mean())
    if noise_floor is None:
        noise_floor = min(_noise_floor(times, ref), _noise_floor(times, ref - model))
    return SignalError(
        signal=signal,
        stage=stage,
        unit=unit,
        reference=reference,
        rms=float(np.sqrt(np.mean(error**2))),
        mean_abs=float(error.mean()),
        max_abs=float(error.max()),
        mean_abs_99_100=at_design,
        noise_floor=float(noise_floor),
        samples=samples,
    )


def noise_floor(t: ArrayLike, values: ArrayLike) -> float:
    """RMS of the measurement noise of one channel, estimated from the channel alone; same unit as ``values``.

    The motion of a machine is smooth over some samples, noise is not. Third differences at lag k,

        d_k[i] = y[i + 3k] - 3 y[i + 2k] + 3 y[i + k] - y[i],      s_k = sqrt(mean(d_k^2) / 20),

    remove any motion that is a parabola over 3k samples, and for white noise s_k is its RMS at every k (1 + 9 + 9 + 1 =
    20).

    1. The log is cut into windows of about 1 s. Windows with a gap or a NaN, and constant ones (a switched-off
       sensor), do not count. The half that moves least from its first to its last third holds the dwells.
    2. s_k is the median over these windows, so steps and spikes, which sit in a few windows, do not count.
    3. A sensor's lag correlates its noise, and s_1 is then too small (0.36 of the truth at 1 kHz behind a lag of 5 ms).
       The lag doubles until s_k stops growing: that plateau is the answer. Correlated noise grows at most 1.5-fold per
       doubling, a channel that holds each sample for several rows twofold, motion eightfold: where growth exceeds 2.1
       motion has taken over, and the last level before it is the answer. Behind a filter of the second order noise
       grows up to 2.8-fold, and then comes to a plateau.
    4. A quantised channel cannot be known better than q / sqrt(12): the answer is never below it.

    Limits: in a log that never dwells and whose raster is too slow for its motion, the answer is an upper bound. Noise
    correlated over more than about 1/16 of a window (0.06 s) is seen only in part. A motion as fast as the raster
    (limit cycle, vibration at a few samples per period) counts as noise. A constant channel gives 0.
    """
    times, y = np.asarray(t, dtype=float), np.asarray(values, dtype=float)
    if times.shape != y.shape:
        raise InputError(f"noise floor: {y.size} values for {times.size} times; the two must be equal in number")
    there = np.flatnonzero(np.isfinite(y))
    if there.size > 1 and np.median(np.diff(there)) >= 2.0:  # a slower channel on a faster raster
        times, y = times[there], y[there]
    q = resolution(y) / np.sqrt(12.0)
    windows = _dwell_windows(times, y)
    if windows.size == 0:
        return float(q)
    width = windows.shape[1]
    k, level = 1, _level(windows, 1)
    before_filter = None  # the level, where what follows may be motion as well
    while 12 * k <= width and level > 0.0:
        after = _level(windows, 2 * k)
        growth = after / level
        if growth < PLATEAU_GROWTH:
            return float(max(0.5 * (level + after), q))
        if growth > MOTION_GROWTH and before_filter is None:
            before_filter = level
        if growth > FILTER_GROWTH:
            break
        k, level = 2 * k, after
    return float(max(level if before_filter is None else before_filter, q))


_noise_floor = noise_floor  # `error_figures` has a parameter of that name


def resolution(values: ArrayLike) -> float:
    """Step q of a quantised channel: the spacing of which all differences between its values are multiples; 0 where
    there is none.
    """
    y = np.asarray(values, dtype=float)
    levels = np.unique(y[np.isfinite(y)])
    if levels.size < 2:
        return 0.0
    gaps = np.diff(levels)
    gaps = gaps[gaps > 1e-6 * np.abs(levels).max()]  # a value and its copy through float32 are the same level
    if gaps.size < 2:
        return float(gaps[0]) if gaps.size else 0.0
    q = float(gaps.min())
    multiples = gaps / q
    q *= float(np.mean(multiples[multiples < 1.5]))  # rounding averages out
    off_grid = np.abs(gaps / q - np.round(gaps / q))
    return q if np.mean(off_grid < 0.05) > 0.95 else 0.0


def resolution_before(values: ArrayLike) -> float:
    """Step q of a quantised channel that was rounded once more, to a step r of less than q: its values are multiples of
    q but for r / 2, and multiples of r. A bus, or a file's last digit, rounds so. 0 where there is none.
    """
    y = np.asarray(values, dtype=float)
    levels = np.unique(y[np.isfinite(y)])
    gaps = np.diff(levels)
    apart = gaps > 1e-6 * np.abs(levels).max(initial=0.0)
    gaps, levels = gaps[apart], levels[np.append(True, apart)] if len(gaps) else levels
    if gaps.size < LEVELS:
        return 0.0
    least = float(np.quantile(gaps, 0.01))
    parts = (least / m for m in range(1, MOST_PARTS + 1))
    r = next((p for p in parts if np.mean(np.abs(gaps / p - np.round(gaps / p)) < 0.05) > 0.95), 0.0)
    if r == 0.0:
        return 0.0
    q = float(np.mean(gaps[gaps < 1.51 * least]))
    for _ in range(2):  # the more levels, the better is q known, and how many steps lie between two of them
        number = np.concatenate([[0.0], np.cumsum(np.round(gaps / q))])
        q, start = np.polyfit(number, levels, 1)
    off = np.abs(levels - start - q * number)
    return float(q) if q > 1.5 * r and np.mean(off < 0.55 * r) > 0.95 else 0.0


def _level(windows: Array, k: int) -> float:
    """Median over the windows of the RMS that third differences at lag k show."""
    d = windows[:, 3 * k :] - 3.0 * windows[:, 2 * k : -k] + 3.0 * windows[:, k : -2 * k] - windows[:, : -3 * k]
    return float(np.sqrt(np.median(np.mean(d**2, axis=1)) / 20.0))


def _dwell_windows(t: Array, y: Array) -> Array:
    """Rows of consecutive samples in which the channel moves least: (windows, samples), may be empty."""
    n = y.size
    if n < 8:
        return np.empty((0, 0))
    dt = float(np.median(np.diff(t)))
    width = int(np.clip(round(WINDOW_S / dt) if dt > 0 else 0, *WINDOW_SAMPLES))
    width = min(width, n)
    starts = np.unique(np.linspace(0, n - width, min(MAX_WINDOWS, max(1, 2 * (n // width) - 1))).astype(int))
    rows = y[starts[:, None] + np.arange(width)]
    whole = np.isfinite(rows).all(axis=1) & (t[starts + width - 1] - t[starts] < 1.5 * width * dt)
    alive = np.ptp(rows, axis=1) > 0
    rows = rows[whole & alive]
    if rows.shape[0] < 4:
        return rows
    third = width // 3
    motion = np.abs(rows[:, -third:].mean(axis=1) - rows[:, :third].mean(axis=1))
    return rows[motion <= np.median(motion)]
