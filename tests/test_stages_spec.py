"""Stages alone by their specification: which lanes run together, in what steps, from which samples they start."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from plant import Plant, build_plant
from plant.chain import TICK
from plant.curve import KNOWN, PLACES, QUANTITIES, at_curve
from plant.effects import CURVES, ROW, valve_flow_saturation
from plant.layout import C_LOW
from plant.parameters import KIND, LVDT_FACTOR, LVDT_LAG, LVDT_SHARE, VALVE_SHARE, derive
from plant.places import LVDT_LAG_ERROR, N_R, VALVE_LAG
from plant.stages import (
    actuator,
    actuator_run,
    bends,
    blocks,
    engine,
    engine_run,
    hydraulic_blocks,
    linkage,
    linkage_run,
    motor_blocks,
    run_bends,
    step_currents,
)
from plant.stages.hydraulic_blocks import NEEDS, WAYS
from vaneloop.base.curve import POINTS

HYDRAULIC, MOTOR = "plant.toml", "plant_electromechanical.toml"
Calls = list[tuple[Any, ...]]


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> Callable[[Any, str], Calls]:
    """What a compiled function is called with, instead of running it; one thread, so that the order is the list's."""
    monkeypatch.setattr("vaneloop.base.side_by_side.threads", lambda: 1)
    monkeypatch.setattr(blocks, "threads", lambda: 1)

    def of(module: Any, name: str) -> Calls:
        seen: Calls = []
        monkeypatch.setattr(module, name, lambda *a: seen.append(a))
        return seen

    return of


# ---- shares of work --------------------------------------------------------------------------------------------------


@given(st.integers(0, 100), st.integers(1, 16), st.integers(0, 15))
def test_a_block_is_left_unfilled_only_where_its_lanes_are_few(lanes: int, width: int, few: int) -> None:
    wide = blocks.in_blocks(lanes, width, few)
    rest = lanes % width
    assert wide == (lanes if rest > few else lanes - rest)


