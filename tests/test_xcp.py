"""The XCP slave: against the bytes of docs/xcp.md, and against pyxcp's master in lockstep and on the embedded bus."""

from __future__ import annotations

import logging
import os
import re
import shutil
import struct
import subprocess
import sys
import time
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from controller import FAULTS, INPUTS, MODES, load_calibration
from controller.records import STATE
from hil.calibrate import Attended, Memory, Slave, master
from hil.calibrate.a2l import a2l_of
from hil.calibrate.memory import CALIBRATION, Refusal
from hil.calibrate.prepare import PATIENCE, WORK, Desk, Outside, Task
from hil.calibrate.slave import key_of
from hil.calibrate.station import MASTER, SLAVE, XcpService, data_of, replay_attended, row_of
from hil.loop.node import Ecu, Node
from hil.native import Program
from hil.native.program import own_scalars
from tests.conftest import ROOT
from tests.installed_run import installed_run
from tests.native_builds import build
from vaneloop.base.tables import path as table_path

NOTHING = np.zeros((0, 2), np.int64)


def done(memory: Memory, task: Task | None) -> None:
    """Let what a task changes take effect now."""
    if task is not None:
        task.finish(WORK[task.name](memory.elements, *task.arguments))


class Bench:
    """A node in RUN with a slave, and its ECU, tick by tick."""

    def __init__(self, **options: Any):
        self.node = Node(seed=3)
        self.memory = Memory(self.node)
        options.setdefault("a2l", lambda: a2l_of(self.memory, master=MASTER, slave=SLAVE))
        self.slave = Slave(self.memory, **options)
        self.attended = Attended(self.node, XcpService(self.slave))
        self.ecu = Ecu(n_dem=70.0)
        self.sent = NOTHING

    def tick(self, *commands: bytes) -> list[bytes]:
        """Run a tick with these commands; return what the slave sent."""
        frames = [*self.ecu.tick(self.sent).tolist(), *(row_of(MASTER, c) for c in commands)]
        out = self.attended.tick(np.array(frames, np.int64).reshape(-1, 2))
        own = out[:, 0] & 0x7FF == SLAVE
        self.sent = out[~own].copy()
        return [(d & (1 << 64) - 1).to_bytes(8, "little")[: h >> 32 & 15] for h, d in out[own].tolist()]

    def answers(self, command: str | bytes, n: int = 1) -> list[bytes]:
        """The ``n`` answers to a command; one that is checked outside of the tick comes later."""
        out = self.tick(bytes.fromhex(command) if isinstance(command, str) else command)
        for _ in range(3):
            if len(out) < n:
                out += self.tick()
        assert len(out) == n, out
        return out

    def ask(self, command: str | bytes) -> bytes:
        """The one answer to a command."""
        return self.answers(command)[0]

    def run(self, ticks: int = 500) -> Bench:
        """Run until the controller is in RUN."""
        for _ in range(ticks):
            self.tick()
        return self


def number(bench: Bench, name: str) -> int:
    """Address of a calibration value."""
    return CALIBRATION + 8 * bench.memory.by_name()[name]


def write(bench: Bench, name: str, value: float) -> list[str]:
    """Write a double in two commands, as a master on classic CAN does; the answers."""
    raw = struct.pack("<d", value)
    answers = [bench.ask(struct.pack("<BxxBI", 0xF6, 0, number(bench, name)))]
    answers += [bench.ask(bytes([0xF0, len(part)]) + part) for part in (raw[:6], raw[6:])]
    return [a.hex() for a in answers]


def published() -> list[tuple[str, str]]:
    """Requests and answers of docs/xcp.md."""
    text = (ROOT / "docs" / "xcp.md").read_text(encoding="utf-8")
    return re.findall(r"^\| [^|]+ \| `([0-9A-F ]+)` \| `([0-9A-F ,]+)` \|", text, re.M)


def test_the_published_vectors_are_what_the_slave_answers() -> None:
    rows = published()
    assert len(rows) > 30
    bench = Bench(save=None).run()
    for request, answers in rows:
        found = bench.tick(bytes.fromhex(request))
        while sum(map(len, found)) < sum(len(bytes.fromhex(a)) for a in answers.split(",")):
            found += bench.tick()
        assert [a.hex(" ").upper() for a in found] == [a.strip() for a in answers.split(",")], request


