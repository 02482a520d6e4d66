"""Quick import of the SDK; in processes of their own, because an import happens once."""

from __future__ import annotations

import json
import subprocess
import sys
from typing import Any

_IMPORT = """
import gc, json
from pydantic import BaseModel
from vehanchor_server.transport.quick_import import quick_import
"""


def _printed(code: str) -> Any:
    done = subprocess.run([sys.executable, "-c", _IMPORT + code], capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


def test_validators_of_the_sdk_are_built_at_first_use_only() -> None:
    built = """
with quick_import():
    import mcp.types
    class Own(BaseModel):
        x: int
before = mcp.types.Tool.__pydantic_complete__
tool = mcp.types.Tool.model_validate({"name": "a", "inputSchema": {"type": "object"}})
print(json.dumps([before, mcp.types.Tool.__pydantic_complete__, tool.name, Own.__pydantic_complete__]))
"""
    assert _printed(built) == [False, True, "a", True]


def test_pydantic_and_the_collector_are_as_before_after_it_also_after_an_error() -> None:
    after = """
class Before(BaseModel): pass
try:
    with quick_import():
        within = gc.isenabled()
        raise KeyError
except KeyError:
    pass
class After(BaseModel): pass
print(json.dumps([within, gc.isenabled(), dict(BaseModel.model_config), After.__pydantic_complete__]))
"""
    assert _printed(after) == [False, True, {}, True]


def test_the_listing_of_a_quick_server_is_that_of_a_usual_one() -> None:
    listing = """
import anyio, sys
from vehanchor_server.settings import Settings
if {quick}:
    with quick_import():
        from vehanchor_server.app import create_server
else:
    from vehanchor_server.app import create_server
from vehanchor_server.services import create_services
tools = anyio.run(create_server(create_services(Settings(in_process=True))).list_tools)
print(json.dumps([tool.model_dump(mode="json") for tool in tools]))
"""
    quick, usual = (_printed(listing.format(quick=quick)) for quick in (True, False))
    assert quick == usual
    assert len(usual) > 3
