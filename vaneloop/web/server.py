"""The server: one session a browser, the four pages, curves, saved files, behind the guard."""

from __future__ import annotations

import asyncio
import logging
import math
import os
import secrets
import signal
import socket
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import uvicorn
from fastapi import FastAPI, Request, Response
from fastapi.middleware.gzip import GZipMiddleware
from fastapi.responses import FileResponse, HTMLResponse, PlainTextResponse
from nicegui import Client, ui
from nicegui import app as pages

from hil.logs.formats import suffixes
from vaneloop.base import terminal
from vaneloop.web import fleet, missing, run, schedule
from vaneloop.web.charts import Curves, view
from vaneloop.web.guard import Guard
from vaneloop.web.jobs import Cancelled, Spare
from vaneloop.web.lasting import Lasting
from vaneloop.web.private import private_folder
from vaneloop.web.session import CODE, LogFile, Session

__all__ = ["serve"]

MOST_SESSIONS = 6  # one without an open tab gives way
MOST_CODE = 1 << 20  # bytes of a Python file that are looked at
RECONNECT = 60.0  # s that a tab may be out of reach and still counts as open: a browser on a busy machine answers late
PAGES = ("/", "/schedule", "/run", "/fleet")
FULL = f"""{MOST_SESSIONS} browsers are at work here, each with an open tab, and that is the limit.

Close a tab of one of them; after {RECONNECT:.0f} s its place is free.
"""
NO_PAGE = """This page could not be made, which is a defect of VaneLoop.

Where the workbench was started a line says which, and where its traceback is. Reload the page; if it fails again, end
the program (Ctrl-C) and start it anew.
"""
LOG = logging.getLogger("nicegui")
HERE = Path(__file__).resolve().parent


class Plain(logging.Handler):
    """What libraries log, as lines for the terminal: the traceback of a defect goes into a file."""

    def emit(self, record: logging.LogRecord) -> None:
        """Print one line."""
        error = record.exc_info[1] if record.exc_info else None
        if isinstance(error, asyncio.CancelledError | Cancelled):
            return  # somebody wanted that
        text = terminal.defect(error) if error is not None else " ".join(record.getMessage().split())
        print(f"vaneloop: {text}", file=sys.stderr, flush=True)


class Sessions:
    """Sessions by the browser's cookie; their files live in one private folder."""

    def __init__(self, make: Callable[[str], Session]):
        self.make = make
        self.of: dict[str, Session] = {}
        self.tabs: dict[str, set[Client]] = {}  # pages that are open, being loaded or reconnecting
        self.used: dict[str, float] = {}

    def get(self, key: str, tab: Client) -> Session | None:
        """Return the browser's session for one more tab; make it where there is none. None where others with open tabs
        take all places.
        """
        if key not in self.of:
            if len(self.of) >= MOST_SESSIONS and not self._give_way():
                return None
            self.of[key], self.tabs[key] = self.make(key), set()
        self.tabs[key].add(tab)
        self.used[key] = time.monotonic()
        tab.on_delete(lambda: self._left(key, tab))
        return self.of[key]

    def _left(self, key: str, tab: Client) -> None:
        if key in self.of:
            self.tabs[key].discard(tab)
            self.used[key] = time.monotonic()

    def _give_way(self) -> bool:
        """End the session without a tab that rested longest, one at work only where no other is."""
        alone = [k for k, tabs in self.tabs.items() if not tabs]
        if not alone:
            return False
        old = min(alone, key=lambda k: (self.of[k].working.total() > 0, self.used[k]))
        del self.tabs[old]
        self.of.pop(old).close()
        return True

    def close(self) -> None:
        """End everything."""
        for s in self.of.values():
            s.close()
        self.of.clear()
        self.tabs.clear()


def logs_in(folder: Path) -> list[LogFile]:
    """Logs of the examples and of ``folder``, as the user would name them there."""
    examples = HERE.parent.parent / "examples"
    out = []
    ends = suffixes()
    for place in dict.fromkeys([folder.resolve(), examples]):
        if place.is_dir():
            for f in sorted(place.iterdir())[:500]:
                if f.suffix.lower() in ends and f.is_file():
                    out.append(
                        LogFile(f, f.name if place != examples else f"example: {f.name}", os.path.relpath(f, folder))
                    )
    return out


def models_in(folder: Path) -> list[LogFile]:
    """Models of one's own among the examples and in ``folder``. None is run to find that out."""
    examples, out = HERE.parent.parent / "examples", []
    for place in dict.fromkeys([examples, folder.resolve()]):
        for f in sorted(place.iterdir())[:500] if place.is_dir() else ():
            if f.suffix.lower() == CODE and f.is_file() and b"System(" in f.read_bytes()[:MOST_CODE]:
                ours = place == examples
                name = f"example: {f.name}" if ours else f.name
                out.append(LogFile(f, name, os.path.relpath(f, folder), shipped=ours))
    return out


def serve(
    sock: socket.socket,
    folder: Path,
    token: str,
    most: int,
    loopback: bool,
    ready: Callable[[str], None],
    tables: str | None = None,
    controller: str | None = None,
) -> None:
    """Serve until Ctrl-C. ``sock`` listens already; ``most``: bytes of an upload; ``ready`` takes a word that does for
    the token once; ``tables``: folder of the machine's tables, None: the shipped ones;
    ``controller``: shared library of the user's own, None: the firmware here.
    """
    with private_folder() as private:
        tempfile.tempdir = str(private)  # uploads on their way are private too
        _serve(sock, folder, token, most, loopback, ready, private, tables, controller)


