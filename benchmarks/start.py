"""A module of this folder as a command: help, JSON, progress and exit codes are those of `vaneloop`'s own commands."""

from __future__ import annotations

import importlib
import sys
from typing import NoReturn

from vaneloop.base import terminal

__all__ = ["main", "run"]


def main(module: str, argv: list[str]) -> int:
    """Run ``module`` (benchmarks.hidden_effect, say: DESCRIPTION, ``add_options``, ``command``) with the words
    ``argv``; return the exit code.
    """
    return terminal.start(f"python -m {module}", lambda: importlib.import_module(module), argv)


def run(module: str) -> NoReturn:
    """What ``python -m`` of a module does."""
    terminal.is_command = True
    sys.exit(main(module, sys.argv[1:]))
