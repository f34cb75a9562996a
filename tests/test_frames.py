"""Frames as the DBC says: compiled codec against cantools and autosar-e2e, receiver against what a bus brings, node
against lockstep.
"""

from __future__ import annotations

import math
from itertools import combinations
from typing import Any

import can
import cantools
import e2e.p01
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from controller import load_calibration
from hil.bus import frames
from hil.bus.frames import ECU_DEMAND, VGV_ANGLES, VGV_ANGLES_2, VGV_ANGLES_3, VGV_HEALTH, VGV_SERVO, VGV_STATUS
from hil.loop.lockstep import Stimulus, advance, columns_of
from hil.loop.node import Ecu, Node, replay
from hil.loop.tick import new_loop
from plant import build_plant
from vaneloop.base import tables
from vaneloop.base.vanes import VANES

NONE = np.zeros((0, 2), np.int64)


@pytest.fixture(scope="module")
def db() -> Any:
    """The frames that carry signals."""
    whole = cantools.database.load_file(tables.path("vgv.dbc"))
    return cantools.database.Database([m for m in whole.messages if m.frame_id in frames.NAMES])


def data_of(payload: int) -> bytes:
    return int(payload).to_bytes(8, "little", signed=True)


def reference(message: Any, values: dict[str, float], counter: int) -> bytes:
    """The frame as cantools and autosar-e2e make it."""
    data = bytearray(message.encode({**values, "crc": 0, "counter": (counter - 1) % 15}, strict=False))
    e2e.p01.e2e_p01_protect(data, 0x5600 + message.frame_id)
    return bytes(data)


def encode(ident: int, v: dict[str, float], counter: int) -> bytes:
    """The frame as the compiled codec makes it."""
    if ident == ECU_DEMAND:
        word = frames.encode_demand(v["n_dem"], v["n_r"], int(v["mode_request"]), counter)
    elif ident == VGV_STATUS:
        word = frames.encode_status(v["x_dem"], v["x_lvdt"], int(v["state"]), counter)
    elif ident == VGV_SERVO:
        word = frames.encode_servo(v["i_cmd"], fault_bits(v), counter)
    elif ident in frames.ANGLES:
        first, second, third = (v.get(name, math.nan) for name in (*frames.ANGLES[ident], "none")[:3])
        word = frames.encode_angles(first, second, third, counter, ident)
    else:
        word = frames.encode_health(v["p_s"], v["t_oil"], int(v["frames_lost"]), int(v["frames_rejected"]), counter)
    return data_of(word)


def fault_bits(v: dict[str, float]) -> int:
    from controller import FAULTS as names

    return sum(int(v[f"fault_{name}"]) << bit for bit, name in enumerate(names))


@given(seed=st.integers(0, 2**32))
def test_codec_equals_cantools_and_the_e2e_library(db: Any, seed: int) -> None:
    rng = np.random.default_rng(seed)
    for message in db.messages:
        for _ in range(40):
            v = {
                s.name: float(rng.uniform(s.minimum, s.maximum))
                if s.scale != 1
                else int(rng.integers(s.minimum, s.maximum + 1))
                for s in message.signals
                if s.name not in ("crc", "counter")
            }
            counter = int(rng.integers(0, 15))
            theirs = reference(message, v, counter)
            assert encode(message.frame_id, v, counter) == theirs
            word = int.from_bytes(theirs, "little", signed=True)
            ours = frames.decode(int(frames.word0(message.frame_id)), word)
            expected = message.decode(theirs, decode_choices=False)
            for name, value in ours.items():
                assert value == (fault_bits(expected) if name == "faults" else expected[name]), name


@given(st.binary(min_size=8, max_size=8))
@example(b"1\xaf\x95\x08F\xd8W\x10")  # a right CRC, and 15 for a counter
@example(b"\x00\x00\x00\x80\x00\x80\x00\x80")  # angles that are not available
def test_any_eight_bytes_decode_as_cantools_has_them(db: Any, data: bytes) -> None:
    for message in db.messages:
        word = int.from_bytes(data, "little", signed=True)
        ours = frames.decode(int(frames.word0(message.frame_id)), word)
        expected = message.decode(data, decode_choices=False)
        for name, value in ours.items():
            if name != "faults":
                missing = name in VANES and expected[name] == -32768 * 0.002
                assert math.isnan(value) if missing else value == expected[name], name
        right = e2e.p01.e2e_p01_check(bytearray(data), 0x5600 + message.frame_id)
        assert right == (int(frames.crc(message.frame_id, word)) == data[0] and data[1] & 15 != 15)


