"""Formulas of channels: against numpy and closed forms, on rasters of their own, and every complaint in one line."""

from __future__ import annotations

import json
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import vaneloop
from hil.logs.formula import FUNCTIONS, FormulaError, formula_of, named
from tests.conftest import ROOT
from vaneloop.base.errors import InputError

LOG = ROOT / "examples" / "hidden_effect.parquet"


def channel(t: np.ndarray, values: np.ndarray, unit: str = "") -> vaneloop.Channel:
    return vaneloop.Channel(np.asarray(t, dtype=float), np.asarray(values, dtype=float), unit=unit)


# ---- numbers ---------------------------------------------------------------------------------------------------------

NUMBERS = st.floats(0.1, 5.0).map(lambda x: f"{x:.3g}")


def _expressions(parts: st.SearchStrategy[str]) -> st.SearchStrategy[str]:
    pair = st.tuples(parts, st.sampled_from(["+", "-", "*", "/"]), parts)
    return st.one_of(
        pair.map(lambda p: f"({p[0]} {p[1]} {p[2]})"), parts.map(lambda p: f"-{p}"), parts.map(lambda p: f"abs({p})"),
        st.tuples(parts, st.integers(0, 3)).map(lambda p: f"({p[0]}) ** {p[1]}"),
        st.tuples(parts, parts).map(lambda p: f"max({p[0]}, {p[1]})"),
        st.tuples(parts, parts, parts).map(lambda p: f"where({p[0]} > 1, {p[1]}, {p[2]})"),
        st.tuples(parts, parts, parts).map(lambda p: f"{p[0]} - {p[1]} * {p[2]}"),
    )  # fmt: skip


@given(st.recursive(st.one_of(NUMBERS, st.sampled_from(["a", "b"])), _expressions, max_leaves=12))
def test_a_formula_is_what_python_makes_of_the_same_words(text: str) -> None:
    t = np.arange(40.0)
    a, b = 2.5 + np.sin(t), 1.5 + 0.3 * np.cos(3.0 * t)
    names = {"a": a, "b": b, "where": np.where, "max": np.maximum, "abs": np.abs}
    with np.errstate(all="ignore"):
        said = np.asarray(eval(text, {"__builtins__": {}}, names), dtype=float) + 0.0 * t
    finite = np.isfinite(said)
    try:
        made = formula_of(text).made({"a": channel(t, a), "b": channel(t, b)})
    except FormulaError as e:
        assert "names no channel" in str(e) or not finite.any(), text
        return
    assert np.array_equal(made.t, t[finite]) and np.allclose(made.values, said[finite], rtol=1e-12), text


def test_powers_signs_and_comparisons_bind_as_in_python() -> None:
    x = {"x": channel([0, 1, 2], [2, 3, 4])}

    def of(text: str) -> list[float]:
        return formula_of(text).made(x).values.tolist()

    assert of("-x ** 2") == [-4, -9, -16] and of("2 ** 3 ** 2 + 0 * x") == [512] * 3 and of("x ^ 2") == [4, 9, 16]
    assert of("x - 1 - 1") == [0, 1, 2] and of("2 ** -x") == [0.25, 0.125, 0.0625]
    assert of("not x > 3 and x > 2 or x == 2") == [1, 1, 0] and of("x % 2") == [0, 1, 0]


def test_rates_and_integrals_are_those_of_closed_forms() -> None:
    t = np.linspace(0.0, 10.0, 2001)
    x = {"x": channel(t, np.sin(t), "mm")}
    rate, integral = (formula_of(f"{f}(x)").made(x) for f in ("rate", "integral"))
    assert np.abs(rate.values - np.cos(t))[1:-1].max() < 1e-5 and rate.unit == "mm/s"
    assert np.abs(integral.values - (1.0 - np.cos(t))).max() < 1e-5 and integral.unit == "mm*s"
    late = formula_of("delay(x, 0.5)").made(x)
    assert late.t[0] == 0.5 and np.abs(late.values - np.sin(late.t - 0.5)).max() < 1e-5
    nothing = formula_of("x * t - t * sin(2 * t / 2) * mean(x) / mean(x)").made({"x": channel(t, np.sin(t))})
    assert np.abs(nothing.values).max() < 1e-12


