"""The panel "Calibrate" of the page Run: the controller's numbers over XCP, while the loop runs."""

from __future__ import annotations

import shlex

from nicegui import events, ui

from vaneloop.web.frame import Live, card, command_line
from vaneloop.web.running import Loop
from vaneloop.web.tuning import shown

__all__ = ["Calibrate"]


class Calibrate:
    """The panel. Fields stay the same elements while their numbers change; another group is drawn anew."""

    def __init__(self, live: Live, loop: Loop):
        self.live, self.loop, self.tuning = live, loop, loop.tuning
        self.group, self.words = "servo", ""
        self.fields: dict[int, tuple[ui.input, ui.label]] = {}

    def draw(self) -> None:
        """Draw it."""
        t = self.tuning
        with card(
            "4  Calibrate",
            "The controller's numbers over XCP, by the slave that INCA, CANape and pyxcp see. A value acts whole, "
            "between two ticks; the chart marks it.",
        ):
            self.live.part(self._all, "calibrate", "loop", shows=lambda: (bool(t.elements), t.pages.shape))
            self.live.complaint("calibrate")
            self.live.part(self._files, "calibrate", shows=lambda: tuple(map(str, t.saved)))
        self.live.watch(self._now, "calibrate")

    def _all(self) -> None:
        t = self.tuning
        if not t.elements:
            ui.label("Start the loop: then its calibration is read.").classes("soft")
            return
        if not t.pages.shape[1]:
            if self.live.session.working["calibrate"]:
                ui.label("reading the calibration ...").classes("soft").props('role="status"')
            ui.button("Read the calibration", icon="download", on_click=t.read).props(
                "unelevated padding='4px 14px'"
            ).classes("read-calibration")
            return
        with ui.element("div").classes("rowc"):

            def use(e: events.ValueChangeEventArguments[int]) -> None:
                if e.value != t.page:
                    t.use(e.value)

            ui.label("the firmware uses the page").classes("soft")
            self.used = ui.toggle({0: "working", 1: "reference"}, value=t.page, on_change=use).props(
                "dense unelevated no-caps padding='2px 10px' title='page that the firmware uses'"
            )
            ui.button("Copy reference over working", icon="content_copy", on_click=t.copy).props(
                "outline dense padding='4px 12px'"
            )
            ui.button("Save the working page", icon="save", on_click=t.save).props("outline dense padding='4px 12px'")
        groups = t.groups()
        if self.group not in groups:
            self.group = next(iter(groups))
        box = ui.element("div").classes("stackc")

        def again() -> None:
            box.clear()
            with box:
                self._rows()

        def group(e: events.ValueChangeEventArguments[str]) -> None:
            self.group = e.value
            again()

        def find(e: events.ValueChangeEventArguments[str | None]) -> None:
            self.words = (e.value or "").lower()
            again()

        with ui.element("div").classes("rowc") as head:
            ui.select(list(groups), value=self.group, label="group", on_change=group).props(
                "outlined dense options-dense"
            ).style("min-width:200px").classes("calibration-group")
            ui.input(placeholder="or find in all of them", value=self.words, on_change=find).props(
                'outlined dense clearable debounce=300 aria-label="find a calibration value"'
            )
        head.move(target_index=1)
        again()

    def _rows(self) -> None:
        """The numbers of a group, or those in whose name or meaning the words are."""
        t, self.fields = self.tuning, {}
        of = t.groups()[self.group]
        if self.words:
            of = [i for every in t.groups().values() for i in every]
            of = [i for i in of if self.words in f"{t.elements[i].name} {t.elements[i].meaning}".lower()][:60]
        if not of:
            ui.label("nothing has that in its name or meaning").classes("soft")
        with (
            ui.element("div").classes("calibration").props('tabindex="0" role="group" aria-label="calibration values"')
        ):
            for i in of:
                e = t.elements[i]
                unit, low, high = e.border or "-", shown(e.low / e.factor), shown(e.high / e.factor)
                with ui.element("div").classes("calibrated").props(f'data-name="{e.name}"'):
                    with ui.element("div"):
                        ui.label(e.name).classes("name")
                        only = "; in STANDBY only" if e.guarded else ""
                        ui.label(f"{e.meaning}; {low} to {high} {unit}{only}").classes("note")
                    field = ui.input(suffix=unit).props(f'outlined dense aria-label="{e.name} [{unit}]"')

                    def give(i: int = i, field: ui.input = field) -> None:
                        t.change(i, field.value)

                    field.on("keydown.enter", give)
                    field.on("blur", give)
                    self.fields[i] = field, ui.label().classes("note reference")
        self._now()

    def _now(self) -> None:
        """Show the numbers as they are."""
        t = self.tuning
        if not t.pages.shape[1]:
            return
        for i, (field, reference) in self.fields.items():
            factor = t.elements[i].factor
            value, was = (shown(page[i] / factor) for page in t.pages)
            if not field.is_deleted and field.value != value and i not in t.asked:
                field.set_value(value)
            if not reference.is_deleted:
                reference.set_text(f"reference {was}")
                reference.classes(replace="note reference" + (" other" if was != value else ""))
        if not self.used.is_deleted:
            self.used.set_value(t.page)

    def _files(self) -> None:
        saved = self.tuning.saved
        if saved:
            with ui.element("div").classes("rowc"):
                for f in saved:
                    ui.link(f"download {f.name}", f"/saved/tuned-{f.name}").props(f'download="{f.name}"').style(
                        "color:var(--measured)"
                    )
            ui.label("In a folder tuned/ they are a calibration that every command takes:").classes("note")
            command_line("vaneloop run --tables tuned/")
        bus = self.loop.bus_name if self.loop.bus != "lockstep" else "vcan0"
        ui.label("Without this page: the controller on a bus that INCA, CANape or pyxcp join.").classes("note")
        command_line(shlex.join(["vaneloop", "run", "--bus", bus, "--xcp", "--xcp-open", "--xcp-save", "tuned/"]))
