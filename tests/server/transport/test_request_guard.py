"""What a request may cost before it is known to be a call."""

from __future__ import annotations

import contextlib
import json
import select
import socket
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx2 as httpx
import pytest
from starlette.middleware.exceptions import ExceptionMiddleware

from tests.server.transport.test_http import discover, served
from vehanchor_server.settings import Settings
from vehanchor_server.transport.request_guard import MAX_NESTED, MAX_SEPARATORS, RequestGuard

N_UNKNOWN = 500_000


@pytest.fixture(scope="module")
def base(detector_path: Path) -> Iterator[str]:
    settings = Settings(detector=str(detector_path), max_concurrency=1, isolation="in-process")
    with served(settings) as address:
        yield address


def call(arguments: dict[str, Any], *, modern: bool, name: str = "estimate_gsd") -> dict[str, Any]:
    """A call as a plain HTTP client sends it."""
    request = discover()
    request["json"]["method"] = "tools/call"
    request["json"]["params"] |= {"name": name, "arguments": arguments}
    request["headers"] |= {
        "Mcp-Method": "tools/call",
        "Mcp-Name": name,
        "Content-Type": "application/json",
    }
    if not modern:
        del request["json"]["params"]["_meta"]
        request["headers"] = {
            key: value for key, value in request["headers"].items() if not key.startswith("M")
        }
    return {"content": json.dumps(request["json"]).encode(), "headers": request["headers"]}


@pytest.fixture(scope="module")
def unknown() -> bytes:
    """A JSON object of half a million members."""
    return b"{" + b",".join(b'"a%d":0' % i for i in range(N_UNKNOWN)) + b"}"


def with_unknown(unknown: bytes, *, modern: bool, nested: bool) -> dict[str, Any]:
    """A call that has the members as its arguments, or in its image."""
    request = call({"image": "unknown"} if nested else {"unknown": "unknown"}, modern=modern)
    replaced = b'"unknown"' if nested else b'{"unknown": "unknown"}'
    request["content"] = request["content"].replace(replaced, unknown)
    assert len(request["content"]) > 5_000_000
    return request


@pytest.mark.promise("requests")
@pytest.mark.parametrize("modern", [True, False])
def test_very_many_unknown_arguments_are_refused_before_they_are_parsed(
    base: str, unknown: bytes, modern: bool
) -> None:
    request = with_unknown(unknown, modern=modern, nested=modern)
    with httpx.Client(timeout=60) as client:
        answer = client.post(f"{base}/mcp", **request)
    assert answer.status_code == 400
    message = answer.json()["error"]["message"]
    assert message.startswith("invalid_arguments: the request has more than")


@pytest.mark.anyio
@pytest.mark.parametrize("part", [b"," * 1000, b"[" * 1000, b'"a":0,' * 200])
async def test_the_application_gets_no_more_of_a_body_than_may_be_parsed(part: bytes) -> None:
    parts = [0]
    answers = []

    async def receive() -> Any:
        parts[0] += 1
        return {"type": "http.request", "body": part, "more_body": True}

    async def send(message: Any) -> None:
        answers.append(message)

    async def parsing(scope: Any, receive: Any, send: Any) -> None:
        while (await receive())["more_body"]:
            pass

    door = RequestGuard(ExceptionMiddleware(parsing), path="/mcp", max_large_bodies=1)
    await door(
        {"type": "http", "path": "/mcp", "headers": [(b"host", b"localhost")]}, receive, send
    )
    assert parts[0] <= MAX_SEPARATORS // 400 + 1
    assert answers[0]["status"] == 400


@pytest.mark.promise("requests")
@pytest.mark.parametrize("depth", [MAX_NESTED, 1_000_000])
def test_deep_json_is_refused(base: str, depth: int) -> None:
    request = call({"image": "deep"}, modern=True)
    request["content"] = request["content"].replace(b'"deep"', b"[" * depth + b"]" * depth)
    with httpx.Client(timeout=60) as client:
        answer = client.post(f"{base}/mcp", **request)
    assert answer.status_code == 400
    assert "invalid_arguments" in answer.text


def test_a_path_of_commas_is_no_list(base: str) -> None:
    assert MAX_SEPARATORS > 2 * 4096
    with httpx.Client(timeout=60) as client:
        answer = client.post(
            f"{base}/mcp",
            **call({"image": {"kind": "path", "path": "/" + ",:" * 2000}}, modern=True),
        )
    assert answer.status_code == 200
    assert "source_disabled" in answer.text


@pytest.mark.promise("places")
def test_bodies_beyond_the_places_are_refused_before_they_are_read(base: str) -> None:
    host, port = base.removeprefix("http://").split(":")
    head = (
        f"POST /mcp HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
        f"Accept: application/json, text/event-stream\r\nContent-Length: {30 << 20}\r\n\r\n"
    ).encode()
    large = call({"image": {"kind": "base64", "data": "A" * 200_000}}, modern=True)

    def until_answered(client: httpx.Client, status: int) -> None:
        while client.post(f"{base}/mcp", **large).status_code != status:
            time.sleep(0.02)

    with contextlib.ExitStack() as stack:
        client = stack.enter_context(httpx.Client(timeout=60))
        for _ in range(3):  # one call, two to spare
            sending = stack.enter_context(socket.create_connection((host, int(port)), timeout=10))
            sending.sendall(head + b"{" + b" " * (1 << 20))
        until_answered(client, 503)
        with socket.create_connection((host, int(port)), timeout=10) as refused:
            refused.sendall(head)
            assert refused.recv(4096).startswith(b"HTTP/1.1 503")
        # what is small needs no place
        assert client.post(f"{base}/mcp", **discover()).status_code == 200
    with httpx.Client(timeout=60) as client:
        until_answered(client, 200)  # their places are free again


def test_who_hangs_up_in_the_middle_of_a_body_leaves_no_traceback(
    base: str, caplog: pytest.LogCaptureFixture
) -> None:
    host, port = base.removeprefix("http://").split(":")

    def until_idle() -> None:  # what the server has received is dealt with before it answers twice
        for _ in range(2):
            with urllib.request.urlopen(f"{base}/healthz", timeout=60) as answer:
                assert answer.status == 200

    with socket.create_connection((host, int(port)), timeout=5) as leaving:
        leaving.sendall(
            b"POST /mcp HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
            b"Accept: application/json, text/event-stream\r\nContent-Length: 100\r\n\r\n{"
        )
        until_idle()
    until_idle()
    assert not [record for record in caplog.records if record.exc_info]


def test_a_client_that_sends_on_after_a_refusal_reads_it(base: str) -> None:
    host, port = base.removeprefix("http://").split(":")
    part = b"," * (64 << 10)
    n_parts = 32
    head = (
        f"POST /mcp HTTP/1.1\r\nHost: localhost\r\nContent-Length: {n_parts * len(part)}\r\n\r\n"
    ).encode()
    with socket.create_connection((host, int(port)), timeout=20) as client:
        client.sendall(head + part)
        assert select.select([client], [], [], 20)[0]
        for _ in range(n_parts - 1):
            client.sendall(part)
        assert client.recv(4096).startswith(b"HTTP/1.1 400")
