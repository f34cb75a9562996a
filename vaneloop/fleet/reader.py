"""The process that reads logs. A log that kills it, or on which it hangs, costs a row and not the worker.

It gets a line of JSON for each log on standard input, and answers with a line on standard output; whatever libraries
print goes to standard error. It ends when its worker ends.
"""

from __future__ import annotations

import contextlib
import faulthandler
import fcntl
import importlib
import json
import os
import select
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from numba import config

from vaneloop.base import terminal
from vaneloop.base.child import python
from vaneloop.base.compiled import cache_folder, sources_digest
from vaneloop.base.errors import DeviceError, InputError
from vaneloop.fleet.kinds import KINDS

__all__ = ["DEVICE", "Died", "NotReady", "Reader", "Stopped", "TimedOut", "serve"]

SERVE = "from vaneloop.fleet.reader import serve; serve()"

# one thread a process: several processes that each use all cores are slower than one
ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS", "POLARS_MAX_THREADS"), "1"
)

WARM_UP = 1200.0  # s for compiling on the slowest of machines
DEVICE = "device"  # status of an answer that says why the device cannot be used
STARTS = 3  # of a process that ends before it has read anything


class Died(Exception):
    """The process ended instead of answering."""


class TimedOut(Exception):
    """The process has not answered in time."""


class Stopped(Exception):
    """The worker is to stop, and has ended the process."""


class NotReady(InputError):
    """The process cannot compile what it needs: no log's fault, and so for every log."""


class Reader:
    """A worker's process for logs, begun when it is first needed and after it has died."""

    def __init__(self, kind: str, folder: str, stopped: threading.Event, device: str = "cpu"):
        """``kind``: one of `KINDS`: what is done with each log; ``device``: what runs it (`hil.loop.engines`)."""
        self.kind, self.folder, self.stopped, self.device = kind, folder, stopped, device
        self.process: subprocess.Popen[bytes] | None = None

    def ask(
        self, path: str, options: dict[str, Any], limit: float, beside: Sequence[str] = (), device: str = ""
    ) -> dict[str, Any]:
        """What the function says of a log; ``beside``: what will be asked for next; ``device``: in place of the
        process's own. Raises Died, TimedOut (after ``limit`` s), Stopped, NotReady, DeviceError, or OSError.
        """
        try:
            if self.process is None:
                self._ready(options)
            asked = {"path": path, "options": options, "beside": list(beside), "device": device or self.device}
            return self._answer(asked, limit)
        except BrokenPipeError:
            raise Died(f"the process that read it ended with {self._ended()}") from None
        except (Stopped, TimedOut):
            self.stop()
            raise

    def _ready(self, options: dict[str, Any]) -> None:
        """Have a process that has compiled what it needs."""
        for tried in range(1, STARTS + 1):
            try:
                return self._begin(options)
            except BrokenPipeError:
                how = self._ended()
                if tried == STARTS:
                    why = f"the process that reads logs ended {tried} times before it read any, with {how}"
                    raise NotReady(why) from None
            except TimedOut:
                self.stop()
                raise NotReady(
                    f"the process that reads logs is not ready after {WARM_UP:g} s of compiling; a machine with less "
                    f"to do is needed"
                ) from None

    def _ended(self) -> str:
        """How the process ended, in words."""
        assert self.process is not None
        code = self.process.wait()
        why = self._last_words()
        self.stop()
        return f"signal {-code}{why}" if code < 0 else f"exit code {code}{why}"

    def _begin(self, options: dict[str, Any]) -> None:
        """Start the process, and have it compile what it needs; other processes of this host wait meanwhile."""
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 (as long as the process)
        self.process = subprocess.Popen(
            python(SERVE, self.kind, self.folder), stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._errors,
            env=_environment(),
        )  # fmt: skip
        self._answer({"options": options, "device": self.device}, WARM_UP)

    def _answer(self, question: dict[str, Any], limit: float) -> dict[str, Any]:
        assert self.process is not None and self.process.stdin is not None and self.process.stdout is not None
        self.process.stdin.write(json.dumps(question).encode() + b"\n")
        self.process.stdin.flush()
        answer, until = b"", time.monotonic() + limit
        while not answer.endswith(b"\n"):
            ready, _, _ = select.select([self.process.stdout], [], [], 0.5)
            if ready:
                if not (more := os.read(self.process.stdout.fileno(), 1 << 20)):
                    raise BrokenPipeError
                answer += more
            elif self.stopped.is_set():
                raise Stopped
            elif time.monotonic() > until:
                raise TimedOut(f"no answer in {limit:g} s")
        said = dict(json.loads(answer))
        if said.get("status") == DEVICE:
            raise DeviceError(said["reason"])
        return said

    def stop(self) -> None:
        """End the process."""
        if self.process is not None:
            self.process.kill()
            self.process.wait()
            for pipe in (self.process.stdin, self.process.stdout, self._errors):
                if pipe is not None:
                    with contextlib.suppress(OSError):
                        pipe.close()
            self.process = None

    def _last_words(self) -> str:
        """What the process said in the end: the system's name for the fault, where it gave one."""
        self._errors.seek(0)
        said = self._errors.read().decode("utf-8", "replace").strip().splitlines()
        fatal = [line for line in said if line.startswith("Fatal")] or said[-1:]
        return f" ({fatal[0][:120]})" if fatal else ""


