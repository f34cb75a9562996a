"""Logs as verbs take them: one log in parts, what is fitted and what only tests that; the record of a system."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from hil.logs import Channel, Log, LogError, read_log
from hil.logs.channels import raster
from hil.logs.held import held
from hil.logs.notes import Note
from hil.logs.units import NO_UNIT, factor_of
from vaneloop.base.errors import InputError, meant
from vaneloop.base.spans import Span, apart, is_span, spans_of
from vaneloop.identification import Record, StageError, System
from vaneloop.identification.least_squares.problem import Fit, LeastSquaresProblem
from vaneloop.identification.subsystem import Array
from vaneloop.verbs.long import carried, held_against
from vaneloop.verbs.replay import a_log

if TYPE_CHECKING:
    from vaneloop.verbs.machine import Machine
    from vaneloop.verbs.replay import LogLike

__all__ = [
    "LogsLike", "Parts", "Tested", "bind_parts", "part_of", "read_record", "records_of", "signals_of", "split",
    "tested",
]  # fmt: skip

Part: TypeAlias = "tuple[float | None, float | None] | str"  # of a log: from, to in s; None an open end
Parts: TypeAlias = "Part | Sequence[Part]"
LogsLike: TypeAlias = "LogLike | Record | Sequence[LogLike | Record]"  # one or several logs, of a user's own system


@dataclass(frozen=True)
class Tested:
    """Error of a signal on the part of a log that nothing was fitted to, RMS in its unit.

    error_before, error_after  with the model as it was, and with what was found, both with parameters of the other part
    """

    stage: str
    signal: str
    unit: str
    error_before: float
    error_after: float
    noise_floor: float
    samples: int


def split(fit: Parts, test: Parts | LogsLike) -> tuple[list[Span], list[Span], list[Any]]:
    """Parts to fit, parts to test, and what else is to test: logs of their own. Raises InputError, one line."""
    listed = [test] if is_span(test) or not isinstance(test, Sequence) or isinstance(test, str) else list(test)
    to_fit = spans_of(fit, "--fit")
    to_test = spans_of([x for x in listed if is_span(x)], "--test")
    apart(to_fit, to_test)
    return to_fit, to_test, [x for x in listed if not is_span(x)]


def records_of(record: Record, spans: Sequence[Span]) -> list[Record]:
    """Each part of a record as one of its own; without parts, the record."""
    out: list[Record] = []
    t = np.asarray(record.t, dtype=float)
    for span in spans:
        use = _inside(t, span, record.name)
        columns = {k: v[use] if np.shape(v) == t.shape else v for k, v in _arrays(record).items()}
        begin = record.begin + float(t[use][0] - t[0])
        notes = () if out else record.notes
        out.append(Record(f"{record.name} {span}", t[use], columns, begin, notes, record.ordered))
    return out or [record]


def part_of(log: Log, spans: Sequence[Span]) -> Log:
    """A log's samples within these parts; without parts, the log."""
    if not spans:
        return log
    longest = max((c.t for c in log.values()), key=len)
    for span in spans:
        _inside(longest, span, log.path)
    part = log.within(list(spans))
    return part[[name for name, c in part.items() if len(c) > 1]]


def bind_parts(machine: Machine, log: Log, fit: Sequence[Span], test: Sequence[Span]) -> Any:
    """The stages of the parts of a log that are fitted, with those of the other parts as its ``test``."""
    chain = machine.bind(part_of(log, fit))
    if test:
        chain.test = machine.bind(part_of(log, test))
    return chain


def tested(chain: Any, fits: Sequence[tuple[str, Fit, Fit]]) -> list[Tested]:
    """What each stage's fits before and after say on the part of the log that they have not seen."""
    test = getattr(chain, "test", None)
    out: list[Tested] = []
    if test is None:
        return out
    for name, before, after in fits:
        stage = next((s for s in test.stages if s.name == name), None)
        if stage is None:
            continue
        here = next(s for s in chain.stages if s.name == name)
        judge = LeastSquaresProblem(stage, stage.floor)
        thetas = np.array([carried(here, f.theta, stage) for f in (before, after)])
        if test.whole is not None:
            sums = held_against(test, [(name, list(thetas), judge.floor, np.inf)]).sums[name]
            n, rms = sums.samples.sum(axis=1), sums.rms() * judge.floor
        else:
            n = judge.valid.sum(axis=1)
            rms = np.sqrt(judge.mean_squares(judge.errors(thetas))) * judge.floor
        for k, signal in enumerate(stage.outputs):
            figures = float(rms[0, k]), float(rms[1, k]), float(judge.floor[k]), int(n[k])
            out.append(Tested(name, signal, stage.units[k], *figures))
    return out


def _arrays(record: Record) -> dict[str, Array]:
    return {k: np.asarray(v, dtype=float) for k, v in record.columns.items()}


def _inside(t: Array, span: Span, name: str) -> Array:
    """Which times lie in a part; refuses one that has none."""
    use = (t >= span.low) & (t < span.high)
    if np.count_nonzero(use) < 2:
        raise InputError(
            f"{name}: {np.count_nonzero(use)} samples in '{span}'; the log is from {t[0]:g} to {t[-1]:g} s"
        )
    return np.asarray(use)


def signals_of(system: System) -> dict[str, str]:
    """The channels that a system looks for in a log, name -> unit; "": any."""
    motion = {c: system.units.get("position", "") for c in (system.position,) if c}
    motion |= {c: "" for c in (system.velocity,) if c}
    return {**motion, **system.inputs, **system.outputs}


