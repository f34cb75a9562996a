"""Frames to a file that opens whenever the recording stops, also by ``kill -9``: candump, BLF, MDF4 or Parquet, by
suffix.

Twice a second what has come in is appended, each format in its own way such that the file is whole again afterwards:

==========
============================================================================================================================
candump    lines, written whole, with the direction behind each frame as ``candump -x`` has it
BLF        a container; the file is closed and opened again with python-can's writer, so that its header counts what is
           there
MDF4       a compressed data block behind the file's end, then its address into the list of blocks, then the number of
           records: two writes of eight bytes, so that a reader meets the state before or after
Parquet    a row group and a footer with all row groups so far behind the footer before (readers take the last one); row
           groups are merged ten by ten, so that footers stay small; at the end the file is written anew without what
           became obsolete
==========
============================================================================================================================

A killed process loses nothing that it has handed to the kernel, so at most half a second is lost; a machine that loses
its power may lose what the kernel has not yet written to the disk.

`Recorder` writes in the process that calls it. `RecorderProcess` gives frames to a process of its own through a pipe,
for a loop that must not wait for a disk; it ends the file properly even where the loop's process is killed.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import select
import struct
import subprocess
import sys
import time
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np

from hil.logs import canlog
from vaneloop.base.errors import InputError
from vaneloop.base.tables import path as table_path

if TYPE_CHECKING:
    import can

__all__ = [
    "FLUSH", "FRAME", "SUFFIXES", "Record", "Recorder", "RecorderProcess", "check_name", "free_name", "packed_message",
    "read_record",
]  # fmt: skip

FLUSH = 0.5  # s between two appends; at most this much is lost
EXTENDED, REMOTE, ERROR = 1 << 31, 1 << 30, 1 << 29  # in `ident`, as SocketCAN has them

# a frame on its way to the file: time since 1970, then struct canfd_frame, with the direction in one of its unused
# bytes
FRAME = np.dtype(
    [
        ("ns", "<i8"),
        ("ident", "<u4"),
        ("length", "u1"),
        ("flags", "u1"),
        ("tx", "u1"),
        ("unused", "u1"),
        ("data", "u1", (64,)),
    ]
)
_FRAME = struct.Struct("<qIBBBx64s")
_WHOLE = select.PIPE_BUF // FRAME.itemsize * FRAME.itemsize  # bytes that a pipe takes whole or not at all
FD = 4  # in `flags`; 1 is the bit-rate switch, 2 the error state, as SocketCAN has them


class _Format(Protocol):
    """A file that can be appended to and is whole after every append."""

    def append(self, frames: np.ndarray) -> None:
        """Add frames (FRAME)."""

    def close(self) -> None:
        """End the file."""


# ---- candump ---------------------------------------------------------------------------------------------------------


class _Candump:
    def __init__(self, path: Path, channel: str):
        self.fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND, 0o666)
        self.channel = (
            re.sub(r"\W", "-", channel)[:15] or "can0"
        )  # a name of a network interface has 15 characters at most

    def append(self, frames: np.ndarray) -> None:
        text, lines = frames["data"].tobytes().hex().upper(), []
        columns = (frames["ns"] // 1000, frames["ident"], frames["length"], frames["flags"], frames["tx"])
        for k, (us, ident, n, flags, tx) in enumerate(zip(*(c.tolist() for c in columns), strict=True)):
            name = (
                f"{ident & 0x1FFFFFFF:08X}"
                if ident & EXTENDED
                else f"{ident:08X}"
                if ident & ERROR
                else f"{ident & 0x7FF:03X}"
            )
            data = f"R{n or ''}" if ident & REMOTE else text[128 * k : 128 * k + 2 * n]
            if flags & FD:
                data = f"#{flags & 3:X}{data}"
            lines.append(
                f"({us // 1_000_000:010d}.{us % 1_000_000:06d}) {self.channel} {name}#{data} {'T' if tx else 'R'}\n"
            )
        _append(self.fd, "".join(lines).encode("ascii"))

    def close(self) -> None:
        os.close(self.fd)


def _append(fd: int, data: bytes) -> None:
    """Write all of ``data`` at the file's end or, where the disk refuses, nothing of it."""
    end = os.lseek(fd, 0, os.SEEK_END)
    try:
        view = memoryview(data)
        while view:
            view = view[os.write(fd, view) :]
    except OSError:
        os.ftruncate(fd, end)
        raise