def test_every_frame_and_signal_of_the_dbc_is_known(db: Any) -> None:
    assert {m.frame_id: m.name for m in db.messages} == frames.NAMES
    assert {m.frame_id: m.cycle_time for m in db.messages} == frames.PERIOD
    for m in db.messages:
        names = {s.name for s in m.signals if s.name not in ("crc", "counter") and not s.name.startswith("fault_")}
        assert names == set(frames.FRAMES[m.frame_id][1]) - {"faults"}
        assert m.dbc.attributes["DataID"].value == 0x5600 + m.frame_id


@given(st.binary(min_size=8, max_size=8))
@example(bytes(8))
@example(b"\xff" * 8)
def test_authentication_frames_of_the_dbc_are_those_of_the_code(data: bytes) -> None:
    whole = cantools.database.load_file(tables.path("vgv.dbc"))
    auth = {m.frame_id: m for m in whole.messages if m.frame_id not in frames.NAMES}
    assert {ident: m.name for ident, m in auth.items()} == frames.AUTH_NAMES
    word = int.from_bytes(data, "little", signed=True)
    assert data_of(frames.encode_auth(*frames.decode_auth(word))) == data
    for ident, m in auth.items():
        of = whole.get_message_by_frame_id(m.dbc.attributes["AuthenticatorOf"].value)
        assert (m.name, m.cycle_time, ident) == (f"{of.name}_AUTH", of.cycle_time, of.frame_id + frames.AUTH)
        assert m.dbc.attributes["SecOCDataID"].value == of.dbc.attributes["DataID"].value
        assert m.decode(data) == frames.decode(int(frames.word0(ident)), word)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e300, -1e300, 5e-324])
def test_values_that_no_frame_holds_are_held_at_the_limits_and_nan_is_not_available(db: Any, value: float) -> None:
    words = {
        ECU_DEMAND: frames.encode_demand(value, value, 1, 0),
        VGV_STATUS: frames.encode_status(value, value, 2, 0),
        VGV_SERVO: frames.encode_servo(value, 255, 0),
        VGV_ANGLES: frames.encode_angles(value, value, value, 0),
        VGV_HEALTH: frames.encode_health(value, value, 999, 999, 0),
        **{i: frames.encode_angles(value, value, value, 0, i) for i in (VGV_ANGLES_2, VGV_ANGLES_3)},
    }
    for ident, word in words.items():
        message = db.get_message_by_frame_id(ident)
        raw = message.decode(data_of(word), scaling=False, decode_choices=False)
        physical = message.decode(data_of(word), decode_choices=False)
        for s in message.signals:
            missing = (s.dbc.attributes or {}).get("NotAvailable")
            if s.length != 16:
                continue
            if math.isnan(value):
                assert raw[s.name] == missing.value
            else:
                assert physical[s.name] == pytest.approx(min(max(value, s.minimum), s.maximum), abs=s.scale / 2)
                assert raw[s.name] != missing.value


@given(
    ident=st.integers(0, 2**29 - 1),
    extended=st.booleans(),
    kind=st.sampled_from(["data", "remote", "fd", "error"]),
    data=st.binary(max_size=8),
)
@example(ident=5, extended=True, kind="data", data=b"\xff" * 8)
def test_message_and_words_are_the_same_frame(ident: int, extended: bool, kind: str, data: bytes) -> None:
    message = can.Message(
        arbitration_id=ident if extended else ident & 0x7FF,
        is_extended_id=extended and kind != "error",
        is_remote_frame=kind == "remote",
        is_fd=kind == "fd",
        is_error_frame=kind == "error",
        data=None if kind == "remote" else data,
        dlc=len(data),
    )
    words = np.array(frames.from_message(message), np.int64)
    back = frames.to_message(*words)
    assert back.equals(message, timestamp_delta=None, check_channel=False)
    assert words[0] & frames.HEAD_MASK == words[0] != frames.PAUSE  # no bus gives the loop's own word


# ---- receiver --------------------------------------------------------------------------------------------------------


