"""Recordings of a bus as the tools of the field write them: whatever frames there were, they are read to the last bit.

Hypothesis makes the frames; the lines are those of the tools' own descriptions, and where python-can reads or writes a
format it is the judge.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import can
import cantools
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hil.logs import LogError, read_log
from hil.logs.dbc import Message, load_dbc
from hil.logs.formats import format_at
from hil.logs.frames import EXTENDED, Frames, in_order
from hil.logs.signals import e2e_crc, select
from hil.logs.source import Options
from tests.conftest import examples


@dataclass(frozen=True)
class Frame:
    """A data frame."""

    us: int  # since the start
    ident: int
    extended: bool
    data: bytes
    bus: int

    @property
    def told(self) -> bool:
        """Whether the length of the identifier can be told from its value."""
        return self.extended == (self.ident > 0x7FF)


@st.composite
def recordings(draw: st.DrawFn, longest: int = 8, told: bool = False, step: int = 900_000) -> list[Frame]:
    """Frames in order of time; ``told``: of identifiers whose length is that of their value."""
    out, us = [], draw(st.integers(0, 59_999_999))
    for _ in range(draw(st.integers(1, 12))):
        extended = draw(st.booleans())
        low = 0x800 if told and extended else 0
        ident = draw(st.integers(low, 0x1FFFFFFF if extended else 0x7FF))
        data = draw(st.binary(min_size=0, max_size=longest))
        out.append(Frame(us, ident, extended, data, draw(st.integers(1, 3))))
        us += draw(st.integers(0, step))
    return out


def seen(frames: Frames) -> list[tuple[int, int, bytes]]:
    """Time in us from the first, identifier, data of each frame."""
    times = np.rint(frames.t * 1e6).astype(int).tolist()
    return [
        (us, ident, row[:n].tobytes())
        for us, ident, n, row in zip(times, frames.ident.tolist(), frames.length.tolist(), frames.data, strict=True)
    ]


def sent(log: list[Frame], unit: int = 1) -> list[tuple[int, int, bytes]]:
    """What should be seen of a log whose times count units of so many us."""
    first = log[0].us // unit
    return [((f.us // unit - first) * unit, f.ident | EXTENDED * f.extended, f.data) for f in log]


def read(name: str, text: str) -> Frames:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        path.write_bytes(text.encode())
        return format_at(path).read_frames(path)


def spaced(data: bytes) -> str:
    return data.hex(" ").upper()


# ---- text ------------------------------------------------------------------------------------------------------------


def console(log: list[Frame], extra: bool, text: bool) -> str:
    """`candump -ta` on a console, with -x and -a where asked."""
    lines = []
    for f in log:
        ident = f"{f.ident:08X}" if f.extended else f"{f.ident:03X}".rjust(8)
        letters = "".join(chr(b) if 32 < b < 127 else "." for b in f.data)
        tail = f"{'':{3 * (8 - len(f.data)) + 3}}'{letters}'" if text else ""
        lines.append(
            f" ({1_600_000_000 + f.us // 10**6}.{f.us % 10**6:06d})  can{f.bus}  {'RX - -  ' * extra}{ident}   "
            f"[{len(f.data)}]  {spaced(f.data)}{tail}"
        )
    return "\n".join(lines) + "\n"


@given(recordings(), st.booleans(), st.booleans())
@settings(max_examples=examples(60), deadline=None)
def test_a_console_s_candump_is_what_candump_logs(log: list[Frame], extra: bool, text: bool) -> None:
    frames = read("a.log", console(log, extra, text))
    assert seen(frames) == sent(log) and frames.notes == []


def test_an_error_frame_on_the_console_is_counted_and_what_is_said_of_it_passed_over() -> None:
    text = console([Frame(0, 0x122, False, b"\x01\x02", 1)], False, False)
    error = " (1600000000.000100)  can1  20000004   [8]  00 04 00 00 00 00 00 00   ERRORFRAME\n\tcontroller-problem{}\n"
    frames = read("a.log", text + error)
    assert seen(frames) == [(0, 0x122, b"\x01\x02")] and frames.notes == ["1 remote or error frames: left out"]


@pytest.mark.parametrize(
    ("line", "why"),
    [
        (" (2018-12-06 09:31:30.000000)  vcan0  122   [1]  74", r"times are dates \(candump -tA\)"),
        ("  vcan0  122   [2]  74 6A", "lines have no time"), ("vcan0  RX - -  122   [2]  74 6A", "lines have no time"),
        (" (000.000000)  vcan0  122  [0]  remote request", "no candump frame"),
    ],
)  # fmt: skip
def test_a_candump_that_cannot_be_used_says_why(tmp_path: Path, line: str, why: str) -> None:
    (tmp_path / "a.log").write_text(line + "\n")
    with pytest.raises(LogError, match=why):
        read_log(tmp_path / "a.log")


@given(st.integers(2, 30), st.integers(1, 20_000))
@settings(max_examples=examples(25), deadline=None)
def test_times_from_frame_to_frame_are_no_times_from_a_start(messages: int, gap: int) -> None:
    """Of so many messages in a row every 10 ms, in us."""
    steps = np.tile([10_000, *[gap % (10_000 // messages)] * (messages - 1)], 400)
    steps[0] = 0
    with pytest.raises(LogError, match="not from frame to frame"):
        in_order("a.log", np.asarray(steps * 1000, np.int64), [])


def busmaster(log: list[Frame]) -> str:
    out = ["***BUSMASTER Ver 3.2.2***", "***PROTOCOL CAN***", "***HEX***", "***SYSTEM MODE***"]
    for f in log:
        tenths = (86_390_000_000 + f.us) % 86_400_000_000 // 100  # begins ten seconds before midnight
        hms = (
            f"{tenths // 36_000_000:02d}:{tenths // 600_000 % 60:02d}:{tenths // 10_000 % 60:02d}:{tenths % 10_000:04d}"
        )
        ident = f"0x{f.ident:0{8 if f.extended else 3}X}"
        out.append(f"{hms} Rx {f.bus} {ident} {'x' if f.extended else 's'} {len(f.data)} {spaced(f.data)} ")
    return "\r\n".join([*out, "***[STOP LOGGING SESSION]***"])


def microchip(log: list[Frame]) -> str:
    head = "//---------------------------------\nMicrochip Technology Inc.\nCAN BUS Analyzer\n//-------------------\n"
    return head + "".join(
        f"{f.us // 1000};RX;0x{f.ident:X};{len(f.data)};{''.join(f'0x{b:02X};' for b in f.data)}\n" for f in log
    )


def crtd(log: list[Frame]) -> str:
    return "0.000000 CXX a remark\n" + "".join(
        f"{f.us // 10**6}.{f.us % 10**6:06d} {f.bus}R{29 if f.extended else 11} {f.ident:08X} {spaced(f.data)} \n"
        for f in log
    )


def canhacker(log: list[Frame]) -> str:
    return "Time   ID     DLC Data                    Comment\n" + "".join(
        f"{f.us // 10**6 % 60:02d}.{f.us // 1000 % 1000:03d} {format(f.ident, '08X' if f.extended else '03X'):8s} "
        f"{len(f.data)} {spaced(f.data)} \n"
        for f in log
    )


def carbus(log: list[Frame]) -> str:
    head = f"@ TEXT @ 3 @ 64 @ 0 @ {len(log)} @ 1 @ 00:00:00.001 @\r"
    return head + "".join(
        f"{f.us // 10**6 % 60:02d},{f.us % 10**6:06d}\t{f.bus}\t0004\t"
        f"{format(f.ident, '08X' if f.extended else '03X')}\t"
        f"{len(f.data)}\t{spaced(f.data):23s}\t00000000\t$       \t\r"
        for f in log
    )


def gvret(log: list[Frame], start: int = 0, digits: str = "02X") -> str:
    return "Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8\n" + "".join(
        f"{start + f.us},{f.ident:08X},{str(f.extended).lower()},Rx,{f.bus},{len(f.data)},"
        f"{''.join(format(b, digits) + ',' for b in f.data.ljust(8, bytes(1)))}\n"
        for f in log
    )


def canedge(log: list[Frame]) -> str:
    return "TimestampEpoch;BusChannel;ID;IDE;DLC;DataLength;Dir;EDL;BRS;ESI;RTR;DataBytes\n" + "".join(
        f"{1_600_000_000 + f.us // 10**6}.{f.us % 10**6:06d};{f.bus};{f.ident:X};{f.extended:d};{len(f.data)};"
        f"{len(f.data)};0;0;0;0;0;{f.data.hex().upper()}\n"
        for f in log
    )


TRACES: dict[str, tuple[Callable[[list[Frame]], str], str, int, bool]] = {
    # lines, file, us of a count, whether only the value of an identifier tells its length
    "BUSMASTER": (busmaster, "a.log", 100, False), "Microchip": (microchip, "a.log", 1000, True),
    "Microchip .can": (microchip, "a.can", 1000, True), "CRTD": (crtd, "a.crtd", 1, False),
    "CANHacker": (canhacker, "a.trc", 1000, True), "CARBUS": (carbus, "a.trc", 1, True),
    "SavvyCAN": (gvret, "a.csv", 1, False), "SavvyCAN, below 0": (lambda x: gvret(x, -(10**15)), "a.csv", 1, False),
    "GVRET, 5 for 05": (lambda x: gvret(x, 0, "X"), "a.csv", 1, False), "CANedge": (canedge, "a.csv", 1, False),
}  # fmt: skip


@pytest.mark.parametrize("tool", TRACES)
@given(st.data())
@settings(max_examples=examples(40), deadline=None)
def test_a_tool_s_trace_is_read_to_the_last_bit(tool: str, data: st.DataObject) -> None:
    write, name, unit, value_tells = TRACES[tool]
    log = data.draw(recordings(told=value_tells))
    frames = read(name, write(log))
    assert seen(frames) == sent(log, unit) and frames.notes == []
    if tool not in ("Microchip", "Microchip .can", "CANHacker"):
        assert frames.bus.tolist() == [f.bus for f in log]


@pytest.mark.parametrize("tool", TRACES)
@given(st.data())
@settings(max_examples=examples(40), deadline=None)
def test_a_damaged_trace_is_read_or_refused_in_one_line(tool: str, data: st.DataObject) -> None:
    write, name, _, _ = TRACES[tool]
    raw = bytearray(write(data.draw(recordings())).encode())
    for _ in range(data.draw(st.integers(1, 6))):
        raw[data.draw(st.integers(0, len(raw) - 1))] = data.draw(st.integers(0, 255))
    with tempfile.TemporaryDirectory() as folder:
        (path := Path(folder) / name).write_bytes(raw[: data.draw(st.integers(1, len(raw)))])
        try:
            frames = format_at(path, "frames").read_frames(path)
        except LogError as e:
            assert "\n" not in str(e) and str(path) in str(e)
        else:
            assert (np.diff(frames.t) >= 0).all() and np.isfinite(frames.t).all()
            assert (frames.length <= frames.data.shape[1]).all() and frames.t.size


@given(recordings(longest=64))
@settings(max_examples=examples(40), deadline=None)
def test_a_csv_of_python_can_is_read_as_it_reads_it(log: list[Frame]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.csv"
        with can.CSVWriter(str(path)) as out:
            for f in log:
                out.on_message_received(can_message(f))
                out.on_message_received(can.Message(f.us / 1e6, 5, is_remote_frame=True))
        frames = format_at(path).read_frames(path)
        with can.CSVReader(str(path)) as reader:
            theirs = [m for m in reader if not m.is_remote_frame]
    assert seen(frames) == sent(log)
    assert [bytes(m.data) for m in theirs] == [row[2] for row in seen(frames)]
    assert frames.notes == [f"{len(log)} remote or error frames: left out"]


def can_message(f: Frame) -> can.Message:
    fd = len(f.data) > 8
    return can.Message(f.us / 1e6, f.ident, f.extended, data=f.data, channel=f.bus, is_fd=fd, check=not fd)


@given(recordings(step=10_000))
@settings(max_examples=examples(25), deadline=None)
def test_a_decimal_comma_in_a_peak_trace_is_a_point(log: list[Frame]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.trc"
        with can.TRCWriter(str(path)) as out:
            for f in log:
                out.on_message_received(can_message(f))
        dots = format_at(path).read_frames(path)
        lines = path.read_text().splitlines()
        changed = [line if line.startswith(";") else line.replace(".", ",", 1) for line in lines]
        assert changed != lines
        path.write_text("\n".join(changed))
        assert seen(format_at(path).read_frames(path)) == seen(dots)


@pytest.mark.parametrize(
    ("name", "text", "why"),
    [
        ("a.log", "***BUSMASTER Ver 3.2.2***\n***DEC***\n11:49:12:9420 Rx 1 35 s 1 64\n", "numbers in DEC"),
        ("a.log", "***BUSMASTER Ver 3.2.2***\n11:49:12:9420 Rx 1 0x023 sr 1 \n", "no BUSMASTER frame in it"),
        ("a.trc", "@ TEXT @ 3 @ 64 @\r", "no CARBUS Analyzer frame in it"),
        ("a.csv", "Time Stamp,ID,Extended,Dir,Bus,LEN,D1\nx,y\n", "no SavvyCAN frame in it"),
        ("a.csv", "timestamp,arbitration_id,extended,remote,error,dlc,data\n1,2\n", "no python-can frame in it"),
    ],
)  # fmt: skip
def test_a_trace_without_frames_is_one_line(tmp_path: Path, name: str, text: str, why: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(LogError, match=why):
        read_log(tmp_path / name)


def test_a_busmaster_log_from_line_to_line_is_added_up() -> None:
    text = "***BUSMASTER Ver 3.2.2***\n***RELATIVE MODE***\n" + "".join(
        f"00:00:00:{step:04d} Rx 1 0x023 s 1 {k:02X}\n" for k, step in enumerate((0, 100, 50, 9999))
    )
    assert [row[0] for row in seen(read("a.log", text))] == [0, 10_000, 15_000, 1_014_900]


def test_lines_that_a_tool_did_not_write_are_counted() -> None:
    good = crtd([Frame(0, 1, False, b"\x05", 1), Frame(9, 2, False, b"", 1)])
    frames = read("a.crtd", good + "1.5 1R11 ZZ 00\n2.0 garbage\n2.0 CEV an event\n")
    assert len(frames.t) == 2 and frames.notes == ["2 lines are not CRTD lines: left out"]


# ---- databases -------------------------------------------------------------------------------------------------------

_UNITS = ["°F", "µA", "°", "mm", "Ω", "m³/h", "degC"]


@given(
    st.lists(st.sampled_from(_UNITS), min_size=1, max_size=6),
    st.sampled_from(["utf-8", "utf-8-sig", "cp1252", "utf-16"]),
)
@settings(max_examples=examples(40), deadline=None)
def test_a_database_s_encoding_is_found(units: list[str], encoding: str) -> None:
    units = [u for u in units if encoding != "cp1252" or u != "Ω"] or ["mm"]
    text = 'VERSION ""\nBU_: A\n' + "".join(
        f'BO_ {100 + k} M{k}: 8 A\n SG_ s{k} : 0|8@1+ (1,0) [0|0] "{u}" A\n' for k, u in enumerate(units)
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.dbc"
        path.write_bytes(text.encode(encoding))
        messages, notes = load_dbc(path)
    assert [m.layout.signals[0].unit for m in messages] == units and notes == []


def test_a_database_that_several_editors_changed_is_read_line_by_line(tmp_path: Path) -> None:
    lines = [
        f'BO_ {k} M{k}: 8 A\n SG_ s : 0|8@1+ (1,0) [0|0] "°F" A\n'.encode(c) for k, c in ((1, "utf-8"), (2, "cp1252"))
    ]
    (tmp_path / "a.dbc").write_bytes(b'VERSION ""\nBU_: A\n' + b"".join(lines))
    assert [m.layout.signals[0].unit for m in load_dbc(tmp_path / "a.dbc")[0]] == ["°F", "°F"]


MUX = """VERSION ""
BU_: A
BO_ 291 M: 8 A
 SG_ which M : 0|8@1+ (1,0) [0|15] "" A
 SG_ x_lvdt m0 : 8|16@1+ (0.001,0) [0|60] "mm" A
 SG_ x_lvdt m1 : 16|16@1+ (0.001,0) [0|60] "mm" A
 SG_ x_dem m1 : 32|16@1+ (0.001,0) [0|60] "mm" A
 SG_ p_s m2 : 8|8@1+ (1,0) [0|60] "bar" A
 SG_ p_s m3 : 8|8@1+ (1,0) [0|60] "MPa" A
