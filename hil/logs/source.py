"""What a format of logs gives and takes: it opens a file as a `Source`, which offers `Series` under names, and writes
`Channel`s.

A source says what stands in the file. `hil.logs.log` brings it to the product's names and units.
"""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from hil.logs.channels import Channel
from hil.logs.errors import LogError
from vaneloop.base.signals import UNITS

__all__ = [
    "ABSENT", "Channel", "LogError", "Options", "Samples", "Series", "Source", "check_file", "close_names", "find",
    "is_absent", "names_held", "numbers", "read_bytes", "second",
]  # fmt: skip

MAX_FILE = 4 << 30  # bytes; a CAN log beyond this is split by every logger


@dataclass(frozen=True)
class Series:
    """Samples as they stand in the file; sample k is called "``word`` ``first`` + k" (row 17); ``framed`` as of
    `Channel`.
    """

    t: np.ndarray
    values: np.ndarray
    unit: str = ""
    t_unit: str = ""
    word: str = "sample"
    first: int = 1
    framed: bool = False


class Source(Protocol):
    """A file that has been opened: ``names`` maps what it offers to the names it may be asked by."""

    kind: str
    names: dict[str, tuple[str, ...]]
    notes: list[str]
    sorted: bool

    def series(self, key: str) -> Series: ...

    def has(self) -> str: ...

    def absent(self, name: str) -> str: ...


class Samples:
    """A source whose samples are at hand: name -> series. What had to be left out of the file is said in ``notes``."""

    kind = "channel"
    sorted = False

    def __init__(self, series: Mapping[str, Series], notes: Iterable[str] = ()):
        self.notes = list(notes)
        self.names: dict[str, tuple[str, ...]] = {name: (name,) for name in series}
        self._series = series

    def has(self) -> str:
        return names_held(self.kind, self.names)

    def absent(self, name: str) -> str:
        return ""

    def series(self, key: str) -> Series:
        return self._series[key]


@dataclass(frozen=True)
class Options:
    """What a reader may need beyond the path."""

    dbc: Path | None
    mapping: Mapping[str, str]
    guess: bool = False  # the time may have a name that says it in other words
    part: int = 0  # which run of a file that holds several, from 1; 0: the reader's choice
    rows: bool = False  # a table may have no time: its rows stand in no order
    signals: Collection[str] = tuple(UNITS)  # names that are looked for, beside those mapped


# A cell without a sample is this NaN; a NaN that the logger wrote is any other. Only the latter is reported.
ABSENT = np.array([0x7FF8_0000_0000_0A0B], np.uint64).view(np.float64)[0]


def is_absent(values: np.ndarray) -> np.ndarray:
    """Which values are `ABSENT`: bool[n]."""
    return values.view(np.uint64) == np.uint64(0x7FF8_0000_0000_0A0B)


# --- files ------------------------------------------------------------------------------------------------------------


def check_file(path: Path) -> int:
    """Size of the file, or a LogError for one that is missing, a folder, empty, or too long."""
    try:
        folder, size = path.is_dir(), path.stat().st_size
    except (OSError, ValueError) as e:
        raise LogError(f"{path}: cannot be read ({getattr(e, 'strerror', None) or e})") from None
    if folder or not path.is_file():
        raise LogError(f"{path}: is {'a folder' if folder else 'not a file'}, not a log")
    if size > MAX_FILE:
        raise LogError(f"{path}: {size} bytes; allowed: up to {MAX_FILE}")
    if not size:
        raise LogError(f"{path}: is empty")
    return size


def read_bytes(path: Path, most: int = -1) -> bytes:
    """The file's bytes, or its first ``most``; LogError where it cannot be read."""
    check_file(path)
    try:
        with path.open("rb") as file:
            return file.read(most)
    except (OSError, MemoryError) as e:
        raise LogError(f"{path}: cannot be read ({getattr(e, 'strerror', None) or e})") from None


def numbers(column: Any, scale: float = 1.0) -> np.ndarray:
    """An array of Arrow's float64 times ``scale``, null as `ABSENT`; from its buffers: ``to_numpy`` imports pandas."""
    known, raw = column.buffers()
    part = slice(column.offset, column.offset + len(column))
    values = np.zeros(len(column)) if raw is None else np.frombuffer(raw, np.float64, part.stop)[part]
    with np.errstate(invalid="ignore", over="ignore"):  # of a damaged file any bits; what they say is judged later
        values = values * scale
    if column.null_count:
        values[np.unpackbits(np.frombuffer(known, np.uint8), bitorder="little")[part] == 0] = ABSENT
    return values


# --- names ------------------------------------------------------------------------------------------------------------


def find(source: Source, name: str, mapped: bool) -> list[str]:
    """What the file offers under ``name``: full name before short; in any case of letters only where the user gave the
    name.
    """
    if name in source.names:
        return [name]
    for fold in (str, str.casefold) if mapped else (str,):
        hits = [k for k, aliases in source.names.items() if any(fold(name) == fold(a) for a in aliases)]
        if hits:
            return hits
    return []


def second(names: Iterable[str]) -> str | None:
    """The first name that was there before; None where all differ."""
    seen = set[str]()
    return next((n for n in names if n in seen or seen.add(n)), None)  # type: ignore[func-returns-value]


def close_names(name: str, have: Iterable[str]) -> str:
    """Suggestions for a misspelt name."""
    back = {h.casefold(): h for h in have}
    near = difflib.get_close_matches(name.casefold(), back, 4, 0.6)
    return "; close: " + ", ".join(back[n][:60] for n in near) if near else ""


def names_held(kind: str, have: Iterable[str]) -> str:
    """What the file offers, shortened."""
    names = [str(h)[:60] for h in have]
    if not names:
        return f"; the file has no {kind}"
    more = f" and {len(names) - 12} more" if len(names) > 12 else ""
    return f"; the file has {len(names)} {kind}{'s' * (len(names) != 1)}: {', '.join(names[:12])}{more}"
