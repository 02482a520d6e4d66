"""A compromised worker sends bytes; the server takes data of a fixed schema from it, and nothing else."""

from __future__ import annotations

import json
import multiprocessing
import os
import pickle
import struct
import subprocess
import threading
import time
from collections.abc import Iterator
from multiprocessing.connection import Connection
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.server.calls.working import IMAGE, Value, answered, done, number, ready
from vehanchor_server.calls import messages
from vehanchor_server.calls.answer import Answer
from vehanchor_server.calls.job import Job
from vehanchor_server.calls.messages import (
    Answered,
    Entered,
    MessageError,
    Progressed,
    Refused,
    read_answer,
    receive,
    receive_task,
    send,
    send_answer,
    send_task,
)
from vehanchor_server.calls.task import Task, named_work, work
from vehanchor_server.errors import CallError
from vehanchor_server.images.argument import Base64Image, PathImage, UrlImage
from vehanchor_server.services import Services

TASK = Task(number, None, IMAGE, None)


def packed(*parts: bytes) -> bytes:
    """Parts as a message has them."""
    return struct.pack(f"<{1 + len(parts)}Q", len(parts), *map(len, parts)) + b"".join(parts)


@pytest.fixture
def pipe() -> Iterator[tuple[Connection, Connection]]:
    ours, theirs = multiprocessing.Pipe()
    with ours, theirs:
        yield ours, theirs


@pytest.mark.parametrize("message", [Entered(stage="decode"), Progressed(percent=50, message="searched 1 of 2 tiles")])
def test_a_message_arrives_as_it_was_sent(pipe: tuple[Connection, Connection], message: Any) -> None:
    send(pipe[1], message)
    assert receive(pipe[0]) == (message, [])


def test_an_answer_arrives_with_its_pictures(pipe: tuple[Connection, Connection]) -> None:
    answer = Answer((Value(value=1), Value(value="two")), b"\xff\xd8overlay", None, b"\xff\xd8page", None)
    send_answer(pipe[1], answer)
    header, parts = receive(pipe[0])
    assert isinstance(header, Answered)
    assert read_answer(header, parts, TASK) == answer


@pytest.mark.parametrize(
    ("image", "fetched"),
    [
        (PathImage(kind="path", path="/data/Straße.png"), None),
        (Base64Image(kind="base64", data="QUJD"), None),
        (UrlImage(kind="url", url="https://example.org/a.png"), b"\x89PNG"),
    ],
)
def test_a_task_arrives_as_it_was_sent(pipe: tuple[Connection, Connection], image: Any, fetched: bytes | None) -> None:
    task = Task(number, None, image, fetched, ((image, fetched), (IMAGE, None)))
    send_task(pipe[0], task)
    assert receive_task(pipe[1]) == task


@pytest.mark.parametrize(
    "sent",
    [
        b"",
        b"\x00" * 7,
        pickle.dumps(("value", os.system)),
        pickle.dumps(("value", subprocess.run)),
        packed(b"{}"),
        packed(b'{"kind":"entered"}'),
        packed(b'{"kind":"entered","stage":"decode","more":1}'),
        packed(b'{"kind":"entered","stage":"\\u001b[2J"}'),
        packed(b'{"kind":"progressed","percent":NaN,"message":""}'),
        packed(b'{"kind":"progressed","percent":1e999,"message":""}'),
        packed(b'{"kind":"refused","code":"__class__ x","message":""}'),
        packed(b"[" * 100_000),
        packed(b'{"kind":' * 50_000),
        packed(b"\xff\xfe"),
        packed(b'{"kind":"progressed","percent":' + b"9" * 200_000 + b',"message":""}'),
        packed(b" " * (messages.MAX_HEADER_BYTES + 1)),
        struct.pack("<2Q", 1, 1 << 63),
        struct.pack("<Q", 1 << 62),
        struct.pack("<3Q", 2, 1, 1) + b"{",
    ],
)
def test_other_bytes_are_no_message(pipe: tuple[Connection, Connection], sent: bytes) -> None:
    sender = threading.Thread(target=pipe[1].send_bytes, args=(sent,))  # more than a socket holds
    sender.start()
    with pytest.raises(MessageError):
        receive(pipe[0])
    sender.join()


@given(st.binary(max_size=400))
def test_no_bytes_do_anything_but_be_refused(sent: bytes) -> None:
    ours, theirs = multiprocessing.Pipe()
    with ours, theirs:
        for message in (sent, packed(sent), packed(sent, sent)):
            theirs.send_bytes(message)
            with pytest.raises(MessageError):
                receive(ours)


@pytest.mark.parametrize(
    "parts",
    [
        [],
        [b"[]"],
        [b"[1]"],
        [b"{}"],
        [b'[{"value":1,"other":2}]'],
        [b'[{"value":1}]', b"picture"],
        [b"[" * 100_000],
        [b" " * (messages.MAX_RECORDS_BYTES + 1)],
    ],
)
def test_an_answer_of_another_form_is_refused(parts: list[bytes]) -> None:
    header = Answered(overlay=False, page_picture=False, histogram=None, drawing=None)
    with pytest.raises(MessageError):
        read_answer(header, parts, TASK)


def test_a_picture_has_a_bound() -> None:
    header = Answered(overlay=True, page_picture=False, histogram=None, drawing=None)
    with pytest.raises(MessageError, match="too large"):
        read_answer(header, [b'[{"value":1}]', bytes(messages.MAX_PICTURE_BYTES + 1)], TASK)


def test_a_larger_message_is_not_read(pipe: tuple[Connection, Connection]) -> None:
    os.write(pipe[1].fileno(), struct.pack("!i", messages.MAX_ANSWER_BYTES + 1))
    with pytest.raises(OSError, match="bad message length"):
        receive(pipe[0])


def test_only_work_can_be_named() -> None:
    with pytest.raises(TypeError, match="not a kind of work"):
        named_work("os:system")


@work(str, Value)
def foreign_bytes(services: Services, job: Job, source: Any, hexadecimal: str) -> Answer[Value]:
    """Write bytes of the caller's choice where messages belong, as a compromised worker can."""
    import gc

    (connection,) = (each for each in gc.get_objects() if isinstance(each, Connection) and not each.closed)
    connection.send_bytes(bytes.fromhex(hexadecimal))
    time.sleep(5)
    return answered(None)


@pytest.mark.slow
@pytest.mark.parametrize(
    "sent",
    [
        pickle.dumps(("value", os.system)),
        packed(b"[" * 1_000_000),
        packed(json.dumps({"kind": "broken", "traceback": ""}).encode()),
    ],
)
def test_a_worker_that_sends_other_bytes_is_ended(running: Services, sent: bytes) -> None:
    before = done(running, number)
    with pytest.raises(CallError, match="worker_killed"):
        done(running, foreign_bytes, sent.hex())
    ready(running)
    assert done(running, number) != before


def test_a_refusal_keeps_its_code(pipe: tuple[Connection, Connection]) -> None:
    send(pipe[1], Refused(code="image_undecodable", message="no JPEG."))
    assert receive(pipe[0])[0] == Refused(code="image_undecodable", message="no JPEG.")
