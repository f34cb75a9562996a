"""The tests of a module against its mutants: which test runs which line, then each mutant against those tests, fastest
first.

The code runs uncompiled (NUMBA_DISABLE_JIT), where a mutant costs no compiling; that both ways give the same bits is
tested elsewhere. Each mutant has a process of its own, forked where all tests are collected, in which only the changed
function's code is exchanged. A process that uses much more processor time than the tests do unchanged hangs: killed.
"""

from __future__ import annotations

import json
import os
import random
import resource
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any

import pytest

from .mutate import Mutant, mutants_of, with_hits

__all__ = ["ROOT", "Outcome", "Target", "run_target"]

ROOT = Path(__file__).resolve().parent.parent.parent
Costs = dict[str, tuple[float, set[tuple[str, int]]]]  # of each test: seconds of processor time, lines run
OURS = ("controller", "plant", "hil", "vaneloop", "tests")
SURVIVED, KILLED, UNCHANGED_FAILED = 0, 10, 11
MEMORY = 8 << 30  # bytes of address space of a mutant
LEAST_SECONDS = 10.0  # of processor time that a mutant has, beside four times what its tests take unchanged


@dataclass(frozen=True)
class Target:
    """Files, and the tests that belong to them.

    tests     files of tests, relative to the root
    without   words (of `pytest -k`) of the tests that take too long uncompiled, or need what is not there
    functions, constants, only    what of the files is changed, see `mutants_of`
    """

    name: str
    files: tuple[str, ...]
    tests: tuple[str, ...]
    without: str = ""
    functions: bool = True
    constants: bool = True
    only: str | None = None

    def mutants(self) -> list[Mutant]:
        """Every mutant of the files."""
        found = [f for pattern in self.files for f in sorted(ROOT.glob(pattern)) if f.name != "__init__.py"]
        if not found:
            raise SystemExit(f"mutants: {', '.join(self.files)}: no such file")
        of = {"functions": self.functions, "constants": self.constants, "only": self.only}
        return [m for f in found for m in mutants_of(ROOT, str(f.relative_to(ROOT)), **of)]  # type: ignore[arg-type]


@dataclass(frozen=True)
class Outcome:
    """What became of a mutant: ``by`` is the test that killed it, "" = it survived."""

    mutant: Mutant
    by: str


def sample(mutants: list[Mutant], n: int | None, seed: int) -> list[Mutant]:
    """Return ``n`` of the mutants, the same for the same seed."""
    if n is None or n >= len(mutants):
        return mutants
    chosen = set(random.Random(seed).sample(range(len(mutants)), n))
    return [m for i, m in enumerate(mutants) if i in chosen]


def run_target(target: Target, chosen: list[Mutant], jobs: int, say: Callable[[Outcome], None]) -> list[Outcome]:
    """Run the mutants in processes of their own; call ``say`` as each is decided."""
    os.chdir(ROOT)
    campaign = _Campaign(target, chosen, jobs, say)
    arguments = [
        *target.tests,
        "-q",
        "--no-header",
        "-p",
        "no:cacheprovider",
        "-s",
        "--disable-warnings",
        "-m",
        "not slow",
    ]
    if target.without:
        arguments += ["-k", f"not ({target.without})"]
    code = pytest.main(arguments, plugins=[campaign])
    if campaign.failed or (code != 0 and not campaign.finished):
        raise SystemExit(f"mutants: {target.name}: {campaign.failed or 'the tests could not be collected'}")
    return campaign.outcomes


class _Campaign:
    def __init__(self, target: Target, chosen: list[Mutant], jobs: int, say: Callable[[Outcome], None]):
        self.target, self.chosen, self.jobs, self.say = target, chosen, jobs, say
        self.outcomes: list[Outcome] = []
        self.failed, self.finished = "", False

    def pytest_collection(self) -> None:
        from hypothesis import Phase, settings

        phases = (Phase.explicit, Phase.generate)  # shrinking a failure would tell nothing here
        settings.register_profile(
            "mutants", max_examples=10, deadline=None, derandomize=True, database=None, phases=phases
        )
        settings.load_profile("mutants")

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        if not session.items:
            self.failed = "no tests"
            return True
        modules = {m.file: _module(m.file) for m in self.chosen}
        costs = self._unchanged(session, modules)
        if not self.failed:
            self._mutants(session, modules, costs)
        self.finished = True
        return True

    def _unchanged(self, session: pytest.Session, modules: dict[str, ModuleType]) -> Costs:
        """Run every test unchanged; return the processor time and the lines of each."""
        at = Path(tempfile.mkstemp(suffix=".json")[1])

        def work() -> str:
            hits: set[tuple[str, int]] = set()
            for file, module in modules.items():
                vars(module)["__hit__"] = hits.add
                for name, code in with_hits(ROOT, file):
                    _function(module, name).__code__ = code
            out = {}
            for item, following in zip(session.items, [*session.items[1:], None], strict=True):
                hits.clear()
                begin = time.process_time()
                bad = _failure(item, following)
                if bad:
                    return bad
                out[item.nodeid] = [time.process_time() - begin, sorted(hits)]
            at.write_text(json.dumps(out))
            return ""

        child = _Child(work, None)
        status = child.wait()
        if status != SURVIVED:
            self.failed = f"a test fails without any change: {child.said()}"
            return {}
        costs = {k: (v[0], {(f, n) for f, n in v[1]}) for k, v in json.loads(at.read_text()).items()}
        at.unlink()
        return costs

    def _mutants(self, session: pytest.Session, modules: dict[str, ModuleType], costs: Costs) -> None:
        by_cost = sorted(session.items, key=lambda item: costs[item.nodeid][0])
        running: dict[int, tuple[_Child, Mutant]] = {}
        left = list(self.chosen)
        while left or running:
            while left and len(running) < self.jobs:
                m = left.pop(0)
                lines = {(m.file, n) for n in range(m.line, m.last + 1)}
                items = [i for i in by_cost if not m.where or costs[i.nodeid][1] & lines]
                limit = LEAST_SECONDS + 4.0 * sum(costs[i.nodeid][0] for i in items)
                child = _Child(lambda m=m, items=items: _try(m, modules[m.file], items), limit)
                running[child.pid] = child, m
            pid, status = os.wait()
            if pid in running:
                child, m = running.pop(pid)
                by = child.verdict(status)
                outcome = Outcome(m, by)
                self.outcomes.append(outcome)
                self.say(outcome)


