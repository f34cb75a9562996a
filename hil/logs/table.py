"""A table of columns, one of them the time: what CSV and Parquet have in common."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hil.logs.names import CERTAIN, is_time
from hil.logs.notes import Note
from hil.logs.source import LogError, Options, Series, close_names, names_held
from hil.logs.times import guess_column

__all__ = ["ROW", "TIME_NAMES", "NoTime", "Table", "Time", "split_unit", "time_column"]

ROW = "number of the row"  # the time of a table without one
ROW_STEP = 0.01  # s, from row to row of such a table
TIME_NAMES = ("t", "time", "timestamp", "timestamps", "time_s", "zeit")


class Table:
    """Columns of a table. A header may carry the unit: `n_r [rpm]`, `n_r (rpm)`; so may a row of its own, ``units``.
    Where it is ``framed``, a row is a frame of a bus.

    own     column -> the column that is its time, where that is another than ``time``
    parts   rows (from 0) at which the logger began again, 0 the first
    part    the one to read, from 1; 0: all where time goes on, else the longest
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
        own: Mapping[str, str] | None = None,
        parts: tuple[int, ...] = (0,),
        part: int = 0,
    ):
        self.notes: list[str] = list(time.notes)
        self.guessed = time.sure  # how surely the column is the time, where that is guessed; 0 where it is stated
        self._load, self._first, self.time, self._units = load, first, time.name, units
        if time.name == ROW:
            self._load = lambda key: ROW_STEP * np.arange(load(headers[0]).size) if key == ROW else load(key)
        self._framed, self._own, self._parts, self._part = framed, own or {}, parts, part
        self.time_unit = units.get(time.name) or split_unit(time.name)[1] or time.unit
        self._t: dict[str, np.ndarray] = {}
        self._rows: slice | None = None
        times = {time.name, *self._own.values()}
        self.names = {h: tuple(dict.fromkeys((h, h.strip(), split_unit(h)[0]))) for h in headers if h not in times}

    def has(self) -> str:
        return names_held(self.kind, [self.time, *self.names])

    def absent(self, name: str) -> str:
        return ""

    def series(self, key: str) -> Series:
        t, values = self._times(self._own.get(key, self.time)), self._load(key)[self.rows]
        if values.size != t.size:
            raise LogError(f"column {key!r} has {values.size} rows, the time column {self.time!r} has {t.size}")
        unit = self._units.get(key) or split_unit(key)[1]
        return Series(t, values, unit, self.time_unit, "row", self._first + (self.rows.start or 0), self._framed)

    def times(self) -> np.ndarray:
        """The time column's numbers as they stand."""
        return self._times(self.time)

    def _times(self, key: str) -> np.ndarray:
        if key not in self._t:
            self._t[key] = self._load(key)[self.rows]
        return self._t[key]

    @property
    def rows(self) -> slice:
        """The rows that are read: those of one part, where the logger began again and time with it."""
        if self._rows is None:
            self._rows = self._of_part() if len(self._parts) > 1 else slice(None)
        return self._rows

    def _of_part(self) -> slice:
        t = self._load(self.time)
        edges = [*self._parts, t.size]
        spans = [t[a:b][np.isfinite(t[a:b])] for a, b in itertools.pairwise(edges)]
        told = [s for s in spans if s.size]
        goes_on = all(a[-1] < b[0] for a, b in itertools.pairwise(told))
        part = self._part or (0 if goes_on else 1 + max(range(len(spans)), key=lambda k: spans[k].size))
        again = ", ".join(str(self._first + row - 1) for row in self._parts[1:6])
        n, lost = len(spans), sum(s.size for k, s in enumerate(spans, 1) if part and k != part)
        done = f"part {part} of {n} is read" if part else f"its {n} parts are read as one, since time goes on"
        self.notes.append(
            Note(
                f"rows: the header stands again in row {again}: {done}; --part N reads one of {n}",
                "joined" if not part else "left out", "rows",
                lost, [self._first + row - 1 for row in self._parts[1:]],
            )
        )  # fmt: skip
        return slice(edges[part - 1], edges[part]) if part else slice(None)


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


def time_column(path: Path, headers: list[str], options: Options, dates: Sequence[str] = ()) -> Time:
    """The column of a table that holds the time: mapped to t, called t, or called like it; else one that says time in
    other words, or the only one of ``dates``, whose type says that they hold dates, if guesses are wanted.
    """
    asked = next((name for name, signal in options.mapping.items() if signal == "t"), None)
    called = [(h, h.strip(), split_unit(h)[0]) for h in headers]
    for fold in (str, str.casefold):
        for name in TIME_NAMES if asked is None else (fold(asked),):
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
    if not found and options.guess and len(dates) == 1:
        note = f"t: guessed to be {dates[0]!r}, the only column of dates; --map NAME=t takes another, --no-guess none"
        return Time(dates[0], "", (note,), CERTAIN)
    if found:
        raise NoTime(f"{path}: the time may be {' or '.join(map(repr, found[:4]))}: --map NAME=t takes one", headers)
    if options.rows:
        return Time(ROW, "s", ("no time column: rows in no order",))
    text = (
        f"{path}: no time column; looked for {', '.join(TIME_NAMES)} (--map NAME=t names "
        f"another){names_held('column', headers)}"
    )
    raise NoTime(text, headers)
