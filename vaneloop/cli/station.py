"""What the commands that join a bus share: their options, the live line, the compiled code, the record."""

from __future__ import annotations

import argparse
import contextlib
import os
import queue
import sys
import threading
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from hil.bus.port import open_bus
from hil.bus.secoc import Authenticator, read_key
from hil.logs.formats import OURS, spoken
from hil.logs.recorder import RecorderProcess
from hil.loop import realtime
from hil.loop.node import Ecu, Node, node_tick
from hil.loop.secured import DEMANDED, FROM_CONTROLLER, Secured
from vaneloop.base import terminal
from vaneloop.base.compiled import is_cached
from vaneloop.base.errors import InputError

__all__ = [
    "ACCEPTED", "A_RECORDING", "BUS_HELP", "BusWatch", "Live", "add_realtime_options", "add_secoc_option",
    "authentication_json", "authentication_words", "authenticator", "bus_name", "check_realtime_options",
    "check_seconds", "joined", "print_lateness", "realtime_json", "recording", "say_authentication",
    "undisturbed", "warm_nodes",
]  # fmt: skip

# both nodes' acceptance filter: 0x0A0 to 0x0BF, so that a flood of other identifiers costs a tick nothing
ACCEPTED = [{"can_id": 0x0A0, "can_mask": 0x7E0}]

A_RECORDING = spoken(f for f in OURS if f.recorder)
BUS_HELP = "vcan0, can0, ... (SocketCAN), or local[:NAME] (embedded bus between processes; needs no CAN in the kernel)"


def add_realtime_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options of a loop in real time."""
    group = parser.add_argument_group("real time (docs/real_time.md)")
    group.add_argument(
        "--realtime-priority",
        metavar="P",
        type=int,
        help="SCHED_FIFO with priority 1..99 (root or ulimit -r): no other program delays it",
    )
    group.add_argument("--cpu", metavar="N", type=int, help="stay on processor N")
    group.add_argument(
        "--policy",
        choices=("catch-up", "skip"),
        default="catch-up",
        help="late ticks are caught up (default), or skipped and counted",
    )
    group.add_argument(
        "--spin-us", metavar="N", type=float, default=50.0, help="us before a deadline not slept but spun (default 50)"
    )


def add_secoc_option(parser: argparse.ArgumentParser) -> None:
    """Declare the option that turns authentication on."""
    parser.add_argument(
        "--secoc",
        metavar="KEY",
        help="authenticate frames (SecOC, docs/bus.md) with the key in the file KEY (mode 600), or env: that in "
        "VANELOOP_SECOC_KEY (default: off)",
    )


def authenticator(args: argparse.Namespace) -> Any:
    """Return what makes and checks MACs under the key of ``--secoc``; None without it."""
    if args.secoc is None:
        return None
    return Authenticator(read_key(args.secoc))


def secured(node: Any, authenticator: Any, *, ecu: bool = False, clock: Callable[[], int] | None = None) -> Any:
    """The controller's node, or the ECU's, with authentication where that is on; ``clock`` as `hil.loop.secured` has
    it.
    """
    if authenticator is None:
        return node
    return Secured(node, authenticator, FROM_CONTROLLER if ecu else DEMANDED, clock)


def authentication_words(args: argparse.Namespace) -> str:
    """Whether authentication is on, for the line at the start."""
    return f"authentication {'off' if args.secoc is None else 'on (SecOC)'}"


def authentication_json(args: argparse.Namespace, node: Any) -> dict[str, int] | None:
    """Return what a secured node has counted; None where authentication is off."""
    return None if args.secoc is None else node.authentication


def say_authentication(args: argparse.Namespace, node: Any, unauthentic: int) -> None:
    """Say what a secured node has counted, and how many frames it refused for it."""
    if args.secoc is not None:
        c = node.authentication
        terminal.say(
            args,
            f"authentication: {c['verified']:,} frames proven, {unauthentic:,} refused ({c['missing']:,} without a "
            f"MAC); MACs refused: {c['wrong_mac']:,} wrong, {c['stale']:,} stale, {c['unmatched']:,} without a frame",
        )


def check_realtime_options(args: argparse.Namespace) -> None:
    """Refuse values that cannot be. Raises InputError."""
    if args.realtime_priority is not None and not 1 <= args.realtime_priority <= 99:
        raise InputError(f"--realtime-priority (={args.realtime_priority}) must be in [1, 99]")
    if not 0.0 <= args.spin_us <= 1000.0:
        raise InputError(f"--spin-us (={args.spin_us:g}) must be in [0, 1000]")
    if args.cpu is not None and args.cpu not in os.sched_getaffinity(0):
        allowed = ", ".join(str(c) for c in sorted(os.sched_getaffinity(0)))
        raise InputError(f"--cpu (={args.cpu}) must be one of {allowed}")
    check_seconds(args, "duration")


def check_seconds(args: argparse.Namespace, *names: str) -> None:
    """Refuse times that cannot be. Raises InputError."""
    for name in names:
        value = getattr(args, name)
        if value is not None and not 0.0 < value <= 1e7:
            raise InputError(f"--{name} (={value:g} s) must be above 0, at most 10,000,000 s")


@contextlib.contextmanager
def undisturbed(args: argparse.Namespace) -> Iterator[list[str]]:
    """`hil.loop.realtime.undisturbed` from options; a refusal is one line."""
    with contextlib.ExitStack() as stack:
        try:
            notes = stack.enter_context(realtime.undisturbed(args.realtime_priority, args.cpu))
        except OSError as e:
            p = args.realtime_priority
            raise InputError(
                f"--realtime-priority {p}: {e.strerror}; run as root, or allow it with ulimit -r {p}"
            ) from None
        yield notes


def bus_name(args: argparse.Namespace) -> str:
    """Return the bus that is asked for; without ``--bus``, vcan0 where there is one, else the embedded bus."""
    if args.bus:
        return str(args.bus)
    return "vcan0" if Path("/sys/class/net/vcan0").exists() else "local"


@contextlib.contextmanager
def joined(name: str, priority: int | None = None, **options: Any) -> Iterator[Any]:
    """Open the bus and leave it at the end. The broker of an embedded bus works with this participant's real-time
    priority.
    """
    if name.partition(":")[0] == "local":
        options["priority"] = priority or 0
    bus = open_bus(name, **options)
    try:
        yield bus
    finally:
        bus.shutdown()


def warm_nodes(args: argparse.Namespace) -> None:
    """Compile the nodes' ticks, saying so before a wait of some seconds."""
    if not is_cached(node_tick):
        terminal.say(args, "compiling the nodes for this machine (once, about 20 s) ...")
    nothing = np.zeros((1, 2), np.int64)
    Node().tick(nothing, 0)
    Ecu().tick(nothing, 0)


