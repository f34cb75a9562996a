"""Recordings: what goes in comes out, in every format, whatever ends the process."""

from __future__ import annotations

import importlib.util
import json
import os
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import can
import numpy as np
import pyarrow.parquet as pq
import pytest

from hil.logs import formats, read_log
from hil.logs.dbc import load_dbc
from hil.logs.record_formats import ERROR, EXTENDED, FD, FRAME, REMOTE
from hil.logs.recorder import Recorder, RecorderProcess
from hil.logs.recordings import read_record
from hil.logs.signals import encode
from tests.conftest import ROOT
from tests.test_bus import broker_of
from vaneloop.base.errors import InputError
from vaneloop.base.tables import path

FORMATS = [s for s, f in formats.FORMATS.items() if f.recorder]
START = 1_700_000_000 * 10**9  # ns
COMMAND = [sys.executable, "-m", "vaneloop.cli.main"]


def waited(pid: int) -> float:
    """Time, s, that a process's threads have waited for a processor so far: what a busy machine adds to everything that
    they do.
    """
    return sum(int(f.read_text().split()[1]) for f in Path(f"/proc/{pid}/task").glob("*/schedstat")) * 1e-9


def some_frames(n: int, first: int = 0) -> np.ndarray:
    """Frames ``first`` to ``first + n``, a millisecond apart: VGV_STATUS with the number in x_dem, every other one
    sent.
    """
    status = next(m for m in load_dbc(path("vgv.dbc"))[0] if m.layout.name == "VGV_STATUS")
    k = first + np.arange(n)
    out = np.zeros(n, FRAME)
    out["ns"], out["ident"], out["length"], out["tx"] = START + k * 10**6, 0x0B0, 8, k % 2
    out["data"][:, :8] = encode(
        status, {"x_dem": k % 40000 * 0.001, "x_lvdt": np.zeros(n), "state": np.full(n, 2.0)}, n
    )
    return out


def special_frames() -> np.ndarray:
    """One of each kind that a bus can carry, within one millisecond, in an order that must stay."""
    out = np.zeros(6, FRAME)
    out["ns"] = START + 1000 * np.arange(6)
    out["ident"] = 0x0A0, EXTENDED | 0x1234567, REMOTE | 0x123, ERROR | 0x080, 0x0B0, 0x7FF
    out["length"] = 8, 3, 4, 8, 12, 0
    out["flags"][4] = FD | 1
    out["tx"] = 0, 1, 0, 0, 1, 0
    for k, n in enumerate(out["length"]):
        if not out["ident"][k] & REMOTE:
            out["data"][k, :n] = k + np.arange(n)
    return out


