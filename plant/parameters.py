"""The plant's numbers: read from ``plant.toml`` and ``geometry.toml``, laid out flat for the compiled chain."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, model_validator

from plant.curve import LOAD_ADDS, acts
from plant.effect import KINDS
from plant.effects import CURVES, DERIVED, MOTOR, N_PARAMETERS, NEUTRAL, ROW, UNISON, pot_lag, rows_at
from plant.geometry import Geometry, length_tolerances, load_geometry
from plant.layout import (
    ACCELERATION,
    AREA,
    BANDWIDTH,
    DAMPING,
    DECELERATION,
    FLOW_GAIN,
    GEOMETRY,
    LAG,
    LVDT_FACTOR,
    LVDT_LAG,
    LVDT_STEP,
    MOTOR_NAMES,
    N_NOMINAL,
    NAMES,
    P_REF,
    PLAY,
    POT_BIAS,
    POT_FACTOR,
    POT_LAG,
    RATED_CURRENT,
    STROKE,
    UNISON_NAMES,
    VALVE_A11,
    VALVE_A12,
    VALVE_A21,
    VALVE_A22,
    VANE_COUNT,
)
from plant.linkage import G_HYSTERESIS, G_L, G_LC, G_LDP, N_CRANK, N_PER_STAGE
from plant.sensors import lag_factor
from plant.valve import valve_matrix
from vaneloop.base.compiled import compiled, in_place
from vaneloop.base.errors import InputError
from vaneloop.base.tables import Bound, Bounded, Quantity, Table, file_of, read
from vaneloop.base.vanes import VANES, own_rows

__all__ = [
    "ACCELERATION", "ACTUATORS", "AMPLIFIER_SHARE", "AREA", "BANDWIDTH", "CURRENT_BANDWIDTH", "CURRENT_SHARE",
    "DAMPING", "DECELERATION", "DRIVE_EFFECTS", "DRIVE_LOADED", "FLOW_GAIN", "GEAR_INERTIA", "GEAR_RATIO", "GEOMETRY",
    "KIND", "LAG", "LINE_CONDUCTANCE", "LVDT_FACTOR", "LVDT_LAG", "LVDT_SHARE", "LVDT_STEP", "MOTOR_INERTIA", "NAMES",
    "N_NOMINAL", "N_PARAMETERS", "PEAK_CURRENT", "PLAY", "POT_BIAS", "POT_FACTOR", "POT_LAG", "POT_POSITION",
    "POT_SHARE", "POT_SHIFT", "P_REF", "RATED_CURRENT", "RATED_SPEED", "RESISTANCE", "RING_STIFFNESS",
    "SCREW_EFFICIENCY", "SCREW_FRICTION", "SCREW_LEAD", "SCREW_MASS", "SCREW_STIFFNESS", "SCREW_VISCOUS", "SPEED_GAIN",
    "SPEED_TIME", "STROKE", "TORQUE_CONSTANT", "VALVE_A11", "VALVE_A12", "VALVE_A21", "VALVE_A22", "VALVE_SHARE",
    "VANE_COUNT", "VANE_EFFECTS", "VOLTAGE", "AnyPlantTable", "ElectromechanicalTable", "Nominal", "PlantTable",
    "changed", "derive", "derive_lane", "load_plant", "motor_steps", "names_of", "nominal", "read_plant",
]  # fmt: skip

# rows of p that `derive` works out from the effects' parameters
DRIVE_EFFECTS = DERIVED  # 0 where every effect from valve to LVDT is neutral: the chain takes its short way
DRIVE_LOADED = DERIVED + 1  # 0 where neither a load nor the oil's pressure changes the motion
VANE_EFFECTS = DERIVED + 2  # as the first, from linkage to potentiometers
VALVE_SHARE = DERIVED + 3  # valve_lag and lvdt_lag: share of the way in one plant step
LVDT_SHARE = DERIVED + 4
POT_SHARE = DERIVED + 5  # a row a stage: the potentiometers' share in one tick, pot_lag included

# rows of an electromechanical actuator
KIND = MOTOR  # number in `KINDS`
(
    RATED_SPEED,  # m/s
    SPEED_GAIN,  # A s/rad
    SPEED_TIME,  # s
    PEAK_CURRENT,  # A
    CURRENT_BANDWIDTH,  # Hz
    TORQUE_CONSTANT,  # N m/A
    RESISTANCE,  # Ohm
    MOTOR_INERTIA,  # kg m2
    GEAR_RATIO,  # -
    GEAR_INERTIA,  # kg m2
    SCREW_LEAD,  # m
    SCREW_EFFICIENCY,  # -
    SCREW_FRICTION,  # N
    SCREW_VISCOUS,  # N m s/rad
    SCREW_MASS,  # kg
    SCREW_STIFFNESS,  # N/m
    VOLTAGE,  # V
) = range(KIND + 1, KIND + 1 + len(MOTOR_NAMES))
CURRENT_SHARE = VOLTAGE + 1  # share of the way that current loop and amplifier_lag go in a motor's step
AMPLIFIER_SHARE = VOLTAGE + 2
# rows of a machine with two actuators
ACTUATORS = UNISON  # how many: 2, side B's numbers in the next lane; 0: one
RING_STIFFNESS, POT_POSITION, LINE_CONDUCTANCE = range(UNISON + 1, UNISON + 1 + len(UNISON_NAMES))
POT_SHIFT = (
    LINE_CONDUCTANCE + 1
)  # -, of the angle between the driven points, what the potentiometers see beyond the mean
MOTOR_STEP = 2.5e-4  # s, the longest step of a motor; a longer plant step, as the search takes, is divided

_SI = {"mm": 1e-3, "mA": 1e-3, "ms": 1e-3, "MPa": 1e6, "N/um": 1e6, "deg": math.pi / 180.0, "mm/s/MPa": 1e-9}


class Engine(Bounded):
    """Rotor speed after its demand."""

    lag: Annotated[Quantity, Bound("s", 0.01, 60.0)]
    acceleration: Annotated[Quantity, Bound("%/s", 0.01, 1000.0)]
    deceleration: Annotated[Quantity, Bound("%/s", 0.01, 1000.0)]


class Valve(Bounded):
    """Servo valve."""

    rated_current: Annotated[Quantity, Bound("mA", 0.1, 1000.0)]
    bandwidth: Annotated[Quantity, Bound("Hz", 1.0, 400.0)]
    damping: Annotated[Quantity, Bound("-", 0.05, 0.99)]


class Actuator(Bounded):
    """Two pistons in parallel, as one."""

    kind: Literal["hydraulic"] = "hydraulic"
    flow_gain: Annotated[Quantity, Bound("m/s", 1e-3, 10.0)]
    area: Annotated[Quantity, Bound("m2", 1e-6, 1.0)]
    stroke: Annotated[Quantity, Bound("mm", 1.0, 1000.0)]


class Supply(Bounded):
    """Oil."""

    pressure: Annotated[Quantity, Bound("MPa", 0.1, 100.0)]
    temperature: Annotated[Quantity, Bound("degC", -60.0, 200.0)]


class Sensors(Bounded):
    """LVDT, stem potentiometers, speed pick-up."""

    lvdt_lag: Annotated[Quantity, Bound("ms", 0.01, 1000.0)]
    lvdt_noise: Annotated[Quantity, Bound("mm", 0.0, 10.0)]
    lvdt_bits: Annotated[Quantity, Bound("-", 4.0, 32.0)]
    lvdt_range: Annotated[Quantity, Bound("mm", 1.0, 1000.0)]
    pot_lag: Annotated[Quantity, Bound("ms", 0.01, 1000.0)]
    pot_noise: Annotated[Quantity, Bound("deg", 0.0, 10.0)]
    pot_bias: Annotated[Quantity, Bound("deg", -10.0, 10.0)]
    speed_noise: Annotated[Quantity, Bound("%", 0.0, 10.0)]


class SideB(Bounded):
    """Numbers of actuator B, its valve and its LVDT that differ from those of A."""

    bandwidth: Annotated[Quantity | None, Bound("Hz", 1.0, 400.0)] = None
    damping: Annotated[Quantity | None, Bound("-", 0.05, 0.99)] = None
    flow_gain: Annotated[Quantity | None, Bound("m/s", 1e-3, 10.0)] = None
    lvdt_lag: Annotated[Quantity | None, Bound("ms", 0.01, 1000.0)] = None


class Actuators(Bounded):
    """How many actuators drive the vanes, and what joins two (`plant.unison`).

    feed  what feeds them: "a valve each", both under the same current, or "one valve" through lines of a conductance
    b     what differs at side B
    """

    number: Annotated[Quantity, Bound("-", 1.0, 2.0)]
    feed: Literal["a valve each", "one valve"] = "a valve each"
    ring_stiffness: Annotated[Quantity | None, Bound("N m/rad", 0.0, 1e7)] = None
    pot_position: Annotated[Quantity | None, Bound("deg", 0.0, 360.0)] = None
    line_conductance: Annotated[Quantity | None, Bound("mm/s/MPa", 0.1, 80.0)] = None
    b: SideB = SideB()

    @model_validator(mode="after")
    def _whole(self) -> Actuators:
        if self.number.value not in (1.0, 2.0):
            raise ValueError(f"number (={self.number.value:g}) must be 1 or 2")
        if self.number.value == 2.0 and (key := next((k for k in _JOINED if getattr(self, k) is None), None)):
            raise ValueError(f"key {key!r} is missing; two actuators need {', '.join(_JOINED)}")
        one_valve = self.feed == "one valve"
        if one_valve != (self.line_conductance is not None):
            raise ValueError(f"line_conductance must be there with feed 'one valve' and only then (={self.feed!r})")
        if one_valve and (key := next((k for k in _OF_VALVE if getattr(self.b, k) is not None), None)):
            raise ValueError(f"b.{key} is of a valve of B's own; feed is 'one valve'")
        return self


_JOINED = ("ring_stiffness", "pot_position")
_OF_VALVE = ("bandwidth", "damping", "flow_gain")
_OF_B = {"bandwidth": BANDWIDTH, "damping": DAMPING, "flow_gain": FLOW_GAIN, "lvdt_lag": LVDT_LAG}  # rows of p


class PlantTable(Table):
    """``plant.toml``: the machine with the hydraulic actuator, or two of them (``plant_two_actuators.toml``)."""

    engine: Engine
    valve: Valve
    actuator: Actuator
    actuators: Actuators | None = None
    supply: Supply
    sensors: Sensors

    @property
    def sides(self) -> int:
        """How many actuators it has."""
        return 1 if self.actuators is None else int(self.actuators.number.value)


class MotorActuator(Bounded):
    """Rod on a ball screw."""

    kind: Literal["electromechanical"]
    stroke: Annotated[Quantity, Bound("mm", 1.0, 1000.0)]


class Amplifier(Bounded):
    """Servo amplifier: speed loop and current loop."""

    rated_current: Annotated[Quantity, Bound("mA", 0.1, 1000.0)]
    rated_speed: Annotated[Quantity, Bound("m/s", 1e-3, 10.0)]
    speed_gain: Annotated[Quantity, Bound("A s/rad", 1e-4, 100.0)]
    speed_time: Annotated[Quantity, Bound("ms", 1.0, 10000.0)]
    peak_current: Annotated[Quantity, Bound("A", 0.1, 1000.0)]
    current_bandwidth: Annotated[Quantity, Bound("Hz", 50.0, 5000.0)]


class ServoMotor(Bounded):
    """Servo motor, as the equivalent direct-current one."""

    torque_constant: Annotated[Quantity, Bound("N m/A", 1e-3, 10.0)]
    resistance: Annotated[Quantity, Bound("Ohm", 1e-3, 100.0)]
    inertia: Annotated[Quantity, Bound("kg m2", 1e-7, 0.1)]


class Gear(Bounded):
    """Reduction gear between motor and screw."""

    ratio: Annotated[Quantity, Bound("-", 0.1, 100.0)]
    inertia: Annotated[Quantity, Bound("kg m2", 0.0, 0.1)]


class Screw(Bounded):
    """Ball screw with rod."""

    lead: Annotated[Quantity, Bound("mm", 0.5, 50.0)]
    efficiency: Annotated[Quantity, Bound("-", 0.1, 1.0)]
    friction: Annotated[Quantity, Bound("N", 0.0, 20000.0)]
    viscous: Annotated[Quantity, Bound("N m s/rad", 0.0, 1.0)]
    mass: Annotated[Quantity, Bound("kg", 0.0, 100.0)]
    stiffness: Annotated[Quantity, Bound("N/um", 1.0, 10000.0)]


class Bus(Bounded):
    """Direct-current bus of the amplifier; the actuator's usual temperature."""

    voltage: Annotated[Quantity, Bound("V", 1.0, 2000.0)]
    temperature: Annotated[Quantity, Bound("degC", -60.0, 200.0)]


