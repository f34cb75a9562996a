"""What tools on the bus cost the controller: lateness of its ticks, and a tick's time, with a measurement at 1 ms."""

from __future__ import annotations

import json
import os
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import can
import numpy as np

from benchmarks.measure import ROOT, Row
from controller.records import STATE
from hil.bus.port import open_bus
from hil.calibrate import Attended, Memory, Slave
from hil.calibrate.station import MASTER, SLAVE, XcpService, row_of
from hil.loop.node import Node

__all__ = ["MEASUREMENTS"]

SECONDS = 15.0
SIGNALS = ("x_servo", "i_cmd", "x_meas")
LIMIT = 1.2


def commands() -> list[bytes]:
    """A list of three signals in single precision, every 1 ms, from CONNECT to its start: three frames a tick."""
    n = len(SIGNALS)
    out = [b"\xff\x00", b"\xd6", b"\xd5\x00\x01\x00", bytes([0xD4, 0, 0, 0, n])]
    out += [bytes([0xD3, 0, 0, 0, t, 1]) for t in range(n)]
    for t, name in enumerate(SIGNALS):
        out.append(bytes([0xE2, 0, 0, 0, t, 0]))
        out.append(struct.pack("<BBBBI", 0xE1, 0xFF, 4, 1, 0x12000000 + 4 * STATE.index(name)))
    return [*out, b"\xe0\x10\x00\x00\x00\x00\x01\x00", b"\xde\x01\x00\x00"]


def _late(channel: str, measured: bool, options: tuple[str, ...]) -> dict[str, float]:
    """Lateness of the installed command's ticks in `SECONDS` s, with a measurement running or without."""
    with tempfile.TemporaryDirectory(prefix="vaneloop-tools-") as folder:
        report = Path(folder) / "run.json"
        words = ["-m", "vaneloop", "run", "--bus", f"local:{channel}", "--xcp", "--duration", f"{SECONDS:g}", *options]
        run = subprocess.Popen(
            [sys.executable, *words, "--json", str(report)], stdout=subprocess.PIPE, text=True, cwd=ROOT
        )
        assert run.stdout is not None
        assert any("Ctrl-C" in line for line in run.stdout)
        bus = open_bus(f"local:{channel}", can_filters=[{"can_id": SLAVE, "can_mask": 0x7FF}])
        frames = 0
        try:
            for raw in commands() if measured else commands()[:1]:
                for _ in range(20):  # a loop that was held up drops what came meanwhile
                    bus.send(can.Message(arbitration_id=MASTER, data=raw, is_extended_id=False))
                    if bus.recv(0.5) is not None:
                        break
            while run.poll() is None:
                frames += bus.recv(0.2) is not None
        finally:
            bus.shutdown()
        assert frames > 100 or not measured, "the measurement does not run"
        return json.loads(report.read_text(encoding="utf-8"))["lateness"]


def lateness() -> Iterator[Row]:
    """Ticks of the command on the embedded bus; three runs each way, in turn, the best of each."""
    for words, options in (("SCHED_FIFO", ("--realtime-priority", "50")), ("ordinary scheduler", ())):
        runs = [
            [_late(f"bench{os.getpid()}", measured, options)["p99_us"] for measured in (False, True)]
            for _ in range(3 if not options or os.geteuid() == 0 else 0)
        ]
        if not runs:
            continue
        without, with_daq = map(min, zip(*runs, strict=True))
        ratio = with_daq / without
        yield Row(
            f"tick late, with a 1 ms measurement, {words}",
            f"p99 {with_daq:.0f} us",
            f"without: {without:.0f} us",
            ratio,
            f"<= {LIMIT}",
            ratio <= LIMIT,
            f"embedded bus, best of 3 runs of {SECONDS:g} s",
        )


def cost() -> Iterator[Row]:
    """Processor time of one tick in lockstep."""
    times = []
    for measured in (False, True):
        node = Node()
        attended = Attended(node, XcpService(Slave(Memory(node))))
        for raw in commands() if measured else commands()[:1]:
            attended.tick(np.array([row_of(MASTER, raw)], np.int64))
        nothing, best = np.zeros((0, 2), np.int64), float("inf")
        for _ in range(5):
            began = time.process_time()
            for _ in range(5_000):
                attended.tick(nothing)
            best = min(best, (time.process_time() - began) / 5_000)
        times.append(best * 1e6)
    yield Row(
        "a tick with a 1 ms measurement of 3 signals", f"{times[1]:.1f} us", f"without: {times[0]:.1f} us",
        times[1] / times[0], note="processor time, of 1,000 us",
    )  # fmt: skip


MEASUREMENTS = {"tools on the bus: a tick's time": cost, "tools on the bus: lateness": lateness}
