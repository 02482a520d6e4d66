"""Run a call about an image: admission, fetching, work in a thread or process, progress."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import anyio.from_thread

from vehanchor_server.calls.job import PERCENT_DONE, Job
from vehanchor_server.calls.task import Task, perform
from vehanchor_server.errors import CallError

if TYPE_CHECKING:
    from mcp.server.mcpserver import Context

    from vehanchor_server.calls.capacity import Stop
    from vehanchor_server.calls.reply import Reply
    from vehanchor_server.calls.task import Record, Work
    from vehanchor_server.images.argument import AnyImage
    from vehanchor_server.services import Services


async def run_call(
    services: Services,
    ctx: Context[Any, Any],
    image: AnyImage,
    work: Work[Record],
    question: Any,
    more: Sequence[AnyImage] = (),
) -> Reply[Record]:
    """Run the work of a call within the server's capacity.

    Args:
        services: the server's parts.
        ctx: the call's context.
        image: the caller's image argument.
        work: work for a worker process, or for a thread if the server has no workers. Library
            errors reach the caller.
        question: the caller's other arguments.
        more: other images; if any, the work gets them with their bytes as a fifth argument and
            opens them itself.

    Raises:
        CallError: the call was refused, failed with a remedy for the caller, or took too long.
    """

    async def call(stop: Stop) -> Reply[Record]:
        await ctx.report_progress(0, PERCENT_DONE, "reading the image")
        task = Task(work, question, await services.sources.fetched((image, *more)))

        def report(percent: float, message: str) -> None:
            anyio.from_thread.run(ctx.report_progress, percent, PERCENT_DONE, message)

        def in_thread() -> Reply[Record]:
            if services.workers is not None:
                return services.workers.run(task, stop, report)
            try:
                return perform(services, task, Job(stop, report))
            except MemoryError as error:  # outside decoding and models
                raise CallError(
                    "out_of_memory",
                    "this server has too little free memory at the moment. Try again later, or "
                    "send a smaller image.",
                ) from error

        result = await services.capacity.in_thread(stop, in_thread)
        await ctx.report_progress(PERCENT_DONE, PERCENT_DONE, "done")
        return result

    return await services.capacity.run(call)