# ---- BLF -------------------------------------------------------------------------------------------------------------


class _Blf:
    def __init__(self, path: Path, channel: str):
        import can

        self.path, self.writer = path, can.BLFWriter
        with self.writer(str(path)):
            pass

    def append(self, frames: np.ndarray) -> None:
        # the writer appends and updates the header in a copy in memory, which then goes to the file at once: first the
        # end, then the header
        with self.path.open("r+b") as file:
            head, end = file.read(144), file.seek(0, io.SEEK_END)
            part = _Tail(head, end)
            writer = self.writer(part, append=True)  # type: ignore[arg-type]
            if writer.object_count == 0:
                writer.start_timestamp = None
            for message in messages(frames):
                writer.on_message_received(message)
            writer.stop()
            _append(file.fileno(), part.tail)
            os.pwrite(file.fileno(), part.head, 0)

    def close(self) -> None:
        pass


class _Tail(io.RawIOBase):
    """What a writer that appends sees of a long file: its header and its end. ``tail`` is what it added."""

    def __init__(self, head: bytes, end: int):
        self.head, self.tail, self.start, self.at = head, b"", end, 0

    def readable(self) -> bool:
        return True

    def writable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def read(self, size: int = -1) -> bytes:
        data = self.head[self.at :] if size < 0 else self.head[self.at : self.at + size]
        self.at += len(data)
        return data

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        self.at = offset + (
            self.start + len(self.tail) if whence == io.SEEK_END else self.at if whence == io.SEEK_CUR else 0
        )
        return self.at

    def tell(self) -> int:
        return self.at

    def write(self, data: Any) -> int:
        data = bytes(data)
        if self.at < len(self.head):
            self.head = self.head[: self.at] + data + self.head[self.at + len(data) :]
        else:
            k = self.at - self.start
            self.tail = self.tail[:k] + data + self.tail[k + len(data) :]
        self.at += len(data)
        return len(data)

    def close(self) -> None:
        """Stay readable for the owner."""


def messages(frames: np.ndarray) -> Any:
    """Give frames as python-can messages."""
    import can

    columns = (frames["ns"] * 1e-9, frames["ident"], frames["length"], frames["flags"], frames["tx"])
    data = frames["data"].tobytes()
    for k, (t, ident, n, flags, tx) in enumerate(zip(*(c.tolist() for c in columns), strict=True)):
        yield can.Message(
            timestamp=t, arbitration_id=ident & 0x1FFFFFFF, is_extended_id=bool(ident & EXTENDED),
            is_remote_frame=bool(ident & REMOTE),
            is_error_frame=bool(ident & ERROR), channel=0, dlc=n,
            data=None if ident & REMOTE else data[64 * k : 64 * k + n], is_rx=not tx,
            is_fd=bool(flags & FD), bitrate_switch=bool(flags & 1), error_state_indicator=bool(flags & 2),
        )  # fmt: skip


# ---- MDF4 ------------------------------------------------------------------------------------------------------------

_COLUMNS = [("BusChannel", "u1"), ("ID", "<u4"), ("IDE", "u1"), ("DLC", "u1"), ("DataLength", "u1"),
    ("DataBytes", "u1", (64,)),
            ("Dir", "u1"), ("EDL", "u1"), ("BRS", "u1"), ("ESI", "u1")]  # fmt: skip
_START_TIME = 64 + 24 + 48  # in the file: identification block, head and links of the header block


