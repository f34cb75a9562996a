"""A surface in a user's own model: a curve's place (`vaneloop.discrepancy.models.curve`), and a function of two
quantities there.

Beyond where the log has been of both at once, a surface stays as at the nearest point where it has.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from vaneloop.discrepancy.models.curve import COLUMN, HOW, Active, Curve
from vaneloop.discrepancy.models.data import Data
from vaneloop.discrepancy.stage import Array

__all__ = ["Surface", "apart", "surfaces_for_kernel"]


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
        from scipy.ndimage import map_coordinates

        low, high = np.array([[self.low], [self.low_second]]), np.array([[self.high], [self.high_second]])
        at = np.clip((q - low) / (high - low), 0.0, 1.0) * (np.array([table.shape]).T - 1)
        return np.asarray(map_coordinates(table, at, order=1))


def apart(active: Active) -> tuple[Active, Sequence[tuple[Surface, Array]]]:
    """Curves and surfaces, each by themselves."""
    surfaces = [(c, table) for c, table in active if isinstance(c, Surface)]
    return [one for one in active if not isinstance(one[0], Surface)], surfaces


def _spread(table: Array, points: int) -> Array:
    """The same table with so many points each way."""
    from scipy.ndimage import map_coordinates

    at = np.linspace(0.0, len(table) - 1.0, points)
    return np.asarray(
        table if len(table) == points else map_coordinates(table, np.meshgrid(at, at, indexing="ij"), order=1)
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
