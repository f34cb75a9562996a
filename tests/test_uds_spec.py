"""The UDS server service by service, state by state and tick by tick, as ISO 14229 and docs/uds.md have it.

The server is asked straight, at ticks that the test names. All numbers stand here again: no test reads a limit from the
code.
"""

from __future__ import annotations

import base64
import hmac
import json
import math
import struct
import zlib
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("isotp")

from controller import Calibration, load_calibration, new_state
from hil.bus.frames import ECU_DEMAND, VGV_STATUS, crc, decode_demand, encode_demand, word0
from hil.calibrate import Memory
from hil.calibrate.prepare import Task
from hil.calibrate.station import row_of
from hil.loop.node import Node
from hil.uds import Server, TroubleMemory
from hil.uds.routines import Sweep, clear_learned
from hil.uds.server import key_of
from hil.uds.station import UdsService, _Ticks
from hil.uds.trouble import Entry
from plant import Plant, build_plant
from tests.uds_bus import Bench
from vaneloop.base.errors import InputError
from vaneloop.base.tables import path

INIT, STANDBY, RUN, DEGRADED, FAIL_SAFE = range(5)
CODES = (0x1A0187, 0x1A0282, 0x1A0322, 0x1A0427, 0x1A052A, 0x1A0677, 0x1A0719, 0x1A0864, 0x1A0947)
FAULTS = (
    *("demand_stale", "demand_rejected", "lvdt_range", "lvdt_rate", "lvdt_stuck", "tracking", "current_saturated"),
    *("demand_range", "paused"),
)


@cache
def shipped() -> tuple[Plant, Calibration]:
    """Machine and calibration as shipped; a node has its own copy of what may be changed."""
    return build_plant(), load_calibration()


def server(mode: int = STANDBY, **options: Any) -> Server:
    """A server whose firmware says that it is in ``mode``."""
    out = Server(Memory(Node(*shipped())), **options)
    out.node.loop.given.mode = float(mode)
    return out


def asked(s: Server, request: str | bytes, k: int = 0, functional: bool = False) -> str:
    """The answers to a request before tick ``k``."""
    raw = bytes.fromhex(request) if isinstance(request, str) else request
    return ", ".join(a.hex(" ").upper() for a in s.request(k, raw, functional))


def seed_of(s: Server, k: int = 0) -> bytes:
    """Ask for a seed, and get one."""
    answer = bytes.fromhex(asked(s, "27 01", k))
    assert answer[:2] == b"\x67\x01" and len(answer) == 10 and any(answer[2:])
    return answer[2:]


def unlocked(mode: int = STANDBY, session: int = 3, k: int = 0, **options: Any) -> Server:
    """A server whose lock is open in a session."""
    out = server(STANDBY, **options)
    unlock(out, k, session)
    out.node.loop.given.mode = float(mode)
    return out


def unlock(s: Server, k: int = 0, session: int = 3) -> None:
    """Begin a session and open its lock."""
    assert asked(s, f"10 0{session}", k) == f"50 0{session} 00 32 01 F4"
    assert asked(s, b"\x27\x02" + key_of(seed_of(s, k)), k) == "67 02"


# ---- every service in every session ----------------------------------------------------------------------------------

# shortest request: sessions that have the service, how its answer begins there while it is locked
SHORTEST = {
    "10 01": ((1, 2, 3), "50 01 00 32 01 F4"),
    "11 01": ((2, 3), "7F 11 33"),
    "14 FF FF FF": ((2, 3), "7F 14 33"),
    "19 0A": ((1, 2, 3), "59 0A 7F"),
    "22 F1 86": ((1, 2, 3), "62 F1 86"),
    "27 01": ((2, 3), "67 01"),
    "28 00 01": ((3,), "7F 28 33"),
    "2E F1 99 20": ((3,), "7F 2E 33"),
    "31 01 02 01": ((3,), "7F 31 33"),
    "34 00 44": ((2,), "7F 34 33"),
    "36 01": ((2,), "7F 36 24"),
    "37": ((2,), "7F 37 24"),
    "3E 00": ((1, 2, 3), "7E 00"),
    "85 01": ((3,), "7F 85 33"),
}


@pytest.mark.parametrize("session", [1, 2, 3])
def test_each_session_has_its_services_and_each_service_its_least_length(session: int) -> None:
    s = server()
    for request, (sessions, answer) in SHORTEST.items():
        asked(s, f"10 0{session}")
        service = request[:2]
        found = asked(s, request)
        assert found.startswith(answer) if session in sessions else found == f"7F {service} 7F", request
        asked(s, f"10 0{session}")
        if len(request) > 2 and session in sessions:
            assert asked(s, request[:-3]) == f"7F {service} 13", "a byte is missing"


def test_every_other_service_is_not_there() -> None:
    s = server()
    known = {int(request[:2], 16) for request in SHORTEST}
    for service in set(range(256)) - known:
        assert asked(s, bytes([service, 1, 2, 3])) == f"7F {service:02X} 11"


def test_a_request_without_bytes_has_no_answer_and_keeps_no_session() -> None:
    s = server()
    asked(s, "10 03", 100)
    assert asked(s, b"", 3000) == ""
    s.before(5100)
    assert s.session == 1


@pytest.mark.parametrize(
    ("request_", "answer"),
    [
        ("99", ""),  # 0x11
        ("19 55", ""),  # 0x12
        ("22 12 34", ""),  # 0x31
        ("27 01", ""),  # 0x7F
        ("22 F1", "7F 22 13"),
        ("10 02", "7F 10 22"),
        ("3E 00", "7E 00"),
        ("3E 80", ""),
        ("22 F1 86", "62 F1 86 01"),
    ],
)
def test_asked_with_all_others_it_is_silent_on_what_it_does_not_have(request_: str, answer: str) -> None:
    assert asked(server(RUN), request_, functional=True) == answer
    assert asked(server(RUN), request_) != "" or request_ == "3E 80"


def test_other_refusals_are_told_to_all_too() -> None:
    s = server()
    asked(s, "10 03")
    for request, answer in (("2E F1 99 20", "7F 2E 33"), ("27 02 00 00 00 00 00 00 00 00", "7F 27 24")):
        assert asked(s, request, functional=True) == answer


def test_with_bit_7_of_the_subfunction_it_acts_without_an_answer_but_says_what_it_refuses() -> None:
    s = unlocked()
    assert asked(s, "28 81 01") == "" and s.silent
    assert asked(s, "28 80 01") == "" and not s.silent
    assert asked(s, "85 82") == "" and not s.trouble.on
    assert asked(s, "85 81") == "" and s.trouble.on
    assert asked(s, "31 81 02 03") == "" and asked(s, "31 03 02 03") == "71 03 02 03 00"
    assert asked(s, "19 81 FF") == "" and asked(s, "3E 80") == "" and asked(s, "27 81") == ""
    for request, answer in {
        "31 81 12 34": "7F 31 31", "28 82 01": "7F 28 12", "28 81 02": "7F 28 31", "85 83": "7F 85 12",
        "3E 81": "7F 3E 12", "3E 80 00": "7F 3E 13", "10 84": "7F 10 12", "11 82": "7F 11 12", "19 D5": "7F 19 12",
        "27 83": "7F 27 12",
    }.items():  # fmt: skip
        assert asked(s, request) == answer, request
    assert asked(s, "11 81") == "" and asked(s, "10 82") == "" and s.session == 2


def test_services_without_a_subfunction_take_bit_7_as_it_is() -> None:
    s = unlocked()
    assert asked(s, "22 F1 86") == "62 F1 86 03" and asked(s, "2E F1 99 41") == "6E F1 99"
    assert asked(s, "14 FF FF FF") == "54" and asked(s, "14 9A 01 87") == "7F 14 31"
    s = unlocked(session=2)
    assert asked(s, "34 80 11 00 09") == "7F 34 31"
    assert asked(s, "34 00 11 00 09") == "74 20 01 00" and asked(s, "36 81 00") == "7F 36 73"


# ---- sessions --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("request_", ["10 03", "3E 00", "3E 80", "22 12 34", "99", "22 F1 86"])
def test_a_session_ends_5000_ticks_after_the_last_request_whatever_that_was(request_: str) -> None:
    s = server()
    asked(s, "10 03", 17)
    asked(s, request_, 1017)
    assert s.before(6016) == [] and s.session == 3
    assert s.before(6017) == [] and s.session == 1


def test_the_default_session_has_no_end() -> None:
    s = server()
    s.trouble.on = False
    s.before(100_000)
    assert s.session == 1 and not s.trouble.on, "nothing was to be put back"


def test_a_new_server_is_locked_in_the_default_session_and_may_be_asked_for_a_seed_at_once() -> None:
    s = server()
    assert asked(s, "22 F1 86") == "62 F1 86 01" and not s.silent and s.trouble.on and s.sweep is None
    asked(s, "10 03")
    assert asked(s, "2E F1 99 41") == "7F 2E 33"
    seed_of(s)


