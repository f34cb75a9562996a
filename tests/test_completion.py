"""What was probably meant, and what a shell completes."""

from __future__ import annotations

import argparse
import os
import re
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
        actions = parser_of(name)._actions
        parts = [p for a in actions if isinstance(a, argparse._SubParsersAction) for p in a.choices.values()]
        for action in [*actions, *(a for p in parts for a in p._actions)]:
            for flag in action.option_strings:
                assert (flag if shell != "fish" else flag.lstrip("-")) in text, (name, flag)
    if shutil.which(shell):
        done = subprocess.run([shell, "-n"], input=text, text=True, capture_output=True, check=False)
        assert done.returncode == 0 and not done.stderr


# words before the one that is completed, what is offered for it, and what is not
COMPLETED = [
    (["vaneloop", "rep"], "replay", "record"), (["vaneloop", "replay", "--tol"], "--tolerance", "--tables"),
    (["vaneloop", "ecu", "--mode", "st"], "standby", "run"), (["vaneloop", "completion", "z"], "zsh", "bash"),
    (["vaneloop", "replay", "exam"], "example.csv", "--report"), (["vaneloop", "fleet", "rep"], "report", "run"),
    (["vaneloop", "fleet", "report", "--tables-"], "--tables-out", "--bus"),
    (["vaneloop", "fleet", "run", "exam"], "example.csv", "report"),
    (["vaneloop", "replay", "--plant", "plant_"], "plant_electromechanical.toml", "example.csv"),
    (["vaneloop", "run", "--bus", "lock"], "lockstep", "local"),
    (["vaneloop", "extend", "example.csv", "--effect", "valve_dead"], "valve_dead_band", "valve_lag"),
    (["vaneloop", "inject", "old_"], "old_frames_again", "nominal"),
    (["vaneloop", "inject", "exam"], "example.csv", "nominal"),
]  # fmt: skip


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "example.csv").touch()
    return tmp_path


def asked(shell: str, text: str, folder: Path) -> str:
    """What a shell prints that reads ``text``."""
    if not shutil.which(shell):
        pytest.skip(f"no {shell}")
    flags = ["-f"] if shell == "zsh" else ["--no-config"] if shell == "fish" else ["--norc"]
    home = dict(os.environ, HOME=str(folder))
    done = subprocess.run(
        [shell, *flags], input=text, text=True, capture_output=True, check=True, cwd=folder, env=home, timeout=600
    )
    assert not done.stderr
    return done.stdout


@pytest.mark.parametrize("words, offered, not_offered", COMPLETED)
def test_bash_completes(
    folder: Path, capsys: pytest.CaptureFixture[str], words: list[str], offered: str, not_offered: str
) -> None:
    line = " ".join(f"'{w}'" for w in words)
    ask = f'\nCOMP_WORDS=({line}); COMP_CWORD={len(words) - 1}; _vaneloop; printf "%s\n" "${{COMPREPLY[@]}}"\n'
    found = asked("bash", script("bash", capsys) + ask, folder).split()
    assert offered in found and not_offered not in found


@pytest.mark.parametrize("words, offered, not_offered", COMPLETED)
def test_fish_completes(
    folder: Path, capsys: pytest.CaptureFixture[str], words: list[str], offered: str, not_offered: str
) -> None:
    text = asked("fish", script("fish", capsys) + f"\ncomplete -C '{' '.join(words)}'\n", folder)
    found = [line.split("\t")[0] for line in text.splitlines()]
    assert offered in found and not_offered not in found


@pytest.mark.parametrize("kept", ["sourced", "in a folder of fpath"])
def test_zsh_completes_from_the_first_tab_on(folder: Path, capsys: pytest.CaptureFixture[str], kept: str) -> None:
    """A real line editor: Tab and Enter after the words; what is called prints its words."""
    (folder / "_vaneloop").write_text(script("zsh", capsys))
    ready = f"fpath=({folder} $fpath); autoload -Uz compinit; compinit -u -D"
    if kept == "sourced":
        ready = f"autoload -Uz compinit; compinit -u -D; source {folder}/_vaneloop"
    for words, offered, _ in COMPLETED:
        ask = f"""
            zmodload zsh/zpty; zpty -b shell zsh -f -i
            zpty -w shell 'PS1=; {ready}; vaneloop() {{ print -r -- "called<$*>" }}; cd {folder}; print rea""dy'
            zpty -r -m shell heard '*ready*'
            zpty -w shell $'{" ".join(words)}\t'
            zpty -r -m shell heard '*called<*>*'; print -r -- "$heard"
        """
        heard = asked("zsh", ask, folder)
        called = re.findall(r"called<([^>]*)>", heard)
        assert called and called[-1].split() == [*words[1:-1], offered], (words, heard)
        if kept != "sourced":
            break  # what differs is the first call


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