class _Mdf:
    """Bus logging as ASAM lays it out: a group each of data, error and remote frames. asammdf makes the empty file,
    blocks are added here.

    Data group -> header list (HL) -> one list block (DL) an append -> one compressed data block (DZ) each.
    """

    KINDS = ("CAN_DataFrame", "CAN_ErrorFrame", "CAN_RemoteFrame")

    def __init__(self, path: Path, channel: str):
        import asammdf
        from asammdf.blocks.v4_blocks import SourceInformation
        from asammdf.blocks.v4_constants import BUS_TYPE_CAN, SOURCE_BUS

        self.kinds = [np.dtype([("t", "<f8"), *((f"{kind}.{c[0]}", *c[1:]) for c in _COLUMNS)]) for kind in self.KINDS]
        with asammdf.MDF(version="4.10") as mdf:
            for kind, dtype in zip(self.KINDS, self.kinds, strict=True):
                rest = np.empty(
                    0, np.dtype([(n, dtype[n].base, dtype[n].shape) for n in dtype.names or () if n != "t"])
                )
                source = SourceInformation(source_type=SOURCE_BUS, bus_type=BUS_TYPE_CAN)
                mdf.append(
                    asammdf.Signal(rest, np.empty(0), name=kind, source=source),
                    comment="VaneLoop",
                    common_timebase=True,
                )
            mdf.save(path, overwrite=True)
        with asammdf.MDF(path) as mdf:
            self.groups = [
                (g.data_group.address + 40, g.channel_group.address + 80) for g in mdf.groups
            ]  # address of the data, records
            sizes = [g.channel_group.samples_byte_nr for g in mdf.groups]
        if sizes != [k.itemsize for k in self.kinds]:
            raise RuntimeError(f"asammdf lays records out in {sizes} bytes, not {[k.itemsize for k in self.kinds]}")
        self.fd = os.open(path, os.O_RDWR)
        self.start = 0
        self.lists: list[int] = [0, 0, 0]  # address of the last list block's link to the next
        self.records = [0, 0, 0]
        self.bytes = [0, 0, 0]

    def append(self, frames: np.ndarray) -> None:
        if not self.start:
            self.start = int(frames["ns"][0])
            os.pwrite(self.fd, struct.pack("<QhhB", self.start, 0, 0, 2), _START_TIME)  # UTC
        ident = frames["ident"]
        error, remote = ident & ERROR != 0, ident & REMOTE != 0
        for k, these in enumerate((~error & ~remote, error, remote & ~error)):
            if these.any():
                self._add(k, self._records(k, frames[these]))

    def _records(self, k: int, frames: np.ndarray) -> np.ndarray:
        out, name = np.zeros(len(frames), self.kinds[k]), self.KINDS[k]
        length, flags = frames["length"], frames["flags"]
        values = {"BusChannel": 1, "ID": frames["ident"] & 0x1FFFFFFF, "IDE": frames["ident"] >> 31,
                  "DLC": np.searchsorted([*range(9), 12, 16, 20, 24, 32, 48, 64], length), "DataLength": length,
                  "DataBytes": frames["data"], "Dir": frames["tx"],
                  "EDL": flags & FD != 0, "BRS": flags & 1, "ESI": flags >> 1 & 1}  # fmt: skip
        out["t"] = (frames["ns"] - self.start) * 1e-9
        for key, v in values.items():
            out[f"{name}.{key}"] = v
        return out

    def _add(self, k: int, records: np.ndarray) -> None:
        at = os.lseek(self.fd, 0, os.SEEK_END)
        out = bytearray(-at % 8)
        at += len(out)
        first = self.lists[k] == 0
        if first:  # header list: link, flags, zip type
            header = at
            out += struct.pack("<4sIQQQHB5x", b"##HL", 0, 40, 1, at + 40, 0, 0)
            at += 40
        raw = records.tobytes()
        packed = zlib.compress(raw, 6)
        block = at + 56
        # list: next, data, flags, one block, its offset in the group's data
        out += struct.pack("<4sIQQQQB3xIQ", b"##DL", 0, 56, 2, 0, block, 0, 1, self.bytes[k])
        out += (
            struct.pack("<4sIQQ2sBxIQQ", b"##DZ", 0, 48 + len(packed), 0, b"DT", 0, 0, len(raw), len(packed)) + packed
        )
        out += bytes(-len(packed) % 8)
        _append(self.fd, bytes(out))
        data, count = self.groups[k]
        self.records[k] += len(records)
        self.bytes[k] += len(raw)
        os.pwrite(self.fd, struct.pack("<Q", header if first else at), data if first else self.lists[k])
        os.pwrite(self.fd, struct.pack("<Q", self.records[k]), count)
        self.lists[k] = at + 24

    def close(self) -> None:
        os.close(self.fd)


