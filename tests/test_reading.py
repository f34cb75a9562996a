"""No command gets a log that cannot be: units that were forgotten, clocks that jump, files that unpack to gigabytes."""

from __future__ import annotations

import io
import json
import re
import struct
import subprocess
import sys
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from hil.logs import Channel, Log, LogError, offered, plausible, read_log, write_log
from hil.logs.candump import write_candump
from hil.logs.dbc import load_dbc
from hil.logs.frames import Frames
from hil.logs.mdf_write import write_bus, write_groups
from hil.logs.signals import encode
from hil.loop.ecu import read_profile
from tests.conftest import ROOT, examples, quick_first
from tests.test_logs import check, refused
from vaneloop.base import tables, terminal
from vaneloop.base.errors import InputError
from vaneloop.base.signals import UNITS
from vaneloop.base.tables import load_toml
from vaneloop.cli import options
from vaneloop.cli.main import main

NONE = np.zeros(0)


def a_run(seconds: float = 30.0, step: float = 0.01) -> dict[str, Channel]:
    """A plausible run that moves: speed 60 to 95 % and back, everything else with it."""
    t = np.arange(0.0, seconds - 0.5 * step, step)
    up = 0.5 - 0.5 * np.cos(2.0 * np.pi * t / seconds * max(1.0, round(seconds / 8.0)))
    ripple = np.sin(50.0 * t)
    rows = {
        "n_dem": 60.0 + 35.0 * up, "n_r": 60.0 + 35.0 * up + 0.01 * ripple, "x_dem": 8.0 + 34.0 * up,
        "x_lvdt": 8.0 + 34.0 * up + 0.005 * ripple,
        "i_cmd": 8.0 * np.gradient(up, t) + 0.05 * ripple, "p_s": 21.0 + 0.05 * ripple,
        "t_oil": 40.0 + 20.0 * t / seconds,
        "vigv": -25.0 + 42.0 * up, "vgv1": -19.0 + 28.0 * up, "vgv2": -14.0 + 22.0 * up, "state": 2.0 + 0.0 * t,
    }  # fmt: skip
    return {k: Channel(t, v) for k, v in rows.items()}


def as_if(channels: dict[str, Channel], **how: Callable[[np.ndarray], np.ndarray]) -> dict[str, Channel]:
    return {k: Channel(c.t, how[k](c.values)) if k in how else c for k, c in channels.items()}


RPM = 30_000.0
# signal -> unit of the log, the signal's values in it, and the option that the refusal proposes
WRONG: list[tuple[str, str, Callable[[np.ndarray], np.ndarray], str]] = [
    ("n_dem", "rpm", lambda v: v * RPM / 100, "--unit n_dem=rpm --design-rpm R"),
    ("n_r", "Hz", lambda v: v * RPM / 6000, "--unit n_r=rpm --design-rpm R"),
    ("n_dem", "ratio", lambda v: v / 100, "--unit n_dem=ratio"),
    ("n_r", "ratio", lambda v: v / 100, "--unit n_r=ratio"),
    ("x_dem", "m", lambda v: v / 1e3, "--unit x_dem=m"),
    ("x_lvdt", "m", lambda v: v / 1e3, "--unit x_lvdt=m"),
    ("x_lvdt", "um", lambda v: v * 1e3, "--unit x_lvdt=um"),
    ("i_cmd", "A", lambda v: v / 1e3, "--unit i_cmd=A"),
    ("i_cmd", "uA", lambda v: v * 1e3, "--unit i_cmd=uA"),
    ("p_s", "Pa", lambda v: v * 1e6, "--unit p_s=Pa"),
    ("p_s", "kPa", lambda v: v * 1e3, "--unit p_s=kPa"),
    ("p_s", "bar", lambda v: v * 10, "--unit p_s=bar"),
    ("p_s", "psi", lambda v: v * 145.0377, "--unit p_s=psi"),
    ("t_oil", "K", lambda v: v + 273.15, "--unit t_oil=K"),
    ("vigv", "rad", np.deg2rad, "--unit vigv=rad"),
    ("vgv1", "rad", np.deg2rad, "--unit vgv1=rad"),
    ("vgv2", "rad", np.deg2rad, "--unit vgv2=rad"),
    ("state", "text of another controller", lambda v: v + 40, "map another name"),
]


# ---- units -----------------------------------------------------------------------------------------------------------


def test_every_signal_has_a_range_with_a_reason() -> None:
    assert plausible.RANGES.keys() == UNITS.keys()
    for signal, r in plausible.RANGES.items():
        assert r.unit == UNITS[signal] and r.low < r.high and len(r.why) > 20
    page = (ROOT / "docs" / "logs.md").read_text(encoding="utf-8")
    for r in plausible.RANGES.values():
        assert f"{r.low:g} to {r.high:g}" in page, "docs/logs.md has the table of ranges"


