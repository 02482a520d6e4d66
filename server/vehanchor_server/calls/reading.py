"""Reading what a worker sends as what it may be: sent by whoever has taken it over.

``pickle`` calls what it is told to call. Here that is only a record, a dataclass or an error of ours that this process
has imported already, so that nothing but values can come out.
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
"""Of a message: more than every picture and outline of an answer."""

_PACKAGES = ("vehanchor", "vehanchor_server")


def receive(connection: Connection) -> tuple[Any, ...]:
    """The next message of a worker.

    Raises:
        EOFError: the process ended.
        OSError: its pipe broke, or the message is too large.
        pickle.UnpicklingError: it is not one that a worker sends.
    """
    message = connection.recv_bytes(_MAX_BYTES)
    try:
        values = _ValuesOnly(io.BytesIO(message)).load()
    except Exception as error:  # pickle raises whatever the bytes lead it to
        raise pickle.UnpicklingError(f"{type(error).__name__}: {error}") from error
    if not isinstance(values, tuple) or not values:
        raise pickle.UnpicklingError("no message")
    return values


class _ValuesOnly(pickle.Unpickler):
    def find_class(self, module_name: str, name: str, /) -> Any:
        """A class that only holds values.

        Raises:
            pickle.UnpicklingError: it is none.
        """
        module = sys.modules.get(module_name) if module_name.partition(".")[0] in _PACKAGES else None
        found = getattr(module, name, None)
        if not isinstance(found, type) or (found.__module__, found.__qualname__) != (module_name, name):
            raise pickle.UnpicklingError(f"a worker sent {module_name}.{name}")
        if not (issubclass(found, (BaseModel, CallError, Enum)) or is_dataclass(found)):
            raise pickle.UnpicklingError(f"a worker sent {module_name}.{name}")
        return found
