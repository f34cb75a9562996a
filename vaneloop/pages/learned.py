"""The page of a law that was learned: its curve with band, where the log has been, formulas, the error falling."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from vaneloop.base.signals import heading
from vaneloop.identification.unmodelled.fitted_candidate import Outcome
from vaneloop.identification.unmodelled.learned_law import LearnedLaw, LearnedSurface
from vaneloop.identification.user_models.by_log import ByLog
from vaneloop.pages.by_log import curves_by_log, log_by_log
from vaneloop.pages.decisions import Explained, explain
from vaneloop.pages.figures import Figure, Line, bars, loop
from vaneloop.pages.page import Page
from vaneloop.pages.story import floors
from vaneloop.pages.style import Tone, capital, number
from vaneloop.pages.surface import BEYOND, map_figure, sections_figure

__all__ = ["BAND", "COLUMNS", "HOW", "about", "curve_figure", "formula_rows", "learned_page", "visited_figure"]

TONES: dict[str, Tone] = {
    "learned": "good", "none": "good", "named": "neutral", "unknown": "bad",
}  # fmt: skip
MORE = 0.15  # of the range, drawn beyond its ends


def curve_figure(law: LearnedLaw) -> Figure:
    """The curve with its band; dashed where no log has been, or where it repeats itself."""
    span = float(law.x[-1] - law.x[0])
    below = np.array([law.x[0] - MORE * span, law.x[0]])
    above = np.array([law.x[-1], law.x[-1] + MORE * span])
    left, right, beyond = np.full(2, law.y[0]), np.full(2, law.y[-1]), "beyond the logs"
    if law.period:
        last, first = law.x >= law.x[-1] - MORE * span, law.x <= law.x[0] + MORE * span
        below, left, above, right = law.x[last] - span, law.y[last], law.x[first] + span, law.y[first]
        beyond = "the same again"
    lines = [
        Line("from", law.x, law.low, "other", 1.0), Line("90 % band", law.x, law.high, "other", 1.0),
        Line("learned", law.x, law.y, "model", 2.0),
        Line(beyond, below, left, "model", 1.4, "dash"), Line(beyond, above, right, "model", 1.4, "dash"),
    ]  # fmt: skip
    out = loop(lines, heading(law.of, law.of_unit), heading(law.name, law.unit))
    low, high, *_, above_all = out["data"]
    high |= {"fill": "tonexty", "fillcolor": "@noise"}
    for line in (low, above_all):  # named by the other of their pair
        line["showlegend"] = False
    return out


def visited_figure(law: LearnedLaw) -> Figure:
    """How much of the logs was where."""
    middle = 0.5 * (law.edges[1:] + law.edges[:-1])
    share = (100.0 * law.visited).tolist()
    return bars(
        [f"{v:.3g}" for v in middle], {"share": share}, "share of samples [%]", x_title=heading(law.of, law.of_unit)
    )


COLUMNS = ["formula", "held-out error, noise floors", "law of the library"]
HOW = "Formulas that come within 5 % of the best, fitted in the curve's place; simplest first."
BAND = "The band holds the curve, as a whole, in 90 % of draws of the log's blocks."


def about(law: LearnedLaw) -> str:
    """What the figure of its curve shows."""
    if law.period:
        return f"{BAND} Dashed: it repeats itself."
    return (
        f"{BAND} Dashed: no log has been there, and the curve stays as at its end. A formula that is the law goes on; "
        f"the notes say how far."
    )


def formula_rows(law: LearnedLaw) -> list[list[str]]:
    """The formulas, a row each."""
    return [[f.text, number(f.error), f.law or "-"] for f in law.formulas]


def learned_page(
    laws: Sequence[LearnedLaw],
    outcome: Outcome,
    said: str,
    notes: Sequence[str],
    by_log: ByLog | None = None,
    command: str = "",
    log: str = "",
    decisions: Mapping[str, Explained] | None = None,
) -> Page:
    """The page of ``vaneloop learn``; ``said``: the answer in one sentence; ``decisions``: as `explain` has it."""
    title = f"A law learned from {Path(log).name}" if laws else f"Learning from {Path(log).name}"
    page = Page(title, said, tone=TONES[outcome.verdict], command=command, log=log)
    for law in laws:
        figures = f"{floors(law.error_before)} → {floors(law.error_after)}"
        page.tile(law.name, figures, "noise floors", "held-out error before and after", "good")
    for law in laws:
        if isinstance(law, LearnedSurface):
            page.section(law.name, f"{capital(law.sentence())}. {BEYOND}")
            page.plot(map_figure(law), "The surface, inside the simulation, with the model's own parameters refitted.")
            page.plot(sections_figure(law), f"The same over {law.of}, at values of {law.second}. {BAND}")
            if law.formulas:
                page.table(COLUMNS, formula_rows(law), HOW)
            continue
        page.section(law.name, f"{capital(law.sentence())}. {about(law)}")
        page.plot(curve_figure(law), "The curve, inside the simulation, with the model's own parameters refitted.")
        page.plot(visited_figure(law), f"Where the logs have been: {heading(law.of, law.of_unit)}.")
        if law.formulas:
            page.table(COLUMNS, formula_rows(law), HOW)
    if outcome.nearest and not laws:
        page.section("What came nearest")
        page.text(", ".join(outcome.nearest) + ".")
    if by_log is not None:
        log_by_log(page, by_log)
        curves_by_log(page, by_log)
    explain(page, decisions or {})
    page.notes(notes)
    return page
