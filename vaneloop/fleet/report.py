"""What the logs of a fleet say together: which engine lacks what, since when, how fast it grows, which is unlike its
sisters, and what the logs could not show.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import scipy

from vaneloop.base.errors import InputError
from vaneloop.fleet.sources import text_table
from vaneloop.fleet.trends import ODD, SURE, Trend, limit_of, odd, trend
from vaneloop.pages.fleet import YEAR, FleetView, Series, log_page

if TYPE_CHECKING:
    import duckdb

__all__ = ["FALSE", "YEAR", "limits_of", "view_of", "write_pages"]

FALSE = (
    0.05  # of the logs of an engine that lacks nothing, in which some one effect is named: docs/diagnosis.md has less
)
CHANCE = 1e-3  # that an engine with no more than that is said to lack the effect
MINIMUM = 2  # logs that name an effect, before an engine is said to lack it
SPREAD = 2.0 * 1.6449  # a 90 % interval over a standard deviation
# of the interval that the tolerance alone gives (a uniform draw's deviation is tolerance / sqrt 3), from which on a log
# has told nothing of a nominal parameter: it stands where the table has it
UNTOLD = 0.9 * SPREAD / 3.0**0.5
# effect -> the nominal parameter of which it is the part beyond the table's value: {} is the effect's parameter. A log
# has the whole in one or the other, as its size is within the tolerance or beyond it
SAME = {
    "linkage_backlash": "linkage.{}_play",
    "pot_bias": "sensors.{}_bias",
    "rotor_lag_error": "engine.lag",
    "screw_friction": "screw.friction",
}


def limits_of(file: str | None) -> dict[str, float]:
    """Limit of each quantity from a CSV file with the columns quantity, limit. Raises InputError."""
    if file is None:
        return {}
    have, rows = text_table(file, "--limits")
    if not {"quantity", "limit"} <= set(have):
        raise InputError(f"--limits {file}: needs the columns quantity, limit; has {', '.join(have)}")
    try:
        return {row["quantity"]: float(row["limit"]) for row in rows}
    except ValueError as e:
        raise InputError(f"--limits {file}: {str(e).splitlines()[0]}; a limit must be a number") from None


def view_of(
    db: duckdb.DuckDBPyConnection, limits: dict[str, float], name: str = "", damaged: dict[str, str] | None = None
) -> FleetView:
    """Work out what the page shows and the tables ``engines``, ``lacks``, ``trends``, ``outliers`` of the database.
    ``damaged``: parts of the run's folder that are, with their reasons.
    """
    engines = [str(r[0]) for r in db.execute("SELECT DISTINCT engine FROM logs ORDER BY engine").fetchall()]
    statuses = dict(db.execute("SELECT status, count(*) FROM logs GROUP BY status ORDER BY status").fetchall())
    lacks = _lacks(db)
    found: list[Series] = [*_effects(db, lacks), *_nominal(db, lacks)]
    wrong = sorted(set(limits) - {s.quantity for s in found} - _known(db))
    if wrong:
        raise InputError(f"--limits: quantity (={wrong[0]!r}) is in no log of the run; a quantity is "
                         "effect.parameter, or a nominal parameter such as linkage.vigv_play")  # fmt: skip
    nominal = len({s.quantity for s in found if s.kind == "nominal"})  # of each engine so many are looked at
    found = [_judged(s, limits, ODD / nominal if s.kind == "nominal" else SURE) for s in found]
    outliers = _outliers(found)
    view = FleetView(
        name=name, engines=engines, statuses=statuses, verdicts=_verdicts(db), lacks=lacks, series=found,
        outliers=outliers, coverage=_coverage(db), refused=_refused(db),
        span=db.execute("SELECT min(time), max(time) FROM logs").fetchall()[0],
        damaged=dict(sorted((damaged or {}).items())),
    )  # fmt: skip
    _store(db, "lacks", lacks)
    _store(db, "trends", [s.json() for s in found])
    _store(db, "outliers", outliers)
    return view


def _verdicts(db: duckdb.DuckDBPyConnection) -> dict[str, dict[str, int]]:
    out: dict[str, dict[str, int]] = {}
    query = "SELECT engine, verdict, count(*) FROM logs WHERE status = 'done' GROUP BY ALL ORDER BY ALL"
    for engine, verdict, n in db.execute(query).fetchall():
        out.setdefault(engine, {})[verdict] = n
    return out


def _lacks(db: duckdb.DuckDBPyConnection) -> list[dict[str, Any]]:
    """Each engine and effect that was named in its logs: in how many of those that could show it, and whether that is
    more than false names explain.
    """
    rows = db.execute(
        "SELECT e.engine, e.effect, e.stage, count(DISTINCT e.path) AS named, avg(e.probability) AS probability, "
        "min(e.time) AS first, max(e.time) AS last, max_by(e.key, coalesce(e.time, 0)), any_value(n.logs) AS logs, "
        "any_value(coalesce(c.missed, 0)) AS missed FROM effects e "
        "JOIN (SELECT engine, count(*) AS logs FROM logs WHERE status = 'done' GROUP BY engine) n USING (engine) "
        "LEFT JOIN (SELECT engine, effect, count(DISTINCT path) AS missed FROM coverage GROUP BY ALL) c "
        "ON c.engine = e.engine AND c.effect = e.effect GROUP BY e.engine, e.effect, e.stage ORDER BY ALL"
    ).fetchall()
    out = []
    for engine, effect, stage, named, probability, first, last, key, logs, missed in rows:
        able = max(logs - missed, named)
        chance = float(scipy.stats.binom.sf(named - 1, able, FALSE))
        out.append({
            "engine": engine, "effect": effect, "stage": stage, "named": named, "able": able, "share": named / able,
            "probability": probability, "first": first, "last": last, "chance": chance, "key": key,
            "lacks": bool(chance < CHANCE and named >= MINIMUM),
        })  # fmt: skip
    return out


def _effects(db: duckdb.DuckDBPyConnection, lacks: Sequence[dict[str, Any]]) -> list[Series]:
    """Sizes over time of every effect that an engine lacks.

    What is the part of a nominal parameter beyond its table (`SAME`) is followed as a whole: what logs say of the one
    and of the other. Of other effects, logs that could show it and found nothing amiss in its stage say that it is
    small: as the smallest size that any log of the fleet tells from nothing.
    """
    rows = db.execute(
        "SELECT engine, effect, stage, parameter, unit, neutral, list(time ORDER BY path), list(value ORDER BY path), "
        "list(high - low ORDER BY path), list(key ORDER BY path), list(path ORDER BY path) FROM effects "
        "WHERE time IS NOT NULL GROUP BY ALL ORDER BY ALL"
    ).fetchall()
    sizes = db.execute(
        "SELECT effect, parameter, min(abs(value - neutral)) FROM effects WHERE low > neutral OR high < neutral "
        "GROUP BY ALL"
    ).fetchall()
    smallest = {(effect, parameter): float(size) for effect, parameter, size in sizes}
    real = {(r["engine"], r["effect"]) for r in lacks if r["lacks"]}
    out = []
    for engine, effect, stage, parameter, unit, neutral, times, values, widths, keys, paths in rows:
        if (engine, effect) not in real:
            continue
        parts = _nominal_parts(db, engine, whole_of(effect, parameter))
        silent = db.execute(
            "SELECT l.time, l.key, l.path FROM logs l WHERE l.engine = $1 AND l.status = 'done' AND l.time IS NOT NULL "
            "AND l.verdict <> 'unknown' AND NOT EXISTS (SELECT 1 FROM effects e WHERE e.path = l.path AND e.stage = $3)"
            " AND NOT EXISTS (SELECT 1 FROM coverage c WHERE c.path = l.path AND (c.effect = $2 OR c.effect = '' AND "
            "c.stage = $3)) ORDER BY l.path", [engine, effect, stage],
        ).fetchall()  # fmt: skip
        if parts:
            values, widths, silent = _whole(values, widths, paths, silent, parts, neutral)
        elif (least := smallest.get((effect, parameter))) is None:
            continue  # no log tells it from nothing
        else:
            silent = [(time, key, neutral, least * SPREAD) for time, key, _ in silent]
        more = list(zip(*silent, strict=True)) or [(), (), (), ()]
        told = [True] * len(times) + [bool(parts)] * len(silent)
        out.append(_series(
            engine, f"{effect}.{parameter}", unit, [*times, *more[0]], [*values, *more[2]], [*widths, *more[3]],
            [*keys, *more[1]], neutral, None, "effect", told,
        ))  # fmt: skip
    return out


def whole_of(effect: str, parameter: str) -> str:
    """The nominal parameter of which an effect's parameter is the part beyond the table; "": of none."""
    return SAME.get(effect, "").format(parameter)


