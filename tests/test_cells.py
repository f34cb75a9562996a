"""Names of others in the cells of a CSV: no spreadsheet runs them, and what reads them has them as they were."""

from __future__ import annotations

import csv
import io
import re
from pathlib import Path

import duckdb
from hypothesis import example, given
from hypothesis import strategies as st

from tests.conftest import ROOT
from vaneloop.base.cells import FORMULA, marked, unmarked
from vaneloop.fleet.sources import text_table
from vaneloop.fleet.tables import write_tables

HOSTILE = ["=1+1", "+x", "-x", "@SUM(A1)", "\t=x", "\r=x", "'=x", "''=x", "=cmd|' /C calc'!A0", '="a"', "=a,b", "-\n"]
PLAIN = ["", "-", "=", "'", "'a", "a=1", "5 - 3", "n_dem", " =x"]


@given(st.text(alphabet="'=+-@\t\ra1,\"\n"))
@example("'=x")
def test_a_text_is_back_as_it_was_and_never_begins_as_a_formula(text: str) -> None:
    assert unmarked(marked(text)) == text
    assert len(text) < 2 or marked(text)[0] not in "=+-@\t\r"


def test_only_what_a_spreadsheet_runs_is_marked() -> None:
    assert [marked(t) for t in HOSTILE] == [f"'{t}" for t in HOSTILE]
    assert [marked(t) for t in PLAIN] == PLAIN == [unmarked(t) for t in PLAIN]


def test_the_tables_of_a_fleet_mark_texts_and_leave_numbers(tmp_path: Path) -> None:
    db = duckdb.connect()
    db.execute("CREATE TABLE logs (path VARCHAR, engine VARCHAR, value DOUBLE)")
    for text in [*HOSTILE, *PLAIN]:
        db.execute("INSERT INTO logs VALUES ($1, $1, -1.5)", [text])
    db.execute("CREATE TABLE numbers AS SELECT -2.5 AS a")
    write_tables(db, tmp_path, ("logs", "numbers"))
    rows = list(csv.reader(io.StringIO((tmp_path / "logs.csv").read_bytes().decode(), newline="")))
    assert rows[1:] == [[marked(t), marked(t), "-1.5"] for t in [*HOSTILE, *PLAIN]]
    assert (tmp_path / "numbers.csv").read_text() == "a\n-2.5\n"
    have = [row["path"] for row in text_table(str(tmp_path / "logs.csv"), "--engines")[1]]
    assert have == [t.strip() for t in [*HOSTILE, *PLAIN]]
    stored = duckdb.execute("SELECT path FROM read_parquet($1)", [str(tmp_path / "logs.parquet")]).fetchall()
    assert [text for (text,) in stored] == [*HOSTILE, *PLAIN]


def test_the_pages_mark_as_the_tables_do() -> None:
    """Their rule is written in JavaScript: the same pattern, but for how it says that a dot is any letter."""
    wanted = FORMULA.replace("(?s:.)", ".")
    for script in ("vaneloop/pages/page.js", "vaneloop/web/chart.js"):
        assert f'/{wanted}/s.test(v) ? "\'" + v' in (ROOT / script).read_text(encoding="utf-8"), script
    assert re.match(FORMULA, "=1")