class _Child:
    """A forked process that runs ``work`` silently; what it returns is in `said`."""

    def __init__(self, work: Callable[[], str], seconds: float | None):
        handle, name = tempfile.mkstemp()
        self.at = Path(name)
        sys.stdout.flush()
        self.pid = os.fork()
        if self.pid:
            os.close(handle)
            return
        status = UNCHANGED_FAILED
        try:
            signal.signal(signal.SIGINT, signal.SIG_DFL)
            if seconds is not None:
                resource.setrlimit(resource.RLIMIT_CPU, (int(seconds) + 1, int(seconds) + 5))
                resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
                resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, 1)
            os.dup2(nowhere, 2)
            said = work()
            os.write(handle, said.encode())
            status = KILLED if said else SURVIVED
        except BaseException:  # what a test raises, pytest has caught: this is a defect here
            os.write(handle, traceback.format_exc().encode()[-2000:])
        finally:
            os._exit(status)

    def wait(self) -> int:
        """Wait for its end; return its exit code, negative after a signal."""
        return os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])

    def verdict(self, status: int) -> str:
        """Return what killed the mutant, "" if nothing did."""
        code, said = os.waitstatus_to_exitcode(status), self.said()
        if code in (SURVIVED, KILLED):
            return said
        if code < 0:
            return f"{signal.Signals(-code).name}: no end, or no memory"
        raise SystemExit(f"mutants: {said}")

    def said(self) -> str:
        text = self.at.read_text(errors="replace")
        self.at.unlink(missing_ok=True)
        return text


def _failure(item: pytest.Item, following: pytest.Item | None) -> str:
    from _pytest.runner import runtestprotocol

    for report in runtestprotocol(item, log=False, nextitem=following):
        if report.failed:
            return f"{item.nodeid}: {str(report.longrepr).strip().splitlines()[-1]}"
    return ""


def _try(m: Mutant, module: ModuleType, items: list[pytest.Item]) -> str:
    try:
        code = m.code()
        if m.where:
            _function(module, m.where).__code__ = code
        else:
            _rebind(module, code)
    except Exception as e:  # noqa: BLE001
        return f"import: {type(e).__name__}: {e}"
    for i, item in enumerate(items):
        bad = _failure(item, items[i + 1] if i + 1 < len(items) else None)
        if bad:
            return bad
    return ""


def _module(file: str) -> ModuleType:
    import importlib

    return importlib.import_module(file.removesuffix(".py").replace("/", "."))


def _function(module: ModuleType, name: str) -> FunctionType:
    place: Any = module
    *owners, last = name.split(".")
    for owner in owners:
        place = getattr(place, owner)
    found = vars(place)[last]
    if isinstance(found, property):
        found = found.fget
    elif isinstance(found, (staticmethod, classmethod)):
        found = found.__func__
    while hasattr(found, "__wrapped__"):
        found = found.__wrapped__
    return found


def _rebind(module: ModuleType, code: CodeType) -> None:
    """Run the changed module aside, and give all that is loaded its new numbers, wherever the old ones are by the same
    name.
    """
    fresh: dict[str, Any] = {**{k: v for k, v in vars(module).items() if k.startswith("__")}}
    exec(code, fresh)  # noqa: S102
    changed = {}
    for name, new in fresh.items():
        old = vars(module).get(name)
        if not name.startswith("__") and _differs(old, new):
            changed[name] = old, new
    loaded_modules = [m for n, m in list(sys.modules.items()) if n.split(".")[0] in OURS and isinstance(m, ModuleType)]
    for loaded in [module, *(m for m in loaded_modules if m is not module)]:
        for name, (old, new) in changed.items():
            if name in vars(loaded) and not _differs(vars(loaded)[name], old):
                vars(loaded)[name] = new


def _differs(a: Any, b: Any) -> bool:
    import numpy as np

    if isinstance(a, np.ndarray):
        return not np.array_equal(a, b)
    plain = (int, float, str, tuple, dict, list)
    return isinstance(a, plain) and isinstance(b, plain) and repr(a) != repr(b)