@pytest.mark.parametrize(("signal", "unit", "turn", "option"), WRONG, ids=[f"{s} in {u}" for s, u, _, _ in WRONG])
def test_a_unit_that_was_forgotten_is_refused_with_the_option_that_mends_it(
    tmp_path: Path, signal: str, unit: str, turn: Any, option: str
) -> None:
    good = a_run()
    write_log(tmp_path / "good.parquet", good)
    assert read_log(tmp_path / "good.parquet").notes == []
    file = tmp_path / "run.parquet"
    write_log(file, as_if(good, **{signal: turn}))
    line = refused(file)
    assert f"{signal} ({signal})" in line and option in line and re.search(r"\d", line)
    if "--unit" not in option or unit == "Hz":
        return
    log = read_log(file, units={signal: unit}, design_rpm=RPM)
    np.testing.assert_allclose(log.channels[signal].values, good[signal].values, rtol=1e-6, atol=1e-6)


def test_all_channels_in_si_are_refused_and_named(tmp_path: Path) -> None:
    good = a_run()
    si = {
        "x_dem": 1e-3,
        "x_lvdt": 1e-3,
        "i_cmd": 1e-3,
        "vigv": np.pi / 180,
        "vgv1": np.pi / 180,
        "n_dem": 1e-2,
        "n_r": 1e-2,
    }
    write_log(tmp_path / "si.parquet", as_if(good, **{k: lambda v, f=f: v * f for k, f in si.items()}))  # type: ignore[misc]
    line = refused(tmp_path / "si.parquet")
    assert "n_dem" in line and "the same for" in line and "x_lvdt" in line
    write_log(
        tmp_path / "si.parquet", as_if(good, p_s=lambda v: v * 1e6, t_oil=lambda v: v + 273.15, n_dem=lambda v: v * 300)
    )
    assert "n_dem (n_dem): all values are outside" in refused(tmp_path / "si.parquet")
    assert "the same for p_s, t_oil" in refused(tmp_path / "si.parquet")


def test_what_the_user_states_is_taken_but_not_against_the_range(tmp_path: Path) -> None:
    write_log(tmp_path / "a.parquet", as_if(a_run(), x_lvdt=lambda v: v / 1e3))
    assert "x_lvdt" in read_log(tmp_path / "a.parquet", units={"x_lvdt": "mm"}).channels
    write_log(tmp_path / "b.parquet", as_if(a_run(), n_dem=lambda v: v * 300))
    assert "--unit" in refused(tmp_path / "b.parquet", units={"n_dem": "%"})


def test_a_machine_that_stands_still_may_be_near_zero(tmp_path: Path) -> None:
    """A log of an engine that is off, and one held at a schedule's zero, are logs like any other."""
    t, rng = np.arange(3000) * 0.01, np.random.default_rng(1)
    noise = {
        k: Channel(t, rng.normal(0.0, s, t.size))
        for k, s in {"x_lvdt": 0.005, "i_cmd": 0.02, "vigv": 0.03, "n_r": 0.02}.items()
    }
    write_log(tmp_path / "off.parquet", noise | {"n_dem": Channel(t, 0.0 * t)})
    assert set(read_log(tmp_path / "off.parquet").channels) == {*noise, "n_dem"}
    slow = as_if(
        a_run(), i_cmd=lambda v: v * 0.0 + 0.02, vigv=lambda v: 0.0 * v
    )  # a current sensor and a potentiometer that are dead
    write_log(tmp_path / "dead.parquet", slow)
    assert set(read_log(tmp_path / "dead.parquet").channels) == set(slow)
    held = as_if(
        a_run(),
        **{k: lambda v: v[:1] + 0.01 * (v - v[0]) for k in ("n_dem", "n_r", "x_dem", "x_lvdt")},
        vigv=lambda v: 0.01 * v,
    )
    write_log(tmp_path / "held.parquet", held)
    assert set(read_log(tmp_path / "held.parquet").channels) == set(held)


@given(st.data())
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow], max_examples=examples(40))
def test_a_few_wild_samples_are_left_out_with_a_note_and_the_rest_is_read(tmp_path: Path, draw: st.DataObject) -> None:
    good = a_run()
    signal = draw.draw(st.sampled_from(sorted(set(good) - {"state"})))
    c = good[signal]
    where = draw.draw(st.lists(st.integers(0, c.t.size - 1), min_size=1, max_size=60, unique=True))
    wild = draw.draw(st.sampled_from([1e9, -1e9, 1e4, -9999.0, 65535.0]))
    values = c.values.copy()
    values[where] = wild
    write_log(tmp_path / "spikes.parquet", {**good, signal: Channel(c.t, values)})
    log = read_log(tmp_path / "spikes.parquet")
    check(log)
    assert np.array_equal(log.channels[signal].values, np.delete(c.values, where))
    assert [n for n in log.notes if n.startswith(f"{signal} (") and f"{len(where)} of 3,000 samples are outside" in n]
    for name in set(good) - {signal}:
        assert np.array_equal(log.channels[name].values, good[name].values)


