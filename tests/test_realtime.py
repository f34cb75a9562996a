"""Real time: lateness, overruns, clean ends; controller and ECU as two processes; a recorded run again in lockstep."""

from __future__ import annotations

import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hil.bus import frames
from hil.bus.port import Port, open_bus
from hil.logs import read_log
from hil.logs.recorder import FRAME, Recorder
from hil.logs.recordings import read_record
from hil.loop.ecu import BUILTIN, Demand, EcuStation, Typed, builtin, read_profile
from hil.loop.node import Ecu, Node, replay
from hil.loop.realtime import TICK_NS, Lateness, Stop, Ticker, run_realtime, stop_on_signals, undisturbed
from tests.conftest import ROOT
from vaneloop.base.errors import InputError
from vaneloop.cli.main import main

COMMAND = [sys.executable, "-m", "vaneloop.cli.main"]
_number = count()


@pytest.fixture
def own_bus() -> str:
    """Name of an embedded bus that no other test uses."""
    return f"local:test{os.getpid()}-{next(_number)}"


_started: list[subprocess.Popen[str]] = []


@pytest.fixture(scope="module", autouse=True)
def nothing_stays_behind() -> Iterator[None]:
    """Kill what a failed test has left running."""
    yield
    for process in _started:
        process.kill()


def start(*args: str, **options: Any) -> subprocess.Popen[str]:
    """Start a command in a process of its own, with both outputs in pipes."""
    process = subprocess.Popen(
        [*COMMAND, *args], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options
    )
    _started.append(process)
    return process


def ended(process: subprocess.Popen[str], timeout: float = 240.0) -> tuple[int, str, str]:
    """Wait for a command; return its exit code, output and complaints."""
    try:
        out, err = process.communicate(timeout=timeout)
    finally:
        process.kill()
    assert "Traceback" not in err, err
    return process.returncode, out, err


def follow(process: subprocess.Popen[str], text: str) -> None:
    """Read the command's standard output up to a line with ``text``."""
    assert process.stdout is not None
    for line in process.stdout:
        if text in line:
            return
    raise AssertionError(f"ended without saying {text!r}: {process.communicate()}")


# ---- clock and figures -----------------------------------------------------------------------------------------------


def test_percentiles_are_those_of_all_times_to_a_bin() -> None:
    rng = np.random.default_rng(1)
    times = (10 ** rng.uniform(1, 9.5, 20_000)).astype(np.int64)  # 10 ns to 3 s
    h = Lateness()
    for k, ns in enumerate(times.tolist()):
        h.add(ns, k)
    for q in (0.5, 0.9, 0.99, 0.999):
        exact = float(np.sort(times)[int(np.ceil(q * len(times))) - 1]) * 1e-3
        assert exact <= h.quantile(q) <= max(exact * 1.011, exact + 0.1)
    assert h.quantile(1.0) == times.max() * 1e-3
    assert h.worst_tick == int(times.argmax())
    assert h.count == len(times) == sum(n for _, n in h.shown())
    assert h.share_over(500.0) == pytest.approx(float((times >= 500_000).mean()))


