"""``vaneloop replay`` and ``python -m hil.replay``: a logged run through firmware and plant, in figures and a page."""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hil.logs import Channel, write_log
from hil.logs.formats import FORMATS, format_of, listed
from hil.logs.notes import told
from hil.loop.lockstep import warm_up
from hil.native import Program, crash_log
from hil.native.crash_log import is_crash_log
from hil.replay import STAGE, STATISTICS, ReplayResult
from vaneloop.base import terminal
from vaneloop.base.errors import InputError, meant
from vaneloop.base.signals import SIDES, UNITS
from vaneloop.cli import options
from vaneloop.pages.run import NAMES
from vaneloop.verbs.replay import replay

__all__ = ["DESCRIPTION", "add_options", "command", "replayed"]

DESCRIPTION = """Replay a logged engine run through the controller's firmware and the plant.

The log's speed demand (and measured speed, supply pressure, oil temperature where logged) drives the loop; every other
signal that the log measured is compared with the simulated one, and the vane angles with their schedule.

examples:
  vaneloop replay examples/engine_run.blf --report replay.html
  vaneloop replay examples/hidden_effect.parquet --tolerance vigv=0.6 --json -
  vaneloop replay YOURS.log --dbc YOURS.dbc --map ENGINE_RPM=n_dem --unit n_dem=rpm --design-rpm 6000

exit codes: 0 agrees (or no tolerance given), 1 a tolerance is exceeded, 2 bad input"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options of replay and of compare."""
    options.add_log_options(parser)
    group = parser.add_argument_group("the model and the judgement")
    group.add_argument(
        "--strategy",
        metavar="S",
        help="single (one mean curve), dual (one a direction), inverse or adaptive (docs/strategies.md)",
    )
    options.add_machine_options(group)
    options.add_channels_option(group)
    options.add_controller_options(parser)
    group.add_argument(
        "--tolerance",
        metavar="signal=value",
        action="append",
        default=[],
        help="largest RMS error allowed, in the signal's unit; signal.max_abs=value, signal.mean_abs=value for the "
        "other figures",
    )
    terminal.add_output_options(parser, report=True)
    parser.add_argument("--out", metavar="F", help=f"write the simulated run as a log ({listed(FORMATS.values())})")


@options.guarded
def command(args: argparse.Namespace) -> int:
    """Run from parsed options; return the exit code."""
    if args.controller is not None and is_crash_log(args.log):
        return _crash_again(args)
    return replayed(args)


def _crash_again(args: argparse.Namespace) -> int:
    """Run a controller on the inputs on which one failed before; where it fails again, that ends this process."""
    rows, about, calibration = crash_log.read(args.log)
    terminal.say(args, f"{args.log}: {len(rows):,} ticks from power-on; then: {about['failure']}")
    crash_log.feed(rows, calibration, Program(args.controller))
    terminal.say(args, f"{args.controller} does not fail on these inputs")
    terminal.write_json(args, {"schema": 1, "log": args.log, "ticks": len(rows), "then": about["failure"]})
    return 0


def replayed(
    args: argparse.Namespace,
    extra: dict[str, Any] | None = None,
    floors: Mapping[str, float] | None = None,
    said: Sequence[str] = (),
) -> int:
    """Run replay from parsed options; ``extra`` goes into the JSON too, ``floors`` as in `replay`, notes that have been
    ``said`` are not said again. Return the exit code.
    """
    limits = _limits(args.tolerance)
    options.tables_of(args, tell=True)
    machine = options.machine_of(args, strategy=args.strategy)  # refuse a wrong name or table before reading a long log
    log = options.read_log_of(args)
    warm_up(lambda text: terminal.say(args, text))
    with terminal.progress_bar(args, f"replaying {Path(args.log).name}") as progress:
        answer = replay(log, machine, progress=progress, floors=floors)
    result, exceeded = answer.result, _exceeded(answer.result, limits)
    rows = [
        [
            s.signal,
            s.stage,
            s.reference,
            *(_figure(getattr(s, k)) for k in (*STATISTICS, "noise_floor")),
            s.unit,
            f"{s.samples:,}",
        ]
        for s in result.signals
    ]
    columns = [
        "signal",
        "subsystem",
        "against",
        "rms",
        "mean",
        "max",
        "mean 99-100 %",
        "noise floor",
        "unit",
        "samples",
    ]
    terminal.print_table(
        args, f"{result.log}: {result.simulated_s:,.0f} s simulated in {result.wall_s:.2f} s", columns, rows
    )
    terminal.notes(args, (n for n in result.notes if n not in said))
    for line in exceeded:
        terminal.say(args, f"differs: {line}")
    notes = list(dict.fromkeys([*said, *result.notes]))
    more = {**(extra or {}), **told(notes)}
    answer = dataclasses.replace(answer, exceeded=exceeded, more=more)
    terminal.write_json(args, answer.to_dict())
    if args.report:
        words = " ".join(["vaneloop replay", args.log, *(a for a in sys.argv[2:] if a != args.log)])
        terminal.say(args, f"page: {answer.report(args.report, words)}")
    if args.out:
        table = format_of(Path(args.out)).channels is not None  # the bus has no motor current, and the mean stroke only
        own = {k: v for k, v in result.model.items() if table or k in UNITS and k not in SIDES}
        channels = {k: Channel(result.t, v, unit=NAMES[k][1] or "-") for k, v in own.items()}
        write_log(args.out, channels)
        terminal.say(args, f"simulated run: {args.out}")
    return 1 if exceeded else 0


def _figure(v: float | None) -> str:
    return "-" if v is None else f"{v:.4g}"


def _limits(options: list[str]) -> dict[tuple[str, str], float]:
    """Parse ``--tolerance`` into {(signal, statistic): limit}."""
    out = {}
    for key, text in terminal.pairs(options, "tolerance").items():
        signal, _, statistic = key.partition(".")
        statistic = statistic or "rms"
        if signal not in STAGE or statistic not in STATISTICS:
            allowed = f"{', '.join(STAGE)}, each also with .{', .'.join(STATISTICS)}"
            near = meant(key, [*STAGE, *(f"{s}.{k}" for s in STAGE for k in STATISTICS)])
            raise InputError(f"--tolerance {key}={text}: {key!r} is not known{near}; allowed: {allowed}")
        value = terminal.number(text)
        if not value >= 0.0 or value == float("inf"):
            raise InputError(f"--tolerance {key}={text}: {text!r} must be a number of 0 or more")
        out[signal, statistic] = value
    return out


def _exceeded(result: ReplayResult, limits: dict[tuple[str, str], float]) -> list[str]:
    """Tolerances that are exceeded, in words. The measurement decides; the schedule where nothing was measured."""
    out = []
    for (signal, statistic), limit in limits.items():
        of = [s for s in result.signals if s.signal == signal]
        if not of:
            raise InputError(f"--tolerance {signal}={limit:g}: {result.log} has no {signal} to compare with")
        judged = next((s for s in of if s.reference == "measured"), of[0])
        value = getattr(judged, statistic)
        words = "measurement" if judged.reference == "measured" else "schedule"
        if value is not None and not value <= limit:  # what is no number is within no tolerance
            out.append(
                f"{signal} {statistic} {value:.4g} {judged.unit} against the {words} exceeds {limit:g} {judged.unit}"
            )
    return out
