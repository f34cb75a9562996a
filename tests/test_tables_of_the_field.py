"""Tables as loggers, spreadsheets and measuring programs write them: Hypothesis writes them, every value is read to its
last digit, and what cannot be read is counted or refused.
"""

from __future__ import annotations

import csv
import io
import re
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import asammdf
import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from hil.figures import noise_floor
from hil.logs import Channel, Log, LogError, read_log
from hil.logs.guess import mean_stroke
from hil.logs.joined import joined
from hil.logs.notes import Note, counted
from hil.logs.plausible import judge, too_small
from hil.logs.scale import proposed_scale
from hil.logs.survey import survey
from hil.logs.units import Units, scale_of
from hil.replay import replay
from plant.geometry import load_schedules
from tests.conftest import examples
from vaneloop.identification.user_models.data import noise_of_neighbours, without_order

SIGNALS = ("n_dem", "n_r", "x_dem", "x_lvdt", "i_cmd")
TWICE = settings(max_examples=examples(60), suppress_health_check=[HealthCheck.function_scoped_fixture])


@st.composite
def tables(draw: Any) -> dict[str, list[float]]:
    """Columns of a log: t (s) and some signals, each number with up to three decimals."""
    n = draw(st.integers(24, 60))
    names = draw(st.lists(st.sampled_from(SIGNALS), min_size=1, unique=True))
    seed = np.random.default_rng(draw(st.integers(0, 2**32)))
    start, step = draw(st.integers(-2000, 2000)), draw(st.sampled_from([1, 5, 10, 25, 1000]))
    columns = {"t": [(start + step * k) / 1000.0 for k in range(n)]}
    return columns | {name: np.round(seed.uniform(1.5, 39.5, n), 3).tolist() for name in names}


def written(columns: dict[str, list[float]], separator: str, comma: bool, quotes: bool, grouped: bool = False) -> str:
    """A table as text."""

    def cell(v: float) -> str:
        text = f"{v:,.3f}" if grouped else f"{v:.3f}"
        return text.translate(str.maketrans(",.", ".,")) if comma else text

    out = io.StringIO()
    write = csv.writer(out, delimiter=separator, quoting=csv.QUOTE_ALL if quotes else csv.QUOTE_MINIMAL).writerow
    write(columns)
    for row in zip(*columns.values(), strict=True):
        write([cell(v) for v in row])
    return out.getvalue()


def read(folder: Path, text: str, name: str = "a.csv", **options: Any) -> Log:
    (folder / name).write_text(text, encoding="utf-8", newline="")
    return read_log(folder / name, require=(), **options)


def holds(log: Log, columns: dict[str, list[float]], rows: Any = slice(None)) -> None:
    """Every value of the table is in the log, at its time, and nothing else."""
    assert set(log.channels) == set(columns) - {"t"}
    for name, c in log.channels.items():
        assert c.values.tolist() == np.asarray(columns[name])[rows].tolist()
        assert c.t.tolist() == np.asarray(columns["t"])[rows].tolist()


@given(
    tables(), st.sampled_from(",;\t"), st.booleans(), st.booleans(), st.sampled_from(["", "\r\n", "preamble", "units"])
)
@TWICE
def test_separator_decimal_sign_quotes_and_lines_before_the_header_change_nothing(
    tmp_path: Path, columns: dict[str, list[float]], separator: str, comma: bool, quotes: bool, more: str
) -> None:
    head, *rows = written(columns, separator, comma, quotes).splitlines()
    if more == "preamble":
        head = f'"Rig 5"\n"Date: Tue Aug 18"\n\n{head}'
    elif more == "units":
        units = {"t": "s", "n_dem": "%", "n_r": "%", "x_dem": "mm", "x_lvdt": "mm", "i_cmd": ""}
        head = f"{head}\n{separator.join(units[c] for c in columns)}"
    log = read(tmp_path, (more if more == "\r\n" else "\n").join([head, *rows]))
    holds(log, columns)
    assert not [n for n in log.notes if "left out" in n]


