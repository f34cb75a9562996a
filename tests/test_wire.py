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

from hil.bus import frames, wire
from hil.bus.lockstep_bus import Channel, LockstepBus, run_lockstep
from hil.loop.node import Ecu, Node
from tests.conftest import ROOT
from vaneloop.base import tables

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
    # a start of frame, four zeros, then blocks of four: a stuff bit every four bits from the fifth on, as far as the
    # CRC lets it
    assert len(bits_of(frame(0x078, b"\x3c\x3c\x3c\x3c\x3c\x3c\x3c\x3c", extended=False))) > 98 + 15


# ---- arbitration and time --------------------------------------------------------------------------------------------


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
    assert [m.arbitration_id for m in heard if m] == [
        0x0A0,
        0x001,
        0x0B0,
    ]  # a queue is first in, first out: 0x001 waits behind 0x0A0


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


# ---- queues ----------------------------------------------------------------------------------------------------------


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
    assert (
        told is not None
        and told.is_error_frame
        and told.data[1] == 1
        and int.from_bytes(told.data[4:8], "little") == 24
    )
    assert late is not None and late.arbitration_id == 99


# ---- errors ----------------------------------------------------------------------------------------------------------


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
    assert times[1] == pytest.approx(
        128 * (len(bits_by_the_book(frame(0x200))) + 13) * BIT, rel=0.05
    )  # one occurrence a frame


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


