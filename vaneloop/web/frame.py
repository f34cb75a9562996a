"""What all pages share: head, light and dark, lines of complaint, progress with cancel, the command to copy."""

from __future__ import annotations

import asyncio
import html
import logging
import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from nicegui import ui
from nicegui.element import Element

from hil.logs.notes import COLUMNS, as_rows, counted
from vaneloop.identification.regimes import agrees
from vaneloop.pages.style import THEMES
from vaneloop.web.charts import figure as figure_of
from vaneloop.web.jobs import Job
from vaneloop.web.moments import Moment
from vaneloop.web.session import STOPPED, Session

__all__ = [
    "PAGES", "Live", "card", "command_line", "drop", "figure_of", "frame", "list_of_moments", "notes_of", "opened",
    "table", "tone",
]  # fmt: skip

PAGES = (("/", "Missing physics"), ("/schedule", "Schedule"), ("/run", "Run"), ("/fleet", "Fleet"))
LOG = logging.getLogger("nicegui")  # whose lines the server prints in plain words
PRIMARY = "#1f6fc4"
MOMENTS = 200  # that are listed
NOTES = 6  # that stand on a page as sentences
FAILED = (
    "a part of this page failed, which is a defect of VaneLoop; where the workbench was started a line says which. "
    "Reload the page: what was read and found is still there"
)
OFTEN = 0.05  # s between two looks at what has changed


def styles() -> str:
    """The pages' style sheet, in the colours of vaneloop.pages."""
    more = {"light": "--page:#f3f5f8;--lift:#eef2f6", "dark": "--page:#0f1419;--lift:#1d252e"}
    themes = [f"body.body--{n}{{{''.join(f'--{k}:{v};' for k, v in c.items())}{more[n]}}}" for n, c in THEMES.items()]
    return "\n".join([*themes, (Path(__file__).parent / "style.css").read_text(encoding="utf-8")])


# What holds the focus may be drawn anew, or go: the same control in its place has it then, or else the answer, what
# stops the work that has begun, the main button, the heading of its card. A press elsewhere gives the focus up.
FOCUS = """<script>(() => {
  let last = null, soon = 0;
  const name = (e) => e.getAttribute("aria-label") || e.innerText || e.tagName;
  const there = (e) => e.getClientRects().length > 0;
  const lost = () => last && document.activeElement === document.body && !(last.at.isConnected && there(last.at));
  const title = (card) => card.querySelector("h2")?.innerText;
  addEventListener("pointerdown", () => { last = null; }, true);
  addEventListener("focusin", (e) => {
    const card = e.target.closest(".vcard");
    last = card && e.target.tabIndex >= 0 ? { at: e.target, name: name(e.target), title: title(card) } : null;
  }, true);
  const again = () => {
    const card = lost() && [...document.querySelectorAll(".vcard")].find((c) => title(c) === last.title);
    if (!card) return;
    const all = (css) => [...card.querySelectorAll(css)].filter(there);
    const alike = (e) => e.tabIndex >= 0 && name(e) === last.name && !e.matches(".cancel");
    const next = all("[tabindex],button,input,a,select,summary").find(alike) || all(".verdict")[0]
      || all(".cancel")[0] || all(".q-btn--unelevated")[0] || all("h2")[0];
    if (next && next.tabIndex < 0) next.tabIndex = -1;
    next?.focus({ preventScroll: true, focusVisible: true });
  };
  addEventListener("DOMContentLoaded", () => new MutationObserver(() => {
    if (!soon && lost()) soon = setTimeout(() => { soon = 0; again(); }, 100);
  }).observe(document.body, { childList: true, subtree: true, attributes: true, attributeFilter: ["class", "style"] }));
})();</script>"""