def test_an_engine_at_rest_does_not_hide_a_speed_in_rpm(tmp_path: Path) -> None:
    good = a_run()
    at = good["n_dem"].t
    write_log(tmp_path / "a.parquet", {**good, "n_dem": Channel(at, np.where(at < 25.0, 0.0, 28_173.0))})
    assert "28,173" in refused(tmp_path / "a.parquet")


def test_a_log_made_in_python_is_held_to_the_same(tmp_path: Path) -> None:
    good = a_run()
    Log("mine", good)
    with pytest.raises(LogError, match=r"mine: n_dem .*--unit n_dem=rpm"):
        Log("mine", as_if(good, n_dem=lambda v: v * 300))
    with pytest.raises(LogError, match=r"mine: spans 1e\+09 s"):
        Log("mine", {"n_dem": Channel(np.array([0.0, 0.01, 1e9]), np.full(3, 60.0))})


def test_a_signal_of_a_users_own_model_may_have_any_size(tmp_path: Path) -> None:
    t = np.arange(100) * 0.01
    (tmp_path / "a.csv").write_text("t,p_s\n" + "".join(f"{k},{210 + k}\n" for k in t))
    log = read_log(tmp_path / "a.csv", signals={"p_s": "bar"}, require=("p_s",))
    assert log.channels["p_s"].values[0] == 210.0
    assert "p_s" in refused(tmp_path / "a.csv", require=("p_s",))


# ---- every command ---------------------------------------------------------------------------------------------------

COMMANDS = [
    *([c, "{log}"] for c in ("replay", "compare", "locate", "diagnose", "experiment")),
    ["extend", "{log}", "--effect", "valve_dead_band", "--out", "{folder}/m.toml"],
    ["schedule", "--log", "{log}"],
    ["run", "--bus", "lockstep", "--log", "{log}"],
    ["run", "--bus", "lockstep", "--profile", "{log}"],
    ["ecu", "--bus", "local:reading", "--log", "{log}"],
]


