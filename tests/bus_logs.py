"""Logs of a run on the bus, the ECU's frames at any phase of the controller's tick: as `vaneloop run --record` stamps
them, and as a logger on the wire does.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np

from hil.bus.lockstep_bus import Channel
from hil.bus.wire import BIT_RATE, BITS_PER_TICK, put, take
from hil.logs.formats import format_of
from hil.logs.frames import Frames
from hil.logs.recorder import Recorder
from hil.loop.ecu import builtin
from hil.loop.node import Ecu, Node, replay
from hil.loop.realtime import packed
from plant import Plant
from plant.model import Model

SLOW = 10  # ticks of a millisecond from frame to frame
NOBODY = np.zeros((0, 2), np.int64)
START = 1_700_000_000_000  # ms


@lru_cache(maxsize=16)
def ecu_frames(profile: str, seconds: float, seed: int) -> np.ndarray:
    """Frames that the ECU sends, one every 10 ms: int64[n, 2]."""
    demand = builtin(profile).per_frame()[: round(100 * seconds), 0]
    ecu = Ecu(n_dem=float(demand[0]), seed=seed + 1)
    out = np.empty((len(demand), 2), np.int64)
    for k, n_dem in enumerate(demand):
        ecu.set_demand(float(n_dem))
        out[k] = ecu.tick(NOBODY)[0]
        for _ in range(SLOW - 1):
            ecu.tick(NOBODY)
    return out


def with_effect(name: str, **parameters: float) -> Plant:
    """Return the plant with one effect of the library."""
    return Model(effects={name: parameters}).plant()


def by_ticks(
    path: Path,
    profile: str,
    phase: int,
    *,
    seconds: float = 30.0,
    seed: int = 1,
    plant: Plant | None = None,
    drift: float = 0.0,
) -> Path:
    """A record whose frames have the time of the tick in which the controller took or sent them; the ECU's come
    ``phase`` ms after its own, and later by the share ``drift`` of the time.
    """
    given = ecu_frames(profile, seconds, seed)
    k = np.arange(len(given))
    at, ticks = SLOW * k + phase + np.floor(SLOW * drift * k).astype(int), SLOW * len(given)
    node = Node(plant, n_r=builtin(profile).n_dem[0], seed=seed)
    sent_at, sent = replay(node, at, given, ticks)
    recorder = Recorder(path)
    for k in np.union1d(at, sent_at).tolist():
        if k < ticks:
            recorder.put(packed((START + k) * 10**6, given[at == k], sent[sent_at == k]))
    recorder.close()
    return path


def by_wire(
    path: Path, profile: str, phase: float, *, seconds: float = 30.0, seed: int = 1, plant: Plant | None = None
) -> Path:
    """A CAN log whose frames have the time of their last bit; the ECU puts its frame into the queue ``phase`` ms after
    the controller's tick.
    """
    given = ecu_frames(profile, seconds, seed)
    due = SLOW * BITS_PER_TICK * np.arange(len(given)) + round(phase * BITS_PER_TICK)
    node = Node(plant, n_r=builtin(profile).n_dem[0], seed=seed)
    channel = Channel()
    at_vgv, at_ecu, ears = channel.join(), channel.join(), channel.join(silent=True)
    got, heard, log, k = np.zeros((64, 2), np.int64), np.zeros((64, 3), np.int64), [], 0
    for tick in range(SLOW * len(given)):
        begin = tick * BITS_PER_TICK
        channel.advance_to(begin)
        n = take(channel.wire, at_vgv, got)
        for head, data in node.tick(got, n).tolist():
            put(channel.wire, at_vgv, head, data)
        while k < len(due) and due[k] < begin + BITS_PER_TICK:
            channel.advance_to(int(due[k]))
            put(channel.wire, at_ecu, *given[k].tolist())
            k += 1
        log.append(heard[: take(channel.wire, ears, heard)].copy())
    head, data, end = np.concatenate(log).T
    ident = (head & 0x7FF).astype(np.uint32)
    n = len(end)
    rows = Frames(
        end / BIT_RATE,
        ident,
        np.zeros(n, np.int32),
        np.full(n, 8, np.uint8),
        np.ascontiguousarray(data).view(np.uint8).reshape(n, 8),
    )
    write_frames(path, rows)
    return path


def write_frames(path: Path, frames: Frames) -> None:
    """Write frames as they are into a CAN log of any format."""
    format_of(path).write_frames(path, frames)
