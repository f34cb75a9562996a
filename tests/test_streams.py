"""Standard input, output and error are anything: no traceback, no defect, the exit code that is written down."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import pytest

from tests.conftest import ROOT
from tests.stream_server import KINDS, MODULES, Server
from vaneloop.cli.main import COMMANDS

NAMES = [*COMMANDS, *MODULES]
LOG = str(ROOT / "examples" / "hidden_effect.parquet")
MISSING = "/no/such/file"
REFUSING = ("full", "hung up")  # as standard output


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    it = Server()
    yield it
    it.close()


def judged(server: Server, words: list[str], kinds: tuple[str, ...], good: int) -> None:
    """Fail unless a command ends as it must: with ``good``, or 2 where standard output refuses what it writes."""
    answer = server.run(words, *kinds)
    said = f"{' '.join(words)} {kinds}: {answer}"
    code = 2 if good == 0 and kinds[1] in REFUSING else good
    assert answer["code"] == code, said
    assert "Traceback" not in answer["err"] + answer["out"] and "Exception ignored" not in answer["err"], said
    if kinds[2] in ("pipe", "socket", "terminal"):
        lines = answer["err"].strip().splitlines()
        assert len(lines) == (code == 2), said
        if code == 2 and good == 0:
            assert lines[0].startswith("vaneloop: standard output: cannot be written ("), said


@pytest.mark.parametrize("out", KINDS)
def test_help_is_written_wherever_it_can_be(server: Server, out: str) -> None:
    for i, name in enumerate(NAMES[KINDS.index(out) :: len(KINDS)]):
        for err in ("pipe", KINDS[i % len(KINDS)]):
            judged(server, [name, "--help"], (KINDS[-i % len(KINDS)], out, err), 0)
    judged(server, ["--version"], (out, out, out), 0)
    judged(server, ["--help"], ("null", out, "pipe"), 0)


@pytest.mark.parametrize("err", KINDS)
def test_a_wrong_word_is_exit_code_2_though_nobody_can_be_told(server: Server, err: str) -> None:
    for i, name in enumerate(NAMES[KINDS.index(err) :: len(KINDS)]):
        judged(server, [name, "--no-such-option"], (KINDS[i % len(KINDS)], KINDS[-i % len(KINDS)], err), 2)
    judged(server, ["no-such-command"], (err, err, err), 2)


@pytest.fixture(scope="module")
def loaded() -> Iterator[Server]:
    """A server that has read the files of every command, as far as there were any."""
    it = Server([[name, MISSING] for name in NAMES])
    yield it
    it.close()


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_every_command_with_every_output_and_error(loaded: Server, name: str) -> None:
    for i, (out, err) in enumerate(itertools.product(KINDS, KINDS)):
        judged(loaded, [name, "--help"], (KINDS[i % len(KINDS)], out, err), 0)
    for i, out in enumerate(KINDS):
        for word in ("--no-such-option", MISSING):
            judged(loaded, [name, word], (KINDS[(i + 3) % len(KINDS)], out, KINDS[(3 * i + 2) % len(KINDS)]), 2)
