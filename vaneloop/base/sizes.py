"""Numbers that fits can square: what is smaller than any measured quantity is zero, what is larger is none.

A fit multiplies squares of what is measured. Of 1e-160 the square is 0, of 1e160 it is infinite, and no equation that
holds either has a solution. The border, 1e-60 and 1e60 in whatever unit, is far beyond any quantity that is measured.
"""

from __future__ import annotations

import numpy as np

__all__ = ["LARGEST", "SMALLEST", "beyond", "no_smaller"]

SMALLEST, LARGEST = 1e-60, 1e60


def no_smaller(values: np.ndarray) -> np.ndarray:
    """The values with 0 for what is smaller than `SMALLEST`; the same array where nothing is."""
    small = (np.abs(values) < SMALLEST) & (values != 0.0)
    return np.where(small, 0.0, values) if small.any() else values


def beyond(values: np.ndarray) -> np.ndarray:
    """Which values are larger than `LARGEST`: bool[n]."""
    return np.asarray(np.abs(values) > LARGEST)
