"""The UDS server: against the bytes of docs/uds.md, and against udsoncan's client, in lockstep and on a bus."""

from __future__ import annotations

import re
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.conftest import ROOT

pytest.importorskip("isotp")
pytest.importorskip("udsoncan")

import udsoncan
from udsoncan.client import Client
from udsoncan.exceptions import NegativeResponseException, TimeoutException

from hil.calibrate.prepare import PATIENCE
from hil.uds import TroubleMemory
from hil.uds.server import SIGNALS, key_of
from hil.uds.station import FUNCTIONAL, REQUEST, RESPONSE
from hil.uds.trouble import AGE, CODES
from tests.installed_run import installed_run, until_heard
from tests.uds_bus import Bench, Lockstep
from vaneloop.base.errors import InputError
from vaneloop.base.tables import path


def client(connection: Any, **settings: Any) -> Client:
    """udsoncan's client, with our key and identifiers, and these settings of its own."""
    config = {
        "security_algo": lambda level, seed, params: key_of(bytes(seed)),
        "data_identifiers": {**dict.fromkeys(SIGNALS, ">f"), 0xF18C: udsoncan.AsciiCodec(13), 0xF199:
                             udsoncan.AsciiCodec(8), "default": ">f"},
        "request_timeout": 20, "p2_timeout": 2, "p2_star_timeout": 10,
    }  # fmt: skip
    return Client(connection, config=config | settings)


def client_on_a_bus(bus: Any) -> Client:
    """udsoncan's client on a bus that runs in real time. The server's own 50 ms judge the machine, so they do not end
    its wait.
    """
    import isotp
    from udsoncan.connections import PythonIsoTpConnection

    address = isotp.Address(isotp.AddressingMode.Normal_11bits, txid=REQUEST, rxid=RESPONSE)
    connection = PythonIsoTpConnection(isotp.CanStack(bus, address=address))
    return client(connection, use_server_timing=False, p2_timeout=5)


def unlock(bench: Bench, session: int = 3) -> None:
    """Open a session and its lock."""
    assert bench.ask(bytes([0x10, session]))[0].startswith("50")
    seed = bytes.fromhex(bench.ask("27 01")[0])[2:]
    assert bench.ask(b"\x27\x02" + key_of(seed)) == ["67 02"]


def test_the_published_vectors_are_what_the_server_answers() -> None:
    text = (ROOT / "docs" / "uds.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| [^|]+ \| `([0-9A-F ]+)` \| `([0-9A-F ,]*)` \|", text, re.M)
    assert len(rows) > 25
    bench = Bench(request=0, seed=0).run(500)
    for request, answer in rows:
        wanted = [a.strip() for a in answer.split(",") if a.strip()]
        assert bench.ask(request, 400 if len(wanted) > 1 else 0) == wanted, request


def test_a_service_engineer_s_session_with_udsoncan() -> None:
    bench = Bench().run(500)
    assert bench.node.mode == "RUN"
    with client(Lockstep(bench)) as c:
        assert c.read_data_by_identifier(0xF18C).service_data.values[0xF18C] == "VANELOOP-0001"
        bench.ecu = None  # the ECU falls silent
        bench.sent = bench.sent[:0]
        bench.run(1200)
        assert bench.node.mode == "FAIL_SAFE"
        codes = c.get_dtc_by_status_mask(0x01).service_data.dtcs
        assert [d.id for d in codes] == [CODES["demand_stale"].number]
        assert codes[0].status.test_failed and codes[0].status.pending and not codes[0].status.confirmed
        assert c.get_number_of_dtc_by_status_mask(0xFF).service_data.dtc_count >= 1
        frame = c.get_dtc_snapshot_by_dtc_number(codes[0].id, 1).service_data.dtcs[0].snapshots
        t = {s.did: s.data for s in frame}
        assert 0.5 < t[0x2000][0] < 0.7 and t[0x2006][0] in (2.0, 3.0)
        # a routine needs a session, a key, and the loop open
        with pytest.raises(NegativeResponseException) as e:
            c.start_routine(0x0201)
        assert e.value.response.code == 0x7F
        c.change_session(3)
        c.unlock_security_access(1)
        with pytest.raises(NegativeResponseException) as e:
            c.start_routine(0x0201)
        assert e.value.response.code == 0x22
        c.clear_dtc(0xFFFFFF)