class ElectromechanicalTable(Table):
    """``plant_electromechanical.toml``: the machine with the electromechanical actuator."""

    engine: Engine
    actuator: MotorActuator
    drive: Amplifier
    motor: ServoMotor
    gear: Gear
    screw: Screw
    supply: Bus
    sensors: Sensors

    @property
    def sides(self) -> int:
        """How many actuators it has."""
        return 1


AnyPlantTable = PlantTable | ElectromechanicalTable  # told apart by [actuator] kind
_TABLES: dict[str, type[PlantTable] | type[ElectromechanicalTable]] = dict(
    zip(KINDS, (PlantTable, ElectromechanicalTable), strict=True)
)


class _AnyTable(BaseModel):
    """What says of which kind a plant table is."""

    actuator: Any = None


def read_plant(source: str | Path = "plant.toml") -> AnyPlantTable:
    """Read a plant table of the kind that its ``[actuator] kind`` names (hydraulic where it names none).

    Raises InputError with file, key, value and what is allowed.
    """
    file = file_of(source)
    actuator = read(file, _AnyTable).actuator
    kind = actuator.get("kind", KINDS[0]) if isinstance(actuator, dict) else KINDS[0]
    if not isinstance(kind, str) or kind not in _TABLES:
        raise InputError(f"{file}: actuator.kind (={kind!r}) must be one of {', '.join(KINDS)}")
    return read(file, _TABLES[kind])


