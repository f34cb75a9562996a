"""Laws of the product's library that are functions of one quantity: what learning should find where one of them is
not in the library.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tests.rig_systems.family import Array, Family, Hidden
from tests.rig_systems.laws import on_signal, state_loss

__all__ = ["FORMS", "Truth", "laws_of", "truth_of"]

# The formula that each law is, in the product's names; empty: none of its formulas, such as a straight line less a
# root. Left out are laws with memory, a rounding (a saw with more teeth than a curve has knots), and stops of a state.
FORMS: dict[str, frozenset[str]] = {
    law: frozenset(names.split("|") if names else ())
    for law, names in (
        ("bias", "constant"),
        ("gain", "line"),
        ("asymmetric_gain", "magnitude|above|below"),
        ("absolute_value", "below|limit to one side"),
        ("square_root", ""),
        ("cubic", "cube"),
        ("dead_zone", "limit|limit to one side"),
        ("saturation", "above|below"),
        ("smooth_saturation", ""),
        ("force_offset", "constant"),
        ("viscous", "line"),
        ("coulomb", "sign|step"),
        ("stribeck", ""),
        ("quadratic_drag", "signed square|square"),
        ("spring", "line"),
        ("cubic_spring", "cube"),
        ("offset", "constant"),
        ("leak", "line"),
    )
}
CONSTANT = ("bias", "force_offset", "offset")


@dataclass(frozen=True)
class Truth:
    """What a law is as a curve.

    at, quantity  its place and what it is a function of, as the product names them; "": a constant, of whatever
    value         the curve at values of its quantity, in the model's units; ``forms``: of `FORMS`
    """

    at: str
    quantity: str
    value: Callable[[Array], Array]
    forms: frozenset[str]

    def found(self, name: str) -> bool:
        """Whether a learned law, ``place.curve_of_QUANTITY``, is at the place and of the quantity."""
        place, _, quantity = name.partition(".curve_of_")
        return place == self.at and quantity != "" and self.quantity in ("", quantity)


def laws_of(f: Family) -> list[str]:
    """Names of the laws of a family that can be left out."""
    return [name for name in f.laws if _kept(f, name)]


def _kept(f: Family, name: str) -> bool:
    place, _, law = name.rpartition(".")
    return law in FORMS and (f.where(place)[0] != "state" or law != "saturation") and name not in f.partners


def truth_of(f: Family, hidden: Hidden, greatest: float) -> Truth:
    """A hidden law as a curve; ``greatest``: magnitude that a square root leaves as it is."""
    kind, i = f.where(hidden.place)
    law, v, at = hidden.law, hidden.values, hidden.place
    if kind == "force":
        spring = law in ("spring", "cubic_spring")
        if f.kind == "force":
            of = "position" if spring else "velocity"
        else:
            of = f.rates[f.states[i]] if spring else at
        value = _force_of(law, v)
    elif kind == "state":
        of, value = at, np.vectorize(lambda x: state_loss(law, v, float(x)), otypes=[float])
    else:
        of = at.removesuffix("_sensor")

        def value(x: Array) -> Array:
            return on_signal(law, v, np.asarray(x, dtype=float), 1.0, True, greatest) - x

    return Truth(at, "" if law in CONSTANT else of, value, FORMS[law])


def _force_of(law: str, v: dict[str, float]) -> Callable[[Array], Array]:
    """The force of a law over the speed, or over the displacement of a spring."""
    return {
        "force_offset": lambda x: v["force"] + 0.0 * x,
        "viscous": lambda x: v["coefficient"] * x,
        "coulomb": lambda x: v["friction"] * np.sign(x),
        "stribeck": lambda x: np.sign(x) * (v["friction"] + v["breakaway_excess"] * np.exp(-((x / v["speed"]) ** 2))),
        "quadratic_drag": lambda x: v["coefficient"] * x * np.abs(x),
        "spring": lambda x: v["stiffness"] * x,
        "cubic_spring": lambda x: v["stiffness"] * x**3,
    }[law]
