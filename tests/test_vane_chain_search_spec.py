"""What the vane chain offers the search beside its library: curves at places, profiles of the next run; and how large a
line or a noise must be to count.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from controller import load_calibration
from controller.records import as_scalars
from hil.figures import noise_floor
from hil.logs import Channel, Log
from plant import Model, build_plant
from plant.curve import KNOWN, PLACES, QUANTITIES
from plant.effects import CURVES
from plant.layout import MOST_CURVES
from plant.model import Learned
from tests.small_logs import white
from vaneloop.base.hysteresis import slipped, weights_of
from vaneloop.base.vanes import VANES
from vaneloop.identification.least_squares.problem import LeastSquaresProblem
from vaneloop.identification.subsystem import Array, Effect, Parameter, Stage
from vaneloop.identification.vane_chain import experiment, hum
from vaneloop.identification.vane_chain.actuator import actuator_stage
from vaneloop.identification.vane_chain.candidates import (
    LAGGED,
    SLIPS,
    VaneChainCandidates,
    curve_effect,
    remade,
    reversals,
    without_laws,
)
from vaneloop.identification.vane_chain.current import _weights, other_current
from vaneloop.identification.vane_chain.demand import _direction_known
from vaneloop.identification.vane_chain.linkage import linkage_stage
from vaneloop.identification.vane_chain.parameters import declared, tables_of
from vaneloop.identification.vane_chain.resample import regimes_of
from vaneloop.identification.vane_chain.stationary_noise import Expected, _noise_in
from vaneloop.identification.vane_chain.subsystem_data import Driven, Made, excerpts

CALIBRATION, MACHINE = load_calibration(), build_plant()
DT = 0.01


# ---- profiles of the next run ----------------------------------------------------------------------------------------


def corners(name: str) -> list[tuple[float, float]]:
    """Where straight parts of a profile meet (s, %)."""
    table: dict[str, list[tuple[float, float]]] = {
        "slow ramp up and down over the whole range": [(0, 45), (3, 45), (60, 100), (63, 100), (120, 45)],
        "fast ramps over the whole range": [
            (0, 50), (3, 50), (11, 99), (14, 99), (22, 50), (25, 50), (33, 99), (41, 50), (60, 50)
        ],
        "dwells at 50, 80 and 99 %": [(0, 50), (30, 50), (36, 80), (66, 80), (70, 99), (100, 99), (106, 50)],
    }  # fmt: skip
    if name in table:
        return table[name]
    if name.startswith("slams"):  # four of 15 s in 120 s, each up and down within 0.2 s
        parts = [[(5.0, 55), (5.2, 98), (20.0, 98), (20.2, 55), (35.0, 55)] for _ in range(4)]
        return [(0.0, 55), *((30.0 * k + t, n) for k, part in enumerate(parts) for t, n in part)]
    if name.startswith("stairs"):  # a second up or down, then 6 s of rest
        levels = [60, 65, 70, 75, 80, 85, 90, 95, 99, 95, 90, 85, 80, 75, 70, 65, 60]
        steps = [(t, n) for k, n in enumerate(levels[1:]) for t, n in ((4 + 7 * k, levels[k]), (5 + 7 * k, n))]
        return [(0, 60), *steps]
    wide = [(2.0 + 4 * k, 80.0) for k in range(24)]  # every 4 s farther, up and down in turn
    turns = [(2.2 + 4 * k, 80.0 + (-1.0) ** (k + 1) * (1.5 + 0.1875 * k)) for k in range(24)]
    back = [(4.0 + 4 * k, 80.0) for k in range(24)]
    return [(0.0, 80.0), *sorted([*wide, *turns, *back])]


STRAIGHT = (
    "slow ramp up and down over the whole range", "fast ramps over the whole range", "slams between 55 and 98 %",
    "stairs of 5 % with dwells", "small reversals about 80 %", "dwells at 50, 80 and 99 %",
)  # fmt: skip


def made_anew(name: str) -> Array:
    """A profile of the bank, which is otherwise kept from the first time that it was asked for."""
    return experiment.profiles.__wrapped__()[name]


@pytest.mark.parametrize("name", STRAIGHT)
def test_a_profile_runs_straight_between_its_corners(name: str) -> None:
    profile = made_anew(name)
    t, n = np.array(corners(name), dtype=float).T
    assert len(profile) == round(100.0 * t[-1])
    assert profile == pytest.approx(np.interp(0.01 * np.arange(len(profile)), t, n), abs=1e-9)


@pytest.mark.parametrize(("name", "middle", "size", "low", "high"), [
    ("swept sine, 2 % about 82 %, 0.05 to 1.5 Hz", 82.0, 2.0, 0.05, 1.5),
    ("swept sine, 6 % about 80 %, 0.02 to 0.5 Hz", 80.0, 6.0, 0.02, 0.5),
])  # fmt: skip
def test_a_swept_sine_has_a_frequency_that_grows_evenly(
    name: str, middle: float, size: float, low: float, high: float
) -> None:
    profile = made_anew(name)
    t = 0.01 * np.arange(10_000)
    turns = low * t + 0.5 * (high - low) / 100.0 * t**2
    assert profile == pytest.approx(middle + size * np.sin(2.0 * np.pi * turns), abs=1e-9)


def test_oil_warms_up_in_a_simulated_run_and_the_machine_has_the_effects_of_the_truth(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Seen(Exception):
        pass

    def run(stimulus: Any, **more: Any) -> None:
        raise Seen(stimulus, more)

    monkeypatch.setattr(experiment, "lockstep", run)
    profile = np.full(9000, 70.0)
    with pytest.raises(Seen) as caught:
        experiment.divergence(profile, {"valve_null_bias": {"bias": 0.5}}, "actuator", "a", "b", seed=7)
    stimulus, more = caught.value.args
    rows = stimulus.rows
    warm = 40.0 + 30.0 * (1.0 - np.exp(-0.01 * np.arange(9000) / 60.0))  # half of it after 42 s
    assert any(np.allclose(rows[:, k], warm) for k in range(rows.shape[1]))
    assert any(np.array_equal(rows[:, k], profile) for k in range(rows.shape[1]))
    assert (more["seed"], more["hashed"], more["calibration"]) == (7, False, None)
    differs = np.flatnonzero((more["plant"].p != MACHINE.p).any(axis=1))
    assert 0.5e-3 in more["plant"].p[differs, 0] and len(differs) < 4  # and what follows from it


def test_columns_of_some_effects_stand_behind_the_parameters() -> None:
    p = Parameter("a", 0.0, "mm")
    effects = [Effect(n, (p,) * k, ((1.0,) * k,)) for n, k in (("one", 1), ("two", 2), ("three", 1), ("four", 3))]
    own = (Parameter("x", 0.0, "mm"), Parameter("y", 0.0, "mm"))
    stage = Stage("s", ("y",), ("mm",), own, tuple(effects), lambda t: t, np.arange(4.0), np.zeros((1, 4)))
    assert experiment._columns(stage, ("two", "four")) == [0, 1, 3, 4, 6, 7, 8]
    assert experiment._columns(stage, ()) == [0, 1]


@pytest.mark.parametrize(("nats", "spreads", "repeats"), [
    (24.0, 0.6, 1), (23.9, 9.0, 2), (99.0, 0.59, 2), (6.0, 9.0, 4), (5.9, 9.0, 0), (99.0, 0.3, 4), (99.0, 0.299, 0),
])  # fmt: skip
def test_a_profile_is_repeated_until_nats_and_spreads_decide_with_a_margin(
    monkeypatch: pytest.MonkeyPatch, nats: float, spreads: float, repeats: int
) -> None:
    """Nats grow with the runs, spreads with their root; twice 12 nats and 0.3 spreads decide, four times at most."""
    monkeypatch.setattr(experiment, "divergence", lambda *_, **__: (nats, spreads))
    monkeypatch.setattr(experiment, "profiles", lambda: {"a ramp": np.arange(300.0)})
    found = SimpleNamespace(effect="valve_lag", rivals=["lvdt_lag"], parameters={})
    got = experiment.recommend(SimpleNamespace(stages=[SimpleNamespace(stage="actuator", effects=[found])]))
    assert got is not None and got["separates"] == (repeats > 0) and got["repeats"] == max(repeats, 1)
    row = got["table"][0]
    assert (row["repeats"], row["nats"], row["spreads"]) == (repeats, nats, spreads)
    assert row["needed"] == pytest.approx(max(24.0 / nats, (0.6 / spreads) ** 2))
    assert row["by_pair"] == [["valve_lag", "lvdt_lag", nats]] and got["heads"]["repeats"] == "runs needed"
    many = max(repeats, 1)
    assert np.array_equal(got["inputs"]["n_dem"][1], np.tile(np.arange(300.0), many))
    assert got["t"] == pytest.approx(0.01 * np.arange(300 * many)) and got["score"] == pytest.approx(many * nats)
    if repeats:
        often = "" if repeats == 1 else f", {repeats} times over"
        assert got["text"] == (
            f"To distinguish valve_lag from lvdt_lag: a ramp{often}, {3 * repeats} s; expected log-likelihood ratio "
            f"{repeats * nats:.1f} for the closest pair."
        )
    else:
        assert got["text"] == (
            f"No profile of the bank separates valve_lag from lvdt_lag, even 4 times over. The best, a ramp, has a "
            f"log-likelihood ratio of {nats:.1f} a run, {spreads:.1f} standard deviations; 24 and 0.6 are required."
        )


def test_of_profiles_that_no_number_of_runs_helps_the_nearest_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    told = {"a": (-5.0, 0.0), "b": (0.5, 0.0), "c": (2.0, 0.01)}
    bank = {name: np.full(100, k) for k, name in enumerate(told)}
    monkeypatch.setattr(experiment, "profiles", lambda: bank)
    monkeypatch.setattr(experiment, "divergence", lambda profile, *_, **__: list(told.values())[int(profile[0])])
    found = SimpleNamespace(effect="valve_lag", rivals=["lvdt_lag"], parameters={})
    got = experiment.recommend(SimpleNamespace(stages=[SimpleNamespace(stage="actuator", effects=[found])]))
    assert got is not None and [row["profile"] for row in got["table"]] == ["c", "b", "a"]


# ---- curves at the places of a subsystem -----------------------------------------------------------------------------

PLACE = {f"{p.at} {p.how}": p for p in PLACES.values()}


def blank(**driven: Any) -> VaneChainCandidates:
    """One of no stage, for questions that need none."""
    source = object.__new__(VaneChainCandidates)
    source.driven = SimpleNamespace(machine=MACHINE, **driven)  # type: ignore[assignment]
    return source


def test_a_curve_is_in_usual_as_large_as_what_stands_at_its_place() -> None:
    size = blank()._size
    table = MACHINE.table.actuator
    most = float(table.area.value) * 21e6  # N: what the supply can push
    for place, error, wanted in (
        ("engine.demand adds", 9.0, 5.0), ("valve.current adds", 9.0, 1.0), ("valve.opening adds", 9.0, 1.0),
        ("actuator.load adds", 9.0, 0.2 * most), ("linkage.play adds", 9.0, 0.3), ("linkage.vgv1_play adds", 9.0, 0.3),
        ("sensors.lvdt adds", 0.049, 0.05), ("sensors.lvdt adds", 0.051, 0.051), ("linkage.crank adds", 0.7, 0.7),
        ("sensors.lvdt times", 9.0, 0.3), ("engine.lag times", 9.0, 0.3), ("linkage.vigv_ring adds", 0.2, 0.2),
    ):  # fmt: skip
        assert size(PLACE[place], error) == pytest.approx(wanted), place


def test_a_curve_that_says_nothing_of_its_own_is_not_offered() -> None:
    says: dict[str, dict[str, set[str]]] = {
        "demand": {"controller.demand adds": {"n_r", "n_dem", "t_oil", "p_s", "time"}},
        "engine": {"engine.lag times": {"n_r", "n_dem", "t_oil", "p_s", "time"}},
        "servo": {
            "servo.current adds": {*QUANTITIES} - {*VANES}, "servo.current times": {*QUANTITIES} - {*VANES, "i_cmd"},
        },
        "actuator": {
            "sensors.lvdt adds": {"time", "p_s"}, "valve.opening adds": {"i_cmd"},
            "actuator.load adds": {*QUANTITIES} - {*VANES, "x_dem"},
            "actuator.flow_gain times": {*QUANTITIES} - {*VANES, "x_dem"},
        },
        "linkage": {
            "linkage.ring adds": {*QUANTITIES} - {"i_cmd", "x_dem", "n_dem"},
            "sensors.lvdt times": {*QUANTITIES} - {"i_cmd", "x_dem", "n_dem", "x_lvdt"},
            "sensors.vigv times": {*QUANTITIES} - {"i_cmd", "x_dem", "n_dem", "vigv"},
            "sensors.vigv adds": {*QUANTITIES} - {"i_cmd", "x_dem", "n_dem"},
        },
    }  # fmt: skip
    idle = blank()._idle
    for stage, places in says.items():
        for place, quantities in places.items():
            assert {q for q in QUANTITIES if not idle(PLACE[place], q, stage)} == quantities, (stage, place)


def test_lags_of_a_channel_are_a_sixth_a_half_and_five_sixths_of_the_way_in_logarithms() -> None:
    t = DT * np.arange(2401)
    columns = {"n_r": 70.0 + 5.0 * np.sin(0.7 * t) + white(1, 2401), "t_oil": np.full(2401, 40.0)}
    driven = Driven(t, columns, MACHINE, CALIBRATION, (), np.ones(2401, dtype=bool), ())
    source = blank()
    source.driven = driven
    rows = np.ones(2401, dtype=bool)
    found = source._late(driven, "n_r", rows)
    shortest, longest = 0.03, 24.0 / 8.0
    wanted = [shortest * (longest / shortest) ** z for z in (1.0 / 6.0, 0.5, 5.0 / 6.0)]
    assert [q.name for q in found] == ["n_r_lagged_by_64600_us", "n_r_lagged_by_300_ms", "n_r_lagged_by_1390_ms"]
    assert wanted == pytest.approx([0.0646, 0.3, 1.39], rel=1e-2)
    assert all(q.unit == "%" and q.remembers for q in found)
    share = 1.0 - np.exp(-DT / 0.3)
    y = [columns["n_r"][0]]
    for v in columns["n_r"][1:]:
        y.append(y[-1] + share * (v - y[-1]))
    assert found[1].visited[500:] == pytest.approx(np.array(y)[500:], abs=0.15)
    assert source._late(driven, "t_oil", rows) == [] == source._late(driven, "vgv1", rows)
    # half of the shortest and twice the longest are the ends of what a log tells
    for times, there in ((0.24, True), (0.23, False), (92.0, True), (93.5, False)):
        assert (found[0].slower(times) is not None) == there, times
    # a lag that changes the channel by less than a hundredth of its spread is none
    slow = {"n_r": 70.0 + t, "t_oil": columns["t_oil"]}
    drifts = driven._replace(columns=slow)
    source.driven = drifts
    spread = np.std(t)
    told = [q.name for q in source._late(drifts, "n_r", rows)]
    assert ("n_r_lagged_by_64600_us" in told) == (np.std(np.minimum(t / 0.0646, 1.0)) * 0.0646 > 0.01 * spread)
    assert "n_r_lagged_by_1390_ms" in told


def test_stops_go_as_far_as_half_of_the_way_since_a_turn() -> None:
    t = DT * np.arange(2000)
    x = 20.0 + 6.0 * np.sin(0.9 * t)
    c = {"x_lvdt": x, "i_cmd": np.zeros(2000)}
    driven = Driven(t, c, MACHINE, CALIBRATION, (), np.ones(2000, dtype=bool), ())
    rows = t > 3.0
    q = blank()._stops(driven, "x_lvdt", rows)
    assert q is not None and (q.name, q.unit) == ("stops_of_x_lvdt", "mm") and q.stops
    way = 0.5 * reversals(t, x, 12.0)["distance_since_reversal_of_x_lvdt"][rows]
    assert len(q.visited) == rows.sum() and q.visited.max() == pytest.approx(6.0, abs=0.1)
    assert np.corrcoef(q.visited, way)[0, 1] > 0.98
    assert blank()._stops(driven, "i_cmd", rows) is None is blank()._stops(driven, "n_r", rows)


def rings_log() -> tuple[Array, dict[str, Array]]:
    n = 900
    t = DT * np.arange(n)
    whole = np.zeros(n, dtype=int)
    c = {
        "x_lvdt": 20.0 + 6.0 * np.sin(0.9 * t) + 1.5 * np.sin(2.6 * t), "n_r": 70.0 + 5.0 * np.sin(0.5 * t),
        "t_oil": np.full(n, 40.0), "p_s": np.full(n, 21.0), "i_cmd": 5.0 * np.cos(0.9 * t), "stretch": whole,
        "machine_spell": whole, "missing": np.zeros(n),
    }  # fmt: skip
    return t, c


def rings(outputs: tuple[str, ...], of: float = 0.02) -> Stage:
    t, c = rings_log()
    begin = linkage_stage(Driven(t, c | {v: np.zeros(len(t)) for v in outputs}, MACHINE, CALIBRATION, outputs,
                                 np.ones(len(t), dtype=bool), ()))  # fmt: skip
    angles = begin.run(begin.neutral()[None])[0] + of * white(3, len(outputs), len(t))
    full = 48.0
    driven = begin.made.driven._replace(  # type: ignore[attr-defined]
        columns=c | dict(zip(outputs, angles, strict=True)), turns=lambda: reversals(t, c["x_lvdt"], full)
    )
    stage = linkage_stage(driven)
    stage.floor = np.full(len(outputs), 0.01)
    return stage


def test_curves_are_offered_at_places_of_the_vanes_that_are_measured() -> None:
    source = VaneChainCandidates(rings(("vigv", "vgv2")))
    found = source.candidates(source.all.neutral()[: len(source.all.parameters)])
    at = {c.at for c in found}
    assert {"linkage.vigv_ring", "sensors.vgv2", "sensors.lvdt", "linkage.play"} <= at
    assert not any("vgv1" in a or "vgv3" in a for a in at)
    quantities = {c.quantity.name for c in found}
    assert not {"vgv1", "vgv3", "t_oil", "p_s", "n_dem"} & quantities and {"n_r", "time", "x_lvdt"} <= quantities
    assert source.measured == frozenset({"vigv", "vgv2"})
    for c in found:
        count = len(c.effect(1.0).parameters)
        assert c.quantity.stops or count <= (24 if c.quantity.name == "time" else 10), c.name
    most = {n: max(len(c.effect(1.0).parameters) for c in found if c.quantity.name == n) for n in ("time", "n_r")}
    assert most["time"] in (23, 24) and most["n_r"] in (9, 10)
    stops = {c.at for c in found if c.quantity.stops}
    assert stops == {a for a, channel in SLIPS.items() if channel == "x_lvdt" and a in at}
    lagged = {c.quantity.name.split("_lagged")[0] for c in found if "_lagged_by" in c.quantity.name}
    assert lagged == {c for c in LAGGED["linkage"] if c not in ("t_oil",)}


def test_no_curve_is_offered_where_the_machine_has_room_for_none() -> None:
    source = VaneChainCandidates(rings(("vigv",)))
    full = MACHINE.p.copy()
    full[CURVES] = MOST_CURVES
    source.driven = source.driven._replace(machine=SimpleNamespace(p=full))  # type: ignore[arg-type]
    assert source.candidates(source.all.neutral()[: len(source.all.parameters)]) == []


def test_a_usual_curve_moves_the_outputs_by_no_more_than_the_error_there_is() -> None:
    stage = rings(("vigv",))
    source = VaneChainCandidates(stage)
    theta = source.stage((), ()).neutral()
    found = source.candidates(theta[: len(source.all.parameters)])
    judge = LeastSquaresProblem(source.stage((), ()), source.floor)
    error = np.sqrt(np.sum(judge.errors(judge.fit((), theta, 1).theta[None]) ** 2) / judge.n)
    for at in ("linkage.ring", "sensors.vigv"):
        c = next(c for c in found if c.at == at and c.how == "adds" and not c.quantity.stops)
        with_it = LeastSquaresProblem(source.stage((), ((c.placed(), c.effect(1.0)),)), source.floor)
        thetas = np.repeat(with_it.stage.neutral()[None], 2, axis=0)
        thetas[1, len(theta)] = c.size
        still, by = with_it.errors(thetas)
        assert np.sqrt(np.sum((by - still) ** 2) / with_it.n) <= 1.02 * error


def fake(name: str, effects: tuple[Effect, ...]) -> Stage:
    """A stage made anew with fewer effects."""

    def make(driven: Any) -> Stage:
        few = tuple(e for e in effects if driven.laws is None or e.name in driven.laws)
        n = len(driven.t)
        stage = Stage(name, ("y",), ("mm",), (), few, lambda p: np.zeros((len(p), 1, n)), driven.t, np.zeros((1, n)))
        stage.made = Made(make, driven)
        return stage

    t = DT * np.arange(100)
    return make(Driven(t, {"y": t}, MACHINE, CALIBRATION, ("y",), np.ones(100, dtype=bool), ()))


def effect(name: str, family: str = "") -> Effect:
    return Effect(name, (Parameter("size", 0.0, "mm"),), ((1.0,),), family=family)


def test_a_stage_made_anew_keeps_its_noise_and_its_conditions() -> None:
    stage = fake("s", (effect("one"), effect("two")))
    said = {
        "floor": np.array([0.1]), "quiet": np.array([0.2]), "noise": lambda t, e: 1.0, "raster_error": np.array([0.3]),
        "lost": np.ones((1, 1, 100)), "memory": 7.0, "regimes": {"time": stage.t}, "regime_units": {"time": "s"},
        "grain": 0.5,
    }  # fmt: skip
    for name, value in said.items():
        setattr(stage, name, value)
    again = remade(stage, ("two",), ())
    assert [e.name for e in again.effects] == ["two"] and again.made.driven.again  # type: ignore[attr-defined]
    assert all(getattr(again, name) is value for name, value in said.items())
    assert not stage.made.driven.again and len(stage.effects) == 2  # type: ignore[attr-defined]


def test_an_excerpt_keeps_the_noise_of_the_whole_and_what_its_rows_lose() -> None:
    stage = fake("s", (effect("one"),))
    assert isinstance(stage.made, Made)
    make, driven = stage.made
    stage.floor, stage.quiet, stage.noise = np.array([0.1]), np.array([0.2]), lambda t, e: 1.0
    stage.raster_error, stage.memory, stage.lost = np.array([0.3]), 7.0, white(1, 2, 1, 100)
    at = np.r_[10:40, 60:90]
    part = excerpts(make, driven, stage, lambda rows: rows % 2 == 0)(at)
    assert np.array_equal(part.t, stage.t[at]) and part.lost is not None
    assert np.array_equal(part.lost, stage.lost[..., at]) and part.memory == 7.0
    assert all(getattr(part, n) is getattr(stage, n) for n in ("floor", "quiet", "noise", "raster_error"))
    inner = part.made.driven  # type: ignore[attr-defined]
    assert inner.again and np.array_equal(inner.run, at % 2 == 0) and np.array_equal(inner.columns["y"], stage.t[at])
    stage.lost = None
    assert excerpts(make, driven, stage, lambda rows: rows >= 0)(at).lost is None


def test_a_law_that_is_not_given_is_not_given_to_either_side() -> None:
    own, other = effect("side_a.lvdt_bias", "lvdt_bias"), effect("side_b.lvdt_bias", "lvdt_bias")
    stages = [fake("a", (own, other, effect("lag"))), fake("b", (effect("lag"),)), fake("c", ())]
    rest = without_laws(stages, ("lvdt_bias",))
    assert [[e.name for e in s.effects] for s in rest] == [["lag"], ["lag"], []]
    assert rest[1] is stages[1] and rest[2] is stages[2]
    one = without_laws(stages, ("side_b.lvdt_bias",))
    assert [e.name for e in one[0].effects] == ["side_a.lvdt_bias", "lag"]


# ---- quantities that curves are of -----------------------------------------------------------------------------------


def learned(at: str, how: str, of: str, low: float, high: float, *values: float) -> Learned:
    return Learned(how=how, at=at, of=of, low=low, high=high, values=list(values), knots=[low] * 4 + [high] * 4)


def test_tables_of_curves_are_those_of_their_own_columns() -> None:
    one = curve_effect("one", learned("linkage.ring", "adds", "x_lvdt", 2.0, 40.0, 0.1, 0.1, 0.1, 0.1))
    two = curve_effect("two", learned("sensors.lvdt", "adds", "n_r", 0.0, 100.0, 0.5, 0.5, 0.5, 0.5))
    t, c = rings_log()
    driven = Driven(t, c, MACHINE, CALIBRATION, (), np.ones(len(t), dtype=bool), (), curves=(one, two))
    thetas = np.array([[9.0, 1.0, 0.0], [9.0, 2.0, 3.0]])
    assert [placed.neutral.tolist() for placed, _ in (one, two)] == [[0.0], [0.0]]
    (place, curve, tables), (other, _, last) = tables_of(driven, thetas)
    assert (place.at, other.at) == ("linkage.ring", "sensors.lvdt") and curve is one[0].curve
    assert tables == pytest.approx(np.broadcast_to([0.1, 0.2], tables.shape))
    assert last == pytest.approx(np.broadcast_to([0.0, 1.5], last.shape))
    assert tables_of(driven._replace(curves=()), thetas) == []


def test_a_machine_s_hysteresis_slips_by_its_own_channel_in_every_lane() -> None:
    law = learned("linkage.ring", "adds", "stops_of_x_lvdt", 0.0, 10.0, 0.0, 0.4, 0.6, 0.7)
    machine = Model(curves={"law": law}, effects={"law": {}}).plant(MACHINE)
    t, c = rings_log()
    driven = Driven(t, c, machine, CALIBRATION, (), np.ones(len(t), dtype=bool), ())
    signals = driven.signals()
    lanes = np.repeat(machine.p[:, :1], 3, axis=1)
    given = driven.slipping(signals, lanes)
    assert given.shape == (KNOWN + 3, len(t)) and np.array_equal(given[:KNOWN], signals[:KNOWN], equal_nan=True)
    table = law.table()(np.array(law.values))
    wanted = slipped(1e-3 * c["x_lvdt"], 0.01, np.ascontiguousarray(weights_of(0.0, 0.01, np.asarray(table)).ravel()))
    assert np.corrcoef(given[KNOWN], wanted)[0, 1] == pytest.approx(1.0, abs=1e-6)
    assert np.array_equal(given[KNOWN], given[KNOWN + 2])
    plain = Driven(t, c, MACHINE, CALIBRATION, (), np.ones(len(t), dtype=bool), ())
    assert plain.slipping(signals, MACHINE.p) is signals


def test_a_current_s_ticks_dither_its_hysteresis() -> None:
    law = learned("valve.current", "adds", "stops_of_i_cmd", 0.0, 10.0, 0.0, 0.4, 0.6, 0.7)
    machine = Model(curves={"law": law}, effects={"law": {}}).plant(MACHINE)
    t, c = rings_log()
    driven = Driven(t, c, machine, CALIBRATION, (), np.ones(len(t), dtype=bool), ())
    by_rows = driven.slipping(driven.signals(), machine.p)[KNOWN]
    same = driven._replace(columns=c | {"ticks": np.repeat(c["i_cmd"][:, None], 10, axis=1)})
    assert same.slipping(same.signals(), machine.p)[KNOWN] == pytest.approx(by_rows, abs=1e-12)
    shaken = c["i_cmd"][:, None] + 12.0 * np.resize([1.0, -1.0], 10)[None]
    dithered = driven._replace(columns=c | {"ticks": shaken}).slipping(driven.signals(), machine.p)[KNOWN]

    def lost(h: Array) -> float:  # what a way back and forth takes
        i = 1e-3 * c["i_cmd"]
        return abs(float(np.sum(0.5 * (h[1:] + h[:-1]) * np.diff(i))))

    assert lost(dithered) < 0.7 * lost(by_rows)
    # an excerpt slips as the whole does
    at = np.r_[300:500, 600:800]
    part = driven.at(at, {k: v[at] for k, v in c.items()}, np.ones(len(at), dtype=bool))
    assert part.slipping(part.signals(), machine.p)[KNOWN] == pytest.approx(by_rows[at])


# ---- how much is enough ----------------------------------------------------------------------------------------------


def hummed(size: float, hz: float = 13.37, noise: float = 1.0, rows: int = 4000) -> list[Channel]:
    t = 5.0 + DT * np.arange(rows)
    return [Channel(t, noise * white(k, rows) + size * np.sin(2.0 * np.pi * hz * t + k)) for k in range(3)]


def test_a_line_counts_that_noise_has_once_in_a_million_logs() -> None:
    """The power of noise in a line is exponential: of 4,000 lines none is above this but by that chance."""
    quiet = [Channel(5.0 + DT * np.arange(4000), np.zeros(4000))]

    def power(size: float) -> float:
        least = [hum._power(np.append(np.diff(c.values, 3), [0.0] * 3)) for c in hummed(size)]
        return float(np.min(least, axis=0)[4:].max())

    low, high = 0.0, 2.0
    wanted = float(np.log(4000 / 1e-6) / np.log(2.0))
    for _ in range(40):
        size = 0.5 * (low + high)
        low, high = (size, high) if power(size) < wanted else (low, size)
    assert power(1.004 * high) > wanted > power(0.996 * high)
    assert hum._common_line(hummed(1.003 * high), quiet, DT) is not None
    assert hum._common_line(hummed(0.997 * high), quiet, DT) is None


@pytest.mark.parametrize(("periods", "told"), [(2, False), (6, True)])
def test_a_line_of_a_few_periods_is_a_drift(periods: int, told: bool) -> None:
    slow = hummed(1.0, periods / 40.0, 1e-9)
    quiet = [Channel(slow[0].t, np.zeros(4000))]
    assert (hum._common_line(slow, quiet, DT) is not None) == told


def test_of_many_lines_four_are_taken_out() -> None:
    t = DT * np.arange(4000)
    lines = (7.3, 11.9, 17.1, 23.3, 31.7, 41.9)
    made = {}
    for k, name in enumerate(("n_r", "x_lvdt", "vigv")):
        hums = sum(np.sin(2.0 * np.pi * hz * t + k + hz) for hz in lines)
        made[name] = Channel(t, 20.0 + white(k, 4000) * 0.1 + hums)
    log = hum.without_hum(Log("a.csv", {**made, "n_dem": Channel(t, np.full(4000, 60.0))}))
    assert len(log.notes) == 4
    told = sorted(float(str(n).split("a line at ")[1].split(" Hz")[0]) for n in log.notes)
    assert all(min(abs(hz - line) for line in lines) < 0.05 for hz in told) and len({*told}) == 4


def test_the_direction_is_known_where_the_past_of_the_demand_cannot_turn_it() -> None:
    """From nothing to all of ``trend_change`` the demand may have come back before the log began."""
    change = CALIBRATION.scalars.trend_change
    frames = np.arange(1500)
    for falls, counts in ((0.0, True), (0.3, False), (2.0, True)):
        n = 70.0 - falls * change * np.clip((frames - 100) / 50.0, 0.0, 1.0)
        known = _direction_known(n, CALIBRATION)
        assert known[:90].all() and known[-1] == counts, falls
        if falls == 0.3:
            assert not known[600:].any()
    as_it_was = as_scalars(CALIBRATION.k)
    assert as_it_was.trend_change == change


ROWS = 20_000
T = DT * np.arange(ROWS)
SPEED = np.interp(T % 20.0, [0.0, 4.0, 5.0, 9.0, 10.0, 14.0, 15.0, 20.0], [0.0, 0.0, 3.0, 3.0, 0.0, 0.0, -3.0, -3.0])


def said(error: Array, output: Array, made: Array | float = 0.0, window: float | None = None) -> Expected | None:
    """What is said of an error beyond a floor of 1, of an output that was logged so."""
    regimes = {"time": T, "stroke speed": SPEED, "direction": np.sign(SPEED)}
    stage = Stage("s", ("y",), ("mm",), (), (), lambda p: np.zeros((len(p), 1, ROWS)), T, error[None], window=window,
                  regimes=regimes, floor=np.ones(1), memory=10.0)  # fmt: skip
    judge = LeastSquaresProblem(stage, np.ones(1))
    e = judge.errors(stage.neutral()[None])[0, 0]
    return _noise_in(judge, 0, e, np.broadcast_to(made, (ROWS,)), output, np.ones(ROWS))


@pytest.mark.parametrize(("times", "noise"), [(1.7, True), (2.6, False)])
def test_noise_is_at_most_twice_what_the_output_shows_where_it_is_quiet(times: float, noise: bool) -> None:
    error = 2.0 * white(1, ROWS)
    found = said(error, np.cumsum(SPEED) * DT + error / times)
    assert (found is not None) == noise
    if found is not None:
        assert found.size == pytest.approx(2.0, rel=0.02) and found.share == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize(("times", "noise"), [(1.7, True), (2.6, False)])
def test_a_channel_s_noise_may_be_twice_what_was_seen_of_it(times: float, noise: bool) -> None:
    error = 2.0 * white(1, ROWS)
    found = said(error, np.cumsum(SPEED) * DT, made=4.0 / times**2)
    assert (found is not None) == noise
    if found is not None:
        assert found.share == pytest.approx(times**2, rel=0.05)


def test_an_error_within_the_floor_s_own_doubt_is_noise_of_that_floor() -> None:
    white_one = white(2, ROWS)
    white_one /= np.sqrt(np.mean(white_one**2))
    quiet = np.cumsum(SPEED) * DT
    assert said(1.0095 * white_one, quiet) == Expected(1.0, 0.0)
    assert said(1.0105 * white_one, quiet) is None  # and beyond it, nothing that the output shows
    assert said(white_one, np.zeros(ROWS), window=1.0) == Expected(1.0, 0.0)


def test_a_line_of_a_quarter_of_the_excess_may_be_chance_and_of_most_of_it_has_a_cause() -> None:
    base = 2.0 * white(5, ROWS)
    for size, noise in ((0.5, True), (3.0, False)):
        error = base + size * np.sin(2.0 * np.pi * 7.3 * T)
        assert (said(error, np.cumsum(SPEED) * DT + error) is not None) == noise, size
    # a constant in the error is no line, but a drift to one side
    assert said(base + 2.5, np.cumsum(SPEED) * DT + base) is None


@pytest.mark.parametrize("start", [0.0, 2000.0])
@pytest.mark.parametrize("bins", [0.0, 1.6, -1.6])
def test_a_line_is_found_within_two_bins_of_where_another_channel_has_it(start: float, bins: float) -> None:
    t = start + DT * np.arange(4000)
    line = 2.0 * np.sin(2.0 * np.pi * 13.37 * (t - start) + 0.7)
    found = hum._line(Channel(t, 20.0 + 0.05 * white(1, 4000) + line), 13.37 + bins / 40.0, DT)
    assert np.std(found - line) < 0.02


def test_a_common_line_is_a_multiple_of_what_the_log_s_length_resolves() -> None:
    t = 5.0 + DT * np.arange(4000)

    def of(channels: list[tuple[int, int]], hz: float = 13.37) -> float | None:
        made = [Channel(t[a:b], white(k, b - a) + 2.0 * np.sin(2.0 * np.pi * hz * t[a:b] + k))
                for k, (a, b) in enumerate(channels)]  # fmt: skip
        return hum._common_line(made, [Channel(t, np.zeros(4000))], DT)

    whole = of([(0, 4000), (0, 4000)])
    assert whole is not None and whole * 40.0 == pytest.approx(round(whole * 40.0), abs=1e-6)
    # a channel that begins later and one that ends earlier stand where they are on the whole
    parts = of([(0, 3000), (1000, 4000)])
    assert parts is not None and parts * 40.0 == pytest.approx(round(parts * 40.0), abs=1e-6)
    assert abs(parts - 13.37) < 1.01 / 40.0 and abs(whole - 13.37) < 1.01 / 40.0


def test_a_command_that_has_the_line_too_is_held_between_its_frames() -> None:
    """A demand of every 50 ms that swings: what it makes swing is no hum, at whatever time its frames come."""
    t = 5.0 + DT * np.arange(4000)
    channels = [Channel(t, white(k, 4000) + 2.0 * np.sin(2.0 * np.pi * 3.3 * t + k)) for k in range(3)]
    slow = t[::5] + 0.004
    swings = Channel(slow, 60.0 + np.sin(2.0 * np.pi * 3.3 * slow))
    assert hum._common_line(channels, [Channel(slow, 60.0 + 0.0 * slow)], DT) is not None
    assert hum._common_line(channels, [swings], DT) is None
    assert hum._common_line(channels, [Channel(t, np.zeros(4000)), swings], DT) is None


def test_a_shape_that_few_logs_show_is_known_to_half_of_its_neutral_value() -> None:
    t, c = rings_log()
    driven = Driven(t, c, MACHINE, CALIBRATION, (), np.ones(len(t), dtype=bool), ())
    effects = [e for stage in ("actuator", "linkage", "demand") for e in declared(stage, driven)[1]]
    drag = [p for e in effects for p in e.parameters if p.name == "drag"]
    assert drag and all(p.tolerance == 0.5 * p.value > 0.0 for p in drag)
    assert all(p.tolerance == 0.0 for e in effects for p in e.parameters if p.name != "drag")
    shapes = {p.name for e in effects for p in e.parameters if p.shape}
    assert shapes <= {"speed", "distance", "spread", "phase", "roundness"} and "phase" in shapes
    started = {p.name: e.starts[0][k] for e in effects for k, p in enumerate(e.parameters) if p.shape}
    assert {n: started[n] for n in started if n in ("speed", "distance", "spread")} == {
        n: v for n, v in (("speed", 5.0), ("distance", 0.3), ("spread", 0.6)) if n in started
    }


def test_a_slow_potentiometer_is_as_slow_in_slow_rows() -> None:
    """A lag of 0.15 s in rows of 50 ms, against rows of 10 ms."""
    out = {}
    for dt, n in ((0.01, 3000), (0.05, 600)):
        t = dt * np.arange(n)
        whole = np.zeros(n, dtype=int)
        c = {"x_lvdt": 20.0 + 6.0 * np.sin(0.9 * t), "t_oil": np.full(n, 40.0), "machine_spell": whole,
             "stretch": whole, "missing": np.zeros(n), "vigv": np.zeros(n)}  # fmt: skip
        stage = linkage_stage(Driven(t, c, MACHINE, CALIBRATION, ("vigv",), np.ones(n, dtype=bool), ()))
        theta = stage.neutral()
        lag = stage.index()["pot_lag"]
        theta[lag] = 1e3 * 0.15 if stage.effect("pot_lag").parameters[0].unit == "ms" else 0.15
        out[dt] = stage.run(np.array([stage.neutral(), theta]))[:, 0]
    fine, slow = out[0.01][:, ::5], out[0.05]
    assert slow[0, 100:] == pytest.approx(fine[0, 100:], abs=0.02)
    assert np.abs(fine[1] - fine[0])[100:].max() > 0.3 and slow[1, 100:] == pytest.approx(fine[1, 100:], abs=0.03)


def other_subsystem(error: float, of: str = "n_r") -> Stage:
    """A subsystem in which curves act by their scale times a swing, and whose error is so many noise floors."""
    t = DT * np.arange(1200)
    swing, left = 3.0 * np.sin(1.3 * t), error * white(4, 1200)

    def make(driven: Driven) -> Stage:
        effects = tuple(e for _, e in driven.curves)

        def run(thetas: Array) -> Array:
            return np.array([[(theta[-1] * swing if effects else 0.0 * swing)] for theta in thetas])

        stage = Stage("linkage", ("y",), ("mm",), (), effects, run, driven.t, left[None])
        stage.made = Made(make, driven)
        return stage

    stage = make(Driven(t, {"y": left, of: t}, MACHINE, CALIBRATION, ("y",), np.ones(1200, dtype=bool), ()))
    stage.floor = np.ones(1)
    return stage


@pytest.mark.parametrize("error", [0.5, 4.0])
def test_what_a_curve_does_elsewhere_is_the_log_of_the_errors_that_are_at_least_the_noise(error: float) -> None:
    source = blank()
    source.others, source.left = [other_subsystem(error)], {}
    law = curve_effect("law", learned("sensors.lvdt", "adds", "n_r", 0.0, 100.0, 0.5, 0.5, 0.5, 0.5))
    for scale in (0.2, 3.0):
        (said,) = source.elsewhere([law], np.array([7.0, scale])).items()
        left = error * np.sqrt(np.mean(white(4, 1200) ** 2))
        with_it = np.hypot(left, np.sqrt(4.5) * scale)
        assert said[0] == "the linkage subsystem"
        assert said[1] == pytest.approx(np.log(max(with_it, 1.0) / max(left, 1.0)), abs=0.02)
    assert source.left == {"linkage": pytest.approx(error, rel=0.05)}
    assert source.elsewhere([law], np.array([7.0, 0.0])) == {}  # a scale of 0 moves nothing
    source.others = [other_subsystem(error, "p_s")]
    assert source.elsewhere([law], np.array([7.0, 3.0])) == {}  # nobody knows the quantity there


def test_errors_are_told_of_the_log_and_of_a_test_log_in_noise_floors() -> None:
    stage, test = rings(("vigv",), 0.02), rings(("vigv",), 0.05)
    source = VaneChainCandidates(stage, np.array([0.01]), test)
    assert source.tests == frozenset({"test"}) and source.whole is source.small is source.all is stage
    errors = source.errors((), source.stage((), ()).neutral())
    assert list(errors) == ["log", "test"]
    for name, size in (("log", 2.0), ("test", 5.0)):
        assert np.nanstd(errors[name]) == pytest.approx(size, rel=0.1), name
    assert VaneChainCandidates(stage).floor is stage.floor
    (course,) = source.courses((), source.stage((), ()).neutral())
    own = (stage.run(stage.neutral()[None])[0] - stage.measured) / 0.01
    assert course.error == pytest.approx(np.where(np.isfinite(own), own, 0.0)) and course.t is stage.t
    assert len(course.drivers) == 3  # speed, pressure and oil: what the machine makes drives nothing
    some: Any = SimpleNamespace(
        quantity=SimpleNamespace(stops=False, name="n_r"), basis=SimpleNamespace(reaches=lambda v: v > 70.0)
    )
    assert list(source.within(some)) == ["test"]
    assert np.array_equal(source.within(some)["test"], rings_log()[1]["n_r"] > 70.0)
    assert source.in_grains(0.5) is None and source.whole.grain == 0.5 == source.small.grain
    assert not source.surfaces and source.noise_known  # a curve is rows of the machine's parameters, of one signal


# ---- documented thresholds where they act ----------------------------------------------------------------------------


def long_stage(n: int, window: float | None) -> Stage:
    def of(at: Array) -> Stage:
        t = DT * at
        stage = Stage("s", ("y",), ("mm",), (), (), lambda p: np.zeros((len(p), 1, len(t))), t, white(1, n)[at][None],
                      window=window, memory=10.0)  # fmt: skip
        stage.floor, stage.excerpt, stage.made = np.ones(1), of, Made(lambda driven: stage, SimpleNamespace())  # type: ignore[arg-type]
        return stage

    return of(np.arange(n))


@pytest.mark.parametrize(("window", "piece", "short"), [(1.0, 1000, 500), (None, 2000, 1000)])
def test_logs_of_more_than_two_minutes_are_learned_on_pieces(window: float | None, piece: int, short: int) -> None:
    """12,000 samples are learned on, 4,000 rank the candidates, in pieces that are longer where a model runs freely."""
    whole = VaneChainCandidates(long_stage(12_000, window))
    assert whole.whole is whole.all and not whole.tests and whole.small is not whole.whole
    source = VaneChainCandidates(long_stage(30_000, window))
    assert source.tests == {"rest of the log"} and VaneChainCandidates(long_stage(12_100, window)).tests
    for part, many, long in ((source.whole, 12_000, piece), (source.small, 4_000, short)):
        rows = np.rint(part.t / DT).astype(int)
        pieces = np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1)
        assert len(rows) == pytest.approx(many, abs=long - 1) and all(len(p) % long == 0 for p in pieces)
        assert any(len(p) == long for p in pieces)
    few = VaneChainCandidates(long_stage(4_000, window))
    assert few.small is few.whole is few.all


@pytest.mark.parametrize(("rise", "told"), [(1.33, False), (1.08, True)])
def test_a_lag_counts_that_changes_its_channel_by_a_hundredth_of_its_spread(rise: float, told: bool) -> None:
    """A rise of so many % a second, which a lag only moves, and a swing of 1 %, which it makes late."""
    t = DT * np.arange(2401)
    n_r = 70.0 + rise * t + np.sin(2.0 * t)
    driven = Driven(t, {"n_r": n_r}, MACHINE, CALIBRATION, (), np.ones(2401, dtype=bool), ())
    source = blank()
    source.driven = driven
    found = [q.name for q in source._late(driven, "n_r", np.ones(2401, dtype=bool))]
    behind = [n_r[0]]
    for v in n_r[1:]:
        behind.append(behind[-1] + (1.0 - np.exp(-DT / 0.0646)) * (v - behind[-1]))
    change = np.std(np.array(behind) - n_r) / np.std(n_r)
    assert 0.0085 < change < 0.0097 or 0.0103 < change < 0.012
    assert ("n_r_lagged_by_64600_us" in found) == told == (change > 0.01)


def test_a_condition_moves_when_its_channel_leaves_a_band_of_four_noise_floors() -> None:
    t = DT * np.arange(3000)
    gaps: Any = SimpleNamespace(far={}, fresh=lambda names: (np.ones(3000, dtype=bool), None))
    n_r = 60.0 + 0.5 * t + 0.01 * white(1, 3000)
    x = 20.0 + 0.002 * white(2, 3000)
    out, _ = regimes_of(t, {"n_r": n_r, "x_lvdt": x, "p_s": x}, gaps)
    band = 4.0 * noise_floor(t, n_r)
    most = np.maximum.accumulate(n_r)  # a rise drags the band behind it
    assert out["rotor speed"][500:] == pytest.approx((most - band)[500:], abs=1e-9)
    assert np.ptp(out["supply pressure"]) < 1e-3


def test_smoothing_by_a_cubic_leaves_the_share_of_white_noise_that_its_textbook_says() -> None:
    """Savitzky and Golay 1964: 59/231 of the power over nine rows, 167/1105 over fifteen."""
    assert [float(np.sum(_weights(n) ** 2)) for n in (9, 15)] == pytest.approx([59.0 / 231.0, 167.0 / 1105.0])


@pytest.mark.parametrize(("share", "told"), [(0.54, True), (0.51, False)])
def test_a_current_is_another_sample_where_it_misfits_by_a_tenth_less(share: float, told: bool) -> None:
    law = 3.0 * white(3, 600, 10)
    mean = law.mean(axis=1)
    c = {"i_cmd": mean + share * (law[:, -1] - mean), "missing": np.zeros(600)}
    what = other_current(DT * np.arange(600), c, law, np.ones(600, dtype=bool), CALIBRATION, 1)
    assert bool(what) == told == ((1.0 - share) / share < 0.9)


@pytest.mark.parametrize(("away", "leans"), [(0.29, True), (0.31, False)])
@pytest.mark.parametrize("end", [False, True])
def test_a_piston_leans_on_a_stop_within_three_tenths_of_a_millimetre(away: float, leans: bool, end: bool) -> None:
    n, full = 900, MACHINE.table.actuator.stroke.value
    x = np.full(n, 20.0)
    x[300:350] = full - away if end else away
    c = {"i_cmd": np.zeros(n), "x_lvdt": x, "n_r": np.full(n, 70.0), "p_s": np.full(n, 21.0),
         "t_oil": np.full(n, 40.0), "missing": np.zeros(n)}  # fmt: skip
    stage = actuator_stage(Driven(DT * np.arange(n), c, MACHINE, CALIBRATION, ("x_lvdt",), np.ones(n, dtype=bool), ()))
    lost = np.flatnonzero(~np.isfinite(stage.measured[0])).tolist()
    assert lost == (list(range(350, 449)) if leans else [])  # a window of 1 s after it left


def test_a_motor_s_actuator_is_known_less_well_than_a_hydraulic_one() -> None:
    motor = build_plant("plant_electromechanical.toml")
    n = 300
    c = {"i_cmd": np.zeros(n), "x_lvdt": np.full(n, 20.0), "n_r": np.full(n, 70.0), "p_s": np.zeros(n),
         "t_oil": np.full(n, 40.0), "missing": np.zeros(n)}  # fmt: skip
    for machine, left in ((motor, 1.1e-3), (MACHINE, 4e-4)):
        driven = Driven(DT * np.arange(n), c, machine, CALIBRATION, ("x_lvdt",), np.ones(n, dtype=bool), ())
        assert actuator_stage(driven).raster_error == pytest.approx([left])
