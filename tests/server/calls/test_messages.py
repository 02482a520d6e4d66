"""A compromised worker can send any bytes; the server accepts only data of a fixed schema."""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import os
import pickle
import threading
import time
from collections.abc import Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.server.calls.working import Value, answered, done, number, ready
from vehanchor import measure_area
from vehanchor.records import AreaMeasurement
from vehanchor_server.app_page.panel import MAX_LINES, MAX_VEHICLES, Drawing, DrawnLine
from vehanchor_server.calls import messages, worker_log
from vehanchor_server.calls.job import Job
from vehanchor_server.calls.listed_vehicle import ListedVehicle
from vehanchor_server.calls.messages import (
    DRAWING,
    HEADER,
    MAX_RECORDS,
    RECORD,
    Limit,
    MessageError,
    Progressed,
    Refused,
    Replied,
    receive,
    receive_reply,
    send,
    send_reply,
)
from vehanchor_server.calls.reply import Reply
from vehanchor_server.calls.task import work
from vehanchor_server.errors import CallError
from vehanchor_server.resources import Resources
from vehanchor_server.services import Services
from vehanchor_server.tools.target import MAX_TARGETS

ONE_RECORD = Replied(n_records=1, drawing=False, picture=False)


@pytest.fixture
def pipe() -> Iterator[tuple[Connection, Connection]]:
    ours, theirs = multiprocessing.Pipe()
    with ours, theirs:
        yield ours, theirs


@pytest.mark.parametrize(
    "message",
    [
        Refused(code="image_undecodable", message="no JPEG."),
        Progressed(percent=50, message="searched 1 of 2 tiles"),
    ],
)
def test_a_message_arrives_as_it_was_sent(
    pipe: tuple[Connection, Connection], message: Any
) -> None:
    send(pipe[1], message)
    assert receive(pipe[0]) == message


def test_an_answer_arrives_with_its_pictures(pipe: tuple[Connection, Connection]) -> None:
    drawing = Drawing(
        vehicles=((1.5, 2, 3, 4, 5, 1, 1, 0),), vehicles_left_out=0, lines=(), length_over_width=2.2
    )
    reply = Reply((Value(value=1), Value(value="two")), b"\xff\xd8picture", drawing)
    send_reply(pipe[1], reply)
    header = receive(pipe[0])
    assert isinstance(header, Replied)
    assert receive_reply(pipe[0], header, Value) == reply


@contextlib.contextmanager
def sent_over(pipe: tuple[Connection, Connection], *parts: bytes) -> Iterator[None]:
    """Send parts in a thread, because a pipe may not hold them; close the reader at the end."""

    def send_all() -> None:
        with contextlib.suppress(OSError):  # the reader has refused one
            for part in parts:
                pipe[1].send_bytes(part)

    sender = threading.Thread(target=send_all)
    sender.start()
    try:
        yield
    finally:
        pipe[0].close()
        sender.join()


@pytest.mark.promise("messages")
@pytest.mark.parametrize(
    "sent",
    [
        b"",
        b"\x00" * 7,
        pickle.dumps(("value", os.system)),
        b"{}",
        b'{"kind":"refused","code":"x"}',
        b'{"kind":"refused","code":"x","message":"","more":1}',
        b'{"kind":"progressed","percent":NaN,"message":""}',
        b'{"kind":"progressed","percent":1e999,"message":""}',
        b'{"kind":"refused","code":"__class__ x","message":""}',
        b'{"kind":"replied","n_records":17,"drawing":false,"picture":false}',
        b"[" * 60_000,
        b"\xff\xfe",
        b'{"kind":"progressed","percent":' + b"9" * 60_000 + b',"message":""}',
    ],
)
def test_other_bytes_are_no_message(pipe: tuple[Connection, Connection], sent: bytes) -> None:
    with sent_over(pipe, sent), pytest.raises(MessageError):
        receive(pipe[0])


