"""Measured runs: logs of any format in, logs of any format out, and recording them from a bus.

log              `read_log`, `write_log`, and the table of all formats
source           what a format gives and takes
csv_format, parquet_format, mdf, candump, asc, blf, trc
                 the formats, one file each; table, text_lines and frames hold what several have in common
bus_log          a log of frames seen through a database (dbc); signals are cut out of frames in signals and columns
units, plausible which unit a number is in, and whether it can be
recorder         frames from a bus to a file, in the formats of record_formats and record_parquet
"""

from hil.logs.log import Channel, Log, LogError, offered, read_log, write_log

__all__ = ["Channel", "Log", "LogError", "offered", "read_log", "write_log"]
