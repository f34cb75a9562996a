"""What each line of the loop's Python promises: demands and their limits, lateness and deadlines on a clock that stands
still, and the numbers that go into a tick and come out of it.
"""

from __future__ import annotations

import gc
import math
import signal
import struct
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from controller import load_calibration
from controller.records import as_inputs
from hil.bus import frames
from hil.bus.frames import PAUSE, R_LAST, R_LAST_TICK
from hil.logs import Channel, Log, write_log
from hil.logs.plausible import LONGEST
from hil.loop import engines, lanes, lockstep, realtime, tick
from hil.loop.ecu import BUILTIN, Demand, EcuStation, Typed, builtin, demand_of_log, read_profile
from hil.loop.heard_lanes import noise_of
from hil.loop.lockstep import Run, Stimulus, columns_of, snapshot_names, to_border
from hil.loop.node import Ecu
from hil.loop.realtime import Lateness, Report, Stop, Ticker, packed, run_realtime, stop_on_signals
from hil.loop.secured import run_secured
from hil.loop.tick import KEPT, new_loop
from plant import Model, build_plant, places
from vaneloop.base.errors import InputError
from vaneloop.base.vanes import VANES

MS = 1_000_000
PLANT, CAL = build_plant(), load_calibration()

# ---- the demand ------------------------------------------------------------------------------------------------------


def test_a_profile_is_straight_lines_and_a_log_is_held() -> None:
    t, n, r = np.array([0.0, 0.02, 0.05]), np.array([60.0, 64.0, 70.0]), np.array([50.0, 52.0, 55.0])
    rows = Demand(t, n, r).per_frame()
    np.testing.assert_allclose(rows, [[60, 50], [62, 51], [64, 52], [66, 53], [68, 54], [70, 55]])
    held = Demand(t, n, r, held=True).per_frame()
    np.testing.assert_allclose(held, [[60, 50], [60, 50], [64, 52], [64, 52], [64, 52], [70, 55]])
    assert Demand(t, n).duration == 0.05 and np.isnan(Demand(t, n).per_frame()[:, 1]).all()
    assert len(Demand(np.array([0.0, 0.0299]), n[:2]).per_frame()) == 3
    # a value that comes a rounding after the raster counts from there
    late = Demand(np.array([0.0, 0.02 + 5e-7]), n[:2], held=True).per_frame()
    assert late[:, 0].tolist() == [60.0, 60.0, 64.0]
    later = Demand(np.array([0.0, 0.0101]), n[:2], held=True).per_frame()
    assert later[:, 0].tolist() == [60.0, 60.0]


CORNERS = {
    "idle": {0: 60, 5: 60, 10: 60},
    "step": {0: 60, 5: 60, 5.01: 80, 15: 80, 15.01: 60, 25: 60},
    "ramp": {0: 60, 2: 60, 12: 80, 22: 100, 27: 100, 37: 80, 47: 60, 50: 60},
    "slam": {0: 45, 3: 45, 3.01: 100, 18: 100, 18.01: 45, 30: 45},
    "staircase": {0: 50, 4.9: 50, 5.0: 60, 10: 70, 24.9: 90, 25: 100, 29.9: 100, 54.9: 50},
    "sine": {0: 80, 2.5: 90, 5: 80, 7.5: 70, 60: 80},
}


@pytest.mark.parametrize("name", BUILTIN)
def test_a_builtin_profile_is_what_its_line_says(name: str) -> None:
    d = builtin(name)
    rows = d.per_frame()[:, 0]
    assert d.t[0] == 0.0 and not d.held and set(CORNERS) == set(BUILTIN)
    for t, n in CORNERS[name].items():
        assert rows[round(t * 100)] == pytest.approx(n, abs=1e-6), t
    seconds = {"staircase": 54.99, "idle": 10, "step": 25, "ramp": 50, "slam": 30, "sine": 60}[name]
    assert d.duration == pytest.approx(seconds)


def test_a_log_gives_its_demand_and_its_speed_where_it_has_one() -> None:
    dem = Channel(np.array([5.0, 5.02, 5.04]), np.array([60.0, 61.0, 62.0]))
    d = demand_of_log(Log("run.csv", {"n_dem": dem}))
    assert d.held and d.n_r is None
    np.testing.assert_allclose(d.t, [0.0, 0.02, 0.04])
    speed = Channel(np.array([5.01, 5.03]), np.array([50.0, 51.0]))
    d = demand_of_log(Log("run.csv", {"n_dem": dem, "n_r": speed}))
    np.testing.assert_allclose(d.t, [0.0, 0.01, 0.02, 0.03], atol=1e-12)  # from where both have begun
    assert d.n_dem.tolist() == [60.0, 61.0, 61.0, 62.0]
    assert d.n_r is not None and d.n_r.tolist() == [50.0, 50.0, 51.0, 51.0]
    d = demand_of_log(Log("run.csv", {"n_dem": dem, "n_r": Channel(np.array([5.03]), np.array([50.0]))}))
    np.testing.assert_allclose(d.t, [0.0, 0.02, 0.04], atol=1e-12)  # one reading holds throughout
    assert d.n_r is not None and d.n_r.tolist() == [50.0] * 3


def profile(folder: Path, text: str) -> Demand:
    (folder / "p.toml").write_text(text)
    return read_profile(folder / "p.toml")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("t = [0, 1]\nn_dem = [-0.001, 1]", r"n_dem \(=-0\.001 %\) must be in \[0, 120\]"),
        ("t = [0, 1]\nn_dem = [1, 120.001]", r"n_dem \(=120\.001 %\) must be in \[0, 120\]"),
        ("t = [0, 1, 1]\nn_dem = [1, 1, 1]", r"t \(=1 s after 1 s\) must increase"),
        ("t = [0, 2, 1]\nn_dem = [1, 1, 1]", r"t \(=1 s after 2 s\) must increase"),
        ("t = [0, inf]\nn_dem = [1, 1]", r"t and n_dem must be finite"),
        ("t = [0, 1]\nn_dem = [1, nan]", r"t and n_dem must be finite"),
        ("t = [0, 1]\nn_dem = [1, true]", r"n_dem must be a list of numbers"),
        ("t = [0, 1]\nn_dem = [1, '2']", r"n_dem must be a list of numbers"),
        ("t = []\nn_dem = []", r"t must be a list of numbers"),
        ("t = 5\nn_dem = [1]", r"t must be a list of numbers"),
        ("t = [0, 1]", r"n_dem must be a list of numbers"),
        ("t = [0, 1]\nn_dem = [1]", r"t has 2 numbers, n_dem 1; they must be as many"),
        ("t = [0]\nn_dem = [1]\nwhat = 2", r"'what' is unknown; allowed: t, n_dem"),
    ],
)
def test_a_profile_that_is_none_is_refused(text: str, says: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=rf"p\.toml: {says}"):
        profile(tmp_path, text)


def test_a_profile_may_reach_both_ends_and_begins_at_zero(tmp_path: Path) -> None:
    d = profile(tmp_path, "t = [3, 4.5]\nn_dem = [0, 120]")
    assert d.t.tolist() == [0.0, 1.5] and d.n_dem.tolist() == [0.0, 120.0]
    d = profile(tmp_path, "t = [-1, 0]\nn_dem = [5.5, 6]")
    assert d.t.tolist() == [0.0, 1.0]
    longest = float(LONGEST)
    assert profile(tmp_path, f"t = [0, {longest}]\nn_dem = [1, 1]").duration == longest
    with pytest.raises(InputError, match=rf"t spans 1\.1e\+06 s; allowed: up to {longest:g} s"):
        profile(tmp_path, f"t = [0, {longest + 1e6}]\nn_dem = [1, 1]")


