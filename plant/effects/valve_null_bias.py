"""The spool is not closed at zero current: flapper and nozzles are out of balance, or the null has drifted.

Equation::

    i_valve = i_cmd + bias

Symbols: i current (A), bias (A), > 0 extends.
Limits: constant; the drift of null with temperature and supply pressure (some per cent of rated current) is not in
it.
In a log: the current that holds the stroke still is -bias; without a current the piston creeps at g bias / i_rated (1
mA: 3.75 mm/s). In closed loop the integrator hides it: only the mean of i_cmd shows it.
Source: Moog, Electrohydraulic Valves: A Technical Look (null bias, null shift).
"""

from __future__ import annotations

from plant.effect import HYDRAULIC, Effect, Parameter
from vaneloop.base.compiled import compiled

__all__ = ["EFFECT", "step"]

EFFECT = Effect(
    "valve_null_bias",
    "valve",
    ("actuator",),
    (Parameter("bias", "mA", 0.0, -20.0, 20.0, "current that the valve adds to its command"),),
    (),
    "the valve is open at zero current",
    "any run of some seconds",
    HYDRAULIC,
)


@compiled
def step(i: float, bias: float) -> float:
    """Return the current (A) that moves the spool."""
    return i + bias
