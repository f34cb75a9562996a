"""``vaneloop locate``: which stage fails, under which conditions, since when?"""

from __future__ import annotations

import argparse
import sys

from app import own_model
from app.common import add_model_option, chain_of, say_located
from hil import cli

__all__ = ["DESCRIPTION", "add_options", "command"]

DESCRIPTION = """Find where the model fails: stage, direction of motion, speed, distance since reversal, stroke, rotor speed, oil
temperature, supply pressure, time. Nominal parameters are refitted within their tolerance first. Significance is corrected for the number
of conditions looked at.

examples:
  vaneloop locate examples/hidden_effect.parquet --report locate.html
  vaneloop locate examples/hidden_effect.parquet --model with_dead_band.toml --json -

exit codes: 0 every stage agrees everywhere, 1 at least one fails, 2 bad input"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    cli.add_log_options(parser)
    add_model_option(parser)
    own_model.add_options(parser)
    cli.add_output_options(parser)
    parser.add_argument("--report", metavar="F.html", help="write a self-contained HTML page with plots")


def command(args: argparse.Namespace) -> int:
    """Run from parsed options; return the exit code."""
    if own_model.asked(args):
        return own_model.command(args, "locate")
    from discrepancy.workflow import locate_stages

    chain = chain_of(args)
    located = locate_stages(chain.stages)
    for x in located:
        say_located(args, x)
    stages = [x.json() for x in located]
    cli.write_json(args, {"schema": 1, "log": args.log, "stages": stages, "not_observed": chain.not_observed, "notes": chain.notes})
    if args.report:
        from discrepancy.report import compare_report

        words = " ".join(["vaneloop locate", *sys.argv[2:]])
        cli.say(args, f"page: {compare_report(located, chain, args.report, words, args.log)}")
    return 1 if any(x.fails for x in located) else 0
