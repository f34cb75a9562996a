"""The embedded bus packet by packet, as the texts of `hil.bus.broker` and `hil.bus.local_bus` have it.

The broker runs in this process: where it would wait, the test's next step is done, so nothing here waits for a clock or
another process. A participant is tried against a broker of the test's own. The bytes are laid out here once more by
`struct`, as linux/can.h has them, and all numbers stand here again.
"""

from __future__ import annotations

import contextlib
import errno
import io
import itertools
import logging
import os
import select
import selectors
import socket
import struct
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import can
import numpy as np
import pytest

from hil.bus import broker, local_bus
from hil.bus.local_bus import LocalBus

GREETING = b"vaneloop bus 1"
WIDE = struct.Struct("<QqIBBBB64s")  # number, time (ns), then struct canfd_frame: id, len, flags, two spare bytes, data
ERROR, REMOTE, EXTENDED = 1 << 29, 1 << 30, 1 << 31  # CAN_ERR_FLAG, CAN_RTR_FLAG, CAN_EFF_FLAG
BRS, ESI, FDF = 1, 2, 4  # CANFD_BRS, CANFD_ESI, CANFD_FDF
PATIENCE = 60.0  # s for what another thread does; nothing here judges it
_numbers = itertools.count()


def new_name() -> str:
    """A bus that nobody else has."""
    return f"spec-{os.getpid()}-{next(_numbers)}"


def classic(ident: int, data: bytes = b"", length: int | None = None) -> bytes:
    """``struct can_frame``: id, len, three spare bytes, data."""
    return struct.pack("<IBxxx8s", ident, len(data) if length is None else length, data)


def fd_frame(ident: int, data: bytes, flags: int = FDF, spare: tuple[int, int] = (0, 0)) -> bytes:
    """``struct canfd_frame``."""
    return struct.pack("<IBBBB64s", ident, len(data), flags, *spare, data)


# ---- the broker's parts ----------------------------------------------------------------------------------------------


def test_the_address_is_abstract_and_of_this_user_and_bus(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "getuid", lambda: 1234)
    assert broker.address("rig.7") == "\0vaneloop-1234-rig.7"


