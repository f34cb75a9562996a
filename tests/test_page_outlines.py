"""What each page holds, held against the text that was approved of it (`tests/page_outline.py` says how to renew it).

The results are small and made by hand, so that every branch of a page is on one of them: a page with much and one with
little, good news and bad.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import control  # its import takes seconds that are no test's
import numpy as np
import pytest

from controller import STRATEGIES
from hil.figures import SignalError, error_figures
from plant import load_geometry
from plant.geometry import vane_angles
from plant.spatial import Clearances
from tests.page_outline import approve, outline, unpacked, written
from tests.test_page import play
from vaneloop.design.clearance import WORDS, ClearanceStudy
from vaneloop.design.links import LinkChange, geometry_with
from vaneloop.design.measured_loop import MeasuredLoop
from vaneloop.design.scheduling import ScheduleResult
from vaneloop.design.spatial import SpatialCheck
from vaneloop.design.strategies import Failure, Outcome, Scenario
from vaneloop.identification.candidates.closed_forms import Formula
from vaneloop.identification.least_squares.problem import Fit, LeastSquaresProblem
from vaneloop.identification.regimes import Shape, locate
from vaneloop.identification.results import Candidate, Found, StageDiagnosis
from vaneloop.identification.subsystem import Effect, Parameter, Stage
from vaneloop.identification.unmodelled.fitted_candidate import Outcome as Learning
from vaneloop.identification.unmodelled.learned_law import LearnedLaw, LearnedSurface
from vaneloop.identification.user_models.by_log import ByLog, Logs
from vaneloop.identification.vane_chain.experiment import HEADS
from vaneloop.identification.workflow import Diagnosis
from vaneloop.pages.by_log import curves_by_log, log_by_log
from vaneloop.pages.campaign import CampaignView, FailedMachine, GroupView, Rare, Requirement, campaign_page
from vaneloop.pages.design import design_page
from vaneloop.pages.diagnosis import compare_page, diagnosis_page, experiment_page, extended_page
from vaneloop.pages.engine_test import engine_test_report
from vaneloop.pages.figures import Line, Panel, bars, heat, histogram, loop, overlay, ranking, waterfall
from vaneloop.pages.fleet import FleetView, Series, day, fleet_page, log_page
from vaneloop.pages.learned import learned_page
from vaneloop.pages.mechanism import clearance_page, spatial_page
from vaneloop.pages.page import Link, Page, Plot, Section
from vaneloop.pages.replay import replay_page
from vaneloop.pages.schedule import schedule_page
from vaneloop.pages.strategies import report as strategies_report
from vaneloop.pages.style import capital

assert control
Array = np.ndarray
VERSION = "vaneloop 1.2.3"


def noise(n: int, size: float, k: int = 0) -> Array:
    """Numbers that scatter evenly with this RMS, the same everywhere."""
    return size * np.sqrt(12.0) * (np.modf(np.arange(1.0 + k, n + 1.0 + k) ** 2 * 0.7548776662)[0] - 0.5)


# ---------------------------------------------------------------- all kinds of figures


def all_figures() -> Page:
    """Every kind of figure, with all that it can show and with next to nothing."""
    t = np.arange(300) * 0.1
    y = np.sin(t)
    page = Page("Figures", "All kinds of them.", tone="good", subtitle="kinds", command="vaneloop a <b>",
                log="a & b.csv", state_hash="abc", version=VERSION)  # fmt: skip
    page.tile("a tile", 0.123456, "mm", "with a note", "bad")
    page.tile("count", 12345)
    page.section("Curves", "One paragraph.\n\nAnother <one>.")
    lines = [Line("a", t, y, "measured", 2.0, "dash", 0.5), Line("b <i>", t, 2 * y, "#123456", shown=False)]
    other = [Line("a", t, y**2), Line("holes", np.delete(t, np.s_[100:150]), np.delete(y, np.s_[100:150]), "other")]
    log = Panel("log [1]", other, log=True, marks={"ten": 10.0}, height=2.0, zero=True)
    page.plot(overlay([Panel("lin [mm]", lines, band=0.3, marks={"limit": 0.7}), log], "x [s]"), "Two panels.")
    page.plot(overlay([Panel("lin [mm]", lines[:1], height=0.5)], height=333))
    page.plot(loop(lines, "x [mm]", "y [deg]", height=300, markers=True), "Marked.", half=True)
    page.plot(loop([Line("flat", t, 0 * t)], "x", "y"), half=True)
    page.section("Shares")
    e = {"one": noise(2000, 0.2), "two": noise(2000, 0.5, 7) + 0.3, "empty": np.full(3, np.nan)}
    page.plot(histogram(e, "error [mm]", noise=0.15))
    page.plot(histogram({"one": e["one"]}, "error [mm]", roles={"one": "good"}, bins=11))
    page.plot(histogram({}, "error [mm]"))
    page.plot(histogram({"none": [0.0, 0.0]}, "error [mm]", bins=3))
    page.section("Bars")
    page.plot(bars(["g", "h"], {"a": [1.5, None], "b": [0.25, np.inf]}, "y [%]", marks={"goal": 1.0}, x_title="groups"))
    many = {s: list(np.arange(7.0) + k) for k, s in enumerate("cde")}
    page.plot(bars([str(k) for k in range(7)], many, "many", roles={"e": "bad"}, height=200))
    steps = [("nominal", 40.0), ("+ a", 8.0), ("+ b", 9.5), ("end", 1.25)]
    page.plot(waterfall(steps, "error [floors]", floor=0.8, told=lambda v: f"<{v:g}>"))
    page.plot(waterfall([("nominal", 3.0), ("end", 1.0)], "error", floor=1.0, height=222))
    page.plot(waterfall([("nominal", 0.0)], "error"))
    names, values = ["low", "top", "mid"], [0.2, 30.0, 4.0]
    page.plot(ranking(names, values, "left", ["mid"], [0.1, 20.0, 3.0], [0.4, 50.0, 7.0], marks={"all": 2.0}))
    page.plot(ranking(names, values, "left", log=True, marks={"all": 2.0, "more": 60.0}))
    page.plot(ranking([*names, "more"], [0.0, *values], "left", ["top"], log=True))
    page.plot(ranking([], [], "nothing"))
    page.section("Maps")
    cells: Any = [[1.0, None, 0.5], [4.0, 0.0, 2.0]]
    page.plot(heat(cells, ["a", "b", "c"], ["<r>", "s"], "mm", "x", "y"))
    places = [["1 … 2", "2 … 3"], ["", "<4>"]]
    few: Any = [[1.0, 2.0], [None, 0.1]]
    page.plot(heat(few, ["a", "b"], ["r", "s"], "deg", places=places, moments=[[3.0, np.nan],
              [None, 7.5]]))  # fmt: skip
    page.plot(heat([[None, None]] * 5, ["a", "b"], list("rstuv"), "deg"))
    page.table(["word", "n", "", "mixed"], [["short", 1, Link("here", "a.html?x&y"), 1.23456],
               ["a" * 25, None, True, "b"],
               ["a" * 24, -2, "c", 0.5]], "A caption.")  # fmt: skip
    page.table(["n"], [[1.23456789]], digits=6)
    page.table(["empty"], [])
    page.notes(["x_lvdt is off", "the second"])
    page.notes([])
    return page


def test_every_kind_of_figure() -> None:
    approve("figures", outline(all_figures()))


def test_the_markup_of_a_page() -> None:
    """What comes before and between the figures; the style sheet and the scripts are files of their own."""
    page = all_figures()
    page.figures = [{"data": [], "layout": f["layout"].get("height") and {"height": f["layout"]["height"]} or {}}
                    for f in page.figures]  # fmt: skip
    page._scripts = lambda: ["SCRIPTS"]  # type: ignore[method-assign]
    text = page.html()
    head, _, rest = text.partition("<style>")
    style, _, rest = rest.partition("</style>")
    approve("markup", head + "STYLE" + rest)
    assert style.startswith(":root{--measured:#1f6fc4;--model:#d1560a;")
    assert style.count("--page:") == 3 and style.count("--measured:#1f6fc4") == 2  # screen and print
    assert style.index("@media (prefers-color-scheme: dark)") < style.index("--measured:#63abf5")


def test_a_page_with_little_has_no_empty_parts() -> None:
    page = Page("Bare", "Nothing.", version=VERSION)
    page.section("Only one")
    text = page.html()
    assert "<nav" not in text and 'class="tiles"' not in text and "<script" not in text and " · " not in text
    assert '<p class="verdict neutral">Nothing.</p>' in text
    assert f"<footer><dl><div><dt>version</dt><dd>{VERSION}</dd></div></dl></footer>" in text


# ---------------------------------------------------------------- replay and engine test


@dataclass(frozen=True)
class Samples:
    """As `hil.logs.Channel`."""

    t: Array
    values: Array


@dataclass(frozen=True)
class Run:
    """As `hil.replay.ReplayResult`."""

    log: str
    simulated_s: float
    wall_s: float
    state_hash: str
    t: Array
    model: dict[str, Array]
    target: dict[str, Array]
    measured: dict[str, Samples]
    signals: list[SignalError] = field(default_factory=list)


def run(
    measured: Sequence[str] = ("n_r", "x_lvdt", "vigv"), width: float = 2.6, dual: bool = True, seconds: float = 200.0,
    floors: dict[str, float] | None = None, model: Sequence[str] = ("n_r", "x_lvdt", "vigv", "vgv1"),
) -> Run:  # fmt: skip
    """Rotor speed to and fro between 40 and 100 %, vanes with a play of 1.6 deg, in the machine of ``width``."""
    t = np.arange(int(seconds * 10.0)) / 10.0
    n_r = 70.0 - 30.0 * np.clip(1.3 * np.cos(2.0 * np.pi * t / 60.0), -1.0, 0.998)
    target = {"vigv": 50.0 * (n_r - 40.0) / 60.0 - 10.0, "vgv1": 30.0 * (n_r - 40.0) / 60.0 - 4.0}
    ahead = np.sign(np.gradient(n_r)) * 0.76 if dual else 0.0
    x = np.clip((target["vigv"] + 10.0 + ahead) / 1.05, 0.0, 48.0)
    own = {"n_r": n_r, "x_lvdt": x, "vigv": play(1.05 * x - 10.0, 1.6), "vgv1": play(0.63 * x - 4.0, 1.0)}
    truth = own | {"vigv": play(1.05 * x - 10.0 + 0.002 * x**2, width), "n_r": n_r + 0.02}
    known = {"n_r": 0.02, "x_lvdt": 0.005, "vigv": 0.03, "vgv1": 0.03} | (floors or {})
    channels = {k: Samples(t, truth[k] + noise(t.size, known[k], 99 * i)) for i, k in enumerate(measured)}
    figures = [
        error_figures(k, "linkage" if k[0] == "v" else k, {"n_r": "%", "x_lvdt": "mm"}.get(k, "deg"), "measured", t,
                      own[k], channels[k].values, n_r, known[k])
        for k in measured
    ]  # fmt: skip
    figures += [
        error_figures(k, "linkage", "deg", "schedule", t, own[k], target[k], n_r, 0.0) for k in target if k in model
    ]
    if "n_r" in measured:
        channels["n_dem"] = Samples(t, n_r + 0.5)
    return Run("logs/run.csv", seconds, 0.5, "ab12", t, {k: own[k] for k in model}, target, channels, figures)


def with_a_hole(r: Run, signal: str) -> Run:
    """The same run, whose log pauses for 8 s."""
    c = r.measured[signal]
    keep = (c.t < 40.0) | (c.t > 48.0)
    return replace(r, measured=r.measured | {signal: Samples(c.t[keep], c.values[keep])})


def test_a_replay_that_misses_hysteresis() -> None:
    r = with_a_hole(run(), "vigv")
    r = replace(r, model=r.model | {"i_motor": 3.0 + np.sin(r.t)})
    approve("replay_misses", outline(replay_page(r, "vaneloop replay run.csv")))


def test_a_replay_within_the_noise() -> None:
    """And with another title, of one vane, on a raster too slow for a mean over 1 s, in no time at all."""
    r = run(("x_lvdt",), model=("x_lvdt", "vigv"), seconds=9.0)
    r = replace(
        r, wall_s=0.0, target={"vigv": r.target["vigv"]}, model=r.model | {"n_r": run(seconds=9.0).model["n_r"]}
    )
    approve("replay_fits", outline(replay_page(r, title="Mine")))


def test_a_replay_of_a_sensor_without_noise() -> None:
    """Its error in noise floors is infinite; one that the model has exactly is none. A signal of which the run has no
    curve has only figures.
    """
    r = run(("vigv", "x_lvdt"), floors={"vigv": 0.0, "x_lvdt": 0.0}, seconds=60.0)
    r = replace(r, measured={"vigv": r.measured["vigv"]})
    approve("replay_without_noise", outline(replay_page(r)))


def test_a_replay_of_a_demand() -> None:
    approve("replay_demand", outline(replay_page(run((), seconds=60.0))))
    nothing = replace(run((), seconds=60.0, model=("n_r",)), signals=[], target={})
    approve("replay_nothing", outline(replay_page(nothing)))


def test_an_engine_test_beside_the_paper(monkeypatch: pytest.MonkeyPatch) -> None:
    pages = written(monkeypatch)
    single, dual = run((), dual=False, seconds=300.0), run(("n_r",), seconds=300.0)
    for r in (single, dual):
        r.model["n_r"][:] = np.round(r.model["n_r"], 3)
    path = engine_test_report(single, dual, {"hysteresis": 1.7}, "e.html", "vaneloop engine-test")
    assert path == Path("e.html")
    approve("engine_test", outline(pages[0]))


def test_an_engine_test_that_misses_the_paper(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is too short for a mean at any speed, and never near the design point."""
    pages = written(monkeypatch)
    short = run((), dual=False, seconds=12.0, model=("n_r", "vigv"))
    engine_test_report(short, short, None, Path("e.html"))
    approve("engine_test_misses", outline(pages[0]))
    with pytest.raises(ValueError, match="holds no figures for 'vigv'"):
        engine_test_report(replace(short, signals=[]), short, None, "e.html")


