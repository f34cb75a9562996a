"""The comparison of a log with what other readers find in it: each kind of difference is told, counted and placed."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from hil.logs import Channel, LogError, others, write_log
from hil.logs.frames import EXTENDED
from hil.logs.mdf import Groups
from hil.logs.others import Compared, by_python_can, compare

LINES = (
    "(10.000000) can0 123#0102030405060708\n(10.010000) can0 0000012A#AA\n(10.020000) can0 124#\n"
    "(10.030000) can0 123#1102030405060708\n"
)
WHOLE = ("frames", "identifiers", "lengths", "bytes of data", "times")


@pytest.fixture
def log(tmp_path: Path) -> Path:
    file = tmp_path / "a.log"
    file.write_text(LINES)
    return file


def rows(found: list[Compared]) -> list[tuple[str, str, str, bool | None]]:
    return [(r.what, r.ours, r.theirs, r.same) for r in found]


def changed(monkeypatch: pytest.MonkeyPatch, change: Callable[[dict[str, np.ndarray]], Any]) -> None:
    """python-can finds something else in a log."""

    def other(path: str) -> dict[str, np.ndarray]:
        found = by_python_can(path)
        return change(found) or found

    monkeypatch.setattr(others, "by_python_can", other)


def test_a_log_that_both_read_alike_is_the_same_in_all(log: Path) -> None:
    found = compare(log, {})
    assert rows(found) == [("frames", "4", "4", True), *((w, "4 frames", "0 differ", True) for w in WHOLE[1:])]
    assert {r.by for r in found} == {"python-can"}
    assert found[0].to_dict() == {"what": "frames", "ours": "4", "theirs": "4", "by": "python-can", "same": True}


@pytest.mark.parametrize(("what", "change"), [
    ("identifiers", lambda f: f["ident"].__setitem__(2, 0x125)), ("lengths", lambda f: f["length"].__setitem__(2, 1)),
    ("bytes of data", lambda f: f["data"].__setitem__((2, 63), 1)),
    ("times", lambda f: f["t"].__setitem__(2, 10.020003)),
])  # fmt: skip
def test_what_differs_is_counted_with_its_first_frame(
    log: Path, monkeypatch: pytest.MonkeyPatch, what: str, change: Any
) -> None:
    def writable(found: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        own = {k: v.copy() for k, v in found.items()}
        change(own)
        return own

    changed(monkeypatch, writable)
    told = {w: (theirs, same) for w, _, theirs, same in rows(compare(log, {}))}
    assert told.pop(what) == ("1 differ, the first in frame 3", False) and told.pop("frames") == ("4", True)
    assert set(told.values()) == {("0 differ", True)}


def test_times_may_differ_by_two_microseconds_and_from_any_start(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for off, same in ((1.9e-6, True), (-1.9e-6, True), (2.1e-6, False)):
        changed(monkeypatch, lambda f, off=off: f | {"t": f["t"] + 500.0 + off * (np.arange(4) == 1)})
        assert rows(compare(log, {}))[-1][3] == same
    changed(monkeypatch, lambda f: {k: v[[2, 0, 3, 1]] for k, v in f.items()})  # in another order
    assert all(r.same for r in compare(log, {}))


def test_another_number_of_frames_is_told_alone_and_none_is_no_answer(
    log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    changed(monkeypatch, lambda f: {k: v[:3] for k, v in f.items()})
    assert rows(compare(log, {})) == [("frames", "4", "3", False)]
    changed(monkeypatch, lambda f: {k: v[:0] for k, v in f.items()})
    assert rows(compare(log, {})) == [("frames", "4", "0", None)]


def test_a_reader_that_fails_is_told_with_its_reason(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for error, said in (
        (ValueError("a\n b  c"), "fails (ValueError: a b c)"), (LogError("no such"), "fails (no such)"),
        (KeyError("x" * 200), f"fails (KeyError: '{'x' * 69})"),
    ):  # fmt: skip

        def fails(path: str, error: Exception = error) -> Any:
            raise error

        monkeypatch.setattr(others, "by_python_can", fails)
        assert rows(compare(log, {})) == [("frames", "4", said, None)]


def test_python_can_s_frames_are_those_of_data(tmp_path: Path) -> None:
    frames = [
        can.Message(1.0, 0x12A, True, data=b"\x01\x02"), can.Message(1.1, 0x123, False, is_remote_frame=True, dlc=4),
        can.Message(1.2, 0x123, False, data=b""), can.Message(1.3, 5, False, is_error_frame=True),
        can.Message(1.4, 5, False, data=bytes(range(12)), is_fd=True),
    ]  # fmt: skip
    log = logging.getLogger("can")
    before = log.level
    log.setLevel(logging.INFO)
    for suffix in (".asc", ".blf", ".BLF"):
        file = tmp_path / f"a{suffix}"
        with can.Logger(str(file) if suffix != ".BLF" else str(tmp_path / "b.blf")) as out:
            for m in frames:
                out.on_message_received(m)
        if suffix == ".BLF":
            (tmp_path / "b.blf").rename(file)
        found = by_python_can(str(file))
        assert found["ident"].tolist() == [EXTENDED | 0x12A, 0x123, 5] and found["length"].tolist() == [2, 0, 12]
        assert found["data"].shape == (3, 64) and found["data"][2, :12].tolist() == list(range(12))
        assert (found["t"] - found["t"][0]).tolist() == pytest.approx([0.0, 0.2, 0.4], abs=1e-6)
        assert found["data"][0].tolist() == [1, 2, *[0] * 62] and not found["data"][2, 12:].any()
    assert log.level == logging.INFO
    log.setLevel(before)


def test_formats_that_no_other_reader_has_are_told(tmp_path: Path) -> None:
    table = tmp_path / "a.csv"
    table.write_text("t,n_dem,x_dem\n0,50,1\n")
    (row,) = compare(table, {})
    assert row == Compared("columns", "2", "-", "none of python-can, cantools, asammdf: CSV", None)
    (tmp_path / "b.csv").write_text(
        "Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2\n166064000,00000122,false,Rx,0,2,74,6A,\n"
    )
    assert compare(tmp_path / "b.csv", {}) == [
        Compared("frames", "1", "-", "python-can does not read frames in CSV", None)
    ]  # fmt: skip
    head = "timestamp,arbitration_id,extended,remote,error,dlc,data\n0.25,0x122,0,0,0,2,dGo=\n"
    for mark in ("", "\ufeff"):
        (tmp_path / "c.csv").write_text(mark + head, encoding="utf-8")
        assert compare(tmp_path / "c.csv", {})[0].by == "python-can"
    with pytest.raises(LogError, match="is not a log's"):
        compare(tmp_path / "a.txt", {})


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """Half a second of speeds and strokes on the product's own bus."""
    t = np.arange(50) * 0.01
    write_log(tmp_path / "run.log", {
        "n_dem": Channel(t, 60.0 + t), "x_lvdt": Channel(t[10:], 20.0 + t[10:]), "x_dem": Channel(t, 20.0 + t),
    })  # fmt: skip
    return tmp_path / "run.log"


