"""The numbers of a campaign against closed forms: plan, draw, search, probability, indices. No machine is simulated."""

from __future__ import annotations

import json
import shlex
import tomllib
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import optimize, stats

pytest.importorskip("psutil", reason="the extra `fleet` is not installed")
pytest.importorskip("duckdb", reason="the extra `fleet` is not installed")

from hil.inject.margin import Margin
from plant import Model
from vaneloop.base.errors import InputError
from vaneloop.fleet import campaign, trial
from vaneloop.fleet import plan as plans
from vaneloop.fleet.files import whole_json
from vaneloop.fleet.folder import Folder
from vaneloop.fleet.plan import Choice, Group, Plan, Varied, draw, groups, load_plan, model_of, varied
from vaneloop.pages.campaign import GroupView

Array = Any


@pytest.fixture(autouse=True)
def no_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nobody cuts the power here: nothing waits for the disk."""
    monkeypatch.setattr("vaneloop.fleet.files.os.fsync", lambda number: None)


SCENARIO = 'title = "Nothing moves"\nduration = 0.4\n'
TWO = [Varied("a.x", "deg", -1.0, 3.0, False), Varied("jam.force", "N", 10.0, 20.0, True)]


def plan_of(**keys: Any) -> Plan:
    return Plan(**{"title": "Made", "scenarios": ["still"], "vary": {"a.x": [0.0, 1.0]}, **keys})


# ---- plans -----------------------------------------------------------------------------------------------------------


def test_a_plan_without_more_is_that_of_the_documentation() -> None:
    p = plan_of()
    said = (p.samples, p.sampling, p.search, p.sensitivity, p.confidence, p.allowed, p.seed, p.model, p.plant)
    assert said == (64, "sobol", 40, 0, 0.95, None, 1, None, None)
    assert p.calibration == p.firmware == [Choice(name="shipped")]


@pytest.mark.parametrize(
    ("keys", "allowed"),
    [
        ({"samples": 4, "search": 0}, True),
        ({"samples": 2, "search": 0}, False),
        ({"samples": 65536}, True),
        ({"samples": 100_000, "sampling": "random"}, True),
        ({"samples": 100_001, "sampling": "random"}, False),
        ({"samples": 4, "search": 1}, False),
        ({"samples": 5, "search": 1, "sampling": "random"}, True),
        ({"samples": 4, "search": 1, "sampling": "random"}, False),
        ({"samples": 5, "search": 0, "sampling": "sobol"}, False),
        ({"search": 10_000}, True),
        ({"search": 10_001}, False),
        ({"search": -1}, False),
        ({"samples": 8, "sensitivity": 8}, True),
        ({"samples": 8, "sensitivity": 16}, False),
        ({"samples": 8, "sensitivity": 6}, False),
        ({"samples": 8, "sensitivity": 6, "sampling": "random"}, True),
        ({"samples": 100_000, "sensitivity": 10_000, "sampling": "random"}, True),
        ({"samples": 100_000, "sensitivity": 10_001, "sampling": "random"}, False),
        ({"confidence": 0.5}, False),
        ({"confidence": 0.501}, True),
        ({"confidence": 1.0}, False),
        ({"allowed": 0.0}, False),
        ({"allowed": 1.0}, False),
        ({"samples": 250, "sampling": "subset"}, True),
        ({"samples": 249, "sampling": "subset"}, False),
        ({"samples": 10_000, "sampling": "subset"}, True),
        ({"samples": 10_001, "sampling": "subset"}, False),
        ({"saved": 0}, True),
        ({"saved": 1000}, True),
        ({"saved": 1001}, False),
        ({"seed": 0}, True),
        ({"seed": -1}, False),
        ({"title": "abc"}, False),
        ({"title": "abcd"}, True),
        ({"scenarios": []}, False),
        ({"scenarios": ["a/still.toml", "b/still"]}, False),
        ({"scenarios": ["a/still.toml", "b/stills"]}, True),
        ({"scenarios": ["it's"]}, False),
        ({"vary": {}}, False),
        ({"vary": {"a": [1.0]}}, False),
        ({"vary": {"a": [1.0, 2.0, 3.0]}}, False),
        ({"vary": {f"{k}": [0.0, 1.0] for k in range(100)}}, True),
        ({"vary": {f"{k}": [0.0, 1.0] for k in range(101)}}, False),
        ({"calibration": []}, False),
        ({"firmware": []}, False),
        ({"calibration": [{"name": "a"}, {"name": "b", "tables": "T"}]}, True),
        ({"calibration": [{"name": "a"}, {"name": "a"}]}, False),
        ({"calibration": [{"name": "a", "controller": "x.so"}]}, False),
        ({"firmware": [{"name": "a", "controller": "x.so"}]}, True),
        ({"firmware": [{"name": "a", "tables": "T"}]}, False),
        ({"firmware": [{"name": "a b"}]}, False),
        ({"firmware": [{"name": "x" * 60}]}, True),
        ({"firmware": [{"name": "x" * 61}]}, False),
    ],
)
def test_a_plan_s_limits_are_exact(keys: dict[str, Any], allowed: bool) -> None:
    if allowed:
        plan_of(**keys)
    else:
        with pytest.raises(ValueError, match="validation error"):
            plan_of(**keys)


@pytest.mark.parametrize(("more", "allowed"), [(0, True), (1, False)])
def test_a_plan_asks_for_a_million_trials_at_most(more: int, allowed: bool) -> None:
    """Two scenarios, two calibrations, two firmwares, each 65,000 samples and 20,000 points times (2 + 1)."""
    keys = {
        "scenarios": ["a", "b"], "samples": 65_000 + more, "sensitivity": 10_000, "sampling": "random",
        "calibration": [{"name": "a"}, {"name": "b"}], "firmware": [{"name": "a"}, {"name": "b"}],
        "vary": {f"{k}": [0.0, 1.0] for k in range(5)},
    }  # fmt: skip
    assert plans.MOST == 8 * (65_000 + 10_000 * 6)
    if allowed:
        plan_of(**keys)
    else:
        with pytest.raises(ValueError, match="asks for 1,000,008 trials; allowed: 1,000,000"):
            plan_of(**keys)


def test_a_plan_s_files_stand_beside_it(tmp_path: Path) -> None:
    (tmp_path / "my.toml").write_text(SCENARIO)
    (tmp_path / "p.toml").write_text("x")
    file = tmp_path / "plan.toml"
    file.write_text(
        'title = "Made"\nscenarios = ["my.toml", "demand_stops"]\nmodel = "m.toml"\nplant = "p.toml"\n'
        '[vary]\n"a.x" = [0, 1]\n[[calibration]]\nname = "soft"\ntables = "S"\n[[calibration]]\nname = "hard"\n'
        '[[firmware]]\nname = "mine"\ncontroller = "c.so"\n[[firmware]]\nname = "shipped"\n'
    )
    p = load_plan(file)
    assert p.scenarios == [str(tmp_path / "my.toml"), "demand_stops"]
    assert (p.model, p.plant) == (str(tmp_path / "m.toml"), str(tmp_path / "p.toml"))
    assert [c.tables for c in p.calibration] == [str(tmp_path / "S"), None]
    assert [c.controller for c in p.firmware] == [str(tmp_path / "c.so"), None]
    files = plans.files_of_plan(p)
    assert files.pop("scenario.demand_stops").endswith("demand_stops.toml")
    assert files == {
        "scenario.my": str(tmp_path / "my.toml"), "tables.soft": str(tmp_path / "S"),
        "firmware.mine": str(tmp_path / "c.so"), "model": str(tmp_path / "m.toml"), "plant": str(tmp_path / "p.toml"),
    }  # fmt: skip
    assert plans.scenario_of(files, Group("my", "soft", "mine")).title == "Nothing moves"
    (tmp_path / "p.toml").unlink()
    (tmp_path / "demand_stops").write_text(SCENARIO)
    p = load_plan(file)
    assert p.plant == "p.toml" and p.scenarios[1] == str(tmp_path / "demand_stops"), "a file comes before a shipped one"
    file.write_text('title = "Made"\nscenarios = ["my.toml"]\n[vary]\n"a.x" = [0, 1]\n')
    p = load_plan(file)
    assert (p.model, p.plant) == (None, None) and plans.files_of_plan(p).keys() == {"scenario.my"}


@pytest.mark.parametrize(
    ("by", "why"),
    [
        ('"my: RUN"', ""),
        ('"my"', ""),
        ('" my : by 0.300 s "', ""),
        ('"my: STANDBY"', r"requirement 'R-1': no claim of 'my' has the words 'STANDBY'; its claims: RUN by 0\.300 s"),
        ('"mine"', r"requirement 'R-1': verified_by 'mine' must be one of the scenarios \['my'\]"),
        ("", r"requirement\.0\.verified_by"),
        ('"my"\n]\n[[requirement]]\nid = "R-1"\ntext = "Some text"\nverified_by = ["my"', r"its ids .* must differ"),
        (
            '"my"\n]\n[[requirement]]\nid = "R 2"\ntext = "Some text"\nverified_by = ["my"',
            r"requirement\.1\.id \(='R 2'\)",
        ),
    ],
)
def test_a_requirement_is_verified_by_claims_of_the_plan_s_scenarios(tmp_path: Path, by: str, why: str) -> None:
    (tmp_path / "my.toml").write_text(f'{SCENARIO}[[expect]]\nmode = "RUN"\nby = 0.3\nbecause = "it starts"\n')
    (tmp_path / "plan.toml").write_text(
        'title = "Made"\nscenarios = ["my.toml"]\n[vary]\n"a.x" = [0, 1]\n'
        f'[[requirement]]\nid = "R-1"\ntext = "Some text"\nverified_by = [{by}]\n'
    )
    if not why:
        (asked,) = load_plan(tmp_path / "plan.toml").requirement
        assert asked.takes("my", "RUN by 0.300 s") and not asked.takes("other", "RUN by 0.300 s")
        return
    with pytest.raises(InputError, match=why):
        load_plan(tmp_path / "plan.toml")


@pytest.mark.parametrize(("source", "allowed"), [('log = "old.log"', False), ("begin = 0.1\nlength = 0.1", True)])
def test_a_scenario_that_replays_a_file_is_refused(tmp_path: Path, source: str, allowed: bool) -> None:
    (tmp_path / "old.log").write_text("(0.0) can0 100#00\n")
    (tmp_path / "my.toml").write_text(
        f'{SCENARIO}[[inject]]\naction = "replay"\n{source}\nstart = 0.3\nduration = 0.05\n'
    )
    (tmp_path / "plan.toml").write_text('title = "Made"\nscenarios = ["my.toml"]\n[vary]\n"a.x" = [0, 1]\n')
    if allowed:
        load_plan(tmp_path / "plan.toml")
    else:
        with pytest.raises(InputError, match=r"plan\.toml: scenarios: 'my' replays a log file"):
            load_plan(tmp_path / "plan.toml")


def test_groups_are_every_scenario_with_every_calibration_and_firmware() -> None:
    p = plan_of(scenarios=["x/a.toml", "b"], calibration=[{"name": "c"}, {"name": "d"}], firmware=[{"name": "f"}])
    assert [g.name for g in groups(p)] == ["a.c.f", "a.d.f", "b.c.f", "b.d.f"]


def test_a_group_has_the_machine_of_its_files(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plans, "Machine", lambda *of: of)
    files = {"tables.c": "T", "model": "m", "plant": "p", "firmware.f": "so", "tables.d": "other"}
    assert plans.group_machine(files, Group("s", "c", "f")) == ("T", "m", None, "p", "so")
    made = Model()
    assert plans.group_machine(files, Group("s", "x", "y"), made) == (None, made, None, "p", None)


PLANT: Any = SimpleNamespace(
    kind="hydraulic",
    nominal=[
        SimpleNamespace(name="a.x", unit="deg", value=2.0, tolerance=0.5),
        SimpleNamespace(name="a.exact", unit="mm", value=1.0, tolerance=0.0),
    ],
    parameters_of=lambda e: {"force": SimpleNamespace(name="force", unit="N")},
)
EFFECTS = {"jam": SimpleNamespace(kinds=("hydraulic",)), "burn": SimpleNamespace(kinds=("electric",))}


def test_what_is_varied_has_its_table_s_tolerance_or_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plans, "EFFECTS", EFFECTS)
    p = plan_of(vary={"a.x": "tolerance", "a.exact": [0.5, 3.0], "jam.force": [10.0, 20.0]})
    assert varied(p, PLANT, "p") == [
        Varied("a.x", "deg", 1.5, 2.5, False), Varied("a.exact", "mm", 0.5, 3.0, False),
        Varied("jam.force", "N", 10.0, 20.0, True)]  # fmt: skip
    assert plans.as_options(p, TWO) == {"vary": [asdict(q) for q in TWO], "seed": 1}


@pytest.mark.parametrize(
    ("vary", "says"),
    [
        ({"a.exact": "tolerance"}, "'a.exact' has no tolerance in its table; give its limits [low, high] in mm"),
        ({"jam.force": "tolerance"}, "'jam.force' is an effect's parameter; give its limits [low, high] in N"),
        ({"burn.force": [0.0, 1.0]}, "'burn.force' is unknown"),
        (
            {"a.y": [0.0, 1.0]},
            "'a.y' is unknown (did you mean a.x?); allowed: a nominal parameter, or EFFECT.parameter",
        ),
        ({"a.x": [1.0, 1.0]}, "'a.x': low (=1) must be below high (=1)"),
        ({"jam.force": [2.0, 1.0]}, "'jam.force': low (=2) must be below high (=1)"),
    ],
)
def test_what_the_machine_does_not_have_is_refused(
    monkeypatch: pytest.MonkeyPatch, vary: dict[str, Any], says: str
) -> None:
    monkeypatch.setattr(plans, "EFFECTS", EFFECTS)
    with pytest.raises(InputError) as e:
        varied(plan_of(vary=vary), PLANT, "p.toml")
    assert str(e.value).startswith(f"p.toml: vary: {says}")


def test_a_trial_s_model_is_the_plan_s_own_with_its_values_in_it() -> None:
    base = Model(
        parameters={"a.x": 9.0, "a.y": 8.0}, effects={"jam": {"speed": 1.0}, "dip": {"depth": 2.0}}, meta={"k": 1}
    )
    made = model_of(TWO, [0.5, 12.0], base)
    assert made.parameters == {"a.x": 0.5, "a.y": 8.0} and made.meta == {"k": 1}
    assert made.effects == {"jam": {"speed": 1.0, "force": 12.0}, "dip": {"depth": 2.0}}
    assert base.parameters["a.x"] == 9.0 and base.effects["jam"] == {"speed": 1.0}, "the plan's own stays as it is"
    alone = model_of([*TWO, Varied("jam.of.two", "", 0.0, 1.0, True)], [0.5, 12.0, 1.0])
    assert alone.parameters == {"a.x": 0.5} and alone.effects == {"jam": {"force": 12.0, "of.two": 1.0}}
    with pytest.raises(ValueError, match="shorter"):
        model_of(TWO, [0.5])


def test_a_point_of_the_unit_cube_lies_between_the_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    g = Group("s", "c", "f")
    assert trial.model_at({}, g, TWO, [0.25, 0.5]).parameters == {"a.x": 0.0}
    assert trial.model_at({}, g, TWO, [1.0, 0.5]).effects == {"jam": {"force": 15.0}}
    assert plans.values_at(TWO, [0.25, 0.5]) == [0.0, 15.0]
    monkeypatch.setattr(trial, "group_machine", lambda files, g, model: SimpleNamespace(plant=("plant", model)))
    monkeypatch.setattr(
        plans,
        "load_model",
        lambda file, plant: Model(parameters={"from": 1.0}) if plant == ("plant", Model()) and file == "m" else None,
    )
    assert trial.model_at({"model": "m"}, g, TWO[:1], [0.0]).parameters == {"from": 1.0, "a.x": -1.0}


# ---- the draw --------------------------------------------------------------------------------------------------------


def test_a_sobol_draw_has_one_point_in_each_part_of_every_quantity() -> None:
    a, b = draw(plan_of(samples=64, sensitivity=16), 3)
    assert a.shape == (64, 3) and b.shape == (16, 3)
    for column in a.T:
        assert sorted((column * 64).astype(int)) == list(range(64))
    for column in b.T:
        assert sorted((column * 16).astype(int)) == list(range(16)), "the first of a sequence are one too"


def test_an_independent_draw_is_as_uneven_as_chance() -> None:
    p = plan_of(samples=300, sensitivity=7, sampling="random", seed=5)
    a, b = draw(p, 2)
    assert a.shape == (300, 2) and b.shape == (7, 2) and a.min() >= 0.0 and a.max() < 1.0
    assert all(stats.kstest(column, "uniform").pvalue > 0.01 for column in a.T)
    assert len(set((a[:, 0] * 300).astype(int))) < 250, "one in each part would be no chance"
    both = np.random.default_rng(5).random((300, 4))
    assert np.array_equal(a, both[:, :2]) and np.array_equal(b, both[:7, 2:])


@pytest.mark.parametrize("sampling", ["sobol", "random"])
def test_another_seed_is_another_draw(sampling: str) -> None:
    one, same, other = (draw(plan_of(samples=16, sampling=sampling, seed=s), 2)[0] for s in (1, 1, 2))
    assert np.array_equal(one, same) and not np.array_equal(one, other)


# ---- margins of a trial ----------------------------------------------------------------------------------------------


def claim(expected: str, share: float | None, held: bool | None = None, **more: Any) -> dict[str, Any]:
    held = share is None or share >= 0.0 if held is None else held
    return {"expected": expected, "held": held, "value": share, "unit": "deg", "share": share} | more


def test_claims_that_guide_are_those_that_a_tolerance_moves() -> None:
    one = {"margins": [claim("a", 0.5), claim("b", 0.1), claim("c", None), claim("d", 0.3)]}
    two = {"margins": [claim("a", 0.5), claim("b", 0.2), claim("c", None), claim("d", 0.4)]}
    assert trial.moving([one, two]) == ["b", "d"] and trial.moving([one, one]) == ["a", "b", "d"] == trial.moving([one])
    assert trial.moving([]) == [] == trial.moving([{"margins": [claim("c", None)]}])


def test_the_least_margin_is_that_of_claims_that_guide_and_of_all_that_are_broken() -> None:
    said = {"margins": [claim("a", 0.2), claim("b", 0.4), claim("c", None, False), claim("d", 0.6)]}
    assert trial.worst_share(said, ["b", "d"]) == 0.4 and trial.worst_share(said, ["d"]) == 0.6
    assert trial.worst_share(said, []) == 1.0 == trial.worst_share(said, ["c"])
    assert trial.worst_share({"margins": [claim("a", -0.2), claim("b", 0.4)]}, ["b"]) == -0.2


# ---- one trial -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("own", [False, True])
@pytest.mark.parametrize("known", [False, True])
def test_a_trial_runs_its_scenario_and_a_firmware_of_one_s_own_is_judged_as_any(
    monkeypatch: pytest.MonkeyPatch, own: bool, known: bool
) -> None:
    machine = SimpleNamespace(plant="P", calibration="K", controller="c.so" if own else None)
    reactions = SimpleNamespace(reactions={"s": 1} if known else {})
    checks = [
        SimpleNamespace(seen="x", held=True),
        SimpleNamespace(seen="y", held=False),
        SimpleNamespace(seen="z", held=None),
    ]
    outcome = SimpleNamespace(held=False, state_hash="h", checks=checks)
    asked: list[Any] = []
    monkeypatch.setattr(
        trial, "group_machine", lambda files, g, model: machine if model.parameters == {"a.x": 1.0} else None
    )
    monkeypatch.setattr(trial, "scenario_of", lambda files, g: "scenario")
    monkeypatch.setattr(trial, "load_reactions", lambda source: reactions)
    monkeypatch.setattr(trial, "expected_of_any", lambda name, scenario, table: f"any {name} {scenario}")
    monkeypatch.setattr(trial, "run", lambda scenario, **more: asked.append((scenario, more)) or outcome)
    found = [SimpleNamespace(expected="e", held=True, value=np.nan, unit="", share=np.nan),
             SimpleNamespace(expected="f", held=False, value=-2.0, unit="mm", share=-0.5)]  # fmt: skip
    monkeypatch.setattr(trial, "margins", lambda scenario, outcome: asked.append(scenario) or found)
    answer = trial.trial_once({}, Group("s", "c", "f"), TWO[:1], np.array([0.5]))
    (scenario, more), judged = asked
    assert scenario == "scenario" and judged == ("any s scenario" if own and known else "scenario")
    assert more == {"plant": "P", "calibration": "K", "name": "s", "reactions": reactions if own else None}
    assert answer == {
        "point": [0.5], "held": False, "state_hash": "h", "seen": ["y"],
        "margins": [{"expected": "e", "held": True, "value": None, "unit": "", "share": None},
                    {"expected": "f", "held": False, "value": -2.0, "unit": "mm", "share": -0.5}],
    }  # fmt: skip


def test_a_trial_s_file_says_what_is_to_be_done(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        trial, "trial_once", lambda files, g, q, point: {"held": point[0] > 0.5, "of": [files, g, q, point]}
    )
    monkeypatch.setattr(trial, "_search", lambda *of: {"held": True, "of": list(of)})
    monkeypatch.setattr(trial, "side_by_side", lambda files, g, q, points, device: [trial.Alone("why")] * len(points))
    options = {"files": {"model": "machine/m.toml"}, "vary": [asdict(q) for q in TWO], "seed": 7}
    files, g = {"model": "/run/machine/m.toml"}, Group("s", "c", "f")
    asked: dict[str, Any] = {"group": ["s", "c", "f"], "point": [0.6, 0.1]}
    whole_json(tmp_path / "t.json", asked)
    said = trial.run_trial(str(tmp_path / "t.json"), options, "/run")
    assert said == {"verdict": "held", "answer": {
        "held": True, "of": [files, g, TWO, [0.6, 0.1]], "alone": "why", "ran": {"bus": 1},
    }}  # fmt: skip
    whole_json(tmp_path / "t.json", asked | {"point": [0.5, 0.1]})
    assert trial.run_trial(str(tmp_path / "t.json"), options, "/run")["verdict"] == "failed"
    asked = {"group": ["s", "c", "f"], "search": 3}
    whole_json(tmp_path / "t.json", asked)
    assert trial.run_trial(str(tmp_path / "t.json"), options, "/run")["answer"]["of"] == [files, g, TWO, asked, 7]


def test_samples_of_one_group_run_in_lanes_together_and_their_answers_are_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ran: list[Any] = []
    margin = trial.Margin("e", True, 2.0, "mm", 0.5)

    def lanes(files: Any, g: Group, quantities: Any, points: Any, device: str) -> list[Any]:
        ran.append((g.name, [list(p) for p in points]))
        return [trial.Ran([margin], device, "n") if p[0] < 0.5 else trial.Alone("why") for p in points]

    monkeypatch.setattr(trial, "side_by_side", lanes)
    monkeypatch.setattr(trial, "trial_once", lambda files, g, q, point: {"held": False, "point": point})
    monkeypatch.setattr(trial, "_kept", {})
    asked = {
        "a": {"group": ["s", "c", "f"], "point": [0.1, 0.1]}, "b": {"group": ["s", "c", "f"], "point": [0.2, 0.1]},
        "c": {"group": ["s", "c", "f"], "point": [0.9, 0.1]}, "other": {"group": ["s", "c", "g"], "point": [0.3, 0.1]},
        "search": {"group": ["s", "c", "f"], "search": 3}, "levels": {"group": ["s", "c", "f"], "subset": True},
        "bad": {"group": ["s", "c", "f"], "point": [0.3], "what": 1},
    }  # fmt: skip
    for name, one in asked.items():
        whole_json(tmp_path / f"{name}.json", one)
    options = {"files": {}, "vary": [asdict(q) for q in TWO], "seed": 7}
    at = {name: str(tmp_path / f"{name}.json") for name in (*asked, "none")}

    def answer(name: str, *beside: str) -> dict[str, Any]:
        return dict(trial.run_trial(at[name], options, "/run", [at[n] for n in beside], "a GPU")["answer"])

    in_lanes = {"held": True, "margins": [{"expected": "e", "held": True, "value": 2.0, "unit": "mm", "share": 0.5}],
                "state_hash": None, "seen": [], "alone": "", "ran": {"a GPU": 1}, "note": "n"}  # fmt: skip
    assert answer("a", *at) == {"point": [0.1, 0.1], **in_lanes}
    assert ran == [("s.c.f", [[0.1, 0.1], [0.2, 0.1], [0.9, 0.1]])]
    assert answer("b") == {"point": [0.2, 0.1], **in_lanes} and len(ran) == 1  # kept, and asked for once
    assert answer("c") == {"point": [0.9, 0.1], "held": False, "alone": "why", "ran": {"bus": 1}} and trial._kept == {}
    assert answer("b")["alone"] == "" and ran[1] == ("s.c.f", [[0.2, 0.1]])
    with pytest.raises(InputError, match=r"bad.json: is no trial of a campaign \(what: Extra inputs"):
        trial.run_trial(at["bad"], options, "/run")
    # the order in which a file names things does not matter
    answer("a", "b")
    whole_json(tmp_path / "b.json", {"point": [0.2, 0.1], "group": ["s", "c", "f"]})
    assert answer("b")["alone"] == "" and len(ran) == 3


def test_warming_up_compiles_the_loop_and_runs_a_moment(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[Any] = []
    monkeypatch.setattr(trial, "warm_up", lambda told: seen.append(told("x")))
    monkeypatch.setattr(trial, "run", lambda scenario: seen.append(scenario.duration))
    monkeypatch.setattr(trial, "warm_up_lanes", lambda: seen.append("lanes"))
    trial.run_trial.warm_up({}, "")
    assert seen == [None, 0.1, "lanes"]


# ---- the search ------------------------------------------------------------------------------------------------------


class Machines:
    """Machines whose least margin is a function of the point; every run is noted."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, share: Callable[[Array], float]):
        """Take the place of the simulation."""
        self.share, self.runs = share, []
        monkeypatch.setattr(trial, "trial_once", self.once)

    def once(self, files: Any, g: Any, quantities: Any, point: list[float]) -> dict[str, Any]:
        assert isinstance(point, list) and all(0.0 <= u <= 1.0 for u in point)
        self.runs.append(tuple(point))
        share = float(self.share(np.array(point)))
        return {
            "point": point,
            "held": share >= 0.0,
            "margins": [claim("m", share), claim("still", -9.0, True)],
            "run": len(self.runs),
        }

    def search(self, runs: int, known: Array, seed: int = 1) -> dict[str, Any]:
        """A search from these points."""
        points = [(list(map(float, p)), float(self.share(np.array(p)))) for p in known]
        quantities = [Varied(f"q{k}", "", 0.0, 1.0, False) for k in range(len(known[0]))]
        asked = {"search": runs, "among": ["m"], "known": points}
        return trial._search({}, Group("s", "c", "f"), quantities, asked, seed)


