"""JSON Schemas in the subset that every host reads.

pydantic writes references, ``oneOf`` with ``discriminator``, and titles that repeat the names. Some hosts and
validators refuse the first two, and all pay for the third in the model's context.
"""

from __future__ import annotations

from typing import Any

__all__ = ["portable_schema"]

_DIALECT = "https://json-schema.org/draft/2020-12/schema"
_REFERENCE = "#/$defs/"


def portable_schema(schema: dict[str, Any], *, dialect: bool = False) -> dict[str, Any]:
    """The same schema without references, ``oneOf``, ``discriminator`` and generated titles.

    Args:
        schema: as pydantic writes it; not recursive.
        dialect: name the dialect, for a schema that stands in a file of its own.
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
