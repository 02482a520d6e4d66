"""Images on web servers, for addresses that the caller names. The MCP server has its own downloads and rules.

A server can send slowly or without end. Every reply is read up to the bytes that were asked for, every connection is
cut when the image's time is spent, and redirects are counted.
"""

from __future__ import annotations

import io
import re
import socket
import threading
import time
from collections import OrderedDict
from contextlib import contextmanager, suppress
from functools import partial
from http.client import HTTPConnection, HTTPException, HTTPSConnection
from typing import TYPE_CHECKING, Any, Self
from urllib.parse import urljoin
from urllib.request import (
    HTTPHandler,
    HTTPSHandler,
    OpenerDirector,
    ProxyHandler,
    Request,
    UnknownHandler,
)

from vehanchor.errors import ImageDecodeError, ImageNotFoundError, ImageTooLargeError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from vehanchor.options import ImageLimits

MAX_REDIRECTS = 3
MAX_S = 600.0
"""Seconds that one image may wait for its server, in all."""

_ADDRESS = re.compile(r"https?://", re.IGNORECASE)
_REDIRECTS = (301, 302, 303, 307, 308)
_SILENCE_S = 30.0
_PART_BYTES = 1 << 16  # most headers fit in the first part
_PARTS_KEPT = 256  # 16 MiB, as in GDAL
_CHUNK_BYTES = 1 << 20


def is_address(name: str) -> bool:
    """Test whether a name is an http(s) address rather than a path."""
    return _ADDRESS.match(name) is not None


class RemoteFile:
    """A file on a web server.

    Args:
        address: its http(s) address.
        limits: ``max_bytes`` bounds a file that is downloaded whole.
        max_s: seconds to wait for the server, in all; None for ``MAX_S``.
    """

    def __init__(self, address: str, limits: ImageLimits, *, max_s: float | None = None) -> None:
        self.address = address
        self.size = 0
        self.has_ranges = False
        self._max_bytes = limits.max_bytes
        self._left_s = self._max_s = MAX_S if max_s is None else max_s
        self._parts: OrderedDict[int, bytes] = OrderedDict()
        self._lock = threading.Lock()

    def read_at(self, offset: int, count: int) -> bytes:
        """Read a range; a server without ranges gives only the start of its file.

        Raises:
            ImageNotFoundError: there is no such file, or the server does not answer.
            ImageDecodeError: the download stopped or took too long.
        """
        if count <= 0:
            return b""
        first, last = offset // _PART_BYTES, (offset + count - 1) // _PART_BYTES
        with self._lock:
            missing = [index for index in range(first, last + 1) if index not in self._parts]
            if missing:
                self._fetch_parts(missing[0], missing[-1])
            data = b"".join(self._parts.get(index, b"") for index in range(first, last + 1))
            while len(self._parts) > _PARTS_KEPT:
                self._parts.popitem(last=False)
        skipped = offset - first * _PART_BYTES
        return data[skipped : skipped + count]

    def fetch(self) -> bytes:
        """Download the file.

        Raises:
            ImageNotFoundError: there is no such file, or the server does not answer.
            ImageDecodeError: the download stopped or took too long.
            ImageTooLargeError: the file has more bytes than the limits allow.
        """
        with self._reply({}) as reply:
            data = _read(reply, self._max_bytes + 1)
        if len(data) > self._max_bytes:
            raise ImageTooLargeError(f"{self.address} exceeds the limit of {self._max_bytes} bytes")
        return data

    def _fetch_parts(self, first: int, last: int) -> None:
        """Request neighbouring parts at once."""
        start, count = first * _PART_BYTES, (last - first + 1) * _PART_BYTES
        if self._parts and (not self.has_ranges or start >= self.size):
            return
        with self._reply({"Range": f"bytes={start}-{start + count - 1}"}) as reply:
            if not self._parts:
                total = (reply.headers.get("Content-Range") or "").rpartition("/")[2]
                self.has_ranges = reply.status == 206 and total.isdigit()
                self.size = int(total) if self.has_ranges else 0
            if reply.status == 416 or (reply.status != 206 and start > 0):
                return
            data = _read(reply, count)
        for index in range(first, last + 1):
            begin = (index - first) * _PART_BYTES
            self._parts[index] = data[begin : begin + _PART_BYTES]

    @contextmanager
    def _reply(self, headers: dict[str, str]) -> Iterator[Any]:
        """Open the server's reply, close it at the end, and translate its errors."""
        started = time.monotonic()
        try:
            with _followed(self.address, headers, started + self._left_s) as reply:
                if reply.status not in (200, 206, 416):  # 416: past the end
                    raise ImageNotFoundError(f"{self.address} answers {reply.status} {reply.reason}")
                try:
                    yield reply
                    if time.monotonic() - started >= self._left_s:  # a cut reply may look complete
                        raise TimeoutError
                except (OSError, HTTPException, ValueError) as error:
                    raise self._stopped(error, started) from error
        except (OSError, ValueError, HTTPException) as error:
            if time.monotonic() - started >= self._left_s:
                raise self._stopped(error, started) from error
            raise ImageNotFoundError(f"cannot read {self.address}: {error}; check the address") from error
        finally:
            self._left_s -= time.monotonic() - started

    def _stopped(self, error: Exception, started: float) -> ImageDecodeError:
        spent = time.monotonic() - started >= self._left_s
        why = f"it took more than {self._max_s:g} s" if spent else str(error)
        return ImageDecodeError(f"the download of {self.address} stopped: {why}; try again, or download it first")


