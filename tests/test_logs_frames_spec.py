"""Logs of frames byte by byte: BLF objects and containers, lines of text, the order of time, signals and databases.

Files are put together here from the formats' own descriptions; what is read is compared with python-can, cantools, the
e2e library and closed forms.
"""

from __future__ import annotations

import re
import struct
import zlib
from pathlib import Path
from typing import Any

import can
import cantools
import e2e.p01
import numpy as np
import pytest

from hil.logs import Channel, LogError, plausible, read_log, write_log
from hil.logs.blf import read_blf
from hil.logs.bus_log import Bus, encode_channels
from hil.logs.candump import read_candump, write_candump
from hil.logs.dbc import MAX_DBC, Message, load_dbc
from hil.logs.frames import EXTENDED, Frames, in_order
from hil.logs.signals import crc_table, cut_raw, cut_signal, e2e_crc, encode, pgn, select
from hil.logs.source import Options
from hil.logs.text_lines import match_lines
from hil.logs.through_can import write_asc, write_blf, write_trc
from hil.logs.tool_traces import read_asc, read_trc
from vaneloop.base import tables

DBC = tables.path("vgv.dbc")
BY_NAME = {m.layout.name: m for m in load_dbc(DBC)[0]}


# ---- BLF -------------------------------------------------------------------------------------------------------------


CAN, CAN2, FD, FD64, CONTAINER, TEXT = 1, 86, 100, 101, 10, 65


def head(size: int = 144) -> bytes:
    return b"LOGG" + struct.pack("<I", size) + bytes(size - 8)


def obj(kind: int, body: bytes, ns: int = 0, version: int = 1, ticks: bool = False, size: int | None = None) -> bytes:
    """An object of Vector's: header of 32 or 40 bytes, then the body; ``ticks``: time in 10 us."""
    long = 40 if version == 2 else 32
    at = ns // 10_000 if ticks else ns
    out = struct.pack(
        "<4sHHIIIHHQ", b"LOBJ", long, version, size or long + len(body), kind, 1 if ticks else 2, 0, 0, at
    )
    return out + bytes(long - 32) + body


def classic(ident: int, data: bytes, bus: int = 1, flags: int = 0, dlc: int | None = None, more: int = 0) -> bytes:
    return struct.pack("<HBBI8s", bus, flags, len(data) if dlc is None else dlc, ident, data) + bytes(more)


def fd(ident: int, data: bytes, bus: int = 1, flags: int = 0, valid: int | None = None) -> bytes:
    return struct.pack(
        "<HBBIIBBBBI64s", bus, flags, 15, ident, 0, 0, 1, len(data) if valid is None else valid, 0, 0, data
    )


def fd64(
    ident: int, data: bytes, bus: int = 1, flags: int = 0, valid: int | None = None, ext: int = 0, room: int = 64
) -> bytes:
    """Of such an object only the bytes that count are there: ``room``."""
    return struct.pack(
        "<BBBBIIIIIIIHBBI", bus, 15, len(data) if valid is None else valid, 0, ident, 0, flags, 0, 0, 0, 0, 0, 0, ext, 0
    ) + data.ljust(room, b"\xee")[:room]  # fmt: skip


def container(body: bytes, method: int = 2, length: int | None = None) -> bytes:
    packed = zlib.compress(body) if method == 2 else body
    size = 32 + len(packed)
    out = struct.pack("<4sHHIIH6xI4x", b"LOBJ", 16, 1, size, CONTAINER, method, len(body) if length is None else length)
    return out + packed + bytes(size % 4)


def read(path: Path, *parts: bytes, first: bytes | None = None) -> Frames:
    (path / "a.blf").write_bytes((head() if first is None else first) + b"".join(parts))
    return read_blf(path / "a.blf")


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize(
    ("kind", "body", "remote", "longest"),
    [(CAN, classic, 0x80, 8), (CAN2, classic, 0x80, 8), (FD, fd, 0x80, 64), (FD64, fd64, 0x10, 64)],
)
def test_every_kind_of_object_is_decoded_as_vector_lays_it_out(
    tmp_path: Path, version: int, kind: int, body: Any, remote: int, longest: int
) -> None:
    data = bytes(range(1, longest + 1))
    objects = [
        obj(kind, body(0x123, data, bus=2), 1_000_000_000, version),
        obj(kind, body(0x1ABCDEF0 | 1 << 31, data[:3], bus=7), 1_000_010_000, version, ticks=True),
        obj(kind, body(0x124, data[:1], flags=remote), 1_000_020_000, version),
        obj(kind, body(0x125, b"", flags=0xFF ^ remote if kind != FD64 else 0xFF ^ 0x10), 1_000_030_007, version),
        obj(kind, body(0x6000_0126, data), 1_000_040_000, version),
    ]
    if longest == 64:
        objects.append(obj(FD, fd(0x127, b""), 2_000_000_000, version))
    frames = read(tmp_path, container(b"".join(objects)))
    assert frames.notes == []
    assert frames.ident[:4].tolist() == [0x123, EXTENDED | 0x1ABCDEF0, 0x125, 0x126]
    assert frames.length[:4].tolist() == [longest, 3, 0, longest]
    assert frames.bus[:4].tolist() == [2, 7, 1, 1]
    np.testing.assert_allclose(frames.t[:4], [0.0, 1e-5, 3.0007e-5, 4e-5], atol=1e-12)
    assert frames.data.shape[1] == longest
    assert [frames.data[k].tobytes() for k in range(4)] == [
        data, data[:3].ljust(longest, b"\0"), bytes(longest), data
    ]  # fmt: skip


def test_data_is_as_long_as_the_frame_says_with_zeros_where_none_is_stored(tmp_path: Path) -> None:
    data = bytes(range(1, 65))
    objects = [
        obj(CAN, classic(1, data[:8], dlc=15)), obj(FD, fd(2, data, valid=65)), obj(FD64, fd64(3, data, valid=200)),
        obj(FD64, fd64(4, data, valid=20, room=12)), obj(FD64, fd64(5, data, valid=20, ext=32 + 40 + 16)),
        obj(FD64, fd64(6, data, valid=8, ext=32 + 40 + 16)), obj(FD64, fd64(7, data, valid=20, ext=32 + 40)),
        obj(FD64, fd64(8, data, valid=20, ext=32)), obj(FD64, fd64(9, data[:4], valid=4, room=4)),
    ]  # fmt: skip
    frames = read(tmp_path, container(b"".join(objects)))
    assert dict(zip(frames.ident.tolist(), frames.length.tolist(), strict=True)) == {
        1: 8, 2: 64, 3: 64, 4: 20, 5: 20, 6: 8, 7: 20, 8: 0, 9: 4
    }  # fmt: skip
    stored = frames.length.tolist()
    stored[3], stored[4], stored[6] = 12, 16, 0  # zeros at the end of a frame need not be stored
    for n, row in zip(stored, frames.data, strict=True):
        assert row.tobytes() == data[:n].ljust(64, b"\0")
    only = read(tmp_path, container(obj(CAN, classic(1, b"\x01")) + obj(FD64, fd64(3, b"\x02\x03"))))
    assert only.data.shape == (2, 8) and only.data[1, :3].tolist() == [2, 3, 0]