@pytest.mark.parametrize("words", COMMANDS, ids=[" ".join(w) for w in COMMANDS])
def test_every_command_refuses_a_wrong_unit_with_the_same_line(
    tmp_path: Path, words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "rpm.csv"
    write_log(file, as_if(a_run(8.0), n_dem=lambda v: v * 300))
    words = [w.format(log=file, folder=tmp_path) for w in words]
    assert main(words) == 2
    complaint = capsys.readouterr().err.strip()
    with pytest.raises(LogError) as caught:
        read_log(file)
    assert complaint == f"vaneloop: {caught.value}"
    assert "n_dem (n_dem)" in complaint and "--unit n_dem=rpm --design-rpm R" in complaint
    # what the line proposes is an option of this very command, and reads the log
    parser = terminal.Parser(prog="vaneloop")
    import importlib

    from vaneloop.cli.main import COMMANDS as TABLE

    importlib.import_module(TABLE[words[0]][0]).add_options(parser)
    args = parser.parse_args([*words[1:], "--unit", "n_dem=rpm", "--design-rpm", "30000"])
    reading = options.log_options(args, getattr(args, "profile", None))
    assert 59.0 < read_log(file, **reading).channels["n_dem"].values.min() < 61.0


def test_the_workbench_refuses_it_with_the_same_line(tmp_path: Path) -> None:
    from vaneloop.web import process, worker

    file = tmp_path / "rpm.csv"
    write_log(file, as_if(a_run(8.0), n_dem=lambda v: v * 300))
    with pytest.raises(LogError) as caught:
        read_log(file)
    silent = lambda fraction, text: None  # noqa: E731
    tasks: list[Callable[..., Any]] = [worker.preview, worker.compare, worker.diagnose]
    for task in tasks:
        with pytest.raises(LogError) as again:
            task(silent, [str(file)])
        assert str(again.value) == str(caught.value) == process._line(again.value)
    with pytest.raises(LogError, match="n_dem"):
        worker.schedule_step(silent, "loop", ["--log", str(file)], str(tmp_path), "")
    words = ["--log", str(file), "--unit", "n_dem=rpm", "--design-rpm", "30000"]
    from vaneloop.cli.schedule import log_of

    assert log_of(worker.parsed("schedule", words)).channels["n_dem"].values.max() < 100.0


# ---- time ------------------------------------------------------------------------------------------------------------

FORMATS = [".csv", ".parquet", ".mf4", ".log", ".asc", ".blf", ".trc", "bus.mf4"]  # that `write_stamped` writes
_T0 = 1_735_000_000.0


def write_stamped(file: Path, t: np.ndarray) -> None:
    """A log of n_dem (60 to 70 %) whose rows or frames carry the stamps ``t`` (s), in this order, in the format of its
    suffix.
    """
    n_dem = 60.0 + np.linspace(0.0, 10.0, t.size)
    suffix = file.suffix
    if suffix == ".csv":
        file.write_text("t,n_dem\n" + "".join(f"{a:.6f},{b:.6f}\n" for a, b in zip(t, n_dem, strict=True)))
        return
    if suffix == ".parquet":
        import pyarrow as pa
        import pyarrow.parquet as pq

        pq.write_table(pa.table({"t": t, "n_dem": n_dem}), file)
        return
    if suffix == ".mf4" and not file.name.startswith("bus"):
        write_groups(file, [(t, {"n_dem": (n_dem, "%")})])
        return
    message = next(m for m in load_dbc(tables.path("vgv.dbc"))[0] if m.layout.name == "ECU_DEMAND")
    data = encode(message, {"n_dem": n_dem, "n_r": n_dem}, t.size)
    frames = Frames(
        t, np.full(t.size, message.ident, np.uint32), np.zeros(t.size, np.int32), np.full(t.size, 8, np.uint8), data
    )
    if suffix == ".mf4":
        write_bus(file, frames)
    else:
        raw_writer(file, frames)


def raw_writer(file: Path, frames: Frames) -> None:
    """Frames with their stamps as they are: python-can's writers mend them."""
    rows = list(zip(frames.t.tolist(), frames.ident.tolist(), frames.data, strict=True))
    if file.suffix == ".log":
        write_candump(file, frames)
    elif file.suffix == ".asc":
        head = "date Fri Jan 1 10:00:00.000 am 2021\nbase hex  timestamps absolute\n"
        file.write_text(head + "".join(f"{t:.6f} 1  {i:X}  Rx  d 8 {d.tobytes().hex(' ')}\n" for t, i, d in rows))
    elif file.suffix == ".trc":
        text = "".join(
            f"{k + 1:6}) {1e3 * t:.3f} 1  Rx  {i:04X}  8  {d.tobytes().hex(' ')}\n" for k, (t, i, d) in enumerate(rows)
        )
        file.write_text(";$FILEVERSION=1.2\n" + text)
    else:
        file.write_bytes(blf([b"".join(blf_frame(round(t * 1e9), i, d.tobytes()) for t, i, d in rows)]))


def blf_frame(ns: int, ident: int, data: bytes) -> bytes:
    head = struct.pack("<4sHHIIIHHQ", b"LOBJ", 32, 1, 48, 1, 2, 0, 0, ns)
    return head + struct.pack("<HBBI8s", 1, 0, len(data), ident, data)


def quick_formats() -> list[str]:
    return [f for f in FORMATS if not f.endswith(".mf4")]


def name_of(form: str) -> str:
    return form if form.startswith("bus") else f"a{form}"


def well_read(file: Path, t: np.ndarray, wrong: list[int], beyond: float = 0.0) -> Log:
    """The log without the rows ``wrong``, with a note that says so; its time still runs as ``t``.

    beyond  s, by how much wrong stamps of the first and last rows lie outside as if there were a gap, so that nobody
            can tell
    """
    log = read_log(file)
    check(log)
    c = log.channels["n_dem"]
    right = np.setdiff1d(np.arange(t.size), wrong)
    assert c.t.size >= right.size - 2 * len(wrong), log.notes
    assert c.t[-1] - c.t[0] < t.max() - t.min() + beyond + 1.0
    rows = np.rint((c.values - 60.0) * 0.1 * (t.size - 1)).astype(int)  # which row each value was
    late = c.t - t[rows]
    # a wrong stamp that is in order by chance cannot be told; all others keep their place
    assert np.count_nonzero(np.abs(late - np.median(late)) > 0.005) <= 2 * len(wrong)
    return log


@pytest.mark.parametrize("wrong", [[1], [198], [1, 198], [2], [2, 3, 195, 196]])
@pytest.mark.parametrize("form", [".csv", ".log"])
def test_of_two_stamps_at_an_end_the_one_that_fits_the_others_is_kept(
    tmp_path: Path, form: str, wrong: list[int]
) -> None:
    t = 5.0 + np.arange(200) * 0.01
    stamps = t.copy()
    for k in wrong:
        stamps[k] = 0.0 if k < 100 else 12.5
    write_stamped(tmp_path / f"a{form}", stamps)
    log = well_read(tmp_path / f"a{form}", t, wrong)
    assert log.channels["n_dem"].t.size == 200 - len(wrong) and any(n.startswith("time") for n in log.notes)


@given(st.data())
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow], max_examples=examples(60))
def test_wrong_time_stamps_anywhere_are_left_out(tmp_path: Path, draw: st.DataObject) -> None:
    form = draw.draw(st.sampled_from(quick_formats()))
    n = draw.draw(st.integers(200, 600))
    start = draw.draw(st.sampled_from([0.0, 5.0, 1e5, _T0]))
    t = start + np.arange(n) * 0.01
    wrong = draw.draw(st.lists(st.integers(0, n - 1), min_size=1, max_size=8, unique=True))
    stamps = t.copy()
    for k in wrong:
        stamps[k] = draw.draw(st.sampled_from([0.0, 1e9, 1e6, 9e4, start + 1e5, _T0 + 12.5]))
    write_stamped(tmp_path / f"a{form}", stamps)
    before = {
        k: t[0] - stamps[k] for k in wrong if set(range(k)) <= set(wrong) and 0.0 < t[0] - stamps[k] <= plausible.JUMP
    }
    after = {
        k: stamps[k] - t[-1]
        for k in wrong
        if set(range(k, n)) <= set(wrong) and 0.0 < stamps[k] - t[-1] <= plausible.JUMP
    }
    log = well_read(
        tmp_path / f"a{form}", t, wrong, max(before.values(), default=0.0) + max(after.values(), default=0.0)
    )
    visible = [k for k in wrong if abs(stamps[k] - t[k]) > 0.1 and k not in before | after]
    assert not visible or any(n.startswith("time") for n in log.notes)


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("stamp", [0.0, 4e8])
@pytest.mark.parametrize("at", [0, 1500, 2999])
def test_one_wrong_time_stamp_is_left_out_of_every_format(
    tmp_path: Path, form: str, stamp: float, at: int, quick_mdf: None
) -> None:
    t = 100.0 + np.arange(3000) * 0.01
    stamps = t.copy()
    stamps[at] = stamp
    file = tmp_path / name_of(form)
    write_stamped(file, stamps)
    options: dict[str, Any] = {"dbc": tables.path("vgv.dbc")} if form == "bus.mf4" else {}
    log = read_log(file, **options)
    c = log.channels["n_dem"]
    assert c.t.size in (2999, 3000) and c.t[-1] - c.t[0] < (31.0 if stamp or at else 131.0)
    assert stamp == 0.0 and at == 0 or any("time" in n for n in log.notes)


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize(("first", "second"), [(0.0, _T0), (_T0, 0.0), (0.0, 4e5), (4e5, 0.0)])
@pytest.mark.parametrize("share", [0.3, 0.7])
def test_of_a_clock_that_jumps_the_longer_part_is_kept(
    tmp_path: Path, form: str, first: float, second: float, share: float, quick_mdf: None
) -> None:
    n, cut = 1000, int(1000 * share)
    t = np.arange(n) * 0.01
    stamps = np.where(np.arange(n) < cut, first + t, second + t)
    file = tmp_path / name_of(form)
    write_stamped(file, stamps)
    options: dict[str, Any] = {"dbc": tables.path("vgv.dbc")} if form == "bus.mf4" else {}
    log = read_log(file, **options)
    c = log.channels["n_dem"]
    kept = np.arange(n)[cut:] if share < 0.5 else np.arange(n)[:cut]
    np.testing.assert_allclose(c.values, (60.0 + np.linspace(0.0, 10.0, n))[kept], atol=2e-3)
    assert 0.0 <= c.t[0] < 10.1 and c.t[-1] - c.t[0] == pytest.approx(t[kept[-1]] - t[kept[0]], abs=1e-3)
    assert any("time" in n for n in log.notes)


