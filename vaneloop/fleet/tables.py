"""All results of a run as tables: rolled up from its parts by DuckDB, in bounded memory.

    logs      path, engine, time, key, status, reason, verdict, duration_s      a row a log
    effects   ... effect, stage, parameter, unit, value, low, high, neutral, probability
    nominal   ... stage, parameter, unit, value, low, high, table, tolerance
    coverage  ... effect, stage, needs                                          what a log could not show

Rows are in the order of path, so that two runs over the same logs give the same files.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pyarrow as pa
import pyarrow.compute as pc

from vaneloop.base.cells import FORMULA
from vaneloop.base.errors import InputError
from vaneloop.base.files import own_folder, whole
from vaneloop.fleet.folder import KEY, STATUSES, Folder

if TYPE_CHECKING:
    import duckdb

__all__ = ["TABLES", "answers", "damaged", "database", "roll_up", "write_tables"]

TABLES = ("logs", "effects", "nominal", "coverage")
MEMORY = "700MB"
_OF = "l.path, l.engine, l.time, l.key"
_SIZES = """[{"effect": "VARCHAR", "stage": "VARCHAR", "probability": "DOUBLE", "parameter": "VARCHAR",
"unit": "VARCHAR", "value": "DOUBLE", "low": "DOUBLE", "high": "DOUBLE", "neutral": "DOUBLE"}]"""
_NOMINAL = """[{"stage": "VARCHAR", "parameter": "VARCHAR", "unit": "VARCHAR", "value": "DOUBLE", "low": "DOUBLE",
"high": "DOUBLE", "table": "DOUBLE", "tolerance": "DOUBLE"}]"""
_MISSED = """[{"effect": "VARCHAR", "stage": "VARCHAR", "needs": "VARCHAR"}]"""
_UNSEEN = """[{"stage": "VARCHAR", "verdict": "VARCHAR", "reason": "VARCHAR"}]"""
# table, field of an answer, its shape, its texts that must be there, its numbers
_FIELDS = (
    ("effects", "sizes", _SIZES, ("effect", "stage", "parameter", "unit"),
     ("probability", "value", "low", "high", "neutral")),
    ("nominal", "nominal", _NOMINAL, ("stage", "parameter", "unit"), ("value", "low", "high", "table", "tolerance")),
    ("missed", "not_observable", _MISSED, ("effect", "stage"), ()),
    ("unseen", "stages", _UNSEEN, ("stage", "verdict"), ()),
)  # fmt: skip
_ANSWER = json.dumps({"duration_s": "DOUBLE"} | {field: json.loads(shape) for _, field, shape, *_ in _FIELDS})
_NEEDED = ("neutral", "table")  # numbers that must be there; others may be null, where a log does not tell them
_DAMAGED = "its answer is damaged; vaneloop fleet run --retry does it anew"
TAKEN = 64 << 20  # bytes of answers that are looked into at once


def roll_up(folder: Folder) -> duckdb.DuckDBPyConnection:
    """The tables of a run, in a database in memory. Raises InputError where nothing is finished yet, and for the folder
    of a campaign, which has no logs.

    A part of the run that is damaged is noted (`Folder.damaged`). An answer in which something is not what a diagnosis
    says is a log with the status damaged.
    """
    if folder.of_campaign:
        raise InputError(
            f"{folder.path}: is a campaign's run, not a fleet's; vaneloop campaign PLAN.toml --out {folder.path} "
            f"--report campaign.html shows it"
        )
    if not folder.finished():
        raise InputError(f"{folder.path}: no part of the run is finished yet; vaneloop fleet status says how far it is")
    db = database()
    entries = folder.entries()
    text = {n: pa.array([getattr(e, n) for e in entries], pa.string()) for n in ("path", "key", "engine", "reason")}
    db.register("_given", pa.table({**text, "time": pa.array([e.time for e in entries], pa.float64())}))
    db.execute("CREATE TEMP TABLE entries AS SELECT * FROM _given")
    db.unregister("_given")
    db.execute("CREATE TEMP TABLE results (key VARCHAR, status VARCHAR, reason VARCHAR, verdict VARCHAR, "
               "duration_s DOUBLE)")  # fmt: skip
    for table, _, shape, _, _ in _FIELDS:
        db.execute(f"CREATE TEMP TABLE raw_{table} AS SELECT '' AS key, x.*, true AS good FROM (SELECT unnest("
                   f"from_json('[]', '{shape}')) AS x) LIMIT 0")  # fmt: skip
    for batch in _batches(folder):
        _take(db, batch)
    bad = " UNION ".join(f"SELECT key FROM raw_{table} WHERE NOT good" for table, *_ in _FIELDS)
    db.execute(f"UPDATE results SET status = 'damaged' WHERE key IN ({bad})")
    db.execute(f"UPDATE results SET reason = '{_DAMAGED}', verdict = NULL, duration_s = NULL WHERE status = 'damaged'")
    db.execute(
        "CREATE TABLE logs AS SELECT e.path, e.engine, e.time, e.key, "
        "CASE WHEN e.key = '' THEN 'unreadable' ELSE coalesce(r.status, 'pending') END AS status, "
        "CASE WHEN e.key = '' THEN e.reason ELSE coalesce(r.reason, '') END AS reason, r.verdict, "
        "r.duration_s FROM entries e LEFT JOIN results r USING (key) ORDER BY e.path"
    )
    whole = "JOIN logs l USING (key) WHERE l.status <> 'damaged' ORDER BY l.path"
    for table, columns in (("effects", _columns(_SIZES)), ("nominal", _columns(_NOMINAL))):
        first = "r.effect, " if table == "effects" else ""
        db.execute(f"CREATE TABLE {table} AS SELECT {_OF}, {columns} FROM raw_{table} r {whole}, {first}r.stage, "
                   f"r.parameter")  # fmt: skip
    db.execute(
        f"CREATE TABLE coverage AS SELECT {_OF}, {_columns(_MISSED)} FROM (SELECT key, effect, stage, needs FROM "
        "raw_missed UNION ALL SELECT key, '' AS effect, stage, reason AS needs FROM raw_unseen WHERE verdict = "
        f"'not_observed') r {whole}, r.stage, r.effect"
    )
    return db


def damaged(folder: Folder) -> set[str]:
    """Keys of the logs whose answers are damaged."""
    if folder.of_campaign or not folder.finished():
        return set()
    return {str(key) for (key,) in roll_up(folder).execute("SELECT key FROM logs WHERE status = 'damaged'").fetchall()}


def _columns(shape: str) -> str:
    return ", ".join(f'r."{name}"' for name in json.loads(shape)[0])


def _batches(folder: Folder) -> Iterator[pa.Table]:
    """What came of all logs, each content once, as the latest row has it; some `TAKEN` bytes at a time."""
    held: list[pa.Table] = []
    size, seen = 0, set[str]()
    for table in folder.parts("key", "status", "reason", "verdict", "answer"):
        fresh = []
        for key in reversed(table.column("key").to_pylist()):
            good = key is not None and KEY.fullmatch(key) is not None and key not in seen
            fresh.append(good)
            if good:
                seen.add(key)
        held.append(table.filter(pa.array(fresh[::-1], pa.bool_())))
        size += table.nbytes
        if size > TAKEN:
            yield pa.concat_tables(held)
            held, size = [], 0
    if held:
        yield pa.concat_tables(held)


def _take(db: duckdb.DuckDBPyConnection, batch: pa.Table) -> None:
    """Put what came of some logs into the database."""
    db.register("_part", batch)
    known = ", ".join(f"'{s}'" for s in STATUSES)
    fields = ", ".join(f"'$.{field}'" for _, field, *_ in _FIELDS)
    wrong = " OR ".join(f"coalesce(kinds[{k}], 'NULL') NOT IN ('ARRAY', 'NULL')" for k in range(2, len(_FIELDS) + 2))
    db.execute(  # a text that is no JSON must be gone before it is looked into
        "CREATE OR REPLACE TEMP TABLE valid AS SELECT * REPLACE (CASE WHEN json_valid(answer) THEN answer END AS answer"
        ") FROM _part"
    )
    db.unregister("_part")
    db.execute(
        "CREATE OR REPLACE TEMP TABLE part AS SELECT key, status, reason, verdict, "
        f"json_type(answer, ['$', {fields}]) AS kinds, from_json(answer, '{_ANSWER}') AS said FROM valid"
    )
    db.execute(
        f"INSERT INTO results SELECT key, CASE WHEN status IS NULL OR status NOT IN ({known}) OR status = 'done' AND "
        f"(kinds IS NULL OR verdict IS NULL) OR kinds IS NOT NULL AND (kinds[1] <> 'OBJECT' OR {wrong}) THEN 'damaged' "
        "ELSE status END, coalesce(reason, ''), verdict, CASE WHEN isfinite(said.duration_s) THEN said.duration_s END "
        "FROM part"
    )
    for table, field, _, texts, numbers in _FIELDS:
        good = [f"x.{c} IS NOT NULL" for c in texts]
        good += [f'coalesce(isfinite(x."{c}"), {str(c not in _NEEDED).lower()})' for c in numbers]
        db.execute(f"INSERT INTO raw_{table} SELECT key, x.*, x IS NOT NULL AND {' AND '.join(good)} FROM (SELECT key, "
                   f"unnest(said.{field}) AS x FROM part WHERE status = 'done')")  # fmt: skip


_spilled = cache(lambda: str(own_folder("vaneloop-fleet-")))  # what does not fit into memory


def database() -> duckdb.DuckDBPyConnection:
    """A database in memory; what does not fit goes to a private folder, not to where the user stands."""
    import duckdb

    place = _spilled()
    alone = dict.fromkeys(("autoinstall_known_extensions", "autoload_known_extensions"), "false")
    db = duckdb.connect(config={"memory_limit": MEMORY, "threads": "2", "temp_directory": place, **alone})
    db.execute("SET enable_progress_bar = false")
    return db


def answers(folder: Folder, keys: list[str]) -> dict[str, dict[str, Any]]:
    """The answers to some logs by their keys, as ``vaneloop diagnose --json`` gives them; damaged ones are left out."""
    wanted, found = pa.array(keys, pa.string()), {}
    for table in folder.parts("key", "answer"):
        for row in reversed(table.filter(pc.is_in(table["key"], wanted)).to_pylist()):
            if row["answer"] is not None and row["key"] not in found:
                with suppress(ValueError, RecursionError):
                    found[row["key"]] = json.loads(row["answer"])
    return {key: answer for key, answer in found.items() if isinstance(answer, dict)}


def write_tables(db: duckdb.DuckDBPyConnection, to: str | Path, tables: tuple[str, ...] = TABLES) -> list[Path]:
    """Write each table as Parquet and as CSV into a folder; return the files. Raises InputError.

    A text of the CSV that a spreadsheet would run as a formula has an apostrophe in front (`vaneloop.base.cells`).
    """
    import duckdb

    out, folder = [], Path(to)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for table in tables:
            for suffix, how in (("parquet", "FORMAT parquet, COMPRESSION zstd"), ("csv", "FORMAT csv, HEADER")):
                file = folder / f"{table}.{suffix}"
                rows = _marked(db, table) if suffix == "csv" else f"SELECT * FROM {table}"
                with whole(file) as part:
                    db.execute(f"COPY ({rows}) TO '{_quoted(str(part))}' ({how})")
                out.append(file)
    except (OSError, duckdb.Error) as e:
        raise InputError(f"--tables-out {folder}: cannot be written ({str(e).splitlines()[0]})") from None
    return out


def _marked(db: duckdb.DuckDBPyConnection, table: str) -> str:
    """The query for a table whose texts no spreadsheet runs."""
    columns = db.execute(f"DESCRIBE {table}").fetchall()
    texts = [name for name, kind, *_ in columns if kind == "VARCHAR"]
    if not texts:
        return f"SELECT * FROM {table}"
    of = (f'if(regexp_matches("{t}", $m$), chr(39) || "{t}", "{t}") AS "{t}"' for t in texts)
    return f"SELECT * REPLACE ({', '.join(of)}) FROM {table}".replace("$m$", f"'{_quoted(FORMULA)}'")


def _quoted(text: str) -> str:
    return text.replace("'", "''")
