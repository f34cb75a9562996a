"""Parts of reading logs against what they are for, worked out here: messages of several frames, times of traces that
begin anew, parts of a table, decimal commas, bits of signals, frames of other packages, notes as data.
"""

from __future__ import annotations

import base64
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hil.logs import dataframe, guess, layout, notes, tool_traces, transport
from hil.logs import joined as joined_samples
from hil.logs.frames import EXTENDED, Frames
from hil.logs.mapping import Bench
from hil.logs.notes import Note
from hil.logs.recordings import read_record
from hil.logs.signals import _place
from hil.logs.source import LogError, Options
from hil.logs.survey import MOST_LISTED, Survey
from hil.logs.table import Table, Time, split_unit

# ---- messages of several frames --------------------------------------------------------------------------------------


def frames_of(*of: tuple[int, bytes] | tuple[int, bytes, int]) -> Frames:
    """Frames a second apart: identifier, data, and bus where it is not 0."""
    data = np.array([list(f[1].ljust(8, b"\0")) for f in of], np.uint8)
    return Frames(
        np.arange(float(len(of))), np.array([f[0] for f in of], np.uint32),
        np.array([f[2] if len(f) > 2 else 0 for f in of], np.int32),  # type: ignore[misc]
        np.array([len(f[1]) for f in of], np.uint8), data,
    )  # fmt: skip


def joined(find: Any, *of: Any) -> Any:
    frames = frames_of(*of)
    return find(frames, np.arange(len(of)))