def test_objects_of_other_kinds_versions_and_sizes_are_passed_over(tmp_path: Path) -> None:
    good = obj(CAN2, classic(0x321, b"\x01\x02", more=8), 5)
    others = [
        obj(TEXT, bytes(40)),
        obj(CAN, classic(1, b"\x01"), version=3),
        obj(CAN, classic(1, b"\x01")[:15]),
        obj(FD, fd(1, b"\x01")[:83]),
        obj(FD64, fd64(1, b"", room=0)[:39]),
        obj(CAN, classic(1, b"\x01")[:15], version=2),
    ]
    frames = read(tmp_path, container(b"".join(others) + good))
    assert frames.ident.tolist() == [0x321] and frames.notes == []
    shortest = [obj(CAN, classic(1, b"\x01")), obj(FD, fd(2, b"\x01")), obj(FD64, fd64(3, b"", room=0))]
    assert read(tmp_path, container(b"".join(shortest))).ident.tolist() == [1, 2, 3]


def test_frames_of_all_kinds_stay_in_the_order_of_the_file(tmp_path: Path) -> None:
    kinds = [(FD64, fd64), (CAN, classic), (FD, fd), (CAN2, classic), (CAN, classic), (FD64, fd64)]
    objects = [obj(kind, body(k, bytes([k])), 7, 1 + k % 2) for k, (kind, body) in enumerate(kinds)]
    frames = read(tmp_path, container(b"".join(objects)))
    assert frames.ident.tolist() == list(range(6)) and frames.data[:, 0].tolist() == list(range(6))


def test_containers_may_be_stored_split_an_object_or_hold_none_and_objects_may_stand_outside(tmp_path: Path) -> None:
    a, b = obj(CAN, classic(1, b"\x01")), obj(CAN, classic(2, b"\x02"), 10)
    assert read(tmp_path, container(a, 0), container(b, 2)).ident.tolist() == [1, 2]
    assert read(tmp_path, container((a + b)[:50]), container((a + b)[50:])).ident.tolist() == [1, 2]
    assert read(tmp_path, a, container(b), container(b"")).ident.tolist() == [1, 2]
    assert read(tmp_path, container(a), first=head(200)).ident.tolist() == [1]
    tiny = b"LOGG" + struct.pack("<I", 16) + bytes(136)  # a header is no shorter than 144 bytes
    assert read(tmp_path, container(a), first=tiny).ident.tolist() == [1]
    three = obj(CAN2, classic(1, b"\x01", more=1)) + bytes(1) + obj(CAN, classic(2, b"\x02"), 10)
    assert read(tmp_path, container(three)).notes == []  # a few bytes between objects fill up
    for odd in (b"\x01", b"\x01\x02", b"\x01\x02\x03"):  # and between containers, by the length of the one before
        body = a + odd
        assert read(tmp_path, container(body, 0), container(b, 0)).ident.tolist() == [1, 2]


@pytest.mark.parametrize(
    ("between", "places"),
    # an object of no size is a damaged place, and what lies behind its first word another
    [(bytes(8), 0), (bytes(9), 1), (b"LOBJ" + bytes(28), 2), (obj(CAN, b"", size=31), 2), (b"LOBJ" + bytes(8), 1)],
)
def test_damaged_places_between_objects_are_counted(tmp_path: Path, between: bytes, places: int) -> None:
    a, b = obj(CAN, classic(1, b"\x01")), obj(CAN, classic(2, b"\x02"), 10)
    frames = read(tmp_path, container(a + between + b))
    assert frames.ident.tolist() == [1, 2]
    assert frames.notes == ([f"{places} damaged places in the BLF: what is there was left out"] if places else [])


def test_a_damaged_container_costs_its_frames_and_is_counted(tmp_path: Path) -> None:
    a, b = obj(CAN, classic(1, b"\x01")), obj(CAN, classic(2, b"\x02"), 10)
    one = "1 damaged places in the BLF: what is there was left out"
    unknown = container(a, 3)
    assert (read(tmp_path, unknown, container(b)).ident.tolist(), read(tmp_path, unknown, container(b)).notes) == (
        [2],
        [one],
    )
    broken = bytearray(container(a))
    broken[34:50] = bytes(16)
    frames = read(tmp_path, bytes(broken), container(b))
    assert (frames.ident.tolist(), frames.notes) == ([2], [one])
    frames = read(tmp_path, b"junk" * 5, container(b))
    assert (frames.ident.tolist(), frames.notes) == ([2], [one])
    frames = read(tmp_path, struct.pack("<4sHHII", b"LOBJ", 16, 1, 15, CONTAINER), container(b))
    assert (frames.ident.tolist(), frames.notes) == ([2], [one])
    assert read(tmp_path, container(a), b"junk" * 5).notes == [one]
    whole = container(a + b, 0)
    cut = read(tmp_path, whole[:-3])
    assert (cut.ident.tolist(), cut.notes) == ([1], ["1 damaged places in the BLF: what is there was left out"]) or (
        cut.ident.tolist() == [1] and len(cut.notes) == 1
    )
    lying = read(tmp_path, container(a + b, 2, length=len(a)))  # holds more than it says
    assert lying.ident.tolist() == [1]
    assert read(tmp_path, container(a), b"LOBJ").ident.tolist() == [1]  # fifteen bytes are no object


def test_what_is_no_blf_is_refused(tmp_path: Path) -> None:
    for raw in (head()[:143], b"LOGF" + bytes(200)):
        (tmp_path / "a.blf").write_bytes(raw)
        with pytest.raises(LogError, match="must begin with LOGG and a header of 144 bytes"):
            read_blf(tmp_path / "a.blf")
    with pytest.raises(LogError, match="no CAN data frame in it"):
        read(tmp_path)
    with pytest.raises(LogError, match="no CAN data frame in it"):
        read(tmp_path, container(obj(TEXT, bytes(40))))
    with pytest.raises(LogError, match="no CAN data frame in it"):
        read(tmp_path, container(obj(CAN, classic(1, b"", flags=0x80))))  # a remote frame has no data


@pytest.mark.parametrize(
    ("more", "said"), [(0, "no CAN data frame"), (1, "unpack to more than 35,554,432; allowed: 50 times")]
)
def test_a_blf_unpacks_to_32_mib_and_fifty_times_its_size_at_most(tmp_path: Path, more: int, said: str) -> None:
    most = (32 << 20) + 50 * 40_000
    raw = head() + container(bytes(most + more))
    assert len(raw) < 40_000
    (tmp_path / "a.blf").write_bytes(raw + bytes(40_000 - len(raw)))
    with pytest.raises(LogError, match=said):
        read_blf(tmp_path / "a.blf")


def test_time_stamps_beyond_what_nanoseconds_can_say_stay_at_the_end(tmp_path: Path) -> None:
    late = obj(CAN, classic(1, b"\x01"), 2**64 - 1)
    assert read(tmp_path, container(obj(CAN, classic(2, b""), int(9e18)) + late)).t.tolist() == [0.0, 0.0]
    ticks = struct.pack("<4sHHIIIHHQ", b"LOBJ", 32, 1, 48, CAN, 1, 0, 0, 2**63)
    frames = read(tmp_path, container(obj(CAN, classic(2, b""), int(9e18)) + ticks + classic(1, b"")))
    assert frames.t.tolist() == [0.0, 0.0]


# ---- written as the formats want it ----------------------------------------------------------------------------------


def some(fd_too: bool = True) -> Frames:
    t = np.array([0.0, 0.0105, 1.000002, 1.5, 3.25])
    ident = np.array([0x12, 0x7FF, EXTENDED | 0x12, EXTENDED | 0x1FFFFFFF, 0x100], np.uint32)
    length = np.array([8, 0, 3, 7, 12 if fd_too else 5], np.uint8)
    data = np.zeros((5, 64 if fd_too else 8), np.uint8)
    for k, n in enumerate(length):
        data[k, :n] = 10 * k + np.arange(n)
    return Frames(t, ident, np.zeros(5, np.int32), length, data)


