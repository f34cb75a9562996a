"""A fleet run loses no log and does none twice, whoever is killed, and whatever a log does to its reader.

The logs are a stand-in's (tests/fleet_jobs.py), so that a run takes a second; the last tests run real logs.
"""

from __future__ import annotations

import contextlib
import json
import os
import random
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest

pytest.importorskip("psutil", reason="the extra `fleet` is not installed")

import tests.fleet_jobs  # noqa: F401 (the stand-in is a kind of work)
from tests.conftest import ROOT
from vaneloop.base.errors import InputError
from vaneloop.fleet import sources, state
from vaneloop.fleet.folder import Folder
from vaneloop.fleet.leases import Leases, Me
from vaneloop.fleet.worker import DEATHS, Journal, lines, work

JOB = "read"
ENV = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONDONTWRITEBYTECODE": "1"}
WORK = (
    "import sys; import tests.fleet_jobs; from vaneloop.fleet.worker import work\n"
    "from vaneloop.base import terminal\n"
    "sys.exit(terminal.run(lambda: bool(work(sys.argv[1], every=0.2, patience=float(sys.argv[2]))) * 0))"
)


@pytest.fixture(autouse=True)
def here(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The readers find the stand-in."""
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    yield


def fleet(tmp: Path, texts: dict[str, str], in_chunk: int | None = None, limit: float = 600.0) -> Folder:
    """A run of logs with these texts, nothing done yet."""
    for name, text in texts.items():
        (tmp / "logs" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp / "logs" / name).write_text(text, encoding="utf-8")
    folder = Folder.begin(tmp / "run", JOB, {"limit": limit}, {})
    folder.add(sources.find([str(tmp / "logs")]), in_chunk)
    return folder


def many(n: int, text: str = "log {i}") -> dict[str, str]:
    return {f"e{i % 3}/2026-01-{1 + i % 28:02d}_{i}.csv": text.format(i=i) for i in range(n)}


def rows(folder: Folder) -> list[dict[str, str]]:
    """All rows of all parts, in the order of their keys; every content must be there once."""
    out = [r for f in (folder.path / "parts").glob("*.parquet") for r in pq.read_table(f).to_pylist()]
    assert len({r["key"] for r in out}) == len(out)
    return sorted(out, key=lambda r: r["key"])


def of(folder: Folder, name: str) -> dict[str, str]:
    """The row of the log with this name."""
    (key,) = (e.key for e in folder.entries() if Path(e.path).name == name)
    (row,) = (r for r in rows(folder) if r["key"] == key)
    return row


def process(folder: Folder, patience: float = 600.0, **env: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", WORK, str(folder.path), str(patience)], env={**ENV, **env}, cwd=ROOT,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def until(happens: Callable[[], bool], p: subprocess.Popen[str] | None = None) -> None:
    """Wait for an event, however long it takes; fail where the process ends instead."""
    while not happens():
        assert p is None or p.poll() is None or happens(), p.stderr and p.stderr.read()
        time.sleep(0.01)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[str, ...]]:
    """Rows of 40 logs that nobody disturbed."""
    folder = fleet(tmp_path_factory.mktemp("calm"), many(40))
    work(folder.path)
    return [tuple(r.values()) for r in rows(folder)]


# ---- what is taken up ------------------------------------------------------------------------------------------------


def test_a_run_does_every_content_once(tmp_path: Path) -> None:
    folder = fleet(tmp_path, {**many(6), "e9/copy_2026-02-01.csv": "log 3"})
    assert work(folder.path) == {"done": 6}
    assert len(folder.entries()) == 7 and len(rows(folder)) == 6
    assert state.state_of(folder).came == {"done": 6}
    assert json.loads(of(folder, "copy_2026-02-01.csv")["answer"])["letters"] == 5
    assert work(folder.path) == {}, "a second worker finds nothing to do"


def test_engine_and_time_come_from_list_metadata_and_path(tmp_path: Path) -> None:
    import pyarrow as pa

    for name in ("a7/start_20260314T1230.csv", "a7/b.csv"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(name)
    said = pa.table({"t": [0.0]}).replace_schema_metadata({"engine": "b8", "time": "2026-03-15"})
    pq.write_table(said, tmp_path / "a7" / "c_2020-01-01.parquet")
    (tmp_path / "list.csv").write_text("path,engine,time\na7/b.csv,c9,2026-03-16 08:00\n")
    folder = Folder.begin(tmp_path / "run", JOB, {}, {})
    folder.add(sources.find([str(tmp_path / "a7")], str(tmp_path / "list.csv")))
    found = {Path(e.path).name: (e.engine, e.time) for e in folder.entries()}
    assert found == {
        "start_20260314T1230.csv": ("a7", sources.moment("2026-03-14T12:30")),
        "b.csv": ("c9", sources.moment("2026-03-16 08:00")),
        "c_2020-01-01.parquet": ("b8", sources.moment("2026-03-15")),
    }


@pytest.mark.parametrize(
    ("text", "seconds"),
    [
        ("run_19700102", 86400.0),
        ("1970-01-01T01:00:05Z", 3605.0),
        ("2026-02-30", None),
        ("n7", None),
        ("1234567890", None),
    ],
)
def test_a_moment_is_read_from_words(text: str, seconds: float | None) -> None:
    assert sources.moment(text) == seconds


@pytest.mark.parametrize(
    ("table", "says"),
    [("a,b\n1,2\n", "needed: path and engine"), ("path,time\nx,soon\n", "must be a date"), (None, "cannot be read")],
)
def test_a_wrong_list_of_engines_is_one_line(tmp_path: Path, table: str | None, says: str) -> None:
    (tmp_path / "a.csv").write_text("x")
    if table is not None:
        (tmp_path / "list.csv").write_text(table)
    with pytest.raises(InputError, match=says):
        sources.find([str(tmp_path / "a.csv")], str(tmp_path / "list.csv"))


def test_new_and_changed_logs_are_taken_up_and_others_are_left(tmp_path: Path) -> None:
    folder = fleet(tmp_path, many(4))
    work(folder.path)
    logs = sorted((tmp_path / "logs").rglob("*.csv"))
    logs[0].write_text("now it is another")
    (tmp_path / "logs" / "new_2026-05-05.csv").write_text("log 99")
    assert folder.add(sources.find([str(tmp_path / "logs")])) == 2
    assert work(folder.path) == {"done": 2}
    assert len(folder.entries()) == 5 and folder.add(sources.find([str(tmp_path / "logs")])) == 0
    assert json.loads(of(folder, logs[0].name)["answer"])["first"] == "now it is an"


def test_a_run_of_another_machine_or_version_is_not_gone_on_with(tmp_path: Path) -> None:
    (tmp_path / "m.toml").write_text("a = 1\n")
    folder = Folder.begin(tmp_path / "run", JOB, {}, {"model": str(tmp_path / "m.toml")})
    assert (tmp_path / "run" / folder.job["files"]["model"]).read_text() == "a = 1\n"
    (tmp_path / "m.toml").write_text("a = 2\n")
    with pytest.raises(InputError, match="was begun with machine"):
        Folder.begin(tmp_path / "run", JOB, {}, {"model": str(tmp_path / "m.toml")})
    job = json.loads((tmp_path / "run" / "run.json").read_text())
    (tmp_path / "run" / "run.json").write_text(json.dumps({**job, "version": "0.0+old"}))
    with pytest.raises(InputError, match=r"was begun by vaneloop 0\.0\+old"):
        work(folder.path)


def test_a_run_is_of_the_sources_that_its_results_follow_from(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every module that a diagnosis or a trial loads is in the digest, and the tables; each changes it."""
    from vaneloop.base import tables
    from vaneloop.fleet import folder

    script = (
        "import sys, vaneloop.fleet.diagnosis, vaneloop.fleet.trial, vaneloop.fleet.worker, vaneloop.verbs.search\n"
        "for m in list(sys.modules.values()): print(getattr(m, '__file__', ''))"
    )
    said = subprocess.run([sys.executable, "-c", script], env=ENV, cwd=ROOT, capture_output=True, text=True, check=True)
    ours = [Path(f).relative_to(ROOT) for f in said.stdout.split() if f.startswith(str(ROOT / "")) and ".venv" not in f]
    loaded = [f for f in ours if f != Path("vaneloop/__init__.py")]  # names only
    assert len(loaded) > 50
    assert [f for f in loaded if not str(f).startswith(tuple(f"{p}/" for p in folder._SOURCES))] == []

    files = [tmp_path / p / "part.py" for p in folder._SOURCES] + [tmp_path / "tables" / "plant.toml"]
    for f in files:
        f.parent.mkdir(parents=True)
        f.write_text("a = 1\n")
    monkeypatch.setattr(folder, "_ROOT", tmp_path)
    monkeypatch.setattr(tables, "path", lambda name: tmp_path / "tables" / name)
    seen = {folder.sources_version.__wrapped__()}
    (tmp_path / "vaneloop/base/__pycache__").mkdir()
    (tmp_path / "vaneloop/base/__pycache__/made.c").write_text("what is made of sources is none")
    assert folder.sources_version.__wrapped__() in seen
    for f in files:
        f.write_text("a = 2\n")
        seen.add(folder.sources_version.__wrapped__())
    assert len(seen) == len(files) + 1


def test_a_copy_of_a_folder_with_a_dot_in_its_name_is_where_the_job_says(tmp_path: Path) -> None:
    (tmp_path / "bench.v2").mkdir()
    (tmp_path / "bench.v2" / "plant.toml").write_text("a = 1\n")
    folder = Folder.begin(tmp_path / "run", JOB, {}, {"tables": str(tmp_path / "bench.v2")})
    assert (folder.path / folder.job["files"]["tables"] / "plant.toml").read_text() == "a = 1\n"


def test_a_folder_of_something_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("x")
    with pytest.raises(InputError, match="holds other files"):
        Folder.begin(tmp_path, JOB, {}, {})
    with pytest.raises(InputError, match="is no fleet run"):
        Folder(tmp_path)


# ---- logs that do harm -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "status", "says"),
    [
        ("kill the reader", "died", f"signal 11 .*Segmentation fault.*, {DEATHS} times"),
        ("hang", "timeout", "no answer in 5 s"),
        ("refuse", "refused", r"must be in \[0, 120\]"),
        ("defect", "defect", "internal error: KeyError"),
        ("alter", "changed", "has changed since"),
    ],
)
def test_a_bad_log_is_a_row_with_its_reason(tmp_path: Path, text: str, status: str, says: str) -> None:
    folder = fleet(
        tmp_path, {**many(3), "e1/bad_2026-01-01.csv": text}, in_chunk=4, limit=5.0 if text == "hang" else 600.0
    )
    came = work(folder.path)
    assert came == {"done": 3, status: 1}
    bad = next(r for r in rows(folder) if r["status"] != "done")
    assert bad["status"] == status and re.search(says, bad["reason"]), bad["reason"]
    assert "\n" not in bad["reason"]


