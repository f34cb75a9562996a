"""``vaneloop experiment``: which demand profile would best tell the remaining rivals apart?"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

from hil.logs import Channel, write_log
from vaneloop.base import terminal
from vaneloop.base.errors import InputError
from vaneloop.base.files import write
from vaneloop.cli import options, own_model
from vaneloop.cli.chains import chain_of
from vaneloop.cli.options import add_machine_options
from vaneloop.identification.user_models.experiment import Limits
from vaneloop.pages.diagnosis import experiment_rows
from vaneloop.verbs.search import Recommended, diagnosed
from vaneloop.verbs.search import experiment as recommend

__all__ = ["DESCRIPTION", "add_options", "command"]

DESCRIPTION = """Recommend the next experiment: the log is diagnosed; every pair of effects that it cannot distinguish
is simulated with its fitted parameters on each of a bank of safe demand profiles; each rival is then refitted to the
other's run. The profile under which even the best refit stays farthest from the truth separates them best.

With --system the runs are those of your model's inputs, within --limit and --rate, outputs too; the best is improved by
shifting parts of it, and checked by simulated runs with noise. Where no rivals are left, the run is sought that tells
the parameters best (D-optimal).

examples:
  vaneloop experiment examples/hidden_effect.parquet --out next_demand.csv --report experiment.html
  vaneloop experiment examples/tank.csv --system examples/tank.py --limit pump=0:8 --limit level=2:60 --out next.csv

exit codes: 0 a profile is recommended or nothing is to be separated, 1 no profile separates them, 2 bad input"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    options.add_log_options(parser)
    add_machine_options(parser)
    own_model.add_options(parser)
    run = parser.add_argument_group("the run, with --system")
    run.add_argument(
        "--limit", metavar="NAME=LOW:HIGH", action="append", default=[],
        help="range of an input (default: as in the log) or of an output (default: none), in the system's unit",
    )  # fmt: skip
    run.add_argument("--rate", metavar="NAME=R", action="append", default=[], help="greatest rate of an input, per s")
    run.add_argument("--seconds", metavar="S", help="length of the run (default: as the log)")
    parser.add_argument("--out", metavar="F.csv", help="write what drives the run as a log, if it separates the rivals")
    terminal.add_output_options(parser, report=True)


def command(args: argparse.Namespace) -> int:
    """Run from parsed options; return the exit code."""
    if own_model.asked(args):
        with terminal.progress_bar(args, "searching laws, trying runs") as progress:
            answer = own_model.ask(args, "experiment", limits=_limits(args), progress=progress)
    else:
        for name in ("limit", "rate", "seconds"):
            if getattr(args, name):
                raise InputError(f"--{name} needs --system MY.py")
        chain = chain_of(args, loop=True)
        with options.search_bar(args) as news:
            found = diagnosed(chain, args.log, news=news)
        with terminal.progress_bar(args, "trying profiles") as progress:
            answer = recommend(None, found, progress=progress)
    e = answer.recommended
    if e is None:
        terminal.say(args, "nothing to separate: the log leaves no rivals")
    else:
        rows = [[x if isinstance(x, str) else f"{x:.4g}" for x in row] for row in experiment_rows(e)]
        terminal.print_table(args, "what each run would tell, after refit", list(e["heads"].values()), rows)
        terminal.say(args, answer.sentence())
    terminal.write_json(args, answer.to_dict())
    if e is not None and args.out:
        if e["separates"]:
            _write(Path(args.out), e)
            terminal.say(args, f"profile: {args.out}")
        else:
            print(f"vaneloop experiment: no profile separates the rivals; {args.out} is not written", file=sys.stderr)
    if args.report:
        terminal.say(args, f"page: {answer.report(args.report, terminal.typed('experiment'))}")
    return 1 if e is not None and not e["separates"] else 0


def _write(path: Path, e: Recommended) -> None:
    """Write what drives a run as a log: of the vane chain in any format, of a user's own system as a table."""
    if set(e["inputs"]) == {"n_dem"}:
        write_log(path, {name: Channel(e["t"], v) for name, (_, v) in e["inputs"].items()})
        return
    if path.suffix.lower() != ".csv":
        raise InputError(f"--out {path}: must end with .csv, with --system")
    rows = zip(e["t"], *(v for _, v in e["inputs"].values()), strict=True)
    head = ",".join(["t", *e["inputs"]])
    write(path, "\n".join([head, *(",".join(f"{v:.6g}" for v in row) for row in rows)]) + "\n")


def _limits(args: argparse.Namespace) -> Limits:
    """What a run of a user's own system must keep to."""
    ranges = {}
    for name, text in terminal.pairs(args.limit, "limit").items():
        low, _, high = text.partition(":")
        try:
            ranges[name] = float(low), float(high)
        except ValueError:
            raise InputError(f"--limit {name}={text}: must be NAME=LOW:HIGH, two numbers") from None
        if not (np.all(np.isfinite(ranges[name])) and ranges[name][0] < ranges[name][1]):
            raise InputError(f"--limit {name}={text}: the low end must be below the high one, both finite")
    rates = {
        name: _above_zero("rate", f"{name}={text}", text) for name, text in terminal.pairs(args.rate, "rate").items()
    }
    return Limits(ranges, rates, _above_zero("seconds", args.seconds, args.seconds) if args.seconds else None)


def _above_zero(option: str, shown: str, text: str) -> float:
    value = terminal.number(text)
    if not (np.isfinite(value) and value > 0.0):
        raise InputError(f"--{option} {shown}: must be a number above 0")
    return value