@pytest.mark.parametrize(
    ("suffix", "write"), [(".asc", write_asc), (".blf", write_blf), (".trc", write_trc), (".log", write_candump)]
)
def test_what_is_written_python_can_reads_frame_by_frame(tmp_path: Path, suffix: str, write: Any) -> None:
    given = some(fd_too=suffix in (".asc", ".blf"))
    write(tmp_path / f"a{suffix}", given)
    got = list(can.LogReader(tmp_path / f"a{suffix}"))
    assert [m.arbitration_id | (EXTENDED if m.is_extended_id else 0) for m in got] == given.ident.tolist()
    assert [bytes(m.data) for m in got] == [d[:n].tobytes() for d, n in zip(given.data, given.length, strict=True)]
    np.testing.assert_allclose([m.timestamp - got[0].timestamp for m in got], given.t, atol=1.1e-6)
    assert [m.is_fd for m in got] == (given.length > 8).tolist()


def test_candump_lines_are_written_to_the_microsecond(tmp_path: Path) -> None:
    write_candump(tmp_path / "a.log", some(fd_too=False))
    assert (tmp_path / "a.log").read_text() == (
        "(0000000000.000000) vcan0 012#0001020304050607\n(0000000000.010500) vcan0 7FF#\n"
        "(0000000001.000002) vcan0 00000012#141516\n(0000000001.500000) vcan0 1FFFFFFF#1E1F2021222324\n"
        "(0000000003.250000) vcan0 100#28292A2B2C\n"
    )


# ---- lines of text ---------------------------------------------------------------------------------------------------


def text(path: Path, suffix: str, *lines: str) -> Path:
    file = path / f"a{suffix}"
    file.write_text("\n".join(lines) + "\n")
    return file


def test_candump_identifiers_end_where_their_kind_ends(tmp_path: Path) -> None:
    frames = read_candump(text(
        tmp_path, ".log",
        "(1.0) can0 7FF#01", "(1.0) can0 800#02", "(1.0) can0 1FFFFFFF#03", "(1.0) can0 20000000#04",
        "(1.0) can0 20000080#05", "(1.0) can0 00000001#06", "(1.0) can0 001#R", "(1.0) can0 001#R5",
        "(1.0)  can0  001   [2]  remote request", "(1.0) can0 001#", "(1.0) RX can0 001#",
    ))  # fmt: skip
    assert frames.ident.tolist() == [0x7FF, EXTENDED | 0x1FFFFFFF, EXTENDED | 1, 1]
    assert frames.length.tolist() == [1, 1, 1, 0]
    assert frames.notes == ["1 lines are not candump lines: left out", "6 remote or error frames: left out"]


def test_candump_forms_and_buses_are_told_apart(tmp_path: Path) -> None:
    frames = read_candump(
        text(
            tmp_path,
            ".log",
            "(10.5) can0 123#1122334455667788",
            "(10.500001) can1 123##1" + "AB" * 64,
            "(10.50001)  can0  123   [08]  11 22 33 44 55 66 77 88",
            "(10.500020) can0 123#112233445566778899",
            "(10.500030) vcan2 123##0AABB T",
            "(10.500040) can0 RX - - 123   [2]  0A 0b",
            "(10.500050)  can1  RX - -  123   [2]  0A 0b",
            "(10.500060) can0 123#11_9 R",
            "DROPCOUNT: dropped 3 CAN frames on 'can0' socket (total drops 3)",
            "DROPCOUNT: dropped 1 CAN frame on 'can1' socket",
            "DROPCOUNT: dropped 2000 CAN frames on 'can0' socket",
            "# a comment",
            "",
        )
    )
    names = ["can0", "can1", "can0", "can0", "vcan2", "can0", "can1", "can0"]
    number = dict(zip(names, frames.bus.tolist(), strict=True))
    assert sorted(number.values()) == [0, 1, 2] and frames.bus.tolist() == [number[n] for n in names]
    assert frames.length.tolist() == [8, 64, 8, 8, 2, 2, 2, 1]
    np.testing.assert_allclose(frames.t, [0, 1e-6, 1e-5, 2e-5, 3e-5, 4e-5, 5e-5, 6e-5], atol=1e-9)
    assert frames.data.shape[1] == 64 and frames.data[5, :2].tolist() == [0x0A, 0x0B]
    assert frames.notes == [
        "the logger dropped 2,003 frames of can0 (DROPCOUNT)", "the logger dropped 1 frames of can1 (DROPCOUNT)"
    ]  # fmt: skip


def test_lines_of_one_length_and_many_layouts_are_all_read(tmp_path: Path) -> None:
    """More layouts of one length than there are rounds, and other lines of that length between."""
    lines, want, bad = [], [], 0
    for k in range(40):
        lines.append(f"(100.{k:06d}) {chr(97 + k % 26)}{chr(97 + k // 26)}n 12{k % 10}#{k:02X}")
        want.append((0x120 + k % 10, k))
        lines.append(f"(100.{k:06d}) {chr(97 + k % 26)}{chr(97 + k // 26)}n 12{k % 10}.{k:02X}")
        bad += 1
        lines.append(f"(10x.{k:06d}) can 123#{k:02X}")  # as long, but a letter for a digit
        bad += 1
    frames = read_candump(text(tmp_path, ".log", *lines))
    assert list(zip(frames.ident.tolist(), frames.data[:, 0].tolist(), strict=True)) == want
    assert frames.notes == [f"{bad} lines are not candump lines: left out"]
    assert np.unique(frames.bus).size == 40
    np.testing.assert_allclose(frames.t, np.arange(40) * 1e-6, atol=1e-9)


def test_a_line_of_six_hundred_bytes_is_read_and_a_longer_one_is_none() -> None:
    layout = re.compile(rb"\((?P<s> *\d{1,10})\)(?P<tail>.*)\Z", re.S)
    raw = b"\n".join(
        [b"(" + b"7" * 3 + b")" + b"x" * n for n in (595, 596)] + [b"(12)\r", b"", b"other", b"(1x)", b"(9)"]
    )
    *lines, bad = match_lines(raw, layout, b"(")
    assert [len(part.start) for part in lines] == [1, 1, 1] and bad == 2  # one too long, one that does not match
    assert sorted(int(part.number("s")[0]) for part in lines) == [9, 12, 777]
    padded = b"(   1)\n(  23)\n( 2 3)\n(4 56)\n( 789)\n(    )"
    *lines, bad = match_lines(padded, layout, b"(")
    assert sorted(int(n) for part in lines for n in part.number("s")) == [1, 23, 789] and bad == 3


def test_hex_digits_of_both_cases_are_one_layout(tmp_path: Path) -> None:
    digits = "0123456789abcdefABCDEF"
    lines = [
        f"(1.{k:06d}) can0 {a}{b}{a}#{b}{a}"
        for k, (a, b) in enumerate((a, b) for a in "0123456789abcdefABCDEF"[:8] for b in digits)
    ]
    frames = read_candump(text(tmp_path, ".log", *lines))
    want = [(int(line[16:19], 16), int(line[20:22], 16)) for line in lines]
    assert list(zip(frames.ident.tolist(), frames.data[:, 0].tolist(), strict=True)) == want


