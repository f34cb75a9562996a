"""``vaneloop locate``: which stage fails, under which conditions, since when?"""

from __future__ import annotations

import argparse

from vaneloop.base import terminal
from vaneloop.cli import options, own_model
from vaneloop.cli.chains import chain_of
from vaneloop.cli.options import add_machine_options, say_located
from vaneloop.verbs.search import compared

__all__ = ["DESCRIPTION", "add_options", "command"]

DESCRIPTION = """Find where the model fails: subsystem, direction of motion, speed, distance since reversal, stroke,
rotor speed, oil temperature, supply pressure, time. Nominal parameters are refitted within their tolerance first.
Significance is corrected for the number of conditions examined.

examples:
  vaneloop locate examples/hidden_effect.parquet --report locate.html
  vaneloop extend examples/hidden_effect.parquet --effect valve_dead_band --out with_dead_band.toml
  vaneloop locate examples/hidden_effect.parquet --model with_dead_band.toml --json -

exit codes: 0 every subsystem fits everywhere, 1 at least one fails, 2 bad input"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    options.add_log_options(parser)
    add_machine_options(parser)
    options.add_controller_options(parser)
    own_model.add_options(parser)
    terminal.add_output_options(parser, report=True)


@options.guarded
def command(args: argparse.Namespace) -> int:
    """Run from parsed options; return the exit code."""
    if own_model.asked(args):
        answer = own_model.ask(args, "locate")
        own_model.show(args, answer.by_log)
    else:
        chain = chain_of(args)
        answer = compared(chain, args.log, "locate")
    options.say_tested(args, answer.tested)
    for x in answer.located:
        say_located(args, x)
    for f in answer.held.failing if answer.held else ():
        terminal.say(args, str(f))
    options.answered(args, "locate", answer)
    return 1 if answer.fails else 0
