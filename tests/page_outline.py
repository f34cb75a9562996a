"""What a page holds, as a text that can be reviewed, and the comparison with the text that was approved.

An outline has the page's words, its tiles, its tables' cells and of each figure all that its JSON says. Of many numbers
it has how many there are, the first, the last, the range and the mean, to four digits, so that it is the same on other
machines. What nearly every figure has (`USUAL`) is left out.

`RENEW_OUTLINES=1 pytest` on the test's file writes the approved texts anew: read what `git diff` shows.
"""

from __future__ import annotations

import base64
import difflib
import html
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vaneloop.pages.page import Page, Plot, Section

__all__ = ["approve", "digest", "figure_lines", "outline", "unpacked", "written"]

APPROVED = Path(__file__).parent / "outlines"
RENEW = "RENEW_OUTLINES"
FEW = 9  # numbers or words that are written out one by one
ROWS = 9  # of a longer table so many are shown, from the first to the last
USUAL: dict[str, Any] = {  # what a trace or a layout has unless it says otherwise
    "type": "scatter", "mode": "lines", "showlegend": True, "visible": True, "xaxis": "x", "yaxis": "y", "opacity": 1.0,
    "connectgaps": False, "marker.size": 3, "line.dash": "solid", "hovermode": "x unified",
    "hoversubplots": "axis", "layer": "below", "zeroline": False, "showspikes": True, "xref": "x domain", "x0": 0,
    "x1": 1, "showarrow": False,
}  # fmt: skip

HOVER = ("%{y:.4g}", "%{x:.4g}, %{y:.4g}", "%{x}: %{text}", "%{x:.3g}: %{y:.2f} %")


def unpacked(values: Mapping[str, str]) -> np.ndarray:
    """The numbers of Plotly's binary form."""
    raw = base64.b64decode(values["bdata"])
    return np.frombuffer(raw, dtype="<" + values["dtype"]).astype(float)


def number(value: float, scale: float = 0.0) -> str:
    """Four digits; what is only rounding beside ``scale`` is 0."""
    return "0" if abs(value) <= 1e-6 * scale else f"{value:.4g}"


def digest(values: Sequence[float | None] | np.ndarray) -> str:
    """A series in a few words: all of a few numbers, else how many, first, last, range, mean, and how many are none."""
    a = np.array([np.nan if v is None else float(v) for v in values], dtype=float)
    finite = a[np.isfinite(a)]
    scale = float(np.abs(finite).max(initial=0.0))
    if len(a) <= FEW:
        return "[" + ", ".join(number(v, scale) if np.isfinite(v) else "-" for v in a) + "]"
    if not len(finite):
        return f"{len(a)} of which none is a number"
    low, high, ends = finite.min(), finite.max(), sorted((finite[0], finite[-1]))
    said = f"{len(a)} from {number(finite[0], scale)} to {number(finite[-1], scale)}"
    if ends[0] > low or ends[1] < high:
        said += f" within {number(low, scale)} to {number(high, scale)}"
    if low < high:
        said += f", mean {number(float(finite.mean()), scale)}"
    return said + (f", {len(a) - len(finite)} none" if len(finite) < len(a) else "")


def told(value: Any) -> str:
    """Any value of a figure."""
    if isinstance(value, Mapping) and "bdata" in value:
        return digest(unpacked(value))
    if isinstance(value, list | tuple | np.ndarray):
        if len(value) and isinstance(value[0], list | tuple | np.ndarray):
            rows = [told(row) for row in value]
            flat = [v for row in value for v in row]
            if len(rows) > FEW and not isinstance(flat[0], str):
                return f"{len(rows)} rows of {len(value[0])}: {digest(flat)}"
            return " / ".join(rows)
        if all(v is None or isinstance(v, int | float | np.number) for v in value):
            return digest(value)
        words = [str(v).replace("\n", " ") for v in value]
        if len(words) > 2 * FEW:
            words = [*words[:FEW], "…", words[-1], f"({len(value)})"]
        return "[" + ", ".join(words) + "]"
    if isinstance(value, bool) or value is None or isinstance(value, str):
        return str(value)
    return number(float(value))


def flat(value: Mapping[str, Any], at: str = "") -> Iterator[tuple[str, Any]]:
    """Each value of nested dictionaries by its path."""
    for key, v in value.items():
        if isinstance(v, Mapping) and "bdata" not in v and v:
            yield from flat(v, f"{at}{key}.")
        else:
            yield f"{at}{key}", v