@pytest.mark.parametrize(
    ("line", "want"),
    [
        ("   0.010000 1  123             Rx   d 3 01 02 03  Length = 1", (0x123, 1, "010203")),
        ("   0.010000 2  1ABCDEFx        Tx   d 2 0a 0B", (EXTENDED | 0x1ABCDEF, 2, "0a0b")),
        ("   0.010000 1  7FF             Rx   d 9 01 02 03 04 05 06 07 08 09", (0x7FF, 1, "0102030405060708")),
        ("   0.010000 1  7FF             Rx   d f 01 02 03 04 05 06 07 08 09", (0x7FF, 1, "0102030405060708")),
        ("   0.010000 1  123             Rx   d 2 01 02 03", (0x123, 1, "0102")),
        (
            "   0.010000 CANFD   3 Rx        123  1 0 9 12 01 02 03 04 05 06 07 08 09 0A 0B 0C  0 0",
            (0x123, 3, "0102030405060708090a0b0c"),
        ),
        (
            "   0.010000 CANFD   3 Rx        1ABx Name  1 0 9 12 01 02 03 04 05 06 07 08 09 0A 0B 0C  0",
            (EXTENDED | 0x1AB, 3, "0102030405060708090a0b0c"),
        ),
        (
            "   0.010000 CANFD   3 Rx        123  1 0 a 8 01 02 03 04 05 06 07 08 09 0A 0B 0C  0 0",
            (0x123, 3, "0102030405060708"),
        ),
        ("   0.010000 1  800             Rx   d 1 01", None),
        ("   0.010000 1  20000000x       Rx   d 1 01", None),
        ("   0.010000 1  123             Rx   r 1", None),
        ("   0.010000 1  ErrorFrame", None),
    ],
)
def test_lines_of_asc_are_read_and_others_are_none(
    tmp_path: Path, line: str, want: tuple[int, int, str] | None
) -> None:
    first = "   0.000000 1  001             Rx   d 0"
    frames = read_asc(text(tmp_path, ".asc", "date x", "base hex  timestamps absolute", first, line, "Begin"))
    assert frames.t.size == 1 + (want is not None) and frames.notes == []
    if want:
        ident, bus, data = want
        assert (frames.ident[1], frames.bus[1]) == (ident, bus)
        assert frames.data[1, : frames.length[1]].tobytes().hex() == data
        assert frames.t[1] == pytest.approx(0.01, abs=1e-12)


def test_asc_in_decimal_is_refused_and_relative_times_add_up_over_every_event(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="has its numbers in base dec; allowed: base hex"):
        read_asc(text(tmp_path, ".asc", "base dec", "   0.010000 1  123             Rx   d 1 01"))
    with pytest.raises(LogError, match="no ASC frame in it; a line looks like: 0.010000 1 A0"):
        read_asc(text(tmp_path, ".asc", "base hex"))
    frame = "   {:.6f} 1  123             Rx   d 1 01"
    relative = [
        "base hex timestamps relative",
        frame.format(0.5),
        "   0.250000 Start of measurement",
        frame.format(0.125),
    ]
    np.testing.assert_allclose(read_asc(text(tmp_path, ".asc", *relative)).t, [0.0, 0.375], atol=1e-9)
    absolute = [relative[0].replace("relative", "absolute"), frame.format(0.5), frame.format(0.625)]
    np.testing.assert_allclose(read_asc(text(tmp_path, ".asc", *absolute)).t, [0.0, 0.125], atol=1e-9)


@pytest.mark.parametrize(
    ("head", "line", "want"),
    [
        ("", "     1)     0.5  0123  2  01 02", (0x123, 1, "0102")),
        ("", "     1)     0.5  00000123  2  01 02", (EXTENDED | 0x123, 1, "0102")),
        ("", "     1)     0.5  1234  1  01", None),
        (";$FILEVERSION=1.2", "     1)     0.500 3  Rx         0123  2  01 02", (0x123, 3, "0102")),
        (
            ";$FILEVERSION=1.1",
            "     1)     0.5  Tx         07FF  9  01 02 03 04 05 06 07 08 09 0A 0B 0C",
            (0x7FF, 1, "0102030405060708090a0b0c"),
        ),
        (
            ";$FILEVERSION=2.0\n;$COLUMNS=N,O,T,I,d,l,D",
            "      1         0.500 FD     0123 Rx 9  01 02 03 04 05 06 07 08 09",
            (0x123, 1, "010203040506070809"),
        ),
        *[
            (
                ";$FILEVERSION=2.1\n;$COLUMNS=N,O,T,B,I,d,R,L,D",
                f"      1         0.500 FB 2     0123 Rx -  {code}    " + "AB " * 64,
                (0x123, 2, "ab" * n),
            )
            for code, n in ((8, 8), (9, 12), (10, 16), (11, 20), (12, 24), (13, 32), (14, 48), (15, 64), (16, 64))
        ],
        (";$FILEVERSION=2.1\n;$COLUMNS=N,O,T,B,I,d,R,L,D", "      1         0.500 ST 2     0123 Rx -  1    01", None),
        (";$FILEVERSION=2.1\n;$COLUMNS=N,O,T,B,I,d,R,L,D", "      1         0.500 DT 2     0123 Rx -  4  RTR", None),
    ],
)
def test_lines_of_trc_are_read_by_their_columns(
    tmp_path: Path, head: str, line: str, want: tuple[int, int, str] | None
) -> None:
    if want is None:
        with pytest.raises(LogError, match="no TRC frame in it; a line looks like: 1\\)"):
            read_trc(text(tmp_path, ".trc", head, line))
        return
    frames = read_trc(text(tmp_path, ".trc", head, line.replace("0.5", "0.0"), line))
    ident, bus, data = want
    assert (frames.ident[1], frames.bus[1]) == (ident, bus)
    assert frames.data[1, : frames.length[1]].tobytes().hex() == data
    np.testing.assert_allclose(frames.t, [0.0, 0.0005], atol=1e-12)


@pytest.mark.parametrize(
    ("head", "said"),
    [
        (";$FILEVERSION=3.0", "TRC version 3.0 is not known; allowed: 1.0, 1.1, 1.2, 1.3, 2.0, 2.1"),
        (";$COLUMNS=N,O,I,Z,L,D", "TRC columns OIZLD are not understood"),
        (";$COLUMNS=N,O,I,I,L,D", "are not understood"),
        (";$COLUMNS=N,O,L,D", "are not understood"),
        (";$COLUMNS=N,I,L,D", "are not understood"),
        (";$COLUMNS=N,O,I,D,L", "are not understood; allowed: O, T, B, I, d, R, L, l, and D last"),
        (";$COLUMNS=N,O,I,D", "must have one of L and l"),
        (";$COLUMNS=N,O,I,L,l,D", "must have one of L and l"),
    ],
)
def test_columns_of_trc_that_are_not_understood_are_refused(tmp_path: Path, head: str, said: str) -> None:
    with pytest.raises(LogError, match=said.replace("(", "\\(")):
        read_trc(text(tmp_path, ".trc", head, "1 0.5 0123 1 01"))


# ---- order of time ---------------------------------------------------------------------------------------------------


def ordered(t: Any) -> tuple[list[float], list[str]]:
    notes: list[str] = []
    given = np.asarray(t)
    out, order = in_order("log", given, notes)
    return out[order].tolist(), notes


def test_frames_may_come_fifty_milliseconds_late() -> None:
    assert ordered(np.array([5, 1_000_000_005], np.int64)) == ([0.0, 1.0], [])
    base = np.arange(40) * 0.1
    late = base.copy()
    late[20] = base[19] - 0.0499
    t, notes = ordered(late)
    assert t == sorted(late) and notes == ["1 frames out of order by up to 49.9 ms: sorted by time"]
    late[20] = base[19] - 0.0501
    t, notes = ordered(late)
    assert len(t) == 39 and notes == [
        f"time: 1 of 40 frames have a wrong time stamp (first frame 21: {late[20]:.9g} s from the first): left out"
    ]
    mixed = base.copy()
    mixed[[5, 20]] = base[4] - 0.01, 0.0
    t, notes = ordered(mixed)
    assert len(t) == 39 and len(notes) == 2 and "1 frames out of order by up to 10 ms" in notes[1]


