"""A self-contained HTML page of figures, tables and plots that opens from disk, with no network, in light and in dark.

    page = Page("Replay of run.csv", "The model follows the log.", tone="good", log="run.csv")
    page.tile("worst signal", "0.21", "deg", "VIGV, RMS")
    page.section("Vane angle", "Measured and simulated over the whole run.")
    page.plot(overlay([Panel("vigv [deg]", [Line("measured", t, y, "measured")])]), "Drag to zoom.")
    page.table(["signal", "rms"], [["vigv", 0.21]])
    page.write("out.html")

A plot is a plain dictionary in Plotly's JSON form, as `vaneloop.pages.figures` makes them; a
`plotly.graph_objects.Figure` works too. Colours are names of roles (``@measured``, ``@model``, ``@target``, ``@error``,
...), which the page's script (``page.js``) resolves for the reader's light or dark scheme; its style sheet is
``page.css``. All text that enters a page is escaped: names out of logs cannot become markup.
"""

from __future__ import annotations

import html
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hil.logs.notes import COLUMNS, Note, as_rows, counted
from vaneloop.base.files import write
from vaneloop.base.version import installed_version
from vaneloop.pages.figures import Figure
from vaneloop.pages.style import THEMES, Tone, capital, number

__all__ = ["Link", "Page", "Plot", "Section", "Tile"]

_POLICY = (  # no network at all, whatever a page may hold
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:; base-uri 'none'; "
    "form-action 'none'"
)


_REGION = ' tabindex="0" role="group" aria-label="{}"'  # what is wider than the screen is moved by keyboard, too


class Link(NamedTuple):
    """A cell of a table that leads to another page: its text, and where that page is from here."""

    text: str
    href: str


class Tile(NamedTuple):
    """A key figure, ready to be shown."""

    label: str
    value: str
    unit: str
    note: str
    tone: Tone


class Section(NamedTuple):
    """The beginning of a section: its heading."""

    title: str


class Plot(NamedTuple):
    """A plot: its place among the figures, what stands below it, and whether it takes half of a wide screen."""

    number: int
    caption: str
    half: bool


class Page:
    """A report under construction: verdict, key figures, sections, footer.

    tiles, parts  what it holds, in its order, for whoever shows it elsewhere (the workbench); a part that is a string
                  is HTML: paragraphs, or a table
    """

    def __init__(
        self,
        title: str,
        verdict: str,
        *,
        tone: Tone = "neutral",
        subtitle: str = "",
        command: str = "",
        log: str = "",
        state_hash: str = "",
        version: str | None = None,
    ):
        self.title, self.verdict, self.tone, self.subtitle = title, verdict, tone, subtitle
        self.facts = {"version": version or _version(), "command": command, "log": log, "state hash": state_hash}
        self.tiles: list[Tile] = []
        self.parts: list[str | Section | Plot] = []
        self.figures: list[Figure] = []

    def tile(self, label: str, value: object, unit: str = "", note: str = "", tone: Tone = "neutral") -> None:
        """Add a key figure; ``note`` says in a few words what it means."""
        self.tiles.append(Tile(label, number(value), unit, note, tone))

    def section(self, title: str, text: str = "") -> None:
        """Begin a section: a heading and what its plots say in plain words; an empty line in ``text`` begins a new
        paragraph.
        """
        self.parts.append(Section(title))
        self.text(text)

    def text(self, text: str) -> None:
        """Add paragraphs."""
        self.parts += [f"<p>{html.escape(p.strip())}</p>" for p in text.split("\n\n") if p.strip()]

    def notes(self, notes: Sequence[str]) -> None:
        """Add what the reader should know, a sentence each, and a row for each thing that was done to the log, in a
        section of its own; nothing where there is none.
        """
        if notes:
            self.section("Notes")
            for note in notes:
                if not isinstance(note, Note):
                    self.text(f"{capital(note).removesuffix('.')}.")
            self.done(counted(notes))

    def done(self, done: Sequence[Mapping[str, Any]]) -> None:
        """Add a table of what was done to a log, as JSON has it (`hil.logs.notes.counted`); nothing where there is
        nothing.
        """
        if rows := as_rows(done):
            self.table(list(COLUMNS), rows, "What reading did to the log.")

    def plot(self, figure: Any, caption: str = "", *, half: bool = False) -> None:
        """Add a plot; two ``half`` ones in a row stand side by side where the screen is wide enough."""
        if hasattr(figure, "to_plotly_json"):
            figure = json.loads(figure.to_json())
        self.parts.append(Plot(len(self.figures), caption, half))
        self.figures.append(figure)

    def table(
        self, columns: Sequence[str], rows: Sequence[Sequence[object]], caption: str = "", digits: int = 3
    ) -> None:
        """Add a table; numbers are rounded to so many digits and set flush right."""
        e = html.escape
        head = ""
        for i, c in enumerate(columns):
            tag = "th" if c else "td"  # a heading without words is none
            head += f"<{tag}{_right(bool(rows) and all(_is_number(r[i]) for r in rows))}>{e(str(c))}</{tag}>"
        body = "".join(
            "<tr>" + "".join(f"<td{_kind(v)}>{_cell(v, digits)}</td>" for v in row) + "</tr>\n" for row in rows
        )
        note = f"<caption>{e(caption)}</caption>" if caption else ""
        self.parts.append(
            f'<div class="scroll"{_REGION.format("table")}>'
            f"<table>{note}<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>"
        )

    @contextmanager
    def folded(self, summary: str) -> Iterator[None]:
        """Fold what is added meanwhile under a line that opens it; plots cannot be folded."""
        first = len(self.parts)
        yield
        inside = [part for part in self.parts[first:] if isinstance(part, str)]
        body = "".join(inside)
        self.parts[first:] = [f"<details><summary>{html.escape(summary)}</summary>{body}</details>"]

    def html(self) -> str:
        """Return the whole page."""
        e = html.escape
        sections = [p.title for p in self.parts if isinstance(p, Section)]
        toc = "".join(f'<a href="#s{i}">{e(s)}</a>' for i, s in enumerate(sections, start=1))
        facts = "".join(f"<div><dt>{e(k)}</dt><dd>{e(v)}</dd></div>" for k, v in self.facts.items() if v)
        parts = [
            "<!doctype html>",
            '<html lang="en"><head><meta charset="utf-8">',
            f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">',
            '<meta name="viewport" content="width=device-width, initial-scale=1"><meta name="color-scheme" '
            'content="light dark">',
            f"<title>{e(self.title)}</title>",
            f"<style>{_css()}</style>",
            "</head><body><main>",
            f"<header><p "
            f'class="kicker">VaneLoop{" · " + e(self.subtitle) if self.subtitle else ""}</p><h1>{e(self.title)}</h1>'
            f'<p class="verdict {e(self.tone)}">{e(self.verdict)}</p></header>',
            f'<div class="tiles">{"".join(map(_tile, self.tiles))}</div>' if self.tiles else "",
            f'<nav aria-label="contents">{toc}</nav>' if len(sections) > 1 else "",
            *self._body(),
            f"<footer><dl>{facts}</dl></footer>",
            "</main>",
            *(self._scripts() if self.figures else []),
            "</body></html>",
        ]
        return "\n".join(parts) + "\n"

    def _scripts(self) -> list[str]:
        """What draws the figures."""
        from plotly.offline import get_plotlyjs

        return [
            f'<script type="application/json" id="figures">{_json(self.figures)}</script>',
            f'<script type="application/json" id="themes">{_json(THEMES)}</script>',
            f"<script>{get_plotlyjs()}</script>",
            f"<script>\n{_beside('page.js')}</script>",
        ]

    def write(self, path: str | Path) -> Path:
        """Write the page in one go: a reader never sees half of it. Raises InputError when it cannot be written."""
        return write(path, self.html().encode(errors="backslashreplace"))

    def _body(self) -> list[str]:
        """The parts as HTML; half plots that follow each other stand in one grid."""
        out, grid, sections = [], False, 0
        for part in self.parts:
            half = isinstance(part, Plot) and part.half
            if half != grid:
                out.append('<div class="pair">' if half else "</div>")
                grid = half
            if isinstance(part, Section):
                sections += 1
                out.append(f'<h2 id="s{sections}">{html.escape(part.title)}</h2>')
            elif isinstance(part, Plot):
                height = int(self.figures[part.number].get("layout", {}).get("height") or 400)
                note = f"<figcaption>{html.escape(part.caption)}</figcaption>" if part.caption else ""
                out.append(
                    f'<figure><div class="box"{_REGION.format("plot")}><div class="plot" id="p{part.number}" '
                    f'style="height:{height}px"></div></div>{note}</figure>'
                )
            else:
                out.append(part)
        return [*out, "</div>"] if grid else out


