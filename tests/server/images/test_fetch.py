"""What a caller's URL can be made to reach."""

from __future__ import annotations

import ssl
import threading
from collections.abc import Iterator
from dataclasses import dataclass, replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import ClassVar

import pytest
import trustme

from vehanchor_server.errors import CallError
from vehanchor_server.images.fetch import MAX_REDIRECTS, Fetcher, is_public_address

pytestmark = pytest.mark.anyio

PICTURE = b"a picture" * 100


class _Handler(BaseHTTPRequestHandler):
    requests: ClassVar[list[tuple[str, str]]] = []
    may_answer: ClassVar[threading.Event] = threading.Event()

    def do_GET(self) -> None:
        type(self).requests.append((self.headers["Host"], self.path))
        if self.path == "/slow":
            self.may_answer.wait(60)
        if self.path.startswith("/to/"):
            self.send_response(302)
            self.send_header("Location", self.path.removeprefix("/to/"))
            self.end_headers()
            return
        self.send_response(404 if self.path == "/missing" else 200)
        if self.path != "/endless":
            self.send_header("Content-Length", str(len(PICTURE)))
        self.end_headers()
        for _ in range(1000 if self.path == "/endless" else 1):
            self.wfile.write(PICTURE)

    def log_message(self, *_: object) -> None:
        pass


@dataclass(frozen=True)
class WebServer:
    port: int
    trust: ssl.SSLContext
    requests: list[tuple[str, str]]

    def url(self, path: str = "/a.png", host: str = "images.test") -> str:
        return f"https://{host}:{self.port}{path}"


@pytest.fixture(scope="module")
def _web_server() -> Iterator[WebServer]:
    authority = trustme.CA()
    server = ThreadingHTTPServer(("127.0.0.1", 0), _Handler)
    server.daemon_threads = True
    server.handle_error = lambda *_: None  # type: ignore[method-assign] # clients that hang up are the point
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    authority.issue_cert("images.test", "other.test").configure_cert(context)
    server.socket = context.wrap_socket(server.socket, server_side=True)
    thread = threading.Thread(
        target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True
    )
    thread.start()
    trust = ssl.create_default_context()
    authority.configure_trust(trust)
    yield WebServer(server.server_address[1], trust, _Handler.requests)
    server.shutdown()
    server.server_close()
    thread.join()


@pytest.fixture
def web_server(_web_server: WebServer) -> WebServer:
    _web_server.requests.clear()
    return _web_server


@pytest.fixture
def fetcher(web_server: WebServer) -> Fetcher:
    """A fetcher to which the loopback address is public."""

    async def resolve(host: str, port: int) -> list[str]:
        return ["127.0.0.1"]

    return Fetcher(
        hosts=(f"images.test:{web_server.port}",),
        max_bytes=10_000,
        timeout_s=60,
        ssl_context=web_server.trust,
        resolve=resolve,
        is_public=lambda address: address == "127.0.0.1",
    )


async def refusal(fetcher: Fetcher, url: str) -> CallError:
    with pytest.raises(CallError) as caught:
        await fetcher.fetch(url)
    return caught.value


def resolving_to(fetcher: Fetcher, *addresses: str) -> Fetcher:
    async def resolve(host: str, port: int) -> list[str]:
        return list(addresses)

    return replace(fetcher, resolve=resolve)


async def test_an_image_on_an_allowed_host_is_fetched(
    fetcher: Fetcher, web_server: WebServer
) -> None:
    assert await fetcher.fetch(web_server.url("/a.png?size=2#top")) == PICTURE
    assert web_server.requests == [(f"images.test:{web_server.port}", "/a.png?size=2")]


async def test_a_redirect_on_an_allowed_host_is_followed(
    fetcher: Fetcher, web_server: WebServer
) -> None:
    assert await fetcher.fetch(web_server.url("/to//a.png")) == PICTURE
    assert await fetcher.fetch(web_server.url(f"/to/{web_server.url()}")) == PICTURE


@pytest.mark.promise("no-sources")
async def test_without_hosts_urls_are_off() -> None:
    error = await refusal(Fetcher((), 100, 1), "https://images.test/a.png")
    assert error.code == "source_disabled"


@pytest.mark.parametrize(
    "address",
    [
        "127.0.0.1",
        "10.0.0.1",
        "172.16.3.4",
        "192.168.1.1",
        "169.254.169.254",
        "100.64.0.1",
        "0.0.0.0",
        "224.0.0.1",
        "255.255.255.255",
        "192.0.2.1",
        "::1",
        "::",
        "fe80::1",
        "fe80::1%eth0",
        "fd00:ec2::254",
        "ff02::1",
        "::ffff:127.0.0.1",
        "::ffff:169.254.169.254",
        "64:ff9b::a9fe:a9fe",
        "2002:a9fe:a9fe::1",
        "2001:0:a9fe:a9fe::1",
        "fec0::1",
        "feff::1",
        "3fff::1",
        "3fff:fff::1",
        "192.0.0.9",
        "192.0.0.170",
        "192.88.99.1",
        "168.63.129.16",
        "not an address",
    ],
)
def test_addresses_that_only_look_public_are_not_public(address: str) -> None:
    assert not is_public_address(address)


