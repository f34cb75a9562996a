"""The error of a model in noise floors, as fits compare it: 0 where nothing was measured, far off where the model gives
no number.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from vaneloop.base.compiled import compiled_free
from vaneloop.identification.settings import KEPT_ERRORS, NO_ANSWER_ERROR
from vaneloop.identification.subsystem import Array

__all__ = ["ResidualCache", "normalise_residuals", "whiten_unlogged"]


@compiled_free
def normalise_residuals(
    model: np.ndarray, measured: np.ndarray, counted: np.ndarray, floor: np.ndarray, starts: np.ndarray, out: np.ndarray
) -> None:
    """Fill out[set, output, sample] with (measured - model) / floor, less its mean over each window.

    model     [sets, outputs, samples]; a value that is not finite is off by `NO_ANSWER_ERROR`
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
                e[i] = counted[o, i] * (error * to_floor if math.isfinite(error) else NO_ANSWER_ERROR)
            for w in range(len(starts)):
                end = starts[w + 1] if w + 1 < len(starts) else n
                total = many = 0.0
                for i in range(starts[w], end):
                    total += e[i]
                    many += counted[o, i]
                mean = total / max(many, 1.0)
                for i in range(starts[w], end):
                    e[i] -= mean * counted[o, i]


@compiled_free
def whiten_unlogged(errors: np.ndarray, response: np.ndarray, starts: np.ndarray) -> None:
    """Whiten errors e of which an input that nobody logged is a part: in each window a multiple of its response s, the
    multiple a standard normal number of that window.

    Their covariance there is C = I + s s', with the inverse root::

        C^(-1/2) e = e - (1 - 1 / sqrt(1 + s's)) s (s'e) / (s's)

    errors    [sets, outputs, samples], changed in place; as `normalise_residuals` leaves them
    response  [outputs, samples], likewise: what one standard deviation of the input does
    starts    first samples of the windows
    """
    sets, outputs, n = errors.shape
    for w in range(len(starts)):
        end = starts[w + 1] if w + 1 < len(starts) else n
        power = 0.0
        for o in range(outputs):
            for i in range(starts[w], end):
                power += response[o, i] * response[o, i]
        if power > 0.0:
            share = (1.0 - 1.0 / math.sqrt(1.0 + power)) / power
            for k in range(sets):
                along = 0.0
                for o in range(outputs):
                    for i in range(starts[w], end):
                        along += response[o, i] * errors[k, o, i]
                for o in range(outputs):
                    for i in range(starts[w], end):
                        errors[k, o, i] -= share * along * response[o, i]


# ---- Errors of the parameter sets that were simulated last: one set in ten is asked for again soon


class ResidualCache:
    """What was simulated last, by its parameters, bit for bit."""

    def __init__(self) -> None:
        self._kept: dict[bytes, Array] = {}

    def errors(self, thetas: Array, simulate: Callable[[Array], Array]) -> Array:
        """Return float64[sets, outputs, samples]: what ``simulate`` makes of those sets that are not there."""
        keys = [theta.tobytes() for theta in thetas]
        new: dict[bytes, int] = {}
        for i, key in enumerate(keys):
            if key not in self._kept:
                new.setdefault(key, i)
        if len(new) == len(keys):
            made = out = simulate(thetas)
            if not keys:
                return out
        else:
            made = simulate(thetas[list(new.values())]) if new else thetas
            of = {**self._kept, **dict(zip(new, made, strict=False))}
            out = np.array([of[key] for key in keys])
        most = KEPT_ERRORS // max(out[0].size, 1)
        first = max(len(new) - most, 0)
        for key, errors in list(zip(new, made, strict=False))[first:]:
            self._kept[key] = errors.copy()
        while len(self._kept) > most:
            del self._kept[next(iter(self._kept))]
        return out