def test_a_gap_stays_a_gap_and_a_short_step_back_is_refused_as_ever(tmp_path: Path) -> None:
    t = np.concatenate([np.arange(1000) * 0.01, 3000.0 + np.arange(1000) * 0.01])
    write_stamped(tmp_path / "gap.csv", t)
    log = read_log(tmp_path / "gap.csv")
    assert log.notes == [] and np.allclose(log.channels["n_dem"].t, t)
    for back in (0.2, 2.0, 3600.0):
        t = 4000.0 + np.arange(2000) * 0.01
        t[1000:] -= back
        for form in (".csv", ".log"):
            write_stamped(tmp_path / f"back{form}", t)
            assert "runs backwards" in refused(tmp_path / f"back{form}")


@pytest.mark.parametrize("unit", ["ms", "us", "ns"])
def test_a_time_that_counts_in_smaller_units_is_refused_with_the_option(tmp_path: Path, unit: str) -> None:
    factor = {"ms": 1e3, "us": 1e6, "ns": 1e9}[unit]
    n = np.arange(30_000)
    (tmp_path / "a.csv").write_text("t,n_dem\n" + "".join(f"{k * 0.01 * factor:.0f},60\n" for k in n))
    assert "--unit t=" in refused(tmp_path / "a.csv")
    assert read_log(tmp_path / "a.csv", units={"t": unit}).channels["n_dem"].t[-1] == pytest.approx(299.99)
    (tmp_path / "b.csv").write_text("t,n_dem\n" + "".join(f"{(_T0 + k * 0.01) * factor:.0f},60\n" for k in n[:100]))
    assert "--unit t=" in refused(tmp_path / "b.csv", guess=False)


def test_spans_out_of_proportion_to_the_rows_are_refused(tmp_path: Path) -> None:
    for step in (60.0, 9_000.0):  # seconds from row to row
        write_stamped(tmp_path / "slow.csv", np.arange(3000) * step)
        assert "spans" in refused(tmp_path / "slow.csv") and "allowed: up to" in refused(tmp_path / "slow.csv")
    write_stamped(tmp_path / "slow.csv", np.arange(1500) * 10.0)
    assert read_log(tmp_path / "slow.csv").channels["n_dem"].t.size == 1500
    write_stamped(tmp_path / "jumps.csv", np.concatenate([k * 1e6 + np.arange(100.0) for k in range(4)]))
    assert "time jumps 3 times" in refused(tmp_path / "jumps.csv")