def _nominal_parts(db: duckdb.DuckDBPyConnection, engine: str, parameter: str) -> dict[str, tuple[float, float, bool]]:
    """What each log says of a nominal parameter: path -> value beyond the table, width of its interval, and whether it
    stands at the end of its tolerance, where a log tells only that it is no less.
    """
    rows = db.execute(
        "SELECT path, value - \"table\", high - low, abs(value - \"table\") >= 0.999 * tolerance FROM nominal WHERE "
        "engine = $1 AND parameter = $2 AND high - low IS NOT NULL", [engine, parameter],
    ).fetchall()  # fmt: skip
    return {path: (float(value), float(width), bool(ends)) for path, value, width, ends in rows}


def _whole(
    values: Sequence[float], widths: Sequence[float | None], paths: Sequence[str], silent: Sequence[Any],
    parts: dict[str, tuple[float, float, bool]], neutral: float,
) -> tuple[list[float], list[float], list[Any]]:  # fmt: skip
    """Values and widths of an effect with those of its nominal parameter: of the logs that name it, and of the silent.

    Logs that name the effect know the sum of both; that they do not know the share of the nominal one makes the effect
    as much less sure, and is taken off.
    """
    found = [(time, key, neutral + parts[path][0], parts[path][1]) for time, key, path in silent
             if path in parts and not parts[path][2]]  # fmt: skip
    sure = float(np.median([width for *_, width in found])) if found else 0.0
    sums, whole = [], []
    for value, width, path in zip(values, (w or 0.0 for w in widths), paths, strict=True):
        share, unsure, _ = parts.get(path, (0.0, 0.0, False))
        sums.append(value + share)
        whole.append(max(float(np.sqrt(max(width**2 - unsure**2, 0.0))), min(sure, width)))
    return sums, whole, found


