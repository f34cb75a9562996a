"""Messages longer than a frame: put together from J1939's transport protocol and from ISO-TP, as other programs send
them.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import asammdf
import cantools
import isotp
import numpy as np
import pytest
from asammdf.blocks.conversion_utils import from_dict
from hypothesis import given, settings
from hypothesis import strategies as st

from hil.logs import LogError, read_log
from hil.logs.formats import format_at
from hil.logs.frames import EXTENDED
from hil.logs.mdf_child import _bus_columns
from hil.logs.source import Options
from hil.logs.transport import put_together
from tests.conftest import examples

LONG = """VERSION ""
BU_: A
BO_ {broadcast} BROADCAST: {n} A
 SG_ first : 0|16@1+ (1,0) [0|0] "" A
 SG_ last : {last}|8@1+ (1,0) [0|0] "" A
BO_ {asked} ASKED: {n} A
 SG_ first : 0|16@1+ (1,0) [0|0] "" A
 SG_ last : {last}|8@1+ (1,0) [0|0] "" A
BO_ 291 SEGMENTED: {n} A
 SG_ first : 0|16@1+ (1,0) [0|0] "" A
 SG_ last : {last}|8@1+ (1,0) [0|0] "" A
"""
BROADCAST, ASKED = 0x18FECA2A, 0x18EF172A  # a group for all, and one for the node 0x17


def database(folder: Path, n: int) -> Path:
    path = folder / "long.dbc"
    path.write_text(LONG.format(n=n, last=8 * n - 8, broadcast=BROADCAST | EXTENDED, asked=ASKED | EXTENDED))
    return path


def j1939(data: bytes, group: int, destination: int, source: int) -> list[tuple[int, bytes]]:
    """The frames of a message as J1939-21 has them: the announcement, then seven bytes each."""
    packets = -(-len(data) // 7)
    kind, most = (32, 0xFF) if destination == 0xFF else (16, packets)
    head = bytes([kind]) + len(data).to_bytes(2, "little") + bytes([packets, most]) + group.to_bytes(3, "little")
    to = destination << 8 | source
    parts = [data[7 * k : 7 * k + 7].ljust(7, b"\xff") for k in range(packets)]
    return [(0x1CEC0000 | to, head)] + [(0x1CEB0000 | to, bytes([k + 1]) + p) for k, p in enumerate(parts)]


def log_of(folder: Path, frames: list[tuple[int, bytes]]) -> Path:
    path = folder / "a.log"
    path.write_text(
        "".join(f"({k}.000000) can0 {i:0{8 if i > 0x7FF else 3}X}#{d.hex()}\n" for k, (i, d) in enumerate(frames))
    )
    return path


@given(st.data())
@settings(max_examples=examples(40), deadline=None)
def test_messages_of_j1939_come_back_whole_however_their_frames_alternate(data: st.DataObject) -> None:
    n = data.draw(st.integers(9, 200))
    payloads = data.draw(st.lists(st.binary(min_size=n, max_size=n), min_size=2, max_size=4))
    sessions = [
        j1939(p, (BROADCAST if k % 2 else ASKED & 0x1FF0000) >> 8 & 0x3FFFF, 0xFF if k % 2 else 0x17, 0x2A)
        for k, p in enumerate(payloads)
    ]
    queues = [sum(sessions[0::2], []), sum(sessions[1::2], [])]  # one session at a time between two nodes
    frames, whole = [], []
    while any(queues):
        k = data.draw(st.sampled_from([k for k in (0, 1) if queues[k]]))
        frames.append(queues[k].pop(0))
    with tempfile.TemporaryDirectory() as folder:
        source = format_at(path := log_of(Path(folder), frames)).open(path, Options(database(Path(folder), n), {}))
    for key, mine in (("ASKED", payloads[0::2]), ("BROADCAST", payloads[1::2])):
        whole = [float(p[-1]) for p in mine]
        assert source.series(f"{key}.last").values.tolist() == whole
        assert source.series(f"{key}.first").values.tolist() == [float(p[0] | p[1] << 8) for p in mine]
    last = [k for k, (i, d) in enumerate(frames) if i & 0xFFFF == 0x172A and i >> 16 == 0x1CEB and d[0] == -(-n // 7)]
    assert source.series("ASKED.last").t.tolist() == [float(k) for k in last]
    assert f"J1939 TP: {len(payloads)} messages put together from {len(frames)} frames" in source.notes


def test_a_packet_that_is_missing_costs_its_message_and_one_sent_again_does_not(tmp_path: Path) -> None:
    whole = j1939(bytes(range(20)), 0xFECA, 0xFF, 0x2A)
    frames = [*whole[:2], *whole[3:], *whole, whole[0], whole[1], whole[1], *whole[2:], *whole[:2]]
    source = format_at(path := log_of(tmp_path, frames)).open(path, Options(database(tmp_path, 20), {}))
    assert source.series("BROADCAST.last").values.tolist() == [19.0, 19.0]
    assert source.notes == ["J1939 TP: 2 messages put together from 8 frames; 2 incomplete: left out"]


def by_isotp(payloads: list[bytes], extended: bool) -> list[tuple[int, bytes]]:
    """The frames with which can-isotp sends, and its receiver's flow control, in the order of the bus."""
    bus: list[tuple[int, bytes]] = []
    to_receiver: list[isotp.CanMessage] = []
    to_sender: list[isotp.CanMessage] = []

    def out(queue: list[isotp.CanMessage]) -> Any:
        def send(m: isotp.CanMessage) -> None:
            queue.append(m)
            bus.append((m.arbitration_id, bytes(m.data)))

        return send

    def into(queue: list[isotp.CanMessage]) -> Any:
        return lambda timeout: queue.pop(0) if queue else None

    mode = isotp.AddressingMode.Normal_29bits if extended else isotp.AddressingMode.Normal_11bits
    one = isotp.TransportLayerLogic(into(to_sender), out(to_receiver), isotp.Address(mode, txid=0x123, rxid=0x321))
    other = isotp.TransportLayerLogic(into(to_receiver), out(to_sender), isotp.Address(mode, txid=0x321, rxid=0x123))
    for p in payloads:
        one.send(p)
        for _ in range(3 * len(p) + 10):
            one.process()
            other.process()
            if (got := other.recv()) is not None:
                assert bytes(got) == p
                break
        else:
            raise AssertionError("can-isotp did not send")
    return bus


