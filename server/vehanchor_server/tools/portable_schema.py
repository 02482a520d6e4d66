"""JSON Schemas in the subset that all hosts support.

pydantic writes references, ``oneOf`` with ``discriminator``, and titles that repeat names. Some
hosts and validators reject the first two; the titles waste the model's context.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from vehanchor.options import declared_options

if TYPE_CHECKING:
    from collections.abc import Collection

_REFERENCE = "#/$defs/"


def portable_schema(schema: dict[str, Any]) -> dict[str, Any]:
    """Replace references and ``oneOf`` of pydantic's schema, and drop ``discriminator`` and generated titles."""
    plain = _plain(schema, schema.get("$defs", {}))
    assert isinstance(plain, dict)
    return plain


def _plain(node: Any, definitions: dict[str, Any]) -> Any:
    if isinstance(node, list):
        return [_plain(item, definitions) for item in node]
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
        if key == "properties":  # a property may be named like a keyword
            result[key] = {
                name: _plain(property_, definitions) for name, property_ in value.items()
            }
        elif key in ("const", "enum", "default", "examples"):
            result[key] = value
        else:
            result["anyOf" if key == "oneOf" else key] = _plain(value, definitions)
    if "const" in result and "type" not in result:
        result["type"] = {str: "string", bool: "boolean", int: "integer"}[type(result["const"])]
    return result


_NOT_LISTED = {
    "default",
    "examples",
    "exclusiveMinimum",
    "minimum",
    "maximum",
    "minLength",
    "maxLength",
    "pattern",
}
_UNLISTED = {"detail", "tolerance_m", "object_height_m"}
_UNLISTED |= {name for name, each in declared_options().items() if not each.option.listed}


def listed(
    node: dict[str, Any], kinds: Collection[str] = (), *, described: bool = True
) -> dict[str, Any]:
    """Reduce a portable schema to what a model needs: names, types, required fields, numbers of items.

    Arguments for programs are left out, at any depth. Optional arguments lose their null type. A
    union of an object and a text becomes the text, which every host passes unchanged. The server
    still checks the limits that are dropped here; what has the listed shape has a valid shape.

    Args:
        node: the portable schema.
        kinds: kinds of images that the server accepts from models; an empty collection lists all.
        described: whether to keep the description.
    """
    options = [
        option
        for option in node.get("anyOf", ())
        if option != {"type": "null"} and _accepted(option, kinds)
    ]
    if {"object", "string"} == {option.get("type") for option in options}:
        options = [option for option in options if option["type"] == "string"]
    if len(options) == 1:
        node = {**options[0], **{key: value for key, value in node.items() if key != "anyOf"}}
        return listed(node, kinds, described=described)
    result: dict[str, Any] = {}
    for key, value in node.items():
        if key in _NOT_LISTED or (key == "description" and not described):
            continue
        if key == "additionalProperties" and not {"image", "kind"} & set(
            node.get("properties", ())
        ):
            # below the arguments, only an image with fields of two kinds would be ambiguous
            continue
        if key == "properties":
            result[key] = {
                name: listed(each, kinds, described=described)
                for name, each in value.items()
                if name not in _UNLISTED
            }
        elif key == "anyOf":
            result[key] = [listed(option, kinds, described=False) for option in options]
        elif key == "items":
            result[key] = listed(value, kinds, described=False)
        elif key == "const":
            result["enum"] = [value]
        else:
            result[key] = value
    return result


def _accepted(option: dict[str, Any], kinds: Collection[str]) -> bool:
    kind = option.get("properties", {}).get("kind")
    return kind is None or not kinds or kind["const"] in kinds
