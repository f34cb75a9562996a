"""Tools in every state: XCP slave and UDS server beside models of what the standards and the docs allow in each.

The models stand here again, from ASAM MCD-1 XCP, ISO 14229-1, docs/xcp.md and docs/uds.md: a command's answer, and what
it leaves behind. A third machine attacks both services on one node by the rules of `vaneloop fuzz --tool both`.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

pytest.importorskip("isotp")

from controller import Calibration, load_calibration
from controller.records import INPUTS, SCALARS
from hil.calibrate import Attended, Memory, Slave
from hil.calibrate.slave import key_of as xcp_key
from hil.calibrate.station import MASTER, XcpService, replay_attended, row_of
from hil.inject.fuzz_tools import _Target
from hil.inject.tool_rules import RULES, Tool, in_frames
from hil.loop.node import Ecu, Node
from hil.uds import Server
from hil.uds.server import key_of as uds_key
from hil.uds.station import REQUEST, UdsService
from plant import Plant, build_plant
from tests.conftest import examples

INIT, STANDBY, RUN, DEGRADED, FAIL_SAFE = range(5)
INPUT, STATES, CAL = 0x10000000, 0x12000000, 0x20000000
PAUSE, S3, RESETS, SWEEP = 10_000, 5000, 5000, 14_334  # ticks
waits = st.sampled_from((1, 50, 99, 100, 1000, 4999, 5000, 9999, 10_000))
modes = st.sampled_from((INIT, STANDBY, STANDBY, RUN, DEGRADED, FAIL_SAFE))


@cache
def shipped() -> tuple[Plant, Calibration]:
    """Machine and calibration as shipped; a node has its own copy of what may be changed."""
    return build_plant(), load_calibration()


# ---- XCP -------------------------------------------------------------------------------------------------------------


@dataclass
class Listed:
    """A measurement list as the model has it: entries of each table, their kind or None."""

    tables: list[list[str | None]] = field(default_factory=list)
    event: bool = False
    stim: bool = False
    selected: bool = False
    runs: bool = False

    @property
    def whole(self) -> bool:
        """Whether it may be started."""
        return self.event and bool(self.tables) and all(e for t in self.tables for e in t)


class XcpStates(RuleBasedStateMachine):
    """One slave with calibration, STIM and measurement locked."""

    @initialize(locked=st.sampled_from((("cal", "stim"), ("cal", "stim", "daq"), ())))
    def begin(self, locked: tuple[str, ...]) -> None:
        memory = Memory(Node(*shipped()))
        self.lockable = sum({"cal": 1, "daq": 4, "stim": 8}[n] for n in locked)
        self.s = Slave(memory, locked=locked)
        self.mode, self.k, self.wrong, self.until = INIT, 0, 0, 0
        self.connected = False
        self.fresh()
        self.before = memory.live()
        self.connect()

    def fresh(self) -> None:
        self.locked, self.seed, self.frozen, self.step = self.lockable, 0, False, 0
        self.lists: list[Listed] = []
        self.pointer: tuple[int, int, int] | None = None

    def ask(self, command: bytes) -> str:
        """The first answer: "FF", or the code of the error."""
        self.s.k = self.k
        out = self.s.command(command)
        desk = self.s.memory.desk
        desk.before(desk.k, desk.note())
        out += self.s.late()
        if not out:
            return ""
        return "FF" if out[0][0] == 0xFF else f"{out[0][1]:02X}"

    def expect(self, command: bytes, wanted: str, resource: int = 0) -> bool:
        """Ask, compare with the model; whether it was carried out."""
        if not self.connected:
            wanted = ""
        elif self.locked & resource:
            wanted = "25"
        found = self.ask(command)
        assert found == wanted, (command.hex(" "), found, wanted)
        return found == "FF"

    @property
    def running(self) -> bool:
        return any(of.runs for of in self.lists)

    @rule(n=waits)
    def wait(self, n: int) -> None:
        self.k += n

    @rule(mode=modes)
    def modes_change(self, mode: int) -> None:
        self.mode = mode
        self.s.memory.loop.given.mode = float(mode)

    @rule()
    def connect(self) -> None:
        self.connected = True
        self.expect(b"\xff\x00", "FF")

    @rule(at=st.integers(0, 1), stim=st.booleans())
    def a_whole_list_runs(self, at: int, stim: bool) -> None:
        """The way there in one go, as far as the locks let it."""
        self.connect()
        for resource in (4, 8):
            self.get_seed(resource)
            if self.seed:
                self.unlock(True, 0)
        self.free()
        self.lists_are_allocated(2)
        for each in (0, 1):
            self.tables_are_allocated(each, 1)
        self.entries_are_allocated(at, 0, 1)
        self.point(at, 0, 0)
        self.write_entry("n_dem")
        self.list_mode(at, 2 if stim else 16, 0)
        self.start(at, 1)

    @rule()
    def disconnect(self) -> None:
        if self.expect(b"\xfe", "FF"):
            self.connected = False
            self.fresh()

    @rule(resource=st.sampled_from((1, 4, 8, 2, 5)))
    def get_seed(self, resource: int) -> None:
        if self.wrong >= 3 and self.k >= self.until:
            self.wrong = 0
        wanted = "22" if resource not in (1, 4, 8) else "25" if self.locked & resource and self.wrong >= 3 else "FF"
        if self.expect(bytes([0xF8, 0, resource]), wanted) and self.locked & resource:
            self.seed = resource

    @rule(good=st.sampled_from((True, True, True, False)), cut=st.integers(0, 6))
    def unlock(self, good: bool, cut: int) -> None:
        if not self.seed or not self.connected:
            self.expect(b"\xf7\x06" + bytes(6), "29")
            return
        resource, self.seed = self.seed, 0
        pending = self.s._seed
        assert pending is not None and pending[0] == resource
        key = xcp_key({1: "cal", 4: "daq", 8: "stim"}[resource], pending[1])
        if good:
            self.expect(b"\xf7\x06" + key, "FF")
            self.locked &= ~resource
            self.wrong = 0
        else:
            self.expect(b"\xf7\x06" + (key[:cut] if cut < 6 else bytes(6)), "25")
            self.wrong += 1
            if self.wrong >= 3:
                self.until = self.k + PAUSE
            self.connected = False
            self.fresh()

    @rule()
    def free(self) -> None:
        if self.expect(b"\xd6", "FF", 4):
            self.lists, self.step, self.pointer = [], 1, None

    @rule(n=st.sampled_from((1, 2, 2, 16, 17)))
    def lists_are_allocated(self, n: int) -> None:
        wanted = "11" if self.running else "29" if self.step != 1 else "30" if n > 16 else "FF"
        if self.expect(struct.pack("<BxH", 0xD5, n), wanted, 4):
            self.lists, self.step = [Listed() for _ in range(n)], 2

    @rule(at=st.integers(0, 2), n=st.sampled_from((1, 1, 2, 65)))
    def tables_are_allocated(self, at: int, n: int) -> None:
        full = sum(len(of.tables) for of in self.lists) + n > 64
        wanted = (
            "11" if self.running else "29" if self.step not in (2, 3) else "22" if at >= len(self.lists)
            else "30" if full else "FF"
        )  # fmt: skip
        if self.expect(struct.pack("<BxHB", 0xD4, at, n), wanted, 4):
            self.lists[at].tables += [[] for _ in range(n)]
            self.step = 3

    @rule(at=st.integers(0, 2), table=st.integers(0, 2), n=st.sampled_from((1, 1, 2, 8)))
    def entries_are_allocated(self, at: int, table: int, n: int) -> None:
        there = at < len(self.lists) and table < len(self.lists[at].tables)
        wanted = (
            "11" if self.running else "29" if self.step not in (3, 4) else "22" if not there
            else "30" if len(self.lists[at].tables[table]) + n > 7 else "FF"
        )  # fmt: skip
        if self.expect(struct.pack("<BxHBB", 0xD3, at, table, n), wanted, 4):
            self.lists[at].tables[table] += [None] * n
            self.step = 4

    @rule(at=st.integers(0, 2), table=st.integers(0, 2), entry=st.integers(0, 2))
    def point(self, at: int, table: int, entry: int) -> None:
        wanted = (
            "22" if at >= len(self.lists) else "11" if self.lists[at].runs
            else "22" if table >= len(self.lists[at].tables) or entry >= len(self.lists[at].tables[table]) else "FF"
        )  # fmt: skip
        if self.expect(struct.pack("<BxHBB", 0xE2, at, table, entry), wanted, 4):
            self.pointer = at, table, entry

    @rule(kind=st.sampled_from(("n_dem", "n_dem", "pause", "state", "nowhere")))
    def write_entry(self, kind: str) -> None:
        address = {"n_dem": INPUT, "pause": INPUT + 4 * INPUTS.index("pause"), "state": STATES}.get(kind, 0)
        wanted = "29"
        if self.pointer is not None:
            at, table, entry = self.pointer
            of = self.lists[at]
            entries = of.tables[table] if table < len(of.tables) else []
            others = sum(4 for i, e in enumerate(entries) if e and i != entry)
            wanted = (
                "11" if of.runs else "22" if entry >= len(entries) or others or kind == "nowhere"
                else "23" if of.stim and kind == "pause" else "22" if of.stim and kind == "state" else "FF"
            )  # fmt: skip
        if self.expect(struct.pack("<BBBBI", 0xE1, 0xFF, 4, 1, address), wanted, 4) and self.pointer is not None:
            entries[entry] = kind
            self.pointer = at, table, entry + 1

    @rule(at=st.integers(0, 2), mode=st.sampled_from((2, 2, 16, 18)), event=st.sampled_from((0, 1, 2)))
    def list_mode(self, at: int, mode: int, event: int) -> None:
        kinds = {e for t in self.lists[at].tables for e in t if e} if at < len(self.lists) else set()
        wanted = (
            "25" if mode == 2 and self.locked & 8 else "22" if at >= len(self.lists) else "11" if self.lists[at].runs
            else "27" if mode == 18 else "22" if event == 2
            else "FF" if mode == 16 or kinds <= {"n_dem"} else "either"
        )  # fmt: skip
        command = struct.pack("<BBHHBB", 0xE0, mode, at, event, 1, 0)
        if wanted == "either" and self.connected and not self.locked & 4:
            assert self.ask(command) in ("22", "23")
        elif self.expect(command, wanted, 4):
            self.lists[at].event, self.lists[at].stim = True, mode == 2

    @rule(at=st.integers(0, 2), what=st.sampled_from((0, 1, 1, 2, 3)))
    def start(self, at: int, what: int) -> None:
        there = at < len(self.lists)
        wanted = (
            "22" if not there else "27" if what == 3 else "2A" if what in (1, 2) and not self.lists[at].whole else "FF"
        )
        if self.expect(struct.pack("<BBH", 0xDE, what, at), wanted, 4):
            of = self.lists[at]
            if what == 0:
                of.runs = of.selected = False
            of.runs |= what == 1
            of.selected |= what == 2

    @rule(what=st.integers(0, 3))
    def start_selected(self, what: int) -> None:
        chosen = [of for of in self.lists if what == 0 or of.selected]
        wanted = "27" if what == 3 else "2A" if what == 1 and not all(of.whole for of in chosen) else "FF"
        if self.expect(bytes([0xDD, what]), wanted, 4):
            for of in chosen:
                of.selected, of.runs = False, what == 1

    @rule(at=st.integers(0, 2))
    def clear(self, at: int) -> None:
        if self.expect(struct.pack("<BxH", 0xE3, at), "FF" if at < len(self.lists) else "22", 4):
            of = self.lists[at]
            of.tables, of.runs, of.selected = [[None] * len(t) for t in of.tables], False, False

    @rule(pid=st.integers(0, 5), value=st.floats(width=32), short=st.booleans())
    def give(self, pid: int, value: float, short: bool) -> None:
        assert self.ask(bytes([pid]) + struct.pack("<f", value)[: 2 if short else 4]) == ""

    @rule(on=st.sampled_from((0, 1, 2)))
    def freeze(self, on: int) -> None:
        if self.expect(bytes([0xE6, on, 0]), "27" if on == 2 else "FF", 1):
            self.frozen = on == 1

    @rule(name=st.sampled_from(("kp", "tracking_limit")), share=st.floats(0.5, 0.99))
    def calibrate(self, name: str, share: float) -> None:
        value = share * float(self.s.memory.pages[1][SCALARS.index(name)])
        raw = struct.pack("<f", value)
        self.expect(struct.pack("<BxxBI", 0xF6, 1, CAL + 4 * SCALARS.index(name)), "FF")
        closed = name != "kp" and self.mode not in (INIT, STANDBY)
        changes = np.float32(self.s.memory.live()[SCALARS.index(name)]) != np.float32(value)
        if self.expect(b"\xf0\x04" + raw, "23" if closed and changes else "FF", 1):
            self.before = self.s.memory.live()
            assert self.before[SCALARS.index(name)] == np.float32(value)

    @invariant()
    def what_holds(self) -> None:
        s = self.s
        assert s.connected == self.connected and s._locked == self.locked and s._freeze == self.frozen
        assert (s.memory.live() == self.before).all(), "nothing else is changed"
        assert len(s.daq.lists) == len(self.lists) <= 16 and sum(len(of.tables) for of in s.daq.lists) <= 64
        assert [(of.running, of.selected) for of in s.daq.lists] == [(of.runs, of.selected) for of in self.lists]
        assert not s.daq.stimulus.given or any(of.stim and of.runs for of in self.lists)
        assert np.isfinite(list(s.daq.stimulus.given.values())).all() and len(s.sample(self.k)) <= 32


# ---- UDS -------------------------------------------------------------------------------------------------------------


class UdsStates(RuleBasedStateMachine):
    """One server; the mode of its firmware is what the test says."""

    @initialize()
    def begin(self) -> None:
        self.s = Server(Memory(Node(*shipped())))
        self.live = self.s.memory.live()
        self.k = self.last = self.again = self.wrong = self.until = 0
        self.session, self.mode = 1, INIT
        self.results: set[int] = set()
        self.texts: dict[str, str] = {}
        self.close()

    def close(self) -> None:
        self.open = self.seed = self.quiet = self.off = False
        self.file: tuple[int, int, int] | None = None  # bytes announced, bytes that came, blocks
        self.stop()

    def stop(self) -> None:
        if getattr(self, "routine", 0):
            self.results.add(self.routine)
        self.routine = self.since = 0

    @property
    def idle(self) -> bool:
        return self.mode in (INIT, STANDBY) and not self.routine

    def expect(self, request: bytes, wanted: str, sessions: tuple[int, ...] = (1, 2, 3), key: bool = False) -> bool:
        """Ask, compare with the model; whether it was carried out. ``key``: it needs the key."""
        if self.session not in sessions:
            wanted = "7F"
        elif key and not self.open:
            wanted = "33"
        (found,) = (a.hex().upper() for a in self.s.request(self.k, request))
        self.last = self.k
        assert (found[4:] if found[:2] == "7F" else "") == wanted, (request.hex(" "), found, wanted)
        return wanted == ""

    @rule(n=waits)
    def wait(self, n: int) -> None:
        self.k += n
        self.s.before(self.k)
        if self.session != 1 and self.k - self.last >= S3:
            self.session = 1
            self.close()
        self.s.after(self.k)
        if self.routine and self.k - self.since >= SWEEP:
            self.stop()

    @rule(mode=modes)
    def modes_change(self, mode: int) -> None:
        self.mode = mode
        self.s.memory.loop.given.mode = float(mode)
        self.s.after(self.k)
        self.quiet &= mode in (INIT, STANDBY)

    @rule(session=st.sampled_from((1, 2, 3, 3, 4)))
    def control(self, session: int) -> None:
        wanted = "12" if session == 4 else "22" if session == 2 and not self.idle else ""
        if self.expect(bytes([0x10, session]), wanted):
            self.session = session
            self.close()

    @rule(session=st.sampled_from((2, 3, 3)))
    def open_a_session(self, session: int) -> None:
        """The way there in one go, as far as the pause lets it."""
        self.control(session)
        self.get_seed()
        if self.seed:
            self.key(True)

    @rule(request=st.sampled_from(("3E 00", "22 F1 86", "19 0A", "22 20 00 20 07")))
    def read(self, request: str) -> None:
        assert self.expect(bytes.fromhex(request), "")

    @rule()
    def get_seed(self) -> None:
        if self.wrong >= 3 and self.k >= self.until:
            self.wrong = 0
        if self.expect(b"\x27\x01", "37" if self.wrong >= 3 else "", (2, 3)) and not self.open:
            self.seed = True

    @rule(good=st.sampled_from((True, True, True, False)))
    def key(self, good: bool) -> None:
        if not self.seed:
            self.expect(b"\x27\x02" + bytes(8), "24", (2, 3))
            return
        assert self.s._seed is not None
        right, self.seed = uds_key(self.s._seed), False
        self.open = good
        if not good:
            self.wrong += 1
            self.until = self.k + PAUSE if self.wrong >= 3 else 0
        wanted = "" if good else "36" if self.wrong >= 3 else "35"
        self.expect(b"\x27\x02" + (right if good else bytes(8)), wanted, (2, 3))
        if good:
            self.wrong = 0

    @rule(on=st.booleans())
    def silence(self, on: bool) -> None:
        if self.expect(bytes([0x28, on, 1]), "22" if on and not self.idle else "", (3,), key=True):
            self.quiet = on

    @rule(off=st.booleans())
    def entries(self, off: bool) -> None:
        if self.expect(bytes([0x85, 1 + off]), "", (3,), key=True):
            self.off = off

    @rule()
    def clear(self) -> None:
        self.expect(b"\x14\xff\xff\xff", "", (2, 3), key=True)

    @rule(how=st.sampled_from((1, 3)))
    def reset(self, how: int) -> None:
        if self.expect(bytes([0x11, how]), "22" if not self.idle or self.k < self.again else "", (2, 3), key=True):
            self.again = self.k + RESETS
            assert self.s.before(self.k) == []
            self.session = 1
            self.close()

    @rule(what=st.integers(1, 3), which=st.sampled_from((1, 2, 3)))
    def routines(self, what: int, which: int) -> None:
        mine = self.routine == which
        if what == 1:
            wanted = "24" if self.routine else "" if self.mode == STANDBY else "22"
        elif what == 2:
            wanted = "" if mine else "24"
        else:
            wanted = "" if mine or which in self.results else "24"
        if self.expect(bytes([0x31, what, 2, which]), wanted, (3,), key=True):
            if what == 1 and which == 3:
                self.results.add(3)
            elif what == 1:
                self.routine, self.since = which, self.k
            elif what == 2:
                self.stop()

    @rule(text=st.text("ABC", min_size=1, max_size=9))
    def write(self, text: str) -> None:
        if self.expect(b"\x2e\xf1\x99" + text.encode(), "13" if len(text) > 8 else "", (3,), key=True):
            self.texts["F199"] = text

    @rule(n=st.sampled_from((0, 4, 300, 65_537)))
    def announce(self, n: int) -> None:
        wanted = "22" if not self.idle else "70" if not 1 <= n <= 65_536 else ""
        if self.expect(b"\x34\x00\x44" + struct.pack(">II", 0, n), wanted, (2,), key=True):
            self.file = n, 0, 0

    @rule(n=st.sampled_from((1, 2, 254, 255)), step=st.sampled_from((0, 1, 1, 2)))
    def block(self, n: int, step: int) -> None:
        announced, came, blocks = self.file or (0, 0, 0)
        again = step == 0 and came > 0
        wanted = (
            "24" if self.file is None else "13" if n > 254 else "" if again else "73" if step != 1
            else "71" if came + n > announced else ""
        )  # fmt: skip
        if self.expect(bytes([0x36, blocks + step & 0xFF]) + bytes(n), wanted, (2,)) and not again:
            self.file = announced, came + n, blocks + 1

    @precondition(lambda self: self.file is None or self.file[0] != self.file[1])
    @rule()
    def end_too_early(self) -> None:
        self.expect(b"\x37", "24", (2,))

    @invariant()
    def what_holds(self) -> None:
        s = self.s
        assert s.session == self.session and s._open == self.open and s.trouble.on != self.off
        assert s.silent == self.quiet and (not s.silent or self.mode in (INIT, STANDBY)), "silence in a closed loop"
        assert (s.sweep is not None) == bool(self.routine) and s.trouble.texts == self.texts
        assert (s.memory.live() == self.live).all() and len(s._file or b"") <= 65_536


XcpStates.TestCase.settings = settings(max_examples=examples(300), stateful_step_count=40, deadline=None)
UdsStates.TestCase.settings = settings(max_examples=examples(300), stateful_step_count=40, deadline=None)
test_xcp_answers_in_every_state_as_its_model = XcpStates.TestCase
test_uds_answers_in_every_state_as_its_model = UdsStates.TestCase


# ---- both on one node ------------------------------------------------------------------------------------------------


class BothStates(RuleBasedStateMachine):
    """Both services attacked by rules, tick by tick; what must hold of every tick `_Target` checks."""

    @initialize(keys=st.booleans(), request=st.integers(0, 1))
    def begin(self, keys: bool, request: int) -> None:
        self.target = _Target("both", 0 if keys else 1, request, np.array([np.inf, np.inf]))
        self.target.tick([(MASTER, b"\xff\x00"), (REQUEST, b"\x02\x10\x03")])

    @rule(which=st.sampled_from(list(RULES)), number=st.integers(0, 2**32 - 1))
    def attack(self, which: Any, number: int) -> None:
        t = self.target
        rng = np.random.default_rng(number)
        t.tick(which(Tool(rng, t.slave, t.server, uds_key, t.keys)))

    @rule(n=st.sampled_from((1, 20, 200)))
    def wait(self, n: int) -> None:
        for _ in range(n):
            self.target.tick([])

    @rule(request=st.integers(0, 1), away=st.sampled_from((0, 0, 30, 1200)))
    def the_ecu_asks(self, request: int, away: int) -> None:
        self.target.ecu.set_demand(70.0, mode_request=request)
        self.target.away = away

    def teardown(self) -> None:
        t = self.target
        while t.busy:
            t.tick([])
        t.flash()
        self.the_ecu_asks(1, 0)
        for _ in range(8000):
            t.tick([])
            if t.node.mode == "RUN" and not t.given:
                return
        raise AssertionError(f"RUN is not back: {t.node.mode}")


BothStates.TestCase.settings = settings(max_examples=examples(100) // 6, stateful_step_count=40, deadline=None)
test_both_services_on_one_node_leave_the_controller_alone = pytest.mark.slow(BothStates.TestCase)


# ---- a record --------------------------------------------------------------------------------------------------------


def attended(**options: Any) -> tuple[Attended, Slave, Server]:
    """A node with both services, as ``vaneloop run --xcp --uds`` has it."""
    memory = Memory(Node(*shipped()))
    slave, server = Slave(memory, locked=("cal", "stim"), **options), Server(memory, **options)
    return Attended(memory.node, XcpService(slave), UdsService(server), told=True), slave, server


def test_a_recorded_session_with_keys_is_repeated_with_the_seeds_that_it_had() -> None:
    node, slave, server = attended()
    ecu, ours = Ecu(n_dem=70.0), np.zeros((0, 2), np.int64)
    ecu.set_demand(70.0, mode_request=0)
    rows = np.zeros((140, 2), np.int64)
    taken: list[tuple[int, list[int]]] = []
    sent: list[tuple[int, list[int]]] = []
    rng = np.random.default_rng(2)
    opened = set()
    for k in range(1200):
        tool: list[tuple[int, bytes]] = []
        if k == 5:
            tool = [
                (MASTER, b"\xff\x00"),
                (MASTER, b"\xf8\0\1"),
                (REQUEST, b"\x02\x10\x03"),
                (REQUEST, b"\x02\x27\x01"),
            ]
        elif k == 20:
            assert slave._seed is not None and server._seed is not None
            tool = [(MASTER, b"\xf7\x06" + xcp_key("cal", slave._seed[1]))]
            tool += in_frames(REQUEST, b"\x27\x02" + uds_key(server._seed))
        elif k > 40 and k % 3 == 0:
            some = list(RULES)[int(rng.integers(len(RULES)))]
            tool = some(Tool(rng, slave, server, uds_key, True))[:60]
        opened |= {("xcp", not slave._locked & 1), ("uds", server._open)}
        frames = [*ecu.tick(ours).tolist(), *(list(row_of(*f)) for f in tool)]
        rows[: len(frames)] = np.array(frames, np.int64).reshape(-1, 2)
        n = node.heed(rows, len(frames))
        taken += [(k, row) for row in rows[:n].tolist()]
        out = node.tick(rows, n)
        sent += [(k, row) for row in out.tolist()]
        ours = out[out[:, 0] & 0x7FF < 0x100].copy()
    assert opened >= {("xcp", True), ("uds", True)}
    other, *_ = attended(seed=3)  # it has a number of its own, until the note comes
    at, received = np.array([k for k, _ in taken]), np.array([row for _, row in taken], np.int64)
    again_at, again = replay_attended(other, at, received, 1200)
    assert again_at.tolist() == [k for k, _ in sent] and again.tolist() == [row for _, row in sent]
    assert other.node.fingerprint() == node.node.fingerprint() and other.lost == node.lost
    assert any(n for counts in other.lost.values() for n in counts.values()), "something was dropped"
