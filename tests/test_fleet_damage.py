"""A run folder that a disk has spoilt, or that somebody made to do harm: what is damaged is a row with its reason, the
rest is reported, and nothing outside of the folder is touched.

Each damage is one of `DAMAGES` at a place drawn by chance. Then status, report and work (or run) look at the folder, in
this process, with a stand-in for the reader of logs.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import threading
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

pytest.importorskip("psutil", reason="the extra `fleet` is not installed")
pytest.importorskip("duckdb", reason="the extra `fleet` is not installed")

from tests.conftest import ROOT
from vaneloop.base import terminal
from vaneloop.base.child import python
from vaneloop.base.errors import InputError
from vaneloop.base.tables import path as shipped
from vaneloop.cli import campaign, fleet
from vaneloop.cli import options as cli_options
from vaneloop.cli.main import main
from vaneloop.fleet import folder, kinds, worker
from vaneloop.fleet.files import whole_json
from vaneloop.fleet.folder import Folder
from vaneloop.fleet.leases import Leases
from vaneloop.fleet.sources import find
from vaneloop.fleet.worker import work

KINDS_OF_FILES = ("run.json", "logs", "parts", "results", "leases", "workers", "journal", "machine")
HANGS = 600  # s after which a command waits for ever: a thousand times what any takes
BAD_VALUES: tuple[Any, ...] = (
    None, True, -1, 0.5, 1e308, 10**18, 10**40, float("nan"), float("inf"), "", "../../outside", "/etc/passwd", "a\nb",
    "\x1b[2Jx", "<script>", "\ud800", "x" * 100_000, [], {}, [[]], {"a": {"b": []}},
)  # fmt: skip


class Stand:
    """A reader that answers at once."""

    def __init__(self, kind: str, run: str, stopped: threading.Event, device: str):
        """As `vaneloop.fleet.reader.Reader`."""

    def ask(self, path: str, options: dict[str, Any], limit: float, *beside: Any) -> dict[str, Any]:
        """An answer as a diagnosis has it."""
        return {"status": "done", "reason": "", "verdict": "missing", "answer": answer(len(path))}

    def stop(self) -> None:
        """Nothing to end."""


def answer(k: int) -> dict[str, Any]:
    """The answer to a log."""
    size = {"effect": "dip", "stage": "s", "probability": 0.5, "parameter": "q", "unit": "MPa", "value": 1.0 + k,
            "low": 0.5, "high": 1.5, "neutral": 0.0}  # fmt: skip
    row = {"stage": "s", "parameter": "p", "unit": "deg", "value": 2.0 + k, "low": 1.0, "high": 3.0, "table": 0.0,
           "tolerance": None}  # fmt: skip
    return {
        "log": "a", "verdict": "missing", "duration_s": 60.0, "sizes": [size], "nominal": [row], "notes": ["n"],
        "not_observable": [{"effect": "x", "stage": "s", "needs": "n"}],
        "stages": [{"stage": "t", "verdict": "not_observed", "reason": "r"}],
        "effects": [{**size, "rivals": [], "parameters": {"q": size}}],
    }  # fmt: skip


@pytest.fixture(autouse=True)
def nearby(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Workers work in this process, and with a stand-in."""
    monkeypatch.setattr(worker, "Reader", Stand)

    def rented(run: Folder, on: str, n: int, queue: Any, every: float, told: Any, trust: str = "") -> dict[str, int]:
        return work(run.path, every=every, patience=0.5, wait=False, trust=trust)

    for command in (campaign, fleet):
        monkeypatch.setattr(command, "rent", rented)
    yield


