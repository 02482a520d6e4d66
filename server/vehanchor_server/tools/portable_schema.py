"""JSON Schemas in the subset that all hosts support.

pydantic writes references, ``oneOf`` with ``discriminator``, and titles that repeat names. Some
hosts and validators reject the first two; the titles waste the model's context.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from vehanchor.options.option import UNLISTED_KEY

if TYPE_CHECKING:
    from collections.abc import Collection

_REFERENCE = "#/$defs/"
_JSON_TYPES = {str: "string", bool: "boolean", int: "integer"}
_NOT_LISTED_KEYS = {
    "default",
    "examples",
    "exclusiveMinimum",
    "minimum",
    "maximum",
    "minLength",
    "maxLength",
    "pattern",
}


def portable_schema(schema: dict[str, Any]) -> dict[str, Any]:
    """Replace references and ``oneOf``; drop ``discriminator`` and generated titles."""
    portable = _portable(schema, schema.get("$defs", {}))
    assert isinstance(portable, dict)
    return portable


def _portable(node: Any, definitions: dict[str, Any]) -> Any:
    if isinstance(node, list):
        return [_portable(item, definitions) for item in node]
    if not isinstance(node, dict):
        return node
    reference = node.get("$ref")
    if isinstance(reference, str) and reference.startswith(_REFERENCE):
        siblings = {key: value for key, value in node.items() if key != "$ref"}
        node = {**definitions[reference.removeprefix(_REFERENCE)], **siblings}
    result: dict[str, Any] = {}
    for key, value in node.items():
        if key in ("$defs", "discriminator") or (key == "title" and isinstance(value, str)):
            continue
        if key == "properties":
            # By name, because a property may be named like a keyword.
            result[key] = {name: _portable(field, definitions) for name, field in value.items()}
        elif key in ("const", "enum", "default", "examples"):
            result[key] = value
        elif key == "oneOf":
            result["anyOf"] = _portable(value, definitions)
        else:
            result[key] = _portable(value, definitions)
    if "const" in result and "type" not in result:
        result["type"] = _JSON_TYPES[type(result["const"])]
    return result


def without_marks(node: Any) -> Any:
    """Remove the marks of fields that are not listed to models."""
    if isinstance(node, list):
        return [without_marks(item) for item in node]
    if not isinstance(node, dict):
        return node
    return {key: without_marks(value) for key, value in node.items() if key != UNLISTED_KEY}


def listed(
    node: dict[str, Any], kinds: Collection[str] = (), *, described: bool = True
) -> dict[str, Any]:
    """Reduce a portable schema to the names, types and required fields that a model needs.

    Fields that their declaration marks as unlisted are left out, at any depth. Optional arguments
    lose their null type. A union of an object and a text becomes the text, which every host passes
    unchanged. The server still checks the limits that are dropped here. A value of the listed shape
    has a valid shape.

    Args:
        node: the portable schema.
        kinds: kinds of images that the server accepts from models; an empty collection lists all.
        described: whether to keep the description.
    """
    variants = _listed_variants(node, kinds)
    if len(variants) == 1:
        siblings = {key: value for key, value in node.items() if key != "anyOf"}
        return listed({**variants[0], **siblings}, kinds, described=described)
    result: dict[str, Any] = {}
    for key, value in node.items():
        if key in _NOT_LISTED_KEYS or (key == "description" and not described):
            continue
        if key == "properties":
            result[key] = {
                name: listed(field, kinds, described=described)
                for name, field in value.items()
                if UNLISTED_KEY not in field
            }
        elif key == "additionalProperties":
            # Below the arguments, only an image with fields of two kinds would be ambiguous.
            if {"image", "kind"} & set(node.get("properties", ())):
                result[key] = value
        elif key == "anyOf":
            result[key] = [listed(variant, kinds, described=False) for variant in variants]
        elif key == "items":
            result[key] = listed(value, kinds, described=False)
        elif key == "const":
            result["enum"] = [value]
        else:
            result[key] = value
    return result


def _listed_variants(node: dict[str, Any], kinds: Collection[str]) -> list[dict[str, Any]]:
    """Return the variants of a union that models see."""
    variants = []
    for variant in node.get("anyOf", ()):
        if variant != {"type": "null"} and _is_accepted(variant, kinds):
            variants.append(variant)
    if {variant.get("type") for variant in variants} == {"object", "string"}:
        return [variant for variant in variants if variant["type"] == "string"]
    return variants


def _is_accepted(variant: dict[str, Any], kinds: Collection[str]) -> bool:
    kind = variant.get("properties", {}).get("kind")
    return kind is None or not kinds or kind["const"] in kinds
