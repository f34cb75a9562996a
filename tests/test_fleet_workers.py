"""What a worker of a fleet does with each log, its reader with each line, and what is rented: within this process, with
stand-ins for readers, Dask and Slurm.
"""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("psutil", reason="the extra `fleet` is not installed")
pytest.importorskip("duckdb", reason="the extra `fleet` is not installed")

from vaneloop.base.errors import DeviceError, InputError
from vaneloop.fleet import diagnosis, reader, rent, worker
from vaneloop.fleet.files import read_json, whole_json
from vaneloop.fleet.folder import Folder, key_of
from vaneloop.fleet.kinds import KINDS, Kind, Options
from vaneloop.fleet.leases import Leases
from vaneloop.fleet.reader import Died, NotReady, Reader, Stopped, TimedOut
from vaneloop.fleet.sources import Source
from vaneloop.fleet.worker import lines, work

ONE = Kind((__name__, "stand_in"), Options)
DONE = {"status": "done", "reason": "", "verdict": "none", "answer": {}}


class Readings:
    """A reader's stand-in: what it says of a log is next in a list, or an error; then "done"."""

    def __init__(self) -> None:
        """Nothing was asked yet."""
        self.says: dict[str, list[Any]] = {}
        self.asked: list[str] = []
        self.words: tuple[Any, ...] = ()
        self.with_others: list[tuple[int, str]] = []  # of each question: how many beside, and the device
        self.limits: set[tuple[str, float]] = set()
        self.stops = 0
        self.stopped = threading.Event()

    def __call__(self, function: str, folder: str, stopped: threading.Event, device: str) -> Readings:
        self.words, self.stopped = (function, folder, device), stopped
        return self

    def ask(
        self, path: str, options: dict[str, Any], limit: float, beside: Any = (), device: str = ""
    ) -> dict[str, Any]:
        self.asked.append(Path(path).name)
        self.with_others.append((len(beside), device))
        self.limits.add((json.dumps(options), limit))
        left = self.says.get(Path(path).name, [])
        what = left.pop(0) if left else DONE
        if callable(what) and not isinstance(what, type):
            what = what()
        if isinstance(what, Exception):
            raise what
        return dict(what)

    def stop(self) -> None:
        self.stops += 1


@pytest.fixture
def readings(monkeypatch: pytest.MonkeyPatch) -> Iterator[Readings]:
    made = Readings()
    monkeypatch.setattr(worker, "Reader", made)
    monkeypatch.setitem(KINDS, "one", ONE)
    yield made


def fleet(tmp: Path, names: str = "abc", in_chunk: int | None = None, **options: Any) -> Folder:
    """A run of small logs."""
    for name in names:
        (tmp / f"{name}.csv").write_text(name)
    run = Folder.begin(tmp / "run", "one", options, {})
    run.add([Source(str(tmp / f"{name}.csv"), "e", 0.0) for name in names], in_chunk)
    return run


def rows(run: Folder) -> dict[str, dict[str, Any]]:
    """Of each log's name what came of it."""
    import pyarrow.parquet as pq

    names = {e.key: Path(e.path).stem for e in run.entries()}
    return {names[r["key"]]: r for f in (run.path / "parts").glob("*.parquet") for r in pq.read_table(f).to_pylist()}


def journal(run: Folder) -> list[tuple[str, ...]]:
    """What happened, without times and workers."""
    return [
        (x["what"], *(str(x[k]) for k in ("chunk", "lease", "status", "reason") if k in x)) for x in lines(run.path)
    ]


# ---- a worker --------------------------------------------------------------------------------------------------------


def test_a_worker_does_every_log_writes_down_what_it_does_and_leaves_nothing(
    tmp_path: Path, readings: Readings
) -> None:
    run = fleet(tmp_path, "abc", 2, limit=7)
    assert work(run.path) == {"done": 3}
    assert sorted(readings.asked) == ["a.csv", "b.csv", "c.csv"]
    assert (
        readings.words == ("one", str(run.path), "auto")
        and readings.limits == {('{"limit": 7}', 7.0)}
        and readings.stops == 1
    )
    first, second = run.chunks()
    said = journal(run)
    one = [("took", first, "0"), ("begin",), ("end", "done"), ("begin",), ("end", "done"), ("closed", first)]
    two = [("took", second, "0"), ("begin",), ("end", "done"), ("closed", second)]
    assert said in (one + two, two + one)
    begun = [x for x in lines(run.path) if x["what"] == "begin"]
    assert {(x["key"], Path(x["path"]).name) for x in begun} == {(e.key, Path(e.path).name) for e in run.entries()}
    assert {x["key"] for x in lines(run.path) if x["what"] == "end"} == {e.key for e in run.entries()}
    assert {n: r["status"] for n, r in rows(run).items()} == dict.fromkeys("abc", "done")
    for name in ("leases", "workers", "results"):
        assert not list((run.path / name).iterdir()), name
    assert work(run.path) == {} and len(journal(run)) == len(said)


def test_without_a_limit_a_log_has_an_hour(tmp_path: Path, readings: Readings) -> None:
    work(fleet(tmp_path, "a").path)
    assert readings.limits == {("{}", 3600.0)}


def test_workers_begin_at_different_chunks(tmp_path: Path, readings: Readings) -> None:
    begun = set()
    run = fleet(tmp_path, "abcdef")
    for k in range(40):
        taken: list[list[str]] = []
        me = SimpleNamespace(name=f"worker-{k}", stopped=threading.Event(), every=1.0)
        leases = Leases(run.path)
        leases.take = lambda order, name, taken=taken: taken.append(list(order))
        worker._Worker(run, me, leases).run(wait=False)
        assert sorted(taken[0]) == sorted(run.chunks()), "each comes to all of them"
        begun.add(taken[0][0])
        at = sorted(run.chunks()).index(taken[0][0])
        assert taken[0] == sorted(run.chunks())[at:] + sorted(run.chunks())[:at]
    assert begun == set(run.chunks())


@pytest.mark.parametrize(("every", "pause"), [(0.25, 0.25), (5.0, 1.0)])
@pytest.mark.parametrize("waits", [True, False])
def test_a_worker_waits_for_others_if_it_is_to_take_over_what_they_leave(
    tmp_path: Path, readings: Readings, waits: bool, every: float, pause: float
) -> None:
    run = fleet(tmp_path, "a")
    (chunk,) = run.chunks()
    whole_json(run.path / "workers" / "far.json", {"host": "far", "pid": 1, "started": 0.0, "kind": "worker"})
    (run.path / "workers" / "far.beat").write_text("1")
    assert Leases(run.path).take([chunk], "far") == (chunk, 0)
    waited: list[float] = []

    def wait(timeout: float) -> bool:
        """At the second time the other is gone."""
        waited.append(timeout)
        if len(waited) == 2:
            (run.path / "workers" / "far.json").unlink()
        return False

    stopped = SimpleNamespace(is_set=lambda: False, wait=wait)
    me: Any = SimpleNamespace(name="me", stopped=stopped, every=every)
    assert worker._Worker(run, me, Leases(run.path)).run(waits) == ({"done": 1} if waits else {})
    assert waited == ([pause] * 2 if waits else []) and bool(run.finished()) == waits


