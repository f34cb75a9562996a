"""The two nodes on the bus, as docs/bus.md has them: what is sent when, what a received frame does, what is counted."""

from __future__ import annotations

import math

import numpy as np
import pytest

from hil.bus import frames
from hil.bus.frames import ECU_DEMAND, ERROR, PAUSE, VGV_ANGLES, VGV_ANGLES_3, VGV_HEALTH, VGV_SERVO, VGV_STATUS
from hil.loop.node import Ecu, Node, replay
from plant import places

NONE = np.zeros((0, 2), np.int64)
CYCLE = [VGV_STATUS, VGV_SERVO, VGV_ANGLES]


def demand(counter: int, n_dem: float = 70.0, n_r: float = 69.0, request: int = 1) -> tuple[int, int]:
    return int(frames.word0(ECU_DEMAND)), int(frames.encode_demand(n_dem, n_r, request, counter % 15))


def rows(*some: tuple[int, int]) -> np.ndarray:
    return np.array(some, np.int64).reshape(-1, 2)


def started(ticks: int = 100, **options) -> Node:
    """A node in RUN that has heard a frame every 10 ms; the next tick takes the next one."""
    vgv = Node(**options)
    for k in range(ticks):
        vgv.tick(rows(demand(k // 10)) if k % 10 == 0 else NONE)
    assert vgv.mode == "RUN"
    return vgv


def named(sent: np.ndarray) -> dict[int, dict[str, float]]:
    return {int(head) & frames.IDENT_MASK: frames.decode(int(head), int(data)) for head, data in sent}


# ---- what the controller sends ---------------------------------------------------------------------------------------


def test_three_frames_every_ten_ticks_and_health_every_hundred_with_counters_of_their_own() -> None:
    vgv = Node()
    counters: dict[int, list[int]] = {}
    for k in range(401):
        sent = vgv.tick(NONE).copy()
        idents = (sent[:, 0] & frames.IDENT_MASK).tolist()
        assert idents == ([] if k % 10 else CYCLE + ([VGV_HEALTH] if k % 100 == 0 else []))
        for head, data in sent.tolist():
            assert head >> 32 == 8 and int(frames.crc(head & frames.IDENT_MASK, data)) == data & 255
            counters.setdefault(head & frames.IDENT_MASK, []).append(data >> 8 & 15)
    for ident in CYCLE:
        assert counters[ident] == [i % 15 for i in range(41)]
    assert counters[VGV_HEALTH] == [0, 1, 2, 3, 4]


def test_servo_tells_the_mean_current_since_the_last_frame() -> None:
    vgv = started(seed=3)
    currents: list[float] = []
    for k in range(100, 141):
        sent = vgv.tick(rows(demand(k // 10, 90.0, 89.0)) if k % 10 == 0 else NONE)
        currents.append(vgv.loop.state.i_cmd)
        if k % 10 == 0 and k > 100:
            assert named(sent)[VGV_SERVO]["i_cmd"] == pytest.approx(1e3 * np.mean(currents[-10:]), abs=0.0011)
    assert np.ptp(currents) > 1e-3


def test_frames_tell_the_sampled_sensors_in_the_units_of_the_dbc() -> None:
    vgv = started(seed=5)
    at = vgv.loop.s[
        places.POT : places.POT + 3, 0
    ].copy()  # what the tick samples: the machine as the tick before left it
    sent = named(vgv.tick(rows(demand(10))))
    a = vgv.loop
    vane = np.rad2deg(at + a.sigma[1:4] * vgv._noise[0, 1:4])
    assert list(sent[VGV_ANGLES].values()) == pytest.approx(vane.tolist(), abs=0.0011)
    assert not np.allclose(vane, np.rad2deg(at), atol=0.01)  # its noise is in it
    assert sent[VGV_STATUS]["x_lvdt"] == pytest.approx(1e3 * a.inputs[5], abs=0.00051)
    assert sent[VGV_STATUS]["x_dem"] == pytest.approx(1e3 * a.state.x_dem, abs=0.00051)
    assert sent[VGV_STATUS]["state"] == 2 and sent[VGV_SERVO]["faults"] == 0
    health = sent[VGV_HEALTH]
    assert (health["p_s"], health["t_oil"]) == (pytest.approx(21.0), pytest.approx(40.0))


def test_supply_and_temperature_are_those_of_the_machine() -> None:
    vgv = Node(p_s=18.5e6, t_oil=-12.0)
    health = named(vgv.tick(NONE))[VGV_HEALTH]
    assert (health["p_s"], health["t_oil"]) == (pytest.approx(18.5), pytest.approx(-12.0))
    strong, weak = Node(p_s=21e6), Node(p_s=5e6)
    for k in range(200):
        for vgv in (strong, weak):
            vgv.tick(rows(demand(k // 10, 95.0, 95.0)) if k % 10 == 0 else NONE)
    assert strong.loop.s[places.X, 0] > weak.loop.s[places.X, 0] + 1e-3


def test_faults_are_told_by_their_bits() -> None:
    vgv = started()
    for _ in range(61):
        vgv.tick(NONE)
    sent = named(np.concatenate([vgv.tick(NONE).copy() for _ in range(10)]))
    assert (
        vgv.faults == 1 and sent[VGV_SERVO]["faults"] == 1 and sent[VGV_STATUS]["state"] == 3 and vgv.mode == "DEGRADED"
    )


# ---- what a received frame does --------------------------------------------------------------------------------------


def test_the_last_good_frame_of_a_tick_counts_and_refused_ones_are_counted_in_it() -> None:
    vgv = started()
    wrong = demand(11)[0], demand(11)[1] ^ 1 << 30
    vgv.tick(rows(demand(10, 61.0, 62.0), wrong, demand(11, 63.0, 64.0), wrong))
    a = vgv.loop
    assert (a.fed.demand_fresh, a.fed.demand_rejected) == (1.0, 2.0)
    assert (a.state.n_dem, a.state.n_r_raw) == (pytest.approx(63.0), pytest.approx(64.0))
    vgv.tick(NONE)
    assert (a.fed.demand_fresh, a.fed.demand_rejected) == (0.0, 0.0) and a.state.demand_age > 0.0
    vgv.tick(rows(demand(12, request=0)))
    assert a.state.run_request == 0.0 and vgv.mode == "STANDBY"


def test_only_the_first_n_rows_are_received() -> None:
    vgv = started()
    vgv.tick(rows(demand(10, 61.0), demand(11, 63.0)), 1)
    assert vgv.loop.state.n_dem == pytest.approx(61.0)


def test_frames_of_others_are_counted_by_whose_they_seem_to_be() -> None:
    vgv = started()
    before = vgv.counts
    data = frames.encode_demand(70.0, 70.0, 1, 10)
    heads = [int(frames.word0(i)) for i in (VGV_STATUS, VGV_ANGLES, VGV_HEALTH)] + [
        int(frames.word0(i)) for i in (0x0AF, 0x0B4)
    ]
    vgv.tick(
        rows(
            *[(h, int(data)) for h in heads],
            (int(frames.word0(ECU_DEMAND)) | ERROR, 0),
            (int(frames.word0(0x0B0)) | ERROR, 0),
        )
    )
    after = {name: v - before[name] for name, v in vgv.counts.items()}
    assert {name: v for name, v in after.items() if v} == {"own_identifier": 3, "other": 2, "error_frames": 2}


def test_silence_is_no_loss() -> None:
    vgv = started()
    for _ in range(80):
        vgv.tick(NONE)
    assert vgv.counts["stale"] == 1 and vgv.counts["lost"] == 0
    sent = [vgv.tick(NONE).copy() for _ in range(21)]
    health = next(named(s)[VGV_HEALTH] for s in sent if len(s) == 4)
    assert (health["frames_lost"], health["frames_rejected"]) == (
        0,
        0,
    )  # of a sender that sends nothing nothing is lost


def test_the_machine_runs_at_its_own_speed_until_a_demand_has_come_and_then_at_the_demands() -> None:
    vgv = Node(n_r=60.0)
    for _ in range(50):
        vgv.tick(NONE)
    assert vgv.loop.s[places.N_R, 0] == pytest.approx(60.0)
    for k in range(50, 300):
        vgv.tick(rows(demand(k // 10, 70.0, 65.0)) if k % 10 == 0 else NONE)
    assert 60.1 < vgv.loop.s[places.N_R, 0] < 70.0


def test_a_machine_starts_on_the_mean_curve_of_its_speed() -> None:
    for n_r in (50.0, 90.0):
        a = Node(n_r=n_r).loop
        assert a.s[places.X, 0] == pytest.approx(np.interp(n_r, a.calibration.table[0], a.calibration.table[3]))
        assert a.s[places.N_R, 0] == n_r


def test_a_load_of_the_air_acts_at_the_measured_speed() -> None:
    from plant.model import Model

    plant = Model(effects={"aero_load": {"force": 6000.0}}).plant(None)
    vgv = Node(plant, n_r=60.0)
    currents = []
    for n_r in (60.0, 110.0):
        for k in range(400):
            vgv.tick(rows(demand(vgv.k // 10, 60.0, n_r)) if k % 10 == 0 else NONE)
        currents.append(vgv.loop.s[places.GIVE, 0])
    assert currents[1] == pytest.approx(currents[0] * (110.0 / 60.0) ** 2, rel=0.05)


def test_noise_is_drawn_once_for_each_hundred_ticks_and_used_row_by_row() -> None:
    vgv = Node(seed=9)
    numbers = np.random.Generator(np.random.PCG64(9)).standard_normal((200, 5))
    for k in range(150):
        vgv.tick(NONE)
        assert np.array_equal(vgv._noise[k % 100], numbers[k])
    assert not Node().loop.sigma.any() and Node(seed=1).loop.sigma.all()


def test_the_fingerprint_is_of_everything() -> None:
    prints = {Node(seed=1).fingerprint()}
    for part in ("z", "s", "mean", "receiver", "counter"):
        vgv = Node(seed=1)
        getattr(vgv.loop if hasattr(vgv.loop, part) else vgv.arrays, part).reshape(-1)[1] += 1
        prints.add(vgv.fingerprint())
    assert len(prints) == 6


@pytest.mark.parametrize("start", [0, 7, 100])
@pytest.mark.parametrize("ticks", [1, 95, 250])
def test_a_recorded_run_is_repeated_from_any_tick_on(start: int, ticks: int) -> None:
    heard = [(k, demand(k // 10)) for k in range(0, 360, 10)] + [(k, demand(k // 10)) for k in range(5, 360, 50)]
    heard.sort()
    one, other = Node(seed=2), Node(seed=2)
    for k in range(start):
        for vgv in (one, other):
            vgv.tick(rows(*[f for at, f in heard if at == k]))
    sent, at = [], []
    for k in range(start, start + ticks):
        some = one.tick(rows(*[f for a, f in heard if a == k])).copy()
        sent.append(some)
        at += [k] * len(some)
    left = [(a, f) for a, f in heard if start <= a]
    ticks_of, frames_of = replay(other, np.array([a for a, _ in left]), rows(*[f for _, f in left]), ticks)
    assert ticks_of.tolist() == at and np.array_equal(frames_of, np.concatenate(sent))
    assert one.fingerprint() == other.fingerprint() and other.k == start + ticks


# ---- ECU -------------------------------------------------------------------------------------------------------------


def test_the_ecu_sends_its_demand_every_ten_ticks() -> None:
    ecu = Ecu(n_dem=60.0)
    seen = []
    for k in range(201):
        if k == 95:
            ecu.set_demand(80.0, 77.0, 0)
        sent = ecu.tick(NONE).copy()
        assert len(sent) == (k % 10 == 0)
        seen += [(int(d) >> 8 & 15, *named(sent)[ECU_DEMAND].values()) for _, d in sent]
    assert [s[0] for s in seen] == [i % 15 for i in range(21)]
    assert {s[1:] for s in seen[:10]} == {(60.0, 60.0, 1)} and {s[1:] for s in seen[10:]} == {(80.0, 77.0, 0)}


def test_without_a_measured_speed_the_ecus_engine_gives_it_with_noise() -> None:
    silent, noisy = Ecu(n_dem=60.0), Ecu(n_dem=60.0, seed=4)
    sent: tuple[list[float], list[float]] = ([], [])
    for _ in range(400):
        for ecu, out in zip((silent, noisy), sent, strict=True):
            ecu.set_demand(70.0)
            out += [named(f)[ECU_DEMAND]["n_r"] for f in [ecu.tick(NONE).copy()] if len(f)]
    plain, scattered = np.array(sent[0]), np.array(sent[1])
    assert 60.0 == plain[0] < plain[20] < plain[-1] < 70.0 and plain[20] - plain[10] < 0.8 + 0.02  # 8 %/s
    rms = np.std(scattered - plain)
    assert 0.3 < rms / noisy.arrays.sigma[0] < 2.0
    numbers = np.random.Generator(np.random.PCG64(4)).standard_normal(40)
    assert np.allclose(scattered - plain, noisy.arrays.sigma[0] * numbers, atol=0.0021)


def test_the_ecu_keeps_the_last_good_values_of_each_frame() -> None:
    ecu = Ecu()
    assert all(math.isnan(v) for v in ecu.values.values())
    given = {
        VGV_STATUS: frames.encode_status,
        VGV_SERVO: frames.encode_servo,
        VGV_ANGLES: frames.encode_angles,
        VGV_HEALTH: frames.encode_health,
    }
    values = {
        VGV_STATUS: (1.0, 2.0, 3),
        VGV_SERVO: (4.0, 5),
        VGV_ANGLES: (6.0, 7.0, 8.0),
        VGV_HEALTH: (9.0, 10.0, 11, 12),
    }
    for counter in range(2):  # the first shows only where the counter is
        ecu.tick(rows(*[(int(frames.word0(i)), int(given[i](*v, counter))) for i, v in values.items()]))
    assert list(ecu.values.values()) == pytest.approx([float(i) for i in range(1, 13)])
    data = int(frames.encode_status(9.0, 9.0, 4, 2))
    for ident in (VGV_STATUS - 1, VGV_ANGLES_3 + 1):
        ecu.tick(rows((int(frames.word0(ident)), data)))
    ecu.tick(rows((int(frames.word0(VGV_STATUS)), data ^ 1 << 20)))
    assert list(ecu.values.values()) == pytest.approx([float(i) for i in range(1, 13)])
    ecu.tick(rows((int(frames.word0(VGV_STATUS)), data)))
    assert ecu.values["x_dem"] == pytest.approx(9.0) and ecu.values["state"] == 4.0


def test_frames_that_are_late_by_five_periods_are_stale() -> None:
    ecu = Ecu()
    quick = ["VGV_STATUS", "VGV_SERVO", "VGV_ANGLES"]
    for k in range(1, 501):
        ecu.tick(NONE)
        assert ecu.stale() == ([] if k < 50 else quick if k < 500 else [*quick, "VGV_HEALTH"])
    vgv, ecu = Node(), Ecu()
    heard = NONE
    for _ in range(130):
        ecu.tick(heard)
        heard = vgv.tick(NONE).copy()
    assert ecu.stale() == []
    for k in range(60):
        ecu.tick(NONE)
        assert ecu.stale() == ([] if k < 41 else quick)  # the last three were heard at tick 121, this is tick 130 + k


def test_the_controller_gets_of_each_potentiometer_what_is_left_of_it() -> None:
    vgv = started()
    at = vgv.loop.s[places.POT : places.POT + 3, 0].copy()
    vgv.tick(NONE)
    assert np.allclose(vgv.loop.fed.pots[:3], at, atol=1e-12)  # all of it, at first
    assert np.isnan(vgv.loop.fed.pots[3:]).all()  # stages that the machine lacks
    at = vgv.loop.s[places.POT : places.POT + 3, 0].copy()
    vgv.loop.pots[0] = 0.5, 0.1, 1.0, 0.0, 0.0, np.nan
    vgv.tick(NONE)
    assert np.allclose(vgv.loop.fed.pots[:3], [0.5 * at[0] + 0.1, at[1], np.nan], atol=1e-12, equal_nan=True)


def test_a_frame_with_counter_0_is_heard_like_any_other() -> None:
    ecu = Ecu()
    for k in range(60):
        heard = [
            (int(frames.word0(VGV_STATUS)), int(frames.encode_status(1.0, 1.0, 2, c)))
            for at, c in ((40, 14), (50, 0))
            if k == at
        ]
        ecu.tick(rows(*heard))
    assert ecu.stale() == ["VGV_SERVO", "VGV_ANGLES"]


def test_a_run_of_no_ticks_sends_nothing() -> None:
    at, sent = replay(Node(), np.zeros(0), NONE, 0)
    assert at.shape == (0,) and sent.shape == (0, 2)


def test_replay_goes_on_in_silence_after_the_last_recorded_frame() -> None:
    one, other = Node(seed=2), Node(seed=2)
    heard = [(k, demand(k // 10)) for k in range(0, 30, 10)]
    sent = [one.tick(rows(*[f for at, f in heard if at == k])).copy() for k in range(130)]
    at, again = replay(
        other, np.array([k for k, _ in heard]), rows(*[f for _, f in heard]).ravel(), 130
    )  # words one after the other
    assert np.array_equal(again, np.concatenate(sent)) and at.tolist() == [k for k, s in enumerate(sent) for _ in s]
    assert one.fingerprint() == other.fingerprint() and one.counts["stale"] == 1


def test_a_pause_is_told_in_seconds_for_one_tick_and_is_no_frame() -> None:
    vgv = started()
    before = vgv.counts
    vgv.tick(rows((PAUSE, 30), (PAUSE, 12)))
    assert vgv.loop.fed.pause == pytest.approx(0.042)
    assert {name: v - before[name] for name, v in vgv.counts.items() if v != before[name]} == {"stale": 1}
    vgv.tick(NONE)
    assert vgv.loop.fed.pause == 0.0


def test_after_a_pause_the_first_frame_only_shows_where_the_counter_is() -> None:
    vgv = started()
    vgv.tick(rows((PAUSE, 20), demand(10)))
    assert vgv.loop.fed.demand_fresh == 0.0 and vgv.counts["sync"] == 2
    vgv.tick(rows(demand(11)))
    assert vgv.loop.fed.demand_fresh == 1.0


def test_a_controller_that_stood_still_is_safe_first() -> None:
    vgv = started()
    vgv.tick(rows((PAUSE, 60)))
    assert vgv.mode == "FAIL_SAFE"


@pytest.mark.parametrize(
    ("n_dem", "n_r", "mode", "plausible"),
    [
        (50.0, 60.0, 1, True),
        (60.0, 50.0, 1, True),
        (110.0, 60.0, 1, True),
        (60.0, 110.0, 1, True),
        (60.0, 60.0, 0, True),
        (49.998, 60.0, 1, False),
        (60.0, 49.998, 1, False),
        (110.002, 60.0, 1, False),
        (60.0, 110.002, 1, False),
        (math.nan, 60.0, 1, False),
        (60.0, math.nan, 1, False),
        (60.0, 60.0, 2, False),
        (60.0, 60.0, 3, False),
    ],
)
def test_the_machine_follows_only_demands_within_the_limits_of_the_calibration(
    n_dem: float, n_r: float, mode: int, plausible: bool
) -> None:
    vgv = started()
    k = vgv.loop.calibration.scalars
    k.demand_low, k.demand_high = 50.0, 110.0
    vgv.tick(rows(demand(10, n_dem, n_r, mode)))
    assert vgv.counts["good"] == 10 and vgv.loop.fed.demand_fresh == 1.0
    assert vgv.arrays.supply[2:].tolist() == pytest.approx([n_dem, n_r] if plausible else [70.0, 69.0])


def test_the_engine_of_the_machine_follows_the_demand_and_not_the_measured_speed() -> None:
    vgv = Node(n_r=60.0)
    for k in range(300):
        vgv.tick(rows(demand(k // 10, 70.0, 50.0)) if k % 10 == 0 else NONE)
    assert 61.0 < vgv.loop.s[places.N_R, 0] < 70.0
