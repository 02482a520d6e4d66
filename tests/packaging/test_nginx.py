"""nginx, as in examples/deploy, loses no call before two servers, also when one of them dies."""

from __future__ import annotations

import base64
import os
import re
import resource
import select
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
from tests.packaging.test_deploy import NGINX_SERVICE
from tests.server.transport.test_http import discover
from tests.server_process import http_server, write_images
from vehanchor import estimate_gsd

pytestmark = [pytest.mark.nginx, pytest.mark.timeout(900)]

N_CALLS = 48
N_CLIENTS = 6
MAX_LOAD_S = 400
# Honest calls at a time, and idle connections of each kind beside them.
N_HONEST = 40
N_IDLE = 512
IDLE_FOR_S = 30.0
# Requests of a stranger whose heads never end: more than nginx has connections.
N_UNFINISHED = 5_000
STRANGER = "127.0.0.9"
# Bodies of a stranger: as many as one address may send at a time, and as large as one may be.
N_BODIES = 32
BODY_BYTES = 31 << 20
PATIENCE_S = 100  # for nginx, on a busy machine
WAITS_AFTER_S = 1.0
MIB = 1 << 20
MAX_WAIT_S = 1.0
STREAM_MODULE = Path("/usr/lib/nginx/modules/ngx_stream_module.so")
Call = tuple[dict[str, Any], float | None]
"""Argument with an image, and the scale that must come back."""


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


@dataclass(frozen=True)
class Deployment:
    """nginx with the servers behind it.

    Attributes:
        url: address of nginx.
        servers: address and process id of each server.
        log: nginx's log of requests.
        calls: calls with known answers.
    """

    url: str
    servers: list[tuple[str, int]]
    log: Path
    calls: list[Call]

    def count_requests(self) -> Counter[str]:
        """Count the requests of each server in nginx's log; a repeated one counts for both."""
        addresses = r"127\.0\.0\.1:\d+(?=,|$)"
        return Counter(re.findall(addresses, self.log.read_text(), flags=re.MULTILINE))


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that the servers may read."""
    folder = tmp_path_factory.mktemp("images")
    write_images(folder)
    return folder


@pytest.fixture(scope="module")
def calls(images: Path) -> list[Call]:
    found: list[Call] = []
    for path in sorted(images.iterdir()):
        gsd = estimate_gsd(path).gsd_m_per_px
        # 2 MB: more than nginx keeps in memory.
        encoded = base64.b64encode(path.read_bytes()).decode()
        found.append(({"kind": "path", "path": str(path)}, gsd))
        found.append(({"kind": "base64", "data": encoded}, gsd))
    return found


@pytest.fixture
def deployment(images: Path, calls: list[Call], tmp_path: Path) -> Iterator[Deployment]:
    needed_program("nginx", "apt-get install nginx-light libnginx-mod-stream")
    with ExitStack() as stack:
        flags = ("--root", str(images), "--threads", "1")
        servers = [stack.enter_context(http_server(*flags)) for _ in range(2)]
        addresses = [_host_and_port(server.url) for server in servers]
        url = stack.enter_context(nginx_before(addresses, tmp_path))
        processes = [server.pid for server in servers]
        behind = list(zip(addresses, processes, strict=True))
        yield Deployment(url, behind, log=tmp_path / "access.log", calls=calls)


def _host_and_port(url: str) -> str:
    return url.removeprefix("http://").removesuffix("/mcp")


@contextmanager
def nginx_before(addresses: list[str], tmp_path: Path) -> Iterator[str]:
    """Start nginx as in the deployment, before these servers; return its URL."""
    nginx = needed_program("nginx", "apt-get install nginx-light libnginx-mod-stream")
    port = free_port()
    configuration = tmp_path / "nginx.conf"
    configuration.write_text(_configuration(addresses, tmp_path, port))
    # As root, nginx would run its workers as "nobody", who may not write to tmp_path.
    user = "user root;" if os.geteuid() == 0 else ""
    files = ("-c", str(configuration), "-e", str(tmp_path / "error.log"))
    command = [nginx, *files, "-g", f"daemon off; {user}"]
    checked = subprocess.run([*command, "-t"], capture_output=True, text=True, check=False)
    assert checked.returncode == 0, checked.stderr
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    try:
        deadline = time.monotonic() + PATIENCE_S
        while not (tmp_path / "nginx.pid").exists():
            assert process.poll() is None, (tmp_path / "error.log").read_text()
            assert time.monotonic() < deadline
            time.sleep(0.05)
        while not _listens(port):
            assert time.monotonic() < deadline
            time.sleep(0.05)
        yield f"http://127.0.0.1:{port}/mcp"
    finally:
        process.send_signal(signal.SIGQUIT)
        process.wait(30)


def _listens(port: int) -> bool:
    try:
        socket.create_connection(("127.0.0.1", port)).close()
    except ConnectionRefusedError:
        return False
    return True


def _configuration(addresses: list[str], tmp_path: Path, port: int) -> str:
    """Return the deployment's configuration with other servers, folders and port."""
    text = (ROOT / "examples/deploy/nginx.conf").read_text()
    rule = re.search(r"server vehanchor:8000(.*?;)", text)
    assert rule is not None
    servers = " ".join(f"server {address}{rule.group(1)}" for address in addresses)
    text = text.replace(rule.group(), servers)
    text = text.replace("listen 8080;", f"listen 127.0.0.1:{port};")
    text = text.replace("/tmp/", f"{tmp_path}/")
    # Debian's nginx loads the front's module; that of the container has it.
    if STREAM_MODULE.exists():
        text = f"load_module {STREAM_MODULE};\n{text}"
    return text.replace("/dev/stdout", f"{tmp_path}/access.log")


