"""Replay: a logged run through firmware and plant, signal by signal against what was measured."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from hil.logs import Log, LogError, read_log
from hil.logs.dataframe import is_frame
from hil.replay import ReplayResult, replay_json
from hil.replay import replay as run
from vaneloop.base.errors import InputError
from vaneloop.base.signals import UNITS
from vaneloop.pages.replay import replay_page
from vaneloop.verbs.answer import Answer, Row
from vaneloop.verbs.curves import Curve, Curves
from vaneloop.verbs.machine import Machine, files_of

if TYPE_CHECKING:
    from pandas import DataFrame

    from hil.figures import SignalError
    from vaneloop.pages.page import Page

__all__ = ["LogLike", "Replay", "a_log", "brief", "log_of", "replay"]

LogLike: TypeAlias = "Log | DataFrame | str | Path"  # what an analysis takes as a log


@dataclass(frozen=True, repr=False, eq=False)
class Replay(Answer):
    """A replayed log.

    result    the curves and figures (`hil.replay.ReplayResult`)
    exceeded  tolerances that do not hold, in words
    more      what a caller adds to the JSON
    """

    result: ReplayResult
    exceeded: list[str] = field(default_factory=list)
    more: Mapping[str, object] = field(default_factory=dict)

    @property
    def log(self) -> str:  # type: ignore[override]
        """The log's name."""
        return self.result.log

    @property
    def signals(self) -> list[SignalError]:
        """Error of every signal."""
        return self.result.signals

    def sentence(self) -> str:
        """The answer in one sentence."""
        return self.page().verdict

    def to_dict(self) -> dict[str, object]:
        """The answer as the JSON of ``vaneloop replay``."""
        return {**replay_json(self.result), "exceeded": self.exceeded, **self.more}

    def rows(self) -> list[Row]:
        """A row for each signal and what it was held against: its errors."""
        return [asdict(s) for s in self.signals]

    def _worked_out(self) -> Curves:
        r, out = self.result, []
        floors = {s.signal: (s.stage, s.unit, s.noise_floor) for s in self.signals if s.reference == "measured"}
        for name, (stage, unit, floor) in floors.items():
            c = r.measured[name]
            error = c.values - np.interp(c.t, r.t, r.model[name], np.nan, np.nan)
            out.append(Curve(name, stage, unit, c.t, c.values, error, error, floor))
        return Curves(out, self.log)

    def page(self, command: str = "") -> Page:
        """The answer as a page."""
        return replay_page(self.result, command, notes=self.result.notes)


def log_of(log: LogLike, machine: Machine, require: tuple[str, ...] = ("n_dem",)) -> Log:
    """The log, read where it is a file's name or a frame: what is guessed is held against the machine's own tables. Of
    a `Log` the signals of the product are taken.
    """
    if not isinstance(log, Log):
        return read_log(a_log(log), require=require, tables=files_of(machine.tables))
    if missing := [name for name in require if name not in log]:
        raise LogError(f"{log.path}: no {missing[0]}; it has {', '.join(log)}")
    ours = [name for name in log if name in UNITS]
    return log if len(ours) == len(log.channels) else log[ours]


def a_log(log: object) -> str | Path | DataFrame:
    """A file's name or a frame; InputError, one line, for what is neither."""
    if isinstance(log, str | Path) or is_frame(log):
        return log
    raise InputError(f"log (={brief(log)}): allowed: what read_log gives, a pandas.DataFrame, or a file's name")


def brief(thing: object) -> str:
    """A thing on one short line."""
    text = " ".join(repr(thing).split())
    return text if len(text) <= 60 else f"{text[:57]}..."


def replay(
    log: LogLike,
    machine: Machine | None = None,
    *,
    progress: Callable[[float], None] | None = None,
    floors: Mapping[str, float] | None = None,
) -> Replay:
    """Run a log (or the file of one) through firmware and plant, and hold the model against what it measured.

    Parameters
    ----------
    log : Log, pandas.DataFrame, str or Path
        The run; its demand ``n_dem`` drives the loop.
    machine : Machine, optional
        Default: the shipped tables.
    progress : callable, optional
        Takes the fraction done.
    floors : Mapping, optional
        Noise floors of signals, in their units, where they are known better than from this run.

    Returns
    -------
    Replay
        Its `rows` are the signals with their errors. Nothing is fitted: ``params`` is empty.

    Raises
    ------
    LogError
        For a log that cannot drive the loop.

    Examples
    --------
    >>> import vaneloop
    >>> answer = vaneloop.replay(vaneloop.read_log("examples/hidden_effect.parquet")[0:5])
    >>> answer.residuals.units["x_lvdt"], len(answer.params)
    ('mm', 0)
    """
    m = machine or Machine()
    return Replay(run(log_of(log, m), plant=m.plant, calibration=m.calibration, progress=progress, floors=floors))