def read_record(log: LogLike, system: System, **reading: Any) -> tuple[Record, list[str]]:
    """Read a log as a system wants it, by its own ``read`` or by ours; return it and what there is to note.

    log      a file's name, a frame, or what has been read of one
    reading  arguments of `hil.logs.read_log`: dbc, mapping, units, design_rpm
    """
    if system.read is not None and isinstance(log, str | Path):
        return Record(Path(log).name, *_by_its_own_reader(str(log), system)), []
    signals = signals_of(system)
    needed = [c for c in signals if c not in system.optional()]
    if isinstance(log, Log):
        read = _in_units(log, signals, needed)
    else:
        read = read_log(a_log(log), **reading, require=needed, signals=signals, rows=system.kind == "static")
    if not read.ordered:
        return _without_order(read, system, Path(log if isinstance(log, str | Path) else read.path).name)
    reference = max((read.channels[c] for c in system.outputs if c in read.channels), key=lambda c: len(c.t))
    drivers = (system.position, system.velocity, *system.inputs)
    t, notes = _driven(reference.t, {c: read.channels[c] for c in drivers if c in read.channels})
    columns = {}
    for c, channel in read.channels.items():
        step = float(np.median(np.diff(channel.t))) if len(channel.t) > 1 else 0.0
        holds = c in system.inputs and channel.framed and system.holds
        v = channel.values[held(channel, t)] if holds else np.interp(t, channel.t, channel.values)
        if c in system.outputs:  # outputs are never made up: far from a sample there is none
            i = np.clip(np.searchsorted(channel.t, t), 1, len(channel.t) - 1)
            v[np.minimum(np.abs(channel.t[i] - t), np.abs(t - channel.t[i - 1])) > 1.5 * step] = np.nan
        columns[c] = v
    name = Path(log if isinstance(log, str | Path) else read.path).name
    said = [n.on(name) if isinstance(n, Note) else f"{name}: {n}" for n in (*read.notes, *notes)]
    return Record(name, t, columns, notes=said), said


def _without_order(read: Log, system: System, name: str) -> tuple[Record, list[str]]:
    """The rows of a table without time that have all inputs and an output, in an order that follows from their numbers
    alone: that of the file says nothing.
    """
    t, columns = raster(read.channels)
    whole = np.all([np.isfinite(columns[c]) for c in system.inputs if c in columns], axis=0)
    whole &= np.any([np.isfinite(columns[c]) for c in system.outputs if c in columns], axis=0)
    notes = list(read.notes)
    if lost := int(np.count_nonzero(~whole)):
        notes.append(Note(f"rows: {lost} without an input, or without any output: left out", "left out", "rows", lost))
    columns = {c: v[whole] for c, v in columns.items()}
    order = np.lexsort([columns[c] for c in sorted(columns)])
    order = order[np.random.default_rng(0).permutation(len(order))]  # no fold is then of one corner of the inputs
    said = [n.on(name) if isinstance(n, Note) else f"{name}: {n}" for n in notes]
    return Record(name, t[: len(order)], {c: v[order] for c, v in columns.items()}, 0.0, said, False), said


def _driven(t: Array, drivers: Mapping[str, Channel]) -> tuple[Array, list[Note]]:
    """The times at which all drivers are known, and notes of the others: what drove the model then nobody knows. A
    driver is known for one step before its first sample and behind its last; of a single sample it is a constant.
    """
    notes = []
    use = np.ones(len(t), dtype=bool)
    for name, c in drivers.items():
        if len(c.t) < 2:
            continue
        step = float(np.median(np.diff(c.t)))
        known = (t > c.t[0] - 1.5 * step) & (t < c.t[-1] + 1.5 * step)
        if not known.all():
            said = f"{name}: logged from {c.t[0]:.5g} to {c.t[-1]:.5g} s: what is measured outside does not count"
            notes.append(Note(said, "cut", name, int(np.count_nonzero(~known))))
            use &= known
    return (t, notes) if use.all() else (t[use], notes)


def _in_units(log: Log, signals: Mapping[str, str], needed: Sequence[str]) -> Log:
    """The channels of a log that a system has a use for, each in the system's unit.

    Raises LogError where one is missing, or where its unit does not convert.
    """
    if missing := next((c for c in needed if c not in log or len(log[c]) < 2), None):
        raise LogError(f"{log.path}: no {missing}{meant(missing, log)}; it has {', '.join(log)}")
    channels = {}
    for name, unit in signals.items():
        if name not in log:
            continue
        c = log[name]
        told = unit != c.unit and not {unit.casefold(), c.unit.casefold()} & set(NO_UNIT)
        factor = factor_of(c.unit, unit) if told else (1.0, 0.0)
        if not isinstance(factor, tuple):
            raise LogError(f"{log.path}: {name} is in {c.unit}; allowed: {unit} or what converts to it")
        values = c.values if factor == (1.0, 0.0) else factor[0] * c.values + factor[1]
        channels[name] = dataclasses.replace(c, values=values, unit=unit)
    return Log(log.path, channels, log.notes, signals)


def _by_its_own_reader(path: str, system: System) -> tuple[Any, dict[str, Any]]:
    """Time and channels from the system's ``read``."""
    assert system.read is not None
    if not Path(path).is_file():
        raise StageError(f"{path}: no such file")
    said = f"{path}: read() of system {system.name!r}"
    try:
        data = dict(system.read(path))
    except Exception as e:
        raise StageError(f"{said} failed: {type(e).__name__}: {' '.join(str(e).split())}") from None
    if "t" not in data:
        raise StageError(f"{said} returned {', '.join(map(str, data)) or 'nothing'}; a time 't' is needed")
    try:
        columns = {str(k): np.asarray(v, dtype=float) for k, v in data.items()}
    except (TypeError, ValueError) as e:
        raise StageError(f"{said}: not numbers ({e})") from None
    return columns.pop("t"), columns
