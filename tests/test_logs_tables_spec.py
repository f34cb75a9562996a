"""Tables and what is made of them: cells, times, dates, units, names, limits, and what is said of what was left out."""

from __future__ import annotations

import dataclasses
import datetime as dt
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pint
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hil.logs import Channel, Log, LogError, csv_format, offered, plausible, source, transport, write_log
from hil.logs import guess as guess_of
from hil.logs import joined as joined_rows
from hil.logs import log as logs
from hil.logs.channels import Channels, NoChannel, raster
from hil.logs.dates import OddRow, from_dates
from hil.logs.formula import formula_of
from hil.logs.frames import Frames
from hil.logs.guess import feed_forward
from hil.logs.joined import Joined, joined, seems_joined
from hil.logs.mapping import Bench, read_mapping, write_mapping
from hil.logs.notes import Note
from hil.logs.opening import open_log
from hil.logs.scale import _mean_over, _usual, proposed_scale
from hil.logs.source import ABSENT, check_file, close_names, is_absent, names_held, numbers, read_bytes
from hil.logs.stale import _turns, stale_rows
from hil.logs.survey import MOST_LISTED, Row, Survey, sparkline, survey
from hil.logs.table import NoTime, split_unit
from hil.logs.times import guess_column, guess_unit
from hil.logs.units import USUAL_UNITS, Units, factor_of
from tests.conftest import examples
from tests.small_logs import read
from tests.small_logs import written as csv
from vaneloop.base.signals import UNITS


def values(file: Path, signal: str = "n_dem", **options: Any) -> list[float]:
    return read(file, **options).channels[signal].values.tolist()


def refused(file: Path, **options: Any) -> str:
    with pytest.raises(LogError) as caught:
        read(file, **options)
    return str(caught.value).replace(str(file), "LOG")


ROWS = "0,50\n1,51\n2,52\n"


# ---- CSV -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "text",
    [
        "t,n_dem\n0,50\n1,51\n2,52\n",
        "t;n_dem\n0;50\n1;51\n2;52",
        "t\tn_dem\r\n0\t50\r\n1\t51\r\n2\t52\r\n",
        "t;n_dem\n0,0;50,0\n1,0;51,0\n2,0;52,0\n",
        "\n# a remark\n\nt,n_dem\n0,50\n1,51\n2,52\n",
        "sep=;\nt;n_dem\n0;50\n1;51\n2;52\n",
        '"sep=,"\nt,n_dem\n0,50\n1,51\n2,52\n',
        "t [s],n_dem [%]\n0,50\n1,51\n2,52\n",
        "t,n_dem\ns,%\n0,50\n1,51\n2,52\n",
        "t,n_dem\n[s],(%)\n0,50\n1,51\n2,52\n",
        "t,n_dem,foo\n-,%,\n0,50,1\n1,51,1\n2,52,1\n",
        " t , n_dem \n0, 50\n1,51 \n2,52\n",
        "t,n_dem,word\n0,50,a\n1,51,b\n2,52,c\n",
        't,n_dem,word\n0,50,"a,b"\n1,51,"c\nd"\n2,52,e\n',
        "t,n_dem\n0,50,,\n1,51\n2,52\n",
        b"\xef\xbb\xbft,n_dem\n0,50\n1,51\n2,52\n",
        "t,n_dem\n0,50\n1,51\n2,52\n".encode("utf-16"),
        "t,n_dem,\u00d6l\n0,50,1\n1,51,1\n2,52,1\n".encode("cp1252"),
        "t,n_dem,,\n0,50,1,\n1,51,1,\n2,52,1,\n",
    ],
)
def test_the_same_table_is_read_however_it_is_written(tmp_path: Path, text: str | bytes) -> None:
    log = read(csv(tmp_path, text))
    assert log.channels["n_dem"].values.tolist() == [50, 51, 52] and log.channels["n_dem"].t.tolist() == [0, 1, 2]
    assert set(log.channels) == {"n_dem"} and not log.channels["n_dem"].framed


@pytest.mark.parametrize("none", ["", "NA", "N/A", "null", "None", "-", " NA ", "#N/A", "NULL", "--", "nan", "1.#QNAN"])
def test_a_cell_without_a_sample_leaves_its_row_out(tmp_path: Path, none: str) -> None:
    for last in ("52", " 52"):  # plain numbers, and one by one
        log = read(csv(tmp_path, f"t,n_dem\n0,50\n1,{none}\n2,{last}\n"))
        assert log.channels["n_dem"].t.tolist() == [0, 2]
        assert log.notes == (
            ["n_dem (n_dem): 1 of 3 samples are NaN or infinite: left out"] if none in ("nan", "1.#QNAN") else []
        )


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("t,n_dem\n0,50\n1,x y\n", "LOG: column 'n_dem', row 3: 'x y' is not a number"),
        ("# r\n\nt,n_dem\ns,%\n0,50\n1,1_000\n", "LOG: column 'n_dem', row 6: '1_000' is not a number"),
        ("sep=,\nt,n_dem\n0,50\n1,x\n", "LOG: column 'n_dem', row 4: 'x' is not a number"),
        ("t,n_dem\n0,50\nx,51\n", "LOG: column 't', row 3: 'x' is not a number"),
        ("t,n_dem\n0,50\n1," + "x" * 41 + "\n", f"row 3: '{'x' * 40}' is not a number"),
        ("t,n_dem,n_dem\n0,1,2\n", "LOG: column 'n_dem' is there more than once"),
        (b"t,\0\n", "LOG: is not a CSV (binary bytes in it)"),
        (
            "a,b\n0,1\n",
            "LOG: no time column; looked for t, time, timestamp, timestamps, time_s, zeit (--map NAME=t names another)",
        ),
        ("t,b\n0,1\n", "LOG: none"),
    ],
)
def test_what_is_no_table_is_refused_by_row_and_column(tmp_path: Path, text: str | bytes, said: str) -> None:
    file = csv(tmp_path, text)
    if said == "LOG: none":
        assert read(file).channels == {}
    else:
        assert said in refused(file)


@pytest.mark.parametrize("separator", [",", ";", "\t", "|"])
def test_cells_stand_between_commas_semicolons_tabs_or_bars(tmp_path: Path, separator: str) -> None:
    rows = [
        ["t", "n_dem", "remark"],
        *([f"{k}.5", f"{50 + k}", "a|b" if separator == "," else "a,b"] for k in range(9)),
    ]
    log = read(csv(tmp_path, "\n".join(map(separator.join, rows)) + "\n"))
    assert log.channels["n_dem"].values.tolist() == [50.0 + k for k in range(9)]
    assert log.channels["n_dem"].t.tolist() == [k + 0.5 for k in range(9)]


def test_a_time_that_is_none_is_told_what_times_are(tmp_path: Path) -> None:
    for text in ("0 s", "00:01.5", "2026-03-01 10:00:00 CET"):
        said = refused(csv(tmp_path, f"t,n_dem\n{text},1\n"))
        assert f"'{text}' is not a number, nor a date such as 2026-03-01 10:00:00.000; write seconds" in said


def test_space_behind_the_last_row_that_was_never_written_is_left_out(tmp_path: Path) -> None:
    text = b"t,n_dem\n0,50\n1,51\n2,52\n"
    for raw in (text, text + text[:9].replace(b"t,n_dem", b"3,53\n4,")):  # at the end of a row, and in one
        log = read(csv(tmp_path, raw + b"\0" * 4096))
        assert log.channels["n_dem"].values.tolist()[:3] == [50, 51, 52]
        assert "rows: behind the last one stand 4,096 bytes of 0, as after a loss of power: left out" in log.notes
    assert refused(csv(tmp_path, b"\0" * 64)) == "LOG: is not a CSV (binary bytes in it)"
    assert "binary bytes" in refused(csv(tmp_path, text[:12] + b"\0" + text[12:]))


def test_a_table_has_ten_thousand_columns_at_most(tmp_path: Path) -> None:
    for n, fine in ((10_000, True), (10_001, False)):
        head = "t,n_dem" + "," * (n - 2)
        file = csv(tmp_path, f"{head}\n0,50\n1,51\n")
        if fine:
            assert list(csv_format.open_csv(file, source.Options(None, {})).names) == ["n_dem"]
        else:
            assert refused(file) == "LOG: 10001 columns; allowed: 10000"


def test_rows_of_other_lengths_are_left_out(tmp_path: Path) -> None:
    for quote in ("", '"'):
        text = f"t,n_dem,x_dem\n0,50,{quote}1{quote}\n1,51\n2,52,3,4,5\n4,54,5\n"
        log = read(csv(tmp_path, text))
        assert log.channels["n_dem"].t.tolist() == [0, 4] and log.channels["x_dem"].values.tolist() == [1, 5]
    longer = read(csv(tmp_path, "t,n_dem\r\n0,50,1\r\n1,51\r\n2,52\r\n"))
    assert longer.channels["n_dem"].values.tolist() == [51, 52]


@pytest.mark.parametrize(
    ("under", "unit"),
    [
        ("s,rpm", "rpm"),
        ("s,", ""),
        (",rpm", "rpm"),
        ("0,rpm", None),
        ("s,quux", ""),
        ("quux,foo", None),
        ("nan,rpm", None),
        ("-,none", None),
    ],
)
def test_a_row_of_units_has_units_and_nothing_else(tmp_path: Path, under: str, unit: str | None) -> None:
    file = csv(tmp_path, f"t,n_dem\n{under}\n0,500\n1,510\n")
    if unit is None:
        assert "row 2" in refused(file, units={"n_dem": "rpm"}, design_rpm=1000.0) or under == "-,none"
    else:
        found = values(file, design_rpm=1000.0, units={} if unit else {"n_dem": "rpm"})
        assert found == pytest.approx([50.0, 51.0])


def test_what_is_written_as_a_table_is_plain_text(tmp_path: Path) -> None:
    write_log(
        tmp_path / "b.csv",
        {
            "n_dem": Channel(np.array([0.0, 2.0]), np.array([50.0, 51.5])),
            "x_dem": Channel(np.array([1.0]), np.array([9.0])),
        },
    )
    assert (tmp_path / "b.csv").read_text() == "t,n_dem,x_dem\n0,50,\n1,,9\n2,51.5,\n"


# ---- Parquet ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "factor"),
    [
        (pa.timestamp("s"), 1.0),
        (pa.timestamp("ms"), 1e-3),
        (pa.timestamp("us"), 1e-6),
        (pa.timestamp("ns", "UTC"), 1e-9),
        (pa.duration("ms"), 1e-3),
        (pa.int32(), 1.0),
        (pa.uint8(), 1.0),
        (pa.float32(), 1.0),
        (pa.decimal128(21, 2), 1.0),
    ],
)
def test_times_of_any_arrow_type_are_seconds(tmp_path: Path, kind: Any, factor: float) -> None:
    whole = pa.array([1, 2, 4], pa.int64()).cast(kind)
    pq.write_table(pa.table({"t": whole, "n_dem": [50.0, 51.0, 52.0]}), tmp_path / "a.parquet")
    np.testing.assert_allclose(
        read(tmp_path / "a.parquet").channels["n_dem"].t, factor * np.array([1, 2, 4]), rtol=1e-12
    )