@pytest.mark.parametrize(("uid", "let_in"), [(1000, True), (0, True), (1, False), (999, False), (1001, False)])
def test_only_the_same_user_and_root_are_let_in(uid: int, let_in: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def credentials(*which: int) -> bytes:  # struct ucred: process, user, group
        asked.append(which)
        return struct.pack("3i", 1, uid, 1)

    monkeypatch.setattr(os, "getuid", lambda: 1000)
    assert broker.same_user(SimpleNamespace(getsockopt=credentials)) is let_in  # type: ignore[arg-type]
    assert asked == [(socket.SOL_SOCKET, socket.SO_PEERCRED, 12)]


def test_the_other_end_of_a_socket_of_this_process_is_the_same_user() -> None:
    a, b = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with a, b:
        assert broker.same_user(a) and broker.same_user(b)


@pytest.mark.parametrize(
    ("lost", "told"),
    [(1, 1), (0x12345678, 0x12345678), (0xFFFFFFFF, 0xFFFFFFFF), (0x100000000, 0xFFFFFFFF), (1 << 40, 0xFFFFFFFF)],
)
def test_loss_is_an_error_frame_of_a_receive_overflow_with_the_number(lost: int, told: int) -> None:
    # CAN_ERR_CRTL (0x004), data[1] = CAN_ERR_CRTL_RX_OVERFLOW (0x01); the first spare byte says that it is the broker's
    data = bytes([0, 1, 0, 0]) + told.to_bytes(4, "little")
    assert broker.loss(lost) == fd_frame(ERROR | 0x004, data, 0, (2, 0))


class Taker:
    """A socket that takes ``room`` packets and then no more until it is given room."""

    def __init__(self, room: int):
        self.room = room
        self.got: list[bytes] = []

    def send(self, packet: bytes) -> None:
        if not self.room:
            raise BlockingIOError
        self.room -= 1
        self.got.append(packet)


def packets(n: int) -> list[bytes]:
    return [WIDE.pack(k, 1000 + k, 0x100 + k % 512, 4, 0, 0, 0, k.to_bytes(4, "little")) for k in range(1, n + 1)]


def member(room: int) -> tuple[Any, Taker]:
    taker = Taker(room)
    return broker._Member(taker), taker  # type: ignore[arg-type]


def test_a_new_participant_has_not_greeted_wants_nothing_of_its_own_and_has_no_priority() -> None:
    m, taker = member(0)
    assert (m.connection, m.greeted, m.own, m.priority, list(m.waiting)) == (taker, False, False, 0, [])


def test_a_packet_is_handed_over_at_once_and_not_kept() -> None:
    m, taker = member(2)
    sent = packets(2)
    for p in sent:
        m.give(p)
    assert taker.got == sent and not m.waiting


def test_what_is_not_taken_waits_and_nothing_overtakes_it() -> None:
    m, taker = member(1)
    sent = packets(4)
    m.give(sent[0])
    m.give(sent[1])
    taker.room = 1
    m.give(sent[2])  # there is room now, but another waits before it
    assert taker.got == sent[:1] and list(m.waiting) == sent[1:3]
    m.catch_up()
    assert taker.got == sent[:2] and list(m.waiting) == sent[2:3]
    taker.room = 5
    m.catch_up()
    m.give(sent[3])
    assert taker.got == sent and not m.waiting


def test_8192_frames_are_kept_and_those_beyond_are_one_error_frame_in_their_place() -> None:
    m, taker = member(0)
    sent = packets(8192 + 4)
    for p in sent[:8192]:
        m.give(p)
    assert list(m.waiting) == sent[:8192]
    for p in sent[8192:8195]:
        m.give(p)
    assert len(m.waiting) == 8193 and list(m.waiting)[:8192] == sent[:8192]
    taker.room = 1
    m.catch_up()
    m.give(sent[8195])  # 8191 packets and the word on the loss wait: the queue is full still
    taker.room = 9000
    m.catch_up()
    assert taker.got[:8192] == sent[:8192] and not m.waiting
    data = bytes([0, 1, 0, 0]) + (4).to_bytes(4, "little")
    # its number and its time are those of the first that is gone
    assert taker.got[8192:] == [struct.pack("<Qq", 8193, 1000 + 8193) + fd_frame(ERROR | 4, data, 0, (2, 0))]


def test_a_second_loss_is_told_in_a_place_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(broker, "BACKLOG", 3)
    m, taker = member(0)
    sent = packets(9)
    for p in sent[:4]:  # three wait, one is gone
        m.give(p)
    taker.room = 2
    m.catch_up()
    for p in sent[4:7]:  # one more waits, then two are gone
        m.give(p)
    taker.room = 20
    m.catch_up()
    m.give(sent[7])
    assert [WIDE.unpack(p)[0] for p in taker.got] == [1, 2, 3, 4, 5, 6, 8]
    assert [p[:88] for p in taker.got[:3]] == sent[:3]
    words = [WIDE.unpack(p) for p in taker.got]
    assert [(w[2], w[5], w[7][4]) for w in words if w[2] & ERROR] == [(ERROR | 4, 2, 1), (ERROR | 4, 2, 2)]
    assert taker.got[4] == sent[4] and taker.got[6] == sent[7]


def test_a_participant_that_is_gone_is_an_error_of_the_system() -> None:
    def gone(packet: bytes) -> None:
        raise BrokenPipeError(errno.EPIPE, "gone")

    m = broker._Member(SimpleNamespace(send=gone))  # type: ignore[arg-type]
    with pytest.raises(BrokenPipeError):
        m.give(b"x")
    m.waiting.append(b"y")
    with pytest.raises(BrokenPipeError):
        m.catch_up()


@pytest.mark.parametrize(
    ("priorities", "policy", "highest"),
    [([], os.SCHED_OTHER, 0), ([0, 0], os.SCHED_OTHER, 0), ([0, 1], os.SCHED_FIFO, 1), ([7, 99, 3], os.SCHED_FIFO, 99)],
)
def test_the_broker_takes_the_highest_priority(
    priorities: list[int], policy: int, highest: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []
    monkeypatch.setattr(os, "sched_setscheduler", lambda pid, p, param: asked.append((pid, p, param.sched_priority)))
    broker.schedule(iter(priorities))
    assert asked == [(0, policy, highest)]


@pytest.mark.parametrize("says", [PermissionError, AttributeError])
def test_a_user_without_the_right_stays_at_the_priority_it_has(says: type, monkeypatch: pytest.MonkeyPatch) -> None:
    def no(*_: object) -> None:
        raise says

    monkeypatch.setattr(os, "sched_setscheduler", no)
    broker.schedule([5])


# ---- the broker with its participants --------------------------------------------------------------------------------

IDLE = object()  # a step after which the broker's wait ends without anything having come


class Over(Exception):
    """The test has no more steps."""


class Turns(selectors.EpollSelector):
    """The selector of a broker that does the next step of the test where it would wait."""

    def __init__(self, steps: Iterator[Any]):
        super().__init__()
        self.steps = steps
        self.waits: list[float | None] = []
        self.turns = 0

    def select(self, timeout: float | None = None) -> Any:
        """Return what can be done; do steps until something can."""
        self.waits.append(timeout)
        self.turns += 1
        assert self.turns < 2000, "the broker turns without doing anything"
        while not (events := super().select(0)):
            self.turns = 0
            step = next(self.steps, Over)
            if step is Over:
                raise Over
            if step is IDLE:
                return []
        return events


class Spy(socket.socket):
    """A socket that keeps which options were set, and cannot be read where the test wants it."""

    broken = False

    def recv(self, *which: Any) -> bytes:
        if self.broken:
            raise OSError(errno.EIO, "Input/output error")
        return super().recv(*which)

    def setsockopt(self, *which: Any) -> None:
        vars(self).setdefault("options", []).append(which)
        super().setsockopt(*which)


class Listener(socket.socket):
    """Whose connections are spied on, and which fails where the test wants it."""

    fails = 0

    def accept(self) -> tuple[Any, Any]:
        if self.fails:
            self.fails -= 1
            raise OSError(errno.EMFILE, "Too many open files")
        fd, address = self._accept()  # type: ignore[attr-defined]
        vars(self).setdefault("connections", []).append(Spy(fileno=fd))
        return self.connections[-1], address  # type: ignore[attr-defined]


class Stand:
    """A broker in this process, with a clock and a scheduler of the test's own."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch):
        self.name = new_name()
        self.listener = Listener(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.listener.bind(broker.address(self.name))
        self.listener.listen(64)
        self.listener.setblocking(False)
        self.clock, self.ns = 500.0, 10**18
        self.scheduled: list[tuple[int, int]] = []
        self.clients: list[socket.socket] = []
        self.selector: Turns
        monkeypatch.setattr(broker, "time", SimpleNamespace(monotonic=lambda: self.clock, time_ns=lambda: self.ns))
        monkeypatch.setattr(
            os, "sched_setscheduler", lambda _pid, policy, param: self.scheduled.append((policy, param.sched_priority))
        )
        self.monkeypatch = monkeypatch

    def run(self, steps: Callable[[], Iterator[Any]]) -> None:
        """Serve until the steps are over or the broker ends."""

        def made() -> Turns:
            self.selector = Turns(steps())
            return self.selector

        self.monkeypatch.setattr(broker, "selectors", SimpleNamespace(**{**vars(selectors), "DefaultSelector": made}))
        broker.serve(self.listener)

    def all(self, steps: Callable[[], Iterator[Any]]) -> None:
        """Serve until the steps are over, all of them."""
        with pytest.raises(Over):
            self.run(steps)

    def connect(self) -> socket.socket:
        """One more participant, which has not greeted."""
        client = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.clients.append(client)
        client.setblocking(False)
        client.connect(broker.address(self.name))
        return client

    def join(self, greeting: int = 0) -> socket.socket:
        """One more, which has greeted with this byte; its answer comes after the next step."""
        client = self.connect()
        client.send(GREETING + bytes([greeting]))
        return client

    def close(self) -> None:
        """Close all sockets."""
        for s in (*self.clients, self.listener):
            s.close()


@pytest.fixture
def stand(monkeypatch: pytest.MonkeyPatch) -> Iterator[Stand]:
    s = Stand(monkeypatch)
    yield s
    s.close()


def heard(client: socket.socket) -> list[bytes]:
    """All packets that wait for a participant; the last is empty where the broker has closed the connection."""
    out: list[bytes] = []
    with contextlib.suppress(BlockingIOError):
        while not out or out[-1]:
            with contextlib.suppress(ConnectionResetError):  # closed with something of this participant's unread
                out.append(client.recv(512))
    return out


def packet(number: int, ns: int, raw: bytes, mark: int = 0) -> bytes:
    """What a participant receives."""
    raw = raw.ljust(72, b"\0")
    return struct.pack("<Qq", number, ns) + raw[:6] + bytes([mark, 0]) + raw[8:]


def test_a_greeting_is_answered_and_a_frame_goes_to_every_other_participant(stand: Stand) -> None:
    def steps() -> Iterator[Any]:
        a, b, c = stand.join(), stand.join(), stand.join()
        yield
        assert [heard(x) for x in (a, b, c)] == [[GREETING]] * 3
        a.send(classic(0x123, b"\x01\x02\x03"))
        yield
        assert heard(b) == heard(c) == [packet(1, 10**18, classic(0x123, b"\x01\x02\x03"))] and heard(a) == []
        stand.ns += 7
        c.send(classic(EXTENDED | 0x1FFFFFFF, bytes(range(8))))
        yield
        assert heard(a) == heard(b) == [packet(2, 10**18 + 7, classic(EXTENDED | 0x1FFFFFFF, bytes(range(8))))]
        assert heard(c) == []

    stand.all(steps)


def test_who_wants_its_own_frames_gets_them_marked_and_the_others_unmarked(stand: Stand) -> None:
    def steps() -> Iterator[Any]:
        a, b = stand.join(1), stand.join()
        yield
        assert heard(a) == heard(b) == [GREETING]
        raw = fd_frame(0x7FF, bytes(range(1, 65)))
        a.send(raw)
        yield
        assert heard(a) == [packet(1, 10**18, raw, mark=1)] and heard(b) == [packet(1, 10**18, raw)]
        b.send(raw)
        yield
        assert heard(a) == [packet(2, 10**18, raw)] and heard(b) == []

    stand.all(steps)


def test_the_two_spare_bytes_of_a_frame_are_the_brokers(stand: Stand) -> None:
    def steps() -> Iterator[Any]:
        a, b = stand.join(), stand.join()
        yield
        heard(b)
        pattern = bytes(range(1, 73))
        a.send(pattern)
        a.send(pattern[:16])
        yield
        want = pattern[:6] + b"\0\0" + pattern[8:]
        assert heard(b) == [struct.pack("<Qq", 1, 10**18) + want, packet(2, 10**18, want[:16])]

    stand.all(steps)


def test_who_has_not_greeted_hears_nothing(stand: Stand) -> None:
    def steps() -> Iterator[Any]:
        a, silent = stand.join(), stand.connect()
        yield
        a.send(classic(1))
        yield
        assert heard(silent) == []
        silent.send(GREETING + b"\0")
        yield
        a.send(classic(2))
        yield
        assert heard(silent) == [GREETING, packet(2, 10**18, classic(2))]

    stand.all(steps)


@pytest.mark.parametrize(
    "greeting", [GREETING, b"vaneloop bus 2\0", GREETING + b"\0\0", GREETING[:-1] + b"\0", b"v", bytes(16), b"\0" * 300]
)
def test_who_greets_otherwise_is_sent_away(stand: Stand, greeting: bytes) -> None:
    def steps() -> Iterator[Any]:
        a, other = stand.join(), stand.connect()
        yield
        other.send(greeting)
        yield
        assert heard(other) == [b""]
        a.send(classic(1))
        yield
        assert heard(a) == [GREETING] and len(stand.selector.get_map()) == 2

    stand.all(steps)


@pytest.mark.parametrize("size", [1, 8, 15, 17, 71, 73, 88, 256, 257])
def test_what_is_neither_16_nor_72_bytes_ends_the_connection_and_reaches_nobody(stand: Stand, size: int) -> None:
    def steps() -> Iterator[Any]:
        a, b = stand.join(), stand.join()
        yield
        a.send(classic(1))
        a.send(bytes(size))
        a.send(classic(2))
        yield
        assert heard(a)[0] == GREETING and heard(b) == [GREETING, packet(1, 10**18, classic(1))]
        c = stand.join()
        yield
        assert heard(c) == [GREETING] and len(stand.selector.get_map()) == 3

    stand.all(steps)


def test_a_second_greeting_is_no_frame(stand: Stand) -> None:
    def steps() -> Iterator[Any]:
        a, b = stand.join(), stand.join()
        yield
        a.send(GREETING + b"\0")
        yield
        assert heard(a) == [GREETING, b""] and heard(b) == [GREETING]

    stand.all(steps)


def test_64_frames_of_one_participant_then_it_is_the_next_ones_turn(stand: Stand) -> None:
    def steps() -> Iterator[Any]:
        a, b, c = stand.join(), stand.join(), stand.join()
        yield
        assert heard(c) == [GREETING]
        for k in range(70):
            a.send(classic(0x100 + k))
        b.send(classic(0x300))
        yield
        order = [WIDE.unpack(p)[2] for p in heard(c)]
        assert order == [*range(0x100, 0x140), 0x300, *range(0x140, 0x146)]

    stand.all(steps)


def test_another_users_process_is_sent_away(stand: Stand, monkeypatch: pytest.MonkeyPatch) -> None:
    def steps() -> Iterator[Any]:
        monkeypatch.setattr(broker, "same_user", lambda _: False)
        other = stand.join()
        yield
        assert heard(other) == [b""] and len(stand.selector.get_map()) == 1
        yield IDLE
        assert stand.selector.waits[-1] == 1.0  # it is no participant for which the broker would stay
        monkeypatch.undo()
        monkeypatch.setattr(os, "sched_setscheduler", lambda *_: None)
        a = stand.join()
        yield
        assert heard(a) == [GREETING]

    with pytest.raises(Over):
        stand.run(steps)


def test_a_connection_that_the_system_refuses_ends_nothing(stand: Stand) -> None:
    def steps() -> Iterator[Any]:
        stand.listener.fails = 1
        a = stand.join()
        yield
        assert heard(a) == [GREETING]

    stand.all(steps)


def test_a_connection_does_not_block_and_may_keep_a_mebibyte(stand: Stand) -> None:
    def steps() -> Iterator[Any]:
        stand.connect()
        yield
        (connection,) = stand.listener.connections  # type: ignore[attr-defined]
        assert connection.getblocking() is False
        assert connection.options == [(socket.SOL_SOCKET, socket.SO_SNDBUF, 1_048_576)]

    stand.all(steps)


def test_the_scheduler_follows_who_comes_and_goes(stand: Stand) -> None:
    fifo, other = os.SCHED_FIFO, os.SCHED_OTHER

    def steps() -> Iterator[Any]:
        a = stand.join()
        yield
        assert stand.scheduled == [(other, 0)]
        b = stand.join(3 << 1)
        yield
        c = stand.join(99 << 1 | 1)
        yield
        assert stand.scheduled[1:] == [(fifo, 3), (fifo, 99)]
        c.close()
        yield
        assert stand.scheduled[3:] == [(fifo, 3)]
        a.close()  # had none: nothing changes
        yield
        assert len(stand.scheduled) == 4
        b.close()
        yield
        assert stand.scheduled[4:] == [(other, 0)]

    stand.all(steps)


def test_own_frames_are_asked_for_by_bit_0_alone(stand: Stand) -> None:
    def steps() -> Iterator[Any]:
        a, b = stand.join(98 << 1), stand.join(2 << 1 | 1)
        yield
        a.send(classic(1))
        b.send(classic(2))
        yield
        assert [WIDE.unpack(p)[2] for p in heard(a)[1:]] == [2]
        assert [WIDE.unpack(p)[2] for p in heard(b)[1:]] == [1, 2]

    stand.all(steps)


def test_who_leaves_is_forgotten_and_another_may_come(stand: Stand) -> None:
    def steps() -> Iterator[Any]:
        a, b = stand.join(), stand.join()
        yield
        b.close()
        yield
        assert len(stand.selector.get_map()) == 2
        a.send(classic(1))
        c = stand.join()
        yield
        a.send(classic(2))
        yield
        assert heard(a) == [GREETING]
        assert [p if p == GREETING else WIDE.unpack(p)[2] for p in heard(c)] in ([GREETING, 2], [GREETING, 1, 2])

    stand.all(steps)


@pytest.mark.parametrize("own", [0, 1])
@pytest.mark.parametrize("unread", [False, True])
def test_what_a_participant_sent_before_it_left_reaches_the_others(stand: Stand, own: int, unread: bool) -> None:
    def steps() -> Iterator[Any]:
        a, b, c = stand.join(), stand.join(own), stand.join()
        yield
        if not unread:
            heard(b)
        a.send(classic(0x100))  # the broker finds that b is gone before it reads what b has sent
        for k in range(1, 4):
            b.send(classic(0x200 + k))
        b.close()
        yield
        assert [WIDE.unpack(p)[2] for p in heard(c)[1:]] == [0x100, 0x201, 0x202, 0x203]
        assert len(stand.selector.get_map()) == 3

    stand.all(steps)


def test_what_a_slow_reader_sent_before_it_left_reaches_the_others(stand: Stand) -> None:
    def steps() -> Iterator[Any]:
        a, slow, c = stand.join(), stand.join(), stand.join()
        yield
        yield from fill(stand, a, slow, lambda: heard(c))
        slow.send(classic(0x300))
        slow.close()
        yield
        assert [WIDE.unpack(p)[2] for p in heard(c)] == [0x100, 0x300] and len(stand.selector.get_map()) == 3

    stand.all(steps)


def test_who_is_gone_when_a_frame_comes_for_it_leaves_the_others_undisturbed(stand: Stand) -> None:
    def steps() -> Iterator[Any]:
        a, b, c = stand.join(), stand.join(), stand.join()
        yield
        a.send(classic(1))  # the broker gives it to b before it hears that b is gone
        b.close()
        yield
        a.send(classic(2))
        yield
        assert [WIDE.unpack(p)[2] for p in heard(c)[1:]] == [1, 2] and heard(a) == [GREETING]
        assert len(stand.selector.get_map()) == 3

    stand.all(steps)


def test_who_is_gone_with_packets_unread_leaves_the_others_undisturbed(stand: Stand) -> None:
    def steps() -> Iterator[Any]:
        a, b, c = stand.join(), stand.join(), stand.join()
        yield
        a.send(classic(1))
        yield
        b.close()  # the kernel answers the broker's read with "connection reset"
        yield
        assert len(stand.selector.get_map()) == 3
        a.send(classic(2))
        yield
        assert [WIDE.unpack(p)[2] for p in heard(c)[1:]] == [1, 2]

    stand.all(steps)


def test_who_cannot_be_read_is_sent_away(stand: Stand) -> None:
    def steps() -> Iterator[Any]:
        a, b = stand.join(), stand.join()
        yield
        stand.listener.connections[1].broken = True  # type: ignore[attr-defined]
        b.send(classic(1))
        yield
        assert heard(b) == [GREETING, b""] and heard(a) == [GREETING]

    stand.all(steps)


def test_who_leaves_before_its_answer_comes_is_forgotten(stand: Stand) -> None:
    def steps() -> Iterator[Any]:
        stand.join().close()
        yield
        assert len(stand.selector.get_map()) == 1
        a = stand.join()
        yield
        assert heard(a) == [GREETING]

    stand.all(steps)


def fill(
    stand: Stand, sender: socket.socket, reader: socket.socket, read: Callable[[], object] = lambda: None
) -> Iterator[Any]:
    """Send frames until the broker keeps one for the reader; the others ``read`` all but the last."""
    held = waiting_of(stand, reader)
    for _ in range(100_000):
        read()
        sender.send(classic(0x100))
        yield
        if held():
            return
    raise AssertionError("the reader takes everything")


def waiting_of(stand: Stand, client: socket.socket) -> Callable[[], bool]:
    """Whether the broker waits for room at this participant's connection."""
    place = stand.clients.index(client)

    def held() -> bool:
        connection = stand.listener.connections[place]  # type: ignore[attr-defined]
        return bool(stand.selector.get_key(connection).events & selectors.EVENT_WRITE)

    return held


def test_a_reader_that_does_not_read_is_told_what_is_gone_and_holds_up_nobody(
    stand: Stand, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(broker, "BACKLOG", 5)
    quick: list[bytes] = []

    def steps() -> Iterator[Any]:
        a, slow, fast = stand.join(), stand.join(), stand.join()
        yield
        assert heard(slow) == heard(fast) == [GREETING]
        held = waiting_of(stand, slow)
        assert not held()
        sent = 0
        while not held():
            a.send(classic(0x100, sent.to_bytes(4, "little")))
            sent += 1
            yield
            quick.extend(heard(fast))
        first = sent  # waits; four more do, and the seven after them are gone
        for _ in range(11):
            a.send(classic(0x100, sent.to_bytes(4, "little")))
            sent += 1
            yield
            quick.extend(heard(fast))
        got = heard(slow)
        yield
        got += heard(slow)
        yield
        got += heard(slow)
        assert not held()
        words = [WIDE.unpack(p) for p in got]
        assert [w[0] for w in words] == list(range(1, first + 6))
        last = words.pop()
        assert all(int.from_bytes(w[7][:4], "little") == w[0] - 1 and w[2] == 0x100 for w in words)
        assert last[2] == ERROR | 4 and last[5] == 2 and last[7][:8] == bytes([0, 1, 0, 0, 7, 0, 0, 0])
        a.send(classic(0x200))
        yield
        assert heard(slow) == [packet(sent + 1, 10**18, classic(0x200))]
        assert [WIDE.unpack(p)[0] for p in quick] == list(range(1, sent + 1))

    stand.all(steps)


def test_who_leaves_with_packets_still_waiting_is_forgotten(stand: Stand) -> None:
    def steps() -> Iterator[Any]:
        a, slow = stand.join(), stand.join()
        yield
        yield from fill(stand, a, slow)
        slow.close()
        yield
        assert len(stand.selector.get_map()) == 2

    stand.all(steps)


def test_the_broker_ends_a_second_after_the_last_has_left_and_waits_no_longer_than_that(stand: Stand) -> None:
    done = []

    def steps() -> Iterator[Any]:
        stand.clock = 500.999
        yield IDLE
        a = stand.join()
        yield
        assert heard(a) == [GREETING]
        stand.clock = 900.0
        yield IDLE
        a.close()
        yield
        stand.clock = 900.999
        yield IDLE
        done.append(True)
        stand.clock = 901.0
        yield IDLE
        raise AssertionError("it stays")

    stand.run(steps)
    assert done
    waits = stand.selector.waits
    assert waits[0] == waits[1] == waits[-1] == 1.0 and set(waits) == {1.0, None}


def test_without_any_participant_the_broker_ends_after_a_second(stand: Stand) -> None:
    def steps() -> Iterator[Any]:
        stand.clock = 501.0
        yield IDLE
        raise AssertionError("it stays")

    stand.run(steps)
    assert stand.selector.waits == [1.0]


def test_a_broker_may_be_told_how_long_it_lingers(stand: Stand, monkeypatch: pytest.MonkeyPatch) -> None:
    def steps() -> Iterator[Any]:
        stand.clock += 2.5
        yield IDLE
        stand.clock += 0.5
        yield IDLE
        raise AssertionError("it stays")

    turns: list[Turns] = []

    def made() -> Turns:
        turns.append(Turns(steps()))
        return turns[0]

    monkeypatch.setattr(broker, "selectors", SimpleNamespace(**{**vars(selectors), "DefaultSelector": made}))
    broker.serve(stand.listener, 3.0)
    assert turns[0].waits == [3.0, 3.0]


# ---- its start -------------------------------------------------------------------------------------------------------


class Left(Exception):
    """A process that would have ended."""


class System:
    """What a starting broker asks of the system, written down in place of being done."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, forks: list[int]):
        self.did: list[Any] = []
        self.listeners: list[socket.socket] = []
        left = iter(forks)

        def fork() -> int:
            self.did.append("fork")
            return next(left)

        def leave(code: int) -> None:
            self.did.append(("exit", code))
            raise Left

        def serve(listener: socket.socket) -> None:
            self.did.append("serve")
            self.listeners.append(listener)

        put = monkeypatch.setattr
        put(os, "fork", fork)
        put(os, "_exit", leave)
        put(os, "setsid", lambda: self.did.append("setsid"))
        put(os, "sched_setaffinity", lambda *which: self.did.append(("cores", *which)))
        put(os, "sched_setscheduler", lambda *which: self.did.append(("scheduler", which[1], which[2].sched_priority)))
        put(os, "open", lambda *which: self.did.append(("open", *which)) or 77)  # type: ignore[func-returns-value]
        put(os, "dup2", lambda *which: self.did.append(("dup2", *which)))
        put(os, "chdir", lambda *which: self.did.append(("chdir", *which)))
        put(broker, "serve", serve)


@pytest.mark.parametrize(("cores", "taken"), [(3, range(3)), (None, range(1))])
def test_a_broker_starts_as_a_daemon_of_all_cores_and_no_priority(
    cores: int | None, taken: range, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: cores)
    system = System(monkeypatch, [0, 0])
    name = new_name()
    assert broker.main(name) == 0
    assert system.did == [
        *("fork", "setsid", "fork", ("cores", 0, taken), ("scheduler", os.SCHED_OTHER, 0)),
        *(("open", "/dev/null", os.O_RDWR), ("dup2", 77, 0), ("dup2", 77, 1), ("dup2", 77, 2)),
        *(("chdir", "/"), "serve"),
    ]
    (listener,) = system.listeners
    with listener:
        assert listener.getsockname() == f"\0vaneloop-{os.getuid()}-{name}".encode()
        assert listener.getblocking() is False and listener.type == socket.SOCK_SEQPACKET
        with pytest.raises(BlockingIOError):
            listener.accept()
        assert room(listener.getsockname()) == room(of_64())


def of_64() -> bytes:
    """Address of a socket that listens for 64 connections, as the test makes it."""
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    listener.bind(f"\0{new_name()}")
    listener.listen(64)
    _open.append(listener)
    return listener.getsockname()


_open: list[socket.socket] = []


def room(address: bytes) -> int:
    """How many may connect before anybody is let in."""
    clients: list[socket.socket] = []
    try:
        while len(clients) < 1000:
            clients.append(socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET))
            clients[-1].setblocking(False)
            clients[-1].connect(address)
    except BlockingIOError:
        return len(clients) - 1
    finally:
        for c in (*clients, *_open):
            c.close()
    raise AssertionError("as many as like")


def test_a_user_who_may_not_choose_cores_gets_a_broker_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    def no(*_: object) -> None:
        raise PermissionError

    system = System(monkeypatch, [0, 0])
    monkeypatch.setattr(os, "sched_setaffinity", no)
    assert broker.main(new_name()) == 0 and system.did[-1] == "serve"
    system.listeners[0].close()


@pytest.mark.parametrize(
    ("forks", "did"), [([4711], ["fork", ("exit", 0)]), ([0, 4711], ["fork", "setsid", "fork", ("exit", 0)])]
)
def test_both_parents_of_the_daemon_end_well(forks: list[int], did: list[Any], monkeypatch: pytest.MonkeyPatch) -> None:
    system = System(monkeypatch, forks)
    with pytest.raises(Left):
        broker.main(new_name())
    assert system.did == did


def test_a_second_broker_of_a_name_says_so_and_ends_with_3(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    system = System(monkeypatch, [])
    name = new_name()
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as first:
        first.bind(f"\0vaneloop-{os.getuid()}-{name}")
        assert broker.main(name) == 3
    assert system.did == []
    said = capsys.readouterr()
    assert (said.out, said.err) == ("", f"bus {name}: Address already in use\n")


# ---- a participant joins ---------------------------------------------------------------------------------------------


class Line:
    """A socket that answers from a list: what `recv` gives, or raises."""

    def __init__(self, world: World, answer: Any):
        self.world, self.answer = world, answer
        self.did: list[Any] = []
        self.closed = False

    def settimeout(self, seconds: float) -> None:
        self.did.append(("timeout", seconds))

    def setblocking(self, flag: bool) -> None:
        self.did.append(("blocking", flag))

    def setsockopt(self, *which: Any) -> None:
        self.did.append(("option", *which))

    def connect(self, address: str) -> None:
        self.did.append(("connect", address))
        if isinstance(self.answer, OSError):
            raise self.answer

    def getsockopt(self, *which: Any) -> bytes:
        return struct.pack("3i", 1, self.world.uid, 1)

    def send(self, raw: bytes) -> None:
        self.did.append(("send", raw))

    def recv(self, size: int) -> bytes:
        if isinstance(self.answer, tuple):
            raise self.answer[0]
        return self.answer[:size]

    def close(self) -> None:
        self.closed = True


class World:
    """A system whose sockets answer one after the other, the last answer for ever, and whose clock goes on by what is
    slept.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch, answers: list[Any], nap: float | None = None):
        self.answers, self.lines = answers, list[Line]()
        self.uid = os.getuid()
        self.clock, self.naps = 100.0, list[float]()
        self.runs: list[tuple[Any, dict[str, Any]]] = []
        self.ends: list[SimpleNamespace] = []
        self.closed_at_nap: list[bool] = []

        def made(*which: Any) -> Line:
            assert which == (socket.AF_UNIX, socket.SOCK_SEQPACKET)
            self.lines.append(Line(self, self.answers.pop(0) if len(self.answers) > 1 else self.answers[0]))
            return self.lines[-1]

        def sleep(seconds: float) -> None:
            self.naps.append(seconds)
            self.closed_at_nap.append(self.lines[-1].closed)
            self.clock += seconds if nap is None else nap

        def run(command: list[str], **options: Any) -> SimpleNamespace:
            self.runs.append((command, options))
            return self.ends.pop(0) if self.ends else SimpleNamespace(returncode=0, stderr=b"")

        monkeypatch.setattr(local_bus, "socket", SimpleNamespace(**{**vars(socket), "socket": made}))
        monkeypatch.setattr(local_bus, "time", SimpleNamespace(monotonic=lambda: self.clock, sleep=sleep))
        monkeypatch.setattr(local_bus, "subprocess", SimpleNamespace(**{**vars(subprocess), "run": run}))


REFUSED = ConnectionRefusedError(errno.ECONNREFUSED, "Connection refused")


def end(bus: LocalBus) -> None:
    """Leave the bus."""
    bus.shutdown()


def test_a_participant_connects_greets_and_does_not_block_afterwards(monkeypatch: pytest.MonkeyPatch) -> None:
    world = World(monkeypatch, [GREETING])
    bus = LocalBus("rig")
    (line,) = world.lines
    assert line.did == [
        ("timeout", 10.0),
        ("option", socket.SOL_SOCKET, socket.SO_SNDBUF, 1_048_576),
        ("connect", f"\0vaneloop-{os.getuid()}-rig"),
        ("send", GREETING + b"\0"),
        ("blocking", False),
    ]
    assert not world.runs and not world.naps and not line.closed
    end(bus)
    assert line.closed


@pytest.mark.parametrize(
    ("options", "byte"),
    [
        ({}, 0),
        ({"receive_own_messages": True}, 1),
        ({"priority": 1}, 2),
        ({"priority": 99}, 198),
        ({"priority": 99, "receive_own_messages": True}, 199),
        ({"priority": "5"}, 10),
    ],
)
def test_the_greeting_says_own_frames_and_priority(
    options: dict[str, Any], byte: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    world = World(monkeypatch, [GREETING])
    end(LocalBus("rig", **options))
    assert ("send", GREETING + bytes([byte])) in world.lines[0].did


def test_a_bus_tells_what_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    World(monkeypatch, [GREETING])
    bus = LocalBus()
    assert (bus.channel, bus.channel_info) == ("vaneloop", "vaneloop embedded bus 'vaneloop'")
    assert (bus.lost, bus.restarts, bus.protocol) == (0, 0, can.CanProtocol.CAN_FD)
    assert bus.filters is None
    end(bus)
    rig = LocalBus("rig", fd=False, can_filters=[{"can_id": 1, "can_mask": 3}])
    assert (rig.channel, rig.channel_info) == ("rig", "vaneloop embedded bus 'rig'")
    assert rig.protocol == can.CanProtocol.CAN_20 and rig.filters == [{"can_id": 1, "can_mask": 3}]
    end(rig)


@pytest.mark.parametrize("name", ["a", "x" * 60, "A-z_0.9", 7])
def test_names_of_1_to_60_letters_digits_and_three_signs_are_taken(name: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    world = World(monkeypatch, [GREETING])
    end(LocalBus(name))
    assert ("connect", f"\0vaneloop-{os.getuid()}-{name}") in world.lines[0].did


@pytest.mark.parametrize("name", ["", "x" * 61, "a b", "a/b", "ä", "a\n", "a:b", "\0"])
def test_another_name_is_refused_with_what_is_allowed(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    world = World(monkeypatch, [GREETING])
    with pytest.raises(can.CanInitializationError) as e:
        LocalBus(name)
    assert str(e.value) == f"channel (={name!r}) must be 1 to 60 letters, digits, '_', '.' or '-'"
    assert not world.lines


@pytest.mark.parametrize("priority", [-1, 100])
def test_a_priority_outside_0_to_99_is_refused(priority: int, monkeypatch: pytest.MonkeyPatch) -> None:
    world = World(monkeypatch, [GREETING])
    with pytest.raises(can.CanInitializationError) as e:
        LocalBus("rig", priority=priority)
    assert str(e.value) == f"priority (={priority}) must be in [0, 99]" and not world.lines


def test_where_there_is_no_broker_one_is_started_and_asked_5_ms_later(monkeypatch: pytest.MonkeyPatch) -> None:
    world = World(monkeypatch, [REFUSED, GREETING])
    end(LocalBus("rig"))
    ((command, options),) = world.runs
    assert command == [sys.executable, "-I", broker.__file__, "rig"]
    null, pipe = subprocess.DEVNULL, subprocess.PIPE
    assert options == {"stdin": null, "stdout": null, "stderr": pipe, "check": False}
    assert world.naps == [0.005] and world.closed_at_nap == [True] and len(world.lines) == 2


def test_a_broker_that_somebody_else_started_meanwhile_is_as_good(monkeypatch: pytest.MonkeyPatch) -> None:
    world = World(monkeypatch, [REFUSED, GREETING])
    world.ends = [SimpleNamespace(returncode=3, stderr=b"bus rig: Address already in use\n")]
    end(LocalBus("rig"))
    assert len(world.runs) == 1


@pytest.mark.parametrize(
    ("code", "stderr", "says"),
    [
        (1, b"Traceback\n  somewhere\nOSError: no room\n\n", "OSError: no room"),
        (4, b"", "4"),
        (2, b" \n", "2"),
        (-9, b"", "-9"),
        (1, b"bad \xff byte", "bad \ufffd byte"),
    ],
)
def test_a_broker_that_does_not_start_is_one_line_with_its_last_word(
    code: int, stderr: bytes, says: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    world = World(monkeypatch, [REFUSED])
    world.ends = [SimpleNamespace(returncode=code, stderr=stderr)]
    with pytest.raises(can.CanInitializationError) as e:
        LocalBus("rig")
    assert str(e.value) == f"bus rig: its broker does not start ({says})"


@pytest.mark.parametrize("answer", [b"vaneloop bus 2", b"", GREETING + b"\0", GREETING.ljust(65, b"x")])
def test_who_answers_otherwise_is_left_and_asked_again(answer: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    world = World(monkeypatch, [answer, GREETING])
    end(LocalBus("rig"))
    assert not world.runs and world.naps == [0.005] and world.closed_at_nap == [True]


@pytest.mark.parametrize("answer", [(TimeoutError("timed out"),), (ConnectionResetError(),), PermissionError()])
def test_an_error_other_than_a_refusal_starts_no_second_broker(answer: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    world = World(monkeypatch, [answer, GREETING])
    end(LocalBus("rig"))
    assert not world.runs and world.naps == [0.005] and world.closed_at_nap == [True]


def test_a_broker_has_ten_seconds_to_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    world = World(monkeypatch, [b""], nap=1.0)
    with pytest.raises(can.CanInitializationError) as e:
        LocalBus("rig")
    assert str(e.value) == "bus rig: its broker does not answer"
    assert len(world.lines) == 12 and world.clock == 111.0  # asked at 0, 1, ... 10 and 11 s


def test_another_users_broker_is_refused_and_nothing_is_said_to_it(monkeypatch: pytest.MonkeyPatch) -> None:
    world = World(monkeypatch, [GREETING])
    world.uid = os.getuid() + 1
    with pytest.raises(can.CanInitializationError) as e:
        LocalBus("rig")
    assert str(e.value) == "bus rig: another user has taken its address"
    assert [d for d in world.lines[0].did if d[0] == "send"] == [] and len(world.lines) == 1


# ---- a participant's frames ------------------------------------------------------------------------------------------


class Desk:
    """A broker of the test's own: it greets who comes and does nothing else."""

    def __init__(self) -> None:
        self.name = new_name()
        self.listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.listener.bind(f"\0vaneloop-{os.getuid()}-{self.name}")
        self.listener.listen(8)
        self.listener.settimeout(PATIENCE)
        self.opened: list[Any] = []

    def open(self, **options: Any) -> tuple[LocalBus, socket.socket]:
        """A participant and its connection at this end."""
        bus: list[LocalBus] = []
        connection = self.meet(lambda: bus.append(LocalBus(self.name, **options)))
        self.opened += [*bus, connection]
        return bus[0], connection

    def meet(self, joins: Callable[[], object]) -> socket.socket:
        """Greet who joins in ``joins``; return its connection."""
        met: list[socket.socket] = []

        def greet() -> None:
            connection, _ = self.listener.accept()
            connection.settimeout(PATIENCE)
            connection.recv(64)
            connection.send(GREETING)
            met.append(connection)

        greeter = threading.Thread(target=greet, daemon=True)
        greeter.start()
        joins()
        greeter.join(PATIENCE)
        met[0].settimeout(5.0)
        return met[0]

    def close(self) -> None:
        """Close all."""
        for o in self.opened:
            if isinstance(o, LocalBus):
                o.shutdown()
            else:
                o.close()
        self.listener.close()


@pytest.fixture
def desk(monkeypatch: pytest.MonkeyPatch) -> Iterator[Desk]:
    monkeypatch.setattr(local_bus, "START_TIME", 3.0)  # for what goes wrong: nothing here does
    d = Desk()
    yield d
    d.close()


def raw_packet(ident: int, length: int, flags: int = 0, mark: int = 0, data: bytes = b"", ns: int = 0) -> bytes:
    return WIDE.pack(1, ns, ident, length, flags, mark, 0, data)


def no_select(*_: object) -> Any:
    raise AssertionError("it waits")


@pytest.mark.parametrize(
    ("raw", "message"),
    [
        (raw_packet(0x123, 3, data=b"abc"), can.Message(arbitration_id=0x123, is_extended_id=False, data=b"abc")),
        (raw_packet(0, 0), can.Message(arbitration_id=0, is_extended_id=False)),
        (
            raw_packet(0x7FF, 8, data=b"12345678"),
            can.Message(arbitration_id=0x7FF, is_extended_id=False, data=b"12345678"),
        ),
        (raw_packet(EXTENDED | 0x1FFFFFFF, 1, data=b"x"), can.Message(arbitration_id=0x1FFFFFFF, data=b"x")),
        (raw_packet(EXTENDED | 0x10, 0), can.Message(arbitration_id=0x10)),
        (
            raw_packet(REMOTE | 0x10, 5),
            can.Message(arbitration_id=0x10, is_extended_id=False, is_remote_frame=True, dlc=5),
        ),
        (
            raw_packet(ERROR | 0x88, 8, data=b"\0" * 8),
            can.Message(arbitration_id=0x88, is_extended_id=False, is_error_frame=True, data=bytes(8)),
        ),
        (
            raw_packet(ERROR | REMOTE | 0x88, 8, data=b"12345678"),
            can.Message(arbitration_id=0x88, is_extended_id=False, is_error_frame=True, data=b"12345678"),
        ),
        (
            raw_packet(0x10, 64, FDF, data=bytes(range(64))),
            can.Message(arbitration_id=0x10, is_extended_id=False, is_fd=True, data=bytes(range(64))),
        ),
        (
            raw_packet(0x10, 12, FDF | BRS, data=bytes(12)),
            can.Message(arbitration_id=0x10, is_extended_id=False, is_fd=True, bitrate_switch=True, data=bytes(12)),
        ),
        (
            raw_packet(0x10, 12, FDF | ESI, data=bytes(12)),
            can.Message(
                arbitration_id=0x10, is_extended_id=False, is_fd=True, error_state_indicator=True, data=bytes(12)
            ),
        ),
    ],
)
def test_a_packet_becomes_the_message_and_the_message_the_frame(desk: Desk, raw: bytes, message: can.Message) -> None:
    bus, other = desk.open()
    other.send(raw)
    got = bus.recv(0)
    assert got is not None and got.equals(message, timestamp_delta=None, check_channel=False)
    assert got.dlc == message.dlc and got.channel == desk.name and got.is_rx
    bus.send(message)
    sent = other.recv(256)
    frame = raw[16:]
    if message.is_error_frame:  # an error frame is one whatever else is set
        frame = (int.from_bytes(frame[:4], "little") & ~REMOTE).to_bytes(4, "little") + frame[4:]
    assert sent == (frame if message.is_fd else frame[:16])
    assert bus.lost == bus.restarts == 0


def test_the_time_is_the_brokers_and_a_mark_says_that_the_frame_is_ones_own(desk: Desk) -> None:
    bus, other = desk.open()
    ns = 1_700_000_000_123_456_789
    for mark in (0, 1, 2, 3):
        other.send(raw_packet(0x10, 0, mark=mark, ns=ns))
    got = [bus.recv(0) for _ in range(4)]
    assert [m.timestamp for m in got if m] == [pytest.approx(ns / 1e9, abs=1e-6, rel=0)] * 4
    assert [m.is_rx for m in got if m] == [True, False, True, True]


def test_without_a_frame_recv_does_not_wait_at_zero_and_waits_as_long_as_it_is_told(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    bus, other = desk.open()
    waits: list[Any] = []

    def waiting(*which: Any) -> Any:
        waits.append(which)
        return [], [], []

    monkeypatch.setattr(local_bus, "select", SimpleNamespace(select=no_select))
    assert bus.recv(0) is None and bus._recv_internal(0) == (None, False) and bus._recv_internal(-1.0) == (None, False)
    monkeypatch.setattr(local_bus, "select", SimpleNamespace(select=waiting))
    for timeout in (0.5, 1.0, 2.0):
        assert bus._recv_internal(timeout) == (None, False)
    assert bus._recv_internal(None) == (None, False)
    (at,) = {id(w[0][0]) for w in waits}
    assert at == id(bus._socket) and [w[1:] for w in waits] == [([], [], t) for t in (0.5, 1.0, 2.0, None)]

    def comes(readers: Any, _writers: Any, _errors: Any, _timeout: float | None) -> Any:
        other.send(raw_packet(0x77, 0))
        return readers, [], []

    monkeypatch.setattr(local_bus, "select", SimpleNamespace(select=comes))
    got, filtered = bus._recv_internal(1.0)
    assert got is not None and got.arbitration_id == 0x77 and filtered is False
    monkeypatch.setattr(local_bus, "select", SimpleNamespace(select=lambda readers, *_: (readers, [], [])))
    assert bus._recv_internal(1.0) == (None, False)  # somebody else was quicker


def test_a_frame_that_is_there_is_given_without_waiting(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    bus, other = desk.open()
    monkeypatch.setattr(local_bus, "select", SimpleNamespace(select=no_select))
    other.send(raw_packet(0x42, 0))
    got = bus.recv()
    assert got is not None and got.arbitration_id == 0x42


def test_filters_hold_for_a_participant(desk: Desk) -> None:
    bus, other = desk.open(can_filters=[{"can_id": 0xB0, "can_mask": 0x7F0, "extended": False}])
    for ident in (0xA0, 0xB1, 0x1B0):
        other.send(raw_packet(ident, 0))
    assert [m and m.arbitration_id for m in (bus.recv(0), bus.recv(0), bus.recv(0))] == [None, 0xB1, None]


def test_rows_are_of_frames_that_pass_the_filters_and_an_error_frame_passes_all(desk: Desk) -> None:
    bus, other = desk.open(can_filters=[{"can_id": 0xB0, "can_mask": 0x7F0, "extended": False}])
    for ident in (0xA0, 0xB1, EXTENDED | 0xB2, ERROR | 4, 0x1B0, 0xB3):
        other.send(raw_packet(ident, 0))
    rows = np.zeros((4, 2), np.int64)
    assert bus.read_rows(rows[:1]) == 1 and bus.read_rows(rows[1:]) == 2 and bus.read_rows(rows[3:]) == 0
    assert rows[:3, 0].tolist() == [0xB1, ERROR | 4, 0xB3]
    other.send(raw_packet(ERROR | 4, 0))
    got = bus.recv(0)
    assert got is not None and got.is_error_frame
    other.send(raw_packet(0xA0, 0))
    bus.set_filters(None)
    rows[0] = -7
    assert bus.read_rows(rows[:1]) == 1 and rows[0].tolist() == [0xA0, 0]


def test_the_readers_own_loss_is_counted_and_logged(desk: Desk, caplog: pytest.LogCaptureFixture) -> None:
    bus, other = desk.open()
    with caplog.at_level(logging.WARNING):
        other.send(WIDE.pack(9, 0, ERROR | 4, 8, 0, 2, 0, bytes([0, 1, 0, 0, 0x34, 0x12, 0, 0])))
        got = bus.recv(0)
        assert got is not None and got.is_error_frame and got.arbitration_id == 4 and got.data[1] == 1
        other.send(WIDE.pack(9, 0, ERROR | 4, 8, 0, 2, 0, bytes([0, 1, 0, 0, 1, 0, 0, 1, 9])))
        bus.recv(0)
    assert bus.lost == 0x1234 + 0x01000001
    says = f"bus {desk.name}: this reader is too slow, {{}} frames are lost to it"
    assert [r.getMessage() for r in caplog.records] == [says.format(0x1234), says.format(0x01000001)]


@pytest.mark.parametrize(
    ("ident", "flags", "mark"),
    [(ERROR | 4, 0, 0), (ERROR | 4, 0, 1), (ERROR | 5, 0, 2), (ERROR | 0, 0, 2), (ERROR | 4, FDF, 2), (4, 0, 2)],
)
def test_no_other_frame_is_the_brokers_word_on_a_loss(desk: Desk, ident: int, flags: int, mark: int) -> None:
    bus, other = desk.open()
    other.send(WIDE.pack(9, 0, ident, 8, flags, mark, 0, bytes([0, 1, 0, 0, 5, 0, 0, 0])))
    got = bus.recv(0)
    assert got is not None and got.arbitration_id == ident & 0xFF and bus.lost == 0


def test_a_bus_has_the_descriptor_of_its_socket(desk: Desk) -> None:
    bus, other = desk.open()
    assert select.select([bus.fileno()], [], [], 0)[0] == []
    other.send(raw_packet(1, 0))
    assert select.select([bus.fileno()], [], [], 0)[0] == [bus.fileno()]


def test_rows_are_the_frames_without_what_the_broker_put_into_them(desk: Desk) -> None:
    bus, other = desk.open()
    other.send(raw_packet(0x123, 3, mark=1, data=b"\x01\x02\x03"))
    other.send(raw_packet(EXTENDED | 0x1FFFFFFF, 8, data=b"\xff" * 8))
    other.send(raw_packet(REMOTE | 0x10, 5, mark=2))
    other.send(raw_packet(0x10, 48, FDF | BRS | ESI, data=bytes(range(48))))
    want = [
        (3 << 32 | 0x123, 0x030201),
        (8 << 32 | 0x9FFFFFFF, -1),
        (5 << 32 | 0x40000010, 0),
        (4 << 40 | 48 << 32 | 0x10, 0x0706050403020100),
    ]
    rows = np.full((3, 2), -7, np.int64)
    assert bus.read_rows(rows[:1]) == 1 and bus.read_rows(rows[1:]) == 2
    assert rows.tolist() == [list(r) for r in want[:3]]
    rows[:] = -7
    assert bus.read_rows(rows[:0]) == 0
    assert bus.read_rows(rows) == 1 and rows[0].tolist() == list(want[3]) and (rows[1:] == -7).all()
    assert bus.read_rows(rows) == 0


def test_rows_are_sent_as_classic_frames_in_their_order(desk: Desk) -> None:
    bus, other = desk.open()
    rows = np.array([[3 << 32 | 0x123, 0x030201], [8 << 32 | 0x9FFFFFFF, -1]], np.int64)
    assert bus.write_rows(rows) == 2 and bus.write_rows(rows[:0]) == 0
    assert other.recv(256) == classic(0x123, b"\x01\x02\x03")
    assert other.recv(256) == classic(EXTENDED | 0x1FFFFFFF, b"\xff" * 8)


class Full:
    """A socket that takes nothing until the test gives it room."""

    def __init__(self, room: int = 0):
        self.room, self.taken = room, list[bytes]()

    def send(self, raw: bytes) -> None:
        if not self.room:
            raise BlockingIOError
        self.room -= 1
        self.taken.append(raw)


def test_a_full_buffer_is_waited_for_as_long_as_the_caller_says(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    bus, _ = desk.open()
    full, real = Full(), bus._socket
    clock, waits = [50.0], list[Any]()
    monkeypatch.setattr(local_bus, "time", SimpleNamespace(monotonic=lambda: clock[0]))

    def waiting(readers: Any, writers: Any, errors: Any, timeout: float | None) -> Any:
        waits.append(timeout)
        assert (readers, writers, errors) == ([], [full], [])
        if len(waits) == 1:  # writable, but another was quicker
            clock[0] += 1.5
            return [], [full], []
        if timeout is None or timeout > 1.0:
            full.room = 1
            return [], [full], []
        clock[0] += timeout
        return [], [], []

    monkeypatch.setattr(local_bus, "select", SimpleNamespace(select=waiting))
    monkeypatch.setattr(bus, "_socket", full)
    bus.send_raw(b"a" * 16)
    assert waits == [None, None] and full.taken == [b"a" * 16]
    waits.clear()
    bus.send_raw(b"b" * 16, 4.0)
    assert waits == [4.0, 2.5] and full.taken[1:] == [b"b" * 16]
    waits.clear()
    with pytest.raises(can.CanOperationError) as e:
        bus.send_raw(b"c" * 16, 2.0)
    assert str(e.value) == f"bus {desk.name}: transmit buffer full" and waits == [2.0, 0.5]
    waits.clear()
    with pytest.raises(can.CanOperationError, match="transmit buffer full"):
        bus.send(can.Message(arbitration_id=1), timeout=0)
    assert waits == [] and len(full.taken) == 2
    monkeypatch.setattr(bus, "_socket", real)


def test_rows_for_which_there_is_no_room_are_left_out_and_not_waited_for(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    bus, _ = desk.open()
    real, full = bus._socket, Full(2)
    monkeypatch.setattr(local_bus, "select", SimpleNamespace(select=no_select))
    monkeypatch.setattr(local_bus, "time", SimpleNamespace(monotonic=lambda: 50.0))
    monkeypatch.setattr(bus, "_socket", full)
    rows = np.array([[k, 0] for k in range(4)], np.int64)
    assert bus.write_rows(rows) == 2 and full.taken == [classic(0), classic(1)]
    assert bus.write_rows(rows) == 0
    monkeypatch.setattr(bus, "_socket", real)


# ---- a broker ends ---------------------------------------------------------------------------------------------------


def test_a_reader_whose_broker_ended_joins_the_next_and_is_told(
    desk: Desk, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    bus, other = desk.open()
    fd, files = bus.fileno(), len(os.listdir("/proc/self/fd"))
    other.close()
    got: list[Any] = []
    monkeypatch.setattr(time, "time_ns", lambda: 5_000_000_000)
    with caplog.at_level(logging.WARNING), warnings.catch_warnings(record=True) as unclosed:
        warnings.simplefilter("always", ResourceWarning)
        again = desk.meet(lambda: got.append(bus.receive_packet()))
    assert unclosed == []
    desk.opened.append(again)
    assert got == [struct.pack("<Qq", 0, 5_000_000_000) + fd_frame(ERROR | 0x100, b"", 0)[:4] + b"\x08" + bytes(67)]
    assert bus.restarts == 1 and bus.lost == 0 and bus.fileno() == fd
    assert len(os.listdir("/proc/self/fd")) == files
    assert [r.getMessage() for r in caplog.records] == [
        f"bus {desk.name}: its broker ended and was started again; frames may be lost"
    ]
    again.send(raw_packet(0x55, 0))
    m = bus.recv(0)
    assert m is not None and m.arbitration_id == 0x55
    bus.send(can.Message(arbitration_id=0x66, is_extended_id=False))
    assert again.recv(256) == classic(0x66)


def test_a_reset_connection_is_a_broker_that_ended(desk: Desk) -> None:
    bus, other = desk.open()
    bus.send(can.Message(arbitration_id=1))
    other.close()  # with a frame unread: the kernel answers "connection reset"
    got: list[Any] = []
    desk.opened.append(desk.meet(lambda: got.append(bus.recv(0))))
    assert got[0].is_error_frame and got[0].arbitration_id == 0x100 and got[0].dlc == 8 and got[0].is_rx
    assert bus.restarts == 1


def test_a_sender_whose_broker_ended_joins_the_next_and_sends_there(desk: Desk) -> None:
    bus, other = desk.open()
    other.close()
    again = desk.meet(lambda: bus.send(can.Message(arbitration_id=0x66, is_extended_id=False)))
    desk.opened.append(again)
    assert again.recv(256) == classic(0x66) and bus.restarts == 1
    again.close()
    once_more = desk.meet(lambda: bus.send(can.Message(arbitration_id=0x67, is_extended_id=False), timeout=0))
    desk.opened.append(once_more)
    assert once_more.recv(256) == classic(0x67) and bus.restarts == 2


def test_after_shutdown_everything_says_that_the_bus_is_shut_down(desk: Desk) -> None:
    bus, other = desk.open()
    bus.shutdown()
    assert other.recv(256) == b""
    bus.shutdown()
    for call in (
        *(bus.receive_packet, lambda: bus.recv(0), lambda: bus.recv(1.0), bus._rejoin),
        *(lambda: bus.send(can.Message(arbitration_id=1)), lambda: bus.send_raw(bytes(16), 0)),
        lambda: bus.read_rows(np.zeros((1, 2), np.int64)),
    ):
        with pytest.raises(can.CanOperationError) as e:
            call()
        assert str(e.value) == f"bus {desk.name} is shut down"
    assert bus.write_rows(np.zeros((2, 2), np.int64)) == 0 and bus.restarts == 0


@pytest.mark.parametrize("says", [OSError(errno.EBADF, "Bad file descriptor"), ValueError("file descriptor cannot be")])
def test_a_bus_that_is_shut_down_while_somebody_waits_says_so(
    desk: Desk, says: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    def shut(*_: object) -> Any:
        raise says

    bus, _ = desk.open()
    monkeypatch.setattr(local_bus, "select", SimpleNamespace(select=shut))
    with pytest.raises(can.CanOperationError) as e:
        bus.recv(1.0)
    assert str(e.value) == f"bus {desk.name} is shut down"


def test_shutdown_stops_what_is_sent_in_a_period(desk: Desk) -> None:
    bus, _ = desk.open()
    task: Any = bus.send_periodic(can.Message(arbitration_id=1), 100.0)
    assert not task.stopped
    bus.shutdown()
    assert task.stopped


# ---- which buses there are -------------------------------------------------------------------------------------------


def test_the_buses_of_this_user_are_listed_by_name_each_once(monkeypatch: pytest.MonkeyPatch) -> None:
    own, other = os.getuid(), os.getuid() + 1
    text = "\n".join(
        f"0000000000000000: 00000002 00000000 00010000 0005 01 {k} {path}".rstrip()
        for k, path in enumerate(
            [
                *(f"@vaneloop-{own}-rig", f"@vaneloop-{own}-a.b", f"@vaneloop-{own}-rig", f"@vaneloop-{other}-theirs"),
                *("", "/run/dbus", f"@vaneloop-{own}", f"/tmp/@vaneloop-{own}-no", f"@vaneloops-{own}-no"),
            ]
        )
    )
    opened = []

    def files(*which: Any, **how: Any) -> io.StringIO:
        opened.append((which, how))
        return io.StringIO("Num RefCount Protocol Flags Type St Inode Path\n" + text + "\n")

    monkeypatch.setattr(local_bus, "open", files, raising=False)
    want = [{"interface": "vaneloop", "channel": "a.b"}, {"interface": "vaneloop", "channel": "rig"}]
    assert LocalBus._detect_available_configs() == want
    assert opened == [(("/proc/net/unix",), {"encoding": "utf-8"})]


def test_a_bus_that_listens_is_listed_by_python_can(desk: Desk) -> None:
    assert {"interface": "vaneloop", "channel": desk.name} in can.detect_available_configs(["vaneloop"])


def test_a_system_without_the_list_has_no_buses(monkeypatch: pytest.MonkeyPatch) -> None:
    def none(*_: Any, **__: Any) -> Any:
        raise FileNotFoundError

    monkeypatch.setattr(local_bus, "open", none, raising=False)
    assert LocalBus._detect_available_configs() == []


def test_the_broker_needs_nothing_but_the_standard_library() -> None:
    done = subprocess.run(
        [sys.executable, "-I", "-S", "-X", "importtime", "-c", f"import runpy; runpy.run_path({broker.__file__!r})"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "numpy" not in done.stderr and "vaneloop" not in done.stderr and Path(broker.__file__).name == "broker.py"
