"""What a test costs is in the JUnit report, and the table in CONTRIBUTING.md counts it once."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests import conftest, costs
from tests.conftest import LONG, ROOT, longest_first

CASE = (
    '<testcase><properties><property name="file" value="{}"/><property name="cpu_s" value="{}"/></properties>{}'
    "</testcase>"
)


def report(file: Path, *cases: tuple[str, float, str]) -> Path:
    file.write_text(f"<testsuites>{''.join(CASE.format(*case) for case in cases)}</testsuites>")
    return file


def test_dear_files_come_first_and_cheap_ones_are_one_row(tmp_path: Path) -> None:
    quick = report(tmp_path / "q.xml", ("tests/test_a.py", 4.0, ""), ("tests/test_b.py", 1.0, ""),
                   ("tests/test_c.py", 2.0, ""), ("tests/test_c.py", 0.0, "<skipped/>"))  # fmt: skip
    long = report(tmp_path / "l.xml", ("tests/test_a.py", 7.0, ""), ("tests/test_d.py", 50.0, ""))
    assert costs.table({"quick": quick, "long": long}).splitlines()[2:] == [
        "| `test_d.py` | | | 1 | 50 |",
        "| `test_a.py` | 1 | 4 | 1 | 7 |",
        "| 2 others | 2 | 3 | | |",
        "| all | 3 | 7 | 2 | 57 |",
    ]


def test_a_run_reports_what_its_tests_and_their_children_took(tmp_path: Path) -> None:
    burn = "import time\\nwhile time.process_time() < 1.0: pass"
    (tmp_path / "conftest.py").write_text("from tests.conftest import pytest_runtest_setup, pytest_runtest_teardown\n")
    (tmp_path / "test_it.py").write_text(
        "import subprocess, sys\n"
        "def test_idle(): pass\n"
        f'def test_child(): subprocess.run([sys.executable, "-c", "{burn}"], check=True)\n'
    )
    words = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--rootdir", tmp_path, "--junitxml"]
    subprocess.run([*words, tmp_path / "out.xml", tmp_path], cwd=ROOT, check=True, capture_output=True)
    idle, child = (seconds for _, seconds in costs.costs(tmp_path / "out.xml"))
    assert idle < 0.5 < child  # the clock of processes ticks in hundredths of a second


def test_the_page_has_a_place_for_the_table() -> None:
    page = (ROOT / costs.PAGE).read_text(encoding="utf-8")
    assert page.index(costs.BEGIN) < page.index(costs.END)


def test_each_worker_begins_with_long_modules_and_every_test_is_run_once() -> None:
    long = [name for group in LONG for name in group]
    assert len(set(long)) == len(long) and all((ROOT / f"tests/test_{name}.py").is_file() for name in long)
    modules = [f"tests.test_{name}" for name in ("a", "web", "docs", "b", "real_data", "rig", "web", "c", "a", "held")]
    for workers in (1, 2, 3, 4):
        order = longest_first(modules, workers)
        assert sorted(order) == list(range(len(modules)))
        assert all(
            modules[order[k * len(modules) // workers]] not in ("tests.test_a", "tests.test_c")
            for k in range(min(workers, 3))
        )


def test_what_is_shared_out_among_workers_are_the_tests_that_are_run(pytestconfig: pytest.Config) -> None:
    """An order of all tests, of which a mark then takes away nine in ten, has the long ones in the midst of a share."""
    last_first = pytestconfig.hook.pytest_collection_modifyitems.get_hookimpls()
    ours = next(k for k, one in enumerate(last_first) if one.function is conftest.pytest_collection_modifyitems)
    marks = next(k for k, one in enumerate(last_first) if one.plugin_name == "mark")
    assert ours < marks, "called before -m and -k have left out what is not run"