def test_a_clock_that_falls_at_every_third_frame_counts_from_frame_to_frame() -> None:
    for n, falls, fine in ((100, 30, True), (100, 31, False), (10, 4, True), (11, 4, False)):
        t = np.arange(n) * 1e-6
        for k in range(falls):
            t[2 * k : 2 * k + 2] = t[2 * k : 2 * k + 2][::-1].copy()
        if fine:
            assert ordered(t)[0] == sorted(t)
        else:
            with pytest.raises(LogError, match=f"time runs backwards at {falls} of {n} frames; it must count from one"):
                ordered(t)
    with pytest.raises(LogError, match="time of frame 3 is not a number"):
        ordered(np.array([0.0, 1.0, np.nan, 2.0]))
    half = np.concatenate([np.arange(60.0), 30.0 + np.arange(60.0)])
    with pytest.raises(LogError, match=r"time runs backwards by 29 s at frame 61; allowed: up to 50 ms \(sorted\)"):
        ordered(half)
    assert ordered(np.empty(0))[0] == []


# ---- frames of a message ---------------------------------------------------------------------------------------------


def frames_of(ident: Any, data: np.ndarray, length: int | None = None, bus: Any = 0) -> Frames:
    n, w = data.shape
    wide = 8 if w <= 8 else 64
    ids = np.broadcast_to(np.asarray(ident, np.uint32), n)
    return Frames(
        np.arange(n) * 0.01, ids, np.broadcast_to(np.asarray(bus, np.int32), n), np.full(n, length or w, np.uint8),
        np.pad(data, ((0, 0), (0, wide - w))),
    )  # fmt: skip


def layouts(text: str, strict: bool = True) -> Any:
    """Messages of a database, as cantools has them."""
    return cantools.database.load_string(text, "dbc", strict=strict).messages  # type: ignore[union-attr]


def message(signals: str, length: int = 8, ident: int = 0x123, name: str = "M", **more: Any) -> Message:
    text = f'VERSION ""\nBU_: A\nBO_ {ident} {name}: {length} A\n{signals}\n'
    layout = layouts(text, strict=False)[0]
    number = layout.frame_id | (EXTENDED if layout.is_extended_frame else 0)
    return Message(layout, number, more.get("e2e"), more.get("j1939", False), more.get("missing", {}))


def test_a_parameter_group_is_an_identifier_without_priority_source_and_destination() -> None:
    """J1939-21: below 240 the PDU's specific part is a destination, from 240 on it belongs to the group."""
    for pf in (0x00, 0xEE, 0xEF, 0xF0, 0xFE, 0xFF):
        for page in (0, 1, 2, 3):
            group = page << 16 | pf << 8 | (0x34 if pf >= 240 else 0)
            for priority, source in ((0, 0), (7, 0xFF), (3, 0x17)):
                assert int(pgn(priority << 26 | page << 24 | pf << 16 | 0x34 << 8 | source)) == group


def test_the_exact_identifier_goes_before_its_group_and_one_sender_is_taken() -> None:
    m = message(' SG_ a : 0|8@1+ (1,0) [0|0] "" A', ident=EXTENDED | 0x0CF00400)
    data = np.arange(8, dtype=np.uint8)[:, None].repeat(8, axis=1)
    others = [EXTENDED | 0x18F00417, EXTENDED | 0x18F00418, 0x400]
    rows, notes = select(frames_of([m.ident, *others[:1] * 7], data), m)
    assert rows.tolist() == [0] and notes == []
    rows, notes = select(
        frames_of([*others, others[1], others[1], others[0], 0x18F00417, EXTENDED | 0x18F00501], data), m
    )
    assert rows.tolist() == [1, 3, 4] and notes == ["M: 2 senders or buses; took 0x18F00418 (3 of 5 frames)"]
    rows, notes = select(frames_of(m.ident, data, bus=[0, 1, 1, 0, 1, 2, 0, 1]), m)
    assert rows.tolist() == [1, 2, 4, 7] and notes == ["M: 3 senders or buses; took 0xCF00400 (4 of 8 frames)"]
    standard = message(' SG_ a : 0|8@1+ (1,0) [0|0] "" A', ident=0x400)
    assert select(frames_of([EXTENDED | 0x400] * 8, data), standard) == (pytest.approx(np.empty(0)), [])
    two = message(' SG_ a : 0|8@1+ (1,0) [0|0] "" A', length=7, ident=0x400)
    lengths = frames_of(0x400, data)
    lengths.length[:] = [8, 7, 6, 0, 7, 7, 8, 8]
    rows, notes = select(lengths, two)
    assert rows.tolist() == list(range(8))
    assert notes == ["M: 2 of 8 frames are shorter than its 7 bytes: read as far as they reach"]


@pytest.mark.parametrize("length", [2, 5, 8, 12, 64])
def test_frames_of_any_length_are_checked_by_the_crc_of_e2e_profile_one(length: int) -> None:
    rng = np.random.default_rng(length)
    data = rng.integers(0, 256, (50, length)).astype(np.uint8)
    data_id = 0x56A0

    def slow(row: bytes) -> int:  # SAE J1850, bit by bit: polynomial 0x1D, as AUTOSAR starts and ends it
        crc = 0
        for byte in (data_id & 0xFF, data_id >> 8, *row[1:]):
            crc ^= byte
            for _ in range(8):
                crc = (crc << 1 ^ 0x1D if crc & 0x80 else crc << 1) & 0xFF
        return crc

    want = [slow(row.tobytes()) for row in data]
    assert e2e_crc(data, data_id).tolist() == want
    data[:, 0] = want
    data[[3, 7], 0] ^= 1
    m = message(' SG_ a : 8|4@1+ (1,0) [0|0] "" A', length=length, e2e=data_id)
    rows, notes = select(frames_of(0x123, data), m)
    assert rows.tolist() == [k for k in range(50) if k not in (3, 7)]
    assert notes == ["M: 2 of 50 frames have a wrong CRC: left out"]
    assert crc_table()[:4].tolist() == [0x00, 0x1D, 0x3A, 0x27]


