"""What reading did to a log, in a sentence and as data: what was left out, cut, filled, converted, guessed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

__all__ = ["COLUMNS", "MOST_ROWS", "Note", "as_rows", "counted", "told"]

MOST_ROWS = 20  # that a note lists; it counts all
COLUMNS = ("done", "to", "how many", "rows", "in words")  # of `as_rows`


class Note(str):
    """A note on a log: the sentence, and what it says as data.

    kind    what was done: ``left out``, ``cut``, ``filled``, ``converted``, ``guessed``, ``joined``
    of      what it was done to: a signal, a column, a message, ``rows``, ``frames``, ``time``
    number  how many samples or rows
    rows    the first of them, as an editor counts
    """

    kind: str
    of: str
    number: int
    rows: tuple[int, ...]

    def __new__(cls, text: str, kind: str, of: str, number: int = 0, rows: Iterable[int] = ()) -> Note:
        note = super().__new__(cls, text)
        note.kind, note.of, note.number, note.rows = kind, of, int(number), tuple(int(r) for r in rows)[:MOST_ROWS]
        return note

    def on(self, log: str) -> Note:
        """The same, which names the log: of several."""
        return Note(f"{log}: {self}", self.kind, self.of, self.number, self.rows)

    def __reduce__(self) -> tuple[Any, ...]:
        return Note, (str(self), self.kind, self.of, self.number, self.rows)


def counted(notes: Iterable[str]) -> list[dict[str, Any]]:
    """The notes that count something, as JSON has them."""
    return [
        {"kind": n.kind, "of": n.of, "count": n.number, "rows": list(n.rows), "said": str(n)}
        for n in notes
        if isinstance(n, Note)
    ]


def told(notes: Iterable[str]) -> dict[str, Any]:
    """What JSON says of the notes: all of them as sentences, and those that count something as data."""
    every = list(notes)
    return {"notes": every, "done": counted(every)}


def as_rows(done: Iterable[Mapping[str, Any]]) -> list[list[Any]]:
    """What was done to a log, as JSON has it (`counted`), as the rows of a table; how many is None where that was not
    counted.
    """
    out = []
    for one in done:
        listed, more = ", ".join(f"{r:,}" for r in one["rows"]), one["count"] - len(one["rows"])
        listed += f" and {more:,} more" if listed and more > 0 else ""
        out.append([one["kind"], one["of"], one["count"] or None, listed, one["said"]])
    return out
