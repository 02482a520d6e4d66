from __future__ import annotations

import base64
import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import anyio
import cv2
import numpy as np
import pytest
from mcp import Client
from mcp.server import MCPServer
from mcp.types import CallToolResult, ImageContent, TextContent

import vehanchor
from tests.server.test_models import calibration_file
from vehanchor.detection.detector import load_detector
from vehanchor_server.app import create_server, create_services
from vehanchor_server.settings import Settings
from vehanchor_server.tools.overlay import MAX_PICTURE_BYTES

pytestmark = pytest.mark.anyio

ERAS = ("auto", "legacy")  # auto finds the stateless 2026-07-28 protocol


def by_path(path: Path | str) -> dict[str, Any]:
    return {"image": {"kind": "path", "path": str(path)}}


def text_of(result: CallToolResult) -> str:
    first = result.content[0]
    assert isinstance(first, TextContent)
    return first.text


def picture_of(result: CallToolResult) -> np.ndarray:
    """The overlay, decoded, after a look at what every overlay must be."""
    picture = result.content[1]
    assert isinstance(picture, ImageContent)
    assert picture.mime_type == "image/jpeg"
    data = base64.b64decode(picture.data)
    assert len(data) <= MAX_PICTURE_BYTES
    decoded = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert decoded is not None
    return np.asarray(decoded)


def error_of(result: CallToolResult) -> str:
    assert result.is_error
    return text_of(result).partition(":")[0]


@pytest.fixture(params=ERAS)
def era(request: pytest.FixtureRequest) -> str:
    return str(request.param)


async def test_a_call_gives_the_librarys_record_and_a_sentence(
    server: MCPServer[object], images: Path, detector_path: Path, era: str
) -> None:
    expected = vehanchor.estimate_gsd(images / "cars.png", detector=load_detector(detector_path, threads=1))
    async with Client(server, mode=era) as client:
        result = await client.call_tool("estimate_gsd", by_path(images / "cars.png"))
    assert not result.is_error
    assert result.structured_content == expected.model_dump(mode="json")
    assert len(result.content) == 1
    assert text_of(result).startswith(f"{expected.gsd_m_per_px:.3g} m/px (95 % interval ")
    assert f"confidence {expected.confidence:.2f} from 24 vehicles: safe to use." in text_of(result)


async def test_no_vehicle_is_a_result_not_an_error(server: MCPServer[object], images: Path, era: str) -> None:
    async with Client(server, mode=era) as client:
        result = await client.call_tool("estimate_gsd", by_path(images / "empty.png"))
    assert not result.is_error
    assert result.structured_content is not None
    assert result.structured_content["status"] == "no_anchor"
    assert result.structured_content["gsd_m_per_px"] is None
    assert result.structured_content["confidence"] == 0
    assert text_of(result) == "No vehicles found, confidence 0: no metric scale; use another anchor."


async def test_few_vehicles_are_a_result_that_says_not_to_rely_on_it(server: MCPServer[object], images: Path) -> None:
    async with Client(server) as client:
        result = await client.call_tool("estimate_gsd", by_path(images / "two.png"))
    assert result.structured_content is not None
    assert result.structured_content["status"] == "low_confidence"
    assert "from 2 vehicles: do not rely on it (too little evidence); fall back" in text_of(result)


async def test_the_same_image_by_path_file_url_base64_and_data_uri_gives_the_same_record(
    server: MCPServer[object], images: Path
) -> None:
    file = images / "sub dir" / "cars é.png"
    encoded = base64.b64encode(file.read_bytes()).decode()
    arguments: list[dict[str, Any]] = [
        {"kind": "path", "path": str(file)},
        {"kind": "path", "path": file.as_uri()},
        {"kind": "path", "path": file.as_uri().replace("file:///", "file://localhost/")},
        {"kind": "base64", "data": encoded},
        {"kind": "base64", "data": f"data:image/png;base64,{encoded}"},
        {"kind": "base64", "data": "\n".join(encoded[i : i + 76] for i in range(0, len(encoded), 76))},
    ]
    async with Client(server) as client:
        results = [await client.call_tool("estimate_gsd", {"image": image}) for image in arguments]
    assert [result.is_error for result in results] == [False] * len(arguments), [text_of(result) for result in results]
    assert all(result.structured_content == results[0].structured_content for result in results)


async def test_arguments_reach_the_library(server: MCPServer[object], images: Path, detector_path: Path) -> None:
    expected = vehanchor.estimate_gsd(
        images / "cars.png",
        detector=load_detector(detector_path, threads=1),
        reference_length_m=4.6,
        frame_width_px=320,
        frame_height_px=256,
    )
    arguments = {
        **by_path(images / "cars.png"),
        "reference_length_m": 4.6,
        "frame": {"width_px": 320, "height_px": 256},
    }
    async with Client(server) as client:
        result = await client.call_tool("estimate_gsd", arguments)
        by_region = await client.call_tool("estimate_gsd", {**by_path(images / "cars.png"), "region": "europe"})
    assert result.structured_content == expected.model_dump(mode="json")
    assert expected.frame is not None
    assert f"In your 320 x 256 copy that is {expected.frame.gsd_m_per_px:.3g} m/px." in text_of(result)
    assert by_region.structured_content is not None
    assert by_region.structured_content["reference_length_m"] == pytest.approx(4.5)