# ---------------------------------------------------------------- comparison and diagnosis


def stage(name: str = "actuator", drift: float = 0.0, window: float | None = None) -> Stage:
    """A stroke and a speed that a model with a gain follows; the effect ``grip`` adds where the motion is negative.
    Between 20 and 22 s the stroke was not measured.
    """
    t = np.arange(600) * 0.1
    speed = 3.0 * np.sin(0.9 * t) + np.cos(0.31 * t)
    place = 20.0 + 5.0 * np.sin(0.21 * t)

    def model(thetas: Array) -> Array:
        gain, grip, more = np.asarray(thetas, dtype=float).T
        x = gain[:, None] * place + grip[:, None] * (speed < 0.0)
        return np.stack([x, gain[:, None] * speed + more[:, None] * t], axis=1)

    measured = model(np.array([[1.02, 0.5, drift]]))[0] + np.array([noise(600, 0.05), noise(600, 0.2, 31)])
    measured[0, 200:220] = np.nan
    grip = Effect("grip", (Parameter("size", 0.0, "mm", 0.0, 2.0),), ((0.1,), (1.0,)))
    more = Effect("more", (Parameter("rate", 0.0, "mm/s2"),), ((0.1,),))
    return Stage(
        name, ("x_lvdt", "speed"), ("mm", "mm/s"), (Parameter("gain", 1.0, "-", 0.5, 1.5, 0.1),), (grip, more), model,
        t, measured, window=window, regimes={"speed": speed, "direction": np.sign(speed), "time": t},
        regime_units={"speed": "mm/s", "time": "s"}, floor=np.array([0.06, 0.2]),
    )  # fmt: skip


