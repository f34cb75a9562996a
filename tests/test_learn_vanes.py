"""Laws that nobody listed in the vane chain: a curve does at each place what the library's effect does that it is,
in the loop and in the stages of the search; the file, and the command from a log to a law that another log confirms.
"""

from __future__ import annotations

import json
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from hil.logs import Channel, Log, read_log, write_log
from hil.loop.lockstep import Stimulus, lockstep
from plant import Model, build_plant, load_model, write_model
from plant.curve import PLACES, quantity_of
from plant.layout import MOST_CURVES
from plant.model import Learned
from tests import rig
from tests.conftest import quick_first
from tests.firmware_on_rig import firmware
from vaneloop.base.errors import InputError
from vaneloop.cli.main import main
from vaneloop.identification.selection.rules import SUITS_ALL, LogChanges
from vaneloop.identification.vane_chain.candidates import VaneChainCandidates, remade, reversals
from vaneloop.identification.vane_chain.chain import Chain, build_chain
from vaneloop.verbs.learn import learned

N = 3000
WIDE = {"low": 0.0, "high": 150.0}


def law(place: str, of: str, form: str, *values: float, low: float = -100.0, high: float = 200.0) -> Learned:
    at, how = place.rsplit(" ", 1)
    return Learned(how=how, at=at, of=of, low=low, high=high, form=form, values=list(values))


def curved(*laws: Learned) -> Model:
    names = [f"law {k}" for k in range(len(laws))]
    return Model(effects={n: {} for n in names}, curves=dict(zip(names, laws, strict=True)))


