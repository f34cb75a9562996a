"""The embedded bus as a python-can interface, ``vaneloop``: ``python -m can.logger -i vaneloop -c NAME`` joins it like
any other bus.

Every participant of the same user on this machine that opens the same NAME hears the others' frames, all in the same
order; there is no bit rate and no arbitration (`hil.bus.lockstep_bus` has those). Nothing is lost silently: a reader
that falls `hil.bus.broker.BACKLOG` frames behind gets an error frame (CAN_ERR_CRTL, data[1] = 1 receive overflow,
data[4:8] = how many frames are gone) in the place of the frames, its `LocalBus.lost` counts them and the log says so.
If the broker is killed, the next call starts another one; the reader gets an error frame CAN_ERR_RESTARTED, because
frames may be gone that nobody can count.
"""

from __future__ import annotations

import logging
import os
import re
import select
import socket
import struct
import subprocess
import sys
import time
from typing import Any

import can
import numpy as np

from hil.bus import broker, frames

__all__ = ["DEFAULT", "LocalBus"]

LOG = logging.getLogger(__name__)
DEFAULT = "vaneloop"  # name of the bus if none is given
_NAME = re.compile(r"[A-Za-z0-9_.-]{1,60}\Z")
_HEAD = struct.Struct("<Qq")
_FRAME = struct.Struct("<IBBBB64s")
_ERROR, _REMOTE, _EXTENDED = 0x20000000, 0x40000000, 0x80000000
_BRS, _ESI, _FDF = 1, 2, 4
RESTARTED = 0x100  # CAN_ERR_RESTARTED
START_TIME = 10.0  # s for which a new broker may take to start on a busy machine


