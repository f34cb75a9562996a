"""One worker: takes a chunk, has its logs read, writes what came of them, and takes the next, until all are done."""

from __future__ import annotations

import contextlib
import json
import os
import random
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from vaneloop.base.errors import DeviceError, InputError
from vaneloop.fleet.files import passed, plain_bytes, whole_json
from vaneloop.fleet.folder import Entry, Folder, key_of, sources_version
from vaneloop.fleet.kinds import KINDS, checked
from vaneloop.fleet.leases import Leases, Me
from vaneloop.fleet.reader import DEVICE, Died, Reader, Stopped, TimedOut

__all__ = ["Journal", "lines", "work"]


class Journal:
    """The journal of one worker: what it did, a line each, never changed. A line torn by a kill is left out."""

    def __init__(self, run: Path, worker: str):
        """Open it for appending."""
        (run / "journal").mkdir(parents=True, exist_ok=True)
        flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW
        self.file = os.open(run / "journal" / f"{worker}.jsonl", flags, 0o644)

    def note(self, what: str, **more: Any) -> None:
        """Append a line, on the disk before this returns."""
        text = json.dumps({"at": round(time.time(), 3), "what": what, **more}, sort_keys=True)
        os.write(self.file, f"{text}\n".encode())
        os.fsync(self.file)

    def close(self) -> None:
        """Close the file."""
        os.close(self.file)


def lines(run: Path) -> Iterator[dict[str, Any]]:
    """Every line of every journal, with its ``worker``."""
    for file in sorted((run / "journal").glob("*.jsonl")):
        with open(file, encoding="utf-8", errors="replace") as f:
            for text in f:
                with contextlib.suppress(ValueError):
                    yield {**json.loads(text), "worker": file.stem}


DEATHS = 3  # of its reader, after which a log is given up
TRIES = 12  # begun and never ended, also by the death of the whole worker


def work(
    run: str | Path, *, starter: str = "", every: float = 5.0, patience: float = 60.0, wait: bool = True,
    trust: str = "", device: str = "auto",
) -> dict[str, int]:  # fmt: skip
    """Work on a run until nothing is left to do; return how many logs came to what.

    starter   name of the process that rents this one: when it is gone, this one stops too
    every     s between heartbeats
    patience  s without a heartbeat, after which another worker's chunk is taken over
    wait      stay until others have done theirs, and take over what they leave
    trust     SHA-256 of the machine (run.json) whose code may be run: a model of the user's own, controllers
    device    what runs a campaign's trials side by side: "auto", "cpu" or "cuda" (docs/campaigns.md)
    Raises InputError where this VaneLoop is not the run's, its code is not trusted, its machine is damaged, or the disk
    is full, DeviceError where the device cannot be used or fails: what is done is done.
    """
    folder = Folder(run)
    if folder.job["version"] != sources_version():
        raise InputError(
            f"{folder.path}: was begun by vaneloop {folder.job['version']}; this is {sources_version()}, whose results "
            f"do not belong beside those"
        )
    limit = checked(folder.job["kind"], folder.job["options"], folder.path).limit
    if (code := folder.code()) and trust != folder.job["machine"]:
        raise InputError(
            f"{folder.path}: its workers would run code that the folder brings: {', '.join(code)}; --trust of vaneloop "
            f"fleet work allows it"
        )
    me: Me | None = None
    try:
        folder.machine()
        me = Me(folder.path, every, starter)
        with _terminable(me):
            return _Worker(folder, me, Leases(folder.path, patience), limit, device).run(wait)
    except OSError as e:
        raise InputError(f"{folder.path}: {_short(e)}; what is done is kept, run the same command again") from None
    finally:
        if me is not None:
            me.leave()


