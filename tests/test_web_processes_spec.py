"""The processes of the workbench in one process: how work is asked for and answered, the tasks of the worker, the loop
that runs, what is kept private, and the curves that are sent.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import logging
import os
import queue
import socket
import struct
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("nicegui")

import httpx
from nicegui import Client
from nicegui.testing.general import nicegui_reset_globals

from controller import FAULTS
from hil.bus import frames
from hil.calibrate import master
from hil.logs import Channel
from hil.loop.ecu import builtin
from plant import load_geometry, load_schedules
from tests.workbench_page import Clock
from vaneloop.base import terminal
from vaneloop.base.errors import InputError
from vaneloop.identification.least_squares.problem import LeastSquaresProblem
from vaneloop.identification.regimes import locate
from vaneloop.verbs.machine import files_of
from vaneloop.web import command, held, jobs, loop, private, process, server, worker
from vaneloop.web.charts import Band, Curves, Mark, Over, Panel, Trace, bands, of_log, of_stage, painted, thinned, view
from vaneloop.web.jobs import AGAIN, COLUMNS, COMPILING, LOADING, Cancelled, Spare, Worker, WorkError
from vaneloop.web.process import Inbox, parsed
from vaneloop.web.server import Plain
from vaneloop.web.xy import MOST, Plane, arrows, plane, xy_figure

# ---- asked for, and answered -----------------------------------------------------------------------------------------


NOBODY = 1 << 23  # of no process: beyond what Linux numbers


class Started:
    """In place of a process: it ends when it is told to."""

    def __init__(self, pid: int = NOBODY):
        self.pid, self.code, self.over = pid, 0, threading.Event()
        ours, theirs = socket.socketpair()
        self.ours, self.theirs = Connection(ours.detach()), Connection(theirs.detach())

    def poll(self) -> int | None:
        return self.code if self.over.is_set() else None

    def wait(self) -> int:
        self.over.wait(5.0)
        return self.code

    def end(self, code: int = 0) -> None:
        self.code = code
        self.over.set()


class Spares:
    """In place of a spare process."""

    def __init__(self) -> None:
        self.taken: list[Started] = []

    def take(self) -> Any:
        self.taken.append(Started(NOBODY + len(self.taken)))
        return self.taken[-1], self.taken[-1].ours


async def until(true: Callable[[], Any]) -> None:
    """Wait for what another thread does."""
    for _ in range(2000):
        if true():
            return
        await asyncio.sleep(0.001)
    raise AssertionError("it has not come")


def test_a_question_is_answered_and_its_progress_told(monkeypatch: pytest.MonkeyPatch) -> None:
    killed: list[int] = []
    monkeypatch.setattr(jobs.os, "killpg", lambda pid, _: killed.append(pid))
    spares, changes, news = Spares(), [], []
    w = Worker("a.module", lambda: changes.append(1), spares)  # type: ignore[arg-type]
    w.news = news.append

    async def go() -> None:
        first = asyncio.ensure_future(w.call("look", "looking", words=["a"]))
        await until(lambda: w.jobs)
        (p,) = spares.taken
        assert await asyncio.get_running_loop().run_in_executor(None, p.theirs.recv) == (1, "look", {"words": ["a"]})
        second = asyncio.ensure_future(w.call("read", "reading"))
        await until(lambda: len(w.jobs) == 2)
        assert len(spares.taken) == 1 and [j.text for j in w.jobs.values()] == ["looking", "reading"]
        assert p.theirs.recv() == (2, "read", {})
        w.tell(stop=True)
        assert p.theirs.recv() == (1, "tell", {"stop": True})
        before = len(changes)
        p.theirs.send(("progress", LOADING, (None, "compiling")))
        await until(lambda: w.loading)
        assert {j.text for j in w.jobs.values()} == {"compiling"} and len(changes) == before + 1
        third = asyncio.ensure_future(w.call("more", "doing more"))
        await until(lambda: len(w.jobs) == 3)
        assert w.jobs[3].text == "compiling" and w.jobs[3].asked == "doing more"
        p.theirs.send(("progress", LOADING, (None, "")))
        await until(lambda: not w.loading)
        assert [j.text for j in w.jobs.values()] == ["looking", "reading", "doing more"]
        p.theirs.send(("progress", 1, (0.25, {"found": "x"})))
        p.theirs.send(("progress", 9, (0.5, "nobody's")))
        p.theirs.send(("progress", 2, (0.5, "half")))
        await until(lambda: w.jobs[2].fraction == 0.5)
        assert news == [{"found": "x"}] and w.jobs[1].fraction is None and w.jobs[2].text == "half"
        p.theirs.send(("done", 1, [1, 2]))
        p.theirs.send(("failed", 2, "no such file"))
        assert await first == [1, 2]
        with pytest.raises(WorkError, match=r"^no such file$"):
            await second
        w.loading = "compiling"
        w.stop()
        assert w.loading == ""
        with pytest.raises(Cancelled, match="stopped"):
            await third
        assert w.process is None and not w.jobs and killed == [NOBODY]

    def stopped(p: Any) -> None:
        killed.append(p.pid)
        p.end()

    monkeypatch.setattr(jobs, "_kill", stopped)
    monkeypatch.setattr(jobs.os, "killpg", lambda *_: None)
    asyncio.run(go())


def test_a_bar_moves_only_so_often(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, changes = Clock(monkeypatch, "jobs"), []
    w = Worker(changed=lambda: changes.append(1))
    job = w.jobs[1] = jobs.Job(1, "a", "at it", None, "at it", started=98.5)  # type: ignore[arg-type]
    assert job.seconds == 1.5
    told = []
    for now, fraction, text in ((100.0, 0.1, "at it"), (100.3, 0.2, ""), (100.31, 0.3, ""), (100.32, 0.4, "more"),
                                (100.4, 0.5, "more"), (100.61, 0.6, ""), (100.63, 0.7, "more")):  # fmt: skip
        clock.now = now
        w._progress(1, fraction, text)
        told.append(len(changes))
        assert job.fraction == fraction and job.text == ("at it" if now < 100.32 else "more")
    assert told == [1, 1, 2, 3, 3, 3, 4]
    w._progress(1, None, {"not": "taken"})
    assert job.fraction == 0.7


def test_a_process_that_ends_by_itself_leaves_a_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jobs.os, "killpg", lambda *_: None)
    spares = Spares()
    w = Worker(spare=spares)  # type: ignore[arg-type]

    async def fails(code: int) -> str:
        asked = asyncio.ensure_future(w.call("look", "looking"))
        await until(lambda: w.jobs)
        spares.taken[-1].end(code)
        with pytest.raises(WorkError) as e:
            await asked
        assert w.process is None
        return str(e.value)

    async def go() -> None:
        why = "; nothing is kept of it, start it again"
        ended = "the process that did this was ended from outside ({}), perhaps for want of memory" + why
        assert await fails(-9) == ended.format("signal 9")
        assert await fails(3) == ended.format("exit code 3")
        assert len(spares.taken) == 2
        await asyncio.sleep(0)
        w.start()
        w._connection.close()  # type: ignore[union-attr]
        with pytest.raises(WorkError, match="^the process that does this has ended; start it again$"):
            await w.call("look", "looking")
        w.tell(nobody="hears")
        w._lost(SimpleNamespace(wait=lambda: 1))  # type: ignore[arg-type]  # another one
        assert w.process is not None
        spares.taken[-1].end()

    asyncio.run(go())


def test_a_spare_process_is_there_for_the_next(monkeypatch: pytest.MonkeyPatch) -> None:
    launched: list[tuple[str, ...]] = []
    killed: list[Any] = []

    def launch(module: str, *more: str) -> Any:
        launched.append((module, *more))
        p = Started()
        return p, p.ours

    later: list[tuple[float, Any]] = []
    monkeypatch.setattr(jobs, "_launch", launch)
    monkeypatch.setattr(jobs, "_kill", killed.append)
    of_loop = SimpleNamespace(call_later=lambda *a: later.append(a))
    monkeypatch.setattr(jobs, "asyncio", SimpleNamespace(get_running_loop=lambda: of_loop))
    spare = Spare("m")
    spare.refill()
    spare.refill()
    assert launched == [("m", "--load")]
    ready = spare._ready
    assert spare.take() is ready and later == [(AGAIN, spare.refill)] and AGAIN == 10.0
    assert spare.take() is not ready and launched == [("m", "--load")] * 2  # none was there
    spare.refill()
    gone = spare._ready
    assert gone is not None
    gone[0].end()  # type: ignore[attr-defined]
    assert spare.take() is not gone and len(launched) == 4
    spare.close()
    spare.refill()
    assert killed == [] and len(launched) == 4
    other = Spare("n")
    other.refill()
    last = other._ready
    other.close()
    assert last is not None and killed == [last[0]] and other._ready is None


def test_a_process_is_started_apart_and_ended_with_its_group(monkeypatch: pytest.MonkeyPatch) -> None:
    given: dict[str, Any] = {}

    def popen(words: list[str], **more: Any) -> Any:
        given.update(more, words=words, there=os.fstat(more["pass_fds"][0]).st_mode)
        return SimpleNamespace(pid=77, wait=lambda: given.setdefault("waited", True))

    monkeypatch.setattr(jobs.subprocess, "Popen", popen)
    p, connection = jobs._launch("some.module", "--load")
    *_, script, descriptor, load = given["words"]
    assert "'some.module'" in script and [descriptor, load] == [str(given["pass_fds"][0]), "--load"]
    assert given["start_new_session"] is True
    assert given["env"]["OMP_NUM_THREADS"] == given["env"]["OPENBLAS_NUM_THREADS"] == "1" and given["env"]["PATH"]
    with pytest.raises(OSError, match="Bad file"):
        os.fstat(given["pass_fds"][0])
    connection.close()
    ended: list[Any] = []
    monkeypatch.setattr(jobs.os, "killpg", lambda *a: ended.append(a))
    jobs._kill(p)
    assert ended == [(77, 9)] and given["waited"]


# ---- the other side --------------------------------------------------------------------------------------------------


def test_what_comes_too_late_for_a_task_reaches_no_other() -> None:
    box = Inbox()
    assert box.take() is None
    box.put(0, {"a": 1})
    assert box.take() == {"a": 1} and box.take() is None
    box.put(1, {"old": 1})
    box.begin(2)
    box.put(2, {"new": 1})
    box.put(3, {"early": 1})
    assert box.take() == {"new": 1} and box.take() is None


def test_options_are_parsed_as_the_command_line_does() -> None:
    args = parsed("diagnose", ["a.csv", "--design-rpm", "38000"])
    assert (args.log, args.design_rpm, args.quiet) == ("a.csv", 38000.0, True)
    with pytest.raises(InputError, match=r"^vaneloop diagnose: error: unrecognized arguments: --nothing$|--nothing"):
        parsed("diagnose", ["a.csv", "--nothing"])


class Questions:
    """In place of a queue: the questions in their order, and then the end."""

    def __init__(self, *asked: Any):
        self.asked = list(asked)

    def get(self) -> Any:
        if not self.asked:
            raise KeyboardInterrupt
        return self.asked.pop(0)

    def put(self, item: Any) -> None:
        raise AssertionError(item)


def test_questions_are_answered_in_their_order(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = SimpleNamespace(now=100.0)
    limits: list[Any] = []
    monkeypatch.setattr(process, "time", SimpleNamespace(monotonic=lambda: clock.now))
    monkeypatch.setattr(process.resource, "setrlimit", lambda *a: limits.append(a))
    monkeypatch.setattr(process.threading, "Thread", lambda **_: SimpleNamespace(start=lambda: None))
    box = Inbox()
    monkeypatch.setattr(process, "INBOX", box)

    def works(progress: Any, a: int) -> int:
        assert box._task == 1
        for now, fraction in ((100.0, 0.5), (100.04, 0.6), (100.06, 0.7), (100.07, 1.0), (100.08, None), (100.1, 0.8)):
            clock.now = now
            progress(fraction, "words")
        return a + 1

    def fails(progress: Any, how: str) -> None:
        raise InputError("a line") if how == "input" else ValueError("ours")

    monkeypatch.setattr(terminal, "defect", lambda e: f"a defect: {e}")
    asked = [(1, "works", {"a": 2}), (2, "fails", {"how": "input"}), (3, "fails", {"how": "else"}), (4, "none", {})]
    monkeypatch.setattr(process.queue, "Queue", lambda: Questions(*asked))
    ours, theirs = socket.socketpair()
    said: list[str] = []

    def load(progress: Any) -> None:
        progress(0.5, "loading")
        said.append("loaded")
        raise ValueError("told when it is asked for")

    with pytest.raises(KeyboardInterrupt):
        process.answer(theirs.detach(), {"works": works, "fails": fails}, load)
    connection, got = Connection(ours.detach()), []
    with contextlib.suppress(EOFError):
        while connection.poll(5.0):
            got.append(connection.recv())
    assert got == [
        ("progress", LOADING, (None, "loading")), ("progress", LOADING, (None, "")),
        ("progress", 1, (0.5, "words")), ("progress", 1, (0.7, "words")), ("progress", 1, (1.0, "words")),
        ("progress", 1, (None, "words")), ("done", 1, 3), ("failed", 2, "a line"), ("failed", 3, "a defect: ours"),
        ("failed", 4, "a defect: 'none'"),
    ]  # fmt: skip
    (_, memory), (_, core) = limits
    whole = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    assert memory == (max(4 << 30, int(0.75 * whole)),) * 2 and core == (0, 0) and said == ["loaded"]


def test_what_listens_sorts_questions_from_news_and_ends_with_the_server(monkeypatch: pytest.MonkeyPatch) -> None:
    box, ended = Inbox(), threading.Event()
    monkeypatch.setattr(process, "INBOX", box)
    monkeypatch.setattr(process.resource, "setrlimit", lambda *_: None)
    killed: list[Any] = []

    def kill(*given: Any) -> None:
        killed.append(given)
        ended.set()

    monkeypatch.setattr(process.os, "killpg", kill)
    ours, theirs = socket.socketpair()
    connection = Connection(ours.detach())
    connection.send((0, "tell", {"stop": True}))
    connection.send((5, "last", {}))
    monkeypatch.setattr(process.queue, "Queue", Ends)
    try:
        with pytest.raises(KeyboardInterrupt):
            process.answer(theirs.detach(), {"last": lambda progress: box.put(5, {"late": 1})})
        assert connection.recv() == ("done", 5, None)
    finally:
        connection.close()
        ended.wait(5.0)  # as long as nothing is killed
    assert killed == [(os.getpgrp(), 9)]
    assert box.take() == {"late": 1} and box.take() is None


class Ends(queue.Queue):  # type: ignore[type-arg]
    """A queue that ends after its first question."""

    begun = False

    def get(self, *given: Any, **more: Any) -> Any:
        if self.begun:
            raise KeyboardInterrupt
        self.begun = True
        return super().get(*given, **more)


# ---- what is kept private --------------------------------------------------------------------------------------------


def test_the_private_folder_is_ones_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(private.tempfile, "tempdir", str(tmp_path))
    with private.private_folder() as folder:
        assert folder.name.startswith(f"vaneloop-web-{os.getpid()}-") and folder.stat().st_mode & 0o777 == 0o700
        lock = folder / "lock"
        assert lock.stat().st_mode & 0o777 == 0o600 and [p.name for p in folder.iterdir()] == ["lock"]
        assert private.sweep(tmp_path) == [] and not private._left(folder)
    assert not folder.exists()
    odd = tmp_path / "vaneloop-web-odd"
    odd.mkdir()
    assert private._left(odd) and private.sweep(tmp_path) == [odd] and not odd.exists()


# ---- the command -----------------------------------------------------------------------------------------------------


def test_the_command_says_its_link_and_what_is_wrong(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    served: list[Any] = []
    opened: list[str] = []
    monkeypatch.setattr("vaneloop.web.server.serve", lambda sock, *given: served.append((sock, *given)))
    monkeypatch.setattr(command.webbrowser, "open", opened.append)
    monkeypatch.setattr(command, "needs", lambda *given: served.append(given))
    parser = argparse.ArgumentParser()
    command.add_options(parser)
    token = "a-token_of-this-test0"
    monkeypatch.setenv("VANELOOP_WEB_TOKEN", token)

    def run(*words: str) -> Any:
        served.clear()
        assert command.command(parser.parse_args([*words, "--folder", str(tmp_path)])) == 0
        assert served[0] == ("the workbench", "nicegui", "tsdownsample")
        sock, folder, known, most, loopback, ready, tables, controller = served[1]
        port = sock.getsockname()[1]
        ready("once")
        sock.close()
        assert (folder, known, tables, controller) == (tmp_path, token, None, None)
        return port, most, loopback, capsys.readouterr()

    port, most, loopback, said = run("--port", "0")
    link = f"http://127.0.0.1:{port}/?token="
    assert said.out == f"{link}{token}\n" and opened == [f"{link}once"] and loopback and most == 512 << 20
    assert said.err == "starting the workbench; its link follows ...\nCtrl-C ends it\n"
    port, most, loopback, said = run("--port", "0", "--host", "0.0.0.0", "--quiet", "--no-open", "--upload-limit", "1")
    assert said.out == f"http://{socket.gethostname()}:{port}/?token={token}\n" and said.err == "" and len(opened) == 1
    assert not loopback and most == 1 << 20
    assert parser.parse_args([]).port == 8765 and parser.parse_args([]).upload_limit == 512
    taken = socket.create_server(("127.0.0.1", 0))
    bad = [
        (["--port", "-1"], r"--port \(=-1\) must be in \[0, 65535\]"),
        (["--port", "65536"], r"--port \(=65536\) must be in \[0, 65535\]"),
        (["--upload-limit", "0"], r"--upload-limit \(=0 MB\) must be in \[1, 16384\]"),
        (["--upload-limit", "16385"], r"--upload-limit \(=16385 MB\) must be in \[1, 16384\]"),
        (["--folder", "no/such"], "--folder no/such: is not a folder"),
        (["--host", "no such host"], "--host no such host --port 8765: cannot listen there .*"),
        (["--port", str(taken.getsockname()[1])], ".*cannot listen there .Address already in use."),
    ]  # fmt: skip
    for words, why in bad:
        with pytest.raises(InputError, match=f"^{why}$"):
            command.command(parser.parse_args(words))
    taken.close()
    for wrong in ("x" * 15, "x" * 16 + "!", "x" * 16 + "é"):
        monkeypatch.setenv("VANELOOP_WEB_TOKEN", wrong)
        with pytest.raises(InputError, match=f"^VANELOOP_WEB_TOKEN: 16 or more .* it has {len(wrong)} characters$"):
            command.command(parser.parse_args(["--port", "0"]))
    for good in ("x" * 16, "", "A-_0" * 4):
        monkeypatch.setenv("VANELOOP_WEB_TOKEN", good)
        command.command(parser.parse_args(["--port", "0", "--quiet", "--no-open"]))
        assert len(served[-1][2]) >= 16
        served[-1][0].close()
    for port in ("65535", "1"):
        args = parser.parse_args(["--port", port, "--folder", str(tmp_path), "--upload-limit", "16384", "--quiet"])
        monkeypatch.setattr(command, "_listen", lambda *given: socket.create_server(("::1", 0), family=socket.AF_INET6))
        command.command(args)
        served[-1][5]("x")
        served[-1][0].close()
        assert "http://[::1]:" in capsys.readouterr().out and served[-1][3] == 16384 << 20


# ---- curves ----------------------------------------------------------------------------------------------------------


def unpacked_view(body: bytes) -> tuple[dict[str, Any], list[np.ndarray]]:
    """Head and lines of an answer."""
    (size,) = struct.unpack_from("<I", body)
    head = json.loads(body[4 : 4 + size])
    at, lines = 4 + size + (-(4 + size) % 8), []
    for p in head["panels"]:
        for _ in range(1 + len(p["lines"])):
            lines.append(np.frombuffer(body, "<f8", p["n"], at))
            at += 8 * p["n"]
    assert at == len(body)
    return head, lines


def test_a_view_has_what_is_asked_for_and_one_sample_to_each_side() -> None:
    t = np.arange(100.0)
    panels = [Panel("a", "mm", t, [Trace("x", t**2, "model", 2.0, (3, 1)), Trace("y", -t)], 0.5, 99, 1.5, "g"),
              Panel("b", "-", t[10:20] * 2.0, [Trace("z", t[:10])]), Panel("c", "", t[:0], [])]  # fmt: skip
    curves = Curves(panels, "key", [Mark(5.0, "gust")], [Band(1.0, 2.0, "RUN", "bad")])
    head, (x, a, y, *_) = unpacked_view(view(curves, 20.0, 30.0, 500))
    assert x.tolist() == list(range(19, 31)) and a.tolist() == [v**2 for v in x] and y.tolist() == [-v for v in x]
    assert head["panels"][0] == {
        "title": "a", "unit": "mm", "band": 0.5, "height": 99, "least": 1.5, "group": "g", "n": 12,
        "lines": [{"name": "x", "role": "model", "width": 2.0, "dash": [3, 1]},
                  {"name": "y", "role": "measured", "width": 1.25, "dash": []}],
    }  # fmt: skip
    assert (head["span"], head["key"], head["near"]) == ([0.0, 99.0], "key", 40.0)
    assert head["marks"] == [[5.0, "gust"]] and head["bands"] == [[1.0, 2.0, "RUN", "bad"]]
    for start, end in ((0.0, 3.0), (-9.0, 3.0), (0.5, 3.0)):
        assert unpacked_view(view(curves, start, end, 500))[1][0].tolist() == [0.0, 1.0, 2.0, 3.0]
    whole, lines = unpacked_view(view(curves, None, None, 500))
    assert [p["n"] for p in whole["panels"]] == [100, 10, 0] and lines[3].tolist() == (t[10:20] * 2.0).tolist()
    assert unpacked_view(view(Curves(), None, None, 1))[0]["span"] == [0.0, 1.0]
    one = Curves([Panel("a", "mm", t[5:6], [Trace("x", t[5:6])])])
    head, _ = unpacked_view(view(one, None, None, 1))
    assert head["span"] == [5.0, 6.0] and head["near"] == 2.0
    fine = Curves([Panel("a", "mm", t * 1e-3, [Trace("x", t)])])
    assert unpacked_view(view(fine, None, None, 1))[0]["near"] == 2.0


def test_a_thinned_line_keeps_its_extremes_within_a_bound() -> None:
    t = np.arange(50_000.0)
    y, z = np.sin(t), np.zeros_like(t)
    z[777], z[30_000:30_010], y[:5] = 9.0, np.nan, np.nan
    for n_out in (200, 1000):
        x, (a, b) = thinned(t, [y, z], n_out)
        assert len(x) <= 2 * max(100, n_out // 2) and (b[x == 777.0] == 9.0).all() and 777.0 in x
        assert np.isin(x, t).all() and (np.diff(x) > 0).all() and a[x == 777.0] == y[777]
    same, lines = thinned(t[:200], [y[:200]], 200)
    assert same is not None and len(same) == 200 and len(lines) == 1
    assert len(thinned(t[:201], [y[:201]], 200)[0]) <= 200
    for pixels, n in ((1, 200), (100, 200), (150, 300), (10**6, 4000)):
        head, _ = unpacked_view(view(Curves([Panel("a", "", t, [Trace("x", np.sin(0.37 * t))])]), None, None, pixels))
        assert 0.9 * n <= head["panels"][0]["n"] <= n


def test_curves_of_a_log_are_grouped_and_other_logs_laid_over() -> None:
    t = np.arange(5.0)
    channels = {
        "n_dem": ("%", t, t),
        "state": ("-", t, np.array([2.0, 3.0, 3.0, 4.0, 2.0])),
        "odd": ("V", t, t),
        "lag": ("", t, t),
    }
    over = [Over("one", {"n_dem": ("%", t, 2 * t)}, 1.0), Over("two", {"n_dem": ("%", t, t)})]
    c = of_log(channels, "k", over, [Mark(1.0, "m")], [Band(0.0, 1.0, "x", "noise")], made=["lag"])
    assert [(p.title, p.group, p.height) for p in c.panels] == [
        ("n_dem [%]", "speed", 74), ("state", "controller", 74), ("odd [V]", "", 74), ("lag", "formulas", 74),
    ]  # fmt: skip
    assert [(x.name, x.role, x.dash) for x in c.panels[0].traces] == [
        ("this log", "measured", ()), ("one", "model", (7, 3)), ("two", "target", (2, 3)),
    ]  # fmt: skip
    assert np.isnan(c.panels[0].traces[1].y[0]) and c.panels[0].traces[1].y[1:].tolist() == [0.0, 2.0, 4.0, 6.0]
    assert [(b.start, b.end, b.text, b.role) for b in c.bands] == [
        (1.0, 3.0, "DEGRADED", "model"), (3.0, 4.0, "FAIL_SAFE", "bad"), (0.0, 1.0, "x", "noise"),
    ]  # fmt: skip
    assert [x.name for x in of_log(channels, "k").panels[2].traces] == ["odd"]
    assert of_log(channels, "k", modes=False).bands == ()
    assert len(bands(np.arange(2000.0), np.arange(2000.0) % 2, {1: ("on", "bad")})) == 400


def test_errors_of_a_stage_lie_below_its_curves() -> None:
    t = np.arange(4.0)
    told = {"t": t, "outputs": {"x": {"unit": "mm", "floor": 0.1, "measured": 2 * t, "errors": {"nominal model": t}}}}
    hand = {"outputs": {"x": {"errors": {"by hand": 0.5 * t}}}}
    c = of_stage(told, hand, "k")
    assert [(p.title, p.band, p.height) for p in c.panels] == [
        ("x [mm]", None, 150),
        ("error [mm]", pytest.approx(0.3), 150),
    ]
    assert [(x.name, x.role, x.y.tolist()) for x in c.panels[0].traces] == [
        ("measured", "measured", [0.0, 2.0, 4.0, 6.0]), ("nominal model", "error", [0.0, 1.0, 2.0, 3.0]),
        ("by hand", "target", [0.0, 1.5, 3.0, 4.5]),
    ]  # fmt: skip
    assert [(x.name, x.role, x.y.tolist()) for x in c.panels[1].traces] == [
        ("nominal model", "error", t.tolist()), ("by hand", "target", (0.5 * t).tolist()),
    ]  # fmt: skip
    assert len(of_stage(told, None, "k").panels[1].traces) == 1


def test_a_role_is_painted_in_the_themes_colour() -> None:
    theme = {"model": "#aabbcc"}
    assert painted({"a": ["@model", "@model/0.5", "@nobody", 3], "b": {"bdata": "@model"}}, theme) == {
        "a": ["#aabbcc", "#aabbcc80", "@nobody", 3], "b": {"bdata": "@model"},
    }  # fmt: skip


# ---- one over the other ----------------------------------------------------------------------------------------------


def test_a_plane_has_the_samples_of_both_channels() -> None:
    t = np.arange(10.0)
    x, y = Channel(t, t**2, unit="mm"), Channel(t, -t, unit="V")
    p = plane(x, y, None)
    assert (
        p.n == 10
        and p.colour.tolist() == t.tolist()
        and p.x.tolist() == (t**2).tolist()
        and p.y.tolist() == (-t).tolist()
    )
    p = plane(x, y, Channel(t, t + 5.0, unit="-"), (2.0, 5.0))
    assert (p.t.tolist(), p.colour.tolist(), p.n) == ([2.0, 3.0, 4.0], [7.0, 8.0, 9.0], 3)
    holed = Channel(t, np.where(t == 4.0, np.nan, t), unit="mm")
    p = plane(holed, y, None)
    assert p.n == 9 and np.isnan(p.x).sum() == np.isnan(p.y).sum() == np.isnan(p.colour).sum() >= 1
    gap = np.concatenate([t, t + 100.0])
    p = plane(Channel(gap, gap, unit="mm"), Channel(gap, gap, unit="V"), None)
    assert p.n == 20 and len(p.t) == 21 and np.isnan(p.x[10]) and p.t[10] == 9.0 and not np.isnan(p.x[[9, 11]]).any()
    long = np.arange(20_000.0)
    p = plane(Channel(long, np.sin(long), unit="-"), Channel(long, np.cos(long), unit="-"), None)
    assert p.n == 20_000 and 0.5 * MOST < len(p.t) <= MOST == 4000


def test_arrows_point_along_the_way_and_noise_turns_none() -> None:
    x, y = np.linspace(0.0, 1.0, 101), np.zeros(101)
    ax, ay = arrows(x, y)
    assert ay.tolist() == [0.0] * 16 and ax.tolist() == [
        pytest.approx(v) for k in range(8) for v in (0.12 * k, 0.12 * k + 0.12)
    ]  # fmt: skip
    turn = np.linspace(0.0, 6.0 * np.pi, 2000)
    ax, ay = arrows(5.0 * np.cos(turn), 0.1 * np.sin(turn))
    assert len(ax) == 28
    step = np.hypot(np.diff(ax)[::2] / 10.0, np.diff(ay)[::2] / 0.2)
    assert (step >= 0.12).all() and (step < 0.13).all()
    for none in (np.zeros(0), np.full(5, 3.0), np.full(3, np.nan)):
        assert arrows(none, none)[0].size == 0
    ax, ay = arrows(np.array([0.0, np.nan, 1.0]), np.array([0.0, 5.0, 1.0]))
    assert (ax.tolist(), ay.tolist()) == ([0.0, 1.0], [0.0, 1.0])
    ax, _ = arrows(np.array([0.0, 0.05, 0.0, 0.05, 1.0]), np.zeros(5))
    assert ax.tolist() == [0.0, 1.0]


def test_a_plane_is_drawn_with_its_begin_and_end() -> None:
    t = np.arange(5.0)
    f = xy_figure(Plane(t, np.array([np.nan, 1.0, 2.0, 3.0, np.nan]), t, 2 * t, 3), ["<x>", "y", "c"])
    way, points, arrow, begin, end = f["data"]
    assert (begin["name"], begin["x"], begin["y"]) == ("begin", [1.0], [1.0])
    assert (end["name"], end["x"], end["y"], end["marker"]["symbol"]) == ("end", [3.0], [3.0], "square-open")
    assert points["marker"]["color"] == [2.0, 4.0, 6.0] and points["customdata"] == [1.0, 2.0, 3.0]
    assert (
        arrow["x"] == [1.0, 2.0, 2.0, 3.0] and arrow["marker"]["size"] == [0, 13, 0, 13] and way["line"]["width"] == 1
    )
    assert f["layout"]["xaxis"]["title"]["text"] == "&lt;x&gt;" and f["layout"]["yaxis"]["title"]["text"] == "y"
    assert points["marker"]["size"] == 4 and points["marker"]["colorbar"]["thickness"] == 14
    none = np.full(2, np.nan)
    assert len(xy_figure(Plane(t[:2], none, none, none, 0), ["x", "y", "c"])["data"]) == 3
    assert len(xy_figure(Plane(t[:0], t[:0], t[:0], t[:0], 0), ["x", "y", "c"])["data"]) == 3


# ---- the loop that runs ----------------------------------------------------------------------------------------------


class Ticking(Clock):
    """A clock that goes on by a fixed time whenever it is read."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *modules: str, step: float = 0.004):
        super().__init__(monkeypatch, *modules)
        self.step = step
        self.slept: list[float] = []

    def perf_counter(self) -> float:
        self.now += self.step
        return round(self.now, 9)

    def sleep(self, seconds: float) -> None:
        self.slept.append(seconds)
        self.now += seconds


