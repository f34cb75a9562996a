"""Frames to a file that opens whenever the recording stops, also by ``kill -9``, in each format that can be recorded
to (`hil.logs.formats`).

Twice a second what has come in is appended, each format in its own way such that the file is whole again afterwards
(`hil.logs.record_formats`). A killed process loses nothing that it has handed to the kernel, so at most half a second
is lost; a machine that loses its power may lose what the kernel has not yet written to the disk.

`Recorder` writes in the process that calls it. `RecorderProcess` gives frames to a process of its own through a pipe,
for a loop that must not wait for a disk; it ends the file properly even where the loop's process is killed.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import select
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from hil.logs.formats import format_of, spoken
from hil.logs.record_formats import FRAME, packed_message
from vaneloop.base import terminal
from vaneloop.base.child import python_module
from vaneloop.base.errors import InputError
from vaneloop.base.files import cannot_write

__all__ = ["FLUSH", "FRAME", "Recorder", "RecorderProcess", "check_name", "free_name", "packed_message"]

FLUSH = 0.5  # s between two appends; at most this much is lost
_END = b"\xff" * FRAME.itemsize  # in place of a frame: nothing comes after it; who forked may hold the pipe still
_WHOLE = select.PIPE_BUF // FRAME.itemsize * FRAME.itemsize  # bytes that a pipe takes whole or not at all


class Recorder:
    """A recording into a file of this process: `put` frames as they come, `poll` now and then, `close` at the end.

    path     its suffix says the format; a file that is there already is kept under another name
    channel  name of the bus, for candump
    """

    def __init__(self, path: str | Path, channel: str = "vcan0"):
        self.path = check_name(path)
        empty, self.kept = self.path.is_file(), _keep_old(self.path)
        try:
            self.file = format_of(self.path).record(self.path, channel)
        except OSError as e:
            with contextlib.suppress(OSError):  # what was begun goes, and the earlier recording has its name again
                if self.kept:
                    self.kept.replace(self.path)
                elif empty:
                    os.truncate(self.path, 0)
                elif self.path.is_file():
                    self.path.unlink()
            raise InputError(cannot_write(self.path, e)) from None
        self.frames = 0  # in the file
        self._waiting: list[bytes] = []
        self._next = time.monotonic() + FLUSH

    def put(self, frames: bytes) -> None:
        """Take frames (bytes of FRAME)."""
        if frames:
            self._waiting.append(frames)

    def poll(self) -> None:
        """Append what has come in, if it is time. Raises InputError where the file cannot be written: it then ends
        before these frames.
        """
        if time.monotonic() >= self._next:
            self.flush()

    def flush(self) -> None:
        """Append what has come in."""
        self._next = time.monotonic() + FLUSH
        if self._waiting:
            frames = np.frombuffer(b"".join(self._waiting), FRAME)
            self._waiting.clear()
            try:
                self.file.append(frames)
            except OSError as e:
                raise InputError(f"{cannot_write(self.path, e)}; it ends after {self.frames:,} frames") from None
            self.frames += len(frames)

    def close(self) -> None:
        """Append what has come in and end the file."""
        try:
            self.flush()
        finally:
            self.file.close()


def check_name(path: str | Path) -> Path:
    """Return the path of a recording if its name and folder allow one. Raises InputError."""
    path = Path(path)
    format_of(path, "recorder", "is not one of a recording", spoken).check(path)
    if path.is_dir() or not path.parent.is_dir():
        raise InputError(f"{path}: {'is a folder' if path.is_dir() else 'its folder does not exist'}")
    if not os.access(path if path.exists() else path.parent, os.W_OK):
        raise InputError(f"cannot write {path}: Permission denied")
    return path


def free_name(path: Path) -> Path:
    """Return the first of run.1.log, run.2.log, ... that is free."""
    n = 1
    while (other := path.with_name(f"{path.stem}.{n}{path.suffix}")).exists():
        n += 1
    return other


def _keep_old(path: Path) -> Path | None:
    """Move an earlier recording out of the way: what was recorded is not lost. Return its new name."""
    if not path.is_file() or path.stat().st_size == 0:
        return None
    other = free_name(path)
    path.rename(other)
    return other


# --- in a process of its own ------------------------------------------------------------------------------------------


class RecorderProcess:
    """A recording in a process of its own. `put` is one write into a pipe that holds half a minute of frames; it never
    waits.

    Frames that do not fit, because the disk stands still, are counted in ``lost``. Raises InputError for what
    `Recorder` refuses.
    """

    def __init__(self, path: str | Path, channel: str = "vcan0"):
        self.path, self.lost, self.frames, self.error = check_name(path), 0, 0, ""
        command = python_module("hil.logs.recorder", str(self.path), channel)
        # in a session of its own: Ctrl-C at the terminal is for the loop, which then ends the recording
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True)
        assert self._process.stdin is not None
        self._pipe = self._process.stdin.fileno()
        _enlarge(self._pipe)
        ready = self._answer()
        if not ready.startswith("ready"):
            raise InputError(ready.partition(" ")[2] or f"{self.path}: the recorder did not start")
        self.kept = ready.partition(" ")[2]
        os.set_blocking(self._pipe, False)

    def _answer(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline().decode().strip()

    def put(self, frames: bytes) -> None:
        """Take frames (bytes of FRAME)."""
        for at in range(0, len(frames), _WHOLE):
            part = frames[at : at + _WHOLE]
            try:
                os.write(self._pipe, part)
            except (BlockingIOError, BrokenPipeError):
                self.lost += len(part) // FRAME.itemsize

    def close(self) -> None:
        """End the recording and wait until the file is whole. ``frames`` then says how many are in it, ``error`` what
        went wrong.
        """
        assert self._process.stdin is not None
        os.set_blocking(self._pipe, True)
        with contextlib.suppress(BrokenPipeError):
            os.write(self._pipe, _END)
        self._process.stdin.close()
        word, _, rest = self._answer().partition(" ")
        self._process.wait()
        if word == "frames":
            self.frames, self.error = int(rest), ""
        else:
            self.error = rest or "the recorder was killed"


def _enlarge(pipe: int, size: int = 1 << 20) -> None:
    with contextlib.suppress(OSError):  # an unprivileged user may be allowed less: 64 KiB are two seconds
        fcntl.fcntl(pipe, fcntl.F_SETPIPE_SZ, size)


def serve(path: str, channel: str) -> int:
    """Record what comes through standard input until it ends or says so, and say on standard output how that went."""
    for number in (
        signal.SIGINT,
        signal.SIGTERM,
        signal.SIGHUP,
    ):  # the loop's process ends the recording by closing the pipe
        signal.signal(number, signal.SIG_IGN)

    def say(text: str) -> None:
        with contextlib.suppress(OSError):  # nobody may be there any more
            os.write(1, (text + "\n").encode())

    try:
        recorder = Recorder(path, channel)
        say(f"ready {recorder.kept or ''}")
        rest, size = b"", FRAME.itemsize
        while not rest.endswith(_END):
            if select.select([0], [], [], FLUSH / 2)[0]:
                data = os.read(0, 1 << 20)
                if not data:
                    break
                rest += data
                whole = len(rest) - len(rest) % size
                frames = rest[:whole].removesuffix(_END)
                if frames:
                    recorder.put(frames)
                rest = rest[len(frames) :]
            recorder.poll()
        recorder.close()
    except InputError as e:
        say(f"error {e}")
        return 2
    say(f"frames {recorder.frames}")
    return 0


if __name__ == "__main__":
    sys.exit(terminal.run(lambda: serve(*sys.argv[1:])))
