"""The HTML pages: complete in one file, safe against hostile names, small for long runs, honest about gaps."""

from __future__ import annotations

import base64
import html
import json
import os
import re
import stat
from dataclasses import dataclass, field
from html.parser import HTMLParser

import numpy as np
import plotly.graph_objects as go
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hil.figures import error_figures
from tests.browser import open_to_all
from tests.conftest import ROOT, examples
from vaneloop.base.errors import InputError
from vaneloop.identification.regimes import Regime
from vaneloop.identification.results import Found, StageDiagnosis
from vaneloop.pages.engine_test import PAPER_TABLE_5, engine_test_report
from vaneloop.pages.failures import failure_map
from vaneloop.pages.figures import Line, Panel, bars, heat, histogram, loop, overlay, ranking, waterfall
from vaneloop.pages.page import Page
from vaneloop.pages.replay import replay_page
from vaneloop.pages.series import MAX_POINTS, decimate, distribution
from vaneloop.pages.story import falling, worths
from vaneloop.pages.style import THEMES, number

HOSTILE = "</script><img src=x onerror=alert(1)>&\"'\u2028"


class Elements(HTMLParser):
    """Collects the elements of a page and the text outside of scripts."""

    def __init__(self, source):
        super().__init__()
        self.tags, self.attributes, self.text, self._inside = [], [], [], None
        self.feed(source)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += attrs
        self._inside = tag

    def handle_endtag(self, tag):
        self._inside = None

    def handle_data(self, data):
        if self._inside not in ("script", "style"):
            self.text.append(data)


def embedded(source, name):
    return json.loads(re.search(rf'<script type="application/json" id="{name}">(.*?)</script>', source, re.S)[1])


def unpack(packed):
    return np.frombuffer(base64.b64decode(packed["bdata"]), dtype="<" + packed["dtype"]).astype(float)


def painted(value):
    """What the page's script makes of a figure in the light scheme, for Plotly's own validators."""
    if isinstance(value, str) and value.startswith("@"):
        return THEMES["light"][value[1:].split("/")[0]]
    if isinstance(value, dict):
        return value if "bdata" in value else {k: painted(v) for k, v in value.items()}
    return [painted(v) for v in value] if isinstance(value, list) else value


def full_page(name="vigv"):
    t = np.linspace(0, 100, 2000)
    page = Page(f"Replay of {name}", f"verdict {name}", subtitle=name, command=name, log=name, state_hash=name)
    page.tile(name, 0.5, name, name)
    page.section(name, name)
    page.text(name)
    page.table([name, "rms"], [[name, 0.5]], name)
    page.plot(overlay([Panel(name, [Line(name, t, np.sin(t), "measured")], band=0.1, marks={name: 0.2})], name), name)
    page.plot(histogram({name: np.sin(t)}, name, noise=0.1), name, half=True)
    page.plot(loop([Line(name, t, t)], name, name), name, half=True)
    page.plot(bars([name, "b"], {name: [1.0, None]}, name, marks={name: 0.5}), name)
    page.plot(waterfall([(name, 1.0), ("effect", 0.3), ("end", 0.2)], name, floor=0.1), name)
    page.plot(ranking([name, "b"], [0.9, 0.1], name, highlight=[name], low=[0.8, 0.0], high=[0.95, 0.2]), name)
    page.plot(heat([[1.0, None], [0.2, 0.3]], [name, "c"], [name, "r"], name, name, name), name)
    return page


# ---------------------------------------------------------------- the file


def test_the_page_needs_no_network_and_forbids_it():
    elements = Elements(full_page().html())
    loads = [v for k, v in elements.attributes if k in ("src", "href", "srcset", "data") and not v.startswith("#")]
    assert loads == []
    policy = next(v for k, v in elements.attributes if k == "content" and "default-src" in v)
    assert "default-src 'none'" in policy and "http" not in policy
    script = (ROOT / "vaneloop" / "pages" / "page.js").read_text(encoding="utf-8")
    assert "sendChartToCloud" not in script and "modeBarButtons:" in script