def test_nobody_is_answered_before_connect_and_everything_unknown_gets_an_error() -> None:
    bench = Bench()
    assert bench.tick(b"\xfd") == [] and bench.tick(b"\xf5\x01") == []
    bench.ask("FF00")
    assert (
        bench.tick(b"\x01") == []
        and bench.ask("C5") == b"\xfe\x20"
        and bench.ask("F0") == b"\xfe\x21"
        and bench.ask("FC") == b"\xfe\x00"
    )
    assert bench.ask("FE") == b"\xff" and bench.tick(b"\xfd") == []


def test_what_is_read_is_what_the_tick_used() -> None:
    bench = Bench().run()
    bench.ask("FF00")
    for signal in bench.memory.signals[::7]:
        got = b"".join(bench.memory.read(0, signal.address + i, 4) for i in (0, 4))
        area, _, name = signal.name.partition("_")
        if area == "state":
            assert got == bench.node.loop.z[STATE.index(name) : STATE.index(name) + 1].tobytes(), signal.name
    before = bench.node.loop.z[STATE.index("x_servo")]
    answer = bench.ask(struct.pack("<BBBBI", 0xF4, 4, 0, 1, 0x12000000 + 4 * STATE.index("x_servo")))
    assert answer[1:] == np.float32(before).tobytes()


def test_a_value_takes_effect_whole_between_two_ticks() -> None:
    bench = Bench().run()
    bench.ask("FF00")
    was = bench.node.loop.calibration.scalars.kp
    raw = struct.pack("<d", 12.5)
    bench.ask(struct.pack("<BxxBI", 0xF6, 0, number(bench, "kp")))
    bench.ask(b"\xf0\x06" + raw[:6])
    assert bench.node.loop.calibration.scalars.kp == was, "half a number must not be there"
    bench.ask(b"\xf0\x02" + raw[6:])
    assert bench.node.loop.calibration.scalars.kp == 12.5


@pytest.mark.parametrize(
    ("name", "value", "code"),
    [
        ("kp", 1e9, "fe22"),
        ("kp", float("nan"), "fe22"),
        ("current_limit", 0.05, "fe22"),  # more than the valve's, by the tables' bound allowed
        ("current_limit", 0.03, "fe23"),  # in RUN
        ("tracking_limit", 0.09, "fe23"),
        ("strategy", 0.0, "fe23"),
        ("stages", 2.0, "fe23"),
        ("stroke_tables_extension_5", 0.0, "fe22"),  # would fall below its neighbour
    ],
)
def test_what_is_refused_changes_nothing(name: str, value: float, code: str) -> None:
    bench = Bench().run()
    assert bench.node.mode == "RUN"
    bench.ask("FF00")
    before = bench.memory.live()
    assert write(bench, name, value)[-1] == code
    assert (bench.memory.live() == before).all()


def test_monitors_may_be_set_while_the_loop_is_open() -> None:
    bench = Bench()
    bench.ask("FF00")
    assert bench.node.mode == "INIT"
    assert write(bench, "tracking_limit", 0.004)[-1] == "ff"
    assert bench.node.loop.calibration.scalars.tracking_limit == 0.004


def test_a_page_is_switched_whole_and_only_if_its_tables_can_be() -> None:
    bench = Bench().run()
    bench.ask("FF00")
    was = bench.node.loop.calibration.table.copy()
    assert bench.ask("EB 01 00 01") == b"\xff"  # the firmware on the reference page
    assert write(bench, "stroke_tables_extension_5", 0.0)[-1] == "ff"  # nobody uses it yet
    assert (bench.node.loop.calibration.table == was).all()
    assert bench.ask("EB 01 00 00") == b"\xfe\x22"
    assert write(bench, "stroke_tables_extension_5", float(was[1, 5]) + 1e-5)[-1] == "ff"
    assert bench.ask("EB 01 00 00") == b"\xff"
    assert bench.node.loop.calibration.table[1, 5] == was[1, 5] + 1e-5
    assert bench.ask("E4 00 01 00 00") == b"\xff"  # the reference page over the working page
    assert (bench.node.loop.calibration.table == was).all()
    assert bench.ask("E4 00 00 00 01") == b"\xfe\x23"


def test_other_nodes_of_the_same_tables_are_left_alone() -> None:
    tables = load_calibration()
    node = Node(calibration=tables)
    kp = float(tables.scalars.kp)
    memory = Memory(node)
    done(memory, memory.change({memory.by_name()["kp"]: 0.5 * kp}))
    assert node.loop.calibration.scalars.kp == 0.5 * kp and tables.scalars.kp == kp


