"""Quick import of the MCP SDK.

The SDK defines some 550 pydantic models: the wire types of two revisions of the protocol. pydantic
builds a validator for each at import, and one session uses a few dozen. ``import_sdk`` lets
pydantic build the SDK's validators at first use, which saves a tenth of the processor time up to
the first ``tools/list``.
"""

from __future__ import annotations

import importlib

from pydantic import BaseModel, ConfigDict

_SDK = "mcp.server.apps"  # imports all that the server uses of the SDK


def import_sdk() -> None:
    """Import the SDK while ``BaseModel`` has ``defer_build``, which its models inherit.

    Models that are defined later are built at once, as usual, unless their base is one of the
    SDK's.
    """
    usual = BaseModel.model_config
    BaseModel.model_config = ConfigDict(defer_build=True)
    try:
        importlib.import_module(_SDK)
    finally:
        BaseModel.model_config = usual