def unusual(value: Mapping[str, Any], without: Sequence[str] = ()) -> str:
    """All of a dictionary that is not as usual, in one line."""
    pairs = [(k, v) for k, v in flat(value) if k not in without and not (k in USUAL and USUAL[k] == v)]
    pairs = [(k, v) for k, v in pairs if k != "hovertemplate" or v not in HOVER]
    return ", ".join(f"{k} {told(v)}" for k, v in pairs)


def figure_lines(figure: Mapping[str, Any]) -> list[str]:
    """What a figure draws: a line for each axis, each trace, each shape and each annotation."""
    layout = figure["layout"]
    axes = {k: v for k, v in layout.items() if re.fullmatch(r"[xy]axis\d*", k)}
    extra = {k: v for k, v in layout.items() if k not in axes and k not in ("shapes", "annotations")}
    lines = [unusual(extra)] if unusual(extra) else []
    for name, axis in axes.items():
        title = axis.get("title", {}).get("text", "")
        lines.append(f"{name} “{title}” {unusual(axis, ('title.text',))}".rstrip())
    for trace in figure["data"]:
        name = trace.get("name", "")
        same = ["type", "name", "x", "y"]
        same += ["legendgroup"] if trace.get("legendgroup") == name else []
        same += ["marker.color"] if trace.get("marker", {}).get("color") == trace.get("line", {}).get("color") else []
        lines.append(f"- {trace.get('type')} “{name}” {unusual(trace, same)}".rstrip())
        lines.append("    " + "; ".join(f"{k} {told(trace[k])}" for k in ("x", "y") if k in trace))
    for what in ("shapes", "annotations"):
        lines += [f"- {what[:-1]}: {unusual(x, ())}" for x in layout.get(what, ())]
    return lines


class _Html(HTMLParser):
    """The paragraphs, and the cells, of a part of a page; cells of numbers have a # before them."""

    def __init__(self, source: str):
        super().__init__()
        self.lines: list[str] = []
        self.rows: list[list[str]] = []
        self.feed(source)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        of = dict(attrs)
        if tag == "tr":
            self.rows.append([])
        elif tag in ("td", "th"):
            self.rows[-1].append("#" if of.get("class") == "num" else "")
        elif tag == "a":
            self.rows[-1][-1] += f"({of['href']}) "

    def handle_data(self, data: str) -> None:
        if not data.strip():
            return
        if self.rows:
            self.rows[-1][-1] += data
        else:
            self.lines.append(data)


def part_lines(source: str) -> list[str]:
    """A part of a page that is HTML: paragraphs, or a table."""
    read = _Html(source)
    rows = read.rows
    if len(rows) > ROWS + 2:
        some = np.unique(np.linspace(1, len(rows) - 1, ROWS).astype(int))
        rows = [rows[0], *(rows[k] for k in some), [f"({len(rows) - 1} rows)"]]
    return [*read.lines, *("| " + " | ".join(row) for row in rows)]


def outline(page: Page) -> str:
    """Everything that a page holds."""
    facts = {k: v for k, v in page.facts.items() if v and k != "version"}
    lines = [f"# {page.title}", f"{page.tone}: {page.verdict}", *([page.subtitle] if page.subtitle else [])]
    lines += [f"{k}: {v}" for k, v in facts.items()]
    lines += [f"[{t.tone}] {t.label}: {t.value} {t.unit}; {t.note}" for t in page.tiles]
    for part in page.parts:
        if isinstance(part, Section):
            lines += ["", f"## {part.title}"]
        elif isinstance(part, Plot):
            half = "half plot" if part.half else "plot"
            lines += [f"{half} {part.number}: {part.caption}"]
            lines += [f"  {line}" for line in figure_lines(page.figures[part.number])]
        else:
            lines += part_lines(part)
    return html.unescape("\n".join(lines)) + "\n"


def written(monkeypatch: pytest.MonkeyPatch) -> list[Page]:
    """Pages that are written from now on, kept in place of files."""
    pages: list[Page] = []

    def write(page: Page, path: str | Path) -> Path:
        pages.append(page)
        return Path(path)

    monkeypatch.setattr(Page, "write", write)
    return pages


def approve(name: str, text: str) -> None:
    """Hold a text against the one that was approved under this name."""
    file = APPROVED / f"{name}.txt"
    if os.environ.get(RENEW):
        file.write_text(text, encoding="utf-8")
    approved = file.read_text(encoding="utf-8") if file.exists() else ""
    if text != approved:
        diff = difflib.unified_diff(
            approved.splitlines(), text.splitlines(), f"approved {file.name}", "now", n=1, lineterm=""
        )
        test = os.environ.get("PYTEST_CURRENT_TEST", "tests").split("::")[0]
        how = f"If that is right: {RENEW}=1 pytest {test}, and read the diff of tests/outlines."
        pytest.fail("\n".join([*diff, how]), pytrace=False)