def test_the_stroke_sweep_measures_the_stroke_and_leaves_the_loop_as_it_was() -> None:
    bench = Bench(request=0).run(500)
    assert bench.node.mode == "STANDBY"
    unlock(bench)
    assert bench.ask("31 01 02 01") == ["71 01 02 01"]
    seen = set()
    for k in range(15_000):
        bench.tick()
        seen.add(bench.node.mode)
        if k % 2000 == 0:
            assert bench.ask("3E 80", 0) == []
        loop = bench.node.loop
        assert abs(loop.given.i_cmd) <= loop.calibration.scalars.current_limit
    answer = bytes.fromhex(bench.ask("31 03 02 01")[0])
    assert answer[:5] == b"\x71\x03\x02\x01\x00", "it must have been done"
    low, high, worst = struct.unpack(">3f", answer[5:])
    table = loop.calibration.table
    assert low == pytest.approx(1e3 * np.interp(45.0, table[0], table[2]), abs=0.3)
    assert high == pytest.approx(1e3 * np.interp(104.0, table[0], table[1]), abs=0.3)
    assert 0.0 < worst < 5.0 and "RUN" in seen
    bench.run(200)
    assert bench.node.mode == "STANDBY" and bench.node.faults == 0
    counts = bench.node.counts
    assert counts["wrong_crc"] == counts["wrong_sequence"] == counts["repeated"] == 0


def test_a_session_that_dies_ends_the_sweep() -> None:
    bench = Bench(request=0).run(500)
    unlock(bench)
    bench.ask("31 01 02 02")
    bench.run(3000)
    assert bench.node.mode == "RUN"
    bench.run(2500)  # S3 is over
    assert bench.server.session == 1 and bench.node.mode == "STANDBY"


def test_three_wrong_keys_bring_the_delay() -> None:
    bench = Bench(request=0).run(100)
    bench.ask("10 03")
    codes = []
    for _ in range(3):
        bench.ask("27 01")
        codes += bench.ask(b"\x27\x02" + bytes(8))
    assert codes == ["7F 27 35", "7F 27 35", "7F 27 36"]
    assert bench.ask("27 01") == ["7F 27 37"]
    for _ in range(11):
        bench.run(1000)
        bench.ask("3E 00")
    assert bench.ask("27 01")[0].startswith("67 01")


def test_a_fault_is_pending_then_confirmed_then_ages_away() -> None:
    stale = CODES["demand_stale"].number
    trouble = TroubleMemory()
    frame = lambda: b"x" * 36  # noqa: E731
    for cycle in (1, 2):
        trouble.look(2, 1, frame)
        entry = trouble.entry(stale)
        assert entry is not None and entry.status & 0x2F == (0x27 if cycle == 1 else 0x2F)
        trouble.look(2, 0, frame)
        assert not entry.status & 1 and entry.status & 4
        trouble.new_cycle()
        assert entry.status & 0x40 and not entry.status & 2
    for cycle in range(AGE):
        assert entry.status & 8, cycle
        trouble.look(2, 0, frame)
        trouble.new_cycle()
    assert not entry.status & 8 and entry.first == b"" and not entry.status & 4


def test_trouble_codes_are_kept_over_a_restart(tmp_path: Path) -> None:
    kept: list[str] = []
    bench = Bench(store=kept.append).run(500)
    bench.ecu, bench.sent = None, bench.sent[:0]
    bench.run(300)
    file = tmp_path / "codes.json"
    file.write_text(kept[-1])
    again = TroubleMemory.load(file)
    entry = again.entry(CODES["demand_stale"].number)
    assert entry is not None and entry.failures == 1 and len(entry.first) == 4 * len(SIGNALS)
    assert entry.status & 0x20 and entry.status & 0x40 and not entry.status & 1
    for text in ("", "[]", '{"codes": 3}', kept[-1].replace('"failures": 1', '"failures": 999'), "\x00" * 99,
                 kept[-1].replace('"failures": 1', '"failures": Infinity'),
                 kept[-1].replace('keys": 0', 'keys": 256'), kept[-1].replace('keys": 0', 'keys": -1')):  # fmt: skip
        file.write_text(text)
        with pytest.raises(InputError, match="is no memory of trouble codes"):
            TroubleMemory.load(file)