@pytest.mark.parametrize(
    ("request_", "answer"),
    [
        ("10 00", "7F 10 12"), ("10 01", "50 01 00 32 01 F4"), ("10 02", "50 02 00 32 01 F4"),
        ("10 03", "50 03 00 32 01 F4"), ("10 04", "7F 10 12"), ("10 03 00", "7F 10 13"), ("11 00", "7F 11 12"),
        ("11 01", "51 01"), ("11 02", "7F 11 12"), ("11 03", "51 03"), ("11 04", "7F 11 12"), ("11 01 00", "7F 11 13"),
        ("3E 00", "7E 00"), ("3E 01", "7F 3E 12"), ("3E 00 00", "7F 3E 13"),
    ],
)  # fmt: skip
def test_what_session_reset_and_tester_present_answer(request_: str, answer: str) -> None:
    assert asked(unlocked() if request_.startswith("11") else server(), request_) == answer


@pytest.mark.parametrize("mode", range(5))
def test_what_opens_the_loop_is_done_in_init_and_standby_only(mode: int) -> None:
    refused = mode not in (INIT, STANDBY)
    assert asked(server(mode), "10 02") == ("7F 10 22" if refused else "50 02 00 32 01 F4")
    for request, answer in {"11 01": "51 01", "11 03": "51 03"}.items():
        assert asked(unlocked(mode), request) == ("7F 11 22" if refused else answer), request
    s = unlocked(mode)
    assert asked(s, "28 01 01") == ("7F 28 22" if refused else "68 01") and s.silent != refused
    assert asked(s, "28 00 01") == "68 00" and asked(s, "85 02") == "C5 02", "these hold nothing up"
    s = unlocked(session=2)
    s.node.loop.given.mode = float(mode)
    assert asked(s, "34 00 11 00 09") == ("7F 34 22" if refused else "74 20 01 00")
    s = unlocked()
    s.node.loop.given.mode = float(mode)
    assert asked(s, "31 01 02 03") == ("71 01 02 03" if mode == STANDBY else "7F 31 22")
    assert asked(s, "31 01 02 01") == ("71 01 02 01" if mode == STANDBY else "7F 31 22")


@pytest.mark.parametrize("how", ["10 01", "10 03", "10 02", "time", "reset"])
def test_with_its_session_ends_all_that_it_changed(how: str) -> None:
    s = unlocked(k=10)
    assert asked(s, "28 01 01", 10) == "68 01" and asked(s, "85 02", 10) == "C5 02"
    assert asked(s, "31 01 02 01", 10) == "71 01 02 01"
    if how == "10 02":
        assert asked(s, how, 20) == "7F 10 22" and s.session == 3 and s.sweep is not None, "a routine runs"
        assert asked(s, "31 02 02 01", 20) == "71 02 02 01"
    if how == "reset":
        assert asked(s, "11 01", 20) == "7F 11 22", "a routine runs"
        assert asked(s, "31 02 02 01", 20) == "71 02 02 01" and asked(s, "11 01", 20) == "51 01"
        assert s.session == 3 and s.before(21) == []
    elif how == "time":
        s.before(5010)
    else:
        asked(s, how, 20)
    assert s.session == {"10 03": 3, "10 02": 2}.get(how, 1)
    assert not s.silent and s.trouble.on and s.sweep is None
    asked(s, "10 03", 6000)
    assert asked(s, "31 03 02 01", 6000) == "7F 31 33", "locked again"
    asked(s, b"\x27\x02" + key_of(seed_of(s, 6000)), 6000)
    assert asked(s, "31 03 02 01", 6000)[:14] == "71 03 02 01 02", "its result was kept: aborted"


@pytest.mark.parametrize("how", ["10 02", "10 03"])
def test_a_seed_and_a_file_end_with_their_session(how: str) -> None:
    s = unlocked(session=2)
    assert asked(s, "34 00 11 00 04") == "74 20 01 00" and asked(s, "36 01 41 41 41 41") == "76 01"
    asked(s, how)
    asked(s, "10 02")
    assert asked(s, "37") == "7F 37 24" and asked(s, "36 01 41") == "7F 36 24"
    key = key_of(seed_of(s))
    asked(s, how)
    assert asked(s, b"\x27\x02" + key) == "7F 27 24"


def test_a_reset_starts_the_firmware_anew_once_before_the_next_tick() -> None:
    bench = Bench(request=1).run(300)
    s, z = bench.server, bench.node.loop.z
    s.trouble.entries[3].status = 0x2F
    s.node.loop.given.mode = float(STANDBY)
    unlock(s, 300)
    was = z.copy()
    assert asked(s, "11 03", 300) == "51 03" and (z == was).all() and s.trouble.entries[3].status == 0x2F
    assert s.before(300) == [] and (z == new_state()).all() and not (z == was).all()
    assert s.trouble.entries[3].status == 0x6C, "a new operation cycle"
    z[:] = was
    asked(s, "10 03", 301)
    assert s.before(301) == [] and (z == was).all() and s.session == 3


def test_a_controller_of_your_own_is_not_reset_and_does_not_forget() -> None:
    node = Node()
    node.loop.given.mode = float(STANDBY)
    s = Server(Memory(node))
    s.memory.loop = s.memory.loop._replace(foreign=(1,))
    unlock(s)
    assert asked(s, "11 01") == "7F 11 22"
    was = s.memory.loop.z.copy()
    s.before(1)
    assert (s.memory.loop.z == was).all()
    loop = node.loop._replace(foreign=(1,))
    assert not clear_learned(SimpleNamespace(loop=loop))  # type: ignore[arg-type]


# ---- seed and key ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("request_", "answer"),
    [
        ("27 00", "7F 27 12"), ("27 03", "7F 27 12"), ("27 01 00", "7F 27 13"), ("27 02", "7F 27 13"),
        ("27 02 01 02 03 04 05 06 07", "7F 27 13"), ("27 02 01 02 03 04 05 06 07 08 09", "7F 27 13"),
        ("27 02 01 02 03 04 05 06 07 08", "7F 27 24"),
    ],
)  # fmt: skip
def test_what_is_no_seed_and_no_key(request_: str, answer: str) -> None:
    s = server()
    asked(s, "10 03")
    assert asked(s, request_) == answer


def test_a_seed_is_good_for_one_key_and_the_latest_counts() -> None:
    s = server()
    asked(s, "10 03")
    first, second = seed_of(s), seed_of(s)
    assert first != second
    assert asked(s, b"\x27\x02" + key_of(first)) == "7F 27 35"
    assert asked(s, b"\x27\x02" + key_of(second)) == "7F 27 24", "it was used up"
    assert asked(s, "31 01 02 03") == "7F 31 33" and asked(s, "2E F1 99 41") == "7F 2E 33"
    assert asked(s, b"\x27\x02" + key_of(seed_of(s))) == "67 02"
    assert asked(s, "27 01") == "67 01 00 00 00 00 00 00 00 00"
    assert asked(s, b"\x27\x02" + bytes(8)) == "7F 27 24" and asked(s, "2E F1 99 41") == "6E F1 99"


def test_seeds_follow_from_a_number_and_without_one_nobody_foresees_them() -> None:
    def seeds(**options: Any) -> list[bytes]:
        s = server(**options)
        asked(s, "10 03")
        return [seed_of(s) for _ in range(3)]

    numbers = (0, 7, -(2**63), 2**63 - 1)
    for number in numbers:
        of = [hmac.digest(struct.pack("<q", number), f"uds {n}".encode(), "sha256")[:8] for n in (1, 2, 3)]
        assert seeds(seed=number) == of
    assert len({s for _ in range(20) for s in seeds()}) == 60
    s = server(seed=7)
    s.lock.number = 0
    asked(s, "10 03")
    assert [seed_of(s)] == seeds(seed=0)[:1], "a record's note"


def wrong_key(s: Server, k: int) -> str:
    """Ask for a seed and send a wrong key."""
    key = bytearray(key_of(seed_of(s, k)))
    key[7] ^= 1
    return asked(s, b"\x27\x02" + bytes(key), k)


def test_after_the_third_wrong_key_there_is_no_seed_for_10000_ticks() -> None:
    s = server()
    asked(s, "10 03", 500)
    assert [wrong_key(s, k) for k in (500, 600, 777)] == ["7F 27 35", "7F 27 35", "7F 27 36"]
    for k in (777, 778, 5000, 10_776):
        assert asked(s, "27 01", k) == "7F 27 37", k
    asked(s, "10 03", 10_776)
    assert asked(s, "27 01", 10_776) == "7F 27 37", "nor in a new session"
    assert asked(s, b"\x27\x02" + bytes(8), 5000) == "7F 27 24", "without a seed no key is tried"
    assert [wrong_key(s, 10_777) for _ in range(3)] == ["7F 27 35", "7F 27 35", "7F 27 36"]
    assert asked(s, "27 01", 20_776) == "7F 27 37"
    asked(s, b"\x27\x02" + key_of(seed_of(s, 20_777)), 20_777)
    assert asked(s, "2E F1 99 41", 20_777) == "6E F1 99"


