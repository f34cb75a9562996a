"""Recordings read back, frame by frame with their directions, by python-can: what `hil.logs.recorder` wrote, or another
program.
"""

from __future__ import annotations

import io
import logging
from array import array
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import can
import numpy as np

from hil.bus.frames import NOTE, from_message
from hil.logs.blf import whole_blf
from hil.logs.formats import format_of
from hil.logs.record_formats import ERROR, NOTE_CHANNEL, NOTE_NAME, FramesOfRecord
from hil.logs.source import LogError, check_file
from vaneloop.base.errors import InputError

__all__ = ["Record", "frames_of", "read_blf", "read_candump", "read_opened_mdf", "read_record", "read_text"]


@dataclass(frozen=True)
class Record:
    """Frames of a recording, in order: ms since 1970 (int64[n]), both words (int64[n, 2], `hil.bus.frames`), and
    whether it sent them. Among them the notes of the loop (`hil.bus.frames.NOTE`).
    """

    ms: np.ndarray
    rows: np.ndarray
    sent: np.ndarray


def read_record(path: str | Path) -> Record:
    """Read what a `Recorder` wrote, or another program in a format that python-can reads. Raises LogError."""
    path = Path(path)
    check_file(path)
    of = format_of(path, "recording", "is not a recording's")
    try:
        us, rows, sent = of.read_recording(path)
    except InputError:
        raise
    except Exception as e:  # readers meet a damaged file with any exception there is
        raise LogError(f"{path}: cannot be read as a recording of frames ({type(e).__name__}: {e})") from None
    if not len(us):
        raise LogError(f"{path}: no CAN frame in it")
    order = np.argsort(us, kind="stable")
    return Record(us[order] // 1000, rows[order], sent[order])


def frames_of(messages: Iterable[Any], notes: str | int) -> FramesOfRecord:
    """Frames that a reader of python-can gives, 32 bytes each; it logs a line for each that it cannot read. Those on
    the channel ``notes`` are the loop's own notes (`hil.bus.frames.NOTE`).
    """
    found, log = array("q"), logging.getLogger("can")
    level = log.level
    log.setLevel(logging.CRITICAL)
    try:
        for m in messages:
            head, data = from_message(m)
            found.extend((round(m.timestamp * 1e6), head | NOTE * (m.channel == notes), data, not m.is_rx))
    finally:
        log.setLevel(level)
    table = np.array(found, np.int64).reshape(-1, 4)
    return table[:, 0], table[:, 1:3], table[:, 3] != 0


# --- formats ----------------------------------------------------------------------------------------------------------


def read_text(path: Path) -> FramesOfRecord:
    """Frames of a text log."""
    with can.LogReader(path) as reader:
        return frames_of(reader, NOTE_CHANNEL)


def read_candump(path: Path) -> FramesOfRecord:
    """Frames of a candump log."""
    with can.CanutilsLogReader(path) as reader, path.open() as file:
        return frames_of(_with_errors(reader, file), NOTE_NAME)


def _with_errors(reader: Iterable[can.Message], file: Iterable[str]) -> Iterator[can.Message]:
    """Give the frames of a candump log. python-can takes most error frames of one for data frames."""
    for message, line in zip(reader, (line for line in file if line.strip()), strict=True):
        if int(line.split()[2].partition("#")[0], 16) & ERROR:
            message.is_error_frame, message.is_extended_id = True, False
        yield message


def read_blf(path: Path) -> FramesOfRecord:
    """Frames of a Vector binary log."""
    with can.BLFReader(io.BytesIO(whole_blf(path))) as reader:
        return frames_of(reader, NOTE_CHANNEL)


def read_opened_mdf(path: str) -> FramesOfRecord:
    """Frames of an MDF4 file, in the process that may open one (`hil.logs.mdf_child`)."""
    with can.LogReader(path) as reader:
        return frames_of(reader, NOTE_CHANNEL)
