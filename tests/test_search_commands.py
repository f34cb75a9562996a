"""The commands of the search for missing physics, as a user runs them: on the example log whose machine has a dead band
and a load.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.logs import Channel, read_log, write_log
from tests.browser import open_to_all
from vaneloop.cli.main import main

ROOT = Path(__file__).resolve().parent.parent
LOG = ROOT / "examples" / "hidden_effect.parquet"
HIDDEN = {
    "valve_dead_band": ("half_width", 0.8, "mA"),
    "aero_load": ("force", 3500.0, "N"),
}  # what examples/record.py put in


@dataclass(frozen=True)
class Answer:
    """What a command left behind."""

    code: int
    out: str
    err: str

    def json(self) -> dict[str, Any]:
        return json.loads(self.out, parse_constant=lambda word: pytest.fail(f"{word} is not JSON"))  # type: ignore[no-any-return]


def vaneloop(*words: str | Path, folder: Path | None = None) -> Answer:
    """Run a command in a process of its own."""
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "vaneloop.cli.main", *map(str, words)]
    p = subprocess.run(command, cwd=folder or ROOT, env=env, capture_output=True, text=True, timeout=300, check=False)
    return Answer(p.returncode, p.stdout, p.stderr)


def here(capsys: pytest.CaptureFixture[str], *words: str | Path) -> Answer:
    """Run a command in this process: starting one takes a processor longer than the command."""
    return Answer(main([str(w) for w in words]), *capsys.readouterr())


@pytest.fixture(scope="session")
def diagnosis(tmp_path_factory: pytest.TempPathFactory) -> tuple[Answer, Path]:
    page = tmp_path_factory.mktemp("diagnosis") / "diagnosis.html"
    return vaneloop("diagnose", LOG, "--json", "-", "--report", page), page


@pytest.fixture(scope="session")
def extension(tmp_path_factory: pytest.TempPathFactory) -> tuple[Answer, Path]:
    model = tmp_path_factory.mktemp("extension") / "both.toml"
    return vaneloop(
        "extend", LOG, "--effect", "valve_dead_band", "--effect", "aero_load", "--out", model, "--json", "-"
    ), model


@pytest.fixture(scope="session")
def nominal() -> Answer:
    return vaneloop("compare", LOG, "--json", "-")


# ---- diagnose --------------------------------------------------------------------------------------------------------


def test_diagnose_names_both_hidden_effects_and_no_other(diagnosis: tuple[Answer, Path]) -> None:
    answer, _ = diagnosis
    assert answer.code == 1
    j = answer.json()
    assert (j["schema"], j["log"], j["verdict"]) == (1, str(LOG), "missing")
    assert {e["effect"] for e in j["effects"]} == set(HIDDEN)
    for e in j["effects"]:
        name, truth, unit = HIDDEN[e["effect"]]
        p = e["parameters"][name]
        assert e["stage"] == "actuator" and e["probability"] > 0.8 and e["rivals"] == []
        assert p["unit"] == unit and p["low"] <= p["value"] <= p["high"]
        assert p["value"] == pytest.approx(truth, rel=0.05)  # the machine behind the log obeys other equations


def test_diagnose_finds_nothing_missing_in_the_other_stages(diagnosis: tuple[Answer, Path]) -> None:
    verdicts = {s["stage"]: s["verdict"] for s in diagnosis[0].json()["stages"]}
    assert verdicts == {"demand": "none", "servo": "none", "engine": "none", "actuator": "missing", "linkage": "none"}


def test_the_json_of_diagnose_keeps_its_contract(diagnosis: tuple[Answer, Path]) -> None:
    j = diagnosis[0].json()
    assert {"schema", "log", "verdict", "stages", "effects", "recalibrated", "unknown", "elapsed_s"} <= set(j)
    signals = []
    for s in j["stages"]:
        assert {"stage", "verdict", "signal", "unit", "error_before", "error_after", "noise_floor"} <= set(s)
        assert min(s["error_before"], s["error_after"], s["noise_floor"]) > 0.0
        signals.append(s["signal"])
    assert signals == ["x_dem", "i_cmd", "n_r", "x_lvdt", "vigv", "vgv1", "vgv2"]
    for q in j["recalibrated"]:
        assert {"parameter", "value", "low", "high", "unit"} <= set(q)
    assert j["unknown"] == [] and j["elapsed_s"] > 0.0


def test_diagnose_tells_the_user_on_standard_error_and_writes_a_page(diagnosis: tuple[Answer, Path]) -> None:
    answer, page = diagnosis
    assert "The actuator subsystem lacks" in answer.err and "Traceback" not in answer.err
    text = page.read_text(encoding="utf-8")
    assert "<html" in text and "valve_dead_band" in text and "aero_load" in text
    assert 'src="http' not in text  # self-contained


# ---- extend, compare, locate -----------------------------------------------------------------------------------------


def test_extend_brings_the_held_out_error_to_the_noise_floor(extension: tuple[Answer, Path]) -> None:
    answer, model = extension
    assert answer.code == 0, answer.err
    j = answer.json()
    (s,) = j["stages"]
    assert (s["stage"], s["signal"]) == ("actuator", "x_lvdt")
    assert s["error_before"] > 10 * s["noise_floor"] and s["error_after"] <= 1.1 * s["noise_floor"]
    levels = [step["noise_floors"] for step in j["waterfall"]["actuator"]]
    assert levels == sorted(levels, reverse=True) and len(levels) >= 3
    assert j["model"] == str(model)
    for e in j["effects"]:
        name, truth, _ = HIDDEN[e["effect"]]
        assert e["parameters"][name]["value"] == pytest.approx(truth, rel=0.05)


def test_the_model_file_says_what_was_added_and_how(extension: tuple[Answer, Path]) -> None:
    text = extension[1].read_text(encoding="utf-8")
    assert "[effects.valve_dead_band]" in text and "[effects.aero_load]" in text
    assert "vaneloop extend" in text


def test_compare_shows_the_whole_loop_and_each_stage(nominal: Answer) -> None:
    assert nominal.code == 0, nominal.err
    j = nominal.json()
    assert {"schema", "log", "simulated_s", "wall_s", "state_hash", "signals", "stages"} <= set(j)
    keys = {
        "signal",
        "stage",
        "unit",
        "reference",
        "rms",
        "mean_abs",
        "max_abs",
        "mean_abs_99_100",
        "noise_floor",
        "samples",
    }
    assert all(keys <= set(s) for s in j["signals"])
    assert {s["stage"] for s in j["stages"]} == {"demand", "servo", "engine", "actuator", "linkage"}
    worst = max(j["stages"], key=lambda s: s["ratio"])
    assert worst["stage"] == "actuator" and worst["ratio"] == pytest.approx(worst["rms"] / worst["noise_floor"])


def test_the_loop_hides_what_the_stage_shows(nominal: Answer) -> None:
    j = nominal.json()
    loop = next(s["rms"] for s in j["signals"] if (s["signal"], s["reference"]) == ("x_lvdt", "measured"))
    stage = next(s["rms"] for s in j["stages"] if s["signal"] == "x_lvdt")
    assert stage > 10 * loop


@pytest.mark.slow
def test_the_extended_model_is_nearer_to_the_log_in_the_whole_loop(
    nominal: Answer, extension: tuple[Answer, Path], tmp_path: Path
) -> None:
    page = tmp_path / "compare.html"
    answer = vaneloop("compare", LOG, "--model", extension[1], "--json", "-", "--report", page)
    assert answer.code == 0, answer.err
    before, after = nominal.json(), answer.json()
    for where in ("signals", "stages"):
        x = [next(s["rms"] for s in j[where] if s["signal"] == "x_lvdt") for j in (before, after)]
        assert x[1] < 0.6 * x[0], where
    assert page.stat().st_size > 10_000
    open_to_all(page, "compare")


def test_compare_leaves_with_one_where_a_tolerance_is_exceeded(capsys: pytest.CaptureFixture[str]) -> None:
    answer = here(capsys, "compare", LOG, "--tolerance", "x_lvdt=0.001", "--json", "-", "--quiet")
    assert answer.code == 1 and answer.json()["exceeded"]
    assert answer.err.count("\n") <= 1


def test_locate_names_the_actuator_and_no_other_stage(capsys: pytest.CaptureFixture[str]) -> None:
    answer = here(capsys, "locate", LOG, "--json", "-")
    assert answer.code == 1
    stages = {s["stage"]: s for s in answer.json()["stages"]}
    assert [name for name, s in stages.items() if s["fails"]] == ["actuator"]
    conditions = {r["condition"] for r in stages["actuator"]["regimes"]}
    assert {"direction", "stroke speed", "stroke", "time"} <= conditions
    for r in stages["actuator"]["regimes"]:
        assert len(r["edges"]) == len(r["rms"]) + 1 == len(r["noise_floors"]) + 1 == len(r["significant"]) + 1
    assert stages["actuator"]["onset_s"] is None  # it was there from the start


@pytest.mark.slow
def test_locate_agrees_with_the_extended_model(extension: tuple[Answer, Path]) -> None:
    answer = vaneloop("locate", LOG, "--model", extension[1], "--json", "-", "--quiet")
    stages = {s["stage"]: s for s in answer.json()["stages"]}
    ratio = max(max(x for x in r["noise_floors"] if x is not None) for r in stages["actuator"]["regimes"])
    assert ratio < 2.0


# ---- bad input -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def bad(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with logs that cannot be searched."""
    folder = tmp_path_factory.mktemp("bad")
    c = read_log(LOG, require=()).channels
    write_log(folder / "short.csv", {k: Channel(v.t[:300], v.values[:300]) for k, v in c.items()})
    write_log(folder / "vanes_only.csv", {"vigv": Channel(c["vigv"].t[:2000], c["vigv"].values[:2000])})
    t = np.arange(200) * 0.01
    (folder / "text.csv").write_text("t,n_dem,x_lvdt\n" + "\n".join(f"{x:.2f},fast,slow" for x in t))
    (folder / "cut.parquet").write_bytes(LOG.read_bytes()[:5000])
    (folder / "a_folder").mkdir()
    (folder / "wrong.toml").write_text('[effects.valve_dead_bnad]\nhalf_width = "wide"\n')
    return folder


