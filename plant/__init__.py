"""The physics: engine, servo valve, actuator, linkage with play, sensors."""

from plant.geometry import Geometry, Schedules, load_geometry, load_schedules
from plant.machine import Plant, build_plant
from plant.model import Model, load_model, write_model

__all__ = [
    "Geometry",
    "Model",
    "Plant",
    "Schedules",
    "build_plant",
    "load_geometry",
    "load_model",
    "load_schedules",
    "write_model",
]
