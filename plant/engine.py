"""Rotor speed: follows its demand with a lag, inside the limits of the acceleration and deceleration schedules.

Equation::

    dn/dt = clip((n_dem - n) / lag, -deceleration, acceleration)

Symbols: n, n_dem in % of design speed, lag in s, limits in %/s. The step is explicit Euler; at 1 ms and a lag of 1.2 s
its error is below 0.05 % of the change.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from plant.effects import acceleration_limit_error, rotor_lag_error
from plant.parameters import ACCELERATION, DECELERATION, LAG
from plant.places import ACCELERATION_LIMIT_ERROR, ROTOR_LAG_ERROR
from plant.prepared import with_effects
from vaneloop.base.compiled import compiled, inlined

__all__ = ["Engine", "engine_step", "prepare", "step"]


class _Engine(NamedTuple):
    """What a step needs of the engine, worked out once: s, %/s, %/s; behind these fields those of the effects at the
    engine (`plant.prepared`).
    """

    lag: float
    acceleration: float
    deceleration: float


@inlined
def _numbers(p: np.ndarray, j: int) -> _Engine:
    """Return what the engine of lane ``j`` of the parameters is, but for the effects' own numbers."""
    return _Engine(
        rotor_lag_error.step(p[LAG, j], p[ROTOR_LAG_ERROR, j]),
        acceleration_limit_error.step(p[ACCELERATION, j], p[ACCELERATION_LIMIT_ERROR, j]),
        p[DECELERATION, j],
    )


Engine, prepare = with_effects(_Engine, _numbers, "p, j", "engine")


@compiled
def engine_step(n: float, n_dem: float, lag: float, acceleration: float, deceleration: float, dt: float) -> float:
    """Return the rotor speed (%) after ``dt`` (s)."""
    return n + min(max((n_dem - n) / lag, -deceleration), acceleration) * dt


@inlined
def step(n: float, d: Any, n_dem: float, dt: float, lag_times: float = 1.0, rise_times: float = 1.0) -> float:
    """Return the rotor speed (%) after ``dt`` (s) towards the demand ``n_dem`` (%); ``lag_times``, ``rise_times``: what
    curves make of lag and acceleration.
    """
    return engine_step(n, n_dem, d.lag * lag_times, d.acceleration * rise_times, d.deceleration, dt)