@lru_cache
def stimulus() -> Stimulus:
    t = np.arange(N // 10 + 1) * 0.01
    n_dem = 75.0 + 15.0 * np.sin(t * 2.1) + 5.0 * np.sin(t * 9.0)
    return Stimulus.of(n_dem, p_s=(21.0 + np.sin(t)) * 1e6, t_oil=45.0 + 10.0 * t)


def columns(model: Model, plant: str = "plant.toml") -> np.ndarray:
    run = lockstep(stimulus(), plant=build_plant(plant, model=model), seed=1, hashed=False)
    return np.column_stack(list(run.columns.values()))


# a curve, and the effect of the library that it is
SAME = {
    "null": (law("valve.current adds", "n_r", "constant", 0.7), {"valve_null_bias": {"bias": 0.7}}),
    "overlap": (
        law("valve.opening adds", "i_cmd", "limit", -1.0, 0.33, low=-3.0, high=3.0),
        {"valve_dead_band": {"half_width": 0.33}},
    ),
    "viscosity": (
        law("actuator.flow_gain times", "t_oil", "above", 0.004, 40.0, low=40.0, high=140.0),
        {"oil_viscosity": {"coefficient": 0.004}},
    ),
    "air load": (law("actuator.load adds", "n_r", "square", 0.3, **WIDE), {"aero_load": {"force": 3000.0}}),
    "lvdt": (law("sensors.lvdt adds", "time", "constant", 0.3), {"lvdt_bias": {"bias": 0.3}}),
    "lvdt gain": (law("sensors.lvdt times", "time", "constant", 0.02), {"lvdt_gain": {"factor": 1.02}}),
    "lag": (law("engine.lag times", "n_dem", "constant", 0.25), {"rotor_lag_error": {"lag": 0.3}}),
    "limit": (
        law("engine.acceleration times", "n_dem", "constant", -0.25),
        {"acceleration_limit_error": {"limit": -2.0}},
    ),
    "schedule": (law("controller.demand adds", "n_r", "constant", 0.4), {"schedule_error": {"offset": 0.4}}),
    "growth": (
        law("linkage.vgv1_ring adds", "t_oil", "above", 0.01, 40.0, low=40.0, high=140.0),
        None,
    ),
    "pot": (law("sensors.vgv2 adds", "p_s", "constant", 0.5), {"pot_bias": {"vgv2": 0.5}}),
    "pot gain": (law("sensors.vigv times", "p_s", "constant", 0.05), {"pot_gain": {"vigv": 1.05}}),
}  # fmt: skip


@pytest.mark.parametrize("what", [w for w, (_, effects) in SAME.items() if effects])
def test_in_the_loop_a_curve_is_the_effect_that_it_imitates(what: str) -> None:
    curve, effects = SAME[what]
    plain, ours, theirs = (columns(m) for m in (Model(), curved(curve), Model(effects=effects)))
    moved = np.nanmax(np.abs(theirs - plain), axis=0)
    late = np.nanmax(np.abs(np.diff(theirs[::1], axis=0)), axis=0)  # signals are those of the tick before
    off = np.nanmax(np.abs(ours - theirs), axis=0)
    assert np.nanmax(moved) > 0.0
    assert np.all(off <= 1e-9 + 0.02 * moved + 0.5 * late * (moved > 0.0))
    assert np.nansum(off) < 0.2 * np.nansum(moved)


def test_a_curve_of_nothing_changes_no_reading() -> None:
    """The long way round gives the short one's bits, as it does with neutral effects."""
    nothing = curved(*(law(f"{at}", "n_r", "constant", 0.0) for at in list(PLACES)[:MOST_CURVES]))
    assert np.array_equal(columns(Model()), columns(nothing), equal_nan=True)


@pytest.mark.parametrize("place", [k for k, p in PLACES.items() if p.vane in ("", "vigv", "vgv1", "vgv2")])
def test_every_place_acts_in_the_loop(place: str) -> None:
    size = {"-": 0.2, "mm": 0.5, "mA": 2.0, "N": 5e3, "deg": 1.0, "%": 3.0}[PLACES[place].unit]
    of = "n_dem" if PLACES[place].stages[0] in ("engine", "demand") else "t_oil"
    assert not np.array_equal(columns(Model()), columns(curved(law(place, of, "constant", size))), equal_nan=True)


def test_a_motor_has_curves_too() -> None:
    table = "plant_electromechanical.toml"
    ours = columns(curved(law("actuator.load adds", "n_r", "square", 0.1, **WIDE)), table)
    theirs = columns(Model(effects={"aero_load": {"force": 1000.0}}), table)
    plain = columns(Model(), table)
    assert np.nanstd(theirs - plain, axis=0)[-1] > 0.0  # the motor's current carries the load
    assert np.nanstd((ours - theirs)[:, -1]) < 0.05 * np.nanstd((theirs - plain)[:, -1])
    with pytest.raises(InputError, match="actuator.flow_gain"):
        columns(curved(law("actuator.flow_gain times", "t_oil", "line", 0.01)), table)


# ---- stages of the search


@lru_cache
def chain(model: Model | None = None):
    run = rig.simulate(rig.manoeuvre(5, 60.0), firmware(), seed=5, rate=100, randomised=False)
    channels = {k: Channel(run.log["t"], v) for k, v in run.log.items() if k != "t"}
    return Log("rig", channels), build_chain(Log("rig", channels))


@pytest.mark.parametrize("what", quick_first(SAME, 2))
def test_in_its_stage_a_curve_is_the_effect_that_it_imitates(what: str) -> None:
    curve, effects = SAME[what]
    log, plain = chain()
    stage = PLACES[f"{curve.at} {curve.how}"].stages[0]
    nominal = plain.stage(stage).run(plain.stage(stage).neutral()[None])[0]
    ours = build_chain(log, build_plant(model=curved(curve))).stage(stage)
    got = ours.run(ours.neutral()[None])[0]
    if effects is None:
        warm = np.interp(plain.t, log.channels["t_oil"].t, log.channels["t_oil"].values) - 40.0
        assert np.array_equal(got[0], nominal[0]) and np.std(got[1] - nominal[1]) > 0.1 * np.std(warm) * 0.01
        return
    theirs = build_chain(log, build_plant(model=Model(effects=effects)), present=tuple(effects)).stage(stage)
    want = theirs.run(theirs.neutral()[None])[0]
    moved, counts = np.abs(want - nominal).max(), np.isfinite(ours.measured)  # where the rings began is forgotten there
    assert moved > 0.0 and np.abs(got - want)[counts].max() < 0.03 * moved


def test_reversals_of_a_stroke() -> None:
    """Up 10 mm, down 5 mm, up again, at 10 mm/s."""
    t = np.arange(0.0, 2.5, 0.01)
    x = np.interp(t, [0.0, 1.0, 1.5, 2.5], [10.0, 20.0, 15.0, 25.0])
    r = reversals(t, x, 48.0)
    way, far, since = (r[f"{n}_of_x_lvdt"] for n in ("direction", "distance_since_reversal", "time_since_reversal"))
    assert way[80] == 1.0 and way[140] == -1.0 and way[200] == 1.0
    assert far[140] == pytest.approx(4.0, abs=0.3) and far[200] == pytest.approx(5.0, abs=0.3)
    assert since[140] == pytest.approx(0.4, abs=0.05) and since[200] == pytest.approx(0.5, abs=0.05)


def test_candidates_are_places_times_quantities_that_say_something() -> None:
    _, whole = chain()
    for stage in whole.stages:
        ground = VaneChainCandidates(stage)
        some = ground.candidates(stage.neutral()[: len(stage.parameters)])
        assert some and len({c.name for c in some}) == len(some)
        for c in some:
            assert stage.name in PLACES[f"{c.at} {c.how}"].stages and quantity_of(c.quantity.name)
        only = remade(stage, (), [(some[0].placed(), some[0].effect(1.0))])
        assert np.allclose(only.run(only.neutral()[None]), stage.run(stage.neutral()[None]), atol=1e-9)


# ---- the file


def test_a_law_file_is_read_as_it_was_written(tmp_path) -> None:
    model = curved(law("valve.current adds", "p_s", "line", 0.02))
    write_model(tmp_path / "m.toml", model)
    assert load_model(tmp_path / "m.toml") == model


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"at": "valve.curent"}, "valve.curent"), ({"how": "adds", "at": "engine.lag"}, "engine.lag"),
        ({"of": "oil"}, "'oil'"), ({"of": "vgv7"}, "vgv7"), ({"low": 5.0, "high": 5.0}, "low"),
        ({"form": "spiral"}, "spiral"),
        ({"form": "", "knots": [0.0, 1.0]}, "knots"), ({"values": [1.0, 2.0]}, "2 values"),
    ],
)  # fmt: skip
def test_a_law_that_cannot_be_is_refused_in_a_line(tmp_path, change, named) -> None:
    write_model(tmp_path / "m.toml", curved(law("valve.current adds", "p_s", "line", 0.02).model_copy(update=change)))
    with pytest.raises(InputError) as e:
        load_model(tmp_path / "m.toml")
    assert named in str(e.value) and "\n" not in str(e.value)


