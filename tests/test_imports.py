"""Every module of the packages imports, on this Python and with what is installed."""

from __future__ import annotations

import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

import vaneloop
from tests.release import contents, differing
from vaneloop.base.version import installed_version

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


def test_the_version_is_that_of_the_project_wherever_it_is_told() -> None:
    version = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    assert f"\n## [{version}] " in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert f"Version {version} " in (ROOT / "README.md").read_text(encoding="utf-8")
    assert vaneloop.__version__ == installed_version() and "__version__" in dir(vaneloop)
    command = [sys.executable, "-m", "vaneloop", "--version"]
    told = subprocess.run(command, check=True, capture_output=True, text=True, cwd=ROOT).stdout
    assert told == f"vaneloop {vaneloop.__version__}\n"


def test_wheels_differ_in_what_one_lacks_or_has_otherwise(tmp_path: Path) -> None:
    made = []
    for name, files in (("a.whl", {"x": "1", "y": "2"}), ("b.whl", {"x": "1", "y": "3", "z": ""})):
        with zipfile.ZipFile(tmp_path / name, "w") as archive:
            for file, text in files.items():
                archive.writestr(file, text)
        made.append(contents(tmp_path / name))
    assert differing(*made) == ["y", "z"] == differing(*reversed(made)) and differing(made[0], made[0]) == []