def test_plotly_is_inlined_once_and_the_charset_is_declared():
    source = full_page().html()
    assert source.count("* plotly.js v") == 1
    assert source.startswith("<!doctype html>") and '<meta charset="utf-8">' in source[:200]


def test_hostile_names_stay_text():
    source = full_page(HOSTILE).html()
    harmless = full_page("x").html()
    assert Elements(source).tags == Elements(harmless).tags
    assert "<img" not in re.sub(r"<script>.*?</script>", "", source, flags=re.S)
    assert "onerror" not in {k for k, _ in Elements(source).attributes}
    assert HOSTILE in "".join(Elements(source).text)  # shown as it is called
    trace = embedded(source, "figures")[0]["data"][0]
    assert "<" not in trace["name"] and html.unescape(trace["name"]) == HOSTILE


@settings(max_examples=examples(30), deadline=None)
@given(st.text(max_size=40))
def test_any_text_leaves_the_structure_of_the_page(name):
    page = Page(name, name, command=name, log=name)
    page.section(name, name)
    page.table([name], [[name]])
    page.plot(loop([Line(name, [0, 1], [0, 1])], name, name), name)
    elements = Elements(page.html())
    assert elements.tags.count("script") == 4 and elements.tags.count("figure") == 1
    assert len(embedded(page.html(), "figures")) == 1


@pytest.mark.parametrize("index", range(7))
def test_plotly_accepts_every_kind_of_plot(index):
    go.Figure(painted(full_page().figures[index]))


def test_every_colour_role_exists_in_both_schemes():
    assert THEMES["light"].keys() == THEMES["dark"].keys()
    used = set(re.findall(r'"@([a-z0-9]+)', json.dumps(full_page().figures)))
    assert used <= THEMES["light"].keys() and {"measured", "noise", "error"} <= used


def test_a_width_sets_no_colour():
    """So colours that a wide screen reads are read on a phone, too (`tests/browser.py`)."""
    pages = ROOT / "vaneloop" / "pages"
    of_width = re.findall(r"@media \(max-width.*?\}\}", (pages / "page.css").read_text("utf-8"), re.S)
    script = (pages / "page.js").read_text("utf-8")
    narrow = re.findall(r"if \(narrow\) \{.*?^    \}|if \(narrow [^{]*;$", script, re.S | re.M)
    assert len(of_width) >= 2 and len(narrow) >= 2
    assert not [w for w in (*of_width, *narrow) if re.search(r"colou?r|background|--|opacity", w)]


def test_a_plotly_figure_can_be_added():
    page = Page("t", "v")
    page.plot(go.Figure(go.Scatter(x=[1, 2], y=[3, float("nan")])))
    assert embedded(page.html(), "figures")[0]["data"][0]["type"] == "scatter"


def test_writing_is_atomic_and_readable_by_others(tmp_path):
    target = tmp_path / "réport.html"
    target.write_text("old")
    assert full_page("Grad °").write(target) == target
    assert "Grad °" in target.read_text(encoding="utf-8")
    assert [f.name for f in tmp_path.iterdir()] == [target.name]
    mask = os.umask(0)
    os.umask(mask)
    assert stat.S_IMODE(target.stat().st_mode) == 0o666 & ~mask


def test_a_failed_write_leaves_the_old_page(tmp_path, monkeypatch):
    target = tmp_path / "r.html"
    target.write_text("old")

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(InputError, match="No space left"):
        Page("t", "v").write(target)
    assert target.read_text() == "old" and len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("where", ["missing/r.html", "file/r.html", ".", "a\0b.html"])
def test_a_place_that_cannot_be_written_is_refused_in_one_line(tmp_path, where):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError) as refusal:
        Page("t", "v").write(str(tmp_path / where))
    assert str(refusal.value).startswith(f"cannot write {tmp_path / where}: ") and "\n" not in str(refusal.value)


