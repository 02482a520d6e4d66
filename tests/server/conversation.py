"""Helpers for calls: arguments, and parts of answers."""

from __future__ import annotations

import base64
import contextlib
import json
import socket
import threading
import time
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import anyio
import cv2
import numpy as np
import uvicorn
from jsonschema.validators import validator_for
from mcp import Client
from mcp.server import MCPServer
from mcp.types import CallToolResult, ImageContent, TextContent
from starlette.types import ASGIApp

from vehanchor_server.calls.jpeg import MAX_PICTURE_BYTES
from vehanchor_server.schemas import schema_files

ERAS = ("auto", "legacy")  # auto finds the stateless 2026-07-28 protocol


def by_path(path: Path | str) -> dict[str, Any]:
    """Arguments of a program, which reads whole records."""
    return {"image": {"kind": "path", "path": str(path)}, "detail": "full"}


async def called(
    server: MCPServer[object],
    tool: str,
    image: Path | None = None,
    /,
    *,
    era: str = "auto",
    **more: Any,
) -> CallToolResult:
    """The result of one call of a program, by a client of its own."""
    named = {} if image is None else by_path(image)
    async with Client(server, mode=era) as client:
        return await client.call_tool(tool, {**named, **more})


@cache
def input_schema(tool: str) -> dict[str, Any]:
    """The published schema of a tool's arguments."""
    schema: dict[str, Any] = json.loads(schema_files((tool,))[f"{tool}.input.json"])
    return schema


def check_shape(value: Any, schema: dict[str, Any]) -> None:
    """Validate by a schema; ``test_schemas`` checks the schema itself, at ten times the cost."""
    validator_for(schema)(schema).validate(value)


def record_of(result: CallToolResult) -> dict[str, Any]:
    assert not result.is_error, text_of(result)
    assert isinstance(result.structured_content, dict)
    return result.structured_content


def text_of(result: CallToolResult) -> str:
    first = result.content[0]
    assert isinstance(first, TextContent)
    return first.text


def picture_of(result: CallToolResult) -> np.ndarray:
    """The overlay, decoded, after the checks of every overlay."""
    picture = result.content[1]
    assert isinstance(picture, ImageContent)
    assert picture.mime_type == "image/jpeg"
    data = base64.b64decode(picture.data)
    assert len(data) <= MAX_PICTURE_BYTES
    decoded = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert decoded is not None
    return np.asarray(decoded)


def error_of(result: CallToolResult) -> str:
    assert result.is_error
    return text_of(result).partition(":")[0]


async def reported(reports: Sequence[float]) -> None:
    """Wait for the last report of a call's progress, which may come after its result."""
    with anyio.move_on_after(60):
        while not reports or reports[-1] < 100:
            await anyio.sleep(0.01)


@contextlib.contextmanager
def listening() -> Iterator[socket.socket]:
    """A socket on a free port of 127.0.0.1."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        yield free


@contextlib.contextmanager
def serving(app: ASGIApp, listener: socket.socket) -> Iterator[None]:
    """Serve an application until the block ends."""
    server = uvicorn.Server(
        uvicorn.Config(app, log_config=None, access_log=False, timeout_graceful_shutdown=2)
    )
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, daemon=True)
    thread.start()
    while not server.started and thread.is_alive():
        time.sleep(0.01)
    try:
        yield
    finally:
        server.should_exit = True
        thread.join()
