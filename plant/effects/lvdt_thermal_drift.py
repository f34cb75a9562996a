"""The stroke sensor's zero moves as it warms up.

Equation::

    reading = x + coefficient (T - 40 degC)

Symbols: x stroke (m), T oil temperature (degC), coefficient (m/K).
Limits: linear, and the sensor is as warm as the oil: no thermal lag.
In a log: vanes drift with t_oil, all vane rows at once in the ratio of their slopes, while x_lvdt follows x_dem.
Source: definition; 0.01 % of range per kelvin is a usual data-sheet figure.
"""

from __future__ import annotations

from plant.effect import T_REF, Effect, Parameter
from vaneloop.base.compiled import compiled

__all__ = ["EFFECT", "step"]

EFFECT = Effect(
    "lvdt_thermal_drift",
    "lvdt",
    ("actuator", "linkage"),
    (Parameter("coefficient", "mm/K", 0.0, -0.2, 0.2, "drift of the reading per kelvin of oil above 40 degC"),),
    (),
    "the stroke reading drifts with temperature",
    "vane angles logged while the oil warms up by 10 K or more",
)


@compiled
def step(x: float, t_oil: float, coefficient: float) -> float:
    """Return the reading (m) of the stroke ``x`` (m) at the oil temperature ``t_oil`` (degC)."""
    return x if coefficient == 0.0 else x + coefficient * (t_oil - T_REF)
