"""An acceleration schedule that is not the table's: the rotor may speed up by less, or by more, each second.

Equation::

    dn/dt <= acceleration_nominal + limit

Symbols: n speed (%), limit beyond nominal (%/s), negative for an engine that is held back.
Limits: the deceleration limit stays; the total is kept above 0.01 %/s.
In a log: the slope of n_r in fast rises differs, falls and slow rises do not. Nothing shows unless a demand asks for
more than the limit.
Source: definition.
"""

from __future__ import annotations

from plant.effect import Effect, Parameter
from vaneloop.base.compiled import compiled

__all__ = ["EFFECT", "step"]

EFFECT = Effect(
    "acceleration_limit_error",
    "engine",
    ("engine",),
    (Parameter("limit", "%/s", 0.0, -7.5, 50.0, "acceleration limit beyond nominal"),),
    (),
    "the rotor's acceleration limit is not the nominal one",
    "rises of the demand faster than the acceleration limit",
)


@compiled
def step(nominal: float, limit: float) -> float:
    """Return the acceleration limit (%/s)."""
    return max(nominal + limit, 1e-2)
