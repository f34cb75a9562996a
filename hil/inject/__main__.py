"""``python -m hil.inject``: the same command as ``vaneloop inject``."""

import sys

from vaneloop.base import terminal


def main(argv: list[str] | None = None) -> int:
    """Run the command line; return the exit code."""

    def load() -> object:
        from vaneloop.cli import inject

        return inject

    return terminal.start("python -m hil.inject", load, argv)


if __name__ == "__main__":
    sys.exit(main())
