"""Photographs that contradict the claim of one scale are refused, and the groups are named."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tests.analyses import made_card
from tests.flight.ground import ground, photograph_of, vehicles_of, write_flight
from tests.models import write_detector
from vehanchor.errors import InvalidParameterError
from vehanchor.imagery.facts import ImageFacts
from vehanchor.imagery.metadata.camera import CameraMetadata
from vehanchor.options import ScaleOptions
from vehanchor_flight.photograph import Photograph, StoredPhotograph
from vehanchor_flight.same_scale import check_same_scale
from vehanchor_flight.verbs import estimate_flight

NO_CARS = np.zeros(0)


def _photograph(
    name: str,
    image: ImageFacts,
    lengths: NDArray[np.float64] = NO_CARS,
    **options: Any,
) -> Photograph:
    stored = StoredPhotograph(image, vehicles_of(lengths), 1.0)
    return Photograph.of(name, stored, made_card(5.0), ScaleOptions.of(options))


def _taken(
    height_m: float | None = 80.0,
    focal_35mm: float | None = 24.0,
    width_px: int = 640,
    zoom: float = 1.0,
) -> ImageFacts:
    camera = CameraMetadata(
        height_m=height_m,
        height_tag="DJI RelativeAltitude",
        focal_35mm=focal_35mm,
        off_nadir_deg=0.0,
        digital_zoom=zoom,
    )
    return ImageFacts(width_px, width_px * 3 // 4, camera=camera)


CONTRADICTIONS = {
    "zoom": [_taken(), _taken(focal_35mm=72.0)],
    "smaller sensor": [_taken(), _taken(width_px=320)],
    "two heights": [_taken(43.0), _taken(85.0)],
    "zoom without heights": [_taken(None), _taken(None, focal_35mm=72.0)],
    "digital zoom": [_taken(), _taken(zoom=2.0)],
    "georeferences": [
        ImageFacts(640, 480, georeference_gsd_m_per_px=0.1),
        ImageFacts(640, 480, georeference_gsd_m_per_px=0.2),
    ],
}


@pytest.mark.parametrize("images", CONTRADICTIONS.values(), ids=CONTRADICTIONS)
def test_facts_of_two_scales_are_refused(images: list[ImageFacts]) -> None:
    members = [_photograph(name, image) for name, image in zip("ab", images, strict=True)]
    with pytest.raises(InvalidParameterError, match="do not have one scale"):
        check_same_scale(members, [])


AGREEMENTS = {
    "terrain": [_taken(80.0), _taken(88.0)],
    "barometer at a low height": [_taken(8.0), _taken(10.0)],
    "one height without metadata": [_taken(), ImageFacts(640, 480)],
    "no height, one lens": [_taken(None), _taken(None)],
}


@pytest.mark.parametrize("images", AGREEMENTS.values(), ids=AGREEMENTS)
def test_facts_of_one_scale_are_accepted(images: list[ImageFacts]) -> None:
    members = [_photograph(name, image) for name, image in zip("ab", images, strict=True)]
    check_same_scale(members, [])


def test_metadata_that_are_not_to_be_used_contradict_nothing() -> None:
    images = [_taken(43.0), _taken(85.0)]
    members = [_photograph(str(k), image, metadata=False) for k, image in enumerate(images)]
    check_same_scale(members, [])


def test_the_groups_are_named() -> None:
    heights = {"low/1.jpg": 43.0, "low/2.jpg": 44.0, "high/1.jpg": 85.0}
    members = [_photograph(f"flight/{name}", _taken(height)) for name, height in heights.items()]
    with pytest.raises(InvalidParameterError) as refusal:
        check_same_scale(members, [])
    message = str(refusal.value)
    assert "m/px: low/1.jpg, low/2.jpg; " in message
    assert "m/px: high/1.jpg. " in message
    assert "leave out same_scale" in message


CARS = 40.0 * (1 + 0.05 * np.linspace(-1, 1, 12) ** 3)


def test_cars_of_two_sizes_are_refused() -> None:
    plain = ImageFacts(800, 600)
    members = [_photograph("near", plain, 2 * CARS), _photograph("far", plain, CARS)]
    with pytest.raises(InvalidParameterError, match=r"near; .* far"):
        check_same_scale(members, [])


def test_two_cars_of_another_size_contradict_nothing() -> None:
    plain = ImageFacts(800, 600)
    members = [_photograph("few", plain, 2 * CARS[:2]), _photograph("many", plain, CARS)]
    check_same_scale(members, [])


def test_overlaps_of_two_scales_are_refused(tmp_path: Path) -> None:
    world = ground(seed=5)
    paths = []
    for number, scale in enumerate((1.0, 1.5)):
        path = str(tmp_path / f"{number}.png")
        cv2.imwrite(path, photograph_of(world, 600 + 40 * number, 600, scale=scale))
        paths.append(path)
    detector = write_detector(tmp_path / "painted.onnx")
    with pytest.raises(InvalidParameterError, match=r"1\.00 times .* 0\.png; 1\.5\d times"):
        estimate_flight(paths, same_scale=True, detector=detector, rulers=("vehicles",))


def test_photographs_of_one_scale_are_pooled(tmp_path: Path) -> None:
    detector = write_detector(tmp_path / "painted.onnx")
    fleets = [list(30 * (CARS / 40)), list(30.5 * (CARS / 40))]
    flight = write_flight(tmp_path, fleets)
    record = estimate_flight(flight, same_scale=True, detector=detector, rulers=("vehicles",))
    assert record.status == "ok"
