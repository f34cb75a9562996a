"""``vaneloop compare``: by how much does the model miss, stage by stage and in the whole loop?"""

from __future__ import annotations

import argparse
import sys
from dataclasses import asdict

from app import own_model
from app.common import chain_of
from hil import cli, replay

__all__ = ["DESCRIPTION", "add_options", "command"]

DESCRIPTION = """Compare the model with a log: the whole loop, as replay does, and each stage driven by its own logged inputs.

In closed loop the controller hides what the model lacks; stage by stage it cannot. Errors are in the signal's unit and in multiples of the
noise floor.

examples:
  vaneloop compare run.csv
  vaneloop compare run.csv --model with_dead_band.toml --tolerance vigv=0.2 --report compare.html

exit codes: 0 agrees (or no tolerance given), 1 a tolerance is exceeded, 2 bad input"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options: those of replay."""
    replay.add_options(parser)
    own_model.add_options(parser)


def command(args: argparse.Namespace) -> int:
    """Run from parsed options; return the exit code."""
    if own_model.asked(args):
        return own_model.command(args, "compare")
    from discrepancy.workflow import compare_stages
    from hil.logs import LogError

    extra: dict[str, object] = {}
    report, args.report = args.report, None
    stages: list[dict[str, object]] = []
    try:
        chain = chain_of(args)
    except LogError as e:
        cli.say(args, f"note: no stage by stage comparison: {e}")
        extra["not_observed"] = {"all": str(e)}
    else:
        figures = compare_stages(chain.stages)
        stages = [{**asdict(f), "ratio": f.rms / f.noise_floor} for f in figures]
        rows = [
            [f.stage, f.signal, f"{f.rms:.4g}", f"{f.noise_floor:.4g}", f"{f.rms / f.noise_floor:.2f}", f.unit, f"{f.samples:,}"]
            for f in figures
        ]
        rows += [[name, "not observed: " + why, "-", "-", "-", "", "-"] for name, why in chain.not_observed.items()]
        columns = ["stage", "signal", "rms", "noise floor", "ratio", "unit", "samples"]
        cli.print_table(args, "each stage on its own logged inputs", columns, rows)
        extra["not_observed"] = chain.not_observed
        if report:
            from discrepancy.report import compare_report

            words = " ".join(["vaneloop compare", *sys.argv[2:]])
            cli.say(args, f"page: {compare_report(figures, chain, report, words, args.log)}")
            report = None
    args.report = report
    return replay.command(args, {"stages": stages, **extra})
