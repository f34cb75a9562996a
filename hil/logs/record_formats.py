"""Formats of a recording: files that frames are appended to and that are whole after every append.

candump    lines, written whole, with the direction behind each frame as ``candump -x`` has it
BLF        a container; the file is closed and opened again with python-can's writer, so that its header counts what is
           there
MDF4       a compressed data block behind the file's end, then its address into the list of blocks, then the number of
           records: two writes of eight bytes, so that a reader meets the state before or after
Parquet    `hil.logs.record_parquet`

A note of the loop is in each of them a frame on a channel of its own.
"""

from __future__ import annotations

import io
import logging
import os
import re
import struct
import zlib
from array import array
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

if TYPE_CHECKING:
    import can

__all__ = [
    "ERROR",
    "EXTENDED",
    "FD",
    "FRAME",
    "NOTE_CHANNEL",
    "NOTE_KIND",
    "NOTE_NAME",
    "REMOTE",
    "BlfRecord",
    "CandumpRecord",
    "FramesOfRecord",
    "MdfRecord",
    "RecordFormat",
    "append_whole",
    "frames_of",
    "messages",
    "packed_message",
]  # fmt: skip

EXTENDED, REMOTE, ERROR = 1 << 31, 1 << 30, 1 << 29  # in `ident`, as SocketCAN has them
# a frame on its way to the file: time since 1970, then struct canfd_frame, with the direction in one of its unused
# bytes, and in another whether it is no frame of the bus but a note of the loop (`hil.bus.frames.NOTE`)
FRAME = np.dtype(
    [
        ("ns", "<i8"),
        ("ident", "<u4"),
        ("length", "u1"),
        ("flags", "u1"),
        ("tx", "u1"),
        ("note", "u1"),
        ("data", "u1", (64,)),
    ]
)
_FRAME = struct.Struct("<qIBBBx64s")
FD = 4  # in `flags`; 1 is the bit-rate switch, 2 the error state, as SocketCAN has them
# The channel of notes. A bus cannot have it: `CandumpRecord` gives no bus a name with a dot, a recording has one bus,
# number 0 in BLF and 1 in MDF4. In Parquet a note has a kind of its own, NOTE_KIND.
NOTE_NAME, NOTE_CHANNEL, NOTE_KIND = "vaneloop.note", 254, "note"


# frames of a recording: us since 1970 (int64[n]), both words (int64[n, 2], `hil.bus.frames`), whether it sent them
FramesOfRecord = tuple[np.ndarray, np.ndarray, np.ndarray]


class RecordFormat(Protocol):
    """A file that can be appended to and is whole after every append."""

    def append(self, frames: np.ndarray) -> None:
        """Add frames (FRAME)."""

    def close(self) -> None:
        """End the file."""


def frames_of(messages: Iterable[Any], notes: str | int) -> FramesOfRecord:
    """Frames that a reader of python-can gives, 32 bytes each; it logs a line for each that it cannot read. Those on
    the channel ``notes`` are the loop's own notes (`hil.bus.frames.NOTE`).
    """
    from hil.bus.frames import NOTE, from_message

    found, can = array("q"), logging.getLogger("can")
    level = can.level
    can.setLevel(logging.CRITICAL)
    try:
        for m in messages:
            head, data = from_message(m)
            found.extend((round(m.timestamp * 1e6), head | NOTE * (m.channel == notes), data, not m.is_rx))
    finally:
        can.setLevel(level)
    table = np.array(found, np.int64).reshape(-1, 4)
    return table[:, 0], table[:, 1:3], table[:, 3] != 0


def append_whole(fd: int, data: bytes) -> None:
    """Write all of ``data`` at the file's end or, where the disk refuses, nothing of it."""
    end = os.lseek(fd, 0, os.SEEK_END)
    try:
        view = memoryview(data)
        while view:
            view = view[os.write(fd, view) :]
    except OSError:
        os.ftruncate(fd, end)
        raise


def messages(frames: np.ndarray) -> Any:
    """Give frames as python-can messages."""
    import can

    columns = (frames["ns"] * 1e-9, *(frames[c] for c in ("ident", "length", "flags", "tx", "note")))
    data = frames["data"].tobytes()
    for k, (t, ident, n, flags, tx, note) in enumerate(zip(*(c.tolist() for c in columns), strict=True)):
        yield can.Message(
            timestamp=t, arbitration_id=ident & 0x1FFFFFFF, is_extended_id=bool(ident & EXTENDED),
            is_remote_frame=bool(ident & REMOTE),
            is_error_frame=bool(ident & ERROR), channel=NOTE_CHANNEL if note else 0, dlc=n,
            data=None if ident & REMOTE else data[64 * k : 64 * k + n], is_rx=not tx,
            is_fd=bool(flags & FD), bitrate_switch=bool(flags & 1), error_state_indicator=bool(flags & 2),
        )  # fmt: skip


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


# --- candump ----------------------------------------------------------------------------------------------------------


class CandumpRecord:
    """Lines of a `candump -x -L`, one a frame."""

    def __init__(self, path: Path, channel: str):
        self.fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND, 0o666)
        self.channel = (
            re.sub(r"\W", "-", channel)[:15] or "can0"
        )  # a name of a network interface has 15 characters at most

    def append(self, frames: np.ndarray) -> None:
        text, lines = frames["data"].tobytes().hex().upper(), []
        columns = (frames["ns"] // 1000, *(frames[c] for c in ("ident", "length", "flags", "tx", "note")))
        for k, (us, ident, n, flags, tx, note) in enumerate(zip(*(c.tolist() for c in columns), strict=True)):
            channel = NOTE_NAME if note else self.channel
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
                f"({us // 1_000_000:010d}.{us % 1_000_000:06d}) {channel} {name}#{data} {'T' if tx else 'R'}\n"
            )
        append_whole(self.fd, "".join(lines).encode("ascii"))

    def close(self) -> None:
        os.close(self.fd)


# --- BLF --------------------------------------------------------------------------------------------------------------


class BlfRecord:
    """A container an append, made by python-can's writer."""

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
            append_whole(file.fileno(), part.tail)
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


# --- MDF4 -------------------------------------------------------------------------------------------------------------

_COLUMNS = [("BusChannel", "u1"), ("ID", "<u4"), ("IDE", "u1"), ("DLC", "u1"), ("DataLength", "u1"),
    ("DataBytes", "u1", (64,)),
            ("Dir", "u1"), ("EDL", "u1"), ("BRS", "u1"), ("ESI", "u1")]  # fmt: skip
_START_TIME = 64 + 24 + 48  # in the file: identification block, head and links of the header block


class MdfRecord:
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
        values = {"BusChannel": np.where(frames["note"], NOTE_CHANNEL, 1),
                  "ID": frames["ident"] & 0x1FFFFFFF, "IDE": frames["ident"] >> 31,
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
        append_whole(self.fd, bytes(out))
        data, count = self.groups[k]
        self.records[k] += len(records)
        self.bytes[k] += len(raw)
        os.pwrite(self.fd, struct.pack("<Q", header if first else at), data if first else self.lists[k])
        os.pwrite(self.fd, struct.pack("<Q", self.records[k]), count)
        self.lists[k] = at + 24

    def close(self) -> None:
        os.close(self.fd)
