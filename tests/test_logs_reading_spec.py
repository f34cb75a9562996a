"""Reading a log: whatever is recorded is read at its time and in its unit, and what is left out is told with its rows.

Each file is made here, so that what must be read of it is known.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.logs import Channel, Format, Log, LogError, Options, formats, layout, offered, read_log, write_log
from hil.logs.formats import format_at, format_of, listed, spoken
from hil.logs.guess import feed_forward, mean_stroke, planned_angles
from hil.logs.notes import MOST_ROWS, Note
from hil.logs.scale import proposed_scale
from hil.logs.source import Samples, Series
from hil.logs.units import UnitError, Units, factor_of, scale_of
from tests.small_logs import read
from tests.small_logs import written as made


def refused(file: Path, **options: Any) -> str:
    with pytest.raises(LogError) as caught:
        read(file, **options)
    return str(caught.value).replace(str(file), "LOG")


def noted(log: Log) -> list[tuple[str, str, int, tuple[int, ...]]]:
    """What was done to the log, as data."""
    return [(n.kind, n.of, n.number, n.rows) for n in log.notes if isinstance(n, Note)]


# ---- what is left out is counted, with its rows ----------------------------------------------------------------------


@pytest.mark.parametrize("before", ["", "# of the bench\n", "# of the bench\n\n"])
@pytest.mark.parametrize("units", ["", "s,%,mm\n"])
def test_a_number_that_is_none_is_told_by_its_row_in_the_file(tmp_path: Path, before: str, units: str) -> None:
    rows = [f"{k},50,{'inf' if k in (3, 7) else 'nan' if k == 5 else ''}\n" for k in range(9)]
    rows[1] = "1,,4\n"
    file = made(tmp_path, f"{before}t,n_dem,x_dem\n{units}" + "".join(rows))
    first = 2 + before.count("\n") + units.count("\n")
    log = read(file)
    assert log.channels["x_dem"].values.tolist() == [4.0] and log.channels["n_dem"].t.size == 8
    assert noted(log) == [("left out", "x_dem", 3, (first + 3, first + 5, first + 7))]
    assert log.notes == ["x_dem (x_dem): 3 of 9 samples are NaN or infinite: left out"]


def test_of_many_rows_the_first_twenty_are_listed_and_all_are_counted(tmp_path: Path) -> None:
    rows = "".join(f"{k},{'nan' if k % 3 == 0 else 50}\n" for k in range(90))
    log = read(made(tmp_path, "t,n_dem\n" + rows))
    assert noted(log) == [("left out", "n_dem", 30, tuple(2 + 3 * k for k in range(20)))] and MOST_ROWS == 20


def test_rows_of_one_time_are_told_but_for_the_last(tmp_path: Path) -> None:
    t = [0, 1, 1, 1, 2, 3, 3, 4, 5, 6]
    log = read(made(tmp_path, "t,n_dem,x_dem\n" + "".join(f"{s},{50 + k},\n" for k, s in enumerate(t))))
    assert log.channels["n_dem"].values.tolist() == [50, 53, 54, 56, 57, 58, 59]
    assert noted(log) == [("left out", "n_dem", 3, (3, 4, 7))] and "3 of 10 samples" in log.notes[0]
    many = [s // 2 for s in range(60)]
    log = read(made(tmp_path, "t,n_dem\n" + "".join(f"{s},50\n" for s in many)))
    assert noted(log) == [("left out", "n_dem", 30, tuple(2 + 2 * k for k in range(20)))]


def test_rows_of_one_time_behind_a_cell_without_a_sample_keep_their_numbers(tmp_path: Path) -> None:
    cells = ["50", "nan", "51", "", "52", "53", "54", "55"]
    times = [0, 1, 2, 3, 4, 4, 5, 6]
    log = read(made(tmp_path, "t,n_dem\n" + "".join(f"{s},{c}\n" for s, c in zip(times, cells, strict=True))))
    assert log.channels["n_dem"].values.tolist() == [50, 51, 53, 54, 55]
    assert noted(log) == [("left out", "n_dem", 1, (3,)), ("left out", "n_dem", 1, (6,))]


def test_time_that_runs_backwards_is_refused_at_the_row_where_it_falls(tmp_path: Path) -> None:
    times = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15]
    cells = ["nan" if k in (2, 13) else "50" for k in range(len(times))]
    file = made(tmp_path, "t,n_dem\n" + "".join(f"{s},{c}\n" for s, c in zip(times, cells, strict=True)))
    assert refused(file) == "LOG: n_dem (n_dem): time runs backwards at row 16, from 12 s to 2 s"


def test_a_few_wild_samples_and_one_side_of_a_jump_are_counted(tmp_path: Path) -> None:
    rows = [f"{k},{-40 if k in (2, 9) else 50}\n" for k in range(30)]
    assert noted(read(made(tmp_path, "t,n_dem\n" + "".join(rows)))) == [("left out", "n_dem", 2, ())]
    jump = [f"{k},50,\n" for k in range(12)] + [f"{1e6 + k},51,{k}\n" for k in range(30)]
    log = read(made(tmp_path, "t,n_dem,x_dem\n" + "".join(jump)))
    assert ("left out", "time", 12, ()) in noted(log) and log.channels["x_dem"].t.size == 30
    assert ("converted", "time", 30, ()) in noted(log)


def test_a_channel_without_a_sample_that_can_be_used_is_told(tmp_path: Path) -> None:
    log = read(made(tmp_path, "t,n_dem,x_dem\n0,nan,1\n1,inf,2\n"))
    assert list(log.channels) == ["x_dem"]
    assert log.notes == [
        "n_dem (n_dem): 2 of 2 samples are NaN or infinite: left out", "n_dem (n_dem): no sample that can be used"
    ]  # fmt: skip
    assert read(made(tmp_path, "t,n_dem,x_dem\n")).notes == []  # no row at all


def test_a_note_is_said_once_however_many_channels_it_is_of(tmp_path: Path) -> None:
    rows = "".join(f"{5 if k == 20 else k},50,51,9\n" for k in range(40))
    log = read(made(tmp_path, "t,n_dem,n_r,x_dem\n" + rows))
    assert log.notes == ["time: 1 of 40 rows have a wrong time stamp (first row 22: 5 s): left out"]
    assert noted(log) == [("left out", "time", 1, (22,))] and all(c.t.size == 39 for c in log.channels.values())


# ---- what is required ------------------------------------------------------------------------------------------------


def test_the_demand_is_required_where_it_is_one_of_the_signals(tmp_path: Path) -> None:
    file = made(tmp_path, "t,x_dem,load\n0,1,5\n1,2,6\n")
    with pytest.raises(LogError, match="no n_dem: looked for column 'n_dem'"):
        read_log(file)
    assert list(read_log(file, signals={"load": "N"}).channels) == ["load"]
    assert list(read_log(file, require=("x_dem",)).channels) == ["x_dem"]


def test_what_is_required_says_why_it_is_not_there(tmp_path: Path) -> None:
    nothing = made(tmp_path, "t,n_dem,x_dem\n0,nan,1\n1,nan,2\n")
    assert refused(nothing, require=("n_dem",)) == (
        "LOG: no n_dem: looked for column 'n_dem' (n_dem (n_dem): 2 of 2 samples are NaN or infinite: left out; n_dem "
        "(n_dem): no sample that can be used); --map NAME=n_dem names another; the file has 3 columns: t, n_dem, x_dem"
    )
    (tmp_path / "m.toml").write_text("[names]\nn_dem = 'N1'\n")
    lacking = made(tmp_path, "t,x_dem\n0,1\n1,2\n")
    assert refused(lacking, require=("n_dem",), mapping_file=tmp_path / "m.toml") == (
        f"LOG: no n_dem: looked for column 'n_dem' ({tmp_path / 'm.toml'} calls it 'N1', which the log does not have); "
        "--map NAME=n_dem names another; the file has 2 columns: t, x_dem"
    )
    two = made(
        tmp_path, "t,speed_cmd_pct,speed_set_pct\n" + "".join(f"{k},{50 + k % 7},{50 + k % 7}\n" for k in range(30))
    )
    assert "(may be 'speed_cmd_pct' or 'speed_set_pct': not guessed; --map NAME=n_dem takes one)" in refused(
        two, require=("n_dem",)
    )


def test_a_speed_that_waits_for_its_design_speed_is_refused_where_it_is_needed(tmp_path: Path) -> None:
    rows = "".join(f"{k},{9000 + 2 * k},{20 + 0.5 * k}\n" for k in range(30))
    file = made(tmp_path, "t,speed_act_rpm,x_dem\n" + rows)
    words = "'speed_act_rpm' is in rpm and needs the design speed to become %: --design-rpm 9100"
    assert refused(file, require=("n_r",)).startswith(f"LOG: n_r: {words}")
    log = read(file)
    assert list(log.channels) == ["x_dem"] and sum(n.startswith(f"n_r: {words}") for n in log.notes) == 1
    assert sum(n.startswith("n_r:") for n in log.notes) == 1  # told once
    alone = made(tmp_path, "t,speed_act_rpm,foo\n" + rows)
    assert refused(alone).startswith(f"LOG: n_r: {words}")  # it is all that the log has
    assert read(file, design_rpm=9000.0).channels["n_r"].values[0] == pytest.approx(100.0)


def test_a_database_beside_a_table_is_told_and_stands_in_a_refusal(tmp_path: Path) -> None:
    file = made(tmp_path, "t,n_dem\n0,50\n1,51\n")
    dbc = made(tmp_path, "", "x.dbc")
    said = f"{dbc}: not used, as the log holds no frames of a bus"
    assert read(file, dbc=dbc).notes == [said]
    assert refused(file, dbc=dbc, require=("x_dem",)).endswith(f"; {said}")
    assert refused(file, dbc=dbc, mapping={"M.X": "x_dem"}).endswith(f"; {said}")


# ---- units and scale -------------------------------------------------------------------------------------------------


def test_a_unit_that_does_not_say_it_is_proposed_where_another_signal_does(tmp_path: Path) -> None:
    """A stroke in volts of its transducer, beside its demand in mm."""
    t = 0.05 * np.arange(300)
    x = 24.0 + 10.0 * np.sin(t)
    rows = "".join(f"{a:g},{b:.6f},{b / 4.8:.6f}\n" for a, b in zip(t, x, strict=True))
    file = made(tmp_path, "t,x_dem,x_lvdt [V]\n" + rows)
    said = refused(file)
    assert said.startswith("LOG: x_lvdt (x_lvdt [V]) in 'V': unit does not convert; allowed: mm or what converts to it")
    assert said.endswith("; it follows x_dem with --unit 'x_lvdt=4.8*mm'")
    log = read(file, units={"x_lvdt": "4.8*mm"})
    assert log.channels["x_lvdt"].values == pytest.approx(x, abs=1e-5)
    unknown = made(tmp_path, "t,x_dem,x_lvdt [ticks]\n" + rows)
    assert refused(unknown) == (
        "LOG: x_lvdt (x_lvdt [ticks]): unit 'ticks' is not known, and it is not mm; it follows x_dem with --unit "
        "'x_lvdt=4.8*mm'"
    )
    alone = made(tmp_path, "t,n_dem,x_lvdt [V]\n" + "".join(f"{k},50,{20 + k % 7}\n" for k in range(60)))
    assert refused(alone).endswith("with gain and zero --unit 'x_lvdt=2.5*mm-10')")  # nothing there says it


def test_gain_and_zero_of_a_text_are_those_of_arithmetic() -> None:
    for text, want in {
        "mm": (1.0, "mm", 0.0), "-mm": (-1.0, "mm", 0.0), " 2.5*mm ": (2.5, "mm", 0.0), "0.1 mA": (0.1, "mA", 0.0),
        "17.14*mm-12": (17.14, "mm", -12.0), "-deg+80": (-1.0, "deg", 80.0), "-2*deg - 1.5": (-2.0, "deg", -1.5),
        "1e-3*mm": (1e-3, "mm", 0.0), ".5*mA": (0.5, "mA", 0.0), "2.*mA": (2.0, "mA", 0.0), "mm+1e1": (1.0, "mm", 10.0),
        "%-30": (1.0, "%", -30.0), "1/min": (1.0, "1/min", 0.0), "-1/min": (-1.0, "1/min", 0.0), "-": (1.0, "-", 0.0),
        "": (1.0, "", 0.0), "n/a": (1.0, "n/a", 0.0), "- none": (-1.0, "none", 0.0), "?": (1.0, "?", 0.0),
        "2*m/s": (2.0, "m/s", 0.0), "rad/s": (1.0, "rad/s", 0.0), "-?": (-1.0, "?", 0.0),
    }.items():  # fmt: skip
        assert scale_of(text) == want, text


def test_gain_goes_before_the_unit_and_the_zero_is_in_it() -> None:
    """The number times the gain plus the zero is in the stated unit, which is then brought to the signal's own."""
    given = np.array([0.0, 4.0, 10.0])
    for stated, want in {
        "2*cm": 20.0 * given, "2*cm+1": 20.0 * given + 10.0, "-cm-1": -10.0 * given - 10.0, "0.5*inch": 12.7 * given,
        "mm+3": given + 3.0, "3*mm": 3.0 * given,
    }.items():  # fmt: skip
        out = Units(Path("LOG"), {"x_dem": stated}, None, []).convert("x_dem", "k", given, "bar")
        assert out == pytest.approx(want), stated
    speed = Units(Path("LOG"), {"n_r": "2*rpm+100"}, 5000.0, [])
    assert speed.convert("n_r", "k", given, "") == pytest.approx((2.0 * given + 100.0) / 50.0)
    kept = Units(Path("LOG"), {}, None, []).convert("x_dem", "k", given, "mm")
    assert kept is given  # no number is touched that is right