def test_a_log_that_does_not_count_from_its_start_is_simulated_from_it(tmp_path: Path) -> None:
    """Seconds of the day, or of the era of a logger: not eighty thousand seconds of nothing before the first row."""
    write_stamped(tmp_path / "day.csv", 86_000.0 + np.arange(1000) * 0.01)
    log = read_log(tmp_path / "day.csv")
    assert log.channels["n_dem"].t[0] == 0.0 and "taken for the start of the log" in log.notes[0]


def test_blocks_of_rows_of_a_table_are_channels_of_their_own(tmp_path: Path) -> None:
    """A table that lists one channel after the other: each runs from its own start."""
    rows = [f"{k * 0.01:.2f},60,\n" for k in range(500)] + [f"{k * 0.5:.2f},,{k}\n" for k in range(9)]
    (tmp_path / "a.csv").write_text("t,n_dem,x_dem\n" + "".join(rows))
    log = read_log(tmp_path / "a.csv")
    assert log.channels["n_dem"].t.size == 500 and log.channels["x_dem"].values.tolist() == list(range(9))


@pytest.mark.parametrize("command", quick_first(["replay", "compare"]))
def test_replay_and_compare_of_a_wrong_stamp_stay_small(tmp_path: Path, command: str) -> None:
    t = np.arange(1000) * 0.01
    t[-1] = 1e9
    write_stamped(tmp_path / "a.csv", t)
    out = tmp_path / "r.json"
    done = limited([command, str(tmp_path / "a.csv"), "--json", str(out), "--quiet"], 6 << 30)
    assert done.returncode in (0, 2) and "Traceback" not in done.stderr, done.stderr
    if command == "replay":
        result = json.loads(out.read_text())
        assert result["simulated_s"] < 12.0 and any("far from all others" in n for n in result["notes"])


def test_a_profile_of_any_length_is_refused(tmp_path: Path) -> None:
    (tmp_path / "p.toml").write_text("t = [0, 1e9]\nn_dem = [60, 90]\n")
    with pytest.raises(InputError, match="spans 1e"):
        read_profile(tmp_path / "p.toml")
    from hil.engine_test import load_profile

    text = tables.path("engine_test.toml").read_text()
    head, dwell = text.split("[dwell]")
    (tmp_path / "e.toml").write_text(head + "[dwell]" + re.sub(r"\b\d+(?=,)", "90000", dwell))
    with pytest.raises(InputError, match="allowed: up to 100000 s"):
        load_profile(tmp_path / "e.toml")


# ---- memory ----------------------------------------------------------------------------------------------------------


def limited(words: list[str], memory: int) -> subprocess.CompletedProcess[str]:
    """Run a command of ours with so much address space, and no more."""
    code = (
        f"import resource, sys; resource.setrlimit(resource.RLIMIT_AS, ({memory}, {memory}));"
        f"sys.argv = ['vaneloop', *{words!r}]; from vaneloop.cli.main import run; run()"
    )
    return subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=300, check=False
    )


def one_line(done: subprocess.CompletedProcess[str]) -> str:
    assert done.returncode == 2 and "Traceback" not in done.stderr, done.stderr
    (line,) = done.stderr.strip().splitlines()
    return line


TOMLS = {
    "a key of 50,000 parts": "a" + ".a" * 50_000 + " = 1\n",
    "a table of 50,000 parts": "[a" + ".a" * 50_000 + "]\nb = 1\n",
    "quoted parts": '"\\""' + '."\\""' * 50_000 + " = 1\n",
    "parts with blanks": "a" + " . 'a'" * 50_000 + " = 1\n",
    "lists in lists": "a = " + "[" * 50_000,
    "tables in tables": "a = " + "{a = " * 50_000,
    "nine megabytes": "a = 1\n" * 1_500_000,
    "a long word": "a" * 1_000_000,
    "blanks": "a" + " " * 1_000_000,
    "many keys of many parts": "".join(f"k{k:x}.a.b.c.d.e.f.g.h.i.j.k.l.m = 1\n" for k in range(25_000)),
}


