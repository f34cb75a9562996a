"""The installed command ``vaneloop run`` in a process of its own."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from tests.conftest import ROOT


@contextmanager
def installed_run(*options: str, within: float = 20) -> Iterator[None]:
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
