"""A table of columns, one of them the time: what CSV and Parquet have in common."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hil.logs.source import Channel, LogError, Series, close_names, names_held

__all__ = ["NoTime", "Table", "polars_table", "split_unit", "time_column"]

_TIME_NAMES = ("t", "time", "timestamp", "timestamps", "time_s", "zeit")


class Table:
    """Columns of a CSV or Parquet file. A header may carry the unit: `n_r [rpm]`, `n_r (rpm)`."""

    kind = "column"
    sorted = False

    def __init__(self, headers: list[str], load: Callable[[str], np.ndarray], first: int, time: str):
        self.notes: list[str] = []
        self._load, self._first, self.time = load, first, time
        self._t: np.ndarray | None = None
        self.names = {h: tuple(dict.fromkeys((h, h.strip(), split_unit(h)[0]))) for h in headers if h != time}

    def has(self) -> str:
        return names_held(self.kind, [self.time, *self.names])

    def absent(self, name: str) -> str:
        return ""

    def series(self, key: str) -> Series:
        if self._t is None:
            self._t = self._load(self.time)
        values = self._load(key)
        if values.size != self._t.size:
            raise LogError(f"column {key!r} has {values.size} rows, the time column {self.time!r} has {self._t.size}")
        return Series(self._t, values, split_unit(key)[1], split_unit(self.time)[1], "row", self._first)


def split_unit(header: str) -> tuple[str, str]:
    """`n_r [rpm]` is n_r in rpm; no bracket, no unit."""
    m = re.fullmatch(r"\s*([^\[\]()]+?)\s*(?:\[([^\[\]]*)\]|\(([^()]*)\))\s*", header)
    return (m[1], (m[2] if m[2] is not None else m[3]).strip()) if m else (header.strip(), "")


class NoTime(LogError):
    """A table without a column that can be its time; ``headers`` are what it has."""

    def __init__(self, text: str, headers: list[str]):
        super().__init__(text)
        self.headers = headers


def time_column(path: Path, headers: list[str], mapping: Mapping[str, str]) -> str:
    """The column of a table that holds the time: mapped to t, called t, or called like it."""
    asked = next((name for name, signal in mapping.items() if signal == "t"), None)
    for fold in (str, str.casefold):
        for name in _TIME_NAMES if asked is None else (fold(asked),):
            for h in headers:
                if name in (fold(h), fold(h.strip()), fold(split_unit(h)[0])):
                    return h
    if asked is not None:
        raise NoTime(
            f"{path}: no column {asked!r} to map to t{close_names(asked, headers)}{names_held('column', headers)}",
            headers,
        )
    text = (
        f"{path}: no time column; looked for {', '.join(_TIME_NAMES)} (--map NAME=t names "
        f"another){names_held('column', headers)}"
    )
    raise NoTime(text, headers)


# --- writing ----------------------------------------------------------------------------------------------------------


def _raster(channels: dict[str, Channel]) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """All times of all channels, and each channel on them, NaN where it has no sample."""
    t = np.unique(np.concatenate([c.t for c in channels.values()]))
    columns = {}
    for name, c in channels.items():
        columns[name] = np.full(t.size, np.nan)
        columns[name][np.searchsorted(t, c.t)] = c.values
    return t, columns


def polars_table(channels: dict[str, Channel]) -> Any:
    """Channels as a polars table, t first, null where a channel has no sample."""
    import polars as pl

    t, columns = _raster(channels)
    return pl.DataFrame({"t": t, **columns}).with_columns(pl.all().fill_nan(None))
