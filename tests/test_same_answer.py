"""Every verb says the same of one log: compare, locate, diagnose, extend, page, workbench start from one error and one
noise floor.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil import figures
from hil.logs import Channel, Log
from tests.conftest import ROOT
from tests.firmware_on_rig import firmware
from tests.rig import Hidden, manoeuvre, simulate
from vaneloop.cli.main import main
from vaneloop.discrepancy import locate as core
from vaneloop.discrepancy.diagnose import diagnose_stage, extend_stage
from vaneloop.discrepancy.models.vanes import Chain, build_chain
from vaneloop.discrepancy.workflow import compare_stages, locate_stages

LOG = ROOT / "examples" / "hidden_effect.parquet"
SENSOR = {
    "actuator": 0.00505
}  # mm, the rig's LVDT: noise of 5 um, its converter's step, what its valve has beyond the model's


def rig(hidden: list[Hidden], seed: int, rate: int = 100) -> Chain:
    log = simulate(manoeuvre(seed, 100.0), firmware(), hidden, seed=seed, rate=rate).log
    return build_chain(Log("rig", {k: Channel(log["t"], v) for k, v in log.items() if k != "t"}))


# what is hidden, in which stage, seed: gross, small, none
CASES: list[tuple[str, dict[str, float], str, int]] = [
    ("valve_dead_band", {"half_width": 1.5e-3}, "actuator", 951),
    ("valve_dead_band", {"half_width": 5e-5}, "actuator", 952),
    ("end_stop_shift", {"shift": 8e-3}, "actuator", 953),
    ("valve_null_bias", {"bias": 1e-3}, "actuator", 954),
    ("linkage_backlash", {"stage": 0, "width": 0.02}, "linkage", 955),
    ("rotor_lag_error", {"lag": 1.2}, "engine", 956),
    ("", {}, "actuator", 957),
    ("", {}, "linkage", 958),
]


SLOW = (954, 955)


@pytest.mark.parametrize(
    ("effect", "size", "stage", "seed"),
    [pytest.param(*c, id=f"{c[0] or 'clean'} {c[3]}", marks=[pytest.mark.slow] if c[3] in SLOW else []) for c in CASES],
)
def test_every_verb_starts_from_the_same_number(effect: str, size: dict[str, float], stage: str, seed: int) -> None:
    s = rig([Hidden(effect, size)] if effect else [], seed).stage(stage)
    assert s.floor is not None
    compared, (located,) = compare_stages([s]), locate_stages([s])
    assert [f.ratio for f in compared] == [f.ratio for f in located.signals]
    starts = {"compare": np.array([f.ratio for f in compared])}
    d = diagnose_stage(s, s.floor)
    starts["diagnose"] = d.error_before / d.floor
    if effect:
        e = extend_stage(s, (effect,))
        starts["extend"] = e.error_before / e.floor
        assert d.verdict == "missing" or not located.fails
    else:
        assert not located.fails and d.verdict == "none"
        assert located.worst.ratio < 1.03
    for verb, ratio in starts.items():
        assert ratio == pytest.approx(starts["compare"], rel=0.02), verb
    if stage in SENSOR:
        assert s.floor[0] == pytest.approx(SENSOR[stage], rel=0.06)


@pytest.fixture(scope="module")
def said(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What each verb says of the example, in JSON, on its page, in the workbench."""
    folder = tmp_path_factory.mktemp("said")
    out: dict[str, Any] = {}
    for verb in ("compare", "locate", "diagnose", "extend"):
        more = ["--effect", "valve_dead_band", "aero_load", "--out", str(folder / "m.toml")] if verb == "extend" else []
        page, answer = folder / f"{verb}.html", folder / f"{verb}.json"
        main([verb, str(LOG), *more, "--json", str(answer), "--report", str(page), "--quiet"])
        out[verb], out[f"{verb} page"] = json.loads(answer.read_text()), page.read_text(encoding="utf-8")
    from vaneloop.web import worker

    out["web"] = worker.compare(lambda *_: None, [str(LOG)])
    return out


def ratios(verb: str, j: Any) -> dict[str, float]:
    """Error over noise floor, by signal, that a verb starts from."""
    if verb == "web":
        return {f.signal: f.ratio for f in j["figures"]}
    if verb == "locate":
        return {f["signal"]: f["ratio"] for s in j["stages"] for f in s["signals"]}
    before = "rms" if verb == "compare" else "error_before"
    return {s["signal"]: s[before] / s["noise_floor"] for s in j["stages"] if s["signal"]}