def test_a_frozen_page_is_loaded_as_the_same_bits(tmp_path: Path) -> None:
    bench = Bench(save=tmp_path / "tuned").run()
    bench.ask("FF00")
    rng = np.random.default_rng(4)
    for name in ("kp", "ki", "kff", "trend_hold", "lead"):
        i = bench.memory.by_name()[name]
        e = bench.memory.elements[i]
        done(bench.memory, bench.memory.change({i: float(rng.uniform(e.low, min(e.high, 0.4)))}))
    assert bench.ask("F9 01 00 00") == b"\xfe\x27"
    bench.ask("E6 01 00")
    assert bench.answers("F9010000", 2) == [b"\xff", b"\xfd\x03"]
    back = load_calibration(
        tmp_path / "tuned" / "calibration.toml",
        tmp_path / "tuned" / "stroke_tables.toml",
        angles=tmp_path / "tuned" / "vane_angles.toml",
    )
    row = np.concatenate([back.k, back.table.reshape(-1), back.angles.reshape(-1)])
    assert (row == bench.memory.live()).all()


def test_without_the_key_nothing_is_changed_and_a_wrong_one_ends_the_session() -> None:
    bench = Bench(locked=("cal", "daq")).run()
    bench.ask("FF00")
    assert bench.ask("FD") == bytes.fromhex("FF0005000000")
    assert bench.ask("D6") == b"\xfe\x25" and bench.ask("F0 01 00") == b"\xfe\x25"
    seed = bench.ask("F8 00 01")
    assert seed[:2] == b"\xff\x06"
    assert bench.ask(b"\xf7\x06" + key_of("cal", seed[2:])) == b"\xff\x04"
    assert write(bench, "kp", 12.0)[-1] == "ff"
    seed = bench.ask("F8 00 04")
    assert bench.ask(b"\xf7\x06" + bytes(6)) == b"\xfe\x25"
    assert bench.tick(b"\xfd") == []


def test_the_checksum_is_that_of_the_page() -> None:
    bench = Bench()
    bench.ask("FF00")
    bench.ask(struct.pack("<BxxBI", 0xF6, 0, CALIBRATION))
    image = bench.memory.live().tobytes()
    assert bench.ask(struct.pack("<BxxxI", 0xF3, len(image))) == struct.pack("<BBHI", 0xFF, 9, 0, zlib.crc32(image))


def test_an_attended_node_does_what_one_alone_does() -> None:
    bench = Bench()
    alone, ecu, sent = Node(seed=3), Ecu(n_dem=70.0), NOTHING
    bench.ask("FF00")
    sent = alone.tick(ecu.tick(sent)).copy()
    for k in range(1500):
        bench.tick(b"\xfd", bytes([k & 0xFF]) * 5)
        sent = alone.tick(ecu.tick(sent)).copy()
    assert alone.fingerprint() == bench.node.fingerprint()


def test_stimulated_speeds_and_angles_reach_the_firmware_and_end_by_themselves() -> None:
    bench = Bench().run()
    bench.ask("FF00")
    names = ["n_dem", "n_r", "vigv"]
    for command in ("D6", "D5 00 01 00", "D4 00 00 00 03", *(f"D3 00 00 00 {t:02X} 01" for t in range(3))):
        assert bench.ask(command) == b"\xff", command
    for table, name in enumerate(names):
        bench.ask(f"E2 00 00 00 {table:02X} 00")
        bench.ask(struct.pack("<BBBBI", 0xE1, 0xFF, 4, 1, 0x10000000 + 4 * INPUTS.index(name)))
    assert bench.ask("E0 02 00 00 01 00 01 00") == b"\xff"
    assert bench.ask("DE 01 00 00") == b"\xff\x00"
    for _ in range(50):
        bench.tick(*(bytes([pid]) + struct.pack("<f", v) for pid, v in enumerate((81.0, 80.5, 0.25))))
    fed = bench.node.loop.fed
    assert (fed.n_dem, fed.n_r) == pytest.approx((81.0, 80.5), abs=0.002) and fed.pots[0] == 0.25
    assert bench.node.mode == "RUN" and bench.node.counts["wrong_crc"] == 0
    bench.run(130)
    assert fed.n_dem == pytest.approx(70.0, abs=0.002) and fed.pots[0] != 0.25


INPUT = 0x10000000  # address of the first


def stim_list(bench: Bench) -> None:
    """A list of one entry, and the pointer at it."""
    for command in ("D6", "D5 00 01 00", "D4 00 00 00 01", "D3 00 00 00 00 01", "E2 00 00 00 00 00"):
        assert bench.ask(command) == b"\xff", command


