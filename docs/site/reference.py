"""The pages of the reference, made from the code at each build: commands, Python, JSON, signals, CAN, calibration,
laws, scenarios. Nothing here says anything of its own: a wrong word on such a page is corrected where the code says it.
"""

from __future__ import annotations

import argparse
import importlib
import inspect
import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cantools
from cantools.database.can import Message, Signal

import vaneloop
from controller.calibration import CalibrationTable
from hil.inject.scenario import library, load_scenario
from hil.logs import Channel, Log, read_log
from vaneloop.base import terminal
from vaneloop.base.signals import UNITS
from vaneloop.base.tables import Bound, load_toml, path
from vaneloop.cli.main import COMMANDS, GROUPS
from vaneloop.identification.candidates.library import LAWS, Size

__all__ = ["options_of", "pages"]

ROOT = Path(__file__).resolve().parents[2]
MADE = "*Made from the code when the site is built.*"


def pages() -> dict[str, str]:
    """Markdown of every page, by its place in docs/."""
    out = {
        "reference/index.md": index_page(),
        "reference/python.md": python_page(),
        "reference/json.md": json_page(),
        "reference/signals.md": signals_page(),
        "reference/can.md": can_page(),
        "reference/calibration.md": calibration_page(),
        "reference/laws.md": laws_page(),
        "reference/scenarios.md": scenarios_page(),
    }
    return out | {f"reference/commands/{name}.md": command_page(name) for name in COMMANDS}


def cell(text: Any) -> str:
    """Text as it may stand in a cell of a table."""
    return " ".join(str(text).split()).replace("|", "\\|").replace("<", "&lt;")


def table(head: Iterable[str], rows: Iterable[Iterable[Any]]) -> str:
    """A Markdown table; no rows: nothing."""
    lines = [f"| {' | '.join(cell(c) for c in row)} |" for row in rows]
    head = list(head)
    return "\n".join([f"| {' | '.join(head)} |", "|---" * len(head) + "|", *lines]) + "\n" if lines else ""


# ---- commands --------------------------------------------------------------------------------------------------------


def index_page() -> str:
    """What the reference holds."""
    out = ["# Reference", MADE, "## Commands", "`vaneloop COMMAND --help` prints the same."]
    for title, group in GROUPS.items():
        rows = [(f"[`{name}`](commands/{name}.md)", text) for name, (_, text) in group.items()]
        out += [f"### {title[:1].upper()}{title[1:]}", table(("command", "does"), rows)]
    return "\n\n".join(out)


def parser_of(name: str) -> terminal.Parser:
    """The parser of a command."""
    module = importlib.import_module(COMMANDS[name][0])
    parser = terminal.Parser(prog=f"vaneloop {name}", description=module.DESCRIPTION)
    module.add_options(parser)
    return parser


def options_of(name: str) -> list[str]:
    """Every option of a command, those of its parts (fleet run) too."""
    parsers = [parser_of(name)]
    for action in parsers[0]._actions:
        if isinstance(action, argparse._SubParsersAction):
            parsers += action.choices.values()
    return sorted({o for p in parsers for a in p._actions for o in a.option_strings if o.startswith("--")})


def command_page(name: str) -> str:
    """A command as its own parser describes it."""
    parser = parser_of(name)
    out = [f"# {name}", prose(f"{parser.description or ''}\n\n{parser.epilog or ''}")]
    for group in parser._action_groups:
        rows = [(invocation(a), meaning(parser, a)) for a in group._group_actions if a.help != argparse.SUPPRESS]
        if rows:
            title, _, page = (group.title or "options").partition(" (")
            out += [f"## {title[:1].upper()}{title[1:]}", escaped(page.rstrip(")")), group.description or ""]
            out.append(table(("typed", "does"), rows))
    return "\n\n".join(x for x in out if x) + "\n"


def prose(text: str) -> str:
    """The words of a help text: paragraphs as they are, indented lines as code."""
    out = []
    for part in re.split(r"\n{2,}", inspect.cleandoc(text)):
        head, colon, lines = part.partition(":\n")
        if colon and all(x.startswith("  ") for x in lines.splitlines()):
            out.append(f"{head[:1].upper()}{head[1:]}:\n\n```sh\n{inspect.cleandoc(lines)}\n```")
        elif part.strip():
            out.append(escaped(re.sub(r"^exit codes: ", "Exit codes: ", part.strip())))
    return "\n\n".join(out)


def escaped(text: str) -> str:
    """Plain text as Markdown: options, and names with an underscore, are code; a page that is named is a link."""
    text = re.sub(r"(?<![`\w/.-])(--[a-z][\w-]*|[\w.]*_[\w.]*\w)(?![`\w/])", r"`\1`", text)
    return linked(text.replace("<", "&lt;"), "../../")