def test_a_worker_that_waits_stops_when_it_is_told_to(tmp_path: Path, readings: Readings) -> None:
    run, waited = fleet(tmp_path, "a"), []
    stopped = SimpleNamespace(is_set=lambda: False, wait=lambda timeout: waited.append(timeout) or True)
    me: Any = SimpleNamespace(name="me", stopped=stopped, every=1.0)
    w = worker._Worker(run, me, Leases(run.path))
    w.leases.take = lambda chunks, name: None
    assert w.run(True) == {} and waited == [1.0]
    with pytest.raises(OSError):
        os.fstat(w.journal.file)  # its journal is closed


def test_a_worker_that_is_told_to_stop_takes_no_more(tmp_path: Path, readings: Readings) -> None:
    run = fleet(tmp_path, "abcd", 2)
    readings.says = {f"{n}.csv": [lambda: readings.stopped.set() or DONE] for n in "abcd"}
    assert work(run.path) == {"done": 1} and len(readings.asked) == 1
    assert not run.finished() and [n for _, n in run.begun()] == [1], "an answer that has come is kept"
    assert not list((run.path / "leases").iterdir()) and [w for w, *_ in journal(run)] == ["took", "begin", "end"]
    readings.says = {}
    assert work(run.path) == {"done": 3} and len(readings.asked) == 4 and len(rows(run)) == 4


def test_a_log_in_which_a_worker_is_stopped_has_no_row(tmp_path: Path, readings: Readings) -> None:
    run = fleet(tmp_path, "a")
    readings.says = {"a.csv": [lambda: readings.stopped.set() or Stopped()]}
    assert work(run.path) == {} and not run.finished() and readings.asked == ["a.csv"]
    assert work(run.path) == {"done": 1}


def test_a_worker_that_has_lost_its_lease_leaves_the_chunk(tmp_path: Path, readings: Readings) -> None:
    run = fleet(tmp_path, "ab", 2)
    (chunk,) = run.chunks()

    def another() -> dict[str, Any]:
        (run.path / "leases" / f"{chunk}.1").write_text('{"worker": "nobody"}')
        return DONE

    readings.says = {"a.csv": [another]}
    assert work(run.path) == {"done": 2}
    taken = [x for x in journal(run) if x[0] in ("took", "closed")]
    assert taken == [("took", chunk, "0"), ("took", chunk, "2"), ("closed", chunk)]
    assert readings.asked == ["a.csv", "b.csv"], "what was done is not done again"


def test_a_chunk_that_was_finished_between_look_and_lease_is_cleared(tmp_path: Path, readings: Readings) -> None:
    run = fleet(tmp_path, "a")
    ((chunk, entries),) = run.chunks().items()
    work(run.path)
    (run.results(chunk)).mkdir()
    assert Leases(run.path).take([chunk], "me") == (chunk, 0)
    me = SimpleNamespace(name="me", stopped=threading.Event(), every=1.0)
    before = journal(run)
    worker._Worker(run, me, Leases(run.path))._chunk(chunk, 0, entries)
    assert not run.results(chunk).exists() and not list((run.path / "leases").iterdir()) and journal(run) == before
    assert readings.asked == ["a.csv"]


@pytest.mark.parametrize(
    ("finished", "mine", "fails"), [(False, True, True), (True, True, False), (False, False, False)]
)
def test_a_file_that_is_gone_is_a_fault_only_where_nobody_else_has_cleared_up(
    tmp_path: Path, readings: Readings, monkeypatch: pytest.MonkeyPatch, finished: bool, mine: bool, fails: bool
) -> None:
    run = fleet(tmp_path, "a")
    ((chunk, entries),) = run.chunks().items()

    def vanishes(*_: Any) -> None:
        if finished:
            (run.path / "parts").mkdir()
            (run.path / "parts" / f"{chunk}.parquet").write_text("")
        if not mine:
            (run.path / "leases" / f"{chunk}.1").write_text("")
        raise FileNotFoundError(2, "gone")

    me = SimpleNamespace(name="me", stopped=threading.Event(), every=1.0)
    w = worker._Worker(run, me, Leases(run.path))
    w.leases.take([chunk], "me")
    monkeypatch.setattr(w, "_log", vanishes)
    if fails:
        with pytest.raises(FileNotFoundError):
            w._chunk(chunk, 0, entries)
    else:
        w._chunk(chunk, 0, entries)
    assert not (run.path / "leases" / f"{chunk}.0").exists()
    assert [x[0] for x in journal(run)] == ["took"]


