"""Below the curves of a log: channels made by formulas, one channel over another, and what is between the cursors as a
file.
"""

from __future__ import annotations

import html
from functools import partial
from typing import TYPE_CHECKING, Any

from nicegui import events, ui

from hil.logs import Channel
from hil.logs.formula import FUNCTIONS
from vaneloop.base.signals import heading
from vaneloop.web.frame import Live, command_line, dark, figure_of
from vaneloop.web.xy import TIME, plane, xy_figure

if TYPE_CHECKING:
    from vaneloop.web.session import Session

__all__ = ["FormulaPart"]

SAVED = {"between-csv": "between.csv", "between-parquet": "between.parquet"}
SMALL = "outline dense padding='4px 14px'"


class FormulaPart:
    """What the page has of them."""

    def __init__(self, session: Session, live: Live):
        self.s, self.live = session, live
        self.field: ui.input

    def build(self) -> None:
        """Draw it."""
        s, live = self.s, self.live
        with ui.element("div").classes("stackc formulas"):
            ui.html("<h3>Channels of channels</h3>", sanitize=False)
            ui.label(
                "NAME = FORMULA [UNIT], such as lag = x_dem - x_lvdt [um]. Made of all samples of the log. Enter adds "
                f"it. Functions: {', '.join(FUNCTIONS)}."
            ).classes("soft small")
            with ui.element("div").classes("rowc"):
                self.field = ui.input(label="formula").props("outlined dense maxlength=400").classes("formula")
                self.field.style("min-width:min(420px,100%)").on("keydown.enter", self._add)
                ui.button("Add", icon="add", on_click=self._add).props(SMALL).classes("add-formula")
            live.complaint("formula")
            live.part(self._list, "formula", "log", shows=lambda: (tuple(f.text for f in s.formulas), s.made))
            ui.html("<h3>One over the other</h3>", sanitize=False)
            live.part(self._choose, "formula", "log", shows=lambda: (tuple(s.channels()),))
            live.part(
                self._xy, "formula", "log", "xy", "cursors", "theme",
                shows=lambda: (s.preview, s.made, s.xy, s.between(), dark(s)),
            )  # fmt: skip
            ui.html("<h3>Save what is between the cursors</h3>", sanitize=False)
            live.part(
                self._export, "formula", "log", "cursors", "export",
                shows=lambda: (s.preview, s.made, s.between(), tuple(k for k in SAVED if k in s.saved)),
            )  # fmt: skip
            live.complaint("export")

    # ---- formulas

    async def _add(self) -> None:
        text = str(self.field.value or "").strip()
        if text and await self.s.add_formula(text):
            self.field.set_value("")

    def _list(self) -> None:
        s = self.s
        for f in s.formulas:
            made = s.made.get(f.name)
            with ui.element("div").classes("rowc made").style("flex-wrap:nowrap"):
                if isinstance(made, Channel):
                    said = f"{heading(f.name, made.unit)} = {f.expression}, {len(made):,} samples"
                    ui.label(said).classes("small mono")
                else:
                    ui.label(made or f.text).classes("small complaint")
                ui.button(icon="close", on_click=partial(s.drop_formula, f.name)).props(
                    f'flat dense round size=sm aria-label="take {html.escape(f.name)} away"'
                )

    # ---- one over the other

    def _choose(self) -> None:
        s = self.s
        names = list(s.channels())
        if len(names) < 2:
            ui.label("This takes two channels.").classes("soft small")
            return

        def chosen(which: str, e: events.ValueChangeEventArguments[Any]) -> None:
            s.xy = {**s.xy, which: str(e.value or "")}
            s.touch("xy")

        with ui.element("div").classes("rowc"):
            for which, label in (("x", "x axis"), ("y", "y axis"), ("colour", "coloured by")):
                options = names if which != "colour" else [TIME, *names]
                now = s.xy.get(which, TIME if which == "colour" else "")
                box = ui.select(
                    options, value=now if now in options else None, label=label, on_change=partial(chosen, which)
                )
                box.props("outlined dense options-dense").style("min-width:170px").classes(f"xy-{which}")

    def _xy(self) -> None:
        s = self.s
        channels = s.channels()
        x, y, colour = (s.xy.get(k, "") for k in ("x", "y", "colour"))
        if x not in channels or y not in channels:
            ui.label("Choose the channels of both axes.").classes("soft small")
            return
        third = channels.get(colour)
        p = plane(channels[x], channels[y], third, s.between())
        if not p.n:
            ui.label("These channels have no sample at one time between the cursors.").classes("note")
            return
        heads = [heading(n, channels[n].unit) for n in (x, y)]
        heads.append(heading(colour, third.unit) if third is not None else heading(TIME, "s"))
        drawn = f", {len(p.t):,} of them drawn, each extreme among them" if len(p.t) < p.n else ""
        ui.label(
            f"{heads[1]} over {heads[0]}, {self._when()}: {p.n:,} samples{drawn}. Coloured by {heads[2]}; arrows show "
            f"the direction of time, circle and square where it begins and ends."
        ).classes("note xy-said")
        figure_of(xy_figure(p, heads), dark(s), height=430).classes("xy")

    def _when(self) -> str:
        between = self.s.between()
        return f"from {between[0]:g} to {between[1]:g} s" if between else "the whole log"

    # ---- a file

    def _export(self) -> None:
        s = self.s
        if not s.channels():
            return
        ui.label(
            f"Every sample of every channel, those made by formulas too, {self._when()}. Both cursors are set in the "
            "curves above, or typed."
        ).classes("soft small")
        with ui.element("div").classes("rowc"):
            for key, name in SAVED.items():
                kind = "CSV" if name.endswith("csv") else "Parquet"
                ui.button(kind, icon="save", on_click=partial(s.save_channels, key, name)).props(
                    f'{SMALL} aria-label="save the channels as {kind}"'
                )
            for key, name in SAVED.items():
                if key in s.saved:
                    link = ui.link(f"download {name}", f"/saved/{key}").props(f'download="{name}"')
                    link.classes(f"saved-{key}").style("color:var(--measured)")
        if s.offered:  # a model that reads its logs itself has no such command
            command_line(s.export_command(next(iter(SAVED.values()))))
