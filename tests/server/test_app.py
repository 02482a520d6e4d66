"""What the server says of itself."""

from __future__ import annotations

import base64
import struct

import pytest
from mcp import Client
from mcp.server import MCPServer

pytestmark = pytest.mark.anyio


async def test_it_greets_with_its_name_and_an_icon_that_needs_no_network(server: MCPServer[object]) -> None:
    async with Client(server) as client:
        itself = client.server_info
    assert itself is not None
    assert (itself.name, itself.title) == ("vehanchor", "VehAnchor")
    assert itself.icons is not None
    (icon,) = itself.icons
    kind, _, encoded = icon.src.partition(",")
    picture = base64.b64decode(encoded, validate=True)
    assert (kind, icon.mime_type) == ("data:image/png;base64", "image/png")
    assert picture.startswith(b"\x89PNG")
    width, height = struct.unpack(">II", picture[16:24])
    assert icon.sizes == [f"{width}x{height}"]
    assert len(icon.src) < 2000, "it is sent with every greeting"
