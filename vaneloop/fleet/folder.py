"""The folder of a fleet run. All its state is in files, so that any process can end at any moment.

    run.json               what is done with each log, VaneLoop's version and sources, SHA-256 of the machine
    machine/               tables, model file and mapping: copies, so that all workers use the same
    logs/000000.parquet    a batch of logs: path, SHA-256, engine, time, chunk; later batches add, or replace a path
    leases/CHUNK.N         who works on a chunk; the greatest N counts
    workers/W.json, W.beat who a worker is, and that it lives
    journal/W.jsonl        what a worker did, a line each, never changed
    results/CHUNK/KEY.json what came of one log of a chunk in work: its status is done, refused, defect, died, timeout,
                           changed or unreadable
    parts/CHUNK.parquet    what came of all logs of a finished chunk

A result belongs to the content of a log (KEY: SHA-256 and suffix), not to its name: a copy is not diagnosed again.
"""

from __future__ import annotations

import json
import os
import shutil
import stat
import time
from collections.abc import Iterable, Iterator, Sequence, Set
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

from vaneloop.base import tables
from vaneloop.base.errors import InputError
from vaneloop.fleet.files import create, digest_of, passed, read_json, whole
from vaneloop.fleet.sources import Source

__all__ = ["Entry", "Folder", "copies_of", "key_of", "sources_version"]

_COLUMNS = ("key", "status", "reason", "verdict", "answer")
_ROOT = Path(__file__).parents[2]
LEFT_BEHIND = 3600.0  # s since it was last written to, after which nobody is at work on a temporary file
# what a result follows from: how it is found and written, and the tables of a machine that nobody gave
_SOURCES = (
    "controller", "plant", "hil", "vaneloop/base", "vaneloop/discrepancy", "vaneloop/verbs", "vaneloop/fleet"
)  # fmt: skip


@dataclass(frozen=True)
class Entry:
    """One log of the run: where it is, what is in it, whose it is.

    key     its content: SHA-256 and suffix; "": it cannot be read, ``reason`` says why
    chunk   the chunk that does it; "": another entry of the same content has one
    engine  "" where it is not known
    time    s since 1970, of the log's start; None: not known
    """

    path: str
    key: str
    size: int
    mtime_ns: int
    chunk: str
    engine: str
    time: float | None
    reason: str = ""


def key_of(path: str) -> str:
    """Key of a log: what is in it, and its suffix, which says how to read it. Raises OSError."""
    return f"{digest_of(path)}{Path(path).suffix.lower()}"


def copies_of(files: dict[str, str]) -> dict[str, str]:
    """Where in a run's folder the copies of files and folders stand, by the same names."""
    return {name: f"machine/{name}{Path(f).suffix}" for name, f in files.items()}


@cache
def sources_version() -> str:
    """VaneLoop's version and a digest of the sources, tables and numba's version from which a result follows: results
    of other code do not belong beside these.
    """
    import hashlib
    from importlib.metadata import PackageNotFoundError, version

    try:
        number = version("vaneloop")
    except PackageNotFoundError:
        number = "0"
    h = hashlib.sha256(version("numba").encode())
    kinds = (".py", ".toml", ".dbc", ".c", ".h")
    for place in (*(_ROOT / p for p in _SOURCES), tables.path("plant.toml").parent):
        for f in sorted(f for f in place.rglob("*.*") if f.suffix in kinds and "__pycache__" not in f.parts):
            h.update(f"{f.relative_to(place).as_posix()}:{digest_of(f)}\n".encode())
    return f"{number}+{h.hexdigest()[:16]}"