@pytest.mark.parametrize("suffix", FORMATS)
def test_every_kind_of_frame_comes_back_as_it_was(suffix: str, tmp_path: Path) -> None:
    file, given = tmp_path / f"run{suffix}", special_frames()
    recorder = Recorder(file)
    recorder.put(given.tobytes())
    recorder.close()
    got = read_record(file)
    # error frames have no direction, and BLF and MDF4 keep an error frame's class, but not all of its bytes
    errors = given["ident"] & ERROR != 0
    assert (got.ms == START // 10**6).all()
    assert got.sent[~errors].tolist() == (given["tx"] != 0)[~errors].tolist()
    kinds = EXTENDED | REMOTE | ERROR
    assert [int(h) & kinds for h in got.rows[:, 0]] == [int(i) & kinds for i in given["ident"]]
    assert (got.rows[~errors, 0] & 0x1FFFFFFF).tolist() == (given["ident"][~errors] & 0x1FFFFFFF).tolist()
    assert (got.rows[:, 0] >> 40 & FD).tolist() == (given["flags"] & FD).tolist()
    assert (got.rows[~errors, 0] >> 32 & 0xFF).tolist() == given["length"][~errors].tolist()
    words = np.ascontiguousarray(given["data"][:, :8]).view("<i8")[:, 0]
    assert got.rows[~errors, 1].tolist() == words[~errors].tolist()


def parquet_readers() -> list[Callable[[Path], Any]]:
    """pyarrow's, which the product reads with, and one of another code where it is installed."""
    other = importlib.util.find_spec("polars") and importlib.import_module("polars")
    return [pq.read_table, *([other.read_parquet] if other else [])]


@pytest.mark.parametrize("suffix", FORMATS)
def test_the_file_is_whole_after_every_append(suffix: str, tmp_path: Path, quick_mdf: None) -> None:
    file, recorder, total = tmp_path / f"run{suffix}", None, 0
    recorder = Recorder(file)
    for k in range(30):  # Parquet merges row groups at the 5th and at the 25th
        recorder.put(some_frames(7, total).tobytes())
        recorder.flush()
        total += 7
        if k in (0, 1, 3, 4, 5, 23, 24, 29):
            log = read_log(file, require=("x_dem",))
            assert log.channels["x_dem"].values == pytest.approx(np.arange(total) * 0.001, abs=1e-9)
            assert len(read_record(file).ms) == total
            if suffix == ".parquet":
                assert all(len(read(file)) == total for read in parquet_readers())
            else:
                with can.LogReader(file) as reader:
                    assert sum(1 for _ in reader) == total
    recorder.close()
    after = read_record(file)
    assert (after.ms - START // 10**6).tolist() == list(range(total))
    assert recorder.frames == total


@pytest.mark.slow
def test_long_parquet_recordings_keep_every_row_in_order(tmp_path: Path) -> None:
    file = tmp_path / "run.parquet"
    recorder = Recorder(file)
    for k in range(700):  # beyond 5**4 appends, where groups are merged no more
        recorder.put(some_frames(2, 2 * k).tobytes())
        recorder.flush()
    grown = file.stat().st_size
    ms = read_record(file).ms - START // 10**6
    assert ms.tolist() == list(range(1400))
    recorder.close()
    assert (read_record(file).ms - START // 10**6).tolist() == list(range(1400))
    assert file.stat().st_size < grown / 20
    assert list(tmp_path.iterdir()) == [file]


@pytest.mark.parametrize("suffix", FORMATS)
def test_a_recording_cut_off_at_the_end_still_opens_where_the_format_can(suffix: str, tmp_path: Path) -> None:
    """A write that a power failure cuts off: whole blocks before it are there (Parquet needs its footer:
    documented).
    """
    file = tmp_path / f"run{suffix}"
    recorder = Recorder(file)
    for k in range(5):
        recorder.put(some_frames(100, 100 * k).tobytes())
        recorder.flush()
    whole = file.stat().st_size
    recorder.put(some_frames(100, 500).tobytes())
    recorder.flush()
    if suffix in (".mf4", ".parquet"):
        return
    with file.open("r+b") as f:
        f.truncate((whole + file.stat().st_size) // 2)
    assert len(read_log(file, require=("x_dem",)).channels["x_dem"].t) >= 500


def test_an_earlier_recording_of_that_name_is_kept(tmp_path: Path) -> None:
    file = tmp_path / "run.log"
    for n in (3, 5):
        recorder = Recorder(file)
        recorder.put(some_frames(n).tobytes())
        recorder.close()
    assert len(read_record(file).ms) == 5
    assert len(read_record(tmp_path / "run.1.log").ms) == 3
    assert recorder.kept == tmp_path / "run.1.log"


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("run.csv", "suffix '.csv'"),
        ("run", "suffix ''"),
        ("no/such/run.log", "its folder does not exist"),
        ("folder.log", "is a folder"),
    ],
)
def test_what_cannot_be_recorded_to_is_refused_in_one_line(name: str, says: str, tmp_path: Path) -> None:
    (tmp_path / "folder.log").mkdir()
    for kind in (Recorder, RecorderProcess):
        with pytest.raises(InputError, match=says) as e:
            kind(tmp_path / name)
        assert "\n" not in str(e.value) and name in str(e.value)


@pytest.mark.slow
@pytest.mark.parametrize("suffix", FORMATS)
def test_a_full_disk_ends_the_recording_but_not_the_file(suffix: str, tmp_path: Path) -> None:
    file = tmp_path / f"run{suffix}"
    code = f"""
        import resource
        from hil.logs.recorder import Recorder
        from vaneloop.base.errors import InputError
        from tests.test_record import some_frames
        recorder, k = Recorder({str(file)!r}), 0
        resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, 60_000))
        try:
            while True:
                recorder.put(some_frames(100, 100 * k).tobytes())
                recorder.flush()
                k += 1
        except InputError as e:
            print(recorder.frames, e)
    """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)], cwd=ROOT, capture_output=True, text=True, check=True, timeout=240
    )
    frames, _, words = done.stdout.partition(" ")
    assert int(frames) > 100 and f"ends after {int(frames):,} frames" in words and "File too large" in words
    assert len(read_record(file).ms) == int(frames)


@pytest.mark.slow
@pytest.mark.parametrize("suffix", FORMATS)
def test_what_an_append_needs_is_loaded_before_the_first_frame_comes(suffix: str, tmp_path: Path) -> None:
    """Else the first frames wait in memory for as long as imports take, and are lost with the process."""
    frames = tmp_path / "frames"
    frames.write_bytes(some_frames(200, 0).tobytes())
    code = f"""
        import sys
        from pathlib import Path
        from hil.logs import columns
        from hil.logs.recorder import Recorder
        compiled = lambda f: map(str, getattr(columns, f).signatures)
        loaded = lambda: {{*sys.modules, *((f, s) for f in ("cut", "wrong_crc") for s in compiled(f))}}
        recorder = Recorder({str(tmp_path / f"run{suffix}")!r})
        before = loaded()
        recorder.put(Path({str(frames)!r}).read_bytes())
        recorder.flush()
        print(sorted(map(str, loaded() - before)))
    """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)], cwd=ROOT, capture_output=True, text=True, check=True, timeout=240
    )
    assert done.stdout.strip() == "[]"


