"""Read messages from a worker that may be compromised.

``pickle`` calls any importable object that a message names. This reader allows only records, dataclasses, enums and
errors of our own packages that this process has already imported, so a message can only produce values.
"""

from __future__ import annotations

import io
import pickle
import sys
from dataclasses import is_dataclass
from enum import Enum
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel

from vehanchor_server.errors import CallError

if TYPE_CHECKING:
    from multiprocessing.connection import Connection

_MAX_BYTES = 64 << 20
"""Limit of a message: more than all pictures and outlines of an answer."""

_PACKAGES = ("vehanchor", "vehanchor_server")


def receive(connection: Connection) -> tuple[Any, ...]:
    """Receive the next message of a worker.

    Raises:
        EOFError: the process ended.
        OSError: the pipe broke, or the message is too large.
        pickle.UnpicklingError: the message is invalid.
    """
    message = connection.recv_bytes(_MAX_BYTES)
    try:
        values = _ValuesOnly(io.BytesIO(message)).load()
    except Exception as error:  # pickle raises arbitrary errors
        raise pickle.UnpicklingError(f"{type(error).__name__}: {error}") from error
    if not isinstance(values, tuple) or not values:
        raise pickle.UnpicklingError("no message")
    return values


class _ValuesOnly(pickle.Unpickler):
    def find_class(self, module_name: str, name: str, /) -> Any:
        """Return a class that only holds values.

        Raises:
            pickle.UnpicklingError: the object is not such a class.
        """
        module = sys.modules.get(module_name) if module_name.partition(".")[0] in _PACKAGES else None
        found = getattr(module, name, None)
        if not isinstance(found, type) or (found.__module__, found.__qualname__) != (module_name, name):
            raise pickle.UnpicklingError(f"a worker sent {module_name}.{name}")
        if not (issubclass(found, (BaseModel, CallError, Enum)) or is_dataclass(found)):
            raise pickle.UnpicklingError(f"a worker sent {module_name}.{name}")
        return found