async def test_the_operators_calibration_is_the_ruler_of_callers_who_name_none(
    settings: Settings, images: Path, tmp_path: Path
) -> None:
    calibration = calibration_file(tmp_path / "c.json")
    server = create_server(create_services(replace(settings, calibration=calibration)))
    async with Client(server) as client:
        result = await client.call_tool("estimate_gsd", by_path(images / "cars.png"))
        named = await client.call_tool("estimate_gsd", {**by_path(images / "cars.png"), "reference_length_m": 4.8})
    assert result.structured_content is not None
    assert result.structured_content["reference_length_m"] == 4.31
    assert named.structured_content is not None
    assert named.structured_content["reference_length_m"] == 4.8


async def test_the_overlay_is_a_small_jpeg_beside_the_record(server: MCPServer[object], images: Path, era: str) -> None:
    async with Client(server, mode=era) as client:
        result = await client.call_tool("estimate_gsd", {**by_path(images / "large.png"), "include_overlay": True})
    assert not result.is_error
    decoded = picture_of(result)
    assert 700 < max(decoded.shape) <= 1568


async def test_noise_is_squeezed_below_the_pictures_limit(settings: Settings, tmp_path: Path) -> None:
    noise = np.random.default_rng(1).integers(0, 256, (1600, 1600, 3), dtype=np.uint8)
    assert cv2.imwrite(str(tmp_path / "noise.png"), noise)
    server = create_server(create_services(Settings(roots=(tmp_path,), detector=settings.detector, threads=1)))
    async with Client(server) as client:
        result = await client.call_tool("estimate_gsd", {**by_path(tmp_path / "noise.png"), "include_overlay": True})
    picture = result.content[1]
    assert isinstance(picture, ImageContent)
    assert len(base64.b64decode(picture.data)) <= MAX_PICTURE_BYTES


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({}, "image: it is required"),
        ({"image": {"path": "/a"}}, "kind is missing"),
        ({"image": {"kind": "ftp", "path": "/a"}}, "'path', 'base64', 'url'"),
        ({"image": "/a.jpg"}, "give an object"),
        ({"image": {"kind": "path", "path": "/a", "url": "x"}}, "image.path.url: there is no such argument"),
        ({"image": {"kind": "path", "path": ""}}, "image.path: String should have at least 1 character"),
        ({"image": {"kind": "path", "path": "/a"}, "detector": "/etc/passwd"}, "detector: there is no such argument"),
        ({"image": {"kind": "path", "path": "/a"}, "reference_length_m": -1}, "greater than 0"),
        ({"image": {"kind": "path", "path": "/a"}, "reference_length_m": "inf"}, "reference_length_m"),
        ({"image": {"kind": "path", "path": "/a"}, "reference_length_m": "nan"}, "reference_length_m"),
        ({"image": {"kind": "path", "path": "/a"}, "frame": {"width_px": 3}}, "frame.height_px: it is required"),
        ({"image": {"kind": "path", "path": "/a"}, "frame": {"width_px": 0, "height_px": 3}}, "frame.width_px"),
    ],
)
async def test_wrong_arguments_are_told_in_one_line(
    server: MCPServer[object], arguments: dict[str, Any], words: str, era: str
) -> None:
    async with Client(server, mode=era) as client:
        result = await client.call_tool("estimate_gsd", arguments)
    assert error_of(result) == "invalid_arguments"
    assert words in text_of(result)
    assert "\n" not in text_of(result)


async def test_a_wrong_argument_is_not_repeated_to_the_caller(server: MCPServer[object]) -> None:
    async with Client(server) as client:
        result = await client.call_tool("estimate_gsd", {"image": {"kind": "base64", "data": 7, "secret": "hunter2"}})
    assert "hunter2" not in text_of(result)


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        ({"region": "atlantis"}, "invalid_parameter"),
        ({"region": "europe", "reference_length_m": 4.6}, "invalid_parameter"),
        ({"frame": {"width_px": 100, "height_px": 100}}, "frame_mismatch"),
    ],
)
async def test_the_librarys_refusals_keep_their_code(
    server: MCPServer[object], images: Path, arguments: dict[str, Any], code: str
) -> None:
    async with Client(server) as client:
        result = await client.call_tool("estimate_gsd", {**by_path(images / "cars.png"), **arguments})
    assert error_of(result) == code


async def test_a_file_that_is_no_image_is_told_without_a_descriptors_name(
    server: MCPServer[object], images: Path
) -> None:
    async with Client(server) as client:
        result = await client.call_tool("estimate_gsd", by_path(images / "notes.txt"))
    assert error_of(result) == "image_undecodable"
    assert "/proc" not in text_of(result)