# NiceGUI's bar says "Trying to reconnect" for as long as it takes. It says more where nothing answers any more, or
# where another workbench answers, which does not know this page's token.
GONE = """<script>(() => {
  const ended = "The workbench has ended. Start it again (vaneloop web) and open the link that it prints.";
  const other = "Another workbench runs here now. Open the link that it printed.";
  addEventListener("DOMContentLoaded", () => {
    const bar = document.getElementById("popup"), said = bar?.lastElementChild, waiting = said?.textContent;
    let asking = 0;
    if (!said) return;
    bar.setAttribute("role", "alert");
    const ask = async () => {
      const answer = await fetch("/assets/uPlot.css", { cache: "no-store" }).catch(() => null);
      if (asking) said.textContent = !answer ? ended : answer.status === 403 ? other : waiting;
    };
    new MutationObserver(() => {
      const lost = bar.ariaHidden === "false";
      if (lost && !asking) asking = setInterval(ask, 2000);
      else if (!lost && asking) { clearInterval(asking); asking = 0; said.textContent = waiting; }
    }).observe(bar, { attributes: true, attributeFilter: ["aria-hidden"] });
  });
})();</script>"""


@contextmanager
def frame(session: Session, here: str) -> Iterator[None]:
    """Head, theme and the column in which a page's cards stand."""
    ui.add_css(styles())
    ui.add_head_html('<link rel="stylesheet" href="/assets/uPlot.css">' + FOCUS + GONE)
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

        ui.button(icon="contrast", on_click=flip).props(
            'flat round dense color=grey aria-label="light or dark" title="light or dark"'
        )

    async def ask() -> None:
        try:
            prefers = bool(await ui.run_javascript("matchMedia('(prefers-color-scheme: dark)').matches", timeout=60.0))
        except TimeoutError:  # the browser has gone, or is kept from answering
            return
        if session.extra.get("prefers_dark") != prefers:
            session.extra["prefers_dark"] = prefers
            session.touch("theme")

    ui.timer(0.01, ask, once=True)
    with ui.element("div").classes("main"):  # NiceGUI's own page is the landmark "main"
        ui.html(f"<h1>{html.escape(dict(PAGES)[here])}</h1>", sanitize=False).classes("away")
        yield


def dark(session: Session) -> bool:
    """Whether the page is dark now."""
    return bool(session.extra.get("prefers_dark", False)) if session.dark is None else session.dark


