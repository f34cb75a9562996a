"""Measured runs: read any log into channels in the product's names and units, write channels into any log.

A log is a file of any format of `hil.logs.formats`. Whatever it is, it ends as a `Log`: per signal the times, strictly
increasing, in seconds from the start, and the values, finite, in the unit of docs/architecture.md. Each channel keeps
its own raster; nothing is interpolated and gaps stay gaps. What cannot be used raises `LogError`, one line; what had to
be left out is said in `Log.notes`. docs/logs.md is the user's page.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hil.logs import plausible
from hil.logs.channels import Channels
from hil.logs.dataframe import frame_columns, is_frame, name_of, open_frame
from hil.logs.formats import format_at, format_of
from hil.logs.guess import Files, Guess
from hil.logs.joined import joined, seems_joined
from hil.logs.notes import MOST_ROWS, Note
from hil.logs.opening import Opened, is_ours, open_log, sketch, wanted_design_speed
from hil.logs.scale import proposed_scale
from hil.logs.source import ABSENT, Channel, LogError, Options, Series, Source, close_names, find, is_absent
from hil.logs.stale import stale_rows
from hil.logs.table import ROW, NoTime, split_unit
from hil.logs.units import UnitError, Units
from vaneloop.base.errors import meant
from vaneloop.base.signals import UNITS

if TYPE_CHECKING:
    from pandas import DataFrame

__all__ = ["Channel", "Log", "LogError", "offered", "read_log", "write_log"]

_A_NAME = re.compile(r"[^\W\d]\w*")
_A_UNIT = re.compile(r"[^\t\r\n,;\"\[\]]{1,32}")
_EPOCH = 1e8  # s; a table whose time starts three years in counts from 1970, not from the start of the log


@dataclass(frozen=True, repr=False)
class Log(Channels):
    """A measured run. It is used as a frame of pandas is (`Channels`), and every analysis takes it.

    Raises LogError where a channel of the product's signals cannot be in its unit, or where the time spans more than
    the rows are worth (`hil.logs.plausible`): no command gets such a log, whoever made it.

    Attributes
    ----------
    path : str
        The file it was read from, or a name.
    channels : dict
        Each `Channel` by its name; every channel has a time of its own.
    notes : list
        What was left out or assumed on reading, in words.
    signals : Mapping
        Unit of each signal that the log may have.
    guesses : tuple
        Which of its names and units are guesses; each has its note, too.
    ordered : bool
        Its rows stand in the order of time; not so in a table without one, whose time only counts them.

    Examples
    --------
    >>> import vaneloop
    >>> log = vaneloop.read_log("examples/hidden_effect.parquet")
    >>> log["x_lvdt"]
    Channel(20,000 samples, 0 to 199.99 s, 1.874 to 44.98 mm)
    >>> log[10:20][["x_lvdt", "i_cmd"]]
    Log('hidden_effect.parquet', 1,000 rows, 10 to 19.99 s: x_lvdt [mm], i_cmd [mA])
    >>> len(log), "p_s" in log, log.units["p_s"]
    (20000, True, 'MPa')
    """

    notes: list[str] = field(default_factory=list)
    signals: Mapping[str, str] = field(default_factory=lambda: UNITS, repr=False)
    guesses: tuple[Guess, ...] = ()
    ordered: bool = True

    def __post_init__(self) -> None:
        wrong = []
        for name, c in self.channels.items():
            if is_ours(name, self.signals) and (why := plausible.judge(name, c.values)[1]):
                wrong.append((name, name, why, c.values))
        _refuse_units(self.path, wrong)
        times = [c.t for c in self.channels.values() if c.t.size]
        if times and (why := plausible.span_complaint(times)):
            unit = plausible.unit_of_time(max(times, key=len))
            raise LogError(f"{self.path}: {why}; --unit t={unit}, if time counts in {unit}")
        own = {name: c if c.unit else replace(c, unit=self.signals.get(name, "")) for name, c in self.channels.items()}
        object.__setattr__(self, "channels", own)

    def _unit_of(self, name: str) -> str:
        return self.signals.get(name, "")

    @classmethod
    def from_dataframe(
        cls,
        frame: DataFrame,
        *,
        units: Mapping[str, str] | None = None,
        mapping: Mapping[str, str] | None = None,
        design_rpm: float | None = None,
        name: str = "",
    ) -> Log:
        """Take a ``pandas.DataFrame`` as it is: every column of numbers is a channel, and nothing is guessed.

        `read_log` takes a frame as it takes a file, and guesses which column is which signal of the vane machine.

        Parameters
        ----------
        frame : pandas.DataFrame
            Its time is the index, or a column called ``t``, ``time`` or the like; dates and durations become s. NaN is
            no sample. What ``attrs["units"]`` says of a column is its unit.
        units : Mapping, optional
            Column (or signal) -> unit, such as ``{"x_lvdt": "um"}``; goes before what the frame says. A signal of the
            product is brought to its own unit, any other keeps what is stated.
        mapping : Mapping, optional
            Column -> name that it gets.
        design_rpm : float, optional
            Design speed, rpm; needed where a rotor speed is not in %.
        name : str, optional
            What messages call the log; default: ``attrs["name"]``.

        Returns
        -------
        Log

        Raises
        ------
        LogError
            One line, for a frame without a time, or with values that no sensor can give.

        Examples
        --------
        >>> import pandas as pd
        >>> from vaneloop import Log
        >>> frame = pd.DataFrame({"t": [0.0, 0.1, 0.2], "x_lvdt": [20e3, 20.5e3, 21e3], "pump": [1.0, 1.1, 1.2]})
        >>> log = Log.from_dataframe(frame, units={"x_lvdt": "um", "pump": "V"}, name="bench")
        >>> log
        Log('bench', 3 rows, 0 to 0.2 s: x_lvdt [mm], pump [V])
        >>> log["x_lvdt"].values.tolist()
        [20.0, 20.5, 21.0]
        """
        if not is_frame(frame):
            raise LogError(f"from_dataframe: {type(frame).__name__} is given; allowed: a pandas.DataFrame")
        names, given, signals = dict(mapping or {}), dict(units or {}), dict[str, str]()
        said = name or name_of(frame)
        for column, unit in frame_columns(frame).items():
            signal = names.get(column, split_unit(column)[0])
            own = given.pop(column, "") or given.get(signal) or unit
            signals[signal] = UNITS.get(signal, own)
            if own:
                given[signal] = own
        signals.pop("t", None)
        if odd := next((k for k in given if k not in signals and k != "t"), None):
            raise LogError(f"{said}: unit of {odd!r}: is no column of numbers{meant(odd, signals)}")
        if odd := next((k for k, v in names.items() if v not in signals and v != "t"), None):
            raise LogError(f"{said}: mapping of {odd!r}: is no column of numbers{meant(odd, signals)}")
        return read_log(
            frame, mapping=names, units=given, design_rpm=design_rpm, require=(), signals=signals, guess=False,
            name=name,
        )  # fmt: skip


def _refuse_units(path: str | Path, wrong: list[tuple[str, str, str, np.ndarray]]) -> None:
    """Raise LogError if there is a channel (signal, name in the log, why, values) that cannot be in its unit."""
    if wrong:
        signal, key, why, values = wrong[0]
        also = "; the same for " + ", ".join(w[0] for w in wrong[1:]) if len(wrong) > 1 else ""
        raise LogError(f"{path}: {signal} ({key}): {why}; {plausible.proposed(signal, values)}{also}")


# --- reading ----------------------------------------------------------------------------------------------------------


def _take(
    path: Path, source: Source, signal: str, name: str, mapped: bool, needed: bool, notes: list[str]
) -> tuple[str, Series] | None:
    """Key and samples of a signal; None where the file does not offer it. Refuses a name that the user gave in vain."""
    keys = find(source, name, mapped)
    if not keys:
        if not mapped:
            return None
        reason = source.absent(name)
        close = (
            f" ({reason})" if reason else close_names(name, {a for aliases in source.names.values() for a in aliases})
        )
        raise LogError(f"{path}: no {source.kind} {name!r} to map to {signal}{close}{source.has()}")
    series = {k: source.series(k) for k in keys}
    if len(keys) == 1:
        return keys[0], series[keys[0]]
    # databases repeat a name in messages that never carry it: the only one that moves is meant
    moving = [k for k in keys if series[k].values.size and np.ptp(series[k].values) > 0]
    if len(moving) == 1:
        notes.append(f"{signal}: took {moving[0]}; {', '.join(k for k in keys if k != moving[0])} never changes")
        return moving[0], series[moving[0]]
    if mapped or needed:
        raise LogError(f"{path}: {signal} may be {' or '.join(keys[:6])}; name one: --map {keys[0]}={signal}")
    notes.append(f"{signal}: may be {' or '.join(keys[:6])}: left out (--map {keys[0]}={signal} takes one)")
    return None


def _in_time(s: Series, t: np.ndarray, known: dict[int, np.ndarray], notes: list[str]) -> np.ndarray:
    """The times ``t`` (s) of a series; rows whose stamp is wrong have none. ``known``: what was found before, by the
    array of the file.
    """
    if id(s.t) not in known:
        rows = np.flatnonzero(np.isfinite(t))
        bad = None
        if rows.size and (np.diff(t[rows]) < 0).any():
            bad = plausible.out_of_order(t[rows])
        known[id(s.t)] = rows[bad] if bad is not None else rows[:0]
        if known[id(s.t)].size:
            first = int(known[id(s.t)][0])
            what = f"{known[id(s.t)].size:,} of {rows.size:,} {s.word}s"
            where = f"first {s.word} {first + s.first}: {t[first]:.9g} s"
            said = f"time: {what} have a wrong time stamp ({where}): left out"
            notes.append(Note(said, "left out", "time", known[id(s.t)].size, known[id(s.t)][:MOST_ROWS] + s.first))
    bad = known[id(s.t)]
    if not bad.size:
        return t
    there = np.isfinite(s.values)
    if 2 * np.count_nonzero(there[bad]) > np.count_nonzero(there):  # a channel that has a block of rows of its own
        return t
    t = t.copy()
    t[bad] = ABSENT
    return t


def _rises(t: np.ndarray) -> bool:
    """Whether all times are finite and strictly increasing."""
    return bool(np.isfinite(t).all() and (t[1:] > t[:-1]).all())


def _clean(
    path: Path, signal: str, key: str, s: Series, in_order: bool, rises: bool, notes: list[str]
) -> Channel | None:
    """Samples that can be used: both numbers finite, time strictly increasing; None where nothing is left.

    rises  the times are known to be finite and strictly increasing
    """
    t, values = s.t, s.values
    finite = np.isfinite(values) if rises else np.isfinite(t) & np.isfinite(values)
    if not finite.all():
        lost = int(np.count_nonzero(~finite & ~(is_absent(values) | is_absent(t))))
        if lost:
            rows = np.flatnonzero(~finite & ~(is_absent(values) | is_absent(t))) + s.first
            said = f"{signal} ({key}): {lost} of {t.size} samples are NaN or infinite: left out"
            notes.append(Note(said, "left out", signal, lost, rows))
        t, values = t[finite], values[finite]
    if not in_order and not rises and t.size:
        back = np.flatnonzero(np.diff(t) < 0)
        if back.size:
            row, (a, b) = np.flatnonzero(finite)[back[0] + 1] + s.first, t[back[0] : back[0] + 2]
            raise LogError(
                f"{path}: {signal} ({key}): time runs backwards at {s.word} {row}, from {a:.9g} s to {b:.9g} s"
            )
    if t.size and not rises:
        last = np.append(np.diff(t) > 0, True)
        changed = np.count_nonzero(np.diff(values)[~last[:-1]])
        if 2 * changed > t.size:  # not a few samples: the clock does not tell them apart
            raise LogError(
                f"{path}: {signal} ({key}): {int(np.count_nonzero(~last)):,} of {t.size:,} samples have the time of "
                f"the next: the times need more digits, or --map NAME=t names another time"
            )
        if not last.all():
            twice = np.flatnonzero(finite)[~last] + s.first
            said = f"{signal} ({key}): {twice.size} of {t.size} samples have the time of the next: left out"
            notes.append(Note(said, "left out", signal, twice.size, twice[:MOST_ROWS]))
            t, values = t[last], values[last]
    if not t.size:
        if s.t.size:
            notes.append(f"{signal} ({key}): no sample that can be used")
        return None
    return Channel(np.ascontiguousarray(t, np.float64), np.ascontiguousarray(values, np.float64), s.framed)


def read_log(
    path: str | Path | DataFrame,
    *,
    dbc: str | Path | None = None,
    mapping: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    design_rpm: float | None = None,
    require: Iterable[str] | None = None,
    signals: Mapping[str, str] = UNITS,
    guess: bool = True,
    mapping_file: str | Path | None = None,
    tables: Files | None = None,
    part: int = 0,
    name: str = "",
    rows: bool = False,
) -> Log:
    """Read a log of any format, or a ``pandas.DataFrame``, into channels with the product's names and units.

    Parameters
    ----------
    path : str, Path or pandas.DataFrame
        The file; its suffix says the format. A frame is read as a table is; its time is the index, or a column.
    dbc : str or Path, optional
        Database of a CAN log; default: tables/vgv.dbc.
    mapping : Mapping, optional
        Name in the log -> signal, ``{"N1_DEM": "n_dem"}``; a CAN name may be MESSAGE.SIGNAL, an MDF name GROUP.CHANNEL.
    units : Mapping, optional
        Signal -> unit that the log uses for it, ``{"n_r": "rpm"}``; goes before a unit in the file.
    design_rpm : float, optional
        Design speed, rpm; needed where a rotor speed is not in %.
    require : iterable of str, optional
        Signals without which the log is of no use; each needs two samples. Default: ``n_dem``, where it is one of
        ``signals``.
    signals : Mapping, optional
        Name -> unit of all signals to look for; default: the product's.
    guess : bool, optional
        Guess names and units that nobody states (`hil.logs.guess`), each with a note; not with a mapping file.
    mapping_file : str or Path, optional
        Names, units, design speed and database of a bench (`hil.logs.mapping`); what is given beside it goes before.
    tables : Mapping, optional
        The machine's own tables, against whose schedule guesses are held: name without suffix -> file; default: the
        shipped ones.
    part : int, optional
        Which run of a table in which the header stands again, from 1; 0: all where time goes on, else the longest.
    name : str, optional
        What messages call a frame; default: its ``attrs["name"]``.
    rows : bool, optional
        Take a table without a time column, too: its rows stand in no order (`Log.ordered`).

    Returns
    -------
    Log

    Raises
    ------
    LogError
        One line, for whatever cannot be used.

    Examples
    --------
    >>> import vaneloop
    >>> log = vaneloop.read_log("examples/hidden_effect.parquet")
    >>> frame = log.to_pandas()
    >>> frame["x_lvdt"].iloc[:3].round(2).tolist()
    [27.12, 27.12, 27.1]
    >>> vaneloop.read_log(frame).columns == log.columns
    True
    """
    opened = partial(open_frame, path) if is_frame(path) else None
    path = Path(name or name_of(path)) if is_frame(path) else Path(path)
    require = tuple(r for r in ("n_dem",) if r in signals) if require is None else tuple(require)
    for what, given in (("unit of", dict(units or {})), ("required", dict.fromkeys(require))):
        for signal in given:
            if signal not in signals and signal != "t":
                raise LogError(
                    f"{path}: {what} {signal!r}: is not a signal{close_names(signal, signals)}; allowed: "
                    f"{', '.join(signals)}, t"
                )
    if design_rpm is not None and not (math.isfinite(design_rpm) and design_rpm > 0):
        raise LogError(f"{path}: design speed (={design_rpm:g} rpm) must be finite and above 0")

    log = open_log(
        path, dbc, mapping, units, design_rpm, signals, guess, mapping_file, tables or {}, part, opened, rows
    )
    source, named, notes, units = log.source, log.named, log.notes, log.units
    if log.guesses.rpm:
        speed, _, words = wanted_design_speed(path, log)
        if not log.taken or set(log.guesses.rpm) & set(require):
            raise LogError(f"{path}: {speed}: {words}")
        notes.append(f"{speed}: {words}")
    unit = Units(path, units, log.design_rpm, notes, signals)
    channels: dict[str, Channel] = {}
    keys: dict[str, str] = {}
    wrong: list[tuple[str, str, str, np.ndarray]] = []
    known: dict[int, np.ndarray] = {}
    # channels of a table share its time: that of the file, which lives as long as its id counts, in s, whether it rises
    times: dict[tuple[int, str], tuple[np.ndarray, np.ndarray, bool]] = {}
    for signal in signals:
        name = named.get(signal, signal)
        said = len(source.notes), len(notes)
        try:
            taken = _take(path, source, signal, name, signal in named, signal in require, notes)
        except LogError as e:
            whole = str(e) if str(e).startswith(str(path)) else f"{path}: {e}"
            raise LogError("; ".join(filter(None, (whole, log.unused)))) from None
        if taken is not None:
            key, s = taken
            with np.errstate(all="ignore"):  # what overflows is not finite and left out below
                if (id(s.t), s.t_unit) not in times:
                    seconds = _in_seconds(path, unit, s)
                    times[id(s.t), s.t_unit] = s.t, seconds, _rises(seconds)
                _, t, rises = times[id(s.t), s.t_unit]
                try:
                    values = unit.convert(signal, key, s.values, s.unit)
                except UnitError as e:
                    raise LogError(f"{e}{_scale(path, log, signal, t, s.values)}") from None
                if signal in unit.unknown and (found := _scale(path, log, signal, t, s.values)):
                    what = f"unit {unit.unknown[signal]!r} is not known, and it is not {signals[signal]}"
                    raise LogError(f"{path}: {signal} ({key}): {what}{found}")
            if values is not s.values:
                values = np.where(is_absent(s.values), ABSENT, values)
            if not source.sorted and not rises:
                t = _in_time(s, t, known, notes)
            channel = _clean(path, signal, key, replace(s, t=t, values=values), source.sorted, rises, notes)
            if channel is not None and is_ours(signal, signals):
                channel = _inside(signal, key, channel, wrong, notes)
            if channel is not None:
                channels[signal], keys[signal] = channel, key
        if signal in require and (signal not in channels or channels[signal].t.size < 2):
            found = "only one sample of" if signal in channels else "no"
            reason = "; ".join(source.notes[said[0] :] + notes[said[1] :]) or source.absent(name)
            reason = "; ".join(filter(None, (reason, log.guesses.open.get(signal), log.absent.get(signal))))
            asked = f"looked for {source.kind} {name!r}" + (f" ({reason})" if reason else "")
            line = f"{path}: {found} {signal}: {asked}; --map NAME={signal} names another{source.has()}"
            raise LogError("; ".join(filter(None, (line, log.unused))))
    _refuse_units(path, wrong)
    ordered = getattr(source, "time", "") != ROW
    channels = _one_run(path, channels, require, notes)
    channels = _own_samples(_fresh(channels, notes) if ordered else channels, notes)
    _shift(channels, notes, "1900" if units.get("t") == "day" else "1970")
    ours = {name: (c.t, c.values) for name, c in channels.items() if is_ours(name, signals)}
    sure, perhaps = plausible.too_small(ours, set(units) - set(log.guesses.made))
    if sure:
        small, *others = sure
        raise LogError(
            f"{path}: {small} ({keys[small]}): {sure[small]}"
            + (f"; the same for {', '.join(others)}" if others else "")
        )
    notes += [f"{name} ({keys[name]}): {why}" for name, why in perhaps.items()]
    notes += [f"{name}: {why}" for name, why in log.guesses.open.items() if name not in log.guesses.rpm]
    made = tuple(g for g in log.guesses.made.values() if g.signal in channels)
    return Log(str(path), channels, list(dict.fromkeys([*source.notes, *notes])), signals, made, ordered)


def _scale(path: Path, log: Opened, signal: str, t: np.ndarray, values: np.ndarray) -> str:
    """What to state of a signal whose unit does not say it, where the log's other signals do; else ""."""
    good = np.isfinite(t) & np.isfinite(values)
    others = {n: c for n, c in sketch(path, log, UNITS).items() if n != signal}
    found = proposed_scale(signal, (t[good], values[good]), others, log.tables) if is_ours(signal, UNITS) else None
    return f"; it follows {found[1]} with --unit '{signal}={found[0]}'" if found else ""


