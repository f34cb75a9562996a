"""``python -m hil.inject``: the same command as ``vaneloop inject``."""

import importlib
import sys

from vaneloop.base import terminal


def main(argv: list[str] | None = None) -> int:
    """Run the command line; return the exit code."""
    return terminal.start("python -m hil.inject", lambda: importlib.import_module("vaneloop.cli.inject"), argv)


if __name__ == "__main__":
    sys.exit(main())
