"""CSV and its kin: text with a header line, read and written through pyarrow."""

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
from hil.logs.dates import OddRow, date_notes, from_dates
from hil.logs.layout import Layout, in_points, layout_of, line_at, opening, rows_of, units_row
from hil.logs.notes import MOST_ROWS, Note
from hil.logs.plausible import FEW, RUN
from hil.logs.source import ABSENT, Channel, LogError, Options, Source, is_absent, numbers, read_bytes
from hil.logs.table import ROW, Table, Time, split_unit, time_column
from vaneloop.base.files import whole

__all__ = ["open_csv", "open_text", "write_csv", "write_lvm", "write_msl"]

_NO_SAMPLE = ["NA", "N/A", "n/a", "#N/A", "#NA", "<NA>", "NaT", "null", "NULL", "(null)", "None", "-", "--", "---"]
# what C and table programs print for a number that is none
_NO_NUMBER = {f"{sign}1.#{word}" for sign in ("", "-") for word in ("IND", "QNAN", "SNAN", "INF")} | {
    "#DIV/0!", "#VALUE!", "#NUM!", "#REF!", "#NAME?", "#NULL!",
}  # fmt: skip
_BLOCK = 1 << 23  # bytes read at once; no row may be longer
_INK = re.compile(rb"\S")
_WORD = re.compile(rb"[b-dg-hj-mo-zB-DG-HJ-MO-Z_]")  # of a word, and neither of a number, nan nor inf
_END = "\x1e\x1a"  # stands behind the last row, where none can be
# a day, and the midnight that table programs put behind it
_DAY = re.compile(r"(?:\d{1,4}[-/.]\d{1,2}[-/.]\d{1,4}|\d{1,2}-[A-Za-zä]{3,9}-\d{4})(?:[ T]0?0:00(?::00(?:[.,]0+)?)?)?")
_CLOCK = re.compile(r"\d{1,2}:\d{2}.*")
_NUMBERED = re.compile(r"[._ ]\d+$")


def open_csv(path: Path, options: Options) -> Source:
    """A table of text: separator , ; or tab, decimal comma with any of them; empty cell = no sample there."""
    return open_text(path, read_bytes(path), options)


