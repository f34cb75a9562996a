"""`import vaneloop`: every verb's answer, and that terminal, JSON, page and notebook say the same."""

from __future__ import annotations

import html
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import vaneloop
from tests.conftest import ROOT
from vaneloop.base import terminal
from vaneloop.cli.main import main
from vaneloop.verbs.answer import Answer
from vaneloop.verbs.search import Diagnosed, Experiment, Extended, Stages

LOG = ROOT / "examples" / "hidden_effect.parquet"
RUN = ROOT / "examples" / "engine_run.blf"
TIMES = ("elapsed_s", "wall_s")


def shown(answer: Answer, folder: Path) -> str:
    """Try every way in which an answer shows itself; return the written page."""
    assert str(answer) == answer.sentence() and answer.sentence().endswith(".")
    assert answer.sentence() in html.unescape(answer._repr_html_())
    assert len(answer.figure().data) > 0
    terminal.plain(answer.to_dict())
    page = answer.report(folder / "page.html", "vaneloop something").read_text(encoding="utf-8")
    assert html.escape(answer.page().verdict) in page
    return page


def cells(page: str) -> set[str]:
    """Contents of a page's tables."""
    return {html.unescape(re.sub(r"<[^>]+>", "", c)).strip() for c in re.findall(r"<td[^>]*>(.*?)</td>", page)}


def without_times(data: Any) -> Any:
    return json.loads(json.dumps({k: v for k, v in terminal.plain(data).items() if k not in (*TIMES, "log")}))


@pytest.fixture(scope="module")
def diagnosed() -> Diagnosed:
    answer = vaneloop.diagnose(LOG)
    assert isinstance(answer, Diagnosed)
    return answer


def command(folder: Path, *words: str) -> Any:
    """The JSON of a command."""
    out = folder / "answer.json"
    assert main([*words, "--quiet", "--json", str(out)]) in (0, 1)
    return json.loads(out.read_text())


@pytest.mark.slow
def test_diagnose_says_in_a_notebook_what_the_command_says(diagnosed: Diagnosed, tmp_path: Path) -> None:
    assert diagnosed.effects == ["valve_dead_band", "aero_load"] and diagnosed.verdict == "missing"
    assert without_times(diagnosed.to_dict()) == without_times(command(tmp_path, "diagnose", str(LOG)))


@pytest.mark.slow
def test_a_diagnosis_page_has_the_numbers_of_its_json(diagnosed: Diagnosed, tmp_path: Path) -> None:
    from vaneloop.pages.style import interval, number

    there, data = cells(shown(diagnosed, tmp_path)), diagnosed.to_dict()
    for s in data["stages"]:
        assert {s["stage"], s["signal"]} <= there
        assert {number(s[k]) for k in ("error_before", "error_after", "noise_floor")} <= there
    for e in data["effects"]:
        assert {e["effect"], f"{100 * e['probability']:.0f} %"} <= there
        for name, p in e["parameters"].items():
            assert {name, *map(str, interval(*(p[k] for k in ("value", "low", "high"))))} <= there
    for r in data["recalibrated"]:
        assert {r["parameter"], str(interval(*(r[k] for k in ("value", "low", "high")))[0])} <= there


@pytest.mark.slow
def test_extend_gives_a_model_with_which_the_log_agrees(diagnosed: Diagnosed, tmp_path: Path) -> None:
    answer = vaneloop.extend(vaneloop.read_log(LOG), diagnosed.effects)
    assert isinstance(answer, Extended) and answer.reached and not answer.refused
    shown(answer, tmp_path)
    file = answer.write(tmp_path / "m.toml")
    with_it = vaneloop.locate(LOG, vaneloop.Machine(model=file))
    assert isinstance(with_it, Stages) and not any(x.fails for x in with_it.located if x.stage == "actuator")
    told = command(tmp_path, "extend", str(LOG), "--effect", *diagnosed.effects, "--out", str(tmp_path / "n.toml"))
    differ = {"model", *TIMES, "log"}
    assert {k: v for k, v in told.items() if k not in differ} == {
        k: v for k, v in without_times(answer.to_dict()).items() if k not in differ
    }