# ---- Parquet ---------------------------------------------------------------------------------------------------------


class _Group(NamedTuple):
    """A row group in the file: times merged, its rows (None where it will not be merged again), their number, its part
    of the footer.
    """

    level: int
    rows: Any
    number: int
    footer: bytes


class _Parquet:
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
        import pyarrow as pa

        from vaneloop.base.signals import UNITS

        self.path, self.messages = path, canlog.load_dbc(table_path("vgv.dbc"))[0]
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
        import pyarrow as pa

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
        import pyarrow as pa

        ident, n = frames["ident"], len(frames)
        error, remote, fd = ident & ERROR != 0, ident & REMOTE != 0, frames["flags"] & FD != 0
        ours = np.where(error | remote | fd, np.uint32(ERROR), ident)
        plain = canlog.Frames(
            np.zeros(n), ours, np.zeros(n, np.int32), frames["length"], np.ascontiguousarray(frames["data"][:, :8])
        )
        columns: dict[str, Any] = {
            "t": (frames["ns"] - (self.start or 0)) * 1e-9,
            "time": pa.array(frames["ns"]).cast(pa.timestamp("ns", "UTC")),
            "id": ident & 0x1FFFFFFF, "extended": ident & EXTENDED != 0,
            "kind": np.select([error, remote, fd], ["error", "remote", "fd"], "data"), "tx": frames["tx"] != 0,
            "length": frames["length"],
            "bytes": [d[:k].tobytes() for d, k in zip(frames["data"], frames["length"].tolist(), strict=True)],
        }  # fmt: skip
        for message in self.messages:
            rows, _ = canlog.select(plain, message)
            for signal in message.layout.signals:
                if signal.name in self.signals:
                    there, values, _ = canlog.cut_signal(plain, rows, message, signal)
                    column, absent = np.zeros(n), np.ones(n, bool)
                    column[there], absent[there] = values, False
                    columns[signal.name] = pa.array(column, mask=absent)
        return pa.table(columns, schema=self.schema)

    def _write(self, keep: list[_Group], rows: Any, level: int) -> None:
        """Append a row group and the footer of what is kept and it, in one write."""
        import pyarrow.parquet as pq

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
        _append(self.fd, raw[: -8 - size] + tail + len(tail).to_bytes(4, "little") + b"PAR1")
        if len(rows):
            self.groups = [
                *keep,
                _Group(level, rows if level < self.TOP and len(rows) <= self.MOST else None, len(rows), groups[0]),
            ]

    def close(self) -> None:
        """Write the file anew without obsolete row groups and footers, and put it in place of the grown one."""
        import pyarrow.parquet as pq

        os.close(self.fd)
        new = self.path.with_name(f".{self.path.name}.{os.getpid()}")
        try:
            file = pq.ParquetFile(self.path)
            with pq.ParquetWriter(new, self.schema, compression="zstd") as writer:
                for batch in file.iter_batches(200_000):
                    writer.write_batch(batch)
            os.replace(new, self.path)
        except OSError:  # no room for a second copy: the grown file is whole
            new.unlink(missing_ok=True)


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


SUFFIXES: dict[str, Callable[[Path, str], _Format]] = {
    ".log": _Candump,
    ".blf": _Blf,
    ".mf4": _Mdf,
    ".parquet": _Parquet,
}


# ---- a recording -----------------------------------------------------------------------------------------------------


class Recorder:
    """A recording into a file of this process: `put` frames as they come, `poll` now and then, `close` at the end.

    path     .log (candump), .blf, .mf4 or .parquet; a file that is there already is kept under another name
    channel  name of the bus, for candump
    """

    def __init__(self, path: str | Path, channel: str = "vcan0"):
        self.path = check_name(path)
        self.kept = _keep_old(self.path)
        try:
            self.file = SUFFIXES[self.path.suffix.lower()](self.path, channel)
        except OSError as e:
            raise InputError(f"{self.path}: cannot be written ({e.strerror or e})") from None
        self.frames = 0  # in the file
        self._waiting: list[bytes] = []
        self._next = time.monotonic() + FLUSH

    def put(self, frames: bytes) -> None:
        """Take frames (bytes of FRAME)."""
        if frames:
            self._waiting.append(frames)

    def poll(self) -> None:
        """Append what has come in, if it is time. Raises InputError where the file cannot be written: it then ends
        before these frames.
        """
        if time.monotonic() >= self._next:
            self.flush()

    def flush(self) -> None:
        """Append what has come in."""
        self._next = time.monotonic() + FLUSH
        if self._waiting:
            frames = np.frombuffer(b"".join(self._waiting), FRAME)
            self._waiting.clear()
            try:
                self.file.append(frames)
            except OSError as e:
                raise InputError(
                    f"{self.path}: cannot be written ({e.strerror or e}); it ends after {self.frames:,} frames"
                ) from None
            self.frames += len(frames)

    def close(self) -> None:
        """Append what has come in and end the file."""
        try:
            self.flush()
        finally:
            self.file.close()


