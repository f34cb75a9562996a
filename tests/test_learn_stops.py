"""Laws of the vane chain that are a hysteresis: stops of a signal, in the loop, in the stages of the search, in the
file, and learned of a machine with another hysteresis.
"""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hil.logs import Channel, Log, write_log
from plant import Model, build_plant
from plant.curve import CRANK_ADDS, CURRENT_ADDS, begin, bend, follow, quantity_of
from plant.effects import N_STATE
from tests import rig
from tests.firmware_on_rig import firmware
from tests.test_learn_lags import TICK, chain_of, confirmed, left, run_of
from tests.test_learn_vanes import chain, columns, curved, law
from vaneloop.base.curve import POINTS
from vaneloop.base.errors import InputError
from vaneloop.base.hysteresis import RADII, slipped, weights_of
from vaneloop.cli.main import main
from vaneloop.identification.results import rms_of
from vaneloop.identification.settings import BEFORE_LOG
from vaneloop.identification.unmodelled.curve_choice import another_confirms
from vaneloop.identification.unmodelled.fitted_candidate import FittedCandidate
from vaneloop.identification.unmodelled.learning import CurveSearch
from vaneloop.identification.user_models.exogenous_regressors import forgotten, of_stops
from vaneloop.identification.vane_chain.candidates import LAGGED, SLIPS, VaneChainCandidates, with_laws
from vaneloop.identification.vane_chain.chain import build_chain
from vaneloop.identification.vane_chain.subsystem_data import Made

BUSHING = ("linkage.crank adds", "stops_of_x_lvdt", "tanh", -0.8, 1.5)  # takes up to 0.8 mm of the stroke
GIVE = 1.8  # mm
REACH = {"low": 0.0, "high": 24.0}


def ticks_of(model: Model, course: np.ndarray, site: int) -> np.ndarray:
    """What a model's curves at a site give when the current goes its ``course`` (mA), a value a tick."""
    p, s, out = build_plant(model=model).p, np.zeros((N_STATE, 1)), []
    begin(s, p, 0, 40.0)
    for k, i in enumerate(course):
        follow(s, p, 0, i * 1e-3, 0.0, 70.0, 70.0, 2.1e7, 40.0, (k + 1) * TICK)
        out.append(bend(s, p, 0, site))
    return np.array(out)


@pytest.mark.slow
@given(st.lists(st.floats(-20.0, 20.0), min_size=1, max_size=30))
def test_in_the_plant_stops_are_those_of_their_definition(course: list[float]) -> None:
    """Each is the way since rest, kept within its radius at every tick; weights are the slopes' differences."""
    bent = law("valve.current adds", "stops_of_i_cmd", "tanh", 0.5, 0.25, low=0.0, high=10.0)
    got = ticks_of(curved(bent), np.array(course), CURRENT_ADDS)
    radii, table = 10.0 * np.linspace(0.0, 1.0, RADII + 1) ** 2, np.linspace(0.0, 10.0, POINTS)
    slopes = np.append(np.diff(np.interp(radii, table, 0.5 * np.tanh(0.25 * table))) / np.diff(radii), 0.0)
    at, want = np.zeros(RADII), []
    for move in np.diff(course, prepend=0.0):
        at = np.clip(at + move, -radii[1:], radii[1:])
        want.append(1e-3 * float((slopes[:-1] - slopes[1:]) @ at))
    assert got == pytest.approx(np.array(want), rel=1e-9, abs=1e-12)


def test_a_first_move_gives_the_virgin_curve_and_the_way_back_twice_it_of_half_the_way() -> None:
    up = np.linspace(0.0, 8.0, 400)
    model = curved(law("valve.current adds", "stops_of_i_cmd", "line", 0.1, low=0.0, high=2.0))
    got = 1e3 * ticks_of(model, np.concatenate([up, up[::-1]]), CURRENT_ADDS)
    assert got[:400] == pytest.approx(0.1 * np.minimum(up, 2.0), abs=1e-6)  # one stop, which slips at 2 mA
    assert got[400:] == pytest.approx(0.2 - 0.1 * np.minimum(8.0 - up[::-1], 4.0), abs=1e-6)


@given(st.integers(0, 2**31))
def test_a_way_round_costs_energy_and_its_loop_closes(seed: int) -> None:
    """Whatever the course: back and forth twice more between the same ends, the second time is the first, and the work
    is not below 0 where weights are not.
    """
    rng = np.random.default_rng(seed)
    x = np.linspace(0.0, 1.0, 257)
    weights = weights_of(0.0, 5.0, np.sqrt(x) * rng.uniform(0.1, 3.0))
    assert weights.min() >= -1e-12
    ends = np.repeat(rng.uniform(-6.0, 6.0, (2, 1)), 3, axis=1).T.ravel()  # there and back, three times
    course = np.interp(0.05 * np.arange(1201), np.arange(0.0, 61.0, 10.0), np.append(0.0, ends))
    gives = slipped(course, 5.0, weights)
    first, second = gives[400:801], gives[800:]  # whole ways round, with the step that closes them
    assert second[1:-1] == pytest.approx(first[1:-1], abs=1e-9)
    assert np.sum(0.5 * (second[1:] + second[:-1]) * np.diff(course[800:])) >= -1e-9


