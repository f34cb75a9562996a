"""Quantities of which a law may be a function and which are known before a model runs: other columns of the log, time,
what follows from how a channel turns, and what it was before.
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from plant.curve import TURN, turns
from vaneloop.base.compiled import compiled
from vaneloop.base.durations import folded, in_name, named_lag, period_in_name
from vaneloop.base.hysteresis import STOPS, slipped, weights_of
from vaneloop.identification.settings import BEFORE_LOG, COARSE_STOPS, NO_TURN
from vaneloop.identification.subsystem import Array
from vaneloop.identification.user_models.motion import smoothed
from vaneloop.identification.user_models.system import Record

__all__ = [
    "DISTANCE", "MINUS", "SINCE", "STOPS", "TIME", "WAY", "column_of", "every", "forgotten", "is_memory", "lagged",
    "lagged_name", "named_lag", "of_stops", "share_given_back", "sides_of", "swings",
]  # fmt: skip

TIME = "time"
MINUS = "_minus_"
WAY, DISTANCE, SINCE = "direction_of_", "distance_since_reversal_of_", "time_since_reversal_of_"


def every(period: float, cycles: float, channel: str = TIME) -> str:
    """Name of what a channel is within each ``period`` (s, or in its unit), to as many digits as so many ``cycles``
    tell.
    """
    digits = max(int(np.ceil(np.log10(200.0 * cycles))), 4)
    return f"{channel}_every_{(in_name if channel == TIME else period_in_name)(period, digits)}"


def sides_of(name: str, known: Collection[str]) -> tuple[str, str] | None:
    """Of a difference ``ONE_minus_OTHER`` of quantities that are ``known``, both names; None: it is none, or the name
    of a quantity itself.
    """
    if name in known:
        return None
    words = name.split(MINUS)
    pairs = ((MINUS.join(words[:k]), MINUS.join(words[k:])) for k in range(1, len(words)))
    return next((pair for pair in pairs if pair[0] in known and pair[1] in known), None)


def column_of(record: Record, t: Array, name: str) -> Array:
    """Values of a quantity on a record, float64[samples]; ``t``: s, as the log counts."""
    if name == TIME:
        return t
    if name not in record.columns and (found := folded(name)):
        return column_of(record, t, found[0]) % found[1]
    for prefix, which in ((WAY, 0), (DISTANCE, 1), (SINCE, 2)):
        if name.startswith(prefix) and name not in record.columns:
            return _turns(t, _filled(record.columns[name.removeprefix(prefix)]))[which]
    if name.startswith(STOPS) and name not in record.columns:  # how they slip is a matter of the curve
        return _filled(record.columns[name.removeprefix(STOPS)])
    if name not in record.columns and (lag := named_lag(name)):
        return np.asarray(lagged(np.ascontiguousarray(t, dtype=float), _filled(record.columns[lag[0]]), lag[1]))
    return _filled(record.columns[name])


def _filled(y: Array) -> Array:
    """A channel with its gaps bridged."""
    good = np.isfinite(y)
    k = np.arange(len(y))
    return np.interp(k, k[good], y[good]) if good.any() else np.zeros(len(y))


def _turns(t: Array, y: Array) -> Array:
    x = smoothed(t, y) if np.ptp(y) > 0.0 and len(y) > 100 else y
    return np.asarray(turns(np.ascontiguousarray(x), np.ascontiguousarray(t), TURN * float(np.ptp(x))))


# ---- What remembers: what a channel was a while ago, and how far it has gone since each of its turns
#
# A lag is one of first order. A hysteresis is a sum of stops (`vaneloop.base.hysteresis`), known by its virgin curve
# alone. A curve that bends down has stops of positive weight. It can then be learned, drawn, stored and put into a
# formula as every other curve.


def is_memory(name: str) -> bool:
    """Whether a quantity's name is that of a lag, or of stops."""
    return name.startswith(STOPS) or named_lag(name) is not None


def lagged_name(channel: str, tau: float) -> str:
    """Name of a channel lagged by ``tau`` (s), to three digits."""
    return f"{channel}_lagged_by_{in_name(tau, 3)}"


@compiled
def lagged(t: np.ndarray, q: np.ndarray, tau: float) -> np.ndarray:
    """A channel ``q`` at times ``t`` (s) through a first-order lag that starts settled; straight between samples."""
    out = np.empty(len(q))
    y = out[0] = q[0]
    for k in range(1, len(q)):
        z = (t[k] - t[k - 1]) / tau
        keep = np.exp(-z)
        slope = (q[k] - q[k - 1]) / z if z > 0.0 else 0.0
        y = out[k] = q[k] - slope + (y - q[k - 1] + slope) * keep
    return out


def of_stops(q: Array, low: float, high: float, table: Array) -> Array:
    """What the hysteresis with this virgin curve makes of a channel ``q``, which starts at rest; float64[samples]."""
    return np.asarray(slipped(np.ascontiguousarray(q, dtype=float), high, weights_of(low, high, table)))


def share_given_back(low: float, high: float, table: Array) -> float:
    """Share of the stops of a virgin curve, seen coarsely, that give energy: those whose weight has the rarer sign.
    Stops with weights of one sign only take energy. Infinite where there are none.
    """
    weights = weights_of(low, high, table, COARSE_STOPS)[:-1]  # the last one stands for all that is wider
    size = float(np.abs(weights).sum())
    least = float(min(np.maximum(weights, 0.0).sum(), np.maximum(-weights, 0.0).sum()))
    return least / size if size > 0.0 else np.inf


def forgotten(q: Array, high: float, table: Array) -> Array:
    """Where a hysteresis with this virgin curve, from 0 to ``high``, has forgotten what its channel ``q`` did before;
    bool[samples].

    A channel that has gone a way R from one end to the other has moved stops of radius R / 2 to where they stand after
    any start. What wider ones give is the rest of the virgin curve: how far it goes on from its height at R / 2.
    """
    way = np.maximum.accumulate(q) - np.minimum.accumulate(q)
    highest, lowest = (f.accumulate(table[::-1])[::-1] for f in (np.maximum, np.minimum))
    rest = np.interp(0.5 * way, np.linspace(0.0, high, len(table)), np.maximum(highest - table, table - lowest))
    return np.asarray(np.maximum.accumulate(rest <= BEFORE_LOG * np.max(np.abs(table))))


def swings(q: Array) -> Array:
    """Of each sample of a channel, how far it goes from the turn before to the turn after; float64[samples].

    It has turned where it goes back by more than `NO_TURN` of its whole way. What the log cuts off, before the first
    turn and after the last, is as wide as the next swing at least.
    """
    least = NO_TURN * float(np.ptp(q))
    high = low = heads = 0
    turns: list[int] = []
    for k, v in enumerate(q.tolist()):
        high, low = (k if v > q[high] else high), (k if v < q[low] else low)
        if heads >= 0 and q[high] - v > least:
            turns.append(high)
            heads, low = -1, k
        elif heads <= 0 and v - q[low] > least:
            turns.append(low)
            heads, high = 1, k
    if not turns:
        return np.zeros(len(q))
    turns.append(len(q) - 1)
    wide = np.abs(np.diff(q[turns]))
    wide[[0, -1]] = wide[:2].max(), wide[-2:].max()
    return np.repeat(wide, np.diff([0, *turns[1:-1], len(q)]))
