"""The embedded bus between processes: a small process that gives every frame to every participant, in one order.

The first participant starts it (`hil.bus.local_bus`); it ends a second after the last one has left, however that one
ended. Its address is an abstract Unix socket, ``@vaneloop-UID-NAME``, which the kernel frees with the process: there is
no stale socket to clean up. Only processes of the same user (or root) are let in.

Packets (SOCK_SEQPACKET keeps their borders): a participant greets with `HELLO` and a byte (bit 0 `OWN`, above it its
real-time priority), is greeted back, and sends frames of 16 or 72 bytes (``struct can_frame``, ``struct canfd_frame``).
It receives `PACKET`: number, time (ns since 1970), frame. A participant that does not read keeps up to `BACKLOG`
frames; what is beyond is replaced, in its place in the order, by one error frame that says how many frames are gone.
Nobody else waits for it. The broker runs with the highest real-time priority of its participants: who must not be late
must not wait for it either.

Only the standard library is imported, and the file is run by its path, so that it starts in some tens of milliseconds.
"""

from __future__ import annotations

import contextlib
import os
import selectors
import socket
import struct
import sys
import time
from collections import deque
from collections.abc import Iterable

HELLO = b"vaneloop bus 1"
OWN = 1  # flag of the greeting: wants its own frames, too
PACKET = struct.Struct("<Qq72s")
FRAME_AT = 16  # the frame's first byte in a packet
MARK_AT = FRAME_AT + 6  # a spare byte of struct canfd_frame
MINE, LOSS = 1, 2  # its values: the reader's own frame; the broker's word on what the reader lost
BACKLOG = 8192  # frames kept for a slow reader
TURN = 64  # frames taken from one participant before the next one's turn
LINGER = 1.0  # s without participants
SEND_BUFFER = 1 << 20  # bytes

# struct can_frame of an error frame: id CAN_ERR_FLAG | CAN_ERR_CRTL, 8 bytes, data[1] = CAN_ERR_CRTL_RX_OVERFLOW,
# data[4:8] = frames lost
_LOST = struct.Struct("<IBBBxBBBBI")
_CRED = struct.Struct("3i")


def address(name: str) -> str:
    """Return the socket address of the bus ``name`` of this user."""
    return f"\0vaneloop-{os.getuid()}-{name}"


def same_user(connection: socket.socket) -> bool:
    """Return True if the process at the other end is this user's or root's."""
    _, uid, _ = _CRED.unpack(connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CRED.size))
    return uid in (os.getuid(), 0)


def loss(lost: int) -> bytes:
    """Return the error frame that stands for ``lost`` frames, 72 bytes."""
    return _LOST.pack(0x20000004, 8, 0, LOSS, 0, 1, 0, 0, min(lost, 0xFFFFFFFF)).ljust(72, b"\0")


class _Member:
    """One participant: its socket, and what it has not yet taken."""

    def __init__(self, connection: socket.socket):
        self.connection = connection
        self.greeted = False
        self.own = False
        self.priority = 0
        self.waiting: deque[bytes | list[int]] = (
            deque()
        )  # packets, and [frames lost, number, time] where frames are gone

    def give(self, packet: bytes) -> None:
        """Hand over a packet, keep it, or count it as lost; raises OSError where the participant is gone."""
        waiting = self.waiting
        if not waiting:
            try:
                self.connection.send(packet)
                return
            except BlockingIOError:
                pass
        if len(waiting) < BACKLOG:
            waiting.append(packet)
            return
        last = waiting[-1]
        if isinstance(last, list):
            last[0] += 1
        else:
            number, at, _ = PACKET.unpack(packet)
            waiting.append([1, number, at])

    def catch_up(self) -> None:
        """Hand over what waits, as far as it is taken."""
        waiting = self.waiting
        while waiting:
            head = waiting[0]
            packet = PACKET.pack(head[1], head[2], loss(head[0])) if isinstance(head, list) else head
            try:
                self.connection.send(packet)
            except BlockingIOError:
                return
            waiting.popleft()


