"""Print the tools' schemas as the hosts' SDKs send them to models: see ``test_listed_schema``."""

from __future__ import annotations

import asyncio
import json
import sys
from typing import Any

from agents.mcp import MCPUtil
from anthropic.lib.tools.mcp import async_mcp_tool
from google.adk.tools._gemini_schema_util import _to_gemini_schema
from mcp.types import Tool
from pydantic_ai.profiles.google import GoogleJsonSchemaTransformer
from pydantic_ai.profiles.openai import OpenAIJsonSchemaTransformer


class _Server:
    name = "vehanchor"
    tool_input_guardrails = tool_output_guardrails = ()

    def __getattr__(self, name: str) -> Any:
        return lambda *_, **__: None


def converted(tool: Tool) -> dict[str, Any]:
    nobody: Any = _Server()
    schema = tool.input_schema
    gemini = _to_gemini_schema(json.loads(json.dumps(schema)))
    return {
        "anthropic": async_mcp_tool(tool, nobody).to_dict()["input_schema"],
        "google-adk": gemini.model_dump(mode="json", exclude_none=True) if gemini else None,
        "openai-agents": MCPUtil.to_function_tool(tool, nobody, False).params_json_schema,
        "pydantic-ai, google": GoogleJsonSchemaTransformer(json.loads(json.dumps(schema)), strict=None).walk(),
        "pydantic-ai, openai": OpenAIJsonSchemaTransformer(json.loads(json.dumps(schema)), strict=None).walk(),
    }


async def main(tools: list[dict[str, Any]]) -> None:
    print(json.dumps({tool["name"]: converted(Tool.model_validate(tool)) for tool in tools}))


asyncio.run(main(json.load(sys.stdin)))