def test_a_log_as_a_profile_tells_its_notes(tmp_path: Path) -> None:
    t = np.arange(50) * 0.1
    write_log(tmp_path / "d.csv", {"n_dem": Channel(t, 60.0 + t)})
    said: list[list[str]] = []
    d = read_profile(str(tmp_path / "d.csv"), said.append)
    assert len(said) == 1 and not d.held and d.n_r is None
    np.testing.assert_allclose(d.n_dem, 60.0 + t, atol=1e-6)


def test_what_is_typed() -> None:
    d = Typed()
    assert (d.n_dem, d.mode_request, d.quit, d.complaint) == (60.0, 1, False, "")
    for line, n in (
        ("70", 70.0),
        ("+5.5", 75.5),
        (" -0.5 ", 75.0),
        ("", 75.0),
        ("0", 0.0),
        ("120", 120.0),
        ("-120", 0.0),
    ):
        d.line(line)
        assert (d.n_dem, d.complaint) == (n, "")
    for line in ("-0.1", "120.5", "nan"):
        d.complaint = ""
        d.line(line)
        assert d.n_dem == 0.0 and "must be in [0, 120]" in d.complaint, line
    for line, mode in (("standby", 0), ("run", 1), ("S", 0), ("R", 1)):
        d.line(line)
        assert d.mode_request == mode
    d.line("x" * 60)
    assert d.complaint.startswith(f"'{'x' * 40}' is not known: a number sets") and not d.quit
    for word in ("q", "Quit", "exit"):
        d = Typed(61.0)
        d.line(word)
        assert d.quit and d.n_dem == 61.0


class Heard:
    """In place of the ECU's node: what it was asked to send, and when it has heard a good VGV_STATUS."""

    def __init__(self, first: int) -> None:
        self.k, self.first, self.asked = 0, first, list[tuple[int, Any]]()
        self.arrays = SimpleNamespace(receiver=np.full((1, 16), -1, np.int64))

    def set_demand(self, *given: Any, **more: Any) -> None:
        self.asked.append((self.k, (*given, *more.values())))

    def tick(self, received: np.ndarray, n: int) -> np.ndarray:
        if self.k >= self.first:
            self.arrays.receiver[0, R_LAST], self.arrays.receiver[0, R_LAST_TICK] = 3, self.k
        self.k += 1
        return received[:n]


def station(first: int, demand: Any, **more: Any) -> EcuStation:
    return EcuStation(demand, ecu=Heard(first), **more)  # type: ignore[arg-type]


NO = np.zeros((2, 2), np.int64)


def test_the_demands_time_begins_with_the_first_good_status() -> None:
    s = station(14, Demand(np.array([0.0, 0.02]), np.array([60.0, 64.0]), np.array([50.0, 51.0])), mode_request=0)
    for _ in range(60):
        assert len(s.tick(NO, 1)) == 1
    ecu: Any = s.ecu
    assert ecu.asked == [(0, (60.0, 50.0, 0)), (10, (60.0, 50.0, 0)), (20, (60.0, 50.0, 0)), (30, (62.0, 50.5, 0)),
                         (40, (64.0, 51.0, 0)), (50, (64.0, 51.0, 0))]  # fmt: skip
    assert (s.met, s.k, s.t) == (14, 60, pytest.approx(0.046))
    assert station(99, Demand(np.zeros(1), np.ones(1))).t == 0.0


def test_a_typed_demand_is_sent_as_it_stands() -> None:
    typed = Typed(66.0)
    s = station(0, typed)
    assert s.rows[0, 0] == 66.0
    for k in range(21):
        if k == 5:
            typed.line("70"), typed.line("standby")
        s.tick(NO, 0)
    ecu: Any = s.ecu
    assert ecu.asked == [(0, (66.0, 1)), (10, (70.0, 0)), (20, (70.0, 0))]


def test_the_controller_is_waited_for_and_given_up() -> None:
    s = station(10**9, Demand(np.zeros(1), np.ones(1)), timeout=0.03, wait=0.05)
    watch = s.watcher(0.04)
    assert watch(49) is None
    assert watch(50) == "no good VGV_STATUS within 0.05 s: is a controller running?"
    s = station(5, Demand(np.zeros(1), np.ones(1)), timeout=0.03, wait=0.05)
    watch = s.watcher(0.04)
    for _ in range(7):
        s.tick(NO, 0)
    assert (s.met, watch(6)) == (5, None)
    assert watch(35) is None  # last heard in tick 6
    assert watch(36) == "timed out: no good VGV_STATUS for 0.03 s at t = 0.03 s"
    for _ in range(60):
        s.tick(NO, 0)
    assert (watch(44), watch(45)) == (None, "done")  # 40 ms after tick 5
    assert s.watcher(None)(45) is None
    default = station(0, Demand(np.zeros(1), np.ones(1)))
    assert (default.timeout, default.wait, default.mode_request) == (500, 10_000, 1)
    typed = Typed()
    s = station(0, typed)
    s.tick(NO, 0)
    watch = s.watcher(None)
    assert watch(0) is None
    typed.line("quit")
    assert watch(0) == "quit"


# ---- lateness --------------------------------------------------------------------------------------------------------


def test_the_bins_of_lateness_are_its_edges() -> None:
    assert Lateness.EDGES[[0, 1, 10_000, 10_001, 19_900, 19_901, -1]].tolist() == [
        0, 100, 10**6, 10**6 + 10**4, 10**8, 10**8 + 10**6, 10**10
    ]  # fmt: skip
    for ns in (0, 99, 100, 999_999, 10**6, 10**6 + 9999, 10**6 + 10**4, 10**8 - 1, 10**8, 5 * 10**9, 10**10 - 1):
        h = Lateness()
        h.add(ns, 7)
        at = int(np.flatnonzero(h.bins)[0])
        assert h.EDGES[at] <= ns < h.EDGES[at + 1], ns
    h = Lateness()
    for ns in (10**10, 10**11):
        h.add(ns, 1)
    assert h.bins[-1] == 2 and h.count == 2


def test_figures_of_lateness() -> None:
    h = Lateness()
    assert (h.count, h.quantile(0.5), h.share_over(1.0)) == (0, 0.0, 0.0)
    for k in range(1000):
        h.add(50 + 1000 * k, k)  # 0.05 us, 1.05 us, ...
    h.add(30_000_000, 1000)
    h.add(20_000_000, 1001)
    assert (h.worst_ns, h.worst_tick, h.count) == (30_000_000, 1000, 1002)
    assert h.quantile(0.5) == pytest.approx(500.1) and h.quantile(1.0) == h.quantile(2.0) == 30_000.0
    assert h.quantile(0.9995) == 30_000.0  # never above the largest
    assert h.share_over(500.0) == pytest.approx(502 / 1002) and h.share_over(25_000.0) == pytest.approx(1 / 1002)
    assert h.figures() == {
        "p50_us": h.quantile(0.5), "p99_us": h.quantile(0.99), "p999_us": h.quantile(0.999), "max_us": 30_000.0,
        "over_500us": h.share_over(500.0),
    }  # fmt: skip
    assert h.shown() == [
        ("< 10 us", 10), ("< 20 us", 10), ("< 50 us", 30), ("< 100 us", 50), ("< 200 us", 100), ("< 500 us", 300),
        ("< 1 ms", 500), ("< 2 ms", 0), ("< 5 ms", 0), ("< 10 ms", 0), ("< 100 ms", 2), (">= 100 ms", 0),
    ]  # fmt: skip
    h.add(10**8, 5)
    assert h.shown()[-1] == (">= 100 ms", 1)