def test_a_log_that_changed_is_done_the_next_time(tmp_path: Path) -> None:
    folder = fleet(tmp_path, {"e1/a.csv": "alter"})
    work(folder.path)
    assert folder.add(sources.find([str(tmp_path / "logs")])) == 1
    assert work(folder.path) == {"done": 1}
    assert of(folder, "a.csv")["status"] == "done"


def test_a_log_that_vanishes_is_a_row_and_comes_back(tmp_path: Path) -> None:
    folder = fleet(tmp_path, {"e1/a.csv": "log 1"})
    (tmp_path / "logs/e1/a.csv").rename(tmp_path / "away")
    assert work(folder.path) == {"unreadable": 1}
    (tmp_path / "away").rename(tmp_path / "logs/e1/a.csv")
    bad = frozenset(k for k, s in state.came_to(folder).items() if s == "unreadable")
    assert folder.add(sources.find([str(tmp_path / "logs")]), again=bad) == 1
    assert work(folder.path) == {"done": 1} and set(state.came_to(folder).values()) == {"done"}


def test_a_pipe_or_a_dangling_link_among_the_logs_is_a_row(tmp_path: Path) -> None:
    (tmp_path / "logs").mkdir()
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "logs" / "a.csv").symlink_to(tmp_path / "pipe")
    (tmp_path / "logs" / "b.csv").symlink_to(tmp_path / "nowhere")
    folder = fleet(tmp_path, {"c.csv": "log 1"})
    assert work(folder.path) == {"done": 1}
    assert {Path(e.path).name: bool(e.reason) for e in folder.entries()} == {
        "a.csv": True,
        "b.csv": True,
        "c.csv": False,
    }
    assert state.state_of(folder).came == {"done": 1, "unreadable": 2}