SIX = [(0.1, 0.9), (0.9, 0.2), (0.4, 0.4), (0.7, 0.7), (0.3, 0.15), (0.6, 0.3)]


def slope(u: Array) -> float:
    return 0.5 + 0.3 * u[0] - 0.2 * u[1]


class Stopped(Exception):
    """A stand-in for an optimizer has seen enough."""


def test_a_search_begins_where_a_plane_through_the_known_points_falls(monkeypatch: pytest.MonkeyPatch) -> None:
    machines, told = Machines(monkeypatch, slope), {}

    def evolution(f: Any, box: Any, **more: Any) -> None:
        told["box"], told["rng"] = box, more.pop("rng").random()
        told["init"], told["more"] = more.pop("init"), more

    monkeypatch.setattr(optimize, "differential_evolution", evolution)
    monkeypatch.setattr(optimize, "minimize", lambda *a, **k: None)
    answer = machines.search(20, SIX, seed=4)
    assert machines.runs == [(0.0, 1.0)] and answer["run"] == 1 and answer["runs"] == 1
    worst = sorted(SIX, key=slope)
    assert answer["from"] == slope(np.array(worst[0]))
    assert told["init"].tolist() == [list(p) for p in worst[:4]] + [[0.0, 1.0]], "the corner for the fifth worst"
    assert told["box"] == [(0.0, 1.0)] * 2 and told["rng"] == np.random.default_rng(4).random()
    assert told["more"] == {"maxiter": 10_000, "tol": 0.0, "atol": -1.0, "polish": False}