def linked(text: str, up: str) -> str:
    """Text in which the pages that it names are links; ``up``: the way from its page to docs/."""
    return re.sub(r"(?<!\]\()(?<![\w/])docs/([\w/]+\.md)", lambda m: f"[{m[1].removesuffix('.md')}]({up}{m[1]})", text)


def invocation(action: argparse.Action) -> str:
    """How an option is typed."""
    value = action.metavar or (action.dest.upper() if action.nargs != 0 else "")
    value = " ".join(value) if isinstance(value, tuple) else value
    return ", ".join(f"`{o} {value}`" if action.nargs != 0 else f"`{o}`" for o in action.option_strings) or f"`{value}`"


def meaning(parser: argparse.ArgumentParser, action: argparse.Action) -> str:
    """What an option does, with its values filled in."""
    text = escaped(parser._get_formatter()._expand_help(action)) if action.help else ""
    if action.choices and not all(str(c) in text for c in action.choices):
        text += f" One of: {', '.join(f'`{c}`' for c in action.choices)}."
    return text


# ---- Python ----------------------------------------------------------------------------------------------------------


def python_page() -> str:
    """The public names of `vaneloop`, from their docstrings, by the module in which each is written."""
    out = ["# Python interface", MADE, "[From Python](../python.md) is the guide. `import vaneloop` has all of these."]
    homes: dict[str, list[str]] = {}
    for name in vaneloop.__all__:
        homes.setdefault(getattr(vaneloop, name).__module__, []).append(name)
    for home, names in homes.items():
        out += [f"## {home}", doc(importlib.import_module(home))]
        for name in names:
            out += [f"### {name}", f"```python\n{signature(name)}\n```", doc(getattr(vaneloop, name))]
            out += members(getattr(vaneloop, name))
    return "\n\n".join(x for x in out if x) + "\n"


def signature(name: str) -> str:
    """How a name is called, one argument a line where that is long."""
    thing = getattr(vaneloop, name)
    if isinstance(thing, type) and issubclass(thing, Exception):
        return f"class {name}({thing.__bases__[0].__name__})"
    s = inspect.signature(thing)
    words: list[str] = []
    for p in s.parameters.values():
        if p.kind is p.KEYWORD_ONLY and "*" not in words:
            words.append("*")
        star = "**" if p.kind is p.VAR_KEYWORD else "*" if p.kind is p.VAR_POSITIONAL else ""
        default = "" if p.default is p.empty else f" = {p.default!r}"
        words.append(f"{star}{p.name}{named(p.annotation, ': ')}{default if len(default) < 60 else ' = ...'}")
    end = "" if isinstance(thing, type) else named(s.return_annotation, " -> ")
    whole = f"{name}({', '.join(words)}){end}"
    return whole if len(whole) <= 90 else f"{name}(\n" + "".join(f"    {w},\n" for w in words) + f"){end}"


def named(annotation: Any, before: str) -> str:
    """An annotation as it is written."""
    if annotation is inspect.Signature.empty:
        return ""
    return before + (annotation if isinstance(annotation, str) else inspect.formatannotation(annotation))


def numpydoc(text: str) -> list[str]:
    """A section of a docstring in the manner of numpydoc, as Markdown: a table of names, or an example as code."""
    title, _, *lines = text.splitlines()
    if title == "Examples":
        parts = re.split(r"\n{2,}", "\n".join(lines))
        code = [p if not p.startswith(">>>") else f"```pycon\n{p}\n```" for p in parts]
        return [f"**{title}**", *code]
    rows: list[list[str]] = []
    for line in lines:
        if not line.startswith(" ") and line.strip():
            name, _, kind = line.partition(" : ")
            rows.append([f"`{name}`", kind, ""])
        elif rows:
            rows[-1][2] += f" {line.strip()}"
    return [f"**{title}**", table(("name", "type", "is"), rows)]


def sections(text: str) -> tuple[str, list[str]]:
    """What stands before the sections of numpydoc in a docstring, and each section."""
    parts = re.split(r"\n(?=[A-Z]\w+\n-{4,}\n)", f"\n{text}")
    return parts[0].strip("\n"), [p.rstrip() for p in parts[1:]]


def doc(thing: Any) -> str:
    """A docstring as Markdown: what stands in two columns becomes a table, and so do the sections of numpydoc."""
    text, more = sections(inspect.getdoc(thing) or "")
    return linked("\n\n".join([told(text), *(x for part in more for x in numpydoc(part))]), "../")