def test_a_unit_of_no_signal_of_ours_is_that_of_the_table_given() -> None:
    own = Units(Path("LOG"), {}, None, [], {"load": "kN", "speed": "rpm"})
    assert own.convert("load", "k", np.array([1500.0]), "N") == pytest.approx([1.5])
    assert own.convert("speed", "k", np.array([2.0]), "Hz") == pytest.approx([120.0])
    assert own.convert("t", "k", np.array([2.0]), "min") == pytest.approx([120.0])
    with pytest.raises(UnitError) as caught:
        own.convert("load", "k", np.array([1.0]), "mm")
    assert (caught.value.signal, caught.value.key) == ("load", "k") and "allowed: kN or" in str(caught.value)
    assert own.unknown == {}
    own.convert("load", "k", np.array([1.0]), "quux")
    (note,) = own.notes
    assert own.unknown == {"load": "quux"} and isinstance(note, Note) and (note.kind, note.of) == ("guessed", "load")
    assert note.number == 1 and note == "load (k): unit 'quux' is not known, kN assumed"


@pytest.mark.parametrize(
    ("text", "unit"),
    [("m^2", True), ("m**2/m", True), ("m^10", False), ("m**-10", False), ("m^2^2", False), ("m**2**2", False),
     ("m/999", False), ("1000*m", False), ("m" * 33, False), ("m;m", False), ("mm\u00b3", False), ("0*m", False)],
)  # fmt: skip
def test_a_text_is_a_unit_only_where_it_cannot_keep_anybody_busy(text: str, unit: bool) -> None:
    assert (factor_of(text, "mm") is not None) == unit


