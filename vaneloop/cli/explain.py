"""``--explain``: the verdict of every acceptance rule on every candidate."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from typing import Any

from vaneloop.base import terminal
from vaneloop.pages.decisions import Explained, counted, decision_table, reasons

__all__ = ["add_option", "show"]


def add_option(parser: Any) -> None:
    """Declare ``--explain``."""
    parser.add_argument(
        "--explain", action="store_true",
        help="print why each candidate was accepted or not: every acceptance rule, the number measured and the limit",
    )  # fmt: skip


def show(args: argparse.Namespace, of: Mapping[str, Explained]) -> None:
    """Print the decisions of each subsystem, and the rules with their reasons; ``of``: as `explain` has it."""
    every = [d for decisions, _ in of.values() for d in decisions]
    if not args.explain or not every:
        return
    for name, (decisions, chosen) in of.items():
        if decisions:
            terminal.print_table(args, f"{name}: {counted(decisions)}", *decision_table(decisions, chosen))
    terminal.print_table(args, "acceptance rules", ["rule", "unit", "limit", "reason"], reasons(every))
