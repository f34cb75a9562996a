"""``vaneloop locate``: which stage fails, under which conditions, since when?"""

from __future__ import annotations

import argparse
import sys

from app import own_model
from app.common import add_model_option, chain_of
from hil import cli

__all__ = ["DESCRIPTION", "add_options", "command"]

DESCRIPTION = """Find where the model fails: stage, direction of motion, speed, distance since reversal, stroke, rotor speed, oil
temperature, supply pressure, time. Nominal parameters are refitted within their tolerance first. Significance is corrected for the number
of conditions looked at.

examples:
  vaneloop locate run.csv --report locate.html
  vaneloop locate run.csv --model with_dead_band.toml --json -

exit codes: 0 no stage fails anywhere, 1 at least one does, 2 bad input"""


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
    from discrepancy.fit import Judge
    from discrepancy.locate import onset, regimes
    from discrepancy.workflow import compare_stages, floor_of

    chain = chain_of(args)
    out, fails = [], False
    for stage in chain.stages:
        judge = Judge(stage, floor_of(stage))
        fit = judge.fit((), stage.neutral())
        found = regimes(judge, fit, 2.0)
        hot = [r for r in found if r.significant.any()]
        start = onset(judge, fit) if hot else None
        fails |= bool(hot)
        cli.say(args, f"{stage.name}: " + ("agrees everywhere" if not hot else f"fails in {len(hot)} of {len(found)} conditions"))
        if start is not None:
            cli.say(args, f"  begins at t = {start:.0f} s")
        for r in hot[:4]:
            cli.say(args, f"  {r.worst()}")
        out.append(
            {
                "stage": stage.name,
                "fails": bool(hot),
                "onset_s": start,
                "regimes": [
                    {
                        "signal": r.output, "unit": r.unit, "condition": r.condition, "condition_unit": r.condition_unit, "edges": r.edges,
                        "rms": r.rms, "noise_floors": r.ratio, "samples": r.samples, "significant": [bool(b) for b in r.significant],
                        "contrast": r.contrast,
                    }
                    for r in found
                ],
            }
        )  # fmt: skip
    cli.write_json(args, {"schema": 1, "log": args.log, "stages": out, "not_observed": chain.not_observed})
    if args.report:
        from discrepancy.report import compare_report

        words = " ".join(["vaneloop locate", *sys.argv[2:]])
        cli.say(args, f"page: {compare_report(compare_stages(chain.stages), chain, args.report, words, args.log)}")
    return 1 if fails else 0
