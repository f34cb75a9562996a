"""A task with a controller of the user's own in a process of its own: what crashes or hangs there ends there.

Three processes. The caller's waits for a guard. The guard's child runs the task; it is a fork, so the task may be any
function. The guard waits for that child alone, watches the black boxes (`hil.native.black_box`), ends it where it does
not go on, and ends every process that the controller left behind: it is their next parent (PR_SET_CHILD_SUBREAPER).
Nobody waits for the end of a pipe, which a process of the controller's could hold: answers are files.

The caller says of a controller that ended its process in which tick, when, why and on which inputs.
"""

from __future__ import annotations

import contextlib
import ctypes
import faulthandler
import json
import math
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
import traceback
from collections.abc import Callable, Iterator
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple, NoReturn, TypeVar, cast

from controller.records import INPUT_FIELDS, TICK
from hil.native import black_box, crash_log
from hil.native.call import REASONS

__all__ = ["PATIENCE", "ControllerFailed", "isolated", "told"]

PATIENCE = 5.0  # s for which a call may last before the controller counts as hanging
_ENDING = 10.0  # s that the process may take to end where a signal asks for it
_LOOK = 0.1  # s
_TRIES = 1000  # to end what a controller left behind: about a second
_ASKS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_WAKES = (*_ASKS, signal.SIGCHLD)
_STREAMS = {0: "standard input", 1: "standard output", 2: "standard error"}
_SIGNALS = {
    signal.SIGSEGV: "it reached memory that is not its own",
    signal.SIGBUS: "it reached memory that is not there",
    signal.SIGFPE: "it divided a whole number by zero",
    signal.SIGILL: "it ran into what is no instruction",
    signal.SIGABRT: "it aborted",
}
_PR_SET_PDEATHSIG, _PR_SET_CHILD_SUBREAPER = 1, 36
_DIGEST = sha256().digest_size  # bytes before an answer, by which one that was overwritten is known
T = TypeVar("T")


class ControllerFailed(RuntimeError):
    """A controller of the user's own ended its process: one line with tick, time, reason and last inputs."""


class RemoteTraceback(Exception):
    """Where an exception was raised in the process with the controller: its traceback, as text."""


def isolated(task: Callable[[], T], save_crash: str | None = None, patience: float = PATIENCE) -> T:
    """Call ``task`` in a process of its own and return its answer, which must be picklable; its exceptions come, too.

    save_crash  file for the inputs of every tick, if the controller fails: `hil.native.crash_log` runs them again
    patience    s that one call of the controller may take

    Raises ControllerFailed where the controller crashed, hung, gave what cannot be or closed what is not its own.
    """
    folder = Path(tempfile.mkdtemp(prefix="vaneloop-boxes-"))
    try:
        _flush()
        _watched(task, folder, save_crash is not None, patience)
        end = _read_end(folder)
        answer = _read_answer(folder, end)
        if answer is None:
            raise ControllerFailed(_failure(folder, end, save_crash))
        good, what, lines = answer
        if not good:
            raise what from RemoteTraceback(lines)
        return cast("T", what)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _flush() -> None:
    for stream in (sys.stdout, sys.stderr):
        if stream is not None:
            stream.flush()


# ---- the caller's process --------------------------------------------------------------------------------------------


def _watched(task: Callable[[], Any], folder: Path, every_tick: bool, patience: float) -> None:
    """Start the guard and wait for its end. Signals that ask for an end go on to it; only the main thread can pass them
    on.
    """
    before: dict[int, Any] = {}
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, _WAKES)
    try:
        guard = os.fork()
        if guard == 0:
            _guard(task, folder, every_tick, patience, mask)
        if threading.current_thread() is threading.main_thread():
            before = {n: signal.signal(n, lambda number, frame: os.kill(guard, number)) for n in _ASKS}
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
    try:
        _wait(guard)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _wait(guard: int) -> None:
    """Wait for the guard, and wake it where somebody stopped it."""
    ends: list[int] = []
    with contextlib.suppress(OSError):  # an older kernel has none: its end is seen at the next look
        ends.append(os.pidfd_open(guard))
    try:
        while True:
            select.select(ends, [], [], _LOOK)
            found, status = os.waitpid(guard, os.WNOHANG | os.WUNTRACED)
            if found and not os.WIFSTOPPED(status):
                return
            if found:
                os.kill(guard, signal.SIGCONT)
    except ChildProcessError:  # where the caller's process ignores SIGCHLD, nothing is kept of a child's end
        return
    finally:
        for end in ends:
            os.close(end)


