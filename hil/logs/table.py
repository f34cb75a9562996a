"""A table of columns, one of them the time: what CSV and Parquet have in common."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hil.logs.names import is_time
from hil.logs.source import LogError, Options, Series, close_names, names_held
from hil.logs.times import guess_column

__all__ = ["NoTime", "Table", "Time", "split_unit", "time_column"]

_TIME_NAMES = ("t", "time", "timestamp", "timestamps", "time_s", "zeit")


class Table:
    """Columns of a CSV or Parquet file. A header may carry the unit: `n_r [rpm]`, `n_r (rpm)`; so may a row of its own,
    ``units``. Where it is ``framed``, a row is a frame of a bus.
    """

    kind = "column"
    sorted = False

    def __init__(
        self,
        headers: list[str],
        load: Callable[[str], np.ndarray],
        first: int,
        time: Time,
        units: Mapping[str, str],
        framed: bool = False,
    ):
        self.notes = list(time.notes)
        self.guessed = time.sure  # how surely the column is the time, where that is guessed; 0 where it is stated
        self._load, self._first, self.time, self._units = load, first, time.name, units
        self._framed = framed
        self.time_unit = units.get(time.name) or split_unit(time.name)[1] or time.unit
        self._t: np.ndarray | None = None
        self.names = {h: tuple(dict.fromkeys((h, h.strip(), split_unit(h)[0]))) for h in headers if h != time.name}

    def has(self) -> str:
        return names_held(self.kind, [self.time, *self.names])

    def absent(self, name: str) -> str:
        return ""

    def series(self, key: str) -> Series:
        t, values = self.times(), self._load(key)
        if values.size != t.size:
            raise LogError(f"column {key!r} has {values.size} rows, the time column {self.time!r} has {t.size}")
        unit = self._units.get(key) or split_unit(key)[1]
        return Series(t, values, unit, self.time_unit, "row", self._first, self._framed)

    def times(self) -> np.ndarray:
        """The time column's numbers as they stand."""
        if self._t is None:
            self._t = self._load(self.time)
        return self._t


def split_unit(header: str) -> tuple[str, str]:
    """`n_r [rpm]` is n_r in rpm; no bracket, no unit."""
    text = header.strip()
    at = next((k for k, c in enumerate(text) if c in "[]()"), 0)
    pair = {"[": "[]", "(": "()"}.get(text[at : at + 1], "")
    if not at or not pair or text[-1] != pair[1] or any(c in pair for c in text[at + 1 : -1]):
        return text, ""
    return text[:at].rstrip(), text[at + 1 : -1].strip()


class NoTime(LogError):
    """A table without a column that can be its time; ``headers`` are what it has."""

    def __init__(self, text: str, headers: list[str]):
        super().__init__(text)
        self.headers = headers


class Time(NamedTuple):
    """The time column of a table, the unit that its name states (beyond a bracket), and what was guessed of it."""

    name: str
    unit: str = ""
    notes: tuple[str, ...] = ()
    sure: float = 0.0


def time_column(path: Path, headers: list[str], options: Options) -> Time:
    """The column of a table that holds the time: mapped to t, called t, or called like it; else one that says time in
    other words, if guesses are wanted.
    """
    asked = next((name for name, signal in options.mapping.items() if signal == "t"), None)
    called = [(h, h.strip(), split_unit(h)[0]) for h in headers]
    for fold in (str, str.casefold):
        for name in _TIME_NAMES if asked is None else (fold(asked),):
            for h, *others in called:
                if name == fold(h) or any(name == fold(o) for o in others):
                    return Time(h)
    if asked is not None:
        raise NoTime(
            f"{path}: no column {asked!r} to map to t{close_names(asked, headers)}{names_held('column', headers)}",
            headers,
        )
    found, sure = guess_column(headers) if options.guess else ([], 0.0)
    if len(found) == 1:
        unit = is_time(found[0])[1]
        why = f"its name says time{' in ' + unit if unit else ''}"
        note = (
            f"t: guessed to be {found[0]!r}, {100 * sure:.0f} % sure ({why}); --map NAME=t takes another, --no-guess "
        )
        note += "none"
        return Time(found[0], unit, (note,), sure)
    if found:
        raise NoTime(f"{path}: the time may be {' or '.join(map(repr, found[:4]))}: --map NAME=t takes one", headers)
    text = (
        f"{path}: no time column; looked for {', '.join(_TIME_NAMES)} (--map NAME=t names "
        f"another){names_held('column', headers)}"
    )
    raise NoTime(text, headers)
