"""``vaneloop new-controller``: a project of a controller of the user's own, to begin with."""

from __future__ import annotations

import argparse
import contextlib
from importlib import resources
from pathlib import Path

from controller.header import FOLDER
from hil.inject.any_controller import SHIPPED
from vaneloop.base import terminal
from vaneloop.base.errors import InputError
from vaneloop.base.files import cannot_write, write_all

__all__ = ["DESCRIPTION", "add_options", "command"]

DESCRIPTION = """Write a project of a controller of your own in C: a PI controller with one stroke table a direction, an
adapter for the code of a generator, a Makefile, the limits and reactions that it is judged by, tests. It builds with
make and gcc, passes its tests and runs (docs/own_controller.md).

examples:
  vaneloop new-controller MY_CONTROLLER/

exit codes: 0 written, 2 bad input"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("folder", metavar="DIR", help="folder to write; it must be new or empty")
    terminal.add_output_options(parser)


def command(args: argparse.Namespace) -> int:
    """Write the project; return the exit code."""
    folder = Path(args.folder)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder}: is there already; a new or an empty folder is needed")
    template = Path(str(resources.files("vaneloop") / "templates" / "own_controller"))
    sources = [f for f in template.rglob("*") if f.is_file() and f.suffix != ".pyc"]
    contents = {folder / f.relative_to(template): f.read_bytes() for f in sources}
    contents[folder / "vaneloop_controller.h"] = (FOLDER / "vaneloop_controller.h").read_bytes()
    contents[folder / "reactions.toml"] = SHIPPED.read_bytes()
    new = [] if folder.is_dir() else [folder]
    new += sorted({f.parent for f in contents} - {folder})
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for inner in new:
            inner.mkdir(exist_ok=True)
        write_all(contents)
    except (OSError, InputError) as e:
        for inner in reversed(new):  # the next try needs a new or an empty folder
            with contextlib.suppress(OSError):
                inner.rmdir()
        raise e if isinstance(e, InputError) else InputError(cannot_write(folder, e)) from None
    files = sorted(f.relative_to(folder).as_posix() for f in contents)
    terminal.say(args, f"{folder}: {', '.join(files)}")
    terminal.say(args, f"next: cd {folder} && make && make run && make test")
    terminal.write_json(args, {"schema": 1, "folder": str(folder), "files": files})
    return 0
