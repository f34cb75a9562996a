"""Logs and answers as frames: what goes into pandas comes back, what a fit says of itself is what it should be."""

from __future__ import annotations

import dataclasses
import inspect
import json
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import vaneloop
from hil.logs.channels import Channels
from tests.conftest import ROOT
from vaneloop.base import extras
from vaneloop.cli.replay import _exceeded
from vaneloop.identification.workflow import Diagnosis
from vaneloop.verbs.answer import Answer
from vaneloop.verbs.search import Diagnosed, Experiment, Extended

pd = pytest.importorskip("pandas")
LOG = ROOT / "examples" / "hidden_effect.parquet"
MOST_BYTES = 200_000  # of an answer in a notebook's cell


@pytest.fixture(scope="module")
def log() -> vaneloop.Log:
    return vaneloop.read_log(LOG)[0:60]


@pytest.fixture(scope="module")
def better(log: vaneloop.Log) -> Extended:
    return vaneloop.extend(log, ["valve_dead_band", "aero_load"])


def same(a: vaneloop.Log, b: vaneloop.Log) -> bool:
    """Whether two logs have the same samples, units and rasters."""
    return list(a) == list(b) and all(
        np.array_equal(a[n].t, b[n].t)
        and np.array_equal(a[n].values, b[n].values)
        and (a[n].framed, a[n].unit) == (b[n].framed, b[n].unit)
        for n in a
    )


# ---- logs ------------------------------------------------------------------------------------------------------------


@st.composite
def logs(draw: st.DrawFn) -> vaneloop.Log:
    """Channels of any rasters, in units of any system, some of them from a bus."""
    channels, units = {}, {}
    for name in draw(st.lists(st.sampled_from(["u", "level", "q 2", "x_lvdt", "°C?"]), min_size=1, unique=True)):
        n = draw(st.integers(2, 30))
        rng = np.random.default_rng(draw(st.integers(0, 999)))
        t = np.cumsum(rng.uniform(1e-3, 0.5, n))
        units[name] = "mm" if name == "x_lvdt" else draw(st.sampled_from(["V", "m", "-", ""]))
        channels[name] = vaneloop.Channel(t, rng.uniform(5.0, 40.0, n), draw(st.booleans()))
    return vaneloop.Log("made", channels, signals=units)


@given(logs())
def test_a_log_comes_back_from_pandas_as_it_was(log: vaneloop.Log) -> None:
    frame = log.to_pandas()
    assert len(frame) == len(log) and list(frame.columns) == list(log) and list(frame.index) == list(log.t)
    assert same(vaneloop.Log.from_dataframe(frame), log)


@given(logs(), st.floats(0.0, 10.0), st.floats(0.0, 10.0))
def test_parts_of_a_log_are_its_samples_in_that_time(log: vaneloop.Log, low: float, width: float) -> None:
    high = low + width
    kept = {n: (c.t >= low) & (c.t < high) for n, c in log.items()}
    if width == 0.0 or not any(k.any() for k in kept.values()):
        with pytest.raises(vaneloop.InputError):
            log[low:high]
        return
    part = log[low:high]
    assert set(part) == {n for n, k in kept.items() if k.any()}
    assert all(np.array_equal(part[n].values, log[n].values[kept[n]]) for n in part)
    assert all(np.array_equal(log[n][low:high].t, part[n].t) for n in part)