def test_offsets_of_temperatures_are_those_of_the_books() -> None:
    for unit, t, want in (("K", 273.15, 0.0), ("degF", 212.0, 100.0), ("degF", 32.0, 0.0), ("c", 17.0, 17.0)):
        a, b = factor_of(unit, "degC")  # type: ignore[misc]
        assert a * t + b == pytest.approx(want, abs=1e-9), unit  # type: ignore[operator]


SPEEDS = 0.05 * np.arange(500)


def test_a_stroke_and_a_vane_follow_the_schedule_where_no_peer_is_there() -> None:
    n = 70.0 + 18.0 * np.sin(0.4 * SPEEDS)
    at, curve = mean_stroke({})
    x = np.interp(n, at, curve)
    for speed in ("n_r", "n_dem"):
        channels = {speed: (SPEEDS, n)}
        for signal in ("x_dem", "x_lvdt"):
            assert proposed_scale(signal, (SPEEDS, x / 4.8), channels, {}) == ("4.8*mm", "the schedule")
            assert proposed_scale(signal, (SPEEDS, x), channels, {}) is None
        angle = planned_angles(n, {})["vgv2"]
        assert proposed_scale("vgv2", (SPEEDS, angle / 30.0), channels, {}) == ("30*deg", "the schedule")
        assert proposed_scale("p_s", (SPEEDS, n), channels, {}) is None  # nothing is known to go with it
    # the measured speed goes before the demanded one, and a peer before the schedule
    both = {"n_dem": (SPEEDS, n[::-1].copy()), "n_r": (SPEEDS, n)}
    assert proposed_scale("x_dem", (SPEEDS, x / 4.8), both, {}) == ("4.8*mm", "the schedule")
    assert proposed_scale("x_dem", (SPEEDS, x / 4.8), {**both, "x_lvdt": (SPEEDS, 2.0 * x)}, {}) == (
        "9.6*mm", "x_lvdt"
    )  # fmt: skip


