"""``vaneloop compare``: by how much does the model miss, stage by stage and in the whole loop?"""

from __future__ import annotations

import argparse

from hil.logs import LogError
from vaneloop.base import terminal
from vaneloop.cli import options, own_model, replay
from vaneloop.cli.chains import chain_of
from vaneloop.cli.options import guarded
from vaneloop.pages import story
from vaneloop.verbs.search import compared

__all__ = ["DESCRIPTION", "add_options", "command"]

DESCRIPTION = """Compare the model with a log: the whole loop, as replay does, and each subsystem driven by its own
logged inputs.

In closed loop the controller hides what the model lacks; in a subsystem alone it cannot. Errors are in the signal's
unit and in multiples of the noise floor.

examples:
  vaneloop compare examples/hidden_effect.parquet
  vaneloop extend examples/hidden_effect.parquet --effect valve_dead_band --out with_dead_band.toml
  vaneloop compare examples/hidden_effect.parquet --model with_dead_band.toml --tolerance vigv=0.2 --report compare.html

exit codes: 0 agrees (or no tolerance given), 1 a tolerance is exceeded, 2 bad input"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options: those of replay."""
    replay.add_options(parser)
    own_model.add_options(parser)


@guarded
def command(args: argparse.Namespace) -> int:
    """Run from parsed options; return the exit code."""
    if own_model.asked(args):
        return _own(args)
    extra: dict[str, object] = {}
    report, args.report = args.report, None
    stages: list[dict[str, object]] = []
    floors: dict[str, float] = {}
    said: list[str] = []
    alone = ""  # why there is only the loop
    try:
        chain = chain_of(args, loop=True)
    except LogError as e:
        alone = str(e)
        extra["not_observed"] = {"all": str(e)}
    else:
        said = chain.notes
        answer = compared(chain, args.log)
        located = answer.located
        figures = [f for x in located for f in x.signals]
        stages = [f.json() for f in figures]
        floors = {f.signal: f.noise_floor for f in figures}
        rows = [
            [f.stage, f.signal, *(f"{v:.4g}" for v in (f.rms, f.noise_floor)), story.floors(f.ratio),
            f"{f.rms_as_given:.4g}", f.unit,
             f"{f.samples:,}"] for f in figures
        ]  # fmt: skip
        rows += [
            [name, f"{story.CANNOT}: {why}", "-", "-", "-", "-", "", "-"] for name, why in chain.not_observed.items()
        ]
        columns = ["subsystem", "signal", "rms", "noise floor", "ratio", "as given", "unit", "samples"]
        terminal.print_table(
            args,
            "each subsystem on its own logged inputs, nominal parameters refitted within their tolerances",
            columns,
            rows,
        )
        options.say_tested(args, answer.tested)
        extra |= {k: v for k, v in answer.to_dict().items() if k in ("tested", "whole")}
        terminal.say(args, answer.sentence())
        extra["not_observed"] = chain.not_observed
        extra["verdict"] = "fails" if answer.fails else "agrees"
        if report:
            words = terminal.typed("compare")
            terminal.say(args, f"page: {answer.report(report, words)}")
            report = None
    args.report = report
    code = replay.replayed(args, {"stages": stages, **extra}, floors, said)
    if alone:  # where the loop cannot be compared either, that is said once
        terminal.say(args, f"note: no comparison by subsystem: {alone}")
    return code


def _own(args: argparse.Namespace) -> int:
    """`command` of a model of the user's own: no loop around it."""
    answer = own_model.ask(args, "compare")
    own_model.show(args, answer.by_log)
    terminal.say(args, answer.sentence())
    options.answered(args, "compare", answer)
    return 0
