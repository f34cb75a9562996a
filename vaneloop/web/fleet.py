"""Page 4, Fleet: a run folder of `vaneloop fleet`, how far it is, and what its logs say together.

What is shown is the page that ``vaneloop fleet report`` writes, part by part (`vaneloop.pages.fleet`).
"""

from __future__ import annotations

import html
import os
import re
import shlex
from pathlib import Path
from typing import Any

from nicegui import events, ui

from vaneloop.pages.page import Page, Plot, Section
from vaneloop.web.frame import Live, card, command_line, dark, figure_of, frame, table
from vaneloop.web.jobs import WorkError
from vaneloop.web.session import Session

__all__ = ["LOGS", "Fleet", "build", "runs_in"]

LOGS = "fleet_logs"  # where the pages of single logs are, from this page
OFTEN = 2.0  # s between two looks at a run that is not at its end
DEPTH, MOST = 4, 5_000  # folders below the one that is served, and how many of them are looked into
KEY = re.compile(r"[0-9a-f]{64}\.?\w{0,8}")


def runs_in(folder: Path) -> list[str]:
    """Run folders below ``folder``, as seen from there. Links are not followed."""
    found = []
    for looked, (place, inside, files) in enumerate(os.walk(folder)):
        here = Path(place).relative_to(folder)
        if "run.json" in files:
            found.append(str(here))
        if "run.json" in files or len(here.parts) >= DEPTH or looked > MOST:
            inside.clear()
        inside[:] = sorted(d for d in inside if d[0] not in "._")
    return sorted(found)


class Fleet:
    """The run that is looked at.

    state  how far it is (`vaneloop.fleet.state.State` as plain data), and whether it is a campaign's
    page   its report, of the first ``read`` contents that were done
    """

    def __init__(self, session: Session):
        """``session.extra["served"]`` is the folder below which runs are offered."""
        self.s = session
        self.folder = Path(session.extra["served"])
        self.runs = runs_in(self.folder)
        self.run = ""
        self._clear()

    def _clear(self) -> None:
        self.state: dict[str, Any] | None = None
        self.page: Page | None = None
        self.read = -1

    @property
    def path(self) -> str:
        """Folder of the run."""
        return str(self.folder / self.run)

    @property
    def complete(self) -> bool:
        """Whether all that was taken up is done."""
        return self.state is not None and self.state["done"] >= self.state["contents"]

    def choose(self, run: str) -> None:
        """Look at another run."""
        if run != self.run and run in self.runs:
            self.run = run
            self._clear()
            self.s.errors.pop("fleet", None)
            self.s.touch("fleet")
            self.look()

    def find(self) -> None:
        """Look for runs again."""
        self.runs = runs_in(self.folder)
        self.s.touch("fleet")

    def look(self) -> None:
        """Look how far the run is, and read its results when it has come to its end."""
        if self.run and not self.s.working["fleet"] and "fleet" not in self.s.errors:
            self.s.do("fleet", self._look())

    def report(self) -> None:
        """Read the results so far."""
        if self.state is not None and not self.s.working["fleet"]:
            self.s.do("fleet", self._report())

    async def _look(self) -> None:
        run = self.run
        state = await self.s.aside.call("fleet_state", "" if self.state else "looking at the run", run=self.path)
        if run != self.run:
            return
        first, self.state = self.state is None, state
        self.s.touch("fleet")
        if state["done"] != self.read and state["came_to"] and (first or self.complete):
            await self._report()

    async def _report(self) -> None:
        run, done = self.run, self.state["done"] if self.state else -1
        page = await self.s.aside.call("fleet_report", "reading the results", run=self.path, logs=LOGS)
        if run == self.run:
            self.page, self.read = page, done
            self.s.touch("fleet-report")

    async def log(self, name: str) -> str | None:
        """The page of one log as HTML; None: there is none."""
        key = name.removesuffix(".html")
        if not self.run or KEY.fullmatch(key) is None:
            return None
        try:
            return str(await self.s.aside.call("fleet_log", "", run=self.path, key=key))
        except WorkError:
            return None


def build(session: Session, most: int) -> None:
    """Draw the page."""
    if "fleet" not in session.extra:
        session.extra["fleet"] = Fleet(session)
    with frame(session, "/fleet"):
        page = _Page(session, Live(session))
        page.run()
        page.live.part(
            page.report,
            "fleet",
            "fleet-report",
            "theme",
            shows=lambda: (page.fleet.run, page.fleet.page, dark(session)),
        )


