"""A log of the vanes on one raster: 10 ms, the ECU frame's period, or the log's own where that is slower; which rows
each subsystem has; where channels have gaps; and the conditions under which a stage may fail.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
import scipy

from hil.figures import noise_floor, resolution
from hil.logs import Channel, Log, LogError
from hil.logs.held import COMMANDS, FEW, answers, held, taken
from vaneloop.base.compiled import compiled
from vaneloop.base.sizes import no_smaller
from vaneloop.base.vanes import VANES
from vaneloop.identification.regimes import steady
from vaneloop.identification.settings import CONDITION_BAND, EXPLAINED, RASTER, WINDOW
from vaneloop.identification.subsystem import Array, Stage

__all__ = [
    "DEMANDS",
    "OF_SIDES",
    "OF_SUBSYSTEM",
    "Gaps",
    "Grid",
    "OfSubsystem",
    "every_other",
    "expect_draws",
    "first_row",
    "grid_of",
    "last_digit",
    "lately",
    "no_gap_in_window",
    "on_raster",
    "pieces_of",
    "regimes_of",
    "rms",
    "since",
    "stretches",
]


CONDITIONS = ("x_lvdt", "n_r", "t_oil", "p_s", "i_cmd")
DEMANDS = ("n_dem", "x_dem")  # no sensor reads them
ROUNDED = (*DEMANDS, "n_r", "x_lvdt")  # drive a subsystem: what their last digit hides is an error of what they drive


class OfSubsystem(NamedTuple):
    """Channels of a subsystem: it cannot do without ``needs``, is driven by ``takes`` where they are logged, and
    explains ``gives``, or some of them.
    """

    needs: tuple[str, ...]
    takes: tuple[str, ...]
    gives: tuple[str, ...]


OF_SUBSYSTEM = {
    "demand": OfSubsystem(("n_dem", "n_r"), (), ("x_dem",)),
    "servo": OfSubsystem(("x_dem", "x_lvdt"), (), ("i_cmd",)),
    "engine": OfSubsystem(("n_dem",), (), ("n_r",)),
    "actuator": OfSubsystem(("i_cmd",), ("n_r", "p_s", "t_oil"), ("x_lvdt",)),
    "linkage": OfSubsystem(("x_lvdt",), ("n_r", "t_oil"), VANES),
}
OF_SIDES = {  # of two actuators, in place of the one; the rings bring the other's stroke to each
    "actuator_a": OfSubsystem(("i_cmd", "x_lvdt_b"), ("n_r", "p_s", "t_oil"), ("x_lvdt_a",)),
    "actuator_b": OfSubsystem(("i_cmd", "x_lvdt_a"), ("n_r", "p_s", "t_oil"), ("x_lvdt_b",)),
}


class Grid(NamedTuple):
    """The raster of a log: from where the first of its subsystems is known to where the last is.

    start, dt, rows  s of the log's own time, s, number of rows
    steps            usual time between two samples of each channel, s
    known            first row that each channel, or subsystem, has, and the row behind its last; those that have all
                     may be left out
    digits           step of the last digit of each of `ROUNDED` as filed: what is worked out of it, such as rows
                     between samples, has been rounded as well
    """

    start: float
    dt: float
    rows: int
    steps: Mapping[str, float]
    known: Mapping[str, tuple[int, int]] = MappingProxyType({})
    digits: Mapping[str, float] = MappingProxyType({})

    def rows_of(self, name: str) -> tuple[int, int]:
        """First row of a channel or a subsystem, and the row behind its last."""
        return self.known.get(name, (0, self.rows))

    def pieces_of(self, subsystem: str, pieces: Sequence[tuple[int, int]] = ()) -> tuple[tuple[int, int], ...] | None:
        """These pieces of rows, as `on_raster` takes them, as far as a subsystem has them; None: it has none."""
        low, high = self.rows_of(subsystem)
        if (low, high) == (0, self.rows):
            return tuple(pieces)
        cut = ((max(first, low), min(behind, high)) for first, behind in pieces or [(0, self.rows)])
        return tuple((first, behind) for first, behind in cut if first < behind) or None

    @property
    def window(self) -> int:
        """Rows of a window of the stages that integrate."""
        return max(1, round(WINDOW / self.dt))


def grid_of(log: Log) -> Grid:
    """The raster of a log. What begins within a window of the first subsystem begins with it, and ends likewise; what
    begins later does so in whole windows.
    """
    channels = log.channels
    times = {id(c.t): c.t for c in channels.values()}  # channels of a table share one
    usually = {i: float(np.median(np.diff(t))) if len(t) > 1 else np.inf for i, t in times.items()}
    steps = {name: usually[id(c.t)] for name, c in channels.items()}
    many = {name: (float(c.t[0]), float(c.t[-1])) for name, c in channels.items() if len(c.t) > FEW}
    if not many:
        raise LogError(f"{log.path}: no channel has more than {FEW} samples")
    dt = max(RASTER, round(float(np.median([steps[name] for name in many])) / RASTER) * RASTER)
    spans = {}
    for name, of in (OF_SUBSYSTEM | OF_SIDES).items():
        gives = [many[c] for c in of.gives if c in many]
        if gives and all(c in channels for c in of.needs):
            own = [many[c] for c in (*of.needs, *of.takes, "state") if c in many]
            own.append((min(s[0] for s in gives), max(s[1] for s in gives)))
            spans[name] = max(s[0] for s in own), min(s[1] for s in own)
    first = min(s[0] for s in (spans or many).values())
    last = max(s[1] for s in (spans or many).values())
    start = max(s[0] for s in many.values() if s[0] < first + WINDOW)
    end = min(s[1] for s in many.values() if s[1] > last - WINDOW)
    start += _to_frame(channels, steps, start, dt)
    rows = max(1, int((end - start) / dt + 1e-6) + 1)
    window = max(1, round(WINDOW / dt))

    def known(low: float, high: float) -> tuple[int, int]:
        late, early = low >= first + WINDOW, high <= last - WINDOW
        begin = -int(-((low - start) / dt - 1e-6) // window) * window if late else 0
        return min(begin, rows), max(min(int((high - start) / dt + 1e-6) + 1, rows), 0) if early else rows

    of_each = {name: known(*s) for name, s in (many | spans).items()}
    digits = {name: resolution(channels[name].values) for name in ROUNDED if name in channels}
    return Grid(start, dt, rows, steps, {name: s for name, s in of_each.items() if s != (0, rows)}, digits)


class Gaps(NamedTuple):
    """Rows at which channels have no sample near, each bool[rows].

    border  rows at the border of two pieces of a log: none has one there
    far     channel -> rows far from its samples
    lost    channel -> rows at which a sample of its own is missing
    """

    border: Array
    far: Mapping[str, Array]
    lost: Mapping[str, Array]

    def fresh(self, names: Iterable[str]) -> tuple[Array, Array]:
        """At which rows all of these channels are known, and at which one of them misses a sample.

        Rows at the end of a gap, filled from one side alone, are in the gap.
        """
        far, lost = self.border, np.zeros(len(self.border), dtype=bool)
        for name in names:
            if name in self.far:
                far, lost = far | self.far[name], lost | self.lost[name]
        return ~scipy.ndimage.binary_propagation(far, mask=far | lost), lost


def on_raster(
    log: Log, grid: Grid, pieces: Sequence[tuple[int, int]] = ()
) -> tuple[Array, dict[str, Array], Gaps, list[str]]:
    """All channels on one uniform raster; where they have gaps; notes.

    pieces  (first row, row behind the last), ascending, in whole windows: only these rows of a long log, each piece as
            behind a gap; all on the raster of the whole log. Default: all rows

    Where commands came in frames, a row is a tick of the controller: what it sent then, with the commands that it had.
    """
    if not pieces:
        t = np.arange(grid.rows) * grid.dt
        columns, far, lost = _columns(log.channels, grid, t)
        return t, columns, Gaps(np.zeros(len(t), dtype=bool), far, lost), list(log.notes)
    parts = []
    for first, behind in pieces:
        t = np.arange(first, behind) * grid.dt
        low, high = (grid.start + k * grid.dt for k in (first - grid.window, behind + grid.window))
        parts.append((t, *_columns({k: _between(c, low, high) for k, c in log.channels.items()}, grid, t)))
    times, columns_of, far_of, lost_of = zip(*parts, strict=True)
    borders = [np.zeros(len(t), dtype=bool) for t in times]
    for before, after in itertools.pairwise(borders):  # a smoothing filter, or a spline, looks across the border
        before[-1] = after[0] = True
    joined = {name: np.concatenate([c[name] for c in columns_of]) for name in log.channels}

    def whole(rows: Sequence[Mapping[str, Array]]) -> dict[str, Array]:
        none = [np.zeros(len(t), dtype=bool) for t in times]
        names = dict.fromkeys(name for of in rows for name in of)
        return {n: np.concatenate([of.get(n, z) for of, z in zip(rows, none, strict=True)]) for n in names}

    return np.concatenate(times), joined, Gaps(np.concatenate(borders), whole(far_of), whole(lost_of)), list(log.notes)


def _between(c: Channel, low: float, high: float) -> Channel:
    """The samples between two times, and the next one on either side."""
    use = slice(max(int(np.searchsorted(c.t, low)) - 1, 0), int(np.searchsorted(c.t, high)) + 1)
    return Channel(c.t[use], c.values[use], c.framed)


def first_row(channels: Mapping[str, Channel], grid: Grid) -> float:
    """Time of row 0 in the log's own time, s: rows stand where the samples of the controller do."""
    reference = answers(channels) or max((c for c in channels.values()), key=lambda c: len(c.t))
    own = float(np.median(np.diff(reference.t)))
    own = grid.dt if abs(own - grid.dt) < 0.02 * grid.dt else own  # a jitter's median would add up over the log
    if own < 0.5 * grid.dt:
        return grid.start
    return grid.start + float(np.median((reference.t - grid.start + 0.5 * own) % own) - 0.5 * own)