def test_a_peer_that_says_nothing_leaves_the_schedule_to_say_it() -> None:
    n = 70.0 + 18.0 * np.sin(0.4 * SPEEDS)
    x = np.interp(n, *mean_stroke({}))
    noise = np.random.default_rng(7).standard_normal(SPEEDS.size)
    for peer in ((SPEEDS, np.full(SPEEDS.size, 9.0)), (SPEEDS, noise), (SPEEDS[:40], x[:40])):
        found = proposed_scale("x_dem", (SPEEDS, x / 4.8), {"x_lvdt": peer, "n_r": (SPEEDS, n)}, {})
        assert found == ("4.8*mm", "the schedule")


def test_a_peer_counts_where_both_were_sampled() -> None:
    """Of a peer that begins later and ends earlier, the 50 samples within; outside anything may be."""
    t = 0.1 * np.arange(200)
    x = 24.0 + 10.0 * np.sin(t)
    own = np.where((t >= 4.0) & (t <= 15.0), x / 5.0, 900.0)
    inside = (t >= 4.0) & (t <= 15.0)
    channels = {"x_lvdt": (t[inside], x[inside])}
    assert proposed_scale("x_dem", (t, own), channels, {}) == ("5*mm", "x_lvdt")
    short = (t >= 4.0) & (t < 8.95)
    assert np.count_nonzero(short) == 50
    assert proposed_scale("x_dem", (t, x / 5.0), {"x_lvdt": (t[short], x[short])}, {}) == ("5*mm", "x_lvdt")
    assert proposed_scale("x_dem", (t, x / 5.0), {"x_lvdt": (t[short][1:], x[short][1:])}, {}) is None


def valve(t: np.ndarray, x: np.ndarray) -> np.ndarray:
    """The current of a valve with a dead band of 0.4 mA that moves the stroke so, mA."""
    v = (np.interp(t + 0.1, t, x) - np.interp(t - 0.1, t, x)) / 0.2
    return np.asarray(feed_forward({}) * v + 0.4 * np.sign(v))


def test_a_current_is_told_by_the_stroke_that_moves() -> None:
    t = 0.01 * np.arange(3000)
    x = 24.0 + 12.0 * np.sin(0.6 * t)
    i = valve(t, x)

    def of(values: np.ndarray, at: np.ndarray = t, **strokes: Any) -> Any:
        return proposed_scale("i_cmd", (at, values), strokes or {"x_lvdt": (t, x)}, {})

    assert of(i / 1.19) is None and of(i / 1.23) == ("1.2*mA", "the rate of x_lvdt")  # as well as the rate says it
    assert of(i / 0.78) == ("0.8*mA", "the rate of x_lvdt") or of(i / 0.78) == ("0.78*mA", "the rate of x_lvdt")
    assert of(i - 4.9) is None and of(i - 5.2) == ("mA+5.2", "the rate of x_lvdt")
    ramp = 2.0 * t  # one way at one speed: gain and zero are one
    assert of(valve(t, ramp) / 40.0, x_lvdt=(t, ramp)) is None
    spread = np.std(i) * np.sqrt(1.0 / 0.97**2 - 1.0)  # as loose as a correlation of 0.97
    noise = np.random.default_rng(5).standard_normal(t.size)
    slow = np.interp(t, t[::40], noise[::40])  # what the mean over a fifth of a second leaves
    slow *= spread / np.std(slow)
    assert of((i + 0.6 * slow) / 40.0) is not None and of((i + 1.6 * slow) / 40.0) is None
    # the measured stroke first; a demand where it has too few samples
    assert of(i / 40.0, x_lvdt=(t[:49], x[:49]), x_dem=(t, x)) == ("40*mA", "the rate of x_dem")
    assert of(i / 40.0, x_lvdt=(t, x), x_dem=(t, x[::-1].copy())) == ("40*mA", "the rate of x_lvdt")
    few = t[1000:1045]  # of the current
    assert of(i[1000:1045] / 40.0, few) is None


# ---- formats ---------------------------------------------------------------------------------------------------------