def check_name(path: str | Path) -> Path:
    """Return the path of a recording if its name and folder allow one. Raises InputError."""
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        known = "candump (.log), BLF (.blf), MDF4 (.mf4) or Parquet (.parquet)"
        raise InputError(f"{path}: suffix {path.suffix!r} is not one of a recording; allowed: {known}")
    if path.is_dir() or not path.parent.is_dir():
        raise InputError(f"{path}: {'is a folder' if path.is_dir() else 'its folder does not exist'}")
    if not os.access(path if path.exists() else path.parent, os.W_OK):
        raise InputError(f"{path}: cannot be written (permission denied)")
    return path


def free_name(path: Path) -> Path:
    """Return the first of run.1.log, run.2.log, ... that is free."""
    n = 1
    while (other := path.with_name(f"{path.stem}.{n}{path.suffix}")).exists():
        n += 1
    return other


def _keep_old(path: Path) -> Path | None:
    """Move an earlier recording out of the way: what was recorded is not lost. Return its new name."""
    if not path.is_file() or path.stat().st_size == 0:
        return None
    other = free_name(path)
    path.rename(other)
    return other


@dataclass(frozen=True)
class Record:
    """Frames of a recording, in order: ms since 1970 (int64[n]), both words (int64[n, 2], `hil.bus.frames`), and
    whether it sent them.
    """

    ms: np.ndarray
    rows: np.ndarray
    sent: np.ndarray