class _End(NamedTuple):
    """How the process with the controller ended.

    child   its number; 0: not known, for something ended the guard
    status  as os.waitpid gives it
    why     the guard ended it, and for this; "": it ended by itself
    """

    child: int = 0
    status: int = 0
    why: str = ""


def _read_end(folder: Path) -> _End:
    """What the guard wrote; where it did not, its child is ended here, with its session."""
    try:
        return _End(*json.loads((folder / "end").read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        with contextlib.suppress(OSError, ValueError):
            os.killpg(int((folder / "child").read_text(encoding="utf-8")), signal.SIGKILL)
        return _End()


def _read_answer(folder: Path, end: _End) -> tuple[bool, Any, str] | None:
    """The task's answer: whether it is good, it or an exception, and that one's traceback; None where the process did
    not end by itself, or wrote none that is whole.
    """
    if end.child == 0 or end.why or end.status != 0:
        return None
    try:
        data = (folder / f"answer-{end.child}").read_bytes()
    except OSError:
        return None
    digest, content = data[:_DIGEST], data[_DIGEST:]
    return cast("tuple[bool, Any, str]", pickle.loads(content)) if sha256(content).digest() == digest else None


def _failure(folder: Path, end: _End, save_crash: str | None) -> str:
    """What happened, in one line; leaves the crash log."""
    box = black_box.left(folder)
    number = os.WTERMSIG(end.status) if os.WIFSIGNALED(end.status) else 0
    why = f"ended by {_name(number)}" if number else f"ended with code {os.WEXITSTATUS(end.status)}"
    if end.child == 0:
        why = "ended what watches it, or took away its folder for temporary files"
    why = end.why or why
    if box is None:
        hint = "; memory that the controller overwrote may be the cause" if number in _SIGNALS else ""
        where = "" if end.why or end.child == 0 else f", outside a call of it{hint}"
        return f"the process with the controller {why}{where}"
    if not end.why and number in _SIGNALS:
        why += f" ({_SIGNALS[signal.Signals(number)]})"
    line = told(box, why)
    if save_crash is not None and box.tick >= 0:
        line += f"; {crash_log.write(save_crash, box, line)}"
    return line


def _name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:  # a real-time signal
        return f"signal {number}"


# ---- the guard -------------------------------------------------------------------------------------------------------


def _guard(task: Callable[[], Any], folder: Path, every_tick: bool, patience: float, mask: set[Any]) -> NoReturn:
    """Be the guard: start the process with the controller, wait for its end, end what it started, say how it ended."""
    try:
        os.setsid()  # Ctrl-C comes to the caller, which passes it on
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        _prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        _prctl(_PR_SET_CHILD_SUBREAPER, 1)
        child = os.fork()
        if child == 0:
            _run(task, folder, every_tick, mask)
        (folder / "child").write_text(str(child), encoding="utf-8")
        end = _watch(child, folder, patience)
        _end_others(child)
        (folder / "end").write_text(json.dumps(end), encoding="utf-8")
    finally:
        os._exit(0)  # what matters it has written


def _prctl(option: int, value: int) -> None:
    ctypes.CDLL(None).prctl(option, value, 0, 0, 0)


def _watch(child: int, folder: Path, patience: float) -> _End:
    """Wait for the child's end, which comes where a call of the controller takes longer than ``patience`` (s), or where
    a signal asks for it.
    """
    seen, since, stopped, asked, why = black_box.progress(folder), time.monotonic(), False, "", ""
    end_by = math.inf
    while True:
        wake = signal.sigtimedwait(_WAKES, _LOOK)
        if wake is not None and wake.si_signo in _ASKS:
            os.kill(child, wake.si_signo)
            asked, end_by = _name(wake.si_signo), min(end_by, time.monotonic() + _ENDING)
        for found, status in _changed():
            if found == child and not os.WIFSTOPPED(status) and not os.WIFCONTINUED(status):
                return _End(child, status, why)
            if found == child:
                stopped = os.WIFSTOPPED(status)
        now = black_box.progress(folder)
        if now != seen or not (now or stopped):
            seen, since = now, time.monotonic()
        if why:
            continue
        if time.monotonic() - since > patience:
            why = f"was stopped for {patience:g} s" if stopped else f"did not come back within {patience:g} s"
        elif time.monotonic() > end_by:
            why = f"did not end within {_ENDING:g} s of {asked}"
        if why:
            os.killpg(child, signal.SIGKILL)


def _changed() -> Iterator[tuple[int, int]]:
    """Children of this process that ended, stopped or went on, each with its status."""
    with contextlib.suppress(ChildProcessError):
        while (found := os.waitpid(-1, os.WNOHANG | os.WUNTRACED | os.WCONTINUED))[0]:
            yield found


def _end_others(child: int) -> None:
    """End what is left of the child's session, and every other process that came from it: they are children of this
    process now. A recorder and a broker of ours end by themselves.
    """
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(child, signal.SIGKILL)
    for _ in range(_TRIES):
        for _ in _changed():
            pass
        left = [p for p in _descendants() if not _is_ours(p)]
        if not left:
            return
        for process in left:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.kill(process, signal.SIGKILL)
        time.sleep(0.01 * _LOOK)


def _descendants() -> list[int]:
    """Numbers of the processes that come from this one."""
    try:
        os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOHANG | os.WNOWAIT)
    except ChildProcessError:
        return []  # as a rule
    children: dict[int, list[int]] = {}
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError, ValueError, IndexError):
            state, parent = (folder / "stat").read_text(errors="replace").rpartition(")")[2].split()[:2]
            if state != "Z" or int(parent) == os.getpid():  # another one's is not this one's to clear away
                children.setdefault(int(parent), []).append(int(folder.name))
    out = children.get(os.getpid(), [])
    for process in out:
        out += children.get(process, [])
    return out


