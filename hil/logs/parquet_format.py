"""Parquet, read and written through pyarrow."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from hil.logs.arrow import arrow_table
from hil.logs.dates import OddRow, date_notes, from_dates
from hil.logs.source import Channel, LogError, Options, Source, check_file, numbers, second
from hil.logs.table import Table, time_column
from vaneloop.base.files import whole

__all__ = ["FRAME_COLUMNS", "open_parquet", "said_by_parquet", "whole_parquet", "write_parquet"]

FRAME_COLUMNS = ("time", "id", "extended", "kind", "tx", "length", "bytes")  # of a table that has a row a frame

_MOST_ROWS = (
    4_000_000,
    2,
)  # of a Parquet file, and more for each of its bytes; a column that never changes takes next to none
# Bytes that a row group may unpack to: for each row of each column, and for each byte of the file (columns of text).
# The group says it, since pyarrow 26 ends the process when it is asked for a column chunk whose statistics are damaged.
_MOST_UNPACKED = 40, 100


_DAMAGE = OSError, ValueError, OverflowError, MemoryError


def whole_parquet(path: Path) -> Any:
    """A Parquet file of any kind, opened (`pyarrow.parquet.ParquetFile`). Every reader of the format begins here.

    Raises LogError for what is none, and for one that says that it unpacks to more than its size is worth.
    """
    size = check_file(path)
    try:
        file = pq.ParquetFile(path)
        names = file.schema_arrow.names
    except (pa.ArrowException, *_DAMAGE) as e:
        raise LogError(f"{path}: is not a Parquet file ({str(e)[:160]})") from None
    most = _MOST_ROWS[0] + _MOST_ROWS[1] * size
    if file.metadata.num_rows > most:
        raise LogError(
            f"{path}: {size:,} bytes say that they hold {file.metadata.num_rows:,} rows; allowed: up to {most:,}"
        )
    unpacked = sum(file.metadata.row_group(g).total_byte_size for g in range(file.metadata.num_row_groups))
    most = _MOST_UNPACKED[0] * len(names) * (file.metadata.num_rows + 100_000) + _MOST_UNPACKED[1] * size
    if unpacked > most:
        raise LogError(f"{path}: {size:,} bytes say that they unpack to {unpacked:,}; allowed: up to {most:,}")
    return file


def open_parquet(path: Path, options: Options) -> Source:
    """Parquet with numeric columns; null = no sample there."""
    damage = pa.ArrowException, *_DAMAGE
    file = whole_parquet(path)
    schema = file.schema_arrow
    if again := second(schema.names):
        raise LogError(f"{path}: column {again!r} is there more than once")
    dates_of = [name for name, kind in zip(schema.names, schema.types, strict=True) if pa.types.is_timestamp(kind)]
    time = time_column(path, list(schema.names), options, dates_of)

    def load(key: str) -> np.ndarray:
        kind = schema.field(key).type
        kind = kind.value_type if pa.types.is_dictionary(kind) else kind
        scale = 1.0
        dates = key == time.name and (pa.types.is_string(kind) or pa.types.is_large_string(kind))
        if pa.types.is_timestamp(kind) or pa.types.is_duration(kind):
            scale = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}[kind.unit]
        elif not (
            dates
            or pa.types.is_integer(kind)
            or pa.types.is_floating(kind)
            or pa.types.is_decimal(kind)
            or pa.types.is_boolean(kind)
        ):
            raise LogError(f"{path}: column {key!r} holds {kind}, not numbers")
        try:
            column = file.read(columns=[key], use_threads=False).column(key).combine_chunks().cast(kind)
            column.validate(full=True)
            if dates:
                found = from_dates(column.cast(pa.string()))
                if isinstance(found, OddRow):
                    raise LogError(f"{path}: column {key!r}, row {found.row + 1}: {found.why}")
                if found is None:
                    raise LogError(f"{path}: column {key!r} holds words that are no dates, not numbers")
                table.notes += date_notes(found, 1)
                return found.t
            if pa.types.is_timestamp(kind) or pa.types.is_duration(kind):
                column = column.cast(pa.int64())
            if pa.types.is_boolean(kind):
                column = column.cast(pa.int8())
            return numbers(column.cast(pa.float64(), safe=False), scale)
        except LogError:
            raise
        except damage as e:
            raise LogError(f"{path}: column {key!r} cannot be read ({str(e)[:160]})") from None

    table = Table(list(schema.names), load, 1, time, {}, framed=set(FRAME_COLUMNS) <= set(schema.names))
    return table


def said_by_parquet(path: Path) -> dict[str, str]:
    """What the metadata say of ``engine`` and ``time``; nothing where they cannot be read."""
    try:
        said = pq.read_metadata(path).metadata or {}
    except (OSError, pa.ArrowException):
        return {}
    return {n: said[n.encode()].decode("utf-8", "replace") for n in ("engine", "time") if n.encode() in said}


def write_parquet(path: Path, channels: dict[str, Channel], dbc: Path | None) -> None:
    """Write a Parquet file: t, then a column a channel on all times of all; null where a channel has no sample."""
    table = arrow_table(channels)
    with whole(path, LogError) as part:
        pq.write_table(table, part, compression="zstd")
