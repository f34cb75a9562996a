"""The tests of a package against its mutants: which test runs which line, then each mutant against those tests,
quickest first.

Each mutant has a process of its own, forked where all tests are collected, in which only the changed function's code,
or number, is exchanged. What numba compiles is changed only where it runs uncompiled (NUMBA_DISABLE_JIT), where a
mutant costs no compiling; that both ways give the same bits is tested elsewhere. A process that uses much more
processor time than the tests do unchanged hangs: killed.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import inspect
import json
import os
import random
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from types import CodeType, FunctionType, MemberDescriptorType, ModuleType
from typing import Any

import pytest
from _pytest.outcomes import Failed

from .mutate import (
    DEFAULT,
    FIELD,
    FUNCTION,
    MODULE,
    PRODUCT,
    Mutant,
    derived_from,
    made_of,
    mentions,
    mutants_of,
    own_names,
    with_hits,
)

__all__ = ["ROOT", "Outcome", "Target", "run_target", "sample"]

ROOT = Path(__file__).resolve().parent.parent.parent
Lines = set[tuple[str, int]]
Costs = dict[str, tuple[float, Lines]]  # of each test: seconds of processor time, lines run
OURS = (*PRODUCT, "tests")
SURVIVED, KILLED, UNCHANGED_FAILED = 0, 10, 11
MEMORY = 8 << 30  # bytes of address space of a mutant
LEAST_SECONDS = 10.0  # of processor time that a mutant has, beside four times what its tests take unchanged
# A test that takes longer, with what it shares with others, is not run: one mutant may need a hundred tests.
LONGEST_TEST = 5.0  # s of processor time
# The quickest tests that reach a mutant, up to this: a survivor costs all of it, and a sample has hundreds of them.
MOST_SECONDS = 20.0  # of processor time
WAITS = 6.0  # times the processor time of a test may pass on the clock: it waits for others


@dataclass(frozen=True)
class Target:
    """Files, and the tests that belong to them.

    files, but  patterns relative to the root, and the names of those files that another target has
    tests       files of tests, relative to the root
    without     words (of `pytest -k`) of the tests that do not run here: too long uncompiled, or all in other processes
    functions, constants, only    what of the files is changed, see `mutants_of`
    compiled    the code runs compiled, so what numba compiles stays as it is
    kernels     it does not, and nothing else is changed
    enough      share of the mutants that the tests should kill
    thresholds  the names of those in the record of the identification's that are changed
    """

    name: str
    files: tuple[str, ...]
    tests: tuple[str, ...]
    without: str = ""
    functions: bool = True
    constants: bool = True
    only: str | None = None
    compiled: bool = False
    kernels: bool = False
    enough: float = 0.9
    but: tuple[str, ...] = ()
    thresholds: tuple[str, ...] = ()

    def paths(self) -> list[str]:
        """Every file, relative to the root."""
        found = [f for pattern in self.files for f in sorted(ROOT.glob(pattern)) if f.name not in self.but]
        found = [f for f in found if f.name not in ("__init__.py", "__main__.py") or "def " in f.read_text()]
        if not found:
            raise SystemExit(f"mutants: {', '.join(self.files)}: no such file")
        return [str(f.relative_to(ROOT)) for f in found]

    def mutants(self) -> list[Mutant]:
        """Every mutant of the files."""
        of = {n: getattr(self, n) for n in ("functions", "constants", "only", "compiled", "kernels")}
        found = [m for f in self.paths() for m in mutants_of(ROOT, f, **of)]
        return [m for m in found if m.file != SETTINGS or m.kind != MODULE or set(m.names) <= set(self.thresholds)]

    def digest(self) -> str:
        """Digest of all that decides which test runs which line."""
        h = hashlib.sha256(repr(dataclasses.astuple(self)).encode() + sys.version.encode())
        sources = [f for package in (*PRODUCT, "tables") for f in (ROOT / package).rglob("*") if f.suffix in SOURCES]
        helpers = [f for f in (ROOT / "tests").rglob("*.py") if not f.name.startswith("test_")]
        for f in sorted([*sources, *helpers, *(ROOT / t.split("::")[0] for t in self.tests)]):
            h.update(str(f).encode() + f.read_bytes())
        return h.hexdigest()


SETTINGS = "vaneloop/identification/settings.py"
SOURCES = {".py", ".toml", ".dbc", ".c", ".h", ".js", ".css"}


@dataclass(frozen=True)
class Outcome:
    """What became of a mutant: ``by`` is the test that killed it, "" = it survived; ``reached`` by some test."""

    mutant: Mutant
    by: str
    reached: bool = True


def sample(mutants: list[Mutant], n: int | None, seed: int) -> list[Mutant]:
    """Return ``n`` of the mutants, the same for the same seed: lines by chance, each with one of its mutants by chance,
    so that a line of many numbers counts as one.
    """
    if n is None:
        return [m for m in mutants if _compiles(m)]
    chance = random.Random(seed)
    order = chance.sample(range(len(mutants)), len(mutants))
    lines: dict[tuple[str, int], list[int]] = {}
    for i in order:
        lines.setdefault((mutants[i].file, mutants[i].line), []).append(i)
    each = [lines[line] for line in chance.sample(sorted(lines), len(lines))]
    chosen: set[int] = set()
    while len(chosen) < n and any(each):
        for of_line in filter(None, each):
            i = of_line.pop()
            if len(chosen) < n and _compiles(mutants[i]):
                chosen.add(i)
    return [m for i, m in enumerate(mutants) if i in chosen]


def _compiles(m: Mutant) -> bool:
    try:
        m.code()
    except SyntaxError:  # a name that is bound no more
        return False
    return True


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
        "--tb=native",  # looks for no source text
        "-m",
        "not slow",
    ]
    if target.without:
        arguments += ["-k", f"not ({target.without})"]
    code = pytest.main(arguments, plugins=[campaign])
    if campaign.failed or (code != 0 and not campaign.finished):
        raise SystemExit(f"mutants: {target.name}: {campaign.failed or 'the tests could not be collected'}")
    return campaign.outcomes


TOO_LONG = f"takes more than {LONGEST_TEST:.0f} s"


class _TooLong(Failed):
    """Ends a test that runs longer than `LONGEST_TEST`, and all that need the same fixture if that does."""


class _NoImport(Exception):
    """With this change the module cannot be imported."""


class _Campaign:
    def __init__(self, target: Target, chosen: list[Mutant], jobs: int, say: Callable[[Outcome], None]):
        self.target, self.chosen, self.jobs, self.say = target, chosen, jobs, say
        self.outcomes: list[Outcome] = []
        self.failed, self.finished = "", False
        self.hits: Lines = set()
        self.shared: dict[Any, tuple[float, Lines]] = {}  # of fixtures that serve many tests

    def pytest_collection(self) -> None:
        from hypothesis import Phase, settings

        phases = (Phase.explicit, Phase.generate)  # shrinking a failure would tell nothing here
        settings.register_profile(
            "mutants", max_examples=10, deadline=None, derandomize=True, database=None, phases=phases
        )
        settings.load_profile("mutants")
        with contextlib.suppress(ImportError):
            import tests.browser

            tests.browser.CHROMIUM = None  # what a browser asks the product is not asked in this process

    @pytest.hookimpl(hookwrapper=True)
    def pytest_fixture_setup(self, fixturedef: Any) -> Iterator[None]:
        """What a fixture of many tests runs, each of them reaches."""
        if fixturedef.scope == "function":
            yield
            return
        before, begin = set(self.hits), _processor_time()
        self.hits.clear()
        yield
        self.shared[fixturedef] = _processor_time() - begin, set(self.hits)
        self.hits |= before

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        items = [i for i in session.items if not any(mark.name == "skip" for mark in i.iter_markers())]
        modules = {file: _module(file) for file in self.target.paths()}
        costs = self._costs(items, modules)
        if not self.failed:
            self._mutants([i for i in items if i.nodeid in costs], modules, costs)
        self.finished = True
        return True

    def _costs(self, items: list[pytest.Item], modules: dict[str, ModuleType]) -> Costs:
        """Return the processor time of each test, and the lines that it runs: as kept from a run with the same sources
        and tests, else measured.
        """
        at = ROOT / "out" / "mutants" / f"{self.target.name}.json"
        digest = self.target.digest()
        found = json.loads(at.read_text()) if at.exists() else {}
        if found.get("digest") != digest:
            found = {"digest": digest, "files": list(modules), **self._measured(items, modules)}
            if found["costs"]:
                at.parent.mkdir(parents=True, exist_ok=True)
                new = at.with_suffix(f".{os.getpid()}")
                new.write_text(json.dumps(found))
                new.replace(at)
        for test, why in found["without"].items():
            print(f"{self.target.name}: without {test}: {why}", flush=True)
        if not found["costs"]:
            self.failed = "; ".join(["no test is left", *(f"{test}: {why}" for test, why in found["without"].items())])
        files = found["files"]
        return {test: (cost, {(files[f], n) for f, n in lines}) for test, (cost, lines) in found["costs"].items()}

    def _measured(self, items: list[pytest.Item], modules: dict[str, ModuleType]) -> dict[str, Any]:
        """Run the tests of each file unchanged: which lines they reach, and how long they take. Those that fail, take
        too long or reach no line are left out.
        """
        by_file: dict[str, list[pytest.Item]] = {}
        for item in items:
            by_file.setdefault(item.nodeid.split("::")[0], []).append(item)
        costs: dict[str, tuple[float, list[tuple[int, int]]]] = {}
        without: dict[str, str] = {}
        works: list[_Work] = [(f, partial(self._reached, of, modules), None) for f, of in by_file.items()]
        for file, said in _side_by_side(works, self.jobs):
            if not said.startswith("{"):
                without[file] = said or "its tests end the process"
                continue
            for test, (why, seconds, lines) in json.loads(said).items():
                if why:
                    without[test] = why
                elif lines:
                    costs[test] = seconds, lines
        return {"costs": costs, "without": without}

    def _reached(self, items: list[pytest.Item], modules: dict[str, ModuleType]) -> str:
        """Of each test: why it does not count, its processor time, and the lines that it runs: the place of a file, and
        a number.
        """
        forks = _HitsOfForks(self.hits)
        for file, module in modules.items():
            vars(module)["__hit__"] = forks
            for name, code in with_hits(ROOT, file, compiled=self.target.compiled):
                with contextlib.suppress(LookupError, AttributeError, TypeError, ValueError):
                    _function(module, name).__code__ = code
        at = {file: i for i, file in enumerate(modules)}
        seen = {}
        for item, following in zip(items, [*items[1:], None], strict=True):
            self.hits.clear()
            made, begin = set(self.shared), _processor_time()
            bad = _within(item, following)
            seconds = _processor_time() - begin - sum(s for f, (s, _) in self.shared.items() if f not in made)
            reached = self.hits | forks.told()
            for cost, lines in self._shared_by(item):
                seconds += cost
                reached |= lines
            if not bad and seconds > LONGEST_TEST:
                bad = TOO_LONG
            seen[item.nodeid] = bad, seconds, sorted((at[f], n) for f, n in reached)
        return json.dumps(seen)

    def _shared_by(self, item: pytest.Item) -> Iterable[tuple[float, Lines]]:
        found = getattr(item, "_fixtureinfo", None)
        for definitions in found.name2fixturedefs.values() if found else ():
            yield from (self.shared[d] for d in definitions if d in self.shared)

    def _mutants(self, items: list[pytest.Item], modules: dict[str, ModuleType], costs: Costs) -> None:
        by_cost = sorted(items, key=lambda item: costs[item.nodeid][0])
        of_name = mentions(ROOT, modules)
        words = {i.nodeid: _words_of(i) for i in items}

        def reaching(m: Mutant) -> list[pytest.Item]:
            lines = {(m.file, n) for n in range(m.line, m.last + 1)}
            known: frozenset[str] = frozenset()  # by which a test itself may read it
            if m.kind == DEFAULT:
                lines = of_name[f"{m.file} {m.where}"]
            elif m.kind in (MODULE, FIELD):
                lines = set().union(*(of_name.get(name, ()) for name in m.names))
                known = made_of(ROOT, m.file, m.names if m.kind == MODULE else (m.where,))
            anywhere = m.kind in (MODULE, FIELD) and not lines  # only others read it
            spent = 0.0
            out: list[pytest.Item] = []
            for item in by_cost:
                cost, run = costs[item.nodeid]
                if anywhere or run & lines or words[item.nodeid] & known:
                    spent += cost
                    if out and spent > MOST_SECONDS:
                        break
                    out.append(item)
            return out

        def decided(m: Mutant, by: str, reached: bool = True) -> None:
            self.outcomes.append(Outcome(m, by, reached))
            self.say(self.outcomes[-1])

        left = self.chosen
        while left:
            works: list[_Work] = []
            for m in left:
                found = reaching(m)
                if found:
                    limit = LEAST_SECONDS + 4.0 * sum(costs[i.nodeid][0] for i in found)
                    works.append((m, partial(_try, m, modules[m.file], found, costs), limit))
                else:
                    decided(m, "", reached=False)
            killed: dict[str, list[tuple[Mutant, str]]] = {}
            for m, by in _side_by_side(works, self.jobs):
                if test := next((i.nodeid for i in by_cost if by.startswith(f"{i.nodeid}: ")), ""):
                    killed.setdefault(test, []).append((m, by))
                else:
                    decided(m, by)
            # What fails alone and unchanged, too, tells nothing: its mutants are tried again without it.
            alone: list[_Work] = [
                (i, partial(_try, None, None, [i], costs), None) for i in by_cost if i.nodeid in killed
            ]
            left = []
            for item, bad in _side_by_side(alone, self.jobs):
                if bad:
                    print(f"{self.target.name}: without {item.nodeid}: alone it fails unchanged", flush=True)
                    by_cost.remove(item)
                    left += [m for m, _ in killed[item.nodeid]]
                else:
                    for m, by in killed[item.nodeid]:
                        decided(m, by)


class _HitsOfForks:
    """Notes a line that is run, also in a process that is forked off a test: that has the changed code, too."""

    def __init__(self, hits: Lines):
        self.hits, self.owner = hits, os.getpid()
        self.file = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115  # as long as this process
        self.read = 0

    def __call__(self, line: tuple[str, int]) -> None:
        if line not in self.hits:
            self.hits.add(line)
            if os.getpid() != self.owner:
                with contextlib.suppress(OSError):  # it may have closed what is not its own
                    self.file.write(f"{line[0]} {line[1]}\n".encode())

    def told(self) -> Lines:
        """Lines that forks have run since the last time."""
        data = os.pread(self.file.fileno(), os.fstat(self.file.fileno()).st_size - self.read, self.read)
        self.read += len(data)
        return {(file, int(n)) for file, n in (line.split() for line in data.decode().splitlines())}


def _words_of(item: pytest.Item) -> frozenset[str]:
    try:
        return frozenset(re.findall(r"\w+", inspect.getsource(getattr(item, "function"))))  # noqa: B009
    except (AttributeError, OSError, TypeError):  # a test that is no function
        return frozenset()


def _clock() -> float:
    """Seconds on the clock but those for which the processor served others: a busy machine makes no test late."""
    try:
        waited = float(Path("/proc/thread-self/schedstat").read_text().split()[1]) * 1e-9
    except (OSError, IndexError):  # a kernel that does not count
        waited = 0.0
    return time.monotonic() - waited


def _end_after(seconds: float, end: Callable[[], object]) -> None:
    """Call ``end`` once so many seconds of `_clock` have passed, and then every second."""
    until = _clock() + seconds

    def rings(*_: object) -> None:
        left = until - _clock()
        signal.setitimer(signal.ITIMER_REAL, max(left, 1.0))
        if left <= 0.0:
            end()

    signal.signal(signal.SIGALRM, rings)
    signal.setitimer(signal.ITIMER_REAL, seconds)


def _ended_by_the_alarm() -> None:
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    os.kill(os.getpid(), signal.SIGALRM)


def _processor_time() -> float:
    of_children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + of_children.ru_utime + of_children.ru_stime


def _within(item: pytest.Item, following: pytest.Item | None) -> str:
    """Run a test unchanged; return why it failed, or that it took too long."""

    def late(*_: object) -> None:
        raise _TooLong(TOO_LONG)

    signal.signal(signal.SIGPROF, late)
    begin = _processor_time()
    signal.setitimer(signal.ITIMER_PROF, LONGEST_TEST, 1.0)
    _end_after(WAITS * LONGEST_TEST, late)
    try:
        bad = _failure(item, following)
    except _TooLong:
        bad = TOO_LONG
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.setitimer(signal.ITIMER_REAL, 0.0)
    with contextlib.suppress(Exception):  # of what was stopped, something may still stand
        if bad:
            item.session._setupstate.teardown_exact(following)
    if bad and (TOO_LONG in bad or _processor_time() - begin > LONGEST_TEST):
        return TOO_LONG
    return bad and f"fails without any change: {bad}"


_Work = tuple[Any, Callable[[], str], float | None]  # whose, what is done, within how much processor time


def _side_by_side(works: list[_Work], jobs: int) -> Iterator[tuple[Any, str]]:
    """Run each in a process of its own, as many at a time as there are jobs; yield whose it is and what it said."""
    running: dict[int, tuple[_Child, Any]] = {}
    left = works[::-1]
    while left or running:
        while left and len(running) < jobs:
            whose, work, seconds = left.pop()
            child = _Child(work, seconds)
            running[child.pid] = child, whose
        pid, status = os.wait()
        if pid in running:
            child, whose = running.pop(pid)
            yield whose, child.verdict(status)


class _Child:
    """A forked process that runs ``work`` silently, in a folder and a group of its own, and writes what it returns."""

    def __init__(self, work: Callable[[], str], seconds: float | None):
        self.folder = Path(tempfile.mkdtemp(prefix="mutant-"))
        self.at = self.folder / "said"
        sys.stdout.flush()
        self.pid = os.fork()
        if self.pid:
            return
        status, said = UNCHANGED_FAILED, ""
        try:
            os.setpgid(0, 0)
            signal.signal(signal.SIGINT, signal.SIG_DFL)
            os.environ["TMPDIR"] = os.environ["PYTEST_DEBUG_TEMPROOT"] = tempfile.tempdir = str(self.folder)
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
            if seconds is not None:
                resource.setrlimit(resource.RLIMIT_CPU, (int(seconds) + 1, int(seconds) + 5))
                resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
            nowhere = os.open(os.devnull, os.O_RDWR)
            for stream in range(3):
                os.dup2(nowhere, stream)
            said = work()
            status = KILLED if said else SURVIVED
        except BaseException:  # what a test raises, pytest has caught: this is a defect here
            said = traceback.format_exc()[-2000:]
        finally:
            with contextlib.suppress(OSError):
                self.at.write_text(said)
            os._exit(status)

    def verdict(self, status: int) -> str:
        """Return what killed the mutant, "" if nothing did; whatever it started ends with it."""
        with contextlib.suppress(OSError):
            os.killpg(self.pid, signal.SIGKILL)
        code, said = os.waitstatus_to_exitcode(status), self.at.read_text() if self.at.exists() else ""
        shutil.rmtree(self.folder, ignore_errors=True)
        if code in (SURVIVED, KILLED):
            return said
        if code == UNCHANGED_FAILED:
            raise SystemExit(f"mutants: {said}")
        return f"{signal.Signals(-code).name}: no end, or no memory" if code < 0 else f"exit {code}"


def _failure(item: pytest.Item, following: pytest.Item | None) -> str:
    from _pytest.runner import runtestprotocol

    try:
        reports = runtestprotocol(item, log=False, nextitem=following)
    except KeyboardInterrupt:  # pytest passes it on; here only the test itself can have raised it
        return f"{item.nodeid}: KeyboardInterrupt"
    for report in reports:
        if report.failed:
            return f"{item.nodeid}: {str(report.longrepr).strip().splitlines()[-1]}"
    return ""


def _try(m: Mutant | None, module: ModuleType | None, items: list[pytest.Item], costs: Costs) -> str:
    """Run the tests with this change, or none; return which fails, and why."""
    if m is None or module is None:
        pass
    elif m.kind == FUNCTION:
        _function(module, m.where).__code__ = m.code()
    else:
        try:
            _put(module, m.kind, m.where, m.names, m.code())
        except _NoImport as e:
            return f"import: {e}"
    for item, following in zip(items, [*items[1:], None], strict=True):
        _end_after(WAITS * (LEAST_SECONDS + costs[item.nodeid][0]), _ended_by_the_alarm)
        bad = _failure(item, following)
        if bad:
            return bad
    return ""


def _module(file: str) -> ModuleType:
    import importlib

    return importlib.import_module(file.removesuffix(".py").removesuffix("/__init__").replace("/", "."))


def _owner(module: ModuleType, name: str) -> Any:
    place: Any = module
    for owner in name.split("."):
        place = getattr(place, owner)
    return place


def _function(module: ModuleType, name: str) -> FunctionType:
    owner, _, last = name.removesuffix(".setter").rpartition(".")
    found = vars(_owner(module, owner) if owner else module)[last]
    if isinstance(found, property):
        found = found.fset if name.endswith(".setter") else found.fget
    elif isinstance(found, (staticmethod, classmethod)):
        found = found.__func__
    elif isinstance(found, cached_property):
        found = found.func
    while hasattr(found, "__wrapped__"):
        found = found.__wrapped__
    if not isinstance(found, FunctionType):
        raise TypeError(name)
    return found


def _put(module: ModuleType, kind: str, where: str, names: tuple[str, ...], code: CodeType) -> None:
    """Give the constants, the field or the argument the values that ``code`` gives their names; then the same for all
    that is made of them, in every module that has them by these names.
    """
    space = {**vars(module), **(vars(_owner(module, where)) if kind == FIELD else {})}
    try:
        exec(code, space)  # noqa: S102
    except Exception as e:
        raise _NoImport(f"{type(e).__name__}: {e}") from e
    if kind == DEFAULT:
        _set_default(_function(module, where), names[0], space[names[0]])
        return
    if kind == FIELD:
        owner = _owner(module, where)
        for name in names:
            _set_field(owner, name, space[name])
        names, changed = (where,), {where: (owner, owner)}  # what was made of the class has the default that it had
    else:
        changed = {n: (vars(module)[n], space[n]) for n in names}
    for loaded in [m for n, m in list(sys.modules.items()) if n.split(".")[0] in OURS or m is module]:
        held = {n for n, (old, _) in changed.items() if n in vars(loaded) and _is_same(vars(loaded)[n], old)}
        path = Path(getattr(loaded, "__file__", None) or ROOT.parent)
        file = str(path.relative_to(ROOT)) if held and path.is_relative_to(ROOT) else ""
        if file and loaded is not module:
            held -= own_names(ROOT, file)  # another constant of the same name
        for name in held:
            vars(loaded)[name] = changed[name][1]
        if held and file:
            for d in derived_from(ROOT, file):
                if d.reads & held and not set(d.names) & set(names):
                    with contextlib.suppress(LookupError, AttributeError, TypeError, ValueError):  # of compiled code
                        _put(loaded, d.kind, d.where, d.names, d.code)


def _is_same(a: Any, b: Any) -> bool:
    return a is b or (type(a) is type(b) and isinstance(a, (int, float, str)) and a == b)


def _set_default(function: Any, name: str, value: Any) -> None:
    if name in (function.__kwdefaults__ or ()):
        function.__kwdefaults__[name] = value
        return
    code = function.__code__
    arguments = code.co_varnames[: code.co_argcount]
    defaults = list(function.__defaults__ or ())
    if name in arguments[len(arguments) - len(defaults) :]:  # else a subclass takes it otherwise
        defaults[arguments.index(name) - len(arguments)] = value
        function.__defaults__ = tuple(defaults)


def _set_field(owner: Any, name: str, value: Any) -> None:
    """Give a field of a class another default, also in the classes that have it from there."""
    for sub in owner.__subclasses__():
        if name not in vars(sub).get("__annotations__", ()):
            _set_field(sub, name, value)
    if fields := getattr(owner, "model_fields", None):  # pydantic checks by what it made of the fields
        fields[name].default = value
        owner.model_rebuild(force=True)
    elif name in getattr(owner, "_field_defaults", ()):
        owner._field_defaults[name] = value
        _set_default(owner.__new__, name, value)
    else:
        if name in getattr(owner, "__dataclass_fields__", ()):
            owner.__dataclass_fields__[name].default = value
            _set_default(owner.__init__, name, value)
        if not isinstance(vars(owner).get(name), MemberDescriptorType):
            setattr(owner, name, value)
