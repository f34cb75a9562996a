"""The corpus: logs that other libraries wrote are what their generator writes, and are read as these read them."""

from __future__ import annotations

import json
from pathlib import Path

import asammdf
import can
import numpy as np
import pytest

from hil.logs import read_log
from hil.logs.formats import suffixes
from hil.logs.others import Compared, compare
from tests.corpus.make import FOLDER, SPEED, STROKE, make
from vaneloop.cli.main import main

DBC = FOLDER / "corpus.dbc"
LOGS = sorted(f for f in FOLDER.iterdir() if f.suffix not in (".py", ".dbc") and f.is_file())
# a process that opens an MDF4 file takes half a second, and there are three for each
READ = [pytest.param(f, marks=pytest.mark.slow if f.suffix == ".mf4" else ()) for f in LOGS if f.suffix in suffixes()]


def content(path: Path) -> list[tuple[object, ...]]:
    """What the library that wrote a file reads in it."""
    if path.suffix == ".dbc":
        return [(path.read_text(encoding="cp1252"),)]
    if path.name.startswith("asammdf"):
        with asammdf.MDF(path, process_bus_logging=False) as mdf:  # type: ignore[call-arg]
            return [
                (s.name, s.unit, s.samples.tolist(), s.timestamps.tolist())
                for g, group in enumerate(mdf.groups)
                for s in (mdf.get(group=g, index=i) for i in range(len(group.channels)))
            ]
    with can.LogReader(path) as reader:
        return [
            (m.timestamp, m.arbitration_id, m.is_extended_id, m.is_remote_frame, m.dlc, bytes(m.data)) for m in reader
        ]


def test_the_corpus_is_what_its_generator_writes(tmp_path: Path) -> None:
    make(tmp_path)
    assert {f.name for f in tmp_path.iterdir()} == {f.name for f in [*LOGS, DBC]}
    for file in [*LOGS, DBC]:
        assert content(tmp_path / file.name) == content(file), file.name
    assert sum(f.stat().st_size for f in LOGS) < 200_000


@pytest.mark.parametrize("file", READ, ids=lambda f: f.name)
def test_a_log_of_the_corpus_is_read_as_other_libraries_read_it(file: Path) -> None:
    log = read_log(file, dbc=DBC if file.name.startswith("python_can") or "virtual" in file.name else None)
    truth = {
        "n_dem": (SPEED, 0.005),
        "n_r": (SPEED - 0.5, 0.005),
        "x_lvdt": (STROKE, 0.0005),
        "x_dem": (STROKE, 0.0005),
    }
    assert len(log.channels) >= 2
    for name, c in log.channels.items():
        np.testing.assert_allclose(c.values, truth[name][0], atol=1.001 * truth[name][1], rtol=0)
    if file.suffix != ".dat":
        found = compare(file, {s: s for s in log.channels}, None if file.name == "asammdf.mf4" else DBC)
        assert len(found) >= len(log.channels) and [c for c in found if c.same is False] == []
        assert any(c.same for c in found)


def test_the_command_tells_where_another_library_reads_something_else(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    file = FOLDER / "python_can_fd.asc"
    words = ["map", "--check", str(file), "--dbc", str(DBC), "--json", str(tmp_path / "a.json")]
    assert main(words) == 0
    assert "python-can" in (said := capsys.readouterr().out) and "cantools" in said and "NO" not in said
    rows = json.loads((tmp_path / "a.json").read_text())["check"]
    assert [r["what"] for r in rows[:2]] == ["frames", "identifiers"] and all(r["same"] for r in rows)
    theirs = can.LogReader(file)
    lost = list(theirs)[:-1]
    monkeypatch.setattr(can, "LogReader", lambda path: _Reader(lost))
    assert main(words) == 1
    assert "NO" in capsys.readouterr().out
    lost[0].data[0] ^= 1
    lost.append(lost[-1])
    monkeypatch.setattr(can, "LogReader", lambda path: _Reader(lost))
    unlike = {c.what: c for c in compare(file, {}, DBC)}
    assert (
        unlike["bytes of data"].theirs.startswith("2 differ, the first in frame ") and not unlike["bytes of data"].same
    )


class _Reader(list[can.Message]):
    """Frames as a reader of python-can gives them."""

    def __enter__(self) -> _Reader:
        return self

    def __exit__(self, *_: object) -> None:
        pass


def test_what_no_other_library_reads_is_said(tmp_path: Path) -> None:
    (tmp_path / "a.crtd").write_text("1.0 1R11 00000123 00 01 02 03 04 05 06 07\n")
    (tmp_path / "a.csv").write_text("t,n_dem\n0,1\n1,2\n")
    assert compare(tmp_path / "a.crtd", {}, DBC)[0] == Compared(
        "frames", "1", "-", "python-can does not read CRTD", None
    )
    assert compare(tmp_path / "a.csv", {})[0].same is None
    (tmp_path / "a.log").write_text(" (1.0)  can0  123   [2]  01 02\n")
    assert compare(tmp_path / "a.log", {}, DBC)[0].theirs.startswith("fails (")