def test_no_more_curves_than_there_is_room_for(tmp_path) -> None:
    many = curved(*[law("valve.current adds", "p_s", "line", 0.02)] * (MOST_CURVES + 1))
    with pytest.raises(InputError, match=f"at most {MOST_CURVES}"):
        build_plant(model=many)


def test_a_log_without_the_quantity_is_refused(tmp_path) -> None:
    log, _ = chain()
    less = Log("rig", {k: c for k, c in log.channels.items() if k != "n_dem"})
    with pytest.raises(InputError, match="n_dem"):
        build_chain(less, build_plant(model=curved(law("engine.lag times", "n_dem", "constant", 0.1))))


# ---- the command


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """Two logs of one engine whose lag grows with its speed, which is no effect of the library."""
    folder = tmp_path_factory.mktemp("lag")
    hidden = rig.Hidden("speed_dependent_lag", {"slope": 0.012})
    for name, seed in (("one", 31), ("two", 32)):
        run = rig.simulate(rig.manoeuvre(seed, 100.0), firmware(), [hidden], seed=7, rate=100)
        write_log(folder / f"{name}.parquet", {k: Channel(run.log["t"], v) for k, v in run.log.items() if k != "t"})
    return folder


@pytest.mark.slow
def test_the_law_of_one_log_lets_the_error_of_another_fall(logs, capsys) -> None:
    one, two, file, better = (str(logs / n) for n in ("one.parquet", "two.parquet", "law.toml", "better.toml"))
    out, report = str(logs / "law.json"), str(logs / "law.html")
    assert main(["learn", one, "--out", file, "--report", report, "--json", out]) == 1
    said = json.loads((logs / "law.json").read_text())
    assert said["verdict"] == "learned" and [w["effect"] for w in said["laws"]] == ["engine.lag.gain_of_n_r"]
    assert said["laws"][0]["error_after"] < 1.2 < said["laws"][0]["error_before"]
    (line,) = [f["numbers"] for f in said["laws"][0]["formulas"] if f["form"] == "straight line"]
    # 0.012 (n_r - 70) of a lag that is itself known to 5 %
    assert line == {"a": pytest.approx(0.012, rel=0.1), "b": pytest.approx(70.0, abs=6.0)}
    assert "engine.lag" in (logs / "law.html").read_text()
    capsys.readouterr()
    page, parts = str(logs / "better.html"), ("--fit", ":60", "--test", "60:")
    main(
        [
            "extend",
            two,
            "--effect",
            file,
            *parts,
            "--out",
            better,
            "--report",
            page,
            "--json",
            str(logs / "tested.json"),
        ]
    )
    (tested,) = json.loads((logs / "tested.json").read_text())["tested"]
    assert tested["error_after"] < 0.4 * tested["error_before"]
    assert "engine.lag.gain_of_n_r" in (logs / "better.html").read_text()
    main(["extend", two, "--effect", file, "--out", better, "--json", str(logs / "better.json")])
    stage = json.loads((logs / "better.json").read_text())["waterfall"]["engine"]
    assert stage[-1]["noise_floors"] < 1.3 < 2.0 < stage[0]["noise_floors"]
    with_law, plain = (_errors(two, *more, out=logs / "c.json") for more in (("--model", better), ()))
    assert with_law["n_r"] < 0.5 * plain["n_r"]
    assert main(["locate", two, "--model", better, "--json", str(logs / "l.json")]) in (0, 1)


