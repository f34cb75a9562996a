"""The bus in simulated time call by call and bit by bit, as `hil.bus.lockstep_bus` has it.

Bits are counted here once more (`bits`): a frame as CAN 2.0 has it, with its stuff bits and its CRC, in strings. All
numbers stand here again: 500 kbit/s, 64 frames to send, 4,096 received, 16 participants.
"""

from __future__ import annotations

import itertools
from types import SimpleNamespace
from typing import Any

import can
import numpy as np
import pytest

from hil.bus import frames, lockstep_bus
from hil.bus import wire as w
from hil.bus.lockstep_bus import Channel, LockstepBus, channel_of, run_lockstep
from hil.loop.node import Ecu, Node

BIT = 1 / 500_000  # s
GAP = 3  # bits between frames
_numbers = itertools.count()


def new_name() -> str:
    """A wire that nobody else has."""
    return f"spec-{next(_numbers)}"


def bits(ident: int, data: bytes = b"") -> int:
    """Bits of a classic data frame with an 11-bit identifier, from its start to the end of frame."""
    plain = f"0{ident:011b}000{len(data):04b}" + "".join(f"{b:08b}" for b in data)
    crc = 0
    for b in plain:
        top = crc >> 14 ^ int(b)
        crc = (crc << 1 & 0x7FFF) ^ (0x4599 if top else 0)
    plain += f"{crc:015b}"
    sent = ""
    for b in plain:
        sent += b
        if len(sent) >= 5 and set(sent[-5:]) == {b} and stuffable(sent):
            sent += "10"[int(b)]
    return len(sent) + 10


def stuffable(sent: str) -> bool:
    """Whether the run at the end is five long, counted as CAN does: a stuff bit begins a run of its own."""
    run, last = 0, ""
    for b in sent:
        run = run + 1 if b == last else 1
        last = b
        if run > 5:
            return False
    return run == 5


def frame(ident: int, data: bytes = b"", **more: Any) -> can.Message:
    return can.Message(arbitration_id=ident, is_extended_id=False, data=data, **more)


def two(channel: Channel | None = None, **options: Any) -> tuple[LockstepBus, LockstepBus, Channel]:
    """A sender with these options and a listener on one wire."""
    channel = channel or Channel()
    return LockstepBus(channel, **options), LockstepBus(channel), channel


def idents(bus: LockstepBus, n: int = 9) -> list[int]:
    """Identifiers of what has come up to now."""
    rows = np.zeros((n, 2), np.int64)
    return [int(r) & 0x1FFFFFFF for r in rows[: bus.read_rows(rows), 0]]


# ---- the wire and its participants -----------------------------------------------------------------------------------


def test_a_wire_as_made_has_no_faults_and_room_for_64_to_send_and_4096_to_receive() -> None:
    c = Channel()
    assert c.wire.tx.shape[1] == 64 and c.wire.rx.shape[1] == 4096 and c.wire.node.shape[0] == 16
    assert c.wire.chance.tolist() == [0.0, 0.0] and c.wire.clock[w.RESTART] == 1 and c.tasks == []
    assert (c.wire.clock == Channel(seed=0).wire.clock).all() and c.now == 0.0 and c.load == 0.0
    assert (c.wire.clock != Channel(seed=1).wire.clock).any()


def test_a_wire_has_the_options_that_it_is_given() -> None:
    c = Channel(queue=2, buffer=3, error_rate=0.25, loss=0.5, seed=7, restart=False)
    assert c.wire.tx.shape[1] == 2 and c.wire.rx.shape[1] == 3
    assert c.wire.chance.tolist() == [0.25, 0.5] and c.wire.clock[w.RESTART] == 0


@pytest.mark.parametrize("name", ["error_rate", "loss"])
def test_a_rate_is_a_probability(name: str) -> None:
    for value in (0.0, 0.5, 1.0):
        options: dict[str, Any] = {name: value}
        assert value in Channel(**options).wire.chance.tolist()
    for value in (-0.001, 1.001, 1.2, float("nan")):
        options = {name: value}
        with pytest.raises(ValueError) as e:
            Channel(**options)
        assert str(e.value) == f"{name} (={value}) must be in [0, 1]"


def test_sixteen_participants_have_a_place_and_the_seventeenth_has_none() -> None:
    c = Channel()
    assert [c.join() for _ in range(16)] == list(range(16))
    with pytest.raises(can.CanInitializationError) as e:
        c.join()
    assert str(e.value) == "the lockstep bus has no place left for participant 17"
    c.leave(5)
    c.leave(3)
    assert (c.join(), c.join()) == (3, 5)


def test_a_participant_hears_errors_and_not_itself_unless_it_says_otherwise() -> None:
    c = Channel()
    flags = (w.JOINED, w.WANTS_OWN, w.WANTS_ERRORS, w.SILENT)
    c.join()
    c.join(own=True, errors=False, silent=True)
    assert c.wire.node[0, flags].tolist() == [1, 0, 1, 0] and c.wire.node[1, flags].tolist() == [1, 1, 0, 1]