def test_neither_a_reset_nor_a_restart_ends_the_pause(tmp_path: Path) -> None:
    kept: list[str] = []
    s = server(store=kept.append)
    unlock(s, 100)
    assert asked(s, "11 01", 100) == "51 01" and s.before(100) == []
    asked(s, "10 03", 500)
    assert [wrong_key(s, k) for k in (500, 500, 500)] == ["7F 27 35", "7F 27 35", "7F 27 36"]
    s.before(501)
    s.after(501)
    file = tmp_path / "codes.json"
    for found, first, wrong in ((kept[-1], "7F 27 37", 3), (kept[-1].replace('keys": 3', 'keys": 1'), "67", 1)):
        file.write_text(found)
        again = server(trouble=TroubleMemory.load(file))
        assert again.trouble.wrong_keys == wrong
        asked(again, "10 03", 0)
        assert asked(again, "27 01", 9_999).startswith(first)
        seed_of(again, 10_000)
    assert wrong_key(again, 10_000) == "7F 27 35" and wrong_key(again, 10_000) == "7F 27 36"


def test_a_right_key_forgives_and_a_new_session_does_not() -> None:
    s = server()
    asked(s, "10 03")
    assert wrong_key(s, 0) == "7F 27 35" and wrong_key(s, 0) == "7F 27 35"
    asked(s, b"\x27\x02" + key_of(seed_of(s)))
    asked(s, "10 03")
    assert wrong_key(s, 0) == "7F 27 35" and wrong_key(s, 0) == "7F 27 35"
    asked(s, "10 02")
    assert wrong_key(s, 0) == "7F 27 36"


# ---- traffic, entries ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("request_", "answer"),
    [
        ("28 00 01", "68 00"), ("28 01 01", "68 01"), ("28 02 01", "7F 28 12"), ("28 03 01", "7F 28 12"),
        ("28 00 00", "7F 28 31"), ("28 00 02", "7F 28 31"), ("28 01 03", "7F 28 31"), ("28 01", "7F 28 13"),
        ("28 01 01 00", "7F 28 13"), ("85 00", "7F 85 12"), ("85 01", "C5 01"), ("85 02", "C5 02"),
        ("85 03", "7F 85 12"), ("85 02 00", "7F 85 13"),
    ],
)  # fmt: skip
def test_what_traffic_and_entries_answer_and_only_then_do(request_: str, answer: str) -> None:
    s = unlocked()
    assert asked(s, request_) == answer
    assert s.silent == (request_ == "28 01 01") and s.trouble.on == (request_ != "85 02")


@pytest.mark.parametrize("mode", [RUN, DEGRADED, FAIL_SAFE])
def test_a_closed_loop_ends_the_silence_for_good(mode: int) -> None:
    s = unlocked()
    assert asked(s, "28 01 01") == "68 01" and s.silent
    s.after(0)
    assert s.silent
    s.node.loop.given.mode = float(mode)
    assert not s.silent, "from the tick on that closes it"
    s.after(1)
    s.node.loop.given.mode = float(STANDBY)
    assert not s.silent and asked(s, "28 01 01") == "68 01" and s.silent


def test_a_reset_is_followed_by_the_next_after_5000_ticks_at_the_earliest() -> None:
    s = server()
    for k, answer in ((0, "51 01"), (1, "7F 11 22"), (4999, "7F 11 22"), (5000, "51 01"), (9999, "7F 11 22")):
        unlock(s, k)
        assert asked(s, "11 01", k) == answer, k
        s.before(k)
        assert s.session == (1 if answer == "51 01" else 3)


def test_traffic_is_not_stopped_while_a_routine_runs() -> None:
    s = unlocked()
    asked(s, "31 01 02 02")
    assert asked(s, "28 01 01") == "7F 28 22" and asked(s, "28 00 01") == "68 00"


# ---- reading and writing data ----------------------------------------------------------------------------------------


def test_live_data_are_the_firmware_s_in_the_units_of_the_table() -> None:
    bench = Bench().run(437)
    loop = bench.node.loop
    bench.memory.loop.given.faults = 5.0
    values = (
        0.436, loop.state.n_dem, loop.state.n_r_raw, 1e3 * loop.given.x_dem, 1e3 * loop.fed.x_lvdt,
        1e3 * loop.given.i_cmd, 2.0, 5.0, math.degrees(loop.angles[0]),
    )  # fmt: skip
    assert all(values), "each says something"
    asks = "22" + "".join(f" 20 {i:02X}" for i in range(9))
    got = bytes.fromhex(asked(bench.server, asks))
    assert got == b"\x62" + b"".join(bytes([0x20, i]) + struct.pack(">f", v) for i, v in enumerate(values))
    assert asked(bench.server, "22 20 09") == "7F 22 31" and asked(bench.server, "22 1F FF") == "7F 22 31"
    bench.server.after(437)  # the fault begins: the same is frozen
    assert bench.server.trouble.entries[0].first == struct.pack(">9f", *values)


def test_what_single_precision_cannot_hold_is_infinite() -> None:
    """XCP may give such a stroke (STIM); in mm it is beyond the largest single."""
    s = server()
    s.node.loop.fed.x_lvdt, s.node.loop.given.faults = -3e38, 4.0
    assert asked(s, "22 20 04 20 07") == "62 20 04 FF 80 00 00 20 07 40 80 00 00"
    s.after(0)
    assert s.trouble.entries[2].first[16:20] == b"\xff\x80\0\0", "the freeze frame"
    sweep = Sweep(SimpleNamespace(), 0, 2, (-3e38, 0.005), (3e38, 0.037), 3e38)  # type: ignore[arg-type]
    assert sweep.result(0x0201) == b"\2" + bytes.fromhex("FF800000 7F800000 7F800000")
    assert sweep.result(0x0202) == b"\2" + bytes.fromhex("7F800000 FF800000")


def test_identifiers_that_stand_still() -> None:
    s = unlocked()
    crc_of = zlib.crc32(s.memory.live().tobytes())
    for ident, value in {
        "F1 87": b"VGV-1", "F1 8C": b"VANELOOP-0001", "F1 95": b"1.0", "F1 97": b"variable guide vanes",
        "F1 98": b" " * 16, "F1 99": b" " * 8, "F1 86": b"\x03", "F1 A0": struct.pack(">I", crc_of),
    }.items():  # fmt: skip
        assert asked(s, f"22 {ident}") == f"62 {ident} {value.hex(' ').upper()}"
    for ident in ("F1 85", "F1 88", "F1 8B", "F1 8D", "F1 94", "F1 96", "F1 9A", "F1 9F", "F1 A1", "00 00", "FF FF"):
        assert asked(s, f"22 {ident}") == "7F 22 31"
    s.memory.change({s.memory.by_name()["kp"]: 12.0}, judged=True)
    assert asked(s, "22 F1 A0")[-11:] != struct.pack(">I", crc_of).hex(" ").upper()


@pytest.mark.parametrize("n", [1, 2, 15, 16, 17])
def test_up_to_16_identifiers_are_read_at_once_and_none_if_one_is_not_there(n: int) -> None:
    s = server()
    asks = "22" + " F1 86" * n
    assert asked(s, asks) == ("62" + " F1 86 01" * n if n <= 16 else "7F 22 13")
    assert asked(s, asks + " F1") == "7F 22 13", "half an identifier"
    if n < 16:
        assert asked(s, asks + " 12 34") == "7F 22 31"


@pytest.mark.parametrize(
    ("ident", "text", "code"),
    [
        ("F1 98", b"x" * 16, 0), ("F1 98", b"x" * 17, 0x13), ("F1 99", b"20260101", 0), ("F1 99", b"2" * 9, 0x13),
        ("F1 99", b" ", 0), ("F1 99", b"a\x1f", 0x31), ("F1 99", b"~\x20", 0), ("F1 99", b"\x7fa", 0x31),
        ("F1 98", b"\x80", 0x31), ("F1 97", b"x", 0x31), ("F1 9A", b"x", 0x31), ("F1 86", b"x", 0x31),
    ],
)  # fmt: skip
def test_texts_are_written_up_to_their_length_in_printable_letters(ident: str, text: bytes, code: int) -> None:
    s = unlocked()
    s.trouble.changed = False
    found = asked(s, bytes.fromhex("2E" + ident) + text)
    assert found == (f"7F 2E {code:02X}" if code else f"6E {ident}")
    assert s.trouble.changed == (code == 0) and bool(s.trouble.texts) == (code == 0)
    if code == 0:
        room = 16 if ident == "F1 98" else 8
        assert s.trouble.texts == {ident.replace(" ", ""): text.decode()}
        assert asked(s, f"22 {ident}") == f"62 {ident} {text.ljust(room).hex(' ').upper()}"


def test_nothing_is_written_without_the_key() -> None:
    s = server()
    asked(s, "10 03")
    for ident in ("F1 98", "F1 99"):
        assert asked(s, f"2E {ident} 41") == "7F 2E 33" and asked(s, f"2E {ident}") == "7F 2E 13"
    assert asked(s, "2E F1 97 41") == "7F 2E 31" and s.trouble.texts == {} and not s.trouble.changed


# ---- trouble codes over the service ----------------------------------------------------------------------------------