class Live:
    """Redraws parts of a page when what they show has changed: part -> sections of the session that it watches.

    A click on an element that has meanwhile been drawn anew is lost, so nothing is drawn anew for progress, and buttons
    stay.
    """

    def __init__(self, session: Session):
        """Look soon after something has changed; nothing travels to the browser otherwise."""
        self.session = session
        self.parts: list[tuple[Callable[[], None], tuple[str, ...], Element | None]] = []
        self.seen: dict[str, int] = dict(session.versions)
        self.counted = time.monotonic()
        self.looked, self.soon = 0.0, False
        self.client = ui.context.client
        ui.timer(0.5, self.look)
        session.lookers.append(self.wake)
        ui.on_exception(self.failed)
        self.complaint("page")
        self.client.on_delete(lambda: session.lookers.remove(self.wake))

    def wake(self) -> None:
        """Look as soon as what goes on now has ended, but not more often than ``OFTEN`` allows."""
        if not self.soon:
            self.soon = True
            wait = max(0.0, self.looked + OFTEN - time.monotonic())
            asyncio.get_running_loop().call_later(wait, self.look)

    def watch(self, draw: Callable[[], None], *sections: str, of: Element | None = None) -> None:
        """Call ``draw`` when one of ``sections`` has changed, as long as the element that it is ``of`` is there."""
        self.parts.append((draw, sections, of))

    def part(
        self, draw: Callable[[], None], *sections: str, shows: Callable[[], tuple[Any, ...]], classes: str = "stackc"
    ) -> None:
        """Make a box here that ``draw`` fills, now and whenever one of ``sections`` has changed and ``shows`` differs
        from before.
        """
        box = ui.element("div").classes(classes)
        before = shows()

        def again() -> None:
            nonlocal before
            now = shows()
            if not _same(now, before):
                before = now
                box.clear()
                with box:
                    draw()

        with box:
            draw()
        self.watch(again, *sections, of=box)

    def shown(self, element: Element, when: Callable[[], bool], *sections: str) -> None:
        """Show ``element`` only ``when`` that is so; it stays the same element."""

        def show() -> None:
            element.set_visibility(bool(when()))

        show()
        self.watch(show, *sections, of=element)

    def complaint(self, *sections: str) -> None:
        """Lines that the command line would print, where there are any."""

        def draw() -> None:
            for text in shows():
                if text:
                    ui.label(text if text == STOPPED else f"vaneloop: {text}").classes("complaint").props(
                        'role="alert"'
                    )

        def shows() -> tuple[str, ...]:
            return tuple(self.session.errors.get(s, "") for s in sections)

        self.part(draw, *sections, shows=shows)

    def progress(self, *names: str) -> None:
        """A bar with what is being done in jobs of these names, and a button that stops it."""
        with ui.element("div").classes("rowc").style("width:100%;flex-wrap:nowrap") as row:
            with ui.element("div").classes("stackc").style("gap:3px"):
                text = ui.label().classes("small soft work").props('role="status"')
                bar = ui.linear_progress(0.0, show_value=False).props(
                    f'rounded instant-feedback aria-label="progress: {names[0]}"'
                )
            ui.button("Cancel", icon="close", on_click=lambda: self.session.stop(*names)).props(
                "outline dense padding='2px 10px'"
            ).classes("cancel")

        def show() -> None:
            job = self.session.busy(*names)
            row.set_visibility(job is not None and bool(job.text))
            if job is not None:
                share = f", {100 * job.fraction:.0f} %" if job.fraction is not None else ""
                text.set_text(f"{job.text}{share} ({job.seconds:.0f} s{_left(job)})")
                if (job.fraction is None) != ("indeterminate" in bar.props):
                    bar.props(add="indeterminate") if job.fraction is None else bar.props(remove="indeterminate")
                bar.set_value(round(job.fraction or 0.0, 3))

        show()
        self.watch(show, "jobs", of=row)

    def look(self) -> None:
        """Redraw what has changed."""
        self.soon, self.looked = False, time.monotonic()
        if self.client.is_deleted:
            return
        now = dict(self.session.versions)
        changed = {k for k, v in now.items() if self.seen.get(k) != v}
        self.seen = now
        if self.session.jobs and time.monotonic() - self.counted > 0.5:
            self.counted = time.monotonic()
            changed.add("jobs")  # the seconds go on
        if changed:
            self.parts = [p for p in self.parts if p[2] is None or not p[2].is_deleted]
            for draw, sections, of in list(self.parts):
                if changed.intersection(sections) and (of is None or not of.is_deleted):
                    try:
                        draw()
                    except Exception as e:  # the other parts go on
                        LOG.error("a part of the page", exc_info=e)
                        self.failed()

    def failed(self) -> None:
        """Say on the page that a part of it failed; the terminal has the line of the defect."""
        self.session.errors["page"] = FAILED
        self.session.touch("page")


def _left(job: Job) -> str:
    """How long a job may still take, as it went so far; "" before that can be said."""
    f = job.fraction or 0.0
    if f < 0.05 or f >= 1.0 or job.seconds < 2.0:
        return ""
    return f", about {math.ceil(job.seconds * (1.0 - f) / f)} s left"


def _same(a: tuple[Any, ...], b: tuple[Any, ...]) -> bool:
    """Whether two answers of ``shows`` are one: plain values by value, anything else only as the same object."""
    plain = (str, int, float, tuple)
    return len(a) == len(b) and all(
        x is y or (isinstance(x, plain) and isinstance(y, plain) and x == y) for x, y in zip(a, b, strict=True)
    )


@contextmanager
def card(title: str, about: str = "") -> Iterator[None]:
    """A white box with a title."""
    with ui.element("section").classes("vcard"):
        ui.html(f"<h2>{html.escape(title)}</h2>", sanitize=False)
        if about:
            ui.label(about).classes("soft small").style("margin:-4px 0 8px;max-width:110ch")
        yield


def command_line(text: str, label: str = "the same as a command") -> None:
    """The equivalent command with a button that copies it."""

    def copy() -> None:
        ui.clipboard.write(text)
        ui.notify("copied")

    with ui.element("div").classes("cmd") as line:
        line.props["title"] = label
        ui.html(f"<code>{html.escape(text)}</code>", sanitize=False).style("flex:1;min-width:0")
        ui.button(icon="content_copy", on_click=copy).props('flat dense round size=sm aria-label="copy the command"')


