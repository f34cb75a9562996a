"""Exit codes: what is ours to mend leaves with 70 and one line that says so, never with the 1 of "differs"."""

from __future__ import annotations

import ast
import importlib.util
import os
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import pytest

from benchmarks import start
from tests.conftest import ROOT
from tests.syntax import nodes
from tests.test_structure import PACKAGES
from vaneloop.base import terminal
from vaneloop.base.errors import InputError
from vaneloop.cli.main import COMMANDS, IN_CHECKOUT, main

LOG = str(ROOT / "examples" / "hidden_effect.parquet")


def broken(*_: object, **__: object) -> None:
    raise KeyError("level.square_root")


def complaint(err: str) -> str:
    """The last line, which must be the only one of ours."""
    *others, line = err.strip().splitlines()
    assert not any("Traceback" in o or o.startswith("vaneloop:") for o in others), err
    return line


@pytest.fixture
def kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where tracebacks go in this test."""
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    monkeypatch.delenv("VANELOOP_DEBUG", raising=False)
    return tmp_path


@pytest.mark.parametrize("name", COMMANDS)
def test_an_internal_error_of_any_command_leaves_with_70(
    name: str, kept: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(importlib.import_module(COMMANDS[name][0]), "add_options", broken)
    assert main([name]) == terminal.DEFECT == 70
    line = complaint(capsys.readouterr().err)
    assert (
        "KeyError: 'level.square_root' (test_exit_codes.py:" in line and "defect of VaneLoop, not of your input" in line
    )
    (file,) = kept.glob("vaneloop-*.traceback")
    assert str(file) in line and "in broken" in file.read_text(encoding="utf-8")


@pytest.mark.parametrize("name", ["compare", "locate", "diagnose", "replay"])
def test_an_error_deep_inside_leaves_with_70(
    name: str, kept: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("vaneloop.cli.options.read_log", broken)
    assert main([name, LOG, "--quiet"]) == 70
    assert "internal error" in complaint(capsys.readouterr().err)


def test_the_traceback_is_printed_where_asked_for(
    kept: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("VANELOOP_DEBUG", "1")
    assert terminal.run(lambda: broken() or 0) == 70
    err = capsys.readouterr().err
    assert "in broken" in err and "traceback above" in err and not list(kept.iterdir())


def test_a_traceback_that_cannot_be_kept_is_no_second_error(kept: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.NamedTemporaryFile", lambda *a, **k: (_ for _ in ()).throw(OSError("full")))
    assert "VANELOOP_DEBUG=1 prints the traceback" in terminal.defect(KeyError("x"))


def killed(*_: object, **__: object) -> None:
    """Work in a process that somebody kills."""
    with ProcessPoolExecutor(1) as pool:
        pool.submit(os.kill, os.getpid(), 0).result()  # it works
        pool.submit(os._exit, 9).result()


def test_a_killed_search_says_what_to_do_next(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("vaneloop.cli.diagnose.command", killed)
    assert main(["diagnose", LOG]) == 70
    line = complaint(capsys.readouterr().err)
    assert "was ended from outside" in line and "start it again" in line and "BrokenProcessPool" not in line


def test_bad_input_is_no_defect(capsys: pytest.CaptureFixture[str]) -> None:
    def refuse() -> int:
        raise InputError("n_dem (=-3 %) must be in [0, 120] %")

    assert terminal.run(refuse) == 2 and capsys.readouterr().err == "vaneloop: n_dem (=-3 %) must be in [0, 120] %\n"


# every module that can be run; what breaks it, in its process
MODULES = {
    "vaneloop": ("hil.logs.read_log", ["locate", LOG]),
    "vaneloop.cli.main": ("hil.logs.read_log", ["locate", LOG]),
    "vaneloop.cli.ahead": ("hil.loop.lockstep.lockstep", ["simulator", "."]),
    "vaneloop.cli.demo": ("os.path.relpath", []),
    "vaneloop.web.worker": ("", ["not a number"]),
    "vaneloop.web.loop": ("", ["not a number"]),
    "hil.replay": ("hil.logs.read_log", [LOG]),
    "hil.inject": ("hil.inject.scenario.library", ["--all"]),
    "hil.logs.recorder": ("", []),  # it lacks its words
    "hil.bus.broker": ("", []),
}


def test_what_a_number_must_be_is_said_with_the_number() -> None:
    without = []
    for file in (*(ROOT / "vaneloop" / "cli").glob("*.py"), *(ROOT / "benchmarks").glob("*.py")):
        for node in nodes(file.read_text(encoding="utf-8")):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "InputError" and node.args:
                said = node.args[0]
                if isinstance(said, ast.Constant) and "must be" in str(said.value):
                    without.append(f"{file.name}:{said.lineno} {said.value}")
    assert without == []


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["fleet_demo", "--out", "x", "--logs", "3"], "--logs (=3) must be in [4, 100000]"),
        (
            ["fleet_demo", "--out", "x", "--engines", "9", "--logs", "8"],
            "--engines (=9) must be in [4, 8], no more than --logs",
        ),
        (["fleet_demo", "--out", "x", "--workers", "0"], "--workers (=0) must be in [1, 64]"),
        (["hidden_effect", "--logs", "0"], "--logs (=0) must be in [1, 100000]"),
        (["hidden_effect", "--workers", "65"], "--workers (=65) must be in [1, 64]"),
        (["hidden_effect", "--duration", "5"], "--duration (=5 s) must be in [30, 1e5]"),
        (["hidden_effect", "--seed", "-1"], "--seed (=-1) must be in [0, 2^63)"),
        (["two_actuators", "--logs", "0"], "--logs (=0) must be in [1, 100000]"),
        (["two_actuators", "--workers", "65"], "--workers (=65) must be in [1, 64]"),
        (["two_actuators", "--duration", "5"], "--duration (=5 s) must be in [30, 3600]"),
        (["two_actuators", "--seed", "-1"], "--seed (=-1) must be in [0, 2^63)"),
    ],
)
def test_a_number_out_of_range_is_named(words: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert start.main(f"benchmarks.{words[0]}", words[1:]) == 2
    assert said in capsys.readouterr().err


@pytest.mark.parametrize(("words", "module"), IN_CHECKOUT.items())
def test_what_is_no_command_any_more_says_where_it_is(
    words: str, module: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*words.split(), "--workers", "1"]) == 2
    line = complaint(capsys.readouterr().err)
    assert line == f"vaneloop: '{words}' is not a command; in a checkout: python -m {module}"
    assert importlib.util.find_spec(module) is not None and words.split()[-1] not in COMMANDS


def test_every_module_that_can_be_run_is_in_the_list() -> None:
    runs = {
        ".".join(p.relative_to(ROOT).with_suffix("").parts).removesuffix(".__main__")
        for top in PACKAGES
        for p in (ROOT / top).rglob("*.py")
        if p.name == "__main__.py" or '__name__ == "__main__"' in p.read_text(encoding="utf-8")
    }
    # which write the C header, for developers, and the C source that export-fmu reads
    assert runs - {"controller.header", "hil.fmu.source"} == set(MODULES)


# doors to the same commands, and processes of the workbench: each begins with a second of imports
DEAR = {"vaneloop.cli.main", "vaneloop.web.worker", "vaneloop.web.loop", "hil.replay", "hil.inject"}


@pytest.mark.parametrize("module", [pytest.param(m, marks=pytest.mark.slow if m in DEAR else ()) for m in MODULES])
def test_a_module_run_by_itself_leaves_with_70(module: str, tmp_path: Path) -> None:
    """The module in a process of its own, in which one of our functions (or the word that starts it) is broken."""
    what, words = MODULES[module]
    home, _, function = what.rpartition(".")
    script = (
        "import importlib, runpy, sys\n"
        "def broken(*a, **k): raise KeyError('level.square_root')\n"
        f"if {function!r}: setattr(importlib.import_module({home!r}), {function!r}, broken)\n"
        f"sys.argv = ['x', *{words!r}]\n"
        f"runpy.run_module({module!r}, run_name='__main__', alter_sys=True)\n"
    )
    env = {**os.environ, "PYTHONPATH": str(ROOT), "TMPDIR": str(tmp_path)}
    p = subprocess.run(
        [sys.executable, "-c", script], cwd=tmp_path, env=env, capture_output=True, text=True, timeout=120, check=False
    )
    assert p.returncode == 70, p.stderr
    assert "internal error" in complaint(p.stderr) and list(tmp_path.glob("vaneloop-*.traceback"))
