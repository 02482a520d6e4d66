from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.analyses import made_card
from tests.flight.ground import sighting_of
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

LOOKED = CameraTilt(35.0, 0.0, focal_length_px=FOCAL, source="metadata")
NOTHING = Detections(np.zeros((0, 5)), np.zeros(0))
FLEET = fleet(12, 50.0)


def _photograph(name: str, image: ImageFacts, found: Detections) -> Photograph:
    kept = StoredPhotograph(image, found, 1.0, tilt=metadata_tilt(image, ScaleOptions()))
    return Photograph.of(name, kept, made_card(CAR_M), ScaleOptions())


def _with_and_without_cars() -> list[Photograph]:
    cars = _photograph("cars", ImageFacts(500, 500), sighting_of(FLEET))
    return [cars, _photograph("bare", ImageFacts(500, 400), NOTHING)]


def _flight(*photographs: Photograph | Failure) -> FlightEstimate:
    places = [place for place, stored in enumerate(photographs) if isinstance(stored, Photograph)]
    return conclude_flight(
        photographs, [single_component(places, 0)], made_card(CAR_M), same_scale=True
    )


def test_a_photograph_of_a_flight_has_its_own_record_with_the_flights_scale() -> None:
    cars, bare = _with_and_without_cars()
    flight = _flight(cars, bare)
    record = estimate_in_flight(flight, flight.photographs[1])
    assert bare.analysis.estimate.gsd_m_per_px is None
    assert (record.n_vehicles, record.image_height_px) == (0, 400)
    assert record.gsd_m_per_px == flight.gsd_m_per_px
    assert (record.status, record.leading_ruler) == ("ok", "vehicles")
    assert [ruler.gsd_m_per_px for ruler in record.rulers] == pytest.approx(
        [flight.gsd_m_per_px], rel=1e-3
    )


def test_a_photograph_that_could_not_be_read_has_no_record() -> None:
    flight = _flight(
        _photograph("cars", ImageFacts(500, 500), sighting_of(np.full(9, 50.0))),
        Failure("gone", ImageNotFoundError("no such file")),
    )
    with pytest.raises(ValueError, match="gone could not be read"):
        estimate_in_flight(flight, flight.photographs[1])


def test_what_is_carried_too_far_to_be_used_says_why() -> None:
    photographs = _with_and_without_cars()
    component = replace(single_component([0, 1], 0), log_sds=np.array([0.0, 0.4]))
    flight = conclude_flight(photographs, [component], made_card(CAR_M), same_scale=False)
    near, far = (estimate_in_flight(flight, each) for each in flight.photographs)
    assert (near.status, near.reason) == ("ok", None)
    assert (far.status, far.reason) == ("low_confidence", "imprecise")
    assert flight.photographs[0].advice is None
    assert flight.photographs[1].advice == (
        "Its rulers are in other photographs, and the overlaps in between widen the interval: "
        "add photographs between them, or give the height."
    )


def test_photographs_and_components_that_nothing_links_have_advice_of_their_own() -> None:
    photographs = _with_and_without_cars()
    components = [single_component([place], 0) for place in range(2)]
    flight = conclude_flight(photographs, components, made_card(CAR_M), same_scale=False)
    assert (flight.photographs[0].reason, flight.components[0].advice) == (None, None)
    bare = flight.photographs[1]
    assert (bare.status, bare.reason) == ("no_scale", "too_few")
    assert bare.advice == flight.components[1].advice
    assert "no other photograph overlaps it" in (bare.advice or "")


def test_a_flight_that_looked_aside_tells_its_tilt_at_its_own_scale() -> None:
    members = [_photograph("one", FACTS, _cars(LOOKED)), _photograph("bare", FACTS, NOTHING)]
    flight = _flight(*members)
    pooled = flight.components[0].pooled
    bare = estimate_in_flight(flight, flight.photographs[1])
    for record in (pooled, bare):
        assert record.tilt is not None
        assert record.tilt.tilt_deg == pytest.approx(35.0, abs=2)  # the cars are heard, too
        assert record.gsd_m_per_px is not None
        assert record.gsd_m_per_px == pytest.approx(GSD, rel=0.12)
        assert record.tilt.gsd_least_m_per_px is not None
        assert record.tilt.gsd_largest_m_per_px is not None
        assert (
            record.tilt.gsd_least_m_per_px < record.gsd_m_per_px < record.tilt.gsd_largest_m_per_px
        )
    own = members[1].analysis.estimate.tilt
    assert own is not None
    assert own.gsd_least_m_per_px is None
