"""Measured runs: read any log into channels in the product's names and units, write channels into any log.

A log is a CAN recording (`.log` of candump, `.asc`, `.blf`, `.trc`, bus-logging `.mf4`) with a DBC, MDF4 channel groups
(`.mf4`), CSV or Parquet. Whatever it is, it ends as a `Log`: per signal the times, strictly increasing, in seconds from
the start, and the values, finite, in the unit of docs/architecture.md. Each channel keeps its own raster; nothing is
interpolated and gaps stay gaps. What cannot be used raises `LogError`, one line; what had to be left out is said in
`Log.notes`. docs/logs.md is the user's page.
"""

from __future__ import annotations

import csv
import difflib
import functools
import io
import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from hil.logs import canlog, plausible
from hil.logs.canlog import LogError
from vaneloop.base import tables
from vaneloop.base.signals import UNITS

__all__ = ["Channel", "Log", "LogError", "offered", "read_log", "write_log"]


_TIME_NAMES = ("t", "time", "timestamp", "timestamps", "time_s", "zeit")
_EPOCH = 1e8  # s; a table whose time starts three years in counts from 1970, not from the start of the log
_MOST_FRAMES = 20_000_000  # of one message; 55 h at 10 ms
_HOLD = 3  # frame periods a value is repeated on the bus before its channel counts as silent


@dataclass(frozen=True)
class Channel:
    """Samples of one signal: t in s, strictly increasing; values in the signal's unit, finite."""

    t: np.ndarray
    values: np.ndarray


@dataclass(frozen=True)
class Log:
    """A measured run: where it is from, its channels by name, and what was left out or assumed on reading.

    Raises LogError where a channel of the product's signals cannot be in its unit, or where the time spans more than
    the rows are worth (`hil.logs.plausible`): no command gets such a log, whoever made it.
    """

    path: str
    channels: dict[str, Channel]
    notes: list[str] = field(default_factory=list)
    signals: Mapping[str, str] = field(default_factory=lambda: UNITS, repr=False)

    def __post_init__(self) -> None:
        wrong = []
        for name, c in self.channels.items():
            if _ours(name, self.signals) and (why := plausible.judge(name, c.values)[1]):
                wrong.append((name, name, why, c.values))
        _refuse_units(self.path, wrong)
        times = [c.t for c in self.channels.values() if c.t.size]
        if times and (why := plausible.span_complaint(times)):
            raise LogError(f"{self.path}: {why}; --unit t=ms, if time counts in ms")


def _ours(name: str, signals: Mapping[str, str]) -> bool:
    """Whether ``name`` is one of the product's signals: a system of a user's own may give its name to something
    else.
    """
    return name in plausible.RANGES and signals.get(name) == UNITS[name]


def _refuse_units(path: str | Path, wrong: list[tuple[str, str, str, np.ndarray]]) -> None:
    """Raise LogError if there is a channel (signal, name in the log, why, values) that cannot be in its unit."""
    if wrong:
        signal, key, why, values = wrong[0]
        also = "; the same for " + ", ".join(w[0] for w in wrong[1:]) if len(wrong) > 1 else ""
        raise LogError(f"{path}: {signal} ({key}): {why}; {plausible.proposed(signal, values)}{also}")


# --- sources: what a file offers, before names and units --------------------------------------------------------------


@dataclass(frozen=True)
class Series:
    """Samples as they stand in the file; sample k is called "``word`` ``first`` + k" (row 17)."""

    t: np.ndarray
    values: np.ndarray
    unit: str = ""
    t_unit: str = ""
    word: str = "sample"
    first: int = 1


class Source(Protocol):
    """A file that has been opened: ``names`` maps what it offers to the names it may be asked by."""

    kind: str
    names: dict[str, tuple[str, ...]]
    notes: list[str]
    sorted: bool

    def series(self, key: str) -> Series: ...

    def has(self) -> str: ...

    def absent(self, name: str) -> str: ...


class Bus:
    """A CAN log seen through a database: `MESSAGE.SIGNAL`, or `SIGNAL` where one message has it."""

    kind = "signal"
    sorted = True

    def __init__(self, frames: canlog.Frames, messages: list[canlog.Message], notes: list[str], dbc: Path):
        self.frames, self.dbc = frames, dbc
        self.notes = notes + frames.notes
        self.names: dict[str, tuple[str, ...]] = {}
        self._of: dict[str, tuple[canlog.Message, Any]] = {}
        self._silent: dict[str, str] = {}
        self._rows: dict[int, np.ndarray] = {}
        seen = np.unique(frames.ident)
        groups = canlog.pgn(seen[seen >> 31 == 1])
        for m in messages:
            here = m.ident in seen or (m.ident >> 31 and canlog.pgn(m.ident & 0x1FFFFFFF) in groups)
            for s in m.layout.signals:
                key = f"{m.layout.name}.{s.name}"
                if here:
                    self.names[key] = (key, s.name)
                    self._of[key] = m, s
                else:
                    why = (
                        f"{dbc.name} has it in {m.layout.name} (0x{m.ident & 0x1FFFFFFF:X}), but the log has no "
                        f"such frame"
                    )
                    self._silent[s.name] = self._silent[key] = why

    def has(self) -> str:
        if self.names:
            return _has(self.kind, self.names)
        ident, count = np.unique(self.frames.ident & 0x1FFFFFFF, return_counts=True)
        most = ", ".join(f"0x{i:X}" for i in ident[np.argsort(-count)][:8]) + (", ..." if ident.size > 8 else "")
        return f"; {self.dbc.name} has no message for the log's {ident.size} identifiers ({most}): --dbc F"

    def absent(self, name: str) -> str:
        return self._silent.get(name, "")

    def series(self, key: str) -> Series:
        m, signal = self._of[key]
        if m.ident not in self._rows:
            self._rows[m.ident], notes = canlog.select(self.frames, m)
            self.notes += notes
        rows, values, missing = canlog.cut_signal(self.frames, self._rows[m.ident], m, signal)
        if missing and not rows.size:
            self._silent[key] = self._silent[str(signal.name)] = f"all {missing} frames say not available"
        elif missing:
            self.notes.append(f"{key}: {missing} frames say not available: left out")
        return Series(self.frames.t[rows], values, str(signal.unit or ""))