@given(tables(), st.booleans())
@TWICE
def test_signs_between_thousands_are_taken_off(tmp_path: Path, columns: dict[str, list[float]], comma: bool) -> None:
    columns = {k: v if k == "t" else [1000.0 * x for x in v] for k, v in columns.items()}
    columns["t"] = [t - columns["t"][0] for t in columns["t"]]
    columns = {"t": columns["t"], "n_dem": columns[next(k for k in columns if k != "t")]}
    text = written(columns, ";", comma, False, grouped=True)
    log = read(tmp_path, text, units={"n_dem": "rpm"}, design_rpm=100_000.0)
    assert log.channels["n_dem"].values == pytest.approx(np.array(columns["n_dem"]) * 1e-3, rel=1e-12)


@given(tables(), st.data())
@TWICE
def test_a_row_with_another_number_of_cells_is_left_out_and_counted_or_refused(
    tmp_path: Path, columns: dict[str, list[float]], data: st.DataObject
) -> None:
    head, *rows = written(columns, ",", False, False).splitlines()
    n, cells = len(rows), len(columns)
    wrong = sorted(data.draw(st.sets(st.integers(0, n - 1), min_size=1, max_size=n)))
    for k in wrong:
        other = data.draw(st.integers(1, 2 * cells + 1).filter(lambda m: m != cells))
        rows[k] = ",".join((rows[k].split(",") + ["1"] * other)[:other])
    good = np.setdiff1d(np.arange(n), wrong)
    try:
        log = read(tmp_path, "\n".join([head, *rows]))
    except LogError as e:
        assert f"{len(wrong)} of {n} rows have more or fewer cells than the header (first row {wrong[0] + 2}: " in str(
            e
        )
        assert len(wrong) > 0.1 * n
        return
    holds(log, columns, good)
    (note,) = [m for m in log.notes if isinstance(m, Note) and m.of == "rows"]
    assert note.number == len(wrong) and note.rows == tuple(k + 2 for k in wrong)[:20]
    assert counted(log.notes)[0] == {
        "kind": "left out", "of": "rows", "count": len(wrong), "rows": list(note.rows), "said": str(note),
    }  # fmt: skip
    assert 2 * len(wrong) <= n


@given(tables(), st.booleans())
@TWICE
def test_decimal_commas_between_commas_are_refused(
    tmp_path: Path, columns: dict[str, list[float]], quotes: bool
) -> None:
    text = written(columns, ",", True, True)
    if quotes:
        holds(read(tmp_path, text), columns)
    else:
        with pytest.raises(LogError, match="decimal commas, or lists, between commas"):
            read(tmp_path, text.replace('"', ""))


@given(tables(), st.integers(1, 3), st.booleans())
@TWICE
def test_a_needless_column_may_stand_there_twice_and_a_needed_one_may_not(
    tmp_path: Path, columns: dict[str, list[float]], often: int, needed: bool
) -> None:
    name = next(k for k in columns if k != "t") if needed else "Trigger"
    lines = written(columns, ",", False, False).splitlines()
    lines = [",".join([line, *["0" if k else name] * (often + (not needed))]) for k, line in enumerate(lines)]
    if needed:
        with pytest.raises(LogError, match=f"column '{name}' is there more than once"):
            read(tmp_path, "\n".join(lines))
    else:
        holds(read(tmp_path, "\n".join(lines)), columns)


@given(tables(), st.sampled_from(["Time", "Zeit", "timestamp [s]"]), st.sampled_from(["same", ".1"]))
@TWICE
def test_each_series_may_have_its_own_time(
    tmp_path: Path, columns: dict[str, list[float]], called: str, how: str
) -> None:
    names = [k for k in columns if k != "t"]
    assume(len(names) > 1)
    late = {name: [round(t + 0.001 * k, 3) for t in columns["t"]] for k, name in enumerate(names)}
    head = [h for k, name in enumerate(names) for h in (called + (f".{k}" if k and how == ".1" else ""), name)]
    assume(how == "same" or "[" not in called)
    rows = zip(*(column for name in names for column in (late[name], columns[name])), strict=True)
    log = read(tmp_path, "\n".join([",".join(head), *(",".join(map(str, row)) for row in rows)]))
    for name in names:
        assert log.channels[name].t.tolist() == late[name] and log.channels[name].values.tolist() == columns[name]


