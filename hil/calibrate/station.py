"""A node on the bus with the tools that attend to it: frames of theirs are kept from the firmware, and answered.

The tools' frames are worked on before a tick, of each service in order of arrival; answers and measurements are sent
after it. A tick has room for so much work and no more: the rest waits, and of what waits too long the oldest is dropped
and counted. What takes longer than a tick is done outside of it, and takes effect before the tick whose frames say so.
"""

from __future__ import annotations

from collections import deque
from typing import Any, Protocol

import numpy as np

from hil.bus.frames import ERROR, EXTENDED, FD, IDENT_MASK, NOTE, PREPARED, REMOTE, SEEDS
from hil.calibrate.lock import Lock
from hil.calibrate.memory import Memory
from hil.calibrate.slave import Slave
from hil.loop.node import Node

__all__ = ["MASTER", "SLAVE", "Attended", "Service", "XcpService", "replay_attended"]

MASTER, SLAVE = 0x6E0, 0x6E1  # CAN identifiers of XCP: commands, answers with measurements
MOST_WORK = 8  # before one tick, of all services together: a command of XCP is 1
HEAVY = (0xDD, 0xDE, 0xE4, 0xEB)  # starts or selects lists, copies or switches a page: a tick's work
MOST_WAITING = 256  # commands kept, and answers beyond which no further command is carried out
MOST_ANSWERS = 4  # sent after one tick: about what the bus carries
_KIND = EXTENDED | REMOTE | ERROR | FD | NOTE
NOTHING = np.zeros((0, 2), np.int64)


class Service(Protocol):
    """What attends to a node: an XCP slave, a UDS server."""

    name: str
    idents: tuple[int, ...]

    @property
    def lock(self) -> Lock:
        """Its seed and key."""

    @property
    def counts(self) -> dict[str, int]:
        """What it has lost, by name."""

    @property
    def memory(self) -> Memory:
        """The node's memory, of all its services the same."""

    def hear(self, ident: int, data: bytes) -> None:
        """Take a frame under one of ``idents``."""

    def change(self, k: int, rows: np.ndarray, n: int) -> tuple[np.ndarray, int]:
        """Return what the node gets in place of the first ``n`` rows at tick ``k``."""

    def before(self, k: int) -> None:
        """What time brings before tick ``k``."""

    def work(self) -> int:
        """Work on the frame that has waited longest; return how much work that was, 0: none waits, or it must wait."""

    def after(self, k: int) -> np.ndarray | None:
        """Return frames (int64[n, 2]) to send after tick ``k``."""

    @property
    def silent(self) -> bool:
        """Whether the node must not send its own frames."""


def row_of(ident: int, data: bytes) -> tuple[int, int]:
    """Return a frame of up to eight bytes as a row."""
    return ident | len(data) << 32, int.from_bytes(data.ljust(8, b"\0"), "little", signed=True)


def data_of(head: int, data: int) -> bytes:
    """Return the data of a row: `row_of` the other way round."""
    return data.to_bytes(8, "little", signed=True)[: head >> 32 & 0xFF]


class XcpService:
    """An XCP slave on CAN.

    dropped  commands that came faster than they could be carried out
    """

    name = "xcp"
    idents: tuple[int, ...] = (MASTER,)
    silent = False

    def __init__(self, slave: Slave):
        self.slave = slave
        self.dropped = 0
        self._in: deque[bytes] = deque(maxlen=MOST_WAITING)
        self._out: deque[bytes] = deque()

    @property
    def lock(self) -> Lock:
        """The slave's seed and key."""
        return self.slave.lock

    @property
    def counts(self) -> dict[str, int]:
        """Frames of the tool that were dropped."""
        return {"dropped": self.dropped}

    @property
    def memory(self) -> Memory:
        """What the slave shows."""
        return self.slave.memory

    def hear(self, ident: int, data: bytes) -> None:
        """Keep a command for the next tick."""
        self.dropped += len(self._in) == MOST_WAITING  # the oldest goes
        self._in.append(data)

    def change(self, k: int, rows: np.ndarray, n: int) -> tuple[np.ndarray, int]:
        """Put what a tool gives in place of the ECU's demand into its frames."""
        return self.slave.daq.stimulus.change(k, rows, n)

    def before(self, k: int) -> None:
        """Take the answers that have come late."""
        self.slave.k = k
        self._out += self.slave.late()

    def work(self) -> int:
        """Carry out a command; a tool that floods the slave waits for its answers."""
        if not self._in or self.slave.waiting or len(self._out) > MOST_WAITING:
            return 0
        command = self._in.popleft()
        self._out += self.slave.command(command)
        return MOST_WORK if command[:1] and command[0] in HEAVY else 1

    def after(self, k: int) -> np.ndarray | None:
        """Return answers and measurements."""
        slave = self.slave
        measured = slave.sample(k)
        self._out += slave.late()
        if not self._out and not len(measured):
            return None
        answers = [row_of(slave.ident, self._out.popleft()) for _ in range(min(MOST_ANSWERS, len(self._out)))]
        return np.concatenate([np.array(answers, np.int64).reshape(len(answers), 2), measured])


