"""Exact conversion of intermediate results to JSON and back, for journals.

Journals of flights and evaluations keep frozen dataclasses, named tuples, records, arrays and the
values of JSON. A codec makes objects of its own classes only, so that a foreign journal cannot
import or run anything.
"""

from __future__ import annotations

import base64
from dataclasses import fields, is_dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import BaseModel

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from typing import TypeAlias

    JsonObject: TypeAlias = dict[str, Any]

# A JSON object with this key is an array or an object of the class that it names.
_KIND = "="
_ARRAY = "array"


class Codec:
    """Converter between values of some classes and JSON values.

    Args:
        classes: frozen dataclasses, named tuples and records with different names.
        former_names: today's names by former names of classes (``Looks``) and of their fields
            (``Detections.looks``), so that journals of earlier versions can be read.
    """

    def __init__(
        self, classes: Iterable[type[Any]], former_names: Mapping[str, str] | None = None
    ) -> None:
        self._classes = {stored.__name__: stored for stored in classes}
        self._former_names = former_names or {}

    def dump(self, value: Any) -> Any:
        """Convert a value to JSON values.

        Raises:
            TypeError: the value contains an object of another class.
        """
        if value is None or _is_json_scalar(value):
            return value
        if isinstance(value, np.ndarray):
            return _dump_array(value)
        if isinstance(value, np.generic):
            return value.item()
        kind = type(value)
        if kind in self._classes.values():
            return {_KIND: kind.__name__, "fields": self._dump_fields(value)}
        if kind in (tuple, list):
            return [self.dump(item) for item in value]
        raise TypeError(f"{kind.__name__} is not a stored class: add it to those of the codec")

    def _dump_fields(self, value: Any) -> JsonObject:
        if isinstance(value, BaseModel):
            return value.model_dump(mode="json")
        if is_dataclass(value):
            names = [field.name for field in fields(value)]
        else:
            names = value._fields
        return {name: self.dump(getattr(value, name)) for name in names}

    def load(self, stored: Any) -> Any:
        """Convert the result of ``dump`` back to the value; lists come back as tuples.

        Raises:
            ValueError: the result names an unknown class, or is not a value of its class.
        """
        if isinstance(stored, list):
            return tuple(self.load(item) for item in stored)
        if not isinstance(stored, dict):
            return stored
        stored_name = stored[_KIND]
        name = self._former_names.get(stored_name, stored_name)
        if name == _ARRAY:
            return _load_array(stored)
        kind = self._classes.get(name)
        if kind is None:
            raise ValueError(f"{name!r} is not the name of a stored class")
        if issubclass(kind, BaseModel):
            return kind.model_validate(stored["fields"])
        values = {}
        for stored_field, stored_value in stored["fields"].items():
            field = self._former_names.get(f"{name}.{stored_field}", stored_field)
            values[field] = self.load(stored_value)
        return kind(**values)


def _is_json_scalar(value: Any) -> bool:
    # A subclass, such as an enumeration, would come back as its base.
    is_subclass = type(value).__module__ != "builtins"
    return isinstance(value, bool | int | float | str) and not is_subclass


def _dump_array(array: np.ndarray) -> JsonObject:
    data = np.ascontiguousarray(array).tobytes()
    return {
        _KIND: _ARRAY,
        "dtype": array.dtype.str,
        "shape": list(array.shape),
        "data": base64.b64encode(data).decode("ascii"),
    }


def _load_array(stored: JsonObject) -> np.ndarray:
    dtype = np.dtype(stored["dtype"])
    if dtype.hasobject:
        raise ValueError(f"an array of {dtype} cannot be stored")
    data = base64.b64decode(stored["data"])
    array = np.frombuffer(data, dtype=dtype).reshape(stored["shape"])
    # The copy can be written to; the buffer itself cannot.
    return array.copy()