def _in_seconds(path: Path, unit: Units, s: Series) -> np.ndarray:
    """The times of a series in s."""
    t = unit.convert("t", "t", s.t, s.t_unit)
    known = t[np.isfinite(t)]
    if not plausible.latest(known):
        of = plausible.unit_of_time(known)
        raise LogError(
            f"{path}: time (={np.median(known):.6g} s) must be below {plausible.LATEST:g} s; --unit t={of}, if it is "
            f"in {of}"
        )
    return t


def _inside(
    signal: str, key: str, c: Channel, wrong: list[tuple[str, str, str, np.ndarray]], notes: list[str]
) -> Channel | None:
    """The channel without the few samples that its signal cannot have; where they are not few, it goes on the list of
    the wrong.
    """
    inside, why = plausible.judge(signal, c.values)
    if why:
        wrong.append((signal, key, why, c.values))
    if why or inside.all():
        return c
    r, far = plausible.RANGES[signal], c.values[~inside]
    unit = "" if r.unit == "-" else f" {r.unit}"
    furthest = far[np.argmax(np.abs(far))]
    what = (
        f"{far.size:,} of {inside.size:,} samples are outside {r.low:g} to {r.high:g}{unit} (furthest {furthest:.6g})"
    )
    notes.append(Note(f"{signal} ({key}): {what}: left out", "left out", signal, far.size))
    return replace(c, t=c.t[inside], values=c.values[inside])