def test_a_corner_that_is_no_better_than_the_best_known_machine_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """Twice as many points as quantities begin, and a margin that falls nowhere gives no corner."""
    inits = []
    monkeypatch.setattr(optimize, "differential_evolution", lambda f, box, **more: inits.append(more["init"].tolist()))
    monkeypatch.setattr(optimize, "minimize", lambda *a, **k: None)
    nine = np.random.default_rng(1).random((9, 3)).tolist()
    Machines(monkeypatch, lambda u: 0.5).search(20, nine)
    assert inits == [sorted(nine)[:6]]


@pytest.mark.parametrize(("runs", "half"), [(9, 5), (8, 4)])
def test_half_of_the_runs_are_evolution_s_and_the_simplex_has_the_others(
    monkeypatch: pytest.MonkeyPatch, runs: int, half: int
) -> None:
    """The simplex begins at the least margin so far, with corners 0.15 towards the middle."""
    points = {(0.5, 0.2): -0.5, (0.0, 1.0): 0.9}
    machines, told = Machines(monkeypatch, lambda u: points.get(tuple(u), 0.3)), {}

    def evolution(f: Any, box: Any, **more: Any) -> None:
        assert f(np.array([0.5, 0.2])) == f(np.array([0.5, 0.2])) == -0.5, "what is known is not run again"
        assert f(np.array([-3.0, 7.0])) == f(np.array([0.0, 1.0])) == 0.9, "what lies outside is brought to the edge"
        assert f(np.array(SIX[0])) == 0.3
        for k in range(9):
            f(np.array([0.25, k / 16]))
        raise AssertionError("too many runs")

    def simplex(f: Any, at: Array, **more: Any) -> None:
        told["before"], told["at"] = len(machines.runs), at.tolist()
        told["corners"], told["more"] = more["options"].pop("initial_simplex").tolist(), more
        for k in range(9):
            f(np.array([0.75, k / 16]))

    monkeypatch.setattr(optimize, "differential_evolution", evolution)
    monkeypatch.setattr(optimize, "minimize", simplex)
    answer = machines.search(runs, SIX)
    assert told["before"] == half and len(machines.runs) == runs == answer["runs"]
    assert told["at"] == [0.5, 0.2] and np.allclose(told["corners"], [[0.5, 0.2], [0.35, 0.2], [0.5, 0.35]])
    options = {"maxfev": 100_000, "xatol": 1e-4, "fatol": 1e-6}
    assert told["more"] == {"method": "Nelder-Mead", "bounds": [(0.0, 1.0)] * 2, "options": options}
    assert answer["point"] == [0.5, 0.2] and answer["from"] == 0.3
    assert len(set(machines.runs)) == runs, "no machine is run twice"


