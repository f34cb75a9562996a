"""Processes of ours import nothing from the folder in which a user stands: it may be somebody else's."""

from __future__ import annotations

import ast
import json
import subprocess
from pathlib import Path

import numpy as np
import pytest

from hil.logs import Channel, read_log, write_log
from hil.logs.recorder import RecorderProcess
from tests.conftest import ROOT
from tests.syntax import nodes
from tests.test_structure import PACKAGES, python_files
from vaneloop.base.child import python, python_module

NAMES = ("json", "os", "struct", "numpy", "can", "hil", "vaneloop", "numba", "sitecustomize")


@pytest.fixture
def trap(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of logs with modules in it that leave a mark when they are imported; it is where the user stands."""
    folder = tmp_path / "logs"
    folder.mkdir()
    for name in NAMES:
        (folder / f"{name}.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'a').write({name!r})\n")
    monkeypatch.chdir(folder)
    return tmp_path / "ran"


def test_a_child_finds_this_vaneloop_and_nothing_where_the_user_stands(trap: Path) -> None:
    code = "import json, sys, vaneloop; print(json.dumps([vaneloop.__file__, sys.argv[1:]]))"
    said = subprocess.run(python(code, "a", "b c"), capture_output=True, text=True, check=True)
    assert json.loads(said.stdout) == [str(ROOT / "vaneloop" / "__init__.py"), ["a", "b c"]]
    done = subprocess.run(python_module("vaneloop.cli.main", "--version"), capture_output=True, text=True, check=False)
    assert done.returncode == 0 and done.stdout.startswith("vaneloop") and not trap.exists()


def test_readers_and_recorders_import_nothing_from_a_folder_of_logs(trap: Path) -> None:
    t = np.arange(0.0, 1.0, 0.01)
    write_log("a.mf4", {"n_dem": Channel(t, 60.0 + t)})
    assert len(read_log("a.mf4").channels["n_dem"].values) == 100
    recorder = RecorderProcess("a.log")
    recorder.close()
    assert not trap.exists()


def test_every_process_of_ours_is_started_so() -> None:
    own = {"vaneloop/base/child.py": "the one place", "hil/bus/local_bus.py": "-I: isolated from all of it"}
    found = {
        str(path.relative_to(ROOT))
        for package in PACKAGES
        for path in python_files(package)
        for node in nodes(path.read_text(encoding="utf-8"))
        if isinstance(node, ast.Attribute) and node.attr == "executable" and ast.unparse(node.value) == "sys"
    }
    assert found == set(own)