@dataclass(frozen=True)
class Nominal:
    """One parameter as an engineer knows it. ``value``, ``tolerance`` in ``unit``; ``si`` turns them into SI; ``row``
    of the plant's p.
    """

    name: str
    value: float
    tolerance: float
    unit: str
    si: float
    row: int


def names_of(kind: str, vanes: tuple[str, ...]) -> dict[str, int]:
    """Return the row of p of each named parameter that a machine with an actuator of this ``kind`` and these stages
    has.
    """
    rows = {NAMES[row]: row for row in own_rows(NAMES, vanes)}
    if kind == "hydraulic":
        return rows
    hydraulic = ("valve.", "supply.", "actuator.flow_gain", "actuator.area")
    own = {"drive.rated_current": RATED_CURRENT} | {n: KIND + 1 + i for i, n in enumerate(MOTOR_NAMES)}
    return {n: row for n, row in rows.items() if not n.startswith(hydraulic)} | own


def nominal(table: AnyPlantTable, geometry: Geometry) -> list[Nominal]:
    """Return every named parameter of the machine: those of `names_of` in their order, then each stage's link ``lc``
    and lever arm ``l``.

    These two stand for all lengths of the linkage, and so does their tolerance (`plant.geometry.length_tolerances`).
    """
    out = []
    rows = names_of(table.actuator.kind, geometry.vanes)
    if isinstance(table, PlantTable) and table.sides == 2:
        given = {name: UNISON + 1 + i for i, name in enumerate(UNISON_NAMES)}
        rows |= {name: row for name, row in given.items() if getattr(table.actuators, name.split(".")[1]) is not None}
    for name, row in rows.items():
        section, key = name.split(".")
        if section == "linkage":
            q = geometry.stage(key.removesuffix("_play")).hysteresis
        elif key.endswith("_bias"):
            q = table.sensors.pot_bias
        else:
            q = getattr(getattr(table, section), key)
        out.append(Nominal(name, q.value, q.tolerance, q.unit, _SI.get(q.unit, 1.0), row))
    for name, tolerance in length_tolerances(geometry).items():
        stage, key = name.split("_", 1)
        q = getattr(geometry.stage(stage), key)
        row = GEOMETRY + N_CRANK + VANES.index(stage) * N_PER_STAGE + {"lc": G_LC, "l": G_L}[key]
        out.append(Nominal(f"linkage.{name}", q.value, tolerance, q.unit, _SI[q.unit], row))
    return out


