"""Very many closed loops: figures without logs, on a GPU or not. Numba's simulator stands in for the GPU."""

from __future__ import annotations

import fcntl
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from controller import load_calibration
from hil import inject
from hil.inject import Scenario
from hil.inject.heard import Heard, hear
from hil.inject.in_lanes import WATCHED, margins_in_lanes, margins_on_gpu
from hil.inject.margin import Margin, margins
from hil.loop import cuda, engines
from hil.loop.engines import Engines, Unfinished, lockstep_engines
from hil.loop.heard_lanes import H_FRESH, H_P_S, H_SOURCE, N_HEARD, depth, stretches
from hil.loop.lockstep import Stimulus, lockstep
from plant import Model, Plant, build_plant
from vaneloop.base import extras
from vaneloop.base.errors import DeviceError, InputError
from vaneloop.fleet import campaign, together
from vaneloop.fleet.plan import files_of_plan, groups, load_plan, varied
from vaneloop.fleet.together import no_gpu
from vaneloop.fleet.worker import work
from vaneloop.pages.campaign import campaign_page

HERE = Path(__file__).resolve().parent.parent
# one by one on the processor, by the loop that the program compiles ahead
ALONE = load_calibration(strategy="inverse")
RISE = Stimulus.of(np.linspace(60.0, 61.0, 3))


def plants() -> list[Plant]:
    """A machine as built, and one with effects in its drive and its linkage."""
    base = build_plant()
    effects = {"valve_null_bias": {"bias": 1.0}, "aero_load": {"force": 500.0}, "linkage_friction": {"vigv": 0.2}}
    return [base, Model(effects=effects).plant(base)]


def figures(run: Engines) -> dict[str, list[float]]:
    """The numbers of an answer, for JSON."""
    names = ("servo_error", "angle_error", "stroke", "angles", "in_mode")
    return {name: getattr(run, name).tolist() for name in names}


def test_an_unknown_device_is_one_line():
    with pytest.raises(InputError, match="device .='gpu'. must be one of auto, cpu, cuda"):
        lockstep_engines(RISE, [build_plant()], device="gpu")


def test_without_numba_cuda_a_line_names_the_extra_and_auto_goes_on(monkeypatch):
    monkeypatch.setattr(extras, "is_there", lambda module: False)
    cuda.kernel.cache_clear()
    with pytest.raises(InputError, match=r"needs numba-cuda, which is not installed: pip install 'vaneloop\[gpu\]'"):
        lockstep_engines(RISE, [build_plant()], calibrations=ALONE, device="cuda")
    run = lockstep_engines(RISE, [build_plant()], calibrations=ALONE, device="auto")
    assert run.ran.all() and run.devices == ["cpu"] and "numba-cuda" in run.notes[0]


def test_figures_are_those_of_the_log():
    run = lockstep_engines(RISE, [build_plant()], calibrations=ALONE, seed=3, device="cpu")
    log = lockstep(RISE, calibration=ALONE, plant=build_plant(), seed=3).columns
    assert run.servo_error[0] == np.abs(log["x_dem"] - log["x_lvdt"]).max()
    assert run.stroke[0] == log["x_lvdt"][-1] and run.angles[0, 0] == log["vigv"][-1]
    assert run.in_mode[0].sum() == pytest.approx(0.03)


class Failing:
    """A GPU that runs one chunk and then fails."""

    name = "a GPU"

    def room(self, *_: object) -> int:
        return 1