class _Worker:
    def __init__(self, folder: Folder, me: Me, leases: Leases, limit: float = 3600.0, device: str = "cpu"):
        self.folder, self.me, self.leases, self.limit, self.device = folder, me, leases, limit, device
        self.reader = Reader(folder.job["kind"], str(folder.path), me.stopped, device)
        self.counts: dict[str, int] = {}
        self.journal = Journal(folder.path, me.name)

    def run(self, wait: bool) -> dict[str, int]:
        chunks = self.folder.chunks()
        order = sorted(chunks)
        # each begins elsewhere, so that a thousand workers do not all ask for the first chunk
        at = random.Random(self.me.name).randrange(max(len(order), 1))
        order = order[at:] + order[:at]
        try:
            while not self.me.stopped.is_set():
                done = self.folder.finished()
                order = [c for c in order if c not in done]
                if not order:
                    break
                passed("take")
                taken = self.leases.take(order, self.me.name)
                if taken is not None:
                    self._chunk(*taken, chunks[taken[0]])
                elif not wait or self.me.stopped.wait(min(self.me.every, 1.0)):
                    break
        finally:
            self.reader.stop()
            self.journal.close()
        return self.counts

    def _chunk(self, chunk: str, number: int, entries: Sequence[Entry]) -> None:
        passed("leased")
        if chunk in self.folder.finished():  # between the look and the lease
            self.folder.clear(chunk)
            return
        self.journal.note("took", chunk=chunk, lease=number)
        try:
            for i, e in enumerate(entries):
                if self.me.stopped.is_set() or not self.leases.mine(chunk, number):
                    return
                if self.folder.result(chunk, e.key) is None:
                    self._log(chunk, e, [other.path for other in entries[i + 1 :]])
            self.folder.close(chunk, entries)
        except FileNotFoundError:  # who stood still long enough may find that another has finished, and cleared up
            if chunk not in self.folder.finished() and self.leases.mine(chunk, number):
                raise
            return
        finally:
            self.leases.give_back(chunk, number)
        self.journal.note("closed", chunk=chunk)

    def _log(self, chunk: str, e: Entry, beside: Sequence[str]) -> None:
        tried = self.folder.results(chunk) / f"{e.key}.tried"
        row: dict[str, Any] | None = None
        while row is None:
            try:
                before = _tries(tried)
            except OSError:  # no plain file
                self.folder.set_aside(tried)
                before = []
            row = _given_up(before)
            if row is None:
                _append(tried, "begin")
                self.journal.note("begin", key=e.key, path=e.path)
                passed("begin")
                row = self._read(e, tried, before, beside)
            if row is None and self.me.stopped.is_set():  # an answer that has come is kept all the same
                return
        whole_json(self.folder.results(chunk) / f"{e.key}.json", {"key": e.key, **row})
        passed("result")
        tried.unlink(missing_ok=True)
        self.counts[row["status"]] = self.counts.get(row["status"], 0) + 1
        self.journal.note("end", key=e.key, status=row["status"])

    def _read(self, e: Entry, tried: Path, before: Sequence[str], beside: Sequence[str]) -> dict[str, Any] | None:
        """What comes of a log now; None: to be tried again. After a failure it is tried without those ``beside``, and
        with "auto" on the processor.
        """
        if (bad := _unlike(e)) is not None:
            return bad
        together = bool(beside) and KINDS[self.folder.job["kind"]].together and not before
        device = "cpu" if before and self.device == "auto" else ""
        try:
            row = self.reader.ask(e.path, self.folder.job["options"], self.limit, () if before else beside, device)
        except Stopped:
            return None
        except DeviceError as why:
            self.journal.note("device", key=e.key, reason=str(why))
            _append(tried, DEVICE)
            raise
        except Died as why:
            self.journal.note("died", key=e.key, reason=str(why))
            _append(tried, f"died {why}")
            return None
        except TimedOut as why:
            if together:  # the time is one log's
                _append(tried, f"late {why}")
                return None
            return {"status": "timeout", "reason": str(why)}
        if (bad := _unlike(e)) is not None:
            return bad
        if row["status"] == "defect" and not any(x.startswith("defect") for x in before):
            # once more, in a process that begins anew: compiled code read while another process wrote it, say
            _append(tried, f"defect {row['reason']}")
            self.reader.stop()
            return None
        return row


def _given_up(before: Sequence[str]) -> dict[str, Any] | None:
    """The row of a log that was tried often enough; None: it is tried (again)."""
    died = [x.removeprefix("died ") for x in before if x.startswith("died ")]
    if len(died) >= DEATHS:
        return {"status": "died", "reason": f"{died[-1]}, {len(died)} times"}
    begun = sum(x == "begin" for x in before)
    if begun >= TRIES:
        return {"status": "died", "reason": f"was begun {begun} times, and its worker ended each time"}
    return None


def _unlike(e: Entry) -> dict[str, Any] | None:
    """The row of a log that is not what the run took up; None: it is."""
    try:
        if key_of(e.path) == e.key:
            return None
    except OSError as why:
        return {"status": "unreadable", "reason": f"cannot be read ({why.strerror})"}
    reason = "its content has changed since the run took it up; vaneloop fleet run takes it up anew"
    return {"status": "changed", "reason": reason}


def _tries(file: Path) -> list[str]:
    """What a log's file says of how it was tried, without tries that a device broke off."""
    out: list[str] = []
    for line in _lines(file):
        if line == DEVICE:
            del out[-1:]
        else:
            out.append(line)
    return out


def _lines(file: Path) -> list[str]:
    try:
        return plain_bytes(file).decode("utf-8", "replace").splitlines()
    except FileNotFoundError:
        return []


def _append(file: Path, line: str) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW
    with open(os.open(file, flags, 0o644), "a", encoding="utf-8") as f:
        f.write(" ".join(line.split()) + "\n")
        f.flush()
        os.fsync(f.fileno())


@contextlib.contextmanager
def _terminable(me: Me) -> Iterator[None]:
    """SIGTERM (a queue that wants its node back) ends the work in order; only a main thread can hear it."""
    stop: Callable[..., None] = lambda *_: me.stopped.set()  # noqa: E731
    try:
        before = signal.signal(signal.SIGTERM, stop)
    except ValueError:
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _short(e: OSError) -> str:
    return f"{e.filename}: {e.strerror}" if e.filename else str(e.strerror or e)