def _columns(
    channels: Mapping[str, Channel], grid: Grid, t: Array
) -> tuple[dict[str, Array], dict[str, Array], dict[str, Array]]:
    """`on_raster` at rows ``t`` (s from its start): channels, and of those with gaps what `Gaps` says of them."""
    dt, when = grid.dt, t + first_row(channels, grid)
    had = taken(channels, when, 0.5 * dt)
    columns, far, missing = {}, dict[str, Array](), dict[str, Array]()
    row = np.rint(t / dt)
    for name, c in channels.items():
        if len(c.t) < 2:
            columns[name] = np.full(len(t), c.values[0] if len(c.t) else np.nan)
            continue
        step = grid.steps[name]
        if name in COMMANDS and c.framed:
            i = held(c, had)
            columns[name], age = c.values[i], had - c.t[i]
            lost = np.append(np.diff(c.t), step) > 1.5 * max(step, dt)
            # two frames are bridged, as two rows are below
            gone, lacks = age >= 3.0 * max(step, dt), lost[i] & (age > 0.75 * step)
            if gone.any() or lacks.any():
                far[name], missing[name] = gone, lacks
            continue
        partly = np.zeros(len(t), dtype=bool)
        uniform = float(np.mean(np.abs(np.diff(c.t) - step) < 0.3 * step)) > 0.98
        if name == "i_cmd" and step < 0.6 * dt:
            total = np.concatenate([[0.0], np.cumsum(c.values)])
            edge = np.searchsorted(c.t, np.concatenate([[when[0] - dt], when]) + 0.5 * step)
            count = np.diff(edge)
            columns[name] = np.diff(total[edge]) / np.maximum(count, 1)
            partly = count < 0.75 * dt / step  # some of its samples are missing: straight lines between those there
            between = when[partly, None] - dt * np.arange(10) / 10.0
            columns[name][partly] = np.interp(between, c.t, c.values).mean(axis=1)
        elif (
            uniform and abs(step - dt) < 0.02 * dt and not _between_rows(c, when, dt)
            or name in (*DEMANDS, "state") or _held(c, step, dt)
        ):  # fmt: skip
            # rows of a regular logger: the nearest row, whatever its clock's jitter; commands and what comes in frames
            # hold their value
            i = np.clip(np.searchsorted(c.t, when + 0.5 * step) - 1, 0, len(c.t) - 1)
            columns[name] = c.values[i]
        else:
            columns[name] = np.interp(when + (_settled(c, when, step, dt) if uniform else 0.0), c.t, c.values)
        i = np.clip(np.searchsorted(c.t, when), 1, len(c.t) - 1)
        away = np.minimum(np.abs(c.t[i] - when), np.abs(when - c.t[i - 1]))
        if name in grid.known:  # a gap is between samples; before the first and after the last there is none
            low, behind = grid.rows_of(name)
            away[(row < low) | (row >= behind)] = 0.0
        # one or two rows are bridged, more are a gap; those bridged are not the channel's own
        gone, lacks = away >= 1.5 * max(step, dt), partly | (away > 0.75 * (step if uniform else max(step, dt)))
        if lacks.any():
            far[name], missing[name] = gone, lacks
            if name in DEMANDS:
                columns[name] = np.where(lacks, np.interp(when, c.t, c.values), columns[name])
    return {name: no_smaller(v) for name, v in columns.items()}, far, missing


