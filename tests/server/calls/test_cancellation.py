"""A model that runs for seconds ends within 0.3 s of the moment when nobody waits for it any more."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import anyio
import pytest
from mcp import Client

from tests.sam_models import SamFiles
from tests.server.calls.slow_models import weighed_down
from tests.server.conftest import POOL_BOX
from tests.server.conversation import ERAS, by_path, error_of, text_of
from tests.server.transport.test_http import served
from vehanchor_server.app import create_server
from vehanchor_server.services import Services, create_services
from vehanchor_server.settings import Settings

pytestmark = [pytest.mark.anyio, pytest.mark.slow]

STOPS_WITHIN_S = 0.3
COMPUTES_S = 0.5  # from the report that a model starts until it surely runs

TOOLS = {
    "estimate_gsd": {},
    "measure_area": {"targets": [{"box": POOL_BOX}], "gsd_m_per_px": 0.2},  # its segmenter is the slow model
}


@pytest.fixture(scope="module")
def slow(
    images: Path, detector_path: Path, segmenter_paths: SamFiles, tmp_path_factory: pytest.TempPathFactory
) -> Settings:
    folder = tmp_path_factory.mktemp("slow")
    encoder, decoder = segmenter_paths
    return Settings(
        roots=(images,),
        detector=str(weighed_down(detector_path, folder / "detector.onnx")),
        segmenter=(weighed_down(encoder, folder / "encoder.onnx"), decoder),
        threads=1,
        max_concurrency=1,
        isolation="in-process",
    )


@pytest.fixture
def services(slow: Settings) -> Services:
    made = create_services(slow)
    made.models.detector()
    made.models.segmenter()
    return made


async def called(client: Client, tool: str, images: Path, computing: anyio.Event) -> Any:
    """Make a call; the event tells that its model runs."""

    async def on_progress(progress: float, total: float | None, message: str | None) -> None:
        if message in ("segmenting the object", "searched 0 of 9 tiles"):
            await anyio.sleep(COMPUTES_S)
            computing.set()

    arguments = {**by_path(images / "pool.png"), **TOOLS[tool]}
    return await client.call_tool(tool, arguments, progress_callback=on_progress)


@pytest.mark.parametrize("era", ERAS)
@pytest.mark.parametrize("tool", TOOLS)
async def test_cancelling_stops_the_running_model(services: Services, images: Path, tool: str, era: str) -> None:
    async with Client(create_server(services), mode=era) as client:
        computing = anyio.Event()
        async with anyio.create_task_group() as group:
            group.start_soon(called, client, tool, images, computing)
            await computing.wait()
            assert services.capacity.running == 1
            cancelled = time.monotonic()
            group.cancel_scope.cancel()
        while services.capacity.running:
            await anyio.sleep(0.002)
        assert time.monotonic() - cancelled < STOPS_WITHIN_S


@pytest.mark.parametrize("tool", TOOLS)
async def test_the_deadline_stops_the_running_model(slow: Settings, images: Path, tool: str) -> None:
    services = create_services(replace(slow, deadline_s=1.0))
    services.models.detector()
    services.models.segmenter()
    async with Client(create_server(services)) as client:
        started = time.monotonic()
        result = await called(client, tool, images, anyio.Event())
        took = time.monotonic() - started
    assert error_of(result) == "deadline_exceeded"
    assert 1.0 <= took < 1.0 + STOPS_WITHIN_S
    assert services.capacity.running == 0


@pytest.mark.parametrize("tool", TOOLS)
async def test_a_client_that_hangs_up_stops_the_running_model(slow: Settings, images: Path, tool: str) -> None:
    """Over HTTP the one place of the server is free again for the next caller."""
    with served(slow) as base:
        async with Client(f"{base}/mcp") as client:
            computing = anyio.Event()
            async with anyio.create_task_group() as group:
                group.start_soon(called, client, tool, images, computing)
                await computing.wait()
                refused = await client.call_tool("estimate_gsd", by_path(images / "small.png"))
                group.cancel_scope.cancel()
        assert error_of(refused) == "busy"
        async with Client(f"{base}/mcp") as client:
            await anyio.sleep(STOPS_WITHIN_S)
            result = await client.call_tool("estimate_gsd", by_path(images / "notes.txt"))
        assert error_of(result) == "image_undecodable", text_of(result)
