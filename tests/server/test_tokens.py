"""What the server costs a model's context, at four characters a token."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcp import Client
from mcp.server import MCPServer
from mcp.types import CallToolResult, TextContent, Tool

from tests.server.conftest import POOL_BOX
from tests.server.conversation import by_path, text_of

pytestmark = pytest.mark.anyio

CHARACTERS_A_TOKEN = 4
LISTED = 2450
ESTIMATE, AREA, DISTANCE = (80, 160), (130, 220), (130, 220)  # of text and structured content
FRAME = {"width_px": 320, "height_px": 256}
SMALL_BOX = {name: value / 2 for name, value in POOL_BOX.items()}
LINES = [{"points": [{"x": 10, "y": 20}, {"x": 300, "y": 120}]}]
STATED = {"gsd_m_per_px": 0.15, "gsd_basis": "measured"}
CALLS: list[tuple[str, str, dict[str, Any], tuple[int, int]]] = [
    ("estimate_gsd", "cars.png", {}, ESTIMATE),
    ("estimate_gsd", "cars.png", {"frame": FRAME}, ESTIMATE),
    ("estimate_gsd", "cars.png", {"region": "europe"}, ESTIMATE),
    (
        "estimate_gsd",
        "cars.png",
        {"known_lengths": [{"x1": 0, "y1": 0, "x2": 90, "y2": 0, "metres": 14}]},
        ESTIMATE,
    ),
    ("estimate_gsd", "two.png", {}, ESTIMATE),
    ("estimate_gsd", "small.png", {}, ESTIMATE),
    ("estimate_gsd", "empty.png", {}, ESTIMATE),
    ("estimate_gsd", "large.png", {}, ESTIMATE),
    ("measure_area", "pool.png", {"targets": [{"box": POOL_BOX}]}, AREA),
    ("measure_area", "pool.png", {"targets": [{"box": POOL_BOX}]}, AREA),
    ("measure_area", "pool.png", {"targets": [{"box": SMALL_BOX}], "frame": FRAME}, AREA),
    ("measure_area", "pool.png", {"targets": [{"points": [{"x": 324, "y": 378}]}]}, AREA),
    ("measure_area", "pool.png", {"targets": [{"box": POOL_BOX}], **STATED}, AREA),
    ("measure_area", "pool_two.png", {"targets": [{"box": POOL_BOX}]}, AREA),
    ("measure_area", "pool_alone.png", {"targets": [{"box": POOL_BOX}]}, AREA),
    ("measure_area", "pool_large.png", {"targets": [{"box": POOL_BOX}]}, AREA),
    ("measure_distance", "cars.png", {"lines": LINES}, DISTANCE),
    ("measure_distance", "two.png", {"lines": LINES}, DISTANCE),
    ("measure_distance", "empty.png", {"lines": LINES}, DISTANCE),
    ("measure_distance", "cars.png", {"lines": LINES, "gsd_m_per_px": 0.1}, DISTANCE),
]


def tokens_of(value: Any) -> float:
    text = value if isinstance(value, str) else json.dumps(value, separators=(",", ":"))
    return len(text) / CHARACTERS_A_TOKEN


def tokens_listed(tools: list[Tool]) -> float:
    """What a model reads of the tools: names, descriptions and arguments."""
    return sum(tokens_of(part) for tool in tools for part in (tool.name, tool.description, tool.input_schema))


def words_of(result: CallToolResult) -> str:
    """All text, as hosts join it that show a model nothing else."""
    return " ".join(part.text for part in result.content if isinstance(part, TextContent))


async def test_the_list_of_tools_is_short(server: MCPServer[object]) -> None:
    async with Client(server) as client:
        listed = await client.list_tools()
    assert tokens_listed(listed.tools) <= LISTED, tokens_listed(listed.tools)


@pytest.mark.parametrize(("tool", "image", "more", "limits"), CALLS)
async def test_answers_are_short(
    server: MCPServer[object], images: Path, tool: str, image: str, more: dict[str, Any], limits: tuple[int, int]
) -> None:
    async with Client(server) as client:
        arguments = {"image": by_path(images / image)["image"], **more}
        result = await client.call_tool(tool, arguments)
        full = await client.call_tool(tool, {**arguments, "detail": "full"})
    assert not result.is_error, text_of(result)
    assert tokens_of(words_of(result)) <= limits[0], words_of(result)
    assert tokens_of(result.structured_content) <= limits[1], result.structured_content
    assert result.structured_content is not None
    assert full.structured_content is not None
    short = {name.removeprefix("scale_") for name in result.structured_content}
    assert short <= {*full.structured_content, "reason", "advice"}


async def test_a_short_answer_never_rounds_a_confidence_over_the_limit() -> None:
    from tests.analyses import make_analysis
    from vehanchor_server.calls.compact import short_record

    boxes = np.array([[500.0, 500, length, 10, 0] for length in (30, 31, 32)])
    estimate = make_analysis(boxes, 1000, 1000).estimate
    short = short_record([estimate.model_copy(update={"confidence": 0.89996, "gsd_m_per_px": 0.123456})])
    assert (short["confidence"], short["gsd_m_per_px"]) == (0.899, 0.123)
    assert "model_sha256" not in short
