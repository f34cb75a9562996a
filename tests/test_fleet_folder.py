"""The folder of a fleet run: its files and their formats, who holds what, exact limits, and what is damaged.

All of it within this process: no worker is started, no log is diagnosed.
"""

from __future__ import annotations

import hashlib
import json
import os
import signal
import stat
import threading
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("psutil", reason="the extra `fleet` is not installed")
pytest.importorskip("duckdb", reason="the extra `fleet` is not installed")

import pyarrow as pa
import pyarrow.parquet as pq

from vaneloop.base.errors import InputError
from vaneloop.fleet import files, folder, leases, sources, state, tables
from vaneloop.fleet.folder import LEFT_BEHIND, Entry, Folder, copies_of, key_of
from vaneloop.fleet.leases import BEATS, Leases, Me, gone
from vaneloop.fleet.sources import Source, find, moment
from vaneloop.fleet.worker import Journal, lines


def sha(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def begun(tmp: Path, options: dict[str, Any] | None = None, given: dict[str, str] | None = None) -> Folder:
    return Folder.begin(tmp / "run", "one", options or {}, given or {})


def written(tmp: Path, texts: dict[str, str]) -> list[Source]:
    for name, text in texts.items():
        (tmp / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp / name).write_text(text)
    return [Source(str(tmp / name), "e", float(k)) for k, name in enumerate(texts)]


def done(run: Folder, chunk: str, **answers: dict[str, Any]) -> None:
    """Results of a chunk, as a worker leaves them."""
    for e in run.chunks()[chunk]:
        row = {"key": e.key, "status": "done", "reason": "", "verdict": "none", "answer": {"b": 1, "a": [2]}}
        files.whole_json(run.results(chunk) / f"{e.key}.json", row | answers.get(e.key.split(".")[0], {}))


# ---- files that are whole or not there -------------------------------------------------------------------------------


def test_a_file_is_whole_or_as_it_was(tmp_path: Path) -> None:
    at = tmp_path / "a" / "b" / "c.json"
    files.whole_json(at, {"z": 1, "a": "ä"})
    assert at.read_text(encoding="utf-8") == '{"a": "\\u00e4", "z": 1}' and files.read_json(at) == {"a": "ä", "z": 1}

    def torn(path: Path) -> None:
        assert path.parent == at.parent and path.name.startswith(".c.json.") and path.name.endswith(".part")
        path.write_text("half")
        raise OSError(5, "no power")

    with pytest.raises(OSError, match="no power"):
        files.whole(at, torn)
    with pytest.raises(ZeroDivisionError):
        files.whole(at, lambda path: 1 / 0)
    assert files.read_json(at) == {"a": "ä", "z": 1} and [p.name for p in at.parent.iterdir()] == ["c.json"]


def test_of_several_that_make_a_file_the_first_has_it(tmp_path: Path) -> None:
    at = tmp_path / "leases" / "c.0"
    assert files.create(at, lambda f: f.write_text("first")) is True
    assert files.create(at, lambda f: f.write_text("second")) is False
    assert at.read_text() == "first" and [p.name for p in at.parent.iterdir()] == ["c.0"]
    with pytest.raises(FileNotFoundError):
        files.create(tmp_path / "c.1", lambda f: f.unlink())  # nothing was written


def test_a_file_is_on_the_disk_before_it_has_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[str] = []

    def sync(number: int) -> None:
        seen.append("its name" if (tmp_path / "a").exists() else "sync")

    monkeypatch.setattr(files.os, "fsync", sync)
    monkeypatch.setattr(files, "passed", seen.append)
    files.whole(tmp_path / "a", lambda f: f.write_text("x"))
    assert seen == ["written", "sync", "its name"]


def test_a_damaged_file_is_named(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text("{")
    with pytest.raises(InputError, match=r"a\.json: is no JSON; the run folder is damaged"):
        files.read_json(tmp_path / "a.json")


@pytest.mark.parametrize(
    ("said", "kills_at"), [("here", 1), ("here:1", 1), ("here:3", 3), ("there:1", None), ("", None)]
)
def test_a_process_may_be_killed_at_a_point(monkeypatch: pytest.MonkeyPatch, said: str, kills_at: int | None) -> None:
    count, killed = 0, []
    monkeypatch.setenv(files.KILL, said)
    monkeypatch.setattr(files, "_seen", {})
    monkeypatch.setattr(files.os, "kill", lambda pid, number: killed.append((count, pid, number)))
    while count < 5:
        count += 1
        files.passed("here")
    assert killed == ([(kills_at, os.getpid(), signal.SIGKILL)] if kills_at else [])


@pytest.mark.parametrize(("said", "fit"), [("3", 2), ("1", 0), ("0", 9), ("", 9), (None, 9)])
def test_a_disk_may_be_full_from_a_file_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, said: str | None, fit: int
) -> None:
    monkeypatch.setattr(files, "_seen", {})
    if said is not None:
        monkeypatch.setenv(files.FULL, said)
    made = 0
    for k in range(9):
        try:
            files.whole(tmp_path / f"{k}", lambda f: f.write_text("x"))
            made += 1
        except OSError as e:
            assert e.errno == 28 and e.strerror == "No space left on device"
    assert made == fit == len(list(tmp_path.iterdir()))


def test_a_digest_is_that_of_the_content(tmp_path: Path) -> None:
    (tmp_path / "A.CSV").write_text("abc")
    assert files.digest_of(tmp_path / "A.CSV") == sha("abc") and key_of(str(tmp_path / "A.CSV")) == sha("abc") + ".csv"


# ---- the journal -----------------------------------------------------------------------------------------------------


def test_a_journal_has_a_line_for_each_note_and_keeps_what_was_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vaneloop.fleet.worker.time.time", lambda: 12.34567)
    synced: list[int] = []
    monkeypatch.setattr("vaneloop.fleet.worker.os.fsync", synced.append)
    for name, what in (("w2", "took"), ("w1", "begin"), ("w1", "end")):
        journal = Journal(tmp_path / "run" / "of", name)
        journal.note(what, key="k")
        assert synced[-1] == journal.file
        journal.close()
        with pytest.raises(OSError):
            os.fstat(journal.file)
    file = tmp_path / "run" / "of" / "journal" / "w1.jsonl"
    assert (
        file.read_text() == '{"at": 12.346, "key": "k", "what": "begin"}\n{"at": 12.346, "key": "k", "what": "end"}\n'
    )
    assert stat.S_IMODE(file.stat().st_mode) & 0o700 == 0o600
    assert [(x["worker"], x["what"]) for x in lines(tmp_path / "run" / "of")] == [
        ("w1", "begin"), ("w1", "end"), ("w2", "took")]  # fmt: skip


def test_torn_lines_in_a_journal_are_left_out_wherever_they_stand(tmp_path: Path) -> None:
    (tmp_path / "journal").mkdir()
    (tmp_path / "journal" / "w.jsonl").write_bytes(b'{"what": "a"}\n{"wh\n\xff\xfe\n{"what": "b"}\n{"what"')
    assert [x["what"] for x in lines(tmp_path)] == ["a", "b"]
    assert list(lines(tmp_path / "nowhere")) == []


# ---- leases ----------------------------------------------------------------------------------------------------------


def worker(run: Path, name: str, beat: str | None = "1", **who: Any) -> None:
    """A worker's files; without more, one of another host."""
    (run / "workers").mkdir(parents=True, exist_ok=True)
    said = {"host": "far", "pid": 1, "started": 0.0, "kind": "worker"} | who
    (run / "workers" / f"{name}.json").write_text(json.dumps(said))
    if beat is not None:
        (run / "workers" / f"{name}.beat").write_text(beat)


def lease(run: Path, name: str, holder: str | None) -> None:
    (run / "leases").mkdir(parents=True, exist_ok=True)
    (run / "leases" / name).write_text("" if holder is None else json.dumps({"worker": holder}))


def test_of_a_chunk_s_leases_the_greatest_number_counts(tmp_path: Path) -> None:
    assert Leases(tmp_path).held() == {}
    for name in ("000000-000001.0", "000000-000001.10", "000000-000001.9", "000000-000002.0"):
        lease(tmp_path, name, "w")
    for name in (".000000-000001.11.3f.part", ".7", "000000-000003.x", "000000-000004", "000000-000005."):
        lease(tmp_path, name, "w")  # no leases: a number and a chunk are needed
    assert Leases(tmp_path).held() == {"000000-000001": 10, "000000-000002": 0}
    assert Leases(tmp_path).mine("000000-000001", 10) and not Leases(tmp_path).mine("000000-000001", 9)
    assert not Leases(tmp_path).mine("000000-000009", 0), "it has been given back"


def test_a_lease_says_who_holds_it(tmp_path: Path) -> None:
    lease(tmp_path, "c.3", "w7")
    lease(tmp_path, "d.0", None)
    held = Leases(tmp_path)
    assert (held.holder("c", 3), held.holder("c", 4), held.holder("d", 0)) == ("w7", "", "")
    held.give_back("c", 3)
    held.give_back("c", 3)
    assert held.holder("c", 3) == ""


def test_a_worker_takes_the_first_chunk_that_is_free_or_left_alone(tmp_path: Path) -> None:
    worker(tmp_path, "alive")
    for name, holder in (("a.0", "alive"), ("b.4", "gone"), ("c.0", None)):
        lease(tmp_path, name, holder)
    held = Leases(tmp_path)
    assert held.take(["a", "b", "d"], "me") == ("b", 5) and held.holder("b", 5) == "me"
    assert json.loads((tmp_path / "leases" / "b.5").read_text()) == {"worker": "me"}
    worker(tmp_path, "me")
    assert held.take(["a", "b", "c"], "me") == ("c", 1), "a lease that says nothing is nobody's"
    assert held.take(["a", "b", "d"], "me") == ("d", 0)
    assert held.take(["a", "b", "c", "d"], "me") is None and held.take([], "me") is None


def test_a_holder_is_looked_at_once_for_all_its_chunks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("a.0", "b.0", "c.0", "d.0"):
        lease(tmp_path, name, "x" if name < "c" else "y")
    asked: list[str] = []
    monkeypatch.setattr(Leases, "dead", lambda self, name: bool(asked.append(name)))
    assert Leases(tmp_path).take("abcd", "me") is None and asked == ["x", "y"]


def test_a_chunk_that_another_takes_meanwhile_is_left_to_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make = leases.create
    monkeypatch.setattr(leases, "create", lambda path, write: path.name != "a.0" and make(path, write))
    assert Leases(tmp_path).take(["a", "b"], "me") == ("b", 0)


def test_a_heartbeat_may_stand_still_for_the_patience_and_no_longer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    worker(tmp_path, "far")
    clock = [100.0]
    monkeypatch.setattr("vaneloop.fleet.leases.time.monotonic", lambda: clock[0])
    held, other = Leases(tmp_path), Leases(tmp_path, 3.0)
    said = []
    for now, beat in ((100.0, "1"), (160.0, "1"), (160.5, "1"), (161.0, "2"), (221.0, "2"), (222.0, "2")):
        clock[0] = now
        worker(tmp_path, "far", beat)
        said.append(held.dead("far"))
    assert said == [False, False, True, False, False, True]
    assert not other.dead("far")
    clock[0] += 3.0
    assert not other.dead("far")
    clock[0] += 0.1
    assert other.dead("far")


def test_a_worker_whose_files_are_not_there_or_damaged_is_gone(tmp_path: Path) -> None:
    held = Leases(tmp_path)
    assert held.dead("nobody")
    worker(tmp_path, "w", None)
    assert held.dead("w")
    worker(tmp_path, "w")
    assert not held.dead("w")
    (tmp_path / "workers" / "w.json").write_text("{")
    assert held.dead("w")


def test_a_process_is_gone_where_this_host_has_no_other_news_of_it() -> None:
    import psutil

    here, began = leases._host(), psutil.Process().create_time()
    me = {"host": here, "pid": os.getpid(), "started": began}
    assert leases._started(os.getpid()) == began
    assert not gone(me) and not gone(me | {"started": began + 1.0 - 1e-3}) and not gone(me | {"started": began - 0.99})
    assert gone(me | {"started": began + 1.01}) and gone(me | {"started": began - 1.01}), "its number is another's now"
    child = os.fork()
    if child == 0:
        os._exit(0)
    os.waitid(os.P_PID, child, os.WEXITED | os.WNOWAIT)
    assert leases._started(child) is None, "it has ended, though nobody has asked how"
    os.waitpid(child, 0)
    assert leases._started(child) is None and gone(me | {"pid": child})
    assert not gone(me | {"pid": child, "host": "far"}), "that cannot be known from here"


def test_a_host_is_its_name_its_boot_and_its_space_of_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    import socket

    name, boot, space = leases._host().split(" ")
    assert name == socket.gethostname() and len(boot) == 36 and space.startswith("pid:[")

    def none(*_: Any, **__: Any) -> str:
        raise OSError(2, "none")

    monkeypatch.setattr(leases.os, "readlink", none)
    monkeypatch.setattr(Path, "read_text", none)
    assert leases._host() == f"{name}  ", "what a system does not tell is left empty"


def test_who_enters_a_run_writes_down_who_it_is_and_lets_its_heart_beat(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import psutil

    class Once(threading.Event):
        """Waits three times for no time at all, then stops."""

        waited: list[float | None] = []

        def wait(self, timeout: float | None = None) -> bool:
            self.waited.append(timeout)
            return len(self.waited) > 3

    monkeypatch.setattr(leases, "threading", SimpleNamespace(Event=Once, Thread=threading.Thread))
    me = Me(tmp_path, kind="starter")
    me._thread.join()
    said = json.loads((tmp_path / "workers" / f"{me.name}.json").read_text())
    assert said == {"host": leases._host(), "pid": os.getpid(), "started": psutil.Process().create_time(),
                    "kind": "starter"}  # fmt: skip
    assert me.name.split("-")[-2] == str(os.getpid()) and len(me.name.split("-")[-1]) == 8
    assert (tmp_path / "workers" / f"{me.name}.beat").read_text() == "4" and Once.waited == [5.0] * 4
    assert not me.stopped.is_set()
    me.leave()
    assert not list((tmp_path / "workers").iterdir()) and me.stopped.is_set()
    me.leave()


def test_two_workers_of_one_process_have_two_names_and_their_hearts_do_not_hold_it_up(tmp_path: Path) -> None:
    a, b = Me(tmp_path, 3600.0), Me(tmp_path, 3600.0)
    assert a.name != b.name and a._thread.is_alive() and a._thread.daemon
    assert (tmp_path / "workers" / f"{a.name}.beat").read_text() == "1", "it beats before anything is waited for"
    a.leave()
    assert not a._thread.is_alive()
    b.leave()


def test_a_full_disk_stops_no_heart(tmp_path: Path) -> None:
    me = Me(tmp_path, 3600.0)
    me.leave()
    (tmp_path / "workers").rmdir()
    me._beat()
    assert me.beats == 2


def test_a_worker_stops_with_the_process_that_rents_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    worker(tmp_path, "starter")
    me = Me(tmp_path, 3600.0, "starter")
    assert me._watch is not None and me._watch.patience == BEATS * 3600.0 == 12 * 3600.0
    me.leave()
    monkeypatch.setattr(leases, "BEATS", 3.6e6)
    me = Me(tmp_path, 1e-3, "starter")
    assert not me.stopped.wait(0.05)
    (tmp_path / "workers" / "starter.json").unlink()
    assert me.stopped.wait(30.0)
    me.leave()
    alone = Me(tmp_path, 1e-3)
    assert not alone.stopped.wait(0.02), "without a starter there is nobody to miss"
    alone.leave()


# ---- the run's own file ----------------------------------------------------------------------------------------------


def test_a_run_keeps_its_job_and_copies_of_its_files(tmp_path: Path) -> None:
    (tmp_path / "T").mkdir()
    (tmp_path / "T" / "plant.toml").write_text("a = 1\n")
    (tmp_path / "m.toml").write_text("b = 2\n")
    given = {"tables": str(tmp_path / "T"), "model": str(tmp_path / "m.toml")}
    run = begun(tmp_path / "deep" / "er", {"limit": 3}, given)
    assert run.job.keys() == {"schema", "kind", "options", "version", "machine", "files"}
    assert (run.job["schema"], run.job["kind"], run.job["options"]) == (1, "one", {"limit": 3})
    assert run.job["files"] == copies_of(given) == {"tables": "machine/tables", "model": "machine/model.toml"}
    assert (run.path / "machine/tables/plant.toml").read_text() == "a = 1\n"
    assert (run.path / "machine/model.toml").read_text() == "b = 2\n"
    assert stat.S_IMODE((run.path / "machine").stat().st_mode) == 0o755
    assert sorted(p.name for p in run.path.iterdir()) == ["machine", "run.json"]
    text = (run.path / "run.json").read_text()
    assert text.endswith("}\n") and text == json.dumps(run.job, indent=2, sort_keys=True) + "\n"
    expected = f"model/:{sha('b = 2' + chr(10))}\ntables/plant.toml:{sha('a = 1' + chr(10))}\n"
    assert run.job["machine"] == sha(expected)
    assert begun(tmp_path / "deep" / "er", {"limit": 3}, given).job == run.job and not run.of_campaign
    assert Folder.begin(tmp_path / "c", "one", {"plan": {}}, {}).of_campaign


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"options": {"b": 1, "a": 2}}, 'not {"a": 2, "b": 1}; give another'),
        ({"kind": "other"}, "was begun with kind one, not other; give another --out"),
        ({"options": {"a": "x" * 80}}, 'was begun with options {}, not {"a": "' + "x" * 50 + "...; give another"),
        ({"options": {"a": "x" * 51}}, 'not {"a": "' + "x" * 51 + '"}; give another'),
        ({"options": {"a": "x" * 52}}, 'not {"a": "' + "x" * 50 + "...; give another"),
    ],
)
def test_another_job_needs_another_folder(tmp_path: Path, change: dict[str, Any], says: str) -> None:
    begun(tmp_path)
    job = {"kind": "one", "options": {}} | change
    with pytest.raises(InputError) as e:
        Folder.begin(tmp_path / "run", job["kind"], job["options"], {})
    assert says in str(e.value)


