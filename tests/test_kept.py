"""Compiled code that is kept: found again where nothing has changed that it follows from, and only there."""

from __future__ import annotations

import argparse
import math
import os
import subprocess
import sys
from collections import namedtuple
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.conftest import ROOT
from vaneloop.base import terminal
from vaneloop.base.kept import Waiting, digest_of
from vaneloop.identification.candidates import laws

# Two users' models of the same names, whose helper is too large to be put in place: what is compiled in another process
# and read from files must not take the one's for the other's.
CODE = """
import sys
import numpy as np
from numba.core import event
from vaneloop.identification.user_models.codegen import compiled_code

compiled = []
class Count(event.Listener):
    def on_start(self, e):
        compiled.append(1)
    def on_end(self, e):
        pass
event.register("numba:compile", Count())

def answer(loss):
    space = {"np": np, "compiled_code": compiled_code, "__name__": "mine"}
    exec(f'''
def lost(level, n):
    out = 0.0
    for k in range(n):
        out += {loss} * level if k % 3 else np.sin(level) * 0.0
        if k > 5:
            out += np.cos(level * k) ** 2.5 + np.arctan2(level, k) + np.exp(-level) + np.floor(level)
    return out

def model(level):
    return lost(level, 3)
''', space)
    space["model"] = compiled_code(space["model"])
    exec("@compiled_code\\ndef run(level):\\n    return model(level)", space)
    return space["run"](1.0)

print(*(answer(float(loss)) for loss in sys.argv[1:]), len(compiled))
"""


def run(folder: Path, *losses: str, **env: str) -> list[float]:
    env = {**os.environ, "NUMBA_CACHE_DIR": str(folder), **env}
    words = [sys.executable, "-c", CODE, *losses]
    done = subprocess.run(words, cwd=ROOT, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return [float(word) for word in done.stdout.split()]


@pytest.mark.slow
def test_a_users_functions_are_compiled_once_and_two_of_one_name_are_told_apart(tmp_path: Path) -> None:
    *first, compiled = run(tmp_path, "0.5")
    assert first == [1.0] and compiled > 0
    *other, compiled = run(tmp_path, "2.0")
    assert other == [4.0] and compiled > 0
    assert run(tmp_path, "0.5", "2.0", "0.5") == [1.0, 4.0, 1.0, 0], "both from files, nothing compiled"


@pytest.mark.slow
def test_what_was_compiled_ahead_is_read_and_left_as_it_is(tmp_path: Path) -> None:
    run(tmp_path / "ahead", "0.5")
    before = sorted((tmp_path / "ahead").rglob("*"))
    assert run(tmp_path / "user", "0.5", VANELOOP_AHEAD=str(tmp_path / "ahead")) == [1.0, 0], "nothing compiled"
    *_, compiled = run(tmp_path / "user", "2.0", VANELOOP_AHEAD=str(tmp_path / "ahead"))
    assert compiled > 0 and sorted((tmp_path / "ahead").rglob("*")) == before
    assert list((tmp_path / "user").rglob("*.nbc"))


@pytest.mark.slow
def test_after_the_set_up_the_first_replay_and_diagnosis_compile_nothing(tmp_path: Path) -> None:
    """What `make` has compiled is enough; where nobody has, it is compiled now."""
    env = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "user")}
    for words in (
        ["vaneloop.cli.ahead"],
        ["vaneloop", "replay", "examples/engine_run.blf"],
        ["vaneloop", "diagnose", "examples/hidden_effect.parquet"],
    ):
        done = subprocess.run(
            [sys.executable, "-m", *words], cwd=ROOT, env=env, capture_output=True, text=True, check=False
        )
        assert done.returncode in (0, 1), done.stderr
        assert words == ["vaneloop.cli.ahead"] or "compiling" not in done.stdout + done.stderr, done.stdout
    assert not list((tmp_path / "user").rglob("*.nbc"))


@pytest.mark.slow
def test_a_damaged_file_counts_as_none(tmp_path: Path) -> None:
    run(tmp_path, "0.5")
    files = list(tmp_path.rglob("*.nbc"))
    assert files
    for n, file in enumerate(files):
        file.write_bytes(file.read_bytes()[: n * 100] if n % 2 else b"")
    *answer, compiled = run(tmp_path, "0.5")
    assert answer == [1.0] and compiled > 0
    assert run(tmp_path, "0.5") == [1.0, 0], "it was written anew"