class Still:
    """A clock that moves only by sleep, which ends ``late``, by reading and by hand, ns."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, late: int = 50_000, reading: int = 0) -> None:
        self.now, self.late, self.reading, self.slept = 10**15, late, reading, list[int]()
        monkeypatch.setattr(realtime.time, "monotonic_ns", self.read)

    def read(self) -> int:
        self.now += self.reading
        return self.now

    def take(self, ticker: Ticker) -> None:
        def sleep(clock: int, flags: int, at: Any, rest: Any) -> int:
            assert (clock, flags, rest) == (1, 1, None)
            until = ticker._time.tv_sec * 10**9 + ticker._time.tv_nsec
            self.slept.append(until)
            self.now = max(self.now, until) + self.late
            return 0

        ticker._sleep = sleep  # type: ignore[assignment]


def ticking(clock: Still, **options: Any) -> Ticker:
    t = Ticker(**options)
    clock.take(t)
    t.begin()
    return t


def test_deadlines_are_a_period_apart_whatever_happened(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Still(monkeypatch, late=0, reading=1000)
    begin = clock.now
    t = ticking(clock)
    assert t.start == t.deadline == begin + 1000 + MS
    late = [t.wait() for _ in range(3)]
    assert clock.slept == [t.start + k * MS - 50_000 for k in range(3)]  # then it spins
    assert late == [0, 0, 0] and t.deadline == t.start + 3 * MS
    assert (t.missed, t.skipped, t.paused, t.pauses) == (0, 0, 0, 0)


@pytest.mark.parametrize(("policy", "stall", "behind"), [("catch-up", 3.5, 2), ("skip", 3.5, 2), ("skip", 1.99, 0)])
def test_a_late_tick_is_counted_from_one_period_on(
    policy: str, stall: float, behind: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = Still(monkeypatch)
    t = ticking(clock, policy=policy)
    t.wait()
    clock.now += int(stall * MS)
    assert t.wait() == int((stall - 1) * MS)
    assert (t.missed, t.skipped, t.paused) == (int(behind > 0), behind if policy == "skip" else 0, 0)
    assert t.deadline - t.start == (2 + t.skipped) * MS
    if policy == "catch-up":
        assert [t.wait() for _ in range(3)] == [int(1.5 * MS), int(0.5 * MS), 0]
        assert t.missed == 2


def test_exactly_one_period_late_is_missed(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Still(monkeypatch)
    t = ticking(clock, policy="skip")
    clock.now = t.deadline + MS
    assert t.wait() == MS and (t.missed, t.skipped) == (1, 1)
    assert t.deadline == t.start + 2 * MS


@pytest.mark.parametrize(("still", "paused"), [(49.999999, 0), (50.0, 50), (50.9, 50), (120.0, 120)])
def test_fifty_periods_without_a_tick_are_a_pause(still: float, paused: int, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Still(monkeypatch)
    t = ticking(clock)
    t.wait()
    clock.now += int((still + 1.0) * MS)
    t.wait()
    assert (t.paused, t.pauses, t.skipped) == (paused, int(paused > 0), paused)
    t.wait()
    assert (t.paused, t.pauses) == (0, int(paused > 0))  # of the last tick only


def test_beyond_a_hundred_ticks_the_rest_is_skipped(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Still(monkeypatch)
    t = ticking(clock)
    for behind, skipped in ((100, 0), (101, 101)):
        clock.now = t.deadline + behind * MS
        t._last = clock.now - MS  # a tick has run just before: no pause
        assert t.wait() == behind * MS
        assert (t.skipped, t.pauses) == (skipped, 0)


# ---- a node in real time ---------------------------------------------------------------------------------------------


def test_frames_are_recorded_a_microsecond_apart() -> None:
    received = np.array([[8 << 32 | 0x100, -5], [1 << 41 | 8 << 32 | 0x101, 6]], np.int64)
    sent = np.array([[8 << 32 | 0x200, 7]], np.int64)
    rows = [struct.unpack("<qqq56x", packed(10**18, received, sent)[80 * i : 80 * i + 80]) for i in range(3)]
    assert rows == [
        (10**18, 8 << 32 | 0x100, -5), (10**18 + 1000, 8 << 32 | 0x101, 6),
        (10**18 + 2000, 8 << 32 | 0x200 | 1 << 48, 7),
    ]  # fmt: skip
    assert packed(5, received[:0], sent[:0]) == b""


class Line:
    """A bus: frames wait in it, what is sent is kept."""

    def __init__(self, *waiting: int) -> None:
        self.waiting, self.sent, self.fail = list(waiting), list[int](), False

    def read(self, rows: np.ndarray) -> int:
        n = min(len(rows), len(self.waiting))
        rows[:n, 0], rows[:n, 1] = 8 << 32 | 0x100, self.waiting[:n]
        del self.waiting[:n]
        return n

    def write(self, rows: np.ndarray) -> int:
        if self.fail:
            from can import CanError

            raise CanError("no bus")
        self.sent += rows[:, 1].tolist()
        return len(rows)


class Echo:
    """A node: keeps what it gets; sends it back in every second tick."""

    def __init__(self, line: Line) -> None:
        self.line, self.got, self.k = line, list[list[tuple[int, int]]](), 0

    def tick(self, received: np.ndarray, n: int) -> np.ndarray:
        self.got.append([(int(a), int(b)) for a, b in received[:n]])
        self.k += 1
        self.line.waiting.append(100 + self.k)
        return received[: n if self.k % 2 == 0 else 0].copy()


def test_each_tick_takes_what_has_come_and_sends_what_the_node_gives(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Still(monkeypatch, reading=100)
    monkeypatch.setattr(realtime.time, "time_ns", lambda: 5 * MS + 3)
    line = Line(*range(200))  # what came while nobody listened is old
    node, put, ticker = Echo(line), list[bytes](), Ticker()
    clock.take(ticker)
    r = run_realtime(node, line, ticks=4, ticker=ticker, put=put.append)
    assert [[b for _, b in got] for got in node.got] == [[], [101], [102], [103]]
    assert line.sent == [101, 103]
    assert (r.ticks, r.received, r.sent, r.dropped, r.missed, r.skipped, r.pauses) == (4, 3, 2, 0, 0, 0, 0)
    assert (r.ended, r.failed, r.started_ns) == ("", "", 6 * MS)
    assert r.begin.count == r.end.count == r.work.count == 4
    assert r.begin.worst_ns <= r.end.worst_ns and r.work.worst_ns == 100
    assert r.wall_s == pytest.approx(3e-3, abs=1e-5)
    assert [struct.unpack_from("<q", p)[0] for p in put] == [7 * MS, 8 * MS, 9 * MS]  # ticks with a frame
    assert [len(p) for p in put] == [160, 80, 160]


def test_after_a_pause_the_node_is_told_and_frames_are_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Still(monkeypatch)
    line = Line()
    node, ticker = Echo(line), Ticker()
    clock.take(ticker)

    def watch(k: int) -> str | None:
        if k == 2:
            clock.now += 81 * MS
            line.waiting += range(1000, 1200)
        return None

    r = run_realtime(node, line, ticks=60, ticker=ticker, watch=watch)
    assert node.got[3] == [(PAUSE, 80)]
    assert all(got == [] for got in node.got[4:53]) and node.got[53] != []  # deaf for 50 ticks
    assert r.pauses == 1 and r.skipped == 80 and r.dropped == 201 + 49
    assert r.received == 2 + 7  # before and after


def test_a_run_ends_as_it_is_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Still(monkeypatch)

    def run(**options: Any) -> Report:
        line, ticker = Line(), Ticker()
        clock.take(ticker)
        return run_realtime(Echo(line), line, ticker=ticker, **options)

    r = run(watch=lambda k: "enough" if k == 6 else None)
    assert (r.ended, r.ticks) == ("enough", 7)
    stop = Stop()
    stop.asked = "SIGTERM"
    r = run(stop=stop)
    assert (r.ended, r.ticks) == ("SIGTERM", 0)
    seen: list[tuple[int, int]] = []
    r = run(ticks=2500, live=lambda report: seen.append((report.ticks, report.missed)))
    assert seen == [(1000, 0), (2000, 0)] and r.ticks == 2500
    line, ticker = Line(5, 5), Ticker()
    clock.take(ticker)
    line.fail = True
    r = run_realtime(Echo(line), line, ticks=10, ticker=ticker)
    assert r.failed == "the bus failed: no bus" and r.ticks == 1


def test_a_node_that_heeds_adds_notes_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Still(monkeypatch)
    line, ticker, put = Line(), Ticker(), list[bytes]()
    clock.take(ticker)
    node = Echo(line)

    def heed(rows: np.ndarray, n: int) -> int:
        rows[n] = 9, 9
        return n + 1

    node.heed = heed  # type: ignore[attr-defined]
    r = run_realtime(node, line, ticks=3, ticker=ticker, put=put.append)
    assert [got[-1] for got in node.got] == [(9, 9)] * 3 and r.received == 5 and len(put) == 3


def test_dropping_takes_all_that_has_come() -> None:
    rows = np.zeros((4, 2), np.int64)
    for n in (0, 3, 4, 5, 8, 9):
        line = Line(*range(n))
        assert realtime._drop(line.read, rows) == n and line.waiting == []
    assert realtime._drop(len, rows) == 1_000_000  # who floods does not hold the loop


def test_signals_ask_for_the_end_and_a_second_ctrl_c_interrupts() -> None:
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = [signal.getsignal(n) for n in numbers]
    with stop_on_signals() as stop:
        assert not stop
        signal.raise_signal(signal.SIGHUP)
        assert stop and stop.asked == "SIGHUP"
        signal.raise_signal(signal.SIGTERM)
        assert stop.asked == "SIGTERM"
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert [signal.getsignal(n) for n in numbers] == before


# ---- in lockstep -----------------------------------------------------------------------------------------------------


def test_a_stimulus_is_a_row_each_ten_milliseconds() -> None:
    s = Stimulus.of([60.0, 61.0], [50.0, 51.0], 20e6, [30.0, 31.0], 0.0)
    assert s.rows.tolist() == [[60, 50, 20e6, 30, 1, 0, 0], [61, 51, 20e6, 31, 1, 0, 0]]
    s = Stimulus.of(70.0)
    assert s.rows.shape == (1, 7) and math.isnan(s.rows[0, 1])
    assert s.rows[0, [0, 2, 3, 4, 5, 6]].tolist() == [70.0, 21e6, 40.0, 1.0, 0.0, 1.0]


def test_columns_are_the_borders() -> None:
    names = columns_of(VANES[:2], motor=True)
    assert names == (
        "t",
        "n_dem",
        "n_r",
        "x_dem",
        "x_lvdt",
        "i_cmd",
        "p_s",
        "t_oil",
        *VANES[:2],
        "state",
        "n_engine",
        "i_motor",
    )
    assert columns_of(VANES[:3])[-1] == "n_engine"
    out = to_border(np.ones((2, len(names))), names)
    assert {k: v[0] for k, v in out.items()} == pytest.approx(
        dict.fromkeys(names, 1.0)
        | {"x_dem": 1e3, "x_lvdt": 1e3, "i_cmd": 1e3, "p_s": 1e-6}
        | dict.fromkeys(VANES[:2], math.degrees(1.0))
    )
    assert all(v.flags["C_CONTIGUOUS"] for v in out.values())


def test_a_run_that_is_no_number_is_refused() -> None:
    columns = {"t": np.array([0.0, 0.01, 0.02]), "x": np.array([1.0, math.inf, math.nan])}
    with pytest.raises(
        InputError, match=r"simulation: x \(=inf\) at t = 0\.010 s must be finite; this machine runs away"
    ):
        Run(columns, 0.03, 0.0, "", 0)
    assert Run({"t": columns["t"]}, 0.03, 0.0, "", 0).t is columns["t"]


def test_the_controller_starts_on_the_nearer_curve() -> None:
    at = 71.3
    extension, retraction = (float(np.interp(at, CAL.table[0], CAL.table[r])) for r in (1, 2))
    assert extension > retraction
    middle = 0.5 * (extension + retraction)
    for demand, starts in (
        (None, (1.0, 1.0)), (extension, (1.0, 1.0)), (middle + 1e-6, (1.0, 1.0)), (middle - 1e-6, (-1.0, 0.0)),
        (retraction, (-1.0, 0.0)), (extension + 1.0, (1.0, 1.0)), (retraction - 1.0, (-1.0, 0.0)),
    ):  # fmt: skip
        assert lockstep._starting_curve(CAL, at, demand) == starts


def test_a_run_is_as_long_as_its_stimulus_or_as_asked() -> None:
    s = Stimulus.of(np.full(3, 62.0))
    run = lockstep.lockstep(s, every=5)
    np.testing.assert_allclose(run.t, np.arange(6) * 5e-3)
    assert run.simulated_s == pytest.approx(0.03) and run.faults == 0 and len(run.state_hash) == 64
    seen: list[Any] = []
    short = lockstep.lockstep(s, duration=0.017, watch=seen.append, progress=seen.append, hashed=False, every=10)
    np.testing.assert_allclose(short.t, [0.0, 0.01])
    assert short.state_hash == "" and [x if isinstance(x, float) else x.shape for x in seen] == [
        (17, len(snapshot_names(PLANT))), 1.0
    ]  # fmt: skip
    with pytest.raises(ValueError, match=r"every \(=7\) must divide 10000"):
        lockstep.lockstep(s, every=7)
    assert run.columns["n_r"][0] == pytest.approx(62.0, abs=1e-6)  # its own engine, at rest on the demand
    given = lockstep.lockstep(Stimulus.of(np.full(3, 62.0), 55.0))
    assert (given.columns["n_r"] == 55.0).all()
    assert given.columns["x_lvdt"][0] < run.columns["x_lvdt"][0] - 0.5  # a lower speed asks for less stroke
    low = Stimulus.of(np.full(3, 62.0), p_s=5e6, t_oil=70.0)
    assert set(lockstep.lockstep(low).columns["p_s"]) == {5.0} and set(lockstep.lockstep(low).columns["t_oil"]) == {
        70.0
    }


def test_noise_follows_its_seed() -> None:
    s = Stimulus.of(np.full(2, 62.0))
    a, b, c, quiet = (lockstep.lockstep(s, seed=seed) for seed in (1, 1, 2, None))
    assert a.state_hash == b.state_hash and len({r.state_hash for r in (a, c, quiet)}) == 3
    zero = lockstep.lockstep(s, seed=0)
    assert zero.state_hash != quiet.state_hash


# ---- one tick's numbers ----------------------------------------------------------------------------------------------


def test_the_mean_stroke_is_the_table_at_the_speed() -> None:
    table = np.array([[50.0, 60.0, 80.0], [0, 0, 0], [0, 0, 0], [0.010, 0.015, 0.035]])
    for n, x in (
        (40.0, 0.010),
        (50.0, 0.010),
        (55.0, 0.0125),
        (60.0, 0.015),
        (70.0, 0.025),
        (80.0, 0.035),
        (90.0, 0.035),
    ):
        assert tick.mean_stroke(table, n) == pytest.approx(x), n
    assert tick.mean_stroke(table, math.nan) == 0.010


def test_the_last_frame_by_a_time_is_found() -> None:
    sent = np.full((KEPT, 4), np.nan)
    for q in (100, 103, 110):
        sent[q % KEPT, 0] = q
    for then, row in ((110, 110), (109, 103), (103, 103), (102, 100), (100, 100), (99, 100), (-50, 100), (500, 110)):
        assert tick._last_by(sent, then, 110) == row % KEPT, then
    for q in range(900, 1001):
        sent[q % KEPT, 0] = q
    assert tick._last_by(sent, 950, 1000) == 950 % KEPT
    assert tick._last_by(sent, 10, 1000) == 900 % KEPT


def loop_of(**effects: dict[str, float]) -> Any:
    plant = build_plant(model=Model(effects=effects)) if effects else PLANT
    return new_loop(plant, CAL, n_engine=60.0, n_r=60.0, t_oil=40.0, noisy=False)


def test_a_new_loop_is_at_rest_at_its_speed() -> None:
    a = loop_of()
    assert a.s[places.X, 0] == pytest.approx(tick.mean_stroke(CAL.table, 60.0)) and a.s[places.N_R, 0] == 60.0
    assert not a.sigma.any() and np.isnan(a.sent).all() and math.isnan(a.lvdt[0]) and a.foreign == ()
    noisy = new_loop(PLANT, CAL, n_engine=70.0, n_r=60.0, t_oil=40.0, noisy=True)
    assert noisy.sigma.tolist() == PLANT.sigma.tolist() and noisy.s[places.N_R, 0] == 70.0
    assert noisy.s[places.X, 0] == pytest.approx(tick.mean_stroke(CAL.table, 60.0))
    assert noisy.p is not PLANT.p and noisy.pots.shape == (0, 2 * len(PLANT.vanes))
    np.testing.assert_array_equal(a.calibration.k, CAL.k)
    np.testing.assert_array_equal(a.calibration.table, CAL.table)


def test_effects_on_the_calibration_are_flashed() -> None:
    a = loop_of(
        schedule_error={"offset": 0.5}, controller_gain_error={"factor": 1.2}, trend_threshold_error={"factor": 1.5}
    )
    was, now = CAL.scalars, a.calibration.scalars
    for name in ("kp", "ki", "kff"):
        assert getattr(now, name) == pytest.approx(1.2 * getattr(was, name)), name
    for name in ("trend_rate_on", "trend_change"):
        assert getattr(now, name) == pytest.approx(1.5 * getattr(was, name)), name
    np.testing.assert_allclose(a.calibration.table[1:], CAL.table[1:] + 0.5e-3)
    np.testing.assert_array_equal(a.calibration.table[0], CAL.table[0])
    np.testing.assert_array_equal(a.built.table, CAL.table)  # as the tables have it
    np.testing.assert_allclose(a.flash, [0.5e-3, 1.5, 1.2])


# ---- many loops ------------------------------------------------------------------------------------------------------


def test_what_is_one_for_all_or_one_for_each() -> None:
    one = Stimulus.of(60.0)
    assert lanes.for_each(one, Stimulus, 3, "stimulus") == [one] * 3
    assert lanes.for_each((one, one), Stimulus, 2, "stimulus") == [one, one]
    with pytest.raises(ValueError, match=r"stimulus \(=1 of them\) must be one, or one for each of the 2 plants"):
        lanes.for_each([one], Stimulus, 2, "stimulus")


def test_a_block_begins_with_a_line_of_the_cache() -> None:
    kinds = [np.dtype([("a", np.float64, (n,))]) for n in (1, 3, 17)]
    for kind in kinds:
        block = lanes.aligned(kind)
        assert block.ctypes.data % 64 == 0 and block.shape == (1,) and not block["a"].any()


def test_lanes_refuse_what_does_not_go_together() -> None:
    with pytest.raises(ValueError, match=r"every \(=7\) must divide 10000"):
        lanes.lockstep_lanes(Stimulus.of(60.0), [PLANT], every=7)
    pair = [Stimulus.of(np.full(n, 60.0)) for n in (2, 3)]
    with pytest.raises(ValueError, match=r"stimuli \(=\[2, 3\] rows\) must be equally long"):
        lanes.lockstep_lanes(pair, [PLANT, PLANT])
    assert lanes.lockstep_lanes([], []) == []


def test_a_loop_in_lanes_starts_as_lockstep_does() -> None:
    loop = lanes._at_start(PLANT, CAL, Stimulus.of([61.0], [55.0], t_oil=50.0), True)
    assert (loop.state.direction, loop.state.blend) == (1.0, 1.0) and loop.sigma.any()
    assert loop.s[places.N_R, 0] == 61.0 and loop.s[places.X, 0] == pytest.approx(tick.mean_stroke(CAL.table, 55.0))
    loop = lanes._at_start(PLANT, CAL, Stimulus.of([61.0]), False)
    assert loop.s[places.X, 0] == pytest.approx(tick.mean_stroke(CAL.table, 61.0)) and not loop.sigma.any()


def test_frames_that_come_late_or_are_held_are_those_of_before() -> None:
    """can_delay of 25 ms: the newest content that is as old; frame_hold of 50 ms: the content of the last multiple."""

    def arrive(k: int, a: Any, n: float) -> float:
        tick.arrive(k, a, n, n - 1.0, 1.0)
        return float(as_inputs(a.inputs).n_dem)

    for effects, expected in (
        ({}, [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11]),
        ({"can_delay": {"delay": 0.03}}, [0, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8]),
        ({"frame_hold": {"period": 0.05}}, [0, 0, 0, 0, 0, 5, 5, 5, 5, 5, 10, 10]),
    ):
        a = loop_of(**effects)
        assert [arrive(10 * i, a, float(i)) for i in range(12)] == expected, effects


# ---- what a run asks of the system -----------------------------------------------------------------------------------


class System:
    """Stands in for what a process asks of Linux, and notes it."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, locks: int = 0, slack: int = 50_000):
        self.asked: list[tuple[Any, ...]] = []

        def note(name: str, answer: Any = 0) -> Any:
            return lambda *given: self.asked.append((name, *given)) or answer

        self.policy = realtime.os.SCHED_OTHER
        libc = SimpleNamespace(
            prctl=note("prctl", slack), mlockall=note("mlockall", locks), munlockall=note("munlockall"),
            syscall=lambda number, pid, attr, flags: self.asked.append(("slice", struct.unpack("IIQiIQQQ", attr))),
        )  # fmt: skip
        monkeypatch.setattr(realtime, "_libc", libc)
        monkeypatch.setattr(realtime, "_SCHED_SETATTR", 314)
        monkeypatch.setattr(realtime.ctypes, "get_errno", lambda: 1)
        for name, answer in (
            ("sched_getaffinity", {0, 1}), ("sched_getparam", "parameters"), ("getpriority", 5),
            ("sched_setaffinity", None), ("sched_setscheduler", None),
        ):  # fmt: skip
            monkeypatch.setattr(realtime.os, name, note(name, answer))
        monkeypatch.setattr(realtime.os, "sched_getscheduler", lambda pid: self.policy)

    def of(self, name: str) -> list[tuple[Any, ...]]:
        return [given[1:] for given in self.asked if given[0] == name]


