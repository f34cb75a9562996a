"""The simulated wire: bits, arbitration, queues, errors and their counters, bus-off; and the whole loop over it."""

from __future__ import annotations

import os
import subprocess
import sys
from typing import Any

import can
import cantools
import e2e.p01
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import tables
from hil import frames, wire
from hil.lockstep_bus import Channel, LockstepBus, run_lockstep
from hil.node import Ecu, Node
from tests.conftest import ROOT

BIT = 1 / wire.BIT_RATE


def frame(ident: int, data: bytes = bytes(8), **more: Any) -> can.Message:
    return can.Message(arbitration_id=ident, data=data, is_extended_id=more.pop("extended", False), **more)


def bits_by_the_book(message: can.Message) -> str:
    """Bits from start of frame to CRC with stuffing, written down as text."""
    ident = message.arbitration_id
    remote = "1" if message.is_remote_frame else "0"
    if message.is_extended_id:
        head = f"0{ident >> 18:011b}11{ident & 0x3FFFF:018b}{remote}00"
    else:
        head = f"0{ident:011b}{remote}00"
    plain = head + f"{message.dlc:04b}" + "".join(f"{b:08b}" for b in message.data)
    value = int(plain, 2) << 15  # polynomial division
    for k in range(len(plain) - 1, -1, -1):
        if value >> (k + 15) & 1:
            value ^= 0b1100010110011001 << k
    plain += f"{value:015b}"
    out = ""
    for bit in plain:
        out += bit
        if len(out) >= 5 and len(set(out[-5:])) == 1:
            out += "1" if bit == "0" else "0"
    return out


def bits_of(message: can.Message) -> str:
    out = np.zeros(192, np.int64)
    n = wire.frame_bits(*frames.from_message(message), out)
    return "".join(str(b) for b in out[:n])


@given(ident=st.integers(0, 2**29 - 1), extended=st.booleans(), remote=st.booleans(), data=st.binary(max_size=8))
def test_bits_of_a_frame_are_those_of_the_standard(ident: int, extended: bool, remote: bool, data: bytes) -> None:
    message = can.Message(
        arbitration_id=ident if extended else ident & 0x7FF,
        is_extended_id=extended,
        is_remote_frame=remote,
        dlc=len(data),
        data=None if remote else data,
    )
    assert bits_of(message) == bits_by_the_book(message)


@given(ident=st.integers(0, 0x7FF), data=st.binary(min_size=8, max_size=8))
def test_a_frame_of_eight_bytes_takes_111_to_135_bits(ident: int, data: bytes) -> None:
    n = len(bits_of(frame(ident, data))) + wire.END + wire.INTERMISSION
    assert 111 <= n <= 135


def test_worst_case_of_stuffing_is_reached() -> None:
    # a start of frame, four zeros, then blocks of four: a stuff bit every four bits from the fifth on, as far as the CRC lets it
    assert len(bits_of(frame(0x078, b"\x3c\x3c\x3c\x3c\x3c\x3c\x3c\x3c", extended=False))) > 98 + 15


# ---- arbitration and time ---------------------------------------------------------------------------------------------------------------


def three(**options: Any) -> tuple[Channel, LockstepBus, LockstepBus, LockstepBus]:
    channel = Channel(**options)
    return channel, LockstepBus(channel), LockstepBus(channel), LockstepBus(channel)


def test_a_frame_arrives_after_exactly_its_bits() -> None:
    channel, a, b, _ = three()
    sent = frame(0x0A0, b"\x11\x22\x33\x44\x55\x66\x77\x88")
    a.send(sent)
    got = b.recv(1)
    bits = len(bits_by_the_book(sent)) + wire.END
    assert got is not None and got.timestamp == pytest.approx(bits * BIT, abs=1e-12)
    channel.advance(1e-3)
    assert channel.load == pytest.approx((bits + 3) / (round(got.timestamp / BIT) + 500))


def test_frames_follow_each_other_after_the_intermission() -> None:
    _, a, b, _ = three()
    sent = [frame(0x100 + k) for k in range(4)]
    for m in sent:
        a.send(m)
    got = [b.recv(1) for _ in sent]
    gaps = np.diff([m.timestamp for m in got if m]) / BIT
    assert np.allclose(gaps, [len(bits_by_the_book(m)) + wire.END + wire.INTERMISSION for m in sent[1:]])