# ---- signals ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("length", [1, 3, 4, 7, 8, 9, 16, 31, 33, 52, 63, 64])
@pytest.mark.parametrize("order", [0, 1])
@pytest.mark.parametrize("signed", ["+", "-"])
def test_every_length_place_and_order_of_bits_is_as_cantools_has_it(length: int, order: int, signed: str) -> None:
    rng = np.random.default_rng(length)
    data = rng.integers(0, 256, (12, 8)).astype(np.uint8)
    data[0], data[1] = 0, 255
    for first in {0, min(5, 64 - length), 64 - length}:
        start = 8 * (first // 8) + 7 - first % 8 if order == 0 else first
        m = message(f' SG_ a : {start}|{length}@{order}{signed} (0.5,-3) [0|0] "" A')
        (s,) = m.layout.signals
        theirs = np.array([m.layout.decode(row.tobytes(), scaling=False)["a"] for row in data], object)
        assert cut_raw(data, s).tolist() == theirs.tolist()
        for wide in (data, np.pad(data, ((0, 0), (0, 4)))):  # of eight bytes compiled, of more by columns
            rows, values, missing = cut_signal(frames_of(0x123, wide), np.arange(12), m, s)
            assert rows.tolist() == list(range(12)) and missing == 0
            np.testing.assert_allclose(values, theirs.astype(float) * 0.5 - 3.0, rtol=1e-15)
        if length <= 52:
            again = encode(m, {"a": theirs.astype(float) * 0.5 - 3.0}, 12)
            assert cut_raw(again, s).tolist() == theirs.tolist()
            assert [m.layout.encode({"a": float(v) * 0.5 - 3.0}, strict=False) for v in theirs] == [
                row.tobytes() for row in again
            ]


@pytest.mark.parametrize(("kind", "length"), [(1, 32), (2, 64)])
def test_ieee_numbers_are_cut_and_not_written(kind: int, length: int) -> None:
    values = np.array([0.0, 1.5, -2.25, 1e10])
    data = values.astype(f"<f{length // 8}").view(np.uint8).reshape(4, -1)
    text = (
        f'VERSION ""\nBU_: A\nBO_ 291 M: 8 A\n SG_ a : 0|{length}@1- (2,1) [0|0] "" A\nSIG_VALTYPE_ 291 a : {kind};\n'
    )
    layout = layouts(text)[0]
    m = Message(layout, 291, None, False, {})
    rows, got, _ = cut_signal(
        frames_of(291, np.pad(data, ((0, 0), (0, 8 - data.shape[1])))), np.arange(4), m, layout.signals[0]
    )
    np.testing.assert_allclose(got, 2.0 * values.astype(f"f{length // 8}").astype(float) + 1.0, rtol=1e-15)
    assert (encode(m, {}, 2) == 0).all()
    with pytest.raises(LogError, match=f"a: its {length} bits in M cannot be written; allowed: 52-bit integers"):
        encode(m, {"a": values}, 4)


def test_a_raw_value_that_means_not_available_is_left_out_and_counted() -> None:
    data = np.zeros((5, 8), np.uint8)
    data[:, 0] = [1, 255, 3, 255, 5]
    more: dict[str, Any]
    for more in ({}, {"j1939": True}):
        m = message(' SG_ a : 0|8@1+ (1,0) [0|0] "" A', missing={"a": 255}, **more)
        for wide in (data, np.pad(data, ((0, 0), (0, 4)))):
            rows, values, missing = cut_signal(frames_of(0x123, wide), np.arange(5), m, m.layout.signals[0])
            assert (rows.tolist(), values.tolist(), missing) == ([0, 2, 4], [1, 3, 5], 2)


@pytest.mark.parametrize(
    ("length", "there"),
    [
        (2, [0, 1, 2, 3]),
        (3, [5, 6, 7]),
        (4, [13, 14]),
        (7, [125, 126]),
        (8, [0xFC, 0xFD]),
        (16, [0xFDFF]),
        (32, [0xFDFFFFFF]),
    ],
)
def test_the_top_of_a_j1939_signal_means_error_or_not_available(length: int, there: list[int]) -> None:
    """J1939-71: of a byte and more 0xFE.. and 0xFF.., of 4 to 7 bits all ones, of fewer nothing."""
    full = (1 << length) - 1
    tops = [full] if 4 <= length < 8 else [0xFE << length - 8, full] if length >= 8 else []
    raw = np.array([*there, *tops], np.uint64)
    data = raw.view(np.uint8).reshape(-1, 8)
    for sign in "+-":
        m = message(f' SG_ a : 0|{length}@1{sign} (1,0) [0|0] "" A', j1939=True)
        rows, _, missing = cut_signal(frames_of(0x123, data), np.arange(raw.size), m, m.layout.signals[0])
        assert rows.tolist() == list(range(len(there))) and missing == len(tops)


NESTED = """ SG_ top M : 0|4@1+ (1,0) [0|15] "" A
 SG_ sub m1M : 4|4@1+ (1,0) [0|15] "" A
 SG_ a m2 : 8|8@1+ (1,0) [0|0] "" A
 SG_ b m1 : 8|8@1+ (1,0) [0|0] "" A
 SG_ far : 48|16@1+ (1,0) [0|0] "" A"""


def test_a_signal_is_in_frames_whose_selectors_say_so_and_that_are_long_enough() -> None:
    text = (
        f'VERSION ""\nBU_: A\nBO_ 291 M: 8 A\n{NESTED}\nSG_MUL_VAL_ 291 sub top 1-1;\n'
        "SG_MUL_VAL_ 291 a sub 2-2, 5-5;\nSG_MUL_VAL_ 291 b top 3-3;\n"
    )
    layout = layouts(text)[0]
    m = Message(layout, 291, None, False, {})
    data = np.zeros((6, 8), np.uint8)
    data[:, 0] = [0x21, 0x51, 0x22, 0x31, 0x03, 0x53]
    data[:, 1] = 10 + np.arange(6)
    frames = frames_of(291, data)
    assert cut_signal(frames, np.arange(6), m, layout.get_signal_by_name("a"))[0].tolist() == [0, 1]
    assert cut_signal(frames, np.arange(6), m, layout.get_signal_by_name("b"))[1].tolist() == [14, 15]
    frames.length[:] = [8, 7, 2, 1, 2, 1]
    assert cut_signal(frames, np.arange(6), m, layout.get_signal_by_name("b"))[0].tolist() == [4]
    assert cut_signal(frames, np.arange(6), m, layout.get_signal_by_name("far"))[0].tolist() == [0]
    wide = message(' SG_ a : 72|8@1+ (1,0) [0|0] "" A', length=12)
    rows, values, missing = cut_signal(frames, np.arange(6), wide, wide.layout.signals[0])
    assert rows.size == values.size == missing == 0


def test_what_a_frame_cannot_hold_is_refused_with_what_it_holds() -> None:
    status = BY_NAME["VGV_ANGLES"]
    (s,) = [s for s in status.layout.signals if s.name == "vigv"]
    low, high = -32767 * float(s.scale), 32767 * float(s.scale)
    assert encode(status, {"vigv": np.array([low, high, np.nan])}, 3).shape == (3, 8)
    for value in (high + 0.51 * float(s.scale), low - 0.51 * float(s.scale)):  # the lowest means not available
        with pytest.raises(
            LogError, match=rf"vigv \(={value:g} deg\): does not fit VGV_ANGLES, which holds -65.536 to 65.534"
        ):
            encode(status, {"vigv": np.array([0.0, value])}, 2)
    plain = message(' SG_ a : 0|4@1+ (-2,1) [0|0] "" A')
    assert encode(plain, {"a": np.array([1.0, -29.0])}, 2)[:, 0].tolist() == [0, 15]
    with pytest.raises(LogError, match=r"a \(=-31 \): does not fit M, which holds -29 to 1; a table format"):
        encode(plain, {"a": np.array([-31.0])}, 1)
    assert encode(plain, {"a": np.array([np.nan])}, 1)[0, 0] == 0  # nothing means not available: 0


def test_counters_run_to_fourteen_and_crcs_are_those_of_the_library() -> None:
    demand = BY_NAME["ECU_DEMAND"]
    data = encode(demand, {"n_dem": np.linspace(0.0, 100.0, 32)}, 32)
    assert (data[:, 1] & 15).tolist() == [(k + 1) % 15 for k in range(32)]
    for row in data:
        assert e2e.p01.e2e_p01_check(bytearray(row.tobytes()), demand.e2e or 0)
    assert demand.missing == {"mode_request": 3, "n_dem": 65535, "n_r": 65535} and demand.e2e == 22176


# ---- a log seen through a database -----------------------------------------------------------------------------------


def bus_of(frames: Frames, *messages: Message) -> Bus:
    return Bus(frames, list(messages), ["of the database"], Path("my.dbc"))


def test_a_bus_names_what_its_log_has_and_what_it_lacks() -> None:
    here = message(' SG_ a : 0|8@1+ (1,0) [0|0] "mm" A\n SG_ b : 8|8@1+ (1,0) [0|0] "" A', missing={"b": 0})
    group = message(' SG_ c : 0|8@1+ (1,0) [0|0] "" A', ident=EXTENDED | 0x0CF00400, name="G")
    gone = message(' SG_ d : 0|8@1+ (1,0) [0|0] "" A', ident=0x456, name="H")
    far = message(' SG_ e : 0|8@1+ (1,0) [0|0] "" A', ident=EXTENDED | 0x0CF00500, name="J")
    data = np.zeros((4, 8), np.uint8)
    data[:, 0] = np.arange(4)
    bus = bus_of(frames_of([0x123, 0x123, EXTENDED | 0x18F00417, 0x123], data), here, group, gone, far)
    assert bus.names == {"M.a": ("M.a", "a"), "M.b": ("M.b", "b"), "G.c": ("G.c", "c")}
    assert bus.has() == "; the file has 3 signals: M.a, M.b, G.c"
    assert bus.absent("d") == bus.absent("H.d") == "my.dbc has it in H (0x456), but the log has no such frame"
    assert (
        bus.absent("J.e") == "my.dbc has it in J (0xCF00500), but the log has no such frame" and bus.absent("a") == ""
    )
    a = bus.series("M.a")
    assert (a.unit, a.framed, a.values.tolist()) == ("mm", True, [0, 1, 3])
    np.testing.assert_allclose(a.t, [0.0, 0.01, 0.03])
    assert (
        bus.series("M.b").values.size == 0 and bus.absent("b") == bus.absent("M.b") == "all 3 frames say not available"
    )
    data[0, 1] = 7
    part = bus_of(frames_of(0x123, data), here)
    assert part.series("M.b").values.tolist() == [7]
    assert part.notes == ["of the database", "M.b: 3 frames say not available: left out"]
    assert bus_of(frames_of([0x20, 0x10, 0x10, 0x30], data), here).has() == (
        "; my.dbc has no message for the log's 3 identifiers (0x10, 0x20, 0x30): --dbc F"
    )
    many = bus_of(frames_of(np.arange(1, 10), np.zeros((9, 8), np.uint8)), here).has()
    assert "9 identifiers (0x1, 0x2, 0x3, 0x4, 0x5, 0x6, 0x7, 0x8, ...): --dbc F" in many
    eight = bus_of(frames_of(np.arange(1, 9), np.zeros((8, 8), np.uint8)), here).has()
    assert "(0x1, 0x2, 0x3, 0x4, 0x5, 0x6, 0x7, 0x8): --dbc F" in eight


def sent(channels: dict[str, Channel], name: str, signal: str) -> tuple[np.ndarray, np.ndarray]:
    """Times and values of a signal as the frames carry it, by cantools; NaN: not available."""
    frames = encode_channels(channels, DBC, Path("x.log"))
    m = BY_NAME[name]
    rows = np.flatnonzero(frames.ident == m.ident)
    raw = [m.layout.decode(frames.data[r].tobytes(), scaling=False)[signal] for r in rows]
    s = m.layout.get_signal_by_name(signal)
    values = [np.nan if v == m.missing[signal] else v * float(s.scale) + float(s.offset) for v in raw]
    return frames.t[rows], np.array(values)


def test_a_value_is_repeated_for_three_frames_or_three_of_its_steps() -> None:
    t = np.array([0.0, 0.01, 0.021, 0.20, 0.211])
    at, values = sent(
        {"x_dem": Channel(t, np.arange(5.0)), "x_lvdt": Channel(0.01 * np.arange(30), np.ones(30))},
        "VGV_STATUS",
        "x_dem",
    )
    there = ~np.isnan(values)
    np.testing.assert_allclose(at[there], [0.0, 0.01, 0.02, 0.03, 0.04, 0.05, 0.20, 0.21, 0.22, 0.23, 0.24], atol=1e-9)
    np.testing.assert_allclose(values[there], [0, 1, 1, 2, 2, 2, 3, 3, 4, 4, 4], atol=0.001)
    slow = Channel(np.array([0.0, 0.05, 0.10, 0.40]), np.array([1.0, 2.0, 3.0, 4.0]))
    at, values = sent({"x_dem": slow}, "VGV_STATUS", "x_dem")  # its step is 50 ms: held for 150 ms
    np.testing.assert_allclose(at, [*np.arange(0.0, 0.255, 0.01), 0.40], atol=1e-9)
    single = sent(
        {"x_dem": Channel(np.zeros(1), np.ones(1)), "x_lvdt": Channel(0.01 * np.arange(9), np.ones(9))},
        "VGV_STATUS",
        "x_dem",
    )
    assert np.isnan(single[1]).tolist() == [False] * 4 + [True] * 5


def test_the_current_in_a_frame_is_the_mean_of_its_samples_since_the_frame_before() -> None:
    t = 0.0025 * np.arange(20)
    current = np.arange(20.0)
    at, values = sent({"i_cmd": Channel(t, current)}, "VGV_SERVO", "i_cmd")
    np.testing.assert_allclose(at, [0.0, 0.01, 0.02, 0.03, 0.04], atol=1e-9)
    np.testing.assert_allclose(
        values, [0.0, *(np.mean(current[4 * k - 3 : 4 * k + 1]) for k in (1, 2, 3, 4))], atol=0.001
    )
    one = sent({"i_cmd": Channel(0.01 * np.arange(4), np.array([1.0, 5.0, 2.0, 8.0]))}, "VGV_SERVO", "i_cmd")[1]
    np.testing.assert_allclose(one, [1.0, 5.0, 2.0, 8.0], atol=0.001)
    stroke = sent({"x_dem": Channel(t, current)}, "VGV_STATUS", "x_dem")[1]
    np.testing.assert_allclose(stroke, [0, 4, 8, 12, 16], atol=0.001)  # of other signals the latest counts


def test_frames_have_their_message_s_period_and_the_lower_identifier_goes_first() -> None:
    channels = {
        "n_dem": Channel(1.0 + 0.01 * np.arange(11), np.full(11, 50.0)),
        "p_s": Channel(1.05 + 0.1 * np.arange(2), np.full(2, 21.0)),
    }
    frames = encode_channels(channels, DBC, Path("x.log"))
    demand, health = (frames.t[frames.ident == i] for i in (0x0A0, 0x0B3))
    np.testing.assert_allclose(demand, 0.01 * np.arange(11), atol=1e-9)
    np.testing.assert_allclose(health, [0.1], atol=1e-9)
    together = frames.ident[np.abs(frames.t - 0.1) < 1e-6].tolist()
    assert together == [0x0A0, 0x0B3] and (np.diff(frames.t) >= 0).all()
    demanded = BY_NAME["ECU_DEMAND"].layout.decode(frames.data[0].tobytes(), decode_choices=False)
    assert demanded["mode_request"] == 1
    with pytest.raises(LogError, match=r"x.log: 2e\+05 s are too long for a CAN log with a frame every 0.01 s"):
        encode_channels({"n_dem": Channel(np.array([0.0, 200_000.1]), np.ones(2))}, DBC, Path("x.log"))


def test_a_signal_that_the_database_lacks_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "d.dbc").write_text('VERSION ""\nBU_: A\nBO_ 291 M: 12 A\n SG_ n_dem : 64|16@1+ (0.01,0) [0|0] "%" A\n')
    with pytest.raises(LogError, match="a.log: d.dbc has no signal for t_oil, x_dem"):
        write_log(
            tmp_path / "a.log",
            {n: Channel(np.zeros(1), np.ones(1)) for n in ("x_dem", "n_dem", "t_oil")},
            dbc=tmp_path / "d.dbc",
        )
    frames = encode_channels(
        {"n_dem": Channel(np.array([0.0, 0.01]), np.array([1.0, 2.0]))}, tmp_path / "d.dbc", Path("x")
    )
    assert (
        frames.data.shape == (2, 12) and frames.length.tolist() == [12, 12] and frames.data[:, 8].tolist() == [100, 200]
    )