def _one_run(
    path: Path, channels: dict[str, Channel], require: tuple[str, ...], notes: list[str]
) -> dict[str, Channel]:
    """Channels of the one run that the log holds, where its clock jumped."""
    if not channels:
        return channels
    first, last, note, why = plausible.longest_part([c.t for c in channels.values()])
    if why:
        raise LogError(f"{path}: {why}")
    if not note:
        return channels
    lost = max(int(np.count_nonzero((c.t < first) | (c.t > last))) for c in channels.values())
    notes.append(Note(note, "left out", "time", lost))
    out = {}
    for name, c in channels.items():
        use = (c.t >= first) & (c.t <= last)
        if use.any():
            out[name] = replace(c, t=c.t[use], values=c.values[use])
        if name in require and np.count_nonzero(use) < 2:
            raise LogError(f"{path}: no {name} in the part of the log that is kept ({note})")
    return out


def _fresh(channels: dict[str, Channel], notes: list[str]) -> dict[str, Channel]:
    """Channels without the rows that only repeat the row before (`hil.logs.stale`)."""
    tables: list[list[str]] = []
    for name, c in channels.items():
        if not c.framed:
            table = next((names for names in tables if _same(channels[names[0]].t, c.t)), None)
            if table is None:
                tables.append([name])
            else:
                table.append(name)
    out = dict(channels)
    for names in tables:
        stale = stale_rows([channels[n].values for n in names]) if len(names) > 1 else np.zeros(0, dtype=bool)
        if not stale.any():
            continue
        t = channels[names[0]].t[stale]
        many = int(np.count_nonzero(stale))
        notes.append(Note(f"{', '.join(names)}: {many:,} of {stale.size:,} rows repeat the row before in every channel "
                          f"(the first at {t[0]:.6g} s): stale, left out", "left out", "time", many))  # fmt: skip
        for n in names:
            c = channels[n]
            out[n] = replace(c, t=c.t[~stale], values=c.values[~stale])
    return out