def test_a_recording_ends_though_another_process_holds_its_pipe(tmp_path: Path) -> None:
    """A copy of the loop's process, forked by who runs in it, has every descriptor that it had."""
    recorder = RecorderProcess(tmp_path / "run.log")
    other = os.fork()
    if other == 0:
        signal.pause()
        os._exit(0)
    try:
        recorder.put(some_frames(10).tobytes())
        recorder.close()
    finally:
        os.kill(other, signal.SIGKILL)
        os.waitpid(other, 0)
    assert recorder.frames == 10 and not recorder.error
    assert len(read_record(tmp_path / "run.log").ms) == 10


# ---- kill -9 ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("suffix", FORMATS)
def test_killing_the_recorder_costs_at_most_a_second(suffix: str, tmp_path: Path) -> None:
    file = tmp_path / f"run{suffix}"
    recorder = RecorderProcess(file)
    put_at, k = [], 0
    end, late, due = time.monotonic() + 1.7, 0.0, 0
    while time.monotonic() < end or due <= 50:
        recorder.put(some_frames(1, k).tobytes())
        put_at.append(time.monotonic())
        k += 1
        time.sleep(0.002)
        if (
            time.monotonic() > end
        ):  # frames that must be in the file by now: a second old, more where the recorder had to wait
            late = waited(recorder._process.pid)
            due = sum(t < time.monotonic() - 1.0 - late for t in put_at)
            assert time.monotonic() < end + 120.0
    recorder._process.send_signal(signal.SIGKILL)
    recorder._process.wait()
    held = read_record(file)
    assert (held.ms - START // 10**6).tolist() == list(range(len(held.ms)))
    assert len(held.ms) >= due > 50
    recorder.close()
    assert "killed" in recorder.error


@pytest.mark.slow
def test_killing_the_loop_loses_nothing_that_it_handed_over(tmp_path: Path) -> None:
    file = tmp_path / "run.mf4"
    code = f"""
        import os, signal
        from hil.logs.recorder import RecorderProcess
        from tests.test_record import some_frames
        recorder = RecorderProcess({str(file)!r})
        for k in range(500):
            recorder.put(some_frames(1, k).tobytes())
        print(recorder._process.pid, flush=True)
        os.kill(os.getpid(), signal.SIGKILL)
    """
    command = [sys.executable, "-c", textwrap.dedent(code)]
    done = subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, timeout=120, check=False)
    assert done.returncode == -signal.SIGKILL
    pid, end = int(done.stdout), time.monotonic() + 120
    while (
        Path(f"/proc/{pid}").exists()
        and Path(f"/proc/{pid}/stat").read_text().split()[2] != "Z"
        and time.monotonic() < end
    ):
        time.sleep(0.05)
    assert len(read_record(file).ms) == 500


@pytest.mark.slow
def test_vaneloop_record_survives_kill_9_in_every_format(tmp_path: Path) -> None:
    """Four recorders on one bus, killed while frames come; and one that is asked to end, which has them all."""
    name = f"local:record{os.getpid()}"
    files = [tmp_path / f"killed{s}" for s in FORMATS] + [tmp_path / "whole.blf"]
    started = [
        subprocess.Popen([*COMMAND, "record", str(f), "--bus", name], cwd=ROOT, stdout=subprocess.PIPE, text=True)
        for f in files
    ]
    for p in started:
        assert p.stdout is not None
        assert p.stdout.readline().startswith("recording")
    sent_at = []
    with can.Bus(interface="vaneloop", channel=name.partition(":")[2]) as bus:
        end = time.monotonic() + 2.5
        while time.monotonic() < end:
            bus.send(can.Message(arbitration_id=0x123, is_extended_id=False, data=len(sent_at).to_bytes(4, "little")))
            sent_at.append(time.monotonic())
            time.sleep(0.005)
        killed = time.monotonic()
        late = [waited(p.pid) + waited(broker_of(name.partition(":")[2])) for p in started]
        for p in started[:-1]:
            p.kill()
        until = time.monotonic() + 120
        while (not files[-1].is_file() or len(read_record(files[-1]).ms) < len(sent_at)) and time.monotonic() < until:
            time.sleep(0.2)  # the bus still carries frames to the last one
        started[-1].send_signal(signal.SIGINT)
    said = started[-1].communicate(timeout=240)[0]
    for p in started:
        p.wait(timeout=240)
    for file, more in zip(files, late, strict=True):
        held = read_record(file).rows[:, 1].tolist()
        assert held == list(range(len(held))), file.suffix
        assert len(held) >= sum(t < killed - 1.0 - more for t in sent_at), (file.suffix, more)
    assert len(sent_at) > 100
    assert len(held) == len(sent_at)
    assert started[-1].returncode == 0 and "ended by SIGINT" in said


def test_vaneloop_record_says_what_it_did_and_ends_by_itself(tmp_path: Path) -> None:
    file = tmp_path / "run.log"
    command = [*COMMAND, "record", str(file), "--bus", f"local:quiet{os.getpid()}", "--duration", "0.3", "--json", "-"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=240, check=False)
    assert done.returncode == 0
    assert json.loads(done.stdout)["frames"] == 0
