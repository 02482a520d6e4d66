from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcp import Client
from mcp.server import MCPServer

import vehanchor
from tests.analyses import make_analysis
from tests.server.conversation import by_path, called, error_of, record_of, text_of
from vehanchor.detection.detector import load_detector
from vehanchor.models.runtime import Runtime
from vehanchor.records import GsdEstimate, Reason
from vehanchor.records.text import significant
from vehanchor_server.tools.messages import answer_of

pytestmark = pytest.mark.anyio


async def test_a_call_gives_the_librarys_record_with_a_sentence(
    server: MCPServer[object], images: Path, detector_path: Path, era: str
) -> None:
    expected = vehanchor.estimate_gsd(
        images / "cars.png", detector=load_detector(detector_path, Runtime(threads=1))
    )
    result = await called(server, "estimate_gsd", images / "cars.png", era=era)
    assert record_of(result) == expected.model_dump(mode="json")
    assert len(result.content) == 1
    assert text_of(result).startswith(
        f"{significant(expected.gsd_m_per_px or 0)} m/px (95 % interval "
    )
    assert f"confidence {expected.confidence:.2f} from 24 vehicles: safe to use." in text_of(result)


async def test_callers_limit_the_search(server: MCPServer[object], images: Path) -> None:
    limited = await called(server, "estimate_gsd", images / "large.png", max_tiles=2, effort="full")
    details = record_of(limited)["details"]
    assert (details["tiles_searched"], details["stopped_because"]) == (2, "max_tiles")
    assert (await called(server, "estimate_gsd", images / "large.png", effort="most")).is_error


async def test_no_vehicle_is_a_result_not_an_error(server: MCPServer[object], images: Path) -> None:
    result = await called(server, "estimate_gsd", images / "empty.png")
    record = record_of(result)
    assert (record["status"], record["gsd_m_per_px"], record["confidence"]) == ("no_scale", None, 0)
    assert text_of(result).startswith(
        "No ruler was found, confidence 0: no metric scale (no car was found); if cars, or two "
        "different things of known size, are in sight, mark them (add, known_lengths), or give a "
        "measured length (known_lengths), or give photographs of the flight with cars "
        "(more_images), or give the height and lens (height_m, focal_35mm)."
    )


async def test_few_vehicles_are_a_result_that_says_not_to_rely_on_it(
    server: MCPServer[object], images: Path
) -> None:
    result = await called(server, "estimate_gsd", images / "two.png")
    assert record_of(result)["status"] == "low_confidence"
    reason = "from 2 vehicles: do not rely on it (2 vehicles alone: too little evidence); "
    assert f"{reason}{LINE}, or {LENGTH}." in text_of(result)


async def test_arguments_reach_the_library(
    server: MCPServer[object], images: Path, detector_path: Path
) -> None:
    detector = load_detector(detector_path, Runtime(threads=1))
    expected = vehanchor.estimate_gsd(
        images / "cars.png", detector=detector, reference_length_m=4.6, frame=(320, 256)
    )
    frame = {"width_px": 320, "height_px": 256}
    result = await called(
        server, "estimate_gsd", images / "cars.png", reference_length_m=4.6, frame=frame
    )
    assert record_of(result) == expected.model_dump(mode="json")
    assert expected.frame is not None
    assert f"In your 320 x 256 copy that is {expected.frame.gsd_m_per_px:.3g} m/px." in text_of(
        result
    )
    by_region = await called(server, "estimate_gsd", images / "cars.png", region="europe")
    assert record_of(by_region)["details"]["reference_length_m"] == pytest.approx(4.5)
    assert "europe" not in text_of(by_region)


async def test_a_country_without_measured_cars_is_not_asked_for_again(
    server: MCPServer[object], images: Path
) -> None:
    result = await called(server, "estimate_gsd", images / "cars.png", region="JP")
    codes = [warning["code"] for warning in record_of(result)["warnings"]]
    assert "region_unmeasured" in codes
    assert "give the region" not in text_of(result)


async def test_known_lengths_are_in_the_callers_frame(
    server: MCPServer[object], images: Path
) -> None:
    line = {"x1": 10, "y1": 10, "x2": 110, "y2": 10, "metres": 200}
    frame = {"width_px": 320, "height_px": 256}
    result = await called(
        server, "estimate_gsd", images / "cars.png", frame=frame, known_lengths=[line]
    )
    # 2 m/px of the frame, which is half as large
    assert "The given line, assumed, gives 1 m/px" in text_of(result)
    assert "rulers_disagree" in [warning["code"] for warning in record_of(result)["warnings"]]
    short = [{**line, "x2": 11}]
    refused = await called(
        server, "estimate_gsd", images / "cars.png", frame=frame, known_lengths=short
    )
    assert error_of(refused) == "invalid_known_length"


