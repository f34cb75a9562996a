"""``vaneloop ecu``: the external engine control unit on the bus."""

from __future__ import annotations

import argparse
import contextlib
import os
import select
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from controller import FAULTS, MODES
from hil.bus.frames import R_GOOD, R_LOST, R_UNAUTHENTIC
from hil.bus.port import Port
from hil.engine_test import load_profile
from hil.logs.notes import told
from hil.loop import ecu
from hil.loop.ecu import EcuStation, Typed
from hil.loop.node import Ecu
from hil.loop.realtime import Ticker, run_realtime, stop_on_signals, wall_clock
from vaneloop.base import terminal
from vaneloop.base.errors import InputError, meant
from vaneloop.base.tables import load_toml
from vaneloop.base.vanes import VANES
from vaneloop.cli import options, station

__all__ = ["DESCRIPTION", "add_options", "command", "demand_of"]

DESCRIPTION = """The engine control unit on the CAN bus: sends ECU_DEMAND every 10 ms with the speed that its engine
model has (or the log had), and watches the controller's frames. Start it before or after vaneloop run: its demand
begins with the first good VGV_STATUS.

The demand is a profile, a log, or what is typed: a number sets n_dem (%), +N or -N changes it, run and standby ask for
the mode, quit ends; at a terminal the arrow keys change it by 1 %, page up and down by 5 %. The end of standard input
leaves the last demand standing.

profiles: idle, step, ramp, slam, staircase, sine, engine-test; a TOML file with lists t (s) and n_dem (%); a CSV file
with columns t,n_dem

examples:
  vaneloop ecu --bus vcan0 --profile staircase
  vaneloop ecu --log examples/engine_run.blf --duration 60
  (echo 70; sleep 5; echo 90; sleep 5; echo quit) | vaneloop ecu

exit codes: 0 good (also after Ctrl-C), 1 the controller did not answer or stopped answering, 2 bad input"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--bus", metavar="B", help=f"{station.BUS_HELP}; default: vcan0 if there is one, else local")
    parser.add_argument("--profile", metavar="F", help="speed demand: a name, or a file (.toml, or a log)")
    parser.add_argument(
        "--log", metavar="F", help="speed demand, and measured speed if it has one, from any log (docs/logs.md)"
    )
    parser.add_argument(
        "--duration",
        metavar="S",
        type=float,
        help="seconds from the first VGV_STATUS on (default: the profile's, the log's)",
    )
    parser.add_argument(
        "--timeout",
        metavar="S",
        type=float,
        default=0.5,
        help="give up after this long without a good VGV_STATUS (default 0.5)",
    )
    parser.add_argument(
        "--wait", metavar="S", type=float, default=10.0, help="wait this long for the first VGV_STATUS (default 10)"
    )
    parser.add_argument(
        "--mode", choices=("run", "standby"), default="run", help="mode asked for with a profile or log (default run)"
    )
    options.add_machine_options(parser)
    parser.add_argument(
        "--seed", metavar="N", type=int, help="noisy measured speed, with this seed (default: noise-free)"
    )
    options.add_reading_options(parser.add_argument_group("reading the log (docs/logs.md)"))
    station.add_secoc_option(parser)
    station.add_realtime_options(parser)
    terminal.add_output_options(parser)
    parser.add_argument(
        "--live", action="store_true", help="a line every second on standard error, also where that is no terminal"
    )


def demand_of(args: argparse.Namespace, notes: list[str], default: str | None = None) -> Any:
    """Return the demand that ``--profile`` or ``--log`` names, else the builtin profile ``default``; None for a typed
    one. What there is to note on reading it is said, and goes into ``notes``.
    """
    if args.profile and args.log:
        raise InputError("--profile and --log exclude each other")
    table = args.profile if args.profile and Path(args.profile).suffix.lower() not in ("", ".toml") else None
    reading = options.log_options(args, table)

    def tell(said: list[str]) -> None:
        notes.extend(said)
        terminal.notes(args, said)

    if args.log:
        log = options.read_log_of(args)
        tell(log.notes)
        return ecu.demand_of_log(log)
    name = args.profile or default
    if name is None:
        return None
    if name in ecu.BUILTIN:
        return ecu.builtin(name)
    path = Path(name)
    if name == "engine-test" or (path.suffix.lower() == ".toml" and path.is_file() and "speed" in load_toml(path)):
        n_dem = load_profile("engine_test.toml" if name == "engine-test" else path)
        return ecu.Demand(np.arange(len(n_dem)) * 0.01, n_dem)
    if not path.suffix:
        near = meant(name, [*ecu.BUILTIN, "engine-test"])
        raise InputError(
            f"--profile {name!r} is not known{near}; allowed: {', '.join(ecu.BUILTIN)}, engine-test, or a file "
            "(.toml, or a log)"
        )
    return ecu.read_profile(path, tell, **reading)


def command(args: argparse.Namespace) -> int:
    """Run from parsed options; return the exit code."""
    station.check_realtime_options(args)
    station.check_seconds(args, "timeout", "wait")
    if args.seed is not None and args.seed < 0:
        raise InputError(f"--seed (={args.seed}) must be 0 or more")
    name = station.bus_name(args)
    if name.partition(":")[0] == "lockstep":
        raise InputError(
            "--bus lockstep exists within one process: vaneloop run --bus lockstep --profile F has an ECU of its own"
        )
    authenticator = station.authenticator(args)
    machine = options.machine_of(args).plant
    read_notes: list[str] = []
    demand = demand_of(args, read_notes)
    typed = Typed() if demand is None else None
    source: Any = typed if demand is None else demand
    station.warm_nodes(args)
    first = 60.0 if demand is None else float(demand.per_frame()[0, 0])
    ecu = EcuStation(
        source, timeout=args.timeout, wait=args.wait, mode_request=int(args.mode == "run"),
        ecu=Ecu(machine, n_dem=first, seed=args.seed),
    )  # fmt: skip
    node = station.secured(ecu, authenticator, ecu=True, clock=wall_clock())
    duration = args.duration if args.duration is not None or demand is None else demand.duration
    complaint = ""
    with (
        stop_on_signals() as stop,
        station.joined(name, args.realtime_priority, can_filters=station.ACCEPTED) as bus,
        _typing(args, typed),
    ):
        port = Port(bus)
        live = station.Live(args)

        def show(report: Any) -> None:
            v = ecu.ecu.values
            state = "waiting" if ecu.met is None else MODES[int(v["state"])]
            faults = ", ".join(
                f for bit, f in enumerate(FAULTS) if v["faults"] == v["faults"] and int(v["faults"]) >> bit & 1
            )
            n_dem, n_r, _ = ecu.ecu.arrays.demand
            n_r = ecu.ecu.arrays.s[0, 0] if n_r != n_r else n_r
            note = typed.complaint if typed is not None else ""
            angles = " ".join(f"{v[name]:6.2f}" for name in VANES if name in v)
            live.say(
                f"{ecu.t:>6.0f} s  n_dem {n_dem:6.2f} %  n_r {n_r:6.2f} %  {state:<9}  x_dem {v['x_dem']:6.2f}  "
                f"x_lvdt {v['x_lvdt']:6.2f} mm  vanes {angles} deg  {faults}  {note}"
            )
            if typed is not None:
                typed.complaint = ""

        bus_watch, done = station.BusWatch(args, name, port), ecu.watcher(duration)

        def watch(k: int) -> str | None:
            bus_watch(k)
            return done(k)

        terminal.say(
            args,
            f"ECU on {name}, {args.profile or args.log or Typed.HELP}; {station.authentication_words(args)}; Ctrl-C "
            f"ends",
        )
        try:
            with station.undisturbed(args) as notes:
                report = run_realtime(
                    node, port, ticker=Ticker(spin_us=args.spin_us, policy=args.policy), stop=stop,
                    live=show if live.on else None,
                    watch=watch,
                )  # fmt: skip
        finally:
            live.close()
    if report.failed:
        complaint = report.failed
    elif report.ended not in ("done", "quit", *("SIGINT", "SIGTERM", "SIGHUP")):
        complaint = report.ended
    values, receivers = ecu.ecu.values, ecu.ecu.arrays.receiver
    state = MODES[int(values["state"])] if values["state"] == values["state"] else "never heard"
    good, lost = int(receivers[:, R_GOOD].sum()), int(receivers[:, R_LOST].sum())
    unauthentic = int(receivers[:, R_UNAUTHENTIC].sum())
    ended = f", ended by {report.ended}" if report.ended.startswith("SIG") else ""
    terminal.say(args, f"{ecu.t:,.3f} s of demand on {name}{ended}; controller: {state}")
    terminal.say(
        args,
        f"frames: {report.sent:,} sent, {port.refused:,} not taken by the bus; from the controller {good:,} good, "
        f"{lost:,} lost",
    )
    f = report.begin.figures()
    terminal.say(
        args,
        f"lateness: p50 {f['p50_us']:,.1f}, p99 {f['p99_us']:,.1f}, max {f['max_us']:,.1f} us; missed ticks "
        f"{report.missed:,}",
    )
    station.say_authentication(args, node, unauthentic)
    if complaint:
        print(f"vaneloop ecu: {complaint}", file=sys.stderr)
    terminal.write_json(args, {
        "schema": 1, "bus": name, "ended": report.ended or "done", "demand_s": ecu.t, "state": state, "values": values,
        "frames": {"sent": report.sent, "refused": port.refused, "good": good, "lost": lost,
        "lost_by_reader": port.lost, "unauthentic": unauthentic},
        "secoc": station.authentication_json(args, node),
        **station.realtime_json(report), **told([*read_notes, *notes]), "complaint": complaint,
    })  # fmt: skip
    return 1 if complaint else 0


# ---- typing ----------------------------------------------------------------------------------------------------------

KEYS = {
    "\x1b[A": "+1",
    "\x1b[B": "-1",
    "\x1b[5~": "+5",
    "\x1b[6~": "-5",
    "+": "+1",
    "-": "-1",
    "r": "run",
    "s": "standby",
    "q": "quit",
}


@contextlib.contextmanager
def _typing(args: argparse.Namespace, typed: Any) -> Iterator[None]:
    """Give what comes through standard input to ``typed``: keys of a terminal that is ours, lines otherwise.

    A terminal that controls no process of ours (under an init, in a container) is read in lines, as a pipe is.
    """
    fd = terminal.input_of(sys.stdin) if typed is not None else None
    if fd is None:
        yield
        return
    with terminal.keyboard(sys.stdin) as keys:
        target, of = (_lines, (args, fd, typed)) if keys is None else (_keys, (keys, typed))
        threading.Thread(target=target, args=of, daemon=True).start()
        yield


_LONGEST = 4096  # bytes of a line


def _lines(args: argparse.Namespace, fd: int, typed: Any) -> None:
    rest = b""
    while True:
        try:
            data = os.read(fd, 4096)
        except OSError:
            return
        *lines, rest = (rest + data).split(b"\n")
        if len(rest) > _LONGEST:  # as from /dev/zero, where no line ever ends
            print(f"vaneloop ecu: standard input: a line of more than {_LONGEST:,} bytes; not read on", file=sys.stderr)
            return
        if not data:
            lines.append(rest)
        for line in lines:
            typed.line(line.decode(errors="replace"))
            if typed.complaint:
                print(f"vaneloop ecu: {typed.complaint}", file=sys.stderr, flush=True)
                typed.complaint = ""
        if not data:
            return


def _keys(fd: int, typed: Any) -> None:
    number = ""
    while not typed.quit:
        if not select.select([fd], [], [], 0.2)[0]:
            continue
        try:
            data = os.read(fd, 64)
        except OSError:  # the terminal is gone
            return
        if not data:
            return
        text = data.decode(errors="replace")
        if text in KEYS and not number:
            typed.line(KEYS[text])
            continue
        for c in text:
            if c in "\r\n":
                typed.line(number)
                number = ""
            elif c in "\x7f\b":
                number = number[:-1]
            elif c.isdigit() or c in ".+-" or (c.isalpha() and len(number) < 20):
                number = KEYS[c] if c in "rsq" and not number else number + c
                if number in ("run", "standby", "quit"):
                    typed.line(number)
                    number = ""
