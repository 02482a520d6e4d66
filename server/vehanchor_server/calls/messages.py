"""Messages between the server and its workers: data with a fixed schema and limits.

An image can compromise the worker that decodes it, so a worker's message must not run code in the server. A message
has a few parts with their lengths: JSON that pydantic models validate, and pictures as raw bytes. The number and size
of the parts are checked before parsing; pydantic's parser limits the depth.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias

from pydantic import Field, TypeAdapter, ValidationError

from vehanchor_server.app_page.panel import Drawing, LengthHistogram
from vehanchor_server.calls.answer import Answer
from vehanchor_server.calls.task import Task, named_work
from vehanchor_server.frozen import FrozenModel
from vehanchor_server.images.argument import AnyImage, Base64Image, PathImage, UrlImage

if TYPE_CHECKING:
    from collections.abc import Sequence
    from multiprocessing.connection import Connection

    from pydantic import BaseModel

MAX_HEADER_BYTES = 256 << 10
MAX_RECORDS_BYTES = 8 << 20  # an outline of 16 objects has 1 MiB
MAX_PICTURE_BYTES = 2 << 20
MAX_ANSWER_BYTES = MAX_HEADER_BYTES + MAX_RECORDS_BYTES + 2 * MAX_PICTURE_BYTES
_MAX_PARTS = 256
_LENGTH = struct.Struct("<Q")
MAX_WORDS = 8000  # characters of a message for people


class MessageError(Exception):
    """The bytes are not a message of this protocol."""


class Loaded(FrozenModel):
    """The worker has loaded its models, or failed to; its confinement."""

    kind: Literal["loaded"] = "loaded"
    failure: str | None = Field(max_length=80)
    landlock: int = Field(ge=0, le=1000)
    seccomp: bool
    lacks: str = Field(max_length=MAX_WORDS)


class Broken(FrozenModel):
    """The worker cannot start."""

    kind: Literal["broken"] = "broken"
    traceback: str = Field(max_length=MAX_WORDS)


class Entered(FrozenModel):
    """A stage of the call began."""

    kind: Literal["entered"] = "entered"
    stage: str = Field(max_length=40, pattern=r"^[a-z_]+$")


class Progressed(FrozenModel):
    """Progress of the call."""

    kind: Literal["progressed"] = "progressed"
    percent: float = Field(ge=0, le=100)
    message: str = Field(max_length=200)


class Refused(FrozenModel):
    """The call failed with a remedy for the caller."""

    kind: Literal["refused"] = "refused"
    code: str = Field(max_length=40, pattern=r"^[a-z0-9_]+$")
    message: str = Field(max_length=MAX_WORDS)


class Exhausted(FrozenModel):
    """The worker ran out of memory."""

    kind: Literal["exhausted"] = "exhausted"


class Failed(FrozenModel):
    """The work has a bug."""

    kind: Literal["failed"] = "failed"
    traceback: str = Field(max_length=MAX_WORDS)


class Answered(FrozenModel):
    """The work is done; records and pictures are further parts of the message."""

    kind: Literal["answered"] = "answered"
    overlay: bool
    page_picture: bool
    histogram: LengthHistogram | None
    drawing: Drawing | None


WorkerMessage: TypeAlias = Loaded | Broken | Entered | Progressed | Refused | Exhausted | Failed | Answered
_WORKER_MESSAGE: TypeAdapter[WorkerMessage] = TypeAdapter(Annotated[WorkerMessage, Field(discriminator="kind")])


class _NamedImage(FrozenModel):
    """An image of a task; the bytes of a sent or fetched image are a separate part."""

    kind: Literal["path", "base64", "url"]
    name: str = ""
    attached: bool


class _TaskHeader(FrozenModel):
    """A task for a worker; the question and the images' bytes are further parts of the message."""

    work: str
    images: tuple[_NamedImage, ...] = Field(min_length=1)


def send(connection: Connection, message: WorkerMessage) -> None:
    """Send a message without an answer."""
    connection.send_bytes(_pack([message.model_dump_json().encode()]))


def send_answer(connection: Connection, answer: Answer[BaseModel]) -> None:
    """Send the answer of a call."""
    header = Answered(
        overlay=answer.overlay is not None,
        page_picture=answer.page_picture is not None,
        histogram=answer.histogram,
        drawing=answer.drawing,
    )
    records = b"[" + b",".join(record.model_dump_json().encode() for record in answer.records) + b"]"
    pictures = [picture for picture in (answer.overlay, answer.page_picture) if picture is not None]
    connection.send_bytes(_pack([header.model_dump_json().encode(), records, *pictures]))