def test_what_a_run_asks_of_the_system_is_given_back(monkeypatch: pytest.MonkeyPatch) -> None:
    system = System(monkeypatch)
    with realtime.undisturbed(priority=40, cpu=1) as notes:
        assert notes == [] and system.of("mlockall") == [(1 | 2 | 4,)]  # now, later, and only once it is used
        assert system.of("prctl") == [(30, 0, 0, 0, 0), (29, 1, 0, 0, 0)]  # timers as exact as they can be
        assert system.of("sched_setaffinity") == [(0, {1})]
        ((pid, policy, parameters),) = system.of("sched_setscheduler")
        assert (pid, policy, parameters.sched_priority) == (0, realtime.os.SCHED_FIFO, 40)
        assert system.of("slice") == [((48, realtime.os.SCHED_OTHER, 0, 5, 0, 100_000, 0, 0),)]  # 0.1 ms
        system.asked.clear()
    assert system.asked == [
        ("munlockall",), ("prctl", 29, 50_000, 0, 0, 0),
        ("sched_setscheduler", 0, realtime.os.SCHED_OTHER, "parameters"),
        ("getpriority", realtime.os.PRIO_PROCESS, 0), ("slice", (48, realtime.os.SCHED_OTHER, 0, 5, 0, 0, 0, 0)),
        ("sched_setaffinity", 0, {0, 1}),
    ]  # fmt: skip


