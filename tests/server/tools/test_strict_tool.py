from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import pytest
from mcp import Client
from mcp.server import MCPServer

from tests.server.conversation import by_path, error_of, text_of

pytestmark = pytest.mark.anyio


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({}, "image: it is required"),
        ({"image": {"path": "/a"}}, "kind is missing"),
        ({"image": {"kind": "ftp", "path": "/a"}}, "'path', 'base64', 'url'"),
        ({"image": "/a.jpg"}, "give an object"),
        ({"image": {"kind": "path", "path": "/a", "url": "x"}}, "image.path.url: there is no such argument"),
        ({"image": {"kind": "path", "path": ""}}, "image.path: String should have at least 1 character"),
        ({"image": {"kind": "path", "path": "/a"}, "detector": "/etc/passwd"}, "detector: there is no such argument"),
        ({"image": {"kind": "path", "path": "/a"}, "reference_length_m": -1}, "greater than 0"),
        ({"image": {"kind": "path", "path": "/a"}, "reference_length_m": "inf"}, "reference_length_m"),
        ({"image": {"kind": "path", "path": "/a"}, "reference_length_m": "nan"}, "reference_length_m"),
        ({"image": {"kind": "path", "path": "/a"}, "frame": {"width_px": 3}}, "frame.height_px: it is required"),
        ({"image": {"kind": "path", "path": "/a"}, "frame": {"width_px": 0, "height_px": 3}}, "frame.width_px"),
    ],
)
async def test_wrong_arguments_are_told_in_one_line(
    server: MCPServer[object], arguments: dict[str, Any], words: str, era: str
) -> None:
    async with Client(server, mode=era) as client:
        result = await client.call_tool("estimate_gsd", arguments)
    assert error_of(result) == "invalid_arguments"
    assert words in text_of(result)
    assert "\n" not in text_of(result)


async def test_a_wrong_argument_is_not_repeated_to_the_caller(server: MCPServer[object]) -> None:
    async with Client(server) as client:
        result = await client.call_tool("estimate_gsd", {"image": {"kind": "base64", "data": 7, "secret": "hunter2"}})
    assert "hunter2" not in text_of(result)


async def test_a_bug_is_told_without_its_details_and_logged_with_them(
    server: MCPServer[object], images: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def broken(*_: object, **__: object) -> None:
        raise RuntimeError("password is hunter2")

    monkeypatch.setattr("vehanchor.estimate.analyse_raster", broken)
    async with Client(server) as client:
        result = await client.call_tool("estimate_gsd", by_path(images / "cars.png"))
    assert error_of(result) == "internal_error"
    assert "hunter2" not in text_of(result)
    assert "hunter2" in caplog.text


@pytest.mark.parametrize("deep", [False, True])
async def test_more_values_than_any_call_has_are_told_without_looking_at_each(
    server: MCPServer[object], deep: bool
) -> None:
    many = {f"a{i}": 0 for i in range(100_000)}
    started = time.monotonic()
    async with Client(server) as client:
        result = await client.call_tool("estimate_gsd", {"image": many} if deep else many)
    assert text_of(result).startswith("invalid_arguments: more than 1000 values.")
    assert time.monotonic() - started < 2


async def test_long_names_are_shortened_before_they_are_told(server: MCPServer[object]) -> None:
    long = "n" * 100_000
    async with Client(server) as client:
        for arguments in ({long: 1}, {"image": {"kind": long}}, {"image": {"kind": "path", "path": "/a", long: 1}}):
            result = await client.call_tool("estimate_gsd", arguments)
            assert error_of(result) == "invalid_arguments"
            assert len(text_of(result)) < 700
        result = await client.call_tool(long, {})
    assert error_of(result) == "unknown_tool"
    assert len(text_of(result)) < 300
