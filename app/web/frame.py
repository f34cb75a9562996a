"""What all pages share: head, light and dark, lines of complaint, progress with cancel, the command to copy."""

from __future__ import annotations

import html
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from nicegui import ui

from app.web.charts import figure as figure_of
from app.web.session import Session
from hil.page import THEMES

__all__ = ["PAGES", "Live", "card", "command_line", "complaint", "figure_of", "frame", "opened", "progress", "table", "tone"]

PAGES = (("/", "Missing physics"), ("/schedule", "Schedule"), ("/run", "Run"))
PRIMARY = "#1f6fc4"


def styles() -> str:
    """The pages' style sheet, in the colours of hil.page's reports."""
    more = {"light": "--page:#f3f5f8;--lift:#eef2f6", "dark": "--page:#0f1419;--lift:#1d252e"}
    themes = [f"body.body--{n}{{{''.join(f'--{k}:{v};' for k, v in c.items())}{more[n]}}}" for n, c in THEMES.items()]
    return "\n".join([*themes, (Path(__file__).parent / "style.css").read_text(encoding="utf-8")])


@contextmanager
def frame(session: Session, here: str) -> Iterator[None]:
    """Head, theme and the column in which a page's cards stand."""
    ui.add_css(styles())
    ui.add_head_html('<link rel="stylesheet" href="/assets/uPlot.css">')
    ui.colors(primary=PRIMARY)
    mode = ui.dark_mode(value=session.dark)
    with ui.element("header").classes("head"):
        ui.link("VaneLoop", "/").classes("brand")
        for path, name in PAGES:
            ui.link(name, path).classes("page" + (" here" if path == here else ""))
        ui.element("div").classes("grow")

        def flip() -> None:
            session.dark = not dark(session)
            mode.value = session.dark
            session.touch("theme")

        ui.button(icon="contrast", on_click=flip).props('flat round dense color=grey aria-label="light or dark"').tooltip("light or dark")

    async def ask() -> None:
        prefers = bool(await ui.run_javascript("matchMedia('(prefers-color-scheme: dark)').matches", timeout=5.0))
        if session.extra.get("prefers_dark") != prefers:
            session.extra["prefers_dark"] = prefers
            session.touch("theme")

    ui.timer(0.01, ask, once=True)
    with ui.element("main").classes("main"):
        yield


def dark(session: Session) -> bool:
    """Whether the page is dark now."""
    return bool(session.extra.get("prefers_dark", False)) if session.dark is None else session.dark


class Live:
    """Redraws parts of a page when what they show has changed: part -> sections of the session that it watches."""

    def __init__(self, session: Session):
        """Look ten times a second; nothing travels to the browser unless something changed."""
        self.session = session
        self.parts: list[tuple[Callable[[], None], tuple[str, ...]]] = []
        self.seen: dict[str, int] = dict(session.versions)
        ui.timer(0.1, self.look)

    def watch(self, draw: Callable[[], None], *sections: str) -> None:
        """Call ``draw`` when one of ``sections`` has changed."""
        self.parts.append((draw, sections))

    def part(self, draw: Callable[[], None], *sections: str, classes: str = "stackc", only: Callable[[], bool] = lambda: True) -> None:
        """Make a box here that ``draw`` fills, now and whenever one of ``sections`` has changed and ``only`` says so."""
        box = ui.element("div").classes(classes)

        def again() -> None:
            if not only():
                return
            box.clear()
            with box:
                draw()

        with box:
            draw()
        self.watch(again, *sections)

    def look(self) -> None:
        """Redraw what has changed."""
        now = dict(self.session.versions)
        changed = {k for k, v in now.items() if self.seen.get(k) != v}
        self.seen = now
        if changed:
            for draw, sections in self.parts:
                if changed.intersection(sections):
                    draw()


@contextmanager
def card(title: str, about: str = "") -> Iterator[None]:
    """A white box with a title."""
    with ui.element("section").classes("vcard"):
        ui.html(f"<h2>{html.escape(title)}</h2>", sanitize=False)
        if about:
            ui.label(about).classes("soft small").style("margin:-4px 0 8px;max-width:110ch")
        yield


def complaint(session: Session, *sections: str) -> None:
    """Lines that the command line would print, where there are any."""
    for s in sections:
        if s in session.errors:
            text = session.errors[s]
            ui.label(text if text == "stopped" else f"vaneloop: {text}").classes("complaint").props('role="alert"')


def progress(session: Session, *names: str) -> None:
    """A bar with what is being done and a button that stops it."""
    job = session.busy(*names)
    if job is None or not job.text:
        return
    with ui.element("div").classes("rowc").style("width:100%;flex-wrap:nowrap"):
        with ui.element("div").classes("stackc").style("gap:3px"):
            share = f", {100 * job.fraction:.0f} %" if job.fraction is not None else ""
            ui.label(f"{job.text}{share} ({job.seconds:.0f} s)").classes("small soft")
            bar = ui.linear_progress(job.fraction or 0.0, show_value=False).props("rounded instant-feedback")
            if job.fraction is None:
                bar.props("indeterminate")
        ui.button("Cancel", icon="close", on_click=session.stop).props("outline dense padding='2px 10px'").classes("cancel")


def command_line(text: str, label: str = "the same as a command") -> None:
    """The equivalent command with a button that copies it."""

    def copy() -> None:
        ui.clipboard.write(text)
        ui.notify("copied")

    with ui.element("div").classes("cmd").tooltip(label):
        ui.html(f"<code>{html.escape(text)}</code>", sanitize=False).style("flex:1;min-width:0")
        ui.button(icon="content_copy", on_click=copy).props('flat dense round size=sm aria-label="copy the command"')


def table(columns: Sequence[str], rows: Sequence[Sequence[Any]], numbers: Sequence[int] = ()) -> None:
    """A small table; a cell that is a tuple ("html", text) is taken as it is."""

    def cell(v: Any) -> str:
        return str(v[1]) if isinstance(v, tuple) else html.escape(str(v))

    head = "".join(f'<th class="{"num" if i in numbers else ""}">{html.escape(c)}</th>' for i, c in enumerate(columns))
    body = "".join(
        "<tr>" + "".join(f'<td class="{"num" if i in numbers else ""}">{cell(v)}</td>' for i, v in enumerate(r)) + "</tr>" for r in rows
    )
    ui.html(f'<div class="scroll"><table class="vtable"><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>', sanitize=False)


def opened(session: Session, title: str, now: bool = False) -> ui.expansion:
    """A part that opens and closes, and stays as it is when it is drawn anew."""
    kept: dict[str, bool] = session.extra.setdefault("opened", {})
    box = ui.expansion(title, value=now or kept.get(title, False), on_value_change=lambda e: kept.__setitem__(title, bool(e.value)))
    return box.classes("w-full").props("dense")


def tone(ratio: float) -> str:
    """Colour of an error in noise floors."""
    return "good" if ratio < 1.2 else "mid" if ratio < 3.0 else "bad"