def fit_of(s: Stage, theta: tuple[float, float, float], effects: tuple[str, ...] = (), held_out: float = 1.21) -> Fit:
    """What a fit holds that ended at these parameters; its held-out error is a tenth above the fitted."""
    judge = LeastSquaresProblem(s, np.array([0.05, 0.2]))
    at = np.array(theta)
    cost, free = judge.block_costs(judge.errors(at[None]))[0], judge.columns(effects)
    flat = np.zeros((judge.n_blocks, len(free)))
    return Fit(effects, at, free, cost, held_out * cost, flat, flat[:, :, None] * flat[:, None], 0.0 * free,
               at[free] - 0.01, at[free] + 0.02)  # fmt: skip


def said_of(
    s: Stage, verdict: str, effects: Sequence[Found] = (), final: Fit | None = None, **more: Any
) -> StageDiagnosis:
    """What a stage says, with these errors before and after."""
    base = fit_of(s, (1.02, 0.0, 0.0))
    left = (
        np.array([0.052, 0.21])
        if effects
        else np.array([0.31, 0.5])
        if verdict == "unknown"
        else np.array([0.053, 0.2])
    )
    before = left if verdict == "none" else np.array([0.6, 0.5])
    known: dict[str, Any] = {"candidates": [], "correlation": 1.0, "steps": [], "excess": 1.0} | more
    return StageDiagnosis(s.name, s.outputs, s.units, verdict, np.array([0.05, 0.2]), base, final or base, before, left,
                          list(effects), known.pop("recalibrated", []), **known)  # fmt: skip


def diagnosis(window: float | None = None) -> tuple[Diagnosis, SimpleNamespace]:
    """A stage that lacks two effects, one that lacks what nobody knows, one that fits, one that nothing is known of."""
    acting, strange, fits = stage(window=window), stage("engine", 0.05), stage("linkage")
    sizes = {"size": {"value": 0.5, "low": 0.4, "high": 0.61, "unit": "mm"}}
    slow = {"rate": {"value": -0.02, "low": -0.03, "high": -0.01, "unit": "mm/s2"}}
    effects = [
        Found("grip", 0.93, sizes, ["stick", "hold"], 50.0, fall=8.0, inseparable=["time"]),
        Found("more", 0.999, slow, [], 20.0, fall=2.0),
    ]
    candidates = [Candidate(f"c{k:02d}", 30.0 - k, 2.0, left=2.0 + 0.3 * k) for k in range(14)]
    candidates += [
        Candidate("grip", 40.0, 9.0, left=1.5), Candidate("more", -1.0, 0.0, left=11.9),
        Candidate("none", -2.0, 0.0, left=12.5), Candidate("unseen", 0.0, 0.0, "an oil that warms up by 20 K"),
    ]  # fmt: skip
    first = said_of(
        acting, "missing", effects, fit_of(acting, (1.02, 0.5, 0.001), ("grip", "more")), candidates=candidates,
        correlation=1.83, steps=[("nominal", 12.0), ("grip", 3.0), ("grip + more", 1.04)], excess=1.04,
        recalibrated=[{"parameter": "gain", "value": 1.02, "low": 1.01, "high": 1.03, "unit": "-", "at_limit": False}],
    )  # fmt: skip
    second = said_of(
        strange, "unknown", steps=[("nominal", 6.2)], excess=6.2, candidates=[Candidate("grip", -3.0, 0.0)]
    )
    shapes = {
        "engine": [
            Shape("speed", "time", 0.9, "error of speed grows linearly with time", np.arange(12.0),
                  np.arange(12.0) ** 1.5, "s", "mm/s"),
            Shape("x_lvdt", "speed", 0.2, "x_lvdt stays away", np.arange(3.0), np.array([2.0, 1.0, 4.0]), "mm/s", "mm"),
        ]
    }  # fmt: skip
    d = Diagnosis("unknown", [first, second, said_of(fits, "none")], shapes, {"servo": "no i_cmd in the log"}, 3.0,
                  ["the log is short", "p_s is constant"])  # fmt: skip
    return d, SimpleNamespace(stages=[acting, strange, fits], not_observed=d.not_observed, notes=[])


TESTED = [
    SimpleNamespace(
        stage="actuator", signal="x_lvdt", error_before=0.7, error_after=0.08, noise_floor=0.05, unit="mm", samples=1234
    )
]


def test_a_diagnosis_with_every_verdict() -> None:
    d, bound = diagnosis()
    text = outline(diagnosis_page(d, bound, "vaneloop diagnose a.csv", "logs/a.csv", tested=TESTED))
    approve("diagnosis", text)


def test_a_diagnosis_of_which_nothing_is_missing() -> None:
    d, bound = diagnosis()
    clean = Diagnosis("none", [d.stages[2]], {}, {}, 1.0)
    approve("diagnosis_none", outline(diagnosis_page(clean, bound, "vaneloop diagnose", "a.csv")))


def test_an_extended_model() -> None:
    d, bound = diagnosis(window=12.0)
    s = d.stages[0]
    d = replace(d, verdict="missing", stages=[s], shapes={}, notes=[])
    approve("extended", outline(extended_page(d, bound, "vaneloop extend", "a.csv")))
    worse = replace(
        s, error_after=np.array([0.2, 0.2]), steps=[("nominal", 12.0), ("+ grip", 4.0)], effects=s.effects[:1]
    )
    d = replace(d, stages=[worse])
    page = extended_page(d, bound, "vaneloop extend", "a.csv", "its error on the test log is larger")
    approve("extended_refused", "\n".join(outline(page).splitlines()[:30]) + "\n")
    assert "falls from 12 to 1.04 noise floors: an error remains." in extended_page(d, bound, "", "a.csv").verdict
    assert extended_page(d, bound, "", "a.csv").tone == "bad"


