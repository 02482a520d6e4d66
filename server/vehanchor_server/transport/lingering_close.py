"""Lingering close: read what is left of a request's body after an early answer.

A server that closes a connection with unread bytes resets it, and the reset can overtake the answer (RFC 9112, section
9.6). The answer goes out at once; its end waits until the body has arrived or a limit is reached.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import anyio
from starlette.datastructures import Headers, MutableHeaders

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

__all__ = ["LINGER_S", "LingeringClose"]

LINGER_S = 30.0  # nginx: lingering_time
_KEEP_ALIVE_BYTES = 64 << 10  # a longer rest ends its connection: reading it costs more than a new connection


class LingeringClose:
    """ASGI middleware that discards the rest of a body before the connection can close.

    Args:
        app: the application.
        max_bytes: discarded for one request.
        max_s: seconds for which bytes are awaited.
    """

    def __init__(self, app: ASGIApp, *, max_bytes: int, max_s: float = LINGER_S) -> None:
        self._app = app
        self._max_bytes = max_bytes
        self._max_s = max_s

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Run the application; hold the end of an early answer back until the body has arrived."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        body = _Body(Headers(scope=scope), receive)

        async def send_and_linger(message: Message) -> None:
            if message["type"] == "http.response.start" and body.n_left > _KEEP_ALIVE_BYTES:
                message = {**message, "headers": list(message.get("headers", []))}
                MutableHeaders(raw=message["headers"])["Connection"] = "close"
            ends = message["type"] == "http.response.body" and not message.get("more_body", False)
            if not ends or body.complete:
                await send(message)
                return
            await send({**message, "more_body": True})
            with anyio.move_on_after(self._max_s):
                await body.discard(self._max_bytes)
            await send({"type": "http.response.body", "body": b"", "more_body": False})

        await self._app(scope, body.receive, send_and_linger)


class _Body:
    """How much of one request's body has arrived."""

    def __init__(self, headers: Headers, receive: Receive) -> None:
        self._receive = receive
        self._n_read = 0
        self._n_declared = _declared_bytes(headers)
        self.complete = self._n_declared == 0

    @property
    def n_left(self) -> float:
        """Bytes that are still to be read; infinite if the length is unknown."""
        return 0 if self.complete else self._n_declared - self._n_read

    async def receive(self) -> Message:
        """Receive the next message and count its bytes."""
        message = await self._receive()
        if message["type"] == "http.disconnect":
            self.complete = True
        elif message["type"] == "http.request":
            self._n_read += len(message.get("body", b""))
            self.complete = not message.get("more_body", False)
        return message

    async def discard(self, max_bytes: int) -> None:
        """Read until the body ends, the client leaves or a number of bytes has been read."""
        until = self._n_read + max_bytes
        while not self.complete and self._n_read < until:
            await self.receive()


def _declared_bytes(headers: Headers) -> float:
    """Return the length of a body as its head declares it; infinite if it is sent in chunks."""
    if "transfer-encoding" in headers:
        return float("inf")
    declared = headers.get("content-length", "0")
    return int(declared) if declared.isdigit() else 0
