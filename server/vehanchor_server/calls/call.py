"""One call of a tool that looks at an image: a place, the image, the work in a thread or process, its progress."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import anyio.from_thread

from vehanchor_server.calls.job import PERCENT_DONE, Job, Stages
from vehanchor_server.calls.task import Task, perform
from vehanchor_server.errors import CallError

if TYPE_CHECKING:
    from mcp.server.mcpserver import Context

    from vehanchor_server.calls.answer import Answer
    from vehanchor_server.calls.capacity import Stop
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
) -> Answer[Record]:
    """Run the work of a call, if there is a place for it.

    Args:
        services: of the server.
        ctx: of the call.
        image: the caller's argument.
        work: runs in a worker process, or in a thread if the server has none. Errors of the library are passed on
            to the caller.
        question: what the work is asked.
        more: other images; where there are any, the work gets them and their bytes as a fifth argument, and opens
            them itself.

    Raises:
        CallError: the call was refused, failed for a reason that its caller can act on, or took too long.
    """

    async def call(stop: Stop) -> Answer[Record]:
        await ctx.report_progress(0, PERCENT_DONE, "reading the image")
        fetched = await services.sources.fetched(image)
        others = await services.sources.fetched_together(more, len(fetched or b""))
        task = Task(work, question, image, fetched, others)

        def report(percent: float, message: str) -> None:
            anyio.from_thread.run(ctx.report_progress, percent, PERCENT_DONE, message)

        def in_thread() -> Answer[Record]:
            with Stages() as stages:
                if services.workers is not None:
                    return services.workers.run(task, stop, report, stages.enter)
                try:
                    return perform(services, task, Job(stop, report, stages.enter))
                except MemoryError as error:  # of whatever the library does beside decoding and models
                    raise CallError(
                        "out_of_memory",
                        "this server has too little memory left just now. Try again when less is running, or send a "
                        "smaller image.",
                    ) from error

        result = await services.capacity.in_thread(stop, in_thread)
        await ctx.report_progress(PERCENT_DONE, PERCENT_DONE, "done")
        return result

    return await services.capacity.run(call)
