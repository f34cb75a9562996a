"""What every part of the product stands on, by its specification: names, parts of logs, hulls, splines, formulas, work
side by side, what a command prints, compiled code that is kept.
"""

from __future__ import annotations

import argparse
import errno
import gc
import io
import json
import math
import os
import subprocess
import sys
import termios
import threading
import types as types_of_python
import unicodedata
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np
import pytest
from numba import njit, types
from numba.core import codegen, compiler, config, errors, ir
from pydantic import BaseModel, Field, ValidationError
from scipy.interpolate import CubicSpline, RegularGridInterpolator

from vaneloop.base import (
    cells,
    child,
    compiled,
    curve,
    durations,
    extras,
    files,
    forms,
    hysteresis,
    kept,
    lean,
    notebook,
    quantities,
    sizes,
    spans,
    terminal,
    vanes,
)
from vaneloop.base.errors import InputError, meant
from vaneloop.base.holes import holes
from vaneloop.base.hull import hull_of, nearest_within, within
from vaneloop.base.side_by_side import shared_out, side_by_side
from vaneloop.base.spans import Span
from vaneloop.base.spline_rates import SplineRates
from vaneloop.base.tables import Quantity, _complaint

# ---- names -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seconds, digits, name", [
    (138.0, 3, "138_s"), (0.138, 3, "138_ms"), (1.5, 3, "1500_ms"), (0.136986, 6, "136986_us"), (0.136986, 3, "137_ms"),
    (1e-3, 3, "1_ms"), (1.0, 3, "1_s"), (2.5e-7, 3, "250_ns"), (1.23e-9, 3, "1_ns"), (1e-12, 3, "1_ns"),
    (123456.0, 3, "123000_s"),
])  # fmt: skip
def test_a_time_in_a_name_is_a_whole_number_of_the_largest_unit(seconds: float, digits: int, name: str) -> None:
    assert durations.in_name(seconds, digits) == name
    if seconds > 2e-9:
        assert durations.named_lag(f"n_r_lagged_by_{name}") == ("n_r", pytest.approx(seconds, rel=5e-3))


@pytest.mark.parametrize("name, channel, period", [
    ("time_every_137_ms", "time", 0.137), ("time_every_2_s", "time", 2.0), ("x_every_0p8976", "x", 0.8976),
    ("x_every_1p2em05", "x", 1.2e-5), ("x_every_3e2", "x", 300.0), ("x_every_12", "x", 12.0), ("x_every_0", "", 0.0),
    ("x_every_0p0", "", 0.0), ("x_every_9e999", "", 0.0), ("time_every_0_s", "", 0.0), ("x_lagged_by_2_s", "", 0.0),
    ("x", "", 0.0),
])  # fmt: skip
def test_a_period_in_a_name_is_above_nothing_and_no_end(name: str, channel: str, period: float) -> None:
    found = durations.folded(name)
    assert found == ((channel, pytest.approx(period)) if channel else None)
    assert durations.within_no_period(name) == (channel or name)
    assert durations.period_of(name) == (pytest.approx(period) if channel == "time" else 0.0)


def test_a_number_is_whole_to_ten_digits() -> None:
    for x, whole in ((5.0, True), (1e6 + 1e-5, True), (1e6 + 1e-3, False), (0.5, False), (5.0 + 1e-7, False)):
        assert durations._whole(x) == whole, x


def test_a_channel_s_period_is_written_without_a_dot() -> None:
    said = [durations.period_in_name(p, 4) for p in (0.8976, 1.2e-5, 300.0, 1.5e20, 0.12346)]
    assert said == ["0p8976", "1p2em05", "300", "1p5e20", "0p1235"]
    for p in (0.8976, 1.2e-5, 300.0, 1.5e20):
        assert durations.folded(f"x_every_{durations.period_in_name(p, 4)}") == ("x", pytest.approx(p))