def entry(size: int, ext: int, address: int) -> bytes:
    """WRITE_DAQ of whole bytes."""
    return struct.pack("<BBBBI", 0xE1, 0xFF, size, ext, address)


def test_a_stimulated_stroke_is_what_the_monitors_judge() -> None:
    bench = Bench().run()
    bench.ask("FF00")
    stim_list(bench)
    assert bench.ask("E0 02 00 00 00 00 01 00") == b"\xff"
    assert bench.ask(entry(4, 1, INPUT + 4 * INPUTS.index("x_lvdt"))) == b"\xff"
    assert bench.ask("DE 01 00 00") == b"\xff\x00"
    loop, alone = bench.node.loop, Node(seed=3)
    own = loop.fed.x_lvdt
    assert bench.tick(b"\0" + struct.pack("<f", own)) == [] and loop.fed.x_lvdt == np.float32(own)
    assert bench.node.faults == 0
    high = float(loop.calibration.scalars.lvdt_high) + 1e-3
    for _ in range(60):
        bench.tick(b"\0" + struct.pack("<f", high))
    assert loop.fed.x_lvdt == np.float32(high)
    assert bench.node.faults >> FAULTS.index("lvdt_range") & 1 and bench.node.mode == "FAIL_SAFE"
    assert abs(loop.given.i_cmd) <= loop.calibration.scalars.current_limit
    bench.run(130)
    assert loop.fed.x_lvdt != np.float32(high) and np.isnan(alone.loop.lvdt).all()


@pytest.mark.parametrize(
    ("size", "ext", "address", "code"),
    [
        (4, 1, INPUT + 4 * INPUTS.index("n_r") + 2, "fe22"),  # between two inputs
        (2, 1, INPUT, "fe22"),
        (4, 0, INPUT, "fe22"),
        (4, 1, INPUT + 4 * INPUTS.index("demand_fresh"), "fe23"),  # monitors judge by it
        (4, 1, INPUT + 4 * INPUTS.index("pause"), "fe23"),
        (4, 1, 0x12000000, "fe22"),
        (4, 1, CALIBRATION, "fe22"),
    ],
)
def test_what_is_not_one_input_cannot_be_stimulated(size: int, ext: int, address: int, code: str) -> None:
    bench = Bench().run(1)
    bench.ask("FF00")
    stim_list(bench)
    assert bench.ask(entry(size, ext, address)) == b"\xff"  # it may be measured
    assert bench.ask("E0 02 00 00 00 00 01 00").hex() == code
    stim_list(bench)
    assert bench.ask("E0 02 00 00 00 00 01 00") == b"\xff"
    assert bench.ask(entry(size, ext, address)).hex() == code


def test_an_overload_says_so_by_itself() -> None:
    bench = Bench().run(20)
    bench.ask("FF00")
    tables = 33  # one more than a tick takes
    for command in ("D6", "D5 00 01 00", f"D4 00 00 00 {tables:02X}"):
        bench.ask(command)
    for t in range(tables):
        bench.ask(f"D3 00 00 00 {t:02X} 01")
        bench.ask(f"E2 00 00 00 {t:02X} 00")
        bench.ask(entry(4, 1, 0x12000000))
    bench.ask("E0 10 00 00 00 00 01 00")
    assert b"\xfd\x06" in bench.tick(b"\xde\x01\x00\x00")
    seen = [frame for _ in range(1000) for frame in bench.tick()]
    assert set(seen) == {b"\xfd\x06"} and 9 <= len(seen) <= 11, "again as long as it lasts, but not in every tick"


class Held:
    """Work that is done when a test says so."""

    def __init__(self, memory: Memory):
        self.memory, self.held, self.free = memory, (0, None), False

    def begin(self, number: int, name: str, arguments: tuple[Any, ...]) -> None:
        self.held = number, WORK[name](self.memory.elements, *arguments)

    def done(self) -> tuple[int, Any]:
        return self.held if self.free else (0, None)


