"""Invalid arguments in words.

Each mistake takes one line with the caller's names and the expected value; an example call follows.
"""

from __future__ import annotations

import json
from difflib import get_close_matches
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

from vehanchor_server.errors import shortened

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pydantic import ValidationError

_MAX_COMPLAINTS = 3
_SHOWN_CHARS = 200  # per complaint
_MISSING = "missing"
_UNKNOWN = "extra_forbidden"
_OWN_WORDS = (
    "target_form",
    "value_error",
    "unit",
)  # errors of our validators, which say what to give
_UNCHANGED = (*_OWN_WORDS, "string_too_long")  # pydantic's message is clear

_Schema: TypeAlias = "Mapping[str, Any]"
_Position: TypeAlias = tuple[str, ...]
"""Names from the arguments to a value, such as ``("targets", "0", "box")``."""


class _Mistake(NamedTuple):
    """Mistake at a position.

    Attributes:
        kind: pydantic's type of the error.
        words: the mistake in words.
    """

    kind: str
    words: str


class _Location(NamedTuple):
    """Position of a mistake in the arguments and in the schema.

    Attributes:
        position: the position in the caller's names.
        schema: schema of the value there.
        parent: schema of the object or list around it.
    """

    position: _Position
    schema: _Schema
    parent: _Schema


def complaints(
    error: ValidationError, arguments: Any, *, schema: _Schema, required: Sequence[str]
) -> str:
    """Describe the mistakes, without their values, which may be base64 images.

    Args:
        error: pydantic's error, which can list one mistake several times.
        arguments: the caller's arguments.
        schema: the tool's full schema; its arguments have examples.
        required: arguments of the example call.
    """
    mistakes: dict[_Position, _Mistake] = {}
    parents: dict[_Position, _Schema] = {}
    for detail in error.errors(include_url=False, include_context=False, include_input=False):
        kind = detail["type"]
        location = _locate(detail["loc"], arguments, schema, is_missing=kind == _MISSING)
        words = _in_words(kind, detail["msg"], location)
        # The first error at a position counts: pydantic lists one for each variant of a union.
        mistakes.setdefault(location.position, _Mistake(kind, words[:_SHOWN_CHARS]))
        parents[location.position[:-1]] = location.parent
    for position, parent in parents.items():
        _join_names(mistakes, position, parent)
    positions = [position for position in mistakes if not _has_wrong_part(position, mistakes)]
    lines = []
    for position in positions[:_MAX_COMPLAINTS]:
        name = ".".join(map(shortened, position)) or "arguments"
        lines.append(f"{name}: {mistakes[position].words}")
    text = "; ".join(lines)
    if len(positions) > _MAX_COMPLAINTS:
        text += f" (and {len(positions) - _MAX_COMPLAINTS} more)"
    wrong_arguments = [position[0] for position in positions if position]
    return f"{text}. Example: {example_call(schema, (*required, *wrong_arguments))}"


def _has_wrong_part(position: _Position, mistakes: Mapping[_Position, _Mistake]) -> bool:
    """Return whether a mistake lies within this value.

    A wrong part also makes its whole wrong, such as a list that is then too short.
    """
    return any(other[: len(position)] == position != other for other in mistakes)


def example_call(schema: _Schema, names: Sequence[str]) -> str:
    """Return a call with the named arguments, as far as they have examples, as JSON."""
    properties = schema["properties"]
    arguments = {}
    for name in dict.fromkeys(names):
        example = _example(properties.get(name, {}))
        if example is not None:
            arguments[name] = _in_order(example, properties[name])
    return json.dumps(arguments)


def _example(node: _Schema) -> Any:
    """Return the first example of a schema or of its variants; None without one."""
    if "examples" in node:
        return node["examples"][0]
    for variant in node.get("anyOf", ()):
        example = _example(variant)
        if example:
            return example
    return None


def _in_order(value: Any, node: _Schema) -> Any:
    """Return an example with the fields in the schema's order; pydantic sorts them by name."""
    if isinstance(value, list):
        return [_in_order(item, _part(node, 0)) for item in value]
    if not isinstance(value, dict):
        return value
    ordered = {}
    for name in _field_names(node):
        if name in value:
            ordered[name] = _in_order(value[name], _part(node, name))
    return ordered