def test_what_the_system_does_not_give_is_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    system = System(monkeypatch, locks=-1, slack=0)
    gc.disable()
    try:
        with realtime.undisturbed() as notes:
            assert notes == ["memory is not locked (Operation not permitted); ulimit -l or root allows it"]
            assert system.of("sched_setaffinity") == system.of("sched_setscheduler") == []
        assert not gc.isenabled()  # it was off before
    finally:
        gc.enable()
    assert system.of("prctl")[-1] == (29, 1, 0, 0, 0) and len(system.of("slice")) == 2
    system.asked.clear()
    system.policy = realtime.os.SCHED_FIFO  # which has no turns
    realtime._ask_for_slice(100)
    monkeypatch.setattr(realtime, "_SCHED_SETATTR", None)
    system.policy = realtime.os.SCHED_OTHER
    realtime._ask_for_slice(100)
    assert system.of("slice") == []


def test_the_scheduler_is_asked_by_linux_s_own_number_of_the_call() -> None:
    """sched_setattr(2) of the tables of system calls of x86-64 and of ARM's 64 bits."""
    machine = realtime.os.uname().machine
    assert {"x86_64": 314, "aarch64": 274}.get(machine) == realtime._SCHED_SETATTR


# ---- engines on a GPU, which stands still here -----------------------------------------------------------------------