def test_stages_come_without_a_gap() -> None:
    assert vanes.vanes_of({"vgv1", "vigv", "x"}) == ("vigv", "vgv1") and vanes.vanes_of(vanes.VANES) == vanes.VANES
    assert vanes.VANES[0] == "vigv" and vanes.VANES[-1] == "vgv7" and len(vanes.VANES) == 8
    for present, says in (
        ({}, "vigv is missing: the"), ({"vgv1"}, "vigv is missing, but vgv1 is there: the"),
        ({"vigv", "vgv1", "vgv3"}, "vgv2 is missing, but vgv3 is there: the"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=says):
            vanes.vanes_of(present)
    names = ["linkage.vigv_play", "stroke", "linkage.vgv1_play", "sensors.vgv2"]
    assert vanes.own_rows(names, ("vigv", "vgv1")) == [0, 1, 2] and vanes.vane_in("stroke") is None
    vanes.same_stages(geometry=("vigv",), angles=("vigv",))
    with pytest.raises(InputError, match=r"angles: vane rows \(=vigv, vgv1\) must be those of geometry, vigv$"):
        vanes.same_stages(geometry=("vigv",), angles=("vigv", "vgv1"))


def test_the_nearest_word_is_asked_for() -> None:
    assert meant("vgiv", ["vigv", "vgv1", "other"]) == " (did you mean vigv?)" and meant("qqq", ["vigv"]) == ""
    assert meant("VIGW", ["Vigv"]) == " (did you mean Vigv?)" and meant("ab", []) == ""


def test_what_is_not_installed_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    assert extras.is_there("json") and extras.is_there("os.path") and not extras.is_there("no_such_package.part")
    assert extras.needed("a thing", "json") is json
    monkeypatch.setattr(extras, "is_there", lambda m: m != "isotp")
    extras.needs("a thing", "json", "nicegui")
    with pytest.raises(InputError, match=r"a thing needs can-isotp, which .*: pip install 'vaneloop\[diagnostics\]'"):
        extras.needed("a thing", "isotp")


def test_a_quantity_that_says_no_tolerance_is_exact() -> None:
    assert Quantity(value=1.0, unit="mm", origin="chosen: a test").tolerance == 0.0
    with pytest.raises(ValueError, match="greater than or equal to 0"):
        Quantity(value=1.0, unit="mm", origin="chosen: a test", tolerance=-1e-9)


def test_a_table_of_no_known_kind_says_which_there_are() -> None:
    class One(BaseModel):
        kind: Literal["one"]

    class Two(BaseModel):
        kind: Literal["two"]

    class Table(BaseModel):
        part: One | Two = Field(discriminator="kind")

    for given, says in (
        ({"part": {}}, "part: key 'kind' is missing"),
        ({"part": {"kind": "three"}}, "part.kind (='three'): must be one of 'one', 'two'"),
    ):  # fmt: skip
        with pytest.raises(ValidationError) as wrong:
            Table.model_validate(given)
        assert _complaint(wrong.value, Table) == says


def test_what_is_written_is_brought_to_the_disk_with_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: list[Path] = []
    there = os.readlink
    sizes: list[int] = []

    def sync(fd: int) -> None:
        synced.append(Path(there(f"/proc/self/fd/{fd}")))
        sizes.append(os.fstat(fd).st_size)

    monkeypatch.setattr(files.os, "fsync", sync)
    monkeypatch.chdir("/")
    target = files.write(tmp_path / "a.txt", "text")
    assert target.read_text() == "text" and [p.parent for p in synced[:-1]] == [tmp_path] * (len(synced) - 1)
    assert synced[-1] == tmp_path and len(synced) > 1  # the file before it takes its name, the folder after
    assert sizes[:-1] == [4] * (len(sizes) - 1)  # and all of it
    monkeypatch.chdir(tmp_path)
    files.write("b.txt", b"bytes")
    assert synced[-1] == tmp_path and (tmp_path / "b.txt").read_bytes() == b"bytes"


def test_what_a_library_writes_is_brought_to_the_disk_with_the_old_file_s_rights(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced: list[tuple[str, int]] = []
    monkeypatch.setattr(
        files.os, "fsync", lambda fd: synced.append((os.readlink(f"/proc/self/fd/{fd}"), os.fstat(fd).st_size))
    )
    owners: list[tuple[int, int]] = []
    file = tmp_path / "a.txt"
    file.write_text("old")
    for mode in (0o640, 0o440 if os.geteuid() == 0 else 0o600):
        file.chmod(mode)
        synced.clear()
        before = len(os.listdir("/proc/self/fd"))
        with files.whole(file) as part:
            assert part.parent == tmp_path and part.name.startswith(".a.txt.") and part.name.endswith(".part")
            assert part.stat().st_mode & 0o777 & ~mode & 0o077 == 0  # nobody reads it who may not read the old one
            part.write_text("new one")
            name = str(part)
        assert len(os.listdir("/proc/self/fd")) == before
        assert synced == [(name, 7), (str(tmp_path), tmp_path.stat().st_size)]
        assert (
            file.stat().st_mode & 0o777 == mode and file.read_text() == "new one" and len(list(tmp_path.iterdir())) == 1
        )
    now = os.stat(file)
    monkeypatch.setattr(files.os, "chown", lambda name, *owner: owners.append(owner))
    for owner in ((now.st_uid, now.st_gid), (now.st_uid + 1, now.st_gid), (now.st_uid, now.st_gid + 1)):
        files._Target(str(file), str(file), 0o600, owner).finish()
    assert owners == [(now.st_uid + 1, now.st_gid), (now.st_uid, now.st_gid + 1)]


def test_a_file_is_made_where_its_links_lead_and_once(tmp_path: Path) -> None:
    old, link, dangling = tmp_path / "old", tmp_path / "link", tmp_path / "dangling"
    old.write_text("x")
    link.symlink_to("old")
    dangling.symlink_to(tmp_path / "new")
    files.write(link, "y")
    files.write(dangling, b"z")
    assert link.is_symlink() and old.read_text() == "y" and (tmp_path / "new").read_bytes() == b"z"
    chain = [tmp_path / f"l{k}" for k in range(41)]
    for one, other in zip(chain, [*chain[1:], old], strict=True):
        one.symlink_to(other)
    assert files._behind_links(str(chain[2])) == (str(old), False)  # 39 links
    for k in (0, 1):
        with pytest.raises(InputError, match=rf"cannot write .*l{k}: Too many levels of symbolic links"):
            files.write(chain[k], "w")
    with pytest.raises(FileExistsError), files.replacing(old, only_new=True):
        pass
    with files.replacing(tmp_path / "first", only_new=True) as part:
        part.write_text("1")
    assert (tmp_path / "first").read_text() == "1"
    for name, why in ((tmp_path, "Is a directory"), (f"{tmp_path}/no/x", "No such file"), (f"{tmp_path}/q/", "No such"),
                      ("a\0b", "embedded null byte")):  # fmt: skip
        with pytest.raises(InputError, match=f"^cannot write .*: {why}"):
            files.check(name)
    files.check(old)
    files.check("/dev/null")
    for at in ("/dev/null", "/proc/self/fd/1"):
        assert files._begin(at) == (at, at, 0, (0, 0))
    os.mkfifo(tmp_path / "pipe")
    assert files._begin(tmp_path / "pipe").part == str(tmp_path / "pipe")
    assert not [f for f in tmp_path.iterdir() if f.name.endswith(".part")]


def test_a_page_is_offered_where_there_is_one() -> None:
    for report, options in ((None, ["json", "quiet"]), (False, ["json", "quiet"]), (True, ["report", "json", "quiet"])):
        parser = argparse.ArgumentParser()
        terminal.add_output_options(parser, *([] if report is None else [report]))
        assert list(vars(parser.parse_args([]))) == options
    assert parser.parse_args(["--quiet"]).quiet is True and parser.parse_args([]).json is None


@pytest.mark.parametrize(("unit", "kind"), [
    ("mm", "length"), (" mm ", "length"), ("deg", "angle"), ("l", "volume"), ("mm^3", "volume"), ("cm**3", "volume"),
    ("m3", "volume"), ("deg3", ""), ("m2", ""), ("kg", "mass"), ("%", "share"), ("degC", "temperature"),
    ("rpm", "angular velocity"), ("km/h", "velocity"), ("mm / s", "velocity"), ("mm s^-1", "velocity"),
    ("m·s**-1", "velocity"), ("(mm)/s", "velocity"), ("deg/s", "angular velocity"), ("kg/s", ""), ("m/kg", ""),
    ("mph", "velocity"), ("furlong", ""), ("", ""),
])  # fmt: skip
def test_a_unit_says_what_kind_of_quantity_it_is_of(unit: str, kind: str) -> None:
    assert quantities.kind_of(unit) == kind


def test_zeros_of_temperature_are_so_far_from_the_absolute_one() -> None:
    found = {u: quantities.absolute_zero(u) for u in ("K", " degC", "°C", "deg C", "celsius", "degF", "°F", "mm")}
    celsius, fahrenheit = 273.15, 273.15 * 9.0 / 5.0 - 32.0
    assert found == {
        "K": 0.0, " degC": celsius, "°C": celsius, "deg C": celsius, "celsius": celsius,
        "degF": pytest.approx(fahrenheit), "°F": pytest.approx(fahrenheit), "mm": 0.0,
    }  # fmt: skip


def test_a_pause_of_more_than_ten_steps_is_a_hole() -> None:
    even = np.arange(40.0)
    for leap, found in ((10.0, []), (10.5, [19]), (12.0, [19])):
        t = np.where(even > 19, even + leap - 1.0, even)
        assert holes(t).tolist() == found
    two = np.where(even > 30, even + 40.0, np.where(even > 9, even + 20.0, even))
    assert holes(two).tolist() == [9, 30]  # two of forty may be followed by one, three may not
    assert holes(np.where(even > 20, two + 50.0, two)).size == 0
    assert holes(two[:39]).size == 0  # nor two of thirty-nine
    assert holes(np.array([0.0, 1.0])).size == holes(np.zeros(30)).size == 0
    assert holes(np.array([0.0, 1.0, 50.0])).size == 0


@pytest.mark.parametrize(("text", "cell"), [
    ("=1", "'=1"), ("+x", "'+x"), ("-a b", "'-a b"), ("@x", "'@x"), ("\tx", "'\tx"), ("\rx", "'\rx"), ("-", "-"),
    ("'=1", "''=1"), ("'x", "'x"), ("a=1", "a=1"), ("", ""), ("=\n", "'=\n"),
])  # fmt: skip
def test_no_text_of_a_cell_is_a_formula_and_each_comes_back(text: str, cell: str) -> None:
    assert cells.marked(text) == cell and cells.unmarked(cell) == text


def test_numbers_too_small_or_too_large_to_be_squared_are_told() -> None:
    values = np.array([0.0, 1e-60, -1e-60, 0.9e-60, -0.9e-60, 1e60, 1.1e60, -1.1e60, np.inf])
    assert sizes.no_smaller(values).tolist() == [0.0, 1e-60, -1e-60, 0.0, 0.0, 1e60, 1.1e60, -1.1e60, np.inf]
    assert sizes.beyond(values).tolist() == [False] * 6 + [True] * 3
    same = np.array([0.0, 1.0])
    assert sizes.no_smaller(same) is same


def test_a_result_is_shown_as_text_and_as_html() -> None:
    assert [notebook.shown(v) for v in (None, math.nan, True, False, 1.23456, 12_345, "t", 0)] == [
        "", "", "yes", "no", "1.235", "12,345", "t", "0"
    ]  # fmt: skip
    assert notebook.shown(1.23456, 2) == "1.2"
    columns, rows = ["name", "n", "good"], [["a<b", 1.5, True], ["longer", 1234, False]]
    assert notebook.text_table(columns, rows).split("\n") == [
        "name        n  good", "a<b       1.5  yes", "longer  1,234  no",
    ]  # fmt: skip
    right, left = 'style="text-align:right"', 'style="text-align:left"'
    assert notebook.html_table(columns, rows, "a & b") == (
        f'<table><caption {left}>a &amp; b</caption><thead><tr><th scope="col" {left}>name</th>'
        f'<th scope="col" {right}>n</th><th scope="col" {left}>good</th></tr></thead><tbody>'
        f"<tr><td {left}>a&lt;b</td><td {right}>1.5</td><td {left}>yes</td></tr>"
        f"<tr><td {left}>longer</td><td {right}>1,234</td><td {left}>no</td></tr></tbody></table>"
    )
    assert "<caption" not in notebook.html_table(columns, rows)


def test_a_surface_is_straight_between_its_points_and_stays_as_at_its_edges() -> None:
    rng = np.random.default_rng(5)
    table = rng.normal(size=(5, 4))
    xs, zs = np.linspace(10.0, 20.0, 5), np.linspace(-1.0, 1.0, 4)
    scipys = RegularGridInterpolator((xs, zs), table)
    for x, z in rng.uniform((8.0, -1.3), (22.0, 1.3), (50, 2)):
        want = float(scipys([np.clip(x, 10.0, 20.0), np.clip(z, -1.0, 1.0)])[0])
        assert curve.on_grid.py_func(x, z, LOW, HIGH, table) == pytest.approx(want)
        line = float(np.interp(x, xs, table[:, 0]))
        assert curve.on_table.py_func(x, 10.0, 20.0, table[:, 0]) == pytest.approx(line)
        assert curve.on_even.py_func(x, 10.0, 0.4, table[:, 0]) == pytest.approx(line)


# ---- parts of logs ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("given, low, high", [
    ("0:200", 0.0, 200.0), ("200:", 200.0, math.inf), (":200", -math.inf, 200.0), (" : 3 ", -math.inf, 3.0),
    ((1, 2.5), 1.0, 2.5), ((None, 2.0), -math.inf, 2.0), ([1.0, None], 1.0, math.inf), ("1e2:1.5e2", 100.0, 150.0),
    (Span(3.0, 4.0), 3.0, 4.0), (":", -math.inf, math.inf),
])  # fmt: skip
def test_a_part_of_a_log_has_two_ends_of_which_each_may_be_open(given: Any, low: float, high: float) -> None:
    assert spans.span_of(given, "--fit") == Span(low, high)
    assert spans.span_of(str(spans.span_of(given, "--fit")), "--fit") == Span(low, high)