def _environment() -> dict[str, str]:
    """Environment of the process: one thread, and a cache of compiled code that no other host or version shares."""
    own = {"NUMBA_CACHE_DIR": f"{cache_folder()}-{socket.gethostname()}"}
    return {**own, **os.environ, **ONE_THREAD}


def serve() -> None:
    """Answer for one log after the other until standard input ends. The words: kind, run folder."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    faulthandler.enable()
    threading.Thread(target=_end_with, args=(os.getppid(),), daemon=True).start()
    module, name = KINDS[sys.argv[1]].function
    function = getattr(importlib.import_module(module), name)
    for line in sys.stdin:
        asked = json.loads(line)
        try:
            if "path" in asked:
                more = [asked["beside"], asked["device"]] if KINDS[sys.argv[1]].together else []
                said = function(asked["path"], asked["options"], sys.argv[2], *more)
                answer = {"status": "done", "reason": "", **said}
            else:
                _warm_up(getattr(function, "warm_up", None), asked["options"], sys.argv[2])
                if (compile_for := getattr(function, "warm_up_device", None)) is not None:
                    compile_for(asked["device"])
                answer = {}
        except DeviceError as e:
            answer = {"status": DEVICE, "reason": str(e)}
        except InputError as e:
            answer = {"status": "refused", "reason": str(e)}
        except Exception as e:
            answer = {"status": "defect", "reason": terminal.defect(e)}
        answers.write(json.dumps(terminal.plain(answer), sort_keys=True, allow_nan=False) + "\n")
        answers.flush()


def _warm_up(function: Callable[..., object] | None, options: dict[str, Any], run: str) -> None:
    """Fill the cache of compiled code, once a host and version; others of this host wait until it is there.

    Processes that compile the same function at one time can lose or spoil each other's entry (numba#4807).
    """
    if function is None:
        return
    cache = Path(config.CACHE_DIR)  # type: ignore[attr-defined]
    cache.mkdir(parents=True, exist_ok=True)
    warm = cache / f"fleet-{function.__module__}-{sources_digest()}.warm"
    with open(cache / "fleet.lock", "w") as lock:
        waits = time.monotonic() + WARM_UP / 2.0
        while not warm.exists() and time.monotonic() < waits:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)  # ends with the process, however that ends
            except OSError:
                time.sleep(0.5)
                continue
            if not warm.exists():
                function(options, run)
                warm.touch()


def _end_with(parent: int) -> None:
    """End this process when the worker is gone, also in the middle of a log."""
    while os.getppid() == parent:
        time.sleep(1.0)
    os._exit(1)
