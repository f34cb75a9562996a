"""Overlap: the spool's lands are wider than their ports, so that it must travel before oil flows.

Equation::

    opening = u - clip(u, -h, h),   h = half_width / i_rated

Symbols: u spool (-), h overlap as a fraction of rated travel, half_width (A).
Limits: the same overlap on both sides (else see valve_null_bias); no leakage flow within it; beyond it the full flow
gain.
In a log: i_cmd jumps by twice the half-width at each reversal of the stroke, which stands still meanwhile; the speed
for a given current is less by the same amount in both directions. In closed loop: a flat spot at reversals, sometimes
a slow limit cycle in dwells.
Source: Merritt, Hydraulic Control Systems (1967), section 5-7, closed-centre valves.
"""

from __future__ import annotations

from plant.effect import HYDRAULIC, Effect, Parameter
from vaneloop.base.compiled import compiled

__all__ = ["EFFECT", "step"]

EFFECT = Effect(
    "valve_dead_band",
    "valve",
    ("actuator",),
    (Parameter("half_width", "mA", 0.0, 0.0, 20.0, "current that moves the spool but no oil"),),
    (),
    "small currents move no oil",
    "small currents: slow motion, reversals",
    HYDRAULIC,
)


@compiled
def step(u: float, half: float) -> float:
    """Return the opening (-) of the spool ``u`` (-) with an overlap of ``half`` (-)."""
    return u - min(max(u, -half), half)
