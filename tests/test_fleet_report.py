"""What a fleet's logs say together, on results whose truth is known: onsets, growth, limits, outliers, coverage."""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.browser import open_to_all

pytest.importorskip("psutil", reason="the extra `fleet` is not installed")
pytest.importorskip("duckdb", reason="the extra `fleet` is not installed")

from benchmarks import start
from benchmarks.fleet_demo import YEARS, fate, size_at
from tests.conftest import ROOT, quick_first
from vaneloop.base.errors import InputError
from vaneloop.cli.main import main
from vaneloop.fleet import state
from vaneloop.fleet.folder import Folder, _schema
from vaneloop.fleet.report import YEAR, limits_of, view_of, whole_of, write_pages
from vaneloop.fleet.sources import moment
from vaneloop.fleet.tables import TABLES, answers, roll_up, write_tables
from vaneloop.fleet.trends import Trend, limit_of, odd, trend
from vaneloop.pages.fleet import FleetView, fleet_page

BEGIN = moment("2026-01-01") or 0.0
NOMINAL = [f"linkage.vgv{k}_{what}" for k in range(5) for what in ("play", "lc", "l", "bias")]


def answer(rng: np.random.Generator, engine: int, years: float, tail: list[float]) -> dict[str, Any]:
    """What a log of an engine says: engine 0 wears from 0.8 years on, in engine 1 a sensor is exchanged at 1.2 years,
    engine 2 is badly rigged, engine 3 lacks an effect that grows from 0.6 years on. ``tail``: an engine's own values.
    """
    nominal = []
    for k, name in enumerate(NOMINAL):
        value = 1.0 + tail[k] + rng.normal(0.0, 0.01)
        value += 0.2 * max(years - 0.8, 0.0) if (engine, k) == (0, 0) else 0.0
        value += 0.15 * (years >= 1.2) if (engine, k) == (1, 3) else 0.0
        value += 0.5 if (engine, k) == (2, 1) else 0.0
        row = {"stage": "linkage", "parameter": name, "unit": "deg", "value": value, "low": value - 0.01}
        nominal.append(row | {"high": value + 0.01, "table": 1.0, "tolerance": 0.3})
    sizes = []
    size = 0.5 * max(years - 0.6, 0.0) + rng.normal(0.0, 0.02)
    if engine == 3 and size > 0.08 or rng.random() < 0.01:
        size = max(size, 0.08)
        row = {"effect": "supply_dip", "stage": "actuator", "probability": 0.9, "parameter": "depth", "unit": "MPa"}
        sizes.append(row | {"value": size, "low": size - 0.03, "high": size + 0.03, "neutral": 0.0})
    blind = {"effect": "coil_heating", "stage": "actuator", "needs": "an oil temperature that changes by 20 K"}
    return {
        "log": f"e{engine}", "verdict": "missing" if sizes else "none", "nominal": nominal, "sizes": sizes,
        "not_observable": [blind] if years < 1.0 else [], "stages": [], "duration_s": 300.0, "notes": [],
        "effects": [{**s, "rivals": [], "parameters": {"depth": s}} for s in sizes],
    }  # fmt: skip


def synthetic(tmp: Path, engines: int, each: int, seed: int = 1) -> Folder:
    """A finished run over two years, as the workers would leave it."""
    rng = np.random.default_rng(seed)
    folder = Folder.begin(tmp / "run", "read", {}, {})
    rows: list[dict[str, Any]] = []
    results: list[dict[str, Any]] = []
    for e in range(engines):
        own = rng.normal(0.0, 0.03, len(NOMINAL)).tolist()
        for k, years in enumerate(np.sort(rng.uniform(0.0, 2.0, each))):
            key, at = f"{e:05d}{k:059d}.csv", BEGIN + years * YEAR
            chunk = f"000000-{len(rows) // 64:06d}"
            rows.append({"path": f"/logs/e{e:03d}/{k:05d}.csv", "key": key, "size": 1, "mtime_ns": 1, "chunk": chunk,
                         "engine": f"e{e:03d}", "time": at, "reason": ""})  # fmt: skip
            said = answer(rng, e, float(years), own)
            row = {"key": key, "status": "done", "reason": "", "verdict": said["verdict"], "answer": json.dumps(said)}
            results.append(row)
    for where in ("logs", "parts"):
        (folder.path / where).mkdir()
    pq.write_table(pa.Table.from_pylist(rows, schema=_schema()), folder.path / "logs" / "000000.parquet")
    for k in range(0, len(rows), 64):
        pq.write_table(pa.Table.from_pylist(results[k : k + 64]), folder.path / f"parts/000000-{k // 64:06d}.parquet")
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Folder:
    return synthetic(tmp_path_factory.mktemp("fleet"), 30, 50)


