"""The installed command ``vaneloop run`` in a process of its own."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from tests.conftest import ROOT


@contextmanager
def installed_run(*options: str, within: float = 600) -> Iterator[None]:
    """Run the command from when its loop has begun to the end of the block; ``within`` so many s it must then end."""
    run = subprocess.Popen(
        [sys.executable, "-m", "vaneloop", "run", *options], stdout=subprocess.PIPE, text=True, cwd=ROOT
    )
    try:
        assert run.stdout is not None
        assert any("Ctrl-C" in line for line in run.stdout)
        yield
    finally:
        run.terminate()
        run.wait(within)


def until_heard(work: Callable[[], None], *silence: type[Exception], attempts: int = 20) -> None:
    """Do what a tool does, again after a request that nobody answered: a loop that a busy machine holds up for 50 ms
    drops what came meanwhile.
    """
    for _ in range(attempts - 1):
        try:
            work()
            return
        except silence:
            pass
    work()