@pytest.mark.parametrize("device", ["cuda", "auto"])
def test_a_gpu_that_fails_half_way_loses_nothing_that_was_finished(monkeypatch, device):
    done = []

    def on_gpu(kernel, work, some):
        if done:
            raise RuntimeError("out of order")
        done.append(some)
        work.out.stroke[some] = 7.0
        work.ran_on(kernel.name, some)

    monkeypatch.setattr(engines, "_on_gpu", on_gpu)
    monkeypatch.setattr(cuda, "kernel", Failing)
    monkeypatch.setattr(engines, "_on_processor", lambda work, some: work.ran_on("cpu", some))
    three = [build_plant()] * 3
    if device == "cuda":
        with pytest.raises(Unfinished, match="out of order; 1 of 3 engines are finished") as e:
            lockstep_engines(RISE, three, device=device)
        assert e.value.engines.ran.tolist() == [True, False, False] and e.value.engines.stroke[0] == 7.0
    else:
        run = lockstep_engines(RISE, three, device=device)
        assert run.on.tolist() == [0, 1, 1] and run.stroke[0] == 7.0 and "out of order" in run.notes[0]


def simulated() -> None:
    """In a child: the kernel, interpreted by numba's simulator."""
    cals = [load_calibration(), load_calibration(strategy="single")]
    for given in (cals[0], cals):  # scalars as arguments of the kernel, and as records
        print(json.dumps(figures(lockstep_engines(RISE, plants(), calibrations=given, seed=1, device="cuda"))))