@pytest.fixture(scope="module")
def view(folder: Folder) -> FleetView:
    """What its logs say, worked out once."""
    return view_of(roll_up(folder), {})


def series(rng: np.random.Generator, n: int, size: float, kind: str) -> tuple[Any, Any, Any, float, float]:
    """A quantity over two years with its scatter of 1: times, values, deviations, onset, growth a year."""
    t, s = np.sort(rng.uniform(0.0, 2.0, n)), rng.uniform(0.2, 0.5, n)
    onset = float(rng.uniform(0.2, 1.4))
    rate = size / (2.0 - onset)
    y = 5.0 + rng.normal(0.0, 1.0, n) + rng.normal(0.0, s)
    late = {"growth": rate * np.maximum(t - onset, 0.0), "step": size * (t >= onset), "none": 0.0 * t}[kind]
    return t, y + late, s, onset, rate


def shares(kind: str, n: int, size: float, many: int, seed: int) -> list[tuple[Trend, Any]]:
    rng = np.random.default_rng(seed)
    drawn = [series(rng, n, size, kind) for _ in range(many)]
    return [(trend(*x[:3]), x) for x in drawn]


# ---- statistics ------------------------------------------------------------------------------------------------------


def test_quantities_that_do_not_change_are_left_alone() -> None:
    kinds = [f.kind for n in (20, 50, 200) for f, _ in shares("none", n, 0.0, 200, n)]
    assert sum(k != "none" for k in kinds) <= 4, "one in a thousand is allowed; four in 600 are a chance of 0.3 %"


def test_onsets_and_growth_are_found_and_their_intervals_hold() -> None:
    """Growths of 6 to 12 scatters within the log, 50 logs an engine, as in a fleet of 40 engines and 2,000 logs."""
    found = [x for size in (6.0, 8.0, 12.0) for x in shares("growth", 50, size, 150, int(size))]
    named = [(f, x) for f, x in found if f.kind == "growth"]
    assert len(named) >= 0.95 * len(found)
    assert np.mean([abs(f.onset - x[3]) <= 0.2 for f, x in named]) >= 0.9
    assert 0.85 <= np.mean([f.rate_low <= x[4] <= f.rate_high for f, x in named]) <= 0.95
    assert 0.82 <= np.mean([f.onset_low <= x[3] <= f.onset_high for f, x in named]) <= 0.97


@pytest.mark.parametrize(
    ("common", "least", "most"), quick_first([(1.0, 0.85, 0.95), (0.0, 0.85, 0.95), (3.0, 0.85, 0.99)])
)
def test_growth_is_as_uncertain_as_its_logs_scatter_whatever_they_have_wrong_alike(
    common: float, least: float, most: float
) -> None:
    """Each log claims the scatter and what all of them have wrong alike, in scatters; the latter moves the level."""
    rng, inside = np.random.default_rng(round(common)), []
    for _ in range(400):
        t, y, _, onset, rate = series(rng, 24, 9.0, "growth")
        f = trend(t, y + rng.normal(0.0, common), np.full(24, np.hypot(1.06, common)))
        if f.kind == "growth":
            inside.append(f.rate_low <= rate <= f.rate_high)
            assert f.now_high - f.now_low > 2.0 * common or common < 3.0
    assert len(inside) > 350 and least <= np.mean(inside) <= most


@pytest.mark.slow
def test_the_time_to_a_limit_is_within_its_interval() -> None:
    inside = []
    for f, (t, _, _, onset, rate) in shares("growth", 50, 8.0, 150, 5):
        when = limit_of(f, float(t[-1]), 5.0 + 16.0)
        if f.kind == "growth":
            assert when.low is not None and when.high is not None and when.time is not None
            inside.append(when.low <= onset + 16.0 / rate <= when.high)
    assert 0.82 <= np.mean(inside) <= 0.97