async def _answer(url: str, image: dict[str, Any], tally: Counter[str]) -> float | None:
    """Return the scale; repeat a call that is refused because all servers are busy.

    nginx asks the other replica only if the first did not accept the connection. A call that ended
    with its replica is repeated here: it changes nothing, so any client may repeat it.
    """
    arguments = {"image": image, "detail": "full"}
    while True:
        result = None
        try:
            async with Client(url, read_timeout_seconds=120) as client:
                result = await client.call_tool("estimate_gsd", arguments)
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
    """Send all calls with several clients; count right, wrong, refused and broken ones."""
    tally: Counter[str] = Counter()
    queue = iter(range(N_CALLS))

    async def client() -> None:
        for i in queue:
            image, expected = deployment.calls[i % len(deployment.calls)]
            gsd = await _answer(deployment.url, image, tally)
            tally["right" if gsd == expected else "wrong"] += 1

    with anyio.fail_after(MAX_LOAD_S):
        async with anyio.create_task_group() as group:
            for _ in range(N_CLIENTS):
                group.start_soon(client)
    return tally


@pytest.mark.anyio
async def test_both_replicas_answer_rightly(deployment: Deployment) -> None:
    started = time.perf_counter()
    tally = await _load(deployment)
    seconds = time.perf_counter() - started
    rate = N_CALLS / seconds
    print(f"{N_CALLS} calls, {N_CLIENTS} clients, {seconds:.1f} s, {rate:.1f} a second: {tally}")
    assert tally["right"] == N_CALLS, tally
    assert not tally["broken off"], tally
    shares = deployment.count_requests()
    assert set(shares) == {address for address, _ in deployment.servers}
    assert min(shares.values()) > 0.25 * shares.total(), shares


@pytest.mark.anyio
async def test_when_a_replica_is_killed_the_other_takes_over(deployment: Deployment) -> None:
    _, victim = deployment.servers[0]

    async def kill() -> None:
        while deployment.count_requests().total() < N_CALLS / 4:
            await anyio.sleep(0.05)
        os.kill(victim, signal.SIGKILL)

    async with anyio.create_task_group() as group:
        group.start_soon(kill)
        tally = await _load(deployment)
    print(dict(tally))
    assert tally["right"] == N_CALLS, tally
    # The calls that the victim had, and those that it still accepted while it ended.
    assert tally["broken off"] <= 2 * N_CLIENTS, tally


def test_a_request_that_killed_a_replica_is_not_repeated(tmp_path: Path) -> None:
    requests: list[bytes] = []

    def hang_up_on_each(listener: socket.socket) -> None:
        with suppress(OSError):
            while True:
                connection, _ = listener.accept()
                with connection:
                    requests.append(connection.recv(65536))

    with ExitStack() as stack:
        listeners = [stack.enter_context(socket.create_server(("127.0.0.1", 0))) for _ in range(2)]
        for listener in listeners:
            threading.Thread(target=hang_up_on_each, args=(listener,), daemon=True).start()
        addresses = [f"127.0.0.1:{listener.getsockname()[1]}" for listener in listeners]
        url = stack.enter_context(nginx_before(addresses, tmp_path))
        assert httpx2.post(url, json={"poison": True}).status_code == 502
        assert len(requests) == 1
        for listener in listeners:
            listener.shutdown(socket.SHUT_RDWR)