def _same(a: np.ndarray, b: np.ndarray) -> bool:
    return a is b or np.array_equal(a, b)


def _own_samples(channels: dict[str, Channel], notes: list[str]) -> dict[str, Channel]:
    """Channels at the rate at which they were sampled, where an exporter joined their samples by straight lines; a
    command that seldom bends keeps its lines, but says how far its samples are apart.
    """
    polled = {name: c for name, c in channels.items() if not c.framed}
    if not any(seems_joined(c.t, c.values) for c in polled.values()):
        return channels
    found = {name: j for name, c in polled.items() if (j := joined(c.t, c.values)) is not None}
    if not any(j.sure for j in found.values()):
        return channels
    out = dict(channels)
    for name, j in found.items():
        c = channels[name]
        step = float(np.median(np.diff(c.t)))
        apart = j.every * step
        said = f"{name}: samples {apart:.3g} s apart are joined by straight lines"
        if j.sure:
            true = np.rint((c.t - c.t[0]) / step).astype(np.int64) % j.every == j.first
            notes.append(Note(f"{said}: only these are taken, {np.count_nonzero(true):,} of {true.size:,}", "left out",
                              name, int(np.count_nonzero(~true))))  # fmt: skip
            out[name] = replace(c, t=c.t[true], values=c.values[true], apart=apart)
        elif j.every > 2:
            notes.append(Note(f"{said}", "filled", name, c.t.size - c.t.size // j.every))
            out[name] = replace(c, apart=apart)
    return out


def offered(path: str | Path, *, dbc: str | Path | None = None) -> list[str]:
    """Names that a log offers and that ``mapping`` may name. Raises LogError for a file that is no log."""
    path = Path(path)
    try:
        source = format_at(path).open(path, Options(Path(dbc) if dbc is not None else None, {}))
    except NoTime as e:
        return [h for h in e.headers if h]
    time = getattr(source, "time", None)  # a table's time column is a column like any other
    return [*([time] if time else []), *source.names]


def _shift(channels: dict[str, Channel], notes: list[str], era: str) -> None:
    """Count time from the start of the log where the file counts from 1970 (or another ``era``), from midnight, or
    from an event far away.
    """
    if channels and abs(start := min(float(c.t[0]) for c in channels.values())) > plausible.JUMP:
        since = f"counts from {era}" if start > _EPOCH else "does not count from the start"
        said = f"time {since}: {start:.6f} s taken for the start of the log"
        notes.append(Note(said, "converted", "time", max(len(c.t) for c in channels.values())))
        shifted = {i: t - start for i, t in {id(c.t): c.t for c in channels.values()}.items()}
        for name, c in channels.items():
            channels[name] = replace(c, t=shifted[id(c.t)])


# --- writing ----------------------------------------------------------------------------------------------------------


def write_log(path: str | Path, channels: dict[str, Channel], *, dbc: str | Path | None = None) -> None:
    """Write channels as a log; the suffix says the format.

    Tables and MDF4 hold every sample as it is, of a channel of any name that says its unit ("-": none). CAN formats
    hold what the bus would carry: the frames of ``dbc`` (default tables/vgv.dbc) at their periods, in their resolution,
    with valid counter and CRC, from 0 s on. Raises LogError for a name that is no signal, a channel that is not one, a
    value that its frame cannot hold.
    """
    path = Path(path)
    of = format_of(path)
    table = of.channels is not None and dbc is None
    if not channels:
        raise LogError(f"{path}: no channel to write")
    checked = {}
    for name, c in channels.items():
        if name not in UNITS and not (table and _A_NAME.fullmatch(name) and _A_UNIT.fullmatch(c.unit)):
            also = ", or in a table any name of letters and digits with a unit" if table else ""
            what = f"is not a signal{close_names(name, UNITS)}; allowed: {', '.join(UNITS)}{also}"
            raise LogError(f"{path}: {name!r} {what}")
        t, values = np.asarray(c.t, np.float64), np.asarray(c.values, np.float64)
        if t.ndim != 1 or t.shape != values.shape or not t.size:
            raise LogError(
                f"{path}: {name}: t {t.shape} and values {values.shape} must be lists of one length, not empty"
            )
        if not (np.isfinite(t).all() and np.isfinite(values).all() and (np.diff(t) > 0).all()):
            raise LogError(f"{path}: {name}: samples must be finite and their times increasing")
        checked[name] = Channel(t, values, unit=UNITS.get(name, c.unit))
    of.write(path, checked, Path(dbc) if dbc is not None else None)
