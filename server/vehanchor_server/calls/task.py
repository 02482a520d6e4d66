"""Task: the work of a call, for this process or a worker."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Generic, Protocol, TypeVar

from vehanchor_server.images.source import library_errors

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from vehanchor_server.calls.job import Job
    from vehanchor_server.images.argument import AnyImage
    from vehanchor_server.images.source import ImageSources
    from vehanchor_server.models import Models

Result = TypeVar("Result")


class Parts(Protocol):
    """The parts of ``Services`` that a task needs."""

    @property
    def sources(self) -> ImageSources:
        """Image sources."""

    @property
    def models(self) -> Models:
        """The operator's models."""

    @property
    def readable(self) -> tuple[Path, ...] | None:
        """Files and folders that workers may read; None for no confinement."""


@dataclass(frozen=True)
class Task(Generic[Result]):
    """Work of a call, as sent to a worker.

    Attributes:
        work: function of the worker's ``Services``: a module-level function or a ``functools.partial`` of one.
        image: the caller's image argument.
        fetched: bytes of a fetched image.
        more: other images with their bytes, which the work opens one at a time.
    """

    work: Callable[..., Result]
    image: AnyImage
    fetched: bytes | None
    more: tuple[tuple[AnyImage, bytes | None], ...] = ()


def perform(services: Parts, task: Task[Result], job: Job) -> Result:
    """Open the image and do the work in this thread.

    Raises:
        CallError: the work failed with a remedy for the caller.
    """
    with services.sources.open(task.image, task.fetched) as source, library_errors(source):
        return task.work(services, job, source, *((task.more,) if task.more else ()))
