"""A CAN bus in simulated time as a python-can interface, and the whole loop over it: controller, plant and ECU, frame
by frame, bit by bit.

`LockstepBus` joins a `Channel` of this process. Simulated time stands still until somebody moves it: `Channel.advance`,
or `recv` with a timeout, which lets it run until a frame comes or the (simulated) time is over. Nothing depends on the
machine's clock, so the same calls give the same frames at the same bit, always. `hil.bus.wire` says what is simulated.

`run_lockstep` is the fast way: both nodes and the wire in one compiled loop.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import can
import numpy as np
from can.broadcastmanager import CyclicSendTaskABC, ModifiableCyclicTaskABC, RestartableCyclicTaskABC

from hil.bus import wire as w
from hil.bus.frames import from_message, passes, to_message
from hil.bus.wire import BIT_RATE, BITS_PER_TICK, Wire, new_wire, put, run_wire, take
from hil.loop.node import MOST_SENT, Ecu, EcuArrays, Node, NodeArrays, ecu_tick, node_tick
from vaneloop.base.compiled import in_place

__all__ = ["BusRun", "Channel", "LockstepBus", "channel_of", "run_lockstep"]

NODES = 16
STATES = {w.ACTIVE: can.BusState.ACTIVE, w.PASSIVE: can.BusState.PASSIVE, w.BUS_OFF: can.BusState.ERROR}


class Channel:
    """One simulated wire with its participants.

    queue       frames a participant's transmit queue holds
    buffer      frames a participant's receive buffer holds
    error_rate  probability that a frame is destroyed on the wire; it is sent again
    loss        probability that one receiver misses a frame that went well
    seed        of the random numbers
    restart     participants come back from bus-off by themselves, after 128 times 11 recessive bits
    """

    def __init__(
        self,
        *,
        queue: int = 64,
        buffer: int = 4096,
        error_rate: float = 0.0,
        loss: float = 0.0,
        seed: int = 0,
        restart: bool = True,
    ):
        for name, value in (("error_rate", error_rate), ("loss", loss)):
            if not 0.0 <= value <= 1.0:
                raise ValueError(f"{name} (={value}) must be in [0, 1]")
        self.wire = new_wire(NODES, queue, buffer, error_rate, loss, seed, restart)
        self.tasks: list[_Task] = []

    def join(self, *, own: bool = False, errors: bool = True, silent: bool = False) -> int:
        """Take a free place on the wire; return its number. A silent participant only listens: it does not even
        acknowledge.
        """
        for j in range(NODES):
            node = self.wire.node[j]
            if not node[w.JOINED]:
                node[:] = 0
                node[w.JOINED], node[w.WANTS_OWN], node[w.WANTS_ERRORS], node[w.SILENT] = 1, own, errors, silent
                return j
        raise can.CanInitializationError(f"the lockstep bus has no place left for participant {NODES + 1}")

    def leave(self, j: int) -> None:
        """Give the place back."""
        self.wire.node[j, w.JOINED] = 0

    @property
    def now(self) -> float:
        """Simulated time, s."""
        return int(self.wire.clock[w.NOW]) / BIT_RATE

    @property
    def load(self) -> float:
        """Share of the time in which the wire was busy."""
        return float(self.wire.clock[w.BUSY] / max(self.wire.clock[w.NOW], self.wire.clock[w.FREE], 1))

    def advance(self, seconds: float, watch: int = -1) -> None:
        """Let simulated time run on by ``seconds``; with ``watch`` >= 0 no farther than until that participant has
        something to take.
        """
        self.advance_to(int(self.wire.clock[w.NOW]) + round(seconds * BIT_RATE), watch)

    def advance_to(self, bit: int, watch: int = -1) -> None:
        """The same up to the time ``bit`` (in bits)."""
        while True:
            task = min((t for t in self.tasks if t.active), key=lambda t: t.due, default=None)
            until = bit if task is None else min(bit, max(task.due, int(self.wire.clock[w.NOW])))
            run_wire(self.wire, until, watch)
            if task is None or task.due > bit or self.wire.clock[w.NOW] < until:
                return
            task.send()

    def idle(self) -> bool:
        """Return True if nothing will ever happen by itself: no frame waits, no periodic task runs, nobody recovers."""
        node = self.wire.node
        there = node[:, w.JOINED] == 1
        return (
            not any(t.active for t in self.tasks)
            and not (node[there, w.TX_N] > 0).any()
            and not (self.wire.clock[w.RESTART] and (node[there, w.MODE] == w.BUS_OFF).any())
        )

    def destroy(self, frames: int, *, node: int = -1, ident: int = -1) -> None:
        """Destroy the next ``frames`` frames, of participant ``node`` and with identifier ``ident`` only where these
        are given.
        """
        self.wire.clock[w.DESTROY], self.wire.clock[w.DESTROY_NODE], self.wire.clock[w.DESTROY_IDENT] = (
            frames,
            node,
            ident,
        )


_channels: dict[str, Channel] = {}


def channel_of(name: str = "lockstep") -> Channel:
    """Return the channel of that name in this process, made on first use; a name's last participant takes it along."""
    return _channels.setdefault(name, Channel())