# ---- rasters ---------------------------------------------------------------------------------------------------------


def test_where_two_rasters_meet_the_finer_one_stays_and_nothing_is_made_up() -> None:
    fine, coarse = np.arange(1000) / 100.0, np.arange(20, 90) / 10.0
    coarse = coarse[(coarse < 4.95) | (coarse > 7.05)]  # a hole of 2 s
    channels = {"f": channel(fine, 3.0 * fine), "c": channel(coarse, 2.0 * coarse), "state": channel([0, 6], [2, 4])}
    for text in ("f - c", "0 - c + f"):
        made = formula_of(text).made(channels)
        assert np.isin(made.t, fine).all() and np.allclose(made.values, made.t)
        assert made.t[0] == fine[200] and made.t[-1] <= coarse[-1]
        assert not ((made.t > 4.91) & (made.t < 7.09)).any() and np.count_nonzero(made.t < 5.0) > 280
    mode = formula_of("state + 0 * f").made(channels)
    assert set(mode.values) == {2.0, 4.0} and (mode.values[mode.t < 6.0] == 2.0).all()  # a mode has no halves


@given(st.integers(2, 60), st.integers(2, 60), st.integers(0, 2**32 - 1))
def test_any_two_rasters_give_rising_times_that_both_have(n: int, m: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = (np.cumsum(rng.uniform(0.01, 1.0, k)) + rng.uniform(0.0, 5.0) for k in (n, m))
    channels = {"a": channel(a, rng.standard_normal(n)), "b": channel(b, rng.standard_normal(m))}
    try:
        made = formula_of("a + 2 * b + 0 * c").made(channels | {"c": channel([0.0, 1e3], [1.0, 2.0])})
    except FormulaError as e:
        assert "no finite number" in str(e)
        return
    assert (np.diff(made.t) > 0.0).all() and np.isfinite(made.values).all()
    assert made.t[0] >= max(a[0], b[0]) and made.t[-1] <= min(a[-1], b[-1])
    assert np.isin(made.t, a).all() or np.isin(made.t, b).all()


# ---- units -----------------------------------------------------------------------------------------------------------

UNITS = {"x": "mm", "y": "um", "i": "mA", "p": "MPa", "w": "deg", "T": "degC", "v": "m/s", "k": "", "r": "%"}


@pytest.mark.parametrize(
    ("text", "unit", "value"),
    [
        ("x + y", "mm", 2.002), ("y + x", "um", 2002.0), ("x - 1", "mm", 1.0), ("1 + x / x", "-", 2.0),
        ("i * p", "mA*MPa", 4.0), ("x / v", "mm*s/m", 1.0), ("k * 3 [um]", "um", 6.0),
        ("x ** 2", "mm**2", 4.0), ("sqrt(p * p)", "MPa", 2.0),
        ("sqrt(x)", "mm**0.5", 2.0**0.5), ("2 / x", "1/mm", 1.0), ("x [um]", "um", 2000.0), ("x / y [%]", "%", 1e5),
        ("sin(w)", "-", float(np.sin(np.deg2rad(2.0)))),
        ("atan2(x, y) [deg]", "deg", float(np.rad2deg(np.arctan2(2, 2e-3)))),
        ("T - T", "K", 0.0), ("T - 1", "degC", 1.0), ("rate(T)", "K/s", 0.0), ("T [K]", "K", 275.15),
        ("k * x", "mm", 4.0), ("k [mm]", "mm", 2.0), ("r + 1", "%", 3.0), ("x > y", "-", 1.0),
        ("max(x, y)", "mm", 2.0), ("x * v [W]", "", 0.0), ("integral(i) [A*s]", "A*s", 0.0),
    ],
)  # fmt: skip
def test_units_go_along(text: str, unit: str, value: float) -> None:
    t = np.arange(3.0)
    channels = {name: channel(t, np.full(3, 2.0), u) for name, u in UNITS.items()}
    if not unit:
        with pytest.raises(FormulaError, match=r"is in mm\*m/s, which does not convert to W"):
            formula_of(text).made(channels)
        return
    made = formula_of(text).made(channels)
    assert made.unit == unit and made.values[0] == pytest.approx(value, rel=1e-12, abs=1e-12)


# ---- what is refused -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "at", "what"),
    [
        ("lag = x_dem -", 14, "the end where a channel, a number or a bracket is needed"),
        ("lag = x_dm", 7, "no channel 'x_dm' (did you mean x_dem?)"),
        ("x_dem + p_s", 7, "mm and MPa do not go together"), ("(x_dem", 7, "closes the bracket of position 1"),
        ("max(x_dem)", 1, "max is given 1; it takes 2 or more"), ("abs()", 5, "')' where a channel"),
        ("sine(x_dem)", 1, "no function 'sine' (did you mean sin?)"), ("sin(p_s)", 1, "MPa is no angle"),
        ("x_dem x_lvdt", 7, "'x_lvdt' is not expected here"), ("x_dem $ 2", 7, "'$' is not understood"),
        ("__import__('os').system('true')", 12, "\"'\" is not understood"), ("x_dem.__class__", 1, "no channel"),
        ("x_dem[0]", 6, "[0] is no unit"), ("1 < x_dem < 2", 11, "a second comparison"),
        ("3 + 4", 3, "names no channel"),
        ("log(-x_dem)", 1, "gives no finite number"), ("x_dem ** n_r", 7, "the power of mm must be a number"),
        ("9 ** 9 ** 9 ** 9 * x_dem", 18, "gives no finite number"), ("sin = x_dem", 1, "has a meaning of its own"),
        ("= x_dem", 1, "no name before '='"), ("a = ", 4, "no formula"), ("(" * 300 + "x_dem", 41, "more than 40"),
        ("-" * 300 + "x_dem", 41, "more than 40"), ("x_dem+" * 100, 401, "600 characters; allowed: up to 400"),
        ("x_dem [mm;]", 7, "[mm;] is no unit"), ("rate(3)", 1, "rate needs a channel"),
        ("delay(x_dem, n_r)", 1, "must be a number of seconds"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_one_line_with_its_position(text: str, at: int, what: str) -> None:
    log = vaneloop.read_log(LOG)[0:1]
    with pytest.raises(FormulaError) as found:
        formula_of(text).made(log.channels)
    assert what in str(found.value) and f"position {at}: " in str(found.value) and found.value.at == at - 1
    assert "\n" not in str(found.value) and isinstance(found.value, InputError)


@given(st.text(st.sampled_from("xy1.e+-*/%^()<>=!,`[] absnotwhere\n\0é"), max_size=40))
def test_no_text_gets_anything_but_a_channel_or_one_line(text: str) -> None:
    t = np.arange(5.0)
    try:
        made = formula_of(text).made({"x": channel(t, t + 1.0, "mm"), "y": channel(t, t, "s")})
    except FormulaError as e:
        assert "\n" not in str(e) and "position" in str(e)
        return
    assert len(made.t) == len(made.values) and np.isfinite(made.values).all() and made.unit


# ---- where they are used ---------------------------------------------------------------------------------------------


def test_a_log_gets_channels_by_formulas_and_stays_as_it_was() -> None:
    log = vaneloop.read_log(LOG)[0:20]
    more = log.assign(lag="x_dem - x_lvdt [um]", slow="abs(lag) < 5", x_lvdt="x_lvdt * 1.01 [um]", twin=log["n_r"])
    assert "lag" not in log and more.columns == [*log.columns, "lag", "slow", "twin"]
    lag = 1e3 * (log["x_dem"].values - log["x_lvdt"].values)
    assert np.allclose(more["lag"].values, lag) and more.units["lag"] == "um" and more["twin"] is log["n_r"]
    assert np.array_equal(more["slow"].values, (np.abs(more["lag"].values) < 5.0).astype(float))
    assert more.units["x_lvdt"] == "mm" and np.allclose(more["x_lvdt"].values, 1.01 * log["x_lvdt"].values)
    assert len(more[5:6]) == 100
    with pytest.raises(vaneloop.InputError, match="position 1: no channel 'lag'"):
        log.assign(slow="lag > 1")


TABLES = [".csv", ".parquet", ".msl", ".lvm", *(pytest.param(s, marks=pytest.mark.slow) for s in (".mf4", ".mdf"))]


@pytest.mark.parametrize("suffix", TABLES)
def test_a_made_channel_is_written_with_its_unit_and_read_again(tmp_path: Path, suffix: str) -> None:
    log = vaneloop.read_log(LOG)[10:12].assign(lag="x_dem - x_lvdt [um]", share="x_lvdt / x_dem")
    file = tmp_path / f"part{suffix}"
    vaneloop.write_log(file, log.channels)
    back = vaneloop.read_log(file, signals={"n_dem": "%", "lag": "mm", "share": "-"})
    assert back.columns == ["n_dem", "lag", "share"]
    assert np.allclose(back["lag"].values, 1e-3 * log["lag"].values, atol=1e-12)
    for name, unit in (("lag", ""), ("odd name", "mm"), ("lag", 'm"m')):
        with pytest.raises(vaneloop.InputError, match="is not a signal"):
            vaneloop.write_log(file, {name: channel(np.arange(3.0), np.arange(3.0), unit)})


def test_the_command_makes_channels_and_exports_what_is_between(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from vaneloop.cli.main import main

    out, data = tmp_path / "lag.parquet", tmp_path / "map.json"
    words = ["map", str(LOG), "--formula", "lag = x_dem - x_lvdt [um]", "--formula", "big = abs(lag) > 100"]
    assert main([*words, "--between", "10:20", "--export", str(out), "--json", str(data)]) == 0
    assert re.search(r"lag +x_dem - x_lvdt +um +formula", capsys.readouterr().out)
    made = json.loads(data.read_text())["formulas"]
    assert [(m["name"], m["unit"], m["samples"]) for m in made] == [("lag", "um", 20_000), ("big", "-", 20_000)]
    log = vaneloop.read_log(out, signals={"lag": "um", "x_dem": "mm", "x_lvdt": "mm"})
    assert (log.t[0], log.t[-1], len(log)) == (10.0, 19.99, 1000)
    assert np.allclose(log["lag"].values, 1e3 * (log["x_dem"].values - log["x_lvdt"].values))
    for more, what in (
        (["--formula", "x_dem"], "has no name"), (["--between", "1:2"], "needs --export"),
        (["--formula", "lag = x_dem - nosuch"], "position 15: no channel 'nosuch'"),
        (["--export", str(tmp_path / "a.blf"), "--formula", "lag = x_dem"], "'lag' is not a signal"),
    ):  # fmt: skip
        assert main(["map", str(LOG), "--quiet", *more]) == 2
        said = capsys.readouterr().err.strip()
        assert what in said and "\n" not in said


def test_a_name_is_needed_where_formulas_stand_beside_each_other() -> None:
    assert named("lag = x_dem [mm]").unit == "mm"
    with pytest.raises(FormulaError, match="has no name"):
        named("x_dem - x_lvdt")


def test_the_page_of_the_grammar_lists_every_function() -> None:
    text = (ROOT / "docs" / "logs.md").read_text(encoding="utf-8")
    section = text[text.index("## Formulas") :].partition("\n## ")[0]
    for name, f in FUNCTIONS.items():
        assert re.search(rf"^\| `{name}\([^|]*\| {re.escape(f.meaning)}", section, re.M), name


def test_what_has_the_attributes_of_a_channel_is_enough() -> None:
    plain = SimpleNamespace(t=np.arange(3.0), values=np.arange(3.0), unit="mm")
    assert formula_of("2 * `odd name`").made({"odd name": plain}).values.tolist() == [0.0, 2.0, 4.0]
