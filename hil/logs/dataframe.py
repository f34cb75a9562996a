"""A ``pandas.DataFrame`` as a source of a log. pandas itself is not imported: whoever has a frame has it.

Units are those of ``frame.attrs["units"]`` (column -> unit), or stand behind a column's name, ``n_r [rpm]``. A cell
that is NaN has no sample: rasters may differ from column to column.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeGuard

import numpy as np

from hil.logs.source import ABSENT, LogError, Options, Series, second
from hil.logs.table import ROW, NoTime, Table, Time, split_unit, time_column

if TYPE_CHECKING:
    from pandas import DataFrame

__all__ = ["frame_columns", "is_frame", "name_of", "open_frame"]

NAMELESS = "DataFrame"


def is_frame(thing: object) -> TypeGuard[DataFrame]:
    """Whether that is a frame of pandas, or of another package that makes one of itself (polars, pyarrow)."""
    return hasattr(thing, "columns") and hasattr(thing, "dtypes") or _foreign(thing)


def _foreign(thing: object) -> bool:
    """Whether that is a frame of another package."""
    return callable(getattr(thing, "to_pandas", None)) and type(thing).__module__.split(".")[0] in ("polars", "pyarrow")


def _own(frame: Any) -> Any:
    """The frame as one of pandas."""
    return frame.to_pandas() if _foreign(frame) else frame


def name_of(frame: DataFrame) -> str:
    """What a frame is called in messages: its ``attrs["name"]``."""
    name = getattr(frame, "attrs", {}).get("name")
    return str(name) if name else NAMELESS


def _said(frame: Any, key: str) -> Any:
    return frame.attrs.get(key) or {}


def units_in(frame: Any) -> dict[str, str]:
    """Units that a frame states: column, or name of its index -> unit."""
    said = _said(frame, "units")
    if not isinstance(said, Mapping):
        raise LogError(f"{name_of(frame)}: attrs['units'] (={said!r}) must be a dict of column -> unit")
    return {str(k): str(v) for k, v in said.items() if v}


def _kind(values: Any) -> str:
    """What a column holds: number, date, duration; "" for anything else."""
    kind = getattr(values.dtype, "kind", "O")
    return {"M": "date", "m": "duration", **dict.fromkeys("iufb", "number")}.get(kind, "")


def frame_columns(frame: DataFrame) -> dict[str, str]:
    """Columns of numbers -> the unit that the frame states, "" where it states none."""
    own = _own(frame)
    units = units_in(own)
    return {
        str(c): units.get(str(c)) or units.get(split_unit(str(c))[0]) or split_unit(str(c))[1]
        for k, c in enumerate(own.columns) if _kind(own.iloc[:, k]) == "number"
    }  # fmt: skip


def _numbers(values: Any, what: str) -> np.ndarray:
    """A column as float64: dates and durations in s, dates from the first one on; what is missing is `ABSENT`."""
    kind = _kind(values)
    if not kind:
        raise LogError(f"{what} holds {values.dtype}, not numbers")
    if kind == "number":
        out = np.array(values.to_numpy(dtype=np.float64, na_value=np.nan))
    else:
        ticks = values.to_numpy(dtype="datetime64[ns]" if kind == "date" else "timedelta64[ns]")
        there = ~np.isnat(ticks)
        count = ticks.astype(np.int64)
        first = count[there].min() if kind == "date" and there.any() else 0
        out = np.where(there, (count - first) * 1e-9, np.nan)
    out[np.isnan(out)] = ABSENT
    return out


def open_frame(frame: DataFrame, path: Path, options: Options) -> Table:
    """A frame as a source. Raises LogError for one that is no table of one time and channels beside it."""
    own: Any = _own(frame)
    if getattr(own.columns, "nlevels", 1) > 1 or getattr(own.index, "nlevels", 1) > 1:
        raise LogError(f"{path}: its columns or rows have several levels; allowed: one name a column, one time a row")
    headers = [str(c) for c in own.columns]
    if again := second(headers):
        raise LogError(f"{path}: column {again!r} is there more than once")
    if not len(own):
        raise LogError(f"{path}: has no row")
    units, columns = units_in(own), dict(zip(headers, own.columns, strict=True))
    index = _time_of_index(own, headers, options)
    time = Time(index) if index else time_column(path, headers, options)

    def load(key: str) -> np.ndarray:
        if key == index:
            return _numbers(own.index.to_series(), f"{path}: its index")
        return _numbers(own[columns[key]], f"{path}: column {key!r}")

    if time.name == index:
        kind = _kind(own.index)
    else:
        kind = _kind(own[columns[time.name]]) if time.name != ROW else ""
    if kind in ("date", "duration"):  # they are turned into s, whatever is said of them
        units[time.name] = "s"
    framed = {str(c) for c in own.attrs.get("framed") or ()}
    return _Frame([*([index] if index else []), *headers], load, 0, time, units, framed)


def _time_of_index(own: Any, headers: list[str], options: Options) -> str:
    """The name under which a frame's index is its time; "" where a column is, or may be."""
    name = "t" if own.index.name is None else str(own.index.name)
    if name in headers or _kind(own.index) == "":
        return ""
    counts = type(own.index).__name__ == "RangeIndex" and own.index.name is None  # it only counts the rows
    asked = next((n for n, signal in options.mapping.items() if signal == "t"), None)
    if asked is not None:
        return name if asked == name else ""
    if counts:
        return ""
    if own.index.name is None and _kind(own.index) == "number":  # rows of numbers: a column that says time goes before
        try:
            time_column(Path(), headers, replace(options, rows=False))
            return ""
        except NoTime:
            return "" if options.rows and not own.index.is_monotonic_increasing else name
    return name


class _Frame(Table):
    """A table whose columns say by themselves which of them came in frames of a bus."""

    def __init__(
        self, headers: list[str], load: Any, first: int, time: Time, units: Mapping[str, str], framed: set[str]
    ):
        super().__init__(headers, load, first, time, units)
        self._of_frames = framed

    def series(self, key: str) -> Series:
        s = super().series(key)
        return Series(s.t, s.values, s.unit, s.t_unit, s.word, s.first, key in self._of_frames)