def remembered() -> Server:
    """A server that remembers: code 1 with two frames, code 3 without a frame, the others with nothing."""
    s = server()
    for entry in s.trouble.entries:
        entry.status = 0x00
    s.trouble.entries[0] = Entry(0x2F, 7, 3, 5, bytes(range(36)), bytes(range(100, 136)))
    s.trouble.entries[2] = Entry(0xA4, 255, 1, 39)
    return s


@pytest.mark.parametrize(
    ("request_", "answer"),
    [
        ("19 01 01", "59 01 7F 01 00 01"), ("19 01 04", "59 01 7F 01 00 02"), ("19 01 80", "59 01 7F 01 00 00"),
        ("19 01 00", "59 01 7F 01 00 00"), ("19 01 FF", "59 01 7F 01 00 02"), ("19 01", "7F 19 13"),
        ("19 01 FF 00", "7F 19 13"), ("19 02 01", "59 02 7F 1A 01 87 2F"), ("19 02 10", "59 02 7F"),
        ("19 02 24", "59 02 7F 1A 01 87 2F 1A 03 22 24"), ("19 02", "7F 19 13"), ("19 02 24 00", "7F 19 13"),
        ("19 03", "59 03 1A 01 87 01 1A 01 87 02"), ("19 03 00", "7F 19 13"),
        ("19 0A", "59 0A 7F 1A 01 87 2F 1A 02 82 00 1A 03 22 24 1A 04 27 00 1A 05 2A 00 1A 06 77 00 1A 07 19 00 "
                  "1A 08 64 00 1A 09 47 00"),
        ("19 0A 00", "7F 19 13"), ("19 00", "7F 19 12"), ("19 05", "7F 19 12"), ("19 07", "7F 19 12"),
        ("19 09", "7F 19 12"), ("19 0B", "7F 19 12"),
        ("19 06 1A 01 87 FF", "59 06 1A 01 87 2F 01 07 02 05 03 03"), ("19 06 1A 01 87 01", "59 06 1A 01 87 2F 01 07"),
        ("19 06 1A 01 87 02", "59 06 1A 01 87 2F 02 05"), ("19 06 1A 03 22 03", "59 06 1A 03 22 24 03 01"),
        ("19 06 1A 03 22 FF", "59 06 1A 03 22 24 01 FF 02 27 03 01"), ("19 06 1A 01 87 00", "7F 19 31"),
        ("19 06 1A 01 87 04", "7F 19 31"), ("19 06 1A 01 87 FE", "7F 19 31"), ("19 06 1A 01 88 FF", "7F 19 31"),
        ("19 06 1A 01 87", "7F 19 13"), ("19 06 1A 01 87 FF 00", "7F 19 13"),
        ("19 04 1A 03 22 FF", "59 04 1A 03 22 24"),
        ("19 04 1A 01 87 00", "7F 19 31"), ("19 04 1A 01 87 03", "7F 19 31"), ("19 04 1A 01 87 FE", "7F 19 31"),
        ("19 04 00 00 00 FF", "7F 19 31"), ("19 04 1A 01 87", "7F 19 13"), ("19 04 1A 01 87 01 01", "7F 19 13"),
    ],
)  # fmt: skip
def test_what_is_told_of_trouble_codes(request_: str, answer: str) -> None:
    assert asked(remembered(), request_) == answer


@pytest.mark.parametrize("record", [1, 2, 0xFF])
def test_a_snapshot_has_each_signal_under_its_identifier(record: int) -> None:
    def of(n: int, first: int) -> bytes:
        parts = (bytes([0x20, i, *range(first + 4 * i, first + 4 * i + 4)]) for i in range(9))
        return bytes([n, 9]) + b"".join(parts)

    wanted = b"\x59\x04\x1a\x01\x87\x2f" + b"".join(of(n, f) for n, f in ((1, 0), (2, 100)) if record in (n, 0xFF))
    assert bytes.fromhex(asked(remembered(), bytes.fromhex("19041A0187") + bytes([record]))) == wanted


@pytest.mark.parametrize(
    ("request_", "answer", "cleared"),
    [
        ("14 FF FF FF", "54", range(9)), ("14 1A 01 87", "54", [0]), ("14 1A 09 47", "54", [8]),
        ("14 1A 01 88", "7F 14 31", []), ("14 00 00 00", "7F 14 31", []), ("14 FF FF FE", "7F 14 31", []),
        ("14 FF FF", "7F 14 13", []), ("14 FF FF FF 00", "7F 14 13", []),
    ],
)  # fmt: skip
def test_codes_are_cleared_one_or_all(request_: str, answer: str, cleared: Any) -> None:
    s = unlocked()
    s.trouble.changed = False
    s.trouble.entries = [Entry(0x2F, 7, 3, 5, b"a", b"b") for _ in CODES]
    assert asked(s, request_) == answer and s.trouble.changed == (answer == "54")
    for i, entry in enumerate(s.trouble.entries):
        assert entry == (Entry(0x50, 0, 0, 0, b"", b"") if i in cleared else Entry(0x2F, 7, 3, 5, b"a", b"b"))


def test_what_changed_is_stored_after_the_tick_once() -> None:
    kept: list[str] = []
    s = server(store=kept.append)
    s.after(0)  # STANDBY completes tests
    assert len(kept) == 1 and kept[0] == s.trouble.dump() and not s.trouble.changed
    s.after(1)
    assert len(kept) == 1
    s.node.loop.given.faults = 1.0
    s.after(2)
    assert len(kept) == 2 and json.loads(kept[1])["codes"][0]["status"] == 0x27
    quiet = server()
    quiet.after(0)
    assert quiet.trouble.changed, "nobody stores it"


# ---- the memory of trouble codes -------------------------------------------------------------------------------------


def never() -> bytes:
    raise AssertionError("no fault begins, nothing is to be frozen")


@pytest.mark.parametrize("mode", range(5))
def test_each_mode_completes_its_tests(mode: int) -> None:
    """ISO 14229: bits 4 and 6 go with the first completed test. In INIT there is none; those of the servo and of a
    stuck LVDT need a closed loop.
    """
    trouble = TroubleMemory()
    assert [e.status for e in trouble.entries] == [0x50] * 9
    trouble.look(mode, 0, never)
    closed = (4, 5, 6)
    done = [mode != INIT and (i not in closed or mode in (RUN, DEGRADED)) for i in range(9)]
    assert [e.status for e in trouble.entries] == [0x00 if d else 0x50 for d in done]
    assert trouble.changed == (mode != INIT)
    trouble.changed = False
    trouble.look(mode, 0, never)
    assert not trouble.changed
    trouble.look(RUN, 0, never)
    assert [e.status for e in trouble.entries] == [0x00] * 9 and trouble.changed == (mode not in (RUN, DEGRADED))


@pytest.mark.parametrize("bit", range(9))
def test_a_fault_is_entered_as_it_begins_in_any_mode(bit: int) -> None:
    trouble = TroubleMemory()
    trouble.look(INIT, 1 << bit, lambda: b"first")
    at_once = bit in (2, 3, 4, 8)
    for i, entry in enumerate(trouble.entries):
        assert entry == (Entry(0x2F if at_once else 0x27, 1, 1, 0, b"first", b"first") if i == bit else Entry())
    assert trouble.changed
    trouble.changed = False
    trouble.look(INIT, 1 << bit, never)
    assert not trouble.changed, "it stands"
    trouble.look(INIT, 0, never)
    assert trouble.entries[bit].status == (0x2E if at_once else 0x26) and trouble.changed
    trouble.look(INIT, 1 << bit, lambda: b"again")
    entry = trouble.entries[bit]
    assert entry == Entry(0x2F if at_once else 0x27, 2, 1, 0, b"first", b"again")


def test_a_fault_that_stands_does_not_begin_again_with_another() -> None:
    trouble = TroubleMemory()
    trouble.look(RUN, 0b1, lambda: b"1")
    trouble.look(RUN, 0b11, lambda: b"2")
    assert trouble.entries[0] == Entry(0x27, 1, 1, 0, b"1", b"1")
    assert trouble.entries[1] == Entry(0x27, 1, 1, 0, b"2", b"2")
    trouble.look(RUN, 0b10, never)
    assert [e.status for e in trouble.entries[:3]] == [0x26, 0x27, 0x00]


def test_codes_of_two_cycles_are_confirmed_in_the_second_that_fails() -> None:
    trouble = TroubleMemory()
    trouble.look(RUN, 1, lambda: b"")
    trouble.look(RUN, 0, never)
    trouble.look(RUN, 1, lambda: b"")
    assert trouble.entries[0] == Entry(0x27, 2, 1, 0), "twice in one cycle is one cycle"
    trouble.new_cycle()
    assert trouble.entries[0].status == 0x64 and trouble.entries[0].trips == 1
    trouble.look(RUN, 1, lambda: b"")
    assert trouble.entries[0] == Entry(0x2F, 3, 2, 0)


