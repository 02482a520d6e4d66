"""Connections that say nothing, or half of what they have to."""

from __future__ import annotations

import contextlib
import http.client
import itertools
import resource
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Iterator
from functools import partial
from typing import Any

import pytest
import uvicorn

from tests.server_process import SERVE
from vehanchor_server.transport.connections import (
    _IDLE_S,
    BACKLOG,
    ConnectionLimits,
    LimitedProtocol,
    within_open_files,
)

LIMITS = ConnectionLimits(total=8, per_address=6, head_s=0.3, body_s=0.5)
PATIENT = ConnectionLimits(total=8, per_address=6)
TIMED_OUT = b"HTTP/1.1 408 "
MANY = 600  # bytes of a trickle: a minute of them


async def app(scope: Any, receive: Any, send: Any) -> None:
    if scope["type"] != "http":
        return
    while (await receive()).get("more_body"):
        pass
    await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", b"2")]})
    await send({"type": "http.response.body", "body": b"ok"})


@contextlib.contextmanager
def served(limits: ConnectionLimits) -> Iterator[tuple[str, int]]:
    """The address of a server with such limits."""
    with socket.socket() as listener:
        listener.bind(("0.0.0.0", 0))
        limited: Any = partial(LimitedProtocol, limits=limits)
        config = uvicorn.Config(app, http=limited, lifespan="off", log_config=None, backlog=BACKLOG)
        server = uvicorn.Server(config)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, daemon=True)
        thread.start()
        while not server.started:
            time.sleep(0.01)
        yield "127.0.0.1", listener.getsockname()[1]
        server.should_exit = True
        thread.join(10)


@pytest.fixture(scope="module")
def address() -> Iterator[tuple[str, int]]:
    with served(LIMITS) as where:
        yield where


def last_words(connection: socket.socket) -> bytes:
    """What the server says until it hangs up."""
    connection.settimeout(30)
    said = b""
    with contextlib.suppress(ConnectionResetError):
        while part := connection.recv(4096):
            said += part
    return said


def answered(address: tuple[str, int]) -> bool:
    with urllib.request.urlopen(f"http://{address[0]}:{address[1]}/", timeout=30) as answer:
        return bool(answer.read() == b"ok")


def test_who_says_nothing_is_hung_up_on(address: tuple[str, int]) -> None:
    with socket.create_connection(address) as silent:
        assert last_words(silent).startswith(TIMED_OUT)


@pytest.mark.parametrize(
    "begun",
    [
        b"GET / HTTP/1.1\r\nHost: a\r\n",
        b"POST / HTTP/1.1\r\nHost: a\r\nContent-Length: 9999\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: a\r\n\r\nGET / HTTP/1.1\r\n",  # a second request, half of it
    ],
)
def test_a_trickle_does_not_keep_a_connection_open(address: tuple[str, int], begun: bytes) -> None:
    def trickle(slow: socket.socket) -> None:
        for _ in range(MANY):
            slow.sendall(b"x")
            time.sleep(0.1)

    with socket.create_connection(address) as slow:
        slow.sendall(begun)
        with pytest.raises((BrokenPipeError, ConnectionResetError)):
            trickle(slow)
    assert answered(address)


def test_a_connection_may_wait_between_requests(address: tuple[str, int]) -> None:
    with contextlib.closing(http.client.HTTPConnection(*address, timeout=30)) as client:
        for pause_s in (2 * LIMITS.head_s, 0):  # longer than a head may take
            client.request("GET", "/")
            answer = client.getresponse()
            answer.read()  # whole: it may come in several pieces
            assert answer.status == 200
            time.sleep(pause_s)


def test_an_address_has_so_many_connections_and_no_more() -> None:
    with served(PATIENT) as address, contextlib.ExitStack() as stack:
        idle = [stack.enter_context(socket.create_connection(address)) for _ in range(PATIENT.per_address)]
        extra = stack.enter_context(socket.create_connection(address))
        assert last_words(extra) == b""  # at once, or it would be told of its time
        other = stack.enter_context(socket.socket())
        other.bind(("127.0.0.2", 0))
        other.settimeout(30)
        other.connect(address)
        other.sendall(b"GET / HTTP/1.1\r\nHost: a\r\n\r\n")
        assert other.recv(4096).startswith(b"HTTP/1.1 200")
        assert len(idle) == PATIENT.per_address


