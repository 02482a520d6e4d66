"""Whether the event loop stays free: ``python -m benchmarks.server_latency``.

``tools/list`` over HTTP while a 4096 x 4096 estimate runs. Aim: < 100 ms at the 95th percentile.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from pathlib import Path

import anyio
from mcp import Client

from benchmarks.server_process import http_server, write_large_image


async def measure(url: str, image: Path) -> None:
    """One client computes, the other asks."""
    idle: list[float] = []
    loaded: list[float] = []
    running = anyio.Event()
    done = anyio.Event()

    async def asked(times: list[float]) -> None:
        async with Client(url) as client:
            started = time.perf_counter()
            await client.list_tools()
            times.append(1000 * (time.perf_counter() - started))

    async def compute() -> None:
        async def on_progress(progress: float, total: float | None, message: str | None) -> None:
            del total, message
            if progress >= 10:
                running.set()

        async with Client(url, read_timeout_seconds=300) as client:
            result = await client.call_tool(
                "estimate_gsd", {"image": {"kind": "path", "path": str(image)}}, progress_callback=on_progress
            )
            assert not result.is_error, result
            done.set()

    for _ in range(50):
        await asked(idle)
    async with anyio.create_task_group() as group:
        group.start_soon(compute)
        await running.wait()
        while not done.is_set():
            await asked(loaded)
            await anyio.sleep(0.02)
    for name, times in (("idle", idle), ("during a 4096 x 4096 estimate", loaded)):
        cuts = statistics.quantiles(times, n=20)
        print(f"tools/list {name}: median {statistics.median(times):.1f} ms, p95 {cuts[-1]:.1f} ms of {len(times)}")


def main() -> None:
    """Start a server and measure."""
    with tempfile.TemporaryDirectory() as directory:
        image = write_large_image(Path(directory).resolve())
        with http_server("--root", directory, "--deadline-s", "300") as (url, _):
            anyio.run(measure, url, image)


if __name__ == "__main__":
    main()
