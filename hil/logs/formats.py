"""The formats of logs: how a file of each suffix is opened and written."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from hil.logs.asc import read_asc, write_asc
from hil.logs.blf import read_blf, write_blf
from hil.logs.bus_log import bus_reader, bus_writer
from hil.logs.candump import read_candump, write_candump
from hil.logs.csv_format import open_csv, write_csv
from hil.logs.frames import Frames
from hil.logs.mdf import open_mdf, write_mdf
from hil.logs.parquet_format import open_parquet, write_parquet
from hil.logs.source import Channel, LogError, Options, Source
from hil.logs.trc import read_trc, write_trc

__all__ = ["FORMATS", "Format", "format_of"]


@dataclass(frozen=True)
class Format:
    """How to read a file of the format, how to write channels into one (with a database, for CAN), and how to read its
    frames, where it holds nothing else.
    """

    read: Callable[[Path, Options], Source]
    write: Callable[[Path, dict[str, Channel], Path | None], None]
    frames: Callable[[Path], Frames] | None = None


def _can(read: Callable[[Path], Frames], write: Callable[[Path, Frames], None]) -> Format:
    """Format of a CAN log, seen through the database."""
    return Format(bus_reader(read), bus_writer(write), read)


FORMATS: dict[str, Format] = {
    ".log": _can(read_candump, write_candump),
    ".asc": _can(read_asc, write_asc),
    ".blf": _can(read_blf, write_blf),
    ".trc": _can(read_trc, write_trc),
    ".mf4": Format(open_mdf, write_mdf),
    ".csv": Format(open_csv, write_csv),
    ".parquet": Format(open_parquet, write_parquet),
}


def format_of(path: Path) -> Format:
    """The format that a file's suffix names."""
    found = FORMATS.get(path.suffix.lower())
    if found is None:
        raise LogError(f"{path}: suffix {path.suffix!r} is not a log's; allowed: {', '.join(FORMATS)}")
    return found
