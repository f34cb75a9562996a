"""The folder of a fleet run. All its state is in files, so that any process can end at any moment.

    run.json               kind of the work, its options, VaneLoop's version and sources, SHA-256 of the machine
    machine/               tables, model file and mapping: copies, so that all workers use the same
    logs/000000.parquet    a batch of logs: path, SHA-256, engine, time, chunk; later batches add, or replace a path
    leases/CHUNK.N         who works on a chunk; the greatest N counts
    workers/W.json, W.beat who a worker is, and that it lives
    journal/W.jsonl        what a worker did, a line each, never changed
    results/CHUNK/KEY.json what came of one log of a chunk in work: its status is done, refused, defect, died, timeout,
                           changed or unreadable
    parts/CHUNK.parquet    what came of all logs of a finished chunk

A result belongs to the content of a log (KEY: SHA-256 and suffix), not to its name: a copy is not diagnosed again.

Another may have made the folder, or a disk spoilt it. So a link in it is not followed, a name is used only where it has
the form that this module gives it, and what is damaged is noted with its reason (`Folder.damaged`) and left out.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import shutil
import stat
import tempfile
import time
import uuid
from collections.abc import Iterator, Sequence, Set
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from importlib import metadata
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from vaneloop.base import tables
from vaneloop.base.errors import InputError
from vaneloop.base.version import installed_version
from vaneloop.fleet.files import create, digest_of, passed, plain_file, read_json, reason_of, whole
from vaneloop.fleet.kinds import TRIAL
from vaneloop.fleet.sources import Source

__all__ = ["STATUSES", "Entry", "Folder", "copies_of", "key_of", "sources_version"]

_COLUMNS = ("key", "status", "reason", "verdict", "answer")
STATUSES = ("done", "refused", "defect", "died", "timeout", "changed", "unreadable")  # what may come of a log
ROOMS = ("machine", "logs", "leases", "workers", "journal", "results", "parts", "trials", "worst", "failed")
CODE = ("system", "controller", "firmware.")  # files of a machine that are run and not read; a dot: all that begin so
MOST_JOB = 4 << 20  # bytes of run.json
MOST_ROWS = 10_000_000  # of a table
KEY = re.compile(r"[0-9a-f]{64}(\.[a-z0-9_+-]{1,16})?")
CHUNK = re.compile(r"[0-9]{6,12}-[0-9]{6,12}")
_BATCH = re.compile(r"([0-9]{6,12})\.parquet")
_COPY = re.compile(r"machine/[^/\x00-\x1f\x7f]{1,200}")
_SUFFIX = re.compile(r"\.[a-z0-9_+-]{1,16}")
_ROOT = Path(__file__).parents[2]
LEFT_BEHIND = 3600.0  # s since it was last written to, after which nobody is at work on a temporary file
# what a result follows from: how it is found and written, and the tables of a machine that nobody gave
_SOURCES = (
    "controller", "plant", "hil",
    *(f"vaneloop/{room}" for room in ("base", "identification", "pages", "verbs", "fleet")),
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
    """Key of a log: what is in it, and its suffix, which says how to read it; of an odd one a digest. OSError."""
    suffix = Path(path).suffix.lower()
    if suffix and not _SUFFIX.fullmatch(suffix):
        suffix = f".{hashlib.sha256(os.fsencode(suffix)).hexdigest()[:12]}"
    return f"{digest_of(path)}{suffix}"


def copies_of(files: dict[str, str]) -> dict[str, str]:
    """Where in a run's folder the copies of files and folders stand, by the same names."""
    return {name: f"machine/{name}{Path(f).suffix}" for name, f in files.items()}


