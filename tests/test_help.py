"""What `vaneloop COMMAND --help` shows can be typed: options that exist, files that are there or are made by an example
before.
"""

from __future__ import annotations

import importlib
import re
import shlex
from pathlib import Path

import pytest

from tests.conftest import ROOT
from vaneloop.base import terminal
from vaneloop.cli.main import COMMANDS

_FILE = re.compile(r"[\w./-]+\.(?:log|asc|blf|trc|mf4|csv|parquet|toml|dbc|html|py|json)|[\w./-]+/")
_MAKES = {"--out", "--record", "--report", "--json"}


def parser_of(name: str) -> terminal.Parser:
    module = importlib.import_module(COMMANDS[name][0])
    parser = terminal.Parser(prog=f"vaneloop {name}", description=module.DESCRIPTION)
    module.add_options(parser)
    return parser


def examples(name: str) -> list[list[str]]:
    """Words behind ``vaneloop`` of every example in the help of a command; what stands two blanks away is a remark."""
    text = parser_of(name).format_help()
    lines = re.search(r"^examples:\n((?:  .*\n?)+)", text, re.M)
    assert lines, f"vaneloop {name} --help shows no example"
    out = []
    for line in lines[1].splitlines():
        command = re.split(r"\S(?=\s{2,})", line.strip(), maxsplit=1)[0]
        whole = line.strip()[: len(command) + 1]
        assert "vaneloop " in whole, line
        out.append(shlex.split(whole[whole.index("vaneloop ") :])[1:])
    return out


def made() -> set[str]:
    """Files and folders that the examples of all commands write."""
    out = set()
    for name in COMMANDS:
        for words in examples(name):
            out |= {b for a, b in zip(words, words[1:], strict=False) if a in _MAKES}
            if words[0] in ("record", "new-controller"):
                out.add(words[1])
    return out


@pytest.mark.parametrize("name", list(COMMANDS))
def test_every_example_of_the_help_parses(name: str) -> None:
    for words in examples(name):
        parser_of(words[0]).parse_args(words[1:])  # exits with 2 where an option does not exist


@pytest.mark.parametrize("name", list(COMMANDS))
def test_every_file_that_the_help_names_is_there(name: str) -> None:
    """It is in the checkout, an example makes it, or it is in capitals: the reader's own."""
    there = made()
    folders = tuple(m for m in there if m.endswith("/"))
    for words in examples(name):
        for before, word in zip(words, words[1:], strict=False):
            if _FILE.fullmatch(word) and before not in _MAKES and word not in there and not word.startswith(folders):
                assert (ROOT / word).exists() or Path(word).stem.isupper(), f"vaneloop {' '.join(words)}: {word}"


def test_a_missing_file_and_a_wrong_option_in_an_example_would_be_seen() -> None:
    with pytest.raises(SystemExit):
        parser_of("replay").parse_args(["examples/engine_run.blf", "--tolerence", "vigv=1"])
    assert not (ROOT / "examples/engine_run.log").exists() and _FILE.fullmatch("examples/engine_run.log")
