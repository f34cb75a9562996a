"""What other readers find in a log, beside what VaneLoop read: frames of python-can, signals of cantools, channels of
asammdf (`vaneloop map --check`).
"""

from __future__ import annotations

import io
import logging
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import can
import numpy as np

from hil.logs.blf import whole_blf
from hil.logs.bus_log import Bus
from hil.logs.formats import Format, format_at
from hil.logs.frames import EXTENDED, Frames
from hil.logs.mdf import Groups, read_as_others
from hil.logs.source import LogError, Options, Source

__all__ = ["Compared", "by_python_can", "compare"]

_READERS = {"candump": "python-can", "Vector ASCII": "python-can", "BLF": "python-can", "PEAK trace": "python-can",
            "MDF4": "python-can through asammdf"}  # fmt: skip
_MOST = 100_000  # frames of a message that cantools decodes, which takes it some 50 us each
_CLOSE = 2e-6  # s; a time since 1970 has no more digits as a floating point number


@dataclass(frozen=True)
class Compared:
    """One thing of a log as two readers have it; ``same`` is None where the other does not read it."""

    what: str
    ours: str
    theirs: str
    by: str
    same: bool | None

    def to_dict(self) -> dict[str, Any]:
        """The row as JSON has it."""
        return asdict(self)


def compare(path: str | Path, signals: dict[str, str], dbc: str | Path | None = None) -> list[Compared]:
    """Compare what VaneLoop reads of a log with what other libraries read of it.

    signals  signal -> its name in the log: what is to be compared beside the frames
    dbc      database of a log with frames; default: the product's own

    Raises LogError for a log that cannot be opened, InputError for an extra that is not installed.
    """
    path = Path(path)
    of = format_at(path)
    source = of.open(path, Options(Path(dbc) if dbc is not None else None, {name: s for s, name in signals.items()}))
    if isinstance(source, Bus):
        return [*_frames(path, of, source.frames), *_signals(source, signals)]
    if isinstance(source, Groups):
        return list(_channels(path, source, signals))
    return [Compared("columns", f"{len(source.names)}", "-", f"none of python-can, cantools, asammdf: {of.name}", None)]


def by_python_can(path: str) -> dict[str, np.ndarray]:
    """The data frames of a log as python-can reads them: t (s), ident, length, data."""
    log = logging.getLogger("can")
    level = log.level
    log.setLevel(logging.CRITICAL)
    try:
        file = io.BytesIO(whole_blf(Path(path))) if path.lower().endswith(".blf") else None
        with can.BLFReader(file) if file is not None else can.LogReader(path) as reader:
            frames = [
                (m.timestamp, m.arbitration_id | EXTENDED * m.is_extended_id, m.dlc, bytes(m.data).ljust(64, b"\0"))
                for m in reader
                if not m.is_remote_frame and not m.is_error_frame
            ]
    finally:
        log.setLevel(level)
    data = np.frombuffer(b"".join(f[3] for f in frames), np.uint8).reshape(-1, 64)
    kinds = {"t": np.float64, "ident": np.uint32, "length": np.int64}
    return {**{k: np.array([f[i] for f in frames], kind) for i, (k, kind) in enumerate(kinds.items())}, "data": data}


