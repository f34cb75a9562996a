"""Which bus a command joins, and frames in and out of it without a python-can message for each."""

from __future__ import annotations

import re
import socket
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import can
import numpy as np
from can.interfaces import socketcan

from hil.bus.frames import FD, HEAD_MASK, to_bytes
from hil.bus.local_bus import DEFAULT, LocalBus
from hil.bus.lockstep_bus import LockstepBus
from vaneloop.base.errors import InputError

__all__ = ["BUS_HELP", "Port", "open_bus"]

BUS_HELP = "vcan0, can0, ...: SocketCAN; local[:NAME]: embedded bus between processes; lockstep: simulated time"
_CAN_TYPE = "280"  # ARPHRD_CAN
SO_RXQ_OVFL = 40  # the kernel tells how many frames it dropped
SO_RCVBUFFORCE = 33  # as SO_RCVBUF, beyond the system's limit where the rights allow
RECEIVE_BUFFER = 8 << 20  # bytes that the kernel may keep for a reader: about 10,000 frames, half a minute of this bus
_NET = Path("/sys/class/net")


def open_bus(name: str, **options: bool | float | str | Sequence[object] | None) -> can.BusABC:
    """Open the bus that ``name`` says: ``vcan0``, ``can0`` ... (SocketCAN), ``local[:NAME]`` (embedded),
    ``lockstep[:NAME]``.

    options go to the python-can interface (``receive_own_messages``, ``can_filters``, ...). InputError where there is
    no such bus.
    """
    kind, _, rest = name.partition(":")
    given: dict[str, Any] = dict(options)  # what each interface takes, it judges itself
    try:
        if kind == "local":
            return LocalBus(rest or DEFAULT, **given)
        if kind == "lockstep":
            return LockstepBus(rest or "lockstep", **given)
        if not rest and (re.fullmatch(r"v?can\d+", kind) or _is_can(kind)):
            _check_socketcan(kind)
            return socketcan.SocketcanBus(kind, **{"fd": True, **given})
    except (OSError, can.CanError) as e:
        raise InputError(
            f"--bus {name}: {getattr(e, 'strerror', None) or e}; --bus local joins the embedded bus instead"
        ) from None
    raise InputError(
        f"--bus {name!r} is not known; allowed: vcan0, can0 or another CAN interface, local, local:NAME, lockstep"
    )


def _is_can(name: str) -> bool:
    try:
        return bool(re.fullmatch(r"[^/\s:]{1,15}", name)) and (_NET / name / "type").read_text().strip() == _CAN_TYPE
    except OSError:
        return False


def _check_socketcan(name: str) -> None:
    """Raise InputError, naming the way out, where the kernel has no such interface or it is down."""
    instead = "--bus local joins the embedded bus instead"
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except (OSError, AttributeError):
        raise InputError(f"--bus {name}: this kernel has no CAN; {instead}") from None
    if not (_NET / name).exists():
        hint = f" (sudo ip link add dev {name} type vcan makes it)" if name.startswith("v") else ""
        raise InputError(f"--bus {name}: no such interface{hint}; {instead}")
    if not _is_can(name):
        raise InputError(f"--bus {name}: is not a CAN interface; {instead}")
    flags = int((_NET / name / "flags").read_text(), 16)
    if not flags & 1:  # IFF_UP
        raise InputError(f"--bus {name}: is down (sudo ip link set {name} up); {instead}")


class Port:
    """Frames (rows of two int64, `hil.bus.frames`) in and out of an open bus without waiting, as a control tick wants
    them.

    lost     frames that this reader was too slow for
    refused  frames that the bus did not take (queue full, interface down, bus-off)
    errors   calls that SocketCAN answered with an error (interface down)
    """

    def __init__(self, bus: Any):
        self.bus = bus
        self.refused = self.errors = 0
        self._dropped = 0
        self._rows = hasattr(bus, "read_rows")
        if not self._rows:
            self._socket: socket.socket = bus.socket
            self._socket.setsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL, 1)
            try:
                self._socket.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, RECEIVE_BUFFER)
            except OSError:
                self._socket.setsockopt(
                    socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER
                )  # the kernel takes what it allows
            self._buffer = bytearray(72)
            self._words = np.frombuffer(self._buffer, "<i8")

    @property
    def lost(self) -> int:
        """Frames that this reader was too slow for."""
        return self.bus.lost if self._rows else self._dropped

    def read(self, rows: np.ndarray) -> int:
        """Take what has come into the first rows of ``rows`` (int64[n, 2]); return how many. What does not fit stays
        for the next call.
        """
        if self._rows:
            return self.bus.read_rows(rows)
        n = 0
        while n < len(rows):
            try:
                size, extra, _, _ = self._socket.recvmsg_into([self._buffer], 64, socket.MSG_DONTWAIT)
            except BlockingIOError:
                break
            except OSError:
                self.errors += 1
                break
            for level, kind, data in extra:
                if level == socket.SOL_SOCKET and kind == SO_RXQ_OVFL:
                    self._dropped = int.from_bytes(data[:4], "little")
            rows[n] = self._words[:2]
            rows[n, 0] &= HEAD_MASK
            if size == 72:
                rows[n, 0] |= FD
            n += 1
        return n

    def write(self, rows: np.ndarray) -> int:
        """Send the frames; return how many the bus took. The others are gone and counted as refused."""
        if self._rows:
            taken = self.bus.write_rows(rows)
        else:
            taken = 0
            for raw in to_bytes(rows):
                try:
                    self._socket.send(raw, socket.MSG_DONTWAIT)
                    taken += 1
                except OSError:
                    continue
        self.refused += len(rows) - taken
        return taken
