"""What an installation without extras does: all that needs none of them, and one line for what does."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

from hil.logs import Channel, write_log
from plant import load_geometry
from tests.conftest import ROOT
from tests.syntax import nodes
from tests.test_structure import PACKAGES
from vaneloop.base import extras
from vaneloop.base.errors import InputError
from vaneloop.base.extras import EXTRAS, needed
from vaneloop.cli.main import COMMANDS, main
from vaneloop.design.multibody import multibody_angles
from vaneloop.design.spatial import spatial_check
from vaneloop.fleet.rent import rent

ASKED_FOR = [(extra, module, package) for extra, brought in EXTRAS.items() for module, package in brought.items()]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
# a file as far as its first two blocks say what it is
MDF4 = b"MDF     4.10    VaneLoop" + bytes(40) + b"##HD" + bytes(100)
WORDS = {
    "asammdf": ["compare run.mf4", "map run.mf4", "replay run.mf4", "record --bus local new.mf4",
                "run --bus lockstep --duration 1 --record new.mf4", "run --bus lockstep --inputs run.mf4"],
    "psutil": ["fleet status run", "campaign plan.toml --out run"],
    "duckdb": ["fleet report run", "campaign plan.toml --out run"],
    "ruptures": ["fleet report run"],
    "distributed": ["campaign plan.toml --out run --on slurm", "fleet run . --out run --on tcp://127.0.0.1:1"],
    "cryptography": ["campaign plan.toml --out run --on slurm", "fleet run . --out run --on slurm",
                     "run --bus lockstep --duration 1 --secoc env", "ecu --bus local --secoc env"],
    "nicegui": ["web --no-open"],
    "tsdownsample": ["web --no-open"],
    "fmpy": ["run --bus lockstep --duration 1 --plant plant.fmu"],
    "isotp": ["run --bus local --duration 1 --uds", "fuzz --tool uds"],
}  # fmt: skip


def names(requirements: list[str]) -> set[str]:
    """Names of packages as the package index has them."""
    return {re.sub(r"[-_.]+", "-", re.split(r"[\s<>=!~;\[]", r, maxsplit=1)[0]).lower() for r in requirements}


@pytest.mark.parametrize(("module", "words"), [(m, w) for m, commands in WORDS.items() for w in commands])
def test_a_command_without_its_extra_says_in_one_line_what_to_install(
    module: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "run.mf4").write_bytes(MDF4)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(extras, "is_there", lambda asked: asked != module)  # the others are, wherever this runs
    monkeypatch.setitem(sys.modules, module, None)
    assert main(words.split()) == 2
    (line,) = capsys.readouterr().err.splitlines()
    extra = "secoc" if "--secoc" in words else next(e for e, brought in EXTRAS.items() if module in brought)
    assert line.endswith(f" needs {EXTRAS[extra][module]}, which is not installed: pip install 'vaneloop[{extra}]'")
    assert [f.name for f in tmp_path.iterdir()] == ["run.mf4"], "files are left behind"


@pytest.mark.parametrize(("extra", "module", "package"), ASKED_FOR)
def test_what_asks_for_a_package_names_it_and_its_extra(
    extra: str, module: str, package: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert package in names(PROJECT["optional-dependencies"][extra])
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(InputError, match=rf"^A thing needs {package}, .*: pip install 'vaneloop\[{extra}\]'$"):
        needed("A thing", module, extra)


def test_no_log_is_written_as_mdf4_without_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "asammdf", None)
    with pytest.raises(InputError, match=r"a\.mf4: MDF4 needs asammdf, .* pip install 'vaneloop\[mdf\]'"):
        write_log(tmp_path / "a.mf4", {"n_dem": Channel(np.arange(9.0), np.arange(9.0))})


def test_no_queue_is_asked_without_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"--on slurm needs dask, .* pip install 'vaneloop\[fleet\]'"):
        rent(None, "slurm", 1, {}, 1.0, lambda done, of: None)  # type: ignore[arg-type]


def test_without_exudyn_the_linkage_in_space_is_checked_one_way(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "exudyn", None)
    check = spatial_check(load_geometry("geometry.toml"), points=3)
    assert not check.multibody and "pip install 'vaneloop[multibody]'" in check.notes[0]
    with pytest.raises(InputError, match=r"exudyn, .* pip install 'vaneloop\[multibody\]'"):
        multibody_angles(load_geometry("geometry.toml"), "vigv", np.array([0.0, 24.0]))


def test_help_completion_and_version_need_no_extra() -> None:
    script = (
        f"import sys; sys.modules.update(dict.fromkeys({[m for _, m, _ in ASKED_FOR]!r}))\n"
        "from vaneloop.cli.main import COMMANDS, main\n"
        "for words in [['--version'], ['completion', 'bash'], *([c, '--help'] for c in COMMANDS)]:\n"
        "    try: code = main(words)\n"
        "    except SystemExit as e: code = e.code\n"
        "    assert not code, words\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 0 and not done.stderr, done.stderr
    assert done.stdout.count("usage:") >= len(COMMANDS)


# modules that are not named as the package that brings them; whoever loads hil.inject.sil is pytest
BROUGHT_BY = {
    "can": "python-can", "llvmlite": "numba", "isotp": "can-isotp", "fastapi": "nicegui", "uvicorn": "nicegui",
}  # fmt: skip


def test_the_product_imports_only_what_is_installed_or_asked_for() -> None:
    known = names(PROJECT["dependencies"]) | {"pytest"}
    for extra in EXTRAS:
        known |= names(PROJECT["optional-dependencies"][extra])
    unknown = set()
    for file in (f for package in PACKAGES for f in (ROOT / package).rglob("*.py") if "templates" not in f.parts):
        for node in nodes(file.read_text(encoding="utf-8")):
            if isinstance(node, ast.Import):
                found = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                found = [node.module]
            else:
                continue
            for top in {name.partition(".")[0] for name in found} - set(sys.stdlib_module_names) - set(PACKAGES):
                if BROUGHT_BY.get(top, top) not in known:
                    unknown.add(f"{file.relative_to(ROOT)}: {top}")
    assert not unknown, "\n".join(sorted(unknown))
