"""Campaigns: margins agree with verdicts; probability, worst case and indices are right where the truth is known."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree as Xml

import numpy as np
import pytest

pytest.importorskip("psutil", reason="the extra `fleet` is not installed")

from hil import inject
from hil.inject.margin import margins
from tests.browser import open_to_all
from tests.conftest import ROOT
from tests.native_builds import wrong
from vaneloop.base.errors import InputError
from vaneloop.cli.main import main
from vaneloop.fleet import campaign
from vaneloop.fleet.plan import draw, groups, load_plan
from vaneloop.fleet.worker import work
from vaneloop.pages.campaign import campaign_page


@pytest.fixture(autouse=True)
def here(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The processes that run trials find the package."""
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    yield


# ---- margins ---------------------------------------------------------------------------------------------------------

T = np.arange(1000) * 1e-3
X = 10.0 * T  # mm
MODE = np.where(T < 0.2, 1, np.where(T < 0.8, 2, 3))  # STANDBY, RUN, DEGRADED
CLAIMS = [  # claim, margin, share; NaN: nothing measures it
    ({"mode": "RUN", "at": 0.2}, 0.002, 1.0),
    ({"mode": "RUN", "at": 0.201}, 0.001, 0.5),
    ({"mode": "RUN", "at": 0.3}, -0.098, -1.0),
    ({"mode": "RUN", "by": 0.6, "after": 0.1}, 0.4, 0.8),
    ({"mode": "RUN", "by": 0.15, "after": 0.1}, -0.05, -1.0),
    ({"mode": "FAIL_SAFE", "by": 0.6}, np.nan, -1.0),
    ({"mode": "RUN", "during": [0.4, 0.7]}, 0.2, 0.5),
    ({"mode": "RUN", "during": [0.4, 0.9]}, -0.101, -0.202),
    ({"mode": "FAIL_SAFE", "never": True}, np.nan, np.nan),
    ({"mode": "DEGRADED", "never": True}, -0.2, -0.2002),
    ({"signal": "x_lvdt", "low": 3.0, "high": 8.0, "during": [0.4, 0.7]}, 1.0, 0.4),
    ({"signal": "x_lvdt", "high": 5.0, "during": [0.4, 0.6]}, -1.0, -0.2),
    ({"signal": "x_lvdt", "low": 12.0, "high": 14.0, "by": 0.9}, -2.01, -1.0),
    ({"signal": "x_lvdt", "low": 5.0, "never": True}, -0.5, -0.5005),
]


@pytest.mark.parametrize(("claim", "value", "share"), CLAIMS, ids=[str(c) for c, _, _ in CLAIMS])
def test_a_margin_is_the_distance_and_has_the_verdicts_sign(claim: dict, value: float, share: float) -> None:
    from hil.inject.verdict import Outcome, Trace

    scenario = inject.Scenario(title="made", duration=1.0, expect=[inject.Expect(**claim)])
    signals = {"x_lvdt": X, "x_dem": X, "i_cmd": X}
    trace = Trace(T, MODE, np.zeros(1000, np.int64), signals)
    checks = inject.judge(scenario, trace)
    m = margins(scenario, Outcome("made", "", "lockstep", checks, trace, [], [], {}, [], 1.0, 0.0, None))[0]
    assert m.held == checks[0].held and (np.isnan(m.share) or (m.share >= 0.0) == m.held)
    assert m.value == pytest.approx(value, abs=1e-9, nan_ok=True) and m.share == pytest.approx(
        share, abs=2e-4, nan_ok=True
    )


# ---- the whole, where the truth is known -----------------------------------------------------------------------------

STILL = """title = "Nothing moves"
duration = 0.4
[[expect]]
signal = "vigv"
high = {high}
during = [0.3, 0.35]
"""


def write(folder: Path, margin: float = 0.05, more: str = "", keys: str = "", name: str = "still") -> Path:
    """A plan whose scenario holds while the potentiometer's bias is below ``margin`` deg; the rest is idle."""
    still = inject.Scenario(title="still", duration=0.4)
    vigv = inject.run(still).trace.signals["vigv"][300:351].max()
    (folder / f"{name}.toml").write_text(STILL.format(high=float(vigv) + margin))
    plan = folder / "plan.toml"
    plan.write_text(
        f'title = "bias"\nscenarios = ["{name}.toml"]\nsamples = 16\nsearch = 16\nsensitivity = 8\n{keys}\n'
        f'[vary]\n"sensors.vigv_bias" = "tolerance"\n"engine.lag" = [1.1, 1.3]\n{more}'
    )
    return plan


