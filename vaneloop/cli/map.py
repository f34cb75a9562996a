"""``vaneloop map``: which name of a log is which signal, in which unit, how surely; written down as a mapping file."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path

from hil.logs import read_log, write_log
from hil.logs.formula import named
from hil.logs.mapping import write_mapping
from hil.logs.survey import sparkline, survey
from vaneloop.base import terminal
from vaneloop.base.errors import InputError
from vaneloop.base.signals import UNITS
from vaneloop.base.spans import span_of
from vaneloop.cli import options
from vaneloop.identification import load_system
from vaneloop.verbs.parts import signals_of

__all__ = ["DESCRIPTION", "add_options", "command"]

DESCRIPTION = """Show what is in a log: the name and unit of each signal, stated or guessed, how surely, and how it
looks. Every command that takes the log guesses the same (docs/logs.md). A mapping file keeps what is right: edit it,
and give it to any command with --mapping. Formulas make channels of channels; what is read and made is written as a
log.

examples:
  vaneloop map examples/hidden_effect.parquet
  vaneloop map BENCH.csv --design-rpm 38000 --out bench.toml
  vaneloop replay BENCH.csv --mapping bench.toml
  vaneloop map examples/tank.csv --system examples/tank.py
  vaneloop map examples/hidden_effect.parquet --formula "lag = x_dem - x_lvdt [um]" --between 10:20 --export lag.csv
  vaneloop map --check examples/engine_run.blf   # the same in python-can, cantools, asammdf?

exit codes: 0 the log can be read so, 1 a line says what is missing or another reader finds something else, 2 bad
input"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    options.add_log_options(parser)
    options.add_tables_option(parser, plant=False)
    parser.add_argument(
        "--system", metavar="MY.py", help="Python file with a vaneloop.System in it, whose channels are looked for"
    )
    group = parser.add_argument_group("channels of channels (docs/logs.md#formulas)")
    group.add_argument(
        "--formula", metavar="'NAME = FORMULA [UNIT]'", action="append", default=[],
        help="make a channel, such as 'lag = x_dem - x_lvdt [um]'; a later formula may name it",
    )  # fmt: skip
    group.add_argument(
        "--between", metavar="FROM:TO", help="seconds of the log for --export, such as 10:20 (default: all)"
    )
    group.add_argument(
        "--export", metavar="F",
        help="write the channels that were read and made as a log (.csv, .parquet, .mf4, and without formulas any "
             "format)",
    )  # fmt: skip
    terminal.add_output_options(parser)
    parser.add_argument("--out", metavar="F.toml", help="write the mapping file")
    parser.add_argument(
        "--check", action="store_true", help="compare with what python-can, cantools and asammdf read of the log"
    )


def command(args: argparse.Namespace) -> int:
    """Run from parsed options; return the exit code."""
    reading = options.log_options(args)
    options.warm_up_for(args)
    signals = _signals(args.system)
    formulas = [named(text) for text in args.formula]
    span = span_of(args.between, "--between") if args.between else None
    if span is not None and not args.export:
        raise InputError(f"--between {args.between} needs --export F, the file that holds these seconds")
    seen = survey(args.log, **reading, signals=signals)
    log = None
    if (formulas or args.export) and not seen.complaint:
        log = read_log(args.log, **reading, require=(), signals=signals)
        log = log.assign(**{f.name: f.text for f in formulas})
    rows = [
        [
            r.signal, r.name, r.unit, f"{100 * r.confidence:.0f} %" if r.how == "guessed" else r.how,
            f"{r.low:.4g} to {r.high:.4g}", sparkline(r.curve),
        ]
        for r in seen.rows
    ]  # fmt: skip
    if log is not None:
        for f in formulas:
            c = log[f.name]
            low, high = float(c.values.min()), float(c.values.max())
            unit = "" if c.unit == "-" else c.unit
            rows.append([f.name, f.expression, unit, "formula", f"{low:.4g} to {high:.4g}", sparkline(c.values)])
    terminal.print_table(
        args, f"{args.log}: names known: {len(seen.rows)}, not known: {len(seen.other)}",
        ["signal", "in the log", "unit", "sure", "range", "over time"], rows,
    )  # fmt: skip
    for signal, why in seen.open.items():
        terminal.say(args, f"open: {signal}: {why}")
    for line in seen.unused():
        terminal.say(args, f"not used: {line}")
    for note in seen.notes:
        if "guessed to be" not in note and not any(note.startswith(f"{s}: {w}") for s, w in seen.open.items()):
            terminal.say(args, f"note: {note}")
    if seen.complaint:
        terminal.say(args, f"cannot be read so: {seen.complaint}")
    data, unlike = seen.to_dict(), False
    if args.check:
        from hil.logs.others import compare

        found = compare(args.log, {r.signal: r.name for r in seen.rows if r.signal != "t"}, seen.dbc)
        data["check"] = [c.to_dict() for c in found]
        unlike = any(c.same is False for c in found)
        words = {True: "yes", False: "NO", None: "-"}
        terminal.print_table(
            args, f"{args.log}: read by VaneLoop, and by others", ["what", "VaneLoop", "another", "by", "same"],
            [[c.what, c.ours, c.theirs, c.by, words[c.same]] for c in found],
        )  # fmt: skip
    if log is not None and formulas:
        data["formulas"] = [
            {
                "name": f.name, "formula": f.expression, "unit": log[f.name].unit, "samples": len(log[f.name]),
                "low": float(log[f.name].values.min()), "high": float(log[f.name].values.max()),
            }
            for f in formulas
        ]  # fmt: skip
    terminal.write_json(args, data)
    if log is not None and args.export:
        part = log if span is None else log.within([span])
        write_log(args.export, part.channels)
        terminal.say(args, f"channels: {args.export}")
    if args.out:
        head = f"How VaneLoop reads the logs of this bench (--mapping). From {Path(args.log).name}."
        remarks = {r.signal: f"guessed, {100 * r.confidence:.0f} % sure" for r in seen.rows if r.how == "guessed"}
        write_mapping(args.out, seen.bench(), remarks, head)
        terminal.say(args, f"mapping: {args.out}")
    return 1 if seen.complaint or unlike else 0


def _signals(path: str | None) -> Mapping[str, str]:
    """What is looked for, name -> unit: our signals, or the channels of a model of the user's own."""
    if path is None:
        return UNITS
    system = load_system(path)
    if system.read is not None:
        raise InputError(f"--system {path}: has a read() of its own for its logs; no name is mapped for it")
    return signals_of(system)