"""


def by_cantools(layout: Any, name: str, data: bytes) -> float | None:
    """A signal's value in a frame that may be cut; None where it does not reach."""
    found = layout.decode(data, decode_choices=False, allow_truncated=True).get(name) if data else None
    return None if found is None else float(found)


@given(st.lists(st.binary(max_size=8), min_size=1, max_size=20))
@settings(max_examples=examples(60), deadline=None)
def test_every_branch_counts_and_a_frame_is_read_as_far_as_it_reaches(payloads: list[bytes]) -> None:
    payloads = [bytes([d[0] % 4]) + d[1:] if d else d for d in payloads]
    with tempfile.TemporaryDirectory() as folder:
        (dbc := Path(folder) / "m.dbc").write_text(MUX)
        (log := Path(folder) / "a.log").write_text(
            "".join(f"({k}.000000) can0 123#{d.hex()}\n" for k, d in enumerate(payloads))
        )
        source = format_at(log).open(log, Options(dbc, {}))
    layout = cantools.database.load_string(MUX, "dbc").get_message_by_frame_id(291)
    assert {k for k in source.names if "p_s" in k} == {"M.p_s (which=2)", "M.p_s (which=3)"}
    for key, name, branch in (
        ("M.x_lvdt", "x_lvdt", (0, 1)), ("M.x_dem", "x_dem", (1,)), ("M.p_s (which=2)", "p_s", (2,)),
        ("M.p_s (which=3)", "p_s", (3,)),
    ):  # fmt: skip
        want = [(k, by_cantools(layout, name, d)) for k, d in enumerate(payloads) if d and d[0] in branch]
        s = source.series(key)
        assert [k for k, v in want if v is not None] == s.t.tolist()
        assert s.values.tolist() == pytest.approx([v for _, v in want if v is not None])
    short = sum(len(d) < 8 for d in payloads)
    told = f"M: {short} of {len(payloads)} frames are shorter than its 8 bytes: read as far as they reach"
    assert source.notes == ([told] if short else [])


