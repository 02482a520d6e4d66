"""Services: the resources of a server, and the capacity and workers that run its calls."""

from __future__ import annotations

import logging
import os
import threading
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import anyio.from_thread

from vehanchor_server.calls.capacity import Capacity
from vehanchor_server.calls.client import current_client
from vehanchor_server.calls.job import PERCENT_DONE, Job
from vehanchor_server.calls.task import Task, perform
from vehanchor_server.calls.worker_process import WorkerLimits
from vehanchor_server.calls.workers import WorkerPool
from vehanchor_server.errors import CallError
from vehanchor_server.resources import Resources, create_resources

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from mcp.server.mcpserver import Context

    from vehanchor_server.calls.capacity import Stop
    from vehanchor_server.calls.reply import Reply
    from vehanchor_server.calls.task import Record, Work
    from vehanchor_server.images.argument import AnyImage
    from vehanchor_server.settings import Settings

_logger = logging.getLogger(__name__)

_NO_WORKERS = (
    "there are no workers (isolation in-process): images are decoded with all rights of this "
    "process, and one that ends its decoder ends the server"
)


@dataclass(frozen=True)
class Services:
    """The parts of a server that all its tools share.

    Attributes:
        resources: settings, models and image sources.
        capacity: limit of concurrent calls.
        workers: worker processes; None if this process does the work.
    """

    resources: Resources
    capacity: Capacity
    workers: WorkerPool | None

    @property
    def ready(self) -> bool:
        """Whether a call can start at once."""
        return (self.workers or self.resources.models).ready

    @property
    def failure(self) -> str | None:
        """Error code of the last failed load of a model, or None."""
        return (self.workers or self.resources.models).failure

    def preload(self, delay_s: float = 0.0) -> threading.Timer:
        """Load the models in the background after a delay, in a worker or here.

        Returns:
            The thread, which is already started.
        """
        load = self.resources.models.load_all
        if self.workers is None:
            _logger.warning(_NO_WORKERS)
        else:
            load = self.workers.start
        timer = threading.Timer(delay_s, load)
        timer.name = "vehanchor-preload"
        timer.daemon = True
        timer.start()
        return timer

    def close(self) -> None:
        """Refuse new calls and stop the running ones."""
        self.capacity.close()
        if self.workers is not None:
            self.workers.close()

    async def run_call(
        self,
        ctx: Context[Any, Any],
        image: AnyImage,
        *,
        work: Work[Record],
        question: Any,
        more: Sequence[AnyImage] = (),
    ) -> Reply[Record]:
        """Run the work of a call within the capacity, in a worker or in a thread.

        Args:
            ctx: the call's context; it receives the progress.
            image: the caller's image argument.
            work: work for a worker process, or for a thread if the server has no workers. Library
                errors reach the caller.
            question: the caller's other arguments.
            more: other images; if any, the work gets them with their bytes as a fifth argument
                and opens them itself.

        Raises:
            CallError: the call was refused, failed with a remedy for the caller, or took too long.
        """

        def report(percent: float, message: str) -> None:
            anyio.from_thread.run(ctx.report_progress, percent, PERCENT_DONE, message)

        async def call(stop: Stop) -> Reply[Record]:
            await ctx.report_progress(0, PERCENT_DONE, "reading the image")
            images = await self.resources.sources.fetched((image, *more))
            task = Task(work, question, images=images)
            in_thread = partial(self._run_blocking, task, stop, report)
            reply = await self.capacity.in_thread(stop, in_thread)
            await ctx.report_progress(PERCENT_DONE, PERCENT_DONE, "done")
            return reply

        return await self.capacity.run(call, current_client())

    def _run_blocking(
        self, task: Task[Record], stop: Stop, report: Callable[[float, str], None]
    ) -> Reply[Record]:
        """Run a task in a worker, or in this thread without workers."""
        if self.workers is not None:
            return self.workers.run(task, stop, report)
        try:
            return perform(self.resources, task, Job(stop, report))
        except MemoryError as error:  # outside decoding and models
            raise CallError(
                "out_of_memory",
                "this server has too little free memory at the moment. Try again later, or "
                "send a smaller image.",
            ) from error


def create_services(settings: Settings) -> Services:
    """Create the parts of a server without loading or starting anything."""
    n_cpus = os.cpu_count() or 1
    workers = None
    if settings.isolation != "in-process":
        limits = WorkerLimits(settings.max_worker_bytes, cpu_s=n_cpus * settings.deadline_s)
        workers = WorkerPool(partial(create_resources, settings), limits)
    max_concurrency = settings.max_concurrency or max(2, n_cpus)
    return Services(
        resources=create_resources(settings),
        capacity=Capacity(max_concurrency, settings.deadline_s),
        workers=workers,
    )
