"""What a user has chosen: the log, what lies beside it, and how it is read, as the words of a command."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hil.logs import Channel

__all__ = ["CODE", "OTHER_SUFFIXES", "Choice", "LogFile", "Overlay", "safe_name"]

OTHER_SUFFIXES = (".dbc", ".toml")  # beside a log: its database, a model file
CODE = ".py"  # a model of the user's own


@dataclass(frozen=True)
class LogFile:
    """A file that may be chosen: where it is, what the user calls it, and how a command would name it.

    marks    of a run recorded here: s from its start, what was injected then
    shipped  it came with the workbench: its code is ours
    """

    path: Path
    name: str
    word: str
    marks: tuple[tuple[float, str], ...] = ()
    shipped: bool = False


@dataclass
class Choice:
    """What the log is held against, and how it is read: what the form says.

    system  model of the user's own; None: the vane chain of ``tables``
    model   what is known of either by now: parameters as fitted, effects added
    also, test            further logs that are fitted, and that only test, with ``system``
    fit_part, test_part   seconds of the log that are fitted, and that only test: FROM:TO; "": all, none
    """

    file: LogFile | None = None
    dbc: LogFile | None = None
    model: LogFile | None = None
    bench: LogFile | None = None  # mapping file
    mapping: dict[str, str] = field(default_factory=dict)  # signal -> name in the log
    units: dict[str, str] = field(default_factory=dict)  # signal -> unit in the log
    design_rpm: str = ""
    guess: bool = True
    tables: str | None = None
    system: LogFile | None = None
    also: list[LogFile] = field(default_factory=list)
    test: list[LogFile] = field(default_factory=list)
    fit_part: str = ""
    test_part: str = ""

    def beside(self) -> list[str]:
        """Names of the files that are taken beside the log."""
        return [f.name for f in (self.dbc, self.model, self.bench) if f is not None]

    def words(self, real: bool) -> list[str]:
        """Words of the command line after the verb; ``real``: as the worker needs them, else as the user would type
        them.
        """

        out = self.reading(real)
        if self.model is not None:
            out += ["--model", _place(self.model, real)]
        if self.tables is not None and self.system is None:
            out += ["--tables", self.tables]
        tests = [*([self.test_part] if self.test_part else []), *(_place(f, real) for f in self.test)]
        further = (
            ("--also", [_place(f, real) for f in self.also]),
            ("--fit", self.fit_part.split()),
            ("--test", tests),
        )
        for option, given in further:
            out += [option, *given] if given else []
        return out

    def reading(self, real: bool) -> list[str]:
        """Those of them that say how the log is read."""
        assert self.file is not None
        out = [_place(self.file, real)]
        if self.dbc is not None:
            out += ["--dbc", _place(self.dbc, real)]
        for signal, name in self.mapping.items():
            out += ["--map", f"{name}={signal}"]
        for signal, unit in self.units.items():
            out += ["--unit", f"{signal}={unit}"]
        if self.design_rpm.strip():
            out += ["--design-rpm", self.design_rpm.strip()]
        if self.bench is not None:
            out += ["--mapping", _place(self.bench, real)]
        if not self.guess:
            out += ["--no-guess"]
        if self.system is not None:
            out += ["--system", _place(self.system, real)]
        return out


def _place(file: LogFile, real: bool) -> str:
    """A file as the worker needs it, else as the user would type it."""
    return str(file.path) if real else file.word


@dataclass(eq=False)
class Overlay:
    """Another log laid over the one chosen, ``later`` (s); its channels once it is read, and as they are ``shown``,
    with those that formulas make.
    """

    file: LogFile
    later: float = 0.0
    channels: Mapping[str, tuple[str, Any, Any]] | None = None
    shown: Mapping[str, Channel] = field(default_factory=dict)


def safe_name(name: str) -> str:
    """A file name that is one: its last part, letters, digits and -_. only, not hidden."""
    kept = re.sub(r"[^A-Za-z0-9._ -]", "_", re.split(r"[/\\]", name)[-1]).strip(" .")
    stem, dot, suffix = kept.rpartition(".")
    return (stem[:80].strip(" .") or "file") + dot + suffix[:10] if dot else kept[:80] or "file"