def test_a_place_that_is_taken_again_knows_nothing_of_the_one_before() -> None:
    a, b, c = two()
    a.send(frame(1))
    c.advance(0.01)
    c.destroy(1)
    a.send(frame(1))
    c.advance(0.00002)
    assert a.tec > 0 and c.wire.node[a.place].any()
    a.shutdown()
    again = LockstepBus(c)
    assert again.place == a.place and again.tec == again.rec == again.lost == 0 and idents(again) == []
    assert c.wire.node[again.place].sum() == 2  # there, and told of errors
    c.advance(0.01)
    assert idents(b) == [1, 0x88]


def test_time_goes_on_by_what_is_asked_to_the_nearest_bit() -> None:
    c = Channel()
    c.advance(0.25)
    assert c.now == 0.25 and c.wire.clock[w.NOW] == 125_000
    c.advance(2.6 * BIT)
    assert c.wire.clock[w.NOW] == 125_003
    c.advance_to(125_003)
    c.advance_to(7)  # never back
    assert c.wire.clock[w.NOW] == 125_003


def test_time_stops_where_the_participant_that_is_watched_has_something() -> None:
    a, b, c = two()
    third = LockstepBus(c)
    a.send(frame(0x123, b"abc"))
    n = bits(0x123, b"abc")
    c.advance(1.0, a.place)
    assert c.now == 1.0  # the sender hears nothing
    a.send(frame(0x123, b"abc"))
    idents(b)
    c.advance(1.0, b.place)
    assert c.wire.clock[w.NOW] == 500_000 + n
    c.advance(1.0)
    assert c.wire.clock[w.NOW] == 1_000_000 + n
    assert idents(b) == [0x123] and idents(third) == [0x123, 0x123]


def test_by_itself_time_waits_for_nobody() -> None:
    """Whoever has something to take: without a watch the time asked for passes."""
    a, b, c = two()
    for sender in (a, b):
        sender.send(frame(5))
        begin = c.now
        c.advance(0.5)
        assert c.now == begin + 0.5
        sender.send(frame(5))
        c.advance_to(int(c.wire.clock[w.NOW]) + 250_000)
        assert c.now == begin + 1.0


def test_the_load_is_the_share_of_frames_and_their_gaps() -> None:
    a, _, c = two()
    a.send(frame(0x123, b"abc"))
    n = bits(0x123, b"abc") + GAP
    c.advance(2 * BIT)  # the frame that has begun is carried through
    assert c.load == 1.0
    c.advance_to(4 * n)
    assert c.load == 0.25


def test_a_load_is_no_quotient_of_nothing() -> None:
    c = Channel()
    c.advance_to(1)
    assert c.load == 0.0
    c.wire.clock[w.BUSY] = 1
    assert c.load == 1.0


def test_a_wire_is_idle_when_nothing_can_come_by_itself() -> None:
    a, b, c = two()
    assert c.idle()
    a.send(frame(1))
    assert not c.idle()
    c.advance(0.01)
    assert c.idle()
    task = b.send_periodic(frame(2), 1.0)
    assert not c.idle()
    task.stop()
    c.advance(0.01)
    assert c.idle()
    c.wire.node[a.place, w.MODE], c.wire.node[a.place, w.TO_RECOVER] = w.BUS_OFF, 5
    assert not c.idle()
    a.state = can.BusState.ACTIVE
    assert c.idle()
    a.send(frame(3))
    c.leave(a.place)  # what a participant that is gone had to send is nobody's
    assert c.idle()


def test_a_bus_off_participant_that_stays_so_is_waited_for_by_nobody() -> None:
    c = Channel(restart=False)
    a, b, _ = two(c)
    c.wire.node[a.place, w.MODE], c.wire.node[a.place, w.TO_RECOVER] = w.BUS_OFF, 128
    assert c.idle()
    with pytest.raises(can.CanOperationError, match="nothing can come"):
        b.recv()


def test_frames_are_destroyed_as_many_as_are_asked_for_whoever_sends_them() -> None:
    a, b, c = two()
    for sender in (a, b):
        c.destroy(2)
        sender.send(frame(0x1))
        c.advance(0.01)
    assert c.wire.clock[w.ERRORS] == 4 and c.wire.clock[w.FRAMES] == 2
    c.destroy(1, node=b.place)
    a.send(frame(0x1))
    c.advance(0.01)
    assert c.wire.clock[w.ERRORS] == 4
    b.send(frame(0x1))
    c.advance(0.01)
    assert c.wire.clock[w.ERRORS] == 5
    c.destroy(1, ident=0x10)
    a.send(frame(0x11))
    c.advance(0.01)
    assert c.wire.clock[w.ERRORS] == 5
    a.send(frame(0x10))
    c.advance(0.01)
    assert c.wire.clock[w.ERRORS] == 6