def table(columns: Sequence[str], rows: Sequence[Sequence[Any]], numbers: Sequence[int] = ()) -> None:
    """A small table; a cell that is a tuple ("html", text) is taken as it is, the words of a row that has nothing
    after them have the row.
    """

    def cell(v: Any) -> str:
        return str(v[1]) if isinstance(v, tuple) else html.escape(str(v))

    def filled(row: Sequence[Any]) -> int:
        return max((i + 1 for i, v in enumerate(row) if v != ""), default=0)

    def over(row: Sequence[Any], i: int) -> str:
        return f' colspan="{len(row) - i}"' if i + 1 == filled(row) < len(row) else ""

    tags = ["th" if c else "td" for c in columns]  # a heading without words is none
    head = "".join(
        f'<{tag} class="{"num" if i in numbers else ""}">{html.escape(c)}</{tag}>'
        for i, (tag, c) in enumerate(zip(tags, columns, strict=True))
    )
    body = "".join(
        "<tr>"
        + "".join(
            f'<td class="{"num" if i in numbers else ""}"{over(r, i)}>{cell(v)}</td>'
            for i, v in enumerate(r[: filled(r)])
        )
        + "</tr>"
        for r in rows
    )
    ui.html(
        '<div class="scroll" tabindex="0" role="group" aria-label="table">'
        f'<table class="vtable"><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>',
        sanitize=False,
    )


def drop(label: str, most: int, accept: str, on_upload: Any, on_rejected: Any) -> ui.upload:
    """A field to drop a file on, with a button that opens one: by mouse, keyboard and screen reader."""
    box = ui.upload(auto_upload=True, max_file_size=most, on_upload=on_upload, on_rejected=on_rejected)
    box.props(f'accept="{accept}" flat')
    words = html.escape(label, quote=True)
    box.add_slot(
        "header",
        f"""<div class="drop"><span>{words}</span>
        <q-btn dense unelevated no-caps color="primary" padding="4px 14px" label="Choose a file"
        @click="props.pickFiles" />
        <label class="away">{words}<q-uploader-add-trigger /></label></div>""",
    )
    return box


def opened(session: Session, title: str, now: bool = False) -> ui.expansion:
    """A part that opens and closes, and stays as it is when it is drawn anew."""
    kept: dict[str, bool] = session.extra.setdefault("opened", {})
    box = ui.expansion(
        title, value=now or kept.get(title, False), on_value_change=lambda e: kept.__setitem__(title, bool(e.value))
    )
    return box.classes("w-full").props("dense")


def notes_of(session: Session, title: str, notes: Sequence[str], said: Sequence[str] = ()) -> None:
    """Notes on a log: the first as sentences, but for those ``said`` elsewhere; what was done to it, in a table."""
    for note in [n for n in notes if n not in said][:NOTES]:
        ui.label(f"note: {note}").classes("note")
    if rows := as_rows(counted(notes)):
        with opened(session, title):
            table(COLUMNS, [["" if c is None else c for c in row] for row in rows], numbers=(2,))


def list_of_moments(
    live: Live,
    moments: Callable[[], Sequence[Moment]],
    show: Callable[[float], Any],
    *sections: str,
    most: int = MOMENTS,
) -> None:
    """The latest ``most`` moments, the latest on top; a press on one shows it. What is listed already stays the same
    element, so that no press is lost while others come.
    """
    count = ui.label().classes("note")
    box = ui.element("div").classes("events").props('role="log" tabindex="0" aria-label="what happened"')
    rows: dict[Moment, ui.element] = {}

    def draw() -> None:
        now = list(moments())[-most:]
        left_out = len(moments()) - len(now)
        count.set_text(f"the latest {most} of {len(moments()):,}" if left_out else "")
        count.set_visibility(bool(left_out))
        kept = set(now)
        for gone in [m for m in rows if m not in kept]:
            rows.pop(gone).delete()
        for m in now:
            if m in rows:
                continue
            with box:
                if m.t is None:
                    rows[m] = ui.label(m.line).classes("small mono moment")
                else:
                    rows[m] = ui.button(m.line, on_click=lambda m=m: show(m.t))
                    rows[m].props("flat dense no-caps align=left padding='0 6px'").classes("small mono moment")
            rows[m].move(target_index=0)
        box.set_visibility(bool(now))

    draw()
    live.watch(draw, *sections, of=box)


def tone(ratio: float) -> str:
    """Colour of an error in noise floors."""
    return "good" if agrees(ratio, 1.0) else "mid" if ratio < 3.0 else "bad"
