"""Calls our tools with Pydantic AI's toolset, as an agent does for a model: see ``test_clients``."""

from __future__ import annotations

import asyncio
import json
import sys
from importlib.metadata import version
from typing import Any

from fastmcp.client.transports import StdioTransport
from pydantic_ai import ModelRetry
from pydantic_ai.mcp import MCPToolset

PATIENCE_S = 120  # for a loaded machine; the default is 5


async def answers(toolset: Any, calls: list[tuple[str, dict[str, Any]]]) -> dict[str, Any]:
    async with toolset:
        tools = [tool.name for tool in await toolset.list_tools()]
        results = []
        for name, arguments in calls:
            try:
                result = await toolset.direct_call_tool(name, arguments)
                parts = isinstance(result, list)  # where there is a picture; else it is the record
                seen = {"text": result[0], "picture": result[1].media_type} if parts else {"record": result}
                results.append(seen)
            except ModelRetry as error:  # what the model is told
                results.append({"text": str(error)})
        return {"tools": tools, "results": results}


async def main(asked: dict[str, Any]) -> None:
    stdio = MCPToolset(StdioTransport(**asked["stdio"]), init_timeout=PATIENCE_S)
    http = MCPToolset(asked["url"], init_timeout=PATIENCE_S)
    print(
        json.dumps(
            {
                "versions": {name: version(name) for name in ("pydantic-ai-slim", "fastmcp-slim", "mcp")},
                "stdio": await answers(stdio, asked["calls"]),
                "http": await answers(http, asked["calls"]),
            }
        )
    )


asyncio.run(main(json.load(sys.stdin)))
