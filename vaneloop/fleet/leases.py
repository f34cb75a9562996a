"""Who works on which chunk. No lock is held and no clock compared: only files that are made in one step.

A lease is a file CHUNK.N; the greatest N counts. Of several workers that would have a chunk, the one that makes the
next file has it. A lease may be taken over when its worker is known to be gone (its process, on this host), or when its
heartbeat, a number that it counts up, has not moved while the observer's own clock ran for some time (another host, a
worker that stands still). A worker that comes back after that sees the greater N and leaves the chunk alone.
"""

from __future__ import annotations

import os
import re
import socket
import threading
import time
import uuid
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from vaneloop.base.errors import InputError
from vaneloop.fleet.files import create, plain_bytes, read_json, whole_json

__all__ = ["BEATS", "Leases", "Me", "gone", "who_is"]

BEATS = 12.0  # heartbeats that may fail to come until a worker is taken for dead
SMALL = 1 << 16  # bytes of a file here, at most
_LEASE = re.compile(r"([^.]+)\.([0-9]{1,12})")
_NAME = re.compile(r"[A-Za-z0-9._-]{1,200}")


def _host() -> str:
    """This host, this boot of it, this space of process numbers: within it a number names a process."""
    parts = [socket.gethostname()]
    for file in ("/proc/sys/kernel/random/boot_id", "/proc/self/ns/pid"):
        try:
            parts.append(os.readlink(file) if file.endswith("/pid") else Path(file).read_text().strip())
        except OSError:
            parts.append("")
    return " ".join(parts)


def _started(pid: int) -> float | None:
    """When a process started, as its system counts; None: there is no such process."""
    import psutil

    try:
        process = psutil.Process(pid)
        return None if process.status() == psutil.STATUS_ZOMBIE else process.create_time()
    except psutil.NoSuchProcess:
        return None


def who_is(file: Path) -> dict[str, Any]:
    """What a worker's file says. Raises FileNotFoundError, and InputError where it is damaged."""
    who = read_json(file, SMALL)
    kinds = {"host": str, "pid": int, "started": float | int, "kind": str}
    if not isinstance(who, dict) or not all(isinstance(who.get(k), kind) for k, kind in kinds.items()):
        raise InputError(f"{file}: does not say host, pid, started and kind; the run folder is damaged")
    if not 0 < who["pid"] < 1 << 31:
        raise InputError(f"{file}: pid (={who['pid']}) is no number of a process; the run folder is damaged")
    return who


def gone(who: dict[str, Any]) -> bool:
    """Whether a process is known to be gone; False also where that cannot be known from here."""
    if who["host"] != _host():
        return False
    started = _started(int(who["pid"]))
    return started is None or abs(started - float(who["started"])) > 1.0


class Me:
    """This process as a worker of a run: its name, and a heartbeat as long as it lives.

    starter  the process that rents it
    stopped  set when this one is to stop: the starter is gone, or somebody asked for it
    """

    def __init__(self, run: Path, every: float = 5.0, starter: str = "", kind: str = "worker"):
        """Enter the run: write down who this is, and let the heart beat every so many seconds."""
        self.folder = run / "workers"
        self.name = f"{socket.gethostname()}-{os.getpid()}-{uuid.uuid4().hex[:8]}"
        who = {"host": _host(), "pid": os.getpid(), "started": _started(os.getpid()), "kind": kind}
        whole_json(self.folder / f"{self.name}.json", who)
        self.every, self.beats = every, 0
        self.stopped = threading.Event()
        self._starter = starter
        self._watch = Leases(run, BEATS * every) if starter else None
        self._beat()
        self._thread = threading.Thread(target=self._live, daemon=True)
        self._thread.start()

    def leave(self) -> None:
        """Stop the heartbeat and strike the name off."""
        self.stopped.set()
        self._thread.join()
        for suffix in ("json", "beat"):
            (self.folder / f"{self.name}.{suffix}").unlink(missing_ok=True)

    def _beat(self) -> None:
        self.beats += 1
        try:
            with open(self.folder / f"{self.name}.beat", "w") as f:
                f.write(f"{self.beats}")
        except OSError:  # a full disk: others may take over what this one has, which harms nothing
            pass

    def _live(self) -> None:
        while not self.stopped.wait(self.every):
            self._beat()
            if self._watch is not None and self._watch.dead(self._starter):
                self.stopped.set()


class Leases:
    """The leases of a run, as one process sees them.

    patience  s for which a heartbeat of another host may stand still
    """

    def __init__(self, run: Path, patience: float = 60.0):
        """Look at the run in this folder."""
        self.folder, self.workers, self.patience = run / "leases", run / "workers", patience
        self._seen: dict[str, tuple[str, float]] = {}  # worker -> its beat, and when this was first seen

    def held(self) -> dict[str, int]:
        """The greatest number of each chunk's leases."""
        out: dict[str, int] = {}
        try:
            for f in os.scandir(self.folder):
                if (m := _LEASE.fullmatch(f.name)) is not None:
                    out[m[1]] = max(out.get(m[1], -1), int(m[2]))
        except FileNotFoundError:
            pass
        return out

    def holder(self, chunk: str, number: int) -> str:
        """Name of the worker that has a lease; "": it has been given back just now, or is damaged."""
        try:
            said = read_json(self.folder / f"{chunk}.{number}", SMALL)
        except (FileNotFoundError, InputError):
            return ""
        name = said.get("worker") if isinstance(said, dict) else None
        return name if isinstance(name, str) and _NAME.fullmatch(name) else ""

    def dead(self, worker: str) -> bool:
        """Whether a worker is gone, or silent for longer than the patience."""
        try:
            if gone(who_is(self.workers / f"{worker}.json")):
                return True
            beat = plain_bytes(self.workers / f"{worker}.beat", SMALL).decode("utf-8", "replace")
        except (OSError, InputError):
            return True  # it has left
        now = time.monotonic()
        last, since = self._seen.get(worker, (None, now))
        if last != beat:  # also an empty one: a worker may stand still while it writes
            self._seen[worker] = (beat, now)
            return False
        return now - since > self.patience

    def take(self, chunks: Iterable[str], me: str) -> tuple[str, int] | None:
        """Take the first chunk that is free or left alone: its name and the lease's number; None: all are in work."""
        held, text = self.held(), f'{{"worker": "{me}"}}'
        workers: dict[str, bool] = {}
        for chunk in chunks:
            number = held.get(chunk, -1)
            if number >= 0 and (holder := self.holder(chunk, number)):
                if holder not in workers:
                    workers[holder] = self.dead(holder)
                if not workers[holder]:
                    continue
            if create(self.folder / f"{chunk}.{number + 1}", lambda f: f.write_text(text)):
                return chunk, number + 1
        return None

    def mine(self, chunk: str, number: int) -> bool:
        """Whether a lease still counts."""
        return (self.folder / f"{chunk}.{number}").exists() and not (self.folder / f"{chunk}.{number + 1}").exists()

    def give_back(self, chunk: str, number: int) -> None:
        """Leave a chunk to others."""
        (self.folder / f"{chunk}.{number}").unlink(missing_ok=True)
