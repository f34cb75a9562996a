"""The physics: engine, servo valve, actuator, linkage with play, sensors."""

from plant.geometry import Geometry, Schedules, load_geometry, load_schedules
from plant.machine import Plant, build_plant

__all__ = ["Geometry", "Plant", "Schedules", "build_plant", "load_geometry", "load_schedules"]