def test_an_idle_connection_gives_way_to_a_new_one() -> None:
    with served(PATIENT) as address, contextlib.ExitStack() as stack:
        for i in range(PATIENT.total):
            idle = stack.enter_context(socket.socket())
            idle.bind((f"127.0.0.{2 + i % 2}", 0))
            idle.connect(address)
        time.sleep(2 * _IDLE_S)
        assert answered(address)


def test_limits_fit_into_the_open_files_that_the_system_allows(monkeypatch: pytest.MonkeyPatch) -> None:
    for n_files in (64, 256, 1024, 65_536):
        monkeypatch.setattr(resource, "getrlimit", lambda _, n=n_files: (n, n))
        limits, backlog = within_open_files(ConnectionLimits(total=512), 2)
        assert limits.total + backlog <= n_files - 40
        assert limits.total >= min(512, n_files // 8)
    assert (limits.total, backlog) == (512, BACKLOG)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="sets the limit on open files of a child")
def test_a_server_with_64_open_files_answers_beside_80_idle_sockets() -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    url = f"http://127.0.0.1:{port}/healthz"
    files = partial(resource.setrlimit, resource.RLIMIT_NOFILE, (64, 64))
    with subprocess.Popen([*SERVE, "--http", "--port", str(port)], stderr=subprocess.PIPE, preexec_fn=files) as server:
        try:
            deadline = time.monotonic() + 60
            while True:
                with contextlib.suppress(OSError), urllib.request.urlopen(url, timeout=5):
                    break
                assert time.monotonic() < deadline
                time.sleep(0.1)
            with contextlib.ExitStack() as stack:
                for _ in range(80):
                    idle = stack.enter_context(socket.socket())
                    idle.setblocking(False)
                    idle.connect_ex(("127.0.0.1", port))
                started, answers = time.monotonic(), []
                while time.monotonic() < started + 12:
                    with contextlib.suppress(OSError), urllib.request.urlopen(url, timeout=1):
                        answers.append(time.monotonic() - started)
                    time.sleep(0.1)
        finally:
            server.terminate()
            assert server.stderr is not None
            log = server.stderr.read()
    pauses = [after - before for before, after in itertools.pairwise([0.0, *answers, 12.0])]
    assert max(pauses) < 3, answers
    assert len(log) < 20_000
    assert b"ulimit -n is 64" in log


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="sets the limit on open files of a child")
def test_more_idle_sockets_than_open_files_leave_the_server_answering_and_its_log_small() -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    with subprocess.Popen(
        [*SERVE, "--http", "--port", str(port), "--max-connections-per-address", "400"],
        stderr=subprocess.PIPE,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_NOFILE, (1024, 1024)),
    ) as server:
        url = f"http://127.0.0.1:{port}/healthz"
        try:
            deadline = time.monotonic() + 60
            while True:
                with contextlib.suppress(OSError), urllib.request.urlopen(url, timeout=5):
                    break
                assert time.monotonic() < deadline
                time.sleep(0.1)
            with contextlib.ExitStack() as stack:
                sockets = []
                for i in range(1100):
                    one = stack.enter_context(socket.socket())
                    one.bind((f"127.0.0.{2 + i % 4}", 0))
                    one.setblocking(False)
                    one.connect_ex(("127.0.0.1", port))
                    sockets.append(one)
                ok = 0
                until = time.monotonic() + 24  # idle ones are hung up on after 20 s
                while time.monotonic() < until:
                    with contextlib.suppress(OSError), urllib.request.urlopen(url, timeout=1):
                        ok += 1
                    time.sleep(0.1)
                with urllib.request.urlopen(url, timeout=2) as answer:
                    assert answer.status == 200
                assert ok > 0
        finally:
            server.terminate()
            assert server.stderr is not None
            log = server.stderr.read()
        assert len(log) < 100_000
