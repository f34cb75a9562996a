"""CSV: text with a header line, read and written through pyarrow."""

from __future__ import annotations

import csv
import io
import re
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from pyarrow import csv as arrow

from hil.logs.arrow import arrow_table
from hil.logs.dates import OddRow, from_dates
from hil.logs.source import ABSENT, Channel, LogError, Options, Source, numbers, read_bytes, second
from hil.logs.table import Table, split_unit, time_column
from hil.logs.units import NO_UNIT, factor_of
from vaneloop.base.files import whole
from vaneloop.base.signals import UNITS

__all__ = ["open_csv", "write_csv"]

_NO_SAMPLE = ["NA", "N/A", "null", "None", "-"]
_MOST_COLUMNS = 10_000
_BLOCK = 1 << 23  # bytes read at once; no row may be longer
_INK = re.compile(rb"\S")
_END = "\x1e\x1a"  # stands behind the last row, where none can be


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
    again = second(h for h in headers if h)
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
    """Rows of a CSV, from byte ``at`` of ``raw``; ``wanted`` columns are read together on the first call, all others
    together when one of them is asked for: a file is parsed three times at most, however many columns it has.
    """

    def __init__(
        self, path: Path, raw: bytes, at: int, headers: list[str], wanted: list[str], separator: str, comma: bool,
        first: int, time: str,
    ):  # fmt: skip
        self.path, self.raw, self.at, self.headers, self.wanted = path, raw, at, headers, wanted
        self.separator, self.comma, self.first = separator, comma, first
        self.time, self.notes = time, list[str]()
        self.squared = False
        self.ready: dict[str, np.ndarray] | None = None
        self.text: Any = None  # the columns that are not ready, as words

    def column(self, header: str) -> np.ndarray:
        if _INK.search(self.raw, self.at) is None:
            return np.empty(0)
        if self.ready is None:
            if self.raw.count(b'"', self.at) % 2:
                self._closed()
            try:
                table = self._read(self.wanted, pa.float64())
                self.ready = {h: numbers(table.column(h).combine_chunks()) for h in self.wanted}
            except pa.ArrowException:
                self.ready = {}  # a cell that is no number
        if header not in self.ready:
            self.ready[header] = self._numbers(header)
        return self.ready[header]

    def _read(self, columns: list[str], kind: Any) -> Any:
        """The columns of ``columns`` as ``kind``. Rows with too many or too few cells are squared once, then read
        again.
        """
        places = [f"c{i}" for i in range(len(self.headers))]  # names of our own: the file's may be empty
        place = dict(zip(self.headers, places, strict=True))
        wanted = [place[h] for h in columns]
        ragged = False

        def other_length(row: Any) -> str:
            nonlocal ragged
            ragged = True
            return "error"

        try:
            table = arrow.read_csv(
                pa.BufferReader(pa.py_buffer(self.raw).slice(self.at)),
                arrow.ReadOptions(column_names=places, block_size=_BLOCK),
                arrow.ParseOptions(
                    delimiter=self.separator, newlines_in_values=b'"' in self.raw, ignore_empty_lines=False,
                    invalid_row_handler=other_length,
                ),
                arrow.ConvertOptions(
                    check_utf8=False,  # it was decoded before
                    column_types=dict.fromkeys(wanted, kind), include_columns=wanted,
                    null_values=["", *_NO_SAMPLE], strings_can_be_null=False,
                    decimal_point="," if self.comma else ".",
                ),
            )  # fmt: skip
        except pa.ArrowException:
            if not ragged or self.squared:
                raise
            self.raw, self.squared = self._rows_squared(len(places)), True
            self.at = 0
            return self._read(columns, kind)
        return table.rename_columns(columns)

    def _rows_squared(self, cells: int) -> bytes:
        try:
            return _squared(self.raw[self.at :], self.separator, cells)
        except csv.Error as e:
            raise LogError(f"{self.path}: rows cannot be read ({e})") from None

    def _closed(self) -> None:
        """Refuse a quotation mark that nobody closes: it would swallow all rows behind it as one cell."""
        text, row = self.raw[self.at :].decode() + f"\n{_END}", self.first
        try:
            for cells in csv.reader(io.StringIO(text, newline=""), delimiter=self.separator):
                if cells and cells[-1].endswith(_END) and cells != [_END]:
                    break
                row += 1 + sum(c.count("\n") for c in cells)
            else:
                return
        except csv.Error:  # a cell longer than any number
            pass
        raise LogError(f"{self.path}: row {row}: a quotation mark opens a cell that no other one closes")

    def _numbers(self, header: str) -> np.ndarray:
        """A column whose cells are not all plain numbers: blanks are taken off, the first cell that is none is
        named.
        """
        try:
            if self.text is None:
                ready = self.ready or {}
                self.text = self._read([h for h in self.headers if h and h not in ready], pa.string())
            text = [cell.strip() for cell in self.text.column(header).to_pylist()]
        except (pa.ArrowException, csv.Error) as e:
            raise LogError(f"{self.path}: column {header!r}: {str(e)[:160]}") from None
        values = np.full(len(text), ABSENT)
        for row, cell in enumerate(text):
            if cell == "" or cell in _NO_SAMPLE:
                continue
            number = cell.replace(",", ".") if self.comma else cell
            try:
                if "_" in number:  # Python's own spelling of thousands
                    raise ValueError
                values[row] = float(number)
            except ValueError:
                if header == self.time:
                    none = {"", *_NO_SAMPLE}
                    dates = from_dates(pa.array([None if c in none else c for c in text], pa.string()))
                    if isinstance(dates, OddRow):
                        where = f"column {header!r}, row {dates.row + self.first}"
                        raise LogError(f"{self.path}: {where}: {dates.why}") from None
                    if dates is not None:
                        self.notes.append(dates[1])
                        return dates[0]
                raise LogError(
                    f"{self.path}: column {header!r}, row {row + self.first}: {cell[:40]!r} is not a number"
                ) from None
        return values


def _squared(rows: bytes, separator: str, cells: int) -> bytes:
    """Rows of so many cells each: of a row with more the rest is left out, what a shorter one lacks is empty."""
    if b'"' in rows:
        out = io.StringIO(newline="")
        write = csv.writer(out, delimiter=separator, lineterminator="\n").writerow
        for row in csv.reader(io.StringIO(rows.decode(), newline=""), delimiter=separator):
            write([*row[:cells], *[""] * (cells - len(row))])
        return out.getvalue().encode()
    between = separator.encode()
    lines = rows.replace(b"\r\n", b"\n").removesuffix(b"\n").split(b"\n")
    for i, line in enumerate(lines):
        if missing := cells - 1 - line.count(between):
            lines[i] = between.join(line.split(between)[:cells]) + between * max(missing, 0)
    return b"\n".join(lines) + b"\n"


def write_csv(path: Path, channels: dict[str, Channel], dbc: Path | None) -> None:
    """Write a CSV: t, then a column a channel on all times of all; an empty cell where a channel has no sample."""
    table = arrow_table(channels)
    with whole(path, LogError) as part, part.open("wb") as file:
        file.write(",".join(table.column_names).encode() + b"\n")  # Arrow would put quotes around every name
        arrow.write_csv(table, file, arrow.WriteOptions(include_header=False, quoting_style="none"))
