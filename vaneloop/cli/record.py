"""``vaneloop record``: all frames of a bus into a file that opens whatever happens."""

from __future__ import annotations

import argparse
import time
from typing import Any

from can import CanError

from hil.bus.port import Port
from hil.logs.recorder import Recorder, check_name, packed_message
from hil.loop.realtime import stop_on_signals
from vaneloop.base import terminal
from vaneloop.base.errors import InputError
from vaneloop.cli import station

__all__ = ["DESCRIPTION", "add_options", "command"]

DESCRIPTION = """Record every frame on a CAN bus, with its time of arrival, in the format that the file's suffix says;
in Parquet with the signals of vgv.dbc in columns. The file can be opened at any time while it grows, and after any end,
kill -9 too, which costs at most the last second. A file of that name that is there already is kept under another name.

examples:
  vaneloop record run.mf4
  vaneloop record night.blf --bus vcan0 --duration 3600

exit codes: 0 good (also after Ctrl-C), 1 frames were lost or the file could not be written to the end, 2 bad input"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("out", metavar="FILE", help=f"file to record to: {station.A_RECORDING}")
    parser.add_argument("--bus", metavar="B", help=f"{station.BUS_HELP}; default: vcan0 if there is one, else local")
    parser.add_argument("--duration", metavar="S", type=float, help="seconds to record (default: until Ctrl-C)")
    terminal.add_output_options(parser)
    parser.add_argument(
        "--live", action="store_true", help="a line every second on standard error, also where that is no terminal"
    )


def command(args: argparse.Namespace) -> int:
    """Run from parsed options; return the exit code."""
    station.check_seconds(args, "duration")
    check_name(args.out)
    name = station.bus_name(args)
    if name.partition(":")[0] == "lockstep":
        raise InputError("--bus lockstep exists within one process: vaneloop run --bus lockstep --record F records it")
    failed = ""
    with stop_on_signals() as stop, station.joined(name) as bus:
        port = Port(bus)
        recorder = Recorder(args.out, name.replace(":", "-"))
        if recorder.kept is not None:
            terminal.say(args, f"{args.out} was there already: it is now {recorder.kept}")
        terminal.say(args, f"recording {name} to {args.out}; Ctrl-C ends")
        live = station.Live(args)
        started = shown = time.monotonic()
        taken = 0
        try:
            while not stop:
                now = time.monotonic()
                if args.duration is not None and now - started >= args.duration:
                    break
                message = bus.recv(0.1)
                burst: list[bytes] = []
                while message is not None:
                    burst.append(packed_message(message))
                    message = bus.recv(0) if len(burst) < 1000 else None
                recorder.put(b"".join(burst))
                taken += len(burst)
                recorder.poll()
                if now - shown >= 1.0:
                    shown = now
                    live.say(f"{now - started:>6.0f} s  {taken:,} frames  {port.lost:,} lost")
        except (CanError, InputError) as e:
            failed = str(e)
        finally:
            live.close()
            try:
                recorder.close()
            except InputError as e:
                failed = failed or str(e)
    lost = port.lost
    words = [
        f"{recorder.frames:,} frames in {args.out}",
        f"{lost:,} lost" if lost else "",
        f"ended by {stop.asked}" if stop.asked else "",
    ]
    terminal.say(args, "; ".join(w for w in words if w))
    exceeded = ([failed] if failed else []) + ([f"the bus lost {lost:,} frames for this reader"] if lost else [])
    for line in exceeded:
        terminal.say(args, f"incomplete: {line}")
    out: dict[str, Any] = {
        "schema": 1,
        "bus": name,
        "path": args.out,
        "frames": recorder.frames,
        "lost": lost,
        "exceeded": exceeded,
    }
    terminal.write_json(args, out)
    return 1 if exceeded else 0
