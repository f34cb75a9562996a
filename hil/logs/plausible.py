"""What a log of this machine can hold: a range for each signal, and a time that runs. Reading judges by it, for every
command alike.

A wrong unit shifts a whole channel, a sensor's spike shifts single samples. So a channel whose samples mostly lie
outside its range is refused, and a few of them are left out. A channel a hundred or a thousand times too small is
inside every range; it is refused where the machine moves and the channel moves with it, only so little. docs/logs.md is
the user's page.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from vaneloop.base.signals import SIDES
from vaneloop.base.vanes import VANES

__all__ = [
    "FEW", "JUMP", "RANGES", "Range", "judge", "latest", "longest_part", "out_of_order", "span_complaint", "too_small",
    "unit_of_time",
]  # fmt: skip

# share of a channel's samples (or a log's rows) that may be wrong one by one; more is a wrong unit, or a wrong clock
FEW = 0.1
RUN = 10  # rows: so many wrong time stamps in a row are still single ones
# s: a longer silence is a clock that jumped; nearly three hours, longer than any gap that a run is worth keeping for
JUMP = 1e4
# s from row to row, on average, in a log of more than 2 * JUMP; the raster of the simulation must stay in proportion
SLOWEST = 10.0
LONGEST = 1e5  # s, 28 h: the simulation holds all of it in memory, 30 kB a second
LATEST = 1e10  # s since 1970, the year 2286
CLOCKS = {"ms": 1e-3, "us": 1e-6, "ns": 1e-9}  # what else loggers count in, s
USUAL_STEP = 1e-2  # s from row to row


@dataclass(frozen=True)
class Range:
    """What a signal can be, in its own unit.

    low, high  what the machine, its sensors and its bus can give, with room for faults of sensors
    why        where the range comes from
    typical    a usual value; of the units that would explain a wrong channel the one that comes nearest is proposed
    large      units in which the numbers are too large: name -> factor and offset to the signal's own
    small      unit in which the numbers are far too small, and how many of the signal's own it is
    """

    unit: str
    low: float
    high: float
    why: str
    typical: float = 0.0
    large: Mapping[str, tuple[float, float]] | None = None
    small: tuple[str, float] | None = None


_SPEED = Range(
    "%", -10.0, 150.0, "the bus carries up to 131 %; no rotor stands 150 %", 80.0, {"rpm": (0.0, 0.0)}, ("ratio", 100.0)
)
_STROKE = Range(
    "mm",
    -25.0,
    75.0,
    "0 to 48 mm from stop to stop, half a stroke beyond for a faulty LVDT",
    24.0,
    {"um": (1e-3, 0.0)},
    ("m", 1e3),
)
_ANGLE = Range(
    "deg",
    -90.0,
    90.0,
    "a vane turns less than a quarter turn either way",
    15.0,
    {"mrad": (0.0573, 0.0)},
    ("rad", 57.29578),
)
RANGES = {
    "n_dem": _SPEED,
    "n_r": _SPEED,
    "x_dem": _STROKE,
    "x_lvdt": _STROKE,
    "i_cmd": Range("mA", -100.0, 100.0, "rated current 40 mA; drivers give no more than twice "
                                        "that", 5.0, {"uA": (1e-3, 0.0)}, ("A", 1e3)),
    "p_s": Range(
        "MPa", -1.0, 60.0, "nominal 21 MPa; the highest aircraft hydraulics have 56 MPa", 21.0,
        {"Pa": (1e-6, 0.0), "kPa": (1e-3, 0.0), "bar": (0.1, 0.0), "psi": (6.894757e-3, 0.0)},
    ),
    "t_oil": Range(
        "degC", -80.0, 200.0, "no oil flows below -80 degC or lasts above 200 degC", 40.0,
        {"K": (1.0, -273.15), "degF": (1 / 1.8, -17.8)},
    ),
    **dict.fromkeys(VANES, _ANGLE),
    "state": Range("-", 0.0, 4.0, "the modes of vgv.dbc: INIT, STANDBY, RUN, DEGRADED, FAIL_SAFE"),
    **dict.fromkeys(SIDES, _STROKE),
}  # fmt: skip


# ---- values ----------------------------------------------------------------------------------------------------------


def judge(signal: str, values: np.ndarray) -> tuple[np.ndarray, str]:
    """Which values (own unit) are inside the signal's range, and why they cannot all be the signal's, if so: "" where a
    few are wild.

    Values near 0 say nothing about the unit: an engine at rest has 0 rpm and 0 %. They do not count in the share.
    """
    r = RANGES[signal]
    inside = (values >= r.low) & (values <= r.high)
    if inside.all():
        return inside, ""
    outside = int(np.count_nonzero(~inside))
    telling = int(np.count_nonzero(np.abs(values) > 0.01 * r.high))
    if outside <= FEW * telling:
        return inside, ""
    median = float(np.median(values[~inside]))
    share = "all" if outside == values.size else f"{outside:,} of {values.size:,}"
    unit = "" if r.unit == "-" else f" {r.unit}"
    return inside, f"{share} values are outside {r.low:g} to {r.high:g}{unit} (median of these {median:,.6g})"


def proposed(signal: str, values: np.ndarray) -> str:
    """Options that would put the values into the signal's range: the unit that comes nearest to what is usual."""
    r = RANGES[signal]
    if r.large is None:
        return "map another name to it, or leave it out"
    if r is _SPEED:
        return f"--unit {signal}=rpm --design-rpm R, if it is in rpm"
    outside = values[(values < r.low) | (values > r.high)]
    median = float(np.median(np.abs(outside)))
    able = {u: a * median + b for u, (a, b) in r.large.items() if r.low <= a * median + b <= r.high}
    best = min(able, key=lambda u: abs(np.log(max(able[u], 1e-3) / r.typical)), default="")
    return f"--unit {signal}={best}, if it is in {best}" if best else f"--unit {signal}=UNIT says what it is in"


