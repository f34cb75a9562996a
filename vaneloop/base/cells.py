"""Text in the cells of a CSV that a spreadsheet may open.

A spreadsheet takes a cell that begins with =, +, -, @, a tab or a carriage return for a formula and runs it (OWASP, CSV
injection). Names come from files of others, so such a text gets an apostrophe in front, which a spreadsheet reads as
"this is text". A text that has such an apostrophe already gets another, so that reading takes exactly one off.
"""

from __future__ import annotations

import re

__all__ = ["FORMULA", "marked", "unmarked"]

FORMULA = r"^'*[=+\-@\t\r](?s:.)"  # a sign alone is no formula: the unit - is no number's
_FORMULA = re.compile(FORMULA)


def marked(text: str) -> str:
    """A text as a cell that no spreadsheet runs."""
    return f"'{text}" if _FORMULA.match(text) else text


def unmarked(cell: str) -> str:
    """The text of a cell that `marked` made; any other cell as it is."""
    return cell[1:] if cell.startswith("'") and _FORMULA.match(cell) else cell
