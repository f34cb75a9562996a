"""What pages are made of: colours, numbers, series, figures, sentences, the file; each against what it should be."""

from __future__ import annotations

import json
import math
import re
from dataclasses import dataclass, replace
from importlib.metadata import PackageNotFoundError
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from hil.figures import SignalError
from tests.conftest import ROOT, examples
from tests.page_outline import unpacked
from vaneloop.identification.regimes import Located, Regime, StageFigures
from vaneloop.identification.results import Found, StageDiagnosis
from vaneloop.identification.workflow import Diagnosis
from vaneloop.pages.by_log import short_names
from vaneloop.pages.diagnosis import located_sentence, located_tone, verdict_sentence
from vaneloop.pages.engine_test import _rise_and_fall
from vaneloop.pages.failures import failure_map, worst_cell
from vaneloop.pages.figures import Line, Panel, bars, heat, histogram, loop, overlay, ranking, waterfall
from vaneloop.pages.page import Page, Plot, _finite, _json, _version
from vaneloop.pages.replay import _error_lines, _ratio, _replay_verdict
from vaneloop.pages.run import _middle_curve, axis_title, loops, rotor_speed, signal_name, speed_lines
from vaneloop.pages.series import break_at_holes, decimate, distribution, packed, thin_path
from vaneloop.pages.story import (
    CANNOT,
    EXPLAINED,
    FAILS,
    FITS,
    MISSING,
    UNKNOWN,
    WORDS,
    doubt,
    extended_sentence,
    fall,
    falling,
    floors,
    jumps,
    stage_tone,
    together,
    untold,
    verdict_word,
    word,
    word_of_located,
    worths,
)  # fmt: skip
from vaneloop.pages.strategies import _SHOWN
from vaneloop.pages.style import THEMES, _luminance, _on, capital, cell_role, heat_colour, interval, number, painted

Array = np.ndarray

# ---------------------------------------------------------------- colours and numbers


def wcag(colour: str) -> float:
    """Relative luminance as WCAG 2 writes it."""
    parts = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    r, g, b = (p / 12.92 if p <= 0.03928 else ((p + 0.055) / 1.055) ** 2.4 for p in parts)
    return 0.2126 * r + 0.7152 * g + 0.0722 * b


@given(st.integers(0, 0xFFFFFF))
def test_luminance_is_that_of_wcag_and_words_are_black_or_white_by_contrast(value: int) -> None:
    colour = f"#{value:06x}"
    light = wcag(colour)
    assert _luminance(colour) == pytest.approx(light, abs=1e-4)
    on_black, on_white = (light + 0.05) / 0.05, 1.05 / (light + 0.05)
    if abs(on_black / on_white - 1.0) > 0.01:
        assert _on(colour) == ("#000000" if on_black > on_white else "#ffffff")


def test_luminance_of_single_colours() -> None:
    assert [_luminance(c) for c in ("#ff0000", "#00ff00", "#0000ff")] == pytest.approx([0.2126, 0.7152, 0.0722])
    assert _luminance("#000000") == 0.0 and _luminance("#ffffff") == pytest.approx(1.0)
    assert _luminance("#0a0a0a") == pytest.approx(10 / 255 / 12.92)
    assert _luminance("#0b0b0b") == pytest.approx(((11 / 255 + 0.055) / 1.055) ** 2.4)


def test_a_level_of_a_map_is_mixed_of_its_neighbours() -> None:
    for theme, c in THEMES.items():
        assert [heat_colour(theme, v) for v in (0.0, 0.5, 1.0)] == [c["heat0"], c["heat1"], c["heat2"]]
    assert heat_colour("light", 0.25) == "#f5d4b6"  # half-way from f4f7fa to f6b073; .5 goes to the even
    assert heat_colour("light", 0.75) == "#cc6a41"
    roles = [cell_role(k / 100) for k in range(101)]
    assert (
        roles[0] == "cell0"
        and sorted(roles) == roles
        and len(set(roles)) == len([k for k in THEMES["dark"] if "cell" in k])
    )
    for theme in THEMES:
        changes = [
            k for k in range(1, 201) if _on(heat_colour(theme, k / 200)) != _on(heat_colour(theme, (k - 1) / 200))
        ]
        assert changes
        for k in changes:
            assert THEMES[theme][cell_role(k / 200)] != THEMES[theme][cell_role((k - 1) / 200)]


def test_numbers_at_the_ends_of_their_ranges() -> None:
    said = {
        0.001: "0.001", 0.00099: "9.90e-04", 99999.0: "99,999", 1e5: "1.00e+05", -1e5: "-1.00e+05", 0.5: "0.5",
        0.1234: "0.123", 12.0: "12", 12.34: "12.3", 9.87654: "9.88", 123456: "123,456", -2.0: "-2",
        1e-7: "1.00e-07", 1234.5678: "1,235",
    }  # fmt: skip
    assert {v: number(v) for v in said} == said
    values = (None, math.inf, math.nan, True, np.bool_(False), "x", np.int64(4321), np.float32(0.25))
    assert [number(v) for v in values] == ["–", "–", "–", "yes", "no", "x", "4,321", "0.25"]
    assert (number(12.3456, 2), number(12.3456, 5), number(1e6, 2), number(0.00012345, 5)) == (
        "12",
        "12.346",
        "1.0e+06",
        "1.2345e-04",
    )
    rounded_up = ((9.979, 2), (99.96, 3), (0.9996, 3), (0.09999, 2), (-999.7, 3), (999.7, 4), (1000.0, 3), (0.001, 2))
    assert [number(*v) for v in rounded_up] == ["10", "100", "1.00", "0.10", "-1,000", "999.7", "1,000", "0.001"]
    assert number(0.3 + 1e-9, 3) == "0.300"  # measured, not as published: zeros tell what is known