def test_a_calibration_file_is_loaded_whole_or_not_at_all() -> None:
    text = path("calibration.toml").read_text(encoding="utf-8")
    bench = Bench(request=0).run(500)
    assert bench.node.mode == "STANDBY"
    kp = float(bench.node.loop.calibration.scalars.kp)
    for change, good in (("kp = { value = 12.0", True), ("kp = { value = -12.0", False)):
        raw = text.replace("kp = { value = 16.0", change).encode()
        unlock(bench, 2)
        assert bench.ask(b"\x34\x00\x44" + struct.pack(">II", 0, len(raw))) == ["74 20 01 00"]
        for n, at in enumerate(range(0, len(raw), 254), 1):
            assert bench.ask(bytes([0x36, n & 255]) + raw[at : at + 254]) == [f"76 {n & 255:02X}"]
        answers = bench.ask("37", 400)
        assert answers == (["7F 37 78", "77"] if good else ["7F 37 78", "7F 37 72"]), answers
        assert bench.node.loop.calibration.scalars.kp == 12.0 != kp


def given_a_file(bench: Bench, change: str) -> None:
    """Transfer a calibration.toml with another kp."""
    raw = path("calibration.toml").read_text(encoding="utf-8").replace("kp = { value = 16.0", change).encode()
    unlock(bench, 2)
    bench.ask(b"\x34\x00\x44" + struct.pack(">II", 0, len(raw)))
    for n, at in enumerate(range(0, len(raw), 254), 1):
        bench.ask(bytes([0x36, n & 255]) + raw[at : at + 254])


def test_a_file_is_refused_where_the_loop_was_closed_while_it_was_checked() -> None:
    bench = Bench(request=0).run(500)
    given_a_file(bench, "kp = { value = 12.0")
    assert bench.server.request(bench.node.k, b"\x37") == []
    # whoever else asks in the same tick is answered
    assert bench.server.request(bench.node.k, b"\x3e\x00") == [b"\x7e\x00"]
    assert bench.server.request(bench.node.k, b"\x22\xf1\x86") == [b"\x7f\x22\x21"]
    assert bench.ecu is not None
    bench.ecu.set_demand(70.0, mode_request=1)
    answers = []
    for _ in range(200):
        answers += [a.hex() for a in bench.server.before(bench.node.k)]
        bench.tick()
    assert answers == ["7f3778", "7f3722"] and bench.node.mode == "RUN"
    assert bench.node.loop.calibration.scalars.kp == 16.0


def test_a_file_waits_for_its_check_as_long_as_that_takes() -> None:
    bench = Bench(request=0).run(500)
    given_a_file(bench, "kp = { value = 12.0")
    desk = bench.memory.desk
    runner, desk.runner = desk.runner, Never()  # type: ignore[assignment]
    bench.server.request(bench.node.k, b"\x37")
    answers = [frame[1:4].hex() for _ in range(PATIENCE + 10) for frame in bench.tick()]
    assert answers == ["7f3778", "7f3772"] and bench.node.loop.calibration.scalars.kp == 16.0
    desk.runner = runner
    given_a_file(bench, "kp = { value = 12.0")
    assert bench.ask("37", 400) == ["7F 37 78", "77"] and bench.node.loop.calibration.scalars.kp == 12.0


class Never:
    """Work that is never done."""

    def begin(self, *of: Any) -> None:
        """Forget it."""

    def done(self) -> tuple[int, Any]:
        return 0, None


