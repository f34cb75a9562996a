"""The time of a table in words: dates and times of day, however its logger wrote them."""

from __future__ import annotations

import re
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from pyarrow import compute as pc

from hil.logs.notes import Note
from hil.logs.source import ABSENT, numbers

__all__ = ["Dates", "OddRow", "date_notes", "from_dates"]

# days as loggers write them, and the clock; a decimal comma has become a point, Z has become +00:00
_Y, _M, _D, _SHORT = r"(?P<y>\d{4})", r"(?P<m>\d{1,2})", r"(?P<d>\d{1,2})", r"(?P<y>\d{2})"
_MONTHS = {
    name: k
    for k, names in enumerate(("jan", "feb", "mar mär mrz", "apr", "may mai", "jun", "jul", "aug", "sep", "oct okt",
                               "nov", "dec dez"), 1)
    for name in names.split()
}  # fmt: skip
_WORD = r"(?P<w>[A-Za-zä]{3})[a-zä]*\.?"  # a month's name
_AMBIGUOUS = (
    f"{_D}/{_M}/{_Y}", f"{_M}/{_D}/{_Y}", f"{_D}/{_M}/{_SHORT}", f"{_M}/{_D}/{_SHORT}", f"{_SHORT}/{_M}/{_D}",
)  # fmt: skip
_DAYS = (
    f"{_Y}-{_M}-{_D}", f"{_Y}/{_M}/{_D}", rf"{_D}\.{_M}\.{_Y}", rf"{_D}\.{_M}\.{_SHORT}", *_AMBIGUOUS,
    r"(?P<y>\d{4})(?P<m>\d{2})(?P<d>\d{2})", f"{_D}[- .]+{_WORD}[- ]+{_Y}", f"{_WORD} +{_D}, *{_Y}",
)  # fmt: skip
_CLOCK = r"(?P<H>\d{1,2}):(?P<M>\d{2})(?::(?P<S>\d{2})(?P<f>\.\d+)?)?(?: *(?P<h>[AaPp])\.?[Mm]\.?)?"
_ZONE = r"(?: *(?P<zh>[+-]\d{2}):?(?P<zm>\d{2}))?"
_FEW = 1000  # rows that most forms of another kind are told by
_HOUR, _DAY = 3_600_000_000, 86_400_000_000  # microseconds
_PAUSE = 60_000_000  # microseconds that pass at most between the two rows at the end of summer time
_NIGHT = 4  # clocks are put back to an hour before
_NO_ZONE = 100  # hours that two digits cannot say


class OddRow(NamedTuple):
    """A cell that is no date as those before it are: its place in the column, from 0, and why."""

    row: int
    why: str


class Dates(NamedTuple):
    """Times that were words.

    t     s from the first one, `ABSENT` where there is none
    zero  the first one, microseconds since 1970 or midnight
    note  what is the start of the log
    back  place in the column, from 0, where the hour of the end of summer time was taken out; -1: nowhere
    """

    t: np.ndarray
    zero: int
    note: str
    back: int