def test_only_words_begin_with_a_capital() -> None:
    said = {
        "the end": "The end",
        "x_lvdt is": "x_lvdt is",
        "a.b is": "a.b is",
        "it. is": "It. is",
        "": "",
        "  ": "  ",
        "i": "I",
    }
    assert {k: capital(k) for k in said} == said


def test_painting_puts_colours_in_place_of_roles() -> None:
    figure = {
        "a": ["@model", ("@error/0.25", "@nothing")],
        "b": {"dtype": "f4", "bdata": "@model"},
        "c": "plain",
        "d": 1.5,
    }
    light = THEMES["light"]
    assert painted(figure) == {
        "a": [light["model"], [light["error"] + "40", "@nothing"]],
        "b": figure["b"],
        "c": "plain",
        "d": 1.5,
    }
    assert painted("@model/1", "dark") == THEMES["dark"]["model"] + "ff"


# ---------------------------------------------------------------- series


def test_a_pause_of_more_than_ten_steps_breaks_a_line() -> None:
    t = np.delete(np.arange(100.0), np.s_[40:49])  # a step of 10: none
    assert_array_equal(break_at_holes(t, t)[0], t)
    t = np.delete(np.arange(100.0), np.s_[40:50])
    x, y = break_at_holes(t, 2.0 * t)
    assert x[39:42].tolist() == [39.0, 40.0, 50.0] and np.isnan(y[40]) and np.isnan(y).sum() == 1 and y[41] == 100.0
    few = np.array([0.0, 1.0, 100.0])
    assert len(break_at_holes(few, few)[0]) == 3  # a hole in three samples is no hole
    twenty = np.append(np.arange(19.0), 100.0)
    assert len(break_at_holes(twenty, twenty)[0]) == 21 and len(break_at_holes(twenty[1:], twenty[1:])[0]) == 19
    assert len(break_at_holes(few[:2], few[:2])[0]) == 2
    still = np.zeros(50)
    assert len(break_at_holes(still, still)[0]) == 50


def test_three_samples_are_looked_at() -> None:
    x, _ = break_at_holes(np.arange(3.0), np.arange(3.0))
    assert len(x) == 3