class RemoteStream(io.RawIOBase):
    """A remote file as GDAL reads it. A failed download reads as the file's end, which GDAL reports."""

    def __init__(self, file: RemoteFile) -> None:
        self._file = file
        self._at = 0

    def readable(self) -> bool:
        """Return True."""
        return True

    def seekable(self) -> bool:
        """Return True."""
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET, /) -> int:
        """Move to an offset."""
        self._at = offset + {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self._file.size}[whence]
        return self._at

    def tell(self) -> int:
        """Return the offset."""
        return self._at

    def read(self, size: int = -1, /) -> bytes:
        """Read bytes, fewer at the end of the file."""
        data = b""
        with suppress(ImageDecodeError, ImageNotFoundError):
            data = self._file.read_at(self._at, size if size >= 0 else self._file.size - self._at)
        self._at += len(data)
        return data


def _read(reply: Any, count: int) -> bytes:
    """Read a reply's body up to a number of bytes."""
    data = bytearray()
    while len(data) < count and (chunk := reply.read1(min(_CHUNK_BYTES, count - len(data)))):
        data += chunk
    return bytes(data)


@contextmanager
def _followed(address: str, headers: dict[str, str], ends: float) -> Iterator[Any]:
    """Open a reply after redirects to http(s) addresses; cut all connections at a time.

    Raises:
        OSError: the server does not answer, or redirects too often or elsewhere.
    """
    with _Deadline(ends) as deadline:
        opener = _opener(deadline)
        for _ in range(MAX_REDIRECTS + 1):
            with opener.open(Request(address, headers=headers), timeout=_SILENCE_S) as reply:
                if reply.status not in _REDIRECTS:
                    yield reply
                    return
                address = urljoin(address, reply.headers.get("Location", ""))
            if not is_address(address):
                raise OSError(f"it redirects to {address[:100]!r}, which is no http(s) address")
        raise OSError(f"it redirects more than {MAX_REDIRECTS} times")


class _Deadline:
    """Cut connections at a time; a timeout of a socket restarts with each byte."""

    def __init__(self, ends: float) -> None:
        self._connections: list[socket.socket] = []
        self._timer = threading.Timer(max(0.0, ends - time.monotonic()), self._cut)
        self._timer.daemon = True

    def __enter__(self) -> Self:
        self._timer.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._timer.cancel()
        for connection in self._connections:
            connection.close()

    def watch(self, connection: socket.socket) -> None:
        """Cut a connection, too. TLS takes the object of a socket away, hence the duplicate."""
        self._connections.append(connection.dup())

    def _cut(self) -> None:
        for connection in self._connections:
            with suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)


def _opener(deadline: _Deadline) -> OpenerDirector:
    """Create urllib's opener for http(s) alone, which returns redirects and failures as replies."""
    opener = OpenerDirector()
    for handler in (ProxyHandler(), UnknownHandler(), _Handler(deadline), _SecureHandler(deadline)):
        opener.add_handler(handler)
    return opener


class _Handler(HTTPHandler):
    def __init__(self, deadline: _Deadline) -> None:
        super().__init__()
        self._deadline = deadline

    def http_open(self, req: Request) -> Any:
        return self.do_open(partial(_watched, _Connection, self._deadline), req)


class _SecureHandler(HTTPSHandler):
    def __init__(self, deadline: _Deadline) -> None:
        super().__init__()
        self._deadline = deadline

    def https_open(self, req: Request) -> Any:
        return self.do_open(partial(_watched, _SecureConnection, self._deadline), req)


def _watched(kind: type[_Connection], deadline: _Deadline, host: str, **named: Any) -> _Connection:
    connection = kind(host, **named)
    connection.deadline = deadline
    return connection


class _Connection(HTTPConnection):
    """Connection that is watched from its opening."""

    deadline: _Deadline

    def connect(self) -> None:
        super().connect()
        self.deadline.watch(self.sock)


class _SecureConnection(HTTPSConnection, _Connection):
    """The same over TLS, with the handshake."""
