"""The server over real HTTP on the loopback address."""

from __future__ import annotations

import base64
import contextlib
import json
import signal
import socket
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import anyio
import httpx2 as httpx
import numpy as np
import pytest
from mcp import Client

from tests.server.conftest import N_TILES_LARGE
from tests.server.conversation import by_path, error_of, listening, serving, text_of
from tests.server_process import http_server
from tests.tiles import Tiles
from vehanchor_server.settings import Settings, SettingsError
from vehanchor_server.tools.target import MAX_POLYGON_NUMBERS, MAX_TARGETS
from vehanchor_server.transport.http import _auth, create_app

pytestmark = pytest.mark.anyio

TOKEN = "a-long-enough-token-1234"
ERAS = ("auto", "legacy")
KNOWN = {"gsd_m_per_px": 0.1, "gsd_basis": "measured"}


@contextlib.contextmanager
def served(settings: Settings) -> Iterator[str]:
    """The server's address, for as long as it listens."""
    with listening() as listener, serving(create_app(settings), listener):
        yield f"http://127.0.0.1:{listener.getsockname()[1]}"


@pytest.fixture
def base(settings: Settings) -> Iterator[str]:
    with served(settings) as address:
        yield address


@pytest.fixture(scope="module")
def guarded(detector_path: Path) -> Iterator[str]:
    settings = Settings(
        detector=str(detector_path),
        public_urls=(
            "https://vehanchor.test/mcp",
            "https://console.test",
            "https://agents.test:8443/mcp",
        ),
        isolation="in-process",
    )
    with served(settings) as address:
        yield address


@pytest.fixture
def token_file(tmp_path: Path) -> Path:
    path = tmp_path / "tokens"
    path.write_text(TOKEN + "\n")
    return path


def discover(**headers: str) -> dict[str, Any]:
    """A request of the stateless protocol, as a plain HTTP client sends it."""
    meta = {
        "io.modelcontextprotocol/protocolVersion": "2026-07-28",
        "io.modelcontextprotocol/clientCapabilities": {},
        "io.modelcontextprotocol/clientInfo": {"name": "test", "version": "1"},
    }
    return {
        "json": {"jsonrpc": "2.0", "id": 1, "method": "tools/list", "params": {"_meta": meta}},
        "headers": {
            "Accept": "application/json, text/event-stream",
            "MCP-Protocol-Version": "2026-07-28",
            "Mcp-Method": "tools/list",
            **headers,
        },
    }


@pytest.mark.parametrize("era", ERAS)
async def test_tools_can_be_called(base: str, images: Path, era: str) -> None:
    reports: list[float] = []

    async def on_progress(progress: float, total: float | None, message: str | None) -> None:
        reports.append(progress)

    async with Client(f"{base}/mcp", mode=era) as client:
        listed = [tool.name for tool in (await client.list_tools()).tools]
        assert listed == ["estimate_gsd", "measure_area", "measure_distance", "view_image"]
        result = await client.call_tool(
            "estimate_gsd", by_path(images / "cars.png"), progress_callback=on_progress
        )
        refused = await client.call_tool("estimate_gsd", by_path("/etc/passwd"))
    assert result.structured_content is not None
    assert result.structured_content["status"] == "ok"
    assert 3 <= len(reports) <= 5
    assert error_of(refused) == "path_not_allowed"