@given(tables(), st.integers(2, 22), st.booleans(), st.integers(0, 2))
@TWICE
def test_where_the_header_stands_again_a_part_is_named_and_each_can_be_read(
    tmp_path: Path, columns: dict[str, list[float]], cut: int, goes_on: bool, part: int
) -> None:
    head, *rows = written(columns, "\t", False, False).splitlines()
    t = columns["t"]
    first = rows[:cut]
    again = rows[cut:] if goes_on else rows[: len(rows) - cut]
    text = "\n".join(['"Rig 5"', '"Capture Date: 1"', head, *first, '"Rig 5"', '"Capture Date: 2"', head, *again])
    log = read(tmp_path, text, part=part)
    second = np.arange(cut, len(t)) if goes_on else np.arange(len(t) - cut)
    read_rows = {
        0: np.arange(len(t)) if goes_on else max(np.arange(cut), second, key=len),
        1: np.arange(cut),
        2: second,
    }
    holds(log, columns, read_rows[part])
    assert f"rows: the header stands again in row {cut + 6}: " in str(log.notes)
    with pytest.raises(LogError, match="part 3: the log has 2 parts"):
        read(tmp_path, text, part=3)
    with pytest.raises(LogError, match=f"row {cut + 6}: another header stands there"):
        read(
            tmp_path,
            "\n".join(
                ['"Rig 5"', '"Capture Date: 1"', head, *first, "", "", head.replace("t\t", "t\tnew_", 1), *again]
            ),
        )


@given(
    st.integers(3, 30), st.integers(3, 30), st.sampled_from([10, 250, 1000]), st.sampled_from(["two", "one", "words"]),
    st.integers(0, 3600),
)  # fmt: skip
@TWICE
def test_the_hour_that_comes_twice_is_taken_out(
    tmp_path: Path, before: int, after: int, step: int, form: str, back_at: int
) -> None:
    begin = datetime(2025, 10, 26, 2, 0, 0) + timedelta(seconds=back_at) - timedelta(milliseconds=before * step)
    stamps = [begin + timedelta(milliseconds=k * step, hours=-(k >= before)) for k in range(before + after)]
    between = "," if form == "two" else " "
    form = "%d.%m.%Y" if form == "words" else "%Y-%m-%d"
    lines = [f"{s.strftime(form)}{between}{s.strftime('%H:%M:%S.%f')[:-3]},{50 + k % 7}" for k, s in enumerate(stamps)]
    log = read(tmp_path, "\n".join([f"{'Date,Time' if between == ',' else 'Time'},n_dem", *lines]))
    assert log.channels["n_dem"].t == pytest.approx(np.arange(before + after) * step * 1e-3, abs=1e-6)
    assert f"time: falls back by an hour at row {before + 2}, at the end of summer time" in str(log.notes)


@given(st.integers(2, 20), st.integers(2, 20), st.integers(1, 300))
@TWICE
def test_the_day_beside_the_time_of_day_counts(tmp_path: Path, one: int, other: int, days: int) -> None:
    begin = datetime(2026, 1, 1, 10, 0, 0)
    stamps = [begin + timedelta(seconds=0.5 * k, days=days * (k >= one)) for k in range(one + other)]
    lines = [f"{s:%Y-%m-%d},{s:%H:%M:%S.%f},50" for s in stamps]
    log = read(tmp_path, "\n".join(["Date,Time,n_dem", *lines]))
    kept = max(one, other) if max(one, other) > 10 or one == other else max(one, other)
    assert log.channels["n_dem"].t.size == kept and np.ptp(log.channels["n_dem"].t) < 11.0
    assert "far from all others" in str(log.notes) or "time jumps" in str(log.notes)