def test_a_format_says_what_it_cannot_do_and_which_can(tmp_path: Path) -> None:
    path = tmp_path / "a.crtd"
    crtd = format_of(path)
    channels = {"n_dem": Channel(np.arange(2.0), np.full(2, 50.0))}
    for act, said in (
        (lambda: crtd.write(path, channels, None), "CRTD cannot be written; allowed: .mf4, .dat, .mdf, .csv, .msl, "),
        (lambda: crtd.write_frames(path, None), "CRTD cannot be written as frames; allowed: .log, .asc, .blf, .trc, "),
        (lambda: crtd.record(path, "can0"), "CRTD cannot be recorded to; allowed: .log, .blf, .mf4, .parquet"),
        (lambda: crtd.read_recording(path), "CRTD cannot be read as a recording; allowed: .log, .asc, .blf, .trc, "),
        (lambda: format_of(Path("a.csv")).read_frames(path), "CSV cannot be read as frames; allowed: .log, .can, "),
        (lambda: Format("none", (".x",)).open(path, Options(None, {})), "none cannot be read; allowed: .mf4, .dat, "),
    ):
        with pytest.raises(LogError) as caught:
            act()  # type: ignore[no-untyped-call]
        assert str(caught.value).startswith(f"{path}: {said}")
    assert crtd.said_by(path) == {} and format_of(Path("a.parquet")).said_by(path) == {}


def test_formats_are_named_in_words() -> None:
    some = [format_of(Path(f"a{s}")) for s in (".log", ".blf", ".dat")]
    assert listed(some) == ".log, .blf, .dat, .mdf" and listed([*some, *some]) == listed(some) and listed([]) == ""
    assert spoken(some) == "candump (.log), BLF (.blf) or MDF3 (.dat, .mdf)" and spoken(some[:1]) == "candump (.log)"
    assert spoken(some[:2]) == "candump (.log) or BLF (.blf)"


def test_a_file_is_of_the_format_that_it_begins_as(tmp_path: Path) -> None:
    for name, head, called in (
        ("a.log", b"(1.0) can0 123#00\n", "candump"), ("a.log", b"***BUSMASTER Ver 3***\n", "BUSMASTER"),
        ("a.LOG", b"//---\n", "Microchip CAN BUS Analyzer"), ("a.log", b"", "candump"),
        ("a.csv", b"t,n_dem\n", "CSV"), ("a.csv", b"\xef\xbb\xbftimestamp,arbitration_id,x\n", "frames in CSV"),
        ("a.trc", b";$FILEVERSION=2.1\n", "PEAK trace"), ("a.trc", b"@ TEXT @\n", "CARBUS Analyzer"),
        ("a.trc", b"?", "PEAK trace"), ("a.can", b"?", "Microchip CAN BUS Analyzer"),
    ):  # fmt: skip
        file = made(tmp_path, head, name)
        assert format_at(file).name == called and format_of(file).name in ("candump", "CSV", "PEAK trace", called)
        assert formats.is_framed(file) == (called != "CSV")
    assert format_at(tmp_path / "none.log").name == "candump" and not formats.is_framed(tmp_path / "a.txt")
    assert format_at(made(tmp_path, b"***BUSMASTER", "a.log"), "recorder").name == "candump"  # which can be recorded to
    with pytest.raises(LogError, match=r"suffix '.csv' is none of a bus; allowed: .log, .can"):
        format_of(Path("a.csv"), "frames", "is none of a bus")
    assert [f.name for f in formats.with_part("recorder")] == ["candump", "BLF", "MDF4", "Parquet"]


def test_a_file_of_no_suffix_of_a_log_is_told_by_its_content(tmp_path: Path) -> None:
    for head, said in (
        (b"PK\x03\x04rest", "; it is a workbook, or another archive: save its table as CSV"),
        (b"\xef\xbb\xbfLabVIEW Measurement\t", "; it begins as LabVIEW measurement does (.lvm)"),
        (b"UnFinMF 4.10", "; it begins as MDF4 does (.mf4)"), (b"MDF     2.0", "; it begins as MDF3 does (.dat)"),
        (b" PAR1", ""), (b"", ""),
    ):  # fmt: skip
        file = made(tmp_path, head, "a.xyz")
        with pytest.raises(LogError) as caught:
            format_at(file)
        assert str(caught.value).startswith(f"{file}: suffix '.xyz' is not a log's; allowed: .log, ")
        assert str(caught.value).endswith(f"parquet{said}")
        with pytest.raises(LogError) as caught:
            format_at(file, "recorder")
        assert str(caught.value).endswith(" .log, .blf, .mf4, .parquet")


def test_a_format_whose_extra_is_missing_asks_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[str, ...]] = []
    monkeypatch.setattr(formats, "needs", lambda *given: asked.append(given))
    format_of(Path("a.csv")).check(Path("a.csv"))
    assert asked == []
    format_of(Path("a.mf4")).check(Path("a.mf4"))
    assert asked == [("a.mf4: MDF4", *formats.EXTRAS["mdf"])]


# ---- tables of text --------------------------------------------------------------------------------------------------


def columns(file: Path, **options: Any) -> dict[str, tuple[list[float], list[float]]]:
    return {n: (c.t.tolist(), c.values.tolist()) for n, c in read(file, **options).channels.items()}


def test_each_column_may_be_asked_for_after_the_others(tmp_path: Path) -> None:
    """A column of words is read only where somebody asks for it; the others are as they were."""
    file = made(tmp_path, "t,a,n_dem,b,word\n0,1,50,7,x\n1,2,51,8,y\n")
    source = format_at(file).open(file, Options(None, {}))
    assert source.series("b").values.tolist() == [7, 8] and source.series("n_dem").values.tolist() == [50, 51]
    assert source.series("a").values.tolist() == [1, 2] and source.series("a").t.tolist() == [0, 1]
    with pytest.raises(LogError, match="column 'word', row 2: 'x' is not a number"):
        source.series("word")
    assert offered(file) == ["t", "a", "n_dem", "b", "word"]
    assert (source.series("a").first, source.series("a").word) == (2, "row")


