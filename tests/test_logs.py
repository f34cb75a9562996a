"""Logs: every format reads back what was written, names and units arrive as stated, and what cannot be used is refused
in one line.
"""

from __future__ import annotations

import contextlib
import os
import re
import subprocess
import sys
import zlib
from pathlib import Path
from typing import Any

import e2e.p01
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from hil.bus.frames import AUTH
from hil.logs import Channel, Log, LogError, csv_format, read_log, write_log
from hil.logs.blf import read_blf
from hil.logs.candump import read_candump
from hil.logs.dbc import Message, load_dbc
from hil.logs.formats import FORMATS
from hil.logs.frames import EXTENDED, Frames
from hil.logs.notes import Note
from hil.logs.signals import cut_signal, e2e_crc, encode, select
from hil.logs.tool_traces import read_asc, read_trc
from tests.conftest import examples
from vaneloop.base import tables
from vaneloop.base.signals import SIDES, UNITS
from vaneloop.base.vanes import VANES

DBC = tables.path("vgv.dbc")
DATA = Path(os.environ.get("VANELOOP_DATA", Path(__file__).parents[2] / "shared" / "data"))
BUSES = [s for s, f in FORMATS.items() if f.frames]  # nothing but frames
TABLES = [s for s, f in FORMATS.items() if not f.framed]
BOTH = [s for s in FORMATS if s not in (*BUSES, *TABLES)]
RESOLUTION = {
    "n_dem": 0.002, "n_r": 0.002, "x_dem": 0.001, "x_lvdt": 0.001, "i_cmd": 0.002, "p_s": 0.001, "t_oil": 0.01,
    **dict.fromkeys(VANES, 0.002), "state": 1.0,
}  # fmt: skip
# id, name, period ms, DataID of the frames that DESIGN section 7 fixes
FRAMES = {
    0x0A0: ("ECU_DEMAND", 10, ("n_dem", "n_r", "mode_request")),
    0x0B0: ("VGV_STATUS", 10, ("x_dem", "x_lvdt", "state")),
    0x0B1: ("VGV_SERVO", 10, ("i_cmd",)), 0x0B2: ("VGV_ANGLES", 10, ("vigv", "vgv1", "vgv2")),
    0x0B3: ("VGV_HEALTH", 100, ("p_s", "t_oil")),
    0x0B4: ("VGV_ANGLES_2", 10, ("vgv3", "vgv4", "vgv5")), 0x0B5: ("VGV_ANGLES_3", 10, ("vgv6", "vgv7")),
}  # fmt: skip
FAULTS = (
    "fault_demand_stale", "fault_demand_rejected", "fault_lvdt_range", "fault_lvdt_rate", "fault_lvdt_stuck",
    "fault_tracking",
    "fault_current_saturated", "fault_demand_range", "fault_paused",
)  # fmt: skip


def data(name: str) -> Path:
    """A real recording, or skip."""
    if not (DATA / name).exists():
        pytest.skip(f"real recordings are not here: {DATA / name} (set VANELOOP_DATA)")
    return DATA / name


def run(n: int = 400, seed: int = 1) -> dict[str, Channel]:
    """A run with every signal, 10 ms, health signals 100 ms."""
    rng = np.random.default_rng(seed)
    t = np.arange(n) * 0.01
    slow = t[::10]
    out = {name: Channel(t, rng.uniform(5, 40, n)) for name in UNITS if name not in ("p_s", "t_oil", "state", *SIDES)}
    out["state"] = Channel(t, rng.integers(0, 5, n).astype(float))
    return out | {
        "p_s": Channel(slow, rng.uniform(5, 25, slow.size)),
        "t_oil": Channel(slow, rng.uniform(-40, 120, slow.size)),
    }


def check(log: Log) -> None:
    """What holds of every log: known names, times strictly increasing, finite numbers, equal lengths."""
    for name, c in log.channels.items():
        assert name in UNITS
        assert c.t.dtype == c.values.dtype == np.float64
        assert c.t.shape == c.values.shape and c.t.ndim == 1 and c.t.size
        assert np.isfinite(c.t).all() and np.isfinite(c.values).all() and (np.diff(c.t) > 0).all()


def refused(path: Path, **options: Any) -> str:
    """The line with which a log is refused."""
    with pytest.raises(LogError) as caught:
        read_log(path, **options)
    line = str(caught.value)
    assert "\n" not in line and str(path) in line
    return line


def csv(path: Path, text: str) -> Path:
    file = path / "run.csv"
    file.write_text(text)
    return file


# --- the bus's frames -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def db() -> Any:
    import cantools

    return cantools.database.load_file(DBC, strict=True)


def test_dbc_has_the_seven_frames_at_their_identifiers_and_periods(db: Any) -> None:
    assert {m.frame_id for m in db.messages} == {*FRAMES, *(ident + AUTH for ident in FRAMES)}
    for m in db.messages:
        if m.frame_id not in FRAMES:
            assert (m.name, m.length) == (f"{FRAMES[m.frame_id - AUTH][0]}_AUTH", 8)
            assert [(s.name, s.start, s.length) for s in m.signals] == [("freshness", 0, 32), ("mac", 32, 32)]
            continue
        name, period, signals = FRAMES[m.frame_id]
        assert (m.name, m.cycle_time, m.length, m.is_extended_frame) == (name, period, 8, False)
        assert set(signals) <= {s.name for s in m.signals}
        assert m.comment and all(s.comment for s in m.signals)
    assert len({m.dbc.attributes["DataID"].value for m in db.messages if m.frame_id in FRAMES}) == len(FRAMES)


def test_dbc_signals_do_not_overlap_and_leave_the_protection_its_place(db: Any) -> None:
    for m in db.messages:
        used: set[int] = set()
        for s in m.signals:
            bits = set(range(s.start, s.start + s.length))
            assert s.byte_order == "little_endian" and not bits & used and max(bits) < 64
            used |= bits
        layout = {s.name: (s.start, s.length) for s in m.signals}
        if m.frame_id in FRAMES:
            assert layout["crc"] == (0, 8) and layout["counter"] == (8, 4)


