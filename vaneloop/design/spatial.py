"""``vaneloop spatial``: the planar model against the mechanism in space, over the whole stroke."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from plant.geometry import vane_angles
from plant.spatial import spatial_angles
from vaneloop.base.errors import InputError
from vaneloop.base.extras import is_there
from vaneloop.design.multibody import multibody_angles

if TYPE_CHECKING:
    from plant import Geometry

__all__ = ["SpatialCheck", "spatial_check"]


@dataclass(frozen=True)
class SpatialCheck:
    """Vane angles (deg) over the stroke (mm) by three ways, keyed by stage.

    planar     the paper's analytic model
    newton     constraint equations in space, Newton's method (`plant.spatial`)
    multibody  the same joints in a general multibody library (`vaneloop.design.multibody`); empty where Exudyn is not
               installed
    """

    stroke: np.ndarray
    planar: dict[str, np.ndarray]
    newton: dict[str, np.ndarray]
    multibody: dict[str, np.ndarray]
    notes: list[str]

    def difference(self, stage: str) -> np.ndarray:
        """Angle in space minus planar angle, deg: the multibody library's where it ran."""
        return (self.multibody or self.newton)[stage] - self.planar[stage]


def spatial_check(geometry: Geometry, offset: float = 0.0, points: int = 97, progress: Any = None) -> SpatialCheck:
    """Close every stage in space over the stroke of 0 to 48 mm.

    offset  mm along the engine's axis between the crank's plane and the clevis' where the vane angle is 0
    Raises InputError, naming stage and stroke, where a stage does not close.
    """
    if not -100.0 <= offset <= 100.0:
        raise InputError(f"--offset (={offset:g} mm) must be in [-100, 100]")
    if not 2 <= points <= 10_000:
        raise InputError(f"--points (={points}) must be in [2, 10000]")
    stroke = np.linspace(0.0, 48.0, points)
    planar = dict(zip(geometry.vanes, np.rad2deg(vane_angles(stroke * 1e-3, geometry)).T, strict=True))
    newton = {s: spatial_angles(geometry, s, stroke, offset) for s in geometry.vanes}
    multibody, notes = {}, []
    if not is_there("exudyn"):
        notes.append(
            "exudyn is not installed (pip install 'vaneloop[multibody]'): constraint equations by Newton's method only"
        )
    else:
        for i, s in enumerate(geometry.vanes):
            multibody[s] = multibody_angles(geometry, s, stroke, offset)
            if progress is not None:
                progress((i + 1) / len(geometry.vanes))
    return SpatialCheck(stroke, planar, newton, multibody, notes)
