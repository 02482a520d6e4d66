"""Calls our tools with FastMCP's client: see ``test_clients``."""

from __future__ import annotations

import asyncio
import json
import sys
from importlib.metadata import version
from typing import Any

from fastmcp import Client
from fastmcp.client.transports import StdioTransport
from fastmcp.exceptions import ToolError


async def answers(client: Any, calls: list[tuple[str, dict[str, Any]]]) -> dict[str, Any]:
    async with client:
        tools = [tool.name for tool in await client.list_tools()]
        results = []
        for name, arguments in calls:
            try:
                result = await client.call_tool(name, arguments)
                words, *pictures = result.content
                seen = {"text": words.text, "record": result.structured_content}
                results.append({**seen, "picture": pictures[0].mime_type} if pictures else seen)
            except ToolError as error:
                results.append({"text": str(error)})
        return {"tools": tools, "results": results}


async def main(asked: dict[str, Any]) -> None:
    print(
        json.dumps(
            {
                "versions": {name: version(name) for name in ("fastmcp", "mcp")},
                "stdio": await answers(Client(StdioTransport(**asked["stdio"])), asked["calls"]),
                "http": await answers(Client(asked["url"]), asked["calls"]),
            }
        )
    )


asyncio.run(main(json.load(sys.stdin)))