async def test_vehicles_are_corrected_by_hand_in_the_callers_frame(
    server: MCPServer[object], images: Path
) -> None:
    plain = record_of(await called(server, "estimate_gsd", images / "cars.png"))
    n = plain["details"]["n_detections"]
    corrections: dict[str, Any] = {"drop": str(n), "add": [{"x1": 1, "y1": 2, "x2": 21, "y2": 2}]}
    frame = {"width_px": plain["image_width_px"] // 2, "height_px": plain["image_height_px"] // 2}
    result = await called(server, "estimate_gsd", images / "cars.png", **corrections, frame=frame)
    record = record_of(result)
    assert (record["details"]["by_hand"], record["confidence"] <= 0.99) == (
        {"dropped": 1, "added": 1},
        True,
    )
    assert "by hand: 1 added, 1 dropped" in text_of(result)
    missing = await called(server, "estimate_gsd", images / "cars.png", drop=f"1,{n + 1}")
    assert missing.is_error
    assert (
        f"drop has number {n + 1}, which is not a vehicle of this image: its vehicles are 1 to {n}"
        in text_of(missing)
    )


async def test_a_height_makes_a_scale_without_vehicles(
    server: MCPServer[object], images: Path
) -> None:
    height: dict[str, Any] = {"height_m": 100, "height_basis": "measured", "focal_35mm": 24}
    result = await called(server, "estimate_gsd", images / "empty.png", **height)
    assert (record_of(result)["leading_ruler"], record_of(result)["n_vehicles"]) == ("height", 0)
    assert "from given height: safe to use." in text_of(result)
    assert "The given height, measured, gives" in text_of(result)
    assert "give height_m" in text_of(
        await called(server, "estimate_gsd", images / "empty.png", focal_35mm=24)
    )


@pytest.fixture
def doubtful() -> GsdEstimate:
    """An estimate from two vehicles."""
    boxes = np.array([[x, 50.0, 30.0, 12.0, 0.0] for x in (50.0, 150.0)])
    estimate = make_analysis(boxes, 400, 300).estimate
    assert estimate.status == "low_confidence"
    return estimate


LINE = "draw a line over parking bays or lane dashes (known_lengths)"
LENGTH = "give a measured length (known_lengths)"
DROP = "drop boxes that are not cars, see view_image (drop)"
ORIGINAL = "send the original image"


@pytest.mark.parametrize(
    ("reason", "remedies"),
    [
        ("too_few", [LINE, LENGTH]),
        ("assumed", [LINE, LENGTH]),
        ("not_cars", [DROP, LINE]),
        ("too_coarse", [ORIGINAL, LINE]),
    ],
)
def test_advice_names_at_most_two_remedies_by_arguments_the_best_first(
    doubtful: GsdEstimate, reason: Reason, remedies: list[str]
) -> None:
    estimate = doubtful.model_copy(update={"reason": reason})
    words = answer_of([estimate], (), "short").text
    assert words.endswith(f"; {', or '.join(remedies)}.")
    assert "guess" not in words


def test_a_full_answer_has_the_rulers_and_the_gains(doubtful: GsdEstimate) -> None:
    text = answer_of([doubtful], (), "full").text
    (cars,) = [ruler for ruler in doubtful.rulers if ruler.kind == "vehicles"]
    assert f"Vehicles: {significant(cars.gsd_m_per_px)} m/px (95 % interval" in text
    assert "Expected confidence by remedy: length" in text
    assert text.startswith(answer_of([doubtful], (), "short").text)


# --- Resampling for another model


async def test_a_target_scale_gives_the_factor(server: MCPServer[object], images: Path) -> None:
    image = {"image": by_path(images / "cars.png")["image"]}
    result = await called(server, "estimate_gsd", **image, target_gsd_m_per_px=0.3)
    gsd = record_of(result)["gsd_m_per_px"]
    factor = f"resample the image by {gsd / 0.3:.3f}"
    assert factor[:-1] in text_of(result)
    assert any("resample the image by" in hint for hint in record_of(result)["warnings"])


async def test_a_copy_has_its_own_factor(server: MCPServer[object], images: Path) -> None:
    arguments = {
        "image": by_path(images / "cars.png")["image"],
        "frame": {"width_px": 320, "height_px": 256},
        "target_gsd_m_per_px": 0.05,
    }
    text = text_of(await called(server, "estimate_gsd", **arguments))
    assert "resample your copy by" in text
    assert "Enlarging adds no detail." in text


async def test_an_unusable_scale_gives_no_factor(server: MCPServer[object], images: Path) -> None:
    image = {"image": by_path(images / "empty.png")["image"]}
    result = await called(server, "estimate_gsd", **image, target_gsd_m_per_px=0.3)
    assert "Do not resample for 0.3 m/px: the scale is not usable." in text_of(result)


async def test_an_answer_lists_the_vehicles_on_request(
    server: MCPServer[object], images: Path
) -> None:
    image = {"kind": "path", "path": str(images / "cars.png")}
    async with Client(server) as client:
        result = await client.call_tool("estimate_gsd", {"image": image, "list_vehicles": True})
    record = record_of(result)
    vehicles = record["vehicles"]
    assert [vehicle["number"] for vehicle in vehicles] == list(range(1, len(vehicles) + 1))
    assert sum(vehicle["used"] for vehicle in vehicles) == record["n_vehicles"]
    first = vehicles[0]
    assert f"1 at {first['x_px']:.0f}, {first['y_px']:.0f}, " in text_of(result)


async def test_a_height_in_feet_is_refused_with_its_metres(
    server: MCPServer[object], images: Path
) -> None:
    result = await called(server, "estimate_gsd", images / "cars.png", height_m="120 ft")
    assert error_of(result) == "invalid_arguments"
    assert "height_m: give a number without a unit: 36.58 m" in text_of(result)