def in_simulator(function: str) -> list[Any]:
    """What a function of this file prints in a process in which numba's simulator stands in for a GPU."""
    if not extras.is_there("numba_cuda"):
        pytest.skip("the extra gpu is not installed: the kernel has no simulator to run in")
    code = f"from tests.test_gpu import {function}; {function}()"
    env = {**os.environ, "NUMBA_ENABLE_CUDASIM": "1"}
    done = subprocess.run([sys.executable, "-c", code], cwd=HERE, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


@pytest.mark.slow
def test_the_kernel_gives_what_the_loop_gives():
    told_all = in_simulator("simulated")
    for told, strategies in zip(told_all, (("dual", "dual"), ("dual", "single")), strict=True):
        for i, (plant, strategy) in enumerate(zip(plants(), strategies, strict=True)):
            log = lockstep(RISE, calibration=load_calibration(strategy=strategy), plant=plant, seed=1).columns
            assert told["stroke"][i] == log["x_lvdt"][-1]
            assert told["servo_error"][i] == pytest.approx(np.abs(log["x_dem"] - log["x_lvdt"]).max(), rel=1e-9)
            targets = np.rad2deg(plant.schedules.targets(log["n_r"]))
            for q, vane in enumerate(plant.vanes):
                assert told["angles"][i][q] == pytest.approx(log[vane][-1], rel=1e-9)
                assert told["angle_error"][i][q] == pytest.approx(np.abs(log[vane] - targets[:, q]).max(), rel=1e-9)
            assert told["in_mode"][i] == pytest.approx(0.01 * np.bincount(log["state"].astype(int), minlength=5))


# ---- scenarios -------------------------------------------------------------------------------------------------------

# frames late, refused, twice and with other bits; oil, sensor and tables that change, one of them within 10 ms, two at
# once; claims of every kind
ACTIONS = [
    {"action": "delay", "delay": 0.01, "jitter": 0.03, "start": 0.05, "duration": 0.1},
    {"action": "override", "signals": {"n_r": 71.5}, "every": 2, "start": 0.1},
    {"action": "corrupt", "bits": 1, "probability": 0.2},
    {"action": "replay", "frame": "ECU_DEMAND", "begin": 0.05, "length": 0.05, "start": 0.2, "duration": 0.05},
    {"action": "machine", "p_s": 0.0, "start": 0.123, "duration": 0.02},
    {"action": "machine", "effect": "lvdt_bias", "parameters": {"bias": 1.5}, "start": 0.153, "duration": 0.047},
    {"action": "machine", "effect": "schedule_error", "parameters": {"offset": 1.0}, "start": 0.2},
    {"action": "machine", "effect": "aero_load", "parameters": {"force": 2000.0}, "start": 0.0},
]
CLAIMS = [
    {"mode": "RUN", "at": 0.05, "tolerance": 0.1},
    {"mode": "RUN", "during": [0.2, 0.29]},
    {"mode": "DEGRADED", "never": True},
    {"fault": "any", "never": True, "during": [0.1, 0.2]},
    {"fault": "demand_rejected", "by": 0.2},
    {"signal": "vigv", "low": -20.0, "high": 30.0, "during": [0.2, 0.25]},
    {"signal": "vgv2", "low": 5.0, "by": 0.3, "after": 0.1},
    {"signal": "x_lvdt", "low": 2.0, "high": 12.0, "never": False, "during": [0.1, 0.3]},
    {"signal": "n_r", "low": 61.0, "high": 80.0, "by": 0.2},
    {"signal": "i_cmd", "low": -30.0, "high": 30.0, "during": [0.05, 0.2]},
    {"count": "good", "low": 3, "by": 0.2},
]
DAY = Scenario.model_validate({
    "title": "Some of everything", "duration": 0.3, "seed": 3, "demand": [[0.0, 60.0], [0.1, 60.0], [0.3, 70.0]],
    "inject": ACTIONS, "expect": CLAIMS,
})  # fmt: skip


def heard(scenario: Scenario) -> Heard:
    """What a controller hears of a scenario."""
    found = hear(scenario, build_plant())
    assert isinstance(found, Heard)
    return found


def on_gpu(scenario: Scenario, given: list[Plant]) -> list[list[Margin]]:
    """Margins of machines that ran on the GPU."""
    found = margins_on_gpu(cuda.kernel(WATCHED), scenario, given, load_calibration(), heard(scenario))
    return [one for some, of in found for _, one in zip(some, of, strict=True)]


def assert_same(one: list[Margin], other: list[Margin]) -> None:
    """The same verdicts, and margins within 1e-9 of their value."""
    assert [(m.expected, m.held, m.unit) for m in one] == [(m.expected, m.held, m.unit) for m in other]
    of = [np.array([(m.value, m.share) for m in some]) for some in (one, other)]
    np.testing.assert_allclose(*of, rtol=1e-9, atol=1e-12)


def simulated_day() -> None:
    """In a child: margins of a scenario, from the kernel that numba's simulator interprets."""
    for one in on_gpu(DAY, plants()):
        print(json.dumps([[m.expected, m.held, m.value, m.unit, m.share] for m in one]))


@pytest.mark.slow
def test_a_scenario_in_the_kernel_is_that_in_lanes_and_on_the_bus():
    lanes = margins_in_lanes(DAY, plants(), load_calibration(), heard(DAY))
    held = set()
    for plant, mine, told in zip(plants(), lanes, in_simulator("simulated_day"), strict=True):
        found = [Margin(*row) for row in told]
        assert_same(found, mine)
        assert_same(found, margins(DAY, inject.run(DAY, plant=plant)))
        held |= {m.held for m in found}
    assert held == {True, False}


def test_a_stretch_ends_where_something_new_is_heard():
    rows = np.zeros((25, N_HEARD))
    rows[:, H_SOURCE] = -1.0
    rows[3, H_FRESH], rows[3, H_SOURCE] = 1.0, 0.0
    rows[17:, H_P_S] = 1e6
    assert stretches(rows).tolist() == [3, 2, 1, *range(7, 0, -1), *range(7, 0, -1), 3, 2, 1, *range(5, 0, -1)]
    assert depth(rows) == 1
    rows[23, H_FRESH], rows[23, H_SOURCE] = 1.0, 0.0
    assert depth(rows) == 3, "the third frame of the ECU has been sent when the first one comes"


@pytest.mark.slow
def test_ten_thousand_engines_on_a_gpu_are_those_in_lanes():
    try:
        cuda.check()
    except cuda.unusable() as e:
        pytest.skip(f"no GPU: {cuda.said(e)}")
    given = (plants() * 5_000)[:10_000]
    some = [Model(effects={"lvdt_bias": {"bias": 1e-4 * i}}).plant(plant) for i, plant in enumerate(given)]
    for one, other in zip(on_gpu(DAY, some), margins_in_lanes(DAY, some, load_calibration(), heard(DAY)), strict=True):
        assert_same(one, other)


# ---- campaigns -------------------------------------------------------------------------------------------------------

PLAN = """title = "On a GPU"
scenarios = ["day.toml"]
samples = 8
search = 0
[vary]
"sensors.vigv_bias" = "tolerance"
"valve_null_bias.bias" = [-2.0, 2.0]
"""
STILL = """title = "Nothing moves"
duration = 0.1
expect = [{{ signal = "vigv", high = {high}, during = [0.05, 0.09] }}, {{ mode = "RUN", by = 0.08 }}]
"""


def plan(folder: Path) -> Path:
    """A plan of one short scenario, which holds or not as the potentiometer's bias is."""
    vigv = inject.run(Scenario(title="still", duration=0.1)).trace.signals["vigv"]
    (folder / "day.toml").write_text(STILL.format(high=float(vigv[50:91].max())), encoding="utf-8")
    (folder / "plan.toml").write_text(PLAN, encoding="utf-8")
    return folder / "plan.toml"


def command(file: Path, out: Path, *words: str, **env: str) -> tuple[int, str, dict[str, Any]]:
    """`vaneloop campaign` in a process of its own: exit code, what it said, its JSON."""
    code = "import sys; from vaneloop.cli.main import main; sys.exit(main(sys.argv[1:]))"
    answer = out.with_suffix(".json")
    done = subprocess.run(
        [sys.executable, "-c", code, "campaign", str(file), "--out", str(out), "--json", str(answer), *words],
        cwd=HERE, env={**os.environ, "PYTHONPATH": str(HERE), **env}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    said = json.loads(answer.read_text(encoding="utf-8")) if answer.exists() else {}
    return done.returncode, done.stdout + done.stderr, said


SIMULATED = {"NUMBA_ENABLE_CUDASIM": "1"}


@pytest.mark.slow
def test_a_campaign_on_a_gpu_says_what_it_says_on_the_processor(tmp_path: Path) -> None:
    if not extras.is_there("numba_cuda"):
        pytest.skip("the extra gpu is not installed: the kernel has no simulator to run in")
    file = plan(tmp_path)
    code, said, gpu = command(file, tmp_path / "gpu", "--device", "cuda", **SIMULATED)
    assert code in (0, 1), said
    other, words, cpu = command(file, tmp_path / "cpu", "--device", "cpu")
    assert code == other and "Simulated: 0.8 s on numba's simulator" in said
    assert gpu["simulated_s"] == {"numba's simulator": pytest.approx(0.8)} and gpu["notes"] == cpu["notes"] == []
    assert cpu["simulated_s"] == {"cpu": pytest.approx(0.8)} and "the processor (in lanes)" in words
    (mine,), (theirs,) = gpu["groups"], cpu["groups"]
    assert mine["alone"] == {} and mine["same"] and mine["failed"] == theirs["failed"] and 0 < mine["failed"] < 8
    for one, same in zip(mine["requirements"], theirs["requirements"], strict=True):
        assert (one["expected"], one["broken"], one["trials"]) == (same["expected"], same["broken"], same["trials"])
        for of in ("least", "median"):
            assert one[of] is same[of] is None or one[of] == pytest.approx(same[of], rel=1e-9)
    file.write_text(file.read_text().replace('"day.toml"', '"day.toml", "babbling_idiot"'))
    code, said, _ = command(file, tmp_path / "none", "--device", "cuda", **SIMULATED)
    assert code == 2 and "babbling_idiot.shipped.shipped cannot run on a GPU: when frames come" in said
    assert not (tmp_path / "none").exists() and len(said.splitlines()) == 1


def test_without_a_gpu_cuda_is_one_line_and_a_later_command_goes_on(tmp_path: Path) -> None:
    if not no_gpu():
        pytest.skip("there is a GPU")
    read, quantities, folder = campaign.begin(plan(tmp_path), tmp_path / "run", 3600.0)
    assert campaign.take_samples(read, quantities, folder, 1) == 8 and len(folder.chunks()) == 1
    with pytest.raises(DeviceError, match="^device 'cuda': "):
        work(folder.path, device="cuda")
    assert not folder.finished() and not list((folder.path / "leases").iterdir())
    assert work(folder.path, device="auto") == {"done": 8}
    view = campaign.judge(read, quantities, folder, lambda fraction: None)
    assert view.simulated_s == {"cpu": pytest.approx(0.8)} and len(view.notes) == 1
    assert view.notes[0].startswith("device 'auto': ") and view.notes[0].endswith("lanes ran 8 machines")
    page = campaign_page(view).write(tmp_path / "c.html").read_text(encoding="utf-8")
    assert "Simulated: 0.8 s on the processor (in lanes). device" in page and "lanes ran 8 machines." in page
    with pytest.raises(InputError, match="^device 'cuda': "):
        campaign.has_gpu("cuda", True)
    assert [campaign.has_gpu(*of) for of in (("auto", True), ("cpu", True), ("auto", False))] == [False] * 3
    assert campaign.has_gpu("cuda", False), "workers elsewhere say themselves whether they have one"


class Stopping:
    """A GPU that runs three machines and then fails."""

    name = "a GPU"

    def release(self) -> None:
        raise AssertionError("it is not used any more")


@pytest.mark.parametrize("device", ["cuda", "auto"])
def test_a_gpu_that_fails_amid_a_chunk_leaves_the_rest_to_the_processor_or_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, device: str
) -> None:
    file = load_plan(plan(tmp_path))
    files, (g,) = files_of_plan(file), groups(file)
    quantities = varied(file, build_plant(), "plan")
    points = np.random.default_rng(1).random((5, 2)).tolist()
    alone = together.side_by_side(files, g, quantities, points)

    def some(kernel: Any, scenario: Any, plants: list[Plant], calibration: Any, heard: Any) -> Any:
        yield range(3), margins_in_lanes(scenario, plants[:3], calibration, heard)
        raise RuntimeError("out of order")

    monkeypatch.setattr(together, "_lost", [])
    monkeypatch.setattr(together, "margins_on_gpu", some)
    monkeypatch.setattr(cuda, "kernel", lambda watched: Stopping())
    for first in (True, False):
        if device == "cuda":
            with pytest.raises(DeviceError, match="^device 'cuda': out of order$"):
                together.side_by_side(files, g, quantities, points, device)
            continue
        found = together.side_by_side(files, g, quantities, points, device)
        assert [(r.on, r.note) for r in found if isinstance(r, together.Ran)] == [
            *[("a GPU", "") if first else ("cpu", "device 'auto': out of order")] * 3,
            *[("cpu", "device 'auto': out of order")] * 2,
        ]
        assert [r.margins for r in found if isinstance(r, together.Ran)] == [a.margins for a in alone]  # type: ignore[union-attr]


def test_workers_of_a_computer_take_turns_with_its_gpu(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(together.config, "CACHE_DIR", str(tmp_path / "cache"))
    with together._turn(), open(tmp_path / "cache" / "gpu.lock", "w") as other, pytest.raises(BlockingIOError):
        fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)
    with open(tmp_path / "cache" / "gpu.lock", "w") as other:
        fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)


def test_a_process_compiles_for_the_gpu_before_the_first_trial(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    monkeypatch.setattr(together, "_lost", [])
    monkeypatch.setattr(together, "no_gpu", lambda: asked.append("looked") or "none here")
    together.warm_up_gpu("cpu")
    assert asked == []
    together.warm_up_gpu("auto")
    assert asked == ["looked"] and together._lost == ["none here"]
    with pytest.raises(DeviceError, match="^device 'cuda': none here$"):
        together.warm_up_gpu("cuda")
    monkeypatch.setattr(together, "no_gpu", lambda: "")
    monkeypatch.setattr(together, "_on_gpu", lambda of, plants, device: asked.append((len(plants), device)))
    together.warm_up_gpu("auto")
    assert asked[-1] == (1, "auto")
