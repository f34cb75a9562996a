"""How a result shows itself in a notebook and in a console: a table as text, and as HTML."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence

__all__ = ["html_table", "shown", "text_table"]


def shown(value: object, digits: int = 4) -> str:
    """A value as a cell has it: numbers with so many digits, nothing for what is not known."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.{digits}g}"
    return f"{value:,}" if isinstance(value, int) else str(value)


def _flush_right(rows: Sequence[Sequence[object]], k: int) -> bool:
    """Whether a column holds numbers."""
    return all(isinstance(row[k], int | float) and not isinstance(row[k], bool) for row in rows)


def text_table(columns: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """A table as text, a line a row."""
    cells = [list(columns), *([shown(v) for v in row] for row in rows)]
    right = [_flush_right(rows, k) for k in range(len(columns))]
    width = [max(len(row[k]) for row in cells) for k in range(len(columns))]
    return "\n".join(
        "  ".join(c.rjust(w) if r else c.ljust(w) for c, w, r in zip(row, width, right, strict=True)).rstrip()
        for row in cells
    )


def html_table(columns: Sequence[str], rows: Sequence[Sequence[object]], caption: str = "") -> str:
    """A table as HTML; all text is escaped: names out of logs cannot become markup."""
    e = html.escape
    side = [' style="text-align:right"' if _flush_right(rows, k) else ' style="text-align:left"'
            for k in range(len(columns))]  # fmt: skip
    head = "".join(f'<th scope="col"{s}>{e(c)}</th>' for c, s in zip(columns, side, strict=True))
    body = "".join(
        "<tr>" + "".join(f"<td{s}>{e(shown(v))}</td>" for v, s in zip(row, side, strict=True)) + "</tr>" for row in rows
    )
    note = f'<caption style="text-align:left">{e(caption)}</caption>' if caption else ""
    return f"<table>{note}<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
