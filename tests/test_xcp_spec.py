"""The XCP slave command by command, state by state and byte by byte, as the standard and docs/xcp.md have it.

The slave is asked straight; where time matters, the test names the ticks. All numbers stand here again: no test reads a
limit from the code.
"""

from __future__ import annotations

import hmac
import json
import math
import os
import re
import struct
import sys
import threading
import tomllib
import zlib
from functools import cache
from multiprocessing.connection import Pipe
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from controller import Calibration, load_calibration
from controller.records import FAULTS, INPUTS, SCALARS, STATE
from hil.bus.frames import ECU_DEMAND, ERROR, EXTENDED, FD, PREPARED, REMOTE, SEEDS, decode_demand, encode_demand, word0
from hil.calibrate import Attended, Memory, Slave, elements, master, prepare
from hil.calibrate.a2l import a2l_of
from hil.calibrate.daq import Daq, Entry
from hil.calibrate.elements import Element
from hil.calibrate.errors import Refusal
from hil.calibrate.lock import Lock
from hil.calibrate.prepare import WORK, AtOnce, Desk, Outside, Task, serve
from hil.calibrate.slave import key_of
from hil.calibrate.station import XcpService, data_of, replay_attended, row_of
from hil.loop.node import Node
from plant import Plant, build_plant

INIT, STANDBY, RUN, DEGRADED, FAIL_SAFE = range(5)
INPUT, OUTPUT, STATES, CAL = 0x10000000, 0x11000000, 0x12000000, 0x20000000
NUMBERS = 528  # of the shipped calibration: 68 scalars, 4 times 66 of strokes, 4 times 49 of angles


@cache
def shipped() -> tuple[Plant, Calibration]:
    """Machine and calibration as shipped; a node has its own copy of what may be changed."""
    return build_plant(), load_calibration()


def slave(mode: int = RUN, connect: bool = True, **options: Any) -> Slave:
    """A slave whose firmware says that it is in ``mode``."""
    memory = Memory(Node(*shipped()))
    memory.loop.given.mode = float(mode)
    out = Slave(memory, **options)
    if connect:
        asked(out, "FF 00")
    return out


def asked(s: Slave, command: str | bytes) -> str:
    """The answers to a command; what the desk does is done at once."""
    out = s.command(bytes.fromhex(command) if isinstance(command, str) else command)
    desk = s.memory.desk
    desk.before(desk.k, desk.note())
    return ", ".join(a.hex(" ").upper() for a in out + s.late())


def all_of(s: Slave, *commands: str) -> None:
    """Commands that must go well."""
    for command in commands:
        assert asked(s, command).startswith("FF"), command


def at(address: int, ext: int = 0) -> bytes:
    """SET_MTA."""
    return struct.pack("<BxxBI", 0xF6, ext, address)


def entry(size: int, ext: int, address: int, bit: int = 0xFF) -> bytes:
    """WRITE_DAQ."""
    return struct.pack("<BBBBI", 0xE1, bit, size, ext, address)


def scalar(name: str) -> int:
    """Address of a scalar of the calibration."""
    return CAL + 8 * SCALARS.index(name)


def write(s: Slave, address: int, value: float, ext: int = 0) -> str:
    """Write a number whole; the last answer."""
    raw = struct.pack("<d" if ext == 0 else "<f", value)
    assert asked(s, at(address, ext)) == "FF"
    out = ""
    for part in (raw[:6], raw[6:]):
        if part:
            out = asked(s, bytes([0xF0, len(part)]) + part)
    return out


# ---- every command ---------------------------------------------------------------------------------------------------

# shortest command: the resource that locks it, how its answer begins behind CONNECT
SHORTEST = {
    "FE": ("", "FF"), "FD": ("", "FF 00"), "FC": ("", "FE 00"), "FB": ("", "FF 00 00 00 00 00 10 10"),
    "FA 00": ("", "FF 00 00 00 03 00 00 00"), "F9 01 00 00": ("cal", "FE 24"), "F8 00 01": ("", "FF"),
    "F7 06": ("", "FE 29"), "F6 00 00 00 00 00 00 20": ("", "FF"), "F5 01": ("", "FE 22"),
    "F4 01 00 00 00 00 00 20": ("", "FF"), "F3 00 00 00 01 00 00 00": ("", "FE 22"), "F0 01 00": ("cal", "FE 22"),
    "ED 01 00 00 00 00 00 20": ("cal", "FE 22"), "EB 01 00 00": ("cal", "FF"), "EA 01 00": ("cal", "FF 00 00 00"),
    "E9": ("cal", "FF 01 01"), "E8 01 00 00 00": ("cal", "FF 02 00 00 00 00"), "E7 00 00 00": ("cal", "FF 3F 00"),
    "E6 00 00": ("cal", "FF"), "E5 00 00": ("cal", "FF 00 00"), "E4 00 01 00 00": ("cal", "FF"),
    "E3 00 00 00": ("daq", "FE 22"), "E2 00 00 00 00 00": ("daq", "FE 22"), "E1 FF 04 01 00 00 00 12": ("daq", "FE 29"),
    "E0 10 00 00 00 00 01 00": ("daq", "FE 22"), "DF 00 00 00": ("daq", "FE 22"), "DE 00 00 00": ("daq", "FE 22"),
    "DD 00": ("daq", "FF"), "DC": ("daq", "FF 00 00 00 00 00 00 00"), "DB": ("daq", "FE 29"),
    "DA": ("daq", "FF 93 00 00 02 00 00 00"), "D9": ("daq", "FF 01 07 04 04 6A 01 00"),
    "D7 00 00 00": ("daq", "FF 8C FF 04 01 06 00"), "D6": ("daq", "FF"), "D5 00 00 00": ("daq", "FE 29"),
    "D4 00 00 00 00": ("daq", "FE 29"), "D3 00 00 00 00 00": ("daq", "FE 29"),
}  # fmt: skip


@pytest.mark.parametrize("locked", [(), ("cal",), ("daq",), ("cal", "daq")])
def test_each_command_has_its_least_length_and_its_lock(locked: tuple[str, ...]) -> None:
    s = slave(locked=locked)
    for command, (resource, answer) in SHORTEST.items():
        asked(s, "FE")
        asked(s, "FF 00")
        found = asked(s, command)
        if resource in locked:
            assert found == "FE 25", command
        elif command == "F8 00 01" and "cal" in locked:
            assert found.startswith("FF 06")
        else:
            assert found.startswith(answer), command
        if " " in command:
            asked(s, "FF 00")
            assert asked(s, command[:-3]) == "FE 21", "a byte is missing"


def test_every_other_command_is_not_known_and_what_is_no_command_has_no_answer() -> None:
    s = slave()
    known = {int(command[:2], 16) for command in SHORTEST} | {0xFF}
    for code in set(range(0xC0, 0x100)) - known:
        assert asked(s, bytes([code, 0, 0, 0, 0, 0, 0, 0])) == "FE 20", hex(code)
    for code in range(0xC0):
        assert asked(s, bytes([code, 0, 0, 0, 0, 0, 0, 0])) == ""
    assert asked(s, b"") == "" and asked(s, "FD") == "FF 00 00 00 00 00"


def test_nothing_is_answered_before_connect_and_after_disconnect() -> None:
    s = slave(connect=False)
    for _ in range(2):
        for command in (*SHORTEST, "C5", "F2 FF 58 43 50 02", "F2", "FF", "FF 02", ""):
            assert asked(s, command) == "", command
        assert asked(s, "FF 01") == "FF 0D C0 08 08 00 01 01" and s.connected
        assert asked(s, "FE") == "FF" and not s.connected


@pytest.mark.parametrize(
    ("command", "answer"),
    [
        ("FF 00", "FF 0D C0 08 08 00 01 01"), ("FF 01", "FF 0D C0 08 08 00 01 01"), ("FF 02", "FE 21"), ("FF", "FE 21"),
        ("F2 FF 58 43 50 00", "FF 58 43 50 E0 06 00 00"), ("F2 FF 58 43 50 01", "FF A7 BC AF E0 06 00 00"),
        ("F2 FF 58 43 50 02", "FE 20"), ("F2 FF 58 43 50", "FE 20"), ("F2 FE 58 43 50 00", "FE 20"),
        ("F2 FF 58 43 51 00", "FE 20"), ("F2", "FE 20"), ("F2 FF 58 43 50 00 00 00", "FF 58 43 50 E0 06 00 00"),
    ],
)  # fmt: skip
def test_what_finds_a_slave_and_connects_it(command: str, answer: str) -> None:
    assert asked(slave(), command) == answer
    if command.startswith("F2") and answer.startswith("FF"):
        assert asked(slave(connect=False), command) == answer, "nobody need be connected"
        assert asked(slave(ident=0x712), command)[-11:] == "11 07 00 00"


def test_a_second_connect_keeps_the_session_and_one_after_disconnect_begins_anew() -> None:
    s = slave(locked=("cal", "daq"))
    for resource, name in ((1, "cal"), (4, "daq")):
        seed = bytes.fromhex(asked(s, bytes([0xF8, 0, resource])))[2:]
        asked(s, b"\xf7\x06" + key_of(name, seed))
    all_of(s, "D6", "D5 00 01 00", "FA 00")
    assert asked(s, at(scalar("kp"))) == "FF" and asked(s, "F0 06 00 00 00 00 00 00") == "FF"
    asked(s, at(scalar("ki")))
    assert asked(s, "FF 00") == "FF 0D C0 08 08 00 01 01"
    assert asked(s, "FD") == "FF 00 00 00 00 00" and asked(s, "DA") == "FF 93 01 00 02 00 00 00"
    assert asked(s, "F5 04") == "FF 00 00 00 00", "of ki"
    assert asked(s, "FE") == "FF" and asked(s, "FF 00")[:2] == "FF"
    assert asked(s, "FD") == "FF 00 05 00 00 00" and asked(s, "F5 01") == "FE 22" and len(s.daq.lists) == 0
    seed = bytes.fromhex(asked(s, "F8 00 01"))[2:]
    asked(s, b"\xf7\x06" + key_of("cal", seed))
    asked(s, at(scalar("kp") + 6))
    assert asked(s, "F0 02 29 40") == "FF" and s.memory.live()[12] == 16.0, "the first half is forgotten"


def test_the_status_tells_what_is_locked_and_whether_a_list_runs() -> None:
    for locked, word in (((), 0), (("cal",), 1), (("daq",), 4), (("daq", "cal", "cal"), 5)):
        assert asked(slave(locked=locked), "FD") == f"FF 00 {word:02X} 00 00 00"
    s = listed(1)
    assert asked(s, "DE 01 00 00") == "FF 00" and asked(s, "FD") == "FF 40 00 00 00 00"
    assert asked(s, "DE 00 00 00") == "FF 00" and asked(s, "FD") == "FF 00 00 00 00 00"


# ---- seed and key ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("command", "answer"),
    [
        ("F8 01 01", "FE 29"), ("F8 02 01", "FE 22"), ("F8 00 00", "FE 22"), ("F8 00 02", "FE 22"),
        ("F8 00 03", "FE 22"), ("F8 00 05", "FE 22"), ("F8 00 08", "FF 00"), ("F8 00 04", "FF 00"),
        ("F8 00 10", "FE 22"), ("F7 06 00 00 00 00 00 00", "FE 29"),
    ],
)  # fmt: skip
def test_what_is_no_seed(command: str, answer: str) -> None:
    assert asked(slave(locked=("cal",)), command) == answer


def test_a_key_opens_the_resource_of_its_seed_once() -> None:
    s = slave(locked=("cal", "daq"))
    first = bytes.fromhex(asked(s, "F8 00 01"))
    assert first[:2] == b"\xff\x06" and len(first) == 8
    seed = bytes.fromhex(asked(s, "F8 00 04"))[2:]
    assert seed != first[2:]
    assert asked(s, b"\xf7\x06" + key_of("daq", seed)) == "FF 01"
    assert asked(s, "F7 06 00 00 00 00 00 00") == "FE 29" and s.connected
    assert asked(s, "DD 00") == "FF" and asked(s, "E9") == "FE 25" and asked(s, "F8 00 04") == "FF 00"
    seed = bytes.fromhex(asked(s, "F8 00 01"))[2:]
    assert asked(s, b"\xf7\x06" + key_of("cal", seed)) == "FF 00" and asked(s, "E9") == "FF 01 01"


@pytest.mark.parametrize("how", ["of the other resource", "of another length", "one bit", "half"])
def test_a_wrong_key_ends_the_session(how: str) -> None:
    s = slave(locked=("cal", "daq"))
    seed = bytes.fromhex(asked(s, "F8 00 01"))[2:]
    key = bytearray(key_of("daq" if how == "of the other resource" else "cal", seed))
    key[5] ^= how == "one bit"
    raw = bytes([0xF7, 5 if how == "of another length" else 6]) + bytes(key)
    assert asked(s, raw[:5] if how == "half" else raw) == "FE 25" and not s.connected
    asked(s, "FF 00")
    assert asked(s, "FD") == "FF 00 05 00 00 00"


