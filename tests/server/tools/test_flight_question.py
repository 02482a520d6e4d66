from __future__ import annotations

import re
from functools import partial
from pathlib import Path
from typing import Any

import anyio
import numpy as np
import pytest
from mcp import Client
from mcp.server import MCPServer

from tests.flight.ground import ground, photograph_of
from tests.models import paint_vehicles
from tests.sam_models import SamFiles
from tests.server.conftest import LENGTH_PX, paint_scene, settings_with_models, write_image
from tests.server.conversation import by_path, called, error_of, picture_of, record_of, text_of
from vehanchor.options.rulers import StatedScale
from vehanchor.rulers.stated_scale import stated_witness
from vehanchor.scale.posterior import judge
from vehanchor_server.app import create_server
from vehanchor_server.services import create_services
from vehanchor_server.settings import Settings
from vehanchor_server.tools.flight_question import MAX_MORE_IMAGES
from vehanchor_server.tools.measuring_call import _USABLE_TOLERANCE

pytestmark = pytest.mark.anyio

CARS_M = 5.045  # the stand-in detector's reference length


def _named(path: Path) -> dict[str, str]:
    return {"kind": "path", "path": str(path)}


def _among(first: Path, *others: Path, **more: Any) -> dict[str, Any]:
    return {**by_path(first), "more_images": [_named(path) for path in others], **more}


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A root for this module alone, because other tests count the files in theirs."""
    root = tmp_path_factory.mktemp("flights").resolve()
    for name, cars in (("two.png", 2), ("more.png", 9), ("empty.png", 0)):
        write_image(root / name, paint_scene(640, 512, cars))
    return root


@pytest.fixture(scope="module")
def settings(images: Path, detector_path: Path, segmenter_paths: SamFiles) -> Settings:
    return settings_with_models((images,), detector_path, segmenter_paths)


@pytest.fixture(scope="module")
def server(settings: Settings) -> MCPServer[object]:
    return create_server(create_services(settings))


@pytest.fixture(scope="module")
def flight(images: Path) -> Path:
    """``here.png`` without a car, ``near.png`` with cars that overlaps it, ``elsewhere.png``."""
    folder = images / "flight"
    folder.mkdir()
    world = ground(seed=5)
    other = ground(seed=6)
    near = np.ascontiguousarray(photograph_of(world, 660, 580, turn_deg=30))
    paint_vehicles(
        near,
        [
            [60 + 70 * (k % 6), 60 + 90 * (k // 6), LENGTH_PX + k % 3 - 1, 14, 0.4]
            for k in range(24)
        ],
    )
    write_image(folder / "near.png", near)
    write_image(folder / "here.png", photograph_of(world, 600, 600, scale=1.25))
    write_image(folder / "elsewhere.png", photograph_of(other, 600, 600))
    (folder / "broken.png").write_text("no image")
    return folder


@pytest.fixture(scope="module")
def overlapping(server: MCPServer[object], flight: Path) -> dict[str, Any]:
    """The record of an image without cars, with a linked image and an unlinked one."""
    arguments = _overlapping_call(flight)
    return record_of(anyio.run(partial(called, server, "estimate_gsd", **arguments)))


def _overlapping_call(flight: Path) -> dict[str, Any]:
    arguments = _among(flight / "here.png", flight / "elsewhere.png", flight / "near.png")
    return {**arguments, "frame": {"width_px": 250, "height_px": 250}}


async def test_an_image_without_cars_has_no_scale_of_its_own(
    server: MCPServer[object], flight: Path
) -> None:
    alone = record_of(await called(server, "estimate_gsd", flight / "here.png"))
    assert alone["gsd_m_per_px"] is None


def test_an_image_without_cars_has_the_scale_of_its_flight(overlapping: dict[str, Any]) -> None:
    gsd = overlapping["gsd_m_per_px"]
    assert gsd == pytest.approx(1.25 * CARS_M / LENGTH_PX, rel=0.03)
    assert overlapping["rulers"][0]["gsd_m_per_px"] == pytest.approx(gsd, rel=0.01)
    assert overlapping["scale"]["gsd_m_per_px"] == gsd
    assert overlapping["warnings"] == []


def test_a_scale_of_a_flight_has_an_interval(overlapping: dict[str, Any]) -> None:
    gsd = overlapping["gsd_m_per_px"]
    assert overlapping["gsd_ci95_low_m_per_px"] < gsd < overlapping["gsd_ci95_high_m_per_px"]


def test_a_scale_of_a_flight_is_given_in_the_callers_frame(overlapping: dict[str, Any]) -> None:
    gsd = overlapping["frame"]["gsd_m_per_px"]
    assert gsd == pytest.approx(2 * overlapping["gsd_m_per_px"])


async def test_a_call_about_a_flight_can_be_shown(server: MCPServer[object], flight: Path) -> None:
    call = {"tool": "estimate_gsd", "arguments": _overlapping_call(flight)}
    shown = await called(server, "view_image", of=call)
    assert picture_of(shown).shape[0] > 250


async def test_an_unlinked_image_keeps_its_own_scale_with_a_warning(
    server: MCPServer[object], flight: Path
) -> None:
    own = record_of(await called(server, "estimate_gsd", flight / "near.png"))
    among = record_of(
        await called(
            server, "estimate_gsd", **_among(flight / "near.png", flight / "elsewhere.png")
        )
    )
    assert [warning["code"] for warning in among["warnings"]] == ["not_linked"]
    assert digits({**among, "warnings": []}) == digits(own)


def digits(value: Any) -> Any:
    """A record with twelve digits; the last bits of a product depend on its factors' order."""
    if isinstance(value, dict):
        return {name: digits(item) for name, item in value.items()}
    if isinstance(value, list):
        return [digits(item) for item in value]
    return float(f"{value:.12g}") if isinstance(value, float) else value