def _tile(t: Tile) -> str:
    e = html.escape
    return (
        f'<div class="tile {e(t.tone)}"><div class="label">{e(t.label)}</div><div '
        f'class="value">{e(t.value)} <span class="unit">{e(t.unit)}</span></div><div '
        f'class="note">{e(t.note)}</div></div>'
    )


def _version() -> str:
    """Version of the installed distribution."""
    return f"vaneloop {installed_version('(not installed)')}"


def _is_number(value: object) -> bool:
    return value is None or (isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool))


def _cell(value: object, digits: int) -> str:
    """Inside of a table cell."""
    if isinstance(value, Link):
        return f'<a href="{html.escape(value.href)}">{html.escape(value.text)}</a>'
    return html.escape(number(value, digits))


def _kind(value: object) -> str:
    """Class of a table cell: numbers flush right, short text unbroken."""
    return ' class="num"' if _is_number(value) else ' class="short"' if len(str(value)) <= 24 else ""


def _right(yes: bool) -> str:
    return ' class="num"' if yes else ""


def _json(data: object) -> str:
    """JSON that can stand inside a script element: no tag can end it, no NaN breaks it."""
    text = json.dumps(_finite(data), ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    for c in "<>&\u2028\u2029":
        text = text.replace(c, f"\\u{ord(c):04x}")
    return text


def _finite(data: Any) -> Any:
    """Plain Python data with None for what JSON cannot hold."""
    if isinstance(data, Mapping):
        return {str(k): _finite(v) for k, v in data.items()}
    if isinstance(data, np.ndarray):
        return _finite(data.tolist())
    if isinstance(data, list | tuple):
        return [_finite(v) for v in data]
    if isinstance(data, float | np.floating):
        return float(data) if math.isfinite(data) else None
    if isinstance(data, np.integer):
        return int(data)
    return data


def _css() -> str:
    light, dark = ("".join(f"--{k}:{v};" for k, v in THEMES[s].items()) for s in ("light", "dark"))
    return (
        f":root{{{light}--page:#f3f5f8}}\n@media (prefers-color-scheme: dark){{:root{{{dark}--page:#0f1419}}}}\n"
        f"@media print{{:root{{{light}--page:#ffffff}}}}\n\n" + _beside("page.css")
    )


def _beside(name: str) -> str:
    """Text of a file of the page that stands beside this module."""
    return (Path(__file__).parent / name).read_text(encoding="utf-8")