def _between_rows(c: Channel, when: Array, dt: float) -> bool:
    """Whether the channel's samples stand between the rows, as those of another clock do, and not only jitter."""
    i = np.clip(np.searchsorted(c.t, when - 0.5 * dt), 0, len(c.t) - 1)
    apart = (c.t[i] - when)[np.abs(c.t[i] - when) <= 0.5 * dt]
    turn = np.exp(2j * np.pi * apart / dt).mean() if len(apart) else 1.0
    return bool(abs(np.angle(turn)) / (2.0 * np.pi) > 0.1 or abs(turn) < 0.5)


def _held(c: Channel, step: float, dt: float) -> bool:
    """Whether the channel is logged faster than the raster and yet holds its value for rows: it came in frames."""
    return bool(step < 0.6 * dt and np.count_nonzero(np.diff(c.values)) < 0.3 * len(c.t))


def _settled(c: Channel, when: Array, step: float, dt: float) -> float:
    """Seconds behind the rows ``when`` at which a channel shows what it had there, where it comes in frames and a
    low-pass, or a mean, makes slopes of their steps: on a slope a row is partly the frame before, and its noise, too.
    """
    many = round(dt / step)
    if many < 3 or len(when) < 2:
        return 0.0
    place = np.rint((c.t[1:] - when[0]) / step).astype(int) % many  # of the sample that a change ends at
    usual = np.diff(c.t) < 1.5 * step
    change = np.bincount(place[usual], np.diff(c.values)[usual] ** 2, many) / np.maximum(
        np.bincount(place[usual], minlength=many), 1
    )
    moves = change >= EXPLAINED * change.mean()
    if moves.all():
        return 0.0
    settles = int(np.argmin(moves))  # after the row; and there it stays until the next frame
    return (settles + int(np.argmax(moves[settles:])) - 1 if moves[settles:].any() else many - 1) * step