def j1939(size: int, group: int, control: int = 32, packets: int | None = None) -> bytes:
    """Connection management: so many bytes of a parameter group to come."""
    many = -(-size // 7) if packets is None else packets
    return bytes([control]) + size.to_bytes(2, "little") + bytes([many, 255]) + group.to_bytes(3, "little")


CM, DT = EXTENDED | 0x1CECFF03, EXTENDED | 0x1CEBFF03  # from 3 to all


def packets(content: bytes, numbers: list[int] | None = None) -> list[tuple[int, bytes]]:
    parts = [content[k : k + 7].ljust(7, b"\xff") for k in range(0, len(content), 7)]
    return [(DT, bytes([n]) + parts[n - 1]) for n in numbers or range(1, len(parts) + 1)]


@pytest.mark.parametrize("size", [9, 14, 15, 100, 1785])
def test_a_broadcast_message_is_its_packets_in_their_order(size: int) -> None:
    content = bytes((7 * k + 1) % 256 for k in range(size))
    found = joined(transport._j1939, (CM, j1939(size, 0xFEE3)), *packets(content))
    assert found.data == [content] and found.ident == [EXTENDED | 6 << 26 | 0xFEE3 << 8 | 3] and found.bus == [0]
    assert found.t == [-(-size // 7)] and (found.frames, found.broken) == (-(-size // 7) + 1, 0)


def test_messages_of_j1939_that_are_none() -> None:
    content = bytes(range(20))
    good = (CM, j1939(20, 0xFEE3))
    for of, broken, many in (
        ([(CM, j1939(8, 0xFEE3)), *packets(content[:8])], 0, 0),  # it fits into a frame
        ([(CM, j1939(20, 0xFEE3, packets=4)), *packets(content)], 0, 0),
        ([(CM, j1939(20, 0xFEE3, control=17)), *packets(content)], 0, 0),  # clear to send
        ([(CM, j1939(20, 0xFEE3)[:7]), *packets(content)], 0, 0),
        ([good, *packets(content)[:2]], 1, 0), ([good, good, *packets(content)], 1, 1),
        ([good, *packets(content, [1, 1, 2, 3])], 0, 1), ([good, *packets(content, [3, 2, 1])], 0, 1),
        ([good, *packets(content), *packets(content)], 0, 1),
        ([good, *[(i, d, 1) for i, d in packets(content)]], 1, 0),  # another bus
        ([good, (DT, packets(content)[0][1][:7]), *packets(content)], 0, 1),  # a packet cut short is none
    ):  # fmt: skip
        found = joined(transport._j1939, *of)
        assert (found.broken, len(found.t), found.data) == (broken, many, [content] * many), of
    to_one = joined(transport._j1939, (EXTENDED | 0x1CEC2103, j1939(9, 0xEF00, 16)),
                    *[(EXTENDED | 0x1CEB2103, d) for _, d in packets(bytes(range(9)))])  # fmt: skip
    assert to_one.ident == [EXTENDED | 6 << 26 | 0xEF2103]  # of a group below 0xF000 the destination is a part
    for group, kept in ((0xEFFF, 0x2100), (0xF000, 0)):
        one = joined(transport._j1939, (EXTENDED | 0x1CEC2103, j1939(9, group, 16)),
                     *[(EXTENDED | 0x1CEB2103, d) for _, d in packets(bytes(9))])  # fmt: skip
        assert one.ident == [EXTENDED | 6 << 26 | group << 8 | kept | 3]


def iso(content: bytes, first: int = 1) -> list[tuple[int, bytes]]:
    """A message in ISO-TP, its consecutive frames counted from ``first``."""
    if len(content) < 8:
        return [(5, bytes([len(content)]) + content)]
    head = [(5, (0x1000 | len(content)).to_bytes(2, "big") + content[:6])]
    rest = range(6, len(content), 7)
    return head + [(5, bytes([0x20 | (first + n) % 16]) + content[k : k + 7]) for n, k in enumerate(rest)]


@pytest.mark.parametrize("size", [1, 7, 8, 20, 118, 119, 4095])
def test_a_message_of_iso_tp_is_its_frames_in_their_order(size: int) -> None:
    content = bytes((5 * k + 2) % 256 for k in range(size))
    found = joined(transport._iso_tp, *iso(content), (5, b"\x30\0\0"))  # flow control is passed over
    assert found.data == [content] and (found.frames, found.broken) == (len(iso(content)), 0)
    assert found.ident == [5] and found.t == [len(iso(content)) - 1.0]


def test_messages_of_iso_tp_that_are_none() -> None:
    content = bytes(range(1, 31))
    for of, broken, data in (
        ([(5, b"")], 0, []), ([(5, b"\x00\x01")], 0, []), ([(5, b"\x03ab")], 0, []), ([(5, b"\x03abc")], 0, [b"abc"]),
        (iso(content, 2), 1, []), (iso(content)[:-1], 1, []), ([*iso(content)[:2], *iso(content)], 1, [content]),
        ([*iso(content)[:2], (5, b"\x01a")], 1, [b"a"]), ([(5, iso(content)[0][1][:7])], 0, []),
        (iso(content)[1:], 0, []), ([(5, b"\x10\x06" + bytes(6))], 0, []), ([(5, b"\x10\x07" + bytes(6))], 1, []),
        ([(5, b"\x10\x00\x00\x00\x00\x0aab"), (5, b"\x21cdefghi"), (5, b"\x22jk")], 0, [b"abcdefghij"]),
        ([(5, b"\x10\x00\x00\x00\x10\x00ab")], 0, []),  # 4,096 bytes
        ([iso(content)[0], *[(i, d, 1) for i, d in iso(content)[1:]]], 1, []),
    ):  # fmt: skip
        found = joined(transport._iso_tp, *of)
        assert (found.broken, found.data) == (broken, data), of


# ---- traces ----------------------------------------------------------------------------------------------------------


def part(place: list[int], ms: list[int]) -> Any:
    n = len(place)
    return (np.array(place), np.array(ms, np.int64) * 10**6, np.full(n, 1, np.uint32), 0, np.zeros((n, 1), np.uint8))


@pytest.mark.parametrize(("ms", "goes_on"), [
    ([59_000, 59_900, 100, 1_000], [0, 900, 1_100, 2_000]), ([100, 59_990, 200], [0, -110, 100]),
    ([100, 70_000, 200], None), ([50_000, 49_990, 50_010], [0, -10, 10]),
    ([10, 50_000, 20, 50_000], [0, 49_990, 60_010, 109_990]),
    ([10_000, 9_100, 11_000], [0, -900, 1_000]), ([10_000, 8_500, 9_000], [0, 58_500, 59_000]),
])  # fmt: skip
def test_a_clock_of_a_minute_goes_on_and_a_frame_may_come_late(
    ms: list[int], goes_on: list[int] | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    got: list[Any] = []
    monkeypatch.setattr(tool_traces, "join_parts", lambda path, parts, *rest: got.extend(parts))
    places = list(range(len(ms)))
    tool_traces._joined(Path("x"), [part(places[::2], ms[::2]), part([], []), part(places[1::2], ms[1::2])],
                        tool_traces._CANHACKER, [])  # fmt: skip
    assert len(got) == 2
    t = np.empty(len(ms))
    for p in got:
        t[p[0]] = p[1] / 1e6
    assert (t - t[0]).tolist() == (goes_on or [m - ms[0] for m in ms])  # beyond a minute nothing begins anew


def test_a_csv_of_python_can_says_what_each_row_is(tmp_path: Path) -> None:
    def row(t: str = "0.25", ident: str = "0x122", extended: str = "0", remote: str = "0", error: str = "0",
            data: bytes = b"hi") -> str:  # fmt: skip
        return f"{t},{ident},{extended},{remote},{error},{len(data)},{base64.b64encode(data).decode()}"

    lines = [
        row("1.0"), row("1.5", "0x800", "1"), row("1.6", "0x800"), row("1.7", "0x7ff"), row("1.8", "0x1fffffff", "1"),
        row("1.9", "0x20000000", "1"), row(remote="1"), row(error="1"), row("x"), "1,2,3", "",
        row("2.0", data=bytes(64)), row("2.1", data=bytes(65)), row("9e9"), row("2.2", "-0x1"), row("2.3", data=b""),
    ]  # fmt: skip
    file = tmp_path / "a.csv"
    file.write_text("\n".join(["timestamp,arbitration_id,extended,remote,error,dlc,data", *lines]))
    found = tool_traces.read_csv_frames(file)
    assert found.t.tolist() == pytest.approx([0.0, 0.5, 0.7, 0.8, 1.0, 1.3])
    assert found.ident.tolist() == [0x122, EXTENDED | 0x800, 0x7FF, EXTENDED | 0x1FFFFFFF, 0x122, 0x122]
    assert found.length.tolist() == [2, 2, 2, 2, 64, 0] and found.data[0, :2].tobytes() == b"hi"
    assert list(found.notes) == ["7 lines are not python-can lines: left out", "2 remote or error frames: left out"]


# ---- tables ----------------------------------------------------------------------------------------------------------


def table(t: list[float], parts: tuple[int, ...], part: int = 0) -> Table:
    columns = {"t": np.array(t), "x": np.arange(float(len(t)))}
    return Table(["t", "x"], lambda key: columns[key], 5, Time("t"), {}, parts=parts, part=part)


def test_parts_of_a_table_are_one_where_time_goes_on_else_the_longest_is_read() -> None:
    goes_on = table([0, 1, 2, 3, 4], (0, 2))
    assert goes_on.series("x").values.tolist() == [0, 1, 2, 3, 4] and goes_on.series("x").first == 5
    (note,) = goes_on.notes
    said = "its 2 parts are read as one, since time goes on; --part N reads one of 2"
    assert str(note) == f"rows: the header stands again in row 6: {said}"
    assert isinstance(note, Note) and (note.kind, note.of, note.number, note.rows) == ("joined", "rows", 0, (6,))
    again = table([0, 1, 0, 1, 2, 0], (0, 2, 5))
    series = again.series("x")
    assert series.values.tolist() == [2, 3, 4] and series.t.tolist() == [0, 1, 2] and series.first == 7
    (note,) = again.notes
    assert isinstance(note, Note) and str(note).startswith("rows: the header stands again in row 6, 9: part 2 of 3 is")
    assert (note.kind, note.number, note.rows) == ("left out", 3, (6, 9))
    assert table([0, 1, 0, 1, 2, 0], (0, 2, 5), part=1).series("x").values.tolist() == [0, 1]
    assert table([0, 1, 0, 1, 2, 0], (0, 2, 5), part=3).series("x").values.tolist() == [5]
    assert table([0, 1, 1, 2], (0, 2)).series("x").values.tolist() == [0, 1]  # the same time again is no going on
    assert (
        table([0, 1, np.nan, np.nan, 2], (0, 2, 4)).series("x").values.size == 5
    )  # a part without a time says nothing
    assert table([0, 1], (0,)).notes == []


@pytest.mark.parametrize(("header", "name", "unit"), [
    ("n_r [rpm]", "n_r", "rpm"), ("n_r(rpm)", "n_r", "rpm"), (" a [ b ] ", "a", "b"), ("[rpm]", "[rpm]", ""),
    ("a]b", "a]b", ""), ("a [b] c", "a [b] c", ""), ("a [b)", "a [b)", ""), ("a [b[c]]", "a [b[c]]", ""),
    ("a (b[c])", "a", "b[c]"), ("a", "a", ""), ("", "", ""), ("a []", "a", ""),
])  # fmt: skip
def test_a_header_carries_its_unit_in_the_last_bracket(header: str, name: str, unit: str) -> None:
    assert split_unit(header) == (name, unit)


@pytest.mark.parametrize(("cells", "comma", "thousands", "out"), [
    (["1,5", "-2,25", "x"], True, False, ["1.5", "-2.25", "x"]), (["1.234,5", "7"], True, True, ["1234.5", "7"]),
    (["1.234", "2,5"], True, True, ["1234", "2.5"]), (["1.234", "2.345,5"], True, False, ["1234", "2345.5"]),
    (["1.5", "2.25"], True, False, ["1.5", "2.25"]),
    (["1,234", "1,234.5", "x,y"], False, True, ["1234", "1234.5", "x,y"]),
    (["", "12"], True, False, ["", "12"]),
])  # fmt: skip
def test_a_number_with_a_decimal_comma_gets_a_point(
    cells: list[str], comma: bool, thousands: bool, out: list[str]
) -> None:
    assert layout.in_points(cells, comma, thousands) == out


@pytest.mark.parametrize(
    ("cells", "thousands"), [(["1.234", "2,5"], False), (["1.5", "2,5"], True), (["1.234"], False)]
)
def test_a_number_that_may_be_read_either_way_is_refused(cells: list[str], thousands: bool) -> None:
    with pytest.raises(ValueError, match=rf"^{cells[0]}$"):
        layout.in_points(cells, True, thousands)


# ---- signals, frames of other packages, notes ------------------------------------------------------------------------


def test_bits_of_a_signal_lie_where_its_byte_order_has_them() -> None:
    """Every start and length of a frame of eight bytes: bit by bit along the signal."""
    for order in ("little_endian", "big_endian"):
        for start in range(64):
            for length in range(1, 65):
                bits = [start]  # little endian: from the least on; big endian: from the most on
                for _ in range(length - 1):
                    last = bits[-1]
                    up = last + 1 if order == "little_endian" else last + 15 if last % 8 == 0 else last - 1
                    bits.append(up)
                if max(bits) > 63:
                    continue
                least = bits[0] if order == "little_endian" else bits[-1]
                bytes_ = list(dict.fromkeys(b // 8 for b in (bits if order == "little_endian" else bits[::-1])))
                found = _place(SimpleNamespace(byte_order=order, start=start, length=length))
                assert found == (bytes_, least % 8), (order, start, length)


def test_a_frame_of_another_package_is_one_that_makes_one_of_pandas() -> None:
    def of(module: str, **have: Any) -> Any:
        return type("Frame", (), {"__module__": module, **have})()

    made = {"to_pandas": lambda self: "pandas"}
    for module, good in (("polars.dataframe.frame", True), ("pyarrow.lib", True), ("modin.pandas", False)):
        frame = of(module, **made)
        assert dataframe._foreign(frame) == dataframe.is_frame(frame) == good
        assert dataframe._own(frame) == ("pandas" if good else frame)
        assert not dataframe._foreign(of(module)) and not dataframe._foreign(of(module, to_pandas=3))
    assert dataframe.is_frame(of("any", columns=[], dtypes=[])) and not dataframe.is_frame(of("any", columns=[]))
    assert dataframe.name_of(of("any", attrs={"name": "run 7"})) == "run 7"
    assert dataframe.name_of(of("any", attrs={"name": ""})) == dataframe.name_of(of("any")) == "DataFrame"
    assert dataframe.units_in(of("any", attrs={"units": {"a": "mm", 3: "", "b": None}})) == {"a": "mm"}
    assert dataframe.units_in(of("any", attrs={})) == dataframe.units_in(of("any", attrs={"units": None})) == {}
    with pytest.raises(LogError, match=r"DataFrame: attrs\['units'\] \(=\['mm'\]\) must be a dict of column -> unit"):
        dataframe.units_in(of("any", attrs={"units": ["mm"]}))


def test_notes_are_sentences_and_data() -> None:
    many = Note("rows: so", "left out", "rows", 1_300, range(3_000, 4_300))
    few = Note("x: so", "cut", "x", 2, [1_000, 7])
    assert notes.counted(["a word", few]) == [
        {"kind": "cut", "of": "x", "count": 2, "rows": [1_000, 7], "said": "x: so"}
    ]
    assert notes.told(iter(["a word", few]))["notes"] == ["a word", "x: so"]
    rows = notes.as_rows(notes.counted([many, few, Note("t", "guessed", "t"), Note("u", "filled", "u", 5)]))
    listed = ", ".join(f"{r:,}" for r in many.rows)
    assert rows == [
        ["left out", "rows", 1_300, f"{listed} and {1_300 - len(many.rows):,} more", "rows: so"],
        ["cut", "x", 2, "1,000, 7", "x: so"], ["guessed", "t", None, "", "t"], ["filled", "u", 5, "", "u"],
    ]  # fmt: skip
    assert len(many.rows) == notes.MOST_ROWS and str(many.on("a.csv")) == "a.csv: rows: so"
    assert many.on("a.csv").rows == many.rows


def test_a_bench_is_what_a_survey_shows() -> None:
    from_rows = [
        SimpleNamespace(signal="n_r", name="speed", unit="rpm"),
        SimpleNamespace(signal="x_dem", name="d", unit=""),
    ]
    survey = SimpleNamespace(rows=from_rows, design_rpm=9_000.0, dbc=Path("a.dbc"))
    found = Survey.bench(survey)  # type: ignore[arg-type]
    assert found == Bench({"n_r": "speed", "x_dem": "d"}, {"n_r": "rpm"}, 9_000.0, Path("a.dbc"))
    lists = {"a": "why", "b": "", "c": "why", **{f"d{k}": "many" for k in range(MOST_LISTED + 2)}}
    told = Survey.unused(SimpleNamespace(other=lists))  # type: ignore[arg-type]
    names = ", ".join(f"d{k}" for k in range(MOST_LISTED))
    assert told == ["a, c: why", "b", f"{names} and 2 more: many"]
    for how, guessed in ((("said",), False), (("said", "guessed"), True)):
        rows = [SimpleNamespace(how=h) for h in how]
        assert Survey.guessed.fget(SimpleNamespace(rows=rows)) == guessed  # type: ignore[attr-defined]


# ---- what a log suggests ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("share", [0.72, 0.9, 1.0, 1.2, 1.3])
def test_a_log_in_rpm_suggests_the_speed_under_which_its_strokes_lie_on_the_schedule(share: float) -> None:
    of, curve = guess.mean_stroke(guess._SHIPPED)
    t = np.linspace(0.0, 100.0, 1_001)
    n = np.interp(t, [0.0, 50.0, 100.0], [4_000.0, 10_000.0, 4_000.0])
    stroke = np.interp(100.0 * n / (1e4 * share), of, curve)
    found, why = guess.design_speed((t, n), (t, stroke))
    assert found == pytest.approx(1e4 * share, rel=0.01) and "follows the schedule best" in why


def test_a_log_in_rpm_without_a_stroke_that_fits_suggests_its_largest_speed() -> None:
    of, curve = guess.mean_stroke(guess._SHIPPED)
    t = np.linspace(0.0, 100.0, 1_001)
    n = np.interp(t, [0.0, 50.0, 100.0], [4_000.0, 10_000.0, 4_000.0])
    for stroke in (None, np.full(1_001, 20.0), np.interp(100.0 * n / 1.8e4, of, curve)):
        found, why = guess.design_speed((t, n), None if stroke is None else (t, stroke))
        assert found == pytest.approx(1e4, rel=0.01) and why.startswith("the largest speed is ")
    assert guess.design_speed((t, 0.0 * n), None) == (0.0, "it is 0 throughout")


@pytest.mark.parametrize(
    ("apart", "every"), [(k, k) for k in (2, 3, 7, 13, 19, 20)] + [(21, 7), (22, 11), (23, 0), (1, 0)]
)
def test_samples_up_to_twenty_rows_apart_are_seen_between_straight_lines(apart: int, every: int) -> None:
    rng = np.random.default_rng(apart)
    rows = np.arange(2_000)
    true = rows[3::apart]
    values = np.interp(rows, true, rng.normal(size=true.size))
    found = joined_samples.joined(0.01 * rows, values)
    assert found == (joined_samples.Joined(every, 3 % every, True) if every else None)


@pytest.mark.parametrize(("before", "stands"), [(0, 1), (58, 59), (59, 60)])
def test_a_header_stands_within_sixty_lines(before: int, stands: int) -> None:
    lines = [*(f"remark {k}" for k in range(before)), "t,n_dem"]
    raw = "\n".join([*lines, *(f"{k},6{k % 10}" for k in range(30))]).encode()
    if before < 59:
        found = layout.layout_of(Path("a.csv"), raw, Options(None, {}))
        assert found.head.row == stands and found.headers == ["t", "n_dem"] and found.first == stands + 1


@pytest.mark.parametrize(("sign", "comma"), [(",", True), (".", False), ("", False)])
def test_a_labview_file_says_its_decimal_sign_and_its_units(sign: str, comma: bool) -> None:
    said = [f"Decimal_Separator\t{sign}"] if sign else []
    head = ["LabVIEW Measurement\t", *said, "X_Columns\tOne", "***End_of_Header***\t", "Channels\t3",
            "Y_Unit_Label\tmm\t\tmA", "***End_of_Header***\t", "X_Value\ta\tb\tc"]  # fmt: skip
    raw = "\n".join([*head, *(f"{k}\t1\t2\t3" for k in range(5))]).encode()
    found = layout.layout_of(Path("a.lvm"), raw, Options(None, {}))
    assert (found.comma, found.units, found.headers) == (comma, {"a": "mm", "c": "mA"}, ["X_Value", "a", "b", "c"])


def test_a_recording_that_is_no_file_is_refused_before_its_name_is_judged(tmp_path: Path) -> None:
    (tmp_path / "x.blf").mkdir()
    (tmp_path / "empty.blf").write_bytes(b"")
    for name, says in (("none.blf", "cannot be read (No such file or directory)"), ("x.blf", "is a folder, not a log"),
                       ("empty.blf", "is empty")):  # fmt: skip
        with pytest.raises(LogError) as e:
            read_record(tmp_path / name)
        assert str(e.value) == f"{tmp_path / name}: {says}"
