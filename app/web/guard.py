"""What stands before the pages: who may ask, from where, and how much they may send.

- On loopback only requests to a loopback name are answered, so that no page of another site can reach the server by a name of its own
  (DNS rebinding); elsewhere only requests with the token, which a cookie then remembers.
- A request whose Origin is another site is refused: websockets are not bound by the browser's same-origin rule.
- A body larger than the limit is cut off while it arrives, whatever its header says.
"""

from __future__ import annotations

import hmac
import ipaddress
from collections.abc import Awaitable, Callable, MutableMapping
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

__all__ = ["COOKIE", "Guard", "is_loopback"]

COOKIE = "vaneloop_token"
HEADERS = (
    (b"x-content-type-options", b"nosniff"),
    (b"x-frame-options", b"DENY"),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-opener-policy", b"same-origin"),
    (
        b"content-security-policy",  # nothing from another host; NiceGUI needs inline scripts and Vue's compiler
        b"default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval'; style-src 'self' 'unsafe-inline'; "
        b"img-src 'self' data: blob:; font-src 'self' data:; connect-src 'self'; "
        b"frame-ancestors 'none'; base-uri 'self'; form-action 'self'",
    ),
)

Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[Message, Receive, Send], Awaitable[None]]


def is_loopback(host: str) -> bool:
    """Whether ``host`` is this machine only."""
    host = host.strip("[]").rstrip(".").lower()
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:  # a name, and be it 127.0.0.1.example.com
        return False


class _TooLarge(Exception):
    pass


class Guard:
    """ASGI application around another. ``token`` None: loopback, no token. ``most``: bytes of a body."""

    def __init__(self, app: App, token: str | None, most: int):
        self.app, self.token, self.most = app, token, most

    async def __call__(self, scope: Message, receive: Receive, send: Send) -> None:
        """Let the request pass, or answer it with one line."""
        if scope["type"] not in ("http", "websocket"):
            await self.app(scope, receive, send)
            return
        headers = {k.decode("latin-1").lower(): v.decode("latin-1") for k, v in scope["headers"]}
        host = headers.get("host", "")
        given = parse_qs(scope.get("query_string", b"").decode("latin-1")).get("token", [""])[0]
        if self.token is None and not is_loopback(urlsplit("//" + host).hostname or ""):
            await _refuse(scope, receive, send, 421, f"this server answers on loopback names only, not as {host[:80]!r}")
            return
        origin = headers.get("origin")
        if origin is not None and urlsplit(origin).netloc != host:
            await _refuse(scope, receive, send, 403, f"a page of {origin[:80]!r} may not use this server")
            return
        if self.token is not None and not (self._knows(headers.get("cookie", "")) or _same(given, self.token)):
            await _refuse(scope, receive, send, 401, "this server needs its token: open the address that `vaneloop web` printed")
            return
        length = headers.get("content-length", "0")
        if not length.isdigit() or int(length) > self.most:
            await _refuse(scope, receive, send, 413, f"the file is larger than the limit of {self.most / 2**20:.0f} MB")
            return
        seen = 0
        started = False

        async def limited() -> Message:
            nonlocal seen
            message = await receive()
            seen += len(message.get("body", b"")) if message["type"] == "http.request" else 0
            if seen > self.most:
                raise _TooLarge
            return message

        async def dressed(message: Message) -> None:
            nonlocal started
            if message["type"] == "http.response.start":
                started = True
                extra = list(HEADERS)
                if self.token is not None and _same(given, self.token):
                    extra.append((b"set-cookie", f"{COOKIE}={self.token}; HttpOnly; SameSite=Strict; Path=/".encode()))
                message["headers"] = [*message.get("headers", []), *extra]
            await send(message)

        try:
            await self.app(scope, limited, dressed)
        except _TooLarge:
            if not started:
                await _refuse(scope, receive, send, 413, f"the file is larger than the limit of {self.most / 2**20:.0f} MB")

    def _knows(self, cookies: str) -> bool:
        try:
            found = SimpleCookie(cookies).get(COOKIE)
        except CookieError:
            return False
        return found is not None and self.token is not None and _same(found.value, self.token)


def _same(a: str, b: str) -> bool:
    return hmac.compare_digest(a.encode(), b.encode())


async def _refuse(scope: Message, receive: Receive, send: Send, status: int, line: str) -> None:
    if scope["type"] == "websocket":
        await receive()
        await send({"type": "websocket.close", "code": 1008})
        return
    body = (line + "\n").encode()
    headers = [(b"content-type", b"text/plain; charset=utf-8"), (b"content-length", str(len(body)).encode()), *HEADERS]
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": body})
