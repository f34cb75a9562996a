"""The pages of the workbench without a browser: what stands on them, what a user does, and what comes of it, held
against the texts that were approved (`tests/workbench_page.py`). What workers answer is made by hand.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("nicegui")

from nicegui import ui

from controller import FAULTS
from hil.bus import frames
from hil.figures import SignalError
from tests.page_outline import approve
from tests.test_page_outlines import diagnosis, fit_of, learned, said_of, stage, surface
from tests.test_page_outlines import fleet as view
from tests.test_page_outlines import stage as made
from tests.workbench_page import HELD, Clock, Opened, Transcript, answering, in_a_loop
from vaneloop.identification.least_squares.problem import LeastSquaresProblem
from vaneloop.identification.regimes import locate
from vaneloop.identification.subsystem import Parameter
from vaneloop.pages.fleet import fleet_page
from vaneloop.web import fleet, missing, run, running, schedule
from vaneloop.web.choice import LogFile
from vaneloop.web.jobs import COLUMNS, Cancelled, Job, WorkError
from vaneloop.web.moments import Moment
from vaneloop.web.session import Session
from vaneloop.web.worker import APART, curves_of

FLOOR = np.array([0.05, 0.2])


@pytest.fixture
def session(tmp_path: Path) -> Iterator[Session]:
    """A session with three logs and two models that may be chosen."""
    logs = [LogFile(tmp_path / n, n, f"logs/{n}", marks, n == "b.csv") for n, marks in (
        ("a.csv", ((1.5, "gust"),)), ("b.csv", ()), ("hidden_effect.parquet", ()))]  # fmt: skip
    models = [LogFile(tmp_path / "own.py", "own.py", "own.py"),
              LogFile(tmp_path / "tank.py", "example: tank.py", "tank.py", shipped=True)]  # fmt: skip
    for f in (*logs, *models):
        f.path.write_text(f"contents of <{f.name}>")
    s = Session("1", tmp_path / "private", logs, models=models)
    s.extra["served"] = tmp_path
    yield s
    s.close()


def located_of(name: str = "actuator", gain: float = 0.0) -> Any:
    """Where a stage fails."""
    s = stage(name)
    return locate(LeastSquaresProblem(s, FLOOR), fit_of(s, (1.02, gain, 0.0)))


def compared() -> dict[str, Any]:
    """The answer of a comparison: a stage that fails from a moment on, one that fits, one that no log can tell of."""
    located = {"actuator": replace(located_of(), onset=31.4), "linkage": located_of("linkage", 0.5)}
    curves = {n: curves_of(LeastSquaresProblem(stage(n), FLOOR), {"nominal model": np.array([1.02, 0.0, 0.0])})
              for n in located}  # fmt: skip
    return {
        "figures": [f for x in located.values() for f in x.signals], "located": located, "verdict": "It fails.",
        "tone": "bad", "curves": curves, "not_observed": {"servo": "no i_cmd"}, "notes": ["a note", "known already"],
        "windows": {"actuator": 12.0, "linkage": None}, "apart": (APART, ["signal", "rms"], [["x_lvdt", 0.123456]]),
    }  # fmt: skip


def diagnosed() -> dict[str, Any]:
    """The answer of a search: effects with rivals, an unknown one, a stage that fits."""
    d, _ = diagnosis()
    unknown = {"stage": "engine", "shape": "grows with time; told already", "nearest_effects": ["c01", "c02"]}
    nothing = {"stage": "other", "shape": "", "nearest_effects": None}
    return {
        "diagnosis": d, "json": {"verdict": "unknown", "unknown": [unknown, nothing]}, "verdict": "So: told already.",
        "apart": None,
    }  # fmt: skip


def refitted(words: list[str], stage: str, effects: tuple[str, ...]) -> dict[str, Any]:
    """The answer of a fit with these effects."""

    s = made(stage)
    d = diagnosis()[0].stages[0]
    found = [f for f in d.effects if f.effect in effects]
    r = said_of(s, "missing", found, fit_of(s, (1.02, 0.5, 0.001), tuple(f.effect for f in found)),
                steps=[("nominal", 12.0), *((f"+ {e}", 3.0 / (k + 1)) for k, e in enumerate(effects))],
                excess=3.0 / (len(effects) + 2))  # fmt: skip
    bounds = {"grip": {"size": Parameter("size", 0.0, "mm", 0.0, 2.0)},
              "more": {"rate": Parameter("rate", 0.0, "mm/s2", -np.inf, np.inf)}}  # fmt: skip
    models = {"nominal model": r.base.theta, "with effects": r.final.theta}
    return {"result": r, "curves": curves_of(LeastSquaresProblem(s, FLOOR), models), "theta": r.final.theta,
            "floor": r.floor, "bounds": bounds}  # fmt: skip


T = np.arange(0.0, 4.0, 0.01)
ON = (T > 1.0) & (T < 2.0)
CHANNELS = {
    "n_dem": ("%", T, 60.0 + 10.0 * (T > 2.0)), "x_lvdt": ("mm", T, 20.0 + np.sin(T)),
    "x_dem": ("mm", T[::2], 20.0 + np.sin(T[::2])), "state": ("-", T, 2.0 + 1.0 * (T > 3.0)),
}  # fmt: skip
SEEN = {
    "signals": {"t": ("time", "s", "as named", 1.0, "", []),
                "n_dem": ("N", "rpm", "guessed", 0.87, "it moves", [1, 3, 2]),
                "x_lvdt": ("x_lvdt", "", "as named", 1.0, "", [])},
    "open": {"i_cmd": "two names could be it"}, "unused": ["one", "two"], "suggested_rpm": 38000.0, "damaged": False,
    "ours": {"n_dem": "%", "x_lvdt": "mm", "i_cmd": "mA"},
}  # fmt: skip
PREVIEW = {
    "notes": ["known already", "N is guessed to be n_dem", "unit of N is guessed to be rpm", "3 rows are out of order"],
    "channels": CHANNELS, "faults": {FAULTS[1]: (T, 1.0 * ON)},
}  # fmt: skip
LEARNED = {"laws": [], "verdict": "none", "sentence": "Nothing was learned.", "notes": ["short log"],
           "nearest": ["outflow of level"]}  # fmt: skip


def writes(*names: str) -> Any:
    """An answer that leaves files where the words of a command say."""

    def written(words: list[str]) -> dict[str, Any]:
        for w in words:
            if Path(w).name in names and Path(w).is_absolute():
                Path(w).write_text("written")
        return {"code": 0, "text": ""}

    return written


def usual() -> dict[str, Any]:
    """What the workers answer."""

    def report(path: str, **_: Any) -> str:
        Path(path).write_text("report")
        return path

    d = LeastSquaresProblem(stage(), FLOOR)
    by_hand = {"curves": curves_of(d, {"by hand": np.array([1.0, 0.1, 0.0])}), "rms": {"x_lvdt": 0.21, "speed": 0.4}}
    plan = {"text": "Move slowly.", "t": np.arange(20.0), "separates": True, "table": [], "heads": [],
            "inputs": {"n_dem": ("%", 50.0 + np.arange(20.0))}}  # fmt: skip
    return {
        "offers": ["N", "x_lvdt", "spare"], "look": SEEN, "preview": PREVIEW, "compare": compared(),
        "whole_loop": ([SignalError("vigv", "linkage", "deg", "measured", 0.51, 0.4, 1.3, 0.6, 0.03, 99)], ""),
        "diagnose": diagnosed(), "refit": refitted, "ahead": refitted, "hand": by_hand, "experiment": plan,
        "report": report, "learn": LEARNED, "command": writes("extended.toml", "extended.html", "mapping.toml"),
        "over": {"channels": {k: v for k, v in CHANNELS.items() if k != "state"}, "notes": [], "faults": {}},
    }  # fmt: skip


class Begun(Transcript):
    """A page of ``build`` with its transcript and its clock; ``answers`` may be changed on the way."""

    def __init__(
        self, monkeypatch: pytest.MonkeyPatch, session: Session, answers: dict[str, Any], build: Any,
        whole: bool = False,
    ):  # fmt: skip
        self.clock = Clock(monkeypatch, "jobs", "frame", "run", "running")
        monkeypatch.setattr("vaneloop.web.frame.OFTEN", 1e9)  # it looks when it is asked to
        self.answers = answers
        asked = answering(monkeypatch, answers)
        super().__init__(
            Opened(session, build), asked, {session.folder: "PRIVATE", session.folder.parent: "FOLDER"}, whole
        )


def test_from_a_log_to_the_missing_effects(monkeypatch: pytest.MonkeyPatch, session: Session) -> None:
    async def go() -> None:
        t = Begun(monkeypatch, session, usual(), missing.build, whole=True)
        opened = t.page
        await t.put(".choose", 0)
        await t.click("Show me the worst moment")
        await t.click("Find the missing physics")
        await t.put(opened.find("more"), False)
        await t.put(opened.find("c00"), True)
        await t.put(opened.find("c00"), False)
        await t.put(opened.find("more"), True)
        await t.fire("grip size", "update:model-value", 0.7)
        await t.click("Back to the fit")
        await t.put(opened.all(ui.toggle)[0], "linkage")
        await t.put(opened.all(ui.toggle)[1], "engine")
        await t.put(opened.all(ui.toggle)[1], "actuator")
        await t.click("Recommend an experiment")
        await t.click("Report")
        await t.click("Extended model")
        await t.click("Learn the law")
        await t.click("light or dark")
        await t.click("Go on with this model")
        approve("web_missing", t.text())

    in_a_loop(go())


def test_names_units_formulas_and_other_logs(monkeypatch: pytest.MonkeyPatch, session: Session) -> None:
    async def go() -> None:
        t = Begun(monkeypatch, session, usual(), missing.build)
        opened = t.page
        await t.click("Open the example")
        await t.put("name of i_cmd in the log", "spare")
        await t.fire("name of i_cmd in the log", "keydown.enter")
        await t.put("unit of n_dem in the log", " 1/min ")
        await t.click("Read again")
        await t.click("Use 38000 rpm")
        await t.put(opened.all(ui.checkbox)[0], False)
        await t.click("Save as mapping file")
        await t.click("Forget all of it")
        await t.put(".formula", "lag = x_dem - x_lvdt [mm]")
        await t.fire(".formula", "keydown.enter")
        await t.put(".formula", "x_dem = x_lvdt")
        await t.click("Add")
        await t.put(".formula", "   ")
        await t.click("Add")
        await t.put(".formula", "none = nobody + 1")
        await t.click("Add")
        await t.put(".formula", "twice = 2 * x_dem")
        await t.click("Add")
        await t.put(".xy-x", "x_dem")
        await t.put(".xy-y", "lag")
        await t.put(".xy-colour", "n_dem")
        chart = next(e for e in opened.all(missing.Chart) if e._props["tree"])
        await t.fire(chart, "cursors", [3.0, 1.0])
        await t.click("save the channels as CSV")
        await t.fire(chart, "cursors", [100.0, 101.0])
        await t.fire(chart, "cursors", [None, 1.0])
        await t.put(".other", 0)
        await t.put("later by [s]", 0.5)
        await t.put(".other", 1)
        await t.click("take a.csv away")
        await t.click("take lag away")
        await t.put(".part-fit", " :2 ")
        await t.fire(".part-fit", "keydown.enter")
        await t.put(".part-test", "2:")
        await t.click("Compare again")
        approve("web_log", t.text())

    in_a_loop(go())


def test_what_is_under_way_what_fails_and_what_is_stopped(monkeypatch: pytest.MonkeyPatch, session: Session) -> None:
    async def go() -> None:
        t = Begun(monkeypatch, session, usual() | {"preview": HELD, "whole_loop": ([], "no vane"),
                  "over": WorkError("no such file")}, missing.build)  # fmt: skip
        opened = t.page
        session.search.loading = "It compiles."
        session.touch("jobs")
        await t.note("loading")
        for name in ("x.dbc", "x.toml", "bench.toml"):
            path = session.folder.parent / name
            path.write_text("a = 1\n[names]\n" if name == "bench.toml" else "a = 1\n")
            session.choose(LogFile(path, name, name))
            await t.note(name)
        await t.put(".choose", 0)
        job = Job(1, "preview", "reading the log", asyncio.get_running_loop().create_future(), started=100.0)
        session.search.jobs[1] = job
        session.touch("jobs")
        await t.note("under way")
        for fraction, now in ((0.0, 100.3), (0.05, 101.9), (0.05, 102.0), (0.25, 104.1), (1.0, 140.0)):
            job.fraction, t.clock.now = fraction, now
            await t.note(f"{fraction} at {now}")
        t.clock.now = 140.5
        await t.note("half a second later")
        t.clock.now = 140.6
        await t.note("a little more")
        await t.click("Cancel", n=0)
        t.answers["preview"] = WorkError(f"{session.files[1].path}: bad, {session.folder}/x")
        await t.put(".choose", 1)
        t.answers["preview"] = {**PREVIEW, "channels": {}, "notes": ["N is guessed to be n_dem"]}
        await t.put(".choose", 2)
        t.answers["preview"] = {**PREVIEW, "notes": [f"note {k}" for k in range(9)]}
        t.answers["compare"] = {**compared(), "located": {}, "not_observed": {}, "apart": None, "tone": "good"}
        await t.put(".choose", 0)
        await t.put(".other", 1)
        t.answers["diagnose"] = HELD
        await t.click("Find the missing physics")
        session._news({"found": "actuator fits"})
        session._news({"found": "engine fits"})
        await t.note("so far")
        session.search.held[-1].set_result({**diagnosed(), "apart": (APART, ["x"], [[1.0]])})  # type: ignore[attr-defined]
        t.answers["refit"] = WorkError("cannot be fitted")
        await t.note("found")
        await t.put(opened.find("c00"), True)
        t.answers |= {"report": Cancelled(), "experiment": WorkError("no run"), "command": WorkError("no model")}
        await t.click("Report")
        await t.click("Recommend an experiment")
        await t.click("Extended model")
        session.stop("diagnose")
        session.errors["page"] = "x"
        monkeypatch.setattr(missing._Page, "_map", lambda page: 1 / 0)
        opened.live.failed()
        await t.note("failed")
        approve("web_fails", t.text())

    in_a_loop(go())


def laws() -> dict[str, Any]:
    """A curve and a surface that were learned."""
    return {
        "laws": [learned(), surface()],
        "verdict": "learned",
        "sentence": "Two laws.",
        "notes": [],
        "nearest": ["x"],
    }


def test_a_model_of_one_s_own(monkeypatch: pytest.MonkeyPatch, session: Session) -> None:
    async def go() -> None:
        answers = usual() | {"look": {**SEEN, "ours": {"u": "V", "y": ""}}}

        def writing(law: str, page: str, **_: Any) -> dict[str, Any]:
            Path(law).write_text("law")
            Path(page).write_text("page")
            return laws()

        answers["learn"] = writing
        t = Begun(monkeypatch, session, answers, missing.build)
        await t.put(".choose", 0)
        for name in ("../x.csv", "mine.PY", "x.dbc", "x", "x.exe"):
            await uploaded(t, name)
        await t.fire(t.page.find(ui.upload), "rejected")
        await t.put(".choose-model", 0)
        await t.click("Leave it")
        await t.put(".choose-model", 0)
        await t.click("Run it")
        await t.put(".choose-model", 1)
        await uploaded(t, "anything.exe")
        session.takes_code = False
        await uploaded(t, "mine.py")
        await t.put(".choose", 0)
        await t.put(".log-also", 1)
        await t.put(".log-test", 2)
        await t.click("leave b.csv out")
        await t.click("Find the missing physics")
        await t.click("Learn the law")
        await t.click("Add the law to the model")
        await t.click("Recommend an experiment")
        await t.put(".choose-model", -1)
        approve("web_own", t.text())

    in_a_loop(go())


# ---- the loop that runs ----------------------------------------------------------------------------------------------


def rows(t: np.ndarray, **more: Any) -> np.ndarray:
    """Rows of the bus: every column moves, and one vane row is not there."""
    out = np.array([(k + 1.0) * np.sin(t + k) for k in range(len(COLUMNS))]).T
    known = {"t": t, "state": 2.0, "faults": 0.0, COLUMNS[9]: np.nan} | more
    for name, value in known.items():
        out[:, COLUMNS.index(name)] = value
    return out


def heard(t: np.ndarray, **more: Any) -> dict[str, Any]:
    """News of a loop that runs."""
    servo = next(i for i, n in frames.NAMES.items() if n == "VGV_SERVO")
    trace = [(float(v), servo | 8 << 32, 0x0807060504030201 + k, {"x": 1.25}) for k, v in enumerate(t[:3])]
    return {"rows": rows(t, **more.pop("columns", {})), "trace": trace, "frames": 12345, "refused": 1, "speed": 0.96,
            "load": 0.234, **more}  # fmt: skip


def number(name: str, **more: Any) -> Any:
    """A number that a calibration tool may change."""
    given = {"border": "mA", "factor": 1e-3, "low": 0.0, "high": 0.04, "fixed": False, "table": "calibration",
             "of_curve": False, "section": "servo", "guarded": False, "meaning": f"what <{name}> is"}  # fmt: skip
    return SimpleNamespace(name=name, **given | more)


ELEMENTS = (number("gain"), number("limit", section="current_limit", guarded=True, border="", factor=1.0),
            number("knee", fixed=True), number("s1", table="stroke_tables", of_curve=True))  # fmt: skip


def test_a_run_in_lockstep(monkeypatch: pytest.MonkeyPatch, session: Session) -> None:
    async def go() -> None:
        t = Begun(monkeypatch, session, {"ready": None, "lockstep": HELD, "judge": {"code": 0, "text": ""}}, run.build,
                  whole=True)  # fmt: skip
        opened, lp = t.page, session.extra["loop"]
        await t.tick()
        await t.click("babbling_idiot")
        await t.put("find a scenario", "IDLE")
        await t.put("find a scenario", None)
        await t.fire("speed demand", "update:model-value", 66.5, n=1)
        await t.put(".profile", "staircase")
        await t.put(opened.find("noisy sensors" if opened.all("noisy sensors") else ui.checkbox), False)
        await t.put(".pace", 3.0)
        await t.click("Start")
        worker = lp.workers["loop"]
        worker.jobs[1] = Job(1, "lockstep", "loading", worker.held[0], started=100.0)
        session.touch("loop-jobs")
        await t.note("loading")
        worker.jobs[1].text = "running"
        first = np.arange(0.01, 1.0, 0.01)
        worker.news(heard(first, columns={"state": np.where(first < 0.5, 0.0, 2.0), "faults": 1.0 * (first > 0.7)}))
        await t.tick("news")
        worker.news({"elements": ELEMENTS})
        await t.note("what may be calibrated")
        await t.put(opened.all(ui.toggle)[0], "standby")
        lp.tuning.answered([(1, "out of range")])
        await t.note("the calibration could not be read")
        await t.click("Read the calibration")
        lp.tuning.pages = np.array([[0.02, 3.0, 1.0, 2.5], [0.02, 4.0, 1.0, 2.5]])
        session.touch("calibrate")
        await t.note("read")
        await t.put(".calibration-group", "current limit")
        await t.put("find a calibration value", "S1")
        await t.put("find a calibration value", "nobody")
        await t.put("find a calibration value", None)
        await t.put("limit [-]", "3.5")
        await t.fire("limit [-]", "blur")
        lp.tuning.answered([(lp.tuning._number, [b"", np.array([3.5]).tobytes()])])
        await t.note("changed")
        await t.put("limit [-]", "3.5")
        await t.fire("limit [-]", "keydown.enter")
        await t.put("page that the firmware uses", 1)
        lp.tuning.answered([(lp.tuning._number, [b"", b""])])
        await t.note("switched")
        await t.put("page that the firmware uses", 0)
        lp.tuning.answered([(lp.tuning._number, "busy")])
        await t.note("not switched")
        await t.click("Copy reference over working")
        lp.tuning.answered([(lp.tuning._number, "no")])
        await t.click("Save the working page")
        (session.folder / "tuned").mkdir()
        (session.folder / "tuned/calibration.toml").write_text("x")
        lp.tuning.answered([(lp.tuning._number, [b"", b""])])
        await t.note("saved")
        await t.put(".pace", 0.0)
        await t.fire("speed demand", "update:model-value", 71.0, n=1)
        await t.put(".trigger", "any fault")
        await t.click("babbling_idiot")
        t.clock.now += 1.6
        later = np.arange(1.0, 60.0, 0.05)
        faults = np.where(later > 20.0, 0b110.__float__(), 0.0)
        worker.news(heard(later, columns={"faults": faults, "state": 3.0}, injected=[(20.0, "babbling_idiot")]))
        await t.tick("a fault")
        for k in range(70):
            lp._tell(Moment(60.0, f"moment {k}"))
        worker.news(heard(np.array([60.0, 60.0, 61.0]), columns={"state": [np.nan, 9.0, 4.0]}))
        await t.tick("more")
        await t.click("Go on")
        await t.put("filter of the trace", "0B")
        await t.tick("filtered")
        await t.put(opened.find("hold" if opened.all("hold") else ui.checkbox, 0), True)
        worker.news(heard(np.array([62.0])))
        await t.tick("held")
        moment = opened.all(".moment")
        await t.click(moment[0])
        await t.click(moment[-1])
        await t.click("Judge babbling_idiot")
        await t.click("Stop")
        (session.folder / "run1.log").write_text("a record")
        worker.held[0].set_result({})
        worker.jobs.clear()
        await t.note("ended")
        assert lp.recorded.marks == ((pytest.approx(20.0 - 0.01), "babbling_idiot"),)
        await t.click("Open in missing physics")
        approve("web_run", t.text())

    in_a_loop(go())


def test_a_run_in_real_time(monkeypatch: pytest.MonkeyPatch, session: Session) -> None:
    async def go() -> None:
        answers = {"ready": None, "listen": HELD, "node": HELD, "ecu": HELD, "outside": True}
        t = Begun(monkeypatch, session, answers, run.build)
        lp = session.extra["loop"]
        await t.put(".bus", "local")
        await t.put(".profile", "slam")
        await t.click("Start")
        for name in ("listen", "node", "ecu"):
            lp.workers[name].jobs[1] = Job(1, name, "running", lp.workers[name].held[0])
        lp.workers["listen"].news(heard(np.arange(0.0, 3.0, 0.01), clock=90.0))
        figures = {"p50_us": 12.3, "p99_us": 45.0, "p999_us": 67.0, "max_us": 890.0, "ticks": 3000}
        lp.workers["node"].news({"late": figures, "histogram": [("< 10", 5), ("< 100", -1)]})
        await t.tick("news")
        await t.tick("nothing new")
        assert lp.clock == 90.0
        await t.click("bit_flips")
        lp.tell(demand=1.0)
        lp._calibrate(3, [b"x"])
        await t.click("Stop")
        for name, answer in (("listen", {}), ("ecu", {}), ("node", {"late": {**figures, "ticks": 3100}})):
            lp.workers[name].held[0].set_result(answer)
        await t.note("ended")
        await t.tick()
        await t.click("Start")
        lp.workers["node"].held[1].set_exception(WorkError("no bus"))
        await t.note("failed")
        session.controller = "/lib/mine.so"
        session.tables = "engine7"
        await t.put(".bus", "lockstep")
        t.answers["lockstep"] = WorkError("ended")
        await t.click("Start")
        approve("web_run_real", t.text())

    in_a_loop(go())


# ---- the schedule ----------------------------------------------------------------------------------------------------


def links() -> Any:
    """The result of a schedule."""
    speed = np.arange(90.0, 101.0)
    names = ("vigv", "vgv1", "vgv2")
    made = []
    for k, n in enumerate(names):
        figures = {"initial": 3.0 + k, "built": 2.0 + k, "adjusted": 1.0 + k}
        made.append(SimpleNamespace(
            stage=n, lb_initial=10.0 + k, lb_built=11.0 + k, lb=12.25 + k, lc_built=20.0, lc=21.5, at_design=figures,
            rms={a: b / 2 for a, b in figures.items()}, largest={a: 2 * b for a, b in figures.items()},
            error_built=0.1 * speed, error=0.01 * speed + k,
        ))  # fmt: skip
    stroke = np.linspace(-2.0, 50.0, 40)
    x = np.linspace(0.0, 40.0, 5000)
    loops = {n: SimpleNamespace(
        width=1.5 + k, width_sigma=0.02, offset=0.3, lb=20.0, lc=30.0, noise=0.05, stroke=stroke, mean=stroke - 10.0,
        extension=stroke - 9.0, retraction=stroke - 11.0,
        samples=(x, x - 10.0, np.where(x < 15, 1, np.where(x < 30, -1, 0)))) for k, n in enumerate(names)}  # fmt: skip
    table = np.array([speed, speed / 2, speed / 2 - 1, speed / 2 - 0.5])
    return SimpleNamespace(links=made, loops=loops, speed=speed, table=table, notes=["2 rows are out of order"])


async def uploaded(t: Transcript, name: str) -> None:
    """Drop a file on the page."""

    class File:
        async def save(self, path: Path) -> None:
            path.write_text("uploaded")

    file: Any = File()
    file.name = name
    box = t.page.find(ui.upload)
    with box.parent_slot:
        await box._upload_handlers[0](SimpleNamespace(file=file))
    kept = sorted(p for p in t.page.session.folder.glob("upload*/*"))
    modes = [
        (str(p.relative_to(t.page.session.folder)), oct(p.stat().st_mode), oct(p.parent.stat().st_mode)) for p in kept
    ]
    await t.note(f"drop {name}: {modes}")


def test_the_schedule(monkeypatch: pytest.MonkeyPatch, session: Session) -> None:
    async def go() -> None:
        strokes = np.linspace(0.0, 40.0, 9)
        drawn = {"strokes": strokes.tolist(), "stages": [{"key": "vigv", "name": "VIGV", "radius": 0.2,
                 "joints": [[[1.0, 2.0]]], "angles": (strokes / 2).tolist()}]}  # fmt: skip
        speed = np.arange(40.0, 101.0)
        steps = {
            "mechanism": drawn,
            "stroke": {"speed": speed, "table": np.array([speed, speed + 1, speed - 1, speed])},
            "links": links(),
            "loop": links(),
            "tables": {"result": links(), "files": ["/x/vigv.toml", "/x/s.html"]},
        }

        def step(step: str, **_: Any) -> Any:
            answer = steps[step]
            if isinstance(answer, Exception):
                raise answer
            return answer

        geometry = schedule.Plan.of(session).geometry
        answers: dict[str, Any] = {"schedule_step": step, "engine_part": ("geometry", geometry)}
        t = Begun(monkeypatch, session, answers, schedule.build, whole=True)
        opened, plan = t.page, session.extra["plan"]
        for title in ("1  Mechanism", "2  Stroke for the VIGV", "3  Links of the other vane rows"):
            await t.click(title)
        await t.put(".loop-log", 1)
        for title in ("4  Measured loop", "5  Tables"):
            await t.click(title)
        await t.click("light or dark")
        boxes = opened.all(ui.number)
        await t.put(next(b for b in boxes if b._props["label"] == "largest change of Lb [mm]"), 4.0)
        length = next(b for b in boxes if str(b._props["label"]).startswith("VIGV Lb"))
        await t.fire(length, "blur")
        await t.put(length, None)
        await t.fire(length, "blur")
        await t.put(length, 33.5)
        await t.fire(length, "keydown.enter")
        await t.click("1  Mechanism")
        editor = opened.find(schedule.Editor)
        await t.fire(editor, "moved", [2, -3.25])
        await t.fire(editor, "moved", [2, -3.25])
        at = next(b for b in boxes if str(b._props["label"]).startswith("at "))
        await t.put(at, 7.5)
        await t.fire(at, "blur")
        await t.put(at, None)
        await t.fire(at, "blur")
        await t.put(opened.all(ui.toggle)[0], "vgv1")
        option = next(b for b in boxes if b._props["label"] == "lengths change by [mm]")
        await t.put(option, 0.25)
        await t.put(option, None)
        await t.put(opened.all(ui.select)[-1], "max")
        steps["links"] = WorkError("no links")
        await t.click("3  Links of the other vane rows")
        for part, value in (("geometry", "33.5"), ("schedules", "7.5")):
            assert value in (session.folder / "engine" / f"{part}.toml").read_text()
        t.answers["schedule_step"] = HELD
        await t.click("1  Mechanism")
        await t.click("2  Stroke for the VIGV")
        plan.options["step"] = 0.75
        session.bench.held[0].set_result(drawn)  # type: ignore[attr-defined]
        await t.note("an answer to what is asked no more")
        await t.put(".loop-log", -1)
        await t.fire(opened.find(ui.upload), "rejected")
        for name in ("geometry.toml", "loop.csv", "x.exe"):
            await uploaded(t, name)
        await t.click("Back to the shipped engine")
        approve("web_schedule", t.text())

    in_a_loop(go())


# ---- a fleet ---------------------------------------------------------------------------------------------------------


def test_a_run_of_a_fleet(monkeypatch: pytest.MonkeyPatch, session: Session, tmp_path: Path) -> None:
    for folder in ("runs/one", "runs/two", ".hidden", "_no", "a/b/c/d/e"):
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / "run.json").write_text("{}")
    (tmp_path / "runs/one/inner").mkdir()
    (tmp_path / "runs/one/inner/run.json").write_text("{}")
    state = {"done": 3, "contents": 10, "logs": 1200, "came_to": {}, "damaged": {}, "workers": {"w1": "local"},
             "campaign": False}  # fmt: skip

    async def go() -> None:
        t = Begun(monkeypatch, session, {"fleet_state": dict(state), "fleet_report": fleet_page(view(), logs="x")},
                  fleet.build, whole=True)  # fmt: skip
        await t.put(".run-folder", "runs/one")
        await t.click("Read the results so far")
        await t.tick("nothing new")
        t.answers["fleet_state"] = {**state, "done": 10, "came_to": {"done": 9000}, "damaged": {"x.csv": "no <time>"}}
        await t.tick("complete")
        await t.tick("nothing more is asked")
        t.answers["fleet_state"] = {**state, "campaign": True, "logs": 10, "contents": 0, "done": 0}
        await t.put(".run-folder", "runs/two")
        await t.click("Look again")
        (tmp_path / "more").mkdir()
        (tmp_path / "more/run.json").write_text("{}")
        await t.click("Look again")
        t.answers["fleet_state"] = WorkError("no such run")
        await t.put(".run-folder", "more")
        await t.tick("after a complaint")
        f = session.extra["fleet"]
        f.choose("nowhere")
        f.choose("more")
        t.answers["fleet_log"] = "<html>"
        key = "0" * 64
        said = [await f.log(n) for n in (f"{key}.html", f"{key}.csv.html", f"{key[1:]}.html", f"{key}.123456789.html")]
        assert said == ["<html>", "<html>", None, None]
        t.answers["fleet_log"] = WorkError("none")
        assert await f.log(key) is None
        f.run = ""
        assert await f.log(key) is None
        await t.note("a log's page")
        approve("web_fleet", t.text())

    in_a_loop(go())
    assert fleet.runs_in(tmp_path) == ["a/b/c/d/e", "more", "runs/one", "runs/two"][1:]


# ---- what a session does ---------------------------------------------------------------------------------------------


def test_what_is_stopped_is_what_was_named(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    stopped: list[str] = []
    jobs = {"search": ("diagnose", "look"), "bench": ("refit",), "aside": ("judge",)}
    for worker, names in jobs.items():
        w = getattr(session, worker)
        w.jobs.update({k: Job(k, n, n, None, started=0.0) for k, n in enumerate(names)})  # type: ignore[arg-type]
        monkeypatch.setattr(w, "stop", lambda worker=worker: stopped.append(worker))
    assert [j.name for j in session.jobs] == ["diagnose", "look", "refit", "judge"]
    assert session.busy("refit", "judge") is session.bench.jobs[0] and session.busy("none") is None
    for names, ends in ((("look",), ["search"]), (("judge",), ["aside"]), ((), ["search", "bench"]), (("none",), []),
                        (("refit", "judge"), ["bench", "aside"])):  # fmt: skip
        stopped.clear()
        session._hand_wanted = True
        session.stop(*names)
        assert stopped == ends and session._hand_wanted is False
    for worker in jobs:
        getattr(session, worker).jobs.clear()


def test_switching_forgets_what_was_set_by_hand(session: Session) -> None:
    async def go() -> None:
        session.stage, session.chosen = "actuator", {"actuator": ("grip",)}
        session.hand, session.hand_rms = {"grip": {"size": 0.7}}, {"x_lvdt": 1.0}
        session.do = lambda section, work: work.close()  # type: ignore[method-assign]
        session.switch("more", True)
        assert session.chosen == {"actuator": ("grip", "more")} and session.hand == {} and session.hand_rms == {}
        session.switch("grip", True)
        assert session.chosen == {"actuator": ("more", "grip")}
        session.switch("more", False)
        assert session.chosen == {"actuator": ("grip",)}

    asyncio.run(go())


def test_a_page_looks_again_soon_but_not_too_often(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock(monkeypatch, "frame")
    later: list[Any] = []

    async def go() -> None:
        opened = Opened(session, missing.build)
        loop: Any = asyncio.get_running_loop()
        monkeypatch.setattr(loop, "call_later", lambda wait, call: later.append((wait, call)))
        live = opened.live
        live.soon, live.looked = False, 99.97
        session.touch("log")
        assert [(round(w, 9), c) for w, c in later] == [(0.02, live.look)] and live.soon
        session.touch("log")
        assert len(later) == 1
        clock.now = 101.0
        opened.look()
        assert live.soon is False and live.looked == 101.0
        clock.now = 102.0
        session.touch("log")
        assert later[1][0] == 0.0

    in_a_loop(go())


def test_a_run_that_hangs_is_ended_and_its_controller_named(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock(monkeypatch, "running")
    loop: Any = running.Loop(session)
    stopped: list[int] = []
    wait = asyncio.wait

    async def waiting(tasks: Any, timeout: float) -> Any:
        assert timeout == 0.5
        clock.now += timeout
        return await wait(tasks, timeout=0.0)

    ticks = [b"a", b"b"] + [b"c"] * 1000
    monkeypatch.setattr(running.asyncio, "wait", waiting)
    monkeypatch.setattr(running.black_box, "progress", lambda boxes: ticks.pop(0))
    monkeypatch.setattr(running.black_box, "left", lambda boxes: "the box")
    monkeypatch.setattr(running.isolation, "told", lambda box, why: f"{box}: {why}")

    async def watched(patience: bool) -> str:
        future: asyncio.Future[Any] = asyncio.get_running_loop().create_future()

        def stop() -> None:
            stopped.append(round(clock.now))
            if not future.done():
                future.set_exception(Cancelled("stopped"))

        async def call() -> Any:
            return await future

        if not patience:
            future.set_exception(WorkError("ended"))
        try:
            return str(await loop._watched(SimpleNamespace(stop=stop), call()))
        except WorkError as e:
            return str(e)

    loop.boxes = session.folder
    patience = running.isolation.PATIENCE
    assert asyncio.run(watched(True)) == f"the box: did not come back within {patience:g} s"
    assert stopped[0] == pytest.approx(100.0 + 1.5 + patience, abs=1.1)
    assert asyncio.run(watched(False)) == "the box: ended its process"
    monkeypatch.setattr(running.black_box, "left", lambda boxes: None)
    assert asyncio.run(watched(False)) == "ended"
