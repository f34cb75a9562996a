"""What is left of a controller that ended its process: the ticks it began and ended, and its last inputs.

The loop writes it into memory that is a file where somebody watches (`hil.native.isolation`): it outlives the process.
"""

from __future__ import annotations

import json
import mmap
import os
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from controller import INPUTS, Calibration
from hil.native.call import ENTERED, N_HEAD, REASON, RETURNED, STARTED, VALUE

__all__ = ["STARTED", "Box", "begun", "new", "progress", "watched"]

_HEAD = 64  # numbers before the rows of inputs
EVERY_TICK = 30_000_000  # rows where all are kept: eight hours; the file is sparse
_WATCHED: list[tuple[Path, int]] = []  # folder for the boxes of this process, rows of each


def watched(folder: Path, every_tick: bool) -> None:
    """Keep the black boxes of this process in ``folder`` from now on; of every tick, or of the last one."""
    _WATCHED[:] = [(folder, EVERY_TICK if every_tick else 1)]


def begun() -> bool:
    """Whether somebody watches this process."""
    return bool(_WATCHED)


def new(path: str, calibration: Calibration) -> tuple[np.ndarray, np.ndarray]:
    """Return the head (float64[N_HEAD], `hil.native.call`) and the rows (float64[n, inputs]) of a new box, of the
    controller ``path`` with ``calibration``.
    """
    if not _WATCHED:
        return np.zeros(N_HEAD), np.zeros((1, len(INPUTS)))
    folder, rows = _WATCHED[0]
    handle, name = tempfile.mkstemp(prefix="box-", dir=folder)
    try:
        os.ftruncate(handle, 8 * (_HEAD + rows * len(INPUTS)))
        whole = np.frombuffer(mmap.mmap(handle, 0), np.float64)
    finally:
        os.close(handle)
    flashed = {name: getattr(calibration, name).tolist() for name in ("k", "table", "angles")}
    Path(f"{name}.json").write_text(json.dumps({"controller": path, "calibration": flashed}), encoding="utf-8")
    return whole[:N_HEAD], whole[_HEAD:].reshape(rows, len(INPUTS))


@dataclass(frozen=True)
class Box:
    """A black box that was left.

    calibration  with which it was flashed (`Calibration`'s arrays)
    tick    that had begun, from 0; -1: it was not yet switched on
    inputs  float64[n, inputs] of the last n ticks, its own last
    reason, value  why the controller was stopped (`hil.native.call.REASONS`, 0 = it was not), and what it gave
    """

    controller: str
    calibration: dict[str, list[Any]]
    tick: int
    inputs: np.ndarray
    reason: int
    value: float


def progress(folder: Path) -> tuple[float, ...]:
    """What changes while a controller's step returns, whichever of the boxes it has; () where none is in a step."""
    out = []
    for name in folder.glob("box-*.json"):
        with name.with_suffix("").open("rb") as f:
            head = np.frombuffer(f.read(8 * N_HEAD))
        if head[ENTERED] != head[RETURNED] or head[STARTED] == 0.0:
            out += [float(head[ENTERED]), float(head[RETURNED])]
    return tuple(out)


def left(folder: Path) -> Box | None:
    """The box of the controller that was in a step, or in its start, when the process ended; None: in none."""
    for name in sorted(folder.glob("box-*.json")):
        file = name.with_suffix("")
        with file.open("rb") as f:
            head = np.frombuffer(f.read(8 * N_HEAD))
        if head[STARTED] == 0.0 or head[ENTERED] != head[RETURNED]:
            rows = np.memmap(file, np.float64, "r", 8 * _HEAD).reshape(-1, len(INPUTS))
            ticks = int(head[ENTERED])
            if ticks > len(rows):
                kept = np.array(rows[[(ticks - 1) % len(rows)]]) if len(rows) == 1 else np.array(rows[:0])
            else:
                kept = np.array(rows[:ticks])
            about = json.loads(name.read_text(encoding="utf-8"))
            return Box(
                about["controller"], about["calibration"], ticks - 1, kept, int(head[REASON]), float(head[VALUE])
            )
    return None
