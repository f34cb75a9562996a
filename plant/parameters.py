"""The plant's numbers: read from ``plant.toml`` and ``geometry.toml``, laid out flat for the compiled chain."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np

from plant.effects import DERIVED, N_PARAMETERS, NEUTRAL, ROW, pot_lag, rows_at
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
    N_NOMINAL,
    NAMES,
    P_REF,
    PLAY,
    POT_BIAS,
    POT_FACTOR,
    POT_LAG,
    RATED_CURRENT,
    STROKE,
    VALVE_A11,
    VALVE_A12,
    VALVE_A21,
    VALVE_A22,
    VANE_COUNT,
)
from plant.linkage import G_HYSTERESIS, G_L, G_LC, G_LDP, N_CRANK, N_PER_STAGE
from plant.sensors import lag_factor
from plant.valve import valve_matrix
from vaneloop.base.tables import Bound, Bounded, Quantity, Table, read
from vaneloop.base.vanes import VANES, own_rows

__all__ = [
    "ACCELERATION",
    "AREA",
    "BANDWIDTH",
    "DAMPING",
    "DECELERATION",
    "DRIVE_EFFECTS",
    "DRIVE_LOADED",
    "FLOW_GAIN",
    "GEOMETRY",
    "LAG",
    "LVDT_FACTOR",
    "LVDT_LAG",
    "LVDT_SHARE",
    "LVDT_STEP",
    "NAMES",
    "N_NOMINAL",
    "N_PARAMETERS",
    "PLAY",
    "POT_BIAS",
    "POT_FACTOR",
    "POT_LAG",
    "POT_SHARE",
    "P_REF",
    "RATED_CURRENT",
    "STROKE",
    "VALVE_A11",
    "VALVE_A12",
    "VALVE_A21",
    "VALVE_A22",
    "VALVE_SHARE",
    "VANE_COUNT",
    "VANE_EFFECTS",
    "Nominal",
    "PlantTable",
    "derive",
    "load_plant",
    "nominal",
]

# rows of p that `derive` works out from the effects' parameters
DRIVE_EFFECTS = DERIVED  # 0 where every effect from valve to LVDT is neutral: the chain takes its short way
DRIVE_LOADED = DERIVED + 1  # 0 where neither a load nor the oil's pressure changes the motion
VANE_EFFECTS = DERIVED + 2  # as the first, from linkage to potentiometers
VALVE_SHARE = DERIVED + 3  # valve_lag and lvdt_lag: share of the way in one plant step
LVDT_SHARE = DERIVED + 4
POT_SHARE = DERIVED + 5  # a row a stage: the potentiometers' share in one tick, pot_lag included

_SI = {"mm": 1e-3, "mA": 1e-3, "ms": 1e-3, "MPa": 1e6, "deg": math.pi / 180.0}


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


class PlantTable(Table):
    """``plant.toml``."""

    engine: Engine
    valve: Valve
    actuator: Actuator
    supply: Supply
    sensors: Sensors


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


def nominal(table: PlantTable, geometry: Geometry) -> list[Nominal]:
    """Return every named parameter of the machine: those of `NAMES` in their order, then each stage's link ``lc`` and
    lever arm ``l``.

    These two stand for all lengths of the linkage, and so does their tolerance (`plant.geometry.length_tolerances`).
    """
    out = []
    for row in own_rows(NAMES, geometry.vanes):
        name = NAMES[row]
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


_NEUTRAL = np.concatenate([np.zeros(N_NOMINAL), NEUTRAL])[:, None]
_DRIVE_ROWS = rows_at("valve", "supply", "actuator", "lvdt")
_LOAD_ROWS = [r for r in rows_at("supply", "actuator") if r not in (ROW["oil_viscosity"], ROW["end_stop_shift"])]
_LOAD_ROWS.append(ROW["valve_flow_saturation"] + 1)  # a round corner is worked out where the load is
_VANE_ROWS = rows_at("linkage", "pot")


def derive(p: np.ndarray, dt: float, tick: float) -> None:
    """Work out the rows that follow from others: the valve's and the sensors' exact steps over ``dt`` and
    ``tick`` (s).
    """
    for j in range(p.shape[1]):
        p[VALVE_A11 : VALVE_A22 + 1, j] = valve_matrix(p[BANDWIDTH, j], p[DAMPING, j], dt)
        p[LVDT_FACTOR, j] = lag_factor(p[LVDT_LAG, j], dt)
        p[POT_FACTOR, j] = lag_factor(p[POT_LAG, j], tick)
        p[VALVE_SHARE, j] = lag_factor(p[ROW["valve_lag"], j], dt)
        p[LVDT_SHARE, j] = lag_factor(p[ROW["lvdt_lag"], j], dt)
        for k in range(int(p[VANE_COUNT, j])):
            p[POT_SHARE + k, j] = lag_factor(pot_lag.step(p[POT_LAG, j], p[ROW["pot_lag"] + k, j]), tick)
    for flag, rows in ((DRIVE_EFFECTS, _DRIVE_ROWS), (DRIVE_LOADED, _LOAD_ROWS), (VANE_EFFECTS, _VANE_ROWS)):
        p[flag] = np.any(p[rows] != _NEUTRAL[rows], axis=0)


def load_plant(
    source: str | Path = "plant.toml", geometry: str | Path = "geometry.toml"
) -> tuple[PlantTable, Geometry, np.ndarray]:
    """Read, check and flatten the plant's tables.

    Returns the two tables and p, float64[N_PARAMETERS, 1] in SI, without the derived rows (`derive`).
    The play's width at the ring is the published width at the vane over the lever's ratio Ld'/L at mid-stroke.
    Raises InputError with file, key, value and what is allowed.
    """
    table, geo = read(source, PlantTable), load_geometry(geometry)
    p = np.zeros((N_PARAMETERS, 1))
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
    return table, geo, p