def _nominal(db: duckdb.DuckDBPyConnection, lacks: Sequence[dict[str, Any]]) -> list[Series]:
    """Every nominal parameter of every engine over time, as recalibrated by the logs that tell something of it; but for
    those that are followed as a whole with an effect.
    """
    rows = db.execute(
        'SELECT engine, parameter, unit, any_value("table"), any_value(tolerance), list(time ORDER BY path), '
        "list(value ORDER BY path), list(high - low ORDER BY path), list(key ORDER BY path) FROM nominal "
        "WHERE time IS NOT NULL AND (coalesce(tolerance, 0) <= 0 OR high - low < $1 * tolerance) "
        "GROUP BY engine, parameter, unit ORDER BY ALL", [UNTOLD],
    ).fetchall()  # fmt: skip
    named = db.execute("SELECT DISTINCT engine, effect, parameter FROM effects").fetchall()
    real = {(r["engine"], r["effect"]) for r in lacks if r["lacks"]}
    followed = {(engine, whole_of(effect, p)) for engine, effect, p in named if (engine, effect) in real}
    return [
        _series(engine, parameter, unit, times, values, widths, keys, table, tolerance, "nominal")
        for engine, parameter, unit, table, tolerance, times, values, widths, keys in rows
        if (engine, parameter) not in followed
    ]


def _series(
    engine: str, quantity: str, unit: str, times: Sequence[float], values: Sequence[float],
    widths: Sequence[float | None], keys: Sequence[str], neutral: float, tolerance: float | None, kind: str,
    told: Sequence[bool] | None = None,
) -> Series:  # fmt: skip
    t, y = np.array(times, dtype=float), np.array(values, dtype=float)
    s = np.array([v if v else np.nan for v in widths], dtype=float) / SPREAD  # of no width: not known
    good = np.isfinite(t) & np.isfinite(y)
    s = np.where(np.isfinite(s), s, np.nanmax(s) if np.isfinite(s).any() else 0.0)
    order = np.argsort(t[good], kind="stable")
    names = np.array(keys, dtype=object)[good][order]
    return Series(
        engine, quantity, unit, t[good][order], y[good][order], s[good][order], [str(k) for k in names],
        np.array(told or [True] * len(t), dtype=bool)[good][order], neutral, tolerance, kind,
    )  # fmt: skip


