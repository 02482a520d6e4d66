"""Calls within the capacity of a server: progress, slots, deadline and cancellation."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import anyio
import pytest
from mcp import Client
from mcp.server import MCPServer

from tests.server.conftest import N_TILES_LARGE
from tests.server.conversation import by_path, error_of, reported
from tests.tiles import Tiles
from vehanchor_server.app import create_server
from vehanchor_server.services import Services, create_services
from vehanchor_server.settings import Settings

pytestmark = pytest.mark.anyio


async def stop_requested(services: Services) -> None:
    """Wait until the one call that runs was asked to end."""
    (stop,) = services.capacity._stops
    while not stop.requested:
        await anyio.sleep(0.01)


@pytest.mark.parametrize(("name", "n_reports"), [("small.png", 4), ("large.png", 5)])
async def test_progress_rises_in_three_to_five_reports(
    server: MCPServer[object], images: Path, name: str, n_reports: int, era: str
) -> None:
    reports: list[float] = []

    async def on_progress(progress: float, total: float | None, message: str | None) -> None:
        assert total == 100
        assert message
        reports.append(progress)

    async with Client(server, mode=era) as client:
        await client.call_tool(
            "estimate_gsd", by_path(images / name), progress_callback=on_progress
        )
        await reported(reports)
    assert len(reports) == n_reports
    assert reports == sorted(set(reports))
    assert reports[0] == 0
    assert reports[-1] == 100


@pytest.mark.promise("places")
async def test_a_call_that_finds_no_slot_is_refused(
    settings: Settings, images: Path, tiles: Tiles, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vehanchor_server.calls.capacity.MAX_WAIT_S", 0.1)
    services = create_services(replace(settings, max_concurrency=1))
    codes: list[str] = []
    async with Client(create_server(services)) as client, anyio.create_task_group() as group:

        async def call() -> None:
            result = await client.call_tool("estimate_gsd", by_path(images / "cars.png"))
            codes.append(error_of(result) if result.is_error else "ok")

        with tiles.held():  # the first call cannot end before the second is refused
            group.start_soon(call)
            await tiles.begun()
            await call()
            assert codes == ["busy"]
    assert codes == ["busy", "ok"]
    assert services.capacity.running == 0


async def test_a_call_at_its_deadline_frees_its_slot(
    settings: Settings, images: Path, tiles: Tiles
) -> None:
    tiles.least_s = 0.1
    services = create_services(replace(settings, deadline_s=0.3))
    async with Client(create_server(services)) as client:
        result = await client.call_tool("estimate_gsd", by_path(images / "large.png"))
    assert error_of(result) == "deadline_exceeded"
    assert tiles.n_begun < N_TILES_LARGE
    assert services.capacity.running == 0


async def test_a_cancelled_call_frees_its_slot(
    services: Services, images: Path, tiles: Tiles, era: str, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "vehanchor_server.calls")
    async with Client(create_server(services), mode=era) as client:
        async with anyio.create_task_group() as group:
            with tiles.held():
                group.start_soon(client.call_tool, "estimate_gsd", by_path(images / "large.png"))
                await tiles.begun()
                group.cancel_scope.cancel()
                with anyio.CancelScope(shield=True):
                    await stop_requested(services)
        while services.capacity.running:
            await anyio.sleep(0.01)
        assert tiles.n_begun == 1
        last_line = caplog.records[-1]
        assert getattr(last_line, "fields", {})["status"] == "cancelled"
        result = await client.call_tool("estimate_gsd", by_path(images / "cars.png"))
    assert not result.is_error


async def test_lack_of_memory_outside_models_has_its_own_code(
    server: MCPServer[object], images: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def hungry(*_: object, **__: object) -> None:
        raise MemoryError

    monkeypatch.setattr("vehanchor.detection.detector.Detector.detect_tile", hungry)
    async with Client(server) as client:
        result = await client.call_tool("estimate_gsd", by_path(images / "cars.png"))
    assert error_of(result) == "out_of_memory"