def test_what_is_no_run_s_folder_is_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match="is a file; a folder is needed"):
        Folder.begin(tmp_path / "file", "one", {}, {})
    (tmp_path / "empty" / "machine").mkdir(parents=True)
    (tmp_path / "empty" / ".hidden").write_text("x")
    assert Folder.begin(tmp_path / "empty", "one", {}, {}).job["schema"] == 1, "as a starter leaves it that was killed"
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "x").write_text("x")
    with pytest.raises(InputError, match="holds other files and is no fleet run"):
        Folder.begin(tmp_path / "other", "one", {}, {})
    (tmp_path / "other" / "run.json").write_text('{"schema": 2}')
    with pytest.raises(InputError, match="schema 2; allowed: 1"):
        Folder(tmp_path / "other")
    with pytest.raises(InputError, match="it has no run.json"):
        Folder(tmp_path / "nowhere")
    monkeypatch.setattr(folder, "create", lambda path, write: (_ for _ in ()).throw(OSError(28, "No space left")))
    with pytest.raises(InputError, match=r"new: cannot be written \(No space left\)"):
        Folder.begin(tmp_path / "new", "one", {}, {})


def test_of_two_starters_the_first_has_copied_the_machine(tmp_path: Path) -> None:
    for k in "ab":
        (tmp_path / f"{k}.toml").write_text(k)
    (tmp_path / "run").mkdir()
    folder._copy({"model": str(tmp_path / "a.toml")}, tmp_path / "run" / "machine")
    folder._copy({"model": str(tmp_path / "b.toml")}, tmp_path / "run" / "machine")
    assert (tmp_path / "run" / "machine" / "model.toml").read_text() == "a"
    assert [p.name for p in (tmp_path / "run").iterdir()] == ["machine"], "the second leaves nothing"
    with pytest.raises(OSError):
        folder._copy({"model": str(tmp_path / "none.toml")}, tmp_path / "other" / "machine")
    assert list((tmp_path / "other").iterdir()) == []


