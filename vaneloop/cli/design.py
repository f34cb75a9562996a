"""``vaneloop design``: the servo loop's figures against their limits."""

from __future__ import annotations

import argparse

from vaneloop.base import terminal
from vaneloop.base.errors import InputError
from vaneloop.cli.options import add_plant_option

__all__ = ["DESCRIPTION", "add_options", "command"]

DESCRIPTION = """Servo loop: crossover, gain, phase and disk margins at every corner of the tolerances, step and ramp,
and the limit cycles that backlash inside the loop would cause, predicted by describing function and compared with the
time simulation.

examples:
  vaneloop design --report design.html
  vaneloop design --kp 24 --backlash-inside 0.05 --json -

exit codes: 0 all stated limits hold, 1 not, 2 bad input"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--kp", type=float, metavar="G", help="proportional gain, mA/mm (default: the calibration's)")
    parser.add_argument("--ki", type=float, metavar="G", help="integral gain, mA/(mm s)")
    parser.add_argument("--kff", type=float, metavar="G", help="feed-forward of the demanded speed, mA/(mm/s)")
    parser.add_argument(
        "--backlash-inside", type=float, metavar="MM", help="backlash between piston and LVDT to examine, mm"
    )
    add_plant_option(parser)
    terminal.add_output_options(parser, report=True)


def command(args: argparse.Namespace) -> int:
    """Run from parsed options; return the exit code."""
    for name in ("kp", "ki", "kff"):
        value = getattr(args, name)
        if value is not None and not 0.0 <= value <= 1e6:
            raise InputError(f"--{name} (={value:g}) must be in [0, 1e6]")
    from vaneloop.design.servo_design import evaluate, summary
    from vaneloop.pages.design import design_page

    result, code = evaluate(
        kp=args.kp, ki=args.ki, kff=args.kff, backlash_inside=args.backlash_inside, plant=args.plant or "plant.toml"
    )
    for line in summary(result):
        terminal.say(args, line)
    terminal.write_json(args, {"schema": 1, **result.to_dict()})
    if args.report:
        terminal.say(args, f"page: {design_page(result, args.report)}")
    return code
