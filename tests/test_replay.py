"""Replay from the command line, on real logs where they are, and with what users get wrong."""

from __future__ import annotations

import contextlib
import io
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from hil.logs import Channel, write_log
from hil.loop.lockstep import Stimulus, lockstep
from tests.conftest import ROOT
from vaneloop.cli.main import main


def vaneloop(
    *args: str | Path, module: str = "vaneloop.cli.main", cwd: Path = ROOT
) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", module, *map(str, args)]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=300, check=False)


def inside(*args: str | Path) -> subprocess.CompletedProcess[str]:
    """The same command without a process of its own."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = main([*map(str, args)])
        except SystemExit as leaving:
            code = int(leaving.code or 0)
    return subprocess.CompletedProcess(args, code, out.getvalue(), err.getvalue())


def refused(done: subprocess.CompletedProcess[str]) -> str:
    """The one line of a refusal."""
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    lines = done.stderr.strip().splitlines()
    assert len(lines) == 1, lines
    return lines[0]


@pytest.fixture(scope="module")
def own_log(tmp_path_factory):
    """A log that the model itself made, noise-free, and the same with a pot that reads 0.5 deg too much."""
    folder = tmp_path_factory.mktemp("logs")
    n = np.interp(np.arange(0.0, 40.0, 0.01), [0, 2, 10, 20, 25, 40], [60, 60, 90, 90, 75, 75])
    c = lockstep(Stimulus.of(n)).columns
    channels = {k: Channel(c["t"], v) for k, v in c.items() if k not in ("t", "n_engine")}
    write_log(folder / "own.csv", channels)
    write_log(folder / "own.parquet", channels)
    write_log(folder / "own.log", channels)
    write_log(folder / "biased.csv", {**channels, "vigv": Channel(c["t"], c["vigv"] + 0.5)})
    return folder


@pytest.mark.parametrize("name", ["own.csv", "own.parquet", "own.log"])
def test_model_agrees_with_a_log_that_it_made(own_log, name, tmp_path) -> None:
    out = tmp_path / "r.json"
    tolerances = {"vigv": 0.02, "x_lvdt": 0.02, "i_cmd": 0.3}  # a bus log is coarser: resolution, 10 ms frames
    args = [a for k, v in tolerances.items() for a in ("--tolerance", f"{k}={v}")]
    done = inside("replay", own_log / name, *args, "--json", out)
    assert done.returncode == 0, done.stdout + done.stderr
    result = json.loads(out.read_text())
    assert result["schema"] == 1 and len(result["state_hash"]) == 64
    keys = {
        "signal",
        "stage",
        "unit",
        "reference",
        "rms",
        "mean_abs",
        "max_abs",
        "mean_abs_99_100",
        "noise_floor",
        "samples",
    }
    assert all(set(s) == keys for s in result["signals"])
    assert {(s["signal"], s["reference"]) for s in result["signals"]} >= {
        ("vigv", "measured"),
        ("vigv", "schedule"),
        ("i_cmd", "measured"),
    }


@pytest.mark.slow
def test_exceeded_tolerance_exits_1_and_says_which(own_log) -> None:
    done = vaneloop("compare", own_log / "biased.csv", "--tolerance", "vigv=0.4")
    assert done.returncode == 1
    assert (
        "differs: vigv rms 0.4" in done.stdout
    )  # a little less than the bias: the play starts where the log's vane was
    assert vaneloop("compare", own_log / "biased.csv", "--tolerance", "vigv=0.6", "--quiet").returncode == 0


@pytest.mark.slow
def test_module_and_command_are_the_same(own_log) -> None:
    a = vaneloop(own_log / "own.csv", "--json", "-", "--quiet", module="hil.replay")
    b = vaneloop("replay", own_log / "own.csv", "--json", "-", "--quiet")
    one, two = json.loads(a.stdout), json.loads(b.stdout)
    assert one["state_hash"] == two["state_hash"] and one["signals"] == two["signals"]


def test_strategy_changes_the_stroke_demand(own_log) -> None:
    done = inside("replay", own_log / "own.csv", "--strategy", "single", "--tolerance", "x_dem=0.3", "--quiet")
    assert done.returncode == 1


def test_report_is_one_file_that_needs_no_network(own_log, tmp_path) -> None:
    page = tmp_path / "r.html"
    assert inside("replay", own_log / "own.csv", "--report", page, "--out", tmp_path / "sim.parquet").returncode == 0
    html = page.read_text(encoding="utf-8")
    assert "vigv" in html.lower() and "<script src=" not in html and "<link " not in html
    assert (tmp_path / "sim.parquet").stat().st_size > 1000


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["--strategy", "triple"], ["triple", "single", "dual"]),
        (["--tolerance", "vane=1"], ["vane", "vigv"]),
        (["--tolerance", "vigv=fast"], ["fast", "number"]),
        (["--tolerance", "vigv"], ["vigv", "NAME=value"]),
        (["--map", "nonsense"], ["nonsense", "NAME=value"]),
        (["--unit", "n_dem=rpm"], ["rpm", "design"]),
        (["--dbc", "absent.dbc", "--json", "-"], []),
        (["--frobnicate"], ["--frobnicate"]),
        (["--json", "/absent/folder/x.json"], ["/absent/folder/x.json"]),
        (["--report", "/absent/folder/x.html"], ["/absent/folder/x.html"]),
        (["--out", "/absent/folder/x.csv"], ["/absent/folder/x.csv"]),
    ],
)
def test_bad_argument_is_refused_in_one_line(own_log, args, words) -> None:
    done = inside("replay", own_log / "own.csv", *args, *([] if "--json" in args else ["--quiet"]))
    if args[0] == "--dbc":
        assert done.returncode in (0, 2) and "Traceback" not in done.stderr  # a CSV has no use for it
        return
    line = refused(done)
    assert all(w in line for w in words), line


def test_log_without_demand_is_refused_in_one_line(tmp_path) -> None:
    (tmp_path / "x.csv").write_text("t,vigv\n0,1\n0.01,2\n")
    line = refused(inside("replay", tmp_path / "x.csv"))
    assert "x.csv" in line and "n_dem" in line


def test_speed_in_rpm_without_saying_so_is_refused_with_the_way_out(tmp_path) -> None:
    (tmp_path / "x.csv").write_text("t,n_dem\n" + "".join(f"{i / 100},{5000 + i}\n" for i in range(100)))
    line = refused(inside("replay", tmp_path / "x.csv"))
    assert "--design-rpm" in line and "n_dem" in line


def test_time_running_backwards_is_refused_in_one_line(tmp_path) -> None:
    (tmp_path / "x.csv").write_text("t,n_dem\n0,60\n0.01,60\n0.005,60\n0.02,60\n")
    assert "n_dem" in refused(inside("replay", tmp_path / "x.csv"))


def test_gap_in_the_demand_is_noted_and_does_not_count(tmp_path) -> None:
    t = np.concatenate([np.arange(0, 5, 0.01), np.arange(15, 20, 0.01)])
    write_log(tmp_path / "gap.csv", {"n_dem": Channel(t, np.full(len(t), 70.0))})
    done = inside("replay", tmp_path / "gap.csv", "--json", "-")
    result = json.loads(done.stdout)
    assert any("gap" in n for n in result["notes"])
    assert result["simulated_s"] == pytest.approx(20.0, abs=0.05)
    assert result["signals"][0]["samples"] < 1100


def test_unknown_command_is_refused_in_one_line() -> None:
    assert "replay" in refused(vaneloop("repaly"))


def test_real_car_log_drives_the_loop(data_dir) -> None:
    folder = data_dir / "can_honda"
    options = ["--map", "ENGINE_RPM=n_dem", "--unit", "n_dem=rpm", "--design-rpm", "6000", "--json", "-", "--quiet"]
    done = vaneloop("replay", folder / "revlog.log", "--dbc", folder / "honda_pilot_2017.dbc", *options)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert result["simulated_s"] == pytest.approx(13.0, abs=0.2)
    vigv = next(s for s in result["signals"] if s["signal"] == "vigv")
    assert vigv["reference"] == "schedule" and vigv["mean_abs"] < 0.55


@pytest.mark.slow
def test_real_truck_recording_drives_the_loop(data_dir) -> None:
    folder = data_dir / "can_j1939"
    options = ["--map", "EngineSpeed=n_dem", "--unit", "n_dem=rpm", "--design-rpm", "1000", "--json", "-", "--quiet"]
    done = vaneloop("replay", folder / "log.mf4", "--dbc", folder / "j1939_demo.dbc", *options)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert result["simulated_s"] > 100.0
    assert next(s for s in result["signals"] if s["signal"] == "vigv")["mean_abs"] < 0.55