def receive(connection: Connection) -> tuple[WorkerMessage, list[bytes]]:
    """Receive the next message of a worker.

    Returns:
        The message and the parts after its header.

    Raises:
        EOFError: the process ended.
        OSError: the pipe broke, or the message is too large.
        MessageError: the bytes are not a message.
    """
    header, *parts = _unpack(connection.recv_bytes(MAX_ANSWER_BYTES))
    if len(header) > MAX_HEADER_BYTES:
        raise MessageError(f"a header of {len(header)} bytes")
    try:
        return _WORKER_MESSAGE.validate_json(header), parts
    except ValidationError as error:
        raise MessageError(_summary(error)) from None


def read_answer(header: Answered, parts: Sequence[bytes], task: Task[Any]) -> Answer[Any]:
    """Validate the answer to a task.

    Raises:
        MessageError: the message is not an answer to this task.
    """
    if len(parts) != 1 + header.overlay + header.page_picture or len(parts[0]) > MAX_RECORDS_BYTES:
        raise MessageError("an answer whose parts contradict its header")
    if any(len(picture) > MAX_PICTURE_BYTES for picture in parts[1:]):
        raise MessageError("a picture above the size limit")
    try:
        records = task.work.records.validate_json(parts[0])
    except ValidationError as error:
        raise MessageError(_summary(error)) from None
    if not records:
        raise MessageError("an answer without a record")
    pictures = iter(parts[1:])
    overlay = next(pictures) if header.overlay else None
    page_picture = next(pictures) if header.page_picture else None
    return Answer(records, overlay, header.histogram, page_picture, header.drawing)


def send_task(connection: Connection, task: Task[Any]) -> None:
    """Send a task to a worker."""
    named, attached = [], []
    for image, fetched in ((task.image, task.fetched), *task.more):
        content = image.data.encode() if isinstance(image, Base64Image) else fetched
        name = image.path if isinstance(image, PathImage) else image.url if isinstance(image, UrlImage) else ""
        named.append(_NamedImage(kind=image.kind, name=name, attached=content is not None))
        attached += [content] if content is not None else []
    header = _TaskHeader(work=task.work.name, images=tuple(named))
    question = task.work.question.dump_json(task.question)
    connection.send_bytes(_pack([header.model_dump_json().encode(), question, *attached]))


def receive_task(connection: Connection) -> Task[Any]:
    """Receive the next task, in a worker.

    Raises:
        EOFError: the server ended.
        MessageError: the bytes are not a task.
    """
    header_json, question_json, *attached = _unpack(connection.recv_bytes())
    try:
        header = _TaskHeader.model_validate_json(header_json)
        work = named_work(header.work)
        question = work.question.validate_json(question_json)
    except ValidationError as error:
        raise MessageError(_summary(error)) from None
    contents = iter(attached)
    images = [_image(named, next(contents) if named.attached else None) for named in header.images]
    (image, fetched), *more = images
    return Task(work, question, image, fetched, tuple(more))


def _image(named: _NamedImage, content: bytes | None) -> tuple[AnyImage, bytes | None]:
    if named.kind == "path":
        return PathImage(kind="path", path=named.name), None
    if named.kind == "url":
        return UrlImage(kind="url", url=named.name), content
    return Base64Image(kind="base64", data=(content or b"").decode()), None


def _pack(parts: Sequence[bytes]) -> bytes:
    """Join parts after their number and lengths."""
    lengths = [_LENGTH.pack(len(parts)), *(_LENGTH.pack(len(part)) for part in parts)]
    return b"".join((*lengths, *parts))


def _unpack(message: bytes) -> list[bytes]:
    """Split a message into its parts.

    Raises:
        MessageError: the lengths contradict the bytes.
    """
    size = _LENGTH.size
    if len(message) < size or not 1 <= (n_parts := _LENGTH.unpack_from(message)[0]) <= _MAX_PARTS:
        raise MessageError("no number of parts")
    at = size * (1 + n_parts)
    if len(message) < at:
        raise MessageError("fewer lengths than parts")
    lengths = [_LENGTH.unpack_from(message, size * (1 + place))[0] for place in range(n_parts)]
    if at + sum(lengths) != len(message):
        raise MessageError("parts of other lengths than announced")
    parts = []
    for length in lengths:
        parts.append(message[at : at + length])
        at += length
    return parts


def _summary(error: ValidationError) -> str:
    """Return the first problem, without the possibly hostile input."""
    first = error.errors(include_input=False, include_url=False)[0]
    return f"{error.title}: {'.'.join(map(str, first['loc']))[:200]}: {first['type']}"
