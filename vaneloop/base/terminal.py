"""What every command line of ours shares: one-line errors, exit codes, log options, JSON, progress bar.

Exit codes: 0 good, 1 differs or a limit is exceeded, 2 bad input, 70 a defect of VaneLoop itself.
Only the standard library is imported here, so that help is quick.

Standard input, output and error may be anything (`standard_streams`): closed, a full disk, a pipe that nobody reads any
more, a terminal that answers no question (`is_terminal`, `keyboard`).
"""

from __future__ import annotations

import argparse
import io
import json
import math
import os
import re
import select
import sys
import tempfile
import termios
import traceback
import tty
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NoReturn

from vaneloop.base.errors import InputError, meant
from vaneloop.base.files import write

__all__ = [
    "DEFECT", "Parser", "ReaderGone", "add_output_options", "clean", "compiling", "defect", "input_of", "is_terminal",
    "keyboard", "notes", "number", "pairs", "print_table", "progress_bar", "run", "say", "standard_streams", "start",
    "typed", "write_json",
]  # fmt: skip


is_command = False  # this process is the command that a user typed, and no program that calls it
told_of_compiling = False  # of what is compiled next


class Parser(argparse.ArgumentParser):
    """A parser whose complaint is one line, and which does not guess abbreviated options."""

    def __init__(self, *args: Any, **kwargs: Any):
        kwargs.setdefault("formatter_class", argparse.RawDescriptionHelpFormatter)
        kwargs["allow_abbrev"] = False
        super().__init__(*args, **kwargs)

    def error(self, message: str) -> NoReturn:
        """Print the complaint in one line, with what was probably meant, and exit 2."""
        if (choice := re.search(r"invalid choice: '(.*?)' \(choose from (.*)\)$", message)) is not None:
            message += meant(choice[1], [c.strip(" '") for c in choice[2].split(",")])
        elif message.startswith("unrecognized arguments: "):
            wrong = next((w for w in message.split()[2:] if w.startswith("-")), "")
            message += meant(wrong.partition("=")[0], self._option_string_actions) if wrong else ""
        self.exit(2, f"{self.prog}: {message} ({self.prog} --help explains)\n")


def add_output_options(parser: argparse.ArgumentParser, report: bool = False) -> None:
    """Options that say where results go; ``report``: a page is one of them."""
    group = parser.add_argument_group("output")
    if report:
        group.add_argument("--report", metavar="F.html", help="write a self-contained HTML page with plots")
    group.add_argument("--json", metavar="FILE", help="write the result as JSON; - is standard output")
    group.add_argument("--quiet", action="store_true", help="no text, no progress bar")


def pairs(
    options: list[str], name: str, allowed: Callable[[str], bool] | None = None, known: str = ""
) -> dict[str, str]:
    """Split ``a=b`` options into a dict. Raises InputError for anything else, and for an ``a`` that is given two
    values.
    """
    out: dict[str, str] = {}
    for option in options:
        key, eq, value = option.partition("=")
        if not (eq and key.strip() and value.strip()):
            raise InputError(f"--{name} {option!r} must look like NAME=value")
        if allowed is not None and not allowed(key.strip()):
            near = meant(key.strip(), known.split(", "))
            raise InputError(f"--{name} {option!r}: {key.strip()!r} is not known{near}; allowed: {known}")
        before = out.setdefault(key.strip(), value.strip())
        if before != value.strip():
            raise InputError(f"--{name} {option!r}: {key.strip()!r} has been given {before!r} before; allowed: once")
    return out


def number(text: str) -> float:
    """The number that a text is; NaN where it is none."""
    try:
        return float(text)
    except ValueError:
        return math.nan


_CONTROL = {c: f"\\x{c:02x}" for c in (*range(0x20), *range(0x7F, 0xA0))} | {
    c: f"\\u{c:04x}" for c in (0x061C, 0x200E, 0x200F, *range(0x2028, 0x202F), *range(0x2066, 0x206A))
}


def clean(text: str, lines: bool = False) -> str:
    """Text for a terminal: a control character in it, which may come from a file's name, is shown and does nothing.
    With ``lines``, line ends stay.
    """
    kept = text.split("\n") if lines else [text]
    shown = "\n".join(part.translate(_CONTROL) for part in kept)
    return shown.encode("utf-8", "backslashreplace").decode("utf-8")


def say(args: argparse.Namespace, text: str) -> None:
    """Tell the user something, unless quiet; where JSON goes to standard output, text goes to standard error."""
    global told_of_compiling
    told_of_compiling = told_of_compiling or text.startswith("compiling")
    if not args.quiet:
        print(clean(text, lines=True), file=sys.stderr if args.json == "-" else sys.stdout, flush=True)


def typed(name: str) -> str:
    """The line with which the user asked the command ``name``."""
    return " ".join([f"vaneloop {name}", *sys.argv[2:]])