@pytest.mark.parametrize("what", ["value", "page", "copy", "save"])
def test_no_tick_waits_for_a_check_and_what_it_changes_acts_whole_with_its_answer(what: str, tmp_path: Path) -> None:
    bench = Bench(save=tmp_path).run()
    bench.ask("FF00")
    write(bench, "kp", 12.5)
    bench.memory.desk = bench.attended.desk = Desk(held := Held(bench.memory))  # type: ignore[arg-type]
    command = {"page": "EB 01 00 01", "copy": "E4 00 01 00 00", "save": "F9 01 00 00"}.get(what, "F0 02 26 40")
    if what == "value":
        bench.ask(struct.pack("<BxxBI", 0xF6, 0, number(bench, "kp")))
        bench.ask("F0 06 00 00 00 00 00 00")
    bench.ask("E6 01 00")
    was = bench.memory.live()
    for frames in (bench.tick(bytes.fromhex(command)), bench.tick(b"\xfd"), *(bench.tick() for _ in range(40))):
        assert frames == [] and (bench.memory.live() == was).all() and not list(tmp_path.glob("*"))[3:]
    held.free = True
    assert bench.tick()[0] == b"\xff"
    kp = bench.node.loop.calibration.scalars.kp
    assert kp == {"value": 11.0, "page": 16.0, "copy": 16.0, "save": 12.5}[what]
    assert (tmp_path / "calibration.toml").exists() == (what == "save")


def test_a_check_that_does_not_end_is_given_up_and_changes_nothing() -> None:
    bench = Bench().run()
    bench.ask("FF00")
    bench.memory.desk = bench.attended.desk = Desk(Held(bench.memory))  # type: ignore[arg-type]
    bench.memory.desk.k = bench.node.k
    bench.tick(b"\xeb\x01\x00\x01")
    answers = [frame.hex() for _ in range(PATIENCE + 2) for frame in bench.tick()]
    assert answers == ["fe10"] and bench.memory.ecu_page == 0
    assert bench.ask("EA 01 00") == b"\xff\x00\x00\x00"


def test_whether_a_monitor_may_be_set_is_asked_again_when_it_would_act() -> None:
    bench = Bench()
    bench.ask("FF00")
    bench.memory.desk = bench.attended.desk = Desk(held := Held(bench.memory))  # type: ignore[arg-type]
    raw = struct.pack("<d", 0.004)
    bench.ask(struct.pack("<BxxBI", 0xF6, 0, number(bench, "tracking_limit")))
    bench.ask(b"\xf0\x06" + raw[:6])
    was = bench.memory.live()
    assert bench.node.mode == "INIT" and bench.tick(b"\xf0\x02" + raw[6:]) == []
    bench.run()
    assert bench.node.mode == "RUN"
    held.free = True
    assert bench.tick() == [b"\xfe\x23"] and (bench.memory.live() == was).all()


def test_a_session_in_real_time_is_repeated_from_its_record(tmp_path: Path) -> None:
    """The record has the notes of `heed`; whenever the checks were done, they act in the same ticks again."""
    bench = Bench().run()
    bench.attended.told = True
    bench.memory.desk = bench.attended.desk = Desk(Outside(bench.memory.elements))
    taken: list[tuple[int, list[Any]]] = []
    sent: list[tuple[int, list[int]]] = []
    rows, k0 = np.zeros((64, 2), np.int64), bench.node.k
    start = (bench.node.loop.z.copy(), bench.node.loop.s.copy())

    def tick(*commands: bytes) -> list[bytes]:
        frames = [*bench.ecu.tick(bench.sent).tolist(), *(list(row_of(MASTER, c)) for c in commands)]
        rows[: len(frames)] = np.array(frames, np.int64).reshape(-1, 2)
        n = bench.attended.heed(rows, len(frames))
        k = bench.node.k
        taken.extend((k - k0, row) for row in rows[:n].tolist())
        out = bench.attended.tick(rows, n)
        sent.extend((k - k0, row) for row in out.tolist())
        own = out[:, 0] & 0x7FF == SLAVE
        bench.sent = out[~own].copy()
        return [data_of(h, d) for h, d in out[own].tolist()]

    for command in ("FF 00", "F6 00 00 00 60 00 00 20", "F0 06 00 00 00 00 00 00", "F0 02 29 40", "EB 03 00 01"):
        answers = tick(bytes.fromhex(command))
        while not answers:
            time.sleep(0.001)
            answers = tick()
        assert answers == [b"\xff" + answers[0][1:]], command
    for _ in range(50):
        tick()
    assert bench.memory.ecu_page == 1

    other = Bench().run()
    assert (other.node.loop.z == start[0]).all() and (other.node.loop.s == start[1]).all()
    other.attended.told = True
    at, frames = np.array([t for t, _ in taken]), np.array([row for _, row in taken], np.int64)
    k, again = replay_attended(other.attended, at, frames, bench.node.k - k0)
    assert k.tolist() == [t for t, _ in sent] and again.tolist() == [row for _, row in sent]
    assert other.node.fingerprint() == bench.node.fingerprint() and (other.memory.live() == bench.memory.live()).all()


