"""Standard input, output and error are anything: no traceback, no defect, the exit code that is written down."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.conftest import ROOT
from tests.stream_server import KINDS, MODULES, Server
from vaneloop.cli.main import COMMANDS

NAMES = [*COMMANDS, *MODULES]
LOG = str(ROOT / "examples" / "hidden_effect.parquet")
MISSING = "/dev/null/no/such/file"  # which nobody can make, either
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


@pytest.mark.slow
def test_the_engine_control_unit_takes_any_input_for_its_demand() -> None:
    """It gives up where no controller answers, whatever it is typed on, and says so where somebody can read it."""
    words = ["ecu", "--bus", f"local:streams-{os.getpid()}", "--wait", "0.3"]
    server = Server([[*words, "--profile", "ramp"]])  # which leaves this process's own input alone
    try:
        for i, kinds in enumerate(zip(KINDS * 2, KINDS + KINDS[3:] + KINDS[:3], strict=True)):
            answer = server.run(words, *kinds, KINDS[(5 * i + 2) % len(KINDS)])
            written = kinds[1] not in (*REFUSING, "gone")
            assert answer["code"] == (1 if written else 2 if kinds[1] in REFUSING else 0), (kinds, answer)
            assert "Traceback" not in answer["err"] + answer["out"], (kinds, answer)
    finally:
        server.close()


ON_A_TERMINAL = """
import fcntl, os, sys, termios, tty
from vaneloop.base import terminal

def refuse(*_):
    raise termios.error(25, "Inappropriate ioctl for device")

def keys():
    with terminal.keyboard(sys.stdin) as fd:
        return fd, not termios.tcgetattr(0)[3] & termios.ICANON

foreign = keys()[0], terminal.input_of(sys.stdin)
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
before = termios.tcgetattr(0)
ours = keys(), terminal.input_of(sys.stdin), termios.tcgetattr(0) == before
was, refused = dict(vars(termios)), []
for name in ("tcgetattr", "tcsetattr"):
    setattr(termios, name, refuse), setattr(tty, name, refuse)
    with terminal.keyboard(sys.stdin) as fd:
        refused.append((fd, terminal.input_of(sys.stdin), terminal.is_terminal(sys.stdin)))
    setattr(termios, name, was[name]), setattr(tty, name, was[name])
child = os.fork()
if child == 0:
    os.setpgid(0, 0)  # as a job in the background
    with terminal.keyboard(sys.stdin) as fd:
        os._exit(10 * (fd is None) + (terminal.input_of(sys.stdin) is None))
behind = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
print((foreign, ours, refused, behind))
"""


def test_a_terminal_is_used_only_where_it_answers_every_call() -> None:
    other, end = os.openpty()
    words = [sys.executable, "-c", ON_A_TERMINAL]
    done = subprocess.run(
        words, cwd=ROOT, stdin=end, capture_output=True, text=True, start_new_session=True, check=False, timeout=60
    )
    os.close(other), os.close(end)
    # descriptors: None is no keyboard, or nothing to read from
    foreign, ours = (None, 0), ((0, True), 0, True)
    refused = [(None, 0, False), (None, 0, True)]
    assert done.stdout.strip() == str((foreign, ours, refused, 11)), done.stderr


def test_an_installed_command_meets_python_s_own_streams() -> None:
    """What the server imitates, once with the interpreter's start and end."""
    command = f"{sys.executable} -m vaneloop"
    for redirection, code, said in (
        (">/dev/full", 2, "vaneloop: standard output: cannot be written (No space left on device)\n"),
        (">&-", 0, ""),
        ("<&-", 0, ""),
        (">&- <&- 2>&-", 0, ""),
    ):
        done = subprocess.run(
            f"{command} --version {redirection}", shell=True, cwd=ROOT, capture_output=True, text=True, check=False
        )
        assert (done.returncode, done.stderr) == (code, said), redirection


def test_a_file_of_ours_does_not_get_the_number_of_a_closed_stream(tmp_path: Path) -> None:
    """Else what is said on standard error would stand in it."""
    code = (
        "import sys; from vaneloop.base import terminal\n"
        f"def command():\n    f = open({str(tmp_path / 'f')!r}, 'w')\n"
        "    print('lost', file=sys.stderr), print('lost'), f.write('kept'), f.close()\n    return 3\n"
        "sys.exit(terminal.run(command))"
    )
    words = ["/bin/sh", "-c", 'exec "$0" -c "$1" >&- 2>&- <&-', sys.executable, code]
    done = subprocess.run(words, cwd=ROOT, check=False)
    assert done.returncode == 3 and (tmp_path / "f").read_text() == "kept"
