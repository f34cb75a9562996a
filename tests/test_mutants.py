"""`make mutants` itself: what it changes, what it finds out, and that its list of equivalent mutants is up to date."""

from __future__ import annotations

import importlib
import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from benchmarks.settings import record
from tests.conftest import ROOT
from tests.mutants import campaign as trial
from tests.mutants.__main__ import ENOUGH, STRICT, TARGETS
from tests.mutants.campaign import SETTINGS
from tests.mutants.mutate import PRODUCT, made_of, mutants_of

TINY = '''
from dataclasses import dataclass

LIMIT = 4.0
N = 2
TWICE = 2 * LIMIT


def over(x, low):
    """Text."""
    if x > LIMIT and not low:
        return -x
    n = 0
    while n < N:
        n += 1
    return max(x, n)


def unused(x):
    return x + 1


def stop(asked):
    if asked > 0:
        raise KeyboardInterrupt


@dataclass
class Range:
    """Text."""

    low: float = -1.0

    def has(self, x, by=0.5, *, none=False):
        """Text."""
        try:
            return x is not None and x not in (self.low, by, none) and x < TWICE
        except TypeError:
            return 7


@dataclass
class Wider(Range):
    def __init__(self, low):
        super().__init__(low)


@compiled
def fast(x):
    return x + SIZE


SIZE = 3
'''
# What stands beside the program's own decorators, for numba is not needed here.
TINY = TINY.replace("LIMIT =", "compiled = lambda f: f\nLIMIT =", 1)
TESTS = """
import tiny

def test_over():
    assert tiny.over(5.0, False) == -5.0 and tiny.over(5.0, True) == 5.0 and tiny.over(4.5, False) == -4.5
    tiny.stop(0)
    assert tiny.over(3.9, False) == 3.9 and tiny.over(-9, False) == 2 and tiny.over(2.5, False) == 2.5

def test_range():
    r = tiny.Range()
    assert r.low == -1.0 and r.has(1.0) and r.has(7.9) and r.has("x") == 7 and tiny.Wider(3.0).low == 3.0
    assert not any(r.has(x) for x in (None, -1.0, 0.5, False, 8.0)) and tiny.over(4.1, False) < 0.0
"""


def test_every_operator_number_and_statement_is_changed_once(tmp_path: Path) -> None:
    (tmp_path / "tiny.py").write_text(TINY)
    found = {m.name.split(": ", 1)[1] for m in mutants_of(tmp_path, "tiny.py")}
    assert found >= {
        "`LIMIT = 4.0` -> `LIMIT = 3.2`", "`LIMIT = 4.0` -> `LIMIT = 5.0`", "`N = 2` -> `N = 3`",
        "`if x > LIMIT and (not low)` -> `if x >= LIMIT and (not low)`", "`if x > LIMIT and (not low)` -> `if x <= "
                                                                         "LIMIT and (not low)`",
        "`if x > LIMIT and (not low)` -> `if x > LIMIT or not low`", "`if x > LIMIT and (not low)` -> `if x > LIMIT "
                                                                     "and low`",
        "`return -x` -> `return x`", "`while n < N` -> `while n >= N`", "`n += 1` -> `n -= 1`", "`n += 1` -> `n += 2`",
        "`n += 1` -> `pass`",
        "`return max(x, n)` -> `return min(x, n)`", "`return x + 1` -> `return x - 1`", "`low: float = -1.0` -> `low: "
                                                                                        "float = 1.0`",
        "`by=0.5` -> `by=0.625`", "`none=False` -> `none=True`", "`return 7` -> `return 8`", "`SIZE = 3` -> `SIZE = 4`",
        "`return x + SIZE` -> `return x - SIZE`", "`super().__init__(low)` -> `pass`",
    }  # fmt: skip
    says = "return x is not None and x not in (self.low, by, none) and (x < TWICE)"
    for was, becomes in (("is not", "is"), ("not in", "in"), ("x < ", "x <= ")):
        assert f"`{says}` -> `{says.replace(was, becomes, 1)}`" in found
    for m in mutants_of(tmp_path, "tiny.py"):
        assert m.code() and m.line > 1  # each compiles


def test_a_type_is_no_number(tmp_path: Path) -> None:
    """Pydantic's classes keep what was made of it: another one in its place would change nothing."""
    (tmp_path / "typed.py").write_text("Share = Annotated[float, Field(gt=0.0, le=1.0)]\nSIZE = 3\n")
    assert [m.becomes for m in mutants_of(tmp_path, "typed.py")] == ["SIZE = 4"]