SEARCH = ("locate", "diagnose")
BAD: list[tuple[tuple[str, ...], tuple[str, ...]]] = [
    (
        ("extend", "{log}", "--effect", "valve_dead_bnad", "--out", "m.toml"),
        ("valve_dead_bnad", "'valve_dead_band' is meant"),
    ),
    (("extend", "{log}", "--out", "m.toml"), ("--effect",)),
    (("extend", "{log}", "--effect", "aero_load"), ("--out",)),
    (
        ("extend", "{log}", "--effect", "aero_load", "--out", "no_such_folder/m.toml"),
        ("no_such_folder/m.toml", "cannot write"),
    ),
    (("extend", "{log}", "--effect", "aero_load", "--out", "a_folder"), ("a_folder", "cannot write")),
    (("extend", "vanes_only.csv", "--effect", "aero_load", "--out", "m.toml"), ("vanes_only.csv",)),
    *(((c, "no_such.csv"), ("no_such.csv",)) for c in (*SEARCH, "compare")),
    *(((c, "vanes_only.csv"), ("vanes_only.csv", "no subsystem can be judged")) for c in SEARCH),
    *(((c, "short.csv"), ("short.csv", "300 samples", "at least 500")) for c in SEARCH),
    (("diagnose", "text.csv"), ("text.csv",)),
    (("diagnose", "cut.parquet"), ("cut.parquet",)),
    (("diagnose", "{log}", "--workers", "0"), ("--workers (=0) must be in [1, 64]",)),
    (("diagnose", "{log}", "--workers", "two"), ("--workers",)),
    (("diagnose", "{log}", "--model", "wrong.toml"), ("wrong.toml", "valve_dead_bnad")),
    (("locate", "{log}", "--model", "no_such.toml"), ("no_such.toml",)),
    (("locate", "{log}", "--json", "no_such_folder/out.json"), ("no_such_folder/out.json", "cannot write")),
]


