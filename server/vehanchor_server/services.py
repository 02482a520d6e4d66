"""Shared parts of one server: its options, models, images and places for calls."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from vehanchor_server.calls.capacity import Capacity
from vehanchor_server.calls.worker_process import WorkerLimits
from vehanchor_server.calls.workers import WorkerPool
from vehanchor_server.images.fetch import Fetcher
from vehanchor_server.images.path_access import PathAccess
from vehanchor_server.images.source import ImageSources
from vehanchor_server.models import Models
from vehanchor_server.settings import Settings


@dataclass(frozen=True)
class Services:
    """Everything that tools work with; one for each server.

    Attributes:
        settings: the operator's options.
        models: the operator's models.
        sources: where images come from.
        capacity: how much runs at once.
        workers: the processes that work; None where this one does.
    """

    settings: Settings
    models: Models
    sources: ImageSources
    capacity: Capacity
    workers: WorkerPool | None = None

    @property
    def readable(self) -> tuple[Path, ...] | None:
        """Files and folders that work reads; None leaves it all that the server's user may read.

        Drivers of accelerators need devices, sockets and caches of their own.
        """
        providers = {name.strip().lower().removesuffix("executionprovider") for name in self.settings.providers}
        if self.settings.unconfined or providers - {"cpu"}:
            return None
        return (*self.settings.roots, *self.models.files())

    @property
    def ready(self) -> bool:
        """Whether a call can start at once."""
        return self.models.ready if self.workers is None else self.workers.ready

    @property
    def failure(self) -> str | None:
        """The code of the error that loading the models ended with, None without one."""
        return self.models.failure if self.workers is None else self.workers.failure

    def preload(self, delay_s: float = 0.0) -> None:
        """Load the models in the background, after a while, wherever they run."""
        if self.workers is None:
            self.models.preload(delay_s)
        else:
            self.workers.start(delay_s)

    def close(self) -> None:
        """Accept no more calls, and stop those that run."""
        self.capacity.close()
        if self.workers is not None:
            self.workers.close()


def create_services(settings: Settings) -> Services:
    """Make the parts of a server; nothing is loaded or started yet."""
    n_calls = settings.max_concurrency or _default_concurrency()
    workers = None
    if not settings.in_process:
        limits = WorkerLimits(settings.max_worker_bytes, (os.cpu_count() or 1) * settings.deadline_s)
        workers = WorkerPool(partial(_working_services, settings), n_calls, limits)
    return _services(settings, n_calls, workers)


def _working_services(settings: Settings) -> Services:
    """The parts of a worker, which has no workers itself."""
    return _services(settings, 1, None)


def _services(settings: Settings, n_calls: int, workers: WorkerPool | None) -> Services:
    max_bytes = settings.image_limits.max_bytes
    return Services(
        settings=settings,
        models=Models(settings),
        sources=ImageSources(
            paths=PathAccess(settings.roots, settings.spelled_roots),
            fetcher=Fetcher(settings.image_hosts, max_bytes, settings.fetch_timeout_s),
            max_bytes=max_bytes,
        ),
        capacity=Capacity(n_calls, settings.deadline_s),
        workers=workers,
    )


def _default_concurrency() -> int:
    """One call for each CPU, and two at least."""
    return max(2, os.cpu_count() or 1)