def test_the_next_experiment() -> None:
    d, bound = diagnosis()
    d = replace(d, stages=d.stages[2:], notes=[], shapes={})
    table = [
        {"profile": "stairs", "nats": 40.0, "spreads": 9.5, "repeats": 1},
        {"profile": "slams", "nats": -233.6, "spreads": 0.0, "repeats": 0},
    ]
    plan = {
        "text": "Move slowly.\n\nThen fast.", "t": np.arange(20.0), "separates": True,
        "inputs": {"n_dem": ("%", 50.0 + np.arange(20.0) ** 1.2)}, "table": table, "heads": HEADS,
    }  # fmt: skip
    approve("experiment", outline(experiment_page(d, bound, "vaneloop experiment", "a.csv", "Move the vanes.", plan)))
    assert "next experiment" not in outline(experiment_page(d, bound, "", "a.csv", "None is needed.", None))
    none = experiment_page(d, bound, "", "a.csv", "No profile.", {**plan, "separates": False})
    assert not none.figures  # what separates nothing is not drawn as the next experiment


def test_where_a_stage_fails() -> None:
    """One that fails everywhere, one that fails under one condition only, and one that fits."""
    fails, fits = stage(), stage("linkage")
    located = [locate(LeastSquaresProblem(fails, np.array([0.05, 0.2])), fit_of(fails, (1.02, 0.0, 0.0))),
               locate(LeastSquaresProblem(fits, np.array([0.05, 0.2])), fit_of(fits, (1.02, 0.5, 0.0)))]  # fmt: skip
    located[0] = replace(located[0], onset=31.4)
    bound = SimpleNamespace(stages=[fails, fits], not_observed={"servo": "no i_cmd in the log"}, notes=[])
    page = compare_page(located, bound, "vaneloop compare a.csv", "x/a.csv", None, TESTED)
    approve("compare", outline(page))
    bound.not_observed = {}
    whole = locate(LeastSquaresProblem(fits, np.array([0.05, 0.2])), fit_of(fits, (1.02, 0.5, 0.0), held_out=1.0))
    page = compare_page([whole], bound, "vaneloop locate", "a.csv", title="Where it fails")
    approve("locate_fits", "\n".join(outline(page).splitlines()[:12]) + "\n")
    assert [t.tone for t in page.tiles] == ["good"]


# ---------------------------------------------------------------- a user's own model, log by log


def own_logs(names: Sequence[str], k: int, kind: str = "force", cutoff: float | None = None) -> Any:
    """A system on these logs, 5 s each: a spring whose force is read, and with it another force; theta is a factor."""
    t = np.arange(50.0 * len(names)) * 0.1
    x = np.sin(0.7 * t + k)
    measured = np.array([2.0 * x + noise(len(t), 0.1, k), 3.0 * x**2 + noise(len(t), 0.2, k)])
    measured[:, :3] = np.nan
    halves = [np.stack([x[i : i + 50], x[i : i + 50] ** 2]) for i in range(0, len(t), 50)]

    def run(thetas: Array) -> Array:
        return np.stack([thetas[:, :1] * x, (thetas[:, :1] + thetas[:, 1:2]) * x**2], axis=1)

    return SimpleNamespace(
        logs={n: slice(50 * i, 50 * i + 50) for i, n in enumerate(names)}, t=t, measured=measured, u=halves, run=run,
        data=SimpleNamespace(cutoff=cutoff), theta_from=lambda fitted, theta: theta + 0.1, stages=[], not_observed={},
        stage=SimpleNamespace(parameters=(Parameter("stiffness", 2.0, "N/m"), Parameter("mass", 1.0, "kg"))),
        system=SimpleNamespace(kind=kind, units={"position": "mm"} if cutoff else {}, parameters=()),
    )  # fmt: skip


def by_log(laws: bool = True, test: bool = True, kind: str = "force") -> ByLog:
    """Two logs that were fitted and seven that test, a law that helps on all but one; or one log and no law."""
    fitted = own_logs(["runs/a.csv", "runs/b.csv"] if laws else ["only.csv"], 0, kind, 5.0 if laws else None)
    tests = own_logs([f"runs/t{k}.csv" for k in range(7)], 5, kind) if test else None
    logs = Logs(fitted, tests)
    names = [*fitted.logs, *(tests.logs if tests else ())]
    steps = {"model": {n: np.array([1.0 + 0.1 * i, 2.0 + 0.1 * i]) for i, n in enumerate(names)}}
    if laws:
        steps["friction"] = {n: v * 0.5 for n, v in steps["model"].items()}
        steps["friction + play"] = {n: v * 0.4 for n, v in steps["model"].items()}
    effects = ("friction", "play") if laws else ()
    base = SimpleNamespace(theta=np.array([1.8, 0.9]), effects=())
    final = SimpleNamespace(
        theta=np.array([2.1, 0.8]), effects=effects, free=np.array([1]), low=np.array([0.7]), high=np.array([0.95])
    )
    d = SimpleNamespace(
        stage="rig", outputs=("force", "other"), units=("N", "kN"), base=base, final=final,
        verdict="missing" if laws else "none", error_before=np.array([1.0, 2.0]), error_after=np.array([0.4, 0.7]),
        floor=np.array([0.1, 0.25]), excess=1.234,
    )  # fmt: skip
    ablation = {"friction": {n: 0.6 + 0.05 * i for i, n in enumerate(names)}, "play": dict.fromkeys(names, 0.8)}
    return ByLog(logs, d, steps, ablation if laws else {}, notes=["play hardly helps"])  # type: ignore[arg-type]


def test_what_several_logs_say_beyond_one() -> None:
    page = Page("Logs", "Many.", version=VERSION)
    answer = by_log()
    log_by_log(page, answer)
    approve("by_log", outline(page))
    page = Page("Curves", "Many.", version=VERSION)
    curves_by_log(page, answer)
    assert len([p for p in page.parts if isinstance(p, Plot)]) == 2 * (2 + 6)  # of the tests no more than six
    lines = outline(page).splitlines()
    starts = [i for i, line in enumerate(lines) if line.startswith("plot")]
    approve("by_log_curves", "\n".join([*lines[: starts[2]], *lines[starts[4] : starts[6]]]) + "\n")
    for figure in page.figures[::2]:  # each log begins at 0 s
        assert {tuple(unpacked(d["x"])[[0, -1]].round(3)) for d in figure["data"]} == {(0.0, 4.9)}
    assert sum("(fitted)." in line for line in lines) == 2 and sum("(test)." in line for line in lines) == 6


def test_one_log_of_a_model_to_which_nothing_is_added() -> None:
    page = Page("One", "Log.", version=VERSION)
    answer = by_log(laws=False, test=False, kind="simulate")
    log_by_log(page, answer)
    curves_by_log(page, answer)
    approve("by_log_one", outline(page))
    answer.logs.fitted.system.kind = "force"
    answer.logs.fitted.stage.parameters = ()
    page = Page("One", "Log.", version=VERSION)
    log_by_log(page, answer)
    curves_by_log(page, answer)
    text = outline(page)
    assert "Parameters of the model" not in text and "plot 1: only.csv: force over displacement." in text
    assert "xaxis “displacement [m]”" in text and "yaxis “force [N]”" in text and "with the laws" not in text


