from __future__ import annotations

import base64
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from mcp import Client
from mcp.types import ImageContent

from tests.server.app_page.test_app_page import SHOWS_PAGES
from tests.server.conversation import by_path
from vehanchor_server.app import create_server
from vehanchor_server.calls.jpeg import MAX_PICTURE_BYTES
from vehanchor_server.services import create_services
from vehanchor_server.settings import Settings

pytestmark = pytest.mark.anyio


async def test_noise_is_squeezed_until_no_host_cuts_the_result(settings: Settings, tmp_path: Path) -> None:
    noise = np.random.default_rng(1).integers(0, 256, (1600, 1600, 3), dtype=np.uint8)
    assert cv2.imwrite(str(tmp_path / "noise.png"), noise)
    server = create_server(
        create_services(Settings(roots=(tmp_path,), detector=settings.detector, threads=1, isolation="in-process"))
    )
    async with Client(server, extensions=SHOWS_PAGES) as client:
        asked = by_path(tmp_path / "noise.png")
        result = await client.call_tool("estimate_gsd", asked)
        drawn = await client.call_tool("view_image", {"of": {"tool": "estimate_gsd", "arguments": asked}})
    picture = drawn.content[1]
    assert isinstance(picture, ImageContent)
    assert len(base64.b64decode(picture.data)) <= MAX_PICTURE_BYTES
    assert len(json.dumps(result.meta)) < 200_000
    assert len(drawn.model_dump_json()) < 750_000  # where hosts cut
