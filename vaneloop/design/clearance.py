"""``vaneloop clearance``: the hysteresis of each stage traced to clearances of its joints, in millimetres."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from plant.spatial import Clearances, clearance_for, clearance_loop, clearance_width, contributions, freedoms
from vaneloop.base.errors import InputError

if TYPE_CHECKING:
    from plant import Geometry
__all__ = ["FITS", "ClearanceStudy", "clearance_study"]

# mm. Chosen: running fits as new (H8/f7 on 10 to 18 mm: 0.016 to 0.061 mm) at the pivots, as much in each spherical
# joint, two of which hold the actuator; a close fit at the lever arms' ends. What these leave of the hysteresis is the
# ring's own freedom.
FITS = {"actuator": 0.10, "crank_pivot": 0.04, "crank_link": 0.05, "link_clevis": 0.05, "lever_pin": 0.03}
WORDS = {
    "actuator": "actuator, both ends",
    "crank_pivot": "bell crank's bearing",
    "crank_link": "crank to link",
    "link_clevis": "link to clevis",
    "ring": "ring across its links",
    "lever_pin": "lever arm's end",
}


@dataclass(frozen=True)
class ClearanceStudy:
    """One stage's hysteresis made of clearances. deg, mm.

    width       what was to be explained; made: what the clearances make
    clearances  the joints' fits, and the ring's freedom that makes up the rest
    parts       width that each joint makes alone
    per_mm      width for 1 mm of clearance of each joint
    alone       clearance that each joint would need if it made the whole width by itself (None: more than 5 mm)
    freedoms    change of the vane angle for 1 mm of each of the ring's four freedoms, largest over the stroke
    stroke, extension, retraction   the loop in space; play: half the width of a play operator at the ring, seen at the
                                    vane
    around, width_around            width over the vane's place on the ring, deg from the right clevis
    """

    stage: str
    width: float
    made: float
    clearances: Clearances
    parts: dict[str, float]
    per_mm: dict[str, float]
    alone: dict[str, float | None]
    freedoms: dict[str, float]
    stroke: np.ndarray
    extension: np.ndarray
    retraction: np.ndarray
    play: np.ndarray
    around: np.ndarray
    width_around: np.ndarray


def clearance_study(
    geometry: Geometry, stage: str, width: float, fits: Clearances, vane: float = -90.0, ring: float | None = None
) -> ClearanceStudy:
    """Find the ring's clearance that, beside ``fits``, gives the stage's ``width`` (deg) at the vane; ``ring`` (mm)
    takes it as given.

    vane  deg along the ring from the right clevis to the measured vane; -90 is the lowest
    Raises InputError where the fits alone are wider than the width, or no clearance reaches it.
    """
    fits.check()
    if ring is None:
        ring = clearance_for(geometry, stage, width, fits, "ring", vane)
    whole = replace(fits, ring=ring)
    stroke = np.linspace(0.0, 48.0, 49)
    extension, retraction = clearance_loop(geometry, stage, stroke, whole, vane)
    alone: dict[str, float | None] = {}
    for joint in WORDS:
        try:
            alone[joint] = clearance_for(geometry, stage, width, Clearances(), joint, vane)
        except InputError:
            alone[joint] = None
    around = np.linspace(-180.0, 180.0, 25)
    made = clearance_width(geometry, stage, whole, vane)
    ratio = getattr(geometry, stage).l.value / getattr(geometry, stage).ld_prime.value
    mean = np.deg2rad(0.5 * (extension + retraction))
    at_vane = (1.0 + (ratio * np.sin(mean)) ** 2) / np.cos(mean)  # d vane / d ring over its value in mid-range
    each = [freedoms(geometry, stage, x, vane) for x in (0.0, 24.0, 48.0)]
    return ClearanceStudy(
        stage,
        width,
        made,
        whole,
        contributions(geometry, stage, whole, vane),
        {j: clearance_width(geometry, stage, Clearances(**{j: 0.1}), vane) / 0.1 for j in WORDS},
        alone,
        {name: max((e[name] for e in each), key=abs) for name in each[0]},
        stroke,
        extension,
        retraction,
        0.5 * made * at_vane,
        around,
        np.array([clearance_width(geometry, stage, whole, float(v)) for v in around]),
    )


def study_rows(studies: list[ClearanceStudy]) -> list[list[str]]:
    """Per joint and stage: clearance, width, and the clearance that alone would make the whole width."""
    return [
        [
            WORDS[j],
            *(t for s in studies for t in (f"{getattr(s.clearances, j):.3f}", f"{s.parts[j]:.3f}", _or(s.alone[j]))),
        ]
        for j in WORDS
    ]


def _or(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"