def open_text(path: Path, raw: bytes, options: Options) -> Source:
    """The table that ``raw`` is the text of."""
    if raw[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raw = raw.decode("utf-16", errors="replace").encode()
    cut = len(raw) - len(raw := raw.rstrip(b"\0"))  # space that a logger had taken before its power went
    if b"\0" in raw or not raw:
        raise LogError(f"{path}: is not a CSV (binary bytes in it)")
    if not raw.isascii():
        try:
            raw.decode("utf-8")
        except UnicodeDecodeError:
            raw = raw.decode("cp1252", errors="replace").encode()
        raw = raw.removeprefix(b"\xef\xbb\xbf")
    layout = layout_of(path, raw, options)
    keys, headers = layout.keys, layout.headers
    labview = layout.labview and "X_Value" in headers and "t" not in options.mapping.values()
    time = Time("X_Value") if labview else time_column(path, headers, options)
    own = _own_times(layout, time.name)
    known = {*options.signals, *options.mapping}
    for h in dict.fromkeys(headers):
        if h and headers.count(h) > 1 and h not in own.values() and ({h, split_unit(h)[0]} & known or h == time.name):
            others = [k for k, of in zip(keys, headers, strict=True) if of == h][1:]
            raise LogError(f"{path}: column {h!r} is there more than once (the others: {', '.join(others)})")
    wanted = [k for k in keys if k in known or split_unit(k)[0] in known or k == time.name]
    day = _day_beside(layout, time.name) if not own and time.name != ROW else ""
    raw, parts = _parts(path, raw, layout, time.name)
    if options.part > len(parts):
        raise LogError(f"{path}: part {options.part}: the log has {len(parts)} part{'s' * (len(parts) > 1)}")
    rows = _Csv(path, raw, layout, wanted, {time.name, *own.values()}, day)
    offered = [k for k in keys if k and k != day]
    units = {**{k: split_unit(h)[1] for k, h in zip(keys, headers, strict=True) if k != h}, **layout.units}
    table = Table(offered, rows.column, layout.first, time, units, own=own, parts=parts, part=options.part)
    rows.notes = table.notes
    if cut:
        table.notes.append(f"rows: behind the last one stand {cut:,} bytes of 0, as after a loss of power: left out")
    return table


def _own_times(layout: Layout, time: str) -> dict[str, str]:
    """Column -> the column of its own time, where each series has one before it; empty where one time is for all."""
    base = split_unit(time)[0].casefold()

    def is_one(key: str, header: str) -> bool:
        name = split_unit(header)[0].casefold()
        return key == time or name == base or (len(base) > 1 and _NUMBERED.sub("", name) == base)

    out, at, times = {}, "", 0
    for key, header in zip(layout.keys, layout.headers, strict=True):
        if is_one(key, header):
            at, times = key, times + 1
        elif not at:
            return {}
        elif key:
            out[key] = at
    return out if times > 1 and len(set(out.values())) == times else {}


def _day_beside(layout: Layout, time: str) -> str:
    """The column with the day, where the time column has the time of day only."""
    index = layout.keys.index(time)

    def first_of(k: int) -> str:
        rows = rows_of(layout.sample, layout.separator)
        return next((row[k] for row in rows if len(row) > k and row[k] not in ("", *_NO_SAMPLE)), "")

    if not _CLOCK.fullmatch(first_of(index)):
        return ""
    days = [h for k, h in enumerate(layout.keys) if h and k != index and _DAY.fullmatch(first_of(k))]
    called = [h for h in days if re.search(r"(?i)dat(e|um)|day|tag\b", h)]
    return (called or days)[0] if len(called) == 1 or len(days) == 1 else ""


def _parts(path: Path, raw: bytes, layout: Layout, time: str) -> tuple[bytes, tuple[int, ...]]:
    """The text with empty rows in place of headers that stand in it again, units below them, too, and the rows (from 0)
    behind these headers.

    Raises LogError for another header: the cells below it are of other columns.
    """
    head = raw[layout.head.at : layout.head.behind].strip(b"\r\n")
    begins = head.split(layout.separator.encode(), 1)[0] + layout.separator.encode()
    word = _WORD.search(head)  # a byte is found in much less time than a line
    if len(begins) < 2 or (word and raw.find(word[0], layout.at) < 0) or raw.find(head, layout.at) < 0:
        return raw, (0,)  # another header has no numbers, and is met by that
    out, parts, kept, at = [], [0], layout.at, layout.at - 1
    row, counted = layout.first, layout.at
    empty = layout.separator.encode() * (len(layout.keys) - 1) + b"\n"
    while (at := raw.find(b"\n" + begins, at)) >= 0:
        row, counted = row + raw.count(b"\n", counted, at + 1), at + 1
        line = line_at(raw, at + 1, row)
        if raw[line.at : line.behind].strip(b"\r\n") != head:
            raise LogError(f"{path}: row {row}: another header stands there; cut the file before it")
        first = line.at
        while first > kept:
            before = raw.rfind(b"\n", 0, first - 1) + 1
            text = line_at(raw, before).text
            if before < kept or (text.strip() and opening(text) not in layout.opens):
                break
            first = before
        behind = line.behind
        if units_row(line_at(raw, behind).text, layout.keys, layout.separator):
            behind = line_at(raw, behind).behind
        out += [raw[kept:first], empty * raw.count(b"\n", first, behind)]
        kept = behind
        parts.append(row + 1 - layout.first)
        at = behind - 1
    return b"".join([raw[: layout.at], *out, raw[kept:]]), tuple(parts)


class _Csv:
    """Rows of a table of text; ``wanted`` columns are read together on the first call, all others together when one of
    them is asked for: a file is parsed three times at most, however many columns it has.

    times  columns that are a time; ``day``: the column with the day of a time that is a time of day, "" for none
    """

    def __init__(self, path: Path, raw: bytes, layout: Layout, wanted: list[str], times: set[str], day: str):
        self.path, self.raw, self.at, self.layout, self.wanted = path, raw, layout.at, layout, wanted
        self.keys, self.separator, self.first = layout.keys, layout.separator, layout.first
        self.times, self.day, self.notes = times, day, list[str]()
        self.zero: int | None = None  # microseconds: the first of all dates
        self.fitted = False
        self.ready: dict[str, np.ndarray] | None = None
        self.text: Any = None  # the columns that are not ready, as words

    def column(self, key: str) -> np.ndarray:
        if _INK.search(self.raw, self.at) is None:
            return np.empty(0)
        if self.ready is None:
            if self.raw.find(b'"', self.at) >= 0 and self.raw.count(b'"', self.at) % 2:
                self._closed()
            try:
                table = self._read(self.wanted, pa.float64())
                self.ready = {k: numbers(table.column(k).combine_chunks()) for k in self.wanted}
            except pa.ArrowException:
                self.ready = {}  # a cell that is no number
        if key not in self.ready:
            self.ready[key] = self._numbers(key)
        if self.layout.labview and key in self.times and is_absent(self.ready[key]).all():
            self.ready[key] = self._steps(len(self.ready[key]))
        return self.ready[key]

    def _read(self, columns: list[str], kind: Any) -> Any:
        """The columns of ``columns`` as ``kind``. Rows with too many or too few cells are left out once, then the
        others read again.
        """
        places = [f"c{i}" for i in range(len(self.keys))]  # names of our own: the file's may be empty
        place = dict(zip(self.keys, places, strict=True))
        wanted = [place[k] for k in columns]
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
                    decimal_point="," if self.layout.comma else ".",
                ),
            )  # fmt: skip
        except pa.ArrowException:
            if not ragged or self.fitted:
                raise
            self.raw, self.fitted = self._fitting(), True
            self.at = 0
            return self._read(columns, kind)
        return table.rename_columns(columns)

    def _fitting(self) -> bytes:
        """Rows of as many cells as the header has; where a row had others, an empty one in its place.

        Cells that only end a row, empty, are taken off; a column of remarks at its end may lack its cell. Raises
        LogError where more than single rows do not fit.
        """
        try:
            rows, counts = _fitting(self.raw[self.at :], self.separator, self.layout.least, len(self.keys))
        except csv.Error as e:
            raise LogError(f"{self.path}: rows cannot be read ({e})") from None
        misfits = np.flatnonzero(counts)
        if not misfits.size:
            return rows
        first = int(misfits[0])
        said = f"{misfits.size:,} of {counts.size:,} rows have more or fewer cells than the header"
        said += f" (first row {self.first + first}: {counts[first]}, the header {len(self.keys)})"
        if misfits.size > FEW * counts.size and (misfits.size > RUN or 2 * misfits.size > counts.size):
            if self.separator == "," and counts[first] > len(self.keys):
                said += "; decimal commas, or lists, between commas? they need quotation marks or another separator"
            raise LogError(f"{self.path}: {said}")
        self.notes.append(
            Note(f"rows: {said}: left out", "left out", "rows", misfits.size, self.first + misfits[:MOST_ROWS])
        )
        return rows

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

    def _words(self, key: str) -> list[str]:
        """The cells of a column, without blanks around them; what stands for no sample is empty."""
        try:
            if self.text is None:
                ready = self.ready or {}
                self.text = self._read([k for k in self.keys if k and k not in ready], pa.string())
            cells = (cell.strip() for cell in self.text.column(key).to_pylist())
        except (pa.ArrowException, csv.Error) as e:
            raise LogError(f"{self.path}: column {key!r}: {str(e)[:160]}") from None
        return ["" if c in _NO_SAMPLE else c for c in cells]

    def _numbers(self, key: str) -> np.ndarray:
        """A column whose cells are not all plain numbers: blanks and signs between thousands are taken off, the first
        cell that is none is named.
        """
        text = self._words(key)
        try:
            plain = in_points(text, self.layout.comma, self.layout.thousands)
        except ValueError as e:
            raise LogError(
                f"{self.path}: column {key!r}: {str(e)!r} may have a decimal point or one between thousands, in a "
                "table with decimal commas"
            ) from None
        values = np.full(len(text), ABSENT)
        for row, cell in enumerate(plain):
            if not cell:
                continue
            try:
                if "_" in cell:  # Python's own spelling of thousands
                    raise ValueError
                values[row] = np.nan if cell in _NO_NUMBER else float(cell)
            except ValueError:
                if key in self.times and (t := self._dates(key, text)) is not None:
                    return t
                where = f"column {key!r}, row {row + self.first}"
                if key in self.times and text[row] == self.layout.headers[self.keys.index(key)]:
                    raise LogError(
                        f"{self.path}: row {row + self.first}: another header stands there; cut the file before it"
                    ) from None
                nor = ", nor a date such as 2026-03-01 10:00:00.000; write seconds" if key in self.times else ""
                raise LogError(f"{self.path}: {where}: {text[row][:40]!r} is not a number{nor}") from None
        return values

    def _steps(self, rows: int) -> np.ndarray:
        """The times of a LabVIEW measurement file that says its step only, s."""
        start, step = (self.layout.labview.get(k, [""])[0].replace(",", ".") for k in ("X0", "Delta_X"))
        try:
            return float(start or 0.0) + float(step) * np.arange(rows)
        except ValueError:
            raise LogError(f"{self.path}: has no times, and its step (Delta_X={step!r}) is no number") from None

    def _dates(self, key: str, text: list[str]) -> np.ndarray | None:
        """The times of a column of dates, s; None where they are none."""
        if self.day:
            days = [d.split(" ")[0].split("T")[0] for d in self._words(self.day)]
            text = [f"{d} {c}" if d and c else "" for d, c in zip(days, text, strict=True)]
        dates = from_dates(pa.array([c or None for c in text], pa.string()))
        if dates is None:
            return None
        if isinstance(dates, OddRow):
            raise LogError(f"{self.path}: column {key!r}, row {dates.row + self.first}: {dates.why}")
        if self.zero is not None:  # each series has its own time: all count from the first one
            return dates.t + (dates.zero - self.zero) * 1e-6
        self.zero = dates.zero
        self.notes += date_notes(dates, self.first)
        return dates.t