def whole(at: Path) -> Folder:
    """A run of twelve logs: chunks that are finished, in work, and free; workers of other hosts; a table."""
    logs = at / "logs"
    for k in range(12):
        (logs / f"e{k % 3}").mkdir(parents=True, exist_ok=True)
        (logs / f"e{k % 3}" / f"2026-01-{1 + k:02d}.csv").write_text(f"log {k}")
    (at / "outside").mkdir()
    (at / "outside" / "kept.txt").write_text("kept")
    (at / "tables").mkdir()
    shutil.copy(shipped("plant.toml"), at / "tables")
    reading = {"mapping": {}, "units": {}, "design_rpm": None, "guess": True}
    options = {"files": folder.copies_of({"tables": ""}), "reading": reading, "limit": 3600.0}
    run = Folder.begin(at / "run", kinds.DIAGNOSIS, options, {"tables": str(at / "tables")})
    run.add(find([str(logs)]), 3)
    for n, (chunk, entries) in enumerate(run.chunks().items()):
        for k, e in enumerate(entries[: (3, 3, 2, 0)[n]]):
            row = {"key": e.key, "status": "done", "reason": "", "verdict": "missing", "answer": answer(k)}
            whole_json(run.results(chunk) / f"{e.key}.json", row)
        if n < 2:
            assert run.close(chunk, entries)
    (run.results("000000-000002") / f"{run.chunks()['000000-000002'][2].key}.tried").write_text("begin\n")
    whole_json(run.path / "workers" / "far.json", {"host": "far", "pid": 7, "started": 1.0, "kind": "worker"})
    (run.path / "workers" / "far.beat").write_text("3")
    assert Leases(run.path).take(["000000-000003"], "gone")
    (run.path / "journal").mkdir()
    (run.path / "journal" / "far.jsonl").write_text('{"what": "took", "at": 1.0}\n')
    return run


# ---- damages ---------------------------------------------------------------------------------------------------------


def _any(run: Path, draw: random.Random, where: str = "") -> Path:
    """A file of the run, of a kind drawn first, so that the few are hit as often as the many."""
    where = where or draw.choice(KINDS_OF_FILES)
    if where == "run.json":
        return run / where
    return draw.choice(sorted(f for f in (run / where).rglob("*") if f.is_file() and not f.is_symlink()))


def _truncated(run: Path, draw: random.Random) -> None:
    file = _any(run, draw)
    os.truncate(file, draw.randrange(max(file.stat().st_size, 1)))


def _garbled(run: Path, draw: random.Random) -> None:
    file = _any(run, draw)
    data = bytearray(file.read_bytes())
    for _ in range(draw.choice((1, 5, 50))):
        if data:
            data[draw.randrange(len(data))] = draw.randrange(256)
    file.write_bytes(data)


def _garbage(run: Path, draw: random.Random) -> None:
    _any(run, draw).write_bytes(draw.randbytes(draw.choice((1, 100, 10_000))))


def _encoded(run: Path, draw: random.Random) -> None:
    file = _any(run, draw)
    file.write_bytes(file.read_bytes().decode("latin-1").encode(draw.choice(("utf-16", "utf-8-sig", "utf-7"))))


def _missing(run: Path, draw: random.Random) -> None:
    _any(run, draw).unlink()


def _folder_for_a_file(run: Path, draw: random.Random) -> None:
    file = _any(run, draw)
    file.unlink()
    file.mkdir()
    (file / "x.parquet").write_text("x")


def _pipe_for_a_file(run: Path, draw: random.Random) -> None:
    file = _any(run, draw)
    file.unlink()
    os.mkfifo(file)


def _link_for_a_file(run: Path, draw: random.Random) -> None:
    file = _any(run, draw)
    file.unlink()
    file.symlink_to(draw.choice((run.parent / "outside" / "kept.txt", run.parent / "outside", Path("/dev/zero"), file)))


def _link_for_a_folder(run: Path, draw: random.Random) -> None:
    room = draw.choice(sorted(p for p in run.rglob("*") if p.is_dir() and not p.is_symlink()))
    shutil.rmtree(room)
    room.symlink_to(run.parent / "outside")


