"""``measure_area`` where it differs from ``estimate_gsd``: targets, segmenter, alternatives."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import anyio
import cv2
import jsonschema
import pytest
from mcp import Client
from mcp.server import MCPServer
from mcp.types import CallToolResult

import vehanchor
from tests.sam_models import SamFiles, write_sam
from tests.server.conftest import POOL_BOX
from tests.server.conversation import (
    by_path,
    called,
    check_shape,
    error_of,
    input_schema,
    record_of,
    text_of,
)
from tests.server.test_app import AREA as AREA_TOKENS
from vehanchor.detection.detector import load_detector
from vehanchor.models.runtime import Runtime
from vehanchor.records import AreaMeasurement, Notice, OtherObject
from vehanchor_server.app import create_server
from vehanchor_server.calls.compact import short_record
from vehanchor_server.services import create_services
from vehanchor_server.settings import Settings
from vehanchor_server.tools.messages import answer_of

pytestmark = pytest.mark.anyio

Call = Callable[..., Any]
BOX = POOL_BOX["x_min"], POOL_BOX["y_min"], POOL_BOX["x_max"], POOL_BOX["y_max"]

MEASURED = {"gsd_basis": "measured"}


def pool_in(path: Path, **more: Any) -> dict[str, Any]:
    return {**by_path(path), "targets": [{"box": POOL_BOX}], **more}


async def asked(server: MCPServer[object], arguments: dict[str, Any]) -> CallToolResult:
    return await called(server, "measure_area", **arguments)


async def test_a_call_gives_the_librarys_record_with_a_sentence(
    server: MCPServer[object], images: Path, detector_path: Path, segmenter_paths: SamFiles
) -> None:
    expected = vehanchor.measure_area(
        images / "pool.png",
        box=BOX,
        detector=load_detector(detector_path, Runtime(threads=1)),
        segmenter=segmenter_paths,
    )
    result = await asked(server, pool_in(images / "pool.png"))
    assert record_of(result) == expected.model_dump(mode="json")
    assert len(result.content) == 1
    assert text_of(result).startswith(f"{expected.area_m2:.0f} m2 (95 % interval ")
    assert (
        f"from 24 vehicles, scale confidence {expected.scale_confidence:.2f}: safe to use."
        in text_of(result)
    )
    assert "Mask of 4584 px: x 300 to 348, y 330 to 426 in your image." in text_of(result)


async def test_points_include_or_exclude(
    server: MCPServer[object], images: Path, detector_path: Path, segmenter_paths: SamFiles
) -> None:
    points = [(324.0, 378.0, True), (200.0, 400.0, False)]
    expected = vehanchor.measure_area(
        images / "pool.png",
        points=points,
        detector=load_detector(detector_path, Runtime(threads=1)),
        segmenter=segmenter_paths,
    )
    named: list[dict[str, Any]] = [{"x": 324, "y": 378}, {"x": 200, "y": 400, "label": "exclude"}]
    assert record_of(
        await asked(server, {**by_path(images / "pool.png"), "targets": [{"points": named}]})
    ) == (expected.model_dump(mode="json"))
    named[1]["label"] = "include"
    other = record_of(
        await asked(server, {**by_path(images / "pool.png"), "targets": [{"points": named}]})
    )
    assert other["bounding_box"] != expected.model_dump(mode="json")["bounding_box"]


class TwoPools(NamedTuple):
    """Short and full answers about a point that may mean one pool or two."""

    short: dict[str, Any]
    text: str
    full: dict[str, Any]

    @property
    def sizes_m2(self) -> list[float]:
        return [other["area_m2"] for other in self.full["alternatives"]]


@pytest.fixture(scope="module")
def two_pools(server: MCPServer[object], images: Path) -> TwoPools:
    pools = cv2.imread(str(images / "pool_alone.png"))
    assert pools is not None
    # A second pool beside the first; the toy network takes both in a large crop.
    pools[330:426, 400:448] = pools[330:426, 300:348]
    # Not as a file: other tests list the folder.
    data = base64.b64encode(cv2.imencode(".png", pools)[1].tobytes()).decode()
    arguments = {
        "image": {"kind": "base64", "data": data},
        "targets": [{"points": [{"x": 162, "y": 189}]}],
        "gsd_m_per_px": 0.15,
        "frame": {"width_px": 320, "height_px": 256},
        **MEASURED,
    }
    short = anyio.run(asked, server, arguments)
    full = anyio.run(asked, server, {**arguments, "detail": "full"})
    return TwoPools(record_of(short), text_of(short), record_of(full))


def test_a_mask_of_unknown_extent_is_not_usable(two_pools: TwoPools) -> None:
    assert two_pools.full["status"] == two_pools.short["status"] == "low_confidence"
    advice = "do not rely on it; give a tight box drawn by eye around the object that you mean."
    assert advice in two_pools.text


def test_alternatives_have_the_scale_of_the_image(two_pools: TwoPools) -> None:
    expected = [other["mask_area_px"] * 0.15**2 for other in two_pools.full["alternatives"]]
    assert two_pools.sizes_m2 == pytest.approx(expected)


def test_a_short_answer_has_the_alternatives(two_pools: TwoPools) -> None:
    sizes = [other["area_m2"] for other in two_pools.short["alternatives"]]
    assert sizes == pytest.approx(two_pools.sizes_m2, rel=0.005)
    words = " or ".join(f"{size:.3g} m2" for size in two_pools.sizes_m2)
    assert f"Or you mean {words}." in two_pools.text


def test_a_short_answer_omits_the_box_of_a_mask_of_unknown_extent(two_pools: TwoPools) -> None:
    assert "bounding_box" in two_pools.full["frame"]
    assert "bounding_box" not in {**two_pools.short, **two_pools.short["frame"]}
    assert "Mask:" not in two_pools.text


async def test_advice_on_a_doubtful_scale_names_a_doubtful_mask_too(
    settings: Settings, images: Path, tmp_path: Path
) -> None:
    server = create_server(
        create_services(replace(settings, segmenter=write_sam(tmp_path, scores=[0.4])))
    )
    arguments = pool_in(images / "pool.png")
    without_scale = {
        name: value for name, value in arguments.items() if not name.startswith("gsd_")
    }
    text = text_of(await asked(server, {**without_scale, "drop": "2-24"}))
    assert "; and for the mask, look at it with view_image" in text


async def test_a_mask_that_the_segmenter_doubts_comes_with_a_warning(
    settings: Settings, images: Path, tmp_path: Path
) -> None:
    server = create_server(
        create_services(replace(settings, segmenter=write_sam(tmp_path, scores=[0.4])))
    )
    result = await asked(server, pool_in(images / "pool.png"))
    assert record_of(result)["status"] == "low_confidence"
    assert (
        "do not rely on it; look at it with view_image, and give a tight box, or its outline "
        "(polygon), by eye." in text_of(result)
    )
    assert (
        "Warning mask_score_low: The expected overlap with the object is 0.40, below 0.7."
        in text_of(result)
    )


@pytest.mark.parametrize(
    ("target", "words"),
    [
        ({}, "targets.0: give either box, points or polygon: "),
        (..., "targets: it is required"),
        (None, "targets.0: "),
        (
            {"box": POOL_BOX, "points": [{"x": 1, "y": 1}]},
            "targets.0: give either box, points or polygon",
        ),
        ({"box": {**POOL_BOX, "x_min": None}}, "targets.0.box.x_min: "),
        ({"box": {"x_min": 1, "y_min": 2, "x_max": 3}}, "targets.0.box.y_max: it is required"),
        ({"box": {**POOL_BOX, "x_max": "inf"}}, "targets.0.box.x_max: give a number"),
        ({"box": {**POOL_BOX, "unit": "m"}}, "targets.0.box.unit: there is no such argument"),
        ({"points": [{"x": 1, "y": 1}] * 33}, "targets.0.points: give a list of 1 to 32 items"),
        (
            {"points": [{"x": 1, "y": 1, "label": "yes"}]},
            'targets.0.points.0.label: give one of "include", "exclude"',
        ),
    ],
)
async def test_a_target_of_the_wrong_form_is_refused_in_one_line(
    server: MCPServer[object], images: Path, target: Any, words: str
) -> None:
    arguments = {**by_path(images / "pool.png"), **({} if target is ... else {"targets": [target]})}
    result = await asked(server, arguments)
    assert error_of(result) == "invalid_arguments"
    assert words in text_of(result)
    assert "\n" not in text_of(result)
    with pytest.raises(jsonschema.ValidationError):
        check_shape(arguments, input_schema("measure_area"))


async def test_a_missing_segmenter_stops_only_measure_area(
    settings: Settings, images: Path, caplog: pytest.LogCaptureFixture
) -> None:
    files = Path("/nowhere/secret.onnx"), Path("/nowhere/decoder.onnx")
    server = create_server(create_services(replace(settings, segmenter=files)))
    result = await asked(server, pool_in(images / "pool.png"))
    estimate = await called(server, "estimate_gsd", images / "pool.png")
    assert text_of(result) == (
        "model_unavailable: this server's segmenter cannot be loaded (model_not_found). Its "
        "operator must check "
        "--segmenter."
    )
    assert "/nowhere/secret.onnx" in caplog.text
    assert not estimate.is_error


async def test_targets_are_in_the_callers_frame(server: MCPServer[object], images: Path) -> None:
    half = {name: value / 2 for name, value in POOL_BOX.items()}
    frame = {"width_px": 320, "height_px": 256}
    result = await asked(
        server, {**by_path(images / "pool.png"), "targets": [{"box": half}], "frame": frame}
    )
    whole = record_of(await asked(server, pool_in(images / "pool.png")))
    record = record_of(result)
    assert record["area_m2"] == whole["area_m2"]
    assert record["frame"]["gsd_m_per_px"] == pytest.approx(2 * whole["gsd_m_per_px"])
    assert "Mask of 4584 px: x 150 to 174, y 165 to 213 in your copy." in text_of(result)


async def test_the_longest_answer_about_an_area_stays_short(
    server: MCPServer[object], images: Path
) -> None:
    frame = {"width_px": 320, "height_px": 256}
    half = {name: value / 2 for name, value in POOL_BOX.items()}
    full = {
        **by_path(images / "pool_two.png"),
        "targets": [{"box": half}],
        "frame": frame,
        "detail": "full",
    }
    area = AreaMeasurement.model_validate(record_of(await asked(server, full)))
    assert area.estimate is not None
    assert area.bounding_box is not None
    other = OtherObject(
        area_m2=1234.5, mask_area_px=12345, mask_score=0.8, bounding_box=area.bounding_box
    )
    codes = (
        "extent_unknown",
        "mask_score_low",
        "mask_touches_edge",
        "mask_in_pieces",
        "target_small",
    )
    notices = tuple(Notice(code=code, message=f"{'A fact ' * 12}. And more.") for code in codes)
    changes = {"reason": "not_cars", "n_vehicles": 24}
    worst = area.model_copy(
        update={
            "alternatives": (other, other),
            "warnings": notices,
            "estimate": area.estimate.model_copy(update=changes),
        }
    )
    answer = answer_of([worst], ["Region europe: cars of 4.85 m."], "short")
    assert len(answer.text) <= 4 * AREA_TOKENS[0]
    assert answer.text.endswith("Region europe: cars of 4.85 m.")
    assert all(notice.code in answer.text for notice in notices)
    assert (
        len(json.dumps(short_record([worst], answer.warnings), separators=(",", ":")))
        <= 4 * AREA_TOKENS[1]
    )


# --- Polygons of the caller


CORNERS = [300, 330, 348, 330, 348, 426, 300, 426]


async def test_a_polygon_is_measured_by_its_corners(
    server: MCPServer[object], images: Path
) -> None:
    targets = [{"polygon": CORNERS}]
    result = await asked(
        server, {**by_path(images / "pool.png"), "targets": targets, "detail": "full"}
    )
    record = record_of(result)
    assert record["polygon_area_px"] == 48 * 96
    assert (record["mask_score"], record["segmenter"], record["status"]) == (None, None, "ok")
    assert "Mask of 4608 px: x 300 to 348, y 330 to 426 in your image." in text_of(result)


async def test_a_polygon_and_a_box_share_a_call(server: MCPServer[object], images: Path) -> None:
    targets = [{"polygon": CORNERS}, {"box": POOL_BOX}]
    image = {"image": by_path(images / "pool.png")["image"]}
    result = await asked(server, {**image, "targets": targets})
    polygon, box = record_of(result)["measurements"]
    assert "mask_score" not in polygon
    assert polygon["area_m2"] == pytest.approx(box["area_m2"], rel=0.1)


@pytest.mark.parametrize(
    ("polygon", "message"),
    [
        (CORNERS[:4], "6 to 400 items"),
        (CORNERS[:7], "odd number"),
        ([*CORNERS[:4], *CORNERS[6:], *CORNERS[4:6]], "lines cross"),
        ([*CORNERS[:4], 9000, 426], "not inside the"),
        ([0.1, 0.1, 0.2, 0.1, 0.2, 0.2], "all coordinates lie in 0 to 1"),
        (CORNERS * 51, "6 to 400 items"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
async def test_a_bad_polygon_is_refused(
    server: MCPServer[object], images: Path, polygon: list[float], message: str
) -> None:
    targets = [{"polygon": polygon}]
    result = await asked(server, {**by_path(images / "pool.png"), "targets": targets})
    assert result.is_error
    assert message in text_of(result)


# --- What must fit


async def test_a_fit_is_stated_in_words_and_fields(server: MCPServer[object], images: Path) -> None:
    image = {"image": by_path(images / "pool.png")["image"]}
    must_fit = {"length_m": 5, "width_m": 3}
    result = await asked(server, {**image, "targets": [{"polygon": CORNERS}], "must_fit": must_fit})
    record = record_of(result)
    fit = record["fit"]
    assert 0.9 < fit["fit_probability"] <= record["scale_confidence"]
    assert (fit["center"]["x_px"], fit["center"]["y_px"]) == pytest.approx((324, 378), abs=1)
    assert len(fit["corners"]) == 4
    assert fit["n_fits_at_least"] >= 2
    # Of other sizes only the largest circle is stated.
    assert record["inscribed_diameter_m"] > 5
    assert "length_m" not in record
    assert "inscribed_center" not in record
    assert "5 x 3 m fits with probability 0.9" in text_of(result)
    assert "centre x 324, y 378 in your image, heading" in text_of(result)
    circle = f"; the largest circle inside is {record['inscribed_diameter_m']} m across."
    assert circle in text_of(result)


async def test_a_fit_lies_in_the_callers_copy(server: MCPServer[object], images: Path) -> None:
    half = [number / 2 for number in CORNERS]
    result = await asked(
        server,
        {
            "image": by_path(images / "pool.png")["image"],
            "targets": [{"polygon": half}],
            "must_fit": {"length_m": 5, "width_m": 3},
            "frame": {"width_px": 320, "height_px": 256},
        },
    )
    record = record_of(result)
    centre = record["frame"]["fit_center"]
    assert (centre["x_px"], centre["y_px"]) == pytest.approx((162, 189), abs=1)
    assert "center" not in record["fit"]
    assert "centre x 162, y 189 in your copy" in text_of(result)


async def test_a_fit_at_an_unusable_scale_is_not_acted_on(
    server: MCPServer[object], images: Path
) -> None:
    image = {"image": by_path(images / "pool_two.png")["image"]}
    result = await asked(
        server,
        {**image, "targets": [{"polygon": CORNERS}], "must_fit": {"diameter_m": 0.5}},
    )
    record = record_of(result)
    assert record["status"] == "low_confidence"
    assert record["fit"]["fit_probability"] <= record["scale_confidence"]
    assert ": do not act on it." in text_of(result)


@pytest.mark.parametrize(
    "must_fit",
    [{}, {"length_m": 5}, {"diameter_m": 3, "length_m": 5, "width_m": 2}, {"diameter_m": 0}],
    ids=str,
)
async def test_a_bad_shape_to_fit_is_refused(
    server: MCPServer[object], images: Path, must_fit: dict[str, float]
) -> None:
    targets = [{"polygon": CORNERS}]
    result = await asked(
        server, {**by_path(images / "pool.png"), "targets": targets, "must_fit": must_fit}
    )
    assert result.is_error
    assert "must_fit" in text_of(result)


async def test_a_picture_shows_what_must_fit(server: MCPServer[object], images: Path) -> None:
    arguments = {
        "image": by_path(images / "pool.png")["image"],
        "targets": [{"polygon": CORNERS}],
        "must_fit": {"diameter_m": 3},
    }
    result = await called(server, "view_image", of={"tool": "measure_area", "arguments": arguments})
    assert not result.is_error


async def test_a_short_answer_has_the_pixels_of_the_mask(
    server: MCPServer[object], images: Path
) -> None:
    async with Client(server) as client:
        image = {"kind": "path", "path": str(images / "pool.png")}
        targets = [{"polygon": CORNERS}]
        result = await client.call_tool("measure_area", {"image": image, "targets": targets})
    assert record_of(result)["mask_area_px"] == 48 * 96


async def test_an_area_at_the_images_edge_is_stated_as_a_lower_bound(
    server: MCPServer[object], images: Path
) -> None:
    corners = [{"polygon": [540, 330, 640, 330, 640, 426, 540, 426]}]
    result = await asked(server, {**by_path(images / "pool_two.png"), "targets": corners})
    assert text_of(result).startswith("At least ")


@pytest.mark.parametrize("tool", ["measure_area", "measure_distance"])
async def test_a_measuring_tool_names_the_way_from_several_images(
    server: MCPServer[object], tool: str
) -> None:
    async with Client(server) as client:
        listed = {listed.name: listed for listed in (await client.list_tools()).tools}
    description = listed[tool].description
    assert description is not None
    assert "more_images" in description
    promised = {"detail", "object_height_m", "gsd_m_per_px", "gsd_tolerance", "gsd_basis"}
    assert promised <= listed[tool].input_schema["properties"].keys()