class Folder:
    """A run folder, by its path."""

    def __init__(self, path: str | Path):
        """Open a run that is there. Raises InputError where ``path`` is none."""
        self.path = Path(path)
        if not (self.path / "run.json").is_file():
            raise InputError(
                f"{self.path}: is no fleet run (it has no run.json); vaneloop fleet run LOGS --out makes one"
            )
        self.job: dict[str, Any] = read_json(self.path / "run.json")
        if self.job.get("schema") != 1:
            raise InputError(f"{self.path}: run.json has schema {self.job.get('schema')!r}; allowed: 1")

    @classmethod
    def begin(cls, path: str | Path, function: str, options: dict[str, Any], files: dict[str, str]) -> Folder:
        """Make the run, or open it where it was begun before with the same job, machine and sources.

        function  module:name of what is done with each log (`vaneloop.fleet.reader`)
        options   its plain options
        files     name -> file or folder that it needs, copied
        """
        root = Path(path)
        if root.exists() and not root.is_dir():
            raise InputError(f"--out {root}: is a file; a folder is needed")
        if root.is_dir() and not (root / "run.json").is_file() and any(
            p.name not in ("machine",) and not p.name.startswith(".") for p in root.iterdir()
        ):  # fmt: skip
            raise InputError(f"--out {root}: holds other files and is no fleet run; give an empty or a new folder")
        digest = _digest_of_all(files)
        job = {
            "schema": 1, "function": function, "options": options, "version": sources_version(), "machine": digest,
            "files": copies_of(files),
        }  # fmt: skip
        if not (root / "run.json").is_file():
            try:
                _copy(files, root / "machine")
                create(root / "run.json", lambda f: f.write_text(json.dumps(job, indent=2, sort_keys=True) + "\n"))
            except OSError as e:
                raise InputError(f"--out {root}: cannot be written ({e.strerror})") from None
        folder = cls(root)
        for what in ("function", "options", "machine", "version"):
            if folder.job[what] != job[what]:
                raise InputError(
                    f"--out {root}: was begun with {what} {_short(folder.job[what])}, not {_short(job[what])}; "
                    f"give another --out"
                )
        return folder

    @property
    def of_campaign(self) -> bool:
        """Whether trials of a campaign are run here, not logs diagnosed."""
        return "plan" in self.job["options"]

    # ---- the logs ----------------------------------------------------------------------------------------------------

    def entries(self) -> list[Entry]:
        """Every log, each path once: as the latest batch has it, in the order of the batches."""
        found: dict[str, Entry] = {}
        for e in _rows(self._batches()):
            found.pop(e.path, None)
            found[e.path] = e
        return list(found.values())

    def chunks(self) -> dict[str, list[Entry]]:
        """The chunks of all batches and their logs; a chunk never changes."""
        out: dict[str, list[Entry]] = {}
        for e in _rows(self._batches()):
            if e.chunk:
                out.setdefault(e.chunk, []).append(e)
        return out

    def finished(self) -> set[str]:
        """Names of the chunks that are done."""
        try:
            return {f.name.removesuffix(".parquet") for f in os.scandir(self.path / "parts") if f.name[0] != "."}
        except FileNotFoundError:
            return set()

    def add(self, logs: Sequence[Source], in_chunk: int | None = None, again: Set[str] = frozenset()) -> int:
        """Take up logs that are new or have changed since they were taken up; return how many.

        in_chunk  logs in a chunk (default: few logs, small chunks)
        again     keys that are to be done once more
        """
        import pyarrow as pa
        import pyarrow.parquet as pq

        while True:
            batches = self._batches()
            before = list(_rows(batches))
            known = {e.path: e for e in before}
            keys = {e.key for e in before if e.chunk} - again
            other = [s for s in logs if not _same(s, known.get(s.path), again)]
            with ThreadPoolExecutor(8) as pool:
                looked = pool.map(lambda s, known=known: _look(s, known.get(s.path), again), other)
                new = [e for e in looked if e is not None]
            if not new:
                return 0
            batch = len(batches)  # as many as were read: what came while the logs were looked at has this number
            size = in_chunk or min(max(len(new) // 200, 1), 64)
            n, rows = 0, []
            for e in new:
                fresh = e.key not in keys and e.key != ""
                keys.add(e.key)
                rows.append({**asdict(e), "chunk": f"{batch:06d}-{n // size:06d}" if fresh else ""})
                n += fresh
            table = pa.Table.from_pylist(rows, schema=_schema())
            if create(self.path / "logs" / f"{batch:06d}.parquet", partial(pq.write_table, table)):
                return len(new)
            # another starter was quicker: what it took up is known now

    def _batches(self) -> list[Path]:
        return sorted((self.path / "logs").glob("[0-9]*.parquet"))

    # ---- results -----------------------------------------------------------------------------------------------------

    def results(self, chunk: str) -> Path:
        """Folder of the results of a chunk in work."""
        return self.path / "results" / chunk

    def close(self, chunk: str, entries: Sequence[Entry]) -> bool:
        """Put the results of a chunk into its part, and clear its files away; False: a result is missing."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        if chunk in self.finished():
            return True
        rows = []
        for e in entries:
            try:
                rows.append(read_json(self.results(chunk) / f"{e.key}.json"))
            except FileNotFoundError:
                return chunk in self.finished()
        table = pa.Table.from_pylist(
            [{**{c: r.get(c) for c in _COLUMNS}, "answer": _json(r.get("answer"))} for r in rows],
            schema=pa.schema([(c, pa.string()) for c in _COLUMNS]),
        )
        whole(self.path / "parts" / f"{chunk}.parquet", lambda f: pq.write_table(table, f, compression="zstd"))
        passed("part")
        self.clear(chunk)
        return True

    def clear(self, chunk: str) -> None:
        """Remove what a finished chunk does not need any more."""
        shutil.rmtree(self.results(chunk), ignore_errors=True)
        for lease in (self.path / "leases").glob(f"{chunk}.*"):
            lease.unlink(missing_ok=True)

    def tidy(self) -> None:
        """Clear up after processes that were killed between a part and its clearing, or while they wrote a file."""
        for file in self.path.rglob(".*.part"):
            with suppress(FileNotFoundError):  # it has become whole meanwhile
                if time.time() - file.stat().st_mtime > LEFT_BEHIND:
                    file.unlink()
        done = self.finished()
        for folder in (self.path / "results").glob("*"):
            if folder.name in done:
                self.clear(folder.name)

    def begun(self) -> Iterator[tuple[str, int]]:
        """Chunks in work, and how many results each has by now."""
        done = self.finished()
        for folder in sorted((self.path / "results").glob("*")):
            if folder.name not in done:
                yield folder.name, sum(1 for f in folder.glob("*.json") if f.name[0] != ".")


def _rows(batches: Iterable[Path]) -> Iterator[Entry]:
    """Every row of these batches."""
    import pyarrow.parquet as pq

    for batch in batches:
        for row in pq.read_table(batch).to_pylist():
            yield Entry(**row)


def _schema() -> Any:
    import pyarrow as pa

    text, number = pa.string(), pa.int64()
    return pa.schema([
        ("path", text), ("key", text), ("size", number), ("mtime_ns", number), ("chunk", text), ("engine", text),
        ("time", pa.float64()), ("reason", text),
    ])  # fmt: skip


def _same(s: Source, known: Entry | None, again: Set[str]) -> bool:
    """Whether a log is as it is ``known``, and not to be done once more: nothing has to be read for that."""
    if known is None or known.key in again or s.engine not in ("", known.engine) or s.time not in (None, known.time):
        return False
    try:
        there = os.stat(s.path)
    except OSError:
        return False
    return stat.S_ISREG(there.st_mode) and (known.size, known.mtime_ns) == (there.st_size, there.st_mtime_ns)


def _look(s: Source, known: Entry | None, again: Set[str]) -> Entry | None:
    """The log as an entry; None where nothing has changed since it was ``known``."""
    try:
        there = os.stat(s.path)
        if not stat.S_ISREG(there.st_mode):
            raise OSError(0, "it is no plain file")
        same = known is not None and (known.size, known.mtime_ns) == (there.st_size, there.st_mtime_ns)
        if same and known is not None and s.engine in ("", known.engine) and s.time in (None, known.time):
            return replace(known, chunk="") if known.key in again else None
        s = s.described()
        key = known.key if same and known is not None else key_of(s.path)
        return Entry(s.path, key, there.st_size, there.st_mtime_ns, "", s.engine, s.time)
    except OSError as e:
        reason = f"cannot be read ({e.strerror})"
        if known is not None and known.reason == reason:
            return None
        return Entry(s.path, "", 0, 0, "", s.engine or Path(s.path).parent.name, s.time, reason)


def _digest_of_all(files: dict[str, str]) -> str:
    """SHA-256 of what files and folders hold, by name."""
    import hashlib

    h = hashlib.sha256()
    for name, f in sorted(files.items()):
        path = Path(f)
        for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
            if file.is_file():
                try:
                    inside = file.relative_to(path).as_posix() if path.is_dir() else ""
                    h.update(f"{name}/{inside}:{digest_of(file)}\n".encode())
                except OSError as e:
                    raise InputError(f"{file}: cannot be read ({e.strerror})") from None
    return h.hexdigest()


def _copy(files: dict[str, str], to: Path) -> None:
    """Copy files and folders, all at once: of two starters one is the first."""
    import tempfile

    to.parent.mkdir(parents=True, exist_ok=True)
    made = Path(tempfile.mkdtemp(prefix=".machine-", dir=to.parent))
    try:
        for name, copy in copies_of(files).items():
            take = shutil.copytree if Path(files[name]).is_dir() else shutil.copyfile
            take(files[name], made / Path(copy).name)
        made.chmod(0o755)
        os.rename(made, to)
    except OSError:
        if not to.is_dir():
            raise
    finally:
        shutil.rmtree(made, ignore_errors=True)


def _json(answer: Any) -> str | None:
    return None if answer is None else json.dumps(answer, sort_keys=True)


def _short(value: object) -> str:
    text = value if isinstance(value, str) else json.dumps(value, sort_keys=True)
    return text if len(text) <= 60 else text[:57] + "..."
