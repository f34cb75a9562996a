"""The UDS server on CAN: ISO-TP (ISO 15765-2, by can-isotp) in simulated time, and what it may do to the frames."""

from __future__ import annotations

import logging
from collections import deque
from typing import Any

import isotp
import numpy as np
from isotp.tools import Timer

from hil.calibrate.memory import Memory
from hil.calibrate.station import row_of
from hil.uds.server import MOST_REQUEST, Server

__all__ = ["FUNCTIONAL", "REQUEST", "RESPONSE", "UdsService"]

REQUEST, RESPONSE, FUNCTIONAL = 0x7E0, 0x7E8, 0x7DF  # CAN identifiers
MOST_WAITING = 64  # frames kept for the next tick
MOST_ANSWERS = 16  # kept while the tool does not take the ones before
LOGGER = "hil.uds.isotp"  # can-isotp warns of every wrong frame; a flood of them must not cost a tick its time
logging.getLogger(LOGGER).setLevel(logging.CRITICAL)
MOST_SENT = 4  # frames sent after one tick


class _Ticks(Timer):
    """can-isotp's timer, in ticks of simulated time."""

    def __init__(self, timeout: float, service: UdsService):
        self._service = service
        super().__init__(timeout)

    def start(self, timeout: float | None = None) -> None:
        if timeout is not None:
            self.set_timeout(timeout)
        self.start_time = self._service.k

    def elapsed_ns(self) -> int:
        return 0 if self.start_time is None else (self._service.k - self.start_time) * 1_000_000


class _Transport(isotp.TransportLayerLogic):
    """ISO-TP whose timers count ticks."""

    def __init__(self, service: UdsService, **options: Any):
        self._service = service
        super().__init__(**options)
        self.timer_tx_stmin = _Ticks(0, service)

    def _start_rx_fc_timer(self) -> None:
        self.timer_rx_fc = _Ticks(1.0, self._service)
        self.timer_rx_fc.start()

    def _start_rx_cf_timer(self) -> None:
        self.timer_rx_cf = _Ticks(1.0, self._service)
        self.timer_rx_cf.start()


class UdsService:
    """A UDS server behind ISO-TP; requests to all nodes (functional) are single frames.

    dropped  answers that the tool did not take in time
    """

    idents: tuple[int, ...] = (REQUEST, FUNCTIONAL)

    def __init__(self, server: Server):
        self.server, self.k = server, 0
        self._in: deque[isotp.CanMessage] = deque()
        self._out: deque[tuple[int, int]] = deque()
        self._all: deque[bytes] = deque()
        self.dropped = 0
        self._transport = _Transport(
            self,
            rxfn=lambda: self._in.popleft() if self._in else None,
            txfn=lambda m: self._out.append(row_of(m.arbitration_id, bytes(m.data))),
            address=isotp.Address(isotp.AddressingMode.Normal_11bits, txid=RESPONSE, rxid=REQUEST),
            params={
                "max_frame_size": MOST_REQUEST,
                "blocksize": 8,
                "stmin": 1,
                "tx_padding": 0xCC,
                "logger_name": LOGGER,
            },
        )

    @property
    def memory(self) -> Memory:
        """The node's memory."""
        return self.server.memory

    def hear(self, ident: int, data: bytes) -> None:
        """Keep a frame for the next tick."""
        if ident == FUNCTIONAL:
            if data and 1 <= data[0] <= 7 and len(data) > data[0] and len(self._all) < MOST_WAITING:
                self._all.append(data[1 : 1 + data[0]])
        elif len(self._in) < MOST_WAITING:
            self._in.append(isotp.CanMessage(arbitration_id=ident, data=data, dlc=len(data)))

    def change(self, k: int, rows: np.ndarray, n: int) -> tuple[np.ndarray, int]:
        """Put a routine's demand into the ECU's frames."""
        if self.server.sweep is not None:
            rows = self.server.sweep.replace(k, rows[:n])
        return rows, n

    def before(self, k: int) -> None:
        """Take requests and answer them."""
        self.k = k
        if self._in or self._out or self._transport.transmitting() or self._transport.is_rx_active():
            self._transport.process()
        while self._all:
            self._answer(self.server.request(k, self._all.popleft(), functional=True))
        while (whole := self._transport.recv()) is not None:
            self._answer(self.server.request(k, bytes(whole)))
        self._answer(self.server.before(k))

    def _answer(self, answers: list[bytes]) -> None:
        for answer in answers:
            if self._transport.tx_queue.qsize() < MOST_ANSWERS:
                self._transport.send(answer)
            else:
                self.dropped += 1
        if answers:
            self._transport.process()

    def after(self, k: int) -> np.ndarray | None:
        """Look at the faults of the tick; return frames to send."""
        self.server.after(k)
        if not self._out:
            return None
        return np.array([self._out.popleft() for _ in range(min(MOST_SENT, len(self._out)))], np.int64)

    @property
    def silent(self) -> bool:
        """Whether the node must not send its own frames (0x28)."""
        return self.server.silent