@contextlib.contextmanager
def recording(args: argparse.Namespace, channel: str) -> Iterator[Any]:
    """Give a running `hil.logs.recorder.RecorderProcess` for ``--record``, or None; it is complete at the end."""
    if not args.record:
        yield None
        return
    recorder = RecorderProcess(args.record, channel.replace(":", "-"))
    if recorder.kept:
        terminal.say(args, f"{args.record} was there already: it is now {recorder.kept}")
    try:
        yield recorder
    finally:
        recorder.close()


class Live:
    """A line a second on standard error, written by a thread so that a slow terminal delays nobody; what it cannot take
    is left out.
    """

    def __init__(self, args: argparse.Namespace):
        self.terminal = terminal.is_terminal(sys.stderr)
        self.on = not args.quiet and (args.live or self.terminal)
        self._lines: queue.Queue[str | None] = queue.Queue(4)
        self._width = 0
        if self.on:
            self._thread = threading.Thread(target=self._write, daemon=True)
            self._thread.start()

    def say(self, text: str) -> None:
        """Show ``text`` instead of the line before; never waits."""
        if self.on:
            with contextlib.suppress(queue.Full):
                self._lines.put_nowait(text)

    def _write(self) -> None:
        while (text := self._lines.get()) is not None:
            out = f"\r{text.ljust(self._width)}" if self.terminal else f"{text}\n"
            self._width = len(text)
            try:
                os.write(2, out.encode())
            except OSError:
                return

    def close(self) -> None:
        """End the line."""
        if self.on:
            with contextlib.suppress(queue.Full):
                self._lines.put_nowait(None)
            self._thread.join(0.5)
            if self.terminal:
                with contextlib.suppress(OSError):
                    os.write(2, b"\r" + b" " * self._width + b"\r")
            self.on = False


