from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import jsonschema
import pytest
from mcp import Client
from mcp.server import MCPServer
from pydantic import BaseModel

from tests.server.conftest import POOL_BOX
from tests.server.conversation import by_path
from vehanchor.options.option import UNLISTED, UNLISTED_KEY, Option
from vehanchor_server.schemas import schema_files
from vehanchor_server.tools.portable_schema import listed, portable_schema, without_marks

PUBLISHED = Path(__file__).parents[2] / "schemas"
TOOLS = ("estimate_gsd", "measure_area", "measure_distance", "view_image")


def nodes(schema: Any) -> Iterator[dict[str, Any]]:
    """Every subschema."""
    if isinstance(schema, dict):
        yield schema
        for value in schema.values():
            yield from nodes(value)
    elif isinstance(schema, list):
        for value in schema:
            yield from nodes(value)


@pytest.fixture(scope="module")
def files() -> dict[str, Any]:
    return {name: json.loads(text) for name, text in schema_files(TOOLS).items()}


def test_the_published_files_are_current() -> None:
    expected = schema_files()
    published = {path.name: path.read_text(encoding="utf-8") for path in PUBLISHED.glob("*.json")}
    assert published == expected, "run: vehanchor serve --schemas schemas"


def test_the_schemas_are_valid_2020_12_that_every_host_reads(files: dict[str, Any]) -> None:
    for name in (name for name in files if name.count(".") == 2):
        schema = files[name]
        jsonschema.Draft202012Validator.check_schema(schema)
        assert schema["type"] == "object"
        for node in nodes(schema):
            assert not {
                "$ref",
                "$defs",
                "oneOf",
                "allOf",
                "discriminator",
                "prefixItems",
                "title",
            } & set(node)
            if node.get("type") == "object":
                # the arguments of another call
                assert node["additionalProperties"] is ("properties" not in node)


def test_the_openai_definition_is_strict_compatible(files: dict[str, Any]) -> None:
    for definition in files["openai.json"]:
        assert definition["strict"] is True
        assert set(definition) == {"type", "name", "description", "parameters", "strict"}
        schema = definition["parameters"]
        jsonschema.Draft202012Validator.check_schema(schema)
        assert "anyOf" not in schema
        for node in nodes(schema):
            assert not {"default", "minLength", "maxLength", "oneOf", "$ref"} & (
                set(node) - set(_properties(node))
            )
            if node.get("type") == "object":
                assert node["additionalProperties"] is False
                assert sorted(node["required"]) == sorted(node["properties"])


def _properties(node: dict[str, Any]) -> set[str]:
    return set(node.get("properties", {}))


@pytest.mark.anyio
@pytest.mark.parametrize(
    ("tool", "more"),
    [
        ("estimate_gsd", {}),
        ("measure_area", {"targets": [{"box": POOL_BOX, "points": None, "polygon": None}]}),
        (
            "measure_area",
            {
                "targets": [
                    {
                        "box": None,
                        "points": [{"x": 324, "y": 378, "label": None}],
                        "polygon": None,
                    }
                ]
            },
        ),
    ],
)
async def test_what_strict_mode_makes_a_model_send_is_accepted(
    server: MCPServer[object], images: Path, files: dict[str, Any], tool: str, more: dict[str, Any]
) -> None:
    definition = files["openai.json"][TOOLS.index(tool)]["parameters"]
    arguments_of_call = {"image": by_path(images / "pool.png")["image"], **more}
    arguments = {**dict.fromkeys(definition["required"]), **arguments_of_call}
    jsonschema.validate(arguments, definition)
    async with Client(server) as client:
        assert not (await client.call_tool(tool, arguments)).is_error


def test_the_anthropic_definition_has_what_the_api_takes(files: dict[str, Any]) -> None:
    for definition in files["anthropic.json"]:
        assert set(definition) == {"name", "description", "input_schema"}
        assert definition["input_schema"]["type"] == "object"


def test_a_property_may_be_named_like_a_keyword() -> None:
    schema = {
        "type": "object",
        "title": "Dropped",
        "properties": {
            "title": {"type": "string"},
            "oneOf": {"$ref": "#/$defs/Part", "description": "kept"},
        },
        "$defs": {"Part": {"const": 3, "title": "Part"}},
    }
    assert portable_schema(schema) == {
        "type": "object",
        "properties": {
            "title": {"type": "string"},
            "oneOf": {"const": 3, "description": "kept", "type": "integer"},
        },
    }


class _Marked(BaseModel):
    """Arguments, of which some are for programs."""

    path: str
    exact: Annotated[bool, UNLISTED] = False
    height_m: Annotated[float | None, Option("Height.", listed=False)] = None


@pytest.fixture
def marked() -> dict[str, Any]:
    return portable_schema(_Marked.model_json_schema())


def test_a_marked_field_is_not_listed_to_models(marked: dict[str, Any]) -> None:
    assert list(listed(marked)["properties"]) == ["path"]


def test_programs_see_a_marked_field_without_its_mark(marked: dict[str, Any]) -> None:
    schema = without_marks(marked)
    assert list(schema["properties"]) == ["path", "exact", "height_m"]
    assert UNLISTED_KEY in str(marked)
    assert UNLISTED_KEY not in str(schema)
