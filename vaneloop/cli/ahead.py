"""``python -m vaneloop.cli.ahead``: compile what the first commands need, when the program is set up.

`make` runs it. Without it the first replay and the first diagnosis compile for some 20 s of processor time each. The
code is for this processor, this Python and these sources. Where one of them is another, the first command compiles as
if there were none.
"""

from __future__ import annotations

import gc
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import numba
import numpy as np
from numba.core.registry import cpu_target

from hil.logs import Channel, write_log
from hil.loop.lockstep import Stimulus, lockstep
from hil.loop.node import Ecu, Node
from vaneloop.base import terminal
from vaneloop.base.child import python_module
from vaneloop.base.files import write
from vaneloop.base.kept import AHEAD, sources_digest
from vaneloop.cli.main import main as vaneloop

__all__ = ["JOBS", "done_side_by_side", "main"]

SECONDS = 40  # of the run that is searched


def _simulated(folder: Path) -> None:
    """The loop in simulated time, on a run that the other jobs read."""
    n_dem = np.repeat([60.0, 90.0, 70.0, 95.0], SECONDS * 25)
    run = lockstep(Stimulus.of(n_dem), seed=1)
    columns = {k: Channel(run.t, v) for k, v in run.columns.items() if k not in ("t", "n_engine")}
    write_log(folder / "run.parquet", columns)
    write_log(folder / "run.blf", columns)


def _searched(folder: Path) -> None:
    """The search for what a model lacks."""
    assert vaneloop(["diagnose", str(folder / "run.parquet"), "--quiet", "--workers", "1"]) in (0, 1)


def _on_the_bus(folder: Path) -> None:
    """The reader of CAN logs, the nodes, and frames in simulated time."""
    assert vaneloop(["replay", str(folder / "run.blf"), "--quiet"]) in (0, 1)
    nothing = np.zeros((1, 2), np.int64)
    Node().tick(nothing, 0)
    Ecu().tick(nothing, 0)


# A list of jobs runs in its order; those of one entry run side by side.
JOBS: tuple[dict[str, Callable[[Path], None]], ...] = (
    {"simulator": _simulated},
    {"search": _searched, "bus": _on_the_bus},
)


def done_side_by_side(module: str, jobs: Iterable[str], folder: Path, environment: Mapping[str, str]) -> bool:
    """Whether each job was done, all at once: ``python -m MODULE JOB FOLDER``. Says which was not, and why."""
    running = {
        job: subprocess.Popen(
            python_module(module, job, str(folder)),
            env=dict(environment),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        for job in jobs
    }
    failed = False
    for job, process in running.items():
        said = process.communicate()[1]
        if process.returncode:
            print(f"[vaneloop] {job}: not compiled ahead: {said.strip()[-300:]}")
            failed = True
    return not failed


def _what() -> str:
    processor = cpu_target.target_context.codegen().magic_tuple()
    return f"{sys.version} numba {numba.__version__} {processor} {sources_digest()}"


def main(words: list[str]) -> int:
    """Compile into `AHEAD` what is not there for this processor, Python and these sources; return an exit code.

    words  none; or a job's name and a folder for its files: what each process of it does
    """
    if words:
        job, folder = words
        gc.disable()  # a collection finds nothing to free of what numba makes
        {**JOBS[0], **JOBS[1]}[job](Path(folder))
        return 0
    done = AHEAD / "done.txt"
    what = _what()
    try:
        if done.exists() and done.read_text(encoding="utf-8") == what:
            return 0
        shutil.rmtree(AHEAD, ignore_errors=True)
        AHEAD.mkdir(parents=True, exist_ok=True)
    except OSError as e:
        print(f"[vaneloop] nothing is compiled ahead: {AHEAD}: {e.strerror}; the first command will compile")
        return 0
    print("[vaneloop] compiling for this machine (once, about 30 s on two cores)", flush=True)
    started = time.perf_counter()
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(AHEAD)}
    with tempfile.TemporaryDirectory() as folder:
        if not all(done_side_by_side("vaneloop.cli.ahead", jobs, Path(folder), environment) for jobs in JOBS):
            return 1
    write(done, what)
    print(f"[vaneloop] compiled in {time.perf_counter() - started:.0f} s")
    return 0


if __name__ == "__main__":
    sys.exit(terminal.run(lambda: main(sys.argv[1:])))