def test_a_flood_is_bounded() -> None:
    bench = Bench()
    bench.ask("FF00")
    frames = np.array([row_of(MASTER, b"\xf5\xff")] * 2000, np.int64)
    for _ in range(20):
        bench.attended.tick(frames)
    (service,) = bench.attended.services
    assert len(service._in) <= 256 and len(service._out) <= 320 and service.dropped > 30_000  # type: ignore[attr-defined]


def test_random_commands_leave_the_limits_alone() -> None:
    bench = Bench().run()
    bench.ask("FF00")
    rng = np.random.default_rng(7)
    for k in range(3000):
        command = rng.integers(0, 256, rng.integers(1, 9), dtype=np.uint8)
        if k % 2:
            command[0] = rng.choice(list(bench.slave._commands))
            if len(command) == 8 and k % 4 == 1:
                command[4:] = np.frombuffer(struct.pack("<I", CALIBRATION + 8 * int(rng.integers(0, 60))), np.uint8)
        for answer in bench.tick(command.tobytes()):
            assert answer[0] in (0xFF, 0xFE, 0xFD) or bench.slave.daq.running
        if not bench.slave.connected:
            bench.tick(b"\xff\x00")
        loop = bench.node.loop
        assert abs(loop.given.i_cmd) <= loop.calibration.scalars.current_limit <= 0.04
        assert bench.node.mode in MODES


@pytest.mark.slow
def test_two_tools_read_the_a2l_file(tmp_path: Path) -> None:
    parser = pytest.importorskip("pya2l.parser")
    pytest.importorskip("pyxcp")
    bench = Bench()
    text = a2l_of(bench.memory, master=MASTER, slave=SLAVE)
    file = tmp_path / "vgv.a2l"
    file.write_text(text, encoding="utf-8")
    tool = Path(sys.executable).with_name("a2ltool")
    if not tool.exists():
        pytest.skip("a2ltool is not installed")
    done = subprocess.run([tool, "--strict", "--check", file], check=False, capture_output=True, text=True)
    assert done.returncode == 0 and "No problems found" in done.stdout + done.stderr, done.stderr
    with parser.A2lParser() as a2l:
        tree = a2l.tree_from_a2l(text.encode())
    module = tree.PROJECT.MODULE[0]
    assert len(module.MEASUREMENT) == len(bench.memory.signals)
    for c in module.CHARACTERISTIC:
        if c.Type == "VALUE":
            name = str(getattr(c.Name, "Value", c.Name))
            at = int(str(getattr(c.Address, "Value", c.Address)), 0)
            assert at == CALIBRATION + 8 * bench.memory.by_name()[name]


def test_the_a2l_file_comes_over_xcp_too() -> None:
    bench = Bench()
    bench.ask("FF00")
    n = struct.unpack("<I", bench.ask("FA 04")[4:])[0]
    got = b""
    while len(got) < n:
        want = min(255, n - len(got))
        part = bench.tick(bytes([0xF5, want]))
        while sum(len(p) - 1 for p in part) < want:
            part += bench.tick()
        got += b"".join(p[1:] for p in part)
    assert got.decode() == a2l_of(bench.memory, master=MASTER, slave=SLAVE)


# ---- pyxcp -----------------------------------------------------------------------------------------------------------


def application(**options: Any) -> Any:
    """pyxcp's settings for our identifiers; they must stand before its parts are made."""
    pytest.importorskip("pyxcp")
    from pyxcp.config import create_application_from_config, set_application

    app = create_application_from_config({}, log_level=logging.ERROR)
    app.transport.layer = "CAN"
    can = app.transport.can
    can.can_id_master, can.can_id_slave, can.max_dlc_required = MASTER, SLAVE, False
    for key, value in options.items():
        setattr(can, key, value)
    set_application(app)
    return app


def unlock_calibration(x: Any) -> None:
    """Open calibration with pyxcp, if it is not open already."""
    if seed := bytes(x.getSeed(0, 1).seed):
        x.unlock(len(seed), key_of("cal", seed))


def save_kp(x: Any, value: float) -> None:
    """Set kp as a master on classic CAN does, and let the working page be saved."""
    x.setMta(CALIBRATION + 8 * Memory(Node()).by_name()["kp"])
    raw = struct.pack("<d", value)
    x.download(raw[:6])
    x.download(raw[6:])
    x.setSegmentMode(1, 0)
    x.setRequest(1, 0)


