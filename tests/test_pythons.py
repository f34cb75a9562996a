"""Other Pythons are found where they are, and one that is not there is told and no failure."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from tests import pythons

OTHER = next(v for v in pythons.PYTHONS if v != f"{sys.version_info[0]}.{sys.version_info[1]}")


def program(path: Path, says: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!/bin/sh\n{says}\n", encoding="utf-8")
    path.chmod(0o755)


def test_a_shim_that_does_not_run_is_passed_over_for_pyenvs_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))
    program(tmp_path / "bin" / f"python{OTHER}", "exit 127")
    program(tmp_path / "bin" / "pyenv", f"echo {tmp_path / 'pyenv'}")
    wrong = tmp_path / "pyenv" / "versions" / f"{OTHER}.0" / "bin" / f"python{OTHER}"
    right = tmp_path / "pyenv" / "versions" / f"{OTHER}.1" / "bin" / f"python{OTHER}"
    program(wrong, "echo 3.6")
    program(right, f"echo {OTHER}")
    assert pythons.find_python(OTHER) == str(right)


def test_a_python_that_is_not_there_is_told_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    def none(version: str) -> str:
        raise LookupError("no such program")

    monkeypatch.setattr(pythons, "find_python", none)
    assert pythons.main() == 0
    assert f"!! not tested on Python {OTHER}: no such program\n" in capfd.readouterr().out


def test_tests_that_fail_on_one_python_fail_the_whole_and_the_others_are_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program(tmp_path / "make", f'echo "$@" >>{tmp_path / "made"}; case "$*" in *python{OTHER}) exit 2;; esac')
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    monkeypatch.setattr(pythons, "find_python", lambda version: f"/somewhere/python{version}")
    assert pythons.main() == 1
    made = (tmp_path / "made").read_text(encoding="utf-8").splitlines()
    assert len(made) == len(pythons.PYTHONS) - 1 and all("test-short" in line for line in made)