def notes(args: argparse.Namespace, texts: Iterable[str]) -> None:
    """Tell the user what there is to note, a line each."""
    for text in texts:
        say(args, f"note: {text}")


def compiling() -> None:
    """Tell the user of a command that something is being compiled, where nothing else has told it."""
    if is_command and not told_of_compiling and "--quiet" not in sys.argv:
        print("vaneloop: compiling what has not run on this machine before (once, it is kept) ...", file=sys.stderr)


def print_table(args: argparse.Namespace, title: str, columns: list[str], rows: list[list[str]]) -> None:
    """Print rows of text as a table, numbers to the right."""
    if args.quiet:
        return
    from rich import box
    from rich.console import Console
    from rich.table import Table

    say(args, title)
    table = Table(box=box.SIMPLE_HEAD)
    for i, c in enumerate(columns):
        cells = [clean(r[i], lines=True) for r in rows]
        text = i == 0 or max(map(len, cells), default=0) > 30 or not any(ch.isdigit() for ch in "".join(cells))
        table.add_column(c, justify="left" if text else "right", overflow="fold")
    for r in rows:
        table.add_row(*(clean(cell) for cell in r))
    console = Console(
        file=sys.stderr if args.json == "-" else sys.stdout,
        soft_wrap=False,
        width=None if is_terminal(sys.stdout) else 150,
        markup=False,
    )
    console.print(table)


def write_json(args: argparse.Namespace, data: dict[str, Any]) -> None:
    """Write ``data`` where ``--json`` says; NaN and infinity become null."""
    if not args.json:
        return
    text = json.dumps(plain(data), indent=2, allow_nan=False)
    if args.json == "-":
        print(text, flush=True)
        return
    write(args.json, text + "\n")


def plain(v: Any) -> Any:
    """Turn numpy values into what JSON knows; NaN and infinity become None."""
    if isinstance(v, dict):
        return {str(k): plain(x) for k, x in v.items()}
    if isinstance(v, list | tuple):
        return [plain(x) for x in v]
    if isinstance(v, str | bool | int | type(None)):
        return v
    if hasattr(v, "item") and getattr(v, "ndim", 1) == 0:
        return plain(v.item())
    if hasattr(v, "tolist"):
        return plain(v.tolist())
    f = float(v)
    return f if f - f == 0.0 else None


@contextmanager
def progress_bar(args: argparse.Namespace, text: str) -> Iterator[Callable[..., None] | None]:
    """Give a function that takes the fraction done, and what is being done where that changes; nothing is drawn when
    quiet or when standard error is no terminal.
    """
    if args.quiet or not is_terminal(sys.stderr):
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(text, total=1.0)
        yield lambda fraction, now=text: bar.update(task, completed=fraction, description=now)


DEFECT = 70  # exit code of sysexits.h for an internal error


def start(prog: str, load: Callable[[], Any], argv: list[str] | None = None) -> int:
    """Run a command from its words; return the exit code. ``load`` returns its module: DESCRIPTION, ``add_options``,
    ``command``.
    """

    def command() -> int:
        module = load()
        parser = Parser(prog=prog, description=module.DESCRIPTION)
        module.add_options(parser)
        return int(module.command(parser.parse_args(argv)))

    return run(command)


def run(command: Callable[[], int]) -> int:
    """Call ``command``; turn what users can cause into one line on standard error and an exit code, and so a defect of
    ours (`defect`).
    """
    with standard_streams():
        try:
            try:
                return command()
            finally:
                if sys.stdout is not None:
                    sys.stdout.flush()  # what could not be written is told of here, and not by Python at its end
        except KeyboardInterrupt:
            print("stopped", file=sys.stderr)
            return 130
        except ReaderGone:
            return 0
        except Exception as e:
            if not isinstance(e, InputError):
                print(f"vaneloop: {defect(e)}", file=sys.stderr)
                return DEFECT
            print(f"vaneloop: {clean(str(e))}", file=sys.stderr)
            return 2


# ---- standard input, output and error --------------------------------------------------------------------------------


class ReaderGone(BrokenPipeError):
    """Whoever read standard output has gone away: nobody asks for the rest."""


class _Output(io.FileIO):
    """Standard output of a command. What cannot be written is bad input: InputError, once, or ReaderGone, once; what
    comes after it is dropped.
    """

    dead = False

    def write(self, data: Any, /) -> int:
        """Write all of ``data``; a descriptor that another program made non-blocking is waited for."""
        whole = memoryview(data).cast("B")
        rest = whole
        while len(rest) and not self.dead:
            try:
                written = super().write(rest)
            except OSError as e:
                self.dead = True
                self.refused(e)
                break
            if written is None:
                select.select([], [self], [])
            rest = rest[written or 0 :]
        return len(whole)

    def isatty(self) -> bool:
        """Whether it is a terminal that can be used as one."""
        return is_terminal(self)

    def refused(self, e: OSError) -> None:
        """Raise what it is."""
        if isinstance(e, BrokenPipeError):
            raise ReaderGone(*e.args) from None
        raise InputError(f"standard output: cannot be written ({e.strerror or e})") from None