def test_the_only_column_of_dates_is_the_time(tmp_path: Path) -> None:
    when = pa.array([10, 11, 12], pa.timestamp("s"))
    columns = {"n_dem": [50.0, 51.0, 52.0], "__index_level_0__": when}
    pq.write_table(pa.table(columns), tmp_path / "a.parquet")
    log = read(tmp_path / "a.parquet")
    assert log.channels["n_dem"].t.tolist() == [10.0, 11.0, 12.0]
    assert log.notes[0].startswith("t: guessed to be '__index_level_0__', the only column of dates")
    pq.write_table(pa.table(columns | {"other": when}), tmp_path / "a.parquet")
    assert "no time column" in refused(tmp_path / "a.parquet")


def test_cells_of_any_number_and_dates_in_words_are_read_and_words_are_not(tmp_path: Path) -> None:
    dates = ["2024-01-02 10:00:00", None, "2024-01-02 10:00:02"]
    table = pa.table({
        "t": dates, "n_dem": pa.array([50, 51, None]), "state": [True, False, True], "x_dem": ["a", "b", "c"],
        "n_r": pa.array([50.0, 51.0, 52.0]).dictionary_encode(),
    })  # fmt: skip
    pq.write_table(table, tmp_path / "a.parquet")
    assert refused(tmp_path / "a.parquet") == "LOG: column 'x_dem' holds string, not numbers"
    pq.write_table(table.drop_columns("x_dem"), tmp_path / "a.parquet")
    log = read(tmp_path / "a.parquet")
    assert log.channels["n_r"].t.tolist() == [0.0, 2.0] and log.channels["state"].values.tolist() == [1, 1]
    assert log.channels["n_dem"].values.tolist() == [50.0]
    assert log.notes[0] == "time: dates; 2024-01-02 10:00:00 taken for the start of the log"
    pq.write_table(pa.table({"t": ["x", "y"], "n_dem": [1.0, 2.0]}), tmp_path / "a.parquet")
    assert refused(tmp_path / "a.parquet") == "LOG: column 't' holds words that are no dates, not numbers"
    (tmp_path / "b.parquet").write_bytes(b"PAR1" * 9)
    assert "is not a Parquet file" in refused(tmp_path / "b.parquet")
    twice = pa.Table.from_arrays([pa.array([1.0])] * 3, names=["t", "a", "a"])
    pq.write_table(twice, tmp_path / "a.parquet")
    assert refused(tmp_path / "a.parquet") == "LOG: column 'a' is there more than once"


class Claims:
    """What a Parquet file says of itself, without being it."""

    def __init__(self, rows: int, bytes_: int, columns: int):
        self.schema_arrow = pa.schema([("t", pa.float64()), *((f"c{k}", pa.float64()) for k in range(columns - 1))])
        self.metadata, self.num_rows, self.num_row_groups, self.total_byte_size = self, rows, 2, bytes_

    def row_group(self, k: int) -> Claims:
        return Claims(0, self.total_byte_size // 2 + (self.total_byte_size % 2) * k, 1)


@pytest.mark.parametrize(("more", "fine"), [(0, True), (1, False)])
def test_a_parquet_file_has_four_million_rows_and_two_a_byte_at_most(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, more: int, fine: bool
) -> None:
    file = csv(tmp_path, b"x" * 1000, "a.parquet")
    rows = 4_000_000 + 2 * 1000 + more
    monkeypatch.setattr(pq, "ParquetFile", lambda _: Claims(rows, 0, 3))
    if fine:
        assert offered(file) == ["t", "c0", "c1"]
    else:
        assert refused(file) == f"LOG: 1,000 bytes say that they hold {rows:,} rows; allowed: up to {rows - 1:,}"
    unpacked = 40 * 3 * (500 + 100_000) + 100 * 1000 + more
    monkeypatch.setattr(pq, "ParquetFile", lambda _: Claims(500, unpacked, 3))
    if fine:
        assert offered(file) == ["t", "c0", "c1"]
    else:
        assert (
            refused(file) == f"LOG: 1,000 bytes say that they unpack to {unpacked:,}; allowed: up to {unpacked - 1:,}"
        )


def test_a_table_with_a_row_a_frame_holds_from_that_frame_on(tmp_path: Path) -> None:
    columns: dict[str, Any] = {"t": [0.0, 1.0], "n_dem": [1.0, 2.0]}
    columns |= {n: ["a", "b"] for n in ("id", "extended", "kind", "tx", "length", "bytes", "time")}
    pq.write_table(pa.table(columns), tmp_path / "a.parquet")
    assert read(tmp_path / "a.parquet").channels["n_dem"].framed
    del columns["bytes"]
    pq.write_table(pa.table(columns), tmp_path / "a.parquet")
    assert not read(tmp_path / "a.parquet").channels["n_dem"].framed


# ---- the time --------------------------------------------------------------------------------------------------------


def dates(*cells: str | None) -> Any:
    """Seconds; the place of a cell that is none as those before it; None where they are none."""
    found = from_dates(pa.array(list(cells), pa.string()))
    return found.row if isinstance(found, OddRow) else None if found is None else found[0].tolist()


NINE = dt.datetime(2024, 3, 7, 9, 8, 7, 654321)


@pytest.mark.parametrize(
    "form",
    [
        "%Y-%m-%d %H:%M:%S.%f",
        "%Y/%m/%d %H:%M:%S.%f",
        "%d.%m.%Y %H:%M:%S.%f",
        "%d.%m.%y %H:%M:%S.%f",
        "%d/%m/%Y %H:%M:%S.%f",
        "%m/%d/%y %H:%M:%S.%f",
        "%y/%m/%d %H:%M:%S.%f",
        "%Y%m%d %H:%M:%S.%f",
        "%Y-%m-%dT%H:%M:%S,%fZ",
        "%Y-%m-%d  %H:%M:%S.%f+02:00",
        "%Y-%m-%d %H:%M:%S.%f -0330",
        "%H:%M:%S.%f",
        "%d.%m.%Y %H:%M:%S,%f",
        "%m/%d/%Y %I:%M:%S.%f %p",
        "%d %b %Y %H:%M:%S.%f",
        "%d-%B-%Y %H:%M:%S.%f",
        "%b %d, %Y %H:%M:%S.%f",
        "%Y-%m-%d %H:%M:%S.%f UTC",
    ],
)
@pytest.mark.parametrize("later", [1e-6, 0.25, 59.5, 3599.000001, 40_000.0])
def test_dates_of_every_form_are_the_seconds_between_them(form: str, later: float) -> None:
    other = NINE + dt.timedelta(seconds=later)
    assert dates(NINE.strftime(form), None, other.strftime(form))[::2] == pytest.approx([0.0, later], abs=1e-9)


@given(st.datetimes(dt.datetime(1970, 1, 1), dt.datetime(2068, 12, 31)), st.integers(1, 86_399_999_999))
def test_halves_of_the_day_and_months_in_words_say_what_their_numbers_say(first: dt.datetime, later: int) -> None:
    cells = [first, first + dt.timedelta(microseconds=later)]
    want = dates(*(c.strftime("%Y-%m-%d %H:%M:%S.%f") for c in cells))
    german = ("Jan", "Feb", "Mär", "Apr", "Mai", "Juni", "Juli", "Aug", "Sept.", "Okt", "Nov", "Dez")
    for form in ("%Y-%m-%d %I:%M:%S.%f %p", "%d %b %Y %H:%M:%S.%f", "%B %d, %Y %I:%M:%S.%f%p"):
        assert dates(*(c.strftime(form) for c in cells)) == want
    assert dates(*(c.strftime(f"%d. {german[c.month - 1]} %Y %I:%M:%S.%f %p") for c in cells)) == want
    cells = [c.strftime("%Y-%m-%d %I:%M %p") for c in cells]
    assert dates(cells[0], cells[1][:-3]) == 1  # neither half: no time as the first one is


def test_days_months_leap_years_and_centuries_count_as_in_the_calendar() -> None:
    days = [
        "1999-12-31 00:00",
        "2000-02-28 23:59",
        "2000-03-01 00:00",
        "2023-02-28 12:00",
        "2023-03-01 12:00",
        "2024-12-31 23:59:60",
    ]
    real = [dt.datetime.fromisoformat(d.replace(":60", ":59")) for d in days]
    want = [(r - real[0]).total_seconds() + d.endswith(":60") for r, d in zip(real, days, strict=True)]
    assert dates(*days) == pytest.approx(want)
    assert dates("01.01.68 00:00", "01.01.69 00:00") == pytest.approx(
        [0.0, (dt.datetime(1969, 1, 1) - dt.datetime(2068, 1, 1)).total_seconds()]
    )
    for wrong in ("2023-02-29 12:00", "2023-13-01 12:00", "2023-00-01 12:00", "2023-04-31 12:00", "2023-04-01 24:00",
                  "2023-04-01 12:60", "2023-04-01 12:00:61", "2023-04-00 12:00", "2023-04-01", "12", "x"):  # fmt: skip
        assert dates(wrong) is None, wrong
    assert dates("2023-04-01 23:59:60") == [0.0] and dates(None) is None
    assert dates("2023-04-01 12:00", None, "x", "y") == 2


def test_zones_are_all_there_or_none_and_their_sign_is_that_of_hours_and_minutes() -> None:
    assert dates("2024-01-01 12:00:00+05:30", "2024-01-01 12:00:00Z", "2024-01-01 12:00:00-00:30") == pytest.approx(
        [0.0, 19_800.0, 21_600.0]
    )
    assert dates("2024-01-01 12:00:00-03:30", "2024-01-01 12:00:00+00:00") == pytest.approx([0.0, -12_600.0])
    assert dates("2024-01-01 12:00:00", "2024-01-01 12:00:00Z") == 1


def test_a_time_of_day_that_falls_by_more_than_half_a_day_has_passed_midnight() -> None:
    assert dates("23:59:59", "00:00:01", "12:00:01") == pytest.approx([0.0, 2.0, 43_202.0])
    assert dates("13:00:00", "01:00:00") == pytest.approx([0.0, -43_200.0])
    assert dates("13:00:00.000001", "01:00:00") == pytest.approx([0.0, 43_199.999999])
    assert dates("23:00", "01:00", "23:00", "01:00")[-1] == pytest.approx(26 * 3600.0)


@given(st.integers(0, 12_000), st.integers(1, 40), st.sampled_from([1, 5, 49, 50, 51, 1200]), st.booleans())
@settings(max_examples=examples(40))
def test_every_row_says_which_number_is_the_day(first: int, step: int, n: int, day_first: bool) -> None:
    """Two forms that all rows have are refused beyond one day; a row that has one alone decides, wherever it stands."""
    form = "%d/%m/%Y %H:%M" if day_first else "%m/%d/%Y %H:%M"
    days = [dt.datetime(2001, 1 + k * step % 12, 1 + (first + k) % 12) for k in range(n)]  # of which none decides
    days.append(dt.datetime(2001, 1, 1) + dt.timedelta(days=first, hours=step))
    text = [d.strftime(form) for d in days]

    def as_other(form: str) -> list[dt.datetime] | None:
        try:
            return [dt.datetime.strptime(cell, form) for cell in text]
        except ValueError:
            return None

    read = [d for f in ("%d/%m/%Y %H:%M", "%m/%d/%Y %H:%M") if (d := as_other(f)) is not None]
    alike = len(read) == 1 or len({d.date() for d in read[0]}) == 1
    want = [(d - read[0][0]).total_seconds() for d in read[0]] if alike else None
    assert dates(*text) == (pytest.approx(want) if alike else None)


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
@pytest.mark.parametrize(("form", "odd"), [
    ("%d/%m/%Y %H:%M:%S", "03/13/2026 00:00:00"), ("%Y-%m-%d %H:%M:%S", "2026-02-29 00:00:00"),
    ("%H:%M:%S", "24:00:00"),
    ("%d.%m.%Y %H:%M:%S", "stopped"), ("%Y-%m-%dT%H:%M:%SZ", "2026-03-14T00:00:00"),
])  # fmt: skip
def test_a_row_that_is_no_date_as_those_before_is_refused_by_its_number(
    tmp_path: Path, suffix: str, form: str, odd: str
) -> None:
    stamps = [(dt.datetime(2026, 3, 14) + dt.timedelta(seconds=k)).strftime(form) for k in range(90)]
    stamps[70] = odd
    if suffix == ".csv":
        csv(tmp_path, "time,n_dem\n" + "".join(f"{s},{60 + k % 7}\n" for k, s in enumerate(stamps)))
    else:
        pq.write_table(pa.table({"time": stamps, "n_dem": [60.0 + k % 7 for k in range(90)]}), tmp_path / "a.parquet")
    row = 72 if suffix == ".csv" else 71
    assert refused(tmp_path / f"a{suffix}") == f"LOG: column 'time', row {row}: {odd!r} is no time as {stamps[0]!r} is"


def test_a_day_and_a_month_that_cannot_be_told_apart_do_not_matter_within_a_day() -> None:
    assert dates("03/04/2024 10:00", "03/04/2024 11:00") == [0.0, 3600.0]
    assert dates("03/04/2024 10:00", "04/04/2024 10:00") is None
    assert dates("13/04/2024 10:00", "14/04/2024 10:00") == [0.0, 86_400.0]
    assert dates("04/13/2024 10:00", "04/14/2024 10:00") == [0.0, 86_400.0]
    # any row may tell them apart
    for n in (1, 49, 50, 2000):
        assert dates(*["03/04/2024 10:00"] * n, "13/04/2024 10:00")[-1] == pytest.approx(10 * 86_400.0)


@pytest.mark.parametrize(
    ("start", "step", "unit"),
    [
        (45_000.0, 1e-6, "day"),
        (45_000.0, 4.9e-5, "day"),
        (45_000.0, 5.1e-5, ""),
        (25_001.0, 1e-6, "day"),
        (24_999.0, 1e-6, ""),
        (74_999.0, 1e-6, "day"),
        (75_001.0, 1e-6, ""),
        (1.7e9, 0.01, ""),
        (4.09e9, 1.0, ""),
        (4.11e9, 1.0, ""),
        (1.7e12, 10.0, "ms"),
        (3.11e11, 10.0, "ms"),
        (3.09e11, 10.0, ""),
        (4.09e12, 10.0, "ms"),
        (1.7e15, 1e4, "us"),
        (3.11e14, 1e4, "us"),
        (3.09e14, 1e4, ""),
        (4.09e15, 1e4, "us"),
        (1.7e18, 1e7, "ns"),
        (3.11e17, 1e7, "ns"),
        (3.09e17, 1e7, ""),
        (4.09e18, 1e7, "ns"),
        (4.11e18, 1e7, ""),
    ],
)
def test_a_time_that_says_a_date_between_1980_and_2100_has_its_unit(start: float, step: float, unit: str) -> None:
    t = start + step * (np.arange(20) - 10)
    said, why = guess_unit(t)
    assert said == unit
    if unit == "day":
        assert why == f"{np.median(t):.6g} counts days since 1900 as Excel does"
    elif unit:
        assert why == f"{np.median(t):.6g} counts {unit} since 1970"
    assert guess_unit(t[:1]) == ("", "") and guess_unit(t[:2])[0] in (unit, "")


def test_of_several_times_a_unit_and_a_clock_decide() -> None:
    found, sure = guess_column(["Date", "Uhrzeit", "speed"])
    assert found == ["Uhrzeit"] and sure == pytest.approx(0.98)
    assert guess_column(["Uhrzeit", "Messzeit_s"])[0] == ["Messzeit_s"]
    assert guess_column(["Uhrzeit", "Laufzeit"])[0] == ["Uhrzeit", "Laufzeit"]
    assert guess_column(["time 2", "Datum"])[0] == ["Datum"] and guess_column(["speed"]) == ([], 0.0)
    assert guess_column(["Datetime", "Date"])[0] == ["Datetime"]


def test_a_time_of_another_name_is_guessed_and_told(tmp_path: Path) -> None:
    file = csv(tmp_path, "Messzeit_ms,n_dem\n0,50\n1000,51\n2000,52\n")
    log = read(file)
    assert log.channels["n_dem"].t.tolist() == [0, 1, 2]
    assert log.notes[0] == (
        "t: guessed to be 'Messzeit_ms', 98 % sure (its name says time in ms); "
        "--map NAME=t takes another, --no-guess none"
    )
    with pytest.raises(NoTime) as caught:
        read(file, guess=False)
    assert caught.value.headers == ["Messzeit_ms", "n_dem"] and offered(file) == ["Messzeit_ms", "n_dem"]
    assert "no column 'Zeit' to map to t; the file has 2 columns" in refused(file, mapping={"Zeit": "t"})
    two = csv(tmp_path, "Uhrzeit,Laufzeit,n_dem\n0,0,50\n1,1,51\n")
    assert refused(two) == "LOG: the time may be 'Uhrzeit' or 'Laufzeit': --map NAME=t takes one"
    assert values(two, mapping={"Laufzeit": "t"}) == [50, 51]
    assert offered(csv(tmp_path, "t,n_dem,,b\n0,1,2,3\n")) == ["t", "n_dem", "b"]


@pytest.mark.parametrize(
    ("header", "split"),
    [
        ("a [mm]", ("a", "mm")),
        (" a(mm) ", ("a", "mm")),
        ("a", ("a", "")),
        ("a [b] [c]", ("a [b] [c]", "")),
        ("a []", ("a", "")),
        ("[mm]", ("[mm]", "")),
    ],
)
def test_a_bracket_behind_a_header_is_its_unit(header: str, split: tuple[str, str]) -> None:
    assert split_unit(header) == split


# ---- units -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("unit", "into", "a", "b"),
    [
        ("%", "%", 1.0, 0.0),
        ("ratio", "%", 100.0, 0.0),
        ("rpm", "rpm", 1.0, 0.0),
        ("1/min", "rpm", 1.0, 0.0),
        ("Hz", "rpm", 60.0, 0.0),
        ("kHz", "rpm", 60_000.0, 0.0),
        ("rps", "rpm", 60.0, 0.0),
        ("rad/s", "rpm", 30.0 / np.pi, 0.0),
        ("m", "mm", 1e3, 0.0),
        ("inch", "mm", 25.4, 0.0),
        ("\u00b5m", "mm", 1e-3, 0.0),
        ("A", "mA", 1e3, 0.0),
        ("bar", "MPa", 0.1, 0.0),
        ("psi", "MPa", 6.894757293e-3, 0.0),
        ("K", "degC", 1.0, -273.15),
        ("\u00b0F", "degC", 5 / 9, -160 / 9),
        ("C", "degC", 1.0, 0.0),
        ("rad", "deg", 180 / np.pi, 0.0),
        ("\u00b0", "deg", 1.0, 0.0),
        ("min", "s", 60.0, 0.0),
        ("day", "s", 86_400.0, 0.0),
        ("ns", "s", 1e-9, 0.0),
        (" MM ", "mm", None, 0.0),
    ],
)
def test_units_convert_as_the_books_say(unit: str, into: str, a: float | None, b: float) -> None:
    found = factor_of(unit, into)
    if a is None:
        assert not isinstance(found, tuple) or found[0] != 1.0  # a unit's letters count: MM is no mm
        return
    assert found == pytest.approx((a, b), rel=1e-9, abs=1e-9)


