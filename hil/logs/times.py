"""The time of a table, however its logger wrote it: a column that means the time, and the unit that its numbers count
in. Dates in words: `hil.logs.dates`.
"""

from __future__ import annotations

import re

import numpy as np

from hil.logs.names import is_time

__all__ = ["guess_column", "guess_unit"]

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
