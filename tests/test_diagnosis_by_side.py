"""Two actuators in the search: each side's actuator in the load of the rings, the linkage behind both strokes, and
faults that are named with their side.
"""

# ruff: noqa: D103 - a test's name is its claim
from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hil.logs import Channel, Log, write_log
from hil.loop.lockstep import Stimulus, lockstep
from plant import Model, Plant, build_plant, chain, load_model, unison
from plant.model import Side
from plant.parameters import LINE_CONDUCTANCE, POT_POSITION, RING_STIFFNESS, derive
from plant.places import X
from plant.stages import ring_loads
from vaneloop import Machine
from vaneloop.base.errors import InputError
from vaneloop.base.tables import file_of
from vaneloop.cli.main import main
from vaneloop.fleet.diagnosis import diagnose_log
from vaneloop.identification import workflow
from vaneloop.identification.results import Found
from vaneloop.identification.subsystem import Stage
from vaneloop.identification.vane_chain import experiment
from vaneloop.identification.vane_chain.candidates import without_laws
from vaneloop.identification.vane_chain.chain import Chain, build_chain
from vaneloop.identification.vane_chain.experiment import divergence
from vaneloop.identification.workflow import diagnose, locate_stages
from vaneloop.verbs.search import extended, known

TABLE = "plant_two_actuators.toml"
TWO = build_plant(TABLE)
T = np.arange(0.0, 40.0, 0.01)
POINTS = [(0, 60), (2, 60), (3, 90), (5, 90), (9, 55), (11, 55), (12, 75), (14, 75), (14.5, 68), (17, 68), (18, 97),
          (20, 97), (21, 60), (23, 60), (27, 85), (29, 85), (30, 52), (32, 52), (33, 80), (40, 80)]  # fmt: skip
DEMAND = np.interp(T, *np.array(POINTS, dtype=float).T)
BIAS, FRICTION = {"lvdt_bias": {"bias": 0.5}}, {"piston_friction": {"force": 1500.0}}
APART = Model(side_b=Side(effects={"valve_null_bias": {"bias": 0.4}}))  # the strokes come apart, truly


def rows_of(plant: Plant, seed: int | None, rows: int) -> Log:
    run = lockstep(Stimulus.of(DEMAND[:rows]), plant=plant, seed=seed, hashed=False)
    return Log("simulated", {k: Channel(run.t, v) for k, v in run.columns.items() if k not in ("t", "n_engine")})


@lru_cache
def log_of(model: str, seed: int | None = 1, rows: int = len(T)) -> Log:
    return rows_of(Model.model_validate_json(model).plant(TWO), seed, rows)


def logged(model: Model, seed: int | None = 1, rows: int = len(T)) -> Log:
    return log_of(model.model_dump_json(), seed, rows)


@lru_cache
def chain_of(model: str, rows: int) -> Chain:
    return build_chain(log_of(model, 1, rows), TWO)


def built(model: Model, rows: int = 2000) -> Chain:
    """The stages of the nominal machine on the log of another; nothing in a test changes them."""
    return chain_of(model.model_dump_json(), rows)


def at_place(plant: Plant, position: float) -> Plant:
    """The machine with its potentiometers at another place (deg) around the rings."""
    p = plant.p.copy()
    p[POT_POSITION] = math.radians(position)
    derive(p, chain.TICK / chain.SUBSTEPS, chain.TICK)
    return replace(plant, p=p)


