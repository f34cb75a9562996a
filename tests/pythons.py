"""``python -m tests.pythons``: `make test-short` on every Python that the package promises, but for the one in use.

A Python is taken from the PATH, from pyenv, or, as root on Debian or Ubuntu, from the system's packages. The last lines
say which was not there. Exit code: 1 where tests failed; a Python that is not there is no failure.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from tests.vcan.run import ROOT, find, install, loudly, say

__all__ = ["PYTHONS", "find_python", "main"]

PYTHONS = ("3.11", "3.12", "3.13")


def find_python(version: str, installing: bool = True) -> str:
    """Path of an interpreter that runs and is of this version.

    Raises LookupError, which says why there is none.
    """
    name = f"python{version}"
    for candidate in _candidates(name):
        asked = [candidate, "-c", "import sys; print('%d.%d' % sys.version_info[:2])"]
        done = subprocess.run(asked, check=False, capture_output=True, text=True, stdin=subprocess.DEVNULL)
        if done.returncode == 0 and done.stdout.strip() == version:
            return candidate
    if not installing:
        raise LookupError(f"no {name} that runs")
    if why := install({name: name}):
        raise LookupError(f"no {name} on the PATH or in pyenv; {why}")
    return find_python(version, installing=False)


def _candidates(name: str) -> Iterator[str]:
    """That on the PATH may be pyenv's, which runs only where the version is chosen: so those that it has come next."""
    if on_path := find(name):
        yield on_path
    if pyenv := find("pyenv"):
        root = subprocess.run([pyenv, "root"], check=False, capture_output=True, text=True).stdout.strip()
        if root:
            yield from map(str, sorted(Path(root, "versions").glob(f"{name.removeprefix('python')}*/bin/{name}")))


def main() -> int:
    """Run them, one Python after the other; return an exit code."""
    here = f"{sys.version_info[0]}.{sys.version_info[1]}"
    lines, code = [], 0
    for version in PYTHONS:
        if version == here:
            continue
        try:
            python = find_python(version)
        except LookupError as e:
            lines.append(f"not tested on Python {version}: {e}")
            continue
        say(f"on Python {version}: {python}")
        started = time.monotonic()
        command = ["make", "--no-print-directory", "test-short", f"PYTHON={python}"]
        failed = subprocess.run(command, cwd=ROOT, check=False).returncode != 0
        say(f"Python {version}: {'FAILED' if failed else 'passed'} in {time.monotonic() - started:.0f} s")
        code |= int(failed)
    if lines:
        loudly(lines)
    return code


if __name__ == "__main__":
    sys.exit(main())