@pytest.mark.parametrize("given, says", [
    ("1", "must be FROM:TO"), ("1:2:3", "must be FROM:TO"), (7, "must be FROM:TO"), ((1,), "must be FROM:TO"),
    ("a:2", "'a' must be a number of seconds"), ("nan:2", "'nan' must be a number"),
    ("1:inf", "'inf' must be a number"), ((1, "x"), "'x' must be"), ("3:2", "must be above"),
    ("2:2", r"the end \(=2 s\) must be above the beginning \(=2 s\)"),
])  # fmt: skip
def test_what_is_no_part_of_a_log_is_refused(given: Any, says: str) -> None:
    with pytest.raises(InputError, match=rf"^--fit .*{says}"):
        spans.span_of(given, "--fit")


def test_a_part_is_told_from_a_file() -> None:
    for part in ("0:200", ":", " 1e3: ", "nan:1", "1:inf", "1:2:3", (1, 2.0), (None, None), Span(0.0, 1.0)):
        assert spans.is_span(part), part
    for other in ("a.csv", "C:\\x", "12", "", (1, 2, 3), (1, "a"), [1, 2], None, 5):
        assert not spans.is_span(other), other
    assert spans.spans_of("0:1", "--fit") == [Span(0.0, 1.0)] and spans.spans_of((0, 1), "--fit") == [Span(0.0, 1.0)]
    assert spans.spans_of(["0:1", (2, 3)], "--fit") == [Span(0.0, 1.0), Span(2.0, 3.0)]


def test_parts_may_touch_and_not_share_a_time() -> None:
    a, b, c = Span(0.0, 10.0), Span(10.0, 20.0), Span(19.0, 30.0)
    spans.apart([a, b], [])
    spans.apart([a], [b, Span(20.0, math.inf)])
    with pytest.raises(InputError, match="--fit '10:20' and --test '19:30' share '19:20'; parts must not overlap"):
        spans.apart([a, b], [c])
    with pytest.raises(InputError, match="--fit '10:20' and --fit '19:30' share"):
        spans.apart([a, b, c], [])
    with pytest.raises(InputError, match="--test '0:10': a part of the log needs --fit FROM:TO beside it"):
        spans.apart([], [a])
    spans.apart([], [])


# ---- curves and surfaces ---------------------------------------------------------------------------------------------


def test_spline_rates_are_scipy_s() -> None:
    rng = np.random.default_rng(2)
    for n in (4, 5, 6, 40):
        t = np.cumsum(rng.uniform(0.5, 3.0, n))
        u = rng.standard_normal((2, 3, n))
        rates = SplineRates(t)(u)
        assert rates.shape == u.shape and rates.flags.c_contiguous
        assert rates == pytest.approx(CubicSpline(t, u, axis=-1, bc_type="not-a-knot")(t, 1), rel=1e-9, abs=1e-9)
        assert SplineRates(t)(t**3) == pytest.approx(3.0 * t**2)


def test_splines_sum_to_one_and_stay_as_at_their_ends() -> None:
    knots = np.array([0.0] * 4 + [1.0, 2.5] + [4.0] * 4)
    values = curve.splines(knots, np.linspace(0.0, 4.0, 9))
    assert values.shape == (9, 6) and values.sum(axis=1) == pytest.approx(np.ones(9)) and (values >= 0.0).all()
    assert curve.splines(knots, [-3.0, 9.0]) == pytest.approx(np.eye(6)[[0, 5]])
    open_ends = np.arange(10.0)  # not doubled: between the fourth and the last but three
    assert curve.splines(open_ends, [-1.0]) == pytest.approx(curve.splines(open_ends, [3.0]))
    assert curve.splines(open_ends, [8.5]) == pytest.approx(curve.splines(open_ends, [6.0]))
    assert (curve.DEGREE, curve.POINTS, curve.FINE, curve.SIDE, curve.FINE_SIDE) == (3, 257, 1025, 65, 257)


@pytest.mark.parametrize("columns", [None, 2])
def test_stops_make_their_virgin_curve(columns: int | None) -> None:
    x = np.linspace(0.0, 3.0, 257)
    table = np.sqrt(x) if columns is None else np.column_stack([np.sqrt(x), x - 0.1 * x**2])
    weights = hysteresis.weights_of(0.0, 3.0, table, 16)
    assert weights.shape == ((16,) if columns is None else (16, 2))
    radii = 3.0 * (np.arange(1, 17) / 16) ** 2
    made = np.minimum(radii[:, None], radii) @ weights  # each stop follows up to its radius
    expected = np.stack([np.interp(radii, x, y) for y in table.reshape(257, -1).T], axis=-1).reshape(made.shape)
    assert made == pytest.approx(expected)
    assert len(hysteresis.weights_of(0.0, 3.0, np.sqrt(x))) == hysteresis.RADII == 64
    assert hysteresis.stops_of("stops_of_n_r") == "n_r" and hysteresis.stops_of("n_r") == ""


@pytest.mark.parametrize("samples", [0, 1, 2, 8, 9, 10, 400])
def test_stops_give_the_same_bits_sample_by_sample_and_on_a_whole_log(samples: int) -> None:
    rng = np.random.default_rng(samples)
    course, weights = np.cumsum(rng.normal(size=samples)), rng.normal(size=(hysteresis.RADII, 1))
    s, gives = np.zeros((hysteresis.RADII, 1)), np.zeros(samples)
    for k in range(1, samples):
        gives[k] = hysteresis.slip(s, 0, 0, course[k] - course[k - 1], weights, 0, 3.0)
    assert np.array_equal(hysteresis.slipped(course, 3.0, weights[:, 0]), gives)


@pytest.mark.parametrize(
    ("low", "high", "points"), [(0.0, 1.0, 257), (-3.3, 7.1, 1025), (0.0, 3.0, 2), (1e6, 1e6 + 1e-3, 257)]
)
def test_on_an_even_grid_a_curve_has_the_bits_that_a_search_finds(low: float, high: float, points: int) -> None:
    rng = np.random.default_rng(points)
    grid, table = np.linspace(low, high, points), rng.normal(size=points)
    spread = rng.uniform(low - 0.1 * (high - low), high + 0.1 * (high - low), 2_000)
    beside = [np.nextafter(grid, end) for end in (-np.inf, np.inf)]
    x = np.concatenate([spread, grid, *beside, [np.nan, np.inf, -np.inf]])
    want = np.interp(x, grid, table)
    assert curve.on_even_grid(x, grid, table) == pytest.approx(want, rel=1e-14, abs=1e-14, nan_ok=True)


LOW, HIGH = np.array([10.0, -1.0]), np.array([20.0, 1.0])


def test_a_hull_has_the_corners_of_its_samples_on_the_grid() -> None:
    rng = np.random.default_rng(1)
    x, z = rng.uniform(12.0, 18.0, 400), rng.uniform(-0.5, 0.5, 400)
    corners = np.array([[10.0, -1.0], [20.0, -1.0], [20.0, 1.0], [10.0, 1.0]])
    x, z = np.append(x, corners[:, 0]), np.append(z, corners[:, 1])
    found = hull_of(np.append(x, [25.0, 15.0]), np.append(z, [0.0, 7.0]), LOW, HIGH)  # beyond the range nothing counts
    assert found is not None and sorted(map(tuple, found)) == sorted(map(tuple, corners))
    near = hull_of(np.array([10.04, 19.95, 15.0]), np.array([-0.99, -1.0, 0.99]), LOW, HIGH)
    assert near is not None and {tuple(c) for c in near} == {(10.0, -1.0), (20.0, -1.0), (15.0, 1.0)}
    assert hull_of(np.array([10.0, 15.0, 20.0]), np.array([-1.0, 0.0, 1.0]), LOW, HIGH) is None  # along a line
    assert hull_of(np.array([15.0]), np.array([0.0]), LOW, HIGH) is None


SQUARE = np.array([[12.5, -0.5], [17.5, -0.5], [17.5, 0.5], [12.5, 0.5]])
HALF = 0.5 / 64.0  # of a grid's step, of the range


