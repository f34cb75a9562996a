"""Each notebook of docs/notebooks runs, and prints what stands in its file: the site shows the file."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.conftest import ROOT

nbformat = pytest.importorskip("nbformat")
nbclient = pytest.importorskip("nbclient")
pytest.importorskip("ipykernel")
pytestmark = pytest.mark.slow

FOLDER = ROOT / "docs" / "notebooks"


def printed(cell: dict) -> str:
    """What a cell of code printed."""
    return "".join(output.get("text", "") for output in cell.get("outputs", []))


def test_there_are_three_notebooks() -> None:
    assert len(list(FOLDER.glob("*.ipynb"))) >= 3


@pytest.mark.parametrize("file", sorted(FOLDER.glob("*.ipynb")), ids=lambda f: f.stem)
def test_a_notebook_runs_and_prints_what_it_shows(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    shown = nbformat.read(file, as_version=4)
    nbformat.validate(shown)
    run = nbformat.read(file, as_version=4)
    nbclient.NotebookClient(run, timeout=600, kernel_name="python3", resources={"metadata": {"path": FOLDER}}).execute()
    for before, after in zip(shown.cells, run.cells, strict=True):
        if before.cell_type == "code":
            assert printed(after) == printed(before), f"{file.name}: run it again and save it:\n{before.source}"
