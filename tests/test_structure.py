"""The layout that docs/architecture.md promises: who imports whom, what each package exports, what is in the repository."""

from __future__ import annotations

import ast
import importlib
import re
import subprocess
import tomllib
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

import pytest

from tests.conftest import ROOT

PACKAGES = ("tables", "controller", "plant", "hil", "discrepancy", "app")
OURS = {*PACKAGES, "tests", "benchmarks", "examples"}

# The table of docs/architecture.md: what code in a package may import besides the package itself.
MAY_IMPORT: dict[str, set[str]] = {
    "tables": set(),
    "controller": {"tables"},
    "plant": {"tables"},
    "hil": {"tables", "controller", "plant"},
    "discrepancy": set(),
    "app": {"tables", "controller", "plant", "hil", "discrepancy"},
    "tests/rig": set(),
}
BORDER_OF_DISCREPANCY = ("discrepancy/adapter.py", "discrepancy/report.py", "discrepancy/own_report.py")  # know hil or more
CLOCKS_AND_BUSES = {"asyncio", "can", "cantools", "datetime", "sched", "selectors", "signal", "socket", "threading", "time"}

# What each package exports. To change it on purpose, paste the line that the failing test prints.
EXPORTS: dict[str, list[str]] = {
    "app": [],
    "controller": [
        *("Calibration", "FAULTS", "INPUTS", "MODES", "SCALARS", "STATE", "STRATEGIES"),
        *("load_calibration", "new_inputs", "new_state", "tick"),
    ],
    "discrepancy": ["Effect", "Parameter", "Record", "Stage", "StageError", "System", "load_system", "unknown"],
    "hil": ["Channel", "Log", "LogError", "ReplayResult", "Run", "Stimulus", "read_log", "write_log"],
    "plant": ["Geometry", "Model", "Plant", "Schedules", "build_plant", "load_geometry", "load_model", "load_schedules", "write_model"],
    "plant.effects": ["DERIVED", "EFFECTS", "NEUTRAL", "N_PARAMETERS", "N_STATE", "ROW", "STATE", "STATE_ROW", "rows_at"],
    "tables": ["Axis", "Bound", "Bounded", "InputError", "Quantity", "Table", "load_toml", "path", "read"],
}


def imported_names(source: str, file: str) -> Iterator[tuple[int, str]]:
    """Every dotted name that ``source`` imports, with its line, wherever in the file the import stands.

    ``from a.b import c`` gives a.b and a.b.c (c may be a module); relative imports are resolved against ``file``;
    import_module("a") and __import__("a") with a constant name count too.
    """
    package = Path(file).parent.parts
    for node in ast.walk(ast.parse(source, file)):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield node.lineno, alias.name
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else ()
            base = ".".join([*above, *([node.module] if node.module else [])])
            yield node.lineno, base
            for alias in node.names:
                yield node.lineno, f"{base}.{alias.name}"
        elif isinstance(node, ast.Call) and node.args and isinstance(node.args[0], ast.Constant) and isinstance(node.args[0].value, str):
            called = node.func.attr if isinstance(node.func, ast.Attribute) else node.func.id if isinstance(node.func, ast.Name) else ""
            if called in ("import_module", "__import__"):
                yield node.lineno, node.args[0].value


def may_import(file: str, name: str) -> bool:
    """Whether the architecture lets ``file`` (path from the root, with /) import the dotted ``name``."""
    top = name.split(".")[0]
    home = "tests/rig" if file.startswith("tests/rig/") else file.split("/")[0]
    if home in ("controller", "plant") and top in CLOCKS_AND_BUSES:
        return False
    if top not in OURS:
        return True
    if file == "app/hidden_effect.py" and top == "tests":
        return True  # the blind benchmark hides effects with the rig, and says so where there is no checkout
    if home == "tests/rig":
        return name in ("tests", "tests.rig") or name.startswith("tests.rig.")
    if file in BORDER_OF_DISCREPANCY:
        return top in {"tables", "controller", "plant", "hil", "discrepancy"}
    if home == "discrepancy" and name.startswith(("discrepancy.adapter", "discrepancy.report", "discrepancy.own_report")):
        return False  # the core would know the vane chain through them
    return top == home or top in MAY_IMPORT[home]


def complaints(source: str, file: str) -> list[str]:
    """Imports in ``source`` that the architecture forbids to ``file``, as ``file:line imports name``."""
    return sorted({f"{file}:{line} imports {name}" for line, name in imported_names(source, file) if not may_import(file, name)})


def python_files(folder: str) -> list[Path]:
    """Python sources under ``folder`` of the checkout."""
    return sorted(p for p in (ROOT / folder).rglob("*.py") if "__pycache__" not in p.parts)


def tracked_files() -> list[Path]:
    """Files that git tracks; skips outside a git checkout (a source archive, say)."""
    try:
        listed = subprocess.run(["git", "-C", str(ROOT), "ls-files", "-z"], capture_output=True, check=True).stdout.decode()
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("not a git checkout: tracked files are not known")
    return [ROOT / name for name in listed.split("\0") if name and (ROOT / name).is_file()]


