from __future__ import annotations

import pytest
from mcp import Client
from mcp.server import MCPServer

pytestmark = pytest.mark.anyio


async def test_the_contract_names_every_hint(server: MCPServer[object], era: str) -> None:
    async with Client(server, mode=era) as client:
        listed = (await client.list_tools()).tools
        instructions = client.instructions
    assert [tool.name for tool in listed] == ["estimate_gsd", "measure_area"]
    for tool in listed:
        assert tool.title
        assert tool.description
        assert len(tool.description.encode()) < 2048
        assert "confidence" in tool.description
        assert "0.5" in tool.description
        assert tool.annotations is not None
        assert tool.annotations.read_only_hint
        assert tool.annotations.idempotent_hint
        assert tool.annotations.destructive_hint is False
        assert tool.annotations.open_world_hint is False
    assert instructions is not None
    assert "Below 0.5" in instructions
    assert "Confidence 0 means" in instructions