def test_a_length_that_numpy_finds_out_is_no_number(tmp_path: Path) -> None:
    (tmp_path / "shaped.py").write_text("def f(x):\n    return x.reshape(2, -1)\n")
    assert [m.becomes for m in mutants_of(tmp_path, "shaped.py")] == [
        "return x.reshape(3, -1)", "return x.reshape(2, 1)",
    ]  # fmt: skip


def test_what_runs_compiled_stays_as_it_is_and_so_do_the_numbers_that_it_reads(tmp_path: Path) -> None:
    for package in ("controller", "hil"):
        (tmp_path / package).mkdir()
    (tmp_path / "hil" / "tiny.py").write_text(TINY)
    every, plain, kernels = (
        {m.name for m in mutants_of(tmp_path, "hil/tiny.py", compiled=compiled, kernels=kernels)}
        for compiled, kernels in ((False, False), (True, False), (False, True))
    )
    assert every == plain | kernels and not plain & kernels
    assert {n.split(" ", 1)[1] for n in kernels} == {
        "fast: `return x + SIZE` -> `return x - SIZE`", "module: `SIZE = 3` -> `SIZE = 4`",
    }  # fmt: skip


def test_every_file_of_the_product_belongs_to_a_target_and_its_tests_are_there() -> None:
    covered = {f for t in TARGETS for f in t.paths()}
    files = {str(f.relative_to(ROOT)) for package in PRODUCT for f in (ROOT / package).rglob("*.py")}
    of_users = {f for f in files if f.startswith("vaneloop/templates/")}
    left = files - covered - of_users
    assert not [f for f in left if not f.endswith(("__init__.py", "__main__.py")) or "def " in (ROOT / f).read_text()]
    assert not [t for target in TARGETS for t in target.tests if not (ROOT / t.split("::")[0]).is_file()]
    assert {t.enough for t in TARGETS} == {ENOUGH, STRICT}


def test_every_threshold_of_the_identification_belongs_to_the_rooms_that_read_it() -> None:
    rooms = [t for t in TARGETS if t.name.startswith("vaneloop.identification")]
    assert {name for t in rooms for name in t.thresholds} == {s.name for s in record()}
    assert all(SETTINGS in t.paths() for t in rooms if t.thresholds)
    (selection,) = (t for t in rooms if t.name == "vaneloop.identification.selection")
    assert "NATS" in selection.thresholds and "REGIME_BINS" not in selection.thresholds


