"""Measure the memory of a whole server after calls: ``python -m research.benchmarks.server_memory [--in-process]``.

Aim: with worker processes at most 1.3 times that of one process, and a warm call at most 10 ms slower.
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
from tests.server_process import IDLE_S, http_server, memory_mib, middle_box, target, write_images


async def measure(*flags: str, n_rounds: int, n_calls: int) -> None:
    """Print the memory of each process of a server, and how long a warm call takes."""
    with tempfile.TemporaryDirectory() as directory:
        images = write_images(Path(directory).resolve())
        by_path: dict[str, Any] = {"image": {"kind": "path", "path": str(images[0])}}
        box = target(middle_box(images[0]))
        with http_server("--root", directory, *flags) as server:
            loaded = memory_mib(server.pid)
            async with Client(server.url, read_timeout_seconds=120) as client:

                async def call(tool: str, arguments: dict[str, Any]) -> None:
                    result = await client.call_tool(tool, arguments)
                    assert not result.is_error, result.content

                for _ in range(n_rounds):
                    for tool, arguments in (("estimate_gsd", by_path), ("measure_area", {**by_path, **box})):
                        async with anyio.create_task_group() as group:
                            for _ in range(2):
                                group.start_soon(call, tool, arguments)
                called = memory_mib(server.pid)
                await anyio.sleep(IDLE_S)
                idle = memory_mib(server.pid)
                taken_ms = []
                for _ in range(n_calls):
                    started = time.perf_counter()
                    await call("measure_area", {**by_path, **box, "gsd_m_per_px": 0.15})
                    taken_ms.append(1000 * (time.perf_counter() - started))
    values: dict[str, float | str] = {
        "PSS once loaded, MiB": round(sum(loaded)),
        "PSS of the server alone once loaded, MiB": round(loaded[0]),
        "PSS of the largest worker after both tools, MiB": round(max(called[1:], default=0.0)),
        "PSS after both tools, twice at once, MiB": round(sum(called)),
        f"PSS {IDLE_S:g} s later, MiB": round(sum(idle)),
        "processes": len(idle),
        "measure_area with a known scale, median, ms": statistics.median(taken_ms),
        "measure_area with a known scale, fastest, ms": min(taken_ms),
    }
    print(*values_table(values), sep="\n")


def main() -> None:
    """Command line; unknown options are passed on to the server."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=2, help="of both tools, before memory is looked at")
    parser.add_argument("--calls", type=int, default=20, help="that are timed")
    given, others = add_record_option(parser).parse_known_args()
    key = "memory_in_process" if "--in-process" in others else "memory_workers"
    with recording("server", [key], given.record):
        anyio.run(lambda: measure(*others, n_rounds=given.rounds, n_calls=given.calls))


if __name__ == "__main__":
    main()
