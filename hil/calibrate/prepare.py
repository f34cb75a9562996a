"""Work for tools that takes longer than a tick may: checks of whole tables, files.

It is done outside of the ticks, in a process of its own in real time (a thread would hold up the loop's), and at once
in simulated time. What it changes takes effect between two ticks, whole. In which, a note among a tick's frames says
(`hil.bus.frames.PREPARED`): it is recorded with them, so a recorded session is repeated bit for bit.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import tempfile
from collections.abc import Callable
from multiprocessing.connection import Connection, Pipe
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from controller import load_calibration
from hil.calibrate import elements
from hil.calibrate.elements import Element
from hil.calibrate.errors import BUSY, DENIED, VERIFY, Refusal
from vaneloop.base.child import python
from vaneloop.base.errors import InputError
from vaneloop.base.files import cannot_write

__all__ = ["WORK", "AtOnce", "Desk", "Outside", "Task"]

PATIENCE = 1500  # ticks until work is given up: a master waits 2 s for an answer
Elements = tuple[Element, ...]


class Task(NamedTuple):
    """Work that waits: ``name`` and ``arguments`` of `WORK`, and what takes effect with its result.

    finish  raises `Refusal` where nothing may change
    """

    name: str
    arguments: tuple[Any, ...]
    finish: Callable[[Any], None]


def judge(of: Elements, row: np.ndarray, tables: tuple[str, ...]) -> str:
    """Why the tables of a row would be refused; "" where they would not."""
    return elements.complaint(of, row, tables)


def save(of: Elements, row: np.ndarray, folder: Path) -> tuple[int, str]:
    """Write a row as tables into ``folder``; XCP's error and why, 0 where it is written."""
    if why := elements.complaint(of, row, tuple(elements.MODELS)):
        return VERIFY, why
    try:
        elements.write_tables(folder, of, row)
    except OSError as e:
        return DENIED, cannot_write(folder, e)
    except InputError as e:
        return DENIED, str(e)
    return 0, ""


def load(of: Elements, file: bytes) -> np.ndarray | None:
    """Read a calibration.toml: its scalars; None where it is none."""
    with tempfile.TemporaryDirectory() as folder:
        there = Path(folder) / "calibration.toml"
        there.write_bytes(file)
        try:
            return load_calibration(there).k
        except InputError:
            return None


WORK: dict[str, Callable[..., Any]] = {f.__name__: f for f in (judge, save, load)}


class AtOnce:
    """Work done where it is asked for: simulated time waits."""

    def __init__(self, of: Elements):
        self._elements, self._done = of, (0, None)

    def begin(self, number: int, name: str, arguments: tuple[Any, ...]) -> None:
        """Do it."""
        self._done = number, WORK[name](self._elements, *arguments)

    def done(self) -> tuple[int, Any]:
        """Number and result of the work that was done last; 0: none."""
        return self._done


class Outside:
    """Work done in a process of its own, which ends with this one. Its begin and its result cost a tick some 50 us."""

    def __init__(self, of: Elements):
        self._pipe, theirs = Pipe()
        code = f"from hil.calibrate.prepare import serve; serve({theirs.fileno()})"
        words = python(code)
        # in a session of its own: Ctrl-C at the terminal is for the loop
        subprocess.Popen(words, pass_fds=[theirs.fileno()], stdin=subprocess.DEVNULL, start_new_session=True)
        theirs.close()
        self._done: tuple[int, Any] = 0, None
        self._pipe.send(of)
        self._pipe.recv()  # it has loaded what it needs

    def begin(self, number: int, name: str, arguments: tuple[Any, ...]) -> None:
        """Hand it over; where the process is gone nothing will come back."""
        with contextlib.suppress(OSError):
            self._pipe.send((number, name, arguments))

    def done(self) -> tuple[int, Any]:
        """Number and result of the work that came back last; 0: none."""
        with contextlib.suppress(EOFError, OSError):
            while self._pipe.poll(0):
                self._done = self._pipe.recv()
        return self._done


class Desk:
    """The one task that waits.

    runner   does the work: `AtOnce`, or `Outside`
    waiting  whether a task waits
    """

    def __init__(self, runner: AtOnce | Outside):
        self.runner, self.k = runner, 0
        self._task: Task | None = None
        self._then: Callable[[Refusal | None], None] = lambda why: None
        self._number = self._since = 0

    @property
    def waiting(self) -> bool:
        """Whether a task waits."""
        return self._task is not None

    def begin(self, task: Task, then: Callable[[Refusal | None], None]) -> None:
        """Have a task done; ``then`` is called between two ticks, with the reason if nothing has changed. Raises
        `Refusal` where another one waits.
        """
        if self.waiting:
            raise Refusal(BUSY, "another change is being checked")
        self._number += 1
        self._task, self._then, self._since = task, then, self.k
        self.runner.begin(self._number, task.name, task.arguments)

    def note(self) -> int:
        """Number of the task whose work is done; 0 where none waits or it is not."""
        return self._number if self.waiting and self.runner.done()[0] == self._number else 0

    def before(self, k: int, noted: int) -> None:
        """Let the task ``noted`` take effect before tick ``k``; give up one that waits too long."""
        self.k = k
        task = self._task
        if task is None or (noted != self._number and k - self._since < PATIENCE):
            return
        self._task = None
        why: Refusal | None = None
        try:
            if noted != self._number:
                raise Refusal(BUSY, f"{task.name} is not done after {PATIENCE} ticks")
            task.finish(self.runner.done()[1])
        except Refusal as e:
            why = e
        self._then(why)


def serve(fd: int) -> None:
    """Do work until the loop's process is gone."""
    pipe = Connection(fd)
    os.nice(5)
    with contextlib.suppress(EOFError, OSError):
        of = pipe.recv()
        pipe.send("ready")
        while True:
            number, name, arguments = pipe.recv()
            pipe.send((number, WORK[name](of, *arguments)))