def test_what_is_no_unit_is_none_and_what_does_not_convert_is_named() -> None:
    assert factor_of("quux", "mm") is None and factor_of("9**9**9", "mm") is None and factor_of("m^10", "mm") is None
    assert (
        factor_of("m\n", "mm") == (1000.0, 0.0)
        and factor_of("x" * 33, "mm") is None
        and factor_of("1000", "mm") is None
    )
    assert factor_of("bar", "mm") == "bar" and factor_of("m^9", "mm") == "m^9" and factor_of("$", "mm") is None
    assert isinstance(pint.UnitRegistry(), pint.UnitRegistry) and all(factor_of(u, u) is not None for u in USUAL_UNITS)
    long = "m" + "*m/m" * 7
    assert len(long) == 29 and isinstance(factor_of(long, "mm"), tuple)
    assert isinstance(factor_of(long + "*mm/mm"[:0] + " " * 9, "mm"), tuple)
    assert factor_of("m*m/m*m/m*m/m*m/m*m/m*m/m*m/m*1 ".replace("*1 ", "") + "*m/m", "mm") is None


def convert(signal: str, unit: str, stated: str = "", rpm: float | None = None) -> tuple[Any, list[str]]:
    notes: list[str] = []
    units = Units(Path("LOG"), {signal: stated} if stated else {}, rpm, notes)
    given = np.array([1.0, 2.0])
    return units.convert(signal, "key", given, unit).tolist(), notes


def test_a_channel_is_brought_to_its_own_unit_with_its_sign() -> None:
    assert convert("x_dem", "m") == ([1000.0, 2000.0], []) and convert("x_dem", "m", "-cm") == ([-10.0, -20.0], [])
    assert convert("x_dem", "", "-mm") == ([-1.0, -2.0], []) and convert("x_dem", "-mm")[0] == [1.0, 2.0]
    assert convert("t_oil", "K", "-K")[0] == pytest.approx([-274.15, -275.15])
    for none in ("", "-", "none", "n/a", "null", "NULL", "1", "mm"):
        assert convert("x_dem", none) == ([1.0, 2.0], [])
    assert convert("x_dem", "quux") == ([1.0, 2.0], ["x_dem (key): unit 'quux' is not known, mm assumed"])
    assert convert("n_r", "rpm", rpm=200.0)[0] == [0.5, 1.0] and convert("n_r", "", "-Hz", 200.0)[0] == [-30.0, -60.0]
    assert convert("state", "quux") == ([1.0, 2.0], []) and convert("t", "ms")[0] == pytest.approx([0.001, 0.002])
    for arguments, said in (
        (
            ("x_dem", "bar"),
            "LOG: x_dem (key) in 'bar': unit does not convert; allowed: mm or what converts to it (--unit x_dem=..., "
            "with gain and zero --unit 'x_dem=2.5*mm-10')",
        ),
        (("x_dem", "", "quux"), "LOG: x_dem (key) in 'quux': unit is not known; allowed: mm or what converts to it"),
        (("n_r", "mm"), "unit does not convert; allowed: %, or rpm, Hz, rad/s with the design speed (--unit n_r=..."),
        (
            ("n_r", "rpm"),
            "LOG: n_r (key) is in rpm and needs the design speed to become %; --design-rpm R gives the design speed",
        ),
        (("x_dem", "mm", "1"), "unit does not convert"),
    ):
        with pytest.raises(LogError) as caught:
            convert(*arguments)
        assert said in str(caught.value)


