"""The variables of an FMU: signals in SI, parameters in the units of their tables, each with bounds and meaning.

Signals are in SI, so that a plant and a controller that are joined give the loop's bits; tools show them in the
border's units. Parameters have the numbers of the tables and of model files.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from controller import STRATEGIES, Calibration
from controller.calibration import CalibrationTable, scalars_in
from controller.records import FAULTS, MODES, SCALAR_FIELDS, SCALARS
from hil.fmu.memory import FED, OWN_ENGINE, SHOWN, Shape, places_of
from plant import Model, Plant
from plant.effects import EFFECTS
from plant.layout import PLAY
from plant.model import allowed_of
from vaneloop.base.vanes import MOST

__all__ = ["FIXED", "INPUT", "OUTPUT", "PARTS", "REAL", "TIME", "TRUTH", "TUNABLE", "WHOLE", "Variable", "variables_of"]

REAL, WHOLE, TRUTH = range(3)
TIME, INPUT, OUTPUT, FIXED, TUNABLE = range(5)
PARTS = ("plant", "controller", "loop")


class Variable(NamedTuple):
    """One variable.

    kind, role   `REAL`, `WHOLE` or `TRUTH`; `INPUT`, `OUTPUT`, `FIXED` (before the start only) or `TUNABLE`
    unit, shown  of its value, and the border's unit in which tools show it; "": none
    start, low, high  in ``unit``; NaN: no bound, and a sensor that may be not fitted
    at           its number in the memory; -1: behind the memory, in the order of the parameters
    acts         number in SI that is value * si * ratio; -1: none
    """

    name: str
    kind: int
    role: int
    unit: str
    description: str
    start: float = 0.0
    low: float = -math.inf
    high: float = math.inf
    at: int = -1
    acts: int = -1
    si: float = 1.0
    ratio: float = 1.0
    shown: str = ""


_INPUTS = {  # name -> type, unit, shown as, start, description; the start of None is the machine's usual value
    "n_dem": (REAL, "%", "", 60.0, "rotor speed demand"),
    "n_r": (REAL, "%", "", 60.0, "measured rotor speed; without effect while own_engine is true"),
    "i_cmd": (REAL, "A", "mA", 0.0, "servo-valve current; positive extends"),
    "x_lvdt": (REAL, "m", "mm", 0.0, "stroke as the LVDT measures it"),
    "p_s": (REAL, "Pa", "MPa", None, "supply pressure"),
    "t_oil": (REAL, "degC", "", None, "oil temperature; that of an electromechanical actuator"),
    "mode_request": (WHOLE, "", "", 1.0, "0 standby, 1 run"),
    "demand_fresh": (TRUTH, "", "", 1.0, "a good frame of the ECU comes every 10 ms; false: none comes"),
    "demand_rejected": (WHOLE, "", "", 0.0, "frames of the ECU refused in each 10 ms"),
    "pause": (REAL, "s", "", 0.0, "for which the controller stood still before each tick"),
}
_OUTPUTS = {
    "i_cmd": (REAL, "A", "mA", "servo-valve current of the last tick; positive extends"),
    "x_dem": (REAL, "m", "mm", "stroke demand of the last tick"),
    "x_lvdt": (REAL, "m", "mm", "stroke as the LVDT measures it"),
    "x": (REAL, "m", "mm", "stroke"),
    "n_engine": (REAL, "%", "", "rotor speed of the machine's own engine"),
    "i_motor": (REAL, "A", "", "motor current"),
    "state": (WHOLE, "", "", "controller mode: " + ", ".join(f"{i} {name}" for i, name in enumerate(MODES))),
    "faults": (WHOLE, "", "", "bits of the faults: " + ", ".join(f"{1 << i} {name}" for i, name in enumerate(FAULTS))),
}
_FED_BY_PART = {
    "plant": ("n_dem", "n_r", "i_cmd", "p_s", "t_oil"),
    "controller": ("n_dem", "n_r", "x_lvdt", "mode_request", "demand_fresh", "demand_rejected", "pause"),
    "loop": ("n_dem", "n_r", "p_s", "t_oil", "mode_request", "demand_fresh", "demand_rejected"),
}
_SHOWN_BY_PART = {
    "plant": ("x_lvdt", "x", "n_engine", "i_motor"),
    "controller": ("i_cmd", "x_dem", "state", "faults"),
    "loop": SHOWN,
}


def variables_of(
    part: str,
    plant: Plant,
    model: Model,
    calibration: Calibration,
    table: CalibrationTable,
    memory: np.ndarray,
    shape: Shape,
) -> list[Variable]:
    """Return the variables of a part: inputs, outputs, parameters.

    model   what the plant has beyond its tables
    table   the calibration as its file has it
    memory  of the machine before its start (`hil.fmu.memory.first`)
    """
    out = [*_signals(part, plant, memory, shape)]
    if part != "controller":
        out += _machine(plant, model, shape)
    out += _effects(part, plant, model, shape)
    if part != "plant":
        out += _firmware(calibration, table, shape)
    return out


def _signals(part: str, plant: Plant, memory: np.ndarray, shape: Shape) -> Iterator[Variable]:
    places = places_of(shape)
    fed, shown = places["fed"].at, places["shown"].at
    open_end = math.nan if part == "controller" else math.inf
    for name in _FED_BY_PART[part]:
        kind, unit, border, start, description = _INPUTS[name]
        at = fed + FED.index(name)
        first = float(memory[at]) if start is None else start
        low, high = (-open_end, open_end) if kind == REAL else (0.0, 1.0 if name != "demand_rejected" else 1e6)
        if name == "n_r" and part == "controller":
            description = "measured rotor speed"
        yield Variable(name, kind, INPUT, unit, description, first, low, high, at, shown=border)
    if part == "controller":
        for k, vane in enumerate(plant.vanes):
            description = f"angle of stage {vane} as its stem potentiometer gives it; NaN: not fitted"
            at = fed + len(FED) + k
            yield Variable(vane, REAL, INPUT, "rad", description, 0.0, math.nan, math.nan, at, shown="deg")
    for name in _SHOWN_BY_PART[part]:
        if name == "i_motor" and plant.kind == "hydraulic":
            continue
        kind, unit, border, description = _OUTPUTS[name]
        yield Variable(name, kind, OUTPUT, unit, description, at=shown + SHOWN.index(name), shown=border)
    if part != "controller":
        for k, vane in enumerate(plant.vanes):
            description = f"angle of stage {vane} as its stem potentiometer gives it"
            yield Variable(vane, REAL, OUTPUT, "rad", description, at=shown + len(SHOWN) + k, shown="deg")
        description = "true: the machine's own engine turns after n_dem; false: its speed is n_r"
        yield Variable("own_engine", TRUTH, FIXED, "", description, 1.0, 0.0, 1.0, places["clock"].at + OWN_ENGINE)


def _machine(plant: Plant, model: Model, shape: Shape) -> Iterator[Variable]:
    """The nominal machine's numbers, as a model file's [parameters] has them."""
    p = places_of(shape)["p"].at
    for n in plant.nominal:
        low, high = allowed_of(plant, n)
        section, key = n.name.split(".", 1)
        ratio = 1.0
        if PLAY <= n.row < PLAY + MOST:  # declared at the vane, used at the ring
            ldp, lever = plant.lever(n.row - PLAY)
            ratio = lever / ldp
        description = f"{key.replace('_', ' ')} of the {section}, as built"
        value = model.parameters.get(n.name, n.value)
        acts = p + n.row
        yield Variable(f"plant.{n.name}", REAL, TUNABLE, n.unit, description, value, low, high, -1, acts, n.si, ratio)


def _effects(part: str, plant: Plant, model: Model, shape: Shape) -> Iterator[Variable]:
    """Every effect that acts in the part, as a model file's [effects] has it."""
    p = places_of(shape)["p"].at
    for name, effect in EFFECTS.items():
        in_controller = effect.site == "demand"
        if plant.kind not in effect.kinds or part == ("plant" if in_controller else "controller"):
            continue
        given = model.effects.get(name, {})
        for row, q in plant.parameters_of(name).items():
            description = f"{effect.summary}: {q.meaning}; neutral: {q.neutral:g}"
            value = given.get(q.name, q.neutral)
            yield Variable(
                f"effects.{name}.{q.name}", REAL, TUNABLE, q.unit, description, value, q.low, q.high, -1, p + row, q.si
            )