def test_a_file_that_cannot_be_read_is_named_before_a_run_begins(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "m.toml").write_text("x")

    def bad(path: Path) -> str:
        raise OSError(13, "Permission denied")

    assert folder._digest_of_all({"model": str(tmp_path / "none")}) == sha("")
    monkeypatch.setattr(folder, "digest_of", bad)
    with pytest.raises(InputError, match=r"m\.toml: cannot be read \(Permission denied\)"):
        folder._digest_of_all({"model": str(tmp_path / "m.toml")})


def test_a_version_is_that_of_every_source_by_name_and_content(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from importlib.metadata import PackageNotFoundError, version

    from vaneloop.base import tables as shipped

    assert all(list((folder._ROOT / p).glob("*.py")) for p in folder._SOURCES), "each has sources of this VaneLoop"
    monkeypatch.setattr(folder, "_ROOT", tmp_path)
    monkeypatch.setattr(shipped, "path", lambda name: tmp_path / "tables" / name)
    of = folder.sources_version.__wrapped__
    (tmp_path / "plant" / "deep" / "__pycache__").mkdir(parents=True)
    a, b = tmp_path / "plant" / "deep" / "a.py", tmp_path / "plant" / "b.toml"
    a.write_text("1")
    b.write_text("2")
    expected = version("numba") + f"b.toml:{sha('2')}\ndeep/a.py:{sha('1')}\n"
    assert of() == f"{version('vaneloop')}+{sha(expected)[:16]}"
    before = of()
    for name in ("deep/__pycache__/a.py", "notes.md", "deep/a.pyc"):
        (tmp_path / "plant" / name).write_text("3")
        assert of() == before, name
    a.rename(tmp_path / "plant" / "a.py")
    assert of() != before

    def unknown(name: str) -> str:
        if name == "vaneloop":
            raise PackageNotFoundError
        return "1"

    monkeypatch.setattr("importlib.metadata.version", unknown)
    assert of().startswith("0+")


# ---- the logs of a run -----------------------------------------------------------------------------------------------


def test_a_batch_has_a_row_for_each_log(tmp_path: Path) -> None:
    run, logs = begun(tmp_path), written(tmp_path, {"a.csv": "1", "b.csv": "2", "copy.csv": "1"})
    assert run.add(logs) == 3
    rows = pq.read_table(run.path / "logs" / "000000.parquet").to_pylist()
    at = os.stat(tmp_path / "a.csv")
    assert rows[0] == {"path": logs[0].path, "key": sha("1") + ".csv", "size": 1, "mtime_ns": at.st_mtime_ns,
                       "chunk": "000000-000000", "engine": "e", "time": 0.0, "reason": ""}  # fmt: skip
    assert [r["chunk"] for r in rows] == ["000000-000000", "000000-000001", ""], "a copy is done with the other"
    assert [Entry(**r) for r in rows] == run.entries()
    assert {c: [e.path for e in es] for c, es in run.chunks().items()} == {
        "000000-000000": [logs[0].path], "000000-000001": [logs[1].path]}  # fmt: skip
    assert run.add(logs) == 0 and len(list((run.path / "logs").iterdir())) == 1


@pytest.mark.parametrize(
    ("n", "asked", "size"), [(7, 3, 3), (7, None, 1), (399, None, 1), (400, None, 2), (13_000, None, 64)]
)
def test_chunks_are_as_large_as_asked_or_a_two_hundredth_of_the_logs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, n: int, asked: int | None, size: int
) -> None:
    monkeypatch.setattr(folder, "_look", lambda s, known, again: Entry(s.path, sha(s.path), 1, 1, "", "e", None))
    pool = SimpleNamespace(map=map)
    monkeypatch.setattr(folder, "ThreadPoolExecutor", lambda n: nullcontext(pool))
    run = begun(tmp_path)
    assert run.add([Source(f"/nowhere/{k}") for k in range(n)], asked) == n
    sizes = [len(es) for es in run.chunks().values()]
    assert sizes == [size] * (n // size) + [n % size] * (n % size > 0)
    assert list(run.chunks()) == [f"000000-{k:06d}" for k in range(len(sizes))]


def test_a_later_batch_adds_and_replaces(tmp_path: Path) -> None:
    run, logs = begun(tmp_path), written(tmp_path, {"a.csv": "1", "b.csv": "2"})
    run.add(logs)
    (tmp_path / "a.csv").write_text("changed")
    more = [*logs, *written(tmp_path, {"c.csv": "3", "d.csv": "2"})]
    assert run.add(more) == 3
    assert [(Path(e.path).name, e.chunk) for e in run.entries()] == [
        ("b.csv", "000000-000001"), ("a.csv", "000001-000000"), ("c.csv", "000001-000001"), ("d.csv", "")]  # fmt: skip
    assert list(run.chunks()) == ["000000-000000", "000000-000001", "000001-000000", "000001-000001"]


def test_what_is_to_be_done_again_has_a_new_chunk(tmp_path: Path) -> None:
    run, logs = begun(tmp_path), written(tmp_path, {"a.csv": "1", "b.csv": "2"})
    run.add(logs)
    assert run.add(logs, again=frozenset({sha("2") + ".csv"})) == 1
    assert [(Path(e.path).name, e.chunk) for e in run.entries()] == [
        ("a.csv", "000000-000000"),
        ("b.csv", "000001-000000"),
    ]


def test_a_log_that_cannot_be_read_is_a_row_without_a_chunk_until_it_can(tmp_path: Path) -> None:
    run, missing = begun(tmp_path), Source(str(tmp_path / "e7" / "a.csv"), "", 5.0)
    pipe = tmp_path / "p.csv"
    os.mkfifo(pipe)
    assert run.add([missing, Source(str(pipe), "own")]) == 2
    a, b = run.entries()
    assert a == Entry(missing.path, "", 0, 0, "", "e7", 5.0, "cannot be read (No such file or directory)")
    assert (b.engine, b.chunk, b.key, b.reason) == ("own", "", "", "cannot be read (it is no plain file)")
    assert run.add([missing, Source(str(pipe), "own")]) == 0, "known already"
    written(tmp_path, {"e7/a.csv": "1"})
    assert run.add([missing]) == 1
    assert run.entries()[-1].chunk == "000001-000000" and run.entries()[-1].key == sha("1") + ".csv"
    (tmp_path / "e7" / "a.csv").unlink()
    assert run.add([missing]) == 1 and run.entries()[-1].reason == a.reason


def test_only_a_log_that_is_not_as_it_is_known_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (s,) = written(tmp_path, {"a.csv": "1"})
    known = folder._look(s, None, frozenset())
    assert known is not None
    read: list[str] = []
    monkeypatch.setattr(folder, "key_of", lambda path: read.append(path) or "new")
    none: frozenset[str] = frozenset()
    same = [(s, known, none), (Source(s.path), known, none), (Source(s.path, "e"), known, none), (s, known, {"x"})]
    assert [folder._same(*x) for x in same] == [True] * 4 and [folder._look(*x) for x in same] == [None] * 4
    assert folder._look(s, known, {known.key}) == known and not folder._same(s, known, {known.key})
    other = [replace(s, engine="f"), replace(s, time=9.0)]
    for x in other:
        assert not folder._same(x, known, none)
        assert folder._look(x, known, none) == replace(known, engine=x.engine, time=x.time) and read == []
    for was in (replace(known, size=2), replace(known, mtime_ns=1), None):
        assert not folder._same(s, was, none)
        found = folder._look(s, was, none)
        assert found is not None and found.key == "new" and len(read) == 1
        read.clear()
    os.unlink(s.path)
    assert not folder._same(s, known, none)
    os.mkfifo(s.path)
    there = os.stat(s.path)
    assert not folder._same(s, replace(known, size=there.st_size, mtime_ns=there.st_mtime_ns), none)


# ---- results ---------------------------------------------------------------------------------------------------------


def test_a_chunk_is_closed_when_all_its_results_are_there(tmp_path: Path) -> None:
    run, logs = begun(tmp_path), written(tmp_path, {"a.csv": "1", "b.csv": "2"})
    run.add(logs, 2)
    ((chunk, entries),) = run.chunks().items()
    assert run.finished() == set() and list(run.begun()) == []
    assert not run.close(chunk, entries)
    done(run, chunk, **{sha("2"): {"status": "refused", "reason": "why", "verdict": None, "answer": None}})
    (run.results(chunk) / ".x.json").write_text("")
    assert list(run.begun()) == [(chunk, 2)] and run.results(chunk) == run.path / "results" / chunk
    lease(run.path, f"{chunk}.0", "w")
    lease(run.path, f"{chunk}.1", "w")
    lease(run.path, "000000-000009.0", "w")
    assert run.close(chunk, entries) and run.finished() == {chunk} and list(run.begun()) == []
    table = pq.read_table(run.path / "parts" / f"{chunk}.parquet")
    assert table.schema == pa.schema([(c, pa.string()) for c in ("key", "status", "reason", "verdict", "answer")])
    assert table.to_pylist() == [
        {"key": sha("1") + ".csv", "status": "done", "reason": "", "verdict": "none", "answer": '{"a": [2], "b": 1}'},
        {"key": sha("2") + ".csv", "status": "refused", "reason": "why", "verdict": None, "answer": None},
    ]
    assert [p.name for p in (run.path / "leases").iterdir()] == ["000000-000009.0"]
    assert not run.results(chunk).exists()
    assert run.close(chunk, entries), "it is closed already"
    run.clear(chunk)


def test_two_answers_that_say_the_same_are_the_same_text() -> None:
    assert folder._json({"b": 1, "a": {"d": 2, "c": 3}}) == folder._json({"a": {"c": 3, "d": 2}, "b": 1})
    assert folder._json(None) is None


def test_a_part_is_passed_before_its_chunk_is_cleared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run, logs = begun(tmp_path), written(tmp_path, {"a.csv": "1"})
    run.add(logs)
    ((chunk, entries),) = run.chunks().items()
    done(run, chunk)
    seen: list[Any] = []
    monkeypatch.setattr(
        folder, "passed", lambda point: seen.append((point, run.finished(), run.results(chunk).exists()))
    )
    run.close(chunk, entries)
    assert seen == [("part", {chunk}, True)]


def test_what_killed_processes_left_is_cleared_up_and_what_may_be_at_work_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, logs = begun(tmp_path), written(tmp_path, {"a.csv": "1", "b.csv": "2"})
    run.add(logs)
    first, second = run.chunks()
    done(run, first)
    done(run, second)
    run.close(first, run.chunks()[first])
    (run.results(first)).mkdir()
    (run.results(first) / "x.json").write_text("{}")
    old, young = run.path / "parts" / ".old.part", run.path / "parts" / ".young.part"
    for file, age in ((old, LEFT_BEHIND + 1.0), (young, LEFT_BEHIND)):
        file.write_text("")
        os.utime(file, (1e9 - age, 1e9 - age))
    monkeypatch.setattr("vaneloop.fleet.folder.time.time", lambda: 1e9)
    assert run.finished() == {first} and LEFT_BEHIND == 3600.0
    run.tidy()
    assert not old.exists() and young.exists() and not run.results(first).exists() and run.results(second).exists()


# ---- how far a run is ------------------------------------------------------------------------------------------------


def test_a_state_counts_paths_contents_and_what_came_of_them(tmp_path: Path) -> None:
    run = begun(tmp_path)
    logs = written(tmp_path, {"a.csv": "1", "b.csv": "2", "c.csv": "3", "copy.csv": "1"})
    run.add([*logs, Source(str(tmp_path / "none.csv"))])
    assert state.came_to(run) == {}
    first, second, third = run.chunks()
    done(run, first)
    done(run, second, **{sha("2"): {"status": "refused"}})
    run.close(first, run.chunks()[first])
    worker(run.path, "far", kind="starter")
    worker(run.path, "silent", None)
    found = state.state_of(run)
    assert found == state.State(5, 4, 3, {"done": 1, "unreadable": 1}, {"far": "starter"})
    assert found.json() == {"logs": 5, "contents": 4, "done": 3, "came_to": found.came, "workers": found.workers,
                            "damaged": {}}  # fmt: skip
    run.close(second, run.chunks()[second])
    done(run, third)
    assert state.state_of(run).came == {"done": 1, "refused": 1, "unreadable": 1} and state.state_of(run).done == 4
    run.close(third, run.chunks()[third])
    again = {sha("2") + ".csv"}
    run.add(logs, again=again)
    *_, fourth = run.chunks()
    done(run, fourth)
    assert state.state_of(run).done == 4, "what is done once more is no more than all"
    run.close(fourth, run.chunks()[fourth])
    assert state.came_to(run) == {sha(k) + ".csv": "done" for k in "123"}, "the later counts"


def test_names_of_workers_that_are_gone_are_struck_off(tmp_path: Path) -> None:
    run = begun(tmp_path)
    me = {"host": leases._host(), "pid": os.getpid(), "started": leases._started(os.getpid())}
    worker(run.path, "me", **me)
    worker(run.path, "far")
    worker(run.path, "before", **me | {"started": 1.0})
    worker(run.path, "bare", None, **me | {"started": 1.0})
    (run.path / "parts").mkdir()
    (run.path / "parts" / ".x.part").write_text("")
    os.utime(run.path / "parts" / ".x.part", (1.0, 1.0))
    state.tidy(run)
    assert sorted(p.name for p in (run.path / "workers").iterdir()) == ["far.beat", "far.json", "me.beat", "me.json"]
    assert not list((run.path / "parts").iterdir())


def test_a_worker_that_leaves_while_somebody_looks_is_nobody(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = begun(tmp_path)
    for name in ("a", "b", "c"):
        worker(run.path, name)
    read = state.who_is

    def late(file: Path) -> Any:
        if file.stem == "b":
            file.unlink()
        return read(file)

    monkeypatch.setattr(state, "who_is", late)
    assert [file.stem for file, _ in state._workers(run)] == ["a", "c"]


# ---- the tables ------------------------------------------------------------------------------------------------------


def test_results_become_tables_in_the_order_of_paths(tmp_path: Path) -> None:
    run = begun(tmp_path / "it's")
    logs = written(tmp_path, {"b.csv": "2", "a.csv": "1", "c.csv": "3", "copy.csv": "1"})
    run.add([*logs, Source(str(tmp_path / "none.csv"), "f")])
    with pytest.raises(InputError, match="no part of the run is finished yet"):
        tables.roll_up(run)
    two, one, _ = run.chunks()
    size = {"effect": "dip", "stage": "s", "probability": 0.5, "parameter": "q", "unit": "MPa", "value": 1.0,
            "low": 0.5, "high": 1.5, "neutral": 0.0}  # fmt: skip
    row = {"stage": "s", "parameter": "p", "unit": "deg", "value": 2.0, "low": 1.0, "high": 3.0, "table": 0.0,
           "tolerance": None}  # fmt: skip
    answer = {"duration_s": 60.0, "sizes": [size], "nominal": [row], "not_observable": [{"effect": "x", "stage": "s",
              "needs": "n"}], "stages": [{"stage": "t", "verdict": "not_observed", "reason": "r"},
                                         {"stage": "u", "verdict": "none", "reason": "r"}]}  # fmt: skip
    done(run, two, **{sha("2"): {"status": "refused", "reason": "why", "verdict": None, "answer": None}})
    done(run, one, **{sha("1"): {"answer": answer}})
    for chunk in (one, two):
        run.close(chunk, run.chunks()[chunk])
    db = tables.roll_up(run)
    key, a, copy = sha("1") + ".csv", str(tmp_path / "a.csv"), str(tmp_path / "copy.csv")
    said = db.execute("SELECT path, engine, time, key, status, reason, verdict, duration_s FROM logs").fetchall()
    assert said == [
        (a, "e", 1.0, key, "done", "", "none", 60.0),
        (str(tmp_path / "b.csv"), "e", 0.0, sha("2") + ".csv", "refused", "why", None, None),
        (str(tmp_path / "c.csv"), "e", 2.0, sha("3") + ".csv", "pending", "", None, None),
        (copy, "e", 3.0, key, "done", "", "none", 60.0),
        (
            str(tmp_path / "none.csv"),
            "f",
            None,
            "",
            "unreadable",
            "cannot be read (No such file or directory)",
            None,
            None,
        ),
    ]
    of = [(a, "e", 1.0, key), (copy, "e", 3.0, key)]
    assert db.execute("SELECT path, engine, time, key, effect, value, neutral FROM effects").fetchall() == [
        (*x, "dip", 1.0, 0.0) for x in of
    ]
    assert db.execute("SELECT path, engine, time, key, parameter, tolerance FROM nominal").fetchall() == [
        (*x, "p", None) for x in of
    ]
    assert db.execute("SELECT path, engine, time, key, effect, stage, needs FROM coverage").fetchall() == [
        (*x, *y) for x in of for y in (("x", "s", "n"), ("", "t", "r"))
    ]
    assert tables.answers(run, [key, "no"]) == {key: answer} and tables.answers(run, [sha("2") + ".csv"]) == {}
    out = tables.write_tables(db, tmp_path / "deep" / "t'b", ("logs", "effects"))
    assert [p.name for p in out] == ["logs.parquet", "logs.csv", "effects.parquet", "effects.csv"]
    assert sorted(p.name for p in (tmp_path / "deep" / "t'b").iterdir()) == sorted(p.name for p in out)
    assert pq.read_table(out[0]).num_rows == 5 and out[1].read_text().startswith("path,engine,time,key,status,")
    assert tables.write_tables(db, tmp_path / "deep" / "t'b", ("logs",)) == out[:2]
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"--tables-out .*file: cannot be written \("):
        tables.write_tables(db, tmp_path / "file")
    before = {f.name: f.read_bytes() for f in out[0].parent.iterdir()}
    db.execute("CREATE VIEW broken AS SELECT error('a full disk') AS x")
    (out[0].parent / "broken.parquet").write_text("what was there")
    with pytest.raises(InputError, match="cannot be written"):
        tables.write_tables(db, out[0].parent, ("broken",))
    assert {f.name: f.read_bytes() for f in out[0].parent.iterdir()} == {**before, "broken.parquet": b"what was there"}
    progress = (
        "SELECT current_setting('enable_progress_bar'), current_setting('threads'), current_setting('temp_directory')"
    )
    ((bar, threads, place),) = db.execute(progress).fetchall()
    assert (bar, threads) == (False, 2) and Path(place).name.startswith("vaneloop-fleet-")
    assert stat.S_IMODE(os.stat(place).st_mode) == 0o700, "nobody else may read what does not fit into memory"


# ---- which logs there are --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "seconds"),
    [
        ("1970-01-02", 86400.0), ("19700101T000001", None), ("x_1970-01-02T03:04:05Z", 86400.0 + 3 * 3600 + 4 * 60 + 5),
        ("1970-01-02 03-04", 86400.0 + 3 * 3600 + 4 * 60), ("19700102_0304", 86400.0 + 3 * 3600 + 4 * 60),
        ("1970-02-29", None), ("11970-01-02", None), ("1970-01-023", None), ("2000-02-29", 951782400.0),
        ("first 1970-01-03 then 1970-01-02", 2 * 86400.0), ("", None),
    ],
)  # fmt: skip
def test_a_moment_is_the_first_date_in_a_text(text: str, seconds: float | None) -> None:
    assert moment(text) == (1.0 if text.endswith("000001") else seconds)