@cache
def sources_version() -> str:
    """VaneLoop's version and a digest of the sources, tables and numba's version from which a result follows: results
    of other code do not belong beside these.
    """
    h = hashlib.sha256(metadata.version("numba").encode())
    kinds = (".py", ".toml", ".dbc", ".c", ".h")
    for place in (*(_ROOT / p for p in _SOURCES), tables.path("plant.toml").parent):
        for f in sorted(f for f in place.rglob("*.*") if f.suffix in kinds and "__pycache__" not in f.parts):
            h.update(f"{f.relative_to(place).as_posix()}:{digest_of(f)}\n".encode())
    return f"{installed_version()}+{h.hexdigest()[:16]}"


class Folder:
    """A run folder, by its path.

    job      content of run.json
    damaged  what was found damaged so far: name within the folder -> reason
    """

    def __init__(self, path: str | Path):
        """Open a run that is there. Raises InputError where ``path`` is none, or its run.json is damaged."""
        self.path = Path(path)
        self.damaged: dict[str, str] = {}
        try:
            found = read_json(self.path / "run.json", MOST_JOB)
        except FileNotFoundError:
            raise InputError(
                f"{self.path}: is no fleet run (it has no run.json); vaneloop fleet run LOGS --out makes one"
            ) from None
        self.job: dict[str, Any] = _checked(found, self.path)

    @classmethod
    def begin(cls, path: str | Path, kind: str, options: dict[str, Any], files: dict[str, str]) -> Folder:
        """Make the run, or open it where it was begun before with the same job, machine and sources.

        kind     what is done with each log (`vaneloop.fleet.kinds.KINDS`)
        options  its plain options
        files    name -> file or folder that it needs, copied
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
            "schema": 1, "kind": kind, "options": options, "version": sources_version(), "machine": digest,
            "files": copies_of(files),
        }  # fmt: skip
        if not (root / "run.json").is_file():
            try:
                _copy(files, root / "machine")
                _same_machine(root, job)
                create(root / "run.json", lambda f: f.write_text(json.dumps(job, indent=2, sort_keys=True) + "\n"))
            except OSError as e:
                raise InputError(f"--out {root}: cannot be written ({e.strerror})") from None
        folder = cls(root)
        for what in ("kind", "options", "machine", "version"):
            if folder.job.get(what) != job[what]:
                raise InputError(
                    f"--out {root}: was begun with {what} {_short(folder.job.get(what))}, not {_short(job[what])}; "
                    f"give another --out"
                )
        folder.machine()
        return folder

    @property
    def of_campaign(self) -> bool:
        """Whether trials of a campaign are run here, not logs diagnosed."""
        return bool(self.job["kind"] == TRIAL) or "plan" in self.job["options"]

    def machine(self) -> dict[str, str]:
        """The files of the machine by their names, for who is going to work here.

        Raises InputError where they are not those that the run was begun with, or where a folder of the run leads
        elsewhere.
        """
        for room in ROOMS:
            if (bad := _no_room(self.path / room)) is not None:
                raise InputError(f"{self.path / room}: {bad}; the run folder is damaged, and nothing is done in it")
        _same_machine(self.path, self.job)
        return {name: str(self.path / copy) for name, copy in self.job["files"].items()}

    def code(self) -> list[str]:
        """Files of the machine that whoever works on the run runs: a model of the user's own, controllers."""
        return [str(self.path / f) for n, f in sorted(self.job["files"].items())
                if any(n.startswith(c) if c.endswith(".") else n == c for c in CODE)]  # fmt: skip

    def note(self, file: Path, why: str) -> None:
        """Note that a part of the run is damaged."""
        self.damaged.setdefault(file.relative_to(self.path).as_posix(), why)

    def names(self, *room: str) -> list[str]:
        """Names in a folder of the run, in order, without hidden ones; none where it is not there or is a link."""
        at = self.path.joinpath(*room)
        if (bad := _no_room(at)) is not None:
            self.note(at, bad)
            return []
        try:
            return sorted(f for f in os.listdir(at) if f[0] != ".")
        except FileNotFoundError:
            return []
        except OSError as e:
            self.note(at, f"cannot be read ({reason_of(e)})")
            return []

    def room(self, *names: str) -> Path:
        """A folder of the run to write into, made where it is not there. Raises InputError where it leads elsewhere."""
        at = self.path
        for name in names:
            at /= name
            if (bad := _no_room(at)) is not None:
                raise InputError(f"{at}: {bad}; the run folder is damaged, and nothing is written there")
            at.mkdir(exist_ok=True)
        return at

    def set_aside(self, file: Path) -> None:
        """Take a damaged thing out of the way: under a hidden name, which nobody reads."""
        with suppress(FileNotFoundError):
            os.rename(file, file.with_name(f".{file.name[:100]}.{uuid.uuid4().hex[:12]}.damaged"))

    def table(self, file: Path, schema: pa.Schema) -> pa.Table | None:
        """A Parquet file of the run with these columns; None: it is damaged, which is noted."""
        try:
            with open(plain_file(file), "rb") as f:
                opened = pq.ParquetFile(f)
                if opened.metadata.num_rows > MOST_ROWS:
                    raise OSError(0, f"it has {opened.metadata.num_rows:,} rows; allowed: {MOST_ROWS:,}")
                if missing := [n for n in schema.names if n not in opened.schema_arrow.names]:
                    raise OSError(0, f"it lacks the column {missing[0]}")
                found = opened.read(columns=schema.names).select(schema.names).cast(schema)
                found.validate(full=True)
                return found
        except FileNotFoundError:
            return None
        except OSError as e:
            self.note(file, f"cannot be read ({' '.join(reason_of(e).split())[:120]})")
        except (pa.ArrowException, ValueError, KeyError) as e:
            self.note(file, f"is damaged ({' '.join(str(e).split())[:120]})")
        return None

    # ---- the logs ----------------------------------------------------------------------------------------------------

    def entries(self) -> list[Entry]:
        """Every log, each path once: as the latest batch has it, in the order of the batches."""
        found: dict[str, Entry] = {}
        for e in self._rows():
            found.pop(e.path, None)
            found[e.path] = e
        return list(found.values())

    def chunks(self) -> dict[str, list[Entry]]:
        """The chunks of all batches and their logs; a chunk never changes."""
        out: dict[str, list[Entry]] = {}
        for e in self._rows():
            if e.chunk:
                out.setdefault(e.chunk, []).append(e)
        return out

    def finished(self) -> set[str]:
        """Names of the chunks that are done."""
        return {name for f in self.names("parts") if CHUNK.fullmatch(name := f.removesuffix(".parquet")) and name != f}

    def add(self, logs: Sequence[Source], in_chunk: int | None = None, again: Set[str] = frozenset()) -> int:
        """Take up logs that are new or have changed since they were taken up; return how many.

        in_chunk  logs in a chunk (default: few logs, small chunks)
        again     keys that are to be done once more
        """
        while True:
            batch = max(self._batches(), default=-1) + 1  # what comes while the logs are looked at has this number
            before = list(self._rows())
            known = {e.path: e for e in before}
            keys = {e.key for e in before if e.chunk} - again
            other = [s for s in logs if not _same(s, known.get(s.path), again)]
            with ThreadPoolExecutor(8) as pool:
                looked = pool.map(lambda s, known=known: _look(s, known.get(s.path), again), other)
                new = [e for e in looked if e is not None]
            if not new:
                return 0
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

    def _batches(self) -> dict[int, Path]:
        return {int(m[1]): self.path / "logs" / m[0] for f in self.names("logs") if (m := _BATCH.fullmatch(f))}

    def _rows(self) -> Iterator[Entry]:
        """Every row of every batch that can be an entry; others are noted."""
        for _, batch in sorted(self._batches().items()):
            table = self.table(batch, _schema())
            for number, row in enumerate(table.to_pylist() if table is not None else [], 1):
                if (bad := _no_entry(row)) is not None:
                    self.note(batch, f"row {number}: {bad}")
                else:
                    yield Entry(**row)

    # ---- results -----------------------------------------------------------------------------------------------------

    def results(self, chunk: str) -> Path:
        """Folder of the results of a chunk in work. What stands in its place and is none is set aside."""
        at = self.path / "results" / chunk
        if _no_room(at) is not None:
            self.set_aside(at)
        return at

    def result(self, chunk: str, key: str) -> dict[str, Any] | None:
        """What came of a log of a chunk in work; None: nothing yet. A damaged result is set aside, to be made anew."""
        file = self.results(chunk) / f"{key}.json"
        try:
            row = read_json(file)
        except FileNotFoundError:
            return None
        except InputError:
            row = None
        if _is_result(row, key):
            return dict(row)
        self.set_aside(file)
        return None

    def close(self, chunk: str, entries: Sequence[Entry]) -> bool:
        """Put the results of a chunk into its part, and clear its files away; False: a result is missing."""
        if chunk in self.finished():
            return True
        rows = []
        for e in entries:
            if (row := self.result(chunk, e.key)) is None:
                return chunk in self.finished()
            rows.append(row)
        table = pa.Table.from_pylist(
            [{**{c: r.get(c) for c in _COLUMNS}, "answer": _json(r.get("answer"))} for r in rows], schema=_part_schema()
        )
        whole(self.path / "parts" / f"{chunk}.parquet", lambda f: pq.write_table(table, f, compression="zstd"))
        passed("part")
        self.clear(chunk)
        return True

    def parts(self, *columns: str) -> Iterator[pa.Table]:
        """These columns of what came of all logs of each finished chunk, the latest chunk first."""
        for chunk in sorted(self.finished(), reverse=True):
            table = self.table(self.path / "parts" / f"{chunk}.parquet", _part_schema(columns))
            if table is not None:
                yield table

    def clear(self, chunk: str) -> None:
        """Remove what a finished chunk does not need any more."""
        shutil.rmtree(self.results(chunk), ignore_errors=True)
        for lease in self.names("leases"):
            if lease.startswith(f"{chunk}."):
                with suppress(OSError):
                    (self.path / "leases" / lease).unlink()

    def tidy(self) -> None:
        """Clear up after processes that were killed between a part and its clearing, or while they wrote a file; and
        set aside parts that are damaged: their logs are done anew.
        """
        rooms = [
            (),
            *((r,) for r in ROOMS),
            *((r, f) for r in ("results", "trials", "worst", "failed") for f in self.names(r)),
        ]
        for room in rooms:
            self._sweep(self.path.joinpath(*room))
        for chunk in self.finished():
            part = self.path / "parts" / f"{chunk}.parquet"
            table = self.table(part, _part_schema())
            if table is None or not all(
                status in STATUSES and key is not None and KEY.fullmatch(key)
                for key, status in zip(table["key"].to_pylist(), table["status"].to_pylist(), strict=True)
            ):
                self.set_aside(part)
        done = self.finished()
        for chunk in self.names("results"):
            if chunk in done:
                self.clear(chunk)

    def _sweep(self, room: Path) -> None:
        """Remove temporary files that nobody is at work on from a folder of the run."""
        if _no_room(room) is not None or not room.is_dir():
            return
        for name in os.listdir(room):
            if name[0] == "." and name.endswith(".part"):
                with suppress(OSError):  # it has become whole meanwhile, or is no file
                    there = os.lstat(room / name)
                    if stat.S_ISREG(there.st_mode) and time.time() - there.st_mtime > LEFT_BEHIND:
                        (room / name).unlink()

    def begun(self) -> Iterator[tuple[str, int]]:
        """Chunks in work, and how many results each has by now."""
        done = self.finished()
        for chunk in self.names("results"):
            if CHUNK.fullmatch(chunk) and chunk not in done:
                yield chunk, sum(f.endswith(".json") for f in self.names("results", chunk))


