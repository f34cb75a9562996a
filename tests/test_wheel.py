"""The wheel holds everything that the commands need, and works where there is no checkout."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from importlib import metadata
from pathlib import Path

import pytest

from tests.conftest import ROOT
from tests.test_structure import PACKAGES

JUNK = shutil.ignore_patterns("__pycache__", "*.nbi", "*.nbc")


def run(*command: str, cwd: Path, **env: str) -> str:
    """Run a command that must succeed and return what it printed."""
    plain = {k: v for k, v in os.environ.items() if not k.startswith(("PYTEST", "PYTHON"))}
    done = subprocess.run(
        command, cwd=cwd, env={**plain, **env}, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, f"{' '.join(command)}: exit {done.returncode}\n{done.stdout}\n{done.stderr}"
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built without network from a copy of the sources."""
    if importlib.util.find_spec("pip") is None:
        pytest.skip("building the wheel needs pip")
    if importlib.util.find_spec("setuptools") is None or int(metadata.version("setuptools").split(".")[0]) < 77:
        pytest.skip("building the wheel needs setuptools >= 77 (the test extra brings it)")
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    source.mkdir()
    for name in (*PACKAGES, "tables"):
        shutil.copytree(ROOT / name, source / name, ignore=JUNK)
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        if (ROOT / name).is_file():
            shutil.copy(ROOT / name, source)
    pip = (sys.executable, "-m", "pip", "--disable-pip-version-check")
    run(
        *pip,
        "wheel",
        "--quiet",
        "--no-deps",
        "--no-build-isolation",
        "--no-index",
        "-w",
        str(folder),
        str(source),
        cwd=folder,
    )
    (built,) = folder.glob("vaneloop-*.whl")
    return built


@pytest.fixture(scope="module")
def installed(wheel: Path) -> Path:
    """A folder that holds the unpacked wheel and nothing else."""
    target = wheel.parent / "target"
    pip = (sys.executable, "-m", "pip", "--disable-pip-version-check")
    run(*pip, "install", "--quiet", "--no-deps", "--no-index", "--target", str(target), str(wheel), cwd=wheel.parent)
    return target


def run_installed(installed: Path, folder: Path, *arguments: str) -> str:
    """Run Python in ``folder`` with the unpacked wheel and the libraries, blind to the checkout.

    -S keeps out what an editable install put in site-packages, which would lead back to the checkout.
    """
    libraries = dict.fromkeys([sysconfig.get_path("purelib"), sysconfig.get_path("platlib")])
    return run(sys.executable, "-S", *arguments, cwd=folder, PYTHONPATH=os.pathsep.join([str(installed), *libraries]))


@pytest.mark.slow
def test_the_wheel_holds_every_source_and_table(wheel: Path) -> None:
    inside = set(zipfile.ZipFile(wheel).namelist())
    kept = [
        p
        for name in (*PACKAGES, "tables")
        for p in (ROOT / name).rglob("*")
        if p.is_file() and "__pycache__" not in p.parts
    ]
    # nor what make has compiled ahead for this machine
    made = ROOT / "vaneloop" / "base" / "ahead"
    here = [p.relative_to(ROOT).as_posix() for p in kept if p.suffix not in (".nbi", ".nbc") and made not in p.parents]
    wanted = {f"vaneloop/{name}" if name.startswith("tables/") else name for name in here}
    assert wanted <= inside, f"not in the wheel: {sorted(wanted - inside)}"
    assert {"vaneloop/tables/vgv.dbc", "vaneloop/tables/calibration.toml"} <= inside
    for name in PACKAGES:
        assert f"{name}/__init__.py" in inside


@pytest.mark.slow
def test_the_tables_are_data_only() -> None:
    assert not list((ROOT / "tables").rglob("*.py"))


@pytest.mark.slow
def test_the_wheel_holds_nothing_else_at_its_top(wheel: Path) -> None:
    tops = {name.split("/")[0] for name in zipfile.ZipFile(wheel).namelist()}
    assert {t for t in tops if not t.endswith(".dist-info")} == set(PACKAGES)


@pytest.mark.slow
def test_every_package_imports_from_the_installed_wheel(installed: Path, tmp_path: Path) -> None:
    code = f"import {', '.join(PACKAGES)}\nfor m in [{', '.join(PACKAGES)}]: print(m.__file__)"
    for file in run_installed(installed, tmp_path, "-c", code).splitlines():
        assert Path(file).is_relative_to(installed), f"{file} is not from the wheel"


@pytest.mark.slow
def test_replay_starts_from_the_installed_wheel_in_an_empty_folder(installed: Path, tmp_path: Path) -> None:
    assert "LOG" in run_installed(installed, tmp_path, "-m", "hil.replay", "--help")
    assert "SCENARIO" in run_installed(installed, tmp_path, "-m", "hil.inject", "--help")
    assert "replay" in run_installed(installed, tmp_path, "-m", "vaneloop", "--help")
    assert not list(tmp_path.iterdir()), "--help left files behind"


@pytest.mark.slow
def test_the_wheel_writes_over_no_file_of_an_installed_package(wheel: Path) -> None:
    inside = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    for other in metadata.distributions():
        if other.name.lower() != "vaneloop":
            shared = inside & {str(f) for f in other.files or []}
            assert not shared, f"{other.name} has these files too: {sorted(shared)[:5]}"


@pytest.mark.slow
def test_the_wheel_beside_pytables_leaves_both_in_order(wheel: Path, tmp_path: Path) -> None:
    pytest.importorskip("tables", reason="PyTables is not installed (the extra test-all brings it)")
    beside = tmp_path / "beside"  # PyTables first, then ours over it, as pip would
    theirs = metadata.distribution("tables")
    for file in theirs.files or []:
        if ".." not in file.parts and file.suffix != ".pyc":
            (beside / file).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(str(theirs.locate_file(file)), beside / file)
    pip = (sys.executable, "-m", "pip", "--disable-pip-version-check")
    run(*pip, "install", "--quiet", "--no-deps", "--no-index", "--target", str(beside), str(wheel), cwd=tmp_path)
    code = """
import numpy as np, tables
with tables.open_file("x.h5", "w") as f:
    f.create_array("/", "n_dem", np.arange(3.0))
with tables.open_file("x.h5") as f:
    print(tables.__file__, f.root.n_dem[:].sum())
import vaneloop
from controller import load_calibration
from vaneloop.base.tables import path
load_calibration()
print(path("vgv.dbc"), path("vgv.dbc").is_file())
"""
    hdf5, ours = run_installed(beside, tmp_path, "-c", code).splitlines()
    assert hdf5 == f"{beside / 'tables' / '__init__.py'} 3.0"
    assert ours == f"{beside / 'vaneloop' / 'tables' / 'vgv.dbc'} True"