# ---- processes that end ----------------------------------------------------------------------------------------------

POINTS = ("take", "leased", "begin", "written:1", "written:5", "result", "result:7", "part", "part:2")


@pytest.mark.slow
@pytest.mark.parametrize("point", POINTS)
def test_a_kill_at_any_point_loses_nothing(tmp_path: Path, point: str, undisturbed: list[tuple[str, ...]]) -> None:
    folder = fleet(tmp_path, many(40), in_chunk=5)
    killed = process(folder, VANELOOP_FLEET_KILL=point)
    assert killed.wait() == -signal.SIGKILL, killed.stderr and killed.stderr.read()
    state.tidy(folder)
    work(folder.path)
    assert [tuple(r.values()) for r in rows(folder)] == undisturbed
    (young := folder.path / "results" / ".young.json.part").write_text("{", encoding="utf-8")
    for file in folder.path.rglob("*.part"):
        if file != young:
            os.utime(file, times=(time.time() - 2 * 3600,) * 2)  # left an hour ago and more
    state.tidy(folder)
    assert list(folder.path.rglob("*.part")) == [young], "a file that may be written to now stays"
    young.unlink()
    assert not list((folder.path / "results").iterdir()) and not list((folder.path / "leases").iterdir())


@pytest.mark.slow
def test_fifty_kills_leave_the_same_table(tmp_path: Path, undisturbed: list[tuple[str, ...]]) -> None:
    """Workers are killed at 50 points drawn by chance, two at a time side by side, each followed by others."""
    folder = fleet(tmp_path, many(40), in_chunk=3)
    draw, kills = random.Random(7), 0
    while kills < 50:
        pair = [
            process(folder, VANELOOP_FLEET_KILL=f"{draw.choice(('take', 'leased', 'begin', 'written'))}:1")
            for _ in range(2)
        ]
        kills += sum(p.wait() == -signal.SIGKILL for p in pair)
        if len(folder.finished()) == len(folder.chunks()):
            break
    assert kills == 50 or len(rows(folder)) == 40
    work(folder.path)
    assert [tuple(r.values()) for r in rows(folder)] == undisturbed


