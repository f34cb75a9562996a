"""Where a table of text begins, and how its cells are written: lines before the header, the header, a row of units,
the separator, the decimal sign.
"""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from hil.logs.names import is_time
from hil.logs.source import LogError, Options
from hil.logs.table import TIME_NAMES, split_unit
from hil.logs.units import NO_UNIT, factor_of

__all__ = ["SEPARATORS", "Layout", "cells_of", "in_points", "layout_of", "line_at", "opening", "rows_of", "units_row"]

SEPARATORS = ",;\t|"
MOST_COLUMNS = 10_000
LOOKED_AT = 60  # lines, in which the header stands
SAMPLED = 200  # lines, whose cells say what the decimal sign is
_MOST_BYTES = 1 << 18  # of the lines looked at
_REMARKS = re.compile("(?i)(?:comment|remark|note)s?|kommentar|bemerkung(?:en)?")
_LABVIEW, _LABVIEW_END = b"LabVIEW Measurement", b"***End_of_Header***"

_DATUM = re.compile(r"[-+.,]?\d[\d.,:/T Z+eE-]*|(?i:nan|[-+]?inf(?:inity)?)")  # a number or a date, no word
_POINTS_OFF = re.compile(r"[-+]?\d{1,3}(?:\.\d{3})+,\d*")  # 1.234,5
_COMMAS_OFF = re.compile(r"[-+]?\d{1,3}(?:,\d{3})+\.\d*|[-+]?\d{1,3}(?:,\d{3}){2,}")  # 1,234.5
_GROUPED = re.compile(r"[-+]?[1-9]\d{0,2}(?:\.\d{3})+")  # 1.234
_EITHER = re.compile(r"[-+]?[1-9]\d{0,2},\d{3}")  # 1,234
_DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+(?:[eE][-+]?\d+)?")
_DECIMAL_POINT = re.compile(r"[-+]?\d*\.\d+(?:[eE][-+]?\d+)?")


class Line(NamedTuple):
    """A line of a file: its text, its first byte and that of the next line, its row as an editor counts."""

    text: str
    at: int
    behind: int
    row: int


@dataclass(frozen=True)
class Layout:
    """How a table of text is written.

    head       the header line
    headers    its cells; ``keys``: the same, each only once (``Trigger``, ``Trigger.2``); "" where a column has no name
    least      cells that a row has at least: a column of remarks at the end may lack its cell
    units      key -> unit, of the row of units under the header
    at, first  byte and row (as an editor counts) of the first row of samples
    comma      decimal comma; ``thousands``: some numbers have signs between their thousands
    opens      how the lines before the header begin
    sample     the text of the first rows
    labview    what the header of a LabVIEW measurement file says: word -> cells behind it; empty for other files
    """

    head: Line
    headers: list[str]
    keys: list[str]
    least: int
    separator: str
    units: dict[str, str]
    under: Line | None
    at: int
    first: int
    comma: bool
    thousands: bool
    opens: frozenset[str] = frozenset()
    sample: bytes = field(default=b"", repr=False)
    labview: dict[str, list[str]] = field(default_factory=dict, repr=False)


def line_at(raw: bytes, at: int, row: int = 0) -> Line:
    """The line that begins at a byte, without its end."""
    end = raw.find(b"\n", at)
    text, behind = (raw[at:], len(raw)) if end < 0 else (raw[at:end], end + 1)
    return Line(text.decode("utf-8", "replace").strip("\r"), at, behind, row)


def _lines(raw: bytes, first: Line, most: int) -> Iterator[Line]:
    line = first
    for _ in range(most):
        yield line
        if line.behind >= len(raw) or line.behind - first.at > _MOST_BYTES:
            return
        line = line_at(raw, line.behind, line.row + 1)


def cells_of(text: str, separator: str) -> list[str]:
    """Cells of one line; none where it cannot be read by itself."""
    if '"' not in text and "\r" not in text and len(text) < csv.field_size_limit():
        return [c.strip() for c in text.split(separator)] if text else []
    try:
        return [c.strip() for c in next(csv.reader([text], delimiter=separator), [])]
    except csv.Error:
        return []


