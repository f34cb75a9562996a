"""How far a run is, from its files."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from vaneloop.base.errors import InputError
from vaneloop.fleet.folder import KEY, STATUSES, Folder
from vaneloop.fleet.leases import Leases, gone, who_is

__all__ = ["State", "came_to", "state_of", "tidy"]


@dataclass(frozen=True)
class State:
    """Logs of a run by what came of them, and who works on it.

    logs      paths taken up, each once
    contents  different contents among them, which is what has to be done
    done      of these, in finished chunks and in chunks in work
    came      status -> contents, of the finished chunks
    workers   processes that are not known to be gone: name, kind
    damaged   what of the run's folder cannot be used: name, reason
    """

    logs: int
    contents: int
    done: int
    came: dict[str, int] = field(default_factory=dict)
    workers: dict[str, str] = field(default_factory=dict)
    damaged: dict[str, str] = field(default_factory=dict)

    def json(self) -> dict[str, Any]:
        """The same as plain data."""
        return {
            "logs": self.logs, "contents": self.contents, "done": self.done, "came_to": self.came,
            "workers": self.workers, "damaged": self.damaged,
        }  # fmt: skip


def came_to(folder: Folder) -> dict[str, str]:
    """Status of every content in a finished chunk; of one that was done again, the later."""
    found: dict[str, str] = {}
    for table in folder.parts("key", "status"):
        for row in reversed(table.to_pylist()):
            if row["status"] in STATUSES and KEY.fullmatch(row["key"] or ""):
                found.setdefault(row["key"], row["status"])
    return found


def state_of(folder: Folder) -> State:
    """Look how far a run is."""
    entries, statuses = folder.entries(), came_to(folder)
    unreadable = sum(e.key == "" for e in entries)
    came: dict[str, int] = Counter(statuses.values()) + Counter(unreadable=unreadable)  # without what is zero
    contents = len({e.key for e in entries if e.key} | statuses.keys()) + unreadable
    done = len(statuses) + unreadable + sum(n for _, n in folder.begun())
    leases = Leases(folder.path)
    workers = {file.stem: str(who["kind"]) for file, who in _workers(folder) if not leases.dead(file.stem)}
    came = dict(sorted(came.items()))
    return State(len(entries), contents, min(done, contents), came, workers, dict(sorted(folder.damaged.items())))


def tidy(folder: Folder) -> None:
    """Clear up after processes that were killed: files of finished chunks, names of workers that are gone."""
    folder.tidy()
    for file, who in _workers(folder):
        if gone(who):
            for f in (file, file.with_suffix(".beat")):
                with suppress(OSError):
                    f.unlink()


def _workers(folder: Folder) -> Iterator[tuple[Path, dict[str, Any]]]:
    """The files of the workers, and what they say; one that leaves meanwhile is left out, a damaged one noted."""
    for name in folder.names("workers"):
        file = folder.path / "workers" / name
        if file.suffix == ".json":
            try:
                yield file, who_is(file)
            except FileNotFoundError:
                continue
            except InputError as e:
                folder.note(file, str(e).removeprefix(f"{file}: "))