def test_counters_stop_at_255() -> None:
    trouble = TroubleMemory()
    trouble.entries[0] = Entry(0x60, 254, 254, 9)
    for failures, trips in ((255, 255), (255, 255)):
        trouble.look(RUN, 1, lambda: b"")
        assert (trouble.entries[0].failures, trouble.entries[0].trips, trouble.entries[0].age) == (failures, trips, 0)
        trouble.look(RUN, 0, never)
        trouble.new_cycle()
    assert trouble.entries[0].trips == 255


def test_nothing_is_entered_while_entries_are_off_and_what_stands_is_entered_after() -> None:
    trouble = TroubleMemory(on=False)
    trouble.look(RUN, 1, never)
    assert trouble.entries == [Entry()] * 9 and not trouble.changed
    trouble.on = True
    trouble.look(RUN, 1, lambda: b"x")
    assert trouble.entries[0] == Entry(0x27, 1, 1, 0, b"x", b"x")
    trouble.on = False
    trouble.look(RUN, 0, never)
    assert trouble.entries[0].status == 0x27


def cycle(trouble: TroubleMemory, faults: int = 0, mode: int = RUN) -> Entry:
    """One operation cycle in which these faults come and go; the first code's entry at its end."""
    trouble.look(mode, 0, never)
    if faults:
        trouble.look(mode, faults, lambda: b"f")
        trouble.look(mode, 0, never)
    trouble.changed = False
    trouble.new_cycle()
    assert trouble.changed
    return trouble.entries[0]


def test_pending_goes_with_the_first_cycle_that_completed_the_test_and_did_not_fail() -> None:
    trouble = TroubleMemory()
    assert cycle(trouble, 1).status == 0x64
    trouble.new_cycle()
    assert trouble.entries[0].status == 0x64 and trouble.entries[0].trips == 1, "no test was completed"
    entry = cycle(trouble)
    assert entry.status == 0x60 and entry.trips == 0
    assert cycle(trouble, 1).status == 0x64 and trouble.entries[0].trips == 1, "counted from the beginning"


def test_a_confirmed_code_ages_away_in_the_40th_cycle_without_a_failure() -> None:
    trouble = TroubleMemory()
    cycle(trouble, 1)
    assert cycle(trouble, 1) == Entry(0x6C, 2, 2, 0, b"f", b"f")
    for n in range(1, 40):
        assert cycle(trouble) == Entry(0x68, 2, 2, n, b"f", b"f")
        trouble.new_cycle()
        assert trouble.entries[0].age == n, "a cycle without a completed test does not count"
    assert cycle(trouble) == Entry(0x60, 2, 0, 0, b"", b"")


def test_a_failure_begins_the_ageing_anew() -> None:
    trouble = TroubleMemory()
    cycle(trouble, 1)
    cycle(trouble, 1)
    for _ in range(39):
        cycle(trouble)
    assert cycle(trouble, 1).age == 0 and cycle(trouble).age == 1


def test_a_new_cycle_looks_at_all_faults_anew() -> None:
    trouble = TroubleMemory()
    trouble.look(RUN, 1, lambda: b"a")
    trouble.new_cycle()
    trouble.look(RUN, 1, lambda: b"b")
    assert trouble.entries[0] == Entry(0x2F, 2, 2, 0, b"a", b"b")
    assert [e.status for e in trouble.entries[1:]] == [0x00] * 8


@pytest.mark.parametrize("bit", range(9))
def test_a_code_that_is_cleared_is_tested_and_entered_anew_and_no_other_is(bit: int) -> None:
    trouble = TroubleMemory()
    every = (1 << 9) - 1
    trouble.look(RUN, every, lambda: b"a")
    assert trouble.clear(CODES[bit])
    trouble.look(RUN, every, lambda: b"b")
    for i, entry in enumerate(trouble.entries):
        assert (entry.failures, entry.first, entry.last) == ((1, b"b", b"b") if i == bit else (1, b"a", b"a"))
    trouble = TroubleMemory()
    trouble.look(RUN, 0, never)
    assert trouble.clear(CODES[bit]) and trouble.entries[bit].status == 0x50
    trouble.look(RUN, 0, never)
    assert [e.status for e in trouble.entries] == [0x00] * 9
    assert trouble.clear(0xFFFFFF) and [e.status for e in trouble.entries] == [0x50] * 9
    trouble.look(RUN, 0, never)
    assert [e.status for e in trouble.entries] == [0x00] * 9


def test_there_is_no_lamp_in_the_mask_and_no_entry_of_an_unknown_code() -> None:
    trouble = TroubleMemory()
    trouble.entries[1].status = 0xFF
    assert trouble.by_mask(0x80) == [] and trouble.by_mask(0x01) == [(0x1A0282, 0xFF)]
    assert len(trouble.by_mask(0x10)) == 9 and trouble.entry(0x1A0283) is None
    assert trouble.entry(0x1A0282) is trouble.entries[1]


# ---- the file of trouble codes ---------------------------------------------------------------------------------------


def written(**of: Any) -> dict[str, Any]:
    """The content of a file; ``of`` is of the first code."""
    rows = [
        {
            "code": f"{c:06X}",
            "fault": name,
            "status": 0x50,
            "failures": 0,
            "trips": 0,
            "age": 0,
            "first": "",
            "last": "",
        }
        for c, name in zip(CODES, FAULTS, strict=True)
    ]
    rows[0] |= of
    return {"schema": 1, "codes": rows, "texts": {}}


def test_the_file_has_every_code_with_all_that_is_known(tmp_path: Path) -> None:
    trouble = TroubleMemory()
    trouble.entries[0] = Entry(0x2F, 3, 2, 1, b"first", b"last")
    trouble.texts = {"F199": "20260101"}
    wanted = written(
        status=0x2F, failures=3, trips=2, age=1, first=base64.b64encode(b"first").decode(),
        last=base64.b64encode(b"last").decode(),
    ) | {"texts": {"F199": "20260101"}, "wrong_keys": 2}  # fmt: skip
    trouble.wrong_keys = 2
    assert trouble.dump() == json.dumps(wanted, indent=1) + "\n"
    file = tmp_path / "codes.json"
    file.write_text(trouble.dump())
    again = TroubleMemory.load(file)
    assert again.entries[0] == Entry(0x6C, 3, 2, 1, b"first", b"last"), "and a new cycle has begun"
    assert again.entries[1:] == [Entry()] * 8 and again.texts == trouble.texts and again.on


def test_without_a_file_the_memory_is_empty(tmp_path: Path) -> None:
    trouble = TroubleMemory.load(tmp_path / "none.json")
    assert trouble.entries == [Entry()] * 9 and not trouble.changed
    with pytest.raises(InputError, match="cannot be read"):
        TroubleMemory.load(tmp_path)


@pytest.mark.parametrize(
    ("of", "good"),
    [
        ({"failures": 255}, True), ({"failures": 256}, False), ({"failures": -1}, False), ({"status": 255}, True),
        ({"status": 256}, False), ({"trips": 256}, False), ({"age": -1}, False), ({"age": 0}, True),
        ({"first": base64.b64encode(bytes(255)).decode()}, True),
        ({"first": base64.b64encode(bytes(256)).decode()}, False),
        ({"last": base64.b64encode(bytes(255)).decode()}, True),
        ({"last": base64.b64encode(bytes(256)).decode()}, False),
        ({"first": "*"}, False), ({"first": 3}, False), ({"fault": "else"}, False), ({"age": "old"}, False),
    ],
)  # fmt: skip
def test_a_file_is_read_up_to_its_limits(of: dict[str, Any], good: bool, tmp_path: Path) -> None:
    file = tmp_path / "codes.json"
    file.write_text(json.dumps(written(**of)))
    if good:
        TroubleMemory.load(file)
    else:
        with pytest.raises(InputError, match=r"codes\.json: is no memory of trouble codes"):
            TroubleMemory.load(file)


def test_a_file_has_at_most_65536_bytes(tmp_path: Path) -> None:
    file = tmp_path / "codes.json"
    text = json.dumps(written())
    file.write_text(text.ljust(65_536))
    TroubleMemory.load(file)
    file.write_text(text.ljust(65_537))
    with pytest.raises(InputError, match="65536 bytes"):
        TroubleMemory.load(file)


def test_of_a_file_s_texts_no_more_is_taken_than_fits_and_a_refusal_is_one_short_line(tmp_path: Path) -> None:
    file = tmp_path / "codes.json"
    file.write_text(json.dumps(written() | {"texts": {"F1999": "x" * 33}}))
    assert TroubleMemory.load(file).texts == {"F199": "x" * 32}
    file.write_text(json.dumps(written(age="x" * 999)))
    with pytest.raises(InputError) as e:
        TroubleMemory.load(file)
    assert len(str(e.value)) == 200 and "\n" not in str(e.value)


# ---- routines --------------------------------------------------------------------------------------------------------