def told(text: str) -> str:
    """The words of a docstring as Markdown."""
    out = []
    row = re.compile(r"(\w+(?:, \w+)*)\s{2,}(\S.*)|(\w{2,}) ([a-z].*)")
    for part in re.split(r"\n{2,}", text):
        part = part.rstrip()
        lines = inspect.cleandoc(part).splitlines() if part.startswith(" ") else part.splitlines()
        wide = [x for x in lines if not x.startswith(" ")]
        columns = [m for x in wide if (m := re.match(r"(\w+(?:, \w+)*)\s{2,}\S", x))]
        if columns and len(columns) * 2 >= len(wide):
            rows: list[list[str]] = []
            for x in lines:
                if not x.startswith(" ") and (m := row.match(x)):
                    rows.append([f"`{m[1] or m[3]}`", m[2] or m[4]])
                elif rows:
                    rows[-1][1] += f" {x.strip()}"
            out.append(table(("name", "is"), rows))
        elif part.startswith("    "):
            out.append(f"```text\n{inspect.cleandoc(part)}\n```")
        else:
            out.append(re.sub(r"::$", ":", part).replace("<", "&lt;"))
    return "\n\n".join(out)


def members(thing: Any) -> list[str]:
    """Public methods and properties of a class, with the first sentence of each."""
    if not isinstance(thing, type) or issubclass(thing, Exception):
        return []
    rows = []
    for name, member in inspect.getmembers(thing):
        function = member.fget if isinstance(member, property) else member
        own = (getattr(function, "__module__", None) or "").split(".")[0] in ("vaneloop", "hil", "plant", "controller")
        if name.startswith("_") or not own or not (inspect.isfunction(function) or inspect.ismethod(function)):
            continue
        call = (
            ""
            if isinstance(member, property)
            else "(" + ", ".join(p for p in inspect.signature(function).parameters if p not in ("self", "cls")) + ")"
        )
        rows.append((f"`{name}{call}`", (inspect.getdoc(function) or "").split("\n\n")[0]))
    return [table(("member", "is"), rows)]


# ---- JSON ------------------------------------------------------------------------------------------------------------


def json_page() -> str:
    """The keys of the JSON of each verb, as it answers on the first minute of the example."""
    log = read_log(ROOT / "examples/hidden_effect.parquet")
    first = {n: Channel(c.t[c.t < 60.0], c.values[c.t < 60.0]) for n, c in log.channels.items()}
    log = Log("examples/hidden_effect.parquet", first, list(log.notes))
    answers = {
        "replay": vaneloop.replay(log),
        "compare": vaneloop.compare(log),
        "diagnose": vaneloop.diagnose(log),
        "extend": vaneloop.extend(log, ["valve_dead_band"]),
    }
    out = [
        "# JSON",
        MADE,
        "`--json FILE` of a command and `to_dict()` of an answer in Python give the same. Below are the keys that each "
        "verb gives on the first minute of the shipped example. `[]` is each entry of a list. What is not finite is "
        "null. The values are examples.",
    ]
    for verb, answer in answers.items():
        rows = [(f"`{key}`", kind, f"`{value}`" if value else "") for key, kind, value in keys(answer.to_dict())]
        out += [f"## {verb}", table(("key", "is", "for instance"), rows)]
    return "\n\n".join(out) + "\n"


def keys(value: Any, at: str = "") -> list[tuple[str, str, str]]:
    """Key, kind and an example of everything in a piece of JSON; of a list, of all its entries together."""
    value = terminal.plain(value)
    if isinstance(value, dict) and value:
        named = [row for k, v in value.items() for row in keys(v, f"{at}.{k}" if at else k)]
        return ([(at, "object", "")] if at else []) + named
    if isinstance(value, list):
        found: dict[str, tuple[str, str, str]] = {}
        for row in (row for entry in value for row in keys(entry, f"{at}[]")):
            if row[0] not in found or found[row[0]][1] == "null":  # an entry that has a value tells more
                found[row[0]] = row
        return [(at, "list", "" if value else "[]"), *found.values()]
    kind = {bool: "true or false", int: "number", float: "number", str: "text", type(None): "null"}
    text = f"{value:.4g}" if isinstance(value, float) else value if isinstance(value, str) else json.dumps(value)
    text = text.replace("`", "'")
    return [(at, kind.get(type(value), "object"), text if len(text) < 60 else f"{text[:56]} ...")]


# ---- data ------------------------------------------------------------------------------------------------------------


def signals_page() -> str:
    """Names and units at the borders."""
    return (
        f"# Signals and units\n\n{MADE}\n\nThese names and units hold in logs, on the bus, in tables, in the terminal "
        "and on pages. [Architecture](../architecture.md#units) says what each is.\n\n"
        + table(("signal", "unit"), [(f"`{n}`", u) for n, u in UNITS.items()])
    )