def layout_of(path: Path, raw: bytes, options: Options) -> Layout:
    """The layout of a table (UTF-8). Raises LogError, one line, for a header that cannot be read."""
    line = line_at(raw, 0, 1)
    while line.behind < len(raw) and (line.text.startswith("#") or not line.text.strip()):
        line = line_at(raw, line.behind, line.row + 1)
    if re.fullmatch(r'"?sep=.?"?', line.text) and line.behind < len(raw):  # what Excel writes to be read by Excel
        line = line_at(raw, line.behind, line.row + 1)
    opens, said = frozenset[str](), dict[str, list[str]]()
    if raw.startswith(_LABVIEW, line.at):
        before, line = _behind_labview(raw, line)
        opens = frozenset(opening(b.text) for b in before)
        said = {
            c[0]: c[1:] for b in before if len(c := cells_of(b.text, "\t")) > 1 or len(c := cells_of(b.text, ",")) > 1
        }
    lines = list(_lines(raw, line, LOOKED_AT))
    head, separator = _header(lines, {name for name, signal in options.mapping.items() if signal == "t"})
    opens |= {opening(b.text) for b in lines if b.row < head.row and b.text.strip()}
    try:
        headers = [h.strip() for h in next(csv.reader([head.text], delimiter=separator), [])]
    except csv.Error as e:
        raise LogError(f"{path}: header line cannot be read ({e}): {head.text[:80]!r}") from None
    if len(headers) > MOST_COLUMNS:
        raise LogError(f"{path}: {len(headers)} columns; allowed: {MOST_COLUMNS}")
    keys = _once(headers)
    under: Line | None = line_at(raw, head.behind, head.row + 1)
    units = units_row(under.text, keys, separator) if under is not None else {}
    under = under if units else None
    last = under or head
    sample = _sample(raw, last, separator)
    comma, thousands = False, False
    if (b'"' if separator == "," else b",") in sample:  # else no cell has a comma
        comma, thousands = _decimal(rows_of(sample, separator))
    if (sign := said.get("Decimal_Separator", [""])[0]) in (",", "."):
        comma = sign == ","
    if said and not units:
        units = _labview_units(said, keys)
    least = len(headers)
    while least > 1 and (not headers[least - 1] or _REMARKS.fullmatch(headers[least - 1])):
        least -= 1
    return Layout(
        head, headers, keys, least, separator, units, under, last.behind, last.row + 1, comma, thousands, opens, sample,
        said,
    )  # fmt: skip


def opening(text: str) -> str:
    """How a line begins: its first cell, without quotation marks and what follows a colon."""
    return re.split(r"[:,;\t]", text.strip().strip('"'), maxsplit=1)[0]


def _labview_units(said: dict[str, list[str]], keys: list[str]) -> dict[str, str]:
    """Column -> unit, as the header of a LabVIEW measurement file has it: a unit for each channel, none for their
    times.
    """
    step = 2 if said.get("X_Columns", [""])[0] == "Multi" else 1
    channels = keys[1::step]
    return {k: u for k, u in zip(channels, said.get("Y_Unit_Label", []), strict=False) if k and u}


def _behind_labview(raw: bytes, line: Line) -> tuple[list[Line], Line]:
    """The lines of a LabVIEW measurement file that stand before the header of its first segment, and that header."""
    before: list[Line] = []
    ends = 0
    for one in _lines(raw, line, 4 * LOOKED_AT):
        if ends == 2 or (ends and _DATUM.fullmatch(opening(one.text))):
            return before, one
        before.append(one)
        ends += one.text.strip().startswith(_LABVIEW_END.decode())
    return [], line


def _header(lines: list[Line], times: set[str]) -> tuple[Line, str]:
    """The line that is the header, and the separator: a line of words that has as many cells as the rows below it; the
    first one where there is none.
    """
    best: tuple[int, int, Line, str] | None = None
    for separator in SEPARATORS:
        if not any(separator in b.text for b in lines):
            continue
        cells = [cells_of(b.text, separator) for b in lines]
        rows = [i for i, c in enumerate(cells) if len(c) > 1 and any(map(_DATUM.fullmatch, c))]
        if not rows:
            continue
        usual, number = Counter(len(cells[i]) for i in rows).most_common(1)[0]
        begins = next(i for i in rows if len(cells[i]) == usual)
        ends_empty = usual > 2 and all(not cells[i][-1] for i in rows if len(cells[i]) == usual)
        able = [
            i
            for i, c in enumerate(cells[:begins])
            if len(c) >= usual - ends_empty and sum(map(bool, c)) > 1 and not any(map(_DATUM.fullmatch, c))
        ]
        if able:
            timed = (i for i in able if any(_is_time(c, times) for c in cells[i]))
            found = number, usual, lines[next(timed, able[0])], separator
            best = max(best, found, key=lambda b: b[:2]) if best else found
    if best is not None:
        return best[2], best[3]
    return lines[0], max(SEPARATORS, key=lines[0].text.count)