def test_a_unit_that_the_user_states_is_checked_before_the_log_is_opened(tmp_path: Path) -> None:
    file = csv(tmp_path, f"t,n_dem\n{ROWS}")
    assert (
        refused(file, units={"n_dem": "mm"})
        == "LOG: --unit n_dem=mm: unit does not convert; allowed: %, rpm, Hz or rad/s"
    )
    assert (
        refused(file, units={"x_dem": "bar"})
        == "LOG: --unit x_dem=bar: unit does not convert; allowed: mm or what converts to it"
    )
    assert "unit is not known (did you mean rpm?)" in refused(file, units={"n_r": "rpmm"})
    for fine in ("%", "", "-", "rpm"):
        assert values(file, units={"n_dem": fine}, design_rpm=100.0)
    assert "is not a signal; close: n_dem, x_dem; allowed: n_dem, n_r" in refused(file, units={"n_den": "%"})
    assert "required 'foo': is not a signal" in refused(file, require=("foo",))
    for rpm in (0.0, -1.0, np.inf):
        assert f"design speed (={rpm:g} rpm) must be finite and above 0" in refused(file, design_rpm=rpm)


# ---- reading ---------------------------------------------------------------------------------------------------------


def test_names_may_be_mapped_both_ways_and_not_twice(tmp_path: Path) -> None:
    file = csv(tmp_path, "t,N1,N2\n0,50,60\n1,51,61\n")
    assert values(file, mapping={"N1": "n_dem", "n_r": "N2"}) == [50, 51]
    assert "map a=b: 'b' is not a signal" in refused(file, mapping={"a": "b"})
    assert "both 'N1' and 'N2' are mapped to n_dem" in refused(file, mapping={"N1": "n_dem", "N2": "n_dem"})
    assert values(file, mapping={"n1": "n_dem"}) == [50, 51]
    assert (
        refused(file, mapping={"N3": "n_dem"})
        == "LOG: no column 'N3' to map to n_dem; the file has 3 columns: t, N1, N2"
    )
    assert "no n_dem: looked for column 'n_dem'; --map NAME=n_dem names another" in refused(
        file, require=("n_dem",), guess=False
    )
    one = csv(tmp_path, "t,n_dem\n0,50\n")
    assert "only one sample of n_dem" in refused(one, require=("n_dem",)) and values(one) == [50]


def test_wild_samples_are_left_out_and_the_furthest_is_named(tmp_path: Path) -> None:
    rows = "".join(f"{k},{v}\n" for k, v in enumerate([50.0] * 19 + [-300.0, 200.0]))
    log = read(csv(tmp_path, "t,n_dem\n" + rows))
    assert log.channels["n_dem"].t.tolist() == list(range(19))
    assert log.notes == ["n_dem (n_dem): 2 of 21 samples are outside -10 to 150 % (furthest -300): left out"]
    both = csv(tmp_path, "t,n_dem,n_r,x_dem\n0,9000,9000,1\n1,9000,9000,2\n")
    assert refused(both) == (
        "LOG: n_dem (n_dem): all values are outside -10 to 150 % (median of these 9,000); "
        "--unit n_dem=rpm --design-rpm R, if it is in rpm; the same for n_r"
    )
    mode = csv(tmp_path, "t,state\n" + "".join(f"{k},{9 if k == 3 else 2}\n" for k in range(20)))
    assert read(mode).notes == ["state (state): 1 of 20 samples are outside 0 to 4 (furthest 9): left out"]
    with pytest.raises(LogError, match="LOG: x_dem"):
        Log("LOG", {"x_dem": Channel(np.arange(2.0), np.array([900.0, 900.0]))})
    with pytest.raises(LogError, match="spans 30,000 s with 2 rows; .* --unit t=us, if time counts in us"):
        Log("LOG", {"x_dem": Channel(np.array([0.0, 3e4]), np.ones(2))})
    Log("LOG", {"x_dem": Channel(np.arange(2.0), np.array([900.0, 900.0]))}, signals={"x_dem": "N"})


def test_rows_with_a_wrong_stamp_are_left_out_and_the_first_is_named(tmp_path: Path) -> None:
    t = [*range(30)]
    t[20] = 3
    file = csv(tmp_path, "t,n_dem,x_dem\n" + "".join(f"{s},50,{k}\n" for k, s in enumerate(t)))
    log = read(file)
    assert log.channels["x_dem"].values.tolist() == [k for k in range(30) if k != 20]
    assert log.notes == ["time: 1 of 30 rows have a wrong time stamp (first row 22: 3 s): left out"]
    back = csv(tmp_path, "t,n_dem\n" + "".join(f"{s},50\n" for s in [*range(30), *range(10, 40)]))
    assert refused(back) == "LOG: n_dem (n_dem): time runs backwards at row 32, from 29 s to 10 s"
    # a channel with a block of rows of its own
    text = "t,n_dem,x_dem\n" + "".join(f"{k},50,\n" for k in range(20)) + "".join(f"{k},,9\n" for k in range(5))
    log = read(csv(tmp_path, text))
    assert log.channels["n_dem"].t.size == 20 and log.channels["x_dem"].t.tolist() == [0, 1, 2, 3, 4]


def test_of_samples_at_one_time_the_last_counts_and_half_of_them_may_differ(tmp_path: Path) -> None:
    file = csv(tmp_path, "t,n_dem\n0,50\n1,51\n1,52\n2,53\n")
    log = read(file)
    assert log.channels["n_dem"].values.tolist() == [50, 52, 53]
    assert log.notes[0].startswith("n_dem (n_dem): 1 of 4 samples have the time of the next: ")
    half = csv(tmp_path, "t,n_dem\n" + "".join(f"{k // 2},{50 + k}\n" for k in range(20)))
    assert read(half).channels["n_dem"].t.size == 10
    three = csv(tmp_path, "t,n_dem\n" + "".join(f"{k // 3},{50 + k}\n" for k in range(21)))
    assert "LOG: n_dem (n_dem): 14 of 21 samples have the time of the next: the times need more digits" in refused(
        three
    )
    same = csv(tmp_path, "t,n_dem\n" + "".join(f"{k // 3},50\n" for k in range(21)))
    assert read(same).channels["n_dem"].t.size == 7


def test_a_time_far_from_zero_is_counted_from_the_start(tmp_path: Path) -> None:
    for start, note in (
        (10_000.0, None),
        (10_000.5, "time does not count from the start: 10000.500000 s taken for the start of the log"),
        (1.0e8, "time does not count from the start: 100000000.000000 s taken"),
        (1.7e9, "time counts from 1970: 1700000000.000000 s taken for the start of the log"),
    ):
        log = read(csv(tmp_path, f"t,n_dem,x_dem\n{start},,1\n{start + 1},50,2\n"))
        assert log.channels["n_dem"].t.tolist() == ([start + 1] if note is None else [1.0])
        assert log.notes == [] if note is None else log.notes[0].startswith(note)
    excel = csv(tmp_path, "t,n_dem\n45000.0,50\n45000.00001157407,51\n")
    log = read(excel)
    assert any(n.startswith("time counts from 1900: ") for n in log.notes)
    assert "time (=1.05e+11 s) must be below 1e+10 s; --unit t=ns, if it is in ns" in refused(
        csv(tmp_path, "t,n_dem\n1e11,1\n1.1e11,2\n"), guess=False
    )
    jump = (
        "t,n_dem,x_dem\n" + "".join(f"{k},50,\n" for k in range(12)) + "".join(f"{1e6 + k},51,5\n" for k in range(30))
    )
    log = read(csv(tmp_path, jump))
    assert log.channels["n_dem"].t.size == 30 and "only the longer part is kept, 30 of 42" in log.notes[0]
    lost = (
        "t,n_dem,x_dem\n" + "".join(f"{k},50,5\n" for k in range(12)) + "".join(f"{1e6 + k},51,\n" for k in range(30))
    )
    assert "no x_dem in the part of the log that is kept (time jumps" in refused(
        csv(tmp_path, lost), require=("x_dem",)
    )
    assert "x_dem" not in read(csv(tmp_path, lost)).channels
    assert "time jumps 2 times" in refused(
        csv(tmp_path, "t,n_dem\n" + "".join(f"{1e6 * j + k},50\n" for j in range(3) for k in range(12)))
    )


def test_a_channel_far_too_small_is_refused_or_told(tmp_path: Path) -> None:
    ramp = "".join(f"{0.01 * k},{0.0005 * k},{0.3 * k},{0.001}\n" for k in range(100))
    line = refused(csv(tmp_path, "t,x_dem,n_r,vgv1\n" + ramp))
    assert (
        line.startswith("LOG: x_dem (x_dem): all values are within 0 to 0.0495 mm, which is too little")
        and "the same" not in line
    )
    told = read(csv(tmp_path, "t,x_dem,n_r,vgv1\n" + ramp), units={"x_dem": "mm"})
    assert any(
        n.startswith("vgv1 (vgv1): all values are within 0.001 to 0.001 deg; if they are in rad") for n in told.notes
    )
    two = csv(tmp_path, "t,x_dem,x_lvdt\n" + "".join(f"{0.01 * k},{0.0005 * k},{0.0004 * k}\n" for k in range(100)))
    assert refused(two).endswith("; the same for x_lvdt")


@pytest.mark.parametrize(
    ("channels", "said"),
    [
        ({}, "no channel to write"), ({"n_den": (np.zeros(1), np.zeros(1))}, "'n_den' is not a signal; close: n_dem"),
        ({"n_dem": (np.zeros(2), np.zeros(3))}, "n_dem: t (2,) and values (3,) must be lists of one length, not empty"),
        ({"n_dem": (np.zeros(0), np.zeros(0))}, "must be lists of one length, not empty"),
        ({"n_dem": (np.zeros((1, 1)), np.zeros((1, 1)))}, "must be lists of one length"),
        ({"n_dem": (np.zeros(2), np.zeros(2))}, "samples must be finite and their times increasing"),
        ({"n_dem": (np.array([0.0, np.nan]), np.zeros(2))}, "samples must be finite"),
        ({"n_dem": (np.arange(2.0), np.array([0.0, np.inf]))}, "samples must be finite"),
    ],
)  # fmt: skip
def test_what_is_no_channel_is_not_written(tmp_path: Path, channels: dict[str, Any], said: str) -> None:
    with pytest.raises(LogError) as caught:
        write_log(tmp_path / "a.csv", {n: Channel(*c) for n, c in channels.items()})
    assert said in str(caught.value)


def test_a_suffix_that_is_no_log_s_is_refused(tmp_path: Path) -> None:
    for act in (read, lambda p: write_log(p, {"n_dem": Channel(np.zeros(1), np.zeros(1))}), offered):
        with pytest.raises(
            LogError,
            match=r"suffix '.txt' is not a log's; allowed: .log, .can, .crtd, .crt, .asc, .blf, .trc, .mf4, .dat, "
            r".mdf, .csv, .msl, .lvm, .parquet",
        ):
            act(tmp_path / "a.txt")
    assert values(csv(tmp_path, f"t,n_dem\n{ROWS}", "A.CSV")) == [50, 51, 52]
    with pytest.raises(LogError, match="cannot write .*a.csv: No such file or directory"):
        write_log(tmp_path / "no" / "a.csv", {"n_dem": Channel(np.zeros(1), np.zeros(1))})