_NEUTRAL = np.concatenate([np.zeros(N_NOMINAL), NEUTRAL])  # of an effect: where it does nothing
_DRIVE_ROWS = np.array(rows_at("valve", "supply", "actuator", "lvdt"))
_LOAD_ROWS = np.array(
    [r for r in rows_at("supply", "actuator") if r not in (ROW["oil_viscosity"], ROW["end_stop_shift"])]
    + [ROW["valve_flow_saturation"] + 1]  # a round corner is worked out where the load is
)
_VANE_ROWS = np.array(rows_at("linkage", "pot"))
_VALVE_LAG, _LVDT_LAG, _POT_LAG, _AMPLIFIER_LAG = (
    ROW[e] for e in ("valve_lag", "lvdt_lag", "pot_lag", "amplifier_lag")
)


def derive(p: np.ndarray, dt: float, tick: float) -> None:
    """Work out the rows that follow from others: the valve's and the sensors' exact steps over ``dt`` and
    ``tick`` (s).
    """
    for j in range(p.shape[1]):
        derive_lane(p, j, dt, tick)


@in_place
def derive_lane(p: np.ndarray, j: int, dt: float, tick: float) -> None:
    """`derive` of lane ``j``."""
    if p[KIND, j] == 0.0:  # a motor has no valve
        a11, a12, a21, a22 = valve_matrix(p[BANDWIDTH, j], p[DAMPING, j], dt)
        p[VALVE_A11, j], p[VALVE_A12, j], p[VALVE_A21, j], p[VALVE_A22, j] = a11, a12, a21, a22
    p[LVDT_FACTOR, j] = lag_factor(p[LVDT_LAG, j], dt)
    p[POT_FACTOR, j] = lag_factor(p[POT_LAG, j], tick)
    p[VALVE_SHARE, j] = lag_factor(p[_VALVE_LAG, j], dt)
    p[LVDT_SHARE, j] = lag_factor(p[_LVDT_LAG, j], dt)
    for k in range(int(p[VANE_COUNT, j])):
        p[POT_SHARE + k, j] = lag_factor(pot_lag.step(p[POT_LAG, j], p[_POT_LAG + k, j]), tick)
    if p[KIND, j] != 0.0:
        h = dt / motor_steps(dt)
        p[CURRENT_SHARE, j] = lag_factor(1.0 / (2.0 * math.pi * p[CURRENT_BANDWIDTH, j]), h)
        p[AMPLIFIER_SHARE, j] = lag_factor(p[_AMPLIFIER_LAG, j], h)
    # a motor has no short way
    p[DRIVE_EFFECTS, j] = 1.0 if p[KIND, j] != 0.0 else changed(p, j, _DRIVE_ROWS)
    p[DRIVE_LOADED, j] = changed(p, j, _LOAD_ROWS)
    p[VANE_EFFECTS, j] = changed(p, j, _VANE_ROWS)
    if p[ACTUATORS, j] != 0.0:  # nor have two actuators
        p[DRIVE_EFFECTS, j] = p[DRIVE_LOADED, j] = p[VANE_EFFECTS, j] = 1.0
        p[POT_SHIFT, j] = 0.5 * math.cos(p[POT_POSITION, j])
    if p[CURVES, j] != 0.0:  # nor have curves
        p[DRIVE_EFFECTS, j] = p[VANE_EFFECTS, j] = 1.0
        if acts(p, j, LOAD_ADDS):
            p[DRIVE_LOADED, j] = 1.0


