"""One call's work: its function, the types of what crosses to a worker, and running it in this process."""

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


class Work(Generic[Record]):
    """A kind of work on an image; ``work`` makes one of a function.

    Args:
        function: does the work with services, job, opened image and question; for calls with more images it gets
            these as a fifth argument.
        question: type of the question, a dataclass or pydantic model.
        record: type of the records in the answer.

    Attributes:
        function: as above.
        name: module and name under which a worker finds this object.
    """

    def __init__(self, function: Callable[..., Answer[Record]], question: Any, record: type[Record]) -> None:
        self.function = function
        self.name = f"{function.__module__}:{function.__name__}"
        self._question: Any = question
        self._records: Any = tuple[record, ...]  # type: ignore[valid-type]

    @cached_property
    def question(self) -> TypeAdapter[Any]:
        """Validates and writes the question."""
        return TypeAdapter(self._question)

    @cached_property
    def records(self) -> TypeAdapter[tuple[Record, ...]]:
        """Validates the records of an answer."""
        return TypeAdapter(self._records)


def work(question: Any, record: type[Record]) -> Callable[[Callable[..., Answer[Record]]], Work[Record]]:
    """Make a function of a module a kind of work that workers do.

    Args:
        question: type of what the function is asked.
        record: type of the records that it answers with.
    """
    return lambda function: Work(function, question, record)


def named_work(name: str) -> Work[Any]:
    """Find the work that the server names; called by a worker.

    Raises:
        TypeError: the name is of something else.
    """
    found = pkgutil.resolve_name(name)
    if not isinstance(found, Work):
        raise TypeError(f"{name} is a {type(found).__name__}, not a kind of work")
    return found


@dataclass(frozen=True)
class Task(Generic[Record]):
    """One call's work, as it is sent to a worker.

    Attributes:
        work: the kind of work.
        question: what the caller wants to know.
        image: the caller's argument.
        fetched: its bytes, if it is a URL.
        more: other images and their bytes, which the work opens itself, one at a time.
    """

    work: Work[Record]
    question: Any
    image: AnyImage
    fetched: bytes | None
    more: tuple[tuple[AnyImage, bytes | None], ...] = ()


def perform(services: Parts, task: Task[Record], job: Job) -> Answer[Record]:
    """Open the image and do the work, in this process and thread.

    Raises:
        CallError: the work failed for a reason that its caller can act on.
    """
    with services.sources.open(task.image, task.fetched) as source, library_errors(source):
        return task.work.function(services, job, source, task.question, *((task.more,) if task.more else ()))
