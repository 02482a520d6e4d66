"""One call's work, and doing it: in this process and thread, or sent to another."""

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
    """The parts of a server that work needs: its ``Services``, which hold the workers as well."""

    @property
    def sources(self) -> ImageSources:
        """Where images come from."""

    @property
    def models(self) -> Models:
        """The operator's models."""

    @property
    def readable(self) -> tuple[Path, ...] | None:
        """Files and folders that work reads; None leaves it all that the server's user may read."""


@dataclass(frozen=True)
class Task(Generic[Result]):
    """One call's work, as it is sent to a worker.

    Attributes:
        work: does it with the ``Services`` of the process that it runs in; a function of a module, or a
            ``functools.partial`` of one.
        image: the caller's argument.
        fetched: its bytes, if it is a URL.
        more: other images and their bytes, which the work opens itself, one at a time.
    """

    work: Callable[..., Result]
    image: AnyImage
    fetched: bytes | None
    more: tuple[tuple[AnyImage, bytes | None], ...] = ()


def perform(services: Parts, task: Task[Result], job: Job) -> Result:
    """Open the image and do the work, in this process and thread.

    Raises:
        CallError: the work failed for a reason that its caller can act on.
    """
    with services.sources.open(task.image, task.fetched) as source, library_errors(source):
        return task.work(services, job, source, *((task.more,) if task.more else ()))
