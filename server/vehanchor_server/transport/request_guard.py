"""Middleware: limits on bodies, and no streams without an end.

The SDK reads the whole body and parses it on the event loop; pydantic then records each fault. The
caller determines both costs. This middleware limits them by the number of large bodies in memory,
and by the number of JSON separators and brackets, which it counts as they arrive. A base64 image
has none of these, whatever its size.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING

from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.responses import Response

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

# Commas and colons: a path has up to 4,096, 16 polygons 6,400, a call with 32 points about 250.
MAX_SEPARATORS = 10_000
# Opening braces and brackets: a call with 32 points has about 40, and pydantic's limit is 200.
MAX_NESTED = 150
_SMALL_BYTES = 64 << 10  # a body that needs no slot; uvicorn buffers as much in any case
# Error codes of JSON-RPC.
_INVALID_REQUEST = -32600
_BUSY = -32000


@dataclass
class _Body:
    """Running counts of a body.

    Attributes:
        n_declared: size in the Content-Length header; 0 without one.
        n_bytes: bytes that have arrived.
        n_separators: commas and colons among them.
        n_nested: opening braces and brackets among them.
        has_slot: whether a slot for large bodies is reserved.
        complete: whether all of the body has arrived.
    """

    n_declared: int
    n_bytes: int = 0
    n_separators: int = 0
    n_nested: int = 0
    has_slot: bool = False
    complete: bool = False

    @property
    def is_large(self) -> bool:
        """Whether the body needs a slot, by its declared size or by the bytes that arrived."""
        return max(self.n_declared, self.n_bytes) > _SMALL_BYTES

    def add(self, chunk: bytes) -> None:
        """Count a chunk; refuse a body that is too complex."""
        self.n_bytes += len(chunk)
        self.n_separators += chunk.count(b",") + chunk.count(b":")
        self.n_nested += chunk.count(b"{") + chunk.count(b"[")
        if self.n_separators > MAX_SEPARATORS or self.n_nested > MAX_NESTED:
            raise _refusal(
                400,
                _INVALID_REQUEST,
                f"invalid_arguments: the request has more than {MAX_SEPARATORS} commas and "
                f"colons, or more than {MAX_NESTED} braces and brackets. Send one call with "
                "arguments of the tool's input schema.",
            )


class RequestGuard:
    """ASGI middleware of the MCP endpoint. Other paths pass.

    Args:
        app: the application, which answers an ``HTTPException`` of its ``receive``, as Starlette's
            do.
        path: path of the endpoint.
        max_large_bodies: maximum number of bodies above 64 KiB in memory.
    """

    def __init__(self, app: ASGIApp, *, path: str, max_large_bodies: int) -> None:
        self._app = app
        self._path = path
        self._max_large_bodies = max_large_bodies
        self._n_large_bodies = 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or refuse it.

        The application reads the body through this guard, after it has checked the token.
        """
        if scope["type"] != "http" or scope["path"].rstrip("/") != self._path:
            await self._app(scope, receive, send)
            return
        # GET asks for a stream without an end, on which a stateless server has nothing to send.
        if scope.get("method") == "GET":
            refusal = Response("POST only", status_code=405, headers={"Allow": "POST"})
            await refusal(scope, receive, send)
            return
        declared = Headers(scope=scope).get("content-length", "0")
        body = _Body(int(declared) if declared.isdigit() else 0)

        async def counted() -> Message:
            if body.complete:
                return await receive()
            self._reserve_slot(body)  # by the declared size, before anything is read
            message = await receive()
            if message["type"] == "http.disconnect":
                raise HTTPException(400)  # without a traceback in the log; nobody reads the answer
            body.add(message.get("body", b""))
            self._reserve_slot(body)
            body.complete = not message.get("more_body", False)
            return message

        try:
            await self._app(scope, counted, send)
        finally:
            if body.has_slot:
                self._n_large_bodies -= 1

    def _reserve_slot(self, body: _Body) -> None:
        """Reserve a slot for a large body; refuse the body if none is free."""
        if body.has_slot or not body.is_large:
            return
        if self._n_large_bodies >= self._max_large_bodies:
            raise _refusal(503, _BUSY, "busy: too many large requests. Try again in a few seconds.")
        self._n_large_bodies += 1
        body.has_slot = True


def _refusal(status: int, code: int, message: str) -> HTTPException:
    """Build the answer to a refused request, whose id is unknown."""
    error = {"jsonrpc": "2.0", "id": None, "error": {"code": code, "message": message}}
    headers = {"Content-Type": "application/json"}
    if status == 503:
        headers["Retry-After"] = "2"
    return HTTPException(status, json.dumps(error), headers)