def test_the_lowest_identifier_wins() -> None:
    _, a, b, c = three()
    a.send(frame(0x0B0)), b.send(frame(0x0A0)), b.send(frame(0x001))
    heard = [c.recv(1) for _ in range(3)]
    assert [m.arbitration_id for m in heard if m] == [0x0A0, 0x001, 0x0B0]  # a queue is first in, first out: 0x001 waits behind 0x0A0


def test_standard_beats_extended_and_data_beats_remote() -> None:
    _, a, b, c = three()
    a.send(frame(0x0A0 << 18, extended=True))
    b.send(frame(0x0A0))
    first, second = c.recv(1), c.recv(1)
    assert first is not None and not first.is_extended_id and second is not None and second.is_extended_id
    a.send(can.Message(arbitration_id=0x0A0, is_extended_id=False, is_remote_frame=True, dlc=8))
    b.send(frame(0x0A0))
    first, second = c.recv(1), c.recv(1)
    assert first is not None and not first.is_remote_frame and second is not None and second.is_remote_frame


def test_a_babbling_node_at_identifier_0_keeps_all_others_off() -> None:
    channel, a, b, c = three(queue=8)
    a.send(frame(0x0A0))
    for _ in range(400):
        for _ in range(8 - int(channel.wire.node[b.place, wire.TX_N])):
            b.send(frame(0x000))
        channel.advance(2e-4)
    heard = [m.arbitration_id for m in iter(lambda: c.recv(0), None)]
    assert len(heard) > 300 and 0x0A0 not in heard[1:] and channel.load > 0.99


# ---- queues -----------------------------------------------------------------------------------------------------------------------------


def test_a_full_queue_refuses_and_counts() -> None:
    channel, a, _, _ = three(queue=10)
    for k in range(10):
        a.send(frame(k), timeout=0)
    with pytest.raises(can.CanOperationError, match="transmit queue full"):
        a.send(frame(11), timeout=0)
    assert channel.wire.node[a.place, wire.REFUSED] == 1
    a.send(frame(12), timeout=0.01)  # lets simulated time run until there is room
    assert 0 < channel.now < 0.01


def test_a_full_receive_buffer_is_told_in_place() -> None:
    _, a, b, _ = three(buffer=16)
    for k in range(40):
        a.send(frame(k))
    a.channel.advance(0.02)
    heard = list(iter(lambda: b.recv(0), None))
    assert [m.arbitration_id for m in heard] == list(range(16)) and b.lost == 24
    a.send(frame(99))
    told, late = b.recv(1), b.recv(1)
    assert told is not None and told.is_error_frame and told.data[1] == 1 and int.from_bytes(told.data[4:8], "little") == 24
    assert late is not None and late.arbitration_id == 99


# ---- errors -----------------------------------------------------------------------------------------------------------------------------


def test_a_destroyed_frame_is_sent_again_and_counted() -> None:
    channel, a, b, c = three()
    channel.destroy(1)
    a.send(frame(0x0A0))
    first, second = b.recv(1), b.recv(1)
    assert first is not None and first.is_error_frame and first.arbitration_id == 0x088
    assert second is not None and second.arbitration_id == 0x0A0
    assert (a.tec, b.rec, c.rec) == (7, 0, 0)  # 8 for the error, 1 back for the success; receivers 1 and 1 back
    assert channel.wire.clock[wire.ERRORS] == 1