@pytest.mark.parametrize("home", MAY_IMPORT)
def test_imports_run_the_way_the_architecture_says(home: str) -> None:
    files = python_files(home)
    assert files, f"{home} has no Python file"
    wrong = [c for f in files for c in complaints(f.read_text(encoding="utf-8"), f.relative_to(ROOT).as_posix())]
    assert not wrong, "\n" + "\n".join(wrong)


@pytest.mark.parametrize(
    ("file", "source", "caught"),
    [
        ("tables/x.py", "import controller", "controller"),
        ("tables/x.py", "from . import path", None),
        ("controller/x.py", "def f():\n    from plant.effects import play", "plant.effects"),
        ("controller/x.py", "import time", "time"),
        ("controller/x.py", "from tables import read", None),
        ("plant/effects/x.py", "from .. import controller", None),  # plant.controller, which is plant's own
        ("plant/x.py", "import importlib\nimportlib.import_module('hil.runner')", "hil.runner"),
        ("plant/x.py", "m = __import__('controller')", "controller"),
        ("hil/x.py", "import discrepancy.core as d", "discrepancy.core"),
        ("hil/x.py", "from plant import chain\nfrom controller import tick", None),
        ("hil/x.py", "if True:\n    import tests.rig", "tests.rig"),
        ("discrepancy/locate.py", "import hil.logs", "hil.logs"),
        ("discrepancy/locate.py", "from tables import InputError", "tables"),
        ("discrepancy/locate.py", "from discrepancy import adapter", "discrepancy.adapter"),
        ("discrepancy/laws/x.py", "from ..adapter import chain", "discrepancy.adapter"),
        ("discrepancy/laws/adapter.py", "import plant", "plant"),
        ("discrepancy/adapter.py", "import plant, controller, hil, tables", None),
        ("discrepancy/report.py", "import app", "app"),
        ("app/x.py", "import hil, discrepancy.adapter", None),
        ("app/x.py", "import benchmarks", "benchmarks"),
        ("tests/rig/x.py", "import tables", "tables"),
        ("tests/rig/x.py", "from plant.linkage import ring_angle", "plant.linkage"),
        ("tests/rig/x.py", "from tests.test_plant import make", "tests.test_plant"),
        ("tests/rig/x.py", "from tests.rig.geometry import read\nfrom .geometry import read", None),
    ],
)
def test_a_forbidden_import_is_caught(file: str, source: str, caught: str | None) -> None:
    found = complaints(source, file)
    if caught is None:
        assert found == []
    else:
        assert any(c.endswith(f" imports {caught}") for c in found), found


def packages_with_init() -> list[str]:
    """Dotted names of all our packages that have an ``__init__.py``."""
    inits = [p for top in PACKAGES for p in python_files(top) if p.name == "__init__.py"]
    return sorted(".".join(p.parent.relative_to(ROOT).parts) for p in inits)


@pytest.mark.parametrize("package", packages_with_init())
def test_every_exported_name_exists_and_is_expected(package: str) -> None:
    module = importlib.import_module(package)
    assert Path(str(module.__file__)).is_relative_to(ROOT), f"{package} comes from {module.__file__}, not from this checkout"
    exported = getattr(module, "__all__", None)
    assert exported is not None, f"{package}/__init__.py has no __all__"
    missing = [name for name in exported if not hasattr(module, name)]
    assert not missing, f"{package}.__all__ names what {package} does not have: {missing}"
    line = f'    "{package}": [{", ".join(f"{name!r}" for name in sorted(exported))}],'.replace("'", '"')
    assert sorted(exported) == sorted(EXPORTS.get(package, [])), f"{package} exports something else; if meant, EXPORTS needs\n{line}"


def test_no_file_names_a_place_on_one_machine() -> None:
    place = re.compile(r"(?<![\w./~$}*>-])/(?:work|tmp|home|root|Users)/\w")
    found = []
    for file in tracked_files():
        data = file.read_bytes()
        if b"\0" in data[:8192]:
            continue
        for number, line in enumerate(data.decode("utf-8", "replace").splitlines(), 1):
            if place.search(line):
                found.append(f"{file.relative_to(ROOT)}:{number}: {line.strip()[:120]}")
    assert not found, "\n" + "\n".join(found)


def test_no_tracked_file_is_larger_than_a_mebibyte() -> None:
    large = [f"{f.relative_to(ROOT)}: {f.stat().st_size / 2**20:.2f} MiB" for f in tracked_files() if f.stat().st_size > 2**20]
    assert not large, "\n".join(large)


def test_no_installed_package_takes_one_of_our_names() -> None:
    owners = metadata.packages_distributions()
    foreign = {top: sorted({d for d in owners.get(top, []) if d.lower() != "vaneloop"}) for top in PACKAGES}
    assert not any(foreign.values()), f"installed packages that hide ours: { {k: v for k, v in foreign.items() if v} }"


def test_every_requirement_is_pinned() -> None:
    def name(requirement: str) -> str:
        return re.sub(r"[-_.]+", "-", re.split(r"[\s<>=!~;\[]", requirement.strip(), maxsplit=1)[0]).lower()

    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pinned = {name(x) for x in lines if "==" in x and not x.startswith("#")}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    wanted = [*project["dependencies"], *(r for extra in project["optional-dependencies"].values() for r in extra)]
    assert {name(r) for r in wanted} <= pinned, {name(r) for r in wanted} - pinned
    assert "tables" not in pinned, "the package `tables` (PyTables) would hide ours"
