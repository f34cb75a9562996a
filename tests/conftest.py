"""What every test may use: where the real logs are, a C compiler, and Hypothesis settings that suit compiled code."""

from __future__ import annotations

import contextlib
import gc
import importlib
import os
import shutil
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

from tests.vcan.run import INTERFACE, is_up

ROOT = Path(__file__).resolve().parent.parent

# The first call of a compiled function takes seconds, so no single example has a time limit. `make test-all` asks for
# the other profile (--hypothesis-profile thorough).
QUICK_EXAMPLES = 25
settings.register_profile("quick", deadline=None, print_blob=True, max_examples=QUICK_EXAMPLES)
settings.register_profile("thorough", deadline=None, print_blob=True, max_examples=100)
settings.register_profile("campaign", deadline=None, print_blob=True, max_examples=1000)  # asked for by hand
settings.load_profile("quick")


def examples(thorough: int) -> int:
    """How many examples a property is tried on that asks for more than a profile's own: all in `make test-all` only,
    ten times as many in a campaign.
    """
    profile = settings.get_current_profile_name()
    return min(thorough, QUICK_EXAMPLES) if profile == "quick" else thorough * (10 if profile == "campaign" else 1)


def quick_first(cases: Iterable[Any], quick: int = 1) -> list[Any]:
    """Cases of one kind for `parametrize`: `make test` runs the first, the others are left to `make test-all`."""
    return [
        case if n < quick else pytest.param(*(case if isinstance(case, tuple) else (case,)), marks=pytest.mark.slow)
        for n, case in enumerate(cases)
    ]


# Modules that use what a process makes once: the rig's loop, which numba keeps in no file; models of one's own; sources
# as syntax trees. One worker of xdist has them, one after the other.
WITH_THE_RIG = (
    "rig", "same_answer", "electromechanical", "learn_vanes", "readings", "strategies", "learn_periods", "long_logs",
    "loggers", "hidden_effect", "learn_stops", "machines", "schedule", "recorders", "directions", "tolerances",
    "rivals", "learn_lags", "learn_followers",
)  # fmt: skip
OF_ONES_OWN = (
    "your_own_model", "learn", "hidden_law", "learn_differences", "rig_learned", "own_laws", "learn_surfaces",
    "learn_speed", "doubts",
)  # fmt: skip
OF_SOURCES = ("structure", "writers", "child", "exit_codes", "extras", "settings")
# These and the other modules with the longest tests, longest first. Each worker begins with some of them, so that none
# is left for the end, when the others have nothing more to do.
LONG: tuple[tuple[str, ...], ...] = (
    ("real_data",), ("docs",), ("web",), ("help",), ("native",), ("fuzz",), ("logs_fuzz",), OF_ONES_OWN, WITH_THE_RIG,
    ("record",), ("reading",), ("fleet_report",), ("add_an_effect",), ("growth",), ("fleet_run",), ("realtime",),
    ("design",), ("effects",), ("search_commands",), OF_SOURCES, ("fmu",), ("kept",), ("held",), ("learn_turns",),
)  # fmt: skip


def longest_first(modules: list[str], workers: int) -> list[int]:
    """Order of tests, given by their modules, for workers that begin with an even share of them each, one after the
    other: each share begins with long modules.
    """
    shares: list[list[int]] = [[] for _ in range(workers)]
    for n, group in enumerate(LONG):
        turn = n % (2 * workers)  # there and back: 0, 1, 1, 0, ...
        for name in group:
            shares[min(turn, 2 * workers - 1 - turn)] += [i for i, m in enumerate(modules) if m == f"tests.test_{name}"]
    taken = {i for share in shares for i in share}
    rest = [i for i in range(len(modules)) if i not in taken]
    size = len(modules) // workers
    for share in shares[:-1]:
        missing = max(size - len(share), 0)
        share += rest[:missing]
        rest = rest[missing:]
    return [i for share in shares for i in share] + rest


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Skip what needs a CAN interface where there is none, except where the run is there for it (tests/vcan/run.py);
    give each worker of xdist long tests to begin with, of those that ``-m`` and ``-k`` leave: these are shared out.
    """
    if own := getattr(config, "workerinput", None):
        modules = [getattr(getattr(item, "module", None), "__name__", "") for item in items]
        items[:] = [items[i] for i in longest_first(modules, own["workercount"])]
    if os.environ.get("VANELOOP_NEED_VCAN") or is_up():
        return
    skip = pytest.mark.skip(reason=f"this kernel has no {INTERFACE}; `make test-can` boots one that has")
    for item in items:
        if item.get_closest_marker("socketcan"):
            item.add_marker(skip)


BEGAN = pytest.StashKey[tuple[float, float]]()


def spent() -> tuple[float, float]:
    """Processor time of this process and of children that have ended (s), and the wall clock (s)."""
    return sum(os.times()[:4]), time.monotonic()


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Note when a test began, also where no session runs it but `make mutants`."""
    item.stash[BEGAN] = spent()


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_teardown(item: pytest.Item) -> Generator[None, None, None]:
    """Tell the JUnit report what a test cost, its fixtures included (tests/costs.py)."""
    yield
    cpu, wall = (now - then for now, then in zip(spent(), item.stash[BEGAN], strict=True))
    item.user_properties += [("cpu_s", f"{cpu:.3f}"), ("wall_s", f"{wall:.3f}"), ("file", item.nodeid.split("::")[0])]