class Clock:
    """A clock that only sleeping and stalls move on: no other program can."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch):
        self.now = 10**12
        monkeypatch.setattr("hil.loop.realtime.time", SimpleNamespace(monotonic_ns=self.read))

    def read(self) -> int:
        self.now += 100
        return self.now

    def ticker(self, **options: Any) -> Ticker:
        ticker = Ticker(**options)
        ticker._sleep = self.sleep
        self.until = ticker._time
        ticker.begin()
        ticker.wait()
        return ticker

    def sleep(self, *_: Any) -> None:
        self.now = max(self.now, self.until.tv_sec * 10**9 + self.until.tv_nsec)


@pytest.mark.parametrize("policy", ["catch-up", "skip"])
def test_a_stall_is_caught_up_or_skipped_as_the_policy_says(policy: str, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock(monkeypatch)
    ticker = clock.ticker(policy=policy)
    clock.now += 30 * TICK_NS
    ticks = 0
    while ticks < 200:
        ticker.wait()
        ticks += 1
    elapsed = (
        ticker.deadline - ticker.start
    ) // TICK_NS  # deadlines passed or set: firmware's ticks and those left out
    assert elapsed == ticks + 1 + ticker.skipped
    if policy == "skip":
        assert ticker.skipped == 29 and ticker.missed == 1
    else:
        assert ticker.skipped == 0 and ticker.missed == 29


def test_a_long_stall_is_skipped_under_either_policy(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock(monkeypatch)
    ticker = clock.ticker(policy="catch-up")
    clock.now += 150 * TICK_NS
    late = ticker.wait()
    assert 149 * TICK_NS < late < 150 * TICK_NS and ticker.skipped == 149
    assert clock.now < ticker.deadline <= clock.now + TICK_NS
    assert ticker.pauses == 1 and ticker.paused == 149


def test_no_tick_begins_before_its_deadline() -> None:
    ticker = Ticker(spin_us=200.0)
    ticker.begin()
    for k in range(100):
        assert ticker.wait() >= 0
        assert time.monotonic_ns() >= ticker.start + k * TICK_NS


class Silent:
    """A bus on which nothing happens; ``at_tick`` is called with the number of each read."""

    def __init__(self, at_tick: Any = None):
        self.reads, self.at_tick = 0, at_tick

    def read(self, rows: np.ndarray) -> int:
        self.reads += 1
        if self.at_tick is not None:
            self.at_tick(self.reads)
        return 0

    def write(self, rows: np.ndarray) -> int:
        return len(rows)


def test_a_signal_ends_the_run_after_a_whole_tick() -> None:
    node = Node()
    with stop_on_signals() as stop:
        report = run_realtime(
            node, Silent(lambda n: os.kill(os.getpid(), signal.SIGTERM) if n == 20 else None), stop=stop
        )
    assert report.ended == "SIGTERM"
    assert node.k == report.ticks == report.begin.count == 19  # one read before the first tick empties the bus
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def test_a_stop_asked_for_later_is_heard() -> None:
    stop = Stop()

    def ask(n: int) -> None:
        stop.asked = "enough" if n > 5 else ""

    assert run_realtime(Node(), Silent(ask), stop=stop, ticks=1000).ticks < 10


class Queue:
    """A bus whose reader is held up once, for ``stall`` s at read ``at``, while frames of ECU_DEMAND go on, one each 10
    reads.
    """

    def __init__(self, at: int, stall: float):
        self.at, self.stall, self.reads, self.counter = at, stall, 0, 0
        self.waiting: list[tuple[int, int]] = []
        self.said: list[tuple[int, int]] = []

    def come(self) -> None:
        self.counter = (self.counter + 1) % 15
        self.waiting.append(
            (int(frames.word0(frames.ECU_DEMAND)), int(frames.encode_demand(70.0, 70.0, 1, self.counter)))
        )

    def read(self, rows: np.ndarray) -> int:
        self.reads += 1
        if self.reads % 10 == 0:
            self.come()
        if self.reads == self.at:
            time.sleep(self.stall)
            for _ in range(round(self.stall * 100)):
                self.come()
            return 0
        n = min(len(rows), len(self.waiting))
        rows[:n] = np.array(self.waiting[:n], np.int64).reshape(-1, 2)
        del self.waiting[:n]
        return n

    def write(self, rows: np.ndarray) -> int:
        self.said += [(row[0] & 0x7FF, row[1]) for row in rows.tolist()]
        return len(rows)


def test_a_pause_drops_the_queue_and_is_a_fault_that_the_bus_sees_and_the_record_repeats() -> None:
    node, bus, kept = Node(), Queue(400, 0.3), []
    report = run_realtime(node, bus, ticks=2500, put=kept.append)
    assert report.pauses >= 1 and report.dropped >= 30 + 5 and report.skipped >= 290
    states = [frames.decode(8 << 32 | i, d)["state"] for i, d in bus.said if i == frames.VGV_STATUS]
    faults = [int(frames.decode(8 << 32 | i, d)["faults"]) for i, d in bus.said if i == frames.VGV_SERVO]
    paused = next(i for i, bits in enumerate(faults) if bits & 1 << 8)
    assert paused <= 41 and faults[paused] & 1 and states[paused] == 4.0
    if report.pauses == 1:  # a busy machine may stop us again
        assert states[paused - 1] == 2.0 and states[-1] == 2.0 and faults[-1] == 0
    all_frames = np.frombuffer(b"".join(kept), FRAME)
    of = {tx: all_frames[all_frames["tx"] == tx] for tx in (0, 1)}
    assert report.received == len(of[0]) - report.pauses
    head = of[0]["ident"] | of[0]["length"].astype(np.int64) << 32 | of[0]["note"].astype(np.int64) << 56
    rows = np.stack([head, np.ascontiguousarray(of[0]["data"][:, :8]).view("<i8")[:, 0]], axis=1)
    again = Node()
    replay(again, (of[0]["ns"] - report.started_ns) // TICK_NS, rows, node.k)
    assert again.fingerprint() == node.fingerprint()


class Forger(Queue):
    """The same, with frames of somebody who knows how notes look among the others, at random moments, of every kind."""

    HEADS = [note & frames.HEAD_MASK | kind for note in (frames.PAUSE, frames.PREPARED, frames.FRESHNESS, frames.SEEDS)
             for kind in (0, frames.FD, frames.REMOTE)]  # fmt: skip
    HEADS += [8 << 32 | frames.ERROR | ident for ident in (0x004, 0x080, 0x0A0, 0x100)] + [8 << 32 | 0x0A0]

    def __init__(self, seed: int):
        super().__init__(300, 0.06)
        self.rng = np.random.default_rng(seed)

    def read(self, rows: np.ndarray) -> int:
        for _ in range(int(self.rng.integers(0, 3))):
            head = self.HEADS[self.rng.integers(len(self.HEADS))]
            data = int(self.rng.choice([0, 1, 55, 5000, -1])) if not head & frames.REMOTE else 0
            self.waiting.insert(int(self.rng.integers(len(self.waiting) + 1)), (head, data))
        return super().read(rows)


def test_a_record_repeats_whatever_frames_others_send_while_it_is_made(tmp_path: Path) -> None:
    node, bus, kept = Node(seed=3), Forger(8), []
    report = run_realtime(node, bus, ticks=700, put=kept.append)
    assert report.pauses >= 1
    sent = np.array([word for _, word in bus.said], np.int64)
    for suffix in (".log", ".blf", ".mf4", ".parquet"):
        recorder = Recorder(tmp_path / f"run{suffix}")
        recorder.put(b"".join(kept))
        recorder.close()
        record = read_record(recorder.path)
        taken = ~record.sent
        received = record.rows[taken]
        assert np.count_nonzero(received[:, 0] & frames.NOTE) == report.pauses
        assert np.count_nonzero(received[:, 0] == frames.PAUSE & frames.HEAD_MASK) > 10
        again = Node(seed=3)
        _, now = replay(again, record.ms[taken] - report.started_ns // TICK_NS, received, node.k)
        assert now[:, 1].tolist() == sent.tolist() and again.fingerprint() == node.fingerprint(), suffix


class StandingClock:
    """A clock that moves when it is told to."""

    now = 10**9

    def monotonic_ns(self) -> int:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> StandingClock:
    made = StandingClock()
    monkeypatch.setattr("hil.loop.realtime.time", made)
    return made


@pytest.mark.parametrize("policy", ["catch-up", "skip"])
@pytest.mark.parametrize(("missed", "paused"), [(1, 0), (49, 0), (50, 50), (51, 51), (5000, 5000)])
def test_fifty_ticks_missed_in_one_wake_up_are_a_pause_fewer_are_none(
    clock: StandingClock, missed: int, paused: int, policy: str
) -> None:
    ticker = Ticker(policy=policy)
    ticker.begin()
    for _ in range(3):
        clock.now = ticker.deadline
        ticker.wait()
    clock.now = ticker.deadline + missed * TICK_NS
    ticker.wait()
    assert (ticker.paused, ticker.pauses) == (paused, int(paused > 0))
    assert ticker.skipped == (missed if paused or policy == "skip" else 0)
    clock.now = max(clock.now + 1000, ticker.deadline)
    ticker.wait()
    assert (ticker.paused, ticker.pauses) == (0, int(paused > 0))


def test_short_stalls_in_a_row_are_no_pause_however_late_the_loop_gets(clock: StandingClock) -> None:
    ticker = Ticker()
    ticker.begin()
    for _ in range(20):
        clock.now += 30 * TICK_NS
        ticker.wait()
    assert ticker.pauses == 0 and ticker.skipped > 0


def test_memory_is_unlocked_and_collection_on_again_afterwards() -> None:
    import gc

    with undisturbed() as notes:
        assert not gc.isenabled()
        assert all("memory is not locked" in n for n in notes)
    assert gc.isenabled()
    locked = next(x for x in Path("/proc/self/status").read_text().splitlines() if x.startswith("VmLck"))
    assert locked.split()[1] == "0"


# ---- the ECU's demand ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", BUILTIN)
def test_builtin_profiles_are_demands_that_the_firmware_takes(name: str) -> None:
    rows = builtin(name).per_frame()
    assert len(rows) > 100 and (rows[:, 0] >= 40).all() and (rows[:, 0] <= 100).all() and np.isnan(rows[:, 1]).all()


def test_a_profile_is_straight_lines_and_the_same_in_both_formats(tmp_path: Path) -> None:
    (tmp_path / "p.toml").write_text("t = [5, 6, 6.01, 8]\nn_dem = [60, 70, 80, 80]\n")
    (tmp_path / "p.csv").write_text("t,n_dem\n5,60\n6,70\n6.01,80\n8,80\n")
    a, b = read_profile(tmp_path / "p.toml").per_frame(), read_profile(tmp_path / "p.csv").per_frame()
    assert np.array_equal(a, b, equal_nan=True)
    assert len(a) == 301
    assert a[[0, 50, 100, 101, 300], 0] == pytest.approx([60, 65, 70, 80, 80])


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("t = [0, 1]\n", "n_dem must be a list of numbers"),
        ("t = [0, 1]\nn_dem = [60]\n", "t has 2 numbers, n_dem 1"),
        ("t = [0, 1, 1]\nn_dem = [60, 61, 62]\n", r"t \(=1 s after 1 s\) must increase"),
        ("t = [0, 1]\nn_dem = [60, 121]\n", r"n_dem \(=121 %\) must be in \[0, 120\]"),
        ("t = [0, nan]\nn_dem = [60, 61]\n", "must be finite"),
        ("t = [0, 1]\nn_dem = [60, 61]\nrate = 3\n", "'rate' is unknown"),
        ("t = [0, 1\n", "not a TOML table"),
    ],
)
def test_a_wrong_profile_is_refused_in_one_line(text: str, says: str, tmp_path: Path) -> None:
    (tmp_path / "p.toml").write_text(text)
    with pytest.raises(InputError, match=says) as e:
        read_profile(tmp_path / "p.toml")
    assert "\n" not in str(e.value)


def test_typed_lines_set_the_demand_and_nonsense_is_refused() -> None:
    typed = Typed()
    for line, n_dem, request in [
        ("70", 70, 1),
        ("+5", 75, 1),
        ("-0.5", 74.5, 1),
        ("standby", 74.5, 0),
        ("", 74.5, 0),
        ("run", 74.5, 1),
    ]:
        typed.line(line)
        assert (typed.n_dem, typed.mode_request, typed.complaint) == (n_dem, request, "")
    for line in ("121", "-200", "nan", "1e9", "up"):
        typed.line(line)
        assert typed.n_dem == 74.5 and typed.complaint
        typed.complaint = ""
    typed.line("quit")
    assert typed.quit


def test_the_demand_begins_with_the_first_good_status_and_silence_ends_it() -> None:
    demand = Demand(np.array([0.0, 10.0]), np.array([60.0, 70.0]))
    ecu, node, watch = EcuStation(demand, timeout=0.1, wait=2.0, ecu=Ecu(n_dem=60.0)), Node(), None
    watch = ecu.watcher(None)
    to_ecu = to_node = np.zeros((0, 2), np.int64)
    met = end = None
    for k in range(3000):
        taken = to_node
        to_node = ecu.tick(to_ecu, len(to_ecu)).copy()
        to_ecu = node.tick(taken, len(taken)).copy() if 300 <= k < 2300 else to_ecu[:0]
        if ecu.met is not None and met is None:
            met = k
        if (why := watch(k)) is not None:
            end = why
            break
    assert met is not None and 300 < met < 330
    assert end == f"timed out: no good VGV_STATUS for 0.10 s at t = {(k - met) / 1000:.2f} s" and 2380 < k < 2402
    assert ecu.ecu.arrays.demand[0] == pytest.approx(60.0 + (k - met) / 1000, abs=0.011)
    assert (
        EcuStation(demand, wait=0.5).watcher(None)(500) == "no good VGV_STATUS within 0.5 s: is a controller running?"
    )


# ---- bad input -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (["run", "--bus", "nosuch"], "'nosuch' is not known"),
        (["run", "--bus", "local", "--duration", "0"], "--duration (=0 s) must be above 0"),
        (["run", "--bus", "local", "--duration", "nan"], "--duration (=nan s) must be above 0"),
        (["run", "--bus", "local", "--realtime-priority", "100"], "--realtime-priority (=100) must be in [1, 99]"),
        (["run", "--bus", "local", "--limit-late-us", "-1"], "--limit-late-us (=-1) must be 0 or more"),
        (["run", "--bus", "local", "--inputs", "x.log"], "--inputs is for --bus lockstep"),
        (["run", "--bus", "local", "--cpu", "999"], "--cpu (=999) must be one of"),
        (["run", "--bus", "local", "--record", "x.csv"], "suffix '.csv' is not one of a recording"),
        (["run", "--bus", "lockstep", "--inputs", "no.log"], "no.log: cannot be read"),
        (["run", "--bus", "lockstep", "--profile", "nosuch"], "--profile 'nosuch' is not known; allowed: idle"),
        (["run", "--bus", "lockstep", "--limit-late-us", "5"], "--limit-late-us is for real time"),
        (["run", "--bus", "lockstep", "--model", "no.toml"], "no.toml"),
        (["ecu", "--bus", "lockstep"], "vaneloop run --bus lockstep --profile F"),
        (["ecu", "--bus", "local", "--log", "no.csv"], "no.csv: cannot be read"),
        (["ecu", "--bus", "local", "--log", "a.csv", "--profile", "idle"], "exclude each other"),
        (["ecu", "--bus", "local", "--timeout", "0"], "--timeout (=0 s) must be above 0"),
        (["inject", "flood_low_priority", "--bus", "local", "--model", "m.toml"], "--model is for --bus lockstep"),
        (["inject", "flood_low_priority", "--bus", "local", "--tables", "d"], "--tables is for --bus lockstep"),
        (["inject", "flood_low_priority", "--bus", "local", "--plant", "p.toml"], "--plant is for --bus lockstep"),
        (["record", "x.log", "--bus", "lockstep"], "--bus lockstep exists within one process"),
        (["record", "x.txt"], "suffix '.txt'"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(args: list[str], says: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(args) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and says in err


def test_ctrl_c_while_a_command_is_still_loading_is_one_word(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(name: str) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("vaneloop.cli.main.importlib.import_module", interrupted)
    assert main(["record", "x.log"]) == 130
    assert capsys.readouterr().err == "stopped\n"


# ---- commands --------------------------------------------------------------------------------------------------------


def priority() -> list[str]:
    """Options that keep a loop on time while other tests want the processors, where this user may use them.

    On a single processor (user-mode Linux) two such loops would keep each other and candump from running; there nobody
    else wants it.
    """
    if os.cpu_count() == 1:
        return ["--spin-us", "0"]
    may = os.geteuid() == 0 or resource.getrlimit(resource.RLIMIT_RTPRIO)[0] >= 20
    return ["--realtime-priority", "20"] if may else []


ON_TIME_US = 20_000.0  # a tick that is later than this may cost a frame its 50 ms


def check_run_and_ecu(bus: str, seconds: float, folder: Path) -> tuple[dict, dict]:
    """Controller and ECU as two processes for ``seconds``; both end well, the record is complete and repeats bit for
    bit.

    Returns the JSON of both.

    A busy machine may keep either process from running for longer than the 50 ms after which the controller degrades,
    or than the kernel keeps frames for a socket (some two seconds): faults and losses are only judged where both were
    on time.
    """
    record, told = folder / "run.mf4", folder / "run.json"
    run = start("run", "--bus", bus, "--record", str(record), "--json", str(told), "--seed", "5", *priority())
    args = ("--profile", "sine", "--duration", str(seconds), "--wait", "600", "--timeout", "60", "--json", "-")
    ecu = start("ecu", "--bus", bus, *args, *priority())
    code, out, err = ended(ecu, seconds + 1200)
    run.send_signal(signal.SIGINT)
    run_code, run_out, run_err = ended(run)
    assert code == 0, err
    heard = json.loads(out)
    assert heard["demand_s"] >= seconds
    assert run_code == 0, run_err
    said = json.loads(told.read_text())
    assert said["ended"] == "SIGINT" and said["frames"]["refused"] == heard["frames"]["refused"] == 0
    late = {name: json_["lateness"]["max_us"] for name, json_ in (("ecu", heard), ("run", said))}
    assert heard["state"] == "RUN" or max(late.values()) > ON_TIME_US, (heard["state"], late)
    sent, good, lost = (
        heard["frames"]["sent"],
        said["counts"]["good"],
        said["frames"]["lost"] + heard["frames"]["lost_by_reader"],
    )
    assert (lost == 0 and good >= 80 * seconds) or max(late.values()) > 20 * ON_TIME_US, (lost, good, late)
    assert 0 < good <= sent and 0 < said["frames"]["received"] <= sent
    assert said["ticks"] >= 1000 * seconds and sum(b["ticks"] for b in said["lateness"]["histogram"]) == said["ticks"]
    for part in ("p50", "p99", "p99.9", "max", "missed ticks", "worst tick", "state hash"):
        assert part in run_out
    held = read_record(record)
    assert (
        len(held.ms) == said["record"]["frames"] == said["frames"]["received"] + said["frames"]["sent"] + said["pauses"]
    )
    n_dem = read_log(record).channels["n_dem"]
    assert n_dem.values.max() > 84.0  # the sine's, after a second and a half
    same = ("--seed", "5", "--duration", str(said["ticks"] / 1000))
    again = ended(start("run", "--bus", "lockstep", "--inputs", str(record), *same, "--json", "-"))
    assert again[0] == 0, again
    repeated = json.loads(again[1])
    assert repeated["same"] and repeated["compared"] == said["frames"]["sent"]
    assert repeated["state_hash"] == said["state_hash"]
    return said, heard


@pytest.mark.slow
def test_controller_and_ecu_as_two_processes_on_the_embedded_bus(own_bus: str, tmp_path: Path) -> None:
    check_run_and_ecu(own_bus, 2.0, tmp_path)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Folder with a real-time run in which things happened (a stall of 3 s, the ECU gone before the end), and what was
    said of it.
    """
    folder = tmp_path_factory.mktemp("recorded")
    bus = f"local:recorded{os.getpid()}"
    told = ("--record", str(folder / "run.log"), "--json", str(folder / "run.json"))
    run = start("run", "--bus", bus, *told, "--live", "--limit-late-us", "1e5", *priority())
    ecu = start("ecu", "--bus", bus, "--profile", "staircase", "--wait", "120", "--timeout", "3", *priority())
    assert run.stderr is not None
    while "RUN" not in (line := run.stderr.readline()):
        assert line
    run.send_signal(signal.SIGSTOP)
    ecu_ended = ended(ecu)  # the ECU gives up while the controller stands still, however long it takes
    run.send_signal(signal.SIGCONT)
    while "FAIL_SAFE" not in (line := run.stderr.readline()):
        assert line
    run.send_signal(signal.SIGTERM)
    (folder / "ended.json").write_text(json.dumps({"ecu": ecu_ended, "run": ended(run)}))
    yield folder