def read_record(path: str | Path) -> Record:
    """Read what a `Recorder` wrote, or another program in a format that python-can reads. Raises LogError."""
    from hil.bus.frames import from_message

    path = Path(path)
    canlog.check_file(path)
    try:
        if path.suffix.lower() == ".parquet":
            us, rows, sent = _read_parquet(path)
        else:
            import can

            with can.LogReader(path) as reader:
                found = [(round(m.timestamp * 1e6), *from_message(m), not m.is_rx) for m in reader]
            us = np.array([f[0] for f in found], np.int64)
            rows = np.array([f[1:3] for f in found], np.int64).reshape(-1, 2)
            sent = np.array([f[3] for f in found], bool)
    except InputError:
        raise
    except Exception as e:  # readers meet a damaged file with any exception there is
        raise canlog.LogError(f"{path}: cannot be read as a recording of frames ({type(e).__name__}: {e})") from None
    if not len(us):
        raise canlog.LogError(f"{path}: no CAN frame in it")
    order = np.argsort(us, kind="stable")
    return Record(us[order] // 1000, rows[order], sent[order])


def _read_parquet(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    import pyarrow.parquet as pq

    names = ["time", "id", "extended", "kind", "tx", "length", "bytes"]
    held = pq.ParquetFile(path).schema_arrow.names
    if missing := [n for n in names if n not in held]:
        raise canlog.LogError(f"{path}: no column {missing[0]!r}: holds signals, not frames")
    t = pq.read_table(path, columns=names).to_pydict()
    us = pq.read_table(path, columns=["time"])["time"].cast("int64").to_numpy() // 1000
    flags = {"data": 0, "fd": FD << 40, "remote": REMOTE, "error": ERROR}
    rows = [
        (ident | (EXTENDED if extended and kind != "error" else 0) | flags[kind] | length << 32,
         int.from_bytes(data[:8].ljust(8, b"\0"), "little", signed=True))
        for ident, extended, kind, length,
            data in zip(t["id"], t["extended"], t["kind"], t["length"], t["bytes"], strict=True)
    ]  # fmt: skip
    return us, np.array(rows, np.int64).reshape(-1, 2), np.array(t["tx"], bool)


def packed_message(message: can.Message) -> bytes:
    """Return a python-can message as the recorder takes it (FRAME)."""
    ident = (
        message.arbitration_id
        | (EXTENDED if message.is_extended_id else 0)
        | (REMOTE if message.is_remote_frame else 0)
    )
    if message.is_error_frame:
        ident = message.arbitration_id | ERROR
    flags = (
        (FD if message.is_fd else 0)
        | (1 if message.bitrate_switch else 0)
        | (2 if message.error_state_indicator else 0)
    )
    length = message.dlc if message.is_remote_frame else len(message.data)
    return _FRAME.pack(
        round(message.timestamp * 1e6) * 1000, ident, length, flags, not message.is_rx, bytes(message.data)
    )


class RecorderProcess:
    """A recording in a process of its own. `put` is one write into a pipe that holds half a minute of frames; it never
    waits.

    Frames that do not fit, because the disk stands still, are counted in ``lost``. Raises InputError for what
    `Recorder` refuses.
    """

    def __init__(self, path: str | Path, channel: str = "vcan0"):
        self.path, self.lost, self.frames, self.error = check_name(path), 0, 0, ""
        command = [sys.executable, "-m", "hil.logs.recorder", str(self.path), channel]
        # in a session of its own: Ctrl-C at the terminal is for the loop, which then ends the recording
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True)
        assert self._process.stdin is not None
        self._pipe = self._process.stdin.fileno()
        _enlarge(self._pipe)
        ready = self._answer()
        if not ready.startswith("ready"):
            raise InputError(ready.partition(" ")[2] or f"{self.path}: the recorder did not start")
        self.kept = ready.partition(" ")[2]
        os.set_blocking(self._pipe, False)

    def _answer(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline().decode().strip()

    def put(self, frames: bytes) -> None:
        """Take frames (bytes of FRAME)."""
        for at in range(0, len(frames), _WHOLE):
            part = frames[at : at + _WHOLE]
            try:
                os.write(self._pipe, part)
            except (BlockingIOError, BrokenPipeError):
                self.lost += len(part) // FRAME.itemsize

    def close(self) -> None:
        """End the recording and wait until the file is whole. ``frames`` then says how many are in it, ``error`` what
        went wrong.
        """
        assert self._process.stdin is not None
        self._process.stdin.close()
        word, _, rest = self._answer().partition(" ")
        self._process.wait()
        if word == "frames":
            self.frames, self.error = int(rest), ""
        else:
            self.error = rest or "the recorder was killed"


def _enlarge(pipe: int, size: int = 1 << 20) -> None:
    import fcntl

    with contextlib.suppress(OSError):  # an unprivileged user may be allowed less: 64 KiB are two seconds
        fcntl.fcntl(pipe, fcntl.F_SETPIPE_SZ, size)


def serve(path: str, channel: str) -> int:
    """Record what comes through standard input until it ends, and say on standard output how that went."""
    import signal

    for number in (
        signal.SIGINT,
        signal.SIGTERM,
        signal.SIGHUP,
    ):  # the loop's process ends the recording by closing the pipe
        signal.signal(number, signal.SIG_IGN)

    def say(text: str) -> None:
        with contextlib.suppress(OSError):  # nobody may be there any more
            os.write(1, (text + "\n").encode())

    try:
        recorder = Recorder(path, channel)
        say(f"ready {recorder.kept or ''}")
        rest, size = b"", FRAME.itemsize
        while True:
            if select.select([0], [], [], FLUSH / 2)[0]:
                data = os.read(0, 1 << 20)
                if not data:
                    break
                rest += data
                whole = len(rest) - len(rest) % size
                if whole:
                    recorder.put(rest[:whole])
                    rest = rest[whole:]
            recorder.poll()
        recorder.close()
    except InputError as e:
        say(f"error {e}")
        return 2
    say(f"frames {recorder.frames}")
    return 0


if __name__ == "__main__":
    from vaneloop.base import terminal

    sys.exit(terminal.run(lambda: serve(*sys.argv[1:])))
