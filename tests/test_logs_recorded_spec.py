"""What was recorded is read again, whatever its file went through, and nothing of a recording is lost."""

from __future__ import annotations

import contextlib
import fcntl
import io
import json
import logging
import os
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import can
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from hil.bus.frames import NOTE
from hil.logs import (
    Channel,
    Format,
    Log,
    LogError,
    Options,
    blf,
    csv_format,
    formats,
    layout,
    mdf,
    mdf_child,
    offered,
    opening,
    plausible,
    read_log,
    recorder,
    write_log,
)
from hil.logs.blf import read_blf, whole_blf
from hil.logs.bus_log import encode_channels
from hil.logs.candump import read_candump
from hil.logs.dbc import load_dbc
from hil.logs.formats import format_of
from hil.logs.formula import formula_of
from hil.logs.frames import EXTENDED, Frames
from hil.logs.guess import design_speed, feed_forward, guess, mean_stroke
from hil.logs.joined import Joined, _last_digit, joined, seems_joined
from hil.logs.mapping import Bench, write_mapping
from hil.logs.names import is_time, meaning
from hil.logs.notes import Note
from hil.logs.opening import open_log, sketch
from hil.logs.record_formats import FRAME, NOTE_CHANNEL
from hil.logs.record_parquet import ParquetRecord, _moved
from hil.logs.recorder import Recorder
from hil.logs.recordings import read_record
from hil.logs.scale import _mean_over, proposed_scale
from hil.logs.signals import crc_table, cut_raw, cut_signal, encode
from hil.logs.source import Samples, Series, read_bytes
from hil.logs.stale import stale_rows
from hil.logs.survey import survey
from hil.logs.table import split_unit
from hil.logs.tool_traces import read_asc, read_busmaster, read_canhacker, read_crtd, read_csv_frames
from tests.small_logs import read
from tests.small_logs import written as made
from vaneloop.base.errors import InputError
from vaneloop.base.signals import SIDES, UNITS
from vaneloop.base.tables import path as table_path

# ---- recordings ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("part", [1, 100, 1 << 20])
def test_a_binary_log_is_handed_on_object_by_object_in_containers_of_any_size(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, part: int
) -> None:
    monkeypatch.setattr(blf, "_PART", part)
    with can.BLFWriter(str(tmp_path / "a.blf")) as out:
        for k in range(20):
            out.on_message_received(can.Message(1.0 + k, 0x100 + k, False, data=bytes(range(k % 9)), channel=0))
    with can.BLFReader(io.BytesIO(whole_blf(tmp_path / "a.blf"))) as reader:
        got = list(reader)
    assert [m.arbitration_id for m in got] == [0x100 + k for k in range(20)]
    assert [bytes(m.data) for m in got] == [bytes(range(k % 9)) for k in range(20)]
    ours = read_blf(tmp_path / "a.blf")
    assert ours.ident.tolist() == [m.arbitration_id for m in got] and ours.t.tolist() == pytest.approx(range(20))
    assert read_record(tmp_path / "a.blf").rows.shape == (20, 2)


@pytest.mark.parametrize("suffix", [".blf", ".asc"])
def test_frames_on_channel_254_are_notes_of_the_loop(tmp_path: Path, suffix: str) -> None:
    """Recordings that are there already have their notes on it."""
    with can.Logger(str(tmp_path / f"a{suffix}")) as out:
        for k, channel in enumerate((0, 254, 253)):
            out.on_message_received(can.Message(1.0 + k, 0x100, False, data=b"\1", channel=channel))
    found = read_record(tmp_path / f"a{suffix}")
    assert (found.rows[:, 0] & NOTE != 0).tolist() == [False, True, False] and NOTE_CHANNEL == 254


def test_a_recording_that_cannot_begin_leaves_the_folder_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "run.log"

    def full(path: Path, channel: str) -> Any:
        path.write_bytes(b"half a header")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(recorder, "format_of", lambda *a: SimpleNamespace(record=full, check=lambda p: None))
    for before in (None, b"", b"(1.0) vcan0 123#00 R\n"):
        if before is not None:
            file.write_bytes(before)
        with pytest.raises(InputError, match=r"^cannot write .*run.log: No space left on device$"):
            Recorder(file)
        assert [f.name for f in tmp_path.iterdir()] == ([] if before is None else ["run.log"])
        assert before is None or file.read_bytes() == before


def test_addresses_of_a_row_group_move_and_those_that_are_none_do_not() -> None:
    column = {2: (6, 4), 3: (12, {9: (6, 30), 10: (6, 0), 11: (6, 12), 5: (6, 77)})}
    group = {1: (9, (12, [column])), 5: (6, 4), 3: (6, 55)}
    moved = _moved(group, 1000)  # type: ignore[arg-type]
    assert moved[5] == (6, 1004) and moved[3] == (6, 55) and column[2] == (6, 1004)
    assert column[3][1] == {9: (6, 1030), 10: (6, 0), 11: (6, 1012), 5: (6, 77)}


# ---- MDF -------------------------------------------------------------------------------------------------------------


class Opened:
    """An MDF file as asammdf has it open: of each group the place of its time and the kind of that time."""

    def __init__(self, *masters: tuple[int | None, int]):
        self.groups, self.masters_db = [], {}
        for g, (master, kind) in enumerate(masters):
            channels = [
                SimpleNamespace(name=n, comment="", source=None, sync_type=kind if n == "t" else 0)
                for n in ("t", f"n{g}")
            ]
            self.groups.append(SimpleNamespace(channels=channels, channel_group=SimpleNamespace(cycles_nr=3)))
            if master is not None:
                self.masters_db[g] = master

    def get(self, group: int, index: int, raw: bool = False) -> Any:
        made = SimpleNamespace(samples=np.arange(3.0), timestamps=np.arange(3.0), unit="mm")
        return SimpleNamespace(physical=lambda **_: made)


def test_a_channel_group_without_a_time_in_seconds_is_told() -> None:
    """0: no time at all, 1: virtual or in seconds, 2: an angle, 3: a distance, 4: an index."""
    arrays: dict[str, np.ndarray] = {}
    of = Opened((0, 1), (None, 0), (0, 2), (0, 0), (0, 3), (0, 4))
    reply = mdf_child._read(of, [f"n{k}" for k in range(6)], False, arrays)
    assert set(reply["series"]) == {"n0", "n3"} and reply["buses"] == 0
    assert reply["why"] == dict.fromkeys(("n1", "n2", "n4", "n5"), "its channel group has no time")
    assert reply["names"]["n0"] == ["n0", "group0.n0", "0.n0"] and reply["invalid"] == {"n0": 0, "n3": 0}
    assert set(reply["names"]) == {"n0", "t", "n1", "n2", "n3", "n4", "n5"}  # where nothing says that it is the time


# ---- text ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("raw", [
    b"\xef\xbb\xbft,n_dem,\xc3\x96l\n0,50,1\n1,51,2\n", "t,n_dem,\u00d6l\n0,50,1\n1,51,2\n".encode("cp1252"),
    "t,n_dem,\u00d6l\n0,50,1\n1,51,2\n".encode("utf-16"), "t,n_dem,\u00d6l\n0,50,1\n1,51,2\n".encode(),
])  # fmt: skip
def test_names_are_those_of_the_file_however_it_is_encoded(tmp_path: Path, raw: bytes) -> None:
    file = made(tmp_path, raw)
    assert offered(file) == ["t", "n_dem", "\u00d6l"] and read(file).notes == []
    assert read(file, mapping={"\u00d6l": "x_dem"})["x_dem"].values.tolist() == [1.0, 2.0]


def test_dates_are_told_with_what_was_taken_for_the_start(tmp_path: Path) -> None:
    day = "2026-10-25"
    rows = "".join(f"{day} 0{2 if k < 8 else 1}:{(50 + k) % 60:02}:00,{50 + k}\n" for k in range(6))
    assert read(made(tmp_path, "t,n_dem\n" + rows)).notes == [
        "time: dates; 2026-10-25 02:50:00 taken for the start of the log"
    ]  # fmt: skip
    stamps = [f"{day} 02:5{k}:00" for k in range(7, 10)] + [f"{day} 02:0{k}:00" for k in range(3)]
    log = read(made(tmp_path, "t,n_dem\n" + "".join(f"{s},50\n" for s in stamps)))
    assert log["n_dem"].t.tolist() == [0.0, 60.0, 120.0, 180.0, 240.0, 300.0]
    (start, back) = log.notes
    assert start == "time: dates; 2026-10-25 02:57:00 taken for the start of the log" and start.number == 6
    assert back == (
        "time: falls back by an hour at row 5, at the end of summer time: the hour is taken out from there on"
    )
    assert (back.kind, back.of, back.number, back.rows) == ("converted", "time", 3, (5,))