@given(st.integers(0, 2**31))
def test_where_a_hysteresis_has_forgotten_what_was_before_the_log_it_is_what_it_is_from_rest(seed: int) -> None:
    """Whatever its channel did before. It is never sure of the last part of its height that wide stops give."""
    rng = np.random.default_rng(seed)
    before, log = (rng.uniform(-6.0, 6.0) + np.cumsum(0.3 * rng.standard_normal(400)) for _ in range(2))
    table = -np.tanh(np.linspace(0.0, 8.0, POINTS) * rng.uniform(0.3, 2.0))
    whole = np.concatenate([before, np.linspace(before[-1], log[0], 50), log])
    known, rest = forgotten(log, 8.0, table), of_stops(log, 0.0, 8.0, table)
    after = of_stops(whole, 0.0, 8.0, table)[-len(log) :]
    assert known.any() or np.ptp(log) < 16.0
    assert np.all(np.abs(after - rest)[known] < 2.0 * BEFORE_LOG * np.max(np.abs(table)) + 0.01)


def test_a_channel_that_has_hardly_moved_is_sure_of_nothing_and_one_that_went_everywhere_of_all_after_it() -> None:
    table = np.linspace(0.0, 1.0, POINTS)  # slips at 5 only
    assert not forgotten(np.sin(np.linspace(0.0, 20.0, 200)), 5.0, table).any()
    there = np.concatenate([np.linspace(0.0, 10.0, 101), np.zeros(50)])
    assert np.flatnonzero(forgotten(there, 5.0, table))[0] in (95, 96) and forgotten(there, 5.0, table)[100:].all()


def test_stops_of_nothing_change_no_bit() -> None:
    places = ("valve.current adds", "linkage.crank adds", "linkage.vgv1_ring adds", "engine.demand adds")
    of = ("i_cmd", "x_lvdt", "x_lvdt", "n_dem")
    nothing = [law(at, f"stops_of_{q}", "line", 0.0, **REACH) for at, q in zip(places, of, strict=True)]
    assert np.array_equal(columns(Model()), columns(curved(*nothing)), equal_nan=True)


def test_every_curve_has_its_own_stops() -> None:
    one, two = (law(f"{at} adds", "stops_of_i_cmd", "line", a, low=0.0, high=r)
                for at, a, r in (("valve.current", 0.1, 1.0), ("linkage.crank", 0.2, 5.0)))  # fmt: skip
    course = np.linspace(0.0, 3.0, 50)
    assert 1e3 * ticks_of(curved(one, two), course, CURRENT_ADDS)[-1] == pytest.approx(0.1)
    assert 1e3 * ticks_of(curved(one, two), course, CRANK_ADDS)[-1] == pytest.approx(0.6)


@pytest.mark.parametrize(
    ("place", "of", "stage"),
    [("linkage.crank", "x_lvdt", "linkage"), ("linkage.vgv1_ring", "x_lvdt", "linkage"),
     ("valve.current", "i_cmd", "actuator"), ("engine.demand", "n_dem", "engine")],
)  # fmt: skip
def test_loop_and_stage_say_the_same(place: str, of: str, stage: str) -> None:
    """In a log of the current nobody knows what the valve did before it: a fifth is left there."""
    reach = {"valve.current": 8.0, "engine.demand": 5.0}.get(place, 24.0)
    size = -0.2 if place.endswith("ring") else -0.8  # a ring that goes back when it is driven forth is none
    model = curved(law(f"{place} adds", f"stops_of_{of}", "tanh", size, 10.0 / reach, low=0.0, high=reach))
    run = run_of(model)
    without, with_it = (left(chain_of(run, m), stage) for m in (Model(), model))
    clean = left(chain_of(run_of(Model()), Model()), stage)
    assert without > 5.0 * clean and with_it < 1.2 * clean + (0.2 * without if of == "i_cmd" else 0.0)


def test_its_file_is_taken_and_another_log_confirms_its_scale(tmp_path) -> None:
    stage, plain, effect, theta = confirmed(curved(law(*BUSHING, **REACH)), tmp_path / "law.toml")
    rows = np.arange(1200, 2400)  # an excerpt knows what went before it
    assert isinstance(plain.made, Made)
    part = with_laws(plain.excerpt(rows), (), [effect], "loop")
    late = slice(600, None)  # where in their play the rings began is forgotten there
    assert part.run(theta)[:, :, late] == pytest.approx(stage.run(theta)[:, :, rows][:, :, late], abs=1e-4)


