"""The tools of a server, in the order of the listing.

To add a tool, write a module beside this one with a function like ``estimate_gsd_tool``, and add it
to ``TOOLS``. The server's instructions, the published schemas and the definitions for agents' APIs
follow.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehanchor_server.tools.estimate_gsd import estimate_gsd_tool
from vehanchor_server.tools.measure_area import measure_area_tool
from vehanchor_server.tools.measure_distance import measure_distance_tool
from vehanchor_server.tools.view_image import view_image_tool

if TYPE_CHECKING:
    from collections.abc import Callable

    from vehanchor_server.services import Services
    from vehanchor_server.tools.strict_tool import StrictTool

TOOLS: tuple[Callable[[Services], StrictTool], ...] = (
    estimate_gsd_tool,
    measure_area_tool,
    measure_distance_tool,
)
"""The tools beside ``view_image``, which shows their calls."""


def create_tools(services: Services) -> list[StrictTool]:
    """Create the models' tools; a description that several list for one argument stands in the first only."""
    tools = [create(services) for create in TOOLS]
    tools.append(view_image_tool(services, {tool.name: tool for tool in tools}))
    said: set[tuple[str, str]] = set()
    for tool in tools:
        tool.first_image = services.sources.paths.first
        for name, argument in tool.parameters["properties"].items():
            words = (name, argument.get("description", ""))
            if words in said:
                del argument["description"]
            said.add(words)
    return tools
