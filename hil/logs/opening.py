"""A log is opened: which of its names is which signal, stated by the user or by a mapping file, called as ours, or
guessed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hil.logs import plausible
from hil.logs.formats import format_at
from hil.logs.guess import Files, Guess, Guesses, design_speed, withdrawn
from hil.logs.guess import guess as guess_names
from hil.logs.mapping import Bench, read_mapping
from hil.logs.names import CERTAIN, unit_behind, unit_in_name, unit_kind
from hil.logs.notes import Note
from hil.logs.source import LogError, Options, Source, close_names, find
from hil.logs.table import Table
from hil.logs.times import guess_unit
from hil.logs.units import NO_UNIT, USUAL_UNITS, Units, factor_of, scale_of
from vaneloop.base.errors import meant
from vaneloop.base.signals import UNITS

__all__ = ["Opened", "is_ours", "open_log", "sketch", "times_of", "wanted_design_speed"]


def is_ours(name: str, signals: Mapping[str, str]) -> bool:
    """Whether ``name`` is one of the product's signals: a system of a user's own may give its name to something
    else.
    """
    return name in plausible.RANGES and signals.get(name) == UNITS[name]


def _pairs(path: Path, mapping: Mapping[str, str] | None, signals: Mapping[str, str] = UNITS) -> dict[str, str]:
    """Mapping as signal -> name in the log; both directions are understood, {"N1": "n_dem"} and {"n_dem": "N1"}."""
    known = {*signals, "t"}
    out: dict[str, str] = {}
    for a, b in (mapping or {}).items():
        if b in known:
            name, signal = a, b
        elif a in known:
            name, signal = b, a
        else:
            raise LogError(
                f"{path}: map {a}={b}: {b!r} is not a signal{close_names(b, known)}; allowed: {', '.join(signals)}, t"
            )
        if signal in out and out[signal] != name:
            raise LogError(f"{path}: both {out[signal]!r} and {name!r} are mapped to {signal}")
        out[signal] = name
    return out


def _known_units(path: Path, stated: Mapping[str, str], signals: Mapping[str, str]) -> None:
    """Refuse a unit that the user states and that is none of its signal's: no name is looked for under it."""
    for signal, unit in stated.items():
        gain, text, _ = scale_of(unit)
        own = signals.get(signal, "s")
        if gain == 0.0:
            raise LogError(f"{path}: --unit {signal}={unit}: its gain is 0; allowed: any other number")
        if signal == "state" or text == own or text.casefold() in NO_UNIT:
            continue
        speed = signal in ("n_dem", "n_r") and isinstance(factor_of(text, "rpm"), tuple)
        factor = factor_of(text, own)
        if not speed and not isinstance(factor, tuple):
            what = f"unit is not known{meant(text, USUAL_UNITS)}" if factor is None else "unit does not convert"
            allowed = "%, rpm, Hz or rad/s" if signal in ("n_dem", "n_r") else f"{own} or what converts to it"
            raise LogError(f"{path}: --unit {signal}={unit}: {what}; allowed: {allowed}")


@dataclass
class Opened:
    """A log whose names are known, before its samples are taken: what `read_log` reads and `hil.logs.survey` shows.

    named    signal -> name in the log, where that is not our own: mapped or guessed
    units    signal -> unit in the log, where the user, a mapping file or a guess says it
    absent   signals of the mapping file that the log does not have: signal -> words
    tables   of the machine, that a guess is held against
    unused   what is to be said of a database that the user names in vain
    """

    source: Source
    named: dict[str, str]
    units: dict[str, str]
    design_rpm: float | None
    guesses: Guesses
    notes: list[str]
    taken: set[str]
    dbc: Path | None
    absent: dict[str, str]
    tables: Files
    unused: str = ""