def test_dbc_resolutions_units_and_ranges_are_the_fixed_ones(db: Any) -> None:
    for m in db.messages:
        for s in m.signals:
            if s.name in UNITS:
                assert s.scale == RESOLUTION[s.name]
                assert (s.unit or "-") == UNITS[s.name]
            low, high = s.conversion.numeric_scaled_to_raw(s.minimum), s.conversion.numeric_scaled_to_raw(s.maximum)
            room = (-(2 ** (s.length - 1)), 2 ** (s.length - 1) - 1) if s.is_signed else (0, 2**s.length - 1)
            assert room[0] <= low < high <= room[1], f"{s.name} cannot carry its own range"
    ranges = {s.name: (s.minimum, s.maximum) for m in db.messages for s in m.signals}
    assert ranges["x_lvdt"][0] < 0 and ranges["x_lvdt"][1] > 48  # noise at the stops must not clip
    assert ranges["i_cmd"][0] < -40 and ranges["i_cmd"][1] > 40
    assert ranges["n_dem"][1] > 110


def test_dbc_names_modes_and_faults(db: Any) -> None:
    status, servo = db.get_message_by_name("VGV_STATUS"), db.get_message_by_name("VGV_SERVO")
    assert {k: str(v) for k, v in status.get_signal_by_name("state").choices.items()} == dict(
        enumerate(("INIT", "STANDBY", "RUN", "DEGRADED", "FAIL_SAFE"))
    )
    demand = db.get_message_by_name("ECU_DEMAND").get_signal_by_name("mode_request")
    assert sorted(demand.choices) == [0, 1]
    assert [(s.name, s.start) for s in servo.signals if s.name.startswith("fault_")] == [
        (f, 32 + i) for i, f in enumerate(FAULTS)
    ]
    assert all(s.length == 1 for s in servo.signals if s.name.startswith("fault_"))
    assert all(s.start + s.length <= 41 for s in servo.signals)  # bits 41 to 47 wait for more faults


@given(seed=st.integers(0, 2**32))
def test_dbc_round_trip_loses_at_most_half_a_resolution(db: Any, seed: int) -> None:
    rng = np.random.default_rng(seed)
    for m in db.messages:
        sent = {
            s.name: rng.uniform(s.minimum, s.maximum) if s.scale != 1 else int(rng.integers(s.minimum, s.maximum + 1))
            for s in m.signals
        }
        got = m.decode(m.encode(sent), decode_choices=False)
        assert all(abs(got[s.name] - sent[s.name]) <= s.scale * 0.5000001 for s in m.signals)


