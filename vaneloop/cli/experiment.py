"""``vaneloop experiment``: which demand profile would best tell the remaining rivals apart?"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from hil.logs import Channel, write_log
from vaneloop.base import terminal
from vaneloop.cli import options
from vaneloop.cli.chains import chain_of
from vaneloop.cli.options import add_machine_options
from vaneloop.identification.settings import MOST_REPEATS
from vaneloop.verbs.search import diagnosed
from vaneloop.verbs.search import experiment as recommend

__all__ = ["DESCRIPTION", "add_options", "command"]

DESCRIPTION = """Recommend the next experiment: the log is diagnosed; every pair of effects that it cannot distinguish
is simulated with its fitted parameters on each of a bank of safe demand profiles; each rival is then refitted to the
other's run. The profile under which even the best refit stays farthest from the truth separates them best.

examples:
  vaneloop experiment examples/hidden_effect.parquet --out next_demand.csv --report experiment.html

exit codes: 0 a profile is recommended or nothing is to be separated, 1 no profile separates them, 2 bad input"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    options.add_log_options(parser)
    add_machine_options(parser)
    parser.add_argument(
        "--out", metavar="F.csv", help="write the demand profile as a log (t, n_dem), if it separates the rivals"
    )
    terminal.add_output_options(parser, report=True)


def command(args: argparse.Namespace) -> int:
    """Run from parsed options; return the exit code."""
    chain = chain_of(args, loop=True)
    with options.search_bar(args) as news:
        found = diagnosed(chain, args.log, news=news)
    with terminal.progress_bar(args, "trying profiles") as progress:
        answer = recommend(None, found, progress=progress)
    e = answer.recommended
    if e is None:
        terminal.say(args, "nothing to separate: the log leaves no rivals")
    else:
        rows = [
            [str(r["profile"]), f"{r['nats']:.1f}", f"{r['spreads']:.1f}", str(r["repeats"] or f"over {MOST_REPEATS}")]
            for r in e["table"]
        ]
        terminal.print_table(
            args,
            "divergence of the closest pair of rivals after refit",
            ["profile", "log-likelihood ratio a run", "standard deviations", "runs needed"],
            rows,
        )
        terminal.say(args, answer.sentence())
    terminal.write_json(args, answer.to_dict())
    if e is not None and args.out:
        if e["separates"]:
            write_log(Path(args.out), {"n_dem": Channel(e["t"], e["n_dem"])})
            terminal.say(args, f"profile: {args.out}")
        else:
            print(f"vaneloop experiment: no profile separates the rivals; {args.out} is not written", file=sys.stderr)
    if args.report:
        words = " ".join(["vaneloop experiment", *sys.argv[2:]])
        terminal.say(args, f"page: {answer.report(args.report, words)}")
    return 1 if e is not None and not e["separates"] else 0
