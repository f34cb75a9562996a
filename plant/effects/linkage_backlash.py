"""Backlash other than nominal: worn or tight pins between crank, link, ring and lever.

Equation::

    w = max(w_nominal + width L / Ld', 0)

Symbols: w total backlash at the ring (rad), width total backlash at the vane beyond nominal (rad), L / Ld' ratio of
the lever at mid-stroke.
Limits: all clearance of a vane row as one backlash, between link and ring.
In a log: at each reversal the vane stands until the stroke has crossed the gap; up and down strokes differ by the
width, the same at every stroke.
Source: play operator, see plant/play.py; Kim & Ki 2020, Figure 13, for the nominal width.
"""

from __future__ import annotations

from plant.effect import Effect, per_vane_stage
from vaneloop.base.compiled import compiled

__all__ = ["EFFECT", "step"]

EFFECT = Effect(
    "linkage_backlash",
    "linkage",
    ("linkage",),
    per_vane_stage(
        "deg",
        0.0,
        -10.0,
        5.0,
        "total backlash at the vane beyond nominal; minus the nominal backlash leaves none",
        "hysteresis",
    ),
    (),
    "a vane row has more or less backlash than nominal",
    "reversals of the stroke",
)


@compiled
def step(play: float, width: float, ratio: float) -> float:
    """Return the total backlash (rad at the ring) for a ``width`` (rad at the vane) beyond the nominal ``play``;
    ``ratio`` ring per vane.
    """
    return max(play + width * ratio, 0.0)