class Table:
    """Columns of a CSV or Parquet file. A header may carry the unit: `n_r [rpm]`, `n_r (rpm)`."""

    kind = "column"
    sorted = False

    def __init__(self, headers: list[str], load: Callable[[str], np.ndarray], first: int, time: str):
        self.notes: list[str] = []
        self._load, self._first, self._time = load, first, time
        self._t: np.ndarray | None = None
        self.names = {h: tuple(dict.fromkeys((h, h.strip(), _split_unit(h)[0]))) for h in headers if h != time}

    def has(self) -> str:
        return _has(self.kind, [self._time, *self.names])

    def absent(self, name: str) -> str:
        return ""

    def series(self, key: str) -> Series:
        if self._t is None:
            self._t = self._load(self._time)
        values = self._load(key)
        if values.size != self._t.size:
            raise LogError(f"column {key!r} has {values.size} rows, the time column {self._time!r} has {self._t.size}")
        return Series(self._t, values, _split_unit(key)[1], _split_unit(self._time)[1], "row", self._first)


def _split_unit(header: str) -> tuple[str, str]:
    """`n_r [rpm]` is n_r in rpm; no bracket, no unit."""
    m = re.fullmatch(r"\s*([^\[\]()]+?)\s*(?:\[([^\[\]]*)\]|\(([^()]*)\))\s*", header)
    return (m[1], (m[2] if m[2] is not None else m[3]).strip()) if m else (header.strip(), "")


class _NoTime(LogError):
    """A table without a column that can be its time; ``headers`` are what it has."""

    def __init__(self, text: str, headers: list[str]):
        super().__init__(text)
        self.headers = headers


def _time_column(path: Path, headers: list[str], mapping: Mapping[str, str]) -> str:
    """The column of a table that holds the time: mapped to t, called t, or called like it."""
    asked = next((name for name, signal in mapping.items() if signal == "t"), None)
    for fold in (str, str.casefold):
        for name in _TIME_NAMES if asked is None else (fold(asked),):
            for h in headers:
                if name in (fold(h), fold(h.strip()), fold(_split_unit(h)[0])):
                    return h
    if asked is not None:
        raise _NoTime(
            f"{path}: no column {asked!r} to map to t{_close(asked, headers)}{_has('column', headers)}", headers
        )
    text = (
        f"{path}: no time column; looked for {', '.join(_TIME_NAMES)} (--map NAME=t names "
        f"another){_has('column', headers)}"
    )
    raise _NoTime(text, headers)


def _close(name: str, have: Iterable[str]) -> str:
    """Suggestions for a misspelt name."""
    back = {h.casefold(): h for h in have}
    near = difflib.get_close_matches(name.casefold(), back, 4, 0.6)
    return "; close: " + ", ".join(back[n][:60] for n in near) if near else ""


def _has(kind: str, have: Iterable[str]) -> str:
    """What the file offers, shortened."""
    names = [str(h)[:60] for h in have]
    if not names:
        return f"; the file has no {kind}"
    more = f" and {len(names) - 12} more" if len(names) > 12 else ""
    return f"; the file has {len(names)} {kind}{'s' * (len(names) != 1)}: {', '.join(names[:12])}{more}"


# --- CSV and Parquet --------------------------------------------------------------------------------------------------


