"""Measured runs: logs of any format in, logs of any format out, and recording them from a bus.

log              `read_log`, `write_log`, and the table of all formats
source           what a format gives and takes
csv_format, parquet_format, mdf, candump, asc, blf, trc
                 the formats, one file each; table, text_lines and frames hold what several have in common
bus_log          a log of frames seen through a database (dbc); signals are cut out of frames in signals and columns
opening          which name of a log is which signal: stated, in a mapping file (mapping), or guessed
names, guess, times
                 what a name says; which guess is made; the time of a table
survey           all of that shown before anybody reads the log
held             what a controller had received: a value in a frame holds from that frame on
units, plausible which unit a number is in, and whether it can be
recorder         frames from a bus to a file, in the formats of record_formats and record_parquet
"""

from hil.logs.log import Channel, Log, LogError, offered, read_log, write_log

__all__ = ["Channel", "Log", "LogError", "offered", "read_log", "write_log"]
