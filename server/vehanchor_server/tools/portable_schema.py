"""JSON Schemas in the subset that all hosts support.

pydantic writes references, ``oneOf`` with ``discriminator``, and titles that repeat names. Some hosts and
validators reject the first two; the titles waste the model's context.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

_DIALECT = "https://json-schema.org/draft/2020-12/schema"
_REFERENCE = "#/$defs/"


def portable_schema(schema: dict[str, Any], *, dialect: bool = False) -> dict[str, Any]:
    """Replace references and ``oneOf``, and drop ``discriminator`` and generated titles.

    Args:
        schema: pydantic's schema; not recursive.
        dialect: whether to name the dialect, for a schema in its own file.
    """
    plain = _plain(schema, schema.get("$defs", {}))
    assert isinstance(plain, dict)
    return {"$schema": _DIALECT, **plain} if dialect else plain


def _plain(node: Any, definitions: dict[str, Any]) -> Any:
    if isinstance(node, list):
        return [_plain(item, definitions) for item in node]
    if not isinstance(node, dict):
        return node
    reference = node.get("$ref")
    if isinstance(reference, str) and reference.startswith(_REFERENCE):
        beside = {key: value for key, value in node.items() if key != "$ref"}
        node = {**definitions[reference.removeprefix(_REFERENCE)], **beside}
    result: dict[str, Any] = {}
    for key, value in node.items():
        if key in ("$defs", "discriminator") or (key == "title" and isinstance(value, str)):
            continue
        if key == "properties":  # a property may be named like a keyword
            result[key] = {name: _plain(property_, definitions) for name, property_ in value.items()}
        elif key in ("const", "enum", "default", "examples"):
            result[key] = value
        else:
            result["anyOf" if key == "oneOf" else key] = _plain(value, definitions)
    if "const" in result and "type" not in result:
        result["type"] = {str: "string", bool: "boolean", int: "integer"}[type(result["const"])]
    return result


def listed_schema(schema: dict[str, Any], unlisted: Collection[str] = ()) -> dict[str, Any]:
    """Reduce a portable schema to what a model needs: names, types and descriptions.

    Optional arguments lose their null type. A union discriminated by ``kind`` becomes one object with all fields. The
    server still checks the limits that are dropped here.

    Args:
        schema: result of ``portable_schema``.
        unlisted: arguments to hide from models.
    """
    listed = _listed(schema)
    assert isinstance(listed, dict)
    listed["properties"] = {name: each for name, each in listed["properties"].items() if name not in unlisted}
    return listed


_NOT_LISTED = {"additionalProperties", "default", "exclusiveMinimum", "minimum", "maximum"}
_NOT_LISTED |= {"minItems", "maxItems", "minLength", "maxLength", "minProperties", "maxProperties"}
_MANY = 3  # an object with more fields keeps only its own description


def _listed(node: dict[str, Any], *, said: bool = True) -> dict[str, Any]:
    options = [option for option in node.get("anyOf", ()) if option != {"type": "null"}]
    if len(options) == 1 and "anyOf" in options[0]:
        return _listed({**node, **options[0]}, said=said)
    if len(options) > 1 and all("kind" in option.get("properties", {}) for option in options):
        options = [_of_all_kinds(options)]
    if len(options) == 1:
        node = {**options[0], **{key: value for key, value in node.items() if key != "anyOf"}}
    result: dict[str, Any] = {}
    for key, value in node.items():
        if key in _NOT_LISTED or (key == "description" and not said):
            continue
        if key == "properties":
            said_each = "required" not in node or len(value) <= _MANY or "description" not in node
            # Callers pass the other fields unchanged.
            needed = [name for name in value if said_each or name in node["required"]]
            result[key] = {name: _listed(value[name], said=said_each) for name in needed}
        elif key == "anyOf":
            result[key] = [_listed(option, said=False) for option in value]
        elif key == "items":
            result[key] = _listed(value, said=False)
        else:
            result[key] = value
    return result


def _of_all_kinds(options: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Merge the variants of a union into one object."""
    fields = {name: each for option in options for name, each in option["properties"].items() if name != "kind"}
    kinds = [option["properties"]["kind"]["const"] for option in options]
    return {"type": "object", "properties": {"kind": {"type": "string", "enum": kinds}, **fields}, "required": ["kind"]}
