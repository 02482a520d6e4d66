"""The listed schemas are sufficient: a call of the listed shape is never refused for its shape."""

from __future__ import annotations

import json
import random
import re
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from mcp import Client
from mcp.server import MCPServer
from pydantic import ValidationError

from tests.conftest import ROOT
from tests.server.conversation import check_shape, text_of
from tests.server.test_app import LISTED, tokens_listed
from vehanchor_server.app import create_server
from vehanchor_server.services import create_services
from vehanchor_server.settings import Settings
from vehanchor_server.tools.registry import create_tools
from vehanchor_server.tools.strict_tool import StrictTool, _with_integers

OPERATORS: list[dict[str, Any]] = [
    {"roots": (ROOT,)},
    {"roots": (ROOT,), "image_hosts": ("images.example",)},
    {"image_hosts": ("images.example",)},
    {},
]
_VALUES = {  # errors about a value, or which optional fields belong together
    "greater_than",
    "greater_than_equal",
    "less_than",
    "less_than_equal",
    "string_pattern_mismatch",
    "value_error",
    "must_fit_form",  # a diameter beside a length: hosts do not all know a choice of objects
}


def tools(**operator: Any) -> list[StrictTool]:
    return create_tools(create_services(Settings(**operator)))


def shape_faults(tool: StrictTool, arguments: dict[str, Any]) -> list[dict[str, Any]]:
    """Faults of the shape; of a union, no fault of the variants that were not meant."""
    try:
        tool.fn_metadata.arg_model.model_validate(_with_integers(arguments))
        return []
    except ValidationError as error:
        faults: list[dict[str, Any]] = [
            dict(each) for each in error.errors(include_url=False, include_input=False)
        ]
    values = {fault["loc"][:-1] for fault in faults if fault["type"] in _VALUES}
    return [
        fault
        for fault in faults
        if fault["type"] not in _VALUES and fault["loc"][:-1] not in values
    ]


@pytest.mark.parametrize("operator", OPERATORS, ids=["path", "path and url", "url", "all"])
def test_a_random_call_from_the_listed_schema_alone_has_a_valid_shape(
    operator: dict[str, Any],
) -> None:
    chance = random.Random(20261123)
    for tool in tools(**operator):
        check = jsonschema.validators.validator_for(tool.parameters)(tool.parameters).validate
        for _ in range(100):
            arguments = random_value(tool.parameters, chance)
            check(arguments)
            assert not shape_faults(tool, arguments), (tool.name, arguments)


def test_every_call_of_the_documentation_has_the_listed_shape() -> None:
    by_name = {tool.name: tool for tool in tools(roots=(ROOT,))}
    calls = documented_calls()
    assert len(calls) >= 7
    assert {name for name, _ in calls} == set(by_name)
    for name, arguments in calls:
        given = {key: value for key, value in arguments.items() if value is not None}
        check_shape(given, by_name[name].parameters)
        assert not shape_faults(by_name[name], arguments), (name, arguments)


@pytest.mark.parametrize("operator", OPERATORS[:3], ids=["path", "path and url", "url"])
@pytest.mark.anyio
async def test_the_list_is_short_for_every_operator(operator: dict[str, Any]) -> None:
    async with Client(create_server(create_services(Settings(**operator)))) as client:
        listed = (await client.list_tools()).tools
    assert tokens_listed(listed) <= LISTED, tokens_listed(listed)


@pytest.mark.anyio
async def test_an_example_call_of_an_error_works(server: MCPServer[object], images: Path) -> None:
    async with Client(server) as client:
        for tool in (await client.list_tools()).tools:
            text = text_of(await client.call_tool(tool.name, {"imag": 1}))
            example = json.loads(text.partition("Example: ")[2])
            check_shape(example, tool.input_schema)
            result = await client.call_tool(tool.name, example)
            assert not result.is_error, text_of(result)


@pytest.mark.anyio
@pytest.mark.parametrize("image", [{"kind": "path", "path": "mine.png"}, "mine.png"])
async def test_an_example_names_the_image_of_the_call(
    image: Any, server: MCPServer[object]
) -> None:
    async with Client(server) as client:
        result = await client.call_tool("measure_distance", {"image": image, "lines": []})
    example = json.loads(text_of(result).partition("Example: ")[2])
    assert example["image"] == {"kind": "path", "path": "mine.png"}


_TEXTS = ["car_park.jpg", "FR", "iso_container_20ft", "0.13 0.12 0.15 0.8 aa bb"]


def random_value(node: dict[str, Any], chance: random.Random) -> Any:
    """A value that the schema allows; nothing beside the schema is known."""
    if "anyOf" in node:
        return random_value(chance.choice(node["anyOf"]), chance)
    if "enum" in node:
        return chance.choice(node["enum"])
    kind = node["type"]
    if kind == "object" and "properties" not in node:
        return {}
    if kind == "object":
        names = list(node["properties"])
        optional = [name for name in names if name not in node.get("required", ())]
        n_most = min(
            node.get("maxProperties", len(names)) - len(names) + len(optional), len(optional)
        )
        chosen = chance.sample(
            optional, chance.randint(min(node.get("minProperties", 0), n_most), n_most)
        )
        return {
            name: random_value(node["properties"][name], chance)
            for name in names
            if name in chosen or name not in optional
        }
    if kind == "array":
        n_least = node.get("minItems", 0)
        n_items = chance.randint(n_least, min(node.get("maxItems", n_least + 3), n_least + 3))
        return [random_value(node["items"], chance) for _ in range(n_items)]
    if kind == "number":
        return chance.choice([chance.randint(1, 900), round(chance.uniform(0.1, 900), 2)])
    if kind == "integer":
        # JSON Schema takes 512.0 for an integer
        return chance.choice([chance.randint(256, 1024), 512.0])
    return {"string": chance.choice(_TEXTS), "boolean": chance.random() < 0.5}[kind]


def documented_calls() -> list[tuple[str, dict[str, Any]]]:
    """The tools and arguments of all calls in the documentation and the examples' transcripts."""
    found: list[tuple[str, dict[str, Any]]] = []
    for path in [
        *ROOT.glob("docs/**/*.md"),
        ROOT / "README.md",
        ROOT / "server/vehanchor_server/SKILL.md",
    ]:
        for block in re.findall(
            r"```json\n(.*?)\n```", path.read_text(encoding="utf-8"), re.DOTALL
        ):
            call = json.loads(block)
            if isinstance(call, dict) and "tool" in call:
                found.append((call["tool"], call["arguments"]))
    for path in ROOT.glob("docs/transcripts/*.txt"):
        for tool, arguments in re.findall(
            r"^calls (\w+) (\{.*\})$", path.read_text(encoding="utf-8"), re.MULTILINE
        ):
            found.append((tool, json.loads(arguments)))
    return found
