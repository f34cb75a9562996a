"""Thin oil passes more easily: the flow gain changes with oil temperature.

Equation::

    g(T) = g (1 + coefficient (T - 40 degC))

Symbols: g flow gain (m/s), T oil temperature (degC), coefficient (1/K).
Limits: linear; sharp-edged orifices depend little on viscosity, long passages and cold oil a lot and not linearly.
Kept above 5 % of g.
In a log: the speed for a given i_cmd drifts with t_oil, both ways alike. Without a change of t_oil it is a
recalibration of the flow gain.
Source: Merritt (1967), ch. 3, discharge coefficient at low Reynolds number.
"""

from __future__ import annotations

from plant.effect import HYDRAULIC, T_REF, Effect, Parameter
from vaneloop.base.compiled import compiled

__all__ = ["EFFECT", "step"]

EFFECT = Effect(
    "oil_viscosity",
    "supply",
    ("actuator",),
    (Parameter("coefficient", "1/K", 0.0, -0.02, 0.02, "relative flow gain per kelvin above 40 degC"),),
    (),
    "the flow gain changes with oil temperature",
    "moving strokes while the oil warms up by 10 K or more",
    HYDRAULIC,
)


@compiled
def step(gain: float, t_oil: float, coefficient: float) -> float:
    """Return the flow gain (m/s) at the oil temperature ``t_oil`` (degC)."""
    return gain if coefficient == 0.0 else gain * max(1.0 + coefficient * (t_oil - T_REF), 0.05)
