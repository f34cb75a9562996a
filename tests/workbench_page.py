"""A page of the workbench without server and browser: what stands on it as text, and a user who acts on it.

NiceGUI keeps a page as a tree of elements in this process; here nothing is sent to a browser. What a worker would
answer is given beforehand. A `Transcript` notes after each act which questions went to workers, which complaints there
are, and what has changed on the page; tests hold it against the text that was approved (`tests/page_outline.py`).
"""

from __future__ import annotations

import asyncio
import difflib
import html
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nicegui import Client, core, events, ui
from nicegui.element import Element
from nicegui.helpers import event_type_to_camel_case, expects_arguments
from nicegui.page import page

from tests.page_outline import digest, figure_lines
from vaneloop.web.charts import Curves, Figure
from vaneloop.web.frame import Live
from vaneloop.web.jobs import Cancelled, Worker
from vaneloop.web.session import Session

__all__ = ["HELD", "Clock", "Opened", "Transcript", "answering", "curves_in_words", "in_a_loop", "settled", "tree"]

HELD = object()  # in place of an answer: the worker is still at it
# what NiceGUI gives every element of a kind
USUAL: dict[str, Any] = {
    "color": "primary", "loopback": True, "sanitize": False, "tag": "div", "error": None, "type": "text", "size": "4px",
    "_autocomplete": [], "auto-upload": True, "target": "_self",
}  # fmt: skip
TURNS = 400  # of the event loop, after which what is not done waits for a worker
WORDS = ("label", "model-value", "value", "innerHTML", "text")
NAMED = ("id", "for", "url")  # otherwise each time