def test_of_equal_machines_the_first_that_was_found_is_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    machines = Machines(monkeypatch, lambda u: 0.2 if u[0] == 0.25 else 0.5)
    monkeypatch.setattr(
        optimize, "differential_evolution", lambda f, box, **more: [f(np.array([0.25, v])) for v in (0.6, 0.5)]
    )
    monkeypatch.setattr(optimize, "minimize", lambda *a, **k: None)
    assert machines.search(20, SIX)["point"] == [0.25, 0.6]


def test_where_nothing_is_worse_the_worst_sample_is_run_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where the search only comes as near."""
    worst = (0.1, 0.9)
    machines = Machines(monkeypatch, lambda u: 0.1 if tuple(u) == worst or u[0] == 0.25 else 0.5)
    monkeypatch.setattr(optimize, "differential_evolution", lambda f, box, **more: f(np.array([0.25, 0.6])))
    monkeypatch.setattr(optimize, "minimize", lambda *a, **k: None)
    answer = machines.search(20, SIX)
    assert answer["point"] == list(worst) == list(machines.runs[-1]) and answer["from"] == 0.1
    assert answer["runs"] == 2 and len(machines.runs) == 3, "which is none of the search's runs"


def test_a_search_finds_the_worst_machine_within_its_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    def bowl(u: Array) -> float:
        return 4.0 * (u[0] - 0.62) ** 2 + (u[1] - 0.28) ** 2 - 0.3

    found = []
    for seed in (1, 1, 2):
        machines = Machines(monkeypatch, bowl)
        answer = machines.search(80, np.random.default_rng(2).random((16, 2)).tolist(), seed)
        assert answer["runs"] <= 80 and len(machines.runs) == answer["runs"]
        assert answer["point"] == pytest.approx([0.62, 0.28], abs=0.02) and bowl(np.array(answer["point"])) < -0.2998
        found.append(machines.runs)
    assert found[0] == found[1] != found[2], "the same file gives the same runs"


def test_the_levels_of_a_subset_simulation_run_in_lanes_and_alone_where_they_cannot(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of two quantities the sum of which fails with 2e-4: the levels go there, and the answer has the worst machine."""
    limit = 2.0 - 0.02
    machines = Machines(monkeypatch, lambda u: 0.5 * (limit - u.sum()))
    lanes: list[int] = []

    def side_by_side(files: Any, g: Any, quantities: Any, points: list[list[float]], device: str) -> list[Any]:
        lanes.append(len(points))
        margins = [Margin("m", (s := 0.5 * (limit - sum(u))) >= 0.0, s, "deg", s) for u in points]
        return [trial.Alone("why") if i % 7 == 0 else trial.Ran([m], device) for i, m in enumerate(margins)]

    monkeypatch.setattr(trial, "side_by_side", side_by_side)
    points = np.random.default_rng(3).random((300, 2)).tolist()
    known = [(u, 0.5 * (limit - sum(u))) for u in points]
    asked = {"subset": True, "among": ["m"], "known": known}
    said = [trial._subset({}, Group("s", "c", "f"), TWO, asked, seed, "a GPU") for seed in (1, 1, 2)]
    answer, same, other = said
    assert 3 * sum(answer["ran"].values()) == pytest.approx(sum(lanes), rel=0.2) and set(answer["ran"]) == {
        "a GPU",
        "bus",
    }
    assert answer["point"] == same["point"] != other["point"] and answer["subset"] == same["subset"]
    found = answer["subset"]
    p = np.prod([share for _, share, _ in found["levels"]])
    assert found["reached"] and 2e-4 / 4.0 < p < 4.0 * 2e-4 and 3 <= len(found["levels"]) <= 5
    assert 3 * found["runs"] == pytest.approx(sum(lanes), rel=0.2) and len(machines.runs) > sum(lanes) // 8
    assert not answer["held"] and answer["margins"][0]["share"] < 0.0 and sum(answer["point"]) > limit
    assert trial.is_answer(json.loads(json.dumps({"state_hash": None, "seen": [], **answer})))
    level = trial.Ran([Margin("m", True, 0.4, "", 0.4)])
    monkeypatch.setattr(trial, "side_by_side", lambda files, g, q, of, device: [level] * len(of))
    still = trial._subset({}, Group("s", "c", "f"), TWO, asked | {"known": [(u, 0.4) for u in points]}, 1, "cpu")
    assert still["point"] == min(points) and still["subset"] == {
        "levels": [(0.0, 0.0, 0.0)],
        "reached": False,
        "runs": 0,
    }


