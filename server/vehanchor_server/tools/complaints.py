"""Invalid arguments in words: one line per mistake, the caller's names, the expected value and an example call."""

from __future__ import annotations

import json
from difflib import get_close_matches
from typing import TYPE_CHECKING, Any, NamedTuple

from vehanchor_server.errors import shortened

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pydantic import ValidationError

_MAX_COMPLAINTS = 3
_SHOWN_CHARS = 200  # per complaint
_MISSING = "missing"
_UNKNOWN = "extra_forbidden"
_OWN_WORDS = ("target_form", "value_error")  # errors of our validators, which say what to give


class _Mistake(NamedTuple):
    """Mistake at a place.

    Attributes:
        kind: pydantic's type of the error.
        words: the mistake in words.
    """

    kind: str
    words: str


def complaints(
    error: ValidationError, arguments: Any, schema: Mapping[str, Any], required: Sequence[str]
) -> str:
    """Describe the mistakes, without their values, which may be base64 images.

    Args:
        error: pydantic's error, which can list one mistake several times.
        arguments: the caller's arguments.
        schema: the tool's full schema; its arguments have examples.
        required: arguments of the example call.
    """
    found: dict[tuple[str, ...], _Mistake] = {}
    whole: dict[tuple[str, ...], Mapping[str, Any]] = {}  # objects around the mistakes
    for each in error.errors(include_url=False, include_context=False, include_input=False):
        place, node, around = _place(
            each["loc"], arguments, schema, missing=each["type"] == _MISSING
        )
        words = _in_words(each["type"], each["msg"], place, node, around)
        found.setdefault(place, _Mistake(each["type"], words[:_SHOWN_CHARS]))
        whole[place[:-1]] = around
    for place, node in whole.items():
        _join_names(found, place, node)
    # A wrong part also makes its whole wrong, as a list that is then too short.
    own = [
        place
        for place in found
        if not any(other[: len(place)] == place != other for other in found)
    ]
    lines = [
        f"{'.'.join(map(shortened, place)) or 'arguments'}: {found[place].words}"
        for place in own[:_MAX_COMPLAINTS]
    ]
    more = f" (and {len(own) - _MAX_COMPLAINTS} more)" if len(own) > _MAX_COMPLAINTS else ""
    example = example_call(schema, (*required, *(place[0] for place in own if place)))
    return f"{'; '.join(lines)}{more}. Example: {example}"


def example_call(schema: Mapping[str, Any], names: Sequence[str]) -> str:
    """Return a call with the named arguments, as far as they have examples, as JSON."""
    arguments = schema["properties"]
    examples = {name: _example(arguments.get(name, {})) for name in dict.fromkeys(names)}
    return json.dumps(
        {
            name: _in_order(example, arguments[name])
            for name, example in examples.items()
            if example is not None
        }
    )


def _example(node: Mapping[str, Any]) -> Any:
    if "examples" in node:
        return node["examples"][0]
    return next(filter(None, map(_example, node.get("anyOf", ()))), None)


def _in_order(value: Any, node: Mapping[str, Any]) -> Any:
    """Return an example with the fields in the schema's order; pydantic sorts them by name."""
    if isinstance(value, list):
        return [_in_order(each, _part(node, 0)) for each in value]
    if not isinstance(value, dict):
        return value
    names = dict.fromkeys(
        name for option in _options(node) for name in option.get("properties", {})
    )
    return {name: _in_order(value[name], _part(node, name)) for name in names if name in value}


