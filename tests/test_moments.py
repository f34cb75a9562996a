"""What happened when, in a log and in the live loop; and what a page's session does while its work goes on or fails."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from controller import FAULTS, MODES
from hil.inject.scenario import library, load_scenario
from vaneloop.web import loop, moments
from vaneloop.web.charts import Mark
from vaneloop.web.jobs import Cancelled, Worker, WorkError
from vaneloop.web.loop import COLUMNS
from vaneloop.web.process import Inbox
from vaneloop.web.running import ANY, MOST, Loop
from vaneloop.web.session import LogFile, Session

STALE = 1 << FAULTS.index("demand_stale")


def rows_of(t: np.ndarray, state: Any, faults: Any) -> np.ndarray:
    """Rows as the loop's process sends them."""
    rows = np.full((len(t), len(COLUMNS)), np.nan)
    for name, values in (("t", t), ("state", state), ("faults", faults)):
        rows[:, COLUMNS.index(name)] = values
    return rows


def news(rows: np.ndarray, **more: Any) -> dict[str, Any]:
    return {"rows": rows, "trace": [], "frames": 0, "refused": 0, **more}


def live(tmp_path: Path) -> Loop:
    lp = Loop(Session("x", tmp_path / "0123456789abcdef", []))
    lp.rows = np.empty((36_000, len(COLUMNS)))
    return lp


# ---- a log, and the loop ---------------------------------------------------------------------------------------------


def test_a_log_s_moments_are_its_modes_its_faults_and_what_was_injected() -> None:
    t = np.arange(10.0)
    state = np.array([2, 2, 2, 3, 4, 4, 2, np.nan, 2, 2])
    faults = {"demand_stale": (t, (t >= 3) & (t < 6))}
    found = moments.of_log({"state": ("-", t, state)}, faults, [Mark(2.5, "demand_stops")])
    assert [m.line for m in found] == [
        "0.00 s  mode RUN", "2.50 s  injected: demand_stops", "3.00 s  mode DEGRADED", "3.00 s  demand_stale set",
        "4.00 s  mode FAIL_SAFE", "6.00 s  mode RUN", "6.00 s  demand_stale cleared", "8.00 s  mode RUN",
    ]  # fmt: skip
    assert [(b.start, b.end, b.text) for b in moments.fault_bands(faults)] == [(3.0, 6.0, "demand_stale")]
    both = moments.bit_bands(t, np.where(t < 2, 0.0, 3.0))
    assert [(b.start, b.end, b.text) for b in both] == [(2.0, 9.0, f"{FAULTS[0]}, {FAULTS[1]}")]