def run(plan: Path, out: Path) -> None:
    """Do a campaign's work in this process, without Dask."""
    read, quantities, folder = campaign.begin(plan, out, 3600.0)
    assert campaign.take_samples(read, quantities, folder)
    work(folder.path)
    campaign.take_searches(read, folder)
    work(folder.path)


@pytest.mark.slow
def test_probability_worst_case_and_indices_where_the_truth_is_known(tmp_path: Path) -> None:
    plan, out = write(tmp_path, keys="saved = 3"), tmp_path / "run"
    run(plan, out)
    words = ["campaign", str(plan), "--out", str(out), "--report", str(tmp_path / "c.html")]
    words += ["--json", str(tmp_path / "c.json"), "--junit", str(tmp_path / "c.xml"), "--quiet"]
    assert main(words) == 1  # a quarter of the machines fails; all trials are there, none is run again
    said = json.loads((tmp_path / "c.json").read_text())
    (g,) = said["groups"]
    # each sixteenth of a quantity's range has one point of the sequence: bias above 0.05 of -0.1..0.1 deg is four
    assert (g["trials"], g["failed"], g["lost"]) == (16, 4, 0) and g["low"] < 0.25 < g["high"]
    assert g["low"] == pytest.approx(0.0727, abs=1e-4) and g["high"] == pytest.approx(0.5238, abs=1e-4)
    assert g["by_search"] and g["worst"][0] > 0.0999  # the sequence's greatest is below
    claim = g["requirements"][0]
    assert claim["broken"] == 4 and claim["searched"] == pytest.approx(0.05 - g["worst"][0], abs=1e-3)
    assert g["total"][0] > 0.5 and g["total"][1] == pytest.approx(0.0, abs=1e-6)
    again = g["command"].split()
    assert main([*again[1:], "--json", str(tmp_path / "again.json"), "--quiet"]) == 1
    (o,) = json.loads((tmp_path / "again.json").read_text())["scenarios"]
    assert o["state_hash"] == g["state_hash"] and g["same"]
    assert [f["name"] for f in g["failures"]] and len(g["failures"]) == 3 and g["failures_not_saved"] == 1
    for f in g["failures"]:  # each runs alone to the verdict and the margin that it had in lanes
        assert f["same"] and Path(f["file"]).parent == out / "failed" / g["name"] / "machines"
        assert main([*f["command"].split()[1:], "--json", str(tmp_path / "alone.json"), "--quiet"]) == 1
        (o,) = json.loads((tmp_path / "alone.json").read_text())["scenarios"]
        assert [c["held"] for c in o["expectations"]].count(False) == 1
    assert "3 of 4 failed machines saved, the worst first; 1 more failed" in (tmp_path / "c.html").read_text()
    cases = {c.get("name"): c.find("failure") is not None for c in Xml.parse(tmp_path / "c.xml").iter("testcase")}
    assert cases[claim["expected"]] and not cases["mode changes as documented"] and cases["the combination passes"]
    assert "worst machine" in (tmp_path / "c.html").read_text()
    open_to_all(tmp_path / "c.html", "campaign")


@pytest.mark.slow
@pytest.mark.parametrize("p", [1e-4, 1e-6])
def test_subset_simulation_of_machines_covers_a_probability_that_is_known(tmp_path: Path, p: float) -> None:
    """The bias of the potentiometer is uniform within -0.1..0.1 deg, and adds to the angle: it alone decides."""
    plan, out = write(tmp_path, 0.1 - 0.2 * p, keys='saved = 3\nsampling = "subset"\nallowed = 0.01'), tmp_path / "run"
    text = plan.read_text().replace("samples = 16\nsearch = 16\nsensitivity = 8", "samples = 400\nsearch = 0")
    plan.write_text(text)
    run(plan, out)
    words = ["campaign", str(plan), "--out", str(out), "--json", str(tmp_path / "c.json"), "--report"]
    assert main([*words, str(tmp_path / "c.html")]) == 0, "the interval's upper end is within what is allowed"
    (g,) = json.loads((tmp_path / "c.json").read_text())["groups"]
    assert g["low"] <= p <= g["high"] < 0.01 and g["same"] and g["failed"] <= 1
    assert p / 10.0 < g["rare"]["probability"] < 10.0 * p and g["rare"]["runs"] < 4000
    assert g["rare"]["worst"] and g["worst"][0] > 0.1 - 0.2 * p, "a machine that fails was found, and it reproduces"
    assert "Subset simulation: failure probability" in (tmp_path / "c.html").read_text()


