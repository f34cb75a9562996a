"""A task with a controller of the user's own in a process of its own: what crashes or hangs there ends there.

The process is a fork, so the task may be any function; its answer comes back through a pipe. The parent watches the
black boxes (`hil.native.black_box`) and says of a controller that ended its process in which tick, when, why and on
which inputs.
"""

from __future__ import annotations

import contextlib
import ctypes
import faulthandler
import os
import pickle
import resource
import select
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar, cast

from controller.records import INPUT_FIELDS, TICK
from hil.native import black_box, crash_log
from hil.native.call import REASONS

__all__ = ["PATIENCE", "ControllerFailed", "isolated", "told"]

PATIENCE = 5.0  # s for which a step may last before the controller counts as hanging
_LOOK = 0.1  # s
_SIGNALS = {
    signal.SIGSEGV: "it reached memory that is not its own",
    signal.SIGBUS: "it reached memory that is not there",
    signal.SIGFPE: "it divided a whole number by zero",
    signal.SIGILL: "it ran into what is no instruction",
    signal.SIGABRT: "it aborted",
}
_PR_SET_PDEATHSIG = 1
T = TypeVar("T")


class ControllerFailed(RuntimeError):
    """A controller of the user's own ended its process: one line with tick, time, reason and last inputs."""


def isolated(task: Callable[[], T], save_crash: str | None = None, patience: float = PATIENCE) -> T:
    """Call ``task`` in a process of its own and return its answer, which must be picklable; its exceptions come, too.

    save_crash  file for the inputs of every tick, if the controller fails: `hil.native.crash_log` runs them again
    patience    s that one step may take

    Raises ControllerFailed where the controller crashed, hung or gave what cannot be.
    """
    folder = Path(tempfile.mkdtemp(prefix="vaneloop-boxes-"))
    try:
        sys.stdout.flush(), sys.stderr.flush()
        read, write = os.pipe()
        child = os.fork()
        if child == 0:
            os.close(read)
            _run(task, write, folder, save_crash is not None)
        os.close(write)
        with _forwarding(child):
            answer, hung = _wait(read, child, folder, patience)
        status = os.waitpid(child, 0)[1]
        if answer is None or not os.WIFEXITED(status):
            raise ControllerFailed(_failure(folder, status, hung, patience, save_crash))
        good, what = pickle.loads(answer)
        if not good:
            raise what
        return cast("T", what)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _run(task: Callable[[], Any], pipe: int, folder: Path, every_tick: bool) -> None:
    """Be the process: never returns."""
    code = 1
    try:
        os.setpgid(0, 0)  # Ctrl-C comes to the parent, which passes it on
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        faulthandler.disable()  # the parent says what happened, in one line
        black_box.watched(folder, every_tick)
        try:
            answer = pickle.dumps((True, task()))
        except BaseException as e:
            answer = _pickled(e)
        sys.stdout.flush(), sys.stderr.flush()
        with os.fdopen(pipe, "wb") as out:
            out.write(answer)
        code = 0
    finally:
        os._exit(code)


def _pickled(e: BaseException) -> bytes:
    try:
        data = pickle.dumps((False, e))
        pickle.loads(data)
        return data
    except Exception:
        return pickle.dumps((False, RuntimeError(f"{type(e).__name__}: {e}")))


@contextlib.contextmanager
def _forwarding(child: int) -> Iterator[None]:
    """Pass signals that ask for an end on to the child; only the main thread can."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def forward(number: int, frame: Any) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.kill(child, number)

    before = {n: signal.signal(n, forward) for n in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _wait(pipe: int, child: int, folder: Path, patience: float) -> tuple[bytes | None, bool]:
    """Wait for the answer; None where the pipe ended without one. A controller that hangs is killed: then True."""
    parts: list[bytes] = []
    seen, since, hung = black_box.progress(folder), time.monotonic(), False
    with os.fdopen(pipe, "rb", buffering=0) as pipe_in:
        while True:
            ready, _, _ = select.select([pipe_in], [], [], _LOOK)
            if ready:
                part = pipe_in.read(1 << 20)
                if not part:
                    break
                parts.append(part)
                continue
            now = black_box.progress(folder)
            if now != seen or not now:
                seen, since = now, time.monotonic()
            elif time.monotonic() - since > patience and not hung:
                hung = True
                os.kill(child, signal.SIGKILL)
    return b"".join(parts) or None, hung


def _failure(folder: Path, status: int, hung: bool, patience: float, save_crash: str | None) -> str:
    """What happened, in one line; leaves the crash log."""
    box = black_box.left(folder)
    number = os.WTERMSIG(status) if os.WIFSIGNALED(status) else 0
    ended = f"ended by {signal.Signals(number).name}" if number else f"ended with code {os.WEXITSTATUS(status)}"
    if box is None:
        hint = "; memory that the controller overwrote may be the cause" if number in _SIGNALS else ""
        return f"the process with the controller {ended}, outside a step of it{hint}"
    if hung:
        why = f"did not come back within {patience:g} s"
    else:
        why = ended + (f" ({_SIGNALS[signal.Signals(number)]})" if number in _SIGNALS else "")
    line = told(box, why)
    if save_crash is not None and box.tick >= 0:
        line += f"; {crash_log.write(save_crash, box, line)}"
    return line


def told(box: black_box.Box, why: str) -> str:
    """What a controller of the user's own did, in one line: the reason for which it was stopped, else ``why``."""
    if box.reason:
        why = REASONS[box.reason].format(box.value)
    if box.tick < 0:
        return f"--controller {box.controller}: {why}, while it was switched on"
    line = f"--controller {box.controller}: {why}, in tick {box.tick}, {box.tick * TICK:.3f} s after power-on"
    return f"{line}; last inputs: {_words(box.inputs[-1])}" if len(box.inputs) else line


def _words(inputs: Any) -> str:
    """Inputs of a tick with their units."""
    out, at = [], 0
    for f in INPUT_FIELDS:
        n = len(f.each) or 1
        values = [f"{v:g}" for v in inputs[at : at + n] if v == v or n == 1]
        at += n
        if values:
            out.append(f"{f.name} {' '.join(values)}{'' if f.unit == '-' else ' ' + f.unit}")
    return ", ".join(out)