class OnDevice(np.ndarray):
    """An array that is its own copy on the GPU."""

    def copy_to_host(self) -> np.ndarray:
        return np.array(self)


class Kernel:
    """Notes how it is called; each call puts what it has counted where the figures are."""

    name = "stand-in"
    cuda = SimpleNamespace(to_device=lambda a: np.ascontiguousarray(a).copy().view(OnDevice))

    def __init__(self) -> None:
        self.calls: list[Any] = []

    def __call__(self, k0: int, ticks: int, noise: Any, machines: Any, hears: Any, notes: Any) -> None:
        n = machines.s.shape[1]
        self.calls.append((n, k0, ticks, notes.every, notes.last, noise.shape))
        self.machines, self.hears, self.notes, self.noise = machines, hears, notes, noise
        found = notes.found
        found[:] = np.arange(len(found))[:, None] + 0.25 * np.arange(n)
        found[engines.gpu.LAST_MODE], found[engines.gpu.LOST] = 2.0, np.arange(n) % 2

    def room(self, each: int, share: float, most: int) -> int:
        assert each == 8 * (engines.gpu.NUMBERS + 2 + len(PLANT.vanes)) and share == 0.8 and most == 1 << 17
        return 2


def test_engines_go_to_the_gpu_in_groups_that_can_stand_side_by_side(monkeypatch: pytest.MonkeyPatch) -> None:
    motor = build_plant()
    motor.p[engines.KIND, 0] = 1.0
    plants = [PLANT, build_plant(), motor, PLANT, PLANT]
    cals = [CAL, CAL, CAL, load_calibration(strategy="inverse"), CAL]
    work = engines._Work([Stimulus.of(60.0)] * 5, plants, cals, None, 10, 30)
    groups = [some.tolist() for some in work.for_gpu(Kernel(), None)]  # type: ignore[arg-type]
    assert sorted(i for of in groups for i in of) == [0, 1, 4] and max(map(len, groups)) <= 2
    assert [some.tolist() for some in work.for_gpu(Kernel(), 1)] == [[i] for of in groups for i in of]  # type: ignore[arg-type]
    assert not work.out.ran.any() and work.out.simulated_s == pytest.approx(0.03)
    assert np.isnan(work.out.angle_error).all() and work.out.angle_error.shape == (5, len(PLANT.vanes))