# ---- files and names -------------------------------------------------------------------------------------------------


def test_a_file_has_four_gigabytes_at_most(tmp_path: Path) -> None:
    file = tmp_path / "a.log"
    with file.open("wb") as f:
        f.truncate(4 << 30)
    assert check_file(file) == 4294967296
    with file.open("wb") as f:
        f.truncate((4 << 30) + 1)
    for path, said in (
        (file, "4294967297 bytes; allowed: up to 4294967296"),
        (tmp_path, "is a folder, not a log"),
        (tmp_path / "none", "cannot be read (No such file or directory)"),
        (Path("/dev/null"), "is not a file, not a log"),
    ):
        with pytest.raises(LogError) as caught:
            check_file(path)
        assert said in str(caught.value)
    file.write_bytes(b"")
    with pytest.raises(LogError, match="is empty"):
        check_file(file)
    file.write_bytes(b"abcdef")
    assert (read_bytes(file), read_bytes(file, 4)) == (b"abcdef", b"abcd")


def test_a_refusal_is_one_printable_line_of_a_thousand_letters() -> None:
    assert str(LogError("a\n\tb\x00  c")) == "a b c"
    assert len(str(LogError("x" * 1001))) == 1000 and len(str(LogError("x" * 1000))) == 1000


def test_names_on_offer_are_shortened_to_twelve_of_sixty_letters() -> None:
    assert (
        names_held("column", []) == "; the file has no column"
        and names_held("column", ["a"]) == "; the file has 1 column: a"
    )
    assert names_held("signal", "abcdefghijkl") == "; the file has 12 signals: a, b, c, d, e, f, g, h, i, j, k, l"
    assert names_held("signal", "abcdefghijklmn").endswith("k, l and 2 more") and "x" * 61 not in names_held(
        "c", ["x" * 61]
    )
    assert (
        close_names("n_den", ["n_dem", "n_r", "x_dem"]).startswith("; close: n_dem")
        and close_names("qqq", ["n_dem"]) == ""
    )
    assert close_names("aaaa", [f"aaaa{k}" for k in range(9)]).count("aaaa") == 4
    assert (
        close_names("abcde", ["abcxx"]) == "; close: abcxx" and close_names("abcde", ["abxxx"]) == ""
    )  # 0.6 alike, and 0.4


def test_numbers_of_arrow_are_scaled_and_what_is_absent_is_told_from_nan() -> None:
    column = pa.array([1.0, None, float("nan"), 4.0] * 5).slice(1, 17)
    found = numbers(column, 2.0)
    want = [None, np.nan, 8.0, 2.0] * 4 + [None]
    assert is_absent(found).tolist() == [w is None for w in want]
    np.testing.assert_array_equal(found, [np.nan if w is None else w for w in want])
    assert numbers(pa.array([1.0, 2.0])).tolist() == [1.0, 2.0] and np.isnan(ABSENT)
    assert numbers(pa.nulls(3, pa.float64())).size == 3


# ---- mapping files ---------------------------------------------------------------------------------------------------


def test_a_mapping_file_is_written_with_remarks_and_read_again(tmp_path: Path) -> None:
    bench = Bench({"n_dem": 'a "b" \u00e4\x7f'}, {"n_dem": "rpm"}, 9000.0, tmp_path / "x.dbc")
    write_mapping(tmp_path / "m.toml", bench, {"n_dem": "why\n so"}, "head\nof two lines")
    text = (tmp_path / "m.toml").read_text()
    assert text.startswith("# head\n# of two lines\ndesign_rpm = 9000.0  # rotor speed that is 100 %\ndbc = ")
    assert "\n\n[names]  # signal = name in the log\nn_dem = " in text and "  # why so\n" in text
    assert text.endswith('\n\n[units]  # signal = unit in the log\nn_dem = "rpm"\n')
    assert read_mapping(tmp_path / "m.toml") == bench
    (tmp_path / "r.toml").write_text('dbc = "y.dbc"\n')
    assert read_mapping(tmp_path / "r.toml").dbc == tmp_path / "y.dbc"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("name = 1", "'name' is unknown; close: names; allowed: names, units, design_rpm, dbc"),
        ("names = 1", "names (=1) must be a table"),
        ("[names]\nn_den = 'a'", "names.n_den: is not a signal; close: n_dem"),
        ("[units]\nn_dem = 1", "units.n_dem (=1) must be a word"),
        ("[names]\nn_dem = ' '", "must be a word in quotation marks"),
        ("design_rpm = 0", "design_rpm (=0 rpm) must be above 0 and below 10,000,000"),
        ("design_rpm = 1e7", "must be above 0"),
        ("design_rpm = true", "design_rpm (=True rpm)"),
        ("design_rpm = 'a'", "design_rpm (='a' rpm)"),
        ("dbc = 1", "dbc (=1) must be a file name"),
    ],
)
def test_a_wrong_line_of_a_mapping_file_is_named(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "m.toml").write_text(text)
    with pytest.raises(LogError) as caught:
        read_mapping(tmp_path / "m.toml")
    assert said in str(caught.value)
    (tmp_path / "m.toml").write_text("design_rpm = 9999999.0\n[names]\nt = 'a'")
    assert read_mapping(tmp_path / "m.toml").design_rpm == 9999999.0


def test_a_mapping_file_says_it_all_and_what_the_log_lacks_is_told(tmp_path: Path) -> None:
    file = csv(tmp_path, "t,N1,speed_act\n0,500,500\n1,510,510\n")
    (tmp_path / "m.toml").write_text("design_rpm = 1000\n[names]\nn_dem = 'N1'\nx_dem = 'X'\n[units]\nn_dem = 'rpm'\n")
    log = read(file, mapping_file=tmp_path / "m.toml")
    assert set(log.channels) == {"n_dem"} and log.channels["n_dem"].values.tolist() == pytest.approx([50, 51])
    assert log.notes == [f"x_dem: {tmp_path / 'm.toml'} calls it 'X', which the log does not have"]
    beside = read(file, mapping_file=tmp_path / "m.toml", design_rpm=60_000.0, units={"n_dem": "Hz"})
    assert beside.channels["n_dem"].values.tolist() == pytest.approx([50, 51])  # what is given beside it goes before


def test_the_unit_that_a_mapped_name_says_is_taken_and_told(tmp_path: Path) -> None:
    file = csv(tmp_path, "t_ms,N1_rpm,stroke_cmd_m\n0,500,0.01\n1000,510,0.02\n")
    options: dict[str, Any] = {
        "mapping": {"t_ms": "t", "N1_rpm": "n_dem", "stroke_cmd_m": "x_dem"},
        "design_rpm": 1000.0,
    }
    log = read(file, **options)
    assert log.channels["n_dem"].t.tolist() == [0, 1] and log.channels["x_dem"].values.tolist() == pytest.approx(
        [0.01, 0.02]
    )
    assert log.channels["n_dem"].values.tolist() == pytest.approx([50.0, 51.0])
    assert "n_dem (N1_rpm): taken in rpm, as its name says; --unit n_dem=% states another" in log.notes
    assert "t (t_ms): taken in ms, as its name says; --unit t=s states another" in log.notes
    plain = read(file, guess=False, units={"n_dem": "rpm"}, **options)
    assert "t (t_ms): taken in s, though its name says ms; --unit t=ms takes that" in plain.notes


def test_systems_of_a_user_s_own_take_a_name_in_other_letters(tmp_path: Path) -> None:
    file = csv(tmp_path, "t,LOAD_m,LOAD_mm,other\n0,1,1,2\n1,2,2,3\n")
    log = read(file, signals={"load": "m"})
    assert log.channels["load"].values.tolist() == [0.001, 0.002] and log.guesses[0].why == "its name in other letters"
    assert read(file, signals={"load": "bar"}).channels == {}
    assert open_log(file, None, None, None, None, {"other": "mm"}, True, None, {}).guesses.made == {}


# ---- surveys ---------------------------------------------------------------------------------------------------------


def of(**other: str) -> Survey:
    return Survey("a", [], {}, other, [], "", None, None, None, False)


def test_unused_names_are_listed_by_reason_twenty_at_a_time() -> None:
    assert MOST_LISTED == 20
    assert of(**{f"a{k}": "why" for k in range(20)}).unused() == [", ".join(f"a{k}" for k in range(20)) + ": why"]
    assert of(**{f"a{k}": "why" for k in range(22)}).unused() == [
        ", ".join(f"a{k}" for k in range(20)) + " and 2 more: why"
    ]
    assert of(a="x", b="", c="x").unused() == ["a, c: x", "b"]


def test_a_survey_shows_every_signal_how_it_was_found_and_what_is_left(tmp_path: Path) -> None:
    t = np.arange(200) * 0.01
    rows = "".join(f"{a:g},{50 + 20 * a:g},{500 + 200 * a:g},{200 + 5 * a:g},{200},x\n" for a in t)
    file = csv(tmp_path, "t,n_dem,Nist,supply_pressure,foo,word\n" + rows)
    found = survey(file, mapping={"Nist": "n_r"}, units={"n_r": "rpm"}, design_rpm=1000.0)
    assert [(r.signal, r.name, r.unit, r.how) for r in found.rows] == [
        ("t", "t", "s", "named"), ("n_dem", "n_dem", "%", "named"), ("n_r", "Nist", "rpm", "stated"),
        ("p_s", "supply_pressure", "bar", "guessed"),
    ]  # fmt: skip
    assert found.guessed and found.complaint == "" and set(found.other) == {"foo", "word"} and not found.damaged
    speed = found.rows[2]
    assert (speed.low, speed.curve.size, speed.confidence) == (500.0, 60, 1.0) and speed.high == pytest.approx(898.0)
    assert (speed.curve[0], speed.curve[-1]) == (500.0, pytest.approx(898.0))
    assert found.rows[3].confidence == 0.88 and "its name says pressure" in found.rows[3].why
    bench = found.bench()
    assert (
        bench.names == {"t": "t", "n_dem": "n_dem", "n_r": "Nist", "p_s": "supply_pressure"}
        and bench.design_rpm == 1000.0
    )
    as_json = found.to_dict()
    assert (
        as_json["other"] == ["foo", "word"]
        and "curve" not in as_json["signals"][0]
        and as_json["why_not"] == found.other
    )
    stated = survey(file, mapping={"t": "t"}, guess=False)
    assert stated.rows[0].how == "stated" and not stated.guessed
    few = csv(tmp_path, "t,n_dem\n0,50\n1,51\n")
    assert survey(few).rows[1].curve.tolist() == [50, 51]


