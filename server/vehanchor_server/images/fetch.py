"""Fetch images from web servers that the operator allows.

These checks prevent server-side request forgery. They apply to every redirect: https only, listed
hosts only, public addresses only. The connection goes to the checked address, not to the name, so
that a second DNS answer has no effect. The certificate is still verified for the name.
"""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Awaitable, Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any
from urllib.parse import SplitResult, urljoin, urlsplit

import anyio
import httpcore2 as httpcore

from vehanchor.errors import ImageTooLargeError
from vehanchor.imagery.limits import check_bytes
from vehanchor_server.errors import CallError, shortened

if TYPE_CHECKING:
    import ssl

MAX_REDIRECTS = 3
_REDIRECTS = (301, 302, 303, 307, 308)
_HTTPS_PORT = 443
# Networks that ``ipaddress`` calls public, at least in some versions of Python.
_NOT_PUBLIC = (
    ipaddress.ip_network("64:ff9b::/96"),  # NAT64: embeds an IPv4 address and routes to it
    ipaddress.ip_network("fec0::/10"),  # site-local, deprecated; private
    ipaddress.ip_network("3fff::/20"),  # documentation, RFC 9637
    ipaddress.ip_network("192.0.0.0/24"),  # protocol assignments, RFC 6890
    ipaddress.ip_network("192.88.99.0/24"),  # 6to4 relays, deprecated
    ipaddress.ip_network("168.63.129.16/32"),  # Azure's internal services
)
_HEADERS = (
    (b"Accept", b"image/*, */*;q=0.5"),
    (b"Accept-Encoding", b"identity"),
    (b"User-Agent", b"vehanchor"),
)


def is_public_address(address: str) -> bool:
    """Return whether an IP address is public.

    Private, loopback, link-local, multicast and reserved addresses are not. Of an address that
    embeds an IPv4 address, that one decides, or the address is refused.
    """
    try:
        ip = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return False
    if isinstance(ip, ipaddress.IPv6Address):
        if ip.ipv4_mapped is not None:
            return is_public_address(str(ip.ipv4_mapped))
        if ip.sixtofour is not None or ip.teredo is not None:
            return False
    if any(ip in network for network in _NOT_PUBLIC if network.version == ip.version):
        return False
    return ip.is_global and not (ip.is_multicast or ip.is_reserved or ip.is_unspecified)


async def resolve_host(host: str, port: int) -> list[str]:
    """Resolve a host to its addresses, in the system's order."""
    entries = await anyio.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    return [str(address[0]) for *_, address in entries]