@given(st.integers(0, 100), st.integers(0, 100), st.integers(1, 16), st.integers(1, 8))
def test_every_lane_is_in_one_part_and_cores_share_evenly(wide: int, more: int, width: int, cores: int) -> None:
    with pytest.MonkeyPatch.context() as m:
        m.setattr(blocks, "threads", lambda: cores)
        parts = blocks.parts_of(wide + more, wide, width)
    assert [j for part in parts for j in part] == list(range(wide + more))
    together = [part for part in parts if part.start < wide]
    assert all(len(part) == width for part in together[:-1]) and sum(map(len, together)) == wide
    alone = [len(part) for part in parts if part.start >= wide]
    assert len(alone) <= cores and all(n == -(-more // cores) for n in alone[:-1])


def test_the_last_part_begins_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vaneloop.base.side_by_side.threads", lambda: 1)
    done: list[range] = []
    blocks.on_all_cores(done.append, [range(2), range(2, 4), range(4, 5)])
    assert done == [range(4, 5), range(2, 4), range(2)]


@pytest.mark.parametrize("flags", list(itertools.product((False, True), repeat=len(NEEDS))))
def test_a_block_goes_the_first_way_that_has_all_it_needs(flags: tuple[bool, ...]) -> None:
    way = hydraulic_blocks._way.py_func(np.array(flags))
    has = [(WAYS[k] >= flags).all() for k in range(len(WAYS))]
    assert has[way] and not any(has[:way])


# ---- the actuator ----------------------------------------------------------------------------------------------------

STEPS = 4


@cache
def shipped(table: str = HYDRAULIC) -> Plant:
    """A machine as it is shipped."""
    return build_plant(table)


def machine(lanes: int, table: str = HYDRAULIC) -> np.ndarray:
    """Parameters of equal machines, side by side."""
    p = np.repeat(shipped(table).p, lanes, axis=1)
    derive(p, 2e-3, 8e-3)
    return p


def put(p: np.ndarray, lane: int, effect: str, value: float, which: int = 0) -> None:
    """Give a lane an effect's parameter, SI; its derived rows are filled later."""
    p[ROW[effect] + which, lane] = value


def log(n: int = 12) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Currents of every step, speed, pressure, temperature: no two samples alike."""
    k = np.arange(float(n))
    return 1e-3 * (k[:, None] + 0.1 * np.arange(1.0, STEPS + 1.0)) / n, 60.0 + k, 21e6 + 1e4 * k, 30.0 + k


def run(p: np.ndarray, window: int = 0, table: str = HYDRAULIC, lvdt: np.ndarray | None = None) -> np.ndarray:
    i, n_r, p_s, t_oil = log()
    s = np.repeat(shipped(table).start(0.024, 60.0), p.shape[1], axis=1)
    out = np.full((len(n_r), p.shape[1]), np.nan, order="F")
    actuator_run(i, n_r, p_s, t_oil, 8e-3, p, s, out, lvdt, window)
    return out


def test_lags_take_the_share_that_keeps_the_delay_of_a_ramp() -> None:
    p = machine(3)
    p[LVDT_LAG], p[LVDT_LAG_ERROR], p[VALVE_LAG] = (0.0, 2e-3, 6e-3), (0.004, -1.0, 0.0), (0.014, 0.0, 0.002)
    run(p)  # 4 steps of 2 ms to a sample
    assert p[LVDT_FACTOR] == pytest.approx([1.0, 0.5, 0.25]) and p[LVDT_SHARE] == pytest.approx([1.0 / 3.0, 1.0, 1.0])
    assert p[VALVE_SHARE] == pytest.approx([0.125, 1.0, 0.5])


def test_only_where_the_piston_is_put_it_starts_from_rest_under_the_first_sample(calls: Any) -> None:
    rest, lanes = calls(actuator, "_rest"), calls(actuator, "_actuator_lanes")
    p, stroke = machine(1), np.linspace(0.02, 0.03, 24)[::2]
    run(p)
    assert rest == [] and lanes.pop()[8].shape == (1,)
    run(p, 5, lvdt=stroke)
    i, n_r, _, t_oil = log()
    ((of, _, *at),) = rest
    assert of is p and at == [i[0, 0], n_r[0], t_oil[0]]
    seen = lanes.pop()[8]
    assert seen.tolist() == stroke.tolist() and seen.flags.c_contiguous
    with pytest.raises(ValueError, match=r"window \(=5\) needs x_lvdt"):
        run(p, 5)


def test_the_stroke_starts_where_it_was_seen_only_with_a_window() -> None:
    p, stroke = machine(1), np.full(12, 0.030)
    assert run(p, 5, lvdt=stroke)[0, 0] == pytest.approx(0.030, abs=1e-12)
    free = run(p, lvdt=stroke)[0, 0]
    assert free == run(p)[0, 0] and abs(free - 0.024) < 1e-6
    i, n_r, p_s, t_oil = log()
    out = np.full((12, 1), np.nan)
    actuator_run(i, n_r, p_s, t_oil, 8e-3, p, shipped().start(0.024, 60.0), out)
    assert out[0, 0] == free


@pytest.mark.parametrize("table", [HYDRAULIC, MOTOR])
@pytest.mark.parametrize("n", [1, 8, 9, 10, 16, 17])
def test_blocks_of_eight_and_one_left_over_alone(n: int, table: str, calls: Any) -> None:
    wide = {name: calls(module, "run") for name, module in ((HYDRAULIC, hydraulic_blocks), (MOTOR, motor_blocks))}
    alone = calls(actuator, "_actuator_lanes")
    p = machine(n, table)
    assert (p[KIND] == (table == MOTOR)).all()
    run(p, table=table)
    lanes = 10 if table == HYDRAULIC else 9
    blocks_of = [a[lanes].tolist() for a in wide.pop(table)]
    assert wide.popitem()[1] == []  # those of the other machine
    one = [a[10].tolist() for a in alone]
    assert sorted(map(len, blocks_of)) == ([n % 8] if n % 8 > 1 else []) + [8] * (n // 8)
    assert one == ([[n - 1]] if n % 8 == 1 else [])
    assert sorted(sum(blocks_of + one, [])) == list(range(n))


KINDS_OF_LANES: dict[str, list[tuple[str, float, int]]] = {  # what makes eight lanes need more than others
    "plain": [], "memory": [("valve_hysteresis", 1e-4, 0)], "limited": [("valve_null_bias", 1e-4, 0)],
    "load": [("aero_load", 900.0, 0)],
    "loaded, limited": [("aero_load", 900.0, 0), ("valve_lag", 4e-3, 0)],
    "loaded, sticky": [("aero_load", 900.0, 0), ("piston_stiction", 300.0, 0)],
    "droops": [("supply_pressure_droop", 0.2, 0)],
    "leaks and sticks": [("internal_leakage", 1e-12, 0), ("piston_stiction", 300.0, 0), ("aero_load", 900.0, 0)],
}  # fmt: skip


def test_lanes_that_need_the_same_share_a_block(calls: Any) -> None:
    wide, kinds = calls(hydraulic_blocks, "run"), list(KINDS_OF_LANES)
    order = np.random.default_rng(5).permutation(np.repeat(np.arange(len(kinds)), 8))
    p = machine(len(order))
    for lane, kind in enumerate(order):
        for effect in KINDS_OF_LANES[kinds[kind]]:
            put(p, lane, *effect)
    derive(p, 2e-3, 8e-3)
    run(p)
    assert sorted([kinds[q] for q in set(order[a[10]])] for a in wide) == [[kind] for kind in sorted(kinds)]
    # from those that need least to those that need most
    needs = ["plain", "limited", "memory", "load", "loaded, limited", "loaded, sticky", "droops", "leaks and sticks"]
    assert [kinds[order[a[10][0]]] for a in reversed(wide)] == needs


@pytest.mark.parametrize("effect", [
    ("valve_null_bias", 1e-4, 0), ("valve_lag", 4e-3, 0), ("lvdt_lag", 4e-3, 0),
    ("valve_flow_saturation", 0.9 * valve_flow_saturation.OFF, 0),
])  # fmt: skip
def test_what_limits_a_lane_puts_it_behind_the_plain_ones(effect: tuple[str, float, int], calls: Any) -> None:
    wide = calls(hydraulic_blocks, "run")
    p = machine(16)
    for lane in (0, 2, 4, 6, 8, 10, 12, 14):
        put(p, lane, *effect)
    derive(p, 2e-3, 8e-3)
    run(p)
    assert [a[10].tolist() for a in wide] == [list(range(0, 16, 2)), list(range(1, 16, 2))]


@pytest.mark.parametrize("effect", [
    ("supply_pressure_droop", 0.2, 0), ("internal_leakage", 1e-12, 0), ("valve_flow_saturation", 1e-3, 1),
])  # fmt: skip
def test_what_loses_pressure_puts_a_lane_behind_those_that_stick(effect: tuple[str, float, int], calls: Any) -> None:
    wide = calls(hydraulic_blocks, "run")
    p = machine(16)
    p[hydraulic_blocks.DRIVE_LOADED] = 1.0
    for lane in range(16):
        put(p, lane, *(effect if lane % 2 else ("piston_stiction", 300.0, 0)))
    run(p)
    assert [a[10].tolist() for a in wide] == [list(range(1, 16, 2)), list(range(0, 16, 2))]


def test_a_swaying_screw_and_curves_have_blocks_of_their_own(calls: Any) -> None:
    wide = calls(motor_blocks, "run")
    p = machine(24, MOTOR)
    for lane in range(0, 24, 3):
        put(p, lane, "screw_pitch_error", 1e-5)
    curve(p, range(1, 24, 3), "servo.current adds")
    run(p, table=MOTOR)
    assert [a[9].tolist() for a in wide] == [list(range(k, 24, 3)) for k in (1, 0, 2)]


def curve(p: np.ndarray, lanes: range, at: str, other: int | None = None) -> None:
    """Give lanes a curve of the speed, 1 in its unit everywhere; ``other``: a lane whose curve begins elsewhere."""
    q, bent = QUANTITIES["n_r"], p[:, lanes]
    at_curve(bent, PLACES[at], q, 40.0, 90.0, np.ones((POINTS, len(lanes))))
    p[:, lanes] = bent
    if other is not None:
        p[CURVES + 1 + C_LOW, other] *= 1.5


@pytest.mark.parametrize("n", [9, 10, 12])
def test_a_lane_whose_curve_is_another_runs_alone(n: int, calls: Any) -> None:
    wide, alone = calls(hydraulic_blocks, "run"), calls(actuator, "_actuator_lanes")
    p = machine(n)
    curve(p, range(1, n), "valve.current adds", 3)
    run(p)
    one, rest = ([q for a in seen for q in a[10].tolist()] for seen in (alone, wide))
    assert set(one) == {3, n - 1} if n == 10 else one == [3]  # a ninth of the others is left over
    assert sorted(one + rest) == list(range(n))


# ---- controller, currents, engine ------------------------------------------------------------------------------------


@pytest.mark.parametrize("other, way", [(None, "_side_by_side"), (1, "_lane_by_lane")])
def test_curves_of_the_controller_are_summed_for_each_lane(
    other: int | None, way: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    p = machine(3)
    curve(p, range(3), "controller.demand adds", other)
    curve(p, range(3), "servo.current adds")
    known, s = np.full((KNOWN + 2, 5), 60.0), np.repeat(shipped().start(0.024, 60.0), 3, axis=1)
    taken: Calls = []
    for name in ("_side_by_side", "_lane_by_lane"):
        compiled = getattr(bends, name)
        monkeypatch.setattr(bends, name, lambda *a, name=name, f=compiled: (taken.append((name,)), f(*a)))
    out = np.full((3, 5), np.nan)
    run_bends(known, p, s, PLACES["controller.demand adds"].site, out)
    assert out == pytest.approx(np.full((3, 5), 1e-3)) and taken == [(way,)]


def test_a_current_acts_as_much_later_as_it_is_logged_late() -> None:
    """A ramp of current stays one, a constant one constant; nothing leads to the first sample."""
    ramp = 1e-3 * np.arange(8.0)  # the mean of the interval before each sample
    found = step_currents(ramp, 0.01, 5, behind=0.002)
    middles = np.arange(8.0)[:, None] + (np.arange(5.0) + 0.5) / 5.0 - 0.5 - 0.2
    assert found[3:-1] == pytest.approx(1e-3 * middles[3:-1]) and (found[0] == 0.0).all()
    assert found.shape == (8, 5)
    assert step_currents(ramp, 0.01, 5) == pytest.approx(step_currents(ramp, 0.01, 5, TICK))
    parts = np.arange(24.0).reshape(6, 4)
    late = step_currents(parts, 0.01, 2, behind=0.0025)
    assert (late[0] == 1.5).all()  # the mean of the first sample's parts
    assert late[2:].tolist() == [[(4 * k + 2 * m - 1) + 0.5 for m in (0, 1)] for k in range(2, 6)]


@pytest.mark.parametrize("dt, steps", [
    (1e-4, 1), (1.9e-3, 1), (2e-3, 1), (2e-3 * (1.0 + 1e-7), 1), (2.1e-3, 2), (3.9e-3, 2), (0.01, 5), (0.0101, 6),
    (0.1, 50),
])  # fmt: skip
def test_the_engine_takes_the_fewest_equal_steps_of_at_most_2_ms(dt: float, steps: int, calls: Any) -> None:
    seen = calls(engine, "_engine_run")
    demand = np.arange(12.0)[::2]
    engine_run(demand, dt, machine(2), np.zeros((1, 2)), np.zeros((6, 2)))
    ((n_dem, step, n, *_),) = seen
    assert n_dem.tolist() == demand.tolist() and n_dem.flags.c_contiguous and (step, n) == (dt, steps)


def test_the_engine_runs_lane_by_lane_only_where_curves_differ(calls: Any) -> None:
    wide, alone = calls(engine, "_engine_run"), calls(engine, "_engine_lanes")
    for lanes, other, together in ((range(0), None, True), (range(3), None, True), (range(3), 1, False)):
        p = machine(3)
        if lanes:
            curve(p, lanes, "engine.demand adds", other)
        engine_run(np.full(4, 60.0), 0.01, p, np.zeros((1, 3)), np.zeros((4, 3)))
        assert (len(wide), len(alone)) == ((1, 0) if together else (0, 1))
        wide.clear()
    p = machine(3)
    curve(p, range(1, 3), "engine.demand adds")  # one has none
    alone.clear()
    engine_run(np.full(4, 60.0), 0.01, p, np.zeros((1, 3)), np.zeros((4, 3)))
    assert (len(wide), len(alone)) == (0, 1)


def test_the_rotor_leaves_its_start_by_the_demand_before() -> None:
    p, s = machine(2), np.repeat(shipped().start(0.024, 60.0), 2, axis=1)
    out = np.full((4, 2), np.nan)
    engine_run(np.array([60.0, 60.0, 61.0, 61.0]), 0.01, p, s, out)
    assert (out[:3] == 60.0).all() and (out[3] > 60.0).all() and (s[N_R] == out[3]).all()


# ---- the linkage -----------------------------------------------------------------------------------------------------

L = 12  # samples


def run_linkage(p: np.ndarray, stroke: np.ndarray | None = None, dt: float = 0.01, ready: bool = True) -> np.ndarray:
    """Vane angles, rad[L, stage, lane]; ``ready``: a lane's samples lie side by side in memory."""
    n = np.arange(float(L))
    s = np.repeat(shipped().start(0.024, 60.0), p.shape[1], axis=1)
    out = np.full((p.shape[1], 3, L), np.nan).transpose(2, 1, 0) if ready else np.full((L, 3, p.shape[1]), np.nan)
    x = 0.024 + 1e-4 * n if stroke is None else stroke
    linkage_run(x, 60.0 + n, 30.0 + n, n * dt, dt, p, s, out)
    return out


@pytest.mark.parametrize("dt, reach", [(0.1, 1), (0.01, 1), (5e-3, 2), (2e-3, 5), (1e-3, 10), (0.012, 1)])
def test_the_stroke_s_speed_is_taken_over_10_ms_to_each_side(dt: float, reach: int, calls: Any) -> None:
    assert linkage.speed_reach(dt) == reach
    alone = calls(linkage, "_linkage_lanes")
    stroke = 1e-3 * np.arange(2.0 * L)[::2] ** 2
    run_linkage(machine(1), stroke, dt)
    x, speed = alone[0][:2]
    assert x.tolist() == stroke.tolist() and x.flags.c_contiguous
    k = np.arange(L)
    first, last = np.maximum(k - reach, 0), np.minimum(k + reach, L - 1)
    assert speed == pytest.approx((stroke[last] - stroke[first]) / ((last - first) * dt))


def test_one_sample_alone_has_no_speed(calls: Any) -> None:
    alone = calls(linkage, "_linkage_lanes")
    one, p = np.full(1, 60.0), machine(1)
    linkage_run(np.full(1, 0.024), one, one, one, 0.01, p, np.zeros((1, 1)), np.zeros((1, 3, 1)))
    assert alone[0][1].tolist() == [0.0]


@pytest.mark.parametrize("n", [1, 2, 15, 16, 17, 18, 33])
def test_blocks_of_sixteen_and_one_left_over_alone(n: int, calls: Any) -> None:
    wide, alone = calls(linkage, "_linkage_blocks"), calls(linkage, "_linkage_lanes")
    run_linkage(machine(n))
    assert sorted(len(a[9]) for a in wide) == ([n % 16] if n % 16 > 1 else []) + [16] * (n // 16)
    assert [a[9].tolist() for a in alone] == ([[n - 1]] if n % 16 == 1 else [])


@pytest.mark.parametrize("last", [0, 1, 2])
def test_rubbing_eccentric_and_bent_lanes_have_blocks_of_their_own(last: int, calls: Any) -> None:
    wide = calls(linkage, "_linkage_blocks")
    p = machine(80)
    for lane in range(80):
        effects = {0: [], 1: [("ring_eccentricity", 2e-3, last)], 2: [("linkage_friction", 2e-3, last)],
                   3: [("lvdt_nonlinearity", 1e-4, last % 2)], 4: []}[lane % 5]  # fmt: skip
        for effect in effects:
            put(p, lane, *effect)
    curve(p, range(4, 80, 5), "linkage.ring adds")
    run_linkage(p)
    assert [a[9].tolist() for a in reversed(wide)] == [list(range(k, 80, 5)) for k in range(5)]


@pytest.mark.parametrize("n", [17, 18, 20])
def test_a_lane_of_another_curve_turns_its_rings_alone(n: int, calls: Any) -> None:
    wide, alone = calls(linkage, "_linkage_blocks"), calls(linkage, "_linkage_lanes")
    p = machine(n)
    curve(p, range(n), "linkage.ring adds", 3)
    curve(p, range(5, 6), "linkage.ring adds", 5)
    run_linkage(p)
    blocks_of, one = ([q for a in seen for q in a[9].tolist()] for seen in (wide, alone))
    assert {3, 5} <= set(one) and len(one) == 2 and sorted(blocks_of + one) == list(range(n))


@pytest.mark.parametrize("n", [1, 3])
def test_angles_are_the_same_wherever_their_samples_lie(n: int) -> None:
    p = machine(n)
    found = run_linkage(p)
    assert np.isfinite(found).all() and np.ptp(found[:, 0]) > 1e-3
    assert np.array_equal(found, run_linkage(p, ready=False)) and np.array_equal(found[..., 0], found[..., -1])
