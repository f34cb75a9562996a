"""The plant's numbers: read from ``plant.toml`` and ``geometry.toml``, laid out flat for the compiled chain."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np

from plant.geometry import Geometry, load_geometry
from plant.linkage import G_HYSTERESIS, G_L, G_LDP, N_CRANK, N_GEOMETRY, N_PER_STAGE, STAGES
from plant.sensors import lag_factor
from plant.valve import valve_matrix
from tables import Bound, Bounded, Quantity, Table, read

__all__ = ["NAMES", "Nominal", "PlantTable", "derive", "load_plant", "nominal"]

# Rows of the parameter array p[row, lane]. Named rows first: they are what an engineer can recalibrate.
NAMES = (
    "engine.lag",
    "engine.acceleration",
    "engine.deceleration",
    "valve.rated_current",
    "valve.bandwidth",
    "valve.damping",
    "actuator.flow_gain",
    "actuator.area",
    "actuator.stroke",
    "supply.pressure",
    "sensors.lvdt_lag",
    "sensors.pot_lag",
    "linkage.vigv_play",
    "linkage.vgv1_play",
    "linkage.vgv2_play",
    "sensors.vigv_bias",
    "sensors.vgv1_bias",
    "sensors.vgv2_bias",
)
(
    LAG,
    ACCELERATION,
    DECELERATION,
    RATED_CURRENT,
    BANDWIDTH,
    DAMPING,
    FLOW_GAIN,
    AREA,
    STROKE,
    P_REF,
    LVDT_LAG,
    POT_LAG,
    PLAY,  # three rows: total width at the ring, rad
    _,
    _,
    POT_BIAS,  # three rows, rad
    _,
    _,
) = range(len(NAMES))
GEOMETRY = len(NAMES)  # N_GEOMETRY rows, see plant.linkage
# rows worked out from the others by `derive`
(LVDT_STEP, VALVE_A11, VALVE_A12, VALVE_A21, VALVE_A22, LVDT_FACTOR, POT_FACTOR, N_PARAMETERS) = range(
    GEOMETRY + N_GEOMETRY, GEOMETRY + N_GEOMETRY + 8
)
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
    """One parameter as an engineer knows it. ``value``, ``tolerance`` in ``unit``; ``si`` turns them into SI."""

    name: str
    value: float
    tolerance: float
    unit: str
    si: float


def nominal(table: PlantTable, geometry: Geometry) -> list[Nominal]:
    """Return every named parameter in the order of `NAMES`."""
    out = []
    for name in NAMES:
        section, key = name.split(".")
        if section == "linkage":
            q = getattr(geometry, key.removesuffix("_play")).hysteresis
        elif key.endswith("_bias"):
            q = table.sensors.pot_bias
        else:
            q = getattr(getattr(table, section), key)
        out.append(Nominal(name, q.value, q.tolerance, q.unit, _SI.get(q.unit, 1.0)))
    return out


def derive(p: np.ndarray, dt: float, tick: float) -> None:
    """Work out the rows that follow from others: the valve's and the sensors' exact steps over ``dt`` and ``tick`` (s)."""
    for j in range(p.shape[1]):
        p[VALVE_A11 : VALVE_A22 + 1, j] = valve_matrix(p[BANDWIDTH, j], p[DAMPING, j], dt)
        p[LVDT_FACTOR, j] = lag_factor(p[LVDT_LAG, j], dt)
        p[POT_FACTOR, j] = lag_factor(p[POT_LAG, j], tick)


def load_plant(source: str | Path = "plant.toml", geometry: str | Path = "geometry.toml") -> tuple[PlantTable, Geometry, np.ndarray]:
    """Read, check and flatten the plant's tables.

    Returns the two tables and p, float64[N_PARAMETERS, 1] in SI, without the derived rows (`derive`).
    The play's width at the ring is the published width at the vane over the lever's ratio Ld'/L at mid-stroke.
    Raises InputError with file, key, value and what is allowed.
    """
    table, geo = read(source, PlantTable), load_geometry(geometry)
    p = np.zeros((N_PARAMETERS, 1))
    g = geo.arrays()
    for row, n in enumerate(nominal(table, geo)):
        p[row, 0] = n.value * n.si
    p[GEOMETRY : GEOMETRY + N_GEOMETRY, 0] = g
    for k in range(len(STAGES)):
        o = N_CRANK + k * N_PER_STAGE
        p[PLAY + k, 0] = g[o + G_HYSTERESIS] * g[o + G_L] / g[o + G_LDP]
    p[LVDT_STEP, 0] = table.sensors.lvdt_range.value * 1e-3 / 2.0 ** table.sensors.lvdt_bits.value
    return table, geo, p