class Sender:
    """Frames of ECU_DEMAND to a receiver, one each 10 ms."""

    def __init__(self) -> None:
        self.r = frames.new_receiver(ECU_DEMAND)
        self.now, self.counter = 0, 0

    def frame(self, n_dem: float = 70.0, counter: int | None = None) -> tuple[int, int]:
        return int(frames.word0(ECU_DEMAND)), int(
            frames.encode_demand(n_dem, n_dem, 1, self.counter if counter is None else counter)
        )

    def give(self, head: int, data: int) -> str:
        return frames.VERDICTS[frames.receive(self.r, head, data, self.now)]

    def next(self, send: bool = True) -> str | None:
        """One period on; send the next frame or lose it."""
        self.now += 10
        self.counter = (self.counter + 1) % 15
        verdict = self.give(*self.frame()) if send else None
        frames.grow_old(self.r, self.now)
        return verdict

    def count(self, name: str) -> int:
        return int(self.r[frames.COUNTS.index(name)])

    def started(self) -> Sender:
        assert [self.next() for _ in range(3)] == ["sync", "good", "good"]
        return self


def test_good_frames_stay_good_through_many_turns_of_the_counter() -> None:
    s = Sender().started()
    assert {s.next() for _ in range(100)} == {"good"}
    assert s.count("lost") == 0 and frames.refused(s.r) == 0


@pytest.mark.parametrize("lost", [1, 2, 3, 4])
def test_a_short_loss_is_counted_and_the_next_frame_is_good(lost: int) -> None:
    s = Sender().started()
    for _ in range(lost):
        s.next(send=False)
    assert s.next() == "good"
    assert s.count("lost") == lost and s.count("stale") == 0


@pytest.mark.parametrize("lost", [5, 14, 15, 16, 40])
def test_a_silence_is_a_state_of_its_own_and_no_loss_and_takes_two_frames_to_end(lost: int) -> None:
    s = Sender().started()
    for _ in range(lost):
        s.next(send=False)
    assert s.count("stale") == 1
    assert [s.next(), s.next()] == ["sync", "good"]
    assert s.count("lost") == 0
    s.next(send=False)
    assert s.next() == "good" and s.count("lost") == 1  # what the counter proves afterwards counts
    assert frames.refused(s.r) == 0


def test_a_repeated_frame_is_refused_and_does_not_disturb() -> None:
    s = Sender().started()
    assert s.give(*s.frame()) == "repeated"
    assert s.next() == "good"
    assert s.count("repeated") == 1 and s.count("lost") == 0


def test_a_sender_that_only_repeats_itself_is_never_good() -> None:
    s = Sender().started()
    frozen = s.frame()
    verdicts = set()
    for _ in range(100):
        s.now += 10
        verdicts.add(s.give(*frozen))
        frames.grow_old(s.r, s.now)
    assert verdicts == {"repeated"} and s.count("stale") == 1


@given(st.integers(0, 63))
def test_any_flipped_bit_is_refused(bit: int) -> None:
    s = Sender().started()
    head, data = s.frame(counter=(s.counter + 1) % 15)
    flipped = data ^ (1 << bit if bit < 63 else -(1 << 63))
    assert s.give(head, flipped) == "wrong_crc"


@pytest.mark.parametrize("step", range(15))
def test_a_recorded_frame_between_good_ones_is_good_one_to_five_steps_ahead_and_costs_as_many_true_ones(
    step: int,
) -> None:
    s, good = Sender().started(), 1 <= step <= 5
    for _ in range(20):
        lost = s.count("lost")
        s.now += 5
        verdict = s.give(*s.frame(counter=(s.counter + step) % 15))
        s.now -= 5
        assert verdict == ("good" if good else "repeated" if step == 0 else "wrong_sequence")
        if good:
            assert [s.next() for _ in range(step)] == ["wrong_sequence"] * (step - 1) + ["repeated"]
        assert [s.next(), s.next()] == ["good", "good"]
        assert s.count("lost") - lost == (step - 1 if good else 0)


def test_the_crc_finds_every_error_of_one_or_two_bits_and_not_one_in_256_of_others() -> None:
    bits = 1 << np.arange(64, dtype=np.uint64)
    rng = np.random.default_rng(1)
    data = int(rng.integers(2**63))
    good = int(frames.protect(ECU_DEMAND, data, 7))
    # linear: an error is found by the CRC of the error alone, whatever the frame
    syndrome = np.array([crc_error(good, int(b)) for b in bits])
    assert 0 not in syndrome and all(a != b for a, b in combinations(syndrome.tolist(), 2))
    many = np.bitwise_xor.reduce(syndrome[:, None] * rng.integers(0, 2, (64, 100_000)), axis=0)
    assert np.count_nonzero(many == 0) == pytest.approx(100_000 / 256, abs=4 * (100_000 / 256) ** 0.5)