def _file_for_a_folder(run: Path, draw: random.Random) -> None:
    room = draw.choice(sorted(p for p in run.rglob("*") if p.is_dir() and not p.is_symlink()))
    shutil.rmtree(room)
    room.write_text("x")


def _paths(data: Any, at: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Every place in JSON."""
    yield at
    for k, v in data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ():
        yield from _paths(v, (*at, k))


def _spoilt(data: Any, draw: random.Random) -> Any:
    """JSON with one value, drawn by chance, that is another, gone, or deeper than any."""
    place = draw.choice(list(_paths(data)))
    if not place:
        return draw.choice(BAD_VALUES)
    inner = data
    for k in place[:-1]:
        inner = inner[k]
    if draw.random() < 0.2 and isinstance(inner, dict):
        del inner[place[-1]]
    else:
        inner[place[-1]] = draw.choice(BAD_VALUES)
    return data


def _value(run: Path, draw: random.Random) -> None:
    file = _any(run, draw, draw.choice(("run.json", "results", "leases", "workers")))
    if file.suffix == ".json" or file.parent.name == "leases":
        file.write_text(json.dumps(_spoilt(json.loads(file.read_text()), draw)))


def _deep(run: Path, draw: random.Random) -> None:
    text = draw.choice(("[" * 200_000, '{"a":' * 200_000, "[" * 900 + "]" * 900, "9" * 5000))
    _any(run, draw, draw.choice(("run.json", "results", "leases", "workers"))).write_text(text)


def _cell(run: Path, draw: random.Random) -> None:
    """A value of a table, of the right type or not."""
    file = _any(run, draw, draw.choice(("logs", "parts")))
    rows = pq.read_table(file).to_pylist()
    row = draw.choice(rows)
    name = draw.choice(list(row))
    if name == "answer" and draw.random() < 0.8:
        row[name] = json.dumps(_spoilt(json.loads(row[name]), draw))
    else:
        bad = [v for v in BAD_VALUES if v is None or type(v) is type(row[name]) and v != "\ud800" and v != 10**40]
        row[name] = draw.choice(bad)
    pq.write_table(pa.Table.from_pylist(rows), file)


def _columns(run: Path, draw: random.Random) -> None:
    """A table that lacks a column, has one of another type, or holds nothing."""
    file = _any(run, draw, draw.choice(("logs", "parts")))
    table = pq.read_table(file)
    name = draw.choice(table.schema.names)
    kind = draw.randrange(3)
    if kind == 0:
        table = table.drop_columns([name])
    elif kind == 1:
        at = table.schema.get_field_index(name)
        table = table.set_column(at, name, pa.array([[1.5]] * table.num_rows))
    pq.write_table(table.slice(0, 0) if kind == 2 else table, file)


def _twice(run: Path, draw: random.Random) -> None:
    """Rows, chunks or workers that are there twice."""
    file = _any(run, draw, draw.choice(("logs", "parts", "workers", "leases")))
    if file.suffix == ".parquet":
        table = pq.read_table(file)
        pq.write_table(pa.concat_tables([table, table]), file)
        shutil.copy(file, file.with_name("000009-000000.parquet" if "-" in file.name else "000009.parquet"))
    else:
        shutil.copy(file, file.with_name(f"{file.name.partition('.')[0]}.999999999999"))


def _names(run: Path, draw: random.Random) -> None:
    """Things with names that no run gives."""
    name = draw.choice(("a\nb", "\x1b[31m", "..x", "[1]*?", "'; DROP TABLE logs; --", "x" * 250, "\udcff", "²"))
    room = run / draw.choice(("logs", "parts", "results", "leases", "workers", "journal"))
    for suffix in ("", ".parquet", ".json"):
        if len(name + suffix) < 255:
            (room / (name + suffix)).write_text("x")
    (room / "000000-000001.parquet").write_bytes(_any(run, draw, "parts").read_bytes())


def _outward(run: Path, draw: random.Random) -> None:
    """A file that names things outside."""
    bad = draw.choice(("../../outside/kept.txt", "/etc/passwd", "machine/../../outside", "machine/.."))
    job = json.loads((run / "run.json").read_text())
    kind = draw.randrange(4)
    if kind == 0:
        job["files"] = job["options"]["files"] = {"tables": bad}
    elif kind == 1:
        job["kind"] = draw.choice(("runpy:run_path", "os:system", "tests.fleet_jobs:read", ""))
    elif kind == 2:
        job["options"]["reading"]["dbc"] = bad
    else:
        file = _any(run, draw, "logs")
        rows = pq.read_table(file).to_pylist()
        for row in rows:
            row[draw.choice(("chunk", "key", "path"))] = f"../{bad}"
        pq.write_table(pa.Table.from_pylist(rows), file)
    (run / "run.json").write_text(json.dumps(job))


DAMAGES: tuple[Callable[[Path, random.Random], None], ...] = (
    _truncated, _garbled, _garbage, _encoded, _missing, _folder_for_a_file, _pipe_for_a_file, _link_for_a_file,
    _link_for_a_folder, _file_for_a_folder, _value, _deep, _cell, _columns, _twice, _names, _outward,
)  # fmt: skip


# ---- what the commands make of it ------------------------------------------------------------------------------------


def outside(at: Path) -> dict[str, bytes]:
    """All files beside the run, and what they hold."""
    return {str(f): f.read_bytes() for f in sorted(at.rglob("*")) if (at / "run") not in f.parents and f.is_file()}


def ran(words: list[str], capsys: pytest.CaptureFixture[str]) -> tuple[int, str]:
    """Exit code and text of a command, which must not hang."""

    def hangs(*_: Any) -> None:
        raise AssertionError(f"{' '.join(words)} hangs")

    before = signal.signal(signal.SIGALRM, hangs)
    signal.setitimer(signal.ITIMER_REAL, HANGS)
    try:
        code = main(words)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
    said = capsys.readouterr()
    return code, said.out + said.err


def survives(at: Path, seed: int, capsys: pytest.CaptureFixture[str]) -> list[int]:
    """Do one damage to a run, have every command look at it, and return their exit codes."""
    draw = random.Random(seed)
    run = whole(at)
    damage = DAMAGES[seed % len(DAMAGES)]
    damage(run.path, draw)
    before = outside(at)
    codes = []
    commands = [
        ["fleet", "status", str(run.path)],
        ["fleet", "report", str(run.path)],
        ["fleet", "work", str(run.path), "--patience", "0.5"] if seed % 2 else
        ["fleet", "run", str(at / "logs"), "--out", str(run.path), "--tables", str(at / "tables")],
        ["fleet", "status", str(run.path)],
        ["fleet", "report", str(run.path)],
    ]  # fmt: skip
    for words in commands:
        code, text = ran(words, capsys)
        assert code in (0, 1, 2), (damage.__name__, seed, words, text)
        assert "internal error" not in text and "Traceback" not in text, (damage.__name__, seed, text)
        assert not any(c in text for c in "\x1b\x07\x9b"), (damage.__name__, seed, text)
        if code == 2:
            assert text.startswith("vaneloop: ") and text.count("\n") == 1, (damage.__name__, seed, text)
        codes.append(code)
    assert outside(at) == before, (damage.__name__, seed)
    return codes


@pytest.mark.parametrize("seed", range(0, len(DAMAGES), 3))
def test_a_damage_is_said_and_the_rest_is_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], seed: int
) -> None:
    survives(tmp_path, seed, capsys)


@pytest.mark.slow
@pytest.mark.parametrize("kind", range(len(DAMAGES)), ids=[d.__name__.strip("_") for d in DAMAGES])
def test_of_a_hundred_and_two_damaged_run_folders_none_is_a_defect(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], kind: int
) -> None:
    for k in range(1, 7):
        survives(tmp_path / str(k), kind + k * len(DAMAGES), capsys)


# ---- a folder that somebody made to do harm --------------------------------------------------------------------------


def with_job(run: Folder, **keys: Any) -> None:
    """Change keys of run.json."""
    file = run.path / "run.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | keys))


@pytest.mark.parametrize("kind", ["runpy:run_path", "vaneloop.fleet.diagnosis:diagnose_log", ""])
def test_a_run_folder_names_no_function(tmp_path: Path, capsys: pytest.CaptureFixture[str], kind: str) -> None:
    run = whole(tmp_path)
    with_job(run, kind=kind, function="runpy:run_path")
    code, text = ran(["fleet", "work", str(run.path)], capsys)
    assert code == 2 and f"has kind {kind!r}; allowed: diagnosis, trial" in text
    assert ran(["fleet", "status", str(run.path)], capsys)[0] == 0, "to look at it is no harm"


@pytest.mark.parametrize("reading", [{"dbc": "/etc/passwd"}, {"mapping_file": "x"}, {"tables": {}}, {"guess": "yes"}])
def test_a_run_folder_names_no_file_but_its_own(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], reading: dict[str, Any]
) -> None:
    run = whole(tmp_path)
    with_job(run, options=run.job["options"] | {"reading": reading})
    code, text = ran(["fleet", "work", str(run.path)], capsys)
    assert code == 2 and f"options with a wrong reading.{next(iter(reading))}" in text


@pytest.mark.parametrize(("column", "value"), [
    ("chunk", "../../outside"), ("chunk", "."), ("key", "../../outside/kept.txt"), ("key", f"{'0' * 64}./../x"),
    ("path", "logs/e1/x.csv"), ("path", "/a\0b"),
])  # fmt: skip
def test_a_name_that_leads_outside_is_a_damaged_row(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], column: str, value: str
) -> None:
    run, before = whole(tmp_path), outside(tmp_path)
    (batch,) = (run.path / "logs").iterdir()
    rows = pq.read_table(batch).to_pylist()
    rows[-1][column] = value
    pq.write_table(pa.Table.from_pylist(rows, schema=folder._schema()), batch)
    assert ran(["fleet", "work", str(run.path), "--patience", "0.5"], capsys)[0] == 1
    code, text = ran(["fleet", "status", str(run.path)], capsys)
    assert code == 1 and "11 of 11 contents done" in text and "000000.parquet" in text and f"row 12: {column}" in text
    assert outside(tmp_path) == before


def test_a_damaged_part_is_a_row_and_the_same_run_heals_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = whole(tmp_path / "a [1]*?'\"")  # what a pattern or a query would take for its own
    words = ["fleet", "run", str(run.path.parent / "logs"), "--out", str(run.path), "--tables",
             str(run.path.parent / "tables")]  # fmt: skip
    (run.path / "parts" / "000000-000001.parquet").write_bytes(b"PAR1 and nothing more")
    code, text = ran(["fleet", "status", str(run.path)], capsys)
    assert code == 1 and "5 of 12" in text and "parts/000000-000001.parquet" in text
    page, tables = tmp_path / "f.html", tmp_path / "t"
    code, text = ran(["fleet", "report", str(run.path), "--report", str(page), "--tables-out", str(tables)], capsys)
    assert code == 1 and "parts/000000-000001.parquet" in text and "parts/000000-000001.parquet" in page.read_text()
    assert pq.read_table(tables / "effects.parquet").num_rows == 3
    assert ran(words, capsys)[0] == 0
    code, text = ran(["fleet", "status", str(run.path)], capsys)
    assert code == 0 and "12 of 12" in text and "damaged" not in text


def test_a_damaged_answer_is_a_row_and_a_retry_makes_it_anew(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = whole(tmp_path)
    part = run.path / "parts" / "000000-000000.parquet"
    rows = pq.read_table(part).to_pylist()
    rows[0]["answer"] = json.dumps(answer(0) | {"sizes": [{"effect": None}]})
    pq.write_table(pa.Table.from_pylist(rows), part)
    code, text = ran(["fleet", "report", str(run.path), "--report", str(tmp_path / "f.html")], capsys)
    page = (tmp_path / "f.html").read_text()
    assert "internal" not in text and "its answer is damaged" in page and len(rows) == 3
    words = ["fleet", "run", str(tmp_path / "logs"), "--out", str(run.path), "--tables", str(tmp_path / "tables")]
    for more, left in (([], True), (["--retry"], False)):
        assert ran([*words, *more], capsys)[0] == 0
        ran(["fleet", "report", str(run.path), "--report", str(tmp_path / "f.html")], capsys)
        assert ("its answer is damaged" in (tmp_path / "f.html").read_text()) == left


@pytest.mark.parametrize(
    "room", ["results", "leases", "workers", "journal", "parts", "logs", "machine", "worst", "failed"]
)
def test_a_link_in_place_of_a_folder_is_not_followed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], room: str
) -> None:
    run = whole(tmp_path)
    if (run.path / room).exists():
        shutil.rmtree(run.path / room)
    (run.path / room).symlink_to(tmp_path / "outside")
    before = outside(tmp_path)
    code, text = ran(["fleet", "work", str(run.path)], capsys)
    assert code == 2 and f"{room}: is a link; the run folder is damaged" in text and outside(tmp_path) == before


@pytest.mark.parametrize("change", ["more", "other", "less"])
def test_a_machine_is_the_one_that_the_run_was_begun_with(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], change: str
) -> None:
    run = whole(tmp_path)
    table = run.path / "machine" / "tables" / "plant.toml"
    if change == "less":
        table.unlink()
    else:
        (table if change == "other" else run.path / "machine" / "json.py").write_text("# 2\n")
    words = ["fleet", "run", str(tmp_path / "logs"), "--out", str(run.path), "--tables", str(tmp_path / "tables")]
    for command in (["fleet", "work", str(run.path)], words):
        code, text = ran(command, capsys)
        assert code == 2 and "machine: " in text and "the run folder is damaged" in text


def test_a_machine_that_was_left_before_its_run_was_begun_is_not_taken_for_it(tmp_path: Path) -> None:
    (tmp_path / "run" / "machine").mkdir(parents=True)
    (tmp_path / "run" / "machine" / "model.toml").write_text("a = 1\n")
    (tmp_path / "mine.toml").write_text("a = 2\n")
    with pytest.raises(InputError, match="is not the machine that the run was begun with"):
        Folder.begin(tmp_path / "run", kinds.DIAGNOSIS, {}, {"model": str(tmp_path / "mine.toml")})


@pytest.mark.parametrize("name", ["system", "controller", "firmware.mine"])
def test_code_of_a_run_folder_runs_only_where_the_user_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    asked: list[str] = []
    monkeypatch.setattr(Stand, "ask", lambda self, path, options, limit, *more: asked.append(path) or {
        "status": "done", "reason": "", "verdict": "none", "answer": {}})  # fmt: skip
    (tmp_path / "mine.py").write_text("raise SystemExit('run')\n")
    (tmp_path / "a.csv").write_text("log")
    given = {name: str(tmp_path / "mine.py")}
    options = {"files": folder.copies_of(given), "reading": {}, "limit": 9.0}
    run = Folder.begin(tmp_path / "run", kinds.DIAGNOSIS, options, given)
    run.add(find([str(tmp_path / "a.csv")]))
    code, text = ran(["fleet", "work", str(run.path)], capsys)
    assert code == 2 and f"machine/{name}.py" in text and "--trust" in text and not asked
    with pytest.raises(InputError, match="its workers would run code that the folder brings"):
        work(run.path)
    for command in ("status", "report"):
        ran(["fleet", command, str(run.path)], capsys)
    assert not asked and ran(["fleet", "work", str(run.path), "--trust"], capsys)[0] == 0 and len(asked) == 1


@pytest.mark.parametrize(("said", "trusted"), [("y\n", True), ("yes\n", True), ("n\n", False), ("", False)])
def test_at_a_terminal_the_user_is_asked(monkeypatch: pytest.MonkeyPatch, said: str, trusted: bool) -> None:
    other, end = os.openpty()
    os.write(other, said.encode() or b"\x04")  # Ctrl-D: nothing more is typed
    args = argparse.Namespace(trust=False)
    with os.fdopen(end) as keys:
        monkeypatch.setattr("sys.stdin", keys)
        with nullcontext() if trusted else pytest.raises(InputError, match="^RUN: its code was not run$"):
            cli_options.trusted(args, "RUN", ["RUN/machine/system.py"])
    os.close(other)


def test_a_plan_of_a_campaign_brings_no_controller_unasked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "plan.toml").write_text(
        'title = "of another"\nscenarios = ["demand_stops"]\n[vary]\n"sensors.vigv_bias" = "tolerance"\n'
        '[[firmware]]\nname = "mine"\ncontroller = "mine.so"\n'
    )
    words = ["campaign", str(tmp_path / "plan.toml"), "--out", str(tmp_path / "run")]
    code, text = ran(words, capsys)
    assert code == 2 and "mine.so" in text and "--trust" in text and not (tmp_path / "run").exists()
    code, text = ran([*words, "--trust"], capsys)
    assert code == 2 and "--trust" not in text, "there is no such library"


def test_a_process_of_ours_takes_no_module_from_where_the_user_stands(tmp_path: Path) -> None:
    (tmp_path / "numba.py").write_text("print('of another')\n")
    (tmp_path / "colorsys.py").write_text("print('of another')\n")
    code = "import colorsys, importlib.util as u; print(u.find_spec('numba').origin, u.find_spec('vaneloop').origin)"
    said = subprocess.run(python(code), cwd=tmp_path, capture_output=True, text=True, check=True).stdout
    assert "of another" not in said and str(tmp_path) not in said and str(ROOT) in said


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("\x1b[2Jgone", r"\x1b[2Jgone"), ("a\rb\x07\x9b", r"a\x0db\x07\x9b"), ("\u202egpj", r"\u202egpj"),
        ("Düse 5 °C", "Düse 5 °C"), ("\udcff", r"\udcff"), ("a\nb", r"a\x0ab"),
    ],
)  # fmt: skip
def test_a_name_does_nothing_to_a_terminal(text: str, shown: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert terminal.clean(text) == shown and terminal.clean("a\nb", lines=True) == "a\nb"
    args = argparse.Namespace(quiet=False, json=None)
    terminal.print_table(args, "names", ["name"], [[text]])
    assert shown in capsys.readouterr().out

    def refuses() -> int:
        raise InputError(f"{text}: is not there")

    assert terminal.run(refuses) == 2 and capsys.readouterr().err == f"vaneloop: {shown}: is not there\n"


def test_a_log_whose_name_is_not_utf_8_is_a_row(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = whole(tmp_path)
    with open(os.fsencode(tmp_path / "logs") + b"/e0/\xff_2026-02-01.csv", "w") as f:
        f.write("log 99")
    words = ["fleet", "run", str(tmp_path / "logs"), "--out", str(run.path), "--tables", str(tmp_path / "tables")]
    for new in (1, 0):
        code, text = ran(words, capsys)
        assert code == 0 and f"13 logs, {new} of them new" in text
    (bad,) = (e for e in run.entries() if e.reason)
    assert bad.path.endswith(r"e0/\udcff_2026-02-01.csv") and "is not UTF-8" in bad.reason
