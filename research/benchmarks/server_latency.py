"""Measure the event loop's latency and how fast a call stops: ``python -m research.benchmarks.server_latency``.

``tools/list`` over HTTP while a call computes on 4096 x 4096 pixels; aim: < 100 ms at the 95th percentile. And how soon
after a caller has hung up its place is free for the next one; aim: < 300 ms.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

import anyio
from mcp import Client

from research.results.record import add_record_option, recording, values_table
from tests.server_process import http_server, middle_box, target, write_large_image

COMPUTING = 10  # per cent of progress: the image is read, and a model runs


async def compute(url: str, tool: str, arguments: dict[str, Any], running: anyio.Event, done: anyio.Event) -> None:
    """Make a call; signal when it computes and when it has ended."""

    async def on_progress(progress: float, total: float | None, message: str | None) -> None:
        del total, message
        if progress >= COMPUTING:
            running.set()

    async with Client(url, read_timeout_seconds=300) as client:
        result = await client.call_tool(tool, arguments, progress_callback=on_progress)
        assert not result.is_error, result
        done.set()


async def listing_ms(url: str) -> float:
    """How long ``tools/list`` takes."""
    async with Client(url) as client:
        started = time.perf_counter()
        await client.list_tools()
        return 1000 * (time.perf_counter() - started)


def report(name: str, times: list[float]) -> dict[str, float]:
    """Statistics of the times of ``tools/list``."""
    cuts = statistics.quantiles(times, n=20)
    return {
        f"`tools/list` {name}, median, ms": statistics.median(times),
        f"`tools/list` {name}, 95th percentile, ms": cuts[-1],
    }


async def listings(url: str, calls: dict[str, dict[str, Any]]) -> dict[str, float]:
    """One client computes, the other asks."""
    values = report("idle", [await listing_ms(url) for _ in range(50)])
    for tool, arguments in calls.items():
        times: list[float] = []
        running, done = anyio.Event(), anyio.Event()
        async with anyio.create_task_group() as group:
            group.start_soon(compute, url, tool, arguments, running, done)
            await running.wait()
            while not done.is_set():
                times.append(await listing_ms(url))
                await anyio.sleep(0.02)
        values |= report(f"during `{tool}`", times)
    return values


async def stops(url: str, calls: dict[str, dict[str, Any]], n_stops: int) -> dict[str, float]:
    """Hang up while a model runs, and ask for the one place of the server until it is free."""
    quick = {"image": {"kind": "path", "path": "/"}}  # needs a place, and is refused
    values = {}
    for tool, arguments in calls.items():
        times = []
        for i in range(n_stops):
            running = anyio.Event()
            async with anyio.create_task_group() as group:
                group.start_soon(compute, url, tool, arguments, running, anyio.Event())
                await running.wait()
                await anyio.sleep(0.1 + 0.2 * i)  # another layer each time
                started = time.perf_counter()
                group.cancel_scope.cancel()
            async with Client(url) as client:
                while "busy" in str((await client.call_tool("estimate_gsd", quick)).content):
                    pass
            times.append(1000 * (time.perf_counter() - started))
        values[f"place free again after `{tool}` is cancelled, median, ms"] = statistics.median(times)
        values[f"place free again after `{tool}` is cancelled, most of {n_stops}, ms"] = max(times)
    return values


def main() -> None:
    """Start a server and measure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--stops", type=int, default=10)
    options = add_record_option(parser).parse_args()
    with tempfile.TemporaryDirectory() as directory:
        image = write_large_image(Path(directory).resolve())
        estimate = {"image": {"kind": "path", "path": str(image)}}
        calls = {"estimate_gsd": estimate, "measure_area": {**estimate, **target(middle_box(image))}}
        flags = ["--root", directory, "--deadline-s", "300"]
        with http_server(*flags) as server:
            values = anyio.run(listings, server.url, calls)
        with http_server(*flags, "--max-concurrency", "1") as server:
            values |= anyio.run(stops, server.url, calls, options.stops)
    aims = {name: 100 if name.endswith("percentile, ms") else 300 for name in values if "median" not in name}
    with recording("server", ["latency"], options.record):
        print(*values_table(values, aims), sep="\n")


if __name__ == "__main__":
    main()