def _frames(path: Path, of: Format, ours: Frames) -> Iterator[Compared]:
    """Frames of a recording, beside python-can's."""
    by = _READERS.get(of.name)
    with path.open("rb") as file:
        if of.name == "frames in CSV" and file.read(64).removeprefix(b"\xef\xbb\xbf").startswith(b"timestamp,"):
            by = "python-can"
    if by is None:
        yield Compared("frames", f"{ours.t.size:,}", "-", f"python-can does not read {of.name}", None)
        return
    try:
        theirs = read_as_others(path, {"frames": True}) if of.name == "MDF4" else by_python_can(str(path))
    except Exception as e:  # a reader meets a damaged file with any exception there is
        why = str(e) if isinstance(e, LogError) else f"{type(e).__name__}: {e}"
        yield Compared("frames", f"{ours.t.size:,}", f"fails ({' '.join(why.split())[:80]})", by, None)
        return
    order = np.argsort(theirs["t"], kind="stable")
    theirs = {k: v[order] for k, v in theirs.items()}
    n = theirs["t"].size
    # python-can finds none in bus logging that does not name its source: that is no other answer
    yield Compared("frames", f"{ours.t.size:,}", f"{n:,}", by, n == ours.t.size if n else None)
    if not n or n != ours.t.size:
        return
    wide = np.pad(ours.data, ((0, 0), (0, 64 - ours.data.shape[1])))
    unlike = {
        "identifiers": ours.ident != theirs["ident"], "lengths": ours.length != theirs["length"],
        "bytes of data": (wide != theirs["data"]).any(axis=1),
        "times": np.abs(ours.t - (theirs["t"] - theirs["t"][0])) > _CLOSE,
    }  # fmt: skip
    for what, other in unlike.items():
        count = int(np.count_nonzero(other))
        first = f", the first in frame {int(np.argmax(other)) + 1:,}" if count else ""
        yield Compared(what, f"{n:,} frames", f"{count:,} differ{first}", by, not count)


def _signals(bus: Bus, signals: dict[str, str]) -> Iterator[Compared]:
    """Signals cut out of the frames that VaneLoop read, beside cantools'."""
    decoded: dict[int, list[dict[str, Any]]] = {}
    for signal, name in signals.items():
        keys = [k for k, names in bus.names.items() if name in names]
        for key in keys:
            message, branches, frames, rows = bus.carried(key)
            rows = rows[:_MOST]
            ours = bus.series(key)
            kept = ours.t <= frames.t[rows[-1]] if rows.size else np.zeros(ours.t.size, bool)
            own = dict(zip(ours.t[kept].tolist(), ours.values[kept].tolist(), strict=True))
            if message.ident not in decoded:
                cut = zip(frames.data[rows], frames.length[rows].tolist(), strict=True)
                decoded[message.ident] = [_decoded(message.layout, data[:n].tobytes()) for data, n in cut]
            pairs = zip(frames.t[rows].tolist(), decoded[message.ident], strict=True)
            theirs = {t: float(found[wanted]) for t, found in pairs if (wanted := branches[0].name) in found}
            wrong = [t for t, v in own.items() if not np.isclose(v, theirs.get(t, np.nan), rtol=1e-12, atol=1e-12)]
            more = len(theirs) - len(own)
            said = (
                f"{len(wrong):,} differ" if wrong else "the same" if not more else f"{more:,} more, said not available"
            )
            silent = more == 0 or bool(message.missing.get(str(branches[0].name)) is not None or message.j1939)
            yield Compared(
                f"{signal} ({key})", f"{len(own):,} samples", f"{len(theirs):,} samples, {said}", "cantools",
                not wrong and silent,
            )  # fmt: skip


def _decoded(layout: Any, data: bytes) -> dict[str, Any]:
    """The values of the signals that are in a frame."""
    try:
        return dict(layout.decode(data, decode_choices=False, allow_truncated=True))
    except Exception:  # cantools: a selector that is not known, or data that end before it
        return {}


def _channels(path: Path, source: Source, signals: dict[str, str]) -> Iterator[Compared]:
    """Channels of an MDF file, beside asammdf's own `get`."""
    keys = {k: signal for signal, name in signals.items() for k, names in source.names.items() if name in names}
    theirs = read_as_others(path, {"channels": list(keys)}) if keys else {}
    for n, (key, signal) in enumerate(keys.items()):
        ours, t, values = source.series(key), theirs[f"t{n}"], theirs[f"v{n}"]
        pairs = {"times": (ours.t, t), "values": (ours.values, values)}
        unlike = [what for what, (a, b) in pairs.items() if not np.array_equal(a, b, equal_nan=True)]
        yield Compared(
            f"{signal} ({key})", f"{ours.t.size:,} samples",
            f"{t.size:,} samples, {' and '.join(unlike) + ' differ' if unlike else 'the same'}", "asammdf", not unlike,
        )  # fmt: skip