# ---- databases -------------------------------------------------------------------------------------------------------


def test_a_database_loses_what_its_parser_stumbles_over_least_needed_first(tmp_path: Path) -> None:
    good = 'VERSION ""\nBU_: A\nBO_ 291 M: 8 A\n SG_ a : 0|8@1+ (1,0) [0|0] "" A\n'
    for k, (line, gone) in enumerate([
        ('VAL_ 291 a 0 "x" 1 ;\n', "VAL_"), ('CM_ SG_ 291 "x;y" "z" ;\n', "VAL_, CM_"),
        ('EV_ foo bar ;\n', "VAL_, CM_, BA_"),
    ]):  # fmt: skip
        file = tmp_path / f"{k}.dbc"
        file.write_text(good + line)
        messages, notes = load_dbc(file)
        assert [s.name for s in messages[0].layout.signals] == ["a"]
        assert len(notes) == 1 and notes[0].startswith(f"{file}: read without its lines {gone}")
    (tmp_path / "no.dbc").write_text("nothing")
    with pytest.raises(LogError, match=r"is not a DBC \(it defines no message, BO_\)"):
        load_dbc(tmp_path / "no.dbc")
    (tmp_path / "bad.dbc").write_text("BO_ x y z")
    with pytest.raises(LogError, match="is not a database that cantools reads"):
        load_dbc(tmp_path / "bad.dbc")