def test_destruction_that_names_nothing_is_of_any_node_and_identifier() -> None:
    c = Channel()
    c.wire.clock[w.DESTROY_NODE] = c.wire.clock[w.DESTROY_IDENT] = 4
    c.destroy(3)
    assert c.wire.clock[w.DESTROY] == 3
    assert c.wire.clock[w.DESTROY_NODE] < 0 and c.wire.clock[w.DESTROY_IDENT] < 0


# ---- a bus -----------------------------------------------------------------------------------------------------------


def test_buses_of_one_name_share_a_wire_until_the_last_has_left() -> None:
    name = new_name()
    a, b = LockstepBus(name), LockstepBus(name)
    wire = a.channel
    assert b.channel is wire is channel_of(name) and (a.place, b.place) == (0, 1)
    a.shutdown()
    assert channel_of(name) is wire
    b.shutdown()
    again = LockstepBus(name)
    assert again.channel is not wire and lockstep_bus._channels[name] is again.channel
    again.shutdown()
    assert name not in lockstep_bus._channels


def test_without_a_name_it_is_the_wire_called_lockstep() -> None:
    bus = LockstepBus()
    assert bus.channel is channel_of() is channel_of("lockstep") and bus.name == "lockstep"
    assert bus.channel_info == "lockstep bus 'lockstep'"
    bus.shutdown()
    assert "lockstep" not in lockstep_bus._channels


def test_a_wire_of_ones_own_belongs_to_no_name() -> None:
    name = new_name()
    kept = channel_of(name)
    own = LockstepBus(kept)
    assert own.channel is kept and own.name is None and own.channel_info == "lockstep bus 'own'"
    own.shutdown()
    assert channel_of(name) is kept  # only those who joined by the name count as its participants
    named = LockstepBus(name)
    assert named.channel_info == f"lockstep bus '{name}'"
    named.shutdown()
    assert name not in lockstep_bus._channels


def test_a_bus_begins_active_without_errors_and_without_filters() -> None:
    a, _, c = two()
    assert (a.tec, a.rec, a.lost, a.state, a.filters) == (0, 0, 0, can.BusState.ACTIVE, None)
    node = c.wire.node[a.place]
    assert node[[w.JOINED, w.WANTS_OWN, w.WANTS_ERRORS, w.SILENT]].tolist() == [1, 0, 1, 0]
    b = LockstepBus(c, receive_own_messages=True, receive_errors=False, silent=True)
    assert c.wire.node[b.place, [w.JOINED, w.WANTS_OWN, w.WANTS_ERRORS, w.SILENT]].tolist() == [1, 1, 0, 1]


def test_the_state_follows_the_mode_and_the_counters_are_the_nodes() -> None:
    a, _, c = two()
    node = c.wire.node[a.place]
    node[w.TEC], node[w.REC], node[w.OVERRUN] = 130, 7, 12
    for mode, state in ((0, can.BusState.ACTIVE), (1, can.BusState.PASSIVE), (2, can.BusState.ERROR)):
        node[w.MODE] = mode
        assert a.state is state
    assert (a.tec, a.rec, a.lost) == (130, 7, 12)
    node[w.TO_RECOVER] = 128
    for refused in (can.BusState.PASSIVE, can.BusState.ERROR):
        with pytest.raises(ValueError) as e:
            a.state = refused
        assert str(e.value) == f"state (={refused}) can be set to ACTIVE only: back from bus-off at once"
    assert a.state is can.BusState.ERROR
    a.state = can.BusState.ACTIVE
    assert a.state is can.BusState.ACTIVE and node[[w.MODE, w.TEC, w.REC, w.TO_RECOVER]].tolist() == [0, 0, 0, 0]
    assert a.lost == 12


def test_a_frame_arrives_at_its_last_bit_with_its_data() -> None:
    a, b, c = two()
    a.send(frame(0x123, b"abc"))
    assert c.now == 0.0 and b.recv(0) is None
    got = b.recv(1.0)
    assert got is not None and got.equals(frame(0x123, b"abc"), timestamp_delta=None, check_channel=False)
    n = bits(0x123, b"abc")
    assert got.timestamp == n / 500_000 == c.now and got.channel == "lockstep" and got.is_rx
    assert a.recv(0.001) is None and c.wire.clock[w.NOW] == n + 500


def test_two_frames_in_a_row_are_three_bits_apart() -> None:
    a, b, _ = two()
    a.send(frame(0x100, b"\x01"))
    a.send(frame(0x100, b"\x02\x03"))
    stamps = [m.timestamp / BIT for m in (b.recv(1.0), b.recv(1.0)) if m]
    first = bits(0x100, b"\x01")
    assert stamps == [pytest.approx(first), pytest.approx(first + GAP + bits(0x100, b"\x02\x03"))]