class _Complaints(_Output):
    """Standard error of a command: what cannot be written has nobody to be told to."""

    def refused(self, e: OSError) -> None:
        """Go on."""


@contextmanager
def standard_streams() -> Iterator[None]:
    """Standard input, output and error that never surprise a command: a closed one is the null device, so that no file
    of ours gets its number. Streams that a program has put in the place of Python's stay as they are.
    """
    for fd in range(3):
        try:
            os.fstat(fd)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)  # the lowest number that is free: this one
    was = sys.stdin, sys.stdout, sys.stderr
    if sys.stdin is None:
        sys.stdin = io.TextIOWrapper(io.BytesIO())
    if sys.stdout is sys.__stdout__:
        sys.stdout = _wrapped(_Output, 1, sys.stdout)
    if sys.stderr is sys.__stderr__:
        sys.stderr = _wrapped(_Complaints, 2, sys.stderr)
    try:
        yield
    finally:
        sys.stdin, sys.stdout, sys.stderr = was


def _wrapped(kind: type[_Output], fd: int, stream: Any) -> Any:
    """A text stream on a descriptor, in place of Python's own (None: it was closed at the start)."""
    raw = kind(os.devnull, "w") if stream is None else kind(fd, "w", closefd=False)
    # a name of a file may hold what the encoding has not
    encoding = getattr(stream, "encoding", "utf-8")
    lines = fd == 2 or raw.isatty()
    return io.TextIOWrapper(io.BufferedWriter(raw), encoding, errors="backslashreplace", line_buffering=lines)


def is_terminal(stream: Any) -> bool:
    """Whether a stream is a terminal that says how it is set; one that refuses is none."""
    try:
        termios.tcgetattr(stream.fileno())
    except (AttributeError, OSError, ValueError, termios.error):
        return False
    return True


@contextmanager
def keyboard(stream: Any) -> Iterator[int | None]:
    """Give the descriptor of a terminal whose keys come at once, or None where ``stream`` is none that controls this
    process and answers every call. The terminal is as it was afterwards.
    """
    try:
        fd = stream.fileno()
        ours = os.tcgetpgrp(fd) == os.getpgrp()
        before = termios.tcgetattr(fd)
        if ours:
            tty.setcbreak(fd)
    except (AttributeError, OSError, ValueError, termios.error):
        ours = False
    if not ours:
        yield None
        return
    try:
        yield fd
    finally:
        with suppress(OSError, termios.error):  # it may be gone by now
            termios.tcsetattr(fd, termios.TCSADRAIN, before)


def input_of(stream: Any) -> int | None:
    """Descriptor of a stream that this process may read; None of one that is closed, and of a terminal that is another
    process group's: a command that was started with ``&`` would be stopped for reading it.
    """
    try:
        fd = int(stream.fileno())
    except (AttributeError, OSError, ValueError):
        return None
    try:
        return fd if os.tcgetpgrp(fd) in (0, os.getpgrp()) else None
    except OSError:  # no terminal, or not the one that controls this process: nobody else's turn to read it
        return fd


def defect(e: BaseException) -> str:
    """One line for an error that no input should cause. The traceback goes into a file, or to standard error with
    VANELOOP_DEBUG=1.
    """
    if isinstance(e, MemoryError):
        return "the machine's memory does not suffice for this"
    if type(e).__name__ == "BrokenProcessPool":
        return (
            "a process of the search was ended from outside (killed, or short of memory); nothing is kept of it: start "
            "it again (--workers 1, at the command line, needs less memory)"
        )
    lines = "".join(traceback.format_exception(e))
    # of an error in another process, its traceback is the text of the cause
    place = re.findall(r'^ *File "(.*)", line (\d+)', _there(e) or "".join(traceback.format_tb(e.__traceback__)), re.M)
    at = f" ({Path(place[-1][0]).name}:{place[-1][1]})" if place else ""
    what = " ".join(f"{type(e).__name__}: {e}".split())[:200]
    where = "VANELOOP_DEBUG=1 prints the traceback"
    if os.environ.get("VANELOOP_DEBUG"):
        print(lines, end="", file=sys.stderr)
        where = "traceback above"
    else:
        try:
            with tempfile.NamedTemporaryFile(
                "w", prefix="vaneloop-", suffix=".traceback", delete=False, encoding="utf-8"
            ) as f:
                f.write(lines)
            where = f"traceback in {f.name}"
        except OSError:
            pass
    return f"internal error: {what}{at}. This is a defect of VaneLoop, not of your input; {where}"


def _there(e: BaseException) -> str:
    """The traceback of an error that came from another process (multiprocessing, concurrent.futures)."""
    return str(e.__cause__) if type(e.__cause__).__name__.endswith("RemoteTraceback") else ""