def schedule(priorities: Iterable[int]) -> None:
    """Run with the highest of the priorities (SCHED_FIFO; 0 is the ordinary scheduler) as far as this user may."""
    highest = max(priorities, default=0)
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_FIFO if highest else os.SCHED_OTHER, os.sched_param(highest))


def serve(listener: socket.socket, linger: float = LINGER) -> None:
    """Pass frames on until nobody has been there for ``linger`` seconds."""
    selector = selectors.DefaultSelector()
    selector.register(listener, selectors.EVENT_READ)
    members: dict[socket.socket, _Member] = {}
    number = 0
    alone_since = time.monotonic()

    def leave(member: _Member) -> None:
        nonlocal alone_since
        del members[member.connection]
        selector.unregister(member.connection)
        member.connection.close()
        alone_since = time.monotonic()
        if member.priority:
            schedule(m.priority for m in members.values())

    def read(member: _Member) -> None:
        nonlocal number
        for _ in range(TURN):
            try:
                raw = member.connection.recv(256)
            except BlockingIOError:
                return
            except ConnectionResetError:  # it left with packets unread: what it has sent is there all the same
                continue
            if not raw:
                return leave(member)
            if not member.greeted:
                if raw[:-1] != HELLO:
                    return leave(member)
                member.greeted, member.own, member.priority = True, bool(raw[-1] & OWN), raw[-1] >> 1
                schedule(m.priority for m in members.values())
                member.connection.send(HELLO)
                continue
            if len(raw) not in (16, 72):
                return leave(member)
            number += 1
            now = time.time_ns()
            packet = PACKET.pack(number, now, raw[:6] + b"\0\0" + raw[8:])
            for other in list(members.values()):
                if not other.greeted or (other is member and not other.own):
                    continue
                with contextlib.suppress(OSError):  # it is gone; what it has sent before is still to be read
                    other.give(
                        packet if other is not member else packet[:MARK_AT] + bytes([MINE]) + packet[MARK_AT + 1 :]
                    )
                    if other.waiting:
                        selector.modify(other.connection, selectors.EVENT_READ | selectors.EVENT_WRITE)

    while members or time.monotonic() - alone_since < linger:
        for key, events in selector.select(None if members else linger):
            if key.fileobj is listener:
                with contextlib.suppress(OSError):
                    connection, _ = listener.accept()
                    if not same_user(connection):
                        connection.close()
                        continue
                    connection.setblocking(False)
                    connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
                    members[connection] = _Member(connection)
                    selector.register(connection, selectors.EVENT_READ)
                continue
            member = members[key.fileobj]  # type: ignore[index]
            try:
                if events & selectors.EVENT_WRITE:
                    with contextlib.suppress(OSError):
                        member.catch_up()
                    if not member.waiting:
                        selector.modify(member.connection, selectors.EVENT_READ)
                if events & selectors.EVENT_READ:
                    read(member)
            except OSError:
                leave(member)


def main(name: str) -> int:
    """Listen on the bus ``name`` and go into the background; 0 once that listens, 3 if another broker does already."""
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        listener.bind(address(name))
    except OSError as e:
        print(f"bus {name}: {e.strerror}", file=sys.stderr)
        return 3
    listener.listen(64)
    listener.setblocking(False)
    if os.fork():
        os._exit(0)
    os.setsid()
    if os.fork():
        os._exit(0)
    with contextlib.suppress(OSError, AttributeError):  # who starts it may be a real-time process bound to one core
        os.sched_setaffinity(0, range(os.cpu_count() or 1))
    schedule([])
    null = os.open(os.devnull, os.O_RDWR)
    for fd in (0, 1, 2):
        os.dup2(null, fd)
    os.chdir("/")
    serve(listener)
    return 0


if __name__ == "__main__":
    from vaneloop.base import terminal

    sys.exit(terminal.run(lambda: main(sys.argv[1])))