@pytest.mark.slow
def test_a_stalled_controller_times_the_ecu_out_in_one_line(recorded: Path) -> None:
    code, _, err = json.loads((recorded / "ended.json").read_text())["ecu"]
    assert code == 1
    assert err.count("\n") == 1 and "vaneloop ecu: timed out: no good VGV_STATUS for 3.0" in err


@pytest.mark.slow
def test_a_stall_is_reported_and_the_limit_makes_exit_code_1(recorded: Path) -> None:
    code, out, _ = json.loads((recorded / "ended.json").read_text())["run"]
    said = json.loads((recorded / "run.json").read_text())
    assert code == 1 and "exceeded: a tick (" in out and said["exceeded"]
    assert said["lateness"]["max_us"] > 400_000 and said["skipped"] > 300 and said["missed"] >= 1
    assert said["ended"] == "SIGTERM" and said["mode"] == "FAIL_SAFE" and said["faults"] == ["demand_stale"]


def test_a_recorded_run_repeats_in_lockstep_bit_for_bit(recorded: Path) -> None:
    said = json.loads((recorded / "run.json").read_text())
    args = ("run", "--bus", "lockstep", "--inputs", str(recorded / "run.log"), "--duration", str(said["ticks"] / 1000))
    code, out, err = ended(start(*args, "--record", str(recorded / "again.log")))
    assert code == 0, (out, err)
    assert f"all {said['frames']['sent']:,} frames sent are the same, bit for bit, in the same ticks" in out
    assert said["state_hash"] in out
    first, second = (
        [line.split() for line in (recorded / f).read_text().splitlines()] for f in ("run.log", "again.log")
    )
    assert [(t, *rest) for t, _, *rest in first] == [(t, *rest) for t, _, *rest in second]


