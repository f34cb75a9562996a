"""The safety campaign for the tools' protocols: hostile commands of XCP or UDS against a controller in simulated time,
or sequences of both (`hil.inject.tool_rules`).

In every tick: current and stroke demand within their limits and the current's within the reference page's, a mode that
exists, the monitors as they were while the loop is closed, memory of the services and their work bounded, no silence
while the loop is closed. Without a key nothing is changed at all. At the end of each episode
the tool is gone, and with the calibration of the beginning good frames of the ECU must have RUN back. Over all episodes
the process does not grow.
"""

from __future__ import annotations

import contextlib
import resource
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from controller import MODES
from controller.records import INIT, STANDBY
from hil.calibrate.memory import CALIBRATION, Memory
from hil.calibrate.slave import Slave, key_of
from hil.calibrate.station import MASTER, MOST_WAITING, MOST_WORK, Attended, XcpService, data_of, row_of
from hil.inject.tool_rules import Tool, in_frames, rules_of
from hil.loop.node import Ecu, Node
from hil.uds.server import FUNCTIONAL, REQUEST, Server
from hil.uds.server import key_of as uds_key

__all__ = ["ToolCampaign", "fuzz_tools"]

EPISODE = 5_000  # frames on one controller
# ticks within which RUN must be back: the session's end after 5 s, then the firmware's own times
RECOVERY = 8_000
SETTLED = 4  # episodes after which the process has loaded all that it needs
MOST_GROWTH = 64.0  # MB after them: caches of numba and of the allocator; a leak grows without end
MOST_HELD = 4 * MOST_WAITING  # commands, answers and frames that services may keep


@dataclass
class ToolCampaign:
    """What a campaign saw.

    grown    MB by which the process has grown since its first episodes
    failure  what did not hold, with seed, episode and frame; empty: everything held
    sent     of the episode that failed: tick and frame, in order
    """

    protocol: str
    seed: int
    frames: int = 0
    episodes: int = 0
    ticks: int = 0
    answers: dict[str, int] = field(default_factory=dict)
    grown: float = 0.0
    failure: str = ""
    sent: list[tuple[int, tuple[int, int]]] = field(default_factory=list)