def can_page() -> str:
    """The frames and signals of the product's DBC."""
    database = cantools.database.load_file(path("vgv.dbc"))
    messages: list[Message] = sorted(database.messages, key=lambda m: m.frame_id)
    head = ("frame", "identifier", "bytes", "period", "from")
    rows = [
        (
            f"[`{m.name}`](#{m.name.lower()})",
            f"0x{m.frame_id:03X}",
            m.length,
            f"{m.cycle_time} ms",
            ", ".join(m.senders),
        )
        for m in messages
    ]
    out = [
        "# CAN frames",
        MADE,
        "The database is `tables/vgv.dbc`. [The bus](../bus.md) explains it.",
        table(head, rows),
    ]
    for m in messages:
        columns = ("signal", "bits", "value = raw x factor + offset", "from ... to", "unit", "what")
        out += [f"## {m.name}", m.comment or "", table(columns, [signal_row(s) for s in m.signals])]
    return "\n\n".join(x for x in out if x) + "\n"


def signal_row(s: Signal) -> tuple[str, ...]:
    """One signal of a frame."""
    low, high = (f"{v:g}" if v is not None else "" for v in (s.minimum, s.maximum))
    bits = f"{s.start} ... {s.start + s.length - 1}{', signed' if s.is_signed else ''}"
    names = "; ".join(f"{k}: {v}" for k, v in (s.choices or {}).items())
    what = f"{s.comment or ''} {names}".strip()
    return f"`{s.name}`", bits, f"{s.scale:g}, {s.offset:g}", f"{low} ... {high}", s.unit or "", what


def calibration_page() -> str:
    """Every number of the controller's calibration: value, bounds, origin."""
    out = [
        "# Calibration",
        MADE,
        "The file is `tables/calibration.toml`. The bounds are those of `controller/calibration.py`: a value outside "
        "is refused. [The tables](../tables.md) says how to change one.",
    ]
    for section, values in load_toml(path("calibration.toml")).items():
        model: Any = CalibrationTable.model_fields[section].annotation
        out += [f"## {section}", doc(model)]
        rows = []
        for name, entry in values.items():
            value, unit, origin = (
                (entry["value"], entry["unit"], entry.get("origin", "")) if isinstance(entry, dict) else (entry, "", "")
            )
            bound = next((m for m in model.model_fields[name].metadata if isinstance(m, Bound)), None)
            low, high = (f"{bound.low:.10g}", f"{bound.high:.10g}") if bound else ("", "")
            rows.append((f"`{name}`", f"{value}", unit, low, high, origin))
        out.append(table(("name", "value", "unit", "from", "to", "origin"), rows))
    return "\n\n".join(x for x in out if x) + "\n"


# ---- physics and scenarios -------------------------------------------------------------------------------------------


def laws_page() -> str:
    """The laws that the search tries on users' own models."""
    size = Size(-1.0, 1.0, 1.0, 1.0, 0.01, 100.0, unit="u", force_unit="F", speed_unit="v", travel_unit="x")
    places = {
        "signal": "They act on an input or an output, whose unit is u.",
        "force": "They act where things move: force F, speed v, displacement x.",
        "state": "They act on the rate of a state of first order, whose unit is u.",
    }
    out = [
        "# Laws for your own model",
        MADE,
        "The search tries these on a model of yours ([your own model](../your_own_model.md)). Their bounds follow from "
        "the size of your data. At its neutral size a law changes nothing.",
    ]
    for place, laws in LAWS.items():
        rows = []
        for law in laws.values():
            sizes = ", ".join(f"`{p.name}` {p.unit}" for p in law.make(size)[0])
            rows.append((f"`{law.name}`", law.text, sizes, law.looks))
        out += [f"## On a {place}", places.get(place, ""), table(("law", "what", "sizes", "looks in a log"), rows)]
    return "\n\n".join(x for x in out if x) + "\n"


def scenarios_page() -> str:
    """The scenarios that ship."""
    both = library() | library(2)
    rows = [(f"`{name}`", s.title, s.why, f"{s.duration:g} s") for name in both for s in [load_scenario(name)]]
    return (
        f"# Scenarios of injection\n\n{MADE}\n\n`vaneloop inject NAME` runs one, `vaneloop inject --all` all. "
        "Those that begin with `cha_` are of [two channels](../channels.md). "
        "[Injection](../injection.md) says how to write your own.\n\n" + table(("name", "title", "why", "lasts"), rows)
    )