@pytest.mark.slow
def test_a_controller_that_crashes_is_a_failed_machine_and_not_the_end(tmp_path: Path) -> None:
    gcc = shutil.which("gcc")
    if gcc is None:
        pytest.skip("no C compiler")
    wrong(gcc, tmp_path, "abort();", "")
    more = '[[firmware]]\nname = "shipped"\n[[firmware]]\nname = "mine"\ncontroller = "wrong.so"\n'
    plan = write(tmp_path, 1.0, more)
    text = plan.read_text().replace("samples = 16\nsearch = 16\nsensitivity = 8", "samples = 4\nsearch = 0")
    plan.write_text(text)
    (tmp_path / "still.toml").write_text(
        (tmp_path / "still.toml").read_text().replace("duration = 0.4", "duration = 0.6")
    )
    run_out = tmp_path / "run"
    read, quantities, folder = campaign.begin(plan, run_out, 3600.0)
    campaign.take_samples(read, quantities, folder)
    work(folder.path, trust=folder.job["machine"])
    view = campaign.judge(read, quantities, folder, lambda fraction: None)
    ours, theirs = view.groups
    assert (ours.failed, theirs.failed) == (0, 4) and view.passed(ours) and not view.passed(theirs)
    assert theirs.same and "--controller" in theirs.command and "abort" in theirs.seen[0]
    assert len(theirs.failures) == 4 and theirs.reproduces and "--controller" in theirs.failures[0].command


@pytest.mark.slow
@pytest.mark.parametrize("name", ["model", "plant", "command"])
def test_a_scenario_may_be_called_as_a_file_that_is_saved_beside_it(name: str, tmp_path: Path) -> None:
    plan = write(tmp_path, keys="saved = 1", name=name)
    text = plan.read_text().replace("samples = 16\nsearch = 16\nsensitivity = 8", "samples = 8\nsearch = 0")
    shutil.copy(ROOT / "tables" / "plant.toml", tmp_path / "machine.toml")
    plan.write_text(f'plant = "machine.toml"\n{text}')
    read, quantities, folder = campaign.begin(plan, tmp_path / "run", 3600.0)
    assert campaign.take_samples(read, quantities, folder) == 8
    work(folder.path)
    (g,) = campaign.judge(read, quantities, folder, lambda fraction: None).groups
    assert g.name == f"{name}.shipped.shipped" and g.failed > 0
    assert g.same and all(f.same for f in g.failures) and g.failures