class _Target:
    """A controller with one service, its ECU, and what must hold of it."""

    def __init__(self, protocol: str, seed: int, request: int, limits: np.ndarray):
        self.limits = limits
        self.sent_to: list[tuple[int, tuple[int, int]]] = []
        self.node = Node()
        self.memory = Memory(self.node)
        self.reference = self.memory.pages[1].copy()
        self.guarded = np.array([i for i, e in enumerate(self.memory.elements) if e.guarded])
        self.limit = self.memory.by_name()["current_limit"]
        self.protocol = protocol
        self.keys = protocol != "both" or seed % 2 == 0  # whether a right key may come
        self.services: list[Any] = []
        if protocol != "uds":
            locked = ("cal", "stim") if protocol == "both" else ("cal",) if seed % 3 == 0 else ()
            self.slave = Slave(self.memory, seed=seed, locked=locked)
            self.services.append(XcpService(self.slave))
        if protocol != "xcp":
            self.server = Server(self.memory, seed=seed)
            from hil.uds.station import UdsService  # the extra `diagnostics`

            self.services.append(UdsService(self.server))
        self.service = self.services[0]
        self.attended = Attended(self.node, *self.services)
        self.ecu = Ecu(n_dem=70.0)
        self.ecu.set_demand(70.0, mode_request=request)
        self.away = 0  # ticks for which the ECU is not heard
        self.sent = np.zeros((0, 2), np.int64)
        self.before = self.memory.live()

    def flash(self) -> None:
        """Put the calibration back that it began with: a tool may set monitors in STANDBY so that none lets RUN be."""
        self.memory._load(self.reference, np.arange(len(self.reference)))
        self.before = self.memory.live()

    @property
    def given(self) -> bool:
        """Whether a tool still gives the demand: by STIM, by a routine."""
        stim = self.protocol != "uds" and self.slave.daq.stimulus.given
        return bool(stim or (self.protocol != "xcp" and self.server.sweep))

    @property
    def busy(self) -> bool:
        """Whether frames of the tool still wait."""
        return any(service._in for service in self.services) or self.memory.desk.waiting

    def tick(self, frames: list[tuple[int, bytes]]) -> list[bytes]:
        """Run a tick; raise AssertionError in words for what does not hold."""
        closed = int(self.node.loop.given.mode) not in (INIT, STANDBY)
        mine = [row_of(i, d) for i, d in frames]
        self.sent_to += [(self.node.k, row) for row in mine]
        demand = self.ecu.tick(self.sent).tolist()
        rows = [*(demand if self.away <= 0 else []), *mine]
        self.away -= 1
        out = self.attended.tick(np.array(rows, np.int64).reshape(-1, 2))
        ours = out[:, 0] & 0x7FF < 0x100
        self.sent = out[ours].copy()
        loop = self.node.loop
        limit = float(loop.calibration.scalars.current_limit)
        given = loop.given
        mode = int(given.mode)
        if not abs(float(given.i_cmd)) <= limit + 1e-12:
            raise AssertionError(f"current (={given.i_cmd:g} A) beyond its limit (={limit:g} A)")
        for what, value, most in zip(
            ("current", "stroke demand"), (abs(given.i_cmd), given.x_dem), self.limits, strict=True
        ):
            if not value <= most + 1e-12:
                raise AssertionError(f"{what} (={value:g}) beyond the limit asked for (={most:g})")
        if not limit <= self.reference[self.limit]:
            raise AssertionError(f"current_limit (={limit:g} A) above the reference page's")
        if not 0 <= mode < len(MODES):
            raise AssertionError(f"mode (={given.mode:g}) does not exist")
        now = self.memory.live()
        if closed and (now[self.guarded] != self.before[self.guarded]).any():
            raise AssertionError("a limit or a monitor was changed while the loop was closed")
        self.before = now
        held = sum(len(getattr(service, name)) for service in self.services for name in ("_in", "_out"))
        if self.protocol != "xcp":
            transport = self.services[-1]._transport
            held += transport.tx_queue.qsize() + transport.rx_queue.qsize()
        if held > MOST_HELD:
            raise AssertionError(f"{held} frames are kept")
        if self.attended.worked >= 2 * MOST_WORK:
            raise AssertionError(f"{self.attended.worked} frames' work in one tick")
        if self.protocol != "xcp":
            if mode not in (INIT, STANDBY) and self.node.k % 10 == 1 and not ours.any():
                raise AssertionError(f"no frame was sent in {MODES[mode]}")
            server, slave = self.server, getattr(self, "slave", None)
            if not self.keys and (
                (now != self.reference).any() or server.silent or server.sweep or server.trouble.texts
                or not server.trouble.on or server._reset_again or (slave and slave.daq.stimulus.given)
            ):  # fmt: skip
                raise AssertionError("something was changed without a key")
        return [data_of(h, d) for h, d in out[~ours].tolist()]


