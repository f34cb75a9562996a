"""Which bus a name opens, what a refusal says, and a port's frames over a socket, as `hil.bus.port` has them.

The system's list of interfaces is a folder of the test's own, and SocketCAN's socket one end of a pair: frames are laid
out here once more by `struct`, as linux/can.h has them.
"""

from __future__ import annotations

import errno
import socket
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import can
import numpy as np
import pytest

import hil.bus
from hil.bus import port
from hil.bus.port import Port, open_bus
from vaneloop.base.errors import InputError

EXTENDED = 1 << 31  # CAN_EFF_FLAG
FDF = 4  # CANFD_FDF
INSTEAD = "--bus local joins the embedded bus instead"


# ---- names -----------------------------------------------------------------------------------------------------------


class Buses:
    """Every kind of bus, written down in place of being opened, and the interfaces of a system."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, net: Path):
        self.opened: list[tuple[str, Any, dict[str, Any]]] = []
        self.net, self.has_can = net, True
        self.sockets: list[Any] = []
        self.monkeypatch = monkeypatch
        from can.interfaces import socketcan

        monkeypatch.setattr(port, "LocalBus", self.kind("local"))
        monkeypatch.setattr(port, "LockstepBus", self.kind("lockstep"))
        monkeypatch.setattr(socketcan, "SocketcanBus", self.kind("socketcan"))
        monkeypatch.setattr(port, "_NET", net)
        monkeypatch.setattr(port, "socket", SimpleNamespace(**{**vars(socket), "socket": self.socket}))

    def kind(self, of: str) -> Callable[..., Any]:
        def made(channel: Any, **options: Any) -> Any:
            self.opened.append((of, channel, options))
            return self.opened[-1]

        return made

    def socket(self, *which: int) -> Any:
        if not self.has_can:
            raise OSError(errno.EAFNOSUPPORT, "Address family not supported by protocol")
        made = SimpleNamespace(which=which, closed=False)
        made.close = lambda: setattr(made, "closed", True)
        self.sockets.append(made)
        return made

    def interface(self, name: str, kind: str = "280\n", flags: str = "0x40081\n") -> None:
        """An interface of this name: its type (280 = ARPHRD_CAN) and its flags (bit 0 = IFF_UP)."""
        (self.net / name).mkdir()
        (self.net / name / "type").write_text(kind)
        (self.net / name / "flags").write_text(flags)


@pytest.fixture
def buses(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Buses:
    return Buses(monkeypatch, tmp_path)


@pytest.mark.parametrize(
    ("name", "kind", "channel"),
    [
        *[("local", "local", "vaneloop"), ("local:", "local", "vaneloop"), ("local:rig", "local", "rig")],
        *[("local:a:b", "local", "a:b"), ("lockstep", "lockstep", "lockstep"), ("lockstep:", "lockstep", "lockstep")],
        ("lockstep:two", "lockstep", "two"),
    ],
)
def test_a_name_opens_the_bus_that_it_says(buses: Buses, name: str, kind: str, channel: str) -> None:
    assert open_bus(name, receive_own_messages=True) is buses.opened[0]  # type: ignore[comparison-overlap]
    assert buses.opened == [(kind, channel, {"receive_own_messages": True})] and not buses.sockets


@pytest.mark.parametrize("name", ["vcan0", "can0", "can17", "vcan2", "slcan0", "my-bus", "a", "x" * 15])
def test_an_interface_of_the_kernel_is_opened_with_can_fd(buses: Buses, name: str) -> None:
    buses.interface(name)
    open_bus(name, can_filters=None)
    open_bus(name, fd=False)
    assert buses.opened == [("socketcan", name, {"fd": True, "can_filters": None}), ("socketcan", name, {"fd": False})]
    assert [s.which for s in buses.sockets] == [(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)] * 2
    assert all(s.closed for s in buses.sockets)


@pytest.mark.parametrize(
    "name", ["", "lo", "can", "vcan", "can0x", "xcan0", "vcan0:x", "locals", "x" * 16, "a b", "a/type", "..", "no\n"]
)
def test_another_name_is_refused_with_what_is_allowed(buses: Buses, name: str) -> None:
    buses.interface("lo", "772\n")
    for there in ("vcan0", "x" * 16, "a b", "a"):  # the kernel itself has no names of 16 signs or with a blank
        buses.interface(there)
    with pytest.raises(InputError) as e:
        open_bus(name)
    assert str(e.value) == (
        f"--bus {name!r} is not known; allowed: vcan0, can0 or another CAN interface, local, local:NAME, lockstep"
    )
    assert not buses.opened


@pytest.mark.parametrize(
    ("name", "hint"), [("vcan3", " (sudo ip link add dev vcan3 type vcan makes it)"), ("can3", "")]
)
def test_an_interface_that_is_not_there_says_how_it_is_made(buses: Buses, name: str, hint: str) -> None:
    with pytest.raises(InputError) as e:
        open_bus(name)
    assert str(e.value) == f"--bus {name}: no such interface{hint}; {INSTEAD}" and not buses.opened


def test_an_interface_of_another_kind_is_refused(buses: Buses) -> None:
    buses.interface("can0", "1\n")
    with pytest.raises(InputError) as e:
        open_bus("can0")
    assert str(e.value) == f"--bus can0: is not a CAN interface; {INSTEAD}"


@pytest.mark.parametrize("flags", ["0x40080\n", "0x0\n", "0x2\n", "0xfe\n"])
def test_an_interface_that_is_down_says_how_it_is_brought_up(buses: Buses, flags: str) -> None:
    buses.interface("vcan0", flags=flags)
    with pytest.raises(InputError) as e:
        open_bus("vcan0")
    assert str(e.value) == f"--bus vcan0: is down (sudo ip link set vcan0 up); {INSTEAD}" and not buses.opened


@pytest.mark.parametrize("flags", ["0x1\n", "0x40081\n", "0xc1\n"])
def test_an_interface_that_is_up_is_opened(buses: Buses, flags: str) -> None:
    buses.interface("vcan0", flags=flags)
    open_bus("vcan0")
    assert [o[1] for o in buses.opened] == ["vcan0"]


def test_a_kernel_without_can_is_said_before_anything_else(buses: Buses) -> None:
    buses.has_can = False
    for name in ("vcan0", "can0"):
        with pytest.raises(InputError) as e:
            open_bus(name)
        assert str(e.value) == f"--bus {name}: this kernel has no CAN; {INSTEAD}"


def test_a_python_without_can_is_said_like_a_kernel_without(buses: Buses) -> None:
    without = {k: v for k, v in vars(socket).items() if k != "AF_CAN"}
    buses.monkeypatch.setattr(port, "socket", SimpleNamespace(**without))
    with pytest.raises(InputError, match=r"^--bus can0: this kernel has no CAN; --bus local joins"):
        open_bus("can0")


@pytest.mark.parametrize(
    ("error", "says"),
    [
        (OSError(errno.ENODEV, "No such device"), "No such device"),
        (OSError("odd"), "odd"),
        (can.CanInitializationError("no place left"), "no place left"),
    ],
)
def test_a_bus_that_does_not_open_is_one_line_with_the_way_out(buses: Buses, error: Exception, says: str) -> None:
    def refuses(*_: Any, **__: Any) -> Any:
        raise error

    buses.monkeypatch.setattr(port, "LocalBus", refuses)
    with pytest.raises(InputError) as e:
        open_bus("local:rig")
    assert str(e.value) == f"--bus local:rig: {says}; {INSTEAD}"


def test_the_package_gives_its_two_names_when_they_are_asked_for() -> None:
    assert hil.bus.__getattr__("Port") is Port and hil.bus.__getattr__("open_bus") is open_bus
    assert hil.bus.__all__ == ["Port", "open_bus"]
    with pytest.raises(AttributeError, match=r"^module 'hil\.bus' has no attribute 'close_bus'$"):
        hil.bus.__getattr__("close_bus")


# ---- a port over a bus that gives rows -------------------------------------------------------------------------------


def test_a_port_over_a_bus_of_rows_hands_them_through_and_counts_the_refused() -> None:
    asked: list[Any] = []
    bus = SimpleNamespace(
        lost=4,
        read_rows=lambda rows: asked.append(("read", rows)) or 2,  # type: ignore[func-returns-value]
        write_rows=lambda rows: asked.append(("write", rows)) or 1,  # type: ignore[func-returns-value]
    )
    p = Port(bus)
    rows = np.zeros((3, 2), np.int64)
    assert (p.bus, p.lost, p.refused, p.errors) == (bus, 4, 0, 0)
    assert p.read(rows) == 2 and p.write(rows) == 1 and p.refused == 2
    assert p.write(rows[:1]) == 1 and p.refused == 2 and p.write(rows) == 1 and p.refused == 4
    assert [what for what, _ in asked] == ["read", "write", "write", "write"] and asked[0][1] is rows
    bus.lost = 9
    assert p.lost == 9 and p.errors == 0


# ---- a port over a socket --------------------------------------------------------------------------------------------


class Spied:
    """A socket that keeps which options are set and refuses those that the test names."""

    def __init__(self, real: Any, refuses: tuple[int, ...] = ()):
        self.real, self.refuses = real, refuses
        self.options: list[Any] = []
        self.reads: list[Any] = []

    def setsockopt(self, *which: int) -> None:
        self.options.append(which)
        if which[1] in self.refuses:
            raise PermissionError(errno.EPERM, "Operation not permitted")

    def recvmsg_into(self, *which: Any) -> Any:
        self.reads.append(which)
        return self.real.recvmsg_into(*which)

    def send(self, *which: Any) -> int:
        return self.real.send(*which)


@pytest.fixture
def pair() -> Iterator[tuple[Port, socket.socket]]:
    a, b = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with a, b:
        b.settimeout(5.0)
        yield Port(SimpleNamespace(socket=Spied(a))), b


def classic(ident: int, data: bytes, spare: bytes = b"\0\0\0") -> bytes:
    return struct.pack("<IB3s8s", ident, len(data), spare, data)


def wide(ident: int, data: bytes, flags: int = 0) -> bytes:
    return struct.pack("<IBBxx64s", ident, len(data), flags, data)


def test_a_port_asks_the_kernel_for_its_losses_and_for_eight_mebibytes(pair: tuple[Port, socket.socket]) -> None:
    p, _ = pair
    # SO_RXQ_OVFL and SO_RCVBUFFORCE of asm-generic/socket.h, which Python does not name
    assert p.bus.socket.options == [(socket.SOL_SOCKET, 40, 1), (socket.SOL_SOCKET, 33, 8_388_608)]
    assert (p.lost, p.refused, p.errors) == (0, 0, 0)


def test_without_the_right_a_port_takes_what_the_system_allows() -> None:
    spied = Spied(None, refuses=(33,))
    Port(SimpleNamespace(socket=spied))
    assert spied.options[1:] == [(socket.SOL_SOCKET, 33, 8_388_608), (socket.SOL_SOCKET, socket.SO_RCVBUF, 8_388_608)]


def test_frames_become_rows_without_their_spare_bytes(pair: tuple[Port, socket.socket]) -> None:
    p, other = pair
    rows = np.full((6, 2), -7, np.int64)
    assert p.read(rows) == 0 and (rows == -7).all() and p.errors == 0
    other.send(classic(0x123, b"\x01\x02\x03"))
    other.send(classic(EXTENDED | 0x1FFFFFFF, b"\xff" * 8, spare=b"\xfb\xff\xff"))
    other.send(wide(0x10, bytes(range(48)), FDF | 1))
    other.send(wide(0x11, b"x", 0))  # a CAN FD frame by its size, whatever its flags
    other.send(classic(0x12, b""))
    assert p.read(rows) == 5 and p.read(rows[5:]) == 0
    assert rows.tolist() == [
        [3 << 32 | 0x123, 0x030201],
        [8 << 32 | 0x9FFFFFFF, -1],
        [1 << 42 | 48 << 32 | 0x10, 0x0706050403020100],
        [1 << 42 | 1 << 32 | 0x11, 0x78],
        [0x12, 0],
        [-7, -7],
    ]
    assert all(which[1:] == (64, socket.MSG_DONTWAIT) for which in p.bus.socket.reads)


def test_what_does_not_fit_stays_for_the_next_call(pair: tuple[Port, socket.socket]) -> None:
    p, other = pair
    for k in range(5):
        other.send(classic(k, b""))
    rows = np.zeros((2, 2), np.int64)
    got = []
    for _ in range(4):
        got.append(rows[: p.read(rows), 0].tolist())
    assert got == [[0, 1], [2, 3], [4], []] and p.read(rows[:0]) == 0


def test_what_the_kernel_dropped_is_the_last_number_that_it_told() -> None:
    a, b = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    told = [
        [(socket.SOL_SOCKET, 40, struct.pack("<I", 5))],
        [(socket.SOL_SOCKET, 29, struct.pack("<I", 77)), (101, 40, struct.pack("<I", 78))],  # others' words
        [(socket.SOL_SOCKET, 40, struct.pack("<I", 0x01020304) + b"\x05")],
    ]

    class Tells(Spied):
        def recvmsg_into(self, *which: Any) -> Any:
            size, _, flags, address = super().recvmsg_into(*which)
            return size, told.pop(0), flags, address

    with a, b:
        p = Port(SimpleNamespace(socket=Tells(a), lost=99))
        rows = np.zeros((1, 2), np.int64)
        lost = []
        for _ in range(3):
            b.send(classic(1, b""))
            assert p.read(rows) == 1
            lost.append(p.lost)
    assert lost == [5, 5, 0x01020304]


def test_an_interface_that_goes_down_is_counted_and_ends_the_reading() -> None:
    calls: list[int] = []

    def down(*_: Any) -> Any:
        calls.append(1)
        raise OSError(errno.ENETDOWN, "Network is down")

    p = Port(SimpleNamespace(socket=SimpleNamespace(setsockopt=lambda *_: None, recvmsg_into=down)))
    rows = np.zeros((4, 2), np.int64)
    assert p.read(rows) == 0 and p.errors == 1 and len(calls) == 1
    assert p.read(rows) == 0 and p.errors == 2 and p.refused == p.lost == 0


def test_rows_are_sent_as_frames_of_16_bytes_without_waiting(pair: tuple[Port, socket.socket]) -> None:
    p, other = pair
    rows = np.array([[3 << 32 | 0x123, 0x030201], [8 << 32 | 0x9FFFFFFF, -1]], np.int64)
    assert p.write(rows) == 2 and p.write(rows[:0]) == 0 and p.refused == 0
    assert other.recv(256) == classic(0x123, b"\x01\x02\x03")
    assert other.recv(256) == classic(EXTENDED | 0x1FFFFFFF, b"\xff" * 8)


def test_frames_that_the_socket_does_not_take_are_refused_and_the_others_sent() -> None:
    sent: list[Any] = []

    def send(raw: bytes, flags: int) -> int:
        assert flags == socket.MSG_DONTWAIT
        if raw[0] in (1, 2):
            raise BlockingIOError if raw[0] == 1 else OSError(errno.ENETDOWN, "Network is down")
        sent.append(raw)
        return len(raw)

    p = Port(SimpleNamespace(socket=SimpleNamespace(setsockopt=lambda *_: None, send=send)))
    rows = np.array([[k, 0] for k in range(4)], np.int64)
    assert p.write(rows) == 2 and p.refused == 2 and sent == [classic(0, b""), classic(3, b"")]
    assert p.write(rows[1:]) == 1 and p.refused == 4 and p.errors == 0