def test_seeds_follow_from_a_number_and_without_one_nobody_foresees_them() -> None:
    def seeds(**options: Any) -> list[bytes]:
        s = slave(locked=("cal", "daq", "stim"), **options)
        return [bytes.fromhex(asked(s, f"F8 00 0{r}"))[2:] for r in (1, 4, 8)]

    for number in (0, 7, -(2**63), 2**63 - 1):
        of = [hmac.digest(struct.pack("<q", number), f"xcp {n}".encode(), "sha256")[:6] for n in (1, 2, 3)]
        assert seeds(seed=number) == of
    assert len({s for _ in range(20) for s in seeds()}) == 60


def wrong_key(s: Slave) -> None:
    """Connect, ask for a seed, and send a wrong key: the session ends."""
    asked(s, "FF 00")
    assert asked(s, "F8 00 01").startswith("FF 06")
    assert asked(s, "F7 06 00 00 00 00 00 00") == "FE 25" and not s.connected


def test_after_the_third_wrong_key_there_is_no_seed_for_10000_ticks_whatever_the_resource() -> None:
    s = slave(locked=("cal", "daq"))
    for k in (500, 600, 777):
        s.k = k
        wrong_key(s)
    asked(s, "FF 00")
    for s.k in (777, 10_776):
        assert asked(s, "F8 00 01") == "FE 25" == asked(s, "F8 00 04") and s.connected
        assert asked(s, "F7 06 00 00 00 00 00 00") == "FE 29" and asked(s, "F8 00 08") == "FF 00"
    s.k = 10_777
    wrong_key(s)
    wrong_key(s)
    asked(s, "FF 00")
    seed = bytes.fromhex(asked(s, "F8 00 01"))[2:]
    assert asked(s, b"\xf7\x06" + key_of("cal", seed)) == "FF 04", "a right one forgives"
    asked(s, "FE")
    for _ in range(3):
        wrong_key(s)
    asked(s, "FF 00")
    assert asked(s, "F8 00 01") == "FE 25"


def test_what_was_not_saved_ends_with_the_session() -> None:
    for end in ("FE", "wrong key"):
        s = slave(locked=("daq",))
        all_of(s, "E6 01 00", "EB 03 00 01")
        if end == "FE":
            asked(s, "FE")
        else:
            asked(s, "F8 00 04")
            asked(s, "F7 06 00 00 00 00 00 00")
        asked(s, "FF 00")
        assert asked(s, "E5 00 00") == "FF 00 00" and asked(s, "EA 02 00") == "FF 00 00 00", "freeze, the tool's page"
        assert asked(s, "EA 01 00") == "FF 00 00 01", "the firmware's page is what was calibrated"


# ---- texts, reading --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "text"), [(0, b"vgv"), (1, b"vgv"), (2, b"vgv.a2l"), (3, None), (4, b"the file"), (5, None), (255, None)]
)
def test_what_the_slave_says_that_it_is(kind: int, text: bytes | None) -> None:
    s = slave(a2l=lambda: "the file")
    asked(s, at(scalar("kp")))
    found = bytes.fromhex(asked(s, bytes([0xFA, kind])))
    assert found == struct.pack("<BBHI", 0xFF, 0, 0, len(text or b""))
    if text is None:
        assert asked(s, "F5 02") == "FF 00 00", "the address is as it was: of kp"
    else:
        assert asked(s, bytes([0xF5, len(text) + 1])) == "FE 22"
        got = asked(s, bytes([0xF5, len(text)])).replace(", FF", "")
        assert bytes.fromhex(got) == b"\xff" + text
        assert asked(s, "F5 01") == "FE 22"
        assert asked(slave(), bytes([0xFA, 4])) == "FF 00 00 00 00 00 00 00", "no A2L file is given"


