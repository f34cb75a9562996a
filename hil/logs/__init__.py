"""Measured runs: logs of any format in, logs of any format out, and recording them from a bus.

log              `read_log`, `write_log`
formats          the one list of all formats, and those of other packages
source           what a format gives and takes
csv_format, parquet_format, mdf, candump, asc, blf, trc, tool_traces
                 the formats, one file each but for the text traces of further tools; table, dates, arrow, text_lines
                 and frames hold what several have in common
through_can, mdf_write, mdf_child
                 what python-can and asammdf write, and the process that opens an MDF4 file
bus_log          a log of frames seen through a database (dbc); signals are cut out of frames in signals and columns,
                 longer messages put together in transport
others           what python-can, cantools and asammdf find in a log
opening          which name of a log is which signal: stated, in a mapping file (mapping), or guessed
names, guess, times
                 what a name says; which guess is made; the time of a table
formula          channels made of channels
survey           all of that shown before anybody reads the log
held             what a controller had received: a value in a frame holds from that frame on
units, plausible which unit a number is in, and whether it can be
recorder         frames from a bus to a file, in the formats of record_formats and record_parquet; recordings reads them
                 back
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hil.logs.errors import LogError
    from hil.logs.formats import Format
    from hil.logs.frames import Frames
    from hil.logs.log import Log, offered, read_log, write_log
    from hil.logs.source import Channel, Options, Samples, Series, Source

_HOME = {
    **dict.fromkeys(("Log", "offered", "read_log", "write_log"), "hil.logs.log"), "Format": "hil.logs.formats",
    **dict.fromkeys(("Channel", "Options", "Samples", "Series", "Source"), "hil.logs.source"),
    "Frames": "hil.logs.frames", "LogError": "hil.logs.errors",
}  # fmt: skip

__all__ = [
    "Channel", "Format", "Frames", "Log", "LogError", "Options", "Samples", "Series", "Source", "offered", "read_log",
    "write_log",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    """Import what is asked for when it is asked for: the list of formats must not wait for numpy."""
    if name in _HOME:
        return getattr(importlib.import_module(_HOME[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