@pytest.mark.parametrize(
    "address",
    [
        "93.184.216.34",
        "8.8.8.8",
        "2606:4700:4700::1111",
        "::ffff:8.8.8.8",
        "168.63.129.17",
        "2606:2800:220:1::1",
    ],
)
def test_public_addresses_are_public(address: str) -> None:
    assert is_public_address(address)


async def test_one_private_address_among_public_ones_is_enough(
    fetcher: Fetcher, web_server: WebServer
) -> None:
    mixed = replace(resolving_to(fetcher, "8.8.8.8", "127.0.0.1"), is_public=is_public_address)
    refused = await refusal(mixed, web_server.url())
    assert refused.code == "url_not_allowed"
    assert "127.0.0.1" not in str(refused)


@pytest.mark.promise("fetch")
async def test_the_checked_address_is_the_one_connected_to(
    fetcher: Fetcher, web_server: WebServer
) -> None:
    answers = iter([["127.0.0.1"], ["10.0.0.1"], ["10.0.0.1"]])

    async def rebinding(host: str, port: int) -> list[str]:
        return next(answers)

    assert await replace(fetcher, resolve=rebinding).fetch(web_server.url()) == PICTURE
    assert next(answers) == ["10.0.0.1"], "the name was looked up a second time"


@pytest.mark.promise("fetch")
@pytest.mark.parametrize(
    "target",
    [
        "https://169.254.169.254/latest/meta-data/",
        "http://169.254.169.254/latest/meta-data/",
        "http://images.test/a.png",
        "https://other.test/a.png",
        "file:///etc/passwd",
        "//evil.test/a.png",
    ],
)
async def test_redirects_are_checked_like_the_first_url(
    fetcher: Fetcher, web_server: WebServer, target: str
) -> None:
    assert (await refusal(fetcher, web_server.url(f"/to/{target}"))).code == "url_not_allowed"
    assert len(web_server.requests) == 1


async def test_the_host_of_a_redirect_is_checked_too(
    fetcher: Fetcher, web_server: WebServer
) -> None:
    async def resolve(host: str, port: int) -> list[str]:
        return ["127.0.0.1"] if host == "images.test" else ["169.254.169.254"]

    both = replace(
        fetcher, hosts=(*fetcher.hosts, f"other.test:{web_server.port}"), resolve=resolve
    )
    error = await refusal(both, web_server.url(f"/to/{web_server.url(host='other.test')}"))
    assert error.code == "url_not_allowed"
    assert len(web_server.requests) == 1


async def test_redirects_end(fetcher: Fetcher, web_server: WebServer) -> None:
    error = await refusal(fetcher, web_server.url("/to/" * 9 + "/a.png"))
    assert error.code == "fetch_failed"
    assert len(web_server.requests) == MAX_REDIRECTS + 1


async def test_the_certificate_is_verified_for_the_name(
    fetcher: Fetcher, web_server: WebServer
) -> None:
    wrong_name = replace(fetcher, hosts=(f"evil.test:{web_server.port}",))
    assert (await refusal(wrong_name, web_server.url(host="evil.test"))).code == "fetch_failed"
    untrusted = replace(fetcher, ssl_context=None)
    assert (await refusal(untrusted, web_server.url())).code == "fetch_failed"
    assert web_server.requests == []


@pytest.mark.promise("fetch")
async def test_size_is_capped_whether_declared_or_not(
    fetcher: Fetcher, web_server: WebServer
) -> None:
    assert (
        await refusal(replace(fetcher, max_bytes=100), web_server.url())
    ).code == "image_too_large"
    assert (await refusal(fetcher, web_server.url("/endless"))).code == "image_too_large"


@pytest.mark.promise("fetch")
async def test_time_is_capped(fetcher: Fetcher, web_server: WebServer) -> None:
    _Handler.may_answer.clear()
    try:
        refused = await refusal(replace(fetcher, timeout_s=0.3), web_server.url("/slow"))
        assert refused.code == "fetch_failed"  # before the host has answered
    finally:
        _Handler.may_answer.set()


async def test_failures_of_the_host_are_told(fetcher: Fetcher, web_server: WebServer) -> None:
    assert "404" in str(await refusal(fetcher, web_server.url("/missing")))

    async def unknown(host: str, port: int) -> list[str]:
        import socket

        raise socket.gaierror(-2, f"Name or service not known: {host}:{port}")

    assert (
        await refusal(replace(fetcher, resolve=unknown), web_server.url())
    ).code == "fetch_failed"
    closed = replace(fetcher, hosts=("images.test:1",))
    assert (await refusal(closed, "https://images.test:1/a.png")).code == "fetch_failed"


@pytest.mark.parametrize("location", ["https://[", "https://[::1", "//[x"])
async def test_a_redirect_that_cannot_be_read_is_told(
    fetcher: Fetcher, web_server: WebServer, location: str
) -> None:
    assert (await refusal(fetcher, web_server.url(f"/to/{location}"))).code == "fetch_failed"


async def test_a_name_that_the_resolver_cannot_encode_is_no_host(
    fetcher: Fetcher, web_server: WebServer
) -> None:
    async def resolve(host: str, port: int) -> list[str]:
        raise UnicodeError("label too long")

    assert (
        await refusal(replace(fetcher, resolve=resolve), web_server.url())
    ).code == "url_not_allowed"