def from_dates(text: Any) -> Dates | OddRow | None:
    """Times of Arrow's strings of dates or times of day (null: no sample); the first cell that is none, where those
    before it are dates; None where they are none.

    The form is one that all rows have. A time of day that falls back by more than half a day has passed midnight. Local
    time that falls back by an hour once, at night, is that of the end of summer time: the hour is taken out. Day, month
    and short year that no row tells apart do not matter within one day; beyond it such dates are refused (None).
    """
    known = np.asarray([v is not None for v in text.to_pylist()], bool)
    cells = text.drop_null()
    there = pc.replace_substring_regex(pc.utf8_trim_whitespace(cells), r"(\d),(\d+)", r"\1.\2")
    there = pc.replace_substring_regex(there, r"(?i)\s*(?:Z|UTC|GMT)$", "+00:00")
    if not len(there) or not re.search(r"\d[:T]\d|\d [\d:]", str(there[0])):
        return None
    read, furthest = {}, 0
    for day in (*_DAYS, ""):
        form = f"{day}(?: +|T){_CLOCK}{_ZONE}" if day else _CLOCK
        us = _parsed(there[:_FEW], form)
        us = us if isinstance(us, int) else _parsed(there, form)
        if isinstance(us, int):
            furthest = max(furthest, us)
        else:
            read[day] = us
    if not read:
        why = f"{str(cells[furthest])[:40]!r} is no time as {str(cells[0])[:40]!r} is"
        return OddRow(int(np.flatnonzero(known)[furthest]), why) if furthest else None
    day, us = next(iter(read.items()))
    if not day:
        us = us + _DAY * np.cumsum(np.diff(us, prepend=us[0]) < -_DAY // 2)
    if sum(d in _AMBIGUOUS for d in read) > 1 and day in _AMBIGUOUS and np.unique(us // 86_400_000_000).size > 1:
        return None
    note = f"time: {'dates' if day else 'of day'}; {there[0]} taken for the start of the log"
    back = -1
    if not re.search(r":\d{2}(?:\.\d+)? *[+-]\d{2}:?\d{2}$", str(there[0])) and (at := _summer_ends(us)):
        us[at:] += _HOUR
        back = int(np.flatnonzero(known)[at])
    return Dates(_since(us, known), int(us[0]), note, back)


def date_notes(found: Dates, first: int) -> list[str]:
    """Notes on dates in a column whose first row is called ``first``."""
    note = Note(found.note, "converted", "time", len(found.t))
    if found.back < 0:
        return [note]
    row = first + found.back
    said = f"time: falls back by an hour at row {row}, at the end of summer time: the hour is taken out from there on"
    return [note, Note(said, "converted", "time", len(found.t) - found.back, [row])]


def _summer_ends(us: np.ndarray) -> int:
    """Place at which local time (microseconds) falls back by an hour, the only time and at night; 0 where it does
    not.
    """
    falls = np.flatnonzero(np.diff(us) < 0) + 1
    if falls.size != 1:
        return 0
    at = int(falls[0])
    fall, hour = us[at - 1] - us[at], us[at] % _DAY // _HOUR
    return at if _HOUR - _PAUSE <= fall <= _HOUR and hour < _NIGHT else 0


def _parsed(text: Any, form: str) -> np.ndarray | int:
    """Microseconds (int64) of dates or times of day that are all of one form and exist; of others the place of the
    first that is not.
    """
    parts = pc.extract_regex(text, f"^{form}$")
    if parts.null_count:
        first = int(pc.index(parts.is_null(), True).as_py())
        before = _parsed(text[:first], form) if first else 0
        return before if isinstance(before, int) else first

    def whole(name: str, absent: int = 0) -> np.ndarray:
        if parts.type.get_field_index(name) < 0:
            return np.full(len(text), absent)
        cells = pc.struct_field(parts, name)
        if name == "f":  # digits of whole microseconds
            cells = pc.utf8_slice_codeunits(pc.utf8_rpad(cells, 7, "0"), 1, 7)
        cells = pc.if_else(pc.equal(cells, ""), str(absent), cells)
        return numbers(cells.cast(pa.float64())).astype(np.int64)

    year, month, day = whole("y", 1970), whole("m", 1), whole("d", 1)
    if parts.type.get_field_index("w") >= 0:
        month = np.array([_MONTHS.get(w.lower(), 0) for w in pc.struct_field(parts, "w").to_pylist()])
    hour, minute, second = whole("H"), whole("M"), whole("S")
    half = pc.utf8_lower(pc.struct_field(parts, "h"))  # of the day: a, p or none
    halved = bool(pc.any(pc.not_equal(half, "")).as_py())
    east = whole("zh", _NO_ZONE)
    zoned = east != _NO_ZONE
    year += np.where(year < 69, 2000, np.where(year < 100, 1900, 0))
    begins = (12 * (year - 1970) + month - 1).astype("M8[M]")
    date = begins.astype("M8[D]") + (day - 1)
    wrong = (month < 1) | (month > 12) | (date.astype("M8[M]") != begins) | (hour > 23) | (minute > 59) | (second > 60)
    wrong |= zoned != zoned[0]
    if halved:
        wrong |= pc.equal(half, "").to_numpy(zero_copy_only=False) | (hour < 1) | (hour > 12)
    if wrong.any():
        return int(np.argmax(wrong))
    if halved:
        hour = hour % 12 + 12 * pc.equal(half, "p").to_numpy(zero_copy_only=False)
    if zoned.any():  # the sign is that of hours and minutes
        signs = np.where([str(z).startswith("-") for z in pc.struct_field(parts, "zh").to_pylist()], -1, 1)
        hour, minute = hour - east, minute - signs * whole("zm")
    seconds = ((date.astype(np.int64) * 24 + hour) * 60 + minute) * 60 + second
    return seconds * 1_000_000 + whole("f")


def _since(us: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Seconds since the first of whole microseconds, on the rows that are ``known``; `ABSENT` on the others."""
    out = np.full(known.size, ABSENT)
    out[known] = (us - us[0]) * 1e-6
    return out