def test_pages_of_an_own_model_have_what_its_logs_say() -> None:
    d, bound = diagnosis()
    d = replace(d, stages=d.stages[1:2], shapes={}, notes=[], not_observed={})
    answer = by_log()
    left = "force is left with an error of 0.4 N (29 % of its RMS), 1.23 times the noise of its samples"
    lacks = "The engine subsystem lacks something that the library does not have"
    missing = diagnosis_page(d, bound, "", "a.csv", None, answer)
    assert missing.verdict == f"{lacks}; {left}."
    fits = diagnosis_page(replace(d, verdict="none"), bound, "", "a.csv", None, answer)
    assert fits.verdict == f"Nothing is missing that the library could add to rig; {left}."
    extended = extended_page(d, bound, "", "a.csv", "", answer)
    assert extended.verdict.endswith(f" noise floors: an error remains. {capital(left)}.")
    located = compare_page([], bound, "", "a.csv", answer)
    assert "## Notes\nPlay hardly helps.\n" in outline(located)
    for page in (missing, fits, extended, located):
        titles = {p.title for p in page.parts if isinstance(p, Section)}
        assert {"Log by log", "Which law helps where", "Parameters of the model", "Measured and modelled"} <= titles
        assert sum("(fitted)." in p.caption or "(test)." in p.caption for p in page.parts if isinstance(p, Plot)) == 8


# ---------------------------------------------------------------- laws that were learned


def learned(period: float = 0.0, formulas: bool = True, name: str = "level.outflow") -> LearnedLaw:
    """A curve over a level, with a wider band at its ends."""
    x = np.linspace(0.5, 2.5, 41)
    y = 0.3 * x**2
    band = 0.05 + 0.1 * (x - 1.5) ** 2
    edges = np.linspace(0.5, 2.5, 9)
    told = [
        Formula("square", "0.3 level^2", {"error": 1.02}, 1.02, 2, "quadratic drag"),
        Formula("line", "0.9 level - 0.5", {}, 1.345, 3),
    ]
    return LearnedLaw(
        name, "state adds", "level", "level_every_2" if period else "level", "m/s", "m", x, y, y - band, y + 1.2 * band,
        edges, np.arange(8.0) / 28.0, 14.0, 1.024, x[::10], told if formulas else [], period=period,
    )  # fmt: skip


def surface(formulas: bool = True) -> LearnedSurface:
    """A saddle over a level and a speed, of which the logs have been in a disk."""
    x, across = np.linspace(0.0, 2.0, 65), np.linspace(-1.0, 3.0, 65)
    values = 0.5 * np.outer(x - 0.7, across + 0.2)
    within = ((x[:, None] - 1.0) ** 2 + (0.5 * (across[None] - 1.0)) ** 2) < 0.6
    turn = np.arange(200.0)
    samples = np.array([1.0 + 0.7 * np.cos(turn) * turn / 200.0, 1.0 + 1.4 * np.sin(turn) * turn / 200.0])
    y = values[:, 32]
    return LearnedSurface(
        "tank.both", "adds", "level", "level", "N", "m", x, y, y - 0.1, y + 0.2, x[::8], np.full(8, 0.125), 30.0, 1.5,
        x[::16], [Formula("product", "0.5 level speed", {}, 1.6, 4)] if formulas else [], second="speed",
        second_unit="m/s", middle=1.0, across=across, values=values, lowest=values - 0.3, highest=values + 0.3,
        within=within, samples=samples, been=x, knots_across=across,
    )  # fmt: skip


def test_laws_that_were_learned() -> None:
    outcome = Learning("learned", nearest=["not shown"])
    laws = [learned(), learned(2.0, False, "shaft.cogging"), surface()]
    page = learned_page(laws, outcome, "Three laws.", ["the law file has all"], None, "vaneloop learn", "a/tank.csv")
    approve("learned", outline(page))
    assert "Formulas" not in outline(learned_page([surface(False)], outcome, "One.", []))


@pytest.mark.parametrize(("verdict", "tone"), [("none", "good"), ("named", "neutral"), ("unknown", "bad")])
def test_nothing_was_learned(verdict: str, tone: str) -> None:
    outcome = Learning(verdict, nearest=["outflow of level", "inflow of time"])
    page = learned_page([], outcome, "None.", [], by_log(False, False), "", "tank.csv")
    text = outline(page)
    assert (page.title, page.tone) == ("Learning from tank.csv", tone)
    assert "## What came nearest\noutflow of level, inflow of time.\n" in text
    assert "## Log by log" in text and "## Measured and modelled" in text
    assert "What came nearest" not in outline(learned_page([], Learning(verdict), "", []))


# ---------------------------------------------------------------- fleets and campaigns

DAY = 86400.0
BEGIN = 1767225600.0  # 2026-01-01


def over_time(engine: str, kind: str, n: int = 12, **trend: Any) -> Series:
    """A quantity of an engine every 30 days."""
    t = BEGIN + 30.0 * DAY * np.arange(n)
    y = 1.0 + 0.02 * np.arange(n) ** 1.5
    found = {"kind": kind, "p": 1e-5, "onset": t[3] + 1.0, "onset_low": t[2], "onset_high": t[4], "rate": 0.31,
             "rate_low": 0.25, "rate_high": 0.39, "now": 1.7234, "limit": 2.5, "limit_time": t[-1] + 400 * DAY, 
             "limit_low": t[-1] + 300 * DAY, "limit_high": t[-1] + 600 * DAY, "limit_why": "", **trend}  # fmt: skip
    curve = (t[[0, 3, -1]], np.array([1.0, 1.02, 1.7])) if kind == "growth" else None
    keys = [f"{engine}{k:02d}abcdefgh" for k in range(n)]
    return Series(engine, "linkage.vgv1_play", "deg", t, y, 0.01 + 0.001 * np.arange(n), keys, t > t[1], 1.0, 0.3,
                  "nominal", found, curve)  # fmt: skip


def fleet(**more: Any) -> FleetView:
    """Three engines: one lacks an effect, two change, one is odd."""
    lack = {"stage": "actuator", "first": BEGIN, "last": BEGIN + 90 * DAY, "key": "0123456789", "able": 20}
    known: dict[str, Any] = {
        "name": "runs/fleet", "engines": ["e1", "e2", "e3"], "statuses": {"done": 40, "failed": 2},
        "verdicts": {"e1": {"none": 20, "missing": 5}, "e2": {"none": 15}},
        "lacks": [
            {"engine": "e1", "effect": "dip", "named": 12, "share": 0.6, "probability": 0.913, "lacks": True, **lack},
            {"engine": "e2", "effect": "dip", "named": 1, "share": 0.05, "probability": 0.5, "lacks": False, **lack},
            {"engine": "e2", "effect": "grip", "named": 14, "share": 0.7, "probability": 0.5, "lacks": False, **lack},
        ],
        "series": [
            over_time("e1", "growth"),
            over_time("e2", "step", p=1e-9, limit=None, limit_time=None, limit_why="beyond the limit"),
            over_time("e3", "none"), over_time("e3", "growth", p=1e-4, rate=0.0, limit_high=None, now=np.inf),
        ],
        "outliers": [{"engine": "e3", "quantity": "linkage.vigv_lc", "value": 1.5, "sisters": 1.1, "unit": "mm",
                      "p": 0.0003}],
        "coverage": [
            {"engine": "e1", "stage": "actuator", "effect": "heat", "logs": 5, "of": 25, "needs": "warm oil"},
            {"engine": "e2", "stage": "actuator", "effect": "heat", "logs": 15, "of": 15, "needs": "warm oil"},
            {"engine": "e2", "stage": "servo", "effect": "", "logs": 21, "of": 21, "needs": ""},
        ],
        "refused": [{"engine": "e2", "path": f"/logs/{k}.csv", "status": "failed", "reason": "no time"}
                    for k in range(203)],
        "span": (BEGIN, BEGIN + 330 * DAY),
    }  # fmt: skip
    return FleetView(**(known | more))