def test_a_survey_complains_where_reading_would(tmp_path: Path) -> None:
    none = survey(csv(tmp_path, "t,foo\n0,1\n1,2\n"))
    assert none.complaint.replace(str(tmp_path / "a.csv"), "LOG").startswith(
        "LOG: none of its names is a signal of ours (n_dem, n_r"
    )
    empty = survey(csv(tmp_path, "t,n_dem\n"))
    assert empty.complaint.endswith("a.csv: has no sample") and np.isnan(empty.rows[1].low)
    words = survey(csv(tmp_path, "t,n_dem,x_dem\n0,a,1\n1,b,2\n"))
    assert words.damaged and "row 2: 'a' is not a number" in words.complaint
    wrong = survey(csv(tmp_path, "t,n_dem\n0,9000\n1,9100\n"))
    assert "outside -10 to 150" in wrong.complaint and not wrong.damaged and wrong.rows[1].high == 9100.0
    turns = survey(csv(tmp_path, "t,speed_act_rpm\n" + "".join(f"{k},{9000 + 2 * k}\n" for k in range(30))))
    assert turns.suggested_rpm == 9100.0 and "needs the design speed" in turns.open["n_r"]
    late = survey(csv(tmp_path, "Messzeit_ms,n_dem\n0,50\n1000,51\n"))
    assert (late.rows[0].how, late.rows[0].unit, late.rows[0].confidence) == ("guessed", "ms", 0.98)


def test_a_sparkline_has_eight_steps_and_its_width_at_most() -> None:
    assert (
        sparkline(np.arange(8.0)) == "\u2581\u2582\u2583\u2584\u2585\u2586\u2587\u2588" and sparkline(np.empty(0)) == ""
    )
    assert (
        sparkline(np.arange(100.0)) == sparkline(np.linspace(0, 99, 16).astype(int).astype(float))
        and len(sparkline(np.arange(100.0))) == 16
    )
    assert sparkline(np.full(3, 5.0)) == "\u2581" * 3 and sparkline(np.arange(100.0), 4) == "\u2581\u2583\u2586\u2588"
    assert Row("a", "b", "mm", "named", 1.0, "", 0.0, 1.0, np.empty(0)).signal == "a" and "state" in UNITS


def test_rows_with_separators_in_quotes_are_counted_as_cells(tmp_path: Path) -> None:
    log = read(csv(tmp_path, 't,word,n_dem\n0,"a,b",50\n1\n2,"c,d",52,9\n3,"e",53\n'))
    assert log.channels["n_dem"].t.tolist() == [0, 3] and log.channels["n_dem"].values.tolist() == [50, 53]


class Repeats:
    """A source that offers one name under several keys, as a database does that repeats a signal."""

    kind, sorted = "signal", True

    def __init__(self, **series: list[float]):
        self.notes: list[str] = []
        self.of, self.names = series, {f"{k}.a": (f"{k}.a", "a") for k in series}

    def series(self, key: str) -> source.Series:
        values = np.array(self.of[key.split(".")[0]], float)
        return source.Series(np.arange(values.size, dtype=float), values)

    def has(self) -> str:
        return ""

    def absent(self, name: str) -> str:
        return ""


def take(of: Repeats, mapped: bool, needed: bool) -> tuple[str | None, list[str]]:
    notes: list[str] = []
    found = logs._take(Path("LOG"), of, "n_dem", "a", mapped, needed, notes)
    return (found[0] if found else None), notes


def test_of_a_name_in_several_messages_the_only_one_that_moves_is_meant() -> None:
    one = Repeats(M=[5.0, 5.0], N=[5.0, 5.5], O=[])
    assert take(one, True, False) == ("N.a", ["n_dem: took N.a; M.a, O.a never changes"])
    two = Repeats(**{k: [0.0, float(i + 1)] for i, k in enumerate("MNOPQRS")})
    assert take(two, False, False) == (
        None, ["n_dem: may be M.a or N.a or O.a or P.a or Q.a or R.a: left out (--map M.a=n_dem takes one)"]
    )  # fmt: skip
    for mapped, needed in ((True, False), (False, True)):
        with pytest.raises(
            LogError, match=r"n_dem may be M.a or N.a or O.a or P.a or Q.a or R.a; name one: --map M.a="
        ):
            take(two, mapped, needed)
    assert take(Repeats(), False, False) == (None, [])


def test_a_channel_loses_wrong_rows_unless_they_are_more_than_half_of_it(tmp_path: Path) -> None:
    wrong, few = range(50, 56), {10, 20, 30, 40, 60, 70, 50, 51, 52, 53}
    rows = [f"{3 if k in wrong else k},50,{k if k in few else ''}\n" for k in range(100)]
    log = read(csv(tmp_path, "t,n_dem,x_dem\n" + "".join(rows)))
    assert log.channels["x_dem"].values.tolist() == [10, 20, 30, 40, 60, 70] and log.channels["n_dem"].t.size == 94


def test_a_refused_channel_is_named_as_the_log_names_it(tmp_path: Path) -> None:
    file = csv(tmp_path, "t,N1\n0,9000\n1,9000\n")
    assert refused(file, mapping={"N1": "n_dem"}).startswith("LOG: n_dem (N1): all values are outside -10 to 150 %")
    good = csv(tmp_path, f"t,n_dem\n{ROWS}")
    assert values(good, design_rpm=0.5) == [50, 51, 52]
    assert values(good, units={"x_dem": "none", "state": "quux", "n_dem": "null"}) == [50, 51, 52]


@pytest.mark.parametrize(("samples", "kept"), [(1, False), (2, True)])
def test_two_samples_of_what_is_required_are_enough_in_the_part_that_is_kept(
    tmp_path: Path, samples: int, kept: bool
) -> None:
    rows = "".join(f"{k},50,5\n" for k in range(12))
    rows += "".join(f"{1e6 + k},51,{5 if k < samples else ''}\n" for k in range(30))
    file = csv(tmp_path, "t,n_dem,x_dem\n" + rows)
    if kept:
        assert read(file, require=("x_dem",)).channels["x_dem"].t.tolist() == [0.0, 1.0]
    else:
        assert "no x_dem in the part of the log that is kept" in refused(file, require=("x_dem",))


# ---- quotation marks -------------------------------------------------------------------------------------------------

QUOTED = [f"{k},{50 + k},x" for k in range(40)]


@pytest.mark.parametrize("cell", ['"', '"no', 'x"'])
@pytest.mark.parametrize("row", [0, 17, 39])
@pytest.mark.parametrize("long", [1, 8_000])
def test_a_quotation_mark_that_nobody_closes_is_refused_with_its_row(
    tmp_path: Path, cell: str, row: int, long: int
) -> None:
    lines = QUOTED * long
    lines[row] = f"{row},{50 + row},{cell}"
    text = "\n".join(["t,n_dem,remark", *lines, ""])
    if cell[0] != '"':  # within a cell it is a letter
        assert values(csv(tmp_path, "\n".join(["t,n_dem,remark", *lines[:40], ""]))) == [50.0 + k for k in range(40)]
        return
    assert f"row {row + 2}: a quotation mark opens a cell that no other one closes" in refused(csv(tmp_path, text))


def test_a_cell_in_quotation_marks_may_hold_lines(tmp_path: Path) -> None:
    text = 't,n_dem,remark\n0,50,"a ""b"" \n c, d"\n1,51,5"\n'
    assert values(csv(tmp_path, text)) == [50.0, 51.0]


# ---- channels as a frame ---------------------------------------------------------------------------------------------


def test_a_channel_is_its_samples() -> None:
    c = Channel(np.array([1.0, 2.0, 4.0]), np.array([5.0, -3.0, 7.5]))
    assert (c.framed, c.unit, c.apart) == (False, "", 0.0) and len(c) == 3 and bool(c) and list(c) == [5.0, -3.0, 7.5]
    assert np.mean(c) == pytest.approx(9.5 / 3) and np.array(c, dtype=int).tolist() == [5, -3, 7]
    part = dataclasses.replace(c, unit="mm", framed=True)[1.5:4]
    assert part.t.tolist() == [2.0] and part.values.tolist() == [-3.0] and (part.unit, part.framed) == ("mm", True)
    assert c[:].t.tolist() == [1.0, 2.0, 4.0] and c[2:].values.tolist() == [-3.0, 7.5]
    assert (
        repr(c) == "Channel(3 samples, 1 to 4 s, -3 to 7.5)"
        and repr(part) == "Channel(1 samples, 2 to 2 s, -3 to -3 mm)"
    )
    assert repr(dataclasses.replace(c, unit="-")) == repr(c)
    none = Channel(np.empty(0), np.empty(0), unit="mm")
    assert repr(none) == "Channel(no sample mm)" and bool(none) and len(none) == 0
    with pytest.raises(LogError, match=r"^channel\[3\]: allowed: a slice in s, such as channel\[10:20\]"):
        c[3]  # type: ignore[index]
    with pytest.raises(LogError, match=r"^step \(=2\) of a slice must be left out: a log is cut by its time"):
        c[0:3:2]


def test_channels_of_a_run_are_a_frame_by_name_and_by_time() -> None:
    t = np.arange(5.0)
    a, b = Channel(t, 10.0 * t, unit="mm"), Channel(t[1:] + 0.5, t[1:], True, "mA")
    run = Channels("folder/r.csv", {"a": a, "b": b})
    assert (
        run["a"] is a and list(run) == run.columns == list(run.keys()) == ["a", "b"] and "a" in run and "c" not in run
    )
    assert (
        list(run.values()) == [a, b] and dict(run.items()) == {"a": a, "b": b} and run.units == {"a": "mm", "b": "mA"}
    )
    assert len(run) == 9 and run.t.tolist() == [0.0, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 4.5] and bool(run)
    assert run[["b"]].channels == {"b": b} and run[["b"]].path == "folder/r.csv"
    part = run[2:4]
    assert part["a"].t.tolist() == [2.0, 3.0] and part["b"].t.tolist() == [2.5, 3.5] and part["b"].framed
    assert list(run[0:1]) == ["a"]  # a channel without a sample is left out
    assert repr(run) == "Channels('r.csv', 9 rows, 0 to 4.5 s: a [mm], b [mA])"
    assert Channels("x", {"a": a}).t is a.t and len(Channels("x", {"a": a, "c": dataclasses.replace(a)})) == 5
    empty = Channels("x", {})
    assert repr(empty) == "Channels('x', no rows)" and bool(empty) and len(empty) == 0
    many = Channels("x", {f"c{k}": a for k in range(10)})
    assert repr(many).endswith("c7 [mm] and 2 more)") and "more" not in repr(many[[f"c{k}" for k in range(8)]])
    with pytest.raises(LogError, match=r"^folder/r.csv: no sample in '7:9'; the log is from 0 to 4.5 s$"):
        run[7:9]
    with pytest.raises(LogError, match=r"^x: no sample in ':3'; the log has none at all$"):
        empty[:3]
    with pytest.raises(NoChannel, match=r"^folder/r.csv: no channel 'aa' \(did you mean a\?\); it has a, b$"):
        run["aa"]
    with pytest.raises(KeyError):
        run[["a", "x"]]
    for wrong in (3, ["a", 3], ("a",)):
        with pytest.raises(LogError, match=r"allowed: a name, a list of names, or a slice in s such as log\[10:20\]$"):
            run[wrong]  # type: ignore[index]
    times, columns = raster(run.channels)
    assert (
        times.tolist() == run.t.tolist() and columns["a"][:4].tolist()[:2] == [0.0, 10.0] and np.isnan(columns["a"][2])
    )
    assert columns["b"][[2, 4]].tolist() == [1.0, 2.0] and np.isnan(columns["b"][[0, 1, 3]]).all()
    assert raster({})[0].size == 0
    made = run.assign(twice="2 * a [um]", c=b, more="twice + 1")
    assert made["twice"].values.tolist() == [0.0, 2e4, 4e4, 6e4, 8e4] and made["twice"].unit == "um" and made["c"] is b
    assert made["more"].values[1] == 2e4 + 1 and list(run) == ["a", "b"]
    frame = run.to_pandas()
    assert frame.attrs == {"name": "folder/r.csv", "units": run.units, "framed": ["b"]} and frame.index.name == "t"
    assert run.to_frame().equals(frame) and a.to_pandas().attrs == {"unit": "mm"} and a.to_pandas().index.name == "t"
    cell = run._repr_html_()
    assert cell.count("<tr>") == 3 and ">20<" in cell and "r.csv: 9 rows" in cell and ">40<" in cell


