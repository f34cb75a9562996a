"""`make mutants` itself: what it changes, what it finds out, and that its list of equivalent mutants is up to date."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import ROOT
from tests.mutants.mutate import mutants_of

TINY = '''
LIMIT = 4.0
N = 2


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
'''
TESTS = """
import tiny

def test_over():
    assert tiny.over(5.0, False) == -5.0 and tiny.over(5.0, True) == 5.0 and tiny.over(4.5, False) == -4.5
    assert tiny.over(3.9, False) == 3.9 and tiny.over(-9, False) == 2 and tiny.over(2.5, False) == 2.5
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
        "`return max(x, n)` -> `return min(x, n)`", "`return x + 1` -> `return x - 1`",
    }  # fmt: skip
    for m in mutants_of(tmp_path, "tiny.py"):
        assert m.code() and m.line > 1  # each compiles


SCRIPT = """
import sys
from pathlib import Path
import tests.mutants.campaign as c
c.ROOT, c.LEAST_SECONDS = Path(sys.argv[1]), 1.0
sys.path.insert(0, sys.argv[1])
t = c.Target("tiny", ("tiny.py",), ("test_tiny.py",))
for o in c.run_target(t, t.mutants(), 2, lambda o: None):
    print("#", bool(o.by), o.mutant.name)
"""


def campaign(folder: Path, tests: str) -> subprocess.CompletedProcess[str]:
    (folder / "tiny.py").write_text(TINY)
    (folder / "test_tiny.py").write_text(tests)
    return subprocess.run(
        [sys.executable, "-c", SCRIPT, str(folder)], cwd=ROOT, capture_output=True, text=True, check=False
    )


@pytest.mark.slow
def test_a_campaign_tells_the_killed_from_the_survivors_and_ends_endless_loops(tmp_path: Path) -> None:
    run = campaign(tmp_path, TESTS)
    assert run.returncode == 0, run.stderr
    killed = {
        line.split(": ", 1)[1]: line.startswith("# True") for line in run.stdout.splitlines() if line.startswith("#")
    }
    assert killed["`n += 1` -> `pass`"] and killed["`n += 1` -> `n -= 1`"]  # these never end
    survivors = {name for name, dead in killed.items() if not dead}
    assert survivors == {
        "`if x > LIMIT and (not low)` -> `if x >= LIMIT and (not low)`",  # nobody asks at the limit itself
        "`return x + 1` -> `return x - 1`", "`return x + 1` -> `return x + 2`",  # nobody asks at all
        "`n = 0` -> `n = 1`", "`n += 1` -> `n += 2`",  # no difference
    }  # fmt: skip


def test_a_campaign_whose_tests_fail_unchanged_says_so(tmp_path: Path) -> None:
    run = campaign(tmp_path, "def test_wrong():\n    assert False\n")
    assert run.returncode != 0 and "fails without any change" in run.stderr and "test_wrong" in run.stderr


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
