"""Machines with one to eight stages for tests: the shipped linkage with its last stages scaled, or stages left out."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from controller import Calibration, load_calibration
from plant import Geometry, Plant, Schedules, build_plant, load_geometry, load_schedules
from plant.geometry import Stage, stroke_for_vigv, vane_angles
from vaneloop.base.vanes import VANES
from vaneloop.design.schedule_files import write_geometry, write_schedules, write_vane_angles
from vaneloop.design.stroke_tables import vane_angle_table

__all__ = ["machine", "write_machine"]


def geometry_of(stages: int, scale: float = 0.88) -> Geometry:
    """The shipped stages, as many as asked for; each one more has the lower arm of the one before it times ``scale``,
    a shorter link that keeps its angles about 0, and less play.
    """
    shipped = load_geometry()
    own: dict[str, Stage] = {}
    last = shipped.stages()[-1]
    for k, name in enumerate(VANES[:stages]):
        if k < 3:
            own[name] = shipped.stages()[k]
            continue
        lb, play = last.lb.value * scale, last.hysteresis.value * 0.9
        update = {"lb": lb, "lb_initial": lb, "lc": last.lc.value + 1.55 * (1.0 - scale), "hysteresis": round(play, 3)}
        last = last.model_copy(
            update={key: getattr(last, key).model_copy(update={"value": v}) for key, v in update.items()}
        )
        own[name] = last
    return Geometry(crank=shipped.crank, **own)  # type: ignore[arg-type]


def schedules_of(geometry: Geometry) -> Schedules:
    """The shipped target of the VIGV, and for the others the angles that the linkage gives with it."""
    shipped = load_schedules()
    stroke = np.asarray(stroke_for_vigv(np.deg2rad(shipped.vigv.values), geometry))
    angles = np.round(np.rad2deg(vane_angles(stroke, geometry)), 3)
    others = {
        name: shipped.vigv.model_copy(update={"values": angles[:, k].tolist()})
        for k, name in enumerate(geometry.vanes)
        if k
    }
    return Schedules(speed=shipped.speed, vigv=shipped.vigv, **others)  # type: ignore[arg-type]


def write_machine(folder: Path, stages: int, scale: float = 0.88) -> Path:
    """Write the tables of a machine with so many stages into ``folder``; return it, for ``--tables``."""
    folder.mkdir(parents=True, exist_ok=True)
    geometry = geometry_of(stages, scale)
    write_geometry(geometry, folder / "geometry.toml")
    write_schedules(schedules_of(geometry), folder / "schedules.toml")
    write_vane_angles(vane_angle_table(geometry), geometry, folder / "vane_angles.toml", "derived: geometry.toml")
    return folder


def machine(folder: Path, stages: int, strategy: str | None = None, scale: float = 0.88) -> tuple[Plant, Calibration]:
    """Plant and calibration of a machine with so many stages; its tables are written into ``folder``."""
    at = write_machine(folder, stages, scale)
    plant = build_plant("plant.toml", at / "geometry.toml", at / "schedules.toml")
    return plant, load_calibration("calibration.toml", "stroke_tables.toml", strategy, at / "vane_angles.toml")
