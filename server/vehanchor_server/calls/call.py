"""One call of a tool that looks at an image: a place, the image, the work in a thread, progress from start to end."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

from vehanchor_server.calls.job import PERCENT_DONE, Job
from vehanchor_server.images.source import OpenedImage, library_errors

if TYPE_CHECKING:
    from mcp.server.mcpserver import Context

    from vehanchor_server.calls.capacity import Stop
    from vehanchor_server.images.argument import AnyImage
    from vehanchor_server.services import Services

__all__ = ["run_call"]

Result = TypeVar("Result")


async def run_call(
    services: Services, ctx: Context[Any, Any], image: AnyImage, work: Callable[[Job, OpenedImage], Result]
) -> Result:
    """Run the work of a call, if there is a place for it.

    Args:
        services: of the server.
        ctx: of the call.
        image: the caller's argument.
        work: done in a worker thread; the library's errors that it raises are passed on to the caller.

    Raises:
        CallError: the call was refused, failed for a reason that its caller can act on, or took too long.
    """

    async def call(stop: Stop) -> Result:
        await ctx.report_progress(0, PERCENT_DONE, "reading the image")
        fetched = await services.sources.fetched(image)

        def in_thread() -> Result:
            with (
                services.sources.open(image, fetched) as source,
                Job(ctx, stop) as job,
                library_errors(source),
            ):
                return work(job, source)

        result = await services.capacity.in_thread(stop, in_thread)
        await ctx.report_progress(PERCENT_DONE, PERCENT_DONE, "done")
        return result

    return await services.capacity.run(call)