async def test_a_missing_model_is_the_operators_business(images: Path, caplog: pytest.LogCaptureFixture) -> None:
    server = create_server(create_services(Settings(roots=(images,), detector="/nowhere/secret.onnx")))
    async with Client(server) as client:
        result = await client.call_tool("estimate_gsd", by_path(images / "cars.png"))
    assert error_of(result) == "model_unavailable"
    assert "secret" not in text_of(result)
    assert "/nowhere/secret.onnx" in caplog.text


async def test_a_bug_is_told_without_its_details_and_logged_with_them(
    server: MCPServer[object], images: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def broken(*_: object, **__: object) -> None:
        raise RuntimeError("password is hunter2")

    monkeypatch.setattr("vehanchor.estimate.analyse_raster", broken)
    async with Client(server) as client:
        result = await client.call_tool("estimate_gsd", by_path(images / "cars.png"))
    assert error_of(result) == "internal_error"
    assert "hunter2" not in text_of(result)
    assert "hunter2" in caplog.text


@pytest.mark.parametrize(("name", "n_reports"), [("small.png", 4), ("large.png", 5)])
async def test_progress_is_reported_three_to_five_times_and_rises(
    server: MCPServer[object], images: Path, name: str, n_reports: int, era: str
) -> None:
    reports: list[float] = []

    async def on_progress(progress: float, total: float | None, message: str | None) -> None:
        assert total == 100
        assert message
        reports.append(progress)

    async with Client(server, mode=era) as client:
        await client.call_tool("estimate_gsd", by_path(images / name), progress_callback=on_progress)
        await anyio.sleep(0.05)
    assert len(reports) == n_reports
    assert reports == sorted(set(reports))
    assert reports[0] == 0
    assert reports[-1] == 100


async def test_the_contract_names_every_hint(server: MCPServer[object], era: str) -> None:
    async with Client(server, mode=era) as client:
        listed = (await client.list_tools()).tools
        instructions = client.instructions
    assert [tool.name for tool in listed] == ["estimate_gsd", "measure_area"]
    for tool in listed:
        assert tool.title
        assert tool.description
        assert len(tool.description.encode()) < 2048
        assert "confidence" in tool.description
        assert "0.5" in tool.description
        assert tool.annotations is not None
        assert tool.annotations.read_only_hint
        assert tool.annotations.idempotent_hint
        assert tool.annotations.destructive_hint is False
        assert tool.annotations.open_world_hint is False
    assert instructions is not None
    assert "Below 0.5" in instructions
    assert "Confidence 0 means" in instructions


async def test_over_capacity_a_call_is_refused_at_once(
    settings: Settings, images: Path, slow_tiles: Callable[[float], None], era: str
) -> None:
    slow_tiles(0.5)
    services = create_services(Settings(roots=settings.roots, detector=settings.detector, threads=1, max_concurrency=1))
    codes: list[str] = []
    async with Client(create_server(services), mode=era) as client, anyio.create_task_group() as group:

        async def call() -> None:
            result = await client.call_tool("estimate_gsd", by_path(images / "cars.png"))
            codes.append(error_of(result) if result.is_error else "ok")

        group.start_soon(call)
        await anyio.sleep(0.2)
        with anyio.fail_after(0.25):
            await call()
        assert codes == ["busy"]
    assert codes == ["busy", "ok"]
    assert services.capacity.running == 0


async def test_the_deadline_ends_a_call_and_frees_its_place(
    settings: Settings, images: Path, slow_tiles: Callable[[float], None], era: str
) -> None:
    slow_tiles(0.1)
    services = create_services(Settings(roots=settings.roots, detector=settings.detector, threads=1, deadline_s=0.3))
    async with Client(create_server(services), mode=era) as client:
        with anyio.fail_after(2):
            result = await client.call_tool("estimate_gsd", by_path(images / "large.png"))
    assert error_of(result) == "deadline_exceeded"
    assert services.capacity.running == 0


async def test_cancelling_stops_the_work_and_frees_its_place(
    settings: Settings,
    images: Path,
    slow_tiles: Callable[[float], None],
    era: str,
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO, "vehanchor_server.calls")
    slow_tiles(0.1)
    services = create_services(Settings(roots=settings.roots, detector=settings.detector, threads=1))
    async with Client(create_server(services), mode=era) as client:
        with anyio.move_on_after(0.4):
            await client.call_tool("estimate_gsd", by_path(images / "large.png"))
        with anyio.fail_after(0.3):
            while services.capacity.running:
                await anyio.sleep(0.01)
        assert [getattr(record, "fields", {}).get("status") for record in caplog.records][-1] == "cancelled"
        result = await client.call_tool("estimate_gsd", by_path(images / "cars.png"))
    assert not result.is_error


async def test_other_questions_are_answered_while_a_call_computes(
    server: MCPServer[object], images: Path, slow_tiles: Callable[[float], None]
) -> None:
    slow_tiles(0.2)
    async with Client(server) as client, anyio.create_task_group() as group:
        group.start_soon(client.call_tool, "estimate_gsd", by_path(images / "large.png"))
        await anyio.sleep(0.1)
        with anyio.fail_after(0.5):
            await client.list_tools()
        group.cancel_scope.cancel()