@given(tables(), st.sampled_from(["One", "Multi", "No"]), st.booleans(), st.booleans())
@TWICE
def test_a_labview_file_has_one_time_or_several_or_a_step(
    tmp_path: Path, columns: dict[str, list[float]], x: str, comma: bool, remarks: bool
) -> None:
    names, t = [k for k in columns if k != "t"], columns["t"]
    step = round(t[1] - t[0], 3)
    cells = {k: [str(v).replace(".", "," if comma else ".") for v in column] for k, column in columns.items()}
    series = [[cells["t"] if x != "No" else [""] * len(t)] if k == 0 or x == "Multi" else [] for k in range(len(names))]
    table = [c for k, name in enumerate(names) for c in (*series[k], cells[name])]
    head = [h for k, name in enumerate(names) for h in (*["X_Value"] * len(series[k]), name)]
    sign = "," if comma else "."
    lines = [
        "LabVIEW Measurement\t", "Separator\tTab", f"Decimal_Separator\t{sign}", f"X_Columns\t{x}",
        "Date\t2016/08/11", "***End_of_Header***\t", "\t", f"Channels\t{len(names)}",
        "\t".join(["X0", *[str(t[0]).replace(".", sign)] * len(names)]),
        "\t".join(["Delta_X", *[str(step).replace(".", sign)] * len(names)]), "***End_of_Header***\t",
        "\t".join([*head, "Comment"]),
    ]  # fmt: skip
    lines += ["\t".join(row) + ("\t" if remarks else "") for row in zip(*table, strict=True)]
    log = read(tmp_path, "\r\n".join(lines) + "\r\n", "a.lvm")
    assert set(log.channels) == set(names)
    for name in names:
        assert log.channels[name].values.tolist() == columns[name]
        assert log.channels[name].t == pytest.approx(np.array(t), abs=1e-9)


# ---- gain and zero, and hints that are followed ----------------------------------------------------------------------


@given(st.floats(-50, 50), st.sampled_from(["mm", "m", "inch", "um"]), st.floats(-40, 40), st.booleans())
@TWICE
def test_gain_and_zero_are_stated_with_the_unit(gain: float, unit: str, zero: float, star: bool) -> None:
    gain, zero = float(f"{gain:.6g}"), float(f"{zero:.6g}")
    assume(abs(gain) > 1e-6)
    text = f"{gain:.6f}{'*' if star else ' '}{unit}{zero:+.6f}"
    found = scale_of(text)
    assert found[1] == unit and found[0] == pytest.approx(gain, abs=1e-6) and found[2] == pytest.approx(zero, abs=1e-6)
    volts = np.linspace(-3.0, 3.0, 7)
    to_mm = {"mm": 1.0, "m": 1e3, "inch": 25.4, "um": 1e-3}[unit]
    read = Units(Path("a"), {"x_lvdt": text}, None, []).convert("x_lvdt", "V", volts, "V")
    assert read == pytest.approx((found[0] * volts + found[2]) * to_mm, rel=1e-9, abs=1e-9)


def run_of(seed: int, n: int = 400) -> dict[str, np.ndarray]:
    """A log of the machine as its tables say it: demand, speed, stroke by the schedule, the inlet vane."""
    t = np.arange(n) * 0.01
    rng = np.random.default_rng(seed)
    speed = 75.0 + 12.0 * np.sin(2.0 * np.pi * t / rng.uniform(2.0, 4.0))
    stroke = np.interp(speed, *mean_stroke({}))
    angle = np.rad2deg(load_schedules("schedules.toml").targets(speed))[:, 0]
    return {"t": t, "n_dem": speed + 0.1, "n_r": speed, "x_dem": stroke, "x_lvdt": stroke + 0.01, "vigv": angle}


def followed(folder: Path, columns: dict[str, Any], heads: dict[str, str]) -> tuple[Log, str]:
    """The log read with what the line of its refusal proposes, and that line."""
    names = [heads.get(k, k) for k in columns]
    rows = zip(*columns.values(), strict=True)
    text = "\n".join([",".join(names), *(",".join(repr(float(v)) for v in row) for row in rows)])
    with pytest.raises(LogError) as refused:
        read(folder, text)
    line = str(refused.value)
    units = dict(re.findall(r"--unit '?(\w+)=([^' ;,]+)", line)[:1])
    rpm = re.search(r"--design-rpm (\d+)", line)
    return read(folder, text, units=units, design_rpm=float(rpm[1]) if rpm else None), line


