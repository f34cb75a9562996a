"""The thresholds of the identification as a page: ``python -m benchmarks.settings`` prints it, with ``--write`` it is
written to docs/settings.md.
"""

from __future__ import annotations

import argparse
import ast
import re
from dataclasses import dataclass
from itertools import groupby, pairwise
from pathlib import Path

from benchmarks.measure import ROOT
from vaneloop.base.files import write
from vaneloop.identification import settings

PAGE = ROOT / "docs" / "settings.md"
BEGINNING = """# Thresholds of the identification

The named numbers that decide what `locate`, `diagnose`, `extend` and `learn` answer, or how long they take. They
stand in `vaneloop/identification/settings.py`; `python -m benchmarks.settings --write` writes this page.
[How the search decides](methods.md) says where the main ones enter.

Below each value stands its unit, below each meaning the origin of the value. An origin begins with its kind: a
principle, physics, numerics, a benchmark that chose the value, a budget of work, or a judgement where nothing else
decides. The unit 1 is a pure number. A unit in the plural counts or multiplies what it names: `noise floors`, `scales`.
"""


@dataclass(frozen=True)
class Setting:
    """One threshold: its name, the heading it stands under, its value, unit, meaning and origin."""

    name: str
    heading: str
    value: object
    unit: str
    meaning: str
    origin: str


def record() -> list[Setting]:
    """All thresholds, in the order of their file. ValueError where the text below a value is not as the file says."""
    source = Path(settings.__file__).read_text(encoding="utf-8")
    headings = {n: m[1] for n, line in enumerate(source.splitlines(), 1) if (m := re.match(r"# -+ (.+?) -+$", line))}
    found = []
    for value, text in pairwise(ast.parse(source).body):
        if not isinstance(value, ast.Assign):
            continue
        name = ast.unparse(value.targets[0])
        said = ast.literal_eval(text.value) if isinstance(text, ast.Expr) else ""
        parts = re.fullmatch(r"(.+?): (.+?\.) (.+)", " ".join(said.split()))
        if parts is None:
            raise ValueError(f"{name}: below it stands no `unit: Meaning. origin`")
        heading = headings[max(n for n in headings if n < value.lineno)]
        found.append(Setting(name, heading, getattr(settings, name), *parts.groups()))
    return found


def page() -> str:
    """docs/settings.md: a table for each heading, of two rows for each threshold."""
    parts = [BEGINNING]
    for heading, rows in groupby(record(), lambda row: row.heading):
        parts.append(f"\n## {heading}\n\n| threshold | value, unit | meaning, origin |\n|---|---|---|\n")
        for s in rows:
            parts.append(f"| `{s.name}` | {shown(s.value)} | {s.meaning} |\n| | {s.unit} | {s.origin} |\n")
    return "".join(parts)


def shown(value: object) -> str:
    """A value as the page shows it: numbers as Python writes them, several with commas, named ones with their names."""
    if isinstance(value, dict):
        return "; ".join(f"{name}: {shown(v)}" for name, v in value.items())
    return ", ".join(map(str, value)) if isinstance(value, tuple) else str(value)


def main() -> None:
    """Print the page, or write it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true", help="write docs/settings.md")
    if parser.parse_args().write:
        write(PAGE, page())
    else:
        print(page(), end="")


if __name__ == "__main__":
    main()
