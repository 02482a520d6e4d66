from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.analyses import made_card
from tests.flight.ground import vehicles_of
from tests.models import fleet
from tests.skill.rulers.test_camera_tilt import CAR_M, FACTS, FOCAL, GSD, _cars
from vehanchor.detection.detections import Detections
from vehanchor.errors import ImageNotFoundError
from vehanchor.imagery.facts import ImageFacts
from vehanchor.options import ScaleOptions
from vehanchor.rulers.camera_tilt import CameraTilt, metadata_tilt
from vehanchor_flight.components import single_component
from vehanchor_flight.photograph import Photograph, StoredPhotograph
from vehanchor_flight.project import estimate_in_flight
from vehanchor_flight.record import Failure, conclude_flight
from vehanchor_flight.records import FlightEstimate

TILT = CameraTilt(35.0, 0.0, focal_length_px=FOCAL, source="metadata")
NOTHING = Detections(np.zeros((0, 5)), np.zeros(0))
FLEET = fleet(12, 50.0)


def _photograph(name: str, image: ImageFacts, detections: Detections) -> Photograph:
    tilt = metadata_tilt(image, ScaleOptions())
    stored = StoredPhotograph(image, detections, 1.0, tilt=tilt)
    return Photograph.of(name, stored, made_card(CAR_M), ScaleOptions())


def _with_and_without_cars() -> list[Photograph]:
    cars = _photograph("cars", ImageFacts(500, 500), vehicles_of(FLEET))
    return [cars, _photograph("bare", ImageFacts(500, 400), NOTHING)]


def _flight(*results: Photograph | Failure) -> FlightEstimate:
    usable = [index for index, result in enumerate(results) if isinstance(result, Photograph)]
    component = single_component(usable, 0)
    return conclude_flight(results, [component], made_card(CAR_M), same_scale=True)


def test_a_photograph_keeps_its_own_facts_in_a_flight() -> None:
    flight = _flight(*_with_and_without_cars())
    record = estimate_in_flight(flight, flight.photographs[1])
    assert record.n_vehicles == 0
    assert record.image_height_px == 400


def test_a_photograph_has_the_scale_of_its_flight() -> None:
    cars, bare = _with_and_without_cars()
    flight = _flight(cars, bare)
    record = estimate_in_flight(flight, flight.photographs[1])
    assert bare.analysis.estimate.gsd_m_per_px is None
    assert record.gsd_m_per_px == flight.gsd_m_per_px
    assert record.status == "ok"
    assert record.leading_ruler == "vehicles"
    ruler_scales = [ruler.gsd_m_per_px for ruler in record.rulers]
    assert ruler_scales == pytest.approx([flight.gsd_m_per_px], rel=1e-3)


def test_a_photograph_that_could_not_be_read_has_no_record() -> None:
    cars = _photograph("cars", ImageFacts(500, 500), vehicles_of(np.full(9, 50.0)))
    flight = _flight(cars, Failure("gone", ImageNotFoundError("no such file")))
    with pytest.raises(ValueError, match="gone could not be read"):
        estimate_in_flight(flight, flight.photographs[1])


@pytest.fixture
def far() -> FlightEstimate:
    """Conclude a flight whose second photograph is linked to the first with a large error."""
    component = replace(single_component([0, 1], 0), log_sds=np.array([0.0, 0.4]))
    photographs = _with_and_without_cars()
    return conclude_flight(photographs, [component], made_card(CAR_M), same_scale=False)


def test_a_scale_that_is_carried_too_far_is_not_usable(far: FlightEstimate) -> None:
    near_record, far_record = (estimate_in_flight(far, each) for each in far.photographs)
    assert near_record.status == "ok"
    assert near_record.reason is None
    assert far_record.status == "low_confidence"
    assert far_record.reason == "imprecise"


def test_a_scale_that_is_carried_too_far_has_advice(far: FlightEstimate) -> None:
    assert far.photographs[0].advice is None
    assert far.photographs[1].advice == (
        "Its rulers are in other photographs, and the overlaps in between widen the interval: "
        "add photographs between them, or give the height."
    )


@pytest.fixture
def unlinked() -> FlightEstimate:
    """Conclude a flight of two photographs that nothing links, the second without cars."""
    components = [single_component([index], 0) for index in range(2)]
    photographs = _with_and_without_cars()
    return conclude_flight(photographs, components, made_card(CAR_M), same_scale=False)


def test_an_unlinked_photograph_with_cars_needs_no_advice(unlinked: FlightEstimate) -> None:
    assert unlinked.photographs[0].reason is None
    assert unlinked.components[0].advice is None


def test_an_unlinked_photograph_without_cars_has_advice(unlinked: FlightEstimate) -> None:
    bare = unlinked.photographs[1]
    assert bare.status == "no_scale"
    assert bare.reason == "too_few"
    assert bare.advice == unlinked.components[1].advice
    assert "no other photograph overlaps it" in (bare.advice or "")


@pytest.fixture
def tilted() -> FlightEstimate:
    """Conclude a flight of two tilted photographs, the second without cars."""
    cars = _photograph("one", FACTS, _cars(TILT))
    return _flight(cars, _photograph("bare", FACTS, NOTHING))


@pytest.mark.parametrize("bare", [False, True])
def test_a_tilted_flight_has_its_tilt_at_its_own_scale(tilted: FlightEstimate, bare: bool) -> None:
    record = tilted.components[0].pooled
    if bare:
        record = estimate_in_flight(tilted, tilted.photographs[1])
    assert record.tilt is not None
    # The cars are a cue of the tilt, beside the metadata.
    assert record.tilt.tilt_deg == pytest.approx(35.0, abs=2)
    assert record.gsd_m_per_px is not None
    assert record.gsd_m_per_px == pytest.approx(GSD, rel=0.12)
    smallest = record.tilt.gsd_least_m_per_px
    largest = record.tilt.gsd_largest_m_per_px
    assert smallest is not None
    assert largest is not None
    assert smallest < record.gsd_m_per_px < largest


def test_a_tilted_photograph_without_cars_has_no_scale_of_its_own(tilted: FlightEstimate) -> None:
    own = tilted.photographs[1].own
    assert own is not None
    assert own.tilt is not None
    assert own.tilt.gsd_least_m_per_px is None
