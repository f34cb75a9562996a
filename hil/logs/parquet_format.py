"""Parquet, read and written through pyarrow."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from hil.logs.source import Channel, LogError, Options, Source, check_file, numbers
from hil.logs.table import Table, arrow_table, time_column
from hil.logs.times import from_dates

__all__ = ["FRAME_COLUMNS", "open_parquet", "write_parquet"]

FRAME_COLUMNS = ("time", "id", "extended", "kind", "tx", "length", "bytes")  # of a table that has a row a frame

_MOST_ROWS = (
    4_000_000,
    2,
)  # of a Parquet file, and more for each of its bytes; a column that never changes takes next to none
_MOST_UNPACKED = 40  # bytes a row of a column of numbers


def _chunks(group: Any) -> Iterable[Any]:
    return (group.column(k) for k in range(group.num_columns))


def open_parquet(path: Path, options: Options) -> Source:
    """Parquet with numeric columns; null = no sample there."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    size = check_file(path)
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

    time = time_column(path, list(schema.names), options)

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
            chunks = [
                c
                for g in range(file.metadata.num_row_groups)
                for c in _chunks(file.metadata.row_group(g))
                if c.path_in_schema == key
            ]
        except damage as e:  # a name that is no text
            raise LogError(f"{path}: column {key!r} cannot be read ({str(e)[:160]})") from None
        unpacked, most = (
            sum(c.total_uncompressed_size for c in chunks),
            _MOST_UNPACKED * (file.metadata.num_rows + 100_000),
        )
        if unpacked > most:
            raise LogError(f"{path}: column {key!r} unpacks to {unpacked:,} bytes; allowed: up to {most:,}")
        try:
            column = file.read(columns=[key], use_threads=False).column(key).combine_chunks().cast(kind)
            column.validate(full=True)
            if dates:
                found = from_dates(column.cast(pa.string()))
                if found is None:
                    raise LogError(f"{path}: column {key!r} holds words that are no dates, not numbers")
                table.notes.append(found[1])
                return found[0]
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


def write_parquet(path: Path, channels: dict[str, Channel], dbc: Path | None) -> None:
    """Write a Parquet file: t, then a column a channel on all times of all; null where a channel has no sample."""
    import pyarrow.parquet as pq

    pq.write_table(arrow_table(channels), path, compression="zstd")
