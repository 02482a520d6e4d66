"""``measure_distance`` where it differs from ``estimate_gsd``: lines, several answers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcp import Client
from mcp.server import MCPServer
from mcp.types import CallToolResult

import vehanchor
from tests.server.conftest import paint_scene, write_image
from tests.server.conversation import by_path, called, error_of, record_of, text_of
from vehanchor.detection.detector import load_detector
from vehanchor.models.runtime import Runtime
from vehanchor.records.text import significant
from vehanchor_server.app import create_server
from vehanchor_server.services import create_services
from vehanchor_server.settings import Settings

pytestmark = pytest.mark.anyio

LINE = {"points": [{"x": 20, "y": 500}, {"x": 320, "y": 100}]}
MEASURED: dict[str, Any] = {"gsd_m_per_px": 0.1, "gsd_basis": "measured"}
CORNER = {"points": [{"x": 20, "y": 500}, {"x": 320, "y": 500}, {"x": 320, "y": 100}]}


async def test_a_call_gives_the_librarys_record_with_a_sentence(
    server: MCPServer[object], images: Path, detector_path: Path
) -> None:
    expected = vehanchor.measure_distance(
        images / "cars.png",
        [(20, 500), (320, 100)],
        detector=load_detector(detector_path, Runtime(threads=1)),
    )
    result = await called(server, "measure_distance", images / "cars.png", lines=[LINE])
    assert record_of(result) == expected.model_dump(mode="json")
    assert text_of(result).startswith(f"{significant(expected.distance_m or 0)} m (95 % interval ")
    assert (
        f"from 24 vehicles, scale confidence {expected.scale_confidence:.2f}: safe to use."
        in text_of(result)
    )


async def test_several_lines_are_several_answers_after_one_search(
    server: MCPServer[object], images: Path
) -> None:
    reports: list[str] = []

    async def on_progress(progress: float, total: float | None, message: str | None) -> None:
        reports.append(message or "")

    arguments = {"image": by_path(images / "cars.png")["image"], "lines": [LINE, CORNER]}
    async with Client(server) as client:
        result = await client.call_tool(
            "measure_distance", arguments, progress_callback=on_progress
        )
    record = record_of(result)
    first, second = record["measurements"]
    assert second["distance_m"] == pytest.approx(1.4 * first["distance_m"], rel=0.01)
    assert set(record) == {"measurements"}
    assert text_of(result).splitlines()[1].startswith(f"2. {second['distance_m']:.3g} m")
    assert sum("searched 0" in report for report in reports) <= 1


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        ({"lines": []}, "invalid_arguments", "lines: give a list of 1 to 16 items. Example: {"),
        ({"lines": [LINE] * 17}, "invalid_arguments", "lines: give a list of 1 to 16 items"),
        (
            {"lines": [{"points": [{"x": 1, "y": 1}]}]},
            "invalid_arguments",
            "lines.0.points: give a list of 2 to 32",
        ),
        (
            {"lines": [{"points": [[1, 1], {"x": 9, "y": 9}]}]},
            "invalid_arguments",
            "lines.0.points.0: give an object with x, y",
        ),
        (
            {"lines": [LINE], "scale": "0.1"},
            "invalid_arguments",
            "scale: there is no such argument",
        ),
        (
            {"lines": [{"points": [{"x": 1, "y": 1}, {"x": 900, "y": 5}]}]},
            "invalid_prompt",
            "picture of 1024 x 819 px",
        ),
        (
            {"lines": [{"points": [{"x": 0.1, "y": 0}, {"x": 0.9, "y": 1}]}]},
            "invalid_prompt",
            '"fraction"',
        ),
    ],
)
async def test_what_has_no_meaning_is_told_with_what_may_have_been_meant(
    server: MCPServer[object], images: Path, arguments: dict[str, Any], code: str, words: str
) -> None:
    result = await called(server, "measure_distance", images / "cars.png", **arguments)
    assert error_of(result) == code
    assert words in text_of(result)


async def test_a_place_that_may_be_one_of_a_copy_is_questioned(
    server: MCPServer[object], tmp_path: Path
) -> None:
    image = write_image(tmp_path / "large.png", paint_scene(3136, 1000, 0))
    settings = Settings(roots=(tmp_path.resolve(),), isolation="in-process")
    server = create_server(create_services(settings))
    near = await called(server, "measure_distance", image, lines=[LINE], **MEASURED)
    assert "If you used a smaller copy, give its size as frame" in text_of(near)
    far = {"points": [{"x": 20, "y": 500}, {"x": 3000, "y": 900}]}
    for more in (
        {"lines": [far]},
        {"lines": [LINE], "frame": {"width_px": 3136, "height_px": 1000}},
    ):
        result = await called(server, "measure_distance", image, **MEASURED, **more)
        assert "smaller copy" not in text_of(result)


SMALL = {"points": [{"x": 20, "y": 50}, {"x": 90, "y": 60}]}
SHARES = {"points": [{"x": 0.1, "y": 0.2}, {"x": 0.9, "y": 0.2}]}


@pytest.fixture(scope="module")
def large_image(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("large").resolve()
    return write_image(folder / "large.png", paint_scene(1200, 300, 0))


async def measured(image: Path, line: Any, **more: Any) -> CallToolResult:
    """The short answer about a line, by a server of its own."""
    settings = Settings(roots=(image.parent,), isolation="in-process")
    server = create_server(create_services(settings))
    arguments = {"lines": [line], "detail": "short", **MEASURED, **more}
    return await called(server, "measure_distance", image, **arguments)


async def test_coordinates_that_look_like_shares_are_refused(large_image: Path) -> None:
    result = await measured(large_image, SHARES)
    assert error_of(result) == "invalid_prompt"
    assert 'coordinates: "fraction"' in text_of(result)


async def test_shares_are_taken_if_they_are_named(large_image: Path) -> None:
    assert not (await measured(large_image, SHARES, coordinates="fraction")).is_error


async def test_coordinates_that_look_like_per_cent_are_questioned(large_image: Path) -> None:
    result = await measured(large_image, SMALL)
    assert (
        'all coordinates lie in 0 to 100. If they are pixels, give coordinates: "pixels".'
        in text_of(result)
    )
    assert "0 to 100" in str(record_of(result)["warnings"])


async def test_small_coordinates_are_taken_if_they_are_named(large_image: Path) -> None:
    result = await measured(large_image, SMALL, coordinates="pixels")
    assert "0 to 100" not in text_of(result)


async def test_the_tolerance_of_a_stated_scale_is_in_the_answer(large_image: Path) -> None:
    text = text_of(await measured(large_image, SMALL, coordinates="pixels"))
    assert "scale 0.100 m/px as stated, scale confidence" in text
    assert text.endswith("The stated scale is taken as +- 10 %.")


async def test_places_mean_the_same_in_every_kind_of_coordinates(
    server: MCPServer[object], images: Path
) -> None:
    whole = record_of(
        await called(server, "measure_distance", images / "cars.png", lines=[LINE], **MEASURED)
    )
    for coordinates, reach in (("fraction", 1), ("per_mille", 1000)):
        points = [
            {"x": point["x"] / 640 * reach, "y": point["y"] / 512 * reach}
            for point in LINE["points"]
        ]
        lines = [{"points": points}]
        result = await called(
            server,
            "measure_distance",
            images / "cars.png",
            lines=lines,
            coordinates=coordinates,
            **MEASURED,
        )
        assert record_of(result)["distance_m"] == pytest.approx(whole["distance_m"])


async def test_a_line_beside_the_photograph_of_a_page_is_told_where_to_go(
    server: MCPServer[object], images: Path
) -> None:
    page = np.full((640, 1000, 3), 255, np.uint8)
    page[64:576, 40:680] = paint_scene(640, 512)
    image = images / "beside.png"
    write_image(image, page)
    line = {"points": [{"x": 750, "y": 100}, {"x": 950, "y": 100}]}
    text = text_of(await called(server, "measure_distance", image, lines=[line]))
    image.unlink()  # tests of other modules list the folder
    assert "do not rely on it; measure inside the photograph" in text