# what shows that the machine moves, and how much at least: signal -> own unit
_MOVES = dict.fromkeys(("n_dem", "n_r", "x_dem", "x_lvdt", *SIDES, *VANES), 10.0)
_NOTHING = 1e-6  # mA, a nanoampere; no current of a valve is told so finely, and 1 uA if it is in A moves no piston
_PUSHED = 5.0  # mm of stroke in a second: 1.3 mA at the nominal flow gain


def too_small(
    channels: Mapping[str, tuple[np.ndarray, np.ndarray]], stated: set[str]
) -> tuple[dict[str, str], dict[str, str]]:
    """Signals that are far too small for their unit, each with words: those that certainly are, and those that may be.

    channels  signal -> t (s), values (own unit)
    stated    signals whose unit the user named: what they say is taken

    Certainly: it stays within what the larger unit's range would be, moves there smoothly by a tenth of it, and the
    machine cannot do that; or it is a current too small in the larger unit, too. A speed never rises smoothly within
    1.5 %, nor a stroke within 0.075 mm; angles count while speed or stroke run over a tenth of their range, a current
    while the stroke is pushed.
    """
    within = {}
    for s, (_, v) in channels.items():
        r = RANGES.get(s)
        if r is not None and r.small is not None and v.size and np.any(v != 0.0):
            within[s] = bool(r.low / r.small[1] <= v.min() and v.max() <= r.high / r.small[1])
    sure, perhaps = {}, {}
    for s, small in within.items():
        r = RANGES[s]
        if not small or r.small is None or s in stated:
            continue
        t, v = channels[s]
        unit, factor = r.small
        moved = float(np.ptp(v))
        enough = 0.1 * (r.typical if s == "i_cmd" else r.high) / factor
        smooth = v.size >= 50 and moved >= enough and moved > 20.0 * float(np.median(np.abs(np.diff(v))))
        others = {k: channels[k] for k in _MOVES if k in channels and k != s and not within.get(k, False)}
        moves = any(np.ptp(o) > _MOVES[k] for k, (_, o) in others.items())
        if s == "i_cmd":
            certain = any(_in_a_second(*o) > _PUSHED for k, o in others.items() if k.startswith("x_"))
        elif r is _ANGLE:
            certain = any(np.ptp(o) > _MOVES[k] for k, (_, o) in others.items() if RANGES[k] is not _ANGLE)
        else:
            certain = True
        words = f"all values are within {v.min():.4g} to {v.max():.4g} {r.unit}"
        if s == "i_cmd" and certain and 0.0 < moved < _NOTHING:  # a dead sensor does not move at all
            sure[s] = (
                f"{words}, which is too little for a machine that moves, in {unit} too; --map NAME={s} names another, "
                f"--unit {s}=UNIT says what it is in"
            )
        elif smooth and certain:
            sure[s] = (
                f"{words}, which is too little for a machine that moves; --unit {s}={unit}, if it is in {unit} "
                f"({s}={r.unit}, if not)"
            )
        elif smooth or moves or (r is _SPEED and np.median(v) > 0.1):
            perhaps[s] = f"{words}; if they are in {unit}: --unit {s}={unit}"
    return sure, perhaps


def _in_a_second(t: np.ndarray, v: np.ndarray) -> float:
    """Largest change within a second that the samples show."""
    later = np.searchsorted(t, t + 1.0 + 1e-9, side="right") - 1
    return float(np.abs(v[later] - v).max()) if t.size else 0.0


# ---- time ------------------------------------------------------------------------------------------------------------


def latest(t: np.ndarray) -> bool:
    """Whether ``t`` may be seconds, from whatever start; milliseconds since 1970 are not."""
    return not t.size or abs(float(np.median(t))) <= LATEST