def _is_ours(process: int) -> bool:
    try:
        words = Path(f"/proc/{process}/cmdline").read_bytes().split(b"\0")
    except OSError:
        return False
    return b"hil.logs.recorder" in words or any(w.endswith(b"hil/bus/broker.py") for w in words)


# ---- the process with the controller ---------------------------------------------------------------------------------


def _end_at_once() -> None:
    """Let ``exit`` of C end this process without what libraries registered for its end: after a fork they may wait for
    threads or locks that are not there.
    """
    libc = ctypes.CDLL(None)
    if hasattr(libc, "on_exit"):  # GNU's; what was registered last is called first, with the exit code
        libc.on_exit(libc._exit, None)


def _run(task: Callable[[], Any], folder: Path, every_tick: bool, mask: set[Any]) -> NoReturn:
    """Be the process with the controller."""
    code = 1
    try:
        os.setsid()
        for number in _ASKS:
            signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        _prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        _end_at_once()
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        faulthandler.disable()  # the caller says what happened, in one line
        with contextlib.suppress(OSError):  # where memory runs out, it is this process that the kernel ends
            Path("/proc/self/oom_score_adj").write_text("1000")
        black_box.watched(folder, every_tick)
        kept = _files([0, 1, 2, os.open(folder, os.O_RDONLY)])
        good: bool
        what: Any
        try:
            good, what = True, task()
            _flush()
        except BaseException as e:
            good, what = False, e
            with contextlib.suppress(OSError, ValueError):
                _flush()
        path = black_box.controller(folder)
        if path and (lost := [fd for fd, file in kept.items() if _files([fd])[fd] != file]):
            named = _STREAMS.get(lost[0], "a file descriptor")
            good, what = False, ControllerFailed(f"--controller {path}: it closed {named}, which is not its own")
        content = _pickled(good, what)
        (folder / f"answer-{os.getpid()}").write_bytes(sha256(content).digest() + content)
        code = 0
    finally:
        os._exit(code)


def _files(descriptors: list[int]) -> dict[int, tuple[int, int] | None]:
    """Which file each descriptor is; None where it is closed."""
    out: dict[int, tuple[int, int] | None] = {}
    for fd in descriptors:
        try:
            found = os.fstat(fd)
            out[fd] = found.st_dev, found.st_ino
        except OSError:
            out[fd] = None
    return out


def _pickled(good: bool, what: Any) -> bytes:
    """An answer as bytes; an exception with its traceback."""
    if good:
        return pickle.dumps((True, what, ""))
    lines = "".join(traceback.format_exception(what))
    try:
        data = pickle.dumps((False, what, lines))
        pickle.loads(data)
        return data
    except Exception:
        return pickle.dumps((False, RuntimeError(f"{type(what).__name__}: {what}"), lines))


# ---- words -----------------------------------------------------------------------------------------------------------


def told(box: black_box.Box, why: str) -> str:
    """What a controller of the user's own did, in one line: the reason for which it was stopped, else ``why``."""
    if box.reason:
        why = REASONS[box.reason].format(box.value)
    where = "" if box.call == "vaneloop_step" else f", in {box.call}"
    if box.tick < 0:
        return f"--controller {box.controller}: {why}{where}, while it was switched on"
    line = f"--controller {box.controller}: {why}{where}, in tick {box.tick}, {box.tick * TICK:.3f} s after power-on"
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
