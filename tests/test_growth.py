"""No file hangs a reader: twice the bytes take at most 2.3 times the processor time, whatever the bytes are."""

from __future__ import annotations

import contextlib
import gc
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from controller import load_calibration
from hil.inject.fuzz import read_attack
from hil.inject.scenario import load_scenario
from hil.logs import names
from hil.logs.bus_log import open_bus_log
from hil.logs.dbc import _load_dbc, _without
from hil.logs.formats import FORMATS
from hil.logs.mapping import read_mapping
from hil.logs.names import is_time, lacks, meaning, unit_behind, unit_in_name, unit_kind
from hil.logs.recordings import read_record
from hil.logs.source import Options
from hil.logs.survey import survey
from hil.logs.table import split_unit
from hil.logs.units import factor_of
from hil.loop.ecu import read_profile
from hil.uds.trouble import TroubleMemory
from plant.model import load_model
from plant.parameters import load_plant
from tests.conftest import ROOT
from vaneloop.base import tables
from vaneloop.base.errors import InputError
from vaneloop.base.signals import UNITS

MOST = 2.3  # times the processor time for twice the bytes
FIRST, LAST = 1 << 10, 1 << 20  # bytes of a file
ENOUGH = 0.05  # s of a processor: what takes as long is out of the noise, and not made longer

Make = Callable[[int], str]  # a hostile file of about so many letters


class Reader(NamedTuple):
    """A reader, the files that it is given, and their suffix."""

    read: Callable[[Path], object]
    suffix: str
    files: dict[str, Make]


