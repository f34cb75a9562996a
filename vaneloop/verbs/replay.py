"""Replay: a logged run through firmware and plant, signal by signal against what was measured."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hil.logs import read_log
from hil.replay import ReplayResult, replay_json
from hil.replay import replay as run
from vaneloop.pages.replay import replay_page
from vaneloop.verbs.answer import Answer
from vaneloop.verbs.machine import Machine, files_of

if TYPE_CHECKING:
    from hil.figures import SignalError
    from hil.logs import Log
    from vaneloop.pages.page import Page

__all__ = ["Replay", "log_of", "replay"]


@dataclass(frozen=True)
class Replay(Answer):
    """A replayed log.

    result    the curves and figures (`hil.replay.ReplayResult`)
    exceeded  tolerances that do not hold, in words
    more      what a caller adds to the JSON
    """

    result: ReplayResult
    exceeded: list[str] = field(default_factory=list)
    more: Mapping[str, Any] = field(default_factory=dict)

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

    def to_dict(self) -> dict[str, Any]:
        """The answer as the JSON of ``vaneloop replay``."""
        return {**replay_json(self.result), "exceeded": self.exceeded, **self.more}

    def page(self, command: str = "") -> Page:
        """The answer as a page."""
        return replay_page(self.result, command)


def log_of(log: Log | str | Path, machine: Machine, require: tuple[str, ...] = ("n_dem",)) -> Log:
    """The log, read where it is a file's name: what is guessed is held against the machine's own tables."""
    if not isinstance(log, str | Path):
        return log
    return read_log(log, require=require, tables=files_of(machine.tables))


def replay(
    log: Log | str | Path,
    machine: Machine | None = None,
    *,
    progress: Callable[[float], None] | None = None,
    floors: Mapping[str, float] | None = None,
) -> Replay:
    """Run a log (or the file of one) through firmware and plant, and hold the model against what it measured.

    machine  default: the shipped tables
    floors   noise floors of signals, in their units, where they are known better than from this run

    Raises LogError for a log that cannot drive the loop.
    """
    m = machine or Machine()
    return Replay(run(log_of(log, m), plant=m.plant, calibration=m.calibration, progress=progress, floors=floors))