def sampled(plan: Plan, share: Callable[[Array], float]) -> dict[str, dict[str, Any] | None]:
    """Answers to all samples of a plan by their names."""
    return {
        f"{i:06d}": {"point": x.tolist(), "held": (s := float(share(x))) >= 0.0, "seen": [], "state_hash": f"{s}",
                     "margins": [claim("m", s), claim("idle", 0.1)]}
        for i, x in enumerate(draw(plan, 2)[0])
    }  # fmt: skip


@pytest.mark.parametrize(("fails", "taken"), [(0, 1), (24, 1), (25, 0), (250, 0)])
def test_levels_are_taken_up_where_fewer_than_a_tenth_of_the_samples_fail(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fails: int, taken: int
) -> None:
    plan, _, run = begun(tmp_path, monkeypatch, 'samples = 250\nsearch = 0\nsampling = "subset"\nseed = 4')
    a, _ = draw(plan, 2)
    assert np.array_equal(a, draw(plan.model_copy(update={"sampling": "random"}), 2)[0]), "they are independent"
    limit = sorted([*a[:, 0], 2.0])[fails]
    monkeypatch.setattr(campaign, "_rows", lambda *of: sampled(plan, lambda u: u[0] - limit))
    assert campaign.take_searches(plan, run) == taken and campaign.take_searches(plan, run) == 0
    if taken:
        said = json.loads((run.path / "trials" / "still.shipped.shipped" / "subset.json").read_text())
        assert said["subset"] is True and said["among"] == ["m"]
        assert said["known"] == [[x.tolist(), x[0] - limit] for x in a]


@pytest.mark.parametrize(("reached", "allowed"), [(True, 1e-3), (True, 1e-5), (False, 1e-3), (False, None)])
def test_a_campaign_says_a_small_probability_by_its_levels(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reached: bool, allowed: float | None
) -> None:
    keys = 'samples = 250\nsearch = 0\nsampling = "subset"' + (f"\nallowed = {allowed}" if allowed else "")
    plan, quantities, run = begun(tmp_path, monkeypatch, keys)
    levels = [[0.3, 0.1, 0.2], [0.1, 0.1, 0.2], [0.0, 0.01 * reached, 0.1 * reached]]
    value = -0.25 if reached else 0.02
    extra = {
        "point": [0.01, 0.99], "held": not reached, "margins": [claim("m", value), claim("idle", 0.1)],
        "state_hash": f"{value}", "seen": [], "subset": {"levels": levels, "reached": reached, "runs": 1234},
    }  # fmt: skip
    samples = sampled(plan, lambda u: 0.5 + 0.1 * u[0])
    found = {"[0-9]*.json": samples, "subset.json": {"subset": extra}}
    monkeypatch.setattr(campaign, "_rows", lambda folder, g, of="[0-9]*.json": found.get(of, {}))
    monkeypatch.setattr(campaign, "trial_once", lambda *of: extra)
    view = campaign.judge(plan, quantities, run, lambda share: None)
    (g,) = view.groups
    assert g.rare is not None and g.rare.runs == 1234 and g.found_by == "level" and not g.by_search
    assert (g.trials, g.failed, g.least) == (250, 0, value) and trial.is_answer(extra)
    if reached:
        assert g.probability == pytest.approx(1e-4) and g.low < 1e-4 < g.high < campaign.interval(0, 250, 0.95)[1]
        assert "failure probability 0.0001, " in g.rare.text and "from 3 levels with 1,234 machines" in g.rare.text
        assert g.requirements[0].fails
    else:
        assert (g.probability, g.low) == (0.0, 0.0) and "no machine failed, 0 to " in g.rare.text
        assert g.high == min(g.rare.high, campaign.interval(0, 250, 0.95)[1]) < 0.02
    assert view.passed(g) == (allowed is None if not reached and allowed != 1e-3 else g.high <= (allowed or 0.0))
    assert view.json()["groups"][0]["rare"]["levels"][0] == {"margin": 0.3, "share": 0.1, "variation": 0.2}


@pytest.mark.parametrize(
    ("sampling", "fails", "said"),
    [("subset", 30, "30 of 250 samples fail"), ("subset", 2, "the levels have no answer"), ("random", 2, "")],
)
def test_a_probability_that_is_counted_where_levels_were_asked_for_says_why(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sampling: str, fails: int, said: str
) -> None:
    plan, quantities, run = begun(
        tmp_path, monkeypatch, f'samples = 250\nsearch = 0\nsaved = 0\nsampling = "{sampling}"'
    )
    limit = sorted(draw(plan, 2)[0][:, 0])[fails]
    samples = sampled(plan, lambda u: u[0] - limit)
    monkeypatch.setattr(campaign, "_rows", lambda folder, g, of="[0-9]*.json": samples if of[0] == "[" else {})
    monkeypatch.setattr(campaign, "trial_once", lambda *of: samples["000000"])
    (g,) = campaign.judge(plan, quantities, run, lambda share: None).groups
    assert g.counted == said and g.rare is None and g.probability == fails / 250
    assert (g.low, g.high) == campaign.interval(fails, 250, 0.95)


# ---- probability and requirements ------------------------------------------------------------------------------------


