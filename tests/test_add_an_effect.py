"""docs/add_an_effect.md, done in a copy of the sources exactly as it says: the effect acts everywhere and is found."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import ROOT

PAGE = (ROOT / "docs" / "add_an_effect.md").read_text(encoding="utf-8")
COPIED = (
    "controller", "plant", "hil", "vaneloop", "tables", "tests", "benchmarks", "examples", "docs/effects.md",
    "pyproject.toml",
)  # fmt: skip
JUNK = shutil.ignore_patterns("__pycache__", "ahead")


def blocks(kind: str) -> list[str]:
    """Text of the page's blocks of a kind."""
    return re.findall(rf"^```{kind}\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)


def applied(folder: Path, diff: str) -> list[str]:
    """Put the lines that a diff of the page adds behind the line it shows, in the place it names; return the files."""
    changed = []
    for name, where, body in re.findall(r"^@@ (\S+), (.+)\n((?:(?!@@).*\n)+)", diff, re.MULTILINE):
        file = folder / name
        lines = file.read_text(encoding="utf-8").splitlines()
        at = next(i for i, line in enumerate(lines) if line.startswith(where))
        for line in body.splitlines():
            if line.startswith("+"):
                at += 1
                lines.insert(at, line[1:])
            else:
                at = lines.index(line[1:], at)
        file.write_text("\n".join(lines) + "\n", encoding="utf-8")
        changed.append(name)
    return changed


def test_an_effect_is_a_file_a_call_and_an_entry_in_a_table() -> None:
    """So few places: this is what the page promises."""
    files = [name for diff in blocks("diff") for name in re.findall(r"^@@ (\S+),", diff, re.MULTILINE)]
    assert files == ["plant/stem.py", "plant/stem.py", "tests/effect_table.py"]


@pytest.mark.slow
def test_the_page_adds_an_effect_that_acts_everywhere_and_is_found(gcc: str, tmp_path: Path) -> None:
    for name in COPIED:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, tmp_path / name, ignore=JUNK)
        else:
            (tmp_path / name).parent.mkdir(exist_ok=True)
            shutil.copy(ROOT / name, tmp_path / name)
    log, effect = blocks("python")
    (tmp_path / "warm_play.py").write_text(log, encoding="utf-8")
    (tmp_path / "plant" / "effects" / "play_temperature.py").write_text(effect, encoding="utf-8")
    for diff in blocks("diff"):
        applied(tmp_path, diff)
    environment = {**os.environ, "PYTHONPATH": str(tmp_path), "VANELOOP_AHEAD": str(tmp_path / "ahead")}
    environment.pop("VANELOOP_NOT_TESTED", None)  # where this run, and not the copy's, notes what it skips
    tests = [f"tests/test_effects.py::test_{claim}[play_temperature]" for claim in (
        "docstring_has_its_sections", "neutral_effect_is_an_exact_identity",
        "effect_shows_in_every_stage_it_declares_and_in_no_other",
    )]  # fmt: skip
    for words in (
        ["warm_play.py"], ["-m", "tests.added_effect", "warm_play.parquet"],
        ["-m", "pytest", "-q", "-n0", "-p", "no:cacheprovider", *tests],
    ):  # fmt: skip
        done = subprocess.run(
            [sys.executable, *words], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-3000:]
