"""Time in place of the oil's temperature, and the other way round: where both run alike, a log cannot tell which of
them an effect follows.
"""

from __future__ import annotations

import numpy as np

from vaneloop.discrepancy.stage import Array

__all__ = ["like_temperature", "like_time"]


def like_time(t: Array, t_oil: Array) -> Array:
    """A temperature (degC) that goes straight with time, as far up or down as the oil's went."""
    if np.ptp(t_oil) == 0.0:
        return np.linspace(-0.5, 0.5, len(t)) + t_oil[0]
    sign = 1.0 if np.corrcoef(t, t_oil)[0, 1] >= 0.0 else -1.0
    return np.asarray(t_oil.mean() + sign * np.ptp(t_oil) * ((t - t[0]) / np.ptp(t) - 0.5))


def like_temperature(t: Array, t_oil: Array) -> Array:
    """A time (s) that goes with the oil's temperature, over the same span; time itself where the temperature is not
    known to change.
    """
    return t if np.ptp(t_oil) == 0.0 else np.asarray(t[0] + np.ptp(t) * (t_oil - t_oil.min()) / np.ptp(t_oil))