@pytest.mark.parametrize(("failed", "n"), [(0, 32), (1, 32), (7, 20), (20, 20)])
@pytest.mark.parametrize("confidence", [0.95, 0.8])
def test_the_interval_of_a_probability_is_clopper_s_and_pearson_s(failed: int, n: int, confidence: float) -> None:
    """Its ends are those probabilities at which so many failures, or so few, have half of what is left to chance."""
    low, high = campaign.interval(failed, n, confidence)
    half = (1.0 - confidence) / 2.0
    assert low == (0.0 if failed == 0 else pytest.approx(stats.beta.ppf(half, failed, n - failed + 1)))
    assert high == (1.0 if failed == n else pytest.approx(stats.beta.ppf(1.0 - half, failed + 1, n - failed)))
    assert failed == 0 or stats.binom.sf(failed - 1, n, low) == pytest.approx(half)
    assert failed == n or stats.binom.cdf(failed, n, high) == pytest.approx(half)


def test_a_requirement_has_the_least_and_the_median_margin_of_all_machines() -> None:
    rows = [
        {"margins": [claim("a", 0.4), claim("b", None, unit="")]},
        {"margins": [claim("a", -0.1, value=-2.0), claim("b", None, False, unit="s"), claim("rare", 0.7)]},
        {"margins": [claim("a", 0.2)]},
        {"margins": [claim("a", 0.3)]},
    ]
    search = {"margins": [claim("a", -0.5, value=-7.0), claim("new", -0.2, unit="N"), claim("b", None, True)]}
    asked = [{"id": "R-1", "text": "Some text", "verified_by": ["still: a"]},
             {"id": "R-2", "text": "Some text", "verified_by": ["other", "still: new", "still: e"]}]  # fmt: skip
    plan = plan_of(scenarios=["still", "other"], requirement=asked)
    said = {r.expected: r for r in campaign._requirements(rows, search, plan, "still")}
    assert list(said) == ["a", "b", "rare", "new"]
    assert [r.ids for r in said.values()] == [["R-1"], [], ["R-1", "R-2"], ["R-2"]]
    odds = [(1, 4), (1, 2), (0, 1)]  # broken of those in which it was judged
    assert [(r.low, r.high) for r in said.values()] == [*(campaign.interval(*o, 0.95) for o in odds), (0.0, 1.0)]
    assert {tuple(r.ids) for r in campaign._requirements(rows, search, plan, "other")} == {("R-2",)}
    a, b, rare, new = said.values()
    assert (a.trials, a.broken, a.unit, a.least, a.share) == (4, 1, "deg", -2.0, -0.1)
    assert a.median == pytest.approx(0.25) and (a.searched, a.held) == (-7.0, False)
    assert (b.trials, b.broken, b.unit, b.least, b.median, b.share, b.searched, b.held) == (
        2,
        1,
        "s",
        None,
        None,
        None,
        None,
        True,
    )
    assert (rare.trials, rare.broken, rare.least, rare.searched, rare.held) == (1, 0, 0.7, None, None)
    assert (new.trials, new.broken, new.unit, new.least, new.searched, new.held) == (0, 0, "N", None, -0.2, False)
    assert [r.searched for r in campaign._requirements(rows, None, plan, "still")] == [None] * 3


# ---- the whole, on made-up answers -----------------------------------------------------------------------------------


def begun(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, keys: str, more: str = ""
) -> tuple[Plan, list[Varied], Folder]:
    """A campaign over the made-up plant."""
    (tmp_path / "still.toml").write_text(SCENARIO)
    (tmp_path / "plan.toml").write_text(
        f'title = "Made"\nscenarios = ["still.toml"]\n{keys}\n[vary]\n"a.x" = "tolerance"\n'
        f'"jam.force" = [10, 20]\n{more}'
    )
    monkeypatch.setattr(plans, "EFFECTS", EFFECTS)
    monkeypatch.setattr(plans, "group_machine", lambda files, g, model=None: SimpleNamespace(plant=PLANT))
    return campaign.begin(tmp_path / "plan.toml", tmp_path / "run", 60.0)


def answered(run: Folder, share: Callable[[Array], float], without: tuple[str, ...] = ()) -> None:
    """What workers would have made of all trials."""
    for chunk, entries in run.chunks().items():
        if chunk in run.finished():
            continue
        for e in entries:
            asked = json.loads(Path(e.path).read_text())
            point = asked.get("point", [0.01, 0.99])
            value = float(share(np.array(point)))
            answer: dict[str, Any] = {
                "point": point, "held": value >= 0.0, "margins": [claim("m", value), claim("idle", 0.1)],
                "state_hash": f"{value}", "seen": [] if value >= 0 else ["low"],
            }  # fmt: skip
            row: dict[str, Any] = {"key": e.key, "status": "done", "reason": "", "verdict": "held"}
            row["answer"] = None if asked["name"] in without else answer | ({"runs": 9} if "search" in asked else {})
            whole_json(run.results(chunk) / f"{e.key}.json", row)
        run.close(chunk, entries)


def test_what_a_campaign_is_of_is_in_its_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    points: list[Any] = []
    at = campaign.model_at
    monkeypatch.setattr(
        campaign, "model_at", lambda files, g, q, point: points.append((g.name, point)) or at(files, g, q, point)
    )
    (tmp_path / "S").mkdir()
    more = '[[calibration]]\nname = "soft"\ntables = "S"\n[[calibration]]\nname = "hard"\n'
    plan, quantities, run = begun(tmp_path, monkeypatch, "samples = 8\nconfidence = 0.9\nallowed = 0.5", more)
    assert quantities == [Varied("a.x", "deg", 1.5, 2.5, False), Varied("jam.force", "N", 10.0, 20.0, True)]
    names = ("still.soft.shipped", "still.hard.shipped")
    assert points == [(g, [corner] * 2) for g in names for corner in (0.0, 1.0)]
    options = run.job["options"]
    assert options.keys() == {"files", "limit", "plan", "vary", "seed"} and options["limit"] == 60.0
    assert options["files"] == {"scenario.still": "machine/scenario.still.toml", "tables.soft": "machine/tables.soft"}
    assert options["plan"] == {
        "scenarios": ["still"], "samples": 8, "sampling": "sobol", "search": 40, "sensitivity": 0, "seed": 1,
        "model": False, "plant": False, "vary": {"a.x": "tolerance", "jam.force": [10.0, 20.0]},
        "calibration": [{"name": "soft"}, {"name": "hard"}], "firmware": [{"name": "shipped"}],
    }  # fmt: skip
    assert run.job["kind"] == "trial" and run.of_campaign and plan.confidence == 0.9


