"""The Python around the compiled ticks of many loops and of two channels: how a block of lanes is filled, what engines
hear, how two channels are switched on, and at what a node begins.
"""

from __future__ import annotations

import signal
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from controller import load_calibration, new_state
from controller.channels import KEPT, LINK, NEVER, SEEN, as_channel, as_latch, as_line, new_channel
from controller.records import MODES, SLOW, as_state
from hil.bus import frames
from hil.bus.frames import raw_speed, speed_of
from hil.loop import firmware_lanes, lanes, lockstep, realtime
from hil.loop.heard_lanes import (
    H_DEMAND,
    H_FRESH,
    H_N_DEM,
    H_N_R,
    H_P_S,
    H_REJECTED,
    H_REQUEST,
    H_SOURCE,
    H_T_OIL,
    N_HEARD,
    HeardLanes,
    Rows,
    depth,
    hear_row,
    noise_of,
    power_on,
    stretch_of,
    stretches,
)
from hil.loop.lockstep import Stimulus
from hil.loop.node import Ecu, Node
from hil.loop.pair import new_pair, seen
from hil.loop.realtime import Lateness, Report, Stop, stop_on_signals
from hil.loop.secured import Gate, started
from plant import build_plant, chain_lanes, places
from vaneloop.base.errors import InputError

PLANT, CAL = build_plant(), load_calibration()
TWO, PAIRED = build_plant("plant_two_actuators.toml"), load_calibration(channels=2)
STAGES = len(PLANT.vanes)

# ---- two channels ----------------------------------------------------------------------------------------------------


def test_two_channels_are_switched_on_alike_with_a_in_charge() -> None:
    q = new_pair(TWO, PAIRED)
    parts = (q.z, q.w, q.latch, q.line)
    assert [a.shape[0] for a in (q.z, q.w, q.line)] == [2] * 3 and q.memory.size == sum(a.size for a in parts)
    for number, part in enumerate(parts):  # each has its own place in what is hashed
        part[...] = number
    assert q.memory.tolist() == [float(number) for number, part in enumerate(parts) for _ in range(part.size)]
    q = new_pair(TWO, PAIRED)
    for row in range(2):
        assert np.array_equal(q.z[row], new_state(), equal_nan=True)
        assert np.array_equal(q.w[row], new_channel(), equal_nan=True)
    assert np.array_equal(q.fresh_z, new_state()) and np.array_equal(q.fresh_w, new_channel(), equal_nan=True)
    assert q.link.shape == (2, KEPT, len(LINK)) and (q.link == NEVER).all()
    assert [as_line(row).chance for row in q.line] == [1.0, 2.0]  # chances of their own
    assert [a.tolist() for a in (q.coil, q.lvdt, q.held, q.power)] == [[0.0] * 2] * 3 + [[1.0] * 2]
    q.coil[0] = q.inputs[0, 0] = q.z[0, 0] = 5.0
    assert q.lvdt[0] == 0.0 and q.inputs[1, 0] != 5.0 and q.z[1, 0] != 5.0 and as_latch(q.latch).in_charge == 0.0


def test_two_channels_need_two_actuators_and_the_firmware_here() -> None:
    with pytest.raises(InputError) as e:
        new_pair(PLANT, PAIRED)
    assert str(e.value) == (
        "calibration: channels.number (=2) needs two actuators; the plant table's actuators.number is 1 "
        "(--plant plant_two_actuators.toml)"
    )
    with pytest.raises(InputError, match=r"channels\.number \(=2\) must be 1 for a controller of your own"):
        new_pair(TWO, PAIRED._replace(program=object()))


def test_what_is_seen_of_two_channels_is_in_the_units_of_the_border() -> None:
    q = new_pair(TWO, PAIRED)
    for side in range(2):
        as_state(q.z[side]).mode = 3.0 + side
        w = as_channel(q.w[side])
        w.source, w.health, w.x_select, w.i_sent, w.age = (v + 10.0 * side for v in (1.0, 2.0, 0.005, 0.006, 0.007))
    as_latch(q.latch).in_charge, as_latch(q.latch).changes = 1.0, 4.0
    found = seen(q)
    assert len(found) == len(SEEN)
    assert found == pytest.approx([2, 4, 3, 4, 1, 11, 2, 12, 5, 10_005, 6, 10_006, 7, 10_007])


# ---- a block of lanes ------------------------------------------------------------------------------------------------


