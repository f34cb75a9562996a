"""What a fit says of its parameters: a table of values with their errors, and how these errors go together."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vaneloop.base.errors import InputError, meant
from vaneloop.base.extras import needed
from vaneloop.base.notebook import html_table, text_table
from vaneloop.identification.least_squares.problem import Fit, LeastSquaresProblem
from vaneloop.identification.results import Estimate, estimates

if TYPE_CHECKING:
    from pandas import DataFrame

__all__ = ["Correlation", "Estimate", "Fitted", "NoParameter", "Parameters", "correlation_of", "parameters_of"]

COLUMNS = ("subsystem", "effect", "value", "stderr", "low", "high", "unit", "lower_bound", "upper_bound", "at_bound")


class Fitted(NamedTuple):
    """A fit of one stage: what it was fitted by, the parameters, and those of the nominal model beside it.

    base   None: not known by now
    start  s of the log's own time, where the stage's time is 0
    """

    judge: LeastSquaresProblem
    fit: Fit
    base: Fit | None
    start: float = 0.0


class NoParameter(InputError, KeyError):
    """A name that is none of the fitted parameters."""

    __str__ = ValueError.__str__  # that of KeyError shows the line in quotes


class _Named(Mapping[str, object]):
    """Rows by name; a name that is not there raises `NoParameter`."""

    def __repr__(self) -> str:
        """The table as text."""
        return text_table(*self._table()) if len(self) else f"{type(self).__name__}(nothing was fitted)"

    def _repr_html_(self) -> str:
        """The table in a notebook's cell."""
        return html_table(*self._table())

    def _table(self) -> tuple[list[str], list[list[object]]]:
        raise NotImplementedError

    def _at(self, name: str) -> str:
        if name not in self:
            raise NoParameter(f"parameter {name!r} was not fitted{meant(name, self)}; fitted: {', '.join(self)}")
        return name


class Parameters(_Named, Mapping[str, Estimate]):
    """The parameters that were fitted, by name: a mapping, a table, a frame.

    That of an effect is named with it, ``valve_dead_band.half_width``. Each is an `Estimate` with ``value``,
    ``stderr``, ``low`` and ``high`` (90 % interval), ``unit``, ``bound`` and ``at_bound``.
    """

    def __init__(self, rows: Mapping[str, Estimate]):
        self._rows = dict(rows)

    def __getitem__(self, name: str) -> Estimate:
        """A parameter; NoParameter, a KeyError of one line, where it was not fitted."""
        return self._rows[self._at(name)]

    def __contains__(self, name: object) -> bool:
        """Whether it was fitted."""
        return name in self._rows

    def __iter__(self) -> Iterator[str]:
        """Each name in turn."""
        return iter(self._rows)

    def __len__(self) -> int:
        """How many there are."""
        return len(self._rows)

    def to_frame(self) -> DataFrame:
        """The table as a ``pandas.DataFrame``, a row a parameter; InputError where pandas is not installed."""
        pandas = needed("to_frame", "pandas")
        rows = [row[1:] for row in self._cells()]
        return pandas.DataFrame(rows, index=pandas.Index(list(self), name="parameter"), columns=list(COLUMNS))

    def _cells(self) -> list[list[object]]:
        return [
            [name, e.stage, e.effect, e.value, e.stderr, e.low, e.high, e.unit, *e.bound, e.at_bound]
            for name, e in self._rows.items()
        ]

    def _table(self) -> tuple[list[str], list[list[object]]]:
        return ["parameter", *COLUMNS], self._cells()


class Correlation(_Named, Mapping[str, Mapping[str, float]]):
    """How the errors of two fitted parameters go together, from -1 to 1: ``correl["a"]["b"]``.

    Near 1 or -1 the log tells the two hardly apart. NaN: one of them stands at a bound, or each was fitted to a
    subsystem of its own.
    """

    def __init__(self, names: Sequence[str], values: np.ndarray):
        self._names, self._values = list(names), values

    def __getitem__(self, name: str) -> Mapping[str, float]:
        """The correlations of a parameter; NoParameter where it was not fitted."""
        row = self._values[self._names.index(self._at(name))]
        return {n: float(v) for n, v in zip(self._names, row, strict=True)}

    def __contains__(self, name: object) -> bool:
        """Whether it was fitted."""
        return name in self._names

    def __iter__(self) -> Iterator[str]:
        """Each name in turn."""
        return iter(self._names)

    def __len__(self) -> int:
        """How many parameters there are."""
        return len(self._names)

    def to_frame(self) -> DataFrame:
        """The correlations as a square ``pandas.DataFrame``; InputError where pandas is not installed."""
        pandas = needed("to_frame", "pandas")
        return pandas.DataFrame(self._values, index=self._names, columns=self._names)

    def _table(self) -> tuple[list[str], list[list[object]]]:
        rows = zip(self._names, self._values, strict=True)
        return ["", *self._names], [[name, *(round(float(v), 3) + 0.0 for v in row)] for name, row in rows]


def _names(of: Sequence[Sequence[Estimate]]) -> list[list[str]]:
    """A name for each parameter of each fit: with its effect, and with its subsystem where two have the same."""
    plain = [[f"{e.effect}.{e.name}" if e.effect else e.name for e in fit] for fit in of]
    many = Counter(name for fit in plain for name in fit)
    return [
        [f"{e.stage}: {name}" if many[name] > 1 else name for e, name in zip(fit, names, strict=True)]
        for fit, names in zip(of, plain, strict=True)
    ]


def parameters_of(fits: Sequence[Fitted]) -> Parameters:
    """The parameters of all fits, in their order."""
    of = [estimates(f.judge, f.fit) for f in fits]
    names, rows = itertools.chain(*_names(of)), itertools.chain(*of)
    return Parameters(dict(zip(names, rows, strict=True)))


def correlation_of(fits: Sequence[Fitted]) -> Correlation:
    """How the errors of the parameters of all fits go together."""
    names = list(parameters_of(fits))
    values, at = np.full((len(names), len(names)), np.nan), 0
    for f in fits:
        to = at + len(f.fit.free)
        values[at:to, at:to] = f.judge.correlation(f.fit)
        at = to
    return Correlation(names, values)
