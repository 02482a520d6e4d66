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
    from collections.abc import Callable, Sequence

    from vehanchor_server.services import Services
    from vehanchor_server.tools.strict_tool import StrictTool

TOOLS: tuple[Callable[[Services], StrictTool], ...] = (
    estimate_gsd_tool,
    measure_area_tool,
    measure_distance_tool,
)
"""The tools beside ``view_image``, which shows their calls."""


def create_tools(services: Services) -> list[StrictTool]:
    """Create the tools for models."""
    measuring = [create(services) for create in TOOLS]
    view_image = view_image_tool(services, {tool.name: tool for tool in measuring})
    tools = [*measuring, view_image]
    for tool in tools:
        tool.first_image = services.resources.sources.paths.first
    _describe_once(tools)
    return tools


def _describe_once(tools: Sequence[StrictTool]) -> None:
    """Keep the description of an argument in the first of the tools that share it.

    Models read the whole list, so that repetition wastes their context.
    """
    described: set[tuple[str, str]] = set()
    for tool in tools:
        for name, argument in tool.parameters["properties"].items():
            description = (name, argument.get("description", ""))
            if description in described:
                del argument["description"]
            described.add(description)