def test_the_hour_of_summer_time_comes_at_night_once_and_by_an_hour(tmp_path: Path) -> None:
    def of(*stamps: str) -> Any:
        return read(made(tmp_path, "t,n_dem\n" + "".join(f"2026-10-25 {s},50\n" for s in stamps)))

    for stamps in (
        ("04:59:59", "04:00:00"), ("05:59:00", "05:00:00"), ("02:59:59", "02:01:00"), ("02:59:59", "01:59:58"),
        ("02:59:00", "02:00:00", "02:59:00", "02:00:00"),
    ):  # fmt: skip
        with pytest.raises(LogError, match="time runs backwards at row 3"):
            of(*stamps)
    assert of("03:59:59", "03:00:00")["n_dem"].t.tolist() == [0.0, 1.0]
    assert of("02:59:59", "02:00:58")["n_dem"].t.tolist() == [0.0, 59.0]
    assert of("02:59:59", "01:59:59", "02:00:00")["n_dem"].t.tolist() == [
        0.0,
        1.0,
    ]  # of two stamps at one time the last


def test_units_under_a_header_go_before_those_above_it() -> None:
    head = (
        "LabVIEW Measurement\t\nX_Columns\tOne\n***End_of_Header***\t\nY_Unit_Label\trpm\tcm\n***End_of_Header***\t\n"
    )
    names = "X_Value\tn_dem\tx_dem\n"
    above = layout.layout_of(Path("LOG"), f"{head}{names}0\t50\t1\n".encode(), Options(None, {}))
    assert above.units == {"n_dem": "rpm", "x_dem": "cm"} and above.under is None
    under = layout.layout_of(Path("LOG"), f"{head}{names}s\t%\tmm\n0\t50\t1\n".encode(), Options(None, {}))
    assert under.units == {"X_Value": "s", "n_dem": "%", "x_dem": "mm"} and under.first == above.first + 1


def test_a_log_that_is_opened_is_read_in_its_longest_part(tmp_path: Path) -> None:
    file = made(tmp_path, "t,n_dem\n0,50\n1,51\nt,n_dem\n0,60\n1,61\n2,62\n")
    opened = open_log(file, None, None, None, None, {"n_dem": "%"}, True, None, {})
    assert opened.source.series("n_dem").values.tolist() == [60.0, 61.0, 62.0]


@pytest.mark.parametrize(("header", "split"), [
    ("a [[mm]", ("a [[mm]", "")), ("a (m)m)", ("a (m)m)", "")), ("a [(mm)]", ("a", "(mm)")), ("a ]mm[", ("a ]mm[", "")),
    ("a [m", ("a [m", "")), ("(a) [mm]", ("(a) [mm]", "")), ("a[m]", ("a", "m")),
])  # fmt: skip
def test_a_bracket_is_a_unit_only_where_it_is_whole(header: str, split: tuple[str, str]) -> None:
    assert split_unit(header) == split


@pytest.mark.parametrize(
    "base", ["base hex  timestamps relative", "BASE HEX TIMESTAMPS RELATIVE", "  base\thex timestamps Relative"]
)
def test_the_head_of_an_ascii_log_is_read_in_any_letters_and_line(tmp_path: Path, base: str) -> None:
    lines = f"date Sat Mar 14 10:00:00 2026\n{base}\n   0.5 1 123 Rx d 1 01\n   0.25 1 123 Rx d 1 02\n"
    assert read_asc(made(tmp_path, lines, "a.asc")).t.tolist() == [0.0, 0.25]
    absolute = lines.lower().replace("relative", "absolute").replace("0.25 1", "0.75 1")
    assert read_asc(made(tmp_path, absolute, "a.asc")).t.tolist() == [0.0, 0.25]
    with pytest.raises(LogError, match="has its numbers in base dec; allowed: base hex"):
        read_asc(made(tmp_path, lines.replace("hex", "dec").replace("HEX", "Dec"), "a.asc"))


def test_remarks_of_a_trace_are_no_damage(tmp_path: Path) -> None:
    lines = "1.0 CXX a remark\n1.5 1R11 2C3 00 35\n1.6 1R11 2C3 01 35\n"
    assert read_crtd(made(tmp_path, lines, "a.crtd")).notes == []
    assert read_crtd(made(tmp_path, lines + "1.7 1R11 2C3 0\n", "a.crtd")).notes == [
        "1 lines are not CRTD lines: left out"
    ]  # fmt: skip