def test_a_fleet() -> None:
    view = fleet()
    approve("fleet", outline(fleet_page(view, "vaneloop fleet report", "logs")))
    assert view.keys() == sorted(["0123456789", "e104abcdefgh", "e204abcdefgh", "e304abcdefgh"])
    told = view.json()
    assert told["trends"][2]["now"] is None and told["trends"][1]["of"] == "nominal" and told["schema"] == 1
    assert [t["engine"] for t in told["trends"]] == ["e2", "e1", "e3"] and len(told["lacks"]) == 1
    assert over_time("e1", "growth", onset=BEGIN + 9999 * DAY).first() == "e111abcdefgh"
    assert over_time("e1", "growth", onset=0.0).first() == "e100abcdefgh"


def test_a_healthy_fleet_and_one_without_answers() -> None:
    empty: dict[str, Any] = {"lacks": [], "series": [], "outliers": [], "coverage": [], "refused": []}
    healthy = fleet_page(fleet(**empty, engines=["e1"]))
    approve("fleet_healthy", outline(healthy))
    assert fleet_page(fleet(**empty, verdicts={})).tone == "bad"
    assert fleet(**empty, verdicts={"e1": {}}).sentence() == "No log of the fleet could be diagnosed."
    assert not fleet(**empty).found and fleet(**(empty | {"outliers": [{"engine": "e3"}]})).found
    assert [fleet(**(empty | {k: getattr(fleet(), k)})).found for k in ("lacks", "series", "outliers", "coverage")] == [
        True
    ] * 3 + [False]
    many = [{"engine": f"e{k}", "quantity": "q", "value": 1.0, "sisters": 2.0, "unit": "mm", "p": 0.1} for k in (1, 2)]
    assert fleet(outliers=many, series=[], lacks=[]).sentence() == (
        "Of 3 engines 0 lack an effect in the model, 0 change over time, 2 are unlike their fleet peers."
    )
    effects = [fleet().lacks[0] | {"effect": f"f{k:02d}", "named": k} for k in range(26)]
    figure = fleet_page(fleet(lacks=effects)).figures[0]
    assert figure["data"][0]["x"] == [f"f{k:02d}" for k in range(25, 1, -1)] and figure["data"][0]["y"] == ["e1"]
    figures = fleet_page(fleet(series=[over_time(f"e{k}", "step") for k in range(14)], lacks=[])).figures
    assert len(figures) == 12
    assert [day(v) for v in (None, np.nan, BEGIN, 1e18)] == ["–", "–", "2026-01-01", "later than any date"]


def test_the_page_of_one_log_of_a_fleet() -> None:
    depth = {"depth": {"value": 0.5, "low": 0.4, "high": 0.6, "unit": "MPa"}}
    answer = {
        "log": "/logs/a.csv", "verdict": "missing", "notes": ["Short."],
        "stages": [{"stage": "actuator", "verdict": v, "signal": "x_lvdt", "error_before": 0.6, "error_after": 0.1,
                    "noise_floor": 0.05, "unit": "mm"} for v in ("none", "unknown")],
        "effects": [{"effect": e, "stage": "actuator", "probability": 0.9, "rivals": r, "parameters": depth}
                    for e, r in (("dip", ["leak", "hold"]), ("grip", []))],
        "nominal": [{"stage": "linkage", "parameter": "lc", "value": 1.1, "low": 1.0, "high": 1.2, "table": 1.05,
                     "tolerance": 0.1, "unit": "mm"}],
    }  # fmt: skip
    approve("fleet_log", outline(log_page("0123456789abcdef", answer)))
    bare = {"log": "b", "verdict": "none", "stages": [], "effects": []}
    tones = [log_page("k", bare | {"verdict": v}).tone for v in ("none", "missing", "unknown", "other")]
    assert tones == ["good", "neutral", "bad", "neutral"] and log_page("k", bare).parts == []


def requirement(**more: Any) -> Requirement:
    known: dict[str, Any] = {"expected": "vigv within 2 deg", "trials": 64, "broken": 0, "unit": "deg", "least": 0.3,
             "median": 1.1, "share": 0.15, "searched": 0.2, "held": True}  # fmt: skip
    return Requirement(**(known | more))


def group(name: str = "start.shipped.own", **more: Any) -> GroupView:
    scenario, calibration, firmware = name.split(".")
    known: dict[str, Any] = {
        "name": name, "scenario": scenario, "calibration": calibration, "firmware": firmware, "trials": 64, "lost": 0,
        "failed": 0, "low": 0.0, "high": 0.045, "requirements": [requirement()], "shares": [0.15, 0.8, 0.4, 0.4],
        "points": [[0.5, 0.5]], "worst": [0.0123456, 40.0], "least": 0.1, "by_search": True, "runs": 30, "seen": [],
        "state_hash": "ab12", "saved": "out/worst", "command": "vaneloop inject start", "same": True,
        "first": [0.1234, 0.6], "total": [0.2, 0.7],
    }  # fmt: skip
    return GroupView(**(known | more))


def campaign(groups: list[GroupView], allowed: float | None = None) -> CampaignView:
    varied = [
        {"name": "play", "unit": "mm", "low": 0.010123456, "high": 0.02},
        {"name": "oil", "unit": "degC", "low": -40.0, "high": 60.0},
    ]
    texts = {"R-1": "The vane stays", "R-2": "Nothing verifies it", "R-3": "No fault comes"}
    return CampaignView("Starts", "runs/1", "1.2.3", varied, 0.95, allowed, "Sobol", 7, groups, texts=texts)


def test_a_requirement_holds_where_each_claim_that_verifies_it_does() -> None:
    two = [
        requirement(ids=["R-1"], high=0.04),
        requirement(expected="no fault", broken=1, high=0.07, ids=["R-3", "R-1"]),
    ]
    view = campaign([group(requirements=two), group("b.c.d", requirements=two[:1])])
    found = {r.id: r for r in view.traced}
    assert [(r.holds, len(r.verified_by)) for r in found.values()] == [(False, 3), (False, 0), (False, 1)]
    assert found["R-1"].verified_by[-1] == ("b.c.d", "vigv within 2 deg")
    assert [r["id"] for r in view.json()["requirements"]] == ["R-1", "R-2", "R-3"] and "texts" not in view.json()
    for allowed, holds in ((0.05, [False, False, False]), (0.07, [True, False, True])):
        assert [r.holds for r in campaign(view.groups, allowed).traced] == holds
    assert [r.holds for r in campaign([group(requirements=two[:1])]).traced] == [True, False, False]
    assert not campaign([group(requirements=two[:1], lost=1)]).traced[0].holds