@pytest.mark.promise("proxy")
def test_idle_connections_do_not_delay_honest_calls(tmp_path: Path) -> None:
    """Send honest calls beside silent connections and others that stay after an answer."""

    def call(number: int) -> float:
        """Send an honest call from one of two addresses; return its seconds."""
        transport = httpx2.HTTPTransport(local_address=f"127.0.0.{4 + number % 2}")
        started = time.perf_counter()
        with httpx2.Client(transport=transport) as client:
            assert client.post(url, timeout=60, **discover()).status_code == 200
        return time.perf_counter() - started

    with ExitStack() as stack:
        servers = [stack.enter_context(http_server("--threads", "1")) for _ in range(2)]
        addresses = [_host_and_port(server.url) for server in servers]
        url = stack.enter_context(nginx_before(addresses, tmp_path))
        pool = stack.enter_context(ThreadPoolExecutor(N_HONEST))
        alone: list[float] = []
        for _ in range(3):
            alone += pool.map(call, range(N_HONEST))
        idle = stack.enter_context(closing(IdleConnections(url)))
        beside: list[float] = []
        end = time.monotonic() + IDLE_FOR_S
        while time.monotonic() < end:
            idle.renew()
            beside += pool.map(call, range(N_HONEST))
        assert idle.n_closed > N_IDLE, "nginx closes them"
    print(
        f"slowest call {max(alone):.2f} s alone, {max(beside):.2f} s beside {idle.n_closed} "
        "closed connections"
    )
    # The machine may be busy.
    assert max(beside) < 2 * max(alone) + MAX_WAIT_S


def test_unfinished_heads_of_one_address_do_not_stop_others(tmp_path: Path) -> None:
    with ExitStack() as stack:
        server = stack.enter_context(http_server("--threads", "1"))
        url = stack.enter_context(nginx_before([_host_and_port(server.url)], tmp_path))
        host, port = _host_and_port(url).split(":")
        held = 0
        for _ in range(N_UNFINISHED):
            with suppress(OSError):
                connection = socket.create_connection((host, int(port)), 5, (STRANGER, 0))
                stack.callback(connection.close)
                connection.sendall(b"POST /mcp HTTP/1.1\r\n")
        time.sleep(1)
        for _ in range(N_HONEST):
            answer = httpx2.post(url, timeout=60, **discover())
            held += answer.status_code == 200
        assert held == N_HONEST


def test_the_log_has_the_address_of_the_caller(tmp_path: Path) -> None:
    with ExitStack() as stack:
        server = stack.enter_context(http_server("--threads", "1"))
        url = stack.enter_context(nginx_before([_host_and_port(server.url)], tmp_path))
        transport = httpx2.HTTPTransport(local_address=STRANGER)
        with httpx2.Client(transport=transport) as client:
            assert client.post(url, timeout=60, **discover()).status_code == 200
        deadline = time.monotonic() + PATIENCE_S
        log = tmp_path / "access.log"
        while not log.read_text() and time.monotonic() < deadline:
            time.sleep(0.05)
        assert log.read_text().startswith(f"{STRANGER} ")


def test_bodies_are_not_stored(tmp_path: Path) -> None:
    """Five bodies of 31 MiB without a token filled the memory of nginx."""
    body = b"x" * (31 << 20)
    with ExitStack() as stack:
        server = stack.enter_context(http_server("--threads", "1"))
        url = stack.enter_context(nginx_before([_host_and_port(server.url)], tmp_path))
        with ThreadPoolExecutor(5) as pool:
            list(pool.map(lambda _: _send_slowly(url, body), range(5)))
        stored = [path for path in (tmp_path / "client_body").rglob("*") if path.is_file()]
        assert not stored
        assert not re.search("buffered to a temporary file", (tmp_path / "error.log").read_text())


@pytest.mark.promise("proxy")
def test_nginx_stays_within_its_memory_while_bodies_wait(tmp_path: Path) -> None:
    """Send as many bodies of 31 MiB as one address may, to a server that reads none of them.

    The container's limit counts the memory of nginx, and files in its /tmp, which is in memory.
    """
    limit = NGINX_SERVICE["deploy"]["resources"]["limits"]["memory"]
    limit_mib = int(limit.removesuffix("m"))
    with ExitStack() as stack:
        server = _ServerThatReadsNoBody()
        url = stack.enter_context(nginx_before([server.address], tmp_path))
        # nginx ends when its requests have ended.
        stack.callback(server.close)
        master = int((tmp_path / "nginx.pid").read_text())
        for process in _processes(master):
            n_bytes = limit_mib << 20
            resource.prlimit(process, resource.RLIMIT_DATA, (n_bytes, n_bytes))
        host, port = _host_and_port(url).split(":")
        senders = []
        for _ in range(N_BODIES):
            sender = stack.enter_context(
                socket.create_connection((host, int(port)), 5, (STRANGER, 0))
            )
            sender.setblocking(False)
            senders.append(sender)
        n_sent = _send_until_all_wait(senders)
        processes = _processes(master)
        used_mib = sum(_memory_bytes(process, tmp_path) for process in processes) / MIB
        queued_mib = _queued_bytes(processes) / MIB
        health = httpx2.get(url.replace("/mcp", "/healthz"), timeout=60)
    print(
        f"{n_sent / MIB:.0f} MiB sent; nginx takes {used_mib:.1f} MiB; its sockets hold "
        f"{queued_mib:.1f} MiB, which the container's sysctls limit, and this machine's do not"
    )
    assert health.status_code == 200
    assert used_mib < limit_mib