def _judged(s: Series, limits: dict[str, float], sure: float) -> Series:
    """The series with its trend, and when it will be at its limit: times in s since 1970."""
    if not len(s.t):
        return replace(s, trend={"kind": "too few", "logs": 0})
    zero = float(s.t[0])
    years = (s.t - zero) / YEAR
    found = trend(years, s.y, s.s, sure, s.told)
    said: dict[str, Any] = {k: v for k, v in asdict(found).items() if k != "lines"}
    for k in ("onset", "onset_low", "onset_high"):
        said[k] = zero + said[k] * YEAR
    limit = limits.get(s.quantity)
    if limit is None and s.tolerance and found.kind == "growth":
        limit = s.neutral + float(np.copysign(s.tolerance, found.rate))
    said |= {"limit": limit, "limit_time": None, "limit_low": None, "limit_high": None, "limit_why": ""}
    if limit is not None:
        when = limit_of(found, float(years[-1]), limit)
        for k, v in (("limit_time", when.time), ("limit_low", when.low), ("limit_high", when.high)):
            said[k] = None if v is None or not np.isfinite(v) else zero + v * YEAR
        said["limit_why"] = when.why
    elif found.kind == "growth":
        said["limit_why"] = "no limit is given (--limits)"
    return replace(s, trend=said, curve=_curve(found, s.t))


def _curve(found: Trend, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The trend as a line: times and values."""
    zero, last = float(t[0]), float(t[-1])
    if found.kind == "growth":
        return np.array([zero, zero + found.onset * YEAR, last]), np.array([found.start, found.start, found.now])
    if found.kind == "step":
        at = zero + found.onset * YEAR
        return np.array([zero, at, at, last]), np.array([found.start, found.start, found.now, found.now])
    return np.array([zero, last]), np.array([found.now, found.now])


def _outliers(found: Sequence[Series]) -> list[dict[str, Any]]:
    """Engines whose present level of a nominal parameter is unlike that of their sisters."""
    by: dict[str, list[Series]] = {}
    for s in found:
        if s.kind == "nominal" and "now" in s.trend:
            by.setdefault(s.quantity, []).append(s)
    out = []
    for quantity, group in sorted(by.items()):
        level = [float(s.trend["now"]) for s in group]
        own = [float(s.trend["now_high"] - s.trend["now_low"]) / SPREAD for s in group]
        for s, v, p in zip(group, level, odd(level, own, len(by)), strict=True):
            if p < ODD:
                sisters = float(np.nanmedian([x for x, g in zip(level, group, strict=True) if g is not s]))
                row = {"engine": s.engine, "quantity": quantity, "unit": s.unit}
                out.append(row | {"value": v, "sisters": sisters, "p": float(p)})
    return sorted(out, key=lambda r: (r["p"], r["engine"], r["quantity"]))


def _coverage(db: duckdb.DuckDBPyConnection) -> list[dict[str, Any]]:
    """Effects and stages that logs could not show: of each engine in how many, and what they lacked."""
    rows = db.execute(
        "SELECT c.engine, c.stage, c.effect, count(DISTINCT c.path) AS n, any_value(l.n) AS of, mode(c.needs) FROM "
        "coverage c JOIN (SELECT engine, count(*) AS n FROM logs WHERE status = 'done' GROUP BY engine) l "
        "USING (engine) GROUP BY c.engine, c.stage, c.effect ORDER BY ALL"
    ).fetchall()
    return [dict(zip(("engine", "stage", "effect", "logs", "of", "needs"), r, strict=True)) for r in rows]


def _refused(db: duckdb.DuckDBPyConnection) -> list[dict[str, Any]]:
    rows = db.execute(
        "SELECT engine, path, status, reason FROM logs WHERE status NOT IN ('done', 'pending') ORDER BY path"
    ).fetchall()
    return [dict(zip(("engine", "path", "status", "reason"), r, strict=True)) for r in rows]


def _known(db: duckdb.DuckDBPyConnection) -> set[str]:
    query = "SELECT DISTINCT effect || '.' || parameter FROM effects UNION SELECT DISTINCT parameter FROM nominal"
    return {str(r[0]) for r in db.execute(query).fetchall()}


def _store(db: duckdb.DuckDBPyConnection, table: str, rows: list[dict[str, Any]]) -> None:
    """Keep rows as a table of the database, to be written with the others."""
    names = dict.fromkeys(name for row in rows for name in row)
    columns = {n: [row.get(n) for row in rows] for n in names} or {"engine": pa.array([], pa.string())}
    db.register("_rows", pa.table(columns))
    db.execute(f"CREATE OR REPLACE TABLE {table} AS SELECT * FROM _rows")
    db.unregister("_rows")


def write_pages(folder: Path, said: dict[str, dict[str, Any]]) -> None:
    """Write the page of each log that the fleet's page leads to."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as e:
        raise InputError(f"{folder}: cannot be made for the pages of logs ({e.strerror})") from None
    for key, answer in said.items():
        log_page(key, answer).write(folder / f"{key}.html")