@pytest.mark.parametrize("what", quick_first(TOMLS, len(TOMLS) - 1))
def test_no_toml_takes_much_memory_or_time(tmp_path: Path, what: str) -> None:
    """Nor as what any command takes: a model, a scenario, a profile, a table."""
    file = tmp_path / "m.toml"
    file.write_text(TOMLS[what])
    code = (
        f"import resource; resource.setrlimit(resource.RLIMIT_AS, (2 << 30, 2 << 30)); from vaneloop.base.errors "
        f"import InputError\n"
        "from vaneloop.base.tables import load_toml\n"
        f"try: load_toml({str(file)!r}); print('read')\nexcept InputError as e: print(e)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0 and len(done.stdout.splitlines()) == 1, done.stderr[-300:]
    assert (done.stdout == "read\n") == (what == "many keys of many parts") or str(file) in done.stdout


def test_every_command_that_reads_a_toml_bounds_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "m.toml"
    file.write_text(TOMLS["a key of 50,000 parts"])
    log, system = str(ROOT / "examples" / "hidden_effect.parquet"), tmp_path / "s.py"
    system.write_text(
        "from vaneloop import System\n"
        "system = System('s', 'static', lambda u, x, p: u.n_dem, outputs={'n_r': '%'}, inputs={'n_dem': '%'})\n"
    )
    for words in (
        ["replay", log, "--model", str(file)], ["compare", log, "--model", str(file)], ["inject", str(file)],
        ["run", "--bus", "lockstep", "--profile", str(file)], ["engine-test", "--profile", str(file)],
        ["schedule", "--geometry", str(file)], ["compare", log, "--system", str(system), "--model", str(file)],
    ):  # fmt: skip
        assert main(words) == 2, words
        assert "too many dotted parts; allowed: 16" in capsys.readouterr().err, words


def test_shipped_tables_are_far_below_the_bounds() -> None:
    for file in [*ROOT.rglob("tables/*.toml"), *ROOT.rglob("hil/inject/scenarios/*.toml")]:
        load_toml(file)
        assert file.stat().st_size < tables.MOST_BYTES / 20


def blf(containers: list[bytes], stated: int | None = None) -> bytes:
    """A BLF whose containers unpack to these bytes."""
    out = io.BytesIO()
    out.write(b"LOGG" + (144).to_bytes(4, "little") + bytes(136))
    zipped = {body: zlib.compress(body, 9) for body in set(containers)}
    for body in containers:
        packed = zipped[body]
        size = 32 + len(packed)
        out.write(
            struct.pack("<4sHHIIH6xI4x", b"LOBJ", 16, 1, size, 10, 2, stated or len(body)) + packed + bytes(size % 4)
        )
    return out.getvalue()


@pytest.mark.slow
@pytest.mark.parametrize(
    "what", [pytest.param("zeros", marks=pytest.mark.slow), "frames", pytest.param("a lie", marks=pytest.mark.slow)]
)
def test_a_blf_that_unpacks_to_gigabytes_is_refused(tmp_path: Path, what: str) -> None:
    file = tmp_path / "bomb.blf"
    block = bytes(16 << 20) if what != "frames" else blf_frame(0, 0xA0, bytes(8)) * ((16 << 20) // 48)
    file.write_bytes(blf([block] * 110, 1 << 31 if what == "a lie" else None))
    assert file.stat().st_size < 8 << 20
    line = one_line(limited(["replay", str(file)], 3 << 30))
    assert "unpack to more than" in line and "allowed" in line


def test_frames_that_never_change_are_no_bomb(tmp_path: Path) -> None:
    t = np.arange(60_000) * 0.01
    write_log(tmp_path / "a.blf", {"n_dem": Channel(t, np.full(t.size, 60.0))})
    assert read_log(tmp_path / "a.blf").channels["n_dem"].t.size == t.size


@pytest.mark.slow
@pytest.mark.parametrize("what", ["rows", "pages"])
def test_a_parquet_that_unpacks_to_gigabytes_is_refused(tmp_path: Path, what: str) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    file = tmp_path / "bomb.parquet"
    if what == "rows":
        with pq.ParquetWriter(
            file, pa.schema([("t", pa.float64()), ("n_dem", pa.float64())]), compression="zstd"
        ) as writer:
            block = pa.table({"t": np.zeros(1 << 20), "n_dem": np.zeros(1 << 20)})
            for _ in range(64):
                writer.write_table(block)
    else:
        text = pa.array(["0" * 1_000_000] * 200)
        pq.write_table(pa.table({"t": np.arange(200.0), "n_dem": text}), file, compression="zstd", use_dictionary=False)
    assert file.stat().st_size < 4 << 20
    line = one_line(limited(["replay", str(file)], 3 << 30))
    assert "allowed: up to" in line or "not numbers" in line


@pytest.mark.slow
def test_an_mdf_that_unpacks_to_gigabytes_is_refused(tmp_path: Path) -> None:
    import asammdf

    file = tmp_path / "bomb.mf4"
    n = 20_000_000
    with asammdf.MDF(version="4.10") as mdf:
        mdf.append(
            [asammdf.Signal(np.zeros(n), np.zeros(n), name=f"n_{k}") for k in ("dem", "r")], common_timebase=True
        )
        mdf.save(file, overwrite=True, compression=2)
    assert file.stat().st_size < 4 << 20
    line = one_line(limited(["replay", str(file)], 4 << 30))
    assert str(file) in line


# ---- what was lost in silence ----------------------------------------------------------------------------------------


def test_a_name_mapped_to_two_signals_serves_both(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "a.csv"
    file.write_text("t,RPM,B\n" + "".join(f"{k * 0.01:.2f},{60 + k * 0.001},{k}\n" for k in range(100)))
    parser = terminal.Parser(prog="x")
    options.add_log_options(parser)
    args = parser.parse_args([str(file), "--map", "RPM=n_dem", "--map", "RPM=n_r"])
    log = read_log(file, **options.log_options(args))
    assert np.array_equal(log.channels["n_dem"].values, log.channels["n_r"].values)
    args = parser.parse_args([str(file), "--map", "RPM=n_dem", "--map", "RPM=n_r", "--map", "RPM=vigv"])
    assert set(read_log(file, **options.log_options(args)).channels) == {"n_dem", "n_r", "vigv"}
    assert main(["replay", str(file), "--map", "RPM=n_dem", "--map", "B=n_dem"]) == 2
    assert "'RPM' and 'B' are mapped to n_dem" in capsys.readouterr().err
    assert main(["replay", str(file), "--map", "n_dem=RPM", "--map", "n_dem=B"]) == 2
    assert "n_dem" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("option", "words"), [("--unit", ["n_dem=rpm", "n_dem=Hz"]), ("--tolerance", ["vigv=1", "vigv=2"])]
)
def test_an_option_given_two_values_is_refused(
    tmp_path: Path, option: str, words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    write_stamped(tmp_path / "a.csv", np.arange(100) * 0.01)
    assert main(["replay", str(tmp_path / "a.csv"), option, words[0], option, words[1]]) == 2
    assert f"{option} '{words[1]}'" in capsys.readouterr().err


@pytest.mark.parametrize(
    "option", [["--map", "A=n_dem"], ["--unit", "n_dem=rpm"], ["--dbc", "x.dbc"], ["--design-rpm", "100"]]
)
@pytest.mark.parametrize("command", [["schedule"], ["run", "--bus", "lockstep"], ["ecu", "--profile", "step"]])
def test_an_option_of_reading_without_a_log_is_refused(
    command: list[str], option: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*command, *option]) == 2
    line = capsys.readouterr().err
    assert line.startswith(f"vaneloop: {option[0]} says how to read a log") and line.count("\n") == 1


def test_frames_that_candump_dropped_are_told(tmp_path: Path) -> None:
    write_stamped(tmp_path / "a.log", np.arange(100) * 0.01)
    lines = (tmp_path / "a.log").read_text().splitlines()
    lines[50:50] = ["DROPCOUNT: dropped 7 CAN frames on 'can0' socket (total drops 7)"]
    lines[70:70] = ["DROPCOUNT: dropped 1 CAN frame on 'can0' socket (total drops 8)"]
    (tmp_path / "a.log").write_text("\n".join(lines))
    log = read_log(tmp_path / "a.log")
    assert log.channels["n_dem"].t.size == 100
    assert log.notes == ["the logger dropped 8 frames of can0 (DROPCOUNT)"]


# ---- compiling -------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("form", [".blf", ".csv"])
def test_compiling_is_told_before_it_is_done_whatever_the_format(tmp_path: Path, form: str) -> None:
    """With no compiled code at all: each part that takes seconds is told of before its compiled code is written."""
    write_stamped(tmp_path / f"a{form}", np.arange(100) * 0.01)
    code = (
        "import sys, pathlib\nfrom vaneloop.base import terminal\nimport vaneloop.cli.main\n"
        f"cache = pathlib.Path({str(tmp_path / 'cache')!r})\n"
        "def say(args, text):\n"
        "    print(text, '|', *sorted({f.name.split('-')[0] for f in cache.rglob('*.nbc')}), flush=True)\n"
        "terminal.say = say\n"
        f"sys.exit(vaneloop.cli.main.main(['replay', {str(tmp_path / f'a{form}')!r}]))\n"
    )
    import os

    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache"), "VANELOOP_AHEAD": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=500,
        check=False,
        env=environment,
    )
    assert done.returncode == 0, done.stderr
    lines = [line.partition("|") for line in done.stdout.splitlines() if line.startswith("compiling")]
    told = {text.split(" for ")[0].strip(): there for text, _, there in lines}
    assert set(told) == {"compiling the simulator"} | (
        {"compiling the reader of CAN logs"} if form == ".blf" else set()
    )
    assert "lockstep.advance" not in told["compiling the simulator"]
    if form == ".blf":
        assert "columns.cut" not in told["compiling the reader of CAN logs"]


def test_compiled_code_is_known_by_its_function(tmp_path: Path) -> None:
    """Before a function is compiled there is none of its code; after that there is, whatever the function is called."""
    code = (
        "from vaneloop.base.compiled import is_cached\n"
        "from plant.linkage import crank\n"
        "from plant.stages import actuator_run\n"
        "before = is_cached(crank)\n"
        "crank(0.0, 0.3, 0.2, 0.2, 0.1)\n"
        "assert not before and is_cached(crank) and is_cached(actuator_run), before\n"
    )
    import os

    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache"), "VANELOOP_AHEAD": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False,
                          env=environment)  # fmt: skip
    assert done.returncode == 0, done.stderr


def test_names_on_offer_are_those_of_any_log(tmp_path: Path) -> None:
    """A log whose units are wrong still says what it holds: the workbench's form needs it."""
    write_log(tmp_path / "rpm.csv", as_if(a_run(8.0), n_dem=lambda v: v * 300))
    assert "n_dem" in offered(tmp_path / "rpm.csv")
