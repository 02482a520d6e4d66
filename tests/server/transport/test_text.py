"""Text at the border of the server: halves of characters, and clients that accept JSON alone."""

from __future__ import annotations

import json
from typing import Any

import pytest

from vehanchor_server.transport.json_reply import JsonReply
from vehanchor_server.transport.surrogates import without_lone_surrogates


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (r'"\ud83d.jpg"', r'"\ufffd.jpg"'),
        (r'"\uDC80\ud83d"', r'"\ufffd\ufffd"'),
        (r'"\ud83d\ude00"', r'"\ud83d\ude00"'),
        (r'"\\ud83d"', r'"\\ud83d"'),
        ('"plain"', '"plain"'),
    ],
)
def test_lone_surrogates_are_replaced(text: str, expected: str) -> None:
    assert without_lone_surrogates(text) == expected


async def _reply(accept: bytes | None) -> list[dict[str, Any]]:
    """Ask an application that answers by two events."""
    accepted = {}

    async def app(scope: Any, receive: Any, send: Any) -> None:
        accepted.update(dict(scope["headers"]))
        headers = [(b"content-type", b"text/event-stream")]
        await send({"type": "http.response.start", "status": 200, "headers": headers})
        progress = b'event: message\r\ndata: {"method":"progress"}\r\n\r\n'
        await send({"type": "http.response.body", "body": progress, "more_body": True})
        result = b'event: message\r\ndata: {"id":5,"result":{}}\r\n\r\n'
        await send({"type": "http.response.body", "body": result})

    sent: list[dict[str, Any]] = []

    async def send(message: Any) -> None:
        sent.append(message)

    headers = [] if accept is None else [(b"accept", accept)]
    scope: dict[str, Any] = {"type": "http", "method": "POST", "headers": headers}
    await JsonReply(app)(scope, None, send)  # type: ignore[arg-type]
    assert b"text/event-stream" in accepted[b"accept"]
    return sent


@pytest.mark.anyio
@pytest.mark.parametrize(
    "accept",
    [
        b"application/json",
        b"application/json; charset=utf-8",
        b"application/*",
        b"text/html, */*;q=0.8",
        b"application/json, text/event-stream;q=0",
        b"",
        None,
    ],
)
async def test_a_client_that_does_not_name_events_gets_json(accept: bytes | None) -> None:
    start, body = await _reply(accept)
    assert dict(start["headers"])[b"content-type"] == b"application/json"
    assert json.loads(body["body"]) == {"id": 5, "result": {}}


@pytest.mark.anyio
@pytest.mark.parametrize(
    "accept", [b"application/json, text/event-stream", b"text/event-stream", b"Text/*;q=0.5"]
)
async def test_a_client_that_names_events_gets_events(accept: bytes) -> None:
    start, *bodies = await _reply(accept)
    assert dict(start["headers"])[b"content-type"] == b"text/event-stream"
    assert len(bodies) == 2