def _xcp(rng: np.random.Generator, target: _Target, last: bytes) -> list[tuple[int, bytes]]:
    raw = bytearray(rng.integers(0, 256, rng.integers(1, 9), dtype=np.uint8).tobytes())
    kind = rng.integers(0, 10)
    if kind < 6:
        raw[0] = int(rng.choice(list(target.slave._commands)))
    if kind in (1, 2, 3) and len(raw) == 8:  # somewhere in memory
        base = (CALIBRATION, CALIBRATION, 0x10000000, 0x12000000)[int(rng.integers(0, 4))]
        raw[0], raw[3] = 0xF6, int(rng.integers(0, 2))
        raw[4:8] = struct.pack("<I", base + int(rng.integers(0, 4500)) // 4 * 4)
    elif kind == 4:  # a plausible number
        at = int(rng.integers(0, len(target.memory.elements)))
        e = target.memory.elements[at]
        value = struct.pack("<f", rng.uniform(e.low, e.high))
        return [(MASTER, struct.pack("<BBBBI", 0xF6, 0, 0, 1, CALIBRATION + 4 * at)), (MASTER, b"\xf0\x04" + value)]
    elif kind == 5 and last[:2] == b"\xff\x06":
        return [(MASTER, b"\xf7\x06" + key_of("cal", last[2:]))]
    if not target.slave.connected:
        return [(MASTER, b"\xff\x00"), (MASTER, bytes(raw))]
    return [(MASTER, bytes(raw))]


def _uds(rng: np.random.Generator, target: _Target, last: bytes) -> list[tuple[int, bytes]]:
    ident = REQUEST if rng.random() < 0.9 else FUNCTIONAL
    raw = bytearray(rng.integers(0, 256, rng.integers(1, 8), dtype=np.uint8).tobytes())
    kind = rng.integers(0, 10)
    if kind < 5:
        raw[0] = int(rng.choice(list(target.server._services)))
        if len(raw) > 1 and kind < 3:
            raw[1] = int(rng.integers(0, 8))
        if raw[0] == 0x31 and len(raw) > 3:
            raw[2:4] = bytes([2, int(rng.integers(0, 5))])
    elif kind == 5:
        raw = bytearray([0x10, int(rng.choice([1, 2, 3, 3]))])
    elif kind == 6 and target.server._seed is not None:
        return in_frames(REQUEST, b"\x27\x02" + uds_key(target.server._seed))
    elif kind == 7:  # pieces of ISO-TP in any order
        return [(REQUEST, bytes([int(rng.choice([0x10, 0x20, 0x21, 0x30, 0x31]))]) + bytes(raw))]
    elif kind == 8:
        long = bytearray(rng.integers(0, 256, rng.integers(8, 100), dtype=np.uint8).tobytes())
        long[0] = int(rng.choice([*target.server._services, long[0]]))
        return in_frames(REQUEST, bytes(long))
    return [(ident, bytes([len(raw)]) + bytes(raw))]


def _both(rng: np.random.Generator, target: _Target, last: bytes) -> list[tuple[int, bytes]]:
    if not rng.integers(0, 60):  # the ECU asks for RUN or not, or is not there for a while
        target.ecu.set_demand(70.0, mode_request=int(rng.integers(0, 2)))
        target.away = int(rng.choice([0, 0, 0, 30, 1200]))
    if not rng.integers(0, 300):  # nobody sends: a check is done, a fault heals, a session ends
        for _ in range(int(rng.choice([100, 300, 5200], p=[0.7, 0.27, 0.03]))):
            target.tick([])
    if rng.integers(0, 2):  # an answer is waited for
        return []
    return rules_of(Tool(rng, target.slave, target.server, uds_key, target.keys))


def _resident() -> float:
    """The most memory that this process has had, MB.

    ``ru_maxrss`` counts what it was started from, too: a small program's growth would not show.
    """
    with contextlib.suppress(OSError, ValueError, StopIteration):  # not on macOS
        told = Path("/proc/self/status").read_text()
        return int(next(line for line in told.splitlines() if line.startswith("VmHWM:")).split()[1]) / 1024.0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def fuzz_tools(
    protocol: str,
    frames: int,
    seed: int,
    progress: Callable[[float], None] | None = None,
    *,
    limits: np.ndarray,
    recovery: int = RECOVERY,
) -> ToolCampaign:
    """Send hostile ``frames`` of ``protocol`` ("xcp", "uds", or "both": sequences by rules). The same seed gives the
    same frames.

    limits    what current (A) and stroke demand (m) must not exceed, beside the calibration's own limits; inf: nothing
    recovery  ticks within which RUN must be back
    """
    campaign = ToolCampaign(protocol, seed)
    make = {"xcp": _xcp, "uds": _uds, "both": _both}[protocol]
    settled = 0.0
    while campaign.frames < frames and not campaign.failure:
        rng = np.random.default_rng([seed, campaign.episodes])
        target = _Target(protocol, campaign.episodes, request=campaign.episodes % 2, limits=limits)
        campaign.episodes += 1
        n, end, last = 0, min(EPISODE, frames - campaign.frames), b""
        try:
            while n < end:
                some: list[tuple[int, bytes]] = []
                for _ in range(int(rng.choice([0, 1, 1, 2, 8]))):
                    some += make(rng, target, last)
                n += len(some)
                for answer in target.tick(some):
                    last = answer
                    name = answer[:2].hex() if answer[0] in (0xFE, 0xFD) else "answers"
                    campaign.answers[name] = campaign.answers.get(name, 0) + 1
                campaign.ticks += 1
            while target.busy:  # what was asked for last is done before the tool is gone
                target.tick([])
                campaign.ticks += 1
            target.flash()
            target.away = 0
            target.ecu.set_demand(70.0, mode_request=1)
            for _ in range(recovery):
                target.tick([])
                campaign.ticks += 1
                if target.node.mode == "RUN" and not target.given:  # by the ECU's own demand
                    break
            else:
                raise AssertionError(f"RUN is not back after {recovery * 1e-3:g} s: {target.node.mode}")
            if campaign.episodes <= SETTLED:
                settled = _resident()
            campaign.grown = _resident() - settled
            if not campaign.grown <= MOST_GROWTH:
                raise AssertionError(f"the process has grown by {campaign.grown:.0f} MB; allowed: {MOST_GROWTH:g} MB")
        except Exception as e:
            said = str(e) if isinstance(e, AssertionError) else f"{type(e).__name__}: {e}"
            campaign.failure = f"episode {campaign.episodes - 1}, frame {n}: {said}"
            campaign.sent = target.sent_to
        campaign.frames += n
        if progress is not None:
            progress(min(campaign.frames / frames, 1.0))
    return campaign
