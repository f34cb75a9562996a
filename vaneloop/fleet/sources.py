"""Which logs there are, whose they are, and when each began: from a list, the file's metadata, or its path."""

from __future__ import annotations

import csv
import os
import re
import stat
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from hil.logs.formats import format_of, suffixes
from vaneloop.base.cells import unmarked
from vaneloop.base.errors import InputError

__all__ = ["Source", "find", "moment", "text_table"]

# 2026-03-14, 20260314, each with or without T12:30:05, T1230, _12-30-05
_DATE = re.compile(
    r"(?<!\d)((?:19|20)\d\d)-?(0[1-9]|1[0-2])-?(0[1-9]|[12]\d|3[01])"
    r"(?:[T_ -]?([01]\d|2[0-3])[:-]?([0-5]\d)(?:[:-]?([0-5]\d))?)?(?!\d)"
)


@dataclass(frozen=True)
class Source:
    """A log: path, engine ("": not known), time of its start in s since 1970 (None: not known), and why it cannot be
    taken up ("": it can).
    """

    path: str
    engine: str = ""
    time: float | None = None
    fault: str = ""

    def described(self) -> Source:
        """The same with what the list leaves open, from the file's metadata or else its path."""
        if self.engine and self.time is not None:
            return self
        own, path = _metadata(self.path), Path(self.path)
        when = next((t for text in (own.get("time", ""), path.name) if (t := moment(text)) is not None), None)
        return Source(
            self.path,
            self.engine or own.get("engine", "") or path.parent.name,
            when if self.time is None else self.time,
        )


def moment(text: str) -> float | None:
    """Seconds since 1970 of the first date (with or without a time, taken as UTC) in ``text``; None: there is none."""
    m = _DATE.search(text)
    if m is None:
        return None
    try:
        year, month, date, hour, minute, second = (int(x or 0) for x in m.groups())
        return datetime(year, month, date, hour, minute, second, tzinfo=UTC).timestamp()
    except ValueError:  # 30 February
        return None


def find(places: Sequence[str], engines: str | None = None) -> list[Source]:
    """Every log under ``places`` (files and folders), each once, by path.

    engines  CSV file with the columns path, engine, time (or some of them): it comes before what a file says of itself
             (`Source.described`): its Parquet metadata ``engine`` and ``time``, and these before its path, the folder's
             name and a date in the file's name
    Raises InputError for a place that is not there, or a table that cannot be read.
    """
    listed = _table(engines) if engines else {}
    out = []
    for path in sorted(set(_files(places))):
        said = listed.get(path) or listed.get(Path(path).name) or {}
        shown = path.encode("utf-8", "backslashreplace").decode()
        fault = "" if shown == path else "its name is not UTF-8; rename it"
        out.append(Source(shown, said.get("engine", ""), moment(said.get("time", "")), fault))
    if not out:
        raise InputError(f"{', '.join(places)}: holds no log; allowed: {', '.join(suffixes())}")
    return out


def _files(places: Sequence[str]) -> Iterator[str]:
    ends = suffixes()
    for place in places:
        p = Path(place)
        if p.is_dir():
            for folder, _, names in os.walk(p.absolute()):
                for name in names:
                    f = os.path.join(folder, name)
                    if name[0] != "." and f.lower().endswith(ends) and (os.path.islink(f) or os.path.isfile(f)):
                        yield f
        elif _is_file(p):
            yield str(p.absolute())
        else:
            raise InputError(f"{place}: is neither a log nor a folder of logs")


def _is_file(path: Path) -> bool:
    """Whether it is a plain file: to read a pipe would wait for ever."""
    try:
        return stat.S_ISREG(path.stat().st_mode)
    except OSError:
        return False


def _metadata(path: str) -> dict[str, str]:
    """What a file says of itself; nothing where it cannot be asked (it becomes a row with a reason)."""
    if not _is_file(Path(path)):
        return {}
    try:
        return format_of(Path(path)).said_by(Path(path))
    except InputError:
        return {}


def text_table(file: str, option: str) -> tuple[list[str], list[dict[str, str]]]:
    """Columns and rows of a small CSV that an ``option`` names, blanks taken off; InputError where it is none."""
    try:
        with open(file, encoding="utf-8-sig", newline="") as text:
            rows = csv.DictReader(text, restval="", strict=True)
            have = [str(name).strip() for name in rows.fieldnames or []]
            if twice := next((name for i, name in enumerate(have) if name in have[:i]), None):
                raise InputError(f"{option} {file}: has the column {twice[:60]!r} more than once; allowed: once")
            return have, [
                dict(zip(have, (unmarked(v).strip() for v in list(row.values())[: len(have)]), strict=True))
                for row in rows
            ]
    except (OSError, UnicodeDecodeError, csv.Error) as e:
        raise InputError(f"{option} {file}: cannot be read as CSV ({str(e).splitlines()[0]})") from None


def _table(file: str) -> dict[str, dict[str, str]]:
    """Engine and time by path (as written, and from the table's folder) and by a file's name."""
    have, rows = text_table(file, "--engines")
    if "path" not in have or not {"engine", "time"} & set(have):
        raise InputError(f"--engines {file}: has the columns {', '.join(have)}; needed: path and engine, time or both")
    out: dict[str, dict[str, str]] = {}
    for number, row in enumerate(rows, 2):
        said = {k: row.get(k, "") for k in ("engine", "time")}
        if said["time"] and moment(said["time"]) is None:
            raise InputError(
                f"--engines {file}:{number}: time (={said['time']!r}) must be a date such as 2026-03-14T12:30"
            )
        path = row["path"]
        out[path] = out[str((Path(file).parent / path).absolute())] = said
    return out