def test_error_counters_lead_to_passive_then_bus_off_then_back() -> None:
    channel, a, b, _ = three()
    channel.destroy(32, node=a.place)
    a.send(frame(0x0A0))
    states = []
    while a.state is not can.BusState.ERROR:
        states.append((a.tec, a.state))
        channel.advance(2e-5)
    assert (120, can.BusState.ACTIVE) in states and (128, can.BusState.PASSIVE) in states and a.tec == 256
    with pytest.raises(can.CanOperationError, match="bus-off"):
        a.send(frame(0x0A0))
    channel.advance(3e-4)  # to the end of the last error frame
    off = channel.wire.clock[wire.FREE] - wire.INTERMISSION  # end of the error delimiter
    told = [m.arbitration_id for m in iter(lambda: a.recv(0), None) if m.is_error_frame]
    assert told.count(0x088) == 32 and 0x004 in told and told[-1] == 0x040
    back = a.recv(1)
    assert back is not None and back.arbitration_id == 0x100 and a.state is can.BusState.ACTIVE and a.tec == 0
    waited = back.timestamp / BIT - off
    assert waited == pytest.approx(128 * 11, abs=11)
    a.send(frame(0x0A1))
    heard = [m.arbitration_id for m in iter(lambda: b.recv(0.01), None) if not m.is_error_frame]
    assert heard == [0x0A1]  # the frame that led to bus-off is gone, and counted
    assert channel.wire.node[a.place, wire.REFUSED] == 2


def test_bus_off_without_restart_lasts_until_somebody_ends_it() -> None:
    channel, a, b, _ = three(restart=False)
    channel.destroy(32)
    a.send(frame(1))
    channel.advance(1.0)
    assert a.state is can.BusState.ERROR
    a.state = can.BusState.ACTIVE
    a.send(frame(2))
    assert [m.arbitration_id for m in iter(lambda: b.recv(0.01), None) if not m.is_error_frame] == [2]


def test_a_busy_wire_delays_the_way_back_from_bus_off() -> None:
    times = []
    for busy in (False, True):
        channel, a, b, _ = three()
        channel.destroy(32, node=a.place)
        a.send(frame(0))
        while a.state is not can.BusState.ERROR:
            channel.advance(1e-4)
        started = channel.now
        while a.state is can.BusState.ERROR:
            if busy and channel.wire.node[b.place, wire.TX_N] < 5:
                b.send(frame(0x200))
            channel.advance(1e-4)
        times.append(channel.now - started)
    assert times[0] == pytest.approx(128 * 11 * BIT, abs=2e-4)
    assert times[1] == pytest.approx(128 * (len(bits_by_the_book(frame(0x200))) + 13) * BIT, rel=0.05)  # one occurrence a frame


def test_a_node_that_nobody_acknowledges_stays_error_passive() -> None:
    channel = Channel()
    a = LockstepBus(channel)
    a.send(frame(0x0A0))
    channel.advance(0.5)
    assert a.state is can.BusState.PASSIVE and a.tec == 128
    b = LockstepBus(channel)
    heard = b.recv(0.1)
    assert heard is not None and heard.arbitration_id == 0x0A0


def test_two_nodes_with_one_identifier_and_other_data_destroy_each_other() -> None:
    channel, a, b, c = three()
    for _ in range(5):
        a.send(frame(0x0A0, b"\x00" * 8)), b.send(frame(0x0A0, b"\xff" * 8))
    channel.advance(0.002)
    assert a.tec == b.tec == 8 * channel.wire.clock[wire.ERRORS] > 0
    channel.advance(0.05)
    assert a.state is can.BusState.ACTIVE or channel.wire.node[a.place, wire.BUS_OFFS] > 0
    same, x, y, z = three()
    x.send(frame(0x0A0)), y.send(frame(0x0A0))  # equal to the last bit: one frame on the wire
    assert z.recv(1) is not None and z.recv(0.01) is None and same.wire.clock[wire.FRAMES] == 1
    assert c.rec >= 0


def test_random_faults_are_the_same_for_the_same_seed() -> None:
    def heard(seed: int) -> list[Any]:
        channel, a, b, _ = three(error_rate=0.1, loss=0.1, seed=seed)
        for k in range(60):
            a.send(frame(k))
        out = [(m.timestamp, m.arbitration_id) for m in iter(lambda: b.recv(0.05), None)]
        assert channel.wire.node[b.place, wire.LOST] > 0 and channel.wire.clock[wire.ERRORS] > 0
        return out

    assert heard(3) == heard(3) != heard(4)


def test_periodic_messages_keep_simulated_time() -> None:
    _, a, b, _ = three()
    task = a.send_periodic(frame(0x0A0), 0.010, duration=0.095)
    got = [m.timestamp for m in iter(lambda: b.recv(0.02), None)]
    assert len(got) == 10 and np.allclose(np.diff(got), 0.010)
    task.stop()