def test_a_noise_free_growth_is_found_exactly() -> None:
    t = np.linspace(0.0, 2.0, 41)
    f = trend(t, 1.0 + 3.0 * np.maximum(t - 0.8, 0.0), np.full(41, 1e-3))
    assert f.kind == "growth" and f.onset == pytest.approx(0.8, abs=0.02) and f.rate == pytest.approx(3.0, rel=0.02)
    assert limit_of(f, 2.0, 7.6).time == pytest.approx(3.0, abs=0.05)


def test_an_exchange_is_a_step_and_not_growth() -> None:
    found = shares("step", 50, 6.0, 60, 3)
    assert np.mean([f.kind == "step" for f, _ in found]) >= 0.95
    assert np.mean([abs(f.onset - x[3]) <= 0.2 for f, x in found]) >= 0.95


@pytest.mark.parametrize(
    ("found", "limit", "says"),
    [
        (Trend("none", 20, now=1.0), 2.0, "does not grow"),
        (Trend("step", 20, now=1.0), 2.0, "in one step"),
        (Trend("too few", 5), 2.0, "are too few"),
        (Trend("growth", 20, start=0.0, now=1.0, rate=1.0), -2.0, "away from its limit"),
        (Trend("growth", 20, start=0.0, now=3.0, rate=1.0), 2.0, "beyond its limit"),
    ],
)
def test_where_a_limit_cannot_be_told_words_say_why(found: Trend, limit: float, says: str) -> None:
    assert says in limit_of(found, 2.0, limit).why


@pytest.mark.parametrize("n", [6, 20, 40, 200])
def test_healthy_engines_are_hardly_accused(n: int) -> None:
    rng = np.random.default_rng(n)
    accused = [(odd(rng.normal(0.0, 1.0, n), tests=20) < 0.01).mean() for _ in range(40)]
    assert np.mean(accused) <= 0.02


def test_an_odd_engine_is_seen_also_beside_other_odd_ones() -> None:
    rng = np.random.default_rng(2)
    hits = [(odd(np.r_[rng.normal(0.0, 1.0, 37), 9.0, 10.0, -9.0], tests=20)[-3:] < 0.01).all() for _ in range(40)]
    assert np.mean(hits) >= 0.9


def test_an_interval_is_no_narrower_than_what_all_logs_have_wrong_together() -> None:
    """Logs that agree better than they claim: a gauge that reads 0.4 % too much leaves no scatter."""
    t = np.linspace(0.0, 2.0, 12)
    found = trend(t, 1.004 * 0.5 * np.maximum(t - 0.7, 0.0), np.full(12, 0.03))
    assert found.kind == "growth" and found.rate_low <= 0.5 <= found.rate_high
    assert found.rate_high - found.rate_low > 0.02


def made(**tables: list[dict[str, Any]]) -> Any:
    """A database as `roll_up` gives it, of these rows."""
    import duckdb
    import pyarrow as pa

    db = duckdb.connect()
    for name, rows in tables.items():
        db.register("rows", pa.Table.from_pylist(rows))
        db.execute(f"CREATE TABLE {name} AS SELECT * FROM rows")
    return db


def logs_of(engine: str, years: list[float]) -> list[dict[str, Any]]:
    done = {"status": "done", "reason": "", "verdict": "none", "duration_s": 60.0}
    at = [(f"{engine}/{k:03d}", BEGIN + y * YEAR) for k, y in enumerate(years)]
    return [{"path": p, "engine": engine, "time": t, "key": p} | done for p, t in at]


NO_COVERAGE = [{"path": "", "engine": "", "time": 0.0, "key": "", "effect": "", "stage": "", "needs": ""}]
OF = ("path", "engine", "time", "key")


def test_what_a_log_did_not_tell_is_no_change() -> None:
    """Six logs leave a parameter where the table has it, three tell it: it has not changed."""
    logs = logs_of("e", np.linspace(0.0, 1.9, 9).tolist())
    row = {"stage": "engine", "parameter": "engine.deceleration", "unit": "%/s", "table": 10.0, "tolerance": 0.5}
    nominal = []
    for k, log in enumerate(logs):
        value, half = (10.0, 0.4749) if k < 6 else (10.1978 + 1e-4 * (k - 7), 0.008)
        nominal.append({n: log[n] for n in OF} | row | {"value": value, "low": value - half, "high": value + half})
    sizes = {"effect": "none", "stage": "", "parameter": "", "unit": "", "value": 0.0, "low": 0.0, "high": 0.0}
    effects = [{n: logs[0][n] for n in OF} | sizes | {"neutral": 0.0, "probability": 0.0}]
    view = view_of(made(logs=logs, effects=effects, nominal=nominal, coverage=NO_COVERAGE), {})
    (series,) = (s for s in view.series if s.kind == "nominal")
    assert len(series.t) == 3 and series.trend["kind"] == "too few" and not view.changed


