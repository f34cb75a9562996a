"""The point where one side drives the rings is softer than the rest: a cracked bracket, a worn seat.

Equation::

    1 / kappa' = 1 / kappa + 1 / kappa_A + 1 / kappa_B,   kappa_i = kappa ratio_i / (1 - ratio_i)
    th_A' = th_A - kappa' / kappa_A (th_A - th_B),   th_B' = th_B + kappa' / kappa_B (th_A - th_B)

Symbols: kappa stiffness of a ring between its driven points, kappa' what both sides feel of it, kappa_A and kappa_B
those of the points (N m/rad; rigid at ratio 1). th_A and th_B are the angles to which each side alone would turn the
ring, th_A' and th_B' those of its points (rad). With one soft point kappa' = ratio kappa.
Limits: linear, the same ratio at every ring; no play.
In a log: unequal strokes load the pistons by less than the rings' stiffness says, and the vanes follow the stiff side
by more than the half. At equal strokes nothing of it shows.
Source: three springs in series.
"""

from __future__ import annotations

from plant.effect import PAIR, Effect, Parameter
from vaneloop.base.compiled import compiled

__all__ = ["EFFECT", "step"]

EFFECT = Effect(
    "ring_stiffness",
    "link",
    ("actuator", "linkage"),
    (Parameter("ratio", "-", 1.0, 0.02, 1.0, "stiffness between the driven points, of nominal, by this side's point"),),
    (),
    "the point where one side drives the rings is soft",
    "strokes that differ",
    PAIR,
)


@compiled
def step(ratio_a: float, ratio_b: float) -> tuple[float, float, float]:
    """Return kappa' / kappa, and by which share of th_A - th_B the point of A gives way, and that of B."""
    left = 1.0 / (1.0 / ratio_a + 1.0 / ratio_b - 1.0)
    return left, left * (1.0 / ratio_a - 1.0), left * (1.0 / ratio_b - 1.0)