@given(st.integers(0, 99), st.floats(0.5, 40), st.floats(-3, 3), st.sampled_from(["x_lvdt", "vigv"]), st.booleans())
@settings(max_examples=examples(25), suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_proposed_gain_and_zero_gives_the_signal_back(
    tmp_path: Path, seed: int, gain: float, zero: float, signal: str, turned: bool
) -> None:
    """A gain near 1 is a sensor's own error, which is for the diagnosis: of it only the sign is proposed."""
    columns = run_of(seed)
    near = abs(gain - 1.0) <= 0.2
    gain = -gain if turned else gain
    assume(not near or turned)
    true = columns[signal].copy()
    columns[signal] = (true - zero) / gain
    log, line = followed(tmp_path, columns, {signal: f"{signal} [VRMS]"})
    assert "follows" in line
    own = 0.25 * np.max(np.abs(true)) + 1.25 * abs(zero) if near else 0.0
    assert np.max(np.abs(log.channels[signal].values - true)) < 0.03 * np.ptp(true) + 0.02 + own


@given(
    st.integers(0, 99), st.sampled_from([0.08, 0.1, 0.4, 5.0]), st.sampled_from([0.0, 20.0]), st.booleans(),
    st.floats(0.0, 1.0), st.floats(-0.5, 0.5), st.floats(0.95, 1.05),
)  # fmt: skip
def test_a_current_of_unknown_scale_follows_the_rate_of_the_stroke(
    seed: int, gain: float, zero: float, turned: bool, dead: float, null: float, flow: float
) -> None:
    """Whatever dead band, null bias and flow gain the valve has, within what a table calls its tolerance."""
    rng = np.random.default_rng(seed)
    t = np.arange(1000) * 0.01
    x = 24.0 + 15.0 * np.sin(2.0 * np.pi * t / rng.uniform(3.0, 6.0))
    v = np.gradient(x, t)
    current = (v * 40.0 / 150.0 * flow + dead * np.sign(v) + null + 0.02 * rng.standard_normal(1000)) * (1 - 2 * turned)
    stroke = {"x_lvdt": (t, x + 0.005 * rng.standard_normal(1000))}
    found = proposed_scale("i_cmd", (t, (current + zero) / gain), stroke, {})
    assert found is not None and found[1] == "the rate of x_lvdt"
    said = scale_of(found[0])
    assert said[0] == pytest.approx(-gain if turned else gain) and said[1] == "mA"
    assert (said[2] == 0.0) == (zero == 0.0) and abs(said[2]) == pytest.approx(zero, abs=1.0)
    right = proposed_scale("i_cmd", (t, current), stroke, {})
    assert right == (("-mA", "the rate of x_lvdt") if turned else None)
    assert proposed_scale("i_cmd", (t, rng.standard_normal(1000)), stroke, {}) is None


@given(
    st.integers(0, 99), st.sampled_from(["ms", "us", "ns"]), st.sampled_from([1, 2, 5, 10, 20, 50, 100]), st.booleans()
)
@settings(max_examples=examples(25), suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_proposed_unit_of_time_is_the_right_one(
    tmp_path: Path, seed: int, unit: str, step: int, two_rasters: bool
) -> None:
    columns = run_of(seed, 400)
    t = np.arange(400) * step * 1e-3
    count = {"ms": 1e3, "us": 1e6, "ns": 1e9}[unit]
    ticks = np.rint((t + 112.345) * count)
    assume(np.ptp(ticks) > 20_000.0)
    columns["t"] = ticks
    if two_rasters:
        columns["t"] = np.where(np.arange(400) % 2, ticks - np.rint(0.3e-3 * step * count), ticks)
    log, line = followed(tmp_path, columns, {"t": "timestamp"})
    assert f"--unit t={unit}" in line
    assert np.ptp(log.channels["n_dem"].t) == pytest.approx(np.ptp(t), rel=0.02)


UNITS_THAT_ARE_TOLD = [
    ("p_s", 210.0, "bar"), ("p_s", 21e6, "Pa"), ("p_s", 3046.0, "psi"), ("t_oil", 313.0, "K"),
    ("x_lvdt", 24_000.0, "um"),
]  # fmt: skip


@pytest.mark.parametrize(("signal", "value", "unit"), UNITS_THAT_ARE_TOLD)
def test_a_proposed_unit_gives_a_plausible_channel(tmp_path: Path, signal: str, value: float, unit: str) -> None:
    columns = run_of(3) | {signal: value * (1.0 + 0.01 * np.sin(np.arange(400.0)))}
    log, line = followed(tmp_path, columns, {})
    assert f"--unit {signal}={unit}" in line
    assert judge(signal, log.channels[signal].values)[1] == ""


def test_a_speed_that_is_0_throughout_asks_for_the_design_speed(tmp_path: Path) -> None:
    for name in ("N1_rpm", "N1_DEM_rpm", "n_dem [rpm]"):
        text = f"t,{name}\n" + "".join(f"{0.01 * k:.2f},0\n" for k in range(60))
        with pytest.raises(LogError, match="--design-rpm R"):
            read_log_text(tmp_path, text)
        assert survey(tmp_path / "a.csv").suggested_rpm is None


def test_a_workbook_is_refused_with_what_to_do(tmp_path: Path) -> None:
    (tmp_path / "a.xlsx").write_bytes(b"PK\x03\x04" + bytes(60))
    with pytest.raises(LogError, match=r"suffix '\.xlsx' is not a log's; .*: save its table as CSV"):
        read_log(tmp_path / "a.xlsx")


@given(tables())
@settings(max_examples=examples(2), suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_channels_of_mdf_3_are_those_that_asammdf_reads(
    tmp_path: Path, quick_mdf: None, columns: dict[str, list[float]]
) -> None:
    with asammdf.MDF(version="3.30") as mdf:
        t = np.array(columns["t"])
        mdf.append([asammdf.Signal(np.array(v), t, name=k) for k, v in columns.items() if k != "t"])
        mdf.save(tmp_path / "a.mdf", overwrite=True)
    for name in ("a.mdf", "a.dat", "a.mf4"):
        (tmp_path / name).write_bytes((tmp_path / "a.mdf").read_bytes())
        holds(read_log(tmp_path / name, require=()), columns)


def test_samples_that_an_mdf_marks_as_invalid_are_counted(tmp_path: Path, quick_mdf: None) -> None:
    t, invalid = np.arange(40) / 10.0, np.arange(40) % 7 == 3
    with asammdf.MDF(version="4.10") as mdf:
        mdf.append([asammdf.Signal(50.0 + t, t, name="n_dem", invalidation_bits=invalid)])
        mdf.save(tmp_path / "a.mf4", overwrite=True)
    log = read_log(tmp_path / "a.mf4")
    assert log.channels["n_dem"].t.tolist() == t[~invalid].tolist()
    (done,) = counted(log.notes)
    assert (done["kind"], done["of"], done["count"]) == ("left out", "n_dem", int(invalid.sum()))


def read_log_text(folder: Path, text: str) -> Log:
    (folder / "a.csv").write_text(text)
    return read_log(folder / "a.csv", require=("n_dem",))


# ---- samples that nobody took ----------------------------------------------------------------------------------------


@given(
    st.integers(0, 999),
    st.integers(2, 10),
    st.sampled_from([3, 4, None]),
    st.floats(0.005, 0.2),
    st.sampled_from(["sine", "dwells"]),
)
@TWICE
def test_samples_joined_by_straight_lines_are_taken_at_their_own_rate(
    tmp_path: Path, seed: int, every: int, digits: int | None, noise: float, how: str
) -> None:
    # lines bend at true samples by the root of 6 noises in so many rows, which the last digit must not hide
    assume(digits is None or noise * 6.0**0.5 / every > 4.0 * 10.0**-digits)
    rng, n = np.random.default_rng(seed), 500
    t = np.arange(n) * 0.01 * every
    speed = 70.0 + (8.0 * np.sin(t / 3.0) if how == "sine" else 5.0 * np.round(np.sin(t / 7.0)))
    speed = speed + noise * rng.standard_normal(n)
    fine = np.arange((n - 1) * every + 1) * 0.01
    values = np.interp(fine, t, speed)
    values = values if digits is None else np.round(values, digits)
    rows = "".join(f"{a:.2f},{float(v)!r}\n" for a, v in zip(fine, values, strict=True))
    log = read(tmp_path, "t,n_r\n" + rows)
    c = log.channels["n_r"]
    assert c.t == pytest.approx(t) and c.values.tolist() == values[::every].tolist()
    assert c.apart == pytest.approx(0.01 * every)
    assert noise_floor(c.t, c.values) == pytest.approx(noise, rel=0.35, abs=1e-3)


@given(st.integers(0, 999), st.floats(0.0, 0.2), st.integers(1, 4), st.sampled_from(["sine", "program", "held"]))
@TWICE
def test_a_channel_that_was_sampled_in_each_row_is_left_alone(seed: int, noise: float, digits: int, how: str) -> None:
    rng, t = np.random.default_rng(seed), np.arange(3000) * 0.01
    values = {
        "sine": 70.0 + 8.0 * np.sin(t),
        "program": np.interp(t, np.arange(0.0, 31.0), rng.uniform(50.0, 90.0, 31)),  # corners at whole seconds
        "held": np.repeat(rng.uniform(50.0, 90.0, 600), 5),
    }[how]
    found = joined(t, np.round(values + noise * rng.standard_normal(3000), digits))
    assert found is None or not found.sure


# ---- noise of rows in no order ---------------------------------------------------------------------------------------


@given(st.integers(0, 999), st.floats(0.01, 0.5), st.integers(1, 2), st.booleans())
@settings(max_examples=examples(25))
def test_the_noise_of_a_static_model_does_not_turn_on_the_order_of_its_rows(
    seed: int, noise: float, inputs: int, shuffled: bool
) -> None:
    rng, n = np.random.default_rng(seed), 2000
    u = rng.uniform(-1.0, 1.0, (inputs, n)) if shuffled else np.sort(rng.uniform(-1.0, 1.0, (inputs, n)), axis=1)
    y = 10.0 * np.sin(2.0 * u[0]) + 3.0 * u[-1] ** 2 + noise * rng.standard_normal(n)
    assert without_order(u) == shuffled
    assert noise_of_neighbours(u, y) == pytest.approx(noise, rel=0.15, abs=0.02)
    again = rng.permutation(n)
    assert noise_of_neighbours(u[:, again], y[again]) == pytest.approx(noise_of_neighbours(u, y), rel=0.1)


# ---- time's zero -----------------------------------------------------------------------------------------------------


@given(st.sampled_from([-5.0, 0.0037, 1000.0, 8000.5]), st.integers(0, 9), st.sampled_from(["none", "n_r", "p_s"]))
@settings(max_examples=examples(4), deadline=None)
def test_a_shift_of_all_times_changes_nothing_in_a_replay(shift: float, seed: int, late: str) -> None:
    columns = run_of(seed, 300)
    channels = {k: Channel(columns["t"], columns[k]) for k in ("n_dem", "n_r", "x_dem", "x_lvdt", "vigv")}
    channels["p_s"] = Channel(columns["t"], np.full(300, 21.0))
    if late != "none":
        channels[late] = Channel(columns["t"][100:], channels[late].values[100:])
    here = replay(Log("a", channels))
    there = replay(Log("a", {k: replace(c, t=c.t + shift) for k, c in channels.items()}))
    assert there.state_hash == here.state_hash and there.simulated_s == here.simulated_s
    assert here.t[0] == pytest.approx(0.0 if late == "none" else 0.99) and there.t == pytest.approx(here.t + shift)
    for a, b in zip(here.signals, there.signals, strict=True):
        assert a.samples == b.samples and a.rms == pytest.approx(b.rms, rel=1e-6, abs=1e-9)
    assert max(s.samples for s in here.signals if s.reference == "measured") <= len(here.t) + 1


@given(st.integers(-305, -8), st.integers(0, 99))
def test_a_current_that_moves_nothing_in_any_unit_is_refused(power: int, seed: int) -> None:
    """That of a dead sensor, which a log may have, does not move at all."""
    t = np.arange(500) * 0.01
    small = 10.0**power * np.random.default_rng(seed).standard_normal(500)
    stroke = t, 24.0 + 15.0 * np.sin(2.0 * np.pi * t)
    assert "in A too" in too_small({"i_cmd": (t, small), "x_lvdt": stroke}, set())[0]["i_cmd"]
    assert not too_small({"i_cmd": (t, small), "x_lvdt": (t, np.full(500, 24.0))}, set())[0]
    assert not too_small({"i_cmd": (t, np.full(500, small[0])), "x_lvdt": stroke}, set())[0]