def test_the_same_page_twice_is_the_same_file(tmp_path):
    a, b = full_page().write(tmp_path / "a.html"), full_page().write(tmp_path / "b.html")
    assert a.read_bytes() == b.read_bytes()


# ---------------------------------------------------------------- numbers and lines


@pytest.mark.parametrize(
    ("value", "text"),
    [(None, "–"), (float("nan"), "–"), (0.0, "0"), (0.55, "0.55"), (2.17, "2.17"), (0.12345, "0.123"),
    (1234.5, "1,234"), (3000.0, "3,000"),
     (30000, "30,000"), (1e-7, "1.00e-07"), (-0.5, "-0.5"), (True, "yes"), ("vigv", "vigv"),
     (np.float64(11.72), "11.7")],
)  # fmt: skip
def test_numbers_read_as_a_person_writes_them(value, text):
    assert number(value) == text


@settings(max_examples=examples(60), deadline=None)
@given(st.integers(1, 40000), st.integers(10, 6000), st.integers(0, 2**32 - 1))
def test_a_thinned_line_keeps_its_extremes_and_its_limit(n, limit, seed):
    y = np.random.default_rng(seed).normal(size=n)
    x = np.arange(n) * 0.01
    u, v = decimate(x, y, limit)
    assert u.size <= max(limit, 3) and np.all(np.diff(u) > 0)
    assert v.min() == y.min() and v.max() == y.max()
    assert u[0] == x[0] and u[-1] == x[-1]
    assert np.array_equal(v, y[np.round(u * 100).astype(int)])


def test_a_spike_of_one_sample_survives():
    y = np.zeros(3_000_000)
    y[1_234_567] = 1.0
    x, v = decimate(np.arange(y.size) * 1e-3, y)
    assert v.max() == 1.0 and x[v.argmax()] == 1234.567


@settings(max_examples=examples(40), deadline=None)
@given(st.lists(st.integers(-8000, 8000).map(lambda k: k / 8), min_size=1, max_size=60))
def test_a_distribution_is_drawn_in_steps(values):
    """At every place the line stands at the share of values that are not above it, far values too."""
    drawn = overlay([Panel("share", [Line("all", *distribution(values))])])["data"][0]
    x, y = unpack(drawn["x"]), unpack(drawn["y"])
    assert np.all((np.diff(x) == 0.0) | (np.diff(y) == 0.0)) and np.isfinite(y).all()
    for v in values:
        assert y[x == v].max() == pytest.approx(np.mean(np.array(values) <= v))


def test_float_noise_adds_no_digits_to_a_number():
    assert [number(v, 6) for v in (497.27000000000004, 0.1 + 0.2, 1.68 * (1 + 2e-16))] == ["497.27", "0.3", "1.68"]


