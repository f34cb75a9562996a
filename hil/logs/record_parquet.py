"""Parquet as a format of a recording: a row group and a footer with all row groups so far behind the footer before
(readers take the last one).

Row groups are merged five by five, so that footers stay small; at the end the file is written anew without what became
obsolete.
"""

from __future__ import annotations

import contextlib
import io
import os
from array import array
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from hil.bus.frames import NOTE
from hil.logs.dbc import load_dbc
from hil.logs.frames import Frames
from hil.logs.parquet_format import FRAME_COLUMNS, whole_parquet
from hil.logs.record_formats import ERROR, EXTENDED, FD, FRAME, NOTE_KIND, REMOTE, append_whole
from hil.logs.signals import cut_signal, select
from hil.logs.source import LogError
from vaneloop.base.errors import InputError
from vaneloop.base.files import whole
from vaneloop.base.signals import UNITS
from vaneloop.base.tables import path as table_path

__all__ = ["ParquetRecord", "read_parquet"]


class _Group(NamedTuple):
    """A row group in the file: times merged, its rows (None where it will not be merged again), their number, its part
    of the footer.
    """

    level: int
    rows: Any
    number: int
    footer: bytes


class ParquetRecord:
    """A row a frame: time, identifier, kind, direction, length, bytes; and the signals of `vgv.dbc` in columns that are
    null elsewhere.

    So it is a log for every command as it stands, and still holds each frame. ``t`` counts from the first frame,
    ``time`` from 1970.
    """

    MERGE, TOP = (
        5,
        4,
    )  # row groups merged into one; times that a row is merged: its group then holds 5**4 appends, about 5 minutes
    MOST = 50_000  # rows of a group that is merged further, so that no merge takes longer than an append may

    def __init__(self, path: Path, channel: str):
        self.path = path
        self.messages = [
            m for m in load_dbc(table_path("vgv.dbc"))[0] if any(s.name in UNITS for s in m.layout.signals)
        ]
        self.signals = [s.name for m in self.messages for s in m.layout.signals if s.name in UNITS]
        self.schema = pa.schema([
            ("t", pa.float64()), ("time", pa.timestamp("ns", "UTC")), ("id", pa.uint32()), ("extended", pa.bool_()),
            ("kind", pa.string()),
            ("tx", pa.bool_()), ("length", pa.uint8()), ("bytes", pa.binary()),
            *((s, pa.float64()) for s in self.signals),
        ])  # fmt: skip
        self.fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0o666)
        self.start: int | None = None
        self.groups: list[_Group] = []
        all_kinds = np.zeros(
            len(self.messages), FRAME
        )  # loads, and on a new machine compiles, what an append needs before frames come
        all_kinds["ident"], all_kinds["length"] = [m.ident for m in self.messages], 8
        self._write([], self._rows(np.frombuffer(all_kinds.tobytes(), FRAME)).slice(0, 0), 0)

    def append(self, frames: np.ndarray) -> None:
        if self.start is None:
            self.start = int(frames["ns"][0])
        rows, level, keep, others = self._rows(frames), 0, list(self.groups), self.MERGE - 1
        while (
            level < self.TOP
            and len(keep) >= others
            and all(g.level == level and g.rows is not None for g in keep[-others:])
        ):
            rows = pa.concat_tables([*(g.rows for g in keep[-others:]), rows])
            del keep[-others:]
            level += 1
        self._write(keep, rows, level)

    def _rows(self, frames: np.ndarray) -> Any:
        ident, n = frames["ident"], len(frames)
        error, remote, fd = ident & ERROR != 0, ident & REMOTE != 0, frames["flags"] & FD != 0
        note = frames["note"] != 0
        ours = np.where(error | remote | fd | note, np.uint32(ERROR), ident)
        plain = Frames(
            np.zeros(n), ours, np.zeros(n, np.int32), frames["length"], np.ascontiguousarray(frames["data"][:, :8])
        )
        columns: dict[str, Any] = {
            "t": (frames["ns"] - (self.start or 0)) * 1e-9,
            "time": pa.array(frames["ns"]).cast(pa.timestamp("ns", "UTC")),
            "id": ident & 0x1FFFFFFF, "extended": ident & EXTENDED != 0,
            "kind": np.select([note, error, remote, fd], [NOTE_KIND, "error", "remote", "fd"], "data"),
            "tx": frames["tx"] != 0, "length": frames["length"],
            "bytes": [d[:k].tobytes() for d, k in zip(frames["data"], frames["length"].tolist(), strict=True)],
        }  # fmt: skip
        for message in self.messages:
            rows, _ = select(plain, message)
            for signal in message.layout.signals:
                if signal.name in self.signals:
                    there, values, _ = cut_signal(plain, rows, message, signal)
                    column, absent = np.zeros(n), np.ones(n, bool)
                    column[there], absent[there] = values, False
                    columns[signal.name] = pa.array(column, mask=absent)
        return pa.table(columns, schema=self.schema)

    def _write(self, keep: list[_Group], rows: Any, level: int) -> None:
        """Append a row group and the footer of what is kept and it, in one write."""
        end, part = os.lseek(self.fd, 0, os.SEEK_END), io.BytesIO()
        pq.write_table(
            rows, part, row_group_size=max(len(rows), 1), compression="zstd", write_statistics=False, store_schema=False
        )
        raw = part.getvalue()
        size = int.from_bytes(raw[-8:-4], "little")
        footer, _ = _thrift_read(raw, len(raw) - 8 - size)
        groups = [_thrift_write(_moved(g, end)) for g in footer[_GROUPS][1][1]]
        footer[_ROWS] = (_I64, sum(g.number for g in keep) + len(rows))
        footer[_GROUPS] = (_LIST, (_STRUCT, [*(g.footer for g in keep), *groups]))
        tail = _thrift_write(footer)
        append_whole(self.fd, raw[: -8 - size] + tail + len(tail).to_bytes(4, "little") + b"PAR1")
        if len(rows):
            self.groups = [
                *keep,
                _Group(level, rows if level < self.TOP and len(rows) <= self.MOST else None, len(rows), groups[0]),
            ]

    def close(self) -> None:
        """Write the file anew without obsolete row groups and footers, and put it in place of the grown one."""
        os.close(self.fd)
        with (
            contextlib.suppress(InputError),  # no room for a second copy: the grown file is whole
            whole(self.path) as new,
            pq.ParquetWriter(new, self.schema, compression="zstd") as writer,
        ):
            for batch in pq.ParquetFile(self.path).iter_batches(200_000):
                writer.write_batch(batch)


