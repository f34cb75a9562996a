"""Real time: ticks at absolute deadlines, how late each began, and what is done to be late seldom.

A tick's lateness is the time from its deadline to its begin, deadlines being start + k ms, whatever the ticks before
did. The loop sleeps until shortly before the deadline (``clock_nanosleep``, absolute) and spins the rest.

Overrun. A tick that begins after the deadline of the next one has *missed* it. What then:

``catch-up``  (default) every tick is run, late ones back to back, until the loop is on time again: the firmware's clock
              stays with the wall clock, a stall shows as a burst. Beyond 100 ms the rest is skipped, and counted.
``skip``      deadlines that have passed are left out and counted: no bursts, but the firmware's clock falls behind the
              wall clock.

Pause. Where 50 ms or more lie between one tick's due begin and its begin, counted from the tick before (a suspended
process, a stopped machine), the loop *stood still*: all that a receiver could say of frames is as old as a silence. The
ticks missed are skipped under either policy, what came meanwhile and in the next 50 ms is dropped, and the node is told
with its next tick (`hil.bus.frames.PAUSE`), which is recorded with the frames: the firmware has no clock of its own.
Several shorter stalls in a row are no pause: ticks ran in between.

Frames are recorded with the time of the tick in which they were taken or sent: start + k ms, within a tick 1 us apart
in their order. The start is a whole millisecond, so a record says exactly what to give to which tick, and lockstep
repeats the run bit for bit.

Only this module reads a clock to decide when to run; `controller`, `plant` and `hil.loop.node` have none.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import signal
import struct
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from can import CanError

from hil.bus.frames import HEAD_MASK, NOTE, PAUSE

__all__ = [
    "POLICIES", "Lateness", "Report", "Stop", "Ticker", "run_realtime", "stop_on_signals", "undisturbed", "wall_clock",
]  # fmt: skip

TICK_NS = 1_000_000
POLICIES = ("catch-up", "skip")
MOST_BEHIND = 100  # ticks to catch up; beyond, the rest is skipped
PAUSED_NS = (
    50 * TICK_NS
)  # that much without a tick is a pause: a demand would be stale (`hil.bus.frames.MISSED` periods)
# ticks after a pause in which frames are dropped: a broker hands over what it kept only once its reader reads again
DEAF = 50
SPIN_US = 50  # a sleep ends up to 50 us late; the spin hides that
MOST_READ = 64  # frames taken in one tick (a full 500 kbit/s bus carries five); the rest wait for the next
MOST_NOTES = 4  # of the loop and of the node, behind them

_libc = ctypes.CDLL(None, use_errno=True)


class _Timespec(ctypes.Structure):
    _fields_ = [("tv_sec", ctypes.c_long), ("tv_nsec", ctypes.c_long)]


_CLOCK_MONOTONIC, _TIMER_ABSTIME = 1, 1
_PR_SET_TIMERSLACK, _PR_GET_TIMERSLACK = 29, 30
_SCHED_SETATTR = {"x86_64": 314, "aarch64": 274}.get(os.uname().machine)
SLICE_US = 100  # the shortest that Linux gives
_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4


def _steps() -> np.ndarray:
    """Edges of the histogram, ns: 0.1 us up to 1 ms, 10 us up to 100 ms, 1 ms up to 10 s."""
    return np.concatenate(
        [np.arange(0, 10**6, 100), np.arange(10**6, 10**8, 10**4), np.arange(10**8, 10**10, 10**6), [10**10]]
    )


class Lateness:
    """Histogram of times, fine enough for percentiles (0.1 us below 1 ms, 1 % above), and the largest of them.

    count  number of times;  worst_ns, worst_tick  the largest, and the tick to which it belongs
    """

    EDGES = _steps()
    SHOWN = (10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10_000, 100_000)  # us, upper edges of the printed histogram

    def __init__(self) -> None:
        self.bins = np.zeros(len(self.EDGES), np.int64)
        self._bins = memoryview(self.bins)  # type: ignore[arg-type]
        self.worst_ns, self.worst_tick = 0, 0

    def add(self, ns: int, tick: int) -> None:
        """Count one time."""
        if ns < 10**6:
            i = ns // 100
        elif ns < 10**8:
            i = 10_000 + (ns - 10**6) // 10**4
        else:
            i = min(19_900 + (ns - 10**8) // 10**6, 29_800)
        self._bins[i] += 1
        if ns > self.worst_ns:
            self.worst_ns, self.worst_tick = ns, tick

    @property
    def count(self) -> int:
        """Number of times counted."""
        return int(self.bins.sum())

    def quantile(self, q: float) -> float:
        """Return the time (us) that the share ``q`` of all stays below or at; the upper edge of its bin."""
        if q >= 1.0 or not self.count:
            return self.worst_ns * 1e-3
        i = int(np.searchsorted(np.cumsum(self.bins), q * self.count))
        return min(float(self.EDGES[min(i + 1, len(self.EDGES) - 1)]), self.worst_ns) * 1e-3

    def share_over(self, us: float) -> float:
        """Return the share of times above ``us``, to the width of a bin."""
        first = int(np.searchsorted(self.EDGES, us * 1e3))
        return float(self.bins[first:].sum()) / max(self.count, 1)

    def shown(self) -> list[tuple[str, int]]:
        """Return label and count of a few wide bins."""
        out, before, total = [], 0, np.cumsum(self.bins)
        for us in self.SHOWN:
            upto = int(total[int(np.searchsorted(self.EDGES, us * 1000)) - 1])
            out.append((f"< {us} us" if us < 1000 else f"< {us // 1000} ms", upto - before))
            before = upto
        return [*out, (f">= {self.SHOWN[-1] // 1000} ms", int(total[-1]) - before)]

    def figures(self) -> dict[str, float]:
        """Return p50, p99, p99.9 and the largest, us, and the share above 500 us."""
        return {
            "p50_us": self.quantile(0.5),
            "p99_us": self.quantile(0.99),
            "p999_us": self.quantile(0.999),
            "max_us": self.worst_ns * 1e-3,
            "over_500us": self.share_over(500.0),
        }


class Ticker:
    """Deadlines at start + k periods. `wait` sleeps until the next one and says how late it is.

    missed   ticks that began after the deadline of the next one
    skipped  deadlines left out (`policy`)
    paused   whole periods for which the loop stood still before the last tick, 0 if that was less than 50 ms;  pauses
             how often it did
    """

    def __init__(self, period_ns: int = TICK_NS, *, spin_us: float = SPIN_US, policy: str = "catch-up"):
        self.period, self.spin, self.policy = period_ns, int(spin_us * 1000), policy
        self.missed = self.skipped = self.paused = self.pauses = 0
        self._time = _Timespec()
        self._sleep, self._at = _libc.clock_nanosleep, ctypes.byref(self._time)
        self.start = self.deadline = self._last = 0

    def begin(self) -> None:
        """Set the first deadline one period from now."""
        self._last = time.monotonic_ns()
        self.start = self.deadline = self._last + self.period

    def wait(self) -> int:
        """Sleep until the deadline; set the next one. Returns the lateness, ns."""
        clock, deadline = time.monotonic_ns, self.deadline
        early = deadline - self.spin
        now = clock()
        while now < early:
            self._time.tv_sec, self._time.tv_nsec = divmod(early, 1_000_000_000)
            self._sleep(_CLOCK_MONOTONIC, _TIMER_ABSTIME, self._at, None)  # a signal may end it early
            now = clock()
        while now < deadline:
            now = clock()
        late = now - deadline
        self.deadline = deadline + self.period
        still = now - self._last - self.period
        self._last = now
        self.paused = 0
        if late >= self.period:
            self.missed += 1
            behind = late // self.period
            if still >= PAUSED_NS:
                self.paused = still // self.period
                self.pauses += 1
            if self.policy == "skip" or behind > MOST_BEHIND or self.paused:
                self.skipped += behind
                self.deadline += behind * self.period
        return late


class Stop:
    """A request to end, which a signal or another thread sets."""

    def __init__(self) -> None:
        self.asked = ""

    def __bool__(self) -> bool:
        return bool(self.asked)


@contextlib.contextmanager
def stop_on_signals() -> Iterator[Stop]:
    """Turn SIGINT, SIGTERM and SIGHUP into a request to end; a second SIGINT interrupts at once."""
    stop = Stop()
    before: dict[int, Any] = {}

    def ask(number: int, frame: Any) -> None:
        if stop.asked and number == signal.SIGINT:
            raise KeyboardInterrupt
        stop.asked = signal.Signals(number).name

    for name in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        before[name] = signal.signal(name, ask)
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _ask_for_slice(us: int) -> None:
    """Ask the ordinary scheduler for turns of ``us`` (0: as it likes); who wants short turns gets them soon. Before
    Linux 6.12: nothing.
    """
    if _SCHED_SETATTR is not None and os.sched_getscheduler(0) == os.SCHED_OTHER:
        nice = os.getpriority(os.PRIO_PROCESS, 0)
        # struct sched_attr: size, policy, flags, nice, priority, runtime (ns), deadline, period
        _libc.syscall(_SCHED_SETATTR, 0, struct.pack("IIQiIQQQ", 48, os.SCHED_OTHER, 0, nice, 0, us * 1000, 0, 0), 0)


@contextlib.contextmanager
def undisturbed(priority: int | None = None, cpu: int | None = None) -> Iterator[list[str]]:
    """Keep this process from being late: memory locked, no garbage collection, exact timers, short turns; SCHED_FIFO or
    one core if wanted.

    priority  of SCHED_FIFO, 1..99; None = the ordinary scheduler
    cpu       number of the processor to stay on

    Gives notes on what the system did not allow. Raises PermissionError or OSError where ``priority`` or ``cpu`` are
    refused.
    """
    notes: list[str] = []
    affinity, slack, collecting = os.sched_getaffinity(0), _libc.prctl(_PR_GET_TIMERSLACK, 0, 0, 0, 0), gc.isenabled()
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        if cpu is not None:
            os.sched_setaffinity(0, {cpu})
        if priority is not None:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
        _ask_for_slice(SLICE_US)
        _libc.prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)
        # pages are locked once they are used: the libraries reserve far more than that
        if _libc.mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT):
            notes.append(f"memory is not locked ({os.strerror(ctypes.get_errno())}); ulimit -l or root allows it")
        gc.collect()
        gc.freeze()
        gc.disable()
        yield notes
    finally:
        if collecting:
            gc.enable()
        gc.unfreeze()
        _libc.munlockall()
        _libc.prctl(_PR_SET_TIMERSLACK, max(slack, 1), 0, 0, 0)
        os.sched_setscheduler(0, policy, parameters)
        _ask_for_slice(0)
        os.sched_setaffinity(0, affinity)


# ---- a node in real time ---------------------------------------------------------------------------------------------


class Ticking(Protocol):
    """A node: frames since the last tick in, frames to send out (`hil.loop.node`). One with ``heed(rows, n) -> n`` puts
    notes of its own behind the frames of its next tick; they are recorded with them.
    """

    def tick(self, received: np.ndarray, n: int) -> np.ndarray:
        """Run the next tick."""


class Port(Protocol):
    """Frames in and out of a bus without waiting (`hil.bus.port.Port`)."""

    def read(self, rows: np.ndarray) -> int:
        """Take what has come."""

    def write(self, rows: np.ndarray) -> int:
        """Send."""


@dataclass
class Report:
    """How a real-time run went.

    ticks     run;  missed, skipped, pauses as `Ticker` counts them
    dropped   frames that came in a pause or soon after it
    begin     lateness of each tick's begin;  end  from the deadline until its frames were sent;  work  the tick itself
    received, sent  frames
    started_ns      time since 1970 of tick 0
    ended, failed   what asked for the end, empty at the end of the time; what made it impossible to go on
    """

    ticks: int = 0
    missed: int = 0
    skipped: int = 0
    pauses: int = 0
    received: int = 0
    dropped: int = 0
    sent: int = 0
    started_ns: int = 0
    wall_s: float = 0.0
    ended: str = ""
    failed: str = ""
    begin: Lateness = field(default_factory=Lateness)
    end: Lateness = field(default_factory=Lateness)
    work: Lateness = field(default_factory=Lateness)


_pack = struct.Struct("<qqq56x").pack  # hil.logs.record_formats.FRAME of a frame in two words
_TX = 1 << 48


def packed(ns: int, received: np.ndarray, sent: np.ndarray) -> bytes:
    """Return the frames of one tick (int64[n, 2] each) as the recorder takes them: from ``ns`` since 1970 on, 1 us
    apart, in order.
    """
    out = [_pack(ns + 1000 * i, head & (HEAD_MASK | NOTE), data) for i, (head, data) in enumerate(received.tolist())]
    ns += 1000 * len(out)
    out += [_pack(ns + 1000 * i, head | _TX, data) for i, (head, data) in enumerate(sent.tolist())]
    return b"".join(out)


def wall_clock() -> Callable[[], int]:
    """Return a clock of ms since 1970 that nobody sets while it runs."""
    zero = time.time_ns() - time.monotonic_ns()
    return lambda: (zero + time.monotonic_ns()) // TICK_NS


def _drop(read: Callable[[np.ndarray], int], rows: np.ndarray) -> int:
    """Take what has come and forget it; return how much it was."""
    dropped = n = read(rows)
    while n == len(rows) and dropped < 1_000_000:
        n = read(rows)
        dropped += n
    return dropped


def run_realtime(
    node: Ticking,
    port: Port,
    *,
    ticks: int | None = None,
    ticker: Ticker | None = None,
    stop: Stop | None = None,
    put: Callable[[bytes], None] | None = None,
    live: Callable[[Report], None] | None = None,
    watch: Callable[[int], str | None] | None = None,
) -> Report:
    """Run ``node`` on the bus behind ``port``, a tick a millisecond, for ``ticks`` ticks or until ``stop``.

    put    takes recorded frames (`packed`); it must not wait
    live   called every second, after a tick's work; it must not wait
    watch  called with k after each tick's work; a text ends the run and becomes `Report.ended`

    Call it inside `undisturbed`. The frames that the node still has to get are those that came until its last tick.
    """
    ticker = ticker or Ticker()
    stop = Stop() if stop is None else stop  # one that nobody has asked yet is false
    rows = np.zeros((MOST_READ + MOST_NOTES, 2), np.int64)
    room = rows[:MOST_READ]
    report = Report()
    read, write, tick, clock = port.read, port.write, node.tick, time.monotonic_ns
    heed = getattr(node, "heed", None)
    add_begin, add_end, add_work = report.begin.add, report.end.add, report.work.add
    while port.read(room):  # what came while nobody listened is old
        pass
    report.started_ns = (time.time_ns() // TICK_NS + 1) * TICK_NS
    ticker.begin()
    k, started, deaf = 0, ticker.start, 0
    try:
        while not stop and (ticks is None or k < ticks):
            deadline = ticker.deadline
            late = ticker.wait()
            if ticker.paused:
                deaf = k + DEAF
            if k < deaf:
                report.dropped += _drop(read, room)
                rows[0] = PAUSE, ticker.paused
                n = 1 if ticker.paused else 0
            else:
                n = read(room)
            if heed is not None:
                n = heed(rows, n)
            out = tick(rows, n)
            if len(out):
                report.sent += write(out)
            done = clock()
            add_begin(late, k)
            add_end(done - deadline, k)
            add_work(done - deadline - late, k)
            if put is not None and (n or len(out)):
                put(packed(report.started_ns + k * TICK_NS, rows[:n], out))
            report.received += 0 if ticker.paused else n
            if watch is not None and (why := watch(k)):
                report.ended = why
                k += 1
                break
            k += 1
            if live is not None and k % 1000 == 0:
                report.ticks, report.missed, report.skipped, report.pauses = (
                    k,
                    ticker.missed,
                    ticker.skipped,
                    ticker.pauses,
                )
                live(report)
    except CanError as e:
        report.failed = f"the bus failed: {e}"
    finally:
        report.ticks, report.missed, report.skipped, report.pauses = k, ticker.missed, ticker.skipped, ticker.pauses
        report.wall_s = (clock() - started) * 1e-9
        report.ended = report.ended or stop.asked
    return report