def complaint(code: int, text: str) -> str:
    """The one line that was said."""
    assert code == 2 and "Traceback" not in text, text
    (line,) = text.strip().splitlines()
    return line


@pytest.mark.parametrize(("words", "says"), BAD, ids=[" ".join(w) for w, _ in BAD])
def test_bad_input_gets_one_line_and_exit_code_two(
    words: tuple[str, ...],
    says: tuple[str, ...],
    bad: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(bad)
    try:  # in this process: twenty of their own would take a minute
        code = main([w.format(log=LOG) for w in words] + ["--quiet"])
    except SystemExit as leaving:
        code = int(leaving.code or 0)
    out, err = capsys.readouterr()
    line = complaint(code, err)
    assert out == "" and all(word in line for word in says), line
    assert not (bad / "m.toml").exists()


def test_a_log_that_is_none_is_complained_of_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "junk.mf4").write_bytes(b"MDF     4.10    " + bytes(range(256)) * 40)
    code = main(["compare", str(tmp_path / "junk.mf4")])
    out, err = capsys.readouterr()
    assert "junk.mf4" in complaint(code, err)
    assert all("compil" in line for line in out.splitlines())  # a new machine is told of the wait


def test_a_process_with_bad_input_leaves_with_two(bad: Path) -> None:
    answer = vaneloop("diagnose", "short.csv", folder=bad)
    assert "at least 500" in complaint(answer.code, answer.err)
    assert all("compil" in line for line in answer.out.splitlines())  # a new machine is told of the wait
