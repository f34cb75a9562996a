"""The time of a table, however its logger wrote it: a column that means the time, dates as words, and the unit that its
numbers count in.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from hil.logs.names import is_time

__all__ = ["from_dates", "guess_column", "guess_unit"]

# dates as loggers write them; a decimal comma has become a point, Z has become +00:00
_DATES = [
    f"{day}{between}{clock}{zone}"
    for day in ("%Y-%m-%d", "%Y/%m/%d", "%d.%m.%Y", "%d.%m.%y", "%d/%m/%Y", "%m/%d/%Y", "%Y%m%d")
    for between in (" ", "T")
    for clock in ("%H:%M:%S%.f", "%H:%M")
    for zone in ("", "%z")
]
_AMBIGUOUS = "%d/%m/%Y", "%m/%d/%Y"
_CLOCKS = ("%H:%M:%S%.f", "%H:%M")
_EXCEL = 25_000.0, 75_000.0  # days since 1899-12-30, as Excel counts: 1968 to 2105
_FASTEST = 5e-5  # s; no logger of a bench writes a table with more than 20,000 rows a second
_NEWEST, _OLDEST = 4.1e9, 3.1e8  # s since 1970: 2100 and 1980


def guess_column(headers: list[str]) -> tuple[list[str], float]:
    """Columns that may be the time, the best ones only (several where nothing tells them apart), and how surely.

    A unit in the name, or words that say clock rather than date, decide between several.
    """
    found = {h: is_time(h) for h in headers if is_time(h)[0] > 0.0}
    if not found:
        return [], 0.0
    rank = {h: (c, bool(unit), not re.search(r"(?i)dat(e|um)(?!time)", h)) for h, (c, unit) in found.items()}
    best = max(rank.values())
    return [h for h, r in rank.items() if r == best], best[0]


def guess_unit(t: np.ndarray) -> tuple[str, str]:
    """Unit that a time without one counts in, and why; ("", "") where seconds are possible.

    Only dates tell: a row every 10 may be 10 s or 10 ms apart, so milliseconds from the start are never guessed.

    t  the column's numbers, finite, in the order of the rows
    """
    if t.size < 2:
        return "", ""
    start, step = float(np.median(t)), float(np.median(np.abs(np.diff(t))))
    if _EXCEL[0] < start < _EXCEL[1] and step < _FASTEST:
        return "day", f"{start:.6g} counts days since 1900 as Excel does"
    if start > _NEWEST:
        for unit, factor in (("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9)):
            if _OLDEST < start * factor < _NEWEST:
                return unit, f"{start:.6g} counts {unit} since 1970"
    return "", ""


def from_dates(text: Any) -> tuple[np.ndarray, str] | None:
    """Seconds of a polars column of dates or times of day (null: no sample), counted from the first, and a note; None
    where they are none.

    A time of day that falls back by more than half a day has passed midnight. Day and month that cannot be told apart
    do not matter within one day; beyond it such dates are refused (None).
    """
    import polars as pl

    text = text.str.strip_chars().str.replace(r"(\d),(\d+)", "${1}.${2}").str.replace(r"(?i)\s*Z$", "+00:00")
    there = text.drop_nulls()
    if there.is_empty() or not re.search(r"\d[:T]\d|\d [\d:]", str(there[0])):
        return None
    fits = [f for f in _DATES if _parsed(there.head(50), f) is not None]
    for kind in fits:
        whole = _parsed(text, kind)
        if whole is None or whole.null_count() > text.null_count():
            continue
        if (
            kind.startswith(_AMBIGUOUS)
            and sum(f.startswith(_AMBIGUOUS) for f in fits) > 1
            and whole.dt.date().n_unique() > 1
        ):
            return None
        us = whole.dt.epoch("us")
        return _since(us), f"time: dates; {there[0]} taken for the start of the log"
    for kind in _CLOCKS:
        try:
            clock = text.str.to_time(kind, strict=False)
        except pl.exceptions.PolarsError:
            continue
        if clock.null_count() == text.null_count():
            seconds = _since(clock.cast(pl.Int64) // 1000)
            known = np.flatnonzero(np.isfinite(seconds))
            jumps = np.cumsum(np.diff(seconds[known], prepend=seconds[known[0]]) < -43_200.0)
            seconds[known] += 86_400.0 * jumps
            return seconds, f"time: of day; {there[0]} taken for the start of the log"
    return None


def _parsed(text: Any, kind: str) -> Any:
    """The column as dates of one form; None where its first cell is of another."""
    import polars as pl

    try:
        out = text.str.to_datetime(kind, time_unit="us", strict=False)
    except pl.exceptions.PolarsError:
        return None
    return None if out.null_count() > text.null_count() else out


def _since(us: Any) -> np.ndarray:
    """Seconds since the first of a column of whole microseconds; `ABSENT` where it is null."""
    from hil.logs.source import ABSENT

    null = us.is_null().to_numpy()
    first = int(us.drop_nulls()[0])
    out = (us.fill_null(first).to_numpy() - first) * 1e-6
    out[null] = ABSENT
    return np.asarray(out, np.float64)