@given(seed=st.integers(0, 2**32))
def test_frames_are_those_of_cantools_and_the_e2e_library(db: Any, seed: int) -> None:
    rng = np.random.default_rng(seed)
    for message in load_dbc(DBC)[0]:
        if message.layout.frame_id not in FRAMES:
            continue
        m, n = message.layout, 33
        values = {
            s.name: np.round(rng.uniform(s.minimum, s.maximum, n) / s.scale) * s.scale
            for s in m.signals
            if s.name not in ("crc", "counter")
        }
        ours = encode(message, values, n)
        theirs = bytearray(8)
        for k in range(n):
            counter = theirs[1] & 15
            theirs = bytearray(
                m.encode({name: v[k] for name, v in values.items()} | {"crc": 0, "counter": counter}, strict=False)
            )
            e2e.p01.e2e_p01_protect(theirs, message.e2e)
            assert ours[k].tobytes() == bytes(theirs)
            assert e2e.p01.e2e_p01_check(bytearray(ours[k].tobytes()), message.e2e)
        wrong = ours.copy()
        bit = rng.integers(0, 64, n)
        wrong[np.arange(n), bit // 8] ^= (1 << bit % 8).astype(np.uint8)
        assert (e2e_crc(wrong, message.e2e) != wrong[:, 0]).all()


# --- signals cut out of columns ---------------------------------------------------------------------------------------


@given(st.data())
def test_column_decode_equals_cantools(draw: st.DataObject) -> None:
    from cantools.database.can import Message as CanMessage
    from cantools.database.can import Signal
    from cantools.database.conversion import BaseConversion

    size = draw.draw(st.sampled_from([1, 4, 8, 64]))
    rng = np.random.default_rng(draw.draw(st.integers(0, 2**32)))
    signals = []
    for k in range(6):
        is_float = size >= 8 and rng.random() < 0.2
        length = int(rng.choice([16, 32, 64])) if is_float else int(rng.integers(1, min(64, 8 * size) + 1))
        big = bool(rng.random() < 0.5)
        first = int(rng.integers(0, 8 * size - length + 1))
        start = 8 * (first // 8) + 7 - first % 8 if big else first
        scale, offset = (
            (1, 0)
            if rng.random() < 0.3
            else (float(rng.choice([0.5, 0.001, -2.0, 3.7])), float(rng.choice([0.0, -40.0, 1e3])))
        )
        signals.append(
            Signal(f"s{k}", start, length, "big_endian" if big else "little_endian",
                bool(rng.random() < 0.5) and not is_float,
                   conversion=BaseConversion.factory(scale, offset, None, is_float)))  # fmt: skip
    n = 20
    block = rng.integers(0, 256, (n, size)).astype(np.uint8)
    block[0], block[1] = 0, 255
    wide = np.pad(block, ((0, 0), (0, (8 if size <= 8 else 64) - size)))
    frames = Frames(
        np.arange(n) * 0.1, np.full(n, 0x123, np.uint32), np.zeros(n, np.int32), np.full(n, size, np.uint8), wide
    )
    for s in signals:
        layout = CanMessage(0x123, "M", size, [s], strict=False)
        _, ours, _ = cut_signal(frames, np.arange(n), Message(layout, 0x123, None, False, {}), s)
        theirs = [layout.decode(row.tobytes(), decode_choices=False)[s.name] for row in block]
        np.testing.assert_allclose(ours, np.array(theirs, float), rtol=1e-15, atol=0)


MUX = """VERSION ""
BU_: A
BO_ 291 M: 8 A
 SG_ which M : 0|4@1+ (1,0) [0|15] "" A
 SG_ n_dem m1 : 8|16@1+ (0.01,0) [0|100] "%" A
 SG_ n_r m2 : 8|16@1+ (0.01,0) [0|100] "%" A
"""


def test_a_multiplexed_signal_is_read_where_its_selector_says_so(tmp_path: Path) -> None:
    (tmp_path / "m.dbc").write_text(MUX)
    lines = [
        f"(1.{k:06d}) can0 123#0{1 + k % 2}{(100 * k).to_bytes(2, 'little').hex().upper()}0000000000" for k in range(10)
    ]
    (tmp_path / "a.log").write_text("\n".join(lines))
    log = read_log(tmp_path / "a.log", dbc=tmp_path / "m.dbc")
    assert log.channels["n_dem"].values.tolist() == [0, 2, 4, 6, 8]
    assert log.channels["n_r"].values.tolist() == [1, 3, 5, 7, 9]


# --- round trips ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [*TABLES, *BOTH])
def test_a_table_gives_back_every_sample(tmp_path: Path, suffix: str, quick_mdf: None) -> None:
    sent = run()
    sent["vigv"] = Channel(np.array([0.0001, 0.5, 2.0]), np.array([1.1, 1 / 3, -5.0]))  # a raster of its own
    write_log(tmp_path / f"a{suffix}", sent)
    log = read_log(tmp_path / f"a{suffix}")
    check(log)
    assert log.notes == [] and set(log.channels) == set(sent)
    for name, c in sent.items():
        assert np.array_equal(log.channels[name].t, c.t) and np.array_equal(log.channels[name].values, c.values)


@pytest.mark.parametrize("suffix", [*BUSES, *BOTH])
def test_a_bus_log_gives_back_what_the_frames_carry(tmp_path: Path, suffix: str, quick_mdf: None) -> None:
    sent = run()
    write_log(tmp_path / f"a{suffix}", sent, dbc=DBC)
    log = read_log(tmp_path / f"a{suffix}", dbc=DBC)
    check(log)
    assert log.notes == [] and set(log.channels) == set(sent)
    for name, c in sent.items():
        got = log.channels[name]
        stride = 10 if name == "t_oil" and c.t.size > got.t.size else 1
        np.testing.assert_allclose(got.t, c.t[::stride], atol=1.1e-6)
        if name != "i_cmd":
            np.testing.assert_allclose(got.values, c.values[::stride], atol=RESOLUTION[name] * 0.501)


@given(
    st.lists(st.tuples(st.floats(0, 1e4), st.floats(-10, 75)), min_size=2, unique_by=lambda p: p[0]),
    st.sampled_from(TABLES),
)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=examples(50))
def test_any_samples_survive_a_table(
    tmp_path: Path, quick_mdf: None, points: list[tuple[float, float]], suffix: str
) -> None:
    t, values = np.array(sorted(points)).T
    write_log(tmp_path / f"any{suffix}", {"n_dem": Channel(t, values), "x_dem": Channel(t[:1] + 0.5, values[:1])})
    log = read_log(tmp_path / f"any{suffix}")
    check(log)
    assert np.array_equal(log.channels["n_dem"].t, t) and np.array_equal(log.channels["n_dem"].values, values)


@pytest.mark.parametrize(
    ("suffix", "writer"),
    [(".log", "CanutilsLogWriter"), (".asc", "ASCWriter"), (".blf", "BLFWriter"), (".trc", "TRCWriter")],
)
def test_frames_are_those_that_python_can_reads(tmp_path: Path, suffix: str, writer: str) -> None:
    import can

    rng, path, t = np.random.default_rng(3), tmp_path / f"x{suffix}", 1.7e9
    with getattr(can, writer)(path) as out:
        for _ in range(800):
            t += rng.random() * 0.01
            extended, kind = bool(rng.random() < 0.5), rng.random()
            who = {
                "timestamp": round(t, 6),
                "arbitration_id": int(rng.integers(1 << (29 if extended else 11))),
                "is_extended_id": extended,
            }
            if suffix == ".trc" or kind > 0.4:
                out.on_message_received(
                    can.Message(**who, data=rng.bytes(int(rng.integers(9))), channel=int(rng.integers(3)))
                )
            elif kind > 0.1:
                n = int(rng.choice([1, 8, 12, 16, 20, 24, 32, 48, 64]))
                out.on_message_received(
                    can.Message(**who, is_fd=True, bitrate_switch=kind > 0.2, data=rng.bytes(n), channel=0)
                )
            elif kind > 0.05:
                out.on_message_received(can.Message(**who, is_remote_frame=True, dlc=4, channel=0))
            else:
                out.on_message_received(can.Message(**who, is_error_frame=True, channel=0))
    theirs = [m for m in can.LogReader(path) if not m.is_error_frame and not m.is_remote_frame]
    ours = {".log": read_candump, ".asc": read_asc, ".blf": read_blf, ".trc": read_trc}[suffix](path)
    assert len(theirs) == ours.t.size
    for k, m in enumerate(theirs):
        assert m.arbitration_id | (EXTENDED if m.is_extended_id else 0) == ours.ident[k]
        assert bytes(m.data) == ours.data[k, : ours.length[k]].tobytes()
        assert abs(m.timestamp - theirs[0].timestamp - ours.t[k]) < 2e-6


def test_what_we_write_python_can_and_asammdf_read(tmp_path: Path) -> None:
    import asammdf
    import can

    sent = run(100)
    for suffix in (*BUSES, *BOTH):
        write_log(tmp_path / f"a{suffix}", sent, dbc=DBC)
        assert sum(1 for _ in can.LogReader(tmp_path / f"a{suffix}")) == 6 * 100 + 10
    with asammdf.MDF(tmp_path / "a.mf4") as raw:
        signals = raw.extract_bus_logging({"CAN": [(str(DBC), 0)]})
        np.testing.assert_allclose(signals.get("x_lvdt").samples, sent["x_lvdt"].values, atol=0.0005001)


def test_a_silent_channel_is_not_made_up_on_the_bus(tmp_path: Path) -> None:
    t = np.concatenate((np.arange(100) * 0.01, 5 + np.arange(100) * 0.01))
    write_log(
        tmp_path / "a.log", {"n_dem": Channel(t, np.full(200, 50.0)), "x_dem": Channel(t[:100], np.full(100, 9.0))}
    )
    log = read_log(tmp_path / "a.log")
    gap = np.diff(log.channels["n_dem"].t).max()
    assert 3.9 < gap < 4.1
    assert "n_r" not in log.channels and "x_lvdt" not in log.channels
    assert log.notes == ["VGV_STATUS.x_dem: 100 frames say not available: left out"] or log.notes == []
    assert "all 203 frames say not available" in refused(tmp_path / "a.log", require=("n_r",))


def test_current_on_the_bus_is_the_mean_since_the_last_frame(tmp_path: Path) -> None:
    t = np.arange(1000) * 0.001
    current = 20 * np.sin(2 * np.pi * 100 * t)  # one period a frame: its mean is zero, its samples alias
    write_log(tmp_path / "a.log", {"i_cmd": Channel(t, current)})
    assert np.abs(read_log(tmp_path / "a.log", require=()).channels["i_cmd"].values[1:]).max() < 0.01


# --- candump ----------------------------------------------------------------------------------------------------------


def test_candump_variants_are_understood(tmp_path: Path) -> None:
    frame = encode(load_dbc(DBC)[0][0], {"n_dem": np.array([10.0, 20.0, 30.0, 40.0]), "n_r": np.full(4, 9.0)}, 4)
    hexes = [f.tobytes().hex() for f in frame]
    text = [
        f"(1735329625.000000) can0 0A0#{hexes[0].upper()}",
        f"(1735329625.010000) can0 0a0#{hexes[1]} R",
        f"(1735329625.020000)  vcan1  0A0   [8]  {' '.join(re.findall('..', hexes[2].upper()))}",
        f"(1735329625.025000) can0 0A0##1{hexes[3].upper()} T\r",
        "(1735329625.026000) can0 0A0#R", "(1735329625.026000) can0 0A0#R8", "(1735329625.026000) can0 "
                                                                             "20000080#0000000000000000",
        "(1735329625.027000) can0 1ABCDEF0#0102", "", "# comment", "(1735329625.03",
    ]  # fmt: skip
    (tmp_path / "a.log").write_text("\n".join(text))
    frames = read_candump(tmp_path / "a.log")
    assert frames.ident.tolist() == [0x0A0] * 4 + [0x1ABCDEF0 | EXTENDED]
    assert frames.notes == ["1 lines are not candump lines: left out", "3 remote or error frames: left out"]
    assert frames.data[3, :8].tobytes().hex() == hexes[3]
    log = read_log(tmp_path / "a.log")
    assert log.channels["n_dem"].values.tolist() == [10, 20, 40]  # vcan1 is another bus: two sources are never mixed
    assert any("2 senders or buses" in n for n in log.notes)


def test_many_layouts_and_much_noise_between_lose_no_frame(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    lines = []
    for k in range(3000):
        lines.append(f"({1000 + k * 0.01:.6f}) can{k % 40} 0A0#{rng.bytes(8).hex().upper()}")
        lines.append("(" + "".join(rng.choice(list("abcxyz ."), 40)))
    (tmp_path / "a.log").write_text("\n".join(lines))
    frames = read_candump(tmp_path / "a.log")
    assert frames.t.size == 3000 and np.unique(frames.bus).size == 40
    np.testing.assert_allclose(frames.t, np.arange(3000) * 0.01, atol=1e-9)


def test_frames_up_to_50_ms_out_of_order_are_sorted_and_more_is_refused(tmp_path: Path) -> None:
    write_log(tmp_path / "a.log", run(50))
    lines = (tmp_path / "a.log").read_text().splitlines()
    (tmp_path / "b.log").write_text("\n".join([*lines[:40], *lines[44:52], *lines[40:44], *lines[52:]]))
    log = read_log(tmp_path / "b.log")
    assert any("out of order" in n for n in log.notes)
    assert np.array_equal(log.channels["n_dem"].t, read_log(tmp_path / "a.log").channels["n_dem"].t)
    (tmp_path / "c.log").write_text("\n".join([*lines[80:], *lines[:80]]))
    assert "runs backwards" in refused(tmp_path / "c.log")


def test_frames_with_a_wrong_crc_are_left_out_and_counted(tmp_path: Path) -> None:
    write_log(tmp_path / "a.log", run(50))
    text = re.sub(r"(?m)^(\(0000000000\.1[0-4]0000\) vcan0 0A0#)..", r"\g<1>FF", (tmp_path / "a.log").read_text())
    (tmp_path / "a.log").write_text(text)
    log = read_log(tmp_path / "a.log")
    assert log.channels["n_dem"].t.size == 45
    assert "ECU_DEMAND: 5 of 50 frames have a wrong CRC: left out" in log.notes


def test_short_frames_are_left_out_and_all_short_is_refused(tmp_path: Path) -> None:
    write_log(tmp_path / "a.log", run(50))
    text = (tmp_path / "a.log").read_text()
    (tmp_path / "b.log").write_text(re.sub(r"(?m)^(\(0000000000\.1.*0A0#.{8}).*", r"\1", text))
    assert "ECU_DEMAND: 10 of 50 frames are shorter than its 8 bytes: left out" in read_log(tmp_path / "b.log").notes
    (tmp_path / "c.log").write_text(re.sub(r"(?m)^(.*0A0#.{8}).*", r"\1", text))
    assert "shorter than its 8 bytes" in refused(tmp_path / "c.log")


@pytest.mark.parametrize("suffix", [*BUSES, ".csv"])
def test_a_cut_log_is_read_as_far_as_it_goes(tmp_path: Path, suffix: str) -> None:
    write_log(tmp_path / f"a{suffix}", run(3000))
    raw = (tmp_path / f"a{suffix}").read_bytes()
    (tmp_path / f"b{suffix}").write_bytes(raw[: len(raw) // 2 + 7])
    log = read_log(tmp_path / f"b{suffix}")
    check(log)
    assert 1000 < log.channels["n_dem"].t.size < 2000


# --- other bus formats ------------------------------------------------------------------------------------------------


def test_asc_times_relative_to_the_event_before_add_up(tmp_path: Path) -> None:
    text = "date Fri Jan 1 10:00:00.000 am 2021\nbase hex  timestamps relative\ninternal events logged\n"
    for _ in range(5):
        text += "   0.004000 1  Statistic: D 1 R 0 XD 0 XR 0 E 0 O 0 B 0.00%\n"
        text += "   0.006000 1  123             Rx   d 2 01 02  Length = 1 ID = 291\n"
    (tmp_path / "a.asc").write_text(text)
    np.testing.assert_allclose(read_asc(tmp_path / "a.asc").t, np.arange(5) * 0.01, atol=1e-9)


@pytest.mark.parametrize(
    ("head", "line"),
    [
        ("", "{n:>6}) {t:10.1f}  {i:04X}  8  {d}"),
        (";$FILEVERSION=1.1\n;$STARTTIME=37704.5364870833\n", "{n:>6}) {t:10.1f}  Rx         {i:04X}  8  {d}"),
        (";$FILEVERSION=1.2\n", "{n:>6}) {t:10.3f} 1  Rx         {i:04X}  8  {d}"),
        (";$FILEVERSION=1.3\n", "{n:>6}) {t:10.3f} 1  Rx         {i:04X} -  8    {d}"),
        (";$FILEVERSION=2.0\n;$COLUMNS=N,O,T,I,d,l,D\n", "{n:>7} {t:13.3f} DT     {i:04X} Rx 8  {d}"),
        (";$FILEVERSION=2.1\n;$COLUMNS=N,O,T,B,I,d,R,L,D\n", "{n:>7} {t:13.3f} DT 1     {i:04X} Rx -  8    {d}"),
    ],
)
def test_every_version_of_trc_is_read(tmp_path: Path, head: str, line: str) -> None:
    rows = [
        line.format(n=k + 1, t=10.0 * k, i=0xA0 + k % 2, d=" ".join(f"{b:02X}" for b in range(k, k + 8)))
        for k in range(120)
    ]
    (tmp_path / "a.trc").write_text(head + "; comment\n" + "\n".join(rows))
    frames = read_trc(tmp_path / "a.trc")
    np.testing.assert_allclose(frames.t, np.arange(120) * 0.01, atol=1e-9)
    assert np.array_equal(frames.data[:, 0], np.arange(120)) and frames.ident.tolist() == [0xA0, 0xA1] * 60


def test_a_damaged_blf_container_costs_its_own_frames(tmp_path: Path) -> None:
    write_log(tmp_path / "a.blf", run(4000))
    raw = bytearray((tmp_path / "a.blf").read_bytes())
    second = raw.find(b"LOBJ", raw.find(b"LOBJ", 144) + 4)
    raw[second + 60 : second + 90] = bytes(30)
    (tmp_path / "a.blf").write_bytes(raw)
    log = read_log(tmp_path / "a.blf")
    check(log)
    assert any("damaged" in n for n in log.notes)
    assert 2000 < log.channels["n_dem"].t.size < 4000


def test_a_blf_object_of_size_zero_and_a_boasting_container_are_survived(tmp_path: Path) -> None:
    head = b"LOGG" + (144).to_bytes(4, "little") + bytes(136)
    empty = b"LOBJ" + bytes(28)
    for stream, promise in ((empty * 4, 128), (bytes(1 << 20), 0xFFFFFFFF)):
        body = zlib.compress(stream)
        size = (32 + len(body)).to_bytes(4, "little")
        container = (
            b"LOBJ\x10\0\x01\0"
            + size
            + (10).to_bytes(4, "little")
            + b"\x02"
            + bytes(7)
            + promise.to_bytes(4, "little")
            + bytes(4)
        )
        (tmp_path / "a.blf").write_bytes(head + container + body)
        assert "no CAN data frame" in refused(tmp_path / "a.blf")


# --- names ------------------------------------------------------------------------------------------------------------


def test_names_are_mapped_in_both_directions(tmp_path: Path) -> None:
    file = csv(tmp_path, "Zeit,N1_DEM,n_r\n0,1,3\n1,2,4\n")
    for mapping in ({"N1_DEM": "n_dem"}, {"n_dem": "N1_DEM"}, {"n1_dem": "n_dem"}, {"N1_DEM": "n_dem", "zeit": "t"}):
        assert read_log(file, mapping=mapping).channels["n_dem"].values.tolist() == [1, 2]
    swapped = read_log(csv(tmp_path, "t,n_dem,n_r\n0,1,3\n1,2,4\n"), mapping={"n_dem": "n_r", "n_r": "n_dem"})
    assert swapped.channels["n_dem"].values.tolist() == [3, 4] and swapped.channels["n_r"].values.tolist() == [1, 2]


def test_one_log_name_can_serve_two_signals(tmp_path: Path) -> None:
    log = read_log(csv(tmp_path, "t,RPM\n0,1\n1,2\n"), mapping={"n_dem": "RPM", "n_r": "RPM"})
    assert np.array_equal(log.channels["n_dem"].values, log.channels["n_r"].values)


def test_unknown_names_are_refused_with_what_is_close_and_what_there_is(tmp_path: Path) -> None:
    file = csv(tmp_path, "t,N1_DEM,N1_ACT\n0,1,3\n1,2,4\n")
    line = refused(file, mapping={"N1_DME": "n_dem"})
    assert "close: N1_DEM" in line and "N1_ACT" in line
    assert "close: n_dem" in refused(file, mapping={"N1_DEM": "n_den"})
    assert "'n_dem'" in refused(file) and "N1_DEM" in refused(file)
    assert "both" in refused(file, mapping={"N1_DEM": "n_dem", "N1_ACT": "n_dem"})
    assert "time column" in refused(csv(tmp_path, "a,n_dem\n0,1\n1,2\n"))


def test_a_missing_channel_is_fine_unless_required(tmp_path: Path) -> None:
    file = csv(tmp_path, "t,n_dem\n0,1\n1,2\n")
    assert set(read_log(file).channels) == {"n_dem"}
    assert "no x_lvdt" in refused(file, require=("n_dem", "x_lvdt"))
    assert set(read_log(file, require=()).channels) == {"n_dem"}


def test_a_can_name_may_carry_its_message(tmp_path: Path) -> None:
    write_log(tmp_path / "a.log", run(50))
    for name in ("VGV_STATUS.x_lvdt", "x_lvdt", "X_LVDT"):
        log = read_log(tmp_path / "a.log", mapping={name: "x_dem"})
        assert np.array_equal(log.channels["x_dem"].values, log.channels["x_lvdt"].values)
    line = refused(tmp_path / "a.log", mapping={"VGV_STATUS.x_lvd": "x_dem"})
    assert "close: VGV_STATUS.x_lvdt" in line


def test_an_mdf_name_may_carry_its_group(tmp_path: Path, quick_mdf: None) -> None:
    import asammdf

    t = np.arange(20) * 0.1
    with asammdf.MDF(version="4.10") as mdf:
        for k, name in enumerate(("Rig", "Ref")):
            mdf.append([asammdf.Signal(t + k, t, name="N1", unit="%")], acq_name=name)
        mdf.append([asammdf.Signal(np.array([b"a"] * 20), t, name="text", encoding="utf-8")])
        mdf.save(tmp_path / "a.mf4")
    assert read_log(tmp_path / "a.mf4", mapping={"Ref.N1": "n_dem"}).channels["n_dem"].values[0] == 1
    assert "may be" in refused(tmp_path / "a.mf4", mapping={"N1": "n_dem"})
    assert "not numbers" in refused(tmp_path / "a.mf4", mapping={"text": "n_dem"})


# --- units ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("signal", "unit", "value", "expected"),
    [
        ("n_dem", "rpm", 19000.0, 50.0), ("n_dem", "Hz", 38000 / 60, 100.0), ("n_dem", "1/min", 3800.0, 10.0),
        ("n_dem", "kHz", 0.038 / 0.06, 100.0), ("n_dem", "rad/s", 38000 / 60 * 2 * np.pi, 100.0),
        ("n_dem", "deg/s", 38000 * 6, 100.0),
        ("n_dem", "ratio", 0.5, 50.0), ("n_dem", "%", 7.0, 7.0), ("x_dem", "m", 0.02, 20.0),
        ("x_dem", "inch", 1.0, 25.4),
        ("i_cmd", "A", 0.01, 10.0), ("p_s", "bar", 210.0, 21.0), ("p_s", "psi", 3000.0, 20.6842719),
        ("t_oil", "K", 300.0, 26.85),
        ("t_oil", "°C", 20.0, 20.0), ("t_oil", "degF", 212.0, 100.0), ("vigv", "rad", 1.0, 57.29577951),
        ("vigv", "°", 3.0, 3.0),
    ],
)  # fmt: skip
def test_units_are_converted(tmp_path: Path, signal: str, unit: str, value: float, expected: float) -> None:
    stated = read_log(
        csv(tmp_path, f"t,{signal}\n0,{value!r}\n1,{value!r}\n"), units={signal: unit}, design_rpm=38000, require=()
    )
    in_header = read_log(
        csv(tmp_path, f"t,{signal} [{unit}]\n0,{value!r}\n1,{value!r}\n"), design_rpm=38000, require=()
    )
    for log in (stated, in_header):
        np.testing.assert_allclose(log.channels[signal].values, expected, rtol=1e-7)
        assert log.notes == []


def test_a_speed_that_is_not_in_per_cent_needs_the_design_speed(tmp_path: Path) -> None:
    file = csv(tmp_path, "t,n_dem\n0,1\n1,2\n")
    for unit in ("rpm", "Hz", "rad/s"):
        assert "--design-rpm" in refused(file, units={"n_dem": unit})
    for wrong in (0.0, -1.0, np.nan, np.inf):
        assert "above 0" in refused(file, units={"n_dem": "rpm"}, design_rpm=wrong)


def test_a_unit_that_does_not_convert_is_refused_with_what_is_allowed(tmp_path: Path) -> None:
    line = refused(csv(tmp_path, "t,n_dem,x_dem\n0,1,1\n1,2,2\n"), units={"x_dem": "degC"})
    assert "x_dem" in line and "degC" in line and "mm" in line
    assert "not known" in refused(csv(tmp_path, "t,n_dem\n0,1\n1,2\n"), units={"n_dem": "parsnip"})
    assert "x_dem" in refused(csv(tmp_path, "t,n_dem,x_dem [V]\n0,1,1\n1,2,2\n"))
    assert (
        read_log(csv(tmp_path, "t,n_dem,x_dem [V]\n0,1,1\n1,2,2\n"), units={"x_dem": "mm"}).channels["x_dem"].values[1]
        == 2
    )
    assert "close: n_dem" in refused(csv(tmp_path, "t,n_dem\n0,1\n1,2\n"), units={"n_den": "rpm"})


def test_a_unit_that_nobody_knows_is_taken_for_the_signals_own_with_a_note(tmp_path: Path) -> None:
    log = read_log(csv(tmp_path, "t,n_dem,p_s [Skt]\n0,1,5\n1,2,6\n"))
    assert log.channels["p_s"].values.tolist() == [5, 6]
    assert log.notes == ["p_s (p_s [Skt]): unit 'Skt' is not known, MPa assumed"]


@pytest.mark.parametrize(
    "unit", ["9**9**9**9", "mm^99999", "(" * 40, "mm mm", "%%", "1e999", "m^-", "_", "+", "°°", "\\", "mm/0"]
)
def test_no_unit_text_of_a_file_does_harm(tmp_path: Path, unit: str) -> None:
    with contextlib.suppress(LogError):
        check(read_log(csv(tmp_path, f"t,n_dem,p_s [{unit}]\n0,1,5\n1,2,6\n")))


def test_time_may_be_in_another_unit_or_count_from_1970(tmp_path: Path) -> None:
    assert read_log(csv(tmp_path, "time [ms],n_dem\n0,1\n10,2\n")).channels["n_dem"].t.tolist() == [0, 0.01]
    assert read_log(csv(tmp_path, "t,n_dem\n0,1\n10,2\n"), units={"t": "min"}).channels["n_dem"].t.tolist() == [0, 600]
    log = read_log(csv(tmp_path, "t,n_dem,x_dem\n1700000000.5,,1\n1700000001.5,1,\n1700000002,2,\n"))
    assert log.channels["n_dem"].t.tolist() == [1.0, 1.5] and log.channels["x_dem"].t.tolist() == [0]


def test_parquet_is_read_without_importing_pandas(tmp_path: Path) -> None:
    """Which takes longer than all else of a command that reads a log."""
    write_log(tmp_path / "a.parquet", {"n_dem": Channel(np.arange(9.0), np.arange(9.0))})
    code = "import sys; from hil.logs import read_log; read_log(sys.argv[1]); sys.exit('pandas' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code, str(tmp_path / "a.parquet")], check=False).returncode == 0


@pytest.mark.slow
def test_parquet_takes_integers_bools_dates_and_nulls(tmp_path: Path) -> None:
    import datetime

    pl = pytest.importorskip("polars", reason="no Parquet of another writer: polars is not installed")
    start = datetime.datetime(2024, 1, 1)
    t = [start + datetime.timedelta(milliseconds=10 * k) for k in range(4)]
    pl.DataFrame({"t": t, "n_dem": [1, 2, None, 4], "state": [True, False, True, None]}).write_parquet(
        tmp_path / "a.parquet"
    )
    log = read_log(tmp_path / "a.parquet")
    np.testing.assert_allclose(log.channels["n_dem"].t, [0, 0.01, 0.03], atol=1e-6)
    assert log.channels["n_dem"].values.tolist() == [1, 2, 4] and log.channels["state"].values.tolist() == [1, 0, 1]
    pl.DataFrame({"t": [0, 1], "n_dem": ["a", "b"]}).write_parquet(tmp_path / "b.parquet")
    assert "not numbers" in refused(tmp_path / "b.parquet")


@pytest.mark.parametrize("quote", ["", '"'])
def test_rows_of_a_csv_with_too_few_or_too_many_cells_are_left_out_and_told(tmp_path: Path, quote: str) -> None:
    """As a logger leaves them that lost its power, or that added a list: nothing is moved, filled or cut."""
    rows = ["0,1,5", "1,2", "2,3,7,a remark", "", f"4,{quote}5{quote},9", "5,6,1", "6"]
    log = read_log(csv(tmp_path, "t,n_dem,n_r\n" + "\n".join(rows)))
    for name, values in (("n_dem", [1, 5, 6]), ("n_r", [5, 9, 1])):
        assert log.channels[name].t.tolist() == [0, 4, 5] and log.channels[name].values.tolist() == values
    (note,) = log.notes
    assert note == (
        "rows: 3 of 7 rows have more or fewer cells than the header (first row 3: 2, the header 3): left out"
    )
    assert isinstance(note, Note) and note.number == 3 and note.rows == (3, 4, 8)
    assert "row 6: 'x' is not a number" in refused(csv(tmp_path, "t,n_dem\n0,1\n1\n\n2,3\n3,x\n"))


# --- times and values -------------------------------------------------------------------------------------------------


def test_tables_whose_time_runs_backwards_are_refused_by_row(tmp_path: Path) -> None:
    line = refused(csv(tmp_path, "t,n_dem\n0,1\n0.2,2\n0.1,3\n"))
    assert "n_dem" in line and "row 4" in line and "0.2 s to 0.1 s" in line
    import asammdf

    with asammdf.MDF(version="4.10") as mdf:
        mdf.append([asammdf.Signal(np.arange(4.0), np.array([0, 2.0, 1.0, 3.0]), name="n_dem")])
        mdf.save(tmp_path / "a.mf4")
    assert "runs backwards at sample 3" in refused(tmp_path / "a.mf4")


def test_of_samples_at_one_time_the_last_is_kept(tmp_path: Path) -> None:
    log = read_log(csv(tmp_path, "t,n_dem\n0,1\n1,2\n1,3\n2,4\n"))
    assert log.channels["n_dem"].values.tolist() == [1, 3, 4]
    assert log.notes == ["n_dem (n_dem): 1 of 4 samples have the time of the next: left out"]


@pytest.mark.parametrize("stamp", ["whole seconds", "dates", "too few digits"])
def test_times_too_coarse_for_their_samples_are_refused(tmp_path: Path, stamp: str) -> None:
    """As a spreadsheet writes them: of a hundred samples a second ninety-nine would be left out without a word."""
    t = np.arange(0.0, 20.0, 0.01)
    said = {
        "whole seconds": [f"{x:.0f}" for x in t],
        "dates": [f"2026-11-22 18:45:{int(x):02d}" for x in t],
        "too few digits": [f"{x + 1.7e9:.9g}" for x in t],
    }[stamp]
    rows = "".join(f"{a},{60 + 10 * np.sin(b):.6f}\n" for a, b in zip(said, t, strict=True))
    line = refused(csv(tmp_path, f"time,n_dem\n{rows}"))
    assert "n_dem" in line and "of 2,000 samples have the time of the next" in line and "--map NAME=t" in line


@pytest.mark.parametrize(
    ("unit", "said"),
    [
        ("n_dem=rmp", "unit is not known (did you mean rpm?); allowed: %, rpm, Hz or rad/s"),
        ("n_r=-parsec/h", "unit does not convert"),
        ("x_lvdt=mmm", "did you mean mm?"),
        ("x_lvdt=degC", "unit does not convert; allowed: mm or what converts to it"),
        ("t=seconds_", "unit is not known"),
    ],
)
def test_a_unit_that_is_none_is_refused_before_any_name_is_looked_for(tmp_path: Path, unit: str, said: str) -> None:
    """Else a name that would be guessed is not, and the answer is one of a log without it."""
    file = csv(
        tmp_path,
        "Zeit_s,N1_Demand,Stroke_Position_mm\n" + "".join(f"{i / 10},{60 + i % 7},{9 + i % 5}\n" for i in range(60)),
    )
    line = refused(file, units=dict([unit.split("=", 1)]))
    assert f"--unit {unit}: " in line and said in line


def test_a_row_written_twice_is_read_once(tmp_path: Path) -> None:
    rows = "".join(f"{i / 100},{60 + i / 10}\n" * 4 for i in range(200))
    assert read_log(csv(tmp_path, f"t,n_dem\n{rows}")).channels["n_dem"].t.size == 200


def test_nan_is_left_out_with_a_note_and_empty_cells_without(tmp_path: Path) -> None:
    log = read_log(csv(tmp_path, "t,n_dem,x_dem,n_r\n0,1,,nan\n1,NaN,5,nan\n2,inf,,nan\n3,4,6,nan\n,9,9,nan\n"))
    assert log.channels["n_dem"].t.tolist() == [0, 3] and log.channels["x_dem"].t.tolist() == [1, 3]
    assert "n_r" not in log.channels
    assert log.notes == [
        "n_dem (n_dem): 2 of 5 samples are NaN or infinite: left out",
        "n_r (n_r): 4 of 5 samples are NaN or infinite: left out", "n_r (n_r): no sample that can be used",
    ]  # fmt: skip
    assert "NaN" in refused(csv(tmp_path, "t,n_dem\n0,nan\n1,nan\n"))
    assert "only one sample" in refused(csv(tmp_path, "t,n_dem\n0,1\n1,nan\n"))


def test_a_word_among_numbers_is_named_by_its_row(tmp_path: Path) -> None:
    assert "column 'n_dem', row 3: 'oops' is not a number" in refused(csv(tmp_path, "t,n_dem\n0,1\n1,oops\n"))
    assert "row 5" in refused(csv(tmp_path, "# made by a rig\n\nt,n_dem\n0,1\n1,oops\n"))


@pytest.mark.parametrize(
    "text",
    [
        "t;n_dem\n0;1,5\n0,5;2,5\n",
        "t\tn_dem\n0\t1.5\n0.5\t2.5\n", '"t","n_dem"\n"0","1.5"\n"0.5","2.5"\n',
        "t,n_dem\r\n0,1.5\r\n0.5,2.5\r\n",
        " t , n_dem \n 0 , 1.5 \n 0.5, 2.5\n", "\ufefft,n_dem\n0,1.5\n0.5,2.5",
        "t,n_dem,note\n0,1.5,a\n0.5,2.5\n", "note,t,n_dem\n\u00e4,0,1.5\n-,0.5,2.5\n",
        "t,n_dem,x_dem\n0,1.5,\n0.5,2.5,,\n", "t,n_dem\n0,+1.5\n5e-1,25e-1\n",
    ],
)  # fmt: skip
def test_csv_dialects(tmp_path: Path, text: str) -> None:
    for encoding in ("utf-8", "utf-16"):
        (tmp_path / "a.csv").write_bytes(text.encode(encoding))
        c = read_log(tmp_path / "a.csv").channels["n_dem"]
        assert c.t.tolist() == [0, 0.5] and c.values.tolist() == [1.5, 2.5]


# --- databases --------------------------------------------------------------------------------------------------------


def test_a_dbc_that_does_not_fit_or_parse_is_refused(tmp_path: Path) -> None:
    write_log(tmp_path / "a.log", run(50))
    (tmp_path / "other.dbc").write_text(MUX)
    assert "other.dbc has it in M (0x123), but the log has no such frame" in refused(
        tmp_path / "a.log", dbc=tmp_path / "other.dbc"
    )
    for text in ("", "not a dbc", "BO_ 1 A: 8 X\n SG_ nonsense", "BO_ \0"):
        (tmp_path / "bad.dbc").write_text(text)
        with pytest.raises(LogError, match=r"bad\.dbc"):
            read_log(tmp_path / "a.log", dbc=tmp_path / "bad.dbc")
    with pytest.raises(LogError, match="No such file"):
        read_log(tmp_path / "a.log", dbc=tmp_path / "none.dbc")


J1939 = f"""BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","reserved","J1939PG";
BA_DEF_DEF_ "VFrameFormat" "J1939PG";
BA_ "VFrameFormat" BO_ {0x8CF004FE} 3;
"""


def test_j1939_frames_are_matched_by_their_parameter_group(tmp_path: Path) -> None:
    (tmp_path / "j.dbc").write_text(
        MUX.split("BO_")[0]
        + f'BO_ {0x8CF004FE} EEC1: 8 A\n SG_ n_dem : 24|16@1+ (0.125,0) [0|8031.875] "rpm" A\n'
        + J1939
    )
    speeds = [800, 801, 0xFFFF, 803]
    lines = [
        f"(1.{k:06d}) can0 0CF00400#000000{(8 * n & 0xFFFF).to_bytes(2, 'little').hex().upper()}000000"
        for k, n in enumerate(speeds)
    ]
    lines += ["(1.100000) can0 18F00417#0000000000000000"]
    (tmp_path / "a.log").write_text("\n".join(lines))
    log = read_log(tmp_path / "a.log", dbc=tmp_path / "j.dbc", design_rpm=1000)
    np.testing.assert_allclose(log.channels["n_dem"].values, [80.0, 80.1, 80.3])  # 0xFF.. says not available
    assert any("2 senders or buses; took 0xCF00400 (4 of 5 frames)" in n for n in log.notes)


# --- real recordings --------------------------------------------------------------------------------------------------


def test_a_car_being_revved_is_read_from_candump() -> None:
    folder = data("can_honda")
    options: dict[str, Any] = {"dbc": folder / "honda_pilot_2017.dbc", "design_rpm": 6000}
    for name in ("ENGINE_RPM", "POWERTRAIN_DATA.ENGINE_RPM"):
        log = read_log(folder / "revlog.log", mapping={name: "n_dem"}, **options)
        check(log)
        rpm = log.channels["n_dem"].values * 60
        assert rpm.size == 1300 and rpm.min() == 0 and 5200 < rpm.max() < 5260
        assert np.median(np.diff(log.channels["n_dem"].t)) == pytest.approx(0.01, abs=2e-4)
        assert any("VAL_" in n for n in log.notes)
    assert set(log.channels) == {"n_dem"}
    line = refused(folder / "revlog.log", mapping={"ENGINE_RPM": "n_dem"}, dbc=options["dbc"])
    assert "in rpm" in line and "--design-rpm" in line  # the DBC says rpm
    assert "--dbc" in refused(folder / "revlog.log", mapping={"ENGINE_RPM": "n_dem"})


def test_an_idling_truck_is_read_from_an_mdf_bus_log() -> None:
    folder = data("can_j1939")
    log = read_log(
        folder / "log.mf4", dbc=folder / "j1939_demo.dbc", mapping={"EEC1.EngineSpeed": "n_dem"}, design_rpm=2000
    )
    check(log)
    c = log.channels["n_dem"]
    assert c.t.size == 12719 and c.t[-1] == pytest.approx(127.19, abs=0.01)
    assert 640 < c.values.min() * 20 < c.values.max() * 20 < 660


def test_real_frames_decode_as_cantools_does() -> None:
    import can

    folder = data("can_honda")
    messages = {m.ident: m for m in load_dbc(folder / "honda_pilot_2017.dbc")[0]}
    frames = read_candump(folder / "revlog.log")
    theirs: dict[tuple[int, str], list[float]] = {}
    for k, f in enumerate(can.CanutilsLogReader(folder / "revlog.log")):
        assert f.arbitration_id == frames.ident[k] and bytes(f.data) == frames.data[k, : len(f.data)].tobytes()
        m = messages.get(f.arbitration_id)
        if m is not None and len(f.data) >= m.layout.length:
            for name, value in m.layout.decode(bytes(f.data), decode_choices=False).items():
                theirs.setdefault((m.ident, name), []).append(value)
    assert theirs
    for (ident, name), values in theirs.items():
        m = messages[ident]
        rows, _ = select(frames, m)
        np.testing.assert_allclose(
            cut_signal(frames, rows, m, m.layout.get_signal_by_name(name))[1], values, rtol=1e-15
        )


# --- writing ----------------------------------------------------------------------------------------------------------


def test_what_cannot_be_written_is_refused(tmp_path: Path) -> None:
    t = np.array([0.0, 1.0])
    good = Channel(t, t)
    for name, channels in {
        "a.txt": {"n_dem": good}, "b.csv": {}, "c.csv": {"speed": good}, "d.csv": {"n_dem": Channel(t[::-1], t)},
        "e.csv": {"n_dem": Channel(t, t[:1])}, "f.csv": {"n_dem": Channel(t, np.array([0, np.nan]))},
        "g.log": {"n_dem": Channel(t, np.array([0, 200.0]))}, "none/h.csv": {"n_dem": good},
        "i.log": {"n_dem": Channel(np.array([0, 1e9]), t)},
    }.items():  # fmt: skip
        with pytest.raises(LogError, match=re.escape(str(tmp_path / name))):
            write_log(tmp_path / name, channels)


@pytest.mark.parametrize("cell", ["1.5", " 1.5", "1,5", '"1.5"'])
def test_a_csv_read_in_blocks_is_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cell: str) -> None:
    path = tmp_path / "long.csv"
    rows = "".join(f"{0.01 * k:.2f};{cell if k % 7 else ''};{k % 9}\r\n" for k in range(400))
    path.write_text("# made\nt;n_dem;n_r\ns;%;%\n" + (rows.replace(".", ",") if "," in cell else rows))
    whole = read_log(path).channels
    monkeypatch.setattr(csv_format, "_BLOCK", 100)
    parts = read_log(path).channels
    assert whole.keys() == parts.keys() == {"n_dem", "n_r"}
    for name, c in whole.items():
        assert np.array_equal(c.t, parts[name].t)
        assert np.array_equal(c.values, parts[name].values)
    path.write_text(path.read_text().replace("3.99;", "word;").replace("3,99;", "word;"))
    with pytest.raises(LogError, match="row 403: 'word' is not a number"):
        read_log(path)