@pytest.fixture
def inbox(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing that another test told a loop of this process, and that ended before it heard, is heard by this one."""
    monkeypatch.setattr(loop, "INBOX", Inbox())


def test_what_is_injected_in_lockstep_is_marked_at_the_tick_at_which_it_begins(inbox: None) -> None:
    told: list[dict[str, Any]] = []

    def progress(share: float | None, content: Any) -> None:
        if isinstance(content, dict) and "rows" in content:
            told.append(content)
            if len(told) == 1:
                loop.INBOX.put(0, {"inject": "demand_stops"})
            if any(c["injected"] for c in told) and told[-1]["rows"][-1, 0] > began() + 1.0:
                loop.INBOX.put(0, {"stop": True})

    def began() -> float:
        ((t, name),) = [x for c in told for x in c["injected"]]
        assert name == "demand_stops"
        return float(t)

    loop.lockstep(progress, 70.0, 0.0, None, 1, None)
    rows = np.concatenate([c["rows"] for c in told])
    faults = np.nan_to_num(rows[:, COLUMNS.index("faults")]).astype(int)
    stale = float(rows[np.flatnonzero(faults & STALE)[0], 0])
    assert 0.04 < stale - began() < 0.08  # five frames are missed first


def test_what_is_told_too_late_is_not_heard_by_the_next_run(inbox: None) -> None:
    news = {1: 0, 2: 0}

    def run(task: int, ends_at: int) -> None:
        def progress(share: float | None, content: Any) -> None:
            if isinstance(content, dict) and "rows" in content:
                news[task] += 1
                if news[task] == ends_at:
                    loop.INBOX.put(task, {"stop": True})

        loop.INBOX.begin(task)
        loop.lockstep(progress, 70.0, 0.0, None, 1, None)

    run(1, 1)
    loop.INBOX.put(1, {"stop": True})
    loop.INBOX.put(1, {"demand": 90.0})
    run(2, 3)
    assert news[2] >= 3
    assert loop.INBOX.take() is None


def test_the_server_tells_the_task_that_runs_and_none_where_none_does() -> None:
    sent: list[Any] = []
    w = Worker()
    w._connection = SimpleNamespace(send=sent.append)  # type: ignore[assignment]
    w.tell(stop=True)
    w.jobs = dict.fromkeys((7, 8))  # type: ignore[assignment]
    w.tell(stop=True)
    assert sent == [(7, "tell", {"stop": True})]


def test_a_run_in_real_time_that_fails_hears_nothing_any_more(inbox: None, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: Any, **__: Any) -> None:
        raise OSError("the bus is gone")

    monkeypatch.setattr(loop, "open_bus", lambda *_, **__: SimpleNamespace(read_rows=None, shutdown=lambda: None))
    monkeypatch.setattr(loop, "run_realtime", fails)
    before = set(threading.enumerate())
    with pytest.raises(OSError, match="gone"):
        loop._in_real_time(lambda *_: None, "local", SimpleNamespace(tick=lambda *_: None), None, None)
    assert set(threading.enumerate()) == before
    loop.INBOX.put(0, {"stop": True})
    assert loop.INBOX.take() == {"stop": True}


def test_what_an_outsider_does_is_marked_when_its_first_action_begins(monkeypatch: pytest.MonkeyPatch) -> None:
    from hil.inject.scenario import load_scenario

    name = "flood_low_priority"
    scenario = load_scenario(name)
    first = min(a.start for a in scenario.inject)
    assert first > 0.0
    seen: list[float] = []
    told: list[tuple[float, float]] = []

    def run(made: Any, *, bus: str, name: str, progress: Callable[[float], None]) -> Any:
        for t in np.arange(0.0, scenario.duration, 0.1):
            seen.append(float(t))
            progress(float(t) / scenario.duration)
        return type("Outcome", (), {"held": True})

    def progress(fraction: float | None, text: Any) -> None:
        if isinstance(text, dict):
            told.append((text["at"], seen[-1]))

    monkeypatch.setattr(loop, "run", run)
    before = time.perf_counter()
    assert loop.outside(progress, name, "local:x")
    ((at, t),) = told
    assert before <= at <= time.perf_counter() and first <= t < first + 0.11


def test_the_loop_notes_what_was_injected_and_the_record_keeps_it(tmp_path: Path) -> None:
    lp = live(tmp_path)
    lp._news(news(rows_of(0.01 + np.arange(0.0, 2.0, 0.01), 2.0, 0.0), injected=[(1.51, "demand_stops")]))
    assert [m.line.partition(":")[0] for m in lp.events] == ["1.51 s  injected", "0.01 s  mode RUN"]
    (lp.session.folder / "run0.log").write_text("x")
    lp._ended("run0.log")
    assert lp.recorded is not None and lp.recorded.marks == ((1.5, "demand_stops"),)


def test_the_charts_stop_at_the_fault_or_mode_asked_for_and_at_a_moment_pressed(tmp_path: Path) -> None:
    lp = live(tmp_path)
    t = np.arange(0.0, 60.0, 0.1)
    tracking = 1 << FAULTS.index("tracking")
    faults = np.where(t >= 20.0, STALE, 0) | np.where(t >= 30.0, tracking, 0)
    for lp.trigger, held in (("", None), (ANY, 20.0), ("tracking", 30.0), ("mode DEGRADED", 40.0)):
        lp.last, lp.held, lp.filled = (-1, 0), None, 0
        lp._news(news(rows_of(t, np.where(t >= 40.0, 3.0, 2.0), faults)))
        assert lp.held == (None if held is None else pytest.approx(held))
    assert lp.session.curves["run"].panels[0].t[-1] == pytest.approx(43.0, abs=0.11)
    lp.show(10.0)
    assert lp.session.curves["run"].panels[0].t[-1] == pytest.approx(13.0, abs=0.11)
    lp.go_on()
    assert lp.session.curves["run"].panels[0].t[-1] == pytest.approx(59.9)


def test_a_long_run_keeps_no_more_than_a_page_shows(tmp_path: Path) -> None:
    lp = live(tmp_path)
    for k in range(3 * MOST):
        lp._news(news(rows_of(np.array([float(k)]), 2.0 + k % 2, STALE * (k % 2)), injected=[(k, "demand_stops")]))
    assert len(lp.events) == len(lp.injected) == MOST


def test_scenarios_that_are_over_leave_the_loop() -> None:
    from hil.bus.lockstep_bus import Channel
    from hil.loop.node import Ecu, Node

    channel = Channel(seed=0)
    places = {"ECU": channel.join(), "VGV": channel.join()}
    injected = loop._Injected(Node(), Ecu(), channel, places)
    parts = lambda: [*injected.machines, *injected.disturbers, *(g for w in injected.gateways.values() for g in w)]  # noqa: E731
    for name in (n for n in library() if n != "nominal" and not load_scenario(n).secoc):
        with_end = len(parts()) + len(injected.intruders)
        injected.add(name, 1)
        assert len(parts()) + len(injected.intruders) > with_end, name
        assert injected.news() == [(0.001, name)] and injected.news() == []
    injected.tidy(10**9)
    ends = [p.end if hasattr(p, "end") else max(e for _, e in p.span) for p in parts()]
    assert all(end == np.inf for end in ends), ends


# ---- the session -----------------------------------------------------------------------------------------------------


class Fake:
    """A worker whose answers the test gives: name of the task -> an answer, or what is raised."""

    def __init__(self, **answers: Any):
        self.answers, self.asked, self.jobs = answers, list[str](), dict[int, Any]()

    async def call(self, name: str, text: str, **given: Any) -> Any:
        self.asked.append(name)
        answer = self.answers[name]
        if callable(answer):
            answer = answer(**given)
        if isinstance(answer, BaseException):
            raise answer
        return answer

    def stop(self) -> None:
        """Nothing to end."""


def with_log(tmp_path: Path, **answers: Any) -> Session:
    s = Session("x", tmp_path / "0123456789abcdef", [])
    s.choice.file = LogFile(tmp_path / "run.csv", "run.csv", "run.csv")
    s.search, s.bench, s.aside = (Fake(**answers) for _ in range(3))  # type: ignore[assignment]
    return s


def after(s: Session, *do: Callable[[], Any]) -> None:
    """Do these one after the other, and let each end."""

    async def go() -> None:
        for act in do:
            act()
            while s.tasks:
                await asyncio.gather(*s.tasks, return_exceptions=True)

    asyncio.run(go())


@pytest.mark.parametrize("end", [Cancelled("stopped"), WorkError("no")])
def test_nothing_is_said_so_far_once_a_search_has_ended(tmp_path: Path, end: Exception) -> None:
    s = with_log(tmp_path)
    s.compared = {}

    def search(**_: Any) -> Exception:
        s._news({"found": "servo fits"})
        assert s.sofar == ["servo fits"]
        return end

    s.search = Fake(diagnose=search)  # type: ignore[assignment]
    after(s, s.diagnose)
    assert s.sofar == [] and s.errors["diagnose"]


def test_a_file_that_could_not_be_written_anew_is_not_offered(tmp_path: Path) -> None:
    def write(words: list[str]) -> dict[str, Any]:
        Path(words[words.index("--out") + 1]).write_text("[names]\n")
        return {"code": 0}

    s = with_log(tmp_path, command=write)
    after(s, s.save_mapping)
    assert s.saved["mapping"].is_file()
    s.bench = Fake(command=WorkError("no"))  # type: ignore[assignment]
    after(s, s.save_mapping)
    assert "mapping" not in s.saved and s.errors["mapping"] == "no"
    s.saved["report"] = tmp_path / "old.html"
    s.diagnosis, s.search = {"diagnosis": None}, Fake(report=WorkError("no"))  # type: ignore[assignment]
    after(s, s.save_report)
    assert "report" not in s.saved


def test_a_scenario_is_judged_whatever_else_goes_on(tmp_path: Path) -> None:
    s = with_log(tmp_path, judge={"code": 1})
    lp = Loop(s)
    after(s, lambda: lp.judge("demand_stops"))
    assert s.aside.asked == ["judge"] and not s.bench.asked and not s.search.asked  # type: ignore[attr-defined]
    assert [m.line for m in lp.events] == ["demand_stops, by itself: FAIL"]


def test_a_switch_goes_back_where_its_fit_is_stopped(tmp_path: Path) -> None:
    s = with_log(tmp_path, refit=Cancelled("stopped"))
    s.stage, s.chosen = "actuator", {"actuator": ("aero_load",)}
    after(s, lambda: s.switch("aero_load", False))
    assert s.chosen == {"actuator": ("aero_load",)} and s.errors["fit"]


def test_logs_laid_over_stay_when_the_log_is_read_again(tmp_path: Path) -> None:
    t = np.arange(5.0)
    channels = {"n_dem": ("%", t, t)}
    seen = {"offers": [], "look": {}, "compare": WorkError("none")}
    preview = {"notes": [], "channels": channels, "faults": {}}
    s = with_log(tmp_path, **seen, preview=preview, over=preview)
    others = [LogFile(tmp_path / n, n, n) for n in ("a.csv", "b.csv")]

    def names() -> list[str]:
        return [line.name for line in s.curves["log"].panels[0].traces]

    after(s, s.read, *(lambda o=o: s.lay_over(o) for o in others), lambda: s.move(s.overlays[1], 2.0))
    assert names() == ["this log", "a.csv", "b.csv"]
    assert len({line.dash for line in s.curves["log"].panels[0].traces}) == 3
    after(s, s.read)
    assert names() == ["this log", "a.csv", "b.csv"] and s.overlays[1].later == 2.0
    assert np.isnan(s.curves["log"].panels[0].traces[2].y[:2]).all()
    after(s, lambda: s.take_off(s.overlays[0]))
    assert names() == ["this log", "b.csv"]
    s.bench = Fake(over=WorkError("cannot be read"))  # type: ignore[assignment]
    after(s, lambda: s.lay_over(others[0]))
    assert names() == ["this log", "b.csv"] and s.errors["over"] == "cannot be read"


def test_a_log_of_the_bus_is_read_with_its_faults(tmp_path: Path) -> None:
    from vaneloop.web import worker

    t = np.arange(0.0, 3.0, 0.01)
    table = np.column_stack([t, 70.0 + t, 10.0 + t, np.where(t < 1, 2, 3), t >= 1.0])
    path = tmp_path / "run.csv"
    np.savetxt(path, table, delimiter=",", header="t,n_dem,x_lvdt,state,fault_tracking", comments="", fmt="%.6g")
    seen = worker.preview(lambda share, text: None, [str(path)])
    assert set(seen["channels"]) == {"n_dem", "x_lvdt", "state"} and set(seen["faults"]) == {"tracking"}
    said = [m.line for m in moments.of_log(seen["channels"], seen["faults"], [])]
    assert said == [f"0.00 s  mode {MODES[2]}", f"1.00 s  mode {MODES[3]}", "1.00 s  tracking set"]