def test_nothing_that_opens_the_loop_is_done_in_run() -> None:
    bench = Bench().run(500)
    assert bench.node.mode == "RUN"
    assert bench.ask("10 02") == ["7F 10 22"]
    unlock(bench)
    assert bench.ask("11 01") == ["7F 11 22"]
    assert bench.ask("28 01 01") == ["7F 28 22"] and bench.ask("31 01 02 03") == ["7F 31 22"]
    assert bench.ask("85 02") == ["C5 02"]
    bench.ecu, bench.sent = None, bench.sent[:0]
    bench.run(1200)
    assert bench.node.mode == "FAIL_SAFE", "the monitors go on, whatever the memory keeps"
    assert not bench.server.trouble.by_mask(0x01)


def test_silence_ends_with_its_session() -> None:
    bench = Bench(request=0).run(500)
    unlock(bench)
    assert bench.ask("28 01 01") == ["68 01"]
    own = bench.own
    bench.run(1000)
    assert bench.own == own
    bench.run(4200)
    assert bench.own > own


def test_silence_asked_for_in_standby_does_not_last_into_run() -> None:
    bench = Bench(request=0).run(500)
    unlock(bench)
    assert bench.ask("28 01 01") == ["68 01"]
    assert bench.ecu is not None
    bench.ecu.set_demand(70.0, mode_request=1)
    own = bench.own
    while bench.node.mode == "STANDBY":
        bench.tick((REQUEST, bytes.fromhex("023E80")))
    bench.run(100)
    assert bench.node.mode == "RUN" and bench.own - own >= 30 and bench.ecu.stale() == []


def test_resets_in_a_row_leave_the_firmware_time_to_come_into_run() -> None:
    bench = Bench(request=1)
    seen = []
    for _ in range(600):
        if bench.node.mode in ("INIT", "STANDBY"):
            bench.ask("10 03", 0)
            if (seed := bytes.fromhex(bench.ask("27 01", 0)[0])[2:]) != bytes(8):
                bench.ask(b"\x27\x02" + key_of(seed), 0)
            bench.ask("11 01", 0)
        bench.run(1)
        seen.append(bench.node.mode)
    assert seen.count("RUN") > 300


def test_random_requests_leave_the_limits_alone() -> None:
    bench = Bench().run(500)
    rng = np.random.default_rng(8)
    services = list(bench.server._services)
    for k in range(4000):
        raw = rng.integers(0, 256, rng.integers(1, 9), dtype=np.uint8)
        if k % 3 == 0:
            raw = np.concatenate([[len(raw) % 8], [rng.choice(services)], raw]).astype(np.uint8)[:8]
        bench.tick((REQUEST if k % 5 else FUNCTIONAL, raw.tobytes()))
        if k % 50 == 0:
            bench.ask(bytes([rng.choice(services)]) + raw.tobytes(), 0)
            bench.ask("10 03", 0)
        loop = bench.node.loop
        assert abs(loop.given.i_cmd) <= loop.calibration.scalars.current_limit
        assert bench.node.mode == "RUN" and bench.node.faults == 0


def test_udsoncan_reads_the_installed_command_on_the_embedded_bus(tmp_path: Path) -> None:
    import os

    from hil.bus.port import open_bus

    channel, memory = f"uds{os.getpid()}", tmp_path / "codes.json"
    with installed_run("--bus", f"local:{channel}", "--uds", "--uds-memory", str(memory), "--duration", "120"):
        bus = open_bus(f"local:{channel}", can_filters=[{"can_id": RESPONSE, "can_mask": 0x7FF}])
        with client_on_a_bus(bus) as c:

            def work() -> None:
                assert c.read_data_by_identifier(0xF18C).service_data.values[0xF18C] == "VANELOOP-0001"
                c.change_session(3)
                c.unlock_security_access(1)
                c.write_data_by_identifier(0xF199, "20260101")
                assert c.get_supported_dtc().service_data.dtc_count == len(CODES)

            until_heard(work, TimeoutException)
        bus.shutdown()
    assert TroubleMemory.load(memory).texts == {"F199": "20260101"}
