"""Findings as JSON and back, exactly: for the journals of flights and evaluations.

Frozen dataclasses, named tuples and records of this package, arrays, and what JSON has itself. A class is named by its
module and its name; only classes of ``vehanchor`` are made again, so that a journal from elsewhere can start nothing.
"""

from __future__ import annotations

import base64
import importlib
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
from pydantic import BaseModel

_KIND = "="
_PACKAGE = "vehanchor."


def to_json(value: Any) -> Any:
    """A value as JSON can hold it.

    Raises:
        TypeError: it holds something else than findings do.
    """
    if value is None or (isinstance(value, bool | int | float | str) and type(value).__module__ == "builtins"):
        return value
    if isinstance(value, np.ndarray):
        data = base64.b64encode(np.ascontiguousarray(value).tobytes()).decode("ascii")
        return {_KIND: "array", "dtype": value.dtype.str, "shape": list(value.shape), "data": data}
    if isinstance(value, np.generic):
        return value.item()
    kind = f"{type(value).__module__}:{type(value).__qualname__}"
    if isinstance(value, BaseModel):
        return {_KIND: kind, "fields": value.model_dump(mode="json")}
    if is_dataclass(value):
        return {_KIND: kind, "fields": {each.name: to_json(getattr(value, each.name)) for each in fields(value)}}
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        return {_KIND: kind, "fields": {name: to_json(getattr(value, name)) for name in value._fields}}
    if isinstance(value, tuple | list):
        return [to_json(each) for each in value]
    raise TypeError(f"{type(value).__name__} is no finding")


def from_json(stored: Any) -> Any:
    """The value of what ``to_json`` gave; lists come back as tuples.

    Raises:
        ValueError: it names no class of this package, or is no such value.
    """
    if isinstance(stored, list):
        return tuple(from_json(each) for each in stored)
    if not isinstance(stored, dict):
        return stored
    kind = stored[_KIND]
    if kind == "array":
        dtype = np.dtype(stored["dtype"])
        if dtype.hasobject:
            raise ValueError(f"an array of {dtype} is no finding")
        data = np.frombuffer(base64.b64decode(stored["data"]), dtype=dtype)
        return data.reshape(stored["shape"]).copy()
    module, _, name = kind.partition(":")
    made = getattr(importlib.import_module(module), name, None) if module.startswith(_PACKAGE) else None
    if not isinstance(made, type) or not (
        is_dataclass(made) or issubclass(made, BaseModel) or hasattr(made, "_fields")
    ):
        raise ValueError(f"{kind!r} is no class of findings")
    if issubclass(made, BaseModel):
        return made.model_validate(stored["fields"])
    return made(**{key: from_json(each) for key, each in stored["fields"].items()})
