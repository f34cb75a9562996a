"""Dry friction in elastic joints: a smooth loop that closes gradually after each reversal.

Equation, with a the ring's travel over distance and y in [-1, 1] the bristle::

    y <- s + (y - s) exp(-|a|),   s = sign(a),   th_vane side = th - (width/2) (L / Ld') y

Symbols: th ring angle behind the backlash (rad), width total at the vane (rad), L / Ld' ratio of the lever at
mid-stroke, distance ring travel over which the loop closes to 1/e (rad). Rate-independent: only travel counts.
Limits: Dahl's first-order curve; minor loops drift a little under small vibration, which Coulomb joints do not.
In a log: as with backlash, the up and down strokes differ by the width, but the vane starts to move at once after a
reversal and closes the gap exponentially with travel.
Source: Dahl, AIAA J. 14 (1976) 1675.
"""

from __future__ import annotations

import math

from plant.effect import Effect, Parameter, per_vane_stage
from vaneloop.base.compiled import compiled
from vaneloop.base.vanes import VANES

__all__ = ["EFFECT", "loop", "step"]

EFFECT = Effect(
    "linkage_friction",
    "linkage",
    ("linkage",),
    (
        *per_vane_stage("deg", 0.0, 0.0, 5.0, "total width of the smooth loop at the vane"),
        Parameter("distance", "deg", 0.2, 0.01, 5.0, "ring travel over which the loop closes to 1/e"),
    ),
    (*(f"bristle_{v}" for v in VANES), *(f"ring_{v}" for v in VANES)),
    "a smooth hysteresis loop beside the backlash",
    "reversals of the stroke, slow enough to see the vane start",
)


@compiled
def step(y: float, travel: float, distance: float) -> float:
    """Return the bristle's deflection (-1..1) after the ring has turned by ``travel`` (rad)."""
    if travel == 0.0:
        return y
    s = math.copysign(1.0, travel)
    return s + (y - s) * math.exp(-abs(travel) / distance)


@compiled
def loop(theta: float, y: float, width: float, ratio: float) -> float:
    """Return the ring angle (rad) at the lever: ``theta`` held back by friction; ``width`` at the vane (rad), ``ratio``
    ring per vane.
    """
    return theta - 0.5 * width * ratio * y
