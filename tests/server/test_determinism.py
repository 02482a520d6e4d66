"""Equal calls give equal bytes."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

import anyio
import pytest
from mcp import Client

from tests.server.conversation import by_path, text_of
from vehanchor_server.app import create_server
from vehanchor_server.services import create_services
from vehanchor_server.settings import Settings

pytestmark = [pytest.mark.anyio, pytest.mark.slow]


def calls(images: Path) -> list[tuple[str, dict[str, Any]]]:
    """Each tool, with pictures and as many targets as it takes."""
    cars, pool = by_path(images / "cars.png"), by_path(images / "pool.png")
    boxes = [{"box": {"x_min": 20.0 * i, "y_min": 300, "x_max": 20.0 * i + 90, "y_max": 432}} for i in range(16)]
    lines = [{"points": [{"x": 10 + i, "y": 10}, {"x": 400, "y": 300}]} for i in range(16)]
    several = [
        ("estimate_gsd", cars),
        ("measure_area", {**pool, "targets": boxes}),
        ("measure_distance", {**cars, "lines": lines}),
    ]
    return [
        ("view_image", {}),
        ("view_image", {"image": pool["image"]}),
        *several,
        *(("view_image", {"of": {"tool": tool, "arguments": asked}}) for tool, asked in several),
    ]


@pytest.mark.promise("determinism")
async def test_equal_calls_give_equal_bytes_whatever_the_threads_and_the_calls_before(images: Path) -> None:
    seen: list[list[str]] = []

    async def ask_all(client: Client, asked: list[tuple[str, dict[str, Any]]]) -> None:
        answers = []
        for tool, arguments in asked:
            result = await client.call_tool(tool, arguments)
            assert not result.is_error, text_of(result)
            answers.append(result.model_dump_json())
        seen.append(answers)

    for threads in (1, 4):
        services = create_services(Settings(roots=(images,), threads=threads, max_concurrency=2, deadline_s=300))
        assert services.workers is not None
        try:
            async with Client(create_server(services)) as client:
                await ask_all(client, calls(images))  # cold
                os.kill(services.workers.processes[0], signal.SIGKILL)
                await client.call_tool(*calls(images)[1])  # can meet the killed worker
                async with anyio.create_task_group() as group:  # a new worker, with another beside it
                    group.start_soon(ask_all, client, calls(images))
                    for other in ("large.png", "two.png", "cars.png"):
                        await client.call_tool("estimate_gsd", by_path(images / other))
        finally:
            services.close()
    assert len(seen) == 4
    assert all(answers == seen[0] for answers in seen)