@pytest.mark.parametrize("max_cto", [8, 64])
def test_an_upload_comes_in_frames_and_moves_the_address(max_cto: int) -> None:
    s = slave(max_cto=max_cto)
    image, room = s.memory.live().tobytes(), max_cto - 1
    assert asked(s, "FF 00")[9:11] == f"{max_cto:02X}"
    asked(s, at(CAL))
    assert asked(s, "F5 00") == "FE 22"
    done = 0
    for n in (1, 6, 7, 8, 14, 15, 63, 64, 255):
        frames = [bytes.fromhex(f) for f in asked(s, bytes([0xF5, n])).split(", ")]
        assert [len(f) for f in frames[:-1]] == [room + 1] * (len(frames) - 1) and len(frames) == -(-n // room)
        assert b"".join(f[1:] for f in frames) == image[done : done + n] and {f[0] for f in frames} == {0xFF}
        done += n


def test_a_short_upload_has_room_for_7_bytes_and_leaves_the_address_behind_them() -> None:
    s = slave()
    image = s.memory.live().astype(np.float32).tobytes()
    for n in (0, 8, 9, 255):
        assert asked(s, struct.pack("<BBBBI", 0xF4, n, 0, 1, CAL)) == "FE 22"
    for n in (1, 7):
        got = bytes.fromhex(asked(s, struct.pack("<BBBBI", 0xF4, n, 0, 1, CAL + 4)))
        assert got == b"\xff" + image[4 : 4 + n]
        assert bytes.fromhex(asked(s, "F5 03")) == b"\xff" + image[4 + n : 7 + n]


def test_a_checksum_is_of_1_to_1048576_bytes_and_moves_the_address() -> None:
    text = bytes(i % 251 for i in range((1 << 20) + 5))
    s = slave(a2l=lambda: text.decode("latin-1").encode("ascii", "replace").decode())
    raw = text.decode("latin-1").encode("ascii", "replace")
    asked(s, "FA 04")
    for n in (0, (1 << 20) + 1, 0xFFFFFFFF):
        assert asked(s, struct.pack("<BxxxI", 0xF3, n)) == "FE 22 00 00 00 00 10 00"
    assert (
        asked(s, struct.pack("<BxxxI", 0xF3, 1))
        == f"FF 09 00 00 {struct.pack('<I', zlib.crc32(raw[:1])).hex(' ')}".upper()
    )
    found = bytes.fromhex(asked(s, struct.pack("<BxxxI", 0xF3, 1 << 20)))
    assert found == b"\xff\x09\0\0" + struct.pack("<I", zlib.crc32(raw[1 : 1 + (1 << 20)]))
    assert bytes.fromhex(asked(s, "F5 04")) == b"\xff" + raw[-4:]
    assert asked(s, struct.pack("<BxxxI", 0xF3, 1)) == "FE 22"


AREAS = (  # first address in double precision, in single precision, numbers
    (INPUT, INPUT, 15), (OUTPUT, OUTPUT, 4), (STATES, STATES, 162), (CAL, CAL, 68), (0x20000220, 0x20000110, 264),
    (0x20000A60, 0x20000530, 196),
)  # fmt: skip


@pytest.mark.parametrize("ext", [0, 1])
def test_memory_is_where_the_map_says_and_nothing_is_beside_it(ext: int) -> None:
    s = slave()
    memory, width = s.memory, 8 >> ext
    for i, area in enumerate(AREAS):
        first, end = area[ext], area[ext] + width * area[2]
        assert memory.place(ext, first, 1) == (i + 6 * ext, 0) and memory.place(ext, first, 0) is None
        assert memory.place(ext, first + 5, 7) == (i + 6 * ext, 5)
        assert memory.place(ext, end - 1, 1) == (i + 6 * ext, width * area[2] - 1)
        assert memory.place(ext, first, width * area[2]) == (i + 6 * ext, 0)
        assert memory.place(ext, end - 1, 2) is None and memory.place(ext, first - 1, 2) is None
        assert memory.place(2, first, 1) is None and memory.place(2, first, 0) is None
        assert len(memory.raw[i + 6 * ext]) == width * area[2]
    for base, n in ((INPUT, 15), (OUTPUT, 4), (STATES, 162), (CAL, NUMBERS)):
        assert (
            len(memory.read(ext, base, width * n)) == width * n and len(memory.read(ext, base + width * n - 1, 1)) == 1
        )
        for address, size in ((base + width * n, 1), (base, width * n + 1), (base + 8 * NUMBERS, 1), (base - 1, 1)):
            with pytest.raises(Refusal) as e:
                memory.read(ext, address, size)
            assert e.value.code == 0x22
    for wrong in (2, 3, 255):
        with pytest.raises(Refusal) as e:
            memory.read(wrong, CAL, 4)
        assert e.value.code == 0x22


def test_what_is_read_is_the_tick_s_in_both_precisions() -> None:
    node = Node(*shipped(), seed=1)
    memory = Memory(node)
    for k in range(40):
        node.tick(np.array([(word0(ECU_DEMAND), encode_demand(61.3, 60.7, 1, k // 10))], np.int64)[: k % 10 == 0])
    loop = node.loop
    with np.errstate(over="ignore"):
        for base, row in ((INPUT, loop.inputs), (OUTPUT, loop.outputs), (STATES, loop.z), (CAL, memory.live())):
            assert memory.read(0, base, 8 * len(row)) == row.tobytes()
            assert memory.read(1, base, 4 * len(row)) == row.astype(np.float32).tobytes()
        memory.refresh()
        rows = (loop.inputs, loop.outputs, loop.z, memory.live()[:68], memory.live()[68:332], memory.live()[332:])
        for i, row in enumerate(rows):
            assert memory.raw[i].tobytes() == row.tobytes()
            assert memory.raw[6 + i].tobytes() == row.astype(np.float32).tobytes()


def test_only_what_is_used_is_brought_up_to_date() -> None:
    memory = Memory(Node(*shipped()))
    memory.loop.inputs[:] = 9.0
    memory.loop.outputs[:] = 2.0
    memory.refresh({1, 7})
    assert memory.areas[1].short.tolist() == [2.0] * 4 and 9.0 not in memory.areas[0].short
    memory.refresh({0, 6})
    assert memory.areas[0].short.tolist() == [9.0] * 15


def test_the_signals_are_inputs_outputs_and_the_state_that_the_machine_has() -> None:
    memory = Memory(Node(*shipped()))
    found = {s.name: s.address for s in memory.signals}
    assert [n for n in found if n.startswith("input_")] == [f"input_{n}" for n in INPUTS]
    assert {f"input_{n}": INPUT + 8 * i for i, n in enumerate(INPUTS)}.items() <= found.items()
    assert [found[f"output_{n}"] for n in ("i_cmd", "x_dem", "mode", "faults")] == [OUTPUT + 8 * i for i in range(4)]
    states = {n[6:]: a for n, a in found.items() if n.startswith("state_")}
    assert states == {
        n: STATES + 8 * i for i, n in enumerate(STATE) if n[-4:] not in ("vgv3", "vgv4", "vgv5", "vgv6", "vgv7")
    }
    assert len(found) == len(memory.signals) == 15 + 4 + 92


# ---- writing ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("command", "answer"),
    [
        ("F0 00 00", "FE 22"), ("F0 07 00 00 00 00 00 00", "FE 22"), ("F0 06 00 00 00 00 00 00", "FF"),
        ("F0 06 00 00 00 00 00", "FE 21"), ("F0 02 00", "FE 21"), ("F0 01 00 00", "FF"), ("F0 FF 00", "FE 22"),
    ],
)  # fmt: skip
def test_a_download_has_1_to_6_bytes_and_moves_the_address_if_it_is_taken(command: str, answer: str) -> None:
    s = slave()
    asked(s, at(scalar("kp")))
    assert asked(s, command) == answer
    n = int(command[3:5], 16) if answer == "FF" else 0
    assert asked(s, "F5 08").replace(", FF", "") == "FF " + (
        s.memory.live().tobytes()[96 + n : 104 + n].hex(" ").upper()
    )


def test_a_text_is_not_written_over() -> None:
    s = slave()
    asked(s, "FA 00")
    assert asked(s, "F0 01 00") == "FE 23" and asked(s, "F5 03") == "FF 76 67 76"


def test_with_longer_frames_a_download_carries_whole_numbers_at_their_address() -> None:
    s = slave(max_cto=64)
    raw = struct.pack("<7d", *(s.memory.live()[12:15] * 1.01), *s.memory.live()[15:19])
    head = struct.pack("<xBI", 0, scalar("kp"))
    assert asked(s, b"\xed\x00" + head + raw) == "FE 22" and asked(s, b"\xed\x39" + head + raw + b"\0") == "FE 22"
    assert asked(s, b"\xed\x38" + head + raw[:-1]) == "FE 21" and asked(s, b"\xed\x01" + head) == "FE 21"
    assert s.memory.live()[12] == 16.0
    assert asked(s, b"\xed\x38" + head + raw) == "FF" and s.memory.live()[12] == 16.0 * 1.01
    assert asked(s, "F5 08") == "FF " + struct.pack("<d", s.memory.live()[19]).hex(" ").upper(), "the address is behind"
    asked(s, at(scalar("kp")))
    assert asked(s, b"\xf0\x3f" + raw + bytes(7)) == "FE 22"
    assert asked(s, b"\xf0\x3e" + raw[:8] + s.memory.live().tobytes()[104:158]) == "FF"
    short = struct.pack("<f", 12.5)
    assert asked(s, b"\xed\x04" + struct.pack("<xBI", 1, CAL + 48) + short) == "FF" and s.memory.live()[12] == 12.5
    assert asked(slave(), "ED 01 00 00 60 00 00 20") == "FE 22", "a frame of 8 bytes has no room for data"


@pytest.mark.parametrize(
    ("address", "ext", "answer"),
    [
        (CAL, 0, "FF"), (CAL - 1, 0, "FE 22"), (CAL + 8 * NUMBERS - 1, 0, "FF"), (CAL + 8 * NUMBERS, 0, "FE 22"),
        (CAL + 4 * NUMBERS - 1, 1, "FF"), (CAL + 4 * NUMBERS, 1, "FE 22"), (CAL, 2, "FE 22"), (INPUT, 0, "FE 24"),
        (OUTPUT + 3, 1, "FE 24"), (STATES + 0xFFFFFF, 0, "FE 24"), (0x13000000, 0, "FE 22"), (0, 0, "FE 22"),
        (INPUT - 1, 0, "FE 22"), (INPUT, 7, "FE 24"), (0xFFFFFFFF, 0, "FE 22"),
    ],
)  # fmt: skip
def test_only_the_calibration_is_written(address: int, ext: int, answer: str) -> None:
    s = slave()
    asked(s, at(address, ext))
    assert asked(s, "F0 01 00") == answer


def test_the_last_byte_may_be_written_and_the_last_but_one_with_it() -> None:
    s = slave()
    for ext, end in ((0, CAL + 8 * NUMBERS), (1, CAL + 4 * NUMBERS)):
        asked(s, at(end - 2, ext))
        assert asked(s, "F0 02 00 00") == "FF"
        asked(s, at(end - 2, ext))
        assert asked(s, "F0 03 00 00 00") == "FE 22"


@pytest.mark.parametrize("ext", [0, 1])
def test_a_number_acts_with_its_last_byte_in_whatever_order_they_come(ext: int) -> None:
    width = 8 >> ext
    raw = struct.pack("<d" if ext == 0 else "<f", 12.3125)
    for order in (range(width), reversed(range(width)), (*range(1, width), 0)):
        s = slave()
        todo = list(order)
        for i, byte in enumerate(todo):
            assert s.memory.live()[12] == 16.0, i
            asked(s, at(CAL + 12 * width + byte, ext))
            assert asked(s, bytes([0xF0, 1, raw[byte]])) == "FF"
        assert s.memory.live()[12] == 12.3125 == s.memory.pages[0][12] and s.memory.pages[1][12] == 16.0


def test_halves_of_numbers_wait_side_by_side_in_both_precisions() -> None:
    s = slave()
    double, single = struct.pack("<d", 12.5), struct.pack("<f", 90.0)
    kp, ki = 12, 13
    asked(s, at(CAL + 8 * kp))
    asked(s, b"\xf0\x06" + double[:6])
    asked(s, at(CAL + 8 * ki))
    asked(s, b"\xf0\x06" + struct.pack("<d", 77.0)[:6])
    for number in (kp, ki, 2 * kp, 0, 1):
        asked(s, at(CAL + 4 * number, 1))
        asked(s, b"\xf0\x02" + single[:2])
    asked(s, at(CAL + 8 * kp + 6))
    assert asked(s, b"\xf0\x02" + double[6:]) == "FF" and s.memory.live()[kp] == 12.5 and s.memory.live()[ki] == 100.0
    asked(s, at(CAL + 4 * ki + 2, 1))
    assert asked(s, b"\xf0\x02" + single[2:]) == "FF" and s.memory.live()[ki] == 90.0
    asked(s, at(CAL + 8 * ki + 6))
    assert asked(s, b"\xf0\x02" + struct.pack("<d", 77.0)[6:]) == "FF" and s.memory.live()[ki] == 77.0
    asked(s, at(CAL + 8 * ki + 6))
    assert asked(s, b"\xf0\x02" + struct.pack("<d", 60.0)[6:]) == "FF" and s.memory.live()[ki] == 77.0, "begun anew"


@pytest.mark.parametrize("judged", [False, True])
def test_of_a_refused_number_nothing_is_kept(judged: bool) -> None:
    """Refused by its own bound, or by the check of the whole table; what else the command had is forgotten too."""
    s = slave()
    i, value = (134 + 5, 0.0) if judged else (12, 1e9)
    was = s.memory.live()
    raw = struct.pack("<d", value)
    asked(s, at(CAL + 8 * i))
    asked(s, b"\xf0\x06" + raw[:6])
    assert asked(s, b"\xf0\x02" + raw[6:]) == "FE 22" and (s.memory.live() == was).all()
    asked(s, at(CAL + 8 * i + 6))
    assert asked(s, b"\xf0\x02" + raw[6:]) == "FF", "six bytes are missing again"
    assert (s.memory.live() == was).all()


def test_two_numbers_of_one_command_act_together() -> None:
    s = slave(max_cto=64)
    asked(s, at(scalar("kp")))
    assert asked(s, b"\xf0\x10" + struct.pack("<2d", 15.0, -1.0)) == "FE 22" and s.memory.live()[12] == 16.0
    assert asked(s, b"\xf0\x10" + struct.pack("<2d", 15.0, 99.0)) == "FF"
    assert s.memory.live()[12:14].tolist() == [15.0, 99.0]


@pytest.mark.parametrize(
    ("name", "value", "answer"),
    [
        ("kp", 1000.0, "FF"), ("kp", np.nextafter(1000.0, 2e3), "FE 22"), ("kp", 0.0, "FF"), ("kp", -1e-9, "FE 22"),
        ("kp", math.inf, "FE 22"), ("kp", -math.inf, "FE 22"), ("kp", math.nan, "FE 22"), ("lead", 0.5, "FF"),
        ("lead", 0.5000001, "FE 22"), ("strategy", 2.0, "FF"), ("strategy", 1.5, "FE 22"), ("strategy", 4.0, "FE 22"),
        ("strategy", -1.0, "FE 22"), ("table_input", 1.0, "FF"), ("table_input", 2.0, "FE 22"), ("stages", 3.0, "FF"),
        ("stages", 2.0, "FE 23"), ("play_vgv3", 0.1, "FE 23"), ("play_vigv", 0.1, "FF"), ("current_limit", 0.04, "FF"),
        ("current_limit", 0.0400001, "FE 22"), ("current_limit", 0.03, "FF"), ("tracking_limit", 0.1, "FF"),
        ("tracking_limit", 0.11, "FE 22"), ("stroke_max", 0.04, "FF"), ("stroke_min", 0.048, "FE 22"),
    ],
)  # fmt: skip
def test_a_value_is_taken_up_to_its_bounds(name: str, value: float, answer: str) -> None:
    s = slave(STANDBY)
    before = s.memory.live()
    assert write(s, scalar(name), value) == answer
    wanted = before.copy()
    if answer == "FF":
        wanted[SCALARS.index(name)] = value
    assert (s.memory.live() == wanted).all() and (s.memory.pages[0] == wanted).all()
    assert (s.memory.pages[1] == before).all()


GUARDED = (
    *("strategy", "table_input", "stroke_min", "stroke_max", "current_limit", "init_time", "fail_safe_stroke"),
    *("fail_safe_current", "fail_safe_rate", "degraded_hold", "recover_time", "demand_timeout", "demand_reject_limit"),
    *("demand_reject_leak", "demand_low", "demand_high", "lvdt_low", "lvdt_high", "lvdt_rate", "lvdt_debounce"),
    *("lvdt_heal", "stuck_current", "stuck_motion", "stuck_time", "stuck_margin", "tracking_limit", "tracking_time"),
    "saturated_time",
)


@pytest.mark.parametrize("mode", range(5))
def test_what_limits_or_watches_the_loop_is_changed_in_init_and_standby_only(mode: int) -> None:
    s = slave(mode)
    for i, e in enumerate(s.memory.elements[:68]):
        if e.fixed:
            continue
        now = s.memory.live()[i]
        other = now * (1.0 - 1e-6) if not e.whole else (0.0 if now else 1.0)
        if now == 0.0 and not e.whole:
            other = 1e-7
        closed = mode not in (INIT, STANDBY) and e.name in GUARDED
        assert write(s, CAL + 8 * i, other) == ("FE 23" if closed else "FF"), e.name
        assert write(s, CAL + 8 * i, now) == "FF", "what stands there already is no change"


# ---- pages -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("command", "answer"),
    [
        ("EB 00 00 00", "FE 27"), ("EB 04 00 00", "FE 27"), ("EB 05 00 00", "FE 27"), ("EB 80 00 00", "FE 27"),
        ("EB 7F 00 00", "FE 27"), ("EB 01 00 00", "FF"), ("EB 02 00 01", "FF"), ("EB 03 00 01", "FF"),
        ("EB 81 07 01", "FF"), ("EB 83 FF 00", "FF"), ("EB 01 01 00", "FE 28"), ("EB 02 01 00", "FE 28"),
        ("EB 03 00 02", "FE 26"), ("EB 01 00 FF", "FE 26"), ("EA 01 00", "FF 00 00 00"), ("EA 02 00", "FF 00 00 00"),
        ("EA 00 00", "FE 27"), ("EA 03 00", "FE 27"), ("EA 01 01", "FE 28"),
        ("E8 00 00 00 00", "FF 00 00 00 00 00 00 20"),
        ("E8 00 00 01 00", "FF 00 00 00 80 10 00 00"), ("E8 00 00 02 00", "FE 22"), ("E8 00 01 00 00", "FE 28"),
        ("E8 01 00 00 00", "FF 02 00 00 00 00"), ("E8 01 00 05 00", "FF 02 00 00 00 00"), ("E8 01 01 00 00", "FE 28"),
        ("E8 02 00 00 00", "FE 22"), ("E8 02 00 01 00", "FE 22"), ("E7 00 00 00", "FF 3F 00"),
        ("E7 00 00 01", "FF 0F 00"), ("E7 00 00 02", "FE 26"), ("E7 00 01 00", "FE 28"), ("E6 00 00", "FF"),
        ("E6 01 00", "FF"), ("E6 02 00", "FE 27"), ("E6 01 01", "FE 28"), ("E5 00 00", "FF 00 00"),
        ("E5 00 01", "FE 28"),
        ("E4 00 01 00 00", "FF"), ("E4 01 01 00 00", "FE 28"), ("E4 00 01 01 00", "FE 28"), ("E4 00 00 00 01", "FE 23"),
        ("E4 00 01 00 01", "FE 23"), ("E4 00 00 00 00", "FE 26"), ("E4 00 02 00 00", "FE 26"),
        ("E4 00 01 00 02", "FE 26"),
    ],
)  # fmt: skip
def test_what_the_commands_of_pages_answer(command: str, answer: str) -> None:
    assert asked(slave(), command) == answer


@pytest.mark.parametrize(("mode", "ecu", "xcp"), [(1, 1, 0), (2, 0, 1), (3, 1, 1), (0x81, 1, 0), (0x82, 0, 1)])
def test_firmware_and_tool_change_pages_each_for_itself(mode: int, ecu: int, xcp: int) -> None:
    s = slave()
    write(s, scalar("kp"), 12.5)
    assert asked(s, bytes([0xEB, mode, 0, 1])) == "FF"
    assert asked(s, "EA 01 00") == f"FF 00 00 0{ecu}" and asked(s, "EA 02 00") == f"FF 00 00 0{xcp}"
    assert s.memory.live()[12] == (16.0 if ecu else 12.5)
    asked(s, at(scalar("kp")))
    seen = struct.pack("<d", 16.0 if xcp else 12.5)
    assert bytes.fromhex(asked(s, "F5 07")) == b"\xff" + seen[:7]
    assert write(s, scalar("kp"), 11.0) == ("FE 23" if xcp else "FF")
    assert s.memory.pages[0][12] == (12.5 if xcp else 11.0) and s.memory.live()[12] == (
        16.0 if ecu else s.memory.pages[0][12]
    )
    assert asked(s, "EB 83 00 00") == "FF" and s.memory.live()[12] == s.memory.pages[0][12]


def test_a_change_of_the_tool_s_page_forgets_half_a_number() -> None:
    for command, kept in (("EB 02 00 00", False), ("EB 01 00 00", True)):
        s = slave()
        asked(s, at(scalar("kp")))
        asked(s, "F0 06 00 00 00 00 00 00")
        assert asked(s, command) == "FF"
        asked(s, at(scalar("kp") + 6))
        asked(s, "F0 02 29 40")
        assert s.memory.live()[12] == (12.5 if kept else 16.0)


@pytest.mark.parametrize("mode", range(5))
def test_a_page_with_another_monitor_is_switched_to_with_an_open_loop_only(mode: int) -> None:
    s = slave(STANDBY)
    assert write(s, scalar("tracking_limit"), 0.004) == "FF"
    s.memory.loop.given.mode = float(mode)
    closed = mode not in (INIT, STANDBY)
    assert asked(s, "EB 01 00 01") == ("FE 23" if closed else "FF") and s.memory.ecu_page == (not closed)
    assert s.memory.live()[SCALARS.index("tracking_limit")] == (0.004 if closed else 0.002)
    assert asked(s, "EB 01 00 00") == "FF", "where it is, or open"
    assert asked(s, "E4 00 01 00 00") == ("FE 23" if closed else "FF")
    assert s.memory.pages[0][SCALARS.index("tracking_limit")] == (0.004 if closed else 0.002)


def test_what_is_protected_is_refused_at_once_and_not_checked_first() -> None:
    s = slave(STANDBY)
    write(s, scalar("tracking_limit"), 0.004)
    s.memory.loop.given.mode = float(RUN)
    s.memory.desk = Desk(held := Held())  # type: ignore[arg-type]
    assert asked(s, "EB 01 00 01") == "FE 23" and asked(s, "E4 00 01 00 00") == "FE 23"
    assert write(s, scalar("tracking_limit"), 0.003) == "FE 23" and held.begun == [] and not s.waiting
    assert write(s, scalar("kp"), 12.0) == "" and held.begun == [(1, "judge")] and s.waiting


def test_a_page_that_does_not_fit_together_is_not_switched_to_and_not_saved(tmp_path: Path) -> None:
    s = slave(save=tmp_path / "tuned")
    was = s.memory.live()
    assert asked(s, "EB 01 00 01") == "FF" and write(s, CAL + 8 * (134 + 5), 0.0) == "FF", "nobody uses it"
    assert asked(s, "EB 01 00 00") == "FE 22" and s.memory.ecu_page == 1 and (s.memory.live() == was).all()
    assert asked(s, "E6 01 00") == "FF" and asked(s, "F9 01 00 00") == "FE 32" and not (tmp_path / "tuned").exists()
    assert asked(s, "E4 00 01 00 00") == "FF" and asked(s, "EB 01 00 00") == "FF"


def test_a_page_is_saved_where_there_is_a_folder_and_it_is_frozen(tmp_path: Path) -> None:
    s = slave(save=tmp_path / "tuned")
    for command, answer in (
        ("F9 02 00 00", "FE 22"), ("F9 00 00 00", "FE 22"), ("F9 01 00 00", "FE 27"), ("E5 00 00", "FF 00 00"),
        ("E6 01 00", "FF"), ("E5 00 00", "FF 00 01"), ("F9 01 00 00", "FF, FD 03"), ("E6 00 00", "FF"),
        ("E5 00 00", "FF 00 00"), ("F9 01 00 00", "FE 27"),
    ):  # fmt: skip
        assert asked(s, command) == answer, command
    assert sorted(f.name for f in (tmp_path / "tuned").iterdir()) == [
        "calibration.toml", "stroke_tables.toml", "vane_angles.toml"
    ]  # fmt: skip
    file = tmp_path / "file"
    file.write_text("")
    for folder, answer in ((None, "FE 24"), (file, "FE 24")):
        s = slave(save=folder)
        asked(s, "E6 01 00")
        assert asked(s, "F9 01 00 00") == answer


def test_why_a_command_was_refused_is_kept_in_words() -> None:
    s = slave()
    for command, why in (
        ("C5", "0xc5"),
        ("F6 00", "8 bytes, here 2"),
        ("F9 03 00 00", "0x3"),
        ("EB 01 01 00", "segment"),
    ):
        asked(s, command)
        assert why in s.why


# ---- measurement lists: making them ----------------------------------------------------------------------------------


def script(s: Slave, rows: list[tuple[str, str]]) -> None:
    """Commands with their answers, in order."""
    for command, answer in rows:
        assert asked(s, command) == answer, command


def test_lists_are_made_in_their_order() -> None:
    s = slave()
    script(s, [
        ("D5 00 01 00", "FE 29"), ("D4 00 00 00 01", "FE 29"), ("D3 00 00 00 00 01", "FE 29"), ("D6", "FF"),
        ("D4 00 00 00 01", "FE 29"), ("D3 00 00 00 00 01", "FE 29"), ("D5 00 02 00", "FF"), ("D5 00 02 00", "FE 29"),
        ("D3 00 00 00 00 01", "FE 29"), ("D4 00 00 00 01", "FF"), ("D5 00 02 00", "FE 29"), ("D4 00 01 00 02", "FF"),
        ("D4 00 00 00 01", "FF"), ("D4 00 02 00 01", "FE 22"), ("D3 00 00 00 00 01", "FF"), ("D4 00 00 00 01", "FE 29"),
        ("D5 00 02 00", "FE 29"), ("D3 00 01 00 01 02", "FF"), ("D3 00 01 00 02 01", "FE 22"),
        ("D3 00 02 00 00 01", "FE 22"), ("D3 00 00 00 00 01", "FF"), ("D6", "FF"), ("DA", "FF 93 00 00 02 00 00 00"),
        ("D5 00 01 00", "FF"),
    ])  # fmt: skip
    daq = Daq(s.memory, 0x6E1)
    with pytest.raises(Refusal):
        daq.allocate_lists(1)
    assert daq.overloads == 0 and not daq.running


def test_there_is_room_for_16_lists_64_tables_and_7_entries() -> None:
    s = slave()
    script(s, [
        ("D6", "FF"), ("D5 00 11 00", "FE 30"), ("D5 00 10 00", "FF"), ("DA", "FF 93 10 00 02 00 00 00"),
        ("D4 00 0F 00 41", "FE 30"), ("D4 00 0F 00 3F", "FF"), ("D4 00 00 00 02", "FE 30"), ("D4 00 00 00 01", "FF"),
        ("D4 00 00 00 01", "FE 30"), ("D4 00 10 00 00", "FE 22"), ("D3 00 0F 00 3E 08", "FE 30"),
        ("D3 00 0F 00 3E 07", "FF"), ("D3 00 0F 00 3E 01", "FE 30"), ("D3 00 0F 00 3D 03", "FF"),
        ("D3 00 0F 00 3D 04", "FF"), ("D3 00 0F 00 3D 01", "FE 30"), ("D3 00 0F 00 3F 01", "FE 22"),
        ("E2 00 0F 00 3E 06", "FF"), ("E2 00 0F 00 3E 07", "FE 22"), ("E2 00 0F 00 3F 00", "FE 22"),
        ("E2 00 10 00 00 00", "FE 22"), ("E2 00 00 00 00 00", "FE 22"), ("DB", "FF FF 00 00 00 00 00 00"),
        ("DB", "FE 22"),
    ])  # fmt: skip


def listed(*tables: int, entries: int = 1) -> Slave:
    """A slave with one list a number, of so many tables, each with its entries written, and a mode."""
    s = slave()
    all_of(s, "D6", f"D5 00 {len(tables):02X} 00")
    for i, n in enumerate(tables):
        all_of(s, f"D4 00 {i:02X} 00 {n:02X}")
    for i, n in enumerate(tables):
        for t in range(n):
            all_of(s, f"D3 00 {i:02X} 00 {t:02X} {entries:02X}", f"E2 00 {i:02X} 00 {t:02X} 00")
            for e in range(entries):
                assert asked(s, entry(4 // entries, 1, STATES + 4 * (3 * i + t) + e * 4 // entries)) == "FF"
        all_of(s, f"E0 10 {i:02X} 00 00 00 01 00")
    return s


@pytest.mark.parametrize("table", [0, 1])
def test_a_table_has_room_for_its_bytes_and_the_first_for_the_time_too(table: int) -> None:
    room = 7 if table else 5
    s = slave()
    all_of(s, "D6", "D5 00 01 00", "D4 00 00 00 02", f"D3 00 00 00 {table:02X} 03")
    assert asked(s, entry(1, 0, STATES)) == "FE 29" and asked(s, "DB") == "FE 29", "no pointer"
    asked(s, f"E2 00 00 00 {table:02X} 00")
    for size in (0, room + 1):
        assert asked(s, entry(size, 0, STATES)) == "FE 22"
    assert asked(s, entry(1, 0, STATES, bit=0)) == "FE 22" and asked(s, entry(1, 0, STATES, bit=0xFE)) == "FE 22"
    assert asked(s, entry(1, 2, STATES)) == "FE 22" and asked(s, entry(2, 0, OUTPUT + 31)) == "FE 22"
    assert asked(s, entry(room, 0, STATES)) == "FF", "and the pointer moves on"
    assert asked(s, entry(1, 0, STATES)) == "FE 22", "it is full"
    asked(s, f"E2 00 00 00 {table:02X} 00")
    assert asked(s, entry(room - 3, 0, STATES + 9)) == "FF", "written over, it counts once"
    assert asked(s, entry(3, 1, CAL + 2)) == "FF"
    assert asked(s, entry(1, 0, STATES)) == "FE 22"
    asked(s, f"E2 00 00 00 {table:02X} 01")
    assert asked(s, entry(2, 1, CAL + 2)) == "FF" and asked(s, entry(1, 0, OUTPUT + 31)) == "FF"
    assert asked(s, entry(1, 0, STATES)) == "FE 22", "behind the last entry"
    asked(s, f"E2 00 00 00 {table:02X} 00")
    script(s, [
        ("DB", f"FF FF {room - 3:02X} 00 09 00 00 12"), ("DB", "FF FF 02 01 02 00 00 20"),
        ("DB", "FF FF 01 00 1F 00 00 11"), ("DB", "FE 22"),
    ])  # fmt: skip


def test_the_mode_of_a_list_says_its_event() -> None:
    s = listed(1, 1)
    script(s, [
        ("E0 00 00 00 00 00 01 00", "FE 27"), ("E0 12 00 00 00 00 01 00", "FE 27"),
        ("E0 11 00 00 00 00 01 00", "FE 27"),
        ("E0 30 00 00 00 00 01 00", "FE 27"), ("E0 03 00 00 00 00 01 00", "FE 27"),
        ("E0 10 00 00 02 00 01 00", "FE 22"),
        ("E0 10 00 00 00 00 00 00", "FE 22"), ("E0 10 00 00 02 00 00 00", "FE 22"),
        ("E0 10 02 00 00 00 01 00", "FE 22"),
        ("DF 00 00 00", "FF 10 00 00 00 00 01 00"), ("E0 10 00 00 01 00 FF 07", "FF"),
        ("DF 00 00 00", "FF 10 00 00 01 00 FF 07"), ("DF 00 01 00", "FF 10 00 00 00 00 01 00"),
        ("DE 02 00 00", "FF 00"), ("DF 00 00 00", "FF 11 00 00 01 00 FF 07"), ("DE 01 00 00", "FF 00"),
        ("DF 00 00 00", "FF 51 00 00 01 00 FF 07"), ("E0 10 00 00 01 00 01 00", "FE 11"),
        ("E2 00 00 00 00 00", "FE 11"), ("DE 00 00 00", "FF 00"), ("DF 00 00 00", "FF 10 00 00 01 00 FF 07"),
        ("E2 00 00 00 00 00", "FF"), ("E1 FF 04 01 00 00 00 12", "FF"), ("DF 00 02 00", "FE 22"),
        ("DE 03 00 00", "FE 27"), ("DE 01 02 00", "FE 22"),
        ("DE FF 01 00", "FE 27"), ("D7 00 01 00", "FF 8C FF 05 0A 06 00"),
        ("F5 05", "FF 31 30 20 6D 73"), ("D7 00 02 00", "FE 22"), ("D7 00 00 01", "FE 22"),
        ("D7 00 00 00", "FF 8C FF 04 01 06 00"), ("F5 04", "FF 31 20 6D 73"),
    ])  # fmt: skip


def test_a_fresh_list_has_no_event_and_is_neither_selected_nor_running() -> None:
    s = slave()
    all_of(s, "D6", "D5 00 02 00")
    script(s, [
        ("DF 00 00 00", "FF 10 00 00 00 00 01 00"), ("DE 00 01 00", "FF 00"), ("DE 01 00 00", "FE 2A"),
        ("E0 10 00 00 00 00 01 00", "FF"), ("DE 01 00 00", "FE 2A"), ("DE 02 00 00", "FE 2A"), ("D4 00 00 00 01", "FF"),
        ("D3 00 00 00 00 01", "FF"), ("DE 01 00 00", "FE 2A"), ("E2 00 00 00 00 00", "FF"),
        ("E1 FF 04 01 00 00 00 12", "FF"), ("DE 02 00 00", "FF 00"), ("DE 01 00 00", "FF 00"), ("DE 01 01 00", "FE 2A"),
        ("FD", "FF 40 00 00 00 00"),
    ])  # fmt: skip
    s = slave()
    all_of(
        s, "D6", "D5 00 01 00", "D4 00 00 00 01", "D3 00 00 00 00 01", "E2 00 00 00 00 00", "E1 FF 04 01 00 00 00 12"
    )
    assert asked(s, "DE 01 00 00") == "FE 2A", "no event"


def test_a_list_s_frames_are_numbered_behind_those_of_the_lists_before() -> None:
    s = listed(2, 3, 1)
    script(s, [("DE 02 00 00", "FF 00"), ("DE 02 01 00", "FF 02"), ("DE 02 02 00", "FF 05"), ("DE 01 02 00", "FF 05")])


def test_clearing_a_list_stops_it_and_keeps_its_tables() -> None:
    s = listed(1, 1)
    all_of(s, "DE 01 00 00", "DE 01 01 00")
    script(s, [
        ("E3 00 02 00", "FE 22"), ("E3 00 00 00", "FF"), ("DF 00 00 00", "FF 10 00 00 00 00 01 00"),
        ("DF 00 01 00", "FF 50 00 00 00 00 01 00"), ("E2 00 00 00 00 00", "FF"), ("DB", "FF FF 00 00 00 00 00 00"),
        ("DE 01 00 00", "FE 2A"), ("E2 00 00 00 00 01", "FE 22"), ("E2 00 01 00 00 00", "FE 11"),
        ("DE 00 01 00", "FF 01"), ("E2 00 01 00 00 00", "FF"), ("DB", "FF FF 04 01 0C 00 00 12"),
    ])  # fmt: skip


def runs(s: Slave) -> list[int]:
    """The lists' words of selected and running."""
    return [int(asked(s, f"DF 00 {i:02X} 00")[3:5], 16) & 0x41 for i in range(len(s.daq.lists))]


def test_selected_lists_are_started_and_stopped_together() -> None:
    s = listed(1, 1, 1)
    all_of(s, "DE 02 00 00", "DE 02 02 00")
    assert runs(s) == [1, 0, 1] and asked(s, "DD 03") == "FE 27" and runs(s) == [1, 0, 1]
    assert asked(s, "DD 01") == "FF" and runs(s) == [0x40, 0, 0x40]
    all_of(s, "DE 01 01 00", "DE 02 00 00")
    assert runs(s) == [0x41, 0x40, 0x40]
    assert asked(s, "DD 02") == "FF" and runs(s) == [0, 0x40, 0x40]
    asked(s, "DE 02 00 00")
    assert asked(s, "DD 00") == "FF" and runs(s) == [0, 0, 0], "all of them, and none is selected any more"


def test_where_one_selected_list_is_not_complete_none_is_started() -> None:
    s = listed(1, 1)
    all_of(s, "DE 02 00 00", "DE 02 01 00", "D3 00 01 00 00 01")
    assert asked(s, "DD 01") == "FE 2A" and runs(s) == [1, 1]


def test_the_clock_is_the_next_tick_s_in_32_bits() -> None:
    s = slave()
    s.k = 0x1_0203_0405
    assert asked(s, "DC") == "FF 00 00 00 05 04 03 02"
    s.sample(41)
    assert s.k == 42 and asked(s, "DC") == "FF 00 00 00 2A 00 00 00"


# ---- measurement lists: what they send -------------------------------------------------------------------------------


def sampled(s: Slave, k: int) -> list[str]:
    """The frames of tick ``k``."""
    rows = s.sample(k).tolist()
    assert all(head & 0x7FF == 0x6E1 for head, _ in rows)
    return [data_of(head, data).hex(" ").upper() for head, data in rows]


def test_a_frame_is_its_number_the_time_in_the_first_table_and_the_bytes() -> None:
    s = slave()
    s.memory.loop.z[:] = np.arange(162) + 0.1
    all_of(s, "D6", "D5 00 01 00", "D4 00 00 00 02", "D3 00 00 00 00 02", "D3 00 00 00 01 02")
    all_of(s, "E2 00 00 00 00 00")
    for size, ext, address in ((4, 1, STATES + 4), (1, 0, STATES + 8 * 5 + 7)):
        assert asked(s, entry(size, ext, address)) == "FF"
    all_of(s, "E2 00 00 00 01 00")
    for size, ext, address in ((3, 0, STATES + 8 * 7), (4, 1, CAL + 4 * 12)):
        assert asked(s, entry(size, ext, address)) == "FF"
    all_of(s, "E0 10 00 00 00 00 01 00", "DE 01 00 00")
    single, kp = np.float32(1.1).tobytes().hex(" ").upper(), np.float32(16.0).tobytes().hex(" ").upper()
    fifth, seventh = struct.pack("<d", 5.1)[7:], struct.pack("<d", 7.1)[:3].hex(" ").upper()
    for k, time in ((0, "00 00"), (1, "01 00"), (0x1234, "34 12"), (65_536 + 0xFFFE, "FE FF"), (65_536, "00 00")):
        assert sampled(s, k) == [f"00 {time} {single} {fifth.hex().upper()}", f"01 {seventh} {kp}"]
    s.memory.loop.z[1] = 2.0
    assert sampled(s, 9)[0] == "00 09 00 00 00 00 40 " + fifth.hex().upper(), "of this tick"


@pytest.mark.parametrize(
    ("event", "prescaler", "period"), [(0, 1, 1), (0, 3, 3), (1, 1, 10), (1, 4, 40), (0, 255, 255)]
)
def test_a_list_is_sampled_with_its_event_and_prescaler(event: int, prescaler: int, period: int) -> None:
    s = listed(1)
    all_of(s, f"E0 10 00 00 0{event} 00 {prescaler:02X} 00", "DE 01 00 00")
    assert [k for k in range(600) if sampled(s, k)] == list(range(0, 600, period))
    all_of(s, "DE 00 00 00")
    assert not any(sampled(s, k) for k in range(600))


def test_lists_of_a_tick_come_by_their_priority_then_by_their_number() -> None:
    s = listed(1, 2, 1, 1)
    for i, priority in enumerate((0, 1, 7, 1)):
        all_of(s, f"E0 10 {i:02X} 00 00 00 01 {priority:02X}", f"DE 01 {i:02X} 00")
    assert [f[:2] for f in sampled(s, 5)] == ["03", "01", "02", "04", "00"]
    assert [f[3:8] for f in sampled(s, 5)].count("05 00") == 4, "each list has the time once"
    all_of(s, "DE 00 02 00")
    assert [f[:2] for f in sampled(s, 5)] == ["01", "02", "04", "00"]


def test_beyond_32_frames_whole_lists_are_left_out_and_later_ones_that_fit_are_not() -> None:
    s = listed(20, 13, 12, 1)
    all_of(s, "DD 00", *(f"DE 01 0{i} 00" for i in range(3)))
    assert [int(f[:2], 16) for f in sampled(s, 0)] == [*range(20), *range(33, 45)] and s.daq.overloads == 1
    all_of(s, "DE 01 03 00")
    assert len(sampled(s, 1)) == 32 and s.daq.overloads == 3


def test_an_overload_is_told_at_once_and_again_after_100_ticks_while_it_lasts() -> None:
    s = listed(33)
    all_of(s, "DE 01 00 00")
    told = []
    for k in range(251):
        assert sampled(s, k) == []
        if out := s.late():
            assert out == [b"\xfd\x06"]
            told.append(k)
    assert told == [0, 100, 200]
    assert asked(s, "FE") == "FF" and asked(s, "FF 00")[:2] == "FF"
    s.k = 1000
    assert s.late() == [], "a new session is not told of the old one's"


# ---- STIM ------------------------------------------------------------------------------------------------------------


def stim(*names: str, extra: int = 0) -> Slave:
    """A slave with one STIM list, a table for each input, which runs; before it ``extra`` tables of another list."""
    s = slave()
    all_of(s, "D6", "D5 00 02 00", f"D4 00 00 00 {extra:02X}", f"D4 00 01 00 {len(names):02X}")
    for t, name in enumerate(names):
        all_of(s, f"D3 00 01 00 {t:02X} 01", f"E2 00 01 00 {t:02X} 00")
        assert asked(s, entry(4, 1, INPUT + 4 * INPUTS.index(name))) == "FF"
    all_of(s, "E0 02 01 00 00 00 01 00", "DF 00 01 00")
    assert asked(s, "DF 00 01 00") == "FF 02 00 00 00 00 01 00"
    assert asked(s, "DE 01 01 00") == f"FF {extra:02X}" and asked(s, "DF 00 01 00")[:5] == "FF 42"
    return s


def frame(pid: int, *values: float) -> bytes:
    """A frame of a STIM list."""
    return bytes([pid]) + struct.pack(f"<{len(values)}f", *values)


def given(s: Slave) -> dict[str, float]:
    """The inputs that are given now, by name."""
    return {INPUTS[i]: v for i, v in s.daq.stimulus.given.items()}


@pytest.mark.parametrize("extra", [0, 3])
def test_inputs_are_given_with_the_list_s_last_frame_if_all_have_come(extra: int) -> None:
    s = stim("n_dem", "n_r", "x_lvdt", extra=extra)
    s.command(frame(extra, 81.0))
    s.command(frame(extra + 1, 80.0))
    assert given(s) == {}
    s.command(frame(extra + 3, 1.0))
    s.command(frame(max(extra - 1, 90), 1.0))
    assert given(s) == {}
    s.command(frame(extra + 2, 0.03125))
    assert given(s) == {"n_dem": 81.0, "n_r": 80.0, "x_lvdt": 0.03125}
    s.command(frame(extra + 2, 0.0625))
    assert given(s)["x_lvdt"] == 0.03125, "the others have not come again"
    s.command(frame(extra, 82.0))
    s.command(frame(extra + 1, 80.5)[:4])
    s.command(frame(extra + 2, 0.0625))
    assert given(s)["n_dem"] == 81.0, "a frame is too short"
    s.command(frame(extra + 1, 80.5))
    s.command(frame(extra + 2, 0.0625) + b"\1\2")
    assert given(s) == {"n_dem": 82.0, "n_r": 80.5, "x_lvdt": 0.0625}


def test_two_inputs_of_one_table_stand_side_by_side() -> None:
    s = stim("n_dem", "x_lvdt")
    s.daq.lists[1].tables[1] += [Entry(4, 1, INPUT + 4, 6, 4)]
    assert asked(s, "DE 01 01 00") == "FF 00"
    s.command(frame(0, 81.0))
    s.command(frame(1, 0.25))
    assert given(s) == {}, "half of the table is missing"
    s.command(frame(1, 0.25, 79.0))
    assert given(s) == {"n_dem": 81.0, "x_lvdt": 0.25, "n_r": 79.0}


def test_a_stim_list_that_does_not_run_gives_nothing_and_has_no_frames() -> None:
    s = stim("n_dem")
    assert sampled(s, 0) == [] and s.daq.running
    all_of(s, "DE 00 01 00")
    s.command(frame(0, 81.0))
    assert given(s) == {}


def test_while_stim_is_locked_no_list_becomes_one() -> None:
    s = slave(locked=("stim",))
    all_of(s, "D6", "D5 00 01 00", "D4 00 00 00 01", "D3 00 00 00 00 01")
    assert asked(s, "E0 02 00 00 00 00 01 00") == "FE 25" and asked(s, "E0 10 00 00 00 00 01 00") == "FF"
    seed = bytes.fromhex(asked(s, "F8 00 08"))[2:]
    assert asked(s, b"\xf7\x06" + key_of("stim", seed)) == "FF 00" and asked(s, "E0 02 00 00 00 00 01 00") == "FF"


def test_while_a_list_runs_none_grows_and_its_entries_stay() -> None:
    s = stim("n_dem", "n_r", extra=1)
    script(s, [
        ("D5 00 01 00", "FE 11"), ("D4 00 00 00 01", "FE 11"), ("D4 00 01 00 01", "FE 11"),
        ("D3 00 01 00 00 01", "FE 11"), ("D3 00 00 00 00 01", "FE 11"), ("E2 00 01 00 00 00", "FE 11"),
        ("E2 00 00 00 00 00", "FE 22"), ("E0 10 01 00 00 00 01 00", "FE 11"),
        ("DF 00 01 00", "FF 42 00 00 00 00 01 00"),
    ])  # fmt: skip
    s.command(frame(1, 81.0))
    s.command(frame(2, 80.0))
    assert given(s) == {"n_dem": 81.0, "n_r": 80.0}
    all_of(s, "DE 00 01 00", "D3 00 01 00 00 01", "D3 00 00 00 00 01")
    assert asked(s, "DE 01 01 00") == "FE 2A", "an entry was not written"


def test_locked_measurement_locks_stim() -> None:
    s = stim("n_dem")
    s._locked = 1
    s.command(frame(0, 81.0))
    assert given(s) == {"n_dem": 81.0}
    s._locked = 4
    s.command(frame(0, 82.0))
    assert given(s) == {"n_dem": 81.0}


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_is_not_given(value: float) -> None:
    s = stim("n_dem", "x_lvdt")
    s.command(frame(0, 81.0))
    s.command(frame(1, value))
    assert given(s) == {"n_dem": 81.0} and np.isnan(s.memory.loop.lvdt).all()
    s.command(frame(0, value))
    s.command(frame(1, 0.5))
    assert given(s) == {"n_dem": 81.0, "x_lvdt": 0.5}


@pytest.mark.parametrize("how", ["stop", "all", "free", "clear", "disconnect", "time"])
def test_given_inputs_end_with_their_list_and_after_100_ticks(how: str) -> None:
    s = stim("n_dem", "x_lvdt", "vgv1")
    loop = s.memory.loop
    pots = loop.pots.copy()
    s.k = 1000
    for i, value in enumerate((81.0, 0.03125, 0.25)):
        s.command(frame(i, value))
    assert loop.lvdt.tolist() == [0.03125] and loop.pots[0].tolist() == [1.0, 0.0, 0.0, 0.25, 1.0, 0.0]
    rows = np.zeros((0, 2), np.int64)
    s.daq.stimulus.change(1099, rows, 0)
    assert len(given(s)) == 3
    if how == "time":
        s.daq.stimulus.change(1100, rows, 0)
    else:
        asked(s, {"stop": "DE 00 01 00", "all": "DD 00", "free": "D6", "clear": "E3 00 01 00", "disconnect": "FE"}[how])
    assert given(s) == {} and np.isnan(loop.lvdt).all() and (loop.pots == pots).all()


def test_stopping_a_measurement_leaves_what_is_given() -> None:
    s = stim("n_dem", extra=1)
    all_of(
        s, "DE 00 01 00", "D3 00 00 00 00 01", "E2 00 00 00 00 00", "E1 FF 04 01 00 00 00 12",
        "E0 10 00 00 00 00 01 00", "DE 01 00 00",
        "DE 01 01 00",
    )  # fmt: skip
    s.command(frame(1, 81.0))
    all_of(s, "DE 00 00 00")
    assert given(s) == {"n_dem": 81.0}


@pytest.mark.parametrize(("name", "i"), [(n, i) for i, n in enumerate(INPUTS)])
def test_which_inputs_may_be_given(name: str, i: int) -> None:
    s = slave()
    all_of(
        s, "D6", "D5 00 01 00", "D4 00 00 00 01", "D3 00 00 00 00 01", "E0 02 00 00 00 00 01 00", "E2 00 00 00 00 00"
    )
    may = name in ("n_dem", "n_r", "mode_request", "x_lvdt", "vigv", "vgv1", "vgv2")
    assert asked(s, entry(4, 1, INPUT + 4 * i)) == ("FF" if may else "FE 23")
    for size, ext, address in ((4, 1, INPUT + 4 * i + 1), (3, 1, INPUT + 4 * i), (4, 0, INPUT + 8 * i)):
        asked(s, "E2 00 00 00 00 00")
        assert asked(s, entry(size, ext, address)) == "FE 22"


def test_what_is_no_input_cannot_be_given() -> None:
    s = slave()
    for size, ext, address in (
        (4, 1, INPUT + 60),
        (4, 1, INPUT - 4),
        (4, 1, OUTPUT),
        (4, 1, 0),
        (5, 1, INPUT),
        (4, 2, INPUT),
    ):
        with pytest.raises(Refusal) as e:
            s.daq.stimulus.number(size, ext, address)
        assert e.value.code == 0x22
    assert s.daq.stimulus.number(4, 1, INPUT) == 0


@pytest.mark.parametrize(("request_", "sent"), [(-5.0, 0), (0.0, 0), (1.9, 1), (3.0, 3), (9.0, 3)])
def test_given_speeds_and_request_go_into_the_ecu_s_good_frames(request_: float, sent: int) -> None:
    s = slave()
    rows = np.array([(word0(ECU_DEMAND), encode_demand(70.0, 71.0, 1, 5)), row_of(0x123, b"abc")], np.int64)
    stimulus = s.daq.stimulus
    same, n = stimulus.change(0, rows, 2)
    assert same is rows and n == 2
    stimulus.give(0, {5: 0.03})
    same, n = stimulus.change(1, rows, 2)
    assert same is rows, "the stroke is not in a frame"
    for values, wanted in (
        ({0: 81.0}, (81.0, 71.0, 1)), ({1: 64.0}, (81.0, 64.0, 1)), ({4: request_}, (81.0, 64.0, sent)),
    ):  # fmt: skip
        stimulus.give(0, values)
        out, n = stimulus.change(1, rows, 2)
        assert decode_demand(int(out[0, 1])) == pytest.approx(wanted, abs=2e-3)
        assert n == 2 and (out[1] == rows[1]).all() and decode_demand(int(rows[0, 1]))[0] == 70.0
    assert len(stimulus.change(1, rows, 1)[0]) == 1


# ---- on the bus ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("data", [b"", b"\x01", b"\xff" * 8, b"\x80\0\0\0\0\0\0\xfe", b"\1\2\3"])
def test_a_row_is_identifier_length_and_bytes(data: bytes) -> None:
    head, number = row_of(0x6E1, data)
    assert head == 0x6E1 | len(data) << 32 and number == int.from_bytes(data.ljust(8, b"\0"), "little", signed=True)
    assert np.array([(head, number)], np.int64).tolist() == [[head, number]] and data_of(head, number) == data


class Listener:
    """A service that takes note of all that it is asked; what it hears is a frame's ``cost`` of work."""

    name, counts, cost = "listener", {"dropped": 0}, 1  # noqa: RUF012

    def __init__(self, memory: Memory, *idents: int, silent: bool = False):
        self.lock, self.todo, self.worked = Lock("listener", 8, 5), 0, 0
        self.memory, self.idents, self.silent = memory, idents, silent
        self.heard: list[tuple[int, bytes]] = []
        self.calls: list[str] = []
        self.sends: np.ndarray | None = None

    def hear(self, ident: int, data: bytes) -> None:
        self.heard.append((ident, data))
        self.todo += 1

    def work(self) -> int:
        if not self.todo:
            return 0
        self.todo, self.worked = self.todo - 1, self.worked + 1
        return self.cost

    def change(self, k: int, rows: np.ndarray, n: int) -> tuple[np.ndarray, int]:
        self.calls.append(f"change {k} {n} {len(rows)}")
        return rows, n

    def before(self, k: int) -> None:
        self.calls.append(f"before {k}")

    def after(self, k: int) -> np.ndarray | None:
        self.calls.append(f"after {k}")
        return self.sends


def test_a_tool_s_frames_go_to_its_service_only_and_are_kept_from_the_firmware() -> None:
    node = Node(*shipped())
    memory = Memory(node)
    one, two = Listener(memory, 0x6E0), Listener(memory, 0x7E0, 0x7DF)
    attended = Attended(node, one, two)
    assert not attended.told
    rows = [
        row_of(0x6E0, b"\1\2"), row_of(0x7DF, b"\3"), row_of(0x7E0, b"\4" * 8), row_of(0x6E1, b"\5"),
        row_of(0x123, b""),
        *((head | kind, data) for kind in (EXTENDED, REMOTE, ERROR, FD) for head, data in [row_of(0x6E0, b"\6")]),
    ]  # fmt: skip
    received = np.array(rows, np.int64)
    attended.tick(received)
    assert one.heard == [(0x6E0, b"\1\2")] and two.heard == [(0x7DF, b"\3"), (0x7E0, b"\4" * 8)]
    assert one.calls == ["before 0", "change 0 2 2", "after 0"] == two.calls
    assert node.counts["other"] == 2 and attended.k == 1 and attended.mode == "INIT"
    one.calls.clear()
    attended.tick(received, 1)
    assert one.calls[1] == "change 1 0 0" and node.counts["other"] == 2
    attended.tick(received[4:], 1)
    assert one.calls[4] == "change 2 1 5" and node.counts["other"] == 3, "without a tool's frame they are handed on"


def test_a_silent_service_keeps_the_controller_s_own_frames_back() -> None:
    for silent in ((False, False), (False, True), (True, False)):
        node = Node(*shipped())
        memory = Memory(node)
        services = [Listener(memory, 0x700 + i, silent=q) for i, q in enumerate(silent)]
        services[0].sends = np.array([row_of(0x701, b"\1")], np.int64)
        out = Attended(node, *services).tick(np.zeros((0, 2), np.int64))
        assert len(out) == (1 if any(silent) else 5) and out[-1].tolist() == list(row_of(0x701, b"\1"))
        services[0].sends = None
        for _ in range(9):
            assert len(Attended(node, *services).tick(np.zeros((0, 2), np.int64))) == 0
        out = Attended(node, *services).tick(np.zeros((0, 2), np.int64))
        assert out.shape == ((0, 2) if any(silent) else (3, 2))


class Held:
    """Work that is done when a test says so."""

    def __init__(self) -> None:
        self.begun: list[tuple[int, str]] = []
        self.result: tuple[int, Any] = (0, None)

    def begin(self, number: int, name: str, arguments: tuple[Any, ...]) -> None:
        self.begun.append((number, name))

    def done(self) -> tuple[int, Any]:
        return self.result


def test_a_task_acts_when_it_is_done_or_is_given_up_after_1500_ticks() -> None:
    held = Held()
    desk = Desk(held)  # type: ignore[arg-type]
    said: list[Any] = []
    task = Task("judge", (), said.append)

    def then(why: Refusal | None) -> None:
        said.append(why.code if why else "done")

    desk.before(100, 0)
    assert not desk.waiting and desk.note() == 0
    desk.begin(task, then)
    assert desk.waiting and held.begun == [(1, "judge")] and desk.note() == 0
    with pytest.raises(Refusal) as e:
        desk.begin(task, then)
    assert e.value.code == 0x10
    for k in (100, 101, 1599):
        desk.before(k, 0)
    desk.before(1599, 7)
    assert desk.waiting and said == []
    desk.before(1600, 0)
    assert not desk.waiting and said == [0x10]
    desk.before(1601, 0)
    assert said == [0x10]
    held.result = (1, "late")
    assert desk.note() == 0
    desk.begin(task, then)
    assert held.begun[1] == (2, "judge") and desk.note() == 0
    held.result = (2, "found")
    assert desk.note() == 2
    desk.before(1602, 2)
    assert said == [0x10, "found", "done"] and desk.note() == 0

    def refuse(found: Any) -> None:
        raise Refusal(0x32, "no")

    desk.begin(Task("save", (), refuse), then)
    held.result = (3, "")
    desk.before(1603, 3)
    assert said[3:] == [0x32] and not desk.waiting


def test_a_note_among_the_frames_says_that_work_is_done() -> None:
    for told in (False, True):
        node = Node(*shipped())
        memory = Memory(node)
        memory.desk = desk = Desk(held := Held())  # type: ignore[arg-type]
        attended = Attended(node, Listener(memory, 0x6E0), told=told)
        said: list[Any] = []
        rows = np.zeros((3, 2), np.int64)
        rows[0] = row_of(0x123, b"")
        assert attended.heed(rows, 3) == 3, "there is no room for it"
        assert attended.heed(rows, 1) == 2 and rows[1].tolist() == [SEEDS, 5], "once, of the seeds"
        rows[1] = 0
        assert attended.heed(rows, 1) == 1
        desk.begin(Task("judge", (), said.append), lambda why: None)
        assert attended.heed(rows, 1) == 1 and not rows[1:].any()
        held.result = (1, "x")
        assert attended.heed(rows, 3) == 3, "there is no room for it"
        assert attended.heed(rows, 2) == 3 and rows[2].tolist() == [PREPARED, 1] and not rows[1].any()
        assert attended.heed(rows, 1) == 2 and rows[1].tolist() == [PREPARED, 1]
        attended.tick(rows[:1])
        assert said == ([] if told else ["x"])
        attended.tick(rows[:2])
        assert said == ["x"] and node.counts["other"] == 2 and node.counts["error_frames"] == 0


def test_recorded_frames_are_given_in_their_ticks() -> None:
    node = Node(*shipped())
    memory = Memory(node)
    listener = Listener(memory, 0x6E0)
    frames = np.array([row_of(0x6E0, bytes([i])) for i in range(4)], np.int64)
    seen: list[tuple[int, bytes]] = []
    listener.hear = lambda ident, data: seen.append((node.k, data))  # type: ignore[method-assign]
    ticks, sent = replay_attended(Attended(node, listener), np.array([0, 2, 2, 11]), frames, 12)
    assert seen == [(0, b"\0"), (2, b"\1"), (2, b"\2"), (11, b"\3")]
    assert ticks.tolist() == [0] * 4 + [10] * 3 and sent.shape == (7, 2) and len(set(sent[:, 0].tolist())) == 4
    ticks, sent = replay_attended(Attended(node, listener), np.array([], np.int64), frames[:0], 0)
    assert ticks.shape == (0,) and sent.shape == (0, 2)


def test_8_commands_are_carried_out_before_a_tick_and_4_answers_go_out_after_it() -> None:
    s = slave()
    service = XcpService(s)
    attended = Attended(s.memory.node, service)
    assert service.idents == (0x6E0,) and not service.silent and service.memory is s.memory and service.dropped == 0
    assert service.after(0) is None
    for _ in range(9):
        service.hear(0x6E0, b"\xfd")
    service.before(7)
    attended._work()
    assert s.k == 7 and len(service._in) == 1 and len(service._out) == 8
    out = service.after(7)
    assert out is not None and out.tolist() == [list(row_of(0x6E1, bytes.fromhex("FF0000000000")))] * 4
    service.before(8)
    attended._work()
    assert [len(x) for x in (service.after(8), service.after(9))] == [4, 1] and service.after(10) is None  # type: ignore


def test_256_commands_are_kept_the_oldest_go_and_are_counted() -> None:
    service = XcpService(slave())
    for n in range(259):
        service.hear(0x6E0, bytes([n & 0xFF, n >> 8]))
    assert list(service._in) == [bytes([n & 0xFF, n >> 8]) for n in range(3, 259)] and service.counts == {"dropped": 3}


def test_all_services_together_have_a_tick_s_work_and_take_turns() -> None:
    node = Node(*shipped())
    memory = Memory(node)
    one, two = Listener(memory, 0x6E0), Listener(memory, 0x7E0)
    attended = Attended(node, one, two)
    both = np.array([row_of(i, b"") for i in (0x6E0, 0x7E0) for _ in range(20)], np.int64)
    attended.tick(both)
    assert (one.worked, two.worked) == (4, 4) and attended.lost == {"listener": {"dropped": 0}}
    two.cost = 2
    attended.tick(both[:0])
    assert (one.worked, two.worked) == (7, 7), "the last one of a tick may go beyond"
    one.todo = 0
    attended.tick(both[:0])
    assert (one.worked, two.worked) == (7, 11)
    two.todo = 0
    attended.tick(both[:1])
    assert (one.worked, two.worked) == (8, 11)


def test_with_more_than_256_answers_no_command_is_taken() -> None:
    service = XcpService(slave())
    for n, taken in ((256, 1), (257, 0)):
        service._out.clear()
        service._out.extend([b"\xff"] * n)
        service._in.clear()
        service._in.extend([b"\xfd"] * 3)
        assert service.work() == taken
        assert len(service._in) == 3 - taken and len(service._out) == n + taken


def test_while_a_check_waits_no_command_is_taken_and_its_answer_comes_with_the_effect() -> None:
    s = slave()
    s.memory.desk = desk = Desk(held := Held())  # type: ignore[arg-type]
    service = XcpService(s)
    for command in ("EB 01 00 01", "FD"):
        service.hear(0x6E0, bytes.fromhex(command))
    service.before(0)
    assert [service.work() for _ in range(3)] == [8, 0, 0], "a page takes all of a tick's work"
    assert service.after(0) is None and s.waiting and len(service._in) == 1
    held.result = (1, "")
    desk.before(1, 1)
    service.before(1)
    assert service.work() == 1
    out = service.after(1)
    assert out is not None and [data_of(h, d).hex() for h, d in out.tolist()] == ["ff", "ff0000000000"]
    assert s.memory.ecu_page == 1 and not s.waiting


def test_measurements_come_behind_the_answers() -> None:
    s = listed(1)
    service = XcpService(s)
    service.hear(0x6E0, bytes.fromhex("DE010000"))
    service.before(3)
    assert service.work() == 8
    out = service.after(3)
    assert out is not None and [data_of(h, d)[:3].hex() for h, d in out.tolist()] == ["ff00", "000300"]
    out = service.after(4)
    assert out is not None and len(out) == 1
    s = listed(33)
    all_of(s, "DE 01 00 00")
    service = XcpService(s)
    out = service.after(5)
    assert out is not None and [data_of(h, d).hex() for h, d in out.tolist()] == ["fd06"]


# ---- work outside of the ticks ---------------------------------------------------------------------------------------


def test_what_the_desk_has_done(tmp_path: Path) -> None:
    memory = Memory(Node(*shipped()))
    of, row = memory.elements, memory.live()
    assert list(WORK) == ["judge", "save", "load"]
    assert WORK["judge"](of, row, ("calibration", "stroke_tables", "vane_angles")) == ""
    falls = row.copy()
    falls[134 + 5] = 0.0
    assert WORK["judge"](of, falls, ("stroke_tables",)).startswith("stroke_tables: ")
    assert WORK["judge"](of, falls, ("calibration",)) == ""
    code, why = WORK["save"](of, falls, tmp_path / "none")
    assert code == 0x32 and why.startswith("stroke_tables: ") and not (tmp_path / "none").exists()
    assert WORK["save"](of, row, tmp_path / "a" / "b") == (0, "") and len(list((tmp_path / "a" / "b").iterdir())) == 3
    (tmp_path / "file").write_text("")
    code, why = WORK["save"](of, row, tmp_path / "file")
    assert code == 0x24 and str(tmp_path / "file") in why
    found = WORK["load"](of, (tmp_path / "a" / "b" / "calibration.toml").read_bytes())
    assert (found == row[:68]).all() and WORK["load"](of, b"kp = 3") is None
    once = AtOnce(of)
    assert once.done() == (0, None)
    once.begin(5, "judge", (row, ("calibration",)))
    assert once.done() == (5, "")


def test_the_process_beside_the_loop_does_one_work_after_the_other_and_ends_with_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    memory = Memory(Node(*shipped()))
    niced: list[int] = []
    begun: list[tuple[list[str], dict[str, Any]]] = []
    threads: list[threading.Thread] = []

    def popen(words: list[str], **of: Any) -> None:
        begun.append((words, of))
        thread = threading.Thread(target=serve, args=(os.dup(of["pass_fds"][0]),))
        thread.start()
        threads.append(thread)

    monkeypatch.setattr(prepare.os, "nice", niced.append)
    monkeypatch.setattr(prepare.subprocess, "Popen", popen)
    outside = Outside(memory.elements)
    assert niced == [5] and outside.done() == (0, None)
    (words, of), *_ = begun
    with pytest.raises(OSError):
        os.fstat(of["pass_fds"][0])  # that end is the process's alone
    assert words[:3] == [sys.executable, "-P", "-c"] and f"serve({of['pass_fds'][0]})" in words[3]
    assert of["start_new_session"] is True and of["stdin"] == prepare.subprocess.DEVNULL
    falls = memory.live()
    falls[134 + 5] = 0.0
    for number, row, good in ((1, memory.live(), True), (2, falls, False)):
        outside.begin(number, "judge", (row, ("stroke_tables",)))
        assert outside._pipe.poll(20.0)
        found = outside.done()
        assert found[0] == number and (found[1] == "") == good and outside.done() == found
    outside._pipe.close()
    threads[0].join(20.0)
    assert not threads[0].is_alive()


def test_where_the_process_is_gone_nothing_comes_back(monkeypatch: pytest.MonkeyPatch) -> None:
    ours, theirs = Pipe()
    outside = Outside.__new__(Outside)
    outside._pipe, outside._done = ours, (3, "x")
    theirs.close()
    outside.begin(4, "judge", ())
    assert outside.done() == (3, "x")


# ---- elements and tables ---------------------------------------------------------------------------------------------


def test_every_number_has_its_place_and_bounds() -> None:
    elements._bounds.cache_clear()
    memory = Memory(Node(*shipped()))
    e = memory.elements
    assert len(e) == NUMBERS and [x.name for x in e[:68]] == list(SCALARS) and len({x.name for x in e}) == NUMBERS
    assert e[0] == Element(
        "strategy", "-", e[0].meaning, 0.0, 3.0, "calibration", "schedule", "strategy", "", 1.0, True, True
    )
    assert e[1][3:] == (0.0, 1.0, "calibration", "schedule", "table_input", "", 1.0, True, True, False)
    assert e[9][3:] == (0.001, 1.0, "calibration", "schedule", "stroke_rate", "mm/s", 0.001, False, False, False)
    assert e[47][3:] == (
        0.0,
        10 * math.pi / 180,
        "vane_angles",
        "",
        "play_vgv2",
        "deg",
        math.pi / 180,
        False,
        False,
        False,
    )
    assert e[48][3:] == (0.0, 8.0, "", "", "play_vgv3", "", 1.0, True, False, True) == (*e[48][3:],)
    assert e[67].name == "stages" and e[67].fixed and e[67].guarded and e[67].high == 8.0
    assert {x.name for x in e if x.guarded and not x.fixed} == set(GUARDED)
    assert [x.name for x in e if x.fixed] == [*(f"play_vgv{i}" for i in range(3, 8)), "stages"]
    assert [x.of_curve for x in e] == [False] * 68 + [True] * 460
    assert [x.meaning.rpartition(", ")[2] for x in e[45:53]] == ["vigv", *(f"vgv{i}" for i in range(1, 8))]
    first = 68
    for table, key, n, unit in (
        *(("stroke_tables", key, 66, "m") for key in ("speed", "extension", "retraction", "single")),
        *(("vane_angles", key, 49, "rad") for key in ("stroke", "vigv", "vgv1", "vgv2")),
    ):
        for i in range(n):
            x = e[first + i]
            assert (x.name, x.table, x.section, x.key) == (f"{table}_{key}_{i}", table, key, key)
            assert x.meaning == f"{table}, {key}" and not x.guarded and not x.whole and not x.fixed
            assert x.unit == {"speed": "%", "stroke": "m"}.get(key, unit)
            assert x.factor == {"m": 1e-3, "rad": math.pi / 180, "%": 1.0}[x.unit]
        first += n
    assert (e[134].low, e[134].high) == (0.0, 0.1) and (e[381].low, e[381].high) == (-math.pi / 2, math.pi / 2)
    assert (e[332].low, e[332].high, e[68].high) == (-0.01, 0.1, 150.0)


def test_the_curves_are_those_of_stroke_and_angle() -> None:
    memory = Memory(Node(*shipped()))
    assert [(c.name, c.first, c.axis, c.n) for c in memory.curves] == [
        ("stroke_extension", 134, 68, 66), ("stroke_retraction", 200, 68, 66), ("stroke_single", 266, 68, 66),
        ("angle_vigv", 381, 332, 49), ("angle_vgv1", 430, 332, 49), ("angle_vgv2", 479, 332, 49),
    ]  # fmt: skip
    assert [c.meaning for c in memory.curves][::3] == [
        "stroke demand against speed, extension", "vane angle against stroke, vigv"
    ]  # fmt: skip


OWN = {
    "gain": {"unit": "mA/mm", "meaning": "own", "low": 1.0, "high": 9.0},
    "b": {"unit": "-", "meaning": "", "low": 0.0, "high": 1.0},
}


def test_scalars_of_a_controller_of_your_own_stand_last(tmp_path: Path) -> None:
    _, cal = shipped()
    e = elements.elements_of(cal, OWN)
    assert len(e) == NUMBERS + 2
    assert e[NUMBERS] == Element(
        "own_gain", "mA/mm", "own", 1.0, 9.0, "own_calibration", "gain", "gain", "mA/mm", 1.0, True
    )
    assert not e[NUMBERS].of_curve
    row = np.concatenate([cal.k, cal.table.reshape(-1), cal.angles.reshape(-1), [2.5, 0.5]])
    assert elements.complaint(e, row, ("own_calibration",)) == ""
    files = elements.write_tables(tmp_path, e, row)
    assert [f.name for f in files] == [
        "calibration.toml",
        "stroke_tables.toml",
        "vane_angles.toml",
        "own_calibration.toml",
    ]
    origin = "chosen: frozen from a calibration page by XCP"
    assert tomllib.loads(files[3].read_text()) == {
        "gain": {"value": 2.5, "unit": "mA/mm", "origin": origin}, "b": {"value": 0.5, "unit": "-", "origin": origin}
    }  # fmt: skip


def test_scalars_of_your_own_are_read_written_and_measured_in_their_own_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    values = {"gain": np.array([2.5]), "b": np.array([0.5])}
    own = {name: {**of, "value": values[name]} for name, of in OWN.items()}
    monkeypatch.setattr("hil.calibrate.memory.own_scalars", lambda foreign: own)
    s = slave(STANDBY)
    memory = s.memory
    first = CAL + 8 * NUMBERS
    assert memory.live()[NUMBERS:].tolist() == [2.5, 0.5] and memory.by_name()["own_b"] == NUMBERS + 1
    assert memory.place(0, first, 16) == (6, 0) and memory.place(1, CAL + 4 * NUMBERS + 4, 4) == (13, 4)
    assert memory.place(0, first + 16, 1) is None and asked(s, "E8 00 00 01 00") == "FF 00 00 00 90 10 00 00"
    assert memory.raw[6].tobytes() == struct.pack("<2d", 2.5, 0.5), "there from the start"
    assert write(s, first + 8, 0.25) == "FF" and values["b"].tolist() == [0.25] and values["gain"].tolist() == [2.5]
    assert write(s, first, 9.5) == "FE 22" and write(s, first, 9.0) == "FF" and values["gain"].tolist() == [9.0]
    assert memory.raw[6].tobytes() == struct.pack("<2d", 2.5, 0.5), "a copy, of the last tick that was measured"
    memory.refresh({13})
    assert memory.raw[6].tobytes() == struct.pack("<2d", 9.0, 0.25)
    assert memory.raw[13].tobytes() == struct.pack("<2f", 9.0, 0.25)
    assert memory.read(0, first, 16) == struct.pack("<2d", 9.0, 0.25)
    memory.loop.given.mode = float(RUN)
    assert write(s, first, 8.0) == "FE 23", "what it limits nobody knows"
    memory.loop.given.mode = float(STANDBY)
    assert asked(s, "EB 03 00 01") == "FF" and values["gain"].tolist() == [2.5] and values["b"].tolist() == [0.5]


def test_what_is_written_is_the_whole_calibration_and_is_read_back_as_the_same_bits(tmp_path: Path) -> None:
    memory = Memory(Node(*shipped()))
    rng = np.random.default_rng(5)
    row = memory.live()
    for i, e in enumerate(memory.elements[:68]):
        if e.table == "calibration" and not e.whole and e.section in ("servo", "trend", "observer"):
            row[i] *= 1.0 + 1e-3 * rng.uniform(-1.0, 0.0)
    row[47] = 0.0123456789
    files = elements.write_tables(tmp_path / "new", memory.elements, row)
    back = load_calibration(files[0], files[1], angles=files[2])
    assert (np.concatenate([back.k, back.table.reshape(-1), back.angles.reshape(-1)]) == row).all()
    assert sorted(f.name for f in (tmp_path / "new").iterdir()) == sorted(f.name for f in files), "nothing else is left"
    text = files[0].read_text()
    assert (
        text.startswith("[schedule]\nstrategy = ") and text.endswith("}\n") and "\n\n[servo]\nkp = { value = " in text
    )
    found = tomllib.loads(text)
    assert found["schedule"]["table_input"] == "n_r" and found["servo"]["current_limit"]["unit"] == "mA"
    assert found["servo"]["kff"]["origin"] == "chosen: frozen from a calibration page by XCP"
    angles = tomllib.loads(files[2].read_text())
    assert angles["play_vgv1"]["unit"] == "deg" and len(angles["vgv2"]["values"]) == 49 and "play_vgv3" not in angles
    assert files[2].read_text().startswith("play_vigv = { value = ")
    strokes = tomllib.loads(files[1].read_text())
    assert list(strokes) == ["speed", "extension", "retraction", "single"] and strokes["speed"]["unit"] == "%"


@pytest.mark.parametrize(
    ("value", "factor", "shown"),
    [(0.04, 1e-3, 40.0), (0.001956, 1e-3, 1.956), (16.0, 1.0, 16.0), (0.1234567, 1.0, 0.1234567), (0.0, 1e-3, 0.0)],
)
def test_a_number_is_written_as_short_as_its_bits_allow(value: float, factor: float, shown: float) -> None:
    assert elements.border(value, factor) == shown and shown * factor == value


def test_a_number_of_any_bits_is_found_again_where_there_is_one() -> None:
    rng = np.random.default_rng(6)
    for value in rng.uniform(-0.1, 0.1, 300).tolist():
        shown = elements.border(value, 1e-3)
        near = (shown, np.nextafter(value / 1e-3, 1e300), np.nextafter(value / 1e-3, -1e300), value / 1e-3)
        assert shown * 1e-3 == value or not any(v * 1e-3 == value for v in near)
        assert shown == pytest.approx(value * 1e3, rel=1e-14)


# ---- the master ------------------------------------------------------------------------------------------------------


def test_the_commands_of_the_workbench_byte_by_byte() -> None:
    hexed = lambda commands: [c.hex(" ").upper() for c in commands]  # noqa: E731
    assert master.CONNECT == b"\xff\x00" and master.PAGE_IN_USE == b"\xea\x01\x00"
    assert hexed(master.read_page(1, 64)) == [
        "EB 02 00 01", "F6 00 00 00 00 00 00 20", "F5 FF", "F5 FF", "F5 02", "EB 02 00 00"
    ]  # fmt: skip
    assert hexed(master.read_page(0, 1)) == ["EB 02 00 00", "F6 00 00 00 00 00 00 20", "F5 08", "EB 02 00 00"]
    assert [c[1] for c in master.read_page(0, 255)[2:-1]] == [255] * 8
    assert hexed(master.write_number(12, 12.5)) == [
        "F6 00 00 00 60 00 00 20", "F0 06 00 00 00 00 00 00", "F0 02 29 40", "F6 00 00 00 60 00 00 20", "F5 08"
    ]  # fmt: skip
    assert hexed(master.use_page(1)) == ["EB 01 00 01"] and hexed(master.copy_page()) == ["E4 00 01 00 00"]
    assert hexed(master.save_page()) == ["E6 01 00", "F9 01 00 00"]
    answers = [b"\0", b"", struct.pack("<d", 1.5)[:5], struct.pack("<d", 1.5)[5:] + struct.pack("<d", -2.0), b"\0"]
    assert master.numbers_of(answers).tolist() == [1.5, -2.0]


def test_the_master_sends_one_command_after_the_answer_to_the_other() -> None:
    m = master.Master()
    assert m.send(0.0) is None
    m.hear(b"\xff\x01")
    m.ask(1, [b"\xfd", b"\xf5\x0a"])
    m.ask(2, [b"\xfb"])
    m.hear(b"\xff\x01")  # nothing was sent
    assert m.send(10.0) == b"\xfd" and m.send(11.0) is None
    for passed_over in (b"", b"\xfd\x03", b"\x00\x01\x02", b"\xfc"):
        m.hear(passed_over)
    assert m.send(12.0) is None
    m.hear(b"\xff\x07\x08")
    assert m.done == [] and m.send(13.0) == b"\xf5\x0a"
    m.hear(b"\xff" + bytes(range(7)))
    assert m.send(14.0) is None and m.done == []
    m.hear(b"\xff" + bytes(range(7, 10)))
    assert m.done == [(1, [b"\x07\x08", bytes(range(10))])]
    assert m.send(15.0) == b"\xfb"
    m.hear(b"\xff")
    assert m.done[1:] == [(2, [b""])] and m.send(16.0) is None


@pytest.mark.parametrize(
    ("answer", "why"),
    [
        (b"\xfe\x10", "busy (XCP error 0x10)"), (b"\xfe\x22", "out of range (XCP error 0x22)"),
        (b"\xfe\x23", "write protected (XCP error 0x23)"), (b"\xfe\x24", "access denied (XCP error 0x24)"),
        (b"\xfe\x25", "locked (XCP error 0x25)"), (b"\xfe\x26", "no such page (XCP error 0x26)"),
        (b"\xfe\x27", "not in this mode (XCP error 0x27)"), (b"\xfe\x29", "out of order (XCP error 0x29)"),
        (b"\xfe\x32", "no whole set of tables (XCP error 0x32)"), (b"\xfe\x31", "refused (XCP error 0x31)"),
        (b"\xfe", "refused (XCP error 0x00)"),
    ],
)  # fmt: skip
def test_a_refusal_ends_the_job_in_words(answer: bytes, why: str) -> None:
    m = master.Master()
    m.ask(7, [b"\xfd", b"\xfd", b"\xfb"])
    m.ask(8, [b"\xfc"])
    m.send(0.0)
    m.hear(b"\xff\x01")
    m.send(0.0)
    m.hear(answer)
    assert m.done == [(7, why)] and m.send(1.0) == b"\xfc", "the next begins with its first command"
    m.hear(b"\xff")
    assert m.done[1] == (8, [b""])


def test_an_answer_may_take_2000_ms() -> None:
    m = master.Master()
    m.ask(1, [b"\xfd"])
    m.ask(2, [b"\xfb"])
    m.send(500.0)
    assert m.send(2500.0) is None and m.done == []
    assert m.send(2500.1) is None and m.done == [(1, "no answer within 2 s")]
    assert m.send(2500.2) == b"\xfb"


# ---- the A2L file ----------------------------------------------------------------------------------------------------


def block(text: str, kind: str, name: str) -> list[str]:
    """The lines of a block of an A2L file."""
    found = re.findall(rf"^ */begin {kind} {name} .*?/end {kind}$", text, re.M | re.S)
    assert len(found) == 1, name
    return [line.strip() for line in found[0].splitlines()]


def a2l() -> tuple[str, Memory]:
    """The A2L file of the shipped machine."""
    memory = Memory(Node(*shipped()))
    return a2l_of(memory, master=0x6E0, slave=0x6E1), memory


@pytest.mark.parametrize(
    ("name", "method", "address"),
    [
        ("output_mode", "CM_mode", "0x11000008"), ("state_mode", "CM_mode", "0x12000000"),
        ("output_x_dem", "CM_m_mm", "0x11000004"), ("output_i_cmd", "CM_A_mA", "0x11000000"),
        ("input_vigv", "CM_rad_deg", "0x10000018"), ("input_n_dem", "CM_percent_percent", "0x10000000"),
        ("input_pause", "CM_s_s", "0x10000038"),
        ("state_x_servo", "CM_m_mm", f"{STATES + 4 * STATE.index('x_servo'):#010x}"),
    ],
)  # fmt: skip
def test_a_measurement_is_at_half_the_offset_in_single_precision(name: str, method: str, address: str) -> None:
    lines = block(a2l()[0], "MEASUREMENT", name)
    assert lines[1] == f"FLOAT32_IEEE {method} 0 0 -1e+12 1e+12"
    assert lines[2] == f"ECU_ADDRESS {address} ECU_ADDRESS_EXTENSION 1"


def test_every_signal_is_a_measurement_in_its_group() -> None:
    text, memory = a2l()
    for s in memory.signals:
        head = block(text, "MEASUREMENT", s.name)[0]
        if not s.name.endswith("_faults"):
            assert head == f'/begin MEASUREMENT {s.name} "{s.meaning}"'
        else:
            assert head.endswith(f'"bits from 0 on: {", ".join(FAULTS)}"')
    for area, meaning in (
        ("input", "inputs of the tick"),
        ("output", "outputs of the tick"),
        ("state", "state after the tick"),
    ):
        lines = block(text, "GROUP", f"{area}s")
        assert lines[0] == f'/begin GROUP {area}s "{meaning}"' and lines[1] == "ROOT"
        assert lines[3:-2] == [s.name for s in memory.signals if s.name.startswith(f"{area}_")]


METHODS = {
    "CM_m_mm": 1e3, "CM_m_per_s_mm_per_s": 1e3, "CM_A_mA": 1e3, "CM_rad_deg": 180.0 / math.pi, "CM_s_s": 1.0,
    "CM_percent_percent": 1.0, "CM_none_none": 1.0, "CM_rad_per_s_deg_per_s": 180.0 / math.pi,
}  # fmt: skip


@pytest.mark.parametrize(("name", "factor"), METHODS.items())
def test_a_unit_is_shown_as_the_tables_have_it(name: str, factor: float) -> None:
    lines = block(a2l()[0], "COMPU_METHOD", name)
    assert float(lines[1].split()[1]) == pytest.approx(factor, rel=1e-14) and lines[1].split()[2] == "0"
    assert ' LINEAR "%12.6" "' in lines[0]


def test_every_scalar_that_may_be_changed_is_a_characteristic_with_its_bounds() -> None:
    text, memory = a2l()
    groups: dict[str, list[str]] = {}
    for i, e in enumerate(memory.elements[:68]):
        if e.fixed:
            assert f"CHARACTERISTIC {e.name} " not in text
            continue
        head, value, _ = block(text, "CHARACTERISTIC", e.name)
        words = value.split()
        assert head == f'/begin CHARACTERISTIC {e.name} "{e.meaning}"'
        assert words[:4] == ["VALUE", f"{CAL + 8 * i:#010x}", "RL_VALUE", "0"]
        factor = 1.0
        if e.whole:
            assert words[4] == f"CM_{e.name}"
        else:
            factor = float(block(text, "COMPU_METHOD", words[4])[1].split()[1])
        assert float(words[5]) == pytest.approx(e.low * factor, rel=1e-11)
        assert float(words[6]) == pytest.approx(e.high * factor, rel=1e-11)
        groups.setdefault(e.section if e.table == "calibration" else "vane_angles", []).append(e.name)
    for section, names in groups.items():
        assert block(text, "GROUP", f"cal_{section}")[3:-2] == names


def test_every_curve_has_its_axis_and_bounds() -> None:
    text, memory = a2l()
    for name, first, axis, n, at_axis, low, high in (
        ("stroke_extension", 134, "axis_speed_stroke_tables", 66, 68, 0.0, 100.0),
        ("stroke_retraction", 200, "axis_speed_stroke_tables", 66, 68, 0.0, 100.0),
        ("stroke_single", 266, "axis_speed_stroke_tables", 66, 68, 0.0, 100.0),
        ("angle_vigv", 381, "axis_stroke_vane_angles", 49, 332, -90.0, 90.0),
        ("angle_vgv2", 479, "axis_stroke_vane_angles", 49, 332, -90.0, 90.0),
    ):
        lines = block(text, "CHARACTERISTIC", name)
        method, axis_method = ("CM_m_mm", "CM_percent_percent") if n == 66 else ("CM_rad_deg", "CM_m_mm")
        axis_low, axis_high = ("0", "150") if n == 66 else ("-10", "100")
        assert lines[1] == f"CURVE {CAL + 8 * first:#010x} RL_CURVE 0 {method} {low:g} {high:g}"
        assert lines[2] == f"/begin AXIS_DESCR COM_AXIS NO_INPUT_QUANTITY {axis_method} {n} {axis_low} {axis_high}"
        assert lines[3] == f"AXIS_PTS_REF {axis}"
        points = block(text, "AXIS_PTS", axis)
        assert points[1] == (
            f"{CAL + 8 * at_axis:#010x} NO_INPUT_QUANTITY RL_AXIS 0 {axis_method} {n} {axis_low} {axis_high}"
        )
    assert block(text, "GROUP", "curves")[3:-2] == [
        "axis_speed_stroke_tables", "axis_stroke_vane_angles", "stroke_extension", "stroke_retraction", "stroke_single",
        "angle_vigv", "angle_vgv1", "angle_vgv2",
    ]  # fmt: skip


def test_words_of_choices_are_listed_from_0_on() -> None:
    text, _ = a2l()
    assert block(text, "COMPU_VTAB", "VT_mode")[1:-1] == [
        '0 "INIT"', '1 "STANDBY"', '2 "RUN"', '3 "DEGRADED"', '4 "FAIL_SAFE"'
    ]  # fmt: skip
    assert block(text, "COMPU_VTAB", "VT_mode")[0].endswith("TAB_VERB 5")
    assert block(text, "COMPU_VTAB", "VT_table_input")[1:-1] == ['0 "n_r"', '1 "n_dem"']
    assert block(text, "COMPU_METHOD", "CM_strategy")[1] == "COMPU_TAB_REF VT_strategy"


def test_the_file_says_how_the_slave_is_reached() -> None:
    text, _ = a2l()
    for line in (
        "0x0100 1000 1000 1000 1000 1000 1000 1000 8 8 BYTE_ORDER_MSB_LAST ADDRESS_GRANULARITY_BYTE",
        '/begin EVENT "1 ms" "1 ms" 0 DAQ_STIM 0xFF 1 6 0 /end EVENT',
        '/begin EVENT "10 ms" "10 ms" 1 DAQ_STIM 0xFF 10 6 0 /end EVENT',
        "/begin CHECKSUM XCP_CRC_32 MAX_BLOCK_SIZE 1048576 /end CHECKSUM",
    ):
        assert line in text
    assert "CAN_ID_MASTER 0x6E0" in text.replace("0x6e0", "0x6E0") and "0x20000000 0x1080" in text
    assert json.dumps(text)