class _ServerThatReadsNoBody:
    """Server that answers GET, and holds other requests until it is closed."""

    def __init__(self) -> None:
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._held: list[socket.socket] = []
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()
        self.address = f"127.0.0.1:{self._listener.getsockname()[1]}"

    def _serve(self) -> None:
        with suppress(OSError):
            while True:
                connection, _ = self._listener.accept()
                self._held.append(connection)
                if connection.recv(4096).startswith(b"GET"):
                    connection.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: 2\r\n\r\nok")

    def close(self) -> None:
        """Hang up."""
        self._listener.shutdown(socket.SHUT_RDWR)
        self._thread.join()
        self._listener.close()
        for connection in self._held:
            connection.close()


def _send_until_all_wait(senders: list[socket.socket]) -> int:
    """Send a body on each connection until none takes more; return the bytes that were sent."""
    head = f"POST /mcp HTTP/1.1\r\nHost: localhost\r\nContent-Length: {BODY_BYTES}\r\n\r\n"
    part = b" " * (64 << 10)
    left = dict.fromkeys(senders, BODY_BYTES)
    for sender in senders:
        sender.sendall(head.encode())
    n_sent = 0
    while left:
        _, ready, _ = select.select([], list(left), [], WAITS_AFTER_S)
        if not ready:
            break
        for sender in ready:
            taken = sender.send(part[: left[sender]])
            n_sent += taken
            left[sender] -= taken
            if left[sender] == 0:
                del left[sender]
    return n_sent


def _processes(master: int) -> list[int]:
    """List nginx's processes."""
    children = Path(f"/proc/{master}/task/{master}/children").read_text()
    return [master, *map(int, children.split())]


def _memory_bytes(process: int, folder: Path) -> int:
    """Add the memory of a process, and its open files in a folder, which nginx unlinks at once."""
    n_bytes = 0
    for line in Path(f"/proc/{process}/smaps_rollup").read_text().splitlines():
        if line.startswith("Pss:"):
            n_bytes += int(line.split()[1]) << 10
    for descriptor in Path(f"/proc/{process}/fd").iterdir():
        with suppress(FileNotFoundError):
            target = descriptor.readlink()
            if folder in target.parents:
                n_bytes += descriptor.stat().st_size
    return n_bytes


def _queued_bytes(processes: list[int]) -> int:
    """Add what the kernel holds in the TCP sockets of processes (proc(5), net/tcp)."""
    inodes = set()
    for process in processes:
        for descriptor in Path(f"/proc/{process}/fd").iterdir():
            with suppress(FileNotFoundError):
                inodes.add(str(descriptor.readlink()).removeprefix("socket:").strip("[]"))
    n_bytes = 0
    for line in Path("/proc/net/tcp").read_text().splitlines()[1:]:
        fields = line.split()
        if fields[9] in inodes:
            sent, received = fields[4].split(":")
            n_bytes += int(sent, 16) + int(received, 16)
    return n_bytes


def _send_slowly(url: str, body: bytes) -> None:
    """Send a body; the server may answer and close before its end."""
    with suppress(httpx2.TransportError):
        httpx2.post(url, content=body, timeout=60)


class IdleConnections:
    """Connections of a stranger from two addresses: half are silent, half stay after an answer."""

    def __init__(self, url: str) -> None:
        host, port = _host_and_port(url).split(":")
        self._address = host, int(port)
        self._open: list[socket.socket] = []
        self.n_closed = 0

    def renew(self) -> None:
        """Replace the connections that nginx has closed."""
        for connection in list(self._open):
            if _is_closed(connection):
                self._open.remove(connection)
                connection.close()
                self.n_closed += 1
        for i in range(2 * N_IDLE - len(self._open)):
            # Two connections from one address, then two from the other.
            host = f"127.0.0.{2 + i // 2 % 2}"
            connection = socket.create_connection(self._address, source_address=(host, 0))
            if i % 2 == 1:
                connection.sendall(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n")
            connection.setblocking(False)
            self._open.append(connection)

    def close(self) -> None:
        """Close all connections."""
        for connection in self._open:
            connection.close()


def _is_closed(connection: socket.socket) -> bool:
    """Test whether the other side has closed a connection that does not block."""
    try:
        # An answer that has arrived is read; no bytes mean the end.
        return not connection.recv(4096)
    except BlockingIOError:
        return False
    except ConnectionResetError:
        return True
