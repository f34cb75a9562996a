"""Every module of the packages imports, on this Python and with what is installed."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("controller", "plant", "hil", "vaneloop")
IMPORT = """
import importlib, pkgutil, sys
for root in sys.argv[1:]:
    for found in pkgutil.walk_packages([root], root + "."):
        if found.name.endswith("__main__") or ".templates." in found.name:
            continue  # a program; what users begin with
        try:
            importlib.import_module(found.name)
        except ModuleNotFoundError as e:
            if (e.name or "").partition(".")[0] in ("controller", "plant", "hil", "vaneloop"):
                raise
            print(found.name, "needs", e.name)
        except Exception as e:
            raise SystemExit(f"{found.name}: {type(e).__name__}: {e}")
        else:
            print(found.name)
"""


@pytest.mark.parametrize("package", PACKAGES)
def test_every_module_imports(package: str) -> None:
    """In a process of its own, where nothing has been imported before; an extra that is not installed may lack."""
    command = [sys.executable, "-W", "error::SyntaxWarning", "-c", IMPORT, package]
    done = subprocess.run(command, check=False, capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    told = done.stdout.splitlines()
    assert len(told) > 2 and sum(" needs " in line for line in told) < len(told) / 2, told