def filled(before: str, piece: str, behind: str) -> Make:
    """A file whose one place is filled with copies of a piece."""
    return lambda n: before + piece * (n // len(piece)) + behind


def counted(before: str, piece: str, behind: str) -> Make:
    """The same of pieces that are all different: {} is their number."""
    return lambda n: before + "".join(piece.replace("{}", str(k)) for k in range(n // (len(piece) + 3))) + behind


# what makes patterns and grammars that look back slow
PIECES = {
    "letters": "a", "capitals": "aB", "digits": "1", "blanks": " ", "tabs": "\t", "underscores": "_", "dots": ".",
    "words": "set point ", "compounds": "revs", "acronyms": "nhs", "brackets": "[", "closed": "]", "round": "(",
    "braces": "{", "empty": "[]{", "pairs": "(a)", "slashes": "a/", "backslashes": "\\", "colons": "1:", "quotes": '"',
    "escaped": '\\"', "apostrophes": "'", "signs": "-", "commas": "1,", "semicolons": ";", "exponents": "1e",
    "percent": "%", "equals": "a=", "hashes": "#", "units": "mm*",
}  # fmt: skip


FEW = ("letters", "digits", "blanks", "dots", "brackets", "braces", "backslashes", "quotes", "escaped", "semicolons")


def every(before: str, behind: str, pieces: Iterable[str] = PIECES) -> dict[str, Make]:
    """A place filled with each of the pieces."""
    return {name: filled(before, PIECES[name], behind) for name in pieces}


# ---- the readers -----------------------------------------------------------------------------------------------------


def named(read: Callable[[str], object]) -> Callable[[Path], object]:
    """A function of a name, given the content of a file."""
    return lambda path: read(path.read_text(encoding="utf-8"))


def look(path: Path) -> object:
    """All that opens a log: `vaneloop map` surveys and reads it. What was understood before is forgotten."""
    for kept in (meaning, names._words, unit_kind, factor_of):
        kept.cache_clear()
    return survey(path)


def columns_of(path: Path) -> object:
    """A bus log with the hostile file as its database."""
    _load_dbc.cache_clear()
    return open_bus_log(FORMATS[".blf"].read_frames(ROOT / "examples" / "engine_run.blf"), Options(path, {}))


ROWS = "".join(f"{k / 100},{50 + k % 7},{k % 5}\n" for k in range(20))
NAMES = {
    "times": "time {} s", "temperatures": "Oeltemp_{}_degC", "speeds": "n_dem [a{}]", "plain": "x{}",
    "vanes": "VSV {} angle (deg)",
}  # fmt: skip


def csv_of_columns(name: str, cell: str) -> Make:
    """A table of two rows with many columns."""

    def make(n: int) -> str:
        names = [name.replace("{}", str(k)) for k in range(min(n // (len(name) + 2 * len(cell) + 6), 9_990))]
        rows = [",".join([str(t), "50", *[cell] * len(names)]) for t in range(2)]
        return "\n".join([",".join(["t", "n_dem", *names]), *rows, ""])

    return make


CSV = {
    **{f"name of {k}": m for k, m in every("t,n_dem,", "x\n" + ROWS).items()},
    **{f"first line of {k}": m for k, m in every("", "\nt,n_dem\n" + ROWS).items()},
    **{f"cell of {k}": m for k, m in every("t,n_dem,x\n0,50,", "\n" + ROWS).items()},
    **{f"columns of {k}": csv_of_columns(v, "1") for k, v in NAMES.items()},
    **{f"columns of words, {k}": csv_of_columns(v, "on") for k, v in NAMES.items()},
    "same columns": filled("t,n_dem", ",vgv1", "\n" + ROWS),
    "lines": filled("t,n_dem\n", "\n", ""),
    "rows": counted("t,n_dem\n", "{},50\n", ""),
    "ragged rows": counted("t,n_dem,x\n", "{},50\n", ""),
    "ragged rows in quotes": counted("t,n_dem,x\n", '{},"50"\n', ""),
    "quotes in rows": counted('t,n_dem,x\n0,50,"\n', '{},50,""\n', ""),
    "rows of words": counted("t,n_dem,x\n0,50,no\n", "{},50,on\n", ""),
    "times of day": filled("t,n_dem\n", "12:30:05,50\n", ""),
    "times that fall": counted("t,n_dem\n", "5,{}\n4,50\n", ""),
    "remarks": counted("", "# {}\n", "t,n_dem\n" + ROWS),
}  # fmt: skip

KEYS = {
    **{f"file of {k}": m for k, m in every("", "").items()},
    **{f"key in quotes of {k}": m for k, m in every('"', '" = 1\n').items()},
    **{f"value of {k}": m for k, m in every("a = ", "\n", FEW).items()},
    **{f"long text of {k}": m for k, m in every('a = """', '"""\n', FEW).items()},
    "keys": counted("", "a{} = 1\n", ""),
    "tables": counted("", "[a{}]\n", ""),
    "tables in tables": counted("", "[a.b{}.c]\nd = 1\n", ""),
    "lists of tables": filled("", "[[a]]\nb = 1\n", ""),
    "lists of lists of tables": filled("", "[[a]]\n[[a.b]]\nc = 1\n", ""),
    "dotted keys": counted("", "a.b.c.d{} = 1\n", ""),
    "keys within braces": counted("a = {", "b{} = 1, ", "z = 1}\n"),
    "lists in lists": filled("a = ", "[", "\n"),
    "tables in braces": filled("a = ", "{a=", "\n"),
    "values": filled("a = [", "1, ", "]\n"),
    "dates": filled("a = [", "1979-05-27T07:32:00Z, ", "]\n"),
}  # fmt: skip

TABLE = {k: KEYS[k] for k in ("keys", "tables", "lists of tables", "values", "lists in lists")} | {
    "effects": counted("", "[effects.valve_dead_band{}]\nhalf_width = 1.0\n", ""),
    "parameters": counted("[parameters]\n", '"valve.bandwidth{}" = 60.0\n', ""),
    "names": counted("[names]\n", 'vgv{} = "a"\n', ""),
    "codes": counted("[curves.a]\nknots = [", "{}, ", "1e9]\nvalues = []\n"),
}

DBC = (tables.path("vgv.dbc")).read_text(encoding="utf-8")
DATABASE = {
    **{f"behind it {k}": m for k, m in every(DBC, "\n", FEW).items()},
    **{f"remark of {k}": m for k, m in every(DBC + 'CM_ BO_ 160 "', '";\n', FEW).items()},
    **{f"values of {k}": m for k, m in every(DBC + "\nVAL_ 160 n_r ", ";\n", FEW).items()},
    "remarks that nobody ends": filled(DBC, 'CM_ "a\n', ""),
    "messages": counted(DBC, 'BO_ 160 M{}: 8 ECU\n SG_ s : 0|8@1+ (1,0) [0|1] "" VGV\n', ""),
    "signals": counted(DBC + "BO_ 999 M: 8 ECU\n", ' SG_ s{} : 0|8@1+ (1,0) [0|1] "" VGV\n', ""),
    "attributes": counted(DBC, 'BA_DEF_ BO_ "A{}" INT 0 1;\n', ""),
    "descriptions": counted(DBC, 'VAL_TABLE_ T{} 1 "a" ;\n', ""),
}  # fmt: skip

WHOLE = ("messages", "signals", "remarks that nobody ends")  # cantools takes a tenth of a second for the least of them

CANDUMP = "(1735329625.329586) can0 17C#0000000010000021\n"
ASC = "base hex timestamps absolute\n0.010000 1  A0  Rx  d 8 00 01 02 03 04 05 06 07\n"
TRC = ";$FILEVERSION=2.1\n;$COLUMNS=N,O,T,B,I,d,R,L,D\n1 10.0 DT 1 00A0 Rx - 8 00 01 02 03 04 05 06 07\n"


def lines_of(good: str, frame: str) -> dict[str, Make]:
    """A text log of frames with something hostile in it."""
    return {
        **{f"line of {k}": m for k, m in every(good, "\n", FEW).items()},
        **{f"lines of {k}": filled(good, (p := PIECES[k]) * max(40 // len(p), 1) + "\n", "") for k in FEW},
        **{f"behind a frame {k}": m for k, m in every(good[:-1] + " ", "\n", FEW).items()},
        "frames": filled("", frame, ""), "frames of every length": counted("", frame[:-1] + " {}\n", ""),
    }  # fmt: skip


TOML: dict[str, Callable[[Path], object]] = {
    "mapping": read_mapping, "model": load_model, "plant": load_plant,
    "scenario": load_scenario, "calibration": load_calibration, "profile": read_profile,
}  # fmt: skip
READERS: dict[str, Reader] = {
    "csv": Reader(look, ".csv", CSV),
    "toml": Reader(tables.load_toml, ".toml", KEYS),
    **{name: Reader(read, ".toml", TABLE) for name, read in TOML.items()},
    "dbc": Reader(columns_of, ".dbc", {k: m for k, m in DATABASE.items() if k in WHOLE}),
    "statements": Reader(named(lambda text: _without(text, ["CM_", "VAL_"])), ".dbc", DATABASE),
    "candump": Reader(look, ".log", lines_of(CANDUMP, CANDUMP)),
    "asc": Reader(look, ".asc", lines_of(ASC, ASC.splitlines(keepends=True)[1])),
    "trc": Reader(look, ".trc", lines_of(TRC, TRC.splitlines(keepends=True)[2])),
    "attack": Reader(read_attack, ".log", lines_of(CANDUMP, CANDUMP)),
    "record .log": Reader(read_record, ".log", lines_of(CANDUMP, CANDUMP)),
    "record .asc": Reader(read_record, ".asc", lines_of(ASC, ASC.splitlines(keepends=True)[1])),
    "record .trc": Reader(read_record, ".trc", lines_of(TRC, TRC.splitlines(keepends=True)[2])),
    "codes": Reader(TroubleMemory.load, ".json", {
        **every("", ""), **{f"code of {k}": m for k, m in every('{"codes": ["', '"]}').items()},
        "lists": filled('{"codes": ', "[", "}"), "braces": filled('{"codes": ', '{"a":', "}"),
        "numbers": filled('{"codes": [', "1, ", "1]}"), "rows": counted('{"codes": [', '{"fault": "{}"}, ', "1]}"),
    }),
    **{read.__name__: Reader(named(read), ".txt", every("", "")) for read in (
        is_time, lacks, unit_behind, unit_in_name, split_unit)},
    "meaning": Reader(named(lambda n: meaning.__wrapped__(n, tuple(UNITS))), ".txt", every("", "")),  # type: ignore[attr-defined]
    "unit": Reader(named(lambda n: factor_of.__wrapped__(n, "mm")), ".txt", every("", "")),
}  # fmt: skip


# ---- growth ----------------------------------------------------------------------------------------------------------


def spent(read: Callable[[Path], object], path: Path) -> float:
    """Least processor time (s) of two runs of a reader; that it refuses the file is an answer, too."""
    times = []
    gc.disable()  # a full collection of what other tests left is no part of it
    try:
        for _ in range(2):
            start = time.process_time()
            with contextlib.suppress(InputError):
                read(path)
            times.append(time.process_time() - start)
    finally:
        gc.enable()
    return min(times)


def growth(reader: Reader, make: Make, folder: Path) -> list[tuple[int, float]]:
    """Bytes and processor time (s) of files of about twice the letters each, until one takes long enough: out of the
    noise, and what every file takes is a small part of it.
    """
    path = folder / f"a{reader.suffix}"
    out: list[tuple[int, float]] = []
    n = FIRST
    while n <= LAST and (len(out) < 3 or out[-1][1] < max(ENOUGH, 12.0 * out[0][1])):
        path.write_text(make(n), encoding="utf-8")
        out.append((path.stat().st_size, spent(reader.read, path)))
        n *= 2
    return out


def judged(took: list[tuple[int, float]]) -> float:
    """How many times longer twice the bytes take, over the last three doublings."""
    (size, seconds), (more, longer) = took[max(len(took) - 4, 0)], took[-1]
    if longer < ENOUGH / 4:  # a megabyte in a fiftieth of a second
        return 1.0
    return float((longer / max(seconds, 1e-3)) ** (1.0 / np.log2(more / size)))


# of each kind of file that once took a reader more than linear time, one
QUICK = (
    ("csv", "name of compounds"), ("csv", "name of blanks"), ("csv", "name of brackets"), ("csv", "columns of plain"),
    ("toml", "key in quotes of escaped"), ("statements", "remarks that nobody ends"), ("lacks", "braces"),
    ("split_unit", "blanks"), ("unit_behind", "brackets"), ("meaning", "acronyms"), ("codes", "lists"),
)  # fmt: skip


def linear(reader: Reader, make: Make, folder: Path) -> bool:
    """Whether growth is linear. A machine that is busy with other things gets five tries; a square fails in each."""
    return any(judged(growth(reader, make, folder)) <= MOST for _ in range(5))


@pytest.mark.parametrize(("name", "file"), QUICK)
def test_a_hostile_file_takes_a_reader_linear_time(name: str, file: str, tmp_path: Path) -> None:
    assert linear(READERS[name], READERS[name].files[file], tmp_path), f"{name}: {file}"


@pytest.mark.slow
@pytest.mark.parametrize("name", READERS)
def test_no_hostile_file_takes_a_reader_more_than_linear_time(name: str, tmp_path: Path) -> None:
    reader = READERS[name]
    slow = [file for file, make in reader.files.items() if not linear(reader, make, tmp_path)]
    assert not slow, f"{name}: {', '.join(slow)}"


@pytest.mark.slow
def test_the_judge_tells_a_square_from_a_line(tmp_path: Path) -> None:
    square = Reader(lambda path: [0 for _ in range((path.stat().st_size // 60) ** 2)], ".txt", {})
    line = Reader(lambda path: [0 for _ in range(60 * path.stat().st_size)], ".txt", {})
    assert not linear(square, filled("", "a", ""), tmp_path)
    assert linear(line, filled("", "a", ""), tmp_path)