def out_of_order(t: np.ndarray, slack: float = 0.0) -> np.ndarray | None:
    """Rows whose time stamp is wrong, as the order of the rows shows: bool[n]; None where that does not explain why
    time runs backwards.

    The most rows that can be kept with a time that never falls are kept. What is left must be single stamps (no more
    than `RUN` in a row, `FEW` of all), or one side of a clock that jumped by more than `JUMP`. ``slack`` (s): rows that
    are so little late are no wrong stamps.
    """
    keep = _rising(t)
    wrong = np.flatnonzero(~keep)
    if slack > 0.0 and wrong.size:
        kept = np.flatnonzero(keep)
        at = np.searchsorted(kept, wrong)
        before = np.where(at > 0, t[kept[np.maximum(at - 1, 0)]], -np.inf)
        behind = np.where(at < kept.size, t[kept[np.minimum(at, kept.size - 1)]], np.inf)
        wrong = wrong[(t[wrong] < before - slack) | (t[wrong] > behind + slack)]
        keep = np.ones(t.size, bool)
        keep[wrong] = False
    first, last = t[keep].min(), t[keep].max()
    single = 0
    for run in np.split(wrong, np.flatnonzero(np.diff(wrong) > 1) + 1):
        if run.size and ((t[run] < first - JUMP) | (t[run] > last + JUMP)).all() and run.size > RUN:
            continue  # the other side of a clock that jumped
        if run.size > RUN:
            return None
        single += run.size
    if single > FEW * t.size or 2 * wrong.size > t.size:
        return None
    return ~keep


def _rising(t: np.ndarray) -> np.ndarray:
    """A longest part of ``t`` that never falls, as bool[n]; of equally long ones one whose first and last rows lie near
    the others.
    """
    keep, back = _longest(t), _longest(-t[::-1])[::-1]  # the first chooses well at the end, the second at the start
    alike = np.flatnonzero(keep & back & (np.cumsum(keep) == np.cumsum(back)))
    if alike.size:
        middle = alike[alike.size // 2]
        keep[:middle] = back[:middle]
    return keep


def _longest(t: np.ndarray) -> np.ndarray:
    """A longest part of ``t`` that never falls, as bool[n]: the one that ends lowest (patience sorting)."""
    tails: list[float] = []
    rows: list[int] = []
    before = np.empty(t.size, np.int64)
    for i, v in enumerate(t.tolist()):
        k = bisect_right(tails, v)
        before[i] = rows[k - 1] if k else -1
        if k == len(tails):
            tails.append(v)
            rows.append(i)
        else:
            tails[k], rows[k] = v, i
    keep = np.zeros(t.size, bool)
    i = rows[-1] if rows else -1
    while i >= 0:
        keep[i] = True
        i = int(before[i])
    return keep


def longest_part(times: list[np.ndarray]) -> tuple[float, float, str, str]:
    """First and last time of what can be kept of channels with these times (s, rising), a note on what was cut, and why
    nothing can be.

    Where the clock jumped forward (more than `JUMP` without a sample of any channel) only one side belongs to the run:
    the longer.
    """
    times = list({id(t): t for t in times}.values())  # channels of a table share one
    t = np.unique(np.concatenate(times)) if len(times) > 1 else times[0]
    first, last = float(t[0]), float(t[-1])
    if last - first <= JUMP:
        return first, last, "", ""
    step = max((float(np.median(np.diff(c))) for c in times if c.size > 1), default=0.0)
    at = np.flatnonzero(np.diff(t) > max(JUMP, 100.0 * step))
    if not at.size:
        return first, last, "", ""
    edges = np.concatenate([[0], at + 1, [t.size]])
    size = np.diff(edges)
    best = int(np.argmax(size))
    kept, lost = int(size[best]), int(t.size - size[best])
    a, b = float(t[edges[best]]), float(t[edges[best + 1] - 1])
    if kept < lost:
        jump = f"first from {t[at[0]]:.9g} s to {t[at[0] + 1]:.9g} s"
        return a, b, "", f"time jumps {at.size} times, {jump}; allowed: one jump, or a few wrong stamps"
    if lost <= RUN or (at.size > 1 and lost <= FEW * t.size):
        far = t[0] if best else t[-1]
        return a, b, f"time: {lost:,} of {t.size:,} stamps are far from all others ({far:.9g} s): left out", ""
    words = (
        f"time jumps from {t[at[0]]:.9g} s to {t[at[0] + 1]:.9g} s: only the longer part is kept, {kept:,} of "
        f"{t.size:,} stamps"
    )
    return a, b, words, ""


def unit_of_time(t: np.ndarray) -> str:
    """Unit in which a time must count that is too long in s: the one that puts its rows nearest to a row each 10 ms."""
    apart = np.diff(np.unique(t))
    if not apart.size:
        return "ms"
    step = float(np.median(apart))
    return min(CLOCKS, key=lambda unit: abs(np.log(step * CLOCKS[unit] / USUAL_STEP)))


def span_complaint(times: list[np.ndarray]) -> str:
    """Why channels with these times (s, rising) span more than their rows are worth; "" where they do not."""
    span = max(float(t[-1]) for t in times) - min(float(t[0]) for t in times)
    rows = max(t.size for t in times)
    most = min(LONGEST, max(2.0 * JUMP, SLOWEST * rows))
    if span <= most:
        return ""
    return (
        f"spans {span:,.6g} s with {rows:,} rows; allowed: up to {most:,.6g} s ({SLOWEST:g} s a row, {LONGEST:,.6g} s "
        f"in all)"
    )