def test_own_frames_are_marked_and_only_for_who_wants_them() -> None:
    name = new_name()
    a, b = LockstepBus(name, receive_own_messages=True), LockstepBus(name)
    a.send(frame(7, b"x"))
    own, other = a.recv(1.0), b.recv(1.0)
    assert own is not None and other is not None
    assert (own.is_rx, other.is_rx) == (False, True) and own.arbitration_id == other.arbitration_id == 7
    assert own.channel == other.channel == name and own.timestamp == other.timestamp and own.dlc == 1
    a.send(frame(7, b"x"))
    rows = np.zeros((1, 2), np.int64)
    a.channel.advance(0.01)
    assert a.read_rows(rows) == 1 and rows[0].tolist() == [1 << 32 | 7, ord("x")]
    assert b.read_rows(rows) == 1 and rows[0].tolist() == [1 << 32 | 7, ord("x")]
    a.shutdown()
    b.shutdown()


@pytest.mark.parametrize(
    ("message", "kind"),
    [
        (frame(1, b"x", is_fd=True), "CAN FD"),
        (frame(1, b"x" * 64, is_fd=True), "CAN FD"),
        (frame(1, b"12345678", is_error_frame=True), "error"),
        (frame(1, b"12345678", is_fd=True, is_error_frame=True, check=False), "CAN FD"),
    ],
)
def test_what_a_classic_bus_cannot_send_is_refused(message: can.Message, kind: str) -> None:
    a, _, c = two()
    with pytest.raises(can.CanOperationError) as e:
        a.send(message)
    assert str(e.value) == f"{kind} frame: a classic CAN bus cannot send it" and c.wire.node[a.place, w.REFUSED] == 0


def test_a_full_queue_refuses_at_once_without_a_timeout() -> None:
    a, b, c = two()
    for k in range(64):
        a.send(frame(k), timeout=0)
    with pytest.raises(can.CanOperationError) as e:
        a.send(frame(99), timeout=0)
    assert str(e.value) == "transmit queue full (64 frames)" and c.now == 0.0
    assert c.wire.node[a.place, w.REFUSED] == 1
    c.advance(0.1)
    assert idents(b, 99) == list(range(64))


def test_a_full_queue_is_waited_for_in_steps_of_50_bits() -> None:
    a, b, c = two(Channel(queue=1))
    a.send(frame(1))
    a.send(frame(2))  # the first has begun, and left the queue, 50 bits later
    assert c.wire.clock[w.NOW] == 50
    a.send(frame(3), timeout=1.0)
    assert c.wire.clock[w.NOW] == 100  # the second begins 50 bits after that
    assert c.wire.node[a.place, w.REFUSED] == 0
    c.advance(0.01)
    assert idents(b) == [1, 2, 3]


def test_a_timeout_ends_at_its_bit_and_then_the_frame_is_refused() -> None:
    a, b, c = two(Channel(queue=1))
    a.send(frame(1))
    c.advance_to(1)  # it has begun
    a.send(frame(2))
    begin = int(c.wire.clock[w.NOW])
    with pytest.raises(can.CanOperationError, match=r"^transmit queue full \(1 frames\)$"):
        a.send(frame(3), timeout=30 * BIT)
    assert c.wire.clock[w.NOW] == begin + 30 and c.wire.node[a.place, w.REFUSED] == 1
    with pytest.raises(can.CanOperationError, match="queue full"):
        a.send(frame(3), timeout=-1.0)
    assert c.wire.clock[w.NOW] == begin + 30 and c.wire.node[a.place, w.REFUSED] == 2
    a.send(frame(4), timeout=40 * BIT)  # 20 bits later the first has ended and the second begun
    c.advance(0.01)
    assert idents(b) == [1, 2, 4] and c.wire.node[a.place, w.REFUSED] == 2


def test_who_is_bus_off_or_silent_cannot_send_and_is_told_why() -> None:
    a, _, c = two()
    c.wire.node[a.place, w.MODE], c.wire.node[a.place, w.TO_RECOVER] = w.BUS_OFF, 128
    for timeout in (None, 0, 1.0):
        with pytest.raises(can.CanOperationError) as e:
            a.send(frame(1), timeout=timeout)
        assert str(e.value) == "bus-off: the frame is refused"
    silent = LockstepBus(c, silent=True)
    for timeout in (None, 0, 1.0):
        with pytest.raises(can.CanOperationError) as e:
            silent.send(frame(1), timeout=timeout)
        assert str(e.value) == "a silent participant cannot send"
    assert c.now == 0.0 and c.wire.node[[a.place, silent.place], w.REFUSED].tolist() == [3, 3]


def test_recv_lets_time_run_until_a_frame_or_its_own_end() -> None:
    a, b, c = two()
    assert b.recv(0) is None and c.now == 0.0
    assert b.recv(0.25) is None and c.now == 0.25
    assert b.recv(-1.0) is None and c.now == 0.25
    task = a.send_periodic(frame(1), 3.0)
    assert b.recv(0.01) is not None
    got = b.recv()  # seconds later, in one call
    assert got is not None and got.timestamp == pytest.approx(3.25 + bits(1) * BIT)
    task.stop()
    with pytest.raises(can.CanOperationError) as e:
        b.recv()
    assert str(e.value) == "nothing can come: no node on the lockstep bus has anything to send"


