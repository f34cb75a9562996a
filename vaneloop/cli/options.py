"""Options that several commands share, and what they stand for: a log and how to read it, tables, a model file,
stages.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from typing import Any

from hil.logs import read_log
from hil.logs.columns import warm_up
from hil.logs.formats import OURS, is_framed, listed
from hil.native.isolation import ControllerFailed, isolated
from vaneloop.base import terminal
from vaneloop.base.errors import InputError
from vaneloop.verbs.machine import TABLES, Machine, files_of

__all__ = [
    "A_LOG", "add_channels_option", "add_controller_options", "add_log_options", "add_machine_options",
    "add_plant_option", "add_reading_options", "add_tables_option", "add_trust_option", "add_without_option",
    "answered", "guarded", "log_options", "machine_of", "parts_to_test", "read_log_of", "say_located", "say_tested",
    "search_bar", "tables_of", "trusted", "warm_up_for",
]  # fmt: skip

A_LOG = f"{listed(OURS)}, or the format of a package (docs/logs.md)"


def add_machine_options(parser: Any) -> None:
    """Declare ``--model``, ``--tables`` and ``--plant``: the machine that a command is about (`machine_of`)."""
    parser.add_argument(
        "--model",
        metavar="M.toml",
        help="model file: changed parameters and added effects (written by vaneloop extend)",
    )
    add_tables_option(parser)


@contextmanager
def search_bar(args: argparse.Namespace) -> Iterator[Callable[[Any], None] | None]:
    """A bar of the search of the library, as `terminal.progress_bar` draws one, for the search's ``news``."""
    with terminal.progress_bar(args, "searching the library of effects") as progress:
        yield progress and (lambda n: progress(n.fraction, n.text))


def parts_to_test(args: argparse.Namespace) -> list[str]:
    """What ``--test`` names: parts of the log; with ``--system`` also logs."""
    return [name for group in getattr(args, "test", ()) for name in group]


def answered(args: argparse.Namespace, name: str, answer: Any) -> None:
    """Write the JSON and the page of an answer that the command ``name`` gives, where they are asked for."""
    terminal.write_json(args, answer.to_dict())
    if args.report:
        terminal.say(args, f"page: {answer.report(args.report, terminal.typed(name))}")


def say_tested(args: argparse.Namespace, rows: Any) -> None:
    """Print the errors on the part of the log that nothing was fitted to (`vaneloop.verbs.parts.Tested`)."""
    if rows:
        columns = ["subsystem", "signal", "error before", "error after", "noise floor", "unit", "samples"]
        figures = [[f"{v:.4g}" for v in (r.error_before, r.error_after, r.noise_floor)] for r in rows]
        lines = [[r.stage, r.signal, *three, r.unit, f"{r.samples:,}"] for r, three in zip(rows, figures, strict=True)]
        terminal.print_table(args, "RMS error on the part that nothing was fitted to", columns, lines)


def say_located(args: argparse.Namespace, located: Any) -> None:
    """Print where a stage (`identification.regimes.Located`) fails, under four conditions at most."""
    terminal.say(args, f"{located.stage}: {located.verdict()}")
    if located.onset is not None:
        terminal.say(args, f"  begins at t = {located.onset:.0f} s")
    for r in located.hot[:4]:
        terminal.say(args, f"  {r.worst()}")


def add_log_options(parser: argparse.ArgumentParser) -> None:
    """Options that say how to read a log: the same for every command that takes one."""
    parser.add_argument("log", metavar="LOG", help=f"a log: {A_LOG}")
    add_reading_options(parser.add_argument_group("reading the log (docs/logs.md)"))


