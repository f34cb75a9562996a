"""The UDS server on CAN: ISO-TP (ISO 15765-2, by can-isotp) in simulated time, and what it may do to the frames."""

from __future__ import annotations

import logging
from collections import deque
from typing import Any

import isotp
import numpy as np
from isotp.tools import Timer

from hil.calibrate.lock import Lock
from hil.calibrate.memory import Memory
from hil.calibrate.station import row_of
from hil.uds.server import FUNCTIONAL, MOST_REQUEST, REQUEST, RESPONSE, Server

__all__ = ["FUNCTIONAL", "REQUEST", "RESPONSE", "UdsService"]

MOST_WAITING = 64  # frames kept, and frames to send beyond which no further one is worked on
MOST_ANSWERS = 16  # kept while the tool does not take the ones before
WORK = 2  # of a tick's work (`hil.calibrate.station.MOST_WORK`), a frame with its request
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


class _Pause(_Ticks):
    """The pause between two frames of an answer; it lasts while a tick has as many to send as it may."""

    def is_timed_out(self) -> bool:
        return len(self._service._out) < MOST_SENT and bool(super().is_timed_out())


class _Transport(isotp.TransportLayerLogic):
    """ISO-TP whose timers count ticks."""

    def __init__(self, service: UdsService, **options: Any):
        self._service = service
        super().__init__(**options)
        self.timer_tx_stmin = _Pause(0, service)

    def _start_rx_fc_timer(self) -> None:
        self.timer_rx_fc = _Ticks(1.0, self._service)
        self.timer_rx_fc.start()

    def _start_rx_cf_timer(self) -> None:
        self.timer_rx_cf = _Ticks(1.0, self._service)
        self.timer_rx_cf.start()


class UdsService:
    """A UDS server behind ISO-TP; requests to all nodes (functional) are single frames.

    dropped  frames that came faster than they could be worked on;  untaken  answers that the tool did not take in time
    """

    name = "uds"
    idents: tuple[int, ...] = (REQUEST, FUNCTIONAL)

    def __init__(self, server: Server):
        self.server, self.k = server, 0
        self._in: deque[tuple[int, bytes]] = deque(maxlen=MOST_WAITING)
        self._out: deque[tuple[int, int]] = deque()
        self._now: isotp.CanMessage | None = None
        self.dropped = self.untaken = 0
        self._transport = _Transport(
            self,
            rxfn=self._take,
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
    def lock(self) -> Lock:
        """The server's seed and key."""
        return self.server.lock

    @property
    def counts(self) -> dict[str, int]:
        """Frames of the tool that were dropped, and answers that it did not take."""
        return {"dropped": self.dropped, "untaken": self.untaken}

    @property
    def memory(self) -> Memory:
        """The node's memory."""
        return self.server.memory

    def hear(self, ident: int, data: bytes) -> None:
        """Keep a frame for the next tick."""
        self.dropped += len(self._in) == MOST_WAITING  # the oldest goes
        self._in.append((ident, data))

    def _take(self, timeout: float) -> isotp.CanMessage | None:
        """The frame that is worked on, once."""
        frame, self._now = self._now, None
        return frame

    def change(self, k: int, rows: np.ndarray, n: int) -> tuple[np.ndarray, int]:
        """Do what the requests and the time have brought; put a routine's demand into the ECU's frames."""
        self._answer(self.server.before(k))
        if self.server.sweep is not None:
            rows = self.server.sweep.replace(k, rows[:n])
        return rows, n

    def before(self, k: int) -> None:
        """Go on with an answer, look at the transport's times."""
        self.k = k
        if self._transport.transmitting() or self._transport.is_rx_active():
            self._transport.process()

    def work(self) -> int:
        """Work on a frame, and carry out the request that is whole with it; a tool that floods waits for answers."""
        if not self._in or len(self._out) >= MOST_WAITING:
            return 0
        ident, data = self._in.popleft()
        if ident == FUNCTIONAL:
            if data and 1 <= data[0] <= 7 and len(data) > data[0]:
                self._answer(self.server.request(self.k, data[1 : 1 + data[0]], functional=True))
            return WORK
        self._now = isotp.CanMessage(arbitration_id=ident, data=data, dlc=len(data))
        self._transport.process()
        while (whole := self._transport.recv()) is not None:
            self._answer(self.server.request(self.k, bytes(whole)))
        return WORK

    def _answer(self, answers: list[bytes]) -> None:
        for answer in answers:
            if self._transport.tx_queue.qsize() >= MOST_ANSWERS:  # the oldest goes
                self._transport.tx_queue.get_nowait()
                self.untaken += 1
            self._transport.send(answer)
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