def test_a_size_that_no_log_tells_from_nothing_makes_silent_logs_no_surer() -> None:
    """An engine whose wear is named late; of another, the same stage has a size of 0.0003 +- 0.04 deg."""
    years, onset, rate = np.linspace(0.1, 1.9, 9), 0.42, 0.41
    logs, effects = [*logs_of("worn", years.tolist()), *logs_of("other", years.tolist())], []
    row = {"effect": "linkage_backlash", "stage": "linkage", "parameter": "vgv2", "unit": "deg", "neutral": 0.0}
    for k, log in enumerate(logs):
        size = rate * max(float(years[k % 9]) - onset, 0.0) if k < 9 else 0.0003
        if k < 9 and size < 0.19 or k >= 9 and k % 9 < 6:
            continue  # not named
        here = {n: log[n] for n in OF} | row | {"value": size, "low": size - 0.04, "high": size + 0.04}
        effects.append(here | {"probability": 0.9})
    idle = {"stage": "", "parameter": "", "unit": "", "value": 0.0, "low": 0.0, "high": 0.0, "table": 0.0}
    nominal = [{n: logs[0][n] for n in OF} | idle | {"tolerance": 0.0}]
    view = view_of(made(logs=logs, effects=effects, nominal=nominal, coverage=NO_COVERAGE), {})
    (wear,) = (s for s in view.changed if s.engine == "worn")
    assert wear.trend["rate_low"] <= rate <= wear.trend["rate_high"]
    assert abs(wear.trend["onset"] - BEGIN - onset * YEAR) < 0.2 * YEAR


def grows(effect: str, parameter: str, nominal: str, tolerance: float, sizes: dict[float, tuple[str, float]]) -> Any:
    """Logs of one engine; ``sizes``: years -> whether its log has the size in the "nominal" parameter or the "effect",
    names a "rival" or nothing at all ("silent"), and the size.
    """
    logs, effects, nominals = logs_of("e", list(sizes)), [], []
    for log, (where, size) in zip(logs, sizes.values(), strict=True):
        here, unsure = {n: log[n] for n in OF}, tolerance / 3.0**0.5 * 1.6449
        value, half = (size, 0.007) if where == "nominal" else (0.0, unsure)
        row = {"stage": "linkage", "parameter": nominal, "unit": "deg", "value": value, "low": value - half}
        nominals.append(here | row | {"high": value + half, "table": 0.0, "tolerance": tolerance})
        if where in ("effect", "rival"):
            name, half = (effect, parameter) if where == "effect" else ("other", "p"), np.hypot(0.007, unsure)
            row = {"effect": name[0], "stage": "linkage", "parameter": name[1], "unit": "deg", "value": size}
            effects.append(here | row | {"low": size - half, "high": size + half, "neutral": 0.0, "probability": 0.9})
    return view_of(made(logs=logs, effects=effects, nominal=nominals, coverage=NO_COVERAGE), {})


def test_play_that_outgrows_its_tolerance_is_followed_as_a_whole() -> None:
    """Up to its tolerance of 0.08 deg a log has it in the nominal parameter, at its end for a while, then in the
    effect; the engine was 0.02 deg off from the start. One log names a rival.
    """
    rng, sizes = np.random.default_rng(1), {}
    for k, t in enumerate(np.linspace(0.05, 1.95, 24).tolist()):
        size = 0.02 + 0.4 * max(t - 0.8, 0.0)
        where = "nominal" if size < 0.12 else "effect"
        sizes[t] = ("rival", 0.3) if k == 20 else (where, size + rng.normal(0.0, 0.002))
    for t in [t for t, (where, size) in sizes.items() if where == "nominal" and size > 0.07]:
        sizes[t] = ("nominal", 0.08)
    view = grows("linkage_backlash", "vigv", "linkage.vigv_play", 0.08, sizes)
    (wear,) = view.changed
    assert wear.quantity == "linkage_backlash.vigv" and not [s for s in view.series if "play" in s.quantity]
    assert wear.trend["kind"] == "growth" and wear.trend["start"] == pytest.approx(0.02, abs=0.003)
    assert abs(wear.trend["onset"] - BEGIN - 0.8 * YEAR) < 0.03 * YEAR
    assert wear.trend["rate_low"] <= 0.4 <= wear.trend["rate_high"] < 0.42