def lockstep_of(
    monkeypatch: pytest.MonkeyPatch, told: list[dict[str, Any]], speed: float = 0.0, **more: Any
) -> tuple[list[Any], dict[str, Any], Ticking]:
    """Run the loop; after each of its news the next of ``told`` comes, and in the end "stop"."""
    box, news = Inbox(), []
    monkeypatch.setattr(loop, "INBOX", box)
    clock = Ticking(monkeypatch, "loop")
    left = [*told, {"stop": True}]

    def progress(share: Any, content: Any) -> None:
        assert share is None
        news.append(content)
        if isinstance(content, dict) and "rows" in content:
            after = left.pop(0) if left else {}  # a round goes on when it is told to stop
            for one in after if isinstance(after, list) else [after]:
                box.put(0, one)

    given = {"demand": 70.0, "record": None, "seed": 1, "profile": None, **more}
    return news, loop.lockstep(progress, speed=speed, **given), clock


def column(news: list[Any], name: str) -> np.ndarray:
    """All values of a column."""
    return np.concatenate([n["rows"][:, COLUMNS.index(name)] for n in news if "rows" in n])


def test_the_loop_is_driven_by_what_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[Any] = [
        {"demand": 90.0}, {"demand": 999.0}, {"demand": -3.0}, {"mode_request": 0}, {"mode_request": 1},
        {"profile": "staircase"}, {"nobody": 1},
    ]  # fmt: skip
    news, answer, clock = lockstep_of(monkeypatch, told)
    assert news[0] == COMPILING and {e.name for e in news[1]["elements"]} >= {"current_limit"}
    said = [n for n in news if isinstance(n, dict) and "rows" in n]
    curve = builtin("staircase").per_frame()[:, 0]
    assert [n["n_dem"] for n in said] == [70.0, 90.0, 120.0, 0.0, 0.0, 0.0, *([curve[0]] * 3)]
    t = column(said, "t")
    assert (np.diff(t).round(3) == 0.01).all() and t[-1] < answer["simulated_s"]
    assert answer["frames"] == said[-1]["frames"] == sum(len(n["trace"]) for n in said) and answer["record"] is None
    assert len(answer["state_hash"]) >= 16 and all(0.0 < n["load"] < 1.0 and n["injecting"] == 0.0 for n in said)
    per_round = answer["simulated_s"] / len(said)
    shares = np.array([0.0, *(n["speed"] for n in said)])
    reached = (shares[1:] - 0.8 * shares[:-1]) / 0.2  # of each round, before it is smoothed
    np.testing.assert_allclose(reached, reached[0])
    assert reached[0] == pytest.approx(per_round / 0.104, rel=0.1)
    assert clock.slept == []
    again, same, _ = lockstep_of(monkeypatch, told)
    assert same == answer and len(again) == len(news)
    _, other, _ = lockstep_of(monkeypatch, told, seed=None)
    assert other["state_hash"] != answer["state_hash"]


