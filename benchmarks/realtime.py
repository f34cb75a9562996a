"""How late a tick of 1 ms begins: the product's whole tick with CAN against the plainest C loop (`realtime.c`), turn by turn in one run.

Ours: controller and plant on the embedded bus, an ECU in a process of its own sends to it; what is measured is `hil.realtime.run_realtime`
as ``vaneloop run`` calls it. C: ``clock_nanosleep`` to absolute deadlines, nothing else. Both stay on the first processor with the same
scheduler, memory locked, timer slack 1 ns. The other processor is left alone (but for the ECU), or a busy loop runs on it.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from hil.realtime import Lateness

__all__ = ["compare", "conditions"]

SECONDS, ROUNDS = 3.0, 5  # of each, per condition
PRIORITY = 50


def conditions() -> Iterator[tuple[str, int, bool]]:
    """Give name, priority (0 = ordinary scheduler) and whether the other processor is loaded."""
    for priority, scheduler in ((PRIORITY, "SCHED_FIFO"), (0, "ordinary scheduler")):
        for loaded in (False, True):
            yield f"{scheduler}, {'other core loaded' if loaded else 'idle'}", priority, loaded


def compare(priority: int, loaded: bool) -> tuple[Lateness, Lateness, Lateness]:
    """Return the lateness of C's wake-ups, of our ticks' begins, and the time from our deadlines until the tick's frames were sent."""
    from hil.bus import Port, open_bus
    from hil.node import Node
    from hil.realtime import Lateness, run_realtime, undisturbed

    cpus = sorted(os.sched_getaffinity(0))
    ours_on, others_on = cpus[0], cpus[-1]
    totals = Lateness(), Lateness(), Lateness()
    name = f"local:bench{os.getpid()}"
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="vaneloop-c-")))
        program = folder / "realtime"
        source = Path(__file__).with_name("realtime.c")
        subprocess.run(["gcc", "-O2", "-o", str(program), str(source)], check=True, capture_output=True, text=True)
        bus = open_bus(name)
        stack.callback(bus.shutdown)
        ecu = [sys.executable, "-m", "app.main", "ecu", "--bus", name, "--profile", "idle", "--duration", "1e6", "--timeout", "1e6"]
        ecu += ["--wait", "1e6", "--quiet", "--cpu", str(others_on), "--spin-us", "0"]
        if priority:
            ecu += ["--realtime-priority", str(priority)]
        stack.enter_context(_running(ecu))
        if loaded:
            busy = "import os; os.sched_setaffinity(0, {%d})\nwhile True: pass" % others_on
            stack.enter_context(_running([sys.executable, "-c", busy]))
        node, port, told = Node(), Port(bus), folder / "late"
        node.tick(np.zeros((1, 2), np.int64), 0)  # compiled before the first turn
        while port.read(np.zeros((64, 2), np.int64)) == 0:  # the ECU is there
            pass
        for _ in range(ROUNDS):
            subprocess.run([str(program), str(SECONDS), str(ours_on), str(priority), str(told)], check=True)
            for ns in np.fromfile(told, np.int64).tolist():
                totals[0].add(ns, 0)
            with undisturbed(priority or None, ours_on):
                report = run_realtime(node, port, ticks=round(SECONDS * 1000))
            for total, part in zip(totals[1:], (report.begin, report.end), strict=True):
                total.bins += part.bins
                total.worst_ns = max(total.worst_ns, part.worst_ns)
            if report.received < 50 * SECONDS:
                raise RuntimeError(f"only {report.received} frames came from the ECU in {SECONDS:g} s")
    return totals


@contextlib.contextmanager
def _running(command: list[str]) -> Iterator[None]:
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, cwd=Path(__file__).resolve().parent.parent)
    try:
        yield
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