@pytest.mark.slow
def test_stops_are_tried_where_something_slips_and_of_what_drives_the_stage() -> None:
    _, whole = chain()
    found = set()
    for stage in whole.stages:
        for c in VaneChainCandidates(stage).candidates(stage.neutral()[: len(stage.parameters)]):
            if c.quantity.stops:
                q = quantity_of(c.quantity.name)
                assert q is not None and q.stops and not c.mean and c.how == "adds"
                assert SLIPS[c.at] in LAGGED[stage.name] and f"stops_of_{SLIPS[c.at]}" == c.quantity.name
                found.add(c.at)
    rings = {f"linkage.{v}_ring" for v in ("vigv", "vgv1", "vgv2")}
    assert found == {"valve.current", "linkage.crank", "linkage.ring", *rings}


def test_what_no_machine_slips_with_is_refused() -> None:
    for name in ("stops_of_time", "stops_of_oil", "stops_of_vgv7", "stops_of_n_r_lagged_by_1_s"):
        with pytest.raises(InputError, match="stops_of_SIGNAL"):
            build_plant(model=curved(law("linkage.crank adds", name, "line", 0.4, **REACH)))


def bushing_logs(*runs: tuple[int, float]) -> list[dict[str, Channel]]:
    """Logs of one rig whose crank has a bushing, by seed and seconds: six plays of the stroke, of half-widths r from
    0.25 to 8 mm, whose virgin curve is -give / 6 sum(min(x / r, 1)).
    """
    hidden = rig.Hidden("crank_bushing", {"give": 1e-3 * GIVE})
    logs = [rig.simulate(rig.manoeuvre(seed, s), firmware(), [hidden], seed=9, rate=100).log for seed, s in runs]
    return [{k: Channel(log["t"], v) for k, v in log.items() if k != "t"} for log in logs]


def true_bushing(x: np.ndarray) -> np.ndarray:
    widths = np.array([0.25, 0.5, 1.0, 2.0, 4.0, 8.0])
    return np.asarray(-GIVE / 6.0 * np.minimum(x[:, None] / widths, 1.0).sum(axis=1))


@pytest.mark.slow
def test_of_what_a_bushing_may_be_the_hysteresis_at_the_crank_is_best(monkeypatch) -> None:
    """Of what all rings may have of the stroke's hysteresis, direction and way since it turned; another amplitude
    confirms it.
    """
    every = VaneChainCandidates.candidates

    def some(self, theta):
        rivals = [f"linkage.ring.curve_of_{q}_x_lvdt" for q in ("direction_of", "distance_since_reversal_of")]
        return [c for c in every(self, theta) if c.name in (f"linkage.crank.curve_of_{BUSHING[1]}", *rivals)]

    monkeypatch.setattr(VaneChainCandidates, "candidates", some)
    (log,) = bushing_logs((51, 60.0))
    ground = VaneChainCandidates(build_chain(Log("rig", log)).stage("linkage"))
    fit = SimpleNamespace(theta=ground.whole.neutral(), effects=())
    d: Any = SimpleNamespace(base=fit, final=fit, verdict="unknown", effects=[], nearest=[])
    learner = CurveSearch(ground, d)
    before = FittedCandidate(learner.candidates[0], 0.0, learner.judge, learner.base, ())
    best = learner.finalists(before)[0]
    assert best.candidate.at == "linkage.crank"
    assert learner.allowed(before, best) and another_confirms(learner, before, best)
    # its first spline is wider than the bushing's first play
    assert rms_of(best.judge, best.fit) < 0.2 * rms_of(learner.judge, learner.base)
    table, amplitudes = best.table()
    assert table(amplitudes) == pytest.approx(true_bushing(best.candidate.grid), abs=0.12 * GIVE)  # with the play


@pytest.mark.slow
def test_the_law_of_a_bushing_lets_the_error_of_another_log_fall(tmp_path) -> None:
    for name, log in zip(("one", "two"), bushing_logs((51, 130.0), (52, 130.0)), strict=True):
        write_log(tmp_path / f"{name}.parquet", log)
    one, two, file = (str(tmp_path / n) for n in ("one.parquet", "two.parquet", "law.toml"))
    assert main(["learn", one, "--out", file, "--json", str(tmp_path / "l.json"), "--quiet"]) == 1
    (said,) = json.loads((tmp_path / "l.json").read_text())["laws"]
    assert said["effect"] == "linkage.crank.curve_of_stops_of_x_lvdt"
    assert said["error_after"] < 0.1 * said["error_before"]
    assert np.array(said["y"]) == pytest.approx(true_bushing(np.array(said["x"])), abs=0.12 * GIVE)

    def errors(*more: str) -> float:
        main(["compare", two, *more, "--json", str(tmp_path / "c.json"), "--quiet"])
        signals = json.loads((tmp_path / "c.json").read_text())["signals"]
        return max(
            s["rms"] / s["noise_floor"] for s in signals if (s["stage"], s["reference"]) == ("linkage", "measured")
        )

    better = str(tmp_path / "better.toml")  # the other machine has lengths and nulls of its own
    main(["extend", two, "--effect", file, "--out", better, "--quiet"])
    assert errors("--model", better) < 0.2 * errors()