@pytest.mark.parametrize("n", [500, 100_000])
def test_nan_and_holes_in_time_break_the_line(n):
    t = np.arange(n) * 0.01
    y = np.sin(t)
    y[n // 4 : n // 3] = np.nan
    keep = (t < t[n // 2]) | (t > t[n // 2 + n // 10])
    u, v = decimate(t[keep], y[keep])
    inside = (u > t[n // 2] - 0.005) & (u < t[n // 2 + n // 10])
    assert np.isnan(v[inside]).any() and not np.isfinite(v[inside]).any()
    dead = (u > t[n // 4 + n // 50]) & (u < t[n // 3 - n // 50])
    assert np.isnan(v[dead]).all() and dead.any()


@pytest.mark.parametrize("values", [[], [1.0], [np.nan] * 20000, [np.inf, 1.0, -np.inf]])
def test_poor_series_do_not_break_a_page(values):
    x = np.arange(len(values), dtype=float)
    page = Page("t", "v")
    page.plot(overlay([Panel("a", [Line("b", x, values)])]))
    page.plot(loop([Line("b", x, values)], "x", "y"))
    page.plot(histogram({"b": values}, "x"))
    page.plot(bars([], {}, "y"))
    page.plot(ranking([], [], "p"))
    page.plot(heat([[None]], ["a"], ["b"], "deg"))
    assert len(embedded(page.html(), "figures")) == 6


def test_time_stays_exact_enough_to_zoom_into():
    t = 1e6 + np.arange(2000) * 0.001  # s; single precision would round to 0.06 s
    assert np.abs(unpack(overlay([Panel("a", [Line("b", t, t * 0)])])["data"][0]["x"]) - t).max() < 1e-5


def test_panels_share_one_time_axis():
    t = np.arange(10.0)
    figure = overlay([Panel("a", [Line("l", t, t)]), Panel("b", [Line("l", t, t)]), Panel("c", [Line("m", t, t)])])
    assert {d["xaxis"] for d in figure["data"]} == {"x"}
    assert [d["yaxis"] for d in figure["data"]] == ["y", "y2", "y3"]
    domains = [figure["layout"][k]["domain"] for k in ("yaxis", "yaxis2", "yaxis3")]
    assert all(upper[0] > lower[1] for upper, lower in zip(domains, domains[1:], strict=False))


def test_a_thinned_loop_stays_on_the_path_and_covers_it():
    t = np.arange(400_000) * 0.01
    angle = 0.3 * t + np.where(np.sin(0.01 * t) > 0.99, 5.0, 0.0)
    x, y = np.cos(angle), 2 * np.sin(angle)
    trace = loop([Line("a", x, y)], "x", "y")["data"][0]
    u, v = unpack(trace["x"]), unpack(trace["y"])
    assert u.size <= MAX_POINTS
    drawn = np.isfinite(u)
    assert np.abs(u[drawn] ** 2 + (v[drawn] / 2) ** 2 - 1).max() < 1e-5
    around = np.unwrap(np.sort(np.arctan2(v[drawn] / 2, u[drawn])))
    assert np.diff(around).max() < 0.02


@pytest.mark.parametrize("n", [300, 300_000])
def test_a_gap_in_the_data_is_a_gap_in_the_loop(n):
    x = np.linspace(0, 1, n)
    y = x.copy()
    y[n // 3 : n // 2] = np.nan
    trace = loop([Line("a", x, y)], "x", "y")["data"][0]
    u = unpack(trace["x"])
    step = np.abs(np.diff(u))
    assert np.nanmax(step) < 0.02 and np.isnan(u).any()


def test_a_long_dwell_takes_no_points_from_a_fast_motion():
    ramp = np.linspace(0, 1, 200)
    x = np.concatenate([np.zeros(200_000), ramp, np.ones(200_000), ramp[::-1]])
    trace = loop([Line("a", x, x**2)], "x", "y")["data"][0]
    u = unpack(trace["x"])
    assert np.nanmax(np.abs(np.diff(u))) < 0.011


def test_a_histogram_shares_out_all_samples():
    e = np.concatenate([np.random.default_rng(0).normal(size=5000), [1e6, np.nan]])
    assert unpack(histogram({"e": e}, "x")["data"][0]["y"]).sum() == pytest.approx(100, abs=1e-3)


def test_a_waterfall_hangs_each_fall_from_the_level_before():
    bar = waterfall([("base", 1.0), ("friction", 0.4), ("offset", 0.1), ("left", 0.1)], "rms")["data"][0]
    bottom = bar["base"][0]
    assert 0.0 < bottom < 0.1  # the axis is logarithmic
    assert bar["base"] == [bottom, 0.4, 0.1, bottom]
    assert bar["y"] == pytest.approx([1.0 - bottom, 0.6, 0.3, 0.1 - bottom])


def test_a_page_without_a_plot_has_no_script():
    page = Page("Engines", "Two engines.")
    page.table(["engine"], [["one"], ["two"]])
    assert "<script" not in page.html()


def test_the_worst_moment_of_a_failure_map_is_that_of_a_cell_that_it_shows():
    samples, ratio = np.array([500, 500, 12]), np.array([1.2, 3.0, 9.0])
    at = Regime(
        "x", "mm", "direction", "", np.array([-1.5, -0.5, 0.5, 1.5]), ratio, ratio, samples, ratio > 2.0, 0.5,
        np.array([1.0, 2.0, 3.0]),
    )  # fmt: skip
    figure = failure_map([at])
    assert figure["data"][0]["z"] == [[1.2, 3.0, None]]
    assert figure["layout"]["meta"]["worst"] == 2.0


def test_steps_are_named_by_what_they_add_and_what_they_drop():
    said = StageDiagnosis.__new__(StageDiagnosis)
    said.steps = [("nominal", 9.0), ("a + b", 3.0), ("a + b + c", 2.0), ("a + c", 1.0)]
    assert falling(said) == [
        ("nominal", 9.0), ("+ a + b", 3.0), ("+ c", 2.0), ("− b", 1.0), ("noise floor", 1.0),
    ]  # fmt: skip
    said.steps = [("nominal", 9.0), ("+ a", 3.0), ("+ b", 1.2), ("without numerical error", 1.1)]
    assert [n for n, _ in falling(said)] == ["nominal", "+ a", "+ b", "without numerical error", "noise floor"]
    said.steps = [("nominal", 9.0), ("+ a", 1.201), ("without numerical error", 1.199)]  # nothing that a reader sees
    assert [n for n, _ in falling(said)] == ["nominal", "+ a", "noise floor"]


def test_an_effect_s_share_is_its_part_of_the_way_in_decades():
    said = StageDiagnosis.__new__(StageDiagnosis)
    said.steps, said.excess = [("nominal", 100.0)], 1.0
    said.effects = [Found("small", 1.0, {}, [], 0.0, fall=10.0), Found("great", 1.0, {}, [], 0.0, fall=100.0)]
    assert [(w.effect, w.without) for w in worths(said)] == [("great", 100.0), ("small", 10.0)]
    assert [w.share for w in worths(said)] == pytest.approx([1.0, 0.5])


# ---------------------------------------------------------------- replay and engine test


@dataclass(frozen=True)
class Channel:
    """As `hil.logs.Channel`."""

    t: np.ndarray
    values: np.ndarray


@dataclass(frozen=True)
class Result:
    """As `hil.replay.ReplayResult`."""

    log: str
    simulated_s: float
    wall_s: float
    state_hash: str
    t: np.ndarray
    model: dict
    target: dict
    measured: dict
    signals: list = field(default_factory=list)


def play(x, gap):
    """Lost motion of total width ``gap``."""
    y, s = np.empty_like(x), x[0]
    for i, v in enumerate(x):
        s = min(max(s, v - gap / 2), v + gap / 2)
        y[i] = s
    return y


def result(
    duration=300.0, rate=50.0, width=1.6, model_width=1.6, dual=True, log="run.csv", channels=("n_r", "x_lvdt", "vigv")
):
    """Rotor speed to and fro between 40 and 100 %, vanes with play, sensors with noise."""
    t = np.arange(int(duration * rate)) / rate
    rng = np.random.default_rng(0)
    n_r = 70 - 30 * np.clip(1.3 * np.cos(2 * np.pi * t / 60), -1, 0.998)
    target = 50 * (n_r - 40) / 60 - 10
    ahead = np.sign(np.gradient(n_r)) * 0.5 * model_width * 0.95 if dual else 0.0
    x = np.clip((target + 10 + ahead) / 1.05, 0, 48)
    model = {"n_r": n_r, "x_lvdt": x, "vigv": play(1.05 * x - 10, model_width)}
    noise = {"n_r": 0.02, "x_lvdt": 0.005, "vigv": 0.03}
    truth = model | {"vigv": play(1.05 * x - 10, width)}
    measured = {k: Channel(t, truth[k] + rng.normal(0, noise[k], t.size)) for k in channels}
    measured["n_dem"] = Channel(t, n_r)
    stage = {"n_r": ("engine", "%"), "x_lvdt": ("actuator", "mm"), "vigv": ("linkage", "deg")}
    signals = [error_figures(k, *stage[k], "measured", t, model[k], measured[k].values, n_r) for k in channels]
    signals.append(error_figures("vigv", "linkage", "deg", "schedule", t, model["vigv"], target, n_r, 0.0))
    return Result(log, duration, 0.1, "ab" * 32, t, model, {"vigv": target}, measured, signals)


def verdict(file):
    return re.search(r'<p class="verdict (\w+)">(.*?)</p>', file.read_text(encoding="utf-8")).groups()


def test_a_model_that_fits_is_said_to_fit(tmp_path):
    tone, text = verdict(replay_page(result(), "vaneloop replay run.csv").write(tmp_path / "r.html"))
    assert tone == "good" and "within the sensors" in text


def test_a_model_that_misses_hysteresis_is_said_to_miss_it_in_the_vane_angle(tmp_path):
    tone, text = verdict(replay_page(result(width=2.6)).write(tmp_path / "r.html"))
    assert tone == "bad" and "VIGV angle" in text and "times what sensor noise explains" in text


def test_a_log_with_a_demand_alone_makes_a_page(tmp_path):
    _, text = verdict(replay_page(result(channels=())).write(tmp_path / "r.html"))
    assert "no signal to hold the model against" in text


def test_a_log_with_a_hostile_name_makes_a_safe_page(tmp_path):
    source = replay_page(result(log="/tmp/<img src=x onerror=alert(1)>.csv")).write(tmp_path / "r.html").read_text()
    assert "img" not in Elements(source).tags


def test_a_run_of_three_thousand_seconds_stays_below_eight_megabytes(tmp_path):
    file = replay_page(result(3000.0, 100.0)).write(tmp_path / "r.html")
    assert file.stat().st_size < 8e6


def test_the_engine_test_stands_beside_the_paper(tmp_path):
    single, dual = result(rate=10.0, dual=False, channels=()), result(rate=10.0, channels=())
    file = engine_test_report(single, dual, PAPER_TABLE_5, tmp_path / "e.html")
    tone, text = verdict(file)
    words = " ".join(Elements(file.read_text(encoding="utf-8")).text)
    assert tone == "good" and "0.55" in text
    assert all(figure in words for figure in ("2.17", "0.55", "0.47", "1.6"))
    open_to_all(file, "engine-test")


def test_a_dual_schedule_that_misses_the_paper_is_not_called_good(tmp_path):
    worse = result(rate=10.0, dual=False, channels=())
    assert verdict(engine_test_report(worse, worse, None, tmp_path / "e.html"))[0] == "bad"


def test_a_stage_that_fails_under_one_condition_only_is_not_said_to_fail_by_what_is_noise() -> None:
    """1.03 noise floors over the whole log are none; the condition is what is told."""
    from vaneloop.identification.regimes import Located, Regime, StageFigures
    from vaneloop.pages.diagnosis import located_sentence

    whole = StageFigures("engine", "n_r", "%", 1.03, 1.03, 1.0, 8000)
    bins = [np.array(v) for v in ([1.0, 1.3], [1.0, 1.3], [4000, 4000], [False, True])]
    edges, moments = np.array([60.0, 70.0, 80.0]), np.array([1.0, 2.0])
    regime = Regime("n_r", "%", "rotor speed", "%", edges, *bins, 0.1, moments)
    x = Located("engine", None, np.ones(1), (whole,), (regime,), None)  # type: ignore[arg-type]
    said = located_sentence([x])
    assert "fails most" not in said and "1.03" not in said + x.verdict()
    assert "the engine subsystem fails at n_r: 1.3 %" in said and "rotor speed 70 to 80 %" in said
    clean = Located("engine", None, np.ones(1), (whole,), (), None)  # type: ignore[arg-type]
    assert located_sentence([clean]) == "Every subsystem fits its measurements to within the noise."


def test_a_stage_of_which_the_log_says_nothing_is_never_said_to_fit() -> None:
    """A log without a stroke tells nothing of servo and actuator: the sentence says so."""
    from vaneloop.identification.regimes import Located, StageFigures
    from vaneloop.identification.workflow import Diagnosis
    from vaneloop.pages.diagnosis import located_sentence, verdict_sentence

    fine, bad = (
        Located("engine", None, np.ones(1), (StageFigures("engine", "n_r", "%", r, r, 1.0, 8000),), (), None)  # type: ignore[arg-type]
        for r in (1.0, 3.0)
    )
    silent = {"servo": "no x_lvdt", "actuator": "no i_cmd"}
    end = "Cannot tell from this log: servo, actuator."
    assert located_sentence([fine], silent).startswith("Every observed subsystem fits")
    assert all(located_sentence([x], silent).endswith(end) for x in (fine, bad))
    for verdict in ("none", "missing"):
        assert verdict_sentence(Diagnosis(verdict, [], {}, silent, 1.0)).endswith(end)
    assert "every stage fits" not in verdict_sentence(Diagnosis("none", [], {}, silent, 1.0))


@given(st.floats(0.0, 1.0))
def test_words_on_a_cell_of_a_map_are_read_in_light_and_dark(level: float) -> None:
    """The contrast that WCAG 2 asks of small words, computed here anew from its definition."""
    from vaneloop.pages.style import THEMES, cell_role, heat_colour

    def light(colour: str) -> float:
        parts = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
        r, g, b = (p / 12.92 if p <= 0.03928 else ((p + 0.055) / 1.055) ** 2.4 for p in parts)
        return 0.2126 * r + 0.7152 * g + 0.0722 * b

    for theme, colours in THEMES.items():
        low, high = sorted((light(heat_colour(theme, level)), light(colours[cell_role(level)])))
        assert (high + 0.05) / (low + 0.05) > 4.5, (theme, level)


def test_every_cell_of_a_map_has_its_words_and_an_empty_one_none() -> None:
    cells, words = heat([[1.0, None], [0.0, 0.3]], ["a", "b"], ["c", "d"], "deg")["data"]
    assert cells["z"] == [[1.0, None], [0.0, 0.3]]
    assert list(zip(words["x"], words["y"], words["text"], strict=True)) == [
        ("a", "c", "1"), ("a", "d", "0"), ("b", "d", "0.3"),
    ]  # fmt: skip


def test_what_is_called_worst_is_the_worst_cell_of_the_map() -> None:
    """The most telling condition is not always the one with the greatest error."""
    from vaneloop.identification.regimes import Regime
    from vaneloop.pages.failures import failure_map, worst_cell

    def regime(name: str, ratio: list[float], samples: list[int]) -> Regime:
        n = len(ratio)
        edges, r = np.arange(n + 1.0), np.array(ratio)
        return Regime("x_lvdt", "mm", name, "s", edges, r, r, np.array(samples), r > 1.0, 0.5, 10.0 * r)

    mine = [regime("direction s", [2.0, 3.0], [99, 99]), regime("time", [1.0, 5.0, 9.0], [99, 99, 3])]
    assert worst_cell(mine) == (1, 1)
    assert failure_map(mine)["layout"]["meta"]["worst"] == 50.0
    assert "5 mm" in mine[1].told(1) and "time 1 to 2 s" in mine[1].told(1)


def test_a_name_at_the_beginning_of_a_sentence_stays_as_it_is_written() -> None:
    from vaneloop.pages.style import capital

    assert capital("x_lvdt is off") == "x_lvdt is off"
    assert capital("outflow.gain_of_oil: oil has been there") == "outflow.gain_of_oil: oil has been there"
    assert (
        capital("the actuator subsystem fails at x_lvdt.") == "The actuator subsystem fails at x_lvdt."
        and capital("") == ""
    )
