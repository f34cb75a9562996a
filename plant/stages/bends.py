"""Curves where the controller acts: on its demand and its current."""

from __future__ import annotations

import numpy as np

from plant import curve
from vaneloop.base.compiled import compiled_free

__all__ = ["run_bends"]


@compiled_free
def run_bends(known: np.ndarray, p: np.ndarray, s: np.ndarray, site: int, out: np.ndarray) -> None:
    """Fill out[lane, k] with the sum of each lane's curves at a ``site``, SI, at the signals ``known`` of sample k."""
    for j in range(p.shape[1]):
        for k in range(known.shape[1]):
            curve.take(s, p, j, known, k, k)
            out[j, k] = curve.bend(s, p, j, site)