def test_signals_are_held_against_cantools_value_by_value(run: Path) -> None:
    found = [r for r in compare(run, {"n_dem": "n_dem", "x_lvdt": "x_lvdt"}) if r.by == "cantools"]
    assert [r.what.split(" ")[0] for r in found] == ["n_dem", "x_lvdt"] and all(r.same for r in found)
    assert found[0].ours.endswith(" samples") and found[0].theirs == f"{found[0].ours}, the same"
    assert found[1].theirs.endswith(" more, said not available")  # the first ten frames have no stroke
    assert compare(run, {"load": "load"})[5:] == []


def test_a_value_that_cantools_has_otherwise_is_counted(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    decode = others._decoded
    for off, said in ((0.5, " differ"), (0.0, "the same"), (1e-13, "the same")):
        seen: list[int] = []

        def other(layout: Any, data: bytes, off: float = off, seen: list[int] = seen) -> Any:
            seen.append(1)
            found = decode(layout, data)
            return {k: v + off * (len(seen) < 8) if k == "n_dem" else v for k, v in found.items()}

        monkeypatch.setattr(others, "_decoded", other)
        (row,) = [r for r in compare(run, {"n_dem": "n_dem"}) if r.by == "cantools"]
        assert row.theirs.endswith(f", 7{said}" if off == 0.5 else f", {said}") and row.same == (off != 0.5)


def test_values_that_only_cantools_has_are_a_difference_where_nothing_says_they_are_none(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A database without a raw value for "not available" leaves nobody a reason to leave out a frame."""
    frames = others.Bus.series

    def fewer(bus: Any, key: str) -> Any:
        s = frames(bus, key)
        return type(s)(s.t[3:], s.values[3:], s.unit, framed=True)

    monkeypatch.setattr(others.Bus, "series", fewer)
    (row,) = [r for r in compare(run, {"n_dem": "n_dem"}) if r.by == "cantools"]
    assert row.theirs.endswith(", 3 more, said not available") and row.same  # vgv.dbc has such a value for it
    carried = others.Bus.carried

    def without(bus: Any, key: str) -> Any:
        m, *rest = carried(bus, key)
        return (type(m)(m.layout, m.ident, m.e2e, m.j1939, {}), *rest)

    monkeypatch.setattr(others.Bus, "carried", without)
    (row,) = [r for r in compare(run, {"n_dem": "n_dem"}) if r.by == "cantools"]
    assert row.theirs.endswith(", 3 more, said not available") and row.same is False


def test_the_first_frames_of_a_long_message_are_enough(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(others, "_MOST", 10)
    (row,) = [r for r in compare(run, {"n_dem": "n_dem"}) if r.by == "cantools"]
    assert (row.ours, row.theirs, row.same) == ("10 samples", "10 samples, the same", True)


def test_channels_of_mdf_are_held_against_asammdf(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    t, v = np.arange(3.0), np.array([1.0, np.nan, 3.0])
    content = {"series": dict.fromkeys("abc", (t, v, "mm", False)), "comments": {}, "why": {}, "invalid": {},
               "names": {k: [k, k.upper()] for k in "abc"}}  # fmt: skip
    asked: list[Any] = []

    def theirs(path: Path, request: Any) -> dict[str, np.ndarray]:
        asked.append(request)
        return {"t0": t, "v0": v, "t1": t + 1.0, "v1": v, "t2": t + 1.0, "v2": v + 1.0}

    monkeypatch.setattr(others, "read_as_others", theirs)
    found = list(others._channels(tmp_path, Groups(content), {"x_dem": "A", "x_lvdt": "b", "p_s": "c", "no": "d"}))
    assert rows(found) == [
        ("x_dem (a)", "3 samples", "3 samples, the same", True),
        ("x_lvdt (b)", "3 samples", "3 samples, times differ", False),
        ("p_s (c)", "3 samples", "3 samples, times and values differ", False),
    ]
    assert asked == [{"channels": ["a", "b", "c"]}] and {r.by for r in found} == {"asammdf"}
    assert list(others._channels(tmp_path, Groups(content), {})) == [] and len(asked) == 1
