"""Backlash that grows: pins wear out during the run.

Equation::

    w(t) = w + rate L / Ld' t

Symbols: w total backlash at the ring (rad), rate growth at the vane (rad/s, declared in deg/h), t time from the start
of the log (s).
Limits: steady growth; real wear is fast at first and follows load and number of reversals.
In a log: the hysteresis of a vane row widens from the beginning to the end of the log, symmetrically; nothing at its
start.
Source: Archard's law at constant conditions, J. Appl. Phys. 24 (1953) 981.
"""

from __future__ import annotations

from plant.effect import Effect, per_vane_stage
from vaneloop.base.compiled import compiled

__all__ = ["EFFECT", "step"]

EFFECT = Effect(
    "linkage_wear",
    "linkage",
    ("linkage",),
    per_vane_stage("deg/h", 0.0, 0.0, 200.0, "growth of the total backlash at the vane"),
    (),
    "the backlash of a vane row grows with time",
    "reversals throughout a log of some minutes",
)


@compiled
def step(play: float, rate: float, ratio: float, t: float) -> float:
    """Return the total backlash (rad at the ring) at time ``t`` (s) with a growth of ``rate`` (rad/s at the vane);
    ``ratio`` ring per vane.
    """
    return play + rate * ratio * max(t, 0.0)
