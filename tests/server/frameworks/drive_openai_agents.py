"""Calls our tools with the OpenAI Agents SDK, as its runner does for a model: see ``test_clients``."""

from __future__ import annotations

import asyncio
import json
import sys
from importlib.metadata import version
from typing import Any

from agents.mcp import MCPServerStdio, MCPServerStreamableHttp

PATIENCE_S = 120


async def answers(server: Any, calls: list[tuple[str, dict[str, Any]]]) -> dict[str, Any]:
    async with server:
        tools = [tool.name for tool in await server.list_tools()]
        results = []
        for name, arguments in calls:
            # By alias, since attributes are camelCase in mcp 1 and snake_case in mcp 2.
            result = (await server.call_tool(name, arguments)).model_dump(mode="json", by_alias=True)
            words, *pictures = result["content"]
            seen = {"text": words["text"], "record": result["structuredContent"]}
            results.append({**seen, "picture": pictures[0]["mimeType"]} if pictures else seen)
        return {"tools": tools, "results": results}


async def main(asked: dict[str, Any]) -> None:
    stdio = MCPServerStdio(params=asked["stdio"], client_session_timeout_seconds=PATIENCE_S)
    http = MCPServerStreamableHttp(
        params={"url": asked["url"], "timeout": PATIENCE_S}, client_session_timeout_seconds=PATIENCE_S
    )
    print(
        json.dumps(
            {
                "versions": {name: version(name) for name in ("openai-agents", "mcp")},
                "stdio": await answers(stdio, asked["calls"]),
                "http": await answers(http, asked["calls"]),
            }
        )
    )


asyncio.run(main(json.load(sys.stdin)))