def test_routines_have_an_order() -> None:
    s = unlocked()
    for request, answer in (
        ("31 02 02 01", "7F 31 24"), ("31 03 02 01", "7F 31 24"), ("31 03 02 03", "7F 31 24"),
        ("31 01 02 01", "71 01 02 01"), ("31 01 02 01", "7F 31 24"), ("31 01 02 02", "7F 31 24"),
        ("31 01 02 03", "7F 31 24"), ("31 02 02 02", "7F 31 24"), ("31 03 02 02", "7F 31 24"),
        ("31 03 02 01", "71 03 02 01 01" + " 00" * 12), ("31 02 02 01", "71 02 02 01"), ("31 02 02 01", "7F 31 24"),
        ("31 03 02 01", "71 03 02 01 02" + " 00" * 12), ("31 01 02 03", "71 01 02 03"), ("31 02 02 03", "7F 31 24"),
        ("31 03 02 03", "71 03 02 03 00"), ("31 01 02 02", "71 01 02 02"),
        ("31 03 02 02", "71 03 02 02 01" + " 00" * 8), ("31 03 02 01", "71 03 02 01 02" + " 00" * 12),
        ("31 02 02 02", "71 02 02 02"), ("31 03 02 02", "71 03 02 02 02" + " 00" * 8),
        ("31 00 02 01", "7F 31 12"), ("31 04 02 01", "7F 31 12"), ("31 01 02 00", "7F 31 31"),
        ("31 01 02 04", "7F 31 31"), ("31 04 02 04", "7F 31 31"), ("31 01 02 01 00", "7F 31 13"),
    ):  # fmt: skip
        assert asked(s, request) == answer, request


def test_a_routine_begins_without_faults_only() -> None:
    s = unlocked()
    s.node.loop.given.faults = 4.0
    assert asked(s, "31 01 02 01") == "7F 31 22" and asked(s, "31 01 02 02") == "7F 31 22"
    assert s.sweep is None


def test_what_is_learned_is_forgotten_in_standby_only() -> None:
    node = Node()
    state = node.loop.state
    names = ("offset", "width", "proved_offset", "proved_width", "learned_up", "learned_down", "trusted")
    for mode in (STANDBY, RUN, INIT):
        node.loop.given.mode = float(mode)
        for name in names:
            getattr(state, name)[:] = 0.5
        state.offset_in_use, state.width_in_use, state.n_dem = 0.25, 0.75, 61.0
        done = clear_learned(node)
        assert done == (mode == STANDBY)
        left = [*(v for name in names for v in getattr(state, name)), state.offset_in_use, state.width_in_use]
        assert set(left) == ({0.0} if done else {0.5, 0.25, 0.75}) and state.n_dem == 61.0


def test_the_demand_of_the_sweep_tick_by_tick() -> None:
    """45 % held for 1.5 s, up to 104 % at 12 %/s in 4917 ticks, held, down again, held: 14,334 ticks."""
    sweep = Sweep(SimpleNamespace(), 1000)  # type: ignore[arg-type]
    assert sweep.length == 14_334 and sweep.state == 1
    for at, wanted in (
        (0, 45.0), (1, 45.0), (1499, 45.0), (1500, 45.0), (1501, 45.012), (3000, 63.0), (6416, 45.0 + 12e-3 * 4916),
        (6417, 104.0), (7916, 104.0), (7917, 104.0), (7918, 103.988), (9417, 86.0), (12_833, 104.0 - 12e-3 * 4916),
        (12_834, 45.0), (14_334, 45.0), (20_000, 45.0),
    ):  # fmt: skip
        assert sweep.demand(1000 + at) == pytest.approx(wanted, abs=1e-9), at


def test_the_sweep_replaces_speeds_and_request_in_the_ecu_s_good_frames() -> None:
    sweep = Sweep(SimpleNamespace(), 0)  # type: ignore[arg-type]
    rows = []
    for request in range(4):
        rows.append((word0(ECU_DEMAND), encode_demand(70.0, 71.0, request, 5)))
    rows.append((word0(ECU_DEMAND), encode_demand(70.0, 71.0, 0, 5) ^ 1))  # a wrong CRC
    rows.append((word0(VGV_STATUS), encode_demand(70.0, 71.0, 0, 5)))
    given = np.array(rows, np.int64)
    out = sweep.replace(3000, given)
    assert (given == np.array(rows)).all()
    for i in (0, 1):
        assert decode_demand(int(out[i, 1])) == pytest.approx((63.0, 63.0, 1), abs=1e-3)
        assert crc(ECU_DEMAND, int(out[i, 1])) == int(out[i, 1]) & 0xFF and int(out[i, 1]) >> 8 & 15 == 5
    assert (out[2:] == given[2:]).all(), "more than a request to run is left as it is"


def swept(faults_at: int = -1) -> tuple[Sweep, int]:
    """A sweep over a loop whose stroke and angle tell the tick, and the tick with which it ended."""
    table = np.array([[0.0, 1.0], [-1.0, 3.0]])  # stroke, angle
    state = SimpleNamespace(x_servo=0.0, x_meas=0.0)
    loop = SimpleNamespace(
        state=state, angles=np.zeros(3), calibration=SimpleNamespace(angles=table), fed=SimpleNamespace(x_lvdt=0.0)
    )
    node = SimpleNamespace(loop=loop, faults=0)
    sweep = Sweep(node, 100)  # type: ignore[arg-type]
    for at in range(14_340):
        loop.fed.x_lvdt, loop.angles[0] = at * 1e-5, 4.0 * (at * 2e-5) - 1.0
        state.x_servo, state.x_meas = (1e-3, 2e-3) if at > 750 else (9.0, 1.0)
        node.faults = int(at == faults_at)
        sweep.look(100 + at)
        if sweep.state != 1:
            return sweep, at
    raise AssertionError("it never ends")


def test_the_sweep_measures_the_last_200_ticks_of_each_end_and_is_done_with_its_last_tick() -> None:
    sweep, ended = swept()
    assert ended == 14_334 and sweep.state == 0
    low, high = np.mean(range(1301, 1501)), np.mean(range(7718, 7918))
    assert sweep.low == pytest.approx((low * 1e-5, low * 2e-5), rel=1e-9)
    assert sweep.high == pytest.approx((high * 1e-5, high * 2e-5), rel=1e-9)
    assert sweep.worst == pytest.approx(1e-3), "the way to the first end does not count"


def test_the_largest_error_counts_from_the_751st_tick_on() -> None:
    loop = SimpleNamespace(
        state=SimpleNamespace(x_servo=0.0, x_meas=0.0), angles=np.zeros(1),
        calibration=SimpleNamespace(angles=np.array([[0.0, 1.0], [0.0, 1.0]])), fed=SimpleNamespace(x_lvdt=0.0),
    )  # fmt: skip
    sweep = Sweep(SimpleNamespace(loop=loop, faults=0), 0)  # type: ignore[arg-type]
    for at, error, worst in ((750, 5e-3, 0.0), (751, 1e-3, 1e-3), (752, -4e-3, 4e-3), (753, 2e-3, 4e-3)):
        loop.state.x_meas = 1.0
        loop.state.x_servo = 1.0 + error
        sweep.look(at)
        assert sweep.worst == pytest.approx(worst)


def test_a_fault_aborts_the_sweep() -> None:
    sweep, ended = swept(faults_at=2000)
    assert ended == 2000 and sweep.state == 2
    s = unlocked()
    asked(s, "31 01 02 01", 50)
    s.after(50)
    assert s.sweep is not None
    s.node.loop.given.faults = 1.0
    s.after(51)
    assert s.sweep is None and asked(s, "31 03 02 01", 52) == "71 03 02 01 02" + " 00" * 12
    asked(s, "31 01 02 03", 52)
    assert asked(s, "31 02 02 01", 52) == "7F 31 24"


def test_what_the_routines_tell_of_two_ends() -> None:
    sweep = Sweep(SimpleNamespace(), 0)  # type: ignore[arg-type]
    assert sweep.low == sweep.high == (0.0, 0.0) and sweep.worst == 0.0, "nothing is measured"
    assert sweep.result(0x0201) == b"\1" + bytes(12) and sweep.result(0x0202) == b"\1" + bytes(8)
    sweep = Sweep(SimpleNamespace(), 0, 0, (0.004, 0.005), (0.044, 0.037), 0.0015)  # type: ignore[arg-type]
    assert sweep.result(0x0201) == b"\0" + struct.pack(">3f", 4.0, 44.0, 1.5)
    assert sweep.result(0x0202)[:1] == b"\0"
    gain, offset = struct.unpack(">2f", sweep.result(0x0202)[1:])
    assert gain == pytest.approx(0.040 / 0.032) and offset == pytest.approx(4.0 - 1.25 * 5.0)
    for span, wanted in ((1e-3, 0.0), (1.0001e-3, 40.0), (-1.0001e-3, -40.0), (-1e-3, 0.0)):
        sweep = Sweep(SimpleNamespace(), 0, 2, (0.0, 0.0), (0.04, span), 0.0)  # type: ignore[arg-type]
        assert struct.unpack(">f", sweep.result(0x0202)[1:5])[0] == pytest.approx(wanted, rel=1e-3), span
        assert sweep.result(0x0202)[0] == 2
    sweep = Sweep(SimpleNamespace(), 0, 2, (0.004, 0.005))  # type: ignore[arg-type]
    assert sweep.result(0x0202) == b"\2" + bytes(8), "ended before the other end"


