"""A connection for udsoncan whose bus is a node in lockstep: while its client waits, simulated time runs on."""

from __future__ import annotations

from typing import Any

import isotp
import numpy as np
from udsoncan.connections import BaseConnection
from udsoncan.exceptions import TimeoutException

from hil.calibrate import Attended, Memory
from hil.calibrate.station import row_of
from hil.loop.node import Ecu, Node
from hil.uds import Server, TroubleMemory
from hil.uds.station import REQUEST, RESPONSE, UdsService

NOTHING = np.zeros((0, 2), np.int64)


class Bench:
    """A node with a UDS server, and its ECU, tick by tick."""

    def __init__(self, trouble: TroubleMemory | None = None, request: int = 1, **options: Any):
        self.node = Node()
        self.memory = Memory(self.node)
        self.server = Server(self.memory, trouble, **options)
        self.service = UdsService(self.server)
        self.attended = Attended(self.node, self.service)
        self.ecu: Ecu | None = Ecu(n_dem=70.0)
        self.ecu.set_demand(70.0, mode_request=request)
        self.sent = NOTHING
        self.own = 0  # frames of the controller's own

    def tick(self, *frames: tuple[int, bytes]) -> list[bytes]:
        """Run a tick with these frames of a tool; return what the server sent."""
        rows = [row_of(i, d) for i, d in frames]
        if self.ecu is not None:
            rows = [*self.ecu.tick(self.sent).tolist(), *rows]
        out = self.attended.tick(np.array(rows, np.int64).reshape(-1, 2))
        mine = out[:, 0] & 0x7FF == RESPONSE
        self.sent = out[~mine].copy()
        self.own += len(self.sent)
        return [(d & (1 << 64) - 1).to_bytes(8, "little")[: h >> 32 & 15] for h, d in out[mine].tolist()]

    def run(self, ticks: int) -> Bench:
        """Run without a tool."""
        for _ in range(ticks):
            self.tick()
        return self

    def ask(self, request: str | bytes, ticks: int = 200) -> list[str]:
        """Answers to a request, straight at the server, while time runs."""
        raw = bytes.fromhex(request) if isinstance(request, str) else request
        out = self.server.request(self.node.k, raw)
        for _ in range(ticks if not out else 0):
            out += self.server.before(self.node.k)
            self.tick()
            if out and out[-1][0] != 0x7F:
                break
        return [a.hex(" ").upper() for a in out]


class Lockstep(BaseConnection):  # type: ignore[misc]
    """udsoncan's way to the bench, through ISO-TP on both sides."""

    def __init__(self, bench: Bench):
        super().__init__("lockstep")
        self.bench = bench
        self.inbox: list[bytes] = []
        self.outbox: list[tuple[int, bytes]] = []
        self.transport = isotp.TransportLayerLogic(
            rxfn=lambda: isotp.CanMessage(arbitration_id=RESPONSE, data=self.inbox.pop(0)) if self.inbox else None,
            txfn=lambda m: self.outbox.append((m.arbitration_id, bytes(m.data))),
            address=isotp.Address(isotp.AddressingMode.Normal_11bits, txid=REQUEST, rxid=RESPONSE),
            params={"override_receiver_stmin": 0.0},
        )

    def open(self) -> Lockstep:
        return self

    def close(self) -> None:
        """Nothing to close."""

    def is_open(self) -> bool:
        return True

    def empty_rxqueue(self) -> None:
        self.inbox.clear()

    def specific_send(self, payload: bytes) -> None:
        self.transport.send(payload)

    def specific_wait_frame(self, timeout: float | None = None) -> bytes:
        for _ in range(round((timeout or 1.0) * 1000)):
            self.transport.process()
            frames, self.outbox = self.outbox, []
            self.inbox += self.bench.tick(*frames)
            self.transport.process()
            if (whole := self.transport.recv()) is not None:
                return bytes(whole)
        raise TimeoutException("no answer")