# ---- the whole loop --------------------------------------------------------------------------------------------------


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
    assert dict(zip(idents.tolist(), counts.tolist(), strict=True)) == {
        0xA0: 500,
        0xB0: 500,
        0xB1: 500,
        0xB2: 500,
        0xB3: 50,
    }
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
from hil.bus.lockstep_bus import Channel, run_lockstep
r = run_lockstep(np.linspace(60, 70, 30), seed=3, channel=Channel(error_rate=0.05, loss=0.05, seed=1), hashed=True)
print(r.state_hash, r.vgv.fingerprint(), hash(r.rows.tobytes()), r.error_frames)
"""


@pytest.mark.slow
def test_compiled_and_interpreted_loops_give_the_same_bits() -> None:
    answers = {
        subprocess.run(
            [sys.executable, "-c", SCRIPT], cwd=ROOT,
            env={**os.environ, "NUMBA_DISABLE_JIT": off, "PYTHONHASHSEED": "0"},
            capture_output=True, text=True, check=True,
        ).stdout
        for off in ("0", "1")
    }  # fmt: skip
    assert len(answers) == 1


# ---- limits ----------------------------------------------------------------------------------------------------------


def test_an_error_passive_node_waits_eight_bits_more_after_its_own_frames() -> None:
    gaps = []
    for passive in (False, True):
        channel, a, b, _ = three()
        channel.wire.node[a.place, wire.TEC] = 140 if passive else 0
        channel.wire.node[a.place, wire.MODE] = wire.PASSIVE if passive else wire.ACTIVE
        sent = [frame(0x100), frame(0x101)]
        for m in sent:
            a.send(m)
        first, second = b.recv(1), b.recv(1)
        assert first is not None and second is not None
        gaps.append(round((second.timestamp - first.timestamp) / BIT) - len(bits_by_the_book(sent[1])) - wire.END)
    assert gaps == [3, 3 + 8]


@pytest.mark.parametrize(("before", "after"), [(0, 0), (1, 0), (127, 126), (128, 120), (255, 120)])
def test_a_good_frame_takes_back_one_point_of_a_receiver_or_ends_its_passive_state(before: int, after: int) -> None:
    channel, a, b, _ = three()
    channel.wire.node[b.place, wire.REC] = before
    a.send(frame(0x100))
    assert b.recv(1) is not None and b.rec == after and b.state is can.BusState.ACTIVE


@pytest.mark.parametrize(
    ("before", "after", "state"), [(126, 127, "ACTIVE"), (127, 128, "PASSIVE"), (255, 255, "PASSIVE")]
)
def test_a_destroyed_frame_costs_a_receiver_one_point_up_to_255(before: int, after: int, state: str) -> None:
    channel, a, b, _ = three()
    channel.wire.node[b.place, wire.REC] = before
    channel.destroy(1)
    a.send(frame(0x100))
    channel.advance(4e-5)
    assert channel.wire.clock[wire.ERRORS] == 1 and b.rec == after and b.state is getattr(can.BusState, state)


def test_an_error_frame_ends_fourteen_bits_after_the_error() -> None:
    channel, a, b, _ = three()
    sent = frame(0x100)
    channel.destroy(1)
    a.send(sent)
    told = b.recv(1)
    assert told is not None and told.is_error_frame
    assert round(told.timestamp / BIT) == len(bits_by_the_book(sent)) - 7 + 6 + 8


@pytest.mark.parametrize(
    ("node", "ident", "hit"),
    [(0, None, True), (1, None, False), (None, 0x100, True), (None, 0x101, False), (None, 0, False)],
)
def test_only_the_frames_asked_for_are_destroyed(node: int | None, ident: int | None, hit: bool) -> None:
    channel, a, b, _ = three()
    place = {0: a.place, 1: b.place}
    channel.destroy(1, **({"node": place[node]} if node is not None else {"ident": ident}))
    a.send(frame(0x100))
    channel.advance(1e-3)
    assert channel.wire.clock[wire.ERRORS] == hit and channel.wire.clock[wire.DESTROY] == (not hit)


@pytest.mark.parametrize(
    ("head", "taken"),
    [
        (0x100, True),
        (0x100 | 8 << 32, True),
        (0x100 | 9 << 32, False),
        (0x100 | frames.FD | 8 << 32, False),
        (0x100 | frames.ERROR, False),
    ],
)
def test_only_classic_frames_of_up_to_eight_bytes_are_queued(head: int, taken: bool) -> None:
    channel, a, _, _ = three()
    assert bool(wire.put(channel.wire, a.place, head, 0)) == taken
    assert channel.wire.node[a.place, wire.TX_N] == taken and channel.wire.node[a.place, wire.REFUSED] == (not taken)


def test_a_tick_is_a_millisecond_and_faults_of_a_seed_are_the_same_in_every_version() -> None:
    assert wire.BITS_PER_TICK / wire.BIT_RATE == 1e-3
    clock = wire.new_wire(seed=0).clock
    assert [round(float(wire._random(clock)), 9) for _ in range(3)] == [0.252481907, 0.616829282, 0.157647218]


def test_a_node_is_active_again_at_127_points() -> None:
    channel, a, b, _ = three()
    for before, state in ((129, can.BusState.PASSIVE), (128, can.BusState.ACTIVE)):
        channel.wire.node[a.place, wire.TEC], channel.wire.node[a.place, wire.MODE] = before, wire.PASSIVE
        a.send(frame(0x100))
        assert b.recv(1) is not None and a.tec == before - 1 and a.state is state


def test_others_come_first_while_an_error_passive_node_pauses() -> None:
    channel, a, b, c = three()
    channel.wire.node[a.place, wire.TEC], channel.wire.node[a.place, wire.MODE] = 140, wire.PASSIVE
    a.send(frame(0x100)), a.send(frame(0x101)), b.send(frame(0x200))
    assert [m.arbitration_id for m in (c.recv(1) for _ in range(3)) if m] == [0x100, 0x200, 0x101]


def test_frames_sent_and_received_are_counted_once() -> None:
    channel, a, b, _ = three()
    for k in range(3):
        a.send(frame(0x100 + k))
    channel.advance(2e-3)
    node = channel.wire.node
    assert node[a.place, wire.SENT] == 3 == node[b.place, wire.RECEIVED] == channel.wire.clock[wire.FRAMES]


# ---- the wire by itself: no bus, no messages -------------------------------------------------------------------------


def joined(nodes: int, **options: Any) -> wire.Wire:
    """A wire on which all nodes have joined and want error frames."""
    w = wire.new_wire(nodes, **options)
    w.node[:, [wire.JOINED, wire.WANTS_ERRORS]] = 1
    return w


def off(nodes: int, *which: int, **options: Any) -> wire.Wire:
    """A wire with these nodes bus-off from bit 0 on."""
    w = joined(nodes, **options)
    for j in which:
        w.node[j, wire.TEC], w.node[j, wire.MODE], w.node[j, wire.TO_RECOVER] = 256, wire.BUS_OFF, 128
    return w


def put(w: wire.Wire, j: int, message: can.Message) -> None:
    assert wire.put(w, j, *frames.from_message(message))


def heard_by(w: wire.Wire, j: int) -> list[tuple[int, can.Message]]:
    """What node ``j`` has received up to now, each with the bit at which it came."""
    row = np.zeros((1, 3), np.int64)
    out = []
    while wire.take(w, j, row):
        head, data, at = row[0].tolist()
        out.append((at, frames.to_message(head, data)))
    return out


def idents(heard: list[tuple[int, can.Message]]) -> list[int]:
    return [m.arbitration_id for _, m in heard]


def errors(heard: list[tuple[int, can.Message]]) -> list[tuple[int, bytes]]:
    """Class and data of each error frame."""
    return [(m.arbitration_id, bytes(m.data)) for _, m in heard if m.is_error_frame]


def length(message: can.Message) -> int:
    """Bits of a frame: the stuffed ones, then CRC delimiter, acknowledge slot and delimiter, seven of end of frame."""
    return len(bits_by_the_book(message)) + 1 + 1 + 1 + 7


def remote(ident: int, extended: bool = False) -> can.Message:
    return can.Message(arbitration_id=ident, is_extended_id=extended, is_remote_frame=True, dlc=0)


def test_a_wire_has_the_arrays_it_documents() -> None:
    w = wire.new_wire(3, 5, 7, 0.25, 0.5)
    assert w.clock.shape == (wire.N_CLOCK,) and w.node.shape == (3, wire.N_NODE) and w.chance.tolist() == [0.25, 0.5]
    assert w.tx.shape == (3, 5, 3) and w.rx.shape == (3, 7, 3) and w.bits.shape == (2, 192)


def test_each_seed_begins_its_own_numbers_the_same_in_every_version() -> None:
    first = [wire._random(wire.new_wire(seed=seed).clock) for seed in (1, 3, 2**31)]
    assert first == pytest.approx([0.968459920, 0.113890228, 0.536282271], abs=1e-9)


def test_a_frame_ends_ten_bits_behind_its_crc() -> None:
    w, sent = joined(2), frame(0x100)
    put(w, 0, sent)
    wire.run_wire(w, 1, -1)
    assert (
        w.clock[wire.FREE] == len(bits_by_the_book(sent)) + 10 + 3 and w.rx[1, 0, 2] == len(bits_by_the_book(sent)) + 10
    )


def test_a_length_beyond_eight_counts_as_eight() -> None:
    outs = np.zeros((2, 192), np.int64)
    numbers = [wire.frame_bits(0x100 | n << 32, 0x0123456789ABCDEF, out) for n, out in zip((8, 9), outs, strict=True)]
    assert numbers[0] == numbers[1] and np.array_equal(outs[0], outs[1])


# as ISO 11898-1 has it: each wins against all that follow
ORDER = [
    frame(0x060),
    remote(0x060),
    frame(0x060 << 18, extended=True),
    frame(0x09F << 18 | 0x3FFFF, extended=True),
    frame(0x0A0),
    remote(0x0A0),
    frame(0x0A0 << 18, extended=True),
    remote(0x0A0 << 18, extended=True),
    frame(0x0A0 << 18 | 1, extended=True),
    remote(0x0A0 << 18 | 1, extended=True),
    frame(0x0A0 << 18 | 0x10000, extended=True),
    frame(0x0A0 << 18 | 0x20000, extended=True),
    remote(0x0A0 << 18 | 0x3FFFF, extended=True),
    frame(0x0A1),
    remote(0x0A1),
    frame(0x0A1 << 18, extended=True),
    frame(0x0A2),
    frame(0x7FF),
]


@pytest.mark.parametrize("first", range(len(ORDER) - 1))
def test_arbitration_follows_identifier_then_kind_then_the_rest_of_the_identifier(first: int) -> None:
    for second in range(first + 1, len(ORDER)):
        w = joined(3)
        put(w, 0, ORDER[second]), put(w, 1, ORDER[first])
        wire.run_wire(w, 1, -1)
        assert w.clock[wire.FRAMES] == 1 and w.node[:, wire.SENT].tolist() == [0, 1, 0]


def test_who_queues_at_the_bit_at_which_a_frame_could_begin_takes_part() -> None:
    w = joined(3)
    put(w, 0, frame(0x200))
    wire.run_wire(w, 0, -1)
    put(w, 1, frame(0x100))
    wire.run_wire(w, 1000, -1)
    assert idents(heard_by(w, 2)) == [0x100, 0x200]


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (frame(0x0A0, b"\x00" * 8), frame(0x0A0, b"\xff" + b"\x00" * 7)),
        (frame(0x0A0, b"\x00" * 8), frame(0x0A0, b"\x00" * 7 + b"\x01")),
        (frame(0x0A0, b"\xff" * 8), frame(0x0A0, b"\x7f" * 8)),
        (frame(0x0A0, b""), frame(0x0A0, b"\x00")),
        (frame(0x0A0, b"\x00"), frame(0x0A0, b"\x00" * 8)),
        (remote(0x0A0), can.Message(arbitration_id=0x0A0, is_extended_id=False, is_remote_frame=True, dlc=8)),
        (frame(0x155 << 18 | 77, b"\x12", extended=True), frame(0x155 << 18 | 77, b"\x13", extended=True)),
    ],
)
def test_two_frames_that_differ_behind_the_identifier_end_at_the_first_bit_that_differs(
    one: can.Message, other: can.Message
) -> None:
    a, b = bits_by_the_book(one), bits_by_the_book(other)
    differs = next(i for i, (x, y) in enumerate(zip(a, b, strict=False)) if x != y) + 1
    for first, second in ((one, other), (other, one)):
        w = joined(4)
        put(w, 1, first), put(w, 2, second)
        wire.run_wire(w, 1, -1)
        assert w.clock[wire.ERRORS] == 1 and w.clock[wire.FREE] == differs + 6 + 8 + 3
        assert w.node[:, wire.TEC].tolist() == [0, 8, 8, 0] and w.node[:, wire.REC].tolist() == [1, 0, 0, 1]


def test_who_still_pauses_does_not_send_along_with_a_frame_like_its_own() -> None:
    w = joined(3)
    w.node[0, wire.TEC], w.node[0, wire.MODE] = 140, wire.PASSIVE
    put(w, 0, frame(0x100)), put(w, 0, frame(0x200))
    wire.run_wire(w, 1, -1)
    put(w, 1, frame(0x200))
    wire.run_wire(w, 1000, -1)
    assert idents(heard_by(w, 2)) == [0x100, 0x200, 0x200] and w.node[:, wire.SENT].tolist() == [2, 1, 0]


def test_a_node_that_left_neither_sends_nor_holds_up_the_others() -> None:
    w = joined(3)
    put(w, 0, frame(0x100)), put(w, 1, frame(0x200))
    w.node[0, wire.JOINED] = 0
    wire.run_wire(w, 5000, -1)
    assert w.clock[wire.FRAMES] == 1 and idents(heard_by(w, 2)) == [0x200] and w.clock[wire.ERRORS] == 0
    w.node[1, wire.JOINED] = 0
    wire.run_wire(w, 9000, -1)
    assert w.clock[wire.FRAMES] == 1 and w.clock[wire.NOW] == 9000


def test_a_node_that_left_while_bus_off_does_not_come_back() -> None:
    w = off(3, 0)
    w.node[0, wire.JOINED] = 0
    wire.run_wire(w, 9000, -1)
    assert w.node[0, wire.MODE] == wire.BUS_OFF and heard_by(w, 0) == []


def test_the_first_node_is_waited_for_like_any_other() -> None:
    w, sent = joined(2), frame(0x100)
    put(w, 1, sent)
    wire.run_wire(w, 9000, 0)
    assert w.clock[wire.NOW] == length(sent)


def test_a_wait_ends_before_all_else_that_happens_at_the_same_bit() -> None:
    w = off(2, 0, 1)
    wire.run_wire(w, 128 * 11, 0)
    assert w.node[:, wire.MODE].tolist() == [wire.ACTIVE, wire.BUS_OFF] and w.clock[wire.NOW] == 128 * 11
    wire.run_wire(w, 128 * 11, -1)
    assert w.node[:, wire.MODE].tolist() == [wire.ACTIVE, wire.ACTIVE]


def test_own_frames_are_given_to_those_that_want_them_and_marked() -> None:
    channel = Channel()
    a, b = LockstepBus(channel, receive_own_messages=True), LockstepBus(channel)
    a.send(frame(0x100, b"\x05")), b.send(frame(0x101, b"\x06"))
    for bus, expected in ((a, [(0x100, b"\x05", False), (0x101, b"\x06", True)]), (b, [(0x100, b"\x05", True)])):
        got = list(iter(lambda bus=bus: bus.recv(1e-3), None))
        assert [(m.arbitration_id, bytes(m.data), m.is_rx) for m in got] == expected and not any(
            m.is_extended_id for m in got
        )


def test_rows_are_taken_in_order_as_many_as_there_is_room_for() -> None:
    w = joined(2)
    for k in range(3):
        put(w, 0, frame(0x100 + k, bytes([k])))
    wire.run_wire(w, 1000, -1)
    rows = np.zeros((2, 2), np.int64)
    assert wire.take(w, 1, rows) == 2 and rows.tolist() == [[0x100 | 1 << 32, 0], [0x101 | 1 << 32, 1]]
    assert wire.take(w, 1, rows) == 1 and rows[0].tolist() == [0x102 | 1 << 32, 2] and wire.take(w, 1, rows) == 0


def test_a_full_receive_buffer_takes_nothing_before_it_has_room_to_tell_what_is_gone() -> None:
    w, row = joined(2, buffer=3), np.zeros((1, 2), np.int64)
    until = 0

    def send(ident: int) -> None:
        nonlocal until
        put(w, 0, frame(ident))
        until += 500
        wire.run_wire(w, until, -1)

    for k in range(4):
        send(0x100 + k)
    assert w.node[1, [wire.RX_N, wire.OVERRUN]].tolist() == [3, 1]
    assert wire.take(w, 1, row) == 1
    send(0x104)  # room for one: that is kept for what is to be told
    assert w.node[1, [wire.RX_N, wire.OVERRUN]].tolist() == [2, 2]
    assert wire.take(w, 1, row) == 1
    send(0x105)
    assert w.node[1, [wire.RX_N, wire.OVERRUN]].tolist() == [3, 2]
    heard = heard_by(w, 1)
    assert idents(heard) == [0x102, 0x004, 0x105]
    assert errors(heard) == [(0x004, bytes([0, 1, 0, 0, 2, 0, 0, 0]))]  # CAN_ERR_CRTL_RX_OVERFLOW, and how many
    for k in range(3):
        send(0x106 + k)
    assert idents(heard_by(w, 1)) == [0x106, 0x107, 0x108] and w.node[1, wire.OVERRUN] == 2  # told once


# ---- error frames as SocketCAN's linux/can/error.h lays them out, counters, bus-off ----------------------------------

NOTHING = bytes(8)
DESTROYED, OFF, BACK = (0x088, NOTHING), (0x040, NOTHING), (0x100, NOTHING)  # PROT | BUSERROR, BUSOFF, RESTARTED
RX_PASSIVE, TX_PASSIVE = (0x004, b"\0\x10\0\0\0\0\0\0"), (0x004, b"\0\x20\0\0\0\0\0\0")  # CRTL, detail in data[1]


def test_a_sender_is_told_of_each_error_once_of_the_passive_state_and_of_bus_off() -> None:
    w = joined(2)
    w.clock[wire.DESTROY] = 32
    put(w, 0, frame(0x100)), put(w, 0, frame(0x101))
    wire.run_wire(w, 6000, -1)
    heard = heard_by(w, 0)
    assert errors(heard) == [DESTROYED] * 16 + [TX_PASSIVE] + [DESTROYED] * 16 + [OFF, BACK]
    assert all(m.dlc == 8 and m.is_error_frame for _, m in heard)
    assert errors(heard_by(w, 1)) == [DESTROYED] * 32
    assert w.node[0, [wire.TEC, wire.REC, wire.BUS_OFFS, wire.REFUSED, wire.TX_N]].tolist() == [0, 0, 1, 2, 0]
    assert w.node[1, wire.REC] == 32


@pytest.mark.parametrize(
    ("tec", "rec", "told"),
    [
        (112, 0, []),
        (119, 0, []),
        (120, 0, [TX_PASSIVE]),
        (126, 0, [TX_PASSIVE]),
        (0, 126, []),
        (0, 127, [RX_PASSIVE]),
        (127, 127, [RX_PASSIVE]),
    ],
)
def test_beyond_127_points_a_node_is_told_which_counter_made_it_passive(
    tec: int, rec: int, told: list[tuple[int, bytes]]
) -> None:
    w, j = joined(2), 0 if rec == 0 else 1
    w.node[j, wire.TEC], w.node[j, wire.REC] = tec, rec
    w.clock[wire.DESTROY] = 1
    put(w, 0, frame(0x100))
    wire.run_wire(w, 1, -1)
    wire.run_wire(w, int(w.clock[wire.FREE]), -1)
    assert errors(heard_by(w, j)) == [DESTROYED, *told]
    assert w.node[j, wire.MODE] == (wire.PASSIVE if told else wire.ACTIVE)


@pytest.mark.parametrize(("before", "mode"), [(247, wire.PASSIVE), (248, wire.BUS_OFF)])
def test_a_node_is_bus_off_beyond_255_points(before: int, mode: int) -> None:
    w = joined(2)
    w.node[0, wire.TEC], w.node[0, wire.MODE] = before, wire.PASSIVE
    w.clock[wire.DESTROY] = 1
    put(w, 0, frame(0x100))
    wire.run_wire(w, 1, -1)
    assert w.node[0, wire.TEC] == before + 8 and w.node[0, wire.MODE] == mode
    assert w.node[0, wire.BUS_OFFS] == (mode == wire.BUS_OFF)


def test_a_restart_takes_128_times_11_recessive_bits() -> None:
    w = off(2, 0)
    w.node[0, wire.REC] = 5
    wire.run_wire(w, 128 * 11 - 1, -1)
    assert w.node[0, wire.MODE] == wire.BUS_OFF and heard_by(w, 0) == []
    wire.run_wire(w, 128 * 11, -1)
    assert w.node[0, [wire.MODE, wire.TEC, wire.REC]].tolist() == [wire.ACTIVE, 0, 0]
    assert [(at, *errors([(at, m)])[0]) for at, m in heard_by(w, 0)] == [(128 * 11, *BACK)]


def test_recessive_bits_before_a_frame_and_its_end_count_for_a_restart() -> None:
    w, sent = off(3, 0), frame(0x100)
    wire.run_wire(w, 50, -1)
    put(w, 1, sent)
    wire.run_wire(w, 9000, -1)
    # four times eleven before the frame, once behind it: acknowledge delimiter, end of frame, intermission
    assert [at for at, _ in heard_by(w, 0)] == [50 + length(sent) + 3 + (128 - 4 - 1) * 11]


def test_who_is_bus_off_hears_neither_frames_nor_errors() -> None:
    w = off(3, 0, restart=False)
    w.clock[wire.DESTROY] = 1
    put(w, 1, frame(0x100))
    wire.run_wire(w, 9000, -1)
    assert (w.clock[wire.ERRORS], w.clock[wire.FRAMES]) == (1, 1) and heard_by(w, 0) == []
    assert w.node[0, [wire.TEC, wire.REC, wire.RECEIVED]].tolist() == [256, 0, 0]
    assert w.node[0, wire.TO_RECOVER] == 128  # nor does it recover before it is let


def test_each_node_comes_back_at_its_own_time() -> None:
    for waits in ((128, 100, 114), (100, 128, 114)):
        w = off(4, 0, 1, 2)
        w.node[:3, wire.TO_RECOVER] = waits
        wire.run_wire(w, 9000, -1)
        assert [at for j in range(3) for at, _ in heard_by(w, j)] == [11 * n for n in waits]
        assert not w.node[:, wire.MODE].any()


def test_a_good_frame_of_a_sender_without_points_leaves_it_none() -> None:
    w = joined(2)
    put(w, 0, frame(0x100))
    wire.run_wire(w, 1, -1)
    assert w.node[:, [wire.TEC, wire.REC]].tolist() == [[0, 0], [0, 0]]


def test_a_frame_that_nobody_acknowledges_ends_behind_its_acknowledge_slot() -> None:
    w, sent = joined(1), frame(0x100)
    put(w, 0, sent)
    wire.run_wire(w, 1, -1)
    assert w.clock[wire.FREE] == len(bits_by_the_book(sent)) + 2 + 6 + 8 + 3 and w.clock[wire.ERRORS] == 1


def test_a_missing_acknowledgement_costs_a_passive_sender_nothing_but_any_other_error_does() -> None:
    for destroyed, points in ((0, 140), (1, 148)):
        w = joined(1)
        w.node[0, wire.TEC], w.node[0, wire.MODE], w.clock[wire.DESTROY] = 140, wire.PASSIVE, destroyed
        put(w, 0, frame(0x100))
        wire.run_wire(w, 1, -1)
        assert w.node[0, wire.TEC] == points and w.clock[wire.ERRORS] == 1


def test_two_nodes_that_destroy_each_other_go_bus_off_though_nobody_else_is_there() -> None:
    w = joined(2, restart=False)
    put(w, 0, frame(0x0A0, b"\x00")), put(w, 1, frame(0x0A0, b"\x01"))
    wire.run_wire(w, 9000, -1)
    assert w.node[:, wire.MODE].tolist() == [wire.BUS_OFF] * 2 and w.clock[wire.ERRORS] == 32


def test_frames_to_destroy_are_those_of_the_node_given_be_it_the_first() -> None:
    for node, hits in ((-1, 1), (0, 0), (1, 1), (2, 0)):
        w = joined(3)
        w.clock[wire.DESTROY], w.clock[wire.DESTROY_NODE] = 1, node
        put(w, 1, frame(0x100))
        wire.run_wire(w, 1, -1)
        assert w.clock[wire.ERRORS] == hits


def test_a_frame_that_two_nodes_send_is_destroyed_as_either_ones() -> None:
    for node in (0, 1):
        w = joined(3)
        w.clock[wire.DESTROY], w.clock[wire.DESTROY_NODE] = 1, node
        put(w, 0, frame(0x100)), put(w, 1, frame(0x100))
        wire.run_wire(w, 1, -1)
        assert w.clock[wire.ERRORS] == 1


def test_the_wire_is_busy_from_the_start_of_a_frame_to_the_end_of_the_intermission() -> None:
    w, sent = joined(2), frame(0x100)
    for at in (700, 1400):
        wire.run_wire(w, at, -1)
        put(w, 0, sent)
    wire.run_wire(w, 3000, -1)
    assert w.clock[wire.BUSY] == 2 * (length(sent) + 3) and w.clock[wire.FREE] == 1400 + length(sent) + 3


# ---- chance ----------------------------------------------------------------------------------------------------------


def test_random_numbers_are_drawn_only_where_a_rate_is_not_0() -> None:
    for error_rate, loss, drawn in ((0.0, 0.0, 0), (1e-12, 0.0, 1), (0.0, 1e-12, 2)):
        w = joined(3, error_rate=error_rate, loss=loss, seed=7)
        put(w, 0, frame(0x100))
        fresh = wire.new_wire(seed=7).clock
        wire.run_wire(w, 1, -1)
        for _ in range(drawn):  # one a frame, and one for each of two receivers
            wire._random(fresh)
        assert w.clock[wire.RANDOM] == fresh[wire.RANDOM] and w.clock[wire.FRAMES] == 1


@pytest.mark.parametrize("seed", range(6))
def test_a_frame_is_destroyed_or_lost_where_its_number_is_below_the_rate(seed: int) -> None:
    number = wire._random(wire.new_wire(seed=seed).clock)
    for rate, hit in ((number, 0), (np.nextafter(number, 1.0), 1)):
        w = joined(2, error_rate=rate, seed=seed)
        put(w, 0, frame(0x100))
        wire.run_wire(w, 1, -1)
        assert (w.clock[wire.ERRORS], w.clock[wire.FRAMES]) == (hit, 1 - hit)
        w = joined(2, loss=rate, seed=seed)
        put(w, 0, frame(0x100))
        wire.run_wire(w, 1, -1)
        assert w.node[1, [wire.LOST, wire.RECEIVED]].tolist() == [hit, 1 - hit] and w.clock[wire.ERRORS] == 0


def test_a_random_error_is_at_any_bit_of_the_frame_alike() -> None:
    sent = frame(0x100)
    bits, at = len(bits_by_the_book(sent)), []
    for seed in range(60):
        w = joined(2, error_rate=1.0, seed=seed)
        put(w, 0, sent)
        wire.run_wire(w, 1, -1)
        at.append(int(w.clock[wire.FREE]) - 3 - 8 - 6)
        clock = wire.new_wire(seed=seed).clock
        wire._random(clock)
        share = wire._random(clock)
        assert 0 <= at[-1] - 1 <= share * bits < at[-1]  # the bit in which that share of the frame lies
    assert min(at) < 0.1 * bits and max(at) > 0.9 * bits