def open_log(
    path: Path,
    dbc: str | Path | None,
    mapping: Mapping[str, str] | None,
    units: Mapping[str, str] | None,
    design_rpm: float | None,
    signals: Mapping[str, str],
    guess: bool,
    mapping_file: str | Path | None,
    tables: Files,
    part: int = 0,
    opened: Callable[[Path, Options], Source] | None = None,
    rows: bool = False,
) -> Opened:
    """Open a log and find its names, guessed where nobody states them; arguments as of `read_log`.

    opened  what opens it; default: its format
    """
    bench = read_mapping(mapping_file, signals) if mapping_file is not None else Bench()
    guess = guess and mapping_file is None  # a mapping file says it all
    dbc, design_rpm = dbc or bench.dbc, design_rpm or bench.design_rpm
    stated = {**bench.units, **(units or {})}
    _known_units(path, units or {}, signals)
    given = _pairs(path, mapping, signals)
    named = {**bench.names, **given}
    by_name = {name: signal for signal, name in named.items()}
    options = Options(Path(dbc) if dbc is not None else None, by_name, guess, part, rows, tuple(signals))
    source = (opened or format_at(path).open)(path, options)
    if part and not isinstance(source, Table):
        raise LogError(f"{path}: part {part}: only tables have parts")
    absent = {
        s: f"{mapping_file} calls it {n!r}, which the log does not have"
        for s, n in bench.names.items() if s not in given and s != "t" and not find(source, n, True)
    }  # fmt: skip
    for signal in absent:
        del named[signal]
    notes = [f"{s}: {why}" for s, why in absent.items()]
    unused = ""
    if options.dbc is not None and not hasattr(source, "frames"):
        unused = f"{options.dbc}: not used, as the log holds no frames of a bus"
        notes.append(unused)
    keys = {s: find(source, named.get(s, s), s in named) for s in signals}
    out = Opened(
        source,
        named,
        stated,
        design_rpm,
        Guesses(),
        notes,
        {k for ks in keys.values() for k in ks},
        options.dbc,
        absent,
        tables,
        unused,
    )
    _units_of_names(out, signals, guess)
    if guess:
        _guess_time(path, out)
        out.guesses = guess_names(
            source,
            [s for s in signals if is_ours(s, signals) and s not in named and not keys[s]],
            out.taken,
            stated,
            design_rpm,
        )
        for signal in signals:  # of a system of the user's own: its name in other letters, with a unit behind, no more
            if keys[signal] or signal in named or is_ours(signal, signals):
                continue
            alike = find(source, signal, True) or [
                k
                for k, (name, unit) in ((k, unit_behind(k)) for k in source.names)
                if name.casefold() == signal.casefold() and isinstance(factor_of(unit, signals[signal]), tuple)
            ]
            if len(alike) == 1 and alike[0] not in out.taken:
                unit = source.series(alike[0]).unit or _said(signal, alike[0], signals[signal]) or signals[signal]
                out.guesses.made[signal] = Guess(signal, alike[0], unit, CERTAIN, "its name in other letters")
    if out.guesses.made:
        withdrawn(out.guesses, sketch(path, out, signals), tables)
    for signal, g in out.guesses.made.items():
        named[signal] = g.name
        out.units.setdefault(signal, g.unit)
        notes.append(Note(g.note(), "guessed", signal, 1))
    return out


def _said(signal: str, name: str, own: str) -> str:
    """The unit that a name says, of the kind of the signal's ``own`` and not that one; "" where it says none."""
    unit = unit_behind(name)[1]
    speed = signal in ("n_dem", "n_r") and isinstance(factor_of(unit, "rpm"), tuple) if unit else False
    factor = factor_of(unit, own) if unit and (unit_kind(unit) == "angle") == (unit_kind(own) == "angle") else None
    return unit if speed or (isinstance(factor, tuple) and not np.allclose(factor, (1.0, 0.0), rtol=1e-12)) else ""


