"""How late a tick of 1 ms begins: the product's whole tick with CAN against the plainest C loop (`realtime.c`), turn by
turn in one run.

Ours: controller and plant on the embedded bus, an ECU in a process of its own sends to it; what is measured is
`hil.loop.realtime.run_realtime` as ``vaneloop run`` calls it. C: ``clock_nanosleep`` to absolute deadlines, nothing
else. Both stay on the first processor with the same scheduler, memory locked, timer slack 1 ns. The other processor is
left alone (but for the ECU), or a busy loop runs on it.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from hil.loop.realtime import Lateness

__all__ = ["compare", "conditions", "total"]

SECONDS, ROUNDS = 1.0, 15  # of each, per condition
PRIORITY = 50


def conditions() -> Iterator[tuple[str, int, bool]]:
    """Give name, priority (0 = ordinary scheduler) and whether the other processor is loaded."""
    for priority, scheduler in ((PRIORITY, "SCHED_FIFO"), (0, "ordinary scheduler")):
        for loaded in (False, True):
            yield f"{scheduler}, {'other core loaded' if loaded else 'no load added'}", priority, loaded


@dataclass
class Turns:
    """Lateness in each turn: of C's wake-ups, of our ticks' begins, and the time from our deadlines until the tick's
    frames were sent.
    """

    c: list[Lateness]
    begin: list[Lateness]
    end: list[Lateness]
    received: int = 0  # frames of the ECU

    def late_more(self, us: float, seed: int = 1) -> tuple[int, int, float]:
        """Return our and C's number of ticks later than ``us``, and the ratio that ours exceeds with 95 % (turns drawn
        again and again).

        Lateness comes in bursts, since one program that takes the processor delays many ticks: turns are drawn, not
        ticks.
        """
        ours, theirs = (np.array([h.share_over(us) * h.count for h in turns]).round() for turns in (self.begin, self.c))
        draws = np.random.default_rng(seed).integers(len(ours), size=(4000, len(ours)))
        ratio = (ours[draws].sum(axis=1) + 0.5) / (theirs[draws].sum(axis=1) + 0.5)
        return int(ours.sum()), int(theirs.sum()), float(np.quantile(ratio, 0.05))


def total(turns: list[Lateness]) -> Lateness:
    """Return all turns as one."""
    from hil.loop.realtime import Lateness

    out = Lateness()
    for h in turns:
        out.bins += h.bins
        out.worst_ns = max(out.worst_ns, h.worst_ns)
    return out


def compare(priority: int, loaded: bool) -> Turns:
    """Measure, C and ours in turn."""
    from hil.bus.frames import ECU_DEMAND, IDENT_MASK
    from hil.bus.port import Port, open_bus
    from hil.loop.node import Node
    from hil.loop.realtime import Lateness, run_realtime, undisturbed

    cpus = sorted(os.sched_getaffinity(0))
    ours_on, others_on = cpus[0], cpus[-1]
    turns = Turns([], [], [])
    name = f"local:bench{os.getpid()}-{priority}-{int(loaded)}"
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="vaneloop-c-")))
        program = folder / "realtime"
        source = Path(__file__).with_name("realtime.c")
        subprocess.run(["gcc", "-O2", "-o", str(program), str(source)], check=True, capture_output=True, text=True)
        bus = open_bus(name)
        stack.callback(bus.shutdown)
        ecu = [
            sys.executable,
            "-m",
            "vaneloop.cli.main",
            "ecu",
            "--bus",
            name,
            "--profile",
            "idle",
            "--duration",
            "1e6",
            "--timeout",
            "1e6",
        ]
        ecu += ["--wait", "1e6", "--quiet", "--cpu", str(others_on), "--spin-us", "0"]
        if priority:
            ecu += ["--realtime-priority", str(priority)]
        stack.enter_context(_running(ecu))
        if loaded:
            busy = f"import os; os.sched_setaffinity(0, {{{others_on}}})\nwhile True: pass"
            stack.enter_context(_running([sys.executable, "-c", busy]))
        node, port, told = Node(), Port(bus), folder / "late"
        node.tick(np.zeros((1, 2), np.int64), 0)  # compiled before the first turn
        rows = np.zeros((64, 2), np.int64)
        while not (rows[: port.read(rows), 0] & IDENT_MASK == ECU_DEMAND).any():  # the ECU is not there yet
            time.sleep(0.01)
        for _ in range(ROUNDS):
            subprocess.run([str(program), str(SECONDS), str(ours_on), str(priority), str(told)], check=True)
            turns.c.append(Lateness())
            for ns in np.fromfile(told, np.int64).tolist():
                turns.c[-1].add(ns, 0)
            with undisturbed(priority or None, ours_on):
                report = run_realtime(node, port, ticks=round(SECONDS * 1000))
            turns.begin.append(report.begin)
            turns.end.append(report.end)
            turns.received += report.received
    return turns


@contextlib.contextmanager
def _running(command: list[str]) -> Iterator[None]:
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, cwd=Path(__file__).resolve().parent.parent)
    try:
        yield
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