def test_waiting_for_ever_for_nothing_is_an_error() -> None:
    _, a, _, _ = three()
    with pytest.raises(can.CanOperationError, match="nothing can come"):
        a.recv()


# ---- the whole loop ---------------------------------------------------------------------------------------------------------------------


def demand(seconds: float) -> np.ndarray:
    return np.interp(np.arange(0.0, seconds, 0.01), [0, 1, 3, 4, 6, 8], [60, 60, 85, 85, 70, 70])


def test_every_frame_on_the_wire_is_one_that_cantools_and_e2e_accept() -> None:
    run = run_lockstep(demand(5.0), seed=2)
    db: Any = cantools.database.load_file(tables.path("vgv.dbc"))
    counters: dict[int, int] = {}
    for head, data in run.rows.tolist():
        ident = head & frames.IDENT_MASK
        raw = data.to_bytes(8, "little", signed=True)
        assert e2e.p01.e2e_p01_check(bytearray(raw), 0x5600 + ident)
        v = db.decode_message(ident, raw, decode_choices=False)
        assert ident not in counters or v["counter"] == (counters[ident] + 1) % 15
        counters[ident] = v["counter"]
    idents, counts = np.unique(run.rows[:, 0] & frames.IDENT_MASK, return_counts=True)
    assert dict(zip(idents.tolist(), counts.tolist(), strict=True)) == {0xA0: 500, 0xB0: 500, 0xB1: 500, 0xB2: 500, 0xB3: 50}
    assert np.all(np.diff(run.t) > 0) and run.frames == 2050 and run.error_frames == 0 and 0.08 < run.load < 0.12
    assert run.vgv.mode == "RUN" and run.vgv.faults == 0 and run.ecu.stale() == []


def test_the_fast_loop_is_the_slow_one_made_of_parts() -> None:
    fast = run_lockstep(demand(2.0), seed=5)
    channel = Channel()
    vgv, ecu = Node(n_r=60.0, seed=5), Ecu(n_dem=60.0, seed=6)
    bus_vgv, bus_ecu, ears = LockstepBus(channel), LockstepBus(channel), LockstepBus(channel, silent=True)
    rows, heard, n_dem = np.zeros((64, 2), np.int64), [], demand(2.0)
    for k in range(2000):
        ecu.set_demand(float(n_dem[k // 10]))
        bus_ecu.write_rows(ecu.tick(rows, bus_ecu.read_rows(rows)))
        bus_vgv.write_rows(vgv.tick(rows, bus_vgv.read_rows(rows)))
        channel.advance(1e-3)
        n = ears.read_rows(rows)
        heard.append(rows[:n].copy())
    assert np.array_equal(np.concatenate(heard), fast.rows)
    assert vgv.fingerprint() == fast.vgv.fingerprint()


def test_a_faulty_wire_is_noticed_and_survived() -> None:
    channel = Channel(error_rate=0.02, loss=0.02, seed=9)
    run = run_lockstep(demand(20.0), seed=1, channel=channel)
    assert run.error_frames > 50 and run.vgv.counts["lost"] > 10 and run.vgv.mode == "RUN"
    assert run.vgv.counts["wrong_crc"] == 0  # the wire never delivers a spoiled frame


SCRIPT = """
import numpy as np
from hil.lockstep_bus import Channel, run_lockstep
r = run_lockstep(np.linspace(60, 70, 30), seed=3, channel=Channel(error_rate=0.05, loss=0.05, seed=1), hashed=True)
print(r.state_hash, r.vgv.fingerprint(), hash(r.rows.tobytes()), r.error_frames)
"""


def test_compiled_and_interpreted_loops_give_the_same_bits() -> None:
    answers = {
        subprocess.run(
            [sys.executable, "-c", SCRIPT], cwd=ROOT, env={**os.environ, "NUMBA_DISABLE_JIT": off, "PYTHONHASHSEED": "0"},
            capture_output=True, text=True, check=True,
        ).stdout
        for off in ("0", "1")
    }  # fmt: skip
    assert len(answers) == 1