def test_a_log_that_names_a_rival_says_nothing_of_an_effect_s_size() -> None:
    """A third of the late logs name another effect of the stage: those do not say that the effect is small."""
    rng, sizes = np.random.default_rng(2), {}
    for k, t in enumerate(np.linspace(0.05, 1.95, 30).tolist()):
        size = 1.5 * max(t - 0.7, 0.0)
        named = ("rival", 1.0) if k % 3 == 0 else ("effect", size + rng.normal(0.0, 1e-3))
        sizes[t] = ("silent", 0.0) if size < 0.05 else named
    changed = grows("valve_null_bias", "bias", "x", 0.1, sizes).changed
    (drift,) = (s for s in changed if s.quantity == "valve_null_bias.bias")
    assert drift.trend["kind"] == "growth" and abs(drift.trend["onset"] - BEGIN - 0.7 * YEAR) < 0.05 * YEAR
    assert drift.trend["rate"] == pytest.approx(1.5, rel=0.01)


@pytest.mark.parametrize(
    ("effect", "parameter", "by"),
    [("linkage_backlash", "vgv1", 0.1), ("pot_bias", "vigv", 0.2), ("rotor_lag_error", "lag", 0.3),
     ("screw_friction", "force", 60.0)],
)  # fmt: skip
def test_what_is_followed_as_a_whole_is_one_quantity(effect: str, parameter: str, by: float) -> None:
    """A nominal parameter that is off, and the effect of that size: the same run."""
    from hil.loop.lockstep import Stimulus, lockstep
    from plant import Model
    from plant.parameters import nominal
    from vaneloop.verbs.machine import Machine

    table = {"table": "plant_electromechanical.toml"} if effect == "screw_friction" else {}
    name, plant = whole_of(effect, parameter), Machine(**table).plant
    (known,) = (n for n in nominal(plant.table, plant.geometry) if n.name == name)
    n_dem = np.repeat([60.0, 90.0, 70.0], 200)
    runs = [
        lockstep(Stimulus.of(n_dem), plant=Machine(model=model, **table).plant, seed=1)
        for model in (Model(parameters={name: known.value + by}), Model(effects={effect: {parameter: by}}), Model())
    ]
    for channel, values in runs[0].columns.items():
        np.testing.assert_allclose(values, runs[1].columns[channel], atol=1e-9, err_msg=channel)
    assert any(np.abs(v - runs[2].columns[c]).max() > 1e-3 for c, v in runs[0].columns.items())


@pytest.mark.parametrize(("moves", "least", "most"), [(0.0, 0.85, 0.97), (1.0, 0.70, 0.90)])
def test_intervals_hold_where_logs_claim_more_than_they_scatter(moves: float, least: float, most: float) -> None:
    """Logs of a standard deviation of 3 that differ by 1, and whose gauge is off in all of them alike. Where its error
    changes with the growth, by ``moves`` times what one log scatters, no log shows it: docs/fleet.md says so.
    """
    rng, inside, onsets = np.random.default_rng(6), [], []
    for size in (20.0, 100.0):
        for _ in range(150):
            t, onset = np.sort(rng.uniform(0.0, 2.0, 50)), float(rng.uniform(0.2, 1.4))
            rate, gauge = size / (2.0 - onset), size + moves * rng.normal(0.0, 1.0)
            y = rng.normal(0.0, 3.0) + gauge / (2.0 - onset) * np.maximum(t - onset, 0.0) + rng.normal(0.0, 1.0, 50)
            f = trend(t, y, np.full(50, 3.0))
            assert f.kind == "growth"
            inside.append(f.rate_low <= rate <= f.rate_high)
            onsets.append(f.onset_low <= onset <= f.onset_high)
    assert least <= np.mean(inside) <= most and 0.85 <= np.mean(onsets) <= 0.96