@pytest.mark.slow
def test_calibrations_and_firmwares_of_one_s_own_and_a_kill_within_a_trial(tmp_path: Path) -> None:
    """A second calibration acts, a controller that works passes, and what a kill leaves is gone on with."""
    if shutil.which("gcc") is None or shutil.which("make") is None:
        pytest.skip("no C compiler, or no make")
    assert main(["new-controller", str(tmp_path / "mine"), "--quiet"]) == 0
    subprocess.run(["make", "-s"], cwd=tmp_path / "mine", check=True)
    shutil.copytree(ROOT / "tables", tmp_path / "soft")
    calibration = tmp_path / "soft" / "calibration.toml"
    text = calibration.read_text()
    calibration.write_text(text.replace("kp = { value = 16.0,", "kp = { value = 8.0,"))
    assert calibration.read_text() != text
    more = '[[calibration]]\nname = "soft"\ntables = "soft"\n'
    more += '[[firmware]]\nname = "shipped"\n[[firmware]]\nname = "mine"\ncontroller = "mine/my_controller.so"\n'
    plan = write(tmp_path, 60.0, more)  # wide: what is held here is which files act
    plan.write_text(plan.read_text().replace("samples = 16\nsearch = 16\nsensitivity = 8", "samples = 4\nsearch = 0"))
    read, quantities, folder = campaign.begin(plan, tmp_path / "run", 3600.0)
    assert campaign.take_samples(read, quantities, folder) == 8
    script = "import sys; from vaneloop.fleet.worker import work; work(sys.argv[1], trust=sys.argv[2])"
    env = {**os.environ, "VANELOOP_FLEET_KILL": "begin:3"}
    words = [sys.executable, "-c", script, str(folder.path), folder.job["machine"]]
    killed = subprocess.run(words, env=env, cwd=ROOT, check=False)
    assert killed.returncode == -signal.SIGKILL
    assert work(folder.path, trust=folder.job["machine"]) == {"done": 6}, "two were done, the third is done again"
    view = campaign.judge(read, quantities, folder, lambda fraction: None)
    assert [g.name for g in view.groups] == ["still.soft.shipped", "still.soft.mine"]
    for g in view.groups:
        assert (g.trials, g.failed, g.lost) == (4, 0, 0) and g.same and view.passed(g), (g.name, g.seen)
        assert "--tables" in g.command and ("--controller" in g.command) == (g.firmware == "mine")
    words = view.groups[0].command.split()
    for without, same in (([], True), (words[words.index("--tables") :][:2], False)):  # the calibration acts
        again = [w for w in words[1:] if w not in without]
        assert main([*again, "--json", str(tmp_path / "again.json"), "--quiet"]) == 0
        (o,) = json.loads((tmp_path / "again.json").read_text())["scenarios"]
        assert (o["state_hash"] == view.groups[0].state_hash) == same
    page = campaign_page(view, "").html()
    assert "no search was made" in page


# ---- plans -----------------------------------------------------------------------------------------------------------

BAD = [  # what is put in place of what, and what the line names
    ('"sensors.vigv_bias" = "tolerance"', '"sensors.vigv_bais" = "tolerance"', "did you mean sensors.vigv_bias?"),
    ('"sensors.vigv_bias" = "tolerance"', '"actuator.stroke" = "tolerance"', "actuator.stroke"),
    ("[1.1, 1.3]", "[1.3, 1.1]", "must be below high"),
    ("[1.1, 1.3]", "[0.001, 1.3]", "engine.lag (=0.001 s) must be in"),
    ("samples = 16", "samples = 17", "power of two"),
    ("samples = 16\nsearch = 16\nsensitivity = 8", "samples = 4", "must be at least 5 where a search"),
    ("still.toml", "stil.toml", "stil.toml: no such file"),
    ("search = 16", "serach = 16", "serach"),
]


@pytest.mark.parametrize(("old", "new", "named"), BAD, ids=[n for _, n, _ in BAD])
def test_a_wrong_plan_is_one_line(tmp_path: Path, old: str, new: str, named: str) -> None:
    plan = write(tmp_path)
    plan.write_text(plan.read_text().replace(old, new))
    with pytest.raises(InputError) as e:
        campaign.begin(plan, tmp_path / "run", 3600.0)
    assert named in str(e.value) and "\n" not in str(e.value) and not (tmp_path / "run").exists()


def test_a_draw_is_the_same_every_time_and_the_groups_are_the_product(tmp_path: Path) -> None:
    more = '[[calibration]]\nname = "a"\n[[calibration]]\nname = "b"\n[[firmware]]\nname = "x"\n'
    plan = load_plan(write(tmp_path, more=more))
    (a, b), (c, d) = draw(plan, 2), draw(plan, 2)
    assert np.array_equal(a, c) and np.array_equal(b, d) and a.shape == (16, 2) and b.shape == (8, 2)
    assert [g.name for g in groups(plan)] == ["still.a.x", "still.b.x"]


def test_the_plan_of_the_documentation_is_the_example_and_names_files_that_are_there() -> None:
    text = (ROOT / "docs" / "campaigns.md").read_text(encoding="utf-8")
    plan = ROOT / "examples" / "campaign" / "plan.toml"
    assert plan.read_text(encoding="utf-8") == text.split("```toml\n")[1].split("```")[0]
    assert (plan.parent / "angle.toml").is_file()
