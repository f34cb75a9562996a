"""All results of a run as tables: rolled up from its parts by DuckDB, in bounded memory.

    logs      path, engine, time, key, status, reason, verdict, duration_s      a row a log
    effects   ... effect, stage, parameter, unit, value, low, high, neutral, probability
    nominal   ... stage, parameter, unit, value, low, high, table, tolerance
    coverage  ... effect, stage, needs                                          what a log could not show

Rows are in the order of path, so that two runs over the same logs give the same files.
"""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vaneloop.base.errors import InputError

if TYPE_CHECKING:
    import duckdb

    from vaneloop.fleet.folder import Folder

__all__ = ["TABLES", "answers", "database", "roll_up", "write_tables"]

TABLES = ("logs", "effects", "nominal", "coverage")
MEMORY = "700MB"
_OF = "l.path, l.engine, l.time, l.key"
_SIZES = """[{"effect": "VARCHAR", "stage": "VARCHAR", "probability": "DOUBLE", "parameter": "VARCHAR",
"unit": "VARCHAR", "value": "DOUBLE", "low": "DOUBLE", "high": "DOUBLE", "neutral": "DOUBLE"}]"""
_NOMINAL = """[{"stage": "VARCHAR", "parameter": "VARCHAR", "unit": "VARCHAR", "value": "DOUBLE", "low": "DOUBLE",
"high": "DOUBLE", "table": "DOUBLE", "tolerance": "DOUBLE"}]"""
_MISSED = """[{"effect": "VARCHAR", "stage": "VARCHAR", "needs": "VARCHAR"}]"""
_UNSEEN = """[{"stage": "VARCHAR", "verdict": "VARCHAR", "reason": "VARCHAR"}]"""


def roll_up(folder: Folder) -> duckdb.DuckDBPyConnection:
    """The tables of a run, in a database in memory. Raises InputError where nothing is finished yet, and for the folder
    of a campaign, which has no logs.
    """
    if folder.of_campaign:
        raise InputError(
            f"{folder.path}: is a campaign's run, not a fleet's; vaneloop campaign PLAN.toml --out {folder.path} "
            f"--report campaign.html shows it"
        )
    if not folder.finished():
        raise InputError(f"{folder.path}: no part of the run is finished yet; vaneloop fleet status says how far it is")
    db = database()
    entries, parts = str(folder.path / "logs" / "*.parquet"), str(folder.path / "parts" / "*.parquet")
    db.execute(  # of a path and of a content the latest counts
        "CREATE TEMP TABLE entries AS SELECT path, key, engine, time, reason FROM read_parquet($1, filename = true) "
        "QUALIFY row_number() OVER (PARTITION BY path ORDER BY filename DESC) = 1", [entries]
    )  # fmt: skip
    db.execute(
        "CREATE TEMP VIEW latest AS SELECT key, max(filename) AS filename FROM "
        f"read_parquet('{_quoted(parts)}', filename = true) GROUP BY key"
    )
    db.execute(
        "CREATE TEMP VIEW results AS SELECT r.* FROM "
        f"read_parquet('{_quoted(parts)}', filename = true) r JOIN latest USING (key, filename)"
    )
    db.execute(
        "CREATE TABLE logs AS SELECT e.path, e.engine, e.time, e.key, "
        "CASE WHEN e.key = '' THEN 'unreadable' ELSE coalesce(r.status, 'pending') END AS status, "
        "CASE WHEN e.key = '' THEN e.reason ELSE coalesce(r.reason, '') END AS reason, r.verdict, "
        "CAST(r.answer ->> '$.duration_s' AS DOUBLE) AS duration_s "
        "FROM entries e LEFT JOIN results r USING (key) ORDER BY e.path"
    )
    shapes = (("effects", "sizes", _SIZES, "x.effect, "), ("nominal", "nominal", _NOMINAL, ""))
    for table, field, shape, first in shapes:
        db.execute(
            f"CREATE TABLE {table} AS SELECT {_OF}, x.* FROM (SELECT key, unnest(from_json(answer -> '$.{field}', "
            f"'{shape}')) AS x FROM results) r JOIN logs l USING (key) ORDER BY l.path, {first}x.stage, x.parameter"
        )
    db.execute(
        f"CREATE TABLE coverage AS SELECT {_OF}, x.* FROM (SELECT key, unnest(from_json(answer -> '$.not_observable', "
        f"'{_MISSED}')) AS x FROM results UNION ALL SELECT key, struct_pack(effect := '', stage := y.stage, needs := "
        f"y.reason) FROM (SELECT key, unnest(from_json(answer -> '$.stages', '{_UNSEEN}')) AS y FROM results) WHERE "
        "y.verdict = 'not_observed') r JOIN logs l USING (key) ORDER BY l.path, x.stage, x.effect"
    )
    return db


def database() -> duckdb.DuckDBPyConnection:
    """A database in memory; what does not fit goes to the system's folder for temporary files, not to where the user
    stands.
    """
    import duckdb

    place = str(Path(tempfile.gettempdir()) / f"vaneloop-fleet-{os.getpid()}")
    db = duckdb.connect(config={"memory_limit": MEMORY, "threads": "2", "temp_directory": place})
    db.execute("SET enable_progress_bar = false")
    return db


def answers(folder: Folder, keys: list[str]) -> dict[str, dict[str, Any]]:
    """The answers to some logs by their keys, as ``vaneloop diagnose --json`` gives them."""
    import json

    rows = database().execute(
        "SELECT key, answer FROM read_parquet($1, filename = true) WHERE list_contains($2, key) AND answer IS NOT NULL "
        "ORDER BY filename", [str(folder.path / "parts" / "*.parquet"), keys],
    ).fetchall()  # fmt: skip
    return {key: json.loads(answer) for key, answer in rows}


def write_tables(db: duckdb.DuckDBPyConnection, to: str | Path, tables: tuple[str, ...] = TABLES) -> list[Path]:
    """Write each table as Parquet and as CSV into a folder; return the files. Raises InputError."""
    import duckdb

    out, folder = [], Path(to)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for table in tables:
            for suffix, how in (("parquet", "FORMAT parquet, COMPRESSION zstd"), ("csv", "FORMAT csv, HEADER")):
                file = folder / f"{table}.{suffix}"
                temporary = folder / f".{table}.{suffix}.part"
                db.execute(f"COPY {table} TO '{_quoted(str(temporary))}' ({how})")
                out.append(temporary.replace(file))
    except (OSError, duckdb.Error) as e:
        raise InputError(f"--tables-out {folder}: cannot be written ({str(e).splitlines()[0]})") from None
    return out


def _quoted(text: str) -> str:
    return text.replace("'", "''")