@pytest.mark.parametrize("rows", [1, 3, 199, 200, 201, 500])
def test_a_decimal_comma_is_found_wherever_it_first_stands(tmp_path: Path, rows: int) -> None:
    cells = [f"{k};{50 + k % 9}" for k in range(rows - 1)] + [f"{rows};51,25"]
    log = columns(made(tmp_path, "t;n_dem\n" + "\n".join(cells) + "\n"))
    assert log["n_dem"][1][-1] == 51.25 and len(log["n_dem"][1]) == rows


def test_cells_of_a_labview_file_have_the_units_of_its_header(tmp_path: Path) -> None:
    head = (
        "LabVIEW Measurement\t\nSeparator\tTab\nDecimal_Separator\t{sign}\nX_Columns\t{x}\n***End_of_Header***\t\n\t\n"
        "Channels\t2\nY_Unit_Label\trpm\tcm\nX_Dimension\tTime\tTime\nDelta_X\t{step}\t{step}\nX0\t{start}\t0\n"
        "***End_of_Header***\t\n"
    )
    two = "X_Value\tn_dem\tx_dem\n"
    one = head.format(sign=".", x="One", step="0.5", start="2.5") + two + "1.5\t500\t2\n2\t600\t3\n"
    log = columns(made(tmp_path, one, "a.lvm"), design_rpm=1000.0)
    assert log == {"n_dem": ([1.5, 2.0], [50.0, 60.0]), "x_dem": ([1.5, 2.0], [20.0, 30.0])}
    comma = head.format(sign=",", x="One", step="0,5", start="2,5") + two + "1,5\t500\t2\n2\t602,5\t3\n"
    assert columns(made(tmp_path, comma, "a.lvm"), design_rpm=1000.0)["n_dem"] == ([1.5, 2.0], [50.0, 60.25])
    none = head.format(sign=",", x="No", step="0,5", start="2,5") + two + "\t500\t2\n\t600\t3\n"
    assert columns(made(tmp_path, none, "a.lvm"), design_rpm=1000.0)["x_dem"] == ([2.5, 3.0], [20.0, 30.0])
    multi = head.format(sign=".", x="Multi", step="0.5", start="0")
    multi += "X_Value\tn_dem\tX_Value\tx_dem\n0\t500\t0.25\t2\n1\t600\t1.25\t3\n"
    assert columns(made(tmp_path, multi, "a.lvm"), design_rpm=1000.0) == {
        "n_dem": ([0.0, 1.0], [50.0, 60.0]), "x_dem": ([0.25, 1.25], [20.0, 30.0])
    }  # fmt: skip
    bad = head.format(sign=".", x="No", step="often", start="0") + two + "\t500\t2\n"
    assert refused(made(tmp_path, bad, "a.lvm"), design_rpm=1000.0) == (
        "LOG: has no times, and its step (Delta_X='often') is no number"
    )


def test_a_table_is_written_and_read_in_every_text_format(tmp_path: Path) -> None:
    made_of = {
        "n_dem": Channel(np.array([0.0, 0.5, 2.0]), np.array([50.0, -1.25, 1e-7])),
        "load_cell": Channel(np.array([0.5, 1.0]), np.array([3.0, 4.0]), unit="kN"),
    }
    for suffix, lines in (
        (".csv", ["t,n_dem,load_cell [kN]", "0,50,", "0.5,-1.25,3", "1,,4", "2,1e-7,"]),
        (".msl", ['"VaneLoop"', '"Capture Date: "', "Time\tn_dem\tload_cell", "s\t%\tkN", "0\t50\t", "0.5\t-1.25\t3"]),
    ):
        write_log(tmp_path / f"a{suffix}", made_of)
        assert (tmp_path / f"a{suffix}").read_text().splitlines()[: len(lines)] == lines
    write_log(tmp_path / "a.lvm", made_of)
    text = (tmp_path / "a.lvm").read_text().splitlines()
    assert "Channels\t2" in text and "Samples\t4\t4" in text and "Y_Unit_Label\t%\tkN" in text
    assert text[-5:] == ["X_Value\tn_dem\tload_cell", "0\t50\t", "0.5\t-1.25\t3", "1\t\t4", "2\t1e-7\t"]
    for suffix in (".csv", ".msl", ".lvm", ".parquet"):
        write_log(tmp_path / f"a{suffix}", made_of)
        again = read(tmp_path / f"a{suffix}", signals={"n_dem": "%", "load_cell": "kN"})
        for name, c in made_of.items():
            assert again[name].t.tolist() == c.t.tolist() and again[name].values.tolist() == c.values.tolist()


def test_a_name_or_a_unit_that_a_table_cannot_hold_is_refused(tmp_path: Path) -> None:
    t = np.arange(2.0)
    for name, unit, fine in (
        ("load", "kN", True), ("load", "-", True), ("load", "", False), ("2load", "kN", False), ("lo ad", "kN", False),
        ("load", "k;N", False), ("load", "x" * 32, True), ("load", "x" * 33, False), ("load", "[kN]", False),
    ):  # fmt: skip
        channels = {name: Channel(t, t, unit=unit)}
        if fine:
            write_log(tmp_path / "a.csv", channels)
            assert list(read(tmp_path / "a.csv", signals={"load": unit}).channels) == ["load"]
        else:
            with pytest.raises(LogError, match=r"or in a table any name of letters and digits with a unit$"):
                write_log(tmp_path / "a.csv", channels)
        with pytest.raises(LogError) as caught:  # frames carry what their database has
            write_log(tmp_path / "a.log", channels)
        assert "is not a signal" in str(caught.value) and "in a table" not in str(caught.value)


