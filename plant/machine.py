"""A plant ready to run: its parameters in SI, its starting state, its sensors' noise."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Protocol

import numpy as np

from plant import chain
from plant.effect import PAIR, T_REF, Effect, Parameter
from plant.effects import EFFECTS, ROW, states_of
from plant.geometry import Geometry, Schedules, load_schedules
from plant.linkage import G_L, G_LDP, N_CRANK, N_PER_STAGE
from plant.parameters import GEOMETRY, LINE_CONDUCTANCE, AnyPlantTable, Nominal, Supply, derive, load_plant, nominal
from plant.places import AERO_LOAD
from vaneloop.base.errors import InputError
from vaneloop.base.vanes import own_rows, same_stages

__all__ = ["Additions", "Plant", "build_plant"]


@dataclass(frozen=True)
class Plant:
    """One machine.

    table, geometry, schedules  the tables it came from
    p      float64[N_PARAMETERS, actuators], SI, derived rows included; of two, A's numbers, then B's
    sigma  float64[2 + stages]: rms noise of LVDT (m), each potentiometer (rad), speed (%); one more of two actuators,
           that of B's LVDT
    """

    table: AnyPlantTable
    geometry: Geometry
    schedules: Schedules
    p: np.ndarray
    sigma: np.ndarray

    @property
    def kind(self) -> str:
        """Kind of its actuator, one of `plant.effect.KINDS`."""
        return self.table.actuator.kind

    @property
    def sides(self) -> int:
        """How many actuators it has."""
        return self.table.sides

    def can_have(self, effect: Effect) -> bool:
        """Whether an effect is of its kind of actuator."""
        return self.kind in effect.kinds or (self.sides == 2 and effect.kinds == PAIR)

    def lacks(self, effect: Effect) -> str:
        """Why it cannot have an effect, after the effect's name: "is of ...; this machine's ..."; empty if it can."""
        if self.can_have(effect):
            return ""
        if effect.kinds == PAIR:
            return f"is of {PAIR[0]} actuators on the same rings; this machine has one"
        return f"is of an actuator of kind {', '.join(effect.kinds)}; this machine's is {self.kind}"

    def of_one_actuator(self, what: str) -> None:
        """Refuse a machine with two actuators: InputError in one line, for ``what`` takes one alone."""
        if self.sides != 1:
            raise InputError(f"plant table: actuators.number (={self.sides}) must be 1 for {what} (docs/machines.md)")

    @property
    def one_valve(self) -> bool:
        """Whether both of its actuators hang on one valve."""
        return bool(self.p[LINE_CONDUCTANCE, 0] != 0.0)

    @property
    def share_of_load(self) -> float:
        """What each of its pistons has of the air's load."""
        return 1.0 / self.sides

    def alone(self, side: int) -> Plant:
        """One of two actuators (0 A, 1 B) with its share of the air's load and no rings: a lane of its own."""
        p = np.ascontiguousarray(self.p[:, side : side + 1])
        p[AERO_LOAD] *= self.share_of_load
        return replace(self, p=p)

    def nominal_of(self, n: Nominal, side: int) -> float:
        """Value of a nominal parameter at one of two actuators (0 A, 1 B), in its table's unit."""
        own = getattr(self.table, "actuators", None) if side else None
        given = getattr(own.b, n.name.split(".")[1], None) if own is not None else None
        return n.value if given is None else float(given.value)

    @property
    def usual(self) -> dict[str, float]:
        """Value of a channel that a log may lack, in border units: of what feeds the actuator."""
        supply = self.table.supply
        pressure = supply.pressure.value if isinstance(supply, Supply) else 0.0  # a motor needs no oil
        return {"p_s": pressure, "t_oil": supply.temperature.value}

    @property
    def usual_within(self) -> dict[str, float]:
        """Half-width of the plausible interval around each of `usual`, in border units; 0: nobody says."""
        supply = self.table.supply
        pressure = supply.pressure.tolerance if isinstance(supply, Supply) else 0.0
        return {"p_s": pressure, "t_oil": supply.temperature.tolerance}

    @property
    def vanes(self) -> tuple[str, ...]:
        """The machine's stages, in order."""
        return self.geometry.vanes

    @cached_property
    def nominal(self) -> list[Nominal]:
        """Every named parameter (`plant.parameters.nominal`)."""
        return nominal(self.table, self.geometry)

    @cached_property
    def rows(self) -> np.ndarray:
        """int64: rows of the state s that the machine has, which its fingerprint covers; the others are of stages that
        it lacks, and of another kind of actuator.
        """
        own = set(own_rows(chain.STATE, self.vanes))
        rows = np.array([row for row in states_of(self.kind) if row in own])
        rows.setflags(write=False)
        return rows

    def parameters_of(self, effect: str) -> dict[int, Parameter]:
        """Parameters of an effect, by their rows of p, that this machine has: none of stages it lacks, and no less play
        than all of a stage's.
        """
        own = {}
        for row, q in enumerate(EFFECTS[effect].parameters, ROW[effect]):
            if q.vane in ("", *self.vanes):
                nominal = getattr(self.geometry.stage(q.vane), q.beyond).value if q.beyond else np.inf
                own[row] = replace(q, low=max(q.low, -nominal))
        return own

    def start(self, stroke: float, n_r: float, t_oil: float = T_REF) -> np.ndarray:
        """Return a state at rest at ``stroke`` (m), speed ``n_r`` (%) and ``t_oil`` (degC), every ring in the middle of
        its play.
        """
        s = np.zeros((chain.N_STATE, self.sides))
        chain.rest(s, self.p, 0, stroke, n_r, t_oil)
        return s

    def place_rings(self, s: np.ndarray, angles: tuple[float, ...], n_r: float = 0.0, t_oil: float = T_REF) -> None:
        """Set each ring, as far as its play allows, to where its angle reads as the given one (rad; NaN = leave it)."""
        chain.place_rings(s, self.p, 0, np.array(angles), n_r, t_oil)

    def lever(self, k: int) -> tuple[float, float]:
        """Return Ld' and L (m) of stage ``k``: their ratio turns a small angle of the ring into one of the vane."""
        o = GEOMETRY + N_CRANK + k * N_PER_STAGE
        return float(self.p[o + G_LDP, 0]), float(self.p[o + G_L, 0])


class Additions(Protocol):
    """What a machine has beyond its tables, as a `plant.model.Model` says."""

    def plant(self, base: Plant | None = None) -> Plant:
        """Return ``base`` with it."""


def build_plant(
    source: str | Path = "plant.toml",
    geometry: str | Path = "geometry.toml",
    schedules: str | Path = "schedules.toml",
    model: Additions | None = None,
) -> Plant:
    """Read the plant's tables and return the machine they describe, with what ``model`` adds. InputError for what
    cannot be used.
    """
    table, geo, p = load_plant(source, geometry)
    derive(p, chain.TICK / chain.SUBSTEPS, chain.TICK)
    deg = np.pi / 180.0
    sensors = table.sensors
    sigma = np.array(
        [sensors.lvdt_noise.value * 1e-3, *[sensors.pot_noise.value * deg] * len(geo.vanes), sensors.speed_noise.value]
    )
    if table.sides == 2:
        sigma = np.append(sigma, sigma[0])
    targets = load_schedules(schedules)
    same_stages(**{str(geometry): geo.vanes, str(schedules): targets.vanes})
    plant = Plant(table, geo, targets, p, sigma)
    return model.plant(plant) if model is not None else plant
