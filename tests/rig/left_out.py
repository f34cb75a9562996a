"""Effects of the product's library that are functions of one quantity: what learning should find where one of them is
not in the library.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np

from .effects import Hidden
from .geometry import STAGES
from .kernel import HALF_STROKE

__all__ = ["LEFT_OUT", "Truth"]

Array = np.ndarray
STROKE = ("x_lvdt", "vigv", "vgv1", "vgv2")  # go together


@dataclass(frozen=True)
class Truth:
    """What an effect is as a curve.

    curves  names of the curves that are it, ``place.curve_of_QUANTITY``, with ``{vane}`` for the stage that it is in
    value   (the hidden effect's sizes in SI, values of the quantity) -> the first curve, all but the sizes as logs have
            them; None: no closed form there
    forms   formulas that it is, in the product's names; ``also``: those of a curve where they are others
    """

    curves: tuple[str, ...]
    value: Callable[[Mapping[str, float], Array], Array] | None = None
    forms: tuple[str, ...] = ()
    also: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    def names(self, hidden: Hidden) -> list[str]:
        """The curves by name."""
        vane = STAGES[int(hidden.parameters["stage"])] if "stage" in hidden.parameters else ""
        return [c.replace("{vane}", vane) for c in self.curves]

    def forms_of(self, curve: str, hidden: Hidden) -> tuple[str, ...]:
        """The formulas that the effect is as a curve of this name; none where it is no curve of that name."""
        return self.also.get(curve, self.forms) if curve in self.names(hidden) else ()

    def of(self, hidden: Hidden) -> Callable[[Array], Array] | None:
        """The first curve with the sizes that are hidden."""
        value = self.value
        return None if value is None else lambda x: value(hidden.parameters, x)


def _of(place: str, quantities: tuple[str, ...], word: str = "curve") -> tuple[str, ...]:
    return tuple(f"{place}.{word}_of_{q}" for q in quantities)


def _asymmetry(v: Mapping[str, float], i: Array) -> Array:
    root = math.sqrt(v["ratio"])
    return np.where(i > 0.0, (root - 1.0) * i, (1.0 / root - 1.0) * i)


def _nonlinearity(v: Mapping[str, float], x: Array) -> Array:
    return np.asarray(1e3 * v["amplitude"] * np.sin(math.pi * (x * 1e-3 - HALF_STROKE) / HALF_STROKE))


LINE = ("line", "straight line")
# Left out are effects with memory, constants, and what is a function of two quantities.
LEFT_OUT: Mapping[str, Truth] = MappingProxyType(
    {
        "valve_dead_band": Truth(
            (*_of("valve.opening", ("i_cmd",)), *_of("valve.current", ("i_cmd",))),
            lambda v, i: -np.clip(i, -1e3 * v["half_width"], 1e3 * v["half_width"]),
            ("limit", "limit to one side"),
        ),
        "valve_gain_asymmetry": Truth(
            (
                *_of("valve.opening", ("i_cmd",)),
                *_of("valve.current", ("i_cmd",)),
                *_of("actuator.flow_gain", ("i_cmd",), "gain"),
            ),
            _asymmetry,
            ("magnitude", "above", "below"),
            {"actuator.flow_gain.gain_of_i_cmd": ("step",)},
        ),
        "oil_viscosity": Truth(
            _of("actuator.flow_gain", ("t_oil",), "gain"), lambda v, t: v["coefficient"] * (t - 40.0), LINE
        ),
        "aero_load": Truth(
            _of("actuator.load", ("n_r",)), lambda v, n: v["force"] * (0.01 * n) ** 2, ("square", "power")
        ),
        "piston_friction": Truth(
            _of("actuator.load", ("speed_of_x_lvdt", "direction_of_x_lvdt")),
            None,
            ("sign", "step", "tanh"),
            {"actuator.load.curve_of_direction_of_x_lvdt": ("line",)},
        ),
        "lvdt_gain": Truth(_of("sensors.lvdt", STROKE), lambda v, x: (1.0 - 1.0 / v["factor"]) * x, LINE),
        "lvdt_nonlinearity": Truth(_of("sensors.lvdt", STROKE), _nonlinearity, ("sine",)),
        "lvdt_thermal_drift": Truth(
            _of("sensors.lvdt", ("t_oil",)), lambda v, t: 1e3 * v["coefficient"] * (t - 40.0), LINE
        ),
        "thermal_growth": Truth(
            (*_of("linkage.{vane}_ring", ("t_oil",)), *_of("sensors.{vane}", ("t_oil",))), None, LINE
        ),
        "linkage_compliance": Truth(
            _of("linkage.ring", ("n_r",)),
            lambda v, n: -np.degrees(v["compliance"]) * (0.01 * n) ** 2,
            ("square", "power"),
        ),
        "ring_eccentricity": Truth(
            (*_of("linkage.{vane}_ring", STROKE), *_of("sensors.{vane}", STROKE)), None, ("sine",)
        ),
        "pot_gain": Truth(_of("sensors.{vane}", ("{vane}", *STROKE)), lambda v, a: (1.0 - 1.0 / v["factor"]) * a, LINE),
    }
)
