"""Steady points without a time: a few dozen rows in any order, of which each is judged by its neighbours."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import vaneloop
from hil.logs import LogError, read_log
from vaneloop import System, unknown
from vaneloop.verbs.parts import read_record

SYSTEM = System(
    "amplifier", "static", lambda u, p: p.gain * u.u, outputs={"y": "V"}, inputs={"u": "V"},
    parameters=[unknown("gain", 1.0, "-")],
)  # fmt: skip


def points(n: int, seed: int = 0, lacks: float = 0.0) -> Any:
    pandas = pytest.importorskip("pandas")
    rng = np.random.default_rng(seed)
    u = rng.uniform(-3.0, 3.0, n)
    return pandas.DataFrame({"u": u, "y": 1.5 * u + lacks * np.abs(u) + 0.02 * rng.standard_normal(n)})


def test_24_points_of_a_right_model_lack_nothing_in_any_order(tmp_path: Path) -> None:
    frame, said = points(24), []
    for k, rows in enumerate((frame, frame.sample(frac=1.0, random_state=2), frame.sort_values("u"))):
        rows.to_csv(tmp_path / f"{k}.csv", index=False)
        for log in (tmp_path / f"{k}.csv", *([rows] if k == 1 else [])):
            answer = vaneloop.compare(log, SYSTEM)
            said.append((answer.verdict, answer.rows()[0]["rms"], answer.rows()[0]["noise_floor"]))
            assert any("no time column" in n for n in answer.to_dict()["notes"])
    assert set(said) == {said[0]} and said[0][0] == "agrees"
    assert 0.01 < said[0][2] < 0.04


@pytest.mark.slow
def test_what_is_missing_is_named_from_points_in_no_order() -> None:
    found = vaneloop.diagnose(points(300, lacks=0.4), SYSTEM)
    assert found.verdict == "missing"
    assert not any(law in e for e in found.effects for law in ("lag", "play", "dead_time", "rate_limit"))


def test_a_row_that_lacks_an_input_is_left_out_and_counted() -> None:
    frame = points(40)
    frame.loc[[3, 9], "u"] = np.nan
    frame.loc[5, "y"] = np.nan
    record, notes = read_record(frame, SYSTEM)
    assert len(record.t) == 37 and not record.ordered
    assert any("3 without an input, or without any output" in n for n in notes)
    rows = frame.dropna()
    assert set(zip(record.columns["u"], record.columns["y"], strict=True)) == set(zip(rows.u, rows.y, strict=True))


def test_other_models_and_the_machine_want_a_time(tmp_path: Path) -> None:
    points(60).to_csv(tmp_path / "points.csv", index=False)
    with pytest.raises(LogError, match="no time column"):
        read_log(tmp_path / "points.csv", signals={"u": "V", "y": "V"}, require=("u",))
    with pytest.raises(vaneloop.InputError, match="at least 12"):
        vaneloop.compare(points(11), SYSTEM)
