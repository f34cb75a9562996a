"""``python -m tests.ahead``: compile what tests of several files run and the first commands do not, once for all
workers of pytest-xdist. `make test` does it when it is set up, after `vaneloop.cli.ahead`.
"""

from __future__ import annotations

import gc
import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numba import config

from hil.inject.in_lanes import warm_up_lanes
from hil.loop.lanes import lockstep_lanes
from hil.loop.lockstep import Stimulus
from hil.loop.node import Node, replay
from plant import build_plant
from tests.rig import manoeuvre, simulate
from tests.rig.controller import stand_in
from vaneloop.base.files import write
from vaneloop.cli.ahead import done_side_by_side
from vaneloop.cli.main import main as vaneloop

__all__ = ["JOBS", "main"]


def _on_the_bus() -> None:
    """The loop on the lockstep bus, a scenario there, hostile frames, a recorded run again; the rig's own machine."""
    for words in ("run --bus lockstep --duration 0.1", "inject demand_gap_40ms", "fuzz --frames 100"):
        assert vaneloop([*words.split(), "--quiet"]) in (0, 1)
    replay(Node(), np.zeros(0, np.int64), np.zeros((0, 2), np.int64), 10)
    simulate(manoeuvre(1, 10.0), stand_in())


def _in_lanes() -> None:
    """Loops side by side, and a scenario in them."""
    lockstep_lanes(Stimulus.of(np.full(10, 60.0)), [build_plant()] * 2)
    warm_up_lanes()


JOBS: dict[str, Callable[[], None]] = {"bus": _on_the_bus, "lanes": _in_lanes}


def main(words: list[str]) -> int:
    """Compile what is not there for these sources; return an exit code. ``words``: none, or a job and a folder."""
    if words:
        gc.disable()  # a collection finds nothing to free of what numba makes
        os.chdir(words[1])
        JOBS[words[0]]()
        return 0
    done = Path(config.CACHE_DIR) / "tests.txt"  # type: ignore[attr-defined]
    if done.exists():
        return 0
    print("[vaneloop] compiling what several tests run", flush=True)
    started = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        if not done_side_by_side("tests.ahead", JOBS, Path(folder), os.environ):
            return 1
    write(done, "")
    print(f"[vaneloop] compiled in {time.perf_counter() - started:.0f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