class LocalBus(can.BusABC):
    """A participant of the embedded bus ``channel``.

    channel               name: letters, digits, ``_.-``, at most 60
    receive_own_messages  hear one's own frames, too (``is_rx`` is False on them)
    can_filters           as everywhere in python-can; error frames pass all, as in SocketCAN
    priority              SCHED_FIFO priority of this participant, 0..99: the broker takes the highest, where it may
    lost                  frames that this reader was too slow for, in all
    restarts              how often the broker had to be started anew
    """

    def __init__(
        self,
        channel: Any = DEFAULT,
        can_filters: Any = None,
        receive_own_messages: bool = False,
        fd: bool = True,
        priority: int = 0,
        **kwargs: Any,
    ):
        name = str(channel)
        if not _NAME.match(name):
            raise can.CanInitializationError(f"channel (={name!r}) must be 1 to 60 letters, digits, '_', '.' or '-'")
        self.channel = name
        self.channel_info = f"vaneloop embedded bus '{name}'"
        self.lost = 0
        self.restarts = 0
        if not 0 <= int(priority) <= 99:
            raise can.CanInitializationError(f"priority (={priority}) must be in [0, 99]")
        self._greeting = broker.HELLO + bytes([int(priority) << 1 | (broker.OWN if receive_own_messages else 0)])
        self._can_protocol = can.CanProtocol.CAN_FD if fd else can.CanProtocol.CAN_20
        self._socket = self._join()
        super().__init__(channel=name, can_filters=can_filters, **kwargs)

    def _join(self) -> socket.socket:
        """Connect to the broker, starting one where there is none."""
        deadline = time.monotonic() + START_TIME
        while True:
            connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            try:
                connection.settimeout(START_TIME)
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, broker.SEND_BUFFER)
                connection.connect(broker.address(self.channel))
                if not broker.same_user(connection):
                    raise can.CanInitializationError(f"bus {self.channel}: another user has taken its address")
                connection.send(self._greeting)
                if connection.recv(64) == broker.HELLO:
                    connection.setblocking(False)
                    return connection
                connection.close()  # it was about to end; or it is another version's
            except OSError as e:
                connection.close()
                if isinstance(e, ConnectionRefusedError):
                    self._start()
            if time.monotonic() > deadline:
                raise can.CanInitializationError(f"bus {self.channel}: its broker does not answer")
            time.sleep(0.005)

    def _start(self) -> None:
        done = subprocess.run(
            [sys.executable, "-I", str(broker.__file__), self.channel],
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, check=False,
        )  # fmt: skip
        if done.returncode not in (0, 3):  # 3: somebody else was quicker
            said = done.stderr.decode(errors="replace").strip().splitlines()
            raise can.CanInitializationError(
                f"bus {self.channel}: its broker does not start ({said[-1] if said else done.returncode})"
            )

    def _rejoin(self) -> None:
        """After the broker's end: join again under the same file descriptor."""
        if self._is_shutdown:
            raise can.CanOperationError(f"bus {self.channel} is shut down")
        connection = self._join()
        os.dup2(connection.fileno(), self._socket.fileno())
        connection.close()
        self.restarts += 1
        LOG.warning("bus %s: its broker ended and was started again; frames may be lost", self.channel)

    def receive_packet(self) -> bytes | None:
        """Return the next packet (`hil.bus.broker.PACKET`) or None if there is none now. Counts and logs what
        was lost.
        """
        try:
            packet = self._socket.recv(256)
        except BlockingIOError:
            return None
        except OSError as e:
            if self._is_shutdown:
                raise can.CanOperationError(f"bus {self.channel} is shut down") from e
            packet = b""
        if not packet:
            self._rejoin()
            return broker.PACKET.pack(0, time.time_ns(), _FRAME.pack(_ERROR | RESTARTED, 8, 0, 0, 0, b""))
        if packet[19] & 0x20:  # an error frame; whether it is the broker's word on this reader's own loss
            ident, _, flags, mark, _, data = _FRAME.unpack_from(packet, broker.FRAME_AT)
            if ident == _ERROR | 4 and mark == broker.LOSS and not flags:
                lost = int.from_bytes(data[4:8], "little")
                self.lost += lost
                LOG.warning("bus %s: this reader is too slow, %d frames are lost to it", self.channel, lost)
        return packet

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        packet = self.receive_packet()
        if packet is None:
            if timeout is not None and timeout <= 0:
                return None, False
            try:
                ready, _, _ = select.select([self._socket], [], [], timeout)
            except (OSError, ValueError) as e:
                raise can.CanOperationError(f"bus {self.channel} is shut down") from e
            packet = self.receive_packet() if ready else None
            if packet is None:
                return None, False
        _, ns = _HEAD.unpack_from(packet)
        ident, length, flags, mark, _, data = _FRAME.unpack_from(packet, broker.FRAME_AT)
        remote = bool(ident & _REMOTE) and not ident & _ERROR
        message = can.Message(
            timestamp=ns * 1e-9,
            arbitration_id=ident & 0x1FFFFFFF,
            is_extended_id=bool(ident & _EXTENDED),
            is_remote_frame=remote,
            is_error_frame=bool(ident & _ERROR),
            is_fd=bool(flags & _FDF),
            bitrate_switch=bool(flags & _BRS),
            error_state_indicator=bool(flags & _ESI),
            channel=self.channel,
            dlc=length,
            data=None if remote else data[:length],
            is_rx=mark != broker.MINE,
        )
        return message, message.is_error_frame

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send a frame; waits up to ``timeout`` s (None: as long as it takes) for room, then raises
        CanOperationError.
        """
        ident = msg.arbitration_id | (_EXTENDED if msg.is_extended_id else 0) | (_REMOTE if msg.is_remote_frame else 0)
        if msg.is_error_frame:
            ident = msg.arbitration_id | _ERROR
        flags = (
            (_FDF if msg.is_fd else 0)
            | (_BRS if msg.bitrate_switch else 0)
            | (_ESI if msg.error_state_indicator else 0)
        )
        length = msg.dlc if msg.is_remote_frame else len(msg.data)
        raw = _FRAME.pack(ident, length, flags, 0, 0, bytes(msg.data))
        self.send_raw(raw if msg.is_fd else raw[:16], timeout)

    def send_raw(self, raw: bytes, timeout: float | None = None) -> None:
        """Send 16 bytes of ``struct can_frame`` or 72 of ``struct canfd_frame``."""
        deadline = None if timeout is None else time.monotonic() + timeout
        while True:
            try:
                self._socket.send(raw)
                return
            except BlockingIOError:
                left = None if deadline is None else deadline - time.monotonic()
                if (left is not None and left <= 0) or not select.select([], [self._socket], [], left)[1]:
                    raise can.CanOperationError(f"bus {self.channel}: transmit buffer full") from None
            except OSError as e:
                if self._is_shutdown:
                    raise can.CanOperationError(f"bus {self.channel} is shut down") from e
                self._rejoin()

    def read_rows(self, rows: np.ndarray) -> int:
        """Take what is there and passes the filters into the first rows of ``rows`` (int64[n, 2], `hil.bus.frames`)
        without waiting; return how many.
        """
        n = 0
        while n < len(rows) and (packet := self.receive_packet()) is not None:
            rows[n] = np.frombuffer(packet, "<i8", 2, broker.FRAME_AT)
            rows[n, 0] &= frames.HEAD_MASK
            n += frames.passes(self.filters, int(rows[n, 0]))
        return n

    def write_rows(self, rows: np.ndarray) -> int:
        """Send the frames without waiting; return how many the bus took."""
        taken = 0
        for raw in frames.to_bytes(rows):
            try:
                self.send_raw(raw, 0)
                taken += 1
            except can.CanError:
                continue
        return taken

    def fileno(self) -> int:
        """File descriptor that is readable when a frame is there."""
        return self._socket.fileno()

    def shutdown(self) -> None:
        """Leave the bus."""
        super().shutdown()
        self._socket.close()

    @staticmethod
    def _detect_available_configs() -> list[Any]:
        prefix = "@" + broker.address("")[1:]
        try:
            with open("/proc/net/unix", encoding="utf-8") as file:
                names = {line.split()[-1][len(prefix) :] for line in file if line.split()[-1].startswith(prefix)}
        except OSError:
            names = set()
        return [{"interface": "vaneloop", "channel": name} for name in sorted(names)]