def test_the_example_s_actuator_starts_at_132_floors_whoever_is_asked(said: dict[str, Any]) -> None:
    for verb in ("compare", "locate", "diagnose", "extend", "web"):
        assert ratios(verb, said[verb])["x_lvdt"] == pytest.approx(132.0, rel=0.02), verb


@pytest.mark.parametrize("verb", ["locate", "diagnose", "extend", "web"])
def test_every_signal_of_the_example_has_one_figure(said: dict[str, Any], verb: str) -> None:
    compared = ratios("compare", said["compare"])
    for signal, ratio in ratios(verb, said[verb]).items():
        assert ratio == pytest.approx(compared[signal], rel=0.02), signal


def test_a_signal_has_one_noise_floor_in_one_answer(said: dict[str, Any]) -> None:
    j = said["compare"]
    floors = {s["signal"]: s["noise_floor"] for s in j["stages"]}
    assert {s["signal"] for s in j["signals"]} == set(floors)
    for s in j["signals"]:
        assert s["noise_floor"] == floors[s["signal"]], s["signal"]


def test_terminal_json_page_and_workbench_agree_which_stages_fail(
    said: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "locate.html"
    assert main(["locate", str(LOG), "--report", str(page)]) == 1
    text = capsys.readouterr().out
    terminal = {m[1]: m[2] == "fails" for m in re.finditer(r"^(\w+): (agrees|fails) ", text, re.M)}
    drawn = page.read_text(encoding="utf-8")
    on_page = {s: f"{s}: fails in" in drawn for s in terminal}
    assert all(fails or f"{s}: agrees everywhere" in drawn for s, fails in on_page.items())
    in_json = {s["stage"]: s["fails"] for s in said["locate"]["stages"]}
    on_compare = {s: f"{s}: fails in" in said["compare page"] for s in terminal}
    web = {s: x.fails for s, x in said["web"]["located"].items()}
    expected = {s: s == "actuator" for s in ("demand", "servo", "engine", "actuator", "linkage")}
    assert terminal == on_page == in_json == on_compare == web == expected
    sentence = "The model fails most in the actuator stage: x_lvdt is off by"
    assert all(sentence in x for x in (drawn, said["compare page"], said["web"]["verdict"]))
    assert said["compare"]["verdict"] == "fails"


def test_agrees_is_one_number() -> None:
    """Two packages that may not import each other have it; nobody else writes one."""
    assert figures.AGREES == core.AGREES
    assert core.agrees(1.1, 1.0) and not core.agrees(1.1001, 1.0)
    own = re.compile(r"(ratio|excess|rms\([a-z_]+\)|error_after|\.rms)\b[^\n]{0,40}(<=?|>=?) ?1\.[0-3]\d?\b")
    files = [p for top in ("hil", "vaneloop") for p in (ROOT / top).rglob("*.py")]
    assert len(files) > 100
    wrong = [
        f"{p.relative_to(ROOT)}: {m[0]}"
        for p in files
        for m in own.finditer(p.read_text(encoding="utf-8"))
        if p.name not in ("strategies.py", "engine_test.py")
    ]
    assert not [w for w in wrong if "1.05" not in w], wrong


@pytest.mark.parametrize("seed", range(961, 966))
@pytest.mark.slow
def test_clean_logs_stand_at_their_floors(seed: int) -> None:
    for x in locate_stages(rig([], seed).stages):
        if x.stage != "demand":
            for f in x.signals:
                assert 0.95 < f.ratio < 1.03 and not x.fails, f.signal


def test_a_noise_floor_is_no_more_than_the_noise_of_the_replayed_error() -> None:
    """The channel moves, and motion passes for noise; the error of a model that moves as the machine does holds less of
    it.
    """
    t = np.arange(30_000) * 0.01
    motion = 2.0 * np.sin(2.0 * np.pi * 5.0 * t) * (1.0 + 0.5 * np.sin(2.0 * np.pi * 0.21 * t))
    measured = motion + np.random.default_rng(1).normal(0.0, 0.005, t.size)
    f = figures.error_figures("x_lvdt", "actuator", "mm", "measured", t, motion, measured)
    assert f.noise_floor == pytest.approx(0.005, rel=0.03) and figures.noise_floor(t, measured) > 0.006
