"""What stands before the pages: who may ask, from where, and how much they may send.

Every browser must know the token. The link that is printed carries it; a cookie remembers it, and a redirect takes it
out of the address.

- On loopback only requests that name a loopback address or ``localhost`` are answered. This prevents DNS rebinding.
- A request that a page of another site or of another port has caused is refused (Sec-Fetch-Site, Origin), websockets
  too. The cookie alone cannot tell: to a browser all ports of a host are one site.
- A page is given only to a browser that goes there: nothing else can begin a session.
- A body larger than the limit is cut off while it arrives, whatever its header says.
"""

from __future__ import annotations

import hmac
import ipaddress
import re
import secrets
from collections.abc import Awaitable, Callable, Collection, MutableMapping
from typing import Any
from urllib.parse import parse_qs

__all__ = ["Guard", "is_loopback"]

HEADERS = (
    (b"x-content-type-options", b"nosniff"),
    (b"x-frame-options", b"DENY"),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-opener-policy", b"same-origin"),
    (b"cross-origin-resource-policy", b"same-origin"),
    (
        b"content-security-policy",  # nothing from another host; NiceGUI needs inline scripts and Vue's compiler
        b"default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval'; style-src 'self' 'unsafe-inline'; "
        b"img-src 'self' data: blob:; font-src 'self' data:; connect-src 'self'; "
        b"frame-ancestors 'none'; base-uri 'self'; form-action 'self'",
    ),
)
HOST = re.compile(r"(?P<name>[A-Za-z0-9._-]+|\[[0-9A-Fa-f:.]+\])(?::\d{1,5})?", re.ASCII)

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


class _Refused(Exception):
    def __init__(self, status: int, text: str):
        self.status, self.text = status, text


class Guard:
    """ASGI application around another.

    ``port`` names the cookie: cookies of a host are shared by all its ports. ``loopback``: only loopback names are
    answered. ``most``: bytes of a body. ``pages``: paths that only a browser's navigation gets.
    """

    def __init__(self, app: App, token: str, port: int, most: int, *, loopback: bool, pages: Collection[str] = ()):
        self.app, self.token, self.most, self.loopback, self.pages = app, token, most, loopback, frozenset(pages)
        self.cookie = f"vaneloop_token_{port}"
        self._tickets: set[str] = set()

    def ticket(self) -> str:
        """Return a word that does for the token once: the command line of a browser can be read by every user of the
        machine.
        """
        self._tickets.add(word := secrets.token_urlsafe(24))
        return word

    async def __call__(self, scope: Message, receive: Receive, send: Send) -> None:
        """Let the request pass, or answer it with a plain line."""
        if scope["type"] not in ("http", "websocket"):
            await self.app(scope, receive, send)
            return
        try:
            headers = _headers(scope)
            host = self._host(headers)
            if self._enters(scope):
                await self._entered(scope, headers, send)
                return
            _no_other_site(headers, host)
            if not self._knows(headers):
                raise _Refused(
                    403,
                    "This workbench needs its token.\n\nOpen the link that `vaneloop web` printed where it was "
                    f"started: http://{host}/?token=...\nCopy it into the address bar. If it is lost, end the program "
                    "(Ctrl-C) and start it again.",
                )
            if scope["type"] == "http" and scope["method"] == "GET" and scope["path"] in self.pages:
                _only_a_navigation(headers)
            length = headers.get("content-length", "0")
            if not re.fullmatch(r"[0-9]{1,18}", length):
                raise _Refused(400, f"Content-Length {length[:40]!r} is not a number of bytes")
            if int(length) > self.most:
                raise self._too_large()
            await self._pass(scope, receive, send)
        except _Refused as no:
            await _answer(scope, receive, send, no)

    def _host(self, headers: dict[str, str]) -> str:
        host = headers.get("host", "")
        parts = HOST.fullmatch(host)
        if parts is None:
            raise _Refused(400, f"Host {host[:80]!r} is not one name or address with a port")
        if self.loopback and not is_loopback(parts["name"]):
            raise _Refused(421, f"this server answers on loopback names only, not as {host[:80]!r}")
        return host

    def _enters(self, scope: Message) -> bool:
        """Whether the address carries the token (or an unused ticket): whoever has it may come from anywhere."""
        if scope["type"] != "http" or scope["method"] != "GET":
            return False
        given = parse_qs(scope.get("query_string", b"").decode("latin-1")).get("token", [""])[0]
        used = next((t for t in self._tickets if _same(given, t)), None)
        if used is not None:
            self._tickets.discard(used)
        return used is not None or _same(given, self.token)

    async def _entered(self, scope: Message, headers: dict[str, str], send: Send) -> None:
        """Put the token into the cookie and lead to the page without it in the address."""
        where = scope["path"] if scope["path"] in self.pages else "/"
        cookie = f"{self.cookie}={self.token}; HttpOnly; SameSite=Strict; Path=/"
        extra = [(b"set-cookie", cookie.encode()), (b"cache-control", b"no-store")]
        if headers.get("sec-fetch-site", "none") in ("none", "same-origin"):
            await _write(send, 303, b"", [*extra, (b"location", where.encode())])
        else:
            # a link on another site: a redirect would still count as that site's, and the browser would keep the
            # cookie back
            page = f'<!doctype html><meta http-equiv="refresh" content="0;url={where}"><a href="{where}">VaneLoop</a>\n'
            await _write(send, 200, page.encode(), [*extra, (b"content-type", b"text/html; charset=utf-8")])

    def _knows(self, headers: dict[str, str]) -> bool:
        pairs = (c.partition("=") for c in headers.get("cookie", "").split(";"))
        return any(_same(value.strip(), self.token) for name, _, value in pairs if name.strip() == self.cookie)

    def _too_large(self) -> _Refused:
        return _Refused(413, f"the file is larger than the limit of {self.most / 2**20:.0f} MB")

    async def _pass(self, scope: Message, receive: Receive, send: Send) -> None:
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
                message["headers"] = [*message.get("headers", []), *HEADERS]
            await send(message)

        try:
            await self.app(scope, limited, dressed)
        except _TooLarge:
            if not started:
                raise self._too_large() from None


