"""Ten hours at 100 Hz: what the verbs take of a log of 3.6 million rows and twelve columns.

python -m benchmarks long    # makes the log with the rig once, in some minutes; then some minutes a verb
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from benchmarks.measure import ROOT, Row

__all__ = ["MEASUREMENTS"]

SECONDS, SEED = 36_000, 11
LIMIT, MEMORY = 60.0, 1.5  # s of wall clock on two cores, GiB
VERBS = ("diagnose", "locate", "compare", "replay")
OFTEN = 0.3  # s between two looks at the memory


def _log() -> Path:
    """The log: the rig with a dead band of its valve."""
    path = ROOT / "benchmarks" / "results" / f"rig_{SECONDS}.parquet"
    if not path.exists():
        from tests.firmware_on_rig import firmware
        from tests.rig import Hidden, manoeuvre, simulate, write

        hidden = [Hidden("valve_dead_band", {"half_width": 0.8e-3})]
        path.parent.mkdir(exist_ok=True)
        write(simulate(manoeuvre(SEED, SECONDS), firmware(), hidden, seed=SEED, rate=100), path)
    return path


def _family(pid: int) -> list[int]:
    """A process and all that it started."""
    out = [pid]
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        for child in task.read_text().split():
            out += _family(int(child))
    return out


def _memory(pid: int) -> float:
    """What a process and those that it started hold together, shared pages once, GiB."""
    kib = 0
    for one in _family(pid):
        for line in Path(f"/proc/{one}/smaps_rollup").read_text().splitlines():
            if line.startswith("Pss:"):
                kib += int(line.split()[1])
    return kib / 2**20


def verbs() -> Iterator[Row]:
    """Each verb on the log."""
    log = _log()
    for verb in VERBS:
        began, most = time.perf_counter(), 0.0
        command = [sys.executable, "-m", "vaneloop", verb, str(log)]
        p = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        while True:
            pid, status, used = os.wait4(p.pid, os.WNOHANG)
            if pid:
                break
            with contextlib.suppress(OSError):  # one of them has just ended
                most = max(most, _memory(p.pid))
            time.sleep(OFTEN)
        wall, cpu = time.perf_counter() - began, used.ru_utime + used.ru_stime
        p.returncode = os.waitstatus_to_exitcode(status)
        if p.returncode not in (0, 1):
            raise RuntimeError(f"{verb}: exit code {p.returncode}")
        held = (wall <= LIMIT and most <= MEMORY) if verb == "diagnose" else None
        yield Row(
            f"10 hours at 100 Hz: {verb}", f"{wall:.0f} s, {most:.2f} GiB", f"{LIMIT:.0f} s, {MEMORY} GiB",
            wall / LIMIT, "at most 1", held,
            f"{cpu:.0f} s of a processor; largest process {used.ru_maxrss / 2**20:.2f} GiB; "
            f"load {os.getloadavg()[0]:.1f}",
        )  # fmt: skip


MEASUREMENTS = {"a long log, 10 hours": verbs}