def crc_error(good: int, error: int) -> int:
    """What the CRC in a frame with an error differs by from the right one."""
    wrong = good ^ (error if error < 2**63 else error - 2**64)
    return int(frames.crc(ECU_DEMAND, wrong)) ^ wrong & 0xFF


def test_a_swapped_pair_costs_one_frame() -> None:
    s = Sender().started()
    late = s.frame(counter=(s.counter + 1) % 15)
    s.next(send=False)
    assert s.next() == "good"
    assert s.give(*late) == "wrong_sequence"
    assert s.next() == "good"


def test_counter_15_is_no_counter() -> None:
    s = Sender().started()
    assert s.give(*s.frame(counter=15)) == "wrong_sequence"


@pytest.mark.parametrize("length", [*range(8), 12, 64])
def test_wrong_length_is_refused(length: int) -> None:
    s = Sender().started()
    _, data = s.frame(counter=(s.counter + 1) % 15)
    assert s.give(length << 32 | ECU_DEMAND, data) == "wrong_length"


@pytest.mark.parametrize("flag", [frames.EXTENDED, frames.REMOTE, frames.FD])
def test_wrong_kind_of_frame_is_refused(flag: int) -> None:
    s = Sender().started()
    head, data = s.frame(counter=(s.counter + 1) % 15)
    assert s.give(head | flag, data) == "wrong_kind"


def test_error_frames_and_other_identifiers_are_nobodys_refusals() -> None:
    s = Sender().started()
    head, data = s.frame()
    assert s.give(head | frames.ERROR, data) == "other"
    assert s.give(head + 1, data) == "other"
    assert s.give(head | frames.EXTENDED | 1 << 20, data) == "other"
    assert frames.refused(s.r) == 0


# ---- nodes -----------------------------------------------------------------------------------------------------------