def add_reading_options(group: argparse._ArgumentGroup) -> None:
    """Options that say which name and unit a log uses."""
    group.add_argument("--dbc", metavar="F", help="database of a CAN log (default: the product's own vgv.dbc)")
    group.add_argument(
        "--map",
        metavar="NAME=signal",
        action="append",
        default=[],
        help="the log's NAME is our signal, e.g. ENGINE_RPM=n_dem",
    )
    group.add_argument(
        "--unit", metavar="signal=unit", action="append", default=[], help="unit in the log, e.g. n_dem=rpm"
    )
    group.add_argument(
        "--design-rpm", metavar="R", type=float, help="rotor speed that is 100 %%; needed for speeds in rpm"
    )
    group.add_argument("--mapping", metavar="F.toml", help="mapping file of the bench, written by vaneloop map --out")
    group.add_argument(
        "--no-guess", action="store_true", help="guess no name and no unit that neither the log nor an option states"
    )
    group.add_argument(
        "--part", metavar="N", type=int, help="the run to read, from 1, of a table in which the header stands again"
    )


def add_tables_option(group: Any, plant: bool = True) -> None:
    """Declare ``--tables``, and ``--plant`` where that counts."""
    group.add_argument(
        "--tables",
        metavar="DIR",
        help=f"folder whose {', '.join(TABLES)} (.toml, any of them) replace the shipped ones; vaneloop schedule "
        f"--out writes one",
    )
    if plant:
        add_plant_option(group)


def add_trust_option(group: Any, whose: str) -> None:
    """Declare ``--trust``; the command asks with `trusted`."""
    group.add_argument(
        "--trust", action="store_true", help=f"run the code that {whose} brings (own model, own controller), unasked"
    )


def trusted(args: argparse.Namespace, source: str, code: Sequence[str]) -> None:
    """Ask whether code may run that data name: files of ``source``. Raises InputError where nobody says that it may."""
    if not code or args.trust:
        return
    text = terminal.clean(f"{source}: names code that would run here with your rights: {', '.join(code)}")
    if not terminal.is_terminal(sys.stdin) or terminal.input_of(sys.stdin) is None:
        raise InputError(f"{text}; --trust says that it may")
    print(f"{text}\nRun it? [y/N] ", end="", file=sys.stderr, flush=True)
    if sys.stdin.readline().strip().lower() not in ("y", "yes"):
        raise InputError(f"{source}: its code was not run")


def add_without_option(parser: Any) -> None:
    """Declare ``--without``: laws that are not looked for."""
    parser.add_argument(
        "--without", metavar="EFFECT", nargs="+", default=[],
        help="effects that are not looked for, such as those that this machine cannot have",
    )  # fmt: skip


def add_plant_option(group: Any) -> None:
    """Declare ``--plant``."""
    group.add_argument(
        "--plant",
        metavar="F.toml",
        help="plant table of another machine: a file, or plant_electromechanical.toml or plant_two_actuators.toml, "
        "which ship (docs/machines.md)",
    )


def add_channels_option(group: Any) -> None:
    """Declare ``--channels``."""
    group.add_argument(
        "--channels",
        metavar="N",
        type=int,
        choices=(1, 2),
        help="channels of the controller, 1 or 2, in place of what calibration.toml has; two need a machine with two "
        "actuators (docs/channels.md)",
    )


def add_controller_options(parser: Any, save_crash: bool = True) -> None:
    """Declare ``--controller`` and ``--save-crash``; the command's function must be `guarded`."""
    group = parser.add_argument_group("a controller of your own (docs/own_controller.md)")
    group.add_argument(
        "--controller",
        metavar="PATH.so",
        help="run this shared library in place of the firmware; vaneloop new-controller writes one to begin with",
    )
    if not save_crash:
        return
    group.add_argument(
        "--save-crash",
        metavar="F.parquet",
        help="where the controller fails, keep its inputs of every tick: vaneloop replay F.parquet --controller "
        "PATH.so runs to the same failure",
    )