def error_of(stage: Stage) -> np.ndarray:
    """RMS of a stage's error with nothing refitted, float64[outputs], its windows' constants taken off."""
    e = stage.run(stage.neutral()[None])[0] - stage.measured
    if stage.window:
        rows = round(stage.window / float(stage.t[1] - stage.t[0]))
        e = e[:, : e.shape[1] // rows * rows].reshape(len(e), -1, rows)
        e = (e - e.mean(axis=2, keepdims=True)).reshape(len(e), -1)
    return np.sqrt(np.nanmean(e**2, axis=1))


def found(chain: Chain) -> dict[str, list[tuple[str, list[str]]]]:
    """Stage -> the effects that it is said to lack, each with its rivals."""
    d = diagnose(chain.stages, workers=1)
    return {s.stage: [(f.effect, f.rivals) for f in s.effects] for s in d.stages if s.verdict != "none"}


# ---- the stages ------------------------------------------------------------------------------------------------------


def test_a_machine_of_two_has_an_actuator_of_each_side() -> None:
    made = built(Model())
    assert [s.name for s in made.stages] == ["demand", "servo", "engine", "actuator_a", "actuator_b", "linkage"]
    assert [s.outputs for s in made.stages[3:5]] == [("x_lvdt_a",), ("x_lvdt_b",)]
    names = [{e.name for e in s.effects} for s in made.stages]
    assert {"side_a.piston_friction", "side_a.lvdt_bias", "side_b.lvdt_bias", "aero_load"} <= names[3]
    assert not {"side_b.piston_friction", "piston_friction", "lvdt_bias"} & names[3]
    assert {"lvdt_gain", "side_a.lvdt_gain", "side_b.lvdt_gain", "linkage_backlash"} <= names[5]
    known_by = [p.name for p in made.stage("actuator_b").parameters]
    assert "side_b.actuator.flow_gain" in known_by and "actuators.ring_stiffness" in known_by
    assert not any(x.fails for x in locate_stages(made.stages))


@pytest.mark.parametrize("side", [0, 1])
def test_the_rings_load_a_piston_as_in_the_loop(side: int) -> None:
    """At strokes that differ, of LVDTs that are off: as `plant.unison` has it at the true ones."""
    plant = Model(side_a=Side(effects={"lvdt_bias": {"bias": 0.3}})).plant(TWO)
    a, b = np.array([20e-3, 24e-3, 30e-3]), np.array([20.5e-3, 22e-3, 30e-3])
    still = np.repeat([a + 0.3e-3, b], 50, axis=1)
    loads, slopes = ring_loads(still, np.full(150, 40.0), 0.01, plant.p[:, :1], plant.p[:, 1:], side)
    for k in range(3):
        s = plant.start(a[k], 70.0)
        s[X, 1] = b[k]
        tie = unison.tie(s, plant.p, 0)
        at, slope = (a, b)[side][k], slopes[0, 50 * k + 25]
        assert slope == pytest.approx((tie.k_a, tie.k_b)[side], rel=1e-6)
        assert loads[0, 50 * k + 25] + slope * at == pytest.approx((tie.f_a, tie.f_b)[side], rel=1e-6, abs=1e-3)


def test_ring_loads_of_lanes_are_in_proportion_to_their_stiffness() -> None:
    p = np.repeat(TWO.p[:, :1], 3, axis=1)
    p[RING_STIFFNESS] = [0.0, 1e5, 3e5]
    rings = ring_loads(np.full((2, 20), 20e-3) + [[1e-3], [0.0]], np.full(20, 40.0), 0.01, p, p.copy(), 0)
    assert not rings[:, 0].any() and np.allclose(rings[:, 2], 3.0 * rings[:, 1])
    loads = rings[0] + 21e-3 * rings[1]
    assert loads[1].min() > 1e3


@given(load=st.floats(-1e4, 1e4), slope=st.floats(0.0, 1e8), w=st.floats(0.0, 0.05), c=st.floats(0.0, 1e-6))
def test_the_load_of_a_spring_behind_soft_oil_is_that_at_the_stroke_that_it_leaves(
    load: float, slope: float, w: float, c: float
) -> None:
    force = unison.felt(load, slope, w, c)
    assert force == pytest.approx(load + slope * (w - c * force), rel=1e-6, abs=1e-6 * (abs(load) + slope * w))


def test_noise_of_the_strokes_is_not_added_up_by_a_leakage() -> None:
    """With leakage a piston follows the other through the rings; at the true parameters only the floor is left."""
    leaking = Model(side_a=Side(effects={"internal_leakage": {"coefficient": 8.0}})).plant(TWO)
    stage = build_chain(rows_of(leaking, 5, 4000), TWO).stage("actuator_a")
    true = stage.neutral()
    true[stage.index()["side_a.internal_leakage"]] = 8.0
    left = stage.run(true[None])[0] - stage.measured
    assert float(np.sqrt(np.nanmean(left**2))) < 1.2 * stage.floor[0]


def test_each_actuator_follows_the_loop_while_the_strokes_differ() -> None:
    """Without noise an actuator by itself moves as in the loop; without the rings it does not."""
    plant = APART.plant(TWO)
    log = rows_of(plant, None, 2000)
    assert np.ptp(log["x_lvdt_a"].values - log["x_lvdt_b"].values) > 1.0
    made = build_chain(log, plant, present=("valve_null_bias",))
    free = plant.p.copy()
    free[RING_STIFFNESS] = 0.0
    loose = build_chain(log, replace(plant, p=free), present=("valve_null_bias",))
    for name in ("actuator_a", "actuator_b"):
        assert error_of(made.stage(name))[0] < 1e-3 < 5e-3 < error_of(loose.stage(name))[0]


@pytest.mark.parametrize("position", [0.0, 90.0])
def test_the_linkage_follows_the_loop_while_the_strokes_differ(position: float) -> None:
    plant = at_place(APART.plant(TWO), position)
    log = rows_of(plant, None, 2000)
    made = build_chain(log, plant, present=("valve_null_bias",))
    assert (error_of(made.stage("linkage")) < 5e-3).all()
    swapped = replace(log, channels={**log.channels, "x_lvdt_a": log["x_lvdt_b"], "x_lvdt_b": log["x_lvdt_a"]})
    other = build_chain(swapped, plant, present=("valve_null_bias",))
    assert (error_of(other.stage("linkage")).max() > 0.1) == (position == 0.0)


@pytest.mark.parametrize(("position", "told"), [(0.0, True), (90.0, False)])
def test_strokes_in_each_others_place_are_told_where_the_angles_tell(position: float, told: bool) -> None:
    """At the middle of the rings a potentiometer feels both alike: there nothing tells."""
    unequal = Model(side_b=Side(parameters={"actuator.flow_gain": 0.145}))
    log = rows_of(unequal.plant(at_place(TWO, position)), 1, 2000)
    other = replace(log, channels={**log.channels, "x_lvdt_a": log["x_lvdt_b"], "x_lvdt_b": log["x_lvdt_a"]})
    for one, said in ((log, False), (other, told)):
        notes = build_chain(one, at_place(TWO, position)).notes
        assert any("each seems to stand in the other's place" in n for n in notes) == said


def test_a_log_without_both_strokes_says_in_one_line_what_it_does_not_tell() -> None:
    log = logged(Model(), rows=2000)
    made = build_chain(log[[c for c in log.channels if c not in ("x_lvdt_a", "x_lvdt_b")]], TWO)
    assert [s.name for s in made.stages] == ["demand", "servo", "engine", "linkage"]
    assert list(made.not_observed) == ["actuator_a", "actuator_b"]
    (said,) = [n for n in made.notes if n.startswith("x_lvdt_a, x_lvdt_b: not logged")]
    assert "which actuator or LVDT is at fault cannot be told" in said
    assert not {e.name for e in made.stage("linkage").effects if e.name.startswith("side_")}


def test_the_mean_stroke_of_both_drives_the_servo_where_it_is_not_logged() -> None:
    log = logged(Model(), rows=2000)
    made = Machine(table=TABLE).bind(log[[c for c in log.channels if c != "x_lvdt"]])
    assert "servo" in [s.name for s in made.stages]
    assert np.allclose(made.columns["x_lvdt"], log["x_lvdt"].values[: len(made.t)], atol=1e-9)


def test_one_valve_is_refused_in_one_line() -> None:
    p = TWO.p.copy()
    p[LINE_CONDUCTANCE] = 6e-8
    with pytest.raises(InputError, match=r"actuators\.feed \(='one valve'\) must be 'a valve each'"):
        build_chain(logged(Model(), rows=2000), replace(TWO, p=p))


# ---- what is named ---------------------------------------------------------------------------------------------------


def test_the_actuator_of_the_faulty_side_fails_alone() -> None:
    made = built(Model(side_b=Side(effects=FRICTION)))
    assert [x.stage for x in locate_stages(made.stages) if x.fails] == ["actuator_b"]


@pytest.mark.slow
def test_a_biased_lvdt_is_named_with_its_side_though_each_servo_hides_it() -> None:
    """A rigging offset of half the size strains the rings alike: how they turn with the stroke tells them apart."""
    said = found(build_chain(logged(Model(side_b=Side(effects=BIAS))), TWO))
    assert set(said) == {"actuator_a", "actuator_b"}
    for ((name, rivals),) in said.values():
        assert name == "side_b.lvdt_bias" and set(rivals) <= {"side_b.rigging_offset"}


@pytest.mark.slow
@pytest.mark.parametrize(("effect", "size"), [("rigging_offset", {"length": 0.5}), ("ring_stiffness", {"ratio": 0.3})])
def test_what_is_wrong_between_crank_and_ring_is_named_with_its_side(effect: str, size: dict[str, float]) -> None:
    """The sides differ by 1 % in flow gain: at equal strokes a soft point shows nothing."""
    a, b = (Side(parameters={"actuator.flow_gain": gain}) for gain in (0.151, 0.149))
    said = found(build_chain(logged(Model(side_a=a, side_b=b.model_copy(update={"effects": {effect: size}}))), TWO))
    assert {"actuator_a", "actuator_b"} <= said.keys()
    for names in said.values():
        assert [name for name, _ in names] == [f"side_b.{effect}"]
        assert set(names[0][1]) <= {f"side_a.{effect}"}


@pytest.mark.slow
def test_friction_of_one_side_is_that_sides_and_that_of_both_is_named_once() -> None:
    one = found(build_chain(logged(Model(side_a=Side(effects=FRICTION))), TWO))
    assert one == {"actuator_a": [("side_a.piston_friction", [])]}
    two = found(built(Model(effects=FRICTION), len(T)))
    assert two == {"actuator_a": [("piston_friction", [])], "actuator_b": [("piston_friction", [])]}
    unequal = Model(side_a=Side(effects=FRICTION), side_b=Side(effects={"piston_friction": {"force": 800.0}}))
    both = found(build_chain(logged(unequal), TWO))
    assert [name for names in both.values() for name, _ in names] == [
        "side_a.piston_friction",
        "side_b.piston_friction",
    ]


@pytest.mark.slow
def test_unequal_sides_within_their_tolerance_lack_nothing() -> None:
    parts = [
        Side(parameters={"actuator.flow_gain": g, "valve.bandwidth": w}) for g, w in ((0.1512, 60.6), (0.149, 59.5))
    ]
    assert not found(build_chain(logged(Model(side_a=parts[0], side_b=parts[1])), TWO))


def test_what_is_not_looked_for_is_not_looked_for_at_either_side() -> None:
    made = built(Model())
    for stage in without_laws(made.stages, ["lvdt_bias", "side_a.piston_friction"]):
        names = {e.name for e in stage.effects}
        assert not {"lvdt_bias", "side_a.lvdt_bias", "side_b.lvdt_bias", "side_a.piston_friction"} & names
        assert ("side_b.piston_friction" in names) == (stage.name == "actuator_b")


def answer(stage: str, name: str, low: float, high: float, nats: float, rivals: Sequence[str] = ()) -> SimpleNamespace:
    """What a stage says: an effect with its interval, and rivals of the size -1."""
    size = {"size": {"value": 0.5 * (low + high), "low": low, "high": high}}
    fits = {name: size, **{m: {"size": {"value": -1.0, "low": -1.1, "high": -0.9}} for m in rivals}}
    shares = dict.fromkeys((name, *rivals), 0.9 / (1 + len(rivals)))
    one = Found(name, shares[name], size, list(rivals), nats, fits=fits, probabilities=shares)
    return SimpleNamespace(stage=stage, effects=[one])


@pytest.mark.parametrize(
    ("said", "names"),
    [
        ([("a", "side_a.x", 1.0, 2.0, 9.0), ("b", "side_b.x", 1.5, 3.0, 8.0)], ["x", "x"]),
        ([("a", "side_a.x", 1.0, 2.0, 9.0), ("b", "side_b.x", 2.5, 3.0, 8.0)], ["side_a.x", "side_b.x"]),
        ([("a", "side_a.x", 1.0, 2.0, 9.0)], ["side_a.x"]),
        ([("a", "side_a.x", 1.0, 2.0, 9.0), ("b", "side_a.x", 1.0, 2.0, 8.0)], ["side_a.x", "side_a.x"]),
        (
            [("a", "side_a.x", 1.0, 2.0, 7.0, ["side_b.x"]), ("b", "side_b.x", -1.1, -0.9, 8.0, ["side_a.x"])],
            ["side_b.x", "side_b.x"],
        ),
        (
            [("a", "side_a.x", -1.1, -0.9, 9.0, ["side_b.x"]), ("c", "side_b.x", 0.5, 1.5, 7.0)],
            ["side_b.x", "side_b.x"],
        ),
    ],
)
def test_a_family_has_one_name_where_sizes_agree_or_nothing_tells(
    said: list[tuple[str, ...]], names: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(workflow, "parameters_of", lambda stage, fit, name: fit)
    results = [answer(*one) for one in said]  # type: ignore[arg-type]
    stages = {d.stage: SimpleNamespace(effect=lambda name: SimpleNamespace(family="x")) for d in results}
    workflow._join(stages, results)  # type: ignore[arg-type]
    found = [d.effects[0] for d in results]
    assert [f.effect for f in found] == names and all(f.effect in f.probabilities for f in found)
    assert all(f.effect not in f.rivals for f in found)
    if names == ["side_b.x", "side_b.x"]:
        assert found[0].rivals == ["side_a.x"] and found[0].parameters["size"]["value"] == -1.0


# ---- model files -----------------------------------------------------------------------------------------------------


def test_extend_writes_the_side_and_compare_takes_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log, model = str(tmp_path / "b.parquet"), str(tmp_path / "m.toml")
    write_log(log, logged(Model(side_b=Side(effects=FRICTION)), rows=2000).channels)
    plant = ["--plant", TABLE]
    assert main(["extend", log, *plant, "--effect", "side_b.piston_friction", "--out", model]) == 0
    made = load_model(model, TWO)
    assert made.side_b.effects["piston_friction"]["force"] == pytest.approx(1500.0, rel=0.2)
    assert not made.effects and not made.side_a.effects
    assert main(["locate", log, *plant]) == 1
    assert main(["locate", log, *plant, "--model", model]) == 0
    capsys.readouterr()
    assert main(["compare", log, *plant, "--model", model, "--json", "-"]) == 0
    rows = json.loads(capsys.readouterr().out)["stages"]
    assert {r["stage"] for r in rows} >= {"actuator_a", "actuator_b", "linkage"}


def test_what_both_have_is_fitted_at_each_side() -> None:
    made = built(Model(effects=FRICTION))
    model = extended(made, ["piston_friction"], Model(), "simulated").model
    assert model is not None and not model.effects
    for side in (model.side_a, model.side_b):
        assert side.effects["piston_friction"]["force"] == pytest.approx(1500.0, rel=0.2)
    alone = extended(made, ["lvdt_bias"], Model(), "simulated")
    assert [r.stage for r in alone.diagnosis.stages] == ["linkage"]


def test_a_model_of_one_side_is_part_of_the_machine_and_not_tried_again() -> None:
    have = Model(side_b=Side(effects=FRICTION))
    made = Machine(table=TABLE, model=have).bind(logged(have, rows=2000))
    assert "side_b.piston_friction" not in made.stage("actuator_b").index()
    assert "side_a.piston_friction" in made.stage("actuator_a").index()
    assert not any(x.fails for x in locate_stages(made.stages))


@pytest.mark.parametrize(
    ("name", "said"),
    [("side_b.aero_load", "aero_load is not of one of two actuators"), ("side_b.pot_bias", "pot_bias is not of one")],
)
def test_extend_refuses_what_is_not_of_one_side(name: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        extended(built(Model()), [name], Model(), "simulated")


def test_a_side_without_an_effect_of_the_library_is_unknown() -> None:
    known(["side_b.lvdt_bias", "lvdt_bias"])
    with pytest.raises(InputError, match=r"'side_b\.lvdt_bia' is not in the library"):
        known(["side_b.lvdt_bia"])


@pytest.mark.slow
def test_a_run_is_simulated_with_what_one_side_has_and_its_rival_is_refitted_at_that_side() -> None:
    profile = np.interp(np.arange(0.0, 40.0, 0.01), [5.0, 10.0, 20.0, 25.0, 35.0], [60.0, 95.0, 95.0, 60.0, 60.0])
    for truth, named, rival in (
        ({"side_b.lvdt_bias": BIAS["lvdt_bias"]}, "side_b.lvdt_bias", "side_b.piston_friction"),
        (FRICTION, "piston_friction", "side_b.lvdt_bias"),
    ):
        nats, spreads = divergence(profile, truth, "actuator_b", rival, named, plant=TWO)
        assert nats > 500.0 and spreads > 3.0, named


def test_the_machine_of_a_next_run_has_an_effect_and_not_its_rival(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of two that one log cannot tell apart either subsystem may name the other."""
    seen: list[object] = []
    monkeypatch.setattr(experiment, "profiles", lambda: {"one": np.zeros(10)})

    def divergence(profile: object, truth: object, *names: object) -> tuple[float, float]:
        seen.append((truth, names))
        return 1.0, 1.0

    monkeypatch.setattr(experiment, "divergence", divergence)
    bias, length = ("side_b.lvdt_bias", "bias", 0.5), ("side_b.rigging_offset", "length", 0.25)
    stages = [
        SimpleNamespace(stage=stage, effects=[SimpleNamespace(effect=e, rivals=[r[0]], parameters={n: {"value": v}})])
        for stage, (e, n, v), r in (("actuator_a", length, bias), ("actuator_b", bias, length))
    ]
    got = experiment.recommend(SimpleNamespace(stages=stages))
    assert got is not None and "To distinguish" not in got["text"]  # one nat is too few
    assert "separates side_b.lvdt_bias from side_b.rigging_offset, even" in got["text"]  # a pair is said once
    assert seen == [
        ({e: {n: v}}, (stage, rival, e, ()))
        for stage, (e, n, v), (rival, *_) in (("actuator_a", length, bias), ("actuator_b", bias, length))
    ]


@pytest.mark.slow
def test_a_fleet_has_the_size_that_each_side_of_its_machine_has(tmp_path: Path) -> None:
    pytest.importorskip("psutil", reason="the extra `fleet` is not installed")
    plant = {"files": {"plant": str(file_of(TABLE).resolve())}, "reading": {}}
    for name, model in (("both", Model(effects=FRICTION)), ("b", Model(side_b=Side(effects=FRICTION)))):
        write_log(tmp_path / f"{name}.parquet", logged(model).channels)
        answer = diagnose_log(str(tmp_path / f"{name}.parquet"), plant, str(tmp_path))["answer"]
        ((effect, stage, value),) = ((row["effect"], row["stage"], row["value"]) for row in answer["sizes"])
        assert effect == ("piston_friction" if name == "both" else "side_b.piston_friction")
        assert stage == "actuator_b" or name == "both"
        assert value == pytest.approx(1500.0, rel=0.2)
        assert {row["stage"] for row in answer["nominal"]} >= {"actuator_b"}