# ---- a calibration file ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("request_", "answer"),
    [
        ("34 00 11 00 01", "74 20 01 00"), ("34 00 11 00 00", "7F 34 70"),
        ("34 00 44 00 00 00 00 00 01 00 00", "74 20 01 00"),
        ("34 00 44 00 00 00 00 00 01 00 01", "7F 34 70"), ("34 00 44 FF FF FF FF 00 00 00 05", "74 20 01 00"),
        ("34 00 41 07 00 00 00 09", "74 20 01 00"), ("34 00 14 00 00 00 07 09", "74 20 01 00"),
        ("34 00 15 00 00 00 00 00 09", "7F 34 31"), ("34 00 51 00 00 00 00 00 09", "7F 34 31"),
        ("34 00 10 09", "7F 34 31"), ("34 00 01 09", "7F 34 31"), ("34 01 11 00 09", "7F 34 31"),
        ("34 00 11 00", "7F 34 13"), ("34 00 11 00 09 00", "7F 34 13"), ("34 00 44 00 00 00 00 00 00 10", "7F 34 13"),
    ],
)  # fmt: skip
def test_what_a_download_may_announce(request_: str, answer: str) -> None:
    s = unlocked(session=2)
    assert asked(s, request_) == answer
    assert asked(s, "36 01 41") == ("76 01" if answer.startswith("74") else "7F 36 24")


def test_blocks_come_in_order_and_one_may_come_again() -> None:
    s = unlocked(session=2)
    asked(s, "34 00 11 00 05")
    for request, answer in (
        ("36 00 41", "7F 36 73"), ("36 02 41", "7F 36 73"), ("36 01 41 42", "76 01"), ("36 01 41 42", "76 01"),
        ("36 01", "76 01"), ("36 00 43", "7F 36 73"), ("36 03 43", "7F 36 73"), ("36 02 43 44 45 46", "7F 36 71"),
        ("37", "7F 37 24"), ("36 02 43 44", "76 02"), ("37", "7F 37 24"), ("36 03 45 46", "7F 36 71"),
        ("36 03 45", "76 03"), ("36 04 46", "7F 36 71"), ("37", ""), ("37", "7F 37 21"),
    ):  # fmt: skip
        assert asked(s, request) == answer, request
    begun = s.memory.desk._task
    assert begun is not None and (begun.name, begun.arguments) == ("load", (b"ABCDE",))


def test_a_block_has_at_most_256_bytes_and_their_numbers_begin_again_at_0() -> None:
    s = unlocked(session=2)
    asked(s, "34 00 22 00 00 10 00")
    assert asked(s, b"\x36\x01" + bytes(255)) == "7F 36 13" and asked(s, b"\x36\x01" + bytes(254)) == "76 01"
    for n in range(2, 520):
        assert asked(s, bytes([0x36, n & 0xFF, n & 0xFF])) == f"76 {n & 0xFF:02X}"
        assert asked(s, bytes([0x36, n & 0xFF, 0])) == f"76 {n & 0xFF:02X}", "the same again"


def test_a_download_begins_anew() -> None:
    s = unlocked(session=2)
    asked(s, "34 00 11 00 02")
    assert asked(s, "36 01 41 42") == "76 01"
    assert (
        asked(s, "34 00 11 00 03") == "74 20 01 00" and asked(s, "36 01 43") == "76 01" and asked(s, "37") == "7F 37 24"
    )
    assert asked(s, "34 00 11 00 00") == "7F 34 70" and asked(s, "36 02 44 45") == "76 02", (
        "a refused one changes nothing"
    )


def given_file(s: Server, raw: bytes, k: int = 0) -> None:
    """Transfer a file, and ask for its check."""
    assert asked(s, b"\x34\x00\x41\x00" + struct.pack(">I", len(raw)), k) == "74 20 01 00"
    for n, at in enumerate(range(0, len(raw), 254), 1):
        asked(s, bytes([0x36, n & 255]) + raw[at : at + 254], k)
    assert asked(s, "37", k) == ""


def answers_until(s: Server, first: int, last: int) -> dict[int, str]:
    """What is answered before each tick, with the desk at work."""
    out = {}
    for k in range(first, last):
        s.memory.desk.before(k, s.memory.desk.note())
        if found := s.before(k):
            out[k] = ", ".join(a.hex(" ").upper() for a in found)
    return out


def calibration(*changes: tuple[str, str]) -> bytes:
    """The shipped calibration.toml with other numbers."""
    text = path("calibration.toml").read_text(encoding="utf-8")
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    return text.encode()


def test_a_file_is_answered_after_40_and_120_ticks_and_its_session_lasts_5000_more() -> None:
    s = unlocked(session=2, k=1000)
    given_file(s, calibration(("kp = { value = 16.0", "kp = { value = 12.0")), 1000)
    for request, answer in (("3E 00", "7E 00"), ("22 F1 86", "7F 22 21"), ("99", "7F 99 21"), ("37", "7F 37 21")):
        assert asked(s, request, 1000) == answer
    assert answers_until(s, 1001, 1300) == {1040: "7F 37 78", 1120: "77"}
    assert s.memory.loop.calibration.scalars.kp == 12.0
    s.before(6119)
    assert s.session == 2 and s.before(6119) == [], "answered once"
    s.before(6120)
    assert s.session == 1


def test_a_session_does_not_end_while_its_file_is_checked() -> None:
    s = unlocked(session=2)
    given_file(s, b"x")
    s.before(5000)
    assert s.session == 2
    assert answers_until(s, 5001, 5003) == {5001: "7F 37 72"}


def test_a_check_that_does_not_end_is_answered_after_1500_ticks() -> None:
    s = unlocked(session=2)
    s.memory.desk.runner = SimpleNamespace(begin=lambda *of: None, done=lambda: (0, None))  # type: ignore[assignment]
    given_file(s, calibration())
    assert answers_until(s, 1, 3000) == {40: "7F 37 78", 1500: "7F 37 72"}


def test_the_answer_waits_for_a_check_of_another_tool() -> None:
    s = unlocked(session=2)
    given_file(s, calibration(("kp = { value = 16.0", "kp = { value = 12.0")))
    assert answers_until(s, 1, 100) == {40: "7F 37 78"}
    said: list[Any] = []
    s.memory.desk.begin(Task("judge", (s.memory.live(), ()), said.append), lambda why: None)
    assert [s.before(k) for k in (120, 121, 122)] == [[], [], []] and s.memory.loop.calibration.scalars.kp == 16.0
    assert answers_until(s, 123, 125) == {123: "77"} and s.memory.loop.calibration.scalars.kp == 12.0 and said == [""]


def test_where_another_check_is_under_way_the_end_may_be_asked_for_again() -> None:
    s = unlocked(session=2)
    asked(s, "34 00 11 00 01")
    asked(s, "36 01 41")
    s.memory.desk.begin(Task("judge", (s.memory.live(), ()), lambda found: None), lambda why: None)
    assert asked(s, "37") == "7F 37 21" and asked(s, "22 F1 86") == "62 F1 86 02"
    s.memory.desk.before(1, s.memory.desk.note())
    assert asked(s, "37") == ""


@pytest.mark.parametrize(
    ("changes", "answer"),
    [
        ((("kp = { value = 16.0", "kp = { value = -1.0"),), "7F 37 72"),
        ((("current_limit = { value = 40.0", "current_limit = { value = 41.0"),), "7F 37 72"),  # reads, but is too much
        ((("current_limit = { value = 40.0", "current_limit = { value = 39.0"),), "77"),
    ],
)
def test_a_file_is_taken_over_whole_or_refused(changes: tuple[tuple[str, str], ...], answer: str) -> None:
    s = unlocked(session=2)
    play = s.memory.by_name()["play_vigv"]
    s.memory.change({play: 0.01}, judged=True)
    before = s.memory.live()
    given_file(s, calibration(*changes))
    assert answers_until(s, 1, 200)[120] == answer
    changed = np.flatnonzero(before != s.memory.live()).tolist()
    assert changed == ([s.memory.by_name()["current_limit"]] if answer == "77" else []), "and no other table's number"


@pytest.mark.parametrize("mode", range(5))
def test_a_file_is_not_taken_over_where_the_loop_was_closed_meanwhile(mode: int) -> None:
    s = unlocked(session=2)
    given_file(s, calibration())
    s.node.loop.given.mode = float(mode)
    assert answers_until(s, 1, 200)[120] == ("77" if mode in (INIT, STANDBY) else "7F 37 22")


# ---- on the bus ------------------------------------------------------------------------------------------------------


class Clock:
    """A service whose clock a test sets."""

    k = 0


def test_a_timer_of_the_transport_counts_ticks() -> None:
    clock = Clock()
    timer = _Ticks(1.0, clock)  # type: ignore[arg-type]
    assert timer.elapsed_ns() == 0 and not timer.is_timed_out()
    clock.k = 7
    assert timer.elapsed_ns() == 0
    timer.start()
    clock.k = 1007
    assert timer.elapsed_ns() == 1_000_000_000 and not timer.is_timed_out()
    clock.k = 1008
    assert timer.is_timed_out()
    timer.start(2.0)
    clock.k = 3008
    assert not timer.is_timed_out()
    clock.k = 3009
    assert timer.is_timed_out()
    timer.start()
    assert timer.elapsed_ns() == 0 and timer.timeout == 2_000_000_000