def test_within_a_hull_reaches_half_a_step_beyond_it() -> None:
    x = np.array([15.0, 12.5, 12.5 - 9.9 * HALF, 12.5 - 10.1 * HALF, 17.5 + 9.9 * HALF, 17.5 + 10.1 * HALF, 15.0, 15.0])
    z = np.array([0.0, -0.5, 0.0, 0.0, 0.0, 0.0, 0.5 + 1.9 * HALF, -0.5 - 2.1 * HALF])
    assert within(SQUARE, LOW, HIGH, x, z).tolist() == [True, True, True, False, True, False, True, False]
    with pytest.raises(ValueError, match="corners along a line"):
        within(np.array([[10.0, 0.0], [15.0, 0.0], [20.0, 0.0]]), LOW, HIGH, x, z)


def test_beyond_a_hull_the_nearest_point_of_the_grid_within_it_counts() -> None:
    found = nearest_within(SQUARE, LOW, HIGH)
    k, m = np.divmod(np.arange(65 * 65), 65)
    inside = (k >= 16) & (k <= 48) & (m >= 16) & (m <= 48)
    assert (found[inside] == np.flatnonzero(inside)).all() and found.shape == (65 * 65,)
    assert (found == np.clip(k, 16, 48) * 65 + np.clip(m, 16, 48)).all()


# ---- formulas --------------------------------------------------------------------------------------------------------


def test_a_formula_s_code_gives_its_value() -> None:
    for form in forms.FORMS:
        q = np.array([0.2, 0.9, 1.7, 4.1]) if form.positive else np.array([-2.3, -0.4, 0.2, 0.9, 1.7, 4.1])
        for numbers in ([1.3, 0.7, 0.6], [-0.8, 1.4, 2.0]):
            used = np.array(numbers[: len(form.numbers)])
            code = form.code.format(**dict(zip(form.numbers, map(repr, used.tolist()), strict=True)))
            expected = [float(eval(code, {"math": math, "abs": abs, "q": v})) for v in q.tolist()]
            assert form.value(q, used) == pytest.approx(expected, rel=1e-9, abs=1e-12), form.name
        assert len(form.inner) in (0, len(form.numbers) - 1) and form.text and 1 <= form.complexity <= 6
    assert len(forms.FORMS) == 23 and forms.KELVIN == 273.15


VALUES = {  # at q = 2 with a = 3, b = 0.5, c = 0.25
    "constant": 3.0, "line": 6.0, "straight line": 4.5, "magnitude": 6.0, "sign": 3.0, "square": 12.0,
    "signed square": 12.0, "cube": 24.0, "root": 3.0 * math.sqrt(2.0), "inverse": 1.5, "power": 3.0 * math.sqrt(2.0),
    "exponential": 3.0 * (math.e - 1.0), "tanh": 3.0 * math.tanh(1.0), "quotient": 3.0, "above": 4.5, "below": 0.0,
    "step": 3.0, "gentle step": 3.0 / (1.0 + math.exp(-6.0)), "dead zone": 4.5, "limit to one side": 1.5, "limit": 1.5,
    "Arrhenius": 3.0 * math.exp(0.5 / 300.0 - 0.5 / 275.15), "sine": 3.0 * math.sin(1.25),
}  # fmt: skip


def test_formulas_have_the_values_of_their_texts() -> None:
    for form in forms.FORMS:
        numbers = np.array([3.0, 0.5, 0.25])[: len(form.numbers)]
        assert float(form.value(np.array(2.0), numbers)) == pytest.approx(VALUES[form.name]), form.name
        if form.jump:
            level, half, at = form.jump(numbers)
            below, above = form.value(np.array([at - 1e-6, at + 1e-6]), numbers)
            assert (level - half, level + half) == (pytest.approx(below), pytest.approx(above))


def test_formulas_stay_finite_up_to_their_limits_and_not_beyond() -> None:
    """At each limit and a third beyond it; closed forms, a = 3."""
    of = {
        form.name: lambda q, *n, form=form: float(form.value(np.array(q), np.array([3.0, *n]))) for form in forms.FORMS
    }
    for q, least in ((1e-12, 1e-12), (1.3e-12, 1.3e-12), (0.7e-12, 1e-12), (-0.7e-12, 1e-12), (2.0, 2.0)):
        assert of["power"](q, -1.0) == pytest.approx(math.copysign(3.0 / least, q))
        assert of["inverse"](abs(q)) == pytest.approx(3.0 / least)
    for b, used in ((8.0, 8.0), (10.0, 8.0), (-8.0, -8.0), (-10.0, -8.0), (7.0, 7.0)):
        assert of["power"](2.0, b) == pytest.approx(3.0 * 2.0**used)
    for x, used in ((50.0, 50.0), (65.0, 50.0), (40.0, 40.0), (-65.0, -50.0), (-3.0, -3.0)):
        assert of["exponential"](x, 1.0) == pytest.approx(3.0 * math.expm1(used))
        assert of["gentle step"](-x, 0.0, 1.0) == pytest.approx(3.0 / (1.0 + math.exp(used)), rel=1e-9)
        kelvin = x / (1.0 / 300.0 - 1.0 / 600.0)  # at 600 K
        assert of["Arrhenius"](600.0 - 273.15, kelvin) == pytest.approx(3.0 * math.exp(used))
    assert of["quotient"](1.0, -0.9985) == pytest.approx(3.0 / 1.5e-3) and of["quotient"](1.0, -2.0) == 3.0 / 1e-3
    assert of["gentle step"](1e-9, 0.0, 0.1e-9) == pytest.approx(3.0 / (1.0 + math.exp(-1.0)))
    assert of["gentle step"](1e-9, 0.0, 2e-9) == pytest.approx(3.0 / (1.0 + math.exp(-0.5)))


def test_the_numbers_to_begin_from_are_within_the_range_or_about_it() -> None:
    starts = {form.name: [one for _, one in form.inner] for form in forms.FORMS if form.inner}
    for kinds in starts.values():
        assert all(len(set(one)) == len(one) for one in kinds)
    at = starts["step"][0]
    assert len(at) == 97 and at == pytest.approx([0.02 + 0.01 * k for k in range(97)])


def test_signs_that_change_nothing_are_dropped_and_only_those() -> None:
    q = np.linspace(-3.0, 3.0, 25)
    for form in forms.FORMS:
        numbers = -np.array([3.0, 0.5, 0.25])[: len(form.numbers)]
        plain = form.plain(numbers)
        assert plain.tolist() == [abs(v) if i in form.magnitudes else v for i, v in enumerate(numbers)]
        assert form.positive or form.value(q, plain) == pytest.approx(form.value(q, numbers)), form.name
        assert form.magnitudes == {"gentle step": (2,), "dead zone": (1,), "limit": (1,)}.get(form.name, ())
        assert form.positive == (form.name == "inverse")
        assert form.signed == (form.name in ("magnitude", "sign", "signed square", "dead zone")), form.name


def test_a_product_multiplies_each_with_each() -> None:
    by = {form.name: form for form in forms.FORMS}
    x, z = np.array([1.0, 2.0]), np.array([3.0, 4.0, 5.0])
    found = forms.product(by["line"], by["above"], x, z, np.array([2.0, 3.5]))  # 2 x max(z - 3.5, 0)
    assert found.tolist() == [[0.0, 1.0, 3.0], [0.0, 2.0, 6.0]]
    assert forms.product(by["constant"], by["square"], x, z, np.array([0.5])).tolist() == [[4.5, 8.0, 12.5]] * 2


