"""Shared parts of a server: options, models, image sources, capacity and workers."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import partial

from vehanchor_server.calls.capacity import Capacity
from vehanchor_server.calls.worker_process import WorkerLimits
from vehanchor_server.calls.workers import WorkerPool
from vehanchor_server.images.fetch import Fetcher
from vehanchor_server.images.path_access import PathAccess
from vehanchor_server.images.source import ImageSources
from vehanchor_server.models import Models
from vehanchor_server.parts import Parts
from vehanchor_server.settings import Settings


@dataclass(frozen=True)
class Services(Parts):
    """Shared parts of a server's tools.

    Attributes:
        capacity: limit of concurrent calls.
        workers: worker processes; None if this process does the work.
    """

    capacity: Capacity
    workers: WorkerPool | None = None

    @property
    def ready(self) -> bool:
        """Whether a call can start at once."""
        return self.models.ready if self.workers is None else self.workers.ready

    @property
    def failure(self) -> str | None:
        """Error code of the last failed load of a model, or None."""
        return self.models.failure if self.workers is None else self.workers.failure

    def preload(self, delay_s: float = 0.0) -> None:
        """Load the models in the background after a delay, in the workers or here."""
        if self.workers is None:
            self.models.preload(delay_s)
        else:
            self.workers.start(delay_s)

    def close(self) -> None:
        """Refuse new calls and stop the running ones."""
        self.capacity.close()
        if self.workers is not None:
            self.workers.close()


def create_services(settings: Settings) -> Services:
    """Create the parts of a server without loading or starting anything."""
    n_calls = concurrent_calls(settings)
    workers = None
    if settings.isolation != "in-process":
        limits = WorkerLimits(settings.max_worker_bytes, (os.cpu_count() or 1) * settings.deadline_s)
        workers = WorkerPool(partial(_worker_services, settings), limits)
    return _services(settings, n_calls, workers)


def _worker_services(settings: Settings) -> Services:
    """Create the parts of a worker process."""
    return _services(settings, 1, None)


def _services(settings: Settings, n_calls: int, workers: WorkerPool | None) -> Services:
    max_bytes = settings.image_limits.max_bytes
    return Services(
        settings=settings,
        models=Models(settings),
        sources=ImageSources(
            paths=PathAccess(settings.roots, settings.spelled_roots),
            fetcher=Fetcher(settings.image_hosts, max_bytes),
            max_bytes=max_bytes,
        ),
        capacity=Capacity(n_calls, settings.deadline_s),
        workers=workers,
    )


def concurrent_calls(settings: Settings) -> int:
    """Return the number of concurrent calls: the operator's, or one per CPU, at least two."""
    return settings.max_concurrency or max(2, os.cpu_count() or 1)