def test_a_log_is_used_as_a_frame_is(log: vaneloop.Log) -> None:
    assert len(log) == 6_000 and "p_s" in log and "p_t" not in log and log.units["p_s"] == "MPa"
    assert list(log[["x_lvdt", "i_cmd"]]) == ["x_lvdt", "i_cmd"] == log[["x_lvdt", "i_cmd"]].columns
    assert float(np.mean(log["x_lvdt"])) == float(np.mean(log["x_lvdt"].values))  # type: ignore[call-overload]
    assert log["x_lvdt"].to_pandas().attrs == {"unit": "mm"}
    assert len(repr(log)) < 300 and "\n" not in repr(log) + repr(log["x_lvdt"])
    assert "<table" in log._repr_html_() and "x_lvdt" in log._repr_html_()


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (lambda log: log["x_lvd"], "did you mean x_lvdt?"),
        (lambda log: log[["x_lvdt", "nothing"]], "no channel 'nothing'"),
        (lambda log: log[500:], "the log is from 0 to 59.99 s"),
        (lambda log: log[10:20:2], "step (=2)"),
        (lambda log: log[20:10], "the end (=10 s) must be above the beginning (=20 s)"),
        (lambda log: log[3], "log[3]: allowed: a name"),
        (lambda log: log["x_lvdt"][3], "allowed: a slice in s"),
        (lambda log: vaneloop.compare(3), "log (=3): allowed"),
        (lambda log: vaneloop.compare(log, test=log), "parts of its log"),
        (lambda log: vaneloop.replay(log[["x_lvdt"]]), "no n_dem"),
        (lambda log: vaneloop.extend(log, []), "effects is empty"),
        (lambda log: vaneloop.compare(pd.DataFrame({"x_lvdt": [1.0, 2.0]})), "no time column"),
        (lambda log: vaneloop.compare(pd.DataFrame({"t": [], "x_lvdt": []})), "has no row"),
        (vaneloop.Log.from_dataframe, "allowed: a pandas.DataFrame"),
        (
            lambda log: vaneloop.Log.from_dataframe(pd.DataFrame({"t": [0.0, 1.0], "u": [1, 2]}), units={"w": "V"}),
            "'w'",
        ),
        (
            lambda log: vaneloop.Log.from_dataframe(pd.DataFrame({"t": [0.0, 1.0], "p_s": [210.0, 211.0]})),
            "p_s",  # of bar, where MPa are meant
        ),
    ],
)
def test_what_is_wrong_is_said_in_one_line(wrong: Any, said: str, log: vaneloop.Log) -> None:
    with pytest.raises(vaneloop.InputError) as caught:
        wrong(log)
    assert said in str(caught.value) and "\n" not in str(caught.value)


def test_a_name_that_is_not_there_is_a_key_error_too(log: vaneloop.Log, better: Extended) -> None:
    for wrong in (lambda: log["x"], lambda: better.params["x"], lambda: better.correl["x"]):
        with pytest.raises(KeyError):
            wrong()


@pytest.mark.parametrize(
    ("index", "columns"),
    [
        (pd.Index([0.0, 0.5, 1.0], name="t"), {}),
        (pd.Index([0.0, 0.5, 1.0]), {}),
        (pd.to_timedelta([0, 500, 1000], unit="ms"), {}),
        (pd.date_range("2026-01-01 10:00", periods=3, freq="500ms", tz="Europe/Berlin"), {}),
        (None, {"t": [0.0, 0.5, 1.0]}),
        (None, {"time [ms]": [0.0, 500.0, 1000.0]}),
        (None, {"time": pd.date_range("2026-01-01", periods=3, freq="500ms")}),
    ],
    ids=["named", "numbers", "durations", "dates", "column", "ms", "dates in a column"],
)
def test_the_time_of_a_frame_is_its_index_or_a_column(index: Any, columns: dict[str, Any]) -> None:
    frame = pd.DataFrame({**columns, "u": pd.array([1, 2, None], dtype="Int64"), "who": ["a", "b", "c"]}, index=index)
    log = vaneloop.Log.from_dataframe(frame, units={"u": "V"})
    assert log.columns == ["u"] and log["u"].t.tolist() == [0.0, 0.5] and log["u"].values.tolist() == [1.0, 2.0]
    assert log.units == {"u": "V"} and log.notes == []


