"""Calls from many clients while workers are killed: ``python -m benchmarks.server_chaos --calls 1000``.

Aim: every call is answered, right or with a code that says to try again; ``/healthz`` below 200 ms at the 99th
percentile; the whole server below 2 GiB.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import anyio
import httpx2
from mcp import Client

from benchmarks.server_process import child_processes, http_server, middle_box, resident_mib, target, write_images

RETRYABLE = ("busy", "worker_killed")


async def chaos(n_calls: int, n_clients: int, period_s: float) -> None:
    """Print how the calls ended, how long the server was silent, and how much memory it took."""
    with tempfile.TemporaryDirectory() as directory:
        images = write_images(Path(directory).resolve())
        questions: list[tuple[str, dict[str, Any]]] = [
            ("estimate_gsd", {"image": {"kind": "path", "path": str(image)}}) for image in images
        ]
        known = {**target(middle_box(images[0])), "gsd_m_per_px": 0.15}
        questions.append(("measure_area", {**questions[0][1], **known}))
        flags = ("--root", directory, "--threads", "1", "--max-connections-per-address", "400")
        with http_server(*flags) as server:
            expected = [(await _answer(server.url, *question))[0] for question in questions]
            tally: Counter[str] = Counter()
            healthy_ms: list[float] = []
            peak_mib = [0.0]
            numbers = iter(range(n_calls))

            async def client() -> None:
                for i in numbers:
                    k = i % len(questions)
                    while True:
                        answer, code = await _answer(server.url, *questions[k])
                        tally[code or ("right" if answer == expected[k] else "wrong")] += 1
                        if code not in RETRYABLE:
                            break
                        await anyio.sleep(random.uniform(0.2, 1.0))

            async def kill() -> None:
                while True:
                    await anyio.sleep(period_s)
                    for victim in child_processes(server.pid)[:1]:  # there is none while no call asks for the next
                        os.kill(victim, signal.SIGKILL)
                        tally["kills"] += 1

            async def probe() -> None:
                async with httpx2.AsyncClient(timeout=30) as http:
                    while True:
                        asked = time.perf_counter()
                        (await http.get(server.url.replace("/mcp", "/healthz"))).raise_for_status()
                        healthy_ms.append(1000 * (time.perf_counter() - asked))
                        peak_mib[0] = max(
                            peak_mib[0], resident_mib(server.pid) + sum(map(resident_mib, child_processes(server.pid)))
                        )
                        await anyio.sleep(0.1)

            async with anyio.create_task_group() as group:
                group.start_soon(kill)
                group.start_soon(probe)
                async with anyio.create_task_group() as clients:
                    for _ in range(n_clients):
                        clients.start_soon(client)
                group.cancel_scope.cancel()
    healthy_ms.sort()
    print(f"{n_calls} calls, {n_clients} clients, a worker killed every {period_s:g} s: {dict(tally)}")
    print(
        f"/healthz: median {healthy_ms[len(healthy_ms) // 2]:.0f} ms, p99 {healthy_ms[-len(healthy_ms) // 100]:.0f} ms"
    )
    print(f"memory of all processes, resident: {peak_mib[0]:.0f} MiB at most")


async def _answer(url: str, tool: str, arguments: dict[str, Any]) -> tuple[Any, str | None]:
    """The record, or the error's code."""
    async with Client(url, read_timeout_seconds=120) as client:
        result = await client.call_tool(tool, arguments)
    if result.is_error:
        return None, getattr(result.content[0], "text", "").partition(":")[0]
    return result.structured_content, None


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--calls", type=int, default=10_000)
    parser.add_argument("--clients", type=int, default=64)
    parser.add_argument("--period", type=float, default=5.0, help="seconds between kills")
    given = parser.parse_args()
    anyio.run(chaos, given.calls, given.clients, given.period)
