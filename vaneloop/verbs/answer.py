"""What every answer can do, whatever was asked: say itself in a sentence, as JSON, as a page, as a picture."""

from __future__ import annotations

import html
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vaneloop.pages.style import painted

if TYPE_CHECKING:
    import plotly.graph_objects

    from vaneloop.pages.page import Page

__all__ = ["Answer"]


class Answer:
    """An answer; `sentence`, `to_dict` and `page` are the verb's own, the rest follows from them."""

    log: str

    def sentence(self) -> str:
        """The answer in one sentence."""
        raise NotImplementedError

    def to_dict(self) -> dict[str, Any]:
        """The answer as the JSON of the command (docs/architecture.md)."""
        raise NotImplementedError

    def page(self, command: str = "") -> Page:
        """The answer as a page, not yet written; ``command``: what the user typed."""
        raise NotImplementedError

    def report(self, path: str | Path, command: str = "") -> Path:
        """Write the page, one self-contained HTML file; return its path. Raises InputError where that cannot be."""
        return self.page(command).write(path)

    def plot(self, which: int = 0) -> plotly.graph_objects.Figure:
        """A picture of the page, the first by default, as a plotly figure."""
        import plotly.graph_objects as go

        figures = self.page().figures
        return go.Figure(painted(figures[which]) if figures else {})

    def __str__(self) -> str:
        """Return the answer in one sentence."""
        return self.sentence()

    def _repr_html_(self) -> str:
        """Show the page in a notebook's cell."""
        inside = html.escape(self.page().html(), quote=True)
        return f'<p>{html.escape(self.sentence())}</p><iframe srcdoc="{inside}" width="100%" height="600"></iframe>'