@given(st.integers(9, 120), st.data())
@settings(max_examples=examples(20), deadline=None)
def test_what_can_isotp_sends_comes_back_whole(n: int, data: st.DataObject) -> None:
    payloads = data.draw(st.lists(st.binary(min_size=n, max_size=n), min_size=1, max_size=3))
    frames = by_isotp(payloads, False)
    with tempfile.TemporaryDirectory() as folder:
        dbc = database(Path(folder), n)
        source = format_at(path := log_of(Path(folder), frames)).open(path, Options(dbc, {}))
        layout = cantools.database.load_file(dbc).get_message_by_name("SEGMENTED")
    for name in ("first", "last"):
        theirs = [float(layout.decode(p)[name]) for p in payloads]
        assert source.series(f"SEGMENTED.{name}").values.tolist() == theirs
    assert source.notes[0].startswith(f"SEGMENTED: ISO-TP: {len(payloads)} messages put together from ")


def test_iso_tp_of_which_nothing_is_whole_gives_no_values(tmp_path: Path) -> None:
    """Its first bytes are the protocol's, no signal's."""
    frames = [f for f in by_isotp([bytes(range(30))] * 3, False) if f[0] == 0x123]
    cut = [f for f in frames if f[1][0] >> 4 != 2]
    with pytest.raises(LogError, match="3 of 3 frames are shorter than its 30 bytes: left out"):
        read_log(
            log_of(tmp_path, cut), dbc=database(tmp_path, 30), mapping={"SEGMENTED.first": "n_dem"}, design_rpm=1e4
        )


@given(st.lists(st.tuples(st.sampled_from([0x123, 0x1CECFF2A, 0x1CEBFF2A, 5]), st.binary(max_size=8)), max_size=30))
@settings(max_examples=examples(60), deadline=None)
def test_no_frames_whatever_end_it(frames: list[tuple[int, bytes]]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = log_of(Path(folder), [*frames, (5, b"\0")])
        read = format_at(path).read_frames(path)
        source = format_at(path).open(path, Options(database(Path(folder), 20), {}))
    long, _ = put_together(read, [m for m, _ in source._of.values()])  # type: ignore[attr-defined]
    assert long is None or (long.length <= 4095).all() and (np.diff(long.t) >= 0).all()


# ---- MF4 of newer loggers --------------------------------------------------------------------------------------------


@given(st.integers(0, 1), st.integers(0, 9), st.integers(0, 8))
@settings(max_examples=examples(10), deadline=None)
def test_what_an_mf4_states_in_virtual_channels_is_what_it_is_in_the_records(ide: int, bus: int, length: int) -> None:
    n = 5
    t = np.arange(n) * 0.1

    def signal(name: str, values: Any, constant: int | None = None) -> asammdf.Signal:
        s = asammdf.Signal(np.asarray(values), t, name=f"CAN_DataFrame.{name}")
        if constant is not None:
            s.flags |= asammdf.Signal.Flags.virtual
            s.virtual_conversion = from_dict({"a": 0.0, "b": float(constant)})
        return s

    def columns(virtual: bool) -> list[np.ndarray]:
        with asammdf.MDF(version="4.11") as mdf:
            said = {"BusChannel": bus, "IDE": ide, "DLC": length, "DataLength": length}
            fixed = [signal(k, np.full(n, v, np.uint8), v if virtual else None) for k, v in said.items()]
            data = np.arange(8 * n, dtype=np.uint8).reshape(n, 8)
            mdf.append(
                [signal("ID", np.arange(n, dtype=np.uint32)), *fixed, signal("DataBytes", data)], common_timebase=True
            )
            with tempfile.TemporaryDirectory() as folder:
                path = mdf.save(Path(folder) / "a.mf4")
                with asammdf.MDF(path) as again:
                    return _bus_columns(again, 0, [str(c.name) for c in again.groups[0].channels])

    for got, want in zip(columns(True), columns(False), strict=True):
        assert got.dtype == want.dtype and np.array_equal(got, want)
    assert columns(True)[1].tolist() == [k | EXTENDED * ide for k in range(n)]