def test_filters_pass_over_frames_and_time_goes_on_for_the_next() -> None:
    a, _, c = two()
    b = LockstepBus(c, can_filters=[{"can_id": 2, "can_mask": 0x7FF, "extended": False}])
    for ident in (1, 3, 2, 4):
        a.send(frame(ident))
    got = b.recv()
    assert got is not None and got.arbitration_id == 2
    assert b.recv(0.01) is None and c.now == pytest.approx(got.timestamp + 0.01)


def test_errors_come_as_error_frames_unless_they_are_not_wanted() -> None:
    a, b, c = two()
    deaf = LockstepBus(c, receive_errors=False)
    c.destroy(1)
    a.send(frame(0x20))
    c.advance(0.01)
    assert idents(b) == [0x88, 0x20] and idents(deaf) == [0x20] and idents(a) == [0x88]


def test_a_reader_that_does_not_read_loses_frames_is_told_and_counts_them() -> None:
    a, b, c = two(Channel(buffer=3))
    for k in range(6):
        a.send(frame(k))
    c.advance(0.01)
    assert b.lost == 3 and idents(b) == [0, 1, 2]
    a.send(frame(9))
    got = [b.recv(0.01), b.recv(0.01)]
    assert [m.arbitration_id for m in got if m] == [4, 9]
    assert got[0] is not None and got[0].is_error_frame and bytes(got[0].data) == bytes([0, 1, 0, 0, 3, 0, 0, 0])
    assert a.lost == 0


def test_rows_go_in_and_out_without_time_moving() -> None:
    a, b, c = two(Channel(queue=2))
    rows = np.array([[1 << 32 | k, k] for k in (3, 1, 2)], np.int64)
    assert a.write_rows(rows) == 2 and a.write_rows(rows[:0]) == 0 and c.now == 0.0
    got = np.full((3, 2), -7, np.int64)
    assert b.read_rows(got) == 0 and (got == -7).all()
    c.advance(0.01)
    assert b.read_rows(got[:1]) == 1 and b.read_rows(got[1:]) == 1 and c.now == 0.01
    assert got.tolist() == [[1 << 32 | 3, 3], [1 << 32 | 1, 1], [-7, -7]]


def test_rows_are_of_frames_that_pass_the_filters_however_few_fit() -> None:
    channel = Channel(queue=8)
    a = LockstepBus(channel)
    b = LockstepBus(channel, can_filters=[{"can_id": 0xB0, "can_mask": 0x7F0, "extended": False}])
    a.write_rows(np.array([[8 << 32 | ident, k] for k, ident in enumerate((0xA0, 0xB0, 0xA1, 0x1B0, 0xB3))], np.int64))
    channel.advance(0.01)
    rows = np.zeros((1, 2), np.int64)
    got = []
    while b.read_rows(rows):
        got.append(rows[0].tolist())
    assert got == [[8 << 32 | 0xB0, 1], [8 << 32 | 0xB3, 4]]


def test_what_waits_to_be_sent_can_be_forgotten() -> None:
    a, b, c = two()
    for k in range(5):
        a.send(frame(k))
    a.flush_tx_buffer()
    assert c.idle()
    a.send(frame(9))
    c.advance(0.01)
    assert idents(b) == [9]


def test_after_shutdown_every_call_is_refused_and_the_place_is_free() -> None:
    a, b, c = two()
    a.shutdown()
    a.shutdown()
    rows = np.zeros((1, 2), np.int64)
    for call in (
        *(lambda: a.send(frame(1)), lambda: a.send(frame(1, is_fd=True)), lambda: a.recv(0), a.recv),
        *(lambda: a.read_rows(rows), lambda: a.write_rows(rows)),
    ):
        with pytest.raises(can.CanOperationError) as e:
            call()
        assert str(e.value) == "lockstep bus 'own' is shut down"
    again = LockstepBus(c)
    assert c.wire.node[:, w.JOINED].sum() == 2 and again.place == a.place
    a.shutdown()  # not the place of who has it now
    assert c.wire.node[:, w.JOINED].sum() == 2
    assert b.recv(0) is None


# ---- frames in a period ----------------------------------------------------------------------------------------------


def stamps(bus: LockstepBus, until: float) -> list[tuple[int, int]]:
    """Identifier and bit of arrival of all that comes up to this time."""
    out = []
    while (left := until - bus.channel.now) > 0 and (m := bus.recv(left)) is not None:
        out.append((m.arbitration_id, round(m.timestamp / BIT)))
    return out