def _join_names(mistakes: dict[_Position, _Mistake], position: _Position, parent: _Schema) -> None:
    """Join the missing and unknown names of one object to one mistake.

    Args:
        mistakes: all mistakes; changed in place.
        position: position of the object.
        parent: schema of the object.
    """
    missing = []
    unknown = []
    for other, mistake in mistakes.items():
        if other[:-1] != position:
            continue
        if mistake.kind == _MISSING:
            missing.append(other)
        elif mistake.kind == _UNKNOWN:
            unknown.append(other)
    if len(missing) + len(unknown) < 2:
        return
    words = []
    if missing:
        names = ", ".join(shortened(other[-1]) for other in missing)
        verb = "is" if len(missing) == 1 else "are"
        words.append(f"{names} {verb} missing")
    if unknown:
        names = ", ".join(shortened(other[-1]) for other in unknown[:_MAX_COMPLAINTS])
        words.append(f"there is no {names}")
    text = " and ".join(words)
    if position:
        text += f": give {expectation(parent)}"
    for other in (*missing, *unknown):
        del mistakes[other]
    mistakes[position] = _Mistake(_MISSING, text)


def _locate(
    location: Sequence[Any], arguments: Any, schema: _Schema, *, is_missing: bool
) -> _Location:
    """Follow pydantic's location in the arguments and in the schema.

    The location also has pydantic's names of unions and validators, which are dropped.
    """
    position: list[str] = []
    value = arguments
    node = schema
    parent = schema
    for i, part in enumerate(location):
        is_last = i + 1 == len(location)
        if isinstance(value, dict) and not is_last and part == value.get("kind"):
            continue  # the variant of the image
        if isinstance(value, dict):
            is_in_value = part in value
        else:
            is_in_value = isinstance(value, list) and part in range(len(value))
        if is_in_value:
            value = value[part]
        elif not (is_missing and is_last):
            continue
        position.append(str(part))
        parent = node
        node = _part(node, part)
    return _Location(tuple(position), node, parent)


def _variants(node: _Schema) -> list[_Schema]:
    """Return the variants of a schema without null."""
    if "anyOf" in node:
        return [variant for option in node["anyOf"] for variant in _variants(option)]
    if node.get("type") == "null":
        return []
    return [node]


def _field_names(node: _Schema) -> list[str]:
    """Return the names of the fields of all variants, in the schema's order."""
    names = [name for variant in _variants(node) for name in variant.get("properties", {})]
    return list(dict.fromkeys(names))


def _part(node: _Schema, part: int | str) -> _Schema:
    """Return the schema of an item, by number, or of a field, by name; empty without one."""
    for variant in _variants(node):
        if isinstance(part, int):
            schema = variant.get("items")
        else:
            schema = variant.get("properties", {}).get(part)
        if schema is not None:
            return dict(schema)
    return {}


def _in_words(kind: str, message: str, location: _Location) -> str:
    """Describe one mistake by pydantic's type and message."""
    if kind == _UNKNOWN:
        name = location.position[-1]
        close = get_close_matches(name[:_SHOWN_CHARS], _field_names(location.parent), n=1)
        if close and close[0] != name:
            return f"there is no such argument; the nearest is {close[0]}"
        return "there is no such argument"
    expected = expectation(location.schema)
    if kind in _UNCHANGED or not expected:
        return message.removeprefix("Value error, ")
    if kind == _MISSING:
        return f"it is required: give {expected}"
    return f"give {expected}"


def expectation(node: _Schema) -> str:
    """Describe the values of a schema in a few words; empty without a type."""
    variants = _variants(node)
    kinds = []
    for variant in variants:
        fields = variant.get("properties", {})
        if "kind" in fields:
            kinds.append(fields["kind"]["const"])
    if kinds:
        return f"an object with kind {' or '.join(kinds)} and a field for it, as in the example"
    words = [_variant_in_words(variant) for variant in variants]
    return " or ".join(dict.fromkeys(filter(None, words)))


def _variant_in_words(node: _Schema) -> str:
    if "const" in node or "enum" in node:
        values = node.get("enum") or [node["const"]]
        return f"one of {', '.join(map(json.dumps, values))}"
    kind = node.get("type")
    if kind == "object":
        names = node.get("required") or node.get("properties", {})
        return f"an object with {', '.join(names)}"
    if kind == "array":
        if "maxItems" not in node:
            return "a list"
        return f"a list of {node.get('minItems', 0)} to {node['maxItems']} items"
    if kind == "integer":
        return f"a whole number {_limits(node)}".rstrip()
    if kind == "number":
        return f"a number {_limits(node)}".rstrip()
    if kind == "string":
        return "a text"
    if kind == "boolean":
        return "true or false"
    return ""


def _limits(node: _Schema) -> str:
    """Describe the limits of a number, such as ``> 0 and <= 10``."""
    signs = {"exclusiveMinimum": "> ", "minimum": ">= ", "maximum": "<= "}
    limits = [f"{sign}{node[name]:.10g}" for name, sign in signs.items() if name in node]
    return " and ".join(limits)