def test_the_list_comes_before_metadata_and_metadata_before_the_path(tmp_path: Path) -> None:
    log = tmp_path / "e5" / "2020-01-01.PARQUET"
    log.parent.mkdir()
    table = pa.table({"t": [0.0]})
    pq.write_table(table.replace_schema_metadata({"engine": "own", "time": "2021-01-01"}), log)
    at = str(log)
    assert Source(at).described() == Source(at, "own", moment("2021-01-01"))
    assert Source(at, "x").described() == Source(at, "x", moment("2021-01-01"))
    assert Source(at, "", 0.0).described() == Source(at, "own", 0.0)
    assert Source(at, "x", 0.0).described() == Source(at, "x", 0.0)
    pq.write_table(table.replace_schema_metadata({"time": "no date"}), log)
    assert Source(at).described() == Source(at, "e5", moment("2020-01-01"))
    pq.write_table(table.replace_schema_metadata(None), log)
    assert sources._metadata(at) == {}
    log.write_text("damaged")
    assert Source(at).described() == Source(at, "e5", moment("2020-01-01"))
    log.rename(tmp_path / "e5" / "a.csv")
    assert Source(str(tmp_path / "e5" / "a.csv")).described() == Source(str(tmp_path / "e5" / "a.csv"), "e5", None)
    assert sources._metadata(at) == sources._metadata(str(tmp_path / "e5" / "a.csv")) == {}
    os.mkfifo(at)
    assert sources._metadata(at) == {}, "a pipe is not waited for"


