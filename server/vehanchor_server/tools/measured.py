"""The common course of the measuring tools ``measure_area`` and ``measure_distance``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from vehanchor_server.calls.call import run_call
from vehanchor_server.tools.messages import answer_of
from vehanchor_server.tools.scale_arguments import check_coordinates, hints

if TYPE_CHECKING:
    from collections.abc import Sequence

    from mcp.server.mcpserver import Context
    from mcp.types import CallToolResult

    from vehanchor_server.calls.reply import Detail
    from vehanchor_server.calls.task import Work
    from vehanchor_server.images.argument import AnyImage
    from vehanchor_server.services import Services
    from vehanchor_server.tools.scale_arguments import Question


async def measured(
    services: Services,
    ctx: Context[Any, Any],
    image: AnyImage,
    work: Work[Any],
    question: Question[Any],
    places: Sequence[tuple[float, float]],
    detail: Detail,
) -> CallToolResult:
    """Run the work of a call, and say its records; see ``run_call``.

    The places are the points of the subjects, in the caller's coordinates.
    """
    check_coordinates(places, question.given)
    answer = await run_call(services, ctx, image, work, question)
    told = answer_of(answer.records, hints(places, question.given, answer.record), detail)
    return answer.to_result(*told, detail=detail, shown=question.wanted)
