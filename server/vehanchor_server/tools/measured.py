"""The common course of the measuring tools ``measure_area`` and ``measure_distance``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from vehanchor_server.calls.call import run_call
from vehanchor_server.tools.messages import warnings_of
from vehanchor_server.tools.scale_arguments import check_coordinates, hints

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

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
    describe: Callable[[Any], str],
    detail: Detail,
) -> CallToolResult:
    """Run the work of a call, and say its records in words, numbered if there are several; see ``run_call``.

    The places are the points of the subjects, in the caller's coordinates.
    """
    check_coordinates(places, question.given)
    answer = await run_call(services, ctx, image, work, question)
    words = [describe(record) for record in answer.records]
    if len(words) > 1:
        words = ["\n".join(f"{number}. {sentence}" for number, sentence in enumerate(words, 1))]
    told = hints(places, question.given, answer.record)
    text = " ".join([*words, *warnings_of(answer.records, detail)])
    return answer.to_result(text, detail=detail, shown=question.wanted, hints=told)
