"""Further logs of a model of the user's own, and which part of a log is fitted: ``--also``, ``--fit``, ``--test``."""

from __future__ import annotations

import html
from functools import partial
from typing import TYPE_CHECKING, Any

from nicegui import events, ui

from vaneloop.pages.style import number
from vaneloop.web.choice import LogFile
from vaneloop.web.frame import Live, opened, table

if TYPE_CHECKING:
    from vaneloop.web.session import Session

__all__ = ["FurtherPart", "show_apart"]

PARTS = (("fit", "seconds that are fitted", "all, or FROM:TO"), ("test", "seconds that only test", "none, or FROM:TO"))
LOGS = (("also", "fit another log, too"), ("test", "test with another log"))


class FurtherPart:
    """What the card of the log has of them."""

    def __init__(self, session: Session, live: Live):
        self.s = session
        self.fields: dict[str, ui.input] = {}
        live.part(self._draw, "log", "files", "model", "further", shows=self._shows)

    def _shows(self) -> tuple[Any, ...]:
        s, c = self.s, self.s.choice
        return (
            c.file, c.system, tuple(f.name for f in s.files), tuple(f.name for f in (*c.also, *c.test)),
            c.fit_part, c.test_part,
        )  # fmt: skip

    def _draw(self) -> None:
        s, c = self.s, self.s.choice
        if c.file is None:
            return
        asked = bool(c.also or c.test or c.fit_part or c.test_part)
        with opened(s, "Fit and test", asked).classes("further"):
            ui.label(
                "What is fitted, and what only tests it: parts of this log, such as :200 and 200:"
                + (", or logs of their own." if c.system else ".")
            ).classes("soft small")
            with ui.element("div").classes("rowc"):
                for which, label, hint in PARTS:
                    box = ui.input(label=label, value=getattr(c, f"{which}_part"), placeholder=hint)
                    self.fields[which] = box.props("outlined dense stack-label").classes(f"part-{which}")
                    box.on("keydown.enter", self._parts)
                ui.button("Compare again", icon="refresh", on_click=self._parts).props(
                    "outline dense padding='4px 14px'"
                )
            if c.system is not None:
                for which, label in LOGS:
                    self._logs(which, label)

    def _parts(self) -> None:
        self.s.take_parts(*(str(self.fields[which].value or "").strip() for which, _, _ in PARTS))

    def _logs(self, which: str, label: str) -> None:
        s, c = self.s, self.s.choice
        chosen: list[LogFile] = getattr(c, which)
        free = {i: f.name for i, f in enumerate(s.files) if f != c.file and f not in (*c.also, *c.test)}

        def take(e: events.ValueChangeEventArguments[Any]) -> None:
            if e.value is not None:
                s.take_logs(which, [*chosen, s.files[e.value]])

        with ui.element("div").classes("rowc"):
            box = ui.select(free, label=label, on_change=take).props("outlined dense options-dense")
            box.style("min-width:240px").classes(f"log-{which}")
            for f in chosen:
                with ui.element("div").classes("rowc overlay"):
                    ui.label(f.name).classes("small")
                    ui.button(icon="close", on_click=partial(s.take_logs, which, [x for x in chosen if x != f])).props(
                        f'flat dense round size=sm aria-label="leave {html.escape(f.name)} out"'
                    )


def show_apart(apart: tuple[str, list[str], list[list[Any]]] | None) -> None:
    """The errors of each log apart, or of the part that only tests, where there is one."""
    if apart is None:
        return
    title, columns, rows = apart
    ui.label(title).classes("soft")
    told = [[number(v) if isinstance(v, float) else v for v in row] for row in rows]
    table(columns, told, numbers=[i for i, v in enumerate(rows[0]) if isinstance(v, float)])
