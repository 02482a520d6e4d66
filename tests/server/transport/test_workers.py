"""Two worker processes behind one port, as ``vehanchor serve --http --workers 2`` starts them."""

from __future__ import annotations

import os
import signal
import socket
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import anyio
import httpx2 as httpx
import pytest
from mcp import Client, MCPError

from tests.sam_models import SamFiles
from tests.server.conftest import POOL_BOX
from tests.server.conversation import ERAS, by_path, error_of
from tests.server_process import HttpServer, child_processes, http_server

pytestmark = [
    pytest.mark.anyio,
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform != "linux", reason="looks for processes in /proc"),
]

N_CLIENTS = 6
BEFORE_S, AFTER_S = 2.0, 4.0


@pytest.fixture
def serving(images: Path, detector_path: Path, segmenter_paths: SamFiles) -> Iterator[HttpServer]:
    encoder, decoder = map(str, segmenter_paths)
    models = ["--detector", str(detector_path), "--segmenter", encoder, decoder, "--threads", "1"]
    with http_server("--workers", "2", "--root", str(images), *models) as server:
        yield server


def questions(images: Path) -> list[tuple[str, dict[str, Any]]]:
    pool = by_path(images / "pool.png")
    return [
        ("estimate_gsd", by_path(images / "cars.png")),
        ("estimate_gsd", by_path(images / "two.png")),
        ("measure_area", {**pool, "target": {"box": POOL_BOX}}),
        ("measure_area", {**pool, "target": {"points": [{"x": 324, "y": 378}]}, "gsd_m_per_px": 0.2}),
        ("measure_area", {**by_path("/etc/passwd"), "target": {"box": POOL_BOX}}),
    ]


async def answered(url: str, tool: str, arguments: dict[str, Any], era: str = "auto") -> Any:
    """The record, or the error's code; a server without a free place is asked again."""
    while True:
        async with Client(url, mode=era) as client:
            result = await client.call_tool(tool, arguments)
        if not result.is_error:
            return result.structured_content
        if error_of(result) != "busy":
            return error_of(result)
        await anyio.sleep(0.02)


def busy_s(pid: int) -> float:
    """Processor time that a process has used."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@pytest.mark.parametrize("era", ERAS)
async def test_both_answer_both_tools_alike(serving: HttpServer, images: Path, era: str) -> None:
    workers = child_processes(serving.pid)
    assert len(workers) == 2
    before = [busy_s(pid) for pid in workers]
    asked = questions(images)
    answers: list[list[Any]] = [[] for _ in asked]

    async def client(offset: int) -> None:
        for i in range(len(asked)):
            k = (i + offset) % len(asked)
            answers[k].append(await answered(serving.url, *asked[k], era))

    async with anyio.create_task_group() as group:
        for offset in range(N_CLIENTS):
            group.start_soon(client, offset)
    for same in answers:
        assert len(same) == N_CLIENTS
        assert all(answer == same[0] for answer in same)
    assert answers[4][0] == "path_not_allowed"
    assert all(busy_s(pid) > used for pid, used in zip(workers, before, strict=True)), "one worker did nothing"


async def test_when_one_is_killed_under_load_the_other_keeps_answering(serving: HttpServer, images: Path) -> None:
    asked = questions(images)
    expected = [await answered(serving.url, tool, arguments) for tool, arguments in asked]
    victim, survivor = child_processes(serving.pid)
    tally: Counter[str] = Counter()
    moments: list[float] = []
    ends = time.monotonic() + BEFORE_S + AFTER_S

    async def client(i: int) -> None:
        while time.monotonic() < ends:
            i = (i + 1) % len(asked)
            try:
                answer = await answered(serving.url, *asked[i])
                tally["right" if answer == expected[i] else "wrong"] += 1
                moments.append(time.monotonic())
            except* (MCPError, httpx.HTTPError, OSError):  # its worker was killed
                tally["broken"] += 1

    async with anyio.create_task_group() as group:
        for i in range(N_CLIENTS):
            group.start_soon(client, i)
        await anyio.sleep(BEFORE_S)
        os.kill(victim, signal.SIGKILL)
        killed_at, used = time.monotonic(), busy_s(survivor)
    assert tally["wrong"] == 0, tally
    assert tally["broken"] <= N_CLIENTS, f"calls broke that the other worker could have taken: {tally}"
    assert len([moment for moment in moments if moment > killed_at]) > 0, tally
    assert survivor in child_processes(serving.pid)
    assert busy_s(survivor) > used


def test_sigterm_ends_all_of_them_cleanly(serving: HttpServer) -> None:
    workers = child_processes(serving.pid)
    os.kill(serving.pid, signal.SIGTERM)
    assert serving.process.wait(20) == 0
    deadline = time.monotonic() + 5
    while any(Path(f"/proc/{pid}").exists() for pid in workers) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert not [pid for pid in workers if Path(f"/proc/{pid}").exists()]


def test_a_head_without_an_end_is_refused_and_an_idle_connection_closed(serving: HttpServer) -> None:
    host, port = serving.url.removeprefix("http://").removesuffix("/mcp").split(":")
    with socket.create_connection((host, int(port)), timeout=10) as endless:
        endless.sendall(b"GET /healthz HTTP/1.1\r\nX: " + b"a" * (33 << 10))
        assert endless.recv(4096).startswith(b"HTTP/1.1 400")
    with socket.create_connection((host, int(port)), timeout=10) as idle:
        idle.sendall(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n")
        while idle.recv(4096):
            pass
