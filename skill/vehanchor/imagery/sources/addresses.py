"""Images on web servers, for addresses that the caller names. The MCP server has its own downloads and rules."""

from __future__ import annotations

import re
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from vehanchor.errors import ImageDecodeError, ImageNotFoundError, ImageTooLargeError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from vehanchor.imagery.formats.ifd import ReadAt
    from vehanchor.options import ImageLimits

_ADDRESS = re.compile(r"https?://", re.IGNORECASE)
_TIMEOUT_S = 30.0
_PART_BYTES = 1 << 16  # range size for headers; most headers fit in the first range
_CHUNK_BYTES = 1 << 20


def is_address(name: str) -> bool:
    """Test whether a name is an http(s) address rather than a path."""
    return _ADDRESS.match(name) is not None


def gdal_name(address: str) -> str:
    """Convert an address to the name under which GDAL reads the file by ranges."""
    return f"/vsicurl/{address}"


def range_reader(address: str) -> ReadAt:
    """Create a reader that requests each range of a file once.

    Raises:
        ImageNotFoundError: on reading: there is no such file, or the server does not answer.
    """
    parts: dict[int, bytes] = {}

    def part(index: int) -> bytes:
        if index not in parts:
            first = index * _PART_BYTES
            with _opened(address, {"Range": f"bytes={first}-{first + _PART_BYTES - 1}"}) as reply:
                if reply.status == 206 or index == 0:
                    parts[index] = reply.read(_PART_BYTES)
                else:  # a server without ranges sends the whole file
                    parts[index] = b"" if reply.status == 416 else reply.read(first + _PART_BYTES)[first:]
        return parts[index]

    def read_at(offset: int, count: int) -> bytes:
        data = b""
        while len(data) < count:
            index, skipped = divmod(offset + len(data), _PART_BYTES)
            found = part(index)[skipped : skipped + count - len(data)]
            if not found:
                break
            data += found
        return data

    return read_at


def fetch_file(address: str, limits: ImageLimits) -> bytes:
    """Download a file.

    Raises:
        ImageNotFoundError: there is no such file, or the server does not answer.
        ImageTooLargeError: the file has more bytes than the limits allow.
    """
    data = bytearray()
    with _opened(address, {}) as reply:
        while chunk := reply.read(_CHUNK_BYTES):
            data += chunk
            if len(data) > limits.max_bytes:
                raise ImageTooLargeError(f"{address} exceeds the limit of {limits.max_bytes} bytes")
    return bytes(data)


@contextmanager
def _opened(address: str, headers: dict[str, str]) -> Iterator[Any]:
    """Open a server's reply, close it at the end, and translate its errors."""
    from http.client import HTTPException
    from urllib.error import HTTPError
    from urllib.request import Request, urlopen

    try:
        reply: Any = urlopen(Request(address, headers=headers), timeout=_TIMEOUT_S)
    except HTTPError as error:
        if error.code != 416:  # past the end
            raise ImageNotFoundError(f"{address} answers {error.code} {error.reason}") from error
        reply = error
    except (OSError, ValueError, HTTPException) as error:
        raise ImageNotFoundError(f"cannot read {address}: {error}; check the address") from error
    with reply:
        try:
            yield reply
        except (OSError, HTTPException) as error:
            raise ImageDecodeError(f"the download of {address} stopped: {error}; try again") from error