async def test_images_of_one_scale_put_their_vehicles_together(
    server: MCPServer[object], images: Path
) -> None:
    arguments = _among(
        images / "two.png", images / "more.png", images / "empty.png", same_scale=True
    )
    alone = record_of(await called(server, "estimate_gsd", images / "two.png"))
    among = record_of(await called(server, "estimate_gsd", **arguments))
    # The pictures show the same ground, and of nine cars in one of them, two are in another.
    assert (among["status"], among["rulers"][0]["n"]) == ("ok", 9)
    assert among["confidence"] > alone["confidence"]


async def test_what_cannot_be_used_is_named_by_its_place(
    server: MCPServer[object], flight: Path, images: Path
) -> None:
    here = flight / "here.png"
    near = flight / "near.png"
    line = {"x1": 0, "y1": 0, "x2": 99, "y2": 0, "metres": 9}
    cases = [
        (_among(here, near, flight / "broken.png"), "image_undecodable", "more_images.1"),
        (_among(here, near, Path("/etc/passwd")), "path_not_allowed", "more_images.1"),
        (_among(here, near, images / "no such.png"), "image_not_found", "more_images.1"),
        (_among(here, near, here), "invalid_arguments", "more_images.1 is the same image as image"),
        (_among(flight / "broken.png", near), "image_undecodable", ""),
        (_among(here, *[near] * (MAX_MORE_IMAGES + 1)), "invalid_arguments", "more_images"),
        (_among(here, near, known_lengths=[line]), "invalid_arguments", "known_lengths belong"),
        (_among(here, near, same_scale=True), "invalid_parameter", "scale: image."),
        (_among(here, near, drop="1"), "invalid_arguments", "drop belongs to a single image"),
        (
            {**by_path(here), "more_images": [{"kind": "data", "data": "x"}]},
            "invalid_arguments",
            "more_images.0",
        ),
    ]
    async with Client(server) as client:
        for arguments, code, words in cases:
            result = await client.call_tool("estimate_gsd", arguments)
            assert error_of(result).startswith(code), text_of(result)
            assert words in text_of(result)
            assert "/proc/" not in text_of(result)


async def test_a_scale_from_several_images_measures_the_first_as_its_text_says(
    server: MCPServer[object], flight: Path
) -> None:
    text = text_of(await called(server, "estimate_gsd", **_overlapping_call(flight)))
    given = re.search(r"give gsd_m_per_px ([\d.]+), gsd_tolerance ([\d.]+) and gsd_basis", text)
    assert given is not None, text
    gsd, tolerance = map(float, given.groups())
    line = {"points": [{"x": 10, "y": 10}, {"x": 110, "y": 10}]}
    result = await called(
        server,
        "measure_distance",
        flight / "here.png",
        lines=[line],
        gsd_m_per_px=gsd,
        gsd_tolerance=tolerance,
        gsd_basis="measured",
    )
    record = record_of(result)
    assert record["status"] == "ok"
    assert record["distance_m"] == pytest.approx(100 * gsd, rel=0.01)


def test_the_tolerance_to_give_leaves_a_scale_usable() -> None:
    widest = StatedScale(0.05, "measured", tolerance=0.05 * _USABLE_TOLERANCE)
    decided = judge([stated_witness(widest)])
    assert decided is not None
    assert decided.usable