def _errors(log: str, *more: str, out) -> dict[str, float]:
    main(["compare", log, *more, "--json", str(out)])
    return {s["signal"]: s["rms"] for s in json.loads(out.read_text())["signals"] if s["reference"] == "measured"}


def test_nothing_missing_nothing_learned(tmp_path) -> None:
    run = rig.simulate(rig.manoeuvre(41, 60.0), firmware(), seed=8, rate=100)
    write_log(tmp_path / "l.parquet", {k: Channel(run.log["t"], v) for k, v in run.log.items() if k != "t"})
    assert main(["learn", str(tmp_path / "l.parquet"), "--json", str(tmp_path / "l.json")]) == 0
    assert json.loads((tmp_path / "l.json").read_text())["verdict"] == "none"
    assert read_log(tmp_path / "l.parquet")


def rig_chain(hidden: list[rig.Hidden], n_dem: np.ndarray | None = None, duration: float = 60.0) -> Chain:
    test = rig.manoeuvre(5, duration)
    run = rig.simulate(test if n_dem is None else replace(test, n_dem=n_dem), firmware(), hidden, seed=5, rate=100)
    return build_chain(Log("rig", {k: Channel(run.log["t"], v) for k, v in run.log.items() if k != "t"}))


@pytest.mark.slow
def test_of_a_reading_that_lacks_bits_the_step_is_learned_and_nothing_of_what_it_drives() -> None:
    """The controller sees the stairs, too: a gain of its current had been learned of them."""
    step = 0.1843
    said = learned(rig_chain([rig.Hidden("lvdt_lost_bits", {"step": 1e-3 * step})]), "rig", Model(), 1)
    assert said.verdict == "unknown" and not said.laws
    assert said.to_dict()["steps"]["x_lvdt"] == pytest.approx(step, rel=0.01)
    assert said.sentence().startswith("A reading lacks bits") and "0.184" in said.sentence()


def test_pieces_of_a_log_whose_stroke_hardly_moves_count_as_the_log_does() -> None:
    """Where it never crosses the play all of it counts; so it had been for the log, but not for pieces of it."""
    stage = rig_chain([], np.full_like(rig.manoeuvre(5, 60.0).n_dem, 75.0)).stage("linkage")
    part = stage.excerpt(np.arange(3000, 5000))
    assert np.isfinite(stage.measured[:, 3000:4990]).all()
    assert np.isfinite(part.measured[:, :1990]).all()


def test_a_curve_at_a_shared_place_is_held_against_the_other_subsystem() -> None:
    """What the linkage would put down to the LVDT moves the stroke that the actuator explains; what is at the ring does
    not.
    """
    stages = chain()[1].stages
    linkage = next(s for s in stages if s.name == "linkage")
    ground = VaneChainCandidates(linkage, others=[s for s in stages if s is not linkage])
    own = linkage.neutral()[: len(linkage.parameters)]
    found = {c.name: c for c in ground.candidates(own)}
    lvdt, ring = found["sensors.lvdt.curve_of_time"], found["linkage.ring.curve_of_x_lvdt"]
    for c, size, worse in ((lvdt, c_size := lvdt.size, True), (lvdt, 0.0, False), (ring, c_size, False)):
        curves = ((c.placed(), c.effect(1.0)),)
        theta = np.concatenate([own, np.full(len(curves[0][1].parameters), size)])
        assert ground.elsewhere(curves, theta).keys() == ({"the actuator subsystem"} if worse else set())
    steep = np.concatenate([own, np.full(len(lvdt.effect(1.0).parameters), 20.0 * lvdt.size)])
    change = ground.elsewhere(((lvdt.placed(), lvdt.effect(1.0)),), steep)
    case = LogChanges(change, frozenset(change))
    assert not SUITS_ALL.verdict(case).holds and case.objection().startswith("makes the actuator subsystem worse")
