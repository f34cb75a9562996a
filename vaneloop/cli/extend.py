"""``vaneloop extend``: add effects to the model, fit them to a log, write the model file."""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace

from plant import Model
from vaneloop.base import terminal
from vaneloop.base.errors import InputError
from vaneloop.base.files import check
from vaneloop.cli import options, own_model
from vaneloop.cli.chains import chain_of
from vaneloop.pages.story import falling, floors, since, sizes, word
from vaneloop.verbs.machine import with_law_files
from vaneloop.verbs.search import extended, known

__all__ = ["DESCRIPTION", "add_options", "command"]

DESCRIPTION = """Add physical effects to the model, fit their parameters to a log, and write a model file that every
command takes with --model.

Effects that --model contains are refitted together with the new ones. Errors before and after are on data that
the parameters were not fitted to, beside the noise floor that no model can undercut.

examples:
  vaneloop extend examples/hidden_effect.parquet --effect valve_dead_band --out with_dead_band.toml
  vaneloop extend examples/hidden_effect.parquet --model with_dead_band.toml --effect aero_load --out both.toml

exit codes: 0 each subsystem extended is at its noise floor (within 10 %), 1 an error remains, or the effects
bring the model no nearer to the log (nothing is written then), 2 bad input"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    options.add_log_options(parser)
    options.add_machine_options(parser)
    options.add_controller_options(parser)
    parser.add_argument(
        "--effect", metavar="NAME", action="append", nargs="+", default=[], help="effect to add (docs/effects.md)"
    )
    parser.add_argument("--out", metavar="M2.toml", required=True, help="model file to write")
    own_model.add_options(parser)
    terminal.add_output_options(parser, report=True)


@options.guarded
def command(args: argparse.Namespace) -> int:
    """Run from parsed options; return the exit code."""
    wanted = list(dict.fromkeys(e for group in args.effect for e in group))
    if not wanted:
        raise InputError("extend needs at least one --effect NAME; vaneloop diagnose names candidates")
    check(args.out)
    if own_model.asked(args):
        answer = own_model.ask(args, "extend", effects=wanted)
    else:
        machine = options.machine_of(args)
        wanted, added = with_law_files(wanted, machine)
        known([e for e in wanted if e not in added.curves])
        answer = extended(chain_of(args, Model()), wanted, added, args.log)
    if answer.refused:
        print(f"vaneloop extend: {args.log}: {answer.refused}; {args.out} is not written", file=sys.stderr)
        return 1
    answer = replace(answer, model=answer.model.noted(terminal.typed("extend")), path=args.out)
    answer.write(args.out)
    results = answer.diagnosis.stages
    if answer.by_log is not None:
        own_model.show(args, answer.by_log)
    else:
        terminal.notes(args, answer.diagnosis.notes[len(answer.bound.notes) :])
    rows = []
    for r in results:
        for k in range(len(r.floor)):
            figures = [f"{v:.4g}" for v in (r.error_before[k], r.error_after[k], r.floor[k])]
            rows.append(
                [r.stage, word(r, True), r.outputs[k], *figures, floors(r.error_after[k] / r.floor[k]), r.units[k]]
            )
    columns = ["subsystem", "verdict", "signal", "error before", "error after", "noise floor", "after / floor", "unit"]
    terminal.print_table(args, "errors are RMS on held-out data", columns, rows)
    options.say_tested(args, answer.tested)
    for r in results:
        for f in r.effects:
            terminal.say(args, "; ".join(filter(None, (f"{f.effect}: {sizes(f)}", since(r)))))
        terminal.say(
            args, f"{r.stage}, in noise floors: " + " -> ".join(f"{name} {floors(level)}" for name, level in falling(r))
        )
    terminal.say(args, answer.sentence())
    terminal.say(args, f"model: {args.out}")
    options.answered(args, "extend", answer)
    return 0 if answer.reached else 1