@pytest.mark.slow
def test_a_reader_ends_with_its_worker(tmp_path: Path) -> None:
    import psutil

    folder = fleet(tmp_path, {"e1/a.csv": "hang"})
    p = process(folder)
    until(lambda: any(line["what"] == "begin" for line in lines(folder.path)), p)
    until(lambda: bool(psutil.Process(p.pid).children()), p)
    (reader,) = psutil.Process(p.pid).children()
    p.kill()
    p.wait()
    reader.wait()  # fails by the test's own limit, not by a time


@pytest.mark.slow
def test_sigterm_ends_a_worker_in_order(tmp_path: Path) -> None:
    folder = fleet(tmp_path, {"e1/a.csv": "hang"})
    p = process(folder)
    until(lambda: any(line["what"] == "begin" for line in lines(folder.path)), p)
    p.terminate()
    assert (
        p.wait() == 0 and not list((folder.path / "leases").iterdir()) and not list((folder.path / "workers").iterdir())
    )


def test_an_answer_that_comes_while_a_worker_is_told_to_stop_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from vaneloop.fleet import reader

    folder, ask = fleet(tmp_path, many(3), in_chunk=3), reader.Reader.ask
    with monkeypatch.context() as m:

        def told(self: Any, *words: Any) -> Any:
            row = ask(self, *words)
            self.stopped.set()
            return row

        m.setattr(reader.Reader, "ask", told)
        assert work(folder.path) == {"done": 1}
    assert [n for _, n in folder.begun()] == [1]
    assert work(folder.path) == {"done": 2} and len(rows(folder)) == 3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("compiling", "says"), [("hangs", "is not ready after 2 s of compiling"), (3, "ended 3 times before it read any")]
)
def test_a_machine_that_cannot_compile_is_one_line_and_no_log_s_fault(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, compiling: str | int, says: str
) -> None:
    from vaneloop.fleet import reader

    if compiling == "hangs":
        monkeypatch.setattr(reader, "WARM_UP", 2.0)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    (tmp_path / "a.csv").write_text("log 1")
    folder = Folder.begin(tmp_path / "run", "read_cold", {"compiling": compiling}, {})
    folder.add(sources.find([str(tmp_path / "a.csv")]))
    with pytest.raises(InputError, match=says):
        work(folder.path)
    assert not folder.finished() and not list((folder.path / "leases").iterdir())
    (key,) = (e.key for e in folder.entries())
    assert not (folder.results(folder.entries()[0].chunk) / f"{key}.json").exists(), "the log has no row"
    if compiling == 3:  # the fourth start succeeds
        assert work(folder.path) == {"done": 1}