def test_units_of_a_frame_are_stated_or_stand_in_it() -> None:
    frame = pd.DataFrame({"t": [0.0, 1.0], "x_lvdt [um]": [20e3, 21e3], "N1": [19000.0, 38000.0], "q": [1.0, 2.0]})
    frame.attrs["units"] = {"N1": "rpm", "q": "l/min"}
    log = vaneloop.Log.from_dataframe(frame, mapping={"N1": "n_r"}, design_rpm=38000.0)
    assert log.units == {"x_lvdt": "mm", "n_r": "%", "q": "l/min"}
    assert log["x_lvdt"].values.tolist() == [20.0, 21.0] and log["n_r"].values.tolist() == [50.0, 100.0]
    assert vaneloop.Log.from_dataframe(frame[["t", "q"]], units={"q": "m3/h"}).units == {"q": "m3/h"}


def test_frames_of_other_packages_are_taken_too(log: vaneloop.Log) -> None:
    pa = pytest.importorskip("pyarrow")
    read = vaneloop.read_log(pa.Table.from_pandas(log.to_pandas().reset_index(), preserve_index=False))
    assert list(read) == list(log) and np.array_equal(read["x_lvdt"].values, log["x_lvdt"].values)


# ---- answers ---------------------------------------------------------------------------------------------------------


def figures(answer: Answer) -> str:
    """The JSON of an answer without what depends on how it was asked."""
    data = {k: v for k, v in answer.to_dict().items() if k not in ("log", "elapsed_s", "wall_s")}
    return json.dumps(data, default=str)


def test_a_frame_a_path_and_a_log_give_one_answer(log: vaneloop.Log, tmp_path: Path) -> None:
    file, log = tmp_path / "run.parquet", log[["x_lvdt", "i_cmd", "p_s"]]
    vaneloop.write_log(file, log.channels)
    asked: list[Any] = [log, log.to_pandas(), file, str(file)]
    said = {figures(vaneloop.compare(x)) for x in asked}
    assert len(said) == 1
    assert len({figures(vaneloop.extend(x, "valve_dead_band")) for x in asked[:2]}) == 1


def test_other_channels_of_a_log_change_nothing(log: vaneloop.Log) -> None:
    more = log.to_pandas().assign(pump=0.0)
    more.attrs["units"]["pump"] = "V"
    more = vaneloop.Log.from_dataframe(more)
    assert "pump" in more and figures(vaneloop.compare(more)) == figures(vaneloop.compare(log))


def test_the_table_of_parameters_is_that_of_the_json(better: Extended) -> None:
    effects = {e["effect"]: e["parameters"] for e in better.to_dict()["effects"]}  # type: ignore[attr-defined]
    for effect, parameters in effects.items():
        for name, p in parameters.items():
            e = better.params[f"{effect}.{name}"]
            assert (e.value, e.low, e.high, e.unit) == (p["value"], p["low"], p["high"], p["unit"])
            assert e.stderr == pytest.approx((e.high - e.low) / 2 / 1.645) and not e.at_bound
    frame = better.params.to_frame()
    assert list(frame.index) == list(better.params) and frame.loc["aero_load.force", "unit"] == "N"
    assert {"value", "stderr", "low", "high", "unit", "lower_bound", "upper_bound", "at_bound"} <= set(frame.columns)
    c = better.correl.to_frame()
    assert np.allclose(np.diag(c), 1.0) and np.allclose(c, c.T) and (c.abs().to_numpy() <= 1.0).all()


def test_what_is_left_and_what_is_fitted_make_up_the_log(better: Extended, log: vaneloop.Log) -> None:
    left, fitted = better.residuals["x_lvdt"], better.fitted["x_lvdt"]
    both = np.asarray(left) + np.asarray(fitted)
    assert left.unit == "mm" and np.allclose(both, np.interp(left.t, log["x_lvdt"].t, log["x_lvdt"].values), atol=1e-6)
    row = better.rows()[0]
    assert np.sqrt(np.mean(np.asarray(left) ** 2)) == pytest.approx(row["error_after"], rel=0.02)
    later = vaneloop.extend(log[20:40], better.diagnosis.stages[0].final.effects)  # the log's own time
    assert 20.0 <= later.fitted.t[0] < 25.0 and later.fitted.t[-1] == pytest.approx(39.99)
    near = np.interp(later.fitted.t, fitted.t, fitted.values)
    assert np.sqrt(np.mean((np.asarray(later.fitted["x_lvdt"]) - near) ** 2)) < 0.1