async def test_sixteen_polygons_pass_the_guard(base: str, images: Path) -> None:
    angles = np.linspace(0, 2 * np.pi, MAX_POLYGON_NUMBERS // 2, endpoint=False)
    circle = 100 + 60 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    targets = [{"polygon": circle.ravel().tolist()}] * MAX_TARGETS
    arguments = {**by_path(images / "pool.png"), "targets": targets, **KNOWN}
    async with Client(f"{base}/mcp") as client:
        result = await client.call_tool("measure_area", arguments)
    assert not result.is_error, result.content
    assert result.structured_content is not None
    areas = [record["area_m2"] for record in result.structured_content["measurements"]]
    assert areas == pytest.approx([np.pi * 36] * MAX_TARGETS, rel=0.01)


async def test_requests_need_no_session(base: str) -> None:
    client_info = {"name": "test", "version": "1"}
    params = {"protocolVersion": "2025-06-18", "capabilities": {}, "clientInfo": client_info}
    legacy = {"jsonrpc": "2.0", "id": 1, "method": "initialize", "params": params}
    async with httpx.AsyncClient(timeout=60) as client:
        for request in (
            discover(),
            {"json": legacy, "headers": {"Accept": "application/json, text/event-stream"}},
        ):
            answer = await client.post(f"{base}/mcp", **request)
            assert answer.status_code == 200
            assert "mcp-session-id" not in answer.headers


def _poll(client: httpx.Client, url: str, is_settled: Callable[[httpx.Response], bool]) -> None:
    """Wait until an answer of the server fulfils a condition."""
    while not is_settled(client.get(url)):
        time.sleep(0.05)


def test_a_server_with_loaded_models_is_ready(settings: Settings) -> None:
    with served(settings) as base, httpx.Client(timeout=60) as client:
        assert client.get(f"{base}/healthz").json() == {"status": "alive"}
        _poll(client, f"{base}/readyz", lambda answer: answer.status_code == 200)
        assert client.get(f"{base}/readyz").json() == {"status": "ready"}


def test_a_server_without_its_model_is_alive_but_not_ready() -> None:
    settings = Settings(detector="/nowhere.onnx", isolation="in-process")
    with served(settings) as base, httpx.Client(timeout=60) as client:
        assert client.get(f"{base}/healthz").status_code == 200
        _poll(client, f"{base}/readyz", lambda answer: answer.json()["error"] is not None)
        answer = client.get(f"{base}/readyz")
        assert answer.status_code == 503
        assert answer.json() == {"status": "loading", "error": "model_not_found"}


@pytest.mark.promise("tokens")
def test_without_the_token_nothing_but_health_answers(
    settings: Settings, token_file: Path, caplog: pytest.LogCaptureFixture
) -> None:
    protected = replace(settings, token_file=token_file)
    with served(protected) as base, httpx.Client(timeout=60) as client:
        for headers in (
            {},
            {"Authorization": f"Bearer {TOKEN}x"},
            {"Authorization": f"Basic {base64.b64encode(TOKEN.encode()).decode()}"},
            {"Authorization": TOKEN},
        ):
            answer = client.post(f"{base}/mcp", **discover(**headers))
            assert answer.status_code == 401
            assert answer.headers["www-authenticate"].startswith("Bearer ")
        assert client.post(f"{base}/mcp?access_token={TOKEN}", **discover()).status_code == 401
        assert client.get(f"{base}/healthz").status_code == 200
        assert (
            client.post(f"{base}/mcp", **discover(Authorization=f"Bearer {TOKEN}")).status_code
            == 200
        )
    assert TOKEN not in caplog.text


def test_an_address_of_the_sixth_version_is_written_in_brackets() -> None:
    listening = Settings(host="::1", oidc=("https://issuer.test", "vehanchor"))
    assert str(_auth(listening).resource_server_url) == f"http://[::1]:{listening.port}/mcp"


async def test_an_oidc_server_says_where_to_get_a_token(settings: Settings) -> None:
    protected = Settings(
        detector=settings.detector,
        oidc=("https://issuer.test", "vehanchor"),
        public_urls=("https://vehanchor.test/mcp",),
        isolation="in-process",
    )
    with served(protected) as base, httpx.Client(timeout=60) as client:
        answer = client.post(f"{base}/mcp", **discover())
        assert answer.status_code == 401
        challenge = answer.headers["www-authenticate"]
        assert (
            'resource_metadata="https://vehanchor.test/.well-known/oauth-protected-resource/mcp"'
            in challenge
        )
        metadata = client.get(f"{base}/.well-known/oauth-protected-resource/mcp").json()
        assert metadata["resource"] == "https://vehanchor.test/mcp"
        assert metadata["authorization_servers"] == ["https://issuer.test"]


@pytest.mark.promise("origins")
@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"Host": "evil.test"}, 421),
        ({"Host": "localhost.evil.test:80"}, 421),
        ({"Host": "agents.test"}, 421),
        ({"Host": "agents.test:8443"}, 200),
        ({"Host": "[::1]:80"}, 200),
        ({"Origin": "https://agents.test"}, 403),
        ({"Origin": "https://console.test:444"}, 403),
        ({"Origin": "http://[::1]:80"}, 200),
        ({"Origin": "https://evil.test"}, 403),
        ({"Origin": "null"}, 403),
        ({"Origin": "http://localhost.evil.test"}, 403),
        ({"Origin": "http://localhost:1234"}, 200),
        ({"Host": "vehanchor.test"}, 200),
        ({"Origin": "https://console.test"}, 200),
    ],
)
def test_foreign_hosts_or_origins_are_refused(
    guarded: str, headers: dict[str, str], status: int
) -> None:
    with httpx.Client(timeout=60) as client:
        assert client.post(f"{guarded}/mcp", **discover(**headers)).status_code == status