def test_a_profile_goes_on_every_ten_ticks_from_when_it_was_begun(monkeypatch: pytest.MonkeyPatch) -> None:
    curve = builtin("sine").per_frame()[:, 0]
    news, answer, _ = lockstep_of(monkeypatch, [{}, {}], profile="sine")
    said = [n for n in news if isinstance(n, dict) and "rows" in n]
    ticks = round(1000 * answer["simulated_s"])
    each = ticks // len(said)
    assert [n["n_dem"] for n in said] == [curve[(each * (k + 1) - 1) // 10] for k in range(len(said))]
    news, _, _ = lockstep_of(monkeypatch, [{}, {"profile": "sine"}, {}])
    said = [n for n in news if isinstance(n, dict) and "rows" in n]
    assert [n["n_dem"] for n in said[2:]] == [curve[(each * (k + 1) - 1) // 10] for k in range(len(said) - 2)]


def test_the_loop_keeps_the_pace_that_is_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    news, answer, clock = lockstep_of(monkeypatch, [{}, {}, {"speed": 0.5}, {}, {}], speed=1.0)
    said = [n for n in news if isinstance(n, dict) and "rows" in n]
    t = [n["rows"][-1, 0] if len(n["rows"]) else np.nan for n in said]
    assert 0.3 < answer["simulated_s"] < 0.7 and len(clock.slept) >= 5 and min(clock.slept) >= 0.0
    steps = np.diff([v for v in t if v == v])
    assert steps[0] == pytest.approx(0.1, abs=0.03) and steps[-1] == pytest.approx(0.05, abs=0.03)


@pytest.mark.parametrize(
    ("names", "sees"),
    [
        (["demand_stops"], lambda n: column(n, "faults").max() > 0),
        (["babbling_idiot", "bit_flips"], lambda n: max(x["load"] for x in n) > 0.5),
        (["supply_lost"], lambda n: np.nanmin(column(n, "p_s")) < 0.8 * np.nanmax(column(n, "p_s"))),
        (["bus_off_ecu", "error_frames_all"], lambda n: column(n, "faults").max() > 0),
        (["old_frames_again", "status_spoofed"], lambda n: n[-1]["frames"] > 0),
    ],
)
def test_a_scenario_begins_now_and_is_forgotten_when_it_is_over(
    monkeypatch: pytest.MonkeyPatch, names: list[str], sees: Callable[[list[Any]], Any]
) -> None:
    made: list[Any] = []

    class Seen(loop._Injected):
        def __init__(self, *given: Any):
            super().__init__(*given)
            made.append(self)

    monkeypatch.setattr(loop, "_Injected", Seen)
    told: list[Any] = [{}, [{"inject": n} for n in names], *({} for _ in range(8))]
    news, answer, _ = lockstep_of(monkeypatch, told)
    said = [n for n in news if isinstance(n, dict) and "rows" in n]
    begun = [x for n in said for x in n["injected"]]
    per_round = answer["simulated_s"] / len(said)
    assert [n for _, n in begun] == names and all(t == pytest.approx(2 * per_round + 0.001) for t, _ in begun)
    assert [bool(n["injected"]) for n in said].index(True) == 2
    left = [n["injecting"] for n in said]
    ends = [min(a.end - s.inject[0].start if a.end < 1e6 else a.end, s.duration - min(b.start for b in s.inject))
            for s in map(loop.load_scenario, names) for a in s.inject]  # fmt: skip
    assert left[1] == 0.0 and left[2] == pytest.approx(max(0.0, max(ends) + begun[0][0] - 3 * per_round))
    assert sees(said)
    (injected,) = made
    injected.tidy(10**9)
    assert not injected.machines and not injected.disturbers and not injected.intruders
    assert injected.gateways == {"ECU": [], "VGV": []}


def test_a_tool_calibrates_the_loop_over_its_bus(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    write = [master.CONNECT, *master.write_number(0, 0.5)]
    record = tmp_path / "run.log"
    news, answer, _ = lockstep_of(
        monkeypatch, [[{"xcp": (1, [master.CONNECT])}, {"xcp": (2, write)}], {}, {}, {}], record=str(record)
    )
    done = [x for n in news if isinstance(n, dict) for x in n.get("xcp", ())]
    assert [n for n, _ in done] == [1, 2] and isinstance(done[0][1], list)
    assert answer["record"] == str(record) and len(record.read_text().splitlines()) == answer["frames"]


class Bus:
    """In place of a bus."""

    def __init__(self) -> None:
        self.over, self.written = 0, []
        self.lost = 7
        self.frames: list[list[tuple[int, int]]] = []

    def shutdown(self) -> None:
        self.over += 1

    def read(self, rows: np.ndarray) -> int:
        now = self.frames.pop(0) if self.frames else []
        rows[: len(now)] = np.array(now).reshape(-1, 2)
        return len(now)

    def write(self, rows: np.ndarray) -> None:
        self.written += rows.tolist()


def test_a_listener_hears_everything_and_is_the_tool(monkeypatch: pytest.MonkeyPatch) -> None:
    bus, box = Bus(), Inbox()
    monkeypatch.setattr(loop, "INBOX", box)
    monkeypatch.setattr(loop, "open_bus", lambda name: bus if name == "local:x" else None)
    monkeypatch.setattr(loop, "Port", lambda opened: opened)
    clock = Ticking(monkeypatch, "loop")
    angles = next(i for i, n in frames.NAMES.items() if n == "VGV_ANGLES")
    data = frames.crc(angles, 0x100) | 0x100
    bus.frames = [[(angles | frames.LENGTH << 32, data)] * 3, []]
    news: list[Any] = []
    box.put(0, {"xcp": (1, [master.CONNECT])})

    def progress(_: Any, content: Any) -> None:
        news.append(content)
        if len(news) == 2:
            box.put(0, {"stop": True})

    assert loop.listen(progress, "local:x") == {"frames": 3} and bus.over == 1
    assert [(n["frames"], n["lost"], n["clock"]) for n in news] == [(3, 7, 100.004)] * 2
    t = news[0]["rows"][:, 0]
    assert len(t) == 3 and (t == t[0]).all() and 0.0 < t[0] < 0.05 and len(news[1]["rows"]) == 0
    assert len(bus.written) == 1 and set(clock.slept) == {0.005} and len(news) == 2


def in_real_time(
    monkeypatch: pytest.MonkeyPatch, told: list[dict[str, Any]], begin: Callable[[Any], Any], fails: bool = False
) -> tuple[dict[str, Any], Any]:
    """Begin a node of a loop in real time that ends when it is asked to, or by a failure."""
    box, seen = Inbox(), SimpleNamespace(news=[], bus=Bus(), opened=None, recorder=None)
    monkeypatch.setattr(loop, "INBOX", box)
    clock = Clock(monkeypatch, "loop")

    def open_bus(name: str, can_filters: Any) -> Bus:
        seen.opened = name, can_filters
        return seen.bus

    class Recorder:
        def __init__(self, path: str, name: str):
            seen.recorder, self.closed = self, 0
            self.of = path, name

        def put(self, data: Any) -> None:
            seen.put = data

        def close(self) -> None:
            self.closed += 1

    shown = SimpleNamespace(figures=lambda: {"p50_us": 1.0}, shown=lambda: [("< 10 us", 3)])
    report = SimpleNamespace(begin=shown, ticks=5, missed=1, skipped=2, failed="")

    def run(station: Any, port: Any, stop: Any, put: Any, live: Any) -> Any:
        seen.station, seen.put_given = station, put
        live(report)
        if fails:
            raise InputError("it fails")
        while not stop.asked:
            threading.Event().wait(0.0005)
        seen.asked = stop.asked
        return report

    monkeypatch.setattr(loop, "open_bus", open_bus)
    monkeypatch.setattr(loop, "Port", lambda bus: ("port of", bus))
    monkeypatch.setattr(loop, "RecorderProcess", Recorder)
    monkeypatch.setattr(loop, "run_realtime", run)
    monkeypatch.setattr(loop, "undisturbed", lambda: contextlib.nullcontext(["a note"]))
    for t in told:
        box.put(0, t)
    before = threading.active_count()
    try:
        return begin(lambda *a: seen.news.append(a)), seen
    finally:
        assert seen.bus.over == 1 and threading.active_count() == before and clock.now >= 100.0


def test_the_engine_follows_what_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def begin(progress: Any) -> Any:
        return loop.ecu(progress, "local:x", 66.0, None)

    answer, seen = in_real_time(monkeypatch, [{"demand": 200.0, "mode_request": 0, "stop": True}], begin)
    assert answer == {
        "late": {"p50_us": 1.0}, "histogram": [("< 10 us", 3)], "ticks": 5, "missed": 1, "failed": "",
        "notes": ["a note"], "record": None,
    }  # fmt: skip
    assert seen.asked == "stop" and seen.recorder is None and seen.put_given is None and seen.opened[0] == "local:x"
    assert seen.news == [
        (None, {"late": {"p50_us": 1.0, "ticks": 5, "missed": 1, "skipped": 2}, "histogram": [("< 10 us", 3)]})
    ]
    made: list[Any] = []

    class Typed(loop.Typed):
        def __init__(self, *given: Any):
            super().__init__(*given)
            made.append(self)

    monkeypatch.setattr(loop, "Typed", Typed)
    for told, n_dem, mode in (({"demand": 200.0, "mode_request": 0}, 120.0, 0), ({"demand": -5.0}, 0.0, 1),
                              ({}, 66.0, 1)):  # fmt: skip
        in_real_time(monkeypatch, [{**told, "stop": True}], begin)
        assert (made[-1].n_dem, int(made[-1].mode_request)) == (n_dem, mode)
    in_real_time(monkeypatch, [{"profile": "staircase", "stop": True}], begin)
    curve = builtin("staircase").per_frame()[:, 0]
    assert made[-1].n_dem == curve[0]
    in_real_time(monkeypatch, [{"stop": True}], lambda p: loop.ecu(p, "local:x", 66.0, "ramp"))
    assert made[-1].n_dem == builtin("ramp").per_frame()[0, 0]


def test_the_controller_runs_and_is_recorded(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    record = str(tmp_path / "run.log")

    def begin(progress: Any) -> Any:
        return loop.node(progress, "local:x", record, 1, tuned=str(tmp_path))

    answer, seen = in_real_time(monkeypatch, [{"demand": 3.0}, {"stop": True}], begin)
    assert answer["record"] == record and seen.recorder.of == (record, "local-x") and seen.recorder.closed == 1
    assert seen.put_given == seen.recorder.put and seen.news[0] == (None, COMPILING)
    assert "elements" in seen.news[1][1] and seen.station.told is True
    with pytest.raises(InputError, match="it fails"):
        in_real_time(monkeypatch, [], begin, fails=True)
    plain = loop._attended(lambda *_: None, loop.Node(), str(tmp_path))
    assert plain.told is False
    assert (
        seen.opened[1]
        != in_real_time(monkeypatch, [{"stop": True}], lambda p: loop.ecu(p, "x", 66.0, None))[1].opened[1]
    )


def test_a_scenario_on_a_bus_says_when_it_began(monkeypatch: pytest.MonkeyPatch) -> None:
    Clock(monkeypatch, "loop")
    made = loop.load_scenario("demand_stops")
    first = min(a.start for a in made.inject)
    shares = [0.5 * first / made.duration, first / made.duration, 0.9]
    given: list[Any] = []

    def run(scenario: Any, bus: str, name: str, progress: Any) -> Any:
        given.append((scenario.title, bus, name))
        for s in shares:
            progress(s)
        return SimpleNamespace(held=True)

    monkeypatch.setattr(loop, "run", run)
    said: list[Any] = []
    assert loop.outside(lambda *a: said.append(a), "demand_stops", "vcan0") is True
    text = "injecting demand_stops"
    assert said == [(shares[0], text), (None, {"at": 100.0, "name": "demand_stops"}), (shares[1], text), (0.9, text)]
    assert given == [(made.title, "vcan0", "demand_stops")]


# ---- the tasks of the worker -----------------------------------------------------------------------------------------


def silent(*_: Any) -> None:
    """Progress that nobody sees."""


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """A log of the machine, with a fault."""
    t = np.arange(0.0, 20.0, 0.05)
    n = 70.0 + 10.0 * np.sin(t)
    rows = np.column_stack([t, n, n, t > 10.0])
    path = tmp_path / "run.csv"
    np.savetxt(path, rows, delimiter=",", header=f"t,n_dem,Speed,fault_{FAULTS[0]}", comments="")
    return path


def test_names_and_channels_of_a_log(log: Path, tmp_path: Path) -> None:
    words = [str(log), "--map", "Speed=n_r"]
    assert worker.offers(silent, words) == ["t", "n_dem", "Speed", f"fault_{FAULTS[0]}"]
    seen = worker.look(silent, words)
    assert seen["signals"]["n_r"][0] == "Speed"
    assert seen["damaged"] is False and seen["ours"]["n_r"] == "%" and isinstance(seen["signals"]["n_r"][5], list)
    got = worker.preview(silent, words)
    assert set(got["channels"]) == {"n_dem", "n_r"} and got["channels"]["n_r"][0] == "%"
    (fault,) = got["faults"]
    t, on = got["faults"][fault]
    assert fault == FAULTS[0] and (on == (t > 10.0)).all()
    none = tmp_path / "none.csv"
    none.write_text("a,b\n1,2\n2,3\n")
    seen = worker.look(silent, [str(none)])
    assert set(seen["open"]) <= {"t"} and seen["signals"] == {} and seen["suggested_rpm"] is None
    with pytest.raises(InputError):
        worker.preview(silent, [str(tmp_path / "absent.csv")])


def test_a_whole_command_is_run_in_the_worker(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[Any] = []

    def main(words: list[str]) -> int:
        assert worker.sys.argv == ["vaneloop", *words]
        print("said")
        print("vaneloop: first\nvaneloop: a complaint", file=worker.sys.stderr)
        if words[0] == "exits":
            raise SystemExit(int(words[1]) or None)
        return int(words[1])

    monkeypatch.setattr(worker, "main", main)
    for code in (0, 1, 3):
        assert worker.command(lambda *a: told.append(a), ["run", str(code)]) == {"code": code, "text": "said\n"}
    assert worker.command(silent, ["exits", "0"]) == {"code": 0, "text": "said\n"} and told[0] == (None, "vaneloop run")
    for words in (["run", "2"], ["exits", "2"], ["run", str(terminal.DEFECT)]):
        with pytest.raises(InputError, match="^a complaint$"):
            worker.command(silent, words)
    monkeypatch.setattr(worker, "main", lambda words: 2)
    with pytest.raises(InputError, match="^bad input$"):
        worker.command(silent, ["run"])


def test_a_part_of_an_engine_is_read_by_what_it_says(tmp_path: Path) -> None:
    files = files_of(None)
    assert worker.engine_part(silent, str(files["geometry"]))[0] == "geometry"
    assert worker.engine_part(silent, str(files["schedules"]))[0] == "schedules"
    for text, says in (("[crank]\nx = 1\n", "crank"), ("[speed]\nvalues = 1\n", "speed"),
                       ("[vigv]\nspeed = 1\n", r"allowed here: lb, lb_initial")):  # fmt: skip
        path = tmp_path / "part.toml"
        path.write_text(text)
        with pytest.raises(InputError, match=says):
            worker.engine_part(silent, str(path))


def test_the_steps_of_a_schedule(tmp_path: Path) -> None:
    files = files_of(None)
    words = ["--geometry", str(files["geometry"]), "--schedules", str(files["schedules"]), "--lb-range", "0.5",
             "--lc-range", "0.5"]  # fmt: skip
    drawn = worker.schedule_step(silent, "mechanism", words, "", "")
    strokes = np.array(drawn["strokes"])
    assert len(strokes) == 97 and (strokes[0], strokes[-1]) == worker.STROKE_LIMITS
    geometry, schedules = load_geometry(files["geometry"]), load_schedules(files["schedules"])
    angles = np.rad2deg(worker.vane_angles(strokes * 1e-3, geometry))
    for k, s in enumerate(drawn["stages"]):
        assert s["key"] == geometry.vanes[k] and s["angles"] == angles[:, k].tolist()
        assert s["name"] == worker.NAMES[s["key"]] and s["radius"] == geometry.stage(s["key"]).ld.value
        p = list(worker.plane_joints(geometry, s["key"], strokes[5] * 1e-3).values())
        assert s["joints"][5] == [[round(q.real * 1e3, 3), round(q.imag * 1e3, 3)] for q in p]
    got = worker.schedule_step(silent, "stroke", words, "", "")
    speed = worker.table_speeds(schedules)
    assert (got["speed"] == speed).all() and np.array_equal(
        got["table"], worker.stroke_tables(geometry, schedules, speed)
    )
    told: list[Any] = []
    result = worker.schedule_step(lambda *a: told.append(a), "links", words, "", "")
    assert told[0] == (None, "reading") and {t[1] for t in told[1:]} == {"scheduling"} and len(result.links) > 1
    out = worker.schedule_step(silent, "tables", words, str(tmp_path / "t"), "a command")
    assert Path(out["files"][-1]).name == "schedule.html" and all(Path(f).is_file() for f in out["files"])
    assert "a command" in Path(out["files"][-1]).read_text() and np.array_equal(out["result"].speed, result.speed)


def test_a_comparison_and_its_refits(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of stand-ins for what is held: what is handed on, and what is told on the way."""
    from tests.test_page_outlines import TESTED, by_log, diagnosis, fit_of, stage

    s = stage()
    floor = np.array([0.05, 0.2])
    located = locate(LeastSquaresProblem(s, floor), fit_of(s, (1.02, 0.0, 0.0)))
    answer = SimpleNamespace(located=[located], sentence=lambda: "It fails.", by_log=None, tested=[])
    d, bound = diagnosis()
    bound.notes = ["a note"]
    ticks: list[Any] = []

    class It:
        bound = SimpleNamespace(stages=[s], not_observed={"servo": "why"}, notes=["a note"])

        def stage(self, name: str) -> Any:
            return {x.name: x for x in self.bound.stages}[name]

        def compared(self, progress: Any) -> Any:
            progress(0.5)
            return answer

        def diagnosed(self, news: Any) -> Any:
            news(SimpleNamespace(found=None, fraction=0.2, text="at it"))
            for x in d.stages:
                news(SimpleNamespace(found=x, fraction=0.5, text="more"))
            return SimpleNamespace(
                diagnosis=d, to_dict=lambda: {"a": 1}, sentence=lambda: "So.", by_log=None, tested=TESTED
            )

        def extended(self, at: Any, effects: Any, tick: Any) -> Any:
            for _ in range(20):
                tick()
            return SimpleNamespace(floor=floor, base=fit_of(s, (1.02, 0.0, 0.0)), final=fit_of(s, (1.02, 0.5, 0.0)))

    monkeypatch.setattr(worker, "held", lambda args, say: say("reading") or ticks.append(args.log) or It())
    monkeypatch.setattr(worker, "_HELD", {})
    told: list[Any] = []

    def progress(*a: Any) -> None:
        told.append(a)

    words = [str(log)]
    c = worker.compare(progress, words)
    assert told == [(None, "reading"), (0.1, "comparing"), (pytest.approx(0.55), "comparing"), (1.0, "")]
    assert c["verdict"] == "It fails." and c["notes"] == ["a note"] and c["windows"] == {"actuator": None}
    assert c["apart"] is None and c["not_observed"] == {"servo": "why"} and c["located"] == {"actuator": located}
    assert [f.signal for f in c["figures"]] == ["x_lvdt", "speed"] and c["tone"] == worker.located_tone([located])
    curves = c["curves"]["actuator"]["outputs"]["x_lvdt"]
    assert curves["unit"] == "mm" and curves["floor"] == 0.05 and np.isnan(curves["measured"][200:220]).all()
    model = s.run(np.array([[1.02, 0.0, 0.0]]))
    left = curves["errors"]["nominal model"]
    np.testing.assert_allclose(np.abs(left), np.abs(s.measured[0] - model[0, 0]), atol=1e-12)
    worker.compare(progress, words)
    worker.compare(progress, [*words, "--no-guess"])
    assert ticks == [str(log)] * 2 and len(worker._HELD) == 1
    told.clear()
    got = worker.diagnose(progress, [*words, "--no-guess"])
    assert told[:2] == [(0.0, "searching the library of effects"), (0.2, "at it")]
    assert [t[1]["found"] for t in told[2::2]] == [
        "actuator missing grip and more, 12 → 1.04 noise floors", "engine unknown", "linkage fits",
    ]  # fmt: skip
    assert (
        got["verdict"] == "So."
        and got["json"] == {"a": 1}
        and got["diagnosis"] is d
        and got["apart"][0] == worker.APART
    )
    told.clear()
    more = worker.refit(progress, [*words, "--no-guess"], "actuator", ("grip",))
    assert [f for f, _ in told] == [pytest.approx(min(0.97, k / 3.0)) for k in range(1, 22)]
    assert {t for _, t in told} == {"fitting grip"} and set(more["bounds"]) == {"grip"}
    assert set(more["curves"]["outputs"]["speed"]["errors"]) == {"nominal model", "with effects"}
    told.clear()
    none = worker.refit(progress, [*words, "--no-guess"], "actuator", ())
    assert told[0] == (0.5, "fitting the nominal model") and set(none["curves"]["outputs"]["speed"]["errors"]) == {
        "nominal model"
    }
    theta = np.array([1.02, 0.0, 0.0])
    hand = worker.hand(silent, [*words, "--no-guess"], "actuator", theta, floor, {"grip": {"size": 9.0}})
    top = worker.hand(silent, [*words, "--no-guess"], "actuator", theta, floor, {"grip": {"size": 2.0}, "more": {}})
    assert hand["rms"] == top["rms"] and theta[1] == 0.0
    e = top["curves"]["outputs"]["x_lvdt"]["errors"]["by hand"]
    assert top["rms"]["x_lvdt"] == pytest.approx(np.sqrt(np.nanmean(e**2)))
    below = worker.hand(silent, [*words, "--no-guess"], "actuator", theta, floor, {"grip": {"size": -9.0}})
    assert below["rms"]["x_lvdt"] == pytest.approx(np.sqrt(np.nanmean(left**2)))
    many = by_log()
    title, *table = worker.apart(SimpleNamespace(by_log=many, tested=[]))  # type: ignore[misc, arg-type]
    assert title == "RMS error, log by log" and tuple(table) == worker.errors_by_log(many)
    one = by_log(laws=False, test=False)
    assert worker.apart(SimpleNamespace(by_log=one, tested=TESTED)) is None  # type: ignore[arg-type]


def test_what_a_fleet_s_run_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Folder:
        damaged: dict[str, str] = {}  # noqa: RUF012

        def __init__(self, run: str):
            self.run, self.of_campaign = run, run == "campaign"

    monkeypatch.setattr(worker, "Folder", Folder)
    monkeypatch.setattr(worker, "state_of", lambda f: SimpleNamespace(json=lambda: {"done": 3, "run": f.run}))
    monkeypatch.setattr(worker, "roll_up", lambda f: f.run)
    monkeypatch.setattr(worker, "view_of", lambda db, limits, run, damaged: (db, limits, run, damaged))
    monkeypatch.setattr(worker, "fleet_page", lambda view, logs: (view, logs))
    monkeypatch.setattr(worker, "answers", lambda f, keys: {"k": f.run} if keys == ["k"] else {})
    monkeypatch.setattr(worker, "log_page", lambda key, found: SimpleNamespace(html=lambda: f"{key} {found}"))
    assert worker.fleet_state(silent, "r") == {"done": 3, "run": "r", "campaign": False}
    assert worker.fleet_report(silent, "r", "logs") == (("r", {}, "r", {}), "logs")
    assert worker.fleet_report(silent, "campaign", "logs") is None
    assert worker.fleet_log(silent, "r", "k") == "k r"
    with pytest.raises(InputError, match="^r: has no answer to x$"):
        worker.fleet_log(silent, "r", "x")


def test_what_a_log_will_need_is_loaded_before_there_is_one(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[Any] = []
    monkeypatch.setattr(worker, "warm_up", lambda say: say("compiling"))
    monkeypatch.setattr(worker, "tell_search", lambda say: say("compiling the search"))
    bound: list[Any] = []
    machine = SimpleNamespace(bind=lambda log: bound.append(log) or SimpleNamespace(stages=["a stage"]))
    monkeypatch.setattr(worker, "Machine", lambda: machine)
    monkeypatch.setattr(worker, "locate_stages", told.append)
    run = SimpleNamespace(t=np.arange(3.0), columns={"n_dem": np.ones(3), "t": np.arange(3.0), "odd": np.ones(3)})
    asked: list[Any] = []
    monkeypatch.setattr(worker, "lockstep", lambda stimulus, seed: asked.append((stimulus.rows.shape[0], seed)) or run)
    worker.ready(lambda *a: told.append(a))
    assert told == [(None, "compiling"), (None, "compiling the search"), ["a stage"]] and asked == [(2000, 1)]
    assert list(bound[0].channels) == ["n_dem"]
    said: list[str] = []
    monkeypatch.setattr(held, "warm_up", lambda say: say("compiling"))
    monkeypatch.setattr(held, "tell_search", lambda say: say("the search"))
    monkeypatch.setattr(held, "_OfMachine", lambda args: ("of a machine", args))
    monkeypatch.setattr(held, "_OfSystem", lambda args, system: ("of", system))
    monkeypatch.setattr(held, "load_system", lambda path: path)
    monkeypatch.setattr(held.own_model, "asked", lambda args: bool(args.system))
    args = SimpleNamespace(system=None)
    assert held.held(args, said.append) == ("of a machine", args)  # type: ignore[arg-type, comparison-overlap]
    assert said == ["compiling", "reading the log", "the search"]
    said.clear()
    args.system = "own.py"
    assert held.held(args, said.append) == ("of", "own.py")  # type: ignore[arg-type, comparison-overlap]
    assert said == ["reading the log, fitting the model to it"]


# ---- the server ------------------------------------------------------------------------------------------------------


class Asked:
    """A browser without a window: it keeps its cookies, and goes to pages."""

    def __init__(self, app: Any, port: int):
        there = f"127.0.0.1:{port}"
        self.client = httpx.AsyncClient(
            transport=httpx.ASGITransport(app=app), base_url=f"http://{there}", headers={"accept": "text/html"}
        )

    async def get(self, path: str) -> Any:
        return await self.client.get(path)


def serving(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, visit: Callable[[Any, SimpleNamespace], Any], loopback: bool = True
) -> SimpleNamespace:
    """Serve a folder; ``visit`` it instead of waiting for Ctrl-C. What the server made."""

    seen = SimpleNamespace(words=[], config=None, spare=[], sessions=None, over=False, options={})

    class Stub:
        def __init__(self, config: Any):
            seen.config, self.config = config, SimpleNamespace(loaded_app=None)

        async def startup(self, sockets: Any = None) -> None:
            seen.sockets = sockets

        def run(self, sockets: Any) -> None:
            async def go() -> None:
                app = self_app(seen.config)
                async with app.router.lifespan_context(app):
                    await self.startup(sockets)
                    await visit(Asked(seen.config.app, seen.port), seen)

            asyncio.run(go())
            raise KeyboardInterrupt

    def self_app(config: Any) -> Any:
        inner = config.app.app
        return getattr(inner, "app", inner) if type(inner).__name__ == "Lasting" else inner

    class Spared:
        def refill(self) -> None:
            seen.spare.append("refill")

        def close(self) -> None:
            seen.spare.append("close")

    class Kept(server.Sessions):
        def __init__(self, make: Any):
            super().__init__(make)
            seen.sessions = self

        def close(self) -> None:
            seen.closed = list(self.of.values()) or getattr(seen, "closed", [])
            super().close()

    def config(app: Any, **more: Any) -> Any:
        seen.options = more
        return SimpleNamespace(app=app, **more)

    monkeypatch.setattr(server.uvicorn, "Server", Stub)
    monkeypatch.setattr(server.uvicorn, "Config", config)
    monkeypatch.setattr(server, "Spare", Spared)
    monkeypatch.setattr(server, "Sessions", Kept)
    monkeypatch.setattr(private.tempfile, "tempdir", str(tmp_path / "temporary"))
    monkeypatch.setattr(Worker, "start", lambda worker: None)
    monkeypatch.setattr(server.missing, "WARM", 1e9)
    (tmp_path / "temporary").mkdir(exist_ok=True)
    folder = tmp_path / "served"
    folder.mkdir(exist_ok=True)
    (folder / "a.csv").write_text("t,n_dem\n0,1\n")
    (folder / "mine.py").write_text("system = System('a')\n")
    sock = socket.create_server(("127.0.0.1", 0))
    seen.port = sock.getsockname()[1]
    loggers = {n: logging.getLogger(n) for n in ("nicegui", "asyncio", "uvicorn.error")}
    before = {n: (x.handlers, x.propagate) for n, x in loggers.items()}
    try:
        with nicegui_reset_globals():
            try:
                server.serve(sock, folder, "t" * 20, 1000, loopback, seen.words.append, None, None)
            finally:
                Client.page_routes.clear()  # else the modules of the pages are forgotten, and imported anew
    finally:
        sock.close()
        for n, (handlers, propagate) in before.items():
            loggers[n].handlers, loggers[n].propagate = handlers, propagate
    assert seen.spare == ["refill", "close"] and seen.sockets == [sock]
    return seen


def test_pages_curves_and_saved_files_are_given_to_their_session(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def visit(asked: Asked, seen: SimpleNamespace) -> None:
        assert (await asked.get("/")).status_code == 403
        entered = await asked.get(f"/?token={seen.words[0]}")
        assert entered.status_code == 303
        assert [(await asked.get(p)).status_code for p in ("/curves/x", "/saved/x", "/fleet_logs/x")] == [404] * 3
        for path, title in (("/", "missing physics"), ("/schedule", "schedule"), ("/run", "run"), ("/fleet", "fleet")):
            page = await asked.get(path)
            assert page.status_code == 200 and f"<title>VaneLoop: {title}</title>" in page.text
            assert page.headers["x-frame-options"] == "DENY"
        (session,) = seen.sessions.of.values()
        assert session.takes_code is True and session.extra["served"] == tmp_path / "served"
        assert [f.name for f in session.files if not f.name.startswith("example")] == ["a.csv"]
        assert [f.name for f in session.models if not f.name.startswith("example")] == ["mine.py"]
        t = np.arange(1000.0)
        session.curves["x"] = Curves([Panel("a", "mm", t, [Trace("y", t)])], "k")
        for query, n in (("", 1000), ("?from=10&to=20", 12), ("?n=100", 200), ("?n=-5", 200), ("?n=1e9", 1000)):
            got = await asked.get(f"/curves/x{query}")
            head, _ = unpacked_view(got.content)
            assert head["panels"][0]["n"] == n and got.headers["cache-control"] == "no-store"
            assert got.headers["content-type"] == "application/octet-stream"
        for bad in ("from=x", "to=inf", "n=nan", "from=-inf"):
            got = await asked.get(f"/curves/x?{bad}")
            assert (got.status_code, got.text) == (422, "from, to and n must be numbers")
        assert unpacked_view((await asked.get("/curves/nothing")).content)[0]["panels"] == []
        saved = session.folder / "report.html"
        session.saved["report"] = saved
        assert (await asked.get("/saved/report")).status_code == 404
        saved.write_text("the report")
        got = await asked.get("/saved/report")
        assert got.text == "the report" and 'filename="report.html"' in got.headers["content-disposition"]
        assert (await asked.get("/saved/other")).text == "nothing saved"

        class Fleet:
            async def log(self, name: str) -> str | None:
                return "<p>a log" if name == "k.html" else None

        session.extra["fleet"] = Fleet()
        got = await asked.get("/fleet_logs/k.html")
        assert got.text == "<p>a log" and got.headers["cache-control"] == "no-store"
        assert (await asked.get("/fleet_logs/x")).text == "no such log in the run that is looked at"
        session.errors["page"] = "old"
        monkeypatch.setattr(server.schedule, "build", None)
        assert (await asked.get("/")).status_code == 200 and "page" not in session.errors
        style = await asked.get("/assets/uPlot.css")
        assert style.status_code == 200 and "uplot" in style.text
        assert style.headers.get("content-encoding") is None
        monkeypatch.setattr(server, "MOST_SESSIONS", 0)
        seen.sessions.of.clear()
        full = await asked.get("/")
        assert full.status_code == 429 and full.text.startswith("6 browsers are at work here")
        seen.sessions.of["1"] = session
        assert "after 60 s its place is free" in full.text and server.RECONNECT == 60.0

    seen = serving(tmp_path, monkeypatch, visit)
    assert len(seen.words) == 1 and seen.options["http"] == "h11" and seen.options["ws_max_size"] == 4 << 20
    assert seen.options["timeout_graceful_shutdown"] == 2 and seen.options["ws_per_message_deflate"] is False
    assert not list((tmp_path / "temporary").iterdir())


def test_a_page_that_cannot_be_made_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def build(session: Any, most: int) -> None:
        assert most == 1000
        raise ValueError("no page")

    monkeypatch.setattr(server.fleet, "build", build)
    monkeypatch.setattr(terminal, "defect", lambda e: f"a defect: {e}")

    async def visit(asked: Asked, seen: SimpleNamespace) -> None:
        assert (await asked.get(f"/?token={'t' * 20}")).status_code == 303
        got = await asked.get("/fleet")
        assert got.status_code == 500 and got.text.startswith("This page could not be made")
        (session,) = seen.sessions.of.values()
        assert session.takes_code is False

    seen = serving(tmp_path, monkeypatch, visit, loopback=False)
    assert seen.options["ws_per_message_deflate"] is True and capsys.readouterr().err == "vaneloop: a defect: no page\n"


def test_what_libraries_log_is_a_line(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(terminal, "defect", lambda e: f"a defect: {e}")
    plain = Plain(logging.WARNING)

    def say(text: str, error: BaseException | None = None) -> str:
        info = None if error is None else (type(error), error, None)
        plain.emit(logging.LogRecord("x", 30, "f", 1, text, None, info))
        return capsys.readouterr().err

    assert say("two\n  lines ") == "vaneloop: two lines\n" and say("x", ValueError("y")) == "vaneloop: a defect: y\n"
    assert say("x", asyncio.CancelledError()) == "" and say("x", Cancelled()) == ""


def test_logs_and_models_that_are_offered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, text in (("b.csv", ""), ("a.MF4", ""), ("no.txt", ""), ("m.py", "System("), ("n.py", "nothing")):
        (tmp_path / name).write_text(text)
    (tmp_path / "folder.csv").mkdir()
    (tmp_path / "late.py").write_text(" " * (1 << 20) + "System(")
    (tmp_path / "just.py").write_text(" " * ((1 << 20) - 7) + "System(")
    own = [f for f in server.logs_in(tmp_path) if not f.name.startswith("example: ")]
    assert [(f.name, f.word, f.path) for f in own] == [(n, n, tmp_path / n) for n in ("a.MF4", "b.csv")]
    examples = [f for f in server.logs_in(tmp_path) if f.name.startswith("example: ")]
    assert examples and all(f.path.name == f.name[9:] and (tmp_path / f.word).resolve() == f.path for f in examples)
    models = server.models_in(tmp_path)
    assert [f.name for f in models if not f.shipped] == ["just.py", "m.py"] and models[0].shipped
    assert all(f.name == f"example: {f.path.name}" for f in models if f.shipped)
    assert server.logs_in(tmp_path / "absent")[0].name.startswith("example: ")
    for k in range(501):
        (tmp_path / f"c{k:03d}.csv").write_text("")
    own = [f.name for f in server.logs_in(tmp_path) if not f.name.startswith("example: ")]
    assert len(own) == 500 and own[-1] == "c497.csv"
    for k in range(501):
        (tmp_path / f"A{k:03d}.py").write_text("System(")
    assert len([f for f in server.models_in(tmp_path) if not f.shipped]) == 500