def test_an_extended_model_says_explained_in_every_place(better: Extended, log: vaneloop.Log) -> None:
    data: Any = better.to_dict()
    assert better.verdict == data["verdict"] == data["stages"][0]["verdict"] == "explained"
    assert str(better).endswith("explained.") and better.to_frame()["verdict"].tolist() == ["explained"]
    half = vaneloop.extend(log, ["valve_dead_band"])
    assert half.verdict == half.to_dict()["verdict"] == "missing" and str(half).endswith("an error remains.")
    stage = dataclasses.replace(half.diagnosis.stages[0], error_after=np.array([np.nan]))
    lost = dataclasses.replace(half, diagnosis=dataclasses.replace(half.diagnosis, stages=[stage]))
    assert lost.verdict == "missing" and not lost.reached  # what is no number is never a fit


def test_what_is_no_number_is_within_no_tolerance() -> None:
    wrong: Any = SimpleNamespace(
        log="run", signals=[SimpleNamespace(signal="vigv", reference="measured", rms=np.nan, unit="deg")]
    )
    assert len(_exceeded(wrong, {("vigv", "rms"): 1.0})) == 1


def test_an_answer_is_short_in_a_console_and_light_in_a_notebook(better: Extended, log: vaneloop.Log) -> None:
    for answer in (better, vaneloop.compare(log)):
        assert len(repr(answer)) < 400 and "\n" not in repr(answer)
        page = answer._repr_html_()
        assert len(page) < MOST_BYTES and 'src="data:image/png;base64,' in page and "<script" not in page
        assert len(answer.show()._repr_html_()) > 20 * MOST_BYTES > len(repr(answer.show()))


def test_a_cell_of_a_notebook_has_the_words_of_the_pages(better: Extended, log: vaneloop.Log) -> None:
    found = Diagnosed(better.bound, better.diagnosis, "log")
    quiet = dataclasses.replace(better.diagnosis.stages[0], verdict="none")
    fits = Diagnosed(better.bound, dataclasses.replace(better.diagnosis, stages=[quiet]), "log")
    assert ">missing<" in found._repr_html_() and ">explained<" in better._repr_html_()
    page = fits._repr_html_()
    assert ">fits<" in page and ">none<" not in page and fits.rows()[0]["verdict"] == "none"


def test_a_picture_is_drawn_on_the_axes_that_are_given(better: Extended, log: vaneloop.Log) -> None:
    figure = pytest.importorskip("matplotlib.figure").Figure()
    above, below = figure.subplots(2)
    assert better.plot(ax=above) is above and better.plot(below, residuals=True) is below
    measured, _, model = above.lines
    assert measured.get_label() == "measured" and above.get_ylabel() == "x_lvdt [mm]"
    there = np.isfinite(model.get_ydata())
    assert np.array_equal(model.get_ydata()[there], better.fitted["x_lvdt"].values)
    assert vaneloop.compare(log).plot(figure.subplots(), signal="vigv").get_ylabel() == "vigv [deg]"
    with pytest.raises(vaneloop.InputError, match=r"signal \(='x_lvd'\) \(did you mean x_lvdt\?\)"):
        better.plot(above, signal="x_lvd")


