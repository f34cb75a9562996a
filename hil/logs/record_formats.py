"""What a recording is: a file that frames are appended to and that is whole after every append.

candump    lines, written whole, with the direction behind each frame as ``candump -x`` has it (here)
BLF        a container; the file is closed and opened again with python-can's writer, so that its header counts what is
           there (`hil.logs.through_can`)
MDF4       a compressed data block behind the file's end, then its address into the list of blocks, then the number of
           records: two writes of eight bytes, so that a reader meets the state before or after (`hil.logs.mdf_write`)
Parquet    `hil.logs.record_parquet`

A note of the loop is in each of them a frame on a channel of its own.
"""

from __future__ import annotations

import os
import re
import struct
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np

if TYPE_CHECKING:
    import can

__all__ = [
    "ERROR", "EXTENDED", "FD", "FRAME", "NOTE_CHANNEL", "NOTE_KIND", "NOTE_NAME", "REMOTE", "CandumpRecord",
    "FramesOfRecord", "RecordFormat", "append_whole", "packed_message",
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
