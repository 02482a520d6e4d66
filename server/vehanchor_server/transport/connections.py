"""Connections that cost something and say nothing: how many there may be, and how long a request may take to arrive.

uvicorn counts requests, not connections, and gives a first request all the time in the world. With more sockets than
the process may open, asyncio then fails to accept, and says so two thousand times a second.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from typing import Any

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

BACKLOG = (
    128  # accepted at a stroke, before any can be refused: the process must be able to open as many beside its limit
)
MAX_HEAD_BYTES = 32 << 10
_CHANCE_S = 0.2
_TOO_SLOW = b"HTTP/1.1 408 Request Timeout\r\nConnection: close\r\nContent-Length: 0\r\n\r\n"


@dataclass(frozen=True)
class ConnectionLimits:
    """Limits on the connections of one process.

    Attributes:
        total: open at once.
        per_address: open at once from one address.
        head_s: seconds from the opening, or from the first byte of a later request, to the end of the request's head.
        body_s: seconds from the end of the head to the end of the body.
    """

    total: int = 512
    per_address: int = 256
    head_s: float = 20.0
    body_s: float = 60.0


class LimitedProtocol(H11Protocol):
    """uvicorn's HTTP/1.1, which closes at once what is one too many, and what does not arrive in time.

    Args:
        limits: on connections and times.
        given: what uvicorn gives.
    """

    def __init__(self, *, limits: ConnectionLimits | None = None, **given: Any) -> None:
        super().__init__(**given)
        self._limits = limits or ConnectionLimits()
        self._awaited: str | None = None
        self._timer: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Take a connection, if it is not one too many."""
        super().connection_made(transport)
        address = self.client[0] if self.client else None
        addresses = [getattr(other, "client", None) for other in self.connections]
        alike = sum(1 for other in addresses if other and other[0] == address)
        if len(self.connections) > self._limits.total or (address and alike > self._limits.per_address):
            transport.abort()
            self.connections.discard(self)
            return
        self._await("head", self._limits.head_s)

    def data_received(self, data: bytes) -> None:
        """Take bytes, and watch how long what they begin takes to end."""
        if self.transport.is_closing():
            return
        super().data_received(data)
        theirs = self.conn.their_state
        if theirs is h11.SEND_BODY:
            self._await("body", self._limits.body_s)
        elif theirs is h11.IDLE:
            self._await("head", self._limits.head_s)
        else:
            self._arrived()

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget a connection."""
        self._arrived()
        super().connection_lost(exc)

    def _await(self, part: str, seconds: float) -> None:
        if self._awaited != part:
            self._arrived()
            self._awaited = part
            self._timer = self.loop.call_later(seconds, self._nearly_too_slow)

    def _arrived(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._awaited = self._timer = None

    def _nearly_too_slow(self) -> None:
        """Give bytes a chance that arrived while this process was held up itself."""
        self._timer = self.loop.call_later(_CHANCE_S, self._too_slow)

    def _too_slow(self) -> None:
        if self.transport.is_closing():
            return
        if self.cycle is None or self.cycle.response_complete or not self.cycle.response_started:
            self.transport.write(_TOO_SLOW)
        self.transport.close()
