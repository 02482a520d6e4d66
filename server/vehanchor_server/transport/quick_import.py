"""Quick import of the MCP SDK.

The SDK defines some 550 pydantic models: the wire types of two revisions of the protocol. pydantic builds a validator
for each at import, and one session uses a few dozen. ``quick_import`` lets pydantic build the SDK's validators at first
use, and pauses garbage collection, which would visit the new classes again and again. Together they save a fifth of the
processor time up to the first ``tools/list``.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
from typing import TYPE_CHECKING

from pydantic import BaseModel, ConfigDict

if TYPE_CHECKING:
    from collections.abc import Iterator

_SDK = "mcp.server.apps"  # imports all that the server uses of the SDK


@contextlib.contextmanager
def quick_import() -> Iterator[None]:
    """Import the SDK with deferred validators; the block imports the modules that use it.

    Models that the block defines are built at once, as usual, unless their base is one of the SDK's.
    """
    gc.disable()
    try:
        _import_deferred(_SDK)
        yield
        gc.freeze()  # classes and modules stay until the end of the process
    finally:
        gc.enable()


def _import_deferred(module: str) -> None:
    """Import a module; its pydantic models inherit ``defer_build`` from ``BaseModel``, which has it meanwhile."""
    usual = BaseModel.model_config
    BaseModel.model_config = ConfigDict(defer_build=True)
    try:
        importlib.import_module(module)
    finally:
        BaseModel.model_config = usual
