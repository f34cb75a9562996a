"""Frames of a CAN log as columns of numbers.

A log of any format becomes one `Frames` (time, identifier, bus, length, bytes as arrays); a signal is then cut out
of all frames of its message at once (`hil.logs.signals`). That is what makes an hour of CAN readable in a second:
python-can and cantools walk frame by frame at 0.2 to 0.3 million frames/s and serve here as the reference in the tests,
as the writers of the formats where speed matters less, and as the source of the layout (DBC).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from hil.logs import plausible
from hil.logs.notes import MOST_ROWS, Note
from hil.logs.source import LogError

__all__ = ["DISORDER_S", "EXTENDED", "Frames", "frames_in_order", "in_order"]

EXTENDED = 1 << 31  # flag in `Frames.ident`, as socketcan sets it
DISORDER_S = 0.050  # loggers that merge several channels swap frames by a few ms; more is a clock that jumped


@dataclass(frozen=True)
class Frames:
    """All data frames of a log, in order of time.

    t       float64[n]      s from the first frame
    ident   uint32[n]       identifier, bit 31 set for the 29-bit kind
    bus     int32[n]        number of the bus (interface) in the log
    length  uint8[n]        bytes of data
    data    uint8[n, w]     data, zeros behind `length`; w = 8, or 64 where the log has CAN FD
    """

    t: np.ndarray
    ident: np.ndarray
    bus: np.ndarray
    length: np.ndarray
    data: np.ndarray
    notes: list[str] = field(default_factory=list)

    @property
    def words(self) -> np.ndarray:
        """uint64[n]: eight bytes of data as one number, the first lowest."""
        return np.ascontiguousarray(self.data).view("<u8")[:, 0]


def in_order(name: str, t: np.ndarray, notes: list[str]) -> tuple[np.ndarray, np.ndarray | slice]:
    """Times in s from the first (``t`` in s, or int64 ns) and the order that sorts them; refuse a clock that jumped
    back.
    """
    if t.dtype == np.int64:
        t = (t - t[:1]) / 1e9
    if not np.isfinite(t).all():
        raise LogError(f"{name}: time of frame {int(np.argmin(np.isfinite(t))) + 1} is not a number")
    if not t.size or (np.diff(t) >= 0).all():
        return t, slice(None)
    falls = int(np.count_nonzero(np.diff(t) < 0))
    steps = (
        f"{name}: time runs backwards at {falls} of {t.size} frames; it must count from one start (not from frame to "
        f"frame)"
    )
    if falls > 0.01 * t.size and t.size > 10 and _stands(t):
        raise LogError(steps)
    back = np.maximum.accumulate(t) - t
    worst = int(np.argmax(back))
    if back[worst] > DISORDER_S and (wrong := plausible.out_of_order(t, DISORDER_S)) is not None:
        first = int(np.argmax(wrong))
        what = f"{int(np.count_nonzero(wrong)):,} of {t.size:,} frames"
        said = (
            f"time: {what} have a wrong time stamp (first frame {first + 1}: {t[first]:.9g} s from the first): left out"
        )
        notes.append(
            Note(said, "left out", "frames", int(np.count_nonzero(wrong)), np.flatnonzero(wrong)[:MOST_ROWS] + 1)
        )
        rows = np.flatnonzero(~wrong)
        return t, rows[in_order(name, t[rows], notes)[1]]
    if back[worst] > DISORDER_S:
        limit = f"allowed: up to {DISORDER_S * 1e3:g} ms (sorted)"
        raise LogError(f"{name}: time runs backwards by {back[worst]:.6g} s at frame {worst + 1}; {limit}")
    if falls > 0.3 * t.size and t.size > 10:
        raise LogError(steps)
    notes.append(
        f"{int(np.count_nonzero(back > 0))} frames out of order by up to {back[worst] * 1e3:.3g} ms: sorted by time"
    )
    return t, np.argsort(t, kind="stable")


def _stands(t: np.ndarray) -> bool:
    """Whether the times of a log do not grow on the whole, as those from frame to frame do not."""
    low, high = np.quantile(t, [0.1, 0.9])
    half = t.size // 2
    return bool(np.median(t[half:]) - np.median(t[:half]) <= 0.1 * (high - low))


def frames_in_order(
    name: str, t: np.ndarray, ident: np.ndarray, bus: np.ndarray, length: np.ndarray, data: np.ndarray, notes: list[str]
) -> Frames:
    """Frames in order of time from the first."""
    t, order = in_order(name, t, notes)
    t = t[order]
    return Frames(t - t[:1], ident[order], bus[order], length[order], data[order], notes)
