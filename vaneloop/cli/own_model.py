"""The options of a model of one's own, and what compare, locate, diagnose and extend print of it: each log apart."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any

from plant import Model
from vaneloop.base import terminal
from vaneloop.base.errors import InputError
from vaneloop.base.spans import is_span
from vaneloop.cli import options
from vaneloop.identification import StageError, System, load_system
from vaneloop.identification.user_models.by_log import load_model_of
from vaneloop.pages.by_log import heads, short_names
from vaneloop.pages.story import sized
from vaneloop.verbs import learn, search
from vaneloop.verbs.parts import split
from vaneloop.verbs.search import read_record

__all__ = ["add_options", "ask", "asked", "logs_of", "show", "system_of"]


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options of a user's own model."""
    group = parser.add_argument_group("a model of your own (docs/your_own_model.md)")
    group.add_argument(
        "--system", metavar="MY.py", help="Python file with a vaneloop.System in it, instead of the vane chain"
    )
    group.add_argument(
        "--also", metavar="LOG", action="append", nargs="+", default=[], help="further logs to fit, with --system"
    )
    parts = parser.add_argument_group("which part of the log is fitted")
    parts.add_argument(
        "--fit",
        metavar="FROM:TO",
        action="append",
        nargs="+",
        default=[],
        help="seconds of the log that are fitted, such as 0:200 or :200 (default: all); may be given again",
    )
    parts.add_argument(
        "--test",
        metavar="FROM:TO|LOG",
        action="append",
        nargs="+",
        default=[],
        help="seconds of it that nothing is fitted to, such as 200:; with --system also other logs",
    )


def asked(args: argparse.Namespace) -> bool:
    """Whether the user brought a model; refuses options that only then make sense."""
    if not args.system:
        logs = [name for name in options.parts_to_test(args) if not is_span(name)]
        for name, given in (("also", args.also), ("test", logs)):
            if given:
                what = f" {logs[0]}" if name == "test" else ""
                raise InputError(f"--{name}{what} needs --system MY.py")
        return False
    for name in ("strategy", "tolerance", "tables", "out"):
        model_file = name == "out" and any(hasattr(args, x) for x in ("effect", "learns", "limit"))
        if getattr(args, name, None) and not model_file:
            raise InputError(f"--{name} does not go with --system")
    return True


def system_of(args: argparse.Namespace) -> Any:
    """The user's model."""
    return load_system(args.system)


def ask(args: argparse.Namespace, verb: str, **more: Any) -> Any:
    """Ask ``verb`` of `vaneloop.verbs` of the user's model on the logs that ``args`` name; return its answer."""
    ask_it: Callable[..., Any] = learn.learn if verb == "learn" else getattr(search, verb)
    try:
        system = load_system(args.system)
        added = load_model_of(args.model, system) if args.model else None
        for path in [e for e in more.get("effects", ()) if e.endswith(".toml")]:  # laws that were learned
            law = load_model_of(path, system)
            if not law.curves:
                raise InputError(f"--effect {path}: has no table curves; allowed: a law file of vaneloop learn")
            before = added or Model(meta=law.meta)
            added = before.model_copy(update={"curves": {**before.curves, **law.curves}})
            own = [n for n in law.effects if n not in before.effects]  # and the laws of the library beside them
            more["effects"] = [n for e in more["effects"] for n in (own if e == path else [e])]
        logs, fit, test = logs_of(args, system)
        return ask_it(logs, model=system, fit=fit, test=test, added=added, **more)
    except StageError as e:
        raise InputError(str(e)) from None


def logs_of(args: argparse.Namespace, system: System) -> tuple[list[Any], list[Any], list[Any]]:
    """The logs that ``args`` name, the parts of the first that are fitted, and what is to test: parts and logs."""
    logs = [_record(args, system, p) for p in [args.log, *(p for group in args.also for p in group)]]
    fit, parts, others = split([x for group in args.fit for x in group], options.parts_to_test(args))
    return logs, fit, [*parts, *(_record(args, system, p) for p in others)]


def _record(args: argparse.Namespace, system: Any, path: str) -> Any:
    """One log as the system wants it: by its own reader, or by ours."""
    record, notes = read_record(path, system, **({} if system.read else options.log_options(args)))
    terminal.notes(args, notes)
    return record


def show(args: argparse.Namespace, by_log: Any) -> None:
    """Print what is to note, each log's error after each step, and the model's own parameters."""
    d = by_log.d
    said = {n for logs in (by_log.logs.fitted, by_log.logs.test) if logs for r in logs.data.records for n in r.notes}
    terminal.notes(args, (n for n in by_log.notes if n not in said))  # those were said when the log was read
    short = short_names(list(next(iter(by_log.steps.values()))))
    rows = []
    for log, what, k, errors, size in by_log.rows():
        share = f"{100.0 * errors[-1] / size:.3g} %"
        rows.append([short.get(log, log), what, d.outputs[k], *(f"{e:.4g}" for e in errors), share, d.units[k]])
    columns = ["log", "", "signal", *heads(by_log), "of RMS", "unit"]
    terminal.print_table(args, "RMS error log by log", columns, rows)
    for p in by_log.parameters() if d.steps[1:] else ():
        terminal.say(args, f"parameter {sized(str(p['parameter']) + ':', p)}")
