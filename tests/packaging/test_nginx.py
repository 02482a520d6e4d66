"""examples/deploy/nginx.conf before two servers, on the loopback interface: nothing lost, also when one dies."""

from __future__ import annotations

import base64
import os
import re
import signal
import socket
import subprocess
import threading
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import anyio
import httpx2
import pytest
from mcp import Client, MCPError

from tests.conftest import ROOT
from tests.needs import needed_program
from tests.packaging.container import free_port
from tests.server.transport.test_http import discover
from tests.server_process import http_server, write_images
from vehanchor import estimate_gsd

pytestmark = [pytest.mark.nginx, pytest.mark.timeout(900)]

N_CALLS = 96
N_CLIENTS = 6
LONGEST_S = 400
# calls at a time; connections of each kind
N_HONEST = 40
N_IDLE = 512
IDLE_FOR_S = 30.0
LONGEST_WAIT_S = 1.0
Call = tuple[dict[str, Any], float | None]  # the image argument, and the scale that must come back


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


@dataclass(frozen=True)
class Deployment:
    """nginx and what is behind it."""

    url: str
    servers: list[tuple[str, int]]  # address and process
    log: Path
    calls: list[Call]

    def asked(self) -> Counter[str]:
        """How many requests each server answered, by nginx's log; one that was retried names both."""
        return Counter(
            re.findall(r"127\.0\.0\.1:\d+(?=,|$)", self.log.read_text(), flags=re.MULTILINE)
        )


@pytest.fixture
def deployment(tmp_path: Path) -> Iterator[Deployment]:
    needed_program("nginx", "apt-get install nginx-light")
    images = tmp_path / "images"
    images.mkdir()
    calls: list[Call] = []
    for path in write_images(images):
        gsd = estimate_gsd(path).gsd_m_per_px
        # 2 MB: more than nginx keeps in memory
        encoded = base64.b64encode(path.read_bytes()).decode()
        calls += [
            ({"kind": "path", "path": str(path)}, gsd),
            ({"kind": "base64", "data": encoded}, gsd),
        ]
    with ExitStack() as stack:
        flags = ("--root", str(images), "--threads", "1")
        servers = [stack.enter_context(http_server(*flags)) for _ in range(2)]
        addresses = [server.url.removeprefix("http://").removesuffix("/mcp") for server in servers]
        url = stack.enter_context(nginx_before(addresses, tmp_path))
        behind = [(address, server.pid) for address, server in zip(addresses, servers, strict=True)]
        yield Deployment(url, behind, log=tmp_path / "access.log", calls=calls)


@contextmanager
def nginx_before(addresses: list[str], tmp_path: Path) -> Iterator[str]:
    """The URL of nginx as the deployment sets it up, before these servers."""
    nginx = needed_program("nginx", "apt-get install nginx-light")
    port = free_port()
    text = (ROOT / "examples/deploy/nginx.conf").read_text()
    rule = re.search(r"server vehanchor:8000(.*?;)", text)
    assert rule is not None
    text = text.replace(
        rule.group(), " ".join(f"server {address}{rule.group(1)}" for address in addresses)
    )
    text = text.replace("listen 8080;", f"listen 127.0.0.1:{port};").replace(
        "/tmp/", f"{tmp_path}/"
    )
    text = text.replace("/dev/stdout", f"{tmp_path}/access.log")
    configuration = tmp_path / "nginx.conf"
    configuration.write_text(text)
    # or root's workers become nobody, who may not write to tmp_path
    own = "user root;" if os.geteuid() == 0 else ""
    command = [
        nginx,
        "-c",
        str(configuration),
        "-e",
        str(tmp_path / "error.log"),
        "-g",
        f"daemon off; {own}",
    ]
    checked = subprocess.run([*command, "-t"], capture_output=True, text=True, check=False)
    assert checked.returncode == 0, checked.stderr
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    try:
        deadline = time.monotonic() + 10
        while not (tmp_path / "nginx.pid").exists():
            assert process.poll() is None, (tmp_path / "error.log").read_text()
            assert time.monotonic() < deadline
            time.sleep(0.05)
        yield f"http://127.0.0.1:{port}/mcp"
    finally:
        process.send_signal(signal.SIGQUIT)
        process.wait(30)


async def _answer(url: str, image: dict[str, Any], tally: Counter[str]) -> float | None:
    """The scale, after as many refusals for want of a place as it takes.

    nginx asks the other replica only if the first took no connection: a call that its replica died
    of, or with, is repeated here, as any client may repeat what changes nothing.
    """
    while True:
        result = None
        try:
            async with Client(url, read_timeout_seconds=120) as client:
                result = await client.call_tool("estimate_gsd", {"image": image, "detail": "full"})
        except* (httpx2.RemoteProtocolError, httpx2.ReadError, httpx2.HTTPStatusError, MCPError):
            tally["broken off"] += 1
        if result is None:
            continue
        if not result.is_error:
            gsd: float | None = result.structured_content["gsd_m_per_px"]
            return gsd
        text = getattr(result.content[0], "text", "")
        assert text.startswith("busy:"), text
        tally["busy"] += 1
        await anyio.sleep(0.2)