@pytest.mark.slow
def test_a_worker_that_stands_still_is_replaced_and_does_no_harm(
    tmp_path: Path, undisturbed: list[tuple[str, ...]]
) -> None:
    folder = fleet(tmp_path, many(40), in_chunk=40)
    p = process(folder)
    until(lambda: any(n >= 2 for _, n in folder.begun()), p)
    p.send_signal(signal.SIGSTOP)
    work(folder.path, every=0.1, patience=0.5)
    p.send_signal(signal.SIGCONT)
    assert p.wait() == 0
    assert [tuple(r.values()) for r in rows(folder)] == undisturbed


@pytest.mark.parametrize("moment", [pytest.param(m, marks=pytest.mark.slow if m % 3 else ()) for m in range(1, 13)])
def test_a_worker_may_stand_still_at_any_moment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, moment: int) -> None:
    """Another takes its chunk over, finishes it and clears up; then the first one goes on where it stood."""
    from vaneloop.fleet import files, folder, worker

    run = fleet(tmp_path, many(2), in_chunk=2)
    count = 0

    def stand_still(point: str) -> None:
        nonlocal count
        count += 1
        if count == moment:
            work(run.path, every=0.05, patience=0.0)

    for module in (files, folder, worker):
        monkeypatch.setattr(module, "passed", stand_still)
    work(run.path, every=3600.0)
    assert count >= moment, "the first worker comes to this moment"
    assert [r["status"] for r in rows(run)] == ["done", "done"]
    run.tidy()
    assert not list((run.path / "leases").iterdir()) and not list((run.path / "results").iterdir())


@pytest.mark.slow
def test_a_full_disk_is_one_line_and_the_run_goes_on_later(tmp_path: Path, undisturbed: list[tuple[str, ...]]) -> None:
    folder = fleet(tmp_path, many(40), in_chunk=5)
    p = process(folder, VANELOOP_FLEET_FULL="9")
    _, err = p.communicate()
    assert p.returncode == 2 and err.count("\n") == 1 and "No space left on device" in err, err
    assert not list((folder.path / "leases").iterdir()), "it gives back what it had"
    work(folder.path)
    assert [tuple(r.values()) for r in rows(folder)] == undisturbed