def _checked(job: Any, run: Path) -> dict[str, Any]:
    """What run.json says, where each key has a value that it may have. Raises InputError."""
    if not isinstance(job, dict):
        raise InputError(f"{run}: run.json holds no table of keys and values; the run folder is damaged")
    if job.get("schema") != 1 or isinstance(job["schema"], bool):
        raise InputError(f"{run}: run.json has schema {_short(job.get('schema'))}; allowed: 1")
    job.setdefault("kind", "")
    for key, kind in (("kind", str), ("version", str), ("machine", str), ("options", dict), ("files", dict)):
        if not isinstance(job.get(key), kind):
            what = "a text" if kind is str else "a table"
            raise InputError(f"{run}: run.json has {key} {_short(job.get(key))}; it must be {what}")
    for name, copy in job["files"].items():
        if not isinstance(copy, str) or not _COPY.fullmatch(copy) or copy.endswith(("/.", "/..")):
            raise InputError(f"{run}: run.json has the file {_short(name)} at {_short(copy)}; allowed: machine/NAME")
    inner = job["options"].get("files", job["files"])
    if inner != job["files"]:
        raise InputError(f"{run}: run.json has options with the files {_short(inner)}, not {_short(job['files'])}")
    return job


def _no_room(at: Path) -> str | None:
    """Why something is not a folder of the run's own; None: it is one, or nothing is there."""
    try:
        mode = os.lstat(at).st_mode
    except FileNotFoundError:
        return None
    except OSError as e:
        return f"cannot be read ({reason_of(e)})"
    return None if stat.S_ISDIR(mode) else "is a link" if stat.S_ISLNK(mode) else "is no folder"


