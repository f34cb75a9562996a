"""The error of a model in noise floors, as fits compare it: 0 where nothing was measured, far off where the model gives
no number.
"""

from __future__ import annotations

import math

import numpy as np

from vaneloop.base.compiled import compiled_free

__all__ = ["FAR", "whiten"]

FAR = 1e6  # noise floors: the error of a sample of which the model says nothing; no fit ends there


@compiled_free
def whiten(
    model: np.ndarray, measured: np.ndarray, counted: np.ndarray, floor: np.ndarray, starts: np.ndarray, out: np.ndarray
) -> None:
    """Fill out[set, output, sample] with (measured - model) / floor, less its mean over each window.

    model     [sets, outputs, samples]; a value that is not finite is off by `FAR`
    measured  [outputs, samples], finite
    counted   1.0 where a sample counts, else 0.0: [outputs, samples]
    floor     of each output
    starts    first samples of the windows; none: nothing is taken off
    """
    sets, outputs, n = model.shape
    for k in range(sets):
        for o in range(outputs):
            e, to_floor = out[k, o], 1.0 / floor[o]
            for i in range(n):
                error = measured[o, i] - model[k, o, i]
                e[i] = counted[o, i] * (error * to_floor if math.isfinite(error) else FAR)
            for w in range(len(starts)):
                end = starts[w + 1] if w + 1 < len(starts) else n
                total = many = 0.0
                for i in range(starts[w], end):
                    total += e[i]
                    many += counted[o, i]
                mean = total / max(many, 1.0)
                for i in range(starts[w], end):
                    e[i] -= mean * counted[o, i]