@pytest.hookimpl(tryfirst=True)
def pytest_collection(session: pytest.Session) -> None:
    """Workers of xdist that collect all tests share what pytest makes of a module once, the assertions that explain
    themselves: each begins with modules of its own. Else each of them would make all, which took 6 s of a processor.
    """
    own = getattr(session.config, "workerinput", None)
    if own is None or session.config.args != session.config.getini("testpaths"):
        return
    first = int(own["workerid"].removeprefix("gw")) % own["workercount"]
    for file in sorted((ROOT / "tests").glob("test_*.py"))[first :: own["workercount"]]:
        with contextlib.suppress(Exception, pytest.skip.Exception):  # collecting says what is wrong
            importlib.import_module(f"tests.{file.stem}")


def pytest_collection_finish() -> None:
    """What was imported and collected stays to the end: collections of garbage, 5 % of the time of tests that compile,
    need not look at it again and again.
    """
    gc.collect()
    gc.freeze()


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    """Write down what was skipped, and why, into the file VANELOOP_NOT_TESTED: the last lines of `make test-all` say it
    (tests/vcan/run.py).
    """
    if not (file := os.environ.get("VANELOOP_NOT_TESTED")) or hasattr(config, "workerinput"):
        return  # or a worker of xdist: its reports are the main process's too
    told: Counter[str] = Counter()
    for report in terminalreporter.stats.get("skipped", []):
        why = report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)
        told[f"{report.nodeid.split('::')[0]}: {why.removeprefix('Skipped: ')}"] += 1
    if "any_speed" in config.option.markexpr:
        for item in terminalreporter.stats.get("deselected", []):
            if item.get_closest_marker("socketcan") and not item.get_closest_marker("any_speed"):
                told[f"{item.nodeid.split('[')[0]}: would judge time, which says nothing on an emulated processor"] += 1
    with open(file, "a", encoding="utf-8") as out:
        out.writelines(f"{line}{f' ({n} tests)' if n > 1 else ''}\n" for line, n in told.items())


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Folder of the real logs: VANELOOP_DATA, or shared/data beside the checkout. Skips where there is none."""
    named = os.environ.get("VANELOOP_DATA")
    folder = Path(named) if named else ROOT.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"no real logs: {folder} is not a folder (set VANELOOP_DATA to the folder that holds them)")
    return folder


@pytest.fixture(scope="session")
def gcc() -> str:
    """Path of the C compiler. Skips where there is none."""
    found = shutil.which("gcc")
    if found is None:
        pytest.skip("no C compiler: gcc is not installed")
    return found


# A process that has imported asammdf and forks: each child reads files until one ends it, or so many are read, since
# forking takes four times as long as reading. Of each file it tells its exit status, 0 where there is an answer.
READS_MDF = """
import gc, io, os, signal, sys
import asammdf
from hil.logs.mdf_child import answer

FILES, ENDED = 25, 7
gc.freeze()
status = 0
while status != ENDED:
    pid = os.fork()
    if pid == 0:
        said, code = os.fdopen(os.dup(1), "wb", 0), 1
        os.dup2(2, 1)
        try:
            for _ in range(FILES):
                name, _, request = sys.stdin.buffer.readline().partition(b" ")
                if not name:
                    code = ENDED
                    break
                signal.alarm(20)
                with open(name, "wb") as out:
                    answer(request, out)
                signal.alarm(0)
                said.write(b"0\\n")
            else:
                code = 0
        finally:
            os._exit(code)
    status = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    if status not in (0, ENDED):
        os.write(1, b"%d\\n" % status)
"""


@pytest.fixture(scope="session")
def quick_child() -> Iterator[Callable[[bytes, float], bytes]]:
    """In place of a fresh interpreter a file: one that has imported asammdf and forks."""
    if not hasattr(os, "fork"):
        pytest.skip("needs fork")
    root = str(ROOT)
    process = subprocess.Popen(
        [sys.executable, "-c", READS_MDF],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        cwd=root,
        env={**os.environ, "PYTHONPATH": root},
    )
    assert process.stdin is not None and process.stdout is not None
    stdin, stdout = process.stdin, process.stdout
    reply = Path(os.environ.get("TMPDIR", "/tmp")) / f"vaneloop-mdf-{process.pid}"

    def child(request: bytes, seconds: float) -> bytes:
        stdin.write(str(reply).encode() + b" " + request)
        stdin.flush()
        status = int(stdout.readline())
        return reply.read_bytes() if status == 0 else b""

    yield child
    stdin.close()
    process.wait(30)
    reply.unlink(missing_ok=True)


@pytest.fixture
def quick_mdf(quick_child: Callable[[bytes, float], bytes], monkeypatch: pytest.MonkeyPatch) -> None:
    """Read MDF4 files through it: for tests that read many, and ask nothing of the reader's own process."""
    import hil.logs.mdf

    monkeypatch.setattr(hil.logs.mdf, "_child", quick_child)
