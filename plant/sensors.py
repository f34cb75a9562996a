"""What the sensors make of stroke, angle and speed: lag, noise, a converter's steps.

First-order lag, exact for an input that is constant over the step: ``y <- y + (1 - exp(-dt/tau)) (x - y)``.
Converter: the value is rounded to the nearest multiple of range / 2^bits.
"""

from __future__ import annotations

import math

import numpy as np

from vaneloop.base.compiled import compiled

__all__ = ["lag_factor", "quantise"]


@compiled
def lag_factor(tau: float, dt: float) -> float:
    """Return 1 - exp(-dt/tau): the part of the remaining way a lag of ``tau`` (s) goes in ``dt`` (s); 1 for no lag."""
    if tau <= 0.0:
        return 1.0
    return 1.0 - math.exp(-dt / tau)


@compiled
def quantise(v: float, step: float) -> float:
    """Return ``v`` rounded to the nearest multiple of ``step``; ``v`` itself for step 0, NaN or infinite."""
    if step <= 0.0:
        return v
    return np.floor(v / step + 0.5) * step  # math.floor goes through an integer, which has no NaN and no infinity
