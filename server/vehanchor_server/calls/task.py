"""Work of a call: its function, the type of its records, and its execution in this process."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeVar

from pydantic import BaseModel

from vehanchor_server.images.source import library_errors

if TYPE_CHECKING:
    from collections.abc import Callable

    from vehanchor_server.calls.job import Job
    from vehanchor_server.calls.reply import Reply
    from vehanchor_server.images.argument import AnyImage
    from vehanchor_server.resources import Resources

Record = TypeVar("Record", bound=BaseModel)


class Work(Protocol[Record]):
    """Work of a call: a function of resources, job, opened image and question.

    Other images are a fifth argument.

    Attributes:
        record: type of the records in the reply.
    """

    record: type[Record]

    def __call__(self, *arguments: Any) -> Reply[Record]:
        """Do the work, in a worker process or thread.

        Raises:
            VehAnchorError: the library refused the image or an option.
            CallError: a model cannot be loaded, or another image is refused.
            CallStoppedError: the call was stopped.
        """


def work(record: type[Record]) -> Callable[[Callable[..., Reply[Record]]], Work[Record]]:
    """Decorate a module-level function as work for workers.

    Args:
        record: type of the records in the reply.
    """

    def decorate(function: Any) -> Work[Record]:
        function.record = record
        decorated: Work[Record] = function
        return decorated

    return decorate


@dataclass(frozen=True)
class Task(Generic[Record]):
    """Work of a call, as sent to a worker.

    Attributes:
        work: the kind of work.
        question: the caller's other arguments.
        images: the caller's image arguments, each with its bytes if it was fetched; the work opens
            all but the first.
    """

    work: Work[Record]
    question: Any
    images: tuple[tuple[AnyImage, bytes | None], ...]


def perform(resources: Resources, task: Task[Record], job: Job) -> Reply[Record]:
    """Open the first image and do the work in this thread.

    Raises:
        CallError: the work failed with a remedy for the caller.
    """
    (image, fetched), *more = task.images
    with resources.sources.open(image, fetched) as source, library_errors(source):
        if more:
            return task.work(resources, job, source, task.question, more)
        return task.work(resources, job, source, task.question)