@pytest.mark.promise("requests")
async def test_bodies_over_the_limit_are_refused(base: str) -> None:
    request = discover()
    head, _, tail = json.dumps(request.pop("json")).partition('"test"')
    body = head + '"' + "x" * (33 << 20) + '"' + tail
    with httpx.Client(timeout=60) as client:
        request["headers"]["Content-Type"] = "application/json"
        assert client.post(f"{base}/mcp", content=body, **request).status_code == 413

        def chunks() -> Iterator[bytes]:  # no length declared
            for start in range(0, len(body), 1 << 20):
                yield body[start : start + (1 << 20)].encode()

        # the server may hang up before all is sent
        with contextlib.suppress(httpx.WriteError, httpx.ReadError):
            assert client.post(f"{base}/mcp", content=chunks(), **request).status_code == 413
        assert client.get(f"{base}/healthz").status_code == 200


async def test_a_client_that_hangs_up_frees_its_slot(
    settings: Settings, images: Path, tiles: Tiles
) -> None:
    tiles.least_s = 0.1
    with served(replace(settings, max_concurrency=1)) as base:
        async with Client(f"{base}/mcp") as client, anyio.create_task_group() as group:
            group.start_soon(client.call_tool, "estimate_gsd", by_path(images / "large.png"))
            await tiles.begun()
            group.cancel_scope.cancel()
        async with Client(f"{base}/mcp") as client:
            # The slot is free when a call is not refused as busy any more.
            result = await client.call_tool("estimate_gsd", by_path(images / "notes.txt"))
            while error_of(result) == "busy":
                await anyio.sleep(0.02)
                result = await client.call_tool("estimate_gsd", by_path(images / "notes.txt"))
    assert error_of(result) == "image_undecodable", text_of(result)
    assert tiles.n_begun < N_TILES_LARGE


def test_an_app_that_everyone_could_use_is_not_made() -> None:
    with pytest.raises(SettingsError, match="refusing to listen"):
        create_app(Settings(host="0.0.0.0"))


async def test_a_stream_without_an_end_is_refused(base: str) -> None:
    async with httpx.AsyncClient() as client:
        answer = await client.get(f"{base}/mcp", headers={"accept": "text/event-stream"})
    assert (answer.status_code, answer.headers["allow"]) == (405, "POST")


@pytest.fixture(scope="module")
def quick_server() -> Iterator[tuple[str, int]]:
    """Host and port of a server as a process of its own."""
    with http_server("--isolation", "in-process", "--threads", "1") as server:
        host, port = server.url.removeprefix("http://").removesuffix("/mcp").split(":")
        yield host, int(port)
        server.process.send_signal(signal.SIGTERM)
        assert server.process.wait(20) in (0, -signal.SIGTERM)


@pytest.mark.promise("requests")
@pytest.mark.slow
def test_a_head_without_an_end_is_refused(quick_server: tuple[str, int]) -> None:
    with socket.create_connection(quick_server, timeout=10) as connection:
        connection.sendall(b"GET /healthz HTTP/1.1\r\nX: " + b"a" * (33 << 10))
        assert connection.recv(4096).startswith(b"HTTP/1.1 400")


@pytest.mark.promise("requests")
@pytest.mark.slow
def test_an_idle_connection_is_closed(quick_server: tuple[str, int]) -> None:
    with socket.create_connection(quick_server, timeout=10) as connection:
        connection.sendall(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n")
        while connection.recv(4096):
            pass