@pytest.mark.parametrize("seed", [None, 7])
def test_engines_on_a_gpu_begin_at_rest_and_their_figures_come_back_in_the_border_s_units(seed: int | None) -> None:
    kernel: Any = Kernel()
    loud = flashed_plant()
    plants, cals = [PLANT, PLANT, loud], [CAL, CAL, CAL]
    stimuli = [Stimulus.of(np.full(1500, 60.0)), Stimulus.of(np.full(1500, 80.0)), Stimulus.of(np.full(1500, 60.0))]
    work = engines._Work(stimuli, plants, cals, seed, 20, 15_000)
    engines._on_gpu(kernel, work, np.arange(3))
    warm = lockstep.WARM_UP
    stages = len(PLANT.vanes)
    assert kernel.calls == [
        (3, -warm, warm, 20, 14_980, (1, 2 + stages)), (3, 0, 10_000, 20, 14_980, (10_000 if seed else 1, 2 + stages)),
        (3, 10_000, 5000, 20, 14_980, (5000 if seed else 1, 2 + stages)),
    ]  # fmt: skip
    if seed is not None:
        again = np.random.Generator(np.random.PCG64(seed))
        again.standard_normal((10_000, 2 + stages))
        np.testing.assert_array_equal(kernel.noise, again.standard_normal((5000, 2 + stages)))
    sigma, own, scalars, tables, angles, s, p, z = kernel.machines
    (rows, which), schedule, found = kernel.hears, kernel.notes.targets, kernel.notes.found
    assert which.tolist() == [0, 1, 2] and own.tolist() == [0, 0, 1] and rows.shape == (3, 1500, rows.shape[2])
    assert sigma.any() == (seed is not None) and sigma.shape == (2 + stages, 3) and len(tables) == len(angles) == 2
    np.testing.assert_array_equal(p[:, 0], PLANT.p[: engines.gpu.P_ROWS, 0])
    for j, n in enumerate((60.0, 80.0, 60.0)):
        table = tables[own[j]]
        assert s[places.X, j] == pytest.approx(tick.mean_stroke(table, n)) and s[places.N_R, j] == n
    assert schedule.shape == (1 + stages, schedule.shape[1]) and z.shape == (engines.gpu.Z_ROWS, 3)
    out, gpu = work.out, engines.gpu
    each = 0.25 * np.arange(3)
    np.testing.assert_allclose(out.servo_error, 1e3 * (gpu.SERVO + each))
    np.testing.assert_allclose(out.stroke, 1e3 * (gpu.LAST_STROKE + each))
    np.testing.assert_allclose(out.angles[:, 1], np.degrees(gpu.ANGLE_LAST + 1 + each))
    np.testing.assert_allclose(out.angle_error[:, 0], np.degrees(gpu.ANGLE_ERROR + each))
    np.testing.assert_allclose(out.in_mode[:, 0], (gpu.SAMPLES + each) * 0.02)
    assert out.mode.tolist() == [2, 2, 2] and out.finite.tolist() == [True, False, True] and out.ran.all()
    assert out.devices == ["stand-in"] and out.on.tolist() == [0, 0, 0]
    assert found.shape == (gpu.FOUND, 3) and not isinstance(scalars, gpu.Scalars)
    alone: Any = Kernel()
    one, _, _ = engines.put_on_gpu(alone, [PLANT, PLANT], [CAL, CAL], stimuli[:2], seed, 10, 20)
    assert isinstance(one.scalars, gpu.Scalars) and one.scalars.kp == CAL.scalars.kp  # one calibration is no array


def flashed_plant() -> Any:
    return Model(effects={"controller_gain_error": {"factor": 1.2}}).plant(PLANT)


def test_a_gpu_is_asked_first_and_the_processor_runs_what_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[int] = []
    ran: list[list[int]] = []

    def finished(kernel: Any, work: Any, some: Any) -> None:
        ran.append(some.tolist())
        work.ran_on("gpu" if kernel else "cpu", some)

    monkeypatch.setattr(engines, "_on_gpu", finished)
    monkeypatch.setattr(engines, "_on_processor", lambda work, some: finished(None, work, some))
    monkeypatch.setattr(engines.gpu, "kernel", Kernel)
    monkeypatch.setattr(engines, "threads", lambda: 1)
    monkeypatch.setattr(engines, "AT_ONCE", 2)
    plants = [PLANT] * 3
    out = engines.lockstep_engines(Stimulus.of(60.0), plants, device="auto", at_once=2, progress=done.append)
    assert ran == [[0, 1], [2]] and done == [2, 3] and out.devices == ["gpu"] and out.wall_s > 0.0
    ran.clear(), done.clear()
    cals = [load_calibration(strategy="inverse"), CAL, load_calibration(strategy="inverse")]
    out = engines.lockstep_engines(Stimulus.of(60.0), plants, calibrations=cals, progress=done.append)
    assert ran == [[1], [0, 2]] and done == [1, 3] and out.on.tolist() == [1, 0, 1]
    ran.clear(), done.clear()
    out = engines.lockstep_engines(Stimulus.of(60.0), plants, device="cpu", progress=done.append)
    assert ran == [[0, 1], [2]] and done == [2, 3] and out.devices == ["cpu"]
    engines.lockstep_engines(Stimulus.of(60.0), plants, device="cpu")


# ---- where a run begins ----------------------------------------------------------------------------------------------


def test_a_controller_that_is_heard_in_the_first_tick_is_met_then() -> None:
    s = station(0, Demand(np.array([0.0, 0.02]), np.array([60.0, 64.0])))
    s.tick(NO, 0)
    assert s.met == 0 and s.t == pytest.approx(1e-3)


def test_play_begins_where_the_machine_s_was() -> None:
    stimulus = Stimulus.of(np.full(3, 60.0))
    plain = lockstep.lockstep(stimulus)
    start = np.radians([plain.columns[v][0] for v in VANES[: len(PLANT.vanes)]])
    moved = [lockstep.lockstep(stimulus, angles=tuple(start + side * 1e-3)) for side in (-1.0, 1.0)]
    first = [[run.columns[v][0] for v in VANES[: len(PLANT.vanes)]] for run in moved]
    assert np.all(np.array(first[1]) >= np.array(first[0])) and first[0] != first[1]


def test_a_run_begins_at_its_first_row(monkeypatch: pytest.MonkeyPatch) -> None:
    stimulus = Stimulus.of(np.array([61.0, 75.0]), np.array([55.0, 70.0]))
    stimulus.rows[:, lockstep.S_T_OIL] = 50.0, 80.0
    asked: list[dict[str, Any]] = []

    class Done(Exception):
        pass

    def begun(plant: Any, calibration: Any, **given: Any) -> Any:
        asked.append(given)
        raise Done

    monkeypatch.setattr(lockstep, "new_loop", begun)
    for seed, n_r in ((3, 55.0), (None, np.nan)):
        stimulus.rows[0, lockstep.S_N_R] = n_r
        with pytest.raises(Done):
            lockstep.lockstep(stimulus, seed=seed)
    assert asked[0] == {"n_engine": 61.0, "n_r": 55.0, "t_oil": 50.0, "noisy": True, "pots": None}
    assert (asked[1]["n_r"], asked[1]["noisy"]) == (61.0, False)  # without a speed it turns as demanded


