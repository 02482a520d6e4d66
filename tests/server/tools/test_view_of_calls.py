"""What ``view_image`` draws of a call of a measuring tool."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcp import Client
from mcp.server import MCPServer
from mcp.types import CallToolResult, ImageContent

from tests.server.conftest import POOL, POOL_BOX
from tests.server.conversation import by_path, error_of, picture_of, text_of
from vehanchor.pictures.measurement import PROMPT_RGB
from vehanchor.pictures.scale import KEPT_RGB
from vehanchor_server.app import create_server
from vehanchor_server.services import create_services
from vehanchor_server.settings import Settings

pytestmark = pytest.mark.anyio

TARGETS = {"targets": [{"box": POOL_BOX}]}
LINE = {"points": [{"x": 200, "y": 300}, {"x": 300, "y": 300}]}
STATED = {"gsd_m_per_px": 0.1, "gsd_basis": "measured"}
CALLS: dict[str, dict[str, Any]] = {
    "estimate_gsd": {},
    "measure_area": TARGETS,
    "measure_distance": {"lines": [LINE]},
}


async def drawn(
    server: MCPServer[object],
    image: Path,
    tool: str,
    arguments: dict[str, Any] | None = None,
    **more: Any,
) -> CallToolResult:
    arguments_of_call = {
        "image": by_path(image)["image"],
        **(CALLS[tool] if arguments is None else arguments),
    }
    async with Client(server) as client:
        return await client.call_tool(
            "view_image", {"of": {"tool": tool, "arguments": arguments_of_call}, **more}
        )


def near(picture: np.ndarray, rgb: tuple[int, int, int], within: int) -> np.ndarray:
    """Where a decoded picture has a colour."""
    is_colour: np.ndarray = np.abs(picture[:, :, ::-1].astype(int) - rgb).max(2) < within
    return is_colour


@pytest.mark.parametrize("tool", CALLS)
async def test_the_words_of_the_call_stand_before_a_picture_with_its_vehicles(
    server: MCPServer[object], images: Path, tool: str
) -> None:
    result = await drawn(server, images / "pool.png", tool)
    async with Client(server) as client:
        plain = await client.call_tool(
            tool, {"image": by_path(images / "pool.png")["image"], **CALLS[tool]}
        )
    assert text_of(result) == text_of(plain)
    assert not any(isinstance(part, ImageContent) for part in plain.content)
    assert result.structured_content is None
    picture = picture_of(result)
    assert max(picture.shape) <= 1024
    below = near(picture[-250:], KEPT_RGB, 60)
    assert below.sum() > 500, "the vehicles are enlarged below"


async def test_a_call_that_is_computed_again_gives_the_same_picture(
    settings: Settings, images: Path
) -> None:
    contents = []
    tool = "measure_area"
    for is_remembered in (True, False):
        server = create_server(create_services(settings))
        if is_remembered:
            async with Client(server) as client:
                await client.call_tool(tool, {**by_path(images / "pool.png"), **CALLS[tool]})
        contents.append((await drawn(server, images / "pool.png", tool)).content)
    assert contents[0] == contents[1]


async def test_an_area_is_cut_to_the_object(server: MCPServer[object], images: Path) -> None:
    arguments = {**TARGETS, **STATED}
    result = await drawn(server, images / "pool_alone.png", "measure_area", arguments)
    # A box of 60 x 108 px with a margin of 54 px: 168 x 216 px, four times enlarged.
    pool = near(picture_of(result), (97, 134, 195), 12)
    assert pool.sum() > 0.1 * 4 * 168 * 4 * 216, "the pool is small in its picture"
    rows, columns = np.nonzero(pool)
    shape = (POOL[3] - POOL[1]) / (POOL[2] - POOL[0])
    assert np.ptp(rows) / np.ptp(columns) == pytest.approx(shape, rel=0.03)


async def test_a_distance_is_cut_to_the_line(server: MCPServer[object], images: Path) -> None:
    result = await drawn(server, images / "empty.png", "measure_distance")
    # 200 x 100 px of the image, four times enlarged, with the line of 100 px in the middle.
    rows = picture_of(result)[190:210].astype(int)
    blue, green, red = rows.transpose(2, 0, 1)
    is_line = (red - green > 25) & (blue - green > 10)
    columns = np.nonzero(is_line.any(axis=0))[0]
    assert (columns[0], columns[-1]) == pytest.approx((200, 600), abs=12)


async def test_the_picture_of_all_targets_has_the_requested_side(
    server: MCPServer[object], images: Path
) -> None:
    other = {"x_min": 600, "y_min": 700, "x_max": 660, "y_max": 760}
    arguments_of_call = {"targets": [{"box": POOL_BOX}, {"box": other}], **STATED}
    for side_px in (300, 1568):
        result = await drawn(
            server,
            images / "pool_large.png",
            "measure_area",
            arguments_of_call,
            long_side_px=side_px,
        )
        decoded = picture_of(result)
        assert side_px / 2 < max(decoded.shape[:2]) <= side_px
    yellow = near(decoded, PROMPT_RGB, 60)
    assert np.ptp(np.nonzero(yellow)[1]) > 0.4 * decoded.shape[1], "a prompt is missing"


async def test_a_part_shows_the_numbered_vehicles_of_that_part(
    server: MCPServer[object], images: Path
) -> None:
    part = {"x_min": 20, "y_min": 20, "x_max": 160, "y_max": 120}
    result = await drawn(server, images / "pool.png", "estimate_gsd", part=part, long_side_px=560)
    decoded = picture_of(result)
    height, width = decoded.shape[:2]
    assert max(height, width) == 560
    # The part is as high as 5 of 7 of its width; the caption and the strip are below.
    _, columns = np.nonzero(near(decoded[: width * 5 // 7], KEPT_RGB, 60))
    assert columns.min() < width / 2 < columns.max(), "two vehicles of this part, at x 60 and 130"


async def test_a_part_has_the_crops_of_its_vehicles(
    server: MCPServer[object], images: Path
) -> None:
    part = {"x_min": 20, "y_min": 20, "x_max": 160, "y_max": 120}
    result = await drawn(server, images / "pool.png", "estimate_gsd", part=part, long_side_px=1568)
    decoded = picture_of(result)
    strip = decoded[-128:]
    assert near(strip[:, :256], KEPT_RGB, 60).any()
    assert not near(strip[:, 256:], KEPT_RGB, 60).any(), "there are two vehicles in this part"


async def test_arguments_may_come_as_text_beside_the_image(
    server: MCPServer[object], images: Path
) -> None:
    expected = await drawn(server, images / "pool.png", "measure_area")
    call = {"tool": "measure_area", "arguments": json.dumps(TARGETS)}
    image = by_path(images / "pool.png")["image"]
    async with Client(server) as client:
        result = await client.call_tool("view_image", {"of": call, "image": image})
    assert result.content == expected.content


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        ({"target": []}, "invalid_arguments", "of.arguments: "),
        ({"targets": [{"box": {**POOL_BOX, "x_max": 9999}}]}, "invalid_prompt", "is not inside"),
        (
            {**TARGETS, "image": {"kind": "path", "path": "/elsewhere.png"}},
            "path_not_allowed",
            "allowed directory",
        ),
    ],
)
async def test_a_call_that_fails_is_told_as_such(
    server: MCPServer[object], images: Path, arguments: dict[str, Any], code: str, words: str
) -> None:
    result = await drawn(server, images / "pool.png", "measure_area", arguments)
    assert error_of(result) == code
    assert words in text_of(result)