def test_a_database_has_32_mib_at_most(tmp_path: Path) -> None:
    assert MAX_DBC == 32 << 20
    file = tmp_path / "big.dbc"
    for more, said in ((0, "defines no message"), (1, "33,554,433 bytes; a database may have 33,554,432")):
        with file.open("wb") as f:
            f.truncate(MAX_DBC + more)
        with pytest.raises(LogError, match=said):
            load_dbc(file)


def test_attributes_of_a_database_say_protection_group_and_what_is_missing(tmp_path: Path) -> None:
    text = (
        'VERSION ""\nBU_: A\nBO_ 291 M: 8 A\n SG_ a : 0|8@1+ (1,0) [0|0] "" A\n'
        'BO_ 2566844672 J: 8 A\n SG_ b : 0|8@1+ (1,0) [0|0] "" A\n'
        'BA_DEF_ BO_ "E2EProfile" ENUM "None","P01";\nBA_DEF_ BO_ "DataID" INT 0 65535;\n'
        'BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","reserved","J1939PG";\n'
        'BA_DEF_ SG_ "NotAvailable" INT -65536 65536;\nBA_DEF_DEF_ "E2EProfile" "None";\n'
        'BA_DEF_DEF_ "DataID" 0;\nBA_DEF_DEF_ "VFrameFormat" "StandardCAN";\nBA_DEF_DEF_ "NotAvailable" 0;\n'
        'BA_ "DataID" BO_ 291 77;\n{}BA_ "NotAvailable" SG_ 291 a 250;\nBA_ "VFrameFormat" BO_ 2566844672 3;\n'
    )
    for k, (profile, data_id) in enumerate(
        [('BA_ "E2EProfile" BO_ 291 1;\n', 77), ('BA_ "E2EProfile" BO_ 291 0;\n', None), ("", None)]
    ):
        (tmp_path / f"{k}.dbc").write_text(text.format(profile))
        m, j = load_dbc(tmp_path / f"{k}.dbc")[0]
        assert (m.e2e, m.j1939, m.missing, m.ident) == (data_id, False, {"a": 250}, 291)
        assert (j.e2e, j.j1939, j.missing, j.ident) == (None, True, {}, 2566844672)


def test_a_whole_log_is_read_through_its_database(tmp_path: Path) -> None:
    write_log(tmp_path / "a.asc", {"n_dem": Channel(0.01 * np.arange(20), np.linspace(50, 60, 20))})
    log = read_log(tmp_path / "a.asc")
    assert log.channels["n_dem"].framed and set(log.channels) == {"n_dem"}
    assert plausible.judge("n_dem", log.channels["n_dem"].values)[1] == ""
    assert Options(None, {}).guess is False


def test_the_lower_identifier_goes_first_whatever_the_order_in_the_database(tmp_path: Path) -> None:
    (tmp_path / "d.dbc").write_text(
        'VERSION ""\nBU_: A\nBO_ 512 M: 8 A\n SG_ n_dem : 0|16@1+ (0.01,0) [0|0] "%" A\n'
        f'BO_ {EXTENDED | 0x300} X: 8 A\n SG_ n_r : 0|16@1+ (0.01,0) [0|0] "%" A\n'
        'BO_ 256 N: 8 A\n SG_ x_dem : 0|16@1+ (0.01,0) [0|0] "mm" A\n'
    )
    t = np.array([0.0, 0.01])
    channels = {n: Channel(t, np.ones(2)) for n in ("n_dem", "n_r", "x_dem")}
    frames = encode_channels(channels, tmp_path / "d.dbc", Path("x"))
    assert frames.ident.tolist() == [0x100, 0x200, EXTENDED | 0x300] * 2


@pytest.mark.parametrize(("raw", "unit"), [(b"\xb0C", "\u00b0C"), ("\u00b0C".encode(), "\u00b0C")])
def test_units_in_a_database_are_of_windows_or_of_unicode_with_its_mark(tmp_path: Path, raw: bytes, unit: str) -> None:
    mark = b"" if raw == b"\xb0C" else b"\xef\xbb\xbf"
    (tmp_path / "d.dbc").write_bytes(
        mark + b'VERSION ""\nBU_: A\nBO_ 291 M: 8 A\n SG_ t_oil : 0|8@1+ (1,0) [0|0] "' + raw + b'" A\n'
    )
    assert load_dbc(tmp_path / "d.dbc")[0][0].layout.signals[0].unit == unit


def test_fifty_milliseconds_late_are_not_too_late() -> None:
    assert ordered(np.array([0.0, 0.05, 0.0]))[0] == [0.0, 0.0, 0.05]


def test_the_first_frame_of_a_current_that_begins_later_is_the_mean_of_all_before_it() -> None:
    t = 0.002 * np.arange(1, 16)
    channels = {"n_dem": Channel(0.01 * np.arange(4), np.full(4, 50.0)), "i_cmd": Channel(t, np.arange(1.0, 16.0))}
    at, values = sent(channels, "VGV_SERVO", "i_cmd")
    np.testing.assert_allclose(at, [0.01, 0.02, 0.03], atol=1e-9)
    np.testing.assert_allclose(values, [3.0, 8.0, 13.0], atol=0.001)


def test_integers_of_fifty_two_bits_are_written_and_longer_ones_are_not() -> None:
    assert encode(message(' SG_ a : 0|52@1+ (1,0) [0|0] "" A'), {"a": np.array([2.0**52 - 1])}, 1).any()
    with pytest.raises(LogError, match="a: its 53 bits in M cannot be written"):
        encode(message(' SG_ a : 0|53@1+ (1,0) [0|0] "" A'), {"a": np.array([1.0])}, 1)
