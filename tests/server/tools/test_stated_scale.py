"""A stated scale in the measuring tools: measured, it leads; assumed, it is one witness."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mcp.server import MCPServer
from rasterio import Affine

from tests.server.conftest import POOL_BOX
from tests.server.conversation import called, error_of, record_of, text_of
from tests.skill.imagery.files import geotiff
from vehanchor_server.app import create_server
from vehanchor_server.services import create_services
from vehanchor_server.settings import Settings

pytestmark = pytest.mark.anyio

LINES = [{"points": [{"x": 20, "y": 500}, {"x": 320, "y": 100}]}]  # 500 px
LINE = {"x1": 100, "y1": 50, "x2": 300, "y2": 50, "metres": 31}
TOOLS: dict[str, dict[str, Any]] = {
    "measure_distance": {"lines": LINES},
    "measure_area": {"targets": [{"box": POOL_BOX}]},
}


async def measured(
    server: MCPServer[object], image: Path, tool: str = "measure_distance", **more: Any
) -> Any:
    return record_of(await called(server, tool, image, **TOOLS[tool], **more))


async def refused(
    server: MCPServer[object], image: Path, tool: str, **more: Any
) -> tuple[str, str]:
    result = await called(server, tool, image, **TOOLS[tool], **more)
    return error_of(result), text_of(result)


@pytest.fixture
def never_searches(monkeypatch: pytest.MonkeyPatch) -> None:
    def searched(*_: object, **__: object) -> None:
        raise AssertionError("searched")

    monkeypatch.setattr("vehanchor.analysis.memory.AnalysisMemory.analyse", searched)


@pytest.mark.parametrize("tool", TOOLS)
@pytest.mark.parametrize(("more", "half"), [({}, 0.015), ({"gsd_tolerance": 0.003}, 0.003)])
@pytest.mark.usefixtures("never_searches")
async def test_a_measured_scale_leads_without_a_search_or_a_detector(
    settings: Settings, images: Path, tool: str, more: dict[str, Any], half: float
) -> None:
    server = create_server(
        create_services(replace(settings, detector="/nowhere.onnx", calibration=Path("/nowhere")))
    )
    record = await measured(
        server, images / "pool.png", tool, gsd_m_per_px=0.15, gsd_basis="measured", **more
    )
    assert (record["status"], record["gsd_m_per_px"], record["scale_source"]) == (
        "ok",
        0.15,
        "given",
    )
    assert (record["estimate"], record["scale_confidence"] >= 0.9) == (None, True)
    if tool == "measure_distance":
        assert record["distance_m"] == pytest.approx(75)
        bounds = [record["distance_ci95_low_m"] / 500, record["distance_ci95_high_m"] / 500]
        assert bounds == pytest.approx([0.15 - half, 0.15 + half], rel=0.01)
    else:
        assert record["area_m2"] == pytest.approx(0.15**2 * record["mask_area_px"])


@pytest.mark.usefixtures("never_searches")
async def test_a_measured_scale_as_wide_as_a_guess_is_not_to_be_used(
    server: MCPServer[object], images: Path
) -> None:
    wide: dict[str, Any] = {"gsd_m_per_px": 0.15, "gsd_basis": "measured", "gsd_tolerance": 0.06}
    assert (await measured(server, images / "pool.png", **wide))["status"] == "low_confidence"


@pytest.mark.parametrize(
    "more",
    [{"known_lengths": [LINE]}, {"drop": "1"}, {"add": [{"x1": 1, "y1": 2, "x2": 21, "y2": 2}]}],
)
async def test_what_a_measured_scale_would_leave_unheard_is_refused(
    server: MCPServer[object], images: Path, more: dict[str, Any]
) -> None:
    stated = {"gsd_m_per_px": 0.15, "gsd_basis": "measured"}
    code, words = await refused(server, images / "pool.png", "measure_area", **stated, **more)
    assert code == "invalid_parameter"
    assert "give gsd_m_per_px or " in words


@pytest.mark.parametrize("more", [{"gsd_basis": "measured"}, {"gsd_tolerance": 0.01}])
@pytest.mark.parametrize("tool", TOOLS)
async def test_a_basis_or_a_tolerance_without_the_scale_is_refused(
    server: MCPServer[object], images: Path, tool: str, more: dict[str, Any]
) -> None:
    code, words = await refused(server, images / "pool.png", tool, **more)
    assert code == "invalid_parameter"
    assert "need gsd_m_per_px: give the scale, too" in words


@pytest.mark.parametrize("basis", ["assumed", "measured"])
async def test_a_tolerance_as_large_as_the_scale_is_refused(
    server: MCPServer[object], images: Path, basis: str
) -> None:
    stated = {"gsd_m_per_px": 0.15, "gsd_basis": basis, "gsd_tolerance": 0.15}
    code, words = await refused(server, images / "pool.png", "measure_distance", **stated)
    assert code == "invalid_parameter"
    assert "as large as the scale" in words


def chance_of(record: dict[str, Any], kind: str) -> float:
    (ruler,) = [ruler for ruler in record["estimate"]["rulers"] if ruler["kind"] == kind]
    return float(ruler["p_right"])


@pytest.mark.parametrize("tool", TOOLS)
async def test_an_assumed_scale_that_agrees_is_one_more_witness(
    server: MCPServer[object], images: Path, tool: str
) -> None:
    alone = await measured(server, images / "pool_two.png", tool)
    record = await measured(
        server, images / "pool_two.png", tool, gsd_m_per_px=0.95 * alone["gsd_m_per_px"]
    )
    assert alone["status"] == "low_confidence"
    assert record["scale_confidence"] > alone["scale_confidence"]
    assert record["estimate"]["n_vehicles"] == 2, "the image is searched"
    assert chance_of(record, "stated_scale") > 0.5


@pytest.mark.parametrize(
    ("factor", "status"), [(0.3, "ok"), (1.5, "low_confidence"), (4, "low_confidence")]
)
async def test_an_assumed_scale_against_the_cars_lowers_the_confidence(
    server: MCPServer[object], images: Path, factor: float, status: str
) -> None:
    alone = await measured(server, images / "pool.png")
    record = await measured(
        server, images / "pool.png", gsd_m_per_px=factor * alone["gsd_m_per_px"]
    )
    assert record["scale_confidence"] < alone["scale_confidence"]
    assert record["status"] == status
    assert "rulers_disagree" in [each["code"] for each in record["warnings"]]
    if factor != 1.5:  # there the prior of the scene agrees with the stated scale
        assert record["gsd_m_per_px"] == pytest.approx(alone["gsd_m_per_px"], rel=0.03)
        assert chance_of(record, "stated_scale") < 0.5


@pytest.mark.parametrize("image", ["pool.png", "pool_two.png"])
async def test_an_assumed_scale_that_repeats_the_images_own_changes_nothing(
    server: MCPServer[object], images: Path, image: str
) -> None:
    alone = await measured(server, images / image)
    for factor in (0.985, 1.0, 1.015):
        record = await measured(server, images / image, gsd_m_per_px=factor * alone["gsd_m_per_px"])
        assert record == alone, "the same number twice is one witness"


async def test_an_assumed_scale_alone_is_never_usable(
    server: MCPServer[object], images: Path
) -> None:
    # the prior of the scene agrees
    stated: dict[str, Any] = {"gsd_m_per_px": 0.25, "gsd_tolerance": 0.002}
    record = await measured(server, images / "empty.png", **stated)
    assert record["gsd_m_per_px"] == pytest.approx(0.25, rel=0.1)
    assert (record["status"], record["estimate"]["reason"]) == ("low_confidence", "assumed")


@pytest.fixture
def searches(monkeypatch: pytest.MonkeyPatch) -> Callable[[], int]:
    """Number of searches so far."""
    from vehanchor.analysis import memory
    from vehanchor.analysis.pipeline import analyse_raster as real

    calls = []

    def counted(*arguments: Any) -> Any:
        calls.append(arguments)
        return real(*arguments)

    monkeypatch.setattr(memory, "analyse_raster", counted)
    return lambda: len(calls)


async def estimated(server: MCPServer[object], image: Path, **more: Any) -> Any:
    return record_of(await called(server, "estimate_gsd", image, **more))


@pytest.mark.parametrize(
    "more",
    [
        {},
        {
            "frame": {"width_px": 640, "height_px": 512},
            "known_lengths": [LINE],
            "height_m": 100,
            "focal_35mm": 24,
        },
        {"drop": "1", "add": [{"x1": 100, "y1": 480, "x2": 132, "y2": 480}]},
    ],
)
async def test_a_measurement_after_an_equal_estimate_costs_no_second_search(
    settings: Settings, images: Path, searches: Callable[[], int], more: dict[str, Any]
) -> None:
    server = create_server(create_services(settings))
    estimate = await estimated(server, images / "pool.png", **more)
    assert searches() == 1
    distance = await measured(server, images / "pool.png", "measure_distance", **more)
    area = await measured(server, images / "pool.png", "measure_area", **more)
    assert await estimated(server, images / "pool.png", **more) == estimate
    assert searches() == 1
    assert distance["estimate"] == area["estimate"] == estimate
    elsewhere = create_server(create_services(settings))
    assert await measured(elsewhere, images / "pool.png", "measure_area", **more) == area, (
        "it changes no result"
    )
    assert searches() == 2


@pytest.mark.parametrize(
    ("image", "more"),
    [
        ("pool.png", {"drop": "1"}),
        ("pool.png", {"gsd_m_per_px": 0.17}),
        ("cars.png", {}),
    ],
)
async def test_another_image_or_another_argument_is_searched(
    settings: Settings, images: Path, searches: Callable[[], int], image: str, more: dict[str, Any]
) -> None:
    server = create_server(create_services(settings))
    await estimated(server, images / "pool.png")
    await measured(server, images / image, **more)
    assert searches() == 2


async def test_a_changed_file_of_the_same_name_is_searched(
    settings: Settings, images: Path, tmp_path: Path, searches: Callable[[], int]
) -> None:
    server = create_server(create_services(replace(settings, roots=(tmp_path.resolve(),))))
    image = tmp_path.resolve() / "photo.png"
    for name, n_vehicles in (("cars.png", 24), ("two.png", 2)):
        image.write_bytes((images / name).read_bytes())
        assert (await estimated(server, image))["n_vehicles"] == n_vehicles
    assert searches() == 2


async def test_a_search_that_the_clock_may_end_is_not_remembered(
    settings: Settings, images: Path, searches: Callable[[], int]
) -> None:
    server = create_server(create_services(settings))
    for _ in range(2):
        await estimated(server, images / "cars.png", max_seconds=60)
    assert searches() == 2


@pytest.fixture
def orthophoto(images: Path) -> Iterator[Path]:
    """Write the picture as a GeoTIFF of 0.16 m/px; other tests count the files of the folder."""
    picture = cv2.imread(str(images / "pool.png"))
    assert picture is not None
    path = geotiff(
        images / "ortho.tif",
        np.ascontiguousarray(picture[:, :, ::-1]),
        transform=Affine(0.16, 0, 500_000, 0, -0.16, 5_000_000),
    )
    yield path
    path.unlink()


async def test_a_georeferenced_file_is_measured_with_its_own_scale(
    settings: Settings, orthophoto: Path
) -> None:
    server = create_server(create_services(settings))
    record = await measured(server, orthophoto, "measure_distance")
    assert (record["status"], record["scale_source"]) == ("ok", "file")
    assert record["distance_m"] == pytest.approx(80)


async def test_who_asks_for_the_estimate_gets_it(settings: Settings, orthophoto: Path) -> None:
    server = create_server(create_services(settings))
    record = await measured(server, orthophoto, "measure_distance", file_scale=False)
    assert record["scale_source"] == "estimated"
