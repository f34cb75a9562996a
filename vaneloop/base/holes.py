"""Where samples pause: nothing is drawn or made up across such a hole."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["holes"]

GAP = 10.0  # a pause this many times the usual distance is a hole
SHARE = 20  # a sample in so many may be followed by one: else the raster is irregular, not broken


def holes(t: NDArray[np.float64]) -> NDArray[np.intp]:
    """The samples after which ``t`` (rising) leaps by more than 10 times the usual distance.

    None where there are few samples, or where so many leap that the raster is irregular.
    """
    if t.size < 3:
        return np.empty(0, np.intp)
    step = np.diff(t)
    usual = float(np.median(step))
    found = np.flatnonzero(step > GAP * usual)
    return found if usual > 0 and found.size <= t.size // SHARE else found[:0]
