"""Quick import of the SDK; in processes of their own, because an import happens once."""

from __future__ import annotations

import json
import subprocess
import sys
from typing import Any

_IMPORT = """
import json
from pydantic import BaseModel
from vehanchor_server.transport.quick_import import import_sdk
"""


def _printed(code: str) -> Any:
    done = subprocess.run([sys.executable, "-c", _IMPORT + code], capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


def test_validators_of_the_sdk_are_built_at_first_use_only() -> None:
    built = """
import_sdk()
import mcp.types
class Own(BaseModel):
    x: int
before = mcp.types.Tool.__pydantic_complete__
tool = mcp.types.Tool.model_validate({"name": "a", "inputSchema": {"type": "object"}})
print(json.dumps([before, mcp.types.Tool.__pydantic_complete__, tool.name, Own.__pydantic_complete__]))
"""
    assert _printed(built) == [False, True, "a", True]


def test_pydantic_is_as_before_after_an_error() -> None:
    after = """
import sys
sys.modules["mcp"] = None  # cannot be imported
try:
    import_sdk()
except ImportError:
    class After(BaseModel): pass
    print(json.dumps([dict(BaseModel.model_config), After.__pydantic_complete__]))
"""
    assert _printed(after) == [{}, True]


def test_the_listing_of_a_quick_server_is_that_of_a_usual_one() -> None:
    listing = """
import anyio, sys
from vehanchor_server.settings import Settings
if {quick}:
    import_sdk()
from vehanchor_server.app import create_server
from vehanchor_server.services import create_services
tools = anyio.run(create_server(create_services(Settings(isolation="in-process"))).list_tools)
print(json.dumps([tool.model_dump(mode="json") for tool in tools]))
"""
    quick, usual = (_printed(listing.format(quick=quick)) for quick in (True, False))
    assert quick == usual
    assert len(usual) > 3