@pytest.mark.slow
@pytest.mark.parametrize("seconds", [6, pytest.param(60, marks=pytest.mark.slow)])
def test_pyxcp_records_at_1_ms_bit_for_bit(seconds: int) -> None:
    pytest.importorskip("pyxcp")
    app = application()
    from pyxcp.daq_stim import DaqList, DaqOnlinePolicy
    from pyxcp.master import Master

    from tests.xcp_bus import Lockstep

    names = ("x_servo", "i_cmd", "x_meas")
    address = {name: 0x12000000 + 8 * STATE.index(name) for name in names}
    halves = [(f"{n}_{h}", address[n] + 4 * h, 0, "U32") for n in names for h in (0, 1)]
    samples: list[tuple[int, tuple[int, ...]]] = []

    class Keep(DaqOnlinePolicy):  # type: ignore[misc]
        def on_daq_list(self, daq_list: int, timestamp0: int, timestamp1: int, payload: list[int]) -> None:
            samples.append((timestamp1, tuple(payload)))

    bench = Bench().run(300)
    bus = Lockstep(bench.attended, bench.ecu)
    bus.sent = bench.sent
    daq = Keep([DaqList(name="fast", event_num=0, stim=False, enable_timestamps=True, measurements=halves, priority=0,
                        prescaler=1)])  # fmt: skip
    with Master("can", config=app, policy=daq, transport_layer_interface=bus) as x:
        x.connect()
        daq.setup()
        daq.start()
        first = bus.node.k
        while bus.node.k < first + 1000 * seconds + 1000:
            time.sleep(0.05)  # the listener's thread runs the ticks
        daq.stop()
        x.disconnect()
    assert len(samples) >= 1000 * seconds
    alone, ecu, sent = Node(seed=3), Ecu(n_dem=70.0), NOTHING
    rows = [STATE.index(n) for n in names]
    want = []
    for _ in range(bus.node.k):
        sent = alone.tick(ecu.tick(sent)).copy()
        want.append(alone.loop.z[rows].tobytes())
    order = [h[0] for h in daq.daq_lists[0].headers]
    columns = [order.index(h[0]) for h in halves]
    start = next(k for k, w in enumerate(want) if _same(samples[0][1], columns, w))
    for i, (at, payload) in enumerate(samples[: 1000 * seconds]):
        assert at == i * 1_000_000, "a sample is lost"
        assert _same(payload, columns, want[start + i]), i


def _same(payload: tuple[int, ...], columns: list[int], want: bytes) -> bool:
    return np.array([payload[c] for c in columns], np.uint32).tobytes() == want


def test_pyxcp_calibrates_the_installed_command_on_the_embedded_bus(tmp_path: Path) -> None:
    pytest.importorskip("pyxcp")
    app = application(interface="vaneloop", channel=f"xcp{os.getpid()}")
    from pyxcp.master import Master

    channel = f"xcp{os.getpid()}"
    with (
        installed_run("--bus", f"local:{channel}", "--xcp", "--xcp-save", str(tmp_path / "tuned"), "--duration", "120"),
        Master("can", config=app) as x,
    ):
        x.connect()
        unlock_calibration(x)
        x.setMta(CALIBRATION + 8 * Memory(Node()).by_name()["kp"])
        assert struct.unpack("<d", x.upload(8))[0] == 16.0
        save_kp(x, 11.0)
        x.disconnect()
    assert load_calibration(tmp_path / "tuned" / "calibration.toml").scalars.kp == 11.0


def test_the_master_of_the_workbench_reads_changes_and_says_why_not() -> None:
    bench, tool = Bench().run(20), master.Master()
    n = len(bench.memory.elements)
    kp = bench.memory.by_name()["kp"]
    jobs = {
        1: [master.CONNECT, *master.read_page(1, n)],
        2: [master.CONNECT, *master.write_number(kp, 12.5)],
        3: [master.CONNECT, *master.write_number(kp, 1e9)],
        4: [master.CONNECT, *master.use_page(1), master.PAGE_IN_USE],
    }
    for number, commands in jobs.items():
        tool.ask(number, commands)
    silent = False
    for ms in range(9000):
        command = tool.send(ms)
        answers = bench.tick(*([command] if command is not None and not silent else []))
        for answer in answers:
            tool.hear(answer)
        if len(tool.done) == 4 and not silent:
            tool.ask(5, [master.CONNECT])
            silent = True
    done = dict(tool.done)
    assert (master.numbers_of(done[1][1:]) == bench.memory.pages[1]).all()  # type: ignore[arg-type]
    assert done[2][-1] == struct.pack("<d", 12.5) and done[3] == "out of range (XCP error 0x22)"
    assert done[4][-1][2] == bench.memory.ecu_page == 1  # type: ignore[index]
    assert done[5] == "no answer within 2 s"


