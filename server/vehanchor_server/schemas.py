"""Schema files of the tools: JSON Schemas, and definitions for Anthropic and OpenAI.

* ``<tool>.input.json``, ``<tool>.output.json``: JSON Schema 2020-12 of arguments and structured
  result, of the tools that programs in other languages call
* ``anthropic.json``: a list for ``tools`` of the Messages API
* ``openai.json``: a list for ``tools`` of the Responses API, strict; for Chat Completions, put all
  but ``type`` below ``function``
"""

from __future__ import annotations

import json
from collections.abc import Collection
from typing import Any

from vehanchor_server.services import create_services
from vehanchor_server.settings import Settings
from vehanchor_server.tools.portable_schema import portable_schema
from vehanchor_server.tools.registry import create_tools
from vehanchor_server.tools.strict_tool import StrictTool

PUBLISHED = ("estimate_gsd", "measure_area", "measure_distance", "view_image")
_DIALECT = {"$schema": "https://json-schema.org/draft/2020-12/schema"}
_NOT_IN_STRICT_MODE = (
    "default",
    "examples",
    "pattern",
    "minLength",
    "maxLength",
    "minProperties",
    "maxProperties",
)


def schema_files(tools: Collection[str] = PUBLISHED) -> dict[str, str]:
    """Return the name and text of every file, with the JSON Schemas of these tools."""
    all_tools = create_tools(create_services(Settings()))
    documents: dict[str, Any] = {}
    for tool in all_tools:
        if tool.name not in tools:
            continue
        documents[f"{tool.name}.input.json"] = {**_DIALECT, **tool.full_parameters}
        if tool.record is not None:
            schema = portable_schema(tool.record.model_json_schema())
            documents[f"{tool.name}.output.json"] = {**_DIALECT, **schema}
    documents["anthropic.json"] = [anthropic_definition(tool) for tool in all_tools]
    documents["openai.json"] = [openai_definition(tool) for tool in all_tools]
    return {
        name: json.dumps(document, indent=2, ensure_ascii=False) + "\n"
        for name, document in documents.items()
    }


def anthropic_definition(tool: StrictTool) -> dict[str, Any]:
    """Return the tool's definition for Anthropic's Messages API."""
    return {"name": tool.name, "description": tool.description, "input_schema": tool.parameters}


def openai_definition(tool: StrictTool) -> dict[str, Any]:
    """Return the tool's definition for OpenAI's Responses API in strict mode.

    It has all listed arguments; the optional ones are nullable.
    """
    return {
        "type": "function",
        "name": tool.name,
        "description": tool.description,
        "parameters": _strict(tool.parameters),
        "strict": True,
    }


def _strict(node: Any) -> Any:
    """Close every object and require all its fields; null stands for a field that is left out."""
    if isinstance(node, list):
        return [_strict(item) for item in node]
    if not isinstance(node, dict):
        return node
    # An object with any fields: strict mode has no such type.
    if node.get("type") == "object" and "properties" not in node:
        return {"type": "string", "description": "A JSON object."}
    result = {key: _strict(value) for key, value in node.items() if key not in _NOT_IN_STRICT_MODE}
    if "properties" in node:
        properties = {}
        for name, field in node["properties"].items():
            strict_field = _strict(field)
            if name not in node.get("required", ()):
                strict_field = {"anyOf": [strict_field, {"type": "null"}]}
            properties[name] = strict_field
        result["properties"] = properties
        result["required"] = list(properties)
        result["additionalProperties"] = False
    return result