def test_folders_are_searched_for_logs_and_files_are_taken_as_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("d/a.csv", "d/deep/b.LOG", "d/.c.csv", "d/d.txt", "own.dat"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("x")
    (tmp_path / "d" / "f.csv").mkdir()
    (tmp_path / "d" / "link.csv").symlink_to("nowhere")
    os.mkfifo(tmp_path / "d" / "pipe.csv")
    monkeypatch.chdir(tmp_path)
    found = find(["own.dat", "d", "d/a.csv"])
    assert [os.path.relpath(s.path, tmp_path) for s in found] == ["d/a.csv", "d/deep/b.LOG", "d/link.csv", "own.dat"]
    assert {(s.engine, s.time) for s in found} == {("", None)}
    for bad in ("nowhere", "d/pipe.csv", "d/link.csv"):
        with pytest.raises(InputError, match=f"^{bad}: is neither a log nor a folder of logs$"):
            find([bad])
    with pytest.raises(InputError, match=r"d/f\.csv: holds no log; allowed: \.log"):
        find(["d/f.csv"])


def test_a_list_names_logs_by_path_from_its_folder_or_by_name(tmp_path: Path) -> None:
    for name in ("d/a.csv", "d/b.csv", "e/c.csv", "e/x.csv"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("x")
    text = f" path , engine,time\nd/a.csv, one ,1970-01-02\n{tmp_path}/d/b.csv,two\nc.csv,three,\n"
    (tmp_path / "list.csv").write_text(text, encoding="utf-8-sig")
    found = find([str(tmp_path / "d"), str(tmp_path / "e")], str(tmp_path / "list.csv"))
    assert [(s.engine, s.time) for s in found] == [("one", 86400.0), ("two", None), ("three", None), ("", None)]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("engine,time\nx,1970-01-01\n", "has the columns engine, time; needed: path and engine, time or both"),
        ("path,note\nx,y\n", "has the columns path, note; needed"),
        ("", "has the columns ; needed"),
        ("path,time\nx,\ny,soon\n", r"list.csv:3: time \(='soon'\) must be a date such as 2026-03-14T12:30"),
        ('path,time\n"x', "--engines .*list.csv: cannot be read as CSV"),
        ("path,time,path\na,b,c\n", "--engines .*list.csv: has the column 'path' more than once; allowed: once"),
    ],
)
def test_a_list_that_says_nothing_of_logs_is_refused(tmp_path: Path, text: str, says: str) -> None:
    (tmp_path / "list.csv").write_text(text)
    (tmp_path / "x").write_text("x")
    with pytest.raises(InputError, match=says):
        find([str(tmp_path / "x")], str(tmp_path / "list.csv"))


@pytest.mark.parametrize(
    ("columns", "row", "said"), [("path,engine", "x,e", ("e", None)), ("path,time", "x,1970-01-02", ("", 86400.0))]
)
def test_a_list_may_say_engine_or_time_only(
    tmp_path: Path, columns: str, row: str, said: tuple[str, float | None]
) -> None:
    (tmp_path / "list.csv").write_text(f"{columns}\n{row}\n")
    (tmp_path / "x").write_text("x")
    (s,) = find([str(tmp_path / "x")], str(tmp_path / "list.csv"))
    assert (s.engine, s.time) == said
