from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcp import Client
from mcp.server import MCPServer

import vehanchor
from tests.analyses import make_analysis
from tests.server.conversation import by_path, text_of
from tests.server.test_models import calibration_file
from vehanchor.detection.detector import load_detector
from vehanchor.models.runtime import Runtime
from vehanchor.records import GsdEstimate, Notice
from vehanchor.records.notices import NoticeCode
from vehanchor.records.text import significant
from vehanchor_server.app import create_server
from vehanchor_server.services import create_services
from vehanchor_server.settings import Settings
from vehanchor_server.tools.messages import answer_of

pytestmark = pytest.mark.anyio


async def test_a_call_gives_the_librarys_record_and_a_sentence(
    server: MCPServer[object], images: Path, detector_path: Path, era: str
) -> None:
    expected = vehanchor.estimate_gsd(images / "cars.png", detector=load_detector(detector_path, Runtime(threads=1)))
    async with Client(server, mode=era) as client:
        result = await client.call_tool("estimate_gsd", by_path(images / "cars.png"))
    assert not result.is_error
    assert result.structured_content == expected.model_dump(mode="json")
    assert len(result.content) == 1
    assert text_of(result).startswith(f"{significant(expected.gsd_m_per_px or 0)} m/px (95 % interval ")
    assert f"confidence {expected.confidence:.2f} from 24 vehicles: safe to use." in text_of(result)


async def test_callers_limit_the_search(server: MCPServer[object], images: Path) -> None:
    async with Client(server) as client:
        listed = {tool.name: tool.input_schema for tool in (await client.list_tools()).tools}
        large = by_path(images / "large.png")
        result = await client.call_tool("estimate_gsd", {**large, "max_tiles": 2, "effort": "full"})
        refused = await client.call_tool("estimate_gsd", {**large, "effort": "most"})
    assert result.structured_content is not None
    assert (
        result.structured_content["details"]["tiles_searched"],
        result.structured_content["details"]["stopped_because"],
    ) == (
        2,
        "max_tiles",
    )
    assert refused.is_error
    assert "effort" not in listed["estimate_gsd"]["properties"]  # a model need not know of it


async def test_no_vehicle_is_a_result_not_an_error(server: MCPServer[object], images: Path, era: str) -> None:
    async with Client(server, mode=era) as client:
        result = await client.call_tool("estimate_gsd", by_path(images / "empty.png"))
    assert not result.is_error
    assert result.structured_content is not None
    assert result.structured_content["status"] == "no_scale"
    assert result.structured_content["gsd_m_per_px"] is None
    assert result.structured_content["confidence"] == 0
    assert text_of(result) == (
        "No ruler was found, confidence 0: no metric scale (no car was found); add a car that has no box (add), or "
        "draw a line over a container or court (known_lengths)."
    )


async def test_few_vehicles_are_a_result_that_says_not_to_rely_on_it(server: MCPServer[object], images: Path) -> None:
    async with Client(server) as client:
        result = await client.call_tool("estimate_gsd", by_path(images / "two.png"))
    assert result.structured_content is not None
    assert result.structured_content["status"] == "low_confidence"
    assert text_of(result).endswith(
        "from 2 vehicles: do not rely on it (2 vehicles alone: too little evidence); give the region (region), or add "
        "a car that has no box (add)."
    )


