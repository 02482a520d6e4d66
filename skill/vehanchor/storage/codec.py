"""Intermediate results as JSON and back, exactly: for the journals of flights and evaluations.

Frozen dataclasses, named tuples and records, arrays, and JSON's own values. A codec makes only its
own classes: a journal from elsewhere can import and start nothing. The names of classes may change
with the version of the library, on which journals depend.
"""

from __future__ import annotations

import base64
from dataclasses import fields, is_dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import BaseModel

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

_KIND = "="
_ARRAY = "array"


class Codec:
    """Values of chosen classes to JSON and back.

    Args:
        classes: frozen dataclasses, named tuples and records, each of another name.
        former_names: today's name by the former one, of a class (``Looks``) or of one of its fields
            (``Detections.looks``), so that journals of earlier versions can be read.
    """

    def __init__(
        self, classes: Iterable[type[Any]], former_names: Mapping[str, str] | None = None
    ) -> None:
        self._classes = {each.__name__: each for each in classes}
        self._former_names = former_names or {}

    def dump(self, value: Any) -> Any:
        """Turn a value into what JSON can hold.

        Raises:
            TypeError: the value holds something of another class.
        """
        if value is None or (
            isinstance(value, bool | int | float | str) and type(value).__module__ == "builtins"
        ):
            return value
        if isinstance(value, np.ndarray):
            data = base64.b64encode(np.ascontiguousarray(value).tobytes()).decode("ascii")
            return {
                _KIND: _ARRAY,
                "dtype": value.dtype.str,
                "shape": list(value.shape),
                "data": data,
            }
        if isinstance(value, np.generic):
            return value.item()
        if type(value) in self._classes.values():
            return {_KIND: type(value).__name__, "fields": self._fields(value)}
        if type(value) in (tuple, list):
            return [self.dump(each) for each in value]
        raise TypeError(f"{type(value).__name__} is no stored class: add it to those of the codec")

    def load(self, found: Any) -> Any:
        """Turn the result of ``dump`` into the value; lists come back as tuples.

        Raises:
            ValueError: it names no stored class, or is no such value.
        """
        if isinstance(found, list):
            return tuple(self.load(each) for each in found)
        if not isinstance(found, dict):
            return found
        name = self._former_names.get(found[_KIND], found[_KIND])
        kind = self._classes.get(name)
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
        return kind(
            **{
                self._former_names.get(f"{name}.{field}", field): self.load(value)
                for field, value in found["fields"].items()
            }
        )

    def _fields(self, value: Any) -> dict[str, Any]:
        if isinstance(value, BaseModel):
            return value.model_dump(mode="json")
        names = [each.name for each in fields(value)] if is_dataclass(value) else value._fields
        return {name: self.dump(getattr(value, name)) for name in names}
