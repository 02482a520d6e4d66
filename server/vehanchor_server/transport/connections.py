"""Limits on idle connections: their number, and the time for a request to arrive.

uvicorn limits requests, not connections, and has no timeout for the first request. When the process has no free file
descriptors, asyncio fails to accept and logs the failure two thousand times per second.
"""

from __future__ import annotations

import asyncio
import logging
from dataclasses import dataclass, replace
from typing import Any

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

# Accepted at once, before the limit applies; the process needs as many descriptors beyond its limit.
BACKLOG = 128
_FILES, _FILES_OF_A_CALL = 24, 8  # descriptors of the process itself, and of a call with its worker
_LEAST_CONNECTIONS = 4
_IDLE_S = 0.5  # after which a connection without a request gives way to a new one
MAX_HEAD_BYTES = 32 << 10
_GRACE_S = 0.2
_log = logging.getLogger(__name__)
_TOO_SLOW = b"HTTP/1.1 408 Request Timeout\r\nConnection: close\r\nContent-Length: 0\r\n\r\n"


@dataclass(frozen=True)
class ConnectionLimits:
    """Limits on the connections of one process.

    Attributes:
        total: concurrent connections.
        per_address: concurrent connections from one address.
        head_s: seconds from the opening, or from the first byte of a later request, to the end of the request head.
        body_s: seconds from the end of the head to the end of the body.
    """

    total: int = 512
    per_address: int = 256
    head_s: float = 20.0
    body_s: float = 60.0


def within_open_files(limits: ConnectionLimits, n_calls: int) -> tuple[ConnectionLimits, int]:
    """Reduce limits to what the limit on open files allows (``ulimit -n``).

    Args:
        limits: the operator's limits.
        n_calls: concurrent calls.

    Returns:
        The limits and the backlog.
    """
    try:
        import resource
    except ImportError:  # Windows has no such limit
        return limits, BACKLOG
    n_files, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    if n_files == resource.RLIM_INFINITY:
        return limits, BACKLOG
    spare = max(2 * _LEAST_CONNECTIONS, n_files - _FILES - n_calls * _FILES_OF_A_CALL)
    backlog = min(BACKLOG, spare // 2)
    total = min(limits.total, spare - backlog)
    if total < limits.total:
        _log.warning(
            "at most %d connections: ulimit -n is %d, and --max-connections %d needs %d",
            total,
            n_files,
            limits.total,
            n_files + limits.total - total + BACKLOG - backlog,
        )
    return replace(limits, total=total), backlog


class LimitedProtocol(H11Protocol):
    """uvicorn's HTTP/1.1 protocol with limits on connections and times.

    Args:
        limits: the limits.
        given: uvicorn's arguments.
    """

    def __init__(self, *, limits: ConnectionLimits | None = None, **given: Any) -> None:
        super().__init__(**given)
        self._limits = limits or ConnectionLimits()
        self._awaited: str | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._opened_s = 0.0

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Accept a connection within the limits."""
        super().connection_made(transport)
        address = self.client[0] if self.client else None
        addresses = [getattr(other, "client", None) for other in self.connections]
        alike = sum(1 for other in addresses if other and other[0] == address)
        if address and alike > self._limits.per_address:
            self._abort()
            return
        self._opened_s = self.loop.time()
        if len(self.connections) > self._limits.total:
            idle = self._longest_idle()
            idle._abort()
            if idle is self:
                return
        self._await("head", self._limits.head_s)

    def _longest_idle(self) -> LimitedProtocol:
        """Find the oldest connection that has sent no request for a while; this one if there is none."""
        before = self._opened_s - _IDLE_S
        others = [each for each in self.connections if isinstance(each, LimitedProtocol) and each is not self]
        idle = [each for each in others if each._awaited == "head" and each._opened_s < before]
        return min(idle, key=lambda each: each._opened_s, default=self)

    def _abort(self) -> None:
        self.transport.abort()
        self.connections.discard(self)

    def data_received(self, data: bytes) -> None:
        """Receive bytes and time the current part of the request."""
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
        """Release a connection."""
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
        """Allow for bytes that arrived while this process was busy."""
        self._timer = self.loop.call_later(_GRACE_S, self._too_slow)

    def _too_slow(self) -> None:
        if self.transport.is_closing():
            return
        if self.cycle is None or self.cycle.response_complete or not self.cycle.response_started:
            self.transport.write(_TOO_SLOW)
        self.transport.close()