def _is_time(header: str, times: set[str]) -> bool:
    name = split_unit(header)[0]
    return bool({header, name} & times) or name.casefold() in TIME_NAMES or is_time(header)[0] > 0.0


def _once(headers: list[str]) -> list[str]:
    """Keys of the columns: the header, with a number behind it where it stood there before."""
    taken = set(headers)
    seen: Counter[str] = Counter()
    out = []
    for h in headers:
        seen[h] += bool(h)
        key, n = h, seen[h]
        while seen[h] > 1 and key in taken:
            key, n = f"{h}.{n}", n + 1
        taken.add(key)
        out.append(key)
    return out


def units_row(text: str, keys: list[str], separator: str) -> dict[str, str]:
    """Key -> unit, where the row under the header holds words, at least half of them units; empty where it does not."""
    cells = [c.strip("[]()").strip() for c in cells_of(text, separator)]
    said = [c for c in cells if c.casefold() not in NO_UNIT]
    known = sum(factor_of(c, "s") is not None for c in said if not _DATUM.fullmatch(c))
    if not known or 2 * known < len(said) or any(map(_DATUM.fullmatch, said)) or len(cells) > len(keys):
        return {}
    return {k: c for k, c in zip(keys, cells, strict=False) if k and c.casefold() not in NO_UNIT}


def _sample(raw: bytes, last: Line, separator: str) -> bytes:
    """The first rows; where no comma is in them that could be a decimal one, the first rows with one, too."""
    behind = _behind(raw, last.behind)
    sample = raw[last.behind : behind]
    if separator != "," and b"," not in sample and (far := raw.find(b",", behind)) >= 0:
        first = raw.rfind(b"\n", 0, far) + 1
        sample += raw[first : _behind(raw, first)]
    return sample


def _behind(raw: bytes, at: int) -> int:
    """The byte behind some lines, of which the first begins at a byte."""
    first = at
    for _ in range(SAMPLED):
        end = raw.find(b"\n", at)
        if end < 0:
            return len(raw)
        at = end + 1
        if at - first > _MOST_BYTES:
            break
    return at


def rows_of(sample: bytes, separator: str) -> Iterator[list[str]]:
    """The cells of each line."""
    return (cells_of(text.strip("\r"), separator) for text in sample.decode("utf-8", "replace").split("\n"))


def _decimal(rows: Iterable[Iterable[str]]) -> tuple[bool, bool]:
    """Whether the decimal sign is a comma, and whether thousands have signs between them."""
    cells = [c for row in rows for c in row]
    commas = [c for c in cells if "," in c]
    points_off, commas_off = (any(map(p.fullmatch, commas)) for p in (_POINTS_OFF, _COMMAS_OFF))
    if points_off or any(_DECIMAL_COMMA.fullmatch(c) and not _EITHER.fullmatch(c) for c in commas):
        return True, points_off
    either = any(map(_EITHER.fullmatch, commas))
    points = commas_off or any(map(_DECIMAL_POINT.fullmatch, cells))
    return (False, either or commas_off) if points else (either, False)


def in_points(cells: list[str], comma: bool, thousands: bool) -> list[str]:
    """Cells of a column with a point as decimal sign and none between thousands; what is no number stays as it is.

    Raises ValueError, with the cell, for numbers that may be read either way: 1.234 in a table with decimal commas.
    """
    if not comma:
        return [c.replace(",", "") if _COMMAS_OFF.fullmatch(c) or _EITHER.fullmatch(c) else c for c in cells]
    pointed = [c for c in cells if "," not in c and _DECIMAL_POINT.fullmatch(c) or _GROUPED.fullmatch(c)]
    if pointed:
        grouped = all(map(_GROUPED.fullmatch, pointed))
        commas = any("," in c for c in cells)
        if not grouped and not commas:
            return cells  # a column with decimal points
        if not grouped or not (thousands or any(map(_POINTS_OFF.fullmatch, cells))):
            raise ValueError(pointed[0])
    off = [c.replace(".", "") if _POINTS_OFF.fullmatch(c) or _GROUPED.fullmatch(c) else c for c in cells]
    return [c.replace(",", ".") if _DECIMAL_COMMA.fullmatch(c) else c for c in off]