def test_an_experiment_draws_its_profile_and_a_replay_what_it_measured(log: vaneloop.Log) -> None:
    figure = pytest.importorskip("matplotlib.figure").Figure()
    diagnosed = Diagnosed(vaneloop.compare(log[["x_lvdt", "vigv"]]).bound, Diagnosis("none", [], {}, {}, 0.0), "run")
    best: Any = {
        "t": np.arange(3.0),
        "inputs": {"n_dem": ("%", np.ones(3))},
        "text": "Run it.",
        "table": [{"profile": "p", "by_pair": []}],
    }
    answer = Experiment(diagnosed, best)
    assert answer.plot(figure.subplots()).get_ylabel() == "n_dem [%]" and answer.rows() == [{"profile": "p"}]
    run = vaneloop.replay(log[0:5])
    assert len(run.params) == 0 and repr(run.params) == "Parameters(nothing was fitted)"
    x = log[0:5]["x_lvdt"]
    there = np.isin(x.t, run.residuals["x_lvdt"].t)
    assert np.allclose(np.asarray(run.residuals["x_lvdt"]) + run.fitted["x_lvdt"].values, x.values[there])
    assert run.plot(figure.subplots(), signal="vigv").get_ylabel() == "vigv [deg]"


@pytest.mark.parametrize(("module", "asked"), [("pandas", "to_pandas"), ("pandas", "to_frame"), ("matplotlib", "plot")])
def test_without_the_extra_one_line_says_what_to_install(
    module: str, asked: str, better: Extended, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(extras, "is_there", lambda name: name != module)
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(vaneloop.InputError, match=rf"{module}, .*: pip install 'vaneloop\[notebook\]'$"):
        getattr(better.residuals if asked == "to_pandas" else better, asked)()


# ---- a model of the user's own ---------------------------------------------------------------------------------------


def straight(u: Any, p: Any) -> Any:
    return p.gain * u.u + p.offset


def system(**more: Any) -> vaneloop.System:
    return vaneloop.System(
        "map", "static", straight, outputs={"y": "V"}, inputs={"u": "V"}, places=["output"],
        parameters=[vaneloop.unknown("gain", 1.0, "-"), vaneloop.unknown("offset", 0.5, "V")], **more,
    )  # fmt: skip


def bench(seed: int = 1, n: int = 1_000) -> Any:
    rng, t = np.random.default_rng(seed), np.arange(n) * 0.02
    u = 1.5 + np.sin(0.4 * t) + 0.7 * np.sin(1.7 * t + 1.0)
    return pd.DataFrame({"u": u, "y": 2.0 * u + 0.3 + 0.01 * rng.standard_normal(n)}, index=pd.Index(t, name="t"))


def test_errors_of_a_straight_line_are_those_of_linear_regression() -> None:
    """Of y = gain u + offset the correlation is -mean(u) / rms(u), whatever the noise."""
    frame = bench()
    answer = vaneloop.compare(frame, system())
    u = frame["u"].to_numpy()
    assert answer.correl["gain"]["offset"] == pytest.approx(-u.mean() / np.sqrt(np.mean(u**2)), abs=1e-6)
    slope, level = np.polyfit(u, frame["y"].to_numpy(), 1)
    assert (answer.params["gain"].value, answer.params["offset"].value) == pytest.approx((slope, level), abs=1e-5)
    gain, offset = answer.params["gain"].stderr, answer.params["offset"].stderr
    assert offset / gain == pytest.approx(np.sqrt(np.mean(u**2)), rel=0.3)  # the blocks' own spread counts, too
    assert np.allclose(answer.residuals["y"].values, frame["y"] - slope * u - level, atol=1e-5)


def test_a_parameter_at_its_bound_says_so_and_has_no_error() -> None:
    bound = vaneloop.System(
        "map", "static", straight, outputs={"y": "V"}, inputs={"u": "V"}, places=["output"],
        parameters=[vaneloop.unknown("gain", 1.0, "-", 0.0, 1.8), vaneloop.unknown("offset", 0.5, "V")],
    )  # fmt: skip
    answer = vaneloop.compare(bench(), bound)
    p = answer.params["gain"]
    assert p.value == 1.8 == p.bound[1] and p.at_bound and np.isnan(p.stderr)
    assert np.isnan(answer.correl["gain"]["offset"]) and not answer.params["offset"].at_bound


def test_logs_and_frames_of_a_model_of_ones_own_give_one_answer(tmp_path: Path) -> None:
    frame, s = bench(), system()
    frame.reset_index().to_csv(tmp_path / "bench.csv", index=False)
    in_mv = frame.assign(y=1e3 * frame["y"])
    log = vaneloop.Log.from_dataframe(in_mv, units={"y": "mV"}, name="bench")
    record = vaneloop.Record("bench", frame.index.to_numpy(), {n: frame[n].to_numpy() for n in frame})
    asked: list[Any] = [frame, log, record, tmp_path / "bench.csv", [frame]]
    values = [vaneloop.compare(x, s).params["gain"].value for x in asked]
    assert values == pytest.approx([values[0]] * len(asked), rel=1e-9)
    with pytest.raises(vaneloop.InputError, match="no u"):
        vaneloop.compare(log[["y"]], s)
    with pytest.raises(vaneloop.InputError, match="y is in kg"):
        vaneloop.compare(vaneloop.Log.from_dataframe(frame, units={"y": "kg"}), s)


@pytest.mark.slow
def test_curves_of_several_logs_bear_their_names() -> None:
    both = vaneloop.diagnose([bench(), bench(2)], system(), test=[bench(3)])
    assert both.verdict == "none" and list(both.residuals) == [f"DataFrame{k * chr(39)}: y" for k in range(3)]


@pytest.mark.slow
def test_a_learned_law_has_its_curve_in_the_answer() -> None:
    figure = pytest.importorskip("matplotlib.figure").Figure()
    frame = bench()
    frame["y"] += 0.4 * np.cos(5.0 * frame["u"])
    answer = vaneloop.learn(frame, system())
    law = answer.laws[0]
    assert answer.verdict == "learned" and any(e.effect == law.name for e in answer.params.values())
    assert "gain" in answer.params  # that of the model with its law, and no other beside it
    assert (
        answer.to_frame().loc[0, "effect"] == law.name
        and answer.plot(figure.subplots()).lines[0].get_label() == law.name
    )
    nominal = vaneloop.compare(frame, system()).residuals["y"]
    assert np.std(answer.residuals["y"].values) < 0.1 * np.std(nominal.values)


def test_threads_that_share_a_log_and_an_answer_get_what_one_alone_gets(log: vaneloop.Log) -> None:
    frame, log = bench(), log[["x_lvdt", "vigv"]]
    alone = figures(vaneloop.compare(log)), figures(vaneloop.diagnose(frame, system()))
    shared = vaneloop.compare(log)
    begin = threading.Barrier(4)

    def ask(k: int) -> tuple[str, str, float]:
        begin.wait()
        left = float(np.sum(np.abs(shared.residuals["vigv"].values)))
        return figures(vaneloop.compare(log)), figures(vaneloop.diagnose(frame, system())), left

    with ThreadPoolExecutor(4) as pool:
        said = list(pool.map(ask, range(4)))
    assert {s[:2] for s in said} == {alone} and len({s[2] for s in said}) == 1


# ---- the interface ---------------------------------------------------------------------------------------------------


def annotations(thing: Any, at: str) -> list[str]:
    """Where a function, or a class and its public members, says `Any`."""
    members = [(f"{at}.{n}", m) for c in thing.__mro__ if c.__module__.split(".")[0] in ("vaneloop", "hil")
               for n, m in {**vars(c), "its fields": c}.items()
               if not n.startswith("_") or n == "__init__"] if inspect.isclass(thing) else [(at, thing)]  # fmt: skip
    out = []
    for where, m in members:
        f = m.fget if isinstance(m, property) else getattr(m, "func", getattr(m, "__func__", m))
        hints = getattr(f, "__annotations__", {})
        out += [f"{where}: {k}: {v}" for k, v in hints.items() if "Any" in str(v).replace("AnyAction", "")]
    return out


def test_no_public_name_is_of_any_type() -> None:
    of = [getattr(vaneloop, name) for name in vaneloop.__all__]
    returned = [Answer, *Answer.__subclasses__(), Extended, Channels]
    assert len(returned) > 5
    assert [said for thing in [*of, *returned] for said in annotations(thing, thing.__name__)] == []
