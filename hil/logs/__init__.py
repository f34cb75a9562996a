"""Measured runs: logs of any format in, logs of any format out, and recording them from a bus."""

from hil.logs.log import Channel, Log, LogError, offered, read_log, write_log

__all__ = ["Channel", "Log", "LogError", "offered", "read_log", "write_log"]
