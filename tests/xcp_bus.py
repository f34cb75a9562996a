"""A CAN interface for pyxcp whose bus is a node in lockstep: where its master waits, simulated time runs on."""

from __future__ import annotations

import threading
from collections import deque
from typing import Any

import can
import numpy as np
from pyxcp.transport.can import CanInterfaceBase

from hil.calibrate.station import SLAVE, Attended, row_of
from hil.loop.node import Ecu


class Lockstep(CanInterfaceBase):  # type: ignore[misc]
    """The controller with its tools' services and the ECU, one tick after the other."""

    def __init__(self, node: Attended, ecu: Ecu):
        self.node, self.ecu = node, ecu
        self.came: deque[can.Message] = deque()
        self.todo: deque[tuple[int, int]] = deque()
        self.lock = threading.Lock()
        self.sent = np.zeros((0, 2), np.int64)

    def init(self) -> None:
        """Nothing to open."""

    def set_filters(self, filters: Any) -> None:
        """The slave's frames only, anyway."""

    @property
    def filters(self) -> Any:
        """None."""
        return None

    @property
    def state(self) -> Any:
        """Always well."""
        return can.BusState.ACTIVE

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Keep a frame for the next tick."""
        self.todo.append(row_of(msg.arbitration_id, bytes(msg.data)))

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """Return the next frame of the slave; without one, run a tick."""
        with self.lock:
            if not self.came:
                self.tick()
            return self.came.popleft() if self.came else None

    def tick(self) -> None:
        """Run one tick of the ECU and of the controller."""
        frames = [*self.ecu.tick(self.sent).tolist()]
        while self.todo:
            frames.append(self.todo.popleft())
        out = self.node.tick(np.array(frames, np.int64).reshape(-1, 2))
        own = out[:, 0] & 0x7FF == SLAVE
        self.sent = out[~own].copy()
        for head, data in out[own].tolist():
            raw = (data & 0xFFFF_FFFF_FFFF_FFFF).to_bytes(8, "little")[: head >> 32 & 15]
            self.came.append(
                can.Message(arbitration_id=SLAVE, data=raw, is_extended_id=False, timestamp=self.node.k * 1e-3)
            )
