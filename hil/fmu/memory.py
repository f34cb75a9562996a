"""The memory of an FMU: one row of float64 with everything that its ticks work on.

One block, so that getting, setting and writing down the state of an FMU is copying it. `Place` says where each array
stands; `first` fills it as the machine has it before it starts.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from controller import Calibration, new_inputs, new_state
from controller.records import INPUTS, OUTPUTS, SCALARS, STATE
from hil.loop.tick import KEPT
from plant import Plant, chain
from plant.parameters import N_PARAMETERS

__all__ = ["FED", "HELD_N_DEM", "HELD_N_R", "NEXT", "OWN_ENGINE", "SHOWN", "Place", "Shape", "first", "places_of"]

# what is fed to an FMU and what it shows, SI, beside the potentiometers of its stages
FED = ("n_dem", "n_r", "i_cmd", "x_lvdt", "p_s", "t_oil", "mode_request", "demand_fresh", "demand_rejected", "pause")
SHOWN = ("i_cmd", "x_dem", "x_lvdt", "x", "n_engine", "i_motor", "state", "faults")
NEXT, OWN_ENGINE, HELD_N_DEM, HELD_N_R = range(4)  # numbers of the clock


class Shape(NamedTuple):
    """Sizes that differ from machine to machine: vane stages, points of the stroke tables and of the angle table."""

    stages: int
    points: int
    strokes: int


class Place(NamedTuple):
    """Where an array begins in the memory, and its shape."""

    at: int
    shape: tuple[int, ...]


def places_of(shape: Shape) -> dict[str, Place]:
    """Return the arrays in the memory of an FMU.

    clock    [4] the next tick, 1 where the plant's own engine gives the measured speed, n_dem and n_r held since the
             last frame
    fed, shown  `FED` and `SHOWN`, each with an angle (rad) for each stage behind it
    still    the noise of sensors that have none
    The others are those of `hil.loop.tick.Loop`.
    """
    stages, points, strokes = shape
    arrays: dict[str, tuple[int, ...]] = {
        "clock": (4,),
        "fed": (len(FED) + stages,),
        "shown": (len(SHOWN) + stages,),
        "inputs": (len(INPUTS),),
        "outputs": (len(OUTPUTS),),
        "z": (len(STATE),),
        "built_k": (len(SCALARS),),
        "built_table": (4, points),
        "built_angles": (1 + stages, strokes),
        "k": (len(SCALARS),),
        "table": (4, points),
        "flash": (3,),
        "s": (chain.N_STATE, 1),
        "p": (N_PARAMETERS, 1),
        "sigma": (2 + stages,),
        "still": (1, 2 + stages),
        "mean": (2,),
        "angles": (stages,),
        "sent": (KEPT, 4),
    }
    out, at = {}, 0
    for name, size in arrays.items():
        out[name] = Place(at, size)
        at += int(np.prod(size))
    out["end"] = Place(at, ())
    return out


def first(plant: Plant, calibration: Calibration) -> tuple[Shape, np.ndarray]:
    """Return the sizes of a machine, and its memory before the start: parameters and calibration in place, all else
    neutral. Raises InputError for a machine with two actuators.
    """
    plant.of_one_actuator("an FMU")
    calibration.of_one_channel("an FMU")
    shape = Shape(len(plant.vanes), calibration.table.shape[1], calibration.angles.shape[1])
    places = places_of(shape)
    m = np.zeros(places["end"].at)

    def put(name: str, values: np.ndarray) -> None:
        at, size = places[name]
        m[at : at + values.size] = values.reshape(-1)
        assert values.size == int(np.prod(size)), name

    put("clock", np.array([0.0, 1.0, 0.0, 0.0]))
    usual = plant.usual
    start = {"n_dem": 60.0, "n_r": 60.0, "p_s": usual["p_s"] * 1e6, "t_oil": usual["t_oil"], "mode_request": 1.0}
    start["demand_fresh"] = 1.0
    put("fed", np.array([start.get(name, 0.0) for name in FED] + [0.0] * shape.stages))
    put("inputs", new_inputs())
    put("z", new_state())
    for name, values in (("k", calibration.k), ("table", calibration.table)):
        put(f"built_{name}", values)
        put(name, values)
    put("built_angles", calibration.angles)
    put("flash", np.full(3, np.nan))
    put("p", plant.p)
    put("sent", np.full((KEPT, 4), np.nan))
    return shape, m