def test_a_changed_frame_is_found_when_the_run_is_repeated(recorded: Path, tmp_path: Path) -> None:
    lines = (recorded / "run.log").read_text().splitlines(keepends=True)
    k = next(i for i, line in enumerate(lines) if " 0B0#" in line and i > len(lines) // 2)
    lines[k] = lines[k].replace(" 0B0#", " 0B0#FF", 1)[: len(lines[k]) - 5] + " T\n"
    (tmp_path / "changed.log").write_text("".join(lines))
    code, out, _ = ended(start("run", "--bus", "lockstep", "--inputs", str(tmp_path / "changed.log")))
    assert code == 1 and "differs: frame" in out and "VGV_STATUS" in out


def heard(port: Port, what: dict[str, Any], seconds: float, until: Any = None) -> list[tuple[str, float]]:
    """Listen for ``seconds``, or until ``until()``; return states and fault bits as they came, and keep the last ones
    in ``what``.
    """
    rows, out, end = np.zeros((256, 2), np.int64), [], time.monotonic() + seconds
    while time.monotonic() < end and not (until is not None and until()):
        for head, data in rows[: port.read(rows)].tolist():
            for name in ("state", "faults"):
                if name in (values := frames.decode(head, data)):
                    what[name] = values[name]
                    out.append((name, values[name]))
        time.sleep(0.002)
    return out


@pytest.mark.slow
def test_a_controller_stopped_for_five_seconds_says_so_and_takes_no_old_frame(own_bus: str, tmp_path: Path) -> None:
    record, told = tmp_path / "run.mf4", tmp_path / "run.json"
    run = start("run", "--bus", own_bus, "--record", str(record), "--json", str(told), *priority())
    ecu = start(
        "ecu",
        "--bus",
        own_bus,
        "--profile",
        "idle",
        "--duration",
        "600",
        "--wait",
        "120",
        "--timeout",
        "100",
        *priority(),
    )
    bus, now = open_bus(own_bus), {}
    try:
        port = Port(bus)
        running = lambda: now.get("state") == 2.0 and now.get("faults") == 0.0  # noqa: E731
        heard(port, now, 120, running)
        assert running()
        run.send_signal(signal.SIGSTOP)
        heard(port, now, 5.0)
        run.send_signal(signal.SIGCONT)
        said = heard(port, now, 60, lambda: int(now["faults"]) & 1 << 8)
        faults = [int(v) for name, v in said if name == "faults"]
        assert faults[-1] & 1 << 8 and len(faults) <= 3  # at once; a frame from before the stop may come first
        heard(port, now, 1.0, lambda: now["state"] == 4.0)
        assert now["state"] == 4.0
        heard(port, now, 120, running)
        assert running()  # and back by itself
    finally:
        bus.shutdown()
    for process in (ecu, run):
        process.send_signal(signal.SIGINT)
    ended(ecu)
    code, _, err = ended(run)
    assert code == 0, err
    said_json = json.loads(told.read_text())
    assert said_json["pauses"] >= 1 and said_json["dropped"] >= 300 and said_json["skipped"] >= 4000
    again = ended(
        start(
            "run",
            "--bus",
            "lockstep",
            "--inputs",
            str(record),
            "--duration",
            str(said_json["ticks"] / 1000),
            "--json",
            "-",
        )
    )
    assert again[0] == 0, again
    repeated = json.loads(again[1])
    assert repeated["same"] and repeated["state_hash"] == said_json["state_hash"]


def test_an_ecu_that_stood_still_takes_no_old_frame() -> None:
    vgv, ecu = Node(), Ecu()
    to_vgv = to_ecu = np.zeros((0, 2), np.int64)
    seen = []
    for k in range(750):
        if k == 500:
            to_ecu = np.array([[frames.PAUSE, 5000]], np.int64)
        from_ecu = ecu.tick(to_ecu).copy()
        seen.append(ecu.stale())
        to_ecu = vgv.tick(to_vgv).copy()
        to_vgv = from_ecu
    assert seen[499] == [] and len(seen[500]) == 4
    assert seen[505] == seen[500] and seen[525] == ["VGV_HEALTH"]
    assert seen[600] == ["VGV_HEALTH"] and seen[601] == []  # its second frame after the pause
    sync = ecu.arrays.receiver[:, frames.COUNTS.index("sync")]
    assert sync.tolist() == [2, 2, 2, 2, 0, 0]  # the angles of further stages are not sent


@pytest.mark.slow
def test_a_terminal_that_does_not_control_the_process_is_read_in_lines(own_bus: str) -> None:
    """As under an init, or in a container: the process has a session of its own, and this terminal is not its own."""
    ours, theirs = os.openpty()
    try:
        process = start("ecu", "--bus", own_bus, "--wait", "3", stdin=theirs, start_new_session=True)
        os.write(ours, b"up\n")
        code, _, err = ended(process)
    finally:
        os.close(ours)
        os.close(theirs)
    assert code == 1 and "no good VGV_STATUS within 3 s" in err
    assert "'up' is not known" in err and len(err.splitlines()) == 2


@pytest.mark.slow
def test_a_lost_demand_frame_changes_the_run(recorded: Path, tmp_path: Path) -> None:
    lines = (recorded / "run.log").read_text().splitlines(keepends=True)
    k = [i for i, line in enumerate(lines) if " 0A0#" in line]
    del lines[k[len(k) // 2]]
    (tmp_path / "short.log").write_text("".join(lines))
    code, out, _ = ended(start("run", "--bus", "lockstep", "--inputs", str(tmp_path / "short.log")))
    assert code == 1 and "differs: frame" in out


@pytest.mark.parametrize("suffix", [".log", ".blf", pytest.param(".mf4", marks=pytest.mark.slow), ".parquet"])
def test_a_lockstep_run_is_recorded_and_repeats(suffix: str, tmp_path: Path) -> None:
    file = tmp_path / f"run{suffix}"
    args = ["run", "--bus", "lockstep", "--profile", "slam", "--duration", "4.001", "--seed", "2"]
    assert main([*args, "--record", str(file), "--quiet", "--json", str(tmp_path / "a.json")]) == 0
    assert main([*args, "--quiet", "--json", str(tmp_path / "b.json")]) == 0
    a, b = (json.loads((tmp_path / f"{x}.json").read_text()) for x in "ab")
    assert a["state_hash"] == b["state_hash"] and a["mode"] == "RUN" and a["counts"]["good"] >= 395
    again = ["run", "--bus", "lockstep", "--inputs", str(file), "--duration", "4.001"]
    assert main([*again, "--seed", "2", "--quiet", "--json", str(tmp_path / "c.json")]) == 0
    c = json.loads((tmp_path / "c.json").read_text())
    assert c["same"] and c["compared"] == a["record"]["sent"] and c["state_hash"] == a["state_hash"]
    assert main([*again, "--seed", "3", "--quiet"]) == 1


def test_a_recorded_run_is_a_log_for_replay(tmp_path: Path) -> None:
    file = tmp_path / "run.parquet"
    assert main(["run", "--bus", "lockstep", "--profile", "step", "--record", str(file), "--quiet"]) == 0
    assert main(["replay", str(file), "--quiet", "--json", str(tmp_path / "r.json"), "--tolerance", "vigv=0.2"]) == 0
    signals = {
        s["signal"] for s in json.loads((tmp_path / "r.json").read_text())["signals"] if s["reference"] == "measured"
    }
    assert {"x_dem", "x_lvdt", "i_cmd", "vigv"} <= signals


def test_typed_demand_reaches_the_controller(own_bus: str, tmp_path: Path) -> None:
    run = start("run", "--bus", own_bus, "--json", str(tmp_path / "run.json"), *priority())
    ecu = start(
        "ecu",
        "--bus",
        own_bus,
        "--wait",
        "120",
        "--timeout",
        "5",
        "--json",
        "-",
        "--live",
        *priority(),
        stdin=subprocess.PIPE,
    )
    assert ecu.stdin is not None and ecu.stderr is not None
    follow(run, "Ctrl-C ends")
    ecu.stdin.write("70\nfaster\n+5.5\n")
    ecu.stdin.flush()
    complaints, lines = "", 0
    while lines < 2:  # two seconds of it
        complaints += (line := ecu.stderr.readline())
        assert line, complaints
        lines += "n_dem  75.50" in line and (" RUN " in line or " DEGRADED " in line)
    ecu.stdin.write("quit\n")
    ecu.stdin.flush()
    code, out, err = ended(ecu)
    run.send_signal(signal.SIGINT)
    assert ended(run)[0] == 0
    assert code == 0 and "'faster' is not known" in complaints + err
    assert json.loads(out)["state"] in ("RUN", "DEGRADED")
    assert json.loads((tmp_path / "run.json").read_text())["n_dem"] == pytest.approx(75.5)


@pytest.mark.slow
def test_an_ecu_without_a_controller_gives_up_in_one_line(own_bus: str) -> None:
    code, _, err = ended(start("ecu", "--bus", own_bus, "--profile", "idle", "--wait", "0.3"))
    assert code == 1
    assert err == "vaneloop ecu: no good VGV_STATUS within 0.3 s: is a controller running?\n"


@pytest.mark.slow
def test_priority_that_is_not_allowed_is_one_line(own_bus: str) -> None:
    if os.geteuid() == 0:
        if shutil.which("setpriv") is None:
            pytest.skip("root may always; setpriv (util-linux) to give that up is not installed")
        command = ["setpriv", "--bounding-set", "-sys_nice", "--inh-caps", "-sys_nice", *COMMAND]
    else:
        command = COMMAND
    args = ["run", "--bus", own_bus, "--duration", "1", "--realtime-priority", "50"]
    done = subprocess.run([*command, *args], cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
    if done.returncode == 0:
        pytest.skip("this user may use SCHED_FIFO")
    assert done.returncode == 2
    assert (
        done.stderr
        == "vaneloop: --realtime-priority 50: Operation not permitted; run as root, or allow it with ulimit -r 50\n"
    )