@given(st.binary(max_size=400))
def test_no_bytes_do_anything_but_be_refused(sent: bytes) -> None:
    ours, theirs = multiprocessing.Pipe()
    with ours, theirs:
        for kind in (None, Value, Drawing):
            theirs.send_bytes(sent)
            with pytest.raises(MessageError):
                receive(ours) if kind is None else receive_reply(ours, ONE_RECORD, kind)


@pytest.mark.promise("messages")
@pytest.mark.parametrize(
    "record", [b"[]", b"1", b'{"value":1,"other":2}', b"[" * 1_000, b'[{"value":1}]']
)
def test_an_answer_of_another_form_is_refused(
    pipe: tuple[Connection, Connection], record: bytes
) -> None:
    with sent_over(pipe, record), pytest.raises(MessageError):
        receive_reply(pipe[0], ONE_RECORD, Value)


@pytest.mark.slow
@pytest.mark.promise("messages")
@pytest.mark.parametrize("items", [b"{}", b"0", b"[]"])
@pytest.mark.parametrize(
    "field", ["outline", "warnings", "alternatives", "estimate", "vehicles", "lines"]
)
def test_a_worker_that_was_taken_over_does_not_freeze_the_server(field: str, items: bytes) -> None:
    """200,000 faulty items once took gigabytes and 20 s in the listening process."""
    header = ONE_RECORD.model_copy(update={"drawing": field in ("vehicles", "lines")})
    honest = b'{"value":1}' if header.drawing else b""
    # beyond the limit of bytes, of separators, and within both
    for n_items in (200_000, 12_000, 4_000):
        hostile = b'{"%s":[%s]}' % (field.encode(), b",".join([items] * n_items))
        pipe = multiprocessing.Pipe()
        started = time.process_time()
        parts = [*[honest] * header.drawing, hostile]
        with pipe[1], sent_over(pipe, *parts), pytest.raises((MessageError, OSError)):
            receive_reply(pipe[0], header, Value if header.drawing else AreaMeasurement)
        assert time.process_time() - started < 2


def test_only_the_first_fault_is_told(pipe: tuple[Connection, Connection]) -> None:
    drawing = b'{"vehicles":[%s],"vehicles_left_out":0,"lines":[]}' % b",".join([b"{}"] * 9_000)
    with sent_over(pipe, b'{"value":1}', drawing), pytest.raises(MessageError) as refused:
        receive_reply(pipe[0], ONE_RECORD.model_copy(update={"drawing": True}), Value)
    assert str(refused.value) == "Drawing: vehicles.0: tuple_type"


def size_of(record: Any) -> Limit:
    """What a limit counts of a message."""
    data = record.model_dump_json().encode()
    return Limit(len(data), sum(map(data.count, (b",", b"[", b"{"))))


def test_limits_are_at_most_twice_the_largest_honest_message(
    images: Path,
) -> None:
    rows = tuple((12345.5, 12345.5, 1234.5, 1234.5, -179.5, 1, i, 2) for i in range(MAX_VEHICLES))
    court = DrawnLine(points=((12345.5, 12345.5),) * 5, label="10.97 m, tennis court", closed=True)
    drawing = size_of(
        Drawing(
            vehicles=rows,
            vehicles_left_out=12345,
            lines=(court,) * MAX_LINES,
            length_over_width=None,
        )
    )
    record = size_of(largest_record(images))
    for honest, limit in ((drawing, DRAWING), (record, RECORD)):
        for most, allowed in zip(honest, limit, strict=True):
            assert most < allowed <= 2 * most
    assert (
        size_of(Refused(code="a" * 40, message="\u20ac" * messages.MAX_WORDS)).n_bytes
        < HEADER.n_bytes
    )
    assert MAX_RECORDS == MAX_TARGETS