class Wire:
    """The tool's end of ISO-TP by hand: frames in, frames out, tick by tick."""

    def __init__(self, mode: int = STANDBY, **options: Any):
        self.server = server(mode, **options)
        self.service = UdsService(self.server)
        self.k = 0

    def tick(self, *frames: str, ident: int = 0x7E0) -> list[str]:
        """Run the service through a tick with these frames."""
        for frame in frames:
            self.service.hear(ident, bytes.fromhex(frame))
        self.service.before(self.k)
        while self.service.work():
            pass
        self.service.change(self.k, np.zeros((0, 2), np.int64), 0)
        out = self.service.after(self.k)
        self.k += 1
        if out is None:
            return []
        assert all(h & 0x7FF == 0x7E8 and h >> 32 & 15 == 8 for h, _ in out.tolist())
        return [int(d).to_bytes(8, "little", signed=True).hex(" ").upper() for _, d in out.tolist()]

    def run(self, ticks: int) -> dict[int, list[str]]:
        """Frames by tick, where there are any."""
        came = ((self.k, self.tick()) for _ in range(ticks))
        return {k: found for k, found in came if found}


PAD = " CC"


def test_single_frames_are_answered_in_their_tick_padded_with_cc() -> None:
    wire = Wire()
    assert wire.tick("02 3E 00") == ["02 7E 00" + 5 * PAD]
    assert wire.tick("03 22 F1 86 00 00 00 00") == ["04 62 F1 86 01" + 3 * PAD]
    assert wire.tick() == [] and wire.run(20) == {}
    assert wire.service.idents == (0x7E0, 0x7DF) and not wire.service.silent
    unlock(wire.server)
    wire.tick("03 28 01 01")
    assert wire.service.silent


@pytest.mark.parametrize(
    ("frame", "answer"),
    [
        ("02 3E 00", "02 7E 00"), ("02 3E 00 00 00 00 00 00", "02 7E 00"), ("02 3E", ""), ("00 3E 00", ""), ("", ""),
        ("01 3E", "03 7F 3E 13"), ("07 22 F1 86 F1 86 F1 86", "10 0A 62 F1 86 01"), ("08 22 F1 86 F1 86 F1 86", ""),
        ("10 08 22 F1 86", ""), ("03 22 F1 86", "04 62 F1 86 01"),
    ],
)  # fmt: skip
def test_a_request_to_all_is_a_single_frame(frame: str, answer: str) -> None:
    found = Wire().tick(frame, ident=0x7DF)
    assert len(found) == (answer != "") and all(f.startswith(answer) for f in found)


def test_a_request_to_all_is_marked_so() -> None:
    wire = Wire()
    assert wire.tick("01 99", ident=0x7DF) == [] and wire.tick("01 99") == ["03 7F 99 11" + 4 * PAD]


@pytest.mark.parametrize("ident", [0x7E0, 0x7DF])
def test_of_a_flood_64_frames_are_kept_the_oldest_go_and_are_counted(ident: int) -> None:
    wire = Wire()
    heard: list[tuple[bool, bytes]] = []
    wire.server.request = lambda k, data, functional=False: heard.append((functional, data)) or []  # type: ignore
    wire.tick(*[f"02 3E {n:02X}" for n in range(70)], ident=ident)
    wire.tick()
    assert heard == [(ident == 0x7DF, bytes([0x3E, n])) for n in range(6, 70)]
    assert wire.service.counts == {"dropped": 6, "untaken": 0}


def test_first_frames_without_end_wait_for_their_flow_control_to_be_sent() -> None:
    wire = Wire()
    for _ in range(50):
        assert len(wire.tick(*["10 64 2E F1 99 00 00 00"] * 60)) == 4
        assert len(wire.service._out) <= 64 and len(wire.service._in) <= 64
        assert wire.service._transport.rx_queue.empty() and wire.service._transport.tx_queue.empty()
    assert wire.service.dropped > 2500


def test_an_answer_without_pauses_goes_out_4_frames_a_tick() -> None:
    wire = Wire()
    asks = "22" + " F1 97" * 16
    raw = bytes.fromhex(asks)
    wire.tick(f"10 {len(raw):02X} " + raw[:6].hex(" "))
    for n, at in enumerate(range(6, len(raw), 7), 1):
        last = wire.tick(f"2{n:X} " + raw[at : at + 7].hex(" "))
    assert last[0][:2] == "11"
    came = [wire.tick("30 00 00")] + [wire.tick() for _ in range(30)]
    frames = [f for tick in came for f in tick]
    assert len(frames) == 50 and max(map(len, came)) == 4 and [len(t) for t in came[:12]] == [4] * 12
    assert [f[1] for f in frames] == [f"{n % 16:X}" for n in range(1, 51)]


def test_at_most_4_frames_go_out_a_tick_and_16_answers_wait() -> None:
    wire = Wire()
    found = [wire.tick(*["02 3E 00"] * 6, ident=0x7DF), wire.tick(), wire.tick()]
    assert [len(f) for f in found] == [4, 2, 0] and wire.service.untaken == 0
    answer = b"\x62" + bytes(19)
    wire.service._answer([answer] * 20)  # the first begins, and waits for flow control
    assert wire.service.untaken == 4
    wire.service._answer([answer])
    assert wire.service.untaken == 4, "one of them has begun, so there is room for one"
    wire.service._answer([b"\x62" + bytes(20)])
    assert wire.service.untaken == 5 and wire.service.dropped == 0
    sizes = [r.generator.total_length() for r in wire.service._transport.tx_queue.queue]
    assert sizes == [20] * 15 + [21], "the oldest goes"


def test_a_long_answer_waits_for_flow_control_and_keeps_the_tool_s_pauses() -> None:
    wire = Wire()
    (first,) = wire.tick("05 22 F1 97 F1 97")
    assert first.startswith("10 2D 62 F1 97")
    assert wire.run(100) == {}
    assert wire.tick("30 03 05") == []
    came = wire.run(60)
    assert [f[:2] for frames in came.values() for f in frames] == ["21", "22", "23"]
    ticks = list(came)
    assert {b - a for a, b in zip(ticks, ticks[1:], strict=False)} == {6}, "5 ms, so in the sixth"
    rest = [*wire.tick("30 00 00"), *wire.tick()]
    assert [f[:2] for f in rest] == ["24", "25", "26"] and wire.run(100) == {}


@pytest.mark.parametrize(("wait", "goes_on"), [(1000, True), (1001, False)])
def test_flow_control_may_take_1000_ticks(wait: int, goes_on: bool) -> None:
    wire = Wire()
    assert len(wire.tick("03 22 F1 97")) == 1  # in tick 0
    wire.k = wait
    frames = wire.tick("30 00 00") + wire.tick()
    assert bool(frames) == goes_on


def test_a_long_request_is_asked_for_in_blocks_of_8_frames_1_ms_apart() -> None:
    wire = Wire()
    assert wire.tick("10 64 2E F1 99 00 00 00") == ["30 08 01" + 5 * PAD]
    for n in range(1, 8):
        assert wire.tick(f"2{n:X}" + " 00" * 7) == []
    assert wire.tick("28" + " 00" * 7) == ["30 08 01" + 5 * PAD]
    for n in range(9, 14):
        assert wire.tick(f"2{n:X}" + " 00" * 7) == []
    assert wire.tick("2E" + " 00" * 7) == ["03 7F 2E 7F" + 4 * PAD]


@pytest.mark.parametrize(("wait", "answered"), [(1000, True), (1001, False)])
def test_the_next_frame_of_a_request_may_take_1000_ticks(wait: int, answered: bool) -> None:
    wire = Wire()
    assert wire.tick("10 08 22 F1 86 F1 86 F1")[0][:8] == "30 08 01"
    wire.k = wait
    found = wire.tick("21 86 00 00 00 00 00 00") + wire.tick()
    assert bool(found) == answered


@pytest.mark.parametrize(("size", "good"), [(1024, True), (1025, False)])
def test_a_request_has_at_most_1024_bytes(size: int, good: bool) -> None:
    wire = Wire()
    (found,) = wire.tick(f"1{size >> 8:X} {size & 255:02X} 22 F1 86 F1 86 F1")
    assert found[:2] == ("30" if good else "32") and found[:8] == ("30 08 01" if good else found[:8])


def test_only_a_running_routine_changes_the_ecu_s_frames() -> None:
    wire = Wire()
    rows = np.array([(word0(ECU_DEMAND), encode_demand(70.0, 70.0, 0, 3)), row_of(0x123, b"x")], np.int64)
    same, n = wire.service.change(0, rows, 2)
    assert same is rows and n == 2
    wire.server.sweep = Sweep(wire.server.node, 0)
    other, n = wire.service.change(3000, rows, 1)
    assert n == 1 and len(other) == 1 and decode_demand(int(other[0, 1])) == pytest.approx((63.0, 63.0, 1), abs=1e-3)