def _serve(
    sock: socket.socket, folder: Path, token: str, most: int, loopback: bool, ready: Callable[[str], None],
    private: Path, tables: str | None, controller: str | None,
) -> None:  # fmt: skip
    files, models, spare = logs_in(folder), models_in(folder), Spare()
    spare.refill()  # ready by the time that a log is chosen

    def new(key: str) -> Session:
        session = Session(key, private / secrets.token_hex(8), list(files), tables, controller, spare, models)
        session.extra["served"] = folder
        session.takes_code = loopback
        return session

    sessions = Sessions(new)
    port = sock.getsockname()[1]
    api = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)

    def mine(request: Request) -> Session | None:
        return sessions.of.get(str(request.session.get("id", "")))

    def page(path: str, title: str, build: Callable[[Session, int], None]) -> None:
        @ui.page(path, title=f"VaneLoop: {title}")
        def _page() -> Response | None:
            session = sessions.get(pages.storage.browser["id"], ui.context.client)
            if session is None:
                return PlainTextResponse(FULL, 429)
            session.errors.pop("page", None)
            try:
                build(session, most)
            except Exception as e:
                LOG.error("the page", exc_info=e)
                return PlainTextResponse(NO_PAGE, 500)
            return None

    for path, title, module in zip(
        PAGES, ("missing physics", "schedule", "run", "fleet"), (missing, schedule, run, fleet), strict=True
    ):
        page(path, title, module.build)

    @pages.get("/curves/{name}")
    async def _curves(name: str, request: Request) -> Response:
        session = mine(request)
        if session is None:
            return PlainTextResponse("no session", 404)

        def number(key: str) -> float | None:
            text = request.query_params.get(key)
            value = None if text is None else float(text)
            if value is not None and not math.isfinite(value):
                raise ValueError
            return value

        try:
            start, end, n = number("from"), number("to"), number("n")
        except ValueError:
            return PlainTextResponse("from, to and n must be numbers", 422)
        curves = session.curves.get(name, Curves())
        pixels = 1000 if n is None else int(min(max(n, 0.0), 1e5))
        body = await asyncio.get_running_loop().run_in_executor(None, view, curves, start, end, pixels)
        return Response(body, media_type="application/octet-stream", headers={"Cache-Control": "no-store"})

    @pages.get("/saved/{key}")
    async def _saved(key: str, request: Request) -> Response:
        session = mine(request)
        path = session.saved.get(key) if session is not None else None
        if path is None or not path.is_file():
            return PlainTextResponse("nothing saved", 404)
        return FileResponse(path, filename=path.name, media_type="application/octet-stream")

    @pages.get(f"/{fleet.LOGS}/{{name}}")
    async def _fleet_log(name: str, request: Request) -> Response:
        session = mine(request)
        found = session.extra.get("fleet") if session is not None else None
        text = None if found is None else await found.log(name)
        if text is None:
            return PlainTextResponse("no such log in the run that is looked at", 404)
        return HTMLResponse(text, headers={"Cache-Control": "no-store"})

    pages.add_static_file(local_file=HERE / "uplot" / "uPlot.css", url_path="/assets/uPlot.css")
    pages.on_shutdown(sessions.close)
    FileResponse.chunk_size = 1 << 20  # bytes; at 64 KiB a page's files wait for a thread some fifty times
    # Quasar would show a bar without a name at every request of a chart; what takes long has a bar of its own.
    pages.config.quasar_config["loadingBar"]["skipHijack"] = True
    ui.run_with(
        api, title="VaneLoop", dark=None, language="en-US", tailwind=False, storage_secret=secrets.token_hex(32),
        show_welcome_message=False,
        reconnect_timeout=RECONNECT,
        # within one machine it gains nothing, and took half of the server's time for a first page
        gzip_middleware_factory=None if loopback else GZipMiddleware,
        session_middleware_kwargs={"same_site": "strict", "session_cookie": f"vaneloop_session_{port}"},
    )  # fmt: skip
    for name in ("nicegui", "asyncio", "uvicorn.error"):
        logger = logging.getLogger(name)
        logger.handlers, logger.propagate = [Plain(logging.WARNING)], False
    guard = Guard(Lasting(api) if loopback else api, token, port, most, loopback=loopback, pages=PAGES)
    config = uvicorn.Config(  # h11 bounds the headers of a request
        guard, http="h11", log_config=None, log_level="warning", ws_max_size=4 << 20, timeout_graceful_shutdown=2,
        lifespan="on", ws_per_message_deflate=not loopback,
    )  # fmt: skip

    class Told(uvicorn.Server):
        async def startup(self, sockets: list[socket.socket] | None = None) -> None:
            await super().startup(sockets)
            ready(guard.ticket())

    server = Told(config)
    previous = signal.getsignal(signal.SIGTERM)
    try:
        server.run(sockets=[sock])
    except KeyboardInterrupt:
        pass
    finally:
        signal.signal(signal.SIGTERM, previous)
        sessions.close()
        spare.close()
    sys.stderr.flush()