async def test_arguments_reach_the_library(server: MCPServer[object], images: Path, detector_path: Path) -> None:
    expected = vehanchor.estimate_gsd(
        images / "cars.png",
        detector=load_detector(detector_path, Runtime(threads=1)),
        reference_length_m=4.6,
        frame=(320, 256),
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
    assert by_region.structured_content["details"]["reference_length_m"] == pytest.approx(4.5)
    assert "Region europe: cars of 4.50 m." in text_of(by_region)


async def test_lines_of_known_length_are_read_in_the_callers_frame_and_held_against_the_vehicles(
    server: MCPServer[object], images: Path
) -> None:
    line = {"x1": 10, "y1": 10, "x2": 110, "y2": 10, "metres": 200}
    arguments = {**by_path(images / "cars.png"), "frame": {"width_px": 320, "height_px": 256}, "known_lengths": [line]}
    async with Client(server) as client:
        heard = await client.call_tool("estimate_gsd", arguments)
        refused = await client.call_tool("estimate_gsd", {**arguments, "known_lengths": [{**line, "x2": 11}]})
    assert "The given line, assumed, gives 1 m/px" in text_of(heard)  # 2 m/px of the frame, which is half as large
    assert heard.structured_content is not None
    assert "rulers_disagree" in [warning["code"] for warning in heard.structured_content["warnings"]]
    assert refused.is_error
    assert "invalid_known_length" in text_of(refused)


async def test_vehicles_are_corrected_by_hand_in_the_callers_frame(server: MCPServer[object], images: Path) -> None:
    photo = by_path(images / "cars.png")
    async with Client(server) as client:
        listed = {tool.name: tool.input_schema for tool in (await client.list_tools()).tools}
        plain = (await client.call_tool("estimate_gsd", photo)).structured_content
        assert plain is not None
        n = plain["details"]["n_detections"]
        told = {"drop": str(n), "add": [{"x1": 1, "y1": 2, "x2": 21, "y2": 2}]}
        frame = {"width_px": plain["image_width_px"] // 2, "height_px": plain["image_height_px"] // 2}
        result = await client.call_tool("estimate_gsd", {**photo, **told, "frame": frame})
        missing = await client.call_tool("estimate_gsd", {**photo, "drop": f"1,{n + 1}"})
        unreadable = await client.call_tool("estimate_gsd", {**photo, "drop": "all"})
    assert "drop" in listed["estimate_gsd"]["properties"]
    assert not result.is_error, text_of(result)
    assert result.structured_content is not None
    assert result.structured_content["details"]["by_hand"] == {"dropped": 1, "added": 1}
    assert result.structured_content["confidence"] <= 0.99
    assert "by hand: 1 added, 1 dropped" in text_of(result)
    assert missing.is_error
    assert f"drop has number {n + 1}, which is no vehicle of this image: they are 1 to {n}" in text_of(missing)
    assert "use numbers and ranges with commas, as 1-20,23" in text_of(unreadable)


async def test_a_height_is_a_ruler_and_makes_a_scale_without_vehicles(server: MCPServer[object], images: Path) -> None:
    arguments = {**by_path(images / "empty.png"), "height_m": 100, "height_basis": "measured", "focal_35mm": 24}
    async with Client(server) as client:
        heard = await client.call_tool("estimate_gsd", arguments)
        lone = await client.call_tool("estimate_gsd", {**by_path(images / "empty.png"), "focal_35mm": 24})
        impossible = await client.call_tool("estimate_gsd", {**arguments, "height_m": 0})
    assert heard.structured_content is not None
    assert heard.structured_content["leading_ruler"] == "height"
    assert heard.structured_content["n_vehicles"] == 0
    assert "from given height: safe to use." in text_of(heard)
    assert "The given height, measured, gives" in text_of(heard)
    assert "give height_m" in text_of(lone)
    assert impossible.is_error


async def test_the_operators_calibration_is_the_ruler_of_callers_who_name_none(
    settings: Settings, images: Path, tmp_path: Path
) -> None:
    calibration = calibration_file(tmp_path / "c.json")
    server = create_server(create_services(replace(settings, calibration=calibration)))
    async with Client(server) as client:
        result = await client.call_tool("estimate_gsd", by_path(images / "cars.png"))
        named = await client.call_tool("estimate_gsd", {**by_path(images / "cars.png"), "reference_length_m": 4.8})
    assert result.structured_content is not None
    assert result.structured_content["details"]["reference_length_m"] == 4.31
    assert named.structured_content is not None
    assert named.structured_content["details"]["reference_length_m"] == 4.8


@pytest.fixture
def doubtful() -> GsdEstimate:
    """An estimate from two vehicles."""
    boxes = np.array([[x, 50.0, 30.0, 12.0, 0.0] for x in (50.0, 150.0)])
    estimate = make_analysis(boxes, 400, 300).estimate
    assert estimate.status == "low_confidence"
    return estimate


LINE = "draw a line over a parking bay or lane dash (known_lengths)"
CAR, REGION = "add a car that has no box (add)", "give the region (region)"
DROP = "drop boxes that are no cars, see view_image (drop)"


@pytest.mark.parametrize(
    ("changes", "remedies"),
    [
        ({"reason": "too_few"}, [REGION, CAR]),
        ({"reason": "imprecise"}, [REGION, CAR]),
        ({"reason": "assumed"}, [REGION, CAR]),
        ({"reason": "too_few", "reference_source": "region"}, [CAR, LINE]),
        ({"reason": "not_cars"}, [DROP, LINE]),
        ({"reason": "disagree"}, [DROP, LINE]),
        ({"reason": "too_coarse"}, ["send the original image", LINE]),
    ],
)
def test_advice_names_at_most_two_remedies_by_arguments_the_best_first(
    doubtful: GsdEstimate, changes: dict[str, Any], remedies: list[str]
) -> None:
    details = doubtful.details.model_copy(update={"reference_source": changes.get("reference_source", "model")})
    told = doubtful.model_copy(update={"reason": changes["reason"], "details": details})
    words = answer_of([told], (), "short").text
    assert words.endswith(f"; {', or '.join(remedies)}.")
    assert not {"height", "if it is", "guess"} & set(words.split())


def test_a_single_vehicle_is_counted_in_the_singular(doubtful: GsdEstimate) -> None:
    assert "from 1 vehicle: " in answer_of([doubtful.model_copy(update={"n_vehicles": 1})], (), "short").text


def test_doubts_about_the_fleet_are_told_with_their_warning(doubtful: GsdEstimate) -> None:
    notice = Notice(code=NoticeCode.LOOK_ALIKES, message="They are all alike.")
    words = answer_of([doubtful.model_copy(update={"warnings": (notice,), "reason": "not_cars"})], (), "short").text
    assert f"(the vehicles may not be cars); {DROP}, or {LINE}." in words
    assert words.endswith("Warning look_alikes: They are all alike.")


@pytest.mark.parametrize(("gsd", "words"), [(0.15234, "0.152 m/px"), (12.345, "12.3 m/px"), (1234.5, "1234 m/px")])
def test_numbers_have_three_digits_and_no_exponent(doubtful: GsdEstimate, gsd: float, words: str) -> None:
    assert answer_of([doubtful.model_copy(update={"gsd_m_per_px": gsd})], (), "short").text.startswith(words)
