"""What every answer can do, whatever was asked: say itself as a sentence, JSON, tables, a page, pictures."""

from __future__ import annotations

import base64
import html
import io
import threading
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hil.logs.channels import Channels
from vaneloop.base.errors import InputError, meant
from vaneloop.base.extras import is_there, needed, needs
from vaneloop.base.notebook import html_table
from vaneloop.base.signals import heading
from vaneloop.pages.story import verdict_word
from vaneloop.pages.style import THEMES, painted
from vaneloop.verbs.curves import Curves, curves_of_logs, curves_of_stages
from vaneloop.verbs.estimates import Correlation, Fitted, Parameters, correlation_of, parameters_of

if TYPE_CHECKING:
    import plotly.graph_objects
    from matplotlib.axes import Axes
    from pandas import DataFrame

    from vaneloop.identification.user_models.by_log import ByLog
    from vaneloop.pages.page import Page

__all__ = ["Answer", "Row", "WholePage"]

Row = Mapping[str, object]
COLOUR = THEMES["light"]
INCHES, DOTS = (7.2, 3.0), 100  # of the picture in a notebook's cell
ROWS = 12  # of a table in a notebook's cell

_working = threading.RLock()  # a model's run has memory of its own: curves of an answer are worked out one by one


class WholePage:
    """The whole page of an answer, as a notebook's cell shows it: some megabytes, with all its pictures."""

    def __init__(self, page: Page):
        self._page = page

    def __repr__(self) -> str:
        """What it says, in a console."""
        return f"{self._page.title}: {self._page.verdict}"

    def _repr_html_(self) -> str:
        """Show the page in a frame of its own."""
        inside = html.escape(self._page.html(), quote=True)
        return f'<iframe srcdoc="{inside}" width="100%" height="600" title="{html.escape(self._page.title)}"></iframe>'


