"""What is left of a controller that ended its process: the ticks it began and ended, and its last inputs.

The loop writes it into memory that is a file where somebody watches (`hil.native.isolation`): it outlives the process.
"""

from __future__ import annotations

import contextlib
import json
import mmap
import os
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from controller import INPUTS, Calibration
from hil.native.call import CALL, CALLS, ENTERED, N_HEAD, REASON, REASONS, RETURNED, STEP, VALUE
from vaneloop.base.errors import InputError
from vaneloop.base.files import cannot_write

__all__ = ["Box", "begun", "calling", "controller", "new", "progress", "watched"]

_HEAD = 64  # numbers before the rows of inputs
EVERY_TICK = 30_000_000  # rows where all are kept: eight hours; the file is sparse
_OVERWRITTEN = np.full(N_HEAD, np.nan).tobytes()
_WATCHED: list[tuple[Path, int]] = []  # folder for the boxes of this process, rows of each


def watched(folder: Path, every_tick: bool) -> None:
    """Keep the black boxes of this process in ``folder`` from now on; of every tick, or of the last one."""
    _WATCHED[:] = [(folder, EVERY_TICK if every_tick else 1)]


def begun() -> bool:
    """Whether somebody watches this process."""
    return bool(_WATCHED)


def new(path: str, calibration: Calibration) -> tuple[np.ndarray, np.ndarray]:
    """Return the head (float64[N_HEAD], `hil.native.call`) and the rows (float64[n, inputs]) of a new box, of the
    controller ``path`` with ``calibration``. Raises InputError where the disk is full.
    """
    if not _WATCHED:
        return np.zeros(N_HEAD), np.zeros((1, len(INPUTS)))
    folder, rows = _WATCHED[0]
    handle, name = tempfile.mkstemp(prefix="box-", dir=folder)
    flashed = {name: getattr(calibration, name).tolist() for name in ("k", "table", "angles")}
    try:
        os.ftruncate(handle, 8 * (_HEAD + rows * len(INPUTS)))
        os.posix_fallocate(handle, 0, 8 * (_HEAD + len(INPUTS)))  # else a full disk is a SIGBUS at the first tick
        block = mmap.mmap(handle, 0)
        block.madvise(mmap.MADV_DONTFORK)  # a copy of this process that the controller makes ends with its next tick
        whole = np.frombuffer(block, np.float64)
        Path(f"{name}.json").write_text(json.dumps({"controller": path, "calibration": flashed}), encoding="utf-8")
    except OSError as e:
        raise InputError(cannot_write(folder, e)) from None
    finally:
        os.close(handle)
    return whole[:N_HEAD], whole[_HEAD:].reshape(rows, len(INPUTS))


@contextlib.contextmanager
def calling(head: np.ndarray, function: str) -> Iterator[None]:
    """Note that a function of the controller's other than its step is being called; what ends the process meanwhile
    leaves the note.
    """
    head[CALL] = CALLS.index(function)
    try:
        yield
    finally:
        head[CALL] = STEP


@dataclass(frozen=True)
class Box:
    """A black box that was left.

    calibration  with which it was flashed (`Calibration`'s arrays)
    call    function of the controller's in which the process ended
    tick    that had begun, from 0; -1: it was not yet switched on
    inputs  float64[n, inputs] of the last n ticks, its own last
    reason, value  why the controller was stopped (`hil.native.call.REASONS`, 0 = it was not), and what it gave
    """

    controller: str
    calibration: dict[str, list[Any]]
    call: str
    tick: int
    inputs: np.ndarray
    reason: int
    value: float


def _head(file: Path) -> bytes:
    """The numbers at the head of a box whose controller is in a call; b"" where it is in none, or there is no box."""
    try:
        with file.open("rb") as f:
            head = f.read(8 * N_HEAD)
    except OSError:
        return b""
    if len(head) < 8 * N_HEAD:
        return _OVERWRITTEN
    of = np.frombuffer(head)
    return head if of[CALL] != STEP or of[ENTERED] != of[RETURNED] else b""


def progress(folder: Path) -> bytes:
    """What changes while a controller's calls return, whichever of the boxes it has; b"" where none is in a call."""
    return b"".join(_head(name.with_suffix("")) for name in folder.glob("box-*.json"))


def controller(folder: Path) -> str:
    """Path of a controller that has a box here; "" where none has."""
    for name in folder.glob("box-*.json"):
        with contextlib.suppress(OSError, ValueError, LookupError, TypeError):
            return str(json.loads(name.read_text(encoding="utf-8"))["controller"])
    return ""


def left(folder: Path) -> Box | None:
    """The box of the controller that was in a call when the process ended; None: in none, or it cannot be read."""
    for name in sorted(folder.glob("box-*.json")):
        file = name.with_suffix("")
        if not (found := _head(file)):
            continue
        head = np.frombuffer(found)
        try:
            about = json.loads(name.read_text(encoding="utf-8"))
            ticks, rows = int(head[ENTERED]), (file.stat().st_size // 8 - _HEAD) // len(INPUTS)
            count = ticks if 0 <= ticks <= rows else int(rows == 1)
            kept = np.fromfile(file, np.float64, count * len(INPUTS), offset=8 * _HEAD)
            reason = int(head[REASON]) if head[REASON] in REASONS else 0
            return Box(
                about["controller"], about["calibration"], CALLS[int(head[CALL])], ticks - 1,
                kept.reshape(count, len(INPUTS)), reason, float(head[VALUE]),
            )  # fmt: skip
        except (OSError, ValueError, OverflowError, LookupError, TypeError):  # the controller overwrote it
            continue
    return None
