"""Recordings byte by byte, MDF4 groups and the process that reads them, and what a receiver of frames had.

Each recorded format is read with python-can's or pyarrow's own reader and with a decoder made here from the format's
description.
"""

from __future__ import annotations

import io
import json
import os
import resource
import struct
import subprocess
import sys
import time
import tracemalloc
import zlib
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import asammdf
import can
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from asammdf.blocks.v4_blocks import SourceInformation
from asammdf.blocks.v4_constants import BUS_TYPE_CAN, SOURCE_BUS

from hil.logs import Channel, LogError, formats, mdf, mdf_child, mdf_write, read_log, recorder, through_can, write_log
from hil.logs.dbc import load_dbc
from hil.logs.frames import EXTENDED, Frames
from hil.logs.held import answers, held, phase_of_ticks, taken, time_on_wire
from hil.logs.mdf_write import MdfRecord
from hil.logs.record_formats import ERROR, FD, FRAME, REMOTE, CandumpRecord, append_whole, packed_message
from hil.logs.record_parquet import ParquetRecord, _thrift_read, _thrift_write, read_parquet
from hil.logs.recorder import FLUSH, Recorder, check_name, free_name
from hil.logs.recordings import read_record
from hil.logs.signals import encode
from hil.logs.source import Options
from hil.logs.through_can import messages
from vaneloop.base.child import python, python_module
from vaneloop.base.errors import InputError
from vaneloop.base.tables import path as table_path

START = 1_700_000_000_123_456_000  # ns
LENGTHS = [*range(9), 12, 16, 20, 24, 32, 48, 64]


def frames(n: int, first: int = 0, seed: int = 1) -> np.ndarray:
    """Frames of every kind, a microsecond and more apart."""
    rng = np.random.default_rng(seed + first)
    out = np.zeros(n, FRAME)
    out["ns"] = START + 1000 * (7 * (first + np.arange(n)))
    kind = rng.integers(0, 5, n)
    ident = rng.integers(0, 1 << 11, n).astype(np.uint32)
    out["ident"] = np.select(
        [kind == 1, kind == 2, kind == 3],
        [EXTENDED | (ident << 18 | 5), REMOTE | ident, ERROR | 0x080 | (ident & 0x1FF)], ident
    )  # fmt: skip
    out["length"] = np.where(kind == 4, rng.choice(LENGTHS, n), rng.integers(0, 9, n))
    out["length"][kind == 3] = 8
    out["flags"] = np.where(kind == 4, FD | rng.integers(0, 4, n), 0)
    out["tx"] = rng.integers(0, 2, n)
    for k in range(n):
        if kind[k] != 2:
            out["data"][k, : out["length"][k]] = rng.integers(0, 256, out["length"][k])
    return out


