"""Intermediate results as JSON and back, exactly: for the journals of flights and evaluations.

Frozen dataclasses, named tuples and records, arrays, and JSON's own values. A class is stored under the name that
``stored`` gives it, so that a class or module may be renamed. Only classes with such a name are made again: a journal
from elsewhere can import and start nothing.
"""

from __future__ import annotations

import base64
from dataclasses import fields, is_dataclass
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from pydantic import BaseModel

if TYPE_CHECKING:
    from collections.abc import Callable

_KIND, _ARRAY = "=", "array"
_CLASSES: dict[str, type[Any]] = {}
_NAMES: dict[type[Any], str] = {}
Class = TypeVar("Class", bound=type)


def stored(name: str) -> Callable[[Class], Class]:
    """Give a class the name under which its values are stored.

    Args:
        name: unique among stored classes; it never changes.

    Returns:
        A decorator for a frozen dataclass, a named tuple or a record.
    """

    def register(kind: Class) -> Class:
        taken = _CLASSES.setdefault(name, kind)
        if name == _ARRAY or (taken is not kind and taken.__qualname__ != kind.__qualname__):
            raise ValueError(f"the stored name {name!r} is taken by {taken.__qualname__}")
        _CLASSES[name] = kind
        _NAMES[kind] = name
        return kind

    return register


def to_json(value: Any) -> Any:
    """Turn a value into what JSON can hold.

    Raises:
        TypeError: the value holds something that has no stored name.
    """
    if value is None or (isinstance(value, bool | int | float | str) and type(value).__module__ == "builtins"):
        return value
    if isinstance(value, np.ndarray):
        data = base64.b64encode(np.ascontiguousarray(value).tobytes()).decode("ascii")
        return {_KIND: _ARRAY, "dtype": value.dtype.str, "shape": list(value.shape), "data": data}
    if isinstance(value, np.generic):
        return value.item()
    name = _NAMES.get(type(value))
    if name is not None:
        return {_KIND: name, "fields": _fields(value)}
    if type(value) in (tuple, list):
        return [to_json(each) for each in value]
    raise TypeError(f"{type(value).__name__} has no stored name: decorate it with vehanchor.storage.stored.stored")


def from_json(found: Any) -> Any:
    """Turn the result of ``to_json`` into the value; lists come back as tuples.

    Raises:
        ValueError: it names no stored class, or is no such value.
    """
    if isinstance(found, list):
        return tuple(from_json(each) for each in found)
    if not isinstance(found, dict):
        return found
    name, kind = found[_KIND], _CLASSES.get(found[_KIND])
    if name == _ARRAY:
        dtype = np.dtype(found["dtype"])
        if dtype.hasobject:
            raise ValueError(f"an array of {dtype} cannot be stored")
        data = np.frombuffer(base64.b64decode(found["data"]), dtype=dtype)
        return data.reshape(found["shape"]).copy()
    if kind is None:
        raise ValueError(f"{name!r} is the name of no stored class")
    if issubclass(kind, BaseModel):
        return kind.model_validate(found["fields"])
    return kind(**{key: from_json(each) for key, each in found["fields"].items()})


def _fields(value: Any) -> dict[str, Any]:
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json")
    names = [each.name for each in fields(value)] if is_dataclass(value) else value._fields
    return {name: to_json(getattr(value, name)) for name in names}