def _headers(scope: Message) -> dict[str, str]:
    """Headers by name in small letters. One that came twice is joined, so that it is none of the values allowed;
    cookies may come so.
    """
    out: dict[str, str] = {}
    for k, v in scope["headers"]:
        name, value = k.decode("latin-1").lower(), v.decode("latin-1")
        out[name] = f"{out[name]}{'; ' if name == 'cookie' else ', '}{value}" if name in out else value
    if any(ord(c) < 32 or ord(c) == 127 for c in scope["path"]):
        raise _Refused(400, "the path contains control characters")
    return out


def _no_other_site(headers: dict[str, str], host: str) -> None:
    """Refuse what a page of another site, or of another port of this machine, has caused."""
    origin = headers.get("origin")
    if origin is not None and origin.lower() not in (f"http://{host}".lower(), f"https://{host}".lower()):
        raise _Refused(403, f"a page of {origin[:80]!r} may not use this server")
    site = headers.get("sec-fetch-site", "none")  # absent: an older browser, or none at all
    if site not in ("none", "same-origin"):
        raise _Refused(
            403,
            f"this request comes from another site's page ({site[:40]!r}): type or copy the address into the address "
            f"bar",
        )


def _only_a_navigation(headers: dict[str, str]) -> None:
    mode, target = headers.get("sec-fetch-mode", "navigate"), headers.get("sec-fetch-dest", "document")
    if "text/html" not in headers.get("accept", "").lower() or mode != "navigate" or target != "document":
        raise _Refused(406, "this is a page for a browser (Accept: text/html)")


def _same(a: str, b: str) -> bool:
    return hmac.compare_digest(a.encode(), b.encode())


async def _answer(scope: Message, receive: Receive, send: Send, no: _Refused) -> None:
    if scope["type"] == "websocket":
        await receive()
        await send({"type": "websocket.close", "code": 1008})  # before it was accepted: 403
        return
    body = (no.text + "\n").encode("utf-8", "replace")
    await _write(
        send, no.status, body, [(b"content-type", b"text/plain; charset=utf-8"), (b"cache-control", b"no-store")]
    )


async def _write(send: Send, status: int, body: bytes, headers: list[tuple[bytes, bytes]]) -> None:
    headers = [*headers, (b"content-length", str(len(body)).encode()), *HEADERS]
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": body})
