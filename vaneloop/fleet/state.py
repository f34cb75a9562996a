"""How far a run is, from its files."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from vaneloop.fleet.files import read_json
from vaneloop.fleet.folder import Folder
from vaneloop.fleet.leases import Leases, gone
from vaneloop.fleet.tables import database

__all__ = ["State", "came_to", "state_of", "tidy"]


@dataclass(frozen=True)
class State:
    """Logs of a run by what came of them, and who works on it.

    logs      paths taken up, each once
    contents  different contents among them, which is what has to be done
    done      of these, in finished chunks and in chunks in work
    came      status -> contents, of the finished chunks
    workers   processes that are not known to be gone: name, kind
    """

    logs: int
    contents: int
    done: int
    came: dict[str, int] = field(default_factory=dict)
    workers: dict[str, str] = field(default_factory=dict)

    def json(self) -> dict[str, Any]:
        """The same as plain data."""
        return {
            "logs": self.logs, "contents": self.contents, "done": self.done, "came_to": self.came,
            "workers": self.workers,
        }  # fmt: skip


def came_to(folder: Folder) -> dict[str, str]:
    """Status of every content in a finished chunk; of one that was done again, the later."""
    if not folder.finished():
        return {}
    query = "SELECT key, status FROM read_parquet($1, filename = true) ORDER BY filename"
    return dict(database().execute(query, [str(folder.path / "parts" / "*.parquet")]).fetchall())


def state_of(folder: Folder) -> State:
    """Look how far a run is."""
    entries, statuses = folder.entries(), came_to(folder)
    unreadable = sum(e.key == "" for e in entries)
    came = Counter(statuses.values()) + Counter(unreadable=unreadable)  # without what is zero
    contents = len({e.key for e in entries if e.key} | statuses.keys()) + unreadable
    done = len(statuses) + unreadable + sum(n for _, n in folder.begun())
    leases = Leases(folder.path)
    workers = {file.stem: str(who["kind"]) for file, who in _workers(folder) if not leases.dead(file.stem)}
    return State(len(entries), contents, min(done, contents), dict(sorted(came.items())), workers)


def tidy(folder: Folder) -> None:
    """Clear up after processes that were killed: files of finished chunks, names of workers that are gone."""
    folder.tidy()
    for file, who in _workers(folder):
        if gone(who):
            for f in (file, file.with_suffix(".beat")):
                f.unlink(missing_ok=True)


def _workers(folder: Folder) -> Iterator[tuple[Path, dict[str, Any]]]:
    """The files of the workers, and what they say; one that leaves meanwhile is left out."""
    for file in sorted((folder.path / "workers").glob("*.json")):
        try:
            who = read_json(file)
        except FileNotFoundError:
            continue
        yield file, who