# ---- rows that were written again ------------------------------------------------------------------------------------


def test_rows_that_repeat_every_channel_are_stale_where_noise_makes_that_no_chance() -> None:
    draw = np.random.default_rng(2)
    columns = [draw.standard_normal(4000).round(2) for _ in range(6)]
    stale = np.zeros(4000, dtype=bool)
    stale[[100, 101, 102, 900, 1500, 1501, 3999]] = True
    for v in columns:
        v[:] = v[np.maximum.accumulate(np.where(stale, 0, np.arange(4000)))]
    assert np.flatnonzero(stale_rows(columns)).tolist() == np.flatnonzero(stale).tolist()
    assert not stale_rows([*columns, np.arange(4000.0)]).any()  # one of them is always new
    flat = np.repeat(np.arange(400.0), 10)  # without noise nothing is stale
    assert not stale_rows([flat, flat]).any() and not stale_rows([]).any() and not stale_rows([columns[0][:9]]).any()
    slow = [np.repeat(v[:1000], 3) for v in columns]  # two rows in three: channels that are slower than the rows
    assert not stale_rows(slow).any()
    assert _turns(np.tile([0.0, 1.0], 20)) == 1.0 and _turns(np.arange(40.0)) == 0.0
    assert _turns(np.tile([0.0, 1.0], 5)) == 0.0  # too few to say
    assert _turns(np.tile([0.0, 1.0, 1.0, 2.0, 2.0, 0.0], 10)) == pytest.approx(2 / 3, abs=0.03)


# ---- gain and zero that a log says -----------------------------------------------------------------------------------


def test_the_scale_of_a_signal_is_that_of_its_peer() -> None:
    t = np.arange(400) * 0.05
    n = 70.0 + 20.0 * np.sin(0.5 * t)
    peers = {"n_r": (t, n)}

    def of(values: Any, signal: str = "n_dem", channels: Any = peers, at: Any = t) -> tuple[str, str] | None:
        return proposed_scale(signal, (at, values), channels, {})

    assert of(n) is None and of(n / 100.0) == ("100*%", "n_r") and of(n / 152.0) == ("152*%", "n_r")
    assert of(n + 30.0) == ("%-30", "n_r") and of(-n) == ("-%", "n_r") and of(-(n - 50.0) / 4.0) == ("-4*%+50", "n_r")
    assert of(n + 0.79) is None and of(n + 0.82) == ("%-0.82", "n_r")  # a fiftieth of what the peer moves
    zero = f"%{np.median(n - n / 1.09):+.4g}"  # within a tenth the gain is taken for 1
    assert of(n / 1.09) == (zero, "n_r") and of(n / 1.12) == ("1.12*%", "n_r")
    noise = np.random.default_rng(1).standard_normal(400)
    follows = 2.0 * n + np.std(n) * 2.0 * noise * np.sqrt(1.0 / 0.975**2 - 1.0)
    loose = 2.0 * n + np.std(n) * 2.0 * noise * np.sqrt(1.0 / 0.96**2 - 1.0)
    assert of(follows) is not None and of(loose) is None
    assert of(n[:49] / 100.0, at=t[:49]) is None and of(n[:50] / 100.0, at=t[:50]) is not None
    assert of(n / 100.0, at=t + 17.55) is None and of(np.full(400, 3.0)) is None and of(n / 100.0, channels={}) is None
    assert of(n / 100.0, "n_r", {"n_dem": (t, n)}) == ("100*%", "n_dem")
    x = 24.0 + 10.0 * np.sin(0.5 * t)
    assert of(x / 25.4, "x_lvdt", {"x_dem": (t, x)}) == ("25.4*mm", "x_dem")


@pytest.mark.parametrize(
    ("gain", "usual"), [(1.04, 1.0), (9.7, 10.0), (0.0243, 0.025), (-41.0, -40.0), (1.37, 1.5), (1.2, 1.2), (7.0, 7.0)]
)
def test_a_gain_is_one_that_people_choose_where_it_is_as_good(gain: float, usual: float) -> None:
    assert _usual(gain) == pytest.approx(usual)


def test_a_mean_is_that_of_what_lies_a_tenth_of_a_second_around() -> None:
    t = np.array([0.0, 0.0625, 0.125, 0.25, 1.0])
    assert _mean_over(t, np.array([1.0, 2.0, 6.0, 4.0, 8.0])) == pytest.approx([1.5, 3.0, 4.0, 4.0, 8.0])


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_the_scale_of_a_valve_s_current_is_that_of_the_stroke_s_rate(side: float) -> None:
    """i = kff v + d sign(v) + i0, in mA for mm/s."""
    t = np.arange(2000) * 0.01
    x = 24.0 + 12.0 * np.sin(0.6 * t)
    kff = feed_forward({})
    v = (np.interp(t + 0.1, t, x) - np.interp(t - 0.1, t, x)) / 0.2
    i = kff * v + 0.4 * np.sign(v)
    channels = {"x_lvdt": (t, x)}

    def of(values: Any, channels: Any = channels) -> tuple[str, str] | None:
        return proposed_scale("i_cmd", (t, values), channels, {})

    assert of(i) is None and of(1.1 * i) is None
    assert of(side * i / 40.0) == (f"{side * 40:g}*mA", "the rate of x_lvdt")
    assert of(side * i / 40.0 + 0.5)[0] == f"{side * 40:g}*mA{-side * 20:+g}"  # type: ignore[index]
    assert of(i + 4.0) is None and of(i + 6.0) == ("mA-6", "the rate of x_lvdt")  # a valve may have a null bias
    assert of(-i) == ("-mA", "the rate of x_lvdt") and of(i / 40.0, {"x_dem": (t, x)}) == ("40*mA", "the rate of x_dem")
    assert of(np.random.default_rng(1).standard_normal(2000)) is None and of(i, {}) is None
    assert of(i / 40.0, {"x_lvdt": (t, 24.0 + 0.5 * np.sin(0.6 * t))}) is None  # it hardly moves


# ---- from samples to channels ----------------------------------------------------------------------------------------


def test_rows_with_a_wrong_stamp_have_no_time_unless_a_channel_has_them_for_itself() -> None:
    t = np.arange(200) * 0.1
    t[50:53] = 900.0
    known: dict[int, Any] = {}
    notes: list[str] = []
    s: Any = SimpleNamespace(t=t, values=np.ones(200), word="row", first=2)
    out = logs._in_time(s, t, known, notes)
    (note,) = notes
    assert note == "time: 3 of 200 rows have a wrong time stamp (first row 52: 900 s): left out"
    assert isinstance(note, Note) and (note.kind, note.of, note.number, note.rows) == (
        "left out",
        "time",
        3,
        (52, 53, 54),
    )
    assert is_absent(out[50:53]).all() and out[:50].tolist() == t[:50].tolist() and t[51] == 900.0
    own = np.full(200, np.nan)
    own[48:53] = 1.0  # three of its five samples
    again: Any = SimpleNamespace(t=t, values=own, word="row", first=2)
    assert logs._in_time(again, t, known, notes) is t and len(notes) == 1
    own[40:53] = 1.0
    assert is_absent(logs._in_time(again, t, known, notes)[51]) and len(known) == 1
    good = np.arange(200) * 0.1
    plain: Any = SimpleNamespace(t=good, values=np.ones(200), word="row", first=2)
    assert logs._in_time(plain, good, known, notes) is good and len(notes) == 1


def test_of_each_table_stale_rows_are_left_out_once() -> None:
    draw = np.random.default_rng(3)
    t, stale = np.arange(3000) * 0.01, np.zeros(3000, dtype=bool)
    stale[[200, 201, 700]] = True
    at = np.maximum.accumulate(np.where(stale, 0, np.arange(3000)))
    names = [f"c{k}" for k in range(6)]
    made = {n: Channel(t if k % 2 else t.copy(), draw.standard_normal(3000).round(2)[at]) for k, n in enumerate(names)}
    made["framed"] = Channel(t, made["c0"].values, framed=True)
    made["alone"] = Channel(t[1:], made["c1"].values[1:])
    notes: list[str] = []
    out = logs._fresh(made, notes)
    assert [str(n) for n in notes] == [
        "c0, c1, c2, c3, c4, c5: 3 of 3,000 rows repeat the row before in every channel (the first at 2 s): stale, "
        "left out"
    ]
    assert isinstance(notes[0], Note) and (notes[0].kind, notes[0].of, notes[0].number) == ("left out", "time", 3)
    for n in names:
        assert out[n].t.tolist() == t[~stale].tolist() and out[n].values.tolist() == made[n].values[~stale].tolist()
    assert out["framed"] is made["framed"] and out["alone"] is made["alone"] and list(out) == list(made)


def test_samples_that_an_exporter_joined_are_taken_at_their_own_rate() -> None:
    """Every fifth row is a sample, the first in row 2; a command that seldom bends keeps its lines."""
    t = np.arange(3000) * 0.01
    true = np.random.default_rng(4).standard_normal(601).round(3)
    rows = np.arange(3000)
    slow = np.interp(rows, 2 + 5 * np.arange(-1, 600), true)
    bends = np.interp(rows, np.r_[0, 20 * np.cumsum([7, 8] * 10)], np.r_[0.0, np.tile([10.0, 3.0], 10)])
    made = {"slow": Channel(t, slow), "seldom": Channel(t, bends), "fast": Channel(t, np.sin(t * 77.0).round(4))}
    notes: list[str] = []
    out = logs._own_samples(made, notes)
    assert joined(t, slow) == Joined(5, 2, True) and out["fast"] is made["fast"]
    assert out["slow"].t.tolist() == t[2::5].tolist() and out["slow"].values == pytest.approx(true[1:601], abs=1e-9)
    assert (out["slow"].apart, made["slow"].apart) == (pytest.approx(0.05), 0.0)
    assert (
        str(notes[0]) == "slow: samples 0.05 s apart are joined by straight lines: only these are taken, 600 of 3,000"
    )
    assert isinstance(notes[0], Note) and (notes[0].kind, notes[0].of, notes[0].number) == ("left out", "slow", 2400)
    assert joined(t, bends) == Joined(20, 0, False) and out["seldom"].values is made["seldom"].values
    assert out["seldom"].apart == pytest.approx(0.2) and len(notes) == 2
    assert str(notes[1]) == "seldom: samples 0.2 s apart are joined by straight lines"
    assert isinstance(notes[1], Note) and (notes[1].kind, notes[1].number) == ("filled", 2850)
    assert logs._own_samples({"fast": made["fast"]}, notes) == {"fast": made["fast"]} and len(notes) == 2
    framed = {"slow": dataclasses.replace(made["slow"], framed=True)}
    assert logs._own_samples(framed, notes) is framed  # a value holds from its frame on