class LockstepBus(can.BusABC):
    """A participant of a simulated wire.

    channel  a name (one wire per name and process) or a `Channel` made with options of its own
    receive_own_messages, can_filters  as everywhere in python-can; error frames pass all filters, as in SocketCAN
    receive_errors  error frames (SocketCAN's classes: 0x088 destroyed frame, 0x004 error passive or receive overflow,
                    0x040 bus-off, 0x100 back again)
    silent  listen only

    Timestamps and timeouts are simulated seconds. `send` queues a frame; where the queue is full it lets time run up to
    ``timeout`` (None: as long as it takes), then raises CanOperationError. ``lost`` counts frames for which the receive
    buffer had no room; in their place stands an error frame with their number (CAN_ERR_CRTL, data[1] = 1, data[4:8]).
    """

    def __init__(
        self,
        channel: Any = "lockstep",
        can_filters: Any = None,
        receive_own_messages: bool = False,
        receive_errors: bool = True,
        silent: bool = False,
        **kwargs: Any,
    ):
        self.name = channel if isinstance(channel, str) else None
        self.channel: Channel = channel_of(channel) if isinstance(channel, str) else channel
        self.channel_info = f"lockstep bus '{self.name or 'own'}'"
        self.place = self.channel.join(own=receive_own_messages, errors=receive_errors, silent=silent)
        self._row = np.zeros((1, 3), np.int64)
        super().__init__(channel=channel, can_filters=can_filters, **kwargs)

    def _count(self, which: int) -> int:
        return int(self.channel.wire.node[self.place, which])

    @property
    def lost(self) -> int:
        """Frames for which the receive buffer had no room."""
        return self._count(w.OVERRUN)

    @property
    def tec(self) -> int:
        """Transmit error counter."""
        return self._count(w.TEC)

    @property
    def rec(self) -> int:
        """Receive error counter."""
        return self._count(w.REC)

    @property
    def state(self) -> can.BusState:
        """ACTIVE, PASSIVE, or ERROR: bus-off."""
        return STATES[self._count(w.MODE)]

    @state.setter
    def state(self, new_state: can.BusState) -> None:
        if new_state is not can.BusState.ACTIVE:
            raise ValueError(f"state (={new_state}) can be set to ACTIVE only: back from bus-off at once")
        node = self.channel.wire.node[self.place]
        node[w.MODE], node[w.TEC], node[w.REC], node[w.TO_RECOVER] = w.ACTIVE, 0, 0, 0

    def _check(self) -> None:
        if self._is_shutdown:
            raise can.CanOperationError(f"{self.channel_info} is shut down")

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Queue a frame. CanOperationError: bus-off, queue full, CAN FD on this classic bus, an error frame."""
        self._check()
        if msg.is_fd or msg.is_error_frame:
            raise can.CanOperationError(f"{'CAN FD' if msg.is_fd else 'error'} frame: a classic CAN bus cannot send it")
        channel, node = self.channel, self.channel.wire.node[self.place]
        end = None if timeout is None else int(channel.wire.clock[w.NOW]) + round(timeout * BIT_RATE)
        head, data = from_message(msg)
        while not put(channel.wire, self.place, head, data):
            now = int(channel.wire.clock[w.NOW])
            if node[w.MODE] == w.BUS_OFF:
                raise can.CanOperationError("bus-off: the frame is refused")
            if node[w.SILENT]:
                raise can.CanOperationError("a silent participant cannot send")
            if end is not None and now >= end:
                raise can.CanOperationError(f"transmit queue full ({channel.wire.tx.shape[1]} frames)")
            node[w.REFUSED] -= 1  # not yet
            channel.advance_to(now + 50 if end is None else min(now + 50, end))

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """Return the next frame; simulated time runs on for it, by at most ``timeout`` s."""
        self._check()
        channel = self.channel
        end = None if timeout is None else int(channel.wire.clock[w.NOW]) + round(timeout * BIT_RATE)
        while True:
            while take(channel.wire, self.place, self._row):
                head, data, at = self._row[0].tolist()
                message = to_message(
                    head & ~w.OWN, data, at / BIT_RATE, self.name or "lockstep", is_rx=not head & w.OWN
                )
                if message.is_error_frame or self._matches_filters(message):
                    return message
            now = int(channel.wire.clock[w.NOW])
            if end is not None and now >= end:
                return None
            if end is None and channel.idle():
                raise can.CanOperationError("nothing can come: no node on the lockstep bus has anything to send")
            channel.advance_to(now + BIT_RATE if end is None else end, self.place)

    def read_rows(self, rows: np.ndarray) -> int:
        """Take what has come up to now and passes the filters into the first rows of ``rows`` (int64[n, 2]); return how
        many. Time does not move.
        """
        self._check()
        n = 0
        while taken := take(self.channel.wire, self.place, rows[n:]):
            new = rows[n : n + taken]
            new[:, 0] &= ~w.OWN
            passed = new[[passes(self.filters, head) for head in new[:, 0].tolist()]]
            rows[n : n + len(passed)] = passed
            n += len(passed)
        return n

    def write_rows(self, rows: np.ndarray) -> int:
        """Queue the frames; return how many were taken. Time does not move."""
        self._check()
        return sum(put(self.channel.wire, self.place, head, data) for head, data in rows.tolist())

    def _send_periodic_internal(
        self,
        msgs: Any,
        period: float,
        duration: float | None = None,
        autostart: bool = True,
        modifier_callback: Any = None,
    ) -> CyclicSendTaskABC:
        task = _Task(self, msgs, period, duration, modifier_callback)
        self.channel.tasks.append(task)
        if autostart:
            task.start()
        return task

    def flush_tx_buffer(self) -> None:
        """Forget what waits to be sent."""
        self.channel.wire.node[self.place, w.TX_N] = 0

    def shutdown(self) -> None:
        """Leave the bus."""
        if not self._is_shutdown:
            super().shutdown()
            self.channel.tasks = [t for t in self.channel.tasks if t.bus is not self]
            self.channel.leave(self.place)
            if self.name is not None and not self.channel.wire.node[:, w.JOINED].any():
                _channels.pop(self.name, None)


class _Task(ModifiableCyclicTaskABC, RestartableCyclicTaskABC):
    """Messages sent every ``period`` of simulated time."""

    def __init__(
        self,
        bus: LockstepBus,
        messages: Any,
        period: float,
        duration: float | None,
        modify: Callable[[can.Message], None] | None,
    ):
        if not period > 0:
            raise ValueError(f"period (={period}) must be greater than 0")
        super().__init__(messages, period)
        self.bus, self.modify = bus, modify
        self.step = max(round(period * BIT_RATE), 1)
        self.length = None if duration is None else round(duration * BIT_RATE)
        self.active, self.due, self.end, self.at = False, 0, 0, 0

    def start(self) -> None:
        """Send the first message now."""
        self.due = int(self.bus.channel.wire.clock[w.NOW])
        self.end = w.NEVER if self.length is None else self.due + self.length
        self.active = True

    def stop(self) -> None:
        """Send no more."""
        self.active = False

    def send(self) -> None:
        """Send the message that is due; a full queue loses it, as it does on a real bus."""
        if self.due >= self.end:
            self.active = False
            return
        message = self.messages[self.at]
        self.at = (self.at + 1) % len(self.messages)
        if self.modify is not None:
            self.modify(message)
        put(self.bus.channel.wire, self.bus.place, *from_message(message))
        self.due += self.step


# ---- the whole loop --------------------------------------------------------------------------------------------------


@in_place
def run_loop(
    k0: int,
    ticks: int,
    profile: np.ndarray,
    vgv: NodeArrays,
    vgv_noise: np.ndarray,
    vgv_row: int,
    ecu: EcuArrays,
    ecu_noise: np.ndarray,
    wire: Wire,
    at_vgv: int,
    at_ecu: int,
    received: np.ndarray,
    sent: np.ndarray,
    log: np.ndarray,
    logged: int,
    states: np.ndarray,
) -> int:
    """Run VGV node, ECU and wire for ``ticks`` ticks from tick ``k0``; return the number of rows written to ``log``.

    profile    float64[n, 3] what the ECU demands: n_dem, n_r (NaN = its engine), mode_request; a row every 10 ms, the
               last one held
    received   int64[m, 2], sent int64[4, 2] scratch
    log        int64[rows, 3] what participant ``logged`` hears (-1: nobody)
    states     float64[ticks or 0, n] the firmware's and the plant's state after each tick
    """
    rows = 0
    z, s = vgv.loop.z, vgv.loop.s
    n_z, n_s = z.shape[0], s.shape[0]
    for i in range(ticks):
        k = k0 + i
        frame = min(k // 10, profile.shape[0] - 1)
        for q in range(3):
            ecu.demand[q] = profile[frame, q]
        n = take(wire, at_ecu, received)
        for q in range(ecu_tick(k, received, n, ecu_noise[k // 10 % 10], ecu, sent)):
            put(wire, at_ecu, sent[q, 0], sent[q, 1])
        n = take(wire, at_vgv, received)
        for q in range(node_tick(k, received, n, vgv_noise, vgv_row + i, vgv, sent)):
            put(wire, at_vgv, sent[q, 0], sent[q, 1])
        run_wire(wire, (k + 1) * BITS_PER_TICK, -1)
        if logged >= 0:
            rows += take(wire, logged, log[rows:])
        if states.shape[0] > 0:
            for q in range(n_z):
                states[i, q] = z[q]
            for q in range(n_s):
                states[i, n_z + q] = s[q, 0]
    return rows


@dataclass(frozen=True)
class BusRun:
    """One run of the loop over the simulated bus.

    simulated_s, wall_s  s
    load        share of the time in which the wire was busy
    frames, error_frames  on the wire
    t, rows     float64[n] s and int64[n, 2]: every frame on the wire at its end, if they were kept
    state_hash  sha256 of every tick's state, if asked for
    """

    simulated_s: float
    wall_s: float
    load: float
    frames: int
    error_frames: int
    t: np.ndarray
    rows: np.ndarray
    state_hash: str
    vgv: Node
    ecu: Ecu


def run_lockstep(
    n_dem: np.ndarray,
    n_r: np.ndarray | None = None,
    *,
    vgv: Node | None = None,
    ecu: Ecu | None = None,
    channel: Channel | None = None,
    duration: float | None = None,
    seed: int | None = None,
    keep: bool = True,
    hashed: bool = False,
    progress: Callable[[float], None] | None = None,
) -> BusRun:
    """Run controller, plant and ECU over the simulated wire.

    n_dem, n_r  %, one row every 10 ms (n_r None or NaN = the ECU's engine model)
    vgv, ecu    nodes at their start; made with ``seed`` and the first demand where None
    channel     default: a wire without faults
    duration    s, default the length of ``n_dem``
    keep        keep every frame on the wire
    progress    called with the fraction done
    """
    n_dem = np.atleast_1d(np.asarray(n_dem, np.float64))
    profile = np.stack(
        [n_dem, np.broadcast_to(np.nan if n_r is None else n_r, n_dem.shape), np.ones(len(n_dem))], axis=1
    )
    vgv = vgv or Node(n_r=float(n_dem[0]), seed=seed)
    ecu = ecu or Ecu(n_dem=float(n_dem[0]), seed=None if seed is None else seed + 1)
    channel = channel or Channel()
    wire = channel.wire
    at_vgv, at_ecu = channel.join(errors=True), channel.join(errors=True)
    ears = channel.join(silent=True) if keep else -1
    ticks = round((duration if duration is not None else len(n_dem) * 0.01) * 1000)
    offset = int(wire.clock[w.NOW]) // BITS_PER_TICK
    if offset or vgv.k or ecu.k:
        raise ValueError("run_lockstep starts with nodes and a wire at tick 0")
    received, sent = np.zeros((256, 2), np.int64), np.zeros((MOST_SENT, 2), np.int64)
    log: list[np.ndarray] = []
    digest = hashlib.sha256()
    started = time.perf_counter()
    while vgv.k < ticks:
        noise, row = vgv.noise()
        n = min(len(noise) - row, ticks - vgv.k, vgv.stride)
        some = np.empty((16 * n if keep else 0, 3), np.int64)
        states = np.empty((n if hashed else 0, len(vgv.loop.z) + len(vgv.loop.s)))
        m = run_loop(
            vgv.k,
            n,
            profile,
            vgv.arrays,
            noise,
            row,
            ecu.arrays,
            ecu.noise(n),
            wire,
            at_vgv,
            at_ecu,
            received,
            sent,
            some,
            ears,
            states,
        )
        log.append(some[:m])
        if hashed:
            digest.update(memoryview(states))  # type: ignore[arg-type]
        vgv.k += n
        ecu.k += n
        vgv.moved()
        if progress is not None:
            progress(vgv.k / ticks)
    wall = time.perf_counter() - started
    rows = np.concatenate(log) if log else np.empty((0, 3), np.int64)
    clock = wire.clock
    return BusRun(
        ticks * 1e-3, wall, channel.load, int(clock[w.FRAMES]), int(clock[w.ERRORS]), rows[:, 2] / BIT_RATE,
        np.ascontiguousarray(rows[:, :2]), digest.hexdigest() if hashed else "", vgv, ecu,
    )  # fmt: skip
