"""What a quantity of one engine does over time: does it change, since when, how fast, and when is it at its limit; and
is it unlike that of its sisters?

A quantity is the size of an effect, or a nominal parameter as recalibrated, log by log, at times t (years) with the
standard deviation s that each log gives.

    step     y = a + c [t >= T]                 something was exchanged at T
    growth   y = a + g max(t - T, 0)            wear sets in at T (T may be the beginning)

The logs of an engine may differ by more than s: then the scatter b beyond it is estimated with the curve. They may
differ by less: what a log claims beyond the scatter is wrong in all logs of the engine alike. It shifts the level, and
the level's interval has it in full. The growth is as uncertain as the scatter makes it, and no surer than such claims
are when they are averaged over the logs: logs without any scatter do not make it exact.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy
from numpy.typing import NDArray

from vaneloop.base.extras import needed

__all__ = ["Limit", "Trend", "limit_of", "odd", "trend"]

Array = NDArray[np.float64]
Kind = Literal["none", "growth", "step", "too few"]
LEAST = 8  # logs of an engine, below which nothing is said of change
LEVEL = 0.9  # of all intervals
HALF = float(scipy.special.ndtri(0.5 + LEVEL / 2))  # of such an interval, over a standard deviation
SURE = 1e-3  # probability of so good a fit without any change, below which a change is said to be there
HORIZON = 100.0  # years beyond which nobody asks
ODD = 0.01  # of the healthy engines that may be accused, at most


@dataclass(frozen=True)
class Limit:
    """When a quantity reaches its limit, years on the axis of the trend.

    low, high  90 % interval; high may be infinite
    why        why it cannot be told, in words; "": it can
    """

    time: float | None
    low: float | None
    high: float | None
    why: str = ""


@dataclass(frozen=True)
class Trend:
    """What one quantity of one engine does.

    onset, rate       time T (years) and growth g (1/year) or, of a step, its height; each with its 90 % interval
    start, now        level before the change and at the last log
    p                 probability of so good a fit without any change
    scatter           from log to log, beyond what the logs say of themselves
    lines             curves that fit about as well, a row each: T, a, g, variance of a, covariance, variance of g, how
                      many of their deviations still fit, by how much all logs alike may have a wrong, and how far g is
                      in doubt at least; the intervals are what all of them allow together
    """

    kind: Kind
    logs: int
    start: float = float("nan")
    now: float = float("nan")
    now_low: float = float("nan")
    now_high: float = float("nan")
    onset: float = float("nan")
    onset_low: float = float("nan")
    onset_high: float = float("nan")
    rate: float = float("nan")
    rate_low: float = float("nan")
    rate_high: float = float("nan")
    p: float = 1.0
    scatter: float = 0.0
    lines: Array | None = None


def trend(t: Array, y: Array, s: Array, sure: float = SURE, told: NDArray[np.bool_] | None = None) -> Trend:
    """The change of a quantity with time, if there is one.

    t     years, any order; y  the quantity; s  standard deviation of each y
    sure  probability of so good a fit without any change, below which a change is said to be there
    told  which logs tell the value; the others only that it is y within s, and nothing of the scatter (default: all do)
    """
    order = np.argsort(t, kind="stable")
    told = np.ones(len(t), dtype=bool) if told is None else np.asarray(told)[order]
    t, y, s = (np.asarray(v, dtype=float)[order] for v in (t, y, s))
    n = len(t)
    if n < LEAST or t[-1] <= t[0]:
        return Trend("too few", n)
    b = _scatter(t[told], y[told], s[told])
    w = 1.0 / np.maximum(s**2 + np.where(told, b, 0.0) ** 2, 1e-100)
    level = float(np.average(y, weights=w))
    rest = float(np.sum(w * (y - level) ** 2))
    fits = {kind: _fitted(kind, t, y, w, _candidates(t, kind)) for kind in ("growth", "step")}
    kind = min(fits, key=lambda k: float(fits[k][:, 3].min()))
    left = float(fits[kind][:, 3].min())
    # three numbers against one; two shapes, and T chosen among many, make chance fits six times as probable (simulated)
    gain = (rest - left) / 3.0 / max(left / (n - 3), 1e-300)
    p = min(1.0, 6.0 * float(scipy.stats.f.sf(gain, 3, n - 3)))
    if p >= sure or not _by_ruptures(t, y):
        half = float(scipy.stats.t.ppf(0.5 + LEVEL / 2, n - 1) * np.sqrt(rest / (n - 1) / w.sum()))
        return Trend("none", n, level, level, level - half, level + half, p=p, scatter=b)
    return _changed(kind, p, b, t, y, w, fits[kind], told)


def _changed(
    kind: str, p: float, b: float, t: Array, y: Array, w: Array, fits: Array, told: NDArray[np.bool_]
) -> Trend:
    """The trend with a change: numbers and intervals."""
    n = len(t)
    for _ in range(3 if kind == "growth" else 0):  # a finer look around the best, between the times beside it
        fits = fits[np.argsort(fits[:, 0], kind="stable")]
        (near,) = np.nonzero(fits[:, 3] <= fits[:, 3].min() * (1.0 + 12.0 / (n - 3)))
        ends = fits[[max(near[0] - 1, 0), min(near[-1] + 1, len(fits) - 1)], 0]
        fits = np.concatenate([fits, _fitted(kind, t, y, w, np.linspace(ends[0], ends[1], 60))])
    T, a, g, left = fits[np.argmin(fits[:, 3]), :4]
    line = a + g * (np.maximum(t - T, 0.0) if kind == "growth" else (t >= T))
    # what scatters are the logs that tell a value; beside others, which know the level before, they have g and T to fit
    freedom = max(int(told.sum()) - (3 if told.all() else 2), 1)
    squares = float(np.sum((w * (y - line) ** 2)[told]))
    sigma2 = squares / freedom  # of weight 1: 1 where logs scatter as they say of themselves
    room = float(scipy.stats.f.ppf(LEVEL, 1, freedom)) - (fits[:, 3] - left) / max(sigma2, 1e-300)
    kept, q = fits[room >= 0.0], np.sqrt(room[room >= 0.0])
    most = squares / float(scipy.stats.chi2.ppf(1.0 - LEVEL, freedom))  # scatter that chance allows
    alike = np.sqrt(max(1.0 - most, 0.0) * told.sum() / w[told].sum())
    full = np.maximum(t[-1] - kept[:, 0], 1e-9) if kind == "growth" else np.ones(len(kept))
    wrong = np.column_stack([np.full(len(kept), alike), alike / np.sqrt(told.sum()) / full]) * HALF
    lines = np.column_stack([kept[:, :3], kept[:, 4:] * sigma2, q, wrong])
    rate, half = lines[:, 2], np.maximum(q * np.sqrt(lines[:, 5]), lines[:, 8])
    now, now_half = _along(lines, t[-1] - lines[:, 0] if kind == "growth" else np.ones(len(lines)))
    end = float(a + g * (t[-1] - T if kind == "growth" else 1.0))
    return Trend(
        "growth" if kind == "growth" else "step", n, float(a), end, float((now - now_half).min()),
        float((now + now_half).max()), float(T), float(lines[:, 0].min()), float(lines[:, 0].max()), float(g),
        float((rate - half).min()), float((rate + half).max()), p, b, lines,
    )  # fmt: skip


def _along(lines: Array, late: Array) -> tuple[Array, Array]:
    """Level of each line at ``late`` years after its beginning, and half its interval."""
    _, a, g, vaa, vag, vgg, q, level, growth = lines.T
    own = q * np.sqrt(np.maximum(vaa + 2.0 * late * vag + late**2 * vgg, 0.0))
    return a + g * late, np.hypot(np.maximum(own, late * growth), level)


def limit_of(found: Trend, t_last: float, limit: float) -> Limit:
    """When a growing quantity reaches ``limit``: years on the trend's axis, with a 90 % interval after Fieller.

    The interval is that of the line through the present level with the present growth, both uncertain together; it is
    open at its end where growth might be zero.
    """
    if found.kind == "too few":
        return Limit(None, None, None, f"{found.logs} logs with a known time are too few, {LEAST} are needed")
    if found.kind != "growth":
        return Limit(None, None, None, "it does not grow" if found.kind == "none" else "it has changed in one step")
    if (limit - found.now) * found.rate <= 0:
        past = (limit - found.start) * found.rate > 0
        return Limit(t_last, None, None, "it is beyond its limit") if past else Limit(
            None, None, None, "it grows away from its limit"
        )  # fmt: skip
    time = t_last + (limit - found.now) / found.rate
    assert found.lines is not None
    sign, low, high = np.sign(found.rate), np.inf, 0.0
    for years in np.geomspace(1e-3, HORIZON, 2000):
        y, half = _along(found.lines, t_last + years - found.lines[:, 0])
        if low == np.inf and np.any(sign * (y - limit) + half >= 0.0):
            low = years
        if np.all(sign * (y - limit) - half >= 0.0):
            high = years
            break
    return Limit(
        time, t_last + low, t_last + high if high else float("inf"),
        "" if high else "its growth is not sure enough for a latest time",
    )  # fmt: skip


def odd(values: Sequence[float] | Array, spread: Sequence[float] | Array | None = None, tests: int = 1) -> Array:
    """Probability that a healthy engine is as far from its sisters as each of these, over ``tests`` quantities.

    The sisters' level and scatter are their median and quartiles, so that some odd ones do not hide each other; each
    engine is compared with the others only. spread: standard deviation of each value itself.
    """
    v = np.asarray(values, dtype=float)
    out = np.ones(len(v))
    for i in range(len(v)):
        others = np.delete(v, i)
        others = others[np.isfinite(others)]
        if len(others) < 5 or not np.isfinite(v[i]):
            continue
        centre = float(np.median(others))
        # the median of |x - m| over 0.6745 is the standard deviation of a bell; few sisters know it badly: a t with
        # fewer degrees of freedom (0.37: the efficiency of this estimate)
        scale = float(np.median(np.abs(others - centre))) / 0.6745 * (1.0 + 0.8 / len(others))
        own = 0.0 if spread is None else float(np.asarray(spread, dtype=float)[i])
        width = float(np.hypot(scale * np.sqrt(1.0 + 1.57 / len(others)), own))
        if width > 0.0:
            freedom = max(0.37 * (len(others) - 1), 2.0)
            out[i] = min(1.0, 2.0 * float(scipy.stats.t.sf(abs(v[i] - centre) / width, freedom)) * tests)
        elif v[i] != centre:
            out[i] = 0.0
    return out


# ---- least squares ---------------------------------------------------------------------------------------------------


def _fitted(kind: str, t: Array, y: Array, w: Array, at: Array) -> Array:
    """The curve with its change at each of these times, by weighted least squares: a row each of T, a, g, weighted
    squares left, and the variances and covariance of a and g over that of unit weight.
    """
    late = np.maximum(t - at[:, None], 0.0) if kind == "growth" else (t >= at[:, None]).astype(float)
    mean = float(np.average(y, weights=w))
    sw, sl, sll, sly = w.sum(), late @ w, late**2 @ w, late @ (w * (y - mean))
    det = np.maximum(sw * sll - sl**2, 1e-300)
    g = sw * sly / det
    left = np.maximum(np.sum(w * (y - mean) ** 2) - g * sly, 0.0)
    return np.column_stack([at, mean - g * sl / sw, g, left, sll / det, -sl / det, sw / det])


def _straight(x: Array, y: Array) -> float:
    """Squares that a straight line over x leaves."""
    dx, dy = x - x.mean(), y - y.mean()
    return float(dy @ dy - (dx @ dy) ** 2 / max(float(dx @ dx), 1e-300))


def _candidates(t: Array, kind: str) -> Array:
    """Times at which a change may have begun: at least three logs stand on each side (a growth may begin at once)."""
    if kind == "step":
        return 0.5 * (t[2:-3] + t[3:-2])
    return np.concatenate([[t[0]], np.linspace(t[2], t[-3], 120)])


def _scatter(t: Array, y: Array, s: Array) -> float:
    """Scatter from log to log beyond s: from second differences, which a slow change leaves out, by their median."""
    if len(t) < 4:
        return 0.0
    left, right = t[1:-1] - t[:-2], t[2:] - t[1:-1]
    share = np.divide(left, left + right, out=np.full(len(left), 0.5), where=left + right > 0)
    bend = y[1:-1] - (1.0 - share) * y[:-2] - share * y[2:]
    gain = 1.0 + (1.0 - share) ** 2 + share**2
    variance = (float(np.median(np.abs(bend) / np.sqrt(gain))) / 0.6745) ** 2
    return float(np.sqrt(max(variance - float(np.median(s**2)), 0.0)))


def _by_ruptures(t: Array, y: Array) -> bool:
    """Whether a search for change points (ruptures, exact, of level and slope) finds one too.

    It takes none of the two shapes for granted: what only one bad log makes look like a change, it leaves alone.
    """
    ruptures = needed("vaneloop fleet", "ruptures")
    z, n = y - y.mean(), len(y)
    flat, line = float(np.sum(z**2)), _straight(t, z)
    if line < flat - 2.0 * np.log(n) * line / (n - 2):
        return True  # it has changed all along
    signal = np.column_stack([z, np.ones(n), (t - t[0]) / (t[-1] - t[0])])
    ends = ruptures.Dynp(model="linear", min_size=3, jump=max(1, n // 60)).fit(signal).predict(n_bkps=1)
    left = sum(_straight(t[part], z[part]) for part in (slice(0, ends[0]), slice(ends[0], n)))
    return bool(left < flat - 3.0 * np.log(n) * left / (n - 4))
