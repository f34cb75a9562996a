"""The rig: a truth simulator of engine, servo valve, actuator, linkage and sensors, independent of the product's plant.
See docs/rig.md.
"""

from .controller import AsObject, Compiled, Controller, playback, stand_in
from .effects import CATALOGUE, EFFECTS, MOTOR_EFFECTS, OUTSIDE, WITH_MOTOR, Effect, Hidden, draw, neutral
from .geometry import Geometry
from .geometry import load as load_geometry
from .manoeuvre import MANOEUVRES, Manoeuvre, manoeuvre, slow_ramps, small_moves, steady
from .simulate import Run, Spell, machine, simulate, write

__all__ = [
    "CATALOGUE",
    "EFFECTS",
    "MANOEUVRES",
    "MOTOR_EFFECTS",
    "OUTSIDE",
    "WITH_MOTOR",
    "AsObject",
    "Compiled",
    "Controller",
    "Effect",
    "Geometry",
    "Hidden",
    "Manoeuvre",
    "Run",
    "Spell",
    "draw",
    "load_geometry",
    "machine",
    "manoeuvre",
    "neutral",
    "playback",
    "simulate",
    "slow_ramps",
    "small_moves",
    "stand_in",
    "steady",
    "write",
]
