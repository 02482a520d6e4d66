"""Work of a call: its function, the types of its messages to a worker, and its execution in this process."""

from __future__ import annotations

import pkgutil
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeVar

from pydantic import BaseModel, TypeAdapter

from vehanchor_server.images.source import library_errors

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from vehanchor_server.calls.answer import Answer
    from vehanchor_server.calls.job import Job
    from vehanchor_server.images.argument import AnyImage
    from vehanchor_server.images.source import ImageSources
    from vehanchor_server.models import Models

Record = TypeVar("Record", bound=BaseModel)


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


class Work(Generic[Record]):
    """A kind of work on an image; the decorator ``work`` creates one from a function.

    Args:
        function: function of services, job, opened image and question; other images are a fifth argument.
        question: type of the question, a dataclass or pydantic model.
        record: type of the records in the answer.

    Attributes:
        function: the function.
        name: module and name by which a worker finds this object.
    """

    def __init__(self, function: Callable[..., Answer[Record]], question: Any, record: type[Record]) -> None:
        self.function = function
        self.name = f"{function.__module__}:{function.__name__}"
        self._question: Any = question
        self._records: Any = tuple[record, ...]  # type: ignore[valid-type]

    @cached_property
    def question(self) -> TypeAdapter[Any]:
        """Type adapter of the question."""
        return TypeAdapter(self._question)

    @cached_property
    def records(self) -> TypeAdapter[tuple[Record, ...]]:
        """Type adapter of the answer's records."""
        return TypeAdapter(self._records)


def work(question: Any, record: type[Record]) -> Callable[[Callable[..., Answer[Record]]], Work[Record]]:
    """Decorate a module-level function as work for workers.

    Args:
        question: type of the question.
        record: type of the records in the answer.
    """
    return lambda function: Work(function, question, record)


def named_work(name: str) -> Work[Any]:
    """Find work by its name, in a worker.

    Raises:
        TypeError: the name belongs to another object.
    """
    found = pkgutil.resolve_name(name)
    if not isinstance(found, Work):
        raise TypeError(f"{name} is a {type(found).__name__}, not a kind of work")
    return found


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


def perform(services: Parts, task: Task[Record], job: Job) -> Answer[Record]:
    """Open the image and do the work in this thread.

    Raises:
        CallError: the work failed with a remedy for the caller.
    """
    with services.sources.open(task.image, task.fetched) as source, library_errors(source):
        return task.work.function(services, job, source, task.question, *((task.more,) if task.more else ()))