def _fitting(rows: bytes, separator: str, least: int, cells: int) -> tuple[bytes, np.ndarray]:
    """Rows of ``cells`` cells each, and of each row that had fewer than ``least`` or more of them how many; 0 of the
    others.
    """
    if b'"' in rows:
        out = io.StringIO(newline="")
        write = csv.writer(out, delimiter=separator, lineterminator="\n").writerow
        counts = []
        for row in csv.reader(io.StringIO(rows.decode(), newline=""), delimiter=separator):
            fits = _fits(row, least, cells)
            counts.append(0 if fits else len(row))
            write([*row[:cells], *[""] * (cells - len(row))] if fits else [""] * cells)
        return out.getvalue().encode(), np.array(counts, np.int64)
    between = separator.encode()
    lines = rows.replace(b"\r\n", b"\n").removesuffix(b"\n").split(b"\n")
    counted = np.zeros(len(lines), np.int64)
    for i, line in enumerate(lines):
        if (there := line.count(between) + 1) != cells:
            parts = line.split(between)
            fits = _fits(parts, least, cells)
            lines[i] = between.join(parts[:cells]) + between * max(cells - there, 0) if fits else between * (cells - 1)
            counted[i] = 0 if fits else there
    return b"\n".join(lines) + b"\n", counted