def test_a_message_is_sent_now_and_then_in_its_period() -> None:
    a, b, c = two()
    c.advance(0.5)
    task = a.send_periodic(frame(5), 0.01)
    begin, n = 250_000, bits(5)
    assert stamps(b, 0.535) == [(5, begin + 5000 * k + n) for k in range(4)]
    task.stop()
    assert stamps(b, 0.6) == []
    task.start()  # type: ignore[attr-defined]
    assert stamps(b, 0.6151) == [(5, 300_000 + n), (5, 305_000 + n)]
    assert c.tasks == [task]


def test_the_message_due_at_the_end_of_a_wait_is_queued_in_it_and_sent_after_it() -> None:
    a, b, c = two()
    a.send_periodic(frame(5), 0.01)
    c.advance_to(5000)
    assert idents(b) == [5] and c.wire.node[a.place, w.TX_N] == 1
    c.advance_to(5000 + bits(5))
    assert idents(b) == [5] and c.wire.node[a.place, w.TX_N] == 0
    c.advance_to(9999)
    assert c.wire.node[a.place, w.TX_N] == 0 and c.now == 9999 * BIT


def test_of_several_messages_each_comes_in_its_turn() -> None:
    a, b, _ = two()
    a.send_periodic([frame(5), frame(5, b"x"), frame(5, b"yz")], 0.01)
    got = []
    for _ in range(7):
        m = b.recv(0.02)
        assert m is not None
        got.append(bytes(m.data))
    assert got == [b"", b"x", b"yz", b"", b"x", b"yz", b""]


@pytest.mark.parametrize(("duration", "times"), [(0.03, 3), (0.0301, 4), (0.01, 1), (0.0, 0), (None, 6)])
def test_a_duration_ends_what_is_sent(duration: float | None, times: int) -> None:
    a, b, c = two()
    task: Any = a.send_periodic(frame(5), 0.01, duration)
    assert len(stamps(b, 0.0599)) == times and task.active is (duration is None)
    assert c.idle() is (duration is not None)
    task.stop()
    task.start()  # for as long once more
    assert len(stamps(b, 0.12)) == min(times, 6) + (duration is None)


def test_a_message_may_be_changed_before_each_sending_and_replaced_between() -> None:
    a, b, _ = two()

    def count(m: can.Message) -> None:
        m.data[0] += 1

    task: Any = a.send_periodic(frame(5, b"\x07"), 0.01, modifier_callback=count)
    got = [b.recv(0.02), b.recv(0.02)]
    assert [m.data[0] for m in got if m] == [8, 9]
    task.modify_data(frame(5, b"\x20"))
    last = b.recv(0.02)
    assert last is not None and last.data[0] == 0x21 and task.period == 0.01


def test_a_task_that_does_not_start_by_itself_waits_for_its_start() -> None:
    a, b, c = two()
    task: Any = a.send_periodic(frame(5), 0.01, autostart=False)
    assert c.tasks == [task] and not task.active and c.idle() and stamps(b, 0.02) == []
    task.start()
    assert stamps(b, 0.0201) == [(5, 10_000 + bits(5))]


def test_the_task_that_is_due_first_is_sent_first() -> None:
    a, b, _ = two()
    b.send_periodic(frame(1), 0.004)
    a.send_periodic(frame(2), 0.003)
    third = LockstepBus(a.channel)
    got = stamps(third, 0.0099)
    assert [ident for ident, _ in got] == [1, 2, 2, 1, 2, 1, 2]
    assert [at for _, at in got[2:]] == [1500 + bits(2), 2000 + bits(1), 3000 + bits(2), 4000 + bits(1), 4500 + bits(2)]


def test_a_watched_wait_ends_before_the_tasks_behind_it() -> None:
    a, b, c = two()
    a.send_periodic(frame(5), 0.01)
    c.advance(1.0, b.place)
    assert c.wire.clock[w.NOW] == bits(5) and c.wire.node[a.place, w.SENT] == 1
    c.advance_to(20_000)
    assert len(idents(b)) == 4 and c.wire.node[a.place, w.TX_N] == 1


@pytest.mark.parametrize("period", [0.0, -0.01, float("nan")])
def test_a_period_is_greater_than_0(period: float) -> None:
    a, _, c = two()
    with pytest.raises(ValueError) as e:
        a.send_periodic(frame(5), period)
    assert str(e.value) == f"period (={period}) must be greater than 0" and c.tasks == []


def test_a_period_is_at_least_one_bit() -> None:
    a, b, c = two(Channel(queue=8))
    task: Any = a.send_periodic(frame(5), 1e-9)
    c.advance_to(3)
    assert task.due == 4 and c.wire.node[a.place, [w.TX_N, w.REFUSED]].tolist() == [3, 0]
    task.stop()
    c.advance_to(1000)
    assert idents(b) == [5, 5, 5, 5]


def test_a_full_queue_loses_what_is_sent_in_a_period() -> None:
    a, _, c = two(Channel(queue=2))
    a.send_periodic(frame(5), BIT)
    c.advance_to(9)
    assert c.wire.node[a.place, [w.TX_N, w.REFUSED]].tolist() == [2, 7]