def _to_frame(channels: Mapping[str, Channel], steps: Mapping[str, float], start: float, dt: float) -> float:
    """Return the time from ``start`` to the controller's next frame, as the commands in a log faster than the frames
    show it; else 0.
    """
    for name in ("x_dem", "n_dem"):
        if name in channels and _held(channels[name], steps[name], dt):
            c = channels[name]
            turn = np.exp(2j * np.pi * (c.t[1:][np.diff(c.values) != 0.0] - start) / dt)
            if len(turn) > 20 and abs(turn.mean()) > 0.5:
                return float(np.angle(turn.mean()) / (2.0 * np.pi) % 1.0 * dt)
    return 0.0


def every_other(columns: dict[str, Array], current: Array | None = None) -> dict[str, Array]:
    """Every other row; of the current, which is a mean since the row before, the mean of two, or ``current``."""
    out = {k: v[::2] for k, v in columns.items()}
    if current is not None:
        out["i_cmd"] = current
    elif "i_cmd" in columns:
        i = columns["i_cmd"]
        out["i_cmd"] = np.concatenate([i[:1], 0.5 * (i[1:-1:2] + i[2::2])])
    return out


def last_digit(values: Array, step: float) -> Callable[[np.random.Generator], Array]:
    """Function that draws the rounding error of a channel's last digit, a ``step``, which changes where the reading
    does.
    """
    reading = np.cumsum(np.diff(values, prepend=values[:1]) != 0.0)
    return lambda draw: np.asarray(step * draw.uniform(-0.5, 0.5, reading[-1] + 1)[reading])


