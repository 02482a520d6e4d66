"""Work of a call: its function, the type of its records, and its execution in this process."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from pydantic import BaseModel

from vehanchor_server.images.source import library_errors

if TYPE_CHECKING:
    from collections.abc import Callable

    from vehanchor_server.calls.job import Job
    from vehanchor_server.calls.reply import Reply
    from vehanchor_server.images.argument import AnyImage
    from vehanchor_server.parts import Parts

Record = TypeVar("Record", bound=BaseModel)


class Work(Generic[Record]):
    """A kind of work on an image; the decorator ``work`` creates one from a module-level function.

    Attributes:
        function: function of services, job, opened image and question; other images are a fifth argument.
        record: type of the records in the reply.
    """

    def __init__(self, function: Callable[..., Reply[Record]], record: type[Record]) -> None:
        self.function = function
        self.record = record
        self.__module__ = function.__module__

    def __reduce__(self) -> str:
        """Pickle by name, like a function."""
        return self.function.__name__


def work(record: type[Record]) -> Callable[[Callable[..., Reply[Record]]], Work[Record]]:
    """Decorate a module-level function as work for workers.

    Args:
        record: type of the records in the reply.
    """
    return lambda function: Work(function, record)


@dataclass(frozen=True)
class Task(Generic[Record]):
    """Work of a call, as sent to a worker.

    Attributes:
        work: the kind of work.
        question: the caller's other arguments.
        image: the caller's image argument.
        fetched: bytes of a fetched image.
        more: other images with their bytes, which the work opens one at a time.
    """

    work: Work[Record]
    question: Any
    image: AnyImage
    fetched: bytes | None
    more: tuple[tuple[AnyImage, bytes | None], ...] = ()


def perform(services: Parts, task: Task[Record], job: Job) -> Reply[Record]:
    """Open the image and do the work in this thread.

    Raises:
        CallError: the work failed with a remedy for the caller.
    """
    with (
        job.stop.calling(job.cancellation.cancel),
        services.sources.open(task.image, task.fetched) as source,
        library_errors(source),
    ):
        return task.work.function(services, job, source, task.question, *((task.more,) if task.more else ()))