def largest_record(images: Path) -> AreaMeasurement:
    """An area with an outline of 200 points in a large image, alternatives and ten warnings."""
    area = measure_area(images / "pool.png", box=(294, 324, 354, 432))
    notice = (
        area.warnings[0]
        if area.warnings
        else {"code": "many_vehicles_dropped", "message": "a" * 200}
    )
    raw = area.model_dump(mode="json")
    point = {"x_px": 123456.5, "y_px": 123456.5}
    raw["outline"] = [
        {"exterior": {"points": [point] * 104}, "holes": [{"points": [point] * 4}] * 24}
    ]
    raw["warnings"] = [notice] * 10
    return AreaMeasurement.model_validate(raw)


def test_a_picture_has_a_bound(pipe: tuple[Connection, Connection]) -> None:
    header = ONE_RECORD.model_copy(update={"picture": True})
    picture = bytes(messages.MAX_PICTURE_BYTES + 1)
    with (
        sent_over(pipe, b'{"value":1}', picture),
        pytest.raises(OSError, match="bad message length"),
    ):
        receive_reply(pipe[0], header, Value)


@work(Value)
def foreign_bytes(resources: Resources, job: Job, source: Any, hexadecimal: str) -> Reply[Value]:
    """Write bytes of the caller's choice where messages belong, as a compromised worker can."""
    import inspect

    callers = (caller.frame.f_locals for caller in inspect.stack())
    connection = next(names["connection"] for names in callers if "connection" in names)
    connection.send_bytes(bytes.fromhex(hexadecimal))
    threading.Event().wait()
    return answered(None)


@pytest.mark.slow
@pytest.mark.parametrize(
    "sent",
    [
        pickle.dumps(("value", os.system)),
        b"[" * 1_000_000,
        b'{"kind":"loaded","failure":null,"confinement":{"landlock":0,"seccomp":true,"lacks":""}}',
    ],
)
def test_a_worker_that_sends_other_bytes_is_ended(running: Services, sent: bytes) -> None:
    before = done(running, number)
    with pytest.raises(CallError, match="worker_killed"):
        done(running, foreign_bytes, sent.hex())  # although it waits for ever
    ready(running)
    assert done(running, number) != before


def forwarded(output: bytes, caplog: pytest.LogCaptureFixture) -> list[str]:
    """The lines of the log after a worker has said something and ended."""
    ours, theirs = multiprocessing.Pipe(duplex=False)
    with caplog.at_level(logging.WARNING):
        thread = worker_log.forward_log(ours, 4711)
        with theirs, os.fdopen(os.dup(theirs.fileno()), "wb") as stream:
            stream.write(output)
        thread.join(30)
    return [record.getMessage() for record in caplog.records]


@pytest.mark.promise("worker-log")
def test_a_workers_lines_are_labelled_without_control_characters(
    caplog: pytest.LogCaptureFixture,
) -> None:
    forged = b'plain\n\x1b[2J{"level": "INFO", "message": "call"}\r\n\xff\xe2\x80\xaeodd\n'
    lines = forwarded(forged, caplog)
    assert len(lines) == 3
    assert all(line.startswith("worker 4711: ") and line.isprintable() for line in lines)


@pytest.mark.promise("worker-log")
def test_a_workers_lines_are_limited(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(worker_log, "_MAX_LINES", 3)
    lines = forwarded(b"x" * 5000 + b"\n" + 9 * b"line\n", caplog)
    assert lines[0].endswith("x [cut]")
    assert len(lines[0]) < 2100
    assert lines[3:] == ["worker 4711: more than 3 lines; the rest is omitted"]


def test_the_listed_vehicles_arrive(pipe: tuple[Connection, Connection]) -> None:
    ours, theirs = pipe
    vehicles = (ListedVehicle(number=3, x_px=10.5, y_px=20.0, length_px=31.0, used=True),)
    send_reply(theirs, Reply((Value(value=1),), vehicles=vehicles))
    header = receive(ours)
    assert isinstance(header, Replied)
    assert receive_reply(ours, header, Value).vehicles == vehicles