def test_locate_and_compare_say_the_same(tmp_path: Path) -> None:
    located = vaneloop.locate(LOG)
    assert isinstance(located, Stages) and located.fails
    assert without_times(located.to_dict()) == without_times(command(tmp_path, "locate", str(LOG)))
    page = shown(located, tmp_path)
    assert {x.stage for x in located.located} <= cells(page)
    assert str(vaneloop.compare(LOG)) == str(located)


def test_replay_says_in_a_notebook_what_the_command_says(tmp_path: Path) -> None:
    answer = vaneloop.replay(vaneloop.read_log(RUN))
    told = command(tmp_path, "replay", str(RUN))
    assert without_times(answer.to_dict()) == without_times(told) and told["state_hash"]
    from vaneloop.pages.style import number

    there = cells(shown(answer, tmp_path))
    for s in answer.signals:
        assert {number(s.rms), number(s.noise_floor)} <= there


@pytest.mark.slow
def test_an_experiment_of_a_log_without_rivals(diagnosed: Diagnosed, tmp_path: Path) -> None:
    answer = vaneloop.experiment(LOG, diagnosed)
    assert isinstance(answer, Experiment) and answer.recommended is None
    notes = diagnosed.diagnosis.notes
    assert answer.to_dict() == {
        "schema": 1, "log": answer.log, "recommended": None, "profiles": [], "notes": notes, "done": [],
    }  # fmt: skip
    shown(answer, tmp_path)


def straight(u: Any, p: Any) -> Any:
    return p.gain * u.u + p.offset


def test_the_verbs_take_a_system_of_the_user(tmp_path: Path) -> None:
    system = vaneloop.System(
        "map", "static", straight, outputs={"y": "V"}, inputs={"u": "V"},
        parameters=[vaneloop.unknown("gain", 1.0, "-"), vaneloop.unknown("offset", 0.0, "V")],
    )  # fmt: skip
    t = np.arange(0.0, 40.0, 0.02)
    rng = np.random.default_rng(1)
    u = np.sin(0.4 * t) + 0.7 * np.sin(1.7 * t + 1.0) + 0.3 * np.sin(4.1 * t)
    log = vaneloop.Record("made", t, {"u": u, "y": np.abs(2.0 * u + 0.3) + 0.01 * rng.standard_normal(len(t))})
    answer = vaneloop.diagnose(log, system)
    assert isinstance(answer, Diagnosed) and answer.effects == ["y.absolute_value"] and answer.verdict == "missing"
    there = cells(shown(answer, tmp_path))
    assert "y.absolute_value" in there
    better = vaneloop.extend([log], answer.effects, system, test=[log])
    assert isinstance(better, Extended) and better.model is not None and better.model.effects
    better.write(tmp_path / "better.toml")
    assert vaneloop.diagnose(log, system, added=better.model).verdict == "none"
    assert isinstance(vaneloop.compare(log, system), Stages)
    with pytest.raises(vaneloop.InputError, match="not a law"):
        vaneloop.extend(log, ["y.nothing"], system)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (lambda: vaneloop.Machine(tables="nowhere"), "nowhere: is not a folder"),
        (lambda: vaneloop.Machine(model="nowhere.toml"), "nowhere.toml"),
        (lambda: vaneloop.Machine(strategy="triple"), "triple"),
        (lambda: vaneloop.diagnose("nowhere.csv"), "nowhere.csv"),
        (lambda: vaneloop.extend(LOG, ["valve_ded_band"]), "probably 'valve_dead_band'"),
    ],
)
def test_bad_input_is_refused_in_one_line(wrong: Any, said: str) -> None:
    with pytest.raises(vaneloop.InputError) as caught:
        wrong()
    assert said in str(caught.value) and "\n" not in str(caught.value)


def test_names_are_imported_when_they_are_used() -> None:
    assert set(vaneloop.__all__) <= set(dir(vaneloop))
    for name in vaneloop.__all__:
        assert getattr(vaneloop, name).__name__ == name
    with pytest.raises(AttributeError, match="module 'vaneloop' has no attribute 'nothing'"):
        _ = vaneloop.nothing