def rms(stage: Stage, difference: Array) -> Array:
    """RMS of a difference of outputs where the stage counts them, its windows' constants free: float64[outputs]."""
    e = np.where(np.isfinite(stage.measured), difference, np.nan)
    if stage.window:
        w = int(round(stage.window / (stage.t[1] - stage.t[0])))
        e = e[:, : e.shape[1] // w * w].reshape(len(e), -1, w)
        mean = np.nansum(e, axis=2, keepdims=True) / np.maximum(np.isfinite(e).sum(axis=2, keepdims=True), 1)
        e = (e - mean).reshape(len(e), -1)
    return np.asarray(np.sqrt(np.nansum(e**2, axis=1) / np.maximum(np.isfinite(e).sum(axis=1), 1)))


def expect_draws(stage: Stage, draws: Array) -> None:
    """Have a stage expect errors such as these ``draws``, float64[draws, outputs, samples]: what of them stands so long
    that it is not seen as noise of the stage's error counts as the raster's.
    """
    counts = np.where(np.isfinite(stage.measured), 1.0, np.nan)
    shown = [[noise_floor(stage.t, output) for output in one * counts] for one in draws]
    stands = np.mean([rms(stage, one) ** 2 for one in draws], axis=0) - np.mean(np.square(shown), axis=0)
    stage.lost, stage.raster_error = draws, np.sqrt(np.maximum(stands, 0.0))


def stretches(good: Array) -> Array:
    """Number of the stretch of good rows that each row belongs to, from 0; a row that is not good belongs to the
    stretch before it.
    """
    begins = good & ~np.concatenate([[False], good[:-1]])
    begins[0] = False
    return np.cumsum(begins)


def since(t: Array, stretch: Array) -> Array:
    """Time since the first row of each row's stretch, s."""
    return np.asarray(t - t[np.searchsorted(stretch, stretch)])


def pieces_of(stretch: Array) -> list[slice]:
    """Rows of each stretch."""
    edges = [0, *(np.flatnonzero(np.diff(stretch)) + 1).tolist(), len(stretch)]
    return [slice(a, b) for a, b in itertools.pairwise(edges)]


def no_gap_in_window(t: Array, fresh: Array) -> Array:
    """Rows of windows that have only good rows."""
    w = (t / WINDOW).astype(int)
    bad = np.unique(w[~fresh])
    return ~np.isin(w, bad)


def lately(rows: Array, seconds: float, dt: float = RASTER) -> Array:
    """Whether any of these rows, ``dt`` (s) apart, was less than some seconds ago."""
    n = np.arange(len(rows))
    return np.asarray(n - np.maximum.accumulate(np.where(rows, n, -np.inf)) < seconds / dt)


def regimes_of(t: Array, columns: dict[str, Array], gaps: Gaps) -> tuple[dict[str, Array], dict[str, str]]:
    """Conditions under which a stage may fail, each without its sensor's noise (`steady`); NaN in the gaps of their
    channels.
    """

    def known(name: str, values: Array) -> Array:
        return np.where(gaps.fresh([name])[0], values, np.nan) if name in gaps.far else values

    columns = {c: steady(v, CONDITION_BAND * noise_floor(t, v)) for c, v in columns.items() if c in CONDITIONS}
    out: dict[str, Array] = {"time": t}
    units = {"time": "s"}
    dt = t[1] - t[0]
    if "x_lvdt" in columns:
        x = columns["x_lvdt"]
        k = max(3, int(round(0.1 / dt)))
        smooth = np.convolve(np.pad(x, k, mode="edge"), np.ones(2 * k + 1) / (2 * k + 1), mode="valid")
        v = np.gradient(smooth, dt)
        out |= {"stroke": x, "stroke speed": v, "direction": np.sign(np.where(np.abs(v) > 0.2, v, 0.0))}
        units |= {"stroke": "mm", "stroke speed": "mm/s", "direction": ""}
        out["distance since reversal"], units["distance since reversal"] = _since_reversal(smooth, v), "mm"
        out = {name: v if name == "time" else known("x_lvdt", v) for name, v in out.items()}
    for name, label, unit in (
        ("n_r", "rotor speed", "%"),
        ("t_oil", "oil temperature", "degC"),
        ("p_s", "supply pressure", "MPa"),
    ):
        if name in columns:
            out[label], units[label] = known(name, columns[name]), unit
    if "i_cmd" in columns:
        out["current"], units["current"] = known("i_cmd", columns["i_cmd"]), "mA"
    return out, units


@compiled
def _since_reversal(x: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Way since the stroke ``x`` (mm) turned, mm; ``v``: its speed, which below 0.2 mm/s turns nothing."""
    out = np.zeros(len(x))
    last, sign = x[0], 0.0
    for i in range(1, len(x)):
        if abs(v[i]) > 0.2 and np.sign(v[i]) != sign:
            sign, last = np.sign(v[i]), x[i]
        out[i] = abs(x[i] - last)
    return out
