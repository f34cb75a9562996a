"""A curve in a user's own model: what it does, where, and of which quantity it is a function.

| how                        | at a place    | does                                                                  |
|----------------------------|---------------|-----------------------------------------------------------------------|
| parameter times            | a parameter   | p (1 + c(q))                                                          |
| input adds, input times    | an input      | u + c(q), u (1 + c(q))                                                |
| state adds                 | a derivative  | c(q) is taken off it; where a mass divides forces, off the force there |
| force adds                 | kind force    | c(q) is added to the force                                            |
| output adds, output times  | an output     | y + c(q), y (1 + c(q))                                                |

The quantity q is a simulated state or output, what drives the model, or a column that is known beforehand
(`identification.user_models.exogenous_regressors`), or the difference of two of these. Beyond the values that q has had
a curve stays as at its end. A curve may jump: then its table is what is left beside the jump, which runs as friction of
the library does: within a small range of q it is a straight line.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from vaneloop.base.curve import FINE, POINTS, on_even_grid
from vaneloop.base.forms import Form
from vaneloop.identification.settings import AT_ONCE
from vaneloop.identification.subsystem import Array
from vaneloop.identification.user_models.data import Data
from vaneloop.identification.user_models.exogenous_regressors import MINUS, STOPS, of_stops

__all__ = [
    "COLUMN", "HOW", "INPUT", "OUTPUT", "SENSED", "Curve", "Jump", "Surface", "Table", "apart", "bent",
    "curves_for_kernel", "runs", "surfaces_for_kernel",
]  # fmt: skip

INPUT, OUTPUT, COLUMN = 100, 200, 300  # numbers of quantities: states are below
NOTHING = -1  # in the place of one that would be taken off
Table = Callable[[Array], Array]
Jump = Callable[[Array], tuple[float, float]]
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
    less      of a difference, number and name of what is taken off; ``of`` is then of what it is taken off from
    low, high the range in which it bends
    table     from its parameters to the curve, less its jump, at points evenly from low to high
    jump      from its parameters to half the height of its jump, and where that is; None: it has none
    period    after which it repeats itself along a channel that no column has within it; 0: it does not
    """

    how: str
    place: int
    of: int
    quantity: str
    low: float
    high: float
    table: Table
    jump: Jump | None = None
    less: tuple[int, str] | None = None
    period: float = 0.0

    def row(self, values: Array) -> Array:
        """What runs with these parameters: its table, behind it the jump that it may have."""
        return np.append(self.table(values), self.jump(values)) if self.jump else self.table(values)

    def parts(self, row: Array) -> tuple[Array, float, float]:
        """Of a `row` the table, half the height of the jump, and where it is."""
        return (row[:-2], float(row[-2]), float(row[-1])) if self.jump else (row, 0.0, 0.0)

    def whole(self, values: Array) -> Array:
        """The curve with these parameters at the points of its table, its jump with it."""
        table, half, place = self.parts(self.row(values))
        return table + half * np.sign(np.linspace(self.low, self.high, len(table)) - place) if half else table

    def at(self, q: Array, row: Array) -> Array:
        """The curve at values of its quantity; of stops, at a course of what they follow."""
        table, half, place = self.parts(row)
        if self.quantity.startswith(STOPS):
            return of_stops(q, self.low, self.high, table)
        q, table = np.ascontiguousarray(q, dtype=float), np.ascontiguousarray(table, dtype=float)
        c = on_even_grid(q, np.linspace(self.low, self.high, len(table)), table)
        return c + half * np.sign(q - place) if half else c

    @property
    def quantities(self) -> tuple[tuple[int, str], ...]:
        """Number and name of what it is a function of; of a difference, those of both."""
        if self.less is None:
            return ((self.of, self.quantity),)
        return (self.of, self.quantity.removesuffix(f"{MINUS}{self.less[1]}")), self.less

    @property
    def simulated(self) -> bool:
        """Whether its quantity is a state, or the difference to one."""
        return any(of < INPUT for of, _ in self.quantities)

    def value(self, one: Callable[[int, str], Array]) -> Array:
        """Its quantity, where ``one`` says what each number and name stands for."""
        first, *other = (one(*of) for of in self.quantities)
        q = np.asarray(first - other[0] if other else first)
        return q % self.period if self.period else q

    def values(self, data: Data, log: int, u: Array, y: Array | None = None) -> Array:
        """Its quantity on a log, of a model that is not simulated; of a surface, float64[2, samples]."""

        def one(of: int, name: str) -> Array:
            if of >= COLUMN:
                return data.column(log, name)
            if of >= OUTPUT:
                return np.asarray(data.y[log][of - OUTPUT] if y is None else y[of - OUTPUT])
            return np.asarray(u[of - INPUT])

        return self.value(one)


def runs(form: Form, low: float, high: float, points: int = FINE) -> tuple[Table, Jump | None]:
    """What a formula is as a `Curve`: from its numbers to the table from low to high, and to the jump."""
    grid = np.linspace(low, high, points)
    jump = form.jump
    if jump is None:
        return lambda n: np.broadcast_to(form.value(grid, n), grid.shape).astype(float), None
    return lambda n: np.full(points, jump(n)[0]), lambda n: jump(n)[1:]


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


