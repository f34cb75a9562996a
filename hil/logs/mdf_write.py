"""What is written in MDF4, through asammdf: logs, and recordings."""

from __future__ import annotations

import os
import struct
import tempfile
import zlib
from pathlib import Path
from typing import Any

import asammdf
import numpy as np
from asammdf.blocks.v4_blocks import SourceInformation
from asammdf.blocks.v4_constants import BUS_TYPE_CAN, SOURCE_BUS

from hil.logs.bus_log import encode_channels
from hil.logs.frames import Frames
from hil.logs.record_formats import ERROR, FD, NOTE_CHANNEL, REMOTE, append_whole
from hil.logs.source import Channel, LogError
from vaneloop.base.files import whole
from vaneloop.base.signals import UNITS

__all__ = ["MdfRecord", "write_bus", "write_groups", "write_mdf", "write_mdf3"]

_BUS = "CAN_DataFrame"


def write_mdf(path: Path, channels: dict[str, Channel], dbc: Path | None) -> None:
    """Channel groups, one per raster; bus logging where a DBC is given."""
    if dbc is not None:
        write_bus(path, encode_channels(channels, dbc, path))
        return
    write_groups(path, _rasters(channels))


def _rasters(channels: dict[str, Channel]) -> list[tuple[np.ndarray, dict[str, tuple[np.ndarray, str]]]]:
    """Channels by their times: for each the times and name -> (values, unit)."""
    rasters: dict[bytes, tuple[np.ndarray, dict[str, tuple[np.ndarray, str]]]] = {}
    for name, c in channels.items():
        rasters.setdefault(c.t.tobytes(), (c.t, {}))[1][name] = c.values, UNITS.get(name, c.unit).replace("-", "")
    return list(rasters.values())


def write_mdf3(path: Path, channels: dict[str, Channel], dbc: Path | None) -> None:
    """Channel groups of MDF 3.30, one per raster."""
    with whole(path, LogError) as part, tempfile.TemporaryDirectory() as own, asammdf.MDF(version="3.30") as mdf:
        _append(mdf, _rasters(channels))
        mdf.save(file := Path(own) / "log.mdf")  # a file of its own: asammdf writes MDF 3 into no other
        part.write_bytes(file.read_bytes())


def _append(mdf: Any, groups: list[tuple[np.ndarray, dict[str, tuple[np.ndarray, str]]]]) -> None:
    """Add channel groups: for each the times and name -> (values, unit)."""
    for t, channels in groups:
        mdf.append(
            [asammdf.Signal(v, t, name=name, unit=unit) for name, (v, unit) in channels.items()], comment="VaneLoop"
        )


def write_groups(path: Path, groups: list[tuple[np.ndarray, dict[str, tuple[np.ndarray, str]]]]) -> None:
    """Write channel groups: for each the times and name -> (values, unit)."""
    with whole(path, LogError) as part, asammdf.MDF(version="4.10") as mdf:
        _append(mdf, groups)
        with open(part, "wb+") as file:  # given the name, asammdf would put a suffix of its own behind it
            mdf.save(file, compression=2)


def write_bus(path: Path, frames: Frames) -> None:
    """Write a bus-logging file: one channel group of CAN data frames, as the ASAM bus logging standard lays it out."""
    columns = {
        "BusChannel": np.ones(frames.t.size, np.uint8), "ID": frames.ident & 0x1FFFFFFF,
        "IDE": (frames.ident >> 31).astype(np.uint8),
        "DLC": np.searchsorted([*range(9), 12, 16, 20, 24, 32, 48, 64], frames.length).astype(np.uint8),
        "DataLength": frames.length,
        "DataBytes": frames.data, "Dir": np.zeros(frames.t.size, np.uint8), "EDL": (frames.length > 8).astype(np.uint8),
        "BRS": np.zeros(frames.t.size, np.uint8), "ESI": np.zeros(frames.t.size, np.uint8),
    }  # fmt: skip
    kind = [(f"{_BUS}.{k}", c.dtype.newbyteorder("<"), c.shape[1:]) for k, c in columns.items()]
    samples = np.zeros(frames.t.size, kind)
    for k, c in columns.items():
        samples[f"{_BUS}.{k}"] = c
    source = SourceInformation(source_type=SOURCE_BUS, bus_type=BUS_TYPE_CAN)
    with whole(path, LogError) as part, asammdf.MDF(version="4.10") as mdf:
        mdf.append(
            asammdf.Signal(samples, frames.t, name=_BUS, source=source), comment="VaneLoop", common_timebase=True
        )
        with open(part, "wb+") as file:  # given the name, asammdf would put a suffix of its own behind it
            mdf.save(file, compression=2)


# --- recording --------------------------------------------------------------------------------------------------------

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
