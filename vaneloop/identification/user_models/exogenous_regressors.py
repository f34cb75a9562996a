"""Quantities of which a law may be a function and which are known before a model runs: other columns of the log, time,
what follows from how a channel turns, and what it was before (`identification.user_models.hysteresis_regressors`).
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from plant.curve import TURN, turns
from vaneloop.base.durations import folded, in_name, period_in_name
from vaneloop.identification.subsystem import Array
from vaneloop.identification.user_models.hysteresis_regressors import STOPS, lagged, named_lag
from vaneloop.identification.user_models.motion import smoothed
from vaneloop.identification.user_models.system import Record

__all__ = ["DISTANCE", "MINUS", "SINCE", "TIME", "WAY", "column_of", "every", "sides_of"]

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