@settings(max_examples=examples(40), deadline=None)
@given(st.integers(50, 3000), st.integers(20, 60), st.integers(0, 2**32 - 1))
def test_a_thinned_line_has_the_extremes_of_each_group(n: int, limit: int, seed: int) -> None:
    y = np.random.default_rng(seed).normal(size=n)
    y[n // 3 : n // 3 + 2] = np.nan
    x = np.arange(float(n))
    u, v = decimate(x, y, limit)
    if n <= limit:
        assert len(u) == n
        return
    width = -(-n // ((limit - 2) // 3))
    for k in range(0, n, width):
        inside = (u >= k) & (u < k + width)
        part = y[k : k + width]
        assert np.nanmin(v[inside]) == np.nanmin(part) and np.nanmax(v[inside]) == np.nanmax(part)
        assert (
            np.isnan(v[inside]).sum() <= 1 + np.isnan(part[[0, -1]]).any()
            and np.isnan(v[inside]).any() == np.isnan(part).any()
        )
    assert (u[0], u[-1]) == (0.0, n - 1.0) and len(u) <= limit


def test_a_line_is_thinned_only_where_it_is_longer_than_allowed() -> None:
    x = np.arange(30.0)
    assert len(decimate(x, x, 30)[0]) == 30 and len(decimate(x, x, 29)[0]) < 30
    assert [len(decimate(np.arange(n), np.arange(n))[0]) for n in (4500, 4501)] == [4500, 2251]
    y = decimate(x[:4], [1.0, np.inf, -np.inf, 2.0])[1]
    assert np.isnan(y[1:3]).all() and y[3] == 2.0
    with pytest.raises(ValueError, match="x has 2 values, y has 3; they must be equal in number"):
        decimate([1.0, 2.0], [1.0, 2.0, 3.0])


def test_a_path_that_is_short_stays_and_one_that_is_long_is_covered() -> None:
    x = np.array([0.0, 1.0, np.nan, 2.0, 3.0])
    u, v = thin_path(x, x + 1.0)
    assert_array_equal(u, x)
    assert_array_equal(v, x + 1.0)
    u, v = thin_path(x, np.array([0.0, np.inf, 1.0, 2.0, 3.0]))
    assert np.isnan(u[[1, 2]]).all() and np.isnan(v[[1, 2]]).all()
    t = np.linspace(0.0, 1.0, 20_000)
    u, v = thin_path(t, t)  # a straight way: each cell of some 500 is entered once
    assert 480 <= len(u) <= 502 and (u[0], u[-1]) == (0.0, pytest.approx(1.0, abs=0.003)) and np.all(np.diff(u) > 0.0)
    back = np.concatenate([t, t[::-1]])
    assert len(thin_path(back, back)[0]) <= len(u) + 3  # a way back along it is not drawn again
    gap = t.copy()
    gap[8_000:12_000] = np.nan
    u, v = thin_path(t, gap)
    assert np.isnan(u).sum() == np.isnan(v).sum() == 1 and not ((u > 0.401) & (u < 0.599)).any()
    (k,) = np.flatnonzero(np.isnan(u))
    assert (u[k - 1], u[k + 1]) == pytest.approx((0.4, 0.6), abs=0.003)
    gap = t.copy()
    gap[[5_000, 15_000]] = np.nan  # of one sample each
    assert np.isnan(thin_path(t, gap)[0]).sum() == 2
    swing = np.cos(np.linspace(0.0, 300.0, 40_000)) * np.linspace(0.2, 1.0, 40_000)
    whole = len(thin_path(t[::-1].repeat(2), swing, 39_000)[0])
    assert all(len(thin_path(t[::-1].repeat(2), swing, whole - k)[0]) <= whole - k for k in range(1, 5))
    still = np.zeros(5000)
    assert [len(a) for a in thin_path(still, still)] == [1, 1]
    assert len(thin_path(np.full(5000, np.nan), still)[0]) == 5000
    turn = np.linspace(0.0, 200.0, 60_000)
    for limit in (1000, 3000):
        a, b = thin_path(np.cos(turn) * turn, np.sin(turn) * turn, limit)
        assert 0.3 * limit < len(a) <= limit
        radius = np.hypot(a, b)
        assert np.nanmax(radius) > 180.0 and np.nanmin(radius) < 20.0


@settings(max_examples=examples(60), deadline=None)
@given(st.lists(st.floats(-1e6, 1e6, width=32), max_size=50), st.sampled_from([0.0, 1e7]))
def test_packed_numbers_are_the_numbers(values: list[float], far: float) -> None:
    a = np.array(values) + far
    p = packed(a)
    back = unpacked(p)
    assert len(back) == len(a) and p["dtype"] in ("f4", "f8")
    if len(a):
        assert np.abs(back - a).max() <= (0.0 if p["dtype"] == "f8" else 1e-5 * np.ptp(a) + 1e-7 * np.abs(a).max())


def test_numbers_are_packed_in_single_precision_where_it_resolves_them() -> None:
    assert packed([])["dtype"] == packed([np.nan])["dtype"] == packed([0.1, 0.1])["dtype"] == "f4"
    assert packed(np.linspace(0.0, 1.0, 100))["dtype"] == "f4"
    assert packed(1e6 + np.arange(100) * 0.001)["dtype"] == "f8"
    assert packed([0.0, 1.1e6, np.nan])["dtype"] == "f4"
    fine = 1000.0 + np.arange(200_000) * 1e-3  # rounding of 3e-5 beside steps of 1e-3, of a range of 200
    assert packed(fine)["dtype"] == "f4"
    assert packed(1000.0 + np.arange(20_000) * 1e-4)["dtype"] == "f8"
    assert np.isnan(unpacked(packed([np.nan, 1.0]))[0])
    assert_array_equal(unpacked(packed([[1.0, 2.0]])), [1.0, 2.0])


def test_a_distribution_of_nothing_and_of_one() -> None:
    assert [a.tolist() for a in distribution([])] == [[], []]
    assert [a.tolist() for a in distribution([3.0])] == [[3.0, 3.0], [0.0, 1.0]]
    assert [a.tolist() for a in distribution([2.0, 1.0])] == [[1.0, 1.0, 2.0, 2.0], [0.0, 0.5, 0.5, 1.0]]


# ---------------------------------------------------------------- figures


@pytest.mark.parametrize("bins", [21, 81])
def test_a_histogram_and_its_bell_are_shares(bins: int) -> None:
    noise = 0.4
    e = np.linspace(-0.999, 0.999, 1000)
    hill, bell = histogram({"e": e}, "x", noise=noise, bins=bins)["data"]
    x, y = unpacked(hill["x"]), unpacked(hill["y"])
    assert len(x) == bins and y.sum() == pytest.approx(100.0, abs=1e-4)
    reach = 4.0 * noise
    edges = np.linspace(-reach, reach, bins + 1)
    assert_allclose(x, 0.5 * (edges[1:] + edges[:-1]), atol=1e-6)
    density = np.exp(-0.5 * (x / noise) ** 2) / (noise * np.sqrt(2.0 * np.pi))
    assert_allclose(unpacked(bell["y"]), 100.0 * np.diff(edges) * density, rtol=1e-4, atol=1e-5)
    assert unpacked(bell["y"]).sum() == pytest.approx(100.0, abs=0.1)
    assert_array_equal(bell["x"]["bdata"], hill["x"]["bdata"])


def test_the_outermost_bins_hold_what_lies_beyond() -> None:
    e = np.concatenate([np.linspace(-1.0, 1.0, 9990), np.full(10, 50.0)])
    figure = histogram({"e": e}, "x", bins=10)
    y = unpacked(figure["data"][0]["y"])
    assert y[-1] == pytest.approx(y[0] + 0.1, abs=0.06) and figure["layout"]["xaxis"]["range"][1] < 1.1
    assert figure["layout"]["yaxis"]["range"] == [0, pytest.approx(1.12 * y.max())]


def test_panels_fill_the_height_by_their_shares() -> None:
    line = [Line("a", [0.0, 1.0], [0.0, 1.0])]
    layout = overlay([Panel("a", line, height=1.0), Panel("b", line, height=3.0)])["layout"]
    upper, lower = layout["yaxis"]["domain"], layout["yaxis2"]["domain"]
    assert (upper[1], lower[0]) == (1.0, pytest.approx(0.0, abs=1e-12))
    assert (lower[1] - lower[0]) / (upper[1] - upper[0]) == pytest.approx(3.0) and upper[0] - lower[1] == pytest.approx(
        0.055
    )
    assert layout["height"] == 110 + 215 * 4 and layout["xaxis"]["anchor"] == "y2"
    assert overlay([Panel("a", line)])["layout"]["yaxis"]["domain"] == [0.0, 1.0]


def test_defaults_of_lines_panels_and_figures() -> None:
    line, panel = Line("a", [], []), Panel("p", [])
    assert (line.role, line.width, line.dash, line.opacity, line.shown) == ("model", 1.4, "solid", 1.0, True)
    assert (panel.band, panel.height, panel.zero, panel.log, panel.marks) == (None, 1.0, False, False, {})
    page = Page("t", "v")
    page.plot(loop([], "x", "y"))
    assert page.parts == [Plot(0, "", False)] and page.tone == "neutral"
    page.plot(loop([], "x", "y", markers=True), "c", half=True)
    assert page.parts[1] == Plot(1, "c", True)
    assert loop([line], "x", "y")["data"][0]["mode"] == "lines"
    shown = loop([Line("a", [0.0, 1.0], [0.0, 50.0], shown=False), Line("b", [0.0, 1.0], [0.0, 1.0])], "x", "y")
    assert shown["layout"]["yaxis"]["range"] == pytest.approx([-0.06, 1.06])  # of what is seen at first


def test_bars_have_their_numbers_above_them_up_to_twenty() -> None:
    for groups, named in ((10, "outside"), (11, "none")):
        figure = bars([str(k) for k in range(groups)], {"a": [1.0] * groups, "b": [2.0] * groups}, "y")
        assert {d["textposition"] for d in figure["data"]} == {named}


def test_a_ranking_and_a_fall_are_as_high_as_their_names_and_levels() -> None:
    assert [ranking(["a"] * n, [1.0] * n, "x")["layout"]["height"] for n in (1, 3, 4)] == [188, 188, 214]
    levels = waterfall([("a", 2.0), ("b", 2.0), ("c", 3.0), ("d", 1.0)], "y")["data"][0]
    assert levels["marker"]["color"] == ["@error", "@good", "@bad", "@measured"]
    assert [heat([[1.0]] * n, ["a"], ["r"] * n, "u")["layout"]["height"] for n in (1, 3, 4)] == [234, 234, 272]
    places = [["p"]] * 4
    assert heat([[1.0]] * 4, ["a"], ["r"] * 4, "u", places=places)["layout"]["height"] == 120 + 46 * 4


def test_a_map_of_zeros_has_a_scale() -> None:
    assert heat([[0.0, 0.0]], ["a", "b"], ["r"], "u")["data"][0]["zmax"] == 1.0
    assert heat([[-3.0, 1.0]], ["a", "b"], ["r"], "u")["data"][0]["zmax"] == 3.0


def regime(name: str, ratio: list[float], samples: list[int], edges: list[float] | None = None) -> Regime:
    r, many = np.array(ratio), np.array(samples)
    at = np.array(edges) if edges else np.arange(len(r) + 1.0)
    return Regime(
        "x_lvdt", "mm", name, "s" if name != "direction" else "", at, 0.1 * r, r, many, r > 2.0, 0.5, 10.0 * r
    )


def test_a_failure_map_shows_nine_conditions_and_cells_of_more_than_twenty_samples() -> None:
    many = [regime(f"c{k}", [1.0 + k, 0.5], [21, 20]) for k in range(12)]
    cells = failure_map(many)["data"][0]
    assert len(cells["y"]) == 9 and cells["z"][0] == [1.0, None] and cells["z"][8] == [9.0, None]
    assert worst_cell(many) == (8, 0) and cells["y"][0] == "c0 [s]" and cells["x"] == ["eighth 1", "eighth 2"]
    uneven = failure_map([regime("c", [1.0, 2.0, 3.0], [99] * 3), regime("direction", [5.0], [99], [0.5, 1.5])])
    assert uneven["data"][0]["z"] == [[1.0, 2.0, 3.0], [5.0, None, None]] and uneven["layout"]["meta"]["worst"] == 50.0
    assert uneven["data"][0]["hovertext"] == [["0 … 1", "1 … 2", "2 … 3"], ["positive", "", ""]]
    assert uneven["data"][0]["customdata"] == [[10.0, 20.0, 30.0], [50.0, None, None]]


def test_digits_follow_the_width_of_an_interval() -> None:
    said = {
        (1.0391, 1.0362, 1.0419): "1.039 1.036 1.042", (0.79964, 0.79861, 0.80071): "0.7996 0.7986 0.8007",
        (3497.6, 3450.1, 3544.9): "3498 3450 3545", (0.04, 0.01, 9.0): "0.040 0.010 9.000",
        (0.0, -0.1, 0.1): "0.00 -0.10 0.10",
        (2.0, 2.0, 2.0): "2 2 2", (-0.02967, -0.106, 0.04662): "-0.030 -0.106 0.047", (0.0, 0.0, 0.0): "0 0 0",
        (1.23456e-6, 1.2e-6, 1.3e-6): "1.23e-06 1.20e-06 1.30e-06", (4.0e5, 0.0, 8.0e5): "4.0e+05 0 8.0e+05",
        (1.5, -math.inf, 2.5): "1.5 -inf 2.5", (-0.001, -0.4, 0.4): "-0.0010 -0.4000 0.4000",
    }  # fmt: skip
    assert {v: " ".join(map(str, interval(*v))) for v in said} == said
    assert number(interval(1.0391, 1.0362, 1.0419)[1]) == "1.036" and interval(1.0391, 1.0362, 1.0419)[1] == 1.0362


@given(st.floats(-1e9, 1e9), st.floats(1e-12, 1e9), st.floats(0.0, 1.0))
@settings(max_examples=examples(200))
def test_what_an_interval_says_stays_within_a_digit_of_its_width(value: float, width: float, share: float) -> None:
    low = value - share * width
    high = low + width
    if not low <= value <= high or high - low < 1e-12 * abs(value):
        return
    told = [float(str(x)) for x in interval(value, low, high)]
    for shown, true in zip(told, (value, low, high), strict=True):
        assert abs(shown - true) <= 0.51 * max(0.34 * (high - low), 0.0)
    assert told[0] != told[1] or told[0] != told[2]


# ---------------------------------------------------------------- the file


def test_a_page_keeps_what_is_no_text(tmp_path: Path) -> None:
    assert Page("t", "\udc80").write(str(tmp_path / "a.html")) == tmp_path / "a.html"
    assert b"\\udc80" in (tmp_path / "a.html").read_bytes()


def test_a_page_says_which_version_wrote_it(monkeypatch: pytest.MonkeyPatch) -> None:
    assert _version().startswith("vaneloop ") and Page("t", "v").facts["version"] == _version()
    assert Page("t", "v", version="mine 1").facts["version"] == "mine 1"

    def missing(_: str) -> str:
        raise PackageNotFoundError

    monkeypatch.setattr("importlib.metadata.version", missing)
    assert _version() == "vaneloop (not installed)"


def test_data_becomes_json_that_can_stand_in_a_page() -> None:
    data = {
        1: np.array([1.5, np.nan]),
        "b": (np.int64(3), np.float32(0.5), math.inf),
        "c": [True, None, "</script>&\u2028"],
    }
    assert _finite(data) == {"1": [1.5, None], "b": [3, 0.5, None], "c": [True, None, "</script>&\u2028"]}
    text = _json(data)
    assert not set("<>&\u2028") & set(text) and ": " not in text
    assert json.loads(text) == _finite(data)


def test_a_plotly_figure_is_taken_as_its_json() -> None:
    page = Page("t", "v")
    page.plot(SimpleNamespace(to_plotly_json=None, to_json=lambda: '{"data": [], "layout": {"height": 111}}'))
    assert page.figures == [{"data": [], "layout": {"height": 111}}] and 'style="height:111px"' in page.html()


def test_a_figure_that_names_no_height_is_400_pixels_high() -> None:
    page = Page("t", "v")
    page.plot({"data": []})
    page.plot({"data": [], "layout": {}})
    assert page.html().count('style="height:400px"') == 2


def test_scripts_stand_behind_the_page_and_know_its_figures() -> None:
    page = Page("t", "v")
    page.plot(loop([Line("a", [0.0, 1.0], [2.0, 3.0])], "x", "y"))
    kinds = [s.partition(">")[0] for s in page._scripts()]
    assert kinds == [
        '<script type="application/json" id="figures"',
        '<script type="application/json" id="themes"',
        "<script",
        "<script",
    ]
    first, second, plotly, own = page._scripts()
    assert json.loads(first.partition(">")[2].removesuffix("</script>")) == page.figures
    assert json.loads(second.partition(">")[2].removesuffix("</script>")) == THEMES
    assert len(plotly) > 1e6 and '"use strict";' in own and own.endswith("</script>")


# ---------------------------------------------------------------- a run


@dataclass(frozen=True)
class Samples:
    """As `hil.logs.Channel`."""

    t: Array
    values: Array


def result(**more: Any) -> Any:
    t = np.arange(50) * 0.1
    known: dict[str, Any] = {"log": "a.csv", "simulated_s": 5.0, "wall_s": 1.0, "state_hash": "", "signals": [], "t": t,
             "model": {"n_r": 50.0 + t}, "target": {}, "measured": {}}  # fmt: skip
    return SimpleNamespace(**(known | more))


def test_signals_have_names_and_units() -> None:
    assert (signal_name("vgv1"), signal_name("other"), signal_name("i_motor")) == (
        "VGV1 angle",
        "other",
        "motor current",
    )
    assert [axis_title(*a) for a in (("n_r",), ("n_r", "1/s"), ("state",), ("other",), ("other", "bar"))] == [
        "rotor speed [%]", "rotor speed [1/s]", "controller mode", "other", "other [bar]",
    ]  # fmt: skip


def test_rotor_speed_is_measured_where_the_log_has_it() -> None:
    t = np.arange(0.0, 6.0, 1.0)
    r = result(measured={"n_r": Samples(t, 10.0 * t), "n_dem": Samples(t, 11.0 * t)})
    assert_allclose(rotor_speed(r), 10.0 * r.t)
    lines = speed_lines(r)
    assert [(x.name, x.role, x.width, x.shown) for x in lines] == [
        ("demanded", "target", 1.6, True), ("measured", "measured", 1.6, True), ("simulated", "model", 1.2, False),
    ]  # fmt: skip
    assert_array_equal(lines[0].y, 11.0 * t)
    only = result()
    assert_array_equal(rotor_speed(only), only.model["n_r"])
    assert [(x.name, x.shown) for x in speed_lines(only)] == [("simulated", True)]
    assert speed_lines(result(model={})) == []


def there_and_back(
    curve: Any, width: float, n: int = 4000, low: float = 0.0, high: float = 48.0
) -> tuple[Array, Array]:
    """A loop about a curve, this wide, run through ten times."""
    phase = np.linspace(0.0, 20.0 * np.pi, n)
    x = 0.5 * (low + high) - 0.5 * (high - low) * np.cos(phase)
    return x, curve(x) + 0.5 * width * np.sign(np.sin(phase))


def test_the_middle_of_a_loop_is_its_curve() -> None:
    curve = np.polynomial.Polynomial([-10.0, 1.0, 0.02, -2e-4])
    x, y = there_and_back(curve, 1.6)
    mean = _middle_curve(x, y)
    at = np.linspace(3.0, 45.0, 50)
    assert np.abs(mean(at) - curve(at)).max() < 0.02


def test_the_middle_is_that_of_both_sides_though_one_was_visited_more() -> None:
    curve = np.polynomial.Polynomial([-10.0, 1.0])
    x, y = there_and_back(curve, 2.0)
    one_side = np.linspace(0.0, 8.0, 3000)  # a long stay on the upper side of an end
    mean = _middle_curve(np.concatenate([x, one_side]), np.concatenate([y, curve(one_side) + 1.0]))
    at = np.linspace(10.0, 40.0, 20)
    assert np.abs(mean(at) - curve(at)).max() < 0.1


def test_a_way_without_a_loop_has_a_straight_middle_and_a_stroke_at_rest_none() -> None:
    x = np.linspace(0.0, 48.0, 2000)
    bump = np.where((x > 20.0) & (x < 24.0), np.where(np.arange(2000) % 2, 4.0, -4.0), 0.0)
    mean = _middle_curve(x, 2.0 + 0.5 * x + bump)  # both sides in a twelfth of it only
    assert_allclose(mean([0.0, 48.0]), [2.0, 26.0], atol=0.05)
    assert _middle_curve(np.full(100, 3.0), np.arange(100.0)) is None
    rest = 3.0 + 0.001 * np.modf(np.arange(1.0, 400.0) ** 2 * 0.754877)[0]
    assert _middle_curve(rest, rest) is None


def test_the_middle_at_two_places_is_between_their_sides_however_often_each_was_visited() -> None:
    x = np.repeat([0.0, 48.0], 100) + 0.01 * np.modf(np.arange(1.0, 201.0) ** 2 * 0.754877)[0]
    y = np.tile(np.where(np.arange(100) % 10 == 0, 1.0, -1.0), 2)
    y[100:] *= -1.0  # mostly below at one end, mostly above at the other
    assert_allclose(_middle_curve(x, y)([0.0, 48.0]), [0.0, 0.0], atol=0.02)


def test_an_error_in_noise_floors_of_a_sensor_without_noise() -> None:
    def ratio(rms: float, floor: float) -> float:
        return _ratio(SignalError("p_s", "supply", "MPa", "measured", rms, 0.5, 0.9, None, floor, 100))

    assert [ratio(*v) for v in ((0.5, 0.25), (0.5, 0.0), (0.0, 0.0), (0.0, 1.0))] == [2.0, math.inf, 0.0, 0.0]


def test_a_loop_of_few_samples_is_not_drawn() -> None:
    page = Page("t", "v")
    x, y = there_and_back(np.polynomial.Polynomial([0.0, 1.0]), 1.0, 19)
    loops(page, "vigv", [("few", x, y, "model")])
    assert page.parts == []
    x, y = there_and_back(np.polynomial.Polynomial([0.0, 1.0]), 1.0, 20)
    loops(page, "vigv", [("enough", x, y, "model"), ("few", x[:19], y[:19], "measured")])
    assert [p.half for p in page.parts if isinstance(p, Plot)] == [False] and len(page.figures[0]["data"]) == 1
    x, y = there_and_back(np.polynomial.Polynomial([0.0, 1.0]), 1.0)
    page = Page("t", "v")
    loops(page, "vigv", [("enough", x, y, "model"), ("few", x[:19], y[:19], "measured")])
    assert [p.half for p in page.parts if isinstance(p, Plot)] == [True, True] and len(page.figures[1]["data"]) == 1
    page = Page("t", "v")
    loops(page, "vigv", [("at rest", np.full(30, 2.0), np.arange(30.0), "model")])
    assert [p.half for p in page.parts if isinstance(p, Plot)] == [False]


def test_an_error_has_a_mean_over_a_second_where_its_raster_allows_it() -> None:
    def names(dt: float, n: int) -> list[str]:
        t: Any = np.arange(n) * dt
        return [line.name for line in _error_lines(t, np.sin(t))]

    one, both = ["simulated − measured"], ["simulated − measured", "its mean over 1 s"]
    assert names(0.2, 50) == both and names(0.2, 49) == one and names(0.25, 500) == one and names(0.1, 1) == one
    assert [line.name for line in _error_lines(np.zeros(500), np.zeros(500))] == one
    t: Any = np.arange(105) * 0.1
    e = np.arange(105.0)
    e[25] = np.nan
    mean = _error_lines(t, e)[1]
    assert_allclose(np.asarray(mean.x), 0.45 + np.arange(10.0))
    assert_allclose(np.asarray(mean.y), [4.5, 14.5, np.nan, *(34.5 + 10.0 * np.arange(7))])
    late = np.where(t > 5.45, t + 1.0, t)  # a pause of 1 s within a group of ten; then one of more
    assert np.isfinite(np.asarray(_error_lines(late, np.ones(105))[1].y)).all()
    later = np.where(t > 5.45, t + 1.2, t)
    assert np.isnan(np.asarray(_error_lines(later, np.ones(105))[1].y)).tolist() == [k == 5 for k in range(10)]


def test_a_ratio_that_is_noise_a_small_one_and_a_large_one_are_told_apart() -> None:
    def told(rms: float) -> tuple[str, str]:
        s = SignalError("p_s", "supply", "MPa", "measured", rms, 0.5, 0.9, None, 1.0, 100)
        return _replay_verdict(result(), [s], [])

    assert told(1.1) == (
        "The model follows the log to within the sensors' noise: the largest disagreement, in supply pressure, is 0.5 "
        "MPa on average and 0.9 MPa at worst.", "good",
    )  # fmt: skip
    assert (
        told(2.99)[1] == "neutral" and told(3.0)[1] == "bad" and "3.0 times what sensor noise explains" in told(2.99)[0]
    )


def test_speed_that_rises_and_falls_is_told_apart() -> None:
    t = np.arange(4000) * 0.1
    n = 70.0 - 30.0 * np.cos(2.0 * np.pi * t / 100.0)
    rising = np.gradient(n) > 0.0
    r = result(t=t, model={"n_r": n, "vigv": np.where(rising, 0.7, -0.4)}, target={"vigv": np.zeros(4000)})
    speed, rise, fall_ = _rise_and_fall(r)
    assert len(speed) == 30 and (speed[0], speed[-1]) == (pytest.approx(41.0), pytest.approx(99.0))
    assert np.nanmax(np.abs(rise - 0.7)) < 1e-12 and np.nanmax(np.abs(fall_ + 0.4)) < 1e-12
    slow = r.model["n_r"] * 0.0 + 50.0 + 0.0029 * np.arange(4000) / 10.0  # less than 0.3 %/s
    _, rise, fall_ = _rise_and_fall(result(t=t, model=r.model | {"n_r": slow}, target=r.target))
    assert np.isnan(rise).all() and np.isnan(fall_).all()
    for step, moves in ((0.029, False), (0.031, True)):
        n = 40.0 + step * np.arange(2000)
        _, rise, fall_ = _rise_and_fall(
            result(t=t[:2000], model={"n_r": n, "vigv": np.ones(2000)}, target={"vigv": np.zeros(2000)})
        )
        assert np.isfinite(rise).any() == moves and np.isnan(fall_).all()


# ---------------------------------------------------------------- words


def test_errors_in_noise_floors_have_three_digits() -> None:
    said = {0.5: "0.50", 1.0: "1.00", 9.994: "9.99", 9.996: "10", 12.34: "12.3", 99999.0: "1e+05", 123456.0: "1.2e+05"}
    assert {v: floors(v) for v in said} == said


def stage_said(
    verdict: str, before: list[float], after: list[float], effects: list[Found] | None = None
) -> StageDiagnosis:
    said = StageDiagnosis.__new__(StageDiagnosis)
    said.stage, said.outputs, said.units, said.verdict = "servo", ("a", "b"), ("mm", "deg"), verdict
    said.floor, said.error_before, said.error_after = np.array([0.1, 1.0]), np.array(before), np.array(after)
    said.effects, said.steps, said.excess = effects or [], [], 1.0
    return said


def found(name: str, rivals: list[str] | None = None, **more: Any) -> Found:
    return Found(name, 0.9, {}, rivals or [], 1.0, **more)


def test_what_a_stage_says_is_one_word_with_a_tone() -> None:
    done, left = [0.11, 1.1], [0.11, 1.11]
    cases = [
        (stage_said("none", left, left), "fits", "good", "fits", "good"),
        (stage_said("missing", left, done, [found("x")]), "missing", "neutral", "explained", "good"),
        (stage_said("missing", left, left, [found("x")]), "missing", "neutral", "missing", "bad"),
        (stage_said("missing", left, left), "missing", "neutral", "missing", "bad"),
        (stage_said("unknown", left, left), "unknown", "bad", "unknown", "bad"),
        (stage_said("unknown", left, done, [found("x")]), "unknown", "bad", "explained", "good"),
    ]
    for s, plain, tone, extended, then in cases:
        assert (word(s), stage_tone(s), word(s, True), stage_tone(s, True)) == (plain, tone, extended, then)
    said = {v: verdict_word(v) for v in ("none", "missing", "unknown", "not_observed")}
    assert said == {
        "none": "fits", "missing": "missing", "unknown": "unknown", "not_observed": "cannot tell from this log",
    }  # fmt: skip


def test_the_page_on_answers_lists_every_word_of_a_verdict() -> None:
    text = (ROOT / "docs" / "reading_an_answer.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| ([a-z ]+) \| [^|]+ \| ([^|]*`[^|]*) \|", text.split("## Verdicts")[1], re.M)
    assert [word for word, _ in rows] == [FITS, FAILS, MISSING, UNKNOWN, EXPLAINED, CANNOT]
    said = {json_word: word for word, cell in rows if word != EXPLAINED for json_word in re.findall(r"`(\w+)`", cell)}
    assert {k: said[k] for k in WORDS} == WORDS


def test_the_output_that_fails_most_is_told() -> None:
    assert fall(stage_said("missing", [0.3, 2.0], [0.2, 1.0]))[0] == 0
    s = stage_said("missing", [0.3, 20.0], [0.2, 1.5])
    s.steps, s.excess = [("nominal", 14.3), ("x", 1.3)], 1.3
    # the waterfall's first level and its last are what the sentence says
    assert fall(s) == (1, "14.3", "1.30") == (1, *(floors(v) for _, v in falling(s)[:2]))
    assert together(s) == "the 2 signals of servo together"
    s.outputs = ("a",)
    assert together(s) == "a"


def test_what_a_log_cannot_tell_is_said() -> None:
    assert doubt(found("x")) == ""
    assert doubt(found("x", ["y", "z"])) == "this log cannot distinguish it from y or z"
    both = found("x", ["y"], inseparable=["time", "oil temperature"])
    assert (
        doubt(both)
        == "this log cannot distinguish it from y; this log cannot distinguish its cause from time or oil temperature"
    )
    assert untold([]) == "" and untold(["servo", "engine"]) == " Cannot tell from this log: servo, engine."
    assert jumps(None) == "" and jumps(0.0) == "" and "anew every 2.5 s" in jumps(2.5)


def test_an_extended_model_is_told_in_one_sentence() -> None:
    one = stage_said("missing", [0.3, 2.0], [0.1, 1.0], [found("x"), found("y")])
    two = stage_said("unknown", [0.3, 20.0], [0.1, 15.0])
    one.steps, two.outputs, two.steps, two.excess = [("nominal", 2.5)], ("b",), [("nominal", 20.0)], 15.0
    d = Diagnosis("missing", [one, two], {}, {}, 1.0)
    assert extended_sentence(d) == (
        "With x and y the error of the 2 signals of servo together falls from 2.50 to 1.00 noise floors: explained; "
        "with the nominal model the error of b falls from 20 to 15 noise floors: an error remains."
    )
    assert extended_sentence(Diagnosis("none", [], {}, {}, 1.0)) == "Nothing was extended."
    assert extended_sentence(d, "too large") == "The model is no better with it: too large."


def test_what_an_effect_is_worth_is_between_nothing_and_all() -> None:
    s = stage_said(
        "missing", [0.3, 2.0], [0.1, 1.0], [found("harms", fall=0.5), found("all", fall=1e4), found("some", fall=10.0)]
    )
    s.steps, s.excess = [("nominal", 200.0), ("all", 2.0)], 2.0
    assert [(w.effect, w.without, round(w.share, 9)) for w in worths(s)] == [
        ("all", 2e4, 1.0),
        ("some", 20.0, 0.5),
        ("harms", 1.0, 0.0),
    ]
    s.steps = []
    assert [w.share for w in worths(s)] == [1.0, 1.0, 0.0]


def test_steps_of_a_fall() -> None:
    s = stage_said("missing", [0.3, 2.0], [0.1, 1.0])
    s.steps = [("model", 9.0), ("a", 4.0), ("b + a", 3.0), ("b", 2.0), ("b", 1.5), ("without numerical error", 1.4)]
    assert falling(s) == [
        ("model", 9.0), ("+ a", 4.0), ("+ b", 3.0), ("− a", 2.0), ("b", 1.5), ("without numerical error", 1.4),
        ("noise floor", 1.0),
    ]  # fmt: skip


def located(stage: str, rms: float, hot: bool = False, floor: float = 1.0) -> Located:
    bins = replace(regime("time", [1.0, 1.5], [4000, 4000]), significant=np.array([False, hot]))
    figures = (StageFigures(stage, "n_r", "%", rms, rms, floor, 8000),)
    return Located(stage, None, np.ones(1), figures, (bins,), None)  # type: ignore[arg-type]


def test_all_stages_are_told_in_one_sentence() -> None:
    assert located_sentence([located("servo", 1.0)]) == "Every subsystem fits its measurements to within the noise."
    assert located_sentence([located("servo", 1.0)], ["engine"]) == (
        "Every observed subsystem fits its measurements to within the noise. Cannot tell from this log: engine."
    )
    times = ["servo fails at 3 s", "engine fails at 9 s", "servo fails at 20 s"]
    assert located_sentence([located("servo", 1.0)], ["engine"], times) == (
        "Most of the log fits its measurements, but the servo fails at 3 s. So it is in 2 stretches more. Cannot tell "
        "from this log: engine."
    )
    assert (
        located_sentence([located("servo", 1.0)], (), times[:1])
        == "Most of the log fits its measurements, but the servo fails at 3 s."
    )
    two = [located("engine", 2.5, floor=0.5), located("servo", 3.0)]
    said = "The model fails most in the engine subsystem: n_r is off by 2.5 % RMS, 5.00 times its noise floor."
    assert located_sentence(two[:1], (), times) == said
    assert (
        located_sentence(two) == f"{said} servo fails too."
        and located_sentence(two[::-1]) == f"{said} servo fails too."
    )
    assert (
        located_sentence([*two, located("linkage", 1.0), located("actuator", 1.2)])
        == f"{said} servo and actuator fail too."
    )
    hot = [located("servo", 1.05, True), located("engine", 1.0, True)]
    where = "fails at x_lvdt: 0.15 mm (1.5 noise floors) at time 1 to 2 s"
    assert located_sentence(hot) == (
        f"Over the whole log every subsystem fits its measurements, but "
        f"the servo subsystem {where}; the engine subsystem {where}."
    )
    assert word_of_located(hot[0]) == "fails" and word_of_located(located("servo", 1.0)) == "fits"
    tones = [
        located_tone(x)
        for x in ([located("servo", 1.1)], two[:1], [located("servo", 2.0)], [located("servo", 2.001)], hot, [])
    ]
    assert tones == ["good", "bad", "neutral", "bad", "neutral", "good"]


def test_a_diagnosis_is_told_in_one_sentence() -> None:
    lacks = stage_said("missing", [0.3, 2.0], [0.1, 1.0], [found("dip", ["leak", "lag"]), found("grip")])
    strange = stage_said("unknown", [0.3, 2.0], [0.3, 2.0])
    strange.stage = "engine"
    faint: Any = SimpleNamespace(text="explains next to nothing", explained=0.19)
    shape: Any = SimpleNamespace(text="the error of a oscillates", explained=0.2)
    other: Any = SimpleNamespace(text="not the first", explained=0.2)
    said = (
        "The servo subsystem lacks dip (or leak, lag) and grip; the engine subsystem lacks something that the library "
        "does not"
    )
    said += " have"
    d = Diagnosis(
        "unknown",
        [lacks, stage_said("none", [0.1, 1.0], [0.1, 1.0]), strange],
        {"engine": [faint, shape, other]},
        {"linkage": "no vigv"},
        1.0,
    )
    assert verdict_sentence(d) == f"{said}: the error of a oscillates. Cannot tell from this log: linkage."
    d.shapes, d.not_observed = {}, {}
    assert verdict_sentence(d) == f"{said}."
    d.stages = [d.stages[1]]
    assert verdict_sentence(d) == "Nothing is missing: every subsystem fits its measurements down to the noise floor."


def test_short_names_keep_logs_apart() -> None:
    assert short_names(["a/run.csv", "b/other.mf4"]) == {"a/run.csv": "run", "b/other.mf4": "other"}
    assert short_names(["a/run.csv", "b/run.csv"]) == {"a/run.csv": "a/run.csv", "b/run.csv": "b/run.csv"}
    assert short_names(["a/run.xyz", "x.1"]) == {"a/run.xyz": "a/run.xyz", "x.1": "x.1"}
    long = "k" * 10 + "m" * 20
    assert short_names([long]) == {long: "…" + long[-27:]} and short_names(["n" * 28]) == {"n" * 28: "n" * 28}
    alike = [c + "same" * 8 for c in "ab"]
    assert short_names(alike) == {n: n for n in alike} and short_names([f"d/{n}.CSV" for n in alike]) == {
        f"d/{n}.CSV": n for n in alike
    }
    assert short_names(["12345", "6"], 3) == {"12345": "…45", "6": "6"}


def test_failures_that_are_drawn_have_colours_of_their_own() -> None:
    assert len(set(_SHOWN.values())) == len(_SHOWN) and set(_SHOWN.values()) <= THEMES["light"].keys()