@pytest.mark.slow
def test_two_starters_make_one_run(tmp_path: Path, undisturbed: list[tuple[str, ...]]) -> None:
    for name, text in many(40).items():
        (tmp_path / "logs" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "logs" / name).write_text(text)
    script = (
        "import sys; import tests.fleet_jobs; from vaneloop.fleet import sources\n"
        "from vaneloop.fleet.folder import Folder\n"
        "from vaneloop.fleet.worker import work\n"
        f"folder = Folder.begin(sys.argv[2], {JOB!r}, {{}}, {{'model': sys.argv[3]}})\n"
        "folder.add(sources.find([sys.argv[1]])); work(folder.path, every=0.2)"
    )
    (tmp_path / "m.toml").write_text("a = 1\n")
    words = [sys.executable, "-c", script, str(tmp_path / "logs"), str(tmp_path / "run"), str(tmp_path / "m.toml")]
    pair = [subprocess.Popen(words, env=ENV, cwd=ROOT, stderr=subprocess.PIPE, text=True) for _ in range(3)]
    for p in pair:
        _, err = p.communicate()
        assert p.returncode == 0, err
    folder = Folder(tmp_path / "run")
    assert len(folder.entries()) == 40 and [tuple(r.values()) for r in rows(folder)] == undisturbed