def _units_of_names(out: Opened, signals: Mapping[str, str], guess: bool) -> None:
    """Take the unit that a name says which the user gives, where neither the user nor the file states one; tell it."""
    mapped = {s: find(out.source, n, True) for s, n in out.named.items() if s in signals and s not in out.units}
    if isinstance(out.source, Table) and "t" not in out.units and not out.source.time_unit:
        mapped["t"] = [out.source.time]
    for signal, keys in mapped.items():
        own = signals.get(signal, "s")
        unit = _said(signal, keys[0], own) if len(keys) == 1 else ""
        stated = "" if not unit or signal == "t" else out.source.series(keys[0]).unit.strip()
        if not unit or (stated.casefold() not in NO_UNIT and stated != "1"):
            continue
        if guess:
            out.units[signal] = unit
            taken = f"taken in {unit}, as its name says; --unit {signal}={own} states another"
        else:
            taken = f"taken in {own}, though its name says {unit}; --unit {signal}={unit} takes that"
        out.notes.append(Note(f"{signal} ({keys[0]}): {taken}", "converted" if guess else "guessed", signal, 1))


def _guess_time(path: Path, out: Opened) -> None:
    """The unit of a table's time where neither the file nor the user states one and it cannot be seconds."""
    source = out.source
    if not isinstance(source, Table) or source.time_unit or "t" in out.units:
        return
    t = times_of(path, source)
    unit, why = guess_unit(t[np.isfinite(t)])
    if unit:
        out.units["t"] = unit
        said = f"t ({source.time}): guessed to be in {unit} ({why}); --unit t=UNIT states another, --no-guess none"
        out.notes.append(Note(said, "guessed", "t", 1))


def times_of(path: Path, table: Table) -> np.ndarray:
    """The time column of a table, float64[rows]. Raises LogError, one line that names the file."""
    try:
        return table.times()
    except LogError as e:
        raise e if str(e).startswith(str(path)) else LogError(f"{path}: {e}") from None


def sketch(path: Path, out: Opened, signals: Mapping[str, str]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Channels as they will be read, without care for single samples: t (s), values (own unit)."""
    unit = Units(path, {**{s: g.unit for s, g in out.guesses.made.items()}, **out.units}, out.design_rpm, [], signals)
    seen = {}
    for signal in signals:
        g = out.guesses.made.get(signal)
        keys = [g.name] if g else find(out.source, out.named.get(signal, signal), signal in out.named)
        if len(keys) != 1:
            continue
        try:
            s = out.source.series(keys[0])
            with np.errstate(all="ignore"):
                t, v = unit.convert("t", "t", s.t, s.t_unit), unit.convert(signal, keys[0], s.values, s.unit)
        except LogError:
            continue  # reading it says why
        good = np.isfinite(t) & np.isfinite(v)
        if np.count_nonzero(good) > 1:
            order = np.argsort(t[good], kind="stable")
            t, v = t[good][order], v[good][order]
            last = np.append(np.diff(t) > 0, True)
            seen[signal] = t[last], v[last]
    return seen


def wanted_design_speed(path: Path, out: Opened) -> tuple[str, float, str]:
    """A guessed rotor speed that needs the design speed: signal, the design speed (rpm) that the log suggests,
    words.
    """
    signal, name = next(iter(out.guesses.rpm.items()))
    s = out.source.series(name)
    unit = out.units.get(signal) or s.unit or unit_in_name(name)[1] or "rpm"
    factor = factor_of(unit, "rpm")
    t = Units(path, out.units, None, [], UNITS).convert("t", "t", s.t, s.t_unit)
    good = np.isfinite(t) & np.isfinite(s.values)
    seen = sketch(path, out, UNITS)
    speed = t[good], s.values[good] * (factor[0] if isinstance(factor, tuple) else 1.0)
    rpm, why = design_speed(speed, seen.get("x_lvdt", seen.get("x_dem")), out.tables)
    said = f"--design-rpm {rpm:g}, if that is 100 % ({why})" if rpm else f"--design-rpm R states it ({why})"
    words = f"{name!r} is in {unit} and needs the design speed to become %: {said}"
    return signal, rpm, words
