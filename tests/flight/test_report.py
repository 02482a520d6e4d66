from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from tests.analyses import made_card
from tests.flight.ground import facts_at, sighting_of
from vehanchor.errors import ImageDecodeError, OutputError
from vehanchor.options import ScaleOptions
from vehanchor_flight.components import single_component
from vehanchor_flight.io import check_output
from vehanchor_flight.photograph import Photograph, StoredPhotograph
from vehanchor_flight.record import Failure, conclude_flight
from vehanchor_flight.records import FlightEstimate, FlightLink
from vehanchor_flight.report import report_page, write_report
from vehanchor_flight.track import draw_tracks

FLEET = 30.0 * (1 + 0.05 * np.linspace(-1, 1, 9) ** 3)


@pytest.fixture(scope="module")
def record() -> FlightEstimate:
    card, options = made_card(5.0), ScaleOptions()
    photographs: list[Photograph | Failure] = [
        Photograph.of(name, StoredPhotograph(facts_at(40.0 * number, 10.0), sighting_of(cars), 1.0), card, options)
        for number, (name, cars) in enumerate([("<a>.jpg", FLEET), ("b.jpg", FLEET / 2), ("c.jpg", np.zeros(0))])
    ]
    photographs.append(Failure("d.jpg", ImageDecodeError("empty")))
    link = FlightLink(
        first="<a>.jpg", second="b.jpg", ratio=3.0, ratio_log_sd=0.1, n_matches=20, dropped="the ratio is 3 times off"
    )
    components = [single_component([place], 0) for place in range(3)]
    return conclude_flight(photographs, components, card, same_scale=False, links=[link])


def test_the_track_has_every_photograph_its_scale_and_what_supports_it(record: FlightEstimate) -> None:
    (svg,) = ElementTree.fromstring(f"<div>{draw_tracks(record)}</div>")
    told = [each.text or "" for each in svg.iter("title")]
    assert len(told) == 3
    assert told[0].startswith("<a>.jpg: 0.1667 m/px, ")
    assert told[0].endswith("vehicles of its own")
    assert told[2] == "c.jpg: no scale, no_scale, supported by nothing"
    discs = [each for each in svg.iter("circle") if list(each)]
    places = [float(each.attrib["cx"]) for each in discs]
    assert places[2] - places[1] == pytest.approx(places[1] - places[0], abs=0.2)
    assert discs[0].attrib["fill"] != discs[1].attrib["fill"]
    assert next(each.attrib["class"] for each in svg.iter("line")) == "dropped"


def test_the_page_needs_nothing_else_and_tells_what_was_dropped(record: FlightEstimate, tmp_path: Path) -> None:
    write_report(tmp_path / "flight.html", record)
    page = (tmp_path / "flight.html").read_text(encoding="utf-8")
    assert page == report_page(record)
    assert not re.search(r"<script|https?://|src=|@import|url\((?!#)", page)
    assert "&lt;a&gt;.jpg and b.jpg: the ratio is 3 times off" in page
    assert "<a>" not in page
    assert "image_undecodable: empty" in page


def test_a_flight_without_places_has_no_track() -> None:
    card = made_card(5.0)
    photographs = [
        Photograph.of(
            "a", StoredPhotograph(facts_at(0, 0)._replace(camera=None), sighting_of(FLEET), 1.0), card, ScaleOptions()
        )
    ]
    page = report_page(conclude_flight(photographs, [single_component([0], 0)], card, same_scale=True))
    assert "No track: no photograph has a position" in page
    assert "One scale for all photographs" in page


@pytest.mark.parametrize("name", ["flight.txt", "nowhere/flight.html"])
def test_a_page_that_cannot_be_written_is_told(tmp_path: Path, name: str) -> None:
    with pytest.raises(OutputError):
        check_output(tmp_path / name, ".html")