@pytest.mark.slow
def test_where_nothing_can_be_written_it_is_compiled_all_the_same(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("no folder")
    *answer, compiled = run(tmp_path / "file" / "below", "0.5")
    assert answer == [1.0] and compiled > 0


TABLE = np.array([1.0, 2.0])
Sizes = namedtuple("Sizes", ["a", "b"])


def made(source: str, **space: Any) -> Callable[..., Any]:
    space = {"np": np, "math": math, "__name__": "mine", **space}
    exec(source, space)
    return space["f"]


@pytest.mark.parametrize(
    ("source", "one", "other"),
    [
        ("def f(x): return k * x", {"k": 1.0}, {"k": 2.0}),
        ("def f(x): return k * x", {"k": 1.0}, {"k": 1}),
        ("def f(x): return k[0] * x", {"k": TABLE}, {"k": TABLE + 1.0}),
        ("def f(x): return k[0] * x", {"k": TABLE}, {"k": TABLE.astype(np.float32)}),
        ("def f(x): return k.a * x", {"k": Sizes(1.0, 2.0)}, {"k": Sizes(3.0, 2.0)}),
        ("def f(x): return K(1.0, 2.0).a", {"K": Sizes}, {"K": namedtuple("Sizes", ["b", "a"])}),
        ("def f(x): return g(x)", {"g": made("def f(x): return x")}, {"g": made("def f(x): return -x")}),
        ("def f(x): return g(x)", {"g": made("def f(x, y=1.0): return y")}, {"g": made("def f(x, y=2.0): return y")}),
        ("def f(x): return g(x)", {"g": made("def f(x): return k", k=1)}, {"g": made("def f(x): return k", k=2)}),
        ("def f(x): return g(x)", {"g": math.sin}, {"g": math.cos}),
        ("def f(x): return g(x)", {"g": np.sin}, {"g": np.cos}),
        ("def f(x): return (lambda y: y + k)(x)", {"k": 1.0}, {"k": 2.0}),
    ],
)
def test_whatever_a_function_refers_to_is_in_its_digest(source: str, one: Any, other: Any) -> None:
    assert digest_of(made(source, **one))
    assert digest_of(made(source, **one)) == digest_of(made(source, **one))
    assert digest_of(made(source, **one)) != digest_of(made(source, **other))


def test_bytecode_constants_and_closures_are_in_the_digest() -> None:
    def with_cell(k: Any) -> Callable[..., Any]:
        return lambda x: k * x

    digests = [digest_of(made(f"def f(x): return {text}")) for text in ("x + 1", "x + 2", "x - 1", "np.sin(x)")]
    digests += [digest_of(with_cell(1.0)), digest_of(with_cell(2.0))]
    assert all(digests) and len(set(digests)) == len(digests)


def test_of_this_program_s_functions_the_name_suffices() -> None:
    assert digest_of(made("def f(x): return g(0, x)", g=laws.force_of))


@pytest.mark.parametrize("k", [{"a": 1.0}, object(), os, [1.0], np.array(["x"], dtype=object)])
def test_what_cannot_be_told_has_no_digest(k: Any) -> None:
    assert digest_of(made("def f(x): return k", k=k)) == ""
    assert digest_of(made("def f(x): return g(x)", g=made("def f(x): return k", k=k))) == ""
    assert digest_of(made("def f(x): return x", k=k)), "it is not referred to"


@pytest.fixture
def a_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(terminal, "is_command", True)
    monkeypatch.setattr(terminal, "told_of_compiling", False)


def compile_for_long(waiting: Waiting) -> None:
    waiting.on_start(None)
    assert waiting.timer is not None
    waiting.timer.join()
    waiting.on_start(None)  # a function that it calls
    waiting.on_end(None)
    waiting.on_end(None)


def test_a_long_compilation_is_told_once(a_command: None, capsys: pytest.CaptureFixture[str]) -> None:
    waiting = Waiting(after=0.0)
    compile_for_long(waiting)
    waiting.on_start(None)
    waiting.on_end(None)
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("vaneloop: compiling what has not run") and err.count("\n") == 1


def test_a_short_compilation_is_not_told(a_command: None, capsys: pytest.CaptureFixture[str]) -> None:
    waiting = Waiting(after=1e6)
    waiting.on_start(None)
    waiting.on_end(None)
    assert waiting.timer is not None and waiting.timer.finished.is_set()
    assert capsys.readouterr().err == ""


def test_what_the_command_told_itself_hides_only_the_next_one(
    a_command: None, capsys: pytest.CaptureFixture[str]
) -> None:
    """Reading a CAN log tells of its own compilation; what comes after it is another."""
    args = argparse.Namespace(quiet=False, json=None)
    terminal.say(args, "compiling the reader of CAN logs for this machine (once, about 3 s) ...")
    waiting = Waiting(after=0.0)
    compile_for_long(waiting)
    assert capsys.readouterr().err == ""
    compile_for_long(waiting)
    assert "compiling what has not run" in capsys.readouterr().err


def test_a_program_that_calls_a_command_is_not_told(capsys: pytest.CaptureFixture[str]) -> None:
    compile_for_long(Waiting(after=0.0))
    assert capsys.readouterr().err == ""
