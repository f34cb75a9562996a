"""What python-can's writers write: logs in ASC, BLF and TRC, and recordings in BLF."""

from __future__ import annotations

import io
import os
from pathlib import Path
from typing import Any

import can
import numpy as np

from hil.logs.frames import Frames
from hil.logs.record_formats import ERROR, EXTENDED, FD, NOTE_CHANNEL, REMOTE, append_whole
from hil.logs.source import LogError
from vaneloop.base.files import whole

__all__ = ["BlfRecord", "messages", "write_asc", "write_blf", "write_trc"]


def write_asc(path: Path, frames: Frames) -> None:
    """Write a Vector ASCII log."""
    _write(path, frames, can.ASCWriter)


def write_blf(path: Path, frames: Frames) -> None:
    """Write a Vector binary log."""
    _write(path, frames, can.BLFWriter)


def write_trc(path: Path, frames: Frames) -> None:
    """Write a PEAK trace, version 2.1."""
    _write(path, frames, can.TRCWriter)


def _write(path: Path, frames: Frames, writer: type[can.io.generic.MessageWriter]) -> None:
    """Write frames with a writer of python-can."""
    with whole(path, LogError) as part, writer(str(part)) as out:
        for t, i, n, data in zip(
            frames.t.tolist(), frames.ident.tolist(), frames.length.tolist(), frames.data, strict=True
        ):
            message = can.Message(
                round(t, 6), i & 0x1FFFFFFF, i >> 31 == 1, channel=0, data=data[:n].tobytes(), is_fd=n > 8
            )
            out.on_message_received(message)


# --- recording --------------------------------------------------------------------------------------------------------


def messages(frames: np.ndarray) -> Any:
    """Give frames as python-can messages."""
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


class BlfRecord:
    """A container an append, made by python-can's writer."""

    def __init__(self, path: Path, channel: str):
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