_BATCH = 1 << 16  # frames


def read_parquet(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time (us since 1970), both words (`hil.bus.frames`) and direction of each frame of a recording."""
    names = list(FRAME_COLUMNS)
    file = whole_parquet(path)
    held = file.schema_arrow.names
    if missing := [n for n in names if n not in held]:
        raise LogError(f"{path}: no column {missing[0]!r}: holds signals, not frames")
    flags = {"data": 0, "fd": FD << 40, "remote": REMOTE, "error": ERROR, NOTE_KIND: NOTE}
    found = array("q")
    for batch in file.iter_batches(_BATCH, columns=names):  # as Python's numbers, of which each takes 50 bytes
        t = batch.to_pydict()
        us = batch.column("time").cast("int64").to_numpy() // 1000
        rows = zip(us.tolist(), t["id"], t["extended"], t["kind"], t["tx"], t["length"], t["bytes"], strict=True)
        for at, ident, extended, kind, tx, length, data in rows:
            head = ident | (EXTENDED if extended and kind != "error" else 0) | flags[kind] | length << 32
            found.extend((at, head, int.from_bytes(data[:8].ljust(8, b"\0"), "little", signed=True), bool(tx)))
    out = np.array(found, np.int64).reshape(-1, 4)
    return out[:, 0], out[:, 1:3], out[:, 3] != 0


# --- the footer -------------------------------------------------------------------------------------------------------

# The footer is a thrift structure in the compact protocol. pyarrow writes a row group only at the beginning of a file;
# where it is appended to one, the addresses in it move.
_I64, _LIST, _STRUCT = 6, 9, 12
_ROWS, _GROUPS = 3, 4  # of the footer: number of rows, row groups
_ThriftStruct = dict[
    int, tuple[int, Any]
]  # field -> type, value; a list: type and elements, structures that are written already as bytes


def _moved(group: _ThriftStruct, by: int) -> _ThriftStruct:
    """Return a row group whose addresses count from ``by`` bytes earlier."""

    def move(struct: _ThriftStruct, *fields: int) -> None:
        for f in fields:
            if f in struct and struct[f][1] > 0:
                struct[f] = (_I64, struct[f][1] + by)

    move(group, 5)  # file_offset
    for column in group[1][1][1]:
        move(column, 2)  # file_offset
        move(column[3][1], 9, 10, 11)  # data, index and dictionary page
    return group


def _varint(raw: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = raw[at]
        value |= (byte & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if byte < 0x80:
            return value, at


def _thrift_value(raw: bytes, at: int, kind: int) -> tuple[Any, int]:
    if kind in (1, 2, 3):  # in a list, true and false are bytes too
        return raw[at], at + 1
    if kind in (4, 5, _I64):
        value, at = _varint(raw, at)
        return (value >> 1) ^ -(value & 1), at
    if kind == 7:
        return raw[at : at + 8], at + 8
    if kind == 8:
        size, at = _varint(raw, at)
        return raw[at : at + size], at + size
    if kind in (_LIST, 10):
        size, of = raw[at] >> 4, raw[at] & 15
        at += 1
        if size == 15:
            size, at = _varint(raw, at)
        items = []
        for _ in range(size):
            item, at = _thrift_value(raw, at, of)
            items.append(item)
        return (of, items), at
    if kind == _STRUCT:
        return _thrift_read(raw, at)
    raise ValueError(f"thrift type {kind} does not occur in a Parquet footer")


def _thrift_read(raw: bytes, at: int) -> tuple[_ThriftStruct, int]:
    """Return the structure at ``at`` and the place behind it."""
    out: _ThriftStruct = {}
    field = 0
    while raw[at]:
        step, kind = raw[at] >> 4, raw[at] & 15
        at += 1
        if step:
            field += step
        else:
            value, at = _varint(raw, at)
            field = (value >> 1) ^ -(value & 1)
        if kind in (1, 2):
            out[field] = (kind, None)
        else:
            value, at = _thrift_value(raw, at, kind)
            out[field] = (kind, value)
    return out, at + 1


def _number(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def _zigzag(value: int) -> bytes:
    return _number(value << 1 if value >= 0 else -value * 2 - 1)


def _thrift_bytes(kind: int, value: Any) -> bytes:
    if kind in (1, 2, 3):
        return bytes([value])
    if kind in (4, 5, _I64):
        return _zigzag(value)
    if kind == 8:
        return _number(len(value)) + value
    if kind in (_LIST, 10):
        of, items = value
        head = bytes([len(items) << 4 | of]) if len(items) < 15 else bytes([0xF0 | of]) + _number(len(items))
        return head + b"".join(i if isinstance(i, bytes) and of == _STRUCT else _thrift_bytes(of, i) for i in items)
    return value if kind == 7 else _thrift_write(value)


def _thrift_write(struct: _ThriftStruct) -> bytes:
    out, before = bytearray(), 0
    for field, (kind, value) in sorted(struct.items()):
        step = field - before
        out += bytes([step << 4 | kind]) if 1 <= step <= 15 else bytes([kind]) + _zigzag(field)
        if kind not in (1, 2):
            out += _thrift_bytes(kind, value)
        before = field
    return bytes(out) + b"\0"