# ---- work side by side -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cores, items, may, shared", [
    (2, 3, True, True), (2, 2, True, True), (2, 1, True, False), (1, 3, True, False), (2, 3, False, False),
    (4, 0, True, False),
])  # fmt: skip
def test_work_is_shared_out_once_and_answers_keep_their_order(
    cores: int, items: int, may: bool, shared: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vaneloop.base.side_by_side.threads", lambda: cores)

    def of(item: int) -> tuple[int, bool, list[bool]]:
        return item, shared_out(), list(side_by_side(lambda _: shared_out(), range(2)))

    found = list(side_by_side(of, iter(range(items)), may))
    inner = [True, True] if shared or cores > 1 else [False, False]
    assert found == [(k, shared, inner) for k in range(items)] and not shared_out()


def test_what_nobody_waits_for_any_more_is_not_begun(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vaneloop.base.side_by_side.threads", lambda: 2)
    begun: list[int] = []
    go = threading.Event()

    def of(item: int) -> int:
        begun.append(item)
        if item:
            go.wait(10.0)
        return item

    answers = side_by_side(of, range(50))
    assert next(answers) == 0
    threading.Timer(0.05, go.set).start()
    answers.close()  # type: ignore[attr-defined]
    assert len(begun) < 10


# ---- what a command prints -------------------------------------------------------------------------------------------


def said(quiet: bool = False, to: str | None = None) -> argparse.Namespace:
    """Options of a command about its output."""
    return argparse.Namespace(quiet=quiet, json=to)


def test_text_goes_to_standard_output_unless_json_does(capsys: pytest.CaptureFixture[str]) -> None:
    for args in (said(), said(to="x.json"), said(to="-"), said(quiet=True)):
        terminal.say(args, f"text {args.json}")
    out, err = capsys.readouterr()
    assert out == "text None\ntext x.json\n" and err == "text -\n"


def test_pairs_are_split_and_given_once() -> None:
    assert terminal.pairs(["a=1", " b = x=y ", "a=1"], "map") == {"a": "1", "b": "x=y"}
    for wrong in ("a", "=1", "a=", " =1", "a= "):
        with pytest.raises(InputError, match=r"--map .* must look like NAME=value"):
            terminal.pairs([wrong], "map")
    with pytest.raises(InputError, match="'a' has been given '1' before; allowed: once"):
        terminal.pairs(["a=1", "a=2"], "map")
    known: Callable[[str], bool] = lambda name: name in ("vigv", "n_r")  # noqa: E731
    assert terminal.pairs(["n_r=1"], "map", known, "vigv, n_r") == {"n_r": "1"}
    with pytest.raises(InputError, match=r"'vgiv' is not known \(did you mean vigv\?\); allowed: vigv, n_r"):
        terminal.pairs(["vgiv=1"], "map", known, "vigv, n_r")


def test_json_has_plain_numbers_and_null_for_none(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = {
        1: np.float64(2.5), "b": np.array([1.0, np.nan]), "c": (np.inf, np.int64(3), True, None, "t"),
        "d": {"e": [np.array(4)]}, "f": -math.inf, "g": [np.bool_(False)],
    }  # fmt: skip
    expected = {
        "1": 2.5, "b": [1.0, None], "c": [None, 3, True, None, "t"], "d": {"e": [4]}, "f": None, "g": [False],
    }  # fmt: skip
    assert terminal.plain(data) == expected and terminal.plain(0.0) == 0.0
    terminal.write_json(said(), data)
    assert capsys.readouterr().out == ""
    monkeypatch.chdir(tmp_path)
    terminal.write_json(said(to="-"), data)
    assert json.loads(capsys.readouterr().out) == expected and list(tmp_path.iterdir()) == []
    out = Told()
    monkeypatch.setattr(sys, "stdout", out)
    terminal.write_json(said(to="-"), data)
    terminal.say(said(), "text")
    assert out.flushed == 2  # whoever reads it need not wait for the end
    monkeypatch.undo()
    terminal.write_json(said(to=str(tmp_path / "x.json")), data)
    written = (tmp_path / "x.json").read_text()
    assert json.loads(written) == expected and written.endswith("}\n") and written.startswith('{\n  "1"')
    assert capsys.readouterr().out == ""
    with pytest.raises(InputError, match="cannot write"):
        terminal.write_json(said(to=str(tmp_path / "no" / "x.json")), data)


def test_a_table_has_its_numbers_to_the_right(capsys: pytest.CaptureFixture[str]) -> None:
    rows = [["first", "1.5", "on", "7" * 31], ["second", "12.25", "off", "8"]]
    terminal.print_table(said(), "A title", ["name", "number", "word", "long"], rows)
    lines = [line.rstrip() for line in capsys.readouterr().out.splitlines() if line.strip()]
    assert lines[0] == "A title" and len(lines) == 5
    first, second = lines[3], lines[4]
    assert first.index("1.5") + 3 == second.index("12.25") + 5  # numbers end together, words begin together
    assert first.index("on") == second.index("off") and first.index("7" * 31) == second.index("8")
    assert first.index("first") == second.index("second")
    terminal.print_table(said(to="-"), "A title", ["[b]x[/b]"], [])
    out, err = capsys.readouterr()
    assert out == "" and "[b]x[/b]" in err
    terminal.print_table(said(quiet=True), "A title", ["x"], rows)
    assert capsys.readouterr() == ("", "")


def test_a_long_line_of_a_table_has_150_columns(capsys: pytest.CaptureFixture[str]) -> None:
    terminal.print_table(said(), "t", ["x"], [["word " * 100]])
    assert 140 < max(map(len, capsys.readouterr().out.splitlines())) <= 150


@pytest.mark.parametrize("raised, code, says", [
    (None, 3, ""), (KeyboardInterrupt(), 130, "stopped\n"),
    (InputError("x (=1) must be 2"), 2, "vaneloop: x (=1) must be 2\n"),
    (MemoryError(), 70, "vaneloop: the machine's memory does not suffice for this\n"),
    (ZeroDivisionError("why\nnot"), 70, "vaneloop: internal error: ZeroDivisionError: why not (test_base_spec.py:"),
])  # fmt: skip
def test_how_a_command_ends(
    raised: BaseException | None, code: int, says: str, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.delenv("VANELOOP_DEBUG", raising=False)

    def command() -> int:
        if raised is not None:
            raise raised
        return 3

    assert terminal.run(command) == code
    out, err = capsys.readouterr()
    assert out == "" and err.startswith(says) and err.count("\n") == bool(says)
    if "internal" in says:
        file = Path(err.split("traceback in ")[1].strip())
        assert "ZeroDivisionError: why" in file.read_text() and file.name.startswith("vaneloop-")
        assert file.name.endswith(".traceback")
        file.unlink()
    assert terminal.DEFECT == 70


def test_a_traceback_is_printed_where_asked_for_and_a_long_complaint_cut(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("VANELOOP_DEBUG", "1")
    line = terminal.defect(ValueError("x" * 500))
    assert line.startswith(f"internal error: ValueError: {'x' * 188}. This is a defect") and "traceback above" in line
    assert capsys.readouterr().err.count("x" * 500) == 1
    killed = type("BrokenProcessPool", (Exception,), {})()
    assert terminal.defect(killed).startswith("a process of the search was ended from outside")


def test_a_reader_that_goes_ends_a_command_in_silence(capsys: pytest.CaptureFixture[str]) -> None:
    def command() -> int:
        raise terminal.ReaderGone

    assert terminal.run(command) == 0 and capsys.readouterr() == ("", "")


def test_a_command_runs_from_its_words(capsys: pytest.CaptureFixture[str]) -> None:
    module = SimpleNamespace(
        DESCRIPTION="what it does",
        add_options=lambda parser: parser.add_argument("--some-option", choices=["one", "two"]),
        command=lambda args: 1 if args.some_option == "two" else 0,
    )
    start = lambda *words: terminal.start("vaneloop do", lambda: module, list(words))  # noqa: E731
    assert start() == 0 and start("--some-option", "two") == 1
    for words, says in (
        (("--some-option", "twoo"), "(did you mean two?) (vaneloop do --help explains)\n"),
        (("--some-optoin=3",), "unrecognized arguments: --some-optoin=3 (did you mean --some-option?) (vaneloop do"),
        (("--some", "two"), "unrecognized arguments: --some two"),
        (("word",), "unrecognized arguments: word (vaneloop do --help explains)\n"),
    ):  # fmt: skip
        with pytest.raises(SystemExit) as left:
            start(*words)
        err = capsys.readouterr().err
        assert left.value.code == 2 and err.startswith("vaneloop do: ") and says in err and err.count("\n") == 1


def test_progress_is_drawn_on_a_terminal_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[Any] = []

    class Bar:
        def __init__(self, *_: Any, transient: bool, console: Any):
            assert transient and console.stderr

        def __enter__(self) -> Bar:
            return self

        def __exit__(self, *_: object) -> None:
            drawn.append("end")

        def add_task(self, text: str, total: float) -> str:
            return f"{text} of {total}"

        def update(self, task: str, **now: Any) -> None:
            drawn.append((task, now))

    monkeypatch.setattr("rich.progress.Progress", Bar)
    for quiet, terminal_there in ((True, True), (False, False), (False, True)):
        monkeypatch.setattr(terminal, "is_terminal", lambda stream, there=terminal_there: there)
        with terminal.progress_bar(said(quiet), "work") as tell:
            assert (tell is None) == (quiet or not terminal_there)
            if tell is not None:
                tell(0.25)
                tell(0.5, "other work")
    first, second = ({"completed": f, "description": d} for f, d in ((0.25, "work"), (0.5, "other work")))
    assert drawn == [("work of 1.0", first), ("work of 1.0", second), "end"]


def test_control_characters_are_shown() -> None:
    assert terminal.clean("a\x1b[31m\n\u202eb\udc80") == "a\\x1b[31m\\x0a\\u202eb\\udc80"
    assert terminal.clean("a\nb\tc\x7f\x9f\xa0", lines=True) == "a\nb\\x09c\\x7f\\x9f\xa0"
    assert terminal.clean("\x1f \u2027\u2028\u2065\u2069\u206a") == "\\x1f \u2027\\u2028\u2065\\u2069\u206a"


def test_what_turns_or_hides_text_is_shown_and_nothing_else() -> None:
    turns = {0x061C, 0x200E, 0x200F, *range(0x2028, 0x202F), *range(0x2066, 0x206A)}
    for code in range(0x3000):
        shown = unicodedata.category(chr(code)) == "Cc" or code in turns
        assert terminal.clean(chr(code)) == (repr(f"\\x{code:02x}" if code < 256 else f"\\u{code:04x}")[1:-1].replace(
            "\\\\", "\\") if shown else chr(code)), hex(code)  # fmt: skip


def test_what_a_user_asked_for_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["/usr/bin/vaneloop", "run", "--bus", "vcan0"])
    assert terminal.typed("run") == "vaneloop run --bus vcan0"
    assert terminal.number("1e3") == 1000.0 and math.isnan(terminal.number("x")) and math.isnan(terminal.number(""))


def test_a_process_of_ours_takes_no_module_from_where_the_user_stands(tmp_path: Path) -> None:
    (tmp_path / "json.py").write_text("print('theirs')")
    says = child.python("import json, sys, vaneloop; print(json.dumps(sys.argv[1:]))", "a", "b c")
    assert says[1:3] == ["-P", "-c"] and says[4:] == ["a", "b c"] and says[0] == sys.executable
    plain = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    done = subprocess.run(says, cwd=tmp_path, capture_output=True, text=True, check=True, env=plain)
    assert done.stdout == '["a", "b c"]\n'
    module = child.python_module("some.module", "a")
    assert "runpy.run_module('some.module', run_name='__main__', alter_sys=True)" in module[3] and module[4:] == ["a"]


class Told(io.StringIO):
    """A stream that says when it is flushed."""

    flushed = 0

    def flush(self) -> None:
        self.flushed += 1


def test_what_a_command_wrote_is_out_when_it_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    out = Told()
    monkeypatch.setattr(sys, "stdout", out)

    def command() -> int:
        out.flushed = 0
        return 0

    assert terminal.run(command) == 0 and out.flushed >= 1
    monkeypatch.setattr(sys, "stdout", None)
    assert terminal.run(lambda: 0) == 0


def test_output_is_written_whole_or_refused_once() -> None:
    read, write = os.pipe()
    out = terminal._Output(write, "w")
    os.set_blocking(write, False)
    data = bytes(300_000)  # more than a pipe holds: it waits for the reader
    got: list[bytes] = []

    def reads() -> None:
        while sum(map(len, got)) < len(data):
            got.append(os.read(read, 1 << 16))

    reader = threading.Thread(target=reads)
    reader.start()
    assert out.write(data) == 300_000 and not out.isatty()
    reader.join()
    assert b"".join(got) == data and out.write(memoryview(np.arange(3.0))) == 24 and len(os.read(read, 99)) == 24
    os.close(read)
    with pytest.raises(terminal.ReaderGone):
        out.write(b"x")
    assert out.write(b"more") == 4 and out.dead  # what comes after it is dropped
    out.close()
    with terminal._Output("/dev/full", "w") as full:
        with pytest.raises(InputError, match="standard output: cannot be written .No space left on device"):
            full.write(b"x")
        assert full.write(b"y") == 1
    with terminal._Complaints("/dev/full", "w") as nobody:
        assert nobody.write(b"x") == 1 and nobody.dead


def test_standard_streams_are_there_and_as_they_were_afterwards(monkeypatch: pytest.MonkeyPatch) -> None:
    ours, theirs = io.StringIO(), io.StringIO()
    for name in ("stdout", "stderr"):
        monkeypatch.setattr(sys, f"__{name}__", None)
        monkeypatch.setattr(sys, name, ours)
    monkeypatch.setattr(sys, "stdin", None)
    with terminal.standard_streams():
        assert sys.stdin.read() == "" and sys.stdout is sys.stderr is ours  # a program's own stay
    assert sys.stdin is None
    monkeypatch.setattr(sys, "__stdout__", ours)
    monkeypatch.setattr(sys, "__stderr__", theirs)
    monkeypatch.setattr(sys, "stderr", theirs)
    opened: list[Any] = []
    fstat = os.fstat

    def closed(fd: int) -> os.stat_result:
        if fd == 1:
            raise OSError(errno.EBADF, "closed")
        return fstat(fd)

    monkeypatch.setattr(terminal, "_wrapped", lambda kind, fd, stream: (kind, fd, stream))
    monkeypatch.setattr(terminal.os, "fstat", closed)
    monkeypatch.setattr(terminal.os, "open", lambda name, how: opened.append((name, how)) or 99)
    monkeypatch.setattr(terminal.os, "set_inheritable", lambda fd, may: opened.append((fd, may)))
    with terminal.standard_streams():
        assert sys.stdout == (terminal._Output, 1, ours) and sys.stderr == (terminal._Complaints, 2, theirs)
    assert sys.stdout is ours and sys.stderr is theirs and opened == [(os.devnull, os.O_RDWR), (99, True)]


def test_a_stream_is_wrapped_with_its_encoding(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Kind(terminal._Output):
        def __init__(self, at: Any, *how: Any, **more: Any):
            asked.append((at, how, more))
            super().__init__(str(tmp_path / "out"), "w")

    asked: list[Any] = []
    for fd, stream, encoding, lines in (
        (1, SimpleNamespace(encoding="latin-1"), "latin-1", False),
        (2, SimpleNamespace(encoding="ascii"), "ascii", True), (1, None, "utf-8", False),
    ):  # fmt: skip
        made = terminal._wrapped(Kind, fd, stream)
        made.write("\udc80\u20ac")
        assert (made.encoding, made.line_buffering, made.errors) == (encoding, lines, "backslashreplace")
        made.close()
    given = ("w",), {"closefd": False}
    assert asked == [(1, *given), (2, *given), (os.devnull, ("w",), {})]
    monkeypatch.setattr(terminal, "is_terminal", lambda stream: True)
    assert terminal._wrapped(Kind, 1, None).line_buffering


@pytest.fixture
def typed() -> Iterator[Any]:
    """A terminal that controls nobody."""
    master, slave = os.openpty()
    yield SimpleNamespace(fileno=lambda: slave)
    os.close(master)
    os.close(slave)


def test_keys_come_at_once_on_the_terminal_that_controls_this_process(
    typed: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def waits_for_lines() -> bool:
        return bool(termios.tcgetattr(typed.fileno())[3] & termios.ICANON)

    assert terminal.is_terminal(typed) and not terminal.is_terminal(object())
    assert not terminal.is_terminal(SimpleNamespace(fileno=lambda: -1))
    with terminal.keyboard(typed) as fd:
        assert fd is None and waits_for_lines()
    monkeypatch.setattr(terminal.os, "tcgetpgrp", lambda fd: os.getpgrp() + 1)
    with terminal.keyboard(typed) as fd:
        assert fd is None and waits_for_lines() and terminal.input_of(typed) is None
    for group in (os.getpgrp(), 0):
        monkeypatch.setattr(terminal.os, "tcgetpgrp", lambda fd, group=group: group)
        assert terminal.input_of(typed) == typed.fileno()
        with terminal.keyboard(typed) as fd:
            assert (fd == typed.fileno()) == (not waits_for_lines()) == bool(group)
        assert waits_for_lines()
    with terminal.keyboard(object()) as fd:
        assert fd is None and terminal.input_of(object()) is None
    monkeypatch.undo()
    read, write = os.pipe()
    assert terminal.input_of(SimpleNamespace(fileno=lambda: read)) == read
    os.close(read)
    os.close(write)


# ---- compiled code ---------------------------------------------------------------------------------------------------


def test_compiled_code_is_kept_where_that_can_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = compiled.cache_folder.__wrapped__
    monkeypatch.setattr(compiled, "__file__", str(tmp_path / "package" / "compiled.py"))
    monkeypatch.setattr(Path, "home", classmethod(lambda cls: cls(tmp_path / "home")))
    name = f"compiled-{kept.sources_digest()}"
    for _ in range(2):  # it may be there already
        assert folder() == tmp_path / "package" / "__pycache__" / name
    refused = {tmp_path / "package" / "__pycache__"}
    monkeypatch.setattr(compiled.os, "access", lambda place, mode: place not in refused and mode == compiled.os.W_OK)
    cache = tmp_path / "home" / ".cache" / "vaneloop"
    assert folder() == cache / name
    cache.rmdir()
    cache.write_text("no folder")
    gone: list[Any] = []
    monkeypatch.setattr(files.atexit, "register", lambda *a, **how: gone.append((*a, how)))
    own = folder()  # of this process alone, and gone with it
    assert own.name == name and gone == [(files.shutil.rmtree, str(own.parent), {"ignore_errors": True})]
    assert own.parent.name.startswith("vaneloop-") and own.parent.stat().st_mode & 0o777 == 0o700
    own.parent.rmdir()


def test_code_is_kept_found_and_forgotten(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cache = tmp_path / "not" / "there"
    monkeypatch.setattr(config, "CACHE_DIR", str(cache))
    monkeypatch.setattr(kept, "AHEAD", tmp_path / "ahead")

    def twice(x: float) -> float:
        return 2.0 * x

    one = kept.keep(njit(twice), lambda: "a stamp", "own")
    own = one._cache
    assert own.cache_path == str(cache / "own") and not kept.is_kept(one) and one(1.5) == 3.0 and kept.is_kept(one)
    (made,) = (cache / "own").iterdir()  # nothing half written is left
    assert made.suffix == kept.ENTERED and made.name.startswith("test_base_spec.twice-")
    again = kept.keep(njit(twice), lambda: "a stamp", "own")
    assert again._cache.load_overload((types.float64,), again.targetctx) is not None
    assert again._cache.load_overload((types.int64,), again.targetctx) is None
    other = kept.keep(njit(twice), lambda: "another stamp", "own")
    assert not kept.is_kept(other) and other._cache.load_overload((types.float64,), other.targetctx) is None
    (tmp_path / "ahead" / "own").mkdir(parents=True)
    made.rename(tmp_path / "ahead" / "own" / made.name)  # compiled ahead
    assert kept.is_kept(again) and again._cache.load_overload((types.float64,), again.targetctx) is not None
    (tmp_path / "ahead" / "own" / made.name).rename(made)
    again._cache.flush()
    assert not made.exists() and not kept.is_kept(again) and kept.is_kept(twice)


def test_names_and_kinds_of_numbers_are_in_a_function_s_digest() -> None:
    def digest(source: str, **space: Any) -> str:
        exec(source, {"__name__": "mine", "math": math, **space}, own := {})
        made = types_of_python.FunctionType(own["f"].__code__, {"__name__": "mine", "math": math, **space}, "f")
        return kept.digest_of(made)

    digests = [digest(f"def f(x): return {text}") for text in ("math.sin(x)", "math.cos(x)")]
    digests += [digest(f"def f({name}): return {name}") for name in "xy"]
    digests += [digest("def f(x): return k * x", k=k) for k in (np.float32(1.0), np.float32(2.0), np.int8(1))]
    for stamp in ("one", "two"):
        digests.append(digest("def f(x): return g(x)", g=SimpleNamespace(vaneloop_digest=stamp)))
    digests += [digest(f"def f(x, y): return x {sign} y") for sign in "+-"]  # nothing but the bytecode differs
    digests += [digest("def f(x): return g(x)", g=g) for g in (math.sin, math.cos, np.sin, abs, kept.digest_of)]
    digests += [digest("def f(x): return k[0] * x", k=k) for k in ((1.0,), (2.0,), (1,), (1.0, 1.0), np.ones(1))]
    digests += [digest(f"def f(x): return (lambda y: y + {n})(x)") for n in (1, 2)]
    assert all(digests) and len(set(digests)) == len(digests)
    assert digest("def f(x): return k[0]", k=([1.0],)) == digest("def f(x): return g(x)", g=SimpleNamespace()) == ""


def test_what_is_compiled_follows_from_every_source(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = kept.sources_digest.__wrapped__
    assert whole() == kept.sources_digest()
    monkeypatch.setattr(kept, "_ROOT", tmp_path)
    (tmp_path / "plant" / "effects").mkdir(parents=True)
    (tmp_path / "vaneloop" / "pages").mkdir(parents=True)
    digests = [whole()]
    for name in ("plant/a.py", "plant/effects/b.py", "vaneloop/pages/c.py", "plant/d.txt"):
        (tmp_path / name).write_text("x = 1")
        digests.append(whole())
    (tmp_path / "plant" / "a.py").write_text("x = 2")
    digests.append(whole())
    monkeypatch.setattr(kept.numba, "__version__", "0.0")
    digests.append(whole())
    assert digests[2:5] == [digests[2]] * 3 and len(set(digests)) == 5  # pages and texts are not compiled


def test_a_user_s_function_is_compiled_under_its_digest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(kept, "AHEAD", tmp_path / "ahead")

    def scaled(x: float, by: float = 2.0) -> float:
        return by * x

    def moved(x: float, *, plus: float = 1.0) -> float:
        return x + plus

    of = kept.kept_njit(scaled)
    digest = kept.digest_of(scaled)
    assert of.vaneloop_digest == digest and of.py_func.__qualname__ == f"scaled_{digest[:24]}"
    assert (of.py_func.__module__, of.py_func.__defaults__) == (kept.__name__, (2.0,))
    assert kept.kept_njit(moved).py_func.__kwdefaults__ == {"plus": 1.0}
    assert of(3.0) == 6.0 and len(list((tmp_path / "own").iterdir())) == 1 and kept.is_kept(of)
    thing = object()

    def unknown(x: float) -> float:
        return x if thing is None else 2.0 * x

    names = [kept.kept_njit(unknown).py_func.__qualname__ for _ in range(2)]
    assert len(set(names)) == 2 and all(n.startswith("unknown_") for n in names)
    assert not hasattr(kept.kept_njit(unknown), "vaneloop_digest")


def test_a_user_is_told_of_compiling_once_unless_the_command_has_told(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(terminal, "is_command", True)
    monkeypatch.setattr(sys, "argv", ["vaneloop", "run"])
    line = "vaneloop: compiling what has not run on this machine before (once, it is kept) ...\n"
    for told in (False, True):
        monkeypatch.setattr(terminal, "told_of_compiling", told)
        waiting = kept.Waiting(60.0)
        waiting.on_start(None)
        timer = waiting.timer
        assert timer is not None and timer.daemon and timer.interval == 60.0 and timer.is_alive()
        waiting.on_start(None)
        assert waiting.timer is timer and waiting.depth == 2
        waiting.tell()
        assert waiting.told == (not told) and capsys.readouterr().err == ("" if told else line)
        waiting.on_end(None)
        assert terminal.told_of_compiling == told and not timer.finished.is_set()
        waiting.on_end(None)
        assert timer.finished.is_set() and not terminal.told_of_compiling and waiting.depth == 0
        waiting.on_start(None)
        assert (waiting.timer is timer) == (not told)  # once is enough
        waiting.on_end(None)
    monkeypatch.setattr(terminal, "told_of_compiling", False)
    for words, command in ((["vaneloop", "--quiet"], True), (["vaneloop"], False)):
        monkeypatch.setattr(sys, "argv", words)
        monkeypatch.setattr(terminal, "is_command", command)
        terminal.compiling()
    terminal.say(said(quiet=True), "compiling the simulator")
    assert terminal.told_of_compiling and capsys.readouterr() == ("", "")


@pytest.mark.parametrize(("addresses", "loops", "keeps"), [(False, [], 1), (True, [], 0), (False, ["a loop"], 0)])
def test_code_that_holds_addresses_of_this_process_is_not_kept(
    addresses: bool, loops: list[str], keeps: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path))
    of = kept._Files(math_free, lambda: "a stamp", "")
    monkeypatch.setattr(of, "_index_key", lambda sig, codegen: (sig, codegen), raising=False)
    code = SimpleNamespace(
        library=SimpleNamespace(has_dynamic_globals=addresses), lifted=loops, codegen="c", _reduce=lambda: ("made",)
    )
    of.save_overload("sig", code)
    assert len(list(tmp_path.iterdir())) == keeps
    of.flush()
    of.flush()
    assert list(tmp_path.iterdir()) == []


def math_free(x: float) -> float:
    """A function of a file."""
    return x


def test_variables_are_found_however_deep_an_instruction_holds_them(monkeypatch: pytest.MonkeyPatch) -> None:
    if not lean.is_known():
        return
    scope = ir.Scope(None, loc := ir.Loc("f.py", 1))
    a, b, c, d = (ir.Var(scope, name, loc) for name in "abcd")
    inner = ir.Expr.binop(print, a, b, loc)
    monkeypatch.setattr(lean, "_NO_VARIABLES", set())
    held = {"value": inner, "more": [c, ("word", 3, {"deep": d})], "none": None}
    assert lean._variables(None, held) == lean._variables(None, held) == [a, b, c, d]
    assert {str, int, type(None)} <= lean._NO_VARIABLES and ir.Var not in lean._NO_VARIABLES


def test_what_is_changed_inside_numba(monkeypatch: pytest.MonkeyPatch) -> None:
    if not lean.is_known():
        return
    for of, name in ((compiler.Flags, "__eq__"), (compiler.Flags, "__hash__"), (types.BaseFunction, "get_call_type"),
                     (codegen.CPUCodeLibrary, "_optimize_functions"),
                     (type(errors.termcolor()), "_markup")):  # fmt: skip
        monkeypatch.setattr(of, name, lambda self, *_: "as it comes")
    lean._change_numba()
    flags: Any = compiler.Flags
    assert (flags.__eq__, flags.__hash__) == (lean._same_flags, lean._hash_of_flags)
    assert codegen.CPUCodeLibrary._optimize_functions is lean._optimise_functions
    assert type(errors.termcolor())._markup is lean._plain
    assert types.BaseFunction.get_call_type.__qualname__.startswith("_remembering.")
    assert types.BaseFunction.get_call_type(SimpleNamespace(), None, (), {"k": 1}) == "as it comes"


def test_the_latest_files_of_users_functions_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kept, "OWN", 2)
    for k in (3, 1, 4, 2, 5):
        file = tmp_path / f"{k}{kept.ENTERED}"
        file.write_text("x")
        kept.os.utime(file, (100.0 + k, 100.0 + k))
    (tmp_path / f"0{kept.INNER}").write_text("x")
    kept._prune(tmp_path)
    assert sorted(f.name for f in tmp_path.iterdir()) == [f"0{kept.INNER}", "4.nbc", "5.nbc"]
    kept._prune(tmp_path)
    kept._prune(tmp_path / "none")
    assert len(list(tmp_path.iterdir())) == 3


def test_garbage_waits_for_the_outermost_compilation() -> None:
    quiet, was = lean._NoCollection(), gc.isenabled()
    try:
        for before in (True, False):
            (gc.enable if before else gc.disable)()
            quiet.on_start(None)
            quiet.on_start(None)
            assert not gc.isenabled() and quiet.depth == 2
            quiet.on_end(None)
            assert not gc.isenabled()
            quiet.on_end(None)
            assert gc.isenabled() == before and quiet.depth == 0
    finally:
        (gc.enable if was else gc.disable)()


class Dispatcher:
    """Stands for a function that numba compiles."""

    def __init__(self, **options: bool):
        self.targetoptions, self.py_func = options, print
        self.overloads: dict[Any, Any] = {}
        self._cache, self._compiler = SimpleNamespace(inner=None), SimpleNamespace(_customize_flags=None)
        self.asked: list[Any] = []
        self.get_call_template = lambda args, kws: self.asked.append((args, kws, self.calls.within)) or "template"
        self.compile = lambda sig: self.asked.append((sig, self._cache.inner, dict(self.overloads))) or "code"
        self.add_overload = self.asked.append
        self.calls = lean._Calls(self)


def made(address: int, *args: Any) -> Any:
    """Compiled code with an entry for Python at this address."""
    return SimpleNamespace(
        library=SimpleNamespace(get_pointer_to_function=lambda name: address if name == "entry" else -1),
        fndesc=SimpleNamespace(llvm_cpython_wrapper_name="entry"), signature=SimpleNamespace(args=args),
    )  # fmt: skip


def test_what_compiled_code_calls_gets_no_entry_until_python_calls() -> None:
    of = Dispatcher()
    assert of.get_call_template((types.literal(3),), {"k": types.literal(4)}) == "template"
    assert of.asked.pop() == ((types.literal(3),), {"k": types.literal(4)}, True) and not of.calls.within
    assert Dispatcher(forceinline=False).get_call_template((types.literal(3),), {}) == "template"
    inline = Dispatcher(forceinline=True)
    inline.get_call_template((types.literal(3), types.float64), {"k": types.literal(4)})
    assert inline.asked == [((types.int64, types.float64), {"k": types.int64}, True)]
    flags = SimpleNamespace(no_cpython_wrapper=False)
    assert of._compiler._customize_flags(flags) is flags and not flags.no_cpython_wrapper
    of.calls.within = True
    assert of._compiler._customize_flags(flags) is flags and flags.no_cpython_wrapper
    sig, bare, entered = (types.float64,), made(0, types.float64), made(77, types.float64)
    of.add_overload(bare)
    assert of.overloads == {sig: bare} and of.asked == []
    assert of.compile(sig) == "code" and of.asked.pop() == (sig, True, {sig: bare})  # compiled code asks
    of.calls.within = False
    assert of.compile(sig) == "code" and of.asked.pop() == (sig, False, {})  # Python asks: once more, with an entry
    of.overloads[sig] = entered
    of.compile(sig)
    assert of.asked.pop() == (sig, False, {sig: entered})
    of.add_overload(entered)
    assert of.asked == [entered]


def test_a_failed_look_up_leaves_a_function_callable_by_python() -> None:
    of = Dispatcher()
    of.calls.template = lambda *_: 1 / 0
    with pytest.raises(ZeroDivisionError):
        of.get_call_template((), {})
    assert not of.calls.within


def test_only_what_numba_compiles_is_compiled_so() -> None:
    assert lean.called_by_code(print) is print
    if lean.is_known():
        of = njit(lambda x: x)
        assert lean.called_by_code(of) is of and isinstance(of.compile.__self__, lean._Calls)


def test_the_type_of_a_call_of_numbers_is_found_once() -> None:
    asked: list[Any] = []
    good = SimpleNamespace(args=("good",))

    def find(self: Any, context: Any, args: Any, kws: Any) -> Any:
        asked.append(args)
        return good if types.float64 in args else None if types.int32 in args else SimpleNamespace(args=("other",))

    of = SimpleNamespace(_impl_keys={("good",): "key", ("other",): "compiled"}, typing_key="key")
    get = lean._remembering(find)
    for args, kws, times in (
        ((types.float64,), {}, 1), ((types.float64, types.boolean), {}, 1), ((types.float64,), {"k": 1}, 2),
        ((types.float64, types.unicode_type), {}, 2), ((types.int32,), {}, 2), ((types.int64,), {}, 2),
    ):  # fmt: skip
        asked.clear()
        first, second = get(of, "context", args, kws), get(of, "context", args, kws)
        assert len(asked) == times, args
        assert first is second or first.args == second.args
    get(of, "another context", (types.float64,), {})
    assert asked == [(types.int64,), (types.int64,), (types.float64,)]


def test_options_that_say_the_same_are_equal() -> None:
    flags: Any = compiler.Flags
    a, b = flags(), flags()
    assert lean._given(a) == {} and lean._same_flags(a, b) and lean._same_flags(a, object()) is NotImplemented
    a.release_gil = not a.release_gil
    assert list(lean._given(a)) == ["release_gil"] and not lean._same_flags(a, b)
    assert lean._hash_of_flags(a) != lean._hash_of_flags(b)
    b.release_gil = a.release_gil
    assert lean._same_flags(a, b) and lean._hash_of_flags(a) == lean._hash_of_flags(b)
    assert lean._plain(None, "text", 1, 2) == "text"


def test_functions_that_are_only_declared_are_not_optimised() -> None:
    done: list[Any] = []
    functions = [SimpleNamespace(name=n, is_declaration=n == "b") for n in "abc"]
    module = SimpleNamespace(data_layout="", functions=functions)
    timed = SimpleNamespace(record=lambda text, _: pytest.MonkeyPatch.context())
    passes = SimpleNamespace(run=lambda f, builder: done.append((f.name, builder)))
    codegen = SimpleNamespace(_data_layout="e-p", _function_pass_manager=lambda: (passes, "builder"))
    lean._optimise_functions(SimpleNamespace(_codegen=codegen, _recorded_timings=timed), module)
    assert module.data_layout == "e-p" and done == [("a", "builder"), ("c", "builder")]


def test_how_functions_are_compiled() -> None:
    assert kept.sources_digest() == compiled.sources_digest() and len(kept.sources_digest()) == 16
    assert compiled.threads() == int(config.NUMBA_NUM_THREADS)
    for of, options in (
        (compiled.compiled, {}), (compiled.compiled_free, {"nogil": True}), (compiled.in_place, {"_nrt": False}),
        (compiled.in_place_free, {"nogil": True, "_nrt": False}),
        (compiled.inlined, {"_nrt": False, "forceinline": True}),
        (compiled.fused, {"_nrt": False, "forceinline": True, "fastmath": {"contract"}}),
    ):  # fmt: skip
        made_of: Any = of(lambda x: x)
        expected = options | {"error_model": "numpy", "no_cfunc_wrapper": True}
        assert {k: v for k, v in made_of.targetoptions.items() if k not in ("nopython", "boundscheck")} == expected