def test_a_log_is_taken_up_once_where_another_starter_is_quicker(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from vaneloop.fleet import folder

    (tmp_path / "a.csv").write_text("log 1")
    logs, run, look = sources.find([str(tmp_path / "a.csv")]), Folder.begin(tmp_path / "run", JOB, {}, {}), folder._look

    def slowly(*what: Any) -> Any:
        monkeypatch.setattr(folder, "_look", look)
        assert Folder(run.path).add(logs) == 1, "the other one takes it up meanwhile"
        return look(*what)

    monkeypatch.setattr(folder, "_look", slowly)
    assert run.add(logs) == 0 and len(run.chunks()) == 1


# ---- leases and journals ---------------------------------------------------------------------------------------------


def test_a_lease_has_one_holder_and_only_a_dead_one_loses_it(tmp_path: Path) -> None:
    a, b = Me(tmp_path, every=3600.0), Me(tmp_path, every=3600.0)
    leases = Leases(tmp_path, patience=3600.0)
    assert leases.take(["c"], a.name) == ("c", 0)
    assert leases.take(["c"], b.name) is None and leases.mine("c", 0)
    a.leave()
    assert leases.take(["c"], b.name) == ("c", 1)
    assert not leases.mine("c", 0) and leases.mine("c", 1)
    b.leave()


def test_a_silent_worker_of_another_host_loses_its_lease_by_the_observer_s_clock(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    far, near = Me(tmp_path, every=3600.0), Me(tmp_path, every=3600.0)
    file = tmp_path / "workers" / f"{far.name}.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "host": "far away", "pid": 1}))
    clock = [100.0]
    monkeypatch.setattr("vaneloop.fleet.leases.time.monotonic", lambda: clock[0])
    leases = Leases(tmp_path, patience=60.0)
    assert leases.take(["c"], far.name) == ("c", 0)
    for now, beat, taken in ((100.0, "1", None), (150.0, "2", None), (205.0, "2", None), (215.0, "2", ("c", 1))):
        clock[0] = now
        (tmp_path / "workers" / f"{far.name}.beat").write_text(beat)
        assert leases.take(["c"], near.name) == taken, now
    far.leave()
    near.leave()


def test_a_worker_that_stands_still_while_it_writes_its_heartbeat_loses_its_lease(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    still = Me(tmp_path, every=3600.0)
    clock = [100.0]
    monkeypatch.setattr("vaneloop.fleet.leases.time.monotonic", lambda: clock[0])
    (tmp_path / "workers" / f"{still.name}.beat").write_text("")
    leases = Leases(tmp_path, patience=60.0)
    assert not leases.dead(still.name)
    clock[0] = 161.0
    assert leases.dead(still.name)
    still.leave()


@pytest.mark.parametrize("look", [state.state_of, state.tidy])
def test_a_worker_that_leaves_while_somebody_looks_is_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, look: Callable[[Folder], Any]
) -> None:
    folder = fleet(tmp_path, many(1))
    me, read = Me(folder.path, every=3600.0), state.who_is

    def late(file: Path) -> Any:
        me.leave()
        return read(file)

    monkeypatch.setattr(state, "who_is", late)
    look(folder)
    assert state.state_of(folder).workers == {}


def test_a_torn_line_of_a_journal_is_left_out(tmp_path: Path) -> None:
    journal = Journal(tmp_path, "w")
    journal.note("begin", key="a")
    with open(tmp_path / "journal" / "w.jsonl", "a") as f:
        f.write('{"what": "en')
    assert [(x["what"], x["key"], x["worker"]) for x in lines(tmp_path)] == [("begin", "a", "w")]
    journal.close()


# ---- rented workers --------------------------------------------------------------------------------------------------

RENT = (
    "import sys; import tests.fleet_jobs; from vaneloop.base import terminal\n"
    "from vaneloop.fleet.folder import Folder; from vaneloop.fleet.rent import rent\n"
    "def main(): print(rent(Folder(sys.argv[1]), sys.argv[2], 2, {}, 0.2, lambda n, of: None)); return 0\n"
    "if __name__ == '__main__': sys.exit(terminal.run(main))"
)


def starter(tmp: Path, folder: Folder, on: str) -> subprocess.Popen[str]:
    """A process that rents two workers for a run."""
    (tmp / "rent.py").write_text(RENT)
    words = [sys.executable, str(tmp / "rent.py"), str(folder.path), on]
    return subprocess.Popen(words, env=ENV, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.mark.slow
def test_rented_workers_share_a_run_and_end_with_a_starter_that_is_killed(
    tmp_path: Path, undisturbed: list[tuple[str, ...]]
) -> None:
    import psutil

    folder = fleet(tmp_path, {**many(40), "e1/slow.csv": "hang"}, in_chunk=2)
    p = starter(tmp_path, folder, "local")
    until(lambda: len(folder.finished()) >= 3, p)
    rented = psutil.Process(p.pid).children(recursive=True)
    listening = [c for one in (psutil.Process(p.pid), *rented) for c in one.net_connections("all")]
    assert len(rented) >= 2 and listening == [], "nobody else can ask them for anything"
    p.kill()
    p.wait()
    psutil.wait_procs(rented)  # scheduler, workers and readers end by themselves, though one log hangs
    (tmp_path / "logs" / "e1" / "slow.csv").unlink()
    state.tidy(folder)
    work(folder.path)
    seen = [tuple(r.values()) for r in rows(folder) if r["status"] == "done"]
    assert seen == undisturbed
    assert [r["status"] for r in rows(folder) if r["status"] != "done"] == ["unreadable"]


@pytest.mark.slow
def test_a_killed_rented_worker_has_a_successor_and_the_run_ends(
    tmp_path: Path, undisturbed: list[tuple[str, ...]]
) -> None:
    import psutil

    folder = fleet(tmp_path, many(40), in_chunk=2)
    p = starter(tmp_path, folder, "local")
    until(lambda: any(line["what"] == "begin" for line in lines(folder.path)), p)
    worker = int(next(line["worker"] for line in lines(folder.path)).split("-")[-2])
    psutil.Process(worker).kill()
    out, err = p.communicate()
    assert p.returncode == 0, err
    assert [tuple(r.values()) for r in rows(folder)] == undisturbed and out.startswith("{")


@pytest.mark.parametrize(("on", "says"), [("slrum", "did you mean slurm"), ("tcp://127.0.0.1:1", "no Dask scheduler")])
def test_a_place_that_is_not_there_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, on: str, says: str
) -> None:
    from vaneloop.fleet import rent

    pytest.importorskip("distributed", reason="the extra `fleet` is not installed")
    monkeypatch.setattr(rent, "ANSWERS", 0.5)  # nobody is there who could be late
    with pytest.raises(InputError, match=says):
        rent.rent(fleet(tmp_path, many(2)), on, 1, {}, 0.2, lambda n, of: None)


@pytest.mark.slow
def test_a_dask_scheduler_that_is_killed_is_one_line_and_the_run_goes_on(
    tmp_path: Path, undisturbed: list[tuple[str, ...]]
) -> None:
    import psutil

    pytest.importorskip("distributed", reason="the extra `fleet` is not installed")
    folder = fleet(tmp_path, {**many(40), "e1/slow.csv": "hang"}, in_chunk=2)
    file = tmp_path / "scheduler.json"
    runs = ["dask_scheduler", "dask_worker"]
    options = [["--port", "0", "--no-dashboard"], ["--nthreads", "1", "--nworkers", "2", "--no-dashboard"]]
    options[1] += ["--preload", "tests.fleet_jobs"]
    cluster = [
        subprocess.Popen(
            [sys.executable, "-m", f"distributed.cli.{name}", "--scheduler-file", str(file), *more], env=ENV,
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        ) for name, more in zip(runs, options, strict=True)
    ]  # fmt: skip
    started = None
    try:
        until(file.exists)
        until(lambda: bool(file.read_text()))
        address = json.loads(file.read_text())["address"]
        started = starter(tmp_path, folder, address)
        until(lambda: len(folder.finished()) >= 3, started)
        cluster[0].kill()
        _, err = started.communicate()
        assert started.returncode == 2 and "the Dask scheduler has gone" in err, err
    finally:
        for p in [*cluster, *([started] if started else [])]:
            with contextlib.suppress(psutil.NoSuchProcess):  # some end by themselves meanwhile
                for child in psutil.Process(p.pid).children(recursive=True):
                    with contextlib.suppress(psutil.NoSuchProcess):
                        child.kill()
            p.kill()
            p.wait()
    (tmp_path / "logs" / "e1" / "slow.csv").unlink()
    state.tidy(folder)
    work(folder.path)
    assert [tuple(r.values()) for r in rows(folder) if r["status"] == "done"] == undisturbed


@pytest.mark.slow
def test_the_scheduler_of_a_queue_s_jobs_takes_nobody_without_the_run_s_keys(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from vaneloop.fleet import rent

    for module in ("distributed", "dask_jobqueue", "cryptography"):
        pytest.importorskip(module, reason="the extra `fleet` is not installed")
    from dask.distributed import Client
    from distributed.security import Security

    for command, says in (("sbatch", "Submitted batch job 1"), ("scancel", "")):  # a queue that never begins a job
        (tmp_path / command).write_text(f"#!/bin/sh\necho {says}\n")
        (tmp_path / command).chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    (tmp_path / "run").mkdir()
    cluster = rent._cluster("slurm", 1, {}, str(tmp_path / "run"))
    try:
        address = str(cluster.scheduler_address)
        assert address.startswith("tls://")
        for other, security in ((address.replace("tls://", "tcp://"), None), (address, Security.temporary())):
            with pytest.raises(OSError):
                Client(other, security=security, timeout=2.0).close()
        Client(cluster, timeout=30.0).close()
        keys = [f for f in (tmp_path / "run").iterdir() if f.name.startswith(".dask")]
        assert len(keys) == 3 and {f.stat().st_mode & 0o077 for f in keys} == {0}
    finally:
        cluster.close()