def test_points_of_a_worker_s_way_are_passed_in_order(
    tmp_path: Path, readings: Readings, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, seen = fleet(tmp_path, "a"), []
    (e,) = run.entries()
    tried, result = (run.results(e.chunk) / f"{e.key}.{suffix}" for suffix in ("tried", "json"))

    def passed(point: str) -> None:
        seen.append((point, tried.exists() and tried.read_text(), result.exists()))

    monkeypatch.setattr(worker, "passed", passed)
    work(run.path)
    assert seen == [
        ("take", False, False),
        ("leased", False, False),
        ("begin", "begin\n", False),
        ("result", "begin\n", True),
    ]
    assert not tried.exists()


def test_a_log_that_kills_its_reader_three_times_is_given_up(tmp_path: Path, readings: Readings) -> None:
    run = fleet(tmp_path, "ab", 2)
    readings.says = {"a.csv": [Died(f"ended\n  with {k}") for k in range(9)], "b.csv": [Died("x"), Died("y")]}
    assert work(run.path) == {"died": 1, "done": 1}
    assert rows(run)["a"] | {"key": ""} == {
        "key": "", "status": "died", "reason": "ended with 2, 3 times", "verdict": None, "answer": None}  # fmt: skip
    assert readings.asked == ["a.csv"] * 3 + ["b.csv"] * 3
    assert [x[1:] for x in journal(run) if x[0] == "died"] == [(f"ended\n  with {k}",) for k in range(3)] + [
        ("x",),
        ("y",),
    ]
    assert {x["key"] for x in lines(run.path) if x["what"] == "died"} == {e.key for e in run.entries()}


def test_a_log_in_which_its_worker_ends_twelve_times_is_given_up(tmp_path: Path, readings: Readings) -> None:
    run = fleet(tmp_path, "ab", 2)
    for e, n in zip(run.entries(), (12, 11), strict=True):
        for _ in range(n):
            worker._append(run.results(e.chunk) / f"{e.key}.tried", "begin")
    assert work(run.path) == {"died": 1, "done": 1}
    assert rows(run)["a"]["reason"] == "was begun 12 times, and its worker ended each time"
    assert readings.asked == ["b.csv"]


def test_a_log_that_takes_too_long_is_not_tried_again(tmp_path: Path, readings: Readings) -> None:
    run = fleet(tmp_path, "a")
    readings.says = {"a.csv": [TimedOut("no answer in 5 s")]}
    assert work(run.path) == {"timeout": 1} and rows(run)["a"]["reason"] == "no answer in 5 s"
    assert readings.asked == ["a.csv"]


def test_after_a_failure_a_log_is_tried_without_others_and_with_auto_on_the_processor(
    tmp_path: Path, readings: Readings, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(KINDS, "one", replace(ONE, together=True))
    late, killed = TimedOut("no answer in 7 s"), Died("signal 9")
    readings.says = {"a.csv": [late, killed, DONE], "b.csv": [late, late]}
    run = fleet(tmp_path, "abc", 3)
    assert work(run.path, device="auto") == {"done": 2, "timeout": 1}
    alone = (0, "cpu")
    assert readings.with_others == [(2, ""), alone, alone, (1, ""), alone, (0, "")]
    assert rows(run)["b"]["reason"] == "no answer in 7 s"


def test_a_gpu_that_fails_costs_no_log_and_ends_the_work_with_a_line(tmp_path: Path, readings: Readings) -> None:
    run = fleet(tmp_path, "abc", 3)
    readings.says = {"b.csv": [DeviceError("device 'cuda': out of order")] * 20}
    for _ in range(20):  # oftener than a log may end its worker
        with pytest.raises(DeviceError, match="^device 'cuda': out of order$"):
            work(run.path, device="cuda")
    assert not run.finished() and readings.asked == ["a.csv", *["b.csv"] * 20], "what was done is kept"
    assert not list((run.path / "leases").iterdir()) and ("device", "device 'cuda': out of order") in journal(run)
    assert work(run.path, device="cuda") == {"done": 2} and set(rows(run)) == set("abc")
    assert set(readings.with_others) == {(2, ""), (1, ""), (0, "")}, "no try counts, and the processor does nothing"


def test_a_device_that_cannot_be_used_is_said_by_the_process_and_raised(popen: Any) -> None:
    r, _ = reads(Process([b"{}\n", b'{"status": "device", "reason": "no GPU"}\n', b'{"a": 1}\n']))
    popen(r)
    with pytest.raises(DeviceError, match="^no GPU$"):
        r.ask("/a", {}, 60.0, ["/b"], "cuda")
    assert r.ask("/a", {}, 60.0) == {"a": 1}, "the process is there still"


def test_a_defect_is_tried_once_more_by_a_new_process(tmp_path: Path, readings: Readings) -> None:
    run = fleet(tmp_path, "ab", 2)
    bad = {"status": "defect", "reason": "internal error: KeyError"}
    readings.says = {"a.csv": [bad] * 9, "b.csv": [bad, DONE]}
    assert work(run.path) == {"defect": 1, "done": 1}
    assert readings.asked == ["a.csv"] * 2 + ["b.csv"] * 2 and readings.stops == 3
    assert rows(run)["a"]["reason"] == "internal error: KeyError"


@pytest.mark.parametrize("when", ["before", "while"])
@pytest.mark.parametrize(("change", "status", "says"), [
    (lambda f: f.write_text("other"), "changed", "its content has changed since the run took it up; vaneloop fleet"),
    (lambda f: f.unlink(), "unreadable", "cannot be read (No such file or directory)"),
])  # fmt: skip
def test_a_log_that_is_not_what_was_taken_up_has_no_answer(
    tmp_path: Path, readings: Readings, when: str, change: Callable[[Path], object], status: str, says: str
) -> None:
    run = fleet(tmp_path, "a")
    if when == "before":
        change(tmp_path / "a.csv")
    readings.says = {"a.csv": [lambda: change(tmp_path / "a.csv") and DONE or DONE]}
    assert work(run.path) == {status: 1} and rows(run)["a"]["reason"].startswith(says)
    assert len(readings.asked) == (when == "while")


def test_what_was_done_to_a_log_is_one_line_each(tmp_path: Path) -> None:
    file = tmp_path / "a" / "b" / "c"
    assert worker._lines(file) == []
    for line in ("begin", "died of\n a  cold"):
        worker._append(file, line)
    assert file.read_text() == "begin\ndied of a cold\n" and worker._lines(file) == ["begin", "died of a cold"]


def test_a_line_is_on_the_disk_when_it_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[str] = []
    monkeypatch.setattr(worker.os, "fsync", lambda number: seen.append((tmp_path / "c").read_text()))
    worker._append(tmp_path / "c", "begin")
    assert seen == ["begin\n"]


def test_another_version_is_refused_and_a_full_disk_is_one_line(
    tmp_path: Path, readings: Readings, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = fleet(tmp_path, "a")
    with monkeypatch.context() as m:
        m.setattr(worker, "sources_version", lambda: "9.9")
        with pytest.raises(InputError, match=r"was begun by vaneloop .*; this is 9\.9, whose results do not belong"):
            work(run.path)
    readings.says = {"a.csv": [OSError(28, "No space left", "/x")]}
    with pytest.raises(InputError, match=r"run: /x: No space left; what is done is kept, run the same command again"):
        work(run.path)
    assert not list((run.path / "workers").iterdir()) and not list((run.path / "leases").iterdir())
    with monkeypatch.context() as m:
        m.setattr(worker, "Me", lambda *a: (_ for _ in ()).throw(OSError(28, "No space left")))
        with pytest.raises(InputError, match=r"run: No space left; what"):
            work(run.path)
    assert worker._short(OSError("odd")) == "odd"


def test_a_worker_s_patience_and_beat_are_those_of_its_call(
    tmp_path: Path, readings: Readings, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, seen = fleet(tmp_path, "a"), []
    monkeypatch.setattr(worker, "Leases", lambda path, patience: seen.append(patience) or Leases(path, patience))
    me = worker.Me
    monkeypatch.setattr(worker, "Me", lambda path, every, starter: seen.append((every, starter)) or me(path, every))
    work(run.path)
    work(run.path, starter="s", every=0.5, patience=3.0)
    assert seen == [(5.0, ""), 60.0, (0.5, "s"), 3.0]
    waited: list[bool] = []
    monkeypatch.setattr(worker._Worker, "run", lambda self, wait: waited.append(wait) or {})
    work(run.path)
    work(run.path, wait=False)
    assert waited == [True, False]


def test_sigterm_stops_a_worker_and_afterwards_means_what_it_meant(tmp_path: Path) -> None:
    me: Any = SimpleNamespace(stopped=threading.Event())
    before = signal.getsignal(signal.SIGTERM)
    with worker._terminable(me):
        assert not me.stopped.is_set()
        os.kill(os.getpid(), signal.SIGTERM)
        assert me.stopped.wait(10.0)
    assert signal.getsignal(signal.SIGTERM) is before
    ran: list[bool] = []

    def elsewhere() -> None:
        with worker._terminable(me):
            ran.append(True)
        ran.append(True)

    thread = threading.Thread(target=elsewhere)
    thread.start()
    thread.join()
    assert ran == [True, True], "a thread cannot hear it, and works all the same"


# ---- the reader's process, as its worker sees it ---------------------------------------------------------------------


class Process:
    """A process that answers, through real pipes: each line that it gets is kept, and what it says was said before."""

    def __init__(self, says: bytes | list[bytes], code: int = -9, errors: bytes = b""):
        """``says``: what it writes at once, or at each line; then, with None, it closes its output."""
        self.out, self.into = os.pipe()
        self.stdout = os.fdopen(self.out, "rb", buffering=0)
        self.got: list[Any] = []
        self.says = says if isinstance(says, list) else [says]
        self.code, self.killed, self.waited, self.flushed = code, 0, 0, 0
        self.stdin: Any = SimpleNamespace(write=self._write, flush=self._flush, close=lambda: None)

    def _write(self, line: bytes) -> None:
        assert line.endswith(b"\n") and line.count(b"\n") == 1
        self.got.append(json.loads(line))

    def _flush(self) -> None:
        self.flushed += 1
        what = self.says.pop(0) if self.says else None
        if what is None:
            os.close(self.into)
        else:
            os.write(self.into, what)

    def kill(self) -> None:
        self.killed += 1

    def wait(self) -> int:
        self.waited += 1
        return self.code


def reads(*processes: Process, errors: bytes = b"") -> tuple[Reader, list[Any]]:
    """A reader whose processes are these."""
    r, begun = Reader("one", "/run", threading.Event()), []

    def popen(words: list[str], **more: Any) -> Process:
        begun.append((words, more))
        more["stderr"].write(errors)
        return processes[len(begun) - 1]

    r.popen = popen
    return r, begun


@pytest.fixture
def popen(monkeypatch: pytest.MonkeyPatch) -> Callable[[Reader], None]:
    def put(r: Reader) -> None:
        monkeypatch.setattr(reader.subprocess, "Popen", r.popen)

    return put


def test_a_reader_has_its_process_compile_first_and_asks_it_log_by_log(
    popen: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    p = Process([b"{}\n", b'{"status": ', b'{"b": 2}\n'])
    r, begun = reads(p)
    popen(r)
    rest = [b'"done"}\n']

    def wait(into: Any, *more: Any) -> Any:
        """The rest of an answer comes when its beginning has been read."""
        if rest and not select.select(into, [], [], 0.0)[0]:
            os.write(p.into, rest.pop())
        return select.select(into, *more)

    monkeypatch.setattr(reader, "select", SimpleNamespace(select=wait))
    assert r.ask("/a", {"x": 1}, 60.0) == {"status": "done"} and r.ask("/b", {"x": 1}, 60.0) == {"b": 2}
    asked = [{"path": path, "options": {"x": 1}, "beside": [], "device": "cpu"} for path in ("/a", "/b")]
    assert p.got == [{"options": {"x": 1}, "device": "cpu"}, *asked]
    ((words, more),) = begun
    assert words[0] == sys.executable and words[1:3] == ["-P", "-c"] and words[4:] == ["one", "/run"]
    assert "serve()" in words[3]
    assert more["stdin"] == more["stdout"] == subprocess.PIPE and more["env"] == reader._environment()
    assert p.killed == 0 and p.flushed == 3
    r.stop()
    assert p.killed == 1 == p.waited and r.process is None and p.stdout.closed and r._errors.closed
    r.stop()
    assert p.killed == 1


@pytest.mark.parametrize(
    ("code", "errors", "says"),
    [
        (
            -11,
            b"noise\nFatal Python error: Segmentation fault\nmore\n",
            "signal 11 (Fatal Python error: Segmentation fault)",
        ),
        (1, b"first\nKeyError: x\n", "exit code 1 (KeyError: x)"),
        (0, b"", "exit code 0"),
        (-9, b"x" * 200, f"signal 9 ({'x' * 120})"),
        (2, b"\xff last\n", "exit code 2 (\ufffd last)"),
    ],
)
def test_how_a_process_ended_is_said_in_words(popen: Any, code: int, errors: bytes, says: str) -> None:
    p = Process([b"{}\n"], code)
    r, _ = reads(p, errors=errors)
    popen(r)
    with pytest.raises(Died) as e:
        r.ask("/a", {}, 60.0)
    assert str(e.value) == f"the process that read it ended with {says}" and r.process is None and p.killed == 1


def test_an_answer_that_does_not_come_in_time_ends_the_process(popen: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    p, clock = Process([b"{}\n", b""]), [0.0]
    r, _ = reads(p)
    popen(r)
    seen: list[float] = []

    def later(read: Any, write: Any, error: Any, timeout: float) -> Any:
        seen.append(timeout)
        clock[0] += timeout
        return ([p.stdout], [], []) if len(seen) == 1 else ([], [], [])

    monkeypatch.setattr(reader, "select", SimpleNamespace(select=later))
    monkeypatch.setattr(reader, "time", SimpleNamespace(monotonic=lambda: clock[0]))
    with pytest.raises(TimedOut, match=r"^no answer in 3 s$"):
        r.ask("/a", {}, 3.0)
    assert clock[0] == 0.5 + 3.5 and set(seen) == {0.5} and p.killed == 1 and r.process is None


def test_a_worker_that_is_told_to_stop_ends_the_process(popen: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    p = Process([b"{}\n", b""])
    r, _ = reads(p)
    popen(r)
    r._ready({})
    r.stopped.set()
    monkeypatch.setattr(reader, "select", SimpleNamespace(select=lambda *a: ([], [], [])))
    with pytest.raises(Stopped):
        r.ask("/a", {}, 60.0)
    assert p.killed == 1 and r.process is None


@pytest.mark.parametrize("bad", [2, 3])
def test_a_process_that_ends_before_it_reads_is_begun_three_times(popen: Any, bad: int) -> None:
    r, begun = reads(*(Process([], 1) for _ in range(bad)), Process([b"{}\n", b'{"a": 1}\n']), errors=b"no memory\n")
    popen(r)
    if bad == 2:
        assert r.ask("/a", {}, 60.0) == {"a": 1} and len(begun) == 3
    else:
        with pytest.raises(NotReady) as e:
            r.ask("/a", {}, 60.0)
        assert str(e.value) == (
            "the process that reads logs ended 3 times before it read any, with exit code 1 (no memory)"
        )
        assert len(begun) == 3 and r.process is None


def test_a_process_has_twenty_minutes_for_compiling(popen: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    p, clock = Process([b""]), [0.0]
    r, _ = reads(p)
    popen(r)

    def later(*_: Any) -> Any:
        clock[0] += 300.0
        return [], [], []

    monkeypatch.setattr(reader, "select", SimpleNamespace(select=later))
    monkeypatch.setattr(reader, "time", SimpleNamespace(monotonic=lambda: clock[0]))
    with pytest.raises(NotReady, match="is not ready after 1200 s of compiling; a machine with less to do is needed"):
        r.ask("/a", {}, 60.0)
    assert clock[0] == 1500.0 and p.killed == 1 and r.process is None


def test_a_reader_has_one_thread_and_a_cache_of_its_host(monkeypatch: pytest.MonkeyPatch) -> None:
    import socket

    monkeypatch.setenv("OMP_NUM_THREADS", "8")
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    env = reader._environment()
    assert {env[k] for k in reader.ONE_THREAD} == {"1"} and env["PATH"] == os.environ["PATH"]
    assert env["NUMBA_CACHE_DIR"].endswith(f"-{socket.gethostname()}")
    monkeypatch.setenv("NUMBA_CACHE_DIR", "/mine")
    assert reader._environment()["NUMBA_CACHE_DIR"] == "/mine"


# ---- the reader's process, as it is ----------------------------------------------------------------------------------


def stand_in(path: str, options: dict[str, Any], run: str) -> dict[str, Any]:
    """Answer by the log's name."""
    if path == "refuse":
        raise InputError("no log")
    if path == "break":
        raise KeyError("level")
    return {"z": np.float64(1.5), "nan": float("nan"), "path": path, "options": options, "run": run}


class Served:
    """`reader.serve` within this process: what it is asked, and all that it does to the process."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, asked: list[dict[str, Any]]):
        """Serve these lines."""
        self.done: list[Any] = []
        self.text = ""
        read, write = os.pipe()

        def lines() -> Iterator[str]:
            """Whoever asks waits for the answer before it asks again."""
            for line in asked:
                yield json.dumps(line) + "\n"
                if select.select([read], [], [], 0.0)[0]:
                    self.text += os.read(read, 1 << 16).decode()

        mine = SimpleNamespace(
            dup=lambda n: self.done.append(("dup", n)) or write,
            dup2=lambda a, b: self.done.append(("dup2", a, b)),
            fdopen=os.fdopen, getppid=lambda: 4711,
        )  # fmt: skip
        monkeypatch.setattr(reader, "os", mine)
        argv = ["-c", "one", "/run"]
        monkeypatch.setitem(KINDS, "one", ONE)
        monkeypatch.setattr(reader, "sys", SimpleNamespace(argv=argv, stdin=lines()))
        monkeypatch.setattr("faulthandler.enable", lambda: self.done.append("faults"))
        monkeypatch.setattr(reader, "threading", SimpleNamespace(Thread=self.thread))
        monkeypatch.setattr(reader, "_warm_up", lambda *of: self.done.append(("warm", *of)))
        reader.serve()
        os.close(read)

    def thread(self, target: Any, args: Any, daemon: bool) -> Any:
        return SimpleNamespace(start=lambda: self.done.append(("thread", target, args, daemon)))


def test_a_reader_answers_a_line_for_a_line(monkeypatch: pytest.MonkeyPatch) -> None:
    o = {"b": 1}
    asked = [{"options": o}, *({"path": p, "options": o} for p in ("a", "refuse", "break"))]
    served = Served(monkeypatch, asked)
    lines = served.text.splitlines()
    assert lines[:3] == [
        "{}",
        '{"nan": null, "options": {"b": 1}, "path": "a", "reason": "", "run": "/run", "status": "done", "z": 1.5}',
        '{"reason": "no log", "status": "refused"}',
    ]
    bad = json.loads(lines[3])
    assert bad["status"] == "defect" and "KeyError" in bad["reason"] and len(lines) == 4
    assert served.done == [
        ("dup", 1), ("dup2", 2, 1), "faults", ("thread", reader._end_with, (4711,), True), ("warm", None, o, "/run"),
    ]  # fmt: skip


def test_a_reader_ends_with_its_worker(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[Any] = []

    class Ended(Exception):
        pass

    def end(code: int) -> None:
        seen.append(code)
        raise Ended

    parents = iter([7, 7, 1])
    monkeypatch.setattr(reader, "os", SimpleNamespace(getppid=lambda: next(parents), _exit=end))
    monkeypatch.setattr(reader, "time", SimpleNamespace(sleep=seen.append))
    with pytest.raises(Ended):
        reader._end_with(7)
    assert seen == [1.0, 1.0, 1]


def warms(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, flock: Callable[..., None] | None = None
) -> tuple[Any, list[Any]]:
    """`_warm_up` with a cache of its own, and a clock on which to sleep takes no time."""
    from numba import config

    clock, done = [0.0], []
    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path / "deep" / "cache"), raising=False)

    def sleep(seconds: float) -> None:
        done.append(("sleep", seconds))
        clock[0] += seconds

    monkeypatch.setattr(reader, "time", SimpleNamespace(monotonic=lambda: clock[0], sleep=sleep))
    if flock is not None:
        monkeypatch.setattr(reader.fcntl, "flock", flock)

    def compile_all(options: dict[str, Any], run: str) -> None:
        done.append(("compiled", options, run))

    return compile_all, done


def test_of_a_host_s_readers_one_compiles(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    how: list[int] = []
    compile_all, done = warms(monkeypatch, tmp_path, lambda file, what: how.append(what))
    reader._warm_up(compile_all, {"a": 1}, "/run")
    reader._warm_up(compile_all, {"a": 1}, "/run")
    assert done == [("compiled", {"a": 1}, "/run")] and how == [reader.fcntl.LOCK_EX | reader.fcntl.LOCK_NB]
    (warm,) = (tmp_path / "deep" / "cache").glob("*.warm")
    assert warm.name.startswith(f"fleet-{__name__}-")
    reader._warm_up(None, {}, "/run")
    warm.unlink()
    reader._warm_up(None, {}, "/run")
    assert len(done) == 1


def test_a_reader_waits_while_another_compiles_but_not_for_ever(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Half of the time that its worker gives it; then it does without."""

    def taken(file: Any, what: int) -> None:
        raise OSError(11, "taken")

    compile_all, done = warms(monkeypatch, tmp_path, taken)
    reader._warm_up(compile_all, {}, "/run")
    assert done == [("sleep", 0.5)] * 1200


def test_what_another_has_compiled_meanwhile_is_not_compiled_again(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    from vaneloop.base.compiled import sources_digest

    def late(file: Any, what: int) -> None:
        Path(tmp_path / "deep" / "cache" / f"fleet-{__name__}-{sources_digest()}.warm").touch()

    compile_all, done = warms(monkeypatch, tmp_path, late)
    reader._warm_up(compile_all, {}, "/run")
    assert done == []


# ---- rented workers --------------------------------------------------------------------------------------------------


class Dask:
    """Dask's and Slurm's stand-in: tasks are done after they were looked at a few times."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, results: list[Any], refuses: Exception | None = None):
        """Put it in place of the packages."""
        self.did: list[Any] = []
        self.results, self.refuses, self.looks = results, refuses, 0
        dask, distributed, queue = ModuleType("dask"), ModuleType("dask.distributed"), ModuleType("dask_jobqueue")
        dask.config = SimpleNamespace(set=lambda what: self.did.append(("set", what)))
        dask.distributed = distributed
        distributed.Client = self.client
        distributed.wait = self.wait
        security = ModuleType("distributed.security")
        security.Security = SimpleNamespace(temporary=lambda: "keys made for it")
        monkeypatch.setitem(sys.modules, "distributed.security", security)
        queue.SLURMCluster = lambda **o: self.cluster("slurm", o)
        for name, module in (("dask", dask), ("dask.distributed", distributed), ("dask_jobqueue", queue)):
            monkeypatch.setitem(sys.modules, name, module)
        monkeypatch.setattr(rent, "needs", lambda *modules: self.did.append(("needs", *modules)))
        monkeypatch.setattr(rent, "needed", self.needed)

    def needed(self, thing: str, module: str) -> Any:
        self.did.append(("needs", thing, module))
        return sys.modules[module]

    def cluster(self, kind: str, options: dict[str, Any]) -> Any:
        self.did.append((kind, options))
        close = lambda: self.did.append(f"{kind} closed")  # noqa: E731
        return SimpleNamespace(close=close, scale=lambda jobs: self.did.append(("scale", jobs)), kind=kind)

    def client(self, where: Any, timeout: float) -> Any:
        self.did.append(("client", getattr(where, "kind", where), timeout))
        if self.refuses:
            raise self.refuses
        return SimpleNamespace(submit=self.submit, close=lambda: self.did.append("client closed"))

    def submit(self, function: Any, *words: Any, **more: Any) -> Any:
        self.did.append(("submit", function, words, more))
        result = self.results.pop(0)

        def told() -> Any:
            if isinstance(result, BaseException):
                raise result
            return result

        return SimpleNamespace(done=lambda: self.looks > 2, result=told)

    def wait(self, tasks: Any, timeout: float) -> None:
        self.looks += 1
        self.did.append(("wait", len(tasks), timeout))
        if self.looks == 1:
            raise TimeoutError


class Hands:
    """Workers of this machine without processes: each says what is next in a list; None: it was killed."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, says: list[Any]):
        """Put them in place of `rent._Hired`."""
        self.says, self.did, self.words = says, list[str](), set[Any]()
        monkeypatch.setattr(rent, "_Hired", self.hire)

    def hire(self, words: Any) -> Any:
        answer = self.says.pop(0)
        self.words.add(words)
        self.did.append("hired")
        looks = iter([None, 0, 0, 0])
        signalled = lambda n: self.did.append(f"{n}")  # noqa: E731
        state = SimpleNamespace(poll=lambda: next(looks, 0), wait=self.wait, send_signal=signalled)
        return SimpleNamespace(process=state, said=lambda: answer, last_words=lambda: "signal 9",
                               close=lambda: self.did.append("closed"))  # fmt: skip

    def wait(self, timeout: float) -> None:
        raise subprocess.TimeoutExpired("worker", timeout)


def test_as_many_workers_are_rented_as_asked_for_and_what_they_did_is_added_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("dask", "distributed", "dask.distributed"):
        monkeypatch.setitem(sys.modules, name, None)  # workers of this machine need no scheduler
    hands = Hands(monkeypatch, [{"came": {"done": 2, "died": 1}}, {"came": {"done": 3}}])
    run, told = fleet(tmp_path, "abc"), []
    assert rent.rent(run, "local", 2, {}, 0.5, lambda n, of: told.append((n, of)), "sha") == {"done": 5, "died": 1}
    assert told and set(told) == {(0, 3)}
    ((folder, starter, every, trust, device),) = hands.words
    assert folder == str(run.path.resolve()) and starter and (every, trust, device) == (0.5, "sha", "auto")
    assert sorted(hands.did) == ["closed"] * 2 + ["hired"] * 2 and not list((run.path / "workers").iterdir())


def test_a_killed_worker_has_a_successor_until_it_is_plain_that_none_gets_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hands = Hands(monkeypatch, [None] * 3 + [{"came": {"done": 1}}])
    assert rent.rent(fleet(tmp_path, "a"), "local", 1, {}, 0.5, lambda n, of: None) == {"done": 1}
    assert hands.did == ["hired", "closed"] * 4
    hands = Hands(monkeypatch, [None] * 30)
    with pytest.raises(RuntimeError, match="21 workers ended one after the other, the last with signal 9"):
        rent.rent(fleet(tmp_path, "a"), "local", 1, {}, 0.5, lambda n, of: None)


def test_what_a_worker_refuses_is_one_line_and_ctrl_c_ends_all_in_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Hands(monkeypatch, [{"came": {"done": 1}}, {"refused": "the disk is full"}])
    with pytest.raises(InputError, match="^the disk is full$"):
        rent.rent(fleet(tmp_path, "a"), "local", 2, {}, 0.5, lambda n, of: None)
    hands = Hands(monkeypatch, [{}, {}])

    def interrupt(n: int, of: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        rent.rent(fleet(tmp_path, "a"), "local", 2, {}, 0.5, interrupt)
    assert hands.did == ["hired"] * 2 + [f"{signal.SIGTERM}"] * 2 + ["closed"] * 2
    assert not list((tmp_path / "run" / "workers").iterdir())


@pytest.mark.parametrize("fails", [None, InputError("no room")])
def test_a_hired_worker_answers_with_a_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], fails: Exception | None
) -> None:
    seen: list[Any] = []

    def work(run: str, **more: Any) -> dict[str, int]:
        seen.append((run, more))
        if fails:
            raise fails
        return {"done": 1}

    monkeypatch.setattr(rent, "work", work)
    monkeypatch.setattr(rent.sys, "argv", ["-c", "/run", "s", "2.0", "sha", "cuda"])
    rent.hired()
    assert seen == [("/run", {"starter": "s", "every": 2.0, "patience": 24.0, "trust": "sha", "device": "cuda"})]
    assert json.loads(capsys.readouterr().out) == ({"refused": "no room"} if fails else {"came": {"done": 1}})


def test_a_scheduler_of_others_is_used_and_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from concurrent.futures import CancelledError

    dask = Dask(monkeypatch, [{"done": 2}, {"done": 3}])
    run, told = fleet(tmp_path, "abc"), []
    assert rent.rent(run, "tcp://h:1", 2, {}, 0.5, lambda n, of: told.append((n, of)), "sha") == {"done": 5}
    assert told == [(0, 3)] * 3
    settings = {"distributed.scheduler.allowed-failures": 1_000_000, "distributed.worker.daemon": False,
                "distributed.scheduler.http.routes": []}  # fmt: skip
    assert dask.did[0][0] == "needs"
    assert dask.did[1:3] == [("set", settings), ("client", "tcp://h:1", 30.0)]
    (_, f, words, more), (_, _, _, more2) = dask.did[3:5]
    assert (
        f is rent._work
        and words[0] == str(run.path.resolve())
        and words[2:] == (0.5, "sha", "auto")
        and not more["pure"]
    )
    assert more["key"] == f"fleet-{words[1]}-0" and more2["key"] == f"fleet-{words[1]}-1"
    assert dask.did[5:] == [("wait", 2, 1.0)] * 3 + ["client closed"]
    Dask(monkeypatch, [CancelledError()])
    with pytest.raises(
        InputError, match="the Dask scheduler has gone; what is done is kept, run the same command again"
    ):
        rent.rent(run, "tcp://h:1", 1, {}, 0.5, lambda n, of: None)
    for e in (OSError("x"), ValueError("x")):
        dask = Dask(monkeypatch, [], e)
        with pytest.raises(InputError, match=rf"--on slurm: no Dask scheduler answers \({type(e).__name__}\)"):
            rent.rent(run, "slurm", 1, {}, 0.5, lambda n, of: None)
        assert dask.did[-1] == "slurm closed"


def test_jobs_of_a_queue_have_one_core_the_options_given_and_keys_that_were_made_for_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    dask = Dask(monkeypatch, [])
    assert rent._cluster("slurm", 3, {"queue": "night", "walltime": "01:00:00"}, "/run").kind == "slurm"
    (needs, (kind, said), scale) = dask.did
    assert needs == ("needs", "--on slurm", "dask_jobqueue")
    assert (kind, scale) == ("slurm", ("scale", 3)) and said == {
        "cores": 1, "processes": 1, "memory": "4GB", "walltime": "01:00:00", "queue": "night",
        "security": "keys made for it", "shared_temp_directory": "/run",
        "scheduler_options": {"dashboard": False, "dashboard_address": "127.0.0.1:0"},
        "worker_extra_args": ["--no-dashboard", "--dashboard-address", "127.0.0.1:0"],
    }  # fmt: skip
    for on in ("tcp://h:1", "tls://h:1", "ws://h:1"):
        assert rent._cluster(on, 3, {}, "/run") is None
        rent.known(on)
    for on in ("http://h:1", "lokal", "tcp", ""):
        with pytest.raises(InputError, match="is not known.*allowed: local, slurm, tcp"):
            rent.known(on)
    dask.did.clear()
    rent.known("local")
    assert dask.did == []
    rent.known("slurm")
    assert dask.did == [("needs", "--on slurm", "distributed", "dask_jobqueue", "cryptography")]


# ---- what is done with a log -----------------------------------------------------------------------------------------


def found(free: list[int], theta: list[float]) -> Any:
    """What a diagnosis says of the nominal parameters of one stage."""
    low = np.array([theta[c] - 0.5 for c in free])
    return SimpleNamespace(
        stage="s", final=SimpleNamespace(free=np.array(free), theta=np.array(theta), low=low, high=low + 2.0)
    )


def quantity(name: str, value: float = 1.0, tolerance: float = 0.5, shape: bool = False) -> Any:
    return SimpleNamespace(name=name, unit="deg", value=value, tolerance=tolerance, shape=shape)


def said(by_log: Any = None) -> Any:
    """A diagnosis of one stage with two nominal parameters and an effect."""
    effect = SimpleNamespace(parameters=[quantity("depth", 0.25), quantity("how", shape=True)])
    stage = SimpleNamespace(
        name="s", parameters=[quantity("a"), quantity("b", 2.0, np.inf)], effect=lambda e: {"dip": effect}[e]
    )
    sizes = {"depth": {"value": 7.0, "low": 6.0, "high": 8.0}, "how": {}}
    named = {"effect": "dip", "stage": "s", "probability": 1, "parameters": sizes}
    return SimpleNamespace(
        bound=SimpleNamespace(stages=[stage]), by_log=by_log, verdict="missing",
        diagnosis=SimpleNamespace(stages=[found([1, 0, 2], [3.0, 4.0, 5.0])]),
        to_dict=lambda: {"elapsed_s": 1.0, "effects": [named]},
    )  # fmt: skip


def test_nominal_parameters_that_a_log_could_move_have_their_values_and_their_tables() -> None:
    b, a = diagnosis._nominal(said())
    assert a == {"stage": "s", "parameter": "a", "unit": "deg", "value": 3.0, "low": 2.5, "high": 4.5, "table": 1.0,
                 "tolerance": 0.5}  # fmt: skip
    assert b == {"stage": "s", "parameter": "b", "unit": "deg", "value": 4.0, "low": 3.5, "high": 5.5, "table": 2.0,
                 "tolerance": None}  # fmt: skip
    system = SimpleNamespace(parameters=[quantity("b", 9.0, 0.25)])
    own = SimpleNamespace(logs=SimpleNamespace(fitted=SimpleNamespace(system=system)))
    (only,) = diagnosis._nominal(said(own))
    assert only == b | {"table": 9.0, "tolerance": 0.25}, "of a system of one's own what it declares"


def test_effects_have_a_row_for_each_size_and_none_for_a_shape() -> None:
    (row,) = diagnosis._sizes(said(), said().to_dict())
    assert row == {"effect": "dip", "stage": "s", "probability": 1.0, "parameter": "depth", "unit": "deg", "value": 7.0,
                   "low": 6.0, "high": 8.0, "neutral": 0.25}  # fmt: skip


def test_the_answer_to_a_log_has_what_is_followed_over_time(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    columns = {"z": (np.array([1.0, 3.0]), np.array([np.nan, 5.0])), "a": (np.array([0.5, 2.0]), np.array([7.0, 6.0]))}
    monkeypatch.setattr(diagnosis, "_of_machine", lambda *of: asked.append(("machine", of)) or (said(), columns))
    monkeypatch.setattr(diagnosis, "_of_system", lambda *of: asked.append(("system", of)) or (said(), columns))
    options = {"files": {"dbc": "machine/d.dbc", "mapping": "machine/m.toml"}, "reading": {"channel": 1}}
    out = diagnosis.diagnose_log("/log", options, "/run")
    answer = out["answer"]
    assert out["verdict"] == "missing" and "elapsed_s" not in answer and answer["effects"][0]["effect"] == "dip"
    assert answer["nominal"] == diagnosis._nominal(said()) and answer["sizes"] == diagnosis._sizes(said(), answer)
    assert list(answer["range"].items()) == [("a", [6.0, 7.0]), ("z", [5.0, 5.0])] and answer["duration_s"] == 2.5
    files = {"dbc": "/run/machine/d.dbc", "mapping": "/run/machine/m.toml"}
    reading = {"channel": 1, "dbc": files["dbc"], "mapping_file": files["mapping"]}
    assert asked.pop() == ("machine", ("/log", files, reading)) and options["reading"] == {"channel": 1}
    diagnosis.diagnose_log("/log", {"files": {"system": "machine/s.py"}, "reading": {}}, "/run")
    assert asked.pop() == ("system", ("/log", {"system": "/run/machine/s.py"}, {}))


def test_a_log_of_the_machine_is_diagnosed_with_the_run_s_files(monkeypatch: pytest.MonkeyPatch) -> None:

    seen: list[Any] = []
    log = SimpleNamespace(channels={"n": SimpleNamespace(t="T", values="V")})
    monkeypatch.setattr(diagnosis, "read_log", lambda path, **more: seen.append((path, more)) or log)
    monkeypatch.setattr(diagnosis, "files_of", lambda tables: f"files of {tables}")
    monkeypatch.setattr(diagnosis, "Machine", lambda **of: of)
    monkeypatch.setattr(diagnosis, "diagnose", lambda log, machine, workers: (machine, workers))
    files = {"tables": "t", "model": "m", "plant": "p", "controller": "c", "dbc": "d"}
    machine = {"tables": "t", "model": "m", "table": "p", "controller": "c"}
    assert diagnosis._of_machine("/log", files, {"x": 1}) == ((machine, 1), {"n": ("T", "V")})
    assert seen == [("/log", {"require": (), "x": 1, "tables": "files of t"})]
    assert diagnosis._of_machine("/log", {}, {}) == (({}, 1), {"n": ("T", "V")}) and diagnosis._machine({}) == {}


@pytest.mark.parametrize("reads_itself", [False, True])
def test_a_log_of_a_system_of_one_s_own_is_read_as_the_system_reads(
    monkeypatch: pytest.MonkeyPatch, reads_itself: bool
) -> None:
    import vaneloop.identification

    seen: list[Any] = []
    system = SimpleNamespace(read=reads_itself)
    record = SimpleNamespace(t="T", columns={"a": np.array([np.nan, 1.0]), "b": np.array([np.nan, np.nan])})
    monkeypatch.setattr(diagnosis, "load_system", lambda file: system if file == "s" else None)
    monkeypatch.setattr(diagnosis, "load_model_of", lambda file, system: f"of {file}")
    monkeypatch.setattr(diagnosis, "read_record", lambda *a, **k: seen.append((a, k)) or (record, None))
    monkeypatch.setattr(diagnosis, "diagnose", lambda record, system, added: ("said", added))
    found, columns = diagnosis._of_system("/log", {"system": "s", "model": "m"}, {"x": 1})
    assert found == ("said", "of m") and list(columns) == ["a"] and columns["a"][0] == "T"
    assert seen == [(("/log", system), {} if reads_itself else {"x": 1})]
    assert diagnosis._of_system("/log", {"system": "s"}, {})[0] == ("said", None)

    def fails(*_: Any, **__: Any) -> None:
        raise vaneloop.identification.StageError("no column a")

    monkeypatch.setattr(diagnosis, "diagnose", fails)
    with pytest.raises(InputError, match="^no column a$"):
        diagnosis._of_system("/log", {"system": "s"}, {})


def test_warming_up_diagnoses_a_short_run_of_the_machine(monkeypatch: pytest.MonkeyPatch) -> None:

    seen: list[Any] = []
    machine = SimpleNamespace(calibration="K", plant="P")
    monkeypatch.setattr(diagnosis, "_machine", lambda files: seen.append(files) or machine)

    def lockstep(stimulus: Any, **more: Any) -> Any:
        seen.append(more | {"of": stimulus})
        return SimpleNamespace(t=np.arange(3.0), columns={"t": np.arange(3.0), "n": np.ones(3)})

    monkeypatch.setattr(diagnosis, "lockstep", lockstep)
    monkeypatch.setattr(diagnosis, "Stimulus", SimpleNamespace(of=lambda n_dem: n_dem.tolist()))
    monkeypatch.setattr(diagnosis, "diagnose", lambda log, m, workers: seen.append((log, m, workers)))
    diagnosis.diagnose_log.warm_up({"files": {"model": "machine/m.toml"}}, "/run")
    files, more, (log, of, workers) = seen
    assert files == {"model": "/run/machine/m.toml"} and of is machine and workers == 1
    steps = [60.0] * 1000 + [90.0] * 1000 + [70.0] * 1000 + [95.0] * 1000
    assert more == {"calibration": "K", "plant": "P", "seed": 1, "every": 10, "of": steps}
    assert list(log.channels) == ["n"] and log.channels["n"].t.tolist() == [0.0, 1.0, 2.0]
    seen.clear()
    diagnosis.diagnose_log.warm_up({"files": {"system": "s.py"}}, "/run")
    assert seen == [], "a system of one's own compiles with its first log"


def test_a_result_s_key_is_in_its_file(tmp_path: Path, readings: Readings, monkeypatch: pytest.MonkeyPatch) -> None:
    run = fleet(tmp_path, "a")
    (e,) = run.entries()
    monkeypatch.setattr(
        Folder,
        "close",
        lambda self, chunk, entries: (
            self.path.joinpath("parts").mkdir() or (self.path / f"parts/{chunk}.parquet").touch()
        ),
    )
    work(run.path)
    assert read_json(run.results(e.chunk) / f"{e.key}.json") == {"key": key_of(e.path), **DONE}
