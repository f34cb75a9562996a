"""A trend that is too deaf or too keen: the demand must come back farther, or less far, before the controller changes
curves.

Equation::

    rate_on <- factor rate_on,   change <- factor change

Symbols: rate_on least rate of the demand that counts as moving (%/s), change way back that turns the direction (%),
factor (-).
Limits: both thresholds share the factor; the hold time stays.
In a log: after each reversal of n_dem the stroke stays on the old curve for longer (factor > 1) or leaves it sooner:
x_dem is wrong by the distance between the curves, about 1.5 mm, for a while after reversals only. With a factor well
above 1 small reversals never turn it.
Source: definition; Kim & Ki 2020, section 4, for the trend.
"""

from __future__ import annotations

from plant.effect import Effect, Parameter
from vaneloop.base.compiled import compiled

__all__ = ["EFFECT", "step"]

EFFECT = Effect(
    "trend_threshold_error",
    "demand",
    ("demand",),
    (Parameter("factor", "-", 1.0, 0.05, 50.0, "thresholds of the trend over their nominal values"),),
    (),
    "the controller changes curves too late or too soon",
    "reversals of the demand by one to a few per cent, slow and fast",
)


@compiled
def step(threshold: float, factor: float) -> float:
    """Return the threshold in use for the nominal ``threshold`` (% or %/s)."""
    return threshold * factor