def test_shutdown_ends_ones_own_tasks_only() -> None:
    a, b, c = two()
    a.send_periodic(frame(5), 0.01)
    kept = b.send_periodic(frame(6), 0.01)
    a.shutdown()
    assert c.tasks == [kept]
    third = LockstepBus(c)
    assert stamps(third, 0.0101)[-1] == (6, 5000 + bits(6))


# ---- the whole loop --------------------------------------------------------------------------------------------------


def test_a_run_has_a_row_of_demand_every_10_ms_and_keeps_each_frame_at_its_end(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[float] = []
    clock = iter([100.0, 107.5])
    monkeypatch.setattr(lockstep_bus, "time", SimpleNamespace(perf_counter=lambda: next(clock)))
    n_dem = np.full(10, 80.0)
    channel = Channel()
    run = run_lockstep(n_dem, seed=1, channel=channel, progress=told.append)
    assert run.simulated_s == pytest.approx(0.1, rel=1e-12) and run.vgv.k == run.ecu.k == 100
    assert channel.now == 0.1 and run.wall_s == 7.5 and told[-1] == 1.0
    assert run.state_hash == "" and run.error_frames == 0 and run.load == channel.load
    # every 10 ms a demand and three frames of the controller, and once its health
    assert run.frames == 41 == len(run.rows) == len(run.t) and run.rows.shape == (41, 2) and run.t.shape == (41,)
    got = [int(r) & 0x7FF for r in run.rows[:, 0]]
    assert sorted(set(got)) == [0x0A0, 0x0B0, 0x0B1, 0x0B2, 0x0B3] and got.count(0x0A0) == 10 and got.count(0x0B3) == 1
    sizes = [bits(int(r[0]) & 0x7FF, int(r[1]).to_bytes(8, "little", signed=True)) for r in run.rows]
    assert run.t[0] == sizes[0] / 500_000 and run.t[-1] < 0.1 and (np.diff(run.t) > 0).all()
    busy = sum(sizes) + 41 * GAP
    assert run.load == pytest.approx(busy / 50_000)
    ears = channel.wire.node[2]
    assert channel.wire.node[:, w.JOINED].tolist() == [1, 1, 1] + [0] * 13
    assert ears[w.SILENT] == 1 and ears[w.RECEIVED] == 41 and channel.wire.node[:2, w.SILENT].tolist() == [0, 0]
    assert channel.wire.node[:2, w.WANTS_ERRORS].tolist() == [1, 1]


def test_frames_that_are_not_kept_change_nothing_else() -> None:
    n_dem = np.full(5, 80.0)
    channel = Channel()
    kept, run = (
        run_lockstep(n_dem, seed=1, hashed=True),
        run_lockstep(n_dem, seed=1, keep=False, hashed=True, channel=channel),
    )
    assert run.rows.shape == (0, 2) and run.t.shape == (0,) and run.frames == kept.frames == 21
    assert run.state_hash == kept.state_hash and len(run.state_hash) == 64
    assert channel.wire.node[:, w.JOINED].tolist() == [1, 1] + [0] * 14


def test_the_hash_is_of_every_state_and_so_of_the_seed_and_the_demand() -> None:
    n_dem = np.full(3, 80.0)
    hashes = {
        run_lockstep(n_dem, seed=1, hashed=True).state_hash,
        run_lockstep(n_dem, seed=2, hashed=True).state_hash,
        run_lockstep(n_dem, seed=1, duration=0.02, hashed=True).state_hash,
        run_lockstep(n_dem, seed=1, hashed=True, duration=0.031).state_hash,
    }
    assert len(hashes) == 4 and "" not in hashes


def test_a_duration_ends_a_run_and_the_last_demand_is_held_through_it() -> None:
    run = run_lockstep(np.array([70.0]), seed=3, duration=0.025)
    assert run.vgv.k == 25 and run.simulated_s == pytest.approx(0.025)
    held = run_lockstep(np.array([70.0, 70.0, 70.0]), seed=3, duration=0.025)
    assert np.array_equal(run.rows, held.rows)
    assert run_lockstep(np.float64(70.0), seed=3, duration=0.025).frames == run.frames  # type: ignore[arg-type]


def test_a_run_of_no_time_has_no_frames() -> None:
    run = run_lockstep(np.array([70.0]), seed=3, duration=0.0, hashed=True)
    assert run.rows.shape == (0, 2) and run.t.shape == (0,) and run.frames == 0 and run.load == 0.0
    assert run.simulated_s == 0.0 and run.vgv.k == 0


def demands(run: Any) -> list[Any]:
    """n_dem and n_r (%), and mode_request of the ECU's frames, by the DBC."""
    out = []
    for head, data in run.rows.tolist():
        if head & 0x7FF == 0x0A0:
            raw = data.to_bytes(8, "little", signed=True)
            n_dem, n_r = (int.from_bytes(raw[k : k + 2], "little") * 0.002 for k in (2, 4))
            out.append((n_dem, n_r, raw[1] >> 4 & 3))
    return out


def test_the_ecu_sends_the_demand_row_by_row_and_the_speed_where_it_is_given() -> None:
    n_dem, n_r = np.array([70.0, 71.0, 72.0, 73.0]), np.array([60.0, 61.0, 62.0, 63.0])
    run = run_lockstep(n_dem, n_r, seed=1)
    assert demands(run) == [(pytest.approx(a), pytest.approx(b), 1) for a, b in zip(n_dem, n_r, strict=True)]
    own = demands(run_lockstep(n_dem, seed=1))
    assert [d[0] for d in own] == [pytest.approx(a) for a in n_dem]
    assert all(abs(d[1] - 70.0) < 2.0 for d in own)  # its engine, at the first demand
    one = run_lockstep(n_dem, np.array([65.0]), seed=1)
    assert [d[1] for d in demands(one)] == [pytest.approx(65.0)] * 4


def test_the_nodes_are_made_at_the_first_demand_with_seeds_of_their_own() -> None:
    n_dem = np.array([75.0, 76.0])
    made = run_lockstep(n_dem, seed=5, hashed=True)
    vgv, ecu = Node(n_r=75.0, seed=5), Ecu(n_dem=75.0, seed=6)
    given = run_lockstep(n_dem, vgv=vgv, ecu=ecu, hashed=True)
    assert given.vgv is vgv and given.ecu is ecu
    assert np.array_equal(made.rows, given.rows) and made.state_hash == given.state_hash
    without = run_lockstep(n_dem, hashed=True)
    plain = run_lockstep(n_dem, vgv=Node(n_r=75.0, seed=None), ecu=Ecu(n_dem=75.0, seed=None), hashed=True)
    assert without.state_hash == plain.state_hash and np.array_equal(without.rows, plain.rows)


@pytest.mark.parametrize("which", ["vgv", "ecu", "channel"])
def test_nodes_and_a_wire_that_have_run_before_are_refused(which: str) -> None:
    given: dict[str, Any] = {"vgv": Node(n_r=70.0, seed=1), "ecu": Ecu(n_dem=70.0, seed=2), "channel": Channel()}
    if which == "channel":
        given["channel"].advance(0.001)
    else:
        given[which].k = 1
    with pytest.raises(ValueError) as e:
        run_lockstep(np.array([70.0]), **given)
    assert str(e.value) == "run_lockstep starts with nodes and a wire at tick 0"


def test_a_wire_within_its_first_tick_has_not_run() -> None:
    channel = Channel()
    channel.advance_to(499)
    assert run_lockstep(np.array([70.0]), seed=1, channel=channel).vgv.k == 10


def test_destroyed_frames_of_a_run_are_counted() -> None:
    channel = Channel()
    channel.destroy(3)
    run = run_lockstep(np.full(2, 70.0), seed=1, channel=channel)
    errors = int((run.rows[:, 0] >> 29 & 1).sum())
    assert run.error_frames == 3 == errors and run.frames == len(run.rows) - 3 == 9


def test_a_long_run_tells_how_far_it_is_and_goes_on_where_it_was() -> None:
    told: list[float] = []
    run = run_lockstep(np.full(25, 70.0), seed=1, progress=told.append, hashed=True)
    short = Node(n_r=70.0, seed=1)
    short.stride = 60
    parts: list[float] = []  # a node has its noise for 100 ticks at a time, and here goes 60 at the most
    pieces = run_lockstep(np.full(25, 70.0), vgv=short, ecu=Ecu(n_dem=70.0, seed=2), progress=parts.append, hashed=True)
    assert parts == [pytest.approx(k / 250) for k in (60, 100, 160, 200, 250)] and told[-1] == 1.0
    assert pieces.state_hash == run.state_hash and np.array_equal(pieces.rows, run.rows)
    assert np.array_equal(pieces.t, run.t)


def test_a_demand_that_is_changed_in_a_record_keeps_its_counter_and_what_is_no_good_demand_stays() -> None:
    good, other = frames.encode_demand(70.0, 60.0, 1, 11), frames.encode_status(1.0, 2.0, 2, 3)
    demand, status = frames.word0(0x0A0), frames.word0(0x0B0)
    rows = np.array([[demand, good], [demand, good ^ 1], [status, other]], np.int64)
    asked: list[Any] = []
    changed = frames.with_demand(rows, lambda *d: asked.append(d) or (71.0, 61.0, 0))  # type: ignore[func-returns-value]
    assert asked == [(pytest.approx(70.0), pytest.approx(60.0), 1)] and rows[0, 1] == good
    assert changed.tolist() == [[demand, frames.encode_demand(71.0, 61.0, 0, 11)], *rows[1:].tolist()]
    assert np.array_equal(frames.with_demand(rows, lambda *_: None), rows)