@in_place
def changed(p: np.ndarray, j: int, rows: np.ndarray) -> float:
    """Return 1 where any of these rows is not neutral, else 0."""
    for row in rows:
        if p[row, j] != _NEUTRAL[row]:
            return 1.0
    return 0.0


@compiled
def motor_steps(dt: float) -> int:
    """Into how many steps a motor divides a plant step ``dt`` (s)."""
    return max(1, math.ceil(dt / MOTOR_STEP - 1e-6))


def load_plant(
    source: str | Path = "plant.toml", geometry: str | Path = "geometry.toml"
) -> tuple[AnyPlantTable, Geometry, np.ndarray]:
    """Read, check and flatten the plant's tables.

    Returns the two tables and p, float64[N_PARAMETERS, actuators] in SI, without the derived rows (`derive`).
    The play's width at the ring is the published width at the vane over the lever's ratio Ld'/L at mid-stroke.
    Raises InputError with file, key, value and what is allowed.
    """
    table, geo = read_plant(source), load_geometry(geometry)
    p = np.zeros((N_PARAMETERS, 1))
    p[KIND, 0] = KINDS.index(table.actuator.kind)
    g = geo.arrays()
    p[GEOMETRY : GEOMETRY + len(g), 0] = g
    p[VANE_COUNT] = len(geo.vanes)
    for n in nominal(table, geo):
        p[n.row, 0] = n.value * n.si
    for k in range(len(geo.vanes)):
        o = N_CRANK + k * N_PER_STAGE
        p[PLAY + k, 0] = g[o + G_HYSTERESIS] * g[o + G_L] / g[o + G_LDP]
    p[N_NOMINAL:DERIVED, 0] = NEUTRAL
    p[LVDT_STEP, 0] = table.sensors.lvdt_range.value * 1e-3 / 2.0**table.sensors.lvdt_bits.value
    if isinstance(table, PlantTable) and table.actuators is not None and table.sides == 2:
        p[ACTUATORS, 0] = 2.0
        p = np.repeat(p, 2, axis=1)  # side B is as A, but for:
        for key, row in _OF_B.items():
            if (q := getattr(table.actuators.b, key)) is not None:
                p[row, 1] = q.value * _SI.get(q.unit, 1.0)
    return table, geo, p