def _join_names(
    found: dict[tuple[str, ...], _Mistake], place: tuple[str, ...], node: Mapping[str, Any]
) -> None:
    """Join the missing and unknown names of one object to one mistake."""
    wrong = {
        at: each.kind
        for at, each in found.items()
        if at[:-1] == place and each.kind in (_MISSING, _UNKNOWN)
    }
    if len(wrong) < 2:
        return
    names = {
        kind: [shortened(at[-1]) for at, each in wrong.items() if each == kind]
        for kind in (_MISSING, _UNKNOWN)
    }
    missing = names[_MISSING]
    unknown = names[_UNKNOWN][:_MAX_COMPLAINTS]
    words = (
        [f"{', '.join(missing)} {'is' if len(missing) == 1 else 'are'} missing"] if missing else []
    )
    words += [f"there is no {', '.join(unknown)}"] if unknown else []
    for at in wrong:
        del found[at]
    expected = f": give {expectation(node)}" if place else ""
    found[place] = _Mistake(_MISSING, f"{' and '.join(words)}{expected}")


def _place(
    location: Sequence[Any], value: Any, node: Mapping[str, Any], *, missing: bool
) -> tuple[tuple[str, ...], Mapping[str, Any], Mapping[str, Any]]:
    """Follow a location in the arguments and in the schema; drop pydantic's names of unions and validators.

    Returns:
        The place in the caller's names, its schema and the schema around it.
    """
    place: list[str] = []
    around = node
    for i, part in enumerate(location):
        if isinstance(value, dict) and i + 1 < len(location) and part == value.get("kind"):
            continue  # the variant of the image
        known = (
            part in value
            if isinstance(value, dict)
            else isinstance(value, list) and part in range(len(value))
        )
        if known:
            value = value[part]
        elif not (missing and i == len(location) - 1):
            continue
        place.append(str(part))
        around = node
        node = _part(node, part)
    return tuple(place), node, around


def _options(node: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Return the variants of a schema without null."""
    if "anyOf" not in node:
        return [] if node.get("type") == "null" else [node]
    return [each for option in node["anyOf"] for each in _options(option)]


def _part(node: Mapping[str, Any], part: int | str) -> Mapping[str, Any]:
    for option in _options(node):
        found = (
            option.get("items") if isinstance(part, int) else option.get("properties", {}).get(part)
        )
        if found is not None:
            return dict(found)
    return {}


def _in_words(
    kind: str,
    message: str,
    place: Sequence[str],
    node: Mapping[str, Any],
    around: Mapping[str, Any],
) -> str:
    if kind == _UNKNOWN:
        names = [name for option in _options(around) for name in option.get("properties", ())]
        close = [
            name
            for name in get_close_matches(place[-1][:_SHOWN_CHARS], names, n=1)
            if name != place[-1]
        ]
        return f"there is no such argument{f', but {close[0]}' if close else ''}"
    expected = expectation(node)
    if kind in _OWN_WORDS or not expected or kind == "string_too_long":
        return message.removeprefix("Value error, ")
    if kind == _MISSING:
        return f"it is required: give {expected}"
    return f"give {expected}"


def expectation(node: Mapping[str, Any]) -> str:
    """Describe the values of a schema in a few words; empty without a type."""
    options = _options(node)
    kinds = [
        option["properties"]["kind"]["const"]
        for option in options
        if "kind" in option.get("properties", {})
    ]
    if kinds:
        return f"an object with kind {' or '.join(kinds)} and a field for it, as in the example"
    return " or ".join(dict.fromkeys(filter(None, map(_expectation, options))))


def _expectation(node: Mapping[str, Any]) -> str:
    if "const" in node or "enum" in node:
        return f"one of {', '.join(map(json.dumps, node.get('enum') or [node['const']]))}"
    kind = node.get("type")
    if kind == "object":
        return f"an object with {', '.join(node.get('required') or node.get('properties', {}))}"
    if kind == "array":
        low = node.get("minItems", 0)
        high = node.get("maxItems")
        return f"a list of {low} to {high} items" if high else "a list"
    if kind in ("number", "integer"):
        noun = "a whole number" if kind == "integer" else "a number"
        named = (("> ", "exclusiveMinimum"), (">= ", "minimum"), ("<= ", "maximum"))
        limits = " and ".join(f"{sign}{node[name]:.10g}" for sign, name in named if name in node)
        return f"{noun} {limits}".rstrip()
    if kind == "string":
        return "a text"
    return {"boolean": "true or false"}.get(str(kind), "")
