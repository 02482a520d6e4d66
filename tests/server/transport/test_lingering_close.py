"""Early answers reach clients that are still sending."""

from __future__ import annotations

import contextlib
import select
import socket
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import anyio
import pytest

from tests.server.transport.test_http import served
from vehanchor_server.settings import Settings
from vehanchor_server.transport.lingering_close import LingeringClose

pytestmark = pytest.mark.anyio

PART = b"," * (64 << 10)  # enough to be refused by the first one: 10,000 commas are too many
N_PARTS = 128
MAX_BODY_BYTES = 4 << 20
N_PLACES = 3  # for one call, and two to spare
HEAD = (
    b"POST /mcp HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
    b"Accept: application/json, text/event-stream\r\n"
)


@pytest.fixture(scope="module")
def address(detector_path: Path) -> Iterator[tuple[str, int]]:
    settings = Settings(
        detector=str(detector_path), in_process=True, max_concurrency=1, max_body_mb=MAX_BODY_BYTES / (1 << 20)
    )
    with served(settings) as base:
        host, port = base.removeprefix("http://").split(":")
        yield host, int(port)


def answer_to(connection: socket.socket) -> bytes:
    """All that the server says until it closes."""
    said = b""
    while part := connection.recv(4096):
        said += part
    return said


@pytest.mark.parametrize(
    ("head", "status"),
    [
        (HEAD + b"Connection: close\r\nContent-Length: %d\r\n\r\n" % (N_PARTS * len(PART)), b"413"),
        (HEAD + b"Content-Length: %d\r\n\r\n" % (N_PARTS * len(PART)), b"413"),
        (HEAD.replace(b"localhost", b"evil.test") + b"Content-Length: %d\r\n\r\n" % (N_PARTS * len(PART)), b"421"),
        (HEAD.replace(b"/mcp", b"/nowhere") + b"Content-Length: %d\r\n\r\n" % (N_PARTS * len(PART)), b"404"),
        (HEAD + b"Content-Length: %d\r\n\r\n" % (32 * len(PART)), b"400"),
    ],
    ids=["too large, to be closed", "too large", "foreign host", "no such path", "too many commas"],
)
def test_a_client_that_sends_on_after_the_answer_can_send_all_and_read_it(
    address: tuple[str, int], head: bytes, status: bytes
) -> None:
    length = int(head.partition(b"Content-Length: ")[2])
    with socket.create_connection(address, timeout=20) as client:
        client.sendall(head + PART)
        assert select.select([client], [], [], 20)[0]  # the answer has come, and the server has done what it will do
        for _ in range(length // len(PART) - 1):
            client.sendall(PART)
        said = answer_to(client)
    assert said.startswith(b"HTTP/1.1 " + status)
    assert b"\r\nconnection: close\r\n" in said.lower()


def test_a_client_that_asks_to_close_reads_that_its_body_is_too_large(address: tuple[str, int]) -> None:
    request = urllib.request.Request(f"http://{address[0]}:{address[1]}/mcp", b" " * (N_PARTS * len(PART)))
    with pytest.raises(urllib.error.HTTPError, match="413") as refused:  # urllib always asks to close
        urllib.request.urlopen(request, timeout=20)
    refused.value.close()


def test_a_refused_request_of_ordinary_size_keeps_its_connection(address: tuple[str, int]) -> None:
    request = HEAD.replace(b"localhost", b"evil.test") + b"Content-Length: 1000\r\n\r\n" + b" " * 1000
    with socket.create_connection(address, timeout=20) as client:
        for _ in range(2):
            client.sendall(request)
            said = b""
            while b"Invalid Host header" not in said:
                said += client.recv(4096)
            assert said.startswith(b"HTTP/1.1 421")


async def early_answer(scope: Any, receive: Any, send: Any) -> None:
    await send({"type": "http.response.start", "status": 413, "headers": [(b"content-length", b"3")]})
    await send({"type": "http.response.body", "body": b"no."})


async def linger(receive: Callable[[], Any], *, max_bytes: int, max_s: float) -> list[Any]:
    """The messages that answer a request in chunks."""
    sent: list[Any] = []

    async def send(message: Any) -> None:
        sent.append(message)

    scope = {"type": "http", "headers": [(b"transfer-encoding", b"chunked")]}
    await LingeringClose(early_answer, max_bytes=max_bytes, max_s=max_s)(scope, receive, send)
    return sent


async def test_a_body_without_end_is_read_up_to_the_limit_of_bytes() -> None:
    n_read = 0

    async def receive() -> Any:
        nonlocal n_read
        n_read += 1000
        return {"type": "http.request", "body": b"x" * 1000, "more_body": True}

    sent = await linger(receive, max_bytes=10_000, max_s=60)
    assert n_read == 10_000
    assert (b"connection", b"close") in sent[0]["headers"]
    assert [(message["body"], message["more_body"]) for message in sent[1:]] == [(b"no.", True), (b"", False)]


async def test_a_body_that_stops_arriving_is_awaited_up_to_the_limit_of_seconds() -> None:
    async def receive() -> Any:
        await anyio.sleep_forever()

    sent = await linger(receive, max_bytes=10_000, max_s=0.05)
    assert [message.get("more_body") for message in sent] == [None, True, False]


async def test_a_client_that_leaves_is_not_awaited() -> None:
    messages = [{"type": "http.disconnect"}]

    async def receive() -> Any:
        return messages.pop()

    sent = await linger(receive, max_bytes=10_000, max_s=60)
    assert sent[-1]["more_body"] is False


def test_what_is_left_of_refused_bodies_takes_no_place_of_others(address: tuple[str, int]) -> None:
    head = HEAD + b"Content-Length: %d\r\n\r\n" % (32 * len(PART))
    image = b'{"image": "' + b"A" * (2 * len(PART)) + b'"}'  # large enough to need a place
    with contextlib.ExitStack() as stack:
        for _ in range(N_PLACES):
            refused = stack.enter_context(socket.create_connection(address, timeout=20))
            refused.sendall(head + b" " * len(PART) + PART)
            assert refused.recv(4096).startswith(b"HTTP/1.1 400")
        with socket.create_connection(address, timeout=20) as client:
            client.sendall(HEAD + b"Connection: close\r\nContent-Length: %d\r\n\r\n" % len(image) + image)
            assert b" 503 " not in answer_to(client).partition(b"\r\n")[0]