# ---- tables and page -------------------------------------------------------------------------------------------------


def test_the_report_finds_what_is_in_the_fleet(folder: Folder) -> None:
    view = view_of(roll_up(folder), {"supply_dip.depth": 2.0})
    assert [(r["engine"], r["effect"]) for r in view.lacking] == [("e003", "supply_dip")]
    by = {(s.engine, s.quantity): s.trend for s in view.changed}
    wear = by.pop(("e000", "linkage.vgv0_play"))
    assert wear["kind"] == "growth" and abs(wear["onset"] - BEGIN - 0.8 * YEAR) < 0.2 * YEAR
    assert wear["rate_low"] <= 0.2 <= wear["rate_high"] and wear["limit"] == pytest.approx(1.3)
    swap = by.pop(("e001", "linkage.vgv0_bias"))
    assert swap["kind"] == "step" and abs(swap["onset"] - BEGIN - 1.2 * YEAR) < 0.2 * YEAR
    dip = by.pop(("e003", "supply_dip.depth"))
    assert dip["kind"] == "growth" and abs(dip["onset"] - BEGIN - 0.6 * YEAR) < 0.2 * YEAR
    assert dip["limit_low"] <= BEGIN + 4.6 * YEAR <= dip["limit_high"]
    assert len(by) <= 1, f"of 600 quantities that do not change: {list(by)}"
    assert ("e002", "linkage.vgv0_lc") in {(r["engine"], r["quantity"]) for r in view.outliers}
    assert len({r["engine"] for r in view.outliers} - {"e000", "e001", "e002"}) <= 1
    (blind,) = {(r["effect"], r["needs"]) for r in view.coverage}
    assert blind == ("coil_heating", "an oil temperature that changes by 20 K")


@pytest.mark.slow
def test_the_page_leads_to_the_logs_own_pages(folder: Folder, view: FleetView, tmp_path: Path) -> None:
    said = answers(folder, view.keys())
    write_pages(tmp_path / "fleet_logs", said)
    page = fleet_page(view, "vaneloop fleet report", "fleet_logs").write(tmp_path / "fleet.html").read_text()
    links = set(re.findall(r'href="(fleet_logs/[^"]+)"', page))
    assert links and all((tmp_path / x).is_file() for x in links)
    assert "supply_dip" in page and "no limit is given" in page and view.sentence() in page
    open_to_all(tmp_path / sorted(links)[0], "fleet-log")
    open_to_all(tmp_path / "fleet.html", "fleet")


