"""A law that the library does not have, learned where a diagnosis says "unknown": looked for, shown, saved, added."""

from __future__ import annotations

from typing import TYPE_CHECKING

from nicegui import ui

from vaneloop.base.signals import heading
from vaneloop.identification.unmodelled.learned_law import LearnedSurface
from vaneloop.pages.learned import BAND, COLUMNS, HOW, about, curve_figure, formula_rows, visited_figure
from vaneloop.pages.story import floors
from vaneloop.pages.style import capital
from vaneloop.pages.surface import BEYOND, map_figure, sections_figure
from vaneloop.web.charts import figure as figure_of
from vaneloop.web.frame import Live, command_line, dark, table

if TYPE_CHECKING:
    from vaneloop.identification.unmodelled.learned_law import LearnedLaw
    from vaneloop.web.session import Session

__all__ = ["LearnedPart", "unknown_stages"]

FILES = {"law": "law.toml", "law-page": "law.html"}
TONES = {"learned": "good", "none": "good", "named": ""}


def unknown_stages(session: Session) -> list[str]:
    """Stages in which something acts that the library does not have."""
    d = session.diagnosis
    return [] if d is None else [x.stage for x in d["diagnosis"].stages if x.verdict == "unknown"]


class LearnedPart:
    """What the page has of it, below the diagnosis."""

    def __init__(self, session: Session, live: Live):
        self.s, self.live = session, live

    def build(self) -> None:
        """Draw it."""
        s, live = self.s, self.live
        learn = ui.button("Learn the law", icon="auto_graph", on_click=self.learn).props("unelevated size=md")
        ready = lambda: bool(unknown_stages(s)) and s.learned is None and not s.working["learn"]  # noqa: E731
        live.shown(learn.classes("learn-law self-start"), ready, "diagnosis", "learn", "log", "jobs")
        live.progress("learn")
        live.complaint("learn")
        live.part(self._learned, "learn", "diagnosis", "log", "theme", shows=lambda: (s.learned, dark(s)))
        add = ui.button("Add the law to the model", icon="add", on_click=self.add)
        add.props("outline dense padding='4px 14px'").classes("add-law self-start")
        live.shown(add, lambda: "law" in s.saved, "learn", "diagnosis", "log", "jobs")

    # ---- what is done

    def command(self) -> str:
        """The same as a command."""
        return self.s.command("learn", "--out", FILES["law"], "--report", FILES["law-page"])

    def learn(self) -> None:
        """Look for the law, as ``vaneloop learn`` does."""
        if unknown_stages(self.s) and not self.s.working["learn"]:
            self.s.do("learn", self._learn())

    async def _learn(self) -> None:
        s = self.s
        d = s.diagnosis
        assert d is not None
        s.learned = None
        files = {key: s.anew(key, name) for key, name in FILES.items()}
        learned = await s.search.call(
            "learn", "learning a law", words=s.words(), diagnosis=d["diagnosis"],
            law=str(files["law"]), page=str(files["law-page"]), command=self.command(),
        )  # fmt: skip
        if s.diagnosis is d:
            s.learned = learned
            s.saved |= {key: f for key, f in files.items() if f.exists()}
        s.touch("learn")

    def add(self) -> None:
        """Run ``vaneloop extend`` with the law."""
        if "law" in self.s.saved:
            self.s.save_model(self.s.saved["law"])

    # ---- what is shown

    def _learned(self) -> None:
        """Where it acts, of what, its curve, its formulas, and the error before and after."""
        s, learned = self.s, self.s.learned
        if learned is None:
            if unknown_stages(s):
                ui.label(
                    "The library has no effect that explains this error. A law can be learned from this log: at every "
                    "place of the model, as a function of every quantity that the log has."
                ).classes("note")
            return
        ui.label(learned["sentence"]).classes(f"verdict learned {TONES.get(learned['verdict'], 'bad')}")
        for law in learned["laws"]:
            with ui.element("div").classes("verdict fell good"):
                ui.label(f"{floors(law.error_before)} → {floors(law.error_after)} noise floors").classes("v law-error")
                ui.label(f"{law.name}: held-out error before and after").classes("l")
            if isinstance(law, LearnedSurface):
                ui.label(f"{capital(law.sentence())}. {BEYOND} {BAND}").classes("note")
                with ui.element("div").classes("half"):
                    figure_of(map_figure(law), dark(s), height=300)
                    figure_of(sections_figure(law), dark(s), height=300)
                self._formulas(law)
                continue
            bars = f"Bars: {heading(law.of, law.of_unit)} of the log."
            ui.label(f"{capital(law.sentence())}. {about(law)} {bars}").classes("note")
            with ui.element("div").classes("half"):
                figure_of(curve_figure(law), dark(s), height=300)
                figure_of(visited_figure(law), dark(s), height=300)
            self._formulas(law)
        if learned["nearest"] and not learned["laws"]:
            ui.label(f"What came nearest: {', '.join(learned['nearest'])}.").classes("note")
        for note in learned["notes"]:
            ui.label(f"note: {note}").classes("note")
        with ui.element("div").classes("rowc"):
            for key, name in FILES.items():
                if key in s.saved:
                    link = ui.link(f"download {name}", f"/saved/{key}").props(f'download="{name}"')
                    link.classes(f"saved-{key}").style("color:var(--measured)")
        command_line(self.command())
        if "law" in s.saved:
            command_line(s.command("extend", "--effect", FILES["law"], *s.extend_words()))

    def _formulas(self, law: LearnedLaw) -> None:
        """Closed forms that would do in the law's place."""
        if law.formulas:
            ui.label(HOW).classes("note")
            table(COLUMNS, formula_rows(law), numbers=(1,))