def test_the_series_of_a_source_in_memory_are_its_own() -> None:
    series = Series(np.arange(2.0), np.arange(2.0), "mm", "s", "row", 7)
    source = Samples({"a": series}, ["so"])
    assert source.series("a") is series and source.notes == ["so"] and source.names == {"a": ("a",)}
    assert source.has() == "; the file has 1 channel: a" and source.absent("b") == "" and not source.sorted
    assert (Series(np.empty(0), np.empty(0)).word, Series(np.empty(0), np.empty(0)).first) == ("sample", 1)


# ---- where a table begins and how its cells are written --------------------------------------------------------------


def laid(text: str | bytes, mapping: dict[str, str] | None = None) -> layout.Layout:
    raw = text if isinstance(text, bytes) else text.encode()
    return layout.layout_of(Path("LOG"), raw, Options(None, mapping or {}))


@pytest.mark.parametrize(("before", "row"), [
    ("", 1), ("\n\n", 3), ("# a, b\n# c\n", 3), ("sep=;\n", 2), ("Rig 5\nDate: 2026-03-14\n", 3),
    ('"Rig; 5";"of"\n', 2),
    ("\n".join(f"key {k}; value" for k in range(58)) + "\n", 59),
])  # fmt: skip
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_a_header_is_the_line_of_words_above_rows_as_long(before: str, row: int, end: str) -> None:
    text = f"{before}t;n_dem;x_dem\n0;50;1\n1;51;2\n".replace("\n", end)
    found = laid(text)
    assert (found.headers, found.keys, found.separator) == (["t", "n_dem", "x_dem"],) * 2 + (";",)
    assert (found.head.row, found.first, found.least) == (row, row + 1, 3) and found.under is None
    assert text[found.at :].startswith("0;50;1") and text[found.head.at :].startswith("t;n_dem")
    assert not found.comma and not found.thousands and found.units == {}


def test_of_several_lines_of_words_the_one_with_a_time_is_the_header() -> None:
    table = "a;b;c\nUhrzeit;n_dem;x_dem\n0;50;1\n1;51;2\n"
    assert laid(table).headers == ["Uhrzeit", "n_dem", "x_dem"] and laid(table).opens == {"a"}
    assert laid(table, {"b": "t"}).headers == ["a", "b", "c"]  # the user says what the time is called
    assert laid(table.replace("a;b;c", "a;b [s];c"), {"b": "t"}).headers == ["a", "b [s]", "c"]
    assert laid("a;b;c\nd;e;f\n0;50;1\n1;51;2\n").headers == ["a", "b", "c"]
    assert laid("a;b\nt;n;x\n0;50;1\n1;51;2\n").headers == ["t", "n", "x"]  # as many cells as the rows
    assert laid("t;n;x\n").headers == ["t", "n", "x"]  # no row at all
    assert laid("t;n;x;\n0;50;1;\n1;51;2;\n").headers == ["t", "n", "x", ""]
    assert laid("t;n;x\n0;50;1;\n1;51;2;\n").headers == ["t", "n", "x"]  # rows that end with a separator


def test_the_separator_is_that_of_the_most_rows_and_cells() -> None:
    rows = "".join(f"{k},5;{50 + k},25\n" for k in range(9))
    assert laid("t;n_dem\n" + rows).separator == ";" and laid("t;n_dem\n" + rows).comma
    assert laid("t\tn_dem|x\n0\t50\n1\t51\n").separator == "\t"
    assert laid("only\n").separator == "," and laid("a|b|c,d\n").separator == "|"


def test_each_column_has_a_key_of_its_own() -> None:
    found = laid("t,a,a,,a,a.2,\n0,1,2,3,4,5,6\n")
    assert found.keys == ["t", "a", "a.3", "", "a.4", "a.2", ""]
    assert found.headers == ["t", "a", "a", "", "a", "a.2", ""]
    assert layout._once(["a", "a", "a"]) == ["a", "a.2", "a.3"]
    assert layout._once(["a", "a.2", "a"]) == ["a", "a.2", "a.3"]
    assert found.least == 6  # the last cell may lack
    for word in ("remark", "Comments", "Bemerkung", "NOTE"):
        assert laid(f"t,n,{word}\n0,1,x\n").least == 2 and laid(f"t,{word},n\n0,x,1\n").least == 3
    assert laid(",,\n0,1,2\n").least == 1


def test_units_under_a_header_are_at_least_half_of_its_words() -> None:
    def of(text: str, n: int = 3) -> dict[str, str]:
        return layout.units_row(text, ["t", "n", "", "x"][:n], ",")

    assert of("s,rpm,-") == {"t": "s", "n": "rpm"} and of("[s],(rpm),") == {"t": "s", "n": "rpm"}
    assert of("s,quux,mm", 3) == {"t": "s", "n": "quux"}  # a column without a name has no unit
    assert of("s,quux,foo") == {} and of("s,1,mm") == {} and of("-,,none") == {} and of("") == {}
    assert of("s,mm,mm,mm") == {} and of("s") == {"t": "s"} and of(" s , rpm ") == {"t": "s", "n": "rpm"}
    assert of("s,quux,foo,mm", 4) == {"t": "s", "n": "quux", "x": "mm"}


