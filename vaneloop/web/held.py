"""A log held against its model, as the worker keeps it: the vane chain, or a system of the user's own. What is asked of
either is asked of `vaneloop.verbs`, as the command line asks it.
"""

from __future__ import annotations

import argparse
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

from hil.loop.lockstep import warm_up
from vaneloop.cli import options, own_model
from vaneloop.cli.chains import chain_of, tell_search
from vaneloop.identification import System, load_system
from vaneloop.identification.results import StageDiagnosis
from vaneloop.identification.selection.relative_error_acceptance import RelativeErrorAcceptance
from vaneloop.identification.subsystem import Bound, Stage
from vaneloop.identification.user_models.by_log import ByLog, load_model_of
from vaneloop.identification.workflow import Diagnosis, extend_stage
from vaneloop.verbs.learn import Learned, learned, learned_system
from vaneloop.verbs.search import Diagnosed, Stages, compared, compared_system, diagnosed, diagnosed_system, logs_for

__all__ = ["Held", "held", "system_of"]

Share = Callable[[float], None]


class Held(ABC):
    """A log held against a model; ``bound`` are its stages."""

    bound: Bound

    def stage(self, name: str) -> Stage:
        """A stage by its name."""
        return next(s for s in self.bound.stages if s.name == name)

    @abstractmethod
    def compared(self, progress: Share) -> Stages:
        """`vaneloop.compare`."""

    @abstractmethod
    def diagnosed(self, news: Callable[[Any], None]) -> Diagnosed:
        """`vaneloop.diagnose`."""

    @abstractmethod
    def again(self, diagnosis: Diagnosis) -> Diagnosed:
        """The answer of which the page has the diagnosis."""

    @abstractmethod
    def extended(self, stage: Stage, effects: tuple[str, ...], tick: Callable[[], None]) -> StageDiagnosis:
        """What `vaneloop.extend` says of one stage with exactly these effects."""

    @abstractmethod
    def learned(self, diagnosis: Diagnosis, progress: Share) -> Learned:
        """`vaneloop.learn`."""


class _OfMachine(Held):
    """The vane chain of the tables, or of another machine."""

    def __init__(self, args: argparse.Namespace):
        self.args, self.chain = args, chain_of(args)
        self.bound = self.chain

    def compared(self, progress: Share) -> Stages:
        return compared(self.chain, self.args.log, progress=progress)

    def diagnosed(self, news: Callable[[Any], None]) -> Diagnosed:
        return diagnosed(self.chain, self.args.log, 2, news=news)

    def again(self, diagnosis: Diagnosis) -> Diagnosed:
        return Diagnosed(self.chain, diagnosis, self.args.log)

    def extended(self, stage: Stage, effects: tuple[str, ...], tick: Callable[[], None]) -> StageDiagnosis:
        return extend_stage(stage, effects, tick)

    def learned(self, diagnosis: Diagnosis, progress: Share) -> Learned:
        before = options.machine_of(self.args).added
        return learned(self.chain, self.args.log, before, progress=progress, found=self.again(diagnosis))


class _OfSystem(Held):
    """A system of the user's own."""

    def __init__(self, args: argparse.Namespace, system: System):
        self.added = load_model_of(args.model, system) if args.model else None
        logs, fit, test = own_model.logs_of(args, system)
        self.logs, self.log = logs_for(logs, system, fit, test, self.added)
        self.bound = self.logs.fitted

    def compared(self, progress: Share) -> Stages:
        return compared_system(self.logs, self.log, self.added)

    def diagnosed(self, news: Callable[[Any], None]) -> Diagnosed:
        return diagnosed_system(self.logs, self.log, self.added, news=news)

    def again(self, diagnosis: Diagnosis) -> Diagnosed:
        by_log = ByLog.of(self.logs, diagnosis.stages[0], self.added)
        return Diagnosed(self.bound, diagnosis, self.log, by_log)

    def extended(self, stage: Stage, effects: tuple[str, ...], tick: Callable[[], None]) -> StageDiagnosis:
        return extend_stage(stage, effects, tick, RelativeErrorAcceptance)

    def learned(self, diagnosis: Diagnosis, progress: Share) -> Learned:
        return learned_system(self.again(diagnosis), self.added, progress)


def system_of(args: argparse.Namespace) -> System | None:
    """The user's model that ``args`` name; its code runs here. None: they name none."""
    return load_system(args.system) if own_model.asked(args) else None


def held(args: argparse.Namespace, say: Callable[[str], None]) -> Held:
    """Read the log that ``args`` name, and hold it against the model that they name."""
    if (system := system_of(args)) is not None:
        say("reading the log, fitting the model to it")
        return _OfSystem(args, system)
    warm_up(say)
    say("reading the log")
    tell_search(say)
    return _OfMachine(args)