def test_what_a_module_makes_of_a_class_is_made_anew_with_a_field_s_other_default(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "made.py").write_text(
        "from dataclasses import dataclass\n\n@dataclass\nclass Range:\n    low: float = -1.0\n    high: float = 2.0\n"
        "\nUSUAL = Range()\nHIGH = Range(high=9.0)\nBOTH = (USUAL, HIGH)\n"
    )
    monkeypatch.setattr(trial, "ROOT", tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    made: Any = importlib.import_module("made")
    assert made_of(tmp_path, "made.py", ("Range",)) == {"Range", "USUAL", "HIGH", "BOTH"}
    (m,) = (m for m in mutants_of(tmp_path, "made.py") if m.becomes == "low: float = 1.0")
    trial._put(made, m.kind, m.where, m.names, m.code())
    assert [(r.low, r.high) for r in (made.Range(), *made.BOTH)] == [(1.0, 2.0), (1.0, 2.0), (1.0, 9.0)]


SCRIPT = """
import sys
from pathlib import Path
import tests.mutants.campaign as c
c.ROOT, c.LEAST_SECONDS, c.LONGEST_TEST = Path(sys.argv[1]), 1.0, 0.3
sys.path.insert(0, sys.argv[1])
t = c.Target("tiny", ("tiny.py",), ("test_tiny.py",))
chosen = [m for m in c.sample(t.mutants(), None, 1) if sys.argv[2] in m.name]
for o in c.run_target(t, chosen, 2, lambda o: None):
    print("#", bool(o.by), o.mutant.name)
    if not o.reached:
        print("@", o.mutant.name)
"""


def campaign(folder: Path, tests: str, only: str = "") -> subprocess.CompletedProcess[str]:
    (folder / "tiny.py").write_text(TINY)
    (folder / "test_tiny.py").write_text(tests)
    return subprocess.run(
        [sys.executable, "-c", SCRIPT, str(folder), only], cwd=ROOT, capture_output=True, text=True, check=False
    )


@pytest.mark.slow
def test_a_campaign_tells_the_killed_from_the_survivors_and_ends_endless_loops(tmp_path: Path) -> None:
    run = campaign(tmp_path, TESTS)
    assert run.returncode == 0, run.stderr
    killed = {
        line.split(": ", 1)[1]: line.startswith("# True") for line in run.stdout.splitlines() if line.startswith("#")
    }
    assert killed["`if asked > 0` -> `if asked >= 0`"]  # what it raises is the end of a run of pytest
    assert killed["`n += 1` -> `pass`"] and killed["`n += 1` -> `n -= 1`"]  # these never end
    never = {
        "`return x + 1` -> `return x - 1`", "`return x + 1` -> `return x + 2`",
        "`return x + SIZE` -> `return x - SIZE`", "`SIZE = 3` -> `SIZE = 4`",
    }  # fmt: skip
    assert {line.split(": ", 1)[1] for line in run.stdout.splitlines() if line.startswith("@")} == never
    survivors = {name for name, dead in killed.items() if not dead}
    assert survivors == {
        "`if x > LIMIT and (not low)` -> `if x >= LIMIT and (not low)`",  # nobody asks at the limit itself
        *never,  # nobody asks at all
        "`n = 0` -> `n = 1`", "`n += 1` -> `n += 2`",  # no difference
        "`if asked > 0` -> `if asked > 1`",
    }  # fmt: skip


ALONE = """
seen = []

def test_first():
    seen.append(1)

def test_second():
    assert seen and tiny.over(5.0, False) == -5.0
"""


def test_a_test_that_fails_alone_kills_nothing(tmp_path: Path) -> None:
    run = campaign(tmp_path, "import tiny\n" + ALONE, "return -x")
    assert (
        run.returncode == 0
        and "# False" in run.stdout
        and "# True" not in run.stdout
        and "alone it fails unchanged" in run.stdout
    )


def test_what_waits_for_a_processor_is_not_late(monkeypatch: pytest.MonkeyPatch) -> None:
    now, ended, before = [100.0], [], signal.getsignal(signal.SIGALRM)
    monkeypatch.setattr(trial, "_clock", lambda: now[0])
    try:
        trial._end_after(30.0, lambda: ended.append(now[0]))
        rings: Any = signal.getsignal(signal.SIGALRM)
        for now[0] in (100.0, 129.9, 130.0, 131.0):
            rings()
            assert signal.getitimer(signal.ITIMER_REAL)[0] > 0.0  # it asks again
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
    assert ended == [130.0, 131.0]


SLOW = """
@pytest.fixture(scope="module")
def slow():
    begin = time.process_time()
    while time.process_time() < begin + 0.4:
        pass

def test_first(slow):
    assert tiny.over(5.0, False) == -5.0

def test_second(slow):
    assert tiny.over(5.0, False) == -5.0

def test_third():
    assert tiny.over(5.0, False) == -5.0
"""


@pytest.mark.slow
def test_what_takes_too_long_is_left_out_with_all_that_needs_it(tmp_path: Path) -> None:
    run = campaign(tmp_path, "import pytest, time, tiny\n" + SLOW, "return -x")
    assert run.returncode == 0 and "# True tiny.py over: `return -x` -> `return x`" in run.stdout
    assert re.findall(r"without test_tiny.py::(\w+): takes more", run.stdout) == ["test_first", "test_second"]


@pytest.mark.slow
def test_a_campaign_whose_tests_fail_unchanged_says_so(tmp_path: Path) -> None:
    run = campaign(tmp_path, "def test_wrong():\n    assert False\n")
    assert run.returncode != 0 and "fails without any change" in run.stderr and "test_wrong" in run.stderr


@pytest.mark.slow
def test_every_equivalent_mutant_listed_is_one_and_has_a_reason() -> None:
    import tomllib

    entries = tomllib.loads((ROOT / "tests" / "mutants" / "equivalent.toml").read_text())["equivalent"]
    files = {name.split(" ")[0] for e in entries for name in e["mutants"]}
    known = {m.name for f in files for m in mutants_of(ROOT, f)}
    for e in entries:
        assert len(e["reason"]) > 20
        assert set(e["mutants"]) <= known, set(e["mutants"]) - known


@pytest.mark.parametrize("options", [["nothing"], ["--sample", "many"]])
def test_a_target_that_is_not_there_is_refused(options: list[str]) -> None:
    run = subprocess.run(
        [sys.executable, "-m", "tests.mutants", *options], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert run.returncode == 2 and "Traceback" not in run.stderr


def test_a_line_that_a_fork_runs_is_noted() -> None:
    hits: set[tuple[str, int]] = {("a.py", 1)}
    note = trial._HitsOfForks(hits)
    note(("a.py", 2))
    assert note.told() == set()
    for line in (3, 4):
        if os.fork() == 0:
            note(("a.py", 1))
            note(("b.py", line))
            os._exit(0)
        os.wait()
        assert note.told() == {("b.py", line)}
    assert hits == {("a.py", 1), ("a.py", 2)}
