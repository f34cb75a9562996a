"""A stem potentiometer behind a slower filter than the table says.

Equation::

    (tau + lag) dy/dt = vane - y

Symbols: vane angle (rad), y reading (rad), tau nominal lag (s), lag beyond it (s).
Limits: first order.
In a log: one vane row's reading trails while the vanes move, in proportion to their speed, with the same sign as the
motion; dwells are right. Backlash also makes it trail, but by an angle that does not depend on speed.
Source: first-order lag, Ogata, Modern Control Engineering (2010), section 5.
"""

from __future__ import annotations

from plant.effect import Effect, per_vane_stage
from vaneloop.base.compiled import compiled

__all__ = ["EFFECT", "step"]

EFFECT = Effect(
    "pot_lag",
    "pot",
    ("linkage",),
    per_vane_stage("s", 0.0, -0.005, 0.5, "lag beyond nominal"),
    (),
    "a vane-angle reading is late",
    "fast motion",
)


@compiled
def step(nominal: float, lag: float) -> float:
    """Return the potentiometer's lag (s)."""
    return nominal + lag
