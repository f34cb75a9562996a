"""``vaneloop compare|locate|diagnose|extend --system my_model.py``: the four verbs on a user's own model."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from vaneloop.base import terminal
from vaneloop.cli import options

__all__ = ["add_options", "asked", "command"]


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options of a user's own model."""
    group = parser.add_argument_group("a model of your own (docs/your_own_model.md)")
    group.add_argument(
        "--system", metavar="MY.py", help="Python file with a discrepancy.System in it, instead of the vane chain"
    )
    group.add_argument(
        "--also", metavar="LOG", action="append", nargs="+", default=[], help="further logs to fit, with --system"
    )
    group.add_argument(
        "--test",
        metavar="LOG",
        action="append",
        nargs="+",
        default=[],
        help="logs that nothing is fitted to, with --system",
    )


def asked(args: argparse.Namespace) -> bool:
    """Whether the user brought a model; refuses options that only then make sense."""
    from vaneloop.base.errors import InputError

    if not args.system:
        for name in ("also", "test"):
            if getattr(args, name):
                raise InputError(f"--{name} needs --system MY.py")
        return False
    for name in ("strategy", "tolerance", "tables", "out"):
        if getattr(args, name, None) and not (name == "out" and hasattr(args, "effect")):
            raise InputError(f"--{name} does not go with --system")
    return True


def _record(args: argparse.Namespace, system: Any, path: str) -> Any:
    """One log as the system wants it: by its own reader, or by ours."""
    from vaneloop.verbs.search import read_record

    record, notes = read_record(path, system, **({} if system.read else options.log_options(args)))
    for note in notes:
        terminal.say(args, f"note: {note}")
    return record


def command(args: argparse.Namespace, verb: str) -> int:
    """Run ``verb`` on the user's model; return the exit code."""
    from vaneloop.base.errors import InputError
    from vaneloop.discrepancy import StageError, load_system

    try:
        return _command(args, verb, load_system(args.system))
    except StageError as e:
        raise InputError(str(e)) from None


def _command(args: argparse.Namespace, verb: str, system: Any) -> int:
    from vaneloop.base.errors import InputError
    from vaneloop.base.tables import load_toml
    from vaneloop.discrepancy.locate import agrees
    from vaneloop.discrepancy.models import own_model
    from vaneloop.discrepancy.workflow import no_better
    from vaneloop.verbs.search import OwnAnswer

    wanted: list[str] = []
    if verb == "extend":
        wanted = list(dict.fromkeys(e for group in args.effect for e in group))
        if not wanted:
            raise InputError("extend needs at least one --effect NAME; vaneloop diagnose names candidates")
        out = Path(args.out)
        if out.is_dir() or not out.parent.is_dir():
            raise InputError(
                f"{args.out}: cannot be written ({'it is a folder' if out.is_dir() else f'no folder {out.parent}'})"
            )
    if args.model:
        load_toml(args.model)  # refuses what would take the parser gigabytes
    model = own_model.load_model(args.model, system) if args.model else None
    logs = [_record(args, system, p) for p in [args.log, *(p for group in args.also for p in group)]]
    test = [_record(args, system, p) for group in args.test for p in group]
    if verb == "compare":
        answer = own_model.compare(system, logs, test, model)
    elif verb == "locate":
        answer = own_model.locate(system, logs, test, model)
    elif verb == "diagnose":
        with terminal.progress_bar(args, "searching laws at all places") as progress:
            answer = own_model.diagnose(system, logs, test, model, progress)
    else:
        answer = own_model.extend(system, logs, wanted, test, model)
    if verb == "extend" and (text := no_better(answer.diagnosis)):
        print(f"vaneloop extend: {args.log}: {text}; {args.out} is not written", file=sys.stderr)
        return 1
    _show(args, verb, answer)
    more: dict[str, Any] = {}
    words = " ".join([f"vaneloop {verb}", *sys.argv[2:]])
    if verb == "extend":
        answer.model.history.append(words)
        own_model.write_model(args.out, answer.model)
        terminal.say(args, f"model: {args.out}")
        more = {"model": args.out}
    shown = OwnAnswer(answer, args.log, more)
    terminal.write_json(args, shown.to_dict())
    if args.report:
        terminal.say(args, f"page: {shown.report(args.report, words)}")
    if verb == "compare":
        return 0
    if verb == "locate":
        return 1 if answer.located.fails else 0
    d = answer.diagnosis
    if verb == "extend":
        return 0 if all(map(agrees, d.error_after, d.floor)) else 1
    return 0 if d.verdict == "none" else 1


def _show(args: argparse.Namespace, verb: str, answer: Any) -> None:
    """Print the answer."""
    import numpy as np

    from vaneloop.cli.options import say_located
    from vaneloop.pages.own_model import short_names

    d = answer.diagnosis
    for note in answer.notes:
        terminal.say(args, f"note: {note}")
    steps = list(answer.logs)
    rows = []
    fitted = set(answer.bound.logs)
    short = short_names(list(answer.logs[steps[0]]))
    for log in answer.logs[steps[0]]:
        for k, output in enumerate(d.outputs):
            figures = [f"{answer.logs[s][log][k]:.4g}" for s in steps]
            relative = f"{100 * answer.logs[steps[-1]][log][k] / answer._size(log, k):.3g} %"
            rows.append([short[log], "fitted" if log in fitted else "test", output, *figures, relative, d.units[k]])
    together = answer.together()
    for what, bound in (("fitted", answer.bound), ("test", answer.test)):
        if bound is not None and len(bound.logs) > 1:
            for k, output in enumerate(d.outputs):
                figures = [f"{together[s][what][k]:.4g}" for s in steps]
                relative = (
                    100 * together[steps[-1]][what][k] / (float(np.sqrt(np.nanmean(bound.measured[k] ** 2))) or 1.0)
                )
                rows.append(
                    [f"all {len(bound.logs)} together", what, output, *figures, f"{relative:.3g} %", d.units[k]]
                )
    heads = ["model", *(f"+ {s.split(' + ')[-1]}" for s in steps[1:])]
    terminal.print_table(
        args, f"RMS error log by log ({answer.elapsed_s:.1f} s)", ["log", "", "signal", *heads, "of RMS", "unit"], rows
    )
    if verb in ("compare", "locate"):
        if verb == "locate":
            say_located(args, answer.located, 6)
        return
    for p in answer.parameters():
        terminal.say(
            args, f"parameter {p['parameter']}: {p['value']:.5g} [{p['low']:.5g}, {p['high']:.5g}] {p['unit']}"
        )
    for f in d.effects:
        values = ", ".join(
            f"{n} {p['value']:.4g} [{p['low']:.4g}, {p['high']:.4g}] {p['unit']}" for n, p in f.parameters.items()
        )
        rivals = f"; as good: {', '.join(f.rivals)}" if f.rivals else ""
        terminal.say(args, f"missing: {f.effect} ({100 * f.probability:.0f} %): {values}{rivals}")
    terminal.say(args, answer.sentence())
