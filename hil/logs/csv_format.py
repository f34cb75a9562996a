"""CSV: text with a header line, read and written through polars."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from hil.logs.source import ABSENT, Channel, LogError, Options, Source, read_bytes
from hil.logs.table import Table, polars_table, split_unit, time_column
from hil.logs.times import from_dates
from hil.logs.units import NO_UNIT, factor_of
from vaneloop.base.signals import UNITS

__all__ = ["open_csv", "write_csv"]

_NO_SAMPLE = ["NA", "N/A", "null", "None", "-"]
_MOST_COLUMNS = 10_000
_CHUNK = 32 << 20  # bytes of rows that are parsed at one time
_INK = re.compile(rb"\S")


def open_csv(path: Path, options: Options) -> Source:
    """CSV with one header line; separator , ; or tab, decimal comma with ; allowed; empty cell = no sample there."""
    raw = read_bytes(path)
    if raw[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raw = raw.decode("utf-16", errors="replace").encode()
    if b"\0" in raw:
        raise LogError(f"{path}: is not a CSV (binary bytes in it)")
    if not raw.isascii():
        try:
            raw.decode("utf-8")
        except UnicodeDecodeError:
            raw = raw.decode("cp1252", errors="replace").encode()
        raw = raw.removeprefix(b"\xef\xbb\xbf")
    first = 2  # row of the first sample, as an editor counts
    head, at = _line(raw, 0)
    while at < len(raw) and (head.startswith(b"#") or not head.strip()):
        head, at = _line(raw, at)
        first += 1
    line = head.decode().strip("\r")
    if re.fullmatch(r'"?sep=.?"?', line) and at < len(raw):  # what Excel writes to be read by Excel
        head, at = _line(raw, at)
        line, first = head.decode().strip("\r"), first + 1
    separator = max(",;\t", key=line.count)
    try:
        headers = [h.strip() for h in next(csv.reader([line], delimiter=separator), [])]
    except csv.Error as e:
        raise LogError(f"{path}: header line cannot be read ({e}): {line[:80]!r}") from None
    if len(headers) > _MOST_COLUMNS:
        raise LogError(f"{path}: {len(headers)} columns; allowed: {_MOST_COLUMNS}")
    again = next((h for i, h in enumerate(headers) if h in headers[:i] and h), None)
    if again is not None:
        raise LogError(f"{path}: column {again!r} is there more than once")
    under, behind = _line(raw, at)
    units = _units_row(under, headers, separator)
    if units:
        at, first = behind, first + 1
    comma = separator == ";" and re.search(rb"\d,\d", raw[at : at + 4096]) is not None

    time = time_column(path, headers, options)
    known = {*UNITS, *options.mapping, time.name}
    wanted = [h for h in headers if h in known or split_unit(h)[0] in known]
    rows = _Csv(path, raw, at, headers, wanted, separator, comma, first, time.name)
    table = Table([h for h in headers if h], rows.column, first, time, units)
    rows.notes = table.notes
    return table


def _line(raw: bytes, at: int) -> tuple[bytes, int]:
    """The line that begins at a byte, without its end, and where the next one begins."""
    end = raw.find(b"\n", at)
    return (raw[at:], len(raw)) if end < 0 else (raw[at:end], end + 1)


def _units_row(row: bytes, headers: list[str], separator: str) -> dict[str, str]:
    """Column -> unit, where the ``row`` under the header holds units and nothing else; empty where it does not."""
    try:
        line = row.decode().strip("\r")
        cells = [c.strip().strip("[]()") for c in next(csv.reader([line], delimiter=separator), [])]
    except csv.Error:
        return {}
    said = [c for c in cells if c.casefold() not in NO_UNIT]
    if not said:
        return {}
    if any(re.fullmatch(r"[-+\d.,:eE]+|(?i:nan|[-+]?inf)", c) or factor_of(c, "s") is None for c in said):
        return {}
    return {h: c for h, c in zip(headers, cells, strict=False) if h and c.casefold() not in NO_UNIT}


class _Csv:
    """Rows of a CSV, from byte ``at`` of ``raw``; ``wanted`` columns are read together on the first call, any other
    when asked for. A long file is read in chunks: what polars takes beside the numbers is that of one chunk.
    """

    def __init__(
        self, path: Path, raw: bytes, at: int, headers: list[str], wanted: list[str], separator: str, comma: bool,
        first: int, time: str,
    ):  # fmt: skip
        self.path, self.raw, self.at, self.headers, self.wanted = path, raw, at, headers, wanted
        self.separator, self.comma, self.first = separator, comma, first
        self.time, self.notes = time, list[str]()
        self.ready: dict[str, np.ndarray] | None = None

    def column(self, header: str) -> np.ndarray:
        import polars as pl

        if _INK.search(self.raw, self.at) is None:
            return np.empty(0)
        if self.ready is None:
            try:
                parts = [{h: _numbers(f[h]) for h in self.wanted} for f in self._read(self.wanted, pl.Float64)]
                self.ready = {h: np.concatenate([part.pop(h) for part in parts]) for h in self.wanted}
            except pl.exceptions.PolarsError:
                self.ready = {}  # a cell that is no number: column by column
        if header not in self.ready:
            self.ready[header] = self._numbers(header)
        return self.ready[header]

    def _read(self, columns: list[str], kind: Any) -> Iterator[Any]:
        """The columns of ``columns`` as ``kind``, chunk by chunk."""
        import polars as pl

        places = [f"c{self.headers.index(h)}" for h in columns]  # names of our own: the file's may be empty
        head = self.separator.join(f"c{i}" for i in range(len(self.headers))).encode() + b"\n"
        at, whole = self.at, b'"' in self.raw  # a quoted cell may go over lines
        while at < len(self.raw):
            end = -1 if whole else self.raw.find(b"\n", at + _CHUNK)
            begin, at = at, len(self.raw) if end < 0 else end + 1
            frame = pl.read_csv(
                io.BytesIO(head + self.raw[begin:at]), separator=self.separator, infer_schema_length=0,
                schema_overrides=dict.fromkeys(places, kind),
                columns=places, truncate_ragged_lines=True, decimal_comma=self.comma and kind != pl.String,
                null_values=["", *_NO_SAMPLE],
            )  # fmt: skip
            yield frame.select(pl.col(p).alias(h) for p, h in zip(places, columns, strict=True))

    def _numbers(self, header: str) -> np.ndarray:
        """A column whose cells are not all plain numbers: blanks are taken off, the first cell that is none is
        named.
        """
        import polars as pl

        try:
            text = pl.concat([f[header] for f in self._read([header], pl.String)]).str.strip_chars()
        except pl.exceptions.PolarsError as e:
            raise LogError(f"{self.path}: column {header!r}: {str(e)[:160]}") from None
        text = text.set(text.is_in(["", *_NO_SAMPLE]), None)
        number = (text.str.replace(",", ".", literal=True) if self.comma else text).cast(pl.Float64, strict=False)
        bad = (number.is_null() & text.is_not_null()).arg_true()
        if bad.len() and header == self.time and (dates := from_dates(text)) is not None:
            self.notes.append(dates[1])
            return dates[0]
        if bad.len():
            raise LogError(
                f"{self.path}: column {header!r}, row {bad[0] + self.first}: {text[bad[0]][:40]!r} is not a number"
            )
        return _numbers(number)


def _numbers(column: Any) -> np.ndarray:
    """float64 of a polars column; no sample becomes `ABSENT`."""
    values = column.to_numpy().astype(np.float64, copy=True)
    values[column.is_null().to_numpy()] = ABSENT
    return values


def write_csv(path: Path, channels: dict[str, Channel], dbc: Path | None) -> None:
    """Write a CSV: t, then a column a channel on all times of all; an empty cell where a channel has no sample."""
    polars_table(channels).write_csv(path)
