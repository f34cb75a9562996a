"""A process beside the server that answers its questions over a socket, one by one in their order.

Its own process group holds whatever it starts, so that ending the group ends everything; when the server is gone it
ends itself.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import io
import os
import queue
import resource
import signal
import threading
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any, NoReturn

from vaneloop.base import terminal
from vaneloop.base.errors import InputError
from vaneloop.cli.main import COMMANDS
from vaneloop.web.jobs import LOADING

__all__ = ["INBOX", "Inbox", "Progress", "answer", "parsed"]

Progress = Callable[[float | None, Any], None]
MOST_MEMORY = 0.75  # of the machine's
LEAST_MEMORY = 4 << 30  # bytes; compiled code reserves address space of its own


def parsed(verb: str, words: list[str]) -> argparse.Namespace:
    """Return the options of ``vaneloop VERB words`` as the command line parses them; InputError with its complaint."""
    module = importlib.import_module(COMMANDS[verb][0])
    parser = terminal.Parser(prog=f"vaneloop {verb}", description=module.DESCRIPTION)
    module.add_options(parser)
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            args = parser.parse_args(words)
    except SystemExit:
        raise InputError(complaint.getvalue().strip().splitlines()[-1]) from None
    args.quiet = True
    return args


def _limit_memory() -> None:
    whole = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    most = max(LEAST_MEMORY, int(MOST_MEMORY * whole))
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


class Inbox:
    """What the server tells the task that is running. What comes too late for one that has ended reaches no other."""

    def __init__(self) -> None:
        self._told: queue.Queue[tuple[int, dict[str, Any]]] = queue.Queue()
        self._task = 0

    def begin(self, task: int) -> None:
        """A task begins to run: the number of its question."""
        self._task = task

    def put(self, task: int, content: dict[str, Any]) -> None:
        """Tell a task something."""
        self._told.put((task, content))

    def take(self) -> dict[str, Any] | None:
        """The next thing that the running task was told, or None."""
        while True:
            try:
                task, content = self._told.get_nowait()
            except queue.Empty:
                return None
            if task == self._task:
                return content


INBOX = Inbox()


def answer(fd: int, tasks: dict[str, Callable[..., Any]], load: Callable[[Progress], None] | None = None) -> NoReturn:
    """Answer questions with ``tasks`` until the server is gone; ``load`` what they need before the first one."""
    connection = Connection(fd)
    _limit_memory()
    questions: queue.Queue[Any] = queue.Queue()

    def listen() -> None:
        try:
            while True:
                number, name, arguments = connection.recv()
                if name == "tell":
                    INBOX.put(number, arguments)
                else:
                    questions.put((number, name, arguments))
        except (EOFError, OSError):
            os.killpg(os.getpgrp(), signal.SIGKILL)  # the server is gone, and so is whatever this process has started

    threading.Thread(target=listen, daemon=True).start()
    sending = threading.Lock()
    if load is not None:
        with contextlib.suppress(Exception):  # what fails here fails again when it is asked for, and is told then
            load(lambda _, text: connection.send(("progress", LOADING, (None, text))))
        connection.send(("progress", LOADING, (None, "")))
    while True:
        number, name, arguments = questions.get()
        INBOX.begin(number)
        last = 0.0

        def progress(fraction: float | None, text: Any, number: int = number) -> None:
            """Tell the page: a fraction and words, or any news of a task that runs on."""
            nonlocal last
            now = time.monotonic()
            if fraction is None or fraction in (0.0, 1.0) or now - last > 0.05:
                last = now
                with sending:
                    connection.send(("progress", number, (fraction, text)))

        try:
            said = ("done", number, tasks[name](progress, **arguments))
        except BaseException as e:
            said = ("failed", number, _line(e))
        with sending:
            connection.send(said)


def _line(e: BaseException) -> str:
    """One line for the page: what the command line would say, or the kind of the mistake where it is ours."""
    if isinstance(e, InputError):
        return str(e)
    return terminal.defect(e)