def test_a_trial_has_a_file_for_each_sample_and_each_point_of_the_indices(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan, quantities, run = begun(tmp_path, monkeypatch, "samples = 8\nsensitivity = 4\nsearch = 7")
    assert (
        campaign.take_samples(plan, quantities, run) == 8 + 4 * 3 and campaign.take_samples(plan, quantities, run) == 0
    )
    at = run.path / "trials" / "still.shipped.shipped"
    said = {f.stem: json.loads(f.read_text()) for f in at.glob("*.json")}
    a, b = draw(plan, 2)
    expected = {f"{i:06d}": a[i] for i in range(8)} | {f"b{i:06d}": b[i] for i in range(4)}
    expected |= {f"ab000-{i:06d}": [b[i, 0], a[i, 1]] for i in range(4)}
    expected |= {f"ab001-{i:06d}": [a[i, 0], b[i, 1]] for i in range(4)}
    assert {n: s["point"] for n, s in said.items()} == {n: list(x) for n, x in expected.items()}
    assert all(s["group"] == ["still", "shipped", "shipped"] and s["name"] == n for n, s in said.items())
    assert {(e.engine, e.time) for e in run.entries()} == {("campaign", 0.0)}
    (at / "000003.json").write_text("{")
    (at / "000004.json").unlink()
    whole = (at / "000000.json").stat().st_ino
    campaign.take_samples(plan, quantities, run)
    assert {f.stem: json.loads(f.read_text()) for f in at.glob("*.json")} == said
    assert (at / "000000.json").stat().st_ino == whole, "a file that is as it must be is not written again"


def test_a_search_begins_with_the_worst_samples(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plan, quantities, run = begun(tmp_path, monkeypatch, "samples = 8\nsearch = 7")
    assert campaign.take_searches(plan, run) == 0, "no sample has an answer yet"
    campaign.take_samples(plan, quantities, run)
    answered(run, slope, ("000001", "000002"))
    monkeypatch.setattr(campaign, "KNOWN", 3)
    assert campaign.take_searches(plan, run) == 1 and campaign.take_searches(plan, run) == 0
    said = json.loads((run.path / "trials" / "still.shipped.shipped" / "search.json").read_text())
    a, _ = draw(plan, 2)
    known = sorted((slope(x), x.tolist()) for i, x in enumerate(a) if i not in (1, 2))
    assert said["known"] == [[x, share] for share, x in known[:3]]
    assert (said["search"], said["among"], said["name"]) == (7, ["m"], "search")
    assert list(run.chunks())[-1] == "000001-000000"


def test_of_equally_bad_samples_the_order_is_that_of_their_points(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan, quantities, run = begun(tmp_path, monkeypatch, "samples = 8")
    campaign.take_samples(plan, quantities, run)
    answered(run, lambda u: 0.5)
    campaign.take_searches(plan, run)
    said = json.loads((run.path / "trials" / "still.shipped.shipped" / "search.json").read_text())
    assert said["known"] == [[x, 0.1] for x in sorted(draw(plan, 2)[0].tolist())]


@pytest.mark.parametrize(("lost", "search"), [(3, 1), (4, 0)])
def test_five_samples_with_an_answer_are_needed_for_a_search(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lost: int, search: int
) -> None:
    plan, quantities, run = begun(tmp_path, monkeypatch, "samples = 8")
    campaign.take_samples(plan, quantities, run)
    answered(run, slope, tuple(f"{k:06d}" for k in range(lost)))
    assert campaign.take_searches(plan, run) == search
    assert campaign.take_searches(plan.model_copy(update={"search": 0}), run) == 0


def test_searches_are_as_many_chunks_as_groups(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    more = '[[calibration]]\nname = "a"\n[[calibration]]\nname = "b"\n'
    plan, quantities, run = begun(tmp_path, monkeypatch, "samples = 8", more)
    assert campaign.take_samples(plan, quantities, run) == 16
    answered(run, slope)
    assert campaign.take_searches(plan, run) == 2
    assert [len(es) for c, es in run.chunks().items() if c.startswith("000001-")] == [1, 1]


def test_indices_are_those_of_a_plane(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 0.5 + 0.3 u - 0.2 v the shares of variance are 9 / 13 and 4 / 13, first-order and total."""
    plan, g = plan_of(samples=128, sensitivity=128), Group("s", "c", "f")
    a, b = draw(plan, 2)
    mixed = [np.column_stack([b[:, 0], a[:, 1]]), np.column_stack([a[:, 0], b[:, 1]])]
    points = {f"{i:06d}": x for i, x in enumerate(a)} | {f"b{i:06d}": x for i, x in enumerate(b)}
    points |= {f"ab{k:03d}-{i:06d}": x for k in range(2) for i, x in enumerate(mixed[k])}
    every: dict[str, Any] = {n: {"margins": [claim("m", slope(x)), claim("idle", 0.1)]} for n, x in points.items()}
    rows = {n: every.pop(n) for n in list(every)[:128]}
    nowhere: Any = None
    monkeypatch.setattr(campaign, "_rows", lambda folder, g, pattern: every if pattern == "*b*.json" else {})
    first, total = campaign._indices(plan, TWO, nowhere, g, rows, ["m"])
    assert first == pytest.approx([9 / 13, 4 / 13], abs=0.03) and total == pytest.approx([9 / 13, 4 / 13], abs=0.03)
    spread = np.array([slope(x) for x in (*a, *b)]).var()
    for k in range(2):
        change = np.array([slope(x) - slope(y) for x, y in zip(mixed[k], a, strict=True)])
        assert total[k] == pytest.approx(np.mean(change**2) / 2 / spread), "Jansen's estimate"
    assert campaign._indices(plan_of(samples=128), TWO, nowhere, g, rows, ["m"]) == ([], []), "none was asked for"
    assert campaign._indices(plan, TWO, nowhere, g, rows, ["idle"]) == ([], []), "a margin that does not vary has none"
    for of, name in ((rows, "000005"), (every, "b000007"), (every, "ab001-000009")):
        with monkeypatch.context() as m:
            m.setitem(of, name, None)
            assert campaign._indices(plan, TWO, nowhere, g, rows, ["m"]) == ([], []), name


def point_of(model: str, among: Array) -> Array:
    """The point of the unit cube that a saved model file is of, of those among which it must be."""
    made = tomllib.loads(Path(model).read_text())
    distance = among - [made["parameters"]["a.x"] - 1.5, made["effects"]["jam"]["force"] / 10.0 - 1.0]
    nearest = np.abs(distance).max(axis=1)
    assert nearest.min() < 1e-12
    return among[int(nearest.argmin())]


@pytest.mark.parametrize("search", [True, False])
def test_a_campaign_says_how_many_fail_and_which_is_worst(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, search: bool
) -> None:
    plan, quantities, run = begun(tmp_path, monkeypatch, f"samples = 8\nsensitivity = 4\nsearch = {9 * search}")
    campaign.take_samples(plan, quantities, run)
    fails = lambda u: 1.5 * slope(u) - 0.7  # noqa: E731
    answered(run, fails, ("000006",))
    campaign.take_searches(plan, run)
    answered(run, fails)
    again: list[Any] = []

    def once(files: dict[str, str], g: Group, quantities: Any, point: Any) -> dict[str, Any]:
        again.append((files, g.name, quantities, point))
        value = fails(point_of(files["model"], np.vstack([draw(plan, 2)[0], [0.01, 0.99]])))
        return {"state_hash": f"{value}", "margins": [claim("m", value), claim("idle", 0.1)]}

    monkeypatch.setattr(campaign, "trial_once", once)
    told: list[float] = []
    view = campaign.judge(plan, quantities, run, told.append)
    (g,) = view.groups
    a = np.delete(draw(plan, 2)[0], 6, axis=0)
    shares = [fails(x) for x in a]
    failed = sum(s < 0.0 for s in shares)
    assert 0 < failed < 7 and (g.trials, g.lost, g.failed) == (7, 1, failed)
    assert (g.low, g.high) == campaign.interval(failed, 7, 0.95) and told == [1.0]
    assert g.shares == shares and g.points == a.tolist()
    point = [0.01, 0.99] if search else a[int(np.argmin(shares))].tolist()
    assert (g.least, g.by_search, g.runs) == (fails(np.array(point)), search, 9 * search)
    assert g.worst == [1.5 + point[0], 10.0 + 10.0 * point[1]] and g.seen == ["low"]
    assert g.state_hash == f"{g.least}" and g.same
    assert [r.expected for r in g.requirements] == ["m", "idle"]
    assert g.requirements[0].searched == (g.least if search else None)
    assert len(g.first) == len(g.total) == 2
    assert (view.title, view.run, view.version) == ("Made", str(run.path), run.job["version"])
    at = run.path / "worst" / "still.shipped.shipped"
    assert sorted(f.name for f in at.iterdir()) == ["command.txt", "model.toml", "scenario"]
    words = ["vaneloop", "inject", str(at / "scenario" / "still.toml"), "--model", str(at / "model.toml")]
    assert (
        g.command == shlex.join(words) and (at / "command.txt").read_text() == g.command + "\n" and g.saved == str(at)
    )
    assert again[0] == (
        {"scenario.still": str(at / "scenario" / "still.toml"), "model": str(at / "model.toml")},
        g.name,
        [],
        [],
    )
    assert len(again) == 1 + failed and [f.least for f in g.failures] == sorted(s for s in shares if s < 0.0)
    assert g.reproduces and g.saved_failures() == f"{failed} of {failed} failed machines saved, the worst first"
    model = (at / "model.toml").read_text()
    assert "campaign run, worst case of still.shipped.shipped" in model and f"{g.worst[0]!r}"[:12] in model


@pytest.mark.parametrize(("off", "same"), [(0.0, True), (5e-10, True), (5e-9, False)])
@pytest.mark.parametrize("alone", ["", "why", None])
def test_failed_machines_are_saved_the_worst_first_and_run_again_to_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, off: float, same: bool, alone: str | None
) -> None:
    """Bit for bit where the first run was on the bus; of one from lanes the margins to 1e-9. The rest is counted."""
    plan, quantities, run = begun(tmp_path, monkeypatch, "samples = 16\nsearch = 0\nsaved = 3")
    fails = lambda u: 1.5 * slope(u) - 0.8  # noqa: E731
    a, _ = draw(plan, 2)
    campaign.take_samples(plan, quantities, run)
    answered(run, fails)
    rows = campaign._rows
    monkeypatch.setattr(
        campaign,
        "_rows",
        lambda *of: {n: r | ({} if alone is None else {"alone": alone}) for n, r in rows(*of).items()},
    )
    first: list[float] = []

    def once(files: dict[str, str], g: Group, quantities: Any, point: Any) -> dict[str, Any]:
        u = point_of(files["model"], a) if "model" in files else np.array(point)
        value = fails(u) if not first else fails(u) + off  # the first run is of the worst machine
        first.append(value)
        return {"point": point, "state_hash": f"{fails(u)}", "margins": [claim("m", value), claim("idle", 0.1)],
                "held": value >= 0.0, "seen": []}  # fmt: skip

    monkeypatch.setattr(campaign, "trial_once", once)
    old = run.path / "failed" / "still.shipped.shipped" / "machines" / "000099.toml"
    old.parent.mkdir(parents=True)
    old.write_text("")
    view = campaign.judge(plan, quantities, run, lambda share: None)
    (g,) = view.groups
    order = sorted((x for x in a if fails(x) < 0.0), key=fails)
    assert len(order) == g.failed > 4 and not old.exists()
    at = run.path / "failed" / "still.shipped.shipped"
    files = [at / "machines" / f"{f.name}.toml" for f in g.failures]
    assert sorted(files) == sorted((at / "machines").iterdir()) and [f.file for f in g.failures] == list(
        map(str, files)
    )
    for f, x in zip(g.failures, order[:3], strict=True):
        assert np.array_equal(point_of(f.file, a), x) and f.least == fails(x) and np.array_equal(a[int(f.name)], x)
        assert shlex.split(f.command) == ["vaneloop", "inject", str(at / "scenario" / "still.toml"), "--model", f.file]
        assert f.same == (same if alone == "" else off == 0.0)
    assert g.reproduces == (g.same and g.failures[0].same) and (g.reproduces or not view.passed(g))
    left = g.failed - 3
    assert g.saved_failures() == f"3 of {g.failed} failed machines saved, the worst first; {left} more failed and " + (
        "are not saved"
    )
    assert view.json()["groups"][0]["failures_not_saved"] == left
    assert view.json()["groups"][0]["failures"][0] == asdict(g.failures[0])


def test_no_failed_machine_is_saved_where_none_is_asked_for_or_none_failed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan, quantities, run = begun(tmp_path, monkeypatch, "samples = 8\nsearch = 0\nsaved = 0")
    campaign.take_samples(plan, quantities, run)
    answered(run, lambda u: -1.0)
    answer = {"state_hash": "-1.0", "margins": [claim("m", -1.0), claim("idle", 0.1)]}
    monkeypatch.setattr(campaign, "trial_once", lambda *of: answer)
    (g,) = campaign.judge(plan, quantities, run, lambda share: None).groups
    said = "0 of 8 failed machines saved, the worst first; 8 more failed and are not saved"
    assert not g.failures and not (run.path / "failed").exists() and g.saved_failures() == said
    assert GroupView.saved_failures(SimpleNamespace(failed=0, failures=[])) == ""
    one = GroupView.saved_failures(SimpleNamespace(failed=1, failures=[]))
    assert one.endswith("1 more failed and is not saved")


def test_a_campaign_without_an_answer_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plan, quantities, run = begun(tmp_path, monkeypatch, "samples = 8")
    with pytest.raises(InputError, match=r"no trial of still\.shipped\.shipped came to an end"):
        campaign.judge(plan, quantities, run, lambda share: None)
    campaign.take_samples(plan, quantities, run)
    answered(run, slope, tuple(f"{k:06d}" for k in range(8)))
    with pytest.raises(InputError, match="came to an end"):
        campaign.judge(plan, quantities, run, lambda share: None)


@pytest.mark.parametrize("other", [{"state_hash": "other"}, {"margins": [2]}])
def test_a_worst_machine_that_runs_otherwise_from_its_saved_files_is_not_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, other: dict[str, Any]
) -> None:
    _, quantities, run = begun(tmp_path, monkeypatch, "samples = 8")
    worst = {"point": [0.5, 0.5], "state_hash": "h", "margins": [1]}
    files, g = {"scenario.still": str(tmp_path / "still.toml")}, Group("still", "shipped", "shipped")
    monkeypatch.setattr(campaign, "trial_once", lambda *of: worst | other)
    assert not campaign._save(run, files, plan_of(), g, quantities, worst)[2]


def test_a_worst_machine_that_cannot_be_saved_whole_leaves_the_earlier_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, quantities, run = begun(tmp_path, monkeypatch, "samples = 8")
    (tmp_path / "T").mkdir()
    (tmp_path / "T" / "plant.toml").write_text("tables")
    g = Group("still", "soft", "mine")
    files = {"scenario.still": str(tmp_path / "still.toml"), "tables.soft": str(tmp_path / "T")}
    worst = {"point": [0.5, 0.5], "state_hash": "h", "margins": [1]}
    monkeypatch.setattr(campaign, "trial_once", lambda *of: worst)
    at = campaign._save(run, files, plan_of(), g, quantities, worst)[0]

    def there() -> dict[str, bytes]:
        return {str(f.relative_to(at)): f.read_bytes() for f in at.rglob("*") if f.is_file()}

    before = there()
    assert set(before) == {"command.txt", "model.toml", "scenario/still.toml", "tables/plant.toml"}
    (at / "command.txt").unlink()
    (at / "command.txt").mkdir()
    with pytest.raises(InputError, match=r"command\.txt"):
        campaign._save(run, files, plan_of(), g, quantities, worst | {"point": [0.9, 0.1]})
    del before["command.txt"]
    assert there() == before
    (at / "command.txt").rmdir()
    campaign._save(run, files, plan_of(), g, quantities, worst | {"point": [0.9, 0.1]})
    assert there()["model.toml"] != before["model.toml"] and set(there()) == {*before, "command.txt"}


def test_the_worst_machine_is_saved_with_all_that_it_is_made_of(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, quantities, run = begun(tmp_path, monkeypatch, "samples = 8")
    (tmp_path / "T").mkdir()
    for name in ("T/plant.toml", "p.toml", "c.so"):
        (tmp_path / name).write_text(name)
    g = Group("still", "soft", "mine")
    files = {"scenario.still": str(tmp_path / "still.toml"), "tables.soft": str(tmp_path / "T"),
             "plant": str(tmp_path / "p.toml"), "firmware.mine": str(tmp_path / "c.so"),
             "tables.hard": str(tmp_path / "p.toml")}  # fmt: skip
    asked: list[dict[str, str]] = []
    worst = {"point": [0.5, 0.5], "state_hash": "h", "margins": [1]}
    monkeypatch.setattr(campaign, "trial_once", lambda files, *of: asked.append(files) or worst)
    stale = run.path / "worst" / g.name / "stale"
    stale.mkdir(parents=True)
    at, command, same = campaign._save(run, files, plan_of(), g, quantities, worst)
    assert at == run.path / "worst" / "still.soft.mine" and same and not stale.exists()
    assert (at / "tables" / "plant.toml").read_text() == "T/plant.toml"
    assert (at / "plant.toml").read_text() == "p.toml" and (at / "controller.so").read_text() == "c.so"
    assert (at / "scenario" / "still.toml").read_text() == SCENARIO
    words = [
        "--tables",
        str(at / "tables"),
        "--plant",
        str(at / "plant.toml"),
        "--controller",
        str(at / "controller.so"),
    ]
    assert shlex.split(command)[5:] == words
    assert asked == [{"scenario.still": str(at / "scenario" / "still.toml"), "model": str(at / "model.toml"),
                      "tables.soft": words[1], "plant": words[3], "firmware.mine": words[5]}]  # fmt: skip