async def _load(deployment: Deployment) -> Counter[str]:
    tally: Counter[str] = Counter()
    queue = iter(range(N_CALLS))

    async def client() -> None:
        for i in queue:
            image, expected = deployment.calls[i % len(deployment.calls)]
            tally[
                "right" if await _answer(deployment.url, image, tally) == expected else "wrong"
            ] += 1

    with anyio.fail_after(LONGEST_S):
        async with anyio.create_task_group() as group:
            for _ in range(N_CLIENTS):
                group.start_soon(client)
    return tally


@pytest.mark.anyio
async def test_both_replicas_answer_and_every_answer_is_right(deployment: Deployment) -> None:
    started = time.perf_counter()
    tally = await _load(deployment)
    seconds = time.perf_counter() - started
    print(
        f"{N_CALLS} calls, {N_CLIENTS} clients, {seconds:.1f} s, {N_CALLS / seconds:.1f} a "
        f"second: {dict(tally)}"
    )
    assert tally["right"] == N_CALLS, tally
    assert not tally["broken off"], tally
    shares = deployment.asked()
    assert set(shares) == {address for address, _ in deployment.servers}
    assert min(shares.values()) > 0.25 * shares.total(), shares


@pytest.mark.anyio
async def test_when_a_replica_is_killed_the_other_takes_over(deployment: Deployment) -> None:
    _, victim = deployment.servers[0]

    async def kill() -> None:
        await anyio.sleep(2)
        os.kill(victim, signal.SIGKILL)

    async with anyio.create_task_group() as group:
        group.start_soon(kill)
        tally = await _load(deployment)
    print(dict(tally))
    assert tally["right"] == N_CALLS, tally
    # what was on its way to the one that died, and what it still took while it ended
    most = 2 * N_CLIENTS
    assert tally["broken off"] <= most, tally


def test_a_request_that_a_replica_died_of_is_not_sent_to_the_other(tmp_path: Path) -> None:
    seen: list[bytes] = []

    def die_of_each(listener: socket.socket) -> None:
        with suppress(OSError):
            while True:
                connection, _ = listener.accept()
                with connection:
                    seen.append(connection.recv(65536))  # and hang up without an answer

    with ExitStack() as stack:
        listeners = [stack.enter_context(socket.create_server(("127.0.0.1", 0))) for _ in range(2)]
        for listener in listeners:
            threading.Thread(target=die_of_each, args=(listener,), daemon=True).start()
        addresses = [f"127.0.0.1:{listener.getsockname()[1]}" for listener in listeners]
        url = stack.enter_context(nginx_before(addresses, tmp_path))
        assert httpx2.post(url, json={"poison": True}).status_code == 502
        assert len(seen) == 1
        for listener in listeners:
            listener.shutdown(socket.SHUT_RDWR)


@pytest.mark.promise("proxy")
def test_idle_connections_lock_nobody_out(tmp_path: Path) -> None:
    """Send 40 honest calls at a time beside 512 silent connections and 512 that stay after an answer."""

    def call(place: int) -> float:
        started = time.perf_counter()
        with httpx2.Client(
            transport=httpx2.HTTPTransport(local_address=f"127.0.0.{4 + place % 2}")
        ) as client:
            assert client.post(url, timeout=60, **discover()).status_code == 200
        return time.perf_counter() - started

    with ExitStack() as stack:
        servers = [stack.enter_context(http_server("--threads", "1")) for _ in range(2)]
        addresses = [server.url.removeprefix("http://").removesuffix("/mcp") for server in servers]
        url = stack.enter_context(nginx_before(addresses, tmp_path))
        pool = stack.enter_context(ThreadPoolExecutor(N_HONEST))
        alone = [second for _ in range(3) for second in pool.map(call, range(N_HONEST))]
        idle = stack.enter_context(closing(IdleConnections(url)))
        beside: list[float] = []
        ends = time.monotonic() + IDLE_FOR_S
        while time.monotonic() < ends:
            idle.renew()
            beside += pool.map(call, range(N_HONEST))
        assert idle.n_closed > N_IDLE, "nginx closes them"
    print(
        f"slowest call {max(alone):.2f} s alone, {max(beside):.2f} s beside {idle.n_closed} "
        "closed connections"
    )
    assert max(beside) < 2 * max(alone) + LONGEST_WAIT_S  # the machine may be busy


class IdleConnections:
    """Connections of one stranger at two addresses: half say nothing, half stay after an answer."""

    def __init__(self, url: str) -> None:
        host, port = url.removeprefix("http://").removesuffix("/mcp").split(":")
        self._address = host, int(port)
        self._open: list[socket.socket] = []
        self.n_closed = 0

    def renew(self) -> None:
        """Replace those that nginx has closed."""
        for each in list(self._open):
            with suppress(BlockingIOError):
                with suppress(ConnectionResetError):
                    if each.recv(4096):
                        continue
                self._open.remove(each)
                each.close()
                self.n_closed += 1
        for i in range(2 * N_IDLE - len(self._open)):
            connection = socket.socket()
            connection.bind((f"127.0.0.{2 + i // 2 % 2}", 0))
            connection.connect(self._address)
            if i % 2:
                connection.sendall(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n")
            connection.setblocking(False)
            self._open.append(connection)

    def close(self) -> None:
        """Close all."""
        for each in self._open:
            each.close()
