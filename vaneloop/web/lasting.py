"""Files of the pages that never change under their address, kept in memory from their first answer on.

Each of the two dozen files of a first page is otherwise found, opened and read by threads, piece by piece, behind all
layers of the framework. The guard stands before this: who may not ask gets nothing from here either.
"""

from __future__ import annotations

from vaneloop.web.guard import App, Message, Receive, Send

__all__ = ["Lasting"]

MOST = 32 << 20  # bytes that are kept
ASKS_MORE = {b"range", b"if-none-match", b"if-modified-since", b"if-range"}  # the framework answers these


class Lasting:
    """ASGI application around another, whose answers must not depend on what a browser accepts (no compression)."""

    def __init__(self, app: App):
        self.app = app
        self.held: dict[str, tuple[Message, bytes]] = {}
        self.size = 0

    async def __call__(self, scope: Message, receive: Receive, send: Send) -> None:
        """Answer from memory, or pass the request on and keep the answer where it may be."""
        plain = scope["type"] == "http" and scope["method"] == "GET" and not scope.get("query_string")
        if not plain or any(name.lower() in ASKS_MORE for name, _ in scope["headers"]):
            await self.app(scope, receive, send)
            return
        path = scope["path"]
        if path in self.held:
            start, body = self.held[path]
            await send({**start, "headers": list(start["headers"])})
            await send({"type": "http.response.body", "body": body})
            return
        begun: Message = {}
        pieces: list[bytes] = []

        async def listening(message: Message) -> None:
            if message["type"] == "http.response.start" and _lasting(message):
                begun.update(message, headers=list(message["headers"]))
            elif message["type"] == "http.response.body" and begun:
                pieces.append(bytes(message.get("body", b"")))
                if not message.get("more_body"):
                    self._keep(path, begun, b"".join(pieces))
            await send(message)

        await self.app(scope, receive, listening)

    def _keep(self, path: str, start: Message, body: bytes) -> None:
        if path not in self.held and self.size + len(body) <= MOST:
            self.held[path] = dict(start), body
            self.size += len(body)


def _lasting(start: Message) -> bool:
    """Whether an answer is a whole file for ever, and nobody's own: it sets no cookie."""
    headers = {name.lower(): value for name, value in start.get("headers", ())}
    return (
        start["status"] == 200 and b"immutable" in headers.get(b"cache-control", b"") and b"set-cookie" not in headers
    )
