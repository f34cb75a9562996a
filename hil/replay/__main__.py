"""``python -m hil.replay``: the same command as ``vaneloop replay``."""

import importlib
import sys

from vaneloop.base import terminal


def main(argv: list[str] | None = None) -> int:
    """Run the command line; return the exit code."""
    return terminal.start("python -m hil.replay", lambda: importlib.import_module("vaneloop.cli.replay"), argv)


if __name__ == "__main__":
    sys.exit(main())