def guarded(command: Callable[[argparse.Namespace], int]) -> Callable[[argparse.Namespace], int]:
    """Run a command with ``--controller`` in a process of its own: where the controller fails, one line says how, and
    the exit code is 1.
    """

    @wraps(command)
    def run(args: argparse.Namespace) -> int:
        if args.controller is None:
            if args.save_crash is not None:
                raise InputError(
                    f"--save-crash {args.save_crash}: needs --controller; the firmware here does not crash"
                )
            return command(args)
        if args.save_crash is not None and not args.save_crash.endswith(".parquet"):
            raise InputError(f"--save-crash {args.save_crash}: must end with .parquet")
        try:
            return isolated(lambda: command(args), args.save_crash)
        except ControllerFailed as e:
            print(f"vaneloop: {e}", file=sys.stderr)
            return 1

    return run


def tables_of(args: argparse.Namespace, tell: bool = False) -> dict[str, str]:
    """File of each table, by name without suffix: from the folder ``--tables`` or the shipped one; ``tell`` says
    which.
    """
    tables, plant = getattr(args, "tables", None), getattr(args, "plant", None)
    files = files_of(tables, plant)
    if tell and tables is not None:
        own = [name for name, file in files.items() if file != f"{name}.toml"]
        terminal.say(args, f"tables from {Path(tables)}: {', '.join(own)}")
    if tell and plant is not None:
        terminal.say(args, f"plant: {plant}")
    return files


def machine_of(args: argparse.Namespace, model: Any = None, strategy: str | None = None) -> Machine:
    """The machine that ``--tables`` and ``model`` (default: ``--model``) describe."""
    named = getattr(args, "model", None) or None
    return Machine(
        getattr(args, "tables", None),
        named if model is None else model,
        strategy,
        getattr(args, "plant", None),
        getattr(args, "controller", None),
        getattr(args, "channels", None),
    )


def _mapping(options: list[str]) -> dict[str, str]:
    """``--map`` as name in the log -> signal; where a name serves several signals, signal -> name for all but the
    first.
    """
    out: dict[str, str] = {}
    for option in options:
        for name, signal in terminal.pairs([option], "map").items():
            pair = (name, signal) if out.get(name, signal) == signal else (signal, name)
            if out.setdefault(*pair) != pair[1]:
                terminal.pairs([f"{pair[0]}={out[pair[0]]}", "=".join(pair)], "map")  # says so
    return out


def log_options(args: argparse.Namespace, source: str | None = None) -> dict[str, Any]:
    """What the reading options say, as arguments of `hil.logs.read_log`; ``source`` is the file that they are for
    (default: the log).

    Raises InputError for options without a file to read.
    """
    given = {"--dbc": args.dbc, "--map": args.map, "--unit": args.unit, "--design-rpm": args.design_rpm,
             "--mapping": args.mapping, "--no-guess": args.no_guess or None, "--part": args.part}  # fmt: skip
    if (source or args.log) is None and (idle := next((k for k, v in given.items() if v not in (None, [])), None)):
        raise InputError(f"{idle} says how to read a log, but none is given (--log LOG)")
    return {
        "dbc": args.dbc,
        "mapping": _mapping(args.map),
        "units": terminal.pairs(args.unit, "unit"),
        "design_rpm": args.design_rpm,
        "guess": not args.no_guess,
        "mapping_file": args.mapping,
        **({"part": args.part} if args.part else {}),
        **({"tables": files_of(args.tables)} if getattr(args, "tables", None) else {}),
    }


def read_log_of(args: argparse.Namespace, require: tuple[str, ...] = ("n_dem",)) -> Any:
    """Read the log that ``args`` name; tell before code is compiled for it."""
    options = log_options(args)
    warm_up_for(args)
    return read_log(args.log, **options, require=require)


def warm_up_for(args: argparse.Namespace) -> None:
    """Compile what cuts signals out of frames, and say so, where the log holds frames."""
    if is_framed(Path(str(args.log))):
        warm_up(lambda text: terminal.say(args, text))
