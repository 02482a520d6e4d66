"""Messages between the server and its workers.

An image can compromise the worker that decodes it, so its messages are data: JSON that pydantic
models validate, and a picture as raw bytes. Size and number of separators are checked before
parsing, because an error for each of 200,000 empty objects takes gigabytes. A task goes the other
way, pickled, because workers trust the server.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, TypeAlias, TypeVar

from pydantic import Field, TypeAdapter, ValidationError

from vehanchor_server.app_page.panel import Drawing
from vehanchor_server.base_model import FrozenModel
from vehanchor_server.calls.listed_vehicle import MAX_LISTED, ListedVehicle
from vehanchor_server.calls.reply import Reply
from vehanchor_server.sandbox.confinement import Confinement

if TYPE_CHECKING:
    from collections.abc import Callable
    from multiprocessing.connection import Connection

    from pydantic import BaseModel

Parsed = TypeVar("Parsed")


class Limit(NamedTuple):
    """Limit on JSON: at most twice the largest honest message.

    ``tests/server/calls/test_messages.py`` makes that message.

    Attributes:
        n_bytes: size of the JSON.
        n_marks: number of commas, opening brackets and opening braces.
    """

    n_bytes: int
    n_marks: int


HEADER = Limit(64 << 10, 4_000)
RECORD = Limit(20 << 10, 1_400)
DRAWING = Limit(320 << 10, 48_000)
MAX_RECORDS = 16
MAX_PICTURE_BYTES = 2 << 20
MAX_WORDS = 8000  # characters of a message for people
BUG = "internal_error"


class MessageError(Exception):
    """The bytes are not a message of this protocol."""


class Loaded(FrozenModel):
    """The worker has started.

    Attributes:
        failure: error code of a model that cannot be loaded, or None.
        confinement: rights that the worker has dropped.
    """

    kind: Literal["loaded"] = "loaded"
    failure: str | None = Field(max_length=80)
    confinement: Confinement


class Progressed(FrozenModel):
    """Progress of the call."""

    kind: Literal["progressed"] = "progressed"
    percent: float = Field(ge=0, le=100)
    message: str = Field(max_length=200)


class Refused(FrozenModel):
    """The call failed.

    Attributes:
        code: error code; ``BUG`` for a bug of the work or of the start.
        message: problem and remedy for the caller; the traceback of a bug.
    """

    kind: Literal["refused"] = "refused"
    code: str = Field(max_length=40, pattern=r"^[a-z0-9_]+$")
    message: str = Field(max_length=MAX_WORDS)


class Replied(FrozenModel):
    """The work is done; records, drawing and picture follow.

    Attributes:
        n_records: number of records.
        drawing: whether a drawing follows.
        picture: whether a picture follows.
        vehicles: the listed vehicles; None unless the caller asks for them.
    """

    kind: Literal["replied"] = "replied"
    n_records: int = Field(ge=1, le=MAX_RECORDS)
    drawing: bool
    picture: bool
    vehicles: Annotated[tuple[ListedVehicle, ...] | None, Field(max_length=MAX_LISTED)] = None


WorkerMessage: TypeAlias = Loaded | Progressed | Refused | Replied
_WORKER_MESSAGE: TypeAdapter[WorkerMessage] = TypeAdapter(
    Annotated[WorkerMessage, Field(discriminator="kind")]
)


def send(connection: Connection, message: BaseModel) -> None:
    """Send a message or a part of a reply."""
    connection.send_bytes(message.model_dump_json().encode())


def send_reply(connection: Connection, reply: Reply[BaseModel]) -> None:
    """Send the reply of a call."""
    header = Replied(
        n_records=len(reply.records),
        drawing=reply.drawing is not None,
        picture=reply.picture is not None,
        vehicles=reply.vehicles,
    )
    send(connection, header)
    for record in reply.records:
        send(connection, record)
    if reply.drawing is not None:
        send(connection, reply.drawing)
    if reply.picture is not None:
        connection.send_bytes(reply.picture)


def receive(connection: Connection) -> WorkerMessage:
    """Receive the next message of a worker.

    Raises:
        EOFError: the process ended.
        OSError: the pipe broke, or the message is too large.
        MessageError: the bytes are not a message.
    """
    return _receive_json(connection, HEADER, _WORKER_MESSAGE.validate_json)


def receive_reply(connection: Connection, header: Replied, record: type[BaseModel]) -> Reply[Any]:
    """Receive the parts of a reply.

    Args:
        connection: the connection to the worker.
        header: the message before the parts.
        record: type of the records.

    Raises:
        EOFError: the process ended.
        OSError: the pipe broke, or a part is too large.
        MessageError: a part is not of its type.
    """
    records = []
    for _ in range(header.n_records):
        records.append(_receive_json(connection, RECORD, record.model_validate_json))
    drawing = None
    if header.drawing:
        drawing = _receive_json(connection, DRAWING, Drawing.model_validate_json)
    picture = None
    if header.picture:
        picture = connection.recv_bytes(MAX_PICTURE_BYTES)
    return Reply(tuple(records), picture=picture, drawing=drawing, vehicles=header.vehicles)


def _receive_json(
    connection: Connection, limit: Limit, validate: Callable[[bytes], Parsed]
) -> Parsed:
    """Receive and validate one part; check its size and structure before it is parsed."""
    data = connection.recv_bytes(limit.n_bytes)
    n_marks = data.count(b",") + data.count(b"[") + data.count(b"{")
    if n_marks > limit.n_marks:
        raise MessageError(f"{n_marks} separators, more than {limit.n_marks}")
    try:
        return validate(data)
    except ValidationError as error:
        # One fault is enough, and the log gets none of the possibly hostile input.
        first = error.errors(include_input=False, include_url=False)[0]
        where = ".".join(map(str, first["loc"]))[:200]
        raise MessageError(f"{error.title}: {where}: {first['type']}") from None