def test_refusals_say_why() -> None:
    bench = Bench()
    with pytest.raises(Refusal, match=r"kp .* must be in"):
        bench.memory.change({bench.memory.by_name()["kp"]: -1.0})


def test_no_identifier_of_the_tools_is_in_the_dbc() -> None:
    cantools = pytest.importorskip("cantools")
    own = {m.frame_id for m in cantools.database.load_file(str(table_path("vgv.dbc"))).messages}
    assert not own & {MASTER, SLAVE, 0x7DF, 0x7E0, 0x7E8}


def test_scalars_of_a_controller_in_c_are_calibrated_in_its_own_memory(tmp_path: Path) -> None:
    if (gcc := shutil.which("gcc")) is None:
        pytest.skip("no gcc")
    source = ROOT / "examples" / "own_controller" / "follower.c"
    library = build(gcc, source, tmp_path / "follower.so", "-O2")
    node = Node(calibration=load_calibration()._replace(program=Program(library)))
    memory = Memory(node)
    own = own_scalars(node.loop.foreign)
    (name, told), *_ = own.items()
    i = memory.by_name()[f"own_{name}"]
    wanted = told["low"] + 0.25 * (told["high"] - told["low"])
    done(memory, memory.change({i: wanted}))
    assert own_scalars(node.loop.foreign)[name]["value"][0] == wanted == memory.live()[i]
    assert memory.read(0, CALIBRATION + 8 * i, 8) == struct.pack("<d", wanted)
    with pytest.raises(Refusal, match="must be in"):
        memory.change({i: told["high"] * 2.0 + 1.0})
    done(memory, memory.save(tmp_path / "tuned"))
    again = Program(library, str(tmp_path / "tuned" / "own_calibration.toml"))
    other = Node(calibration=load_calibration()._replace(program=again))
    assert own_scalars(other.loop.foreign)[name]["value"][0] == wanted
    assert f"own_{name}" in a2l_of(memory, master=MASTER, slave=SLAVE)


def test_scapy_reads_every_published_request_and_answer() -> None:
    """scapy's XCP layer takes each frame apart by the standard's tables, knows the answer as one to its request, and
    puts the same bytes together again.
    """
    pytest.importorskip("scapy", reason="scapy is not installed: pip install -e '.[test]'")
    from scapy.contrib.automotive.xcp.xcp import CTORequest, CTOResponse
    from scapy.packet import Raw

    fields: dict[str, dict[str, Any]] = {}
    refused: dict[str, str] = {}
    vectors = published()
    for request, answers in vectors:
        asked = CTORequest(bytes.fromhex(request))
        first = answers.split(",")[0].strip()
        told = CTOResponse(bytes.fromhex(first))
        name = asked.sprintf("%CTORequest.pid%")
        if asked.pid == 0xC5 or first == "FE 21":  # not a command; too short
            continue
        assert Raw not in asked and asked.build().hex(" ").upper() == request, request
        assert told.answers(asked), request
        assert told.build().hex(" ").upper() == first, request
        if told.packet_code == 0xFE:
            refused[request] = told.payload.sprintf("%NegativeResponse.error_code%")
        else:
            fields[name] = told.payload.fields
    assert len(fields) > 28
    connect, resolution = fields["CONNECT"], fields["GET_DAQ_RESOLUTION_INFO"]
    assert str(connect["resource"]) == "cal_pag+daq+stim" and (connect["max_cto"], connect["max_dto_le"]) == (8, 8)
    assert str(connect["comm_mode_basic"]) == "slave_block_mode+optional"
    assert "overload_event" in str(fields["GET_DAQ_PROCESSOR_INFO"]["daq_properties"])
    assert (resolution["max_odt_entry_size_daq"], resolution["timestamp_ticks"]) == (7, 1)
    assert fields["READ_DAQ"]["daq_element_address"] == 0x12000000
    assert set(refused.values()) == {
        *("ERR_CMD_SYNCH", "ERR_OUT_OF_RANGE", "ERR_WRITE_PROTECTED", "ERR_ACCESS_DENIED", "ERR_SEGMENT_NOT_VALID"),
        "ERR_SEQUENCE",
        "ERR_DAQ_ACTIVE",
    }
