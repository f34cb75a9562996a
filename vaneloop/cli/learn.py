"""``vaneloop learn``: a law that nobody listed, from logs."""

from __future__ import annotations

import argparse
from typing import Any

from vaneloop.base import terminal
from vaneloop.base.files import check
from vaneloop.base.signals import heading
from vaneloop.cli import explain, options, own_model
from vaneloop.cli.chains import chain_of
from vaneloop.verbs.learn import checked_shape, learned, with_path
from vaneloop.verbs.search import not_given

__all__ = ["DESCRIPTION", "add_options", "command"]

DESCRIPTION = """Learn a law that the library does not have, of the vane chain or of a model of your own.

Where diagnose says "unknown", learn looks for the law itself: at every place of the model, as a function of every
quantity that the logs or the model have. It reports where the law acts, its quantity, its curve with a band, and the
simplest formulas that fit it. A law is accepted if it improves the fit to held-out data, degrades no validation log,
and does clearly better than the laws of the library. If no law is accepted, the answer is "unknown". docs/learn.md

examples:
  vaneloop learn LOG --fit :200 --test 200: --out LAW.toml --report LAW.html
  vaneloop learn LOG --test OTHER --system MY.py --out LAW.toml --report LAW.html
  vaneloop extend NEW --system MY.py --effect LAW.toml --out BETTER.toml
  vaneloop compare NEW --system MY.py --model BETTER.toml

exit codes: 0 nothing is missing, or laws of the library explain it; 1 a law was learned, or something is missing
and no law was accepted; 2 bad input"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    options.add_log_options(parser)
    options.add_machine_options(parser)
    options.add_controller_options(parser)
    parser.add_argument("--out", metavar="LAW.toml", help="law file to write, a model file with the learned laws in it")
    options.add_without_option(parser)
    parser.add_argument(
        "--python", metavar="LAW.py", help="write the first law as a Python file, too: of a model of your own as a Law"
    )
    parser.add_argument(
        "--shape", nargs="+", default=[], metavar="SHAPE",
        help="what you know of every curve: zero (nothing where its quantity is 0), odd (same with the other sign), "
        "rising, falling; zero may stand beside another",
    )  # fmt: skip
    parser.add_argument(
        "--curve", action="store_true",
        help="the law is the curve, even where a formula does as well",
    )  # fmt: skip
    explain.add_option(parser)
    own_model.add_options(parser)
    terminal.add_output_options(parser, report=True)
    parser.set_defaults(learns=True)


@options.guarded
def command(args: argparse.Namespace) -> int:
    """Run from parsed options; return the exit code."""
    for path in filter(None, (args.out, args.python)):
        check(path)
    checked_shape(args.shape)
    own, asked = own_model.asked(args), {"shape": args.shape, "formulas": not args.curve}
    chain: Any = None if own else not_given(chain_of(args, alone="learning"), args.without)
    with terminal.progress_bar(args, "learning an unmodelled law") as tell:
        if own:
            answer = own_model.ask(args, "learn", without=args.without, **asked, progress=tell)
        else:
            answer = learned(chain, args.log, options.machine_of(args).added, progress=tell, **asked)
    if answer.model is not None and args.out:
        answer = with_path(answer, args.out, terminal.typed("learn"))
    if answer.by_log is not None:
        own_model.show(args, answer.by_log)
    for law in answer.laws:
        rows = [
            [f"{law.x[k]:.4g}", *(f"{v[k]:.4g}" for v in (law.y, law.low, law.high))] for k in range(0, len(law.x), 32)
        ]
        columns = [heading(law.of, law.of_unit), heading("curve", law.unit), "90 % from", "to"]
        terminal.print_table(args, f"{law.name}", columns, rows)
        for f in law.formulas:
            name = f", {f.law} of the library" if f.law else ""
            terminal.say(args, f"formula: {f.text}{name}; held-out error {f.error:.3g} noise floors")
    terminal.notes(args, answer.notes)
    if answer.outcome.nearest and not answer.laws:
        terminal.say(args, f"nearest: {', '.join(answer.outcome.nearest)}")
    explain.show(args, answer.explained)
    terminal.say(args, answer.sentence())
    if answer.path:
        terminal.say(args, f"law: {answer.path}")
    options.answered(args, "learn", answer)
    if args.python and answer.laws:
        answer.write_python(args.python, own_model.system_of(args) if own else None)
        terminal.say(args, f"law in Python: {args.python}")
    return 1 if answer.verdict in ("learned", "unknown") else 0