def test_a_campaign_that_holds() -> None:
    view = campaign([group(), group("stop.soft.mine", by_search=False, runs=0, least=0.05, trials=32)])
    approve("campaign", outline(campaign_page(view, "vaneloop campaign")))
    assert [g["passed"] for g in view.json()["groups"]] == [True, True] and view.json()["passed"] is True
    assert not {"points", "shares"} & view.json()["groups"][0].keys() and view.json()["schema"] == 1


def test_a_campaign_that_is_broken() -> None:
    broken = [
        requirement(),
        requirement(expected="no fault", broken=3, unit="", least=None, median=None, searched=None, held=None),
    ]
    view = campaign([
        group(failed=3, lost=1, low=0.01, high=0.13, requirements=broken, least=-0.25,
              seen=["at 3 s: fault", "at 4 s: abort"], first=[], total=[],
              failures=[FailedMachine(f"00000{k}", -0.2, f"out/failed/00000{k}.toml", "vaneloop inject", k == 1)
                        for k in (1, 2)]),
        group("stop.soft.mine", by_search=False, same=False, total=[0.2, 1.2],
              counted="30 of 64 samples fail"),
        group("rare.soft.mine", by_search=False, low=1e-5, high=1e-3,
              rare=Rare(1.2e-4, 1e-5, 1e-3, 900, [{"margin": 0.1, "share": 0.1, "variation": 0.2},
                                                  {"margin": 0.0, "share": 0.0012, "variation": 0.3}], True)),
    ])  # fmt: skip
    approve("campaign_broken", outline(campaign_page(view)))


def test_what_a_group_of_a_campaign_needs_to_pass() -> None:
    never, some = campaign([]), campaign([], 0.05)
    assert never.passed(group()) and some.passed(group())
    assert not never.passed(group(lost=1)) and not never.passed(group(same=False))
    for same in (True, False):
        assert some.passed(group(failed=1, failures=[FailedMachine("0", -0.2, "f", "c", same)])) == same
    assert not some.passed(group(lost=1)) and not some.passed(group(same=False))
    for bad in (requirement(broken=1), requirement(held=False)):
        assert not never.passed(group(requirements=[requirement(), bad])) and some.passed(group(requirements=[bad]))
    assert never.passed(group(high=0.9)) and some.passed(group(high=0.05)) and not some.passed(group(high=0.051))
    assert not requirement(held=None).fails
    assert "2 of 2 combinations" in campaign([group(), group()], 0.05).sentence()
    said = campaign([group(), group("a.b.c", least=-0.5, high=0.2)], 0.05).sentence()
    assert said == (
        "1 of 2 combinations of scenario, calibration and firmware pass (at most 0.05 of the machines may fail); a.b.c "
        "is broken most, with a least margin of -0.5 of what is allowed."
    )
    assert "is broken most" not in campaign([group(least=0.0)]).sentence()


# ---------------------------------------------------------------- design of servo, schedule and strategies


def response(n: int, size: float) -> Any:
    """A run of the servo: piston behind its demand, the LVDT and the vanes behind the piston."""
    t = np.arange(n) * 0.01
    x_dem = 0.02 + size * np.minimum(t, 0.3)
    x = x_dem - 0.2 * size * np.exp(-3.0 * t)
    return SimpleNamespace(t=t, x_dem=x_dem, x=x, x_lvdt=x - 1e-5, x_vane=x - 2e-4, i=0.02 * np.exp(-t))


def design(disk: float = 0.9, unstable: bool = False, ok: bool = True, behind: float = 0.0) -> Any:
    """A loop of an integrator with delay, so far ``behind`` (rad), and all that was asked of it."""
    omega = np.geomspace(1.0, 3000.0, 200)
    s = 1j * omega
    sampled = 20.0 * (1.0 + 2.0 / s) / s * np.exp(-0.01 * s - 1j * behind) / (1.0 + s / 400.0)
    at = {60.0: 1, 4.0: int(np.argmin(np.abs(np.abs(sampled) - 4.0))), 1e-3: -2}  # just where drawing begins and ends
    for size, k in at.items():
        sampled[k] = -1j * size
    curves = {
        "omega": omega, "sampled": sampled, "continuous": sampled * np.exp(0.001 * s), "step_bare": response(90, 0.01),
        "step_drawn": response(90, 0.02), "ramp": response(70, 0.03), "step_t": np.arange(20) * 0.02,
        "step_linear": 1.0 - np.exp(-np.arange(20) * 0.3),
        "play": {"lvdt": response(501, 0.01), "valve": response(450, 0.02), "vanes": response(400, 0.03)},
    }  # fmt: skip
    checks = [SimpleNamespace(name="gain margin", value=9.1, limit=8.0, unit="dB", ok=True, at="hot"),
              SimpleNamespace(name="overshoot", value=25.0, limit=20.0, unit="%", ok=ok, at="cold"),
              SimpleNamespace(name="hunting", value=0.2, limit=0.05, unit="mm", ok=ok, at="worn")]  # fmt: skip
    some = {"gap": 0.1, "unit": "mm", "predicted_hz": 2.1, "harmonic_amplitude": 0.06, "harmonic_hz": 1.6,
            "simulated_amplitude": 0.061, "simulated_hz": 1.59, "without_integral": None}  # fmt: skip
    play = [SimpleNamespace(site=site, predicted_amplitude=a, grazing=g, **some)
            for site, a, g in (("lvdt", 0.05, True), ("valve", 0.8, False), ("vanes", None, False))]  # fmt: skip
    return SimpleNamespace(
        gains=SimpleNamespace(kp=16.0, ki=40.0, kff=3.25), curves=curves, checks=checks, ok=ok, play=play,
        nominal=SimpleNamespace(crossover_hz=3.2, gain_margin_db=10.44, phase_margin_deg=61.26, disk_margin=disk),
        worst={"gain_margin_db": 9.1, "phase_margin_deg": 52.5, "disk_margin": 0.87},
        step={} if unstable else {"overshoot": 1.0},
    )  # fmt: skip


def test_a_design_of_the_servo(monkeypatch: pytest.MonkeyPatch) -> None:
    pages = written(monkeypatch)
    assert design_page(design(), "d.html") == Path("d.html")
    approve("design", outline(pages[0]))


def test_a_design_that_misses_its_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    pages = written(monkeypatch)
    assert design_page(design(2.5, True, False, 0.6), "d.html") == Path("d.html")
    text = outline(pages[0])
    approve("design_unstable", text)
    design_page(design(0.0), "d.html")
    assert "disk margin 2.50" in text and "disk margin 0" not in outline(pages[1])


def link(k: int, name: str, n: int = 13) -> LinkChange:
    """A stage whose error falls from as first built to as it is to adjusted."""
    v = np.linspace(-1.0, 1.0, n) * (k + 1)
    states = ("initial", "built", "adjusted", "extension", "retraction")
    figures = [{s: c + 0.1 * i + k for i, s in enumerate(states)} for c in (-0.3, 0.2, 0.7)]
    return LinkChange(
        name, 50.0 + k, 51.0 + k, 90.5 + k, 52.25 + k, 91.0 + k, 3.0 * v, 2.0 * v, v, v + 0.1, v - 0.1, *figures
    )


