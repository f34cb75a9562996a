"""A controller of the user's own in the loop: the reference implementation in C against the firmware here."""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

from benchmarks.measure import LONG, ROUNDS, Row, _rows, _speed, cpu_time
from benchmarks.ours import OurLoop, Setup, profile
from controller.header import FOLDER
from hil.loop.lockstep import Stimulus
from hil.native import Program

__all__ = ["MEASUREMENTS"]

LIMIT = 1.15


def against_the_firmware() -> Iterator[Row]:
    """The closed loop with the reference implementation, called at its address, and with the firmware here."""
    with tempfile.TemporaryDirectory(prefix="vaneloop-c-") as folder:
        library = str(Path(folder) / "reference.so")
        words = ["gcc", "-std=c99", "-O2", "-ffp-contract=off", "-fPIC", "-shared", "-o", library]
        subprocess.run([*words, str(FOLDER / "reference.c"), "-lm"], check=True, capture_output=True)
        ours = Setup(Stimulus.of(profile(LONG)))
        theirs = Setup(ours.stimulus, ours.calibration._replace(program=Program(library)))
        out, other = _rows(ours), _rows(ours)
        best = [float("inf"), float("inf")]
        for _ in range(ROUNDS):
            best[0] = min(best[0], cpu_time(OurLoop(ours), out))
            best[1] = min(best[1], cpu_time(OurLoop(theirs), other))
        same = "same bits" if (out == other).all() else "OTHER BITS"
        ratio = best[1] / best[0]
        yield Row(
            "loop with a controller of one's own, in C",
            _speed(LONG, best[1]),
            f"the firmware here {_speed(LONG, best[0])}",
            ratio,
            f"<= {LIMIT}",
            ratio <= LIMIT and same == "same bits",
            same,
        )


MEASUREMENTS = {"a controller of one's own": against_the_firmware}
