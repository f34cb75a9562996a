"""The bus: the loop with every CAN frame in lockstep, the decoding of whole logs, the embedded bus."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.measure import Row
from benchmarks.ours import profile
from vaneloop.base import tables

__all__ = ["MEASUREMENTS"]

LONG = 200.0  # s simulated
FRAMES = 1_000_000
SAMPLE = 50_000  # frames that cantools decodes at a time


def lockstep_with_frames() -> Iterator[Row]:
    """Controller, plant and ECU with every frame encoded, arbitrated bit by bit, decoded and checked, against the
    clock.
    """
    from hil.bus.lockstep_bus import run_lockstep

    run_lockstep(profile(1.0), seed=1)
    walls, cpu = [], []
    for _ in range(5):
        started = time.process_time()
        run = run_lockstep(profile(LONG), seed=1)
        cpu.append(time.process_time() - started)
        walls.append(run.wall_s)
    speed = LONG / min(cpu)
    heard = run.vgv.counts["good"] + int(run.ecu.arrays.receiver[:, 0].sum())
    # of the last round some are still on the wire, and each receiver's first only shows the counter
    whole = run.frames == len(run.rows) and run.frames - 10 <= heard <= run.frames and run.vgv.mode == "RUN"
    note = (
        f"{run.frames:,} frames kept, noisy sensors, wire busy {run.load:.1%}; on the wall clock "
        f"{LONG / min(walls):,.0f} s/s"
    )
    yield Row(
        "lockstep with all CAN frames",
        f"{speed:,.0f} s/s",
        "real time 1 s/s",
        speed,
        ">= 300",
        bool(speed >= 300 and whole),
        note,
    )


def decoding() -> Iterator[Row]:
    """A log of a million frames: every signal of every frame, E2E checked by us, against cantools frame by frame."""
    import can
    import cantools

    from hil.bus.lockstep_bus import run_lockstep
    from hil.logs.candump import read_candump, write_candump
    from hil.logs.dbc import load_dbc
    from hil.logs.frames import Frames
    from hil.logs.signals import cut_signal, select

    run = run_lockstep(profile(FRAMES / 410 + 1.0), seed=1)
    rows = run.rows[:FRAMES]
    ident = (rows[:, 0] & 0x7FF).astype(np.uint32)
    data = np.ascontiguousarray(rows[:, 1]).view(np.uint8).reshape(-1, 8)
    n = len(rows)
    log = Frames(run.t[:n], ident, np.zeros(n, np.int32), np.full(n, 8, np.uint8), data)
    messages = load_dbc(tables.path("vgv.dbc"))[0]
    db: Any = cantools.database.load_file(tables.path("vgv.dbc"))

    def ours(frames: Frames) -> dict[tuple[int, str], tuple[np.ndarray, np.ndarray]]:
        out = {}
        for message in messages:
            which, _ = select(frames, message)
            for signal in message.layout.signals:
                out[message.ident, signal.name] = cut_signal(frames, which, message, signal)[:2]
        return out

    def theirs(start: int) -> list[dict[str, Any]]:
        pairs = zip(
            ident[start : start + SAMPLE].tolist(), [d.tobytes() for d in data[start : start + SAMPLE]], strict=True
        )
        return [db.decode_message(i, d, decode_choices=False) for i, d in pairs]

    ours(log)
    best, peer, decoded = float("inf"), 0.0, []
    for start in range(0, n, SAMPLE):
        decoded += theirs(start)
    for _ in range(5):
        started = time.process_time()
        columns = ours(log)
        best = min(best, time.process_time() - started)
        part = float("inf")
        for start in range(0, 4 * SAMPLE, SAMPLE):
            started = time.process_time()
            theirs(start)
            part = min(part, time.process_time() - started)
        peer = min(peer or float("inf"), part * n / SAMPLE)
    seen = 0
    equal = True
    for (_, name), (which, values) in columns.items():
        equal &= np.array_equal(values, np.array([decoded[k][name] for k in which.tolist()], float))
        seen += len(values)
    equal &= seen == sum(len(d) for d in decoded)
    ratio = peer / best
    note = f"{n:,} frames, {seen:,} values, {'all equal' if equal else 'THEY DIFFER'}; ours checks E2E as well"
    rate, peer_rate = f"{n / best / 1e6:,.1f} M frames/s", f"{n / peer / 1e6:,.2f} M frames/s"
    yield Row("decoding a log, cantools", rate, peer_rate, ratio, ">= 50", bool(ratio >= 50 and equal), note)

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "long.log")
        write_candump(path, log)
        mine = other = float("inf")
        for _ in range(3):
            started = time.process_time()
            ours(read_candump(path))
            mine = min(mine, time.process_time() - started)
        part = Path(folder, "part.log")
        with path.open("rb") as whole:
            part.write_bytes(b"".join(whole.readline() for _ in range(SAMPLE)))
        for _ in range(3):
            started = time.process_time()
            for m in can.LogReader(part):
                db.decode_message(m.arbitration_id, m.data, decode_choices=False)
            other = min(other, (time.process_time() - started) * n / SAMPLE)
    yield Row(
        "same from a candump file, python-can and cantools",
        f"{n / mine / 1e6:,.1f} M frames/s",
        f"{n / other / 1e6:,.2f} M frames/s",
        other / mine,
    )


def embedded_bus() -> Iterator[Row]:
    """The embedded bus between processes: time from one participant to another, and frames a second."""
    from hil.bus.port import Port, open_bus

    name = f"local:bench-{os.getpid()}"
    a, b = open_bus(name), open_bus(name)
    try:
        one, two = Port(a), Port(b)
        row, got = np.array([[8 << 32 | 0x0A0, 1]], np.int64), np.zeros((4096, 2), np.int64)
        late = []
        for _ in range(500):
            started = time.perf_counter()
            one.write(row)
            while not two.read(got):
                pass
            late.append(time.perf_counter() - started)
            time.sleep(0.001)
        p50, p99 = np.percentile(late, [50, 99]) * 1e6
        yield Row("embedded bus, one frame", f"{p50:,.0f} us", note=f"p99 {p99:,.0f} us, busy reader")
        n, heard = 50_000, 0
        rows = np.repeat(row, 100, axis=0)
        started = time.perf_counter()
        for _ in range(n // 100):
            one.write(rows)
            heard += two.read(got)
        while heard < n - one.refused and time.perf_counter() - started < 30.0:
            heard += two.read(got)
        wall = time.perf_counter() - started
        missing = n - one.refused - heard - two.lost
        note = (
            f"{one.refused:,} refused (told to the sender), {two.lost:,} told to the reader as lost, {missing:,} "
            f"lost silently"
        )
        yield Row(
            "embedded bus, flood", f"{heard / wall:,.0f} frames/s", target="none silently", held=missing == 0, note=note
        )
    finally:
        a.shutdown()
        b.shutdown()


MEASUREMENTS: dict[str, Callable[[], Iterator[Row]]] = {
    "the loop with every CAN frame": lockstep_with_frames,
    "decoding of logs": decoding,
    "the embedded bus": embedded_bus,
}