def in_words(value: Any) -> str:
    """A property of an element."""
    if isinstance(value, Mapping):
        if set(value) == {"value", "label"}:
            return str(value["label"])
        return "{" + ", ".join(f"{k} {in_words(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list | tuple | np.ndarray):
        if len(value) > 8 and all(isinstance(v, int | float) for v in value):
            return digest(value)
        return "[" + " | ".join(in_words(v) for v in value) + "]"
    return f"{value:.6g}" if isinstance(value, float) else str(value).replace("\n", "\\n")


def line_of(e: Element) -> str:
    """One element: tag and classes, its words, properties, style, and the events that it takes."""
    tag = e.tag.removeprefix("nicegui-").removeprefix("q-")
    props = {k: v for k, v in e._props.items() if not (k in USUAL and USUAL[k] == v)}
    said = [in_words(props.pop(k)) for k in WORDS if k in props and props[k] not in ("", None)]
    said += [e._text] if getattr(e, "_text", None) else []
    props = {k: v for k, v in props.items() if k not in (*WORDS, *NAMED)}
    figure = props.pop("options") if isinstance(e, Figure) else None
    parts = [".".join([tag, *e._classes]), *(f"“{s}”" for s in said)]
    parts += [k if v is True else f"{k}={in_words(v)}" for k, v in props.items()]
    parts += [f"{k}:{v}" for k, v in e._style.items()]
    parts += [f"<{x.type}{f' {x.throttle:g}' if x.throttle else ''}>" for x in e._event_listeners.values()]
    if isinstance(e, ui.timer):
        parts.append(f"every {e.interval:g} s")
    if isinstance(e, ui.upload):
        parts += [slot.template for slot in e.slots.values() if slot.template]
    if figure is not None:
        parts += [in_words(figure["config"]), f"height {figure['layout'].get('height')}: "]
        parts += [" / ".join(figure_lines(figure))]
    return " ".join(re.sub(r"\s+", " ", p) for p in parts if p)


def tree(e: Element, depth: int = 0) -> Iterator[str]:
    """An element and what is in it, a line each."""
    yield "  " * depth + html.unescape(line_of(e))
    for slot in e.slots.values():
        for child in slot.children:
            yield from tree(child, depth + 1)


def inside(e: Element) -> Iterator[Element]:
    """Every element of a tree."""
    yield e
    for slot in e.slots.values():
        for child in slot.children:
            yield from inside(child)


def curves_in_words(curves: Curves) -> list[str]:
    """What a chart is given."""
    out = [f"curves {curves.key!r}"]
    for p in curves.panels:
        band = f", band {p.band:.4g}" if p.band is not None else ""
        out.append(f"  {p.title}: t {digest(p.t)}; height {p.height}, least {p.least:g}, group {p.group!r}{band}")
        out += [f"    {t.name} {t.role} {t.width:g} {t.dash}: {digest(t.y)}" for t in p.traces]
    out += [f"  mark {m.t:g}: {m.text}" for m in curves.marks]
    return out + [f"  band {b.start:g} to {b.end:g}: {b.text} {b.role}" for b in curves.bands]


def answering(monkeypatch: pytest.MonkeyPatch, answers: dict[str, Any]) -> list[str]:
    """Workers answer with these from now on, in this process: a value, an exception, `HELD`, or a function of what is
    asked. Return the list into which each question is written.
    """
    asked: list[str] = []

    async def call(worker: Worker, name: str, text: str, **arguments: Any) -> Any:
        module = "" if worker.module == "vaneloop.web.worker" else f" of {worker.module}"
        asked.append(f"{name}{module} “{text}” " + ", ".join(f"{k}={short(v)}" for k, v in arguments.items()))
        answer = answers[name]
        answer = answer(**arguments) if callable(answer) and not isinstance(answer, type) else answer
        if answer is HELD:
            future = asyncio.get_running_loop().create_future()
            worker.held = [*getattr(worker, "held", []), future]  # type: ignore[attr-defined]
            return await future
        await asyncio.sleep(0)
        if isinstance(answer, BaseException):
            raise answer
        return answer

    def stop(worker: Worker) -> None:
        asked.append(f"stop {worker.module}")
        worker.jobs.clear()
        for future in getattr(worker, "held", ()):
            if not future.done():
                future.set_exception(Cancelled("stopped"))

    monkeypatch.setattr(Worker, "call", call)
    monkeypatch.setattr(Worker, "stop", stop)
    monkeypatch.setattr(Worker, "start", lambda worker: asked.append("start"))
    monkeypatch.setattr(Worker, "tell", lambda worker, **content: asked.append(f"tell {content}"))
    _noting(monkeypatch, asked)
    return asked


def _noting(monkeypatch: pytest.MonkeyPatch, asked: list[str]) -> None:
    """Write down as well what a page would have the browser do, and what failed in it."""
    update = Element.update

    async def never(timer: Any) -> None:
        await asyncio.Event().wait()

    def updated(e: Element) -> None:
        if str(sys._getframe(1).f_globals["__name__"]).startswith("vaneloop."):
            asked.append(f"update {e.tag}")
        update(e)

    monkeypatch.setattr(Element, "update", updated)
    monkeypatch.setattr(ui.timer, "_can_start", never)  # `Opened.tick` calls them
    monkeypatch.setattr(Element, "run_method", lambda e, name, *given, **_: asked.append(f"{e.tag}.{name}{given}"))
    monkeypatch.setattr(ui, "notify", lambda text, **_: asked.append(f"notify {text}"))
    monkeypatch.setattr(ui.clipboard, "write", lambda text: asked.append(f"clipboard {text}"))
    monkeypatch.setattr(ui.navigate, "to", lambda to, **_: asked.append(f"navigate {to}"))
    monkeypatch.setattr(core.app, "handle_exception", lambda e: asked.append(f"FAILED {type(e).__name__}: {e}"))


def short(value: Any) -> str:
    """An argument of a question."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{k}: {short(v)}" for k, v in value.items()) + "}"
    if isinstance(value, np.ndarray):
        return digest(value)
    if isinstance(value, str | int | float | list | tuple) or value is None:
        return str(value)
    return type(value).__name__


async def settled(session: Session) -> None:
    """Wait for all that is done beside the page, but for what a worker is still at."""
    for _ in range(TURNS):
        await asyncio.sleep(0)
        if not session.tasks:
            break


def in_a_loop(work: Any) -> None:
    """Run a test's coroutine in an event loop that NiceGUI takes for its own. What would go to a thread is done at
    once, so that all happens in one order.
    """

    async def run() -> None:
        loop: Any = asyncio.get_running_loop()

        def at_once(_: Any, function: Callable[..., Any], *given: Any) -> asyncio.Future[Any]:
            done = loop.create_future()
            try:
                done.set_result(function(*given))
            except Exception as e:
                done.set_exception(e)
            return done

        core.loop, loop.run_in_executor = loop, at_once
        try:
            await work
        finally:
            core.loop = None

    asyncio.run(run())


class Clock:
    """In place of the module ``time``: it stands still until it is set."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *modules: str):
        self.now = 100.0
        for m in modules:
            monkeypatch.setattr(f"vaneloop.web.{m}.time", self)

    def monotonic(self) -> float:
        """Seconds."""
        return self.now

    perf_counter = time = monotonic

    def sleep(self, seconds: float) -> None:
        """Let time pass."""
        self.now += seconds

    def time_ns(self) -> int:
        """Nanoseconds."""
        return round(self.now * 1e9)


class Opened:
    """A page that is open in no browser."""

    def __init__(self, session: Session, build: Callable[[Session, int], None], most: int = 3 << 20):
        self.session = session
        self.client = Client(page("/of-a-test"))
        with self.client:
            build(session, most)
        self.live: Live = session.lookers[-1].__self__  # type: ignore[attr-defined]

    def lines(self) -> list[str]:
        """What stands on the page."""
        return list(tree(self.client.content))

    def look(self) -> None:
        """Redraw what has changed, as the page does by itself."""
        with self.client:
            self.live.look()

    def all(self, what: str | type) -> list[Element]:
        """Elements by kind, class (after a point), or their words."""
        every = list(inside(self.client.content))
        if isinstance(what, type):
            return [e for e in every if isinstance(e, what)]
        if what.startswith("."):
            return [e for e in every if what[1:] in e._classes]
        said = [[str(e._props.get(k)) for k in ("label", "aria-label", "placeholder", "icon", "title")] for e in every]
        return [e for e, words in zip(every, said, strict=True) if what in words or getattr(e, "_text", None) == what]

    def find(self, what: str | type, n: int = 0) -> Any:
        """One of them."""
        found = self.all(what)
        assert found, what
        return found[n]

    async def fire(self, what: Any, event: str = "click", args: Any = None, n: int = 0) -> None:
        """Let an element have an event."""
        e = what if isinstance(what, Element) else self.find(what, n)
        listeners = [x for x in e._event_listeners.values() if x.type in (event, event_type_to_camel_case(event))]
        assert listeners, (what, event)
        for x in listeners:
            given = events.GenericEventArguments(sender=e, client=self.client, args=args)
            with e.parent_slot or self.client.layout.default_slot:
                assert x.handler is not None
                waits = x.handler(given) if expects_arguments(x.handler) else x.handler()
                if asyncio.iscoroutine(waits):
                    await waits

    def put(self, what: Any, value: Any, n: int = 0) -> None:
        """Give a field, a switch or a choice a value."""
        with self.client:
            (what if isinstance(what, Element) else self.find(what, n)).set_value(value)

    def tick(self) -> None:
        """Let what comes round by itself come round."""
        for e in self.all(ui.timer):
            call = e.callback  # type: ignore[attr-defined]
            if call is not None and not asyncio.iscoroutinefunction(call):
                with self.client:
                    call()

    async def settle(self) -> None:
        """Let everything happen, and be drawn."""
        await settled(self.session)
        self.look()


class Transcript:
    """What a user did on a page, and what came of it, as text. ``names``: what stands for folders of this machine;
    ``whole``: begins with all that stands on the page.
    """

    def __init__(self, opened: Opened, asked: list[str], names: Mapping[Path, str], whole: bool = True):
        self.page, self.asked, self.names = opened, asked, names
        self.before = opened.lines()
        self.out = ["# the page", *(self.before if whole else ())]
        self.curves: dict[str, int] = {}
        self.kept: dict[str, str] = {}
        self.versions = dict(opened.session.versions)
        self.errors: dict[str, str] = {}
        self._questions()

    def _questions(self) -> None:
        self.out += [f"? {line}" for line in self.asked]
        self.asked.clear()

    async def note(self, act: str) -> None:
        """Write down what has changed since the last note."""
        await self.page.settle()
        session = self.page.session
        self.out += ["", f"# {act}"]
        self._questions()
        versions = dict(session.versions)
        touched = [
            f"{k} {n - self.versions.get(k, 0)}" for k, n in sorted(versions.items()) if n != self.versions.get(k)
        ]
        self.versions = versions
        self.out += [f"touched {', '.join(touched)}"] if touched else []
        for key, text in session.errors.items():
            if self.errors.get(key) != text:
                self.out.append(f"! {key}: {text}")
        self.errors = dict(session.errors)
        for name, curves in session.curves.items():
            if self.curves.get(name) != id(curves):
                self.out += [f"{name}: {line}" for line in curves_in_words(curves)]
        self.curves = {name: id(c) for name, c in session.curves.items()}
        kept = {k: p.name for k, p in session.saved.items()}
        if kept != self.kept:
            self.out.append(f"saved {kept}")
        self.kept = kept
        now = self.page.lines()
        diff = difflib.unified_diff(self.before, now, n=0, lineterm="")
        self.out += [line for line in diff if not line.startswith(("---", "+++", "@@"))]
        self.before = now

    async def tick(self, act: str = "a while") -> None:
        """Let a while pass."""
        self.page.tick()
        await self.note(act)

    async def click(self, what: Any, n: int = 0) -> None:
        """Press something."""
        await self.page.fire(what, n=n)
        await self.note(f"press {what if isinstance(what, str) else type(what).__name__}")

    async def fire(self, what: Any, event: str, args: Any = None, n: int = 0) -> None:
        """Let something have an event."""
        await self.page.fire(what, event, args, n)
        await self.note(f"{event} {args!r} at {what if isinstance(what, str) else type(what).__name__}")

    async def put(self, what: Any, value: Any, n: int = 0) -> None:
        """Give something a value."""
        self.page.put(what, value, n)
        await self.note(f"{value!r} for {what if isinstance(what, str) else type(what).__name__}")

    def text(self) -> str:
        """All of it."""
        text = "\n".join(line.rstrip() for line in self.out) + "\n"
        for place, name in self.names.items():
            text = text.replace(str(place), name)
        return text