def _firmware(calibration: Calibration, table: CalibrationTable, shape: Shape) -> Iterator[Variable]:
    """The calibration's scalars, and the stroke tables."""
    places = places_of(shape)
    k, strokes = places["built_k"].at, places["built_table"].at
    meaning = {f.name: f.meaning for f in SCALAR_FIELDS}
    names = ", ".join(f"{i} {name}" for i, name in enumerate(STRATEGIES))
    at, last = k + SCALARS.index("strategy"), float(len(STRATEGIES) - 1)
    strategy = float(calibration.scalars.strategy)
    yield Variable("controller.schedule.strategy", WHOLE, FIXED, "", names, strategy, 0.0, last, at)
    for s in scalars_in(table):
        name, description = f"controller.{s.section}.{s.key}", meaning[s.key]
        acts = k + SCALARS.index(s.key)
        yield Variable(name, REAL, TUNABLE, s.unit, description, s.value, s.low, s.high, -1, acts, s.si)
    for row, curve in enumerate(("extension", "retraction", "single"), 1):
        for i, speed in enumerate(calibration.table[0]):
            description = f"stroke of the curve {curve} at {speed:g} %"
            acts = strokes + row * shape.points + i
            value = calibration.table[row, i] * 1e3
            name = f"controller.stroke_table.{curve}[{i + 1}]"
            yield Variable(name, REAL, TUNABLE, "mm", description, value, 0.0, 100.0, -1, acts, 1e-3)