@dataclass(frozen=True)
class Fetcher:
    """Fetcher of images by URL.

    Attributes:
        hosts: allowed hosts, ``name`` (port 443) or ``name:port``; an empty tuple refuses every
            URL.
        max_bytes: largest image.
        timeout_s: time limit, with redirects.
        ssl_context: verification of certificates; None for the system's authorities.
        resolve: resolves host and port to addresses.
        is_public: returns whether connections to an address are allowed.
    """

    hosts: tuple[str, ...]
    max_bytes: int
    timeout_s: float = 20.0
    ssl_context: ssl.SSLContext | None = None
    resolve: Callable[[str, int], Awaitable[list[str]]] = resolve_host
    is_public: Callable[[str], bool] = is_public_address

    async def fetch(self, url: str) -> bytes:
        """Fetch the bytes at a URL.

        Raises:
            CallError: ``source_disabled``, ``url_not_allowed``, ``fetch_failed``, or the library's
                ``image_too_large``.
        """
        if not self.hosts:
            raise CallError(
                "source_disabled",
                "this server fetches no images by URL. Use another kind, or start it with "
                "--image-host HOST.",
            )
        with anyio.move_on_after(self.timeout_s):
            return await self._follow(url)
        raise CallError(
            "fetch_failed",
            f"the image did not arrive within {self.timeout_s:g} s. Try again, or send it.",
        )

    async def _follow(self, url: str) -> bytes:
        """Fetch the bytes at a URL or at the end of its redirects; check each address."""
        backend = _PinnedBackend(self)
        async with httpcore.AsyncConnectionPool(
            ssl_context=self.ssl_context, network_backend=backend
        ) as pool:
            for _ in range(MAX_REDIRECTS + 1):
                answer = await self._request(pool, self._checked(url))
                if isinstance(answer, bytes):
                    return answer
                url = answer
        raise CallError(
            "fetch_failed", f"more than {MAX_REDIRECTS} redirects. Give the image's final address."
        )

    def _checked(self, url: str) -> SplitResult:
        """Return the URL's parts if its form and host are allowed.

        Raises:
            CallError: ``url_not_allowed``.
        """
        try:
            parts = urlsplit(url)
            host = (parts.hostname or "").lower()
            port = parts.port or _HTTPS_PORT
        except ValueError:
            raise CallError(
                "url_not_allowed", "the URL is malformed. Give https://host/path."
            ) from None
        if parts.scheme != "https" or parts.username is not None or parts.password is not None:
            raise CallError(
                "url_not_allowed",
                "only https:// URLs without a user name are allowed. Give such a URL.",
            )
        if not (url.isascii() and url.isprintable()) or " " in url:
            raise CallError(
                "url_not_allowed",
                "the URL contains characters that need percent-encoding. Encode them.",
            )
        # A host without a port in the list stands for the usual port.
        is_listed = f"{host}:{port}" in self.hosts
        if not is_listed and not (port == _HTTPS_PORT and host in self.hosts):
            raise CallError(
                "url_not_allowed",
                f"host {shortened(host)!r} is not allowed. Allowed: {', '.join(self.hosts)}.",
            )
        return parts

    async def _request(self, pool: httpcore.AsyncConnectionPool, parts: SplitResult) -> bytes | str:
        """Return the body, or the target of a redirect."""
        url = parts._replace(fragment="").geturl()
        try:
            async with pool.stream("GET", url, headers=_HEADERS) as response:
                if response.status in _REDIRECTS:
                    location = _header(response, b"location")
                    return urljoin(url, location.decode("latin-1"))
                if response.status != 200:
                    raise CallError(
                        "fetch_failed", f"the host answered {response.status}. Check the URL."
                    )
                return await self._body(response)
        except (
            httpcore.NetworkError,
            httpcore.ProtocolError,
            httpcore.TimeoutException,
            OSError,
            ValueError,
        ) as error:
            raise CallError(
                "fetch_failed", f"{type(error).__name__} at the host. Check the URL, or try again."
            ) from error

    async def _body(self, response: httpcore.Response) -> bytes:
        """Read the body; refuse one above the limit, at once if it declares its length."""
        declared = _header(response, b"content-length")
        body = bytearray()
        try:
            if declared.isdigit():
                check_bytes(int(declared), self.max_bytes)
            async for chunk in response.aiter_stream():
                body += chunk
                check_bytes(len(body), self.max_bytes)
        except ImageTooLargeError as error:
            raise CallError.of(error) from None
        return bytes(body)


def _header(response: httpcore.Response, name: bytes) -> bytes:
    """Return the value of a header, by its name in lower case; empty without one."""
    for header, value in response.headers:
        if header.lower() == name:
            return value
    return b""


class _PinnedBackend(httpcore.AnyIOBackend):
    """Network backend that connects to the checked address of a host."""

    def __init__(self, fetcher: Fetcher) -> None:
        self._fetcher = fetcher

    async def connect_tcp(
        self,
        host: str,
        port: int,
        timeout: float | None = None,
        local_address: str | None = None,
        socket_options: Iterable[Any] | None = None,
    ) -> httpcore.AsyncNetworkStream:
        try:
            addresses = await self._fetcher.resolve(host, port)
        except UnicodeError:  # an invalid host name
            addresses = []
        # A mixture of public and private addresses is refused, too; no image host has one.
        if not addresses or not all(map(self._fetcher.is_public, addresses)):
            raise CallError(
                "url_not_allowed",
                f"host {shortened(host)!r} does not resolve to public addresses. Use another URL.",
            )
        return await super().connect_tcp(
            addresses[0],
            port,
            timeout=timeout,
            local_address=local_address,
            socket_options=socket_options,
        )