def test_node_does_what_lockstep_does_bit_for_bit() -> None:
    raw = np.interp(np.arange(400), [0, 50, 150, 250, 399], [60, 60, 80, 70, 72])
    n_dem = np.rint(raw / 0.002) * 0.002
    n_r = np.rint((raw + 0.1) / 0.002) * 0.002
    vgv = Node(n_r=60.0, seed=4)
    sent = []
    for k in range(4000):
        row = np.array(
            [[frames.word0(ECU_DEMAND), frames.encode_demand(n_dem[k // 10], n_r[k // 10], 1, k // 10 % 15)]], np.int64
        )
        sent.append(vgv.tick(row if k % 10 == 0 else NONE).copy())

    decoded = [
        frames.decode(ECU_DEMAND | 8 << 32, int(frames.encode_demand(a, b, 1, 0)))
        for a, b in zip(n_dem, n_r, strict=True)
    ]
    rows = Stimulus.of([d["n_dem"] for d in decoded], [d["n_r"] for d in decoded]).rows.copy()
    rows[0, 4] = 0.0  # the first frame only shows the counter
    like = new_loop(build_plant(), load_calibration(), n_engine=60.0, n_r=60.0, t_oil=40.0, noisy=True)
    out = np.empty((400, len(columns_of(VANES[:3]))))
    noise = np.random.Generator(np.random.PCG64(4)).standard_normal((4000, 5))
    advance(0, 4000, rows, noise, like, 10, out, np.empty((0, 0)))
    assert np.array_equal(vgv.loop.z, like.z)
    assert np.array_equal(np.delete(vgv.loop.s, 0), np.delete(like.s, 0))  # the node's own rotor starts one frame later

    status = [frames.decode(*f.tolist()) for f in (t[0] for t in sent if len(t))]
    servo = [frames.decode(*f.tolist()) for f in (t[1] for t in sent if len(t))]
    assert np.allclose([v["x_lvdt"] for v in status], out[:, 4] * 1e3, atol=0.0005001)
    assert np.allclose([v["x_dem"] for v in status], out[:, 3] * 1e3, atol=0.0005001)
    assert np.allclose([v["i_cmd"] for v in servo], out[:, 5] * 1e3, atol=0.0010001)
    assert [v["state"] for v in status] == out[:, 11].tolist()


def together(ticks: int, disturb: Any = None) -> tuple[Node, Ecu, list[np.ndarray], list[np.ndarray]]:
    """An ECU and a controller that hear each other one tick later; ``disturb(k, frames)`` changes what the controller
    hears.
    """
    vgv, ecu = Node(seed=1), Ecu(seed=2)
    to_vgv = to_ecu = NONE
    heard, sent = [], []
    for k in range(ticks):
        ecu.set_demand(60.0 + 20.0 * min(k / 3000.0, 1.0))
        if disturb is not None:
            to_vgv = disturb(k, to_vgv)
        heard.append(to_vgv.copy())
        from_ecu = ecu.tick(to_ecu).copy()
        to_ecu = vgv.tick(to_vgv).copy()
        sent.append(to_ecu)
        to_vgv = from_ecu
    return vgv, ecu, heard, sent


def test_ecu_and_controller_run_and_hear_each_other() -> None:
    vgv, ecu, _, sent = together(3000)
    assert vgv.mode == "RUN" and vgv.faults == 0 and ecu.stale() == []
    assert ecu.values["state"] == 2.0 and ecu.values["x_lvdt"] == pytest.approx(vgv.loop.inputs[5] * 1e3, abs=0.2)
    assert [len(s) for s in sent[:101]].count(4) == 2 and sum(len(s) for s in sent) == 3 * 300 + 30


def test_a_recorded_run_is_repeated_bit_for_bit() -> None:
    rng = np.random.default_rng(3)

    def disturb(k: int, rows: np.ndarray) -> np.ndarray:
        rows = rows.copy()
        if len(rows) and rng.random() < 0.1:
            rows[0, 1] ^= 1 << int(rng.integers(0, 60))
        return np.repeat(rows, rng.integers(0, 3), axis=0) if rng.random() < 0.1 else rows

    vgv, _, heard, sent = together(2500, disturb)
    assert vgv.counts["wrong_crc"] > 5 and vgv.counts["repeated"] > 2
    again = Node(seed=1)
    at = np.repeat(np.arange(2500), [len(h) for h in heard])
    ticks, repeated = replay(again, at, np.concatenate(heard), 2500)
    assert np.array_equal(repeated, np.concatenate(sent))
    assert np.array_equal(ticks, np.repeat(np.arange(2500), [len(s) for s in sent]))
    assert again.fingerprint() == vgv.fingerprint()


def test_silence_is_degraded_then_fail_safe_and_run_returns() -> None:
    modes = {}

    def disturb(k: int, rows: np.ndarray) -> np.ndarray:
        modes[k] = None
        return NONE if 1000 <= k < 2000 else rows

    vgv, ecu = Node(), Ecu()
    to_vgv = to_ecu = NONE
    seen = []
    for k in range(3600):
        from_ecu = ecu.tick(to_ecu).copy()
        to_ecu = vgv.tick(disturb(k, to_vgv)).copy()
        to_vgv = from_ecu
        seen.append(vgv.mode)
    last_good = 991
    assert seen[last_good + 49] == "RUN" and seen[last_good + 50] == "DEGRADED"
    assert seen[last_good + 549] == "DEGRADED" and seen[last_good + 550] == "FAIL_SAFE"
    assert seen[3550] == "RUN"
    assert vgv.counts["stale"] == 1 and vgv.counts["lost"] == 0


def test_health_tells_what_was_lost_and_refused() -> None:
    def disturb(k: int, rows: np.ndarray) -> np.ndarray:
        if len(rows) and 500 <= k < 530:
            rows = rows.copy()
            rows[:, 1] ^= 1 << 40
        return rows

    vgv, ecu, _, _ = together(1000, disturb)
    assert ecu.values["frames_rejected"] == 3 == vgv.counts["wrong_crc"]
    assert ecu.values["frames_lost"] == 3


@pytest.mark.parametrize(("refused", "mode"), [(4, "RUN"), (5, "DEGRADED")])
def test_the_fifth_refused_frame_of_a_burst_degrades_in_its_own_tick(refused: int, mode: str) -> None:
    vgv, ecu, _, _ = together(1000)
    wrong = np.repeat(ecu._sent.copy(), refused, axis=0)
    wrong[:, 1] ^= 1 << 30
    vgv.tick(wrong)
    assert vgv.mode == mode and vgv.faults == (2 if mode == "DEGRADED" else 0)


@pytest.mark.parametrize(("share", "tolerated"), [(10, True), (5, False)])
def test_one_wrong_frame_in_ten_is_tolerated_for_ever_one_in_five_is_not(share: int, tolerated: bool) -> None:
    modes = set()

    def disturb(k: int, rows: np.ndarray) -> np.ndarray:
        if len(rows) and k > 500 and k // 10 % share == 0:
            rows = rows.copy()
            rows[0, 1] ^= 1 << 20
        return rows

    vgv, _, _, sent = together(6000, disturb)
    modes = {frames.decode(*s[0].tolist())["state"] for s in sent[700:] if len(s)}
    assert (modes == {2.0}) == tolerated


@pytest.mark.parametrize("value", [65535, 60001])
def test_a_speed_out_of_range_under_a_right_crc_degrades_with_the_frame(value: int) -> None:
    vgv, ecu, _, _ = together(1001)  # the last tick sent a frame that has not been heard
    counter = int(ecu.arrays.counter[0])
    data = int(frames.encode_demand(70.0, 70.0, 1, 0)) & ~0xFFFF0000 | value << 16
    vgv.tick(np.array([[frames.word0(ECU_DEMAND), frames.protect(ECU_DEMAND, data, counter)]], np.int64))
    assert vgv.mode == "DEGRADED" and vgv.faults == 1 << 7


# ---- limits of the receiver and the codec ----------------------------------------------------------------------------


@pytest.mark.parametrize("last", [4, 0])
@pytest.mark.parametrize("ident", [ECU_DEMAND, VGV_HEALTH])
def test_silence_begins_with_the_fifth_missed_period_of_the_frame(ident: int, last: int) -> None:
    r = frames.new_receiver(ident)
    period = frames.PERIOD[ident]
    word = frames.encode_demand if ident == ECU_DEMAND else lambda a, b, c, n: frames.encode_health(a, b, c, 0, n)
    assert not frames.grow_old(r, 10_000)  # nothing was heard yet: nothing is late
    for counter, now in (((last + 14) % 15, 3), (last, 4)):
        verdict = frames.receive(r, frames.word0(ident), word(1.0, 1.0, 1, counter), now * period)
    assert frames.VERDICTS[verdict] == "good"
    for now, stale in ((9 * period - 1, False), (9 * period, True), (10 * period - 1, True), (10 * period, True)):
        assert frames.grow_old(r, now) == stale and r[frames.R_LOST] == 0 and r[frames.R_STALE] == stale


@pytest.mark.parametrize(("later", "verdict"), [(50, "good"), (51, "sync")])
@pytest.mark.parametrize("heard_before", [False, True])
def test_a_frame_that_shows_the_counter_is_good_for_five_periods(later: int, verdict: str, heard_before: bool) -> None:
    s = Sender()
    if heard_before:
        s.started()
        for _ in range(20):
            s.next(send=False)
    assert s.give(*s.frame(counter=7)) == "sync"
    s.now += later
    assert s.give(*s.frame(counter=8)) == verdict


@pytest.mark.parametrize(
    ("steps", "verdict", "lost"),
    [(0, "repeated", 0), (1, "good", 0), (5, "good", 4), (6, "wrong_sequence", 0), (14, "wrong_sequence", 0)],
)
@pytest.mark.parametrize("silent", [False, True])
@pytest.mark.parametrize("counter", [0, 9, 14])
def test_a_counter_may_go_on_by_one_to_five_steps(
    steps: int, verdict: str, lost: int, silent: bool, counter: int
) -> None:
    s = Sender()
    s.give(*s.frame(counter=counter if silent else (counter + 14) % 15))
    if not silent:
        assert s.give(*s.frame(counter=counter)) == "good"
    assert s.give(*s.frame(counter=(counter + steps) % 15)) == verdict
    assert s.count("lost") == lost and s.count("good") == (verdict == "good") + (not silent)


def test_after_a_silence_everything_is_as_before_it() -> None:
    s = Sender().started()
    for silence in (1, 2):
        for _ in range(7):
            s.next(send=False)
        assert [s.next() for _ in range(4)] == ["sync", "good", "good", "good"]
        assert s.count("stale") == silence and s.count("lost") == 0


def test_a_frame_out_of_sequence_is_no_candidate_between_good_ones() -> None:
    s = Sender().started()
    s.give(*s.frame(counter=(s.counter + 8) % 15))
    assert s.give(*s.frame(counter=(s.counter + 9) % 15)) == "wrong_sequence"
    assert s.next() == "good" and s.count("wrong_sequence") == 2


@pytest.mark.parametrize("before", range(15))
def test_fifteen_is_no_counter_after_any_other_and_none_to_go_on_from(before: int) -> None:
    s = Sender()
    assert [s.give(*s.frame(counter=c)) for c in ((before + 14) % 15, before, 15)] == ["sync", "good", "wrong_sequence"]
    assert s.give(*s.frame(counter=(before + 1) % 15)) == "good" and s.count("lost") == 0
    fresh = Sender()
    assert [fresh.give(*fresh.frame(counter=c)) for c in (15, 1)] == ["wrong_sequence", "sync"]


def test_after_silence_a_jump_of_the_counter_starts_anew_from_there() -> None:
    s = Sender()
    assert [s.give(*s.frame(counter=c)) for c in (3, 3, 11, 11, 12)] == [
        "sync",
        "repeated",
        "wrong_sequence",
        "repeated",
        "good",
    ]


def test_each_verdict_is_counted_and_five_of_them_are_refusals() -> None:
    s = Sender().started()
    head, data = s.frame()
    (
        s.give(head | frames.EXTENDED, data),
        s.give(head + (1 << 32), data),
        s.give(head, data ^ 1 << 33),
        s.give(head, data),
    )
    s.give(*s.frame(counter=15)), s.give(*s.frame(counter=(s.counter + 7) % 15))
    counted = dict(zip(frames.COUNTS, s.r.tolist(), strict=False))
    assert counted == {
        "good": 2, "sync": 1, "wrong_crc": 1, "repeated": 1, "wrong_sequence": 2, "wrong_length": 1, "wrong_kind": 1,
        "lost": 0, "stale": 0,
    }  # fmt: skip
    assert frames.refused(s.r) == 6


@pytest.mark.parametrize(("count", "told"), [(0, 0), (254, 254), (255, 255), (256, 255), (100_000, 255)])
def test_counts_of_health_stay_at_255(count: int, told: int) -> None:
    for lost, rejected in ((count, 3), (3, count)):
        found = frames.decode_health(frames.encode_health(21.0, 40.0, lost, rejected, 0))
        assert found[2:] == (told if lost == count else 3, told if rejected == count else 3)


def test_fields_hold_their_own_bits_only(db: Any) -> None:
    """Values too great for their field (a mode, fault bits) lose their upper bits and touch no other signal."""
    assert frames.decode_demand(frames.encode_demand(1.0, 2.0, 7, 0)) == (1.0, 2.0, 3)
    assert frames.decode_status(frames.encode_status(1.0, 2.0, 0x1F, 0))[2] == 15
    assert frames.decode_servo(frames.encode_servo(1.0, 0x3FF, 0)) == (1.0, 0x1FF)
    for m in db.messages:
        for s in m.signals:
            if s.scale == 1 or s.minimum is None:
                continue
            decoder, names = frames.FRAMES[m.frame_id]
            for value in (
                s.minimum,
                s.maximum,
                s.minimum - 1.0,
                s.maximum + 1.0,
                s.minimum + 0.4 * s.scale,
                s.minimum + 0.6 * s.scale,
            ):
                sent = encode_any(m.frame_id, {**dict.fromkeys(names, 1.0), s.name: value})
                found = dict(zip(names, decoder(int.from_bytes(sent, "little", signed=True)), strict=False))
                assert found[s.name] == pytest.approx(min(max(value, s.minimum), s.maximum), abs=0.501 * s.scale)
                assert all(found[n] == pytest.approx(1.0) for n in names if n != s.name)


def encode_any(ident: int, v: dict[str, float]) -> bytes:
    """The frame of the compiled codec, ``faults`` as one number."""
    if ident == VGV_SERVO:
        return data_of(frames.encode_servo(v["i_cmd"], int(v["faults"]), 0))
    return encode(ident, v, 0)


@pytest.mark.parametrize("flag", [frames.EXTENDED, frames.REMOTE, frames.ERROR, frames.FD, 1 << 32, 0x100])
def test_what_is_no_frame_of_ours_decodes_to_nothing(flag: int) -> None:
    head, data = int(frames.word0(ECU_DEMAND)), int(frames.encode_demand(1.0, 1.0, 1, 0))
    assert frames.decode(head, data) and frames.decode(head ^ flag, data) == {}


def test_frames_become_bytes_and_come_back() -> None:
    rows = np.array([[frames.word0(i), frames.encode_demand(i / 10.0, 1.0, 1, 3)] for i in (0x0A0, 0x123)], np.int64)
    raw = frames.to_bytes(rows)
    assert [len(b) for b in raw] == [16, 16] and raw[1][:4] == b"\x23\x01\0\0" and raw[1][4] == 8
    assert np.array_equal(frames.from_bytes(b"".join(raw)), rows)


def test_of_a_can_fd_frame_the_first_eight_bytes_and_its_length_are_kept() -> None:
    m = can.Message(arbitration_id=0x0A0, is_extended_id=False, is_fd=True, data=bytes(range(1, 13)))
    head, data = frames.from_message(m)
    assert head == 0x0A0 | 12 << 32 | frames.FD and data == int.from_bytes(bytes(range(1, 9)), "little")
    long = can.Message(arbitration_id=1, is_extended_id=False, is_fd=True, data=bytes(64))
    assert frames.from_message(long)[0] >> 32 & 0xFF == 64
    odd = can.Message(arbitration_id=1, is_extended_id=False, is_remote_frame=True, dlc=65)  # nothing is longer
    assert frames.from_message(odd)[0] >> 32 & 0xFF == 64


def test_a_frame_of_the_bus_that_looks_like_a_note_is_a_frame_of_the_bus() -> None:
    message = frames.to_message(frames.PAUSE, 5000)
    assert message.is_extended_id and (message.arbitration_id, message.dlc) == (0x1FFFFF50, 8)
    words = frames.from_message(message)
    assert words == (frames.PAUSE & frames.HEAD_MASK, 5000) != (frames.PAUSE, 5000)
    r = frames.new_receiver(ECU_DEMAND)
    assert frames.VERDICTS[frames.receive(r, *words, 10)] == "other"


@pytest.mark.parametrize("counter", [0, 1, 14])
def test_a_receiver_that_stood_still_begins_a_silence_and_knows_no_counter(counter: int) -> None:
    s = Sender()
    s.counter = (counter - 3) % 15
    s.started()
    assert s.counter == counter
    frames.stand_still(s.r)
    assert (s.count("stale"), s.count("lost")) == (1, 0)
    assert frames.grow_old(s.r, s.now) and frames.grow_old(
        s.r, s.now + 10
    )  # a silence at once, however short the time seems
    frames.stand_still(s.r)
    assert s.count("stale") == 1  # it is the same silence
    assert [s.next() for _ in range(3)] == ["sync", "good", "good"]
    assert s.count("lost") == 0 and s.count("stale") == 1


def test_a_receiver_that_stood_still_forgets_the_frame_that_showed_the_counter() -> None:
    s = Sender()
    frames.stand_still(s.r)
    assert s.count("stale") == 0 and not frames.grow_old(s.r, s.now)  # who has heard nothing misses nothing
    assert s.next() == "sync"
    frames.stand_still(s.r)
    assert [s.next() for _ in range(2)] == ["sync", "good"] and s.count("stale") == 0
    s.give(*s.frame(counter=2))
    for _ in range(7):
        s.next(send=False)
    assert s.next() == "sync"
    frames.stand_still(s.r)
    assert s.next() == "sync" and s.count("stale") == 1


class Heard(can.BusABC):
    """A bus of python-can's own whose frames are given."""

    def __init__(self, can_filters: Any):
        super().__init__("none", can_filters=can_filters)

    def matches(self, head: int) -> bool:
        return self._matches_filters(frames.to_message(head, 0))

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        raise NotImplementedError

    def shutdown(self) -> None:
        self._is_shutdown = True


IDENT = st.sampled_from([0, 1, 0xA0, 0xB0, 0xB3, 0x1B0, 0x7FF, 0x800, 0x1FFFFFFF])
FILTER = st.fixed_dictionaries(
    {"can_id": IDENT, "can_mask": st.sampled_from([0, 1, 0x7F0, 0x7FF, 0x1FFFFFFF])},
    optional={"extended": st.booleans()},
)


@given(st.none() | st.lists(FILTER, max_size=3), IDENT, st.sampled_from([0, frames.EXTENDED, frames.REMOTE]))
def test_filters_let_through_what_python_can_s_do_and_every_error_frame(filters: Any, ident: int, flags: int) -> None:
    bus, head = Heard(filters), 8 << 32 | ident | flags
    assert frames.passes(bus.filters, head) is bus.matches(head)
    assert frames.passes(bus.filters, head | frames.ERROR) is True
    bus.shutdown()