class _Page:
    def __init__(self, session: Session, live: Live):
        self.s, self.live = session, live
        self.fleet: Fleet = session.extra["fleet"]

    # ---- the run

    def run(self) -> None:
        """Choose a run; how far it is."""
        f = self.fleet
        f.find()
        with card("1  The run", "A folder that vaneloop fleet run has made, below the folder that is served."):
            self.live.part(self._choose, "fleet", shows=lambda: (tuple(f.runs), f.run), classes="rowc")
            self.live.complaint("fleet")
            self.live.progress("fleet_report", "fleet_state")
            self.live.part(self._state, "fleet", shows=lambda: (str(f.state),))
            so_far = ui.button("Read the results so far", icon="refresh", on_click=f.report)
            so_far.props("outline dense padding='2px 12px'")
            self.live.shown(so_far, lambda: f.state is not None and f.state["done"] > max(f.read, 0), "fleet")
        ui.timer(OFTEN, lambda: None if f.complete and f.read >= 0 else f.look())

    def _choose(self) -> None:
        f = self.fleet

        def chosen(e: events.ValueChangeEventArguments[Any]) -> None:
            f.choose(e.value or "")

        if f.runs:
            ui.select(f.runs, value=f.run or None, label="run folder", on_change=chosen).props(
                "outlined dense options-dense"
            ).style("min-width:260px").classes("run-folder")
        else:
            ui.label("There is none: vaneloop fleet run LOGS --out RUN makes one.").classes("soft")
        ui.button("Look again", icon="search", on_click=f.find).props("flat dense padding='2px 10px'")

    def _state(self) -> None:
        f = self.fleet
        if f.state is None:
            return
        s = f.state
        share = s["done"] / max(s["contents"], 1)
        what = "trials" if s["campaign"] else "logs"
        words = f"{s['done']:,} of {s['contents']:,} {what} done"
        if s["logs"] != s["contents"]:
            words += f"; {s['logs']:,} files, some of them with the same content"
        ui.label(words).classes("verdict good" if f.complete else "verdict").props('role="status"')
        ui.linear_progress(round(share, 3), show_value=False).props('rounded aria-label="share that is done"')
        if s["came_to"]:
            table(["came to", "number"], [[k, f"{n:,}"] for k, n in s["came_to"].items()], numbers=(1,))
        if s["damaged"]:
            table(["damaged, and left out", "reason"], [[name, why] for name, why in s["damaged"].items()])
        for name, kind in s["workers"].items():
            ui.label(f"at work: {kind} {name}").classes("small mono")
        if s["campaign"]:
            ui.label("This is a campaign's run. With its plan, this writes its page:").classes("soft")
            command_line(shlex.join(["vaneloop", "campaign", "PLAN.toml", "--out", f.run, "--report", "campaign.html"]))
        elif not f.complete:
            command_line(shlex.join(["vaneloop", "fleet", "work", f.run]), "joins the run from another terminal")
        else:
            command_line(shlex.join(["vaneloop", "fleet", "report", f.run, "--report", "fleet.html"]))

    # ---- what the logs say

    def report(self) -> None:
        """The report: its verdict and figures, then a card a section."""
        page = self.fleet.page
        if page is None:
            return
        with card("2  What the logs say together"):
            ui.label(page.verdict).classes(f"verdict {page.tone}")
            with ui.element("div").classes("tiles").style("align-items:flex-start"):
                for t in page.tiles:
                    with ui.element("div").classes("tile"):
                        ui.label(f"{t.value} {t.unit}".strip()).classes("v")
                        ui.label(t.label).classes("l")
                        ui.label(t.note).classes("l")
        sections: list[tuple[str, list[str | Plot]]] = []
        for part in page.parts:
            if isinstance(part, Section):
                sections.append((part.title, []))
            else:
                sections[-1][1].append(part)
        for number, (title, parts) in enumerate(sections, 3):
            with card(f"{number}  {title}"):
                for part in (p for p in parts if isinstance(p, str)):
                    ui.html(part.replace("<table>", '<table class="vtable">'), sanitize=False).classes("parts w-full")
                plots = [p for p in parts if isinstance(p, Plot)]
                if plots:
                    with ui.element("div").classes("half" if plots[0].half else "stackc"):
                        for plot in plots:
                            self._plot(page, plot)

    def _plot(self, page: Page, plot: Plot) -> None:
        with ui.element("figure").classes("stackc").style("margin:0"):
            figure_of(page.figures[plot.number], dark(self.s))
            if plot.caption:
                ui.html(f"<figcaption>{html.escape(plot.caption)}</figcaption>", sanitize=False).classes("note")