def _open_csv(path: Path, options: _Options) -> Source:
    """CSV with one header line; separator , ; or tab, decimal comma with ; allowed; empty cell = no sample there."""
    raw = canlog.read_bytes(path)
    if raw[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raw = raw.decode("utf-16", errors="replace").encode()
    if b"\0" in raw:
        raise LogError(f"{path}: is not a CSV (binary bytes in it)")
    try:
        raw.decode("utf-8")
    except UnicodeDecodeError:
        raw = raw.decode("cp1252", errors="replace").encode()
    raw = raw.removeprefix(b"\xef\xbb\xbf")
    first = 2  # row of the first sample, as an editor counts
    head, _, rest = raw.partition(b"\n")
    while rest and (head.startswith(b"#") or not head.strip()):
        head, _, rest = rest.partition(b"\n")
        first += 1
    line = head.decode().strip("\r")
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
    comma = separator == ";" and re.search(rb"\d,\d", rest[:4096]) is not None

    time = _time_column(path, headers, options.mapping)
    known = {*UNITS, *options.mapping, time}
    table = _Csv(
        path, rest, headers, [h for h in headers if h in known or _split_unit(h)[0] in known], separator, comma, first
    )
    return Table([h for h in headers if h], table.column, first, time)


class _Csv:
    """Rows of a CSV; ``wanted`` columns are read together on the first call, any other when asked for."""

    def __init__(
        self, path: Path, rows: bytes, headers: list[str], wanted: list[str], separator: str, comma: bool, first: int
    ):
        self.path, self.rows, self.headers, self.wanted = path, rows, headers, wanted
        self.separator, self.comma, self.first = separator, comma, first
        self.ready: dict[str, np.ndarray] | None = None

    def column(self, header: str) -> np.ndarray:
        import polars as pl

        if not self.rows.strip():
            return np.empty(0)
        if self.ready is None:
            try:
                frame = self._read(self.wanted, pl.Float64)
                self.ready = {h: _numbers(frame[h]) for h in self.wanted}
            except pl.exceptions.PolarsError:
                self.ready = {}  # a cell that is no number: column by column
        if header not in self.ready:
            self.ready[header] = self._numbers(header)
        return self.ready[header]

    def _read(self, columns: list[str], kind: Any) -> Any:
        """The columns of ``columns`` as ``kind``."""
        import polars as pl

        places = [f"c{self.headers.index(h)}" for h in columns]  # names of our own: the file's may be empty
        head = self.separator.join(f"c{i}" for i in range(len(self.headers))).encode() + b"\n"
        frame = pl.read_csv(
            io.BytesIO(head + self.rows), separator=self.separator, infer_schema_length=0,
            schema_overrides=dict.fromkeys(places, kind),
            columns=places, truncate_ragged_lines=True, decimal_comma=self.comma and kind != pl.String,
            null_values=["", *_NO_SAMPLE],
        )  # fmt: skip
        return frame.select(pl.col(p).alias(h) for p, h in zip(places, columns, strict=True))

    def _numbers(self, header: str) -> np.ndarray:
        """A column whose cells are not all plain numbers: blanks are taken off, the first cell that is none is
        named.
        """
        import polars as pl

        try:
            text = self._read([header], pl.String)[header].str.strip_chars()
        except pl.exceptions.PolarsError as e:
            raise LogError(f"{self.path}: column {header!r}: {str(e)[:160]}") from None
        text = text.set(text.is_in(["", *_NO_SAMPLE]), None)
        number = (text.str.replace(",", ".", literal=True) if self.comma else text).cast(pl.Float64, strict=False)
        bad = (number.is_null() & text.is_not_null()).arg_true()
        if bad.len():
            raise LogError(
                f"{self.path}: column {header!r}, row {bad[0] + self.first}: {text[bad[0]][:40]!r} is not a number"
            )
        return _numbers(number)


def _numbers(column: Any) -> np.ndarray:
    """float64 of a polars column; no sample becomes `_ABSENT`."""
    values = column.to_numpy().astype(np.float64, copy=True)
    values[column.is_null().to_numpy()] = _ABSENT
    return values


_NO_SAMPLE = ["NA", "N/A", "null", "None", "-"]
_MOST_COLUMNS = 10_000
# A cell without a sample is this NaN; a NaN that the logger wrote is any other. Only the latter is reported.
_ABSENT = np.array([0x7FF8_0000_0000_0A0B], np.uint64).view(np.float64)[0]


def _is_absent(values: np.ndarray) -> np.ndarray:
    return values.view(np.uint64) == np.uint64(0x7FF8_0000_0000_0A0B)


_MOST_ROWS = (
    4_000_000,
    2,
)  # of a Parquet file, and more for each of its bytes; a column that never changes takes next to none

_MOST_UNPACKED = 40  # bytes a row of a column of numbers


def _chunks(group: Any) -> Iterable[Any]:
    return (group.column(k) for k in range(group.num_columns))


def _open_parquet(path: Path, options: _Options) -> Source:
    """Parquet with numeric columns; null = no sample there. Read by pyarrow: polars panics, loudly, on a
    damaged page.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    size = canlog.check_file(path)
    damage = pa.ArrowException, OSError, ValueError, OverflowError, MemoryError
    try:
        file = pq.ParquetFile(path)
        schema = file.schema_arrow
    except damage as e:
        raise LogError(f"{path}: is not a Parquet file ({str(e)[:160]})") from None
    if again := next((n for k, n in enumerate(schema.names) if n in schema.names[:k]), None):
        raise LogError(f"{path}: column {again!r} is there more than once")
    most = _MOST_ROWS[0] + _MOST_ROWS[1] * size
    if file.metadata.num_rows > most:
        raise LogError(
            f"{path}: {size:,} bytes say that they hold {file.metadata.num_rows:,} rows; allowed: up to {most:,}"
        )

    def load(key: str) -> np.ndarray:
        kind = schema.field(key).type
        kind = kind.value_type if pa.types.is_dictionary(kind) else kind
        scale = 1.0
        if pa.types.is_timestamp(kind) or pa.types.is_duration(kind):
            scale = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}[kind.unit]
        elif not (
            pa.types.is_integer(kind)
            or pa.types.is_floating(kind)
            or pa.types.is_decimal(kind)
            or pa.types.is_boolean(kind)
        ):
            raise LogError(f"{path}: column {key!r} holds {kind}, not numbers")
        chunks = [
            c
            for g in range(file.metadata.num_row_groups)
            for c in _chunks(file.metadata.row_group(g))
            if c.path_in_schema == key
        ]
        unpacked, most = (
            sum(c.total_uncompressed_size for c in chunks),
            _MOST_UNPACKED * (file.metadata.num_rows + 100_000),
        )
        if unpacked > most:
            raise LogError(f"{path}: column {key!r} unpacks to {unpacked:,} bytes; allowed: up to {most:,}")
        try:
            column = file.read(columns=[key], use_threads=False).column(key).combine_chunks().cast(kind)
            column.validate(full=True)
            if pa.types.is_timestamp(kind) or pa.types.is_duration(kind):
                column = column.cast(pa.int64())
            if pa.types.is_boolean(kind):
                column = column.cast(pa.int8())
            values = column.cast(pa.float64(), safe=False).fill_null(np.nan).to_numpy(zero_copy_only=False)
            values = np.array(values * scale if scale != 1.0 else values, np.float64)
            values[column.is_null().to_numpy(zero_copy_only=False)] = _ABSENT
            return values
        except damage as e:
            raise LogError(f"{path}: column {key!r} cannot be read ({str(e)[:160]})") from None

    return Table(list(schema.names), load, 1, _time_column(path, list(schema.names), options.mapping))


def _raster(channels: dict[str, Channel]) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """All times of all channels, and each channel on them, NaN where it has no sample."""
    t = np.unique(np.concatenate([c.t for c in channels.values()]))
    columns = {}
    for name, c in channels.items():
        columns[name] = np.full(t.size, np.nan)
        columns[name][np.searchsorted(t, c.t)] = c.values
    return t, columns


def _frame(channels: dict[str, Channel]) -> Any:
    """Channels as a polars table, t first, null where a channel has no sample."""
    import polars as pl

    t, columns = _raster(channels)
    return pl.DataFrame({"t": t, **columns}).with_columns(pl.all().fill_nan(None))


def _write_csv(path: Path, channels: dict[str, Channel], dbc: Path | None) -> None:
    _frame(channels).write_csv(path)


def _write_parquet(path: Path, channels: dict[str, Channel], dbc: Path | None) -> None:
    _frame(channels).write_parquet(path, compression="zstd")


# --- CAN --------------------------------------------------------------------------------------------------------------


def _bus_reader(read: Callable[[Path], canlog.Frames]) -> Callable[[Path, _Options], Source]:
    """Reader of a CAN log format: its frames, seen through the database."""

    def open_bus(path: Path, options: _Options) -> Source:
        return _bus(read(path), options)

    return open_bus


def _bus(frames: canlog.Frames, options: _Options) -> Bus:
    dbc = options.dbc or tables.path("vgv.dbc")
    messages, notes = canlog.load_dbc(dbc)
    return Bus(frames, messages, list(notes), dbc)


def _bus_writer(
    write: Callable[[Path, canlog.Frames], None],
) -> Callable[[Path, dict[str, Channel], Path | None], None]:
    """Writer of a CAN log format: channels to the frames of the database, then these to the file."""

    def write_bus(path: Path, channels: dict[str, Channel], dbc: Path | None) -> None:
        write(path, _encode(channels, dbc or tables.path("vgv.dbc"), path))

    return write_bus


def _encode(channels: dict[str, Channel], dbc: Path, path: Path) -> canlog.Frames:
    """Frames as the nodes would send them: each message at its period, with the value then valid.

    A value is repeated until its channel's next sample, but no longer than `_HOLD` frame periods or steps of the
    channel: after that the signal says "not available", and a message without any value is not sent. i_cmd is the mean
    since the last frame.
    """
    messages, _ = canlog.load_dbc(dbc)
    start = min(float(c.t[0]) for c in channels.values())
    parts = []
    left = set(channels)
    for m in messages:
        names = [s.name for s in m.layout.signals if s.name in channels]
        if not names:
            continue
        left -= set(names)
        period = (m.layout.cycle_time or 10) / 1000
        first = min(float(channels[n].t[0]) for n in names)
        last = max(float(channels[n].t[-1]) for n in names)
        if (last - first) / period > _MOST_FRAMES:
            raise LogError(f"{path}: {last - first:.3g} s are too long for a CAN log with a frame every {period:g} s")
        k = np.arange(math.ceil((first - start) / period - 1e-6), math.floor((last - start) / period + 1e-6) + 1)
        t = start + k * period
        values = {n: _sample(channels[n], t, period, n == "i_cmd") for n in names}
        sent = ~np.logical_and.reduce([np.isnan(v) for v in values.values()])
        t, values = t[sent], {n: v[sent] for n, v in values.items()}
        if "mode_request" in m.missing:
            values["mode_request"] = np.ones(t.size)
        try:
            data = canlog.encode(m, values, t.size)
        except LogError as e:
            raise LogError(f"{path}: {e}") from None
        parts.append((t - start, np.full(t.size, m.ident, np.uint32), data))
    if left:
        raise LogError(f"{path}: {dbc.name} has no signal for {', '.join(sorted(left))}")
    t = np.concatenate([p[0] for p in parts])
    ident = np.concatenate([p[1] for p in parts])
    width = max(8, *(p[2].shape[1] for p in parts))
    data = np.zeros((t.size, width), np.uint8)
    length = np.concatenate([np.full(len(p[2]), p[2].shape[1], np.uint8) for p in parts])
    at = 0
    for p in parts:
        data[at : at + len(p[2]), : p[2].shape[1]] = p[2]
        at += len(p[2])
    order = np.lexsort((ident & 0x1FFFFFFF, np.rint(t * 1e6)))  # the lower identifier wins arbitration
    return canlog.Frames(t[order], ident[order], np.zeros(t.size, np.int32), length[order], data[order])


def _sample(c: Channel, t: np.ndarray, period: float, mean: bool) -> np.ndarray:
    """The channel's value valid at each ``t``: its latest sample, or the mean since the sample before; NaN where it is
    silent.
    """
    now = np.searchsorted(c.t, t + 1e-6, side="right")
    age = t - c.t[np.maximum(now - 1, 0)]
    step = float(np.median(np.diff(c.t))) if c.t.size > 1 else 0.0
    there = (now > 0) & (age <= _HOLD * max(period, step))
    values = c.values[np.maximum(now - 1, 0)].copy()
    if mean and t.size:
        before = np.searchsorted(c.t, t - period + 1e-6, side="right")
        total = np.concatenate(([0.0], np.cumsum(c.values)))
        several = now - before > 1
        values[several] = (total[now] - total[before])[several] / (now - before)[several]
    return np.where(there, values, np.nan)


# --- MDF4 -------------------------------------------------------------------------------------------------------------


class Groups:
    """Channel groups of an MDF4 file: `CHANNEL`, or `GROUP.CHANNEL` where several groups have it."""

    kind = "channel"
    sorted = False

    def __init__(self, content: dict[str, Any]):
        self.notes: list[str] = []
        self.names = {key: tuple(names) for key, names in content["names"].items()}
        self._series, self._why = content["series"], content["why"]

    def has(self) -> str:
        return _has(self.kind, self.names)

    def absent(self, name: str) -> str:
        return ""

    def series(self, key: str) -> Series:
        if key not in self._series:
            self.notes.append(f"{key}: {self._why.get(key, 'has no samples')}")
            return Series(np.empty(0), np.empty(0))
        t, values, unit = self._series[key]
        return Series(t, values, unit)


def _open_mdf(path: Path, options: _Options) -> Source:
    """MDF4: bus logging where the file holds CAN frames and a DBC is given or no channel has a name that is
    asked for.
    """
    from hil.logs import mdf

    wanted = [*UNITS, *options.mapping]
    content, frames = mdf.read_mdf(path, wanted)
    groups = Groups(content)
    if frames is not None and (
        options.dbc is not None or not any(_find(groups, n, n in options.mapping) for n in wanted)
    ):
        return _bus(frames, options)
    return groups


def _write_mdf(path: Path, channels: dict[str, Channel], dbc: Path | None) -> None:
    """Channel groups, one per raster; bus logging where a DBC is given."""
    from hil.logs import mdf

    if dbc is not None:
        mdf.write_bus(path, _encode(channels, dbc, path))
        return
    rasters: dict[bytes, tuple[np.ndarray, dict[str, tuple[np.ndarray, str]]]] = {}
    for name, c in channels.items():
        rasters.setdefault(c.t.tobytes(), (c.t, {}))[1][name] = c.values, UNITS[name].replace("-", "")
    mdf.write_groups(path, list(rasters.values()))


# --- formats ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Options:
    """What a reader may need beyond the path."""

    dbc: Path | None
    mapping: Mapping[str, str]


@dataclass(frozen=True)
class _Format:
    read: Callable[[Path, _Options], Source]
    write: Callable[[Path, dict[str, Channel], Path | None], None]


_FORMATS: dict[str, _Format] = {
    ".log": _Format(_bus_reader(canlog.read_candump), _bus_writer(canlog.write_candump)),
    ".asc": _Format(_bus_reader(canlog.read_asc), _bus_writer(canlog.write_asc)),
    ".blf": _Format(_bus_reader(canlog.read_blf), _bus_writer(canlog.write_blf)),
    ".trc": _Format(_bus_reader(canlog.read_trc), _bus_writer(canlog.write_trc)),
    ".mf4": _Format(_open_mdf, _write_mdf),
    ".csv": _Format(_open_csv, _write_csv),
    ".parquet": _Format(_open_parquet, _write_parquet),
}


def _format(path: Path) -> _Format:
    found = _FORMATS.get(path.suffix.lower())
    if found is None:
        raise LogError(f"{path}: suffix {path.suffix!r} is not a log's; allowed: {', '.join(_FORMATS)}")
    return found


# --- units ------------------------------------------------------------------------------------------------------------

_SPEED = ("n_dem", "n_r")
_ALIASES = {
    "%": "percent", "pct": "percent", "per cent": "percent", "1": "", "ratio": "",
    "°": "degree", "deg": "degree", "°c": "degC", "c": "degC", "celsius": "degC", "deg c": "degC",
    "°f": "degF", "degf": "degF", "f": "degF", "k": "kelvin", "rpm": "rpm", "1/min": "rpm", "u/min": "rpm",
    "r/min": "rpm",
    "rev/min": "rpm", "min^-1": "rpm", "rps": "turn/second", "rev/s": "turn/second", "1/s": "turn/second",
    "hz": "turn/second",
    "khz": "kiloturn/second", "sec": "second", "s": "second",
    "ms": "millisecond", "us": "microsecond", "µs": "microsecond", "ns": "nanosecond", "min": "minute",
}  # fmt: skip


# A unit text comes from a file: 9**9**9 would keep pint busy for hours.
_UNIT = re.compile(r"[A-Za-z%°µμΩ_/*^.0-9 ()-]*")
_POWER_TOWER = re.compile(r"(\*\*|\^)\s*-?\d{2}|(\*\*|\^).*(\*\*|\^)|\d{4}")


@functools.lru_cache(maxsize=1)
def _registry() -> Any:
    import pint

    return pint.UnitRegistry(autoconvert_offset_to_baseunit=True)


@functools.lru_cache(maxsize=256)
def _factor(unit: str, into: str) -> tuple[float, float] | None | str:
    """(a, b) with value_in_into = a * value_in_unit + b; None where ``unit`` is no unit, its name where it cannot be
    converted.

    Frequencies are turns: 1 Hz of a rotor is 60 rpm (pint alone would take it for 1 rad/s).
    """
    import pint

    text = unit.strip()
    text = _ALIASES.get(text.casefold(), text)
    if len(text) > 32 or not _UNIT.fullmatch(text) or _POWER_TOWER.search(text):
        return None
    registry = _registry()
    into = _ALIASES.get(into.casefold(), into)
    try:
        parsed = registry.parse_units(text)
    except (
        pint.errors.PintError,
        ValueError,
        TypeError,
        AttributeError,
        KeyError,
        SyntaxError,
        RecursionError,
        ArithmeticError,
    ):
        return None
    except Exception as e:  # the tokenizer of pint's grammar has error types of its own
        if type(e).__module__ in ("tokenize", "builtins"):
            return None
        raise
    try:
        a, b = (float(registry.Quantity(v, parsed).to(into).magnitude) for v in (0.0, 1.0))
    except (pint.errors.PintError, ValueError, TypeError, ArithmeticError):
        return text
    if not (math.isfinite(a) and math.isfinite(b)) or a == b:
        return None
    return b - a, a


_NO_UNIT = ("", "-", "none", "n/a", "null")  # and "1" where a file says it: MDF writers put it for "nothing"


@dataclass(frozen=True)
class _Units:
    """How to bring a signal's samples to its own unit; ``stated`` are the units that the user named, signal -> unit."""

    path: Path
    stated: Mapping[str, str]
    design_rpm: float | None
    notes: list[str]
    signals: Mapping[str, str] = field(default_factory=lambda: UNITS)

    def convert(self, signal: str, key: str, values: np.ndarray, unit: str) -> np.ndarray:
        own = self.signals.get(signal, "s")
        stated = signal in self.stated
        unit = self.stated.get(signal, unit).strip()
        if signal == "state" or unit == own or unit.casefold() in _NO_UNIT or (unit == "1" and not stated):
            return values
        factor = _factor(unit, own)
        if isinstance(factor, tuple):
            return values if factor == (1.0, 0.0) else values * factor[0] + factor[1]
        if factor is None and not stated:
            self.notes.append(f"{signal} ({key}): unit {unit!r} is not known, {own} assumed")
            return values
        allowed = f"{own} or what converts to it"
        if signal in _SPEED:
            allowed = "%, or rpm, Hz, rad/s with the design speed"
            speed = _factor(unit, "rpm")
            if isinstance(speed, tuple):
                if self.design_rpm is None:
                    way = f"--design-rpm R gives the design speed, --unit {signal}=% says that it is % already"
                    raise LogError(
                        f"{self.path}: {signal} ({key}) is in {unit} and needs the design speed to become %; {way}"
                    )
                return values * (speed[0] * 100.0 / self.design_rpm)
        what = "unit is not known" if factor is None else "unit does not convert"
        raise LogError(f"{self.path}: {signal} ({key}) in {unit!r}: {what}; allowed: {allowed} (--unit {signal}=...)")


# --- reading ----------------------------------------------------------------------------------------------------------


def _pairs(path: Path, mapping: Mapping[str, str] | None, signals: Mapping[str, str] = UNITS) -> dict[str, str]:
    """Mapping as signal -> name in the log; both directions are understood, {"N1": "n_dem"} and {"n_dem": "N1"}."""
    known = {*signals, "t"}
    out: dict[str, str] = {}
    for a, b in (mapping or {}).items():
        if b in known:
            name, signal = a, b
        elif a in known:
            name, signal = b, a
        else:
            raise LogError(
                f"{path}: map {a}={b}: {b!r} is not a signal{_close(b, known)}; allowed: {', '.join(signals)}, t"
            )
        if signal in out and out[signal] != name:
            raise LogError(f"{path}: both {out[signal]!r} and {name!r} are mapped to {signal}")
        out[signal] = name
    return out


def _find(source: Source, name: str, mapped: bool) -> list[str]:
    """What the file offers under ``name``: full name before short; in any case of letters only where the user gave the
    name.
    """
    if name in source.names:
        return [name]
    for fold in (str, str.casefold) if mapped else (str,):
        hits = [k for k, aliases in source.names.items() if any(fold(name) == fold(a) for a in aliases)]
        if hits:
            return hits
    return []


def _take(
    path: Path, source: Source, signal: str, name: str, mapped: bool, needed: bool, notes: list[str]
) -> tuple[str, Series] | None:
    """Key and samples of a signal; None where the file does not offer it. Refuses a name that the user gave in vain."""
    keys = _find(source, name, mapped)
    if not keys:
        if not mapped:
            return None
        reason = source.absent(name)
        close = f" ({reason})" if reason else _close(name, {a for aliases in source.names.values() for a in aliases})
        raise LogError(f"{path}: no {source.kind} {name!r} to map to {signal}{close}{source.has()}")
    series = {k: source.series(k) for k in keys}
    if len(keys) == 1:
        return keys[0], series[keys[0]]
    # databases repeat a name in messages that never carry it: the only one that moves is meant
    moving = [k for k in keys if series[k].values.size and np.ptp(series[k].values) > 0]
    if len(moving) == 1:
        notes.append(f"{signal}: took {moving[0]}; {', '.join(k for k in keys if k != moving[0])} never changes")
        return moving[0], series[moving[0]]
    if mapped or needed:
        raise LogError(f"{path}: {signal} may be {' or '.join(keys[:6])}; name one: --map {keys[0]}={signal}")
    notes.append(f"{signal}: may be {' or '.join(keys[:6])}: left out (--map {keys[0]}={signal} takes one)")
    return None


def _in_time(s: Series, t: np.ndarray, known: dict[int, np.ndarray], notes: list[str]) -> np.ndarray:
    """The times ``t`` (s) of a series; rows whose stamp is wrong have none. ``known``: what was found before, by the
    array of the file.
    """
    if id(s.t) not in known:
        rows = np.flatnonzero(np.isfinite(t))
        bad = None
        if rows.size and (np.diff(t[rows]) < 0).any():
            bad = plausible.out_of_order(t[rows])
        known[id(s.t)] = rows[bad] if bad is not None else rows[:0]
        if known[id(s.t)].size:
            first = int(known[id(s.t)][0])
            what = f"{known[id(s.t)].size:,} of {rows.size:,} {s.word}s"
            notes.append(
                f"time: {what} have a wrong time stamp (first {s.word} {first + s.first}: {t[first]:.9g} s): left out"
            )
    bad = known[id(s.t)]
    there = np.isfinite(s.values)
    if not bad.size or 2 * np.count_nonzero(there[bad]) > np.count_nonzero(
        there
    ):  # a channel that has a block of rows of its own
        return t
    t = t.copy()
    t[bad] = _ABSENT
    return t


def _clean(path: Path, signal: str, key: str, s: Series, in_order: bool, notes: list[str]) -> Channel | None:
    """Samples that can be used: both numbers finite, time strictly increasing; None where nothing is left."""
    t, values = s.t, s.values
    finite = np.isfinite(t) & np.isfinite(values)
    if not finite.all():
        lost = int(np.count_nonzero(~finite & ~(_is_absent(values) | _is_absent(t))))
        if lost:
            notes.append(f"{signal} ({key}): {lost} of {t.size} samples are NaN or infinite: left out")
        t, values = t[finite], values[finite]
    if not in_order and t.size:
        back = np.flatnonzero(np.diff(t) < 0)
        if back.size:
            row, (a, b) = np.flatnonzero(finite)[back[0] + 1] + s.first, t[back[0] : back[0] + 2]
            raise LogError(
                f"{path}: {signal} ({key}): time runs backwards at {s.word} {row}, from {a:.9g} s to {b:.9g} s"
            )
    if t.size:
        last = np.append(np.diff(t) > 0, True)
        if not last.all():
            notes.append(
                f"{signal} ({key}): {int(np.count_nonzero(~last))} of {t.size} samples have the time of the next: "
                f"left out"
            )
            t, values = t[last], values[last]
    if not t.size:
        if s.t.size:
            notes.append(f"{signal} ({key}): no sample that can be used")
        return None
    return Channel(np.ascontiguousarray(t, np.float64), np.ascontiguousarray(values, np.float64))


def read_log(
    path: str | Path,
    *,
    dbc: str | Path | None = None,
    mapping: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    design_rpm: float | None = None,
    require: Iterable[str] = ("n_dem",),
    signals: Mapping[str, str] = UNITS,
) -> Log:
    """Read a log of any format into channels with the product's names and units.

    path        the file; its suffix says the format
    dbc         database of a CAN log; default: tables/vgv.dbc
    mapping     name in the log -> signal, {"N1_DEM": "n_dem"}; a CAN name may be MESSAGE.SIGNAL, an MDF name
                GROUP.CHANNEL
    units       signal -> unit that the log uses for it, {"n_r": "rpm"}; goes before a unit in the file
    design_rpm  design speed, rpm; needed where a rotor speed is not in %
    require     signals without which the log is of no use; each needs two samples
    signals     name -> unit of all signals to look for; default: the product's

    Raises LogError, one line, for whatever cannot be used.
    """
    path, require = Path(path), tuple(require)
    named = _pairs(path, mapping, signals)
    for what, given in (("unit of", dict(units or {})), ("required", dict.fromkeys(require))):
        for signal in given:
            if signal not in signals and signal != "t":
                raise LogError(
                    f"{path}: {what} {signal!r}: is not a signal{_close(signal, signals)}; allowed: "
                    f"{', '.join(signals)}, t"
                )
    if design_rpm is not None and not (math.isfinite(design_rpm) and design_rpm > 0):
        raise LogError(f"{path}: design speed (={design_rpm:g} rpm) must be finite and above 0")

    source = _format(path).read(
        path, _Options(Path(dbc) if dbc is not None else None, {name: signal for signal, name in named.items()})
    )
    notes: list[str] = []
    unit = _Units(path, units or {}, design_rpm, notes, signals)
    channels: dict[str, Channel] = {}
    keys: dict[str, str] = {}
    wrong: list[tuple[str, str, str, np.ndarray]] = []
    known: dict[int, np.ndarray] = {}
    for signal in signals:
        name = named.get(signal, signal)
        said = len(source.notes), len(notes)
        try:
            taken = _take(path, source, signal, name, signal in named, signal in require, notes)
        except LogError as e:
            raise e if str(e).startswith(str(path)) else LogError(f"{path}: {e}") from None
        if taken is not None:
            key, s = taken
            with np.errstate(all="ignore"):  # what overflows is not finite and left out below
                t = unit.convert("t", "t", s.t, s.t_unit)
                values = unit.convert(signal, key, s.values, s.unit)
            if values is not s.values:
                values = np.where(_is_absent(s.values), _ABSENT, values)
            if not plausible.latest(t[np.isfinite(t)]):
                raise LogError(
                    f"{path}: time (={np.nanmedian(t):.6g} s) must be below {plausible.LATEST:g} s; --unit t=ms, if "
                    f"it is in ms"
                )
            if not source.sorted:
                t = _in_time(s, t, known, notes)
            channel = _clean(path, signal, key, replace(s, t=t, values=values), source.sorted, notes)
            if channel is not None and _ours(signal, signals):
                channel = _inside(signal, key, channel, wrong, notes)
            if channel is not None:
                channels[signal], keys[signal] = channel, key
        if signal in require and (signal not in channels or channels[signal].t.size < 2):
            found = "only one sample of" if signal in channels else "no"
            reason = "; ".join(source.notes[said[0] :] + notes[said[1] :]) or source.absent(name)
            asked = f"looked for {source.kind} {name!r}" + (f" ({reason})" if reason else "")
            raise LogError(f"{path}: {found} {signal}: {asked}; --map NAME={signal} names another{source.has()}")
    _refuse_units(path, wrong)
    channels = _one_run(path, channels, require, notes)
    _shift(channels, notes)
    ours = {name: (c.t, c.values) for name, c in channels.items() if _ours(name, signals)}
    sure, perhaps = plausible.too_small(ours, set(units or {}))
    if sure:
        small, *others = sure
        raise LogError(
            f"{path}: {small} ({keys[small]}): {sure[small]}"
            + (f"; the same for {', '.join(others)}" if others else "")
        )
    notes += [f"{name} ({keys[name]}): {why}" for name, why in perhaps.items()]
    return Log(str(path), channels, list(dict.fromkeys([*source.notes, *notes])), signals)


def _inside(
    signal: str, key: str, c: Channel, wrong: list[tuple[str, str, str, np.ndarray]], notes: list[str]
) -> Channel | None:
    """The channel without the few samples that its signal cannot have; where they are not few, it goes on the list of
    the wrong.
    """
    inside, why = plausible.judge(signal, c.values)
    if why:
        wrong.append((signal, key, why, c.values))
    if why or inside.all():
        return c
    r, far = plausible.RANGES[signal], c.values[~inside]
    unit = "" if r.unit == "-" else f" {r.unit}"
    furthest = far[np.argmax(np.abs(far))]
    what = (
        f"{far.size:,} of {inside.size:,} samples are outside {r.low:g} to {r.high:g}{unit} (furthest {furthest:.6g})"
    )
    notes.append(f"{signal} ({key}): {what}: left out")
    return Channel(c.t[inside], c.values[inside])


def _one_run(
    path: Path, channels: dict[str, Channel], require: tuple[str, ...], notes: list[str]
) -> dict[str, Channel]:
    """Channels of the one run that the log holds, where its clock jumped."""
    if not channels:
        return channels
    first, last, note, why = plausible.longest_part([c.t for c in channels.values()])
    if why:
        raise LogError(f"{path}: {why}")
    if not note:
        return channels
    notes.append(note)
    out = {}
    for name, c in channels.items():
        use = (c.t >= first) & (c.t <= last)
        if use.any():
            out[name] = Channel(c.t[use], c.values[use])
        if name in require and np.count_nonzero(use) < 2:
            raise LogError(f"{path}: no {name} in the part of the log that is kept ({note})")
    return out


def offered(path: str | Path, *, dbc: str | Path | None = None) -> list[str]:
    """Names that a log offers and that ``mapping`` may name. Raises LogError for a file that is no log."""
    path = Path(path)
    try:
        source = _format(path).read(path, _Options(Path(dbc) if dbc is not None else None, {}))
    except _NoTime as e:
        return [h for h in e.headers if h]
    time = getattr(source, "_time", None)  # a table's time column is a column like any other
    return [*([time] if time else []), *source.names]


def _shift(channels: dict[str, Channel], notes: list[str]) -> None:
    """Count time from the start of the log where the file counts from 1970, from midnight, or from an event far
    away.
    """
    if channels and abs(start := min(float(c.t[0]) for c in channels.values())) > plausible.JUMP:
        since = "counts from 1970" if start > _EPOCH else "does not count from the start"
        notes.append(f"time {since}: {start:.6f} s taken for the start of the log")
        for name, c in channels.items():
            channels[name] = Channel(c.t - start, c.values)


# --- writing ----------------------------------------------------------------------------------------------------------


def write_log(path: str | Path, channels: dict[str, Channel], *, dbc: str | Path | None = None) -> None:
    """Write channels as a log; the suffix says the format.

    Tables and MDF4 hold every sample as it is. CAN formats hold what the bus would carry: the frames of ``dbc``
    (default tables/vgv.dbc) at their periods, in their resolution, with valid counter and CRC, from 0 s on. Raises
    LogError for a name that is no signal, a channel that is not one, a value that its frame cannot hold.
    """
    path = Path(path)
    write = _format(path).write
    if not channels:
        raise LogError(f"{path}: no channel to write")
    checked = {}
    for name, c in channels.items():
        if name not in UNITS:
            raise LogError(f"{path}: {name!r} is not a signal{_close(name, UNITS)}; allowed: {', '.join(UNITS)}")
        t, values = np.asarray(c.t, np.float64), np.asarray(c.values, np.float64)
        if t.ndim != 1 or t.shape != values.shape or not t.size:
            raise LogError(
                f"{path}: {name}: t {t.shape} and values {values.shape} must be lists of one length, not empty"
            )
        if not (np.isfinite(t).all() and np.isfinite(values).all() and (np.diff(t) > 0).all()):
            raise LogError(f"{path}: {name}: samples must be finite and their times increasing")
        checked[name] = Channel(t, values)
    try:
        write(path, checked, Path(dbc) if dbc is not None else None)
    except OSError as e:
        raise LogError(f"{path}: cannot be written ({e.strerror or e})") from None