def test_a_database_that_knows_no_frame_and_one_beside_a_table_are_told(tmp_path: Path) -> None:
    (tmp_path / "m.dbc").write_text(MUX.replace("291", "292"))
    (tmp_path / "a.log").write_text("(1.0) can0 123#01\n(2.0) can0 123#01\n")
    (tmp_path / "a.csv").write_text("t,n_dem\n0,50\n1,51\n")
    assert read_log(tmp_path / "a.log", dbc=tmp_path / "m.dbc", require=()).notes == [
        "m.dbc has no message for the log's 1 identifiers (0x123): --dbc F"
    ]
    unused = f"{tmp_path / 'm.dbc'}: not used, as the log holds no frames of a bus"
    assert read_log(tmp_path / "a.csv", dbc=tmp_path / "m.dbc").notes == [unused]
    for options in ({"mapping": {"Pos": "x_dem"}}, {"require": ("n_r",)}):
        with pytest.raises(LogError) as caught:
            read_log(tmp_path / "a.csv", dbc=tmp_path / "m.dbc", **options)  # type: ignore[arg-type]
        assert str(caught.value).endswith(unused)


def test_short_frames_of_a_protected_message_are_left_out() -> None:
    """Its CRC is over all bytes: what it protects cannot be judged."""
    layout = cantools.database.load_string(MUX, "dbc").get_message_by_frame_id(291)
    frames = Frames(
        np.arange(2.0), np.full(2, 291, np.uint32), np.zeros(2, np.int32), np.array([8, 3], np.uint8),
        np.zeros((2, 8), np.uint8),
    )  # fmt: skip
    frames.data[:, 0] = e2e_crc(frames.data, 7)
    rows, notes = select(frames, Message(layout, 291, 7, False, {}))
    assert rows.tolist() == [0] and notes == ["M: 1 of 2 frames are shorter than its 8 bytes: left out"]