def curves_for_kernel(curves: Active, data: Data, log: int, n: int, smalls: Array) -> tuple[Array, ...]:
    """The last arguments of a compiled simulation with curves; ``smalls``: state by state, range within which a jump is
    a straight line.
    """
    of, low, high, tables, jumps = [], [], [], [], []
    columns: list[Array] = []
    for c, row in curves:
        a, b = c.low, c.high
        table, half, place = c.parts(row)
        speed = float(smalls[c.of]) if c.of < INPUT and c.less is None else 0.0
        small = (speed or AT_ONCE * (b - a)) if c.simulated else 0.0
        jumps.append((half, place, max(small, 1e-300), c.period))
        numbers = [NOTHING, NOTHING]
        for k, (number, name) in enumerate(c.quantities):
            numbers[k] = number
            if number >= COLUMN:
                numbers[k] = COLUMN + len(columns)
                columns.append(data.column(log, name)[:n])
        if c.quantity.startswith(STOPS) and c.of >= COLUMN:  # what they make of it, as it is
            columns[-1] = c.at(columns[-1], row)
            b = max(float(np.abs(columns[-1]).max()), 1e-300)
            a, table = -b, np.linspace(-b, b, POINTS)
        of.append(numbers)
        low.append(a)
        high.append(b)
        tables.append(table)
    most = max((len(t) for t in tables), default=POINTS)
    tables = [t if len(t) == most else np.interp(np.linspace(0, 1, most), np.linspace(0, 1, len(t)), t) for t in tables]
    per = (most - 1) / (np.array(high) - np.array(low))  # points of a table for one of its quantity
    return (
        np.array([HOW[c.how] for c, _ in curves], dtype=np.int64),
        np.array([c.place for c, _ in curves], dtype=np.int64), np.array(of, dtype=np.int64).reshape(-1, 2),
        np.array(low), per, np.array(tables).reshape(len(tables), most), np.array(jumps).reshape(-1, 4),
        np.array(columns).reshape(len(columns), n),
    )  # fmt: skip


# ---- A surface in a user's own model: a curve's place (`identification.user_models.terms`), and a function of two


@dataclass(frozen=True, kw_only=True)
class Surface(Curve):
    """A surface at a place; ``table`` gives it at points that stand evenly each way.

    of_second, second, low_second, high_second  of its other quantity, as a curve has them of one
    """

    of_second: int
    second: str
    low_second: float
    high_second: float

    @property
    def quantities(self) -> tuple[tuple[int, str], ...]:
        """Number and name of what it is a function of."""
        return ((self.of, self.quantity), (self.of_second, self.second))

    def value(self, one: Callable[[int, str], Array]) -> Array:
        """Both quantities, a row each."""
        return np.array([one(*of) for of in self.quantities])

    def at(self, q: Array, table: Array) -> Array:
        """The surface at values of its quantities, float64[2, n]."""
        low, high = np.array([[self.low], [self.low_second]]), np.array([[self.high], [self.high_second]])
        at = np.clip((q - low) / (high - low), 0.0, 1.0) * (np.array([table.shape]).T - 1)
        return np.asarray(scipy.ndimage.map_coordinates(table, at, order=1))


def apart(active: Active) -> tuple[Active, Sequence[tuple[Surface, Array]]]:
    """Curves and surfaces, each by themselves."""
    surfaces = [(c, table) for c, table in active if isinstance(c, Surface)]
    return [one for one in active if not isinstance(one[0], Surface)], surfaces


def _spread(table: Array, points: int) -> Array:
    """The same table with so many points each way."""
    at = np.linspace(0.0, len(table) - 1.0, points)
    return np.asarray(
        table
        if len(table) == points
        else scipy.ndimage.map_coordinates(table, np.meshgrid(at, at, indexing="ij"), order=1)
    )


def surfaces_for_kernel(surfaces: Sequence[tuple[Surface, Array]], data: Data, log: int, n: int) -> tuple[Array, ...]:
    """The last arguments of a compiled simulation with surfaces."""
    most = max(len(table) for _, table in surfaces)
    columns: list[Array] = []
    of = np.empty((len(surfaces), 2), dtype=np.int64)
    for row, (s, _) in zip(of, surfaces, strict=True):
        for k, (number, name) in enumerate(s.quantities):
            row[k] = number
            if number >= COLUMN:
                row[k] = COLUMN + len(columns)
                columns.append(data.column(log, name)[:n])
    return (
        np.array([HOW[s.how] for s, _ in surfaces], dtype=np.int64),
        np.array([s.place for s, _ in surfaces], dtype=np.int64), of,
        np.array([(s.low, s.low_second) for s, _ in surfaces]),
        np.array([(s.high, s.high_second) for s, _ in surfaces]),
        np.array([_spread(table, most) for _, table in surfaces]), np.array(columns).reshape(len(columns), n),
    )  # fmt: skip
