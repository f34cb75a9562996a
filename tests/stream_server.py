"""Commands with any standard input, output and error: a process that has loaded VaneLoop forks one for each run.

`python -m tests.stream_server []` reads a run a line (JSON: words, kinds) and answers how it ended.
"""

from __future__ import annotations

import contextlib
import fcntl
import importlib
import json
import os
import select
import signal
import socket
import subprocess
import sys
import time
import traceback
from collections.abc import Callable
from typing import Any

from hil.inject.__main__ import main as inject_main
from hil.replay.__main__ import main as replay_main
from tests.conftest import ROOT
from vaneloop.cli.main import COMMANDS, main

# one that hangs up is a terminal whose other side is closed; gone is a pipe without a reader (as input: one to write)
KINDS = ("closed", "null", "pipe", "socket", "terminal", "hung up", "gone", "full")
MODULES: dict[str, Callable[[list[str]], int]] = {"hil.replay": replay_main, "hil.inject": inject_main}
LONGEST = 120.0  # s for a run


def _made(kind: str, fd: int) -> tuple[int | None, int | None]:
    """Descriptor of such a kind, and its other side, from which what is written can be read."""
    if kind == "closed":
        return None, None
    if kind in ("null", "full"):
        return os.open(f"/dev/{kind}", os.O_RDWR), None
    if kind in ("terminal", "hung up"):
        other, end = os.openpty()
        if kind == "hung up":
            os.close(other)
        return end, other if kind == "terminal" else None
    if kind == "socket":
        ours, theirs = socket.socketpair()
        if fd == 0:
            ours.shutdown(socket.SHUT_WR)
        return theirs.detach(), ours.detach()
    read, write = os.pipe()
    if kind == "gone":
        os.close(read)
        return write, None
    if fd == 0:
        os.close(write)
        return read, None
    fcntl.fcntl(write, fcntl.F_SETPIPE_SZ, 1 << 20)
    return write, read


def _stream(fd: int) -> Any:
    """What Python makes of a descriptor when it starts."""
    try:
        os.fstat(fd)
    except OSError:
        return None
    return open(fd, "w" if fd else "r", encoding="utf-8", closefd=False, buffering=1 if fd == 2 else -1)


def _be_a_command(words: list[str], ends: list[int | None]) -> None:
    code = 1
    try:
        os.setsid()
        high = [None if end is None else fcntl.fcntl(end, fcntl.F_DUPFD, 200) for end in ends]
        os.closerange(0, 200)
        for fd, end in enumerate(high):
            if end is not None:
                os.dup2(end, fd)
        os.closerange(200, 210)
        sys.stdin, sys.stdout, sys.stderr = sys.__stdin__, sys.__stdout__, sys.__stderr__ = [
            _stream(fd) for fd in range(3)
        ]
        try:
            code = MODULES[words[0]](words[1:]) if words[0] in MODULES else main(words)
        except SystemExit as e:
            code = int(e.code or 0)
        except BaseException:
            code = 1
            traceback.print_exc()
        try:  # as Python does at its end
            if sys.stdout is not None:
                sys.stdout.flush()
        except OSError:
            code = 120
    finally:
        os._exit(code)


def _said(other: int | None) -> str:
    out = b""
    if other is not None:
        os.set_blocking(other, False)
        with contextlib.suppress(OSError):
            while data := os.read(other, 1 << 16):
                out += data
    return out.decode(errors="replace")


def _run(words: list[str], kinds: list[str]) -> dict[str, Any]:
    made = [_made(kind, fd) for fd, kind in enumerate(kinds)]
    child = os.fork()
    if child == 0:
        _be_a_command(words, [end for end, _ in made])
    watch, end_by, said = os.pidfd_open(child), time.monotonic() + LONGEST, ["", "", ""]
    while not select.select([watch], [], [], 0.05)[0] and time.monotonic() < end_by:
        for fd in (1, 2):  # a terminal and a socket hold little
            said[fd] += _said(made[fd][1])
    hung = not select.select([watch], [], [], 0.0)[0]
    if hung:
        os.kill(child, signal.SIGKILL)
    status = os.waitpid(child, 0)[1]
    for fd in (1, 2):
        said[fd] += _said(made[fd][1])
    for descriptor in (watch, *(x for pair in made for x in pair if x is not None)):
        os.close(descriptor)
    code = None if hung else os.waitstatus_to_exitcode(status)
    return {"code": code, "out": said[1], "err": said[2]}


class Server:
    """The process that forks, as the tests see it.

    before  commands that it runs first, so that what they import is there
    """

    def __init__(self, before: list[list[str]] | None = None) -> None:
        command = [sys.executable, "-m", "tests.stream_server", json.dumps(before or [])]
        self._process = subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def run(self, words: list[str], *kinds: str) -> dict[str, Any]:
        """Exit code (None: it did not end), text on standard output and on standard error of a run with these kinds of
        standard input, output, error.
        """
        stdin, stdout = self._process.stdin, self._process.stdout
        assert stdin is not None and stdout is not None
        print(json.dumps([words, kinds]), file=stdin, flush=True)
        answer: dict[str, Any] = json.loads(stdout.readline())
        return answer

    def close(self) -> None:
        """End it."""
        self._process.communicate("")


if __name__ == "__main__":
    for module, _ in COMMANDS.values():
        importlib.import_module(module)
    with open(os.devnull, "w") as null, contextlib.redirect_stdout(null), contextlib.redirect_stderr(null):
        for words in json.loads(sys.argv[1]):  # what these import, no run imports again
            with contextlib.suppress(SystemExit):
                MODULES[words[0]](words[1:]) if words[0] in MODULES else main(words)
    answers = os.fdopen(os.dup(1), "w")
    for line in iter(sys.stdin.readline, ""):
        print(json.dumps(_run(*json.loads(line))), file=answers, flush=True)