def loop_of(name: str, base: Array) -> MeasuredLoop:
    """A loop 1.6 deg wide; some of its samples are in the gap, and its stroke goes beyond the stops."""
    stroke = np.linspace(-2.0, 50.0, 53)
    x = np.linspace(0.5, 47.5, 300)
    side = np.where(np.arange(300) % 3 == 2, 0, 1 - 2 * (np.arange(300) % 2))
    y = np.interp(x, stroke, base) + 0.8 * side
    return MeasuredLoop(name, 1.6123, 0.0004, 0.1, 51.234, 90.567, 0.0212, 0.03, None, 0.0, (0.0, 48.0),
                        (1.0, 47.0), stroke, base + 0.8, base - 0.8, base, (x, y, side))  # fmt: skip


def scheduled(stages: int = 2, loops: bool = True) -> ScheduleResult:
    """A schedule for the first stages of the machine that is shipped."""
    table = load_geometry()
    names = table.vanes[:stages]
    built = table.model_copy(update=dict.fromkeys(table.vanes[stages:]))
    adjusted = geometry_with(built, {names[-1]: {"lb": built.stage(names[-1]).lb.value + 1.0}})
    speed = np.linspace(40.0, 100.0, 13)
    target = np.stack([0.6 * (speed - 40.0) - 10.0 + k for k in range(stages)], axis=1)
    strokes = np.array([speed, 0.7 * (speed - 40.0) + 1.0, 0.7 * (speed - 40.0) - 1.0, 0.7 * (speed - 40.0)])
    angles = np.rad2deg(vane_angles(np.linspace(-2.0, 50.0, 53) * 1e-3, built))
    found = {"vigv": loop_of("vigv", angles[:, 0] + 0.25)} if loops else {}
    unread: Any = None  # schedules and options
    return ScheduleResult(
        speed, target, strokes, [link(k, n) for k, n in enumerate(names)], found, adjusted, built,
        unread, unread, "run.csv", "here", ["The first.", "The second."] if loops else [],
    )  # fmt: skip


def test_a_schedule_with_a_measured_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    pages = written(monkeypatch)
    assert schedule_page(scheduled(), "s.html", "vaneloop schedule") == Path("s.html")
    approve("schedule", outline(pages[0]))


def test_a_schedule_of_one_stage_without_a_log(monkeypatch: pytest.MonkeyPatch) -> None:
    pages = written(monkeypatch)
    schedule_page(scheduled(1, False), "s.html")
    approve("schedule_one", outline(pages[0]))


def strategies() -> tuple[tuple[Scenario, ...], dict[tuple[str, str], Outcome]]:
    """Two machines, each under all strategies for 60 s."""
    rows = (Scenario("nominal"), Scenario("all together", 2.4, 0.5, 3.0, 0.15))
    t: Any = np.arange(600) * 0.1
    outcomes = {}
    for i, row in enumerate(rows):
        for k, name in enumerate(STRATEGIES):
            size = (1.0 + i) / (1.0 + k)
            n_r = 70.0 + 20.0 * np.sin(0.2 * t)
            angle = np.stack([n_r - 60.0 + size * np.cos(t), n_r - 65.0 + k], axis=1)
            figures = {v: {"mean_abs": size * f, "max_abs": 3.0 * size * f,
                           "mean_abs_99_100": None if k == 0 else 0.5 * size * f}
                       for v, f in (("vigv", 1.0), ("vgv1", 0.8))}  # fmt: skip
            outcomes[row.name, name] = Outcome(
                row.name, name, t, n_r, angle - 1.0, angle, 20.0 + size * np.sin(t), t, t, 0.1 * size * t,
                0.01 * size * t, figures, 400.0 + 10.0 * k, 1.0, 30 + k, 7.0 + k, 0,
            )  # fmt: skip
    return rows, outcomes


def failed(name: str, during: str, step: float) -> Failure:
    return Failure(name, during, ("vigv",), 40.0, step, 0.31, 2, 0.44, 0.55)


def test_strategies_beside_each_other(monkeypatch: pytest.MonkeyPatch) -> None:
    pages = written(monkeypatch)
    rows, outcomes = strategies()
    plant: Any = SimpleNamespace(vanes=("vigv", "vgv1"), geometry=load_geometry())
    goals = [
        {"goal": "error", "value": 3.04, "limit": 3.0, "held": True},
        {"goal": "travel", "value": 1.2, "limit": 1.15, "held": False},
    ]
    run = outcomes["all together", "adaptive"]
    failures = [(failed("no signal", "at rest", 0.05), run), (failed("stuck", "at rest", 0.12), run),
                (failed("drift of 0.005 deg/s", "in motion", 0.1), run),
                (failed("other", "at rest", 0.01), run)]  # fmt: skip
    assert strategies_report(
        "s.html", rows, plant, outcomes, failures, goals, "adaptive", "vaneloop strategies"
    ) == Path("s.html")
    approve("strategies", outline(pages[0]))
    strategies_report("s.html", rows[:1], plant, outcomes, [], goals[:1], "dual")
    text = outline(pages[1])
    assert "All 1 goals are met." in pages[1].verdict and pages[1].tone == "good"
    assert "fail" not in text and "with 1.00 of the travel" in pages[1].verdict
    assert text.count("“true”") == 2 and "y 600 from 0 to 0" in text  # neither growth nor wear


def clearances(stage: str, k: int) -> ClearanceStudy:
    parts = {j: 0.1 * (i + 1) + k for i, j in enumerate(WORDS)}
    x = np.linspace(0.0, 48.0, 25)
    around = np.linspace(-180.0, 180.0, 25)
    return ClearanceStudy(
        stage, 1.6, 1.61 + k, Clearances(0.01, 0.02, 0.03, 0.04, 0.55 + k, 0.06), parts, parts,
        {j: None if j == "ring" else 2.0 + k for j in WORDS},
        {"across_links": 1.6123, "tilt": -0.0212}, x, 0.5 * x - 0.8, 0.5 * x + 0.8 + 0.01 * x, 0.8 + 0.001 * x, around,
        1.6 * np.cos(np.deg2rad(around)) + k,
    )  # fmt: skip


def test_clearances_that_make_the_hysteresis(monkeypatch: pytest.MonkeyPatch) -> None:
    pages = written(monkeypatch)
    assert clearance_page([clearances("vigv", 0), clearances("vgv1", 1)], "c.html", "vaneloop clearance", 90.0) == Path(
        "c.html"
    )
    approve("clearance", outline(pages[0]))


@pytest.mark.parametrize("multibody", [True, False])
def test_the_mechanism_in_space(monkeypatch: pytest.MonkeyPatch, multibody: bool) -> None:
    pages = written(monkeypatch)
    x = np.linspace(0.0, 48.0, 25)
    planar = {"vigv": 0.9 * x - 10.0, "vgv1": 0.6 * x - 4.0}
    newton = {s: v - 1e-4 * x**1.5 * (k + 1) for k, (s, v) in enumerate(planar.items())}
    other = {s: v + 3e-9 * x for s, v in newton.items()} if multibody else {}
    assert spatial_page(SpatialCheck(x, planar, newton, other, []), "s.html", "vaneloop spatial") == Path("s.html")
    approve("spatial" if multibody else "spatial_newton", outline(pages[0]))