class Attended:
    """A node whose frames of service are answered by ``services``; for `run_realtime` it is a node like any other.

    told  a tick's frames say when work that was prepared takes effect: in real time (`heed`), and in a record of it.
          False: with the tick after it was asked for
    worked  work on tools' frames before the last tick; the last one may go beyond `MOST_WORK`
    """

    def __init__(self, node: Node, *services: Service, told: bool = False):
        self.node, self.services, self.told = node, services, told
        self.desk = services[0].memory.desk
        self._by_ident = {ident: s for s in services for ident in s.idents}
        self._seeds_noted = False
        self.worked = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self.node, name)

    def heed(self, rows: np.ndarray, n: int) -> int:
        """Put notes behind the ``n`` frames of the next tick: once from which number the seeds follow, and where work
        is done; return how many rows there are.
        """
        if not self._seeds_noted and n < len(rows):
            self._seeds_noted = True
            rows[n] = SEEDS, self.services[0].lock.number
            n += 1
        number = self.desk.note() if n < len(rows) else 0
        if number:
            rows[n] = PREPARED, number
        return n + (number > 0)

    def tick(self, received: np.ndarray, n: int | None = None) -> np.ndarray:
        """Run the next tick on the first ``n`` rows of ``received``; return the frames to send."""
        n = len(received) if n is None else n
        k = self.node.k
        theirs = []  # frames that are not for the firmware
        noted = 0 if self.told else self.desk.note()
        for i, (head, data) in enumerate(received[:n].tolist()):
            if head == PREPARED:
                theirs.append(i)
                noted = data
            elif head == SEEDS:
                theirs.append(i)
                for each in self.services:
                    each.lock.number = data
            elif (service := self._by_ident.get(head & IDENT_MASK)) is not None:
                theirs.append(i)
                if head & _KIND == 0:
                    service.hear(head & IDENT_MASK, data_of(head, data))
        self.desk.before(k, noted)
        for service in self.services:
            service.before(k)
        self._work()
        rows = np.delete(received[:n], theirs, axis=0) if theirs else received
        n -= len(theirs)
        for service in self.services:
            rows, n = service.change(k, rows, n)
        out = self.node.tick(rows, n)
        if any(service.silent for service in self.services):
            out = NOTHING
        more = [sent for service in self.services if (sent := service.after(k)) is not None]
        return np.concatenate([out, *more]) if more else out

    def _work(self) -> None:
        """Work on the tools' frames, one of each service in turn, until a tick's work is done."""
        self.worked, waiting = 0, deque(self.services)
        while waiting and self.worked < MOST_WORK:
            if done := waiting[0].work():
                self.worked += done
                waiting.rotate(-1)
            else:
                waiting.popleft()

    @property
    def lost(self) -> dict[str, dict[str, int]]:
        """What each service has lost, because more came than a tick has time for."""
        return {service.name: service.counts for service in self.services}


def replay_attended(node: Attended, at: np.ndarray, received: np.ndarray, ticks: int) -> tuple[np.ndarray, np.ndarray]:
    """Run ``node`` for ``ticks`` ticks on recorded frames, commands of its tools included, as `hil.loop.node.replay`
    does.
    """
    first = 0
    ticks_of, sent = [], []
    for k in range(ticks):
        last = int(np.searchsorted(at, k, side="right"))
        out = node.tick(np.ascontiguousarray(received[first:last]))
        first = last
        sent.append(out.copy())
        ticks_of.append(np.full(len(out), k, np.int64))
    return np.concatenate(ticks_of or [np.empty(0, np.int64)]), np.concatenate(sent or [np.empty((0, 2), np.int64)])