def kinds(given: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Which are error, remote and CAN FD frames."""
    return given["ident"] & ERROR != 0, given["ident"] & REMOTE != 0, given["flags"] & FD != 0


def data_of(given: np.ndarray) -> list[bytes]:
    return [d[:n].tobytes() for d, n in zip(given["data"], given["length"], strict=True)]


def record(file: Path, *parts: np.ndarray) -> None:
    to = Recorder(file)
    for part in parts:
        to.put(part.tobytes())
        to.flush()
    to.close()


# ---- frames ----------------------------------------------------------------------------------------------------------


def test_a_frame_is_laid_out_as_the_kernel_has_it_with_a_time_before() -> None:
    assert FRAME.itemsize == 80 and [
        dict(FRAME.fields or {})[n][1] for n in ("ns", "ident", "length", "flags", "tx", "data")
    ] == [0, 8, 12, 13, 14, 16]


def test_messages_of_python_can_are_packed_and_given_back() -> None:
    given = [
        can.Message(1.5, 0x123, False, data=b"\x01\x02", is_rx=False),
        can.Message(2.000001, 0x1FFFFFFF, True, data=b""),
        can.Message(3.0, 0x7FF, False, is_remote_frame=True, dlc=5),
        can.Message(4.0, 0x80, False, is_error_frame=True, data=bytes(8)),
        can.Message(5.0, 0x1, False, is_fd=True, bitrate_switch=True, data=bytes(range(64))),
        can.Message(6.0, 0x2, True, is_fd=True, error_state_indicator=True, data=bytes(12)),
    ]
    packed = np.frombuffer(b"".join(map(packed_message, given)), FRAME)
    assert packed["ns"].tolist() == [1_500_000_000, 2_000_001_000, 3 * 10**9, 4 * 10**9, 5 * 10**9, 6 * 10**9]
    assert packed["ident"].tolist() == [0x123, EXTENDED | 0x1FFFFFFF, REMOTE | 0x7FF, ERROR | 0x80, 1, EXTENDED | 2]
    assert packed["length"].tolist() == [2, 0, 5, 8, 64, 12] and packed["flags"].tolist() == [0, 0, 0, 0, 5, 6]
    assert packed["tx"].tolist() == [1, 0, 0, 0, 0, 0]
    for a, b in zip(messages(packed), given, strict=True):
        assert a.equals(b, timestamp_delta=1e-6, check_channel=False), (a, b)
        assert a.channel == 0 and (a.is_remote_frame or bytes(a.data) == bytes(b.data))


# ---- candump ---------------------------------------------------------------------------------------------------------


def test_candump_lines_say_kind_flags_direction_and_microseconds(tmp_path: Path) -> None:
    given = np.zeros(6, FRAME)
    given["ns"] = [1_999_999, 1_000_000, START, START, START, START]
    given["ident"] = [0x7, EXTENDED | 0x7, REMOTE | 0x7FF, REMOTE | 0x1, ERROR | 0x80, 0x123]
    given["length"] = [2, 0, 4, 0, 8, 12]
    given["flags"][5] = FD | 3
    given["tx"] = [1, 0, 0, 1, 0, 0]
    given["data"][0, :3] = 0xAB, 0xCD, 0xEF
    made = CandumpRecord(tmp_path / "a.log", "my bus/0123456789")
    made.append(given)
    made.close()
    assert (tmp_path / "a.log").read_text().splitlines() == [
        "(0000000000.001999) my-bus-01234567 007#ABCD T", "(0000000000.001000) my-bus-01234567 00000007# R",
        "(1700000000.123456) my-bus-01234567 7FF#R4 R", "(1700000000.123456) my-bus-01234567 001#R T",
        "(1700000000.123456) my-bus-01234567 20000080#0000000000000000 R",
        f"(1700000000.123456) my-bus-01234567 123##3{'00' * 12} R",
    ]  # fmt: skip
    CandumpRecord(tmp_path / "b.log", "").append(given[:1])
    assert (tmp_path / "b.log").read_text() == "(0000000000.001999) can0 007#ABCD T\n"


@pytest.mark.parametrize("suffix", [".log", ".blf", ".mf4"])
def test_every_recorded_frame_is_as_python_can_reads_it(tmp_path: Path, suffix: str) -> None:
    given = frames(120)
    record(tmp_path / f"a{suffix}", given[:1], given[1:50], given[50:])
    error, remote, fd = kinds(given)
    got = list(can.LogReader(tmp_path / f"a{suffix}"))
    if suffix == ".mf4":  # a group a kind: each in its order
        got = [
            m
            for k in (0, 1, 2)
            for m in got
            if (m.is_error_frame, m.is_remote_frame) == ((False, False), (True, False), (False, True))[k]
        ]
        order = np.concatenate([np.flatnonzero(~error & ~remote), np.flatnonzero(error), np.flatnonzero(remote)])
        given = given[order]
        error, remote, fd = kinds(given)
    assert len(got) == 120
    assert [m.is_error_frame for m in got] == error.tolist() and [m.is_remote_frame for m in got] == remote.tolist()
    for m, g, data in zip(got, given, data_of(given), strict=True):
        assert round(m.timestamp * 1e6) == g["ns"] // 1000
        if m.is_error_frame:
            continue
        assert m.arbitration_id == int(g["ident"]) & 0x1FFFFFFF and m.is_extended_id == bool(int(g["ident"]) & EXTENDED)
        assert m.is_rx == (not g["tx"]) and m.is_fd == bool(g["flags"] & FD) and m.dlc == g["length"]
        assert m.is_remote_frame or bytes(m.data) == data
        if m.is_fd:
            assert m.bitrate_switch == bool(g["flags"] & 1)
            assert m.error_state_indicator == bool(g["flags"] & 2) or suffix == ".blf"


# ---- BLF -------------------------------------------------------------------------------------------------------------


def test_a_blf_recording_s_header_counts_what_is_there_after_every_append(tmp_path: Path) -> None:
    file, given = tmp_path / "a.blf", frames(60)
    to = Recorder(file)
    for k in range(3):
        to.put(given[20 * k : 20 * k + 20].tobytes())
        to.flush()
        raw = file.read_bytes()
        size, unpacked, count = struct.unpack_from("<QQI", raw, 16)
        assert size == len(raw) and count == 20 * (k + 1)
        year, month, _, day, hour, minute, second, milli = struct.unpack_from("<8H", raw, 40)
        first = time.gmtime(START // 10**9)
        assert (year, month, day, hour, minute, second, milli) == (*first[:6], START // 10**6 % 1000)
        last = struct.unpack_from("<8H", raw, 56)
        assert last[:2] == first[:2] and unpacked > 144
    to.close()
    assert to.frames == 60


def test_what_a_writer_sees_of_a_long_file_reads_and_seeks_as_a_file() -> None:
    tail = through_can._Tail(bytes(range(144)), 1000)
    assert tail.readable() and tail.writable() and tail.seekable() and tail.tell() == 0
    assert (
        tail.read(3) == b"\0\1\2" and tail.tell() == 3 and tail.read() == bytes(range(3, 144)) and tail.read(5) == b""
    )
    assert tail.seek(10) == 10 and tail.seek(5, io.SEEK_CUR) == 15 and tail.seek(0, io.SEEK_END) == 1000
    assert tail.write(b"abcdef") == 6 and tail.tell() == 1006 and tail.seek(-2, io.SEEK_END) == 1004
    assert tail.write(b"XYZ") == 3 and tail.tail == b"abcdXYZ" and tail.seek(0, io.SEEK_END) == 1007
    tail.seek(4)
    tail.write(b"\xff\xfe")
    assert tail.head == bytes([0, 1, 2, 3, 255, 254, *range(6, 144)]) and tail.tell() == 6
    tail.seek(1002)
    tail.write(b"-")
    assert tail.tail == b"ab-dXYZ"
    tail.close()
    assert tail.read(1) == b""


# ---- MDF4, by its blocks ---------------------------------------------------------------------------------------------


def block(raw: bytes, at: int) -> tuple[bytes, list[int], bytes]:
    """Identifier, links and data of a block of MDF4."""
    kind, size, links = struct.unpack_from("<4s4xQQ", raw, at)
    return kind, list(struct.unpack_from(f"<{links}Q", raw, at + 24)), raw[at + 24 + 8 * links : at + size]


def mdf_groups(raw: bytes) -> Iterator[tuple[bytes, int]]:
    """Records of each channel group as bytes, put together from its list of compressed blocks, and their number."""
    group = block(raw, 64)[1][0]
    while group:
        kind, links, _ = block(raw, group)
        assert kind == b"##DG"
        count = struct.unpack_from("<QQ", block(raw, links[1])[2])[1]
        out = b""
        if links[2]:
            kind, (at,), settings = block(raw, links[2])
            assert kind == b"##HL" and settings[:3] == bytes(3)
            while at:
                kind, (following, data), number = block(raw, at)
                assert (kind, struct.unpack("<B3xIQ", number)) == (b"##DL", (0, 1, len(out)))
                kind, _, packed = block(raw, data)
                of, way, parameter, size, zipped = struct.unpack_from("<2sBxIQQ", packed)
                assert (kind, of, way, parameter, at % 8, data % 8) == (b"##DZ", b"DT", 0, 0, 0, 0)
                part = zlib.decompress(packed[24 : 24 + zipped])
                assert len(part) == size
                out, at = out + part, following
        yield out, count
        group = links[0]


RECORD = np.dtype([("t", "<f8"), ("bus", "u1"), ("id", "<u4"), ("ide", "u1"), ("dlc", "u1"), ("length", "u1"),
                   ("data", "u1", (64,)), ("dir", "u1"), ("edl", "u1"), ("brs", "u1"), ("esi", "u1")])  # fmt: skip


def test_an_mdf_recording_is_a_list_of_compressed_blocks_for_each_kind_of_frame(tmp_path: Path) -> None:
    file, given = tmp_path / "a.mf4", frames(90)
    to = MdfRecord(file, "vcan0")
    for part in (given[:1], given[1:30], given[30:]):
        to.append(part)
    to.close()
    raw = file.read_bytes()
    assert struct.unpack_from("<QhhB", raw, 64 + 24 + 48) == (START, 0, 0, 2)
    error, remote, _ = kinds(given)
    for (records, count), these in zip(mdf_groups(raw), (~error & ~remote, error, remote & ~error), strict=True):
        got, want = np.frombuffer(records, RECORD), given[these]
        assert count == len(got) == len(want) > 5
        np.testing.assert_allclose(got["t"], (want["ns"] - START) * 1e-9, atol=1e-15)
        assert (got["bus"] == 1).all() and got["id"].tolist() == (want["ident"] & 0x1FFFFFFF).tolist()
        assert got["ide"].tolist() == (want["ident"] >> 31).tolist() and got["dlc"].tolist() == [
            LENGTHS.index(n) for n in want["length"]
        ]
        assert got["length"].tolist() == want["length"].tolist() and np.array_equal(got["data"], want["data"])
        assert got["dir"].tolist() == want["tx"].tolist() and got["edl"].tolist() == (want["flags"] >> 2).tolist()
        assert (
            got["brs"].tolist() == (want["flags"] & 1).tolist()
            and got["esi"].tolist() == (want["flags"] >> 1 & 1).tolist()
        )


def test_what_a_disk_refuses_is_not_in_the_file_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fd = os.open(tmp_path / "a", os.O_RDWR | os.O_CREAT)
    append_whole(fd, b"abc")
    write, room = os.write, [2, 4]

    def little(fd: int, data: bytes) -> int:
        if not room:
            raise OSError(28, "No space left on device")
        return write(fd, data[: room.pop(0)])

    monkeypatch.setattr(os, "write", little)
    append_whole(fd, b"defghi")
    assert (tmp_path / "a").read_bytes() == b"abcdefghi"
    room[:] = [2]
    with pytest.raises(OSError, match="No space"):
        append_whole(fd, b"jklm")
    assert (tmp_path / "a").read_bytes() == b"abcdefghi"


# ---- Parquet ---------------------------------------------------------------------------------------------------------


def test_a_row_of_a_parquet_recording_is_its_frame_and_the_signals_in_it(tmp_path: Path) -> None:
    given = frames(80)
    record(tmp_path / "a.parquet", given[:3], given[3:])
    rows = pq.read_table(tmp_path / "a.parquet").to_pylist()
    error, remote, fd = kinds(given)
    for k, (row, g, data) in enumerate(zip(rows, given, data_of(given), strict=True)):
        ident = int(g["ident"])
        assert row["t"] == pytest.approx((int(g["ns"]) - START) * 1e-9, abs=1e-15)
        assert pa.scalar(row["time"], pa.timestamp("ns", "UTC")).value == g["ns"]
        assert (row["id"], row["extended"]) == (ident & 0x1FFFFFFF, bool(ident & EXTENDED))
        assert row["kind"] == ("error" if error[k] else "remote" if remote[k] else "fd" if fd[k] else "data")
        assert (row["tx"], row["length"], row["bytes"]) == (bool(g["tx"]), g["length"], data)
    us, words, sent = read_parquet(tmp_path / "a.parquet")
    assert us.tolist() == (given["ns"] // 1000).tolist() and sent.tolist() == (given["tx"] != 0).tolist()
    lows = [int.from_bytes(d[:8].ljust(8, b"\0"), "little", signed=True) for d in data_of(given)]
    assert words[:, 1].tolist() == lows and (words[:, 0] >> 32 & 0xFF).tolist() == given["length"].tolist()
    assert (words[:, 0] & (EXTENDED | REMOTE | ERROR)).tolist() == (
        given["ident"] & (EXTENDED | REMOTE | ERROR)
    ).tolist()
    assert (words[:, 0] >> 40).tolist() == (given["flags"] & FD).tolist()


def test_signals_stand_in_the_rows_of_their_frames_and_nowhere_else(tmp_path: Path) -> None:
    m = next(m for m in load_dbc(table_path("vgv.dbc"))[0] if m.layout.name == "VGV_HEALTH")
    given = np.zeros(6, FRAME)
    given["ns"], given["ident"], given["length"] = START + 10**8 * np.arange(6), 0x0B3, 8
    given["data"][:, :8] = encode(
        m, {"p_s": np.linspace(20, 25, 6), "t_oil": np.array([40.0, np.nan, 42, 43, 44, 45])}, 6
    )
    given["ident"][2] |= REMOTE
    given["flags"][3] = FD
    given["data"][4, 0] ^= 1  # its CRC is wrong
    record(tmp_path / "a.parquet", given)
    table = pq.read_table(tmp_path / "a.parquet")
    assert table["p_s"].to_pylist() == [pytest.approx(20.0), pytest.approx(21.0), None, None, None, pytest.approx(25.0)]
    assert table["t_oil"].to_pylist() == [pytest.approx(40.0), None, None, None, None, pytest.approx(45.0)]
    assert table["n_dem"].null_count == 6
    assert read_log(tmp_path / "a.parquet", require=()).channels["p_s"].framed


def groups_of(file: Path) -> list[int]:
    meta = pq.ParquetFile(file).metadata
    return [meta.row_group(k).num_rows for k in range(meta.num_row_groups)]


def test_row_groups_are_merged_five_by_five_four_times_and_up_to_fifty_thousand_rows(tmp_path: Path) -> None:
    assert (ParquetRecord.MERGE, ParquetRecord.TOP, ParquetRecord.MOST) == (5, 4, 50_000)
    file, given = tmp_path / "a.parquet", frames(30)
    made = ParquetRecord(file, "")
    assert groups_of(file) in ([], [0])
    seen = []
    for k in range(26):
        made.append(given[k : k + 1])
        seen.append(groups_of(file))
        assert pq.read_table(file)["t"].to_pylist() == pytest.approx(((given["ns"][: k + 1] - START) * 1e-9).tolist())
    assert seen[:6] == [[1], [1, 1], [1, 1, 1], [1, 1, 1, 1], [5], [5, 1]]
    assert seen[9] == [5, 5] and seen[23] == [5, 5, 5, 5, 1, 1, 1, 1] and seen[24:] == [[25], [25, 1]]
    made.close()
    assert groups_of(file) == [26] and [p.name for p in tmp_path.iterdir()] == ["a.parquet"]


def test_a_group_too_large_or_merged_often_enough_is_merged_no_more(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ParquetRecord, "MOST", 4)
    made = ParquetRecord(tmp_path / "a.parquet", "")
    for k in range(30):
        made.append(frames(1, k))
    assert groups_of(tmp_path / "a.parquet") == [5] * 6  # five rows are more than four
    monkeypatch.setattr(ParquetRecord, "MOST", 5)
    monkeypatch.setattr(ParquetRecord, "TOP", 2)
    two = ParquetRecord(tmp_path / "b.parquet", "")
    for k in range(125):
        two.append(frames(1, k))
    assert groups_of(tmp_path / "b.parquet") == [25] * 5
    two.close()
    made.close()


def test_a_full_disk_leaves_the_grown_file_as_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = ParquetRecord(tmp_path / "a.parquet", "")
    made.append(frames(3))

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    made.close()
    assert pq.read_table(tmp_path / "a.parquet").num_rows == 3 and len(list(tmp_path.iterdir())) == 1


def test_a_parquet_log_of_signals_is_no_recording_of_frames(tmp_path: Path) -> None:
    pq.write_table(pa.table({"t": [1.0], "id": [1]}), tmp_path / "a.parquet")
    with pytest.raises(LogError, match="no column 'time': holds signals, not frames"):
        read_record(tmp_path / "a.parquet")


@pytest.mark.parametrize("of", ["footer", "made"])
def test_footers_are_read_and_written_byte_by_byte(tmp_path: Path, of: str) -> None:
    """Thrift's compact protocol: pyarrow's own footers, and every type, short and long lists, far fields, signs."""
    if of == "footer":
        columns = {f"c{k}": pa.array([k, None, -k]) for k in range(20)} | {"s": pa.array(["a", "b", None])}
        out = io.BytesIO()
        pq.write_table(pa.table(columns), out, row_group_size=1)
        raw = out.getvalue()
        size = int.from_bytes(raw[-8:-4], "little")
        footer = raw[-8 - size : -8]
        found, end = _thrift_read(footer, 0)
        assert end == size and _thrift_write(found) == footer
        assert found[3][1] == 3 and len(found[4][1][1]) == 3
        return
    struct_ = {
        1: (1, None),
        2: (2, None),
        3: (3, 7),
        5: (5, -1),
        6: (6, 1 << 40),
        21: (6, -(1 << 33)),
        22: (7, b"12345678"),
        23: (8, b"x" * 300),
        24: (9, (5, list(range(-7, 7)))),
        25: (9, (5, list(range(15)))),
        26: (9, (1, [1, 2, 1])),
        27: (12, {1: (5, 127), 200: (5, 128)}),
        28: (9, (12, [{1: (5, 64)}, {2: (5, -64)}])),
        44: (10, (8, [b"", b"a"])),
    }
    raw = _thrift_write(struct_)
    assert _thrift_read(b"?" + raw, 1) == (struct_, 1 + len(raw))
    assert raw.startswith(bytes([0x11, 0x12, 0x13, 7, 0x25, 1, 0x16, 0x80]))  # a field's step and type, then zigzag
    assert _thrift_write({1: (5, -64), 2: (5, 64)}) == bytes([0x15, 0x7F, 0x15, 0x80, 0x01, 0])
    assert _thrift_write({16: (5, 0)}) == bytes([0x05, 0x20, 0, 0]) and _thrift_write({15: (5, 0)}) == bytes(
        [0xF5, 0, 0]
    )
    assert _thrift_write({1: (9, (5, [0] * 14))})[:2] == bytes([0x19, 0xE5]) and _thrift_write({1: (9, (5, [0] * 15))})[
        :3
    ] == bytes([0x19, 0xF5, 15])
    with pytest.raises(ValueError, match="thrift type 13 does not occur"):
        _thrift_read(bytes([0x1D, 0, 0]), 0)


# ---- recorder --------------------------------------------------------------------------------------------------------


def test_frames_are_appended_every_half_second(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    assert FLUSH == 0.5
    to = Recorder(tmp_path / "a.log")
    to.put(frames(2).tobytes())
    to.put(b"")
    for at, held_ in ((100.49, 0), (100.5, 2), (100.5, 2), (100.99, 2), (101.0, 3)):
        now[0] = at
        to.poll()
        assert to.frames == held_
        if at == 100.5:
            to.put(frames(1, 2).tobytes() if not to._waiting else b"")
    to.close()
    assert len((tmp_path / "a.log").read_text().splitlines()) == 3


def test_a_recording_s_name_is_checked_and_the_first_free_one_taken(tmp_path: Path) -> None:
    file = tmp_path / "run.LOG"
    assert check_name(str(file)) == file and free_name(file) == tmp_path / "run.1.LOG"
    for n in (1, 2, 4):
        (tmp_path / f"run.{n}.LOG").touch()
    assert free_name(file) == tmp_path / "run.3.LOG"
    with pytest.raises(InputError, match=r"suffix '.asc' is not one of a recording; allowed: candump \(.log\), BLF"):
        check_name(tmp_path / "a.asc")
    (tmp_path / "dir.log").mkdir()
    with pytest.raises(InputError, match="is a folder"):
        check_name(tmp_path / "dir.log")
    file.write_bytes(b"")
    assert Recorder(file).kept is None  # an empty file is no recording
    file.write_text("x")
    assert Recorder(file).kept == tmp_path / "run.3.LOG" and (tmp_path / "run.3.LOG").read_text() == "x"


def test_what_is_no_recording_is_refused_and_frames_come_in_order(tmp_path: Path) -> None:
    (tmp_path / "a.log").write_text("(2.5) can0 002#02 T\n(1.0009) can0 001#01\n(2.5) can0 003#\n")
    got = read_record(tmp_path / "a.log")
    assert got.ms.tolist() == [1000, 2500, 2500] and (got.rows[:, 0] & 0x7FF).tolist() == [1, 2, 3]
    assert got.sent.tolist() == [False, True, False]
    (tmp_path / "b.log").write_text("# nothing\n")
    with pytest.raises(LogError, match="b.log: (no CAN frame in it|cannot be read as a recording)"):
        read_record(tmp_path / "b.log")
    (tmp_path / "d.log.gz").write_bytes(b"x" * 300)
    with pytest.raises(LogError, match="d.log.gz: suffix '.gz' is not a recording's; allowed: .log"):
        read_record(tmp_path / "d.log.gz")
    (tmp_path / "c.blf").write_bytes(b"x" * 300)
    with pytest.raises(LogError, match="c.blf: is not a BLF"):
        read_record(tmp_path / "c.blf")


def test_the_recorder_s_process_takes_whole_frames_and_says_how_many(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given, said = frames(50).tobytes(), list[str]()
    parts = [given[:100], given[100:163], given[163:240], given[240:], b""]
    select_ = SimpleNamespace(select=lambda r, w, x, s: (r, [], []) if s == FLUSH / 2 else ([], [], []))
    monkeypatch.setattr(recorder, "select", select_)
    monkeypatch.setattr(os, "read", lambda fd, n: parts.pop(0) if (fd, n) == (0, 1 << 20) else b"")
    monkeypatch.setattr(os, "write", _writer(os.write, said))
    ignored: list[int] = []
    monkeypatch.setattr("signal.signal", lambda number, _: ignored.append(int(number)))
    assert recorder.serve(str(tmp_path / "a.log"), "can7") == 0
    assert said == ["ready \n", "frames 50\n"] and sorted(ignored) == [1, 2, 15]
    lines = (tmp_path / "a.log").read_text().splitlines()
    assert len(lines) == 50 and " can7 " in lines[0]
    parts[:] = [b""]
    assert recorder.serve(str(tmp_path / "a.log"), "can7") == 0 and said[2:] == [
        f"ready {tmp_path / 'a.1.log'}\n",
        "frames 0\n",
    ]
    assert (
        recorder.serve(str(tmp_path / "a.txt"), "can7") == 2
        and said[-1].startswith("error ")
        and "suffix '.txt'" in said[-1]
    )


def _writer(write: Any, said: list[str]) -> Any:
    def to(fd: int, data: Any) -> int:
        if fd != 1:
            return int(write(fd, data))
        said.append(bytes(data).decode())
        return len(data)

    return to


def test_frames_that_do_not_fit_into_the_pipe_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    to: Any = object.__new__(recorder.RecorderProcess)
    to.lost, to._pipe, taken_ = 0, 99, list[bytes]()

    def write(fd: int, data: bytes) -> int:
        if len(taken_) == 1:
            taken_.append(b"")
            raise BlockingIOError
        taken_.append(data)
        return len(data)

    monkeypatch.setattr(os, "write", write)
    to.put(frames(120).tobytes())  # 4096 bytes, what a pipe takes whole, are 51 frames
    assert [len(t) // 80 for t in taken_] == [51, 0, 18] and to.lost == 51


# ---- MDF4 read -------------------------------------------------------------------------------------------------------


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, tuple[int, int]]]:
    """MDF4 files are read in this process; the limits that the other would have set on itself."""
    limits: list[tuple[int, tuple[int, int]]] = []

    def child(request: bytes, seconds: float) -> bytes:
        out = io.BytesIO()
        mdf_child.answer(request, out)
        limits.append((-1, (int(seconds), 0)))
        return out.getvalue()

    monkeypatch.setattr(resource, "setrlimit", lambda which, pair: limits.append((which, pair)))
    monkeypatch.setattr(mdf, "_child", child)
    return limits


def test_the_reader_of_mdf_bounds_its_time_and_its_memory(tmp_path: Path, here: list[Any]) -> None:
    file = tmp_path / "a.mf4"
    mdf_write.write_groups(file, [(np.arange(3.0), {"n_dem": (np.arange(3.0), "%")})])
    size = 2_500_000
    with file.open("ab") as f:
        f.write(bytes(size - file.stat().st_size))
    before = resource.getrusage(resource.RUSAGE_SELF)
    mdf.read_mdf(file, ["n_dem"])
    limits = dict(here)
    spent = before.ru_utime + before.ru_stime
    ends = limits[resource.RLIMIT_CPU]
    assert ends[0] == ends[1] and spent + 22.0 <= ends[0] <= spent + 30.0  # 20 s, and one for each megabyte
    memory = limits[resource.RLIMIT_AS]
    now = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    assert memory[0] == memory[1] and memory[0] - now == pytest.approx((1 << 30) + 40 * size, abs=6e7)
    assert limits[-1] == (20 * 22, 0)


def test_channels_have_the_names_of_their_groups_and_only_the_wanted_are_read(tmp_path: Path, here: list[Any]) -> None:
    file, t = tmp_path / "a.mf4", np.arange(4.0)
    with asammdf.MDF(version="4.10") as made:
        for name, values in (("fast", t), ("slow", t[::2])):
            made.append(
                [
                    asammdf.Signal(10.0 + values, values, name="n_dem", unit="%"),
                    asammdf.Signal(values, values, name=f"{name}\\dev", unit="m", comment="c" * 300),
                    asammdf.Signal(
                        np.array([b"a", b"b", b"c", b"d"][: values.size]), values, name=f"word_{name}", encoding="utf-8"
                    ),
                ],
                acq_name=name,
            )
        made.append([asammdf.Signal(t[:0], t[:0], name="empty")])
        made.save(file)
    content, none = mdf.read_mdf(file, ["N_DEM", "fast", "word_fast", "empty"])
    assert none is None and content["comments"] == {}
    assert content["names"]["fast.n_dem"] == ["fast.n_dem", "n_dem", "0.n_dem"] and "slow.n_dem" in content["names"]
    assert content["names"]["fast\\dev"] == ["fast\\dev", "fast", "fast.fast\\dev", "fast.fast", "0.fast\\dev"]
    assert set(content["series"]) == {"fast.n_dem", "slow.n_dem", "fast\\dev", "empty"}
    at, values, unit, framed = content["series"]["slow.n_dem"]
    assert (at.tolist(), values.tolist(), unit, framed) == ([0.0, 2.0], [10.0, 12.0], "%", False)
    assert content["why"]["word_fast"].startswith("holds ") and content["why"]["word_fast"].endswith(", not numbers")
    groups = mdf.Groups(content)
    assert (
        groups.series("slow.n_dem").values.tolist() == [10.0, 12.0] and groups.absent("x") == "" and not groups.sorted
    )
    nothing = groups.series("word_fast")
    assert (nothing.t.size, nothing.values.size) == (0, 0) and groups.notes[0].startswith("word_fast: holds ")
    assert groups.series("word_slow").t.size == 0 and groups.notes[1] == "word_slow: has no samples"
    assert groups.has().startswith("; the file has 7 channels: fast.n_dem, fast\\dev, word_fast")
    guessed, _ = mdf.read_mdf(file, ["nothing"], guess=True)
    assert {"fast.n_dem", "slow.n_dem"} <= set(guessed["series"]) and "fast\\dev" not in guessed["series"]


def test_comments_say_what_a_channel_is_where_guesses_are_wanted(tmp_path: Path, here: list[Any]) -> None:
    file, t = tmp_path / "a.mf4", np.arange(4.0)
    source = SourceInformation(source_type=SOURCE_BUS, bus_type=BUS_TYPE_CAN)
    with asammdf.MDF(version="4.10") as made:
        made.append([asammdf.Signal(t, t, name="a1", unit="x" * 50, comment="measured rotor speed", source=source)])
        made.append([asammdf.Signal(t, t, name="n_dem", comment="y" * 300)])
        made.save(file)
    content, _ = mdf.read_mdf(file, ["n_dem"], guess=True)
    assert content["comments"]["a1"] == "measured rotor speed" and len(content["comments"]["n_dem"]) == 200
    assert content["series"]["a1"][2:] == ("x" * 40, True) and content["series"]["n_dem"][2:] == ("", False)
    assert set(mdf.read_mdf(file, ["n_dem"])[0]["series"]) == {"n_dem"}


def test_frames_of_a_bus_log_are_those_that_were_written(tmp_path: Path, here: list[Any]) -> None:
    n = 16
    data = np.zeros((n, 64), np.uint8)
    for k, length in enumerate(LENGTHS):
        data[k, :length] = k + 1
    ident = np.where(np.arange(n) % 2, np.uint32(EXTENDED | 5), np.uint32(0x7FF)).astype(np.uint32)
    given = Frames(0.5 * np.arange(n), ident, np.zeros(n, np.int32), np.array(LENGTHS, np.uint8), data)
    mdf_write.write_bus(tmp_path / "a.mf4", given)
    content, got = mdf.read_mdf(tmp_path / "a.mf4", ["n_dem"])
    assert got is not None and content["names"] == {} and got.notes == []
    for of in ("t", "ident", "length", "data"):
        assert np.array_equal(getattr(got, of), getattr(given, of)), of
    assert (got.bus == 1).all()
    small = Frames(given.t[:9], ident[:9], given.bus[:9], given.length[:9], data[:9, :8])
    mdf_write.write_bus(tmp_path / "b.mf4", small)
    assert np.array_equal(mdf.read_mdf(tmp_path / "b.mf4", [])[1].data, small.data)  # type: ignore[union-attr]
    seen = list(can.LogReader(tmp_path / "a.mf4"))
    assert [bytes(m.data) for m in seen] == [d[:k].tobytes() for d, k in zip(data, LENGTHS, strict=True)]
    assert [m.is_fd for m in seen] == [k > 8 for k in LENGTHS] and [m.dlc for m in seen] == LENGTHS


def bus_group(to: Any, columns: dict[str, np.ndarray], t: np.ndarray) -> None:
    kind = [(f"CAN_DataFrame.{k}", c.dtype, c.shape[1:]) for k, c in columns.items()]
    samples = np.zeros(t.size, kind)
    for k, c in columns.items():
        samples[f"CAN_DataFrame.{k}"] = c
    source = SourceInformation(source_type=SOURCE_BUS, bus_type=BUS_TYPE_CAN)
    to.append(asammdf.Signal(samples, t, name="CAN_DataFrame", source=source), common_timebase=True)


def test_buses_of_other_loggers_may_lack_columns_and_are_merged_by_time(tmp_path: Path, here: list[Any]) -> None:
    n, file = 8, tmp_path / "a.mf4"
    t = np.arange(float(n))
    with asammdf.MDF(version="4.10") as made:
        bus_group(
            made,
            {
                "ID": np.array([1, 0x7FF, 0x800, 4, 5, 6, 7, 8], np.uint32),
                "DLC": np.array([0, 1, 8, 9, 2, 3, 15, 4], np.uint8),
                "DataBytes": np.full((n, 8), 7, np.uint8),
            },
            t,
        )
        bus_group(
            made,
            {
                "ID": np.full(3, 0xA0, np.uint32),
                "IDE": np.array([0, 1, 0], np.uint8),
                "BusChannel": np.full(3, 2, np.uint8),
                "DataLength": np.array([12, 3, 70], np.uint8),
                "DataBytes": np.full((3, 12), 9, np.uint8),
            },
            t[:3] + 0.5,
        )
        bus_group(
            made,
            {"ID": np.zeros(0, np.uint32), "DLC": np.zeros(0, np.uint8), "DataBytes": np.zeros((0, 8), np.uint8)},
            t[:0],
        )
        made.save(file)
    _, got = mdf.read_mdf(file, [])
    assert got is not None
    assert got.t.tolist() == [0, 0.5, 1, 1.5, 2, 2.5, 3, 4, 5, 6, 7]
    assert got.ident.tolist() == [1, 0xA0, 0x7FF, EXTENDED | 0xA0, EXTENDED | 0x800, 0xA0, 4, 5, 6, 7, 8]
    assert got.length.tolist() == [0, 12, 1, 3, 8, 64, 8, 2, 3, 8, 4] and got.bus.tolist() == [
        0,
        2,
        0,
        2,
        0,
        2,
        0,
        0,
        0,
        0,
        0,
    ]
    assert (
        got.data.shape == (11, 64)
        and got.data[0].tolist() == [7] * 8 + [0] * 56
        and got.data[1, :13].tolist() == [9] * 12 + [0]
    )


def test_a_file_that_is_no_mdf_or_that_its_reader_cannot_finish_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, here: list[Any]
) -> None:
    head = b"MDF     4.10    " + bytes(48) + b"##HD" + bytes(100)
    for raw, said in (
        (head[:167], "is not a whole MDF file"),
        (b"MDF     3.30    " + bytes(200), "is not a whole MDF file"),
        (b"MDF     2.00    " + bytes(200), "is not a whole MDF file"),
        (b"x" * 200, "is not a whole MDF file"),
        (head[:64] + b"##XX" + head[68:], "is not a whole"),
        (head[:68] + b"\xff" * 300, "is not an MDF file that asammdf reads ("),
    ):
        (tmp_path / "a.mf4").write_bytes(raw)
        with pytest.raises(LogError) as caught:
            mdf.read_mdf(tmp_path / "a.mf4", [])
        assert said in str(caught.value)
    (tmp_path / "a.mf4").write_bytes(head[:68].replace(b"MDF     ", b"UnFinMF ") + b"\xff" * 300)
    with pytest.raises(LogError, match="that asammdf reads"):
        mdf.read_mdf(tmp_path / "a.mf4", [])

    def hungry(*_: object, **__: object) -> None:
        raise MemoryError

    monkeypatch.setattr(asammdf, "MDF", hungry)
    with pytest.raises(
        LogError, match="unpacks to more memory than its size allows, 1,073,741,824 bytes and 40 for each of its own"
    ):
        mdf.read_mdf(tmp_path / "a.mf4", [])
    monkeypatch.setattr(mdf, "_child", lambda *_: b"")
    with pytest.raises(LogError, match=r"is damaged \(the MDF reader could not finish it\)"):
        mdf.read_mdf(tmp_path / "a.mf4", [])


def test_an_answer_goes_to_standard_output_and_nothing_that_a_library_prints(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def answer(request: bytes, out: Any) -> None:
        os.write(1, b"a library prints")
        out.write(b"answer to " + request)

    monkeypatch.setattr(mdf_child, "answer", answer)
    monkeypatch.setattr(sys, "stdin", SimpleNamespace(buffer=io.BytesIO(b"one line\nanother")))
    kept, errors = os.dup(1), os.dup(2)
    try:
        for fd, name in ((1, "out"), (2, "err")):
            file = os.open(tmp_path / name, os.O_WRONLY | os.O_CREAT)
            os.dup2(file, fd)
            os.close(file)
        mdf_child.serve()
    finally:
        os.dup2(kept, 1)
        os.dup2(errors, 2)
        os.close(kept)
        os.close(errors)
    assert (tmp_path / "out").read_bytes() == b"answer to one line\n"
    assert (tmp_path / "err").read_bytes() == b"a library prints"


def test_a_child_that_fails_or_takes_too_long_has_no_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []

    def run(command: list[str], **options: Any) -> Any:
        asked.append((command, options))
        if options["timeout"] == 1.0:
            raise subprocess.TimeoutExpired(command, 1.0)
        return SimpleNamespace(stdout=b"said", returncode=int(options["timeout"]) - 2)

    monkeypatch.setattr(subprocess, "run", run)
    assert [mdf._child(json.dumps({}).encode(), s) for s in (1.0, 2.0, 3.0)] == [b"", b"said", b""]
    command, options = asked[0]
    assert command == python("from hil.logs.mdf_child import serve; serve()")
    assert options["input"] == b"{}" and options["check"] is False
    assert options["env"]["OPENBLAS_NUM_THREADS"] == "1"


# ---- what a receiver had ---------------------------------------------------------------------------------------------


def channel(t: Any, framed: bool = True) -> Channel:
    t = np.asarray(t, float)
    return Channel(t, np.zeros(t.size), framed)


def test_a_value_holds_from_its_frame_on_to_a_microsecond() -> None:
    c = channel([1.0, 2.0, 3.0])
    assert held(c, np.array([0.0, 1.0, 2.0 - 0.9e-6, 2.0 - 1.1e-6, 2.5, 9.0])).tolist() == [0, 0, 1, 0, 1, 2]


def test_answers_are_of_a_log_whose_commands_came_in_frames() -> None:
    eleven, ten = np.arange(11) * 0.01, np.arange(10) * 0.01
    assert answers({"n_dem": channel(eleven, False), "x_dem": channel(eleven)}) is None
    assert answers({"n_r": channel(eleven), "x_dem": channel(ten)}) is None
    found = {"n_dem": channel(eleven), "x_dem": channel(ten), "x_lvdt": channel(eleven + 1.0), "i_cmd": channel(eleven)}
    assert answers(found) is found["x_lvdt"] and answers({"x_dem": channel(eleven)}) is None


def test_a_command_counts_that_came_before_the_nearest_answer() -> None:
    channels = {"n_dem": channel(0.01 * np.arange(30)), "x_dem": channel(0.002 + 0.01 * np.arange(30), False)}
    when = np.array([0.0, 0.1, 0.1069, 0.1071, 0.5])
    np.testing.assert_allclose(taken(channels, when, 0.005), [0.002, 0.102, 0.102, 0.112, 0.5], atol=1e-12)
    np.testing.assert_allclose(
        taken(channels, np.array([0.1, 0.0985, 0.29]), 0.0021), [0.102, 0.0985, 0.292], atol=1e-12
    )
    assert taken({"x_dem": channel([0.0, 1.0])}, when, 1.0) is when
    # on a wire, less the time that the answer was on it
    t = 0.01 * np.arange(30)
    wire = {"n_dem": channel(t), "x_dem": channel(t + 0.002), "i_cmd": channel(t + 0.00223)}
    assert time_on_wire(wire) == pytest.approx(1.25 * 0.00023)
    np.testing.assert_allclose(taken(wire, np.array([0.1]), 0.005), [0.102 - 1.25 * 0.00023], atol=1e-12)


@pytest.mark.parametrize(
    ("apart", "found"),
    [(39e-6, 0.0), (41e-6, 1.25 * 41e-6), (0.69e-3, 1.25 * 0.69e-3), (0.71e-3, 0.0), (3e-4, 1.25 * 3e-4 + 1e-4)],
)
def test_frames_back_to_back_say_how_long_one_is_on_the_wire(apart: float, found: float) -> None:
    t = 0.01 * np.arange(50)
    assert time_on_wire({"x_dem": channel(t), "i_cmd": channel(t + apart)}) == pytest.approx(found, abs=1e-9)


def test_a_tenth_of_the_distances_are_those_of_bursts_or_there_are_none() -> None:
    for bursts, frames_, some in ((9, 91, False), (10, 91, True), (10, 92, False)):
        t = np.sort(np.concatenate([0.0101 * np.arange(frames_), 0.0101 * np.arange(bursts) + 2.3e-4]))
        assert (time_on_wire({"x_dem": channel(t)}) > 0.0) == some == (bursts >= 0.1 * (t.size - 1))
    assert time_on_wire({}) == 0.0 and time_on_wire({"x_dem": channel([0.0, 1e-4, 2e-4], False)}) == 0.0


@pytest.mark.parametrize(("phase", "found"), [(0.0, 0.0), (0.0034, 0.0034), (0.0099, 0.0099), (0.00999, 0.0)])
def test_ticks_stand_where_the_answers_do(phase: float, found: float) -> None:
    t = 0.01 * np.arange(100)
    channels = {"n_dem": channel(t), "x_dem": channel(t + phase)}
    assert phase_of_ticks(channels, 0.01) == pytest.approx(found, abs=1e-9)
    assert phase_of_ticks({"x_dem": channel(t)}, 0.01) == 0.0
    spread = t + 0.0034 + np.linspace(0.0, 0.0061, 100)  # one turn's part of 0.61: half of the answers' raster is gone
    assert phase_of_ticks({"n_dem": channel(t), "x_dem": channel(spread)}, 0.01) == 0.0
    near = t + 0.0034 + np.linspace(-0.00295, 0.00295, 100)
    assert phase_of_ticks({"n_dem": channel(t), "x_dem": channel(near)}, 0.01) == pytest.approx(0.0034, abs=2e-4)


def test_an_answer_within_the_time_given_counts_to_its_end() -> None:
    channels = {"n_dem": channel(0.25 * np.arange(20)), "x_dem": channel(0.25 * np.arange(20), False)}
    assert taken(channels, np.array([1.0625]), 0.0625).tolist() == [1.0]
    assert taken(channels, np.array([1.0625]), 0.062).tolist() == [1.0625]


def test_mdf_is_written_as_groups_of_one_raster_and_as_frames_where_a_database_is_given(tmp_path: Path) -> None:
    t = 0.01 * np.arange(5)
    channels = {
        "n_dem": Channel(t, 50.0 + t),
        "state": Channel(t, np.full(5, 2.0)),
        "p_s": Channel(t[::2], 21.0 + t[::2]),
    }
    mdf_write.write_mdf(tmp_path / "a.mf4", channels, None)
    with asammdf.MDF(tmp_path / "a.mf4") as got:
        assert [[c.name for c in g.channels][1:] for g in got.groups] == [["n_dem", "state"], ["p_s"]]
        assert (got.get("n_dem").unit, got.get("state").unit) == ("%", "")
    mdf_write.write_mdf(tmp_path / "b.mf4", channels, table_path("vgv.dbc"))
    assert {m.arbitration_id for m in can.LogReader(tmp_path / "b.mf4")} == {0x0A0, 0x0B0, 0x0B3}


def test_an_mdf_of_frames_is_seen_through_a_database_unless_its_channels_are_asked_for(
    tmp_path: Path, here: list[Any]
) -> None:
    n = np.arange(4.0)
    with asammdf.MDF(version="4.10") as made:
        bus_group(
            made,
            {
                "ID": np.full(4, 0xA0, np.uint32),
                "DLC": np.full(4, 8, np.uint8),
                "DataBytes": np.zeros((4, 8), np.uint8),
            },
            n,
        )
        made.append([asammdf.Signal(n, n, name="Speed")])
        made.save(tmp_path / "a.mf4")

    def kind(dbc: Path | None, mapping: dict[str, str]) -> str:
        return mdf.open_mdf(tmp_path / "a.mf4", Options(dbc, mapping)).kind

    assert kind(None, {}) == "signal" and kind(None, {"speed": "n_dem"}) == "channel"
    assert kind(table_path("vgv.dbc"), {"speed": "n_dem"}) == "signal"
    mdf_write.write_groups(tmp_path / "a.mf4", [(n, {"x": (n, "")})])
    assert kind(table_path("vgv.dbc"), {}) == "channel"


def test_a_channel_whose_values_have_words_is_read_as_its_numbers(tmp_path: Path, here: list[Any]) -> None:
    words = {"val_0": 0, "text_0": "off", "val_1": 1, "text_1": "on", "default_addr": "?"}
    with asammdf.MDF(version="4.10") as made:
        made.append([asammdf.Signal(np.array([0, 1, 1], np.uint8), np.arange(3.0), name="state", conversion=words)])
        made.append(
            [asammdf.Signal(np.array([1, 2], np.uint8), np.arange(2.0), name="n_dem", conversion={"a": 2.0, "b": 5.0})]
        )
        made.save(tmp_path / "a.mf4")
    series = mdf.read_mdf(tmp_path / "a.mf4", ["state", "n_dem"])[0]["series"]
    assert series["state"][1].tolist() == [0, 1, 1] and series["n_dem"][1].tolist() == [7, 9]


def test_the_extra_that_reads_mdf_is_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, here: list[Any]
) -> None:
    asked: list[tuple[str, ...]] = []
    for module in (mdf, formats):
        monkeypatch.setattr(module, "needs", lambda *what: asked.append(what))
    write_log(tmp_path / "a.mf4", {"n_dem": Channel(np.arange(2.0), np.arange(2.0))})
    mdf.read_mdf(tmp_path / "a.mf4", [])
    assert asked == [(f"{tmp_path / 'a.mf4'}: {name}", "asammdf") for name in ("MDF4", "MDF")]


@pytest.mark.parametrize(
    ("last", "frames_", "error"),
    [("frames 3", 3, ""), ("error no room", 0, "no room"), ("", 0, "the recorder was killed")],
)
def test_a_recorder_in_another_process_tells_how_it_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, last: str, frames_: int, error: str
) -> None:
    import fcntl

    reads, writes = os.pipe()
    waited: list[int] = []
    process = SimpleNamespace(
        stdin=os.fdopen(writes, "wb"),
        stdout=io.BytesIO(f"ready old.log\n{last}\n".encode()),
        wait=lambda: waited.append(1),
    )

    def start(command: list[str], **options: Any) -> Any:
        assert command == python_module("hil.logs.recorder", str(tmp_path / "a.log"), "can3")
        assert options["start_new_session"] is True
        return process

    monkeypatch.setattr(subprocess, "Popen", start)
    to = recorder.RecorderProcess(tmp_path / "a.log", "can3")
    assert (to.kept, to.frames, to.lost, to.error) == ("old.log", 0, 0, "")
    assert not os.get_blocking(writes) and fcntl.fcntl(writes, fcntl.F_GETPIPE_SZ) == 1 << 20
    to.put(b"x" * 160)
    assert os.read(reads, 1000) == b"x" * 160
    to.close()
    assert (to.frames, to.error, waited, process.stdin.closed) == (frames_, error, [1], True)
    os.close(reads)


def test_a_recorder_that_does_not_start_is_refused_with_its_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for said, why in ((b"error it cannot\n", "it cannot"), (b"", "a.log: the recorder did not start")):
        reads, writes = os.pipe()
        process = SimpleNamespace(stdin=os.fdopen(writes, "wb"), stdout=io.BytesIO(said))
        monkeypatch.setattr(subprocess, "Popen", lambda *_, process=process, **__: process)
        with pytest.raises(InputError, match=why):
            recorder.RecorderProcess(tmp_path / "a.log")
        os.close(reads)
        process.stdin.close()


@pytest.mark.parametrize("kind", [CandumpRecord, MdfRecord])
def test_a_recording_that_is_closed_holds_no_file_open(tmp_path: Path, kind: Any) -> None:
    made = kind(tmp_path / {CandumpRecord: "a.log", MdfRecord: "a.mf4"}[kind], "vcan0")
    fd = made.fd
    os.fstat(fd)
    made.close()
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(fd)


def test_a_recorder_that_is_closed_ends_its_file_and_asks_for_an_extra_for_mdf_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []
    monkeypatch.setattr(formats, "needs", lambda what, _: asked.append(what))
    for suffix in (".log", ".mf4"):
        to: Any = Recorder(tmp_path / f"a{suffix}")
        to.put(frames(2).tobytes())
        to.close()
        with pytest.raises(OSError, match="Bad file descriptor"):
            os.fstat(to.file.fd)
        assert len(read_record(tmp_path / f"a{suffix}").ms) == 2
    assert asked == [f"{tmp_path / 'a.mf4'}: MDF4"]


def test_a_grown_file_that_cannot_be_read_again_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = ParquetRecord(tmp_path / "a.parquet", "")
    made.append(frames(3))

    def unreadable(_: object) -> None:
        raise OSError(5, "Input/output error")

    with monkeypatch.context() as broken:
        broken.setattr(pq, "ParquetFile", unreadable)
        made.close()
    assert pq.read_table(tmp_path / "a.parquet").num_rows == 3


def blf_of(objects: bytes) -> bytes:
    """A Vector binary log of one compressed container."""
    packed = zlib.compress(objects, 1)
    head = struct.pack("<4sHHII", b"LOBJ", 16, 1, 32 + len(packed), 10) + struct.pack("<H6xI4x", 2, len(objects))
    return b"LOGG" + (144).to_bytes(4, "little") + bytes(136) + head + packed


def test_a_blf_that_unpacks_to_more_than_it_is_worth_is_refused_on_every_way_in(tmp_path: Path) -> None:
    file = tmp_path / "bomb.blf"
    file.write_bytes(blf_of(bytes(80 << 20)))
    most = (32 << 20) + 50 * file.stat().st_size
    for read in (read_record, read_log):
        tracemalloc.start()
        try:
            with pytest.raises(LogError, match=f"unpack to more than {most:,}"):
                read(file)
            assert tracemalloc.get_traced_memory()[1] < 3 * most
        finally:
            tracemalloc.stop()


def test_a_blf_with_an_object_of_no_size_ends(tmp_path: Path) -> None:
    """Of which python-can's reader makes no end; the frames before and behind it are there."""
    frame = struct.pack("<4sHHIIIHHQ", b"LOBJ", 32, 1, 48, 1, 2, 0, 0, 10) + struct.pack(
        "<HBBI8s", 1, 0, 8, 0x17C, b"ab"
    )
    nothing = struct.pack("<4sHHII", b"LOBJ", 16, 1, 0, 1) + bytes(32)
    (tmp_path / "a.blf").write_bytes(blf_of(frame + nothing + frame))
    assert (read_record(tmp_path / "a.blf").rows[:, 0] & 0x7FF).tolist() == [0x17C, 0x17C]


def test_a_recording_with_lines_that_are_no_frames_says_nothing_on_the_terminal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    good = ";$FILEVERSION=2.1\n;$COLUMNS=N,O,T,B,I,d,R,L,D\n1 10.0 DT 1 00A0 Rx - 8 00 01 02 03 04 05 06 07\n"
    (tmp_path / "a.trc").write_text(good + "no frame\n" * 100)
    assert len(read_record(tmp_path / "a.trc").ms) == 1
    assert not caplog.records and not capsys.readouterr().err