def _fits(row: list[Any], least: int, cells: int) -> bool:
    """Whether a row is as long as the header, but for what is empty at its end, or holds nothing."""
    if len(row) > cells:
        return not any(cell.strip() for cell in row[cells:])
    return len(row) >= least or not any(cell.strip() for cell in row)


def write_csv(path: Path, channels: dict[str, Channel], dbc: Path | None) -> None:
    """Write a CSV: t, then a column a channel on all times of all; an empty cell where a channel has no sample."""
    _write(path, arrow_table(channels), ",", "")


def write_msl(path: Path, channels: dict[str, Channel], dbc: Path | None) -> None:
    """Write a log as TunerStudio does: two lines, names, units, rows, with tabs between."""
    table = arrow_table(channels)
    names = list(channels)
    units = "\t".join(["s", *(c.unit for c in channels.values())]) + "\n"
    _write(path, table, "\t", '"VaneLoop"\n"Capture Date: "\n', ["Time", *names], units)


def write_lvm(path: Path, channels: dict[str, Channel], dbc: Path | None) -> None:
    """Write a LabVIEW measurement file: one time for all channels, decimal point."""
    table = arrow_table(channels)
    names = list(channels)
    about = {"Writer_Version": "2", "Reader_Version": "2", "Separator": "Tab", "Decimal_Separator": ".",
             "Multi_Headings": "No", "X_Columns": "One", "Time_Pref": "Relative"}  # fmt: skip
    block = {"Channels": [str(len(names))], "Samples": [str(table.num_rows)] * len(names),
             "Y_Unit_Label": [c.unit for c in channels.values()], "X_Dimension": ["Time"] * len(names)}  # fmt: skip
    head = "LabVIEW Measurement\t\n" + "".join(f"{k}\t{v}\n" for k, v in about.items()) + "***End_of_Header***\t\n\t\n"
    head += "".join("\t".join([k, *v]) + "\n" for k, v in block.items()) + "***End_of_Header***\t\n"
    _write(path, table, "\t", head, ["X_Value", *names])


def _write(
    path: Path, table: Any, separator: str, before: str, names: list[str] | None = None, under: str = ""
) -> None:
    """Write a table with its header, what stands before that, and what stands under it."""
    head = separator.join(names or table.column_names)  # Arrow would put quotes around every name
    form = arrow.WriteOptions(include_header=False, quoting_style="none", delimiter=separator)
    with whole(path, LogError) as part, part.open("wb") as file:
        file.write(f"{before}{head}\n{under}".encode())
        arrow.write_csv(table, file, form)