class Answer:
    """An answer; `sentence`, `to_dict`, `rows` and `page` are the verb's own, the rest follows from them.

    Answers are not changed once they are made: threads may share one. A picture on the axes of ``plot(ax=...)`` is the
    caller's; without ``ax`` it is made by ``matplotlib.pyplot``, which is for one thread alone.
    """

    log: str
    by_log: ByLog | None = None  # of a user's own system: what the answer means log by log

    def sentence(self) -> str:
        """The answer in one sentence."""
        raise NotImplementedError

    def to_dict(self) -> dict[str, object]:
        """The answer as the JSON of the command (docs/architecture.md)."""
        raise NotImplementedError

    def rows(self) -> Sequence[Row]:
        """The answer's table, a mapping a row."""
        raise NotImplementedError

    def page(self, command: str = "") -> Page:
        """The answer as a page, not yet written; ``command``: what the user typed."""
        raise NotImplementedError

    def _fits(self) -> Sequence[Fitted]:
        """What was fitted to the log; nothing by default."""
        return ()

    def _worked_out(self) -> Curves:
        if self.by_log is None:
            return curves_of_stages(self._fits(), self.log)
        d = self.by_log.d
        return curves_of_logs(self.by_log.logs, d.final.theta, d.base.theta, self.log)

    @cached_property
    def _curves(self) -> Curves:
        with _working:
            return self._worked_out()

    @cached_property
    def params(self) -> Parameters:
        """Every parameter that was fitted: value, standard error, 90 % interval, unit, bounds.

        A mapping by name, ``answer.params["valve_dead_band.half_width"].value``; ``params.to_frame()`` is a
        ``pandas.DataFrame``.
        """
        return parameters_of(self._fits())

    @cached_property
    def correl(self) -> Correlation:
        """Correlations of the errors of `params`: a mapping of mappings, with ``to_frame()``."""
        return correlation_of(self._fits())

    @property
    def residuals(self) -> Channels:
        """Measured minus model, of every output that was fitted, in its unit; used as a log is.

        Of a model that integrates, what remains after each window's own constant.
        """
        return self._curves.residuals

    @property
    def fitted(self) -> Channels:
        """What the fitted model says where something was measured; used as a log is."""
        return self._curves.fitted

    def to_frame(self) -> DataFrame:
        """The answer's table as a ``pandas.DataFrame``; InputError where pandas is not installed."""
        pandas = needed("to_frame", "pandas")
        return pandas.DataFrame([dict(row) for row in self.rows()])

    def report(self, path: str | Path, command: str = "") -> Path:
        """Write the page, one self-contained HTML file.

        Parameters
        ----------
        path : str or Path
            The file.
        command : str, optional
            What the user typed, for the page's foot.

        Returns
        -------
        Path

        Raises
        ------
        InputError
            Where it cannot be written.
        """
        return self.page(command).write(path)

    def show(self) -> WholePage:
        """The whole page in a notebook's cell, with all its pictures: some megabytes."""
        return WholePage(self.page())

    def figure(self, which: int = 0) -> plotly.graph_objects.Figure:
        """A picture of the page, the first by default, as a plotly figure."""
        import plotly.graph_objects as go

        figures = self.page().figures
        return go.Figure(painted(figures[which]) if figures else None)

    def plot(self, ax: Axes | None = None, *, signal: str = "", residuals: bool = False) -> Axes:
        """Draw what was measured and what the model says of it.

        Parameters
        ----------
        ax : matplotlib.axes.Axes, optional
            Where to draw; default: a figure of its own, by ``matplotlib.pyplot``.
        signal : str, optional
            One of ``answer.fitted``; default: the one that the nominal model misses most.
        residuals : bool, optional
            Draw what is left in place of the curves.

        Returns
        -------
        matplotlib.axes.Axes

        Raises
        ------
        InputError
            For a signal that was not fitted, and where matplotlib is not installed.
        """
        curves = self._curves
        name = signal or curves.worst()
        if name not in curves.by_name:
            allowed = ", ".join(curves.by_name) or "nothing, as nothing was fitted"
            raise InputError(f"plot: signal (={name!r}){meant(name, curves.by_name)}: allowed: {allowed}")
        ax = axes(ax)
        c = curves.by_name[name]
        changed = not np.array_equal(c.residual, c.before, equal_nan=True)
        errors = [("nominal model", c.before, COLOUR["muted"])] if changed else []
        errors.append(("with what was found" if changed else "model", c.residual, COLOUR["model"]))
        if not residuals:
            ax.plot(c.t, c.measured, color=COLOUR["measured"], linewidth=2.0, label="measured")
        for label, error, colour in errors:
            ax.plot(c.t, error if residuals else c.measured - error, color=colour, linewidth=0.8, label=label)
        return labelled(ax, heading(f"residual of {name}" if residuals else name, c.unit))

    def __str__(self) -> str:
        """Return the answer in one sentence."""
        return self.sentence()

    def __repr__(self) -> str:
        """What was asked of which log, and the answer, on one line."""
        return f"<{type(self).__name__} of {Path(self.log).name or 'a log'}: {self.sentence()}>"

    def _repr_html_(self) -> str:
        """Show it in a notebook's cell: sentence, tables and one picture; `show` has the whole page."""
        parts = [f"<p><strong>{html.escape(self.sentence())}</strong></p>"]
        if rows := list(self.rows()):
            columns = list(rows[0])
            told = [{**row, "verdict": verdict_word(str(row.get("verdict")))} for row in rows[:ROWS]]
            parts.append(html_table(columns, [[row.get(c) for c in columns] for row in told]))
            if len(rows) > ROWS:
                parts.append(f"<p>and {len(rows) - ROWS} rows more: <code>answer.to_frame()</code></p>")
        parts.append(self._picture())
        parts.append(
            "<p><code>answer.params</code>: parameters and their errors. <code>answer.show()</code>: the whole page "
            "here. <code>answer.report('page.html')</code>: the page as a file.</p>"
        )
        return "\n".join(p for p in parts if p)

    def _picture(self) -> str:
        """What `plot` draws, as a small picture in HTML; "" where there is nothing to draw, or nothing to draw with."""
        if not is_there("matplotlib"):
            return ""
        from matplotlib.figure import Figure

        figure = Figure(figsize=INCHES, dpi=DOTS, layout="constrained")
        try:
            self.plot(figure.subplots())
        except InputError:
            return ""
        file = io.BytesIO()
        figure.savefig(file, format="png")
        data = base64.b64encode(file.getvalue()).decode()
        return f'<img alt="{html.escape(self.sentence(), quote=True)}" src="data:image/png;base64,{data}">'


def axes(ax: Axes | None) -> Axes:
    """Axes to draw on: the caller's, or those of a figure of its own. InputError where matplotlib is not installed."""
    if ax is not None:
        return ax
    needs("plot", "matplotlib")
    pyplot = needed("plot", "matplotlib.pyplot")
    return pyplot.subplots(figsize=INCHES, layout="constrained")[1]


def labelled(ax: Axes, y: str, x: str = "t [s]") -> Axes:
    """Axes with their quantities written to them."""
    ax.set_xlabel(x)
    ax.set_ylabel(y)
    ax.grid(color=COLOUR["grid"], linewidth=0.6)
    if len(ax.get_legend_handles_labels()[1]) > 1:
        ax.legend(loc="best", fontsize="small")
    ax.margins(x=0.0)
    return ax