def test_tables_of_two_reports_are_the_same_bytes(folder: Folder, tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_tables(roll_up(folder), tmp_path / name)
    for table in TABLES:
        assert (tmp_path / "a" / f"{table}.csv").read_bytes() == (tmp_path / "b" / f"{table}.csv").read_bytes()
        assert pq.read_table(tmp_path / "a" / f"{table}.parquet").num_rows > 0


@pytest.mark.parametrize(
    ("text", "says"), [("a,b\n1,2\n", "needs the columns"), ("quantity,limit\nx,soon\n", "number")]
)
def test_a_wrong_file_of_limits_is_one_line(tmp_path: Path, text: str, says: str) -> None:
    (tmp_path / "l.csv").write_text(text)
    with pytest.raises(InputError, match=says):
        limits_of(str(tmp_path / "l.csv"))


def test_a_limit_of_something_else_is_refused(folder: Folder) -> None:
    with pytest.raises(InputError, match="'linkage.plya'"):
        view_of(roll_up(folder), {"linkage.plya": 1.0})


def command(*words: str) -> subprocess.CompletedProcess[str]:
    run = [sys.executable, "-m", "vaneloop", "fleet", *words]
    return subprocess.run(run, cwd=ROOT, capture_output=True, text=True, check=False)


def test_the_command_reports_and_says_how_far_a_run_is(folder: Folder, tmp_path: Path) -> None:
    done = command("status", str(folder.path), "--json", str(tmp_path / "s.json"))
    assert done.returncode == 0, done.stderr
    assert json.loads((tmp_path / "s.json").read_text())["came_to"] == {"done": 1500}
    page = tmp_path / "fleet.html"
    done = command("report", str(folder.path), "--report", str(page), "--tables-out", str(tmp_path / "t"))
    assert done.returncode == 1, done.stderr
    assert "supply_dip" in done.stdout and page.stat().st_size > 100_000
    assert pq.read_table(tmp_path / "t" / "lacks.parquet").num_rows > 0


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("status", "nowhere"), "is no fleet run"),
        (("run", "nowhere", "--out", "x"), "neither a log nor a folder"),
        (("run", "examples", "--out", "x", "--workers", "0"), "must be in"),
        (("work", "x", "--patience", "0"), "must be in"),
        (("run", "examples", "--out", "x", "--patience", "0"), "must be in"),
        (("run", "examples", "--out", "x", "--on", "slrum"), "did you mean slurm"),
        (("run", "examples", "--out", "x", "--queue", "night"), "must look like NAME=value"),
    ],
)
def test_bad_input_is_one_line_before_anything_is_begun(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    words: tuple[str, ...],
    says: str,
) -> None:
    (tmp_path / "examples").mkdir()
    (tmp_path / "examples" / "a.csv").write_text("t,n_dem\n0,60\n")
    monkeypatch.chdir(tmp_path)
    assert main(["fleet", *words]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and says in err, err
    assert not (tmp_path / "x").exists()


def test_the_folder_of_a_campaign_is_told_from_a_fleet_s(tmp_path: Path) -> None:
    run = Folder.begin(tmp_path / "run", "trial", {"plan": {}}, {})
    with pytest.raises(InputError, match=r"is a campaign's run, not a fleet's; vaneloop campaign PLAN\.toml --out"):
        roll_up(run)


@pytest.mark.slow
def test_a_folder_of_a_hundred_thousand_logs(tmp_path: Path) -> None:
    """It is listed and reported in bounded memory; the times are for reading."""
    import psutil

    folder = synthetic(tmp_path, 200, 500)
    began = time.process_time()
    assert state.state_of(folder).came == {"done": 100_000}
    listed = time.process_time() - began
    script = (
        "import sys, time; from hil.inject.fuzz_tools import _resident; from vaneloop.cli.main import main\n"
        "began = time.time(); code = main(['fleet', 'report', sys.argv[1], '--report', sys.argv[2]])\n"
        "print('MiB', int(_resident()), 's', time.time() - began, time.process_time()); sys.exit(code)"
    )
    words = [sys.executable, "-c", script, str(folder.path), str(tmp_path / "fleet.html")]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 1, done.stderr
    memory = int(done.stdout.rsplit("MiB", 1)[1].split()[0])
    print(f"listed in {listed:.1f} s, reported with {done.stdout.splitlines()[-1]}; {psutil.cpu_count()} cores")
    assert memory <= 2048


# ---- a simulated fleet -----------------------------------------------------------------------------------------------


def test_the_fates_of_a_simulated_fleet_are_known() -> None:
    fates = [fate(1, e, 40) for e in range(40)]
    count = Counter(f["fate"] for f in fates)
    assert count["badly rigged"] == count["sensor exchanged"] == 1
    assert 8 <= count["wear"] <= 11 and 6 <= count["null drift"] <= 9 and count["healthy"] >= 18
    for f in fates:
        if f.get("comes") == "growth":
            assert size_at(f, 0.99 * f["onset_years"]) == 0.0 and size_at(f, YEARS) == pytest.approx(f["size"])
            half = 0.5 * (f["onset_years"] + YEARS)
            assert size_at(f, half) == pytest.approx(0.5 * f["size"])
    assert fates == [fate(1, e, 40) for e in range(40)] != [fate(2, e, 40) for e in range(40)]


@pytest.mark.slow
def test_a_small_simulated_fleet_runs_from_logs_to_page(tmp_path: Path) -> None:
    """Eight real logs: simulated, diagnosed by two workers, reported; the badly rigged engine lacks something."""
    logs, run = str(tmp_path / "logs"), str(tmp_path / "run")
    words = ["--engines", "4", "--logs", "8", "--duration", "60", "--out", logs]
    assert start.main("benchmarks.fleet_demo", words) == 0
    done = command("run", logs, "--out", run)
    assert done.returncode == 0 and "8 of 8" in done.stdout, done.stderr
    done = command("report", run, "--report", str(tmp_path / "fleet.html"))
    assert done.returncode in (0, 1), done.stderr
    view = view_of(roll_up(Folder(run)), {})
    assert set(view.engines) == {f"engine_{k:03d}" for k in range(4)}
    assert {s.quantity for s in view.series} >= {"linkage.vigv_play", "actuator.flow_gain", "engine.lag"}
    assert {v for by in view.verdicts.values() for v in by} <= {"none", "missing", "unknown"}


def test_healthy_engines_are_hardly_said_to_change() -> None:
    """Of 100 engines with 20 quantities each, 50 logs: at most 2 % are meant, 6 or more would be a chance of 2 %."""
    rng = np.random.default_rng(4)
    accused = 0
    for _ in range(100):
        t, s = np.sort(rng.uniform(0.0, 2.0, 50)), np.full(50, 0.3)
        accused += any(trend(t, rng.normal(0.0, 1.0, 50), s, 0.01 / 20).kind != "none" for _ in range(20))
    assert accused <= 5


# ---- a user's own system ---------------------------------------------------------------------------------------------

BENCH = """
from vaneloop import System, unknown

system = System(
    "bench", "static", lambda u, p: p.gain * u.current, inputs={"current": "A"}, outputs={"flow": "l/min"},
    parameters=[unknown("gain", 1.0, "l/(min A)")], places=["output"],
)
"""


@pytest.mark.slow
def test_logs_of_a_system_of_ones_own_are_followed_over_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of two benches with a flow of 3 l/(min A), the flow meter of one drifts by 6 l/min a year from May on."""
    from vaneloop.cli import fleet
    from vaneloop.fleet import sources
    from vaneloop.fleet.worker import work

    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    (tmp_path / "bench.py").write_text(BENCH)
    rng, t = np.random.default_rng(1), np.arange(0.0, 30.0, 0.05)
    for engine in ("a", "b"):
        (tmp_path / "logs" / engine).mkdir(parents=True)
        for month in range(1, 13):
            current = np.interp(t, np.arange(0.0, 31.0, 2.0), rng.uniform(-2.0, 2.0, 16))
            flow = 3.0 * current + rng.normal(0.0, 0.05, len(t)) + (engine == "b") * 0.5 * max(month - 5, 0)
            rows = np.column_stack([t, current, flow])
            log = tmp_path / "logs" / engine / f"2026-{month:02d}-01.csv"
            np.savetxt(log, rows, delimiter=",", header="t,current,flow", comments="")
    words = ["run", str(tmp_path / "logs"), "--out", str(tmp_path / "run"), "--system", str(tmp_path / "bench.py")]
    parser = argparse.ArgumentParser()
    fleet.add_options(parser)
    run = Folder.begin(tmp_path / "run", "diagnosis", *fleet._job(parser.parse_args(words)))
    run.add(sources.find([str(tmp_path / "logs")]))
    assert work(run.path, trust=run.job["machine"]) == {"done": 24}
    view = view_of(roll_up(run), {"flow.bias.offset": 12.0})
    assert [(r["engine"], r["effect"]) for r in view.lacking] == [("b", "flow.bias")]
    (drift,) = view.changed
    assert (drift.engine, drift.quantity, drift.trend["kind"]) == ("b", "flow.bias.offset", "growth")
    assert abs(drift.trend["onset"] - (moment("2026-05-01") or 0.0)) < 0.1 * YEAR
    assert drift.trend["rate"] == pytest.approx(6.0, rel=0.05) and drift.trend["limit_time"] is not None
    gain = [s for s in view.series if s.quantity == "gain"]
    assert len(gain) == 2 and all(abs(s.trend["now"] - 3.0) < 0.02 and s.tolerance is None for s in gain)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--system", "no.py"], "no.py: no such file"),
        (["--system", "bench.py", "--plant", "pump.toml"], "--plant does not go with --system"),
        (["--system", "bench.py", "--model", "m.toml"], "is a model of 'the vane chain'; system 'bench' is asked for"),
    ],
)
def test_a_system_that_cannot_be_asked_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], words: list[str], says: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("bench.py").write_text(BENCH)
    Path("m.toml").write_text("[parameters]\n")
    Path("a.csv").write_text("t,current,flow\n0,0,0\n")
    assert main(["fleet", "run", "a.csv", "--out", "x", *words]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and says in err, err
    assert not Path("x").exists()
