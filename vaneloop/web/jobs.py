"""Long work in other processes, seen from the page's event loop: questions with progress, answers, cancelling."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from typing import Any

from vaneloop.base.child import python_module
from vaneloop.base.vanes import VANES

__all__ = ["COLUMNS", "COMPILING", "STEPS", "Cancelled", "Job", "Spare", "WorkError", "Worker"]


# A search has its own two processes: threads of linear algebra would only wait for each other (10 % of a search).
ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
SHOWN = 0.3  # s between two steps of a bar
AGAIN = 10.0  # s after which there is another spare process: the one that was taken has work, and comes first


class WorkError(Exception):
    """Work that failed: one line for the page."""


class Cancelled(Exception):
    """Work that the user stopped."""


@dataclass
class Job:
    """One piece of work: ``fraction`` done (None: unknown), ``text`` says what goes on."""

    number: int
    name: str
    text: str
    future: asyncio.Future[Any]
    asked: str = ""  # the text before its process has said anything
    fraction: float | None = None
    started: float = field(default_factory=time.monotonic)
    told: float = 0.0  # when the page was last told of its progress

    @property
    def seconds(self) -> float:
        """Time since it was asked for."""
        return time.monotonic() - self.started


LOADING = 0  # in place of a question's number: said before any is answered
COMPILING = "loading the simulator (compiling it the first time takes about 20 s)"
STEPS = ("mechanism", "stroke", "links", "loop", "tables")  # of the schedule page
# of every machine; a stage that one lacks is NaN
COLUMNS = ("t", "n_dem", "n_r", "x_dem", "x_lvdt", "i_cmd", *VANES, "p_s", "t_oil", "state", "faults")
Started = tuple[subprocess.Popen[bytes], Connection]


def _launch(module: str, *more: str) -> Started:
    """Start a process of ours that answers over a socket."""
    ours, theirs = socket.socketpair()
    process = subprocess.Popen(
        python_module(module, str(theirs.fileno()), *more), pass_fds=[theirs.fileno()], stdin=subprocess.DEVNULL,
        start_new_session=True, env={**os.environ, **ONE_THREAD},
    )  # fmt: skip
    theirs.close()
    return process, Connection(ours.detach())


def _kill(process: subprocess.Popen[bytes]) -> None:
    """End a process and everything that it started."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


class Spare:
    """A process that has loaded all that a log needs, for the next `Worker` that starts: loading takes seconds. One for
    all sessions.
    """

    def __init__(self, module: str = "vaneloop.web.worker"):
        self.module = module
        self._ready: Started | None = None
        self._closed = False

    def refill(self) -> None:
        """Start one where there is none."""
        if self._ready is None and not self._closed:
            self._ready = _launch(self.module, "--load")

    def take(self) -> Started:
        """Return the one that is there, and let another start later; a new one where none is there, or it has ended."""
        ready, self._ready = self._ready, None
        asyncio.get_running_loop().call_later(AGAIN, self.refill)
        if ready is not None and ready[0].poll() is None:
            return ready
        return _launch(self.module, "--load")

    def close(self) -> None:
        """End it."""
        self._closed = True
        if self._ready is not None:
            _kill(self._ready[0])
            self._ready = None


class Worker:
    """One process with its own group. It starts with the first question, and again after it was stopped."""

    def __init__(
        self, module: str = "vaneloop.web.worker", changed: Callable[[], None] | None = None, spare: Spare | None = None
    ):
        self.module, self.spare = module, spare
        self.loading = ""  # what the process does before it answers: it compiles, perhaps
        self.changed = changed or (lambda: None)
        self.news: Callable[[Any], None] | None = None  # takes what a task that runs on sends
        self.jobs: dict[int, Job] = {}
        self.process: subprocess.Popen[bytes] | None = None
        self._connection: Connection | None = None
        self._next = 0

    def start(self) -> None:
        """Start the process where it is not running: importing what it needs takes a second or two."""
        if self.process is not None and self.process.poll() is None:
            return
        self.process, self._connection = self.spare.take() if self.spare is not None else _launch(self.module)
        self.loading = ""
        loop = asyncio.get_running_loop()
        threading.Thread(target=self._listen, args=(self._connection, loop), daemon=True).start()
        threading.Thread(target=self._watch, args=(self.process, loop), daemon=True).start()

    async def call(self, name: str, text: str, **arguments: Any) -> Any:
        """Ask; return the answer. Raises WorkError with one line, or Cancelled."""
        self.start()
        assert self._connection is not None
        self._next += 1
        job = Job(self._next, name, self.loading or text, asyncio.get_running_loop().create_future(), text)
        self.jobs[job.number] = job
        self.changed()
        try:
            await asyncio.get_running_loop().run_in_executor(None, self._connection.send, (job.number, name, arguments))
        except OSError:
            self._end(job.number, WorkError("the process that does this has ended; start it again"))
        return await job.future

    def tell(self, **content: Any) -> None:
        """Say something to the task that is running; it is short and never waits long."""
        if self._connection is not None and self.jobs:
            with contextlib.suppress(OSError):
                self._connection.send((min(self.jobs), "tell", content))

    def stop(self) -> None:
        """End the process and everything that it started; whoever waits for an answer gets Cancelled."""
        process, self.process = self.process, None
        if process is not None:
            _kill(process)
        self.loading = ""
        self._connection = None  # the listening thread closes it
        for number in list(self.jobs):
            self._end(number, Cancelled("stopped"))

    # ---- answers, from two threads

    def _listen(self, connection: Connection, loop: asyncio.AbstractEventLoop) -> None:
        with contextlib.suppress(EOFError, OSError, RuntimeError):  # the process has ended, or our loop
            while True:
                kind, number, content = connection.recv()
                if kind == "progress":
                    loop.call_soon_threadsafe(self._progress, number, *content)
                else:
                    loop.call_soon_threadsafe(self._end, number, WorkError(content) if kind == "failed" else content)
        connection.close()

    def _watch(self, process: subprocess.Popen[bytes], loop: asyncio.AbstractEventLoop) -> None:
        process.wait()
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)  # what it had started
        with contextlib.suppress(RuntimeError):
            loop.call_soon_threadsafe(self._lost, process)

    def _progress(self, number: int, fraction: float | None, text: Any) -> None:
        if number == LOADING:
            self.loading = text
            for waiting in self.jobs.values():
                waiting.text = text or waiting.asked
            self.changed()
            return
        job = self.jobs.get(number)
        if job is not None and not isinstance(text, str):
            if self.news is not None:
                self.news(text)
        elif job is not None:
            now, other = time.monotonic(), bool(text) and text != job.text
            job.fraction, job.text = fraction, text or job.text
            if other or now - job.told > SHOWN:  # the browser goes through its whole page for each change
                job.told = now
                self.changed()

    def _end(self, number: int, content: Any) -> None:
        job = self.jobs.pop(number, None)
        if job is not None and not job.future.done():
            if isinstance(content, Exception):
                job.future.set_exception(content)
            else:
                job.future.set_result(content)
            self.changed()

    def _lost(self, process: subprocess.Popen[bytes]) -> None:
        if process is not self.process:
            return  # stopped on purpose
        self.process, code = None, process.wait()
        how = f"signal {-code}" if code < 0 else f"exit code {code}"
        for number in list(self.jobs):
            self._end(
                number,
                WorkError(
                    f"the process that did this was ended from outside ({how}), perhaps for want of memory; nothing is "
                    f"kept of it, start it again"
                ),
            )
