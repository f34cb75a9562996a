"""The server: one session a browser, the three pages, curves, saved files, behind the guard."""

from __future__ import annotations

import asyncio
import os
import secrets
import shutil
import signal
import socket
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import uvicorn
from fastapi import FastAPI, Request, Response
from fastapi.responses import FileResponse, PlainTextResponse
from nicegui import app as pages
from nicegui import ui

from app.web import missing, run, schedule
from app.web.charts import Curves, view
from app.web.guard import Guard
from app.web.session import LOG_SUFFIXES, LogFile, Session

__all__ = ["serve"]

MOST_SESSIONS = 6  # the one that rested longest gives way
HERE = Path(__file__).resolve().parent


class Sessions:
    """Sessions by the browser's cookie; their files live in one private folder."""

    def __init__(self, folder: Path, files: list[LogFile]):
        self.folder, self.files = folder, files
        self.of: dict[str, Session] = {}
        self.used: dict[str, float] = {}

    def get(self, key: str) -> Session:
        """Return the browser's session; make it where there is none."""
        if key not in self.of:
            while len(self.of) >= MOST_SESSIONS:
                old = min(self.of, key=lambda k: self.used[k])
                self.of.pop(old).close()
            self.of[key] = Session(key, self.folder / secrets.token_hex(8), list(self.files))
            self.of[key].search.start()  # ready by the time that a log is chosen
            self.of[key].bench.start()
        self.used[key] = time.monotonic()
        return self.of[key]

    def close(self) -> None:
        """End everything."""
        for s in self.of.values():
            s.close()
        self.of.clear()


def logs_in(folder: Path) -> list[LogFile]:
    """Logs of the examples and of ``folder``, as the user would name them there."""
    examples = HERE.parent.parent / "examples"
    out = []
    for place in dict.fromkeys([folder.resolve(), examples]):
        if place.is_dir():
            for f in sorted(place.iterdir())[:500]:
                if f.suffix.lower() in LOG_SUFFIXES and f.is_file():
                    out.append(LogFile(f, f.name if place != examples else f"example: {f.name}", os.path.relpath(f, folder)))
    return out


def serve(sock: socket.socket, folder: Path, token: str | None, most: int, ready: Callable[[], None]) -> None:
    """Serve until Ctrl-C. ``sock`` listens already; ``most``: bytes of an upload."""
    private = Path(tempfile.mkdtemp(prefix="vaneloop-web-"))  # 0700
    tempfile.tempdir = str(private)  # uploads on their way are private too
    try:
        _serve(sock, folder, token, most, ready, private)
    finally:
        shutil.rmtree(private, ignore_errors=True)


def _serve(sock: socket.socket, folder: Path, token: str | None, most: int, ready: Callable[[], None], private: Path) -> None:
    sessions = Sessions(private, logs_in(folder))
    api = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)

    def mine(request: Request) -> Session | None:
        return sessions.of.get(str(request.session.get("id", "")))

    @ui.page("/", title="VaneLoop: missing physics")
    def _missing() -> None:
        missing.build(sessions.get(pages.storage.browser["id"]), most)

    @ui.page("/schedule", title="VaneLoop: schedule")
    def _schedule() -> None:
        schedule.build(sessions.get(pages.storage.browser["id"]), most)

    @ui.page("/run", title="VaneLoop: run")
    def _run() -> None:
        run.build(sessions.get(pages.storage.browser["id"]), most)

    @pages.get("/curves/{name}")
    async def _curves(name: str, request: Request, n: int = 1000) -> Response:
        session = mine(request)
        if session is None:
            return PlainTextResponse("no session", 404)

        def number(key: str) -> float | None:
            text = request.query_params.get(key)
            return None if text is None else float(text)

        try:
            start, end = number("from"), number("to")
        except ValueError:
            return PlainTextResponse("from and to must be numbers", 422)
        curves = session.curves.get(name, Curves())
        body = await asyncio.get_running_loop().run_in_executor(None, view, curves, start, end, n)
        return Response(body, media_type="application/octet-stream", headers={"Cache-Control": "no-store"})

    @pages.get("/saved/{key}")
    async def _saved(key: str, request: Request) -> Response:
        session = mine(request)
        path = session.saved.get(key) if session is not None else None
        if path is None or not path.is_file():
            return PlainTextResponse("nothing saved", 404)
        return FileResponse(path, filename=path.name, media_type="application/octet-stream")

    pages.add_static_file(local_file=HERE / "uplot" / "uPlot.css", url_path="/assets/uPlot.css")
    pages.on_shutdown(sessions.close)
    ui.run_with(
        api, title="VaneLoop", dark=None, tailwind=False, storage_secret=secrets.token_hex(32), show_welcome_message=False,
        reconnect_timeout=20.0, session_middleware_kwargs={"same_site": "strict"},
    )  # fmt: skip
    config = uvicorn.Config(Guard(api, token, most), log_level="warning", ws_max_size=4 << 20, timeout_graceful_shutdown=2, lifespan="on")

    class Told(uvicorn.Server):
        async def startup(self, sockets: list[socket.socket] | None = None) -> None:
            await super().startup(sockets)
            ready()

    server = Told(config)
    previous = signal.getsignal(signal.SIGTERM)
    try:
        server.run(sockets=[sock])
    except KeyboardInterrupt:
        pass
    finally:
        signal.signal(signal.SIGTERM, previous)
        sessions.close()
    sys.stderr.flush()
