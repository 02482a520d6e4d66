"""Replies as JSON to clients that do not ask for event streams.

The SDK answers by a stream of events, and refuses a client that does not name both JSON and event
streams. This middleware asks for both in the client's place. If the client does not name event
streams, it sends the last event, which is the reply, as JSON. RFC 9110, 12.5.1: without the header,
a client accepts everything, and a weight of 0 excludes a type.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

_ACCEPT = b"accept"
_JSON = b"application/json"
_EVENTS = b"text/event-stream"
_DATA = b"data:"
_ALSO_JSON = (_JSON, b"application/*", b"*/*")
_ALSO_EVENTS = (_EVENTS, b"text/*")


class JsonReply:
    """Middleware: replies in JSON for clients that do not name event streams.

    Args:
        app: the application.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, and convert the reply if it is needed."""
        if scope["type"] != "http" or scope["method"] != "POST":
            await self._app(scope, receive, send)
            return
        accepted = _accepted(scope)
        takes_json = not accepted.isdisjoint(_ALSO_JSON)
        takes_events = not accepted.isdisjoint(_ALSO_EVENTS)
        if not takes_json and not takes_events:
            await self._app(scope, receive, send)
            return
        others = [(name, value) for name, value in scope["headers"] if name.lower() != _ACCEPT]
        accept = (_ACCEPT, _JSON + b", " + _EVENTS)
        asked = {**scope, "headers": [*others, accept]}
        if takes_events:
            await self._app(asked, receive, send)
            return
        reply = _Reply(send)
        await self._app(asked, receive, reply.send)


class _Reply:
    """Reply that becomes JSON if it is a stream of events.

    Args:
        send: sends to the client.
    """

    def __init__(self, send: Send) -> None:
        self._send = send
        self._start: Message | None = None
        self._events = b""

    async def send(self, message: Message) -> None:
        """Send a message, or keep it until the stream ends."""
        if message["type"] == "http.response.start" and _is_stream(message):
            self._start = message
            return
        if self._start is None or message["type"] != "http.response.body":
            await self._send(message)
            return
        self._events += message.get("body", b"")
        if message.get("more_body", False):
            return
        body = _last_event(self._events)
        headers = [
            (name, value)
            for name, value in self._start["headers"]
            if name.lower() not in (b"content-type", b"content-length")
        ]
        headers += [(b"content-type", _JSON), (b"content-length", str(len(body)).encode())]
        await self._send({**self._start, "headers": headers})
        await self._send({"type": "http.response.body", "body": body})


def _accepted(scope: Scope) -> set[bytes]:
    """List the types that a client accepts, in small letters; everything without the header."""
    values = [value for name, value in scope["headers"] if name.lower() == _ACCEPT]
    header = b",".join(values).lower()
    if not header.strip():
        return {b"*/*"}
    accepted = set()
    for part in header.split(b","):
        media_type, *parameters = [piece.strip() for piece in part.split(b";")]
        weights = [piece[2:].strip(b" 0.") for piece in parameters if piece.startswith(b"q=")]
        # Of a weight of zero, nothing is left.
        if b"" not in weights:
            accepted.add(media_type)
    return accepted


def _is_stream(start: Message) -> bool:
    """Test whether a reply is a stream of events."""
    headers = {name.lower(): value for name, value in start["headers"]}
    return bool(headers.get(b"content-type", b"").startswith(_EVENTS))


def _last_event(events: bytes) -> bytes:
    """Return the data of the last event; empty without one."""
    lines = [line for line in events.splitlines() if line.startswith(_DATA)]
    return lines[-1].removeprefix(_DATA).strip() if lines else b""