@pytest.fixture
def advanced(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Any, ...]]:
    """What the compiled ticks of a block were asked for; none is run."""
    asked: list[tuple[Any, ...]] = []
    monkeypatch.setattr(lanes, "_advance", lambda *given: asked.append(given))
    return asked


@pytest.mark.parametrize("count", [1, 3, 8, 9])
def test_a_block_is_filled_up_to_whole_vectors_with_the_last_loop(count: int, advanced: list[Any]) -> None:
    every = [Stimulus.of([60.0 + q, 70.0]) for q in range(2)]
    stimuli = [every[j % 2] for j in range(count)]
    loops = [lanes._at_start(PLANT, CAL, s, True) for s in stimuli]
    for j, loop in enumerate(loops):
        loop.state.trend_turn, loop.calibration.scalars.kp, loop.calibration.table[1, 0] = 100.0 + j, 200.0 + j, 0.1 * j
        loop.sigma[:] = 10.0 * j + np.arange(2 + STAGES)
    (way,) = {chain_lanes.way(loop.p) for loop in loops}
    assert way is not None
    block = lanes.Lanes(loops, stimuli, way, every=5)
    n = -(-count // 8) * 8
    of = np.minimum(np.arange(n), count - 1)
    inside = block._block[0]
    assert block.count == count and inside["z_trend_turn"][:n].tolist() == (100.0 + of).tolist()
    assert inside["k_kp"][:n].tolist() == (200.0 + of).tolist()
    assert inside["sigma_lvdt"][:n].tolist() == (10.0 * of).tolist()
    assert inside["sigma_speed"][:n].tolist() == (10.0 * of + 1 + STAGES).tolist()
    assert inside["n_r"][:n].tolist() == (60.0 + of % 2).tolist()
    (k0, ticks, rows, which, noise, sigma, tables, _, lanes_run, stages, *of_way, step, out) = advanced.pop()
    assert (k0, ticks, lanes_run, stages, tuple(of_way), step) == (-1_000, 1_000, n, STAGES, way, 5)
    assert rows.shape[1] == 1 and [rows[which[j], 0, 0] for j in range(n)] == (60.0 + of % 2).tolist()
    assert sigma.tolist() == [[10.0 * j + 1 + q for q in range(STAGES)] for j in of] and noise.shape == (1, 2 + STAGES)
    assert tables[:, 1, 0].tolist() == (0.1 * of).tolist() and out.shape == (0, 0, n) and not noise.any()
    assert len(rows) == len(set(map(id, stimuli))) and not inside["sum"].any() and not inside["count"].any()
    assert block.room(11).shape == (3, len(block.columns), n) and block.room(10).shape[0] == 2
    inside["z_faults"][:n] = np.arange(n)
    assert [block.faults(j) for j in range(count)] == list(range(count))


@pytest.mark.parametrize("seed", [None, 0, 3])
def test_a_run_in_lanes_has_the_noise_of_its_seed_in_pieces_of_ten_seconds(seed: int | None) -> None:
    asked: list[Any] = []

    class Block:
        columns, every, count = lockstep.columns_of(PLANT.vanes), 10, 2

        def room(self, ticks: int) -> np.ndarray:
            return np.zeros((ticks // 10, len(self.columns), 8))

        def advance(self, k0: int, ticks: int, noise: np.ndarray | None, out: np.ndarray) -> None:
            asked.append((k0, ticks, noise))
            out[: ticks // 10] += k0 + np.arange(8.0)

        def faults(self, lane: int) -> int:
            return 10 + lane

    runs = lanes._run(Block(), 20_010, seed)  # type: ignore[arg-type]
    assert [a[:2] for a in asked] == [(0, 10_000), (10_000, 10_000), (20_000, 10)]
    if seed is None:
        assert [a[2] for a in asked] == [None] * 3
    else:
        together = np.random.Generator(np.random.PCG64(seed)).standard_normal((20_010, 2 + STAGES))
        np.testing.assert_array_equal(np.concatenate([a[2] for a in asked]), together)
    assert [(r.faults, r.simulated_s, r.state_hash, r.wall_s) for r in runs] == [
        (10, pytest.approx(20.01), "", 0.0), (11, pytest.approx(20.01), "", 0.0)
    ]  # fmt: skip
    assert [r.columns["n_dem"][k] for r in runs for k in (0, 1_000, 2_000)] == [0, 10_000, 20_000, 1, 10_001, 20_001]
    assert runs[1].columns["x_lvdt"][0] == 1_000.0  # mm


def test_a_controller_with_a_strategy_beyond_the_curves_or_two_channels_runs_alone() -> None:
    for strategy, goes in ((0.0, True), (1.0, True), (2.0, False), (3.0, False)):
        cal = CAL._replace(k=CAL.k.copy())
        cal.scalars.strategy = strategy
        assert firmware_lanes.runs_in_lanes(cal) == goes
    assert not firmware_lanes.runs_in_lanes(PAIRED) and not firmware_lanes.runs_in_lanes(CAL._replace(program="a.so"))


# ---- what engines hear -----------------------------------------------------------------------------------------------


def heard(ticks: int, **columns: dict[int, float]) -> np.ndarray:
    """Rows in which nothing comes, but for these numbers by column and tick."""
    rows = np.zeros((ticks, N_HEARD))
    rows[:, H_SOURCE], rows[:, H_P_S], rows[:, H_T_OIL] = -1.0, 21e6, 40.0
    at = {"fresh": H_FRESH, "rejected": H_REJECTED, "source": H_SOURCE, "p_s": H_P_S, "t_oil": H_T_OIL}
    for name, values in columns.items():
        for k, value in values.items():
            rows[k, at[name]] = value
    return rows


def test_a_stretch_ends_where_something_comes_or_the_supply_changes() -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        rows = heard(47)
        for column, value in ((H_FRESH, 1.0), (H_REJECTED, 2.0), (H_P_S, 1e6), (H_T_OIL, 90.0), (H_N_DEM, 5.0)):
            rows[rng.random(47) < 0.06, column] = value
        found = stretches(rows)
        for k in range(47):
            n = 1
            while k + n < 47 and (k + n) % SLOW and rows[k + n, H_FRESH] < 0.5 and rows[k + n, H_REJECTED] == 0.0 and (
                rows[k + n, [H_P_S, H_T_OIL]] == rows[k + n - 1, [H_P_S, H_T_OIL]]
            ).all():  # fmt: skip
                n += 1
            assert found[k] == n == stretch_of(SimpleNamespace(stretch=found), k)  # type: ignore[arg-type]


@pytest.mark.parametrize(("columns", "deep"), [
    ({}, 1), ({"fresh": {0: 1.0}, "source": {0: 0.0}}, 1), ({"fresh": {39: 1.0}, "source": {39: 1.0}}, 3),
    ({"fresh": {39: 1.0, 45: 1.0}, "source": {39: 0.0, 45: 4.0}}, 4), ({"fresh": {39: 1.0}}, 1),
    ({"source": {39: 0.0}}, 1), ({"fresh": {39: 0.5}, "source": {39: 0.0}}, 1),
    ({"fresh": {40: 1.0}, "source": {40: 0.0}}, 5),
])  # fmt: skip
def test_as_many_frames_are_kept_as_one_may_be_late(columns: dict[str, dict[int, float]], deep: int) -> None:
    assert depth(heard(50, **columns)) == deep


def test_an_engine_hears_the_ecu_s_frame_of_which_its_row_tells() -> None:
    rows = heard(30, fresh={0: 1.0, 12: 1.0, 21: 1.0, 25: 1.0, 27: 1.0}, source={0: 0.0, 12: 0.0, 21: 2.0, 25: 1.0},
                 rejected={13: 2.0})  # fmt: skip
    rows[:, H_N_DEM], rows[:, H_REQUEST], rows[:, H_DEMAND] = 71.0, 1.0, 72.0
    rows[21, H_N_R], rows[27, H_N_R], rows[25, H_REQUEST] = speed_of(5), 130.0, 2.0
    noise, kept = np.array([1.0, -1.0, 2.0]), 3
    hears = Rows(rows, stretches(rows), noise, np.zeros((kept, 2)), np.array([50.0, 51.0]))
    fed = SimpleNamespace(n_dem=-1.0, n_r=-1.0, mode_request=-1.0, demand_fresh=-1.0, demand_rejected=-1.0)
    limits = SimpleNamespace(demand_low=0.0, demand_high=120.0)
    sent = [speed_of(raw_speed(60.0 + 0.5 * noise[frame])) for frame in range(3)]
    speed, n_r = 51.0, {0: sent[0], 12: sent[0], 21: speed_of(raw_speed(sent[2]) ^ 5), 25: sent[1], 27: 130.0}
    for k in range(30):
        found = hear_row(hears, k, 1, fed, limits, 60.0, 0.5, 0.0)
        if k in n_r:
            assert (fed.n_dem, fed.n_r, fed.mode_request) == (71.0, n_r[k], rows[k, H_REQUEST]), k
        if k in (0, 12, 21):  # what asks for no known mode, or is no speed, is not believed
            speed = n_r[k]
        assert found == (72.0, speed, 21e6, 40.0) and (fed.demand_fresh, fed.demand_rejected) == (
            float(k in n_r), 2.0 * (k == 13)
        )  # fmt: skip
    assert hears.sent[:, 1].tolist() == sent and not hears.sent[:, 0].any() and hears.speed.tolist() == [50.0, speed]


@pytest.mark.parametrize("count", [2, 9])
def test_engines_that_hear_begin_at_power_on_and_change_between_ticks(
    count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    loops = [power_on(PLANT, CAL, 60.0 + j) for j in range(count)]
    rows, noise = heard(100), noise_of(3, 100, STAGES)
    block = HeardLanes(loops, [PLANT] * count, [CAL] * count, rows, noise)
    n = -(-count // 8) * 8
    of, inside = np.minimum(np.arange(n), count - 1), block._block[0]
    for name in ("heard", "n_r"):
        assert inside[name][:n].tolist() == (60.0 + of).tolist()
    assert set(inside["sigma_lvdt"][:n]) == {PLANT.sigma[0]} and set(inside["sigma_speed"][:n]) == {PLANT.sigma[-1]}
    assert block._sent.shape == (10, n) and block.room(7).shape == (7, 5 + STAGES + 2, n) and block.k == 0
    asked: list[Any] = []
    monkeypatch.setattr("hil.loop.heard_lanes._advance", lambda *given: asked.append(given))
    for ticks in (7, 5):
        block.advance(ticks, block.room(ticks))
    assert [a[:2] for a in asked] == [(0, 7), (7, 5)] and block.k == 12 and asked[0][2] is rows
    assert (asked[0][7] is block._block) and asked[0][8:10] == (n, STAGES)
    gain, row = CAL.scalars.kp, places.CONTROLLER_GAIN_ERROR
    block.change([{row: 1.0 + 0.1 * j} for j in range(count)])
    assert inside["k_kp"][:n] == pytest.approx(gain * (1.0 + 0.1 * of))
    assert [loop.p[row, 0] for loop in block.loops] == pytest.approx([1.0 + 0.1 * j for j in range(count)])
    assert CAL.scalars.kp == gain and block.loops[-1].calibration.scalars.kp == pytest.approx(
        gain * (0.9 + 0.1 * count)
    )


# ---- nodes -----------------------------------------------------------------------------------------------------------


def test_a_node_begins_at_idle_with_oil_of_its_pressure_and_temperature() -> None:
    node = Node()
    assert node.arrays.supply.tolist() == [21e6, 40.0, 60.0, 60.0] and node.k == 0 and node.mode == MODES[0]
    at = Node(n_r=80.0, p_s=19e6, t_oil=55.0)
    assert at.arrays.supply.tolist() == [19e6, 55.0, 80.0, 80.0]
    assert node.noise()[0].shape[1] == len(PLANT.sigma) and not node.noise()[0].any()
    ecu = Ecu()
    assert ecu.arrays.demand[[0, 2]].tolist() == [60.0, 1.0] and np.isnan(ecu.arrays.demand[1])
    assert ecu.arrays.s[places.N_R, 0] == 60.0 and ecu.arrays.sigma.tolist() == [0.0]
    standby = Ecu(n_dem=75.0, mode_request=0, seed=1)
    assert standby.arrays.demand[[0, 2]].tolist() == [75.0, 0.0] and standby.arrays.s[places.N_R, 0] == 75.0
    assert standby.arrays.sigma.tolist() == [PLANT.sigma[1 + STAGES]]


class Key:
    """An authenticator whose MAC is the frame's data itself."""

    def proves(self, ident: int, data: int, freshness: int, mac: int) -> bool:
        return (data & 0xFF) == (mac & 0xFF)


def test_frames_wait_for_their_macs_and_each_count_says_why_one_was_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    demand = frames.ECU_DEMAND
    head, auth = int(frames.word0(demand)), int(frames.word0(demand + frames.AUTH))
    monkeypatch.setattr(frames, "decode_auth", lambda data: divmod(data, 256))
    gate = Gate(Key(), [demand])  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="no note says the freshness value of the first tick"):
        gate.now(0)
    assert gate.pass_on(0, started(1_000).tolist()) == [] and gate.now(5) == 1_005
    assert gate.pass_on(1, [[auth, 1_001 % 65_536 * 256 + 7]]) == [] and gate.unmatched == 1
    assert gate.pass_on(2, [[head, 7], [head, 8], [5, 6]]) == [(5, 6)]

    def mac(k: int, of: int, off: int = 0) -> list[int]:
        return [auth, (gate.now(k) + off) % 65_536 * 256 + of]

    assert gate.pass_on(3, [mac(3, 8)]) == [(head, 8)] and gate.verified == 1
    assert gate.pass_on(4, [mac(4, 8), mac(4, 7, -1), mac(4, 7)]) == [(head, 7)]
    assert (gate.wrong_mac, gate.stale, gate.verified) == (1, 1, 2)  # none waits with 8; a value not above the last
    assert gate.pass_on(10, [[head, 9]]) == [] == gate.pass_on(59, [])
    assert gate.pass_on(60, []) == [(head | frames.UNAUTHENTIC, 9)] and gate.missing == 1  # 50 ticks
    assert gate.pass_on(61, [[head, 11], mac(61, 12)]) == [] and gate.wrong_mac == 2
    assert gate.pass_on(111, []) == [(head | frames.UNAUTHENTIC, 11)] and gate.missing == 1  # one came, not its own
    assert gate.pass_on(112, [[head, 100 + q] for q in range(16)]) == []
    assert gate.pass_on(113, [[head, 200]]) == [(head | frames.UNAUTHENTIC, 100)] and gate.missing == 2
    assert gate.pass_on(114, [[frames.PAUSE, 60]]) == [(frames.PAUSE, 60)] and gate.pass_on(115, [mac(115, 101)]) == []
    assert gate.unmatched == 2  # what waited is as old as the pause
    gate.correct(115, 900)
    assert gate.now(115) == 1_115  # it never goes back
    gate.correct(115, 1_300)
    assert gate.now(115) == 1_300


# ---- real time -------------------------------------------------------------------------------------------------------


def test_edges_of_lateness_are_fine_where_times_are_short() -> None:
    edges = Lateness.EDGES
    assert len(edges) == 29_801 and (np.diff(edges) > 0).all()
    assert [int(edges[i]) for i in (0, 1, 9_999, 10_000, 10_001, 19_900, 19_901, 29_799, 29_800)] == [
        0, 100, 999_900, 1_000_000, 1_010_000, 100_000_000, 101_000_000, 9_999_000_000, 10_000_000_000
    ]  # fmt: skip
    rng = np.random.default_rng(1)
    for ns in [*(10.0 ** rng.uniform(0, 10.2, 300)).astype(int).tolist(), 10**6 - 1, 10**6, 10**8 - 1, 10**8, 10**10]:
        one = Lateness()
        one.add(int(ns), 3)
        (at,) = np.flatnonzero(one.bins)
        assert edges[at] <= ns and (at == 29_800 or ns < edges[at + 1])
        assert (one.worst_ns, one.worst_tick, one.count) == (ns, 3, 1)


def test_a_report_begins_with_nothing() -> None:
    report = Report()
    numbers = ("ticks", "missed", "skipped", "pauses", "received", "dropped", "sent", "started_ns", "wall_s")
    assert [getattr(report, name) for name in numbers] == [0] * 9 and (report.ended, report.failed) == ("", "")
    assert [h.count for h in (report.begin, report.end, report.work)] == [0] * 3 and report.begin is not Report().begin


def test_a_stop_is_asked_for_by_its_signal_and_handlers_come_back() -> None:
    asks = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = [signal.getsignal(n) for n in asks]
    for number in asks:
        with stop_on_signals() as stop:
            assert not stop
            signal.raise_signal(number)
            assert stop and stop.asked == signal.Signals(number).name
    assert [signal.getsignal(n) for n in asks] == before and not Stop()
    assert (realtime.MOST_BEHIND, realtime.DEAF, realtime.PAUSED_NS, realtime.TICK_NS) == (100, 50, 50 * 10**6, 10**6)