@pytest.mark.parametrize(("cells", "comma", "thousands"), [
    (["1.5", "2"], False, False), (["1,5", "2"], True, False), (["1,234"], True, False),
    (["1,234", "1.5"], False, True),
    (["1.234,5"], True, True), (["1,234.5"], False, True), (["1,234,567"], False, True), (["12,5", "1.5"], True, False),
    (["0,123"], True, False), (["1,234", "0,5"], True, False), (["a,b"], False, False), (["1,5e3"], True, False),
    ([",5"], True, False), (["1,2345"], True, False), (["1,234.", "7"], False, True), ([], False, False),
])  # fmt: skip
def test_the_decimal_sign_is_the_one_that_all_cells_allow(cells: list[str], comma: bool, thousands: bool) -> None:
    assert layout._decimal([["x"], cells]) == (comma, thousands)
    rows = "".join(f"{k};{c}\n" for k, c in enumerate(cells))
    found = laid("t;n\n" + rows)
    assert (found.comma, found.thousands) == (comma, thousands)


def test_lines_and_cells_are_those_of_an_editor() -> None:
    raw = b"ab\r\n\nc"
    first = layout.line_at(raw, 0, 7)
    assert first == ("ab", 0, 4, 7) and layout.line_at(raw, 4) == ("", 4, 5, 0)
    assert layout.line_at(raw, 5) == ("c", 5, 6, 0)
    assert layout.cells_of('a;" b;c ";d', ";") == ["a", "b;c", "d"] and layout.cells_of("", ";") == []
    assert layout.cells_of(" a ; b", ";") == ["a", "b"] and layout.cells_of('"a', ";") == ["a"]
    assert layout.opening('"Date: 3.4."; x') == "Date" and layout.opening("a\tb") == "a"
    assert layout.opening(" k,v") == "k"
    assert list(layout.rows_of(b"a;b\r\nc", ";")) == [["a", "b"], ["c"]]


def test_a_header_that_nobody_can_read_is_refused() -> None:
    with pytest.raises(LogError, match=r"^LOG: 10001 columns; allowed: 10000$"):
        laid(";".join(f"c{k}" for k in range(10_001)) + "\n")
    assert len(laid(";".join(f"c{k}" for k in range(10_000)) + "\n").keys) == 10_000


# ---- the same header again, a column for each time -------------------------------------------------------------------


def test_where_the_header_stands_again_rows_keep_the_numbers_of_the_file(tmp_path: Path) -> None:
    """Two runs with a line of the logger's and a row of units before the second: rows count as an editor does."""
    one = "Run: 1\nt,n_dem\ns,%\n0,50\n1,51\n2,52\n"
    two = "Run: 2\nt,n_dem\ns,%\n0,60\n1,nan\n2,62\n3,63\n"
    file = made(tmp_path, one + two)
    log = read(file)
    assert columns(file) == {"n_dem": ([0.0, 2.0, 3.0], [60.0, 62.0, 63.0])}
    assert log.notes[0] == "rows: the header stands again in row 8: part 2 of 2 is read; --part N reads one of 2"
    assert noted(log) == [("left out", "rows", 3, (8,)), ("left out", "n_dem", 1, (11,))]  # three rows of samples
    assert columns(file, part=1) == {"n_dem": ([0.0, 1.0, 2.0], [50.0, 51.0, 52.0])}
    assert refused(file, part=3) == "LOG: part 3: the log has 2 parts"
    single = made(tmp_path, "t,n_dem\n0,50\n1,51\n")
    assert columns(single, part=1)["n_dem"][1] == [50.0, 51.0]
    assert refused(single, part=2) == "LOG: part 2: the log has 1 part"
    other = made(tmp_path, "t,n_dem\n0,50\n1,51\nt,x_dem\n0,1\n")
    assert refused(other) == "LOG: row 4: another header stands there; cut the file before it"
    on = made(tmp_path, "t,n_dem\n0,50\n1,51\nt,n_dem\n2,52\n3,x\n")
    assert refused(on) == "LOG: column 'n_dem', row 6: 'x' is not a number"


def test_each_series_has_the_time_that_stands_before_it(tmp_path: Path) -> None:
    text = "time,n_dem,time,x_dem,y,time 2,n_r\n0,50,0.5,1,7,0,60\n1,51,1.5,2,8,9,61\n,,2.5,3,9,,\n"
    assert columns(made(tmp_path, text)) == {
        "n_dem": ([0.0, 1.0], [50.0, 51.0]), "x_dem": ([0.5, 1.5, 2.5], [1.0, 2.0, 3.0]),
        "n_r": ([0.0, 9.0], [60.0, 61.0]),
    }  # fmt: skip
    one = "time,n_dem,x_dem\n0,50,1\n1,51,2\n"
    assert columns(made(tmp_path, one))["x_dem"] == ([0.0, 1.0], [1.0, 2.0])
    last = "time,n_dem,x_dem,time\n0,50,1,7\n1,51,2,8\n"  # a time of nothing: there is no series behind it
    assert "column 'time' is there more than once (the others: time.2)" in refused(made(tmp_path, last))
    day = "2026-03-14 10:00:0"
    dates = f"time;n_dem;time;x_dem\n{day}0;50;{day}2;1\n{day}1;51;{day}4;2\n"
    assert columns(made(tmp_path, dates)) == {
        "n_dem": ([0.0, 1.0], [50.0, 51.0]),
        "x_dem": ([2.0, 4.0], [1.0, 2.0]),
    }  # all count from the first one
