"""What a worker prints reaches the log labelled, limited and without control characters."""

from __future__ import annotations

import logging
import multiprocessing
import os

import pytest

from vehanchor_server.calls import worker_log


def forwarded(said: bytes, caplog: pytest.LogCaptureFixture) -> list[str]:
    """The lines of the log after a worker has said something and ended."""
    ours, theirs = multiprocessing.Pipe(duplex=False)
    with caplog.at_level(logging.WARNING):
        thread = worker_log.forward_log(ours, 4711)
        with theirs, os.fdopen(os.dup(theirs.fileno()), "wb") as stream:
            stream.write(said)
        thread.join(30)
    return [record.getMessage() for record in caplog.records]


@pytest.mark.promise("worker-log")
def test_a_workers_lines_are_labelled_and_have_no_control_characters(caplog: pytest.LogCaptureFixture) -> None:
    forged = b'plain\n\x1b[2J{"level": "INFO", "message": "call"}\r\n\xff\xe2\x80\xaeodd\n'
    found = forwarded(forged, caplog)
    assert len(found) == 3
    assert all(line.startswith("worker 4711: ") and line.isprintable() for line in found)


@pytest.mark.promise("worker-log")
def test_a_workers_lines_are_limited_in_length_and_number(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(worker_log, "_MAX_LINES", 3)
    found = forwarded(b"x" * 5000 + b"\n" + 9 * b"line\n", caplog)
    assert found[0].endswith("x [cut]")
    assert len(found[0]) < 2100
    assert found[3:] == ["worker 4711: more than 3 lines; the rest is omitted"]
