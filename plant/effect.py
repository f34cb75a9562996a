"""What an effect of the library declares about itself: where it acts, its parameters with units and bounds, where it
shows.

An effect is one file in `plant.effects`: a docstring, `EFFECT` (this module's `Effect`), and a compiled scalar
``step``. Parameters are declared in the units of the borders (mm, mA, MPa, deg, ...); ``step`` and the plant's arrays
are in SI.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from vaneloop.base.vanes import VANES

__all__ = [
    "DEG", "HYDRAULIC", "KINDS", "MOTOR", "PAIR", "SITES", "STAGES", "T_REF", "UNITS", "Effect", "Parameter",
    "per_vane_stage",
]  # fmt: skip

DEG = math.pi / 180.0
T_REF = 40.0  # degC: oil temperature at which what grows with temperature is nil
SITES = (
    "demand", "engine", "valve", "supply", "amplifier", "motor", "screw", "actuator", "lvdt", "link", "linkage", "pot",
)  # fmt: skip
KINDS = ("hydraulic", "electromechanical")  # of actuators, by their number in `plant.layout.KIND`
HYDRAULIC, MOTOR = KINDS[:1], KINDS[1:]
PAIR = ("two hydraulic",)  # on the same rings: such a machine has what is of hydraulic ones, too
STAGES = ("demand", "servo", "engine", "actuator", "linkage")

UNITS = {  # border unit -> factor into SI (speeds stay in %, temperatures in degC)
    "-": 1.0,
    "s": 1.0,
    "%/s": 1.0,
    "mm": 1e-3,
    "mm/s": 1e-3,
    "mA": 1e-3,
    "N": 1.0,
    "N/(m/s)": 1.0,
    "MPa/(m/s)": 1e6,
    "mm/s/MPa": 1e-9,
    "mm/kN": 1e-6,
    "1/K": 1.0,
    "mm/K": 1e-3,
    "deg": DEG,
    "deg/K": DEG,
    "deg/h": DEG / 3600.0,
}


@dataclass(frozen=True)
class Parameter:
    """One number of an effect, in ``unit``: its neutral value, physical bounds and meaning. ``si`` turns it into SI.

    ``period``: after which it repeats itself, as an angle does; from ``low`` to ``high`` is then one turn. 0: it does
    not. ``vane``: the stage whose number it is; "": the machine's. ``beyond``: the stage's number in geometry.toml that
    it adds to; their sum is never negative.
    """

    name: str
    unit: str
    neutral: float
    low: float
    high: float
    meaning: str
    period: float = 0.0
    vane: str = ""
    beyond: str = ""

    def __post_init__(self) -> None:
        if self.unit not in UNITS:
            raise ValueError(f"{self.name}: unit (={self.unit!r}) must be one of {', '.join(UNITS)}")
        if not self.low <= self.neutral <= self.high:
            raise ValueError(
                f"{self.name}: neutral (={self.neutral:g} {self.unit}) must be in [{self.low:g}, {self.high:g}]"
            )
        if self.period and self.period != self.high - self.low:
            raise ValueError(f"{self.name}: period (={self.period:g} {self.unit}) must be high - low")

    @property
    def si(self) -> float:
        """Factor from ``unit`` into SI."""
        return UNITS[self.unit]


@dataclass(frozen=True)
class Effect:
    """One physical effect.

    name        of the effect and of its file
    site        part of the machine where it acts, one of `SITES`
    stages      stages of the diagnosis, of `STAGES`, in whose logged input or output it shows
    parameters  in the order of the plant's rows; neutral values make the effect an exact identity
    states      names of what it remembers, in the order of the plant's rows
    summary     one line for lists
    excites     what a log must hold for it to show, in words
    kinds       of actuators, of `KINDS` and `PAIR`, that can have it
    """

    name: str
    site: str
    stages: tuple[str, ...]
    parameters: tuple[Parameter, ...]
    states: tuple[str, ...]
    summary: str
    excites: str
    kinds: tuple[str, ...] = KINDS

    def __post_init__(self) -> None:
        if self.site not in SITES:
            raise ValueError(f"{self.name}: site (={self.site!r}) must be one of {', '.join(SITES)}")
        if not self.stages or not set(self.stages) <= set(STAGES):
            raise ValueError(f"{self.name}: stages (={self.stages!r}) must be of {', '.join(STAGES)}")
        if not self.kinds or not set(self.kinds) <= {*KINDS, *PAIR}:
            raise ValueError(f"{self.name}: kinds (={self.kinds!r}) must be of {', '.join((*KINDS, *PAIR))}")
        if len({p.name for p in self.parameters}) != len(self.parameters) or not self.parameters:
            raise ValueError(f"{self.name}: parameters must be there and have different names")

    def __getitem__(self, name: str) -> Parameter:
        """Return the parameter of that name; KeyError names it."""
        for p in self.parameters:
            if p.name == name:
                return p
        raise KeyError(f"{self.name}.{name}")


def per_vane_stage(
    unit: str, neutral: float, low: float, high: float, meaning: str, beyond: str = ""
) -> tuple[Parameter, ...]:
    """Return the same parameter for every stage that a machine can have, fitted jointly for those that it has."""
    return tuple(Parameter(v, unit, neutral, low, high, meaning, vane=v, beyond=beyond) for v in VANES)
