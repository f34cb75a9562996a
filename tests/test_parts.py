"""One log in parts: what is fitted tells nothing of what tests it, whatever the model; wrong parts are told in one
line.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import vaneloop
from tests.conftest import ROOT
from tests.test_your_own_model import STRAIGHT, T, noise, wave
from vaneloop import Law, Parameter, Record, System
from vaneloop.base.errors import InputError
from vaneloop.base.spans import Span, apart, is_span, span_of
from vaneloop.cli.main import main
from vaneloop.verbs.parts import part_of, records_of

LOG = ROOT / "examples" / "hidden_effect.parquet"
ends = st.one_of(st.none(), st.floats(-1e6, 1e6).map(lambda v: float(f"{v:.6g}")))


@given(ends, ends)
def test_a_part_reads_back_as_it_is_written(low: float | None, high: float | None) -> None:
    if low is not None and high is not None and not low < high:
        with pytest.raises(InputError, match="must be above the beginning"):
            span_of((low, high), "--fit")
        return
    span = span_of((low, high), "--fit")
    assert is_span(str(span)) and span_of(str(span), "--fit") == span


@given(st.floats(1.0, 38.0), st.floats(1.0, 38.0))
def test_parts_that_meet_hold_every_sample_once(a: float, b: float) -> None:
    a, b = min(a, b), max(a, b) + 0.5
    record = Record("log", T + 7.0, {"u": T})
    parts = records_of(record, [Span(-np.inf, a + 7.0), Span(a + 7.0, b + 7.0), Span(b + 7.0, np.inf)])
    np.testing.assert_array_equal(np.concatenate([r.columns["u"] for r in parts]), T)
    for r in parts:
        assert r.begin == pytest.approx(r.columns["u"][0])


def test_a_name_of_a_file_is_no_part() -> None:
    assert not any(is_span(x) for x in ("other.csv", "C:/logs/a.csv", "run", Record("a", T, {}), ["a", "b"]))
    assert all(is_span(x) for x in ("0:200", ":", "1e2:", "-5:3.5", "nan:3", (0, None), (1.5, 2)))


def test_only_the_fitted_part_is_fitted() -> None:
    u = wave(1)
    y = np.where(T < 20.0, 2.0 * u + 0.3, 5.0 * u - 1.0) + 0.02 * noise()  # another machine from 20 s on
    record = Record("run", T, {"u": u, "y": y})
    by_log = vaneloop.compare(record, STRAIGHT, fit=(0, 20), test="20:").by_log
    assert by_log is not None
    values = {str(p["parameter"]): float(str(p["value"])) for p in by_log.parameters()}
    assert values["gain"] == pytest.approx(2.0, abs=0.01) and values["offset"] == pytest.approx(0.3, abs=0.01)
    errors = {log: float(v[0]) for log, v in by_log.steps["model"].items()}
    assert errors["run 0:20"] < 0.025
    late = T >= 20.0
    assert errors["run 20:"] == pytest.approx(np.sqrt(np.mean((3.0 * u - 1.3)[late] ** 2)), rel=0.02)


@pytest.mark.slow
def test_a_law_that_turns_on_time_keeps_counting_in_the_second_part() -> None:
    u = wave(2)
    record = Record("run", T + 100.0, {"u": u, "y": 2.0 * u * (1.0 + 0.05 * T) + 0.3 + 0.02 * noise()})
    drift = Law(
        "drift", "signal", lambda u, t, p: u * (1.0 + p.rise * t), [Parameter("rise", 0.0, "1/s", -1.0, 1.0)],
        [0.01, 0.1], places=["u"],
    )  # fmt: skip
    system = System(
        "map", "static", STRAIGHT.model, outputs={"y": "V"}, inputs={"u": "V"}, parameters=STRAIGHT.parameters,
        laws=[drift],
    )  # fmt: skip
    by_log = vaneloop.extend(record, ["u.drift"], system, fit=["100:125"], test=["125:"]).by_log
    assert by_log is not None
    assert by_log.model.effects["u.drift"]["rise"] == pytest.approx(0.05, rel=0.02)
    assert list(by_log.together().values())[-1]["test"][0] < 0.03


@pytest.mark.slow
def test_the_vane_chain_is_fitted_to_a_part_and_tested_on_the_rest(tmp_path: Path) -> None:
    words = [str(LOG), "--fit", "0:110", "--test", "110:", "--quiet"]
    assert main(["diagnose", *words, "--json", str(tmp_path / "d.json"), "--report", str(tmp_path / "d.html")]) == 1
    data = json.loads((tmp_path / "d.json").read_text())
    assert [e["effect"] for e in data["effects"]] == ["valve_dead_band", "aero_load"]
    (stroke,) = [row for row in data["tested"] if row["signal"] == "x_lvdt"]
    assert stroke["error_after"] < 1.1 * stroke["noise_floor"] < 0.05 * stroke["error_before"]
    assert stroke["samples"] < 9_000
    assert "On the part that nothing was fitted to" in (tmp_path / "d.html").read_text(encoding="utf-8")
    # compare says the same of the model as it is
    assert main(["compare", *words, "--json", str(tmp_path / "c.json")]) == 0
    before = {row["signal"]: row["error_before"] for row in data["tested"]}
    told = json.loads((tmp_path / "c.json").read_text())
    assert {row["signal"]: row["error_after"] for row in told["tested"]} == pytest.approx(before, rel=1e-9)
    samples = {row["signal"]: row["samples"] for row in told["stages"]}
    assert samples["x_lvdt"] < 11_000


def test_a_part_of_a_log_has_its_samples_and_no_other() -> None:
    log = vaneloop.read_log(LOG)
    part = part_of(log, [Span(10.0, 20.0), Span(50.0, np.inf)])
    t = part.channels["x_lvdt"].t
    assert t[0] == 10.0 and not np.any((t >= 20.0) & (t < 50.0)) and t[-1] == log.channels["x_lvdt"].t[-1]
    assert part_of(log, []) is log


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ("--fit 0:100 --test 90:", "--fit '0:100' and --test '90:' share '90:100'; parts must not overlap"),
        ("--fit 0:100 --fit 50:150", "--fit '0:100' and --fit '50:150' share '50:100'"),
        ("--test 100:", "--test '100:': a part of the log needs --fit FROM:TO beside it"),
        ("--fit 7:3", "--fit '7:3': the end (=3 s) must be above the beginning (=7 s)"),
        ("--fit 1:2:3", "--fit '1:2:3': must be FROM:TO in s of the log's time"),
        ("--fit nan:3", "--fit 'nan:3': 'nan' must be a number of seconds, or left out"),
        ("--fit a:b", "--fit 'a:b': 'a' must be a number of seconds"),
        ("--fit 200", "--fit '200': must be FROM:TO"),
        ("--fit 5000:", "0 samples in '5000:'; the log is from 0 to "),
        ("--fit 0:0.05", "samples"),
    ],
)
@pytest.mark.parametrize("own", [True, False], ids=["own model", "vanes"])
def test_wrong_parts_are_told_in_one_line(
    options: str, said: str, own: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = str(LOG)
    if own:
        (tmp_path / "m.py").write_text(
            "from vaneloop import System, unknown\n\n\ndef model(u, p):\n    return p.gain * u.u\n\n\n"
            'system = System("map", "static", model, outputs={"y": "V"}, inputs={"u": "V"},\n'
            '    parameters=[unknown("gain", 1.0, "-")])\n'
        )
        log = str(tmp_path / "log.csv")
        np.savetxt(log, np.column_stack([T, T, T]), delimiter=",", header="t,u,y", comments="")
        options += f" --system {tmp_path / 'm.py'}"
    assert main(["locate", log, *options.split()]) == 2
    err = [x for x in capsys.readouterr().err.splitlines() if x]
    assert said in err[-1] and len(err) == 1, err


def test_logs_to_test_the_vane_chain_are_refused() -> None:
    with pytest.raises(InputError, match=re.escape("the vane chain takes parts of its log")):
        vaneloop.compare(LOG, test=["other.csv"])
    with pytest.raises(InputError, match="overlap"):
        apart([Span(0.0, 2.0)], [Span(1.0, 3.0)])


def test_further_logs_are_fitted_whole_and_other_logs_test_beside_parts() -> None:
    def record(name: str, seed: int) -> Record:
        u = wave(seed)
        return Record(name, T, {"u": u, "y": 2.0 * u + 0.3 + 0.02 * noise()})

    given: dict[str, Any] = {"fit": [(None, 10), (30, None)], "test": [(10, 30), record("c", 3)]}
    by_log = vaneloop.compare([record("a", 1), record("b", 2)], STRAIGHT, **given).by_log
    assert by_log is not None and by_log.logs.test is not None
    assert list(by_log.logs.fitted.logs) == ["a :10", "a 30:", "b"]
    assert list(by_log.logs.test.logs) == ["a 10:30", "c"]
