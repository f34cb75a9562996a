"""What was probably meant, and what a shell completes."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from tests.test_help import parser_of
from vaneloop.cli.completion import SHELLS
from vaneloop.cli.main import COMMANDS, main


def script(shell: str, capsys: pytest.CaptureFixture[str]) -> str:
    assert main(["completion", shell]) == 0
    return capsys.readouterr().out


@pytest.mark.parametrize("shell", SHELLS)
def test_every_command_and_every_option_is_in_the_script(shell: str, capsys: pytest.CaptureFixture[str]) -> None:
    text = script(shell, capsys)
    for name in COMMANDS:
        assert name in text
        for action in parser_of(name)._actions:
            for flag in action.option_strings:
                assert (flag if shell != "fish" else flag.lstrip("-")) in text, (name, flag)
    if shutil.which(shell):
        done = subprocess.run([shell, "-n"], input=text, text=True, capture_output=True, check=False)
        assert done.returncode == 0 and not done.stderr


@pytest.mark.parametrize(
    "words, offered, not_offered",
    [
        (["vaneloop", "rep"], "replay", "record"), (["vaneloop", "replay", "--tol"], "--tolerance", "--tables"),
        (["vaneloop", "ecu", "--mode", "st"], "standby", "run"), (["vaneloop", "completion", "z"], "zsh", "bash"),
        (["vaneloop", "replay", "exam"], "example.csv", "--report"),
    ],
)  # fmt: skip
def test_bash_completes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], offered: str, not_offered: str
) -> None:
    if not shutil.which("bash"):
        pytest.skip("no bash")
    (tmp_path / "example.csv").touch()
    line = " ".join(f"'{w}'" for w in words)
    ask = f'\nCOMP_WORDS=({line}); COMP_CWORD={len(words) - 1}; _vaneloop; printf "%s\\n" "${{COMPREPLY[@]}}"\n'
    done = subprocess.run(
        ["bash"], input=script("bash", capsys) + ask, text=True, capture_output=True, check=True, cwd=tmp_path
    )
    found = done.stdout.split()
    assert offered in found and not_offered not in found and not done.stderr


@pytest.mark.parametrize(
    "words, said",
    [
        (["replya"], "did you mean replay?"),
        (["replay", "a.csv", "--tolerence", "vigv=1"], "did you mean --tolerance?"),
        (["replay", "a.csv", "--tolerance", "vgiv=1"], "did you mean vigv?"),
        (["completion", "bsh"], "did you mean bash?"),
        (["ecu", "--mode", "runn"], "did you mean run?"), (["schedule", "--criterion", "rsm"], "did you mean rms?"),
        (["run", "--bus", "lockstep", "--profile", "stairs"], "did you mean staircase?"),
    ],
)  # fmt: skip
def test_what_was_meant_is_asked_in_one_line(words: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    try:
        code = main(words)
    except SystemExit as e:
        code = int(e.code or 0)
    err = capsys.readouterr().err
    assert code == 2 and said in err and len(err.strip().splitlines()) == 1, err