class BusWatch:
    """A line on standard error when the bus takes no more frames (interface down, bus-off, queue full), and one when it
    does again.

    Called at every tick; frames are sent every tenth. Standard error may be slow, so the lines are written by threads.
    """

    CLEAN = 200  # ticks without a refusal: the bus is well again

    def __init__(self, args: argparse.Namespace, name: str, port: Any):
        self.quiet, self.name, self.port = args.quiet, name, port
        self.bad, self.refused = self._bad(), port.refused
        self.first = self.last = -1

    def _bad(self) -> int:
        return int(self.port.refused + self.port.errors)

    def __call__(self, k: int) -> None:
        """Look at the port after tick ``k``."""
        bad = self._bad()
        if bad != self.bad:
            if self.first < 0:
                self.first, self.refused = k, self.port.refused
                self._say(f"{self.name}: {self._why()}; frames are neither sent nor heard, going on")
            self.bad, self.last = bad, k
        elif self.first >= 0 and k - self.last > self.CLEAN:
            gone = self.port.refused - self.refused + 1
            self._say(
                f"{self.name}: takes frames again after {(self.last - self.first + 1) * 1e-3:.1f} s; {gone:,} were "
                f"not sent"
            )
            self.first = -1

    def _why(self) -> str:
        try:
            up = int(Path(f"/sys/class/net/{self.name}/flags").read_text(), 16) & 1
        except (OSError, ValueError):
            return "does not take frames (gone, full or bus-off)"
        return "does not take frames (full or bus-off)" if up else "is down"

    def _say(self, text: str) -> None:
        if not self.quiet:
            threading.Thread(
                target=lambda: print(f"vaneloop: {text}", file=sys.stderr, flush=True), daemon=True
            ).start()


def realtime_json(report: Any) -> dict[str, Any]:
    """Return the lateness part of a command's JSON."""
    begin = report.begin
    t = begin.worst_tick * 1e-3
    at = datetime.fromtimestamp(report.started_ns * 1e-9 + t, UTC).isoformat()
    return {
        "ticks": report.ticks,
        "missed": report.missed,
        "skipped": report.skipped,
        "pauses": report.pauses,
        "dropped": report.dropped,
        "wall_s": report.wall_s,
        "lateness": {
            **begin.figures(),
            "worst": {"tick": begin.worst_tick, "t_s": t, "at": at, "us": begin.worst_ns * 1e-3},
            "histogram": [{"bin": label, "ticks": n} for label, n in begin.shown()],
        },
        "finished_after_deadline": report.end.figures(),
        "tick_takes": report.work.figures(),
    }


def print_lateness(args: argparse.Namespace, report: Any) -> None:
    """Print how late the ticks were."""
    if not report.ticks:
        return
    rows = []
    for name, h in (
        ("begins after its deadline", report.begin),
        ("has sent its frames", report.end),
        ("takes", report.work),
    ):
        f = h.figures()
        rows.append(
            [
                name,
                *(f"{f[k]:,.1f}" for k in ("p50_us", "p99_us", "p999_us", "max_us")),
                f"{100 * f['over_500us']:.3f} %",
            ]
        )
    terminal.print_table(args, "a tick ...", ["us", "p50", "p99", "p99.9", "max", "over 500 us"], rows)
    shown = [(label, n) for label, n in report.begin.shown() if n]
    most = max(n for _, n in shown)
    for label, n in shown:
        terminal.say(args, f"  {label:>9} {n:>10,}  {'#' * max(1, round(50 * n / most))}")
    worst = report.begin
    when = datetime.fromtimestamp(report.started_ns * 1e-9 + worst.worst_tick * 1e-3).strftime("%H:%M:%S.%f")[:-3]
    terminal.say(
        args, f"worst tick: {worst.worst_ns * 1e-3:,.1f} us late at t = {worst.worst_tick * 1e-3:.3f} s ({when})"
    )
    terminal.say(
        args,
        f"missed ticks (later than the next deadline): {report.missed:,} of {report.ticks:,}; skipped: "
        f"{report.skipped:,}",
    )
    if report.pauses:
        terminal.say(
            args, f"stood still for 50 ms or more: {report.pauses:,} times; frames dropped for it: {report.dropped:,}"
        )
    if report.missed and args.realtime_priority is None:
        terminal.say(args, "other programs delayed it; --realtime-priority 50 (root or ulimit -r) keeps them from that")