@pytest.mark.parametrize(("every", "first"), [(2, 1), (3, 0), (7, 4), (20, 11)])
def test_true_samples_are_found_by_where_the_line_bends(every: int, first: int) -> None:
    n = 2400
    at = first + every * np.arange(-1, n // every + 2)
    values = np.interp(np.arange(n), at, np.random.default_rng(every).standard_normal(at.size))
    t = 5.0 + 0.02 * np.arange(n)
    assert joined(t, values) == Joined(every, first, True) and seems_joined(t, values)
    assert joined(t, values, fewest=n) is None and joined(t[:59], values[:59]) is None
    noisy = values + 1e-3 * np.random.default_rng(1).standard_normal(n)
    assert joined(t, noisy) is None and not seems_joined(t, noisy)
    uneven = t + np.where(np.arange(n) % 9 == 0, 0.1, 0.0) * 0.02
    assert joined(uneven, values) is None  # times by a twentieth of a step off
    assert joined(t, np.zeros(n)) is None and joined(t, 3.0 * t) is None


def test_the_last_digit_is_that_of_numbers_of_one_size() -> None:
    def digits(*values: float) -> list[float]:
        return joined_rows._last_digit(np.array(values)).tolist()

    assert (
        digits(1.25, 3.75, 9.5) == [0.01]
        and digits(1.2, 1.5, 9.0) == [pytest.approx(0.1)]
        and digits(3.0, 4.0) == [1.0]
    )
    assert digits(1.25, 10.5, 2.75, 99.0) == pytest.approx([0.01, 0.1, 0.01, 0.1])
    odd = math.pi * np.arange(1.0, 3.0)
    assert joined_rows._last_digit(odd) == pytest.approx([2e-9 * math.pi])  # of the largest
    assert joined_rows._size(np.array([0.0, 0.05, 1.0, 9.99, 10.0])).tolist() == [-12.0, -2.0, 0.0, 0.0, 1.0]


def test_time_from_1970_or_far_away_is_counted_from_the_start() -> None:
    def shifted(start: float, era: str = "1970") -> tuple[list[float], list[str]]:
        t = start + np.arange(3.0)
        channels = {"a": Channel(t, t), "b": Channel(t, t), "c": Channel(t[:2] + 0.5, t[:2])}
        notes: list[str] = []
        logs._shift(channels, notes, era)
        assert channels["a"].t is channels["b"].t and channels["c"].t[0] == channels["a"].t[0] + 0.5
        return channels["a"].t.tolist(), [str(n) for n in notes]

    assert shifted(1.7e9, "1904") == (
        [0.0, 1.0, 2.0], ["time counts from 1904: 1700000000.000000 s taken for the start of the log"]
    )  # fmt: skip
    far = plausible.JUMP
    assert shifted(far) == ([far, far + 1.0, far + 2.0], [])
    assert shifted(far + 10.0)[1] == [
        f"time does not count from the start: {far + 10.0:.6f} s taken for the start of the log"
    ]
    assert shifted(-far - 10.0)[0] == [0.0, 1.0, 2.0]
    logs._shift({}, [], "1970")


# ---- rows as long as their header ------------------------------------------------------------------------------------


@pytest.mark.parametrize("quote", ["", '"'])
def test_rows_have_the_header_s_cells_or_are_counted(quote: str) -> None:
    """Of four cells, three of which must be there: longer rows whose last cells are empty, shorter ones, empty ones."""
    rows = ["1;2;3;4", "1;2;3", "1;2", "1;2;3;4;;", "1;2;3;4;5", ";", "", "1;2;3;4; ", "5;6;7;8"]
    text = "".join(f"{quote}{r.replace(';', f'{quote};{quote}')}{quote}\n" for r in rows).encode()
    out, counted = csv_format._fitting(text, ";", 3, 4)
    assert counted.tolist() == [0, 0, 2, 0, 5, 0, 0, 0, 0] and type(counted[0]) is np.int64
    kept = [["1", "2", "3", "4"], ["1", "2", "3", ""], [""] * 4, ["1", "2", "3", "4"], [""] * 4, [""] * 4, [""] * 4,
            ["1", "2", "3", "4"], ["5", "6", "7", "8"]]  # fmt: skip
    assert [line.split(";") for line in out.decode().splitlines()] == kept
    windows, _ = csv_format._fitting(b"1;2\r\n3\r\n", ";", 2, 2)
    assert windows == b"1;2\n;\n" and csv_format._fitting(b"1;2", ";", 2, 2)[1].tolist() == [0]


# ---- whether signals can be what they are guessed to be --------------------------------------------------------------


def test_two_signals_go_together_where_both_move() -> None:
    a = np.arange(40.0)
    assert (
        guess_of._together(a, 3.0 * a, 39.0, 117.0) == pytest.approx(1.0)
        and guess_of._together(a, -a, 1.0, 1.0) == -1.0
    )
    assert guess_of._together(a, a, 39.1, 1.0) == guess_of._together(a, a, 1.0, 39.1) == 0.0
    assert guess_of._together(a[:19], a[:19], 1.0, 1.0) == 0.0 and guess_of._together(a[:20], a[:20], 1.0, 1.0) > 0.99


def test_a_stroke_off_its_schedule_has_another_zero_or_unit() -> None:
    at, curve = guess_of.mean_stroke({})
    speed = np.linspace(at[0], at[-1], 400)
    planned, off = np.interp(speed, at, curve), 0.18 * np.ptp(curve)
    assert guess_of._off_schedule(planned, speed, {}) == "" == guess_of._off_schedule(planned + 0.99 * off, speed, {})
    assert guess_of._off_schedule(planned + 1.02 * off, speed, {}) == (
        f"it is {1.02 * off:.2g} mm away, half of the time, from what the schedule says"
    )
    middle = planned.mean()
    for times, said in ((1.49, ""), (1.52, "1.5"), (0.68, ""), (0.65, "0.65")):
        found = guess_of._off_schedule(middle + times * (planned - middle), speed, {})
        assert found == (f"it moves {said} times as far as the schedule says" if said else "")
    noise = np.random.default_rng(1).standard_normal(400)
    assert guess_of._off_schedule(100.0 + 20.0 * noise, speed, {}) == ""  # follows no schedule at all
    still = np.full(400, speed[0])
    assert guess_of._off_schedule(planned + 30.0, still, {}) == ""  # nothing was asked of it


def test_a_vane_that_follows_another_s_schedule_is_that_one() -> None:
    t = np.arange(200) * 0.1
    speed = 65.0 + 30.0 * np.sin(0.4 * t)
    planned = guess_of.planned_angles(speed, {})
    channels = {"n_r": (t, speed), "vgv1": (t, planned["vigv"])}
    assert guess_of._other_vane("vgv1", channels, {}) == "vigv"
    assert guess_of._other_vane("vgv1", {**channels, "vgv1": (t, planned["vgv1"] + 1.9)}, {}) == ""
    assert (
        guess_of._other_vane("vgv2", channels, {}) == "" == guess_of._other_vane("vgv1", {"vgv1": channels["vgv1"]}, {})
    )
    demand = {"n_dem": channels["n_r"], "vgv1": channels["vgv1"]}
    assert guess_of._other_vane("vgv1", demand, {}) == "vigv"
    short = {"n_r": (t[:20], speed[:20]), "vgv1": channels["vgv1"]}
    assert guess_of._other_vane("vgv1", short, {}) == ""
    quiet = {"n_r": (t, np.full(200, 60.0)), "vgv1": (t, np.full(200, 40.0))}
    assert guess_of._other_vane("vgv1", quiet, {}) == ""
    assert guess_of._other_vane("vgv7", {**channels, "vgv7": channels["vgv1"]}, {}) == ""  # no such row


# ---- messages in pieces ----------------------------------------------------------------------------------------------


def pieces_of(*frames: str, bus: int = 0) -> Frames:
    data = [bytes.fromhex(f) for f in frames]
    rows = np.zeros((len(data), 64), np.uint8)
    for k, d in enumerate(data):
        rows[k, : len(d)] = np.frombuffer(d, np.uint8)
    n, length = len(data), np.array([len(d) for d in data], np.uint8)
    return Frames(np.arange(float(n)), np.full(n, 0x7E8, np.uint32), np.full(n, bus, np.int32), length, rows)


@pytest.mark.parametrize(
    ("frames", "whole", "broken", "took"),
    [
        (["03aabbcc"], ["aabbcc"], 0, 1), (["04aabbcc"], [], 0, 0), (["00"], [], 0, 0), ([""], [], 0, 0),
        (["07" + "11" * 7], ["11" * 7], 0, 1), (["0009" + "22" * 10], ["22" * 9], 0, 1),  # CAN FD: its length in byte 1
        (["1009" + "33" * 6, "21444444"], ["33" * 6 + "444444"], 0, 2),
        (["1009" + "33" * 6, "300000", "21444444"], ["33" * 6 + "444444"], 0, 2),  # flow control is passed over
        (["1009" + "33" * 6, "22444444"], [], 1, 0), (["1009" + "33" * 6], [], 1, 0), (["21444444"], [], 0, 0),
        (["1009" + "33" * 6, "01aa", "21444444"], ["aa"], 1, 1), (["1006" + "33" * 6, "21"], [], 0, 0),
        (["1000" + "00000009" + "55" * 2, "21" + "66" * 7], ["55" * 2 + "66" * 7], 0, 2),  # the length in four bytes
        (["1fff" + "00" * 6], [], 1, 0), (["1000" + "00001000" + "0000"], [], 0, 0),  # 4095 bytes at most
        (["1075" + "77" * 6, *(f"2{k % 16:x}" + f"{k:02x}" * 7 for k in range(1, 17))],
         ["77" * 6 + "".join(f"{k:02x}" * 7 for k in range(1, 17))[: 2 * 111]], 0, 17),
    ],
)  # fmt: skip
def test_pieces_of_iso_tp_become_messages(frames: list[str], whole: list[str], broken: int, took: int) -> None:
    of = pieces_of(*frames)
    found = transport._iso_tp(of, np.arange(len(frames)))
    assert [d.hex() for d in found.data] == whole and (found.broken, found.frames) == (broken, took)
    assert found.ident == [0x7E8] * len(whole)
    if took > 1:  # a message has the time of its last frame
        assert found.t == [len(frames) - 1.0]


def test_values_are_chosen_sample_by_sample_and_modes_hold() -> None:
    t = np.arange(4.0)
    channels = {"m": Channel(t, np.array([0.0, 1.0, 2.0, 2.0])), "f": Channel(t + 0.5, np.array([5.0, 6.0, 7.0, 8.0]))}
    made = formula_of("where(m > 0.5, m, 9)").made(channels)
    assert made.values.tolist() == [9.0, 1.0, 2.0, 2.0]
    chosen = formula_of("where(m > 0.5, m, 9) + 0 * f").made(channels)
    assert set(chosen.values) <= {9.0, 1.0, 2.0}  # whole numbers are held, and no halves are made of them
