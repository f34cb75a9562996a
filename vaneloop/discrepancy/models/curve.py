"""A curve in a user's own model: what it does, where, and of which quantity it is a function.

| how                        | at a place    | does                                                                  |
|----------------------------|---------------|-----------------------------------------------------------------------|
| parameter times            | a parameter   | p (1 + c(q))                                                          |
| input adds, input times    | an input      | u + c(q), u (1 + c(q))                                                |
| state adds                 | a derivative  | c(q) is taken off it; where a mass divides forces, off the force there |
| force adds                 | kind force    | c(q) is added to the force                                            |
| output adds, output times  | an output     | y + c(q), y (1 + c(q))                                                |

The quantity q is a simulated state or output, what drives the model, or a column that is known beforehand
(`vaneloop.discrepancy.models.quantities`). Beyond the values that q has had a curve stays as at its end.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from vaneloop.base.curve import POINTS
from vaneloop.discrepancy.models.memory import STOPS, of_stops
from vaneloop.discrepancy.stage import Array

if TYPE_CHECKING:
    from vaneloop.discrepancy.models.data import Data

__all__ = ["COLUMN", "HOW", "INPUT", "OUTPUT", "SENSED", "Curve", "bent", "curves_for_kernel"]

INPUT, OUTPUT, COLUMN = 100, 200, 300  # numbers of quantities: states are below
HOW = {
    "parameter times": 1, "input adds": 2, "input times": 3, "state adds": 4, "output adds": 5, "output times": 6,
    "force adds": 5,
}  # fmt: skip
SENSED = ("output adds", "output times")


@dataclass(frozen=True)
class Curve:
    """A curve at a place.

    how       see above; ``place``: index of the parameter, input, state or output
    of        number of the quantity (state, INPUT + k, OUTPUT + k, COLUMN: known beforehand); ``quantity``: its name
    low, high the range in which it bends
    table     from its parameters to the curve at `POINTS` points, evenly from low to high
    """

    how: str
    place: int
    of: int
    quantity: str
    low: float
    high: float
    table: Callable[[Array], Array]

    def at(self, q: Array, table: Array) -> Array:
        """The curve at values of its quantity; of stops, at a course of what they follow."""
        if self.quantity.startswith(STOPS):
            return of_stops(q, self.low, self.high, table)
        return np.interp(q, np.linspace(self.low, self.high, POINTS), table)

    def values(self, data: Data, log: int, u: Array, y: Array | None = None) -> Array:
        """Its quantity on a log, of a model that is not simulated."""
        if self.of >= COLUMN:
            return data.column(log, self.quantity)
        if self.of >= OUTPUT:
            return np.asarray(data.y[log][self.of - OUTPUT] if y is None else y[self.of - OUTPUT])
        return np.asarray(u[self.of - INPUT])


Active = Sequence[tuple[Curve, Array]]


def bent(curves: Active, data: Data, log: int, u: Array, p: Array) -> tuple[Array, Array]:
    """What drives a model that is not simulated, and its parameters, as the curves leave them: a parameter is then one
    value a sample.
    """
    u, known = u.copy(), list(p)
    for curve, table in curves:
        c = curve.at(curve.values(data, log, u), table)
        if curve.how == "parameter times":
            known[curve.place] = known[curve.place] * (1.0 + c)
        elif curve.how == "input adds":
            u[curve.place] = u[curve.place] + c
        elif curve.how == "input times":
            u[curve.place] = u[curve.place] * (1.0 + c)
    return u, known  # type: ignore[return-value]  # the model takes both numbers and arrays


def curves_for_kernel(curves: Active, data: Data, log: int, n: int) -> tuple[Array, ...]:
    """The last arguments of a compiled simulation with curves."""
    of, low, high, tables, columns = [], [], [], [], []
    for c, table in curves:
        a, b = c.low, c.high
        if c.of >= COLUMN:
            column = data.column(log, c.quantity)[:n]
            if c.quantity.startswith(STOPS):  # what they make of it, as it is
                column = c.at(column, table)
                b = max(float(np.abs(column).max()), 1e-300)
                a, table = -b, np.linspace(-b, b, POINTS)
            columns.append(column)
        of.append(COLUMN + len(columns) - 1 if c.of >= COLUMN else c.of)
        low.append(a)
        high.append(b)
        tables.append(table)
    return (
        np.array([HOW[c.how] for c, _ in curves], dtype=np.int64),
        np.array([c.place for c, _ in curves], dtype=np.int64), np.array(of, dtype=np.int64),
        np.array(low), np.array(high), np.ascontiguousarray(tables), np.array(columns).reshape(len(columns), n),
    )  # fmt: skip
