"""What all pages share: head with the three pages, light and dark, styles, lines of complaint, progress with cancel, the command to copy."""

from __future__ import annotations

import html
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from nicegui import ui

from app.web.session import Session
from hil.page import THEMES

__all__ = ["PAGES", "Live", "card", "command_line", "complaint", "frame", "progress", "table", "tone"]

PAGES = (("/", "Missing physics"), ("/schedule", "Schedule"), ("/run", "Run"))
PRIMARY = "#1f6fc4"


def styles() -> str:
    """The pages' style sheet, colours of hil.page's reports."""

    def variables(name: str, page: str, soft: str) -> str:
        return "".join(f"--{k}:{v};" for k, v in THEMES[name].items()) + f"--page:{page};--lift:{soft}"

    return f"body.body--light{{{variables('light', '#f3f5f8', '#eef2f6')}}}\nbody.body--dark{{{variables('dark', '#0f1419', '#1d252e')}}}\n{_STYLE}"


_STYLE = """
body{background:var(--page)!important;color:var(--text);font:15px/1.45 system-ui,-apple-system,"Segoe UI",Roboto,"Noto Sans","DejaVu Sans",sans-serif}
.nicegui-content{padding:0;gap:0;display:block;width:100%}
.head{background:var(--panel);color:var(--text);border-bottom:1px solid var(--grid);box-shadow:none;padding:0 22px;height:52px;display:flex;
 flex-wrap:nowrap;align-items:center;gap:26px}
.brand{font-weight:700;font-size:18px;letter-spacing:.01em;color:var(--text);text-decoration:none}
.head a.page{color:var(--soft);text-decoration:none;font-size:15px;line-height:50px;border-bottom:2px solid transparent}
.head a.page.here{color:var(--text);font-weight:600;border-color:var(--measured)}
.head a.page:hover{color:var(--text)}
.grow{flex:1}
.main{max-width:1840px;margin:0 auto;padding:16px 22px 40px;display:flex;flex-direction:column;gap:14px;width:100%}
.vcard{background:var(--panel);border:1px solid var(--grid);border-radius:8px;padding:14px 18px 16px;width:100%;min-width:0}
.vcard h2{font-size:17px;font-weight:650;line-height:1.3;margin:0 0 8px;letter-spacing:0}
.vcard h3{font-size:14px;font-weight:650;line-height:1.3;margin:12px 0 4px;letter-spacing:0;color:var(--text)}
.soft{color:var(--soft)}.small{font-size:13.5px}.mono{font-family:ui-monospace,"DejaVu Sans Mono",monospace;font-size:13px}
.two{display:grid;grid-template-columns:minmax(350px,28%) minmax(0,1fr);gap:22px;width:100%;align-items:start}
.half{display:grid;grid-template-columns:repeat(2,minmax(0,1fr));gap:22px;width:100%;align-items:start}
@media(max-width:1000px){.two,.half{grid-template-columns:minmax(0,1fr)}}
.stackc{display:flex;flex-direction:column;gap:8px;min-width:0;width:100%}
.rowc{display:flex;flex-wrap:wrap;align-items:center;gap:10px;min-width:0}
.verdict{padding:10px 16px;border-left:5px solid var(--measured);background:var(--lift);border-radius:5px;font-size:17px;line-height:1.4;overflow-wrap:anywhere}
.verdict.good{border-color:var(--good)}.verdict.bad{border-color:var(--bad)}
.complaint{padding:8px 14px;border-left:5px solid var(--bad);background:var(--lift);border-radius:5px;overflow-wrap:anywhere;width:100%}
.note{color:var(--soft);font-size:13.5px;overflow-wrap:anywhere}
.vtable{border-collapse:collapse;width:100%;font-size:13.5px;font-variant-numeric:tabular-nums}
.vtable th,.vtable td{padding:4px 10px 4px 0;text-align:left;border-bottom:1px solid var(--grid);overflow-wrap:anywhere}
.vtable th{color:var(--soft);font-weight:600;font-size:13px;vertical-align:bottom}
.vtable .num{text-align:right;white-space:nowrap}.vtable tr:last-child td{border-bottom:0}
.bar{display:inline-block;height:9px;border-radius:2px;background:var(--good);vertical-align:middle}
.bar.bad{background:var(--bad)}.bar.mid{background:var(--model)}
.scroll{overflow-x:auto;width:100%}
.cmd{display:flex;align-items:center;gap:8px;background:var(--lift);border-radius:5px;padding:3px 6px 3px 12px;min-width:0;width:100%}
.cmd code{font-family:ui-monospace,"DejaVu Sans Mono",monospace;font-size:13px;flex:1;overflow-wrap:anywhere;color:var(--text)}
.q-uploader{width:100%!important;max-height:none!important;background:var(--lift)!important;color:var(--text)!important;box-shadow:none!important;
 border:1px dashed var(--muted);border-radius:8px}
.q-uploader__header{background:transparent!important;color:var(--text)!important}
.q-uploader__list{padding:0!important;min-height:0!important}.q-uploader__subtitle,.q-uploader__list .q-uploader__file{display:none}
.q-field--outlined .q-field__control{border-radius:6px}
.body--dark .q-field__native,.body--dark .q-field__label{color:var(--text)}
.curves{position:relative;width:100%;min-width:0}
.curves-legend{display:flex;flex-wrap:wrap;gap:4px 16px;padding:0 0 2px 60px;min-height:6px}
.curves-name{all:unset;cursor:pointer;font-size:13px;color:var(--text);display:inline-flex;align-items:center;gap:6px}
.curves-name:focus-visible{outline:2px solid var(--measured)}
.curves-name i{width:16px;height:3px;border-radius:2px}.curves-name.off{opacity:.4;text-decoration:line-through}
.curves-hint{color:var(--soft);font-size:12px;padding-left:60px}
.curves .uplot{position:relative}
.curves-readout{position:absolute;top:2px;right:18px;font-size:12px;color:var(--text);background:var(--panel);opacity:.92;padding:0 6px;border-radius:3px;
 pointer-events:none;font-variant-numeric:tabular-nums;max-width:80%;white-space:nowrap;overflow:hidden}
.u-select{background:color-mix(in srgb,var(--measured) 18%,transparent)!important}
.u-cursor-x,.u-cursor-y{border-color:var(--muted)!important}
.effect{display:grid;grid-template-columns:44px minmax(0,1fr) 92px;align-items:center;gap:2px 8px;padding:3px 0;border-bottom:1px solid var(--grid)}
.effect .name{font-weight:600;overflow-wrap:anywhere}.effect .about{grid-column:2/4;font-size:13px;color:var(--soft);line-height:1.35}
.gain{height:8px;background:var(--lift);border-radius:3px;overflow:hidden}.gain i{display:block;height:100%;background:var(--muted)}
.effect.on .gain i{background:var(--model)}
.effects{max-height:560px;overflow-y:auto;padding-right:6px;width:100%}
.turn{display:grid;grid-template-columns:minmax(0,1fr) 116px;gap:0 14px;align-items:center;width:100%}
.turn .what{grid-column:1/3;font-size:13px}
.lamp{display:inline-flex;align-items:center;gap:7px;font-size:13.5px;padding:2px 10px;border-radius:12px;background:var(--lift)}
.lamp i{width:10px;height:10px;border-radius:50%;background:var(--muted);opacity:.5}
.lamp.good i{background:var(--good);opacity:1}.lamp.bad i{background:var(--bad);opacity:1;box-shadow:0 0 7px var(--bad)}.lamp.mid i{background:var(--model);opacity:1}
.trace{font-family:ui-monospace,"DejaVu Sans Mono",monospace;font-size:12.5px;white-space:pre;overflow:auto;height:250px;background:var(--lift);
 border-radius:6px;padding:8px 12px;line-height:1.45}
.tiles{display:flex;flex-wrap:wrap;gap:8px 26px}
.tile .v{font-size:24px;font-weight:600;line-height:1.2;font-variant-numeric:tabular-nums}.tile .l{font-size:13px;color:var(--soft)}
.q-btn{text-transform:none;letter-spacing:0}
.q-expansion-item .q-item{padding:4px 0;min-height:36px}
"""


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

    def part(self, draw: Callable[[], None], *sections: str, classes: str = "stackc") -> None:
        """Make a box here that ``draw`` fills, now and whenever one of ``sections`` has changed."""
        box = ui.element("div").classes(classes)

        def again() -> None:
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
    with ui.element("div").classes("cmd").tooltip(label):
        ui.html(f"<code>{html.escape(text)}</code>", sanitize=False).style("flex:1;min-width:0")
        ui.button(icon="content_copy", on_click=lambda: (ui.clipboard.write(text), ui.notify("copied"))).props(
            'flat dense round size=sm aria-label="copy the command"'
        )


def table(columns: Sequence[str], rows: Sequence[Sequence[Any]], numbers: Sequence[int] = ()) -> None:
    """A small table; a cell that is a tuple ("html", text) is taken as it is."""

    def cell(v: Any) -> str:
        return str(v[1]) if isinstance(v, tuple) else html.escape(str(v))

    head = "".join(f'<th class="{"num" if i in numbers else ""}">{html.escape(c)}</th>' for i, c in enumerate(columns))
    body = "".join(
        "<tr>" + "".join(f'<td class="{"num" if i in numbers else ""}">{cell(v)}</td>' for i, v in enumerate(r)) + "</tr>" for r in rows
    )
    ui.html(f'<div class="scroll"><table class="vtable"><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>', sanitize=False)


def tone(ratio: float) -> str:
    """Colour of an error in noise floors."""
    return "good" if ratio < 1.2 else "mid" if ratio < 3.0 else "bad"
