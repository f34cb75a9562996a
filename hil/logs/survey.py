"""What is in a log, before anybody reads it: which name would be which signal, in which unit, how surely, and how it
looks. Terminal and workbench show the same (`vaneloop map`, the form of page 1).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from hil.logs.guess import Files
from hil.logs.log import read_log
from hil.logs.mapping import Bench
from hil.logs.notes import told
from hil.logs.opening import open_log, times_of, wanted_design_speed
from hil.logs.source import LogError, find
from hil.logs.table import Table
from vaneloop.base.errors import InputError
from vaneloop.base.signals import UNITS

__all__ = ["Row", "Survey", "sparkline", "survey"]

MOST_LISTED = 20  # names with one reason
_BLOCKS = "▁▂▃▄▅▆▇█"


@dataclass(frozen=True)
class Row:
    """A signal that the log has.

    how         "named": it is called as ours; "stated": by option or mapping file; "guessed"
    confidence  0 to 1; 1 where nothing is guessed
    why         what speaks for a guess
    low, high   smallest and largest value, in the log's unit
    curve       float64[n <= 60], the signal over time, for a small picture
    """

    signal: str
    name: str
    unit: str
    how: str
    confidence: float
    why: str
    low: float
    high: float
    curve: np.ndarray = field(repr=False)


@dataclass(frozen=True)
class Survey:
    """All that is to be known before a log is read.

    open        signals that are not found, and why, in words
    other       names that are no signal of ours, and why: name -> a few words
    notes       what reading would note beside the guesses
    complaint   the line with which reading refuses the log; "" where it reads
    damaged     what reading refuses is a channel itself: other names or units will not mend it
    design_rpm  rotor speed that is 100 %, rpm, as stated; ``suggested_rpm``: as the log suggests where it is missing
    """

    path: str
    rows: list[Row]
    open: dict[str, str]
    other: dict[str, str]
    notes: list[str]
    complaint: str
    design_rpm: float | None
    suggested_rpm: float | None
    dbc: Path | None
    damaged: bool

    @property
    def guessed(self) -> bool:
        """Whether anything is guessed."""
        return any(r.how == "guessed" for r in self.rows)

    def unused(self) -> list[str]:
        """What the log has and is not used, a line a reason: the names, and why."""
        out = []
        for why in dict.fromkeys(self.other.values()):
            names = [n for n, w in self.other.items() if w == why]
            more = f" and {len(names) - MOST_LISTED} more" if len(names) > MOST_LISTED else ""
            out.append(f"{', '.join(names[:MOST_LISTED])}{more}{f': {why}' if why else ''}")
        return out

    def bench(self) -> Bench:
        """The mapping file that says all that is shown here."""
        return Bench(
            {r.signal: r.name for r in self.rows}, {r.signal: r.unit for r in self.rows if r.unit}, self.design_rpm,
            self.dbc,
        )  # fmt: skip

    def to_dict(self) -> dict[str, Any]:
        """The survey as the JSON of ``vaneloop map``."""
        rows = [{k: getattr(r, k) for k in Row.__dataclass_fields__ if k != "curve"} for r in self.rows]
        return {
            "log": self.path, "signals": rows, "open": self.open, "other": list(self.other), "why_not": self.other,
            **told(self.notes),
            "complaint": self.complaint, "design_rpm": self.design_rpm, "suggested_rpm": self.suggested_rpm,
        }  # fmt: skip


def survey(
    path: str | Path,
    *,
    dbc: str | Path | None = None,
    mapping: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    design_rpm: float | None = None,
    guess: bool = True,
    mapping_file: str | Path | None = None,
    tables: Files | None = None,
    part: int = 0,
    signals: Mapping[str, str] = UNITS,
) -> Survey:
    """Look at a log as `read_log` would read it with the same arguments; a log that cannot be read is shown with its
    complaint.

    Raises LogError only for a file that cannot be opened at all, NoTime for a table without a time.
    """
    path = Path(path)
    out = open_log(path, dbc, mapping, units, design_rpm, signals, guess, mapping_file, tables or {}, part)
    rows, damaged = [], False
    if isinstance(out.source, Table):
        rows.append(_time(path, out.source, out.units, {*(mapping or {}), *(mapping or {}).values()}))
    for signal in signals:
        g = out.guesses.made.get(signal)
        stated = signal in out.named and g is None
        keys = [g.name] if g else find(out.source, out.named.get(signal, signal), stated)
        if len(keys) != 1:
            continue
        try:
            s = out.source.series(keys[0])
        except LogError:
            damaged = True
            continue
        unit = out.units.get(signal, s.unit) or signals[signal]
        how = "guessed" if g else "stated" if stated else "named"
        rows.append(_row(signal, keys[0], unit, how, g.confidence if g else 1.0, g.why if g else "", s.values))
    used = {r.name for r in rows}
    other = {n: out.guesses.unused.get(n, "") for n in out.source.names if n not in used}
    open_, suggested = dict(out.guesses.open), None
    if out.guesses.rpm:
        signal, rpm, words = wanted_design_speed(path, out)
        suggested, open_[signal] = rpm or None, words
    notes, complaint = list(out.notes), ""
    try:
        notes = read_log(
            path, dbc=dbc, mapping=mapping, units=units, design_rpm=design_rpm, require=(), guess=guess,
            mapping_file=mapping_file, tables=tables, part=part, signals=signals,
        ).notes  # fmt: skip
    except InputError as e:
        complaint = str(e)
    if not complaint and rows and not any(r.curve.size for r in rows):
        complaint = f"{path}: has no sample"
    if not complaint and not any(r.signal != "t" for r in rows):
        complaint = f"{path}: none of its names is a signal of ours ({', '.join(signals)}); --map NAME=signal names one"
    return Survey(
        str(path), rows, open_, other, notes, complaint, out.design_rpm,
        suggested, out.dbc, damaged and bool(complaint),
    )  # fmt: skip


def _time(path: Path, table: Table, units: Mapping[str, str], stated: set[str]) -> Row:
    """The row of a table's time column."""
    t = times_of(path, table)
    unit = units.get("t") or table.time_unit or "s"
    how = "guessed" if table.guessed or ("t" in units and "t" not in stated) else "named"
    if table.time in stated:
        how = "stated"
    return _row("t", table.time, unit, how, table.guessed or 1.0, "", t)


def _row(signal: str, name: str, unit: str, how: str, confidence: float, why: str, values: np.ndarray) -> Row:
    v = values[np.isfinite(values)]
    at = np.linspace(0, v.size - 1, min(60, v.size)).astype(np.int64) if v.size else np.empty(0, np.int64)
    low, high = (float(v.min()), float(v.max())) if v.size else (float("nan"), float("nan"))
    return Row(signal, name, unit, how, round(confidence, 2), why, low, high, v[at])


def sparkline(curve: np.ndarray, width: int = 16) -> str:
    """A curve in one line of text."""
    if not curve.size:
        return ""
    v = curve[np.linspace(0, curve.size - 1, min(width, curve.size)).astype(np.int64)]
    span = float(np.ptp(v)) or 1.0
    return "".join(_BLOCKS[round(float(x - v.min()) / span * (len(_BLOCKS) - 1))] for x in v)