# ---- numbers ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("bits", "kind", "value"), [(16, np.float16, -1.5), (32, np.float32, 0.1), (64, np.float64, -0.1)]
)
def test_an_ieee_signal_is_the_number_that_its_bytes_are(bits: int, kind: Any, value: float) -> None:
    data = np.zeros((1, 16), np.uint8)
    data[0, 1 : 1 + bits // 8] = np.frombuffer(np.array(value, kind).tobytes(), np.uint8)
    signal = SimpleNamespace(byte_order="little_endian", start=8, length=bits, is_float=True, is_signed=True)
    assert cut_raw(data, signal).tolist() == [float(kind(value))]


def test_a_channel_that_seldom_turns_back_has_no_noise_that_tells_a_stale_row() -> None:
    """White noise turns back in two changes of three; what keeps on its way says nothing about a row that repeats."""

    def found(turns: float) -> bool:
        draw = np.random.default_rng(11)
        columns = []
        for _ in range(5):
            way = np.cumsum(draw.random(4000) < turns) % 2 * 2 - 1
            columns.append(np.cumsum(way * draw.uniform(0.5, 1.5, 4000)))
        for v in columns:
            v[1500:] = np.r_[v[1499], v[1500:-1]]  # row 1,500 repeats the one before
        return bool(stale_rows(columns).any())

    assert found(0.33) and not found(0.27)


def test_how_often_a_channel_repeats_itself_is_that_of_the_rows_around() -> None:
    """At rest each channel repeats every second row, in steps of its last digit; later it moves, and a row is stale."""
    draw = np.random.default_rng(3)
    rest = [draw.integers(0, 2, 3000).astype(float) for _ in range(4)]
    moves = [draw.standard_normal(2000) for _ in range(4)]
    columns = [np.r_[a, b] for a, b in zip(rest, moves, strict=True)]
    for v in columns:
        v[4000] = v[3999]
    alike = np.flatnonzero(np.all([v[1:] == v[:-1] for v in columns], axis=0)) + 1
    assert alike.size > 100 and np.flatnonzero(stale_rows(columns)).tolist() == [4000]


def test_what_is_made_of_a_rate_is_interpolated() -> None:
    t, fine = np.arange(5.0), 0.5 * np.arange(9)
    channels = {"x": SimpleNamespace(t=t, values=np.array([0.0, 2.0, 8.0, 18.0, 32.0]), unit=""),
                "f": SimpleNamespace(t=fine, values=np.full(9, 0.25), unit="")}  # fmt: skip
    for name, want in (("rate(x)", [2.0, 3.0, 4.0]), ("integral(x)", [0.0, 0.5, 1.0])):
        assert formula_of(f"{name} + 0 * f").made(channels).values[:3].tolist() == want, name


# ---- formats of other packages ---------------------------------------------------------------------------------------


def test_a_file_is_looked_at_before_the_reader_of_another_package_is(tmp_path: Path) -> None:
    called: list[Any] = []

    def reader(path: Path, *given: Any) -> Any:
        called.append(path)
        raise RuntimeError("of its own")

    rig = Format("Rig", (".rig",), source=reader, channels=reader, extra="mdf")
    entry = SimpleNamespace(dist=SimpleNamespace(name="rig"), value="rig:RIG", load=lambda: rig)
    of = formats._loaded("a.rig", ".rig", entry)  # type: ignore[arg-type]
    assert of.extra == ""  # its package is there
    options = Options(None, {})
    for path, said in ((made(tmp_path, "", "e.rig"), "is empty"), (tmp_path, "is a folder, not a log"),
                       (tmp_path / "none.rig", "cannot be read")):  # fmt: skip
        with pytest.raises(LogError, match=said):
            of.open(path, options)
    assert called == []
    whole = made(tmp_path, "x", "a.rig")
    whose = r"^a.rig: .rig is a format of package rig \(rig:RIG\), which fails at it \(RuntimeError: of its own\)$"
    with pytest.raises(LogError, match=whose):
        of.open(whole, options)
    with pytest.raises(LogError, match=whose):
        of.write(tmp_path / "new.rig", {}, None)  # what is written need not be there
    assert called == [whole, tmp_path / "new.rig"]


@pytest.mark.parametrize(("made_of", "said"), [
    (3, "which is int, not hil.logs.Format"), (Format("Rig", ()), "whose suffixes are none"),
    (Format("Rig", (".rag", ".rog")), "whose suffixes are .rag, .rog"),
])  # fmt: skip
def test_what_another_package_offers_as_a_format_must_be_one(made_of: Any, said: str) -> None:
    entry = SimpleNamespace(dist=None, value="rig:RIG", load=lambda: made_of)
    with pytest.raises(LogError) as caught:
        formats._loaded("a.rig", ".rig", entry)  # type: ignore[arg-type]
    assert str(caught.value) == f"a.rig: .rig is a format of a package (rig:RIG), {said}"


def test_a_source_of_another_package_has_all_that_one_needs() -> None:
    whole = SimpleNamespace(kind="channel", names={}, notes=[], sorted=True, series=lambda k: 1 / 0, has=lambda: "",
                            absent=lambda n: "")  # fmt: skip
    assert formats._clear_source(whole, "whose") is whole and whole.has() == ""
    with pytest.raises(LogError, match=r"^whose, which fails at it \(ZeroDivisionError: division by zero\)$"):
        whole.series("a")
    for name in ("kind", "names", "notes", "sorted", "series", "has", "absent"):
        some = SimpleNamespace(**{k: v for k, v in vars(whole).items() if k != name})
        with pytest.raises(LogError, match=rf"opens it as SimpleNamespace: that is no Source, it has no {name}$"):
            formats._clear_source(some, "whose")


# ---- frames of pandas ------------------------------------------------------------------------------------------------


def frame(columns: dict[str, Any], index: Any = None, **attrs: Any) -> Any:
    made = pd.DataFrame(columns, index=index)
    made.attrs = attrs
    return made


def taken(of: Any, **options: Any) -> tuple[list[float], list[float]]:
    log = read_log(of, **{"require": ()} | options)
    return log["n_dem"].t.tolist(), log["n_dem"].values.tolist()


def test_the_time_of_a_frame_is_the_one_that_somebody_says() -> None:
    speed = [50.0, 51.0, 52.0]
    seconds = pd.Index([0.0, 0.5, 1.0])
    for of, t in (
        (frame({"n_dem": speed}, seconds), [0.0, 0.5, 1.0]),  # numbers without a name
        (frame({"n_dem": speed, "time": [4.0, 5.0, 6.0]}, seconds), [4.0, 5.0, 6.0]),  # a column says it
        (frame({"n_dem": speed, "time": [4.0, 5.0, 6.0]}, seconds.rename("clock")), [0.0, 0.5, 1.0]),
        (frame({"n_dem": speed, "t": [4.0, 5.0, 6.0]}, seconds.rename("t")), [4.0, 5.0, 6.0]),
        (frame({"n_dem": speed, "time": [4.0, 5.0, 6.0]}), [4.0, 5.0, 6.0]),  # whose index only counts
        (frame({"n_dem": speed}, pd.RangeIndex(3, name="t")), [0.0, 1.0, 2.0]),
        (frame({"n_dem": speed, "time": [4.0, 5.0, 6.0]}, pd.Index(["a", "b", "c"])), [4.0, 5.0, 6.0]),
    ):
        assert taken(of) == (t, speed)
    asked = frame({"n_dem": speed, "time": [4.0, 5.0, 6.0], "mine": [7.0, 8.0, 9.0]}, seconds.rename("clock"))
    assert taken(asked, mapping={"mine": "t"})[0] == [7.0, 8.0, 9.0]
    assert taken(asked, mapping={"clock": "t"})[0] == [0.0, 0.5, 1.0]
    assert taken(asked, mapping={"mine": "n_r"})[0] == [0.0, 0.5, 1.0]  # what is mapped to another signal is no time
    with pytest.raises(LogError, match="no time column"):
        taken(frame({"n_dem": speed}))
    with pytest.raises(LogError, match="no column 'other' to map to t"):
        taken(asked, mapping={"other": "t"})


def test_rows_without_a_time_are_in_no_order() -> None:
    speed = [50.0, 52.0, 51.0]
    for index in (None, pd.Index([3.0, 1.0, 2.0])):
        log = read_log(frame({"n_dem": speed}, index), require=(), rows=True)
        assert not log.ordered and log["n_dem"].t.tolist() == [0.0, 0.01, 0.02]
        assert log.notes == ["no time column: rows in no order"] and log["n_dem"].values.tolist() == speed
    rising = read_log(frame({"n_dem": speed}, pd.Index([1.0, 2.0, 3.0])), require=(), rows=True)
    assert rising.ordered and rising["n_dem"].t.tolist() == [1.0, 2.0, 3.0]


def test_a_frame_that_is_no_table_of_one_time_is_refused() -> None:
    two = pd.DataFrame([[0.0, 1.0]], columns=pd.MultiIndex.from_tuples([("a", "t"), ("a", "n_dem")]))
    levels = pd.DataFrame({"n_dem": [1.0]}, index=pd.MultiIndex.from_tuples([(0, 1)]))
    for of in (two, levels):
        with pytest.raises(LogError, match="^DataFrame: its columns or rows have several levels; allowed: one"):
            taken(of)
    with pytest.raises(LogError, match="^run: has no row$"):
        taken(frame({"t": [], "n_dem": []}, name="run"))
    with pytest.raises(LogError, match="^run: column 'a' is there more than once$"):
        taken(pd.DataFrame([[0.0, 1.0, 2.0]], columns=["t", "a", "a"]), name="run")
    with pytest.raises(LogError, match="column 'n_dem' holds object, not numbers"):
        taken(frame({"t": [0.0, 1.0], "n_dem": ["x", 2.0]}))


def test_a_cell_that_is_missing_has_no_sample_and_dates_count_from_the_first() -> None:
    gaps = frame({"t": [0.0, 1.0, 2.0], "n_dem": [50.0, np.nan, 52.0]})
    assert taken(gaps) == ([0.0, 2.0], [50.0, 52.0]) and read_log(gaps, require=()).notes == []
    when = [pd.NaT, *pd.to_datetime(["2026-03-14 10:00", "2026-03-14 10:01"])]
    t, speed = taken(frame({"n_dem": [50.0, 51.0, 52.0], "time": when}))
    assert t == pytest.approx([0.0, 60.0]) and speed == [51.0, 52.0]
    spans = frame({"n_dem": [50.0, 51.0], "time": pd.to_timedelta(["00:00:05", "00:00:06"])}, units={"time": "ms"})
    assert taken(spans) == ([5.0, 6.0], [50.0, 51.0])  # a duration is in s, whatever is said of it
    framed = read_log(frame({"t": [0.0, 1.0], "n_dem": [1.0, 2.0], "n_r": [1.0, 2.0]}, framed=["n_r"]), require=())
    assert (framed["n_dem"].framed, framed["n_r"].framed) == (False, True)


# ---- limits, each on both sides --------------------------------------------------------------------------------------


def test_a_header_ends_within_the_first_quarter_of_a_mebibyte(tmp_path: Path) -> None:
    rows = "t;n_dem\n0;50\n1;51\n"
    assert layout._MOST_BYTES == 1 << 18
    for more, fine in ((0, True), (1, False)):
        file = made(tmp_path, ("x" * 65_535 + "\n") * 3 + "x" * (65_527 + more) + "\n" + rows)
        if fine:
            assert read(file)["n_dem"].values.tolist() == [50.0, 51.0]
        else:
            with pytest.raises(LogError):
                read(file)


def test_digits_behind_a_microsecond_are_cut_off(tmp_path: Path) -> None:
    stamps = ["10:00:00.1234567", "10:00:00.123457999", "10:00:01", "10:00:01.5"]
    log = read(made(tmp_path, "t,n_dem\n" + "".join(f"{s},50\n" for s in stamps)))
    assert log["n_dem"].t.tolist() == pytest.approx([0.0, 1e-6, 0.876544, 1.376544], abs=1e-9)


def test_a_pipe_of_frames_holds_a_mebibyte() -> None:
    out, into = os.pipe()
    try:
        recorder._enlarge(into)
        size = fcntl.fcntl(into, fcntl.F_GETPIPE_SZ)
        most = int(Path("/proc/sys/fs/pipe-max-size").read_text())
        assert size == (1 << 20) or (most < 1 << 20 and os.getuid() != 0)
    finally:
        os.close(out)
        os.close(into)


def test_a_stroke_moves_from_a_millimetre_a_second_on() -> None:
    t = 0.01 * np.arange(3000)
    for fastest, found in ((0.97, None), (1.2, ("40*mA", "the rate of x_lvdt"))):
        x = 24.0 + fastest / 0.6 * np.sin(0.6 * t)
        v = (np.interp(t + 0.1, t, x) - np.interp(t - 0.1, t, x)) / 0.2
        i = feed_forward({}) * v + 0.4 * np.sign(v)
        assert proposed_scale("i_cmd", (t, i / 40.0), {"x_lvdt": (t, x)}, {}) == found
    at = np.array([0.0, 0.09, 0.3, 0.42])  # a tenth of a second on either side
    assert _mean_over(at, np.array([1.0, 3.0, 5.0, 7.0])) == pytest.approx([2.0, 2.0, 5.0, 7.0])


def test_the_last_digit_of_small_numbers_is_that_of_their_size() -> None:
    tiny = 1e-6 * np.pi * np.arange(1.0, 3.0)
    assert _last_digit(tiny) == pytest.approx([2e-15 * np.pi])
    assert _last_digit(np.array([0.25e-6, 0.5e-6])) == pytest.approx([1e-8]) or _last_digit(tiny).size == 1


@pytest.mark.parametrize("top", [76.0, 110.0])
def test_the_design_speed_may_be_far_from_the_largest_speed(top: float) -> None:
    """Of a run up to 76 % it is 1.3 times its largest speed, of one up to 110 % nine tenths."""
    at, curve = mean_stroke({})
    t = np.linspace(0.0, 100.0, 4000)
    speed = top * (0.75 + 0.25 * np.sin(0.3 * t))
    found, why = design_speed((t, 90.0 * speed), (t, np.interp(speed, at, curve)))
    assert found == pytest.approx(9000.0, rel=0.02) and why.startswith("the stroke follows the schedule best with ")


def test_no_mode_and_no_side_is_ever_guessed() -> None:
    rows = np.r_[np.arange(30.0) % 4]
    source = Samples({n: Series(np.arange(30.0), 20.0 + rows, "mm") for n in ("X-LVDT-A", "State", "x lvdt b")})
    found = guess(source, ("state", *SIDES, "load"), set(), {}, None)
    assert found.made == {} and found.open == {}


# ---- a recorder in a process of its own ------------------------------------------------------------------------------


def test_the_recorder_s_process_appends_in_every_turn_also_where_nothing_came(monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[str] = []
    parts = [b"x" * FRAME.itemsize, b"", b"y" * FRAME.itemsize]
    fake = SimpleNamespace(kept=None, frames=2, put=lambda f: done.append(f"put {len(f) // FRAME.itemsize}"),
                           poll=lambda: done.append("poll"), close=lambda: done.append("close"))  # fmt: skip
    monkeypatch.setattr(recorder, "Recorder", lambda path, channel: fake)
    monkeypatch.setattr("signal.signal", lambda *a: None)
    ready = iter([True, False, True, True])
    monkeypatch.setattr(recorder, "select", SimpleNamespace(select=lambda *a: ([0] if next(ready) else [], [], [])))
    monkeypatch.setattr(os, "read", lambda fd, n: parts.pop(0) or parts.pop(0) if parts else b"")
    monkeypatch.setattr(os, "write", lambda fd, data: len(data))
    assert recorder.serve("a.log", "vcan0") == 0
    assert done == ["put 1", "poll", "poll", "put 1", "poll", "close"]


def test_every_column_of_a_recording_can_be_read_after_every_append(tmp_path: Path) -> None:
    """Before it is closed, too, as a killed recorder leaves it: to the last byte of the last column."""
    to = ParquetRecord(tmp_path / "a.parquet", "")
    m = to.messages[-1]
    name = [s.name for s in m.layout.signals if s.name in to.signals][-1]
    values = np.round(np.random.default_rng(1).uniform(1.0, 9.0, 40), 1)
    given = np.zeros(40, FRAME)
    given["ns"], given["ident"], given["length"] = 10**9 * np.arange(1, 41), m.ident, m.layout.length
    given["data"][:, : m.layout.length] = encode(m, {name: values}, 40)
    for k in range(0, 40, 4):
        to.append(given[k : k + 4])
        table = pq.ParquetFile(tmp_path / "a.parquet").read()
        assert table.column_names[-1] == to.signals[-1] and table.num_rows == k + 4
        assert table[name].to_pylist() == pytest.approx(values[: k + 4].tolist(), abs=0.06)
        raw = (tmp_path / "a.parquet").read_bytes()
        assert raw[-4:] == b"PAR1" and int.from_bytes(raw[-8:-4], "little") < len(raw)
    to.close()


# ---- a signal in several messages ------------------------------------------------------------------------------------


def test_a_signal_of_several_messages_is_needed_or_left_out_by_name(tmp_path: Path) -> None:
    dbc = made(tmp_path, "".join(
        f'BO_ {256 + k} {n}: 8 X\n SG_ n_dem : 0|8@1+ (1,0) [0|0] "%" X\n SG_ {n}_x : 8|8@1+ (1,0) [0|0] "" X\n\n'
        for k, n in enumerate("ABC")), "x.dbc")  # fmt: skip

    def of(c: int, b: int = 0) -> Path:
        lines = [f"(1.{k:02}) can0 10{m}#{50 + k * (m == 0 or (m == 1 and b) or (m == 2 and c)):02X}00000000000000"
                 for k in range(4) for m in range(3)]  # fmt: skip
        return made(tmp_path, "\n".join(lines) + "\n", "a.log")

    one = read(of(0), dbc=dbc)
    assert one["n_dem"].values.tolist() == [50.0, 51.0, 52.0, 53.0]
    assert one.notes == ["n_dem: took A.n_dem; B.n_dem, C.n_dem never changes"]
    several = read(of(1), dbc=dbc)
    said = "n_dem: may be A.n_dem or B.n_dem or C.n_dem: left out (--map A.n_dem=n_dem takes one)"
    assert list(several.channels) == [] and several.notes == [said]
    with pytest.raises(LogError, match=r"n_dem may be A.n_dem or B.n_dem or C.n_dem; name one: --map A.n_dem=n_dem"):
        read(of(1), dbc=dbc, require=("n_dem",))
    assert read(of(1), dbc=dbc, mapping={"C.n_dem": "n_dem"})["n_dem"].values.tolist() == [50.0, 51.0, 52.0, 53.0]


# ---- what is made of times -------------------------------------------------------------------------------------------


def test_rows_of_a_parquet_log_count_from_one(tmp_path: Path) -> None:
    stamps = [f"2026-10-25 02:5{k}:00" for k in range(7, 10)] + [f"2026-10-25 02:0{k}:00" for k in range(3)]
    pq.write_table(pa.table({"t": stamps, "n_dem": [50.0] * 6}), tmp_path / "a.parquet")
    (_, back) = read(tmp_path / "a.parquet").notes
    assert str(back).startswith("time: falls back by an hour at row 4, at the end of") and back.rows == (4,)
    pq.write_table(pa.table({"t": [0.0, 1.0, 2.0], "n_dem": [50.0, np.nan, 51.0]}), tmp_path / "a.parquet")
    (note,) = read(tmp_path / "a.parquet").notes
    assert note.rows == (2,)


@pytest.mark.parametrize(("step", "unit"), [
    (0.02, "ms"), (10.0, "ms"), (300.0, "ms"), (332.0, "us"), (3e5, "us"), (3.3e5, "ns"), (1e9, "ns"), (0.0, "ms"),
])  # fmt: skip
def test_the_unit_of_a_time_brings_its_rows_nearest_to_a_hundredth_of_a_second(step: float, unit: str) -> None:
    assert plausible.unit_of_time(step * np.arange(9.0)) == unit
    assert plausible.unit_of_time(np.r_[0.0, 0.0, step * np.arange(9.0)]) == unit  # rows of one time tell nothing
    assert plausible.unit_of_time(np.array([5.0])) == "ms"


def test_a_sketch_has_whole_samples_in_the_order_of_time(tmp_path: Path) -> None:
    rows = "3,53,1\n1,51,nan\n,52,3\n2,nan,2\n2,62,4\n0,50,5\n"
    opened = open_log(made(tmp_path, "t,n_dem,foo\n" + rows), None, None, None, None, UNITS, True, None, {})
    seen = sketch(tmp_path, opened, UNITS)
    assert list(seen) == ["n_dem"]
    assert seen["n_dem"][0].tolist() == [0.0, 1.0, 2.0, 3.0] and seen["n_dem"][1].tolist() == [50.0, 51.0, 62.0, 53.0]


def test_a_word_of_six_letters_may_be_misspelt_and_one_of_five_not() -> None:
    for name, signal, sure in (("servo curent cmd", "i_cmd", 0.88), ("servo strum cmd", None, 0.0)):
        found = meaning(name, tuple(UNITS))
        assert (found.signal if found and found.confidence > 0.5 else None) == signal, name
        assert signal is None or found.confidence == pytest.approx(sure)  # type: ignore[union-attr]


# ---- traces of tools -------------------------------------------------------------------------------------------------


def test_buses_beyond_the_layouts_of_a_length_stay_apart(tmp_path: Path) -> None:
    frames = read_candump(made(tmp_path, "".join(f"(1.5) c{k:02} 123#AB\n" for k in range(40)), "a.log"))
    assert sorted(frames.bus.tolist()) == list(range(40)) and frames.t.tolist() == [0.0] * 40


def test_a_line_whose_data_are_no_base64_is_none(tmp_path: Path) -> None:
    head = "timestamp,arbitration_id,extended,remote,error,dlc,data\n0.5,0x122,0,0,0,2,dGo=\n"
    frames = read_csv_frames(made(tmp_path, head + "0.6,0x122,0,0,0,2,d!Go=\n0.7,0x122,0,0,0,2,dGo\n", "a.csv"))
    assert frames.t.tolist() == [0.0] and list(frames.notes) == ["2 lines are not python-can lines: left out"]


def test_remote_frames_of_every_layout_are_counted(tmp_path: Path) -> None:
    rows = "11:49:12:9420 Rx 1 0x023 s 2 40 00\n11:49:12:9430 Rx 1 0x023 sr 0\n11:49:12:9440 Rx 1 0x023 sr 0\n"
    rows += "11:49:12:9450 Rx 1 0x12345678 xr 0\n"
    frames = read_busmaster(made(tmp_path, "***BUSMASTER Ver 3.2***\n***HEX***\n" + rows, "a.log"))
    assert frames.ident.tolist() == [0x23] and list(frames.notes) == ["3 remote or error frames: left out"]


@pytest.mark.parametrize(("others", "extended"), [("00000456", False), ("456", True)])
def test_an_identifier_of_eight_digits_is_long_beside_shorter_ones(tmp_path: Path, others: str, extended: bool) -> None:
    """Without a word that says so; where all have eight digits they are padded."""
    rows = f"00.250 00000123 1 BE\n00.260 {others} 1 BE\n00.270 18EA0003 1 BE\n"
    frames = read_canhacker(made(tmp_path, "Time   ID     DLC Data                    Comment\n" + rows, "a.trc"))
    assert frames.ident.tolist() == [0x123 | EXTENDED * extended, 0x456, EXTENDED | 0x18EA0003]


def test_a_survey_is_certain_of_a_time_that_is_called_so(tmp_path: Path) -> None:
    (time, speed) = survey(made(tmp_path, "t,n_dem\n0,50\n1,51\n")).rows
    assert (time.confidence, time.how, time.unit, speed.confidence) == (1.0, "named", "s", 1.0)
    given = survey(made(tmp_path, "clock,n_dem\n0,50\n1,51\n"), mapping={"clock": "t"}, units={"t": "min"}).rows[0]
    assert (given.confidence, given.how, given.unit, given.name) == (1.0, "stated", "min", "clock")


# ---- requests to the reader of MDF -----------------------------------------------------------------------------------


def answered(request: dict[str, Any]) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """What the process that opens an MDF file answers, and its arrays, taken apart as its caller does."""
    out = io.BytesIO()
    mdf_child.answer(json.dumps(request).encode(), out)
    line, _, body = out.getvalue().partition(b"\n")
    reply, arrays, at = json.loads(line), {}, 0
    for name, kind, shape in reply.pop("arrays"):
        arrays[name] = np.frombuffer(body, kind, int(np.prod(shape)), at).reshape(shape)
        at += arrays[name].nbytes
    assert at == len(body)
    return reply, arrays


@pytest.fixture
def no_limits(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> dict[str, Any]:
    monkeypatch.setattr("resource.setrlimit", lambda *a: None)
    return {"path": str(made(tmp_path, "x", "a.mf4")), "seconds": 20}


def test_the_reader_of_mdf_hands_on_frames_and_recordings(
    no_limits: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    found = {mdf_child.RECORDING: lambda p: (np.arange(3), np.arange(6).reshape(3, 2), np.array([True, False, True])),
             mdf_child.OTHERS: lambda p: {"t": np.arange(2.0), "data": np.zeros((2, 64), np.uint8)}}  # fmt: skip
    monkeypatch.setattr("pkgutil.resolve_name", found.__getitem__)
    reply, arrays = answered(no_limits | {"record": True})
    assert reply == {} and arrays["us"].tolist() == [0, 1, 2] and arrays["rows"].tolist() == [[0, 1], [2, 3], [4, 5]]
    assert arrays["sent"].tolist() == [True, False, True] and list(arrays) == ["us", "rows", "sent"]
    reply, arrays = answered(no_limits | {"frames": True})
    assert reply == {} and arrays["t"].tolist() == [0.0, 1.0] and arrays["data"].shape == (2, 64)


def test_the_reader_of_mdf_hands_on_channels_and_what_is_wrong_in_one_line(
    no_limits: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    class Other(Opened):
        def __init__(self, path: str):
            super().__init__((0, 1), (0, 1))

        def __enter__(self) -> Other:
            return self

        def __exit__(self, *a: object) -> None:
            pass

        def get(self, group: int, index: int, raw: bool = False) -> Any:
            return SimpleNamespace(
                samples=np.array([group, index], np.int16), timestamps=np.array([0.5, 1.5], np.float32)
            )

    monkeypatch.setattr(mdf_child.asammdf, "MDF", Other)
    reply, arrays = answered(no_limits | {"channels": ["n1", "n0"]})
    assert reply == {} and {k: v.tolist() for k, v in arrays.items()} == {
        "t0": [0.5, 1.5], "v0": [1.0, 1.0], "t1": [0.5, 1.5], "v1": [0.0, 1.0]
    }  # fmt: skip
    assert {a.dtype for a in arrays.values()} == {np.dtype("f8")}

    def fails(path: str) -> None:
        raise ValueError("a  line\nand another " + "x" * 300)

    monkeypatch.setattr(mdf_child.asammdf, "MDF", fails)
    reply, arrays = answered(no_limits | {"channels": ["n1"]})
    assert arrays == {} and reply["error"] == ("ValueError: a line and another " + "x" * 300)[:160]


# ---- a frame taken as it is ------------------------------------------------------------------------------------------


def test_a_frame_of_any_system_keeps_what_it_states() -> None:
    of = frame({"t": [0.0, 0.1], "x_lvdt": [20e3, 21e3], "pump (bar)": [1.0, 2.0], "q": [3.0, 4.0], "who": ["a", "b"]},
               units={"q": "l/min", "x_lvdt": "um"}, name="bench")  # fmt: skip
    log = Log.from_dataframe(of)
    assert log.units == {"x_lvdt": "mm", "pump": "bar", "q": "l/min"} and log["x_lvdt"].values.tolist() == [20.0, 21.0]
    assert log.path == "bench" and log.notes == [] and log["pump"].values.tolist() == [1.0, 2.0]
    given = Log.from_dataframe(of, units={"q": "m3/h", "pump": "psi"}, mapping={"q": "flow"}, name="other")
    assert given.units == {"x_lvdt": "mm", "pump": "psi", "flow": "m3/h"} and given.path == "other"
    stated = Log.from_dataframe(of, units={"x_lvdt": "1e-4*cm"})  # goes before what the frame says
    assert stated["x_lvdt"].values == pytest.approx([20.0, 21.0]) and stated.units["x_lvdt"] == "mm"


@pytest.mark.parametrize(("options", "said"), [
    ({"units": {"qq": "V"}}, "bench: unit of 'qq': is no column of numbers (did you mean q?)"),
    ({"units": {"who": "V"}}, "bench: unit of 'who': is no column of numbers"),
    ({"mapping": {"who": "name"}}, "bench: mapping of 'who': is no column of numbers"),
    ({"mapping": {"none": "t", "no": "x"}}, "bench: mapping of 'no': is no column of numbers"),
])  # fmt: skip
def test_what_is_said_of_no_column_is_refused(options: dict[str, Any], said: str) -> None:
    of = frame({"t": [0.0, 0.1], "q": [3.0, 4.0], "who": ["a", "b"]}, name="bench")
    with pytest.raises(LogError) as caught:
        Log.from_dataframe(of, **options)
    assert str(caught.value).startswith(said)
    with pytest.raises(LogError, match=r"^from_dataframe: list is given; allowed: a pandas.DataFrame$"):
        Log.from_dataframe([1.0])  # type: ignore[arg-type]


# ---- more of samples that were joined --------------------------------------------------------------------------------


def test_true_samples_are_found_where_rows_are_lost(seed: int = 5) -> None:
    """Beside a lost row a line bends wherever it is: such corners say nothing."""
    draw = np.random.default_rng(seed)
    n = 6000
    at = 3 + 5 * np.arange(-1, n // 5 + 2)
    values = np.interp(np.arange(n), at, draw.standard_normal(at.size))
    kept = np.flatnonzero(draw.random(n) > 0.06)
    assert joined(0.02 * kept, values[kept]) == Joined(5, (3 - kept[0]) % 5, True)


def test_a_log_too_long_for_a_bus_is_refused(tmp_path: Path) -> None:
    """20 million frames of a message: 55 hours at one each 10 ms."""
    t = np.array([0.0, 200_000.02])
    with pytest.raises(LogError, match=r"2e\+05 s are too long for a CAN log with a frame every 0.01 s$"):
        encode_channels({"n_dem": Channel(t, np.array([50.0, 51.0]))}, None, Path("a.log"))


def test_fifty_samples_of_a_stroke_tell_the_scale_of_a_current() -> None:
    t = 0.01 * np.arange(1500)
    for many, found in ((50, ("40*mA", "the rate of x_lvdt")), (49, None)):
        at = np.linspace(0.0, 14.99, many)
        x = 24.0 + 12.0 * np.sin(0.6 * at)
        v = (np.interp(t + 0.1, at, x) - np.interp(t - 0.1, at, x)) / 0.2
        i = feed_forward({}) * v + 0.4 * np.sign(v)
        assert proposed_scale("i_cmd", (t, i / 40.0), {"x_lvdt": (at, x)}, {}) == found


def test_the_time_of_labview_is_known_by_its_name() -> None:
    assert is_time("X_Value") == is_time(" x_value ") == (0.9, "") and is_time("X_Values") == (0.0, "")


# ---- what a name says of a unit --------------------------------------------------------------------------------------


@pytest.mark.parametrize(("signal", "name", "own", "unit"), [
    ("x_dem", "stroke_m", "mm", ""), ("x_dem", "stroke_cm", "mm", "cm"), ("x_dem", "stroke_mm", "mm", ""),
    ("x_dem", "stroke [inch]", "mm", "inch"),
    ("x_dem", "stroke", "mm", ""), ("x_dem", "stroke_bar", "mm", ""), ("n_dem", "N1_rpm", "%", "rpm"),
    ("n_r", "N1_Hz", "%", "Hz"), ("n_dem", "N1_pct", "%", ""), ("load", "N1_rpm", "%", ""),
    ("vgv1", "vane_rad", "deg", "rad"),
    ("vgv1", "vane_deg", "deg", ""), ("share", "share_deg", "%", ""), ("share", "share_rad", "-", ""),
    ("t", "clock_ms", "s", "ms"), ("t", "clock_s", "s", ""), ("t_oil", "oil_degF", "degC", "degF"),
    ("t_oil", "oil_degC", "degC", ""), ("p_s", "supply_psi", "MPa", "psi"),
])  # fmt: skip
def test_a_name_says_a_unit_of_its_quantity_that_is_another_one(signal: str, name: str, own: str, unit: str) -> None:
    assert opening._said(signal, name, own) == unit


def test_the_unit_of_a_mapped_name_is_taken_where_the_file_says_none(tmp_path: Path) -> None:
    rows, ten = "0,1,1\n1000,1.5,2\n2000,2,3\n", [10.0, 15.0, 20.0]
    for header, options, values, t, said in (
        ("clock_ms,stroke_cm", {}, ten, [0.0, 1.0, 2.0], ["taken in cm, as its name", "taken in ms, as"]),
        ("clock_ms [s],stroke_cm [mm]", {}, [1.0, 1.5, 2.0], [0.0, 1000.0, 2000.0], []),
        ("clock_ms [ms],stroke_cm [-]", {}, ten, [0.0, 1.0, 2.0], ["taken in cm, as its name"]),
        ("clock_ms,stroke_cm", {"units": {"t": "s"}}, ten, [0.0, 1000.0, 2000.0], ["taken in cm"]),
        ("clock_ms,stroke_cm", {"guess": False}, [1.0, 1.5, 2.0], [0.0, 1000.0, 2000.0],
         ["taken in mm, though its name says cm", "taken in s, though its name says ms"]),
    ):  # fmt: skip
        keys = header.split(",")
        log = read(made(tmp_path, f"{header},other\n{rows}"), mapping={keys[0]: "t", keys[1]: "x_dem"}, **options)
        assert log["x_dem"].values == pytest.approx(values) and log["x_dem"].t == pytest.approx(t), header
        told = [str(n) for n in log.notes]
        assert len(told) == len(said) and all(s in n for s, n in zip(said, told, strict=True)), (header, told)
        kinds = {n.kind for n in log.notes}
        assert kinds <= ({"guessed"} if options.get("guess") is False else {"converted"})


def test_a_user_s_own_speed_takes_no_design_speed(tmp_path: Path) -> None:
    log = read(made(tmp_path, "t,wheel_rpm\n0,100\n1,200\n"), mapping={"wheel_rpm": "wheel"}, signals={"wheel": "Hz"})
    assert log["wheel"].values == pytest.approx([100 / 60, 200 / 60]) and log.units == {"wheel": "Hz"}


def test_other_options_of_a_table_are_of_tables_alone(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"a.log: part 1: only tables have parts$"):
        read(made(tmp_path, "(1.0) can0 123#00\n", "a.log"), part=1)


def test_what_a_mapping_file_states_is_taken_where_nothing_beside_it_does(tmp_path: Path) -> None:
    (tmp_path / "m.toml").write_text('design_rpm = 5000\n[names]\nn_dem = "A"\nt = "clock"\n[units]\nn_dem = "rpm"\n')
    file = made(tmp_path, "clock,A,B\n0,2500,1000\n1,5000,2000\n")
    both = {"mapping_file": tmp_path / "m.toml"}
    assert read(file, **both)["n_dem"].values.tolist() == [50.0, 100.0]
    assert read(file, **both, design_rpm=10_000.0)["n_dem"].values.tolist() == [25.0, 50.0]
    assert read(file, **both, mapping={"B": "n_dem"})["n_dem"].values.tolist() == [20.0, 40.0]
    assert read(file, **both, units={"n_dem": "0.01*%"})["n_dem"].values.tolist() == [25.0, 50.0]
    (tmp_path / "g.toml").write_text('[names]\nt = "clock"\n')
    assert read(made(tmp_path, "clock,speed_cmd_pct\n0,50\n1,51\n"), mapping_file=tmp_path / "g.toml").channels == {}


@pytest.mark.parametrize(("unit", "said"), [
    ("0*%", "--unit n_dem=0*%: its gain is 0; allowed: any other number"), ("1e-9*%", ""), ("-%", ""), ("%+0", ""),
    ("2*bar", "--unit n_dem=2*bar: unit does not convert; allowed: %, rpm, Hz or rad/s"),
])  # fmt: skip
def test_a_gain_of_nothing_is_refused(tmp_path: Path, unit: str, said: str) -> None:
    file = made(tmp_path, "t,n_dem\n0,5\n1,6\n")
    if not said:
        assert list(read(file, units={"n_dem": unit}).channels) == ["n_dem"]
        return
    with pytest.raises(LogError) as caught:
        read(file, units={"n_dem": unit})
    assert str(caught.value) == f"{file}: {said}"


# ---- what a bus carries ----------------------------------------------------------------------------------------------


def test_authentication_frames_are_counted_where_they_prove_nothing(tmp_path: Path) -> None:
    """Of a database that says which messages carry the MAC of another."""
    t = np.arange(20) * 0.01
    write_log(tmp_path / "a.log", {"n_dem": Channel(t, 60.0 + t)})
    plain = read(tmp_path / "a.log")
    assert plain.notes == [] and plain["n_dem"].t.size == 20
    proves = [m for m in load_dbc(table_path("vgv.dbc"))[0] if m.proves]
    assert proves
    name = f"{proves[0].ident & 0x1FFFFFFF:03X}"
    lines = (tmp_path / "a.log").read_text() + f"(0000000000.300000) vcan0 {name}#0011223344556677\n" * 3
    log = read(made(tmp_path, lines, "b.log"))
    assert sum(n.startswith("3 authentication frames (SecOC) in the log: no MAC is checked; ") for n in log.notes) == 1


def test_a_bus_that_no_message_of_the_database_is_on_says_its_identifiers(tmp_path: Path) -> None:
    lines = "".join(f"(1.{k:02}) can0 {0x500 + k % 9:03X}#00\n" for k in range(20))
    with pytest.raises(LogError) as caught:
        read(made(tmp_path, lines, "a.log"), require=("n_dem",))
    most = "0x500, 0x501, 0x502, 0x503, 0x504, 0x505, 0x506, 0x507, ..."
    assert f"vgv.dbc has no message for the log's 9 identifiers ({most}): --dbc F" in str(caught.value)
    with pytest.raises(LogError, match=r"vgv.dbc has it in ECU_\w+ \(0x0?[0-9A-F]+\), but the log has no such frame"):
        t = np.arange(20) * 0.01
        write_log(tmp_path / "b.log", {"x_lvdt": Channel(t, 20.0 + t)})
        read(tmp_path / "b.log", require=("n_dem",))


# ---- a day beside a time of day, and guesses that are withdrawn ------------------------------------------------------


def times(file: Path, **options: Any) -> list[float]:
    return read(file, **options)["n_dem"].t.tolist()  # type: ignore[no-any-return]


def test_the_day_beside_a_time_of_day_is_taken_with_it(tmp_path: Path) -> None:
    def of(head: str, *rows: str) -> Path:
        return made(tmp_path, f"{head};n_dem\n" + "".join(f"{r};{50 + k}\n" for k, r in enumerate(rows)))

    two_days = ("2026-03-14;23:59:59", "2026-03-15;00:00:01", "2026-03-15;02:00:01")
    for head in ("Datum;Uhrzeit", "Date;time", "Tag;Zeit", "a;time"):
        assert times(of(head, *two_days)) == [0.0, 2.0, 7_202.0], head
    late = of("Datum;Zeit", "2026-03-14;10:00:00", "2026-03-15;10:00:01", "2026-03-17;09:00:00")
    column = format_of(late).open(late, Options(None, {})).series("n_dem").t
    assert column.tolist() == [0.0, 86_401.0, 255_600.0]  # days that no clock shows
    midnight = ("14.03.2026 00:00;23:59:59", "15.03.2026 0:00:00;00:00:01", "15.03.2026 00:00:00,000;00:00:02")
    assert times(of("Datum;Uhrzeit", *midnight)) == [0.0, 2.0, 3.0]  # as table programs write a day
    lacking = ("2026-03-14;23:59:59", ";00:00:01", "2026-03-15;", "2026-03-15;00:00:03")
    assert times(of("Datum;Uhrzeit", *lacking)) == [0.0, 4.0]
    two = ("2026-03-14;2020-01-01;23:59:59", "2026-03-15;2020-01-01;00:00:01")
    assert times(of("Datum;built;Zeit", *two)) == [0.0, 2.0]  # the one that is called so
    assert offered(of("Datum;built;Zeit", *two)) == ["Zeit", "built", "n_dem"]
    assert offered(of("a;built;Zeit", *two)) == ["Zeit", "a", "built", "n_dem"]  # which of them, nobody says
    whole = ("2026-03-14;2026-03-14 10:00:00", "2026-03-15;2026-03-14 10:00:01")
    assert times(of("Datum;Uhrzeit", *whole)) == [0.0, 1.0]  # the time has a day of its own
    assert offered(of("Datum;Zeit", *two_days)) == ["Zeit", "n_dem"]
    assert offered(of("Datum;Zeit", *whole)) == ["Zeit", "Datum", "n_dem"]


def test_a_guess_that_contradicts_the_log_is_withdrawn_and_told(tmp_path: Path) -> None:
    """A stroke of the cylinder that runs against the demand of the stroke."""
    t = 0.1 * np.arange(300)
    x = 5.0 + 12.0 * np.sin(0.5 * t)
    rows = "".join(f"{a:g},{b:.3f},{-b:.3f}\n" for a, b in zip(t, x, strict=True))
    file = made(tmp_path, "t,x_dem,actuator position meas [mm]\n" + rows)
    said = "it is x_dem with the other sign; --unit x_lvdt=-mm turns it"
    name = "actuator position meas [mm]"
    log = read(file)
    assert list(log.channels) == ["x_dem"] and log.guesses == ()
    assert log.notes == [f"x_lvdt: {name!r} would be it by name, but {said}: not guessed"]
    shown = survey(file)
    assert shown.other == {name: f"x_lvdt? {said}"} and not shown.guessed
    turned = read(file, units={"x_lvdt": "-mm"})
    assert turned["x_lvdt"].values == pytest.approx(x, abs=1e-3) and turned.guesses[0].name == name


def test_names_of_a_mapping_file_stay_readable(tmp_path: Path) -> None:
    write_mapping(tmp_path / "m.toml", Bench({"x_dem": "Stellweg \u00d6l"}))
    assert 'x_dem = "Stellweg \u00d6l"\n' in (tmp_path / "m.toml").read_text(encoding="utf-8")


def test_a_parquet_log_says_its_engine_and_its_time(tmp_path: Path) -> None:
    table = pa.table({"t": [0.0], "n_dem": [50.0]})
    of = format_of(tmp_path / "a.parquet")
    pq.write_table(table, tmp_path / "a.parquet")
    assert of.said_by(tmp_path / "a.parquet") == {}
    said = {"engine": "E 7", "other": "x", "time": "2026-03-14\u00b0"}
    pq.write_table(table.replace_schema_metadata(said), tmp_path / "a.parquet")
    assert of.said_by(tmp_path / "a.parquet") == {"engine": "E 7", "time": "2026-03-14\u00b0"}
    assert of.said_by(made(tmp_path, "no", "b.parquet")) == {}
    assert Log("x", {"a": Channel(np.arange(2.0), np.arange(2.0))}).ordered


# ---- more ways in ----------------------------------------------------------------------------------------------------

KCD = """<NetworkDefinition xmlns="http://kayak.2codeornot2code.org/1.0"><Document/><Node id="1" name="ECU"/>
<Bus name="b"><Message id="0x100" name="M" length="8"><Signal name="n_dem" offset="0" length="16">
<Value type="unsigned" slope="0.5" unit="%"/></Signal><Signal name="low" offset="0" length="8"/></Message></Bus>
</NetworkDefinition>"""


def test_a_database_of_another_kind_is_taken_as_it_is(tmp_path: Path) -> None:
    """Signals that share bits are nobody's fault here: each is read where it stands."""
    dbc = made(tmp_path, KCD, "a.kcd")
    log = read(made(tmp_path, "(1.0) can0 100#6400000000000000\n(1.1) can0 100#C800\n", "a.log"), dbc=dbc)
    assert log["n_dem"].values.tolist() == [50.0, 100.0] and log["n_dem"].unit == "%"
    with pytest.raises(LogError, match=r"x.kcd: is not a database that cantools reads \("):
        read(made(tmp_path, "(1.0) can0 100#64\n", "a.log"), dbc=made(tmp_path, "<x/>", "x.kcd"))


def test_a_longer_head_of_a_binary_log_is_no_damage(tmp_path: Path) -> None:
    with can.BLFWriter(str(tmp_path / "a.blf")) as out:
        out.on_message_received(can.Message(1.0, 0x100, False, data=b"\1", channel=0))
    raw = (tmp_path / "a.blf").read_bytes()
    longer = raw[:4] + (200).to_bytes(4, "little") + raw[8:144] + bytes(56) + raw[144:]
    found = read_blf(made(tmp_path, longer, "b.blf"))
    assert found.ident.tolist() == [0x100] and found.notes == []
    beyond = raw[:4] + (10**6).to_bytes(4, "little") + raw[8:]
    with pytest.raises(LogError, match="no CAN data frame in it"):
        read_blf(made(tmp_path, beyond, "c.blf"))


@pytest.mark.parametrize("block", [40, 64, 1 << 23])
def test_a_cell_of_several_lines_may_lie_anywhere_in_a_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, block: int
) -> None:
    monkeypatch.setattr(csv_format, "_BLOCK", block)
    rows = "".join(f'{k},{50 + k % 9},"of\n{k}"\n' for k in range(60))
    log = read(made(tmp_path, "t,n_dem,remark\n" + rows))
    assert log["n_dem"].values.tolist() == [50.0 + k % 9 for k in range(60)] and log["n_dem"].t.size == 60


@pytest.mark.parametrize(("share", "sure"), [(0.28, True), (0.22, False)])
def test_a_channel_tells_by_itself_where_a_quarter_of_its_samples_bend(share: float, sure: bool) -> None:
    draw = np.random.default_rng(8)
    knots = np.sort(draw.choice(np.arange(1, 800), int(800 * share), replace=False))
    values = np.interp(np.arange(4001), np.r_[0, 5 * knots, 4000], np.r_[0.0, draw.standard_normal(knots.size), 0.0])
    assert joined(0.01 * np.arange(4001), values) == Joined(5, 0, sure)


class Frames64:
    """CAN FD frames of an MDF file that says their lengths by DLC alone."""

    def __init__(self, columns: dict[str, np.ndarray]):
        self.columns = columns
        kinds = [SimpleNamespace(name=f"CAN_DataFrame.{n}", channel_type=0) for n in columns]
        self.groups = [SimpleNamespace(channels=kinds)]

    def get(self, name: str, group: int, raw: bool, ignore_invalidation_bits: bool) -> Any:
        assert raw and ignore_invalidation_bits
        samples = self.columns[name.split(".")[1]]
        return SimpleNamespace(samples=samples, timestamps=np.arange(float(len(samples))))


def test_a_dlc_above_eight_stands_for_the_lengths_of_can_fd() -> None:
    lengths = [*range(9), 12, 16, 20, 24, 32, 48, 64]
    columns = {"ID": np.full(16, 0x7FF, np.uint32), "DLC": np.arange(16, dtype=np.uint8),
               "DataBytes": np.ones((16, 64), np.uint8)}  # fmt: skip
    columns["ID"][3] = 0x800
    t, ident, bus, length, data = mdf_child._bus_columns(Frames64(columns), 0, [f"CAN_DataFrame.{c}" for c in columns])
    assert length.tolist() == lengths and data.shape == (16, 64) and bus.tolist() == [0] * 16
    assert ident.tolist() == [0x800 | EXTENDED if k == 3 else 0x7FF for k in range(16)]
    assert t.tolist() == list(range(16))
    short = {**columns, "DataBytes": np.ones((16, 6), np.uint8)}
    *_, length, data = mdf_child._bus_columns(Frames64(short), 0, [f"CAN_DataFrame.{c}" for c in short])
    assert length.tolist() == [min(n, 8) for n in lengths] and data.shape == (16, 8)
    assert data.tolist() == [[1] * 6 + [0] * 2] * 16


# ---- what is looked at before it is read -----------------------------------------------------------------------------


def test_bytes_are_those_of_a_file_that_holds_some(tmp_path: Path) -> None:
    for path, said in ((made(tmp_path, "", "empty"), "is empty"), (tmp_path, "is a folder, not a log"),
                       (tmp_path / "none", "cannot be read (No such file or directory)")):  # fmt: skip
        with pytest.raises(LogError) as caught:
            read_bytes(path)
        assert str(caught.value) == f"{path}: {said}"
    assert read_bytes(made(tmp_path, "abc", "a"), 2) == b"ab" and read_bytes(tmp_path / "a") == b"abc"


@pytest.mark.parametrize(("length", "is_float", "start", "fine"), [
    (64, False, 0, True), (65, False, 0, False), (32, True, 0, True), (24, True, 0, False), (64, True, 64, True),
])  # fmt: skip
def test_a_signal_has_the_bits_of_a_number_at_most(length: int, is_float: bool, start: int, fine: bool) -> None:
    signal = SimpleNamespace(name="s", start=start, length=length, is_float=is_float, is_signed=False)
    vars(signal).update(
        scale=2.0, offset=1.0, byte_order="little_endian", multiplexer_signal=None, multiplexer_ids=None
    )
    of = SimpleNamespace(layout=SimpleNamespace(name="M"), missing={}, j1939=False)
    data = np.zeros((2, 64), np.uint8)
    frames = Frames(np.arange(2.0), np.zeros(2, np.uint32), np.zeros(2, np.int32), np.full(2, 64, np.uint8), data)
    if fine:
        assert cut_signal(frames, np.arange(2), of, signal)[1].tolist() == [1.0, 1.0]  # type: ignore[arg-type]
    else:
        with pytest.raises(LogError, match=rf"^M.s: {length} bits cannot be read; allowed: 64, or an IEEE number$"):
            cut_signal(frames, np.arange(2), of, signal)  # type: ignore[arg-type]


def test_parts_are_one_where_each_begins_after_the_last_row_of_the_one_before(tmp_path: Path) -> None:
    for times, values in (
        (((0, 1, 5), (3, 4)), [0.0, 1.0, 2.0]), (((0, 1, 2), (3, 4)), [0.0, 1.0, 2.0, 3.0, 4.0]),
        (((0,), (1, 2), (3,)), [0.0, 1.0, 2.0, 3.0]), (((0, 1), (1, 2, 3)), [2.0, 3.0, 4.0]),
    ):  # fmt: skip
        numbers = iter(range(9))
        text = "".join("t,n_dem\n" + "".join(f"{t},{next(numbers)}\n" for t in part) for part in times)
        assert read(made(tmp_path, text))["n_dem"].values.tolist() == values, times


def test_the_end_of_a_recording_is_told_also_where_the_pipe_is_full() -> None:
    out, into = os.pipe()
    os.set_blocking(into, False)
    with contextlib.suppress(BlockingIOError):
        while True:
            os.write(into, b"\0" * 4096)
    got: list[bytes] = []

    def drain() -> None:
        while data := os.read(out, 1 << 16):
            got.append(data)

    to: Any = object.__new__(recorder.RecorderProcess)
    to.lost, to.frames, to.error, to._pipe = 0, 0, "", into
    to._process = SimpleNamespace(stdin=SimpleNamespace(close=lambda: os.close(into)), stdout=io.BytesIO(b"frames 7\n"),
                                  wait=lambda: None)  # fmt: skip
    later = threading.Timer(0.05, drain)
    later.start()
    to.close()
    later.join()
    os.close(out)
    assert b"".join(got).endswith(recorder._END) and (to.frames, to.error) == (7, "")


# ---- limits of what is taken for joined ------------------------------------------------------------------------------


def joined_rows(every: int, n: int = 3000, first: int = 0) -> np.ndarray:
    """Noise at every so many rows, and straight lines between."""
    at = first + every * np.arange(-1, n // every + 2)
    return np.asarray(np.interp(np.arange(n), at, np.random.default_rng(every).standard_normal(at.size)))


def test_samples_may_be_twenty_rows_apart_and_times_a_twentieth_of_a_step_off() -> None:
    t = 0.02 * np.arange(3000.0)
    assert joined(t, joined_rows(20)) == Joined(20, 0, True) and joined(t, joined_rows(23)) is None
    assert joined(t, joined_rows(21)) == Joined(7, 0, True)  # of 21 rows a third
    for off, found in ((0.045, Joined(5, 0, True)), (0.055, None)):
        shaken = t + 0.02 * off * np.where(np.arange(3000) % 7 == 3, 1.0, 0.0)
        assert joined(shaken, joined_rows(5)) == found, off
    for rows, found in ((25, Joined(5, 0, True)), (40, None)):  # of 3,000, a hundredth may be off by more
        few = t.copy()
        few[7 : 7 + 11 * rows : 11] += 0.02 * 0.2
        assert joined(few, joined_rows(5)) == found, rows


def test_a_long_channel_is_looked_at_where_it_begins_in_its_middle_and_where_it_ends() -> None:
    """A part in each of these places is joined, the rest was sampled in each row."""
    n, part = 40_000, 1500
    t = 0.02 * np.arange(float(n))
    noise = np.random.default_rng(1).standard_normal(n)
    middle = (n - part) // 2
    for place, seen in ((0, True), (n - part, True), (middle, True), (n // 4, False)):
        values = np.cumsum(0.01 * noise)
        values[n // 2 - 200 : n // 2 + 200] = 5.0  # at rest, as most channels are now and then
        values[place : place + part] = joined_rows(5, part)
        assert seems_joined(t, values) == seen, place
    assert not seems_joined(t, noise) and not seems_joined(t, np.zeros(n))


# ---- a unit of time, guessed -----------------------------------------------------------------------------------------


def test_a_time_that_counts_from_1970_in_smaller_units_is_guessed_and_told(tmp_path: Path) -> None:
    for unit, factor in (("ms", 1_000), ("us", 1_000_000), ("ns", 1_000_000_000)):
        rows = "".join(f"{(1_770_000_000 + k) * factor},{50 + k}\n" for k in range(4))
        log = read(made(tmp_path, "t,n_dem\n" + rows))
        assert log["n_dem"].t == pytest.approx([0.0, 1.0, 2.0, 3.0], abs=1e-5)
        assert log.notes[0] == (
            f"t (t): guessed to be in {unit} ({1_770_000_001.5 * factor:.6g} counts {unit} since 1970); --unit t=UNIT "
            "states another, --no-guess none"
        )
        assert isinstance(log.notes[0], Note) and (log.notes[0].kind, log.notes[0].of) == ("guessed", "t")
        stated = read(made(tmp_path, "t,n_dem\n" + rows), units={"t": unit})
        assert stated["n_dem"].t == pytest.approx([0.0, 1.0, 2.0, 3.0], abs=1e-5) and "guessed" not in stated.notes[0]
        with pytest.raises(LogError, match=r"must be below 1e\+10 s; --unit t="):
            read(made(tmp_path, "t,n_dem\n" + rows), guess=False)


# ---- what a reader leaves behind -------------------------------------------------------------------------------------


def test_reading_a_recording_leaves_the_log_of_python_can_as_it_was(tmp_path: Path) -> None:
    log = logging.getLogger("can")
    before = log.level
    log.setLevel(logging.INFO)
    try:
        record = read_record(made(tmp_path, "(1.5) can0 123#01 R\n(1.25) can0 124#02 T\n", "a.log"))
        assert log.level == logging.INFO
    finally:
        log.setLevel(before)
    assert record.ms.tolist() == [1250, 1500] and record.sent.tolist() == [True, False]


def test_an_answer_of_the_reader_of_mdf_is_taken_apart_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = made(tmp_path, b"MDF     4.10    " + bytes(48) + b"##HD" + bytes(100), "a.mf4")
    us, rows, sent = np.arange(3), np.arange(6).reshape(3, 2), np.array([True, False, True])
    arrays = {"us": us, "rows": rows, "sent": sent}
    head = json.dumps({"arrays": [(n, a.dtype.str, a.shape) for n, a in arrays.items()]}).encode() + b"\n"
    asked: list[Any] = []

    def child(request: bytes, seconds: float) -> bytes:
        asked.append((json.loads(request), seconds))
        return head + b"".join(a.tobytes() for a in arrays.values())

    monkeypatch.setattr(mdf, "_child", child)
    others = mdf.read_as_others(file, {"frames": True})
    assert {n: a.tolist() for n, a in others.items()} == {n: a.tolist() for n, a in arrays.items()}
    assert asked[0] == ({"path": str(file), "seconds": 20, "frames": True}, 400)
    found = mdf.read_record_mdf(file)
    assert [a.tolist() for a in found] == [a.tolist() for a in arrays.values()] and asked[1][0]["record"] is True
    monkeypatch.setattr(mdf, "_child", lambda *a: b'{"error": "so it is"}\n')
    with pytest.raises(LogError, match=r"a.mf4: is not an MDF file that asammdf reads \(so it is\)$"):
        mdf.read_as_others(file, {"frames": True})


def test_a_channel_that_cannot_be_read_is_not_in_a_sketch(tmp_path: Path) -> None:
    file = made(tmp_path, "t,n_dem,x_dem,p_s [V],n_r\n0,50,a,1,60\n1,51,b,2,61\n")
    opened = open_log(file, None, None, None, None, UNITS, True, None, {})
    assert {n: v.tolist() for n, (_, v) in sketch(file, opened, UNITS).items()} == {
        "n_dem": [50.0, 51.0], "n_r": [60.0, 61.0]
    }  # fmt: skip
    assert crc_table().shape == (256,)
