"""``vaneloop diagnose``: which physical effects is the model missing?"""

from __future__ import annotations

import argparse
from typing import Any

from vaneloop.base import terminal
from vaneloop.base.errors import InputError
from vaneloop.cli import explain, options, own_model
from vaneloop.cli.chains import chain_of
from vaneloop.cli.options import add_machine_options
from vaneloop.pages.story import CANNOT, UNKNOWN, doubt, since, sizes, word
from vaneloop.verbs.search import diagnosed, not_given

__all__ = ["DESCRIPTION", "add_options", "command", "show"]

DESCRIPTION = """Find the physical effects that the model lacks, from a log.

Every subsystem of the machine (demand, servo, engine, actuator, linkage) is driven by its own logged inputs. Each
effect of the library is fitted, the leaders in pairs. An effect that improves the fit to held-out data is accepted. It
is reported with its probability, its parameters and the rivals that this log cannot distinguish from it. Where the
library does not suffice the answer is "unknown", with the shape of the remaining error.

examples:
  vaneloop diagnose examples/hidden_effect.parquet --report diagnosis.html
  vaneloop diagnose examples/hidden_effect.parquet --explain
  vaneloop extend examples/hidden_effect.parquet --effect valve_dead_band --out with_dead_band.toml
  vaneloop diagnose examples/hidden_effect.parquet --model with_dead_band.toml --json -

exit codes: 0 nothing is missing, 1 something is missing or unknown, 2 bad input"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    options.add_log_options(parser)
    add_machine_options(parser)
    options.add_controller_options(parser)
    parser.add_argument(
        "--workers", type=int, default=2, metavar="N", help="subsystems searched in parallel (default 2)"
    )
    options.add_without_option(parser)
    explain.add_option(parser)
    own_model.add_options(parser)
    terminal.add_output_options(parser, report=True)


@options.guarded
def command(args: argparse.Namespace) -> int:
    """Run from parsed options; return the exit code."""
    if not 1 <= args.workers <= 64:
        raise InputError(f"--workers (={args.workers}) must be in [1, 64]")
    if own_model.asked(args):
        with terminal.progress_bar(args, "searching laws at all places") as progress:
            answer = own_model.ask(args, "diagnose", without=args.without, progress=progress)
    else:
        chain = not_given(chain_of(args), args.without)
        with options.search_bar(args) as news:
            answer = diagnosed(chain, args.log, args.workers, news=news)
    show(args, answer)
    explain.show(args, {s.stage: (s.decisions, s.final.effects) for s in answer.diagnosis.stages})
    options.answered(args, "diagnose", answer)
    return 0 if answer.verdict == "none" else 1


def show(args: argparse.Namespace, answer: Any) -> None:
    """Print the verdict, the stages and the effects."""
    d = answer.diagnosis
    rows = []
    for s in d.stages:
        for k in range(len(s.floor)):
            figures = [f"{v:.4g}" for v in (s.error_before[k], s.error_after[k], s.floor[k])]
            rows.append([s.stage, word(s), s.outputs[k], *figures, s.units[k]])
    for name, why in d.not_observed.items():
        rows.append([name, CANNOT, why, "-", "-", "-", ""])
    columns = ["subsystem", "verdict", "signal", "error before", "error after", "noise floor", "unit"]
    if answer.by_log is not None:
        own_model.show(args, answer.by_log)
    else:
        terminal.notes(args, d.notes[len(answer.bound.notes) :])
    terminal.print_table(args, f"searched in {d.elapsed_s:.1f} s; errors are RMS on held-out data", columns, rows)
    options.say_tested(args, answer.tested)
    for s in d.stages:
        for f in s.effects:
            more = "".join(f"; {said}" for said in (since(s), doubt(f)) if said)
            terminal.say(args, f"missing in {s.stage}: {f.effect} ({100 * f.probability:.0f} %): {sizes(f)}{more}")
        for x in d.shapes.get(s.stage, []):
            terminal.say(args, f"{UNKNOWN if s.verdict == 'unknown' else 'left'} in {s.stage}: {x.text}")
        if s.verdict == "unknown" and (s.nearest or s.refused):
            nearest = ", ".join(s.nearest) or "none"
            terminal.say(args, f"{UNKNOWN} in {s.stage}, nearest: {nearest}{''.join(f'; {why}' for why in s.refused)}")
    terminal.say(args, answer.sentence())
