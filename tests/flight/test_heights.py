from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.analyses import made_card
from tests.flight.ground import sighting_of
from vehanchor.imagery.facts import ImageFacts
from vehanchor.imagery.metadata.camera import CameraMetadata
from vehanchor.options import ScaleOptions
from vehanchor_flight.components import single_component
from vehanchor_flight.photograph import Photograph, StoredPhotograph
from vehanchor_flight.record import conclude_flight
from vehanchor_flight.records import FlightEstimate

GROUND_M, FOCAL_PX, CAR_M = 312.0, 1000.0, 5.0
FLEET = CAR_M * (1 + 0.05 * np.linspace(-1, 1, 30) ** 3)
CAMERA = CameraMetadata(
    latitude_deg=46.0, longitude_deg=7.0, focal_px=FOCAL_PX, taken_width_px=500, taken_height_px=500
)


def _photograph(
    name: str, above_m: float, *, cars: bool, camera: CameraMetadata = CAMERA, options: ScaleOptions | None = None
) -> Photograph:
    """Taken so high above the ground, with cars or none."""
    facts = ImageFacts(500, 500, camera=replace(camera, altitude_m=GROUND_M + above_m))
    lengths = FLEET / (above_m / FOCAL_PX) if cars else np.zeros(0)
    return Photograph.of(
        name, StoredPhotograph(facts, sighting_of(lengths), 1.0), made_card(CAR_M), options or ScaleOptions()
    )


def _flight(*photographs: Photograph) -> FlightEstimate:
    """Photographs that nothing ties to each other."""
    components = [single_component([place], 0) for place in range(len(photographs))]
    return conclude_flight(photographs, components, made_card(CAR_M), same_scale=False)


def test_a_photograph_that_nothing_ties_has_its_scale_by_its_height_above_the_sea() -> None:
    low, high = _flight(_photograph("low", 90.0, cars=True), _photograph("high", 120.0, cars=False)).photographs
    assert low.status == "ok"
    assert high.gsd_m_per_px == pytest.approx(0.120, rel=0.03)
    assert high.gsd_ci95_low_m_per_px is not None
    assert high.gsd_ci95_high_m_per_px is not None
    assert high.gsd_ci95_low_m_per_px < 0.10 < 0.14 < high.gsd_ci95_high_m_per_px
    assert high.supported_by[0].ruler == "positions"
    assert high.scale is None or high.scale.confidence < 0.9


def test_the_order_of_islands_does_not_matter() -> None:
    first, second = _flight(_photograph("high", 120.0, cars=False), _photograph("low", 90.0, cars=True)).photographs
    assert first.gsd_m_per_px == pytest.approx(0.120, rel=0.03)
    assert second.gsd_m_per_px == pytest.approx(0.090, rel=0.03)


@pytest.mark.parametrize(
    "other",
    [
        _photograph("without a lens", 120.0, cars=False, camera=replace(CAMERA, focal_px=None)),
        _photograph("another place", 900.0, cars=False),
        _photograph("below the ground", -20.0, cars=False),
    ],
)
def test_heights_that_tell_nothing_leave_it_without_a_scale(other: Photograph) -> None:
    assert _flight(_photograph("low", 90.0, cars=True), other).photographs[1].gsd_m_per_px is None


def test_without_metadata_heights_are_not_read() -> None:
    bare = ScaleOptions.of({"metadata": False})
    flight = _flight(
        _photograph("low", 90.0, cars=True, options=bare), _photograph("high", 120.0, cars=False, options=bare)
    )
    assert flight.photographs[1].gsd_m_per_px is None


def test_a_scale_that_is_not_sure_says_nothing_of_the_ground() -> None:
    alone = replace(_photograph("low", 90.0, cars=True))
    one_car = StoredPhotograph(alone.view.image, sighting_of(FLEET[:1] / 0.09), 1.0)
    doubtful = Photograph.of("low", one_car, made_card(CAR_M), ScaleOptions())
    record = _flight(doubtful, _photograph("high", 120.0, cars=False))
    assert record.photographs[0].status == "low_confidence"
    assert record.photographs[1].gsd_m_per_px is None