def test_the_loop_is_compiled_once_and_the_user_told_before(monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    ran: list[int] = []
    monkeypatch.setattr(lockstep, "lockstep", lambda stimulus: ran.append(len(stimulus.rows)))
    monkeypatch.setattr(lockstep, "is_cached", lambda function: True)
    lockstep.warm_up(said.append)
    assert said == [] and ran == []
    monkeypatch.setattr(lockstep, "is_cached", lambda function: False)
    lockstep.warm_up(said.append)
    assert ran == [10] and said[0].startswith("compiling the simulator for this machine (once") and len(said) == 2
    assert said[1] == "compiled in 0 s"


def test_each_loop_in_lanes_has_its_share_of_the_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter([5.0, 11.0, 20.0, 26.0])
    monkeypatch.setattr(lanes.time, "perf_counter", lambda: next(clock))
    monkeypatch.setattr(lanes, "Lanes", lambda loops, stimuli, way, every: len(loops))
    monkeypatch.setattr(lanes, "_run", lambda n, ticks, seed: [Run({}, ticks * 1e-3, 0.0, "", 4) for _ in range(n)])
    monkeypatch.setattr(lanes, "on_all_cores", lambda run, parts: [run(part) for part in parts])
    (one,) = lanes.lockstep_lanes(Stimulus.of(np.full(3, 60.0)), [PLANT])
    assert (one.wall_s, one.simulated_s, one.faults) == (6.0, 0.03, 4)
    assert [r.wall_s for r in lanes.lockstep_lanes(Stimulus.of(np.full(3, 60.0)), [PLANT] * 3)] == [2.0] * 3


@pytest.mark.parametrize(("ticks", "words"), [(30, 3), (31, 4), (1, 1)])
def test_noise_of_a_bus_is_a_row_a_tick_and_a_number_a_frame(ticks: int, words: int) -> None:
    sensors, speed = noise_of(7, ticks, 3)
    assert sensors.shape == (ticks, 5) and speed.shape == (words,)
    np.testing.assert_array_equal(sensors, np.random.Generator(np.random.PCG64(7)).standard_normal((ticks, 5)))
    np.testing.assert_array_equal(speed, np.random.Generator(np.random.PCG64(8)).standard_normal(words))


def test_figures_of_engines_on_the_processor_are_those_of_their_logs(monkeypatch: pytest.MonkeyPatch) -> None:
    n = 4
    vanes = PLANT.vanes

    def run_of(k: int) -> Run:
        columns = {
            "n_r": np.full(n, 70.0), "x_dem": np.array([1.0, 2.0, 3.0, 4.0]),
            "x_lvdt": np.array([1.0, 2.5, 2.9, 4.2 + k]), "state": np.array([0.0, 1.0, 1.0, 2.0]),
            **{v: np.degrees(PLANT.schedules.targets(np.full(n, 70.0))[:, q]) + 0.1 * (q + 1) * np.arange(n)
               for q, v in enumerate(vanes)},
        }  # fmt: skip
        return Run(columns, 0.04, 0.0, "", 8 + k)

    def runs(stimuli: Any, plants: Any, **given: Any) -> list[Run]:
        assert given["every"] == 10 and given["duration"] == pytest.approx(0.04) and given["seed"] == 5
        if any(p is away for p in plants):
            raise InputError("runs away")
        return [run_of(0) for _ in plants]

    away = build_plant()
    monkeypatch.setattr(engines, "lockstep_lanes", runs)
    work = engines._Work([Stimulus.of(60.0)] * 3, [PLANT, away, PLANT], [CAL] * 3, 5, 10, 40)
    engines._on_processor(work, np.arange(3))
    out = work.out
    assert out.finite.tolist() == [True, False, True] and out.ran.all() and out.devices == ["cpu"]
    assert out.servo_error[0] == pytest.approx(0.5) and out.stroke[0] == 4.2 and out.mode[0] == 2 and out.faults[0] == 8
    assert out.angle_error[0, : len(vanes)] == pytest.approx(0.3 * np.arange(1, len(vanes) + 1))
    last = np.degrees(PLANT.schedules.targets(np.full(1, 70.0))[0]) + 0.3 * np.arange(1, len(vanes) + 1)
    assert out.angles[0, : len(vanes)] == pytest.approx(last)
    assert out.in_mode[0, :3] == pytest.approx([0.01, 0.02, 0.01]) and out.servo_error[1] == 0.0


def test_a_secured_run_gives_what_was_taken_and_sent_tick_by_tick() -> None:
    class Silent:
        """A node that sends one frame every third tick, and notes what it hears."""

        def __init__(self, head: int) -> None:
            self.head, self.node, self.k, self.heard, self.asked = head, self, 0, [], []
            self.heads: set[int] = set()

        def set_demand(self, n_dem: float, n_r: float) -> None:
            self.asked.append((n_dem, n_r))

        def tick(self, rows: np.ndarray) -> np.ndarray:
            self.heard.append(len(rows))
            self.heads |= set(rows[:, 0].tolist())
            self.k += 1
            return np.array([[self.head, self.k]] if self.k % 3 == 1 else np.zeros((0, 2)), np.int64).reshape(-1, 2)

    heads = [int(frames.word0(i)) for i in (frames.ECU_DEMAND, frames.VGV_STATUS)]
    ecu, vgv = Silent(heads[0]), Silent(heads[1])
    profile = np.array([[60.0, 50.0], [61.0, 51.0]])
    told: list[float] = []
    got = run_secured(profile, vgv, ecu, start=99, duration=0.03, progress=told.append)  # type: ignore[arg-type]
    assert got.run.simulated_s == pytest.approx(0.03) and told == [0.0] and got.run.frames == 20
    assert ecu.asked == [(60.0, 50.0)] * 10 + [(61.0, 51.0)] * 20
    assert got.sent_at.tolist() == list(range(0, 30, 3)) and got.sent[:, 0].tolist() == [heads[1]] * 10
    assert got.taken_at[0] == 0 and got.taken[0].tolist() == [frames.FRESHNESS, 99]
    assert got.taken_at[1:].tolist() == list(range(1, 30, 3)) and got.taken[1:, 0].tolist() == [heads[0]] * 10
    assert ecu.heard[0] == 1 and vgv.heard[:3] == [1, 1, 0] and got.run.error_frames == 0
    assert (ecu.heads, vgv.heads) == ({frames.FRESHNESS, heads[1]}, {frames.FRESHNESS, heads[0]})  # each the other
    other = Silent(heads[1])
    longer = run_secured(profile, other, Silent(heads[0]), start=99, duration=0.6)  # type: ignore[arg-type]
    assert longer.run.simulated_s == pytest.approx(0.6) and other.k == 600


def test_an_ecu_begins_at_its_demand_and_hears_so_many_frames_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    first = EcuStation(Demand(np.array([0.0, 1.0]), np.array([61.0, 75.0])))
    again = EcuStation(Demand(np.array([0.0, 1.0]), np.array([61.0, 90.0])), ecu=Ecu(n_dem=61.0))
    states = [np.concatenate([np.ravel(a) for a in e.arrays]) for e in (first.ecu, again.ecu, Ecu(n_dem=75.0))]
    assert np.array_equal(*states[:2], equal_nan=True) and not np.array_equal(*states[::2], equal_nan=True)
    rooms: list[int] = []

    class Empty:
        def read(self, rows: np.ndarray) -> int:
            rooms.append(len(rows))
            return 0

        def write(self, rows: np.ndarray) -> None:
            pass

    clock = Still(monkeypatch)
    ticker = Ticker()
    assert (ticker.start, ticker.deadline) == (0, 0)
    clock.take(ticker)
    wide: list[int] = []

    class Wide:
        k = 0

        def tick(self, received: np.ndarray, n: int) -> np.ndarray:
            wide.append(len(received))
            return received[:0]

    report = run_realtime(Wide(), Empty(), ticks=2, ticker=ticker)  # type: ignore[arg-type]
    assert set(rooms) == {64} and set(wide) == {64 + 4}  # and the notes of the loop and of the node
    # of each tick: late by the sleep's 50 us beside what spins, its work, and both from the deadline on
    assert report.end.count == report.work.count == report.begin.count == 2
    assert report.end.worst_ns == report.begin.worst_ns + report.work.worst_ns < MS


def test_a_wall_clock_is_that_of_the_beginning(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(realtime.time, "time_ns", lambda: 1_700_000_000_000 * MS)
    now = iter([500 * MS, 512 * MS])
    monkeypatch.setattr(realtime.time, "monotonic_ns", lambda: next(now))
    assert realtime.wall_clock()() == 1_700_000_000_012


def test_a_run_tells_how_long_it_took(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter([1000.0, 1002.5])
    monkeypatch.setattr(lockstep.time, "perf_counter", lambda: next(clock))
    assert lockstep.lockstep(Stimulus.of(np.full(2, 60.0)), hashed=False).wall_s == 2.5
    assert engines.Engines(*[np.zeros(0)] * 10, [], 1.0).wall_s == 0.0
