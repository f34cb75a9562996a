"""The page on the library of effects, made from the effects' own docstrings and declarations.

``python -m benchmarks.effects_page > docs/effects.md`` writes it anew; a test says when that is due.
"""

from __future__ import annotations

import importlib
import re
import textwrap

from plant.effect import KINDS, SITES, Effect, Parameter
from plant.effects import EFFECTS
from vaneloop.base.vanes import VANES

__all__ = ["page"]

HEAD = """# Effects

Physics that the nominal machine does not have. Each is one file in `plant/effects/`, neutral by default: at its neutral
values the machine is the nominal one, bit for bit. A model file (`plant/model.py`) switches effects on; `vaneloop
diagnose` looks for them in a log. A parameter `vigv`, `vgv1`, ... is one of each vane row that the machine has. The
column "actuator" names the kind of actuator that an effect belongs to ([machines](machines.md)); what is of "two
hydraulic" is of one side of [two actuators](machines.md#two-actuators).

This page is made from the files: `python -m benchmarks.effects_page > docs/effects.md`. Units are those of the borders
(docs/architecture.md); inside the code everything is SI.

| effect | site | actuator | shows in | what |
|---|---|---|---|---|
"""


def page() -> str:
    """Return the page, Markdown."""
    effects = [e for site in SITES for e in EFFECTS.values() if e.site == site]
    rows = [
        f"| [`{e.name}`](#{e.name}) | {e.site} | {_kinds(e)} | {', '.join(e.stages)} | {e.summary} |\n" for e in effects
    ]
    return HEAD + "".join(rows) + "".join(_section(e) for e in effects)


def _kinds(e: Effect) -> str:
    return "any" if e.kinds == KINDS else e.kinds[0]


def _told(e: Effect) -> list[Parameter]:
    """The effect's parameters; of those that every vane stage has, the first."""
    return [p for p in e.parameters if p.vane in ("", VANES[0])]


def _name(p: Parameter) -> str:
    return f"`{p.name}`, `{VANES[1]}`, ..." if p.vane else f"`{p.name}`"


def _section(e: Effect) -> str:
    doc = importlib.import_module(f"plant.effects.{e.name}").__doc__ or ""
    what, rest = doc.strip().split("\n\n", 1)
    parts = re.split(r"^(Symbols|Limits|In a log|Source): ", rest, flags=re.MULTILINE)
    equation = re.sub(r"::\n\n", ":\n\n", parts[0]).strip()
    words = {label: _sentence(text) for label, text in zip(parts[1::2], parts[2::2], strict=True)}
    table = "| parameter | unit | neutral | from | to | meaning |\n|---|---|---|---|---|---|\n"
    table += "".join(map(_row, _told(e)))
    sentences = {
        "In a log.": words["In a log"],
        "What excites it.": _sentence(e.excites) + ".",
        "Limits.": words["Limits"],
        "Source.": words["Source"],
    }
    told = "".join(f"{_filled(f'**{head}** {text}')}\n\n" for head, text in sentences.items())
    return f"\n## {e.name}\n\n{what}\n\n{equation}\n\nSymbols: {_symbols(parts)}\n\n{table}\n{told.rstrip()}\n"


def _symbols(parts: list[str]) -> str:
    return parts[parts.index("Symbols") + 1].strip()


def _sentence(text: str) -> str:
    words = " ".join(text.split())
    return words[0].upper() + words[1:]


def _filled(text: str) -> str:
    return textwrap.fill(text, 120, break_long_words=False, break_on_hyphens=False)


def _row(p: Parameter) -> str:
    return f"| {_name(p)} | {p.unit} | {p.neutral:g} | {p.low:g} | {p.high:g} | {p.meaning} |\n"


if __name__ == "__main__":
    print(page(), end="")
