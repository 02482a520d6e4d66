"""Shared parts of a server or a worker: options, models, image sources, capacity and workers."""

from __future__ import annotations

import os
import threading
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

from vehanchor_server.calls.capacity import Capacity
from vehanchor_server.calls.worker_process import WorkerLimits
from vehanchor_server.calls.workers import WorkerPool
from vehanchor_server.images.fetch import Fetcher
from vehanchor_server.images.path_access import PathAccess
from vehanchor_server.images.source import ImageSources
from vehanchor_server.models import Models
from vehanchor_server.parts import Parts

if TYPE_CHECKING:
    from vehanchor_server.settings import Settings


@dataclass(frozen=True)
class Services(Parts):
    """Shared parts of a server's tools; a worker has its own.

    Attributes:
        capacity: limit of concurrent calls.
        workers: worker processes; None if this process does the work.
    """

    capacity: Capacity
    workers: WorkerPool | None

    @property
    def ready(self) -> bool:
        """Whether a call can start at once."""
        return (self.workers or self.models).ready

    @property
    def failure(self) -> str | None:
        """Error code of the last failed load of a model, or None."""
        return (self.workers or self.models).failure

    def preload(self, delay_s: float = 0.0) -> threading.Timer:
        """Load the models in the background after a delay, in a worker or here; return the thread."""
        timer = threading.Timer(
            delay_s, self.models.load_all if self.workers is None else self.workers.start
        )
        timer.name = "vehanchor-preload"
        timer.daemon = True
        timer.start()
        return timer

    def close(self) -> None:
        """Refuse new calls and stop the running ones."""
        self.capacity.close()
        if self.workers is not None:
            self.workers.close()


def create_services(settings: Settings) -> Services:
    """Create the parts of a server or a worker without loading or starting anything."""
    n_cpus = os.cpu_count() or 1
    workers = None
    if settings.isolation != "in-process":
        limits = WorkerLimits(settings.max_worker_bytes, n_cpus * settings.deadline_s)
        workers = WorkerPool(partial(create_services, settings), limits)
    return Services(
        settings=settings,
        models=Models(settings),
        sources=ImageSources(
            paths=PathAccess(settings.roots, settings.spelled_roots),
            fetcher=Fetcher(settings.image_hosts, settings.image_limits.max_bytes),
        ),
        capacity=Capacity(settings.max_concurrency or max(2, n_cpus), settings.deadline_s),
        workers=workers,
    )