def _same_machine(root: Path, job: dict[str, Any]) -> None:
    """Raise InputError where a run's copies of the machine are not what its job says, or more, or lead elsewhere."""
    at, copies = root / "machine", job["files"]
    names = {Path(copy).name for copy in copies.values()}
    why = _no_room(at)
    if why is None and at.is_dir():
        if more := sorted(f for f in os.listdir(at) if f not in names):
            why = f"holds {_short(more[0])}, which is no part of the machine"
        for folder, inner, files in os.walk(at):
            for name in (*inner, *files):
                mode = os.lstat(os.path.join(folder, name)).st_mode
                if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
                    why = f"holds {_short(name)}, which is no plain file"
    if why is None and _digest_of_all({name: str(root / copy) for name, copy in copies.items()}) != job["machine"]:
        why = "is not the machine that the run was begun with"
    if why is not None:
        raise InputError(f"{at}: {why}; the run folder is damaged, give another --out")


def _no_entry(row: dict[str, Any]) -> str | None:
    """What is wrong with a row of a batch; None: it is an entry."""
    path, key, chunk, when = row["path"], row["key"], row["chunk"], row["time"]
    if not path or "\0" in path or path[0] != "/":
        return f"path {_short(path)} is not absolute"
    if key is None or key and not KEY.fullmatch(key):
        return f"key {_short(key)} is no SHA-256 with a suffix"
    if chunk is None or chunk and not (key and CHUNK.fullmatch(chunk)):
        return f"chunk {_short(chunk)} is no chunk's name"
    if when is not None and not math.isfinite(when):
        return f"time {when} is no number"
    lacks = next((name for name in ("size", "mtime_ns", "engine", "reason") if row[name] is None), None)
    return None if lacks is None else f"{lacks} is missing"


def _is_result(row: Any, key: str) -> bool:
    """Whether it is what a worker writes down of a log."""
    return (
        isinstance(row, dict) and row.get("key") == key and row.get("status") in STATUSES
        and isinstance(row.get("reason"), str) and isinstance(row.get("verdict"), str | None)
        and isinstance(row.get("answer"), dict | None)
    )  # fmt: skip


def _part_schema(columns: Sequence[str] = _COLUMNS) -> Any:
    return pa.schema([(c, pa.string()) for c in columns])


def _schema() -> Any:
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
        if s.fault:
            raise OSError(0, s.fault)
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
    text = value if isinstance(value, str) else json.dumps(value, sort_keys=True, default=str)
    return text if len(text) <= 60 else text[:57] + "..."
